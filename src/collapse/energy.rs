//! The energy of a collapse: area-weighted, budget-weighted squared distance to planes.
//!
//! Planes of current faces all meet in their vertex, so about the vertex itself their form has no linear and no constant
//! part: a [`Form`] has six numbers where a [`Quadric`] has ten, and none of them is a small difference of large ones.
//! Only planes that are not current (the baselines') need a [`Quadric`].

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

/// Unit normal and area of a current face, in 16 bytes.
///
/// What goes into a vertex's form has to come out again when the face changes, to the bit. So both are computed from
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
        let Self { xx, xy, xz, yy, yz, zz, .. } = *self;
        start + Form { xx, xy, xz, yy, yz, zz }.least(self.times(start) + self.b, fixed)
    }
}

/// A quadratic form Σ w·(n·x)² about the place where the planes meet.
#[derive(Debug, Clone, Copy, Default)]
pub struct Form {
    xx: f64,
    xy: f64,
    xz: f64,
    yy: f64,
    yz: f64,
    zz: f64,
}

impl Form {
    /// The form of one plane n·x = 0 with weight `w`.
    pub fn of_plane(n: DVec3, w: f64) -> Self {
        let (wx, wy) = (w * n.x, w * n.y);
        Self { xx: wx * n.x, xy: wx * n.y, xz: wx * n.z, yy: wy * n.y, yz: wy * n.z, zz: w * n.z * n.z }
    }

    /// The form w·x².
    pub fn of_all(w: f64) -> Self {
        Self { xx: w, yy: w, zz: w, ..Self::default() }
    }

    /// Half its gradient at `x`.
    #[inline]
    pub fn times(&self, x: DVec3) -> DVec3 {
        DVec3::new(
            self.xx * x.x + self.xy * x.y + self.xz * x.z,
            self.xy * x.x + self.yy * x.y + self.yz * x.z,
            self.xz * x.x + self.yz * x.y + self.zz * x.z,
        )
    }

    /// The step y of least yᵀAy + 2g·y, a little shortened where A leaves it free; 0 along `fixed` axes.
    #[inline]
    pub fn least(&self, g: DVec3, fixed: [bool; 3]) -> DVec3 {
        let lambda = TIKHONOV * (self.xx + self.yy + self.zz) + f64::MIN_POSITIVE;
        let mut m = Self { xx: self.xx + lambda, yy: self.yy + lambda, zz: self.zz + lambda, ..*self };
        let mut r = -g;
        if fixed[0] {
            (m.xx, m.xy, m.xz, r.x) = (lambda, 0.0, 0.0, 0.0);
        }
        if fixed[1] {
            (m.yy, m.xy, m.yz, r.y) = (lambda, 0.0, 0.0, 0.0);
        }
        if fixed[2] {
            (m.zz, m.xz, m.yz, r.z) = (lambda, 0.0, 0.0, 0.0);
        }
        m.solve(r)
    }

    /// x with A·x = r, by the cofactors of a positive definite A; zero where it is singular all the same.
    fn solve(&self, r: DVec3) -> DVec3 {
        let Self { xx, xy, xz, yy, yz, zz } = *self;
        let cofactors = Self {
            xx: yy * zz - yz * yz,
            xy: xz * yz - xy * zz,
            xz: xy * yz - xz * yy,
            yy: xx * zz - xz * xz,
            yz: xy * xz - xx * yz,
            zz: xx * yy - xy * xy,
        };
        let det = xx * cofactors.xx + xy * cofactors.xy + xz * cofactors.xz;
        let x = cofactors.times(r) * det.recip();
        if x.is_finite() { x } else { DVec3::ZERO }
    }
}

impl std::ops::AddAssign for Form {
    fn add_assign(&mut self, o: Self) {
        self.xx += o.xx;
        self.xy += o.xy;
        self.xz += o.xz;
        self.yy += o.yy;
        self.yz += o.yz;
        self.zz += o.zz;
    }
}

impl std::ops::SubAssign for Form {
    fn sub_assign(&mut self, o: Self) {
        self.xx -= o.xx;
        self.xy -= o.xy;
        self.xz -= o.xz;
        self.yy -= o.yy;
        self.yz -= o.yz;
        self.zz -= o.zz;
    }
}

/// A [`Form`] in half the memory. What f32 rounds away is far below what holds a vertex along a plane.
#[derive(Debug, Clone, Copy, Default)]
pub struct SmallForm([f32; 6]);

impl SmallForm {
    /// Rounded.
    pub fn of(form: &Form) -> Self {
        Self([form.xx, form.xy, form.xz, form.yy, form.yz, form.zz].map(|x| x as f32))
    }

    /// To calculate with.
    pub fn form(&self) -> Form {
        let [xx, xy, xz, yy, yz, zz] = self.0.map(f64::from);
        Form { xx, xy, xz, yy, yz, zz }
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
