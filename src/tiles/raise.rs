//! Raises simplified tiles where they are lower than a roof or a façade of the source.
//!
//! In: a tile's surface and the source below it. Out: how far each vertex has to rise; none sinks.
//!
//! # Method
//! Every source face of a kept class is held against the tile triangle that is least below it, within reach; where it is
//! more than the class's budget at scale 1 below, the triangle's vertices rise by the least that mends it. What has risen
//! may then be nearest to something else: the caller asks again.
//!
//! # Promises
//! A vertex moves up only, so it stays on its wall (`a_flattened_roof_rises_to_its_ridge`). That nothing sinks deeper is
//! not asserted here: `signed` certifies each tile afterwards, and the build warns where it cannot.
//!
//! # Limits
//! Budgets are not reached everywhere: on the demo quarter the two finest simplified levels end 0.07 to 0.13 m low, the root
//! 0.5 (roofs) to 1.1 m (façades). A lost chimney lifts the roof around it, and two-sided errors grow. Clutter (trees, masts, cranes) is not kept.

use glam::DVec3;

use super::error::{Corner, Surface, closest};
use super::levels::TileMesh;
use super::signed::{quarter, within};
use crate::geo::bvh::{Bvh, closest_on_triangle};
use crate::ids::{ClassId, ClassScheme};

/// What is kept.
const KEPT: [ClassId; 2] = [ClassId::FACADE, ClassId::ROOF];
/// So much of the budget is used: the certificate has a tolerance of its own.
const USED_SHARE: f64 = 0.85;
/// Source faces are quartered at most this often.
const DEEPEST: u32 = 4;

/// How deep a source of each class may be above its tile, metres; infinite for classes that are not kept.
pub fn limits_m(scheme: &ClassScheme) -> Vec<f64> {
    let mut limits_m = vec![f64::INFINITY; scheme.len()];
    for class in KEPT {
        limits_m[class.index()] = scheme[class].budget_m * USED_SHARE;
    }
    limits_m
}

/// How far each vertex of a tile has to rise; see the module.
pub struct Rises<'a> {
    lift: Lift<'a>,
    tree: Bvh,
    limits_m: &'a [f64],
}

impl<'a> Rises<'a> {
    /// Of a tile that nothing was held against yet.
    pub fn of(mesh: &'a TileMesh, limits_m: &'a [f64]) -> Self {
        let to = Surface { positions: &mesh.positions, faces: &mesh.faces, labels: &mesh.labels };
        let lift = Lift { to, rises: vec![0.0f64; mesh.positions.len()], reach_m: vec![1e-3; limits_m.len()] };
        Self { lift, tree: Bvh::new(&mesh.positions, &mesh.faces), limits_m }
    }

    /// By vertex, metres; none is negative.
    pub fn into_metres(self) -> Vec<f64> {
        self.lift.rises
    }

    /// Holds a part of the source against the tile: triangles with their classes.
    pub fn hold(&mut self, source: impl Iterator<Item = ([DVec3; 3], ClassId)>) {
        let Self { lift, tree, limits_m } = self;
        let to = lift.to;
        let mut near = None;
        let mut found = |triangle: [DVec3; 3]| {
            triangle.map(|at| {
                let corner = Corner { at, hit: closest(at, near, to, tree) };
                near = Some(corner.hit.face);
                corner
            })
        };
        let kept = source.filter(|(_, class)| limits_m[class.index()].is_finite());
        let held: Vec<([Corner; 3], ClassId)> = kept.map(|(triangle, class)| (found(triangle), class)).collect();
        // No point of the tile further away than this may stand for one of the source: the certificate asks the same.
        for (corners, class) in &held {
            let reach_m = &mut lift.reach_m[class.index()];
            *reach_m = corners.iter().map(|c| c.hit.distance).fold(*reach_m, f64::max);
        }
        let mut stack = Vec::new();
        for (corners, class) in held {
            let (limit_m, reach_m) = (limits_m[class.index()], lift.reach_m[class.index()]);
            if corners[0].hit.face == u32::MAX {
                continue;
            }
            stack.push((corners, 0));
            while let Some((corners, depth)) = stack.pop() {
                let (mut below_m, mut face) = lift.least_below(&corners, reach_m);
                if below_m <= limit_m {
                    continue;
                }
                // Not the nearest perhaps, but one within reach that is high enough, or nearly.
                for other in within(&corners, reach_m, tree) {
                    let value_m = lift.value(&corners, other, reach_m);
                    if value_m < below_m {
                        (below_m, face) = (value_m, other);
                    }
                }
                if below_m <= limit_m {
                    continue;
                }
                if below_m.is_infinite() && depth < DEEPEST {
                    quarter(&corners, to, tree).into_iter().for_each(|part| stack.push((part, depth + 1)));
                } else {
                    lift.raise(&corners, face, limit_m);
                }
            }
        }
    }
}

