//! Obstacles: how far a tile's upper envelope sinks below the true top, and what is lost altogether.
//!
//! In: a tile and its reference. Out: an [`EnvelopeTile`]; an [`EnvelopeRow`] for each level and class.
//!
//! # Method
//! 1. the highest point of each surface over every cell of a plan grid (triangles are cut to cells: walls and thin
//!    poles count)
//! 2. sinking: the reference's top less the tile's highest top within one cell around, never below 0
//! 3. cells that are lower by more than the limit than the tile anywhere within the limit, joined where they touch: an
//!    obstacle lost. A wall that moved by less has eroded: its foot sinks by its height and nothing is lost
//! 4. lateral erosion: of cells that sink where they are, how far off the tile is high enough
//!
//! # Numbers
//! This is *tiling* error alone: what simplification did to the reference. The error of the survey comes on top. The
//! Annex 15 figures are vertical accuracies of obstacle data at 90 %, as a yardstick; meeting a number is not approval.
//!
//! # Limits
//! Cells grow where a tile has more than [`MOST_CELLS`] of them; the row says how large the largest were.

use std::collections::BTreeMap;

use glam::DVec3;
use serde::Serialize;

use super::cover::{ClassNames, Shown};
use crate::geo::Aabb;
use crate::ids::ClassId;
use crate::measure::Surface;

/// Side of a cell, metres.
pub const CELL_M: f64 = 0.25;
/// Cells of one tile at most.
pub const MOST_CELLS: usize = 16_000_000;
/// Lateral erosion is looked for this many cells away.
const MOST_RINGS: i64 = 20;
/// Heights are counted in steps of a centimetre.
const BIN_M: f64 = 0.01;
/// Of 100 m in all; what sinks by more counts as that.
const BINS: usize = 10_000;
/// Obstacles kept of each tile, the largest sinking first.
const MOST_LOST: usize = 20;

/// ICAO Annex 15, obstacle data: area, vertical accuracy at 90 %, horizontal accuracy at 90 %, metres.
pub const ANNEX_15_M: [(&str, f64, f64); 4] =
    [("area 1", 30.0, 50.0), ("area 2", 3.0, 5.0), ("area 3", 0.5, 0.5), ("area 4", 1.0, 2.5)];

/// Something that stood there and does not in the tile.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Lost {
    /// Its highest cell sinks by, metres.
    pub sink_m: f64,
    /// Its area on the plan, m².
    pub area_m2: f64,
    /// The top of its highest cell in the local frame.
    pub local_m: [f64; 3],
    /// The class there, by name.
    pub class: String,
}

/// One tile's envelope.
#[derive(Debug, Clone)]
pub struct EnvelopeTile {
    /// Index of the tile.
    pub tile: usize,
    /// Tiles with content above.
    pub level: u32,
    /// The largest first.
    pub lost: Vec<Lost>,
    /// How many were found.
    pub lost_count: usize,
    /// How far around an obstacle its height was looked for, metres.
    pub reach_m: f64,
}

/// What sinks of a class: counts, whatever the number of tiles.
#[derive(Debug, Clone, Default)]
struct Sinking {
    /// Of the largest cells.
    cell_m: f64,
    area_m2: f64,
    uncovered_m2: f64,
    /// Area by sinking.
    bins_m2: Vec<f64>,
    most_m: f64,
    /// How many cells have the height so many times [`CELL_M`] away.
    erosion: BTreeMap<u32, u64>,
    lost: u64,
}

impl Sinking {
    fn add(&mut self, other: &Self) {
        self.cell_m = self.cell_m.max(other.cell_m);
        self.area_m2 += other.area_m2;
        self.uncovered_m2 += other.uncovered_m2;
        self.bins_m2.resize(BINS, 0.0);
        self.bins_m2.iter_mut().zip(&other.bins_m2).for_each(|(sum, m2)| *sum += m2);
        self.most_m = self.most_m.max(other.most_m);
        other.erosion.iter().for_each(|(away, cells)| *self.erosion.entry(*away).or_default() += cells);
        self.lost += other.lost;
    }
}

/// What sinks of all tiles, by level and class.
#[derive(Debug, Clone, Default)]
pub struct Sinkings(BTreeMap<(u32, ClassId), Sinking>);

