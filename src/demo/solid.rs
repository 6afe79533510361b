//! The things of the city as signed distances: buildings, trees, cars, lamps, walls and hedges.
//!
//! Distances are negative inside, metres, and never larger than the true distance outside (they may be smaller).

use glam::{DVec2, DVec3};

use super::noise::value3;
use crate::ids::ClassId;

/// A place with a heading: local x runs along `x`, local y to its left, local z up from `origin`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame {
    pub(super) origin: DVec3,
    pub(super) x: DVec2,
}

impl Frame {
    pub(super) fn local(&self, p: DVec3) -> DVec3 {
        let d = p - self.origin;
        DVec3::new(self.x.dot(d.truncate()), self.x.perp_dot(d.truncate()), d.z)
    }

    pub(super) fn world(&self, l: DVec3) -> DVec3 {
        self.origin + self.x.rotate(l.truncate()).extend(l.z)
    }
}

/// The shape of a roof above the eaves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Roof {
    /// Flat inside a parapet of this height and thickness.
    Flat { height_m: f64, thickness_m: f64 },
    /// Two planes of this slope (tangent), ridge along local x.
    Gable(f64),
    /// Four planes of one slope (tangent).
    Hip(f64),
    /// One plane rising to +y (tangent).
    Shed(f64),
    /// Steep below, shallow above the break 2.6 m over the eaves.
    Mansard,
}

/// What is fixed to a building.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Chimney,
    Dormer,
    Unit,
    Balcony,
}

/// A box fixed to a building, in its frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fixture {
    pub(super) kind: Kind,
    pub(super) centre: DVec3,
    pub(super) half: DVec3,
}

/// Colours and habits of one building.
#[derive(Debug, Clone, Copy)]
pub(super) struct Style {
    pub(super) seed: u32,
    pub(super) wall: [f32; 3],
    pub(super) roof: [f32; 3],
    pub(super) brick: bool,
    pub(super) shutters: bool,
    pub(super) shop: bool,
    pub(super) band_windows: bool,
    pub(super) solar: bool,
}

/// A box with windows and a roof. Walls are numbered: 0 at -y (the street), 1 at +y, 2 at -x, 3 at +x.
#[derive(Debug, Clone)]
pub(super) struct Building {
    pub(super) frame: Frame,
    pub(super) half: DVec2,
    /// Height of the eaves over the frame's origin.
    pub(super) eave: f64,
    pub(super) roof: Roof,
    pub(super) floors: u32,
    pub(super) floor_m: f64,
    pub(super) bay_m: f64,
    pub(super) windows: [bool; 4],
    /// How deep openings are set into walls, metres.
    pub(super) recess_m: f64,
    pub(super) fixtures: Vec<Fixture>,
    pub(super) style: Style,
}

/// Which of a building's surfaces a point is nearest to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Skin {
    Wall,
    Roof,
    Fixture(u16),
}

/// A window, door or shop front, seen from a point on its wall.
#[derive(Debug, Clone, Copy)]
pub(super) struct Opening {
    /// Offset of the point from the middle of the opening.
    pub(super) at: DVec2,
    pub(super) half: DVec2,
    pub(super) door: bool,
    pub(super) shop: bool,
    /// Which one, for variety.
    pub(super) id: u32,
}

/// Signed distance in the plane to a box of half size `half`.
pub(super) fn box2(p: DVec2, half: DVec2) -> f64 {
    let q = p.abs() - half;
    q.max(DVec2::ZERO).length() + q.max_element().min(0.0)
}

fn box3(p: DVec3, half: DVec3) -> f64 {
    let q = p.abs() - half;
    q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
}

impl Building {
    /// The wall nearest to a local point, and how far outside it the point is.
    pub(super) fn wall_at(&self, l: DVec3) -> (usize, f64) {
        let (dx, dy) = (l.x.abs() - self.half.x, l.y.abs() - self.half.y);
        if dx > dy { (if l.x < 0.0 { 2 } else { 3 }, dx) } else { (if l.y < 0.0 { 0 } else { 1 }, dy) }
    }

