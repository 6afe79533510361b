//! Holes as a flight would see them: where a tile is open and the surface it stands for is not, and the other way round.

use serde::Serialize;

use super::cover::Shown;
use crate::draw::holes::{HoleConfig, Holes};
use crate::draw::raster::Seen;
use crate::draw::view::{View, flight};

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

/// Looks at `shown` and `reference` from all around; outlines may differ by `error_m`.
pub fn of(shown: &Shown, reference: &Shown, error_m: f64) -> Openings {
    let corners = corners(shown.aabb.union(reference.aabb));
    let mut found = Openings::default();
    for view in flight(&corners, VIEWS, SIZE_PX) {
        let tile = Seen::of(&view, &shown.surface.positions, &shown.surface.faces);
        let finer = Seen::of(&view, &reference.surface.positions, &reference.surface.faces);
        found.in_tile = larger(found.in_tile, opening(&view, &finer, &tile, reference, error_m));
        found.in_finer = larger(found.in_finer, opening(&view, &tile, &finer, shown, error_m));
    }
    found
}

fn corners(aabb: crate::geo::Aabb) -> Vec<glam::DVec3> {
    let ends = [aabb.min, aabb.max];
    (0..8).map(|i: usize| glam::DVec3::new(ends[i & 1].x, ends[i >> 1 & 1].y, ends[i >> 2].z)).collect()
}

fn opening(view: &View, closed: &Seen, open: &Seen, of_closed: &Shown, error_m: f64) -> Option<Opening> {
    let depth_m = (0..closed.faces().len()).filter_map(|i| closed.depth_m(i)).fold(f64::INFINITY, f64::min);
    let px = error_m / view.m_per_px(depth_m);
    let rim_px = if px.is_finite() { (px.ceil() as u32).saturating_add(1).min(MOST_RIM_PX) } else { MOST_RIM_PX };
    let holes = Holes::of(closed, open, &HoleConfig { behind_m: f64::INFINITY, rim_px });
    let counted: Vec<_> = holes.holes.iter().filter(|hole| hole.px >= LEAST_PX).collect();
    let largest = counted.first()?;
    let face = of_closed.surface.faces.get(largest.face as usize)?;
    let middle = face.iter().map(|&v| of_closed.surface.positions[v as usize]).sum::<glam::DVec3>() / 3.0;
    Some(Opening { area_m2: largest.area_m2, local_m: middle.to_array(), count: counted.len() })
}

fn larger(a: Option<Opening>, b: Option<Opening>) -> Option<Opening> {
    match (a, b) {
        (Some(a), Some(b)) => Some(if b.area_m2 > a.area_m2 { b } else { a }),
        (a, b) => a.or(b),
    }
}
