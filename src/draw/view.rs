//! Cameras: from local metres (x east, y north, z up) to pixels (x right, y down, origin at the top left corner).

use glam::DVec3;

use crate::geo::Aabb;

/// No picture is larger on a side, pixels: the rasteriser's fixed-point coordinates need room to spare.
pub const MAX_SIDE_PX: u32 = 16384;
/// Vertical opening of a view unless told otherwise, degrees: a normal lens, little distortion at the rim.
pub const FOV_DEG: f64 = 40.0;
/// Room left around what is fitted, share of the picture.
const MARGIN: f64 = 0.03;
/// Nothing nearer than this share of the distance to the target is drawn, and nothing behind the camera.
const NEAR_SHARE: f64 = 1e-3;

/// A camera with a picture size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    size_px: [u32; 2],
    eye: DVec3,
    right: DVec3,
    up: DVec3,
    forward: DVec3,
    lens: Lens,
}

/// How depth acts on size.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Lens {
    Parallel { px_per_m: f64 },
    Perspective { focal_px: f64, near_m: f64 },
}

/// A place in a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projected {
    /// Pixels from the left border; pixel centres are at halves.
    pub x_px: f64,
    /// Pixels from the upper border.
    pub y_px: f64,
    /// Metres in front of the camera's plane.
    pub depth_m: f64,
}

impl View {
    /// Looks straight down, north up, so that all `points` are seen at equal scale.
    pub fn above(points: &[DVec3], size_px: [u32; 2]) -> Self {
        let bounds = Aabb::of(points.iter().copied());
        let bounds = if bounds.is_empty() { Aabb { min: DVec3::ZERO, max: DVec3::ONE } } else { bounds };
        let size_px = checked(size_px);
        let extent = (bounds.max - bounds.min).max(DVec3::splat(1e-6));
        let room = |c: usize| f64::from(size_px[c]) * (1.0 - 2.0 * MARGIN);
        let px_per_m = (room(0) / extent.x).min(room(1) / extent.y);
        let eye = ((bounds.min + bounds.max) / 2.0).with_z(bounds.max.z + extent.z.max(1.0));
        let lens = Lens::Parallel { px_per_m };
        Self { size_px, eye, right: DVec3::X, up: DVec3::Y, forward: DVec3::NEG_Z, lens }
    }

    /// Looks straight down with pixel (0, 0)'s upper left corner at `corner` (its z is the camera's) and a stated
    /// scale, so that pictures of neighbours line up.
    pub fn above_at(corner: DVec3, px_per_m: f64, size_px: [u32; 2]) -> Self {
        let size_px = checked(size_px);
        let half = size_px.map(|side| f64::from(side) / 2.0 / px_per_m);
        let eye = corner + DVec3::new(half[0], -half[1], 0.0);
        let lens = Lens::Parallel { px_per_m };
        Self { size_px, eye, right: DVec3::X, up: DVec3::Y, forward: DVec3::NEG_Z, lens }
    }

    /// Looks from `eye` to `target`; `fov_deg` is the opening over the picture's height.
    pub fn from_eye(eye: DVec3, target: DVec3, fov_deg: f64, size_px: [u32; 2]) -> Self {
        let size_px = checked(size_px);
        let forward = (target - eye).try_normalize().unwrap_or(DVec3::NEG_Z);
        let right = forward.cross(DVec3::Z).try_normalize().unwrap_or(DVec3::X);
        let focal_px = f64::from(size_px[1]) / 2.0 / (fov_deg.to_radians() / 2.0).tan();
        let near_m = ((target - eye).length() * NEAR_SHARE).max(1e-9);
        let lens = Lens::Perspective { focal_px, near_m };
        Self { size_px, eye, right, up: right.cross(forward), forward, lens }
    }

    /// Looks as from an aircraft: the camera stands at compass bearing `azimuth_deg` (0 north, 90 east) of `points`,
    /// `elevation_deg` above the horizon, and as near as still shows all of them.
    pub fn oblique(points: &[DVec3], azimuth_deg: f64, elevation_deg: f64, size_px: [u32; 2]) -> Self {
        let (azimuth, elevation) = (azimuth_deg.to_radians(), elevation_deg.to_radians());
        let from = DVec3::new(azimuth.sin() * elevation.cos(), azimuth.cos() * elevation.cos(), elevation.sin());
        let center = Aabb::of(points.iter().copied());
        let center = if center.is_empty() { DVec3::ZERO } else { (center.min + center.max) / 2.0 };
        let view = Self::from_eye(center + from, center, FOV_DEG, size_px);
        view.fitted(points, center)
    }

