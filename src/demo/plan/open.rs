//! Slabs with a car park, and a park with a church.

use glam::{DVec2, DVec3};

use super::{Planner, Side, TILES};
use crate::demo::solid::{Building, Roof, Shape, Thing};

impl Planner<'_> {
    pub(super) fn slabs(&mut self, low: DVec2, high: DVec2) {
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

    pub(super) fn park(&mut self, low: DVec2, high: DVec2) {
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
}
