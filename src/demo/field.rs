//! The whole scene as one signed distance, evaluated through buckets of near things.

use glam::{DVec2, DVec3};

use super::ground::Ground;
use super::solid::{Shape, Thing, smooth_min};
use crate::ids::ClassId;

/// "No thing": the ground itself.
pub(super) const GROUND: u32 = u32::MAX;

/// Side of a bucket, metres.
const BUCKET_M: f64 = 5.0;
/// Things farther than this from a bucket are not listed in it; distances are cut off here.
const REACH_M: f64 = 3.0;
/// Inner corners are rounded over this length, metres.
const ROUND_M: f64 = 0.2;

/// The scene.
pub(super) struct Field {
    pub(super) ground: Ground,
    pub(super) things: Vec<Thing>,
    half_m: f64,
    side: usize,
    buckets: Vec<Vec<u32>>,
    tops: Vec<f64>,
}

impl Field {
    /// Sorts things into buckets over a square of `extent_m` about the origin.
    pub(super) fn new(ground: Ground, things: Vec<Thing>, extent_m: f64) -> Self {
        let half_m = extent_m / 2.0 + REACH_M;
        let side = (2.0 * half_m / BUCKET_M).ceil() as usize;
        let mut buckets = vec![Vec::new(); side * side];
        let mut tops = vec![f64::NEG_INFINITY; side * side];
        let cell = |x: f64| (((x + half_m) / BUCKET_M).floor().max(0.0) as usize).min(side - 1);
        for (id, thing) in things.iter().enumerate() {
            let (low, high) = (thing.low - DVec3::splat(REACH_M), thing.high + DVec3::splat(REACH_M));
            for j in cell(low.y)..=cell(high.y) {
                for i in cell(low.x)..=cell(high.x) {
                    buckets[j * side + i].push(id as u32);
                    tops[j * side + i] = f64::max(tops[j * side + i], thing.high.z);
                }
            }
        }
        Self { ground, things, half_m, side, buckets, tops }
    }

    fn bucket(&self, plan: DVec2) -> usize {
        let cell = |x: f64| (((x + self.half_m) / BUCKET_M).floor().max(0.0) as usize).min(self.side - 1);
        cell(plan.y) * self.side + cell(plan.x)
    }

    /// Height above which a column is empty.
    pub(super) fn top(&self, plan: DVec2, ground_m: f64) -> f64 {
        self.tops[self.bucket(plan)].max(ground_m)
    }

    /// Signed distance to the scene, cut off at 3 m outside; `ground_m` is the land's height at `p`.
    pub(super) fn distance_over(&self, p: DVec3, ground_m: f64) -> f64 {
        let mut d = (p.z - ground_m).min(REACH_M);
        for &id in &self.buckets[self.bucket(p.truncate())] {
            let thing = &self.things[id as usize];
            if thing.box_distance(p) < d + ROUND_M {
                let k = if matches!(thing.shape, Shape::Car(_)) { 0.05 } else { ROUND_M };
                d = smooth_min(d, thing.distance(p).0, k);
            }
        }
        d
    }

    /// Signed distance to the scene, cut off at 3 m outside.
    pub(super) fn distance(&self, p: DVec3) -> f64 {
        self.distance_over(p, self.ground.height(p.truncate()))
    }

    /// Upward gradient of the distance, not normalised away from the surface.
    pub(super) fn normal(&self, p: DVec3) -> DVec3 {
        const STEP_M: f64 = 0.03;
        let mut sum = DVec3::ZERO;
        for corner in [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]] {
            let axis = DVec3::from_array(corner);
            sum += axis * self.distance(p + axis * STEP_M);
        }
        sum.normalize_or(DVec3::Z)
    }

    /// The thing whose surface is nearest to a point of the surface, and its class.
    pub(super) fn nearest(&self, p: DVec3) -> (u32, ClassId) {
        let mut best = (p.z - self.ground.height(p.truncate()), GROUND, ClassId::TERRAIN);
        for &id in &self.buckets[self.bucket(p.truncate())] {
            let thing = &self.things[id as usize];
            if thing.box_distance(p) < best.0.max(0.5) {
                let (d, class) = thing.distance(p);
                if d < best.0 {
                    best = (d, id, class);
                }
            }
        }
        (best.1, best.2)
    }

    /// Distance from thing `id`, or from the ground.
    pub(super) fn distance_to(&self, id: u32, p: DVec3) -> f64 {
        match self.things.get(id as usize) {
            Some(thing) => thing.distance(p).0,
            None => p.z - self.ground.height(p.truncate()),
        }
    }
}
