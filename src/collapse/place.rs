//! Where a collapse puts its vertex, and at what energy.

use std::collections::HashMap;

use glam::{DVec3, I64Vec3};

use super::block::{BORDER, Energy, FIX_X, FIX_Y, LOCKED};
use super::energy::Form;
use super::run::{Run, Vertex};
use super::volume;

/// A solution further from the edge's middle than this many edge lengths is not trusted.
const FARTHEST_LENGTHS: f64 = 2.0;
/// Weight of open borders against the surface beside them, both as squared length.
const BORDER_WEIGHT: f64 = 1.0;
/// A border vertex is tried with at most this many others across a gap, the nearest first.
const MOST_GAPS: usize = 3;

impl Run<'_> {
    /// An energy to file the edge `uv` under; none if the constraints of its ends disagree.
    ///
    /// Faces at both ends count twice, and the grid is not looked at. That is enough to rank an edge, and spares finding
    /// the faces.
    pub(super) fn estimate(&self, u: u32, v: u32) -> Option<f32> {
        if self.block.rules.energy != Energy::Memoryless {
            return self.place(u, v).map(|p| p.1);
        }
        let pull = Pull::of(&self.vertices[u as usize], &self.vertices[v as usize])?;
        Some(if self.block.rules.half_edge { pull.half_edge()?.1 } else { pull.at(pull.step()) })
    }

    /// Where the collapse of `uv` would put the vertex, and at what energy; none if their constraints disagree. What is
    /// near was gathered.
    pub(super) fn place(&self, u: u32, v: u32) -> Option<(DVec3, f32)> {
        let rules = &self.block.rules;
        match rules.energy {
            Energy::Memoryless => self.place_memoryless(u, v),
            Energy::Volume => {
                let (p, energy) = volume::place(self, u, v)?;
                Some((snapped(p, rules.grid_m), energy as f32))
            }
            Energy::Accumulated | Energy::Paper => self.place_accumulated(u, v),
        }
    }

    fn place_memoryless(&self, u: u32, v: u32) -> Option<(DVec3, f32)> {
        let mut pull = Pull::of(&self.vertices[u as usize], &self.vertices[v as usize])?;
        self.count_once(&mut pull, u, v);
        if self.block.rules.half_edge {
            return pull.half_edge();
        }
        let p = snapped(pull.start + pull.step(), self.block.rules.grid_m);
        Some((p, pull.at(p - pull.start)))
    }

    fn place_accumulated(&self, u: u32, v: u32) -> Option<(DVec3, f32)> {
        let (a, b) = (&self.vertices[u as usize], &self.vertices[v as usize]);
        let (start, mask) = start(a, b)?;
        let mut sum = self.quadrics[u as usize];
        sum += self.quadrics[v as usize];
        let mut p = sum.least(start, fixed(mask));
        if (p - start).length_squared() > FARTHEST_LENGTHS * FARTHEST_LENGTHS * (a.at - b.at).length_squared() {
            let ends = [Some(start), keeps(b, a.at), keeps(a, b.at)];
            p = ends.into_iter().flatten().min_by(|a, b| sum.at(*a).total_cmp(&sum.at(*b)))?;
        }
        let p = snapped(p, self.block.rules.grid_m);
        let energy = sum.at(p) as f32;
        let factor = if self.block.rules.energy == Energy::Paper { self.paper_factor(u, v) } else { 1.0 };
        Some((p, energy * factor))
    }

    /// Takes what stands at both ends of `uv` out of the sum of their forms once; `near` is theirs.
    fn count_once(&self, pull: &mut Pull, u: u32, v: u32) {
        let mut shared = (0, 0);
        for (f, face) in &self.near[..self.near_u] {
            if face.corners.contains(&v) {
                pull.take(face.normal.as_dvec3(), f64::from(face.weight));
                shared = (shared.0 + 1, *f);
            }
        }
        if shared.0 == 1 && self.vertices[u as usize].mark.flags & self.vertices[v as usize].mark.flags & BORDER != 0 {
            let (n, weight) = self.border_plane(u, v, shared.1);
            pull.take(n, weight);
        }
    }

    /// Hands out the planes along the open border at `v`: unit normal and weight.
    pub(super) fn borders_of(&self, v: u32, mut add: impl FnMut(DVec3, f64)) {
        if self.vertices[v as usize].mark.flags & BORDER == 0 {
            return;
        }
        for &f in self.star_of(v) {
            for w in self.faces[f as usize].corners {
                if w != v && self.vertices[w as usize].mark.flags & BORDER != 0 && self.shared_faces(v, w) == 1 {
                    let (n, weight) = self.border_plane(v, w, f);
                    add(n, weight);
                }
            }
        }
    }

    /// The plane through border edge `vw`, perpendicular to its face.
    pub(super) fn border_plane(&self, v: u32, w: u32, f: u32) -> (DVec3, f64) {
        let edge = self.at(v.max(w)) - self.at(v.min(w));
        let face = &self.faces[f as usize];
        let n = edge.cross(face.normal.as_dvec3()).normalize_or_zero();
        (n, BORDER_WEIGHT * edge.length_squared() * f64::from(face.omega))
    }

    /// The paper's §2.3 has no numbers. As we read it: the class of the edge's first vertex scales the cost (here by its
    /// weight, budgets standing for importance), and creases are raised above what is coplanar.
    fn paper_factor(&self, u: u32, v: u32) -> f32 {
        let Some(&first) = self.star_of(u).first() else { return 1.0 };
        let normal = self.faces[first as usize].normal;
        let faces = self.star_of(u).iter().chain(self.star_of(v));
        let least = faces.map(|&f| self.faces[f as usize].normal.dot(normal)).fold(1.0, f32::min);
        self.block.paper_weight[first as usize] * if least < super::COPLANAR_COS { super::CREASE_FACTOR } else { 1.0 }
    }

    /// Ranks pairs of open-border vertices within reach of each other. Tiled deliveries are cracked along their own
    /// tiles' borders: there the sides would drift apart as they simplify, and show as slits in coarse levels.
    pub(super) fn rank_gaps(&mut self) {
        let reach = self.block.rules.gap_reach_m;
        let open: Vec<u32> = (0..self.vertices.len() as u32)
            .filter(|&v| self.vertices[v as usize].mark.flags & (BORDER | LOCKED) == BORDER && self.is_open(v))
            .collect();
        let cell = |p: DVec3| (p / reach).floor().as_i64vec3();
        let mut grid: HashMap<I64Vec3, Vec<u32>> = HashMap::new();
        for &v in &open {
            grid.entry(cell(self.at(v))).or_default().push(v);
        }
        let mut near: Vec<(f64, u32)> = Vec::new();
        for &u in &open {
            let p = self.at(u);
            near.clear();
            for i in 0..27 {
                let offset = I64Vec3::new(i % 3, i / 3 % 3, i / 9) - 1;
                for &v in grid.get(&(cell(p) + offset)).into_iter().flatten() {
                    let d = (self.at(v) - p).length();
                    if v != u && d <= reach && self.shared_faces(u, v) == 0 {
                        near.push((d, v));
                    }
                }
            }
            near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            for &(_, v) in near.iter().take(MOST_GAPS) {
                self.rank(u, v);
            }
        }
    }

    /// True for a vertex on an edge that has one face.
    fn is_open(&self, v: u32) -> bool {
        let open = |f: &u32| self.faces[*f as usize].corners.iter().any(|&w| w != v && self.shared_faces(v, w) == 1);
        self.star_of(v).iter().any(open)
    }
}

