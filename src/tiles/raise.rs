//! Raises simplified tiles where they are lower than a roof or a façade of the source.
//!
//! In: [`TileTree`], the partition, classes. Out: the same tree, vertices moved straight up, none down.
//!
//! # Method
//! 1. Every source face of a kept class is held against the tile triangle that is least below it; where it is more than
//!    the class's budget at scale 1 below, all three vertices of that triangle rise by the rest.
//! 2. Vertices at one place in tiles of one step rise alike, by the most that any of the tiles asks: borders stay shared.
//! 3. Again, up to [`ROUNDS`] times, as what has risen may now be nearest to something else.
//!
//! # Promises
//! A vertex moves up only, so it stays on its wall (`a_flattened_roof_rises_to_its_ridge`). That nothing sinks deeper is
//! not asserted here: `signed` certifies each tile afterwards, and the build warns where it cannot.
//!
//! # Limits
//! A triangle rises as a whole: a lost chimney lifts the roof around it. Clutter (trees, masts, cranes) is not kept.

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;

use super::error::{Corner, Surface, closest};
use super::levels::{Tile, TileMesh, TileTree};
use super::partition::Partition;
use super::signed::quarter;
use crate::classes::Classes;
use crate::geo::bvh::{Bvh, closest_on_triangle};
use crate::ids::ClassId;

/// What is kept.
const KEPT: [ClassId; 2] = [ClassId::FACADE, ClassId::ROOF];
/// So much of the budget is used: the certificate has a tolerance of its own.
const USED_SHARE: f64 = 0.85;
const ROUNDS: usize = 5;
/// Rises below this are not worth a round, metres.
const LEAST_M: f64 = 1e-3;
/// Source faces are quartered at most this often.
const DEEPEST: u32 = 4;

/// Raises all simplified tiles.
pub fn keep_tops(tree: &mut TileTree, partition: &Partition, classes: &Classes) {
    let mut limits_m = vec![f64::INFINITY; classes.scheme.len()];
    for class in KEPT {
        limits_m[class.index()] = classes.scheme[class].budget_m * USED_SHARE;
    }
    for _ in 0..ROUNDS {
        let rises: Vec<Vec<f64>> =
            tree.tiles.par_iter().map(|tile| rises_of(tile, partition, classes, &limits_m)).collect();
        let most_m = rises.iter().flatten().copied().fold(0.0, f64::max);
        if most_m < LEAST_M {
            return;
        }
        apply(tree, &rises);
    }
}

fn rises_of(tile: &Tile, partition: &Partition, classes: &Classes, limits_m: &[f64]) -> Vec<f64> {
    let Some(mesh) = &tile.mesh else { return Vec::new() };
    let faces = tile.source.iter().flat_map(|r| r.clone());
    let source = faces.map(|f| (partition.mesh.corners(f), limits_m[classes.label[f].index()]));
    rises(mesh, source.filter(|(_, limit_m)| limit_m.is_finite()))
}

/// How far each vertex has to rise for the given triangles, each with the depth it may sink to.
fn rises(mesh: &TileMesh, source: impl Iterator<Item = ([DVec3; 3], f64)>) -> Vec<f64> {
    let tree = Bvh::new(&mesh.positions, &mesh.faces);
    let to = Surface { positions: &mesh.positions, faces: &mesh.faces, labels: &mesh.labels };
    let mut rises = vec![0.0f64; mesh.positions.len()];
    let mut stack = Vec::new();
    let mut near = None;
    for (triangle, limit_m) in source {
        let corners = triangle.map(|at| Corner { at, hit: closest(at, near, to, &tree) });
        if corners[0].hit.face == u32::MAX {
            continue;
        }
        near = Some(corners[0].hit.face);
        stack.push((corners, 0));
        while let Some((corners, depth)) = stack.pop() {
            let (below_m, face) = least_below(&corners, to);
            if below_m <= limit_m {
                continue;
            }
            let one = corners.iter().all(|c| c.hit.face == face);
            if !one && depth < DEEPEST {
                quarter(&corners, to, &tree).into_iter().for_each(|part| stack.push((part, depth + 1)));
                continue;
            }
            for v in mesh.faces[face as usize] {
                let rise = &mut rises[v as usize];
                *rise = rise.max(below_m - limit_m);
            }
        }
    }
    rises
}

