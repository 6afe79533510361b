//! Tells roof, façade, terrain and clutter apart without training.
//!
//! In: a [`Mesh`] and its [`Planes`]. Out: [`Classes`]: a probability per class and face.
//!
//! # Method
//! 1. `ground`: a height grid of the ground under buildings and trees; heights are above it.
//! 2. `features`: per face height and uprightness; per plane area, texture, residual and top.
//! 3. `rules`: products of sigmoids, one per class. A roof is planar, not upright, in the air; a façade planar,
//!    upright, and its top is in the air (a cliff's is not); terrain is low; clutter is what is rough.
//! 4. `smooth`: a mean field over neighbours, a vote per plane.
//! 5. `context`: roofs that touch form a footprint with a free rim or are none; walls belong to buildings; what is
//!    under or enclosed by a building is building; tiny patches join what is around them.
//!
//! # Numbers
//! see [`ClassesConfig`]
//!
//! # Promises
//! posteriors sum to 1 and the label is their argmax; same result for any number of threads; moving
//! the mesh moves nothing else
//!
//! # Limits
//! see `ground`; colour is not looked at, so a clipped hedge is a wall
//!
//! # Cost
//! with planes and all 0.73 to 0.78 µs of one core a face, 1.3 M faces/s (3.0 M faces of a town; CGAL's region growing,
//! features and classifier 264 µs), of which the four scores 0.40; more where the ground grid has more cells than the mesh has faces. What profiles taught: reading corners
//! through a call that is not inlined took a fifth, `f32::floor` and divisions in `exp` a twentieth, a list of the faces
//! around each vertex a twentieth, sweeping over all faces where only borders change another. What is left is reading
//! memory in no order and, for an eighth, the first touch of fresh pages. Memory: see [`crate::planes`]
//!
//! # References
//! Verdie, Lafarge, Alliez, LOD generation for urban scenes, 2015. The paper's energies (Eq. 9
//! to 16) are in [`paper`], its features in [`nine`], other classes than the four in [`scheme`].

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::ids::{ClassId, ClassScheme};
use crate::mesh::Mesh;
use crate::planes::{NONE, Planes};

mod classify;
mod confusion;
mod context;
mod features;
mod ground;
pub mod nine;
pub mod paper;
mod raster;
mod rules;
pub mod scheme;
mod smooth;
pub mod truth;
pub mod tune;

pub use classify::{Classifier, classify, classify_measured, looks_at_colors};
pub use confusion::{Confusion, confusion};
pub use ground::{Ground, Lattice};
pub use nine::Scene;

/// A probability per class for every face.
#[derive(Debug, Clone)]
pub struct Classes {
    /// The classes and their budgets.
    pub scheme: ClassScheme,
    /// `face * scheme.len() + class`: P(class | face), each face sums to 1.
    pub posterior: Vec<f32>,
    /// The most probable class per face.
    pub label: Vec<ClassId>,
}

impl Classes {
    /// P(class | face) over all classes of face `f`.
    pub fn of(&self, f: usize) -> &[f32] {
        let n = self.scheme.len();
        &self.posterior[f * n..(f + 1) * n]
    }
}

/// Where the rules draw their lines. Lengths in metres.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClassesConfig {
    /// `robust`, `paper`, `paper-eq10` or `cgal`. Default: robust. What follows up to `nine` is for `robust`.
    pub classifier: Classifier,
    /// Below this height above ground things lie on it, metres, > 0. Default: 0.9.
    pub low_m: f64,
    /// Above this height they are in the air, metres, > `low_m`. Default: 2.3: no car, any storey.
    pub high_m: f64,
    /// A wall's top is at least this high above ground, metres, > 0. Default: 2.0.
    pub wall_height_m: f64,
    /// How far from vertical a wall's plane may be, degrees, 1 to 45. Default: 14.
    pub upright_deg: f64,
    /// Planes count fully from about twice this area, m², > 0. Default: 8.
    pub area_scale_m2: f64,
    /// Mean of 1 - cos between faces and their plane where foliage begins, 0 to 1. Default: 0.16.
    pub foliage_spread: f64,
    /// The widest building that still stands on the ground, metres, 4 to 400. Default: 62. Wider means slower.
    pub widest_building_m: f64,
    /// Limit of the ground grid's cells, ≥ 1024. Default: 4 million.
    pub max_cells: u32,
    /// Strength of the mean field, 0 (off) to 20. Default: 3.
    pub smoothing: f64,
    /// Planes above this area vote as one, m², ≥ 0. Default: 4.
    pub vote_area_m2: f64,
    /// Patches of one class below this area join what surrounds them, m², ≥ 0. Default: 1.
    pub island_m2: f64,
    /// The least footprint of a building, m², ≥ 0. Default: 10: a garage, not a van or a treetop's flat spot.
    pub min_footprint_m2: f64,
    /// Neighbourhoods of the paper's features.
    pub nine: nine::NineConfig,
    /// Classes, features, scales and effects of the table-driven classifiers. Default: none, which takes the embedded
    /// table of that name; `src/classes/paper/tables.toml` has them all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub table: Option<paper::Table>,
}

