//! Simplifies a mesh by edge collapses, limited by class, and records every one of them.
//!
//! In: [`Mesh`], [`Classes`]. Out: [`CollapseLog`], whose prefixes are valid meshes, and a [`Cut`] at each scale.
//!
//! # Method
//! 1. Every source vertex is a sample that rides on a face of the current surface, with the budget b of its class.
//! 2. [`Collapser::step`] takes the surface to scale t: it is split into blocks of bounded size; inside a block edges
//!    collapse in order of energy, as long as every sample that would be moved stays within t·b of the new faces.
//! 3. Border vertices closer than the strictest budget may join across the gap, so that meshes delivered in tiles grow
//!    together instead of cracking along the tiles' borders.
//! 4. Blocks lock the vertices they share and are cut elsewhere in every step, so nothing stays locked.
//! 5. After a step faces take the class and weight that most of the samples riding on them have.
//!
//! # Promises
//! - No sample is further than t·b from the surface of its own group after a step to t, so a tile alone keeps the
//!   bound, without its neighbours (`samples_stay_within_their_budget`, `a_group_keeps_its_own_surface`).
//! - A vertex on a wall between groups of faces stays on it, and no face leaves its group's cell: tiles cut from one
//!   step share their borders bit for bit (`walls_are_kept`).
//! - Replaying a prefix of the log gives the mesh of that moment (`replay_equals_the_live_mesh`).
//! - The result does not depend on the number of threads: blocks depend on the mesh alone.
//!
//! # Limits
//! Samples bound the distance from the source to the cut, not back; `tiles::error` measures both. Closed islands shrink
//! to a tetrahedron and stay; a tunnel that is no flap stays, unless `Rules::loop_reach_m` lets it close. A border that
//! two blocks share joins a step later.
//!
//! # Cost
//! About 15 µs a source face down to 0.2 % of the faces (3.1 million faces, processor time on a busy machine). Of the
//! edges tried at a scale, three are refused by their samples for each one that collapses.
//!
//! # Why not …
//! - The strict link condition: a drone scan with 600 components and 7 000 non-manifold edges stalled at 45 000 of its
//!   790 000 faces; with holes, strips and small tunnels free to close it reaches 6 700.
//! - Skipping edges whose plane energy is far above the limit: it prunes under 3 % of the refusals, which come at low
//!   energies, where samples already sit at their limit.
//! - Samples without groups: a piece whose part in one cell is small slipped into the next cell, and that tile alone was
//!   wrong by metres.
//!
//! # References
//! Garland & Heckbert 1997 (quadrics); Lindstrom & Turk 1998 (memoryless); Hoppe 1996 (the record); the semantic
//! weights replace the paper's unnumbered priority rule (§2.3) by budgets in metres.

mod block;
mod energy;
mod legal;
mod place;
mod queue;
pub mod record;
mod refit;
mod run;
mod simplify;
mod star;
mod track;
mod volume;

use std::cmp::Ordering;
use std::collections::HashMap;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::classes::Classes;
use crate::geo::Rect;
use crate::ids::ClassId;
use crate::mesh::{GRID_PER_M, Mesh};
use block::{BORDER, Block, Energy, FIX_X, FIX_Y, LOCKED, Limit, Rules, Sample};

pub use simplify::{
    Event, MOST_CLASSES, Method, Sequence, Simplified, SimplifyConfig, Target, simplify, simplify_owned,
};

/// No vertex, no face.
pub(crate) const NONE: u32 = u32::MAX;

/// A tunnel closes when the loop around it is shorter than this many reaches: no wider than what may deviate. Real
/// scans have hundreds of them, and none of them would let its surroundings go.
const SMALL_LOOP_REACHES: f64 = 6.0;
/// Where the limit grows: t is at least this many times the root mean square of all deviations in budgets. At 8 the
/// limit binds outliers alone: on two real meshes the mean stayed within 1 % and the largest distance fell by 40 %.
const SPREAD: f64 = 8.0;
/// `Energy::Paper`: faces whose normals differ by more than 15° are not coplanar, and cost so much more.
const COPLANAR_COS: f32 = 0.966;
const CREASE_FACTOR: f32 = 4.0;