/// The nearest multiple of a power of two.
fn snapped(p: DVec3, grid_m: f64) -> DVec3 {
    (p / grid_m).round() * grid_m
}

/// What two vertices want of the one they merge into, about the place where the search starts: yᵀSy + 2g·y + c.
struct Pull<'a> {
    start: DVec3,
    sum: Form,
    g: DVec3,
    c: f64,
    mask: u8,
    ends: [&'a Vertex; 2],
}

impl<'a> Pull<'a> {
    #[inline(always)]
    fn of(u: &'a Vertex, v: &'a Vertex) -> Option<Self> {
        let (start, mask) = start(u, v)?;
        let (a, b) = (start - u.at, start - v.at);
        let (mut sum, other) = (u.form.form(), v.form.form());
        let (of_a, of_b) = (sum.times(a), other.times(b));
        sum += other;
        Some(Self { start, sum, g: of_a + of_b, c: a.dot(of_a) + b.dot(of_b), mask, ends: [u, v] })
    }

    /// Takes out a plane through both ends.
    fn take(&mut self, n: DVec3, weight: f64) {
        let d = n.dot(self.start - self.ends[0].at);
        self.sum -= Form::of_plane(n, weight);
        self.g -= n * (weight * d);
        self.c -= weight * d * d;
    }

