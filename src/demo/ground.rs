//! The land and its streets: hills, a bent street grid, kerbs, and what each block is used for.
//!
//! *Town* coordinates (u, v) are the plan rotated and sheared so that streets are lines of constant u or v.

use glam::DVec2;

use super::noise::Rng;

/// Height of a kerb, metres.
const KERB_M: f64 = 0.14;
/// Width of a pavement between kerb and block, metres.
pub(super) const PAVEMENT_M: f64 = 3.0;

/// A street along one town axis.
#[derive(Debug, Clone, Copy)]
pub(super) struct Street {
    /// Town coordinate of its middle.
    pub(super) centre: f64,
    /// Half the carriageway, metres.
    pub(super) half: f64,
}

/// What a block is used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Use {
    /// Attached town houses around a yard.
    Perimeter,
    /// Detached houses in gardens.
    Houses,
    /// Tall flat-roofed slabs and a car park.
    Slabs,
    /// Trees, paths, a church and kiosks.
    Park,
}

/// Where a town point lies relative to the streets around it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot {
    /// Index of the nearest street of constant u, and the offset from its middle.
    pub(super) across_u: (usize, f64),
    /// The same for constant v.
    pub(super) across_v: (usize, f64),
    /// Distance to the nearest kerb, negative on a carriageway.
    pub(super) kerb_m: f64,
}

/// The land of one city.
#[derive(Debug, Clone)]
pub(super) struct Ground {
    axis: DVec2,
    bend: (f64, f64),
    phase: [f64; 2],
    pub(super) us: Vec<Street>,
    pub(super) vs: Vec<Street>,
    shift: usize,
}

impl Ground {
    /// Lays streets over a square of `extent_m`.
    pub(super) fn new(seed: u64, extent_m: f64) -> Self {
        let mut rng = Rng::new(seed, 1, 1);
        let angle: f64 = rng.range(0.2, 0.42);
        let reach = extent_m * 0.72 + 30.0;
        let us = streets(&mut rng, reach, 0.07 * extent_m.min(160.0));
        let vs = streets(&mut rng, reach, -0.05 * extent_m.min(160.0));
        Self {
            axis: DVec2::from_angle(angle),
            bend: (rng.range(2.2, 3.2), rng.range(0.0, 6.0)),
            phase: [rng.range(0.0, 6.0), rng.range(0.0, 6.0)],
            us,
            vs,
            shift: rng.below(4),
        }
    }

    /// Town coordinates of a plan point.
    pub(super) fn town(&self, plan: DVec2) -> DVec2 {
        let t = DVec2::new(self.axis.dot(plan), self.axis.perp_dot(plan));
        DVec2::new(t.x + self.bend_at(t.y), t.y)
    }

    /// The plan point of town coordinates.
    pub(super) fn plan(&self, town: DVec2) -> DVec2 {
        self.axis.rotate(DVec2::new(town.x - self.bend_at(town.y), town.y))
    }

    fn bend_at(&self, v: f64) -> f64 {
        self.bend.0 * (v * BEND_PER_M + self.bend.1).sin()
    }

    /// Direction in the plan of streets of constant v (along u).
    pub(super) fn along_u(&self) -> DVec2 {
        self.axis
    }

    /// Direction in the plan of streets of constant u at `v`.
    pub(super) fn along_v(&self, v: f64) -> DVec2 {
        let slope = self.bend.0 * BEND_PER_M * (v * BEND_PER_M + self.bend.1).cos();
        self.axis.rotate(DVec2::new(-slope, 1.0).normalize())
    }

    /// Places a town point among the streets.
    pub(super) fn spot(&self, town: DVec2) -> Spot {
        let (across_u, across_v) = (nearest(&self.us, town.x), nearest(&self.vs, town.y));
        let du = across_u.1.abs() - self.us[across_u.0].half;
        let dv = across_v.1.abs() - self.vs[across_v.0].half;
        Spot { across_u, across_v, kerb_m: du.min(dv) }
    }