    /// The opening whose bay and floor hold a local point of wall `side`.
    pub(super) fn opening(&self, side: usize, l: DVec3) -> Option<Opening> {
        if !self.windows[side] || l.z < -0.3 || l.z > self.eave {
            return None;
        }
        let (along, half) = if side < 2 { (l.x, self.half.x) } else { (l.y, self.half.y) };
        let bays = ((2.0 * half - 0.4) / self.bay_m).floor().max(1.0);
        let pitch = 2.0 * half / bays;
        let bay = ((along + half) / pitch).floor().clamp(0.0, bays - 1.0);
        let floor = (l.z / self.floor_m).floor().max(0.0);
        if floor >= f64::from(self.floors) {
            return None;
        }
        let x = along + half - (bay + 0.5) * pitch;
        let z = l.z - floor * self.floor_m;
        let ground_front = side == 0 && floor == 0.0;
        let door = ground_front && bay as usize == (self.style.seed as usize) % (bays as usize);
        let shop = ground_front && self.style.shop && !door;
        let (middle, half) = match (door, shop) {
            (true, _) => (1.1, DVec2::new(0.6, 1.1)),
            (_, true) => (1.45, DVec2::new(0.42 * pitch, 1.15)),
            // Churches.
            _ if self.floor_m > 5.0 => (0.55 * self.floor_m, DVec2::new(0.65, 0.24 * self.floor_m)),
            _ if self.style.band_windows => (1.65, DVec2::new(0.36 * pitch, 0.75)),
            _ => (1.7, DVec2::new((0.26 * pitch).min(0.68), 0.82)),
        };
        let id = (bay as u32) * 31 + floor as u32 * 7 + side as u32 * 1009;
        Some(Opening { at: DVec2::new(x, z - middle), half, door, shop, id })
    }

    /// Distance to the planes of the roof, positive above them.
    fn over_roof(&self, l: DVec3) -> f64 {
        let up = l.z - self.eave;
        let plane = |inset: f64, slope: f64| (up - inset * slope) / (1.0 + slope * slope).sqrt();
        let (ix, iy) = (self.half.x - l.x.abs(), self.half.y - l.y.abs());
        match self.roof {
            Roof::Flat { .. } => up,
            Roof::Gable(slope) => plane(iy, slope),
            Roof::Hip(slope) => plane(iy, slope).max(plane(ix, slope)),
            Roof::Shed(slope) => plane(l.y + self.half.y, slope),
            Roof::Mansard => {
                const BREAK_M: f64 = 2.6;
                let low = plane(iy, 2.6).max(if self.windows[2] { plane(ix, 2.6) } else { f64::NEG_INFINITY });
                let high = (up - BREAK_M - (iy - BREAK_M / 2.6) * 0.3) / 1.044;
                low.max(high)
            }
        }
    }

    /// Height of the highest point over the frame's origin, without fixtures.
    pub(super) fn ridge(&self) -> f64 {
        let (hx, hy) = (self.half.x, self.half.y);
        self.eave
            + match self.roof {
                Roof::Flat { height_m, .. } => height_m,
                Roof::Gable(slope) => hy * slope,
                Roof::Hip(slope) => hx.min(hy) * slope,
                Roof::Shed(slope) => 2.0 * hy * slope,
                Roof::Mansard => 2.6 + (hy - 1.0) * 0.3,
            }
    }

