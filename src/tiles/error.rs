//! Measures how far a tile's surface is from the source it stands for, both ways, with certified bounds per class.
//!
//! In: two triangle sets with classes. Out: [`Deviation`] per class.
//!
//! # Method
//! 1. *Measure.* About 16 000 points each way, whatever the size. Source: the centres of some of its faces, weighted
//!    by their area. Tile, whose faces are large: the centres of equal parts of some of its faces.
//! 2. *Bound.* The distance to a triangle is convex, so the largest of the corners' distances to one triangle T of the
//!    other surface bounds the whole face. Distance is 1-Lipschitz: with the corners' own distances and the radius in
//!    which they cover the face, that bounds it too.
//! 3. Of the source, a T that bounded a neighbour is tried before anything is searched for.
//! 4. Faces whose bound passes the largest distance seen by more than the tolerance are quartered until it does not.
//!    Back from the tile, what is nearer than the distance there is left as it is: a class's bound is the larger of both.
//!
//! # Promises
//! `lower ≤ sup distance ≤ upper` for each direction (`the_interval_holds_the_dense_sample`); upper − lower is within
//! [`TOLERANCE_SHARE`] of lower, or [`TOLERANCE_M`], except where [`DEEPEST`] stopped the quartering.
//!
//! # Cost
//! On a scan of 0.77 million faces 28 % of a build, half of it each way; against the collapse, in one run each, 0.92 where
//! a search for every vertex and every part took 1.10. Back from the tile a face is larger than those of the source: no
//! triangle bounds it, and it takes about 14 searches before its 22 parts are small enough. A walk over the source's faces
//! below it would not. Of the source's faces one in six was bounded neither by what bounds its neighbours nor by what is
//! nearest to its corners, and was cut up here and again for `signed`; what is nearest to its middle is now tried first.
//!
//! # References
//! Guéziec, Meshsweeper, 1999 (convexity); Sacht & Jacobson, Cascading upper bounds for triangle soup Pompeiu–Hausdorff
//! distance, 2024.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::signed;
use crate::geo::bvh::{Bvh, Hit, closest_on_triangle};
use crate::ids::ClassId;

/// The interval of the bound is closed to this share of the distance.
pub const TOLERANCE_SHARE: f64 = 0.05;
/// Intervals narrower than this are good enough, metres.
pub const TOLERANCE_M: f64 = 0.001;
/// A face is quartered at most this often.
pub const DEEPEST: u32 = 7;
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
    let mut search = Search::new(tile, tree);
    let mut roughly = Vec::with_capacity(source.faces.len());
    for (f, face) in source.faces.iter().enumerate() {
        let class = source.labels[f].index();
        let value_m = near.settle(face, &mut found[class]);
        if value_m.is_none() {
            search.file(near.corners(face), class, &mut found);
        }
        roughly.push(value_m.unwrap_or([f32::INFINITY; 2]));
    }
    search.close(&mut found);
    signed::bound(&mut near, &mut roughly, &mut found);
    found
}

/// From every point of the tile to the source: per class of the tile. Of each class, nothing is looked at more closely
/// that is nearer than `known_m`: with the distance from the source, which counts for the same bound, nobody would see
/// it.
pub fn from_tile(tile: Surface, source: Surface, tree: &Bvh, known_m: &[f64]) -> Vec<Deviation> {
    let mut found: Vec<Deviation> =
        known_m.iter().map(|&known_m| Deviation { known_m, ..Deviation::default() }).collect();
    let mut near = Near::new(tile, source, tree);
    for (face, label) in tile.faces.iter().zip(tile.labels) {
        let lower = &mut found[label.index()].lower_m;
        *lower = near.corners(face).iter().map(|c| c.hit.distance).fold(*lower, f64::max);
    }
    measure_faces(tile, source, tree, &near.hits, &mut found);
    let mut search = Search::new(source, tree);
    for (face, label) in tile.faces.iter().zip(tile.labels) {
        search.file(near.corners(face), label.index(), &mut found);
    }
    search.close(&mut found);
    found
}

