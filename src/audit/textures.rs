//! Whether images hold the detail that their resolution promises.
//!
//! # Method
//! 1. detail of an octave: the root mean square of what is lost when an image is halved and doubled again, over the texels
//!    that faces show
//! 2. a tile with finer ones is held against these: with the detail that they have at its resolution, by the metres that a
//!    texel of each covers. That works for a single tile. Blurred is what has less than half of it
//! 3. finest tiles are held against each other: by their detail at their own resolution against the most in the octaves
//!    below, which a natural image has somewhat more of, whatever the contrast. Where there are fewer than three, only what
//!    has next to nothing of it is blurred: it holds four times the pixels that it has use for
//!
//! # Limits
//! One image a tile, the largest; images that repeat over a face are left out. KTX2 images are not decoded. A finest tile
//! that is blurred by little cannot be told from one of a smooth place.

use std::collections::BTreeMap;

use image::RgbImage;
use serde::Serialize;

use super::budget::Budget;
use super::cover::Cover;
use super::read::{TileMesh, Tileset};
use super::structure::TileFigures;
use crate::Result;
use crate::input::jpeg;
use crate::report::Reporter;

/// A tile with less than this part of the detail that it might have is blurred.
pub const LEAST_SHARE: f64 = 0.5;
/// A lone finest tile with less than this part of its detail at its own resolution is blurred.
pub const LEAST_ALONE: f64 = 0.05;
/// Tiles of a level looked at, evenly spread; decoding is slow.
const MOST_TILES: usize = 400;
/// Images are not decoded beyond this many pixels.
const MOST_PX: u64 = 1 << 26;
/// Finest tiles of a level that are held against each other.
const LEAST_TILES: usize = 3;
/// Images flatter than this have no detail to lose, of 255.
const LEAST_CONTRAST: f64 = 0.5;
/// Finer detail below this, of 255, may be lost to the compression of any JPEG; blur is told by what is above.
const LEAST_VISIBLE: f64 = 6.0;
/// Blocks of texels with faces on them, below which nothing can be said.
const LEAST_BLOCKS: usize = 256;
/// Octaves that are looked at.
const OCTAVES: usize = 5;

/// The detail of a level's images.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LevelDetail {
    /// Tiles with content above.
    pub level: u32,
    /// Of its tiles those without finer ones: their images are the source's, the others' were made smaller.
    pub is_finest: bool,
    /// Images looked at.
    pub images: usize,
    /// Median detail share.
    pub detail_share: f64,
    /// Of tiles with finer ones the median of their detail by what these have at the same resolution.
    pub share_of_finer: Option<f64>,
}

/// What a tile's detail is held against.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Than {
    /// The next finer tiles, at its own resolution.
    Finer,
    /// The median of the finest tiles of its level.
    Level,
    /// What its own octaves below have.
    Itself,
}

/// A tile whose image has less detail than it might.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Blurred {
    /// Index of the tile.
    pub tile: usize,
    /// Its detail by the other's.
    pub share: f64,
    /// By what.
    pub than: Than,
}

/// Of all levels.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Textures {
    /// The coarsest first.
    pub levels: Vec<LevelDetail>,
    /// By tile.
    pub blurred: Vec<Blurred>,
}

/// Detail of an image by octave.
struct Profile {
    /// Mean squares, from its own resolution down.
    squares: Vec<f64>,
    metres_per_texel: Option<f64>,
    textured_m2: f64,
}

