//! Reads anybody's 3D Tiles: the tree at once, the contents one tile at a time.
//!
//! In: a folder, a tileset.json, a `.3tz` archive, or (feature `http`) a URL. Out: a [`Tileset`], whose tiles are
//! loaded with [`Tileset::load`] into triangles in one local frame.
//!
//! # Method
//! 1. walk the tree, over external tilesets and subtrees ([`tree`], [`implicit`])
//! 2. set a frame: east, north and up about the tileset's centre if that is on the globe, else the root's own
//! 3. on demand take a content apart (gzip, b3dm, cmpt: [`content`]) to its glTF, 1.0 or 2.0 ([`mesh`])
//!
//! # Promises
//! One bad tile does not lose the others: it is refused by a code, and the reasons are counted. No panic, no endless
//! walk, no allocation on a file's word; no byte from outside of the folder, archive or origin named.
//!
//! # Limits
//! i3dm, pnts, vctr and geom are refused, and Draco without the feature `draco`; batch tables, S2 volumes, metadata of
//! implicit tiles and `EXT_mesh_gpu_instancing` are not read. Files outside of the folder named are refused even where a
//! tileset refers to them: name a folder that holds all.

use std::path::Path;
use std::sync::Arc;

use glam::{DMat4, DVec3};
use serde_json::Value;

pub use self::mesh::{FaceClasses, Part, Texture, TileMesh};
pub use self::refusal::Refusal;
pub(super) use self::store::lock;
use self::store::{Address, Stores};
pub use self::volume::Volume;
use crate::geo::Geodetic;
use crate::geo::ellipsoid::{A_M, ecef_from_enu, geodetic_from_ecef};
use crate::report::{Reporter, Warning};
use crate::{Error, Result};

mod archive;
mod classes;
mod content;
#[cfg(feature = "draco")]
mod draco;
#[cfg(test)]
mod exporters;
mod gltf1;
#[cfg(feature = "http")]
mod http;
mod implicit;
mod json;
pub(super) mod mend;
mod mesh;
mod old_ways;
mod refusal;
mod store;
mod subtree;
#[cfg(test)]
mod tests;
mod textures;
mod tree;
mod volume;

/// How a tile goes with its children.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refine {
    /// They are drawn too.
    Add,
    /// They are drawn instead.
    Replace,
}

/// Which way is up in the glTF contents, as the asset says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpAxis {
    /// (x, y, z) becomes (−z, y, x).
    X,
    /// (x, y, z) becomes (x, −z, y); the default.
    Y,
    /// As it is.
    Z,
}

impl UpAxis {
    /// The rotation to z up.
    pub fn z_up(self) -> DMat4 {
        let columns = match self {
            Self::X => [DVec3::Z, DVec3::Y, DVec3::NEG_X],
            Self::Y => [DVec3::X, DVec3::Z, DVec3::NEG_Y],
            Self::Z => DVec3::AXES,
        };
        DMat4::from_mat3(glam::DMat3::from_cols(columns[0], columns[1], columns[2]))
    }
}

/// A tileset JSON: the one named, or one that another refers to.
#[derive(Debug, Clone)]
pub struct SourceFile {
    at: Address,
    /// Index of the file that refers to it.
    above: Option<u32>,
    depth: u32,
    up_axis: UpAxis,
    /// `asset.version`.
    pub version: Option<String>,
    /// `asset.generator`.
    pub generator: Option<String>,
    /// The tileset's own geometric error, as stated.
    pub geometric_error_m: Option<f64>,
    /// Size of the JSON.
    pub json_bytes: u64,
}

impl SourceFile {
    /// Where it is, from the folder or archive named; on servers the URL.
    pub fn path(&self) -> &str {
        &self.at.path
    }
}

/// What a tile shows: a file.
#[derive(Debug, Clone)]
pub struct Content {
    /// As written; of implicit tiles with the coordinates filled in.
    pub uri: Arc<str>,
    /// Its own bounding volume, in the root frame.
    pub volume: Option<Volume>,
    /// It is another tileset, whose root is a child of the tile; there is nothing to load.
    pub is_tileset: bool,
    at: Option<Address>,
}

