//! Cuts one tile into charts, packs them into one image, and paints every texel.
//!
//! # Method
//! 1. Grow charts of connected faces whose normals stay within a cone, at most 14 m across.
//! 2. Project each chart on its own plane, upright walls stay upright.
//! 3. Shelve the charts' rectangles by height at the finest texel size that fits.
//! 4. Paint the texels under each face, then spread colours over the padding.

use std::collections::VecDeque;

use glam::{DVec2, DVec3, Vec2, Vec3};
use image::RgbImage;

/// Texels around a chart.
const PADDING_PX: u32 = 2;
/// Finest texel, metres: beyond this the painted detail has nothing to show.
const FINEST_M: f64 = 0.045;
/// Largest chart, metres.
const CHART_M: f64 = 14.0;
/// Cosine between a face and its chart.
const CONE: f64 = 0.72;

/// One tile's faces, on its own vertices.
pub(super) struct TileMesh<'a> {
    pub(super) positions: &'a [DVec3],
    pub(super) faces: &'a [[u32; 3]],
    /// Per face, unit.
    pub(super) normals: &'a [DVec3],
    /// Direction in the plan that charts of level ground are aligned with.
    pub(super) axis: DVec2,
}

struct Chart {
    faces: Vec<u32>,
    right: DVec3,
    up: DVec3,
    low: DVec2,
    high: DVec2,
    /// Texels from the image's left and top to the chart's corner.
    at: [u32; 2],
}

/// A painted tile.
pub(super) struct Atlas {
    pub(super) image: RgbImage,
    pub(super) corner_uvs: Vec<[Vec2; 3]>,
}

/// Charts, packs and paints; `paint(face, barycentric)` is the colour there, 0 to 1.
pub(super) fn bake(mesh: &TileMesh, size_px: u32, paint: impl Fn(usize, [f64; 3]) -> Vec3) -> Atlas {
    let mut charts = grow(mesh);
    let texel_m = pack(&mut charts, size_px);
    let mut corners = vec![[DVec2::ZERO; 3]; mesh.faces.len()];
    for chart in &charts {
        for &f in &chart.faces {
            corners[f as usize] = mesh.faces[f as usize].map(|v| {
                let p = mesh.positions[v as usize];
                let x = (chart.right.dot(p) - chart.low.x) / texel_m;
                let y = (chart.high.y - chart.up.dot(p)) / texel_m;
                let margin = f64::from(PADDING_PX) + 0.5;
                DVec2::new(x + f64::from(chart.at[0]) + margin, y + f64::from(chart.at[1]) + margin)
            });
        }
    }
    let mut canvas = Canvas::new(size_px);
    for (f, triangle) in corners.iter().enumerate() {
        canvas.fill(*triangle, |weights| paint(f, weights));
    }
    canvas.spread();
    let scale = 1.0 / f64::from(size_px);
    let corner_uvs = corners.iter().map(|t| t.map(|p| (p * scale).as_vec2())).collect();
    Atlas { image: canvas.into_image(), corner_uvs }
}

/// Per face, the faces across its three edges; `u32::MAX` for none.
fn neighbours(faces: &[[u32; 3]]) -> Vec<[u32; 3]> {
    let mut edges: Vec<(u32, u32, u32, u8)> = Vec::with_capacity(faces.len() * 3);
    for (f, face) in faces.iter().enumerate() {
        for e in 0..3 {
            let (a, b) = (face[e], face[(e + 1) % 3]);
            edges.push((a.min(b), a.max(b), f as u32, e as u8));
        }
    }
    edges.sort_unstable();
    let mut across = vec![[u32::MAX; 3]; faces.len()];
    for pair in edges.windows(2) {
        let ((a, b, f, e), (c, d, g, h)) = (pair[0], pair[1]);
        if (a, b) == (c, d) {
            across[f as usize][usize::from(e)] = g;
            across[g as usize][usize::from(h)] = f;
        }
    }
    across
}

