//! Buffers and buffer views as checked byte slices, loaded when first asked for.

use std::borrow::Cow;
use std::cell::{Cell, OnceCell};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::schema::{Buffer, BufferView, Int, Root};
use super::{meshopt, uri};
use crate::input::InputConfig;
use crate::input::path::referred;
use crate::{Error, Result};

/// Where the files are that a glTF names.
#[derive(Clone, Copy)]
pub enum Files<'a> {
    /// On disk, beside the glTF.
    Beside(&'a InputConfig),
    /// Wherever the function finds them: in an archive, on a server. It is given the URI.
    Given(&'a dyn Fn(&str) -> Result<Vec<u8>>),
}

/// Bytes of one glTF file. Every slice it gives out was checked against its buffer.
pub struct Data<'a> {
    pub path: &'a Path,
    pub root: &'a Root,
    bin: Option<&'a [u8]>,
    files: Files<'a>,
    buffers: Vec<OnceCell<Cow<'a, [u8]>>>,
    unpacked: Vec<OnceCell<Vec<u8>>>,
    loaded_bytes: Cell<u64>,
}

/// A buffer view's bytes and the stride it asks for.
#[derive(Clone, Copy)]
pub struct View<'a> {
    pub bytes: &'a [u8],
    pub stride: Option<u64>,
}

impl<'a> Data<'a> {
    pub fn new(path: &'a Path, root: &'a Root, bin: Option<&'a [u8]>, files: Files<'a>) -> Self {
        Self {
            path,
            root,
            bin,
            files,
            buffers: root.buffers.iter().map(|_| OnceCell::new()).collect(),
            unpacked: root.buffer_views.iter().map(|_| OnceCell::new()).collect(),
            loaded_bytes: Cell::new(0),
        }
    }

    /// Bytes loaded and unpacked so far: the measure of how much geometry the file can honestly hold.
    pub fn loaded_bytes(&self) -> u64 {
        self.loaded_bytes.get()
    }

    /// A refusal of this file.
    pub fn refuse(&self, what: impl Into<String>) -> Error {
        Error::input(self.path, what)
    }

    /// The item `index` of `list`, or a refusal that calls it `kind`.
    pub fn at<T>(&self, list: &'a [T], index: Int, kind: &str) -> Result<&'a T> {
        usize::try_from(index.0)
            .ok()
            .and_then(|i| list.get(i))
            .ok_or_else(|| self.refuse(format!("{kind} {} is referenced but there are {}", index.0, list.len())))
    }

    /// Where a file this glTF names is.
    pub fn resolve(&self, reference: &str) -> Result<PathBuf> {
        let decoded = uri::percent_decode(reference)
            .ok_or_else(|| self.refuse(format!("URI {:?} is not UTF-8 text after %-decoding", shorten(reference))))?;
        match self.files {
            Files::Beside(config) => referred(self.path, &decoded, config),
            Files::Given(_) => Err(self.refuse(format!("{:?} is no file of a folder", shorten(reference)))),
        }
    }

    /// The checked bytes of buffer view `index`, unpacked if it is compressed.
    pub fn view(&self, index: Int) -> Result<View<'_>> {
        let view = self.at(&self.root.buffer_views, index, "bufferView")?;
        let packed = view.extensions.ext_meshopt.as_ref().or(view.extensions.khr_meshopt.as_ref());
        let Some(packed) = packed else {
            let bytes = self.slice(index, view.buffer, view.byte_offset, view.byte_length)?;
            return Ok(View { bytes, stride: view.byte_stride.map(|s| s.0) });
        };
        let stride = Some(packed.byte_stride.0);
        let cell = &self.unpacked[index.0 as usize];
        if cell.get().is_none() {
            let bytes = self.slice(index, Some(packed.buffer), packed.byte_offset, Some(packed.byte_length))?;
            let place = |what: String| self.refuse(format!("bufferView {}: {what}", index.0));
            let unpacked = meshopt::unpack(packed, bytes, declared(view), self.path, place)?;
            self.loaded_bytes.set(self.loaded_bytes.get().saturating_add(unpacked.len() as u64));
            let _ = cell.set(unpacked);
        }
        Ok(View { bytes: cell.get().map_or(&[][..], |b| b), stride })
    }

