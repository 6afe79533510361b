//! Lays out the quarter: what stands on each block and along each street.

use glam::{DVec2, DVec3};

use super::ground::{Ground, PAVEMENT_M, Use};
use super::noise::Rng;
use super::solid::{Car, Frame, Matter, Roof, Shape, Style, Thing, Tree, box2};

mod houses;
mod open;
mod town_houses;

/// Sides of a block, in the order they are built.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Side {
    LowV,
    HighV,
    LowU,
    HighU,
}

const PLASTER: [[f32; 3]; 9] = [
    [0.90, 0.86, 0.76],
    [0.86, 0.74, 0.54],
    [0.93, 0.91, 0.87],
    [0.80, 0.78, 0.74],
    [0.85, 0.66, 0.55],
    [0.91, 0.83, 0.62],
    [0.74, 0.79, 0.72],
    [0.78, 0.70, 0.62],
    [0.72, 0.77, 0.82],
];
const TILES: [[f32; 3]; 5] =
    [[0.66, 0.36, 0.26], [0.58, 0.31, 0.22], [0.50, 0.32, 0.25], [0.36, 0.35, 0.37], [0.70, 0.42, 0.30]];
const GRAVEL: [[f32; 3]; 3] = [[0.62, 0.61, 0.58], [0.52, 0.52, 0.52], [0.68, 0.65, 0.60]];
const PAINT: [[f32; 3]; 9] = [
    [0.85, 0.86, 0.87],
    [0.12, 0.13, 0.15],
    [0.55, 0.57, 0.60],
    [0.70, 0.12, 0.12],
    [0.16, 0.28, 0.52],
    [0.32, 0.34, 0.37],
    [0.92, 0.92, 0.90],
    [0.20, 0.36, 0.28],
    [0.78, 0.70, 0.52],
];

/// Collects the things of one city.
pub(super) struct Planner<'a> {
    ground: &'a Ground,
    rng: Rng,
    /// Half the side of the square kept, metres.
    half_m: f64,
    /// Lattice spacing: thin things are made thick enough to be seen by it.
    voxel_m: f64,
    things: Vec<Thing>,
}

/// Everything that stands on the ground, in a fixed order.
pub(super) fn lay_out(ground: &Ground, seed: u64, extent_m: f64, voxel_m: f64) -> Vec<Thing> {
    let rng = Rng::new(seed, 2, 2);
    let mut planner = Planner { ground, rng, half_m: extent_m / 2.0, voxel_m, things: Vec::new() };
    for i in 0..ground.us.len() - 1 {
        for j in 0..ground.vs.len() - 1 {
            planner.rng = Rng::new(seed, 100 + i as i64, 100 + j as i64);
            planner.block(i, j);
        }
    }
    planner.rng = Rng::new(seed, 3, 3);
    planner.streets();
    planner.things
}

