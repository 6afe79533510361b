//! Brings an input of any size into leaf cells on disk, one file at a time.
//!
//! In: a [`Feed`]. Out: a [`City`]; each leaf's part of the surface is a page of the store.
//!
//! # Method
//! 1. *Scan*: files are read one by one (a few at a time where they are small), their bounds taken, their surface
//!    spilled. Materials and images are kept, images as paths.
//! 2. *Gate*: every file is placed in the local frame, welded and cleaned by itself.
//! 3. *Census*: the weight of all faces in plan gives the quadtree.
//! 4. *Cut*: every file is cut at the cells' walls into buckets, one for each leaf.
//! 5. *Join*: buckets become meshes, see [`super::join`].
//!
//! # Limits
//! The largest single file has to fit into memory, at about 150 bytes a triangle.

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::front::{gate_line, refuse_extent, surface_bounds};
use super::join::{Buckets, Joiner};
use super::{Job, Resources};
use crate::geo::{Aabb, Frame, Rect};
use crate::input::discover::Found;
use crate::input::{self, ImageRef, InputConfig, Material, Part, Source};
use crate::mesh::{self, GateReport, Mesh};
use crate::report::Reporter;
use crate::store::Store;
use crate::texture::{Images, texels_of};
use crate::tiles::partition::SNAP_M;
use crate::tiles::{CellTree, Census};
use crate::{Error, Result};

/// Where the source comes from.
pub enum Feed {
    /// All of it is there.
    Memory(Source),
    /// It is read file by file.
    Files(Found, InputConfig),
}

/// What is known of the whole while its surface is in the store.
pub(super) struct City {
    pub tree: CellTree,
    pub leaves: Vec<Leaf>,
    pub materials: Vec<Material>,
    pub images: Vec<ImageRef>,
    pub copyright: Vec<String>,
    pub frame: Frame,
    pub gate: GateReport,
    /// Furthest that welding and snapping moved a vertex, metres.
    pub moved_m: f64,
    /// Lowest z, metres.
    pub floor_m: f64,
}

/// A leaf cell that has faces.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(super) struct Leaf {
    pub cell: u32,
    pub faces: usize,
}

/// What a finished ingest leaves beside the leaves' pages.
#[derive(Serialize, Deserialize)]
struct Finished {
    tree: CellTree,
    leaves: Vec<Leaf>,
    gate: GateReport,
    moved_m: f64,
    floor_m: f64,
}

const FINISHED: &str = "ingest.json";
/// What a face of a leaf takes in its file, vertices and skirts included: 23 to 29 bytes on a real scan and the demo
/// quarter, a third of it when compressed.
const FACE_BYTES: f64 = 27.0;
const COMPRESSED_FACE_BYTES: f64 = 9.0;
/// And a texel that it uses: 0.25 to 0.38 bytes of JPEG for each of the atlas, of which gutters and gaps are up to a
/// quarter. A leaf copies its texels as they are, so one that is too heavy can only be split.
const TEXEL_BYTES: f64 = 0.5;
/// Faces cut at a time.
const CUT_FACES: usize = 1 << 18;
/// Images inside containers stay in memory up to this many bytes; beyond it they become files.
const MOST_ENCODED_BYTES: usize = 64 << 20;