/// Looks at the largest image of each tile, whose sizes are in `figures`.
///
/// # Errors
/// [`crate::Error::Cancelled`].
pub fn measure(tileset: &Tileset, figures: &[TileFigures], budget: Budget, reporter: &Reporter) -> Result<Textures> {
    let cover = Cover::of(tileset);
    let mut by_level = BTreeMap::<(u32, bool), Vec<usize>>::new();
    for tile in (0..tileset.tiles.len()).filter(|&t| tileset.tiles[t].has_mesh()) {
        by_level.entry((tileset.level(tile), cover.has_finer(tile))).or_default().push(tile);
    }
    for tiles in by_level.values_mut() {
        let step = tiles.len().div_ceil(MOST_TILES);
        *tiles = tiles.iter().copied().step_by(step).collect();
    }
    let chosen: Vec<usize> = by_level.values().flatten().copied().collect();
    let pixels = |tile: usize| figures.get(tile).map_or(0, |f| f.texture_px);
    let bytes = |&tile: &usize| Budget::to_see(pixels(tile)) + Budget::to_read(tileset.stored_bytes(tile));
    let look = |&tile: &usize| {
        let figures = figures.get(tile).cloned().unwrap_or_default();
        reporter.check().map(|()| Profile::of(tileset, tile, &figures, budget).map(|profile| (tile, profile)))
    };
    let profiles: Result<Vec<Option<(usize, Profile)>>> = budget.map(&chosen, bytes, look).into_iter().collect();
    let profiles: BTreeMap<usize, Profile> = profiles?.into_iter().flatten().collect();
    let mut found = Textures::default();
    for ((level, has_finer), tiles) in by_level {
        let shares: Vec<(usize, f64)> =
            tiles.iter().filter_map(|tile| Some((*tile, profiles.get(tile)?.share()?))).collect();
        let Some(detail_share) = median(shares.iter().map(|s| s.1)) else { continue };
        let mut row =
            LevelDetail { level, is_finest: !has_finer, images: shares.len(), detail_share, share_of_finer: None };
        if has_finer {
            let of_finer = |tile: usize| Some((tile, share_of_finer(tileset, &cover, &profiles, tile)?));
            let of_finer: Vec<(usize, f64)> = tiles.iter().filter_map(|&tile| of_finer(tile)).collect();
            row.share_of_finer = median(of_finer.iter().map(|s| s.1));
            let blurred = of_finer.iter().filter(|s| s.1 < LEAST_SHARE);
            found.blurred.extend(blurred.map(|&(tile, share)| Blurred { tile, share, than: Than::Finer }));
        } else if shares.len() >= LEAST_TILES {
            let by_median = shares.iter().map(|&(tile, share)| (tile, share / detail_share));
            let blurred = by_median.filter(|s| s.1 < LEAST_SHARE);
            found.blurred.extend(blurred.map(|(tile, share)| Blurred { tile, share, than: Than::Level }));
        } else {
            let blurred = shares.iter().filter(|s| s.1 < LEAST_ALONE);
            found.blurred.extend(blurred.map(|&(tile, share)| Blurred { tile, share, than: Than::Itself }));
        }
        found.levels.push(row);
    }
    found.blurred.sort_by_key(|b| b.tile);
    Ok(found)
}

fn median(of: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = of.collect();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}

/// A tile's detail by that of the next finer tiles at its resolution.
fn share_of_finer(tileset: &Tileset, cover: &Cover, all: &BTreeMap<usize, Profile>, tile: usize) -> Option<f64> {
    let own = all.get(&tile)?;
    let texel_m = own.metres_per_texel?;
    let (mut sum, mut weight) = (0.0, 0.0);
    for finer in cover.next(tileset, tile).into_iter().filter(|&finer| finer != tile).filter_map(|t| all.get(&t)) {
        if let Some(squares) = finer.at(texel_m) {
            sum += squares * finer.textured_m2;
            weight += finer.textured_m2;
        }
    }
    let expected = sum / weight;
    (expected > LEAST_VISIBLE * LEAST_VISIBLE).then(|| (own.squares[0] / expected).sqrt())
}

impl Profile {
    fn of(tileset: &Tileset, tile: usize, figures: &TileFigures, budget: Budget) -> Option<Self> {
        let meshes = tileset.load(tile, &Reporter::new(true)).ok()?;
        let px = |t: &super::read::Texture| t.size_px.map_or(0, |[w, h]| u64::from(w) * u64::from(h));
        let images = meshes.iter().flat_map(|mesh| (0..mesh.textures.len()).map(move |texture| (mesh, texture)));
        let (mesh, texture) = images
            .filter(|(mesh, texture)| (1..=budget.seen_px().min(MOST_PX)).contains(&px(&mesh.textures[*texture])))
            .max_by_key(|(mesh, texture)| px(&mesh.textures[*texture]))?;
        let mut grey = Grey::of(&decoded(&mesh.textures[texture].encoded)?);
        grey.mask(mesh, texture);
        Some(Self {
            squares: grey.squares()?,
            metres_per_texel: figures.metres_per_texel(),
            textured_m2: figures.textured_m2,
        })
    }

    /// Detail at its own resolution by the most in the octaves below; `None` for images too flat.
    fn share(&self) -> Option<f64> {
        let lower = self.squares[1..].iter().copied().fold(0.0, f64::max).sqrt();
        (lower > LEAST_CONTRAST).then(|| self.squares[0].sqrt() / lower)
    }

