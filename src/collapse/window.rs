//! Collapses part of a surface that is larger than memory: whole cells, held together by their positions.
//!
//! In: the [`Patch`] of every cell of a window, and which vertices cells outside it use. Out: the patches as they are
//! after one step.
//!
//! # Method
//! 1. A patch is a cell's current faces and the samples that ride on them. Patches of neighbours share no ids: a vertex
//!    on a wall stands in both, at the same bits, and is one vertex again while both are in one window.
//! 2. [`step`] welds the window's patches, locks what the outside uses, splits the faces into blocks of bounded size and
//!    collapses each. Blocks lock the vertices they share and are cut elsewhere in every step, so nothing stays locked.
//! 3. Small parts that hang together with nothing go when something else is within their limit (`islands`).
//! 4. After a step faces take the class and weight that most of the samples riding on them have.
//! 5. As scales grow, [`Patch::thinned`] lets one sample stand for others near it; it then has that much less to spare.
//!
//! # Cost
//! Of the edges considered on a scan (0.77 million faces, nine steps) one in nine flips, half are refused by their samples,
//! one in twelve for a face across open space, one in five collapses, the rest is filed anew. The first step takes two
//! fifths of all, at 13 µs a collapse no more than `simplify`; later ones take 24 to 130. In the last ones samples are most
//! of it: cubes smaller than the source's faces thin nothing, and at edges of 0.22 m and budgets of 0.1 m 415 of 439
//! thousand samples ride on to the root, 700 to a star.
//!
//! Tried and left out: to ask first the sample that refused last decides four of five refusals and takes 0.93 to 0.97 of the
//! time, for 4 bytes a face and a second way to ask; faces in Morton order gain nothing; blocks of 25 000 faces take 0.95 and
//! leave 1 to 3 % more faces; steps of twice the scale take 0.85 to 0.9 and overshoot what a tile may have by a third.
//!
//! # Promises
//! - No sample, nor any it stands for, is further than t·b from its own cell's surface after a step to t.
//! - Neighbouring patches keep their common border bit for bit (`two_windows_keep_their_border`).
//! - The result depends on the patches alone.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::block::{BORDER, Block, Energy, LOCKED, Limit, Rules, Sample as Tracked};
use super::blocks::{border_of, mark_walls, split_faces};
use super::islands::drop_islands;
use super::{MOST_CLASSES, NONE};
use crate::geo::Rect;
use crate::geo::hash::BitsMap;
use crate::ids::ClassId;
use crate::mesh::GRID_PER_M;

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

/// A tunnel closes when the loop around it is shorter than this many reaches: no wider than what may deviate. Real
/// scans have hundreds of them, and none of them would let its surroundings go.
const SMALL_LOOP_REACHES: f64 = 6.0;

/// The current surface of one cell. Positions are local metres; vertices are told apart by their position.
#[derive(Debug, Clone, Default)]
pub struct Patch {
    /// By vertex.
    pub positions: Vec<DVec3>,
    /// Corners.
    pub faces: Vec<[u32; 3]>,
    /// Class of each face, by the samples riding on it.
    pub labels: Vec<ClassId>,
    /// Per face: Σ P(c|f)/b_c², 1/m².
    pub omega: Vec<f32>,
    /// What holds the surface near the source.
    pub samples: Vec<Sample>,
    /// Per sample, the face it rides on.
    pub rides: Vec<u32>,
}

/// A point of the source.
#[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Sample {
    /// Where it is, local metres.
    pub at: [f64; 3],
    /// Deviation allowed at scale 1, metres.
    pub budget_m: f32,
    /// Weight of the face it came from.
    pub omega: f32,
    /// Samples it stands for are no further from it than this, metres.
    pub reach_m: f32,
    /// Area of the source it stands for, m².
    pub area_m2: f32,
    /// Squared distance to the surface, m².
    pub squared_m2: f32,
    /// Class of the face it came from.
    pub class: u16,
    /// Classes of all faces around it there, a bit each.
    pub classes: u16,
}

/// What a step is made with.
#[derive(Debug, Clone, Copy)]
pub struct StepSettings {
    /// Scale t.
    pub scale: f64,
    /// The strictest budget of the scheme, metres: open borders closer than t times this may join.
    pub strictest_m: f64,
    /// Number of classes.
    pub classes: usize,
    /// A block has at most this many faces.
    pub block_faces: usize,
    /// Where blocks are cut: elsewhere in odd steps than in even ones.
    pub odd: bool,
}

