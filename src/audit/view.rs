//! What a viewer loads: the selection at a screen-space error of 16 pixels, from places in the air.
//!
//! In: the tree, an error for each tile, the figures of tiles. Out: a [`Load`] for each place.
//!
//! # Method
//! As CesiumJS without culling: a tile is refined while `error × height_px / (2 × distance × tan(fovy / 2))` is above
//! the limit; the distance is to its bounding volume. REPLACE draws the children instead, ADD draws them too. A tile that is another tileset is always entered.
//!
//! # Limits
//! No frustum, no fog, no preloading: an upper bound of what is drawn, which is fair between errors compared.

use std::path::Path;

use glam::DVec3;
use serde::Serialize;

use super::distance::{TileDistance, Verdict};
use super::read::{Refine, Tileset};
use super::structure::{SSE_PX, TileFigures};
use crate::geo::Geodetic;
use crate::geo::ellipsoid::ecef_from_geodetic;
use crate::{Error, Result};

/// Picture height, pixels.
pub const HEIGHT_PX: f64 = 1080.0;
/// Opening over the picture's height, degrees.
pub const FOVY_DEG: f64 = 36.0;
/// Heights over the middle of the dataset, metres.
pub const HEIGHTS_M: [f64; 4] = [20.0, 120.0, 400.0, 1000.0];
/// A route is looked at this often, metres.
pub const ROUTE_STEP_M: f64 = 25.0;
/// Places on a route at most; longer steps from there on.
const MOST_PLACES: usize = 2000;

/// What is drawn from a place.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Load {
    /// Tiles drawn.
    pub tiles: u64,
    /// Their triangles.
    pub triangles: u64,
    /// Their size as stored: what is fetched, without the tiles above them.
    pub bytes: u64,
    /// Their draw calls.
    pub draw_calls: u64,
    /// Vertices, indices and decoded textures with mipmaps of the tiles drawn and those above them, which viewers keep.
    pub memory_bytes: u64,
}

/// Position, normal and texture coordinate of a vertex as floats.
const BYTES_PER_VERTEX: u64 = 32;
/// Three indices.
const BYTES_PER_TRIANGLE: u64 = 12;

/// What is drawn from `eye` (local frame) if tile t has the error `error_m[t]`.
pub fn load(tileset: &Tileset, figures: &[TileFigures], error_m: &[f64], eye: DVec3) -> Load {
    let root_eye = tileset.frame.root_from_local.transform_point3(eye);
    let px_per_rad = HEIGHT_PX / (2.0 * (FOVY_DEG.to_radians() / 2.0).tan());
    let mut load = Load::default();
    let mut open = vec![0];
    while let Some(id) = open.pop() {
        let tile = &tileset.tiles[id];
        let distance_m = tile.volume.map_or(0.0, |v| v.outside_m(root_eye));
        let error_px = error_m.get(id).copied().unwrap_or(0.0) * px_per_rad / distance_m.max(1e-9);
        let is_refined = !tile.children.is_empty() && (error_px > SSE_PX || tile.contents.iter().any(|c| c.is_tileset));
        if tile.has_mesh() {
            let own = figures.get(id).cloned().unwrap_or_default();
            load.memory_bytes +=
                own.vertices * BYTES_PER_VERTEX + own.triangles * BYTES_PER_TRIANGLE + own.texture_rgba_bytes * 4 / 3;
            if !is_refined || tile.refine == Refine::Add {
                load.tiles += 1;
                load.triangles += own.triangles;
                load.bytes += own.bytes;
                load.draw_calls += own.draw_calls;
            }
        }
        if is_refined {
            open.extend(&tile.children);
        }
    }
    load
}

/// The errors as stated, metres.
pub fn stated(tileset: &Tileset) -> Vec<f64> {
    tileset.tiles.iter().map(|tile| tile.geometric_error_m).collect()
}

/// The 95th percentile of a tile's distances, both ways, metres; of an incomplete reference from it only.
pub fn p95(of: &TileDistance) -> Option<f64> {
    let all = &of.comparison.as_ref()?.all;
    let distances = if of.is_incomplete { &all.reference_to_simplified } else { &all.two_sided };
    distances.as_ref().map(|s| s.p95_m)
}

/// For each tile what `of` says of it, never less than below it; the stated error where it says nothing.
pub fn measured(tileset: &Tileset, distances: &[TileDistance], of: impl Fn(&TileDistance) -> Option<f64>) -> Vec<f64> {
    let mut error_m: Vec<Option<f64>> = vec![None; tileset.tiles.len()];
    for one in distances {
        let finest = (one.verdict == Verdict::Finest).then_some(0.0);
        error_m[one.tile] = finest.or_else(|| of(one).filter(|_| !one.is_incomplete));
    }
    let stated = |t: usize| tileset.tiles[t].geometric_error_m;
    let mut error_m: Vec<f64> = (0..error_m.len()).map(|t| error_m[t].unwrap_or_else(|| stated(t))).collect();
    // Parents come first.
    for t in (0..error_m.len()).rev() {
        if let Some(parent) = tileset.tiles[t].parent {
            error_m[parent] = error_m[parent].max(error_m[t]);
        }
    }
    error_m
}

