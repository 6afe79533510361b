//! Reads untrusted files into a [`Source`]; the only module that sees them.
//!
//! In: paths. Out: [`Source`], positions in source coordinates (f64), images not yet decoded.

use std::path::PathBuf;
use std::sync::Arc;

use glam::{DVec3, Vec2};

pub mod georeference;
pub mod gltf;
pub mod obj;
pub mod ply;

/// Everything the readers found, before welding. Indices are checked; positions are finite or their faces dropped.
#[derive(Debug, Default, Clone)]
pub struct Source {
    /// One part per file (or per glTF primitive).
    pub parts: Vec<Part>,
    /// Referenced by [`Part::face_material`].
    pub materials: Vec<Material>,
    /// Referenced by [`Material::image`].
    pub images: Vec<ImageRef>,
    /// Copyright texts found in the input, to be passed on.
    pub copyright: Vec<String>,
}

/// A triangle soup with shared vertices, in source coordinates (z up, source units).
#[derive(Debug, Default, Clone)]
pub struct Part {
    /// File or node it came from, for messages.
    pub path: PathBuf,
    /// Source coordinates: z up. glTF's y-up is turned by its reader.
    pub positions: Vec<DVec3>,
    /// Indices into `positions`, checked.
    pub faces: Vec<[u32; 3]>,
    /// Per face and corner, or empty if the part has none. Origin at the image's top left (v down, as in glTF).
    pub corner_uvs: Vec<[Vec2; 3]>,
    /// Per face, index into [`Source::materials`].
    pub face_material: Vec<u32>,
    /// Per vertex sRGB, or empty.
    pub vertex_colors: Vec<[u8; 3]>,
    /// Per face label as found (SUM numbering or -1), or empty.
    pub face_labels: Vec<i16>,
}

/// How a face is painted.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// Name in the input.
    pub name: String,
    /// sRGB colour where there is no image.
    pub base_color: [u8; 3],
    /// Index into [`Source::images`].
    pub image: Option<u32>,
}

/// An image, not decoded yet.
#[derive(Debug, Clone)]
pub enum ImageRef {
    /// A file that was found to exist.
    File(PathBuf),
    /// Encoded bytes from inside a container, with a name for messages.
    Encoded {
        /// For messages.
        name: String,
        /// JPEG, PNG or WebP bytes.
        bytes: Arc<[u8]>,
    },
    /// Pixels made in memory (synthetic cities).
    Pixels(Arc<image::RgbImage>),
}

/// What a reader may do.
#[derive(Debug, Clone, PartialEq)]
pub struct InputConfig {
    /// Follow paths that leave the input's folder. Default: false.
    pub allow_outside: bool,
}
