//! Reads PLY: text and both byte orders, with texture coordinates per wedge or vertex and labels per face or vertex.
//!
//! In: a path. Out: one [`Part`], its materials (one per `comment TextureFile`), images undecoded.
//!
//! # Method
//! 1. parse the header; 2. read vertices; 3. read faces and strips, going back if they come first; 4. name materials.
//!
//! # Promises
//! Counts and list lengths of the file are never allocated by: rows are pushed as they are found. Indices are checked.
//! The tests cut files of all three formats at every byte and flip a bit in each.
//!
//! # Limits
//! Face colours are not read. Point clouds are refused.

use std::path::Path;

use self::body::{Ascii, Binary, Body, Broken};
use self::faces::Faces;
use self::header::{Element, Format, Header};
use self::vertices::Vertices;
use super::path::referred;
use super::{ImageRef, InputConfig, Material, Part, Source};
use crate::report::Reporter;
use crate::{Error, Result};

mod body;
mod faces;
mod header;
#[cfg(test)]
mod tests;
mod vertices;

const VERTICES: &str = "vertex";
const FACES: &str = "face";
const STRIPS: &str = "tristrips";
/// sRGB of faces without an image.
const GREY: [u8; 3] = [128; 3];
/// Rows between two looks at whether the user wants to stop.
const ROWS_PER_CHECK: u64 = 1 << 16;

/// Reads the PLY file at `path` into `source`.
///
/// # Errors
/// [`Error::Input`] if the file is broken, cut short or has no triangles, [`Error::Unsupported`] for a point cloud,
/// [`Error::Limit`] for over 2^32 vertices, [`Error::Io`], [`Error::Cancelled`].
pub fn read(path: &Path, config: &InputConfig, reporter: &Reporter, source: &mut Source) -> Result<()> {
    let is_file = std::fs::metadata(path).map_err(Error::io("read", path))?.is_file();
    if !is_file {
        return Err(Error::input(path, "is not a regular file"));
    }
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    let header = header::parse(path, &bytes, reporter)?;
    let reading = Reading { path, header: &header, config, reporter };
    match header.format {
        Format::Ascii => reading.run(Ascii::new(&bytes[header.body_at..], header.lines, header.is_cr), source),
        Format::LittleEndian => reading.run(Binary::<false>::new(&bytes, header.body_at), source),
        Format::BigEndian => reading.run(Binary::<true>::new(&bytes, header.body_at), source),
    }
}

struct Reading<'a> {
    path: &'a Path,
    header: &'a Header,
    config: &'a InputConfig,
    reporter: &'a Reporter,
}

