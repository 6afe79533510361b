//! Parts of a face by what is nearest to their corners.

use glam::DVec3;

use super::Surface;
use crate::geo::bvh::{Bvh, Hit, closest_on_triangle};

/// A point with what is nearest to it.
#[derive(Clone, Copy)]
pub(in crate::tiles) struct Corner {
    pub at: DVec3,
    pub hit: Hit,
}

/// What is nearest where there is nothing.
pub(super) const FAR: Hit = Hit { face: u32::MAX, point: DVec3::ZERO, distance: f64::INFINITY };

/// The closest point, searched no further than the face that was closest nearby.
pub(in crate::tiles) fn closest(p: DVec3, near: Option<u32>, to: Surface, tree: &Bvh) -> Hit {
    closest_until(p, near, -1.0, to, tree)
}

/// The same, or any point that is within `enough_m`.
pub(super) fn closest_until(p: DVec3, near: Option<u32>, enough_m: f64, to: Surface, tree: &Bvh) -> Hit {
    let known = near.filter(|&f| f != u32::MAX).map(|face| {
        let point = closest_on_triangle(p, &to.triangle(face));
        Hit { face, point, distance: (point - p).length() }
    });
    match known {
        Some(known) if known.distance <= enough_m => known,
        _ => tree.closest_until(p, known.map_or(f64::INFINITY, |k| k.distance), enough_m).or(known).unwrap_or(FAR),
    }
}

/// The four parts of a triangle that its edges' middles make.
pub(in crate::tiles) fn quarter(corners: &[Corner; 3], to: Surface, tree: &Bvh) -> [[Corner; 3]; 4] {
    let middle = |i: usize, j: usize| {
        let at = (corners[i].at + corners[j].at) * 0.5;
        Corner { at, hit: closest(at, Some(corners[i].hit.face), to, tree) }
    };
    let [a, b, c] = *corners;
    let (ab, bc, ca) = (middle(0, 1), middle(1, 2), middle(2, 0));
    [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
}

/// No point of a triangle is further from its nearest corner.
pub(in crate::tiles) fn cover_radius([a, b, c]: [DVec3; 3]) -> f64 {
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
