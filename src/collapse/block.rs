//! One block of the mesh, collapsed to the limit of one scale by one thread.
//!
//! A block is a compact copy of some faces. Vertices that faces outside it use are locked, so blocks never see each
//! other and their order of execution cannot matter.

use std::collections::HashMap;

use glam::{DVec3, I64Vec3};

use super::energy::Quadric;
use super::queue::{Candidate, Queue};
use super::{Collapse, NONE};
use crate::geo::Rect;
use crate::geo::bvh::closest_on_triangle;
use crate::mesh::on_grid;

/// A vertex that must not move: faces outside the block use it, or two walls cross in it.
pub const LOCKED: u8 = 1;
/// A vertex on a wall x = constant: its x must not change.
pub const FIX_X: u8 = 2;
/// A vertex on a wall y = constant.
pub const FIX_Y: u8 = 4;
/// A vertex on an open border of the surface.
pub const BORDER: u8 = 8;

/// A face may turn by at most this much in one collapse (cosine): beyond it, it flips or becomes a sliver.
const LEAST_TURN_COS: f64 = 0.2;
/// An edge is filed again, not collapsed, when its energy grew by more than this since it was ranked.
const STALE_FACTOR: f32 = 1.1;
/// A solution further from the edge's middle than this many edge lengths is not trusted.
const FARTHEST_LENGTHS: f64 = 2.0;
/// Weight of open borders against the surface beside them, both as squared length.
const BORDER_WEIGHT: f64 = 1.0;
/// A tunnel closes when the loop around it is shorter than this many reaches: no wider than what may deviate. Real
/// scans have hundreds of them, and none of them would let its surroundings go.
const SMALL_LOOP_REACHES: f64 = 6.0;
/// A border vertex is tried with at most this many others across a gap, the nearest first.
const MOST_GAPS: usize = 3;

/// What a block is made of. All indices are local to the block; positions are relative to `origin`.
pub struct Block<'a> {
    /// Local positions are relative to this point.
    pub origin: DVec3,
    /// Per vertex: global id, ascending.
    pub vertex_ids: Vec<u32>,
    /// Per vertex.
    pub positions: Vec<DVec3>,
    /// Per vertex: `LOCKED`, `FIX_X`, `FIX_Y`, `BORDER`.
    pub flags: Vec<u8>,
    /// Per face: corners.
    pub faces: Vec<[u32; 3]>,
    /// Per face: Σ P(c|f)/b_c², 1/m².
    pub omega: Vec<f32>,
    /// Per face: index into `boxes`.
    pub group: Vec<u32>,
    /// Scale t of the step.
    pub scale: f64,
    /// Open borders nearer than this may join, metres.
    pub reach_m: f64,
    /// Where the faces of a group must stay, in plan.
    pub boxes: &'a [Rect],
    /// Per tracked sample: where the source is, relative to `origin`.
    pub samples: Vec<DVec3>,
    /// Per tracked sample: how far the surface may be from it at this scale, metres.
    pub limits: Vec<f64>,
    /// Per tracked sample: the face it rides on.
    pub rides: Vec<u32>,
}

/// Plane and weight of a current face.
#[derive(Clone, Copy, Default)]
struct Facet {
    normal: DVec3,
    d: f64,
    area: f64,
}

/// How many faces a vertex shares with the ends of the edge under test; valid while `stamp` is the run's.
#[derive(Clone, Copy, Default)]
struct Mark {
    stamp: u32,
    of_u: u16,
    of_v: u16,
    of_both: u16,
}

/// The running state behind [`Block::collapse`].
struct Run<'a> {
    block: Block<'a>,
    facets: Vec<Facet>,
    quadrics: Vec<Quadric>,
    version: Vec<u32>,
    head: Vec<u32>,
    next: Vec<u32>,
    sample_head: Vec<u32>,
    sample_next: Vec<u32>,
    queue: Queue,
    mark: Vec<Mark>,
    stamp: u32,
    star: Vec<Corner>,
    moved: Vec<(u32, u32)>,
    ring: Vec<u32>,
    log: Vec<Collapse>,
}

/// A face of a star as it would be after the collapse under test.
#[derive(Clone, Copy)]
struct Corner {
    face: u32,
    group: u32,
    dies: bool,
    facet: Facet,
    corners: [DVec3; 3],
}

impl<'a> Block<'a> {
    /// Collapses until no admissible edge is left; returns the block as it then is and what was done, in order.
    /// Faces that died have `NONE` as first corner; positions of vertices that died are stale.
    pub fn collapse(self) -> (Block<'a>, Vec<Collapse>) {
        let mut run = Run::new(self);
        run.rank_all();
        run.rank_gaps();
        while let Some(candidate) = run.queue.pop() {
            run.consider(candidate);
        }
        (run.block, run.log)
    }
}