#[derive(Clone, Copy)]
pub(super) struct Corner {
    pub at: DVec3,
    pub hit: Hit,
}

const FAR: Hit = Hit { face: u32::MAX, point: DVec3::ZERO, distance: f64::INFINITY };

/// What is known of the vertices of one surface about another, found when it is asked for.
pub(super) struct Near<'a> {
    pub from: Surface<'a>,
    pub to: Surface<'a>,
    pub tree: &'a Bvh,
    /// The closest point of each vertex, or [`FAR`].
    hits: Vec<Hit>,
    /// A triangle thought to be near each vertex.
    guess: Vec<u32>,
    last: u32,
}

impl<'a> Near<'a> {
    fn new(from: Surface<'a>, to: Surface<'a>, tree: &'a Bvh) -> Self {
        let count = from.positions.len();
        Self { from, to, tree, hits: vec![FAR; count], guess: vec![u32::MAX; count], last: u32::MAX }
    }

    /// A vertex with its closest point.
    fn corner(&mut self, v: u32) -> Corner {
        let (v, at) = (v as usize, self.from.positions[v as usize]);
        if self.hits[v].face == u32::MAX {
            let near = if self.guess[v] == u32::MAX { self.last } else { self.guess[v] };
            self.hits[v] = closest(at, Some(near), self.to, self.tree);
            (self.guess[v], self.last) = (self.hits[v].face, self.hits[v].face);
        }
        Corner { at, hit: self.hits[v] }
    }

    /// The corners of a face with their closest points.
    pub fn corners(&mut self, face: &[u32; 3]) -> [Corner; 3] {
        face.map(|v| self.corner(v))
    }

    /// Bounds a face by one triangle near it, where that is good enough, and returns what [`signed`] wants to know: how
    /// far that triangle is inside and below the face at most. Most faces need no search at all, for the largest
    /// distance is far above the usual, and one triangle of the tile has many faces of the source.
    fn settle(&mut self, face: &[u32; 3], found: &mut Deviation) -> Option<[f32; 2]> {
        let enough_m = good(found);
        let corners = face.map(|v| self.from.positions[v as usize]);
        let [a, b, c] = face.map(|v| self.guess[v as usize]);
        for k in 0..7 {
            // What stands for a neighbour mostly does here; if not, what is closest to the middle or a corner may.
            let near = match k {
                0 => a,
                1 if b != a => b,
                2 if c != a && c != b => c,
                3 => {
                    let middle = corners.iter().sum::<DVec3>() / 3.0;
                    let hit = closest(middle, Some(if a == u32::MAX { self.last } else { a }), self.to, self.tree);
                    found.lower_m = found.lower_m.max(hit.distance);
                    hit.face
                }
                4.. => {
                    let corner = self.corner(face[k - 4]);
                    found.lower_m = found.lower_m.max(corner.hit.distance);
                    corner.hit.face
                }
                _ => continue,
            };
            if near == u32::MAX {
                continue;
            }
            let triangle = self.to.faces[near as usize].map(|v| self.to.positions[v as usize]);
            let mut offsets = [DVec3::ZERO; 3];
            let mut squared = 0.0f64;
            for (offset, p) in offsets.iter_mut().zip(corners) {
                *offset = p - closest_on_triangle(p, &triangle);
                squared = squared.max(offset.length_squared());
                if squared > enough_m * enough_m {
                    break;
                }
            }
            if squared <= enough_m * enough_m {
                face.iter().for_each(|&v| self.guess[v as usize] = near);
                self.last = near;
                found.upper_m = found.upper_m.max(squared.sqrt());
                return Some(signed::rough(corners, offsets));
            }
        }
        None
    }
}

