//! Which texels of an image are used, and image pyramids that average only those.

use std::sync::LazyLock;

use image::{Rgb, RgbImage};

/// One bit a texel.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Mask {
    width: u32,
    height: u32,
    stride: usize,
    bits: Vec<u64>,
}

impl Mask {
    /// No texel used.
    pub fn new(width: u32, height: u32) -> Self {
        let stride = width.div_ceil(64) as usize;
        Self { width, height, stride, bits: vec![0; stride * height as usize] }
    }

    /// Forgets all texels and takes a new size, keeping the memory.
    pub fn reset(&mut self, width: u32, height: u32) {
        (self.width, self.height, self.stride) = (width, height, width.div_ceil(64) as usize);
        self.bits.clear();
        self.bits.resize(self.stride * height as usize, 0);
    }

    /// Whether the texel is used; it must be inside.
    pub fn get(&self, x: u32, y: u32) -> bool {
        self.bits[y as usize * self.stride + (x / 64) as usize] >> (x % 64) & 1 == 1
    }

    /// Marks one texel, which must be inside.
    pub fn set(&mut self, x: u32, y: u32) {
        self.bits[y as usize * self.stride + (x / 64) as usize] |= 1 << (x % 64);
    }

    /// Marks `x0..x1` of row `y`, clipped to the image.
    pub fn set_span(&mut self, y: u32, x0: u32, x1: u32) {
        let x1 = x1.min(self.width);
        if y >= self.height || x0 >= x1 {
            return;
        }
        self.each_word(y, x0, x1, |word, bits| *word |= bits);
    }

    /// Whether any texel of `x0..x1` of row `y` (inside) is used.
    pub fn any_in_span(&mut self, y: u32, x0: u32, x1: u32) -> bool {
        let mut any = 0;
        if x0 < x1 {
            self.each_word(y, x0, x1, |word, bits| any |= *word & bits);
        }
        any != 0
    }

    fn each_word(&mut self, y: u32, x0: u32, x1: u32, mut visit: impl FnMut(&mut u64, u64)) {
        let row = y as usize * self.stride;
        let (first, last) = (x0 / 64, (x1 - 1) / 64);
        for word in first..=last {
            let low = if word == first { !0 << (x0 % 64) } else { !0 };
            let high = if word == last { !0 >> (63 - (x1 - 1) % 64) } else { !0 };
            visit(&mut self.bits[row + word as usize], low & high);
        }
    }

    /// Grows the used area by one texel at a time (8 neighbours), `rings` times; a new texel is its neighbours' mean.
    pub fn dilate(&mut self, image: &mut RgbImage, rings: u32) {
        let mut fresh = Vec::new();
        for _ in 0..rings {
            fresh.clear();
            for y in 0..self.height {
                for word in 0..self.stride {
                    let mut bits = self.border_bits(y, word);
                    while bits != 0 {
                        let x = word as u32 * 64 + bits.trailing_zeros();
                        bits &= bits - 1;
                        if x < self.width {
                            fresh.push((x, y, self.neighbor_mean(image, x, y)));
                        }
                    }
                }
            }
            for &(x, y, color) in &fresh {
                image.put_pixel(x, y, color);
                self.set(x, y);
            }
        }
    }

    /// The unused texels of one word that touch a used one.
    fn border_bits(&self, y: u32, word: usize) -> u64 {
        let column = |word: usize| {
            let rows = y.saturating_sub(1)..=(y + 1).min(self.height - 1);
            rows.fold(0, |bits, y| bits | self.bits[y as usize * self.stride + word])
        };
        let own = column(word);
        let left = if word > 0 { column(word - 1) >> 63 } else { 0 };
        let right = if word + 1 < self.stride { column(word + 1) << 63 } else { 0 };
        (own | own << 1 | own >> 1 | left | right) & !self.bits[y as usize * self.stride + word]
    }

    fn neighbor_mean(&self, image: &RgbImage, x: u32, y: u32) -> Rgb<u8> {
        let (mut sum, mut count) = ([0_u32; 3], 0);
        for ny in y.saturating_sub(1)..=(y + 1).min(self.height - 1) {
            for nx in x.saturating_sub(1)..=(x + 1).min(self.width - 1) {
                if self.get(nx, ny) {
                    let texel = image.get_pixel(nx, ny);
                    (0..3).for_each(|c| sum[c] += u32::from(texel[c]));
                    count += 1;
                }
            }
        }
        Rgb(sum.map(|s| ((s + count / 2) / count.max(1)) as u8))
    }
}

