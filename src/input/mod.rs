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
pub mod georeference;
pub mod gltf;
pub mod jpeg;
pub mod label_names;
pub mod labels;
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
    let mut all = Source::default();
    read_each(&found, config, u64::MAX, reporter, |source| all.append(source))?;
    all.share_images();
    Ok((all, found))
}

/// Reads the files of `found` and hands them on one by one, in order, each with materials and images of its own; as
/// many are read at a time as have `most_bytes` together, at least one.
///
/// # Errors
/// Those of the readers, of several the first in order, and those of `take`.
pub fn read_each(
    found: &Found,
    config: &InputConfig,
    most_bytes: u64,
    reporter: &Reporter,
    mut take: impl FnMut(Source) -> Result<()>,
) -> Result<()> {
    let bytes = |path: &PathBuf| std::fs::metadata(path).map_or(0, |m| m.len());
    let mut first = 0;
    while first < found.files.len() {
        let (mut end, mut sum) = (first + 1, bytes(&found.files[first]));
        while end < found.files.len() && sum.saturating_add(bytes(&found.files[end])) <= most_bytes {
            sum += bytes(&found.files[end]);
            end += 1;
        }
        read_batch(found, first..end, config, reporter, &mut take)?;
        first = end;
    }
    Ok(())
}

fn read_batch(
    found: &Found,
    batch: std::ops::Range<usize>,
    config: &InputConfig,
    reporter: &Reporter,
    take: &mut impl FnMut(Source) -> Result<()>,
) -> Result<()> {
    // Files after the first that failed need not be read; those before it must, as they may fail too.
    let first_failed = AtomicUsize::new(usize::MAX);
    let read = |i: usize| {
        if i > first_failed.load(Ordering::Relaxed) {
            return None;
        }
        let root = config.root.as_ref().unwrap_or(&found.roots[i]);
        let config = InputConfig { root: Some(root.clone()), ..config.clone() };
        let own = Reporter::new(true);
        let mut source = Source::default();
        let outcome = reporter.check().and_then(|()| read_file(&found.files[i], &config, &own, &mut source));
        if outcome.is_err() {
            first_failed.fetch_min(i, Ordering::Relaxed);
        }
        Some((outcome.map(|()| source), own.warnings()))
    };
    let sources: Vec<_> = batch.into_par_iter().map(read).collect();
    for (source, warnings) in sources.into_iter().flatten() {
        for warning in warnings {
            reporter.warn_many(warning.code, &warning.first_path, warning.count, warning.first);
        }
        take(source?)?;
    }
    Ok(())
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
    pub fn share_images(&mut self) {
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n";

    /// Code, count and first file of each kind.
    type Warnings = Vec<(&'static str, u64, PathBuf)>;

    /// Tiles that share one image and have one material each of the same name.
    fn tiles(names: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            fs::create_dir(folder.path().join(name)).unwrap();
            let text = format!("mtllib m.mtl\nusemtl grass\nf 1 2 3\nusemtl wall\n{TRIANGLE}");
            fs::write(folder.path().join(name).join("tile.obj"), text).unwrap();
            let mtl =
                format!("newmtl grass\nKd 0 1 0\nnewmtl wall\nmap_Kd {name}.jpg\nnewmtl unused\nmap_Kd gone.jpg\n");
            fs::write(folder.path().join(name).join("m.mtl"), mtl.replace("b.jpg", "../a/a.jpg")).unwrap();
            fs::write(folder.path().join(name).join(format!("{name}.jpg")), "x").unwrap();
        }
        folder
    }

    fn read_all(inputs: &[PathBuf]) -> (Result<(Source, Found)>, Warnings) {
        let reporter = Reporter::new(true);
        let outcome = read(inputs, &InputConfig::default(), &reporter);
        (outcome, reporter.warnings().into_iter().map(|w| (w.code, w.count, w.first_path)).collect())
    }

    #[test]
    fn files_are_merged_in_order_with_their_own_materials_and_shared_images() {
        let folder = tiles(&["c", "a", "b"]);
        let (outcome, warnings) = read_all(&[folder.path().to_path_buf()]);
        let (source, found) = outcome.unwrap();
        assert_eq!(warnings, []);
        let paths: Vec<_> = source.parts.iter().map(|part| part.path.clone()).collect();
        assert_eq!(paths, ["a", "b", "c"].map(|name| folder.path().join(name).join("tile.obj")));
        assert_eq!(paths, found.files);
        assert_eq!(source.parts.iter().map(|p| p.face_material.clone()).collect::<Vec<_>>(), [[0, 1], [2, 3], [4, 5]]);
        let images: Vec<_> = source.materials.iter().map(|m| m.image).collect();
        assert_eq!(images, [None, Some(0), None, Some(0), None, Some(1)], "tile b uses the image of tile a");
        assert_eq!(source.images.len(), 2);
    }

    #[test]
    fn thread_count_changes_neither_result_nor_warnings() {
        let names = ["a", "b", "c", "d", "e", "f", "g"];
        let folder = tiles(&names);
        for name in &names[2..] {
            fs::remove_file(folder.path().join(name).join("m.mtl")).unwrap();
        }
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let (outcome, warnings) = pool.install(|| read_all(&[folder.path().to_path_buf()]));
            (format!("{:?}", outcome.unwrap()), warnings)
        };
        let one = run(1);
        assert_eq!(one.1, [("missing-mtl", 5, folder.path().join("c/tile.obj"))]);
        assert_eq!(run(2), one);
        assert_eq!(run(8), one);
    }

    #[test]
    fn of_several_broken_files_the_first_is_told() {
        let folder = tiles(&["a", "b", "c", "d", "e"]);
        for name in ["b", "d", "e"] {
            fs::write(folder.path().join(name).join("tile.obj"), "nothing").unwrap();
        }
        let error = read_all(&[folder.path().to_path_buf()]).0.unwrap_err();
        assert!(matches!(&error, Error::Input { path, .. } if path.ends_with("b/tile.obj")), "{error}");
    }

    #[test]
    fn a_file_named_alone_may_not_refer_beside_its_folder_as_one_in_a_named_folder_may() {
        let folder = tiles(&["a", "b"]);
        let file = folder.path().join("b/tile.obj");
        assert!(matches!(read_all(std::slice::from_ref(&file)).0, Err(Error::Input { .. })));
        // Naming a second file elsewhere must not widen what the first may refer to.
        assert!(matches!(read_all(&[file, folder.path().join("a/tile.obj")]).0, Err(Error::Input { .. })));
        assert!(read_all(&[folder.path().to_path_buf()]).0.is_ok());
    }
}