    /// The same direction and opening, moved so that `points` fill the picture; in closed form, as the constraints
    /// of left and right (and of top and bottom) border are linear in shift and distance.
    fn fitted(self, points: &[DVec3], center: DVec3) -> Self {
        let Lens::Perspective { focal_px, .. } = self.lens else { return self };
        let open = self.size_px.map(|side| f64::from(side) / 2.0 * (1.0 - 2.0 * MARGIN) / focal_px);
        let mut reach = [[f64::NEG_INFINITY; 2]; 2];
        let mut nearest = f64::INFINITY;
        for &point in points {
            let offset = point - center;
            let depth = offset.dot(self.forward);
            for (axis, along) in [self.right, self.up].into_iter().enumerate() {
                let side = offset.dot(along);
                reach[axis][0] = reach[axis][0].max(side - depth * open[axis]);
                reach[axis][1] = reach[axis][1].max(-side - depth * open[axis]);
            }
            nearest = nearest.min(depth);
        }
        if !nearest.is_finite() {
            return self;
        }
        let back = |axis: usize| (reach[axis][0] + reach[axis][1]) / (2.0 * open[axis]);
        let bounds = Aabb::of(points.iter().copied());
        let near_m = ((bounds.max - bounds.min).length() * NEAR_SHARE).max(1e-9);
        let back_m = back(0).max(back(1)).max(near_m * 2.0 - nearest);
        let shift = |axis: usize| (reach[axis][0] - reach[axis][1]) / 2.0;
        let eye = center - self.forward * back_m + self.right * shift(0) + self.up * shift(1);
        Self { eye, lens: Lens::Perspective { focal_px, near_m }, ..self }
    }

    /// The same picture at `factor` times the pixels on a side (as far as [`MAX_SIDE_PX`] allows), for smoothing.
    pub fn enlarged(self, factor: u32) -> Self {
        let largest = MAX_SIDE_PX / self.size_px[0].max(self.size_px[1]);
        let factor = factor.clamp(1, largest.max(1));
        let scale = f64::from(factor);
        let lens = match self.lens {
            Lens::Parallel { px_per_m } => Lens::Parallel { px_per_m: px_per_m * scale },
            Lens::Perspective { focal_px, near_m } => Lens::Perspective { focal_px: focal_px * scale, near_m },
        };
        Self { size_px: self.size_px.map(|side| side * factor), lens, ..self }
    }

    /// Width and height, pixels.
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// The viewing direction, length one.
    pub fn forward(&self) -> DVec3 {
        self.forward
    }

    /// Where the camera stands, local metres.
    pub fn eye(&self) -> DVec3 {
        self.eye
    }

    /// Direction of the picture's right border, length one.
    pub fn right(&self) -> DVec3 {
        self.right
    }

    /// Direction of the picture's upper border, length one.
    pub fn up(&self) -> DVec3 {
        self.up
    }

    /// Where `point` is in the picture, which may be outside its borders; none if it is behind the near plane.
    pub fn project(&self, point: DVec3) -> Option<Projected> {
        let camera = self.camera_from_local(point);
        let [x_px, y_px, nearness] = self.picture_from_camera(camera)?;
        Some(Projected { x_px, y_px, depth_m: self.depth_m(nearness) })
    }

    /// Metres covered by one pixel at `depth_m`.
    pub fn m_per_px(&self, depth_m: f64) -> f64 {
        match self.lens {
            Lens::Parallel { px_per_m } => 1.0 / px_per_m,
            Lens::Perspective { focal_px, .. } => depth_m / focal_px,
        }
    }

    /// x right, y up, z depth, metres.
    pub(super) fn camera_from_local(&self, point: DVec3) -> DVec3 {
        let offset = point - self.eye;
        DVec3::new(offset.dot(self.right), offset.dot(self.up), offset.dot(self.forward))
    }

    /// x and y in pixels, and nearness: a number that is affine over the picture and grows towards the camera.
    pub(super) fn picture_from_camera(&self, camera: DVec3) -> Option<[f64; 3]> {
        let (scale, nearness) = match self.lens {
            Lens::Parallel { px_per_m } => (px_per_m, -camera.z),
            Lens::Perspective { focal_px, near_m } if camera.z >= near_m => (focal_px / camera.z, 1.0 / camera.z),
            Lens::Perspective { .. } => return None,
        };
        let center = self.size_px.map(|side| f64::from(side) / 2.0);
        Some([center[0] + camera.x * scale, center[1] - camera.y * scale, nearness])
    }