/// A tile.
#[derive(Debug, Clone)]
pub struct Tile {
    /// Index into [`Tileset::tiles`]; less than the tile's own. `None`: the root.
    pub parent: Option<usize>,
    /// Indices into [`Tileset::tiles`], rising.
    pub children: Vec<usize>,
    /// Tiles above it, roots of external tilesets among them.
    pub depth: u32,
    /// Index into [`Tileset::files`].
    pub file: u32,
    /// Which child it is of its parent.
    way: u32,
    /// `geometricError` as written; 0 if it is missing.
    pub stated_error: f64,
    /// The same, scaled as the tile's transform scales, metres.
    pub geometric_error_m: f64,
    /// Inherited where it is not stated.
    pub refine: Refine,
    /// In the root frame; `None` if it is missing, broken, or an S2 cell.
    pub volume: Option<Volume>,
    /// In the order of the file.
    pub contents: Vec<Content>,
    /// `metadata` as written.
    pub metadata: Option<Value>,
    /// From the tile's to the root frame, over all ancestors.
    pub transform: DMat4,
    /// Level, x, y and z of a tile that a subtree lists.
    pub implicit: Option<[u32; 4]>,
}

impl Tile {
    /// Which child it is of its parent, as written.
    pub fn way(&self) -> usize {
        self.way as usize
    }

    /// True if it has something to load.
    pub fn has_mesh(&self) -> bool {
        self.contents.iter().any(|content| !content.is_tileset)
    }
}

/// The frame that tiles are loaded in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalFrame {
    /// The origin, if the tileset is on the globe: then the frame is metres east, north and up of it, and the root frame
    /// is ECEF. Else the two are the same.
    pub origin: Option<Geodetic>,
    /// From the frame to the root frame.
    pub root_from_local: DMat4,
    /// From the root frame to the frame.
    pub local_from_root: DMat4,
}

/// A tileset: all its tiles, none of them loaded. May be shared by threads.
pub struct Tileset {
    /// Parents before their children; the root is first.
    pub tiles: Vec<Tile>,
    /// The tileset JSONs; the one named is first.
    pub files: Vec<SourceFile>,
    /// Where tiles are loaded to.
    pub frame: LocalFrame,
    /// What was odd about the tree, counted by code.
    pub warnings: Vec<Warning>,
    /// Contents that are larger as stored are refused, where that is known before they are fetched.
    pub most_content_bytes: u64,
    stores: Stores,
}

/// Opens the tileset that `named` means: a folder, a tileset.json, a `.3tz`, or a URL.
///
/// # Errors
/// [`Error::Io`], [`Error::Input`] if there is no tileset, [`Error::Unsupported`] for URLs without the feature `http`,
/// [`Error::Cancelled`].
pub fn open(named: &Path) -> Result<Tileset> {
    let reporter = Reporter::new(true);
    let (mut stores, start) = Stores::open(named)?;
    let (tiles, files) = tree::Walker::walk(&mut stores, &start, &reporter)?;
    if tiles.is_empty() {
        return Err(Error::input(named, "has no tiles"));
    }
    let frame = LocalFrame::of(&tiles);
    Ok(Tileset { tiles, files, frame, warnings: reporter.warnings(), most_content_bytes: u64::MAX, stores })
}

impl Tileset {
    /// Triangles of tile `tile` in the local frame, a mesh per glTF; none for tiles without content.
    ///
    /// # Errors
    /// Why the first content that cannot be read is refused; see [`Self::load_content`] for one by one.
    pub fn load(&self, tile: usize, reporter: &Reporter) -> Result<Vec<TileMesh>, Refusal> {
        let mut meshes = Vec::new();
        for content in 0..self.tiles.get(tile).map_or(0, |t| t.contents.len()) {
            meshes.extend(self.load_content(tile, content, reporter)?);
        }
        Ok(meshes)
    }

