//! Paints a simplified tile anew, with texels sampled from the source surface.
//!
//! # Method
//! 1. Cut the tile into charts (`chart`) and pack them; if they do not fit, texels grow.
//! 2. Chart by chart, in blocks: draw the tile's faces, which gives each texel a depth along the chart's normal.
//! 3. Draw the source's faces near the block the same way; each texel keeps the one nearest in depth, among those
//!    that face the chart.
//! 4. Sample the kept face at the mip whose texels are as large as the atlas'.
//! 5. Texels without one take the closest point of the source surface.
//! 6. Grow colours into the gutters, then everywhere.
//! # Promises
//! No texel shows what the source mesh does not use: `no_background_shines_through`.
//! # Cost
//! Source faces are set up once per block they touch; memory is one block of 240² texels and the atlas.

use glam::{DVec2, DVec3};
use image::{Rgb, RgbImage};

use super::chart::{Chart, charts};
use super::images::Images;
use super::mask::{Mask, fill, mean};
use super::pack::fit;
use super::raster::{Barycentric, ceil, centers, floor};
use super::repack::no_room;
use super::sample::Painter;
use super::{Baked, GREY, Surface, TextureConfig, rms_texel_m};
use crate::Result;
use crate::geo::bvh::Bvh;

/// Side of a block, samples: its buffers stay in the cache, and 1 to 4 samples a texel divide it.
const BLOCK: u32 = 240;
/// A centre on an edge belongs to the face on either side, whatever the rounding, texels.
const EDGE_PX: f64 = 1e-7;
/// Source faces whose normal is further from the chart's are not seen from there: squared cosine of 78.5°.
const MIN_FACING_SQUARED: f64 = 0.04;
/// No texel is smaller, metres.
const SMALLEST_TEXEL_M: f64 = 1e-6;

/// What a tile is painted from.
#[derive(Clone, Copy)]
pub struct BakeSource<'a> {
    /// The surface as it was before simplification, or a finer level.
    pub surface: Surface<'a>,
    /// Of the surface's positions and faces.
    pub bvh: &'a Bvh,
}

/// Gives the tile new charts of about `texel_m` metres a texel and paints them from `source`.
///
/// Of `tile` only positions and faces matter. [`Baked::texel_m`] is what was achieved: more than asked for where faces
/// lean against their chart or the atlas would not fit.
///
/// # Errors
/// [`Error::Config`](crate::Error::Config) if the gutters of its charts alone do not fit into `max_atlas_px`.
pub fn bake(
    tile: &Surface,
    source: &BakeSource,
    images: &Images,
    texel_m: f64,
    config: &TextureConfig,
) -> Result<Baked> {
    let area_m2: f64 = (0..tile.faces.len()).map(|f| tile.area_m2(f)).sum();
    // Finer than this cannot fit however it is packed.
    let finest_m = area_m2.sqrt() / f64::from(config.max_atlas_px);
    let wanted_m = texel_m.max(finest_m).max(SMALLEST_TEXEL_M);
    let charts = charts(tile.positions, tile.faces, wanted_m, config.chart_angle_deg);
    let sizes = |scale: f64| {
        let size = |chart: &Chart| inner_px(chart, wanted_m / scale).map(|px| px.saturating_add(2 * config.gutter_px));
        charts.iter().map(size).collect()
    };
    let Some((scale, _, packing)) = fit(config.max_atlas_px, config.power_of_two, sizes) else {
        return Err(no_room(charts.len(), config));
    };
    let texel_m = wanted_m / scale;
    let mut baker = Baker {
        tile,
        source,
        texel_m,
        samples: config.samples.max(1),
        search_m: config.search_texels * texel_m,
        painter: Painter::new(source.surface, images, texel_m / f64::from(config.samples.max(1))),
        block: Block::default(),
        atlas: RgbImage::new(packing.size[0], packing.size[1]),
        painted: Mask::new(packing.size[0], packing.size[1]),
    };
    let inside = |at: [u32; 2]| at.map(|x| x + config.gutter_px);
    for (chart, &at) in charts.iter().zip(&packing.at) {
        baker.paint_chart(chart, inside(at));
    }
    let Baker { mut atlas, mut painted, .. } = baker;
    painted.dilate(&mut atlas, config.gutter_px);
    fill(&mut atlas, &painted);
    let origins: Vec<_> = packing.at.iter().map(|&at| inside(at)).collect();
    Ok(place(tile, &charts, &origins, texel_m, atlas))
}