fn grow(mesh: &TileMesh) -> Vec<Chart> {
    let across = neighbours(mesh.faces);
    let mut taken = vec![false; mesh.faces.len()];
    let mut charts = Vec::new();
    // Even faces first: seeds in the middle of planes make few charts.
    let flatness = |f: usize| {
        across[f]
            .iter()
            .filter(|&&g| g != u32::MAX)
            .map(|&g| mesh.normals[f].dot(mesh.normals[g as usize]))
            .sum::<f64>()
    };
    let mut seeds: Vec<(i64, u32)> = (0..mesh.faces.len()).map(|f| ((flatness(f) * -50.0) as i64, f as u32)).collect();
    seeds.sort_unstable();
    for (_, seed) in seeds {
        if !taken[seed as usize] {
            charts.push(grow_one(mesh, &across, &mut taken, seed));
        }
    }
    charts
}

fn grow_one(mesh: &TileMesh, across: &[[u32; 3]], taken: &mut [bool], seed: u32) -> Chart {
    let near = across[seed as usize].iter().filter(|&&g| g != u32::MAX).map(|&g| mesh.normals[g as usize]);
    let normal = near.fold(mesh.normals[seed as usize], |sum, n| sum + n).normalize_or(DVec3::Z);
    let (right, up) = axes(normal, mesh.axis);
    let flat = |p: DVec3| DVec2::new(right.dot(p), up.dot(p));
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    let mut faces = Vec::new();
    let mut queue = VecDeque::from([seed]);
    taken[seed as usize] = true;
    while let Some(f) = queue.pop_front() {
        let corners = mesh.faces[f as usize].map(|v| flat(mesh.positions[v as usize]));
        let (l, h) = corners.iter().fold((low, high), |(l, h), &c| (l.min(c), h.max(c)));
        if f != seed && (h - l).max_element() > CHART_M {
            taken[f as usize] = false;
            continue;
        }
        (low, high) = (l, h);
        faces.push(f);
        for &g in &across[f as usize] {
            if g != u32::MAX && !taken[g as usize] && mesh.normals[g as usize].dot(normal) > CONE {
                taken[g as usize] = true;
                queue.push_back(g);
            }
        }
    }
    Chart { faces, right, up, low, high, at: [0; 2] }
}

/// Axes of a chart's plane: `right` level, `up` as upright as the plane allows.
fn axes(normal: DVec3, axis: DVec2) -> (DVec3, DVec3) {
    // Nearly level: tan 15 degrees of slope is where roofs begin.
    let right = if normal.z > 0.966 || normal.z < -0.966 {
        let along = axis.extend(0.0);
        (along - normal * normal.dot(along)).normalize()
    } else {
        DVec3::Z.cross(normal).normalize()
    };
    (right, normal.cross(right))
}

/// Places all charts; returns the texel's size in metres.
fn pack(charts: &mut [Chart], size_px: u32) -> f64 {
    charts.sort_by(|a, b| {
        let key = |c: &Chart| c.high.y - c.low.y;
        key(b).total_cmp(&key(a)).then(a.faces[0].cmp(&b.faces[0]))
    });
    let mut texel_m = FINEST_M;
    while !shelve(charts, size_px, texel_m) {
        texel_m *= 1.03;
    }
    texel_m
}

fn shelve(charts: &mut [Chart], size_px: u32, texel_m: f64) -> bool {
    let (mut x, mut y, mut shelf) = (0u32, 0u32, 0u32);
    for chart in charts {
        let extent = (chart.high - chart.low) / texel_m;
        let [w, h] = [extent.x, extent.y].map(|length| length.ceil() as u32 + 1 + 2 * PADDING_PX);
        if x + w > size_px {
            (x, y, shelf) = (0, y + shelf, 0);
        }
        if w > size_px || y + h > size_px {
            return false;
        }
        chart.at = [x, y];
        x += w;
        shelf = shelf.max(h);
    }
    true
}

/// An image being painted; unpainted texels are told apart.
struct Canvas {
    size: usize,
    pixels: Vec<[u8; 3]>,
    painted: Vec<bool>,
}

impl Canvas {
    fn new(size_px: u32) -> Self {
        let size = size_px as usize;
        Self { size, pixels: vec![[0; 3]; size * size], painted: vec![false; size * size] }
    }

