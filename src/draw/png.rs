//! PNG bytes of pictures.

use std::io::Cursor;
use std::path::Path;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, RgbImage};

use crate::{Error, Result};

/// The picture as PNG: eight bits, RGB, no date or other text inside. A picture without pixels becomes one white pixel,
/// as the format has no empty pictures.
///
/// # Errors
/// [`Error::Bug`] if the encoder refuses, which no picture causes.
pub fn bytes(picture: &RgbImage) -> Result<Vec<u8>> {
    let white = RgbImage::from_pixel(1, 1, image::Rgb([255; 3]));
    let picture = if picture.width() == 0 || picture.height() == 0 { &white } else { picture };
    let mut bytes = Cursor::new(Vec::new());
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Default, FilterType::Adaptive)
        .write_image(picture.as_raw(), picture.width(), picture.height(), ExtendedColorType::Rgb8)
        .map_err(|error| Error::Bug(format!("a picture could not be written as PNG: {error}")))?;
    Ok(bytes.into_inner())
}

/// Writes the picture to `path`, replacing what is there.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write(picture: &RgbImage, path: &Path) -> Result<()> {
    std::fs::write(path, bytes(picture)?).map_err(Error::io("write", path))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_comes_back_as_it_was() {
        let picture = RgbImage::from_fn(37, 11, |x, y| image::Rgb([(x * 7) as u8, (y * 20) as u8, (x * y) as u8]));
        let png = bytes(&picture).expect("a PNG");
        assert_eq!(png, bytes(&picture).expect("a PNG"));
        assert_eq!(image::load_from_memory(&png).expect("readable").to_rgb8(), picture);
        assert!(bytes(&RgbImage::new(0, 5)).is_ok());
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let error = write(&RgbImage::new(1, 1), Path::new("no-such-folder/a.png")).expect_err("no folder");
        assert!(error.to_string().contains("no-such-folder/a.png"), "{error}");
    }
}
