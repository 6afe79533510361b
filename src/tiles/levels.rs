//! Chooses the scale of every level and cuts the collapse into tiles.
//!
//! In: [`Partition`], [`Classes`]. Out: [`TileTree`].
//!
//! # Method
//! 1. Leaves show the source itself.
//! 2. For each depth, deepest first, the surface collapses in steps of [`LevelsConfig::step_ratio`] with the walls of
//!    that depth kept, until no tile has more than [`LevelsConfig::tile_faces`] faces and the level has lost at least
//!    half of the level below. Faces fall 2.1–2.7 times for a doubling of scale on real meshes, so a quadtree level
//!    needs about three times the scale of the one below.
//! 3. A root that is still heavy gets lighter roots on top of it, so that the first view loads at once.
//!
//! # Promises
//! Every inner tile has content; its scale is above its children's; tiles of one depth share their borders bit for bit.

use serde::{Deserialize, Serialize};

use super::partition::Partition;
use super::skirt::Skirts;
use crate::classes::Classes;
use crate::collapse::{CollapseConfig, CollapseLog, Collapser, Fences};
use crate::geo::Rect;
use crate::ids::ClassId;
use crate::report::Reporter;
use crate::{Error, Result};
use glam::DVec3;

/// How the hierarchy is made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LevelsConfig {
    /// A leaf has at most this many source faces. Default: 40 000.
    pub leaf_faces: usize,
    /// A leaf uses at most this many texels of the source's images. Default: 4 194 304 (2048²).
    pub leaf_texels: usize,
    /// A simplified tile has at most this many faces. Default: 30 000.
    pub tile_faces: usize,
    /// A root above this many faces gets a lighter one on top. Default: 8 000, about 400 kB with its texture.
    pub root_faces: usize,
    /// Scale of a step over that of the step before. Default: 1.6: larger steps overshoot the faces a
    /// tile may have, smaller ones try every edge more often and end up no nearer to the source.
    pub step_ratio: f64,
    /// Strips along the walls of cells that hide gaps between tiles of different levels: `"auto"`, `"off"`, or their
    /// depth in metres. Default: `"auto"`, as deep as the gaps.
    pub skirts: Skirts,
    /// Raise simplified tiles where they are lower than a roof or a façade of the source by more than the budget of
    /// that class at scale 1. Default: false.
    pub keep_tops: bool,
}

impl Default for LevelsConfig {
    fn default() -> Self {
        Self {
            leaf_faces: 40_000,
            leaf_texels: 1 << 22,
            tile_faces: 30_000,
            root_faces: 8_000,
            step_ratio: 1.6,
            skirts: Skirts::Auto,
            keep_tops: false,
        }
    }
}

impl LevelsConfig {
    /// What is wrong with the settings, in words.
    pub fn faults(&self) -> Vec<String> {
        let mut faults = Vec::new();
        for (name, value) in
            [("leaf_faces", self.leaf_faces), ("tile_faces", self.tile_faces), ("root_faces", self.root_faces)]
        {
            if value < 100 {
                faults.push(format!("levels.{name} is {value}; use at least 100"));
            }
        }
        if self.leaf_texels < 4096 {
            faults.push(format!("levels.leaf_texels is {}; use at least 4096", self.leaf_texels));
        }
        if !(1.05..=4.0).contains(&self.step_ratio) {
            faults.push(format!("levels.step_ratio is {}; use 1.05 to 4", self.step_ratio));
        }
        faults
    }
}

/// The first step's tolerance as a share of the median edge: below it almost nothing collapses.
const FIRST_TOLERANCE_EDGES: f64 = 1.0 / 16.0;
/// A level must lose at least this share of the faces of the level below: less is not worth a level.
const LEAST_REDUCTION: f64 = 0.3;
/// A step that loses less than this share buys too little for its error; after two of them in a row a level is taken as
/// it is, or the surface would be spoilt for faces that it cannot lose.
const STALLED_SHARE: f64 = 0.1;
const MOST_STALLED: u32 = 2;
/// Lighter roots are added at most this often.
const MOST_EXTRA_ROOTS: u32 = 3;

/// A simplified surface inside one cell.
#[derive(Debug, Clone, Default)]
pub struct TileMesh {
    /// Local metres.
    pub positions: Vec<DVec3>,
    /// Corners.
    pub faces: Vec<[u32; 3]>,
    /// Class of each face.
    pub labels: Vec<ClassId>,
}

