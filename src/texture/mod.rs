//! Gives every tile one atlas of its own, either repacked from source charts or baked anew.
//!
//! In: a tile's [`Surface`], the source's [`Images`]. Out: [`Baked`] (corner UVs, atlas, metres per texel).
//! # Method
//! 1. [`Images::cover`] marks the texels the mesh uses, so that mips average nothing else.
//! 2. Leaf tiles: [`repack()`] copies the charts a tile uses, texel for texel.
//! 3. Simplified tiles: [`bake()`] cuts new charts (`chart`), packs them (`pack`) and samples the source surface.
//! 4. A cut of a whole mesh: [`paint_cut`] chooses the texel and bakes.
//! 5. [`encode_jpeg`] compresses.
//! # Promises
//! A repacked atlas holds source texels bit for bit; a baked one holds no texel of the source's background; both
//! are the same for any number of threads. Each has its test in the file that makes it.
//! # Limits
//! A coarse mip of a source image mixes texels of charts that are neighbours in the image but not on the
//! surface; [`TextureConfig::samples`] lessens that. Image sets are held as bit masks: 1 bit a texel, always.

use glam::{DVec3, Vec2};
use serde::{Deserialize, Serialize};

use crate::input::Material;
use crate::{Error, Result};

mod bake;
mod chart;
mod cut;
mod encode;
mod images;
mod mask;
mod mean;
mod pack;
mod raster;
mod repack;
mod sample;

pub use bake::{BakeSource, bake};
pub use cut::paint_cut;
pub use encode::encode_jpeg;
pub use images::Images;
pub use mean::mean_colors;
pub use repack::repack;

/// Painted where nothing is known: mid grey, sRGB.
pub(crate) const GREY: [u8; 3] = [128; 3];

/// A tile's own texture.
#[derive(Debug, Clone, PartialEq)]
pub struct Baked {
    /// Per face and corner, into the atlas, 0 to 1, v down.
    pub corner_uvs: Vec<[Vec2; 3]>,
    /// sRGB texels.
    pub atlas: image::RgbImage,
    /// Metres per texel: area-weighted RMS over the textured faces; 0 when no face is textured.
    pub texel_m: f64,
}

/// Borrowed triangles and their paint. Slices other than `positions` and `faces` may be empty.
#[derive(Debug, Clone, Copy, Default)]
pub struct Surface<'a> {
    /// Local metres.
    pub positions: &'a [DVec3],
    /// Indices into `positions`.
    pub faces: &'a [[u32; 3]],
    /// Per face and corner, v down; empty when nothing is textured.
    pub corner_uvs: &'a [[Vec2; 3]],
    /// Per face, index into `materials`; empty: no materials.
    pub face_material: &'a [u32],
    /// Per vertex sRGB; empty when there are none.
    pub vertex_colors: &'a [[u8; 3]],
    /// Referenced by `face_material`.
    pub materials: &'a [Material],
}

impl<'a> From<&'a crate::mesh::Mesh> for Surface<'a> {
    fn from(mesh: &'a crate::mesh::Mesh) -> Self {
        Self {
            positions: &mesh.positions,
            faces: &mesh.faces,
            corner_uvs: &mesh.corner_uvs,
            face_material: &mesh.face_material,
            vertex_colors: &mesh.vertex_colors,
            materials: &mesh.materials,
        }
    }
}

/// UVs beyond this many repeats are nonsense: f32 no longer tells texels apart there.
const MAX_UV: f32 = 1e4;