/// Reads all of the feed into the store, or finds that a run before did.
pub(super) fn ingest(feed: Feed, job: &Job, resources: &Resources, store: &Store, reporter: &Reporter) -> Result<City> {
    let known: Option<Finished> = store.read_file(FINISHED)?.and_then(|bytes| serde_json::from_slice(&bytes).ok());
    let mut scan = Scan::new(store, known.is_none());
    match feed {
        Feed::Memory(source) => scan.add(source, true)?,
        Feed::Files(found, config) => {
            let stage = reporter.stage("input", found.files.len() as u64);
            let alone = found.files.len() == 1;
            input::read_each(&found, &config, resources.memory / 8, reporter, |source| {
                stage.step(1);
                scan.add(source, alone)
            })?;
            scan.all.share_images();
            let images = scan.all.images.len();
            stage.finish(format!("{} files, {} triangles, {images} images", found.files.len(), scan.triangles));
        }
    }
    let frame = scan.frame(job, reporter)?;
    let finished = match known {
        Some(finished) => finished,
        None => scan.finish(&frame, job, resources, reporter)?,
    };
    finished.gate.say(&scan.name, reporter)?;
    let Finished { tree, leaves, gate, moved_m, floor_m } = finished;
    let Source { materials, images, copyright, .. } = scan.all;
    Ok(City { tree, leaves, materials, images, copyright, frame, gate, moved_m, floor_m })
}

/// Files as they are seen for the first time.
struct Scan<'a> {
    store: &'a Store,
    /// Surfaces are wanted, not just what is said about them.
    spills: bool,
    /// Everything but parts.
    all: Source,
    name: std::path::PathBuf,
    bounds: Aabb,
    triangles: usize,
    units: u32,
    encoded_bytes: usize,
    held: Option<Vec<Part>>,
}

impl<'a> Scan<'a> {
    fn new(store: &'a Store, spills: bool) -> Self {
        Self {
            store,
            spills,
            all: Source::default(),
            name: Default::default(),
            bounds: Aabb::EMPTY,
            triangles: 0,
            units: 0,
            encoded_bytes: 0,
            held: None,
        }
    }

    fn add(&mut self, mut source: Source, alone: bool) -> Result<()> {
        for image in &mut source.images {
            if let ImageRef::Encoded { bytes, .. } = image {
                self.encoded_bytes += bytes.len();
                if self.encoded_bytes > MOST_ENCODED_BYTES {
                    let name = format!("image/{}", blake3::hash(bytes).to_hex());
                    if !self.store.has(&name) {
                        self.store.write_file(&name, bytes)?;
                    }
                    *image = ImageRef::File(self.store.path(&name));
                }
            }
        }
        self.all.append(source)?;
        let parts = std::mem::take(&mut self.all.parts);
        if let (0, Some(first)) = (self.units, parts.first()) {
            self.name.clone_from(&first.path);
        }
        self.bounds = self.bounds.union(surface_bounds(&parts));
        self.triangles += parts.iter().map(|p| p.faces.len()).sum::<usize>();
        if self.spills {
            if alone {
                self.held = Some(parts);
            } else {
                spill(self.store, self.units, &parts)?;
            }
        }
        self.units += 1;
        Ok(())
    }

    fn frame(&self, job: &Job, reporter: &Reporter) -> Result<Frame> {
        let stage = reporter.stage("frame", 0);
        if self.bounds.is_empty() {
            return Err(Error::input(&self.name, "no vertex has finite coordinates; nothing to build"));
        }
        let anchor = self.bounds.center().with_z(self.bounds.min.z).round();
        let frame = Frame::of(job.georeference.clone(), anchor)?;
        frame.warn(reporter, &self.name);
        let size = self.bounds.size();
        stage.finish(format!("{:.0} × {:.0} × {:.0} units, {}", size.x, size.y, size.z, frame.describe()));
        Ok(frame)
    }

