//! Says how far the borders of tiles of different levels are apart, and hangs skirts that close the gaps.
//!
//! In: the [`Border`] of every tile: its open edges on the walls of its cell. Out: a [`Hem`] for each: the distance to
//! the borders of all tiles that can stand beside it, and the skirts that hide it.
//!
//! # Method
//! 1. Walls are vertical planes and borders are polylines in them, so a gap is a region of the wall between two
//!    polylines. Tiles that can be neighbours in some cut of the tree are those on the two sides of one plane.
//! 2. Every point of a neighbour's polyline that lies inside this tile's solid (the inner side of its nearest edge)
//!    demands a skirt as deep as its distance from that edge. Segments are halved until the largest distance is certain
//!    ([`CERTAIN_M`], [`CERTAIN_SHARE`]).
//!    What sticks out of a neighbour, a fence that it lost, has no such point near its top: there the demand is the own
//!    point's distance, but no more than half of how thick the solid is: the circle that touches the border there from
//!    inside and crosses it nowhere.
//! 3. A skirt is a strip in the wall: from the edge along the wall into the solid, at right angles to the edge. Below
//!    ground it hangs down, behind a façade that crosses the wall it goes into the building, above the soffit of an eave
//!    it goes up. Corners are mitred, so that strips join.
//!
//! # Promises
//! - A point between the borders of two neighbours is inside one of them and outside the other, and lies in the skirt of
//!   the one it is inside of (`the_skirts_of_two_levels_close_the_gap_between_them`).
//! - [`Hem::wall_m`] is not below the distance of any two borders that can meet, either way.
//! - A skirt lies in the wall and inside the tile's own solid: from above it has no area.
//!
//! # Limits
//! Beside a façade a skirt may run on along the wall beyond its cell's corner, so a box can be a little wider than its
//! cell. A solid thinner than the gap beside it is pierced by its skirt. Where windings disagree the inner side is a guess.
//! Cells that meet at a corner only are not compared: their tiles share a line.

use std::collections::{BTreeMap, HashSet};

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::geo::Rect;
use crate::geo::bvh::{Bvh, closest_on_triangle};
use crate::geo::hash::BitsMap;

/// A distance is certain when it is known to this, metres …
const CERTAIN_M: f64 = 1e-3;
/// … or to this share of it.
const CERTAIN_SHARE: f64 = 0.02;
/// Segments are not halved more often.
const MOST_HALVINGS: u32 = 24;
/// Skirts are deeper than the gap by this share and this length, metres: edges that only touch let light through.
const MARGIN_SHARE: f64 = 0.05;
const MARGIN_M: f64 = 1e-3;
/// Borders nearer than this are the same, metres: the grid of the source.
const SAME_M: f64 = 1e-6;
/// Circles shrink at most so often, and are small enough within this share.
const MOST_SHRINKS: u32 = 32;
const SHRUNK_SHARE: f64 = 1e-3;
/// An edge that sticks out of a neighbour is looked at in so many places.
const PLACES: u32 = 5;
/// A mitre is at most this many times as long as the skirt is deep.
const LONGEST_MITRE: f64 = 3.0;

/// Which skirts tiles get.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Skirts {
    /// As deep as the gaps they close.
    #[default]
    Auto,
    /// None.
    Off,
    /// All of one depth, metres.
    Metres(f64),
}

impl Skirts {
    /// Reads `auto`, `off` or metres; `None` for anything else.
    pub fn parse(text: &str) -> Option<Self> {
        match text.trim() {
            "auto" => Some(Self::Auto),
            "off" => Some(Self::Off),
            number => number.parse().ok().filter(|m| (0.0..=1000.0).contains(m)).map(Self::Metres),
        }
    }
}

impl Serialize for Skirts {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Auto => serializer.serialize_str("auto"),
            Self::Off => serializer.serialize_str("off"),
            Self::Metres(m) => serializer.serialize_f64(*m),
        }
    }
}

impl<'de> Deserialize<'de> for Skirts {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Number(f64),
            Word(String),
        }
        let read = match Written::deserialize(deserializer) {
            Ok(Written::Number(m)) => Self::parse(&m.to_string()),
            Ok(Written::Word(word)) => Self::parse(&word),
            Err(_) => None,
        };
        read.ok_or_else(|| serde::de::Error::custom("levels.skirts: wanted \"auto\", \"off\" or 0 to 1000 metres"))
    }
}

