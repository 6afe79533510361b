//! Cuts one polygon in space into triangles.
//!
//! In: corners in order. Out: triangles of corner numbers, in the polygon's sense of rotation, and whether the
//! polygon was sound.
//! # Method
//!  1. Triangles and convex quads are answered at once.
//!  2. Newell's normal gives the best plane; corners are projected onto it.
//!  3. A polygon that is convex is fanned.
//!  4. Otherwise ears are clipped: first only those whose closed triangle holds no other corner, so that corners on
//!     an edge stay corners of proper triangles; then those with none strictly inside; then, for a polygon that
//!     crosses itself, any.
//! # Promises
//! Always ends, with at most n - 2 triangles, after at most `STEPS_PER_CORNER` × n steps.
//! # References
//! Meisters, Polygons have ears, 1975; Sutherland, Sproull, Schumacker, 1974 (Newell's normal).

use glam::{DVec2, DVec3};

/// Ear tests allowed per corner: enough for every simple polygon of some 4000 corners.
const STEPS_PER_CORNER: u64 = 4096;
/// The most ear tests for one polygon: about a second for a hostile line of half a million corners.
const STEPS_LIMIT: u64 = 1 << 26;
/// Areas below this part of the polygon's squared extent count as zero: some 1000 times f64's rounding.
const FLAT: f64 = 1e-12;
/// Relative difference between the polygon's area and its triangles' that betrays a polygon crossing itself.
const AREA_SLACK: f64 = 1e-6;

/// Triangulates polygons; keeps its buffers between calls.
#[derive(Debug, Default)]
pub struct Triangulator {
    points: Vec<DVec2>,
    next: Vec<u32>,
    previous: Vec<u32>,
    flat: f64,
    steps_left: u64,
}

#[derive(Clone, Copy, PartialEq)]
enum Ear {
    Clean,
    Touched,
    Any,
}

impl Triangulator {
    /// Appends the triangles of `corners` to `triangles`.
    ///
    /// Returns false if the polygon crosses itself or has no area; it is then covered as well as may be.
    pub fn cut(&mut self, corners: &[DVec3], triangles: &mut Vec<[u32; 3]>) -> bool {
        match corners.len() {
            0..3 => return true,
            3 => {
                triangles.push([0, 1, 2]);
                return true;
            }
            4 => {
                if let Some(pair) = cut_quad(corners) {
                    triangles.extend(pair);
                    return true;
                }
            }
            _ => {}
        }
        if !self.project(corners) {
            triangles.extend(fan(corners.len()));
            return false;
        }
        if self.is_convex() {
            triangles.extend(fan(corners.len()));
            return true;
        }
        let before = triangles.len();
        self.clip(triangles);
        self.is_covered(&triangles[before..])
    }

    /// Onto the best plane, counter-clockwise. False if there is none.
    fn project(&mut self, corners: &[DVec3]) -> bool {
        // Relative to a corner, so that map coordinates lose nothing in the products.
        let origin = corners[0];
        let pairs = corners.iter().zip(corners.iter().cycle().skip(1));
        let normal: DVec3 = pairs.map(|(&a, &b)| (a - origin).cross(b - origin)).sum();
        let extent = corners.iter().map(|&c| (c - origin).abs().max_element()).fold(0.0, f64::max);
        self.flat = FLAT * extent * extent;
        let length = normal.length();
        if !length.is_finite() || !self.flat.is_finite() || length <= self.flat {
            return false;
        }
        let (u, v) = (normal / length).any_orthonormal_pair();
        self.points.clear();
        self.points.extend(corners.iter().map(|&c| DVec2::new((c - origin).dot(u), (c - origin).dot(v))));
        true
    }

    fn twice_area(&self, a: u32, b: u32, c: u32) -> f64 {
        let [a, b, c] = [a, b, c].map(|i| self.points[i as usize]);
        (b - a).perp_dot(c - a)
    }

