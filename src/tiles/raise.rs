//! Raises simplified tiles until no roof and no façade of the source stands out of them.
//!
//! In: a tile's surface and the source below it, part by part. Out: how far each vertex has to rise, and what holds then.
//!
//! # Method
//! Every point of a kept class is to have a point of the tile that is sideways within reach and no lower than its limit
//! allows. One tile triangle settles a whole source face: the highest points that it has within reach of the three corners
//! span what stands for the rest. Where none does, the triangle that is highest within reach of each corner rises by what
//! it lacks; then the parts of the face are looked at.
//!
//! Vertices move straight up, so what is within reach sideways stays so and what is high enough stays high enough: each
//! face is looked at once, and no other can undo it. Held to the nearest point in space, as before, a rise changed what
//! was nearest, and five rounds ended a metre short.
//!
//! # Promises
//! - Every point of the kept classes has a point of the tile no further sideways than [`Held::reach_m`] and no more than
//!   [`Held::sunk_m`] lower (`every_point_of_a_roof_is_held_up`).
//! - A vertex moves up only, so it stays on its wall, and a wall may rise more (`a_flattened_roof_rises_to_its_ridge`).
//!
//! # Limits
//! A lost chimney lifts the roof around it, and two-sided errors grow. Clutter (trees, masts, cranes) is not kept.

use glam::{DVec2, DVec3};

use super::error::{Corner, Surface, closest, cover_radius, quarter};
use super::levels::TileMesh;
use crate::geo::bvh::Bvh;
use crate::ids::{ClassId, ClassScheme};

/// What is kept.
const KEPT: [ClassId; 2] = [ClassId::FACADE, ClassId::ROOF];
/// So much of the budget is used: what rounding moves comes on top.
const USED_SHARE: f64 = 0.85;
/// Source faces for which no one triangle of the tile stands are quartered, at most this often, until they are no higher
/// than this share of the limit and no wider than this share of the reach.
const DEEPEST: u32 = 8;
const APART_HEIGHT_SHARE: f64 = 0.5;
const APART_REACH_SHARE: f64 = 0.1;
/// Looked at is what is sideways within so many times the distance that the class has moved anyway. With once an eave
/// that lies in by a little is mended by its wall's foot, which rises by metres; with more, what is told is worth less.
const REACH: f64 = 3.0;
/// Looked at is what is as near as this at least.
const LEAST_REACH_M: f64 = 1e-3;
/// Places are within reach if they are by this share: what is told of them holds after rounding.
const WITHIN: f64 = 1.0 - 1e-9;

/// How much lower than a source of each class its tile may be, metres; infinite for classes that are not kept.
pub fn limits_m(scheme: &ClassScheme) -> Vec<f64> {
    let mut limits_m = vec![f64::INFINITY; scheme.len()];
    for class in KEPT {
        limits_m[class.index()] = scheme[class].budget_m * USED_SHARE;
    }
    limits_m
}

/// What holds of a class once a tile has risen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Held {
    /// How far sideways it was looked for, metres.
    pub reach_m: f64,
    /// No point of the source is more than this above the tile there, metres; negative infinity if there is none.
    pub sunk_m: f64,
}

/// A tile on its way up; see the module.
pub struct Rises<'a> {
    mesh: &'a TileMesh,
    /// Of the surface as it was: boxes keep their plan.
    tree: Bvh,
    limits_m: &'a [f64],
    /// Vertices as they have risen so far.
    risen: Vec<DVec3>,
    held: Vec<Held>,
    /// By class how far sideways is looked, metres.
    reach_m: Vec<f64>,
    /// Triangle that stood for a face lately: it mostly stands for the next.
    last: u32,
}

