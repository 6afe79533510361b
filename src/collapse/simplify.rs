//! Simplifies one mesh to a number of faces, a scale or an error, with or without the record.
//!
//! In: [`Mesh`], [`Classes`]. Out: [`Simplified`].
//!
//! # Method
//! 1. Vertices are put in Morton order, so that a star lies together in memory, and onto the grid.
//! 2. The whole mesh collapses as one block, see [`block`](super::block), in order of energy alone: a cut at any
//!    number of faces or scale is a prefix of one sequence.
//! 3. The cut is refitted, see [`refit`](super::refit).
//!
//! # Numbers
//! Two-sided mean over that of the best peer at equal faces (10, 5, 1 %), all budgets equal: a building 0.86, 0.82, 0.55
//! (Lindstrom–Turk); a crossing 0.78, 0.68, 0.15; a campus 0.50, 0.51, 0.77 (meshoptimizer).
//! What paid: folded faces that vanish in pairs (campus at 10 %: 5.0 → 1.45, and no stall); the true change of squared
//! distance of samples beside the energy (largest distance halved); the refit (13 %); a limit that grows with the mean
//! square (largest distance −40 %, mean unchanged); counting shared faces twice when ranking (time −15 %, error equal).
//! What did not: quadrics that remember, once samples vote; area to the power 1.5 or 2; ranking by distance instead of
//! squares; a limit of four times the root mean square (mean +3 to +30 %).
//!
//! # Cost
//! To 10 % of 295 000 faces, processor seconds: meshoptimizer 0.17, untracked 0.70, tracked with the sequence 1.18,
//! refitted 2.15, CGAL's Lindstrom–Turk 4.6. Peak about 400 bytes a face with the input.
//!
//! # Promises
//! At scale t no source vertex is further than t·b of its class from the cut (`the_scale_bounds_every_vertex`); no new
//! non-manifold edges (`no_edge_gets_a_third_face`).

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::block::{BORDER, Block, Collapsed, Energy, Limit, Rules, Sample};
use super::refit::{self, Point};
use super::{NONE, Samples, border_vertices};
use crate::classes::Classes;
use crate::ids::ClassId;
use crate::mesh::{GRID_PER_M, Mesh};

/// Most classes that an event keeps deviations of.
pub const MOST_CLASSES: usize = 8;
/// The limit starts at this share of the median edge: below it nothing collapses.
const FIRST_LIMIT_EDGES: f64 = 0.25;

/// Which energy orders the collapses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Memoryless planes weighted by area and budget, checked by tracked samples, refitted: the one to use.
    Semantic,
    /// Memoryless planes weighted by area alone, nothing tracked: the fastest.
    Memoryless,
    /// As semantic, but every vertex stays at a place it has in the source, and nothing is refitted.
    HalfEdge,
    /// Garland & Heckbert 1997 with area weights and optimal placement: the baseline.
    Plain,
    /// Lindstrom & Turk 1998.
    LindstromTurk,
    /// The paper's §2.3 as we read it: plain cost scaled by class, raised across creases.
    Paper,
}

/// Where to stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    /// At this many faces, or one less.
    Faces(usize),
    /// Before class c deviates by more than this times its budget (tracked methods only).
    Scale(f64),
}

/// How to simplify.
#[derive(Debug, Clone)]
pub struct SimplifyConfig {
    /// Order and placement.
    pub method: Method,
    /// Where to stop.
    pub target: Target,
    /// Positions are multiples of this, metres; a power of two.
    pub grid_m: f64,
    /// Refit the cut (semantic only).
    pub refit: bool,
    /// Keep the sequence.
    pub record: bool,
}

impl Default for SimplifyConfig {
    fn default() -> Self {
        let grid_m = 1.0 / GRID_PER_M;
        Self { method: Method::Semantic, target: Target::Scale(1.0), grid_m, refit: true, record: false }
    }
}

/// One collapse of a [`Sequence`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Event {
    /// Vertex that stays.
    pub kept: u32,
    /// Vertex that merges into it.
    pub gone: u32,
    /// Where `kept` is afterwards, local metres, on the grid.
    pub position: DVec3,
    /// Energy at which it was done, m² · m² per squared budget.
    pub energy: f32,
    /// Largest deviation of a sample that it moved, by class, metres.
    pub deviation_m: [f32; MOST_CLASSES],
}