/// The tiles of a level, in all or of one class.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EnvelopeRow {
    /// Tiles with content above.
    pub level: u32,
    /// The class's name; `all`.
    pub class: String,
    /// Largest side of a cell, metres.
    pub cell_m: f64,
    /// Plan area looked at, m².
    pub area_m2: f64,
    /// Of it, without anything in the tile within a cell, m².
    pub uncovered_m2: f64,
    /// 90 % of the area sinks by less, metres.
    pub sink_le90_m: f64,
    /// 99.9 % of the area sinks by less, metres.
    pub sink_p999_m: f64,
    /// The most.
    pub sink_max_m: f64,
    /// Of what sinks by more than the limit where it is: 95 % have the height within this distance, metres.
    pub erosion_p95_m: f64,
    /// The most, as far as was looked.
    pub erosion_max_m: f64,
    /// Obstacles lost: joined cells that the tile is not as high as within the limit, less the limit.
    pub obstacles_lost: u64,
    /// Annex 15 areas whose vertical figure is not below `sink_le90_m`: a yardstick, not a finding of fitness.
    pub annex_15_vertical_figure_met: Vec<&'static str>,
}

/// A plan grid.
struct Grid {
    low: [f64; 2],
    size: [usize; 2],
    cell_m: f64,
}

impl Grid {
    fn over(aabb: Aabb) -> Self {
        let mut cell_m = CELL_M;
        loop {
            let size = aabb.plan().size();
            let count = |d: f64| (d / cell_m).floor().max(0.0) + 1.0;
            if count(size.x) * count(size.y) <= MOST_CELLS as f64 || !size.is_finite() {
                let size = [count(size.x), count(size.y)].map(|n| n.min(MOST_CELLS as f64) as usize);
                return Self { low: [aabb.min.x, aabb.min.y], size, cell_m };
            }
            cell_m *= 2.0;
        }
    }

    /// Raises `top` to the highest point of `surface` over each cell; `class` becomes that of the face it is on.
    fn raise(&self, surface: &Surface, top: &mut [f32], class: &mut [ClassId]) {
        let cell = |axis: usize, x: f64| {
            (((x - self.low[axis]) / self.cell_m).floor().max(0.0) as usize).min(self.size[axis] - 1)
        };
        let (mut row, mut piece) = (Vec::new(), Vec::new());
        for (f, face) in surface.faces.iter().enumerate() {
            let corners = face.map(|v| surface.positions[v as usize]);
            let of_face = surface.class.as_ref().and_then(|class| class.get(f)).copied().unwrap_or(ClassNames::UNKNOWN);
            let ends = |points: &[DVec3], axis: usize| {
                points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), p| (l.min(p[axis]), h.max(p[axis])))
            };
            let (low, high) = ends(&corners, 1);
            for j in cell(1, low)..=cell(1, high) {
                self.slice(&corners, 1, j, &mut row);
                if row.is_empty() {
                    continue;
                }
                let (low, high) = ends(&row, 0);
                for i in cell(0, low)..=cell(0, high) {
                    self.slice(&row, 0, i, &mut piece);
                    let z = piece.iter().map(|p| p.z).fold(f64::NEG_INFINITY, f64::max) as f32;
                    let at = j * self.size[0] + i;
                    if z > top[at] {
                        (top[at], class[at]) = (z, of_face);
                    }
                }
            }
        }
    }

    /// The part of a polygon between two grid lines.
    fn slice(&self, polygon: &[DVec3], axis: usize, index: usize, into: &mut Vec<DVec3>) {
        let low = self.low[axis] + index as f64 * self.cell_m;
        let mut half = Vec::with_capacity(8);
        cut(polygon, axis, low, 1.0, &mut half);
        into.clear();
        // The last cell keeps what rounding left beyond it.
        if index + 1 == self.size[axis] { into.extend(half) } else { cut(&half, axis, low + self.cell_m, -1.0, into) }
    }
}

fn cut(polygon: &[DVec3], axis: usize, limit: f64, sign: f64, into: &mut Vec<DVec3>) {
    for (i, p) in polygon.iter().enumerate() {
        let q = &polygon[(i + 1) % polygon.len()];
        let (of_p, of_q) = ((p[axis] - limit) * sign, (q[axis] - limit) * sign);
        if of_p >= 0.0 {
            into.push(*p);
        }
        if (of_p < 0.0) != (of_q < 0.0) {
            into.push(*p + (*q - *p) * (of_p / (of_p - of_q)));
        }
    }
}

/// The highest points of a reference over a plan grid.
pub struct Tops {
    grid: Grid,
    top: Vec<f32>,
    class: Vec<ClassId>,
}

impl Tops {
    /// Nothing yet, over the plan of `aabb`.
    pub fn over(aabb: Aabb) -> Self {
        let grid = Grid::over(aabb);
        let cells = grid.size[0] * grid.size[1];
        Self { grid, top: vec![f32::NEG_INFINITY; cells], class: vec![ClassNames::UNKNOWN; cells] }
    }

    /// Adds a part of the reference.
    pub fn add(&mut self, part: &Surface) {
        self.grid.raise(part, &mut self.top, &mut self.class);
    }
}