impl Surface<'_> {
    /// The three corners of face `f`, metres.
    pub fn corners(&self, f: usize) -> [DVec3; 3] {
        // Mapped, the array costs a call.
        let [a, b, c] = self.faces[f];
        [self.positions[a as usize], self.positions[b as usize], self.positions[c as usize]]
    }

    /// Area of face `f`, m².
    pub fn area_m2(&self, f: usize) -> f64 {
        let [a, b, c] = self.corners(f);
        (b - a).cross(c - a).length() / 2.0
    }

    /// The image face `f` is painted with, if it has one and usable UVs.
    pub(crate) fn image(&self, f: usize) -> Option<u32> {
        let uvs = self.corner_uvs.get(f)?;
        let image = self.materials.get(*self.face_material.get(f)? as usize)?.image?;
        // `<=` is false for NaN, too.
        uvs.iter().all(|uv| uv.x.abs() <= MAX_UV && uv.y.abs() <= MAX_UV).then_some(image)
    }

    /// True where any face has an image; a surface in plain colours needs no atlas.
    pub fn is_painted(&self) -> bool {
        let has_image = |m: &u32| self.materials.get(*m as usize).is_some_and(|m| m.image.is_some());
        !self.corner_uvs.is_empty() && self.face_material.iter().any(has_image)
    }

    /// Metres per texel of the surface's images: the root of area over texels; 0 without texels.
    pub fn texel_m(&self, images: &Images) -> f64 {
        let (mut area_m2, mut texels) = (0.0, 0.0);
        for f in 0..self.faces.len() {
            let Some(image) = self.image(f) else { continue };
            area_m2 += self.area_m2(f);
            texels += texels_of(&self.corner_uvs[f], images.dimensions(image));
        }
        if texels > 0.0 { (area_m2 / texels).sqrt() } else { 0.0 }
    }

    /// The colour of face `f` where it has no image: its mean vertex colour, else its material's colour, else grey.
    pub(crate) fn solid_color(&self, f: usize) -> [u8; 3] {
        if self.vertex_colors.is_empty() {
            return self.base_color(f);
        }
        let corners = self.faces[f].map(|v| self.vertex_colors[v as usize]);
        std::array::from_fn(|c| ((corners.iter().map(|rgb| u16::from(rgb[c])).sum::<u16>() + 1) / 3) as u8)
    }

    /// The material colour of face `f`, else grey.
    pub(crate) fn base_color(&self, f: usize) -> [u8; 3] {
        let material = self.face_material.get(f).and_then(|&m| self.materials.get(m as usize));
        material.map_or(GREY, |m| m.base_color)
    }
}

/// Texels of an image inside a triangle of texture coordinates.
pub fn texels_of(uvs: &[Vec2; 3], [width, height]: [u32; 2]) -> f64 {
    let [a, b, c] = uvs.map(|uv| uv.as_dvec2());
    let texels = 0.5 * (b - a).perp_dot(c - a).abs() * f64::from(width) * f64::from(height);
    if texels.is_finite() { texels } else { 0.0 }
}

/// How atlases are made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TextureConfig {
    /// Largest atlas side, texels, 64 to 16384. A tile that needs more is scaled down. Default: 8192.
    pub max_atlas_px: u32,
    /// Largest atlas side of a simplified tile, texels. Default: 2048, about 600 kB.
    pub coarse_atlas_px: u32,
    /// Largest atlas side of the root, texels. Default: 1024: the first view loads at once.
    pub root_atlas_px: u32,
    /// Texels of padding on each side of a chart, 1 to 64; 2^m keeps m mip levels clean. Default: 2.
    pub gutter_px: u32,
    /// JPEG quality of repacked (leaf) atlases, 1 to 100. Default: 88.
    pub jpeg_quality: u8,
    /// JPEG quality of baked (coarse) atlases, 1 to 100. Default: 80.
    pub coarse_jpeg_quality: u8,
    /// Round atlas sides up to powers of two (else to multiples of 4). Default: false.
    pub power_of_two: bool,
    /// A baked chart takes faces this close to its mean normal, degrees, 10 to 70. Default: 50.
    pub chart_angle_deg: f64,
    /// A baked texel looks for the source surface this many texels away, 1 to 1000. Default: 24
    /// (1.5 times a geometric error of 16 texels).
    pub search_texels: f64,
    /// Samples per baked texel along each side, 1 to 4; more costs its square. Default: 1.
    pub samples: u32,
}

impl Default for TextureConfig {
    fn default() -> Self {
        Self {
            max_atlas_px: 8192,
            coarse_atlas_px: 2048,
            root_atlas_px: 1024,
            gutter_px: 2,
            jpeg_quality: 88,
            coarse_jpeg_quality: 80,
            power_of_two: false,
            chart_angle_deg: 50.0,
            search_texels: 24.0,
            samples: 1,
        }
    }
}