    /// Gate, census, cut and join.
    fn finish(&mut self, frame: &Frame, job: &Job, resources: &Resources, reporter: &Reporter) -> Result<Finished> {
        let stage = reporter.stage("mesh", u64::from(self.units));
        let mut units = Units { store: self.store, held: None, count: self.units };
        let mut gate = GateReport::default();
        let mut bounds = Aabb::EMPTY;
        for unit in 0..self.units {
            reporter.check()?;
            let mut parts = match self.held.take() {
                Some(parts) => parts,
                None => unspill(self.store, unit)?,
            };
            for part in &mut parts {
                frame.locals_from_sources(&part.path, &mut part.positions)?;
            }
            refuse_extent(&self.name, &self.bounds, &surface_bounds(&parts).union(bounds))?;
            let source = Source { parts, ..Source::default() };
            let (mesh, report) = mesh::gate_unit(source, &job.config.gate, reporter)?;
            bounds = bounds.union(Aabb::of(mesh.positions.iter().copied()));
            gate.add(&report);
            units.put(unit, mesh)?;
            stage.step(1);
        }
        if gate.faces == 0 {
            gate.say(&self.name, reporter)?;
        }
        stage.finish(gate_line(&gate));
        self.cut(units, bounds, gate, job, resources, reporter)
    }

    fn cut(
        &self,
        mut units: Units,
        bounds: Aabb,
        gate: GateReport,
        job: &Job,
        resources: &Resources,
        reporter: &Reporter,
    ) -> Result<Finished> {
        let stage = reporter.stage("cells", u64::from(units.count));
        // Unreadable images are told of later, once.
        let silent = Reporter::new(true);
        let images = Images::new(self.all.images.clone(), &silent);
        let levels = &job.config.levels;
        let face_bytes = if job.config.write.compress { COMPRESSED_FACE_BYTES } else { FACE_BYTES };
        let mut census = Census::over(bounds.plan());
        for unit in 0..units.count {
            let mesh = units.take(unit)?;
            // A leaf is full when its faces are, or its texels, or its file.
            let weight = |f: usize| {
                let texels = self.texels(&mesh, f, &images);
                let bytes = face_bytes + TEXEL_BYTES * texels;
                let by_count = (1.0 / levels.leaf_faces as f64).max(texels / levels.leaf_texels as f64);
                by_count.max(bytes / job.config.write.tile_bytes as f64)
            };
            census.count(&mesh, weight);
            units.keep(mesh);
        }
        drop(images);
        let tree = CellTree::of(census, 1.0);
        let mut buckets = Buckets::new(self.store, resources.memory / 8);
        let mut snapped_m = 0f64;
        // A border of one file that lies on a wall is seen by no cell together with another's just beyond it.
        let near_m = if units.count > 1 { SNAP_M.max(job.config.gate.weld_m) } else { SNAP_M };
        for unit in 0..units.count {
            let mut mesh = units.take(unit)?;
            snapped_m = snapped_m.max(tree.snap(&mut mesh, near_m));
            let mut first = 0;
            while first < mesh.faces.len() {
                reporter.check()?;
                let end = (first + CUT_FACES).min(mesh.faces.len());
                for (leaf, soup) in tree.cut(&mesh, first..end) {
                    buckets.add(leaf, unit, soup)?;
                }
                first = end;
            }
            units.remove(unit);
            stage.step(1);
        }
        let joined =
            Joiner { store: self.store, tree: &tree, weld_m: job.config.gate.weld_m }.join(buckets, reporter)?;
        let faces: usize = joined.leaves.iter().map(|l| l.faces).sum();
        let moved_m = gate.moved_m + snapped_m + joined.moved_m;
        stage.finish(format!(
            "{} leaves in {} levels, {} → {faces} triangles along their walls, {} welded between files",
            joined.leaves.len(),
            tree.depth() + 1,
            gate.faces,
            joined.joined
        ));
        let gate = GateReport {
            duplicate: gate.duplicate + joined.duplicate,
            joined: joined.joined,
            unmatched_m: joined.unmatched_m,
            moved_m: gate.moved_m.max(joined.moved_m),
            ..gate
        };
        let finished = Finished { tree, leaves: joined.leaves, gate, moved_m, floor_m: bounds.min.z };
        let bytes = serde_json::to_vec(&finished).map_err(|e| Error::Bug(format!("ingest: {e}")))?;
        self.store.write_file(FINISHED, &bytes)?;
        Ok(finished)
    }