impl<'a> Rises<'a> {
    /// Of a tile that nothing was held against yet.
    pub fn of(mesh: &'a TileMesh, limits_m: &'a [f64]) -> Self {
        Self {
            mesh,
            tree: Bvh::new(&mesh.positions, &mesh.faces),
            limits_m,
            risen: mesh.positions.clone(),
            held: vec![Held { reach_m: LEAST_REACH_M, sunk_m: f64::NEG_INFINITY }; limits_m.len()],
            reach_m: vec![LEAST_REACH_M; limits_m.len()],
            last: 0,
        }
    }

    /// By vertex, metres, none negative; and by class what holds then.
    pub fn finish(self) -> (Vec<f64>, Vec<Held>) {
        (self.risen.iter().zip(&self.mesh.positions).map(|(risen, p)| risen.z - p.z).collect(), self.held)
    }

    /// Holds a part of the source against the tile: triangles with their classes.
    pub fn hold(&mut self, source: impl Iterator<Item = ([DVec3; 3], ClassId)>) {
        let to = Surface { positions: &self.mesh.positions, faces: &self.mesh.faces, labels: &self.mesh.labels };
        if to.faces.is_empty() {
            return;
        }
        let kept = source.filter(|(_, class)| self.limits_m[class.index()].is_finite());
        let mut near = None;
        let corner = |at: DVec3, near: &mut Option<u32>| {
            let hit = closest(at, *near, to, &self.tree);
            *near = Some(hit.face);
            Corner { at, hit }
        };
        let found: Vec<([Corner; 3], ClassId)> = kept
            .map(|(triangle, class)| (triangle.map(|at| corner(at, &mut near)), class))
            .filter(|(corners, _)| corners.iter().all(|c| c.hit.face != u32::MAX))
            .collect();
        for (corners, class) in &found {
            let reach_m = &mut self.reach_m[class.index()];
            *reach_m = corners.iter().map(|c| REACH * c.hit.distance).fold(*reach_m, f64::max);
        }
        let mut stack = Vec::new();
        for (corners, class) in found {
            stack.push((corners, 0));
            while let Some((corners, depth)) = stack.pop() {
                if !self.settle(&corners, class, depth == DEEPEST) {
                    stack.extend(quarter(&corners, to, &self.tree).map(|part| (part, depth + 1)));
                }
            }
        }
    }

    /// Raises what stands for a face until it is high enough. False if parts of it need different triangles.
    fn settle(&mut self, corners: &[Corner; 3], class: ClassId, at_last: bool) -> bool {
        let reach_m = self.reach_m[class.index()];
        let limit_m = self.limits_m[class.index()];
        let lately = [self.last, corners[0].hit.face, corners[1].hit.face, corners[2].hit.face];
        let mut best = self.best(corners, &lately, reach_m);
        if best.0 > limit_m {
            let around = self.around(corners, reach_m);
            best = self.best(corners, &around, reach_m);
            if best.0 > limit_m {
                for c in corners {
                    let (_, face) = self.best(&[*c; 3], &around, reach_m);
                    self.raise(c.at, face, limit_m, reach_m);
                }
                best = self.best(corners, &around, reach_m);
            }
        }
        if best.0 > limit_m {
            let heights = corners.map(|c| c.at.z);
            let extent_m = heights.into_iter().fold(f64::NEG_INFINITY, f64::max)
                - heights.into_iter().fold(f64::INFINITY, f64::min);
            let is_low = extent_m <= APART_HEIGHT_SHARE * limit_m;
            let is_narrow = cover_radius(corners.map(|c| c.at)) <= APART_REACH_SHARE * reach_m;
            if !(at_last || is_low && is_narrow) {
                return false;
            }
            best.0 = self.settle_apart(corners, class, limit_m - extent_m) + extent_m;
        }
        let held = &mut self.held[class.index()];
        *held = Held { reach_m: held.reach_m.max(reach_m), sunk_m: held.sunk_m.max(best.0) };
        self.last = best.1;
        true
    }