/// How blocks are made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CollapseConfig {
    /// A block has at most this many faces. Smaller blocks lock more borders, larger ones leave the cache.
    /// Default: 100 000.
    pub block_faces: usize,
}

impl Default for CollapseConfig {
    fn default() -> Self {
        Self { block_faces: 100_000 }
    }
}

/// Faces of a group never leave the group's box, and borders between groups stay on the boxes' walls.
pub struct Fences<'a> {
    /// Group of every face of the source mesh.
    pub group_of_face: &'a [u32],
    /// Box of every group.
    pub boxes: &'a [Rect],
}

/// One collapse: `gone` merges into `kept`, which moves to `position`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Collapse {
    /// Vertex that stays.
    pub kept: u32,
    /// Vertex that merges into it.
    pub gone: u32,
    /// Where `kept` is afterwards, local metres.
    pub position: DVec3,
    /// Energy at which it was done, m⁴ per squared budget.
    pub energy: f32,
    /// Largest deviation of a sample it moved, as a share of that sample's limit at the step's scale.
    pub share: f32,
}

/// The record of a run.
#[derive(Debug, Clone, Default)]
pub struct CollapseLog {
    /// In order; any prefix is a valid mesh.
    pub events: Vec<Collapse>,
    /// Faces that an event folded onto others, so that they are gone though their corners differ: event, source face.
    pub folded: Vec<(u32, u32)>,
    /// Scale and number of events at the end of each step.
    pub steps: Vec<(f64, usize)>,
}

impl CollapseLog {
    /// The mesh after the first `events` collapses: positions by source vertex, and faces (source ids) that live.
    pub fn replay(&self, mesh: &Mesh, events: usize) -> (Vec<DVec3>, Vec<(u32, [u32; 3])>) {
        let mut positions = mesh.positions.clone();
        let mut into: Vec<u32> = (0..positions.len() as u32).collect();
        for event in &self.events[..events] {
            positions[event.kept as usize] = event.position;
            into[event.gone as usize] = event.kept;
        }
        // A vertex is gone before the one it merged into, so going backwards every target is already final.
        for event in self.events[..events].iter().rev() {
            into[event.gone as usize] = into[event.kept as usize];
        }
        let mut folded: Vec<u32> = self.folded.iter().filter(|(e, _)| (*e as usize) < events).map(|f| f.1).collect();
        folded.sort_unstable();
        let faces = mesh.faces.iter().enumerate().map(|(f, face)| (f as u32, face.map(|v| into[v as usize])));
        let lives = |(f, [a, b, c]): &(u32, [u32; 3])| a != b && b != c && c != a && folded.binary_search(f).is_err();
        (positions, faces.filter(lives).collect())
    }
}

/// The surface at the end of a step.
#[derive(Debug, Clone, Default)]
pub struct Cut {
    /// Scale of the step.
    pub scale: f64,
    /// By source vertex, local metres; meaningful for vertices that `faces` use.
    pub positions: Vec<DVec3>,
    /// Corners as source vertex ids.
    pub faces: Vec<[u32; 3]>,
    /// Source face each face descends from.
    pub face_ids: Vec<u32>,
    /// Class of each face, by the samples riding on it.
    pub labels: Vec<ClassId>,
}

/// A collapse in progress; see the module.
pub struct Collapser<'a> {
    config: CollapseConfig,
    source: &'a Mesh,
    positions: Vec<DVec3>,
    border: Vec<bool>,
    faces: Vec<[u32; 3]>,
    face_ids: Vec<u32>,
    omega: Vec<f32>,
    labels: Vec<ClassId>,
    samples: Samples,
    classes: usize,
    strictest_m: f64,
    log: CollapseLog,
}

/// The tracked samples: one for each source vertex, and one more for each further leaf that has it on its wall, so that
/// every leaf's part of the surface is held down by samples of its own.
#[derive(Default)]
struct Samples {
    /// The source vertex it is at.
    vertex: Vec<u32>,
    /// Current face each rides on (index into `Collapser::faces`), `NONE` for a vertex no face uses.
    face: Vec<u32>,
    budget_m: Vec<f32>,
    omega: Vec<f32>,
    /// A third of the area of the faces around it, m².
    area_m2: Vec<f32>,
    /// Squared distance to the surface, m².
    squared_m2: Vec<f32>,
    class: Vec<ClassId>,
}

