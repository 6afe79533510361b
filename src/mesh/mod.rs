//! The gate: welds, cleans and centres a [`Source`](crate::input::Source) into a [`Mesh`] that later stages trust.

use glam::{DVec3, Vec2};

use crate::input::Material;

pub mod weld;

pub use weld::{GateConfig, GateReport, gate, gate_unit};

/// Positions sit on a grid of 2⁻²⁰ m (about 1 µm), cell walls included. Differences of grid points are exact in f64
/// out to 8 000 km, so a vertex on a wall stays on it through every change of origin.
pub const GRID_PER_M: f64 = (1u64 << 20) as f64;

/// The nearest grid point.
pub fn on_grid(p: DVec3) -> DVec3 {
    (p * GRID_PER_M).round() / GRID_PER_M
}
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
    #[inline]
    pub fn corners(&self, f: usize) -> [DVec3; 3] {
        // Written out, since `map` becomes a call: this is a fifth of the time of the whole front end.
        let [a, b, c] = self.faces[f];
        [self.positions[a as usize], self.positions[b as usize], self.positions[c as usize]]
    }

    /// Twice-area vector of face `f`: its length is twice the area in m², its direction the normal.
    pub fn cross(&self, f: usize) -> DVec3 {
        let [a, b, c] = self.corners(f);
        (b - a).cross(c - a)
    }

    /// Keeps the faces marked true, with all that belongs to them, in order.
    pub fn retain_faces(&mut self, keep: &[bool]) {
        fn retain<T>(items: &mut Vec<T>, keep: &[bool]) {
            let mut f = 0;
            items.retain(|_| {
                f += 1;
                keep[f - 1]
            });
        }
        retain(&mut self.faces, keep);
        retain(&mut self.face_material, keep);
        retain(&mut self.corner_uvs, keep);
        retain(&mut self.face_labels, keep);
    }

    /// Says what is wrong with a mesh that breaks the gate's promises; for tests and debug assertions.
    ///
    /// # Errors
    /// The first broken promise, in words.
    pub fn check(&self) -> Result<(), String> {
        let per_face = [("corner_uvs", self.corner_uvs.len()), ("face_labels", self.face_labels.len())];
        if let Some((name, len)) = per_face.iter().find(|(_, len)| *len != 0 && *len != self.faces.len()) {
            return Err(format!("{name} has {len} entries for {} faces", self.faces.len()));
        }
        if self.face_material.len() != self.faces.len() {
            return Err("every face needs a material index".into());
        }
        if let Some(p) = self.positions.iter().find(|p| !p.is_finite()) {
            return Err(format!("position {p} is not finite"));
        }
        let count = self.positions.len() as u32;
        for (f, &[a, b, c]) in self.faces.iter().enumerate() {
            if a.max(b).max(c) >= count || a == b || b == c || c == a {
                return Err(format!("face {f} has corners {a} {b} {c} of {count} vertices"));
            }
        }
        Ok(())
    }
}
