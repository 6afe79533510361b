//! What simplification hands over, and a simplification by the level collapser to have something to hand over.

use glam::{DVec2, DVec3};

use super::MAX_CLASSES;
use crate::classes::Classes;
use crate::collapse::{CollapseConfig, Collapser, Fences};
use crate::geo::Rect;
use crate::ids::ClassId;
use crate::mesh::{GRID_PER_M, Mesh};

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
    pub labels: Vec<ClassId>,
    /// In order.
    pub events: Vec<Event>,
    /// Faces that an event folded onto others, so that they are gone though their corners differ: event, face; in order.
    pub folded: Vec<(u32, u32)>,
    /// Positions are multiples of this, metres.
    pub grid_m: f64,
}

/// How far to simplify.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    /// At most so many faces.
    Faces(usize),
    /// Every class within so many of its budgets.
    Scale(f64),
    /// Every class within so many metres.
    Error(f64),
}

/// A simplified mesh.
pub struct Simplified {
    /// Vertices.
    pub positions: Vec<DVec3>,
    /// Corners.
    pub faces: Vec<[u32; 3]>,
    /// Source face of each.
    pub face_ids: Vec<u32>,
    /// How it came about.
    pub sequence: Sequence,
}

/// Simplifies by doubling scales.
pub fn simplify(mesh: &Mesh, classes: &Classes, target: Target) -> Simplified {
    let group = vec![0; mesh.faces.len()];
    let boxes = [Rect { min: DVec2::splat(-1e12), max: DVec2::splat(1e12) }];
    let fences = Fences { group_of_face: &group, boxes: &boxes };
    let mut collapser = Collapser::new(mesh, &group, classes, &CollapseConfig::default());
    let budgets: Vec<f64> = classes.scheme.0.iter().map(|c| c.budget_m).collect();
    let (wanted, last) = match target {
        Target::Faces(n) => (n, 1e6),
        Target::Scale(t) => (0, t),
        Target::Error(m) => (0, m / budgets.iter().copied().fold(0.0, f64::max)),
    };
    let mut t = last.min(0.25);
    loop {
        collapser.step(t, &fences);
        if t >= last || collapser.face_count() <= wanted {
            break;
        }
        t = (2.0 * t).min(last);
    }
    let log = collapser.into_log();
    let mut events = Vec::with_capacity(log.events.len());
    let mut step = 0;
    for (i, e) in log.events.iter().enumerate() {
        while i >= log.steps[step].1 {
            step += 1;
        }
        let mut deviation_m = [0f32; MAX_CLASSES];
        for (d, b) in deviation_m.iter_mut().zip(&budgets) {
            *d = (f64::from(e.share) * log.steps[step].0 * b) as f32;
        }
        events.push(Event { kept: e.kept, gone: e.gone, position: e.position, energy: e.energy, deviation_m });
    }
    let (mut low, mut high) = (0, events.len());
    while low < high {
        let middle = (low + high) / 2;
        if log.replay(mesh, middle).1.len() <= wanted { high = middle } else { low = middle + 1 }
    }
    if wanted > 0 {
        events.truncate(low);
    }
    let (positions, living) = log.replay(mesh, events.len());
    let (face_ids, faces) = living.into_iter().unzip();
    let (labels, folded) = (classes.label.clone(), Vec::new());
    let grid_m = 1.0 / GRID_PER_M;
    let sequence =
        Sequence { positions: mesh.positions.clone(), faces: mesh.faces.clone(), labels, events, folded, grid_m };
    Simplified { positions, faces, face_ids, sequence }
}
