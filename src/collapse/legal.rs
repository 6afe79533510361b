//! Which collapses are allowed: no new non-manifold edges, no flips, no face across open space.

use glam::DVec3;

use super::block::{Corner, Mark, Run};
use super::energy::Facet;
use crate::geo::bvh::closest_on_triangle;

/// A face may turn by at most this much in one collapse (cosine): beyond it, it flips or becomes a sliver.
const LEAST_TURN_COS: f32 = 0.2;

impl Run<'_> {
    /// What is left of the link condition (Dey et al., Topology preserving edge contraction, 1999) on meshes that are
    /// full of holes, tunnels and thin sheets: no edge may end up with more faces than two or than it had. Faces that
    /// fold onto each other are no obstacle: two that point opposite ways enclose nothing and vanish together, of two
    /// that point the same way one stays. So tunnels, flaps and double walls close instead of stopping all around them.
    ///
    /// Fills `ring` with the common neighbours and `pairs` with the folded faces.
    pub(super) fn link_allows(&mut self, u: u32, v: u32) -> bool {
        self.stamp += 1;
        self.pairs.clear();
        self.ring.clear();
        for &f in self.stars.faces(u) {
            for w in self.block.faces[f as usize] {
                let mark = &mut self.mark[w as usize];
                *mark = if mark.stamp == self.stamp { *mark } else { Mark { stamp: self.stamp, ..Mark::default() } };
                mark.of_u += 1;
            }
        }
        for i in 0..self.stars.count(v) as usize {
            let f = self.stars.faces(v)[i];
            let face = self.block.faces[f as usize];
            let dies = face.contains(&u);
            let mut common = 0;
            for w in face.into_iter().filter(|&w| w != u && w != v) {
                let mark = &mut self.mark[w as usize];
                if mark.stamp == self.stamp {
                    common += 1;
                    mark.of_v += 1;
                    mark.dying += 2 * u16::from(dies);
                    if mark.of_v == 1 {
                        self.ring.push(w);
                    }
                }
            }
            if !dies && common == 2 && !self.fold(u, v, f) {
                return false;
            }
        }
        // Vertices that faces do not join any more, or never did.
        if self.block.rules.gap_reach_m == 0.0 && self.shared_faces(u, v) == 0 {
            return false;
        }
        let [pu, pv] = [u, v].map(|v| self.block.positions[v as usize]);
        self.ring.iter().all(|w| {
            let Mark { of_u, of_v, dying, .. } = self.mark[*w as usize];
            let pw = self.block.positions[*w as usize];
            let loop_m = || (pu - pv).length() + (pv - pw).length() + (pw - pu).length();
            (of_u + of_v).saturating_sub(dying) <= of_u.max(of_v).max(2) || loop_m() <= self.block.rules.loop_reach_m
        })
    }

    /// Pairs face `f` of v with the face of u that it would fold onto, if there is one; false where they may not meet.
    fn fold(&mut self, u: u32, v: u32, f: u32) -> bool {
        let [a, b] = after(self.block.faces[f as usize], v);
        let onto = self.stars.faces(u).iter().copied().find(|&g| {
            let other = &self.block.faces[g as usize];
            other.contains(&a) && other.contains(&b)
        });
        let Some(g) = onto else { return true };
        if self.group_of(f) != self.group_of(g) {
            return false;
        }
        let same = after(self.block.faces[g as usize], u)[0] == a;
        self.pairs.push((f, g, same));
        for w in [a, b] {
            self.mark[w as usize].dying += if same { 1 } else { 2 };
        }
        true
    }

    /// Fills `star` with the faces as they would be; false where one flips, vanishes or leaves its cell.
    pub(super) fn faces_allow(&mut self, u: u32, v: u32, p: DVec3) -> bool {
        let mut star = std::mem::take(&mut self.star);
        star.clear();
        let allowed = self.fill(&mut star, u, v, p) && star.iter().any(|c| !c.dies);
        self.star = star;
        allowed
    }

    fn fill(&self, star: &mut Vec<Corner>, u: u32, v: u32, p: DVec3) -> bool {
        for (from, to) in [(u, v), (v, u)] {
            for &f in self.stars.faces(from) {
                let face = self.block.faces[f as usize];
                let group = self.group_of(f);
                let between = face.contains(&to);
                if between || self.folds(f) {
                    if from == u || !between {
                        star.push(Corner { face: f, group, dies: true, facet: Facet::default(), corners: [p; 3] });
                    }
                    continue;
                }
                let corners = face.map(|w| if w == from { p } else { self.block.positions[w as usize] });
                let facet = Facet::of(corners);
                let old = &self.facets[f as usize];
                let turned = old.area > 0.0 && facet.normal.dot(old.normal) < LEAST_TURN_COS;
                if turned || facet.area <= 0.0 || !self.stays(group, p) {
                    return false;
                }
                star.push(Corner { face: f, group, dies: false, facet, corners });
            }
        }
        true
    }

    fn folds(&self, f: u32) -> bool {
        self.pairs.iter().any(|&(of_v, of_u, same)| of_v == f || (of_u == f && !same))
    }

    fn stays(&self, group: u32, p: DVec3) -> bool {
        self.block.boxes.get(group as usize).is_none_or(|cell| cell.contains(p.truncate(), 0.0))
    }

    /// What folded faces add to the energy when no samples speak for them: their area times the squared radius of the
    /// largest circle in them.
    pub(super) fn folded_energy(&self) -> f32 {
        let energy = |f: u32| {
            let [a, b, c] = self.corners(f);
            let area = f64::from(self.facets[f as usize].area);
            let around = (b - a).length() + (c - b).length() + (a - c).length();
            let radius = if around > 0.0 { 2.0 * area / around } else { 0.0 };
            area * f64::from(self.block.omega[f as usize]) * radius * radius
        };
        self.pairs.iter().filter(|p| !p.2).map(|&(f, g, _)| energy(f) + energy(g)).sum::<f64>() as f32
    }

    /// True if no new face spans open space: its middle, and those of its long sides, stay within its own budget of the
    /// star as it was. Samples hold the surface near the source; this holds it away from where the source is not, as far
    /// as one collapse can tell.
    pub(super) fn spans_allow(&self) -> bool {
        self.star.iter().filter(|c| !c.dies).all(|c| {
            let limit_squared = self.scale * self.scale / f64::from(self.block.omega[c.face as usize]);
            let near = |p: DVec3| {
                let squared = |old: &Corner| (closest_on_triangle(p, &self.corners(old.face)) - p).length_squared();
                squared(c) <= limit_squared || self.star.iter().any(|old| squared(old) <= limit_squared)
            };
            let [p, q, r] = c.corners;
            // The middle of a short side is near because its ends are.
            let side = |a: DVec3, b: DVec3| (b - a).length_squared() <= 4.0 * limit_squared || near((a + b) * 0.5);
            let small = [(p, q), (q, r), (r, p)].iter().all(|(a, b)| (*b - *a).length_squared() <= limit_squared);
            small || near((p + q + r) / 3.0) && side(p, q) && side(q, r) && side(r, p)
        })
    }
}

/// The two corners that follow `v` in `face`.
fn after(face: [u32; 3], v: u32) -> [u32; 2] {
    let k = face.iter().position(|&w| w == v).unwrap_or(0);
    [face[(k + 1) % 3], face[(k + 2) % 3]]
}
