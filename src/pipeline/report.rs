//! What a build has to say for itself, for people and as JSON.

use std::fmt;
use std::path::PathBuf;

use serde::Serialize;

use crate::classes::{Classes, Confusion};
use crate::geo::FrameSummary;
use crate::ids::ClassScheme;
use crate::mesh::{GateReport, Mesh};
use crate::report::{StageTime, Warning};
use crate::write::TileEntry;

/// What a build did.
#[derive(Debug, Serialize)]
pub struct BuildReport {
    /// The output folder.
    pub out: PathBuf,
    /// The frame.
    pub frame: FrameSummary,
    /// The gate.
    pub gate: GateReport,
    /// Triangles per class of the source, in scheme order, and their area in m².
    pub classes: Vec<ClassShare>,
    /// How well the classes agree with the truth, by area, where the source holds it.
    pub accuracy: Option<Confusion>,
    /// From the root down.
    pub levels: Vec<LevelRow>,
    /// Tiles.
    pub tiles: usize,
    /// Bytes of all tiles.
    pub bytes: u64,
    /// Counted warnings.
    pub warnings: Vec<Warning>,
    /// Wall time by stage; not part of the output, which is the same for every run.
    pub stages: Vec<StageTime>,
}

/// How much of the source is of a class.
#[derive(Debug, Clone, Serialize)]
pub struct ClassShare {
    /// Name in the scheme.
    pub class: String,
    /// Triangles.
    pub triangles: usize,
    /// Area, m².
    pub area_m2: f64,
}

/// One level of the hierarchy.
#[derive(Debug, Clone, Serialize)]
pub struct LevelRow {
    /// 0 is the root.
    pub level: u32,
    /// Tiles of this level.
    pub tiles: usize,
    /// Of them, leaves.
    pub leaves: usize,
    /// Triangles of the surface.
    pub triangles: u64,
    /// Triangles of skirts.
    pub skirt_triangles: u64,
    /// Bytes.
    pub bytes: u64,
    /// Largest `geometricError`, metres.
    pub geometric_error_m: f64,
    /// Largest certified error of the geometry, metres.
    pub geometry_m: f64,
    /// Largest texel, metres.
    pub texel_m: f64,
    /// Largest scale t: every class of every tile is within t times its budget.
    pub scale: f64,
    /// Largest distance of a tile's border to those of tiles that can stand beside it, metres.
    pub wall_m: f64,
    /// Deepest skirt, metres.
    pub skirt_m: f64,
    /// The worst of each class over the level's tiles, metres.
    pub classes: Vec<ClassRow>,
}

/// One class at one level.
#[derive(Debug, Clone, Serialize)]
pub struct ClassRow {
    /// Name in the scheme.
    pub class: String,
    /// Largest deviation allowed at the tile's scale, metres.
    pub budget_m: f64,
    /// Largest certified two-sided bound, metres.
    pub bound_m: f64,
    /// Largest mean, metres.
    pub mean_m: f64,
    /// Largest root mean square, metres.
    pub rms_m: f64,
    /// Largest 95th percentile, metres.
    pub p95_m: f64,
    /// Largest 99th percentile, metres.
    pub p99_m: f64,
    /// Furthest that a tile sinks inside the source, along the source's normals, metres (certified); absent where no tile
    /// of the level has the class.
    pub inside_m: Option<f64>,
    /// Most that a tile is lower than the source, metres (certified).
    pub sunk_m: Option<f64>,
}

