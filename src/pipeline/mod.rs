//! A build from input to output, one line a stage.

use std::path::Path;

use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;

use crate::Result;
use crate::classes::{self, Classes, Confusion};
use crate::config::Config;
use crate::geo::{Aabb, Frame, FrameSummary, Georeference};
use crate::ids::{ClassId, ClassScheme};
use crate::input::Source;
use crate::mesh::{GateReport, Mesh};
use crate::planes;
use crate::report::Reporter;
use crate::texture::{Images, Surface, texels_of};
use crate::tiles::content::{ClassDeviation, Maker};
use crate::tiles::levels::Tile;
use crate::tiles::skirt::{Border, Hem, hems};
use crate::tiles::{self, Partition, TileTree};
use crate::write::tileset::bytes as tileset_bytes;
use crate::write::{self, About, ClassError, GENERATOR, GlbOptions, Output, TileEntry};

pub mod figures;
pub mod front;
pub mod given;
pub mod report;

pub use front::Front;
use front::{place, share_line, weld};
pub use given::LabelSource;
pub use report::BuildReport;
use report::{ClassShare, LevelRow, level_rows, shares};

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
    let config = job.config;
    let output = Output::begin(job.out, job.force)?;
    let images = source.images.clone();
    let copyright = credits(&source, &config.write.copyright);

    let (source, frame) = place(source, &job.georeference, reporter)?;
    let (mesh, gate) = weld(source, config, reporter)?;
    let mut images = Images::new(images, reporter);
    images.cover(&Surface::from(&mesh));
    let (classes, median_edge_m, shares) = classify(&mesh, &images, &frame, job, reporter)?;
    let accuracy = job.labels_are_truth.then(|| agreement(&mesh, &classes));
    let (partition, classes) = cut(mesh, classes, &images, config, reporter)?;
    let mut tree = simplify(&partition, &classes, median_edge_m, config, reporter)?;
    if config.levels.keep_tops {
        let stage = reporter.stage("tops", 0);
        tiles::raise::keep_tops(&mut tree, &partition, &classes);
        stage.finish("simplified tiles are raised to the roofs and façades of the source".into());
        reporter.check()?;
    }
    let hems = hem(&tree, &partition, config, reporter);

    let maker = Maker {
        partition: &partition,
        classes: &classes,
        images: &images,
        texture: &config.texture,
        texel_factor: config.write.texel_factor,
        copyright: copyright.as_deref(),
        normals: config.write.normals,
        moved_m: gate.moved_m + partition.moved_m,
    };
    let written = write_tiles(&tree, &hems, &maker, config, &output, reporter)?;
    let root = entry(&tree, tree.tiles.len() - 1, &written, &config.classes, config.write.texel_factor);
    let levels = level_rows(&root, &config.classes);
    warn_of(&root, config, job.out, reporter);
    let about = About {
        ecef_from_local: frame.ecef_from_local(),
        scheme: &config.classes,
        copyright: copyright.as_deref(),
        texel_factor: config.write.texel_factor,
    };
    let frame = frame.describe();
    output.write("build.json", &build_json(job, &frame, &gate, &shares, &levels, reporter))?;
    output.write("tileset.json", &tileset_bytes(&write::tileset(&root, &about)))?;
    reporter.check()?;
    output.commit()?;
    Ok(BuildReport {
        out: job.out.to_path_buf(),
        frame,
        gate,
        classes: shares,
        accuracy,
        tiles: tree.tiles.len(),
        bytes: levels.iter().map(|l| l.bytes).sum(),
        levels,
        warnings: reporter.warnings(),
        stages: reporter.stages(),
    })
}

