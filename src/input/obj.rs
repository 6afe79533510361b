//! Reads Wavefront OBJ files, parallel in chunks.
//!
//! In: a path. Out: one [`Part`] of a [`Source`], with the materials its faces use.
//! # Method
//!  1. Cut the file between lines into chunks of fixed size; parse each to arrays in its own numbering.
//!  2. Stitch the vertices: prefix sums of the chunks' counts give each chunk its first index.
//!  3. Look up the materials in the order in which they are named.
//!  4. Resolve the faces chunk by chunk, now that every vertex is known: check, drop, triangulate, append in order.
//! # Numbers
//! `CHUNK_BYTES` and `GROUP_CHUNKS` bound the memory above the result; `MAX_BAD_FACES` is the share of unreadable
//! faces past which a file counts as broken.
//! # Promises
//! The result does not depend on the number of threads or the size of the chunks
//! (`chunk_size_and_thread_count_change_nothing`). No index leaves unchecked; a face whose material has an image has
//! finite texture coordinates; every position is finite.
//! # Limits
//! Free-form curves, lines, points, groups and normals are skipped. More than 2^31 - 2 vertices are refused.
//! # Cost
//! 6.5 million lines (223 MB, 3.0 million triangles): 1.1 s of processor time, peak 335 MB of which 160 MB are the
//! result (test `a_large_file_is_timed`, optimised).

use std::collections::{HashMap, HashSet};
use std::path::Path;

use glam::{DVec3, Vec2};
use rayon::prelude::*;

use self::chunk::{Bytes, Chunk, Code};
use super::mtl::Libraries;
use super::triangulate::Triangulator;
use super::{DEFAULT_COLOR, InputConfig, Material, Part, Source};
use crate::error::Place;
use crate::report::Reporter;
use crate::{Error, Result};

mod chunk;
#[cfg(test)]
mod tests;

/// Bytes parsed at a time: large enough that stitching costs nothing, small enough for many cores.
const CHUNK_BYTES: u64 = 8 << 20;
/// Chunks resolved before they are appended: bounds what is held twice. Fixed, so that it cannot show in the result.
const GROUP_CHUNKS: usize = 8;
/// A file more than this part of whose faces cannot be read is broken.
const MAX_BAD_FACES: f64 = 0.5;
/// Most vertices of one file, one less than an index code can name.
const MAX_VERTICES: usize = 0x7FFF_FFFD;
/// Colours are taken for 0..1 if none exceeds this, else for 0..255. A little above 1 for rounding exporters.
const UNIT_COLOR_LIMIT: f32 = 1.001;

/// Reads the OBJ file `path` with its MTL files and appends it to `source` as one part, z as written.
///
/// Warnings: `bad-index`, `bad-coordinate`, `bad-polygon`, `bad-uv`, `missing-uv`, `short-face`, and those of the
/// MTL files.
///
/// # Errors
/// [`Error::Input`] if there are no faces, most are broken, the file is no text, or a path leaves the folder;
/// [`Error::Limit`] for a line over 1 MiB or too many vertices; [`Error::Io`].
pub fn read(path: &Path, config: &InputConfig, reporter: &Reporter, source: &mut Source) -> Result<()> {
    read_chunked(path, config, reporter, source, CHUNK_BYTES)
}

fn read_chunked(
    path: &Path,
    config: &InputConfig,
    reporter: &Reporter,
    source: &mut Source,
    chunk_bytes: u64,
) -> Result<()> {
    let mut chunks = parse(path, reporter, chunk_bytes)?;
    refuse_without_faces(path, &chunks)?;
    let vertices = Vertices::stitch(path, &mut chunks)?;
    let palette = Palette::look_up(path, config, reporter, &chunks, source)?;
    let bad_number = first_bad_number(&chunks);
    let (mut part, tally) = resolve(path, reporter, chunks, &vertices, &palette)?;
    tally.judge(path, reporter, bad_number.as_deref())?;
    palette.append(&mut part.face_material, source)?;
    (part.positions, part.vertex_colors) = vertices.finish();
    source.parts.push(part);
    Ok(())
}

fn parse(path: &Path, reporter: &Reporter, chunk_bytes: u64) -> Result<Vec<Chunk>> {
    let bytes = Bytes::open(path)?;
    if bytes.len() == 0 {
        return Err(Error::input(path, "is empty; an OBJ with faces is wanted"));
    }
    let ranges = bytes.cut(chunk_bytes)?;
    let read = |&range: &(u64, u64)| reporter.check().and_then(|()| Chunk::read(&bytes, range));
    // All results first, so that of several errors it is always the first in the file that is told.
    let chunks: Vec<Result<Chunk>> = ranges.par_iter().map(read).collect();
    chunks.into_iter().collect()
}

