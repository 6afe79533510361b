//! Takes away small parts of a surface that hang together with nothing else and can lose no more faces.
//!
//! In: the surface of a window after its collapse. Out: the same without them; their samples ride on what is beside them.
//!
//! No edge collapse ends a closed surface: its last four faces stay, however large the limit. Scans of trees are made of
//! thousands of such parts, and a root that keeps them all spends its faces on them: of a scan of 6.9 million triangles
//! 15 426 of 15 765, and the scale grew until the ground was 9.7 m off.
//!
//! # Method
//! 1. An island is a connected part of at most [`MOST_FACES`] faces, none of whose vertices the outside uses.
//! 2. It goes when every sample on it finds some other surface of its own cell within its limit, that of no island: so
//!    all are decided at once and in no order.
//! 3. Of those that are left every other one goes if the rest is near: the crown of a tree is nothing but islands. Which
//!    ones changes from step to step.
//!
//! # Promises
//! Those of [`window`](super::window): a sample stays within t·b of its own cell's surface, and what neighbours share
//! goes from both or from none (`an_island_goes_when_all_its_samples_are_near_something_else`).

use glam::DVec3;
use rayon::prelude::*;

use super::NONE;
use super::window::{Patch, Sample};
use crate::geo::bvh::Bvh;

/// Larger parts can still lose faces one by one; what stays of small ones has rarely more.
const MOST_FACES: u32 = 16;

/// Drops the islands of `surface` that the limit at `scale` allows to lose; `cell` is that of each face, and `locked`
/// tells which vertices must stay. Dead faces have `NONE` as first corner. Of islands among themselves every other one
/// may go, others if `odd`.
pub(super) fn drop_islands(surface: &mut Patch, cell: &[u32], locked: &[bool], scale: f64, odd: bool) {
    let part = parts(surface);
    let all = islands(surface, &part, locked);
    drop_some(surface, cell, &part, &all, scale);
    let mut count = usize::from(odd);
    let mut number = vec![None; surface.positions.len()];
    let mut is_next = |face: &[u32; 3]| {
        let number = number[part[face[0] as usize] as usize].get_or_insert_with(|| {
            count += 1;
            count
        });
        *number % 2 == 0
    };
    let faces = surface.faces.iter().zip(all);
    let half: Vec<bool> = faces.map(|(face, is_island)| is_island && face[0] != NONE && is_next(face)).collect();
    drop_some(surface, cell, &part, &half, scale);
}

/// Drops those parts of `is_island`'s faces whose samples are all near something that is none.
fn drop_some(surface: &mut Patch, cell: &[u32], part: &[u32], is_island: &[bool], scale: f64) {
    if !is_island.contains(&true) {
        return;
    }
    let lands = Land::of_cells(surface, cell, is_island);
    let riders: Vec<usize> = (0..surface.rides.len()).filter(|&s| is_island[surface.rides[s] as usize]).collect();
    let home = |&s: &usize| {
        let cell = cell[surface.rides[s] as usize] as usize;
        lands[cell].nearest(&surface.samples[s], scale)
    };
    let homes: Vec<Option<(u32, f32)>> = riders.par_iter().map(home).collect();
    let part_of = |f: usize| part[surface.faces[f][0] as usize] as usize;
    let mut stays = vec![false; surface.positions.len()];
    for (&s, _) in riders.iter().zip(&homes).filter(|(_, home)| home.is_none()) {
        stays[part_of(surface.rides[s] as usize)] = true;
    }
    let goes: Vec<bool> = is_island.iter().enumerate().map(|(f, island)| *island && !stays[part_of(f)]).collect();
    for (&s, home) in riders.iter().zip(homes) {
        if let (true, Some((face, squared_m2))) = (goes[surface.rides[s] as usize], home) {
            (surface.rides[s], surface.samples[s].squared_m2) = (face, squared_m2);
        }
    }
    for (face, _) in surface.faces.iter_mut().zip(goes).filter(|(_, goes)| *goes) {
        *face = [NONE; 3];
    }
}

