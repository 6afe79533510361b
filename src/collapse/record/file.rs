//! The container: a header that says what is where, then the base and the chunks, each under a checksum.
//!
//! # Layout     all numbers little endian
//! | part | what |
//! |---|---|
//! | magic | `rooftile record`, a zero byte |
//! | u16, u16 | version, flags (1: deviations are recorded) |
//! | u32 | bytes of the header, from the magic to its checksum |
//! | 3 × f64 | added to positions: the origin in source coordinates |
//! | i8 | the grid is 2 to this power, metres |
//! | text | method (a byte of length, UTF-8) |
//! | u8, then each | classes: text name, f64 budget in metres, 3 × u8 colour |
//! | u32, then each | chunks, the base first: u32 bytes, events, faces, vertices; 2 × i16 energies; 8 × u8 bounds; 16 bytes of BLAKE3 |
//! | 16 bytes | BLAKE3 of the header so far |
//!
//! # Promises   any byte changed, missing or added is noticed before anything is decoded from it

use std::ops::Range;
use std::path::{Path, PathBuf};

use glam::DVec3;

use super::MAX_CLASSES;
use crate::error::Place;
use crate::ids::{ClassScheme, ClassSpec};
use crate::{Error, Result};

const MAGIC: &[u8; 16] = b"rooftile record\0";
const VERSION: u16 = 4;
/// The flag of [`About::tracked`].
const TRACKED: u16 = 1;
const HASH_BYTES: usize = 16;
const CHUNK_BYTES: usize = 4 * 4 + 2 * 2 + MAX_CLASSES + HASH_BYTES;
/// A feature id byte has room for more, but nothing here was tried with more.
const MOST_CLASSES: usize = 32;
/// Grids from a micrometre to a kilometre.
const GRID_EXPONENTS: std::ops::RangeInclusive<i32> = -24..=10;

/// What a record says about itself.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct About {
    /// Added to positions: the origin of the local frame in source coordinates.
    pub origin: DVec3,
    /// Classes of faces and deviations.
    pub scheme: ClassScheme,
    /// How it was simplified, in a word.
    pub method: String,
    /// Events hold deviations; without them nothing is known of errors.
    pub tracked: bool,
}

impl About {
    /// Classes whose deviations are recorded: the first ones, or none.
    pub fn tracked_classes(&self) -> usize {
        if self.tracked { self.scheme.len().min(MAX_CLASSES) } else { 0 }
    }
}

/// What is known of a chunk without decoding it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ChunkInfo {
    /// Its size.
    pub bytes: u32,
    /// Splits in it; 0 for the base.
    pub events: u32,
    /// Faces of the mesh once it is decoded.
    pub faces: u32,
    /// Vertices of the mesh once it is decoded.
    pub vertices: u32,
    /// The largest energy of all collapses up to its first and its last, as half the binary logarithm, rounded up.
    pub energy: [i16; 2],
    /// Levels of the largest deviation of each class in the mesh once it is decoded.
    pub bounds: [u8; MAX_CLASSES],
    /// First bytes of its BLAKE3.
    pub hash: [u8; HASH_BYTES],
}

/// The header.
#[derive(Debug, Clone, PartialEq)]
pub struct Header {
    /// About the whole.
    pub about: About,
    /// Positions are multiples of this, metres: a power of two.
    pub grid_m: f64,
    /// The base, then the chunks from coarse to fine.
    pub chunks: Vec<ChunkInfo>,
}

/// Bytes a part that makes `count` faces, vertices or events has at least; so nobody can promise what is not there.
pub fn least_bytes(count: usize) -> usize {
    // Real events take 40 bits. 1024: so small parts are never padded.
    count.saturating_sub(1024).div_ceil(8)
}

impl Header {
    /// For chunks whose sizes and hashes are filled in on writing.
    pub fn new(about: &About, grid_m: f64, chunks: &[ChunkInfo]) -> Self {
        Self { about: about.clone(), grid_m, chunks: chunks.to_vec() }
    }

