//! Measures how far a tile's surface is from the source it stands for, both ways, with certified bounds per class.
//!
//! In: two triangle sets with classes. Out: [`Deviation`] per class.
//!
//! # Method
//! 1. *Measure.* About 16 000 points each way, whatever the size. Source: the centres of some of its faces, weighted
//!    by their area. Tile, whose faces are large: the centres of equal parts of some of its faces.
//! 2. *Bound.* The distance to a triangle is convex, so the largest of the corners' distances to one triangle T of the
//!    other surface bounds the whole face. Of the source, a T that bounded a neighbour is tried before anything is
//!    searched for.
//! 3. `search`: faces whose bound passes the largest distance seen by more than the tolerance are cut along the outlines
//!    of what is nearest, until it does not. Back from the tile, what is nearer than the distance there is left as it is:
//!    a class's bound is the larger of both.
//! 4. `signed`: the same pieces bound how far the tile is inside and below the source.
//!
//! # Promises
//! `lower ≤ sup distance ≤ upper` for each direction (`the_interval_holds_the_dense_sample`); upper − lower is within
//! [`TOLERANCE_SHARE`] of lower, or [`TOLERANCE_M`], but for faces of more pieces than `search` allows.
//!
//! # Cost
//! Of a city's tiles (0.4 m edges) 1.7 µs a source face and 8 µs a tile face at the finest simplified level, 0.3 and 15
//! where edges are 1.6 m. Quartered and bounded by their corners' distances the faces took 4.9 and 20, 0.5 and 23.
//!
//! # References
//! Guéziec, Meshsweeper, 1999 (convexity); Sacht & Jacobson, Cascading upper bounds for triangle soup Pompeiu–Hausdorff
//! distance, 2024.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::geo::bvh::{Bvh, closest_on_triangle};
use crate::ids::ClassId;

mod corners;
mod search;
mod signed;

pub(super) use corners::{Corner, closest, cover_radius, quarter};
use search::{Pending, Search};
use signed::Side;

/// The interval of the bound is closed to this share of the distance.
pub const TOLERANCE_SHARE: f64 = 0.05;
/// Intervals narrower than this are good enough, metres.
pub const TOLERANCE_M: f64 = 0.001;
/// So many points of either surface are measured in a tile where it has as many faces, and at most about twice as many:
/// the figures of its classes do not get better with more, and the bound does not need them.
const SAMPLES: usize = 16_000;
/// A large face is measured at up to this many points along an edge.
const MOST_PARTS: usize = 12;

/// A triangle surface with a class for each face.
#[derive(Clone, Copy)]
pub struct Surface<'a> {
    /// Local metres.
    pub positions: &'a [DVec3],
    /// Corners.
    pub faces: &'a [[u32; 3]],
    /// Class of each face.
    pub labels: &'a [ClassId],
}

impl Surface<'_> {
    /// The corners of a face.
    pub fn triangle(&self, face: u32) -> [DVec3; 3] {
        self.faces[face as usize].map(|v| self.positions[v as usize])
    }
}

/// Distances of one class, metres; two-sided when both directions were merged.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Deviation {
    /// No point is further away than this (certified).
    pub upper_m: f64,
    /// Some point is this far away (measured).
    pub lower_m: f64,
    /// How far the tile sinks inside the source, along the source's normals (certified, see `signed`); negative where it
    /// stays outside. Of the source only.
    pub inside_m: f64,
    /// How much lower than the source it is (certified). Of the source only.
    pub sunk_m: f64,
    /// Bounds below this are good enough: another direction is known to be this far off.
    known_m: f64,
    /// Distance and weight (m²) of every sample, unordered.
    samples: Vec<(f32, f32)>,
}

/// Area-weighted figures of a [`Deviation`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Mean, metres.
    pub mean_m: f64,
    /// Root of the mean square, metres.
    pub rms_m: f64,
    /// 95 % of the area is nearer, metres.
    pub p95_m: f64,
    /// 99 % of the area is nearer, metres.
    pub p99_m: f64,
}

impl Deviation {
    /// Both directions together: the larger bounds, and all samples, each direction weighted to one half.
    pub fn two_sided(forward: Self, backward: Self) -> Self {
        let scaled = |d: &Self| {
            let total: f64 = d.samples.iter().map(|s| f64::from(s.1)).sum();
            let scale = if total > 0.0 { 0.5 / total } else { 0.0 };
            d.samples.iter().map(|s| (s.0, (f64::from(s.1) * scale) as f32)).collect::<Vec<_>>()
        };
        let mut samples = scaled(&forward);
        samples.extend(scaled(&backward));
        Self {
            upper_m: forward.upper_m.max(backward.upper_m),
            lower_m: forward.lower_m.max(backward.lower_m),
            inside_m: forward.inside_m,
            sunk_m: forward.sunk_m,
            known_m: 0.0,
            samples,
        }
    }

