//! An interval that holds the largest distance from one surface to another: a proof, not a sample's maximum.
//!
//! # Method
//! Branch and bound over convex pieces of the first surface's faces.
//! 1. Lower bound: any point's distance. Known before the search from all vertices and samples.
//! 2. Upper bounds of a piece: the distance to a triangle is convex, so no point of the piece is further from triangle
//!    t than its furthest corner (Guthe, Borodin, Klein 2005), for the triangles nearest to its corners and middle; and
//!    its middle's distance plus its radius, as distances to a surface change no faster than the point moves.
//! 3. A piece whose upper bound is at most the lower bound plus the tolerance is settled: only what may hold the
//!    maximum is looked at closely. All others are cut in two along the nearest triangle's outline, so that pieces
//!    come to lie over one triangle each, where the bound is sharp; or through the middle where no outline passes.
//! 4. Per class of the reference: where the reference is cut, a piece has its face's class; where it is searched, a
//!    piece has all classes that a nearest point of it might have, found by a ball in the tree. A point between two
//!    classes, no further from one than from the other by more than the tolerance, counts for both.
//!
//! # Promises
//! `lower ≤ truth ≤ upper` always (`the_interval_holds_what_brute_force_finds`); `upper ≤ lower + tolerance` unless the limit of pieces was reached. Chunks begin
//! from the same bounds and are folded in order: the same for any number of threads.
//!
//! # Limits
//! The upper bound stops once it is within the tolerance: surfaces that are equal have an interval up to as wide.

use rayon::prelude::*;
use serde::Serialize;

use super::surface::{Near, Prepared, Surface};
use crate::geo::convex::Convex;

/// Certified bounds of a largest distance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    /// The distance of a point that was found.
    pub lower_m: f64,
    /// No point is further.
    pub upper_m: f64,
}

impl Interval {
    /// Of the larger of two distances.
    pub fn max(self, other: Self) -> Self {
        Self { lower_m: self.lower_m.max(other.lower_m), upper_m: self.upper_m.max(other.upper_m) }
    }
}

/// Faces that share bounds as they grow; small, as a few faces may need most of the work.
const FACES_PER_CHUNK: usize = 256;
/// Distances in f64 are right to this share of the coordinates.
const ROUNDING: f64 = 1e-14;

/// Per class, and whether anything was found of it.
type PerClass = [Option<f64>; Surface::MOST_CLASSES];

/// Where the class of a distance comes from.
#[derive(Clone, Copy)]
pub(super) enum Classes<'a> {
    /// All are one.
    One,
    /// From the face that the point lies on.
    OfFrom,
    /// From the face nearest to the point; with the class masks of that surface's tree.
    OfTo(&'a [u32]),
}

/// One direction to be certified.
pub(super) struct Search<'a> {
    /// The surface whose points are meant.
    pub from: &'a Prepared,
    /// The surface they are measured to; must have faces.
    pub to: &'a Prepared,
    /// Per point of `from` the nearest on `to`.
    pub near: &'a [Near],
    /// Whose classes the intervals are of.
    pub classes: Classes<'a>,
    /// Distances known to occur, per class.
    pub seen: PerClass,
    /// Wanted width of the interval, metres.
    pub tolerance_m: f64,
    /// Pieces after which a chunk takes what bounds it has.
    pub most_pieces: usize,
}

impl Search<'_> {
    /// The interval of each class that `from` (or the nearest points on `to`) has.
    pub fn run(&self) -> Vec<Option<Interval>> {
        let floor = self.floor();
        let chunks = self.from.faces.len().div_ceil(FACES_PER_CHUNK);
        let bounds: Vec<Bounds> = (0..chunks)
            .into_par_iter()
            .map(|chunk| {
                let first = chunk * FACES_PER_CHUNK;
                let last = self.from.faces.len().min(first + FACES_PER_CHUNK);
                let mut run = Run {
                    search: self,
                    bounds: Bounds { lower: floor, upper: PerClass::default() },
                    stack: Vec::new(),
                    left: self.most_pieces,
                };
                (first..last).for_each(|f| run.face(f as u32));
                run.bounds
            })
            .collect();
        let mut all = Bounds { lower: floor, upper: PerClass::default() };
        for chunk in bounds {
            for k in 0..Surface::MOST_CLASSES {
                all.lower[k] = larger(all.lower[k], chunk.lower[k]);
                all.upper[k] = larger(all.upper[k], chunk.upper[k]);
            }
        }
        let size = self.from.aabb().union(self.to.aabb()).size().length();
        let interval = |k: usize| {
            let lower = all.lower[k].or(all.upper[k].map(|_| 0.0))?;
            let upper = lower.max(all.upper[k].unwrap_or(lower));
            Some(Interval { lower_m: lower, upper_m: upper + ROUNDING * (size + upper) })
        };
        (0..Surface::MOST_CLASSES).map(interval).collect()
    }

    /// What vertices and samples show.
    fn floor(&self) -> PerClass {
        let mut floor = self.seen;
        let mut see = |class: u8, distance: f64| {
            let known = &mut floor[usize::from(class)];
            *known = larger(*known, Some(distance));
        };
        match self.classes {
            Classes::One => self.near.iter().for_each(|n| see(0, n.distance)),
            Classes::OfTo(_) => self.near.iter().for_each(|n| see(self.to.class_of(n.face), n.distance)),
            Classes::OfFrom => {
                for (f, face) in self.from.faces.iter().enumerate() {
                    face.iter().for_each(|&v| see(self.from.class_of(f as u32), self.near[v as usize].distance));
                }
            }
        }
        floor
    }
}

