//! Makes the tree of tiles from the leaves up: collapses to a level, writes its tiles, goes on to the next.
//!
//! In: a [`City`] whose leaves have labels. Out: [`Node`]s, the root last, each with its content in the store.
//!
//! # Method
//! A tile is measured against the source below it and painted from it, as long as that has at most
//! [`LevelsConfig::reference_faces`](crate::tiles::LevelsConfig); a larger one against the finest tiles below it that together have no more. So no tile needs more
//! than a fixed amount of memory, and its error is at most a few finer tiles' errors too large.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::ingest::{City, leaf_mesh};
use super::labels::leaf_labels;
use super::steps::Steps;
use super::{Job, Resources};
use crate::geo::Aabb;
use crate::ids::ClassId;
use crate::input::{ImageRef, Material};
use crate::report::{Reporter, Stage};
use crate::store::Store;
use crate::texture::Images;
use crate::tiles::TileMesh;
use crate::tiles::content::{ClassDeviation, MadeTile, Maker, Reference};
use crate::tiles::levels::{FIRST_TOLERANCE_EDGES, LEAST_REDUCTION, MOST_EXTRA_ROOTS, Progress};
use crate::write::{self, GlbOptions};
use crate::{Error, Result};

/// Memory one tile in the making takes at most, about, bytes; a leaf takes a third of it.
const TILE_BYTES: u64 = 450_000_000;

/// A tile of the tree.
pub(super) struct Node {
    pub cell: u32,
    /// Scale t of its cut; 0 for a leaf.
    pub scale: f64,
    pub children: Vec<u32>,
    pub record: Record,
    /// Faces of the source it stands for.
    source_faces: u64,
}

impl Node {
    /// True for a tile that shows the source.
    pub fn is_leaf(&self) -> bool {
        self.scale == 0.0
    }
}

/// What is known of a tile whose content is in the store.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct Record {
    pub bytes: u64,
    pub bounds: Aabb,
    pub geometry_m: f64,
    pub texel_m: f64,
    pub triangles: usize,
    pub classes: Vec<ClassDeviation>,
    /// Of a leaf: images it uses that cannot be read, and what to say of them.
    pub faults: BTreeMap<u32, String>,
}

/// The name of a tile's content in the store.
pub(super) fn content_name(tile: usize) -> String {
    format!("tile/{tile}.glb")
}

/// A tile, the surface it was made of if that is not the source, and images it could not read.
type Made<'m> = (MadeTile, Option<&'m TileMesh>, BTreeMap<u32, String>);

/// Makes all tiles.
pub(super) struct Hierarchy<'a> {
    pub city: &'a City,
    pub job: &'a Job<'a>,
    pub store: &'a Store,
    pub reporter: &'a Reporter,
    pub maker: Maker<'a>,
    pub images: &'a Images<'a>,
    pub memory: u64,
    pub nodes: Vec<Node>,
    /// Tiles that stand for each cell so far: one, or none.
    of_cell: Vec<Option<u32>>,
    /// Time that steps took, the tiles between them aside.
    collapsing: Duration,
}

/// An inner tile to be made.
struct Plan {
    cell: u32,
    mesh: TileMesh,
    children: Vec<u32>,
    is_root: bool,
}

impl<'a> Hierarchy<'a> {
    pub fn new(
        city: &'a City,
        job: &'a Job,
        store: &'a Store,
        images: &'a Images<'a>,
        copyright: Option<&'a str>,
        resources: &Resources,
        reporter: &'a Reporter,
    ) -> Self {
        let config = job.config;
        let maker = Maker {
            scheme: &config.classes,
            texture: &config.texture,
            texel_factor: config.write.texel_factor,
            copyright,
            normals: config.write.normals,
            moved_m: city.moved_m,
        };
        let of_cell = vec![None; city.tree.0.len()];
        Self {
            city,
            job,
            store,
            reporter,
            maker,
            images,
            memory: resources.memory,
            nodes: Vec::new(),
            of_cell,
            collapsing: Duration::ZERO,
        }
    }

