//! Seams between tiles: border edges that do not meet their neighbour's, and how wide the gaps are.
//!
//! In: the [`Border`] of every tile, taken while it is loaded. Out: a [`SeamRow`] for each level and pair of levels.
//!
//! # Method
//! 1. an edge that one face only uses is border; vertices are joined where they are equal to the last bit
//! 2. two tiles are neighbours if the boxes of their triangles touch; their seam is where these overlap
//! 3. each border vertex in the seam (or between two that are) to the nearest border edge of the neighbour: the gap;
//!    a vertex that meets one neighbour is not held against another that is drawn beside it, and where the neighbour's
//!    border is met by this tile's all the same, it is the surface that is open and nothing was torn
//! 4. a vertex that only touches the seam, or stands off it, is held against the finest surface first: if that is open
//!    there, more than twice as near as the neighbour's border, the vertex is of that rim and not of the seam; so is one
//!    where the border turns off the seam and the finest surface's end is nearer than the neighbour
//!
//! # Limits
//! A vertex further than [`SeamConfig::reach_m`] from the neighbour's border has no partner and does not count: the
//! outer border of a dataset, and tiles that overlap. Gaps between levels are measured whether skirts hide them or not; a
//! crack is what exceeds a tile's stated error and the depth of its skirts together.

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

use super::cover::Cover;
use super::read::{Tile, Tileset};
use crate::geo::Aabb;
use crate::geo::bvh::Bvh;
use crate::measure::Surface;

/// From where on borders do not meet.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SeamConfig {
    /// Border edges this near to the neighbour's match, metres. Default: 0.005, for quantized coordinates.
    pub match_m: f64,
    /// A wider gap between tiles of one level is a crack, metres. Default: 0.02.
    pub crack_m: f64,
    /// Border vertices further from the neighbour's border are no part of the seam, metres. Default: 1.
    pub reach_m: f64,
}

impl Default for SeamConfig {
    fn default() -> Self {
        Self { match_m: 0.005, crack_m: 0.02, reach_m: 1.0 }
    }
}

/// The seam is this much thicker than the overlap of the boxes, metres.
const THICKER_M: f64 = 0.01;

/// A vertex between two in the seam belongs to it if it is no further off, metres; beyond that it is an ear of its tile.
const MOVED_M: f64 = 0.25;

/// The neighbour has a vertex without a partner no further from it, metres.
const MISSED_M: f64 = 1.5 * MOVED_M;

/// The border of a tile.
#[derive(Debug, Clone, Default)]
pub struct Border {
    points: Vec<DVec3>,
    edges: Vec<[u32; 2]>,
    aabb: Aabb,
}

impl Border {
    /// Of a tile's triangles.
    pub fn of(surface: &Surface, aabb: Aabb) -> Self {
        let mut ids: HashMap<[u64; 3], u32> = HashMap::with_capacity(surface.positions.len());
        let mut points = Vec::new();
        let mut id = |p: DVec3| {
            *ids.entry((p + 0.0).to_array().map(f64::to_bits)).or_insert_with(|| {
                points.push(p);
                points.len() as u32 - 1
            })
        };
        let mut uses: Vec<[u32; 2]> = Vec::with_capacity(3 * surface.faces.len());
        for face in &surface.faces {
            let [a, b, c] = face.map(|v| id(surface.positions[v as usize]));
            if a != b && b != c && c != a {
                uses.extend([[a, b], [b, c], [c, a]].map(|[a, b]| [a.min(b), a.max(b)]));
            }
        }
        uses.par_sort_unstable();
        let edges: Vec<[u32; 2]> = uses.chunk_by(|a, b| a == b).filter(|g| g.len() == 1).map(|g| g[0]).collect();
        let mut kept = vec![u32::MAX; points.len()];
        let mut own = Self { points: Vec::new(), edges: Vec::new(), aabb };
        for edge in edges {
            own.edges.push(edge.map(|v| {
                if kept[v as usize] == u32::MAX {
                    kept[v as usize] = own.points.len() as u32;
                    own.points.push(points[v as usize]);
                }
                kept[v as usize]
            }));
        }
        own
    }

    /// Border edges.
    pub fn len(&self) -> usize {
        self.edges.len()
    }

    /// True for closed surfaces.
    pub fn is_empty(&self) -> bool {
        self.edges.is_empty()
    }
}

/// Which tiles meet.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Between {
    /// Two of one level that have finer ones.
    #[default]
    Level,
    /// Two of different levels, or a finest tile and one that has finer ones.
    Levels,
    /// Two of the finest tiles: the surface itself.
    Finest,
}