fn refuse_without_faces(path: &Path, chunks: &[Chunk]) -> Result<()> {
    if chunks.iter().any(|chunk| !chunk.ends.is_empty()) {
        return Ok(());
    }
    let vertices: usize = chunks.iter().map(|chunk| chunk.positions.len()).sum();
    let short: u64 = chunks.iter().map(|chunk| chunk.short_faces).sum();
    let what = format!(
        "holds no face of three or more corners ({vertices} vertices, {short} faces of fewer corners); a mesh is \
         wanted, not points or lines"
    );
    Err(Error::input(path, what))
}

/// The first coordinate that is no finite number, for a message.
fn first_bad_number(chunks: &[Chunk]) -> Option<String> {
    let mut lines = 0;
    for chunk in chunks {
        if let Some((line, text)) = &chunk.bad_number {
            return Some(format!("line {} has the coordinates `{text}`", lines + u64::from(*line)));
        }
        lines += chunk.lines;
    }
    None
}

/// The vertices of all chunks, and where each chunk's begin.
struct Vertices {
    positions: Vec<DVec3>,
    /// Empty, or as many as `positions`; NaN where there is none.
    colors: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    /// Per chunk: positions, uvs and lines before it.
    before: Vec<(usize, usize, u64)>,
}

impl Vertices {
    fn stitch(path: &Path, chunks: &mut [Chunk]) -> Result<Self> {
        let mut before = Vec::with_capacity(chunks.len());
        let (mut positions, mut uvs, mut lines) = (0, 0, 0);
        for chunk in chunks.iter() {
            before.push((positions, uvs, lines));
            positions += chunk.positions.len();
            uvs += chunk.uvs.len();
            lines += chunk.lines;
        }
        if positions.max(uvs) > MAX_VERTICES {
            let what = format!(
                "has {positions} vertices and {uvs} texture coordinates, the limit is {MAX_VERTICES}; split it"
            );
            return Err(Error::Limit { path: path.to_path_buf(), what });
        }
        let colored = chunks.iter().any(|chunk| !chunk.colors.is_empty());
        let mut all = Self {
            positions: Vec::with_capacity(positions),
            colors: Vec::with_capacity(if colored { positions } else { 0 }),
            uvs: Vec::with_capacity(uvs),
            before,
        };
        for chunk in chunks {
            all.positions.append(&mut std::mem::take(&mut chunk.positions));
            all.uvs.append(&mut std::mem::take(&mut chunk.uvs));
            if colored {
                all.colors.append(&mut std::mem::take(&mut chunk.colors));
                all.colors.resize(all.positions.len(), [f32::NAN; 3]);
            }
        }
        Ok(all)
    }

    /// Positions, none of them NaN any more, and colours as bytes.
    fn finish(mut self) -> (Vec<DVec3>, Vec<[u8; 3]>) {
        // No face uses the others; put where they cannot widen the extent.
        if let Some(place) = self.positions.iter().copied().find(|p| p.is_finite()) {
            self.positions.iter_mut().filter(|p| !p.is_finite()).for_each(|p| *p = place);
        }
        let largest = self.colors.iter().flatten().copied().filter(|c| c.is_finite()).fold(0.0, f32::max);
        let scale = if largest > UNIT_COLOR_LIMIT { 1.0 } else { 255.0 };
        let color = |rgb: &[f32; 3]| match rgb.iter().all(|c| c.is_finite()) {
            true => rgb.map(|c| (c * scale).round().clamp(0.0, 255.0) as u8),
            false => DEFAULT_COLOR,
        };
        let colors = self.colors.iter().map(color).collect();
        (self.positions, colors)
    }
}

/// The materials named, and which of them each chunk's stretches of faces use.
struct Palette {
    materials: Vec<Material>,
    /// Per chunk: the material it begins with, and that of each of its names.
    chunks: Vec<(u32, Vec<u32>)>,
}

