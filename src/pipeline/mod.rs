//! A build from input to output, one line a stage.

use std::path::Path;

use serde::Serialize;
use serde_json::json;

use crate::config::Config;
use crate::geo::{FrameSummary, Georeference};
use crate::ids::ClassId;
use crate::input::Source;
use crate::mesh::GateReport;
use crate::report::Reporter;
use crate::store::{Store, memory};
use crate::texture::Images;
use crate::tiles::CellTree;
use crate::tiles::content::ClassDeviation;
use crate::tiles::skirt::Hem;
use crate::write::tileset::bytes as tileset_bytes;
use crate::write::{self, About, ClassError, GENERATOR, Output, TileEntry};
use crate::{Error, Result};

mod contents;
mod cracks;
pub mod figures;
pub mod front;
pub mod given;
mod hierarchy;
mod ingest;
mod join;
mod labels;
pub mod report;
mod steps;
mod tops;
mod walls;
mod windows;

use contents::{Contents, Record, content_name};
pub use front::Front;
pub use given::LabelSource;
use hierarchy::Node;
pub use ingest::Feed;
pub use report::BuildReport;
use report::{ClassShare, LevelRow, level_rows};

/// What to build, and where to.
pub struct Job<'a> {
    /// The output folder.
    pub out: &'a Path,
    /// Replace an existing output.
    pub force: bool,
    /// All settings.
    pub config: &'a Config,
    /// Where the source's coordinates are.
    pub georeference: Georeference,
    /// Name and BLAKE3 of each input, for build.json.
    pub inputs: Vec<InputDigest>,
    /// The source's face labels are class ids and true: report how well the classes agree.
    pub labels_are_truth: bool,
    /// Labels that override the classifier.
    pub labels: Option<LabelSource>,
}

/// An input file as it was read.
#[derive(Debug, Clone, Serialize)]
pub struct InputDigest {
    /// File name, without its folder: outputs do not depend on where inputs lie.
    pub name: String,
    /// Size in bytes.
    pub bytes: u64,
    /// BLAKE3, hexadecimal.
    pub blake3: String,
}

/// Builds a tileset; see the crate's own picture of the stages.
///
/// # Errors
/// An output that exists or is busy, a source without surface or outside its coordinate system, the disk, or a wish to
/// stop. Nothing is left behind then.
pub fn build(source: Source, job: &Job, reporter: &Reporter) -> Result<BuildReport> {
    build_from(Feed::Memory(source), job, &Resources::default(), reporter)
}

/// What a run may use; nothing of it shows in the bytes.
#[derive(Debug, Clone)]
pub struct Resources {
    /// Memory, bytes. Default: a third of the machine's.
    pub memory: u64,
    /// Go on with what a run of the same inputs and settings left that was stopped or killed.
    pub resume: bool,
}

impl Default for Resources {
    fn default() -> Self {
        Self { memory: memory::default_bytes(), resume: false }
    }
}

/// Builds a tileset from a source of any size, in bounded memory.
///
/// # Errors
/// Those of [`build`]. After a failure of the disk, or a wish to stop once files have been read, the work done stays
/// beside the output, for [`Resources::resume`].
pub fn build_from(feed: Feed, job: &Job, resources: &Resources, reporter: &Reporter) -> Result<BuildReport> {
    let output = Output::begin(job.out, job.force)?;
    let store = Store::open(output.beside(".work"), &token(job), resources.resume)?;
    let is_repeatable = matches!(feed, Feed::Files(..));
    let built = build_in(feed, job, resources, output, &store, reporter);
    match built {
        // Trying again may help, and then need not begin at the beginning.
        Err(Error::Io { .. }) => built,
        Err(Error::Cancelled { signal, .. }) if is_repeatable && !store.is_empty() => {
            Err(Error::Cancelled { signal, resumable: true })
        }
        _ => {
            store.discard();
            built
        }
    }
}

/// Tells builds apart: whatever changes a byte of a page is in it.
fn token(job: &Job) -> String {
    let text = serde_json::to_string(&json!({
        "generator": GENERATOR,
        "inputs": job.inputs,
        "config": job.config,
        "georeference": job.georeference,
        "labels": job.labels.as_ref().map(LabelSource::digest),
    }));
    blake3::hash(text.unwrap_or_default().as_bytes()).to_hex().to_string()
}

