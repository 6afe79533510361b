//! Where the faces of a city are, and the walls that part them best.
//!
//! In: meshes part by part. Out: [`Grown`], a tree of walls.
//!
//! # Method
//! A region that is too heavy is halved by a wall along x or y. Of the places that leave two to three fifths of the
//! weight on each side those count that make do with the fewest leaves, and of these the one that the fewest faces cross.
//!
//! # Why not …
//! Leaves of 40 000 faces have, on the average (thousands), and cutting makes so many more faces (%):
//! | | house in trees | lone building | campus | town |
//! |---|---|---|---|---|
//! | quarters at the middle, a quadtree | 16, 6.0 | 23, 4.1 | 15, 3.9 | 19, 3.8 |
//! | halves of equal weight | 24, 5.1 | 37, 2.9 | 37, 2.4 | 24, 3.4 |
//! | halves where the fewest cross | 27, 2.9 | 33, 2.1 | 24, 2.6 | 28, 3.1 |
//! | and of those with the fewest leaves | 31, 3.0 | 37, 2.3 | 37, 2.0 | 32, 2.8 |
//!
//! Three to seven tenths of the weight on a side instead of four to six: no better.

use std::cmp::Ordering;

use glam::DVec2;
use rayon::prelude::*;

use super::SNAP_M;
use crate::geo::Rect;
use crate::mesh::{GRID_PER_M, Mesh};

/// Walls may stand on any of so many lines of the square, along each axis.
const COLUMNS: f64 = 65536.0;
/// Above so many faces only every second is kept, and so on: 12 bytes each.
const MOST_ENTRIES: usize = 1 << 25;
/// A wall leaves at least this share of the weight on each side, if it can.
const LEAST_SHARE: f64 = 0.4;

/// Where in a square the faces are.
#[derive(Debug, Clone)]
pub struct Census {
    pub(super) square: Rect,
    entries: Vec<Entry>,
    /// Faces seen; of them every `1 << thinned`th is an entry.
    seen: usize,
    thinned: u32,
}

/// A face's box in columns of the square, and its weight.
#[derive(Debug, Clone, Copy)]
struct Entry {
    low: [u16; 2],
    high: [u16; 2],
    weight: f32,
}

impl Entry {
    fn center(&self, axis: usize) -> u16 {
        self.low[axis].midpoint(self.high[axis])
    }
}

/// Regions halved until they are light.
pub(super) enum Grown {
    Leaf,
    /// Below and above the line `column` of the square along `axis`.
    Cut {
        axis: usize,
        column: u16,
        sides: Box<[Grown; 2]>,
    },
}

impl Grown {
    /// Regions halved at an even number of halvings from this one, itself among them, and at an odd number.
    pub fn halved(&self) -> [usize; 2] {
        let Self::Cut { sides, .. } = self else { return [0, 0] };
        let [below, above] = [sides[0].halved(), sides[1].halved()];
        [1 + below[1] + above[1], below[0] + above[0]]
    }
}

impl Census {
    /// An empty one over a square that holds `bounds`.
    pub fn over(bounds: Rect) -> Self {
        // Lines are multiples of a power of two: f32 holds them exactly about any whole metre near by, so that a wall is
        // the same number in all files.
        let least = bounds.size().max_element() + 2.0 * SNAP_M;
        let unit = (least / 8.0).log2().floor().exp2().max(COLUMNS / GRID_PER_M);
        let low = ((bounds.min - SNAP_M) / unit).floor() * unit;
        let side = ((bounds.max + SNAP_M - low).max_element() / unit).ceil() * unit;
        Self { square: Rect { min: low, max: low + side }, entries: Vec::new(), seen: 0, thinned: 0 }
    }

    /// Counts the faces of a mesh.
    pub fn count(&mut self, mesh: &Mesh, weight: impl Fn(usize) -> f64 + Sync) {
        self.keep(mesh, weight, MOST_ENTRIES);
    }

