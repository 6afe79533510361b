//! Visits the texels of a triangle: those whose centre is inside, or all that are touched.

use glam::DVec2;

/// Below this the triangle is a line, texels².
const MIN_AREA2_PX: f64 = 1e-12;

/// The whole number at or below `x`: without SSE 4.1, which not every machine has, the standard one is a call, and
/// took 3 % of a build. Numbers too large to have a fraction saturate, and NaN is 0.
pub(super) fn floor(x: f64) -> i64 {
    let whole = x as i64;
    whole.saturating_sub(i64::from((whole as f64) > x))
}

/// The whole number at or above `x`; see [`floor`].
pub(super) fn ceil(x: f64) -> i64 {
    let whole = x as i64;
    whole.saturating_add(i64::from((whole as f64) < x))
}

/// Calls `row(y, x0, x1)` for the spans (x1 exclusive) of texels of a `size` window whose centres lie inside `tri`.
///
/// `grow` moves the edges outwards by that many texels, so that a centre on an edge is never lost to rounding.
pub(super) fn centers(tri: [DVec2; 3], grow: f64, size: [u32; 2], mut row: impl FnMut(u32, u32, u32)) {
    let area2 = (tri[1] - tri[0]).perp_dot(tri[2] - tri[0]);
    // Written so that NaN returns, too.
    if !(area2.abs() > MIN_AREA2_PX && area2.is_finite()) {
        return;
    }
    let low = tri[0].y.min(tri[1].y).min(tri[2].y) - grow.max(0.0);
    let high = tri[0].y.max(tri[1].y).max(tri[2].y) + grow.max(0.0);
    let y0 = ceil(low - 0.5).max(0);
    let y1 = floor(high - 0.5).saturating_add(1).min(size[1].into());
    if y0 >= y1 {
        return;
    }
    let sign = area2.signum();
    // Inside is a·x + b·y + c >= 0; one division an edge, not one a row.
    let edge = |p: DVec2, q: DVec2| {
        let (a, b) = ((p.y - q.y) * sign, (q.x - p.x) * sign);
        [a, b, grow * (a.abs() + b.abs()) - a * p.x - b * p.y, -1.0 / a]
    };
    let edges = [edge(tri[0], tri[1]), edge(tri[1], tri[2]), edge(tri[2], tri[0])];
    'rows: for y in y0..y1 {
        let (mut x0, mut x1) = (0i64, i64::from(size[0]));
        for [a, b, c, over] in edges {
            let rest = b * (y as f64 + 0.5) + c;
            if a > 0.0 {
                x0 = x0.max(ceil(rest * over - 0.5));
            } else if a < 0.0 {
                x1 = x1.min(floor(rest * over - 0.5).saturating_add(1));
            } else if rest < 0.0 {
                continue 'rows;
            }
        }
        if x0 < x1 {
            row(y as u32, x0 as u32, x1 as u32);
        }
    }
}

/// Calls `row(y, x0, x1)` for the spans (x1 exclusive) of all texels `tri` touches, however slightly.
pub(super) fn touched(tri: [DVec2; 3], mut row: impl FnMut(i64, i64, i64)) {
    // UVs are f32: at 16384 texels a side they are good to about 1/1000 texel.
    const SLACK_PX: f64 = 1e-3;
    if !tri.iter().all(|p| p.is_finite()) {
        return;
    }
    let low = tri[0].y.min(tri[1].y).min(tri[2].y) - SLACK_PX;
    let high = tri[0].y.max(tri[1].y).max(tri[2].y) + SLACK_PX;
    let (first, last) = (floor(low), floor(high));
    if first == last {
        let (x0, x1) = (tri[0].x.min(tri[1].x).min(tri[2].x), tri[0].x.max(tri[1].x).max(tri[2].x));
        return row(first, floor(x0 - SLACK_PX), floor(x1 + SLACK_PX) + 1);
    }
    // Downwards, with what x gains a row.
    let edge = |p: DVec2, q: DVec2| {
        let (p, q) = if p.y <= q.y { (p, q) } else { (q, p) };
        (p, q, if q.y > p.y { (q.x - p.x) / (q.y - p.y) } else { 0.0 })
    };
    let edges = [edge(tri[0], tri[1]), edge(tri[1], tri[2]), edge(tri[2], tri[0])];
    for y in first..=last {
        let (top, bottom) = (y as f64 - SLACK_PX, y as f64 + 1.0 + SLACK_PX);
        let (mut x0, mut x1) = (f64::INFINITY, f64::NEG_INFINITY);
        for (p, q, slope) in edges {
            if q.y < top || p.y > bottom {
                continue;
            }
            let at = |y: f64| p.x + slope * (y - p.y);
            let upper = if p.y < top { at(top) } else { p.x };
            let lower = if q.y > bottom { at(bottom) } else { q.x };
            x0 = x0.min(upper).min(lower);
            x1 = x1.max(upper).max(lower);
        }
        if x0 <= x1 {
            row(y, floor(x0 - SLACK_PX), floor(x1 + SLACK_PX) + 1);
        }
    }
}

