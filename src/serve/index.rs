//! What may be asked for: a table from request path to body, made once by walking the folder.
//!
//! Promise: the table holds regular files below the folder only; nothing is added to it by a request.

use std::collections::HashMap;
use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, RwLock};
use std::time::SystemTime;

use axum::body::Bytes;

use crate::{Error, Result};

/// The release our page is written for; `tools/viewer/package.json` pins the same.
const CESIUM_CDN: &str = "https://cesium.com/downloads/cesiumjs/releases/1.145/Build/Cesium/";
/// Where `npm ci` puts the build, seen from the project's folder.
const CESIUM_BUILD: &str = "tools/viewer/node_modules/cesium/Build/Cesium";
/// Where our page's own files are.
const VIEWER: &str = "viewer/";
const CONFIG: &str = "viewer/config.json";

/// Our page, compiled in: request path, content.
const PAGE: [(&str, &[u8]); 6] = [
    ("", include_bytes!("viewer/index.html")),
    ("viewer/style.css", include_bytes!("viewer/style.css")),
    ("viewer/viewer.js", include_bytes!("viewer/viewer.js")),
    ("viewer/classes.js", include_bytes!("viewer/classes.js")),
    ("viewer/inspect.js", include_bytes!("viewer/inspect.js")),
    ("viewer/panel.js", include_bytes!("viewer/panel.js")),
];

/// What tells one version of a file from the next without reading it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stamp {
    bytes: u64,
    modified: Option<SystemTime>,
    inode: u64,
}

impl Stamp {
    pub(super) fn of(found: &Metadata) -> Self {
        #[cfg(unix)]
        let inode = std::os::unix::fs::MetadataExt::ino(found);
        #[cfg(not(unix))]
        let inode = 0;
        Self { bytes: found.len(), modified: found.modified().ok(), inode }
    }
}

/// One thing that may be asked for.
pub(super) struct Entry {
    /// For `Content-Type`.
    pub(super) content_type: &'static str,
    /// For `Cache-Control`.
    pub(super) cache_control: &'static str,
    /// Where its bytes are.
    pub(super) source: Source,
}

/// Where bytes are.
pub(super) enum Source {
    /// In memory, with their tag.
    Memory { bytes: Bytes, etag: String },
    /// In a file, with the tag of the version it was made for.
    File { path: PathBuf, etag: Mutex<Option<(Stamp, String)>> },
}

/// All that may be asked for; immutable.
pub(super) struct Table {
    entries: HashMap<String, Arc<Entry>>,
    /// `tileset.json` when this table was made.
    tileset: Stamp,
    files: usize,
    bytes: u64,
}

/// Something in the folder that is not served.
#[derive(Debug)]
pub(super) struct Skipped {
    pub(super) code: &'static str,
    pub(super) path: PathBuf,
    pub(super) what: &'static str,
}

/// A served folder and its current table.
pub(super) struct Site {
    root: PathBuf,
    cesium: Option<PathBuf>,
    table: RwLock<Arc<Table>>,
}

impl Site {
    /// Indexes the tileset in `root`; `cesium` is a folder with `Cesium.js`, else the page loads it from the web.
    ///
    /// # Errors
    /// [`Error::Input`] without a `tileset.json`, [`Error::Io`] where the folder cannot be listed.
    pub(super) fn open(root: &Path, cesium: Option<PathBuf>) -> Result<(Self, Vec<Skipped>)> {
        let root = super::tileset_folder(root)?;
        let (table, skipped) = Table::of(&root, cesium.as_deref())?;
        Ok((Self { root, cesium, table: RwLock::new(Arc::new(table)) }, skipped))
    }

    /// What is served, in one line.
    pub(super) fn describe(&self) -> String {
        let table = self.table();
        let cesium = match &self.cesium {
            Some(folder) => folder.display().to_string(),
            None => format!("{CESIUM_CDN} (run `npm ci` in tools/viewer to work offline)"),
        };
        let size_mb = table.bytes as f64 / 1e6;
        format!("serving {}: {} files, {size_mb:.1} MB; CesiumJS from {cesium}", self.root.display(), table.files)
    }

    /// The entry for a decoded request path without its leading slash.
    pub(super) fn find(&self, path: &str) -> Option<Arc<Entry>> {
        self.table().entries.get(path).cloned()
    }

    /// Makes the table anew if `tileset.json` was replaced since; blocks, so only the paths that
    /// begin a visit ask for it.
    pub(super) fn refresh_for(&self, path: &str) {
        if path != "tileset.json" && path != CONFIG {
            return;
        }
        let now = std::fs::symlink_metadata(self.root.join("tileset.json")).map(|found| Stamp::of(&found));
        if now.is_ok_and(|now| now != self.table().tileset)
            && let Ok((table, _)) = Table::of(&self.root, self.cesium.as_deref())
        {
            *self.table.write().unwrap_or_else(|e| e.into_inner()) = Arc::new(table);
        }
    }

