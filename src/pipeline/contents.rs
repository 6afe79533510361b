//! Makes and writes the content of every tile, from the leaves up.
//!
//! In: [`Node`]s with their surfaces in the store, and the [`Hem`] of each. Out: a [`Record`] for each, its content in
//! the store.
//!
//! # Method
//! A tile is measured against the source below it and painted from it, as long as that has at most
//! [`LevelsConfig::reference_faces`](crate::tiles::LevelsConfig); a larger one against the finest tiles below it that
//! together have no more. So no tile needs more than a fixed amount of memory, and its error is at most a few finer
//! tiles' errors too large. All tiles of the first kind can be made at the same time, the others level by level.
//!
//! # Cost
//! Of a build of a town (3.0 million triangles, 462 images, one thread, 24 µs a triangle) the collapse takes 37 %, distances
//! 20 %, other parts of tiles (bakes, masks of used texels, JPEG, trees, leaves, GLB) 33 %, classes 6 %, ingest 4 %.
//! Every level is measured and painted from the source itself: finer tiles in its place would be cheaper, but what one
//! class lost there would count for all of them.
//! Of a scan (0.77 million triangles, 275 images) there are 18 bakes of 14 million texels, 17 million times that a source
//! face comes near a block of one, and 3 million source faces measured. To hold small source faces against each texel near
//! them instead of row by row took 0.997 of the time of a build.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::hierarchy::{Node, surface};
use super::ingest::{City, leaf_mesh};
use super::labels::leaf_labels;
use super::{Job, Resources, tops};
use crate::geo::Aabb;
use crate::input::{DEFAULT_COLOR, ImageRef, Material};
use crate::report::{Reporter, Stage};
use crate::store::Store;
use crate::texture::Images;
use crate::tiles::content::{Apart, ClassDeviation, Fit, MadeTile, Maker, Reference};
use crate::tiles::raise::Held;
use crate::tiles::skirt::Hem;
use crate::write::{self, GlbOptions, TileContent};
use crate::{Error, Result};

/// Memory one tile in the making takes at most, about, bytes; a leaf takes a third of it.
const TILE_BYTES: u64 = 450_000_000;

/// Texels up to this many times as large as those they were painted from are no coarser: charts that are laid anew, flat
/// where the source's were not, come out some tenth larger at the same wish.
const AS_SHARP: f64 = 1.25;

/// What is known of a tile whose content is in the store.
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct Record {
    pub bytes: u64,
    pub bounds: Aabb,
    pub geometry_m: f64,
    pub texel_m: f64,
    pub reference_texel_m: f64,
    pub triangles: usize,
    pub skirt_triangles: usize,
    pub classes: Vec<ClassDeviation>,
    /// Of a leaf: images it uses that cannot be read, and what to say of them.
    pub faults: BTreeMap<u32, String>,
}

impl Record {
    /// The error to be written if a viewer may see `texel_factor` pixels of it, metres: at the distance where a tile is
    /// exchanged its texels cover a pixel, if finer tiles have smaller ones. Those that have not show nothing more.
    pub fn error_m(&self, texel_factor: f64) -> f64 {
        let is_as_sharp = self.texel_m <= AS_SHARP * self.reference_texel_m;
        if is_as_sharp { self.geometry_m } else { self.geometry_m.max(texel_factor * self.texel_m) }
    }
}

/// The name of a tile's content in the store.
pub(super) fn content_name(tile: usize) -> String {
    format!("tile/{tile}.glb")
}

/// Makes all tiles.
pub(super) struct Contents<'a> {
    pub city: &'a City,
    pub job: &'a Job<'a>,
    pub store: &'a Store,
    pub reporter: &'a Reporter,
    pub images: &'a Images<'a>,
    pub resources: &'a Resources,
    pub nodes: &'a [Node],
    pub hems: &'a [Hem],
    pub copyright: Option<&'a str>,
}