    /// Triangles of content `content` of tile `tile`; none if it is a tileset.
    ///
    /// What is odd but read goes to `reporter`, under the content's URI.
    ///
    /// # Errors
    /// Why it is refused.
    pub fn load_content(&self, tile: usize, content: usize, reporter: &Reporter) -> Result<Vec<TileMesh>, Refusal> {
        let Some((tile, found)) = self.tiles.get(tile).and_then(|t| Some((t, t.contents.get(content)?))) else {
            return Err(Refusal::new("missing", "there is no such content"));
        };
        if found.is_tileset {
            return Ok(Vec::new());
        }
        let Some(at) = &found.at else { return Err(Refusal::new("bad-uri", "its URI leads out of the tileset")) };
        let bytes = self.stores.size(at).unwrap_or(0);
        if bytes > self.most_content_bytes {
            let (mb, most_mb) = (bytes / 1_000_000, self.most_content_bytes / 1_000_000);
            let what = format!("has {mb} MB, and {most_mb} MB fit into --memory");
            return Err(Refusal::new("too-large-for-memory", what));
        }
        let fetched = self.stores.fetch(at)?;
        let job = mesh::Job {
            stores: &self.stores,
            at,
            local_from_tile: self.frame.local_from_root * tile.transform,
            z_up: self.files[tile.file as usize].up_axis.z_up(),
            reporter,
        };
        let mut meshes = content::load(&fetched.bytes, &job)?;
        if let Some(first) = meshes.first_mut() {
            first.bytes = fetched.stored_bytes;
        }
        Ok(meshes)
    }

    /// Bytes of a tile's contents as stored, as far as that is known without fetching them.
    pub fn stored_bytes(&self, tile: usize) -> u64 {
        let contents = self.tiles.get(tile).into_iter().flat_map(|tile| &tile.contents);
        contents.filter_map(|content| self.stores.size(content.at.as_ref()?)).sum()
    }

    /// For people: the files and the way from the root to a tile, such as `tileset.json › 0/3 › a.b3dm`.
    pub fn trail(&self, tile: usize) -> String {
        trail(&self.tiles, &self.files, tile)
    }

    /// Tiles on the way from the root to `tile` that show something of their own: the level of detail it belongs to.
    pub fn level(&self, tile: usize) -> u32 {
        let parent = self.tiles.get(tile).and_then(|t| t.parent);
        let above = std::iter::successors(parent, |&t| self.tiles[t].parent);
        above.filter(|&t| self.tiles[t].has_mesh()).count() as u32
    }
}

/// See [`Tileset::trail`].
fn trail(tiles: &[Tile], files: &[SourceFile], tile: usize) -> String {
    let Some(of) = tiles.get(tile) else { return String::new() };
    let path = files.get(of.file as usize).map_or("", |file| file.path());
    let mut way = Vec::new();
    let mut at = of;
    while let Some(parent) = at.parent.and_then(|p| tiles.get(p)).filter(|parent| parent.file == at.file) {
        way.push(at.way.to_string());
        at = parent;
    }
    way.push("root".into());
    way.reverse();
    let mut text = format!("{path} › {}", way.join("/"));
    if let Some([level, x, y, z]) = of.implicit {
        text.push_str(&format!(" ({level}/{x}/{y}/{z})"));
    }
    if let Some(content) = of.contents.first() {
        text.push_str(" › ");
        text.push_str(&content.uri);
    }
    text
}

impl LocalFrame {
    /// A centre this far above or below the ellipsoid is still on the globe, metres.
    const MAX_HEIGHT_M: f64 = 100_000.0;

    /// The frame about the first tile from the root whose centre is on the globe.
    fn of(tiles: &[Tile]) -> Self {
        /// Tiles looked at: the root of a tileset may be the whole globe, its descendants are not.
        const TRIES: usize = 1000;
        let on_globe = tiles.iter().take(TRIES).find_map(|tile| {
            let centre = tile.volume?.centre();
            let place = geodetic_from_ecef(centre);
            // Near the Earth's centre there is no place; tilesets in their own coordinates are there.
            let is_on = centre.length() > A_M / 2.0 && place.height_m.abs() < Self::MAX_HEIGHT_M;
            is_on.then_some(place)
        });
        let root_from_local = on_globe.map_or(DMat4::IDENTITY, ecef_from_enu);
        Self { origin: on_globe, root_from_local, local_from_root: root_from_local.inverse() }
    }
}
