//! What a tileset's tree and files say without comparing surfaces: sizes, volumes, errors, textures.
//!
//! In: a [`Tileset`]. Out: a [`Structure`]: figures by tile and level, and [`Finding`]s.
//!
//! # Method
//! 1. load each tile once, in parallel, and keep its [`TileFigures`] only
//! 2. sum them up by level, the number of tiles with content above
//! 3. compare volumes and errors down the tree
//!
//! # Numbers
//! Texels per pixel are those at a tile's switching distance: where its error covers [`SSE_PX`] pixels, so that one
//! pixel covers `error / SSE_PX` metres. Below 1 the tile is seen blurred before it is replaced.
//!
//! # Promises
//! The result does not depend on the number of threads; as many tiles are loaded at once as the budget allows.

use serde::Serialize;

use super::budget::Budget;
use super::read::{Refine, TileMesh, Tileset, Volume};
use crate::Result;
use crate::report::Reporter;

/// Screen-space error at which viewers replace a tile unless told otherwise, pixels (CesiumJS).
pub const SSE_PX: f64 = 16.0;

/// From here on things are found wanting.
#[derive(Debug, Clone, PartialEq)]
pub struct StructureConfig {
    /// Content or children this far out of a volume are no rounding, metres. Default: 0.01.
    pub outside_m: f64,
    /// Bytes of one tile's contents. Default: 10 MB, some seconds on a slow link.
    pub tile_bytes: u64,
    /// Triangles of one tile. Default: 300 000.
    pub tile_triangles: u64,
    /// Draw calls of one tile. Default: 50.
    pub tile_draw_calls: u64,
    /// Decoded RGBA bytes of one tile's textures. Default: 128 MiB, two of 4096 × 4096.
    pub tile_texture_bytes: u64,
    /// A child's error may be larger than its parent's by this part. Default: 1e-6.
    pub error_slack: f64,
    /// How many tiles are loaded at once.
    pub budget: Budget,
}

impl Default for StructureConfig {
    fn default() -> Self {
        Self {
            outside_m: 0.01,
            tile_bytes: 10_000_000,
            tile_triangles: 300_000,
            tile_draw_calls: 50,
            tile_texture_bytes: 128 << 20,
            error_slack: 1e-6,
            budget: Budget::default(),
        }
    }
}

/// What one tile is made of.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct TileFigures {
    /// Size of the contents as stored.
    pub bytes: u64,
    /// Triangles.
    pub triangles: u64,
    /// Vertices.
    pub vertices: u64,
    /// Primitives drawn, over all nodes.
    pub draw_calls: u64,
    /// Base colour images.
    pub textures: u64,
    /// Pixels of these images.
    pub texture_px: u64,
    /// Bytes of these images as stored.
    pub texture_encoded_bytes: u64,
    /// Bytes of these images as RGBA without mipmaps. Images that stay packed on the GPU (KTX2) take less.
    pub texture_rgba_bytes: u64,
    /// Area of the faces that show an image, m².
    pub textured_m2: f64,
    /// Area of these faces in their images, texels.
    pub textured_texels: f64,
    /// How far a vertex is out of the tile's volume, metres; the largest.
    pub outside_tile_m: f64,
    /// How far a vertex is out of its content's own volume, metres; the largest.
    pub outside_content_m: f64,
    /// Why a content could not be read: a code.
    pub refused: Option<&'static str>,
}

impl TileFigures {
    /// The side of a texel on the surface, metres, over all textured faces. `None` without.
    pub fn metres_per_texel(&self) -> Option<f64> {
        metres_per_texel(self.textured_m2, self.textured_texels)
    }

