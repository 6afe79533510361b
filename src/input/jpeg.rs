//! Decodes JPEGs, those too that the decoder of [`image`] gets wrong.
//!
//! In: an encoded image. Out: its pixels.
//!
//! # Why not `image` alone
//! Where colours are halved and each comes in a scan of its own, as encoders write it that fit their tables to the image,
//! it gives green stripes, and no error (zune-jpeg 0.5.15). The roots of a tileset, which are painted from finer tiles, were
//! green once.

use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};

use image::RgbImage;
use jpeg_decoder::{Decoder, PixelFormat};

/// What a JPEG begins with.
pub const MAGIC: [u8; 2] = [0xFF, 0xD8];

/// The pixels of a JPEG; `None` if it is broken, has inks instead of colours, or its pixels take more than `most_bytes`.
/// Coefficients of several scans are held beside them.
pub fn decode(encoded: impl Read, most_bytes: usize) -> Option<RgbImage> {
    let mut decoder = Decoder::new(encoded);
    decoder.set_max_decoding_buffer_size(most_bytes);
    // Decoders are known to panic on some broken files: that is one image, not the end of a run.
    let pixels = catch_unwind(AssertUnwindSafe(|| decoder.decode())).ok()?.ok()?;
    let info = decoder.info()?;
    let rgb = match info.pixel_format {
        PixelFormat::RGB24 => pixels,
        PixelFormat::L8 => pixels.iter().flat_map(|&grey| [grey; 3]).collect(),
        _ => return None,
    };
    RgbImage::from_raw(info.width.into(), info.height.into(), rgb)
}

#[cfg(test)]
mod tests {
    use image::Rgb;
    use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

    use super::*;

    #[test]
    fn halved_colours_in_scans_of_their_own_are_no_green_stripes() {
        let image = RgbImage::from_fn(64, 48, |x, y| Rgb([(x * 3) as u8, 120, (y * 4) as u8]));
        for sampling in [SamplingFactor::R_4_2_0, SamplingFactor::R_4_4_4] {
            let mut bytes = Vec::new();
            let mut encoder = Encoder::new(&mut bytes, 90);
            encoder.set_sampling_factor(sampling);
            encoder.set_optimized_huffman_tables(true);
            encoder.encode(image.as_raw(), 64, 48, ColorType::Rgb).unwrap();
            let back = decode(&bytes[..], 1 << 20).unwrap();
            let furthest = image.pixels().zip(back.pixels()).flat_map(|(a, b)| (0..3).map(|k| a[k].abs_diff(b[k])));
            assert!(furthest.max() < Some(24));
        }
    }

    #[test]
    fn what_is_broken_or_too_large_is_nothing() {
        assert_eq!(decode(&[0xFF, 0xD8, 0xFF][..], 1 << 20), None);
        assert_eq!(decode(&b"no image"[..], 1 << 20), None);
    }
}