    /// Leaves, then level after level up to the root.
    pub fn make(&mut self, median_edge_m: f64) -> Result<()> {
        let inner = self.inner_cells();
        let began = Instant::now();
        let stage = self.reporter.stage("tiles", (self.city.leaves.len() + inner) as u64);
        self.make_leaves(&stage)?;
        let levels = &self.job.config.levels;
        let (city, config, store) = (self.city, self.job.config, self.store);
        let mut steps = Steps::new(city, config, store, self.reporter)?;
        let loosest = config.classes.0.iter().map(|c| c.budget_m).fold(f64::MIN_POSITIVE, f64::max);
        let mut scale = median_edge_m.max(1e-3) * FIRST_TOLERANCE_EDGES / loosest;
        let mut last_m = 0.0;
        for depth in (0..city.tree.depth()).rev() {
            let merging = Instant::now();
            steps.merge(depth, scale)?;
            self.collapsing += merging.elapsed();
            last_m = self.collapse(&mut steps, &mut scale, depth, levels.tile_faces)?;
            if depth > 0 {
                self.make_level(&steps, depth, last_m, &stage)?;
            }
        }
        self.make_roots(&mut steps, scale, last_m, &stage)?;
        let (count, collapses) = (steps.count(), steps.collapses);
        let bytes: u64 = self.nodes.iter().map(|n| n.record.bytes).sum();
        let (seconds, all) = (self.collapsing.as_secs_f64(), began.elapsed().as_secs_f64());
        let scale = self.nodes.last().map_or(0.0, |n| n.scale);
        let collapse = self.reporter.stage("collapse", 0);
        collapse.finish_after(seconds, format!("{collapses} collapses in {count} steps to scale {scale:.2}"));
        let summary = format!("{} tiles, {:.1} MB", self.nodes.len(), bytes as f64 / 1e6);
        stage.finish_after(all - seconds, summary);
        Ok(())
    }

    /// Cells above the leaves that have a surface.
    fn inner_cells(&self) -> usize {
        let tree = &self.city.tree;
        let mut seen = vec![false; tree.0.len()];
        for leaf in &self.city.leaves {
            let mut at = leaf.cell;
            while tree.0[at as usize].depth > 0 && !seen[tree.0[at as usize].parent as usize] {
                at = tree.0[at as usize].parent;
                seen[at as usize] = true;
            }
        }
        seen.iter().filter(|s| **s).count()
    }

    /// Steps on until no inner cell of `depth` has more than `most` faces and the level is worth having; returns the
    /// last scale.
    fn collapse(&mut self, steps: &mut Steps, scale: &mut f64, depth: u8, most: usize) -> Result<f64> {
        let tree = &self.city.tree;
        let mut progress = Progress::new(steps.faces(), most);
        loop {
            self.reporter.check()?;
            let (last, began) = (*scale, Instant::now());
            steps.step(last, depth)?;
            self.collapsing += began.elapsed();
            *scale *= self.job.config.levels.step_ratio;
            let inner = steps.cells().filter(|(cell, _)| tree.0[*cell as usize].children.is_some());
            let heaviest = inner.map(|(_, faces)| faces as usize).max().unwrap_or(0);
            if progress.is_done(steps.faces(), heaviest) {
                return Ok(last);
            }
        }
    }

    fn make_leaves(&mut self, stage: &Stage) -> Result<()> {
        let leaves = &self.city.leaves;
        let records = self.in_parallel(leaves.len(), TILE_BYTES / 3, |i| {
            let record = self.once(i, || {
                let source = self.leaf(leaves[i].cell)?;
                let view = self.view(&source, Vec::new());
                let made = self.maker.make_leaf(&source, &view)?;
                Ok((made, None, self.faults(&source)))
            });
            stage.step(1);
            record
        })?;
        for (leaf, record) in leaves.iter().zip(records) {
            let (cell, source_faces) = (leaf.cell, leaf.faces as u64);
            self.add(Node { cell, scale: 0.0, children: Vec::new(), record, source_faces });
        }
        Ok(())
    }