    /// The figures of `meshes`, which content `content` of tile `tile` was loaded to.
    pub fn of(tileset: &Tileset, tile: usize, content: usize, meshes: &[TileMesh]) -> Self {
        let mut figures = Self::default();
        let Some(tile) = tileset.tiles.get(tile) else { return figures };
        let own = tile.contents.get(content).and_then(|content| content.volume);
        for mesh in meshes {
            figures.bytes += mesh.bytes;
            figures.triangles += mesh.faces.len() as u64;
            figures.vertices += mesh.positions.len() as u64;
            figures.draw_calls += mesh.parts.len() as u64;
            figures.textures += mesh.textures.len() as u64;
            for texture in &mesh.textures {
                let [width, height] = texture.size_px.unwrap_or_default().map(u64::from);
                figures.texture_px += width * height;
                figures.texture_encoded_bytes += texture.encoded.len() as u64;
            }
            figures.texture_rgba_bytes = 4 * figures.texture_px;
            let outside = |volume: &Option<Volume>| volume.map_or(0.0, |volume| outside_m(tileset, mesh, &volume));
            figures.outside_tile_m = figures.outside_tile_m.max(outside(&tile.volume));
            figures.outside_content_m = figures.outside_content_m.max(outside(&own));
            let (m2, texels) = textured(mesh);
            figures.textured_m2 += m2;
            figures.textured_texels += texels;
        }
        figures
    }

    fn add(&mut self, other: &Self) {
        self.bytes += other.bytes;
        self.triangles += other.triangles;
        self.vertices += other.vertices;
        self.draw_calls += other.draw_calls;
        self.textures += other.textures;
        self.texture_px += other.texture_px;
        self.texture_encoded_bytes += other.texture_encoded_bytes;
        self.texture_rgba_bytes += other.texture_rgba_bytes;
        self.textured_m2 += other.textured_m2;
        self.textured_texels += other.textured_texels;
        self.outside_tile_m = self.outside_tile_m.max(other.outside_tile_m);
        self.outside_content_m = self.outside_content_m.max(other.outside_content_m);
        self.refused = self.refused.or(other.refused);
    }
}

/// The tiles of one level together.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct LevelFigures {
    /// Tiles with content above: 0 is the coarsest.
    pub level: u32,
    /// Tiles with content.
    pub tiles: u64,
    /// Of these, tiles of which a content could not be read.
    pub refused: u64,
    /// All tiles together; the distances out of volumes are the largest.
    pub sum: TileFigures,
    /// The largest of any tile.
    pub most_bytes: u64,
    /// The most of any tile.
    pub most_triangles: u64,
    /// The most of any tile.
    pub most_draw_calls: u64,
    /// The most of any tile.
    pub most_texture_rgba_bytes: u64,
    /// Smallest, median and largest geometric error, metres.
    pub error_m: [f64; 3],
    /// The side of a texel, over all textured faces, metres.
    pub metres_per_texel: Option<f64>,
    /// Median over the tiles that have an error and a texture.
    pub texels_per_pixel: Option<f64>,
}

/// Something wrong with a tile.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// Stable name.
    pub code: &'static str,
    /// Index of the tile.
    pub tile: usize,
    /// How bad: metres, bytes, triangles or calls, as the code goes.
    pub amount: f64,
    /// Value found, value wanted.
    pub what: String,
}

/// What the tree and the files say.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Structure {
    /// For each tile.
    pub tiles: Vec<TileFigures>,
    /// By level, the coarsest first; levels without content are left out.
    pub levels: Vec<LevelFigures>,
    /// By tile.
    pub findings: Vec<Finding>,
}

/// Loads every tile once and judges the structure. What was odd in the contents goes to `reporter`.
///
/// # Errors
/// [`crate::Error::Cancelled`].
pub fn measure(tileset: &Tileset, config: &StructureConfig, reporter: &Reporter) -> Result<Structure> {
    let load = |&tile: &usize| {
        reporter.check()?;
        let own = Reporter::new(true);
        Ok((figures(tileset, tile, &own), own.warnings()))
    };
    let all: Vec<usize> = (0..tileset.tiles.len()).collect();
    let loaded: Vec<Result<_>> = config.budget.map(&all, |&tile| Budget::to_read(tileset.stored_bytes(tile)), load);
    let mut tiles = Vec::with_capacity(loaded.len());
    for result in loaded {
        let (figures, warnings) = result?;
        for warning in warnings {
            reporter.warn_many(warning.code, &warning.first_path, warning.count, warning.first);
        }
        tiles.push(figures);
    }
    Ok(judge(tileset, tiles, config))
}

