//! The colour of a source face at a point, at the resolution that is asked for.

use std::sync::Arc;

use glam::DVec2;
use image::RgbImage;

use super::images::{Images, UV_SLACK, texel_corners};
use super::mask::Mask;
use super::raster::{Barycentric, floor};
use super::{GREY, Surface};

/// Mips a painter may keep from the cache's reach, bytes.
const HELD_BYTES: usize = 256 << 20;
/// Levels of the largest image there can be.
const LEVELS: usize = 17;

/// Faces a painter remembers, a power of two: row by row, the same few come again and again.
const REMEMBERED: usize = 512;

/// Paints points of a surface; remembers what faces it painted lately.
pub(super) struct Painter<'a> {
    surface: Surface<'a>,
    images: &'a Images<'a>,
    texel_m: f64,
    held: Vec<Arc<RgbImage>>,
    held_bytes: usize,
    /// Per image and level, index into `held` or `u32::MAX`.
    slots: Vec<[u32; LEVELS]>,
    /// By face, modulo their number: which one, and how it is painted.
    faces: Vec<u32>,
    paints: Vec<Paint<'a>>,
}

#[derive(Clone)]
enum Paint<'a> {
    Image { held: usize, mask: Option<&'a Mask>, corners: [DVec2; 3], wrap: [bool; 2] },
    Corners([[u8; 3]; 3]),
    Solid([u8; 3]),
}

impl<'a> Painter<'a> {
    /// Paints for an atlas of `texel_m` metres per texel.
    pub fn new(surface: Surface<'a>, images: &'a Images<'a>, texel_m: f64) -> Self {
        let slots = vec![[u32::MAX; LEVELS]; images.len()];
        Self {
            surface,
            images,
            texel_m,
            held: Vec::new(),
            held_bytes: 0,
            slots,
            faces: vec![u32::MAX; REMEMBERED],
            paints: vec![Paint::Solid(GREY); REMEMBERED],
        }
    }

    /// Colour at the point of `face` with these corner weights.
    pub fn color(&mut self, face: u32, weights: [f64; 3]) -> [u8; 3] {
        let slot = self.remember(face);
        match &self.paints[slot] {
            Paint::Image { held, mask, corners, wrap } => {
                bilinear(&self.held[*held], *mask, between(corners, weights), *wrap)
            }
            Paint::Corners(corners) => blended(corners, weights),
            Paint::Solid(color) => *color,
        }
    }

    /// Colours a row of texels of one face, whose centres lie at `first` and every one to the right of it.
    pub fn color_row(&mut self, face: u32, weights: &Barycentric, first: DVec2, row: &mut [u8]) {
        let slot = self.remember(face);
        // Places are whole numbers and a half: adding is exact.
        let centers = (0..row.len() / 3).map(|x| first + DVec2::new(x as f64, 0.0));
        let texels = row.chunks_exact_mut(3).zip(centers);
        match &self.paints[slot] {
            Paint::Image { held, mask, corners, wrap } => {
                let image = &*self.held[*held];
                for (texel, center) in texels {
                    let at = between(corners, weights.at(center));
                    texel.copy_from_slice(&bilinear(image, *mask, at, *wrap));
                }
            }
            Paint::Corners(corners) => {
                texels.for_each(|(texel, center)| texel.copy_from_slice(&blended(corners, weights.at(center))));
            }
            Paint::Solid(color) => texels.for_each(|(texel, _)| texel.copy_from_slice(color)),
        }
    }

    /// Where the paint of a face is.
    fn remember(&mut self, face: u32) -> usize {
        let slot = face as usize % REMEMBERED;
        if self.faces[slot] != face {
            self.paints[slot] = self.take(face as usize);
            self.faces[slot] = face;
        }
        slot
    }

    fn take(&mut self, face: usize) -> Paint<'a> {
        let surface = self.surface;
        let Some(image) = surface.image(face).filter(|&i| (i as usize) < self.images.len()) else {
            if surface.vertex_colors.is_empty() {
                return Paint::Solid(surface.base_color(face));
            }
            return Paint::Corners(surface.faces[face].map(|v| surface.vertex_colors[v as usize]));
        };
        let size = self.images.dimensions(image);
        let corners = texel_corners(&surface.corner_uvs[face], size);
        let level = self.level(face, corners);
        let scale = 1.0 / f64::from(1_u32 << level);
        let reach = corners[0].max(corners[1]).max(corners[2]) / DVec2::new(size[0].into(), size[1].into());
        Paint::Image {
            held: self.hold(image, level),
            mask: if level == 0 { self.images.mask(image) } else { None },
            corners: corners.map(|p| p * scale),
            wrap: [reach.x > 1.0 + UV_SLACK, reach.y > 1.0 + UV_SLACK],
        }
    }

    /// The level whose texels are nearest in size to ours, on a logarithmic scale.
    fn level(&self, face: usize, corners: [DVec2; 3]) -> u32 {
        let area_px = (corners[1] - corners[0]).perp_dot(corners[2] - corners[0]).abs() / 2.0;
        // Source texels in one of ours; each level has a quarter of them, and the limit between two is at sqrt(4).
        let mut texels = self.texel_m * self.texel_m * area_px / self.surface.area_m2(face);
        let mut level = 0;
        while texels > 2.0 && level + 1 < LEVELS as u32 {
            texels /= 4.0;
            level += 1;
        }
        level
    }

    fn hold(&mut self, image: u32, level: u32) -> usize {
        let slot = self.slots[image as usize][level as usize];
        if slot != u32::MAX {
            return slot as usize;
        }
        let texels = self.images.mip(image, level);
        if self.held_bytes > HELD_BYTES {
            self.held.clear();
            self.held_bytes = 0;
            self.slots.fill([u32::MAX; LEVELS]);
            self.faces.fill(u32::MAX);
        }
        self.held_bytes += texels.as_raw().len();
        self.held.push(texels);
        self.slots[image as usize][level as usize] = self.held.len() as u32 - 1;
        self.held.len() - 1
    }
}

