//! Bounding volumes: how far something is outside of one, metres.

use std::f64::consts::TAU;

use glam::{DMat3, DMat4, DVec3};

use super::json::BoundingVolume;
use super::refusal::{Refusal, refuse};
use crate::geo::Geodetic;
use crate::geo::ellipsoid::{A_M, ecef_from_geodetic, geodetic_from_ecef};

/// A tile's bounding volume in the root frame of the tileset (ECEF where that is on the globe), metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Volume {
    /// A centre and three half axes, after the tile's transform; skewed if that skews.
    Box {
        /// Centre.
        centre: DVec3,
        /// Half axes.
        half: [DVec3; 3],
    },
    /// A ball.
    Sphere {
        /// Centre.
        centre: DVec3,
        /// Radius, metres.
        radius_m: f64,
    },
    /// A part of the WGS 84 globe; transforms do not move it.
    Region {
        /// West, south, east, north, radians; lowest and highest height, metres. East is at least west.
        bounds: [f64; 6],
    },
}

/// Points along an edge of a region at which it is looked at; between them it bulges little.
const REGION_STEPS: usize = 4;

impl Volume {
    /// The volume of a tile, or `None` for kinds that are not read (S2 cells).
    pub(super) fn of(wire: &BoundingVolume, root_from_tile: &DMat4) -> Result<Option<Self>, Refusal> {
        let bad = |what: String| Refusal::new("bad-volume", what);
        if let Some(b) = &wire.oriented_box {
            let b: &[f64; 12] =
                b.as_slice().try_into().map_err(|_| bad(format!("a box has {} numbers, not 12", b.len())))?;
            let at = |i: usize| DVec3::new(b[i], b[i + 1], b[i + 2]);
            return Self::Box { centre: at(0), half: [at(3), at(6), at(9)] }.moved(root_from_tile).finite();
        }
        if let Some(r) = &wire.region {
            let r: &[f64; 6] =
                r.as_slice().try_into().map_err(|_| bad(format!("a region has {} numbers, not 6", r.len())))?;
            let [west, south, east, north, low, high] = *r;
            let sound = [west, east].iter().all(|v| v.abs() <= TAU)
                && south <= north
                && south.abs().max(north.abs()) <= TAU / 4.0 + 1e-9;
            if !sound || low > high {
                return refuse("bad-volume", format!("the region {r:?} is none"));
            }
            // Over the antimeridian.
            let east = if east < west { east + TAU } else { east };
            return Self::Region { bounds: [west, south, east, north, low, high] }.finite();
        }
        if let Some(s) = &wire.sphere {
            let s: &[f64; 4] =
                s.as_slice().try_into().map_err(|_| bad(format!("a sphere has {} numbers, not 4", s.len())))?;
            if s[3] < 0.0 {
                return refuse("bad-volume", format!("a sphere has the radius {}", s[3]));
            }
            let sphere = Self::Sphere { centre: DVec3::new(s[0], s[1], s[2]), radius_m: s[3] };
            return sphere.moved(root_from_tile).finite();
        }
        Ok(None)
    }

    fn moved(self, by: &DMat4) -> Self {
        match self {
            Self::Box { centre, half } => {
                Self::Box { centre: by.transform_point3(centre), half: half.map(|axis| by.transform_vector3(axis)) }
            }
            Self::Sphere { centre, radius_m } => {
                Self::Sphere { centre: by.transform_point3(centre), radius_m: radius_m * largest_scale(by) }
            }
            region => region,
        }
    }

    fn finite(self) -> Result<Option<Self>, Refusal> {
        let finite = match self {
            Self::Box { centre, half } => centre.is_finite() && half.iter().all(|axis| axis.is_finite()),
            Self::Sphere { centre, radius_m } => centre.is_finite() && radius_m.is_finite(),
            Self::Region { bounds } => bounds.iter().all(|v| v.is_finite()),
        };
        if finite { Ok(Some(self)) } else { refuse("bad-volume", "a bounding volume is not finite") }
    }

    /// The middle, in the root frame.
    pub fn centre(&self) -> DVec3 {
        match *self {
            Self::Box { centre, .. } | Self::Sphere { centre, .. } => centre,
            Self::Region { bounds: [west, south, east, north, low, high] } => ecef_from_geodetic(Geodetic {
                lon_rad: (west + east) / 2.0,
                lat_rad: (south + north) / 2.0,
                height_m: (low + high) / 2.0,
            }),
        }
    }