/// sRGB byte to linear light, 0 to 65535.
static LINEAR: LazyLock<[u16; 256]> = LazyLock::new(|| {
    std::array::from_fn(|byte| {
        let s = byte as f64 / 255.0;
        let linear = if s <= 0.04045 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) };
        (linear * 65535.0).round() as u16
    })
});

/// Linear light, 0 to 65535, to the sRGB byte whose own light is nearest.
static SRGB: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let mut byte = 0_usize;
    let mut table = Vec::with_capacity(65536);
    for light in 0..=65535_u32 {
        while byte < 255 && u32::from(LINEAR[byte]) + u32::from(LINEAR[byte + 1]) < 2 * light {
            byte += 1;
        }
        table.push(byte as u8);
    }
    table
});

/// Mean in linear light of sRGB texels with whole weights; `None` if all weights are 0.
pub(super) fn mean(texels: impl Iterator<Item = ([u8; 3], u32)>) -> Option<([u8; 3], u32)> {
    let (mut sum, mut total) = ([0_u64; 3], 0_u64);
    for (rgb, weight) in texels {
        (0..3).for_each(|c| sum[c] += u64::from(LINEAR[usize::from(rgb[c])]) * u64::from(weight));
        total += u64::from(weight);
    }
    (total > 0).then(|| (sum.map(|s| SRGB[((s + total / 2) / total) as usize]), total as u32))
}

/// Levels 1, 2, … down to 1×1. A texel of level m is the mean in linear light of the used ones among the 2^m × 2^m
/// base texels it covers; one that covers none takes its parent's colour. Sides halve rounding up, so texel
/// `x` of level m always starts at base texel `x·2^m`.
pub(super) fn pyramid(base: &RgbImage, mask: Option<&Mask>) -> Vec<RgbImage> {
    if base.width() == 1 && base.height() == 1 {
        return Vec::new();
    }
    let mut levels = Vec::new();
    let mut weights: Vec<Vec<u32>> = Vec::new();
    let (level, weight) = match mask {
        Some(mask) => halve(base, |x, y| u32::from(mask.get(x, y))),
        None => halve(base, |_, _| 1),
    };
    levels.push(level);
    weights.push(weight);
    while let (Some(level), Some(weight)) = (levels.last(), weights.last()) {
        let width = level.width();
        if width == 1 && level.height() == 1 {
            break;
        }
        let (level, weight) = halve(level, |x, y| weight[(y * width + x) as usize]);
        levels.push(level);
        weights.push(weight);
    }
    for m in (0..levels.len() - 1).rev() {
        let (fine, coarse) = levels.split_at_mut(m + 1);
        fill_from_parent(&mut fine[m], &coarse[0], |x, y, width| weights[m][(y * width + x) as usize] == 0);
    }
    levels
}

/// Gives every unused texel of `image` a colour that blends into the used ones around it (push-pull).
pub(super) fn fill(image: &mut RgbImage, mask: &Mask) {
    if let Some(parent) = pyramid(image, Some(mask)).first() {
        fill_from_parent(image, parent, |x, y, _| !mask.get(x, y));
    }
}

fn fill_from_parent(image: &mut RgbImage, parent: &RgbImage, empty: impl Fn(u32, u32, u32) -> bool) {
    let width = image.width();
    let rows = image.chunks_exact_mut(3 * width as usize);
    for (y, row) in (0..).zip(rows) {
        let above = &parent.as_raw()[(y / 2 * parent.width()) as usize * 3..][..parent.width() as usize * 3];
        for (x, texel) in (0..).zip(row.chunks_exact_mut(3)) {
            if empty(x, y, width) {
                let at = (x / 2) as usize * 3;
                texel.copy_from_slice(&above[at..at + 3]);
            }
        }
    }
}

