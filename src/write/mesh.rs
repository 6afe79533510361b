//! Writes a plain mesh with a class per face as PLY, OBJ or GLB, by the ending of its name; see [`super::painted`] for
//! one with a texture.
//!
//! # Method
//! 1. Put vertices and faces into an order that depends on the surface alone, see [`Plain::ordered`].
//! 2. Lay them out: PLY with `int label`, OBJ with a material per class, GLB with a feature per class.
//!
//! # Promises
//! - The same surface gives the same bytes, whatever the numbering it comes with: a mesh simplified to a size and one
//!   replayed to it are one file.
//! - [`write_all`] puts files in place only when all of them are written and synced.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use glam::DVec3;

use super::content::TileContent;
use super::glb::{GlbOptions, glb};
use super::obj::obj;
use super::ply::{Column, Ply, Values};
use crate::ids::{ClassId, ClassScheme};
use crate::{Error, Result};

/// A surface in source coordinates, metres, z up.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plain {
    /// Vertices.
    pub positions: Vec<DVec3>,
    /// Indices into `positions`.
    pub faces: Vec<[u32; 3]>,
    /// Per face, or empty if nobody classified it.
    pub classes: Vec<ClassId>,
}

/// The kinds of file that are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Binary, little endian, doubles.
    Ply,
    /// Text; decimals that read back as the same doubles.
    Obj,
    /// glTF; floats relative to the middle, y up.
    Glb,
}

impl Format {
    /// By the ending of `path`.
    ///
    /// # Errors
    /// [`Error::Config`] for any other ending.
    pub fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
        match ending.to_str() {
            Some("ply") => Ok(Self::Ply),
            Some("obj") => Ok(Self::Obj),
            Some("glb") => Ok(Self::Glb),
            _ => Err(Error::Config(format!("{}: wanted a name that ends in .ply, .obj or .glb", path.display()))),
        }
    }
}

impl Plain {
    /// The same surface in an order of its own: vertices by place, without those that no face uses; faces from their
    /// first vertex on, in order of their vertices.
    ///
    /// Vertices at one place are told apart by the faces around them; those that even they do not tell apart stay in
    /// the order given.
    pub fn ordered(&self) -> Self {
        let bits = |v: u32| self.positions[v as usize].to_array().map(|x| (x + 0.0).to_bits());
        let mut around = vec![0u64; self.positions.len()];
        let mut used = vec![false; self.positions.len()];
        for face in &self.faces {
            for k in 0..3 {
                let [v, a, b] = [face[k], face[(k + 1) % 3], face[(k + 2) % 3]];
                // A sum does not depend on the order of faces.
                let mixed = bits(a).into_iter().chain(bits(b)).fold(0u64, mix);
                around[v as usize] = around[v as usize].wrapping_add(mixed);
                used[v as usize] = true;
            }
        }
        let mut order: Vec<u32> = (0..self.positions.len() as u32).filter(|&v| used[v as usize]).collect();
        order.sort_by(|&a, &b| {
            let [p, q] = [a, b].map(|v| self.positions[v as usize]);
            let places = p.x.total_cmp(&q.x).then(p.y.total_cmp(&q.y)).then(p.z.total_cmp(&q.z));
            places.then(around[a as usize].cmp(&around[b as usize]))
        });
        let mut number = vec![0u32; self.positions.len()];
        order.iter().enumerate().for_each(|(i, &v)| number[v as usize] = i as u32);
        let class = |f: usize| self.classes.get(f).copied();
        let turned = |face: &[u32; 3]| {
            let [a, b, c] = face.map(|v| number[v as usize]);
            [[a, b, c], [b, c, a], [c, a, b]].into_iter().min_by_key(|f| f[0]).unwrap_or([a, b, c])
        };
        let mut faces: Vec<([u32; 3], Option<ClassId>)> =
            self.faces.iter().enumerate().map(|(f, face)| (turned(face), class(f))).collect();
        faces.sort_unstable();
        Self {
            positions: order.iter().map(|&v| self.positions[v as usize]).collect(),
            faces: faces.iter().map(|f| f.0).collect(),
            classes: faces.iter().filter_map(|f| f.1).collect(),
        }
    }

    /// The bytes of a file. Writes things in the order in which they are.
    ///
    /// # Errors
    /// [`Error::Bug`] for indices past the end or a class that `scheme` does not have.
    pub fn bytes(&self, format: Format, scheme: &ClassScheme) -> Result<Vec<u8>> {
        self.check(scheme)?;
        match format {
            Format::Ply => self.ply(scheme).bytes(),
            Format::Obj => Ok(obj(&self.positions, &self.faces, &self.classes, scheme)),
            Format::Glb => {
                let content = self.content(scheme);
                content.check(scheme).map_err(Error::Bug)?;
                Ok(glb(&content, scheme, &GlbOptions::default()))
            }
        }
    }

