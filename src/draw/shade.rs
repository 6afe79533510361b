//! Colours for what is seen: light, paint, smoothing.

use glam::DVec3;
use image::{Rgb, RgbImage};
use rayon::prelude::*;

use super::ramp::Scale;
use super::raster::{NO_FACE, Seen};
use super::view::View;

/// sRGB where no face is seen.
pub const BACKGROUND: [u8; 3] = [255, 255, 255];
/// Light that reaches even what faces away from the lamp, share of full: dark sides keep their colour.
const AMBIENT: f64 = 0.42;

/// A point of a mesh as seen at a pixel.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// The face.
    pub face: u32,
    /// Weights of its corners, each 0 or more, sum 1.
    pub weights: [f64; 3],
    /// Metres in front of the camera's plane.
    pub depth_m: f64,
    /// Share of full light, 0 to 1.
    pub light: f64,
}

/// How faces are coloured.
#[derive(Debug, Clone, Copy)]
pub enum Paint<'a> {
    /// One colour for all.
    Solid([u8; 3]),
    /// One per face.
    Faces(&'a [[u8; 3]]),
    /// One per vertex, blended over faces.
    Vertices(&'a [[u8; 3]]),
    /// A value per face, coloured by a scale.
    FaceValues(&'a [f64], &'a Scale),
    /// A value per vertex: values are blended and then coloured, so a ramp's own colours appear between vertices.
    VertexValues(&'a [f64], &'a Scale),
}

/// Draws a mesh, lit and smoothed 2×2: the call for most pictures.
///
/// # Panics
/// If a face names a vertex, or `paint` lacks a face or vertex, that is not there.
pub fn render(view: &View, positions: &[DVec3], faces: &[[u32; 3]], paint: Paint) -> RgbImage {
    let seen = Seen::of(&view.enlarged(2), positions, faces);
    let picture = color(&seen, positions, faces, |hit| lit(paint.at(faces, hit), hit.light));
    if seen.view() == view { picture } else { halved(&picture) }
}

/// Colours what is seen; `color` is asked once per covered pixel, in no particular order.
pub fn color(seen: &Seen, positions: &[DVec3], faces: &[[u32; 3]], color: impl Fn(&Hit) -> [u8; 3] + Sync) -> RgbImage {
    let view = seen.view();
    let [width, height] = view.size_px();
    let lamp = lamp();
    let mut bytes = vec![0; width as usize * height as usize * 3];
    let rows = bytes.par_chunks_mut(width as usize * 3).zip(seen.faces().par_chunks(width as usize)).enumerate();
    rows.for_each(|(y, (row, seen_faces))| {
        for (x, (pixel, &face)) in row.chunks_exact_mut(3).zip(seen_faces).enumerate() {
            if face == NO_FACE {
                pixel.copy_from_slice(&BACKGROUND);
                continue;
            }
            let corners = faces[face as usize].map(|v| view.camera_from_local(positions[v as usize]));
            let weights = view.weights(corners, x as f64 + 0.5, y as f64 + 0.5);
            let at = corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2];
            let light = light(corners, at, view, lamp);
            pixel.copy_from_slice(&color(&Hit { face, weights, depth_m: at.z, light }));
        }
    });
    RgbImage::from_raw(width, height, bytes).unwrap_or_default()
}

/// `color` under `light` (0 to 1).
pub fn lit(color: [u8; 3], light: f64) -> [u8; 3] {
    color.map(|c| (f64::from(c) * light + 0.5) as u8)
}

/// Half the size: each pixel the mean of four, taken of squares, which is near enough to light to keep thin bright
/// lines as bright as they are. An odd last row or column is dropped.
pub fn halved(picture: &RgbImage) -> RgbImage {
    RgbImage::from_fn(picture.width() / 2, picture.height() / 2, |x, y| {
        let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| picture.get_pixel(2 * x + dx, 2 * y + dy).0);
        Rgb(std::array::from_fn(|c| {
            let sum: u32 = four.iter().map(|p| u32::from(p[c]) * u32::from(p[c])).sum();
            (f64::from(sum) / 4.0).sqrt().round() as u8
        }))
    })
}

