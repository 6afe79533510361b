//! Makes the surfaces of all tiles: collapses the city level by level and keeps what each cell has at each of them.
//!
//! In: a [`City`] whose leaves have labels. Out: [`Node`]s, children before parents, the root last; the surface of each
//! inner one is a page of the store.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::ingest::{City, leaf_mesh};
use super::steps::Steps;
use super::{Job, tops};
use crate::ids::ClassId;
use crate::report::Reporter;
use crate::store::Store;
use crate::tiles::TileMesh;
use crate::tiles::levels::{FIRST_TOLERANCE_EDGES, LEAST_REDUCTION, MOST_EXTRA_ROOTS, Progress};
use crate::{Error, Result};

/// A tile of the tree.
pub(super) struct Node {
    pub cell: u32,
    /// Scale t of its cut; 0 for a leaf.
    pub scale: f64,
    /// Indices of the tiles below.
    pub children: Vec<u32>,
    /// Faces of its surface.
    pub faces: usize,
    /// Faces of the source it stands for.
    pub source_faces: usize,
}

impl Node {
    /// True for a tile that shows the source.
    pub fn is_leaf(&self) -> bool {
        self.scale == 0.0
    }
}

/// The surface of an inner tile, raised where its tops are kept.
pub(super) fn surface(store: &Store, tile: usize) -> Result<TileMesh> {
    let mut page = store.read(&surface_name(tile))?;
    let mut mesh = TileMesh {
        positions: page.take()?,
        faces: page.take()?,
        labels: page.take::<u8>()?.into_iter().map(ClassId).collect(),
    };
    page.finish()?;
    for (p, rise_m) in mesh.positions.iter_mut().zip(tops::rises(store, tile)?) {
        p.z += rise_m;
    }
    Ok(mesh)
}

fn surface_name(tile: usize) -> String {
    format!("surface/{tile}")
}

/// Leaves below a tile, by cell.
pub(super) fn leaves_below(nodes: &[Node], tile: usize) -> Vec<u32> {
    let (mut open, mut leaves) = (vec![tile as u32], Vec::new());
    while let Some(tile) = open.pop() {
        let node = &nodes[tile as usize];
        if node.is_leaf() {
            leaves.push(node.cell);
        }
        open.extend(&node.children);
    }
    leaves.sort_unstable();
    leaves
}

/// Cuts the levels.
///
/// # Errors
/// The disk, or a wish to stop.
pub(super) fn nodes(
    city: &City,
    job: &Job,
    median_edge_m: f64,
    store: &Store,
    reporter: &Reporter,
) -> Result<Vec<Node>> {
    let stage = reporter.stage("collapse", 0);
    let config = job.config;
    let steps = Steps::new(city, config, store, reporter)?;
    let loosest = config.classes.0.iter().map(|c| c.budget_m).fold(f64::MIN_POSITIVE, f64::max);
    let mut hierarchy = Hierarchy {
        city,
        job,
        store,
        reporter,
        steps,
        scale: median_edge_m.max(1e-3) * FIRST_TOLERANCE_EDGES / loosest,
        nodes: Vec::new(),
        of_cell: vec![Vec::new(); city.tree.cells.len()],
    };
    for leaf in &city.leaves {
        let (faces, source_faces) = (leaf.faces, leaf.faces);
        hierarchy.add(Node { cell: leaf.cell, scale: 0.0, children: Vec::new(), faces, source_faces });
    }
    hierarchy.make()?;
    let Hierarchy { steps, nodes, .. } = hierarchy;
    let mut scales: Vec<f64> = nodes.iter().map(|n| n.scale).filter(|scale| *scale > 0.0).collect();
    scales.dedup();
    let scales = scales.iter().map(|scale| format!("{scale:.2}")).collect::<Vec<_>>().join(", ");
    let (collapses, count) = (steps.collapses, steps.count());
    stage.finish(format!("{collapses} collapses in {count} steps, {} tiles, levels at scale {scales}", nodes.len()));
    Ok(nodes)
}

struct Hierarchy<'a> {
    city: &'a City,
    job: &'a Job<'a>,
    store: &'a Store,
    reporter: &'a Reporter,
    steps: Steps<'a>,
    /// Of the last step; before it, of the first.
    scale: f64,
    nodes: Vec<Node>,
    /// Tiles that stand for each cell so far: one, or none, or the children's where nothing of the cell was left.
    of_cell: Vec<Vec<u32>>,
}