    fn to_bytes(&self) -> Vec<u8> {
        let mut out = MAGIC.to_vec();
        out.extend(VERSION.to_le_bytes());
        out.extend(u16::from(self.about.tracked).to_le_bytes());
        let size_at = out.len();
        out.extend(0u32.to_le_bytes());
        self.about.origin.to_array().iter().for_each(|x| out.extend(x.to_le_bytes()));
        out.push(exponent_of(self.grid_m).unwrap_or(0) as u8);
        let text = |out: &mut Vec<u8>, text: &str| {
            let end = (0..=text.len().min(255)).rev().find(|&i| text.is_char_boundary(i)).unwrap_or(0);
            out.push(end as u8);
            out.extend(&text.as_bytes()[..end]);
        };
        text(&mut out, &self.about.method);
        out.push(self.about.scheme.len() as u8);
        for class in &self.about.scheme.0 {
            text(&mut out, &class.name);
            out.extend(class.budget_m.to_le_bytes());
            out.extend(class.color);
        }
        out.extend((self.chunks.len() as u32).to_le_bytes());
        for chunk in &self.chunks {
            [chunk.bytes, chunk.events, chunk.faces, chunk.vertices].iter().for_each(|x| out.extend(x.to_le_bytes()));
            chunk.energy.iter().for_each(|x| out.extend(x.to_le_bytes()));
            out.extend(chunk.bounds);
            out.extend(chunk.hash);
        }
        let size = (out.len() + HASH_BYTES) as u32;
        out[size_at..size_at + 4].copy_from_slice(&size.to_le_bytes());
        let hash = hash_of(&out);
        out.extend(hash);
        out
    }
}

/// Where things are in a file.
#[derive(Debug, Clone)]
pub struct Layout {
    /// What it says.
    pub header: Header,
    /// Where each of `header.chunks` lies.
    pub places: Vec<Range<usize>>,
}

impl Layout {
    /// Puts the parts together.
    pub fn write(header: &Header, payloads: Vec<Vec<u8>>) -> Vec<u8> {
        let mut header = header.clone();
        for (chunk, payload) in header.chunks.iter_mut().zip(&payloads) {
            chunk.bytes = payload.len() as u32;
            chunk.hash = hash_of(payload);
        }
        let mut out = header.to_bytes();
        out.reserve_exact(payloads.iter().map(Vec::len).sum());
        // One after the other is let go.
        payloads.into_iter().for_each(|p| out.extend(p));
        out
    }

    /// Reads the header of `bytes`; `path` is for messages.
    ///
    /// # Errors
    /// [`Error::Input`] for anything but a whole record, [`Error::Unsupported`] for one of a later version.
    pub fn read(path: &Path, bytes: &[u8]) -> Result<Self> {
        let mut cursor = Cursor { path: path.to_path_buf(), bytes, at: 0 };
        if bytes.len() < MAGIC.len() || !bytes.starts_with(MAGIC) {
            return Err(Error::input(path, "is no record: it does not begin with \"rooftile record\""));
        }
        cursor.at = MAGIC.len();
        let version = u16::from_le_bytes(cursor.take()?);
        let flags = u16::from_le_bytes(cursor.take()?);
        let size = u32::from_le_bytes(cursor.take()?) as usize;
        if size > bytes.len() || size < cursor.at + HASH_BYTES {
            return Err(cursor.cut_off(size));
        }
        let (head, hash) = bytes[..size].split_at(size - HASH_BYTES);
        if hash != hash_of(head) {
            return Err(cursor.damaged("header"));
        }
        if version != VERSION || flags > TRACKED {
            let what =
                format!("is a record of version {version}.{flags}, and version {VERSION}.0 is read; record again");
            return Err(Error::Unsupported { path: path.to_path_buf(), what });
        }
        cursor.bytes = head;
        let header = cursor.header(flags & TRACKED != 0)?;
        let mut places = Vec::with_capacity(header.chunks.len());
        let mut at = size;
        for chunk in &header.chunks {
            let end = at.saturating_add(chunk.bytes as usize);
            places.push(at..end);
            at = end;
        }
        if at > bytes.len() {
            return Err(cursor.cut_off(at));
        }
        if at < bytes.len() {
            let what = format!("has {} bytes after its end; record again", bytes.len() - at);
            return Err(Error::input_at(path, Place::Byte(at as u64), what));
        }
        Ok(Self { header, places })
    }

    /// The bytes of part `i`, checked.
    ///
    /// # Errors
    /// [`Error::Input`] if they are not those that were written.
    pub fn payload<'a>(&self, path: &Path, bytes: &'a [u8], i: usize) -> Result<&'a [u8]> {
        let place = self.places[i].clone();
        let payload = bytes.get(place.clone()).unwrap_or_default();
        if hash_of(payload) == self.header.chunks[i].hash {
            return Ok(payload);
        }
        let what = format!("part {i} is damaged: its checksum does not match; copy the file again or record again");
        Err(Error::input_at(path, Place::Byte(place.start as u64), what))
    }
}

fn hash_of(bytes: &[u8]) -> [u8; HASH_BYTES] {
    let mut out = [0; HASH_BYTES];
    out.copy_from_slice(&blake3::hash(bytes).as_bytes()[..HASH_BYTES]);
    out
}

