//! Textured meshes as a viewer without lights shows them, and how alike two such pictures are.
//!
//! # Method
//! The picture is drawn larger, the texture of the face seen at each place sampled bilinearly through its coordinates,
//! and each pixel is the mean of its places.
//! # Limits
//! No mips: texels much smaller than a place of the larger picture flicker. Coordinates past 0 to 1 repeat the image.

use glam::{DVec2, DVec3, Vec2};
use image::{Rgb, RgbImage};

use super::raster::{NO_FACE, Seen};
use super::shade::{BACKGROUND, color};
use super::view::View;

/// Places a pixel along each side.
const PLACES: u32 = 3;

/// Triangles and their images.
#[derive(Debug, Clone, Copy)]
pub struct Scene<'a> {
    /// Local metres.
    pub positions: &'a [DVec3],
    /// Indices into `positions`.
    pub faces: &'a [[u32; 3]],
    /// Per face and corner, v down.
    pub corner_uvs: &'a [[Vec2; 3]],
    /// Per face, index into `images`; none: grey.
    pub face_image: &'a [Option<u32>],
    /// sRGB.
    pub images: &'a [RgbImage],
}

/// What a view shows of a scene.
#[derive(Debug, Clone)]
pub struct Picture {
    /// sRGB, white where nothing is.
    pub pixels: RgbImage,
    /// Per pixel, row by row: surface is seen at all of its places.
    pub covered: Vec<bool>,
}

/// Draws a textured mesh.
///
/// # Panics
/// If a face names a vertex or an image, or lacks coordinates or an image entry, that is not there.
pub fn draw(view: &View, scene: &Scene) -> Picture {
    let large = view.enlarged(PLACES);
    let seen = Seen::of(&large, scene.positions, scene.faces);
    let pixels = color(&seen, scene.positions, scene.faces, |hit| {
        let face = hit.face as usize;
        let Some(image) = scene.face_image[face] else { return GREY };
        let uvs = scene.corner_uvs[face].map(|uv| uv.as_dvec2());
        let uv = uvs[0] * hit.weights[0] + uvs[1] * hit.weights[1] + uvs[2] * hit.weights[2];
        bilinear(&scene.images[image as usize], uv)
    });
    let [width, height] = view.size_px();
    let places = large.size_px()[0] / width.max(1);
    let at = |x: u32, y: u32| (0..places * places).map(move |i| (x * places + i % places, y * places + i / places));
    let covered = (0..width * height).map(|i| {
        let place = |(x, y): (u32, u32)| seen.faces()[y as usize * large.size_px()[0] as usize + x as usize];
        at(i % width, i / width).all(|p| place(p) != NO_FACE)
    });
    Picture {
        covered: covered.collect(),
        pixels: RgbImage::from_fn(width, height, |x, y| {
            let mut sum = [0u32; 3];
            for (x, y) in at(x, y) {
                sum.iter_mut().zip(pixels.get_pixel(x, y).0).for_each(|(s, c)| *s += u32::from(c));
            }
            let count = places * places;
            Rgb(sum.map(|s| ((s + count / 2) / count) as u8))
        }),
    }
}

/// Where a face has no image.
const GREY: [u8; 3] = [128; 3];

/// The image at `uv`, v down, 0 to 1 from border to border; between texel centres the four around are blended.
fn bilinear(image: &RgbImage, uv: DVec2) -> [u8; 3] {
    let [width, height] = [image.width(), image.height()];
    if width == 0 || height == 0 || !uv.is_finite() {
        return BACKGROUND;
    }
    // What ends at 1 is the border, what goes on past it repeats.
    let once = |c: f64| if (0.0..=1.0).contains(&c) { c } else { c - c.floor() };
    let at = DVec2::new(once(uv.x) * f64::from(width) - 0.5, once(uv.y) * f64::from(height) - 0.5);
    let low = at.floor();
    let part = at - low;
    let texel = |dx: f64, dy: f64| {
        let x = (low.x + dx).clamp(0.0, f64::from(width - 1)) as u32;
        let y = (low.y + dy).clamp(0.0, f64::from(height - 1)) as u32;
        image.get_pixel(x, y).0
    };
    let four = [texel(0.0, 0.0), texel(1.0, 0.0), texel(0.0, 1.0), texel(1.0, 1.0)];
    let weights = [(1.0 - part.x) * (1.0 - part.y), part.x * (1.0 - part.y), (1.0 - part.x) * part.y, part.x * part.y];
    std::array::from_fn(|c| {
        let sum: f64 = four.iter().zip(weights).map(|(texel, w)| f64::from(texel[c]) * w).sum();
        (sum + 0.5) as u8
    })
}

