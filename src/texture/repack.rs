//! Copies the source charts a tile uses into an atlas of its own, texel for texel.
//!
//! # Method
//! 1. Faces of one image joined by an edge with equal UVs on both sides are one chart.
//! 2. A chart takes its bounding rectangle, one texel more for bilinear filtering, and the gutter: all of it real
//!    source texels, repeated at the image's border (or wrapped, where the chart itself tiles).
//! 3. Rectangles of one image are merged where that costs no texels.
//! 4. Faces without an image share one block of texels per colour.
//! # Promises
//! Without scaling, every texel a face uses equals the source's: `a_repacked_tile_shows_the_source_texels`.
//! # Cost
//! Sorting of 3 edges a face and one copy of the texels.

use glam::{DVec2, Vec2};
use image::{Rgb, RgbImage};

use super::images::{Images, UV_SLACK, whole_images};
use super::pack::{Packing, fit};
use super::sample::bilinear;
use super::{Baked, GREY, Surface, TextureConfig, rms_texel_m};
use crate::{Error, Result};

/// Side of the block that holds one colour, texels: one GPU block.
const SOLID_PX: u32 = 4;
/// A chart that repeats its image more often than this is scaled down to this many repeats.
const MAX_REPEATS: f64 = 4.0;

/// Copies what `tile` uses of `images` into one atlas.
///
/// # Errors
/// [`Error::Config`] if the gutters of its charts alone do not fit into `max_atlas_px`.
pub fn repack(tile: &Surface, images: &Images, config: &TextureConfig) -> Result<Baked> {
    let charts = charts(tile, images);
    let windows = merged(windows(&charts));
    let solids = Solids::of(tile, images);
    // One rectangle per window and, last, one for all colours.
    let sizes = |scale: f64| {
        let mut sizes: Vec<_> = windows.iter().map(|w| w.size(scale, config.gutter_px)).collect();
        sizes.extend((!solids.colors.is_empty()).then(|| solids.size()));
        sizes
    };
    let Some((scale, sizes, packing)) = fit(config.max_atlas_px, config.power_of_two, sizes) else {
        return Err(no_room(windows.len(), config));
    };
    let mut atlas = RgbImage::from_pixel(packing.size[0], packing.size[1], Rgb(GREY));
    for ((window, &at), &size) in windows.iter().zip(&packing.at).zip(&sizes) {
        window.copy(images, scale, config.gutter_px, &mut atlas, at, size);
    }
    if let Some(&at) = packing.at.get(windows.len()) {
        solids.paint(&mut atlas, at);
    }
    let places = Places { charts: &charts, windows: &windows, solids: &solids, packing: &packing, scale };
    Ok(places.bake(tile, config.gutter_px, atlas))
}

/// The error of an atlas whose gutters leave no room.
pub(super) fn no_room(charts: usize, config: &TextureConfig) -> Error {
    Error::Config(format!(
        "{charts} charts with gutters of {} texels do not fit into an atlas of {} texels a side: \
         raise texture.max_atlas_px or lower texture.gutter_px",
        config.gutter_px, config.max_atlas_px
    ))
}

/// A connected piece of the source's texture.
struct Chart {
    image: u32,
    /// In texels of the image; the smallest corner lies in the first repeat.
    low: DVec2,
    high: DVec2,
    /// Subtracted from UVs.
    shift: DVec2,
    /// Size of the image, texels.
    size: DVec2,
}

struct Charts {
    charts: Vec<Chart>,
    /// Per face; `u32::MAX` for faces without an image.
    of_face: Vec<u32>,
}

