//! A convex part of a triangle, and how it is cut so that its parts come to lie over one other triangle each.

use glam::DVec3;

/// A part with more corners is halved from corner to corner.
const MOST_CORNERS: usize = 8;
/// A cut must leave this share of the part's radius on either side, else the part is cut through its middle.
const LEAST_CUT: f64 = 0.05;

/// Corners in order, in one plane.
#[derive(Clone, Copy)]
pub struct Convex {
    corners: [DVec3; MOST_CORNERS],
    count: u8,
}

impl From<[DVec3; 3]> for Convex {
    fn from(triangle: [DVec3; 3]) -> Self {
        let mut corners = [DVec3::ZERO; MOST_CORNERS];
        corners[..3].copy_from_slice(&triangle);
        Self { corners, count: 3 }
    }
}

impl Convex {
    /// In order around it.
    pub fn corners(&self) -> &[DVec3] {
        &self.corners[..usize::from(self.count)]
    }

    /// The mean of the corners, and how far the furthest is from it.
    pub fn ball(&self) -> (DVec3, f64) {
        let middle = self.corners().iter().sum::<DVec3>() / f64::from(self.count);
        (middle, self.corners().iter().map(|p| (p - middle).length_squared()).fold(0.0, f64::max).sqrt())
    }

    /// Cuts upright to triangle `over`, along the edge of it that divides the part best; through the part's middle where
    /// none does. The middle and radius are those of [`Convex::ball`].
    pub fn cut(&self, over: [DVec3; 3], middle: DVec3, radius: f64) -> [Self; 2] {
        if usize::from(self.count) == MOST_CORNERS {
            return self.halves();
        }
        let normal = (over[1] - over[0]).cross(over[2] - over[0]);
        let mut best = (LEAST_CUT * radius, None);
        for k in 0..3 {
            let (a, b) = (over[k], over[(k + 1) % 3]);
            let outwards = (b - a).cross(normal).normalize_or_zero();
            let sides = self.corners().iter().map(|p| outwards.dot(p - a));
            let (least, most) = sides.fold((0.0f64, 0.0f64), |(l, m), s| (l.min(s), m.max(s)));
            let smaller = most.min(-least);
            if smaller > best.0 {
                best = (smaller, Some((a, outwards)));
            }
        }
        let (a, outwards) = best.1.unwrap_or_else(|| {
            let far = self
                .corners()
                .iter()
                .max_by(|p, q| (*p - middle).length_squared().total_cmp(&(*q - middle).length_squared()));
            (middle, far.map_or(DVec3::X, |p| p - middle))
        });
        match (self.side(a, outwards), self.side(a, -outwards)) {
            (Some(one), Some(other)) => [one, other],
            // Corners all but in the plane may lie on either side in turn.
            _ => self.halves(),
        }
    }

    /// What lies behind the plane through `a`, unless it has too many corners.
    fn side(&self, a: DVec3, outwards: DVec3) -> Option<Self> {
        let mut kept = Self { count: 0, ..*self };
        let corners = self.corners();
        for (i, &p) in corners.iter().enumerate() {
            let q = corners[(i + 1) % corners.len()];
            let (s, t) = (outwards.dot(p - a), outwards.dot(q - a));
            if s <= 0.0 {
                kept.push(p)?;
            }
            if (s < 0.0 && t > 0.0) || (s > 0.0 && t < 0.0) {
                kept.push(p + (q - p) * (s / (s - t)))?;
            }
        }
        Some(kept)
    }

    fn push(&mut self, p: DVec3) -> Option<()> {
        *self.corners.get_mut(usize::from(self.count))? = p;
        self.count += 1;
        Some(())
    }

    /// Cut from corner to corner: neither half has as many. Parts of three corners never get here: cut by a plane they
    /// give at most five.
    fn halves(&self) -> [Self; 2] {
        let half = usize::from(self.count) / 2;
        let mut other = Self { count: self.count - half as u8 + 1, ..*self };
        other.corners[..usize::from(self.count) - half].copy_from_slice(&self.corners()[half..]);
        other.corners[usize::from(self.count) - half] = self.corners[0];
        [Self { count: half as u8 + 1, ..*self }, other]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn area(part: &Convex) -> f64 {
        let c = part.corners();
        (1..c.len() - 1).map(|k| (c[k] - c[0]).cross(c[k + 1] - c[0]).length() * 0.5).sum()
    }

    #[test]
    fn parts_have_the_area_of_the_whole_and_shrink() {
        let whole = [DVec3::ZERO, DVec3::new(3.0, 0.0, 0.2), DVec3::new(0.5, 2.0, -0.1)];
        let over = [DVec3::new(0.3, 0.2, 0.5), DVec3::new(1.4, 0.3, 0.5), DVec3::new(0.7, 0.9, 0.4)];
        let mut parts = vec![Convex::from(whole)];
        let (total, radius) = (area(&parts[0]), parts[0].ball().1);
        for _ in 0..12 {
            parts = parts
                .iter()
                .flat_map(|p| {
                    let (middle, radius) = p.ball();
                    p.cut(over, middle, radius)
                })
                .collect();
            let sum: f64 = parts.iter().map(area).sum();
            assert!((sum - total).abs() < 1e-9 * total, "{sum} for {total}");
        }
        assert!(parts.iter().all(|p| p.ball().1 < 0.2 * radius));
    }
}