impl EnvelopeTile {
    /// Compares what stands out of a tile with what stands out of its reference; the heights go to `sums`.
    pub fn of(
        tile: usize,
        level: u32,
        shown: &Shown,
        reference: Tops,
        names: &ClassNames,
        safe_m: f64,
        sums: &mut Sinkings,
    ) -> Self {
        let Tops { grid, top, class } = reference;
        let mut own = vec![f32::NEG_INFINITY; top.len()];
        grid.raise(&shown.surface, &mut own, &mut vec![ClassNames::UNKNOWN; top.len()]);
        let [width, height] = grid.size;
        let around = |at: usize, ring: i64| {
            let (x, y) = ((at % width) as i64, (at / width) as i64);
            let rows = (y - ring).max(0)..=(y + ring).min(height as i64 - 1);
            let columns = (x - ring).max(0)..=(x + ring).min(width as i64 - 1);
            rows.flat_map(move |y| columns.clone().map(move |x| y as usize * width + x as usize))
        };
        let highest = |at: usize, ring: i64| around(at, ring).map(|i| own[i]).fold(f32::NEG_INFINITY, f32::max);
        let mut by_class = BTreeMap::<ClassId, Sinking>::new();
        let cell_m2 = grid.cell_m * grid.cell_m;
        let mut sunk = vec![0.0f32; top.len()];
        let reach = ((safe_m / grid.cell_m).ceil() as i64).clamp(1, MOST_RINGS);
        let class_of = |at: usize| class[at];
        for at in (0..top.len()).filter(|&at| top[at] > f32::NEG_INFINITY) {
            let of_class = by_class.entry(class_of(at)).or_default();
            of_class.bins_m2.resize(BINS, 0.0);
            of_class.cell_m = grid.cell_m;
            of_class.area_m2 += cell_m2;
            let near = highest(at, 1);
            if near == f32::NEG_INFINITY {
                of_class.uncovered_m2 += cell_m2;
                continue;
            }
            let sink_m = f64::from(top[at] - near).max(0.0);
            if sink_m > safe_m {
                sunk[at] = (top[at] - highest(at, reach)).max(0.0);
            }
            of_class.most_m = of_class.most_m.max(sink_m);
            of_class.bins_m2[((sink_m / BIN_M) as usize).min(BINS - 1)] += cell_m2;
            let enough = top[at] - safe_m as f32;
            if own[at] < enough {
                let ring = (1..=MOST_RINGS).find(|&ring| highest(at, ring) >= enough).unwrap_or(MOST_RINGS);
                let away = (ring as f64 * grid.cell_m / CELL_M).round() as u32;
                *of_class.erosion.entry(away).or_default() += 1;
            }
        }
        let mut lost = Vec::new();
        let mut open = Vec::new();
        for start in 0..sunk.len() {
            if f64::from(sunk[start]) <= safe_m {
                continue;
            }
            let (mut cells, mut worst, mut worst_m) = (0u64, start, 0.0f32);
            open.push((start, std::mem::take(&mut sunk[start])));
            while let Some((at, sink_m)) = open.pop() {
                cells += 1;
                if sink_m > worst_m {
                    (worst, worst_m) = (at, sink_m);
                }
                for next in around(at, 1) {
                    if f64::from(sunk[next]) > safe_m {
                        open.push((next, std::mem::take(&mut sunk[next])));
                    }
                }
            }
            let middle = |axis: usize, i: usize| grid.low[axis] + (i as f64 + 0.5) * grid.cell_m;
            by_class.entry(class_of(worst)).or_default().lost += 1;
            lost.push(Lost {
                sink_m: f64::from(worst_m),
                area_m2: cells as f64 * grid.cell_m * grid.cell_m,
                local_m: [middle(0, worst % width), middle(1, worst / width), f64::from(top[worst])],
                class: names.name(class_of(worst)).into(),
            });
        }
        lost.sort_by(|a, b| b.sink_m.total_cmp(&a.sink_m));
        let lost_count = lost.len();
        lost.truncate(MOST_LOST);
        let reach_m = reach as f64 * grid.cell_m;
        by_class.iter().for_each(|(class, sinking)| sums.0.entry((level, *class)).or_default().add(sinking));
        Self { tile, level, lost, lost_count, reach_m }
    }
}

/// One row for all and one for each class of each level.
pub fn rows(sums: &Sinkings, names: &ClassNames) -> Vec<EnvelopeRow> {
    let mut levels: Vec<u32> = sums.0.keys().map(|(level, _)| *level).collect();
    levels.dedup();
    let of_level = |level: u32| {
        let of_classes = || sums.0.iter().filter(move |((own, _), _)| *own == level);
        let mut all = Sinking::default();
        of_classes().for_each(|(_, sinking)| all.add(sinking));
        let first = row(level, "all".into(), &all);
        let rest = of_classes().map(move |((_, class), sinking)| row(level, names.name(*class).into(), sinking));
        std::iter::once(first).chain(rest).collect::<Vec<_>>()
    };
    levels.into_iter().flat_map(of_level).collect()
}

