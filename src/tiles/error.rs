//! Measures how far a tile's surface is from the source it stands for, both ways, with certified bounds per class.
//!
//! In: two triangle sets with classes. Out: [`Deviation`] per class.
//!
//! # Method
//! 1. *Measure.* Source: distances at the centres of about 50 000 of its faces, weighted by their area. Tile, whose
//!    faces are large: distances at the centres of equal parts of each face.
//! 2. *Bound.* Distance is 1-Lipschitz: d(corner) + longest edge there bounds a face. Where that is not enough: the
//!    distance to a triangle is convex, so the largest of the corners' distances to one triangle T of the other surface
//!    bounds the whole face; the least of these over the triangles nearest to the corners is taken.
//! 3. Faces whose bound passes the largest distance seen by more than the tolerance are quartered until it does not.
//!
//! # Promises
//! `lower ≤ sup distance ≤ upper` for each direction (`the_interval_holds_the_dense_sample`); upper − lower is within
//! [`TOLERANCE_SHARE`] of lower, or [`TOLERANCE_M`], except where [`DEEPEST`] stopped the quartering.
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
/// About so many faces of the source are measured in a tile, at least half of them.
const SOURCE_SAMPLES: usize = 50_000;
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

/// From every point of `from` to `to`: per class of `from`, for `classes` classes.
///
/// `fine` says that `from` is the source: its faces are small, and `inside_m` and `sunk_m` are filled.
pub fn directed(from: Surface, to: Surface, tree: &Bvh, classes: usize, fine: bool) -> Vec<Deviation> {
    let mut found = vec![Deviation::default(); classes];
    let hits = vertex_hits(from, to, tree);
    if fine {
        measure_source(from, to, tree, &hits, &mut found);
    } else {
        measure_faces(from, to, tree, &hits, &mut found);
    }
    let corners = |face: &[u32; 3]| face.map(|v| Corner { at: from.positions[v as usize], hit: hits[v as usize] });
    for (face, label) in from.faces.iter().zip(from.labels) {
        let lower = &mut found[label.index()].lower_m;
        *lower = corners(face).iter().map(|c| c.hit.distance).fold(*lower, f64::max);
    }
    let mut search = Search { to, tree, pending: Vec::new() };
    for (face, label) in from.faces.iter().zip(from.labels) {
        search.file(corners(face), label.index(), &mut found);
    }
    search.close(&mut found);
    if fine {
        signed::bound(from, to, tree, &hits, &mut found);
    }
    found
}

#[derive(Clone, Copy)]
pub(super) struct Corner {
    pub at: DVec3,
    pub hit: Hit,
}

fn vertex_hits(from: Surface, to: Surface, tree: &Bvh) -> Vec<Hit> {
    let far = Hit { face: u32::MAX, point: DVec3::ZERO, distance: f64::INFINITY };
    let mut hits = vec![far; from.positions.len()];
    for face in from.faces {
        let mut near: Option<u32> = None;
        for &v in face {
            let v = v as usize;
            if hits[v].face == u32::MAX {
                hits[v] = closest(from.positions[v], near, to, tree);
            }
            near = Some(hits[v].face);
        }
    }
    hits
}

/// The closest point, searched no further than the face that was closest nearby.
pub(super) fn closest(p: DVec3, near: Option<u32>, to: Surface, tree: &Bvh) -> Hit {
    let none = Hit { face: u32::MAX, point: p, distance: f64::INFINITY };
    let known = near.filter(|&f| f != u32::MAX).map(|face| {
        let point = closest_on_triangle(p, &to.faces[face as usize].map(|v| to.positions[v as usize]));
        Hit { face, point, distance: (point - p).length() }
    });
    let max = known.map_or(f64::INFINITY, |k| k.distance);
    tree.closest(p, max).or(known).unwrap_or(none)
}

/// The source: the centre of one face in every few, which stands for all of them without bias; vertices would show the
/// surface where the collapse held it.
fn measure_source(from: Surface, to: Surface, tree: &Bvh, hits: &[Hit], found: &mut [Deviation]) {
    let stride = (from.faces.len() / SOURCE_SAMPLES).max(1);
    for (f, face) in from.faces.iter().enumerate() {
        let [a, b, c] = face.map(|v| from.positions[v as usize]);
        let cross = (b - a).cross(c - a);
        let deviation = &mut found[from.labels[f].index()];
        if f % stride == 0 {
            let hit = closest((a + b + c) / 3.0, Some(hits[face[0] as usize].face), to, tree);
            deviation.lower_m = deviation.lower_m.max(hit.distance);
            deviation.samples.push((hit.distance as f32, (cross.length() * 0.5) as f32));
        }
    }
}

fn measure_faces(from: Surface, to: Surface, tree: &Bvh, hits: &[Hit], found: &mut [Deviation]) {
    let area = |f: &[u32; 3]| {
        let [a, b, c] = f.map(|v| from.positions[v as usize]);
        (b - a).cross(c - a).length() * 0.5
    };
    let total: f64 = from.faces.iter().map(area).sum();
    // About four samples a face on average, more where a face is large.
    let part_area = total / (4.0 * from.faces.len() as f64).max(1.0);
    for (f, face) in from.faces.iter().enumerate() {
        let [a, b, c] = face.map(|v| from.positions[v as usize]);
        let own = area(face);
        let parts = ((own / part_area.max(f64::MIN_POSITIVE)).sqrt().ceil() as usize).clamp(1, MOST_PARTS);
        let deviation = &mut found[from.labels[f].index()];
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
}

impl Search<'_> {
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
        let mut best = (0..3).map(|k| corners[k].hit.distance + reach(k)).fold(f64::INFINITY, f64::min);
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
                if upper <= good(&found[class]) || depth == DEEPEST {
                    found[class].upper_m = found[class].upper_m.max(upper);
                    continue;
                }
                let middle = |i: usize, j: usize| {
                    let at = (corners[i].at + corners[j].at) * 0.5;
                    Corner { at, hit: closest(at, Some(corners[i].hit.face), self.to, self.tree) }
                };
                let [a, b, c] = corners;
                let (ab, bc, ca) = (middle(0, 1), middle(1, 2), middle(2, 0));
                for m in [&ab, &bc, &ca] {
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

/// A bound up to here closes the interval.
fn good(d: &Deviation) -> f64 {
    d.lower_m + TOLERANCE_M.max(TOLERANCE_SHARE * d.lower_m)
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
        directed(sa, sb, &Bvh::new(&b.0, &b.1), 1, fine).remove(0)
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