fn build_in(
    feed: Feed,
    job: &Job,
    resources: &Resources,
    output: Output,
    store: &Store,
    reporter: &Reporter,
) -> Result<BuildReport> {
    let config = job.config;
    let city = ingest::ingest(feed, job, resources, store, reporter)?;
    let copyright = credits(&city.copyright, &config.write.copyright);
    // What is said of images must not depend on what is cached or was done by a run before: see below.
    let silent = Reporter::new(true);
    let images = Images::with_budget(city.images.clone(), (resources.memory / 8).min(1 << 30), &silent);
    let mut faults = images.faults();
    let labels = labels::label(&city, &images, job, store, reporter)?;
    let nodes = hierarchy::nodes(&city, job, labels.median_edge_m, store, reporter)?;
    if config.levels.keep_tops {
        tops::keep(&city, &nodes, job, store, reporter)?;
    }
    let hems = walls::hem(&city, &nodes, job, store, reporter)?;
    let copyright = copyright.as_deref();
    let (images, nodes, hems) = (&images, &nodes[..], &hems[..]);
    let records = Contents { city: &city, job, store, reporter, images, resources, nodes, hems, copyright }.make()?;

    records.iter().for_each(|r| faults.extend(r.faults.clone()));
    for (image, what) in faults {
        reporter.warn("unreadable-texture", &images.path(image), what);
    }
    let tree = Tree { cells: &city.tree, nodes, records: &records, hems, config };
    let (root, contents) = tree.entry(nodes.len() - 1, 0);
    for (uri, tile) in &contents {
        output.adopt(&store.path(&content_name(*tile)), uri)?;
    }
    let levels = level_rows(&root, &config.classes);
    warn_of(&root, config, job.out, reporter);
    let about = About {
        ecef_from_local: city.frame.ecef_from_local(),
        scheme: &config.classes,
        copyright,
        texel_factor: config.write.texel_factor,
    };
    let frame = city.frame.describe();
    output.write("build.json", &build_json(job, &frame, &city.gate, &labels.shares, &levels, reporter))?;
    output.write("tileset.json", &tileset_bytes(&write::tileset(&root, &about)))?;
    reporter.check()?;
    output.commit()?;
    Ok(BuildReport {
        out: job.out.to_path_buf(),
        frame,
        gate: city.gate.clone(),
        classes: labels.shares,
        accuracy: labels.accuracy,
        tiles: nodes.len(),
        bytes: levels.iter().map(|l| l.bytes).sum(),
        levels,
        warnings: reporter.warnings(),
        stages: reporter.stages(),
    })
}

/// Says what the tree does not keep.
fn warn_of(root: &TileEntry, config: &Config, out: &Path, reporter: &Reporter) {
    let (root_bytes, tile_bytes) = (config.write.root_bytes, config.write.tile_bytes);
    if root.bytes > root_bytes {
        let what = format!(
            "the root has {} kB, {} kB were wanted; lower levels.root_faces",
            root.bytes / 1000,
            root_bytes / 1000
        );
        reporter.warn("heavy-root", out, what);
    }
    let mut open = vec![root];
    let (mut heavy, mut worst) = (0, 0);
    while let Some(tile) = open.pop() {
        open.extend(&tile.children);
        if tile.bytes > tile_bytes {
            heavy += 1;
            worst = worst.max(tile.bytes);
        }
        if !config.levels.keep_tops || tile.children.is_empty() {
            continue;
        }
        for class in tile.classes.iter().filter(|c| [ClassId::ROOF, ClassId::FACADE].contains(&c.class)) {
            let spec = &config.classes[class.class];
            if class.sunk_m > spec.budget_m {
                let what = format!(
                    "{} sinks {:.3} m below a {}, {} m is its budget; do not fly by this tile",
                    tile.uri, class.sunk_m, spec.name, spec.budget_m
                );
                reporter.warn("sunken-tops", out, what);
            }
        }
    }
    let what = format!(
        "up to {:.1} MB, {:.1} MB were wanted; lower levels.leaf_texels, levels.leaf_faces or levels.tile_faces",
        worst as f64 / 1e6,
        tile_bytes as f64 / 1e6
    );
    reporter.warn_many("heavy-tiles", out, heavy, what);
}