/// Thinned samples are about this share of t·b apart: so many stay that a face of the level still carries dozens, and
/// what they stand for costs them little of their limit.
pub const THINNING_SHARE: f64 = 0.125;

impl Patch {
    /// The source itself: a sample at every vertex, with the strictest budget of the faces around it and the class and
    /// weight of the largest.
    pub fn of_source(
        positions: Vec<DVec3>,
        faces: Vec<[u32; 3]>,
        labels: Vec<ClassId>,
        omega: Vec<f32>,
        budgets_m: &[f64],
    ) -> Self {
        let blank = Sample {
            at: [0.0; 3],
            budget_m: f32::INFINITY,
            omega: 0.0,
            reach_m: 0.0,
            area_m2: 0.0,
            squared_m2: 0.0,
            class: 0,
            classes: 0,
        };
        let mut samples: Vec<Sample> = positions.iter().map(|p| Sample { at: p.to_array(), ..blank }).collect();
        let mut rides = vec![NONE; positions.len()];
        let mut largest = vec![-1f32; positions.len()];
        for (f, face) in faces.iter().enumerate() {
            let [a, b, c] = face.map(|v| positions[v as usize]);
            let area = (b - a).cross(c - a).length() as f32;
            for v in face.map(|v| v as usize) {
                let sample = &mut samples[v];
                sample.budget_m = sample.budget_m.min(budgets_m[labels[f].index()] as f32);
                sample.area_m2 += area / 6.0;
                sample.classes |= 1 << labels[f].index().min(MOST_CLASSES - 1);
                if area > largest[v] {
                    largest[v] = area;
                    (sample.omega, sample.class) = (omega[f], labels[f].index() as u16);
                    rides[v] = f as u32;
                }
            }
        }
        let mut patch = Self { positions, faces, labels, omega, samples, rides };
        patch.drop_riderless();
        patch
    }

    /// Vertices that no face uses hold nothing down.
    fn drop_riderless(&mut self) {
        let mut kept = self.rides.iter();
        self.samples.retain(|_| kept.next().is_some_and(|f| *f != NONE));
        self.rides.retain(|f| *f != NONE);
    }

    /// Several patches as one; vertices at equal positions become one.
    pub fn joined(patches: Vec<Self>) -> Self {
        let mut all = Self::default();
        let mut ids = Ids::default();
        for patch in patches {
            let first = all.faces.len() as u32;
            let new: Vec<u32> = patch.positions.iter().map(|p| ids.of(*p, &mut all.positions)).collect();
            all.faces.extend(patch.faces.iter().map(|f| f.map(|v| new[v as usize])));
            all.labels.extend(patch.labels);
            all.omega.extend(patch.omega);
            all.samples.extend(patch.samples);
            all.rides.extend(patch.rides.iter().map(|f| f + first));
        }
        all
    }

    /// Lets one sample of every small cube stand for the others of its budget there, for steps from `scale` on.
    pub fn thinned(mut self, scale: f64) -> Self {
        let key = |s: &Sample| {
            let cube = scale * f64::from(s.budget_m) * THINNING_SHARE;
            let at = (DVec3::from_array(s.at) / cube).floor().as_i64vec3();
            (s.budget_m.to_bits(), at.x, at.y, at.z)
        };
        let mut order: Vec<u32> = (0..self.samples.len() as u32).collect();
        let keys: Vec<_> = self.samples.par_iter().map(key).collect();
        order.par_sort_unstable_by_key(|&s| (keys[s as usize], s));
        let mut keep = vec![false; self.samples.len()];
        for group in order.chunk_by(|&a, &b| keys[a as usize] == keys[b as usize]) {
            let at = |s: u32| DVec3::from_array(self.samples[s as usize].at);
            let middle = group.iter().map(|&s| at(s)).sum::<DVec3>() / group.len() as f64;
            let nearest = |a: &&u32, b: &&u32| {
                let d = |s: u32| (at(s) - middle).length_squared();
                d(**a).total_cmp(&d(**b)).then(a.cmp(b))
            };
            let Some(&kept) = group.iter().min_by(nearest) else { continue };
            let area_m2 = group.iter().map(|&s| self.samples[s as usize].area_m2).sum();
            let reach = |&s: &u32| (at(s) - at(kept)).length() + f64::from(self.samples[s as usize].reach_m);
            let reach = group.iter().map(reach).fold(0.0, f64::max);
            self.samples[kept as usize].area_m2 = area_m2;
            // Rounded up: a reach that is too short would break the promise.
            self.samples[kept as usize].reach_m = (reach as f32).next_up();
            if reach == 0.0 {
                self.samples[kept as usize].reach_m = 0.0;
            }
            keep[kept as usize] = true;
        }
        for (ride, keep) in self.rides.iter_mut().zip(keep) {
            *ride = if keep { *ride } else { NONE };
        }
        self.drop_riderless();
        self
    }
}

