//! Images of a tile: how large they are, undecoded.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::Arc;

use super::mesh::Texture;
use crate::Result;
use crate::input::gltf::data::Data;
use crate::input::gltf::schema::{Int, TextureInfo};
use crate::input::gltf::uri;

const KTX2_MAGIC: &[u8] = b"\xABKTX 20\xBB\r\n\x1A\n";

/// The images of one glTF that were asked for.
pub struct Images<'a> {
    data: &'a Data<'a>,
    find: &'a dyn Fn(&str) -> Result<Vec<u8>>,
    /// By image index, its place in `textures`.
    known: BTreeMap<u64, usize>,
    pub textures: Vec<Texture>,
}

impl<'a> Images<'a> {
    pub fn new(data: &'a Data<'a>, find: &'a dyn Fn(&str) -> Result<Vec<u8>>) -> Self {
        Self { data, find, known: BTreeMap::new(), textures: Vec::new() }
    }

    /// The place in [`Self::textures`] of the image that `info` shows. `None` if it names none.
    pub fn place(&mut self, info: &TextureInfo) -> Result<Option<usize>> {
        let data = self.data;
        let index = info.index.ok_or_else(|| data.refuse("a textureInfo has no index"))?;
        let texture = data.at(&data.root.textures, index, "texture")?;
        let sources = [&texture.extensions.basisu, &texture.extensions.webp];
        let source = sources.into_iter().flatten().find_map(|s| s.source).or(texture.source);
        let Some(source) = source else { return Ok(None) };
        if let Some(&known) = self.known.get(&source.0) {
            return Ok(Some(known));
        }
        let encoded = self.encoded(source)?;
        let (size_px, format) = measure(&encoded);
        self.textures.push(Texture { size_px, format, encoded });
        self.known.insert(source.0, self.textures.len() - 1);
        Ok(Some(self.textures.len() - 1))
    }

    fn encoded(&self, index: Int) -> Result<Arc<[u8]>> {
        let data = self.data;
        let image = data.at(&data.root.images, index, "image")?;
        Ok(match (&image.uri, image.buffer_view) {
            (Some(text), _) if uri::is_data(text) => uri::data(text).map(|(_, bytes)| bytes).unwrap_or_default().into(),
            (Some(text), _) => (self.find)(text)?.into(),
            (None, Some(view)) => data.view(view)?.bytes.into(),
            (None, None) => Vec::new().into(),
        })
    }
}

/// Width and height from the header, and what it is a header of.
fn measure(bytes: &[u8]) -> (Option<[u32; 2]>, &'static str) {
    if bytes.starts_with(KTX2_MAGIC) {
        let word = |at: usize| bytes.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes);
        return (word(20).zip(word(24)).map(|(width, height)| [width, height.max(1)]), "ktx2");
    }
    let Ok(reader) = image::ImageReader::new(Cursor::new(bytes)).with_guessed_format() else {
        return (None, "unknown");
    };
    let format = match reader.format() {
        Some(image::ImageFormat::Jpeg) => "jpeg",
        Some(image::ImageFormat::Png) => "png",
        Some(image::ImageFormat::WebP) => "webp",
        _ => return (None, "unknown"),
    };
    (reader.into_dimensions().ok().map(|(width, height)| [width, height]), format)
}