impl fmt::Display for BuildReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds: f64 = self.stages.iter().map(|s| s.seconds).sum();
        for warning in &self.warnings {
            writeln!(f, "warning    {} × {}: {}", warning.count, warning.code, warning.first)?;
        }
        writeln!(
            f,
            "\n{} tiles, {:.1} MB, {seconds:.1} s, in {}",
            self.tiles,
            self.bytes as f64 / 1e6,
            self.out.display()
        )?;
        write!(f, "\nlevel  tiles  triangles      MB  error m  geometry m  texel m")?;
        for class in &self.classes {
            write!(f, "  {:>9}", class.class)?;
        }
        writeln!(f, "   (largest certified error of each class, m)")?;
        for row in &self.levels {
            let (mb, leaf) = (row.bytes as f64 / 1e6, if row.leaves == row.tiles { "source" } else { "" });
            write!(
                f,
                "{:>5}  {:>5}  {:>9}  {mb:>6.2}  {:>7.3}",
                row.level, row.tiles, row.triangles, row.geometric_error_m
            )?;
            write!(f, "  {:>10.3}  {:>7.3}", row.geometry_m, row.texel_m)?;
            for class in &row.classes {
                write!(f, "  {:>9.3}", class.bound_m)?;
            }
            writeln!(f, "   {leaf}")?;
        }
        if let Some(accuracy) = &self.accuracy {
            let (overall, mean) = (100.0 * accuracy.overall_accuracy, 100.0 * accuracy.mean_iou);
            writeln!(f, "\nclasses against the truth, by area: {overall:.1} % right, mean IoU {mean:.1} %")?;
        }
        Ok(())
    }
}

/// A row for each class, of nothing yet.
pub(super) fn no_shares(scheme: &ClassScheme) -> Vec<ClassShare> {
    scheme.0.iter().map(|c| ClassShare { class: c.name.clone(), triangles: 0, area_m2: 0.0 }).collect()
}

pub(super) fn shares(mesh: &Mesh, classes: &Classes) -> Vec<ClassShare> {
    let mut rows = no_shares(&classes.scheme);
    for (f, label) in classes.label.iter().enumerate() {
        rows[label.index()].triangles += 1;
        rows[label.index()].area_m2 += mesh.cross(f).length() * 0.5;
    }
    rows
}

pub(super) fn level_rows(root: &TileEntry, scheme: &ClassScheme) -> Vec<LevelRow> {
    let mut rows: Vec<LevelRow> = Vec::new();
    let mut open = vec![root];
    while let Some(tile) = open.pop() {
        open.extend(&tile.children);
        let level = tile.level as usize;
        while rows.len() <= level {
            let classes = scheme.0.iter().map(|c| ClassRow {
                class: c.name.clone(),
                budget_m: 0.0,
                bound_m: 0.0,
                mean_m: 0.0,
                rms_m: 0.0,
                p95_m: 0.0,
                p99_m: 0.0,
                inside_m: None,
                sunk_m: None,
            });
            rows.push(LevelRow {
                level: rows.len() as u32,
                tiles: 0,
                leaves: 0,
                triangles: 0,
                skirt_triangles: 0,
                bytes: 0,
                geometric_error_m: 0.0,
                geometry_m: 0.0,
                texel_m: 0.0,
                scale: 0.0,
                wall_m: 0.0,
                skirt_m: 0.0,
                classes: classes.collect(),
            });
        }
        let row = &mut rows[level];
        row.tiles += 1;
        row.leaves += usize::from(tile.children.is_empty());
        row.triangles += tile.triangles;
        row.skirt_triangles += tile.skirt_triangles;
        row.scale = row.scale.max(tile.scale);
        row.wall_m = row.wall_m.max(tile.wall_m);
        row.skirt_m = row.skirt_m.max(tile.skirt_m);
        row.bytes += tile.bytes;
        row.geometric_error_m = row.geometric_error_m.max(tile.geometric_error_m);
        row.geometry_m = row.geometry_m.max(tile.geometry_m);
        row.texel_m = row.texel_m.max(tile.texel_m);
        for class in &tile.classes {
            let of = &mut row.classes[class.class.index()];
            of.budget_m = of.budget_m.max(class.budget_m);
            of.bound_m = of.bound_m.max(class.bound_m);
            of.mean_m = of.mean_m.max(class.mean_m);
            of.rms_m = of.rms_m.max(class.rms_m);
            of.p95_m = of.p95_m.max(class.p95_m);
            of.p99_m = of.p99_m.max(class.p99_m);
            of.inside_m = Some(of.inside_m.map_or(class.inside_m, |m| m.max(class.inside_m)));
            of.sunk_m = Some(of.sunk_m.map_or(class.sunk_m, |m| m.max(class.sunk_m)));
        }
    }
    rows
}
