//! Materials and images, taken over when a face first uses them.

use std::collections::BTreeMap;
use std::path::Path;

use super::data::{Data, shorten};
use super::schema::{Int, Material as GltfMaterial, TextureInfo, TextureTransform};
use super::uri;
use crate::input::{ImageRef, Material, Source};
use crate::report::Reporter;
use crate::{Error, Result};

/// sRGB of a material whose image cannot be had.
pub const GREY: [u8; 3] = [128; 3];
/// Image containers known but not decoded here.
const UNREAD_EXTENSIONS: [&str; 5] = ["ktx2", "ktx", "basis", "dds", "avif"];

/// What a primitive needs to know of its material.
#[derive(Debug, Clone, Copy)]
pub struct Paint {
    /// Texture coordinate set of the base colour image; `None`: there is no image.
    pub uv_set: Option<u64>,
    pub transform: Option<TextureTransform>,
    /// Linear base colour.
    pub factor: [f64; 3],
}

/// The materials and images of one glTF file, by where they end up in the [`Source`].
pub struct Palette<'a> {
    data: &'a Data<'a>,
    reporter: &'a Reporter,
    /// By glTF material (`None`: the default one) and whether its image is used.
    materials: BTreeMap<(Option<Int>, bool), u32>,
    /// By content, so that an image named twice is kept once. `None`: it cannot be had.
    images: BTreeMap<String, Option<u32>>,
}

impl<'a> Palette<'a> {
    pub fn new(data: &'a Data<'a>, reporter: &'a Reporter) -> Self {
        Self { data, reporter, materials: BTreeMap::new(), images: BTreeMap::new() }
    }

    /// How faces of glTF material `index` are painted.
    pub fn paint(&self, index: Option<Int>) -> Result<Paint> {
        let (factor, texture) = self.base(index)?;
        let transform = texture.and_then(|t| t.extensions.transform);
        let uv_set = texture.map(|t| transform.and_then(|t| t.tex_coord).or(t.tex_coord).map_or(0, |set| set.0));
        Ok(Paint { uv_set, transform, factor })
    }

    /// The place in `source` of glTF material `index`, with its image only if `textured`.
    pub fn place(&mut self, index: Option<Int>, textured: bool, source: &mut Source) -> Result<u32> {
        if let Some(&known) = self.materials.get(&(index, textured)) {
            return Ok(known);
        }
        let (factor, texture) = self.base(index)?;
        let image = match texture {
            Some(texture) if textured => self.texture(texture, source)?,
            _ => None,
        };
        if image.is_some() && factor.iter().any(|&f| f < TINT_FROM) {
            let what = "baseColorFactor tints an image; the image is used as it is";
            self.reporter.warn("texture-tint-ignored", self.data.path, what);
        }
        let name = match index {
            Some(index) => self.data.at(&self.data.root.materials, index, "material")?.name.clone(),
            None => Some("default".into()),
        };
        let base_color = if texture.is_some() && image.is_none() { GREY } else { factor.map(srgb) };
        let name = name.unwrap_or_else(|| format!("material {}", index.map_or(0, |i| i.0)));
        let place = source.materials.len() as u32;
        source.materials.push(Material { name, base_color, image });
        self.materials.insert((index, textured), place);
        Ok(place)
    }

    /// Linear base colour and base colour texture.
    pub fn base(&self, index: Option<Int>) -> Result<([f64; 3], Option<&'a TextureInfo>)> {
        let Some(index) = index else { return Ok(([1.0; 3], None)) };
        let material: &GltfMaterial = self.data.at(&self.data.root.materials, index, "material")?;
        let metallic = material.pbr_metallic_roughness.as_ref();
        let (factor, texture) = match (metallic, &material.extensions.specular_glossiness) {
            (None, Some(specular)) => (specular.diffuse_factor, specular.diffuse_texture.as_ref()),
            (metallic, _) => {
                (metallic.and_then(|m| m.base_color_factor), metallic.and_then(|m| m.base_color_texture.as_ref()))
            }
        };
        let [r, g, b, _] = factor.unwrap_or([1.0; 4]);
        Ok(([r, g, b], texture))
    }