fn charts(tile: &Surface, images: &Images) -> Charts {
    let image: Vec<Option<u32>> =
        (0..tile.faces.len()).map(|f| tile.image(f).filter(|&i| (i as usize) < images.len())).collect();
    let mut parent: Vec<u32> = (0..tile.faces.len() as u32).collect();
    let mut edges = Vec::with_capacity(tile.faces.len() * 3);
    for (f, face) in tile.faces.iter().enumerate() {
        let Some(image) = image[f] else { continue };
        for corner in 0..3 {
            let ends = [corner, (corner + 1) % 3].map(|c| (face[c], uv_bits(tile.corner_uvs[f][c])));
            edges.push((image, ends[0].min(ends[1]), ends[0].max(ends[1]), f as u32));
        }
    }
    edges.sort_unstable();
    for pair in edges.windows(2) {
        if (pair[0].0, pair[0].1, pair[0].2) == (pair[1].0, pair[1].1, pair[1].2) {
            let (a, b) = (root(&mut parent, pair[0].3), root(&mut parent, pair[1].3));
            parent[a.max(b) as usize] = a.min(b);
        }
    }
    let mut charts: Vec<(u32, DVec2, DVec2)> = Vec::new();
    let mut of_face = vec![u32::MAX; tile.faces.len()];
    for f in 0..tile.faces.len() {
        let Some(image) = image[f] else { continue };
        let root = root(&mut parent, f as u32) as usize;
        // Roots are the smallest face of their chart, so they come first.
        if root == f {
            of_face[f] = charts.len() as u32;
            charts.push((image, DVec2::INFINITY, DVec2::NEG_INFINITY));
        }
        of_face[f] = of_face[root];
        let (_, low, high) = &mut charts[of_face[f] as usize];
        for uv in tile.corner_uvs[f] {
            (*low, *high) = (low.min(uv.as_dvec2()), high.max(uv.as_dvec2()));
        }
    }
    let chart = |(image, low, high): (u32, DVec2, DVec2)| {
        let [width, height] = images.dimensions(image);
        let size = DVec2::new(width.into(), height.into());
        let shift = DVec2::new(whole_images(low.x, high.x), whole_images(low.y, high.y));
        Chart { image, low: (low - shift) * size, high: (high - shift) * size, shift, size }
    };
    Charts { charts: charts.into_iter().map(chart).collect(), of_face }
}

/// Bits that order UVs and tell them apart, with one zero.
fn uv_bits(uv: Vec2) -> [u32; 2] {
    [(uv.x + 0.0).to_bits(), (uv.y + 0.0).to_bits()]
}

fn root(parent: &mut [u32], mut f: u32) -> u32 {
    while parent[f as usize] != f {
        parent[f as usize] = parent[parent[f as usize] as usize];
        f = parent[f as usize];
    }
    f
}

/// A rectangle of an image that is copied as a whole.
#[derive(Debug, Clone)]
struct Window {
    image: u32,
    /// Texels of the image, bilinear border included; may reach beyond the image.
    low: [i64; 2],
    high: [i64; 2],
    /// Below 1 for charts that repeat too often.
    scale: DVec2,
    wrap: [bool; 2],
    charts: Vec<u32>,
}

fn windows(charts: &Charts) -> Vec<Window> {
    let window = |(id, chart): (usize, &Chart)| {
        let repeats = chart.high / chart.size;
        Window {
            image: chart.image,
            // A bilinear sample at x reads the texels of x - 1/2 and x + 1/2.
            low: [chart.low.x, chart.low.y].map(|x| (x - 0.5).floor() as i64),
            high: [chart.high.x, chart.high.y].map(|x| (x + 0.5).ceil() as i64),
            scale: (MAX_REPEATS / repeats.max(DVec2::splat(1e-9))).min(DVec2::ONE),
            wrap: [repeats.x > 1.0 + UV_SLACK, repeats.y > 1.0 + UV_SLACK],
            charts: vec![id as u32],
        }
    };
    charts.charts.iter().enumerate().map(window).collect()
}

/// Merges overlapping windows of one image where the union has no more texels than the two.
fn merged(mut windows: Vec<Window>) -> Vec<Window> {
    // Each pass merges what overlaps; unions may overlap anew. Far fewer passes are needed in practice.
    const MAX_PASSES: u32 = 16;
    for _ in 0..MAX_PASSES {
        let before = windows.len();
        windows.sort_by_key(|w| (w.image, w.low[0], w.low[1], w.charts[0]));
        for i in 0..windows.len() {
            for j in i + 1..windows.len() {
                let (head, tail) = windows.split_at_mut(j);
                let (a, b) = (&mut head[i], &mut tail[0]);
                if b.image != a.image || b.low[0] > a.high[0] {
                    break;
                }
                a.absorb(b);
            }
        }
        windows.retain(|w| !w.charts.is_empty());
        if windows.len() == before {
            break;
        }
    }
    windows.sort_by_key(|w| w.charts[0]);
    windows
}