fn exponent_of(grid_m: f64) -> Option<i8> {
    GRID_EXPONENTS.into_iter().find(|&e| 2f64.powi(e) == grid_m).map(|e| e as i8)
}

struct Cursor<'a> {
    path: PathBuf,
    bytes: &'a [u8],
    at: usize,
}

impl Cursor<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut out = [0; N];
        out.copy_from_slice(self.slice(N)?);
        Ok(out)
    }

    fn slice(&mut self, count: usize) -> Result<&[u8]> {
        let end = self.at.saturating_add(count);
        if end > self.bytes.len() {
            return Err(self.cut_off(end));
        }
        let slice = &self.bytes[self.at..end];
        self.at = end;
        Ok(slice)
    }

    fn number(&mut self) -> Result<u32> {
        Ok(u32::from_le_bytes(self.take()?))
    }

    fn real(&mut self) -> Result<f64> {
        let x = f64::from_le_bytes(self.take()?);
        if x.is_finite() { Ok(x) } else { Err(self.wrong(format!("a number that is {x}"))) }
    }

    fn text(&mut self) -> Result<String> {
        let [length] = self.take()?;
        let text = std::str::from_utf8(self.slice(usize::from(length))?).map(str::to_owned);
        text.map_err(|_| self.wrong("a text that is not UTF-8"))
    }

    fn header(&mut self, tracked: bool) -> Result<Header> {
        let origin = DVec3::new(self.real()?, self.real()?, self.real()?);
        let [exponent] = self.take()?;
        let exponent = i32::from(exponent as i8);
        if !GRID_EXPONENTS.contains(&exponent) {
            return Err(self.wrong(format!("a grid of 2^{exponent} m")));
        }
        let method = self.text()?;
        let [classes] = self.take()?;
        let mut scheme = ClassScheme(Vec::new());
        for _ in 0..classes {
            let (name, budget_m, color) = (self.text()?, self.real()?, self.take()?);
            scheme.0.push(ClassSpec { name, budget_m, color, of: Vec::new(), when: Vec::new() });
        }
        if scheme.is_empty() || scheme.len() > MOST_CLASSES {
            return Err(self.wrong(format!("{classes} classes, wanted 1 to {MOST_CLASSES}")));
        }
        let count = self.number()? as usize;
        let room = self.bytes.len() - self.at;
        if count == 0 || count.checked_mul(CHUNK_BYTES) != Some(room) {
            return Err(self.wrong(format!("{count} chunks in {room} bytes")));
        }
        let mut chunks = Vec::with_capacity(count);
        for i in 0..count {
            chunks.push(self.chunk(i, chunks.last())?);
        }
        let grid_m = 2f64.powi(exponent);
        Ok(Header { about: About { origin, scheme, method, tracked }, grid_m, chunks })
    }

    fn chunk(&mut self, i: usize, before: Option<&ChunkInfo>) -> Result<ChunkInfo> {
        let [bytes, events, faces, vertices] = [self.number()?, self.number()?, self.number()?, self.number()?];
        let energy = [i16::from_le_bytes(self.take()?), i16::from_le_bytes(self.take()?)];
        let (bounds, hash) = (self.take()?, self.take()?);
        let (new_faces, new_vertices) = match before {
            None => (Some(faces), Some(vertices)),
            Some(b) => (faces.checked_sub(b.faces), vertices.checked_sub(b.vertices)),
        };
        let fits = |n: Option<u32>| n.is_some_and(|n| least_bytes(n as usize) <= bytes as usize);
        let counted = if before.is_none() { events == 0 } else { new_vertices == Some(events) };
        // Corners are numbered 3 · face + corner.
        if !counted || !fits(new_faces) || !fits(new_vertices) || faces > u32::MAX / 4 || vertices >= u32::MAX - 1 {
            let what = format!("part {i} of {bytes} bytes with {events} events, {faces} faces, {vertices} vertices");
            return Err(self.wrong(what));
        }
        Ok(ChunkInfo { bytes, events, faces, vertices, energy, bounds, hash })
    }

    fn wrong(&self, what: impl std::fmt::Display) -> Error {
        Error::input_at(&self.path, Place::Byte(self.at as u64), format!("the header says {what}; record again"))
    }

    fn damaged(&self, what: &str) -> Error {
        Error::input(&self.path, format!("its {what} is damaged: the checksum does not match; copy it again"))
    }

    fn cut_off(&self, wanted: usize) -> Error {
        let what =
            format!("ends too early: {} bytes, and at least {wanted} belong to it; copy it again", self.bytes.len());
        Error::input(&self.path, what)
    }
}