/// Sides of a cell: axis across the wall, and whether the wall is the upper one on that axis.
const SIDES: [(usize, bool); 4] = [(0, false), (0, true), (1, false), (1, true)];

/// An open edge of a tile on a wall.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Edge {
    /// Place of the face among the tile's.
    face: u32,
    /// The corner it starts from.
    corner: u8,
    ends: [DVec3; 2],
    /// Along the wall into the solid, at right angles to the edge; length 1.
    inward: DVec3,
    /// The same at its ends, where other edges go on; not normalised.
    inward_at_ends: [DVec3; 2],
}

/// The open edges of a tile on the walls of its cell.
#[derive(Debug, Clone, Default)]
pub struct Border {
    plan: Option<Rect>,
    /// How far vertices will be moved when they are written, metres.
    rounding_m: f64,
    sides: [Vec<Edge>; 4],
}

/// Where a tile's border is relative to its neighbours', and its skirts.
#[derive(Debug, Clone, Default)]
pub struct Hem {
    /// No point of the tile's border is further from the border of any tile that can stand beside it, nor the other way
    /// round, metres (certified). 0 where nothing can stand beside it.
    pub wall_m: f64,
    /// Depth of the deepest skirt, metres.
    pub skirt_m: f64,
    /// The skirts.
    pub strips: Vec<Strip>,
}

/// A skirt under one edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strip {
    /// Place of the face among the tile's.
    pub face: u32,
    /// The edge goes from this corner of the face to the next.
    pub corner: u8,
    /// The ends of the strip's lower edge, below that corner and the next, local metres.
    pub below: [DVec3; 2],
}

impl Border {
    /// The border of the surface `faces` in the cell `plan`, whose vertices move by up to `rounding_m` when written.
    pub fn of(positions: &[DVec3], faces: impl Iterator<Item = [u32; 3]>, plan: Rect, rounding_m: f64) -> Self {
        let mut found: [Vec<Edge>; 4] = Default::default();
        for (f, face) in faces.enumerate() {
            let corners = face.map(|v| positions[v as usize]);
            for k in 0..3 {
                let ends = [corners[k], corners[(k + 1) % 3]];
                for (side, edges) in found.iter_mut().enumerate() {
                    if let Some(inward) = inward(side, &plan, ends) {
                        let (face, corner) = (f as u32, k as u8);
                        edges.push(Edge { face, corner, ends, inward, inward_at_ends: [inward; 2] });
                    }
                }
            }
        }
        found.iter_mut().for_each(keep_open);
        for (side, edges) in found.iter_mut().enumerate() {
            join(edges, side, &plan);
        }
        Self { plan: Some(plan), rounding_m, sides: found }
    }

    fn wall(&self, side: usize) -> Option<(f64, [f64; 2])> {
        let plan = self.plan?;
        let (axis, upper) = SIDES[side];
        let along = 1 - axis;
        Some((if upper { plan.max[axis] } else { plan.min[axis] }, [plan.min[along], plan.max[along]]))
    }
}

/// The direction into the solid if the edge lies on that side of the cell.
fn inward(side: usize, plan: &Rect, ends: [DVec3; 2]) -> Option<DVec3> {
    let (axis, upper) = SIDES[side];
    let wall = if upper { plan.max[axis] } else { plan.min[axis] };
    if ends.iter().any(|p| (p[axis] - wall).abs() > SAME_M) {
        return None;
    }
    let mut outward = DVec3::ZERO;
    outward[axis] = if upper { 1.0 } else { -1.0 };
    // The face is on the left of its edge, seen from outside the solid, and inside the cell.
    (ends[1] - ends[0]).cross(outward).try_normalize()
}

fn key(p: DVec3) -> [u64; 3] {
    // Adding 0 makes -0 a 0.
    p.to_array().map(|c| (c + 0.0).to_bits())
}

/// Keeps the edges at which an odd number of faces meet: one of them, in the direction that most of them have.
fn keep_open(edges: &mut Vec<Edge>) {
    let mut count: BitsMap<[[u64; 3]; 2], usize> = BitsMap::default();
    for edge in edges.iter() {
        *count.entry(edge.ends.map(key)).or_default() += 1;
    }
    let mut done = HashSet::new();
    edges.retain(|edge| {
        let [a, b] = edge.ends.map(key);
        let (own, back) = (count[&[a, b]], count.get(&[b, a]).copied().unwrap_or(0));
        (own + back) % 2 == 1 && own > back && done.insert([a, b])
    });
}

