//! Holes as a flight would see them: where a tile is open and the surface it stands for is not, and the other way round.

use std::cell::OnceCell;

use glam::DVec3;
use serde::Serialize;

use crate::draw::holes::{Hole, HoleConfig, Holes};
use crate::draw::raster::Seen;
use crate::draw::view::{View, flight};
use crate::geo::Aabb;
use crate::geo::bvh::Bvh;
use crate::measure::Surface;

/// Views of a tile.
const VIEWS: u32 = 6;
/// Of each view.
const SIZE_PX: [u32; 2] = [320, 240];
/// Smaller openings are the edges of pixels.
const LEAST_PX: u64 = 6;
/// No rim is wider: beyond that the error is larger than what is looked for.
const MOST_RIM_PX: u32 = 40;

/// The largest opening.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Opening {
    /// Area across the line of sight, m².
    pub area_m2: f64,
    /// A place in it, on the other surface, local frame.
    pub local_m: [f64; 3],
    /// Openings in the view that shows the largest.
    pub count: usize,
}

/// Openings of a tile, and of what is below it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Openings {
    /// In the tile, where the finer surface is closed.
    pub in_tile: Option<Opening>,
    /// In the finer surface, where the tile is closed.
    pub in_finer: Option<Opening>,
}

/// A look at a tile from all around, and at its reference, part by part.
pub struct Look {
    views: Vec<View>,
    finer: Vec<Layers>,
    faces: u32,
}

/// The reference in one view.
struct Layers {
    seen: Seen,
    /// Of the face at each pixel the middle.
    middle: Vec<DVec3>,
}

impl Look {
    /// Will look at what lies in `aabb`.
    pub fn over(aabb: Aabb) -> Self {
        let views: Vec<View> = flight(&corners(aabb), VIEWS, SIZE_PX);
        let nothing = |view: &View| {
            let seen = Seen::of(view, &[], &[]);
            Layers { middle: vec![DVec3::ZERO; seen.faces().len()], seen }
        };
        Self { finer: views.iter().map(nothing).collect(), views, faces: 0 }
    }

    /// Adds a part of the reference.
    pub fn add(&mut self, part: &Surface) {
        for layers in &mut self.finer {
            let seen = Seen::of(layers.seen.view(), &part.positions, &part.faces);
            for pixel in layers.seen.merge(&seen, self.faces) {
                layers.middle[pixel] = middle(part, seen.faces()[pixel]);
            }
        }
        self.faces = self.faces.saturating_add(part.faces.len() as u32);
    }

    /// Compares the tile with what was added; outlines may differ by `error_m`.
    pub fn openings(&self, tile: &Surface, error_m: f64) -> Openings {
        let mut found = Openings::default();
        let tree = OnceCell::new();
        for (view, finer) in self.views.iter().zip(&self.finer) {
            let seen = Seen::of(view, &tile.positions, &tile.faces);
            let is_open = |hole: &Hole| {
                // The nearest of the tile, to be made only if there is anything to ask.
                let bvh = tree.get_or_init(|| Bvh::new(&tile.positions, &tile.faces));
                is_wide(hole, &finer.seen, &seen, bvh, error_m)
            };
            let in_tile = opening(view, &finer.seen, &seen, error_m, &is_open, &|pixel, _| finer.middle[pixel]);
            let in_finer = opening(view, &seen, &finer.seen, error_m, &|_| true, &|_, face| middle(tile, face));
            found.in_tile = larger(found.in_tile, in_tile);
            found.in_finer = larger(found.in_finer, in_finer);
        }
        found
    }
}

fn middle(of: &Surface, face: u32) -> DVec3 {
    let corners = of.faces.get(face as usize).map(|face| face.map(|v| of.positions[v as usize]));
    corners.map_or(DVec3::ZERO, |[a, b, c]| (a + b + c) / 3.0)
}

fn corners(aabb: Aabb) -> Vec<DVec3> {
    let ends = [aabb.min, aabb.max];
    (0..8).map(|i: usize| DVec3::new(ends[i & 1].x, ends[i >> 1 & 1].y, ends[i >> 2].z)).collect()
}

fn opening(
    view: &View,
    closed: &Seen,
    open: &Seen,
    error_m: f64,
    is_open: &dyn Fn(&Hole) -> bool,
    place: &dyn Fn(usize, u32) -> DVec3,
) -> Option<Opening> {
    let depth_m = (0..closed.faces().len()).filter_map(|i| closed.depth_m(i)).fold(f64::INFINITY, f64::min);
    let px = error_m / view.m_per_px(depth_m);
    let rim_px = if px.is_finite() { (px.ceil() as u32).saturating_add(1).min(MOST_RIM_PX) } else { MOST_RIM_PX };
    let holes = Holes::of(closed, open, &HoleConfig { behind_m: f64::INFINITY, rim_px });
    let counted: Vec<_> = holes.holes.iter().filter(|hole| hole.px >= LEAST_PX && is_open(hole)).collect();
    let largest = counted.first()?;
    let pixel = (largest.at_px[1] * view.size_px()[0] + largest.at_px[0]) as usize;
    let local_m = place(pixel, largest.face).to_array();
    Some(Opening { area_m2: largest.area_m2, local_m, count: counted.len() })
}

