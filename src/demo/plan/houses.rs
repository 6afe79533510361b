//! Detached houses in gardens.

use glam::{DVec2, DVec3};

use super::{GRAVEL, Planner, Side};
use crate::demo::solid::{Building, Matter, Roof, Shape};

impl Planner<'_> {
    pub(super) fn houses(&mut self, low: DVec2, high: DVec2) {
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

    pub(super) fn shed(&mut self, town: DVec2, side: Side, half: DVec2, eave: f64) {
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
}