    /// True when nothing was measured.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Mean, RMS and quantiles over the area.
    pub fn figures(&self) -> Figures {
        let mut samples = self.samples.clone();
        samples.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let total: f64 = samples.iter().map(|s| f64::from(s.1)).sum();
        if total <= 0.0 {
            return Figures::default();
        }
        let sum = |f: fn(f64) -> f64| samples.iter().map(|s| f(f64::from(s.0)) * f64::from(s.1)).sum::<f64>() / total;
        let quantile = |q: f64| {
            let mut reached = 0.0;
            let found = samples.iter().find(|s| {
                reached += f64::from(s.1);
                reached >= q * total
            });
            found.or(samples.last()).map_or(0.0, |s| f64::from(s.0))
        };
        Figures { mean_m: sum(|d| d), rms_m: sum(|d| d * d).sqrt(), p95_m: quantile(0.95), p99_m: quantile(0.99) }
    }
}

/// From every point of the source to the tile: per class of the source, for `classes` classes.
pub fn from_source(source: Surface, tile: Surface, tree: &Bvh, classes: usize) -> Vec<Deviation> {
    let mut found = vec![Deviation::default(); classes];
    measure_source(source, tile, tree, &mut found);
    let mut near = Near::new(source, tile, tree);
    let mut pending = Vec::new();
    let mut sides = Vec::with_capacity(source.faces.len());
    for (face, label) in (0u32..).zip(source.labels) {
        let class = label.index();
        sides.push(match near.settle(face, &mut found[class]) {
            Ok(side) => side,
            Err((bound_m, near)) => {
                pending.push(Pending { face, class, bound_m, near });
                [f32::INFINITY; 2]
            }
        });
    }
    Search { from: source, to: tile, tree }.close(pending, &mut found, Some(&mut sides));
    signed::bound(&near, sides, &mut found);
    found
}

/// From every point of the tile to the source: per class of the tile. Of each class, nothing is looked at more closely
/// that is nearer than `known_m`: with the distance from the source, which counts for the same bound, nobody would see
/// it.
pub fn from_tile(tile: Surface, source: Surface, tree: &Bvh, known_m: &[f64]) -> Vec<Deviation> {
    let mut found: Vec<Deviation> =
        known_m.iter().map(|&known_m| Deviation { known_m, ..Deviation::default() }).collect();
    let mut near = None;
    let corner = |&at: &DVec3| {
        let hit = closest(at, near, source, tree);
        near = Some(hit.face);
        Corner { at, hit }
    };
    let corners: Vec<Corner> = tile.positions.iter().map(corner).collect();
    let search = Search { from: tile, to: source, tree };
    let mut pending = Vec::with_capacity(tile.faces.len());
    for (f, (face, label)) in (0u32..).zip(tile.faces.iter().zip(tile.labels)) {
        let corners = face.map(|v| &corners[v as usize]);
        let lower_m = &mut found[label.index()].lower_m;
        *lower_m = corners.iter().map(|c| c.hit.distance).fold(*lower_m, f64::max);
        pending.push(search.pending(f, corners));
    }
    measure_faces(tile, source, tree, &corners, &mut found);
    search.close(pending, &mut found, None);
    found
}

/// A bound up to here closes the interval, or does not matter.
fn good(d: &Deviation) -> f64 {
    d.known_m.max(d.lower_m + TOLERANCE_M.max(TOLERANCE_SHARE * d.lower_m))
}

/// What is known of the source's vertices about the tile.
struct Near<'a> {
    from: Surface<'a>,
    to: Surface<'a>,
    tree: &'a Bvh,
    /// A triangle thought to be near each vertex.
    guess: Vec<u32>,
    last: u32,
}

impl<'a> Near<'a> {
    fn new(from: Surface<'a>, to: Surface<'a>, tree: &'a Bvh) -> Self {
        Self { from, to, tree, guess: vec![u32::MAX; from.positions.len()], last: u32::MAX }
    }

    /// The corners of a face with their closest points.
    fn corners(&self, face: u32) -> [Corner; 3] {
        self.from.faces[face as usize].map(|v| {
            let at = self.from.positions[v as usize];
            Corner { at, hit: closest(at, Some(self.guess[v as usize]), self.to, self.tree) }
        })
    }