impl<'a> Collapser<'a> {
    /// Starts from the source itself, every sample on a face at its vertex. `leaf_of_face` is the finest grouping that
    /// any step will use: groups of later steps are unions of leaves.
    pub fn new(mesh: &'a Mesh, leaf_of_face: &[u32], classes: &Classes, config: &CollapseConfig) -> Self {
        let budgets: Vec<f64> = classes.scheme.0.iter().map(|c| c.budget_m).collect();
        let weight = |f: usize| {
            let sum = classes.of(f).iter().zip(&budgets).map(|(p, b)| f64::from(*p) / (b * b)).sum::<f64>();
            sum as f32
        };
        let omega: Vec<f32> = (0..mesh.faces.len()).into_par_iter().map(weight).collect();
        let samples = Samples::of(mesh, leaf_of_face, classes, &omega, &budgets);
        Self {
            config: config.clone(),
            source: mesh,
            positions: mesh.positions.clone(),
            border: border_vertices(mesh),
            faces: mesh.faces.clone(),
            face_ids: (0..mesh.faces.len() as u32).collect(),
            omega,
            labels: classes.label.clone(),
            samples,
            classes: budgets.len(),
            strictest_m: budgets.iter().copied().fold(f64::INFINITY, f64::min),
            log: CollapseLog::default(),
        }
    }

    /// Faces left.
    pub fn face_count(&self) -> usize {
        self.faces.len()
    }

    /// Source ids of the faces left.
    pub fn face_ids(&self) -> &[u32] {
        &self.face_ids
    }

    /// The surface as it is.
    pub fn cut(&self) -> Cut {
        Cut {
            scale: self.log.steps.last().map_or(0.0, |s| s.0),
            positions: self.positions.clone(),
            faces: self.faces.clone(),
            face_ids: self.face_ids.clone(),
            labels: self.labels.clone(),
        }
    }

    /// The record so far.
    pub fn log(&self) -> &CollapseLog {
        &self.log
    }

    /// Ends the collapse with its record.
    pub fn into_log(self) -> CollapseLog {
        self.log
    }

    /// Collapses all that scale `t` admits; returns how many collapses that were.
    pub fn step(&mut self, t: f64, fences: &Fences) -> usize {
        let order = self.split_into_blocks();
        let owner = self.block_of_vertices(&order);
        let riders = self.riders();
        let done: Vec<Done> = order
            .par_iter()
            .enumerate()
            .map(|(b, faces)| self.run_block(b as u32, faces, &owner, &riders, t, fences))
            .collect();
        drop(riders);
        let before = self.log.events.len();
        done.into_iter().zip(&order).for_each(|(done, faces)| self.merge(done, faces));
        self.compact();
        self.vote();
        self.log.steps.push((t, self.log.events.len()));
        self.log.events.len() - before
    }

    /// Faces by block: a k-d tree over face centres in plan, cut off the middle in every other step.
    fn split_into_blocks(&self) -> Vec<Vec<u32>> {
        // 0.5 and 0.36: far enough apart that no block border of one step lies near one of the next.
        let share = if self.log.steps.len().is_multiple_of(2) { 0.5 } else { 0.36 };
        let centers: Vec<DVec2> =
            self.faces.par_iter().map(|f| f.iter().map(|&v| self.positions[v as usize].truncate()).sum()).collect();
        let all: Vec<u32> = (0..self.faces.len() as u32).collect();
        split_faces(all, &centers, self.config.block_faces, share)
    }

    /// The block that has all faces of a vertex, `NONE` where several share it.
    fn block_of_vertices(&self, order: &[Vec<u32>]) -> Vec<u32> {
        const UNSEEN: u32 = u32::MAX - 1;
        let mut owner = vec![UNSEEN; self.positions.len()];
        for (b, faces) in order.iter().enumerate() {
            for &v in faces.iter().flat_map(|&f| &self.faces[f as usize]) {
                let seen = &mut owner[v as usize];
                *seen = if *seen == UNSEEN || *seen == b as u32 { b as u32 } else { NONE };
            }
        }
        owner
    }