/// Directions at the ends of edges: between those of the edges that meet there; upright at the cell's corners, where
/// the skirts of two walls have to meet.
fn join(edges: &mut [Edge], side: usize, plan: &Rect) {
    let mut sums: BitsMap<[u64; 3], DVec3> = BitsMap::default();
    for edge in edges.iter() {
        edge.ends.iter().for_each(|p| *sums.entry(key(*p)).or_default() += edge.inward);
    }
    let along = 1 - SIDES[side].0;
    for edge in edges {
        for (end, inward) in edge.ends.iter().zip(&mut edge.inward_at_ends) {
            *inward = sums[&key(*end)];
            let at_corner =
                (end[along] - plan.min[along]).abs() <= SAME_M || (plan.max[along] - end[along]).abs() <= SAME_M;
            if at_corner && inward.z.abs() > 0.5 * inward.length() {
                *inward = DVec3::new(0.0, 0.0, inward.z);
            }
        }
    }
}

/// What the borders on one wall of one tile demand of it.
struct Wall {
    tile: usize,
    side: usize,
    /// For each edge, metres.
    demand_m: Vec<f64>,
    /// Distances that hold for this tile and another one.
    pairs: Vec<(usize, f64)>,
}

/// The hem of every tile. `borders` are those of all tiles of the tree.
pub fn hems(borders: &[Border], skirts: Skirts) -> Vec<Hem> {
    // Tiles by the plane and the side from which they touch it.
    let mut by_wall: ByWall = BTreeMap::new();
    let mut work: Vec<(usize, usize)> = Vec::new();
    for (tile, border) in borders.iter().enumerate() {
        for side in (0..4).filter(|&s| !border.sides[s].is_empty()) {
            if let Some((wall, _)) = border.wall(side) {
                by_wall.entry((side, (wall + 0.0).to_bits())).or_default().push((tile, work.len()));
                work.push((tile, side));
            }
        }
    }
    let trees: Vec<Bvh> = work.par_iter().map(|&(tile, side)| tree(&borders[tile].sides[side])).collect();
    let walls: Vec<Wall> = (work.par_iter().zip(&trees))
        .map(|(&(tile, side), own)| demands(borders, &by_wall, (tile, side), own, &trees))
        .collect();
    let mut hems = vec![Hem::default(); borders.len()];
    for wall in &walls {
        for &(other, distance_m) in &wall.pairs {
            for tile in [wall.tile, other] {
                hems[tile].wall_m = hems[tile].wall_m.max(distance_m);
            }
        }
    }
    for wall in walls.iter().filter(|_| skirts != Skirts::Off) {
        let edges = &borders[wall.tile].sides[wall.side];
        let fixed = match skirts {
            Skirts::Metres(depth_m) => Some(vec![depth_m; edges.len()]),
            _ => None,
        };
        hang(edges, fixed.as_ref().unwrap_or(&wall.demand_m), &mut hems[wall.tile]);
    }
    hems
}

/// Tiles that touch a plane from a side, with the place of their tree.
type ByWall = BTreeMap<(usize, u64), Vec<(usize, usize)>>;

fn tree(edges: &[Edge]) -> Bvh {
    let positions: Vec<DVec3> = edges.iter().flat_map(|e| e.ends).collect();
    let faces: Vec<[u32; 3]> = (0..edges.len() as u32).map(|e| [2 * e, 2 * e + 1, 2 * e + 1]).collect();
    Bvh::new(&positions, &faces)
}