impl Default for ClassesConfig {
    fn default() -> Self {
        Self {
            classifier: Classifier::Robust,
            low_m: 0.9,
            high_m: 2.3,
            wall_height_m: 2.0,
            upright_deg: 14.0,
            area_scale_m2: 8.0,
            foliage_spread: 0.16,
            widest_building_m: 62.0,
            max_cells: 4_000_000,
            smoothing: 3.0,
            vote_area_m2: 4.0,
            island_m2: 1.0,
            min_footprint_m2: 10.0,
            nine: nine::NineConfig::default(),
            table: None,
        }
    }
}

impl ClassesConfig {
    /// Every setting that is out of its range, as a sentence.
    pub fn check(&self) -> Vec<String> {
        let ranges = [
            ("low_m", self.low_m, 1e-3, 100.0),
            ("high_m", self.high_m, self.low_m, 1000.0),
            ("wall_height_m", self.wall_height_m, 1e-3, 1000.0),
            ("upright_deg", self.upright_deg, 1.0, 45.0),
            ("area_scale_m2", self.area_scale_m2, 1e-3, 1e6),
            ("foliage_spread", self.foliage_spread, 1e-3, 1.0),
            ("widest_building_m", self.widest_building_m, 4.0, 400.0),
            ("max_cells", f64::from(self.max_cells), f64::from(ground::MIN_CELLS), f64::from(u32::MAX)),
            ("smoothing", self.smoothing, 0.0, 20.0),
            ("vote_area_m2", self.vote_area_m2, 0.0, 1e9),
            ("island_m2", self.island_m2, 0.0, 1e9),
            ("min_footprint_m2", self.min_footprint_m2, 0.0, 1e9),
        ];
        let out = ranges.iter().filter(|(_, value, low, high)| !(low..=high).contains(&value));
        let mut wrong: Vec<String> =
            out.map(|(name, value, low, high)| format!("classify.{name} is {value}, wanted {low} to {high}")).collect();
        wrong.extend(self.nine.check());
        wrong
    }
}

/// Gives every face its probabilities, by `robust` and without colours; see [`classify`] for the others.
///
/// # Panics
/// If the scheme is empty, which its check refuses.
pub fn label(mesh: &Mesh, planes: &Planes, scheme: &ClassScheme, config: &ClassesConfig) -> Classes {
    classify(Scene { mesh, planes, face_colors: &[] }, scheme, config)
}

/// Scores of terrain, façade, roof and clutter per face.
fn robust(scene: Scene, neighbours: &[[u32; 3]], ground: &Ground, config: &ClassesConfig) -> Vec<rules::Scores> {
    let Scene { mesh, planes, .. } = scene;
    let mut features = features::Features::of(mesh, planes, ground);
    let region = |f: usize| match planes.face_region[f] {
        NONE => None,
        r => Some(&features.regions[r as usize]),
    };
    let faces = (0..mesh.faces.len()).into_par_iter().with_min_len(4096);
    let unary = faces.map(|f| rules::scores(&features, f, region(f), config)).collect();
    let normals = std::mem::take(&mut features.normals);
    drop(features);
    let mut field = smooth::smooth(mesh, planes, neighbours, normals, config, unary);
    context::revise(scene, neighbours, ground, config, &mut field);
    field
}

#[cfg(test)]
mod tests;
