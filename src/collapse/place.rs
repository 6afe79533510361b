//! Where a collapse puts its vertex, and at what energy.

use std::collections::HashMap;

use glam::{DVec3, I64Vec3};

use super::block::{BORDER, Energy, FIX_X, FIX_Y, LOCKED, Run};
use super::energy::Quadric;
use super::volume;

/// A solution further from the edge's middle than this many edge lengths is not trusted.
const FARTHEST_LENGTHS: f64 = 2.0;
/// Weight of open borders against the surface beside them, both as squared length.
const BORDER_WEIGHT: f64 = 1.0;
/// A border vertex is tried with at most this many others across a gap, the nearest first.
const MOST_GAPS: usize = 3;

impl Run<'_> {
    /// Where the collapse of `uv` would put the vertex, and at what energy; none if their constraints disagree.
    ///
    /// Not `exact`: faces at both ends count twice. That is enough to rank an edge, and spares finding them.
    pub(super) fn place(&self, u: u32, v: u32, exact: bool) -> Option<(DVec3, f32)> {
        let (fu, fv) = (self.block.flags[u as usize], self.block.flags[v as usize]);
        let (pu, pv) = (self.block.positions[u as usize], self.block.positions[v as usize]);
        if (fu | fv) & LOCKED != 0 {
            return None;
        }
        let rules = &self.block.rules;
        if rules.energy == Energy::Volume {
            let (p, energy) = volume::place(self, u, v)?;
            return Some((snapped(p, rules.grid_m), energy as f32));
        }
        let mut sum = self.quadrics[u as usize];
        sum += self.quadrics[v as usize];
        if exact && rules.energy == Energy::Memoryless {
            self.count_once(&mut sum, u, v);
        }
        let p = if rules.half_edge {
            let ends = [keeps(fv, pv, pu), keeps(fu, pu, pv)];
            ends.into_iter().flatten().min_by(|a, b| sum.at(*a).total_cmp(&sum.at(*b)))?
        } else {
            snapped(place_free(&sum, (fu, pu), (fv, pv))?, rules.grid_m)
        };
        let energy = sum.at(p) as f32;
        Some((p, if rules.energy == Energy::Paper { energy * self.paper_factor(u, v) } else { energy }))
    }

    /// Takes what stands at both ends of `uv` out of the sum of their quadrics once.
    fn count_once(&self, sum: &mut Quadric, u: u32, v: u32) {
        let (few, other) = if self.stars.count(u) <= self.stars.count(v) { (u, v) } else { (v, u) };
        let mut shared = (0, 0);
        for &f in self.stars.faces(few) {
            if self.block.faces[f as usize].contains(&other) {
                *sum -= self.face_quadric(f);
                shared = (shared.0 + 1, f);
            }
        }
        if shared.0 == 1 && self.block.flags[u as usize] & self.block.flags[v as usize] & BORDER != 0 {
            *sum -= self.border_plane(u, v, shared.1);
        }
    }

    /// The planes along the open border at `v`.
    pub(super) fn border_of(&self, v: u32) -> Quadric {
        let mut sum = Quadric::default();
        for &f in self.stars.faces(v) {
            for w in self.block.faces[f as usize] {
                if w != v && self.block.flags[w as usize] & BORDER != 0 && self.shared_faces(v, w) == 1 {
                    sum += self.border_plane(v, w, f);
                }
            }
        }
        sum
    }

    /// The plane through border edge `vw`, perpendicular to its face.
    fn border_plane(&self, v: u32, w: u32, f: u32) -> Quadric {
        let (v, w) = (v.min(w), v.max(w));
        let (p, q) = (self.block.positions[v as usize], self.block.positions[w as usize]);
        let n = (q - p).cross(self.facets[f as usize].normal.as_dvec3()).normalize_or_zero();
        let omega = f64::from(self.block.omega[f as usize]);
        Quadric::of_plane(n, -n.dot(p), BORDER_WEIGHT * (q - p).length_squared() * omega)
    }

    /// The paper's §2.3 has no numbers. As we read it: the class of the edge's first vertex scales the cost (here by its
    /// weight, budgets standing for importance), and creases are raised above what is coplanar.
    fn paper_factor(&self, u: u32, v: u32) -> f32 {
        let Some(&first) = self.stars.faces(u).first() else { return 1.0 };
        let normal = self.facets[first as usize].normal;
        let faces = self.stars.faces(u).iter().chain(self.stars.faces(v));
        let least = faces.map(|&f| self.facets[f as usize].normal.dot(normal)).fold(1.0, f32::min);
        self.block.paper_weight[first as usize] * if least < super::COPLANAR_COS { super::CREASE_FACTOR } else { 1.0 }
    }

    /// Ranks pairs of open-border vertices within reach of each other. Tiled deliveries are cracked along their own
    /// tiles' borders: there the sides would drift apart as they simplify, and show as slits in coarse levels.
    pub(super) fn rank_gaps(&mut self) {
        let reach = self.block.rules.gap_reach_m;
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
                self.rank(u, v);
            }
        }
    }

    /// True for a vertex on an edge that has one face.
    fn is_open(&self, v: u32) -> bool {
        let open = |f: &u32| self.block.faces[*f as usize].iter().any(|&w| w != v && self.shared_faces(v, w) == 1);
        self.stars.faces(v).iter().any(open)
    }
}

/// The nearest multiple of a power of two.
fn snapped(p: DVec3, grid_m: f64) -> DVec3 {
    (p / grid_m).round() * grid_m
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

fn fixed(mask: u8) -> [bool; 3] {
    [mask & FIX_X != 0, mask & FIX_Y != 0, false]
}

/// `target` if a vertex at `p` under the constraints `mask` may move there.
fn keeps(mask: u8, p: DVec3, target: DVec3) -> Option<DVec3> {
    let [x, y, _] = fixed(mask);
    ((!x || p.x == target.x) && (!y || p.y == target.y)).then_some(target)
}
