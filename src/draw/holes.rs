//! Holes: pixels where a reference mesh has surface and another mesh, seen from the same place, has not.

use super::raster::{NO_FACE, Seen};
use super::shade::BACKGROUND;
use image::{Rgb, RgbImage};

/// What counts as a hole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HoleConfig {
    /// Surface that lies this much behind the reference's counts as missing too: through a hole in a roof one sees
    /// the floor, not the sky. Metres along the view. Default: infinity, only background counts.
    pub behind_m: f64,
    /// Pixels of the reference's own outline that do not count, as a mesh within its error may end there a little
    /// earlier. Default: 1.
    pub rim_px: u32,
}

impl Default for HoleConfig {
    fn default() -> Self {
        Self { behind_m: f64::INFINITY, rim_px: 1 }
    }
}

/// Pixels that are missing.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Holes {
    /// Pixels that could show a hole: the reference without its rim.
    pub checked_px: u64,
    /// Pixels where the other mesh shows background.
    pub open_px: u64,
    /// Pixels where the other mesh lies more than [`HoleConfig::behind_m`] behind.
    pub behind_px: u64,
    /// Area of the missing pixels at the reference's depth, m² across the line of sight.
    pub area_m2: f64,
    /// Connected holes (four neighbours), largest first; the earlier in reading order of equals.
    pub holes: Vec<Hole>,
}

/// One connected hole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hole {
    /// Its pixels.
    pub px: u64,
    /// Area at the reference's depth, m² across the line of sight.
    pub area_m2: f64,
    /// A pixel of it, the first in reading order.
    pub at_px: [u32; 2],
    /// The reference's face at that pixel.
    pub face: u32,
}

impl Holes {
    /// Compares two meshes seen in the same view.
    ///
    /// # Panics
    /// If the views differ: pixels would mean different places.
    pub fn of(reference: &Seen, other: &Seen, config: &HoleConfig) -> Self {
        assert_eq!(reference.view(), other.view(), "holes need the same view");
        let [width, height] = reference.view().size_px().map(|side| side as usize);
        let inner = without_rim(reference.faces(), [width, height], config.rim_px);
        let mut result = Self { checked_px: inner.iter().filter(|&&i| i).count() as u64, ..Self::default() };
        let mut missing = vec![false; inner.len()];
        for i in (0..inner.len()).filter(|&i| inner[i]) {
            let Some(depth_m) = reference.depth_m(i) else { continue };
            match other.depth_m(i) {
                None => result.open_px += 1,
                Some(other_m) if other_m > depth_m + config.behind_m => result.behind_px += 1,
                Some(_) => continue,
            }
            missing[i] = true;
        }
        result.holes = connected(&missing, reference, [width, height]);
        result.area_m2 = result.holes.iter().map(|hole| hole.area_m2).sum();
        result
    }

    /// All missing pixels.
    pub fn missing_px(&self) -> u64 {
        self.open_px + self.behind_px
    }
}

/// `picture` with pixels where `other` shows background and `reference` does not in `mark`.
pub fn marked(picture: &RgbImage, reference: &Seen, other: &Seen, mark: [u8; 3]) -> RgbImage {
    let mut picture = picture.clone();
    for (i, pixel) in picture.pixels_mut().enumerate() {
        let open = |seen: &Seen| seen.faces().get(i).is_none_or(|&f| f == NO_FACE);
        if open(other) {
            *pixel = Rgb(if open(reference) { BACKGROUND } else { mark });
        }
    }
    picture
}

/// Pixels with a face, all of whose neighbours within `rim_px` have one too; beyond the picture's border all have.
fn without_rim(faces: &[u32], [width, height]: [usize; 2], rim_px: u32) -> Vec<bool> {
    let mut inner: Vec<bool> = faces.iter().map(|&f| f != NO_FACE).collect();
    for _ in 0..rim_px {
        let before = inner.clone();
        for (i, keep) in inner.iter_mut().enumerate() {
            let (x, y) = (i % width, i / width);
            let all = (y.saturating_sub(1)..(y + 2).min(height))
                .all(|y| (x.saturating_sub(1)..(x + 2).min(width)).all(|x| before[y * width + x]));
            *keep = all;
        }
    }
    inner
}