/// Half the size, and how many base texels each texel has the light of.
fn halve(fine: &RgbImage, weight: impl Fn(u32, u32) -> u32) -> (RgbImage, Vec<u32>) {
    let (width, height) = fine.dimensions();
    let mut coarse = RgbImage::new(width.div_ceil(2), height.div_ceil(2));
    let mut weights = Vec::with_capacity(coarse.width() as usize * coarse.height() as usize);
    let linear: &[u16; 256] = &LINEAR;
    let srgb: &[u8] = &SRGB;
    let texels = fine.as_raw();
    let row_bytes = 3 * coarse.width() as usize;
    for (y, row) in (0..).zip(coarse.chunks_exact_mut(row_bytes)) {
        for (x, texel) in (0..).zip(row.chunks_exact_mut(3)) {
            let (left, top) = (2 * x, 2 * y);
            let (right, bottom) = (left + 1 < width, top + 1 < height);
            let own = [
                weight(left, top),
                if right { weight(left + 1, top) } else { 0 },
                if bottom { weight(left, top + 1) } else { 0 },
                if right && bottom { weight(left + 1, top + 1) } else { 0 },
            ];
            let total = own[0] + own[1] + own[2] + own[3];
            weights.push(total);
            if total == 0 {
                continue;
            }
            let at = (top as usize * width as usize + left as usize) * 3;
            let below = at + 3 * width as usize;
            let light = |at: usize, c: usize| u32::from(linear[usize::from(texels[at + c])]);
            if own[0] == own[1] && own[0] == own[2] && own[0] == own[3] {
                // Whatever the weight, the quotient is the same: nearly all texels, without a division.
                for (c, own) in texel.iter_mut().enumerate() {
                    let sum = light(at, c) + light(at + 3, c) + light(below, c) + light(below + 3, c);
                    *own = srgb[((sum + 2) >> 2) as usize];
                }
                continue;
            }
            let (mut sum, total) = ([0_u64; 3], u64::from(total));
            for (at, weight) in [at, at + 3, below, below + 3].into_iter().zip(own) {
                if weight > 0 {
                    for (c, sum) in sum.iter_mut().enumerate() {
                        *sum += u64::from(light(at, c)) * u64::from(weight);
                    }
                }
            }
            for (own, sum) in texel.iter_mut().zip(sum) {
                *own = srgb[((sum + total / 2) / total) as usize];
            }
        }
    }
    (coarse, weights)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_cross_word_borders_and_are_clipped() {
        let mut mask = Mask::new(130, 2);
        mask.set_span(1, 60, 200);
        assert!((0..130).all(|x| mask.get(x, 1) == (x >= 60) && !mask.get(x, 0)));
        assert!(mask.any_in_span(1, 0, 61) && !mask.any_in_span(1, 0, 60) && !mask.any_in_span(0, 0, 130));
    }

    #[test]
    fn a_byte_survives_the_way_to_linear_light_and_back() {
        for byte in 0..=255_u8 {
            assert_eq!(mean([([byte; 3], 7)].into_iter()), Some(([byte; 3], 7)));
        }
    }

    #[test]
    fn black_and_white_average_to_half_the_light() {
        let (color, _) = mean([([0; 3], 1), ([255; 3], 1)].into_iter()).unwrap();
        assert_eq!(color, [188; 3]);
    }

    #[test]
    fn no_mip_holds_an_unused_color() {
        let mut base = RgbImage::from_pixel(37, 21, Rgb([255, 0, 255]));
        let mut mask = Mask::new(37, 21);
        for (x, y) in [(3, 3), (4, 3), (30, 18)] {
            base.put_pixel(x, y, Rgb([10, 200, 30]));
            mask.set(x, y);
        }
        let levels = pyramid(&base, Some(&mask));
        assert_eq!(levels.last().unwrap().dimensions(), (1, 1));
        assert!(levels.iter().all(|l| l.pixels().all(|p| *p == Rgb([10, 200, 30]))));
    }

    #[test]
    fn dilation_grows_one_ring_and_fill_the_rest() {
        let mut image = RgbImage::new(70, 9);
        let mut mask = Mask::new(70, 9);
        image.put_pixel(63, 4, Rgb([9, 9, 9]));
        mask.set(63, 4);
        mask.dilate(&mut image, 2);
        for (x, y, texel) in image.enumerate_pixels() {
            let inside = (61..=65).contains(&x) && (2..=6).contains(&y);
            assert_eq!((mask.get(x, y), texel[0]), (inside, if inside { 9 } else { 0 }));
        }
        fill(&mut image, &mask);
        assert!(image.pixels().all(|p| p[0] == 9));
    }
}
