//! The block-wise collapse of a whole scene, scale by scale; see the module above.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::block::{BORDER, Block, Energy, LOCKED, Limit, Rules};
use super::blocks::{border_vertices, mark_walls, split_faces};
use super::samples::Samples;
use super::{Collapse, CollapseLog, NONE};
use crate::classes::Classes;
use crate::geo::Rect;
use crate::ids::ClassId;
use crate::mesh::{GRID_PER_M, Mesh};

/// A tunnel closes when the loop around it is shorter than this many reaches: no wider than what may deviate. Real
/// scans have hundreds of them, and none of them would let its surroundings go.
const SMALL_LOOP_REACHES: f64 = 6.0;

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