/// What a flight along a route loads.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct RouteLoad {
    /// Places looked from.
    pub places: usize,
    /// Length, metres.
    pub length_m: f64,
    /// The most at any place, each for itself.
    pub most: Load,
    /// Mean over the places.
    pub mean_triangles: f64,
    /// Mean over the places.
    pub mean_tiles: f64,
}

/// Flies along `route`, points of the local frame.
pub fn fly(tileset: &Tileset, figures: &[TileFigures], error_m: &[f64], route: &[DVec3]) -> RouteLoad {
    let places = places(route);
    let loads: Vec<Load> = places.iter().map(|&eye| load(tileset, figures, error_m, eye)).collect();
    let most = |of: fn(&Load) -> u64| loads.iter().map(of).max().unwrap_or(0);
    let mean = |of: fn(&Load) -> u64| loads.iter().map(of).sum::<u64>() as f64 / loads.len().max(1) as f64;
    RouteLoad {
        places: loads.len(),
        length_m: route.windows(2).map(|w| w[0].distance(w[1])).sum(),
        most: Load {
            tiles: most(|l| l.tiles),
            triangles: most(|l| l.triangles),
            bytes: most(|l| l.bytes),
            draw_calls: most(|l| l.draw_calls),
            memory_bytes: most(|l| l.memory_bytes),
        },
        mean_triangles: mean(|l| l.triangles),
        mean_tiles: mean(|l| l.tiles),
    }
}

fn places(route: &[DVec3]) -> Vec<DVec3> {
    let length: f64 = route.windows(2).map(|w| w[0].distance(w[1])).sum();
    let step = ROUTE_STEP_M.max(length / MOST_PLACES as f64);
    let mut found: Vec<DVec3> = route.first().copied().into_iter().collect();
    for leg in route.windows(2) {
        let count = (leg[0].distance(leg[1]) / step).ceil().max(1.0) as usize;
        found.extend((1..=count).map(|i| leg[0].lerp(leg[1], i as f64 / count as f64)));
    }
    found
}

/// Reads the first LineString of a GeoJSON file into the local frame; heights are above the ellipsoid, and of points
/// without one 120 m above the frame's origin. In tilesets without a place on the Earth coordinates are local metres.
///
/// # Errors
/// A file that cannot be read, is no GeoJSON, or has no LineString of two points.
pub fn read_route(path: &Path, tileset: &Tileset) -> Result<Vec<DVec3>> {
    let text = std::fs::read(path).map_err(Error::io("read", path))?;
    let json: serde_json::Value =
        serde_json::from_slice(&text).map_err(|e| Error::input(path, format!("is no GeoJSON: {e}")))?;
    let line = line_string(&json, 0).ok_or_else(|| Error::input(path, "has no LineString with two points or more"))?;
    let origin = tileset.frame.origin;
    let low_m = origin.map_or(0.0, |o| o.height_m);
    let local = |p: &[f64; 3]| match origin {
        None => DVec3::from_array(*p).with_z(if p[2].is_nan() { HEIGHTS_M[1] } else { p[2] }),
        Some(_) => {
            let height_m = if p[2].is_nan() { low_m + HEIGHTS_M[1] } else { p[2] };
            let ecef = ecef_from_geodetic(Geodetic::from_degrees(p[0], p[1], height_m));
            tileset.frame.local_from_root.transform_point3(ecef)
        }
    };
    let points: Vec<DVec3> = line.iter().map(local).collect();
    if points.iter().any(|p| !p.is_finite()) {
        return Err(Error::input(path, "has a coordinate that is not finite"));
    }
    Ok(points)
}

/// x, y and z of each point; NaN where there is no z.
fn line_string(json: &serde_json::Value, depth: u32) -> Option<Vec<[f64; 3]>> {
    /// GeoJSON nests a feature in a collection, and a geometry in it.
    const MOST_DEPTH: u32 = 4;
    if depth > MOST_DEPTH {
        return None;
    }
    if json["type"] == "LineString" {
        let points = json["coordinates"].as_array()?.iter().map(|p| {
            let at = |i: usize| p.get(i).and_then(serde_json::Value::as_f64);
            Some([at(0)?, at(1)?, at(2).unwrap_or(f64::NAN)])
        });
        return points.collect::<Option<Vec<_>>>().filter(|points| points.len() >= 2);
    }
    let inner = [&json["geometry"]].into_iter().filter(|v| v.is_object());
    let lists = ["features", "geometries"].into_iter().filter_map(|key| json[key].as_array()).flatten();
    inner.chain(lists).find_map(|v| line_string(v, depth + 1))
}