    /// Radius of a ball about [`Self::centre`] that holds the volume, metres.
    pub fn radius_m(&self) -> f64 {
        match self {
            Self::Sphere { radius_m, .. } => *radius_m,
            _ => self.outline().iter().map(|p| p.distance(self.centre())).fold(0.0, f64::max),
        }
    }

    /// How far the point `p` of the root frame is outside, metres; 0 inside.
    ///
    /// Exact for boxes with right angles and for spheres; for regions east, north and up are taken as straight, and for
    /// skewed boxes it is an upper bound.
    pub fn outside_m(&self, p: DVec3) -> f64 {
        match *self {
            Self::Box { centre, half } => {
                let axes = directions(half);
                let along = axes.inverse() * (p - centre);
                let most = DVec3::from_array(half.map(|axis| axis.length()));
                (axes * (along - along.clamp(-most, most))).length()
            }
            Self::Sphere { centre, radius_m } => (p.distance(centre) - radius_m).max(0.0),
            Self::Region { bounds: [west, south, east, north, low, high] } => {
                let at = geodetic_from_ecef(p);
                // The turn of longitude that is nearest to the middle.
                let middle = (west + east) / 2.0;
                let lon = at.lon_rad + TAU * ((middle - at.lon_rad) / TAU).round();
                let over = |v: f64, low: f64, high: f64| (low - v).max(v - high).max(0.0);
                let (from_axis_m, radius_m) = (p.x.hypot(p.y), A_M + at.height_m);
                DVec3::new(
                    over(lon, west, east) * from_axis_m,
                    over(at.lat_rad, south, north) * radius_m,
                    over(at.height_m, low, high),
                )
                .length()
            }
        }
    }

    /// How far `inner` reaches out of this volume, metres; 0 if it does not.
    ///
    /// Exact for boxes within boxes and spheres; inner regions are looked at on a grid of points, inner spheres at the
    /// ends of 26 diameters.
    pub fn reach_m(&self, inner: &Self) -> f64 {
        if let (Self::Sphere { centre, radius_m }, Self::Sphere { centre: other, radius_m: r }) = (self, inner) {
            return (centre.distance(*other) + r - radius_m).max(0.0);
        }
        inner.outline().into_iter().map(|p| self.outside_m(p)).fold(0.0, f64::max)
    }

    /// Points that say how far the volume reaches.
    fn outline(&self) -> Vec<DVec3> {
        match *self {
            Self::Box { centre, half } => {
                let side = |i: usize, bit: usize| if i & bit == 0 { -1.0 } else { 1.0 };
                let corner = |i: usize| centre + half[0] * side(i, 1) + half[1] * side(i, 2) + half[2] * side(i, 4);
                (0..8).map(corner).collect()
            }
            Self::Sphere { centre, radius_m } => {
                let unit = |i: usize| DVec3::new((i % 3) as f64, (i / 3 % 3) as f64, (i / 9) as f64) - DVec3::ONE;
                let ends = (0..27).map(unit).filter_map(DVec3::try_normalize);
                ends.map(|direction| centre + direction * radius_m).collect()
            }
            Self::Region { bounds: [west, south, east, north, low, high] } => {
                let part = |from: f64, to: f64, i: usize| from + (to - from) * i as f64 / REGION_STEPS as f64;
                let mut points = Vec::new();
                for i in 0..=REGION_STEPS {
                    for j in 0..=REGION_STEPS {
                        let (lon_rad, lat_rad) = (part(west, east, i), part(south, north, j));
                        let at = |height_m| ecef_from_geodetic(Geodetic { lon_rad, lat_rad, height_m });
                        points.extend([at(low), at(high)]);
                    }
                }
                points
            }
        }
    }
}