/// Texels of a chart without gutters.
fn inner_px(chart: &Chart, texel_m: f64) -> [u32; 2] {
    let size = (chart.high - chart.low) / texel_m;
    [size.x, size.y].map(|s| (s.ceil() as u32).max(1))
}

fn place(tile: &Surface, charts: &[Chart], origins: &[[u32; 2]], texel_m: f64, atlas: RgbImage) -> Baked {
    let size = DVec2::new(atlas.width().into(), atlas.height().into());
    let mut corner_uvs = vec![Default::default(); tile.faces.len()];
    let mut areas = vec![(0.0, 0.0); tile.faces.len()];
    for (chart, &origin) in charts.iter().zip(origins) {
        let origin = DVec2::new(origin[0].into(), origin[1].into());
        for &f in &chart.faces {
            let at = tile.corners(f as usize).map(|p| (chart.project(p) - chart.low) / texel_m + origin);
            areas[f as usize] = (tile.area_m2(f as usize), (at[1] - at[0]).perp_dot(at[2] - at[0]).abs() / 2.0);
            corner_uvs[f as usize] = at.map(|at| (at / size).as_vec2());
        }
    }
    Baked { corner_uvs, atlas, texel_m: rms_texel_m(&areas) }
}

struct Baker<'a> {
    tile: &'a Surface<'a>,
    source: &'a BakeSource<'a>,
    texel_m: f64,
    /// Per texel and axis.
    samples: u32,
    search_m: f64,
    painter: Painter<'a>,
    block: Block,
    atlas: RgbImage,
    painted: Mask,
}

