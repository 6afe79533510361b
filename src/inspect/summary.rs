//! Sums up a published tileset: levels, classes, size, place.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

use super::glb;
use super::walk::{self, Oriented, Placed};
use crate::Result;

/// What a tileset holds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TilesetSummary {
    /// The tileset.json.
    pub path: PathBuf,
    /// Version of 3D Tiles.
    pub version: String,
    /// Program that wrote it.
    pub generator: Option<String>,
    /// Credit to show.
    pub copyright: Option<String>,
    /// Number of tiles.
    pub tiles: u64,
    /// Bytes of tileset.json and all contents.
    pub bytes: u64,
    /// Error if nothing is drawn, metres.
    pub geometric_error_m: f64,
    /// Lowest corner of the root's box in its own frame, metres.
    pub min_m: Option<[f64; 3]>,
    /// Highest corner of the root's box in its own frame, metres.
    pub max_m: Option<[f64; 3]>,
    /// Place of the root's origin on the Earth.
    pub place: Option<Place>,
    /// By depth, the root first.
    pub levels: Vec<LevelSummary>,
    /// Shares of the classes in the leaves, by name.
    pub classes: Vec<ClassShare>,
    /// Contents that could not be read, with the reason.
    pub unread: Vec<String>,
}

/// A point on the Earth (WGS 84).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Place {
    /// East positive, degrees.
    pub longitude_deg: f64,
    /// North positive, degrees.
    pub latitude_deg: f64,
    /// Above the ellipsoid, metres.
    pub height_m: f64,
}

/// The tiles of one depth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LevelSummary {
    /// 0 is the root.
    pub depth: usize,
    /// Number of tiles.
    pub tiles: u64,
    /// Triangles of all of them, without skirts.
    pub triangles: u64,
    /// Triangles of skirts, which hide gaps and are no part of the surface.
    pub skirt_triangles: u64,
    /// Draw calls of all of them.
    pub draw_calls: u64,
    /// Bytes of all contents.
    pub bytes: u64,
    /// Smallest geometricError, metres.
    pub min_error_m: f64,
    /// Largest geometricError, metres.
    pub max_error_m: f64,
    /// Smallest texel stated, metres.
    pub min_texel_m: Option<f64>,
    /// Largest texel stated, metres.
    pub max_texel_m: Option<f64>,
}

/// How much of the leaves is of one class.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassShare {
    /// Name of the class.
    pub name: String,
    /// Triangles.
    pub triangles: u64,
    /// Of all leaf triangles, 0 to 1.
    pub triangle_share: f64,
    /// Surface, m².
    pub area_m2: f64,
    /// Of all leaf surface, 0 to 1.
    pub area_share: f64,
}

/// One tile's files.
#[derive(Default)]
struct Measured {
    triangles: u64,
    skirt_triangles: u64,
    draw_calls: u64,
    bytes: u64,
    /// Triangles and area by class name.
    classes: BTreeMap<String, (u64, f64)>,
    unread: Vec<String>,
}

/// Sums up the tileset at `path`, a folder or a tileset.json. Contents that cannot be read are named, not refused.
///
/// # Errors
/// If tileset.json cannot be read or is none.
pub fn tileset(path: &Path) -> Result<TilesetSummary> {
    let opened = walk::open(path)?;
    let tiles = walk::tiles(&opened.tileset);
    let measured: Vec<Measured> = tiles.par_iter().map(|placed| measure(&opened.folder, placed)).collect();
    let mut levels: Vec<LevelSummary> = Vec::new();
    let (mut classes, mut unread) = (BTreeMap::<String, (u64, f64)>::new(), Vec::new());
    let mut bytes = opened.json_bytes;
    for (placed, measured) in tiles.iter().zip(measured) {
        if levels.len() <= placed.depth {
            // Parents come first, so that depths come without gaps.
            levels.push(LevelSummary::new(placed.depth));
        }
        levels[placed.depth].add(placed, &measured);
        bytes += measured.bytes;
        for (name, (triangles, area_m2)) in measured.classes {
            let sum = classes.entry(name).or_default();
            *sum = (sum.0 + triangles, sum.1 + area_m2);
        }
        unread.extend(measured.unread);
    }
    let root = &opened.tileset.root;
    let corners = Oriented::of(&root.bounding_volume).map(|b| b.corners());
    let fold = |by: fn(DVec3, DVec3) -> DVec3| corners.map(|c| c.into_iter().reduce(by).unwrap_or_default().to_array());
    Ok(TilesetSummary {
        path: opened.path,
        version: opened.tileset.asset.version.clone(),
        generator: opened.tileset.asset.generator.clone(),
        copyright: opened.tileset.asset.copyright.clone(),
        tiles: tiles.len() as u64,
        bytes,
        geometric_error_m: opened.tileset.geometric_error,
        min_m: fold(DVec3::min),
        max_m: fold(DVec3::max),
        place: root.transform.and_then(|m| place(DVec3::new(m[12], m[13], m[14]))),
        levels,
        classes: shares(classes),
        unread,
    })
}