    /// From the start to the best place that the constraints allow.
    #[inline(always)]
    fn step(&self) -> DVec3 {
        let y = self.sum.least(self.g, fixed(self.mask));
        let [u, v] = self.ends;
        let far_squared = FARTHEST_LENGTHS * FARTHEST_LENGTHS * (u.at - v.at).length_squared();
        if y.length_squared() <= far_squared { y } else { self.best_of_few() }
    }

    /// To the start or an end, whatever is best.
    fn best_of_few(&self) -> DVec3 {
        let ends = self.allowed_ends().map(|p| p - self.start);
        ends.fold(DVec3::ZERO, |best, y| if self.at(y) < self.at(best) { y } else { best })
    }

    /// The places of the ends that the other end's constraints allow.
    fn allowed_ends(&self) -> impl Iterator<Item = DVec3> {
        let [u, v] = self.ends;
        [keeps(v, u.at), keeps(u, v.at)].into_iter().flatten()
    }

    /// The better end.
    fn half_edge(&self) -> Option<(DVec3, f32)> {
        let ends = self.allowed_ends().map(|p| (p, self.at(p - self.start)));
        ends.min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// The energy at `y` from the start, never negative.
    #[inline(always)]
    fn at(&self, y: DVec3) -> f32 {
        (y.dot(self.sum.times(y)) + 2.0 * self.g.dot(y) + self.c).max(0.0) as f32
    }
}

/// Where the search for the best place starts, and what must not change there; none if the constraints disagree.
#[inline(always)]
fn start(u: &Vertex, v: &Vertex) -> Option<(DVec3, u8)> {
    let middle = (u.at + v.at) * 0.5;
    if (u.mark.flags | v.mark.flags) & (LOCKED | FIX_X | FIX_Y) == 0 {
        Some((middle, 0))
    } else {
        constrained(u, v, middle)
    }
}

fn constrained(u: &Vertex, v: &Vertex, mut start: DVec3) -> Option<(DVec3, u8)> {
    let (mu, mv) = (u.mark.flags & (FIX_X | FIX_Y), v.mark.flags & (FIX_X | FIX_Y));
    if (u.mark.flags | v.mark.flags) & LOCKED != 0 || (mu & mv != mu && mu & mv != mv) {
        return None;
    }
    let (fixed_u, fixed_v) = (fixed(mu), fixed(mv));
    for k in 0..2 {
        match (fixed_u[k], fixed_v[k]) {
            (true, true) if u.at[k] != v.at[k] => return None,
            (true, _) => start[k] = u.at[k],
            (_, true) => start[k] = v.at[k],
            _ => {}
        }
    }
    Some((start, mu | mv))
}

fn fixed(mask: u8) -> [bool; 3] {
    [mask & FIX_X != 0, mask & FIX_Y != 0, false]
}

/// `target` if `vertex` may move there.
fn keeps(vertex: &Vertex, target: DVec3) -> Option<DVec3> {
    let [x, y, _] = fixed(vertex.mark.flags);
    ((!x || vertex.at.x == target.x) && (!y || vertex.at.y == target.y)).then_some(target)
}
