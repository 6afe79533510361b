//! Writes PLY: any columns per vertex, triangles, any columns and lists per face; binary, little endian.
//!
//! In: [`Ply`], borrowed columns. Out: bytes that CloudCompare, MeshLab and our own reader understand.
//!
//! # Method
//! 1. `check` holds the columns against each other; 2. the header names them; 3. rows follow, in buffered chunks.
//!
//! # Promises
//! Same columns, same bytes. [`Ply::write`] puts a file in place whole or not at all.
//! `what_was_written_is_read_back` has our reader look at every kind of column.

use std::borrow::Cow;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use glam::{DVec3, Vec2};

use crate::{Error, Result};

/// A PLY file in the making.
#[derive(Debug, Clone, Default)]
pub struct Ply<'a> {
    /// One line each, for instance `TextureFile wall.jpg`; line breaks become spaces.
    pub comments: Vec<String>,
    /// Columns of element `vertex`, in order.
    pub vertex: Vec<Column<'a>>,
    /// `list uchar int vertex_indices` of element `face`; without faces there is no such element.
    pub faces: Cow<'a, [[u32; 3]]>,
    /// Further columns of element `face`, in order.
    pub face: Vec<Column<'a>>,
}

/// A property with a value (or a list) for each row.
#[derive(Debug, Clone)]
pub struct Column<'a> {
    /// ASCII without spaces, as in `scalar_height`.
    pub name: Cow<'a, str>,
    /// A value per row.
    pub values: Values<'a>,
}

