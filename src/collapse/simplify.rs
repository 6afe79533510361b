//! Simplifies one mesh to a number of faces, a scale or an error, with or without the record.
//!
//! In: [`Mesh`], [`Classes`]. Out: [`Simplified`].
//!
//! # Method
//! 1. Vertices that are used are put in Morton order, so that a star lies together in memory, and onto the grid.
//! 2. The whole mesh collapses as one block, see [`block`](super::block), in order of energy alone: a cut at any
//!    number of faces or scale is a prefix of one sequence.
//! 3. The cut is refitted, see [`refit`](super::refit): once at 1.25 times the faces wanted, or at the scale wanted, from
//!    where it collapses on, by energies of refitted faces and samples that know what the refit left; and at the end.
//!    Before the first refit small pieces go that cost less than other faces (`islands`); a record has none of this.
//!
//! # Numbers
//! Two-sided mean over that of the best of nine peers at equal faces (10, 5, 1 %), all budgets equal: a building 0.80,
//! 0.76, 0.53 (Lindstrom–Turk, at 1 % VTK); a house among trees 0.70, 0.67, 0.64 (Open3D, VTK); a crossing 0.74, 0.65, 0.49
//! (Lindstrom–Turk, VTK); a campus 0.62, 0.60, 0.79 (VTK; 0.92 before pieces of four faces could go, a third of the last
//! 1460). Refitted first at 1.4 times the faces the campus has 0.69, and what needs no pieces to go 1 % more. Over our own
//! [`Method::Plain`] at 10 %: 0.67, 0.68, 0.67, 0.60; faces needed for its accuracy there: 44, 37, 46, 51 % fewer, at 5 %:
//! 51, 36, 52, 49.
//! Façades and roofs at 10 and 5 %, and the mean of all classes, with a quarter of the others' budget: the building 0.65
//! and 0.63 (all: 0.97, 0.95), the house 0.39 and 0.40 (0.73, 0.71), the crossing 0.28 and 0.30 (0.75, 0.65), the campus
//! 0.33 and 0.26 (0.65, 0.64); with a third of it the building's are 0.67 and 0.65 (0.92, 0.88). Key over plain at 10 %:
//! 0.54, 0.36, 0.22, 0.27.
//! To a given scale, collapsing on after the refit leaves 14 to 21 % fewer faces (building, campus; scale 2 and 20).
//! What paid: folded faces that vanish in pairs (campus at 10 %: 5.0 → 1.45, and no stall); the true change of squared
//! distance of samples beside the energy (largest distance halved); the refit (15 to 22 %); a limit that grows with the mean
//! square (largest distance −40 %, mean unchanged); counting shared faces twice when ranking (time −15 %, error equal).
//! What did not: quadrics that remember, once samples vote; area to the power 1.5 or 2; ranking by distance instead of
//! squares; a limit of four times the root mean square (mean +3 to +30 %).
//!
//! # Cost
//! To 10 % of 295 000 faces, processor time of all threads over meshoptimizer's (0.21 s on a busy machine) in the same run:
//! untracked 1.6 to 1.9, tracked with the sequence 2.9 to 3.3, refitted 7.3 (8.0 when it was refitted once); CGAL's
//! Lindstrom–Turk 20 to 27. From 0.25 to 3.03 million faces a face takes 1.23 times as long untracked (1.40 before), 1.10
//! tracked.
//! Peak of the whole process with `simplify`, bytes a face, of 0.77, 0.3 and 0.15 million faces: untracked 125, 159, 207;
//! with the sequence 177, 212, 274; refitted 163, 197, 275. Of these the process itself takes 12 MB (43 of 0.3 million, 83
//! of 0.15 million, whose peak is in finding its classes). Without what `main` tells the C library holes in the heap
//! took a third more (250, 316, 373 with the sequence). Another allocator (mimalloc 0.1.52) took 90 more at the same speed.
//! An input that has to stay (a texture is baked from it) is added.
//! Where the time goes: waiting for memory.
//! What paid (untracked, meshoptimizer's = 1): forms about their own vertex, six numbers instead of ten, and edges and
//! vertices ordered by counting (3.8 → 3.2); f32 for the forms that wait, so that a vertex is one line (→ 2.9, error the
//! same to four digits); both stars copied before anything is decided, and border planes kept up by the star's edges
//! instead of whole rings (→ 2.45); 10 candidates read ahead at once (→ 2.3); nothing large moved about (→ 2.1); a vertex
//! in truth one line, not two (it had 65 bytes), large buckets handled in order of place, 24 read ahead (→ 1.6).
//! Tracked: samples listed face by face in turn (−12 %).
//! What paid in memory (bytes a face, untracked 174 → 112, with the sequence 251 → 169, refitted 217 → 150): vertices of one
//! line (35), the queue's pool of chunks (17) without what is out of date (4), stars that move together (10), deviations as
//! levels (11), moves instead of places (7), samples of 40 bytes (4), points of the refit without their places (30).
//!
//! # Promises
//! At scale t no source vertex is further than t·b of its class from the cut (`the_scale_bounds_every_vertex`); no new
//! non-manifold edges (`no_edge_gets_a_third_face`).

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::block::{BORDER, Block, Collapsed, Energy, Limit, Rules, Sample};
use super::blocks::border_of;
use super::islands::drop_cheap_islands;
use super::refit::{self, Point};
use super::{CollapseLog, MOST_CLASSES, NONE, Sequence};
use crate::classes::Classes;
use crate::ids::ClassId;
use crate::mesh::{GRID_PER_M, Mesh};