/// Vertex ids by position.
#[derive(Default)]
struct Ids(BitsMap<[u64; 3], u32>);

impl Ids {
    fn of(&mut self, p: DVec3, positions: &mut Vec<DVec3>) -> u32 {
        *self.0.entry((p + 0.0).to_array().map(f64::to_bits)).or_insert_with(|| {
            positions.push(p);
            positions.len() as u32 - 1
        })
    }
}

/// A window as one surface.
struct Window<'a> {
    surface: Patch,
    /// Per face, the cell it belongs to.
    cell: Vec<u32>,
    /// Where the cells are.
    boxes: &'a [Rect],
    locked: Vec<bool>,
    border: Vec<bool>,
}

/// Collapses all that the settings' scale admits; returns the cells in their order and how many collapses that were.
///
/// `boxes` are the cells' plans; `is_locked` tells of a vertex on its cell's walls whether a cell outside uses it.
pub fn step(
    patches: Vec<Patch>,
    boxes: &[Rect],
    is_locked: impl Fn(DVec3) -> bool + Sync,
    settings: &StepSettings,
) -> (Vec<Patch>, usize) {
    let mut window = Window::of(patches, boxes, is_locked);
    let blocks = window.split_into_blocks(settings);
    let owner = window.block_of_vertices(&blocks);
    let riders = window.riders();
    let done: Vec<Done> = blocks
        .par_iter()
        .enumerate()
        .map(|(b, faces)| window.run_block(b as u32, faces, &owner, &riders, settings))
        .collect();
    drop(riders);
    let mut collapses = 0;
    for (done, faces) in done.into_iter().zip(&blocks) {
        collapses += done.collapses;
        window.merge(done, faces);
    }
    drop_islands(&mut window.surface, &window.cell, &window.locked, settings.scale, settings.odd);
    window.vote(settings.classes);
    (window.into_patches(), collapses)
}

/// What a block hands back, in the window's ids (`rides`: sample, index into the block's faces and squared distance).
struct Done {
    faces: Vec<[u32; 3]>,
    positions: Vec<(u32, DVec3)>,
    rides: Vec<(u32, (u32, f32))>,
    collapses: usize,
}

impl<'a> Window<'a> {
    fn of(patches: Vec<Patch>, boxes: &'a [Rect], is_locked: impl Fn(DVec3) -> bool + Sync) -> Self {
        let mut cell = Vec::with_capacity(patches.iter().map(|p| p.faces.len()).sum());
        let mut surface = Patch::default();
        let mut on_walls = Ids::default();
        for (c, patch) in patches.into_iter().enumerate() {
            let first = surface.faces.len() as u32;
            // Only vertices on walls can stand in two cells.
            let is_on_wall = |p: &DVec3| (0..2).any(|k| p[k] == boxes[c].min[k] || p[k] == boxes[c].max[k]);
            let mut new = Vec::with_capacity(patch.positions.len());
            for p in &patch.positions {
                if is_on_wall(p) {
                    new.push(on_walls.of(*p, &mut surface.positions));
                } else {
                    new.push(surface.positions.len() as u32);
                    surface.positions.push(*p);
                }
            }
            cell.resize(cell.len() + patch.faces.len(), c as u32);
            surface.faces.extend(patch.faces.iter().map(|f| f.map(|v| new[v as usize])));
            surface.labels.extend(patch.labels);
            surface.omega.extend(patch.omega);
            surface.samples.extend(patch.samples);
            surface.rides.extend(patch.rides.iter().map(|f| f + first));
        }
        let mut locked = vec![false; surface.positions.len()];
        let walls: Vec<u32> = on_walls.0.into_values().collect();
        let outside: Vec<u32> = walls.into_par_iter().filter(|&v| is_locked(surface.positions[v as usize])).collect();
        outside.into_iter().for_each(|v| locked[v as usize] = true);
        let border = border_of(surface.positions.len(), &surface.faces);
        Self { surface, cell, boxes, locked, border }
    }