/// The nodes as they are written: boxes hold their children's, errors never fall towards the root.
struct Tree<'a> {
    cells: &'a CellTree,
    nodes: &'a [Node],
    records: &'a [Record],
    hems: &'a [Hem],
    config: &'a Config,
}

impl Tree<'_> {
    /// The entry of a node, and where in the store the contents of its subtree are, by their name in the output.
    fn entry(&self, at: usize, level: u32) -> (TileEntry, Vec<(String, usize)>) {
        let (node, made, hem) = (&self.nodes[at], &self.records[at], &self.hems[at]);
        let (scheme, texel_factor) = (&self.config.classes, self.config.write.texel_factor);
        let uri = format!("tiles/{level}/{}.glb", self.cells.key(node.cell));
        let mut contents = vec![(uri.clone(), at)];
        let children: Vec<TileEntry> = (node.children.iter())
            .map(|&c| {
                let (entry, below) = self.entry(c as usize, level + 1);
                contents.extend(below);
                entry
            })
            .collect();
        let of_children = children.iter().map(|c| c.geometric_error_m).fold(0.0, f64::max);
        let own = made.error_m(texel_factor);
        // The scale at which the certified bounds are within their budgets, whatever the collapse was allowed.
        // Rounded up, so that the budget at that scale is not below the bound.
        let of_class = |d: &ClassDeviation| match d.bound_m {
            0.0 => 0.0,
            bound_m => (bound_m / scheme[d.class].budget_m).next_up(),
        };
        let own_scale = made.classes.iter().map(of_class).fold(0.0, f64::max);
        let scale = children.iter().map(|c| c.scale).fold(own_scale, f64::max);
        let class_error = |d: &ClassDeviation| ClassError {
            class: d.class,
            budget_m: scheme[d.class].budget_m * scale,
            bound_m: d.bound_m,
            mean_m: d.figures.mean_m,
            rms_m: d.figures.rms_m,
            p95_m: d.figures.p95_m,
            p99_m: d.figures.p99_m,
            inside_m: d.inside_m,
            sunk_m: d.sunk_m,
        };
        let entry = TileEntry {
            uri,
            box_local: children.iter().fold(made.bounds, |b, c| b.union(c.box_local)),
            geometric_error_m: own.max(of_children),
            geometry_m: made.geometry_m,
            texel_m: made.texel_m,
            scale,
            wall_m: hem.wall_m,
            skirt_m: hem.skirt_m,
            triangles: made.triangles as u64,
            skirt_triangles: made.skirt_triangles as u64,
            bytes: made.bytes,
            classes: made.classes.iter().map(class_error).collect(),
            level,
            children,
        };
        (entry, contents)
    }
}

fn credits(found: &[String], added: &str) -> Option<String> {
    let mut all: Vec<&str> = found.iter().map(|c| c.trim()).chain([added.trim()]).filter(|c| !c.is_empty()).collect();
    let mut seen = std::collections::BTreeSet::new();
    all.retain(|c| seen.insert(*c));
    (!all.is_empty()).then(|| all.join("; "))
}

/// From this file a build can be repeated. It holds no times and no paths: equal builds have equal bytes.
fn build_json(
    job: &Job,
    frame: &FrameSummary,
    gate: &GateReport,
    shares: &[ClassShare],
    levels: &[LevelRow],
    reporter: &Reporter,
) -> Vec<u8> {
    let warnings: Vec<_> =
        reporter.warnings().into_iter().map(|w| json!({"code": w.code, "count": w.count, "first": w.first})).collect();
    let text = serde_json::to_string_pretty(&json!({
        "generator": GENERATOR,
        "inputs": job.inputs,
        "config": job.config,
        "georeference": job.georeference,
        "frame": frame,
        "gate": gate,
        "classes": shares,
        "levels": levels,
        "warnings": warnings,
    }));
    text.unwrap_or_default().into_bytes()
}
