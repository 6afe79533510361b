//! The gate: welds, cleans and centres a [`Source`](crate::input::Source) into a [`Mesh`] that later stages trust.

use glam::{DVec3, Vec2};

use crate::input::Material;

pub mod topology;

/// A welded triangle mesh in the local frame (metres, x east, y north, z up). Valid by construction: see [`Mesh::check`].
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// Local positions, metres. Finite. Welded: no wedges; seams live in `corner_uvs`.
    pub positions: Vec<DVec3>,
    /// Three different indices into `positions`.
    pub faces: Vec<[u32; 3]>,
    /// Per face and corner, v down; empty when nothing is textured. Zero for faces whose material has no image.
    pub corner_uvs: Vec<[Vec2; 3]>,
    /// Per face, index into `materials`.
    pub face_material: Vec<u32>,
    /// Per vertex sRGB; empty when the input has none.
    pub vertex_colors: Vec<[u8; 3]>,
    /// Per face label found in the input (SUM numbering, -1 unknown); empty when the input has none.
    pub face_labels: Vec<i16>,
    /// Referenced by `face_material`.
    pub materials: Vec<Material>,
}

impl Mesh {
    /// The three corners of face `f`.
    pub fn corners(&self, f: usize) -> [DVec3; 3] {
        self.faces[f].map(|v| self.positions[v as usize])
    }

    /// Twice-area vector of face `f`: its length is twice the area in m², its direction the normal.
    pub fn cross(&self, f: usize) -> DVec3 {
        let [a, b, c] = self.corners(f);
        (b - a).cross(c - a)
    }
}