/// Gaps between the tiles of one level, or of a level and the next finer one.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct SeamRow {
    /// Which tiles meet.
    pub between: Between,
    /// Of the coarser tiles; of the finest tiles 0.
    pub level: u32,
    /// Of the finer tiles.
    pub finer_level: u32,
    /// Pairs of neighbours with a seam.
    pub pairs: u64,
    /// Border edges in seams.
    pub edges: u64,
    /// Of these, edges that do not match.
    pub unmatched_edges: u64,
    /// Half of the border vertices have a smaller gap, metres.
    pub gap_p50_m: f64,
    /// 95 % have a smaller gap.
    pub gap_p95_m: f64,
    /// The widest gap.
    pub gap_max_m: f64,
}

impl SeamRow {
    /// For people.
    pub fn name(&self) -> String {
        match self.between {
            Between::Finest => "between the finest tiles".into(),
            Between::Level => format!("within level {}", self.level),
            Between::Levels if self.level == self.finer_level => format!("of level {} with finest tiles", self.level),
            Between::Levels => format!("of levels {} and {}", self.level, self.finer_level),
        }
    }
}

/// The widest gap of a pair of tiles.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Crack {
    /// Whose border vertex it is.
    pub tile: usize,
    /// The neighbour.
    pub neighbour: usize,
    /// Width, metres.
    pub gap_m: f64,
    /// Place in the local frame.
    pub local_m: [f64; 3],
    /// Border edges of the pair that do not match.
    pub unmatched_edges: u64,
}

/// All seams.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Seams {
    /// Within levels and across, the coarsest first.
    pub rows: Vec<SeamRow>,
    /// Cracks within levels and within the finest surface, the widest first.
    pub cracks: Vec<Crack>,
    /// Across levels, wider than the stated error and the skirts of either tile; the widest first.
    pub cracks_across: Vec<Crack>,
}

/// What one border finds at another.
#[derive(Default)]
struct Found {
    gaps: Vec<f64>,
    edges: u64,
    unmatched: u64,
    worst: Option<(f64, DVec3)>,
}

