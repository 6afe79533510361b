//! Moves the vertices of a cut, and turns its edges, so that it lies nearer to the source at the same number of faces.
//!
//! A collapse puts each vertex where a few planes want it; the source itself is only asked whether it agrees. Here it
//! speaks: every source vertex and the centre of every source face is a point that pulls the face nearest to it.
//!
//! # Method
//! 1. *Associate.* Each point finds the nearest face, walking from the face it was on.
//! 2. *Pull.* Of every face, a few sums say what its points want of its corners: Σ w·(n·x − …)², where the weights are
//!    area · ω / distance, so that the sum of distances falls and not that of squares (iteratively reweighted least
//!    squares). A few spots of the face are pulled to the source, too, for the way back counts as much.
//! 3. *Fit.* Vertex by vertex (Gauss–Seidel) to the least of the sums; a small term holds it where it was.
//! 4. *Turn.* Points associated anew, an edge between two faces becomes the other diagonal where that brings them nearer.
//!
//! # Numbers
//! Two-sided mean against the cut as collapsed, on four real meshes at 10 % of the faces: −15 to −17 %, of which the run
//! that stops at 1.1 times the faces, is refitted and goes on from there (`simplify`) gives 2 to 6.
//! What paid: vertices held at a tenth of the weight (−4 %), a quarter instead of half of the area to vertices (−1 %), a
//! floor of half the mean distance instead of a quarter (−0.7 %), centres beside vertices (−4 %), turned edges (−3 %),
//! distances instead of squares (−2 %). Spots that pull back: −2 to −3 % where the cut is coarse and the source rough,
//! nothing on a building at 10 %. Sums by face instead of points by vertex: −15 % of the refit's time for one pass more
//! of the same accuracy; a point over the inside of its face found without the general search: −15 % of the run's time, and
//! not asked for its neighbours after a run that tracked it: −6 %.
//! What did not: spots as heavy as points (building +2 %), or only those far off; 6 and 12 passes instead of 3 (−0.5 %);
//! more sweeps; bolder turns; holding vertices less still: the way there falls, the way back grows as much.
//! Left: stopping at 1.4, 1.3 … 1.05 times the faces with a refit each would give 2 % more, for twice the time.
//!
//! # Promises
//! No face flips, no edge gets more than two faces that had not, no point passes its limit that was within it.
//!
//! # References
//! Hoppe et al., Mesh Optimization, 1993 (fit and edge swap); here with distances instead of squares and limits.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::NONE;
use super::energy::Form;
use super::star::Stars;
use crate::geo::bvh::closest_on_triangle;

const SWEEPS: usize = 3;
/// Pull towards the place before the refit, as a share of the weight of the points.
const STAY: f64 = 0.005;
/// A distance counts as at least this share of the mean: nearer points would decide alone.
const LEAST_DISTANCE_SHARE: f64 = 0.5;
/// Weight of the pull along the surface on points beyond its rim, whose nearest spot is on an edge.
const ALONG: f64 = 0.25;
/// A vertex may turn a face by 60° in a sweep.
const LEAST_FIT_COS: f64 = 0.5;
/// Turned faces may differ by this much from the mean of the two before (cosine), and from each other as before.
const LEAST_TURN_COS: f64 = 0.2;
const LEAST_RIDGE_COS: f64 = 0.5;
/// Area over squared longest side: thinner faces are not made of thicker ones.
const SLIVER: f64 = 0.02;
/// A point looks this many rings around for a nearer face.
const MOST_WALKS: usize = 3;
/// Spots of a face that ask how far the source is, as barycentric coordinates.
const SPOTS: [[f64; 3]; 3] =
    [[2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0], [1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0], [1.0 / 6.0, 1.0 / 6.0, 2.0 / 3.0]];
/// Source faces that such a spot asks, those with the nearest centres.
const ASKED: usize = 3;
/// Weight of such spots; at 1 a few of them outvote the many points of a face.
const BACK: f64 = 0.3;

/// A place on the source that pulls the surface. Where it is, see [`Source`].
#[derive(Debug, Clone, Copy)]
pub struct Point {
    /// Area · Σ P(c|f)/b_c².
    pub weight: f32,
    /// The surface must stay this near, metres, if it is.
    pub limit_m: f32,
    /// Face of the cut that it is on.
    pub face: u32,
    /// From that face.
    pub distance_m: f32,
    /// The one after it on the same face.
    next: u32,
}

impl Point {
    /// A point that starts its search at `face`.
    pub fn new(weight: f32, limit_m: f32, face: u32) -> Self {
        Self { weight, limit_m, face, distance_m: 0.0, next: NONE }
    }
}