impl Hierarchy<'_> {
    fn make(&mut self) -> Result<()> {
        let levels = &self.job.config.levels;
        for depth in (0..self.city.tree.depth()).rev() {
            let scale = self.collapse(depth, levels.tile_faces)?;
            self.add_level(depth, scale)?;
        }
        // Lighter roots on top of one that is still heavy: the last of them is kept small.
        for _ in 0..MOST_EXTRA_ROOTS {
            if self.nodes.last().is_none_or(|root| root.faces <= levels.root_faces) {
                break;
            }
            let before = self.steps.faces();
            let scale = self.collapse(0, levels.root_faces)?;
            if self.steps.faces() as f64 > before as f64 * (1.0 - LEAST_REDUCTION) {
                break;
            }
            self.add_inner(0, scale, self.of_cell[0].clone())?;
        }
        let last = self.nodes.len().wrapping_sub(1) as u32;
        if self.of_cell[0] != [last] {
            return Err(Error::Bug(format!("the root's tiles are {:?}, the last is {last}", self.of_cell[0])));
        }
        Ok(())
    }

    /// Steps on until no inner cell of `depth` has more than `most` faces and the level is worth having; returns the
    /// last scale.
    fn collapse(&mut self, depth: u8, most: usize) -> Result<f64> {
        let levels = &self.job.config.levels;
        let mut progress = Progress::new(self.steps.faces(), self.heaviest(depth), most);
        // What the first step of all will leave nobody can say.
        let mut ratio = if self.steps.count() > 0 { progress.ratio(levels.step_ratio) } else { 1.0 };
        self.steps.merge(depth, self.scale * ratio)?;
        loop {
            self.reporter.check()?;
            self.scale *= ratio;
            self.steps.step(self.scale, depth)?;
            if progress.is_done(ratio, self.steps.faces(), self.heaviest(depth)) {
                return Ok(self.scale);
            }
            ratio = progress.ratio(levels.step_ratio);
        }
    }

    /// Faces in the heaviest inner cell of `depth`.
    fn heaviest(&self, depth: u8) -> usize {
        let tree = &self.city.tree;
        let mut of_cell: BTreeMap<u32, u64> = BTreeMap::new();
        for (cell, faces) in self.steps.cells() {
            *of_cell.entry(tree.ancestor(cell, depth)).or_default() += faces;
        }
        // A model of one cell has no inner one, but its light root is to be light.
        let inner = of_cell.iter().filter(|(cell, _)| **cell == 0 || !tree.cells[**cell as usize].is_leaf());
        inner.map(|(_, faces)| *faces as usize).max().unwrap_or(0)
    }

    fn add(&mut self, node: Node) {
        self.of_cell[node.cell as usize] = vec![self.nodes.len() as u32];
        self.nodes.push(node);
    }

    fn add_level(&mut self, depth: u8, scale: f64) -> Result<()> {
        let tree = &self.city.tree;
        let is_inner = |c: &u32| tree.cells[*c as usize].depth == depth && !tree.cells[*c as usize].is_leaf();
        for cell in (0..tree.cells.len() as u32).filter(is_inner) {
            let below = &tree.cells[cell as usize].children;
            let children: Vec<u32> = below.iter().flat_map(|&c| self.of_cell[c as usize].clone()).collect();
            if self.steps.faces_of(cell) > 0 {
                self.add_inner(cell, scale, children)?;
            } else {
                // A sliver that merged into the cells beside it: a tile of nothing would be an empty REPLACE tile, so its
                // children wait for the next level up.
                self.of_cell[cell as usize] = children;
            }
        }
        Ok(())
    }

    /// Adds the tile of a cell as it is now. Its page is written before the next step drops what it is made from, so a
    /// run that goes on finds either.
    fn add_inner(&mut self, cell: u32, scale: f64, children: Vec<u32>) -> Result<()> {
        let name = surface_name(self.nodes.len());
        if !self.store.has(&name) {
            let patch = self.steps.patch(cell)?;
            let mut page = self.store.page(&name)?;
            page.put(&patch.positions)?;
            page.put(&patch.faces)?;
            page.put(&patch.labels.iter().map(|l| l.0).collect::<Vec<u8>>())?;
            page.finish()?;
        }
        let faces = self.steps.faces_of(cell);
        let source_faces = children.iter().map(|&c| self.nodes[c as usize].source_faces).sum();
        self.add(Node { cell, scale, children, faces, source_faces });
        Ok(())
    }
}

/// Calls `take` with the positions and faces of every tile, in parallel; results in the tiles' order.
///
/// # Errors
/// The disk's, or those of `take`.
pub(super) fn for_surfaces<T: Send>(
    nodes: &[Node],
    store: &Store,
    take: impl Fn(usize, &[glam::DVec3], &[[u32; 3]]) -> T + Sync,
) -> Result<Vec<T>> {
    let one = |(t, node): (usize, &Node)| {
        if node.is_leaf() {
            let mesh = leaf_mesh(store, node.cell)?;
            Ok(take(t, &mesh.positions, &mesh.faces))
        } else {
            let mesh = surface(store, t)?;
            Ok(take(t, &mesh.positions, &mesh.faces))
        }
    };
    nodes.par_iter().enumerate().map(one).collect()
}
