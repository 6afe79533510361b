//! Takes away small parts of a surface that hang together with nothing else and can lose no more faces.
//!
//! In: the surface of a window after its collapse, or a whole mesh on its way. Out: the same without them; their samples
//! ride on what is beside them.
//!
//! No edge collapse ends a closed surface: its last four faces stay, however large the limit. Scans of trees are made of
//! thousands of such parts, and a root that keeps them all spends its faces on them: of a scan of 6.9 million triangles
//! 15 426 of 15 765, and the scale grew until the ground was 9.7 m off.
//!
//! # Method
//! 1. An island is a connected part of at most [`MOST_FACES`] faces, none of whose vertices the outside uses.
//! 2. It goes when every sample on it finds some other surface of its own cell within its limit, that of no island: so
//!    all are decided at once and in no order.
//! 3. Of those that are left in a window every other one goes if the rest is near: the crown of a tree is nothing but
//!    islands. Which ones changes from step to step.
//! 4. Of a mesh that is to have so many faces only those go that cost less than other faces ([`drop_cheap_islands`]).
//!
//! # Promises
//! Those of [`window`](super::window): a sample stays within t·b of its own cell's surface, and what neighbours share
//! goes from both or from none (`an_island_goes_when_all_its_samples_are_near_something_else`).

use std::collections::BTreeMap;

use glam::DVec3;
use rayon::prelude::*;

use super::NONE;
use super::block::{Block, Sample};
use super::window::Patch;
use crate::geo::bvh::Bvh;

/// Larger parts can still lose faces one by one; what stays of small ones has rarely more.
const MOST_FACES: u32 = 16;

/// Drops the islands of `surface` that the limit at `scale` allows to lose; `cell` is that of each face, and `locked`
/// tells which vertices must stay. Dead faces have `NONE` as first corner. Of islands among themselves every other one
/// may go, others if `odd`.
pub(super) fn drop_islands(surface: &mut Patch, cell: &[u32], locked: &[bool], scale: f64, odd: bool) {
    let part = parts(surface.positions.len(), &surface.faces);
    let all = islands(surface.positions.len(), &surface.faces, &part, locked);
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
    let Patch { positions, faces, samples, rides, .. } = surface;
    let rider = |s: usize| {
        let sample = &samples[s];
        // Those it stands for have to be within the limit too.
        let limit_m = scale * f64::from(sample.budget_m) - f64::from(sample.reach_m);
        (DVec3::from_array(sample.at), limit_m, rides[s])
    };
    let moves = homes((positions, faces), cell, is_island, samples.len(), rider);
    let mut stays = vec![false; positions.len()];
    let part_of = |f: usize| part[faces[f][0] as usize] as usize;
    for (s, _) in moves.iter().filter(|(_, home)| home.is_none()) {
        stays[part_of(rides[*s] as usize)] = true;
    }
    let goes: Vec<bool> = is_island.iter().enumerate().map(|(f, island)| *island && !stays[part_of(f)]).collect();
    for (s, home) in moves {
        if let (true, Some((face, squared_m2))) = (goes[rides[s] as usize], home) {
            (rides[s], samples[s].squared_m2) = (face, squared_m2);
        }
    }
    for (face, _) in faces.iter_mut().zip(goes).filter(|(_, goes)| *goes) {
        *face = [NONE; 3];
    }
}

/// Drops islands of a whole mesh at `scale`, down to `least` faces: those that add less weight · squared distance a face
/// than other collapses do, the cheapest first.
///
/// Σ weight · squared distance is about as n⁻² in the number n of faces, so that the next face costs 2/n of it.
pub(super) fn drop_cheap_islands(block: &mut Block, scale: f64, least: usize) {
    let Block { positions, faces, samples, .. } = block;
    let part = parts(positions.len(), faces);
    let is_island = islands(positions.len(), faces, &part, &[]);
    let rider = |s: usize| (samples[s].point, scale * f64::from(samples[s].budget_m), samples[s].face);
    let moves = homes((positions, faces), &vec![0; faces.len()], &is_island, samples.len(), rider);
    let mut living = faces.iter().filter(|face| face[0] != NONE).count();
    let total: f64 = samples.iter().map(|s| f64::from(s.weight) * f64::from(s.squared_m2)).sum();
    let most = 2.0 * total / (living as f64).max(1.0);
    // By part: its faces, and what they cost.
    let mut lost: BTreeMap<u32, (usize, f64)> = BTreeMap::new();
    let part_of = |f: usize| part[faces[f][0] as usize];
    for f in (0..faces.len()).filter(|&f| is_island[f]) {
        lost.entry(part_of(f)).or_default().0 += 1;
    }
    for &(s, home) in &moves {
        let Sample { weight, squared_m2, face, .. } = samples[s];
        let squared = home.map_or(f64::INFINITY, |(_, squared_m2)| f64::from(squared_m2));
        lost.entry(part_of(face as usize)).or_default().1 += f64::from(weight) * (squared - f64::from(squared_m2));
    }
    let cost = |(faces, cost): (usize, f64)| cost / faces as f64;
    let mut cheap: Vec<(u32, (usize, f64))> = lost.into_iter().filter(|(_, lost)| cost(*lost) <= most).collect();
    cheap.sort_by(|a, b| cost(a.1).total_cmp(&cost(b.1)).then(a.0.cmp(&b.0)));
    let mut goes = vec![false; positions.len()];
    for (part, (faces, _)) in cheap {
        if living < least + faces {
            break;
        }
        living -= faces;
        goes[part as usize] = true;
    }
    let goes: Vec<bool> = (0..faces.len()).map(|f| is_island[f] && goes[part_of(f) as usize]).collect();
    for (s, home) in moves {
        if let (true, Some(home)) = (goes[samples[s].face as usize], home) {
            (samples[s].face, samples[s].squared_m2) = home;
        }
    }
    for (face, _) in faces.iter_mut().zip(goes).filter(|(_, goes)| *goes) {
        *face = [NONE; 3];
    }
}

