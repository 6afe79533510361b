//! A reference that is too large to be held at once: it comes in parts, and the figures are put together from all.
//!
//! # Method
//! 1. simplified faces are cut into pieces small against the parts; each belongs to the part whose box is nearest to its
//!    middle, as do vertices and middles of faces
//! 2. from a part to the simplified surface: as ever; that surface is held whole
//! 3. back: a piece is no further from the part than D, the least distance of a corner and its longest edge; so the
//!    nearest point of the whole reference is found among the part and all that lies within D of each piece
//! 4. samples are shared out by area, so that all together are spread evenly; certified bounds are raised part by part
//!
//! # Promises
//! The certified interval and all figures mean the same as those of one [`Reference`](super::Reference)
//! (`a_reference_in_parts_gives_the_same_figures`). Memory: the simplified surface, a part and what lies about it, and
//! 10 bytes for each sample and vertex.

use glam::DVec3;

use super::certify::{Classes, Interval, Search};
use super::distance::{self, Labels};
use super::quality::Edges;
use super::sample::Sampler;
use super::signed::Normals;
use super::surface::{Prepared, Surface};
use super::{
    Comparison, Detail, MeasureConfig, Measured, Reference, SidesBothWays, Tally, comparison, furthest, see_vertices,
    tolerance_m,
};
use crate::geo::Aabb;

/// What is known of a reference before its parts are seen.
#[derive(Debug, Clone, Copy)]
pub struct Whole {
    /// Around all of it.
    pub aabb: Aabb,
    /// Its area, m².
    pub area_m2: f64,
}

/// A comparison with a reference that comes in parts.
pub struct Piecewise<'a> {
    config: &'a MeasureConfig,
    whole: Whole,
    simplified: Prepared,
    edges: Edges,
    /// What of the simplified surface each part is measured from.
    owned: Vec<Owned>,
    parts: usize,
    measured: Measured,
    tally: Tally,
}

/// What of the simplified surface belongs to a part.
#[derive(Default)]
struct Owned {
    pieces: Vec<[DVec3; 3]>,
    points: Vec<DVec3>,
    faces: Vec<u32>,
    middles: Vec<DVec3>,
}

/// Pieces are no longer than this part of the smallest part's diagonal.
const PIECE_SHARE: f64 = 0.05;
/// Pieces at most; longer ones from there on.
const MOST_PIECES: usize = 1_000_000;

impl<'a> Piecewise<'a> {
    /// Begins; `parts` are the boxes of the parts to come.
    pub fn new(simplified: &Surface, whole: Whole, parts: &[Aabb], config: &'a MeasureConfig) -> Self {
        let simplified = Prepared::new(simplified, whole.aabb.center());
        let center = whole.aabb.center();
        let mut owned: Vec<Owned> = parts.iter().map(|_| Owned::default()).collect();
        let nearest = |p: DVec3| {
            let p = p + center;
            let far = |aabb: &Aabb| (p - p.clamp(aabb.min, aabb.max)).length_squared();
            let near = |a: &usize, b: &usize| far(&parts[*a]).total_cmp(&far(&parts[*b]));
            (0..parts.len()).filter(|&i| !parts[i].is_empty()).min_by(near)
        };
        for piece in pieces(&simplified, parts) {
            let part = nearest((piece[0] + piece[1] + piece[2]) / 3.0);
            part.into_iter().for_each(|part| owned[part].pieces.push(piece));
        }
        for &point in &simplified.points {
            nearest(point).into_iter().for_each(|part| owned[part].points.push(point));
        }
        for (f, middle) in (0u32..).zip(simplified.middles()) {
            if let Some(part) = nearest(middle) {
                owned[part].faces.push(f);
                owned[part].middles.push(middle);
            }
        }
        let measured = Measured { face_class: vec![0; simplified.faces.len()], ..Measured::default() };
        let tally = Tally { diagonal_m: whole.aabb.size().length(), ..Tally::default() };
        Self { config, whole, edges: Edges::of(&simplified), owned, parts: 0, measured, tally, simplified }
    }