    /// Depth from nearness, metres.
    pub(super) fn depth_m(&self, nearness: f64) -> f64 {
        match self.lens {
            Lens::Parallel { .. } => -nearness,
            Lens::Perspective { .. } => 1.0 / nearness,
        }
    }

    /// Direction of sight through a point (camera metres), any length.
    pub(super) fn ray(&self, camera: DVec3) -> DVec3 {
        match self.lens {
            Lens::Parallel { .. } => DVec3::Z,
            Lens::Perspective { .. } => camera,
        }
    }

    /// The planes (normal, offset: inside is where normal·p + offset ≥ 0, in camera metres) that keep a triangle in
    /// front of the near plane and within `guard_px` of the picture's centre.
    pub(super) fn clip_planes(&self, guard_px: f64) -> [(DVec3, f64); 5] {
        let sides = [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y];
        let mut planes = [(DVec3::ZERO, 1.0); 5];
        match self.lens {
            Lens::Parallel { px_per_m } => {
                for (plane, side) in planes[1..].iter_mut().zip(sides) {
                    *plane = (side * px_per_m, guard_px);
                }
            }
            Lens::Perspective { focal_px, near_m } => {
                // A hair in front, so that rounding cannot put a cut point behind the plane that made it.
                planes[0] = (DVec3::Z, -near_m * (1.0 + 1e-9));
                for (plane, side) in planes[1..].iter_mut().zip(sides) {
                    *plane = (side * focal_px + DVec3::Z * guard_px, 0.0);
                }
            }
        }
        planes
    }

    /// Barycentric weights of the point of the triangle (camera metres) seen at a place of the picture.
    pub(super) fn weights(&self, [a, b, c]: [DVec3; 3], x_px: f64, y_px: f64) -> [f64; 3] {
        let (x, y) = (x_px - f64::from(self.size_px[0]) / 2.0, f64::from(self.size_px[1]) / 2.0 - y_px);
        let parts = match self.lens {
            Lens::Parallel { px_per_m } => {
                let at = DVec3::new(x / px_per_m, y / px_per_m, 0.0);
                let side = |p: DVec3, q: DVec3| (p.x - at.x) * (q.y - at.y) - (p.y - at.y) * (q.x - at.x);
                [side(b, c), side(c, a), side(a, b)]
            }
            Lens::Perspective { focal_px, .. } => {
                let ray = DVec3::new(x / focal_px, y / focal_px, 1.0);
                [ray.dot(b.cross(c)), ray.dot(c.cross(a)), ray.dot(a.cross(b))]
            }
        };
        let sign = if parts[0] + parts[1] + parts[2] < 0.0 { -1.0 } else { 1.0 };
        // Fixed-point corners may put a pixel a hair outside of the true triangle.
        let parts = parts.map(|part| (part * sign).max(0.0));
        let total: f64 = parts[0] + parts[1] + parts[2];
        if total > 0.0 { parts.map(|part| part / total) } else { [1.0, 0.0, 0.0] }
    }
}

/// `count` views of `points` as a flight would see them: all around in equal steps, at three heights in turn.
pub fn flight(points: &[DVec3], count: u32, size_px: [u32; 2]) -> Vec<View> {
    const ELEVATIONS_DEG: [f64; 3] = [25.0, 60.0, 40.0];
    (0..count)
        .map(|i| {
            let azimuth_deg = 360.0 * f64::from(i) / f64::from(count);
            View::oblique(points, azimuth_deg, ELEVATIONS_DEG[i as usize % ELEVATIONS_DEG.len()], size_px)
        })
        .collect()
}

/// The eight corners of a box, to fit a view to.
pub fn corners(bounds: &Aabb) -> [DVec3; 8] {
    std::array::from_fn(|i| {
        let pick = |bit: usize, c: usize| if i >> bit & 1 == 0 { bounds.min[c] } else { bounds.max[c] };
        DVec3::new(pick(0, 0), pick(1, 1), pick(2, 2))
    })
}