/// The limit starts at this share of the median edge: below it nothing collapses.
const FIRST_LIMIT_EDGES: f64 = 0.25;
/// Share of the area that the refit gives to vertices, as Simpson's rule does.
const OF_VERTICES: f32 = 0.25;
/// A cut is refitted first at so many times its number of faces, with so many passes, and collapses on from there.
const FIRST_LEG: f64 = 1.25;
const FIRST_PASSES: usize = 1;
/// Passes of the refit at the end.
const PASSES: usize = 2;

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
    Job::of(mesh, classes, config).run()
}

/// As [`simplify`], with less memory: the input is let go before the work starts.
pub fn simplify_owned(mesh: Mesh, classes: Classes, config: &SimplifyConfig) -> Simplified {
    if mesh.faces.is_empty() {
        return Simplified::default();
    }
    let job = Job::of(&mesh, &classes, config);
    drop((mesh, classes));
    job.run()
}

/// What a run needs of its input.
struct Job<'a> {
    config: &'a SimplifyConfig,
    tracked: bool,
    /// Ordered, about `origin`.
    mesh: Mesh,
    origin: DVec3,
    /// Face of the input that each face is.
    face_ids: Vec<u32>,
    labels: Vec<ClassId>,
    budgets: Vec<f64>,
    /// Σ P(c|f)/b_c² by face, 1/m²; empty for methods that do not weigh.
    omega: Vec<f32>,
}

impl<'a> Job<'a> {
    fn of(mesh: &Mesh, classes: &Classes, config: &'a SimplifyConfig) -> Self {
        let tracked = matches!(config.method, Method::Semantic | Method::HalfEdge);
        let (mut mesh, face_ids) = in_order(mesh, config.grid_m);
        // Without a fold: on the grid, so that differences stay exact.
        let origin = mesh.positions[mesh.positions.len() / 2];
        mesh.positions.iter_mut().for_each(|p| *p -= origin);
        let budgets: Vec<f64> = classes.scheme.0.iter().map(|c| c.budget_m).collect();
        let weight = |f: usize| classes.of(f).iter().zip(&budgets).map(|(p, b)| f64::from(*p) / (b * b)).sum::<f64>();
        let omega = if tracked { face_ids.iter().map(|&f| weight(f as usize) as f32).collect() } else { Vec::new() };
        let labels = face_ids.iter().map(|&f| classes.label[f as usize]).collect();
        Self { config, tracked, mesh, origin, face_ids, labels, budgets, omega }
    }

    fn run(mut self) -> Simplified {
        let refit = self.config.refit && self.config.method == Method::Semantic;
        let mut block = self.block(refit || self.config.record);
        let rules = block.rules;
        // A record tells one run.
        let twice = refit && !self.config.record;
        if twice {
            block.rules.stop_faces = (FIRST_LEG * rules.stop_faces as f64) as usize;
        }
        let mut done = block.collapse();
        if twice {
            drop_cheap_islands(&mut done.block, done.scale, rules.stop_faces);
        }
        self.omega = std::mem::take(&mut done.block.omega);
        let (mut cut, mut samples) = self.cut(&mut done, |f| f);
        if self.mesh.positions.is_empty() {
            self.mesh.positions = samples.iter().map(|s| s.point).collect();
        }
        if refit {
            if twice {
                self.refit(&mut cut, &mut samples, FIRST_PASSES);
                (cut, samples) = self.collapse_on(cut, samples, rules);
            }
            self.refit(&mut cut, &mut samples, PASSES);
        }
        drop(samples);
        if self.config.record {
            cut.sequence = Some(self.sequence(done));
        }
        cut.positions.iter_mut().for_each(|p| *p += self.origin);
        cut.face_ids.iter_mut().for_each(|f| *f = self.face_ids[*f as usize]);
        cut
    }