    /// Indices and classes are in range, or it is a bug.
    pub(super) fn check(&self, scheme: &ClassScheme) -> Result<()> {
        let count = self.positions.len();
        let labelled = self.classes.is_empty() || self.classes.len() == self.faces.len();
        let known = self.classes.iter().all(|c| c.index() < scheme.len());
        if !labelled || !known || self.faces.iter().flatten().any(|v| *v as usize >= count) {
            return Err(Error::Bug(format!("a mesh of {count} vertices that does not hold together")));
        }
        Ok(())
    }

    /// The middle of the surface's box, whole metres.
    pub(super) fn origin(&self) -> DVec3 {
        let low = self.positions.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        let high = self.positions.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
        ((low + high) * 0.5).round()
    }

    fn ply(&self, scheme: &ClassScheme) -> Ply<'_> {
        let mut ply = Ply { faces: self.faces.as_slice().into(), ..Ply::default() };
        ply.vertex.extend(Column::positions(&self.positions));
        if !self.classes.is_empty() {
            ply.comments = scheme.ids().map(|c| format!("label {} {}", c.0, scheme[c].name)).collect();
            let labels: Vec<i32> = self.classes.iter().map(|c| i32::from(c.0)).collect();
            ply.face.push(Column::new("label", Values::I32(labels.into())));
        }
        ply
    }

    /// A vertex for each class that uses it, in the order of faces.
    fn content(&self, scheme: &ClassScheme) -> TileContent {
        let origin = self.origin();
        let mut content = TileContent { origin, ..TileContent::default() };
        let class = |f: usize| self.classes.get(f).copied().unwrap_or(ClassId(0));
        let mut corners: Vec<(u32, ClassId)> =
            self.faces.iter().enumerate().flat_map(|(f, face)| face.map(|v| (v, class(f)))).collect();
        corners.sort_unstable();
        corners.dedup();
        for &(v, class) in &corners {
            content.positions.push((self.positions[v as usize] - origin).as_vec3());
            content.class_of_vertex.push(class);
            if !self.classes.is_empty() {
                content.colors.push(scheme[class].color);
            }
        }
        let number = |corner: (u32, ClassId)| corners.partition_point(|c| *c < corner) as u32;
        content.faces = self.faces.iter().enumerate().map(|(f, face)| face.map(|v| number((v, class(f))))).collect();
        content
    }
}