fn classify(
    mesh: &Mesh,
    images: &Images,
    frame: &Frame,
    job: &Job,
    reporter: &Reporter,
) -> Result<(Classes, f64, Vec<ClassShare>)> {
    let config = job.config;
    let stage = reporter.stage("planes", 0);
    let planes = planes::grow(mesh, &config.planes);
    stage.finish(format!("{} regions, median edge {:.3} m", planes.regions.len(), planes.median_edge_m));
    reporter.check()?;
    let stage = reporter.stage("classes", 0);
    front::warn(config, reporter);
    let face_colors = front::colors(mesh, images, config);
    let scene = classes::Scene { mesh, planes: &planes, face_colors: &face_colors };
    let mut classes = classes::classify(scene, &config.classes, &config.classify);
    if let Some(from) = &job.labels {
        let masks = given::masks(from, mesh, planes.median_edge_m, frame, &config.classes)?;
        classes = classes::truth::overridden(classes, &masks);
    }
    let shares = shares(mesh, &classes);
    stage.finish(share_line(&shares));
    reporter.check()?;
    Ok((classes, planes.median_edge_m, shares))
}

/// Classes against the labels of the source, base classes by number, weighted by area.
fn agreement(mesh: &Mesh, classes: &Classes) -> Confusion {
    let base = classes::scheme::BASE.map(|name| classes::truth::mask_of_name(&classes.scheme, name));
    let truth: Vec<u32> = mesh
        .face_labels
        .iter()
        .map(|&l| usize::try_from(l).ok().and_then(|l| base.get(l)).copied().unwrap_or(0))
        .collect();
    let areas: Vec<f64> = (0..mesh.faces.len()).map(|f| mesh.cross(f).length() * 0.5).collect();
    classes::truth::agreement(classes, &truth, &areas).by_area
}

fn cut(
    mesh: Mesh,
    classes: Classes,
    images: &Images,
    config: &Config,
    reporter: &Reporter,
) -> Result<(Partition, Classes)> {
    let stage = reporter.stage("cells", 0);
    let texels: Vec<f64> = (0..mesh.faces.len())
        .map(|f| {
            let image = mesh.materials.get(mesh.face_material[f] as usize).and_then(|m| m.image);
            match (mesh.corner_uvs.get(f), image) {
                (Some(uvs), Some(image)) => texels_of(uvs, images.dimensions(image)),
                _ => 0.0,
            }
        })
        .collect();
    // A leaf is full when either its faces or its texels are.
    let levels = &config.levels;
    let weight = |f: usize| (1.0 / levels.leaf_faces as f64).max(texels[f] / levels.leaf_texels as f64);
    let before = mesh.faces.len();
    let partition = Partition::of(mesh, weight, 1.0);
    let classes = classes.inherited(&partition.origin);
    let leaves = partition.leaf.chunk_by(|a, b| a == b).count();
    let after = partition.mesh.faces.len();
    stage.finish(format!(
        "{leaves} leaves in {} levels, {before} → {after} triangles along their walls",
        partition.depth() + 1
    ));
    reporter.check()?;
    Ok((partition, classes))
}

fn simplify(
    partition: &Partition,
    classes: &Classes,
    median_edge_m: f64,
    config: &Config,
    reporter: &Reporter,
) -> Result<TileTree> {
    let stage = reporter.stage("collapse", 0);
    let tree = TileTree::of(partition, classes, median_edge_m, &config.levels, &config.collapse, reporter)?;
    let last = tree.log.steps.last().map_or(0.0, |s| s.0);
    stage.finish(format!(
        "{} collapses in {} steps to scale {last:.2}, {} tiles",
        tree.log.events.len(),
        tree.log.steps.len(),
        tree.tiles.len()
    ));
    Ok(tree)
}

/// Coordinates are f32 about an origin near the tile: no vertex moves further when it is written, metres.
const F32_ROUNDING_M: f64 = 2e-5;

