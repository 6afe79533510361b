//! How many levels a tree has and when one is coarse enough.
//!
//! # Method
//! 1. Leaves show the source itself.
//! 2. For each depth, deepest first, the surface collapses in steps of [`LevelsConfig::step_ratio`] with the walls of
//!    that depth kept, until no tile has more than [`LevelsConfig::tile_faces`] faces and the level has lost at least
//!    a third of the level below. Faces fall 2.1–2.7 times for a doubling of scale on real meshes, so a quadtree level
//!    needs about three times the scale of the one below. A step that cannot be the last is left out: three in eleven of
//!    a town, with 0.67 of the time of the collapse, the same levels, and mean errors 0 to 3 % lower.
//! 3. A root that is still heavy gets lighter roots on top of it, so that the first view loads at once.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::skirt::Skirts;
use crate::ids::ClassId;

/// How the hierarchy is made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LevelsConfig {
    /// A leaf has at most this many source faces. Default: 40 000.
    pub leaf_faces: usize,
    /// A leaf uses at most this many texels of the source's images. Default: 4 194 304 (2048²).
    pub leaf_texels: usize,
    /// A simplified tile has at most this many faces. Default: 30 000.
    pub tile_faces: usize,
    /// A root above this many faces gets a lighter one on top. Default: 8 000, about 400 kB with its texture.
    pub root_faces: usize,
    /// What is classified or collapsed at a time has about this many faces, and takes 0.4 kB of memory for each.
    /// Default: 2 000 000.
    pub window_faces: usize,
    /// A tile is measured against the source below it as long as that has at most this many faces, else against finer
    /// tiles; it takes 0.4 kB of memory for each. Default: 1 000 000.
    pub reference_faces: usize,
    /// Scale of a step over that of the step before. Default: 1.6: larger steps overshoot the faces a
    /// tile may have, smaller ones try every edge more often and end up no nearer to the source.
    pub step_ratio: f64,
    /// Strips along the walls of cells that hide gaps between tiles of different levels: `"auto"`, `"off"`, or their
    /// depth in metres. Default: `"auto"`, as deep as the gaps.
    pub skirts: Skirts,
    /// Raise simplified tiles where they are lower than a roof or a façade of the source by more than the budget of
    /// that class at scale 1. Default: false.
    pub keep_tops: bool,
}

impl Default for LevelsConfig {
    fn default() -> Self {
        Self {
            leaf_faces: 40_000,
            leaf_texels: 1 << 22,
            tile_faces: 30_000,
            root_faces: 8_000,
            window_faces: 2_000_000,
            reference_faces: 1_000_000,
            step_ratio: 1.6,
            skirts: Skirts::Auto,
            keep_tops: false,
        }
    }
}

impl LevelsConfig {
    /// What is wrong with the settings, in words.
    pub fn faults(&self) -> Vec<String> {
        let mut faults = Vec::new();
        for (name, value) in [
            ("leaf_faces", self.leaf_faces),
            ("tile_faces", self.tile_faces),
            ("root_faces", self.root_faces),
            ("window_faces", self.window_faces),
            ("reference_faces", self.reference_faces),
        ] {
            if value < 100 {
                faults.push(format!("levels.{name} is {value}; use at least 100"));
            }
        }
        if self.leaf_texels < 4096 {
            faults.push(format!("levels.leaf_texels is {}; use at least 4096", self.leaf_texels));
        }
        if !(1.05..=4.0).contains(&self.step_ratio) {
            faults.push(format!("levels.step_ratio is {}; use 1.05 to 4", self.step_ratio));
        }
        faults
    }

    /// True where one step will not bring a tile of `heaviest` faces down to `most`, so that it may be left out.
    pub fn is_far(&self, heaviest: usize, most: usize) -> bool {
        heaviest as f64 > most as f64 * MOST_LOST_A_DOUBLING.powf(self.step_ratio.log2())
    }
}

/// Faces fall at most so many times for a doubling of scale.
const MOST_LOST_A_DOUBLING: f64 = 2.7;
/// The first step's tolerance as a share of the median edge: below it almost nothing collapses.
pub const FIRST_TOLERANCE_EDGES: f64 = 1.0 / 16.0;
/// A level must lose at least this share of the faces of the level below: less is not worth a level.
pub const LEAST_REDUCTION: f64 = 0.3;
/// A step that loses less than this share buys too little for its error; after two of them in a row a level is taken as
/// it is, or the surface would be spoilt for faces that it cannot lose.
const STALLED_SHARE: f64 = 0.1;
const MOST_STALLED: u32 = 2;
/// A surface whose heaviest tile is this many times too heavy has more patience: separate boxes lose nothing for as long
/// as they are larger than the limit, and a viewer would rather wait for their scale than load them all.
const TOO_HEAVY: usize = 2;
const MOST_STALLED_HEAVY: u32 = 16;
/// Lighter roots are added at most this often.
pub const MOST_EXTRA_ROOTS: u32 = 3;

/// A simplified surface inside one cell.
#[derive(Debug, Clone, Default)]
pub struct TileMesh {
    /// Local metres.
    pub positions: Vec<DVec3>,
    /// Corners.
    pub faces: Vec<[u32; 3]>,
    /// Class of each face.
    pub labels: Vec<ClassId>,
}

/// Decides after each step of a level whether it is done.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    most: usize,
    before: usize,
    count: usize,
    stalled: u32,
}

impl Progress {
    /// A level that begins with `faces` faces and may have `most` in a tile.
    pub fn new(faces: usize, most: usize) -> Self {
        Self { most, before: faces, count: faces, stalled: 0 }
    }

    /// True when the level is done: `faces` are left, of them `heaviest` in the heaviest tile that needs content.
    pub fn is_done(&mut self, faces: usize, heaviest: usize) -> bool {
        let lost = self.count.saturating_sub(faces) as f64;
        self.stalled = if lost <= STALLED_SHARE * self.count as f64 { self.stalled + 1 } else { 0 };
        self.count = faces;
        let enough = faces as f64 <= self.before as f64 * (1.0 - LEAST_REDUCTION) && heaviest <= self.most;
        let patience = if heaviest > TOO_HEAVY * self.most { MOST_STALLED_HEAVY } else { MOST_STALLED };
        enough || self.stalled >= patience
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How many steps of `lost` faces each a level of 100 000 faces goes on for, one tile having a share of them.
    fn steps(lost: usize, share: usize) -> usize {
        let mut progress = Progress::new(100_000, 30_000);
        (1..).find(|&step| progress.is_done(100_000 - lost * step, (100_000 - lost * step) / share)).unwrap()
    }

    #[test]
    fn a_step_is_left_out_only_if_it_could_not_be_the_last() {
        let levels = LevelsConfig { step_ratio: 2.0, ..LevelsConfig::default() };
        assert!(levels.is_far(82_000, 30_000) && !levels.is_far(80_000, 30_000), "2.7 times");
        let levels = LevelsConfig { step_ratio: 4.0, ..levels };
        assert!(levels.is_far(220_000, 30_000) && !levels.is_far(218_000, 30_000), "2.7 times 2.7");
    }

    #[test]
    fn a_level_is_done_when_it_is_light_or_gets_no_lighter() {
        assert_eq!(steps(20_000, 1), 4, "30 000 are left in the heaviest");
        assert_eq!(steps(20_000, 4), 2, "light from the start, but not worth a level before");
        assert_eq!(steps(0, 2), 2, "no tile is very heavy, and nothing collapses");
        assert_eq!(steps(0, 1), 16, "too heavy to be shown");
        assert_eq!(steps(5_000, 1), 8, "down to twice what a tile may have, then no further");
    }
}
