//! One block of samples: which source face each of them sees.
//!
//! In: faces of a tile, a [`View`] of them and the source. Out: the tile's depth and the source's face by sample.

use glam::{DVec2, DVec3};

use super::BakeSource;
use crate::texture::Surface;
use crate::texture::chart::Chart;
use crate::texture::raster::{Barycentric, ceil, centers, floor};

/// A centre on an edge belongs to the face on either side, whatever the rounding, texels.
const EDGE_PX: f64 = 1e-7;
/// Source faces whose normal is further from the chart's are not seen from there: squared cosine of 78.5°.
const MIN_FACING_SQUARED: f64 = 0.04;

/// Between local metres and the samples of a block: right and down in samples, depth in metres towards the viewer.
#[derive(Clone, Copy)]
pub(super) struct View {
    axes: [DVec3; 3],
    /// Of the block's top-left corner, metres.
    low: DVec2,
    sample_m: f64,
}

impl View {
    pub fn of(chart: &Chart, sample_m: f64) -> Self {
        Self { axes: chart.axes, low: chart.low, sample_m }
    }

    pub fn moved(&self, samples: [u32; 2]) -> Self {
        Self { low: self.low + DVec2::new(samples[0].into(), samples[1].into()) * self.sample_m, ..*self }
    }

    pub fn pixel(&self, p: DVec3) -> DVec2 {
        (DVec2::new(p.dot(self.axes[0]), p.dot(self.axes[1])) - self.low) / self.sample_m
    }

    pub fn depth(&self, p: DVec3) -> f64 {
        p.dot(self.axes[2])
    }

    pub fn point(&self, pixel: DVec2, depth: f64) -> DVec3 {
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
pub(super) struct Range {
    low: DVec2,
    high: DVec2,
    far: f64,
    near: f64,
}

/// No face.
pub(super) const NONE: u32 = u32::MAX;

/// Buffers of one block of samples, row by row.
#[derive(Default)]
pub(super) struct Block {
    pub size: [u32; 2],
    /// Depth of the tile's surface, metres; NaN where there is none. f32 is good to 0.1 mm a kilometre away.
    pub depth: Vec<f32>,
    /// Distance in depth to the source face kept, metres.
    distance: Vec<f32>,
    /// The source face kept, or `NONE`.
    pub face: Vec<u32>,
}

impl Block {
    /// Draws faces of the tile; `None` if they cover nothing here.
    pub fn draw_tile(
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
    pub fn find_source(&mut self, source: &BakeSource, view: &View, range: Range, search_m: f64) {
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