/// Where the points are: first the vertices of the source, then the centres of its faces. To keep these beside them
/// would take 36 bytes a face, and be the peak of a run.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// Of its vertices.
    pub positions: &'a [DVec3],
    /// Indices into `positions`.
    pub faces: &'a [[u32; 3]],
    /// Share of a face's weight that its centre has.
    pub of_centers: f32,
}

impl Source<'_> {
    fn corners(&self, f: usize) -> [DVec3; 3] {
        self.faces[f].map(|v| self.positions[v as usize])
    }

    fn at(&self, i: usize) -> DVec3 {
        let center = |f: usize| self.corners(f).iter().sum::<DVec3>() / 3.0;
        self.positions.get(i).copied().unwrap_or_else(|| center(i - self.positions.len()))
    }
}

/// What the points of a face want of its corners: Σ w·(Σ bₖ n·xₖ + r)² over their moves x, with n the face's normal, b
/// where the point is on the face and r how far the face is off; and the same in all directions for points beyond the rim.
#[derive(Debug, Clone, Copy, Default)]
struct Pull {
    normal: Vec3,
    /// Σ w·bᵢ·bⱼ: 00, 11, 22, 01, 12, 20.
    products: [f32; 6],
    rest: [f32; 3],
    rim_products: [f32; 6],
    rim_rest: [Vec3; 3],
    /// The corners may move this far without a look at the limits of its points, metres.
    slack_m: f32,
}

/// As a [`Pull`], while it is summed.
#[derive(Default)]
struct Sum {
    products: [f64; 6],
    rest: [f64; 3],
    rim_products: [f64; 6],
    rim_rest: [DVec3; 3],
}

impl Sum {
    /// A spot `bary` of a face of `normal` that should be `off` from where it is.
    fn add(&mut self, bary: [f64; 3], normal: DVec3, off: DVec3, weight: f64, along: f64) {
        let r = normal.dot(off);
        let [a, b, c] = bary;
        let products = [a * a, b * b, c * c, a * b, b * c, c * a];
        for (sum, product) in self.products.iter_mut().zip(products) {
            *sum += weight * product;
        }
        for (rest, part) in self.rest.iter_mut().zip(bary) {
            *rest += weight * r * part;
        }
        if along > 0.0 {
            for (sum, product) in self.rim_products.iter_mut().zip(products) {
                *sum += along * product;
            }
            for (rest, part) in self.rim_rest.iter_mut().zip(bary) {
                *rest += off * (along * part);
            }
        }
    }
}

struct Refit<'a> {
    positions: &'a mut [DVec3],
    faces: &'a mut [[u32; 3]],
    /// Unit, zero for a face without area.
    normals: Vec<DVec3>,
    stars: Stars,
    points: &'a mut [Point],
    /// By face: the first point on it.
    head: Vec<u32>,
    source: Source<'a>,
    /// Nothing was associated yet.
    first: bool,
}

/// Refits the cut; `points` end on the faces nearest to them.
pub fn refit(positions: &mut [DVec3], faces: &mut [[u32; 3]], points: &mut [Point], source: Source, passes: usize) {
    let stars = Stars::of(positions.len(), faces);
    let normals = faces.iter().map(|f| cross(f.map(|v| positions[v as usize])).normalize_or_zero()).collect();
    let start = positions.to_vec();
    let head = Vec::new();
    let mut refit = Refit { positions, faces, normals, stars, points, head, source, first: true };
    refit.associate();
    for _ in 0..passes {
        refit.fit(&start);
        refit.associate();
        refit.turn();
    }
}