    /// A small face whose corners different triangles stand for: each, high enough above its corner, does for all that is
    /// nearest to that. Returns how much lower than its corner the lowest is.
    fn settle_apart(&mut self, corners: &[Corner; 3], class: ClassId, limit_m: f64) -> f64 {
        // A little more than to the nearest point: it is not lost to rounding.
        let nearest_m = corners.iter().map(|c| c.hit.distance).fold(0.0, f64::max) * (1.0 + 1e-6);
        let reach_m = nearest_m.max(self.reach_m[class.index()]);
        let around = self.around(corners, reach_m);
        let mut below_m = f64::NEG_INFINITY;
        for c in corners {
            let (_, face) = self.best(&[*c; 3], &around, reach_m);
            self.raise(c.at, face, limit_m, reach_m);
            below_m = below_m.max(self.best(&[*c; 3], &around, reach_m).0);
        }
        let held = &mut self.held[class.index()].reach_m;
        *held = held.max(reach_m + cover_radius(corners.map(|c| c.at)));
        below_m
    }

    /// Tile triangles that may have points within reach of a face.
    fn around(&self, corners: &[Corner; 3], reach_m: f64) -> Vec<u32> {
        let low = corners.iter().map(|c| c.at).fold(DVec3::INFINITY, DVec3::min) - reach_m;
        let high = corners.iter().map(|c| c.at).fold(DVec3::NEG_INFINITY, DVec3::max) + reach_m;
        let mut around: Vec<u32> = corners.iter().map(|c| c.hit.face).collect();
        let (low, high) = (low.with_z(f64::NEG_INFINITY), high.with_z(f64::INFINITY));
        self.tree.overlapping(low, high, &mut |face| around.push(face));
        around
    }

    /// Which of some tile triangles is lower than a face by least, and by how much; infinite if none is within reach.
    fn best(&self, corners: &[Corner; 3], faces: &[u32], reach_m: f64) -> (f64, u32) {
        faces.iter().fold((f64::INFINITY, faces[0]), |best, face| self.better(best, corners, *face, reach_m))
    }

    /// The better of what was found and a tile triangle: how much lower than all of the face it is within reach.
    fn better(&self, best: (f64, u32), corners: &[Corner; 3], face: u32, reach_m: f64) -> (f64, u32) {
        let triangle = self.triangle(face);
        let mut below_m = f64::NEG_INFINITY;
        for c in corners {
            match highest(c.at, &triangle, reach_m) {
                Some(q) => below_m = below_m.max(c.at.z - q.z),
                None => return best,
            }
            if below_m >= best.0 {
                return best;
            }
        }
        (below_m, face)
    }

    fn triangle(&self, face: u32) -> [DVec3; 3] {
        self.mesh.faces[face as usize].map(|v| self.risen[v as usize])
    }

    /// Raises a triangle by the least that brings its highest point within reach up to the limit below `p`.
    fn raise(&mut self, p: DVec3, face: u32, limit_m: f64, reach_m: f64) {
        let triangle = self.triangle(face);
        let Some(q) = highest(p, &triangle, reach_m) else { return };
        let missing_m = p.z - q.z - limit_m;
        let shares = shares(&triangle, q);
        let square: f64 = shares.iter().map(|s| s * s).sum();
        if missing_m > 0.0 && square > 0.0 {
            for (share, v) in shares.iter().zip(self.mesh.faces[face as usize]) {
                self.risen[v as usize].z += missing_m * share / square;
            }
        }
    }
}