    fn table(&self) -> Arc<Table> {
        self.table.read().unwrap_or_else(|e| e.into_inner()).clone()
    }
}

impl Table {
    fn of(root: &Path, cesium: Option<&Path>) -> Result<(Self, Vec<Skipped>)> {
        let io = Error::io("read", root.join("tileset.json"));
        let tileset = Stamp::of(&std::fs::symlink_metadata(root.join("tileset.json")).map_err(io)?);
        let mut table = Self { entries: HashMap::new(), tileset, files: 0, bytes: 0 };
        let mut skipped = Vec::new();
        // A name for this version of the folder: the page adds it to every URL, so that a browser
        // never mixes a new tileset with old tiles out of its cache.
        let mut version = blake3::Hasher::new();
        for (path, file, found) in walk(root, &mut skipped)? {
            version.update(format!("{path}\0{:?}\0", Stamp::of(&found)).as_bytes());
            if path == "healthz" || path.starts_with(VIEWER) {
                let what = "not served: the server's own pages have this path; rename it";
                skipped.push(Skipped { code: "path-taken", path: file, what });
                continue;
            }
            table.files += 1;
            table.bytes += found.len();
            table.add(path, file);
        }
        if let Some(cesium) = cesium {
            for (path, file, _) in walk(cesium, &mut Vec::new())? {
                table.add(format!("viewer/cesium/{path}"), file);
            }
        }
        for (path, content) in PAGE {
            table.add_memory(path, Bytes::from_static(content));
        }
        let config = serde_json::json!({
            "version": env!("CARGO_PKG_VERSION"),
            "cesium": if cesium.is_some() { "/viewer/cesium/" } else { CESIUM_CDN },
            "tileset": format!("/tileset.json?v={}", &version.finalize().to_hex()[..16]),
        });
        table.add_memory(CONFIG, Bytes::from(config.to_string()));
        table.add_memory("healthz", Bytes::from_static(b"ok\n"));
        Ok((table, skipped))
    }

    fn add(&mut self, path: String, file: PathBuf) {
        let cache_control = cache_control(&path);
        let source = Source::File { path: file, etag: Mutex::new(None) };
        let entry = Entry { content_type: content_type(&path), cache_control, source };
        self.entries.insert(path, Arc::new(entry));
    }

    fn add_memory(&mut self, path: &str, bytes: Bytes) {
        let content_type = match path {
            "" => content_type("index.html"),
            "healthz" => "text/plain; charset=utf-8",
            _ => content_type(path),
        };
        let source = Source::Memory { etag: etag(&blake3::hash(&bytes)), bytes };
        self.entries.insert(path.to_owned(), Arc::new(Entry { content_type, cache_control: "no-cache", source }));
    }
}

/// The strong entity tag of content with this hash.
pub(super) fn etag(hash: &blake3::Hash) -> String {
    // 128 of the 256 bits: still no two contents alike by accident.
    format!("\"{}\"", &hash.to_hex()[..32])
}

/// All regular files below `root`, with their path in a URL; links, hidden files and odd names are skipped.
fn walk(root: &Path, skipped: &mut Vec<Skipped>) -> Result<Vec<(String, PathBuf, Metadata)>> {
    let mut files = Vec::new();
    let mut folders = vec![(String::new(), root.to_path_buf())];
    while let Some((prefix, folder)) = folders.pop() {
        let mut skip = |code, path: &Path, what| skipped.push(Skipped { code, path: path.to_path_buf(), what });
        let listing = match std::fs::read_dir(&folder) {
            Ok(listing) => listing,
            Err(error) if prefix.is_empty() => return Err(Error::io("read", root)(error)),
            Err(_) => {
                skip("unreadable-folder", &folder, "not served: the folder cannot be listed");
                continue;
            }
        };
        for item in listing.flatten() {
            let path = item.path();
            let name = item.file_name();
            let Some(name) = name.to_str() else {
                skip("odd-name", &path, "not served: the name is not UTF-8");
                continue;
            };
            if name.starts_with('.') {
                continue;
            }
            // Metadata of the item itself, never of what a link points to.
            match item.metadata() {
                Ok(found) if found.is_dir() => folders.push((format!("{prefix}{name}/"), path)),
                Ok(found) if found.is_file() => files.push((format!("{prefix}{name}"), path, found)),
                _ => skip("not-a-file", &path, "not served: a link or a special file, and only plain files are"),
            }
        }
    }
    files.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(files)
}