impl Baker<'_> {
    /// Paints the texels of a chart whose inner top-left texel is at `at`.
    fn paint_chart(&mut self, chart: &Chart, at: [u32; 2]) {
        let view = View::of(chart, self.texel_m / f64::from(self.samples));
        let size = inner_px(chart, self.texel_m).map(|px| px * self.samples);
        let blocks_wide = size[0].div_ceil(BLOCK);
        let mut painted = 0;
        let bins = self.bins(chart, &view, size);
        for bin in bins.chunk_by(|a, b| a.0 == b.0) {
            let low = [bin[0].0 % blocks_wide * BLOCK, bin[0].0 / blocks_wide * BLOCK];
            let extent = [0, 1].map(|i| (size[i] - low[i]).min(BLOCK));
            let view = view.moved(low);
            let Some(range) = self.block.draw_tile(self.tile, bin.iter().map(|b| b.1), &view, extent) else { continue };
            self.block.find_source(self.source, &view, range, self.search_m);
            painted += self.shade(&view, [0, 1].map(|i| at[i] + low[i] / self.samples));
        }
        if painted == 0 {
            self.paint_lost_chart(chart, at);
        }
    }

    /// The faces of each block, sorted by block.
    fn bins(&self, chart: &Chart, view: &View, size: [u32; 2]) -> Vec<(u32, u32)> {
        let last = size.map(|s| (s - 1) / BLOCK);
        let mut bins = Vec::with_capacity(chart.faces.len());
        for &f in &chart.faces {
            let tri = self.tile.corners(f as usize).map(|p| view.pixel(p));
            // Blocks by the face's bounding box; casts saturate at 0.
            let low = (tri[0].min(tri[1]).min(tri[2]) - 1.0) / f64::from(BLOCK);
            let high = (tri[0].max(tri[1]).max(tri[2]) + 1.0) / f64::from(BLOCK);
            for y in low.y as u32..=(high.y as u32).min(last[1]) {
                for x in low.x as u32..=(high.x as u32).min(last[0]) {
                    bins.push((y * (last[0] + 1) + x, f));
                }
            }
        }
        // Stable: inside a block the chart's order decides who owns a texel on an edge.
        bins.sort_by_key(|bin| bin.0);
        bins
    }

    /// Colours the block's texels into the atlas at `at`; returns how many.
    fn shade(&mut self, view: &View, at: [u32; 2]) -> u32 {
        let s = self.samples;
        let mut painted = 0;
        let mut last = (u32::MAX, Barycentric::default());
        let mut found = Vec::with_capacity((s * s) as usize);
        for y in 0..self.block.size[1] / s {
            for x in 0..self.block.size[0] / s {
                found.clear();
                for sample in 0..s * s {
                    let (x, y) = (x * s + sample % s, y * s + sample / s);
                    found.extend(self.sample(view, x, y, &mut last));
                }
                let color = match found[..] {
                    [] => continue,
                    [color] => color,
                    _ => mean(found.iter().map(|&c| (c, 1))).map_or(GREY, |(color, _)| color),
                };
                self.atlas.put_pixel(at[0] + x, at[1] + y, Rgb(color));
                self.painted.set(at[0] + x, at[1] + y);
                painted += 1;
            }
        }
        painted
    }

    fn sample(&mut self, view: &View, x: u32, y: u32, last: &mut (u32, Barycentric)) -> Option<[u8; 3]> {
        let i = (y * self.block.size[0] + x) as usize;
        let depth = self.block.depth[i];
        if depth.is_nan() {
            return None;
        }
        let center = DVec2::new(f64::from(x), f64::from(y)) + 0.5;
        let face = self.block.face[i];
        if face == NONE {
            let hit = self.source.bvh.closest(view.point(center, depth.into()), self.search_m)?;
            return Some(self.color_at(hit.face, hit.point));
        }
        if last.0 != face {
            *last = (face, Barycentric::of(self.source.surface.corners(face as usize).map(|p| view.pixel(p))));
        }
        Some(self.painter.color(face, last.1.at(center)))
    }

    fn color_at(&mut self, face: u32, p: DVec3) -> [u8; 3] {
        let [a, b, c] = self.source.surface.corners(face as usize);
        let n = (b - a).cross(c - a);
        let area2 = n.length_squared();
        let weights = if area2 > 0.0 {
            let second = (p - a).cross(c - a).dot(n) / area2;
            let third = (b - a).cross(p - a).dot(n) / area2;
            [1.0 - second - third, second, third]
        } else {
            [1.0, 0.0, 0.0]
        };
        self.painter.color(face, weights)
    }

    /// A chart with no source surface near it still gets a colour: that of the closest, wherever it is.
    fn paint_lost_chart(&mut self, chart: &Chart, at: [u32; 2]) {
        let [a, b, c] = self.tile.corners(chart.faces[0] as usize);
        let hit = self.source.bvh.closest((a + b + c) / 3.0, f64::INFINITY);
        let color = hit.map_or(GREY, |hit| self.color_at(hit.face, hit.point));
        let size = inner_px(chart, self.texel_m);
        for y in at[1]..at[1] + size[1] {
            (at[0]..at[0] + size[0]).for_each(|x| self.atlas.put_pixel(x, y, Rgb(color)));
            self.painted.set_span(y, at[0], at[0] + size[0]);
        }
    }
}

/// Between local metres and the samples of a block: right and down in samples, depth in metres towards the viewer.
#[derive(Clone, Copy)]
struct View {
    axes: [DVec3; 3],
    /// Of the block's top-left corner, metres.
    low: DVec2,
    sample_m: f64,
}

impl View {
    fn of(chart: &Chart, sample_m: f64) -> Self {
        Self { axes: chart.axes, low: chart.low, sample_m }
    }