/// The closest point, searched no further than the face that was closest nearby.
pub(super) fn closest(p: DVec3, near: Option<u32>, to: Surface, tree: &Bvh) -> Hit {
    let known = near.filter(|&f| f != u32::MAX).map(|face| {
        let point = closest_on_triangle(p, &to.faces[face as usize].map(|v| to.positions[v as usize]));
        Hit { face, point, distance: (point - p).length() }
    });
    let max = known.map_or(f64::INFINITY, |k| k.distance);
    tree.closest(p, max).or(known).unwrap_or(FAR)
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

fn measure_faces(from: Surface, to: Surface, tree: &Bvh, hits: &[Hit], found: &mut [Deviation]) {
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
        let mut near = Some(hits[face[0] as usize].face);
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

/// Faces whose bound may still pass the largest distance seen.
struct Search<'a> {
    to: Surface<'a>,
    tree: &'a Bvh,
    pending: Vec<(f64, usize, [Corner; 3], u32)>,
    /// Middles found lately, by a hash of their place: the parts of a face ask for each of them twice.
    lately: Vec<Lately>,
}

/// A point with what was found for it; the closest if that is further than was enough.
#[derive(Clone, Copy)]
struct Lately {
    corner: Corner,
    enough_m: f64,
}

/// Middles that are remembered, a power of two.
const MOST_LATELY: usize = 1 << 10;

fn place_of(p: DVec3) -> usize {
    let mixed = p
        .to_array()
        .into_iter()
        .fold(0u64, |h, x| (h ^ x.to_bits()).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(29));
    (mixed >> 32) as usize & (MOST_LATELY - 1)
}

impl<'a> Search<'a> {
    fn new(to: Surface<'a>, tree: &'a Bvh) -> Self {
        let corner = Corner { at: DVec3::INFINITY, hit: FAR };
        Self { to, tree, pending: Vec::new(), lately: vec![Lately { corner, enough_m: 0.0 }; MOST_LATELY] }
    }

    /// An upper bound of the distance anywhere on the triangle; not made tighter once it is below `enough`.
    fn upper(&self, corners: &[Corner; 3], enough: f64) -> f64 {
        if corners.iter().any(|c| c.hit.face == u32::MAX) {
            return f64::INFINITY;
        }
        // Distance is 1-Lipschitz. This settles most faces, for the largest distance is far above the usual.
        let reach = |k: usize| {
            let others = [corners[(k + 1) % 3].at, corners[(k + 2) % 3].at];
            others.iter().map(|p| (*p - corners[k].at).length()).fold(0.0, f64::max)
        };
        let furthest_m = corners.iter().map(|c| c.hit.distance).fold(0.0, f64::max);
        let by_nearest_m = furthest_m + cover_radius(corners);
        let mut best = (0..3).map(|k| corners[k].hit.distance + reach(k)).fold(by_nearest_m, f64::min);
        for (k, c) in corners.iter().enumerate() {
            if best <= enough || corners[..k].iter().any(|e| e.hit.face == c.hit.face) {
                continue;
            }
            let triangle = self.to.faces[c.hit.face as usize].map(|v| self.to.positions[v as usize]);
            let worst = corners.iter().map(|e| {
                if e.hit.face == c.hit.face {
                    e.hit.distance
                } else {
                    (closest_on_triangle(e.at, &triangle) - e.at).length()
                }
            });
            best = best.min(worst.fold(0.0, f64::max));
        }
        best
    }

    /// An upper bound by way of the centre: the triangle that is nearest there, where corners lie on edges and say too
    /// little, or the three parts around it. One search, where quartering takes three.
    fn by_centre(&self, corners: &[Corner; 3], radius: f64, depth: u32, found: &mut Deviation) -> f64 {
        // Parts of an even triangle are covered from 0.58 times as far, but corners are as far as they are.
        let furthest_m = corners.iter().map(|c| c.hit.distance).fold(0.0, f64::max);
        let is_hopeless = 0.5 * furthest_m + 0.58 * radius > good(found);
        if is_hopeless && depth > 0 {
            return f64::INFINITY;
        }
        let at = corners.iter().map(|c| c.at).sum::<DVec3>() / 3.0;
        let centre = Corner { at, hit: closest(at, Some(corners[0].hit.face), self.to, self.tree) };
        found.lower_m = found.lower_m.max(centre.hit.distance);
        let triangle = self.to.faces[centre.hit.face as usize].map(|v| self.to.positions[v as usize]);
        let by_triangle_m =
            corners.iter().map(|c| (closest_on_triangle(c.at, &triangle) - c.at).length()).fold(0.0, f64::max);
        let [a, b, c] = *corners;
        let of_part = |part: [Corner; 3]| part.iter().map(|c| c.hit.distance).fold(0.0, f64::max) + cover_radius(&part);
        let by_parts_m = [[a, b, centre], [b, c, centre], [c, a, centre]].map(of_part).into_iter().fold(0.0, f64::max);
        by_triangle_m.min(by_parts_m)
    }

    /// The middle of two corners, with a point of the other surface: the closest, or one within `enough_m`.
    fn middle(&mut self, a: &Corner, b: &Corner, enough_m: f64) -> Corner {
        let at = (a.at + b.at) * 0.5;
        let place = place_of(at);
        let known = &self.lately[place];
        let distance_m = known.corner.hit.distance;
        if known.corner.at == at && (distance_m <= enough_m || distance_m > known.enough_m) {
            return known.corner;
        }
        let hit = |face: u32| {
            let point = closest_on_triangle(at, &self.to.faces[face as usize].map(|v| self.to.positions[v as usize]));
            Hit { face, point, distance: (point - at).length() }
        };
        let mut near = hit(a.hit.face);
        if near.distance > enough_m && a.hit.face != b.hit.face {
            let other = hit(b.hit.face);
            near = if other.distance < near.distance { other } else { near };
        }
        if near.distance > enough_m {
            near = self.tree.closest_until(at, near.distance, enough_m).unwrap_or(near);
        }
        let corner = Corner { at, hit: near };
        self.lately[place] = Lately { corner, enough_m };
        corner
    }

    /// Settles a face whose bound is good enough, keeps it otherwise.
    fn file(&mut self, corners: [Corner; 3], class: usize, found: &mut [Deviation]) {
        let upper = self.upper(&corners, good(&found[class]));
        if upper <= good(&found[class]) {
            found[class].upper_m = found[class].upper_m.max(upper);
        } else {
            self.pending.push((upper, class, corners, 0));
        }
    }

    /// Quarters pending faces, the worst first, until every class's interval is closed.
    fn close(mut self, found: &mut [Deviation]) {
        self.pending.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut stack = Vec::new();
        for face in std::mem::take(&mut self.pending) {
            stack.push(face);
            while let Some((upper, class, corners, depth)) = stack.pop() {
                let is_lost = corners.iter().any(|c| c.hit.face == u32::MAX);
                if upper <= good(&found[class]) || depth == DEEPEST || is_lost {
                    found[class].upper_m = found[class].upper_m.max(upper);
                    continue;
                }
                let radius = cover_radius(&corners);
                let upper = upper.min(self.by_centre(&corners, radius, depth, &mut found[class]));
                if upper <= good(&found[class]) {
                    found[class].upper_m = found[class].upper_m.max(upper);
                    continue;
                }
                // What the parts may have at their corners; closer is not asked for.
                let enough_m = good(&found[class]) - 0.5 * radius;
                let [a, b, c] = corners;
                let [ab, bc, ca] = [(a, b), (b, c), (c, a)].map(|(p, q)| self.middle(&p, &q, enough_m));
                for m in [&ab, &bc, &ca].into_iter().filter(|m| m.hit.distance > enough_m) {
                    found[class].lower_m = found[class].lower_m.max(m.hit.distance);
                }
                for part in [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]] {
                    stack.push((self.upper(&part, good(&found[class])).min(upper), class, part, depth + 1));
                }
            }
        }
        for d in found {
            d.upper_m = d.upper_m.max(d.lower_m);
        }
    }
}