    fn add(&mut self, node: Node) {
        self.of_cell[node.cell as usize] = Some(self.nodes.len() as u32);
        self.nodes.push(node);
    }

    fn make_level(&mut self, steps: &Steps, depth: u8, scale: f64, stage: &Stage) -> Result<()> {
        let tree = &self.city.tree;
        let cells: Vec<u32> = steps
            .cells()
            .map(|(cell, _)| cell)
            .filter(|&c| tree.0[c as usize].depth == depth && tree.0[c as usize].children.is_some())
            .collect();
        let first = self.nodes.len();
        let made = self.in_parallel(cells.len(), TILE_BYTES, |i| {
            let plan = self.plan(steps, cells[i])?;
            let record = self.make_tile(first + i, &plan)?;
            stage.step(1);
            Ok((plan.children, record))
        })?;
        for (cell, (children, record)) in cells.into_iter().zip(made) {
            self.add_inner(cell, scale, children, record);
        }
        Ok(())
    }

    fn add_inner(&mut self, cell: u32, scale: f64, children: Vec<u32>, record: Record) {
        let source_faces = children.iter().map(|&c| self.nodes[c as usize].source_faces).sum();
        self.add(Node { cell, scale, children, record, source_faces });
    }

    /// The tile of a cell as it is after the last step, above the tiles that stand for the cells below.
    fn plan(&self, steps: &Steps, cell: u32) -> Result<Plan> {
        let patch = steps.patch(cell)?;
        let below = self.city.tree.0[cell as usize].children.into_iter().flatten();
        let children = below.filter_map(|c| self.of_cell[c as usize]).collect();
        let mesh = TileMesh { positions: patch.positions, faces: patch.faces, labels: patch.labels };
        Ok(Plan { cell, mesh, children, is_root: false })
    }

    /// The root, and lighter ones on top of it while it is heavy and they are lighter: the last of them is kept small.
    fn make_roots(&mut self, steps: &mut Steps, mut scale: f64, last_m: f64, stage: &Stage) -> Result<()> {
        let most = self.job.config.levels.root_faces;
        let is_leaf = self.city.tree.0[0].children.is_none();
        let mut waiting = if is_leaf { None } else { Some((self.plan(steps, 0)?, last_m)) };
        let mut faces = match &waiting {
            Some((plan, _)) => plan.mesh.faces.len(),
            None => self.city.leaves.iter().map(|l| l.faces).sum(),
        };
        for _ in 0..MOST_EXTRA_ROOTS {
            if faces <= most {
                break;
            }
            let before = steps.faces();
            let at = self.collapse(steps, &mut scale, 0, most)?;
            if steps.faces() as f64 > before as f64 * (1.0 - LEAST_REDUCTION) {
                break;
            }
            if let Some((plan, scale)) = waiting.take() {
                self.make_root(plan, scale, stage)?;
            }
            let own = self.of_cell[0].into_iter().collect();
            let plan = Plan { children: own, ..self.plan(steps, 0)? };
            faces = plan.mesh.faces.len();
            waiting = Some((plan, at));
        }
        if let Some((plan, scale)) = waiting {
            self.make_root(Plan { is_root: true, ..plan }, scale, stage)?;
        }
        Ok(())
    }

    fn make_root(&mut self, plan: Plan, scale: f64, stage: &Stage) -> Result<()> {
        let record = self.make_tile(self.nodes.len(), &plan)?;
        self.add_inner(plan.cell, scale, plan.children, record);
        stage.step(1);
        Ok(())
    }