/// A tile on its way up.
struct Lift<'a> {
    to: Surface<'a>,
    /// So far, by vertex, metres.
    rises: Vec<f64>,
    /// By class.
    reach_m: Vec<f64>,
}

impl Lift<'_> {
    /// How much lower than a point its nearest on a tile triangle is after the rises so far, and that one's place in the
    /// triangle.
    fn below(&self, c: &Corner, face: u32) -> (f64, [f64; 3]) {
        let vertices = self.to.faces[face as usize];
        let triangle = vertices.map(|v| self.to.positions[v as usize]);
        let at = if c.hit.face == face { c.hit.point } else { closest_on_triangle(c.at, &triangle) };
        let shares = shares(&triangle, at);
        let risen: f64 = (0..3).map(|k| shares[k] * self.rises[vertices[k] as usize]).sum();
        (c.at.z - at.z - risen, shares)
    }

    /// How much lower than all of the face one tile triangle is, and which; of those nearest to its corners the best
    /// that all corners reach, or where there is none the one nearest to the first.
    fn least_below(&self, corners: &[Corner; 3], reach_m: f64) -> (f64, u32) {
        let each = corners.map(|c| (self.value(corners, c.hit.face, reach_m), c.hit.face));
        let first = (f64::INFINITY, corners[0].hit.face);
        each.into_iter().fold(first, |best, one| if one.0 < best.0 { one } else { best })
    }

    /// How much lower than all of the face one tile triangle is; infinite if a corner does not reach it.
    fn value(&self, corners: &[Corner; 3], face: u32, reach_m: f64) -> f64 {
        let triangle = self.to.faces[face as usize].map(|v| self.to.positions[v as usize]);
        let reached = corners.iter().all(|e| (closest_on_triangle(e.at, &triangle) - e.at).length() <= reach_m);
        let below = corners.iter().map(|e| self.below(e, face).0);
        if reached { below.fold(f64::NEG_INFINITY, f64::max) } else { f64::INFINITY }
    }

    /// Raises the triangle by the least that brings it within the limit at each corner's nearest point.
    fn raise(&mut self, corners: &[Corner; 3], face: u32, limit_m: f64) {
        for c in corners {
            let (below_m, shares) = self.below(c, face);
            let missing_m = below_m - limit_m;
            let square: f64 = shares.iter().map(|s| s * s).sum();
            if missing_m > 0.0 && square > 0.0 {
                for (share, v) in shares.iter().zip(self.to.faces[face as usize]) {
                    self.rises[v as usize] += missing_m * share / square;
                }
            }
        }
    }
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
        let rises = rises.into_metres();
        assert!(rises.iter().all(|r| *r >= 0.0));
        let raised: Vec<DVec3> = mesh.positions.iter().zip(&rises).map(|(p, r)| *p + DVec3::Z * *r).collect();
        // Straight below the ridge, on the diagonal.
        let height = (raised[0].z + raised[2].z) / 2.0;
        assert!((6.0 - height) <= 0.25 + 1e-9, "{height}");
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
        assert_eq!(rises.into_metres(), [0.0; 3]);
    }
}