    /// Refits a cut; its samples end on the faces nearest to them.
    fn refit(&self, cut: &mut Simplified, samples: &mut [Sample], passes: usize) {
        let mut points = self.points(samples, cut.scale);
        let source =
            refit::Source { positions: &self.mesh.positions, faces: &self.mesh.faces, of_centers: 1.0 - OF_VERTICES };
        refit::refit(&mut cut.positions, &mut cut.faces, &mut points, source, passes);
        for (sample, point) in samples.iter_mut().zip(&points) {
            (sample.face, sample.squared_m2) = (point.face, point.distance_m * point.distance_m);
        }
    }

    /// Takes a refitted cut on to the end: energies are of its own faces, and samples vote with what the refit left.
    fn collapse_on(&self, cut: Simplified, samples: Vec<Sample>, mut rules: Rules) -> (Simplified, Vec<Sample>) {
        if let Limit::Growing { first, .. } = &mut rules.limit {
            *first = cut.scale;
        }
        let Simplified { positions, faces, face_ids, .. } = cut;
        let block = Block {
            origin: self.origin,
            vertex_ids: Vec::new(),
            flags: border_flags(positions.len(), &faces),
            positions,
            faces,
            omega: face_ids.iter().map(|&f| self.omega[f as usize]).collect(),
            paper_weight: Vec::new(),
            group: Vec::new(),
            boxes: &[],
            samples,
            sample_classes: Vec::new(),
            rules,
        };
        self.cut(&mut block.collapse(), |f| face_ids[f as usize])
    }

    fn rules(&self) -> Rules {
        let last = match self.config.target {
            Target::Scale(t) => t,
            Target::Faces(_) => f64::INFINITY,
        };
        let strictest = self.budgets.iter().copied().fold(f64::INFINITY, f64::min);
        let first = FIRST_LIMIT_EDGES * median_edge(&self.mesh) / strictest;
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

    /// The whole mesh as one block. Of what is `wanted` again, faces stay here; positions only if no sample has them.
    fn block(&mut self, wanted: bool) -> Block<'static> {
        let rules = self.rules();
        // The paper's importance of a class, for want of its numbers: the squared inverse of our budget, 1 for the mean.
        let mean = self.budgets.iter().sum::<f64>() / self.budgets.len() as f64;
        let importance = |c: &ClassId| (mean / self.budgets[c.index()]).powi(2) as f32;
        let paper = self.config.method == Method::Paper;
        let flags = border_flags(self.mesh.positions.len(), &self.mesh.faces);
        let (samples, sample_classes) = if self.tracked { self.samples() } else { Default::default() };
        let faces = if wanted { self.mesh.faces.clone() } else { std::mem::take(&mut self.mesh.faces) };
        let positions = if wanted && !self.tracked {
            self.mesh.positions.clone()
        } else {
            std::mem::take(&mut self.mesh.positions)
        };
        Block {
            origin: self.origin,
            vertex_ids: Vec::new(),
            positions,
            flags,
            faces,
            omega: std::mem::take(&mut self.omega),
            paper_weight: if paper { self.labels.iter().map(importance).collect() } else { Vec::new() },
            group: Vec::new(),
            boxes: &[],
            samples,
            sample_classes: if self.config.record { sample_classes } else { Vec::new() },
            rules,
        }
    }

    /// A sample for each vertex: with the strictest budget and all classes around it, and the weight of the largest face there.
    fn samples(&self) -> (Vec<Sample>, Vec<u8>) {
        let sample =
            |&point: &DVec3| Sample { point, weight: 0.0, budget_m: f32::INFINITY, squared_m2: 0.0, face: NONE };
        let mut samples: Vec<Sample> = self.mesh.positions.iter().map(sample).collect();
        let mut classes = vec![0u8; samples.len()];
        let mut largest = vec![-1f32; samples.len()];
        for (f, face) in self.mesh.faces.iter().enumerate() {
            let area = self.mesh.cross(f).length() as f32;
            let budget_m = self.budgets[self.labels[f].index()] as f32;
            let bit = 1 << self.labels[f].index().min(MOST_CLASSES - 1);
            for &v in face {
                let sample = &mut samples[v as usize];
                sample.budget_m = sample.budget_m.min(budget_m);
                classes[v as usize] |= bit;
                sample.weight += area / 6.0;
                if area > largest[v as usize] {
                    largest[v as usize] = area;
                    sample.face = f as u32;
                }
            }
        }
        samples.iter_mut().for_each(|sample| sample.weight *= self.omega[sample.face as usize]);
        (samples, classes)
    }

