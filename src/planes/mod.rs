//! Grows planar regions over a mesh.
//!
//! In: a [`Mesh`]. Out: [`Planes`]: a normal per vertex, a region per face, a plane per region.
//!
//! # Method
//! 1. `normals`: face normals filtered over edge neighbours within a radius, edges preserved; vertex normals are
//!    their area-weighted means. (The paper fits a surface per vertex neighbourhood; a filtered normal is that
//!    fit's gradient at a tenth of the cost.)
//! 2. `grow`: seeds by flatness, flattest first; a region takes neighbours that pass a distance and an angle to
//!    its plane, which is refitted by least squares whenever it has grown by a quarter.
//! 3. Faces on a border between regions go to the region that fits them best; coplanar neighbours merge; what
//!    stays small dissolves.
//!
//! # Numbers
//! see [`PlanesConfig`]
//!
//! # Promises
//! deterministic for any number of threads; `regions` is sorted by area; ids index it
//!
//! # Limits
//! growing itself is serial; a smooth curved surface falls apart into flat patches; a wall of the demo city takes
//! 1.5 regions to cover nine tenths of it (scattered seeds without merging, as in the paper: 1.54)
//!
//! # Cost
//! measured 0.35 µs of one core a face (3.0 M faces of a town, busy machine); with the four classes' scores 0.76 µs, or
//! 1.3 M faces/s, and at the peak about 100 bytes a face beside the mesh. `cargo bench --bench front_end` prints both

use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

use crate::mesh::Mesh;

mod fit;
mod grow;
mod normals;

pub use fit::{Moments, Plane};

/// Planar regions of a mesh and the smoothed normals they grew from.
#[derive(Debug, Clone, Default)]
pub struct Planes {
    /// Per vertex unit normal from a surface fit in its neighbourhood.
    pub vertex_normals: Vec<Vec3>,
    /// Per face region, `NONE` where no region claims it.
    pub face_region: Vec<u32>,
    /// The regions, largest first.
    pub regions: Vec<Region>,
    /// Per face the face behind each edge, as [`crate::mesh::topology::face_neighbours`] gives it.
    pub neighbours: Vec<[u32; 3]>,
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

/// How flat a plane has to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlanesConfig {
    /// Largest distance of a face's centre from its region's plane, metres, > 0. Corners may be twice as far.
    /// Default: none, which takes max(half the median edge, four times the mesh's own noise), within 0.05 to 0.5.
    pub distance_m: Option<f64>,
    /// Largest angle between a face's filtered normal and its region's, degrees, 1 to 80. Default: 25.
    pub angle_deg: f64,
    /// Radius over which face normals are filtered, metres, ≥ 0. Default: 1.0, the size of the smallest part of a
    /// roof worth a plane of its own.
    pub smoothing_radius_m: f64,
    /// Smaller regions dissolve, m². Default: 0.5.
    pub min_area_m2: f64,
    /// Regions of fewer faces dissolve unless they are larger than 8 m². Default: 6.
    pub min_faces: u32,
    /// Where regions start. Default: planar.
    pub seeds: Seeds,
}

/// Where regions start to grow.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Seeds {
    /// Flattest faces first; coplanar neighbours merge in the end.
    #[default]
    Planar,
    /// Any face in a scattered order and nothing merges, as the paper has it.
    Random,
}

impl Default for PlanesConfig {
    fn default() -> Self {
        Self {
            distance_m: None,
            angle_deg: 25.0,
            smoothing_radius_m: 1.0,
            min_area_m2: 0.5,
            min_faces: 6,
            seeds: Seeds::Planar,
        }
    }
}

impl PlanesConfig {
    /// Every setting that is out of its range, as a sentence.
    pub fn check(&self) -> Vec<String> {
        let mut wrong = Vec::new();
        if self.distance_m.is_some_and(|d| !(d > 0.0 && d.is_finite())) {
            wrong.push(format!("planes.distance_m is {:?}, wanted a positive length", self.distance_m));
        }
        if !(1.0..=80.0).contains(&self.angle_deg) {
            wrong.push(format!("planes.angle_deg is {}, wanted 1 to 80", self.angle_deg));
        }
        if !(self.smoothing_radius_m >= 0.0 && self.smoothing_radius_m.is_finite()) {
            wrong.push(format!("planes.smoothing_radius_m is {}, wanted 0 or more", self.smoothing_radius_m));
        }
        if !(self.min_area_m2 >= 0.0 && self.min_area_m2.is_finite()) {
            wrong.push(format!("planes.min_area_m2 is {}, wanted 0 or more", self.min_area_m2));
        }
        wrong
    }
}

/// The natural units of a mesh, from which thresholds follow.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Grain {
    /// Median edge length, metres.
    pub median_edge_m: f64,
    /// Typical distance of a face's neighbours from its plane, metres: the noise at the scale of one edge.
    pub noise_m: f64,
}

impl Grain {
    /// Measures a mesh.
    pub fn of(mesh: &Mesh, config: &PlanesConfig) -> Self {
        normals::surface(mesh, config, None).grain
    }
}

/// Finds the planes of a mesh.
pub fn grow(mesh: &Mesh, config: &PlanesConfig) -> Planes {
    grow_part(mesh, config, None)
}

/// Finds the planes of a part of something larger whose grain is known.
pub fn grow_part(mesh: &Mesh, config: &PlanesConfig, grain: Option<Grain>) -> Planes {
    let surface = normals::surface(mesh, config, grain);
    let vertex_normals = normals::of_vertices(mesh, &surface);
    let (face_region, regions) = grow::regions(mesh, &surface, config);
    Planes {
        vertex_normals,
        face_region,
        regions,
        neighbours: surface.neighbours,
        median_edge_m: surface.grain.median_edge_m,
    }
}