    /// Distance from a local point, and the surface it is nearest to.
    pub(super) fn distance(&self, l: DVec3) -> (f64, Skin) {
        let plan = box2(l.truncate(), self.half);
        let top = self.over_roof(l);
        let (mut best, mut skin) = if top > plan { (top, Skin::Roof) } else { (plan, Skin::Wall) };
        if let Roof::Flat { height_m, thickness_m } = self.roof {
            let inner = -(plan + thickness_m);
            let ring = plan.max(inner).max(top - height_m);
            if ring < best {
                let outer = plan >= inner && plan >= top - height_m;
                (best, skin) = (ring, if outer { Skin::Wall } else { Skin::Roof });
            }
        }
        if skin == Skin::Wall && best.abs() < 0.8 {
            let (side, outside) = self.wall_at(l);
            if let Some(opening) = self.opening(side, l) {
                let frame = (opening.at.abs() - opening.half).max_element();
                best = best.max((-frame).min(self.recess_m + outside));
            }
        }
        for (i, fixture) in self.fixtures.iter().enumerate() {
            let q = l - fixture.centre;
            let mut d = box3(q, fixture.half);
            if fixture.kind == Kind::Dormer {
                // A small pitched top: the box ends half its width below its highest line.
                d = d.max((q.z - fixture.half.z + 0.7 * q.x.abs()) / 1.22);
            }
            if d < best {
                (best, skin) = (d, Skin::Fixture(i as u16));
            }
        }
        (best, skin)
    }
}

/// A tree: a trunk and a rough crown.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tree {
    /// Where the trunk meets the ground.
    pub(super) foot: DVec3,
    pub(super) height: f64,
    pub(super) radius: f64,
    pub(super) conifer: bool,
    pub(super) seed: u32,
}

impl Tree {
    fn distance(&self, p: DVec3) -> f64 {
        let d = p - self.foot;
        let flat = d.truncate().length();
        let crown = if self.conifer {
            // A cone from 1 m up to the top.
            let slope = self.radius / (self.height - 1.0);
            ((flat - (self.height - d.z) * slope) / (1.0 + slope * slope).sqrt()).max(1.0 - d.z)
        } else {
            let half = 0.5 * (self.height - 1.6);
            let scale = DVec3::new(self.radius, self.radius, half);
            let q = (d - DVec3::Z * (self.height - half)) / scale;
            (q.length() - 1.0) * scale.min_element()
        };
        let trunk = (flat - 0.3 - 0.12 * (2.5 - d.z).max(0.0)).max(d.z - 0.6 * self.height).max(-d.z - 1.0);
        let near = smooth_min(crown, trunk, 0.7);
        if near > 2.2 {
            return 0.5 * (near - 1.1);
        }
        let leaf = 0.75 * value3(p / 2.1, self.seed) + 0.35 * value3(p / 0.9, self.seed);
        // 0.5: the noise steepens the field, this keeps it a lower bound.
        0.5 * (near - f64::from(leaf) * (d.z * 0.5).clamp(0.0, 1.0))
    }
}

/// A car, heading along its frame's x.
#[derive(Debug, Clone, Copy)]
pub(super) struct Car {
    pub(super) frame: Frame,
    pub(super) half: DVec2,
    pub(super) van: bool,
    pub(super) paint: [f32; 3],
}

impl Car {
    fn distance(&self, l: DVec3) -> f64 {
        const ROUND_M: f64 = 0.15;
        let body = DVec3::new(self.half.x - ROUND_M, self.half.y - ROUND_M, 0.5 - ROUND_M);
        let lower = box3(l - DVec3::new(0.0, 0.0, 0.45), body) - ROUND_M;
        let (cx, ch, top) = if self.van { (-0.3, self.half.x - 0.4, 2.05) } else { (-0.25, 0.5 * self.half.x, 1.5) };
        let cabin =
            box3(l - DVec3::new(cx, 0.0, top - 0.5), DVec3::new(ch, self.half.y - 0.3, 0.5 - ROUND_M)) - ROUND_M;
        // Slanted windscreens.
        let slant = ((l.x - cx).abs() - ch - 0.1 + 0.6 * (l.z - 1.0)) / 1.17;
        smooth_min(lower, cabin.max(slant), 0.1)
    }
}

/// What a free-standing box is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Matter {
    Hedge,
    Masonry,
}

