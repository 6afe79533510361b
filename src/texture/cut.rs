//! Paints a cut of a whole mesh: one atlas, baked from the source, with texels as small as the cut is worth.
//!
//! # Method
//! 1. Measure how far the cut's faces are from the source, at the centres of their quarters.
//! 2. A texel is a sixteenth of the distance that 95 % of the area keep, but no smaller than the source's texels: all
//!    but the worst of the surface then deserves them, and one spike does not blur the rest.
//! 3. [`bake`](super::bake()): new charts, texels sampled anew, searched for as far out as the cut was seen to be. No
//!    texture coordinate is carried through a collapse, so nothing is smeared.
//! # Limits
//! One atlas: what does not fit into [`TextureConfig::max_atlas_px`] gets larger texels.

use glam::DVec3;
use rayon::prelude::*;

use super::{BakeSource, Baked, Images, Surface, TextureConfig, bake};
use crate::Result;
use crate::geo::bvh::Bvh;

/// Texels to a deviation: as a viewer of tiles swaps them at 16 pixels of error.
const TEXELS_PER_DEVIATION: f64 = 16.0;
/// This share of the area keeps the distance that sets the texel.
const AREA_SHARE: f64 = 0.95;
/// Searched this much further than the largest distance measured, which is a sample.
const REACH: f64 = 1.5;

/// Gives `cut` an atlas with the look of `source`. Of `cut` only positions and faces matter.
///
/// # Errors
/// [`Error::Config`](crate::Error::Config) if the gutters of its charts alone do not fit into `max_atlas_px`.
pub fn paint_cut(cut: &Surface, source: &Surface, images: &Images, config: &TextureConfig) -> Result<Baked> {
    let tree = Bvh::new(source.positions, source.faces);
    let (most_m, furthest_m) = deviation(cut, &tree);
    let texel_m = (most_m / TEXELS_PER_DEVIATION).max(source.texel_m(images));
    let search_texels = if texel_m > 0.0 { config.search_texels.max(REACH * furthest_m / texel_m) } else { 1.0 };
    let config = TextureConfig { search_texels, ..config.clone() };
    bake(cut, &BakeSource { surface: *source, bvh: &tree }, images, texel_m, &config)
}

/// The distance from the source that [`AREA_SHARE`] of the cut keeps, and the largest seen, metres.
fn deviation(cut: &Surface, tree: &Bvh) -> (f64, f64) {
    let far = |p: DVec3| tree.closest(p, f64::INFINITY).map_or(0.0, |hit| hit.distance);
    let of_face = |f: usize| {
        let [a, b, c] = cut.corners(f);
        let center = (a + b + c) / 3.0;
        let quarter = cut.area_m2(f) / 4.0;
        [center, (center + a) / 2.0, (center + b) / 2.0, (center + c) / 2.0].map(|p| (far(p), quarter))
    };
    let mut all: Vec<(f64, f64)> = (0..cut.faces.len()).into_par_iter().flat_map_iter(of_face).collect();
    all.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let total: f64 = all.iter().map(|s| s.1).sum();
    let mut reached = 0.0;
    let most = all.iter().find(|s| {
        reached += s.1;
        reached >= AREA_SHARE * total
    });
    let furthest_m = all.last().map_or(0.0, |s| s.0);
    (most.map_or(furthest_m, |s| s.0), furthest_m)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::Vec2;
    use image::{Rgb, RgbImage};

    use super::*;
    use crate::input::{ImageRef, Material};
    use crate::report::Reporter;

    /// A square of 8 m, in two triangles, at height `z`.
    fn square(z: f64) -> [DVec3; 4] {
        [[0.0, 0.0], [8.0, 0.0], [8.0, 8.0], [0.0, 8.0]].map(|[x, y]| DVec3::new(x, y, z))
    }

    const FACES: [[u32; 3]; 2] = [[0, 1, 2], [0, 2, 3]];

    fn paint(height_m: f64, config: &TextureConfig) -> Baked {
        let reporter = Reporter::new(true);
        let picture = RgbImage::from_fn(64, 64, |x, _| if x < 32 { Rgb([200, 20, 20]) } else { Rgb([20, 20, 200]) });
        let images = Images::new(vec![ImageRef::Pixels(Arc::new(picture))], &reporter);
        let materials = [Material { name: "m".into(), base_color: [1; 3], image: Some(0) }];
        let positions = square(0.0);
        let corner_uvs = FACES
            .map(|f| f.map(|v| positions[v as usize]).map(|p| Vec2::new(p.x as f32 / 8.0, 1.0 - p.y as f32 / 8.0)));
        let source = Surface {
            positions: &positions,
            faces: &FACES,
            corner_uvs: &corner_uvs,
            face_material: &[0; 2],
            vertex_colors: &[],
            materials: &materials,
        };
        let cut = Surface { positions: &square(height_m), faces: &FACES, ..Surface::default() };
        paint_cut(&cut, &source, &images, config).unwrap()
    }

    #[test]
    fn texels_are_as_small_as_the_source_or_a_sixteenth_of_the_deviation() {
        let config = TextureConfig::default();
        assert!((paint(0.0, &config).texel_m - 0.125).abs() < 1e-9);
        assert!((paint(8.0, &config).texel_m - 0.5).abs() < 1e-9);
        let small = paint(0.0, &TextureConfig { max_atlas_px: 20, ..config });
        assert!(small.texel_m > 0.45 && small.atlas.width() <= 20, "{}", small.texel_m);
    }

    #[test]
    fn the_source_is_found_however_far_off_the_cut_is() {
        // 0.5 m of texel: the usual search would end after 12 m in depth, and 40 m at 16 texels is 2.5 m.
        for height_m in [0.3, 8.0, 40.0] {
            let baked = paint(height_m, &TextureConfig { search_texels: 1.0, ..TextureConfig::default() });
            let mut found = baked.atlas.pixels().map(|p| p.0).collect::<Vec<_>>();
            found.sort_unstable();
            found.dedup();
            assert!(found.contains(&[200, 20, 20]) && found.contains(&[20, 20, 200]), "{height_m}: {found:?}");
        }
    }
}
