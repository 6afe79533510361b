//! One chunk of an OBJ file: the bytes it is cut from and the arrays it is parsed into.
//!
//! A chunk knows nothing of the chunks before it, so an index is kept as a code ([`Code`]) that the stitch resolves.

use std::borrow::Cow;
use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::error::Place;
use crate::input::lines::{self, Encoding, LINE_LIMIT_BYTES, Numbers, is_space, trim_start};
use crate::{Error, Result};

/// First window searched for a line end, bytes; doubled until one is found.
const WINDOW_BYTES: u64 = 1 << 16;

/// An OBJ file's bytes, read piece by piece.
pub struct Bytes {
    path: PathBuf,
    /// Where the text begins, after a byte order mark.
    begin: u64,
    len: u64,
    /// The whole text where it had to be decoded (UTF-16).
    decoded: Option<Vec<u8>>,
}

impl Bytes {
    /// Opens a regular file.
    pub fn open(path: &Path) -> Result<Self> {
        let facts = std::fs::metadata(path).map_err(Error::io("read", path))?;
        if !facts.is_file() {
            return Err(Error::input(path, "is a folder, a pipe or a device; a regular OBJ file is wanted"));
        }
        let mut bytes = Self { path: path.to_path_buf(), begin: 0, len: facts.len(), decoded: None };
        let mark = bytes.slice(0, bytes.len.min(3))?.into_owned();
        match Encoding::of(&mark) {
            Encoding::Bytes(mark) => bytes.begin = mark as u64,
            Encoding::Utf16(_) => {
                let text = lines::decoded(std::fs::read(path).map_err(Error::io("read", path))?);
                bytes.len = text.len() as u64;
                bytes.decoded = Some(text);
            }
        }
        Ok(bytes)
    }

    /// Length of the text, bytes.
    pub fn len(&self) -> u64 {
        self.len - self.begin
    }

    /// The bytes from `start` to `end`.
    pub fn slice(&self, start: u64, end: u64) -> Result<Cow<'_, [u8]>> {
        if let Some(text) = &self.decoded {
            return Ok(Cow::Borrowed(&text[start as usize..end as usize]));
        }
        let mut file = File::open(&self.path).map_err(Error::io("read", &self.path))?;
        file.seek(SeekFrom::Start(start)).map_err(Error::io("read", &self.path))?;
        let mut piece = vec![0; (end - start) as usize];
        file.read_exact(&mut piece).map_err(Error::io("read", &self.path))?;
        Ok(Cow::Owned(piece))
    }

    /// Ranges of about `chunk_bytes` that begin and end between logical lines. Depends on nothing but the bytes.
    pub fn cut(&self, chunk_bytes: u64) -> Result<Vec<(u64, u64)>> {
        let mut cuts = vec![self.begin];
        let mut at = self.begin;
        while at < self.len {
            at = match at.saturating_add(chunk_bytes) {
                near if near < self.len => self.line_start_after(near)?,
                _ => self.len,
            };
            cuts.push(at);
        }
        Ok(cuts.windows(2).map(|pair| (pair[0], pair[1])).collect())
    }

    fn line_start_after(&self, at: u64) -> Result<u64> {
        let mut window = WINDOW_BYTES;
        loop {
            let end = self.len.min(at + window);
            if let Some(start) = lines::first_sure_line_start(&self.slice(at, end)?) {
                return Ok(at + start as u64);
            }
            if end == self.len {
                return Ok(end);
            }
            // Room for the rest of one longest line and a whole one after it.
            if window > 2 * LINE_LIMIT_BYTES as u64 + 4 {
                return Err(too_long(&self.path, at));
            }
            window *= 2;
        }
    }
}

/// The error for a line over the limit, near byte `at`.
pub fn too_long(path: &Path, at: u64) -> Error {
    Error::Limit {
        path: path.to_path_buf(),
        what: format!("a line near byte {at} is longer than {LINE_LIMIT_BYTES} bytes, the limit; break it with `\\`"),
    }
}

/// A vertex index as written, in 32 bits.
///
/// 0: none that could be valid. Up to [`Code::ABSENT`]: from 1, absolute. From 2^31: relative to the chunk's first
/// vertex, with a bias.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Code(u32);