fn row(level: u32, class: String, of: &Sinking) -> EnvelopeRow {
    let covered_m2 = of.area_m2 - of.uncovered_m2;
    let quantile = |q: f64| {
        let mut below = 0.0;
        let bin = of.bins_m2.iter().position(|m2| {
            below += m2;
            below >= q * covered_m2
        });
        bin.map_or(0.0, |bin| ((bin + 1) as f64 * BIN_M).min(of.most_m))
    };
    let eroded: u64 = of.erosion.values().sum();
    let mut before = 0;
    let p95 = of.erosion.iter().find(|(_, cells)| {
        before += **cells;
        before as f64 > eroded as f64 * 0.95
    });
    let metres = |away: Option<&u32>| away.map_or(0.0, |away| f64::from(*away) * CELL_M);
    let sink_le90_m = quantile(0.9);
    EnvelopeRow {
        level,
        class,
        cell_m: of.cell_m,
        area_m2: of.area_m2,
        uncovered_m2: of.uncovered_m2,
        sink_le90_m,
        sink_p999_m: quantile(0.999),
        sink_max_m: of.most_m,
        erosion_p95_m: metres(p95.or(of.erosion.last_key_value()).map(|(away, _)| away)),
        erosion_max_m: metres(of.erosion.last_key_value().map(|(away, _)| away)),
        obstacles_lost: of.lost,
        annex_15_vertical_figure_met: ANNEX_15_M
            .iter()
            .filter(|(_, vertical_m, _)| sink_le90_m <= *vertical_m)
            .map(|(name, _, _)| *name)
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of 10 m at height 0; with a post of 0.1 m and `height` in its middle.
    fn square(height: Option<f64>) -> Shown {
        let at = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
        let mut surface = Surface {
            positions: vec![at(0.0, 0.0, 0.0), at(10.0, 0.0, 0.0), at(10.0, 10.0, 0.0), at(0.0, 10.0, 0.0)],
            faces: vec![[0, 1, 2], [0, 2, 3]],
            class: None,
        };
        if let Some(z) = height {
            surface.positions.extend([at(5.05, 5.05, 0.0), at(5.15, 5.05, 0.0), at(5.1, 5.1, z)]);
            surface.faces.push([4, 5, 6]);
        }
        let aabb = Aabb::of(surface.positions.iter().copied());
        Shown { surface, aabb, refused: None }
    }

    fn tops(reference: &Shown) -> Tops {
        let mut tops = Tops::over(reference.aabb);
        tops.add(&reference.surface);
        tops
    }

    /// A tile that stands for the square with the post.
    fn found(tile: &Shown, safe_m: f64) -> (EnvelopeTile, Sinkings) {
        let mut sums = Sinkings::default();
        let reference = tops(&square(Some(3.0)));
        let found = EnvelopeTile::of(0, 0, tile, reference, &ClassNames::default(), safe_m, &mut sums);
        (found, sums)
    }

    #[test]
    fn a_thin_post_that_is_gone_is_an_obstacle_lost() {
        let names = ClassNames::default();
        let of = |tile: &Shown, safe_m| found(tile, safe_m).0;
        let (found, sums) = found(&square(None), 1.0);
        assert_eq!(found.lost_count, 1);
        assert!((found.lost[0].sink_m - 3.0).abs() < 1e-6, "{:?}", found.lost);
        assert_eq!(of(&square(None), 3.5).lost_count, 0);
        assert_eq!(of(&square(Some(2.5)), 1.0).lost_count, 0);
        let rows = rows(&sums, &names);
        assert_eq!(rows.iter().map(|row| row.obstacles_lost).collect::<Vec<_>>(), [1, 1], "all, and its class");
        assert!(rows[0].sink_le90_m <= 0.01 && (rows[0].sink_max_m - 3.0).abs() < 1e-6, "{rows:?}");
        assert_eq!(rows[0].annex_15_vertical_figure_met.len(), 4, "90 % of the area is right: a yardstick only");
        assert!((rows[0].erosion_max_m - 5.0).abs() < 1e-6, "nowhere near is anything as high");
    }

    #[test]
    fn a_post_moved_by_a_cell_is_eroded_and_not_lost() {
        let mut moved = square(Some(3.0));
        moved.surface.positions[4..].iter_mut().for_each(|p| p.x += 0.25);
        let (found, sums) = found(&moved, 1.0);
        assert_eq!(found.lost_count, 0);
        let rows = rows(&sums, &ClassNames::default());
        assert!((rows[0].erosion_max_m - 0.25).abs() < 1e-6, "{rows:?}");
    }
}