    /// Mean square of the detail that is left where a texel covers `texel_m` metres.
    fn at(&self, texel_m: f64) -> Option<f64> {
        let octave = (texel_m / self.metres_per_texel?).log2().max(0.0);
        let (low, part) = (octave.floor() as usize, octave.fract());
        let next = if part > 0.0 { *self.squares.get(low + 1)? } else { 0.0 };
        Some(self.squares.get(low)? * (1.0 - part) + next * part)
    }
}

/// The pixels of an image; `None` if it cannot be decoded.
fn decoded(encoded: &[u8]) -> Option<RgbImage> {
    if encoded.starts_with(&jpeg::MAGIC) {
        return jpeg::decode(encoded, 4 * MOST_PX as usize);
    }
    image::load_from_memory(encoded).ok().map(image::DynamicImage::into_rgb8)
}

struct Grey {
    width: usize,
    height: usize,
    values: Vec<f32>,
    /// Texels that faces show.
    is_used: Vec<bool>,
}

impl Grey {
    fn of(picture: &RgbImage) -> Self {
        let values: Vec<f32> = picture.pixels().map(|p| p.0.iter().map(|&c| f32::from(c)).sum::<f32>() / 3.0).collect();
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        Self { width, height, is_used: vec![true; values.len()], values }
    }

    /// Leaves out what no face of `mesh` shows.
    fn mask(&mut self, mesh: &TileMesh, texture: usize) {
        self.is_used.fill(false);
        let size = glam::DVec2::new(self.width as f64, self.height as f64);
        let faces = mesh.parts.iter().filter(|part| part.texture == Some(texture)).flat_map(|part| part.faces.clone());
        for face in faces.filter_map(|f| mesh.faces.get(f)) {
            let corners = face.map(|v| mesh.uvs.get(v as usize).copied().unwrap_or_default().as_dvec2());
            if corners.iter().all(|uv| uv.cmpge(glam::DVec2::ZERO).all() && uv.cmple(glam::DVec2::ONE).all()) {
                self.use_triangle(corners.map(|uv| uv * size));
            }
        }
    }

    fn use_triangle(&mut self, [a, b, c]: [glam::DVec2; 3]) {
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let twice = (b - a).perp_dot(c - a);
        for y in low.y as usize..(high.y.ceil() as usize).min(self.height) {
            for x in low.x as usize..(high.x.ceil() as usize).min(self.width) {
                let p = glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                let sides = [(a, b), (b, c), (c, a)].map(|(from, to)| (to - from).perp_dot(p - from) * twice);
                if sides.iter().all(|&side| side >= 0.0) {
                    self.is_used[y * self.width + x] = true;
                }
            }
        }
    }

    /// Mean squares of the detail by octave; `None` for images too small or hardly used.
    fn squares(self) -> Option<Vec<f64>> {
        let (mut squares, mut at) = (Vec::new(), self);
        while squares.len() < OCTAVES {
            let Some(half) = at.halved() else { break };
            let Some(square) = at.lost(&half) else { break };
            squares.push(square);
            at = half;
        }
        (squares.len() >= 2).then_some(squares)
    }

    fn halved(&self) -> Option<Self> {
        let (width, height) = (self.width / 2, self.height / 2);
        if width < 8 || height < 8 {
            return None;
        }
        let four = |i: usize| {
            let at = 2 * (i / width) * self.width + 2 * (i % width);
            [at, at + 1, at + self.width, at + self.width + 1]
        };
        let mean = |i: usize| four(i).iter().map(|&at| self.values[at]).sum::<f32>() / 4.0;
        Some(Self {
            width,
            height,
            values: (0..width * height).map(mean).collect(),
            is_used: (0..width * height).map(|i| four(i).iter().all(|&at| self.is_used[at])).collect(),
        })
    }

