//! Where the bytes of a tileset are: a folder, a `.3tz` archive, a web server. Nothing outside of it is ever read.
//!
//! # Promises
//! A URI leads nowhere but into the folder, archive or origin that the user named: `..`, absolute paths, drive letters,
//! `file:` and symbolic links out of it are refused. No file larger than [`MAX_FILE_BYTES`] is read, packed or unpacked.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use super::archive::Archive;
use super::refusal::{Refusal, refuse};
use crate::input::gltf::data::shorten;
use crate::input::gltf::uri::percent_decode;
use crate::{Error, Result};

/// Bytes of one file at most, before and after unpacking: ten times the largest tile that any viewer would draw.
pub const MAX_FILE_BYTES: u64 = 1 << 30;

const GZIP_MAGIC: &[u8] = &[0x1F, 0x8B];

/// A file of a tileset: which store, and the way from its root.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Address {
    store: usize,
    /// Folder and archive: names joined by `/`, no `.` or `..`. Server: the whole URL.
    pub path: String,
}

enum Store {
    /// Canonical folder.
    Folder(PathBuf),
    Archive(Archive),
    #[cfg(feature = "http")]
    Server(super::http::Server),
}

/// The stores of one tileset. Archives inside of a folder are opened as they are met.
pub struct Stores {
    stores: Vec<Store>,
    /// What the user named, for messages.
    shown: PathBuf,
}

/// A file as asked for: unpacked, and the bytes it took to fetch.
pub struct Fetched {
    /// After gzip.
    pub bytes: Vec<u8>,
    /// As stored or sent (in an archive: as the archive holds it).
    pub stored_bytes: u64,
}

impl Stores {
    /// The store of what the user named, and where its tileset.json is.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Input`] for a broken archive, [`Error::Unsupported`] for URLs without the feature `http`.
    pub fn open(named: &Path) -> Result<(Self, Address)> {
        let text = named.to_string_lossy();
        if text.starts_with("http://") || text.starts_with("https://") {
            return Self::open_server(named, &text);
        }
        let kind = std::fs::metadata(named).map_err(Error::io("read", named))?;
        let is_archive = named.extension().is_some_and(|e| e.eq_ignore_ascii_case("3tz"));
        if kind.is_file() && is_archive {
            let archive = Archive::open(named).map_err(|refusal| Error::input(named, refusal.what))?;
            let path = "tileset.json".to_string();
            return Ok((Self::of(Store::Archive(archive), named), Address { store: 0, path }));
        }
        let (folder, file) = match (kind.is_dir(), named.file_name()) {
            (true, _) => (named, "tileset.json".to_string()),
            (false, Some(name)) if kind.is_file() => {
                (named.parent().unwrap_or(Path::new("")), name.to_string_lossy().into_owned())
            }
            _ => return Err(Error::input(named, "is neither a folder nor a file; name a folder or its tileset.json")),
        };
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let folder = std::fs::canonicalize(folder).map_err(Error::io("read", folder))?;
        Ok((Self::of(Store::Folder(folder), named), Address { store: 0, path: file }))
    }

    fn of(store: Store, named: &Path) -> Self {
        Self { stores: vec![store], shown: named.to_path_buf() }
    }

    #[cfg(feature = "http")]
    fn open_server(named: &Path, url: &str) -> Result<(Self, Address)> {
        let server = super::http::Server::of(url).map_err(|refusal| Error::input(named, refusal.what))?;
        let path = server.start();
        Ok((Self::of(Store::Server(server), named), Address { store: 0, path }))
    }

    #[cfg(not(feature = "http"))]
    fn open_server(named: &Path, _url: &str) -> Result<(Self, Address)> {
        let what = "is on a server; build with `--features http`, or copy the tileset to a folder";
        Err(Error::Unsupported { path: named.into(), what: what.into() })
    }

    /// What the user named.
    pub fn shown(&self) -> &Path {
        &self.shown
    }

    /// True if looking into a file costs nothing but a disk access.
    pub fn is_local(&self, at: &Address) -> bool {
        #[cfg(feature = "http")]
        if matches!(self.stores.get(at.store), Some(Store::Server(_))) {
            return false;
        }
        at.store < self.stores.len()
    }