    fn texels(&self, mesh: &Mesh, f: usize, images: &Images) -> f64 {
        let image = self.all.materials.get(mesh.face_material[f] as usize).and_then(|m| m.image);
        match (mesh.corner_uvs.get(f), image) {
            (Some(uvs), Some(image)) => texels_of(uvs, images.dimensions(image)),
            _ => 0.0,
        }
    }
}

fn spill(store: &Store, unit: u32, parts: &[Part]) -> Result<()> {
    let mut page = store.page(&format!("raw/{unit}"))?;
    page.put(&[parts.len() as u64])?;
    for part in parts {
        page.put(part.path.to_string_lossy().as_bytes())?;
        page.put(&part.positions)?;
        page.put(&part.faces)?;
        page.put(&part.corner_uvs)?;
        page.put(&part.face_material)?;
        page.put(&part.vertex_colors)?;
        page.put(&part.face_labels)?;
    }
    page.finish()
}

fn unspill(store: &Store, unit: u32) -> Result<Vec<Part>> {
    let name = format!("raw/{unit}");
    let mut page = store.read(&name)?;
    let count = page.take::<u64>()?.first().copied().unwrap_or(0);
    let mut parts = Vec::new();
    for _ in 0..count {
        parts.push(Part {
            path: String::from_utf8_lossy(&page.take::<u8>()?).into_owned().into(),
            positions: page.take()?,
            faces: page.take()?,
            corner_uvs: page.take()?,
            face_material: page.take()?,
            vertex_colors: page.take()?,
            face_labels: page.take()?,
        });
    }
    page.finish()?;
    store.remove(&name);
    Ok(parts)
}

/// The gated meshes of all files: in memory where there is one, else in the store.
struct Units<'a> {
    store: &'a Store,
    held: Option<Mesh>,
    count: u32,
}

impl Units<'_> {
    fn put(&mut self, unit: u32, mesh: Mesh) -> Result<()> {
        if self.count > 1 {
            return put_mesh(self.store, &format!("unit/{unit}"), &mesh);
        }
        self.held = Some(mesh);
        Ok(())
    }

    fn take(&mut self, unit: u32) -> Result<Mesh> {
        match self.held.take() {
            Some(mesh) => Ok(mesh),
            None => take_mesh(self.store, &format!("unit/{unit}")),
        }
    }

    fn keep(&mut self, mesh: Mesh) {
        if self.count == 1 {
            self.held = Some(mesh);
        }
    }

    fn remove(&self, unit: u32) {
        self.store.remove(&format!("unit/{unit}"));
    }
}

/// Writes a mesh, materials aside.
pub(super) fn put_mesh(store: &Store, name: &str, mesh: &Mesh) -> Result<()> {
    let mut page = store.page(name)?;
    page.put(&mesh.positions)?;
    page.put(&mesh.faces)?;
    page.put(&mesh.corner_uvs)?;
    page.put(&mesh.face_material)?;
    page.put(&mesh.vertex_colors)?;
    page.put(&mesh.face_labels)?;
    page.finish()
}

pub(super) fn take_mesh(store: &Store, name: &str) -> Result<Mesh> {
    let mut page = store.read(name)?;
    let mesh = Mesh {
        positions: page.take()?,
        faces: page.take()?,
        corner_uvs: page.take()?,
        face_material: page.take()?,
        vertex_colors: page.take()?,
        face_labels: page.take()?,
        materials: Vec::new(),
    };
    page.finish()?;
    Ok(mesh)
}

/// The source in a leaf, as it was cut.
pub(super) fn leaf_mesh(store: &Store, cell: u32) -> Result<Mesh> {
    take_mesh(store, &format!("source/{cell}"))
}

/// Distance between two rectangles in plan, metres; 0 where they touch.
pub(super) fn gap(a: &Rect, b: &Rect) -> f64 {
    (a.min - b.max).max(b.min - a.max).max(DVec2::ZERO).length()
}
