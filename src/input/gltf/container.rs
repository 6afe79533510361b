//! Splits a file into its JSON and its binary chunk; knows nothing of what they mean.

use std::path::Path;

use crate::error::Place;
use crate::report::Reporter;
use crate::{Error, Result};

const MAGIC: &[u8] = b"glTF";
const HEADER_BYTES: usize = 12;
const CHUNK_HEADER_BYTES: usize = 8;
const CHUNK_JSON: u32 = 0x4E4F_534A;
const CHUNK_BIN: u32 = 0x004E_4942;
const BOM: &[u8] = b"\xEF\xBB\xBF";

/// The JSON text and, for a GLB that has one, the binary chunk.
#[derive(Debug)]
pub struct Container<'a> {
    pub json: &'a [u8],
    pub bin: Option<&'a [u8]>,
}

/// Splits `bytes`; GLB is told from JSON by its magic, not by the file's name.
pub fn split<'a>(path: &Path, bytes: &'a [u8], reporter: &Reporter) -> Result<Container<'a>> {
    if bytes.starts_with(MAGIC) {
        return split_glb(path, bytes, reporter);
    }
    let json = trim(bytes);
    if !json.trim_ascii_start().starts_with(b"{") {
        return Err(Error::input(path, "is not a glTF: it starts with neither '{' nor 'glTF'"));
    }
    Ok(Container { json, bin: None })
}

fn split_glb<'a>(path: &Path, bytes: &'a [u8], reporter: &Reporter) -> Result<Container<'a>> {
    let at = |byte: usize, what: String| Error::input_at(path, Place::Byte(byte as u64), what);
    let word = |byte: usize| {
        let found = bytes.get(byte..byte + 4).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
        found.ok_or_else(|| at(byte, format!("the file ends here, inside a GLB header, after {} bytes", bytes.len())))
    };
    match word(4)? {
        2 => {}
        1 => return Err(Error::Unsupported { path: path.into(), what: "is glTF 1.0; convert it to glTF 2.0".into() }),
        other => return Err(at(4, format!("GLB version {other}, wanted 2"))),
    }
    let length = word(8)? as usize;
    if length < HEADER_BYTES || length > bytes.len() {
        let what = format!("the header says {length} bytes but the file has {}; it may be cut short", bytes.len());
        return Err(at(8, what));
    }
    if length < bytes.len() {
        let what = format!("{} bytes after the end of the GLB were ignored", bytes.len() - length);
        reporter.warn("glb-trailing-bytes", path, what);
    }

    let (mut json, mut bin) = (None, None);
    let (mut byte, mut place) = (HEADER_BYTES, 0);
    while byte < length {
        let size = word(byte)? as usize;
        let kind = word(byte + 4)?;
        let start = byte + CHUNK_HEADER_BYTES;
        let data = start.checked_add(size).filter(|&end| end <= length).and_then(|end| bytes.get(start..end));
        let Some(data) = data else {
            return Err(at(byte, format!("a chunk of {size} bytes reaches over the end of the GLB at byte {length}")));
        };
        match (kind, place) {
            (CHUNK_JSON, 0) => json = Some(trim(data)),
            (CHUNK_BIN, 1) => bin = Some(data),
            (CHUNK_JSON, _) => return Err(at(byte, "a second JSON chunk; a GLB has one, and first".into())),
            (CHUNK_BIN, _) => {
                return Err(at(byte, "a BIN chunk where none may be; it is the GLB's second chunk".into()));
            }
            (other, 0) => return Err(at(byte, format!("the first chunk has type {other:#010x}, wanted JSON"))),
            _ => {}
        }
        byte = start + size;
        place += 1;
    }
    match json {
        Some(json) if !json.is_empty() => Ok(Container { json, bin }),
        _ => Err(Error::input(path, "the GLB has no JSON chunk, or an empty one")),
    }
}

/// Without a byte order mark and without padding (some writers pad JSON with zeros).
fn trim(json: &[u8]) -> &[u8] {
    let json = json.strip_prefix(BOM).unwrap_or(json);
    let end = json.iter().rposition(|&b| b != 0 && !b.is_ascii_whitespace()).map_or(0, |last| last + 1);
    &json[..end]
}