    fn keep(&mut self, mesh: &Mesh, weight: impl Fn(usize) -> f64 + Sync, most: usize) {
        let per_m = COLUMNS / self.square.size().x;
        let column = |p: DVec2| ((p - self.square.min) * per_m).floor().clamp(DVec2::ZERO, DVec2::splat(COLUMNS - 1.0));
        let entry = |f: usize| {
            let corners = mesh.corners(f).map(|p| column(p.truncate()).as_u16vec2());
            let [a, b, c] = corners;
            Entry { low: a.min(b).min(c).to_array(), high: a.max(b).max(c).to_array(), weight: weight(f) as f32 }
        };
        // Which faces are kept depends on their order alone, not on how they come in parts.
        let step = 1usize << self.thinned;
        let first = self.seen.wrapping_neg() % step;
        self.seen += mesh.faces.len();
        self.entries.par_extend((first..mesh.faces.len().max(first)).into_par_iter().step_by(step).map(entry));
        while self.entries.len() > most {
            self.thinned += 1;
            self.entries = self.entries.iter().copied().step_by(2).collect();
        }
    }

    /// Halves the square until regions have at most `most` weight, or nothing that could be parted.
    pub(super) fn grow(&mut self, most: f64) -> Grown {
        grow(&mut self.entries, most / f64::from(1u32 << self.thinned))
    }

    /// Where a line of the square is, metres.
    pub(super) fn line_m(&self, axis: usize, column: u16) -> f64 {
        self.square.min[axis] + f64::from(column) * (self.square.size()[axis] / COLUMNS)
    }
}

fn grow(entries: &mut [Entry], most: f64) -> Grown {
    let total: f64 = entries.iter().map(|e| f64::from(e.weight)).sum();
    if total <= most {
        return Grown::Leaf;
    }
    let lines = (0..2).filter_map(|axis| best_line(entries, axis, total, most).map(|line| (axis, line)));
    let Some((axis, Line { column, .. })) = lines.min_by(|(_, a), (_, b)| a.cost(b)) else { return Grown::Leaf };
    entries.sort_unstable_by_key(|e| e.center(axis) >= column);
    let (below, above) = entries.split_at_mut(entries.partition_point(|e| e.center(axis) < column));
    let sides = rayon::join(|| grow(below, most), || grow(above, most));
    Grown::Cut { axis, column, sides: Box::new(sides.into()) }
}

/// A line that may part faces, and what speaks against it.
struct Line {
    column: u16,
    /// Leaves that its sides make at least; infinite where one is too light.
    leaves: f64,
    /// Faces that cross it.
    crossed: i64,
    /// Off an even share of the weight.
    off: f64,
}

impl Line {
    fn cost(&self, other: &Self) -> Ordering {
        let by_leaves = self.leaves.total_cmp(&other.leaves);
        by_leaves.then(self.crossed.cmp(&other.crossed)).then(self.off.total_cmp(&other.off))
    }
}