/// A node of the tree.
#[derive(Debug, Clone)]
pub struct Tile {
    /// Cell of the partition.
    pub cell: u32,
    /// 0 for the coarsest.
    pub level: u32,
    /// Scale t of its cut; 0 for a leaf.
    pub scale: f64,
    /// The simplified surface; none for a leaf, which shows the source.
    pub mesh: Option<TileMesh>,
    /// Ranges of the partition's faces that it stands for, ascending.
    pub source: Vec<std::ops::Range<usize>>,
    /// Indices into [`TileTree::tiles`].
    pub children: Vec<u32>,
}

/// All tiles; parents after their children, the root last.
#[derive(Debug, Clone, Default)]
pub struct TileTree {
    /// See [`TileTree`].
    pub tiles: Vec<Tile>,
    /// The record of the collapse that the tiles were cut from.
    pub log: CollapseLog,
}

impl TileTree {
    /// Cuts the levels.
    ///
    /// # Errors
    /// Only when the user asks to stop.
    pub fn of(
        partition: &Partition,
        classes: &Classes,
        median_edge_m: f64,
        config: &LevelsConfig,
        collapse: &CollapseConfig,
        reporter: &Reporter,
    ) -> Result<Self> {
        let mut builder = Builder::new(partition, config, reporter);
        builder.add_leaves();
        let mut collapser = Collapser::new(&partition.mesh, &partition.leaf, classes, collapse);
        let loosest = classes.scheme.0.iter().map(|c| c.budget_m).fold(f64::MIN_POSITIVE, f64::max);
        let mut scale = median_edge_m.max(1e-3) * FIRST_TOLERANCE_EDGES / loosest;
        for depth in (0..partition.depth()).rev() {
            builder.collapse_to(&mut collapser, &mut scale, depth, config.tile_faces)?;
            builder.add_level(&collapser, depth);
        }
        for _ in 0..MOST_EXTRA_ROOTS {
            if builder.root_faces() <= config.root_faces {
                break;
            }
            let before = collapser.face_count();
            builder.collapse_to(&mut collapser, &mut scale, 0, config.root_faces)?;
            if collapser.face_count() as f64 > before as f64 * (1.0 - LEAST_REDUCTION) {
                break;
            }
            builder.add_root(&collapser);
        }
        builder.finish(collapser.into_log())
    }
}

struct Builder<'a> {
    partition: &'a Partition,
    config: &'a LevelsConfig,
    reporter: &'a Reporter,
    tiles: Vec<Tile>,
    /// Tiles that stand for each cell so far: one, or none, or the children's where nothing of the cell was left.
    of_cell: Vec<Vec<u32>>,
}

impl<'a> Builder<'a> {
    fn new(partition: &'a Partition, config: &'a LevelsConfig, reporter: &'a Reporter) -> Self {
        Self { partition, config, reporter, tiles: Vec::new(), of_cell: vec![Vec::new(); partition.cells.len()] }
    }

    fn add_leaves(&mut self) {
        let mut first = 0;
        for of_leaf in self.partition.leaf.chunk_by(|a, b| a == b) {
            let range = first..first + of_leaf.len();
            first = range.end;
            self.add(Tile {
                cell: of_leaf[0],
                level: 0,
                scale: 0.0,
                mesh: None,
                source: vec![range],
                children: Vec::new(),
            });
        }
    }

    fn add(&mut self, tile: Tile) {
        self.of_cell[tile.cell as usize] = vec![self.tiles.len() as u32];
        self.tiles.push(tile);
    }

    /// Steps on until no cell of `depth` that needs content has more than `most` faces and the level is worth having.
    fn collapse_to(&self, collapser: &mut Collapser, scale: &mut f64, depth: u8, most: usize) -> Result<()> {
        let group: Vec<u32> = self.partition.leaf.iter().map(|&leaf| self.partition.ancestor(leaf, depth)).collect();
        let boxes: Vec<Rect> = self.partition.cells.iter().map(|c| c.plan).collect();
        let fences = Fences { group_of_face: &group, boxes: &boxes };
        let before = collapser.face_count();
        let mut stalled = 0;
        loop {
            self.reporter.check()?;
            let count = collapser.face_count();
            collapser.step(*scale, &fences);
            *scale *= self.config.step_ratio;
            let after = collapser.face_count();
            stalled = if (count - after) as f64 <= STALLED_SHARE * count as f64 { stalled + 1 } else { 0 };
            let heaviest = self.heaviest(collapser, &group);
            let enough = after as f64 <= before as f64 * (1.0 - LEAST_REDUCTION) && heaviest <= most;
            if enough || stalled >= MOST_STALLED {
                return Ok(());
            }
        }
    }