/// Unit directions of half axes; those of no length (flat boxes) are set across the others.
fn directions(half: [DVec3; 3]) -> DMat3 {
    /// Below this the three directions are as good as in one plane.
    const MIN_DETERMINANT: f64 = 1e-6;
    let mut axes = half.map(|axis| axis.try_normalize());
    for _ in 0..3 {
        for i in 0..3 {
            if axes[i].is_some() {
                continue;
            }
            axes[i] = match (axes[(i + 1) % 3], axes[(i + 2) % 3]) {
                (Some(a), Some(b)) => a.cross(b).try_normalize(),
                (Some(a), None) | (None, Some(a)) => Some(a.any_orthonormal_vector()),
                (None, None) => Some(DVec3::AXES[i]),
            };
        }
    }
    let [x, y, z] = axes.map(Option::unwrap_or_default);
    let found = DMat3::from_cols(x, y, z);
    if found.determinant().abs() > MIN_DETERMINANT { found } else { DMat3::IDENTITY }
}

/// The largest scale of a transform over its axes.
pub(super) fn largest_scale(transform: &DMat4) -> f64 {
    let axes = [transform.x_axis, transform.y_axis, transform.z_axis];
    axes.iter().map(|axis| axis.truncate().length()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unit_box(at: DVec3, half: f64) -> Volume {
        Volume::Box { centre: at, half: [DVec3::X * half, DVec3::Y * half, DVec3::Z * half] }
    }

    #[test]
    fn a_point_beyond_a_corner_is_outside_by_the_way_to_the_corner() {
        let volume = unit_box(DVec3::ZERO, 1.0);
        assert_eq!(volume.outside_m(DVec3::new(0.5, -1.0, 1.0)), 0.0);
        assert!((volume.outside_m(DVec3::new(4.0, 5.0, 0.0)) - 5.0).abs() < 1e-12);
    }

    #[test]
    fn a_flat_box_has_no_height_and_still_an_up() {
        let volume = Volume::Box { centre: DVec3::ZERO, half: [DVec3::X, DVec3::Y * 2.0, DVec3::ZERO] };
        assert!((volume.outside_m(DVec3::new(0.0, 0.0, 3.0)) - 3.0).abs() < 1e-12);
        let point = Volume::Box { centre: DVec3::ZERO, half: [DVec3::ZERO; 3] };
        assert!((point.outside_m(DVec3::new(0.0, 4.0, 3.0)) - 5.0).abs() < 1e-12);
    }

    #[test]
    fn a_child_that_reaches_out_does_so_by_metres() {
        let parent = unit_box(DVec3::ZERO, 2.0);
        assert_eq!(parent.reach_m(&unit_box(DVec3::X, 1.0)), 0.0);
        assert!((parent.reach_m(&unit_box(DVec3::X * 1.5, 1.0)) - 0.5).abs() < 1e-12);
        let ball = Volume::Sphere { centre: DVec3::X, radius_m: 2.0 };
        assert!((parent.reach_m(&ball) - 1.0).abs() < 1e-12);
        assert!((Volume::Sphere { centre: DVec3::ZERO, radius_m: 2.0 }.reach_m(&ball) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn a_region_knows_metres_east_and_up_even_over_the_antimeridian() {
        let wire = BoundingVolume { region: Some(vec![3.13, 0.0, -3.13, 0.01, 0.0, 50.0]), ..Default::default() };
        let region = Volume::of(&wire, &DMat4::IDENTITY).unwrap().unwrap();
        let at = |lon_rad, height_m| ecef_from_geodetic(Geodetic { lon_rad, lat_rad: 0.005, height_m });
        assert_eq!(region.outside_m(at(-3.135, 20.0)), 0.0);
        assert!((region.outside_m(at(3.135, 57.0)) - 7.0).abs() < 1e-6);
        let east_m = region.outside_m(at(3.129, 20.0));
        assert!((east_m - 0.001 * A_M).abs() < 1.0, "{east_m}");
        assert!((Volume::Sphere { centre: region.centre(), radius_m: 1.0 }).reach_m(&region) > 10_000.0);
    }

    #[test]
    fn a_volume_of_the_wrong_length_is_refused() {
        for wire in [
            BoundingVolume { oriented_box: Some(vec![0.0; 11]), ..Default::default() },
            BoundingVolume { region: Some(vec![0.0, 1.0, 0.0, 0.0, 0.0, 0.0]), ..Default::default() },
            BoundingVolume { sphere: Some(vec![0.0, 0.0, 0.0, -1.0]), ..Default::default() },
        ] {
            assert_eq!(Volume::of(&wire, &DMat4::IDENTITY).unwrap_err().code, "bad-volume");
        }
        assert_eq!(Volume::of(&BoundingVolume::default(), &DMat4::IDENTITY), Ok(None));
    }
}