impl Code {
    /// No index was written.
    pub const ABSENT: Self = Self(0x7FFF_FFFF);
    const RELATIVE: u32 = 0x8000_0000;
    const BIAS: i64 = 0xC000_0000;

    fn of(index: i64, local_count: usize) -> Self {
        let offset = (local_count as i64).saturating_add(index);
        if (1..i64::from(Self::ABSENT.0)).contains(&index) {
            Self(index as u32)
        } else if index < 0 && offset > -0x4000_0000 {
            Self((Self::BIAS + offset) as u32)
        } else {
            Self(0)
        }
    }

    /// The index from 0, if there is such an element among `count`; `base` elements came before the chunk.
    pub fn resolve(self, base: usize, count: usize) -> Option<u32> {
        let index = match self.0 {
            0 => return None,
            code if code < Self::RELATIVE => i64::from(code) - 1,
            code => base as i64 + i64::from(code) - Self::BIAS,
        };
        (0..count as i64).contains(&index).then_some(index as u32)
    }
}

/// What a chunk holds, in its own numbering.
#[derive(Debug, Default)]
pub struct Chunk {
    /// Physical lines.
    pub lines: u64,
    /// `v`; NaN where a coordinate is not a number.
    pub positions: Vec<DVec3>,
    /// As many as `positions`, NaN where there is none; or empty.
    pub colors: Vec<[f32; 3]>,
    /// `vt`, v down; NaN where not a number.
    pub uvs: Vec<[f32; 2]>,
    /// Position and uv of every corner, face by face.
    pub corners: Vec<[Code; 2]>,
    /// Per face, the end of its corners.
    pub ends: Vec<u32>,
    /// Per face, its line in the chunk.
    pub face_lines: Vec<u32>,
    /// First face and name of every stretch of one material.
    pub runs: Vec<(u32, u32)>,
    /// Material names, as `runs` refers to them.
    pub names: Vec<Vec<u8>>,
    name_ids: HashMap<Vec<u8>, u32>,
    /// Line and rest of every `mtllib`.
    pub libraries: Vec<(u32, Vec<u8>)>,
    /// Faces of one or two corners.
    pub short_faces: u64,
    /// Line and text of the first coordinate that is not a finite number.
    pub bad_number: Option<(u32, String)>,
}

impl Chunk {
    /// Parses one range of [`Bytes::cut`].
    ///
    /// # Errors
    /// NUL bytes, a line over the limit, I/O.
    pub fn read(bytes: &Bytes, (start, end): (u64, u64)) -> Result<Self> {
        let text = bytes.slice(start, end)?;
        if let Some(nul) = memchr::memchr(0, &text) {
            let place = Place::Byte(start + nul as u64);
            let what = "holds a NUL byte, so it is not OBJ text; if it is UTF-16, save it with a byte order mark";
            return Err(Error::input_at(&bytes.path, place, what));
        }
        let mut chunk = Self::default();
        let lines = lines::for_each_line(&text, |number, line| chunk.take(number, line));
        chunk.lines = lines.map_err(|at| too_long(&bytes.path, start + at as u64))?.into();
        // What is begun in doubling is kept for long: give back the slack.
        chunk.positions.shrink_to_fit();
        chunk.colors.shrink_to_fit();
        chunk.uvs.shrink_to_fit();
        chunk.corners.shrink_to_fit();
        chunk.ends.shrink_to_fit();
        chunk.face_lines.shrink_to_fit();
        Ok(chunk)
    }

    fn take(&mut self, number: u32, line: &[u8]) {
        match trim_start(line) {
            [b'v', b, rest @ ..] if is_space(*b) => self.take_vertex(number, rest),
            [b'v', b't', b, rest @ ..] if is_space(*b) => {
                let mut numbers = Numbers(rest);
                let u = numbers.next().unwrap_or(f64::NAN);
                let v = numbers.next().unwrap_or(0.0);
                self.uvs.push([u as f32, (1.0 - v) as f32]);
            }
            [b'f', b, rest @ ..] if is_space(*b) => self.take_face(number, rest),
            [b'f'] => self.short_faces += 1,
            [b'u' | b'm', ..] => self.take_name(number, line),
            _ => {}
        }
    }