/// Values of a column.
#[derive(Debug, Clone)]
pub enum Values<'a> {
    /// `uchar`
    U8(Cow<'a, [u8]>),
    /// `short`
    I16(Cow<'a, [i16]>),
    /// `int`
    I32(Cow<'a, [i32]>),
    /// `uint`
    U32(Cow<'a, [u32]>),
    /// `float`
    F32(Cow<'a, [f32]>),
    /// `double`
    F64(Cow<'a, [f64]>),
    /// `list uchar float`: as many a row, one row after the other.
    ListF32 {
        /// Items of a row, 1 to 255.
        per_row: u8,
        /// All items.
        items: Cow<'a, [f32]>,
    },
}

impl<'a> Column<'a> {
    /// A column of `values` called `name`.
    pub fn new(name: impl Into<Cow<'a, str>>, values: Values<'a>) -> Self {
        Self { name: name.into(), values }
    }

    /// A `float` column.
    pub fn f32(name: impl Into<Cow<'a, str>>, values: impl Into<Cow<'a, [f32]>>) -> Self {
        Self::new(name, Values::F32(values.into()))
    }

    /// An `int` column.
    pub fn i32(name: impl Into<Cow<'a, str>>, values: impl Into<Cow<'a, [i32]>>) -> Self {
        Self::new(name, Values::I32(values.into()))
    }

    /// `double x, y, z`.
    pub fn positions(positions: &[DVec3]) -> [Self; 3] {
        ["x", "y", "z"]
            .into_iter()
            .enumerate()
            .map(|(k, name)| {
                let values: Vec<f64> = positions.iter().map(|p| p[k]).collect();
                Self::new(name, Values::F64(values.into()))
            })
            .collect::<Vec<_>>()
            .try_into()
            .unwrap_or_else(|_| unreachable!("three names"))
    }

    /// `uchar red, green, blue`, per vertex or face.
    pub fn colors(colors: &[[u8; 3]]) -> [Self; 3] {
        let channel = |name: &'a str, k: usize| {
            let values: Vec<u8> = colors.iter().map(|c| c[k]).collect();
            Self::new(name, Values::U8(values.into()))
        };
        [channel("red", 0), channel("green", 1), channel("blue", 2)]
    }

    /// `list uchar float texcoord` per face: six numbers, u and v of each corner. `corner_uvs` have v down; PLY's goes
    /// up. Needs a comment `TextureFile NAME`.
    pub fn texcoords(corner_uvs: &[[Vec2; 3]]) -> Self {
        let items: Vec<f32> = corner_uvs.iter().flatten().flat_map(|uv| [uv.x, 1.0 - uv.y]).collect();
        Self::new("texcoord", Values::ListF32 { per_row: 6, items: items.into() })
    }
}

impl Values<'_> {
    /// How the header calls them.
    fn kind(&self) -> &'static str {
        match self {
            Self::U8(_) => "uchar",
            Self::I16(_) => "short",
            Self::I32(_) => "int",
            Self::U32(_) => "uint",
            Self::F32(_) => "float",
            Self::F64(_) => "double",
            Self::ListF32 { .. } => "list uchar float",
        }
    }

    fn rows(&self) -> usize {
        match self {
            Self::U8(v) => v.len(),
            Self::I16(v) => v.len(),
            Self::I32(v) => v.len(),
            Self::U32(v) => v.len(),
            Self::F32(v) => v.len(),
            Self::F64(v) => v.len(),
            Self::ListF32 { per_row, items } => items.len() / usize::from(*per_row).max(1),
        }
    }

    fn put(&self, row: usize, out: &mut impl Write) -> io::Result<()> {
        match self {
            Self::U8(v) => out.write_all(&[v[row]]),
            Self::I16(v) => out.write_all(&v[row].to_le_bytes()),
            Self::I32(v) => out.write_all(&v[row].to_le_bytes()),
            Self::U32(v) => out.write_all(&v[row].to_le_bytes()),
            Self::F32(v) => out.write_all(&v[row].to_le_bytes()),
            Self::F64(v) => out.write_all(&v[row].to_le_bytes()),
            Self::ListF32 { per_row, items } => {
                out.write_all(&[*per_row])?;
                let n = usize::from(*per_row);
                items[row * n..(row + 1) * n].iter().try_for_each(|x| out.write_all(&x.to_le_bytes()))
            }
        }
    }
}

impl Ply<'_> {
    /// The whole file in memory.
    ///
    /// # Errors
    /// Those of [`Ply::check`].
    pub fn bytes(&self) -> Result<Vec<u8>> {
        self.check()?;
        let mut out = Vec::new();
        self.put(&mut out).map_err(Error::io("write", "memory"))?;
        Ok(out)
    }

    /// Writes the file at `path`, replacing one that is there.
    ///
    /// # Errors
    /// Those of [`Ply::check`]; [`Error::Io`], after which `path` is as it was.
    pub fn write(&self, path: &Path) -> Result<()> {
        self.check()?;
        let mut name = std::ffi::OsString::from(".");
        name.push(path.file_name().unwrap_or_default());
        name.push(format!(".partial-{}", std::process::id()));
        let partial = path.with_file_name(name);
        let written = File::create(&partial).and_then(|file| {
            let mut out = BufWriter::with_capacity(1 << 20, file);
            self.put(&mut out)?;
            out.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()?;
            fs::rename(&partial, path)
        });
        written.map_err(|source| {
            let _ = fs::remove_file(&partial);
            Error::io("write", path)(source)
        })
    }

    /// Holds names and lengths against each other.
    ///
    /// # Errors
    /// [`Error::Bug`]: what a caller got wrong.
    pub fn check(&self) -> Result<()> {
        let bug = |what: String| Err(Error::Bug(format!("PLY: {what}")));
        let vertices = self.vertices();
        for (element, columns, rows) in [("vertex", &self.vertex, vertices), ("face", &self.face, self.faces.len())] {
            for column in columns {
                let found = column.values.rows();
                if found != rows {
                    return bug(format!("{element} column {} has {found} rows, wanted {rows}", column.name));
                }
                if column.name.is_empty() || !column.name.bytes().all(|b| b.is_ascii_graphic()) {
                    return bug(format!("{:?} is no name of a column", column.name));
                }
            }
        }
        match self.faces.iter().flatten().max() {
            Some(&last) if last as usize >= vertices || last > i32::MAX as u32 => {
                bug(format!("a face names vertex {last} of {vertices}"))
            }
            _ => Ok(()),
        }
    }

    fn vertices(&self) -> usize {
        self.vertex.first().map_or(0, |column| column.values.rows())
    }

    fn put(&self, out: &mut impl Write) -> io::Result<()> {
        writeln!(out, "ply\nformat binary_little_endian 1.0")?;
        for comment in &self.comments {
            writeln!(out, "comment {}", comment.replace(['\n', '\r'], " "))?;
        }
        let properties = |out: &mut dyn Write, columns: &[Column]| {
            columns.iter().try_for_each(|c| writeln!(out, "property {} {}", c.values.kind(), c.name))
        };
        writeln!(out, "element vertex {}", self.vertices())?;
        properties(out, &self.vertex)?;
        if !self.faces.is_empty() {
            writeln!(out, "element face {}\nproperty list uchar int vertex_indices", self.faces.len())?;
            properties(out, &self.face)?;
        }
        writeln!(out, "end_header")?;
        for row in 0..self.vertices() {
            self.vertex.iter().try_for_each(|column| column.values.put(row, out))?;
        }
        for (row, face) in self.faces.iter().enumerate() {
            out.write_all(&[3])?;
            face.iter().try_for_each(|v| out.write_all(&v.to_le_bytes()))?;
            self.face.iter().try_for_each(|column| column.values.put(row, out))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::{InputConfig, Source, ply};
    use crate::report::Reporter;

    const CORNERS: [DVec3; 4] = [DVec3::new(500_000.25, 0.0, 0.1), DVec3::X, DVec3::Y, DVec3::Z];

    fn tetrahedron<'a>() -> Ply<'a> {
        let mut ply = Ply { faces: vec![[0, 1, 2], [0, 3, 1]].into(), ..Ply::default() };
        ply.vertex.extend(Column::positions(&CORNERS));
        ply
    }

    fn read(bytes: &[u8]) -> Source {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), bytes).unwrap();
        let mut source = Source::default();
        ply::read(file.path(), &InputConfig::default(), &Reporter::new(true), &mut source).unwrap();
        source
    }

    #[test]
    fn what_was_written_is_read_back() {
        let uvs = [[Vec2::ZERO, Vec2::X, Vec2::Y], [Vec2::splat(0.25), Vec2::ONE, Vec2::ZERO]];
        let mut ply = tetrahedron();
        ply.comments = vec!["TextureFile gone.jpg".into(), "two\nlines".into()];
        ply.vertex.push(Column::f32("scalar_height", vec![0.5, 1.0, 2.0, 4.0]));
        ply.vertex.push(Column::new("rank", Values::U32(vec![7; 4].into())));
        ply.vertex.extend(Column::colors(&[[1, 2, 3]; 4]));
        ply.face.push(Column::texcoords(&uvs));
        ply.face.push(Column::new("depth", Values::I16(vec![-1, 1].into())));
        ply.face.push(Column::i32("label", vec![2, -1]));
        let source = read(&ply.bytes().unwrap());
        let part = &source.parts[0];
        assert_eq!(part.positions, CORNERS);
        assert_eq!(part.faces, [[0, 1, 2], [0, 3, 1]]);
        assert_eq!(part.face_labels, [2, -1]);
        assert_eq!(part.vertex_colors, [[1, 2, 3]; 4]);
    }

    #[test]
    fn columns_of_the_wrong_length_or_name_and_bad_faces_are_bugs() {
        let with = |change: fn(&mut Ply)| {
            let mut ply = tetrahedron();
            change(&mut ply);
            ply.bytes().map(|bytes| bytes.len()).map_err(|e| e.to_string())
        };
        assert!(with(|_| {}).is_ok());
        assert!(with(|p| p.face.push(Column::i32("label", vec![1]))).unwrap_err().contains("1 rows, wanted 2"));
        assert!(with(|p| p.vertex.push(Column::i32("two words", vec![1; 4]))).unwrap_err().contains("two words"));
        assert!(with(|p| p.faces.to_mut()[0][2] = 4).unwrap_err().contains("vertex 4 of 4"));
    }

    #[test]
    fn a_file_that_cannot_be_written_leaves_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        let taken = folder.path().join("taken.ply");
        fs::create_dir(&taken).unwrap();
        assert_eq!(tetrahedron().write(&taken).unwrap_err().exit_code(), 6);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "only what was there before");
        let fine = folder.path().join("fine.ply");
        tetrahedron().write(&fine).unwrap();
        assert_eq!(fs::read(&fine).unwrap(), tetrahedron().bytes().unwrap());
    }
}