    /// Faces by block: a k-d tree over face centres in plan, cut off the middle in every other step.
    fn split_into_blocks(&self, settings: &StepSettings) -> Vec<Vec<u32>> {
        let at = |v: u32| self.surface.positions[v as usize].truncate();
        let centers: Vec<DVec2> =
            self.surface.faces.par_iter().map(|f| f.iter().map(|&v| at(v)).sum::<DVec2>()).collect();
        let all: Vec<u32> = (0..self.surface.faces.len() as u32).collect();
        split_faces(all, &centers, settings.block_faces, cut_share(settings.odd))
    }

    /// The block that has all faces of a vertex, `NONE` where several share it.
    fn block_of_vertices(&self, blocks: &[Vec<u32>]) -> Vec<u32> {
        const UNSEEN: u32 = u32::MAX - 1;
        let mut owner = vec![UNSEEN; self.surface.positions.len()];
        for (b, faces) in blocks.iter().enumerate() {
            for &v in faces.iter().flat_map(|&f| &self.surface.faces[f as usize]) {
                let seen = &mut owner[v as usize];
                *seen = if *seen == UNSEEN || *seen == b as u32 { b as u32 } else { NONE };
            }
        }
        owner
    }

    /// Samples by face: for face f, `list[start[f]..start[f + 1]]`.
    fn riders(&self) -> (Vec<u32>, Vec<u32>) {
        let faces = self.surface.faces.len();
        let mut start = vec![0u32; faces + 1];
        self.surface.rides.iter().for_each(|&f| start[f as usize + 1] += 1);
        for f in 0..faces {
            start[f + 1] += start[f];
        }
        let mut at = start.clone();
        let mut list = vec![0; start[faces] as usize];
        for (s, &f) in self.surface.rides.iter().enumerate() {
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
        settings: &StepSettings,
    ) -> Done {
        let surface = &self.surface;
        let mut vertex_ids: Vec<u32> = faces.iter().flat_map(|&f| surface.faces[f as usize]).collect();
        vertex_ids.sort_unstable();
        vertex_ids.dedup();
        let local =
            |v: u32| vertex_ids.binary_search(&v).unwrap_or_else(|_| unreachable!("every corner was listed")) as u32;
        let origin = surface.positions[vertex_ids[0] as usize];
        let faces_local: Vec<[u32; 3]> = faces.iter().map(|&f| surface.faces[f as usize].map(local)).collect();
        let group: Vec<u32> = faces.iter().map(|&f| self.cell[f as usize]).collect();
        let positions: Vec<DVec3> = vertex_ids.iter().map(|&v| surface.positions[v as usize] - origin).collect();
        let boxes: Vec<Rect> = self.boxes.iter().map(|x| x.moved(-origin.truncate())).collect();
        let flag = |v: &u32| {
            let is_free = owner[*v as usize] == b && !self.locked[*v as usize];
            (if is_free { 0 } else { LOCKED }) | if self.border[*v as usize] { BORDER } else { 0 }
        };
        let mut flags: Vec<u8> = vertex_ids.iter().map(flag).collect();
        mark_walls(&mut flags, &positions, &faces_local, &group, &boxes);
        let (start, list) = riders;
        let mut sample_ids = Vec::new();
        let mut rides = Vec::new();
        for (i, &f) in faces.iter().enumerate() {
            sample_ids.extend_from_slice(&list[start[f as usize] as usize..start[f as usize + 1] as usize]);
            rides.resize(sample_ids.len(), i as u32);
        }
        // Those it stands for have to be within the limit too.
        let tracked = |(&s, face): (&u32, u32)| {
            let s = &surface.samples[s as usize];
            let spent_m = f64::from(s.reach_m) / settings.scale;
            let left_m = (f64::from(s.budget_m) - spent_m) as f32;
            Tracked {
                point: DVec3::from_array(s.at) - origin,
                weight: s.area_m2 * s.omega,
                budget_m: if s.reach_m > 0.0 { left_m.next_down().max(0.0) } else { s.budget_m },
                squared_m2: s.squared_m2,
                face,
            }
        };
        let reach_m = settings.scale * settings.strictest_m;
        let block = Block {
            origin,
            positions,
            flags,
            faces: faces_local,
            omega: faces.iter().map(|&f| surface.omega[f as usize]).collect(),
            paper_weight: Vec::new(),
            group,
            boxes: &boxes,
            samples: sample_ids.iter().zip(rides).map(tracked).collect(),
            sample_classes: Vec::new(),
            rules: Rules {
                energy: Energy::Memoryless,
                half_edge: false,
                limit: Limit::Scale(settings.scale),
                gap_reach_m: reach_m,
                loop_reach_m: SMALL_LOOP_REACHES * reach_m,
                grid_m: 1.0 / GRID_PER_M,
                stop_faces: 0,
                recorded: false,
            },
            vertex_ids,
        };
        let done = block.collapse();
        let (block, events) = (done.block, done.log);
        let global = |v: u32| if v == NONE { NONE } else { block.vertex_ids[v as usize] };
        Done {
            faces: block.faces.iter().map(|f| f.map(global)).collect(),
            positions: events.iter().map(|e| (e.kept, e.position)).collect(),
            rides: sample_ids.into_iter().zip(block.samples.iter().map(|s| (s.face, s.squared_m2))).collect(),
            collapses: events.len(),
        }
    }

    fn merge(&mut self, done: Done, faces: &[u32]) {
        for (&f, corners) in faces.iter().zip(&done.faces) {
            self.surface.faces[f as usize] = *corners;
        }
        for (s, (i, squared_m2)) in done.rides {
            self.surface.rides[s as usize] = faces[i as usize];
            self.surface.samples[s as usize].squared_m2 = squared_m2;
        }
        for (v, position) in done.positions {
            self.surface.positions[v as usize] = position;
        }
    }

    /// Faces take the class most of their samples have and the mean of their weights; faces without keep theirs.
    fn vote(&mut self, classes: usize) {
        let (start, list) = self.riders();
        let Patch { samples, labels, omega, .. } = &mut self.surface;
        labels.par_iter_mut().zip(omega).enumerate().for_each(|(f, (label, omega))| {
            let of_face = &list[start[f] as usize..start[f + 1] as usize];
            if of_face.is_empty() {
                return;
            }
            let mut votes = vec![0u32; classes];
            of_face.iter().for_each(|&s| votes[samples[s as usize].class as usize] += 1);
            let most = votes.iter().max().copied().unwrap_or(0);
            if votes[label.index()] < most {
                *label = ClassId(votes.iter().position(|&n| n == most).unwrap_or(0) as u8);
            }
            *omega = of_face.iter().map(|&s| samples[s as usize].omega).sum::<f32>() / of_face.len() as f32;
        });
    }

    /// The living faces of each cell with the vertices they use, in order.
    fn into_patches(self) -> Vec<Patch> {
        let Self { surface, cell, boxes, .. } = self;
        let mut patches = vec![Patch::default(); boxes.len()];
        let mut new_face = vec![NONE; surface.faces.len()];
        let mut new_vertex = vec![NONE; surface.positions.len()];
        let mut used: Vec<u32> = Vec::new();
        let mut first = 0;
        // The faces of a cell lie together, as they were put there.
        for of_cell in cell.chunk_by(|a, b| a == b) {
            let patch = &mut patches[of_cell[0] as usize];
            for (i, new_face) in new_face[first..first + of_cell.len()].iter_mut().enumerate() {
                let f = first + i;
                let face = surface.faces[f];
                if face[0] == NONE {
                    continue;
                }
                *new_face = patch.faces.len() as u32;
                patch.labels.push(surface.labels[f]);
                patch.omega.push(surface.omega[f]);
                patch.faces.push(face.map(|v| {
                    let new = &mut new_vertex[v as usize];
                    if *new == NONE {
                        *new = patch.positions.len() as u32;
                        patch.positions.push(surface.positions[v as usize]);
                        used.push(v);
                    }
                    *new
                }));
            }
            used.drain(..).for_each(|v| new_vertex[v as usize] = NONE);
            first += of_cell.len();
        }
        for (sample, ride) in surface.samples.into_iter().zip(surface.rides) {
            let patch = &mut patches[cell[ride as usize] as usize];
            patch.samples.push(sample);
            patch.rides.push(new_face[ride as usize]);
        }
        patches
    }
}

/// Where k-d trees cut: 0.5 and 0.36 are so far apart that no border of one step lies near one of the next.
pub fn cut_share(odd: bool) -> f64 {
    if odd { 0.36 } else { 0.5 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::on_grid;

    const BUDGETS: [f64; 2] = [0.05, 0.1];

    /// A rough sheet of n × n unit squares from (x, 0).
    fn sheet(x: f64, n: usize) -> Patch {
        let mut positions = Vec::new();
        for j in 0..=n {
            for i in 0..=n {
                let (i, j) = (i as f64 + x, j as f64);
                positions.push(on_grid(DVec3::new(i, j, 0.02 * ((i * 7.3).sin() + (j * 5.1).cos()))));
            }
        }
        let mut faces = Vec::new();
        for j in 0..n {
            for i in 0..n {
                let (a, m) = ((j * (n + 1) + i) as u32, n as u32 + 1);
                faces.extend([[a, a + 1, a + m + 1], [a, a + m + 1, a + m]]);
            }
        }
        let labels = (0..faces.len()).map(|f| ClassId(u8::from(f % 50 > 24))).collect();
        let omega = vec![400.0; faces.len()];
        Patch::of_source(positions, faces, labels, omega, &BUDGETS)
    }

    fn plan(x: f64, n: usize) -> Rect {
        Rect { min: DVec2::new(x, 0.0), max: DVec2::new(x + n as f64, n as f64) }
    }

    fn settings(scale: f64, odd: bool) -> StepSettings {
        StepSettings { scale, strictest_m: 0.05, classes: 2, block_faces: 100_000, odd }
    }

    fn border(patch: &Patch, x: f64) -> Vec<[u64; 3]> {
        let mut found: Vec<_> =
            (patch.positions.iter().filter(|p| p.x == x)).map(|p| p.to_array().map(f64::to_bits)).collect();
        found.sort_unstable();
        found
    }

    #[test]
    fn two_windows_keep_their_border() {
        let n = 12;
        // Together: the border simplifies, alike on both sides.
        let both = [plan(0.0, n), plan(12.0, n)];
        let (mut patches, collapses) =
            step(vec![sheet(0.0, n), sheet(12.0, n)], &both, |_| false, &settings(1.0, false));
        assert!(collapses > 100, "{collapses}");
        let common = border(&patches[0], 12.0);
        assert!(common.len() < n, "{} border vertices of {}", common.len(), n + 1);
        assert_eq!(common, border(&patches[1], 12.0));
        // Apart: the border is locked, and stays.
        let right = patches.pop().unwrap();
        let left = patches.pop().unwrap();
        let (left, _) = step(vec![left], &both[..1], |p| p.x == 12.0, &settings(2.0, true));
        let (right, _) = step(vec![right], &both[1..], |p| p.x == 12.0, &settings(2.0, true));
        assert_eq!(border(&left[0], 12.0), common);
        assert_eq!(border(&right[0], 12.0), common);
    }

    #[test]
    fn thinned_samples_stay_within_their_budget() {
        let n = 24;
        let source = sheet(0.0, n);
        let all = source.samples.clone();
        // Cubes of 2.5 m and 5 m a side: several samples in each.
        let mut patch = source.thinned(400.0);
        assert!(patch.samples.len() < all.len() / 2, "{} of {}", patch.samples.len(), all.len());
        patch.rides.iter().for_each(|f| assert!((*f as usize) < patch.faces.len()));
        patch = step(vec![patch], &[plan(0.0, n)], |_| false, &settings(400.0, false)).0.remove(0);
        let tree = crate::geo::bvh::Bvh::new(&patch.positions, &patch.faces);
        for s in all {
            let d = tree.closest(DVec3::from_array(s.at), f64::INFINITY).unwrap().distance;
            assert!(d <= 400.0 * f64::from(s.budget_m), "{d}");
        }
    }

    #[test]
    fn joined_patches_are_the_surface_they_were() {
        let whole = Patch::joined(vec![sheet(0.0, 4), sheet(4.0, 4)]);
        assert_eq!((whole.faces.len(), whole.positions.len()), (64, 45));
        assert_eq!(whole.samples.len(), 50, "each cell keeps its own samples on the wall");
        assert!(whole.rides[25..].iter().all(|f| *f >= 32));
    }
}