/// Peak signal to noise ratio over the pixels that both cover, decibels of sRGB values; infinite for equal pictures,
/// none where no pixel is covered by both or sizes differ.
pub fn psnr(a: &Picture, b: &Picture) -> Option<f64> {
    if a.pixels.dimensions() != b.pixels.dimensions() {
        return None;
    }
    let (mut squares, mut count) = (0u64, 0u64);
    for (i, (p, q)) in a.pixels.pixels().zip(b.pixels.pixels()).enumerate() {
        if a.covered[i] && b.covered[i] {
            squares += (0..3).map(|c| u64::from(p.0[c].abs_diff(q.0[c])).pow(2)).sum::<u64>();
            count += 3;
        }
    }
    (count > 0).then(|| 10.0 * (255.0f64.powi(2) * count as f64 / squares as f64).log10())
}

#[cfg(test)]
mod tests {
    use super::*;

    const FACES: [[u32; 3]; 2] = [[0, 1, 2], [0, 2, 3]];
    const UVS: [Vec2; 4] = [Vec2::new(0.0, 1.0), Vec2::ONE, Vec2::new(1.0, 0.0), Vec2::ZERO];

    /// A square of 10 m that shows the whole of an image, from above at `px` pixels a metre.
    fn square(image: &RgbImage, px: f64) -> Picture {
        let positions = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]].map(|[x, y]| DVec3::new(x, y, 0.0));
        let scene = Scene {
            positions: &positions,
            faces: &FACES,
            corner_uvs: &FACES.map(|f| f.map(|v| UVS[v as usize])),
            face_image: &[Some(0); 2],
            images: std::slice::from_ref(image),
        };
        let side = (12.0 * px) as u32;
        draw(&View::above_at(DVec3::new(-1.0, 11.0, 5.0), px, [side, side]), &scene)
    }

    /// Red grows to the right, green downwards.
    fn slopes() -> RgbImage {
        RgbImage::from_fn(10, 10, |x, y| Rgb([20 * x as u8, 20 * y as u8, 7]))
    }

    #[test]
    fn a_texel_is_seen_where_its_place_is() {
        let picture = square(&slopes(), 9.0);
        for (x, y) in [(0, 0), (3, 8), (9, 9), (9, 0)] {
            // The middle of the metre that the texel takes, after a metre of background.
            let found = picture.pixels.get_pixel(9 + 9 * x + 4, 9 + 9 * y + 4).0;
            let off = found[0].abs_diff(20 * x as u8).max(found[1].abs_diff(20 * y as u8));
            assert!(off <= 1 && found[2] == 7, "{x} {y}: {found:?}");
        }
        assert_eq!(picture.covered.iter().filter(|c| **c).count(), 90 * 90);
        assert_eq!(picture.pixels.get_pixel(2, 2).0, [255; 3]);
    }

    #[test]
    fn between_texels_colours_are_blended() {
        let picture = square(&slopes(), 9.0);
        // A third of a texel right of the centre of texel 4.
        assert_eq!(picture.pixels.get_pixel(9 + 36 + 4 + 3, 60).0[0], 87);
    }

    #[test]
    fn psnr_is_that_of_the_definition() {
        let (a, b) = (square(&slopes(), 5.0), square(&slopes(), 5.0));
        assert_eq!(psnr(&a, &b), Some(f64::INFINITY));
        let shifted = RgbImage::from_fn(10, 10, |x, y| Rgb([20 * x as u8, 20 * y as u8, 17]));
        // One channel of three is 10 off everywhere.
        let wanted = 10.0 * (255.0f64 * 255.0 * 3.0 / 100.0).log10();
        assert!((psnr(&a, &square(&shifted, 5.0)).unwrap() - wanted).abs() < 1e-9);
        assert_eq!(psnr(&a, &square(&slopes(), 6.0)), None);
        let nothing = Picture { covered: vec![false; a.covered.len()], ..b };
        assert_eq!(psnr(&a, &nothing), None);
    }
}