    /// Samples by face: for face f, `list[start[f]..start[f + 1]]`.
    fn riders(&self) -> (Vec<u32>, Vec<u32>) {
        let mut start = vec![0u32; self.faces.len() + 1];
        for &f in self.samples.face.iter().filter(|&&f| f != NONE) {
            start[f as usize + 1] += 1;
        }
        for f in 0..self.faces.len() {
            start[f + 1] += start[f];
        }
        let mut at = start.clone();
        let mut list = vec![0; start[self.faces.len()] as usize];
        for (s, &f) in self.samples.face.iter().enumerate().filter(|(_, f)| **f != NONE) {
            list[at[f as usize] as usize] = s as u32;
            at[f as usize] += 1;
        }
        (start, list)
    }

    fn run_block(
        &self,
        b: u32,
        faces: &[u32],
        owner: &[u32],
        riders: &(Vec<u32>, Vec<u32>),
        t: f64,
        fences: &Fences,
    ) -> Done {
        let mut vertex_ids: Vec<u32> = faces.iter().flat_map(|&f| self.faces[f as usize]).collect();
        vertex_ids.sort_unstable();
        vertex_ids.dedup();
        let local =
            |v: u32| vertex_ids.binary_search(&v).unwrap_or_else(|_| unreachable!("every corner was listed")) as u32;
        let origin = self.positions[vertex_ids[0] as usize];
        let faces_local: Vec<[u32; 3]> = faces.iter().map(|&f| self.faces[f as usize].map(local)).collect();
        let group: Vec<u32> = faces.iter().map(|&f| fences.group_of_face[self.face_ids[f as usize] as usize]).collect();
        let positions: Vec<DVec3> = vertex_ids.iter().map(|&v| self.positions[v as usize] - origin).collect();
        let boxes: Vec<Rect> = fences.boxes.iter().map(|x| x.moved(-origin.truncate())).collect();
        let mut flags: Vec<u8> = vertex_ids
            .iter()
            .map(
                |&v| if owner[v as usize] == b { 0 } else { LOCKED } | if self.border[v as usize] { BORDER } else { 0 },
            )
            .collect();
        mark_walls(&mut flags, &positions, &faces_local, &group, &boxes);
        let mut sample_ids = Vec::new();
        let mut rides = Vec::new();
        for (i, &f) in faces.iter().enumerate() {
            let (start, list) = riders;
            let of_face = &list[start[f as usize] as usize..start[f as usize + 1] as usize];
            sample_ids.extend_from_slice(of_face);
            rides.resize(sample_ids.len(), i as u32);
        }
        let rules = Rules {
            energy: Energy::Memoryless,
            half_edge: false,
            limit: Limit::Scale(t),
            gap_reach_m: t * self.strictest_m,
            loop_reach_m: SMALL_LOOP_REACHES * t * self.strictest_m,
            grid_m: 1.0 / GRID_PER_M,
            stop_faces: 0,
            recorded: false,
        };
        let block = Block {
            origin,
            positions,
            flags,
            faces: faces_local,
            omega: faces.iter().map(|&f| self.omega[f as usize]).collect(),
            paper_weight: Vec::new(),
            group,
            boxes: &boxes,
            samples: sample_ids
                .iter()
                .zip(rides)
                .map(|(&s, face)| self.samples.placed(s, face, self.source, origin))
                .collect(),
            rules,
            vertex_ids,
        };
        let done = block.collapse();
        let (block, events) = (done.block, done.log);
        let global = |v: u32| if v == NONE { NONE } else { block.vertex_ids[v as usize] };
        Done {
            faces: block.faces.iter().map(|f| f.map(global)).collect(),
            border: block
                .vertex_ids
                .iter()
                .zip(&block.flags)
                .filter(|(_, f)| **f & BORDER != 0)
                .map(|(v, _)| *v)
                .collect(),
            rides: sample_ids.into_iter().zip(block.samples.iter().map(|s| (s.face, s.squared_m2))).collect(),
            events,
            folded: done.folded,
        }
    }

    fn merge(&mut self, done: Done, faces: &[u32]) {
        for (&f, corners) in faces.iter().zip(&done.faces) {
            self.faces[f as usize] = *corners;
        }
        for (s, (i, squared_m2)) in done.rides {
            self.samples.face[s as usize] = faces[i as usize];
            self.samples.squared_m2[s as usize] = squared_m2;
        }
        for v in done.border {
            self.border[v as usize] = true;
        }
        for event in &done.events {
            self.positions[event.kept as usize] = event.position;
        }
        let first = self.log.events.len() as u32;
        self.log
            .folded
            .extend(done.folded.iter().map(|&(e, f)| (first + e, self.face_ids[faces[f as usize] as usize])));
        self.log.events.extend(done.events);
    }

