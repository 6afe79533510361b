//! How many levels a tree has and when one is coarse enough.
//!
//! # Method
//! 1. Leaves show the source itself.
//! 2. For each depth, deepest first, the surface collapses in steps with the walls of that depth kept, until no tile has
//!    more than [`LevelsConfig::tile_faces`] faces and the level has lost at least a third of the level below. The last
//!    step tells how fast faces fall with scale, and so how far the next must go. Of a town's five levels that takes 8
//!    steps; steps of 1.6 each took 11, half again as much time, and overshot.
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
    /// Scale of a step over that of the step before, at most. Default: 2.56.
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
            step_ratio: 2.56,
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
}

/// The first step's tolerance as a share of the median edge: below it almost nothing collapses.
pub const FIRST_TOLERANCE_EDGES: f64 = 1.0 / 16.0;
/// A level must lose at least this share of the faces of the level below: less is not worth a level.
pub const LEAST_REDUCTION: f64 = 0.3;
/// Faces fall 2.1–2.7 times for a doubling of scale, and 1.5 times near the source.
const USUAL_POWER: f64 = 1.15;
/// A step goes a little further than it seems it must, for another step costs more than what it spoils.
const AIM: f64 = 0.93;
const LEAST_RATIO: f64 = 1.15;
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

/// Decides after each step of a level whether it is done, and how far the next one goes.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    most: usize,
    /// Faces that are few enough for a level of its own.
    enough: f64,
    count: usize,
    heaviest: usize,
    stalled: u32,
    /// Faces fall by this power of the scale.
    power: f64,
}

impl Progress {
    /// A level that begins with `faces` faces, `heaviest` of them in the heaviest tile that needs content, which may have
    /// `most`.
    pub fn new(faces: usize, heaviest: usize, most: usize) -> Self {
        let enough = faces as f64 * (1.0 - LEAST_REDUCTION);
        Self { most, enough, count: faces, heaviest, stalled: 0, power: USUAL_POWER }
    }

    /// How many times too many faces there are.
    fn excess(&self) -> f64 {
        (self.count as f64 / self.enough).max(self.heaviest as f64 / self.most as f64)
    }

    /// Scale of the next step over that of the last, at most `largest`.
    pub fn ratio(&self, largest: f64) -> f64 {
        (self.excess() / AIM).powf(1.0 / self.power).max(LEAST_RATIO).min(largest)
    }

    /// Takes down what a step of `ratio` left; true when the level is done.
    pub fn is_done(&mut self, ratio: f64, faces: usize, heaviest: usize) -> bool {
        let lost = self.count.saturating_sub(faces) as f64;
        self.stalled = if lost <= STALLED_SHARE * self.count as f64 { self.stalled + 1 } else { 0 };
        let before = self.excess();
        (self.count, self.heaviest) = (faces, heaviest);
        if ratio > 1.0 {
            self.power = ((before / self.excess()).ln() / ratio.ln()).clamp(0.5 * USUAL_POWER, 2.0 * USUAL_POWER);
        }
        let patience = if heaviest > TOO_HEAVY * self.most { MOST_STALLED_HEAVY } else { MOST_STALLED };
        self.excess() <= 1.0 || self.stalled >= patience
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps of `lost` faces each until a level of 100 000 faces is done, one tile having a share of them.
    fn steps(lost: usize, share: usize) -> usize {
        let mut progress = Progress::new(100_000, 100_000 / share, 30_000);
        let left = |step| 100_000 - lost * step;
        (1..).find(|&step| progress.is_done(1.6, left(step), left(step) / share)).unwrap()
    }

    /// Steps, and faces left in the only tile, which may have 30 000, where 100 000 faces fall by a power of the scale.
    fn with_power(power: f64) -> (usize, usize) {
        let mut progress = Progress::new(100_000, 100_000, 30_000);
        let (mut scale, mut steps) = (1.0, 0);
        loop {
            let ratio = progress.ratio(2.56);
            scale *= ratio;
            steps += 1;
            let left = (100_000.0 * f64::powf(scale, -power)) as usize;
            if progress.is_done(ratio, left, left) {
                return (steps, left);
            }
        }
    }

    #[test]
    fn a_level_takes_few_steps_and_does_not_overshoot() {
        for (power, most_steps) in [(0.6, 3), (0.9, 2), (1.15, 2), (1.5, 1), (2.0, 1)] {
            let (steps, left) = with_power(power);
            assert!(steps <= most_steps && left <= 30_000, "{power}: {steps} steps to {left}");
            assert!(left >= 14_000, "{power}: {left} left");
        }
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
