//! Lists the tiles of a tileset and of the tilesets that it refers to, parents first.

use std::path::Path;
use std::sync::Arc;

use glam::DMat4;

use super::implicit;
use super::json;
use super::mend;
use super::refusal::{Refusal, refuse};
use super::store::{Address, Stores};
use super::volume::{Volume, largest_scale};
use super::{Content, Refine, SourceFile, Tile, UpAxis};
use crate::report::Reporter;
use crate::{Error, Result};

/// Tiles of one tileset at most: some 400 MB of memory.
pub const MAX_TILES: usize = 1_000_000;

/// Tilesets that refer to tilesets, at most.
const MAX_EXTERNAL_DEPTH: u32 = 64;

/// Bytes of tileset JSON and subtrees read over all files.
const MAX_STRUCTURE_BYTES: u64 = 4 << 30;

/// Scales this near to 1 are rounding of a rotation.
const SCALE_SLACK: f64 = 1e-6;

const KNOWN_EXTENSIONS: [&str; 8] = [
    "3DTILES_content_gltf",
    "3DTILES_implicit_tiling",
    "3DTILES_multiple_contents",
    "3DTILES_metadata",
    "3DTILES_bounding_volume_S2",
    "3DTILES_batch_table_hierarchy",
    "MAXAR_content_geojson",
    "MAXAR_extent",
];

/// What is still to be added, depth first.
enum Step {
    Tile { wire: Box<json::Tile>, file: u32, parent: Option<usize>, way: u32 },
    External { at: Address, parent: usize },
}

/// The list as it grows.
pub struct Walker<'a> {
    pub stores: &'a mut Stores,
    pub tiles: Vec<Tile>,
    pub files: Vec<SourceFile>,
    /// Places for tiles looked at in subtrees.
    pub work: u64,
    reporter: &'a Reporter,
    bytes: u64,
    steps: Vec<Step>,
}

impl<'a> Walker<'a> {
    /// Reads the tileset at `start` and all it refers to.
    pub fn walk(
        stores: &'a mut Stores,
        start: &Address,
        reporter: &'a Reporter,
    ) -> Result<(Vec<Tile>, Vec<SourceFile>)> {
        let shown = stores.shown().to_path_buf();
        let mut walker =
            Self { stores, tiles: Vec::new(), files: Vec::new(), work: 0, reporter, bytes: 0, steps: Vec::new() };
        walker.read_file(start, None).map_err(|refusal| Error::input(&shown, refusal.to_string()))?;
        while let Some(step) = walker.steps.pop() {
            reporter.check()?;
            if walker.is_full() {
                break;
            }
            match step {
                Step::Tile { wire, file, parent, way } => walker.add(*wire, file, parent, way),
                Step::External { at, parent } => walker.enter(&at, parent),
            }
        }
        if walker.is_full() {
            let what = format!("the tileset has {MAX_TILES} tiles or more; the rest was left out");
            reporter.warn("too-many-tiles", &shown, what);
        }
        Ok((walker.tiles, walker.files))
    }

    /// True if no tile may be added any more.
    pub fn is_full(&self) -> bool {
        self.tiles.len() >= MAX_TILES
    }

    /// Counts bytes of structure that were read.
    pub fn charge(&mut self, bytes: u64) -> std::result::Result<(), Refusal> {
        self.bytes = self.bytes.saturating_add(bytes);
        if self.bytes > MAX_STRUCTURE_BYTES {
            return refuse("too-large", format!("tilesets and subtrees have more than {MAX_STRUCTURE_BYTES} bytes"));
        }
        Ok(())
    }

    /// Warns about something of tile `tile`.
    pub fn warn(&self, code: &'static str, tile: usize, refusal: &Refusal) {
        self.reporter.warn(code, Path::new(&super::trail(&self.tiles, &self.files, tile)), refusal.what.clone());
    }

    /// The file that tile `tile` is in.
    pub fn address_of(&self, tile: usize) -> &Address {
        &self.files[self.tiles[tile].file as usize].at
    }

