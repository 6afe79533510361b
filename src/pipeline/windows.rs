//! Groups cells into windows that fit into memory.
//!
//! Windows depend on the cells' weights alone, never on the memory there is: the same bytes for every `--memory`.

use std::cmp::Reverse;

use glam::DVec2;

use super::ingest::{Leaf, gap};
use crate::tiles::Quadtree;

/// A cell with what it weighs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighed {
    pub cell: u32,
    pub weight: u64,
}

/// Windows of at most `most` weight, or of one cell; every cell is in one. A k-d tree over the cells' centres, cut at
/// `share` of the weight.
pub(super) fn split(tree: &Quadtree, cells: Vec<Weighed>, most: u64, share: f64) -> Vec<Vec<Weighed>> {
    let total: u64 = cells.iter().map(|c| c.weight).sum();
    if cells.is_empty() {
        return Vec::new();
    }
    if total <= most || cells.len() == 1 {
        let mut cells = cells;
        cells.sort_by_key(|c| c.cell);
        return vec![cells];
    }
    let at = |c: &Weighed| tree.0[c.cell as usize].plan.center();
    let low = cells.iter().map(at).fold(DVec2::INFINITY, DVec2::min);
    let high = cells.iter().map(at).fold(DVec2::NEG_INFINITY, DVec2::max);
    let axis = usize::from(high.y - low.y > high.x - low.x);
    let mut cells = cells;
    cells.sort_by(|a, b| at(a)[axis].total_cmp(&at(b)[axis]).then(a.cell.cmp(&b.cell)));
    let (mut sum, mut middle) = (0, 1);
    for (i, cell) in cells.iter().enumerate() {
        sum += cell.weight;
        if sum as f64 >= share * total as f64 {
            middle = (i + 1).clamp(1, cells.len() - 1);
            break;
        }
    }
    let upper = cells.split_off(middle);
    let mut windows = split(tree, cells, most, share);
    windows.extend(split(tree, upper, most, share));
    windows
}

/// The leaves within `reach_m` of a window's, nearest first, as long as both together have at most `most` faces.
pub(super) fn halo(tree: &Quadtree, leaves: &[Leaf], window: &[Weighed], reach_m: f64, most: u64) -> Vec<u32> {
    let plan = |cell: u32| &tree.0[cell as usize].plan;
    let is_own = |cell: u32| window.iter().any(|w| w.cell == cell);
    let distance = |cell: u32| window.iter().map(|w| gap(plan(w.cell), plan(cell))).fold(f64::INFINITY, f64::min);
    let mut around: Vec<(f64, Reverse<usize>, u32)> = leaves
        .iter()
        .filter(|l| !is_own(l.cell))
        .map(|l| (distance(l.cell), Reverse(l.faces), l.cell))
        .filter(|(d, ..)| *d <= reach_m)
        .collect();
    around.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.2.cmp(&b.2)));
    let mut left = most.saturating_sub(window.iter().map(|w| w.weight).sum());
    let mut taken = Vec::new();
    for (_, Reverse(faces), cell) in around {
        if faces as u64 > left {
            break;
        }
        left -= faces as u64;
        taken.push(cell);
    }
    taken
}