    /// Takes up the next part. `around` gives it together with all of the reference that touches a box, or nothing if
    /// that is the part alone.
    pub fn add(&mut self, part: &Surface, around: &mut dyn FnMut(Aabb) -> Option<Surface>) {
        let index = self.parts;
        self.parts += 1;
        let center = self.whole.aabb.center();
        let own = Prepared::new(part, center);
        self.tally.add(&own);
        if own.faces.is_empty() || self.simplified.faces.is_empty() {
            return;
        }
        let seed = self.config.seed.wrapping_add(2 * index as u64);
        self.forward(&own, seed);
        let owned = std::mem::take(&mut self.owned[index]);
        if owned.pieces.is_empty() && owned.points.is_empty() {
            return;
        }
        let from = Prepared::without_tree(&owned.pieces);
        let is_alone = self.owned.len() == 1;
        let within = (!is_alone).then(|| reach(&from, &owned, &own));
        let more = within.and_then(|within| around(Aabb { min: within.min + center, max: within.max + center }));
        let near = more.map_or(own, |more| Prepared::new(&more, center));
        self.backward(&from, &owned, near, seed.wrapping_add(1));
    }

    fn forward(&mut self, own: &Prepared, seed: u64) {
        let normals = Normals::of(&self.simplified, &self.edges.neighbours);
        let area_m2: f64 = (0..own.faces.len() as u32).map(|f| own.area(f)).sum();
        let sampler = Sampler::new(own, self.samples(area_m2 / self.whole.area_m2), seed);
        let pass = distance::measure(own, &sampler, &self.simplified, &normals, Labels::AtPoint);
        let near = self.simplified.nearest_of(&own.points);
        let mut vertex_class = vec![0; own.points.len()];
        for (f, face) in (0u32..).zip(&own.faces) {
            face.iter().for_each(|&v| vertex_class[v as usize] = own.class_of(f));
        }
        let vertices = distance::vertex_series(&near, |v| vertex_class[v]);
        let mut sides = see_vertices(own, &near, &vertices, &self.simplified, &normals);
        sides.merge(&pass.sides);
        let classes = if own.class.is_empty() { Classes::One } else { Classes::OfFrom };
        let search = self.search(own, &self.simplified, &near, classes, pass.series.largest(self.known(0)));
        raise(&mut self.measured.intervals[0], search.run());
        self.measured.sides.raise(&sides.outside, &sides.inside);
        let found = furthest(own, &near);
        further(&mut self.measured.furthest[0], found);
        self.measured.there.extend(pass);
        self.measured.reference_vertices.extend(vertices);
    }

    fn backward(&mut self, from: &Prepared, owned: &Owned, near: Prepared, seed: u64) {
        let to = Reference::of(near, DVec3::ZERO, Tally::default());
        let normals = Normals::of(&to.surface, &to.edges.neighbours);
        let area = |of: &Prepared| (0..of.faces.len() as u32).map(|f| of.area(f)).sum::<f64>();
        let sampler = Sampler::new(from, self.samples(area(from) / area(&self.simplified)), seed);
        let pass = distance::measure(from, &sampler, &to.surface, &normals, Labels::AtNearest);
        let nearest = to.surface.nearest_of(&owned.points);
        let vertices = distance::vertex_series(&nearest, |v| to.surface.class_of(nearest[v].face));
        let mut of_points = Prepared::without_tree(&[]);
        of_points.points.clone_from(&owned.points);
        let mut sides = see_vertices(&of_points, &nearest, &vertices, &to.surface, &normals);
        sides.merge(&pass.sides);
        let classes = to.masks.as_ref().map_or(Classes::One, |masks| Classes::OfTo(masks));
        let corners = to.surface.nearest_of(&from.points);
        let search = self.search(from, &to.surface, &corners, classes, pass.series.largest(self.known(1)));
        raise(&mut self.measured.intervals[1], search.run());
        self.measured.sides.raise(&sides.inside, &sides.outside);
        let found = furthest(&of_points, &nearest);
        further(&mut self.measured.furthest[1], found);
        for (&f, class) in owned.faces.iter().zip(to.surface.nearest_classes(&owned.middles)) {
            self.measured.face_class[f as usize] = class;
        }
        self.measured.back.extend(pass);
        self.measured.simplified_vertices.extend(vertices);
    }

    /// All figures, once every part was taken up.
    pub fn finish(self) -> (Comparison, Detail) {
        let is_measured = self.measured.intervals.iter().all(|all| all.iter().flatten().next().is_some());
        let measured = is_measured.then_some(&self.measured);
        let detail = measured.map(|m| m.detail(self.whole.aabb.center(), &self.tally, &self.simplified));
        (comparison(&self.tally, measured, self.edges.quality), detail.unwrap_or_default())
    }