    /// Reads a tileset JSON and puts its root on the list of things to do.
    fn read_file(&mut self, at: &Address, parent: Option<usize>) -> std::result::Result<(), Refusal> {
        let fetched = self.stores.fetch(at)?;
        self.charge(fetched.bytes.len() as u64)?;
        let (wire, is_mended): (json::Tileset, bool) = mend::read(&fetched.bytes)
            .map_err(|e| Refusal::new("broken-tileset", format!("{} is no tileset: {e}", at.path)))?;
        if is_mended {
            let what = format!("{} is no sound JSON; it was read as it is meant, which viewers do not do", at.path);
            self.reporter.warn("json-mended", Path::new(&at.path), what);
        }
        let Some(root) = wire.root else { return refuse("broken-tileset", format!("{} has no root tile", at.path)) };
        let above = parent.map(|tile| self.tiles[tile].file);
        let asset = wire.asset.unwrap_or_default();
        let up_axis = match asset.gltf_up_axis.as_deref() {
            Some("X" | "x") => UpAxis::X,
            Some("Y" | "y") => UpAxis::Y,
            Some("Z" | "z") => UpAxis::Z,
            _ => above.map_or(UpAxis::Y, |file| self.files[file as usize].up_axis),
        };
        let unknown = wire.extensions_required.iter().flatten().filter(|e| !KNOWN_EXTENSIONS.contains(&e.as_str()));
        for name in unknown {
            let what = format!("{} requires the extension {name:?}, which is not read", at.path);
            self.reporter.warn("tileset-extension", Path::new(&at.path), what);
        }
        let depth = above.map_or(0, |file| self.files[file as usize].depth + 1);
        let file = self.files.len() as u32;
        self.files.push(SourceFile {
            at: at.clone(),
            above,
            depth,
            up_axis,
            version: asset.version,
            generator: asset.generator,
            geometric_error_m: wire.geometric_error,
            json_bytes: fetched.bytes.len() as u64,
        });
        self.steps.push(Step::Tile { wire: Box::new(root), file, parent, way: 0 });
        Ok(())
    }

    /// Follows a reference from tile `parent` to another tileset.
    fn enter(&mut self, at: &Address, parent: usize) {
        let mut above = Some(self.tiles[parent].file);
        let depth = self.files[self.tiles[parent].file as usize].depth + 1;
        while let Some(file) = above {
            if self.files[file as usize].at == *at {
                let what = format!("{} refers to itself, over {} tilesets; not followed", at.path, depth);
                return self.warn("tileset-cycle", parent, &Refusal::new("tileset-cycle", what));
            }
            above = self.files[file as usize].above;
        }
        if depth > MAX_EXTERNAL_DEPTH {
            let what = format!("tilesets refer to tilesets more than {MAX_EXTERNAL_DEPTH} deep; not followed");
            return self.warn("tileset-depth", parent, &Refusal::new("tileset-depth", what));
        }
        let is_archive = has_ending(&at.path, "3tz");
        let entered = if is_archive { self.stores.enter(at) } else { Ok(at.clone()) };
        if let Err(refusal) = entered.and_then(|at| self.read_file(&at, Some(parent))) {
            self.warn("external-not-read", parent, &refusal);
        }
    }

    fn add(&mut self, wire: json::Tile, file: u32, parent: Option<usize>, way: u32) {
        let above = parent.map(|p| &self.tiles[p]);
        let mut refused = Vec::new();
        let root_from_parent = above.map_or(DMat4::IDENTITY, |p| p.transform);
        let own = wire.transform.as_deref().map(own_transform).unwrap_or(Ok(DMat4::IDENTITY));
        let transform = root_from_parent
            * own.unwrap_or_else(|refusal| {
                refused.push(("bad-transform", refusal));
                DMat4::IDENTITY
            });
        let refine = match wire.refine.as_deref() {
            Some(text) if text.eq_ignore_ascii_case("ADD") => Refine::Add,
            Some(text) if text.eq_ignore_ascii_case("REPLACE") => Refine::Replace,
            Some(text) => {
                let what = format!("refine is {text:?}; REPLACE is assumed");
                refused.push(("bad-refine", Refusal::new("bad-refine", what)));
                Refine::Replace
            }
            None => above.map_or(Refine::Replace, |p| p.refine),
        };
        if wire.geometric_error.is_none() {
            let what = "a tile has no geometricError; 0 is assumed";
            refused.push(("geometric-error-missing", Refusal::new("geometric-error-missing", what)));
        }
        let volume = volume_of(wire.bounding_volume.as_ref(), &transform, &mut refused);
        let stated = wire.geometric_error.unwrap_or(0.0);
        let tile = Tile {
            parent,
            children: Vec::new(),
            depth: above.map_or(0, |p| p.depth + 1),
            file,
            way,
            stated_error: stated,
            geometric_error_m: stated * scale(&transform),
            refine,
            volume,
            contents: Vec::new(),
            metadata: wire.metadata,
            transform,
            implicit: None,
        };
        let id = self.push(tile);
        refused.iter().for_each(|(code, refusal)| self.warn(code, id, refusal));

        let extensions = wire.extensions.unwrap_or_default();
        let multiple = extensions.multiple_contents.and_then(|m| m.contents);
        let contents: Vec<json::Content> = wire
            .content
            .into_iter()
            .chain(wire.contents.into_iter().flatten())
            .chain(multiple.into_iter().flatten())
            .collect();
        let implicit = wire.implicit_tiling.or(extensions.implicit_tiling);
        let children = wire.children.unwrap_or_default();
        let children = children.into_iter().enumerate().rev();
        self.steps.extend(children.map(|(way, wire)| Step::Tile {
            wire: Box::new(wire),
            file,
            parent: Some(id),
            way: way as u32,
        }));
        if let Some(implicit) = implicit {
            if let Err(refusal) = implicit::expand(self, id, &implicit, contents, wire.bounding_volume.as_ref()) {
                self.warn("implicit-not-read", id, &refusal);
            }
            return;
        }
        let base = self.address_of(id).clone();
        for content in contents {
            match content.uri.or(content.url) {
                Some(uri) => self.add_content(id, &base, uri, content.bounding_volume.as_ref()),
                None => {
                    let what = "a content has no uri";
                    self.warn("bad-content", id, &Refusal::new("bad-content", what));
                }
            }
        }
    }

