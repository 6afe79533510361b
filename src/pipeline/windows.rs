//! Groups cells into windows that fit into memory.
//!
//! Windows depend on the cells' weights alone, never on the memory there is: the same bytes for every `--memory`.

use std::cmp::Reverse;

use glam::DVec2;

use super::ingest::{Leaf, gap};
use crate::collapse::window::cut_share;
use crate::tiles::CellTree;

/// Odd windows are cut along y up to this ratio of the sides.
const ODD_PREFERENCE: f64 = 1.5;

/// A cell with what it weighs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighed {
    pub cell: u32,
    pub weight: u64,
}

/// Windows of at most `most` weight, or of one cell; every cell is in one. A k-d tree over the cells' centres, cut at
/// another share of the weight if `odd`, and there rather along y: so that even of four cells no wall is always cut.
pub(super) fn split(tree: &CellTree, cells: Vec<Weighed>, most: u64, odd: bool) -> Vec<Vec<Weighed>> {
    let total: u64 = cells.iter().map(|c| c.weight).sum();
    if cells.is_empty() {
        return Vec::new();
    }
    if total <= most || cells.len() == 1 {
        let mut cells = cells;
        cells.sort_by_key(|c| c.cell);
        return vec![cells];
    }
    let at = |c: &Weighed| tree.cells[c.cell as usize].plan.center();
    let low = cells.iter().map(at).fold(DVec2::INFINITY, DVec2::min);
    let high = cells.iter().map(at).fold(DVec2::NEG_INFINITY, DVec2::max);
    let axis = usize::from((high.y - low.y) * if odd { ODD_PREFERENCE } else { 1.0 } > high.x - low.x);
    let share = cut_share(odd);
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
    let mut windows = split(tree, cells, most, odd);
    windows.extend(split(tree, upper, most, odd));
    windows
}

/// The leaves within `reach_m` of a window's, nearest first, as long as both together have at most `most` faces.
pub(super) fn halo(tree: &CellTree, leaves: &[Leaf], window: &[Weighed], reach_m: f64, most: u64) -> Vec<u32> {
    let plan = |cell: u32| &tree.cells[cell as usize].plan;
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

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::geo::Rect;
    use crate::mesh::Mesh;
    use crate::tiles::Census;

    /// A square of four leaves.
    fn four() -> CellTree {
        let mut census = Census::over(Rect { min: DVec2::ZERO, max: DVec2::splat(64.0) });
        let at = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let mut mesh = Mesh::default();
        for (x, y) in [(8.0, 8.0), (40.0, 8.0), (8.0, 40.0), (40.0, 40.0)] {
            let first = mesh.positions.len() as u32;
            mesh.positions.extend([at(x, y), at(x + 1.0, y), at(x, y + 1.0)]);
            mesh.faces.push([first, first + 1, first + 2]);
        }
        census.count(&mesh, |_| 1.0);
        CellTree::of(census, 1.0)
    }

    #[test]
    fn of_four_cells_every_wall_is_inside_a_window_in_one_of_two_steps() {
        let tree = four();
        let cells = || (1..5).map(|cell| Weighed { cell, weight: 10 }).collect();
        let windows = |odd| -> Vec<Vec<u32>> {
            split(&tree, cells(), 20, odd).iter().map(|w| w.iter().map(|c| c.cell).collect()).collect()
        };
        assert_eq!(windows(false), [[1, 2], [3, 4]]);
        assert_eq!(windows(true), [[1, 3], [2, 4]]);
        assert_eq!(split(&tree, cells(), 40, false).len(), 1);
        assert_eq!(split(&tree, cells(), 5, false).len(), 4, "a cell is never split");
    }
}