/// One thing of the city.
#[derive(Debug, Clone)]
pub(super) enum Shape {
    Building(Building),
    Tree(Tree),
    Car(Car),
    /// A post with a head, foot at the point.
    Lamp {
        foot: DVec3,
        radius: f64,
    },
    /// A hedge or garden wall.
    Fence {
        frame: Frame,
        half: DVec3,
        matter: Matter,
    },
}

/// A shape with a box around it.
#[derive(Debug, Clone)]
pub(super) struct Thing {
    pub(super) shape: Shape,
    pub(super) low: DVec3,
    pub(super) high: DVec3,
}

/// How far below its datum a thing reaches into the ground, metres.
const FOOTING_M: f64 = 3.0;

impl Thing {
    /// Boxes a shape.
    pub(super) fn new(shape: Shape) -> Self {
        let (centre, reach, top) = match &shape {
            Shape::Building(b) => {
                // Balconies and chimneys stand at most 1.6 m out and 3 m up.
                let tallest = b.fixtures.iter().map(|f| f.centre.z + f.half.z).fold(b.ridge(), f64::max);
                (b.frame.origin, turned(b.frame.x, b.half + DVec2::splat(1.6)), tallest)
            }
            Shape::Tree(t) => (t.foot, DVec2::splat(t.radius + 1.2), t.height + 1.2),
            Shape::Car(c) => (c.frame.origin, turned(c.frame.x, c.half), 2.2),
            Shape::Lamp { foot, .. } => (*foot, DVec2::splat(1.0), LAMP_M + 0.5),
            Shape::Fence { frame, half, .. } => (frame.origin, turned(frame.x, half.truncate()), half.z),
        };
        let low = centre - reach.extend(FOOTING_M);
        Self { shape, low, high: centre + reach.extend(top) }
    }

    /// Distance from the box around it; 0 inside.
    pub(super) fn box_distance(&self, p: DVec3) -> f64 {
        (self.low - p).max(p - self.high).max(DVec3::ZERO).length()
    }

    /// Distance and class of the nearest surface.
    pub(super) fn distance(&self, p: DVec3) -> (f64, ClassId) {
        let clutter = |d| (d, ClassId::CLUTTER);
        match &self.shape {
            Shape::Building(b) => {
                let (d, skin) = b.distance(b.frame.local(p));
                let class = match skin {
                    Skin::Wall => ClassId::FACADE,
                    Skin::Fixture(i) if b.fixtures[usize::from(i)].kind == Kind::Balcony => ClassId::FACADE,
                    Skin::Roof | Skin::Fixture(_) => ClassId::ROOF,
                };
                (d, class)
            }
            Shape::Tree(tree) => clutter(tree.distance(p)),
            Shape::Car(car) => clutter(car.distance(car.frame.local(p))),
            Shape::Lamp { foot, radius } => {
                let d = p - *foot;
                let post = (d.truncate().length() - radius).max(d.z - LAMP_M).max(-d.z - 1.0);
                let head = (d - DVec3::Z * LAMP_M).length() - 2.0 * radius;
                clutter(smooth_min(post, head, 0.2))
            }
            Shape::Fence { frame, half, matter } => {
                let l = frame.local(p);
                // Down into the ground, so that slopes leave no gap.
                let d = box2(l.truncate(), half.truncate()).max(l.z - half.z);
                let rough = if *matter == Matter::Hedge && d < 0.5 { 0.18 * value3(p / 0.9, 5) } else { 0.0 };
                clutter(0.8 * (d - f64::from(rough)))
            }
        }
    }
}

/// Height of a lamp's head, metres.
const LAMP_M: f64 = 5.2;

/// Half size of the upright box around a turned one.
fn turned(x: DVec2, half: DVec2) -> DVec2 {
    DVec2::new(x.x.abs() * half.x + x.y.abs() * half.y, x.y.abs() * half.x + x.x.abs() * half.y)
}

/// The smaller of two distances, blended over `k` metres as reconstruction rounds inner corners.
pub(super) fn smooth_min(a: f64, b: f64, k: f64) -> f64 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - h * h * k * 0.25
}
