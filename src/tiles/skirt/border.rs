//! The open edges of a tile on the walls of its cell.

use std::collections::HashSet;

use glam::DVec3;

use super::SAME_M;
use crate::geo::Rect;
use crate::geo::hash::BitsMap;

/// Sides of a cell: axis across the wall, and whether the wall is the upper one on that axis.
pub(super) const SIDES: [(usize, bool); 4] = [(0, false), (0, true), (1, false), (1, true)];

/// An open edge of a tile on a wall.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Edge {
    /// Place of the face among the tile's.
    pub face: u32,
    /// The corner it starts from.
    pub corner: u8,
    pub ends: [DVec3; 2],
    /// Along the wall into the solid, at right angles to the edge; length 1.
    pub inward: DVec3,
    /// The same at its ends, where other edges go on; not normalised.
    pub inward_at_ends: [DVec3; 2],
}

/// What has to be kept of an [`Edge`].
#[derive(Debug, Clone, Copy)]
struct Open {
    face: u32,
    corner: u8,
    ends: [DVec3; 2],
}

/// The open edges of a tile on the walls of its cell.
#[derive(Debug, Clone, Default)]
pub struct Border {
    plan: Option<Rect>,
    /// How far vertices will be moved when they are written, metres.
    pub(super) rounding_m: f64,
    sides: [Box<[Open]>; 4],
}

impl Border {
    /// The border of the surface `faces` in the cell `plan`, whose vertices move by up to `rounding_m` when written.
    pub fn of(positions: &[DVec3], faces: impl Iterator<Item = [u32; 3]>, plan: Rect, rounding_m: f64) -> Self {
        let mut found: [Vec<Open>; 4] = Default::default();
        for (f, face) in faces.enumerate() {
            let corners = face.map(|v| positions[v as usize]);
            for k in 0..3 {
                let ends = [corners[k], corners[(k + 1) % 3]];
                for (side, edges) in found.iter_mut().enumerate() {
                    if inward(side, &plan, ends).is_some() {
                        edges.push(Open { face: f as u32, corner: k as u8, ends });
                    }
                }
            }
        }
        found.iter_mut().for_each(keep_open);
        // What is found is more than what is open, and borders of all tiles are held at once.
        Self { plan: Some(plan), rounding_m, sides: found.map(Vec::into_boxed_slice) }
    }

    /// Place of the wall on a side, and from where to where it goes.
    pub(super) fn wall(&self, side: usize) -> Option<(f64, [f64; 2])> {
        let plan = self.plan?;
        let (axis, upper) = SIDES[side];
        let along = 1 - axis;
        Some((if upper { plan.max[axis] } else { plan.min[axis] }, [plan.min[along], plan.max[along]]))
    }

    /// Open edges on a side.
    pub(super) fn count(&self, side: usize) -> usize {
        self.sides[side].len()
    }

    /// The open edges on a side, in their order.
    pub(super) fn edges(&self, side: usize) -> Vec<Edge> {
        let Some(plan) = self.plan else { return Vec::new() };
        let edge = |&Open { face, corner, ends }: &Open| {
            inward(side, &plan, ends).map(|inward| Edge { face, corner, ends, inward, inward_at_ends: [inward; 2] })
        };
        let mut edges: Vec<Edge> = self.sides[side].iter().filter_map(edge).collect();
        join(&mut edges, side, &plan);
        edges
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

pub(super) fn key(p: DVec3) -> [u64; 3] {
    // Adding 0 makes -0 a 0.
    p.to_array().map(|c| (c + 0.0).to_bits())
}

/// Keeps the edges at which an odd number of faces meet: one of them, in the direction that most of them have.
fn keep_open(edges: &mut Vec<Open>) {
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
