//! On which side of a surface a point lies, and how far at most.
//!
//! Convention: faces are turned outwards (counter-clockwise from outside, as all formats here have it). A point is
//! outside where the vector to it from its nearest point agrees with the surface's normal there; inside where not.
//! On an edge the normals of both faces are added, on a vertex those of all faces about it by their angle (Bærentzen,
//! Aanæs, Signed distance computation using the angle weighted pseudonormal, 2005): exact for closed surfaces.
//!
//! # Limits
//! Beside an open border "inside" means below the tangent plane of the face nearest, which for scans is the ground.
//! Where an edge has three faces and more, or is a crack, the one nearest face decides.

use glam::DVec3;
use serde::Serialize;

use super::quality::NONE;
use super::surface::{Prepared, Surface};
use crate::geo::bvh::Hit;

/// How far the simplified surface lies on either side of the reference.
///
/// Seen from both surfaces: a point of the simplified one below the reference counts as inside, and so does a point of
/// the reference that stands out of the simplified one (a chimney that was cut off).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct SignedBounds {
    /// The furthest seen that the simplified surface sinks into the solid: what stands there would be hit unseen.
    pub inside_seen_m: f64,
    /// The furthest seen that it stands out of the solid.
    pub outside_seen_m: f64,
    /// Neither is more: the certified two-sided bound, which knows no side.
    pub either_upper_m: f64,
}

/// Normals of a surface's vertices and edges.
pub(super) struct Normals<'a> {
    vertex: Vec<DVec3>,
    neighbours: &'a [[u32; 3]],
}

/// A barycentric weight below this is zero: the point lies on the edge.
const ON_EDGE: f64 = 1e-9;

impl<'a> Normals<'a> {
    pub fn of(surface: &Prepared, neighbours: &'a [[u32; 3]]) -> Self {
        let mut vertex = vec![DVec3::ZERO; surface.points.len()];
        for (f, face) in surface.faces.iter().enumerate() {
            let normal = surface.normal(f as u32);
            let corners = surface.corners(f as u32);
            for k in 0..3 {
                let (to_next, to_last) = (corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k]);
                let angle = to_next.cross(to_last).length().atan2(to_next.dot(to_last));
                vertex[face[k] as usize] += normal * angle;
            }
        }
        Self { vertex, neighbours }
    }

    /// True if `p` is in front of the surface, whose nearest point is `hit`.
    fn is_outside(&self, surface: &Prepared, p: DVec3, hit: &Hit) -> bool {
        let [a, b, c] = surface.corners(hit.face);
        let normal = surface.cross(hit.face);
        let squared = normal.length_squared();
        let q = hit.point;
        let weight = |u: DVec3, v: DVec3| (u - q).cross(v - q).dot(normal) / squared;
        let zero = [weight(b, c), weight(c, a), weight(a, b)].map(|w| w < ON_EDGE || w.is_nan());
        let face = surface.faces[hit.face as usize];
        let pseudo = match zero.iter().filter(|z| **z).count() {
            0 => normal,
            1 => {
                // The edge opposite corner k runs from k + 1.
                let k = zero.iter().position(|z| *z).unwrap_or(0);
                let neighbour = self.neighbours[hit.face as usize][(k + 1) % 3];
                normal.normalize_or_zero() + if neighbour == NONE { DVec3::ZERO } else { surface.normal(neighbour) }
            }
            2 => self.vertex[face[zero.iter().position(|z| !*z).unwrap_or(0)] as usize],
            _ => {
                // A face without area: the vertex nearest to the point stands for it.
                let far = [a, b, c].map(|v| (v - q).length_squared());
                let nearest = (0..3).min_by(|&i, &j| far[i].total_cmp(&far[j])).unwrap_or(0);
                self.vertex[face[nearest] as usize]
            }
        };
        (p - q).dot(pseudo) >= 0.0
    }
}

/// The furthest points seen on either side of a surface, per class.
#[derive(Debug, Clone, Default)]
pub(super) struct Sides {
    pub outside: [f64; Surface::MOST_CLASSES],
    pub inside: [f64; Surface::MOST_CLASSES],
}

impl Sides {
    /// Takes up a point and its nearest one on `surface`.
    pub fn see(&mut self, class: u8, p: DVec3, hit: &Hit, surface: &Prepared, normals: &Normals) {
        let k = usize::from(class);
        // The side costs more than the distance and matters for record holders only.
        if hit.distance <= self.outside[k].min(self.inside[k]) {
            return;
        }
        let side = if normals.is_outside(surface, p, hit) { &mut self.outside[k] } else { &mut self.inside[k] };
        *side = side.max(hit.distance);
    }

    pub fn merge(&mut self, other: &Self) {
        for k in 0..Surface::MOST_CLASSES {
            self.outside[k] = self.outside[k].max(other.outside[k]);
            self.inside[k] = self.inside[k].max(other.inside[k]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::quality::Edges;

    /// A tent: its sharp ridge is where a face's own normal would answer wrongly.
    fn tent() -> Prepared {
        let at = DVec3::new;
        let positions =
            vec![at(0., 0., 0.), at(4., 0., 0.), at(4., 0.4, 0.), at(0., 0.4, 0.), at(0., 0.2, 3.), at(4., 0.2, 3.)];
        let faces = vec![[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 3, 2], [0, 2, 1]];
        Prepared::new(&Surface { positions, faces, class: None }, DVec3::ZERO)
    }

    #[test]
    fn points_about_a_sharp_closed_shape_are_told_apart() {
        let tent = tent();
        let edges = Edges::of(&tent);
        assert_eq!((edges.quality.border_edges, edges.quality.inconsistent_edges), (0, 0));
        let normals = Normals::of(&tent, &edges.neighbours);
        let side = |p: DVec3| normals.is_outside(&tent, p, &tent.nearest(p, 0).unwrap());
        for i in 0..400 {
            let p =
                DVec3::new(f64::from(i % 20) * 0.3 - 1.0, f64::from(i % 7) * 0.15 - 0.25, f64::from(i) * 0.01 - 0.3);
            let half = 0.2 * (1.0 - p.z / 3.0);
            let inside = p.z > 0.0 && p.z < 3.0 && p.x > 0.0 && p.x < 4.0 && (p.y - 0.2).abs() < half;
            assert_eq!(side(p), !inside, "{p}");
        }
        assert!(side(DVec3::new(2.0, 0.2, 3.5)), "above the ridge");
        assert!(side(DVec3::new(-1.0, 0.2, 4.0)), "beyond the gable's tip");
    }
}