    /// Area of the reference seen so far, m².
    pub fn area_m2(&self) -> f64 {
        self.tally.area_m2.iter().sum()
    }

    fn samples(&self, share: f64) -> usize {
        let count = (self.config.samples as f64 * share).round();
        if count.is_finite() { (count as usize).clamp(1, self.config.samples.max(1)) } else { 1 }
    }

    fn known(&self, direction: usize) -> [Option<f64>; Surface::MOST_CLASSES] {
        let intervals = &self.measured.intervals[direction];
        std::array::from_fn(|k| intervals.get(k).copied().flatten().map(|i: Interval| i.lower_m))
    }

    fn search<'b>(
        &self,
        from: &'b Prepared,
        to: &'b Prepared,
        near: &'b [super::Near],
        classes: Classes<'b>,
        seen: [Option<f64>; Surface::MOST_CLASSES],
    ) -> Search<'b> {
        let tolerance_m = tolerance_m(self.config, self.tally.diagonal_m);
        Search { from, to, near, classes, seen, tolerance_m, most_pieces: self.config.most_pieces }
    }
}

/// The faces of `surface`, those that are long against the parts cut in pieces.
fn pieces(surface: &Prepared, parts: &[Aabb]) -> Vec<[DVec3; 3]> {
    let mut all: Vec<[DVec3; 3]> = (0..surface.faces.len() as u32).map(|f| surface.corners(f)).collect();
    if parts.len() < 2 {
        return all;
    }
    let sizes = parts.iter().filter(|aabb| !aabb.is_empty()).map(|aabb| aabb.size().length());
    let longest_m = PIECE_SHARE * sizes.fold(f64::INFINITY, f64::min);
    let mut cut = Vec::new();
    while let Some(piece) = all.pop() {
        let length = |k: usize| (piece[(k + 1) % 3] - piece[k]).length();
        let k = (1..3).fold(0, |best, k| if length(k) > length(best) { k } else { best });
        if length(k) <= longest_m || longest_m.is_nan() || cut.len() + all.len() >= MOST_PIECES {
            cut.push(piece);
            continue;
        }
        let middle = (piece[k] + piece[(k + 1) % 3]) / 2.0;
        let (mut one, mut other) = (piece, piece);
        (one[(k + 1) % 3], other[k]) = (middle, middle);
        all.extend([one, other]);
    }
    cut
}

/// A box that holds the nearest point of the reference for all that is owned, whose distances to `own` are bounds: each
/// thing reaches as far as it may have to, so that one that lies far off does not widen the box on all sides.
fn reach(from: &Prepared, owned: &Owned, own: &Prepared) -> Aabb {
    let mut aabb = Aabb::EMPTY;
    let corners = own.nearest_of(&from.points);
    for face in &from.faces {
        let [a, b, c] = face.map(|v| from.points[v as usize]);
        let longest_m = (b - a).length().max((c - b).length()).max((a - c).length());
        let far_m = face.iter().map(|&v| corners[v as usize].distance).fold(f64::INFINITY, f64::min);
        let by = DVec3::splat(far_m + longest_m);
        aabb = aabb.union(Aabb { min: a.min(b).min(c) - by, max: a.max(b).max(c) + by });
    }
    for points in [&owned.points, &owned.middles] {
        for (p, near) in points.iter().zip(own.nearest_of(points)) {
            let by = DVec3::splat(near.distance);
            aabb = aabb.union(Aabb { min: *p - by, max: *p + by });
        }
    }
    aabb
}

fn raise(known: &mut Vec<Option<Interval>>, found: Vec<Option<Interval>>) {
    known.resize(Surface::MOST_CLASSES, None);
    for (known, found) in known.iter_mut().zip(found) {
        *known = known.iter().copied().chain(found).reduce(Interval::max);
    }
}

fn further(known: &mut Option<(DVec3, f64)>, found: Option<(DVec3, f64)>) {
    if let Some(found) = found.filter(|found| known.is_none_or(|known| found.1 > known.1)) {
        *known = Some(found);
    }
}

impl SidesBothWays {
    /// Takes up how far another part lies inside and outside, by class.
    fn raise(&mut self, inside: &[f64], outside: &[f64]) {
        for (known, found) in [(&mut self.inside, inside), (&mut self.outside, outside)] {
            known.resize(Surface::MOST_CLASSES, 0.0);
            known.iter_mut().zip(found).for_each(|(known, found)| *known = known.max(*found));
        }
    }
}