impl Paint<'_> {
    /// The colour at a hit, before light.
    pub fn at(&self, faces: &[[u32; 3]], hit: &Hit) -> [u8; 3] {
        let face = hit.face as usize;
        match self {
            Self::Solid(color) => *color,
            Self::Faces(colors) => colors[face],
            Self::FaceValues(values, scale) => scale.color(values[face]),
            Self::Vertices(colors) => {
                let corners = faces[face].map(|v| colors[v as usize]);
                std::array::from_fn(|c| {
                    let sum: f64 = (0..3).map(|i| f64::from(corners[i][c]) * hit.weights[i]).sum();
                    (sum + 0.5) as u8
                })
            }
            Self::VertexValues(values, scale) => {
                let sum: f64 = (0..3).map(|i| values[faces[face][i] as usize] * hit.weights[i]).sum();
                scale.color(sum)
            }
        }
    }
}

/// Towards the lamp, camera frame: over the viewer's left shoulder, so that no view is dark and, seen from above,
/// light comes from the north-west as on a map.
fn lamp() -> DVec3 {
    DVec3::new(-0.55, 0.55, -0.75).normalize()
}

/// Share of full light on a face (camera metres) at a point of it; both sides of a face are lit alike.
fn light([a, b, c]: [DVec3; 3], at: DVec3, view: &View, lamp: DVec3) -> f64 {
    let normal = (b - a).cross(c - a).try_normalize().unwrap_or(-DVec3::Z);
    let to_viewer = -view.ray(at);
    let normal = if normal.dot(to_viewer) < 0.0 { -normal } else { normal };
    AMBIENT + (1.0 - AMBIENT) * normal.dot(lamp).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::ramp::{NO_DATA, Ramp};

    const SQUARE: [DVec3; 4] =
        [DVec3::ZERO, DVec3::new(8.0, 0.0, 0.0), DVec3::new(8.0, 8.0, 0.0), DVec3::new(0.0, 8.0, 0.0)];
    const FACES: [[u32; 3]; 2] = [[0, 1, 2], [0, 2, 3]];

    fn above() -> View {
        View::above_at(DVec3::new(0.0, 8.0, 5.0), 1.0, [8, 8])
    }

    #[test]
    fn faces_have_their_own_colours() {
        let colors = [[200, 0, 0], [0, 200, 0]];
        let picture = render(&above(), &SQUARE, &FACES, Paint::Faces(&colors));
        let (low, high) = (picture.get_pixel(6, 7).0, picture.get_pixel(1, 0).0);
        assert!(low[0] > 100 && low[1] == 0, "{low:?}");
        assert!(high[1] > 100 && high[0] == 0, "{high:?}");
    }

    #[test]
    fn values_are_blended_before_they_are_coloured() {
        let scale = Scale::new(Ramp::BlueRed, 0.0, 8.0, "m");
        let seen = Seen::of(&above(), &SQUARE, &FACES);
        let paint = Paint::VertexValues(&[0.0, 8.0, 8.0, 0.0], &scale);
        let picture = color(&seen, &SQUARE, &FACES, |hit| paint.at(&FACES, hit));
        for (x, _, pixel) in picture.enumerate_pixels() {
            assert_eq!(pixel.0, scale.color(f64::from(x) + 0.5));
        }
        let missing = Paint::VertexValues(&[f64::NAN; 4], &scale);
        let picture = color(&seen, &SQUARE, &FACES, |hit| missing.at(&FACES, hit));
        assert_eq!(picture.get_pixel(3, 3).0, NO_DATA);
    }

    #[test]
    fn both_sides_of_a_face_are_lit_alike() {
        let turned = FACES.map(|[a, b, c]| [c, b, a]);
        let paint = Paint::Solid([180, 180, 180]);
        assert_eq!(render(&above(), &SQUARE, &FACES, paint), render(&above(), &SQUARE, &turned, paint));
        let view = View::oblique(&SQUARE, 200.0, 40.0, [50, 40]);
        let from_below = View::oblique(&SQUARE, 200.0, -40.0, [50, 40]);
        for view in [view, from_below] {
            let picture = render(&view, &SQUARE, &FACES, paint);
            assert!(picture.pixels().any(|p| p.0 != BACKGROUND));
        }
    }

    #[test]
    fn halving_keeps_flat_colours_and_mixes_borders() {
        let flat = RgbImage::from_pixel(6, 4, Rgb([13, 77, 254]));
        assert!(halved(&flat).pixels().all(|p| p.0 == [13, 77, 254]));
        let edge = RgbImage::from_fn(2, 2, |x, _| Rgb([if x == 0 { 0 } else { 255 }; 3]));
        assert_eq!(halved(&edge).get_pixel(0, 0).0, [180; 3]);
    }
}