    /// Drops dead faces; the order of the others stays.
    fn compact(&mut self) {
        let mut new_id = vec![NONE; self.faces.len()];
        let mut count = 0;
        for (f, id) in new_id.iter_mut().enumerate() {
            if self.faces[f][0] == NONE {
                continue;
            }
            *id = count as u32;
            self.faces[count] = self.faces[f];
            self.face_ids[count] = self.face_ids[f];
            self.omega[count] = self.omega[f];
            self.labels[count] = self.labels[f];
            count += 1;
        }
        self.faces.truncate(count);
        self.face_ids.truncate(count);
        self.omega.truncate(count);
        self.labels.truncate(count);
        for f in self.samples.face.iter_mut().filter(|f| **f != NONE) {
            *f = new_id[*f as usize];
        }
    }

    /// Faces take the class most of their samples have and the mean of their weights; faces without keep theirs.
    fn vote(&mut self) {
        let (start, list) = self.riders();
        let samples = &self.samples;
        let classes = self.classes;
        self.labels.par_iter_mut().zip(&mut self.omega).enumerate().for_each(|(f, (label, omega))| {
            let of_face = &list[start[f] as usize..start[f + 1] as usize];
            if of_face.is_empty() {
                return;
            }
            let mut votes = vec![0u32; classes];
            of_face.iter().for_each(|&s| votes[samples.class[s as usize].index()] += 1);
            let most = votes.iter().max().copied().unwrap_or(0);
            if votes[label.index()] < most {
                *label = ClassId(votes.iter().position(|&n| n == most).unwrap_or(0) as u8);
            }
            *omega = of_face.iter().map(|&s| samples.omega[s as usize]).sum::<f32>() / of_face.len() as f32;
        });
    }
}

/// What a block hands back, in global ids (`rides`: sample, index into the block's faces).
struct Done {
    faces: Vec<[u32; 3]>,
    border: Vec<u32>,
    rides: Vec<(u32, (u32, f32))>,
    events: Vec<Collapse>,
    /// Event in `events`, index into the block's faces.
    folded: Vec<(u32, u32)>,
}

impl Samples {
    /// A sample takes the strictest budget of the faces around its vertex, so that an edge between ground and wall is
    /// kept as well as the wall, and the class and weight of the largest of them in its leaf.
    fn of(mesh: &Mesh, leaf_of_face: &[u32], classes: &Classes, omega: &[f32], budgets: &[f64]) -> Self {
        let count = mesh.positions.len();
        let mut samples = Self {
            vertex: (0..count as u32).collect(),
            face: vec![NONE; count],
            budget_m: vec![f32::INFINITY; count],
            omega: vec![0.0; count],
            area_m2: vec![0.0; count],
            squared_m2: vec![0.0; count],
            class: vec![ClassId(0); count],
        };
        let mut strictest = vec![f32::INFINITY; count];
        let mut largest = vec![-1f32; count];
        // Sample of a vertex in a leaf other than that of its first face.
        let mut further: HashMap<(u32, u32), u32> = HashMap::new();
        for (f, face) in mesh.faces.iter().enumerate() {
            let area = mesh.cross(f).length() as f32;
            for &v in face {
                strictest[v as usize] = strictest[v as usize].min(budgets[classes.label[f].index()] as f32);
                let first = samples.face[v as usize];
                let own = first == NONE || leaf_of_face[first as usize] == leaf_of_face[f];
                let s = if own { v } else { *further.entry((v, leaf_of_face[f])).or_insert_with(|| samples.push(v)) }
                    as usize;
                largest.resize(samples.vertex.len(), -1.0);
                samples.area_m2[s] += area / 6.0;
                if area > largest[s] {
                    largest[s] = area;
                    samples.face[s] = f as u32;
                    samples.omega[s] = omega[f];
                    samples.class[s] = classes.label[f];
                }
            }
        }
        for (budget, &v) in samples.budget_m.iter_mut().zip(&samples.vertex) {
            *budget = strictest[v as usize];
        }
        samples
    }