/// The barycentric weights of corners 1 and 2 as affine functions of the place.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Barycentric {
    origin: DVec2,
    first: DVec2,
    second: DVec2,
}

impl Barycentric {
    /// Of a triangle; one without area gives all weight to corner 0.
    pub fn of(tri: [DVec2; 3]) -> Self {
        let (u, v) = (tri[1] - tri[0], tri[2] - tri[0]);
        let area2 = u.perp_dot(v);
        if area2.abs() <= MIN_AREA2_PX {
            return Self { origin: tri[0], ..Self::default() };
        }
        Self { origin: tri[0], first: DVec2::new(v.y, -v.x) / area2, second: DVec2::new(-u.y, u.x) / area2 }
    }

    /// Weights at `p`; outside the triangle some are negative.
    pub fn at(&self, p: DVec2) -> [f64; 3] {
        let d = p - self.origin;
        let (first, second) = (self.first.dot(d), self.second.dot(d));
        [1.0 - first - second, first, second]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn weights(tri: [DVec2; 3], p: DVec2) -> [f64; 3] {
        Barycentric::of(tri).at(p)
    }

    proptest! {
        #[test]
        fn centers_are_those_with_positive_weights(c in prop::array::uniform6(-3.0..19.0_f64)) {
            let tri = [DVec2::new(c[0], c[1]), DVec2::new(c[2], c[3]), DVec2::new(c[4], c[5])];
            prop_assume!((tri[1] - tri[0]).perp_dot(tri[2] - tri[0]).abs() > 1e-3);
            let mut hit = [[false; 16]; 16];
            centers(tri, 0.0, [16, 16], |y, x0, x1| (x0..x1).for_each(|x| hit[y as usize][x as usize] = true));
            for (y, row) in hit.iter().enumerate() {
                for (x, &hit) in row.iter().enumerate() {
                    let least = weights(tri, DVec2::new(x as f64 + 0.5, y as f64 + 0.5)).into_iter().fold(1.0, f64::min);
                    if least.abs() > 1e-9 {
                        prop_assert_eq!(hit, least > 0.0);
                    }
                }
            }
        }

        #[test]
        fn touched_misses_no_point_of_the_triangle(c in prop::array::uniform6(-3.0..19.0_f64), s in 0.0..1.0_f64, t in 0.0..1.0_f64) {
            let tri = [DVec2::new(c[0], c[1]), DVec2::new(c[2], c[3]), DVec2::new(c[4], c[5])];
            let (s, t) = if s + t > 1.0 { (1.0 - s, 1.0 - t) } else { (s, t) };
            let p = tri[0] + (tri[1] - tri[0]) * s + (tri[2] - tri[0]) * t;
            let mut found = false;
            touched(tri, |y, x0, x1| found |= y == p.y.floor() as i64 && (x0..x1).contains(&(p.x.floor() as i64)));
            prop_assert!(found);
        }
    }

    #[test]
    fn two_triangles_of_a_square_leave_no_center_out() {
        let [a, b, c, d] = [(0.5, 0.5), (7.5, 0.5), (7.5, 7.5), (0.5, 7.5)].map(|(x, y)| DVec2::new(x, y));
        let mut count = [[0; 8]; 8];
        for tri in [[a, b, c], [a, c, d]] {
            centers(tri, 1e-7, [8, 8], |y, x0, x1| (x0..x1).for_each(|x| count[y as usize][x as usize] += 1));
        }
        assert!(count.iter().flatten().all(|&n| n >= 1));
    }
}