impl<'a> Run<'a> {
    fn new(block: Block<'a>) -> Self {
        let (vertices, faces) = (block.positions.len(), block.faces.len());
        let mut run = Self {
            facets: vec![Facet::default(); faces],
            quadrics: vec![Quadric::default(); vertices],
            version: vec![0; vertices],
            head: vec![NONE; vertices],
            next: vec![NONE; 3 * faces],
            sample_head: vec![NONE; faces],
            sample_next: vec![NONE; block.samples.len()],
            queue: Queue::new(),
            mark: vec![Mark::default(); vertices],
            stamp: 0,
            star: Vec::new(),
            moved: Vec::new(),
            ring: Vec::new(),
            log: Vec::new(),
            block,
        };
        for f in (0..faces).rev() {
            run.facets[f] = facet(run.corners(f as u32));
            for k in 0..3 {
                let v = run.block.faces[f][k] as usize;
                run.next[3 * f + k] = run.head[v];
                run.head[v] = (3 * f + k) as u32;
            }
        }
        for s in (0..run.block.samples.len()).rev() {
            let f = run.block.rides[s] as usize;
            run.sample_next[s] = run.sample_head[f];
            run.sample_head[f] = s as u32;
        }
        for v in 0..vertices as u32 {
            run.quadrics[v as usize] = run.quadric_of(v);
        }
        run
    }

    fn corners(&self, f: u32) -> [DVec3; 3] {
        self.block.faces[f as usize].map(|v| self.block.positions[v as usize])
    }

    fn alive(&self, f: u32) -> bool {
        self.block.faces[f as usize][0] != NONE
    }

    /// Calls `visit(face)` for the faces of `v`'s star.
    fn each_face(&self, v: u32, mut visit: impl FnMut(u32)) {
        let mut corner = self.head[v as usize];
        while corner != NONE {
            if self.alive(corner / 3) {
                visit(corner / 3);
            }
            corner = self.next[corner as usize];
        }
    }

    fn quadric_of(&self, v: u32) -> Quadric {
        let mut sum = Quadric::default();
        self.each_face(v, |f| {
            let facet = &self.facets[f as usize];
            let omega = f64::from(self.block.omega[f as usize]);
            sum += Quadric::of_plane(facet.normal, facet.d, facet.area * omega);
            if self.block.flags[v as usize] & BORDER != 0 {
                for w in self.block.faces[f as usize] {
                    if w != v && self.shared_faces(v, w) == 1 {
                        sum += self.border_plane(v, w, facet.normal, omega);
                    }
                }
            }
        });
        sum
    }

    /// The plane through border edge `vw`, perpendicular to its face.
    fn border_plane(&self, v: u32, w: u32, normal: DVec3, omega: f64) -> Quadric {
        let (p, q) = (self.block.positions[v as usize], self.block.positions[w as usize]);
        let n = (q - p).cross(normal).normalize_or_zero();
        Quadric::of_plane(n, -n.dot(p), BORDER_WEIGHT * (q - p).length_squared() * omega)
    }

    fn shared_faces(&self, v: u32, w: u32) -> u32 {
        let mut count = 0;
        self.each_face(v, |f| count += u32::from(self.block.faces[f as usize].contains(&w)));
        count
    }

    fn rank_all(&mut self) {
        for f in (0..self.block.faces.len()).rev() {
            let [a, b, c] = self.block.faces[f];
            for (u, v) in [(a, b), (b, c), (c, a)] {
                // An inner edge is seen from every face beside it: only the first of them ranks it.
                let mut first = f as u32;
                self.each_face(u, |g| {
                    if self.block.faces[g as usize].contains(&v) {
                        first = first.min(g);
                    }
                });
                if first == f as u32 {
                    self.rank(u, v, false);
                }
            }
        }
    }

    fn rank(&mut self, u: u32, v: u32, gap: bool) {
        if let Some((_, energy)) = self.place(u, v) {
            let stamp = self.version[u as usize] + self.version[v as usize];
            self.queue.push(Candidate { u, v, stamp, energy, gap });
        }
    }