/// Measures all seams; `borders` by tile, empty for tiles that were not read.
pub fn measure(tileset: &Tileset, borders: &[Border], config: &SeamConfig) -> Seams {
    let levels: Vec<u32> = (0..borders.len()).map(|tile| tileset.level(tile)).collect();
    let cover = Cover::of(tileset);
    let between = |a: usize, b: usize| match (cover.has_finer(a), cover.has_finer(b)) {
        (false, false) => Some(Between::Finest),
        (true, true) if levels[a] == levels[b] => Some(Between::Level),
        _ => (levels[a].abs_diff(levels[b]) <= 1).then_some(Between::Levels),
    };
    let pairs = neighbours(tileset, borders, &between);
    let trees: Vec<Option<Bvh>> = borders.par_iter().map(tree).collect();
    let around = around(borders.len(), &pairs);
    let met = met(borders, &trees, &around, config);
    let finest = (0..borders.len()).filter(|&t| !cover.has_finer(t));
    let rim = tree(&rim(finest.map(|t| (&borders[t], &met[t][..]))));
    let found: Vec<([usize; 2], [Found; 2])> = pairs
        .into_par_iter()
        .map(|[a, b]| {
            // Of the finest surface, what is torn there is its rim too.
            let rim = rim.as_ref().filter(|_| between(a, b) != Some(Between::Finest));
            // What is above or below the one is not drawn beside it, whatever it meets of the other.
            let beside = |of: usize, other: usize| -> Vec<bool> {
                let zone = seam(&borders[of].aabb, &borders[other].aabb, config.reach_m);
                let others: Vec<usize> =
                    around[of].iter().copied().filter(|&c| !are_nested(tileset, c, other)).collect();
                let meets = |(p, met): (&DVec3, &bool)| {
                    *met && zone.contains(*p, 0.0) && is_met(*p, borders, &trees, &others, config)
                };
                borders[of].points.iter().zip(&met[of]).map(meets).collect()
            };
            let met = [beside(a, b), beside(b, a)];
            let one = |[a, b]: [usize; 2], met: [&[bool]; 2]| {
                gaps([&borders[a], &borders[b]], met, [trees[a].as_ref(), trees[b].as_ref()], rim, config)
            };
            ([a, b], [one([a, b], [&met[0], &met[1]]), one([b, a], [&met[1], &met[0]])])
        })
        .collect();
    let mut seams = Seams::default();
    let mut rows = std::collections::BTreeMap::<(Between, u32, u32), (SeamRow, Vec<f64>)>::new();
    for ([a, b], both) in &found {
        if both.iter().all(|f| f.gaps.is_empty()) {
            continue;
        }
        let Some(kind) = between(*a, *b) else { continue };
        let ends = [levels[*a].min(levels[*b]), levels[*a].max(levels[*b])];
        let key = if kind == Between::Finest { (kind, 0, 0) } else { (kind, ends[0], ends[1]) };
        let (row, all) = rows.entry(key).or_default();
        row.pairs += 1;
        for one in both {
            row.edges += one.edges;
            row.unmatched_edges += one.unmatched;
            all.extend(&one.gaps);
        }
        let (into, limit) = match kind != Between::Levels {
            true => (&mut seams.cracks, config.crack_m),
            false => {
                let allowed_m = [*a, *b].map(|t| across_m(&tileset.tiles[t]));
                (&mut seams.cracks_across, allowed_m.into_iter().fold(config.crack_m, f64::max))
            }
        };
        let ends = [(*a, *b, &both[0]), (*b, *a, &both[1])];
        let worst = ends.iter().filter_map(|(t, n, f)| f.worst.map(|(gap, at)| (gap, at, *t, *n)));
        let worst = worst.max_by(|x, y| x.0.total_cmp(&y.0));
        if let Some((gap_m, at, tile, neighbour)) = worst.filter(|w| w.0 > limit) {
            let unmatched_edges = both[0].unmatched + both[1].unmatched;
            into.push(Crack { tile, neighbour, gap_m, local_m: at.to_array(), unmatched_edges });
        }
    }
    for ((between, level, finer_level), (mut row, mut gaps)) in rows {
        gaps.sort_by(f64::total_cmp);
        let at = |q: f64| gaps.get(((gaps.len() as f64 * q) as usize).min(gaps.len().max(1) - 1)).copied();
        let quantiles = [0.5, 0.95, 1.0].map(|q| at(q).unwrap_or_default());
        [row.gap_p50_m, row.gap_p95_m, row.gap_max_m] = quantiles;
        seams.rows.push(SeamRow { between, level, finer_level, ..row });
    }
    for cracks in [&mut seams.cracks, &mut seams.cracks_across] {
        cracks.sort_by(|a, b| b.gap_m.total_cmp(&a.gap_m).then((a.tile, a.neighbour).cmp(&(b.tile, b.neighbour))));
    }
    seams
}

/// How far a tile may be from a finer neighbour: as its error allows beyond what the skirts hide that it says it has.
fn across_m(tile: &Tile) -> f64 {
    let properties = tile.metadata.as_ref().and_then(|m| m.get("properties"));
    let skirt_m = properties.and_then(|p| p.get("skirtDepth")?.as_f64()).filter(|m| m.is_finite());
    skirt_m.unwrap_or(0.0) + tile.geometric_error_m
}

/// Pairs of tiles whose boxes touch and that may be seen together, none above the other.
fn neighbours(
    tileset: &Tileset,
    borders: &[Border],
    between: &dyn Fn(usize, usize) -> Option<Between>,
) -> Vec<[usize; 2]> {
    let mut order: Vec<usize> = (0..borders.len()).filter(|&t| !borders[t].is_empty()).collect();
    order.sort_by(|&a, &b| borders[a].aabb.min.x.total_cmp(&borders[b].aabb.min.x).then(a.cmp(&b)));
    let mut pairs = Vec::new();
    for (i, &a) in order.iter().enumerate() {
        for &b in &order[i + 1..] {
            if borders[b].aabb.min.x > borders[a].aabb.max.x + THICKER_M {
                break;
            }
            let touch = !seam(&borders[a].aabb, &borders[b].aabb, THICKER_M).is_empty();
            if touch && between(a, b).is_some() && !are_nested(tileset, a, b) {
                pairs.push([a.min(b), a.max(b)]);
            }
        }
    }
    pairs.sort_unstable();
    pairs
}

/// Whether one of two tiles is above the other; parents come before their children.
fn are_nested(tileset: &Tileset, a: usize, b: usize) -> bool {
    let upper = a.min(b);
    let mut at = tileset.tiles[a.max(b)].parent;
    while let Some(id) = at {
        if id == upper {
            return true;
        }
        at = tileset.tiles[id].parent;
    }
    false
}