    fn is_convex(&self) -> bool {
        let n = self.points.len() as u32;
        // Every corner turns left, and so does every triangle of the fan: the second fails for a star.
        (0..n).all(|i| self.twice_area(i, (i + 1) % n, (i + 2) % n) >= -self.flat)
            && (1..n - 1).all(|i| self.twice_area(0, i, i + 1) > self.flat)
    }

    fn clip(&mut self, triangles: &mut Vec<[u32; 3]>) {
        let n = self.points.len() as u32;
        self.next.clear();
        self.next.extend((1..n).chain([0]));
        self.previous.clear();
        self.previous.extend([n - 1].into_iter().chain(0..n - 1));
        self.steps_left = STEPS_LIMIT.min(STEPS_PER_CORNER * u64::from(n));
        let (mut left, mut here, mut failed, mut rule) = (n, 0, 0, Ear::Clean);
        while left > 3 {
            let (before, after) = (self.previous[here as usize], self.next[here as usize]);
            if self.is_ear(here, rule) {
                self.emit([before, here, after], triangles);
                self.next[before as usize] = after;
                self.previous[after as usize] = before;
                (left, here, failed, rule) = (left - 1, after, 0, Ear::Clean);
                continue;
            }
            (here, failed) = (after, failed + 1);
            if failed >= left || self.steps_left == 0 {
                failed = 0;
                rule = if rule == Ear::Clean && self.steps_left > 0 { Ear::Touched } else { Ear::Any };
            }
        }
        self.emit([self.previous[here as usize], here, self.next[here as usize]], triangles);
    }

    /// Triangles with two corners in one place are left out; nothing hangs on them.
    fn emit(&self, triangle: [u32; 3], triangles: &mut Vec<[u32; 3]>) {
        let [a, b, c] = triangle.map(|i| self.points[i as usize]);
        if a != b && b != c && c != a {
            triangles.push(triangle);
        }
    }

    fn is_ear(&mut self, here: u32, rule: Ear) -> bool {
        let (before, after) = (self.previous[here as usize], self.next[here as usize]);
        let [a, b, c] = [before, here, after].map(|i| self.points[i as usize]);
        // A doubled corner covers nothing: away with it.
        if rule == Ear::Any || a == b || b == c {
            return true;
        }
        if (b - a).perp_dot(c - a) <= self.flat {
            return false;
        }
        let margin = if rule == Ear::Clean { -self.flat } else { self.flat };
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let mut other = self.next[after as usize];
        while other != before {
            let p = self.points[other as usize];
            self.steps_left = self.steps_left.saturating_sub(1);
            let near = p.cmpge(low).all() && p.cmple(high).all() && p != a && p != b && p != c;
            if near && [(a, b), (b, c), (c, a)].iter().all(|&(s, t)| (t - s).perp_dot(p - s) > margin) {
                return false;
            }
            other = self.next[other as usize];
        }
        true
    }

    fn is_covered(&self, triangles: &[[u32; 3]]) -> bool {
        let n = self.points.len() as u32;
        let whole: f64 = (1..n - 1).map(|i| self.twice_area(0, i, i + 1)).sum();
        let parts: f64 = triangles.iter().map(|&[a, b, c]| self.twice_area(a, b, c).abs()).sum();
        (whole - parts).abs() <= AREA_SLACK * whole + self.flat
    }
}

fn fan(n: usize) -> impl Iterator<Item = [u32; 3]> {
    (1..n as u32 - 1).map(|i| [0, i, i + 1])
}