impl Reading<'_> {
    fn run<B: Body>(&self, body: B, source: &mut Source) -> Result<()> {
        let element = |name: &str| self.header.elements.iter().find(|e| e.name == name);
        let vertex_element = element(VERTICES).ok_or_else(|| self.refuse("has no element vertex"))?;
        self.check_counts(vertex_element)?;

        let (vertices, later) = self.locate(body)?;
        let plan = element(FACES).and_then(faces::Plan::of);
        let (wedges, labels) = plan.as_ref().map_or((false, false), |plan| (plan.has_wedges, plan.has_labels));
        let mut faces = Faces::new(&vertices, self.header.textures.len(), wedges, labels);
        for (element, mut body) in later {
            match &plan {
                _ if element.name == STRIPS => self.rows(&mut body, element, |body| faces.read_strip(body, element))?,
                Some(plan) => {
                    faces.reserve(room(&body, element));
                    self.rows(&mut body, element, |body| faces.read(body, plan))?;
                }
                None => return Err(self.refuse("its faces have no list vertex_indices or vertex_index")),
            }
        }
        faces.report(self.path, self.reporter);
        if faces.corners.is_empty() {
            return Err(self.refuse(format!("has {} vertices but no triangles", vertices.positions.len())));
        }
        let (corners, uvs, textures, labels) = (faces.corners, faces.uvs, faces.textures, faces.labels);
        let mut part = Part {
            path: self.path.to_path_buf(),
            faces: corners,
            corner_uvs: uvs,
            face_labels: labels,
            positions: vertices.positions,
            vertex_colors: vertices.colors,
            ..Part::default()
        };
        self.paint(&textures, &mut part, source)?;
        drop_bad_positions(&mut part);
        source.parts.push(part);
        Ok(())
    }

    /// Reads the vertices, and marks where faces are: they may come first but need the vertices.
    fn locate<B: Body>(&self, mut body: B) -> Result<(Vertices, Vec<(&Element, B)>)> {
        let is_faces = |element: &Element| matches!(element.name.as_str(), FACES | STRIPS);
        let mut vertices = Vertices::default();
        let mut later = Vec::new();
        let elements = &self.header.elements;
        let last = elements.iter().rposition(|e| is_faces(e) || e.name == VERTICES).unwrap_or(0);
        for (i, element) in elements.iter().enumerate().take(last + 1) {
            if element.name == VERTICES {
                vertices = self.vertices(&mut body, element)?;
                continue;
            }
            if is_faces(element) {
                later.push((element, body.clone()));
            }
            if i < last {
                body.skip_element(element).map_err(|broken| self.broken(&body, element, None, broken))?;
            }
        }
        Ok((vertices, later))
    }

    fn check_counts(&self, vertex: &Element) -> Result<()> {
        if vertex.count > u64::from(u32::MAX) {
            let what = format!("claims {} vertices; at most 2^32 - 1 are read, split the file", vertex.count);
            return Err(Error::Limit { path: self.path.into(), what });
        }
        let has_faces = self.header.elements.iter().any(|e| matches!(e.name.as_str(), FACES | STRIPS) && e.count > 0);
        if !has_faces && vertex.count > 0 {
            let what = format!("is a point cloud: {} points, no faces; make a mesh of it first", vertex.count);
            return Err(Error::Unsupported { path: self.path.into(), what });
        }
        Ok(())
    }

    fn vertices<B: Body>(&self, body: &mut B, element: &Element) -> Result<Vertices> {
        let plan = vertices::Plan::of(element).ok_or_else(|| self.refuse("its vertices lack x, y or z"))?;
        let mut vertices = Vertices::default();
        vertices.positions.reserve(room(body, element));
        self.rows(body, element, |body| plan.read(body, &mut vertices))?;
        Ok(vertices)
    }

    fn rows<B: Body>(
        &self,
        body: &mut B,
        element: &Element,
        mut read: impl FnMut(&mut B) -> Result<(), Broken>,
    ) -> Result<()> {
        if element.properties.is_empty() {
            return Ok(());
        }
        for row in 0..element.count {
            if row % ROWS_PER_CHECK == 0 {
                self.reporter.check()?;
            }
            read(body).map_err(|broken| self.broken(body, element, Some(row), broken))?;
        }
        Ok(())
    }

    /// Names a material per texture, and one for faces without.
    fn paint(&self, textures: &[u32], part: &mut Part, source: &mut Source) -> Result<()> {
        let mut places = vec![u32::MAX; self.header.textures.len() + 1];
        let mut has_image = false;
        let mut used: Vec<bool> = vec![false; places.len()];
        textures.iter().for_each(|&texture| used[texture as usize] = true);
        for (texture, place) in places.iter_mut().enumerate().filter(|(texture, _)| used[*texture]) {
            let file = self.header.textures.get(texture);
            let image = file.map(|file| self.image(file)).transpose()?.flatten().map(|image| {
                source.images.push(image);
                source.images.len() as u32 - 1
            });
            has_image |= image.is_some();
            *place = source.materials.len() as u32;
            let name = file.cloned().unwrap_or_else(|| "untextured".into());
            source.materials.push(Material { name, base_color: GREY, image });
        }
        part.face_material = textures.iter().map(|&texture| places[texture as usize]).collect();
        if !has_image {
            part.corner_uvs = Vec::new();
        }
        Ok(())
    }

    fn image(&self, file: &str) -> Result<Option<ImageRef>> {
        match referred(self.path, file, self.config) {
            Err(Error::Io { .. }) => {
                let what = format!("texture {file:?} cannot be found; its faces are grey");
                self.reporter.warn("missing-texture", self.path, what);
                Ok(None)
            }
            found => Ok(Some(ImageRef::File(found?))),
        }
    }

    fn refuse(&self, what: impl Into<String>) -> Error {
        Error::input(self.path, what)
    }

    fn broken<B: Body>(&self, body: &B, element: &Element, row: Option<u64>, broken: Broken) -> Error {
        let name = &element.name;
        let row = row.map_or(String::new(), |row| format!(" row {} of {}", row + 1, element.count));
        let what = match broken {
            Broken::FileEnds => format!("the file ends in element {name}{row}; it may be cut short"),
            Broken::LineEnds => format!("too few values for element {name}{row}"),
            Broken::NotANumber => format!("element {name}{row} holds something that is not a number"),
            Broken::Length(length) => format!("element {name}{row} holds a list of length {length}"),
            Broken::Index(index) => format!("element {name}{row} names vertex {index}, which does not exist"),
        };
        Error::input_at(self.path, body.place(), what)
    }
}

/// Rows worth making room for: as many as the header says, but no more than the rest of the file can hold.
fn room<B: Body>(body: &B, element: &Element) -> usize {
    // A value is at least one byte, in text too.
    element.count.min(body.left() / (element.properties.len() as u64).max(1)) as usize
}

/// Takes out positions that are not finite; no face uses them.
fn drop_bad_positions(part: &mut Part) {
    if part.positions.iter().all(|position| position.is_finite()) {
        return;
    }
    let is_finite: Vec<bool> = part.positions.iter().map(|position| position.is_finite()).collect();
    let mut rank = Vec::with_capacity(is_finite.len());
    let mut kept = 0;
    for &finite in &is_finite {
        rank.push(kept);
        kept += u32::from(finite);
    }
    part.faces.iter_mut().for_each(|face| *face = face.map(|vertex| rank[vertex as usize]));
    part.positions.retain(|position| position.is_finite());
    let mut finite = is_finite.iter();
    part.vertex_colors.retain(|_| finite.next() == Some(&true));
}