    /// Where `uri` leads from the file `base`.
    pub fn resolve(&self, base: &Address, uri: &str) -> std::result::Result<Address, Refusal> {
        #[cfg(feature = "http")]
        if let Some(Store::Server(server)) = self.stores.get(base.store) {
            return Ok(Address { store: base.store, path: server.resolve(&base.path, uri)? });
        }
        let plain = uri.split(['?', '#']).next().unwrap_or_default();
        let Some(plain) = percent_decode(plain) else {
            return refuse("bad-uri", "a URI is not UTF-8 after %-decoding");
        };
        if has_scheme(&plain) || plain.starts_with(['/', '\\']) {
            return refuse("outside", format!("the URI {:?} does not lead into the tileset", shorten(uri)));
        }
        let path = join(&base.path, &plain)
            .ok_or_else(|| Refusal::new("outside", format!("the URI {:?} leads out of the tileset", shorten(uri))))?;
        if path.is_empty() || path.contains('\0') {
            return refuse("bad-uri", format!("the URI {:?} names no file", shorten(uri)));
        }
        let at = Address { store: base.store, path };
        // Files are sometimes named as the URI is written: with %20, or with ?v=1.
        if plain.len() != uri.len() && !self.has(&at) {
            let as_written = join(&base.path, uri).map(|path| Address { store: base.store, path });
            return Ok(as_written.filter(|other| !other.path.contains('\0') && self.has(other)).unwrap_or(at));
        }
        Ok(at)
    }

    /// True if a folder or archive has the file.
    fn has(&self, at: &Address) -> bool {
        match self.stores.get(at.store) {
            Some(Store::Folder(folder)) => inside(folder, &at.path).is_ok_and(|path| path.is_file()),
            Some(Store::Archive(archive)) => archive.has(&at.path),
            #[cfg(feature = "http")]
            Some(Store::Server(_)) => true,
            None => false,
        }
    }

    /// Its size as stored, if that is known without fetching it.
    pub fn size(&self, at: &Address) -> Option<u64> {
        match self.stores.get(at.store)? {
            Store::Folder(folder) => std::fs::metadata(inside(folder, &at.path).ok()?).ok().map(|m| m.len()),
            Store::Archive(archive) => archive.size(&at.path),
            #[cfg(feature = "http")]
            Store::Server(_) => None,
        }
    }

    /// Opens the archive at `at` as a store of its own; returns where its tileset.json is.
    pub fn enter(&mut self, at: &Address) -> std::result::Result<Address, Refusal> {
        let Some(Store::Folder(folder)) = self.stores.get(at.store) else {
            return refuse("nested-archive", "an archive within an archive or on a server is not read; unpack it");
        };
        let archive = Archive::open(&inside(folder, &at.path)?)?;
        self.stores.push(Store::Archive(archive));
        Ok(Address { store: self.stores.len() - 1, path: "tileset.json".into() })
    }

    /// The file at `at`, gzip undone.
    pub fn fetch(&self, at: &Address) -> std::result::Result<Fetched, Refusal> {
        let (bytes, stored_bytes) = match self.stores.get(at.store) {
            Some(Store::Folder(folder)) => read_file(&inside(folder, &at.path)?)?,
            Some(Store::Archive(archive)) => archive.read(&at.path)?,
            #[cfg(feature = "http")]
            Some(Store::Server(server)) => server.get(&at.path)?,
            None => return refuse("missing", "there is no such store"),
        };
        let bytes = if bytes.starts_with(GZIP_MAGIC) { gunzip(&bytes)? } else { bytes };
        Ok(Fetched { bytes, stored_bytes })
    }

    /// The file at `at` may be told to be one without reading it: its first bytes.
    pub fn peek(&self, at: &Address) -> Option<Vec<u8>> {
        const PEEK_BYTES: u64 = 4096;
        match self.stores.get(at.store)? {
            Store::Folder(folder) => {
                let file = File::open(inside(folder, &at.path).ok()?).ok()?;
                let mut bytes = Vec::new();
                file.take(PEEK_BYTES).read_to_end(&mut bytes).ok()?;
                Some(bytes)
            }
            Store::Archive(archive) => archive.read(&at.path).ok().map(|(bytes, _)| bytes),
            #[cfg(feature = "http")]
            Store::Server(_) => None,
        }
    }
}

/// The canonical path of a regular file in `folder`.
fn inside(folder: &Path, path: &str) -> std::result::Result<PathBuf, Refusal> {
    let full = match std::fs::canonicalize(folder.join(path)) {
        Ok(full) => full,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return refuse("missing", format!("{path} is not there")),
        Err(e) => return refuse("unreadable", format!("{path}: {e}")),
    };
    if !full.starts_with(folder) {
        return refuse("outside", format!("{path} is a link out of the tileset's folder"));
    }
    Ok(full)
}

fn read_file(path: &Path) -> std::result::Result<(Vec<u8>, u64), Refusal> {
    let unreadable = |e: std::io::Error| Refusal::new("unreadable", format!("{}: {e}", name(path)));
    let kind = std::fs::metadata(path).map_err(unreadable)?;
    if !kind.is_file() {
        return refuse("unreadable", format!("{} is not a regular file", name(path)));
    }
    let file = File::open(path).map_err(unreadable)?;
    let bytes = read_limited(file, &name(path))?;
    let stored = bytes.len() as u64;
    Ok((bytes, stored))
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// All of `reader`, or a refusal if that is more than [`MAX_FILE_BYTES`].
pub fn read_limited(reader: impl Read, name: &str) -> std::result::Result<Vec<u8>, Refusal> {
    let mut bytes = Vec::new();
    let read = reader.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes);
    read.map_err(|e| Refusal::new("unreadable", format!("{name}: {e}")))?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return refuse("too-large", format!("{name} is larger than {MAX_FILE_BYTES} bytes"));
    }
    Ok(bytes)
}