/// How much lower than all of the face one tile triangle is, and which; of those nearest to its corners the best.
fn least_below(corners: &[Corner; 3], to: Surface) -> (f64, u32) {
    let below = |face: u32| {
        let triangle = to.faces[face as usize].map(|v| to.positions[v as usize]);
        let at = |c: &Corner| if c.hit.face == face { c.hit.point } else { closest_on_triangle(c.at, &triangle) };
        corners.iter().map(|c| c.at.z - at(c).z).fold(f64::NEG_INFINITY, f64::max)
    };
    let each = corners.map(|c| (below(c.hit.face), c.hit.face));
    each.into_iter().fold((f64::INFINITY, 0), |best, one| if one.0 < best.0 { one } else { best })
}

fn apply(tree: &mut TileTree, rises: &[Vec<f64>]) {
    // Tiles cut in one step have one scale.
    let key = |scale: f64, p: DVec3| (scale.to_bits(), p.to_array().map(f64::to_bits));
    let mut most: HashMap<_, f64> = HashMap::new();
    for (tile, rises) in tree.tiles.iter().zip(rises) {
        let Some(mesh) = &tile.mesh else { continue };
        for (p, &rise) in mesh.positions.iter().zip(rises).filter(|(_, rise)| **rise > 0.0) {
            let known = most.entry(key(tile.scale, *p)).or_default();
            *known = known.max(rise);
        }
    }
    for tile in &mut tree.tiles {
        let Some(mesh) = &mut tile.mesh else { continue };
        for p in &mut mesh.positions {
            if let Some(rise) = most.get(&key(tile.scale, *p)) {
                p.z += rise;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flattened_roof_rises_to_its_ridge() {
        let p = DVec3::new;
        let mesh = TileMesh {
            positions: vec![p(0.0, 0.0, 5.0), p(4.0, 0.0, 5.0), p(4.0, 4.0, 5.0), p(0.0, 4.0, 5.0)],
            faces: vec![[0, 1, 2], [0, 2, 3]],
            labels: vec![ClassId::ROOF; 2],
        };
        let ridge = [[p(0.0, 0.0, 5.0), p(4.0, 0.0, 5.0), p(2.0, 2.0, 6.0)]];
        let rises = rises(&mesh, ridge.into_iter().map(|t| (t, 0.25)));
        assert!(rises.iter().all(|r| *r >= 0.0));
        let raised: Vec<DVec3> = mesh.positions.iter().zip(&rises).map(|(p, r)| *p + DVec3::Z * *r).collect();
        // Straight below the ridge, on the diagonal.
        let height = (raised[0].z + raised[2].z) / 2.0;
        assert!((6.0 - height) <= 0.25 + 1e-9, "{height}");
        assert!(raised.iter().all(|p| p.z <= 6.0), "no higher than it has to be");
    }

    #[test]
    fn what_is_within_its_budget_stays() {
        let p = DVec3::new;
        let mesh = TileMesh {
            positions: vec![p(0.0, 0.0, 5.0), p(4.0, 0.0, 5.0), p(4.0, 4.0, 5.0)],
            faces: vec![[0, 1, 2]],
            labels: vec![ClassId::ROOF],
        };
        let source = [[p(1.0, 0.5, 5.2), p(2.0, 0.5, 5.2), p(2.0, 1.0, 5.2)]];
        assert_eq!(rises(&mesh, source.into_iter().map(|t| (t, 0.25))), [0.0; 3]);
    }
}