/// A bound up to here closes the interval, or does not matter.
fn good(d: &Deviation) -> f64 {
    d.known_m.max(d.lower_m + TOLERANCE_M.max(TOLERANCE_SHARE * d.lower_m))
}

/// No point of a triangle is further from its nearest corner.
pub(super) fn cover_radius(corners: &[Corner; 3]) -> f64 {
    let [a, b, c] = corners.map(|c| c.at);
    let mut squared = [(b - c).length_squared(), (c - a).length_squared(), (a - b).length_squared()];
    squared.sort_unstable_by(f64::total_cmp);
    let [a2, b2, c2] = squared;
    // Where the bisector of a short side meets the longest, which for an acute triangle is beyond the circumcentre.
    let reach = |short2: f64, other2: f64| {
        let across = short2 + c2 - other2;
        if across > 0.0 { short2 * c2.sqrt() / across } else { 0.0 }
    };
    let radius = if a2 + b2 > c2 {
        (a2 * b2 * c2).sqrt() / (2.0 * (b - a).cross(c - a).length())
    } else {
        reach(a2, b2).max(reach(b2, a2))
    };
    // Rounding, and triangles so flat that there is nothing left of their area.
    if radius.is_finite() { (radius * (1.0 + 1e-9)).min(c2.sqrt()) } else { c2.sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(n: usize, height: impl Fn(f64, f64) -> f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let mut positions = Vec::new();
        let mut faces = Vec::new();
        for y in 0..=n {
            for x in 0..=n {
                let (x, y) = (x as f64 / n as f64 * 10.0, y as f64 / n as f64 * 10.0);
                positions.push(DVec3::new(x, y, height(x, y)));
            }
        }
        for y in 0..n {
            for x in 0..n {
                let a = (y * (n + 1) + x) as u32;
                let m = n as u32 + 1;
                faces.extend([[a, a + 1, a + m + 1], [a, a + m + 1, a + m]]);
            }
        }
        (positions, faces)
    }

    fn both(a: &(Vec<DVec3>, Vec<[u32; 3]>), b: &(Vec<DVec3>, Vec<[u32; 3]>), fine: bool) -> Deviation {
        let (la, lb) = (vec![ClassId(0); a.1.len()], vec![ClassId(0); b.1.len()]);
        let sa = Surface { positions: &a.0, faces: &a.1, labels: &la };
        let sb = Surface { positions: &b.0, faces: &b.1, labels: &lb };
        let tree = Bvh::new(&b.0, &b.1);
        if fine { from_source(sa, sb, &tree, 1).remove(0) } else { from_tile(sa, sb, &tree, &[0.0]).remove(0) }
    }

    #[test]
    fn the_interval_holds_the_dense_sample() {
        let bumpy = grid(23, |x, y| (x * 1.3).sin() * (y * 0.7).cos());
        let coarse = grid(4, |x, y| (x * 1.3).sin() * (y * 0.7).cos() * 0.8);
        for (from, to, fine) in [(&bumpy, &coarse, true), (&coarse, &bumpy, false)] {
            let found = both(from, to, fine);
            let tree = Bvh::new(&to.0, &to.1);
            let mut worst = 0f64;
            for f in &from.1 {
                let [a, b, c] = f.map(|v| from.0[v as usize]);
                for i in 0..=40 {
                    for j in 0..=40 - i {
                        let p = a + (b - a) * (i as f64 / 40.0) + (c - a) * (j as f64 / 40.0);
                        worst = worst.max(tree.closest(p, f64::INFINITY).unwrap().distance);
                    }
                }
            }
            assert!(found.upper_m >= worst - 1e-9, "{} < {worst}", found.upper_m);
            assert!(found.upper_m <= worst * 1.1 + TOLERANCE_M, "{} is loose for {worst}", found.upper_m);
            assert!(found.lower_m <= worst + 1e-3);
        }
    }

    #[test]
    fn corners_cover_a_triangle_from_their_radius_and_from_no_less() {
        let corner = |x: f64, y: f64| Corner { at: DVec3::new(x, y, 0.0), hit: FAR };
        let shapes = [[0.5, 0.9], [0.1, 0.05], [0.9, 0.3], [1.7, 0.2], [0.5, 1e-7], [0.0, 1.0], [0.3, 0.0]];
        for [x, y] in shapes {
            let corners = [corner(0.0, 0.0), corner(1.0, 0.0), corner(x, y)];
            let mut furthest = 0f64;
            for i in 0..=200 {
                for j in 0..=200 - i {
                    let [a, b, c] = corners.map(|c| c.at);
                    let p = a + (b - a) * (f64::from(i) / 200.0) + (c - a) * (f64::from(j) / 200.0);
                    furthest = furthest.max([a, b, c].iter().map(|q| (*q - p).length()).fold(f64::INFINITY, f64::min));
                }
            }
            let radius = cover_radius(&corners);
            assert!((furthest..furthest + 0.02).contains(&radius), "{x} {y}: {radius} for {furthest}");
        }
    }

    #[test]
    fn a_class_of_one_face_among_many_is_measured() {
        let (fine, coarse) = (grid(200, |_, _| 0.25), grid(120, |_, _| 0.0));
        let labels = |count: usize, odd: usize| (0..count).map(|f| ClassId(u8::from(f == odd))).collect::<Vec<_>>();
        let (lf, lc) = (labels(fine.1.len(), 77_777), labels(coarse.1.len(), 28_001));
        let source = Surface { positions: &fine.0, faces: &fine.1, labels: &lf };
        let tile = Surface { positions: &coarse.0, faces: &coarse.1, labels: &lc };
        let there = from_source(source, tile, &Bvh::new(&coarse.0, &coarse.1), 2);
        let back = from_tile(tile, source, &Bvh::new(&fine.0, &fine.1), &[0.0; 2]);
        for found in [there, back] {
            assert!((1..9).contains(&found[1].samples.len()), "{}", found[1].samples.len());
            assert!((0.25..0.27).contains(&found[1].upper_m), "{}", found[1].upper_m);
            assert!((0.5..3.0).contains(&(found[0].samples.len() as f64 / SAMPLES as f64)));
        }
    }

    #[test]
    fn two_parallel_planes_are_their_distance_apart() {
        let (low, high) = (grid(8, |_, _| 0.0), grid(3, |_, _| 0.25));
        let down = both(&high, &low, false);
        let figures = down.figures();
        assert!((0.25..0.25 * (1.0 + TOLERANCE_SHARE) + 1e-9).contains(&down.upper_m), "{}", down.upper_m);
        for d in [down.lower_m, figures.mean_m, figures.rms_m, figures.p95_m, figures.p99_m] {
            assert!((d - 0.25).abs() < 1e-6, "{d}");
        }
        // The upper plane as source: the lower one sinks below it by all of the distance.
        assert!((both(&high, &low, true).inside_m - 0.25).abs() < 1e-9);
        assert!((both(&low, &high, true).inside_m + 0.25).abs() < 1e-9);
    }

    #[test]
    fn a_lost_spike_is_seen_from_the_source_only() {
        let spiky = grid(20, |x, y| if (x - 5.0).hypot(y - 5.0) < 0.1 { 3.0 } else { 0.0 });
        let flat = grid(2, |_, _| 0.0);
        assert!((both(&spiky, &flat, true).lower_m - 3.0).abs() < 1e-9);
        assert!(both(&flat, &spiky, false).upper_m < 0.5);
    }
}