    fn moved(&self, samples: [u32; 2]) -> Self {
        Self { low: self.low + DVec2::new(samples[0].into(), samples[1].into()) * self.sample_m, ..*self }
    }

    fn pixel(&self, p: DVec3) -> DVec2 {
        (DVec2::new(p.dot(self.axes[0]), p.dot(self.axes[1])) - self.low) / self.sample_m
    }

    fn depth(&self, p: DVec3) -> f64 {
        p.dot(self.axes[2])
    }

    fn point(&self, pixel: DVec2, depth: f64) -> DVec3 {
        let plane = pixel * self.sample_m + self.low;
        self.axes[0] * plane.x + self.axes[1] * plane.y + self.axes[2] * depth
    }

    /// The box around a range of samples and depths, `search_m` deeper both ways: centre and half its sides along the
    /// axes, metres.
    fn box_around(&self, range: Range, search_m: f64) -> (DVec3, DVec3) {
        let center = self.point((range.low + range.high) / 2.0, (range.near + range.far) / 2.0);
        let half = (range.high - range.low) / 2.0 * self.sample_m;
        (center, half.extend((range.near - range.far) / 2.0 + search_m))
    }
}

/// What a block's own surface takes up: samples and metres of depth.
#[derive(Clone, Copy)]
struct Range {
    low: DVec2,
    high: DVec2,
    far: f64,
    near: f64,
}

const NONE: u32 = u32::MAX;

/// Buffers of one block of samples, row by row.
#[derive(Default)]
struct Block {
    size: [u32; 2],
    /// Depth of the tile's surface, metres; NaN where there is none. f32 is good to 0.1 mm a kilometre away.
    depth: Vec<f32>,
    /// Distance in depth to the source face kept, metres.
    distance: Vec<f32>,
    /// The source face kept, or `NONE`.
    face: Vec<u32>,
}

impl Block {
    /// Draws faces of the tile; `None` if they cover nothing here.
    fn draw_tile(
        &mut self,
        tile: &Surface,
        faces: impl Iterator<Item = u32>,
        view: &View,
        size: [u32; 2],
    ) -> Option<Range> {
        let count = (size[0] * size[1]) as usize;
        self.size = size;
        self.depth.clear();
        self.depth.resize(count, f32::NAN);
        self.distance.clear();
        self.distance.resize(count, f32::INFINITY);
        self.face.clear();
        self.face.resize(count, NONE);
        let empty =
            Range { low: DVec2::INFINITY, high: DVec2::NEG_INFINITY, far: f64::INFINITY, near: f64::NEG_INFINITY };
        let mut range = empty;
        for f in faces {
            let corners = tile.corners(f as usize);
            let tri = corners.map(|p| view.pixel(p));
            let depths = corners.map(|p| view.depth(p));
            let weights = Barycentric::of(tri);
            let depth = &mut self.depth;
            let mut drawn = false;
            let mut draw = |y: u32, x0: u32, x1: u32| {
                drawn = true;
                for x in x0..x1 {
                    let own = &mut depth[(y * size[0] + x) as usize];
                    if own.is_nan() {
                        let w = weights.at(DVec2::new(f64::from(x), f64::from(y)) + 0.5);
                        *own = (depths[0] * w[0] + depths[1] * w[1] + depths[2] * w[2]) as f32;
                    }
                }
                range.low = range.low.min(DVec2::new(x0.into(), y.into()));
                range.high = range.high.max(DVec2::new(x1.into(), f64::from(y) + 1.0));
            };
            centers(tri, EDGE_PX, size, &mut draw);
            // A face between centres still needs a texel near it.
            let middle = (tri[0] + tri[1] + tri[2]) / 3.0;
            let inside = middle.min_element() >= 0.0 && middle.x < f64::from(size[0]) && middle.y < f64::from(size[1]);
            if !drawn && inside {
                let (x, y) = (middle.x as u32, middle.y as u32);
                let own = &mut self.depth[(y * size[0] + x) as usize];
                if own.is_nan() {
                    *own = ((depths[0] + depths[1] + depths[2]) / 3.0) as f32;
                }
                range.low = range.low.min(middle.floor());
                range.high = range.high.max(middle.floor() + 1.0);
                drawn = true;
            }
            if drawn {
                range.far = depths.into_iter().fold(range.far, f64::min);
                range.near = depths.into_iter().fold(range.near, f64::max);
            }
        }
        (range.low.x < range.high.x).then_some(range)
    }