    fn heaviest(&self, collapser: &Collapser, group: &[u32]) -> usize {
        let mut faces = vec![0usize; self.partition.cells.len()];
        collapser.face_ids().iter().for_each(|&f| faces[group[f as usize] as usize] += 1);
        let inner = |cell: &usize| self.partition.cells[*cell].children.is_some();
        (0..faces.len()).filter(inner).map(|c| faces[c]).max().unwrap_or(0)
    }

    fn add_level(&mut self, collapser: &Collapser, depth: u8) {
        let cells: Vec<u32> = (0..self.partition.cells.len() as u32)
            .filter(|&c| {
                self.partition.cells[c as usize].depth == depth && self.partition.cells[c as usize].children.is_some()
            })
            .collect();
        let mut meshes = self.meshes(collapser, depth);
        for cell in cells {
            let below = self.partition.cells[cell as usize].children.into_iter().flatten();
            let children: Vec<u32> = below.flat_map(|c| self.of_cell[c as usize].clone()).collect();
            match meshes.remove(&cell) {
                Some(mesh) => self.add_parent(cell, collapser, mesh, children),
                // A sliver that merged into the cells beside it: a tile of nothing would be an empty REPLACE tile,
                // so its children wait for the next level up.
                None => self.of_cell[cell as usize] = children,
            }
        }
    }

    fn add_parent(&mut self, cell: u32, collapser: &Collapser, mesh: TileMesh, children: Vec<u32>) {
        let scale = collapser.log().steps.last().map_or(0.0, |s| s.0);
        let mut source: Vec<_> = children.iter().flat_map(|&c| self.tiles[c as usize].source.clone()).collect();
        source.sort_by_key(|r| r.start);
        self.add(Tile { cell, level: 0, scale, mesh: Some(mesh), source, children });
    }

    fn add_root(&mut self, collapser: &Collapser) {
        let below = self.of_cell[0].clone();
        if let Some(mesh) = self.meshes(collapser, 0).remove(&0) {
            self.add_parent(0, collapser, mesh, below);
        }
    }

    fn root_faces(&self) -> usize {
        match self.tiles.last() {
            Some(Tile { mesh: Some(mesh), .. }) => mesh.faces.len(),
            Some(leaf) => leaf.source.iter().map(|r| r.len()).sum(),
            None => 0,
        }
    }

    /// The cut of each cell of `depth`, compacted.
    fn meshes(&self, collapser: &Collapser, depth: u8) -> std::collections::BTreeMap<u32, TileMesh> {
        let cut = collapser.cut();
        let mut faces_of: std::collections::BTreeMap<u32, Vec<usize>> = Default::default();
        for (i, &id) in cut.face_ids.iter().enumerate() {
            faces_of.entry(self.partition.ancestor(self.partition.leaf[id as usize], depth)).or_default().push(i);
        }
        let mut local = vec![u32::MAX; cut.positions.len()];
        let mut meshes = std::collections::BTreeMap::new();
        for (cell, faces) in faces_of {
            let mut mesh = TileMesh::default();
            let mut used = Vec::new();
            for i in faces {
                mesh.labels.push(cut.labels[i]);
                mesh.faces.push(cut.faces[i].map(|v| {
                    if local[v as usize] == u32::MAX {
                        local[v as usize] = mesh.positions.len() as u32;
                        mesh.positions.push(cut.positions[v as usize]);
                        used.push(v);
                    }
                    local[v as usize]
                }));
            }
            used.iter().for_each(|&v| local[v as usize] = u32::MAX);
            meshes.insert(cell, mesh);
        }
        meshes
    }

    fn finish(mut self, log: CollapseLog) -> Result<TileTree> {
        let last = self.tiles.len().wrapping_sub(1) as u32;
        if self.of_cell[0] != [last] {
            return Err(Error::Bug(format!("the root's tiles are {:?}, the last is {last}", self.of_cell[0])));
        }
        for at in (0..self.tiles.len()).rev() {
            let level = self.tiles[at].level + 1;
            for child in self.tiles[at].children.clone() {
                self.tiles[child as usize].level = level;
            }
        }
        Ok(TileTree { tiles: self.tiles, log })
    }
}
