//! One block of a mesh, collapsed by one thread in order of energy.
//!
//! A block is a compact copy of some faces. Vertices that faces outside it use are locked, so blocks never see each
//! other and their order of execution cannot matter. A small mesh is one block with nothing locked.
//!
//! [`run`](super::run) does it.

use glam::DVec3;

use super::log::Moves;
use super::run::Run;
use super::{Collapse, MOST_CLASSES};
use crate::geo::Rect;

/// A vertex that must not move: faces outside the block use it, or two walls cross in it.
pub const LOCKED: u8 = 1;
/// A vertex on a wall x = constant: its x must not change.
pub const FIX_X: u8 = 2;
/// A vertex on a wall y = constant.
pub const FIX_Y: u8 = 4;
/// A vertex on an open border of the surface.
pub const BORDER: u8 = 8;

/// What an energy is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Energy {
    /// Planes of the current faces (Lindstrom & Turk 1998), weighted by area: the most accurate.
    Memoryless,
    /// Sums of the source's planes (Garland & Heckbert 1997), weighted by area: the baseline.
    Accumulated,
    /// Volume between the current and the new surface (Lindstrom & Turk 1998, as printed).
    Volume,
    /// As `Accumulated`, multiplied by the class's factor and raised across creases (the paper's §2.3).
    Paper,
}

/// How far samples may be from the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Limit {
    /// Samples are not followed.
    Untracked,
    /// t times their budget.
    Scale(f64),
    /// t times their budget, where t grows with the root mean square of all samples' deviations, from `first` on; the
    /// collapse ends before t passes `last`.
    Growing {
        /// Least t.
        first: f64,
        /// The end.
        last: f64,
    },
}

/// How a block collapses.
#[derive(Debug, Clone, Copy)]
pub struct Rules {
    /// Order and placement.
    pub energy: Energy,
    /// True: a collapse keeps one of its ends where it is.
    pub half_edge: bool,
    /// What samples allow.
    pub limit: Limit,
    /// Open borders nearer than this may join across the gap, metres; 0: never.
    pub gap_reach_m: f64,
    /// Tunnels with a loop shorter than this close, at the price of a non-manifold edge, metres; 0: never.
    pub loop_reach_m: f64,
    /// Positions are multiples of this, metres, a power of two.
    pub grid_m: f64,
    /// Ends when no more faces are left.
    pub stop_faces: usize,
    /// Keep every event with its deviations.
    pub recorded: bool,
}

/// What a block is made of. All indices are local to the block; positions are relative to `origin`.
pub struct Block<'a> {
    /// Local positions are relative to this point.
    pub origin: DVec3,
    /// Per vertex: global id. Empty: its own.
    pub vertex_ids: Vec<u32>,
    /// Per vertex.
    pub positions: Vec<DVec3>,
    /// Per vertex: `LOCKED`, `FIX_X`, `FIX_Y`, `BORDER`.
    pub flags: Vec<u8>,
    /// Per face: corners.
    pub faces: Vec<[u32; 3]>,
    /// Per face: Σ P(c|f)/b_c², 1/m². Empty: 1.
    pub omega: Vec<f32>,
    /// Per face: weight of its class under `Energy::Paper`, empty otherwise.
    pub paper_weight: Vec<f32>,
    /// Per face: index into `boxes`. Empty: one group without walls.
    pub group: Vec<u32>,
    /// Where the faces of a group must stay, in plan.
    pub boxes: &'a [Rect],
    /// Per tracked sample.
    pub samples: Vec<Sample>,
    /// Per sample: the classes of the faces around it in the source, a bit each; the last bit stands for all later ones.
    /// Empty where nothing is recorded.
    pub sample_classes: Vec<u8>,
    /// See there.
    pub rules: Rules,
}

/// A point of the source that the surface must stay near, in 40 bytes.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Relative to the block's origin.
    pub point: DVec3,
    /// Share of the source's area · Σ P(c|f)/b_c².
    pub weight: f32,
    /// Metres at scale 1.
    pub budget_m: f32,
    /// Squared distance to the surface, m².
    pub squared_m2: f32,
    /// The face it rides on.
    pub face: u32,
}

/// What a collapse leaves.
pub struct Collapsed<'a> {
    /// Faces that died have `NONE` as first corner; positions of vertices that died are stale.
    pub block: Block<'a>,
    /// What was done, in order, where the limit is a scale: there a block is a part of a mesh.
    pub log: Vec<Collapse>,
    /// What was done, if it was to be recorded.
    pub(super) moves: Moves,
    /// Faces that died because they folded onto others: index of the collapse, face.
    pub folded: Vec<(u32, u32)>,
    /// Per collapse, if recorded: see [`CollapseLog`](super::CollapseLog).
    pub levels: Vec<[u8; MOST_CLASSES]>,
    /// Of all collapses: see [`CollapseLog`](super::CollapseLog).
    pub most_m: [f32; MOST_CLASSES],
    /// Scale reached.
    pub scale: f64,
}

impl<'a> Block<'a> {
    /// Collapses until the rules end it or no admissible edge is left.
    pub fn collapse(self) -> Collapsed<'a> {
        Run::new(self).collapse()
    }
}