    /// Draws the source's faces up to `search_m` away; close by at first, which mostly suffices and is much cheaper.
    fn find_source(&mut self, source: &BakeSource, view: &View, range: Range, search_m: f64) {
        const CLOSE: f64 = 1.0 / 8.0;
        for reach_m in [search_m * CLOSE, search_m] {
            let (center, half) = view.box_around(range, reach_m);
            let reach_m = reach_m as f32;
            source.bvh.overlapping_turned(center, &view.axes, half, &mut |f, c| self.draw_source(f, c, view, reach_m));
            let own = self.depth.iter().filter(|depth| !depth.is_nan()).count();
            let found = self.face.iter().filter(|&&face| face != NONE).count();
            // The rest is cheaper to look up one by one.
            if found * 8 >= own * 7 {
                break;
            }
        }
    }

    /// Offers a face of the source to the samples it covers.
    fn draw_source(&mut self, f: u32, &[a, b, c]: &[DVec3; 3], view: &View, search_m: f32) {
        let cross = (b - a).cross(c - a);
        let facing = cross.dot(view.axes[2]);
        if facing <= 0.0 || facing * facing <= MIN_FACING_SQUARED * cross.length_squared() {
            return;
        }
        let tri = [view.pixel(a), view.pixel(b), view.pixel(c)];
        let low = (tri[0].min(tri[1]).min(tri[2]) - 0.5 - EDGE_PX).to_array().map(ceil);
        let high = (tri[0].max(tri[1]).max(tri[2]) - 0.5 + EDGE_PX).to_array().map(floor);
        let size = self.size;
        // Most faces of a fine source fall between the samples of a coarse tile.
        if (0..2).any(|k| low[k] > high[k] || high[k] < 0 || low[k] >= i64::from(size[k])) {
            return;
        }
        let depths = [a, b, c].map(|p| view.depth(p));
        let weights = Barycentric::of(tri);
        let depth_at = |x: f64, y: f64| {
            let w = weights.at(DVec2::new(x, y));
            depths[0] * w[0] + depths[1] * w[1] + depths[2] * w[2]
        };
        let step = depth_at(1.0, 0.0) - depth_at(0.0, 0.0);
        let Self { depth, distance, face, .. } = self;
        centers(tri, EDGE_PX, size, |y, x0, x1| {
            let mut source_depth = depth_at(f64::from(x0) + 0.5, f64::from(y) + 0.5);
            for i in (y * size[0] + x0) as usize..(y * size[0] + x1) as usize {
                // NaN, where the tile has no surface, compares false.
                let far = (source_depth as f32 - depth[i]).abs();
                if far <= search_m && (far < distance[i] || (far == distance[i] && f < face[i])) {
                    distance[i] = far;
                    face[i] = f;
                }
                source_depth += step;
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::{ImageRef, Material};
    use crate::report::Reporter;
    use crate::texture::chart::tests::grid;
    use crate::texture::sample::bilinear;
    use glam::Vec2;
    use std::sync::Arc;

    /// Smooth enough to be resampled, busy enough to tell places apart.
    fn picture(side: u32) -> RgbImage {
        RgbImage::from_fn(side, side, |x, y| {
            let (x, y) = (f64::from(x) / 9.0, f64::from(y) / 7.0);
            Rgb([128.0 + 90.0 * x.sin(), 128.0 + 90.0 * (y + x * 0.5).cos(), 128.0 + 60.0 * (x - y).sin()]
                .map(|c| c as u8))
        })
    }

    struct Scene {
        positions: Vec<DVec3>,
        faces: Vec<[u32; 3]>,
        uvs: Vec<[Vec2; 3]>,
        material: Vec<u32>,
        materials: Vec<Material>,
        bvh: Bvh,
    }

    impl Scene {
        /// A hilly unit square, textured from above by the given UVs.
        fn hills(n: u32, uv: impl Fn(DVec3) -> Vec2) -> Self {
            let (positions, faces) = grid(n, |x, y| 0.06 * (8.0 * x).sin() * (6.0 * y).cos());
            Self::of(positions, faces, uv)
        }

        fn of(positions: Vec<DVec3>, faces: Vec<[u32; 3]>, uv: impl Fn(DVec3) -> Vec2) -> Self {
            let uvs = faces.iter().map(|f: &[u32; 3]| f.map(|v| uv(positions[v as usize]))).collect();
            let material = vec![0; faces.len()];
            let materials = vec![Material { name: "ground".into(), base_color: [9, 8, 7], image: Some(0) }];
            let bvh = Bvh::new(&positions, &faces);
            Self { positions, faces, uvs, material, materials, bvh }
        }

        fn surface(&self) -> Surface<'_> {
            Surface {
                positions: &self.positions,
                faces: &self.faces,
                corner_uvs: &self.uvs,
                face_material: &self.material,
                vertex_colors: &[],
                materials: &self.materials,
            }
        }

        fn bake(&self, tile: &Surface, image: RgbImage, texel_m: f64, config: &TextureConfig) -> Baked {
            let reporter = Reporter::new(true);
            let mut images = Images::new(vec![ImageRef::Pixels(Arc::new(image))], &reporter);
            images.cover(&self.surface());
            bake(tile, &BakeSource { surface: self.surface(), bvh: &self.bvh }, &images, texel_m, config).unwrap()
        }
    }

    fn from_above(p: DVec3) -> Vec2 {
        Vec2::new(p.x as f32, 1.0 - p.y as f32)
    }

    fn seen(baked: &Baked, f: usize, w: [f64; 3]) -> [u8; 3] {
        let size = DVec2::new(baked.atlas.width().into(), baked.atlas.height().into());
        let uv = baked.corner_uvs[f].map(|uv| uv.as_dvec2());
        bilinear(&baked.atlas, None, (uv[0] * w[0] + uv[1] * w[1] + uv[2] * w[2]) * size, [false; 2])
    }

    const SPOTS: [[f64; 3]; 7] = [
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0],
        [0.5, 0.5, 0.0],
        [0.3, 0.3, 0.4],
        [0.7, 0.1, 0.2],
        [0.1, 0.75, 0.15],
    ];

    /// PSNR of what the baked tile shows against `truth` of a point, dB.
    fn surface_psnr(tile: &Surface, baked: &Baked, truth: impl Fn(DVec3) -> [u8; 3]) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        for f in 0..tile.faces.len() {
            let [a, b, c] = tile.corners(f);
            for w in SPOTS {
                let wanted = truth(a * w[0] + b * w[1] + c * w[2]);
                for (x, y) in seen(baked, f, w).into_iter().zip(wanted) {
                    sum += (f64::from(x) - f64::from(y)).powi(2);
                    count += 1.0;
                }
            }
        }
        10.0 * (255.0 * 255.0 * count / sum).log10()
    }

    #[test]
    fn a_mesh_baked_onto_itself_looks_the_same() {
        let scene = Scene::hills(24, from_above);
        let image = picture(256);
        let truth = |p: DVec3| bilinear(&image, None, from_above(p).as_dvec2() * 256.0, [false; 2]);
        for samples in [1, 2] {
            let config = TextureConfig { samples, ..Default::default() };
            let baked = scene.bake(&scene.surface(), picture(256), 1.0 / 256.0, &config);
            let db = surface_psnr(&scene.surface(), &baked, truth);
            assert!(db > 36.0, "{db} dB with {samples} samples");
            assert!((1.0..1.2).contains(&(baked.texel_m * 256.0)), "{}", baked.texel_m);
        }
    }

    #[test]
    fn a_simplified_tile_keeps_the_picture() {
        let scene = Scene::hills(48, from_above);
        let (positions, faces) = grid(6, |x, y| 0.06 * (8.0 * x).sin() * (6.0 * y).cos());
        let tile = Surface { positions: &positions, faces: &faces, ..Default::default() };
        let baked = scene.bake(&tile, picture(512), 1.0 / 128.0, &TextureConfig::default());
        let image = picture(512);
        let truth = |p: DVec3| bilinear(&image, None, from_above(p).as_dvec2() * 512.0, [false; 2]);
        let db = surface_psnr(&tile, &baked, truth);
        assert!(db > 27.0, "{db} dB");
    }

    /// The square in two halves that are apart in the image, on magenta.
    fn apart(p: DVec3) -> Vec2 {
        let v = 0.1 + 0.8 * p.y as f32;
        if p.x < 0.5 { Vec2::new(0.05 + 0.7 * p.x as f32, v) } else { Vec2::new(0.25 + 0.7 * p.x as f32, v) }
    }

    #[test]
    fn no_background_shines_through() {
        const MAGENTA: Rgb<u8> = Rgb([255, 0, 255]);
        let (positions, mut faces) = grid(10, |_, _| 0.0);
        faces.retain(|f| f.iter().all(|&v| v % 11 < 5) || f.iter().all(|&v| v % 11 >= 5));
        let scene = Scene::of(positions, faces, apart);
        let reporter = Reporter::new(true);
        let blank = RgbImage::from_pixel(200, 200, MAGENTA);
        let mut images = Images::new(vec![ImageRef::Pixels(Arc::new(blank.clone()))], &reporter);
        images.cover(&scene.surface());
        let mask = images.mask(0).unwrap();
        let mut image = blank;
        for (x, y, texel) in image.enumerate_pixels_mut() {
            if mask.get(x, y) {
                *texel = Rgb([30, 160, 60]);
            }
        }
        for texel_m in [0.004, 0.01, 0.03, 0.09, 0.5] {
            let baked = scene.bake(&scene.surface(), image.clone(), texel_m, &TextureConfig::default());
            assert!(baked.atlas.pixels().all(|p| *p == Rgb([30, 160, 60])), "at {texel_m} m a texel");
        }
    }

    #[test]
    fn two_storeys_keep_their_own_pictures() {
        let (mut positions, mut faces) = grid(4, |_, _| 0.0);
        let count = positions.len() as u32;
        positions.extend(positions.clone().iter().map(|p| *p + DVec3::Z * 0.3));
        faces.extend(faces.clone().iter().map(|f| f.map(|v| v + count)));
        let uv = |p: DVec3| Vec2::new(if p.z > 0.15 { 0.9 } else { 0.1 }, 0.5);
        let scene = Scene::of(positions, faces, uv);
        let image = RgbImage::from_fn(64, 64, |x, _| if x < 32 { Rgb([250, 0, 0]) } else { Rgb([0, 0, 250]) });
        let baked = scene.bake(&scene.surface(), image, 0.02, &TextureConfig::default());
        for f in 0..scene.faces.len() {
            assert_eq!(seen(&baked, f, [0.3, 0.3, 0.4]), if f < 32 { [250, 0, 0] } else { [0, 0, 250] });
        }
    }

    #[test]
    fn a_tile_beyond_the_edge_of_its_source_takes_the_closest_color() {
        let scene = Scene::hills(8, from_above);
        let wide: Vec<_> = scene.positions.iter().map(|p| *p * DVec3::new(1.1, 1.1, 1.0)).collect();
        let far: Vec<_> = scene.positions.iter().map(|p| *p + DVec3::X * 50.0).collect();
        for positions in [wide, far] {
            let tile = Surface { positions: &positions, faces: &scene.faces, ..Default::default() };
            let image = RgbImage::from_pixel(64, 64, Rgb([200, 100, 50]));
            let baked = scene.bake(&tile, image, 0.01, &TextureConfig::default());
            assert!(baked.atlas.pixels().all(|p| *p == Rgb([200, 100, 50])));
        }
    }

    #[test]
    fn vertex_colors_and_plain_materials_are_baked_too() {
        let mut scene = Scene::hills(12, from_above);
        scene.uvs.clear();
        let plain = scene.bake(&scene.surface(), picture(4), 0.02, &TextureConfig::default());
        assert!(plain.atlas.pixels().all(|p| *p == Rgb([9, 8, 7])));
        let colors: Vec<_> = scene.positions.iter().map(|p| [(p.x * 255.0) as u8, (p.y * 255.0) as u8, 0]).collect();
        let source = Surface { vertex_colors: &colors, ..scene.surface() };
        let reporter = Reporter::new(true);
        let images = Images::new(Vec::new(), &reporter);
        let from = BakeSource { surface: source, bvh: &scene.bvh };
        let baked = bake(&source, &from, &images, 0.01, &TextureConfig::default()).unwrap();
        let db = surface_psnr(&source, &baked, |p| [(p.x * 255.0) as u8, (p.y * 255.0) as u8, 0]);
        assert!(db > 36.0, "{db} dB");
    }

    #[test]
    fn an_atlas_that_does_not_fit_gets_larger_texels() {
        let scene = Scene::hills(8, from_above);
        let config = TextureConfig { max_atlas_px: 64, power_of_two: true, ..Default::default() };
        for texel_m in [0.001, 0.0, f64::NAN] {
            let baked = scene.bake(&scene.surface(), picture(256), texel_m, &config);
            assert_eq!(baked.atlas.dimensions(), (64, 64));
            assert!((0.015..0.03).contains(&baked.texel_m), "{}", baked.texel_m);
        }
    }

    #[test]
    fn empty_and_degenerate_tiles_are_no_trouble() {
        let scene = Scene::hills(4, from_above);
        let empty = scene.bake(&Surface::default(), picture(16), 0.1, &TextureConfig::default());
        assert_eq!((empty.atlas.dimensions(), empty.texel_m), ((4, 4), 0.0));
        let tile = Surface { positions: &[DVec3::ZERO; 3], faces: &[[0, 1, 2], [0, 0, 0]], ..Default::default() };
        let point = scene.bake(&tile, picture(16), 0.1, &TextureConfig::default());
        assert!(point.corner_uvs.iter().flatten().all(|uv| uv.min_element() > 0.0 && uv.max_element() < 1.0));
        let lone = Scene::of(Vec::new(), Vec::new(), from_above);
        let grey = lone.bake(&scene.surface(), picture(16), 0.1, &TextureConfig::default());
        assert!(grey.atlas.pixels().all(|p| p.0 == GREY));
    }

    #[test]
    fn tiles_are_the_same_for_any_number_of_threads() {
        use rayon::prelude::*;
        let scene = Scene::hills(20, from_above);
        let run = |threads: usize| {
            let reporter = Reporter::new(true);
            let refs = vec![ImageRef::Pixels(Arc::new(picture(128)))];
            // A budget so small that levels are evicted all the time.
            let mut images = Images::with_budget(refs, 1000, &reporter);
            images.cover(&scene.surface());
            let source = BakeSource { surface: scene.surface(), bvh: &scene.bvh };
            let config = TextureConfig::default();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let tile = |i: u32| {
                    let texel_m = 0.01 * f64::from(1 + i / 2);
                    let surface = scene.surface();
                    if i.is_multiple_of(2) {
                        bake(&surface, &source, &images, texel_m, &config)
                    } else {
                        super::super::repack(&surface, &images, &config)
                    }
                };
                (0..8_u32).into_par_iter().map(tile).collect::<Result<Vec<_>>>().unwrap()
            })
        };
        assert!(run(1) == run(2));
    }
}