impl Window {
    /// Takes over the charts of `other` if that costs no texels; `other` is then without charts.
    fn absorb(&mut self, other: &mut Window) {
        let plain = |w: &Window| w.scale == DVec2::ONE && w.wrap == [false; 2] && !w.charts.is_empty();
        if !plain(self) || !plain(other) {
            return;
        }
        let low = [0, 1].map(|i| self.low[i].min(other.low[i]));
        let high = [0, 1].map(|i| self.high[i].max(other.high[i]));
        let area = |low: [i64; 2], high: [i64; 2]| (high[0] - low[0]) * (high[1] - low[1]);
        if area(low, high) <= area(self.low, self.high) + area(other.low, other.high) {
            (self.low, self.high) = (low, high);
            self.charts.append(&mut other.charts);
            self.charts.sort_unstable();
        }
    }

    fn size(&self, scale: f64, gutter_px: u32) -> [u32; 2] {
        [0, 1].map(|i| {
            let texels = (self.high[i] - self.low[i]) as f64 * self.scale[i] * scale;
            (texels.ceil() as u32).max(1).saturating_add(2 * gutter_px)
        })
    }

    /// Fills the rectangle of the atlas at `at`.
    fn copy(&self, images: &Images, scale: f64, gutter_px: u32, atlas: &mut RgbImage, at: [u32; 2], size: [u32; 2]) {
        let scale = self.scale * scale;
        if scale != DVec2::ONE {
            return self.resample(images, scale, gutter_px, atlas, at, size);
        }
        let source = images.mip(self.image, 0);
        let sides = [source.width(), source.height()].map(i64::from);
        let inside = |axis: usize, px: u32| {
            let x = self.low[axis] - i64::from(gutter_px) + i64::from(px);
            (if self.wrap[axis] { x.rem_euclid(sides[axis]) } else { x.clamp(0, sides[axis] - 1) }) as u32
        };
        let columns: Vec<u32> = (0..size[0]).map(|x| inside(0, x)).collect();
        for y in 0..size[1] {
            let row = inside(1, y);
            for (x, &column) in (at[0]..).zip(&columns) {
                atlas.put_pixel(x, at[1] + y, *source.get_pixel(column, row));
            }
        }
    }

    fn resample(&self, images: &Images, scale: DVec2, gutter: u32, atlas: &mut RgbImage, at: [u32; 2], size: [u32; 2]) {
        // The level whose texels are nearest in size to the atlas', by the finer axis.
        let level = (-scale.max_element().log2()).round().max(0.0) as u32;
        let source = images.mip(self.image, level);
        let per_level = 1.0 / f64::from(1_u32 << level.min(31));
        let low = DVec2::new(self.low[0] as f64, self.low[1] as f64);
        for y in 0..size[1] {
            for x in 0..size[0] {
                let inner = DVec2::new(f64::from(x), f64::from(y)) + 0.5 - f64::from(gutter);
                let color = bilinear(&source, None, (low + inner / scale) * per_level, self.wrap);
                atlas.put_pixel(at[0] + x, at[1] + y, Rgb(color));
            }
        }
    }
}

/// The colours of faces without an image, in one grid of blocks.
struct Solids {
    /// Sorted, no two alike.
    colors: Vec<[u8; 3]>,
    /// Per face, index into `colors`; `u32::MAX` for faces with an image.
    of_face: Vec<u32>,
}

impl Solids {
    fn of(tile: &Surface, images: &Images) -> Self {
        let color = |f: usize| {
            let painted = tile.image(f).is_some_and(|i| (i as usize) < images.len());
            (!painted).then(|| tile.solid_color(f))
        };
        let of_face: Vec<_> = (0..tile.faces.len()).map(color).collect();
        let mut colors: Vec<_> = of_face.iter().flatten().copied().collect();
        colors.sort_unstable();
        colors.dedup();
        let index = |c: &Option<[u8; 3]>| c.and_then(|c| colors.binary_search(&c).ok()).map_or(u32::MAX, |i| i as u32);
        let of_face = of_face.iter().map(index).collect();
        Self { colors, of_face }
    }

    fn columns(&self) -> u32 {
        ((self.colors.len() as f64).sqrt().ceil() as u32).max(1)
    }