/// The best line across an axis; none where the centres of faces are all in one column.
fn best_line(entries: &[Entry], axis: usize, total: f64, most: f64) -> Option<Line> {
    let first = entries.iter().map(|e| e.center(axis)).min()?;
    let last = entries.iter().map(|e| e.center(axis)).max()?;
    let columns = usize::from(last - first) + 1;
    let (mut weights, mut changes) = (vec![0f64; columns], vec![0i64; columns]);
    for e in entries {
        weights[usize::from(e.center(axis) - first)] += f64::from(e.weight);
        // A line runs before its column: a face crosses those after its lowest column, up to its highest.
        let from = usize::from(e.low[axis].max(first) - first) + 1;
        let to = usize::from(e.high[axis].min(last) - first) + 1;
        if from < to {
            changes[from] += 1;
            if to < columns {
                changes[to] -= 1;
            }
        }
    }
    let (mut below, mut crossed) = (0.0, 0);
    let lines = (1..columns).map(|i| {
        below += weights[i - 1];
        crossed += changes[i];
        let off = (below / total - 0.5).abs();
        let leaves = (below / most).ceil() + ((total - below) / most).ceil();
        let leaves = if off <= 0.5 - LEAST_SHARE { leaves } else { f64::INFINITY };
        // Where no line leaves enough on both sides the most even one is taken.
        Line { column: first + i as u16, leaves, crossed: if leaves.is_finite() { crossed } else { 0 }, off }
    });
    lines.min_by(Line::cost)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// Small faces about some places.
    fn specks(places: impl IntoIterator<Item = (f64, f64)>) -> Mesh {
        let mut mesh = Mesh::default();
        for (x, y) in places {
            let first = mesh.positions.len() as u32;
            let corners = [(-0.1, -0.1), (0.1, -0.1), (0.0, 0.2)];
            mesh.positions.extend(corners.map(|(dx, dy)| DVec3::new(x + dx, y + dy, 0.0)));
            mesh.faces.push([first, first + 1, first + 2]);
        }
        mesh
    }

    fn census(mesh: &Mesh, most_entries: usize) -> Census {
        let mut census = Census::over(Rect { min: DVec2::ZERO, max: DVec2::splat(100.0) });
        census.keep(mesh, |_| 1.0, most_entries);
        census
    }

    /// Weights of the leaves.
    fn leaves(grown: &Grown, entries: &[Entry]) -> Vec<f64> {
        let Grown::Cut { axis, column, sides } = grown else {
            return vec![entries.iter().map(|e| f64::from(e.weight)).sum()];
        };
        let (below, above): (Vec<Entry>, Vec<Entry>) = entries.iter().partition(|e| e.center(*axis) < *column);
        [leaves(&sides[0], &below), leaves(&sides[1], &above)].concat()
    }

    fn scattered(n: usize) -> Mesh {
        specks((0..n).map(|i| ((i as f64 * 61.803).rem_euclid(100.0), (i as f64 * 17.77).rem_euclid(100.0))))
    }

    #[test]
    fn a_wall_stands_where_fewest_faces_cross_it() {
        // A dense row at the median of x, and an empty strip beside it.
        let row = (0..40).map(|i| (50.0, f64::from(i)));
        let field = (0..400).map(|i| (f64::from(i % 20) * 5.0, f64::from(i / 20) * 5.0));
        let mut census = census(&specks(row.chain(field)), 1000);
        let Grown::Cut { axis, column, .. } = census.grow(230.0) else { panic!("not cut") };
        let at_m = census.line_m(axis, column);
        let off = (0..20).map(|i| (at_m - f64::from(i) * 5.0).abs()).fold(f64::INFINITY, f64::min);
        assert!(off > 0.1, "the line at {at_m} m of axis {axis} crosses a row");
    }

    #[test]
    fn leaves_are_full_and_none_is_too_heavy() {
        let mut census = census(&scattered(10_000), 1 << 20);
        let grown = census.grow(300.0);
        let leaves = leaves(&grown, &census.entries);
        assert!(leaves.iter().all(|w| (120.0..=300.0).contains(w)), "{leaves:?}");
        assert!(leaves.len() <= 42, "{} leaves where 34 would do", leaves.len());
    }

    #[test]
    fn a_long_census_is_thinned_alike_however_it_comes() {
        let mesh = scattered(10_000);
        let whole = census(&mesh, 3000);
        let mut parts = census(&Mesh::default(), 3000);
        for faces in mesh.faces.chunks(701) {
            parts.keep(&Mesh { faces: faces.to_vec(), ..mesh.clone() }, |_| 1.0, 3000);
        }
        assert_eq!((whole.thinned, whole.entries.len()), (2, 2500));
        let places = |c: &Census| c.entries.iter().map(|e| (e.low, e.high)).collect::<Vec<_>>();
        assert!(places(&whole) == places(&parts) && whole.thinned == parts.thinned);
    }

    #[test]
    fn what_cannot_be_parted_is_a_leaf() {
        let mut census = census(&specks([(5.0, 5.0); 10]), 100);
        assert!(matches!(census.grow(3.0), Grown::Leaf));
        assert!(matches!(Census::over(census.square).grow(1.0), Grown::Leaf), "nothing at all");
    }
}