    fn push(&mut self, tile: Tile) -> usize {
        let id = self.tiles.len();
        if let Some(parent) = tile.parent {
            self.tiles[parent].children.push(id);
        }
        self.tiles.push(tile);
        id
    }

    /// Adds a tile of an implicit tree.
    pub fn add_implicit(
        &mut self,
        parent: usize,
        volume: &json::BoundingVolume,
        stated: f64,
        place: [u32; 4],
    ) -> usize {
        let above = &self.tiles[parent];
        let mut refused = Vec::new();
        let transform = above.transform;
        let tile = Tile {
            parent: Some(parent),
            children: Vec::new(),
            depth: above.depth + 1,
            file: above.file,
            way: above.children.len() as u32,
            stated_error: stated,
            geometric_error_m: stated * scale(&transform),
            refine: above.refine,
            volume: volume_of(Some(volume), &transform, &mut refused),
            contents: Vec::new(),
            metadata: None,
            transform,
            implicit: Some(place),
        };
        let id = self.push(tile);
        refused.iter().for_each(|(code, refusal)| self.warn(code, id, refusal));
        id
    }

    /// Adds what `uri` leads to: a content, or another tileset to be read.
    pub fn add_content(&mut self, tile: usize, base: &Address, uri: String, volume: Option<&json::BoundingVolume>) {
        let at = self.stores.resolve(base, &uri);
        let mut refused = Vec::new();
        let transform = self.tiles[tile].transform;
        let volume = volume.and_then(|volume| volume_of(Some(volume), &transform, &mut refused));
        refused.iter().for_each(|(code, refusal)| self.warn(code, tile, refusal));
        let is_tileset = at.as_ref().map_or_else(|_| is_named_tileset(&uri), |at| self.is_tileset(at));
        if let (true, Ok(at)) = (is_tileset, &at) {
            self.steps.push(Step::External { at: at.clone(), parent: tile });
        }
        if let Err(refusal) = &at {
            self.warn("bad-uri", tile, refusal);
        }
        self.tiles[tile].contents.push(Content { uri: Arc::from(uri), at: at.ok(), volume, is_tileset });
    }

    /// True for tilesets, by name, or by a look inside where the name says nothing.
    fn is_tileset(&self, at: &Address) -> bool {
        const CONTENTS: [&str; 10] = ["b3dm", "i3dm", "pnts", "cmpt", "glb", "gltf", "vctr", "geom", "geojson", "bin"];
        let path = at.path.split('?').next().unwrap_or_default();
        if is_named_tileset(path) {
            return true;
        }
        if CONTENTS.iter().any(|ending| has_ending(path, ending)) || !self.stores.is_local(at) {
            return false;
        }
        let Some(bytes) = self.stores.peek(at) else { return false };
        let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&bytes).trim_ascii_start();
        text.starts_with(b"{") && memchr::memmem::find(text, b"geometricError").is_some()
    }
}

fn is_named_tileset(uri: &str) -> bool {
    has_ending(uri, "json") || has_ending(uri, "3tz")
}

fn has_ending(path: &str, ending: &str) -> bool {
    path.split('?')
        .next()
        .and_then(|path| path.rsplit_once('.'))
        .is_some_and(|(_, found)| found.eq_ignore_ascii_case(ending))
}

fn own_transform(numbers: &[f64]) -> std::result::Result<DMat4, Refusal> {
    let Ok(columns) = <&[f64; 16]>::try_from(numbers) else {
        return refuse("bad-transform", format!("a transform has {} numbers, not 16; it is ignored", numbers.len()));
    };
    let found = DMat4::from_cols_array(columns);
    if !found.is_finite() {
        return refuse("bad-transform", "a transform is not finite; it is ignored");
    }
    Ok(found)
}

/// Geometric errors are scaled as the largest axis of the transform is.
fn scale(transform: &DMat4) -> f64 {
    let scale = largest_scale(transform);
    if (scale - 1.0).abs() < SCALE_SLACK { 1.0 } else { scale }
}

fn volume_of(
    wire: Option<&json::BoundingVolume>,
    transform: &DMat4,
    refused: &mut Vec<(&'static str, Refusal)>,
) -> Option<Volume> {
    let Some(wire) = wire else {
        refused.push(("volume-missing", Refusal::new("volume-missing", "a tile has no boundingVolume")));
        return None;
    };
    let found = Volume::of(wire, transform).unwrap_or_else(|refusal| {
        refused.push(("bad-volume", refusal));
        None
    });
    if found.is_none() && refused.is_empty() {
        let what = "a bounding volume is of a kind that is not read";
        refused.push(("volume-not-read", Refusal::new("volume-not-read", what)));
    }
    found
}