impl Contents<'_> {
    /// One record a node, in their order.
    ///
    /// # Errors
    /// The disk, or a wish to stop.
    pub fn make(&self) -> Result<Vec<Record>> {
        let stage = self.reporter.stage("tiles", self.nodes.len() as u64);
        let mut records: Vec<Option<Record>> = vec![None; self.nodes.len()];
        // The heaviest first: it would otherwise run alone at the end.
        let mut order: Vec<usize> = (0..self.nodes.len()).collect();
        order.sort_by_key(|t| (std::cmp::Reverse(self.nodes[*t].source_faces), *t));
        let most = self.job.config.levels.reference_faces;
        let (above, below): (Vec<usize>, Vec<usize>) =
            order.into_iter().partition(|t| !self.nodes[*t].is_leaf() && self.nodes[*t].source_faces > most);
        let (leaves, inner): (Vec<usize>, Vec<usize>) = below.into_iter().partition(|t| self.nodes[*t].is_leaf());
        self.make_some(&inner, TILE_BYTES, &stage, &mut records)?;
        self.make_some(&leaves, TILE_BYTES / 3, &stage, &mut records)?;
        let mut levels: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        // Scales are positive, so their bits have their order.
        above.into_iter().for_each(|t| levels.entry(self.nodes[t].scale.to_bits()).or_default().push(t));
        for tiles in levels.values() {
            self.make_some(tiles, TILE_BYTES, &stage, &mut records)?;
        }
        let records: Vec<Record> = records.into_iter().flatten().collect();
        let bytes: u64 = records.iter().map(|r| r.bytes).sum();
        stage.finish(format!("{} tiles, {:.1} MB", records.len(), bytes as f64 / 1e6));
        Ok(records)
    }

    /// Makes tiles in the order given, as many at a time as threads and memory allow at `bytes` each.
    fn make_some(&self, tiles: &[usize], bytes: u64, stage: &Stage, records: &mut [Option<Record>]) -> Result<()> {
        let most = (self.resources.memory / 2 / bytes).max(1) as usize;
        let workers = rayon::current_num_threads().min(most);
        let next = AtomicUsize::new(0);
        let known: &[Option<Record>] = records;
        let work = |_| -> Result<Vec<(usize, Record)>> {
            let mut done = Vec::new();
            while let Some(&tile) = tiles.get(next.fetch_add(1, Ordering::Relaxed)) {
                done.push((tile, self.once(tile, known)?));
                stage.step(1);
            }
            Ok(done)
        };
        let done: Result<Vec<_>> = (0..workers).into_par_iter().with_max_len(1).map(work).collect();
        for (tile, record) in done?.into_iter().flatten() {
            records[tile] = Some(record);
        }
        Ok(())
    }

    /// Makes a tile and writes it, unless a run before did.
    fn once(&self, tile: usize, known: &[Option<Record>]) -> Result<Record> {
        self.reporter.check()?;
        let name = format!("tile/{tile}.json");
        if let Some(record) = self.store.read_file(&name)?.and_then(|bytes| serde_json::from_slice(&bytes).ok()) {
            return Ok(record);
        }
        let (made, file, faults) = self.made(tile, known)?;
        // Rounding to the compressed grid is an error like any other.
        let rounding_m = if self.job.config.write.compress { write::quantization_error_m(&made.content) } else { 0.0 };
        self.store.write_file(&content_name(tile), &file)?;
        if !self.nodes[tile].is_leaf() {
            self.write_paint(tile, &made)?;
        }
        let outward = DVec3::splat(rounding_m);
        let held = tops::held(self.store, tile)?;
        let moved_m = self.city.moved_m + made.rounding_m;
        let rounded = |c: ClassDeviation| {
            let c = raised(c, &held, moved_m);
            let [bound_m, inside_m, sunk_m] = [c.bound_m, c.inside_m, c.sunk_m].map(|m| m + rounding_m);
            ClassDeviation { bound_m, inside_m, sunk_m, ..c }
        };
        let classes: Vec<ClassDeviation> = made.classes.into_iter().map(rounded).collect();
        let worst_m = classes.iter().map(|c| c.bound_m).fold(made.geometry_m + rounding_m, f64::max);
        let record = Record {
            bytes: file.len() as u64,
            bounds: Aabb { min: made.bounds.min - outward, max: made.bounds.max + outward },
            geometry_m: worst_m,
            texel_m: made.texel_m,
            reference_texel_m: made.reference_texel_m,
            triangles: made.triangles,
            skirt_triangles: made.skirt_triangles,
            classes,
            faults,
        };
        let bytes = serde_json::to_vec(&record).map_err(|e| Error::Bug(format!("tile: {e}")))?;
        self.store.write_file(&name, &bytes)?;
        Ok(record)
    }

    /// A tile, its file, and images it could not read.
    fn made(&self, tile: usize, known: &[Option<Record>]) -> Result<(MadeTile, Vec<u8>, BTreeMap<u32, String>)> {
        let (node, hem, config) = (&self.nodes[tile], &self.hems[tile], self.job.config);
        let maker = Maker {
            scheme: &config.classes,
            texture: &config.texture,
            texel_factor: config.write.texel_factor,
            copyright: self.copyright,
            normals: config.write.normals,
            moved_m: self.city.moved_m,
        };
        let options =
            GlbOptions { compress: config.write.compress, primitives_per_class: config.write.primitives_per_class };
        let encode = |content: &TileContent| write::glb(content, &config.classes, &options);
        if node.is_leaf() {
            let source = Reference { materials: self.city.materials.clone(), ..self.leaf_part(node.cell)? };
            let made = maker.make_leaf(&source, hem, &self.view(&source, Vec::new()))?;
            let (file, faults) = (encode(&made.content), self.faults(&source));
            return Ok((made, file, faults));
        }
        let (source, images) = self.reference(&node.children, known)?;
        let mesh = surface(self.store, tile)?;
        // The first view is one tile: it is kept small.
        let is_root = tile + 1 == self.nodes.len();
        let (atlas_px, most_bytes) = if is_root {
            (config.texture.root_atlas_px, config.write.root_bytes)
        } else {
            (config.texture.coarse_atlas_px, config.write.tile_bytes)
        };
        let fit = Fit { atlas_px, most_bytes, encode: &encode };
        let (made, file) = maker.make_inner(&mesh, &source, hem, &self.view(&source, images), &fit)?;
        Ok((made, file, BTreeMap::new()))
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
        let mut view = self.images.view(more, (self.resources.memory / (8 * threads)).clamp(16 << 20, 256 << 20));
        view.cover(&source.surface());
        view
    }

    /// Keeps what a tile further up may be painted from.
    fn write_paint(&self, tile: usize, made: &MadeTile) -> Result<()> {
        let mut page = self.store.page(&format!("tile/{tile}.paint"))?;
        page.put(&made.corner_uvs)?;
        page.put(&made.vertex_colors)?;
        page.put(made.content.atlas.as_deref().unwrap_or(&[]))?;
        page.finish()
    }

    /// The finest tiles below `children`, or they themselves, that have few enough faces together.
    fn frontier(&self, children: &[u32]) -> Vec<u32> {
        let most = self.job.config.levels.reference_faces;
        let mut frontier = children.to_vec();
        loop {
            let finer: Vec<u32> = frontier
                .iter()
                .flat_map(|&t| match &self.nodes[t as usize] {
                    node if node.is_leaf() => vec![t],
                    node => node.children.clone(),
                })
                .collect();
            if finer == frontier || finer.iter().map(|&t| self.nodes[t as usize].faces).sum::<usize>() > most {
                return frontier;
            }
            frontier = finer;
        }
    }

    /// What a tile above `children` is measured against, and the images it has beside the input's.
    fn reference(&self, children: &[u32], known: &[Option<Record>]) -> Result<(Reference, Vec<ImageRef>)> {
        let mut frontier = self.frontier(children);
        let is_source = frontier.iter().all(|&t| self.nodes[t as usize].is_leaf());
        frontier.sort_unstable();
        let mut all = Reference { materials: self.city.materials.clone(), ..Reference::default() };
        let mut images = Vec::new();
        if !is_source {
            all.apart = vec![Apart::default(); self.job.config.classes.len()];
        }
        for tile in frontier {
            let node = &self.nodes[tile as usize];
            if !is_source {
                let Some(record) = &known[tile as usize] else {
                    return Err(Error::Bug(format!("tile {tile} is asked for before it is made")));
                };
                for class in &record.classes {
                    let apart = &mut all.apart[class.class.index()];
                    apart.bound_m = apart.bound_m.max(class.bound_m);
                    apart.inside_m = apart.inside_m.max(class.inside_m);
                    apart.sunk_m = apart.sunk_m.max(class.sunk_m);
                }
            }
            let part = if node.is_leaf() {
                self.leaf_part(node.cell)?
            } else {
                self.painted(tile as usize, &mut all, &mut images)?
            };
            all.append(part);
        }
        Ok((all, images))
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

    /// An inner tile as it was made; its atlas goes to `images`, and a material for it to `all`.
    fn painted(&self, tile: usize, all: &mut Reference, images: &mut Vec<ImageRef>) -> Result<Reference> {
        let mesh = surface(self.store, tile)?;
        let mut page = self.store.read(&format!("tile/{tile}.paint"))?;
        let mut part = Reference {
            positions: mesh.positions,
            faces: mesh.faces,
            labels: mesh.labels,
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
        all.materials.push(Material { name, base_color: DEFAULT_COLOR, image });
        Ok(part)
    }
}

/// What is certified of a class, or where that is better what its tile was raised for, with vertices that have moved by
/// `moved_m` since: it sinks less then, but within as far as it was looked around.
fn raised(c: ClassDeviation, held: &[Held], moved_m: f64) -> ClassDeviation {
    match held.get(c.class.index()) {
        Some(held) if held.sunk_m.is_finite() && held.sunk_m + moved_m < c.sunk_m => {
            ClassDeviation { bound_m: c.bound_m.max(held.reach_m + moved_m), sunk_m: held.sunk_m + moved_m, ..c }
        }
        _ => c,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_that_was_high_enough_keeps_its_bound() {
        let of = |sunk_m: f64| {
            let c = ClassDeviation {
                class: crate::ids::ClassId::ROOF,
                bound_m: 0.3,
                inside_m: 0.1,
                sunk_m,
                figures: crate::tiles::error::Figures::default(),
            };
            let raised = raised(c, &[Held { reach_m: 0.9, sunk_m: 0.04 }; 4], 0.001);
            (raised.bound_m, raised.sunk_m)
        };
        assert_eq!(of(0.02), (0.3, 0.02));
        assert_eq!(of(0.2), (0.901, 0.041));
    }

    #[test]
    fn texels_count_where_finer_tiles_have_smaller_ones() {
        let of = |texel_m: f64, reference_texel_m: f64| {
            let record = Record {
                bytes: 0,
                bounds: Aabb::of([DVec3::ZERO]),
                geometry_m: 0.5,
                texel_m,
                reference_texel_m,
                triangles: 0,
                skirt_triangles: 0,
                classes: Vec::new(),
                faults: BTreeMap::new(),
            };
            record.error_m(16.0)
        };
        assert_eq!(of(0.2, 0.1), 3.2);
        assert_eq!(of(0.13, 0.125), 0.5, "no finer tile shows more");
        assert_eq!(of(0.02, 0.01), 0.5, "the surface is off by more than a texel blurs");
        assert_eq!(of(0.0, 0.0), 0.5, "no texture at all");
    }
}