fn measure(folder: &Path, placed: &Placed<'_>) -> Measured {
    let mut measured = Measured::default();
    for content in walk::contents(placed.tile) {
        if let Err(why) = measure_content(folder, &content.uri, placed.tile.children.is_empty(), &mut measured) {
            measured.unread.push(format!("{}: {why}", content.uri));
        }
    }
    measured
}

fn measure_content(folder: &Path, uri: &str, leaf: bool, measured: &mut Measured) -> std::result::Result<(), String> {
    let file = walk::file(folder, uri).ok_or("is no plain path inside the tileset's folder")?;
    let bytes = std::fs::read(file).map_err(|e| format!("cannot be read: {e}"))?;
    measured.bytes += bytes.len() as u64;
    let lists = glb::parse(&bytes).and_then(|glb| glb.triangles()).map_err(|broken| broken.what)?;
    for list in lists {
        measured.draw_calls += 1;
        measured.triangles += list.faces.len() as u64;
        let Some(features) = list.features else { continue };
        for face in &list.faces {
            let id = list.feature_ids[face[0] as usize] as usize;
            if features.skirts.get(id) == Some(&true) {
                measured.triangles -= 1;
                measured.skirt_triangles += 1;
                continue;
            }
            if !leaf {
                continue;
            }
            let Some(name) = features.class_names.get(id) else { continue };
            let [a, b, c] = face.map(|v| list.positions[v as usize]);
            let area_m2 = (b - a).cross(c - a).length() * 0.5;
            let sum = measured.classes.entry(name.clone()).or_default();
            *sum = (sum.0 + 1, sum.1 + area_m2);
        }
    }
    Ok(())
}

fn shares(classes: BTreeMap<String, (u64, f64)>) -> Vec<ClassShare> {
    let (triangles, area_m2) = classes.values().fold((0, 0.0), |sum, c| (sum.0 + c.0, sum.1 + c.1));
    let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
    let one = |(name, (n, area)): (String, (u64, f64))| ClassShare {
        name,
        triangles: n,
        triangle_share: share(n as f64, triangles as f64),
        area_m2: area,
        area_share: share(area, area_m2),
    };
    classes.into_iter().map(one).collect()
}

impl LevelSummary {
    fn new(depth: usize) -> Self {
        Self {
            depth,
            tiles: 0,
            triangles: 0,
            skirt_triangles: 0,
            draw_calls: 0,
            bytes: 0,
            min_error_m: f64::INFINITY,
            max_error_m: 0.0,
            min_texel_m: None,
            max_texel_m: None,
        }
    }

    fn add(&mut self, placed: &Placed<'_>, measured: &Measured) {
        self.tiles += 1;
        self.triangles += measured.triangles;
        self.skirt_triangles += measured.skirt_triangles;
        self.draw_calls += measured.draw_calls;
        self.bytes += measured.bytes;
        self.min_error_m = self.min_error_m.min(placed.tile.geometric_error);
        self.max_error_m = self.max_error_m.max(placed.tile.geometric_error);
        let texel = placed.tile.metadata.as_ref().and_then(|m| m.properties.get("texelSize")?.as_f64());
        // 0 means: not textured.
        if let Some(texel) = texel.filter(|&t| t > 0.0) {
            self.min_texel_m = Some(self.min_texel_m.map_or(texel, |t| t.min(texel)));
            self.max_texel_m = Some(self.max_texel_m.map_or(texel, |t| t.max(texel)));
        }
    }
}

