//! Reads untrusted files into a [`Source`]; the only module that sees them.
//!
//! In: paths. Out: [`Source`], positions in source coordinates (f64), images not yet decoded.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DVec3, Vec2};
use rayon::prelude::*;

use self::discover::Found;
use crate::report::Reporter;
use crate::{Error, Result};

pub mod discover;
pub mod gltf;
mod lines;
mod mtl;
pub mod obj;
pub mod path;
pub mod ply;
pub mod triangulate;

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
#[derive(Debug, Default, Clone, PartialEq)]
pub struct InputConfig {
    /// Follow paths that leave the input's folder. Default: false.
    pub allow_outside: bool,
    /// The folder whose inside is allowed. Default: the folder named as input, or that of the file named.
    pub root: Option<PathBuf>,
}

/// sRGB of what has no colour of its own: a grey between the usual roofs and roads.
pub const DEFAULT_COLOR: [u8; 3] = [180, 180, 180];

/// Finds the files that `inputs` mean and reads them all, in parallel.
///
/// The result and the warnings are in the order of [`Found::files`], whatever the order in which files are done; of
/// several errors the first in that order is returned.
///
/// # Errors
/// Those of [`discover::discover`] and of the readers.
pub fn read(inputs: &[PathBuf], config: &InputConfig, reporter: &Reporter) -> Result<(Source, Found)> {
    let found = discover::discover(inputs, reporter)?;
    // Files after the first that failed need not be read; those before it must, as they may fail too.
    let first_failed = AtomicUsize::new(usize::MAX);
    let read = |(i, path): (usize, &PathBuf)| {
        if i > first_failed.load(Ordering::Relaxed) {
            return None;
        }
        let root = config.root.as_ref().unwrap_or(&found.roots[i]);
        let config = InputConfig { root: Some(root.clone()), ..config.clone() };
        let own = Reporter::new(true);
        let mut source = Source::default();
        let outcome = reporter.check().and_then(|()| read_file(path, &config, &own, &mut source));
        if outcome.is_err() {
            first_failed.fetch_min(i, Ordering::Relaxed);
        }
        Some((outcome.map(|()| source), own.warnings()))
    };
    let sources: Vec<_> = found.files.par_iter().enumerate().map(read).collect();
    let mut all = Source::default();
    for (source, warnings) in sources.into_iter().flatten() {
        for warning in warnings {
            reporter.warn_many(warning.code, &warning.first_path, warning.count, warning.first);
        }
        all.append(source?)?;
    }
    all.share_images();
    Ok((all, found))
}

fn read_file(path: &Path, config: &InputConfig, reporter: &Reporter, source: &mut Source) -> Result<()> {
    match discover::ending(path) {
        Some("obj") => obj::read(path, config, reporter, source),
        Some("glb" | "gltf") => gltf::read(path, config, reporter, source),
        Some("ply") => ply::read(path, config, reporter, source),
        _ => Err(Error::Unsupported { path: path.to_path_buf(), what: "is of a kind that is not read".into() }),
    }
}

impl Source {
    /// Adds the parts of `other`, its materials and images renumbered to follow this source's.
    ///
    /// # Errors
    /// [`Error::Limit`] for more than 2^32 materials or images.
    pub fn append(&mut self, other: Self) -> Result<()> {
        let offset = |ours: usize, theirs: usize, what: &str| {
            let path = || other.parts.first().map(|part| part.path.clone()).unwrap_or_default();
            u32::try_from(ours + theirs).map(|end| end - theirs as u32).map_err(|_| Error::Limit {
                path: path(),
                what: format!("brings the {what} over 2^32; convert fewer files at once"),
            })
        };
        let material_offset = offset(self.materials.len(), other.materials.len(), "materials")?;
        let image_offset = offset(self.images.len(), other.images.len(), "images")?;
        self.parts.extend(other.parts.into_iter().map(|mut part| {
            part.face_material.iter_mut().for_each(|material| *material += material_offset);
            part
        }));
        self.materials.extend(other.materials.into_iter().map(|mut material| {
            material.image = material.image.map(|image| image + image_offset);
            material
        }));
        self.images.extend(other.images);
        for text in other.copyright {
            if !self.copyright.contains(&text) {
                self.copyright.push(text);
            }
        }
        Ok(())
    }

    /// Lets all materials that name one image file share one image.
    fn share_images(&mut self) {
        let mut first: HashMap<PathBuf, u32> = HashMap::new();
        let mut kept = Vec::with_capacity(self.images.len());
        let ids: Vec<u32> = std::mem::take(&mut self.images)
            .into_iter()
            .map(|image| {
                let next = kept.len() as u32;
                let id = match &image {
                    ImageRef::File(path) => *first.entry(path.clone()).or_insert(next),
                    _ => next,
                };
                if id == next {
                    kept.push(image);
                }
                id
            })
            .collect();
        self.images = kept;
        for material in &mut self.materials {
            material.image = material.image.map(|image| ids[image as usize]);
        }
    }
}