impl Refit<'_> {
    fn corners(&self, f: u32) -> [DVec3; 3] {
        self.faces[f as usize].map(|v| self.positions[v as usize])
    }

    /// The points on face `f`.
    fn on(&self, f: u32) -> impl Iterator<Item = usize> {
        let some = |i: u32| (i != NONE).then_some(i as usize);
        std::iter::successors(some(self.head[f as usize]), move |&i| some(self.points[i].next))
    }

    fn associate(&mut self) {
        let mut points = std::mem::take(&mut self.points);
        // What was tracked so far is on a near face already.
        let tracked = if self.first { self.source.positions.len() } else { usize::MAX };
        let find = |seen: &mut Vec<u32>, (i, point): (usize, &mut Point)| {
            self.find(point, self.source.at(i), i < tracked, seen);
        };
        points.par_iter_mut().enumerate().for_each_init(Vec::new, find);
        self.head.clear();
        self.head.resize(self.faces.len(), NONE);
        for (i, point) in points.iter_mut().enumerate().rev() {
            point.next = std::mem::replace(&mut self.head[point.face as usize], i as u32);
        }
        std::mem::swap(&mut self.points, &mut points);
        self.first = false;
    }

    /// Walks to the nearest face, ring by ring; `is_near`: from one that was the nearest not long ago.
    fn find(&self, point: &mut Point, at: DVec3, is_near: bool, seen: &mut Vec<u32>) {
        seen.clear();
        seen.push(point.face);
        let (mut best, mut from) = ((f64::INFINITY, point.face, false), 0);
        for walk in 0..=MOST_WALKS {
            let before = best.1;
            for &f in &seen[from..] {
                let corners = self.corners(f);
                let off_plane = self.normals[f as usize].dot(at - corners[0]);
                if off_plane * off_plane < best.0 {
                    let (on, bary) = spot(at, &corners, self.normals[f as usize]);
                    let squared = (on - at).length_squared();
                    if squared < best.0 {
                        best = (squared, f, bary.iter().all(|&b| b > 1e-6));
                    }
                }
            }
            if walk == MOST_WALKS || (walk > 0 && best.1 == before) {
                break;
            }
            // Most points lie over the inside of their face; there only a fold could be nearer.
            if walk == 0 && is_near && best.2 {
                break;
            }
            from = seen.len();
            for v in self.faces[best.1 as usize] {
                for &f in self.stars.faces(v) {
                    if !seen.contains(&f) {
                        seen.push(f);
                    }
                }
            }
        }
        point.face = best.1;
        point.distance_m = best.0.sqrt() as f32;
    }

    /// What every face's points want.
    fn pulls(&self) -> Vec<Pull> {
        let weights: f64 = self.points.iter().map(|p| f64::from(p.weight)).sum();
        let mean = self.points.iter().map(|p| f64::from(p.weight) * f64::from(p.distance_m)).sum::<f64>() / weights;
        let least = (LEAST_DISTANCE_SHARE * mean).max(f64::MIN_POSITIVE);
        (0..self.faces.len() as u32).into_par_iter().map(|f| self.pull(f, least)).collect()
    }

    fn pull(&self, f: u32, least: f64) -> Pull {
        let (corners, normal) = (self.corners(f), self.normals[f as usize]);
        let mut sum = Sum::default();
        let mut slack = f64::INFINITY;
        for i in self.on(f) {
            let point = &self.points[i];
            let at = self.source.at(i);
            let (on, bary) = spot(at, &corners, normal);
            let off = on - at;
            let distance = off.length();
            slack = slack.min(f64::from(point.limit_m.max(point.distance_m)) - distance);
            let weight = f64::from(point.weight) / (distance + least);
            let along = if bary.iter().any(|&b| b < 1e-9) { weight * ALONG } else { 0.0 };
            sum.add(bary, normal, off, weight, along);
        }
        self.ask_back(f, &corners, least, &mut sum);
        let small = |sums: [f64; 6]| sums.map(|s| s as f32);
        Pull {
            normal: normal.as_vec3(),
            products: small(sum.products),
            rest: sum.rest.map(|r| r as f32),
            rim_products: small(sum.rim_products),
            rim_rest: sum.rim_rest.map(DVec3::as_vec3),
            slack_m: slack as f32,
        }
    }

    /// Lets a few spots of the face be pulled to the source, as far as it can be seen from the points on the face.
    fn ask_back(&self, f: u32, corners: &[DVec3; 3], least: f64, sum: &mut Sum) {
        let normal = self.normals[f as usize];
        let area = 0.5 * cross(*corners).length();
        for bary in SPOTS {
            let spot = corners[0] * bary[0] + corners[1] * bary[1] + corners[2] * bary[2];
            let Some((off, omega)) = self.source_at(f, spot) else { return };
            let weight = BACK * area / SPOTS.len() as f64 * omega / (off.length() + least);
            sum.add(bary, normal, off, weight, 0.0);
        }
    }

    /// From the source to a spot on face `f`, and the weight of an area there; none where the source is not seen.
    fn source_at(&self, f: u32, spot: DVec3) -> Option<(DVec3, f64)> {
        let vertices = self.source.positions.len();
        let mut near = [(f64::INFINITY, NONE); ASKED];
        let look = |f: u32, near: &mut [(f64, u32); ASKED]| {
            for i in self.on(f).filter(|&i| i >= vertices) {
                let mut new = ((self.source.at(i) - spot).length_squared(), i as u32);
                for old in near.iter_mut() {
                    if new.0 < old.0 {
                        std::mem::swap(&mut new, old);
                    }
                }
            }
        };
        look(f, &mut near);
        if near[0].1 == NONE {
            let around = self.faces[f as usize];
            around.iter().flat_map(|&v| self.stars.faces(v)).for_each(|&g| look(g, &mut near));
        }
        let seen = near.into_iter().filter(|n| n.1 != NONE).map(|(_, i)| {
            let source = self.source.corners(i as usize - vertices);
            let area = 0.5 * cross(source).length() * f64::from(self.source.of_centers);
            (spot - closest_on_triangle(spot, &source), f64::from(self.points[i as usize].weight) / area)
        });
        let seen = seen.filter(|(_, omega)| omega.is_finite());
        seen.min_by(|a, b| a.0.length_squared().total_cmp(&b.0.length_squared()))
    }

    fn fit(&mut self, start: &[DVec3]) {
        let mut pulls = self.pulls();
        let from = self.positions.to_vec();
        for _ in 0..SWEEPS {
            for v in 0..self.positions.len() as u32 {
                self.fit_vertex(v, &mut pulls, &from, start[v as usize]);
            }
        }
    }

    /// To where the faces around `v` want it, if that is allowed; `from` are all places when the pulls were summed.
    fn fit_vertex(&mut self, v: u32, pulls: &mut [Pull], from: &[DVec3], start: DVec3) {
        let here = self.positions[v as usize];
        let mut form = Form::default();
        let (mut gradient, mut total) = (DVec3::ZERO, 0.0);
        for &f in self.stars.faces(v) {
            let (face, pull) = (self.faces[f as usize], &pulls[f as usize]);
            let normal = pull.normal.as_dvec3();
            let Some(k) = face.iter().position(|&w| w == v) else { continue };
            let (mut along_normal, mut along) = (f64::from(pull.rest[k]), pull.rim_rest[k].as_dvec3());
            for (j, &w) in face.iter().enumerate() {
                let moved = self.positions[w as usize] - from[w as usize];
                // 01, 12, 20 after the squares.
                let product = if j == k { k } else { 3 + if (k + 1) % 3 == j { k } else { j } };
                along_normal += f64::from(pull.products[product]) * normal.dot(moved);
                along += moved * f64::from(pull.rim_products[product]);
            }
            let (weight, rim) = (f64::from(pull.products[k]), f64::from(pull.rim_products[k]));
            form += Form::of_plane(normal, weight);
            form += Form::of_all(rim);
            gradient += normal * along_normal + along;
            total += weight;
        }
        if total <= 0.0 {
            return;
        }
        form += Form::of_all(STAY * total);
        gradient += (here - start) * (STAY * total);
        let step = form.least(gradient, [false; 3]);
        if self.may_move(v, here + step, pulls) {
            self.positions[v as usize] = here + step;
            let length = step.length() as f32;
            for &f in self.stars.faces(v) {
                self.normals[f as usize] = cross(self.corners(f)).normalize_or_zero();
                pulls[f as usize].slack_m -= length;
            }
        }
    }

    fn may_move(&self, v: u32, to: DVec3, pulls: &[Pull]) -> bool {
        let moved = |f: u32| self.faces[f as usize].map(|w| if w == v { to } else { self.positions[w as usize] });
        let flips = |f: &u32| {
            let new = cross(moved(*f));
            new.dot(self.normals[*f as usize]) <= LEAST_FIT_COS * new.length()
        };
        // A step moves the spot of a point by at most a step.
        let step = (to - self.positions[v as usize]).length() as f32;
        let leaves = |f: &u32| {
            step > pulls[*f as usize].slack_m && {
                let corners = moved(*f);
                self.on(*f).any(|i| {
                    let (at, point) = (self.source.at(i), &self.points[i]);
                    let limit = f64::from(point.limit_m.max(point.distance_m));
                    limit.is_finite() && (closest_on_triangle(at, &corners) - at).length() > limit
                })
            }
        };
        let star = self.stars.faces(v);
        to.is_finite() && !star.iter().any(flips) && !star.iter().any(leaves)
    }

    fn turn(&mut self) {
        let mut placed = Vec::new();
        for f in 0..self.faces.len() as u32 {
            for k in 0..3 {
                if self.turn_edge(f, k, &mut placed) {
                    break;
                }
            }
        }
    }

    /// Turns the edge after corner `k` of face `f` if that is allowed and helps.
    fn turn_edge(&mut self, f: u32, k: usize, placed: &mut Vec<(u32, usize, f64)>) -> bool {
        let face = self.faces[f as usize];
        let (a, b, c) = (face[k], face[(k + 1) % 3], face[(k + 2) % 3]);
        let Some((g, d)) = self.across(f, a, b) else { return false };
        if g < f || d == c || self.stars.faces(c).iter().any(|&h| self.faces[h as usize].contains(&d)) {
            return false;
        }
        let new = [[a, d, c], [d, b, c]];
        let corners = new.map(|t| t.map(|v| self.positions[v as usize]));
        if !self.may_turn([f, g], &corners) {
            return false;
        }
        let mut gain = 0.0;
        placed.clear();
        for i in self.on(f).chain(self.on(g)) {
            let point = &self.points[i];
            let at = self.source.at(i);
            let distance = corners.map(|t| (closest_on_triangle(at, &t) - at).length());
            let side = usize::from(distance[1] < distance[0]);
            if distance[side] > f64::from(point.limit_m.max(point.distance_m)) {
                return false;
            }
            gain += f64::from(point.weight) * (f64::from(point.distance_m) - distance[side]);
            placed.push((i as u32, side, distance[side]));
        }
        if gain <= 0.0 {
            return false;
        }
        for (side, h) in [f, g].into_iter().enumerate() {
            self.faces[h as usize] = new[side];
            self.normals[h as usize] = cross(corners[side]).normalize_or_zero();
            self.head[h as usize] = NONE;
        }
        for &(i, side, distance) in placed.iter().rev() {
            let h = [f, g][side];
            let point = &mut self.points[i as usize];
            (point.face, point.distance_m) = (h, distance as f32);
            point.next = std::mem::replace(&mut self.head[h as usize], i);
        }
        self.stars.remove(b, f);
        self.stars.remove(a, g);
        self.stars.add(d, f);
        self.stars.add(c, g);
        true
    }

    /// The one other face at edge `ab` of `f`, pointing the same way, and its third corner.
    fn across(&self, f: u32, a: u32, b: u32) -> Option<(u32, u32)> {
        let mut others = self.stars.faces(a).iter().filter(|&&h| h != f && self.faces[h as usize].contains(&b));
        let (&g, None) = (others.next()?, others.next()) else { return None };
        let face = self.faces[g as usize];
        (0..3).find(|&k| face[k] == b && face[(k + 1) % 3] == a).map(|k| (g, face[(k + 2) % 3]))
    }

    fn may_turn(&self, old: [u32; 2], new: &[[DVec3; 3]; 2]) -> bool {
        let before = old.map(|f| self.corners(f));
        let mean = cross(before[0]) + cross(before[1]);
        let crosses = new.map(cross);
        if crosses.iter().any(|n| n.dot(mean) <= LEAST_TURN_COS * mean.length() * n.length()) {
            return false;
        }
        let ridge = |n: [DVec3; 2]| n[0].normalize_or_zero().dot(n[1].normalize_or_zero());
        let bent = ridge(crosses) < ridge(old.map(|f| self.normals[f as usize])).min(LEAST_RIDGE_COS);
        let thinnest = |t: &[[DVec3; 3]; 2]| thickness(t[0]).min(thickness(t[1]));
        !bent && thinnest(new) >= thinnest(&before).min(SLIVER)
    }
}