/// Compares the borders of all tiles.
fn hem(tree: &TileTree, partition: &Partition, config: &Config, reporter: &Reporter) -> Vec<Hem> {
    let stage = reporter.stage("walls", 0);
    let border = |tile: &Tile| {
        let plan = partition.cells[tile.cell as usize].plan;
        // Skirts and heights make a tile wider than its cell; the step doubles, so a little room is enough.
        let rounding_m = if config.write.compress {
            write::quantization_error_of(1.5 * plan.size().max_element() + 10.0)
        } else {
            F32_ROUNDING_M
        };
        match &tile.mesh {
            Some(mesh) => Border::of(&mesh.positions, mesh.faces.iter().copied(), plan, rounding_m),
            None => {
                let faces = tile.source.iter().flat_map(|r| r.clone()).map(|f| partition.mesh.faces[f]);
                Border::of(&partition.mesh.positions, faces, plan, rounding_m)
            }
        }
    };
    let borders: Vec<Border> = tree.tiles.par_iter().map(border).collect();
    let hems = hems(&borders, config.levels.skirts);
    let widest_m = hems.iter().map(|h| h.wall_m).fold(0.0, f64::max);
    let deepest_m = hems.iter().map(|h| h.skirt_m).fold(0.0, f64::max);
    let strips: usize = hems.iter().map(|h| h.strips.len()).sum();
    stage.finish(format!(
        "tiles side by side differ by up to {widest_m:.3} m, {strips} skirts up to {deepest_m:.3} m deep"
    ));
    hems
}

/// The first view should come at once, whatever the size of the city.
const LARGEST_ROOT_BYTES: u64 = 500_000;
/// A tile above this takes too long to come, bytes.
const LARGEST_TILE_BYTES: u64 = 1_500_000;