fn demands(borders: &[Border], by_wall: &ByWall, (tile, side): (usize, usize), tree: &Bvh, trees: &[Bvh]) -> Wall {
    let own = &borders[tile];
    let edges = &own.sides[side];
    let mut wall = Wall { tile, side, demand_m: vec![0.0; edges.len()], pairs: Vec::new() };
    let across = side ^ 1;
    let Some((place, span)) = own.wall(side) else { return wall };
    let Some(others) = by_wall.get(&(across, (place + 0.0).to_bits())) else { return wall };
    let along = 1 - SIDES[side].0;
    for &(other, other_tree) in others {
        let Some((_, other_span)) = borders[other].wall(across) else { continue };
        let shared = [span[0].max(other_span[0]), span[1].min(other_span[1])];
        if shared[0] >= shared[1] {
            continue;
        }
        let mut raw_m = vec![0.0f64; edges.len()];
        let mut widest_m = 0.0f64;
        for edge in &borders[other].sides[across] {
            if let Some(ends) = clipped(edge.ends, along, shared) {
                let mut probe = Probe { tree, edges, demand_m: &mut raw_m, widest_m: &mut widest_m };
                probe.segment(ends.map(|p| probe.hit(p)), 0);
            }
        }
        let beside = Beside { edges: &borders[other].sides[across], tree: &trees[other_tree] };
        for (edge, raw_m) in edges.iter().zip(&mut raw_m) {
            if let Some(ends) = clipped(edge.ends, along, shared) {
                *raw_m = beside.sticking_out_m(edge, ends, tree, *raw_m);
            }
        }
        let rounding_m = own.rounding_m + borders[other].rounding_m;
        for (demand_m, raw_m) in wall.demand_m.iter_mut().zip(raw_m) {
            // Rounding alone opens gaps too when it is coarse.
            if raw_m > SAME_M || rounding_m > 1e-4 {
                *demand_m = demand_m.max(raw_m + rounding_m);
            }
        }
        wall.pairs.push((other, widest_m + rounding_m));
    }
    wall
}

/// A border on the other side of the wall.
struct Beside<'a> {
    edges: &'a [Edge],
    tree: &'a Bvh,
}

impl Beside<'_> {
    /// How deep a skirt has to be under the part `ends` of an edge that sticks out of this border's solid, if that is
    /// more than `known_m`; `own` are the border's edges that the edge is one of.
    fn sticking_out_m(&self, edge: &Edge, ends: [DVec3; 2], own: &Bvh, known_m: f64) -> f64 {
        (0..PLACES).fold(known_m, |deepest_m, i| {
            let p = ends[0].lerp(ends[1], f64::from(i) / f64::from(PLACES - 1));
            let Some(hit) = self.tree.closest(p, f64::INFINITY) else { return deepest_m };
            let sticks_out = hit.distance > deepest_m.max(SAME_M) && !is_inside(&self.edges[hit.face as usize], p);
            if sticks_out { deepest_m.max(half_thickness_m(p, edge.inward, own, hit.distance)) } else { deepest_m }
        })
    }
}

/// Radius of the largest circle through a point of a border, with its centre `inward` of it, that no edge crosses; at most
/// `most_m`. What is nearest to the point is no further from it.
fn half_thickness_m(p: DVec3, inward: DVec3, own: &Bvh, most_m: f64) -> f64 {
    let mut radius_m = most_m;
    for _ in 0..MOST_SHRINKS {
        let Some(hit) = own.closest(p + inward * radius_m, f64::INFINITY) else { break };
        let offset = hit.point - p;
        let ahead_m = offset.dot(inward);
        if hit.distance >= radius_m * (1.0 - SHRUNK_SHARE) || ahead_m <= 0.0 {
            break;
        }
        radius_m = offset.length_squared() / (2.0 * ahead_m);
    }
    radius_m
}

/// The part of a segment between two places along the wall.
fn clipped([a, b]: [DVec3; 2], along: usize, [low, high]: [f64; 2]) -> Option<[DVec3; 2]> {
    let at = |value: f64| a + (b - a) * ((value - a[along]) / (b[along] - a[along])).clamp(0.0, 1.0);
    let (first, last) = (a[along].min(b[along]), a[along].max(b[along]));
    if last < low || first > high {
        return None;
    }
    let keep = |p: DVec3| {
        if p[along] < low {
            at(low)
        } else if p[along] > high {
            at(high)
        } else {
            p
        }
    };
    Some([keep(a), keep(b)])
}

/// A point of another tile's border, and the nearest edge of this one's.
#[derive(Clone, Copy)]
struct Found {
    at: DVec3,
    edge: usize,
    distance_m: f64,
}

struct Probe<'a> {
    tree: &'a Bvh,
    edges: &'a [Edge],
    demand_m: &'a mut [f64],
    widest_m: &'a mut f64,
}

