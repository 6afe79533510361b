//! Compresses an atlas as a baseline JPEG of one scan, which every decoder reads.

use image::RgbImage;
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

/// From here on colour is kept at full resolution: below, halved chroma saves about a fifth of the bytes and
/// coarse tiles are seen from afar; above, it would be the largest error left, and it bleeds across chart borders.
const FULL_CHROMA_FROM_QUALITY: u8 = 88;

/// Encodes at `quality` (1 to 100): 4:4:4 from quality 88 on, 4:2:0 below. The same image gives the same bytes.
///
/// # Panics
/// If a side is 0 or above 65535; [`TextureConfig`](super::TextureConfig) keeps atlases far below that.
pub fn encode_jpeg(image: &RgbImage, quality: u8) -> Vec<u8> {
    let side = |px: u32| u16::try_from(px).expect("atlas sides are at most 16384 texels");
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, quality.clamp(1, 100));
    let full = quality >= FULL_CHROMA_FROM_QUALITY;
    encoder.set_sampling_factor(if full { SamplingFactor::R_4_4_4 } else { SamplingFactor::R_4_2_0 });
    let done = encoder.encode(image.as_raw(), side(image.width()), side(image.height()), ColorType::Rgb);
    done.expect("writing to memory only fails for an empty image");
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::texture::images::tests::psnr;
    use image::Rgb;

    /// A façade-like picture: smooth light, sharp windows, a coloured sign, some grain.
    fn facade() -> RgbImage {
        RgbImage::from_fn(128, 128, |x, y| {
            let grain = (((x.wrapping_mul(2_654_435_761) ^ (y * 40_503)) >> 7) & 7) as u8;
            match (x % 32, y % 32) {
                (8..=20, 6..=24) => Rgb([40 + grain, 50 + grain, 70]),
                _ if (40..70).contains(&x) && (50..60).contains(&y) => Rgb([200, 30, 30]),
                _ => Rgb([150 + (x / 4) as u8 + grain, 140 + (y / 4) as u8, 120 + grain]),
            }
        })
    }

    #[test]
    fn the_leaf_quality_holds_35_db_and_is_deterministic() {
        let image = facade();
        let bytes = encode_jpeg(&image, 88);
        assert_eq!(bytes, encode_jpeg(&image, 88));
        let back = image::load_from_memory(&bytes).unwrap().into_rgb8();
        let db = psnr(&image, &back);
        assert!(db > 35.0, "{db} dB");
    }

    #[test]
    fn halved_colours_are_read_by_decoders_that_know_one_scan_alone() {
        let image = facade();
        let back = image::load_from_memory(&encode_jpeg(&image, 80)).unwrap().into_rgb8();
        let db = psnr(&image, &back);
        assert!(db > 25.0, "{db} dB");
    }

    #[test]
    fn a_lower_quality_is_smaller() {
        assert!(encode_jpeg(&facade(), 80).len() * 5 < encode_jpeg(&facade(), 88).len() * 4);
    }
}