    fn make_tile(&self, tile: usize, plan: &Plan) -> Result<Record> {
        self.once(tile, || {
            let (source, images) = self.reference(&plan.children)?;
            let view = self.view(&source, images);
            let made = self.maker.make_inner(&plan.mesh, plan.is_root, &source, &view)?;
            Ok((made, Some(&plan.mesh), BTreeMap::new()))
        })
    }

    /// Unreadable images that a leaf uses. Its making decoded them all, so this depends on nothing else.
    fn faults(&self, source: &Reference) -> BTreeMap<u32, String> {
        let material = |m: &u32| source.materials.get(*m as usize).and_then(|m| m.image);
        let used: BTreeSet<u32> = source.face_material.iter().filter_map(material).collect();
        self.images.faults().into_iter().filter(|(image, _)| used.contains(image)).collect()
    }

    /// Images of a surface: the input's, and `more`.
    fn view(&self, source: &Reference, more: Vec<ImageRef>) -> Images<'_> {
        let threads = rayon::current_num_threads() as u64;
        let mut view = self.images.view(more, (self.memory / (8 * threads)).clamp(16 << 20, 256 << 20));
        view.cover(&source.surface());
        view
    }

    /// Makes a tile and writes it, unless a run before did.
    fn once<'m>(&self, tile: usize, make: impl FnOnce() -> Result<Made<'m>>) -> Result<Record> {
        self.reporter.check()?;
        let name = format!("tile/{tile}.json");
        if let Some(record) = self.store.read_file(&name)?.and_then(|bytes| serde_json::from_slice(&bytes).ok()) {
            return Ok(record);
        }
        let (made, mesh, faults) = make()?;
        let options = GlbOptions {
            compress: self.job.config.write.compress,
            primitives_per_class: self.job.config.write.primitives_per_class,
        };
        // Rounding to the compressed grid is an error like any other.
        let rounding_m = if options.compress { write::quantization_error_m(&made.content) } else { 0.0 };
        let glb = write::glb(&made.content, &self.job.config.classes, &options);
        self.store.write_file(&content_name(tile), &glb)?;
        if let Some(mesh) = mesh {
            self.write_surface(tile, mesh, &made)?;
        }
        let outward = glam::DVec3::splat(rounding_m);
        let record = Record {
            bytes: glb.len() as u64,
            bounds: Aabb { min: made.bounds.min - outward, max: made.bounds.max + outward },
            geometry_m: made.geometry_m + rounding_m,
            texel_m: made.texel_m,
            triangles: made.triangles,
            classes: made.classes,
            faults,
        };
        let bytes = serde_json::to_vec(&record).map_err(|e| Error::Bug(format!("tile: {e}")))?;
        self.store.write_file(&name, &bytes)?;
        Ok(record)
    }

    /// Keeps what a tile further up may be measured against and painted from.
    fn write_surface(&self, tile: usize, mesh: &TileMesh, made: &MadeTile) -> Result<()> {
        let mut page = self.store.page(&format!("tile/{tile}.surface"))?;
        page.put(&mesh.positions)?;
        page.put(&mesh.faces)?;
        page.put(&mesh.labels.iter().map(|l| l.0).collect::<Vec<u8>>())?;
        page.put(&made.corner_uvs)?;
        page.put(&made.vertex_colors)?;
        page.put(made.content.atlas.as_deref().unwrap_or(&[]))?;
        page.finish()
    }

    /// The finest tiles below `children`, or they themselves, that have few enough faces together.
    fn frontier(&self, children: &[u32]) -> Vec<u32> {
        let faces = |tile: &u32| {
            let node = &self.nodes[*tile as usize];
            if node.is_leaf() { node.source_faces } else { node.record.triangles as u64 }
        };
        let most = self.job.config.levels.reference_faces as u64;
        let mut frontier = children.to_vec();
        loop {
            let finer: Vec<u32> = frontier
                .iter()
                .flat_map(|&t| match &self.nodes[t as usize] {
                    node if node.is_leaf() => vec![t],
                    node => node.children.clone(),
                })
                .collect();
            if finer == frontier || finer.iter().map(faces).sum::<u64>() > most {
                return frontier;
            }
            frontier = finer;
        }
    }

    /// What a tile above `children` is measured against, and the images it has beside the input's.
    fn reference(&self, children: &[u32]) -> Result<(Reference, Vec<ImageRef>)> {
        let frontier = self.frontier(children);
        let is_source = frontier.iter().all(|&t| self.nodes[t as usize].is_leaf());
        let mut all = Reference { materials: self.city.materials.clone(), ..Reference::default() };
        let mut images = Vec::new();
        if !is_source {
            all.error_m = vec![0.0; self.maker.scheme.len()];
        }
        for tile in frontier {
            let node = &self.nodes[tile as usize];
            for class in node.record.classes.iter().filter(|_| !is_source) {
                let error_m = &mut all.error_m[class.class.index()];
                *error_m = error_m.max(class.bound_m);
            }
            let part =
                if node.is_leaf() { self.leaf_part(node.cell)? } else { self.surface(tile, &mut all, &mut images)? };
            all.append(part);
        }
        Ok((all, images))
    }

    /// A leaf's source, with all materials.
    fn leaf(&self, cell: u32) -> Result<Reference> {
        Ok(Reference { materials: self.city.materials.clone(), ..self.leaf_part(cell)? })
    }

    fn leaf_part(&self, cell: u32) -> Result<Reference> {
        let mesh = leaf_mesh(self.store, cell)?;
        let (labels, _) = leaf_labels(self.store, cell)?;
        Ok(Reference {
            positions: mesh.positions,
            faces: mesh.faces,
            corner_uvs: mesh.corner_uvs,
            face_material: mesh.face_material,
            vertex_colors: mesh.vertex_colors,
            labels,
            ..Reference::default()
        })
    }

    /// An inner tile's surface; its atlas goes to `images`, and a material for it to `all`.
    fn surface(&self, tile: u32, all: &mut Reference, images: &mut Vec<ImageRef>) -> Result<Reference> {
        let mut page = self.store.read(&format!("tile/{tile}.surface"))?;
        let mut part = Reference {
            positions: page.take()?,
            faces: page.take()?,
            labels: page.take::<u8>()?.into_iter().map(ClassId).collect(),
            corner_uvs: page.take()?,
            vertex_colors: page.take()?,
            ..Reference::default()
        };
        let atlas = page.take::<u8>()?;
        page.finish()?;
        let image = (!atlas.is_empty()).then(|| {
            images.push(ImageRef::Encoded { name: format!("atlas of tile {tile}"), bytes: atlas.into() });
            (self.images.len() + images.len() - 1) as u32
        });
        let name = format!("tile {tile}");
        part.face_material = vec![all.materials.len() as u32; part.faces.len()];
        all.materials.push(Material { name, base_color: crate::input::DEFAULT_COLOR, image });
        Ok(part)
    }

    /// Makes `count` things, in order of index, as many at a time as threads and memory allow at `bytes` each.
    fn in_parallel<T: Send>(
        &self,
        count: usize,
        bytes: u64,
        make: impl Fn(usize) -> Result<T> + Sync,
    ) -> Result<Vec<T>> {
        let most = (self.memory / 2 / bytes).max(1) as usize;
        let workers = rayon::current_num_threads().min(most);
        let next = AtomicUsize::new(0);
        let work = |_| -> Result<Vec<(usize, T)>> {
            let mut done = Vec::new();
            loop {
                let i = next.fetch_add(1, Ordering::Relaxed);
                if i >= count {
                    return Ok(done);
                }
                done.push((i, make(i)?));
            }
        };
        let done: Result<Vec<_>> = (0..workers).into_par_iter().with_max_len(1).map(work).collect();
        let mut done: Vec<(usize, T)> = done?.into_iter().flatten().collect();
        done.sort_by_key(|d| d.0);
        Ok(done.into_iter().map(|d| d.1).collect())
    }
}
