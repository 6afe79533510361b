//! Reads `.3tz` archives: ZIP, entries stored, deflated or packed with zstd.
//!
//! The central directory says where the entries are; the index `@3dtilesIndex1@`, which repeats it in hashed form for
//! readers without memory, is not needed.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use std::sync::Mutex;

use zip::{CompressionMethod, ZipArchive};

use super::refusal::{Refusal, refuse};
use super::store::{MAX_FILE_BYTES, lock, read_limited};

const ZSTD: u16 = 93;

/// An archive, open. Entries are fetched by one thread at a time and unpacked by many.
pub struct Archive(Mutex<ZipArchive<BufReader<File>>>);

impl Archive {
    /// Opens the archive at `path`.
    pub fn open(path: &Path) -> Result<Self, Refusal> {
        let file = File::open(path).map_err(|e| Refusal::new("unreadable", format!("cannot open the archive: {e}")))?;
        let archive = ZipArchive::new(BufReader::new(file));
        archive.map(|a| Self(Mutex::new(a))).map_err(|e| Refusal::new("broken-archive", format!("is no archive: {e}")))
    }

    /// True if there is an entry at `path`.
    pub fn has(&self, path: &str) -> bool {
        lock(&self.0).index_for_name(path).is_some()
    }

    /// Size of the entry at `path`, unpacked as the archive says.
    pub fn size(&self, path: &str) -> Option<u64> {
        let mut archive = lock(&self.0);
        let index = archive.index_for_name(path)?;
        archive.by_index_raw(index).ok().map(|entry| entry.size())
    }

    /// The entry at `path`, unpacked, and its size in the archive.
    pub fn read(&self, path: &str) -> Result<(Vec<u8>, u64), Refusal> {
        let (method, packed, bytes) = self.packed(path)?;
        let stored = packed.len() as u64;
        let unpacked = match method {
            CompressionMethod::Stored => Ok(packed),
            CompressionMethod::Deflated => read_limited(flate2::read::DeflateDecoder::new(&packed[..]), path),
            other if is_zstd(other) => unzstd(&packed, path),
            other => {
                return refuse(
                    "archive-method",
                    format!("{path} is packed as {other}; stored, deflate and zstd are read"),
                );
            }
        };
        let unpacked =
            unpacked.map_err(|r| if r.code == "unreadable" { Refusal { code: "broken-archive", ..r } } else { r })?;
        if unpacked.len() as u64 != bytes {
            return refuse("broken-archive", format!("{path} unpacks to {} bytes of {bytes}", unpacked.len()));
        }
        Ok((unpacked, stored))
    }

    fn packed(&self, path: &str) -> Result<(CompressionMethod, Vec<u8>, u64), Refusal> {
        let broken = |e: &dyn std::fmt::Display| Refusal::new("broken-archive", format!("{path}: {e}"));
        let mut archive = lock(&self.0);
        let index = archive.index_for_name(path);
        let Some(index) = index else { return refuse("missing", format!("{path} is not in the archive")) };
        let entry = archive.by_index_raw(index).map_err(|e| broken(&e))?;
        if entry.compressed_size() > MAX_FILE_BYTES {
            return refuse("too-large", format!("{path} is larger than {MAX_FILE_BYTES} bytes"));
        }
        if entry.encrypted() {
            return refuse("archive-method", format!("{path} is encrypted"));
        }
        let (method, bytes, wanted) = (entry.compression(), entry.size(), entry.compressed_size());
        let packed = read_limited(entry.take(wanted), path)?;
        Ok((method, packed, bytes))
    }
}

/// The crate names zstd only where it is built with the C library, which is not wanted here.
#[expect(deprecated, reason = "the only way to tell a method that the crate was not built for")]
fn is_zstd(method: CompressionMethod) -> bool {
    matches!(method, CompressionMethod::Unsupported(ZSTD))
}

fn unzstd(packed: &[u8], path: &str) -> Result<Vec<u8>, Refusal> {
    let broken = |e: &dyn std::fmt::Display| Refusal::new("broken-archive", format!("{path}: {e}"));
    let decoder = ruzstd::decoding::StreamingDecoder::new(packed).map_err(|e| broken(&e))?;
    read_limited(decoder, path)
}
