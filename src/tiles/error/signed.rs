//! Bounds how far a tile lies inside or below its source: the direction in which a pilot is not safe.
//!
//! In: the source, the tile, and bounds of each face that fell off while distances were bounded ([`Sides`]). Out: per class
//! two certified numbers.
//!
//! # Method
//! For every point p of the source there is a point q of the tile, no further away than the certified bound of p's class,
//! with n·(p − q) ≤ `inside_m`, n the source's normal at p; and one with p.z − q.z ≤ `sunk_m`. A face is settled by one
//! tile triangle T: n·(p − q) is affine where p and q run over the face and T together, so the largest of its corners'
//! values holds for all of it. Or by one point of the tile for the whole face. Of all faces there is such a bound already;
//! those that have the worst of their class are looked at again, and quartered where another triangle within reach is no
//! better.
//!
//! # Promises
//! `the_tile_never_sinks_deeper_than_stated`.

use glam::DVec3;

use super::{Corner, Deviation, Near, Surface, TOLERANCE_M, TOLERANCE_SHARE, cover_radius, quarter};
use crate::geo::bvh::{Bvh, closest_on_triangle};

/// A face is quartered at most this often.
const DEEPEST: u32 = 7;
/// Looked at more closely at first, the worst: what they leave undecided is little.
const FIRST: usize = 256;

/// By face, what bounds both directions by points of the tile within its class's bound, metres; rounded up.
pub(super) type Sides = Vec<[f32; 2]>;

/// The bounds of a face in the making.
pub(super) struct Side {
    directions: [DVec3; 2],
    worst_m: [f64; 2],
}

impl Side {
    pub fn of(corners: [DVec3; 3]) -> Self {
        Self { directions: directions(corners), worst_m: [f64::NEG_INFINITY; 2] }
    }

    /// From a point of the tile to a corner of a piece of the face. What holds for all corners of a piece and points of
    /// one triangle, or one point, holds for all of it.
    pub fn take(&mut self, offset: DVec3) {
        for (worst_m, direction) in self.worst_m.iter_mut().zip(self.directions) {
            *worst_m = worst_m.max(direction.dot(offset));
        }
    }

    pub fn rounded_up(self) -> [f32; 2] {
        self.worst_m.map(|m| (m as f32).next_up())
    }
}

/// Fills `inside_m` and `sunk_m` of every class whose `upper_m` is final; `sides` bound both for each face.
pub(super) fn bound(near: &Near, mut sides: Sides, found: &mut [Deviation]) {
    for (class, found) in found.iter_mut().enumerate() {
        let reach_m = found.upper_m * (1.0 + 1e-9);
        let mut bound_m = [f64::NEG_INFINITY; 2];
        for side in 0..2 {
            let of_class = (0u32..).zip(near.from.labels).filter(|(_, label)| label.index() == class);
            let open = of_class.map(|(f, _)| (sides[f as usize][side], f)).collect();
            worst_first(open, |value_m, f| {
                let is_last = f64::from(value_m) <= enough(bound_m[side]);
                if is_last {
                    // What is left adds nothing worth a closer look: the worst of it stands for all.
                    bound_m[side] = bound_m[side].max(f64::from(value_m));
                } else {
                    refine(near, f, reach_m, &mut bound_m);
                    sides[f as usize] = [f32::NEG_INFINITY; 2];
                }
                !is_last
            });
        }
        let or_0 = |m: f64| if m.is_finite() { m } else { 0.0 };
        (found.inside_m, found.sunk_m) = (or_0(bound_m[0]), or_0(bound_m[1]));
    }
}

/// Hands out values with their faces, the largest first, for as long as `more` are asked for: a few of many.
fn worst_first(mut open: Vec<(f32, u32)>, mut more: impl FnMut(f32, u32) -> bool) {
    let worse = |a: &(f32, u32), b: &(f32, u32)| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1));
    let mut count = FIRST;
    while !open.is_empty() {
        count = count.min(open.len());
        open.select_nth_unstable_by(count - 1, worse);
        let rest = open.split_off(count);
        open.sort_unstable_by(worse);
        if !open.into_iter().all(|(value_m, f)| more(value_m, f)) {
            return;
        }
        (open, count) = (rest, 2 * count);
    }
}