    fn slice(&self, view: Int, buffer: Option<Int>, offset: Option<Int>, length: Option<Int>) -> Result<&[u8]> {
        let refuse = |what: String| self.refuse(format!("bufferView {}: {what}", view.0));
        let buffer = buffer.ok_or_else(|| refuse("names no buffer".into()))?;
        let length = length.ok_or_else(|| refuse("has no byteLength".into()))?.0;
        let bytes = self.buffer(buffer)?;
        let offset = offset.map_or(0, |o| o.0);
        let end = offset.checked_add(length).filter(|&end| end <= bytes.len() as u64);
        let end = end.ok_or_else(|| {
            let held = bytes.len();
            refuse(format!("bytes {offset} to {offset} + {length} leave buffer {}, which has {held}", buffer.0))
        })?;
        Ok(&bytes[offset as usize..end as usize])
    }

    fn buffer(&self, index: Int) -> Result<&[u8]> {
        let buffer = self.at(&self.root.buffers, index, "buffer")?;
        let cell = &self.buffers[index.0 as usize];
        if cell.get().is_none() {
            let bytes = self.load(index, buffer)?;
            self.loaded_bytes.set(self.loaded_bytes.get().saturating_add(bytes.len() as u64));
            let _ = cell.set(bytes);
        }
        Ok(cell.get().map_or(&[][..], |b| b))
    }

    fn load(&self, index: Int, buffer: &Buffer) -> Result<Cow<'a, [u8]>> {
        let refuse = |what: String| self.refuse(format!("buffer {}: {what}", index.0));
        let wanted = buffer.byte_length.ok_or_else(|| refuse("has no byteLength".into()))?.0;
        let short = |held: u64| refuse(format!("byteLength is {wanted} but there are only {held} bytes"));
        let mut bytes: Cow<'a, [u8]> = match &buffer.uri {
            Some(text) if uri::is_data(text) => {
                let (_, bytes) = uri::data(text).ok_or_else(|| refuse("its data: URI is not base64".into()))?;
                bytes.into()
            }
            Some(text) => self.read_file(text, wanted, &refuse)?.into(),
            None if index.0 == 0 => {
                self.bin.ok_or_else(|| refuse("has no uri and there is no BIN chunk".into()))?.into()
            }
            None => return Err(refuse("has no uri; only buffer 0 of a GLB may do without".into())),
        };
        let held = bytes.len() as u64;
        if held < wanted {
            return Err(short(held));
        }
        match &mut bytes {
            Cow::Borrowed(slice) => *slice = &slice[..wanted as usize],
            Cow::Owned(vec) => vec.truncate(wanted as usize),
        }
        Ok(bytes)
    }

    fn read_file(&self, text: &str, wanted: u64, refuse: &dyn Fn(String) -> Error) -> Result<Vec<u8>> {
        if let Files::Given(find) = self.files {
            return find(text);
        }
        let file_path = match self.resolve(text) {
            Err(Error::Io { .. }) => {
                let what = format!("file {:?} cannot be found; put it beside the glTF", shorten(text));
                return Err(refuse(what));
            }
            other => other?,
        };
        let file = File::open(&file_path).map_err(Error::io("read", &file_path))?;
        let held = file.metadata().map_err(Error::io("read", &file_path))?.len();
        if held < wanted {
            let what = format!("byteLength is {wanted} but {} has {held} bytes", file_path.display());
            return Err(refuse(what));
        }
        let mut bytes = Vec::new();
        file.take(wanted).read_to_end(&mut bytes).map_err(Error::io("read", &file_path))?;
        Ok(bytes)
    }
}

fn declared(view: &BufferView) -> Option<u64> {
    view.byte_length.map(|length| length.0)
}

/// The start of a text from a file, fit for a message.
pub fn shorten(text: &str) -> String {
    const SHOWN_CHARS: usize = 80;
    match text.char_indices().nth(SHOWN_CHARS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}
