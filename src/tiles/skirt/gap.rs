//! How far the borders on two sides of one plane are apart, and how deep skirts have to be for it.

use glam::DVec3;

use super::SAME_M;
use super::border::{Border, Edge, SIDES};
use crate::geo::bvh::{Bvh, closest_on_triangle};

/// A distance is certain when it is known to this, metres …
const CERTAIN_M: f64 = 1e-3;
/// … or to this share of it.
const CERTAIN_SHARE: f64 = 0.02;
/// Segments are not halved more often.
const MOST_HALVINGS: u32 = 24;
/// Circles shrink at most so often, and are small enough within this share.
const MOST_SHRINKS: u32 = 32;
const SHRUNK_SHARE: f64 = 1e-3;
/// An edge that sticks out of a neighbour is looked at in so many places.
const PLACES: u32 = 5;

/// The border of one tile on one plane.
pub(super) struct Side {
    tile: usize,
    side: usize,
    span: [f64; 2],
    rounding_m: f64,
    edges: Vec<Edge>,
    tree: Bvh,
}

/// What the borders on one wall of one tile demand of it.
pub(super) struct Wall {
    pub tile: usize,
    pub side: usize,
    /// For each edge, metres.
    pub demand_m: Vec<f64>,
    /// Distances that hold for this tile and another one.
    pub pairs: Vec<(usize, f64)>,
}

impl Side {
    pub fn of(tile: usize, side: usize, border: &Border) -> Option<Self> {
        let (_, span) = border.wall(side)?;
        let edges = border.edges(side);
        let positions: Vec<DVec3> = edges.iter().flat_map(|e| e.ends).collect();
        let faces: Vec<[u32; 3]> = (0..edges.len() as u32).map(|e| [2 * e, 2 * e + 1, 2 * e + 1]).collect();
        Some(Self { tile, side, span, rounding_m: border.rounding_m, tree: Bvh::new(&positions, &faces), edges })
    }

    /// What those of `others` demand that are on the other side of the plane.
    pub fn demands(&self, others: &[Self]) -> Wall {
        let count = self.edges.len();
        let mut wall = Wall { tile: self.tile, side: self.side, demand_m: vec![0.0; count], pairs: Vec::new() };
        for other in others.iter().filter(|other| other.side != self.side) {
            let shared = [self.span[0].max(other.span[0]), self.span[1].min(other.span[1])];
            if shared[0] >= shared[1] {
                continue;
            }
            let (raw_m, widest_m) = self.beside(other, shared);
            let rounding_m = self.rounding_m + other.rounding_m;
            for (demand_m, raw_m) in wall.demand_m.iter_mut().zip(raw_m) {
                // Rounding alone opens gaps too when it is coarse.
                if raw_m > SAME_M || rounding_m > 1e-4 {
                    *demand_m = demand_m.max(raw_m + rounding_m);
                }
            }
            wall.pairs.push((other.tile, widest_m + rounding_m));
        }
        wall
    }

    /// What another border demands of each edge between two places along the wall, and how far it is away at most.
    fn beside(&self, other: &Self, shared: [f64; 2]) -> (Vec<f64>, f64) {
        let along = 1 - SIDES[self.side].0;
        let mut room = Room::of(along, shared);
        let mut raw_m = vec![0.0f64; self.edges.len()];
        let mut widest_m = 0.0f64;
        for ends in other.edges.iter().filter_map(|e| clipped(e.ends, along, shared)) {
            room.hold(ends);
            let (demand_m, widest_m) = (&mut raw_m, &mut widest_m);
            let mut probe = Probe { tree: &self.tree, edges: &self.edges, demand_m, widest_m };
            probe.segment(ends.map(|p| probe.hit(p)), 0);
        }
        let own: Vec<Option<[DVec3; 2]>> = self.edges.iter().map(|e| clipped(e.ends, along, shared)).collect();
        own.iter().flatten().for_each(|ends| room.hold(*ends));
        let beside = Beside { edges: &other.edges, tree: &other.tree };
        for ((edge, raw_m), ends) in self.edges.iter().zip(&mut raw_m).zip(own) {
            if let Some(ends) = ends {
                *raw_m = beside.sticking_out_m(edge, ends, &self.tree, *raw_m);
            }
            *raw_m = raw_m.min(room.depth_m(edge));
        }
        (raw_m, widest_m)
    }
}

/// The part of the plane that two borders share: nothing of either is outside.
struct Room {
    along: usize,
    low: DVec3,
    high: DVec3,
}

impl Room {
    fn of(along: usize, shared: [f64; 2]) -> Self {
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        (low[along], high[along]) = (shared[0], shared[1]);
        Self { along, low, high }
    }

    fn hold(&mut self, ends: [DVec3; 2]) {
        for p in ends {
            (self.low.z, self.high.z) = (self.low.z.min(p.z), self.high.z.max(p.z));
        }
    }

    /// How far a skirt of an edge may go before it leaves: where a border ends, what is nearest to the other one may be a
    /// cell's width away, and no gap is as deep as that.
    fn depth_m(&self, edge: &Edge) -> f64 {
        // From any point of the edge no further than from one of its ends.
        let until = |k: usize| {
            let limit = if edge.inward[k] > 0.0 { self.high[k] } else { self.low[k] };
            edge.ends.map(|p| (limit - p[k]) / edge.inward[k]).into_iter().fold(0.0, f64::max)
        };
        [self.along, 2].into_iter().filter(|&k| edge.inward[k] != 0.0).map(until).fold(f64::INFINITY, f64::min)
    }
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