    /// Mean square of what halving took away; `None` if there is too little of the image.
    fn lost(&self, half: &Self) -> Option<f64> {
        let (mut sum, mut blocks) = (0.0, 0);
        for i in (0..half.values.len()).filter(|&i| half.is_used[i]) {
            blocks += 1;
            let at = 2 * (i / half.width) * self.width + 2 * (i % half.width);
            for at in [at, at + 1, at + self.width, at + self.width + 1] {
                let by = self.values[at] - half.values[i];
                sum += f64::from(by * by) / 4.0;
            }
        }
        (blocks >= LEAST_BLOCKS.min(half.values.len())).then(|| sum / f64::from(blocks as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// White noise of `s` pixels.
    fn noise(x: u32, y: u32, s: u32) -> u32 {
        let mixed = (x / s).wrapping_mul(374_761_393) ^ (y / s).wrapping_mul(668_265_263) ^ s;
        let mixed = (mixed ^ mixed >> 13).wrapping_mul(1_274_126_177);
        (mixed ^ mixed >> 16) % 61
    }

    fn sharp() -> RgbImage {
        let value = |x, y| 20 + noise(x, y, 1) + noise(x, y, 2) + noise(x, y, 4);
        RgbImage::from_fn(256, 256, |x, y| image::Rgb([value(x, y) as u8; 3]))
    }

    fn profile(of: &RgbImage, texel_m: f64) -> Option<Profile> {
        let squares = Grey::of(of).squares()?;
        Some(Profile { squares, metres_per_texel: Some(texel_m), textured_m2: 1.0 })
    }

    #[test]
    fn a_blurred_image_has_little_detail_at_its_own_resolution() {
        let blurred = image::imageops::blur(&sharp(), 3.0);
        let own = profile(&sharp(), 1.0).and_then(|p| p.share()).expect("a share");
        let less = profile(&blurred, 1.0).and_then(|p| p.share());
        assert!(less.is_none_or(|less| less < LEAST_SHARE * own), "{own} {less:?}");
        assert_eq!(profile(&RgbImage::new(64, 64), 1.0).and_then(|p| p.share()), None);
    }

    #[test]
    fn an_image_made_smaller_well_has_the_detail_of_the_finer_one_there_and_a_blurred_one_has_not() {
        let finer = profile(&sharp(), 0.1).expect("a profile");
        // Means of four pixels each.
        let halved = |of: &RgbImage| image::imageops::thumbnail(of, 128, 128);
        let well = profile(&halved(&sharp()), 0.2).expect("a profile");
        let badly = profile(&halved(&image::imageops::blur(&sharp(), 3.0)), 0.2).expect("a profile");
        let share = |of: &Profile| (of.squares[0] / finer.at(0.2).expect("there")).sqrt();
        assert!(share(&well) > 0.9, "{}", share(&well));
        assert!(share(&badly) < LEAST_SHARE, "{}", share(&badly));
        assert_eq!(finer.at(100.0), None);
    }

    #[test]
    fn a_jpeg_with_halved_colours_in_a_scan_each_is_decoded_as_it_was_painted() {
        // Odd in blocks of 16.
        let value = |x: u32, y: u32| 40 + 2 * (x / 3) + (y / 2) + noise(x / 8, y / 8, 1);
        let picture = RgbImage::from_fn(120, 88, |x, y| image::Rgb([value(x, y).min(255) as u8, 120, 60]));
        let mut bytes = Vec::new();
        let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 95);
        encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_2_2);
        encoder.set_optimized_huffman_tables(true);
        encoder.encode(picture.as_raw(), 120, 88, jpeg_encoder::ColorType::Rgb).expect("a JPEG");
        let back = decoded(&bytes).expect("pixels");
        let off = back.as_raw().iter().zip(picture.as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b)));
        let mean = off.sum::<f64>() / picture.as_raw().len() as f64;
        assert!(mean < 6.0, "{mean}");
        let mut png = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut png, image::ImageFormat::Png).expect("a PNG");
        assert_eq!(decoded(png.get_ref()).as_ref(), Some(&picture));
        assert_eq!(decoded(&bytes[..40]), None);
    }

    #[test]
    fn texels_that_no_face_shows_are_left_out() {
        let mut half = sharp();
        half.enumerate_pixels_mut().filter(|(x, _, _)| *x >= 128).for_each(|(_, _, p)| p.0 = [0; 3]);
        let mesh = TileMesh {
            faces: vec![[0, 1, 2], [0, 2, 3]],
            uvs: [[0.0, 0.0], [0.5, 0.0], [0.5, 1.0], [0.0, 1.0]].map(glam::Vec2::from).to_vec(),
            parts: vec![super::super::read::Part { faces: 0..2, texture: Some(0) }],
            ..TileMesh::default()
        };
        let mut grey = Grey::of(&half);
        grey.mask(&mesh, 0);
        let masked = grey.squares().expect("octaves");
        let whole = Grey::of(&sharp()).squares().expect("octaves");
        assert!((masked[0] / whole[0] - 1.0).abs() < 0.05, "{masked:?} {whole:?}");
    }
}