impl Planner<'_> {
    fn push(&mut self, shape: Shape) {
        let thing = Thing::new(shape);
        if self.is_inside(&thing) {
            self.things.push(thing);
        }
    }

    /// True for things the border does not cut: cut things would show their hollow inside.
    fn is_inside(&self, thing: &Thing) -> bool {
        let inside = self.half_m - 0.5 * self.voxel_m;
        thing.low.truncate().min_element() > -inside && thing.high.truncate().max_element() < inside
    }

    /// A frame on the ground at a town point, its y axis pointing away from the street on `side`.
    fn frame(&self, town: DVec2, side: Side) -> Frame {
        let x = match side {
            Side::LowV => self.ground.along_u(),
            Side::HighV => -self.ground.along_u(),
            Side::LowU => -self.ground.along_v(town.y),
            Side::HighU => self.ground.along_v(town.y),
        };
        let plan = self.ground.plan(town);
        Frame { origin: plan.extend(self.ground.height(plan)), x }
    }

    /// The same, raised to the highest ground under a footprint.
    fn site(&self, town: DVec2, side: Side, half: DVec2) -> Frame {
        let mut frame = self.frame(town, side);
        for (sx, sy) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
            let corner = frame.world(DVec3::new(sx * half.x, sy * half.y, 0.0)).truncate();
            frame.origin.z = frame.origin.z.max(self.ground.height(corner));
        }
        frame
    }

    /// A point of the ground on a lattice column, so that a thin post or trunk there is not missed.
    fn snapped(&self, town: DVec2) -> DVec3 {
        let low = -(self.half_m / self.voxel_m).floor() * self.voxel_m;
        let steps = ((self.ground.plan(town) - DVec2::splat(low)) / self.voxel_m).round();
        let plan = DVec2::splat(low) + steps * self.voxel_m;
        plan.extend(self.ground.height(plan))
    }

    /// True where no building or fence is within `gap` of a plan point.
    fn is_free(&self, plan: DVec2, gap: f64) -> bool {
        self.things.iter().all(|thing| {
            let (frame, half) = match &thing.shape {
                Shape::Building(b) => (b.frame, b.half),
                Shape::Fence { frame, half, .. } => (*frame, half.truncate()),
                Shape::Car(car) => (car.frame, car.half),
                Shape::Tree(t) => return t.foot.truncate().distance(plan) > gap + 0.5 * t.radius,
                Shape::Lamp { foot, .. } => return foot.truncate().distance(plan) > gap,
            };
            box2(frame.local(plan.extend(0.0)).truncate(), half) > gap
        })
    }

    fn style(&mut self) -> Style {
        let rng = &mut self.rng;
        let brick = rng.chance(0.18);
        let wall = if brick { [0.60, 0.36, 0.28] } else { PLASTER[rng.below(PLASTER.len())] };
        Style {
            seed: rng.bits() as u32,
            wall,
            roof: TILES[rng.below(TILES.len())],
            brick,
            shutters: rng.chance(0.25),
            shop: false,
            band_windows: false,
            solar: rng.chance(0.16),
        }
    }

    /// Windows are 25 cm deep; a lattice too coarse for them would turn them into dents, so it sees less.
    fn recess_m(&self) -> f64 {
        0.25 * ((1.0 - self.voxel_m) / 0.5).clamp(0.2, 1.0)
    }

    fn flat(&self, height_m: f64) -> Roof {
        Roof::Flat { height_m, thickness_m: (1.3 * self.voxel_m).max(0.4) }
    }

    fn block(&mut self, i: usize, j: usize) {
        let (low, high) = self.ground.rect(i, j);
        match self.ground.land_use(i, j) {
            Use::Perimeter => self.perimeter(low, high),
            Use::Houses => self.houses(low, high),
            Use::Slabs => self.slabs(low, high),
            Use::Park => self.park(low, high),
        }
    }

    fn tree(&mut self, town: DVec2, low: f64, high: f64, conifers: f64) {
        let height = self.rng.range(low, high);
        let conifer = self.rng.chance(conifers);
        let radius = height * if conifer { 0.26 } else { self.rng.range(0.32, 0.42) };
        let seed = self.rng.bits() as u32;
        let foot = self.snapped(town);
        if self.is_free(foot.truncate(), 0.75 * radius) {
            self.push(Shape::Tree(Tree { foot, height, radius, conifer, seed }));
        }
    }

    fn car(&mut self, town: DVec2, side: Side) {
        let half = DVec2::new(self.rng.range(2.0, 2.35), self.rng.range(0.86, 0.95));
        let (van, paint) = (self.rng.chance(0.12), PAINT[self.rng.below(PAINT.len())]);
        let frame = self.frame(town, side);
        if self.is_free(frame.origin.truncate(), 1.2) {
            self.push(Shape::Car(Car { frame, half, van, paint }));
        }
    }

    fn fence(&mut self, town: DVec2, side: Side, length: f64, matter: Matter) {
        let height = if matter == Matter::Hedge { 1.5 } else { 1.3 };
        let thick = (0.58 * self.voxel_m).max(0.15);
        let pieces = (length / 4.0).ceil().max(1.0);
        // In pieces that follow the slope and the bend of the street.
        for n in 0..pieces as usize {
            let offset = ((n as f64 + 0.5) / pieces * 2.0 - 1.0) * length;
            let along = if matches!(side, Side::LowV | Side::HighV) { DVec2::X } else { DVec2::Y };
            let frame = self.frame(town + along * offset, side);
            let half = DVec3::new(length / pieces + 0.2, thick, height);
            self.push(Shape::Fence { frame, half, matter });
        }
    }

    /// Cars, lamps and trees along all streets.
    fn streets(&mut self) {
        let reach = self.half_m * 1.45;
        for along_v in [true, false] {
            let (own, cross) =
                if along_v { (&self.ground.us, &self.ground.vs) } else { (&self.ground.vs, &self.ground.us) };
            for (index, street) in own.iter().enumerate() {
                let trees = index % 2 == 1;
                let mut at = -reach;
                while at < reach {
                    at += 6.2;
                    let gap = cross.iter().map(|c| (at - c.centre).abs() - c.half).fold(f64::INFINITY, f64::min);
                    if gap > PAVEMENT_M + 1.5 {
                        self.street_slice(along_v, street.centre, street.half, at, trees);
                    }
                }
            }
        }
    }

    fn street_slice(&mut self, along_v: bool, centre: f64, half: f64, at: f64, trees: bool) {
        let town = |across: f64, along: f64| {
            if along_v { DVec2::new(centre + across, along) } else { DVec2::new(along, centre + across) }
        };
        let headings = if along_v { [Side::HighU, Side::LowU] } else { [Side::HighV, Side::LowV] };
        for (sign, heading) in [(-1.0, headings[1]), (1.0, headings[0])] {
            if self.rng.chance(0.55) {
                self.car(town(sign * (half - 1.05), at), heading);
            }
            if self.rng.chance(0.05) {
                self.car(town(sign * 1.5, at + 1.0), heading);
            }
            if trees && self.rng.chance(0.55) {
                self.tree(town(sign * (half + 0.9), at + 3.0), 4.0, 5.5, 0.0);
            }
        }
        let slot = (at / 6.2).round() as i64;
        if slot.rem_euclid(4) == 0 {
            let sign = if slot.rem_euclid(8) == 0 { 1.0 } else { -1.0 };
            let foot = self.snapped(town(sign * (half + 0.6), at));
            if self.is_free(foot.truncate(), 1.0) {
                self.push(Shape::Lamp { foot, radius: (0.3 * self.voxel_m).min(0.2) });
            }
        }
    }
}