    /// Paints the texels whose middles lie in a triangle.
    fn fill(&mut self, [a, b, c]: [DVec2; 3], paint: impl Fn([f64; 3]) -> Vec3) {
        let area = (b - a).perp_dot(c - a);
        if area.abs() < 1e-9 {
            return;
        }
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let last = self.size - 1;
        for y in low.y.max(0.0) as usize..=(high.y as usize).min(last) {
            for x in low.x.max(0.0) as usize..=(high.x as usize).min(last) {
                let q = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                let (wb, wc) = ((q - a).perp_dot(c - a) / area, (b - a).perp_dot(q - a) / area);
                let wa = 1.0 - wb - wc;
                if wa >= 0.0 && wb >= 0.0 && wc >= 0.0 {
                    let at = y * self.size + x;
                    let color = paint([wa, wb, wc]) * 255.0;
                    self.pixels[at] = color.round().clamp(Vec3::ZERO, Vec3::splat(255.0)).to_array().map(|v| v as u8);
                    self.painted[at] = true;
                }
            }
        }
    }

    /// Grows the painted parts by the padding, then fills the rest with the mean colour.
    fn spread(&mut self) {
        // One more than the padding: texels under slivers have no painted middle.
        for _ in 0..=PADDING_PX {
            let before = self.painted.clone();
            for y in 0..self.size {
                for x in 0..self.size {
                    let at = y * self.size + x;
                    if !before[at] {
                        self.grow_into(&before, x, y);
                    }
                }
            }
        }
        let mut sum = [0u64; 4];
        for pixel in self.pixels.iter().zip(&self.painted).filter(|(_, painted)| **painted).map(|(p, _)| p) {
            (0..3).for_each(|c| sum[c] += u64::from(pixel[c]));
            sum[3] += 1;
        }
        let mean: [u8; 3] = std::array::from_fn(|c| (sum[c] / sum[3].max(1)) as u8);
        for (pixel, _) in self.pixels.iter_mut().zip(&self.painted).filter(|(_, painted)| !**painted) {
            *pixel = mean;
        }
    }

    fn grow_into(&mut self, before: &[bool], x: usize, y: usize) {
        let mut sum = [0u32; 4];
        for ny in y.saturating_sub(1)..=(y + 1).min(self.size - 1) {
            for nx in x.saturating_sub(1)..=(x + 1).min(self.size - 1) {
                let n = ny * self.size + nx;
                if before[n] {
                    (0..3).for_each(|c| sum[c] += u32::from(self.pixels[n][c]));
                    sum[3] += 1;
                }
            }
        }
        if sum[3] > 0 {
            let at = y * self.size + x;
            self.pixels[at] = std::array::from_fn(|c| (sum[c] / sum[3]) as u8);
            self.painted[at] = true;
        }
    }

    fn into_image(self) -> RgbImage {
        let size = self.size as u32;
        let mut image = RgbImage::new(size, size);
        for (pixel, color) in image.pixels_mut().zip(self.pixels) {
            pixel.0 = color;
        }
        image
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A roof of two faces at right angles, 4 m by 4 m each.
    fn tent() -> (Vec<DVec3>, Vec<[u32; 3]>, Vec<DVec3>) {
        let p = |x, y, z| DVec3::new(x, y, z);
        let positions = vec![p(0., 0., 0.), p(4., 0., 0.), p(4., 4., 4.), p(0., 4., 4.), p(4., 8., 0.), p(0., 8., 0.)];
        let faces = vec![[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]];
        let (south, north) = (p(0., -1., 1.).normalize(), p(0., 1., 1.).normalize());
        (positions, faces, vec![south, south, north, north])
    }

    #[test]
    fn every_texel_under_a_face_shows_that_face() {
        let (positions, faces, normals) = tent();
        let mesh = TileMesh { positions: &positions, faces: &faces, normals: &normals, axis: DVec2::X };
        let atlas = bake(&mesh, 256, |f, _| Vec3::splat((f as f32 * 50.0 + 50.0) / 255.0));
        for (f, uvs) in atlas.corner_uvs.iter().enumerate() {
            let middle = (uvs[0] + uvs[1] + uvs[2]) / 3.0 * 256.0;
            assert_eq!(atlas.image.get_pixel(middle.x as u32, middle.y as u32).0[0] as usize, f * 50 + 50);
        }
    }

    #[test]
    fn a_sharp_ridge_parts_two_charts_and_a_plane_stays_one() {
        let (positions, faces, normals) = tent();
        let mesh = TileMesh { positions: &positions, faces: &faces, normals: &normals, axis: DVec2::X };
        assert_eq!(grow(&mesh).len(), 2);
    }
}