/// The figures of all contents of a tile.
fn figures(tileset: &Tileset, tile: usize, reporter: &Reporter) -> TileFigures {
    let mut sum = TileFigures::default();
    for content in 0..tileset.tiles[tile].contents.len() {
        match tileset.load_content(tile, content, reporter) {
            Ok(meshes) => sum.add(&TileFigures::of(tileset, tile, content, &meshes)),
            Err(refusal) => sum.refused = sum.refused.or(Some(refusal.code)),
        }
    }
    sum
}

/// Levels and findings from the figures of each tile.
pub fn judge(tileset: &Tileset, tiles: Vec<TileFigures>, config: &StructureConfig) -> Structure {
    let mut findings = Vec::new();
    for (id, figures) in tiles.iter().enumerate() {
        of_content(id, figures, config, &mut findings);
        of_tree(tileset, id, config, &mut findings);
    }
    Structure { levels: levels(tileset, &tiles), findings, tiles }
}

fn of_content(tile: usize, figures: &TileFigures, config: &StructureConfig, findings: &mut Vec<Finding>) {
    let mut find = |code, amount: f64, limit: f64, what: String| {
        if amount > limit {
            findings.push(Finding { code, tile, amount, what });
        }
    };
    let outside = |m: f64, of: &str| format!("the content reaches {m:.3} m out of {of} bounding volume");
    let (of_tile, of_content) = (figures.outside_tile_m, figures.outside_content_m);
    find("content-outside-volume", of_tile, config.outside_m, outside(of_tile, "its tile's"));
    find("content-outside-own-volume", of_content, config.outside_m, outside(of_content, "its own"));
    let sizes = [
        ("tile-bytes", figures.bytes, config.tile_bytes, "bytes"),
        ("tile-triangles", figures.triangles, config.tile_triangles, "triangles"),
        ("tile-draw-calls", figures.draw_calls, config.tile_draw_calls, "draw calls"),
        ("tile-texture-bytes", figures.texture_rgba_bytes, config.tile_texture_bytes, "bytes of decoded texture"),
    ];
    for (code, found, most, unit) in sizes {
        find(code, found as f64, most as f64, format!("{found} {unit}; at most {most} draw smoothly"));
    }
}

fn of_tree(tileset: &Tileset, id: usize, config: &StructureConfig, findings: &mut Vec<Finding>) {
    let tile = &tileset.tiles[id];
    let mut find = |code, amount, what: String| findings.push(Finding { code, tile: id, amount, what });
    let error_m = tile.geometric_error_m;
    if error_m < 0.0 {
        find("error-negative", error_m, format!("the geometric error is {error_m} m"));
    }
    let Some(parent) = tile.parent.map(|parent| &tileset.tiles[parent]) else {
        let stated = tileset.files.first().and_then(|file| file.geometric_error_m);
        if let Some(stated) = stated.filter(|&stated| stated < tile.stated_error * (1.0 - config.error_slack)) {
            let what = format!("the tileset's error is {stated} m, less than its root's {} m", tile.stated_error);
            find("error-not-monotone", tile.stated_error - stated, what);
        }
        return;
    };
    if error_m > parent.geometric_error_m * (1.0 + config.error_slack) {
        let what = format!("the error is {error_m} m, more than its parent's {} m", parent.geometric_error_m);
        find("error-not-monotone", error_m - parent.geometric_error_m, what);
    }
    let reach_m = tile.volume.zip(parent.volume).map_or(0.0, |(own, above)| above.reach_m(&own));
    if reach_m > config.outside_m {
        find("child-outside-parent", reach_m, format!("its volume reaches {reach_m:.3} m out of its parent's"));
    }
    let replaces = parent.refine == Refine::Replace && parent.has_mesh();
    if replaces && tile.contents.is_empty() {
        let is_leaf = tile.children.is_empty();
        let then = if is_leaf { "leaves a hole" } else { "is skipped" };
        find("empty-replace", f64::from(u8::from(is_leaf)), format!("an empty tile replaces one with content: {then}"));
    }
}