/// The diagonal both of whose triangles face the quad's way; `None` if neither does.
fn cut_quad(corners: &[DVec3]) -> Option<[[u32; 3]; 2]> {
    let [a, b, c, d] = corners.try_into().ok()?;
    let normal = (c - a).cross(d - b);
    let limit = FLAT * normal.length_squared();
    let faces = |p: DVec3, q: DVec3, r: DVec3| (q - p).cross(r - p).dot(normal) > limit;
    if faces(a, b, c) && faces(a, c, d) {
        Some([[0, 1, 2], [0, 2, 3]])
    } else if faces(b, c, d) && faces(b, d, a) {
        Some([[1, 2, 3], [1, 3, 0]])
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn flat(points: &[(f64, f64)]) -> Vec<DVec3> {
        points.iter().map(|&(x, y)| DVec3::new(x, y, 0.0)).collect()
    }

    fn cut(corners: &[DVec3]) -> (bool, Vec<[u32; 3]>) {
        let mut triangles = Vec::new();
        let sound = Triangulator::default().cut(corners, &mut triangles);
        (sound, triangles)
    }

    fn area_z(corners: &[DVec3], [a, b, c]: [u32; 3]) -> f64 {
        let [a, b, c] = [a, b, c].map(|i| corners[i as usize]);
        (b - a).cross(c - a).z / 2.0
    }

    /// All triangles face up, none is flat, and together they have the polygon's area.
    fn assert_tiles(corners: &[DVec3], area: f64, count: usize) {
        let (sound, triangles) = cut(corners);
        assert!(sound);
        assert_eq!(triangles.len(), count, "{triangles:?}");
        assert!(triangles.iter().all(|&t| area_z(corners, t) > 1e-9), "{triangles:?}");
        let sum: f64 = triangles.iter().map(|&t| area_z(corners, t)).sum();
        assert!((sum - area).abs() < 1e-9, "{sum} is not {area}");
    }

    #[test]
    fn a_convex_quad_is_fanned_and_a_concave_one_cut_at_its_dent() {
        assert_eq!(cut(&flat(&[(0., 0.), (2., 0.), (2., 2.), (0., 2.)])).1, [[0, 1, 2], [0, 2, 3]]);
        for turn in 0..4 {
            let mut arrow = flat(&[(0., 0.), (4., 0.), (1., 1.), (0., 4.)]);
            arrow.rotate_left(turn);
            assert_tiles(&arrow, 4.0, 2);
        }
    }

    #[test]
    fn an_l_and_a_comb_are_tiled_exactly_from_any_first_corner() {
        let l = flat(&[(0., 0.), (3., 0.), (3., 1.), (1., 1.), (1., 3.), (0., 3.)]);
        let comb = flat(&[(0., 0.), (5., 0.), (5., 3.), (4., 1.), (3., 3.), (2., 1.), (1., 3.), (0., 1.)]);
        for (shape, area) in [(l, 5.0), (comb, 10.0)] {
            for turn in 0..shape.len() {
                let mut turned = shape.clone();
                turned.rotate_left(turn);
                assert_tiles(&turned, area, shape.len() - 2);
            }
        }
    }

    #[test]
    fn corners_on_an_edge_stay_corners_of_proper_triangles() {
        let square = flat(&[(0., 0.), (1., 0.), (2., 0.), (2., 1.), (2., 2.), (1., 2.), (0., 2.), (0., 1.)]);
        assert_tiles(&square, 4.0, 6);
        assert_tiles(&flat(&[(0., 0.), (1., 0.), (2., 0.), (0., 2.)]), 2.0, 2);
    }

    #[test]
    fn a_hole_on_a_bridge_stays_a_hole() {
        let ring =
            flat(&[(0., 0.), (4., 0.), (4., 4.), (0., 4.), (0., 0.), (1., 1.), (1., 3.), (3., 3.), (3., 1.), (1., 1.)]);
        assert_tiles(&ring, 12.0, 8);
    }

    #[test]
    fn a_standing_wall_far_from_the_origin_is_cut_in_its_own_plane() {
        let corners: Vec<DVec3> = [(0., 0.), (3., 0.), (3., 1.), (1., 1.), (1., 3.), (0., 3.)]
            .iter()
            .map(|&(x, z)| DVec3::new(500_000.0 + 0.6 * x, 5_000_000.0 + 0.8 * x, z))
            .collect();
        let (sound, triangles) = cut(&corners);
        assert!(sound);
        let area = |t: [u32; 3]| {
            let [a, b, c] = t.map(|i| corners[i as usize]);
            (b - a).cross(c - a).dot(DVec3::new(0.8, -0.6, 0.0)) / 2.0
        };
        assert!(triangles.iter().all(|&t| area(t) > 0.1));
        assert!((triangles.iter().map(|&t| area(t)).sum::<f64>() - 5.0).abs() < 1e-6);
    }

    #[test]
    fn crossing_and_flat_polygons_are_told_apart_from_sound_ones() {
        assert!(!cut(&flat(&[(0., 0.), (2., 2.), (2., 0.), (0., 2.)])).0, "bow tie");
        let star: Vec<_> = (0..5).map(|i| (f64::from(i) * 144f64.to_radians()).sin_cos()).collect();
        assert!(!cut(&flat(&star)).0, "star");
        assert!(!cut(&flat(&[(0., 0.), (1., 0.), (2., 0.), (3., 0.)])).0, "line");
        assert!(!cut(&[DVec3::ONE; 6]).0, "point");
        assert!(!cut(&flat(&[(0., 0.), (1e300, 0.), (1e300, 1e300), (0., 1e300), (-1., 1.)])).0, "overflow");
    }

    #[test]
    fn doubled_corners_do_no_harm() {
        assert_tiles(&flat(&[(0., 0.), (2., 0.), (2., 0.), (2., 2.), (0., 2.), (0., 0.)]), 4.0, 2);
    }

    #[test]
    fn a_spiral_of_a_hundred_thousand_corners_is_cut() {
        let arm = |r: f64| {
            (0..50_000).map(move |i| (f64::from(i) * 0.01, r)).map(|(t, r)| ((t + r) * t.cos(), (t + r) * t.sin()))
        };
        let mut corners: Vec<_> = arm(1.0).collect();
        corners.extend(arm(2.0).collect::<Vec<_>>().into_iter().rev());
        // Cutting ears one by one would take an hour.
        assert_eq!(cut(&flat(&corners)).1.len(), corners.len() - 2);
    }

    proptest! {
        #[test]
        fn any_corners_at_all_end_in_valid_triangles(points in prop::collection::vec((-3i8..3, -3i8..3, -1i8..1), 0..24)) {
            let corners: Vec<_> = points.iter().map(|&(x, y, z)| DVec3::new(x.into(), y.into(), z.into())).collect();
            let (_, triangles) = cut(&corners);
            prop_assert!(triangles.len() <= corners.len().saturating_sub(2));
            prop_assert!(triangles.iter().flatten().all(|&i| (i as usize) < corners.len()));
        }

        #[test]
        fn a_star_shaped_polygon_is_tiled_exactly(radii in prop::collection::vec(0.2f64..5.0, 5..40)) {
            let step = std::f64::consts::TAU / radii.len() as f64;
            let corners: Vec<_> = radii.iter().enumerate()
                .map(|(i, r)| DVec3::new(r * (i as f64 * step).cos(), r * (i as f64 * step).sin(), 7.0)).collect();
            let n = corners.len();
            let area: f64 = (0..n).map(|i| corners[i].truncate().perp_dot(corners[(i + 1) % n].truncate()) / 2.0).sum();
            let (sound, triangles) = cut(&corners);
            prop_assert!(sound);
            prop_assert_eq!(triangles.len(), n - 2);
            let sum: f64 = triangles.iter().map(|&t| area_z(&corners, t)).sum();
            prop_assert!((sum - area).abs() < 1e-9 * area.max(1.0));
            prop_assert!(triangles.iter().all(|&t| area_z(&corners, t) > 0.0));
        }
    }
}