impl Palette {
    fn look_up(
        path: &Path,
        config: &InputConfig,
        reporter: &Reporter,
        chunks: &[Chunk],
        source: &mut Source,
    ) -> Result<Self> {
        let mut libraries = Libraries::new(path, config, reporter)?;
        let mut lines = 0;
        let mut seen = HashSet::new();
        for chunk in chunks {
            for (line, rest) in &chunk.libraries {
                if seen.insert(rest.as_slice()) {
                    libraries.load(lines + u64::from(*line), rest)?;
                }
            }
            lines += chunk.lines;
        }
        // The material of faces before the first usemtl has no name.
        let mut ids: HashMap<&[u8], u32> = HashMap::new();
        let mut palette = Self { materials: Vec::new(), chunks: Vec::new() };
        let mut current: &[u8] = b"";
        for chunk in chunks {
            let mut id = |name| {
                let next = palette.materials.len() as u32;
                let id = *ids.entry(name).or_insert(next);
                if id == next {
                    palette.materials.push(libraries.material(name, &mut source.images)?);
                }
                Ok::<u32, Error>(id)
            };
            let first_run = chunk.runs.first().map_or(chunk.ends.len(), |run| run.0 as usize);
            let begin = if first_run > 0 { id(current)? } else { 0 };
            // A name no run refers to painted no face: its image is not looked for.
            let mut used = vec![false; chunk.names.len()];
            for (i, run) in chunk.runs.iter().enumerate() {
                let end = chunk.runs.get(i + 1).map_or(chunk.ends.len(), |next| next.0 as usize);
                used[run.1 as usize] |= end > run.0 as usize;
            }
            let mut names = Vec::with_capacity(chunk.names.len());
            for (name, used) in chunk.names.iter().zip(used) {
                names.push(if used { id(name.as_slice())? } else { 0 });
            }
            palette.chunks.push((begin, names));
            if let Some(run) = chunk.runs.last() {
                current = &chunk.names[run.1 as usize];
            }
        }
        Ok(palette)
    }

    /// Appends the materials used to `source` and turns `tags` (see [`Faces::tags`]) into their indices.
    ///
    /// A face without texture coordinates gets a twin of its material without the image.
    fn append(&self, tags: &mut [u32], source: &mut Source) -> Result<()> {
        let mut used = vec![false; self.materials.len() * 2];
        tags.iter().for_each(|&tag| used[tag as usize] = true);
        let mut ids = vec![0u32; used.len()];
        for (tag, _) in used.iter().enumerate().filter(|(_, used)| **used) {
            let mut material = self.materials[tag / 2].clone();
            if tag % 2 == 0 {
                material.image = None;
            }
            // Without an image the two are one.
            let twin = tag % 2 == 1 && material.image.is_none() && used[tag - 1];
            ids[tag] = if twin { ids[tag - 1] } else { index(&source.materials)? };
            if !twin {
                source.materials.push(material);
            }
        }
        tags.iter_mut().for_each(|tag| *tag = ids[*tag as usize]);
        Ok(())
    }
}

fn index<T>(list: &[T]) -> Result<u32> {
    u32::try_from(list.len()).map_err(|_| Error::Bug("more than 2^32 materials".into()))
}

/// The faces of one chunk, resolved.
#[derive(Default)]
struct Faces {
    triangles: Vec<[u32; 3]>,
    uvs: Vec<[Vec2; 3]>,
    /// Twice the material, plus one if the face has texture coordinates.
    tags: Vec<u32>,
    tally: Tally,
}

