//! Closes the interval of each class's largest distance: what may pass it is cut up until it does not.
//!
//! In: faces that no one triangle near them settles. Out: `lower_m` and `upper_m` of each class's [`Deviation`].
//!
//! # Method
//! Branch and bound over convex pieces of faces, the worst faces first. A piece is settled by one triangle of the other
//! surface, as the distance to that is convex: by the one that its face was cut along, or the one nearest to its middle.
//! Or by one point of the other surface near its middle, if the piece is small enough. Else it is cut along that
//! triangle's outline, so that pieces come to lie over one triangle each.
//!
//! # Cost
//! About ten pieces a tile face and as many a source face that gets here, 0.5 µs each. Quartered instead, and bounded by
//! their corners' distances, the same faces of five tiles of a city (the finest simplified level) took 2.6 times as long.

use super::corners::{closest_until, cover_radius};
use super::signed::{self, Sides};
use super::{Corner, Deviation, Surface, good};
use crate::geo::bvh::{Bvh, closest_on_triangle};
use crate::geo::convex::Convex;

/// So many faces are taken before all others, the worst first: they show how far the surfaces are apart, and then most
/// of the others are near enough as they are.
const FIRST: usize = 256;
/// A face is cut into at most about so many pieces.
const MOST_PIECES: usize = 16_384;

/// A face that is not settled.
pub(super) struct Pending {
    pub face: u32,
    pub class: usize,
    /// No better is known, metres.
    pub bound_m: f64,
    /// A triangle of the other surface that is near.
    pub near: u32,
}

/// Part of a face, and a triangle of the other surface that is near.
#[derive(Clone, Copy)]
struct Piece {
    shape: Convex,
    near: u32,
}

/// From one surface to another.
pub(super) struct Search<'a> {
    pub from: Surface<'a>,
    pub to: Surface<'a>,
    pub tree: &'a Bvh,
}

impl Search<'_> {
    /// Filed by the distances of its corners, which bound the face already if it is small.
    pub fn pending(&self, face: u32, corners: [&Corner; 3]) -> Pending {
        let furthest_m = corners.iter().map(|c| c.hit.distance).fold(0.0, f64::max);
        Pending {
            face,
            class: self.from.labels[face as usize].index(),
            bound_m: furthest_m + cover_radius(corners.map(|c| c.at)),
            near: corners[0].hit.face,
        }
    }

    /// Looks at all that is pending; `sides` takes what pieces of each face say of [`signed`].
    pub fn close(&self, mut pending: Vec<Pending>, found: &mut [Deviation], mut sides: Option<&mut Sides>) {
        let first = FIRST.min(pending.len());
        let worse = |a: &Pending, b: &Pending| b.bound_m.total_cmp(&a.bound_m).then(a.face.cmp(&b.face));
        if first > 0 {
            pending.select_nth_unstable_by(first - 1, worse);
            pending[..first].sort_unstable_by(worse);
            // Neighbours look at the same places.
            pending[first..].sort_unstable_by_key(|p| p.face);
        }
        let mut stack = Vec::new();
        for face in pending {
            let found = &mut found[face.class];
            if face.near == u32::MAX || (sides.is_none() && face.bound_m <= good(found)) {
                found.upper_m = found.upper_m.max(face.bound_m);
                continue;
            }
            let corners = self.from.triangle(face.face);
            let mut side = sides.is_some().then(|| signed::Side::of(corners));
            stack.push(Piece { shape: corners.into(), near: face.near });
            let mut left = MOST_PIECES;
            while let Some(piece) = stack.pop() {
                left = left.saturating_sub(1);
                self.take(piece, found, side.as_mut(), left == 0, &mut stack);
            }
            if let (Some(sides), Some(side)) = (sides.as_deref_mut(), side) {
                sides[face.face as usize] = side.rounded_up();
            }
        }
        for d in found {
            d.upper_m = d.upper_m.max(d.lower_m);
        }
    }

    /// Settles a piece, or cuts it unless it is the last to be looked at.
    fn take(
        &self,
        piece: Piece,
        found: &mut Deviation,
        mut side: Option<&mut signed::Side>,
        is_last: bool,
        stack: &mut Vec<Piece>,
    ) {
        if self.by_triangle(&piece, piece.near, found, side.as_deref_mut()) {
            return;
        }
        let (middle, radius) = piece.shape.ball();
        let enough_m = good(found) - radius;
        let hit = closest_until(middle, Some(piece.near), enough_m, self.to, self.tree);
        if hit.distance > enough_m {
            // It was searched to the end.
            found.lower_m = found.lower_m.max(hit.distance);
        }
        if is_last || hit.distance + radius <= good(found) {
            found.upper_m = found.upper_m.max(hit.distance + radius);
            if let Some(side) = side {
                piece.shape.corners().iter().for_each(|p| side.take(p - hit.point));
            }
            return;
        }
        if hit.face == piece.near || !self.by_triangle(&piece, hit.face, found, side) {
            let parts = piece.shape.cut(self.to.triangle(hit.face), middle, radius);
            stack.extend(parts.map(|shape| Piece { shape, near: hit.face }));
        }
    }

    /// Settles a piece if no corner is too far from one triangle.
    fn by_triangle(&self, piece: &Piece, near: u32, found: &mut Deviation, side: Option<&mut signed::Side>) -> bool {
        let (triangle, good_m) = (self.to.triangle(near), good(found));
        let offset = |p: &glam::DVec3| p - closest_on_triangle(*p, &triangle);
        let mut squared = 0.0f64;
        for p in piece.shape.corners() {
            squared = squared.max(offset(p).length_squared());
            if squared > good_m * good_m {
                return false;
            }
        }
        found.upper_m = found.upper_m.max(squared.sqrt());
        if let Some(side) = side {
            piece.shape.corners().iter().for_each(|p| side.take(offset(p)));
        }
        true
    }
}
