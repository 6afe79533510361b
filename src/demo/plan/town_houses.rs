//! Attached town houses around a yard.

use glam::{DVec2, DVec3};

use super::{GRAVEL, Planner, Side};
use crate::demo::solid::{Building, Fixture, Kind, Matter, Roof, Shape};

impl Planner<'_> {
    pub(super) fn perimeter(&mut self, low: DVec2, high: DVec2) {
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

    pub(super) fn set_roof_colour(&mut self, house: &mut Building) {
        match house.roof {
            Roof::Flat { .. } => house.style.roof = GRAVEL[self.rng.below(GRAVEL.len())],
            Roof::Mansard => house.style.roof = [0.38, 0.39, 0.42],
            _ => {}
        }
    }

    pub(super) fn roof_units(&mut self, house: &mut Building) {
        for n in 0..1 + self.rng.below(3) {
            let half = if n == 0 { DVec3::new(1.6, 1.4, 1.25) } else { DVec3::new(1.1, 0.8, 0.65) };
            let room = (house.half - half.truncate() - DVec2::splat(1.8)).max(DVec2::ZERO);
            let at = room * DVec2::new(self.rng.range(-1.0, 1.0), self.rng.range(-1.0, 1.0));
            house.fixtures.push(Fixture { kind: Kind::Unit, centre: at.extend(house.eave + half.z - 0.1), half });
        }
    }

    pub(super) fn chimneys(&mut self, house: &mut Building, most: usize) {
        let thick = (0.75 * self.voxel_m).max(0.4);
        for n in 0..1 + self.rng.below(most) {
            let x = (if n == 0 { 0.6 } else { -0.7 }) * (house.half.x - 1.0);
            let top = house.ridge() + 0.9;
            let half = DVec3::new(thick, thick, (top - house.eave) / 2.0);
            let y = self.rng.range(0.15, 0.3) * house.half.y;
            house.fixtures.push(Fixture { kind: Kind::Chimney, centre: DVec3::new(x, y, house.eave + half.z), half });
        }
    }

    pub(super) fn dormers(&mut self, house: &mut Building) {
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
    pub(super) fn balconies(&mut self, house: &mut Building, y: f64, step: usize) {
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
}