impl TextureConfig {
    /// Lists every setting out of its range.
    ///
    /// # Errors
    /// [`Error::Config`] naming each one with the value found and the range wanted.
    pub fn check(&self) -> Result<()> {
        let mut wrong = Vec::new();
        let mut range = |name: &str, value: f64, low: f64, high: f64| {
            if !(low..=high).contains(&value) {
                wrong.push(format!("texture.{name} is {value}, wanted {low} to {high}"));
            }
        };
        range("max_atlas_px", self.max_atlas_px.into(), 64.0, 16384.0);
        range("coarse_atlas_px", self.coarse_atlas_px.into(), 64.0, 16384.0);
        range("root_atlas_px", self.root_atlas_px.into(), 64.0, 16384.0);
        range("gutter_px", self.gutter_px.into(), 1.0, 64.0);
        range("jpeg_quality", self.jpeg_quality.into(), 1.0, 100.0);
        range("coarse_jpeg_quality", self.coarse_jpeg_quality.into(), 1.0, 100.0);
        range("chart_angle_deg", self.chart_angle_deg, 10.0, 70.0);
        range("search_texels", self.search_texels, 1.0, 1000.0);
        range("samples", self.samples.into(), 1.0, 4.0);
        if wrong.is_empty() { Ok(()) } else { Err(Error::Config(wrong.join("; "))) }
    }
}

/// Area-weighted RMS of metres per texel over `(area_m2, area_px)` of faces; 0 without area.
///
/// A face counts as at most 8 times coarser than the whole: the few whose UVs have no area would make it infinite.
fn rms_texel_m(faces: &[(f64, f64)]) -> f64 {
    const MAX_OUTLIER_SQUARED: f64 = 64.0;
    // For tiles that have no texel area at all: one constant colour a face.
    const MIN_FACE_PX: f64 = 0.25;
    let area_m2: f64 = faces.iter().map(|face| face.0).sum();
    let area_px: f64 = faces.iter().map(|face| face.1).sum();
    if area_m2 <= 0.0 {
        return 0.0;
    }
    if area_px <= 0.0 {
        return (area_m2 / (MIN_FACE_PX * faces.len() as f64)).sqrt();
    }
    let most = MAX_OUTLIER_SQUARED * area_m2 / area_px;
    // 0 / 0 is NaN, which `min` turns into the other.
    let sum: f64 = faces.iter().map(|&(m2, px)| m2 * (m2 / px).min(most)).sum();
    (sum / area_m2).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_out_of_range_is_listed_at_once() {
        let config = TextureConfig { gutter_px: 0, samples: 9, search_texels: f64::NAN, ..Default::default() };
        let message = config.check().unwrap_err().to_string();
        assert!(message.contains("gutter_px is 0") && message.contains("samples is 9"), "{message}");
        assert!(message.contains("search_texels is NaN"), "{message}");
        assert!(TextureConfig::default().check().is_ok());
    }

    #[test]
    fn texel_size_is_weighted_by_area() {
        // 3 m² at 1 m a texel and 1 m² at 2 m a texel: sqrt((3·1 + 1·4) / 4).
        let size = rms_texel_m(&[(3.0, 3.0), (1.0, 0.25)]);
        assert!((size - (7.0_f64 / 4.0).sqrt()).abs() < 1e-12);
        // The scale of the numbers does not matter, faces far smaller than a texel included.
        let small = rms_texel_m(&[(3e-6, 3e-6), (1e-6, 0.25e-6)]);
        assert!((size - small).abs() < 1e-12);
        assert_eq!([rms_texel_m(&[]), rms_texel_m(&[(0.0, 1.0)])], [0.0; 2]);
        assert!(rms_texel_m(&[(9.0, 9.0), (1.0, 0.0), (0.0, 0.0)]) < 4.0);
        assert_eq!(rms_texel_m(&[(1.0, 0.0)]), 2.0);
    }
}