    fn take_vertex(&mut self, number: u32, rest: &[u8]) {
        let mut values = [f64::NAN; 6];
        let mut count = 0;
        for value in Numbers(rest).take(7) {
            // The seventh is an alpha or a weight of a colour: read over.
            if let Some(slot) = values.get_mut(count) {
                *slot = value;
            }
            count += 1;
        }
        let position = DVec3::new(values[0], values[1], values[2]);
        if !position.is_finite() && self.bad_number.is_none() {
            self.bad_number = Some((number, lines::text(lines::trim(&rest[..rest.len().min(60)]))));
        }
        if count >= 6 || !self.colors.is_empty() {
            self.colors.resize(self.positions.len(), [f32::NAN; 3]);
            self.colors.push([values[3] as f32, values[4] as f32, values[5] as f32]);
            if count < 6 {
                self.colors[self.positions.len()] = [f32::NAN; 3];
            }
        }
        self.positions.push(position);
    }

    fn take_face(&mut self, number: u32, rest: &[u8]) {
        let first = self.corners.len();
        let mut rest = trim_start(rest);
        while rest.first().is_some_and(|&b| b != b'#') {
            rest = self.take_corner(rest);
        }
        if self.corners.len() - first < 3 {
            self.corners.truncate(first);
            self.short_faces += 1;
            return;
        }
        self.ends.push(self.corners.len() as u32);
        self.face_lines.push(number);
    }

    /// One of `v`, `v/vt`, `v//vn`, `v/vt/vn`; returns what follows it.
    fn take_corner<'a>(&mut self, text: &'a [u8]) -> &'a [u8] {
        let (position, mut rest) = integer(text);
        let mut corner = [Code::of(position.unwrap_or(0), self.positions.len()), Code::ABSENT];
        if let [b'/', after @ ..] = rest {
            let uv;
            (uv, rest) = integer(after);
            if let Some(uv) = uv {
                corner[1] = Code::of(uv, self.uvs.len());
            }
            if let [b'/', after @ ..] = rest {
                rest = integer(after).1;
            }
        }
        if rest.first().is_some_and(|&b| !is_space(b)) {
            corner[0] = Code(0);
            rest = &rest[rest.iter().position(|&b| is_space(b)).unwrap_or(rest.len())..];
        }
        self.corners.push(corner);
        trim_start(rest)
    }

    fn take_name(&mut self, number: u32, line: &[u8]) {
        let (word, rest) = lines::split_word(line);
        match word {
            b"usemtl" => {
                let name = lines::without_comment(lines::trim(rest));
                let face = self.ends.len() as u32;
                let id = self.name_ids.get(name).copied().unwrap_or_else(|| {
                    self.names.push(name.to_vec());
                    self.name_ids.insert(name.to_vec(), self.names.len() as u32 - 1);
                    self.names.len() as u32 - 1
                });
                // A switch that painted nothing is forgotten.
                self.runs.pop_if(|last| last.0 == face);
                self.runs.push((face, id));
            }
            b"mtllib" if self.libraries.last().is_none_or(|(_, last)| last != lines::trim(rest)) => {
                self.libraries.push((number, lines::trim(rest).to_vec()));
            }
            _ => {}
        }
    }
}

/// An integer at the start of `text` and what follows; too many digits give a number out of every range.
fn integer(text: &[u8]) -> (Option<i64>, &[u8]) {
    let (negative, digits) = match text {
        [b'-', rest @ ..] => (true, rest),
        [b'+', rest @ ..] => (false, rest),
        _ => (false, text),
    };
    let mut value = 0i64;
    let mut used = 0;
    while let Some(digit) = digits.get(used).map(|b| b.wrapping_sub(b'0')).filter(|d| *d < 10) {
        value = value.saturating_mul(10).saturating_add(digit.into());
        used += 1;
    }
    if used == 0 {
        return (None, text);
    }
    (Some(if negative { -value } else { value }), &digits[used..])
}