    fn size(&self) -> [u32; 2] {
        [self.columns(), (self.colors.len() as u32).div_ceil(self.columns())].map(|n| n * SOLID_PX)
    }

    fn at(&self, color: u32) -> [u32; 2] {
        [color % self.columns() * SOLID_PX, color / self.columns() * SOLID_PX]
    }

    fn paint(&self, atlas: &mut RgbImage, at: [u32; 2]) {
        for (i, &color) in self.colors.iter().enumerate() {
            let block = self.at(i as u32);
            for y in 0..SOLID_PX {
                for x in 0..SOLID_PX {
                    atlas.put_pixel(at[0] + block[0] + x, at[1] + block[1] + y, Rgb(color));
                }
            }
        }
    }
}

/// Where each face's texels went.
struct Places<'a> {
    charts: &'a Charts,
    windows: &'a [Window],
    solids: &'a Solids,
    packing: &'a Packing,
    scale: f64,
}

impl Places<'_> {
    fn bake(&self, tile: &Surface, gutter_px: u32, atlas: RgbImage) -> Baked {
        let mut window_of_chart = vec![0; self.charts.charts.len()];
        for (w, window) in self.windows.iter().enumerate() {
            window.charts.iter().for_each(|&chart| window_of_chart[chart as usize] = w);
        }
        let place = |x: &[u32; 2]| DVec2::new(x[0].into(), x[1].into());
        let atlas_size = place(&self.packing.size);
        let mut sizes = Vec::new();
        let mut corner_uvs = Vec::with_capacity(tile.faces.len());
        for f in 0..tile.faces.len() {
            let Some(chart) = self.charts.charts.get(self.charts.of_face[f] as usize) else {
                let block = self.solids.at(self.solids.of_face[f]);
                let at = place(&self.packing.at[self.windows.len()]) + place(&block) + f64::from(SOLID_PX) / 2.0;
                corner_uvs.push([(at / atlas_size).as_vec2(); 3]);
                continue;
            };
            let w = window_of_chart[self.charts.of_face[f] as usize];
            let window = &self.windows[w];
            let low = DVec2::new(window.low[0] as f64, window.low[1] as f64);
            let origin = place(&self.packing.at[w]) + f64::from(gutter_px);
            let texels = tile.corner_uvs[f].map(|uv| {
                let source = (uv.as_dvec2() - chart.shift) * chart.size;
                origin + (source - low) * window.scale * self.scale
            });
            sizes.push((tile.area_m2(f), (texels[1] - texels[0]).perp_dot(texels[2] - texels[0]).abs() / 2.0));
            corner_uvs.push(texels.map(|at| (at / atlas_size).as_vec2()));
        }
        Baked { corner_uvs, atlas, texel_m: rms_texel_m(&sizes) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::{ImageRef, Material};
    use crate::report::Reporter;
    use glam::DVec3;
    use proptest::prelude::*;
    use std::sync::Arc;

    const SIDE: f32 = 64.0;

    fn noise() -> RgbImage {
        RgbImage::from_fn(64, 64, |x, y| {
            let mix = (x.wrapping_mul(73_856_093) ^ y.wrapping_mul(19_349_663)).wrapping_mul(2_654_435_761);
            Rgb([(mix >> 8) as u8, (mix >> 16) as u8, (mix >> 24) as u8])
        })
    }

    fn textured() -> Vec<Material> {
        vec![Material { name: "wall".into(), base_color: [1, 2, 3], image: Some(0) }]
    }

    fn uv(x: f32, y: f32) -> Vec2 {
        Vec2::new(x, y) / SIDE
    }

    /// A unit square of two faces.
    const SQUARE: [DVec3; 4] = [DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y];
    const HALVES: [[u32; 3]; 2] = [[0, 1, 2], [0, 2, 3]];

    fn repack_uvs(uvs: &[[Vec2; 3]], config: &TextureConfig) -> Baked {
        let reporter = Reporter::new(true);
        let images = Images::new(vec![ImageRef::Pixels(Arc::new(noise()))], &reporter);
        let materials = textured();
        let tile = Surface {
            positions: &SQUARE,
            faces: &HALVES[..uvs.len()],
            corner_uvs: uvs,
            face_material: &[0, 0][..uvs.len()],
            materials: &materials,
            ..Default::default()
        };
        repack(&tile, &images, config).unwrap()
    }

    /// The bilinear sample of the atlas at a point of face `f`, and that of the source, wrapped or not.
    fn both(
        source: &RgbImage,
        baked: &Baked,
        uvs: &[[Vec2; 3]],
        f: usize,
        weights: [f64; 3],
        wrap: bool,
    ) -> ([u8; 3], [u8; 3]) {
        let at = |uvs: &[Vec2; 3], width: u32, height: u32| {
            let at = uvs[0].as_dvec2() * weights[0] + uvs[1].as_dvec2() * weights[1] + uvs[2].as_dvec2() * weights[2];
            at * DVec2::new(width.into(), height.into())
        };
        let atlas = bilinear(
            &baked.atlas,
            None,
            at(&baked.corner_uvs[f], baked.atlas.width(), baked.atlas.height()),
            [false; 2],
        );
        (atlas, bilinear(source, None, at(&uvs[f], 64, 64), [wrap; 2]))
    }

    fn assert_alike(baked: &Baked, uvs: &[[Vec2; 3]], wrap: bool) {
        let image = noise();
        for f in 0..uvs.len() {
            for i in 0..=16 {
                for j in 0..=16 - i {
                    let weights = [f64::from(i) / 16.0, f64::from(j) / 16.0, f64::from(16 - i - j) / 16.0];
                    let (atlas, source) = both(&image, baked, uvs, f, weights, wrap);
                    // Rounding of f32 UVs may move a sample by 1/256 of the step between two texels.
                    let far = (0..3).map(|c| atlas[c].abs_diff(source[c])).max().unwrap();
                    assert!(far <= 3, "face {f} at {weights:?}: {atlas:?}, wanted {source:?}");
                }
            }
        }
    }

    proptest! {
        #[test]
        fn a_repacked_tile_shows_the_source_texels(c in prop::array::uniform12(0.0..64.0_f32)) {
            let uvs = [[uv(c[0], c[1]), uv(c[2], c[3]), uv(c[4], c[5])], [uv(c[6], c[7]), uv(c[8], c[9]), uv(c[10], c[11])]];
            assert_alike(&repack_uvs(&uvs, &TextureConfig::default()), &uvs, false);
        }
    }

    #[test]
    fn texels_are_copied_bit_for_bit_with_their_real_neighbors() {
        let uvs = [[uv(10.0, 10.0), uv(20.0, 10.0), uv(20.0, 20.0)], [uv(40.0, 30.0), uv(50.0, 40.0), uv(40.0, 40.0)]];
        let baked = repack_uvs(&uvs, &TextureConfig::default());
        // Two charts of 10 texels, one more for bilinear on each side and 2 of gutter: 16 × 16 each.
        assert_eq!(baked.atlas.dimensions().0 * baked.atlas.dimensions().1, 2 * 16 * 16);
        for (f, low) in [(0, [10, 10]), (1, [40, 30])] {
            let corner = baked.corner_uvs[f].iter().fold(Vec2::INFINITY, |low, uv| low.min(*uv));
            let x = (corner.x * baked.atlas.width() as f32).round() as u32 - 3;
            let y = (corner.y * baked.atlas.height() as f32).round() as u32 - 3;
            for (dx, dy) in (0..16).flat_map(|dy| (0..16).map(move |dx| (dx, dy))) {
                let source = *noise().get_pixel(low[0] - 3 + dx, low[1] - 3 + dy);
                assert_eq!(*baked.atlas.get_pixel(x + dx, y + dy), source);
            }
        }
    }

    #[test]
    fn a_chart_at_the_border_of_the_image_repeats_the_border() {
        let uvs = [[uv(0.0, 0.0), uv(64.0, 0.0), uv(64.0, 64.0)], [uv(0.0, 0.0), uv(64.0, 64.0), uv(0.0, 64.0)]];
        let baked = repack_uvs(&uvs, &TextureConfig::default());
        assert_alike(&baked, &uvs, false);
        assert_eq!(baked.atlas.dimensions(), (72, 72));
        assert!((baked.texel_m - 1.0 / 64.0).abs() < 1e-6);
    }

    #[test]
    fn a_tiling_chart_is_wrapped_wherever_it_lies() {
        for (u, v) in [(-2.0, 7.0), (0.0, 0.0), (0.5, -0.25)] {
            let at = |x: f32, y: f32| Vec2::new(u + x, v + y);
            let uvs = [[at(0.0, 0.0), at(2.5, 0.0), at(2.5, 1.5)], [at(0.0, 0.0), at(2.5, 1.5), at(0.0, 1.5)]];
            assert_alike(&repack_uvs(&uvs, &TextureConfig::default()), &uvs, true);
        }
    }

    #[test]
    fn a_chart_of_many_repeats_is_scaled_to_four() {
        let uvs = [[Vec2::ZERO, Vec2::new(100.0, 0.0), Vec2::new(100.0, 0.5)]];
        let baked = repack_uvs(&uvs, &TextureConfig::default());
        assert!(baked.atlas.width() <= 4 * 64 + 8, "{:?}", baked.atlas.dimensions());
    }

    #[test]
    fn what_does_not_fit_is_scaled_and_says_so() {
        let uvs = [[uv(0.0, 0.0), uv(64.0, 0.0), uv(64.0, 64.0)], [uv(0.0, 0.0), uv(64.0, 64.0), uv(0.0, 64.0)]];
        let baked = repack_uvs(&uvs, &TextureConfig { max_atlas_px: 40, ..Default::default() });
        assert!(baked.atlas.width() <= 40 && baked.texel_m > 1.0 / 36.0, "{}", baked.texel_m);
    }

    #[test]
    fn overlapping_charts_share_their_texels() {
        let face = [uv(5.0, 5.0), uv(45.0, 5.0), uv(45.0, 45.0)];
        let twin = repack_uvs(&[face, face.map(|uv| uv + 0.01)], &TextureConfig::default());
        let single = repack_uvs(&[face], &TextureConfig::default());
        assert!(twin.atlas.width() <= single.atlas.width() + 4);
    }

    #[test]
    fn nonsense_uvs_are_painted_with_the_base_color() {
        let baked =
            repack_uvs(&[[Vec2::NAN, Vec2::ZERO, Vec2::ONE], [Vec2::splat(1e30); 3]], &TextureConfig::default());
        assert_eq!(baked.atlas.get_pixel(0, 0), &Rgb([1, 2, 3]));
        assert_eq!(baked.texel_m, 0.0);
    }

    #[test]
    fn degenerate_uvs_and_empty_tiles_are_no_trouble() {
        let baked = repack_uvs(&[[uv(3.3, 4.4); 3], [uv(64.0, 64.0); 3]], &TextureConfig::default());
        assert!(baked.texel_m > 0.0);
        let empty = repack_uvs(&[], &TextureConfig { power_of_two: true, ..Default::default() });
        assert_eq!(empty.atlas.dimensions(), (4, 4));
    }

    #[test]
    fn faces_without_an_image_get_their_color() {
        let reporter = Reporter::new(true);
        let images = Images::new(Vec::new(), &reporter);
        let red = Material { name: "red".into(), base_color: [200, 0, 0], image: None };
        // An image index that does not exist counts as none.
        let blue = Material { name: "blue".into(), base_color: [0, 0, 200], image: Some(7) };
        let materials = [red, blue];
        let uvs = [[Vec2::ZERO; 3]; 2];
        let mut tile = Surface {
            positions: &SQUARE,
            faces: &HALVES,
            corner_uvs: &uvs,
            face_material: &[0, 1],
            materials: &materials,
            ..Default::default()
        };
        let seen = |baked: &Baked| {
            let (width, height) = baked.atlas.dimensions();
            [0, 1].map(|f| {
                let uv = baked.corner_uvs[f][0];
                baked.atlas.get_pixel((uv.x * width as f32) as u32, (uv.y * height as f32) as u32).0
            })
        };
        let config = TextureConfig::default();
        assert_eq!(seen(&repack(&tile, &images, &config).unwrap()), [[200, 0, 0], [0, 0, 200]]);
        tile.vertex_colors = &[[0; 3], [30; 3], [60; 3], [90; 3]];
        assert_eq!(seen(&repack(&tile, &images, &config).unwrap()), [[30; 3], [50; 3]]);
    }
}
