//! Lays out the quarter: what stands on each block and along each street.

use glam::{DVec2, DVec3};

use super::ground::{Ground, PAVEMENT_M, Use};
use super::noise::Rng;
use super::solid::{Building, Car, Fixture, Frame, Kind, Matter, Roof, Shape, Style, Thing, Tree, box2};

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

    // ---- attached town houses around a yard

    fn perimeter(&mut self, low: DVec2, high: DVec2) {
        let depth = self.rng.range(10.5, 12.0);
        for side in [Side::LowV, Side::HighV, Side::LowU, Side::HighU] {
            let corners = matches!(side, Side::LowV | Side::HighV);
            let (from, to) = if corners { (low.x, high.x) } else { (low.y + depth, high.y - depth) };
            let lots = ((to - from) / 12.5).round().max(1.0);
            let width = (to - from) / lots;
            for n in 0..lots as usize {
                let along = from + (n as f64 + 0.5) * width;
                let town = match side {
                    Side::LowV => DVec2::new(along, low.y + depth / 2.0),
                    Side::HighV => DVec2::new(along, high.y - depth / 2.0),
                    Side::LowU => DVec2::new(low.x + depth / 2.0, along),
                    Side::HighU => DVec2::new(high.x - depth / 2.0, along),
                };
                let first = n == 0 && corners;
                let last = n + 1 == lots as usize && corners;
                // The frames of opposite sides run against each other.
                let ends = if matches!(side, Side::LowV | Side::HighU) { [first, last] } else { [last, first] };
                self.town_house(town, side, DVec2::new(width / 2.0 + 0.05, depth / 2.0), ends);
            }
        }
        let middle = (low + high) / 2.0;
        let yard = (high - low) / 2.0 - DVec2::splat(depth + 2.5);
        for n in 0..3 {
            let at = middle + DVec2::new(yard.x * (n as f64 - 1.0) * 0.8, yard.y * self.rng.range(-0.2, 0.2));
            if n != 1 {
                self.shed(at, Side::LowV, DVec2::new(2.6, 1.9), 2.6);
            }
        }
        for _ in 0..9 {
            let at = middle + yard * DVec2::new(self.rng.range(-0.9, 0.9), self.rng.range(-0.9, 0.9));
            self.tree(at, 5.0, 9.0, 0.1);
        }
        self.fence(middle - DVec2::new(0.0, yard.y * 0.4), Side::LowU, yard.y * 0.5, Matter::Masonry);
    }

    fn town_house(&mut self, town: DVec2, side: Side, half: DVec2, ends: [bool; 2]) {
        let corner = ends[0] || ends[1];
        let mut style = self.style();
        style.shop = self.rng.chance(0.4);
        let floors = 3 + self.rng.below(3) as u32;
        let floor_m = self.rng.range(2.95, 3.3);
        let eave = f64::from(floors) * floor_m + 0.5;
        let pick = self.rng.unit();
        let roof = match (pick, corner) {
            (p, _) if p < 0.22 => self.flat(0.8),
            (p, false) if p < 0.42 => Roof::Mansard,
            (_, true) => Roof::Hip(self.rng.range(0.65, 0.85)),
            _ => Roof::Gable(self.rng.range(0.7, 0.95)),
        };
        let frame = self.site(town, side, half);
        let windows = [true, true, ends[0], ends[1]];
        let bay_m = self.rng.range(2.4, 3.0);
        let mut house = Building {
            frame,
            half,
            eave,
            roof,
            floors,
            floor_m,
            bay_m,
            windows,
            recess_m: self.recess_m(),
            fixtures: Vec::new(),
            style,
        };
        match roof {
            Roof::Flat { .. } => self.roof_units(&mut house),
            _ => {
                self.chimneys(&mut house, 2);
                if !corner || matches!(roof, Roof::Hip(_)) && half.x > 5.5 {
                    self.dormers(&mut house);
                }
            }
        }
        if self.rng.chance(0.35) {
            self.balconies(&mut house, 1.0, 1);
        }
        self.set_roof_colour(&mut house);
        self.push(Shape::Building(house));
    }

    fn set_roof_colour(&mut self, house: &mut Building) {
        match house.roof {
            Roof::Flat { .. } => house.style.roof = GRAVEL[self.rng.below(GRAVEL.len())],
            Roof::Mansard => house.style.roof = [0.38, 0.39, 0.42],
            _ => {}
        }
    }

    fn roof_units(&mut self, house: &mut Building) {
        for n in 0..1 + self.rng.below(3) {
            let half = if n == 0 { DVec3::new(1.6, 1.4, 1.25) } else { DVec3::new(1.1, 0.8, 0.65) };
            let room = (house.half - half.truncate() - DVec2::splat(1.8)).max(DVec2::ZERO);
            let at = room * DVec2::new(self.rng.range(-1.0, 1.0), self.rng.range(-1.0, 1.0));
            house.fixtures.push(Fixture { kind: Kind::Unit, centre: at.extend(house.eave + half.z - 0.1), half });
        }
    }

    fn chimneys(&mut self, house: &mut Building, most: usize) {
        let thick = (0.75 * self.voxel_m).max(0.4);
        for n in 0..1 + self.rng.below(most) {
            let x = (if n == 0 { 0.6 } else { -0.7 }) * (house.half.x - 1.0);
            let top = house.ridge() + 0.9;
            let half = DVec3::new(thick, thick, (top - house.eave) / 2.0);
            let y = self.rng.range(0.15, 0.3) * house.half.y;
            house.fixtures.push(Fixture { kind: Kind::Chimney, centre: DVec3::new(x, y, house.eave + half.z), half });
        }
    }

    fn dormers(&mut self, house: &mut Building) {
        let bays = ((2.0 * house.half.x - 0.4) / house.bay_m).floor().max(1.0);
        let pitch = 2.0 * house.half.x / bays;
        for bay in 0..bays as usize {
            // Every second bay, in line with the windows below.
            if bay % 2 == 0 && bays > 2.0 {
                continue;
            }
            let x = (bay as f64 + 0.5) * pitch - house.half.x;
            let half = DVec3::new(0.95, 1.7, 1.35);
            for y in [-1.0, 1.0] {
                let inset = if house.roof == Roof::Mansard { 0.35 } else { 1.0 };
                let centre = DVec3::new(x, y * (house.half.y - half.y - inset), house.eave + half.z - 0.1);
                house.fixtures.push(Fixture { kind: Kind::Dormer, centre, half });
            }
        }
    }

    /// Balconies on the wall at `y` = +1 (yard) or -1 (street), on every `step`-th bay above the ground floor.
    fn balconies(&mut self, house: &mut Building, y: f64, step: usize) {
        let bays = ((2.0 * house.half.x - 0.4) / house.bay_m).floor().max(1.0);
        let pitch = 2.0 * house.half.x / bays;
        for bay in (step.min(bays as usize - 1)..bays as usize).step_by(step + 1) {
            for floor in 1..house.floors {
                let x = (bay as f64 + 0.5) * pitch - house.half.x;
                let z = f64::from(floor) * house.floor_m + 0.4;
                let half = DVec3::new(0.46 * pitch, 1.1, 0.55);
                let centre = DVec3::new(x, y * (house.half.y + 0.1), z);
                house.fixtures.push(Fixture { kind: Kind::Balcony, centre, half });
            }
        }
    }

    // ---- detached houses in gardens

    fn houses(&mut self, low: DVec2, high: DVec2) {
        let lots = ((high.x - low.x) / 16.5).round().max(1.0);
        let width = (high.x - low.x) / lots;
        let depth = (high.y - low.y) / 2.0;
        for (side, out) in [(Side::LowV, -1.0), (Side::HighV, 1.0)] {
            for n in 0..lots as usize {
                let u = low.x + (n as f64 + 0.5) * width;
                let edge = if out < 0.0 { low.y } else { high.y };
                self.house_lot(DVec2::new(u, edge), side, -out, width, depth);
            }
        }
        let middle = (low.y + high.y) / 2.0;
        self.fence(DVec2::new((low.x + high.x) / 2.0, middle), Side::LowV, (high.x - low.x) / 2.0, Matter::Hedge);
    }

    /// One lot whose street edge is at `edge`; `inward` is the sign of v away from the street.
    fn house_lot(&mut self, edge: DVec2, side: Side, inward: f64, width: f64, depth: f64) {
        let half = DVec2::new(self.rng.range(4.3, 5.3), self.rng.range(4.0, 4.8));
        let set_back = self.rng.range(4.5, 6.0);
        let into = |x: f64, y: f64| edge + DVec2::new(x, inward * y);
        let left = -0.5 * width + 0.6 + half.x;
        let floors = 1 + self.rng.below(2) as u32;
        let eave = f64::from(floors) * 2.8 + 0.6;
        let turn = self.rng.chance(0.4);
        let roof = match self.rng.below(4) {
            0 => Roof::Hip(self.rng.range(0.6, 0.8)),
            1 => Roof::Shed(0.25),
            _ => Roof::Gable(self.rng.range(0.75, 1.0)),
        };
        let town = into(left + 0.6, set_back + half.y);
        let mut frame = self.site(town, side, half);
        let mut style = self.style();
        style.solar |= roof == Roof::Shed(0.25);
        let mut half = half;
        if turn {
            frame.x = frame.x.perp();
            half = DVec2::new(half.y, half.x);
        }
        let windows = [true; 4];
        let mut house = Building {
            frame,
            half,
            eave,
            roof,
            floors,
            floor_m: 2.8,
            bay_m: self.rng.range(2.6, 3.2),
            windows,
            recess_m: self.recess_m(),
            fixtures: Vec::new(),
            style,
        };
        self.chimneys(&mut house, 1);
        if matches!(roof, Roof::Gable(s) if s > 0.85) {
            self.dormers(&mut house);
        }
        let wing = self.rng.chance(0.4);
        if wing {
            self.wing(&house);
        }
        self.push(Shape::Building(house));
        let garage = into(0.5 * width - 2.3, set_back + 5.5);
        self.shed(garage, side, DVec2::new(1.9, 3.1), 2.7);
        if self.rng.chance(0.6) {
            self.car(into(0.5 * width - 2.3, set_back - 0.8), if inward > 0.0 { Side::LowU } else { Side::HighU });
        }
        self.fence(into(-0.5 * width, depth * 0.62), Side::LowU, depth * 0.37, Matter::Hedge);
        let front = if self.rng.chance(0.5) { Matter::Hedge } else { Matter::Masonry };
        self.fence(into(-2.4, 0.5), side, 0.5 * width - 2.6, front);
        for _ in 0..4 {
            let at = into(self.rng.range(-0.4, 0.4) * width, self.rng.range(0.62, 0.93) * depth);
            self.tree(at, 3.5, 7.5, 0.25);
        }
    }

    /// The smaller arm of an L, behind a house.
    fn wing(&mut self, house: &Building) {
        let half = DVec2::new(2.6, 3.0);
        let mut frame = house.frame;
        frame.origin = frame.world(DVec3::new(house.half.x - half.x, house.half.y + half.y - 1.0, 0.0));
        frame.x = frame.x.perp();
        let roof = match house.roof {
            Roof::Gable(s) | Roof::Hip(s) => Roof::Gable(s),
            _ => self.flat(0.4),
        };
        let eave = if house.floors == 1 { house.eave } else { house.eave - 2.8 };
        let floors = house.floors.min(if house.floors == 1 { 1 } else { house.floors - 1 });
        let half = DVec2::new(half.y, half.x);
        self.push(Shape::Building(Building { frame, half, eave, roof, floors, fixtures: Vec::new(), ..house.clone() }));
    }

    fn shed(&mut self, town: DVec2, side: Side, half: DVec2, eave: f64) {
        let mut style = self.style();
        style.brick = false;
        style.roof = GRAVEL[self.rng.below(GRAVEL.len())];
        let (frame, roof) = (self.site(town, side, half), Roof::Shed(0.06));
        let windows = [true, false, false, false];
        let fixtures = Vec::new();
        self.push(Shape::Building(Building {
            frame,
            half,
            eave,
            roof,
            floors: 1,
            floor_m: 2.6,
            bay_m: 3.5,
            windows,
            recess_m: self.recess_m(),
            fixtures,
            style,
        }));
    }

    // ---- slabs and a car park

    fn slabs(&mut self, low: DVec2, high: DVec2) {
        let size = high - low;
        for (n, v) in [low.y + 7.5, high.y - 7.5].into_iter().enumerate() {
            let half = DVec2::new(size.x * self.rng.range(0.34, 0.4), 6.2);
            let town = DVec2::new(low.x + half.x + self.rng.range(1.5, size.x - 2.0 * half.x - 1.5), v);
            let side = if n == 0 { Side::LowV } else { Side::HighV };
            let mut style = self.style();
            style.wall = [[0.86, 0.86, 0.84], [0.80, 0.76, 0.68]][n];
            (style.brick, style.shutters, style.band_windows) = (false, false, true);
            let floors = 3 + 2 * n as u32 + self.rng.below(2) as u32;
            let (eave, roof) = (f64::from(floors) * 3.0 + 0.5, self.flat(0.8));
            let frame = self.site(town, side, half);
            let mut slab = Building {
                frame,
                half,
                eave,
                roof,
                floors,
                floor_m: 3.0,
                bay_m: 3.3,
                windows: [true; 4],
                recess_m: self.recess_m(),
                fixtures: Vec::new(),
                style,
            };
            for _ in 0..2 {
                self.roof_units(&mut slab);
            }
            self.balconies(&mut slab, 1.0, 1);
            self.set_roof_colour(&mut slab);
            self.push(Shape::Building(slab));
        }
        // Two rows of bays, see `paint::ground`.
        let middle = (low.y + high.y) / 2.0;
        let bays = ((size.x - 8.0) / 2.6) as usize;
        for n in 0..bays {
            let u = low.x + 4.0 + (n as f64 + 0.5) * 2.6;
            for (v, side) in [(middle - 5.5, Side::LowU), (middle + 5.5, Side::HighU)] {
                if self.rng.chance(0.6) {
                    self.car(DVec2::new(u, v), side);
                }
            }
        }
        for n in 0..6 {
            let at = DVec2::new(low.x + (n as f64 + 0.5) / 6.0 * size.x, low.y + size.y * 0.5 + 10.5);
            self.tree(at, 5.0, 8.0, 0.0);
            self.tree(at - DVec2::new(0.0, 20.0), 4.0, 7.0, 0.0);
            self.tree(DVec2::new(at.x, low.y + 0.5), 4.0, 6.0, 0.3);
        }
    }

    // ---- park

    fn park(&mut self, low: DVec2, high: DVec2) {
        let size = high - low;
        let at = |x: f64, y: f64| low + size * DVec2::new(x, y);
        self.church(at(0.30, 0.62));
        for (x, y) in [(0.84, 0.16), (0.90, 0.62)] {
            let half = DVec2::splat(2.1);
            let mut style = self.style();
            (style.wall, style.roof, style.shop) = ([0.30, 0.42, 0.36], [0.36, 0.46, 0.42], true);
            (style.brick, style.solar) = (false, false);
            let frame = self.site(at(x, y), Side::LowV, half);
            self.push(Shape::Building(Building {
                frame,
                half,
                eave: 2.9,
                roof: Roof::Hip(0.45),
                floors: 1,
                floor_m: 2.9,
                bay_m: 3.0,
                windows: [true; 4],
                recess_m: self.recess_m(),
                fixtures: Vec::new(),
                style,
            }));
        }
        for n in 0..34 {
            let edge = n % 2 == 0;
            let (x, y) = (self.rng.range(0.04, 0.96), self.rng.range(0.05, 0.95));
            let (x, y) = if edge { (x, if y < 0.5 { 0.05 } else { 0.95 }) } else { (x, y) };
            // Keep the cross of paths clear, see `paint::ground`.
            if (x - 0.5).abs() * size.x > 3.5 && (y - 0.35).abs() * size.y > 3.5 {
                self.tree(at(x, y), 5.5, 11.0, 0.2);
            }
        }
    }

    fn church(&mut self, town: DVec2) {
        let mut style = self.style();
        (style.wall, style.brick, style.shutters, style.solar) = ([0.84, 0.80, 0.70], false, false, false);
        style.roof = TILES[1];
        let half = DVec2::new(11.0, 5.0);
        let frame = self.site(town, Side::LowV, half);
        let nave = Building {
            frame,
            half,
            eave: 8.0,
            roof: Roof::Gable(1.25),
            floors: 1,
            floor_m: 8.0,
            bay_m: 3.6,
            windows: [true; 4],
            recess_m: self.recess_m(),
            fixtures: Vec::new(),
            style,
        };
        let mut tower = Building { half: DVec2::splat(3.0), eave: 17.0, roof: Roof::Hip(2.7), ..nave.clone() };
        (tower.floors, tower.floor_m, tower.bay_m, tower.style.roof) = (3, 5.6, 4.0, [0.34, 0.46, 0.42]);
        tower.frame.origin = frame.world(DVec3::new(-half.x - 1.5, 0.0, 0.0));
        // Both or none: a border must not leave a tower alone.
        let [nave, tower] = [nave, tower].map(|b| Thing::new(Shape::Building(b)));
        if self.is_inside(&nave) && self.is_inside(&tower) {
            self.things.extend([nave, tower]);
        }
    }

    // ---- small things

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
