//! Least-squares planes from the exact moments of triangles.

use glam::DVec3;

use crate::geo::eigen::eigen;

/// Area, first and second moments of a piece of surface about a fixed local origin (metres).
#[derive(Debug, Clone, Copy, Default)]
pub struct Moments {
    /// Area, m².
    pub area: f64,
    /// ∫ x dA.
    first: DVec3,
    /// ∫ xxᵀ dA: xx, yy, zz, xy, xz, yz.
    second: [f64; 6],
    /// Σ of area normals, only to orient the plane.
    pub facing: DVec3,
}

/// A fitted plane; see [`Moments::plane`].
#[derive(Debug, Clone, Copy)]
pub struct Plane {
    /// Unit normal, facing as the triangles do.
    pub normal: DVec3,
    /// Centroid, relative to the origin of the moments.
    pub centroid: DVec3,
    /// Root mean square distance of the surface to the plane, metres.
    pub rms_m: f64,
}

impl Moments {
    /// Adds a triangle given relative to the origin. Exact: ∫xxᵀ = A/12 (Σvvᵀ + ssᵀ) with s = Σv.
    pub fn add(&mut self, triangle: [DVec3; 3]) {
        self.add_times(triangle, 1.0);
    }

    /// Takes a triangle out again; what rounding leaves is far below any tolerance.
    pub fn remove(&mut self, triangle: [DVec3; 3]) {
        self.add_times(triangle, -1.0);
    }

    fn add_times(&mut self, [a, b, c]: [DVec3; 3], sign: f64) {
        let half = (0.5 * sign) * (b - a).cross(c - a);
        let area = sign * half.length();
        let sum = a + b + c;
        self.area += area;
        self.first += sum * (area / 3.0);
        self.facing += half;
        let product = |v: DVec3| [v.x * v.x, v.y * v.y, v.z * v.z, v.x * v.y, v.x * v.z, v.y * v.z];
        let (pa, pb, pc, ps) = (product(a), product(b), product(c), product(sum));
        for i in 0..6 {
            self.second[i] += area / 12.0 * (pa[i] + pb[i] + pc[i] + ps[i]);
        }
    }

    /// Centroid relative to the origin; the origin if there is no area.
    pub fn centroid(&self) -> DVec3 {
        if self.area > 0.0 { self.first / self.area } else { DVec3::ZERO }
    }

    /// The same surface seen from another origin: `shift` is the old origin relative to the new one.
    pub fn moved(&self, shift: DVec3) -> Self {
        let Self { area, first: m, second: s, facing } = *self;
        let (d, first) = (shift, m + shift * area);
        let cross = |i: usize, j: usize| m[i] * d[j] + d[i] * m[j] + area * d[i] * d[j];
        let second = [
            s[0] + cross(0, 0),
            s[1] + cross(1, 1),
            s[2] + cross(2, 2),
            s[3] + cross(0, 1),
            s[4] + cross(0, 2),
            s[5] + cross(1, 2),
        ];
        Self { area, first, second, facing }
    }

    /// Both surfaces together; origins must agree.
    pub fn joined(&self, other: &Self) -> Self {
        let mut second = self.second;
        second.iter_mut().zip(other.second).for_each(|(a, b)| *a += b);
        Self {
            area: self.area + other.area,
            first: self.first + other.first,
            second,
            facing: self.facing + other.facing,
        }
    }

    /// The least-squares plane. Degenerate surfaces get the mean facing, or up.
    pub fn plane(&self) -> Plane {
        if self.area <= 0.0 {
            return Plane { normal: DVec3::Z, centroid: DVec3::ZERO, rms_m: 0.0 };
        }
        let centroid = self.first / self.area;
        let c = centroid;
        let outer = [c.x * c.x, c.y * c.y, c.z * c.z, c.x * c.y, c.x * c.z, c.y * c.z];
        let mut covariance = [0.0; 6];
        for i in 0..6 {
            covariance[i] = self.second[i] / self.area - outer[i];
        }
        let ([value, ..], vector) = eigen(covariance);
        let normal = if vector.dot(self.facing) < 0.0 { -vector } else { vector };
        Plane { normal, centroid, rms_m: value.max(0.0).sqrt() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tilted_square_gives_its_plane_back() {
        let normal = DVec3::new(1.0, 2.0, 5.0).normalize();
        let (u, w) = normal.any_orthonormal_pair();
        let at = |x: f64, y: f64| u * x + w * y + normal * 7.0;
        let mut moments = Moments::default();
        moments.add([at(0.0, 0.0), at(4.0, 0.0), at(4.0, 3.0)]);
        moments.add([at(0.0, 0.0), at(4.0, 3.0), at(0.0, 3.0)]);
        let plane = moments.plane();
        assert!((moments.area - 12.0).abs() < 1e-9);
        assert!((plane.normal.dot(moments.facing.normalize()) - 1.0).abs() < 1e-9);
        assert!((plane.normal.dot(normal).abs() - 1.0).abs() < 1e-9);
        assert!(plane.rms_m < 1e-6);
        assert!(plane.centroid.distance(at(2.0, 1.5)) < 1e-9);
    }

    #[test]
    fn moving_the_origin_and_joining_changes_nothing_else() {
        let triangle = [DVec3::new(1.0, 0.0, 2.0), DVec3::new(4.0, 1.0, 2.5), DVec3::new(2.0, 3.0, 1.0)];
        let other = [DVec3::new(4.0, 1.0, 2.5), DVec3::new(6.0, 3.0, 2.0), DVec3::new(2.0, 3.0, 1.0)];
        let shift = DVec3::new(10.0, -20.0, 5.0);
        let (mut near, mut a, mut b) = (Moments::default(), Moments::default(), Moments::default());
        near.add(triangle);
        near.add(other);
        a.add(triangle);
        b.add(other.map(|v| v - shift));
        let (want, got) = (near.plane(), a.joined(&b.moved(shift)).plane());
        assert!(want.centroid.distance(got.centroid) < 1e-9);
        assert!((want.rms_m - got.rms_m).abs() < 1e-9);
        assert!(want.rms_m > 0.01);
    }
}