    /// Height of the land, metres; slopes stay below 8 % but for kerbs.
    pub(super) fn height(&self, plan: DVec2) -> f64 {
        let hills = 0.024 * plan.x
            + 0.014 * plan.y
            + 1.0 * (plan.x / 30.0 + self.phase[0]).sin()
            + 0.8 * (plan.y / 27.0 + self.phase[1]).sin();
        let t = ((self.spot(self.town(plan)).kerb_m + 0.1) / 0.25).clamp(0.0, 1.0);
        hills + KERB_M * t * t * (3.0 - 2.0 * t)
    }

    /// The use of the block between streets `i`, `i + 1` (constant u) and `j`, `j + 1` (constant v).
    pub(super) fn land_use(&self, i: usize, j: usize) -> Use {
        [Use::Perimeter, Use::Houses, Use::Park, Use::Slabs][(i + 2 * j + self.shift) % 4]
    }

    /// The block a town point lies in, if it is between streets.
    pub(super) fn block(&self, town: DVec2) -> Option<(usize, usize)> {
        let i = self.us.partition_point(|s| s.centre < town.x);
        let j = self.vs.partition_point(|s| s.centre < town.y);
        let inside = i > 0 && j > 0 && i < self.us.len() && j < self.vs.len();
        inside.then(|| (i - 1, j - 1))
    }

    /// Town corners (low, high) of block `(i, j)` behind its pavements.
    pub(super) fn rect(&self, i: usize, j: usize) -> (DVec2, DVec2) {
        let edge = |s: &Street, side: f64| s.centre + side * (s.half + PAVEMENT_M);
        (
            DVec2::new(edge(&self.us[i], 1.0), edge(&self.vs[j], 1.0)),
            DVec2::new(edge(&self.us[i + 1], -1.0), edge(&self.vs[j + 1], -1.0)),
        )
    }
}

/// Streets swing sideways once in 150 m.
const BEND_PER_M: f64 = std::f64::consts::TAU / 150.0;

fn streets(rng: &mut Rng, reach: f64, first: f64) -> Vec<Street> {
    let street =
        |rng: &mut Rng, centre, main: bool| Street { centre, half: if main { 5.4 } else { rng.range(4.3, 4.8) } };
    let mut found = vec![street(rng, first, true)];
    for side in [-1.0, 1.0] {
        let mut centre = first;
        while (centre * side) < reach {
            centre += side * rng.range(60.0, 68.0);
            found.push(street(rng, centre, false));
        }
    }
    found.sort_by(|a, b| a.centre.total_cmp(&b.centre));
    found
}

fn nearest(streets: &[Street], x: f64) -> (usize, f64) {
    let mut best = (0, f64::INFINITY);
    for (i, street) in streets.iter().enumerate() {
        let offset = x - street.centre;
        if offset.abs() < f64::abs(best.1) {
            best = (i, offset);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn town_and_plan_coordinates_are_inverse() {
        let ground = Ground::new(7, 130.0);
        for (x, y) in [(0.0, 0.0), (40.0, -25.0), (-61.0, 13.5)] {
            let p = DVec2::new(x, y);
            assert!(ground.plan(ground.town(p)).distance(p) < 1e-9);
        }
    }

    #[test]
    fn slopes_stay_below_eight_percent_away_from_kerbs() {
        let ground = Ground::new(7, 130.0);
        let mut seen = 0;
        for i in 0..2000 {
            let p = DVec2::new(f64::from(i % 50) * 2.6 - 65.0, f64::from(i / 50) * 3.2 - 64.0);
            if ground.spot(ground.town(p)).kerb_m.abs() < 0.5 {
                continue;
            }
            let slope = DVec2::new(
                ground.height(p + DVec2::X * 0.1) - ground.height(p),
                ground.height(p + DVec2::Y * 0.1) - ground.height(p),
            ) / 0.1;
            assert!(slope.length() < 0.08, "{} at {p}", slope.length());
            seen += 1;
        }
        assert!(seen > 1000);
    }

    #[test]
    fn the_four_blocks_around_a_crossing_are_all_different() {
        let ground = Ground::new(3, 130.0);
        let mut uses = Vec::new();
        for (i, j) in [(1, 1), (1, 2), (2, 1), (2, 2)] {
            let land = ground.land_use(i, j);
            assert!(!uses.contains(&land));
            uses.push(land);
        }
    }
}