impl Probe<'_> {
    fn hit(&self, at: DVec3) -> Found {
        let hit = self.tree.closest(at, f64::INFINITY);
        hit.map_or(Found { at, edge: 0, distance_m: 0.0 }, |h| Found {
            at,
            edge: h.face as usize,
            distance_m: h.distance,
        })
    }

    /// Distance to an edge is convex: if both ends are about as near to one edge as to their nearest, the larger of
    /// their distances to it bounds all between them.
    fn segment(&mut self, ends: [Found; 2], halvings: u32) {
        let seen_m = ends[0].distance_m.max(ends[1].distance_m);
        let certain_m = CERTAIN_M.max(CERTAIN_SHARE * seen_m);
        for end in ends {
            let to_edge = ends.map(|e| (nearest(self.edges[end.edge].ends, e.at) - e.at).length());
            let bound_m = to_edge[0].max(to_edge[1]);
            if bound_m <= seen_m + certain_m {
                *self.widest_m = self.widest_m.max(bound_m);
                for (e, distance_m) in ends.iter().zip(to_edge) {
                    self.demand(end.edge, e.at, distance_m);
                    self.demand(e.edge, e.at, e.distance_m);
                }
                return;
            }
        }
        let length_m = (ends[1].at - ends[0].at).length();
        if halvings == MOST_HALVINGS || length_m <= certain_m {
            *self.widest_m = self.widest_m.max(seen_m + length_m * 0.5);
            for end in ends {
                self.demand(end.edge, end.at, end.distance_m + length_m * 0.5);
            }
            return;
        }
        let middle = self.hit((ends[0].at + ends[1].at) * 0.5);
        self.segment([ends[0], middle], halvings + 1);
        self.segment([middle, ends[1]], halvings + 1);
    }

    /// A point on the inner side of an edge has to be reached by its skirt.
    fn demand(&mut self, e: usize, at: DVec3, distance_m: f64) {
        if is_inside(&self.edges[e], at) {
            self.demand_m[e] = self.demand_m[e].max(distance_m);
        }
    }
}

/// Whether a point of the wall is on the inner side of an edge, its nearest.
fn is_inside(edge: &Edge, at: DVec3) -> bool {
    let foot = nearest(edge.ends, at);
    let inward = match edge.ends.iter().position(|p| (*p - foot).length_squared() < SAME_M * SAME_M) {
        Some(end) => edge.inward_at_ends[end],
        None => edge.inward,
    };
    (at - foot).dot(inward) > 0.0
}

fn nearest([a, b]: [DVec3; 2], p: DVec3) -> DVec3 {
    closest_on_triangle(p, &[a, b, b])
}

/// Adds the strips of one wall: at each vertex as deep as the deeper of its edges asks.
fn hang(edges: &[Edge], demand_m: &[f64], hem: &mut Hem) {
    let mut depths: BitsMap<[u64; 3], f64> = BitsMap::default();
    for (edge, &demand_m) in edges.iter().zip(demand_m).filter(|(_, d)| **d > 0.0) {
        for end in edge.ends {
            let depth = depths.entry(key(end)).or_default();
            *depth = depth.max(demand_m * (1.0 + MARGIN_SHARE) + MARGIN_M);
        }
    }
    for edge in edges {
        let depth_m = edge.ends.map(|p| depths.get(&key(p)).copied().unwrap_or(0.0));
        if depth_m[0].max(depth_m[1]) <= 0.0 {
            continue;
        }
        hem.skirt_m = hem.skirt_m.max(depth_m[0]).max(depth_m[1]);
        let below = [0, 1].map(|k| edge.ends[k] + mitre(edge, k) * depth_m[k]);
        hem.strips.push(Strip { face: edge.face, corner: edge.corner, below });
    }
}

