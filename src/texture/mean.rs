//! One colour per face: what rules that look at colour go by.

use rayon::prelude::*;

use super::sample::Painter;
use super::{Images, Surface};

/// Where a face is looked at: its middle, and halfway from there to each corner.
const PLACES: [[f64; 3]; 4] = [
    [1.0 / 3.0; 3],
    [2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0],
    [1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0],
    [1.0 / 6.0, 1.0 / 6.0, 2.0 / 3.0],
];
/// Faces a task takes at once: a painter's start is worth that many.
const CHUNK: usize = 4096;

/// The mean sRGB colour of every face: of four points of its image, seen at half the size of a typical face, else of its
/// vertex colours, else of its material; empty where no face has any of the first two.
pub fn mean_colors(surface: &Surface, images: &Images) -> Vec<[u8; 3]> {
    let count = surface.faces.len();
    let has_image = (0..count).any(|f| surface.image(f).is_some());
    if !has_image && surface.vertex_colors.is_empty() {
        return Vec::new();
    }
    let area_m2: f64 = (0..count).map(|f| surface.area_m2(f)).sum();
    let texel_m = 0.5 * (area_m2 / count as f64).sqrt();
    let of_chunk = |chunk: usize| {
        let mut painter = Painter::new(*surface, images, texel_m);
        let faces = chunk * CHUNK..((chunk + 1) * CHUNK).min(count);
        let of_face = |f: usize| {
            let seen = PLACES.map(|weights| painter.color(f as u32, weights));
            std::array::from_fn(|c| ((seen.iter().map(|rgb| u32::from(rgb[c])).sum::<u32>() + 2) / 4) as u8)
        };
        faces.map(of_face).collect::<Vec<[u8; 3]>>()
    };
    (0..count.div_ceil(CHUNK)).into_par_iter().flat_map_iter(of_chunk).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::{DVec3, Vec2};
    use image::{Rgb, RgbImage};

    use super::*;
    use crate::input::{ImageRef, Material};
    use crate::report::Reporter;

    #[test]
    fn a_face_has_the_colour_of_its_part_of_the_image() {
        // Left half green, right half red.
        let image = RgbImage::from_fn(64, 64, |x, _| if x < 32 { Rgb([0, 200, 0]) } else { Rgb([200, 0, 0]) });
        let reporter = Reporter::new(true);
        let images = Images::new(vec![ImageRef::Pixels(Arc::new(image))], &reporter);
        let positions = [DVec3::ZERO, DVec3::X, DVec3::Y];
        let at = |x: f32| [Vec2::new(x, 0.1), Vec2::new(x + 0.3, 0.1), Vec2::new(x, 0.8)];
        let materials = [Material { name: String::new(), base_color: [9; 3], image: Some(0) }];
        let surface = Surface {
            positions: &positions,
            faces: &[[0, 1, 2], [0, 1, 2]],
            corner_uvs: &[at(0.05), at(0.6)],
            face_material: &[0, 0],
            vertex_colors: &[],
            materials: &materials,
        };
        let found = mean_colors(&surface, &images);
        assert!(found[0][1] > 190 && found[0][0] < 10 && found[1][0] > 190 && found[1][1] < 10, "{found:?}");
        let bare = Surface { corner_uvs: &[], ..surface };
        assert!(mean_colors(&bare, &images).is_empty(), "a material's colour alone is no texture");
    }
}