/// The record of a simplification: any prefix of `events` is a valid mesh.
#[derive(Debug, Clone, Default)]
pub struct Sequence {
    /// Vertices of the source, on the grid, in Morton order.
    pub positions: Vec<DVec3>,
    /// Faces of the source.
    pub faces: Vec<[u32; 3]>,
    /// Class of each face.
    pub labels: Vec<ClassId>,
    /// Budget of each class at scale 1, metres.
    pub budgets_m: Vec<f64>,
    /// What was done, in order.
    pub events: Vec<Event>,
    /// Faces that an event folded onto others, so that they are gone though their corners differ: event, face. In order.
    pub folded: Vec<(u32, u32)>,
    /// Positions are multiples of this, metres.
    pub grid_m: f64,
}

/// A cut.
#[derive(Debug, Clone, Default)]
pub struct Simplified {
    /// Local metres; every one is used.
    pub positions: Vec<DVec3>,
    /// Corners.
    pub faces: Vec<[u32; 3]>,
    /// Face of the input that each face descends from.
    pub face_ids: Vec<u32>,
    /// Class of each face.
    pub labels: Vec<ClassId>,
    /// No tracked vertex of class c is further than this times its budget; infinite where nothing was tracked.
    pub scale: f64,
    /// The record, if asked for.
    pub sequence: Option<Sequence>,
}

/// Simplifies `mesh`. Method and target must agree, see [`Target::Scale`]; an untracked method with a scale does nothing.
pub fn simplify(mesh: &Mesh, classes: &Classes, config: &SimplifyConfig) -> Simplified {
    if mesh.faces.is_empty() {
        return Simplified::default();
    }
    let (mesh, face_ids) = in_order(mesh, config.grid_m);
    let classes = classes.inherited(&face_ids);
    let plan = Plan::of(&mesh, &classes, config);
    let done = plan.block(&mesh, &classes).collapse();
    let sequence = config.record.then(|| sequence(&mesh, &classes, &done, config.grid_m));
    plan.cut(&mesh, &classes, &face_ids, done, sequence)
}

/// What a run needs beside the mesh.
struct Plan<'a> {
    config: &'a SimplifyConfig,
    tracked: bool,
    origin: DVec3,
    budgets: Vec<f64>,
    samples: Samples,
    omega: Vec<f32>,
}

impl<'a> Plan<'a> {
    fn of(mesh: &Mesh, classes: &Classes, config: &'a SimplifyConfig) -> Self {
        let tracked = matches!(config.method, Method::Semantic | Method::HalfEdge);
        let budgets: Vec<f64> = classes.scheme.0.iter().map(|c| c.budget_m).collect();
        let weight = |f: usize| classes.of(f).iter().zip(&budgets).map(|(p, b)| f64::from(*p) / (b * b)).sum::<f64>();
        let omega: Vec<f32> = match config.method {
            Method::Semantic | Method::HalfEdge => (0..mesh.faces.len()).map(|f| weight(f) as f32).collect(),
            _ => vec![1.0; mesh.faces.len()],
        };
        let samples = if tracked {
            let one = vec![0; mesh.faces.len()];
            Samples::of(mesh, &one, classes, &omega, &budgets)
        } else {
            Samples::default()
        };
        // Without a fold: on the grid, so that differences stay exact.
        let origin = mesh.positions[mesh.positions.len() / 2];
        Self { config, tracked, origin, budgets, samples, omega }
    }

    fn rules(&self, mesh: &Mesh) -> Rules {
        let last = match self.config.target {
            Target::Scale(t) => t,
            Target::Faces(_) => f64::INFINITY,
        };
        let strictest = self.budgets.iter().copied().fold(f64::INFINITY, f64::min);
        let first = FIRST_LIMIT_EDGES * median_edge(mesh) / strictest;
        Rules {
            energy: match self.config.method {
                Method::Semantic | Method::Memoryless | Method::HalfEdge => Energy::Memoryless,
                Method::Plain => Energy::Accumulated,
                Method::LindstromTurk => Energy::Volume,
                Method::Paper => Energy::Paper,
            },
            half_edge: self.config.method == Method::HalfEdge,
            limit: if self.tracked { Limit::Growing { first: first.min(last), last } } else { Limit::Untracked },
            gap_reach_m: 0.0,
            loop_reach_m: 0.0,
            grid_m: self.config.grid_m,
            stop_faces: match self.config.target {
                Target::Faces(n) => n,
                Target::Scale(_) => 0,
            },
            recorded: self.config.record,
        }
    }