    /// Ranks pairs of open-border vertices within `reach_m` of each other. Tiled deliveries are cracked along their own
    /// tiles' borders: there the sides would drift apart as they simplify, and show as slits in coarse levels.
    fn rank_gaps(&mut self) {
        let reach = self.block.reach_m;
        let open: Vec<u32> = (0..self.block.positions.len() as u32)
            .filter(|&v| self.block.flags[v as usize] & (BORDER | LOCKED) == BORDER && self.is_open(v))
            .collect();
        let cell = |p: DVec3| (p / reach).floor().as_i64vec3();
        let mut grid: HashMap<I64Vec3, Vec<u32>> = HashMap::new();
        for &v in &open {
            grid.entry(cell(self.block.positions[v as usize])).or_default().push(v);
        }
        let mut near: Vec<(f64, u32)> = Vec::new();
        for &u in &open {
            let p = self.block.positions[u as usize];
            near.clear();
            for i in 0..27 {
                let offset = I64Vec3::new(i % 3, i / 3 % 3, i / 9) - 1;
                for &v in grid.get(&(cell(p) + offset)).into_iter().flatten() {
                    let d = (self.block.positions[v as usize] - p).length();
                    if v != u && d <= reach && self.shared_faces(u, v) == 0 {
                        near.push((d, v));
                    }
                }
            }
            near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            for &(_, v) in near.iter().take(MOST_GAPS) {
                self.rank(u, v, true);
            }
        }
    }

    /// True for a vertex on an edge that has one face.
    fn is_open(&self, v: u32) -> bool {
        let mut open = false;
        self.each_face(v, |f| {
            open |= self.block.faces[f as usize].iter().any(|&w| w != v && self.shared_faces(v, w) == 1);
        });
        open
    }

    /// Where the collapse of `uv` would put the vertex, and at what energy; none if their constraints disagree.
    fn place(&self, u: u32, v: u32) -> Option<(DVec3, f32)> {
        let (fu, fv) = (self.block.flags[u as usize], self.block.flags[v as usize]);
        let (pu, pv) = (self.block.positions[u as usize], self.block.positions[v as usize]);
        if (fu | fv) & LOCKED != 0 {
            return None;
        }
        let mut sum = self.quadrics[u as usize];
        sum += self.quadrics[v as usize];
        self.each_face(u, |f| {
            if self.block.faces[f as usize].contains(&v) {
                let facet = &self.facets[f as usize];
                let weight = facet.area * f64::from(self.block.omega[f as usize]);
                sum += Quadric::of_plane(facet.normal, facet.d, -weight);
            }
        });
        let p = on_grid(place_free(&sum, (fu, pu), (fv, pv))?);
        Some((p, sum.at(p) as f32))
    }

    fn consider(&mut self, candidate: Candidate) {
        let Candidate { u, v, stamp, energy: filed, gap } = candidate;
        if self.head[u as usize] == NONE || self.head[v as usize] == NONE {
            return;
        }
        if self.version[u as usize] + self.version[v as usize] != stamp {
            return;
        }
        let Some((p, energy)) = self.place(u, v) else { return };
        if energy > filed * STALE_FACTOR && energy > f32::MIN_POSITIVE {
            self.queue.push(Candidate { energy, ..candidate });
            return;
        }
        if !self.link_allows(u, v, gap) || !self.faces_allow(u, v, p) {
            return;
        }
        if let Some(share) = self.samples_allow().filter(|_| self.spans_allow()) {
            self.perform(u, v, p, energy, share);
        }
    }

    /// What is left of the link condition (Dey et al., Topology preserving edge contraction, 1999) on meshes that are
    /// full of holes and already non-manifold: no edge may end up with more faces than two or than it had, unless that
    /// closes a tunnel too small to matter at this scale; no two faces may fold onto each other. So small holes close
    /// and strips pinch instead of stopping everything around them.
    fn link_allows(&mut self, u: u32, v: u32, gap: bool) -> bool {
        self.stamp += 1;
        let mut shared = 0;
        let mut corner = self.head[u as usize];
        while corner != NONE {
            let face = self.block.faces[corner as usize / 3];
            corner = self.next[corner as usize];
            if face[0] == NONE {
                continue;
            }
            shared += u32::from(face.contains(&v));
            for w in face {
                let mark = &mut self.mark[w as usize];
                *mark = if mark.stamp == self.stamp { *mark } else { Mark { stamp: self.stamp, ..Mark::default() } };
                mark.of_u += 1;
            }
        }
        if (shared == 0) != gap {
            return false;
        }
        self.ring.clear();
        let mut folds = false;
        let mut corner = self.head[v as usize];
        while corner != NONE {
            let face = self.block.faces[corner as usize / 3];
            corner = self.next[corner as usize];
            if face[0] == NONE {
                continue;
            }
            let dies = face.contains(&u);
            let others = face.map(|w| if w == u || w == v { NONE } else { w });
            let mut common = 0;
            for w in others.into_iter().filter(|&w| w != NONE) {
                let mark = &mut self.mark[w as usize];
                if mark.stamp == self.stamp {
                    common += 1;
                    mark.of_v += 1;
                    mark.of_both += u16::from(dies);
                    if mark.of_v == 1 {
                        self.ring.push(w);
                    }
                }
            }
            if !dies && common == 2 {
                let [a, b] = two(others);
                self.each_face(u, |f| {
                    let other = &self.block.faces[f as usize];
                    folds |= other.contains(&a) && other.contains(&b);
                });
            }
        }
        let [pu, pv] = [u, v].map(|v| self.block.positions[v as usize]);
        let allowed = |w: &u32| {
            let Mark { of_u, of_v, of_both, .. } = self.mark[*w as usize];
            let pw = self.block.positions[*w as usize];
            let loop_m = || (pu - pv).length() + (pv - pw).length() + (pw - pu).length();
            of_u + of_v - 2 * of_both <= of_u.max(of_v).max(2) || loop_m() <= SMALL_LOOP_REACHES * self.block.reach_m
        };
        !folds && self.ring.iter().all(allowed)
    }

