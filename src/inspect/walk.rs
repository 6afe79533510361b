//! Reads a tileset.json and lists its tiles, parents first.

use std::path::{Path, PathBuf};

use glam::{DMat4, DVec3};

use crate::schema::tileset::{BoundingVolume, Content, Tile, Tileset};
use crate::{Error, Result};

/// A tileset.json and the folder its URIs are relative to.
pub(super) struct Opened {
    pub path: PathBuf,
    pub folder: PathBuf,
    pub json_bytes: u64,
    pub tileset: Tileset,
}

/// Opens a tileset by its folder or by its tileset.json.
pub(super) fn open(path: &Path) -> Result<Opened> {
    let path = if path.is_dir() { path.join("tileset.json") } else { path.to_path_buf() };
    let bytes = std::fs::read(&path).map_err(Error::io("read", &path))?;
    let tileset = serde_json::from_slice(&bytes)
        .map_err(|e| Error::input(&path, format!("is no tileset: {e}; name a folder with a tileset.json")))?;
    let folder = path.parent().unwrap_or(Path::new(".")).to_path_buf();
    Ok(Opened { path, folder, json_bytes: bytes.len() as u64, tileset })
}

/// A tile with its place in the tree.
pub(super) struct Placed<'a> {
    pub tile: &'a Tile,
    /// Index into the list; `None` for the root.
    pub parent: Option<usize>,
    pub depth: usize,
    /// Adds to its parent instead of replacing it; inherited.
    pub adds: bool,
    /// For messages: the content's URI, or the way from the root.
    pub name: String,
}

/// All tiles, parents before their children.
pub(super) fn tiles(tileset: &Tileset) -> Vec<Placed<'_>> {
    let mut list: Vec<Placed<'_>> = Vec::new();
    let mut stack = vec![(&tileset.root, None::<usize>, "root".to_string())];
    while let Some((tile, parent, way)) = stack.pop() {
        let (depth, inherited) = parent.map_or((0, false), |p| (list[p].depth + 1, list[p].adds));
        let adds = tile.refine.as_deref().map_or(inherited, |r| r.eq_ignore_ascii_case("ADD"));
        let name = contents(tile).next().map_or_else(|| way.clone(), |c| c.uri.clone());
        let children = tile.children.iter().enumerate().rev();
        stack.extend(children.map(|(i, child)| (child, Some(list.len()), format!("{way}/{i}"))));
        list.push(Placed { tile, parent, depth, adds, name });
    }
    list
}

/// The contents of a tile, of either spelling.
pub(super) fn contents(tile: &Tile) -> impl Iterator<Item = &Content> {
    tile.content.iter().chain(&tile.contents)
}

/// From the tile's to its parent's frame.
pub(super) fn transform(tile: &Tile) -> DMat4 {
    tile.transform.as_ref().map_or(DMat4::IDENTITY, DMat4::from_cols_array)
}

/// The file of a URI, if it is a plain relative path that stays inside `folder`.
pub(super) fn file(folder: &Path, uri: &str) -> Option<PathBuf> {
    let plain = uri.split(['?', '#']).next().unwrap_or_default();
    let path = PathBuf::from(percent_decoded(plain)?);
    let inside = path.components().all(|c| matches!(c, std::path::Component::Normal(_) | std::path::Component::CurDir));
    (inside && !plain.is_empty() && !plain.contains(':') && !plain.contains('\\')).then(|| folder.join(path))
}

fn percent_decoded(text: &str) -> Option<String> {
    let mut bytes = text.bytes();
    let mut out = Vec::new();
    while let Some(b) = bytes.next() {
        if b != b'%' {
            out.push(b);
            continue;
        }
        let mut digit = || (bytes.next()? as char).to_digit(16);
        out.push((digit()? * 16 + digit()?) as u8);
    }
    String::from_utf8(out).ok()
}

/// An oriented box as a centre and half axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Oriented {
    pub centre: DVec3,
    pub half: [DVec3; 3],
}

impl Oriented {
    /// The box of a volume; `None` for regions and spheres.
    pub fn of(volume: &BoundingVolume) -> Option<Self> {
        let b = volume.oriented_box.as_ref()?;
        let at = |i: usize| DVec3::new(b[i], b[i + 1], b[i + 2]);
        Some(Self { centre: at(0), half: [at(3), at(6), at(9)] })
    }

    /// The eight corners.
    pub fn corners(&self) -> [DVec3; 8] {
        std::array::from_fn(|i| {
            let side = |bit: usize| if i & bit == 0 { -1.0 } else { 1.0 };
            self.centre + self.half[0] * side(1) + self.half[1] * side(2) + self.half[2] * side(4)
        })
    }

    /// How far `p` is outside, metres; 0 inside. The largest over the three axes.
    pub fn outside_m(&self, p: DVec3) -> f64 {
        let along = |axis: &DVec3| {
            let length = axis.length();
            let direction = if length > 0.0 { *axis / length } else { DVec3::ZERO };
            (p - self.centre).dot(direction).abs() - length
        };
        self.half.iter().map(along).fold(0.0, f64::max)
    }
}