fn levels(tileset: &Tileset, tiles: &[TileFigures]) -> Vec<LevelFigures> {
    let mut own_level: Vec<u32> = Vec::with_capacity(tiles.len());
    let mut members: Vec<Vec<usize>> = Vec::new();
    for (id, tile) in tileset.tiles.iter().enumerate() {
        // Parents come first, so theirs is known.
        let level = tile.parent.map_or(0, |p| own_level[p] + u32::from(tileset.tiles[p].has_mesh()));
        own_level.push(level);
        if tile.has_mesh() {
            members.resize(members.len().max(level as usize + 1), Vec::new());
            members[level as usize].push(id);
        }
    }
    let occupied = members.iter().enumerate().filter(|(_, members)| !members.is_empty());
    occupied.map(|(level, members)| level_of(tileset, tiles, level as u32, members)).collect()
}

fn level_of(tileset: &Tileset, tiles: &[TileFigures], level: u32, members: &[usize]) -> LevelFigures {
    let mut found = LevelFigures { level, tiles: members.len() as u64, ..LevelFigures::default() };
    let mut sharpness = Vec::new();
    for &id in members {
        let figures = &tiles[id];
        found.sum.add(figures);
        found.refused += u64::from(figures.refused.is_some());
        found.most_bytes = found.most_bytes.max(figures.bytes);
        found.most_triangles = found.most_triangles.max(figures.triangles);
        found.most_draw_calls = found.most_draw_calls.max(figures.draw_calls);
        found.most_texture_rgba_bytes = found.most_texture_rgba_bytes.max(figures.texture_rgba_bytes);
        sharpness.extend(texels_per_pixel(tileset.tiles[id].geometric_error_m, figures));
    }
    let errors = sorted(members.iter().map(|&id| tileset.tiles[id].geometric_error_m).collect());
    let median = |values: &[f64]| values.get(values.len() / 2).copied();
    found.error_m = [errors.first().copied(), median(&errors), errors.last().copied()].map(Option::unwrap_or_default);
    found.metres_per_texel = found.sum.metres_per_texel();
    found.texels_per_pixel = median(&sorted(sharpness));
    found
}

fn sorted(mut values: Vec<f64>) -> Vec<f64> {
    values.sort_by(f64::total_cmp);
    values
}

/// Texels that a pixel covers at the distance where a tile of this error is replaced. `None` for tiles that are never.
pub fn texels_per_pixel(error_m: f64, figures: &TileFigures) -> Option<f64> {
    let metres_per_pixel = error_m / SSE_PX;
    figures.metres_per_texel().filter(|_| error_m > 0.0).map(|metres_per_texel| metres_per_pixel / metres_per_texel)
}

fn metres_per_texel(m2: f64, texels: f64) -> Option<f64> {
    (m2 > 0.0 && texels > 0.0).then(|| (m2 / texels).sqrt())
}

fn outside_m(tileset: &Tileset, mesh: &TileMesh, volume: &Volume) -> f64 {
    let outside = |&p: &glam::DVec3| volume.outside_m(tileset.frame.root_from_local.transform_point3(p));
    mesh.positions.iter().map(outside).fold(0.0, f64::max)
}

/// Area of the faces that show an image, m², and of their texels.
fn textured(mesh: &TileMesh) -> (f64, f64) {
    let (mut m2, mut texels) = (0.0, 0.0);
    for part in &mesh.parts {
        let size = part.texture.and_then(|texture| mesh.textures.get(texture)?.size_px);
        let Some([width, height]) = size.filter(|_| !mesh.uvs.is_empty()) else { continue };
        let per_uv2 = f64::from(width) * f64::from(height);
        for face in &mesh.faces[part.faces.clone()] {
            let [a, b, c] = face.map(|v| mesh.positions[v as usize]);
            let [s, t, u] = face.map(|v| mesh.uvs[v as usize].as_dvec2());
            m2 += (b - a).cross(c - a).length() / 2.0;
            texels += (t - s).perp_dot(u - s).abs() / 2.0 * per_uv2;
        }
    }
    (m2, texels)
}
