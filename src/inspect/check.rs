//! Checks a published tileset, from its files only.
//!
//! # Method
//! 1. The tree: errors fall, boxes hold their children, refinement and metadata make sense.
//! 2. Every content: it exists inside the folder, is a sound GLB, lies in its tile's box; its textures decode.
//!
//! # Numbers
//! [`TOLERANCE_M`] for boxes, plus the rounding step of quantised positions.
//!
//! # Limits
//! Boxes only: regions and spheres are passed over. Contents other than GLB, and external or implicit tilesets, are
//! reported as `not-checked`.

use std::fmt;
use std::io::Cursor;
use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;

use super::glb::{self, Broken, Glb};
use super::walk::{self, Oriented, Placed};
use crate::Result;
use crate::schema::metadata::{Entity, Schema};
use crate::schema::tileset::Tileset;

/// How bad a [`Finding`] is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// A viewer may draw something wrong or nothing.
    Error,
    /// Odd, or could not be checked.
    Warning,
}

/// One thing that is wrong with a tileset.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// Stable name, for instance `missing-file`.
    pub code: &'static str,
    /// URI of the content, or the way to the tile.
    pub place: String,
    /// Value found, value wanted.
    pub what: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let severity = if self.severity == Severity::Error { "error" } else { "warning" };
        write!(f, "{severity} {} {}: {}", self.code, self.place, self.what)
    }
}

/// Content may pass its box, and a box its parent's, by this much, metres: f32 at 8 km from the tile's origin.
const TOLERANCE_M: f64 = 1e-3;

/// Largest side of a texture, pixels: what current graphics hardware takes.
const MAX_TEXTURE_PX: u32 = 16_384;

/// Checks the tileset at `path` (a folder or a tileset.json); finds nothing in a sound one.
///
/// # Errors
/// If tileset.json cannot be read or is none: then there is nothing to check.
pub fn check(path: &Path) -> Result<Vec<Finding>> {
    let opened = walk::open(path)?;
    let tiles = walk::tiles(&opened.tileset);
    let mut findings = Findings::default();
    about(&opened.tileset, &mut findings);
    for placed in &tiles {
        tree(&opened.tileset, &tiles, placed, &mut findings);
    }
    let of_contents: Vec<Findings> = tiles.par_iter().map(|placed| contents(&opened.folder, placed)).collect();
    Ok(findings.0.into_iter().chain(of_contents.into_iter().flat_map(|f| f.0)).collect())
}

#[derive(Default)]
struct Findings(Vec<Finding>);

impl Findings {
    fn error(&mut self, code: &'static str, place: &str, what: String) {
        self.0.push(Finding { severity: Severity::Error, code, place: place.into(), what });
    }

    fn warning(&mut self, code: &'static str, place: &str, what: String) {
        self.0.push(Finding { severity: Severity::Warning, code, place: place.into(), what });
    }

    fn broken(&mut self, place: &str, broken: Broken) {
        match broken.code {
            "unsupported" => self.warning("not-checked", place, broken.what),
            code => self.error(code, place, broken.what),
        }
    }
}

fn about(tileset: &Tileset, findings: &mut Findings) {
    let version = &tileset.asset.version;
    if !["1.0", "1.1"].contains(&version.as_str()) {
        findings.error("version", "tileset.json", format!("asset.version is {version:?}, 1.0 or 1.1 is known"));
    }
    match tileset.root.refine.as_deref() {
        Some("REPLACE" | "ADD") => {}
        other => findings.error("refine", "root", format!("refine of the root is {other:?}, REPLACE or ADD is wanted")),
    }
    let (whole, root) = (tileset.geometric_error, tileset.root.geometric_error);
    if root > whole {
        findings.error("error-order", "root", format!("geometricError {root} m is above the tileset's {whole} m"));
    }
    if let Some(entity) = &tileset.metadata {
        metadata(tileset.schema.as_ref(), entity, "tileset.json", findings);
    }
}

