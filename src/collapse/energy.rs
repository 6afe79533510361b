//! The energy of a collapse: area-weighted, budget-weighted squared distance to the planes of current faces.

use glam::{DVec3, Vec3};

/// A quadratic form Σ w·(n·x + d)² in f64, about the block's own origin.
///
/// Garland and Heckbert, Surface Simplification Using Quadric Error Metrics, 1997, §5; memoryless as in Lindstrom and
/// Turk, Fast and Memory Efficient Polygonal Simplification, 1998: it is made anew from current faces, never summed
/// over history. Area weights (not squared areas) gave the lowest mean distance on noisy meshes.
#[derive(Debug, Clone, Copy, Default)]
pub struct Quadric {
    xx: f64,
    xy: f64,
    xz: f64,
    yy: f64,
    yz: f64,
    zz: f64,
    b: DVec3,
    c: f64,
}

/// Unit normal and area of a current face, in 16 bytes; its plane goes through its first corner.
///
/// What goes into a vertex's quadric has to come out again when the face changes, to the bit. So both are computed from
/// this, never from the corners.
#[derive(Debug, Clone, Copy, Default)]
pub struct Facet {
    /// Unit, zero where the area is.
    pub normal: Vec3,
    /// Square metres.
    pub area: f32,
}

impl Facet {
    /// Of a triangle.
    pub fn of([a, b, c]: [DVec3; 3]) -> Self {
        let cross = (b - a).cross(c - a);
        let length = cross.length();
        if length > 0.0 {
            Self { normal: (cross / length).as_vec3(), area: (0.5 * length) as f32 }
        } else {
            Self::default()
        }
    }

    /// Its plane's form with weight area · `omega`, when `corner` is its first corner.
    pub fn quadric(&self, corner: DVec3, omega: f64) -> Quadric {
        let n = self.normal.as_dvec3();
        Quadric::of_plane(n, -n.dot(corner), f64::from(self.area) * omega)
    }
}

/// Pulls the solution to the edge's middle where the planes leave it free, relative to the form's trace.
const TIKHONOV: f64 = 1e-6;

impl Quadric {
    /// The form of one plane n·x + d = 0 with weight `w`.
    pub fn of_plane(n: DVec3, d: f64, w: f64) -> Self {
        let (wx, wy) = (w * n.x, w * n.y);
        Self {
            xx: wx * n.x,
            xy: wx * n.y,
            xz: wx * n.z,
            yy: wy * n.y,
            yz: wy * n.z,
            zz: w * n.z * n.z,
            b: n * (w * d),
            c: w * d * d,
        }
    }

    /// The form at `p`, never negative.
    pub fn at(&self, p: DVec3) -> f64 {
        (p.dot(self.times(p)) + 2.0 * self.b.dot(p) + self.c).max(0.0)
    }

    fn times(&self, p: DVec3) -> DVec3 {
        DVec3::new(
            self.xx * p.x + self.xy * p.y + self.xz * p.z,
            self.xy * p.x + self.yy * p.y + self.yz * p.z,
            self.xz * p.x + self.yz * p.y + self.zz * p.z,
        )
    }

    /// The point of least energy near `start`; coordinates with a true `fixed` keep their value of `start`.
    pub fn least(&self, start: DVec3, fixed: [bool; 3]) -> DVec3 {
        let g = self.times(start) + self.b;
        let lambda = TIKHONOV * (self.xx + self.yy + self.zz) + f64::MIN_POSITIVE;
        let mut m = [
            [self.xx + lambda, self.xy, self.xz],
            [self.xy, self.yy + lambda, self.yz],
            [self.xz, self.yz, self.zz + lambda],
        ];
        let mut r = [-g.x, -g.y, -g.z];
        for k in (0..3).filter(|&k| fixed[k]) {
            m[k] = [0.0; 3];
            m.iter_mut().for_each(|row| row[k] = 0.0);
            (m[k][k], r[k]) = (lambda, 0.0);
        }
        start + solve(m, r)
    }
}

impl std::ops::SubAssign for Quadric {
    fn sub_assign(&mut self, o: Self) {
        self.xx -= o.xx;
        self.xy -= o.xy;
        self.xz -= o.xz;
        self.yy -= o.yy;
        self.yz -= o.yz;
        self.zz -= o.zz;
        self.b -= o.b;
        self.c -= o.c;
    }
}

impl std::ops::AddAssign for Quadric {
    fn add_assign(&mut self, o: Self) {
        self.xx += o.xx;
        self.xy += o.xy;
        self.xz += o.xz;
        self.yy += o.yy;
        self.yz += o.yz;
        self.zz += o.zz;
        self.b += o.b;
        self.c += o.c;
    }
}

/// Solves a symmetric positive definite 3×3 system by its cofactors; zero where it is singular all the same.
fn solve(m: [[f64; 3]; 3], r: [f64; 3]) -> DVec3 {
    let row = m.map(DVec3::from_array);
    let (c0, c1, c2) = (row[1].cross(row[2]), row[2].cross(row[0]), row[0].cross(row[1]));
    let det = row[0].dot(c0);
    let x = (c0 * r[0] + c1 * r[1] + c2 * r[2]) / det;
    if x.is_finite() { x } else { DVec3::ZERO }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_planes_meet_in_their_corner() {
        let mut q = Quadric::of_plane(DVec3::X, -1.0, 2.0);
        q += Quadric::of_plane(DVec3::Y, -2.0, 3.0);
        q += Quadric::of_plane(DVec3::Z, -3.0, 1.0);
        let p = q.least(DVec3::ZERO, [false; 3]);
        assert!((p - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-4, "{p}");
        assert!(q.at(p) < 1e-8);
    }

    #[test]
    fn a_flat_star_keeps_the_start() {
        let q = Quadric::of_plane(DVec3::Z, 0.0, 5.0);
        let p = q.least(DVec3::new(3.0, 4.0, 1.0), [false; 3]);
        assert!((p - DVec3::new(3.0, 4.0, 0.0)).length() < 1e-5, "{p}");
    }

    #[test]
    fn a_fixed_coordinate_does_not_move() {
        let mut q = Quadric::of_plane(DVec3::X, -1.0, 1.0);
        q += Quadric::of_plane(DVec3::new(0.6, 0.0, 0.8), 0.0, 1.0);
        let p = q.least(DVec3::new(7.0, 0.0, 0.0), [true, false, false]);
        assert_eq!(p.x, 7.0);
        assert!((p.z + 5.25).abs() < 1e-4, "{p}");
    }
}