/// Which faces are on islands.
fn islands(surface: &Patch, part: &[u32], locked: &[bool]) -> Vec<bool> {
    let mut faces = vec![0u32; surface.positions.len()];
    for face in surface.faces.iter().filter(|face| face[0] != NONE) {
        faces[part[face[0] as usize] as usize] += 1;
    }
    for (&part, _) in part.iter().zip(locked).filter(|(_, locked)| **locked) {
        faces[part as usize] = u32::MAX;
    }
    let is_small = |face: &[u32; 3]| face[0] != NONE && faces[part[face[0] as usize] as usize] <= MOST_FACES;
    surface.faces.iter().map(is_small).collect()
}

/// What is no island in a cell.
struct Land {
    faces: Vec<u32>,
    tree: Bvh,
}

impl Land {
    /// By cell; of cells without islands nothing.
    fn of_cells(surface: &Patch, cell: &[u32], is_island: &[bool]) -> Vec<Self> {
        let cells = cell.iter().max().map_or(0, |c| *c as usize + 1);
        let mut has_island = vec![false; cells];
        cell.iter().zip(is_island).filter(|(_, island)| **island).for_each(|(c, _)| has_island[*c as usize] = true);
        let mut faces: Vec<Vec<u32>> = vec![Vec::new(); cells];
        for (f, &c) in cell.iter().enumerate() {
            if has_island[c as usize] && !is_island[f] && surface.faces[f][0] != NONE {
                faces[c as usize].push(f as u32);
            }
        }
        let of_cell = |faces: Vec<u32>| {
            let corners: Vec<[u32; 3]> = faces.iter().map(|&f| surface.faces[f as usize]).collect();
            Self { tree: Bvh::new(&surface.positions, &corners), faces }
        };
        faces.into_par_iter().map(of_cell).collect()
    }

    /// The nearest face within the limit of a sample, and its squared distance, m².
    fn nearest(&self, sample: &Sample, scale: f64) -> Option<(u32, f32)> {
        // Those it stands for have to be within the limit too.
        let limit_m = scale * f64::from(sample.budget_m) - f64::from(sample.reach_m);
        let hit = self.tree.closest(DVec3::from_array(sample.at), limit_m.max(0.0))?;
        Some((self.faces[hit.face as usize], (hit.distance * hit.distance) as f32))
    }
}