/// The neighbours of each of `count` tiles.
fn around(count: usize, pairs: &[[usize; 2]]) -> Vec<Vec<usize>> {
    let mut around = vec![Vec::new(); count];
    for &[a, b] in pairs {
        around[a].push(b);
        around[b].push(a);
    }
    around
}

/// Whether the border of any of `others` passes a point.
fn is_met(p: DVec3, borders: &[Border], trees: &[Option<Bvh>], others: &[usize], config: &SeamConfig) -> bool {
    others.iter().any(|&o| {
        borders[o].aabb.contains(p, config.match_m)
            && trees[o].as_ref().is_some_and(|tree| tree.closest(p, config.match_m).is_some())
    })
}

/// Per tile and border vertex whether any neighbour's border meets it: where three tiles meet, one partner is enough.
fn met(borders: &[Border], trees: &[Option<Bvh>], around: &[Vec<usize>], config: &SeamConfig) -> Vec<Vec<bool>> {
    let of_tile = |(own, others): (&Border, &Vec<usize>)| {
        own.points.iter().map(|p| is_met(*p, borders, trees, others, config)).collect()
    };
    borders.par_iter().zip(around).map(of_tile).collect()
}

/// The edges of some borders that no neighbour meets: where the surface itself ends.
fn rim<'a>(borders: impl Iterator<Item = (&'a Border, &'a [bool])>) -> Border {
    let mut rim = Border::default();
    for (border, met) in borders {
        for edge in border.edges.iter().filter(|edge| edge.iter().any(|v| !met[*v as usize])) {
            let first = rim.points.len() as u32;
            rim.points.extend(edge.map(|v| border.points[v as usize]));
            rim.edges.push([first, first + 1]);
        }
    }
    rim
}

/// Where two boxes overlap, and a little more; empty if they do not.
fn seam(a: &Aabb, b: &Aabb, by: f64) -> Aabb {
    Aabb { min: a.min.max(b.min) - by, max: a.max.min(b.max) + by }
}

fn tree(border: &Border) -> Option<Bvh> {
    let faces: Vec<[u32; 3]> = border.edges.iter().map(|&[a, b]| [a, b, b]).collect();
    (!faces.is_empty()).then(|| Bvh::new(&border.points, &faces))
}

