//! Grows planar regions over a mesh.

use glam::{DVec3, Vec3};

/// Planar regions of a mesh and the smoothed normals they grew from.
#[derive(Debug, Clone, Default)]
pub struct Planes {
    /// Per vertex unit normal from a surface fit in its neighbourhood.
    pub vertex_normals: Vec<Vec3>,
    /// Per face region, `NONE` where no region claims it.
    pub face_region: Vec<u32>,
    /// The regions, largest first.
    pub regions: Vec<Region>,
    /// Median edge length of the mesh, metres: the natural unit of its neighbourhoods.
    pub median_edge_m: f64,
}

/// A face that belongs to no region.
pub const NONE: u32 = u32::MAX;

/// One plane with its extent.
#[derive(Debug, Clone, Copy)]
pub struct Region {
    /// Unit normal, pointing the way its faces do.
    pub normal: DVec3,
    /// A point on the plane: the area-weighted centroid, local metres.
    pub centroid: DVec3,
    /// Area of its faces, m².
    pub area_m2: f64,
    /// Number of its faces.
    pub faces: u32,
}