/// Says what the tree does not keep.
fn warn_of(root: &TileEntry, config: &Config, out: &Path, reporter: &Reporter) {
    if root.bytes > LARGEST_ROOT_BYTES {
        let what = format!(
            "the root has {} kB, 500 kB were wanted; lower levels.root_faces or texture.root_atlas_px",
            root.bytes / 1000
        );
        reporter.warn("heavy-root", out, what);
    }
    let mut open = vec![root];
    let (mut heavy, mut worst) = (0, 0);
    while let Some(tile) = open.pop() {
        open.extend(&tile.children);
        if tile.bytes > LARGEST_TILE_BYTES {
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
        "up to {:.1} MB, 1.5 MB were wanted; lower levels.leaf_texels or levels.leaf_faces",
        worst as f64 / 1e6
    );
    reporter.warn_many("heavy-tiles", out, heavy, what);
}

/// What is known of a tile once it is on disk.
struct Written {
    uri: String,
    bytes: u64,
    bounds: Aabb,
    geometry_m: f64,
    texel_m: f64,
    triangles: usize,
    skirt_triangles: usize,
    wall_m: f64,
    skirt_m: f64,
    classes: Vec<ClassDeviation>,
}

fn write_tiles(
    tree: &TileTree,
    hems: &[Hem],
    maker: &Maker,
    config: &Config,
    output: &Output,
    reporter: &Reporter,
) -> Result<Vec<Written>> {
    let stage = reporter.stage("tiles", tree.tiles.len() as u64);
    let options =
        GlbOptions { compress: config.write.compress, primitives_per_class: config.write.primitives_per_class };
    // The heaviest first: the root needs the whole source and would otherwise run alone at the end.
    let mut order: Vec<usize> = (0..tree.tiles.len()).collect();
    let weight = |t: &usize| tree.tiles[*t].source.iter().map(|r| r.len()).sum::<usize>();
    order.sort_by_key(|t| (std::cmp::Reverse(weight(t)), *t));
    let next = std::sync::atomic::AtomicUsize::new(0);
    let work = |_| -> Result<Vec<(usize, Written)>> {
        let mut done = Vec::new();
        while let Some(&t) = order.get(next.fetch_add(1, std::sync::atomic::Ordering::Relaxed)) {
            reporter.check()?;
            done.push((t, write_tile((&tree.tiles[t], &hems[t]), maker, &config.classes, &options, output)?));
            stage.step(1);
        }
        Ok(done)
    };
    let threads = rayon::current_num_threads();
    let done: Result<Vec<Vec<(usize, Written)>>> = (0..threads).into_par_iter().with_max_len(1).map(work).collect();
    let mut done: Vec<(usize, Written)> = done?.into_iter().flatten().collect();
    done.sort_by_key(|d| d.0);
    let bytes: u64 = done.iter().map(|d| d.1.bytes).sum();
    stage.finish(format!("{} tiles, {:.1} MB", done.len(), bytes as f64 / 1e6));
    Ok(done.into_iter().map(|d| d.1).collect())
}

fn write_tile(
    (tile, hem): (&Tile, &Hem),
    maker: &Maker,
    scheme: &ClassScheme,
    options: &GlbOptions,
    output: &Output,
) -> Result<Written> {
    let made = maker.make(tile, hem)?;
    // Rounding to the compressed grid is an error like any other.
    let rounding_m = if options.compress { write::quantization_error_m(&made.content) } else { 0.0 };
    let uri = format!("tiles/{}/{}.glb", tile.level, maker.partition.key(tile.cell));
    let glb = write::glb(&made.content, scheme, options);
    output.write(&uri, &glb)?;
    let outward = DVec3::splat(rounding_m);
    let rounded = |c: ClassDeviation| ClassDeviation {
        bound_m: c.bound_m + rounding_m,
        inside_m: c.inside_m + rounding_m,
        sunk_m: c.sunk_m + rounding_m,
        ..c
    };
    Ok(Written {
        uri,
        bytes: glb.len() as u64,
        bounds: Aabb { min: made.bounds.min - outward, max: made.bounds.max + outward },
        geometry_m: made.geometry_m + rounding_m,
        texel_m: made.texel_m,
        triangles: made.triangles,
        skirt_triangles: made.skirt_triangles,
        wall_m: hem.wall_m,
        skirt_m: hem.skirt_m,
        classes: made.classes.into_iter().map(rounded).collect(),
    })
}

/// The tree as it is written: boxes hold their children's, errors never fall towards the root.
fn entry(tree: &TileTree, at: usize, written: &[Written], scheme: &ClassScheme, texel_factor: f64) -> TileEntry {
    let (tile, made) = (&tree.tiles[at], &written[at]);
    let children: Vec<TileEntry> =
        tile.children.iter().map(|&c| entry(tree, c as usize, written, scheme, texel_factor)).collect();
    let of_children = children.iter().map(|c| c.geometric_error_m).fold(0.0, f64::max);
    // A leaf is the source, texels and all: only what rounding did to it counts.
    let own = if tile.mesh.is_some() { made.geometry_m.max(texel_factor * made.texel_m) } else { made.geometry_m };
    // The scale at which the certified bounds are within their budgets, whatever the collapse was allowed.
    let own_scale = made.classes.iter().map(|d| d.bound_m / scheme[d.class].budget_m).fold(0.0, f64::max);
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
    TileEntry {
        uri: made.uri.clone(),
        box_local: children.iter().fold(made.bounds, |b, c| b.union(c.box_local)),
        geometric_error_m: own.max(of_children),
        geometry_m: made.geometry_m,
        texel_m: made.texel_m,
        scale,
        wall_m: made.wall_m,
        skirt_m: made.skirt_m,
        triangles: made.triangles as u64,
        skirt_triangles: made.skirt_triangles as u64,
        bytes: made.bytes,
        classes: made.classes.iter().map(class_error).collect(),
        level: tile.level,
        children,
    }
}

fn credits(source: &Source, added: &str) -> Option<String> {
    let mut all: Vec<&str> =
        source.copyright.iter().map(|c| c.trim()).chain([added.trim()]).filter(|c| !c.is_empty()).collect();
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