    /// Bounds a face by one triangle near it, where that is good enough, and returns what that says of [`signed`]; else
    /// what is closest to its middle, and the bound that gives. Most faces need no search at all, for the largest
    /// distance is far above the usual, and one triangle of the tile has many faces of the source.
    fn settle(&mut self, face: u32, found: &mut Deviation) -> Result<[f32; 2], (f64, u32)> {
        let enough_m = good(found);
        let corners = self.from.triangle(face);
        let face = &self.from.faces[face as usize];
        let guesses @ [a, b, c] = face.map(|v| self.guess[v as usize]);
        let is_new = [a != u32::MAX, b != u32::MAX && b != a, c != u32::MAX && c != a && c != b];
        let mut offsets = [DVec3::ZERO; 3];
        // What stands for a neighbour mostly does here; if not, what is closest to the middle may.
        for near in guesses.into_iter().zip(is_new).filter_map(|(near, is_new)| is_new.then_some(near)) {
            let triangle = self.to.triangle(near);
            let mut squared = 0.0f64;
            for (offset, p) in offsets.iter_mut().zip(corners) {
                *offset = p - closest_on_triangle(p, &triangle);
                squared = squared.max(offset.length_squared());
                if squared > enough_m * enough_m {
                    break;
                }
            }
            if squared <= enough_m * enough_m {
                return Ok(self.settled(face, near, squared.sqrt(), corners, offsets, found));
            }
        }
        let middle = corners.iter().sum::<DVec3>() / 3.0;
        let hit = closest(middle, Some(if a == u32::MAX { self.last } else { a }), self.to, self.tree);
        if hit.face == u32::MAX {
            return Err((f64::INFINITY, u32::MAX));
        }
        found.lower_m = found.lower_m.max(hit.distance);
        let triangle = self.to.triangle(hit.face);
        let offsets = corners.map(|p| p - closest_on_triangle(p, &triangle));
        let bound_m = offsets.iter().map(|o| o.length_squared()).fold(0.0, f64::max).sqrt();
        if bound_m <= good(found) {
            return Ok(self.settled(face, hit.face, bound_m, corners, offsets, found));
        }
        self.remember(face, hit.face);
        Err((bound_m, hit.face))
    }

    fn settled(
        &mut self,
        face: &[u32; 3],
        near: u32,
        bound_m: f64,
        corners: [DVec3; 3],
        offsets: [DVec3; 3],
        found: &mut Deviation,
    ) -> [f32; 2] {
        self.remember(face, near);
        found.upper_m = found.upper_m.max(bound_m);
        let mut side = Side::of(corners);
        offsets.into_iter().for_each(|offset| side.take(offset));
        side.rounded_up()
    }

    fn remember(&mut self, face: &[u32; 3], near: u32) {
        face.iter().for_each(|&v| self.guess[v as usize] = near);
        self.last = near;
    }
}

/// The source: the centre of one face in every few, which stands for all of them without bias; vertices would show the
/// surface where the collapse held it.
fn measure_source(from: Surface, to: Surface, tree: &Bvh, found: &mut [Deviation]) {
    let stride = (from.faces.len() / SAMPLES).max(1);
    let mut near = None;
    for (f, (face, label)) in from.faces.iter().zip(from.labels).enumerate() {
        let deviation = &mut found[label.index()];
        // A class of few faces is measured, too.
        if f % stride != 0 && !deviation.samples.is_empty() {
            continue;
        }
        let [a, b, c] = face.map(|v| from.positions[v as usize]);
        let hit = closest((a + b + c) / 3.0, near, to, tree);
        near = Some(hit.face);
        deviation.lower_m = deviation.lower_m.max(hit.distance);
        deviation.samples.push((hit.distance as f32, ((b - a).cross(c - a).length() * 0.5) as f32));
    }
}

fn measure_faces(from: Surface, to: Surface, tree: &Bvh, corners: &[Corner], found: &mut [Deviation]) {
    let area = |f: &[u32; 3]| {
        let [a, b, c] = f.map(|v| from.positions[v as usize]);
        (b - a).cross(c - a).length() * 0.5
    };
    let total: f64 = from.faces.iter().map(area).sum();
    // About two samples a face on average, more where a face is large.
    let part_area = total / (from.faces.len() as f64).max(1.0);
    let stride = (2 * from.faces.len() / SAMPLES).max(1);
    for (f, face) in from.faces.iter().enumerate() {
        let deviation = &mut found[from.labels[f].index()];
        if f % stride != 0 && !deviation.samples.is_empty() {
            continue;
        }
        let [a, b, c] = face.map(|v| from.positions[v as usize]);
        let own = area(face);
        let parts = ((own / part_area.max(f64::MIN_POSITIVE)).sqrt().ceil() as usize).clamp(1, MOST_PARTS);
        let weight = (own / (parts * parts) as f64) as f32;
        let mut near = Some(corners[face[0] as usize].hit.face);
        for i in 0..parts {
            for j in 0..2 * (parts - i) - 1 {
                // Centres of the upright (even j) and inverted (odd j) parts of row i.
                let third = if j % 2 == 0 { 1.0 } else { 2.0 } / 3.0;
                let u = (i as f64 + third) / parts as f64;
                let v = ((j / 2) as f64 + third) / parts as f64;
                let hit = closest(a + (b - a) * u + (c - a) * v, near, to, tree);
                near = Some(hit.face);
                deviation.lower_m = deviation.lower_m.max(hit.distance);
                deviation.samples.push((hit.distance as f32, weight));
            }
        }
    }
}

#[cfg(test)]
mod tests;