fn content_type(path: &str) -> &'static str {
    let extension = path.rsplit_once('.').map_or("", |(_, extension)| extension);
    match extension.to_ascii_lowercase().as_str() {
        "json" | "geojson" => "application/json",
        "gltf" => "model/gltf+json",
        "glb" => "model/gltf-binary",
        "jpg" | "jpeg" => "image/jpeg",
        "png" => "image/png",
        "webp" => "image/webp",
        "ktx2" => "image/ktx2",
        "svg" => "image/svg+xml",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "html" => "text/html; charset=utf-8",
        "txt" | "md" => "text/plain; charset=utf-8",
        "wasm" => "application/wasm",
        // .bin, .subtree, .b3dm, .i3dm, .pnts, .cmpt and whatever else: bytes.
        _ => "application/octet-stream",
    }
}

/// JSON says what the other files mean, so it is asked for again each time; tiles may be kept for an hour.
fn cache_control(path: &str) -> &'static str {
    if path.ends_with(".json") { "no-cache" } else { "public, max-age=3600" }
}

/// The folder of a CesiumJS build on this machine: named by `ROOFTILE_VIEWER`, in the project this
/// program was built in, or below the current folder.
pub(super) fn find_cesium() -> Option<PathBuf> {
    let mut places = Vec::new();
    if let Some(named) = std::env::var_os("ROOFTILE_VIEWER").map(PathBuf::from) {
        places.extend([named.join("node_modules/cesium/Build/Cesium"), named]);
    }
    if let Ok(program) = std::env::current_exe() {
        places.extend(program.ancestors().skip(1).map(|folder| folder.join(CESIUM_BUILD)));
    }
    places.push(PathBuf::from(CESIUM_BUILD));
    places.into_iter().filter(|place| place.join("Cesium.js").is_file()).find_map(|place| place.canonicalize().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn site(files: &[(&str, &str)]) -> (tempfile::TempDir, Site, Vec<Skipped>) {
        let folder = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = folder.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        let (site, skipped) = Site::open(folder.path(), None).unwrap();
        (folder, site, skipped)
    }

    #[test]
    fn files_in_subfolders_are_found_by_their_relative_path() {
        let (_folder, site, skipped) = site(&[("tileset.json", "{}"), ("0/1/2.glb", "glTF")]);
        assert!(skipped.is_empty());
        assert_eq!(site.find("0/1/2.glb").unwrap().content_type, "model/gltf-binary");
        assert!(site.find("0/1").is_none() && site.find("0/1/").is_none() && site.find("/0/1/2.glb").is_none());
    }

    #[test]
    fn a_file_in_the_place_of_our_page_is_reported_not_served() {
        let (_folder, site, skipped) = site(&[("tileset.json", "{}"), ("viewer/viewer.js", "alert()")]);
        assert_eq!(skipped[0].code, "path-taken");
        assert!(matches!(site.find("viewer/viewer.js").unwrap().source, Source::Memory { .. }));
    }

    #[test]
    fn a_new_tileset_json_brings_a_new_table() {
        let (folder, site, _) = site(&[("tileset.json", "{}"), ("a.glb", "1")]);
        std::fs::write(folder.path().join("b.glb"), "2").unwrap();
        site.refresh_for("tileset.json");
        assert!(site.find("b.glb").is_none(), "the table is immutable while tileset.json is");
        std::fs::write(folder.path().join("tileset.json"), "{ }").unwrap();
        site.refresh_for("b.glb");
        assert!(site.find("b.glb").is_none(), "only a visit's first paths look");
        site.refresh_for("tileset.json");
        assert!(site.find("b.glb").is_some());
    }

    #[test]
    fn the_page_asks_for_a_new_version_after_a_new_build() {
        let (folder, site, _) = site(&[("tileset.json", "{}"), ("a.glb", "1")]);
        let config = |site: &Site| match &site.find(CONFIG).unwrap().source {
            Source::Memory { bytes, .. } => bytes.clone(),
            Source::File { .. } => unreachable!(),
        };
        let before = config(&site);
        std::fs::write(folder.path().join("tileset.json"), "{ }").unwrap();
        site.refresh_for(CONFIG);
        assert_ne!(before, config(&site));
    }

    #[test]
    fn every_extension_we_write_has_its_type() {
        let cases = [
            ("tileset.json", "application/json"),
            ("a.glb", "model/gltf-binary"),
            ("a.JPG", "image/jpeg"),
            ("a.png", "image/png"),
            ("a.bin", "application/octet-stream"),
            ("a.subtree", "application/octet-stream"),
            ("a.b3dm", "application/octet-stream"),
            ("a.js", "text/javascript; charset=utf-8"),
            ("a.css", "text/css; charset=utf-8"),
            ("a.wasm", "application/wasm"),
            ("a.html", "text/html; charset=utf-8"),
            ("noextension", "application/octet-stream"),
        ];
        for (path, wanted) in cases {
            assert_eq!(content_type(path), wanted, "{path}");
        }
    }
}