fn between(corners: &[DVec2; 3], weights: [f64; 3]) -> DVec2 {
    corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2]
}

fn blended(corners: &[[u8; 3]; 3], weights: [f64; 3]) -> [u8; 3] {
    std::array::from_fn(|c| {
        let sum: f64 = (0..3).map(|i| f64::from(corners[i][c]) * weights[i]).sum();
        // Float to byte saturates.
        (sum + 0.5) as u8
    })
}

/// Bilinear sample at `at` (texels; centres at halves) of the texels `mask` admits, in sRGB: between neighbours of
/// one level linear light makes no visible difference, and the renderer's own filter does the same.
#[inline]
pub(super) fn bilinear(image: &RgbImage, mask: Option<&Mask>, at: DVec2, wrap: [bool; 2]) -> [u8; 3] {
    let (width, height) = image.dimensions();
    let (xs, fx) = taps(at.x, width, wrap[0]);
    let (ys, fy) = taps(at.y, height, wrap[1]);
    let weights = [(256 - fx) * (256 - fy), fx * (256 - fy), (256 - fx) * fy, fx * fy];
    if let Some(mask) = mask
        && !(mask.get(xs[0], ys[0]) && mask.get(xs[1], ys[0]) && mask.get(xs[0], ys[1]) && mask.get(xs[1], ys[1]))
    {
        return bilinear_of_used(image, mask, xs, ys, [fx, fy], weights);
    }
    let rows = [ys[0] as usize * width as usize, ys[1] as usize * width as usize];
    let columns = [xs[0] as usize, xs[1] as usize];
    let texel = |column: usize, row: usize| {
        let offset = (row + column) * 3;
        &image.as_raw()[offset..offset + 3]
    };
    let [a, b] = [texel(columns[0], rows[0]), texel(columns[1], rows[0])];
    let [c, d] = [texel(columns[0], rows[1]), texel(columns[1], rows[1])];
    let channel = |i: usize| {
        let upper = u32::from(a[i]) * weights[0] + u32::from(b[i]) * weights[1];
        let lower = u32::from(c[i]) * weights[2] + u32::from(d[i]) * weights[3];
        // The weights are 65536 together.
        ((upper + lower + (1 << 15)) >> 16) as u8
    };
    [channel(0), channel(1), channel(2)]
}

/// The same, where some of the four texels are not used.
#[cold]
fn bilinear_of_used(
    image: &RgbImage,
    mask: &Mask,
    xs: [u32; 2],
    ys: [u32; 2],
    [fx, fy]: [u32; 2],
    mut weights: [u32; 4],
) -> [u8; 3] {
    let mut total = 0;
    for (i, weight) in weights.iter_mut().enumerate() {
        if !mask.get(xs[i & 1], ys[i >> 1]) {
            *weight = 0;
        }
        total += *weight;
    }
    if total == 0 {
        // Outside of everything used, which only rounding can cause: take the nearest texel as it is.
        weights[usize::from(fx >= 128) + 2 * usize::from(fy >= 128)] = 1;
        total = 1;
    }
    let mut sum = [total / 2; 3];
    for (i, weight) in weights.into_iter().enumerate() {
        let offset = (ys[i >> 1] as usize * image.width() as usize + xs[i & 1] as usize) * 3;
        for (c, sum) in sum.iter_mut().enumerate() {
            *sum += u32::from(image.as_raw()[offset + c]) * weight;
        }
    }
    sum.map(|s| (s / total) as u8)
}

/// The two texels around `at` on one axis and the weight of the second in 256ths.
#[inline]
fn taps(at: f64, side: u32, wrap: bool) -> ([u32; 2], u32) {
    // Casting saturates, and NaN becomes 0: whatever comes in, the taps are inside.
    let low = floor(at - 0.5);
    let weight = ((at - 0.5 - low as f64) * 256.0) as u32;
    let side = i64::from(side);
    let inside = |x: i64| {
        let within = if wrap && !(0..side).contains(&x) { x.rem_euclid(side) } else { x.clamp(0, side - 1) };
        within as u32
    };
    ([inside(low), inside(low.saturating_add(1))], weight.min(256))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn a_sample_at_a_texel_center_is_that_texel() {
        let image = RgbImage::from_fn(5, 4, |x, y| Rgb([(x * 50) as u8, (y * 60) as u8, 255]));
        for (x, y, texel) in image.enumerate_pixels() {
            let at = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            assert_eq!(bilinear(&image, None, at, [false; 2]), texel.0);
            assert_eq!(bilinear(&image, None, at + DVec2::new(5.0, -4.0), [true; 2]), texel.0);
        }
        assert_eq!(bilinear(&image, None, DVec2::new(2.0, 0.5), [false; 2]), [75, 0, 255]);
        assert_eq!(bilinear(&image, None, DVec2::new(f64::NAN, 1e300), [true, false]), [0, 180, 255]);
    }

    #[test]
    fn unused_texels_have_no_weight() {
        let mut image = RgbImage::from_pixel(4, 4, Rgb([255, 0, 255]));
        let mut mask = Mask::new(4, 4);
        image.put_pixel(1, 1, Rgb([10, 20, 30]));
        mask.set(1, 1);
        assert_eq!(bilinear(&image, Some(&mask), DVec2::new(1.99, 1.01), [false; 2]), [10, 20, 30]);
    }
}