    /// Sample `s` as a block has it, riding on the block's face `face`.
    fn placed(&self, s: u32, face: u32, source: &Mesh, origin: DVec3) -> Sample {
        let s = s as usize;
        Sample {
            point: source.positions[self.vertex[s] as usize] - origin,
            weight: self.area_m2[s] * self.omega[s],
            budget_m: self.budget_m[s],
            squared_m2: self.squared_m2[s],
            face,
            class: self.class[s].0,
        }
    }

    fn push(&mut self, vertex: u32) -> u32 {
        self.vertex.push(vertex);
        self.face.push(NONE);
        self.budget_m.push(f32::INFINITY);
        self.omega.push(0.0);
        self.area_m2.push(0.0);
        self.squared_m2.push(0.0);
        self.class.push(ClassId(0));
        self.vertex.len() as u32 - 1
    }
}

/// Vertices on an edge with one face. Edges are filed under their lower end: six of them are sorted sooner than all.
fn border_vertices(mesh: &Mesh) -> Vec<bool> {
    let edges = || mesh.faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
    let mut start = vec![0u32; mesh.positions.len() + 1];
    edges().for_each(|(a, b)| start[a.min(b) as usize] += 1);
    let mut total = 0;
    for at in &mut start {
        total += *at;
        *at = total;
    }
    let mut upper = vec![0u32; total as usize];
    for (a, b) in edges() {
        let at = &mut start[a.min(b) as usize];
        *at -= 1;
        upper[*at as usize] = a.max(b);
    }
    let mut border = vec![false; mesh.positions.len()];
    for v in 0..mesh.positions.len() {
        let filed = &mut upper[start[v] as usize..start[v + 1] as usize];
        filed.sort_unstable();
        for group in filed.chunk_by(|a, b| a == b).filter(|g| g.len() == 1) {
            border[v] = true;
            border[group[0] as usize] = true;
        }
    }
    border
}

/// Sets `FIX_X` and `FIX_Y` on vertices that faces of several groups share.
fn mark_walls(flags: &mut [u8], positions: &[DVec3], faces: &[[u32; 3]], group: &[u32], boxes: &[Rect]) {
    let mut first = vec![NONE; positions.len()];
    let mut shared = vec![false; positions.len()];
    for (face, &g) in faces.iter().zip(group) {
        for &v in face {
            let seen = &mut first[v as usize];
            shared[v as usize] |= *seen != NONE && *seen != g;
            *seen = g;
        }
    }
    for (face, &g) in faces.iter().zip(group) {
        let cell = &boxes[g as usize];
        for &v in face.iter().filter(|&&v| shared[v as usize]) {
            let p = positions[v as usize];
            if p.x == cell.min.x || p.x == cell.max.x {
                flags[v as usize] |= FIX_X;
            }
            if p.y == cell.min.y || p.y == cell.max.y {
                flags[v as usize] |= FIX_Y;
            }
        }
    }
}

fn split_faces(mut faces: Vec<u32>, centers: &[DVec2], most: usize, share: f64) -> Vec<Vec<u32>> {
    if faces.len() <= most {
        return if faces.is_empty() { Vec::new() } else { vec![faces] };
    }
    let at = |f: &u32| centers[*f as usize];
    let low = faces.iter().map(at).fold(DVec2::INFINITY, DVec2::min);
    let high = faces.iter().map(at).fold(DVec2::NEG_INFINITY, DVec2::max);
    let axis = usize::from(high.y - low.y > high.x - low.x);
    let by_axis = |a: &u32, b: &u32| -> Ordering { at(a)[axis].total_cmp(&at(b)[axis]).then(a.cmp(b)) };
    let middle = (faces.len() as f64 * share) as usize;
    faces.select_nth_unstable_by(middle, by_axis);
    let mut upper = faces.split_off(middle);
    // Selection leaves halves in no particular order; the blocks' order must be the mesh's.
    rayon::join(|| faces.par_sort_unstable(), || upper.par_sort_unstable());
    let (mut a, b) =
        rayon::join(|| split_faces(faces, centers, most, share), || split_faces(upper, centers, most, share));
    a.extend(b);
    a
}

#[cfg(test)]
mod tests;