/// A step of a hash; the constant is that of SplitMix64.
fn mix(hash: u64, bits: u64) -> u64 {
    let mut x = (hash ^ bits).wrapping_add(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

/// Refuses outputs that are folders, inputs, named twice, or in a folder that does not exist; so that nobody waits for a
/// result that cannot be written.
///
/// # Errors
/// [`Error::Output`].
pub fn admit(paths: &[&Path], inputs: &[&Path]) -> Result<()> {
    for (i, path) in paths.iter().enumerate() {
        let refuse = |what: &str| Err(Error::Output { path: path.to_path_buf(), what: what.into() });
        if path.file_name().is_none() || path.is_dir() {
            return refuse("is a folder where a file is to be written; name a file");
        }
        if paths[..i].contains(path) {
            return refuse("is named for two outputs; name another file for one of them");
        }
        let real = path.canonicalize().ok();
        if real.is_some() && inputs.iter().any(|input| input.canonicalize().ok() == real) {
            return refuse("is the input itself; name another output");
        }
        if !folder_of(path).is_dir() {
            return refuse("lies in a folder that does not exist; make it or name another");
        }
    }
    Ok(())
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes files beside their places, syncs them, and renames them into place when all are there.
///
/// # Errors
/// [`Error::Io`]; what was not renamed yet is removed.
pub fn write_all(files: &[(&Path, &[u8])]) -> Result<()> {
    let partial = |path: &Path| -> PathBuf {
        let mut name = OsString::from(".");
        name.push(path.file_name().unwrap_or_default());
        name.push(format!(".partial-{}", std::process::id()));
        path.with_file_name(name)
    };
    let written = files.iter().try_for_each(|(path, bytes)| {
        let beside = partial(path);
        let file = File::create(&beside).and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()));
        file.map_err(Error::io("write", path))
    });
    let placed = written.and_then(|()| {
        files.iter().try_for_each(|(path, _)| fs::rename(partial(path), path).map_err(Error::io("rename", path)))
    });
    if placed.is_err() {
        // What was renamed is whole; the rest goes.
        files.iter().for_each(|(path, _)| drop(fs::remove_file(partial(path))));
    }
    placed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::{self, InputConfig};
    use crate::report::Reporter;

    fn pyramid() -> Plain {
        let far = DVec3::new(400_000.0, 5_000_000.0, 10.0);
        let positions = [[0., 0., 0.], [9., 9., 9.], [1., 0., 0.], [1., 1., 0.1], [0.5, 0.5, 1.]];
        Plain {
            positions: positions.iter().map(|p| far + DVec3::from_array(*p)).collect(),
            faces: vec![[2, 3, 4], [0, 2, 4], [3, 0, 4]],
            classes: vec![ClassId::ROOF, ClassId::FACADE, ClassId::ROOF],
        }
    }

    /// The same surface under other numbers.
    fn renamed(mesh: &Plain) -> Plain {
        let last = mesh.positions.len() as u32 - 1;
        let mut other = mesh.clone();
        other.positions.reverse();
        other.faces = mesh.faces.iter().rev().map(|[a, b, c]| [last - c, last - a, last - b]).collect();
        other.classes.reverse();
        other
    }

    #[test]
    fn the_order_forgets_the_numbering() {
        let mesh = pyramid();
        assert_eq!(mesh.ordered(), renamed(&mesh).ordered());
        assert_eq!(mesh.ordered().positions.len(), 4, "the vertex that no face uses goes");
        assert_eq!(mesh.ordered().ordered(), mesh.ordered());
    }

    #[test]
    fn vertices_at_one_place_are_told_apart_by_their_faces() {
        let mut mesh = pyramid();
        mesh.positions[1] = mesh.positions[4];
        mesh.faces[0] = [2, 3, 1];
        assert_eq!(mesh.ordered(), renamed(&mesh).ordered());
        assert_eq!(mesh.ordered().positions.len(), 5);
    }

    #[test]
    fn every_format_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let scheme = ClassScheme::default();
        let mesh = pyramid().ordered();
        for name in ["a.ply", "a.obj", "a.GLB"] {
            let path = folder.path().join(name);
            let bytes = mesh.bytes(Format::of(&path).unwrap(), &scheme).unwrap();
            write_all(&[(&path, &bytes)]).unwrap();
            let (source, _) = input::read(&[path], &InputConfig::default(), &Reporter::new(true)).unwrap();
            assert_eq!(source.parts.iter().map(|p| p.faces.len()).sum::<usize>(), 3, "{name}");
            if name == "a.ply" {
                let labels: Vec<i16> = mesh.classes.iter().map(|c| i16::from(c.0)).collect();
                assert_eq!(source.parts[0].face_labels, labels);
            }
            if name != "a.GLB" {
                let part = &source.parts[0];
                let corner = |f: usize, k: usize| part.positions[part.faces[f][k] as usize];
                let all: Vec<DVec3> = (0..3).flat_map(|f| [0, 1, 2].map(|k| corner(f, k))).collect();
                let mut wanted: Vec<DVec3> = mesh.faces.iter().flatten().map(|&v| mesh.positions[v as usize]).collect();
                let mut found = all;
                // OBJ has its faces by class.
                for points in [&mut wanted, &mut found] {
                    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)).then(a.z.total_cmp(&b.z)));
                }
                assert_eq!(found, wanted, "{name}");
            }
        }
        assert_eq!(Format::of(Path::new("a.stl")).unwrap_err().exit_code(), 2);
    }

    #[test]
    fn all_files_appear_or_none() {
        let folder = tempfile::tempdir().unwrap();
        let (good, bad) = (folder.path().join("a.ply"), folder.path().join("gone/b.ply"));
        assert_eq!(write_all(&[(&good, b"a"), (&bad, b"b")]).unwrap_err().exit_code(), 6);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        assert_eq!(admit(&[&bad], &[]).unwrap_err().exit_code(), 5);
        write_all(&[(&good, b"a")]).unwrap();
        admit(&[&good], &[&bad]).unwrap();
        assert!(admit(&[&good], &[&good]).unwrap_err().to_string().contains("the input itself"));
        assert!(admit(&[&good, &good], &[]).is_err());
        assert!(admit(&[folder.path()], &[]).is_err());
    }

    #[test]
    fn a_mesh_that_does_not_hold_together_is_our_bug() {
        let mut mesh = pyramid();
        mesh.classes.pop();
        assert_eq!(mesh.bytes(Format::Ply, &ClassScheme::default()).unwrap_err().exit_code(), 7);
    }
}