/// From the end of an edge to the strip's lower edge, for a strip of depth 1. The same for both edges of a vertex, so
/// that their strips join, and at least 1 deep under each of them where the corner is not too sharp.
fn mitre(edge: &Edge, end: usize) -> DVec3 {
    let Some(direction) = edge.inward_at_ends[end].try_normalize() else { return edge.inward };
    let reach = direction.dot(edge.inward);
    if reach <= 1.0 / LONGEST_MITRE { direction * LONGEST_MITRE } else { direction / reach }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    /// A strip of ground 4 m long beside the wall x = 0, on its west (`west`) or east side; `heights` at even distances
    /// along the wall.
    fn strip(heights: &[f64], west: bool, low: f64, high: f64) -> (Vec<DVec3>, Vec<[u32; 3]>, Rect) {
        let n = heights.len();
        let far = if west { -2.0 } else { 2.0 };
        let mut positions = Vec::new();
        for (i, z) in heights.iter().enumerate() {
            let y = low + (high - low) * i as f64 / (n - 1) as f64;
            positions.extend([DVec3::new(0.0, y, *z), DVec3::new(far, y, *z)]);
        }
        let mut faces = Vec::new();
        for i in 0..n as u32 - 1 {
            let [a, b, c, d] = [2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 3];
            faces.extend(if west { [[a, c, b], [b, c, d]] } else { [[a, b, c], [b, d, c]] });
        }
        let plan = if west {
            Rect { min: DVec2::new(-2.0, low), max: DVec2::new(0.0, high) }
        } else {
            Rect { min: DVec2::new(0.0, low), max: DVec2::new(2.0, high) }
        };
        (positions, faces, plan)
    }

    fn border(of: &(Vec<DVec3>, Vec<[u32; 3]>, Rect)) -> Border {
        Border::of(&of.0, of.1.iter().copied(), of.2, 0.0)
    }

    #[test]
    fn only_open_edges_on_walls_are_borders_and_the_solid_is_below_ground() {
        let ground = strip(&[0.0, 0.0, 0.0], true, 0.0, 4.0);
        let border = border(&ground);
        assert_eq!(border.sides.each_ref().map(Vec::len), [2, 2, 1, 1]);
        for edge in border.sides.iter().flatten() {
            assert!((edge.inward - DVec3::NEG_Z).length() < 1e-12, "{}", edge.inward);
        }
    }

    #[test]
    fn a_facade_that_crosses_the_wall_has_its_solid_behind_it() {
        // South face of a house, seen from the south; the wall is x = 0 on its east, the house lies to the north.
        let positions = vec![DVec3::new(-1.0, 1.0, 0.0), DVec3::new(0.0, 1.0, 0.0), DVec3::new(0.0, 1.0, 3.0)];
        let plan = Rect { min: DVec2::new(-1.0, 0.0), max: DVec2::new(0.0, 4.0) };
        let border = Border::of(&positions, [[0, 1, 2]].into_iter(), plan, 0.0);
        assert_eq!(border.sides[1].len(), 1);
        assert!((border.sides[1][0].inward - DVec3::Y).length() < 1e-12);
    }

    #[test]
    fn the_skirts_of_two_levels_close_the_gap_between_them() {
        let fine = strip(&[0.0, 0.3, -0.4, 0.2, 0.0], true, 0.0, 4.0);
        let coarse = strip(&[0.1, 0.0], false, 0.0, 4.0);
        let hems = hems(&[border(&fine), border(&coarse)], Skirts::Auto);
        // The lowest point of the fine border is 0.45 m below the coarse line, as the crow flies a hair less.
        for hem in &hems {
            assert!((0.44..0.47).contains(&hem.wall_m), "{}", hem.wall_m);
        }
        // Where the coarse tile is higher its skirt goes down to the fine border, and the other way round.
        assert!(hems[1].skirt_m > 0.44 && hems[1].skirt_m < 0.5, "{}", hems[1].skirt_m);
        assert!((0.2..0.3).contains(&hems[0].skirt_m), "{}", hems[0].skirt_m);
        let at = |s: f64, ends: [(f64, f64); 2]| {
            let [(y0, z0), (y1, z1)] = ends;
            let low = y0.min(y1) - 1e-9;
            (low..=y0.max(y1) + 1e-9).contains(&s).then(|| z0 + (z1 - z0) * (s - y0) / (y1 - y0))
        };
        let line = |of: &(Vec<DVec3>, Vec<[u32; 3]>, Rect), s: f64| {
            of.1.iter().find_map(|f| {
                let on: Vec<DVec3> = f.map(|v| of.0[v as usize]).into_iter().filter(|p| p.x == 0.0).collect();
                (on.len() == 2).then(|| at(s, [(on[0].y, on[0].z), (on[1].y, on[1].z)])).flatten()
            })
        };
        let foot = |hem: &Hem, s: f64| {
            let side = hem.strips.iter().filter(|strip| strip.below.iter().all(|p| p.x == 0.0));
            let lows = side.filter_map(|strip| at(s, strip.below.map(|p| (p.y, p.z))));
            lows.fold(f64::INFINITY, f64::min)
        };
        for i in 1..400 {
            let s = f64::from(i) / 100.0;
            let (a, b) = (line(&fine, s).unwrap(), line(&coarse, s).unwrap());
            let (high, low) = if a > b { (&hems[0], b) } else { (&hems[1], a) };
            assert!((a - b).abs() < 1e-9 || foot(high, s) < low, "at {s}: {a} {b} {}", foot(high, s));
        }
    }

    #[test]
    fn a_fence_that_the_neighbour_lost_is_closed_to_its_top() {
        // 3 m high, 0.4 m thick, of several edges on each side.
        let places = [0.0, 1.8, 1.8, 1.8, 1.8, 2.2, 2.2, 2.2, 2.2, 4.0];
        let heights = [0.0, 0.0, 1.0, 2.0, 3.0, 3.0, 2.0, 1.0, 0.0, 0.0];
        let mut fence = strip(&heights, true, 0.0, 4.0);
        (0..places.len()).for_each(|i| (0..2).for_each(|k| fence.0[2 * i + k].y = places[i]));
        let flat = strip(&[0.0, 0.0], false, 0.0, 4.0);
        let hems = hems(&[border(&fence), border(&flat)], Skirts::Auto);
        let on_wall = hems[0].strips.iter().filter(|s| s.below.iter().all(|p| p.x == 0.0));
        let strips: Vec<[DVec3; 4]> = on_wall
            .map(|s| {
                let face = fence.1[s.face as usize];
                let [a, b] = [0, 1].map(|k| fence.0[face[(s.corner as usize + k) % 3] as usize]);
                [a, b, s.below[1], s.below[0]]
            })
            .collect();
        let covers = |p: DVec3, s: &[DVec3; 4]| {
            let near = |t: [DVec3; 3]| (closest_on_triangle(p, &t) - p).length() < 1e-9;
            near([s[0], s[1], s[2]]) || near([s[0], s[2], s[3]])
        };
        for i in 1..30 {
            for y in [1.82, 1.9, 1.99, 2.05, 2.15] {
                let p = DVec3::new(0.0, y, 0.1 * f64::from(i));
                assert!(strips.iter().any(|s| covers(p, s)), "{p}");
            }
        }
        let widest_y = strips.iter().flatten().map(|p| (p.y - 2.0).abs()).filter(|y| *y < 1.0).fold(0.0, f64::max);
        assert!(widest_y < 0.23, "the skirts of one side do not come out of the other: {widest_y}");
        assert!(hems[1].strips.is_empty());
    }

    #[test]
    fn equal_borders_need_no_skirts_and_fixed_ones_hang_everywhere() {
        let (west, east) = (strip(&[0.0, 1.0, 0.5], true, 0.0, 4.0), strip(&[0.0, 1.0, 0.5], false, 0.0, 4.0));
        let borders = [border(&west), border(&east)];
        for hem in hems(&borders, Skirts::Auto) {
            assert!(hem.wall_m < 1e-9 && hem.strips.is_empty());
        }
        for hem in hems(&borders, Skirts::Metres(0.5)) {
            assert!(hem.strips.len() >= 2 && hem.skirt_m >= 0.5);
        }
        assert!(hems(&borders, Skirts::Off).iter().all(|hem| hem.strips.is_empty()));
    }

    #[test]
    fn tiles_that_cannot_meet_are_not_compared() {
        let (west, east) = (strip(&[0.0, 0.0], true, 0.0, 4.0), strip(&[5.0, 5.0], false, 4.0, 8.0));
        assert!(hems(&[border(&west), border(&east)], Skirts::Auto).iter().all(|hem| hem.wall_m == 0.0));
    }

    #[test]
    fn what_skirts_may_be_is_read_and_written_alike() {
        assert_eq!(Skirts::parse("auto"), Some(Skirts::Auto));
        assert_eq!(Skirts::parse("0.5"), Some(Skirts::Metres(0.5)));
        for wrong in ["", "on", "-1", "nan", "inf", "1e9"] {
            assert_eq!(Skirts::parse(wrong), None, "{wrong}");
        }
    }
}
