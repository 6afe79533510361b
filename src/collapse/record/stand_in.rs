//! What simplification hands over.

use glam::DVec3;

use super::MAX_CLASSES;
use crate::ids::ClassId;

/// One collapse.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Event {
    /// Vertex that stays.
    pub kept: u32,
    /// Vertex that merges into it.
    pub gone: u32,
    /// Where `kept` is afterwards, on the grid.
    pub position: DVec3,
    /// Energy.
    pub energy: f32,
    /// Largest deviation, per class, of any tracked sample this collapse moved; 0 if none.
    pub deviation_m: [f32; MAX_CLASSES],
}

/// A source and its collapses.
#[derive(Debug, Clone)]
pub struct Sequence {
    /// On the grid.
    pub positions: Vec<DVec3>,
    /// Of the source.
    pub faces: Vec<[u32; 3]>,
    /// Of each face.
    pub class: Vec<ClassId>,
    /// In order.
    pub events: Vec<Event>,
    /// Positions are multiples of this, metres.
    pub grid_m: f64,
}