fn checked(size_px: [u32; 2]) -> [u32; 2] {
    size_px.map(|side| side.clamp(1, MAX_SIDE_PX))
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOX: Aabb = Aabb { min: DVec3::new(100.0, -40.0, 2.0), max: DVec3::new(160.0, 10.0, 31.0) };

    #[test]
    fn north_is_up_from_above() {
        let view = View::above(&corners(&BOX), [600, 300]);
        let at = |x, y| view.project(DVec3::new(x, y, 5.0)).expect("in front");
        assert!(at(130.0, 5.0).y_px < at(130.0, -35.0).y_px);
        assert!(at(105.0, 0.0).x_px < at(155.0, 0.0).x_px);
        let middle = at(130.0, -15.0);
        assert!((middle.x_px - 300.0).abs() < 1e-9 && (middle.y_px - 150.0).abs() < 1e-9);
        let scale = (at(131.0, 0.0).x_px - at(130.0, 0.0).x_px).abs();
        assert!((scale - 300.0 * 0.94 / 50.0).abs() < 1e-9, "{scale}");
    }

    #[test]
    fn a_stated_corner_and_scale_are_kept() {
        let view = View::above_at(DVec3::new(10.0, 20.0, 50.0), 4.0, [80, 40]);
        let at = view.project(DVec3::new(12.0, 19.0, 7.0)).expect("in front");
        assert_eq!([at.x_px, at.y_px, at.depth_m], [8.0, 4.0, 43.0]);
        assert_eq!(view.m_per_px(3.0), 0.25);
    }

    #[test]
    fn flight_views_show_the_whole_box_and_touch_its_rim() {
        let views = flight(&corners(&BOX), 12, [400, 250]);
        assert_eq!(views.len(), 12);
        for view in views {
            let seen = corners(&BOX).map(|p| view.project(p).expect("in front"));
            assert!(seen.iter().all(|p| (0.0..=400.0).contains(&p.x_px) && (0.0..=250.0).contains(&p.y_px)));
            let reach = |c: fn(&Projected) -> f64| {
                let all = seen.iter().map(c);
                all.clone().fold(f64::NEG_INFINITY, f64::max) - all.fold(f64::INFINITY, f64::min)
            };
            let tight = (reach(|p| p.x_px) / 400.0).max(reach(|p| p.y_px) / 250.0);
            assert!((tight - 0.94).abs() < 1e-9, "fills {tight}");
        }
    }

    #[test]
    fn a_camera_in_the_south_sees_the_east_on_its_right() {
        let view = View::oblique(&corners(&BOX), 180.0, 30.0, [400, 250]);
        let at = |p| view.project(p).expect("in front");
        let (west, east) = (at(DVec3::new(100.0, -40.0, 2.0)), at(DVec3::new(160.0, -40.0, 2.0)));
        assert!(west.x_px < east.x_px);
        assert!(at(DVec3::new(130.0, 10.0, 2.0)).depth_m > west.depth_m);
        assert!(at(DVec3::new(130.0, -40.0, 31.0)).y_px < at(DVec3::new(130.0, -40.0, 2.0)).y_px);
    }

    #[test]
    fn what_lies_behind_is_not_projected() {
        let view = View::from_eye(DVec3::ZERO, DVec3::Y, 60.0, [10, 10]);
        assert!(view.project(DVec3::new(0.0, -1.0, 0.0)).is_none());
        let ahead = view.project(DVec3::new(0.0, 7.0, 0.0)).expect("in front");
        assert!((ahead.depth_m - 7.0).abs() < 1e-12);
        assert!(
            (view.enlarged(2).project(DVec3::new(1.0, 7.0, 2.0)).expect("in front").x_px
                - 2.0 * view.project(DVec3::new(1.0, 7.0, 2.0)).expect("in front").x_px)
                .abs()
                < 1e-9
        );
    }

    #[test]
    fn nonsense_makes_a_view_all_the_same() {
        for points in [vec![], vec![DVec3::NAN], vec![DVec3::ONE]] {
            let above = View::above(&points, [0, 99_999]);
            assert_eq!(above.size_px(), [1, MAX_SIDE_PX]);
            assert!(View::oblique(&points, 10.0, 90.0, [8, 8]).eye().is_finite());
        }
    }

    #[test]
    fn weights_find_the_point_again() {
        let tri = [DVec3::new(101.0, 0.0, 3.0), DVec3::new(150.0, -30.0, 9.0), DVec3::new(140.0, 8.0, 25.0)];
        for view in [View::above(&corners(&BOX), [300, 300]), View::oblique(&corners(&BOX), 200.0, 50.0, [300, 300])] {
            let want = [0.2, 0.5, 0.3];
            let point = tri[0] * want[0] + tri[1] * want[1] + tri[2] * want[2];
            let at = view.project(point).expect("in front");
            let got = view.weights(tri.map(|p| view.camera_from_local(p)), at.x_px, at.y_px);
            assert!((0..3).all(|i| (got[i] - want[i]).abs() < 1e-9), "{got:?}");
        }
    }
}