/// What became of the faces.
#[derive(Default)]
struct Tally {
    faces: u64,
    short: u64,
    bad_index: u64,
    bad_coordinate: u64,
    bad_polygon: u64,
    bad_uv: u64,
    missing_uv: u64,
    /// Line and reason.
    first_bad: Option<(u64, &'static str)>,
}

fn resolve(
    path: &Path,
    reporter: &Reporter,
    chunks: Vec<Chunk>,
    vertices: &Vertices,
    palette: &Palette,
) -> Result<(Part, Tally)> {
    let triangles: usize = chunks.iter().map(|chunk| chunk.corners.len() - 2 * chunk.ends.len()).sum();
    let has_uvs = !vertices.uvs.is_empty() && chunks.iter().any(|c| c.corners.iter().any(|c| c[1] != Code::ABSENT));
    let mut part = Part { path: path.to_path_buf(), ..Part::default() };
    part.faces.reserve_exact(triangles);
    part.face_material.reserve_exact(triangles);
    part.corner_uvs.reserve_exact(if has_uvs { triangles } else { 0 });
    let mut tally = Tally::default();
    let mut chunks = chunks.into_iter().enumerate().peekable();
    while chunks.peek().is_some() {
        reporter.check()?;
        let group: Vec<(usize, Chunk)> = chunks.by_ref().take(GROUP_CHUNKS).collect();
        let resolve = |(k, chunk)| resolve_chunk(&chunk, k, vertices, palette, has_uvs);
        let group: Vec<Faces> = group.into_par_iter().map(resolve).collect();
        for mut faces in group {
            part.faces.append(&mut faces.triangles);
            part.face_material.append(&mut faces.tags);
            part.corner_uvs.append(&mut faces.uvs);
            tally.add(faces.tally);
        }
    }
    Ok((part, tally))
}

fn resolve_chunk(chunk: &Chunk, k: usize, vertices: &Vertices, palette: &Palette, has_uvs: bool) -> Faces {
    let (first_position, first_uv, first_line) = vertices.before[k];
    let (begin, names) = &palette.chunks[k];
    let capacity = chunk.corners.len() - 2 * chunk.ends.len();
    let mut faces = Faces::default();
    faces.triangles.reserve_exact(capacity);
    faces.tags.reserve_exact(capacity);
    faces.uvs.reserve_exact(if has_uvs { capacity } else { 0 });
    faces.tally.short = chunk.short_faces;
    let mut cutter = Triangulator::default();
    let (mut corners, mut points, mut uvs, mut pieces) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut runs = chunk.runs.iter().peekable();
    let mut material = *begin;
    let mut from = 0;
    for (face, &end) in chunk.ends.iter().enumerate() {
        while let Some(run) = runs.next_if(|run| run.0 as usize <= face) {
            material = names[run.1 as usize];
        }
        let codes = &chunk.corners[from..end as usize];
        from = end as usize;
        faces.tally.faces += 1;
        corners.clear();
        corners.extend(codes.iter().filter_map(|code| code[0].resolve(first_position, vertices.positions.len())));
        points.clear();
        points.extend(corners.iter().map(|&v| vertices.positions[v as usize]));
        let line = first_line + u64::from(chunk.face_lines[face]);
        if corners.len() < codes.len() {
            faces.tally.bad_index += 1;
            faces.tally.first_bad.get_or_insert((line, "a vertex index is 0 or beyond the vertices there are"));
            continue;
        }
        if !points.iter().all(|p| p.is_finite()) {
            faces.tally.bad_coordinate += 1;
            faces.tally.first_bad.get_or_insert((line, "a vertex has a coordinate that is not a finite number"));
            continue;
        }
        pieces.clear();
        if !cutter.cut(&points, &mut pieces) {
            faces.tally.bad_polygon += 1;
        }
        let textured = has_uvs && take_uvs(codes, first_uv, vertices, &mut uvs, &mut faces.tally.bad_uv);
        if !textured && palette.materials[material as usize].image.is_some() {
            faces.tally.missing_uv += 1;
        }
        for piece in &pieces {
            faces.triangles.push(piece.map(|corner| corners[corner as usize]));
            faces.tags.push(2 * material + u32::from(textured));
            if has_uvs {
                faces.uvs.push(if textured { piece.map(|corner| uvs[corner as usize]) } else { [Vec2::ZERO; 3] });
            }
        }
    }
    faces
}

/// The texture coordinates of a face's corners; false if it has not all of them.
fn take_uvs(codes: &[[Code; 2]], first: usize, vertices: &Vertices, uvs: &mut Vec<Vec2>, bad: &mut u64) -> bool {
    uvs.clear();
    if codes.iter().any(|code| code[1] == Code::ABSENT) {
        return false;
    }
    let uv =
        |code: &[Code; 2]| code[1].resolve(first, vertices.uvs.len()).map(|i| Vec2::from(vertices.uvs[i as usize]));
    uvs.extend(codes.iter().filter_map(uv).filter(|uv| uv.is_finite()));
    let complete = uvs.len() == codes.len();
    *bad += u64::from(!complete);
    complete
}

impl Tally {
    fn add(&mut self, next: Self) {
        self.faces += next.faces;
        self.short += next.short;
        self.bad_index += next.bad_index;
        self.bad_coordinate += next.bad_coordinate;
        self.bad_polygon += next.bad_polygon;
        self.bad_uv += next.bad_uv;
        self.missing_uv += next.missing_uv;
        self.first_bad = self.first_bad.or(next.first_bad);
    }

    /// Warns of what was dropped; refuses the file if that is most of it.
    fn judge(&self, path: &Path, reporter: &Reporter, bad_number: Option<&str>) -> Result<()> {
        let bad = self.bad_index + self.bad_coordinate;
        let (line, why) = self.first_bad.unwrap_or((0, ""));
        let hint = bad_number.filter(|_| self.bad_coordinate > 0).map(|b| format!(" ({b})")).unwrap_or_default();
        if bad as f64 > MAX_BAD_FACES * self.faces as f64 {
            let what = format!(
                "{why}{hint}, and so {bad} of {} faces cannot be read; mend the file or export it again",
                self.faces
            );
            return Err(Error::input_at(path, Place::Line(line), what));
        }
        let first = format!("{bad} of {} faces are dropped; the first, on line {line}: {why}{hint}", self.faces);
        reporter.warn_many("bad-index", path, self.bad_index, first.as_str());
        reporter.warn_many("bad-coordinate", path, self.bad_coordinate, first);
        reporter.warn_many("short-face", path, self.short, "faces of one or two corners are skipped");
        let what = "polygons that cross themselves or have no area are triangulated as well as may be";
        reporter.warn_many("bad-polygon", path, self.bad_polygon, what);
        let what = "faces with a texture coordinate that is missing or no finite number are painted without image";
        reporter.warn_many("bad-uv", path, self.bad_uv, what);
        let what = "faces whose material has an image, but no texture coordinates, are painted without it";
        reporter.warn_many("missing-uv", path, self.missing_uv, what);
        Ok(())
    }
}