    /// Fills `star` with the faces as they would be; false where one flips, vanishes or leaves its cell.
    fn faces_allow(&mut self, u: u32, v: u32, p: DVec3) -> bool {
        let mut star = std::mem::take(&mut self.star);
        star.clear();
        let mut allowed = true;
        for (from, to) in [(u, v), (v, u)] {
            self.each_face(from, |f| {
                let face = self.block.faces[f as usize];
                let group = self.block.group[f as usize];
                if face.contains(&to) {
                    if from == u {
                        star.push(Corner { face: f, group, dies: true, facet: Facet::default(), corners: [p; 3] });
                    }
                    return;
                }
                let corners = face.map(|w| if w == from { p } else { self.block.positions[w as usize] });
                let new = facet(corners);
                let old = &self.facets[f as usize];
                let turned = old.area > 0.0 && new.normal.dot(old.normal) < LEAST_TURN_COS;
                allowed &= !turned && new.area > 0.0 && self.block.boxes[group as usize].contains(p.truncate(), 0.0);
                star.push(Corner { face: f, group, dies: false, facet: new, corners });
            });
        }
        allowed &= star.iter().any(|c| !c.dies);
        self.star = star;
        allowed
    }

    /// Finds the new face of every sample of the star, in the sample's own group; the largest deviation in units of its
    /// limit, or none if one would be further from its group's surface than its limit.
    fn samples_allow(&mut self) -> Option<f32> {
        let mut moved = std::mem::take(&mut self.moved);
        moved.clear();
        let mut worst = 0f64;
        let allowed = self.star.iter().all(|corner| {
            let mut s = self.sample_head[corner.face as usize];
            while s != NONE {
                let (face, squared) = nearest(&self.star, corner, self.block.samples[s as usize]);
                let limit = self.block.limits[s as usize];
                if squared > limit * limit {
                    return false;
                }
                worst = worst.max(squared.sqrt() / limit);
                moved.push((s, face));
                s = self.sample_next[s as usize];
            }
            true
        });
        self.moved = moved;
        allowed.then_some(worst as f32)
    }

    /// True if no new face spans open space: its middle, and those of its long sides, stay within its own budget of the
    /// star as it was. Samples hold the surface near the source; this holds it away from where the source is not, as far
    /// as one collapse can tell.
    fn spans_allow(&self) -> bool {
        self.star.iter().filter(|c| !c.dies).all(|c| {
            let limit_squared = self.block.scale * self.block.scale / f64::from(self.block.omega[c.face as usize]);
            let near = |p: DVec3| {
                let squared = |old: &Corner| (closest_on_triangle(p, &self.corners(old.face)) - p).length_squared();
                squared(c) <= limit_squared || self.star.iter().any(|old| squared(old) <= limit_squared)
            };
            let [p, q, r] = c.corners;
            // The middle of a short side is near because its ends are.
            let side = |a: DVec3, b: DVec3| (b - a).length_squared() <= 4.0 * limit_squared || near((a + b) * 0.5);
            near((p + q + r) / 3.0) && side(p, q) && side(q, r) && side(r, p)
        })
    }

