//! What a collapse did, in order.

use glam::{DVec3, IVec3};

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

/// The events of a run while it runs, in 24 bytes each: of the move of a vertex only its length, in grid steps.
pub(super) struct Moves {
    steps: Vec<Step>,
    /// Where those go that moved too far for that, in order.
    far: Vec<DVec3>,
    grid_m: f64,
}

struct Step {
    kept: u32,
    gone: u32,
    energy: f32,
    by: [i32; 3],
}

/// Stands for a place in `far`.
const FAR: [i32; 3] = [i32::MIN; 3];

impl Moves {
    /// None yet, with room for `most`.
    pub fn new(most: usize, grid_m: f64) -> Self {
        Self { steps: Vec::with_capacity(most), far: Vec::new(), grid_m }
    }

    /// An event that takes its vertex from one place to another, both on the grid.
    pub fn push(&mut self, kept: u32, gone: u32, from: DVec3, to: DVec3, energy: f32) {
        let by = ((to - from) / self.grid_m).as_ivec3();
        let fits = from + by.as_dvec3() * self.grid_m == to && by.to_array() != FAR;
        if !fits {
            self.far.push(to);
        }
        self.steps.push(Step { kept, gone, energy, by: if fits { by.to_array() } else { FAR } });
    }

    /// The events; `at` is where the vertices were before the first, about `origin`.
    pub fn events(self, mut at: Vec<DVec3>, origin: DVec3) -> Vec<Collapse> {
        let Self { steps, far, grid_m } = self;
        let mut far = far.into_iter();
        let event = |Step { kept, gone, energy, by }| {
            let step = IVec3::from_array(by).as_dvec3() * grid_m;
            let place = &mut at[kept as usize];
            *place = if by == FAR { far.next().unwrap_or(*place) } else { *place + step };
            Collapse { kept, gone, position: origin + *place, energy }
        };
        steps.into_iter().map(event).collect()
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moves_are_events_again_however_far_they_went() {
        let grid_m = 0.25;
        let start = vec![DVec3::ZERO, DVec3::new(1.0, -2.0, 0.25)];
        let places = [DVec3::new(0.5, 0.0, -0.25), DVec3::new(1e12, 0.25, 0.0), DVec3::new(0.75, 3.0, 1e9)];
        let mut moves = Moves::new(0, grid_m);
        let mut from = start[1];
        for (to, i) in places.into_iter().zip(2..) {
            moves.push(1, i, from, to, i as f32);
            from = to;
        }
        let origin = DVec3::new(8.0, 0.0, 0.5);
        let events = moves.events(start, origin);
        assert_eq!(events.iter().map(|e| e.position - origin).collect::<Vec<_>>(), places);
        assert_eq!(
            events.iter().map(|e| (e.kept, e.gone, e.energy)).collect::<Vec<_>>(),
            [(1, 2, 2.0), (1, 3, 3.0), (1, 4, 4.0)]
        );
    }
}