    fn texture(&mut self, info: &TextureInfo, source: &mut Source) -> Result<Option<u32>> {
        let data = self.data;
        let index = info.index.ok_or_else(|| data.refuse("a textureInfo has no index"))?;
        let texture = data.at(&data.root.textures, index, "texture")?;
        let webp = texture.extensions.webp.as_ref().and_then(|webp| webp.source);
        for wanted in [webp, texture.source].into_iter().flatten() {
            let found = self.image(wanted, source)?;
            if found.is_some() {
                return Ok(found);
            }
        }
        if webp.or(texture.source).is_none() {
            let what = format!("texture {} has no JPEG, PNG or WebP source; its faces are grey", index.0);
            self.reporter.warn("unsupported-texture", data.path, what);
        }
        Ok(None)
    }

    fn image(&mut self, index: Int, source: &mut Source) -> Result<Option<u32>> {
        let data = self.data;
        let image = data.at(&data.root.images, index, "image")?;
        let key = match (&image.uri, image.buffer_view) {
            (Some(text), _) if uri::is_data(text) => format!("image {}", index.0),
            (Some(text), _) => format!("uri {text}"),
            (None, Some(view)) => format!("view {}", view.0),
            (None, None) => return Err(data.refuse(format!("image {} has neither uri nor bufferView", index.0))),
        };
        if let Some(&known) = self.images.get(&key) {
            return Ok(known);
        }
        let found = match (&image.uri, image.buffer_view) {
            (Some(text), _) if uri::is_data(text) => self.encoded(index, uri::data(text).map(|(_, bytes)| bytes)),
            (Some(text), _) => self.file(text)?,
            (None, Some(view)) => self.encoded(index, Some(data.view(view)?.bytes.to_vec())),
            (None, None) => None,
        };
        let place = found.map(|image| {
            source.images.push(image);
            source.images.len() as u32 - 1
        });
        self.images.insert(key, place);
        Ok(place)
    }

    fn encoded(&self, index: Int, bytes: Option<Vec<u8>>) -> Option<ImageRef> {
        let name = format!("{} image {}", self.data.path.display(), index.0);
        match bytes {
            Some(bytes) if is_decodable(&bytes) => return Some(ImageRef::Encoded { name, bytes: bytes.into() }),
            _ => {
                let what = format!("image {} is not JPEG, PNG or WebP; its faces are grey", index.0);
                self.reporter.warn("unsupported-texture", self.data.path, what);
            }
        }
        None
    }

    fn file(&self, text: &str) -> Result<Option<ImageRef>> {
        let path = match self.data.resolve(text) {
            Err(Error::Io { .. }) => {
                let what = format!("image {:?} cannot be found; its faces are grey", shorten(text));
                self.reporter.warn("missing-texture", self.data.path, what);
                return Ok(None);
            }
            other => other?,
        };
        if has_extension(&path, &UNREAD_EXTENSIONS) {
            let what = format!("image {:?} is not JPEG, PNG or WebP; its faces are grey", shorten(text));
            self.reporter.warn("unsupported-texture", self.data.path, what);
            return Ok(None);
        }
        Ok(Some(ImageRef::File(path)))
    }
}

/// Factors from here on are white to the eye: half a step of 8 bits.
const TINT_FROM: f64 = 1.0 - 0.5 / 255.0;

fn has_extension(path: &Path, among: &[&str]) -> bool {
    path.extension().is_some_and(|found| among.iter().any(|e| found.eq_ignore_ascii_case(e)))
}

/// JPEG, PNG or WebP by the first bytes.
fn is_decodable(bytes: &[u8]) -> bool {
    bytes.starts_with(b"\xFF\xD8\xFF")
        || bytes.starts_with(b"\x89PNG\r\n\x1A\n")
        || (bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP"))
}

/// A linear component as 8-bit sRGB (IEC 61966-2-1); NaN is black.
pub fn srgb(linear: f64) -> u8 {
    let linear = linear.clamp(0.0, 1.0);
    let encoded = if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0).round() as u8
}