    fn block(&self, mesh: &Mesh, classes: &Classes) -> Block<'static> {
        let samples: Vec<Sample> = (0..self.samples.vertex.len() as u32)
            .filter(|&s| self.samples.face[s as usize] != NONE)
            .map(|s| self.samples.placed(s, self.samples.face[s as usize], mesh, self.origin))
            .collect();
        // The paper's importance of a class, for want of its numbers: the squared inverse of our budget, 1 for the mean.
        let mean = self.budgets.iter().sum::<f64>() / self.budgets.len() as f64;
        let importance = |c: &ClassId| (mean / self.budgets[c.index()]).powi(2) as f32;
        let paper = self.config.method == Method::Paper;
        Block {
            origin: self.origin,
            vertex_ids: Vec::new(),
            positions: mesh.positions.iter().map(|p| *p - self.origin).collect(),
            flags: border_vertices(mesh).into_iter().map(|b| if b { BORDER } else { 0 }).collect(),
            faces: mesh.faces.clone(),
            omega: self.omega.clone(),
            paper_weight: if paper { classes.label.iter().map(importance).collect() } else { Vec::new() },
            group: Vec::new(),
            boxes: &[],
            samples,
            rules: self.rules(mesh),
        }
    }

    /// The surface that is left, refitted if the method is.
    fn cut(
        &self,
        mesh: &Mesh,
        classes: &Classes,
        face_ids: &[u32],
        done: Collapsed,
        sequence: Option<Sequence>,
    ) -> Simplified {
        let block = done.block;
        let mut vertex = vec![NONE; block.positions.len()];
        let mut face = vec![NONE; block.faces.len()];
        let mut cut = Simplified { scale: done.scale, sequence, ..Simplified::default() };
        for (f, corners) in block.faces.iter().enumerate().filter(|(_, c)| c[0] != NONE) {
            face[f] = cut.faces.len() as u32;
            cut.faces.push(corners.map(|v| {
                if vertex[v as usize] == NONE {
                    vertex[v as usize] = cut.positions.len() as u32;
                    cut.positions.push(block.positions[v as usize]);
                }
                vertex[v as usize]
            }));
            cut.face_ids.push(face_ids[f]);
            cut.labels.push(classes.label[f]);
        }
        if self.config.refit && self.config.method == Method::Semantic {
            let mut points = self.points(mesh, &block.samples, &face, done.scale);
            refit::refit(&mut cut.positions, &mut cut.faces, &mut points);
        }
        cut.positions.iter_mut().for_each(|p| *p += self.origin);
        cut
    }

    /// Source vertices and centres of source faces, half of the area each, on faces of the cut.
    fn points(&self, mesh: &Mesh, samples: &[Sample], face: &[u32], scale: f64) -> Vec<Point> {
        let mut on_vertex = vec![NONE; mesh.positions.len()];
        let mut points = Vec::with_capacity(samples.len() + mesh.faces.len());
        for (i, &v) in self.samples.vertex.iter().filter(|&&v| self.samples.face[v as usize] != NONE).enumerate() {
            let sample = &samples[i];
            let f = face[sample.face as usize];
            on_vertex[v as usize] = f;
            let limit = (scale * f64::from(sample.budget_m)) as f32;
            points.push(Point::new(sample.point, 0.5 * sample.weight, limit, f));
        }
        for (f, corners) in mesh.faces.iter().enumerate() {
            let area = 0.5 * mesh.cross(f).length() as f32;
            let center = mesh.corners(f).iter().sum::<DVec3>() / 3.0 - self.origin;
            let near = on_vertex[corners[0] as usize];
            points.push(Point::new(center, 0.5 * area * self.omega[f], f32::INFINITY, near));
        }
        points
    }
}

