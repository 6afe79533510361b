//! Whether images hold the detail that their resolution promises.
//!
//! # Method
//! Detail at an image's own resolution is what is lost when it is halved and doubled again; the most of the same in the
//! octaves below is what a natural image has somewhat more of. Their ratio is the detail share, whatever the contrast; of a
//! blurred image it is small. It is held against the median of the tiles of the same level, those with finer ones and
//! those without apart.
//!
//! # Limits
//! One image a tile, the largest. KTX2 images are not decoded.

use image::RgbImage;
use rayon::prelude::*;
use serde::Serialize;

use super::cover::Cover;
use super::read::Tileset;
use crate::Result;
use crate::report::Reporter;

/// A tile with less than this part of its level's detail share is blurred.
pub const LEAST_SHARE: f64 = 0.5;
/// Tiles of a level looked at, evenly spread; decoding is slow.
const MOST_TILES: usize = 400;
/// Images are not decoded beyond this many pixels.
const MOST_PX: u64 = 1 << 26;
/// A level needs this many images to have a usual share.
const LEAST_TILES: usize = 3;
/// Images flatter than this have no detail to lose, of 255.
const LEAST_CONTRAST: f64 = 0.5;

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
}

/// A tile whose image has less detail than its level's.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Blurred {
    /// Index of the tile.
    pub tile: usize,
    /// Its detail share.
    pub detail_share: f64,
    /// The median of its level.
    pub level_share: f64,
}

/// Of all levels.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Textures {
    /// The coarsest first.
    pub levels: Vec<LevelDetail>,
    /// By tile.
    pub blurred: Vec<Blurred>,
}

/// Looks at the largest image of each tile.
///
/// # Errors
/// [`crate::Error::Cancelled`].
pub fn measure(tileset: &Tileset, reporter: &Reporter) -> Result<Textures> {
    let cover = Cover::of(tileset);
    let mut by_level = std::collections::BTreeMap::<(u32, bool), Vec<usize>>::new();
    for tile in (0..tileset.tiles.len()).filter(|&t| tileset.tiles[t].has_mesh()) {
        by_level.entry((tileset.level(tile), cover.has_finer(tile))).or_default().push(tile);
    }
    let mut found = Textures::default();
    for ((level, has_finer), tiles) in by_level {
        let step = tiles.len().div_ceil(MOST_TILES);
        let chosen: Vec<usize> = tiles.into_iter().step_by(step).collect();
        let shares: Result<Vec<Option<(usize, f64)>>> = chosen
            .into_par_iter()
            .map(|tile| reporter.check().map(|()| of_tile(tileset, tile).map(|share| (tile, share))))
            .collect();
        let shares: Vec<(usize, f64)> = shares?.into_iter().flatten().collect();
        let mut sorted: Vec<f64> = shares.iter().map(|s| s.1).collect();
        sorted.sort_by(f64::total_cmp);
        let Some(&median) = sorted.get(sorted.len() / 2) else { continue };
        found.levels.push(LevelDetail { level, is_finest: !has_finer, images: sorted.len(), detail_share: median });
        if sorted.len() >= LEAST_TILES {
            let is_blurred = |s: &&(usize, f64)| s.1 < LEAST_SHARE * median;
            let blurred = |s: &(usize, f64)| Blurred { tile: s.0, detail_share: s.1, level_share: median };
            found.blurred.extend(shares.iter().filter(is_blurred).map(blurred));
        }
    }
    found.blurred.sort_by_key(|b| b.tile);
    Ok(found)
}

fn of_tile(tileset: &Tileset, tile: usize) -> Option<f64> {
    let meshes = tileset.load(tile, &Reporter::new(true)).ok()?;
    let px = |t: &&super::read::Texture| t.size_px.map_or(0, |[w, h]| u64::from(w) * u64::from(h));
    let largest = meshes.iter().flat_map(|m| &m.textures).filter(|t| (1..=MOST_PX).contains(&px(t))).max_by_key(px)?;
    detail_share(&image::load_from_memory(&largest.encoded).ok()?.to_rgb8())
}

/// Detail at the image's own resolution by the most in the octaves below; `None` for images too small or too flat.
fn detail_share(picture: &RgbImage) -> Option<f64> {
    let full = Grey::of(picture);
    let half = full.halved()?;
    let own = full.lost(&half);
    let (mut lower, mut at) = (0.0f64, half);
    for _ in 0..OCTAVES {
        let Some(next) = at.halved() else { break };
        lower = lower.max(at.lost(&next));
        at = next;
    }
    (lower > LEAST_CONTRAST).then(|| own / lower)
}

/// Octaves below an image's own that are looked at: what is blurred has its detail in one of them.
const OCTAVES: u32 = 4;

struct Grey {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Grey {
    fn of(picture: &RgbImage) -> Self {
        let values = picture.pixels().map(|p| p.0.iter().map(|&c| f32::from(c)).sum::<f32>() / 3.0).collect();
        Self { width: picture.width() as usize, height: picture.height() as usize, values }
    }

    fn halved(&self) -> Option<Self> {
        let (width, height) = (self.width / 2, self.height / 2);
        if width < 8 || height < 8 {
            return None;
        }
        let at = |x: usize, y: usize| self.values[y * self.width + x];
        let mean = |x: usize, y: usize| {
            (at(2 * x, 2 * y) + at(2 * x + 1, 2 * y) + at(2 * x, 2 * y + 1) + at(2 * x + 1, 2 * y + 1)) / 4.0
        };
        let values = (0..width * height).map(|i| mean(i % width, i / width)).collect();
        Some(Self { width, height, values })
    }

    /// Root mean square of what halving took away.
    fn lost(&self, half: &Self) -> f64 {
        let mut sum = 0.0;
        for y in 0..2 * half.height {
            for x in 0..2 * half.width {
                let by = self.values[y * self.width + x] - half.values[y / 2 * half.width + x / 2];
                sum += f64::from(by * by);
            }
        }
        (sum / (4 * half.width * half.height) as f64).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blurred_image_has_little_detail_at_its_own_resolution() {
        let noise =
            |x: u32, y: u32, s: u32| ((x / s).wrapping_mul(73) ^ (y / s).wrapping_mul(151)).wrapping_mul(97) % 61;
        let sharp = RgbImage::from_fn(128, 128, |x, y| image::Rgb([(40 + noise(x, y, 1) + noise(x, y, 4)) as u8; 3]));
        let blurred = image::imageops::blur(&sharp, 3.0);
        let (own, less) = (detail_share(&sharp).expect("a share"), detail_share(&blurred));
        assert!(less.is_none_or(|less| less < 0.5 * own), "{own} {less:?}");
        assert_eq!(detail_share(&RgbImage::new(64, 64)), None);
    }
}