/// Place of a geocentric point; `None` far from the surface, where a local frame is no place.
fn place(ecef: DVec3) -> Option<Place> {
    // WGS 84: semi-major axis in metres, first eccentricity squared.
    const A_M: f64 = 6_378_137.0;
    const E2: f64 = 6.694_379_990_141_316e-3;
    // Between 10 km deep and 100 km high.
    if !(6_340_000.0..6_480_000.0).contains(&ecef.length()) {
        return None;
    }
    let across = ecef.x.hypot(ecef.y);
    let mut latitude = ecef.z.atan2(across * (1.0 - E2));
    let normal = |latitude: f64| A_M / (1.0 - E2 * latitude.sin().powi(2)).sqrt();
    // Bowring's fixed point gains about 2.5 digits a step here.
    for _ in 0..8 {
        latitude = (ecef.z + E2 * normal(latitude) * latitude.sin()).atan2(across);
    }
    // Exact at the poles too, where across / cos(latitude) is not.
    let height_m = across * latitude.cos() + ecef.z * latitude.sin() - A_M * (1.0 - E2 * latitude.sin().powi(2)).sqrt();
    let longitude_deg = ecef.y.atan2(ecef.x).to_degrees();
    Some(Place { longitude_deg, latitude_deg: latitude.to_degrees(), height_m })
}

impl fmt::Display for TilesetSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.path.display())?;
        let generator = self.generator.as_deref().unwrap_or("an unnamed program");
        writeln!(f, "3D Tiles {} by {generator}", self.version)?;
        if let Some(copyright) = &self.copyright {
            writeln!(f, "{copyright}")?;
        }
        if let Some(p) = &self.place {
            writeln!(f, "at {:.7}° E {:.7}° N, {:.2} m", p.longitude_deg, p.latitude_deg, p.height_m)?;
        }
        if let (Some(min), Some(max)) = (self.min_m, self.max_m) {
            let size = DVec3::from(max) - DVec3::from(min);
            writeln!(f, "{:.1} × {:.1} × {:.1} m", size.x, size.y, size.z)?;
        }
        writeln!(
            f,
            "{} tiles, {:.2} MB, {:.2} m if nothing is drawn",
            self.tiles,
            mega(self.bytes),
            self.geometric_error_m
        )?;
        writeln!(f, "\ndepth  tiles  triangles   skirts  draws        MB  geometricError m       texel m")?;
        for l in &self.levels {
            let range = |min: f64, max: f64| format!("{min:.3}–{max:.3}");
            let texel = l.min_texel_m.zip(l.max_texel_m).map_or("–".into(), |(min, max)| range(min, max));
            let (errors, mb) = (range(l.min_error_m, l.max_error_m), mega(l.bytes));
            let (depth, tiles, triangles, skirts, draws) =
                (l.depth, l.tiles, l.triangles, l.skirt_triangles, l.draw_calls);
            writeln!(
                f,
                "{depth:5}  {tiles:5}  {triangles:9}  {skirts:7}  {draws:5}  {mb:8.2}  {errors:>16}  {texel:>12}"
            )?;
        }
        if !self.classes.is_empty() {
            writeln!(f, "\nclass (leaves)  triangles           area m²")?;
        }
        for c in &self.classes {
            let (triangles, area) = (100.0 * c.triangle_share, 100.0 * c.area_share);
            writeln!(f, "{:14}  {:9} {triangles:3.0} %  {:10.1} {area:3.0} %", c.name, c.triangles, c.area_m2)?;
        }
        for line in &self.unread {
            writeln!(f, "not read: {line}")?;
        }
        Ok(())
    }
}

fn mega(bytes: u64) -> f64 {
    bytes as f64 / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_the_inverse_of_geocentric_coordinates() {
        // Known in closed form: on the equator, at the pole, and the forward formula in between.
        let close = |a: f64, b: f64| (a - b).abs() < 1e-6;
        let p = place(DVec3::new(6_378_147.0, 0.0, 0.0)).unwrap();
        assert!(close(p.longitude_deg, 0.0) && close(p.latitude_deg, 0.0) && close(p.height_m, 10.0), "{p:?}");
        let p = place(DVec3::new(0.0, 0.0, -6_356_752.314_245_179 - 20.0)).unwrap();
        assert!(close(p.latitude_deg, -90.0) && close(p.height_m, 20.0), "{p:?}");
        // Forward formula at 52° N, 13.4° E, 100 m.
        let (lat, lon) = (52f64.to_radians(), 13.4f64.to_radians());
        let e2 = 6.694_379_990_141_316e-3;
        let n = 6_378_137.0 / (1.0 - e2 * lat.sin().powi(2)).sqrt();
        let r = (n + 100.0) * lat.cos();
        let p = place(DVec3::new(r * lon.cos(), r * lon.sin(), (n * (1.0 - e2) + 100.0) * lat.sin())).unwrap();
        assert!((p.latitude_deg - 52.0).abs() < 1e-10 && (p.longitude_deg - 13.4).abs() < 1e-10, "{p:?}");
        assert!(close(p.height_m, 100.0), "{p:?}");
        assert_eq!(place(DVec3::ZERO), None);
    }
}