/// True if something in the hole is further from the other surface than half a pixel, or than outlines may differ: where
/// two rims lie side by side at a slant, whole rows of pixels fall between them and nothing is missing.
fn is_wide(hole: &Hole, closed: &Seen, open: &Seen, other: &Bvh, error_m: f64) -> bool {
    let view = closed.view();
    let [width, height] = view.size_px().map(|side| side as usize);
    let is_missing = |i: usize| closed.depth_m(i).filter(|_| open.depth_m(i).is_none());
    let mut is_done = vec![false; width * height];
    let mut todo = vec![hole.at_px[1] as usize * width + hole.at_px[0] as usize];
    while let Some(i) = todo.pop() {
        if std::mem::replace(&mut is_done[i], true) {
            continue;
        }
        let Some(depth_m) = is_missing(i) else { continue };
        let (x, y) = (i % width, i / width);
        let m_per_px = view.m_per_px(depth_m);
        let limit_m = error_m.max(0.5 * m_per_px);
        if other.closest(seen_at(view, [x, y], depth_m), limit_m).is_none() {
            return true;
        }
        todo.extend((x > 0).then(|| i - 1));
        todo.extend((x + 1 < width).then_some(i + 1));
        todo.extend((y > 0).then(|| i - width));
        todo.extend((y + 1 < height).then_some(i + width));
    }
    false
}

/// The point in the middle of a pixel at this depth.
fn seen_at(view: &View, [x, y]: [usize; 2], depth_m: f64) -> DVec3 {
    let [width, height] = view.size_px().map(f64::from);
    let (right_px, up_px) = (x as f64 + 0.5 - width / 2.0, height / 2.0 - y as f64 - 0.5);
    view.eye() + view.forward() * depth_m + (view.right() * right_px + view.up() * up_px) * view.m_per_px(depth_m)
}

fn larger(a: Option<Opening>, b: Option<Opening>) -> Option<Opening> {
    match (a, b) {
        (Some(a), Some(b)) => Some(if b.area_m2 > a.area_m2 { b } else { a }),
        (a, b) => a.or(b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A floor of 20 m by 20 m in squares of a metre, without those that `is_left_out` says.
    fn floor(is_left_out: impl Fn(u32, u32) -> bool) -> Surface {
        let mut surface = Surface::default();
        for i in 0..21 * 21 {
            surface.positions.push(DVec3::new(f64::from(i % 21), f64::from(i / 21), 0.0));
        }
        for (x, y) in (0..400).map(|i| (i % 20, i / 20)).filter(|&(x, y)| !is_left_out(x, y)) {
            let a = y * 21 + x;
            surface.faces.extend([[a, a + 1, a + 22], [a, a + 22, a + 21]]);
        }
        surface
    }

    fn look(finer: &Surface, tile: &Surface) -> Openings {
        let mut look = Look::over(Aabb::of(finer.positions.iter().copied()));
        look.add(finer);
        look.openings(tile, 0.02)
    }

    #[test]
    fn a_hole_of_a_metre_is_found_where_it_is_and_one_on_the_other_side_too() {
        let (whole, torn) = (floor(|_, _| false), floor(|x, y| (x, y) == (7, 12)));
        let found = look(&whole, &torn).in_tile.expect("a hole");
        assert!((0.2..1.5).contains(&found.area_m2), "{found:?}");
        let at = DVec3::from_array(found.local_m);
        assert!((at - DVec3::new(7.5, 12.5, 0.0)).length() < 1.0, "{found:?}");
        assert!(look(&torn, &whole).in_finer.is_some());
        assert_eq!(look(&whole, &whole), Openings::default());
    }

    #[test]
    fn a_rim_that_lies_beside_another_is_no_hole() {
        let whole = floor(|_, _| false);
        let mut inset = whole.clone();
        // Less than half a pixel of these views, and more than outlines may differ.
        inset.positions.iter_mut().filter(|p| p.y < 0.5).for_each(|p| p.y += 0.03);
        assert_eq!(look(&whole, &inset).in_tile, None);
    }

    #[test]
    fn a_pixel_is_where_the_view_says() {
        let whole = floor(|_, _| false);
        let corners = corners(Aabb::of(whole.positions.iter().copied()));
        let view = flight(&corners, 3, SIZE_PX)[1];
        let seen = Seen::of(&view, &whole.positions, &whole.faces);
        let mut asked = 0;
        for i in (0..seen.faces().len()).step_by(97) {
            let Some(depth_m) = seen.depth_m(i) else { continue };
            let at = seen_at(&view, [i % SIZE_PX[0] as usize, i / SIZE_PX[0] as usize], depth_m);
            assert!(at.z.abs() < 1e-2 && (-0.1..20.1).contains(&at.x), "{at}");
            asked += 1;
        }
        assert!(asked > 50, "{asked}");
    }
}