fn sequence(mesh: &Mesh, classes: &Classes, done: &Collapsed, grid_m: f64) -> Sequence {
    let events = done.log.iter().zip(&done.deviations).map(|(e, deviation_m)| Event {
        kept: e.kept,
        gone: e.gone,
        position: e.position,
        energy: e.energy,
        deviation_m: *deviation_m,
    });
    Sequence {
        positions: mesh.positions.clone(),
        faces: mesh.faces.clone(),
        labels: classes.label.clone(),
        budgets_m: classes.scheme.0.iter().map(|c| c.budget_m).collect(),
        events: events.collect(),
        folded: done.folded.clone(),
        grid_m,
    }
}

/// The mesh on the grid with its vertices in Morton order and its faces by their first vertex; and where each face was.
fn in_order(mesh: &Mesh, grid_m: f64) -> (Mesh, Vec<u32>) {
    let low = mesh.positions.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let high = mesh.positions.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    let cells = f64::from(MORTON_CELLS - 1) / (high - low).max_element().max(f64::MIN_POSITIVE);
    let key = |p: DVec3| {
        let cell = ((p - low) * cells).as_uvec3();
        spread(cell.x) | spread(cell.y) << 1 | spread(cell.z) << 2
    };
    let mut order: Vec<u64> = mesh.positions.iter().zip(0..).map(|(p, v)| u64::from(key(*p)) << 32 | v).collect();
    sort_by_upper_half(&mut order);
    let mut place = vec![0u32; order.len()];
    order.iter().zip(0..).for_each(|(&at, i)| place[at as u32 as usize] = i);
    let moved = |f: &[u32; 3]| f.map(|v| place[v as usize]);
    // Faces by their first vertex; of the same one, in the order they came in.
    let first = |f: &[u32; 3]| moved(f).into_iter().fold(NONE, u32::min) as usize;
    let mut start = vec![0u32; order.len() + 1];
    mesh.faces.iter().for_each(|f| start[first(f) + 1] += 1);
    for v in 0..order.len() {
        start[v + 1] += start[v];
    }
    let mut face_ids = vec![0u32; mesh.faces.len()];
    for (face, f) in mesh.faces.iter().zip(0..) {
        let at = &mut start[first(face)];
        face_ids[*at as usize] = f;
        *at += 1;
    }
    let ordered = Mesh {
        positions: order.iter().map(|&at| (mesh.positions[at as u32 as usize] / grid_m).round() * grid_m).collect(),
        faces: face_ids.iter().map(|&f| moved(&mesh.faces[f as usize])).collect(),
        ..Mesh::default()
    };
    (ordered, face_ids)
}

/// Stable, in three rounds of ten bits, of which a Morton key has thirty.
fn sort_by_upper_half(items: &mut Vec<u64>) {
    let mut other = vec![0u64; items.len()];
    for shift in [32, 42, 52] {
        let digit = |x: u64| (x >> shift) as usize & 1023;
        let mut start = [0usize; 1024];
        items.iter().for_each(|&x| start[digit(x)] += 1);
        let mut total = 0;
        for at in &mut start {
            total += std::mem::replace(at, total);
        }
        for &x in items.iter() {
            let at = &mut start[digit(x)];
            other[*at] = x;
            *at += 1;
        }
        std::mem::swap(items, &mut other);
    }
}

/// Cells along an axis: three times ten bits.
const MORTON_CELLS: u32 = 1024;

/// Two zeros before every of the ten lowest bits.
fn spread(x: u32) -> u32 {
    let x = (x | x << 16) & 0x0300_00ff;
    let x = (x | x << 8) & 0x0300_f00f;
    let x = (x | x << 4) & 0x030c_30c3;
    (x | x << 2) & 0x0924_9249
}

/// Length in the middle of all edges (of some of them, where there are many), metres.
fn median_edge(mesh: &Mesh) -> f64 {
    let step = (mesh.faces.len() / 10_000).max(1);
    let mut lengths: Vec<f64> = (0..mesh.faces.len())
        .step_by(step)
        .flat_map(|f| {
            let [a, b, c] = mesh.corners(f);
            [(b - a).length(), (c - b).length(), (a - c).length()]
        })
        .collect();
    let middle = lengths.len() / 2;
    *lengths.select_nth_unstable_by(middle, f64::total_cmp).1
}