/// Raises the bounds to what a face asks for.
fn refine(near: &Near, f: u32, reach_m: f64, bound_m: &mut [f64; 2]) {
    let corners = near.corners(f);
    let (to, tree) = (near.to, near.tree);
    if corners.iter().any(|c| c.hit.face == u32::MAX) {
        return;
    }
    let directions = directions(corners.map(|c| c.at));
    let mut stack = vec![(corners, 0)];
    while let Some((corners, depth)) = stack.pop() {
        let enough_m = bound_m.map(enough);
        let settled = |best_m: &[f64; 2]| best_m[0] <= enough_m[0] && best_m[1] <= enough_m[1];
        let mut best_m = values(&corners, &directions, to, reach_m, enough_m);
        if !settled(&best_m) {
            // Not the nearest triangle perhaps, but one within reach.
            for face in within(&corners, reach_m, tree) {
                take_triangle(&mut best_m, &directions, &corners, to, face, reach_m);
            }
        }
        if !settled(&best_m) && depth < DEEPEST {
            quarter(&corners, to, tree).into_iter().for_each(|part| stack.push((part, depth + 1)));
            continue;
        }
        if best_m.iter().any(|b| b.is_infinite()) {
            best_m = values(&corners, &directions, to, f64::INFINITY, [f64::NEG_INFINITY; 2]);
        }
        for (bound_m, value_m) in bound_m.iter_mut().zip(best_m) {
            *bound_m = bound_m.max(value_m);
        }
    }
}

/// Tile triangles whose boxes are within reach of a corner, at most [`MOST_CANDIDATES`].
fn within(corners: &[Corner; 3], reach_m: f64, tree: &Bvh) -> Vec<u32> {
    let p = corners[0].at;
    let mut found = Vec::new();
    tree.overlapping(p - reach_m, p + reach_m, &mut |face| {
        if found.len() < MOST_CANDIDATES {
            found.push(face);
        }
    });
    found
}

/// More triangles within reach are not looked at: the bound is not as good then, but still one.
const MOST_CANDIDATES: usize = 64;

/// The face's normal, and up.
fn directions([a, b, c]: [DVec3; 3]) -> [DVec3; 2] {
    [(b - a).cross(c - a).try_normalize().unwrap_or(DVec3::Z), DVec3::Z]
}

/// A value up to here adds nothing worth a closer look.
fn enough(worst_m: f64) -> f64 {
    if worst_m.is_finite() { worst_m + TOLERANCE_M.max(TOLERANCE_SHARE * worst_m.abs()) } else { worst_m }
}

/// The least value found for each direction; no better than `enough_m` where a coarse look gives that.
fn values(corners: &[Corner; 3], directions: &[DVec3; 2], to: Surface, reach_m: f64, enough_m: [f64; 2]) -> [f64; 2] {
    let mut best_m = [f64::INFINITY; 2];
    // For each point of the face what is nearest to its nearest corner.
    let radius_m = cover_radius(corners.map(|c| c.at));
    if corners.iter().all(|c| c.hit.distance + radius_m <= reach_m) {
        for (best_m, direction) in best_m.iter_mut().zip(directions) {
            let along = corners.map(|c| direction.dot(c.at));
            let extent_m =
                along.into_iter().fold(f64::NEG_INFINITY, f64::max) - along.into_iter().fold(f64::INFINITY, f64::min);
            let offsets = corners.iter().map(|c| direction.dot(c.at - c.hit.point));
            *best_m = offsets.fold(f64::NEG_INFINITY, f64::max) + extent_m.min(radius_m);
        }
        if best_m[0] <= enough_m[0] && best_m[1] <= enough_m[1] {
            return best_m;
        }
    }
    for (k, c) in corners.iter().enumerate() {
        // One point of the tile for the whole face.
        let furthest_m = corners.iter().map(|e| (e.at - c.hit.point).length()).fold(0.0, f64::max);
        if furthest_m <= reach_m {
            take(&mut best_m, directions, corners.map(|e| e.at - c.hit.point));
        }
        if best_m[0] <= enough_m[0] && best_m[1] <= enough_m[1] {
            return best_m;
        }
        // One triangle of it.
        if corners[..k].iter().any(|e| e.hit.face == c.hit.face) {
            continue;
        }
        take_triangle(&mut best_m, directions, corners, to, c.hit.face, reach_m);
    }
    best_m
}

fn take_triangle(
    best_m: &mut [f64; 2],
    directions: &[DVec3; 2],
    corners: &[Corner; 3],
    to: Surface,
    face: u32,
    reach_m: f64,
) {
    let triangle = to.triangle(face);
    let offsets =
        corners.map(|e| e.at - if e.hit.face == face { e.hit.point } else { closest_on_triangle(e.at, &triangle) });
    if offsets.iter().all(|o| o.length() <= reach_m) {
        take(best_m, directions, offsets);
    }
}