/// A face, and the squared distance to it, m².
type Home = (u32, f32);

/// By sample on an island the nearest other face of its cell, if one is within its limit. Of a sample, `rider` tells the
/// place, the limit in metres and the face it is on.
fn homes(
    surface: (&[DVec3], &[[u32; 3]]),
    cell: &[u32],
    is_island: &[bool],
    samples: usize,
    rider: impl Fn(usize) -> (DVec3, f64, u32) + Sync,
) -> Vec<(usize, Option<Home>)> {
    if !is_island.contains(&true) {
        return Vec::new();
    }
    let lands = Land::of_cells(surface, cell, is_island);
    let home = |s: usize| {
        let (at, limit_m, face) = rider(s);
        let home = || lands[cell[face as usize] as usize].nearest(at, limit_m);
        is_island[face as usize].then(|| (s, home()))
    };
    (0..samples).into_par_iter().filter_map(home).collect()
}

/// Which faces are on islands.
fn islands(vertices: usize, faces: &[[u32; 3]], part: &[u32], locked: &[bool]) -> Vec<bool> {
    let mut sizes = vec![0u32; vertices];
    for face in faces.iter().filter(|face| face[0] != NONE) {
        sizes[part[face[0] as usize] as usize] += 1;
    }
    for (&part, _) in part.iter().zip(locked).filter(|(_, locked)| **locked) {
        sizes[part as usize] = u32::MAX;
    }
    let is_small = |face: &[u32; 3]| face[0] != NONE && sizes[part[face[0] as usize] as usize] <= MOST_FACES;
    faces.iter().map(is_small).collect()
}

/// What is no island in a cell.
struct Land {
    faces: Vec<u32>,
    tree: Bvh,
}

impl Land {
    /// By cell; of cells without islands nothing.
    fn of_cells((positions, all): (&[DVec3], &[[u32; 3]]), cell: &[u32], is_island: &[bool]) -> Vec<Self> {
        let cells = cell.iter().max().map_or(0, |c| *c as usize + 1);
        let mut has_island = vec![false; cells];
        cell.iter().zip(is_island).filter(|(_, island)| **island).for_each(|(c, _)| has_island[*c as usize] = true);
        let mut faces: Vec<Vec<u32>> = vec![Vec::new(); cells];
        for (f, &c) in cell.iter().enumerate() {
            if has_island[c as usize] && !is_island[f] && all[f][0] != NONE {
                faces[c as usize].push(f as u32);
            }
        }
        let of_cell = |faces: Vec<u32>| {
            let corners: Vec<[u32; 3]> = faces.iter().map(|&f| all[f as usize]).collect();
            Self { tree: Bvh::new(positions, &corners), faces }
        };
        faces.into_par_iter().map(of_cell).collect()
    }

    fn nearest(&self, at: DVec3, limit_m: f64) -> Option<Home> {
        let hit = self.tree.closest(at, limit_m.max(0.0))?;
        Some((self.faces[hit.face as usize], (hit.distance * hit.distance) as f32))
    }
}

/// By vertex, the lowest vertex of what it hangs together with.
fn parts(vertices: usize, faces: &[[u32; 3]]) -> Vec<u32> {
    let mut lower: Vec<u32> = (0..vertices as u32).collect();
    fn root(lower: &mut [u32], mut v: u32) -> u32 {
        while lower[v as usize] != v {
            // Halves the path.
            lower[v as usize] = lower[lower[v as usize] as usize];
            v = lower[v as usize];
        }
        v
    }
    for &[a, b, c] in faces.iter().filter(|face| face[0] != NONE) {
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