    /// The surface that is left, about the origin, with the faces that it has of the ordered mesh by `name`; and the
    /// samples on its faces.
    fn cut(&self, done: &mut Collapsed, name: impl Fn(u32) -> u32) -> (Simplified, Vec<Sample>) {
        let positions = std::mem::take(&mut done.block.positions);
        let faces = std::mem::take(&mut done.block.faces);
        let mut samples = std::mem::take(&mut done.block.samples);
        let mut vertex = vec![NONE; positions.len()];
        let mut place = vec![NONE; faces.len()];
        let mut cut = Simplified { scale: done.scale, ..Simplified::default() };
        for (f, corners) in (0..).zip(&faces).filter(|(_, c)| c[0] != NONE) {
            place[f as usize] = cut.faces.len() as u32;
            cut.faces.push(corners.map(|v| {
                if vertex[v as usize] == NONE {
                    vertex[v as usize] = cut.positions.len() as u32;
                    cut.positions.push(positions[v as usize]);
                }
                vertex[v as usize]
            }));
            cut.face_ids.push(name(f));
            cut.labels.push(self.labels[name(f) as usize]);
        }
        samples.iter_mut().for_each(|sample| sample.face = place[sample.face as usize]);
        (cut, samples)
    }

    /// Source vertices, a quarter of the area, and centres of source faces, the rest, on faces of the cut: exact for
    /// squared distances from a plane.
    fn points(&self, samples: &[Sample], scale: f64) -> Vec<Point> {
        let mut points = Vec::with_capacity(samples.len() + self.mesh.faces.len());
        points.extend(samples.iter().map(|sample| {
            let limit = (scale * f64::from(sample.budget_m)) as f32;
            Point::new(OF_VERTICES * sample.weight, limit, sample.face)
        }));
        for (f, corners) in self.mesh.faces.iter().enumerate() {
            let area = 0.5 * self.mesh.cross(f).length() as f32;
            let near = points[corners[0] as usize].face;
            points.push(Point::new((1.0 - OF_VERTICES) * area * self.omega[f], f32::INFINITY, near));
        }
        points
    }

    fn sequence(&mut self, done: Collapsed) -> Sequence {
        let Mesh { mut positions, faces, .. } = std::mem::take(&mut self.mesh);
        let events = done.moves.events(positions.clone(), self.origin);
        positions.iter_mut().for_each(|p| *p += self.origin);
        Sequence {
            positions,
            faces,
            labels: std::mem::take(&mut self.labels),
            grid_m: self.config.grid_m,
            log: CollapseLog { events, levels: done.levels, most_m: done.most_m, folded: done.folded },
        }
    }
}

fn border_flags(vertices: usize, faces: &[[u32; 3]]) -> Vec<u8> {
    border_of(vertices, faces).into_iter().map(|b| if b { BORDER } else { 0 }).collect()
}

/// The mesh on the grid with the vertices that it uses in Morton order and its faces by their first vertex; and where
/// each face was.
fn in_order(mesh: &Mesh, grid_m: f64) -> (Mesh, Vec<u32>) {
    let low = mesh.positions.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let high = mesh.positions.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    let cells = f64::from(MORTON_CELLS - 1) / (high - low).max_element().max(f64::MIN_POSITIVE);
    let key = |p: DVec3| {
        let cell = ((p - low) * cells).as_uvec3();
        spread(cell.x) | spread(cell.y) << 1 | spread(cell.z) << 2
    };
    let mut place = vec![NONE; mesh.positions.len()];
    mesh.faces.iter().flatten().for_each(|&v| place[v as usize] = 0);
    let used = mesh.positions.iter().zip(0u64..).filter(|&(_, v)| place[v as usize] != NONE);
    let mut order: Vec<u64> = used.map(|(p, v)| u64::from(key(*p)) << 32 | v).collect();
    sort_by_upper_half(&mut order);
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