/// What the first border finds at the second; both with their trees and what [`met`] says. `rim` is where the finest
/// surface ends.
fn gaps(
    [of, other]: [&Border; 2],
    [met, other_met]: [&[bool]; 2],
    trees: [Option<&Bvh>; 2],
    rim: Option<&Bvh>,
    config: &SeamConfig,
) -> Found {
    let mut found = Found::default();
    let [Some(own), Some(tree)] = trees else { return found };
    let mut zone = seam(&of.aabb, &other.aabb, THICKER_M);
    // Heights may differ by as much as what is looked for.
    zone.min.z -= config.reach_m;
    zone.max.z += config.reach_m;
    let is_in: Vec<bool> = of.points.iter().map(|&p| zone.contains(p, 0.0)).collect();
    let mut links: Vec<(u32, u32)> = of.edges.iter().flat_map(|&[a, b]| [(a, b), (b, a)]).collect();
    links.sort_unstable();
    // A vertex that was moved out of the seam still stands between two that are in it, and the neighbour misses it too:
    // of a slit in the surface that ends near the seam both lips meet the neighbour's, and its tip was never there.
    let lone = other.points.iter().zip(other_met).filter(|(p, met)| !**met && zone.contains(**p, 0.0));
    let missed: Vec<DVec3> = lone.map(|(p, _)| *p).collect();
    let is_missed = |p: DVec3| missed.iter().any(|q| q.distance_squared(p) <= MISSED_M * MISSED_M);
    let mut counts = is_in.clone();
    // With none of its neighbours in the seam a vertex may be where the border of a hole touches it; with one it may be
    // where the surface ends, and both tiles may have shrunk from there. So much of the gap the rim may be away.
    let mut doubt = vec![0.5; of.points.len()];
    for group in links.chunk_by(|a, b| a.0 == b.0) {
        let in_seam = group.iter().filter(|(_, n)| is_in[*n as usize]).count();
        let own = group[0].0 as usize;
        let p = of.points[own];
        if is_in[own] && in_seam > 0 {
            doubt[own] = if in_seam == 1 { 1.0 } else { 0.0 };
        }
        counts[own] |= in_seam >= 2 && zone.contains(p, MOVED_M) && is_missed(p);
    }
    let gap_at = |v: usize| {
        let hit = tree.closest(of.points[v], config.reach_m)?;
        if hit.distance <= config.match_m {
            return Some(hit.distance);
        }
        // What the neighbour has there this tile has too: the surface itself is open and its border only ends at the seam.
        let is_of_surface = || own.closest(hit.point, config.match_m).is_some();
        let is_of_rim =
            || doubt[v] > 0.0 && rim.is_some_and(|rim| rim.closest(of.points[v], doubt[v] * hit.distance).is_some());
        (!met[v] && !is_of_surface() && !is_of_rim()).then_some(hit.distance)
    };
    let gap: Vec<Option<f64>> = (0..of.points.len()).map(|v| counts[v].then(|| gap_at(v)).flatten()).collect();
    for (v, gap) in gap.iter().enumerate() {
        let Some(gap) = *gap else { continue };
        found.gaps.push(gap);
        if found.worst.is_none_or(|(worst, _)| gap > worst) {
            found.worst = Some((gap, of.points[v]));
        }
    }
    for &[a, b] in &of.edges {
        if let (Some(a), Some(b)) = (gap[a as usize], gap[b as usize]) {
            found.edges += 1;
            found.unmatched += u64::from(a.max(b) > config.match_m);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A strip of squares from x = `from` to `from` + 1 along y.
    fn strip(from: f64, move_by: DVec3) -> Border {
        let mut surface = Surface::default();
        for i in 0..5 {
            surface.positions.extend([DVec3::new(from, i as f64, 0.0), DVec3::new(from + 1.0, i as f64, 0.0)]);
        }
        surface.positions[5] += move_by;
        for i in 0..4u32 {
            let a = 2 * i;
            surface.faces.extend([[a, a + 1, a + 3], [a, a + 3, a + 2]]);
        }
        let aabb = Aabb::of(surface.positions.iter().copied());
        Border::of(&surface, aabb)
    }

    fn between(a: &Border, b: &Border) -> [Found; 2] {
        let config = SeamConfig::default();
        let trees = [tree(a), tree(b)];
        let borders = [a, b].map(Border::clone);
        let met = met(&borders, &trees, &[vec![1], vec![0]], &config);
        let one = |a: usize, b: usize| {
            gaps([&borders[a], &borders[b]], [&met[a], &met[b]], [trees[a].as_ref(), trees[b].as_ref()], None, &config)
        };
        [one(0, 1), one(1, 0)]
    }

    #[test]
    fn strips_that_meet_have_no_gap_and_a_lifted_vertex_has_its_own() {
        let right = strip(1.0, DVec3::ZERO);
        let [a, b] = between(&strip(0.0, DVec3::ZERO), &right);
        assert_eq!((a.unmatched, b.unmatched, a.edges, b.edges), (0, 0, 4, 4));
        for by in [DVec3::new(0.0, 0.0, 0.05), DVec3::new(-0.05, 0.0, 0.0)] {
            let [a, b] = between(&strip(0.0, by), &right);
            assert!((a.worst.expect("a gap").0 - 0.05).abs() < 1e-12, "{:?}", a.worst);
            assert_eq!(a.unmatched, 2);
            assert!(b.unmatched >= 1, "the neighbour's vertex is off the line too");
        }
    }

    #[test]
    fn a_slit_of_the_surface_that_ends_near_the_seam_is_no_crack() {
        // The left tile's last square is open from (1, 1) and (1, 1.02) to a tip 0.2 m before the seam.
        let mut points = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::new(0.8, 1.01, 0.0)];
        points.extend([DVec3::new(1.0, 1.02, 0.0), DVec3::new(1.0, 2.0, 0.0), DVec3::new(0.0, 2.0, 0.0)]);
        let faces = vec![[0, 1, 3], [1, 2, 3], [3, 4, 5], [3, 5, 6], [0, 3, 6]];
        let left = Surface { positions: points, faces, class: None };
        let mut right = left.clone();
        right.positions.iter_mut().for_each(|p| p.x = 2.0 - p.x);
        let [left, right] = [left, right].map(|s| Border::of(&s, Aabb::of(s.positions.iter().copied())));
        let [a, b] = between(&left, &right);
        assert_eq!((a.unmatched, b.unmatched), (0, 0));
        assert!(a.edges >= 2 && [a, b].iter().all(|f| f.worst.is_none_or(|(gap, _)| gap < 1e-9)));
    }

    #[test]
    fn a_slit_whose_tip_lies_where_the_tiles_overlap_is_no_crack_either() {
        let mut points = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::new(0.8, 1.01, 0.0)];
        points.extend([DVec3::new(1.0, 1.02, 0.0), DVec3::new(1.0, 2.0, 0.0), DVec3::new(0.0, 2.0, 0.0)]);
        let faces = vec![[0, 1, 3], [1, 2, 3], [3, 4, 5], [3, 5, 6], [0, 3, 6]];
        let left = Surface { positions: points, faces, class: None };
        let mut right = left.clone();
        right.positions.iter_mut().for_each(|p| p.x = 2.0 - p.x);
        right.positions[3].x = 1.5;
        // Something above reaches over the left tile.
        right.positions.extend([DVec3::new(0.7, 1.9, 5.0), DVec3::new(1.0, 1.9, 5.0), DVec3::new(1.0, 2.0, 5.0)]);
        right.faces.push([7, 8, 9]);
        let borders = |left: &Surface| [left, &right].map(|s| Border::of(s, Aabb::of(s.positions.iter().copied())));
        let [a, b] = borders(&left);
        let found = between(&a, &b);
        assert!(found.iter().all(|f| f.unmatched == 0 && f.worst.is_none_or(|(gap, _)| gap < 1e-9)));
        // A lip that was moved off the seam is a crack.
        let mut torn = left;
        torn.positions[4].z = 0.05;
        let [a, b] = borders(&torn);
        let gap = between(&a, &b)[0].worst.expect("a gap").0;
        assert!((0.04..0.06).contains(&gap), "{gap}");
    }

    #[test]
    fn a_rim_that_only_touches_the_seam_is_no_crack() {
        // The left tile has a hole whose tip all but reaches the seam, between two vertices on it.
        let mut points = vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 4.0, 0.0), DVec3::new(0.0, 4.0, 0.0)];
        points.extend([DVec3::new(0.995, 2.0, 0.0), DVec3::new(0.3, 1.5, 0.0), DVec3::new(0.3, 2.5, 0.0)]);
        let faces = vec![[0, 1, 5], [1, 4, 5], [1, 2, 4], [2, 6, 4], [2, 3, 6], [3, 0, 5], [3, 5, 6]];
        let left = Surface { positions: points, faces, class: None };
        let left = Border::of(&left, Aabb::of(left.positions.iter().copied()));
        // The right one has nothing there to be near to.
        let mut right = strip(1.0, DVec3::ZERO);
        right.points.iter_mut().for_each(|p| p.z += 0.3 * f64::from(p.x == 1.0 && p.y > 0.5 && p.y < 3.5));
        let trees = [tree(&left), tree(&right)];
        let borders = [left, right];
        let met = met(&borders, &trees, &[vec![1], vec![0]], &SeamConfig::default());
        let widest = |rim: Option<&Bvh>| {
            let trees = [trees[0].as_ref(), trees[1].as_ref()];
            let all = gaps([&borders[0], &borders[1]], [&met[0], &met[1]], trees, rim, &SeamConfig::default());
            all.worst.map_or(0.0, |w| w.0)
        };
        // What the finest tile has is a little elsewhere.
        let mut finest = borders[0].clone();
        finest.points.iter_mut().for_each(|p| p.z += 0.05);
        let of_hole = rim([(&finest, &met[0][..])].into_iter());
        assert!((0.2..0.31).contains(&widest(None)), "{}", widest(None));
        assert!(widest(tree(&of_hole).as_ref()) < 0.01, "{}", widest(tree(&of_hole).as_ref()));
        let elsewhere = Border { points: of_hole.points.iter().map(|p| *p + 5.0).collect(), ..of_hole };
        assert!(widest(tree(&elsewhere).as_ref()) > 0.2, "a rim elsewhere explains nothing");
    }

    #[test]
    fn a_finer_border_on_the_same_line_matches() {
        let fine = strip(1.0, DVec3::ZERO);
        let coarse = Surface {
            positions: vec![DVec3::ZERO, DVec3::new(1.0, 0.0, 0.0), DVec3::new(1.0, 4.0, 0.0)],
            faces: vec![[0, 1, 2]],
            class: None,
        };
        let coarse = Border::of(&coarse, Aabb::of(coarse.positions.iter().copied()));
        let [a, b] = between(&coarse, &fine);
        assert_eq!((a.unmatched, b.unmatched), (0, 0));
    }
}
