//! What a collapse did, in order.

use glam::DVec3;

use crate::ids::ClassId;
use crate::mesh::Mesh;

/// Most classes that events keep deviations of.
pub const MOST_CLASSES: usize = 8;

/// One collapse: `gone` merges into `kept`, which moves to `position`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Collapse {
    /// Vertex that stays.
    pub kept: u32,
    /// Vertex that merges into it.
    pub gone: u32,
    /// Where `kept` is afterwards, local metres.
    pub position: DVec3,
    /// Energy at which it was done, m² · m² per squared budget.
    pub energy: f32,
}

/// What a run did. Vertices and faces have the numbers of the mesh that it began with.
#[derive(Debug, Clone, Default)]
pub struct CollapseLog {
    /// In order; any prefix is a valid mesh.
    pub events: Vec<Collapse>,
    /// Per event, if they were asked for: the [level](super::record::level_of) of the largest deviation of a sample that
    /// it moved, by class. A sample counts for every class of the faces around it in the source.
    pub levels: Vec<[u8; MOST_CLASSES]>,
    /// The largest of these deviations of all events, by class, metres.
    pub most_m: [f32; MOST_CLASSES],
    /// Faces that an event folded onto others, so that they are gone though their corners differ: event, face. In order.
    pub folded: Vec<(u32, u32)>,
}

impl CollapseLog {
    /// The mesh after the first `events` collapses: positions by source vertex, and faces (source ids) that live.
    pub fn replay(&self, mesh: &Mesh, events: usize) -> (Vec<DVec3>, Vec<(u32, [u32; 3])>) {
        let mut positions = mesh.positions.clone();
        let mut into: Vec<u32> = (0..positions.len() as u32).collect();
        for event in &self.events[..events] {
            positions[event.kept as usize] = event.position;
            into[event.gone as usize] = event.kept;
        }
        // A vertex is gone before the one it merged into, so going backwards every target is already final.
        for event in self.events[..events].iter().rev() {
            into[event.gone as usize] = into[event.kept as usize];
        }
        let mut folded: Vec<u32> = self.folded.iter().filter(|(e, _)| (*e as usize) < events).map(|f| f.1).collect();
        folded.sort_unstable();
        let faces = mesh.faces.iter().enumerate().map(|(f, face)| (f as u32, face.map(|v| into[v as usize])));
        let lives = |(f, [a, b, c]): &(u32, [u32; 3])| a != b && b != c && c != a && folded.binary_search(f).is_err();
        (positions, faces.filter(lives).collect())
    }
}

/// A log with the mesh that it is about.
#[derive(Debug, Clone, Default)]
pub struct Sequence {
    /// Vertices of the source, on the grid, in Morton order.
    pub positions: Vec<DVec3>,
    /// Faces of the source.
    pub faces: Vec<[u32; 3]>,
    /// Class of each face.
    pub labels: Vec<ClassId>,
    /// Positions, those of events too, are multiples of this, metres.
    pub grid_m: f64,
    /// What was done.
    pub log: CollapseLog,
}