fn larger(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    // None is less than any.
    match (a, b) {
        (Some(a), Some(b)) => Some(a.max(b)),
        (a, b) => a.or(b),
    }
}

fn raise(bounds: &mut PerClass, classes: u32, distance: f64) {
    let mut rest = classes;
    while rest != 0 {
        let known = &mut bounds[rest.trailing_zeros() as usize];
        *known = larger(*known, Some(distance));
        rest &= rest - 1;
    }
}

#[derive(Clone, Copy)]
struct Bounds {
    lower: PerClass,
    upper: PerClass,
}

/// A convex part of a face.
#[derive(Clone, Copy)]
struct Piece {
    shape: Convex,
    /// A face of the other surface that is near.
    start: u32,
    /// Classes that its points may count for.
    classes: u32,
}

struct Run<'a> {
    search: &'a Search<'a>,
    bounds: Bounds,
    stack: Vec<Piece>,
    left: usize,
}

impl Run<'_> {
    fn face(&mut self, f: u32) {
        let Search { from, to, near, .. } = *self.search;
        let corners = from.corners(f);
        let near = from.faces[f as usize].map(|v| near[v as usize]);
        let classes = match self.search.classes {
            Classes::One => 1,
            Classes::OfFrom => 1 << from.class_of(f),
            Classes::OfTo(masks) => masks.first().copied().unwrap_or(1),
        };
        // Corners first: most faces are settled by the triangle nearest to one of them.
        let [a, b, c] = corners;
        let edge = [(b - a).length(), (c - b).length(), (a - c).length()];
        let mut bound = f64::INFINITY;
        let mut start = near[0].face;
        for k in 0..3 {
            bound = bound.min(near[k].distance + edge[k].max(edge[(k + 2) % 3]));
            if k > 0 && near[..k].iter().any(|n| n.face == near[k].face) {
                continue;
            }
            let others = [(k + 1) % 3, (k + 2) % 3].map(|i| to.distance_to_face(corners[i], near[k].face));
            let furthest = near[k].distance.max(others[0]).max(others[1]);
            if furthest <= bound {
                (bound, start) = (furthest, near[k].face);
            }
        }
        if bound <= self.threshold(classes).0 {
            return self.settle(classes, bound);
        }
        self.stack.push(Piece { shape: corners.into(), start, classes });
        while let Some(piece) = self.stack.pop() {
            self.piece(piece);
        }
    }

    /// The least and the largest bound that settles a piece for one of `classes`.
    fn threshold(&self, classes: u32) -> (f64, f64) {
        let (mut least, mut largest) = (f64::INFINITY, 0.0f64);
        let mut rest = classes;
        while rest != 0 {
            let limit = self.bounds.lower[rest.trailing_zeros() as usize].unwrap_or(0.0) + self.search.tolerance_m;
            (least, largest) = (least.min(limit), largest.max(limit));
            rest &= rest - 1;
        }
        (least, largest)
    }

    /// A point of these classes is this far.
    fn see(&mut self, classes: u32, distance: f64) {
        raise(&mut self.bounds.lower, classes, distance);
    }

    /// No point of a piece of these classes is further.
    fn settle(&mut self, classes: u32, bound: f64) {
        raise(&mut self.bounds.upper, classes, bound);
    }

    fn piece(&mut self, mut piece: Piece) {
        let to = self.search.to;
        let mut bound = piece.furthest_from(to, piece.start);
        if bound <= self.threshold(piece.classes).0 {
            return self.settle(piece.classes, bound);
        }
        let (middle, radius) = piece.shape.ball();
        let Some(hit) = to.nearest(middle, piece.start) else { return };
        let class = match self.search.classes {
            Classes::OfTo(_) => usize::from(to.class_of(hit.face)),
            _ => piece.classes.trailing_zeros() as usize,
        };
        self.see(1 << class, hit.distance);
        bound = bound.min(hit.distance + radius);
        if hit.face != piece.start {
            bound = bound.min(piece.furthest_from(to, hit.face));
        }
        let (least, largest) = self.threshold(piece.classes);
        if bound <= least {
            return self.settle(piece.classes, bound);
        }
        let is_last = self.left == 0;
        self.left = self.left.saturating_sub(1);
        if let Classes::OfTo(masks) = self.search.classes
            && !piece.classes.is_power_of_two()
        {
            // Classes all but tied for nearest: their points lie about the middle, too.
            let tied = hit.distance + self.search.tolerance_m;
            self.see(to.classes_within(masks, middle, tied, piece.classes), hit.distance);
            if bound <= largest || is_last {
                // No point of the piece is further than `bound` from its nearest point.
                piece.classes = to.classes_within(masks, middle, bound + radius, piece.classes) | (1 << class);
            }
            if bound <= self.threshold(piece.classes).0 {
                return self.settle(piece.classes, bound);
            }
        }
        // A radius of nothing cannot be cut; only a tolerance below rounding leads there.
        if is_last || radius <= ROUNDING * middle.length() {
            return self.settle(piece.classes, bound);
        }
        for shape in piece.shape.cut(to.corners(hit.face), middle, radius) {
            self.stack.push(Piece { shape, start: hit.face, classes: piece.classes });
        }
    }
}

impl Piece {
    /// The largest distance from triangle `f`, which by convexity is that of a corner.
    fn furthest_from(&self, to: &Prepared, f: u32) -> f64 {
        self.shape.corners().iter().map(|p| to.distance_to_face(*p, f)).fold(0.0, f64::max)
    }
}
