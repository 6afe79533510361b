//! Which collapses are allowed: no new non-manifold edges, no flips, no face across open space.

use glam::{DVec3, Vec3};

use super::energy::Facet;
use super::run::{Around, Corner, Face, Mark, Run, Vertex};
use crate::geo::bvh::closest_on_triangle;

/// A face may turn by at most this much in one collapse (cosine): beyond it, it flips or becomes a sliver.
const LEAST_TURN_COS: f32 = 0.2;

impl Run<'_> {
    /// What is left of the link condition (Dey et al., Topology preserving edge contraction, 1999) on meshes that are
    /// full of holes, tunnels and thin sheets: no edge may end up with more faces than two or than it had. Faces that
    /// fold onto each other are no obstacle: two that point opposite ways enclose nothing and vanish together, of two
    /// that point the same way one stays. So tunnels, flaps and double walls close instead of stopping all around them.
    ///
    /// Fills `ring` with the vertices around the edge and `pairs` with the folded faces.
    pub(super) fn link_allows(&mut self, u: u32, v: u32) -> bool {
        self.stamp += 1;
        self.pairs.clear();
        self.ring.clear();
        let near = std::mem::take(&mut self.near);
        let met = self.count_faces(&near, u, v);
        self.near = near;
        if !met {
            return false;
        }
        let [pu, pv] = [u, v].map(|v| self.at(v));
        self.ring.iter().all(|&w| {
            let Vertex { mark: Mark { of_u, of_v, dying, .. }, at: pw, .. } = self.vertices[w as usize];
            if of_u == 0 || of_v == 0 {
                return true;
            }
            let loop_m = || (pu - pv).length() + (pv - pw).length() + (pw - pu).length();
            let left = (u16::from(of_u) + u16::from(of_v)).saturating_sub(u16::from(dying));
            left <= u16::from(of_u.max(of_v).max(2)) || loop_m() <= self.block.rules.loop_reach_m
        })
    }

    /// Marks the ring with the faces that it shares with u and v; false where u and v are no edge, or folded faces may
    /// not meet.
    fn count_faces(&mut self, near: &[(u32, Face)], u: u32, v: u32) -> bool {
        let (of_u, of_v) = near.split_at(self.near_u);
        let mut shared = 0;
        for (_, face) in of_u {
            shared += usize::from(face.corners.contains(&v));
            for w in face.corners.into_iter().filter(|&w| w != u && w != v) {
                let mark = self.mark(w);
                mark.of_u = mark.of_u.saturating_add(1);
            }
        }
        // Vertices that faces do not join any more, or never did.
        if shared == 0 && self.block.rules.gap_reach_m == 0.0 {
            return false;
        }
        for (f, face) in of_v {
            let dies = face.corners.contains(&u);
            let mut common = 0;
            for w in face.corners.into_iter().filter(|&w| w != u && w != v) {
                let mark = self.mark(w);
                common += usize::from(mark.of_u > 0);
                mark.of_v = mark.of_v.saturating_add(1);
                mark.dying = mark.dying.saturating_add(2 * u8::from(dies));
            }
            if !dies && common == 2 && !self.fold(u, v, *f) {
                return false;
            }
        }
        true
    }

    /// The mark of `w`, which is on the ring from now on.
    fn mark(&mut self, w: u32) -> &mut Mark {
        let mark = &mut self.vertices[w as usize].mark;
        if mark.stamp != self.stamp {
            mark.renew(self.stamp);
            self.ring.push(w);
        }
        mark
    }

    /// Pairs face `f` of v with the face of u that it would fold onto, if there is one; false where they may not meet.
    fn fold(&mut self, u: u32, v: u32, f: u32) -> bool {
        let [a, b] = after(self.faces[f as usize].corners, v);
        let onto = self.star_of(u).iter().copied().find(|&g| {
            let other = &self.faces[g as usize].corners;
            other.contains(&a) && other.contains(&b)
        });
        let Some(g) = onto else { return true };
        if self.group_of(f) != self.group_of(g) {
            return false;
        }
        let same = after(self.faces[g as usize].corners, u)[0] == a;
        self.pairs.push((f, g, same));
        for w in [a, b] {
            let dying = &mut self.vertices[w as usize].mark.dying;
            *dying = dying.saturating_add(if same { 1 } else { 2 });
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
        for (i, &(f, face)) in self.near.iter().enumerate() {
            let (from, to) = if i < self.near_u { (u, v) } else { (v, u) };
            let group = self.group_of(f);
            let between = face.corners.contains(&to);
            let ids = face.corners;
            if between || self.folds(f) {
                if from == u || !between {
                    let (facet, around) = (Facet::default(), Around::default());
                    star.push(Corner { face: f, group, dies: true, ids, facet, corners: [p; 3], around });
                }
                continue;
            }
            let corners = ids.map(|w| if w == from { p } else { self.at(w) });
            let facet = Facet::of(corners);
            let turned = facet.normal.dot(face.normal) < LEAST_TURN_COS && face.normal != Vec3::ZERO;
            if turned || facet.area <= 0.0 || !self.stays(group, p) {
                return false;
            }
            star.push(Corner { face: f, group, dies: false, ids, facet, corners, around: Around::of(corners) });
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
            let area = f64::from(Facet::of([a, b, c]).area);
            let around = (b - a).length() + (c - b).length() + (a - c).length();
            let radius = if around > 0.0 { 2.0 * area / around } else { 0.0 };
            f64::from(self.faces[f as usize].weight) * radius * radius
        };
        self.pairs.iter().filter(|p| !p.2).map(|&(f, g, _)| energy(f) + energy(g)).sum::<f64>() as f32
    }

    /// True if no new face spans open space: its middle, and those of its long sides, stay within its own budget of the
    /// star as it was. Samples hold the surface near the source; this holds it away from where the source is not, as far
    /// as one collapse can tell.
    pub(super) fn spans_allow(&mut self) -> bool {
        let mut old = std::mem::take(&mut self.old);
        old.clear();
        old.extend(self.star.iter().map(|c| self.corners(c.face)).map(|corners| (Around::of(corners), corners)));
        let allowed = self.spans_stay(&old);
        self.old = old;
        allowed
    }

    /// The same, of the star as it was: `old`.
    fn spans_stay(&self, old: &[(Around, [DVec3; 3])]) -> bool {
        self.star.iter().zip(old).filter(|(c, _)| !c.dies).all(|(c, own)| {
            let limit_squared = self.scale * self.scale / f64::from(self.faces[c.face as usize].omega);
            let near = |p: DVec3| {
                let is_near = |(around, corners): &(Around, [DVec3; 3])| {
                    around.squared_to(p) <= limit_squared
                        && (closest_on_triangle(p, corners) - p).length_squared() <= limit_squared
                };
                is_near(own) || old.iter().any(is_near)
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
