//! Turns a reference found in a file into a path that may be opened.

use std::path::{Path, PathBuf};

use crate::{Error, Result};

/// The path `reference` names, seen from folder `base`, if it stays below `root`.
///
/// # Errors
/// [`Error::Input`] for URLs, for anything but a regular file and, unless `allow_outside`, for a path that leaves `root`
/// by being absolute, by `..`, or through a symbolic link; [`Error::Io`] (`NotFound`) if there is no such file.
pub(in crate::input) fn resolve(root: &Path, base: &Path, reference: &str, allow_outside: bool) -> Result<PathBuf> {
    let refuse = |why: &str| Err(Error::input(reference, why));
    let outside = "leaves the input's folder; move the file there, or pass --allow-outside";
    let slashed = reference.replace('\\', "/");
    if slashed.is_empty() || slashed.contains('\0') {
        return refuse("is not a file name");
    }
    let head = slashed.split('/').next().unwrap_or_default();
    match head.split_once(':') {
        Some((drive, _)) if drive.len() == 1 && !allow_outside => return refuse(outside),
        Some((scheme, _)) if scheme.len() > 1 => return refuse("is a URL; only local files are read"),
        _ => {}
    }
    if !allow_outside && (slashed.starts_with('/') || climbs(base, root, &slashed)) {
        return refuse(outside);
    }
    let joined = base.join(&slashed);
    let found = std::fs::canonicalize(&joined).map_err(Error::io("read", &joined))?;
    if !allow_outside {
        let root = std::fs::canonicalize(root).map_err(Error::io("read", root))?;
        if !found.starts_with(root) {
            return refuse(outside);
        }
    }
    if !found.is_file() {
        return refuse("is not a regular file");
    }
    Ok(found)
}

/// True if the `..` in `reference` lead above `root`, by the letters alone: the folders need not exist.
fn climbs(base: &Path, root: &Path, reference: &str) -> bool {
    let mut depth = base.strip_prefix(root).map_or(0, |below| below.components().count()) as i64;
    reference.split('/').any(|part| {
        depth += match part {
            "" | "." => 0,
            ".." => -1,
            _ => 1,
        };
        depth < 0
    })
}