/// What the JSON says about a tile.
fn tree(tileset: &Tileset, tiles: &[Placed<'_>], placed: &Placed<'_>, findings: &mut Findings) {
    let (tile, place) = (placed.tile, placed.name.as_str());
    let error_m = tile.geometric_error;
    if error_m < 0.0 {
        findings.error("error-order", place, format!("geometricError {error_m} m is negative"));
    }
    let volume = &tile.bounding_volume;
    if volume.oriented_box.is_none() && volume.region.is_none() && volume.sphere.is_none() {
        findings.error("no-volume", place, "has no bounding volume".into());
    }
    if tile.implicit_tiling.is_some() {
        findings.warning("not-checked", place, "implicit tiling is not followed".into());
    }
    if let Some(entity) = &tile.metadata {
        metadata(tileset.schema.as_ref(), entity, place, findings);
    }
    let number = walk::contents(tile).count();
    if number > 1 {
        findings.warning("several-contents", place, format!("has {number} contents; not every viewer draws them"));
    }
    if number == 0 && tile.children.is_empty() && tile.implicit_tiling.is_none() {
        findings.warning("empty-tile", place, "has neither content nor children".into());
    }
    if number == 0 && !tile.children.is_empty() && !placed.adds {
        // A viewer never refines a tile without error: its children would never be seen.
        if error_m == 0.0 {
            findings.error("empty-tile", place, "replaces its children with nothing, at a geometricError of 0".into());
        } else {
            findings.warning("empty-tile", place, "has no content to show before its children have come".into());
        }
    }
    if let Some(parent) = placed.parent {
        against_parent(&tiles[parent], placed, findings);
    }
}

fn against_parent(parent: &Placed<'_>, placed: &Placed<'_>, findings: &mut Findings) {
    let (tile, place) = (placed.tile, placed.name.as_str());
    let parent_from_tile = walk::transform(tile);
    let axes = [parent_from_tile.x_axis, parent_from_tile.y_axis, parent_from_tile.z_axis];
    let scale =
        if tile.transform.is_some() { axes.iter().fold(0.0, |s: f64, a| s.max(a.truncate().length())) } else { 1.0 };
    let (error_m, above_m) = (tile.geometric_error * scale, parent.tile.geometric_error);
    if error_m > above_m {
        let what = format!("geometricError {error_m} m is above the {above_m} m of its parent {}", parent.name);
        findings.error("error-order", place, what);
    }
    let boxes = (Oriented::of(&parent.tile.bounding_volume), Oriented::of(&tile.bounding_volume));
    let (Some(outer), Some(inner)) = boxes else { return };
    let corners = inner.corners().map(|c| parent_from_tile.transform_point3(c));
    let out_m = corners.iter().map(|&c| outer.outside_m(c)).fold(0.0, f64::max);
    if out_m > TOLERANCE_M {
        let what = format!("its box leaves the box of its parent {} by {out_m:.4} m", parent.name);
        findings.error("box-outside", place, what);
    }
}

fn metadata(schema: Option<&Schema>, entity: &Entity, place: &str, findings: &mut Findings) {
    let Some(class) = schema.and_then(|s| s.classes.get(&entity.class)) else {
        findings.error("metadata", place, format!("the schema has no class {:?}", entity.class));
        return;
    };
    for id in entity.properties.keys().filter(|id| !class.properties.contains_key(*id)) {
        findings.error("metadata", place, format!("class {:?} has no property {id:?}", entity.class));
    }
    for (id, _) in class.properties.iter().filter(|(id, p)| p.required && !entity.properties.contains_key(*id)) {
        findings.error("metadata", place, format!("the required property {id:?} is missing"));
    }
}

/// What the files of a tile say.
fn contents(folder: &Path, placed: &Placed<'_>) -> Findings {
    let mut findings = Findings::default();
    for content in walk::contents(placed.tile) {
        let place = content.uri.as_str();
        let Some(file) = walk::file(folder, place) else {
            findings.error("outside", place, "is no plain path inside the tileset's folder".into());
            continue;
        };
        if !file.is_file() {
            findings.error("missing-file", place, "does not exist".into());
            continue;
        }
        if file.extension().is_none_or(|e| !e.eq_ignore_ascii_case("glb")) {
            findings.warning("not-checked", place, "is no .glb".into());
            continue;
        }
        let bytes = match std::fs::read(&file) {
            Ok(bytes) => bytes,
            Err(error) => {
                findings.error("missing-file", place, format!("cannot be read: {error}"));
                continue;
            }
        };
        match glb::parse(&bytes) {
            Ok(glb) => geometry(&glb, placed, place, &mut findings),
            Err(broken) => findings.broken(place, broken),
        }
    }
    findings
}

fn geometry(glb: &Glb, placed: &Placed<'_>, place: &str, findings: &mut Findings) {
    textures(glb, place, findings);
    let lists = match glb.triangles() {
        Ok(lists) => lists,
        Err(broken) => return findings.broken(place, broken),
    };
    if lists.iter().all(|l| l.faces.is_empty()) {
        findings.warning("empty-tile", place, "draws no triangle".into());
    }
    let Some(volume) = Oriented::of(&placed.tile.bounding_volume) else { return };
    let (mut worst_m, mut worst) = (0.0, None);
    for list in &lists {
        for p in &list.positions {
            let out_m = volume.outside_m(*p) - list.step_m;
            if out_m > worst_m {
                (worst_m, worst) = (out_m, Some(*p));
            }
        }
    }
    if let Some(p) = worst.filter(|_| worst_m > TOLERANCE_M) {
        let what = format!("a vertex at {:.3}, {:.3}, {:.3} is {worst_m:.4} m outside the tile's box", p.x, p.y, p.z);
        findings.error("content-outside", place, what);
    }
}

fn textures(glb: &Glb, place: &str, findings: &mut Findings) {
    for (i, image) in glb.gltf.images.iter().enumerate() {
        let Some(view) = image.buffer_view else {
            findings.warning("not-checked", place, format!("image {i} is outside of the file"));
            continue;
        };
        let mime = image.mime_type.as_deref().unwrap_or_default();
        if !["image/jpeg", "image/png", "image/webp"].contains(&mime) {
            findings.warning("not-checked", place, format!("image {i} of type {mime:?}"));
            continue;
        }
        match glb.view(view) {
            Ok(bytes) => {
                if let Err(what) = decodes(bytes, mime) {
                    findings.error("texture", place, format!("image {i} {what}"));
                }
            }
            Err(broken) => findings.broken(place, broken),
        }
    }
}

fn decodes(bytes: &[u8], mime: &str) -> std::result::Result<(), String> {
    let mut reader = image::ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|e| format!("cannot be read: {e}"))?;
    let found = reader.format().map(|f| f.to_mime_type());
    if found != Some(mime) {
        return Err(format!("says {mime} and looks like {found:?}"));
    }
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_TEXTURE_PX);
    limits.max_image_height = Some(MAX_TEXTURE_PX);
    reader.limits(limits);
    reader.decode().map(drop).map_err(|e| format!("does not decode: {e}"))
}