fn connected(missing: &[bool], reference: &Seen, [width, height]: [usize; 2]) -> Vec<Hole> {
    let mut done = vec![false; missing.len()];
    let (mut holes, mut open) = (Vec::new(), Vec::new());
    for first in (0..missing.len()).filter(|&i| missing[i]) {
        if done[first] {
            continue;
        }
        let at_px = [(first % width) as u32, (first / width) as u32];
        let mut hole = Hole { px: 0, area_m2: 0.0, at_px, face: reference.faces()[first] };
        done[first] = true;
        open.push(first);
        while let Some(i) = open.pop() {
            hole.px += 1;
            hole.area_m2 += reference.depth_m(i).map_or(0.0, |depth| reference.view().m_per_px(depth).powi(2));
            let (x, y) = (i % width, i / width);
            let next = [
                (x > 0).then(|| i - 1),
                (x + 1 < width).then_some(i + 1),
                (y > 0).then(|| i - width),
                (y + 1 < height).then_some(i + width),
            ];
            for n in next.into_iter().flatten().filter(|&n| missing[n]) {
                if !std::mem::replace(&mut done[n], true) {
                    open.push(n);
                }
            }
        }
        holes.push(hole);
    }
    holes.sort_by_key(|hole| std::cmp::Reverse(hole.px));
    holes
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::draw::view::View;

    /// Two squares of 10 m side by side, each of two faces; `gap_m` moves one shared vertex of the right one.
    fn two_squares(gap_m: f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let p = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let positions = vec![
            p(0.0, 0.0),
            p(10.0, 0.0),
            p(10.0, 10.0),
            p(0.0, 10.0),
            p(10.0 + gap_m, 0.0),
            p(20.0, 0.0),
            p(20.0, 10.0),
        ];
        (positions, vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 2]])
    }

    fn seen(gap_m: f64, px_per_m: f64) -> Seen {
        let (positions, faces) = two_squares(gap_m);
        let view =
            View::above_at(DVec3::new(-1.0, 11.0, 9.0), px_per_m, [(22.0 * px_per_m) as u32, (12.0 * px_per_m) as u32]);
        Seen::of(&view, &positions, &faces)
    }

    #[test]
    fn a_moved_vertex_opens_a_hole_of_the_expected_size() {
        for (gap_m, px_per_m) in [(0.4, 20.0), (2.0, 10.0), (0.05, 60.0)] {
            let holes = Holes::of(&seen(0.0, px_per_m), &seen(gap_m, px_per_m), &HoleConfig::default());
            // A triangle of base gap_m and 10 m height, less the rim of one pixel at its base.
            let want = gap_m * 10.0 / 2.0;
            assert!((holes.area_m2 - want).abs() < 0.06 * want, "{} for {want}", holes.area_m2);
            assert_eq!(holes.behind_px, 0);
            assert_eq!(holes.holes[0].face, 3, "the hole is found on the face that moved");
        }
    }

    #[test]
    fn the_same_mesh_has_no_holes() {
        let holes = Holes::of(&seen(0.0, 7.3), &seen(0.0, 7.3), &HoleConfig::default());
        assert_eq!((holes.missing_px(), holes.holes.len()), (0, 0));
        assert!(holes.checked_px > 9000);
    }

    #[test]
    fn a_shrunken_outline_is_rim_and_not_hole() {
        let view = View::above_at(DVec3::new(-1.0, 11.0, 9.0), 4.0, [88, 48]);
        let (positions, faces) = two_squares(0.0);
        let smaller: Vec<DVec3> =
            positions.iter().map(|p| DVec3::new(p.x * 0.98 + 0.2, p.y * 0.96 + 0.2, 0.0)).collect();
        let (reference, other) = (Seen::of(&view, &positions, &faces), Seen::of(&view, &smaller, &faces));
        assert!(Holes::of(&reference, &other, &HoleConfig { rim_px: 0, ..Default::default() }).open_px > 0);
        assert_eq!(Holes::of(&reference, &other, &HoleConfig::default()).open_px, 0);
    }

    #[test]
    fn a_roof_that_is_gone_shows_the_floor_behind() {
        let (mut positions, faces) = two_squares(0.0);
        let view = View::above_at(DVec3::new(-1.0, 11.0, 9.0), 4.0, [88, 48]);
        let reference = Seen::of(&view, &positions, &faces);
        positions.iter_mut().for_each(|p| p.z -= 3.0);
        let other = Seen::of(&view, &positions, &faces);
        assert_eq!(Holes::of(&reference, &other, &HoleConfig { behind_m: 3.5, rim_px: 1 }).missing_px(), 0);
        let holes = Holes::of(&reference, &other, &HoleConfig { behind_m: 2.5, rim_px: 1 });
        assert_eq!((holes.open_px, holes.behind_px), (0, holes.checked_px));
        assert_eq!(holes.holes.len(), 1);
    }
}