fn take(best_m: &mut [f64; 2], directions: &[DVec3; 2], offsets: [DVec3; 3]) {
    for (best_m, direction) in best_m.iter_mut().zip(directions) {
        *best_m = best_m.min(offsets.iter().map(|o| direction.dot(*o)).fold(f64::NEG_INFINITY, f64::max));
    }
}

#[cfg(test)]
mod tests {
    use super::super::from_source;
    use super::*;
    use crate::ids::ClassId;

    type Shape = (Vec<DVec3>, Vec<[u32; 3]>);

    fn grid(n: usize, height: impl Fn(f64, f64) -> f64) -> Shape {
        let at = |x: usize, y: usize| (x as f64 / n as f64 * 10.0, y as f64 / n as f64 * 10.0);
        let points = (0..=n).flat_map(|y| (0..=n).map(move |x| at(x, y)));
        let positions = points.map(|(x, y)| DVec3::new(x, y, height(x, y))).collect();
        let m = n as u32 + 1;
        let cells = (0..n as u32).flat_map(|y| (0..n as u32).map(move |x| y * m + x));
        (positions, cells.flat_map(|a| [[a, a + 1, a + m + 1], [a, a + m + 1, a + m]]).collect())
    }

    fn deviation(source: &Shape, tile: &Shape) -> Deviation {
        let (ls, lt) = (vec![ClassId(0); source.1.len()], vec![ClassId(0); tile.1.len()]);
        let from = Surface { positions: &source.0, faces: &source.1, labels: &ls };
        let to = Surface { positions: &tile.0, faces: &tile.1, labels: &lt };
        from_source(from, to, &Bvh::new(&tile.0, &tile.1), 1).remove(0)
    }

    #[test]
    fn the_tile_never_sinks_deeper_than_stated() {
        let bumpy = grid(31, |x, y| (x * 1.3).sin() * (y * 0.7).cos());
        let coarse = grid(4, |x, y| (x * 1.3).sin() * (y * 0.7).cos() * 0.8);
        let stated = deviation(&bumpy, &coarse);
        // Both are heights over the plane: how much lower the tile is straight below is never less than with a point
        // nearby. What the dense sample sees at the nearest point is the other side of the interval.
        let tree = Bvh::new(&coarse.0, &coarse.1);
        let (mut below_m, mut deep_m) = (f64::NEG_INFINITY, f64::NEG_INFINITY);
        for f in &bumpy.1 {
            let [a, b, c] = f.map(|v| bumpy.0[v as usize]);
            let n = (b - a).cross(c - a).normalize();
            for p in [a, b, c, (a + b + c) / 3.0, (a + b) / 2.0] {
                let q = tree.closest(p, f64::INFINITY).unwrap().point;
                below_m = below_m.max(p.z - q.z);
                deep_m = deep_m.max(n.dot(p - q));
            }
        }
        assert!(stated.sunk_m <= below_m * 1.2 + 0.01, "{} for {below_m}", stated.sunk_m);
        assert!(stated.inside_m <= deep_m * 1.2 + 0.01, "{} for {deep_m}", stated.inside_m);
        // Some point of the tile within reach is that high, for every point of the source.
        for p in &bumpy.0 {
            let mut highest = f64::NEG_INFINITY;
            tree.overlapping(*p - stated.upper_m, *p + stated.upper_m, &mut |f| {
                let triangle = coarse.1[f as usize].map(|v| coarse.0[v as usize]);
                highest = triangle.iter().map(|q| q.z).fold(highest, f64::max);
            });
            assert!(p.z - highest <= stated.sunk_m, "{p} {highest} {}", stated.sunk_m);
        }
    }

    #[test]
    fn a_tile_above_its_source_is_safe_and_says_by_how_much() {
        let (low, high) = (grid(6, |_, _| 0.0), grid(2, |_, _| 0.25));
        let safe = deviation(&low, &high);
        // Rounded up to f32.
        let is = |m: f64, wanted: f64| (wanted..wanted + 1e-6).contains(&m);
        assert!(is(safe.inside_m, -0.25) && is(safe.sunk_m, -0.25), "{safe:?}");
        let sunk = deviation(&high, &low);
        assert!(is(sunk.inside_m, 0.25) && is(sunk.sunk_m, 0.25), "{sunk:?}");
    }

    #[test]
    fn a_lost_spike_counts_with_its_whole_height() {
        let spiky = grid(20, |x, y| if (x - 5.0).hypot(y - 5.0) < 0.1 { 3.0 } else { 0.0 });
        let sunk_m = deviation(&spiky, &grid(2, |_, _| 0.0)).sunk_m;
        assert!((3.0..3.2).contains(&sunk_m), "{sunk_m}");
    }
}
