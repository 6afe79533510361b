//! Holes as a flight would see them: where a tile is open and the surface it stands for is not, and the other way round.

use glam::DVec3;
use serde::Serialize;

use crate::draw::holes::{HoleConfig, Holes};
use crate::draw::raster::Seen;
use crate::draw::view::{View, flight};
use crate::geo::Aabb;
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
        for (view, finer) in self.views.iter().zip(&self.finer) {
            let seen = Seen::of(view, &tile.positions, &tile.faces);
            let in_tile = opening(view, &finer.seen, &seen, error_m, &|pixel, _| finer.middle[pixel]);
            let in_finer = opening(view, &seen, &finer.seen, error_m, &|_, face| middle(tile, face));
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
    place: &dyn Fn(usize, u32) -> DVec3,
) -> Option<Opening> {
    let depth_m = (0..closed.faces().len()).filter_map(|i| closed.depth_m(i)).fold(f64::INFINITY, f64::min);
    let px = error_m / view.m_per_px(depth_m);
    let rim_px = if px.is_finite() { (px.ceil() as u32).saturating_add(1).min(MOST_RIM_PX) } else { MOST_RIM_PX };
    let holes = Holes::of(closed, open, &HoleConfig { behind_m: f64::INFINITY, rim_px });
    let counted: Vec<_> = holes.holes.iter().filter(|hole| hole.px >= LEAST_PX).collect();
    let largest = counted.first()?;
    let pixel = (largest.at_px[1] * view.size_px()[0] + largest.at_px[0]) as usize;
    let local_m = place(pixel, largest.face).to_array();
    Some(Opening { area_m2: largest.area_m2, local_m, count: counted.len() })
}

fn larger(a: Option<Opening>, b: Option<Opening>) -> Option<Opening> {
    match (a, b) {
        (Some(a), Some(b)) => Some(if b.area_m2 > a.area_m2 { b } else { a }),
        (a, b) => a.or(b),
    }
}