fn gunzip(bytes: &[u8]) -> std::result::Result<Vec<u8>, Refusal> {
    let unpacked = read_limited(flate2::read::MultiGzDecoder::new(bytes), "the gzipped file");
    unpacked.map_err(
        |refusal| if refusal.code == "unreadable" { Refusal { code: "broken-gzip", ..refusal } } else { refusal },
    )
}

/// True for `http:`, `file:`, `C:` and the like.
pub fn has_scheme(uri: &str) -> bool {
    let Some((scheme, _)) = uri.split_once(':') else { return false };
    scheme.starts_with(|c: char| c.is_ascii_alphabetic())
        && scheme.chars().all(|c| c.is_ascii_alphanumeric() || "+-.".contains(c))
}

/// `relative` seen from the folder of the file `base`; `None` if it leads above the root.
pub fn join(base: &str, relative: &str) -> Option<String> {
    let folder = base.rsplit_once('/').map_or("", |(folder, _)| folder);
    let mut names: Vec<&str> = folder.split('/').filter(|name| !name.is_empty()).collect();
    for name in relative.split(['/', '\\']) {
        match name {
            "" | "." => {}
            ".." => {
                names.pop()?;
            }
            name => names.push(name),
        }
    }
    Some(names.join("/"))
}

/// Locks whether or not another thread panicked in the meantime.
pub fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_uri_never_leaves_the_folder_of_the_tileset() {
        let temp = tempfile::tempdir().unwrap();
        let folder = temp.path().join("tiles");
        std::fs::create_dir_all(folder.join("a")).unwrap();
        std::fs::write(temp.path().join("secret.glb"), b"secret").unwrap();
        std::fs::write(folder.join("b c.glb"), b"found").unwrap();
        std::fs::write(folder.join("tileset.json"), b"{}").unwrap();
        let (stores, root) = Stores::open(&folder).unwrap();
        let base = stores.resolve(&root, "a/tileset.json").unwrap();
        for uri in [
            "../../secret.glb",
            "/etc/passwd",
            "file:///etc/passwd",
            "C:\\x.glb",
            "..\\..\\secret.glb",
            "%2e%2e/../secret.glb",
        ] {
            assert_eq!(stores.resolve(&base, uri).unwrap_err().code, "outside", "{uri}");
        }
        let found = stores.resolve(&base, "../b%20c.glb?v=1#x").unwrap();
        assert_eq!(stores.fetch(&found).unwrap().bytes, b"found");
        assert_eq!(stores.resolve(&base, "?v=1").map(|a| a.path), Ok("a".into()));
    }

    #[cfg(unix)]
    #[test]
    fn a_link_out_of_the_folder_is_not_followed() {
        let temp = tempfile::tempdir().unwrap();
        let folder = temp.path().join("tiles");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(temp.path().join("secret.glb"), b"secret").unwrap();
        std::os::unix::fs::symlink("../secret.glb", folder.join("x.glb")).unwrap();
        let (stores, root) = Stores::open(&folder).unwrap();
        let at = stores.resolve(&root, "x.glb").unwrap();
        assert_eq!(stores.fetch(&at).err().map(|r| r.code), Some("outside"));
        let at = stores.resolve(&root, "y.glb").unwrap();
        assert_eq!(stores.fetch(&at).err().map(|r| r.code), Some("missing"));
    }

    #[test]
    fn gzipped_files_are_unpacked_and_broken_ones_refused() {
        use std::io::Write;
        let temp = tempfile::tempdir().unwrap();
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        encoder.write_all(&[7; 1000]).unwrap();
        let packed = encoder.finish().unwrap();
        std::fs::write(temp.path().join("a.glb"), &packed).unwrap();
        std::fs::write(temp.path().join("b.glb"), &packed[..packed.len() / 2]).unwrap();
        let (stores, root) = Stores::open(temp.path()).unwrap();
        let fetched = stores.fetch(&stores.resolve(&root, "a.glb").unwrap()).unwrap();
        assert_eq!((fetched.bytes.len(), fetched.stored_bytes), (1000, packed.len() as u64));
        let broken = stores.fetch(&stores.resolve(&root, "b.glb").unwrap());
        assert_eq!(broken.err().map(|r| r.code), Some("broken-gzip"));
    }
}
