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
//! With faces set up once a block and edges divided once a face, not once a row, a town of 226 tiles builds in 0.96 of
//! the processor time. Drawing the source is the largest part: a quarter of a bake.

use glam::{DVec2, DVec3};
use image::{Rgb, RgbImage};

use super::chart::{Chart, charts};
use super::images::Images;
use super::mask::{Mask, fill, mean};
use super::pack::fit;
use super::raster::Barycentric;
use super::repack::no_room;
use super::sample::Painter;
use super::{Baked, GREY, Surface, TextureConfig, rms_texel_m};
use crate::Result;
use crate::geo::bvh::Bvh;
use block::{Block, NONE, View};

mod block;
#[cfg(test)]
mod tests;

/// Side of a block, samples: its buffers stay in the cache, and 1 to 4 samples a texel divide it.
const BLOCK: u32 = 240;
/// Faces of the source whose weights are remembered within a block: row by row, the same few come again and again.
const REMEMBERED: usize = 512;
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
    let samples = config.samples.clamp(1, 4);
    let mut baker = Baker {
        tile,
        source,
        texel_m,
        samples,
        search_m: config.search_texels * texel_m,
        painter: Painter::new(source.surface, images, texel_m / f64::from(samples)),
        block: Block::default(),
        weights: vec![(NONE, Barycentric::default()); REMEMBERED],
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
    /// By face, modulo their number.
    weights: Vec<(u32, Barycentric)>,
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
        self.weights.iter_mut().for_each(|of| of.0 = NONE);
        let s = self.samples;
        let mut painted = 0;
        for y in 0..self.block.size[1] / s {
            if s == 1 {
                painted += self.shade_row(view, y, [at[0], at[1] + y]);
                continue;
            }
            for x in 0..self.block.size[0] / s {
                let Some(color) = self.mean_color(view, [x * s, y * s]) else { continue };
                self.atlas.put_pixel(at[0] + x, at[1] + y, Rgb(color));
                self.painted.set(at[0] + x, at[1] + y);
                painted += 1;
            }
        }
        painted
    }

    /// Colours one row of samples as texels at `at` and to its right, texels of one face together; returns how many.
    fn shade_row(&mut self, view: &View, y: u32, at: [u32; 2]) -> u32 {
        let width = self.block.size[0] as usize;
        let (row, texels) = (y as usize * width, at[1] as usize * self.atlas.width() as usize + at[0] as usize);
        let (mut x, mut painted) = (0, 0);
        while x < width {
            let (from, face) = (x, self.block.face[row + x]);
            x += 1;
            if face == NONE {
                let Some(color) = self.sample(view, from as u32, y) else { continue };
                self.atlas.put_pixel(at[0] + from as u32, at[1], Rgb(color));
            } else {
                while x < width && self.block.face[row + x] == face {
                    x += 1;
                }
                let weights = self.weights_of(face, view);
                let first = DVec2::new(from as f64, f64::from(y)) + 0.5;
                let all: &mut [u8] = &mut self.atlas;
                self.painter.color_row(face, &weights, first, &mut all[3 * (texels + from)..3 * (texels + x)]);
            }
            self.painted.set_span(at[1], at[0] + from as u32, at[0] + x as u32);
            painted += (x - from) as u32;
        }
        painted
    }

    /// The mean of a texel's samples, the first of them at `low`; none if all are.
    fn mean_color(&mut self, view: &View, low: [u32; 2]) -> Option<[u8; 3]> {
        let s = self.samples;
        // 1 to 4 a side.
        let (mut found, mut count) = ([[0; 3]; 16], 0);
        for i in 0..s * s {
            if let Some(color) = self.sample(view, low[0] + i % s, low[1] + i / s) {
                found[count] = color;
                count += 1;
            }
        }
        match found[..count] {
            [] => None,
            [color] => Some(color),
            ref all => Some(mean(all.iter().map(|&c| (c, 1))).map_or(GREY, |(color, _)| color)),
        }
    }

    fn sample(&mut self, view: &View, x: u32, y: u32) -> Option<[u8; 3]> {
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
        let weights = self.weights_of(face, view);
        Some(self.painter.color(face, weights.at(center)))
    }

    /// How a face of the source lies in the block.
    fn weights_of(&mut self, face: u32, view: &View) -> Barycentric {
        let own = &mut self.weights[face as usize % REMEMBERED];
        if own.0 != face {
            let [a, b, c] = self.source.surface.corners(face as usize);
            *own = (face, Barycentric::of([view.pixel(a), view.pixel(b), view.pixel(c)]));
        }
        own.1
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