    fn perform(&mut self, u: u32, v: u32, p: DVec3, energy: f32, share: f32) {
        let ids = &self.block.vertex_ids;
        let (kept, gone) = (ids[u as usize], ids[v as usize]);
        self.log.push(Collapse { kept, gone, position: self.block.origin + p, energy, share });
        let star = std::mem::take(&mut self.star);
        // The list of u is relinked from the faces that live; v's is dropped.
        self.head[u as usize] = NONE;
        self.head[v as usize] = NONE;
        self.ring.clear();
        for corner in star.iter().rev() {
            let f = corner.face as usize;
            self.sample_head[f] = NONE;
            for w in self.block.faces[f] {
                if w != u && w != v && !self.ring.contains(&w) {
                    self.ring.push(w);
                }
            }
            if corner.dies {
                self.block.faces[f] = [NONE; 3];
                continue;
            }
            self.facets[f] = corner.facet;
            for k in 0..3 {
                let w = &mut self.block.faces[f][k];
                if *w == v || *w == u {
                    *w = u;
                    self.next[3 * f + k] = self.head[u as usize];
                    self.head[u as usize] = (3 * f + k) as u32;
                }
            }
        }
        self.star = star;
        for i in (0..self.moved.len()).rev() {
            let (s, face) = self.moved[i];
            self.sample_next[s as usize] = self.sample_head[face as usize];
            self.sample_head[face as usize] = s;
            self.block.rides[s as usize] = face;
        }
        self.block.positions[u as usize] = p;
        self.block.flags[u as usize] |= self.block.flags[v as usize];
        self.version[u as usize] += self.version[v as usize] + 1;
        self.quadrics[u as usize] = self.quadric_of(u);
        let ring = std::mem::take(&mut self.ring);
        for &w in &ring {
            self.quadrics[w as usize] = self.quadric_of(w);
        }
        for &w in &ring {
            self.rank(u, w, false);
        }
        self.ring = ring;
    }
}

/// The best position that the constraints of both ends allow.
fn place_free(sum: &Quadric, (fu, pu): (u8, DVec3), (fv, pv): (u8, DVec3)) -> Option<DVec3> {
    let (mu, mv) = (fu & (FIX_X | FIX_Y), fv & (FIX_X | FIX_Y));
    if mu & mv != mu && mu & mv != mv {
        return None;
    }
    let (fixed_u, fixed_v) = (fixed(mu), fixed(mv));
    let mut start = (pu + pv) * 0.5;
    for k in 0..2 {
        match (fixed_u[k], fixed_v[k]) {
            (true, true) if pu[k] != pv[k] => return None,
            (true, _) => start[k] = pu[k],
            (_, true) => start[k] = pv[k],
            _ => {}
        }
    }
    let p = sum.least(start, fixed(mu | mv));
    if (p - start).length_squared() <= (FARTHEST_LENGTHS * FARTHEST_LENGTHS) * (pu - pv).length_squared() {
        return Some(p);
    }
    let ends = [Some(start), keeps(mv, pv, pu), keeps(mu, pu, pv)];
    ends.into_iter().flatten().min_by(|a, b| sum.at(*a).total_cmp(&sum.at(*b)))
}

fn facet([a, b, c]: [DVec3; 3]) -> Facet {
    let cross = (b - a).cross(c - a);
    let normal = cross.normalize_or_zero();
    Facet { normal, d: -normal.dot(a), area: 0.5 * cross.length() }
}

fn fixed(mask: u8) -> [bool; 3] {
    [mask & FIX_X != 0, mask & FIX_Y != 0, false]
}

/// `target` if a vertex at `p` under the constraints `mask` may move there.
fn keeps(mask: u8, p: DVec3, target: DVec3) -> Option<DVec3> {
    let [x, y, _] = fixed(mask);
    ((!x || p.x == target.x) && (!y || p.y == target.y)).then_some(target)
}

fn two(others: [u32; 3]) -> [u32; 2] {
    let mut found = others.into_iter().filter(|&w| w != NONE);
    [found.next().unwrap_or(NONE), found.next().unwrap_or(NONE)]
}

/// The living face of `star` in the group of `own` that is nearest to `s`, `own` tried first, and the squared distance.
fn nearest(star: &[Corner], own: &Corner, s: DVec3) -> (u32, f64) {
    let mut best = (NONE, f64::INFINITY);
    let own_first = std::iter::once(own).chain(star.iter().filter(|c| c.face != own.face));
    for corner in own_first.filter(|c| !c.dies && c.group == own.group) {
        let off_plane = corner.facet.normal.dot(s) + corner.facet.d;
        if off_plane * off_plane < best.1 {
            let squared = (closest_on_triangle(s, &corner.corners) - s).length_squared();
            if squared < best.1 {
                best = (corner.face, squared);
            }
        }
    }
    best
}