/// By vertex, the lowest vertex of what it hangs together with.
fn parts(surface: &Patch) -> Vec<u32> {
    let mut lower: Vec<u32> = (0..surface.positions.len() as u32).collect();
    fn root(lower: &mut [u32], mut v: u32) -> u32 {
        while lower[v as usize] != v {
            // Halves the path.
            lower[v as usize] = lower[lower[v as usize] as usize];
            v = lower[v as usize];
        }
        v
    }
    for &[a, b, c] in surface.faces.iter().filter(|face| face[0] != NONE) {
        for w in [b, c] {
            let (a, w) = (root(&mut lower, a), root(&mut lower, w));
            lower[a.max(w) as usize] = a.min(w);
        }
    }
    // Lower ones have been settled.
    for v in 0..lower.len() {
        lower[v] = lower[lower[v] as usize];
    }
    lower
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::ClassId;

    const BUDGET_M: f64 = 0.1;

    /// The source `faces`, a class for all.
    fn patch(positions: Vec<DVec3>, faces: Vec<[u32; 3]>) -> Patch {
        let (labels, omega) = (vec![ClassId(0); faces.len()], vec![100.0; faces.len()]);
        Patch::of_source(positions, faces, labels, omega, &[BUDGET_M])
    }

    /// A square of 8 × 8 m on z = 0 from (x, 0) in 32 faces: too many for an island.
    fn ground(x: f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let positions = (0..25).map(|i| DVec3::new(x + 2.0 * f64::from(i % 5), 2.0 * f64::from(i / 5), 0.0)).collect();
        let square = |i: u32| {
            let a = i / 4 * 5 + i % 4;
            [[a, a + 1, a + 6], [a, a + 6, a + 5]]
        };
        (positions, (0..16).flat_map(square).collect())
    }

    /// The ground with tetrahedra at `floats`: 0.5 m wide, 0.25 m high.
    fn cell(floats: &[DVec3]) -> Patch {
        let (mut positions, mut faces) = ground(0.0);
        for at in floats {
            let first = positions.len() as u32;
            let corners = [[-0.25, -0.25, 0.0], [0.25, -0.25, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 0.25]];
            positions.extend(corners.map(|c| *at + DVec3::from_array(c)));
            faces.extend([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]].map(|f| f.map(|v: u32| v + first)));
        }
        patch(positions, faces)
    }

    fn living(patch: &Patch) -> Vec<usize> {
        (0..patch.faces.len()).filter(|&f| patch.faces[f][0] != NONE).collect()
    }

    #[test]
    fn an_island_goes_when_all_its_samples_are_near_something_else() {
        let floats = [DVec3::new(4.0, 3.5, 0.25), DVec3::new(4.0, 3.5, 3.0)];
        // Their tips are 5 and 32.5 budgets up.
        for (scale, faces) in [(4.9, 40), (5.1, 36), (32.4, 36), (32.6, 32)] {
            let mut patch = cell(&floats);
            let vertices = patch.positions.len();
            drop_islands(&mut patch, &[0; 40], &vec![false; vertices], scale, false);
            assert_eq!(living(&patch).len(), faces, "at {scale}");
            for (sample, &ride) in patch.samples.iter().zip(&patch.rides) {
                let tree = Bvh::new(&patch.positions, &[patch.faces[ride as usize]]);
                let hit = tree.closest(DVec3::from_array(sample.at), scale * BUDGET_M).unwrap();
                assert!((hit.distance.powi(2) - f64::from(sample.squared_m2)).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn what_a_sample_stands_for_is_within_the_limit_too() {
        let mut patch = cell(&[DVec3::new(4.0, 3.5, 0.25)]);
        patch.samples.last_mut().unwrap().reach_m = 0.3;
        drop_islands(&mut patch, &[0; 36], &[false; 29], 7.9, false);
        assert_eq!(living(&patch).len(), 36);
        drop_islands(&mut patch, &[0; 36], &[false; 29], 8.1, false);
        assert_eq!(living(&patch).len(), 32);
    }

    #[test]
    fn of_islands_far_from_everything_else_every_other_one_goes() {
        let row: Vec<DVec3> = (0..6).map(|i| DVec3::new(2.0 + 0.6 * f64::from(i), 4.0, 5.0)).collect();
        let mut patch = cell(&row);
        drop_islands(&mut patch, &[0; 56], &[false; 49], 20.0, false);
        assert_eq!(living(&patch)[32..], [32, 33, 34, 35, 40, 41, 42, 43, 48, 49, 50, 51]);
        drop_islands(&mut patch, &[0; 56], &[false; 49], 20.0, true);
        assert_eq!(living(&patch)[32..], [40, 41, 42, 43]);
        drop_islands(&mut patch, &[0; 56], &[false; 49], 20.0, true);
        assert_eq!(living(&patch).len(), 36, "one has no other beside it");
    }

    #[test]
    fn an_island_that_the_outside_uses_stays() {
        let mut patch = cell(&[DVec3::new(4.0, 4.0, 0.25)]);
        let mut locked = vec![false; 29];
        locked[27] = true;
        drop_islands(&mut patch, &[0; 36], &locked, 20.0, false);
        assert_eq!(living(&patch).len(), 36);
    }

    #[test]
    fn what_two_cells_share_goes_from_both_or_from_none() {
        // One half of a double pyramid in each cell, its waist on the wall between them.
        let half = |x: f64, tip: f64, drop: f64| {
            let (mut positions, mut faces) = ground(x);
            positions.iter_mut().for_each(|p| p.z -= drop);
            let waist = [[8.0, 3.75, 0.25], [8.0, 4.25, 0.25], [8.0, 4.0, 0.5]].map(DVec3::from_array);
            positions.extend(waist);
            positions.push(DVec3::new(tip, 4.0, 0.3));
            faces.extend([[25, 26, 28], [26, 27, 28], [27, 25, 28]]);
            patch(positions, faces)
        };
        let cells: Vec<u32> = (0..70).map(|f| f / 35).collect();
        for (scale, drop, faces) in [(4.9, 0.0, 70), (5.1, 0.0, 64), (5.1, 5.0, 70)] {
            let mut both = Patch::joined(vec![half(0.0, 7.7, 0.0), half(8.0, 8.3, drop)]);
            let vertices = both.positions.len();
            drop_islands(&mut both, &cells, &vec![false; vertices], scale, false);
            assert_eq!(living(&both).len(), faces, "at {scale}, the ground {drop} m lower on one side");
        }
    }
}
