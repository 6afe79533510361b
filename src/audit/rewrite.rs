//! The same tiles with measured errors: anybody's tileset, made honest.
//!
//! In: an [`Audit`] of a folder. Out: a copy of it whose `geometricError`s are measured, and never grow downwards.
//!
//! # Limits
//! Folders with explicit tiles only: errors of implicit tiles follow from their root's. Tiles that were not measured
//! keep what they state.

use std::path::{Path, PathBuf};

use serde_json::Value;

use super::distance::TileDistance;
use super::{Audit, view};
use crate::{Error, Result};

/// Which measured number becomes the error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// The certified upper end: no point is further off.
    Strict,
    /// The 95th percentile: what one sees.
    P95,
    /// The certified upper end of buildings, the 95th percentile of the rest.
    Semantic,
}

impl Policy {
    /// The error of a tile, metres.
    pub fn error_m(self, of: &TileDistance, names: &[String]) -> Option<f64> {
        let strict = of.hausdorff.map(|h| h.upper_m);
        match self {
            Self::Strict => strict,
            Self::P95 => view::p95(of),
            Self::Semantic => {
                let by_class = &of.comparison.as_ref()?.by_class;
                if by_class.is_empty() {
                    return strict;
                }
                let error = |c: &crate::measure::ClassFigures| {
                    let name = names.get(c.class.index()).map_or("", String::as_str).to_lowercase();
                    let is_building = ["roof", "facade", "building", "wall"].iter().any(|part| name.contains(part));
                    match is_building {
                        true => c.figures.hausdorff.two_sided.map(|h| h.upper_m),
                        false => c.figures.two_sided.as_ref().map(|s| s.p95_m),
                    }
                };
                Some(by_class.iter().filter_map(error).fold(0.0, f64::max))
            }
        }
    }
}

/// Files and bytes of a tileset that are copied at most: a wrong folder must not fill a disk.
const MOST_FILES: usize = 2_000_000;

/// Writes the tileset of `named` to the new folder `out`; says what error each tile was given, metres.
///
/// # Errors
/// [`Error::Unsupported`] for archives, servers and implicit tiles; [`Error::Output`] if `out` exists or lies inside the
/// tileset; [`Error::Io`].
pub fn rewrite(audit: &Audit, named: &Path, out: &Path, policy: Policy) -> Result<Vec<f64>> {
    let folder = folder(audit, named)?;
    let whole = |p: &Path| std::path::absolute(p).unwrap_or_else(|_| p.to_path_buf());
    let real = folder.canonicalize().map_err(Error::io("read", &folder))?;
    let parent = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let into = parent.canonicalize().unwrap_or_else(|_| whole(parent));
    if out.exists() || into.starts_with(&real) {
        let what = "exists, or lies inside the tileset; name a new folder beside it";
        return Err(Error::Output { path: out.into(), what: what.into() });
    }
    let error_m = view::measured(&audit.tileset, &audit.distances, |d| policy.error_m(d, &audit.classes));
    copy(&folder, out)?;
    for file in 0..audit.tileset.files.len() {
        write(audit, file, &error_m, out)?;
    }
    Ok(error_m)
}

fn folder(audit: &Audit, named: &Path) -> Result<PathBuf> {
    if audit.tileset.tiles.iter().any(|tile| tile.implicit.is_some()) {
        return Err(Error::Unsupported {
            path: named.into(),
            what: "errors of implicit tiles follow from their root's; explicit tiles only can be rewritten".into(),
        });
    }
    let folder =
        if named.is_dir() { named.to_path_buf() } else { named.parent().unwrap_or(Path::new(".")).to_path_buf() };
    let folder = if folder.as_os_str().is_empty() { PathBuf::from(".") } else { folder };
    let is_there = audit.tileset.files.iter().all(|file| folder.join(file.path()).is_file());
    if is_there {
        return Ok(folder);
    }
    Err(Error::Unsupported {
        path: named.into(),
        what: "is no folder of files; unpack it first to rewrite its errors".into(),
    })
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    let mut open = vec![(from.to_path_buf(), to.to_path_buf())];
    let mut files = 0;
    while let Some((from, to)) = open.pop() {
        std::fs::create_dir_all(&to).map_err(Error::io("create", &to))?;
        for entry in std::fs::read_dir(&from).map_err(Error::io("read", &from))? {
            let entry = entry.map_err(Error::io("read", &from))?;
            let (path, into) = (entry.path(), to.join(entry.file_name()));
            let kind = entry.file_type().map_err(Error::io("read", &path))?;
            files += 1;
            if files > MOST_FILES {
                let what = format!("has more than {MOST_FILES} files; is it a tileset's folder?");
                return Err(Error::Limit { path: from, what });
            }
            // Links may lead anywhere.
            if kind.is_dir() {
                open.push((path, into));
            } else if kind.is_file() {
                std::fs::copy(&path, &into).map_err(Error::io("create", &into))?;
            }
        }
    }
    Ok(())
}

/// Replaces the errors in one tileset JSON.
fn write(audit: &Audit, file: usize, error_m: &[f64], out: &Path) -> Result<()> {
    let tiles = &audit.tileset.tiles;
    let path = out.join(audit.tileset.files[file].path());
    let text = std::fs::read(&path).map_err(Error::io("read", &path))?;
    let (mut json, _): (Value, bool) =
        super::read::mend::read(&text).map_err(|e| Error::input(&path, format!("is no JSON: {e}")))?;
    let is_root = |tile: usize| {
        let above = tiles[tile].parent.map(|parent| tiles[parent].file);
        tiles[tile].file as usize == file && above.is_none_or(|above| above as usize != file)
    };
    let Some(root) = (0..tiles.len()).find(|&tile| is_root(tile)) else { return Ok(()) };
    let mut open = vec![(root, vec![])];
    while let Some((tile, way)) = open.pop() {
        let Some(node) = at(&mut json["root"], &way) else { continue };
        let of = &tiles[tile];
        // As written: before the tile's transform scales it.
        let scale = if of.stated_error > 0.0 { of.geometric_error_m / of.stated_error } else { 1.0 };
        node["geometricError"] = serde_json::json!(error_m[tile] / scale);
        for &child in of.children.iter().filter(|&&child| tiles[child].file == of.file) {
            let mut way: Vec<usize> = way.clone();
            way.push(tiles[child].way());
            open.push((child, way));
        }
    }
    let root_error = json["root"]["geometricError"].as_f64().unwrap_or(0.0);
    // What is wrong if nothing is drawn is no tile's to say, but never less than the root's.
    if json["geometricError"].as_f64().is_none_or(|stated| stated < root_error) {
        json["geometricError"] = serde_json::json!(root_error);
    }
    let bytes = serde_json::to_vec(&json).map_err(|e| Error::Bug(format!("tileset: {e}")))?;
    std::fs::write(&path, bytes).map_err(Error::io("write", &path))
}

fn at<'a>(root: &'a mut Value, way: &[usize]) -> Option<&'a mut Value> {
    way.iter().try_fold(root, |node, &child| node.get_mut("children")?.get_mut(child))
}