/// The nearest spot of a triangle with this unit normal, and where it is on it.
#[inline]
fn spot(p: DVec3, t: &[DVec3; 3], normal: DVec3) -> (DVec3, [f64; 3]) {
    let [a, b, c] = t.map(|corner| corner - p);
    let parts = [b.cross(c).dot(normal), c.cross(a).dot(normal), a.cross(b).dot(normal)];
    let all = parts[0] + parts[1] + parts[2];
    if parts.iter().all(|&part| part > 1e-6 * all) {
        return (p + normal * normal.dot(a), parts.map(|part| part / all));
    }
    let on = closest_on_triangle(p, t);
    (on, barycentric(on, t))
}

/// Twice-area vector.
fn cross([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

/// Area over squared longest side.
fn thickness([a, b, c]: [DVec3; 3]) -> f64 {
    let longest = (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
    if longest > 0.0 { 0.5 * cross([a, b, c]).length() / longest } else { 0.0 }
}

/// Barycentric coordinates of a point on a triangle, not negative; zero area: the first corner.
fn barycentric(p: DVec3, t: &[DVec3; 3]) -> [f64; 3] {
    let n = cross(*t);
    let squared = n.length_squared();
    if squared <= 0.0 {
        return [1.0, 0.0, 0.0];
    }
    let part = |b: DVec3, c: DVec3| ((b - p).cross(c - p).dot(n) / squared).clamp(0.0, 1.0);
    let (u, v) = (part(t[1], t[2]), part(t[2], t[0]));
    [u, v, (1.0 - u - v).max(0.0)]
}