/// The highest point of a triangle that is sideways within reach of `p`, or `None`.
fn highest(p: DVec3, triangle: &[DVec3; 3], reach_m: f64) -> Option<DVec3> {
    let reach_m = reach_m * WITHIN;
    let [a, b, c] = *triangle;
    let mut best: Option<DVec3> = None;
    let mut take = |q: DVec3| best = best.filter(|b| b.z >= q.z).or(Some(q));
    // A height is linear over what is within reach of an edge, and over the triangle.
    for (from, to) in [(a, b), (b, c), (c, a)] {
        let (along, offset) = ((to - from).truncate(), (from - p).truncate());
        let (square, dot) = (along.length_squared(), offset.dot(along));
        let outside = offset.length_squared() - reach_m * reach_m;
        let under_root = dot * dot - square * outside;
        let (first, last) = if square > 0.0 && under_root >= 0.0 {
            let root = under_root.sqrt();
            (((-dot - root) / square).max(0.0), ((-dot + root) / square).min(1.0))
        } else {
            (0.0, if square > 0.0 || outside > 0.0 { -1.0 } else { 1.0 })
        };
        if first <= last {
            take(from + (to - from) * if to.z > from.z { last } else { first });
        }
    }
    let normal = (b - a).cross(c - a);
    if normal.z != 0.0 {
        let uphill = (-normal.truncate() / normal.z).try_normalize().unwrap_or(DVec2::ZERO);
        let at = p.truncate() + uphill * reach_m;
        let part = |q: DVec3, r: DVec3| (q.truncate() - at).perp_dot(r.truncate() - at) * normal.z.signum();
        let parts = [part(b, c), part(c, a), part(a, b)];
        let total: f64 = parts.iter().sum();
        if total > 0.0 && parts.iter().all(|part| *part >= 0.0) {
            take((a * parts[0] + b * parts[1] + c * parts[2]) / total);
        }
    }
    best
}

/// Barycentric coordinates of a point of a triangle, none negative.
fn shares(triangle: &[DVec3; 3], p: DVec3) -> [f64; 3] {
    let [a, b, c] = *triangle;
    let normal = (b - a).cross(c - a);
    let part = |q: DVec3, r: DVec3| ((q - p).cross(r - p)).dot(normal).max(0.0);
    let parts = [part(b, c), part(c, a), part(a, b)];
    let total: f64 = parts.iter().sum();
    if total > 0.0 { parts.map(|x| x / total) } else { [1.0 / 3.0; 3] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flattened_roof_rises_to_its_ridge() {
        let p = DVec3::new;
        let mesh = TileMesh {
            positions: vec![p(0.0, 0.0, 5.0), p(4.0, 0.0, 5.0), p(4.0, 4.0, 5.0), p(0.0, 4.0, 5.0)],
            faces: vec![[0, 1, 2], [0, 2, 3]],
            labels: vec![ClassId::ROOF; 2],
        };
        let ridge = [[p(0.0, 0.0, 5.0), p(4.0, 0.0, 5.0), p(2.0, 2.0, 6.0)]];
        let mut rises = Rises::of(&mesh, &[0.25; 4]);
        rises.hold(ridge.into_iter().map(|t| (t, ClassId::ROOF)));
        let (rises, held) = rises.finish();
        assert!(rises.iter().all(|r| *r >= 0.0));
        let raised: Vec<DVec3> = mesh.positions.iter().zip(&rises).map(|(p, r)| *p + DVec3::Z * *r).collect();
        let Held { reach_m, sunk_m } = held[ClassId::ROOF.index()];
        assert!(sunk_m <= 0.25 && reach_m <= 3.3, "{sunk_m} {reach_m}");
        let top = p(2.0, 2.0, 6.0);
        let highest = mesh.faces.iter().filter_map(|f| highest(top, &f.map(|v| raised[v as usize]), reach_m));
        let height = highest.map(|q| q.z).fold(0.0, f64::max);
        assert!(6.0 - height <= 0.25 + 1e-6, "{height}");
        assert!(raised.iter().all(|p| p.z <= 6.5), "not much higher than it has to be: {raised:?}");
    }

    #[test]
    fn what_is_within_its_budget_stays() {
        let p = DVec3::new;
        let mesh = TileMesh {
            positions: vec![p(0.0, 0.0, 5.0), p(4.0, 0.0, 5.0), p(4.0, 4.0, 5.0)],
            faces: vec![[0, 1, 2]],
            labels: vec![ClassId::ROOF],
        };
        let source = [[p(1.0, 0.5, 5.2), p(2.0, 0.5, 5.2), p(2.0, 1.0, 5.2)]];
        let mut rises = Rises::of(&mesh, &[0.25; 4]);
        rises.hold(source.into_iter().map(|t| (t, ClassId::ROOF)));
        assert_eq!(rises.finish().0, [0.0; 3]);
    }

    #[test]
    fn every_point_of_a_roof_is_held_up() {
        let p = DVec3::new;
        // A gable roof with humps on it, of which the tile has two planes that lie in its valleys.
        let roof = |x: f64| 5.0 - 0.05 * x.abs();
        let row = |y: f64| [-4.8, 0.0, 4.8].map(|x| p(x, y, roof(x)));
        let tile = TileMesh {
            positions: [row(-4.8), row(4.8)].concat(),
            faces: vec![[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]],
            labels: vec![ClassId::ROOF; 4],
        };
        let at = |i: i32, j: i32| {
            let (x, y) = (f64::from(i) * 0.4, f64::from(j) * 0.4);
            p(x, y, roof(x) + 0.3 * (x * 1.7).sin().abs() * (y * 1.1).cos().abs())
        };
        let cells = (-12..12).flat_map(|i| (-12..12).map(move |j| (i, j)));
        let source: Vec<[DVec3; 3]> = cells
            .flat_map(|(i, j)| {
                let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                [[a, b, c], [a, c, d]]
            })
            .collect();
        let mut rises = Rises::of(&tile, &[0.01; 4]);
        rises.hold(source.iter().map(|t| (*t, ClassId::ROOF)));
        let (rises, held) = rises.finish();
        assert!(rises.iter().any(|r| *r > 0.01) && rises.iter().all(|r| (0.0..0.7).contains(r)), "{rises:?}");
        let raised: Vec<DVec3> = tile.positions.iter().zip(&rises).map(|(p, r)| *p + DVec3::Z * *r).collect();
        let Held { reach_m, sunk_m } = held[ClassId::ROOF.index()];
        assert!(sunk_m <= 0.01 && reach_m < 1.0, "{sunk_m} {reach_m}");
        for [a, b, c] in source {
            for q in [a, b, c, (a + b) / 2.0, (b + c) / 2.0, (a + b + c) / 3.0] {
                let tops = tile.faces.iter().filter_map(|f| highest(q, &f.map(|v| raised[v as usize]), reach_m));
                let top = tops.map(|t| t.z).fold(f64::NEG_INFINITY, f64::max);
                assert!(q.z - top <= sunk_m + 1e-6, "{q} {top}");
            }
        }
    }

    #[test]
    fn the_highest_point_within_reach_is_found_on_edges_and_between_them() {
        let p = DVec3::new;
        let slope = [p(0.0, 0.0, 0.0), p(10.0, 0.0, 10.0), p(0.0, 10.0, 0.0)];
        let height = |at: DVec3, reach_m: f64| highest(at, &slope, reach_m).map(|q| (q.z * 1e6).round() / 1e6);
        assert_eq!(height(p(3.0, 3.0, -50.0), 1.0), Some(4.0), "uphill, inside");
        assert_eq!(height(p(9.5, 0.0, 0.0), 2.0), Some(10.0), "a corner");
        assert_eq!(height(p(3.0, -1.0, 0.0), 1.25), Some(3.75), "an edge");
        assert_eq!(height(p(3.0, -2.0, 0.0), 1.25), None);
        let wall = [p(0.0, 0.0, 0.0), p(4.0, 0.0, 0.0), p(2.0, 0.0, 6.0)];
        let top = highest(p(1.5, 0.5, 0.0), &wall, 0.7).unwrap();
        assert!((top.z - (1.5 + 0.24f64.sqrt()) * 3.0).abs() < 1e-6, "a wall has no plan: {top}");
    }
}
