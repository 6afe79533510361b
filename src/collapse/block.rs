//! One block of a mesh, collapsed by one thread in order of energy.
//!
//! A block is a compact copy of some faces. Vertices that faces outside it use are locked, so blocks never see each
//! other and their order of execution cannot matter. A small mesh is one block with nothing locked.
//!
//! # Method
//! 1. `place`: every edge gets a position and an energy; the queue orders them.
//! 2. A popped edge is placed again. It is filed anew if its energy grew, or if its samples say that the true change of
//!    squared distance is larger than the energy: quadrics see the last surface only, samples remember the source.
//! 3. `legal`: no flips, no new non-manifold edges; faces that fold onto each other vanish in pairs.
//! 4. `track`: samples of the two stars move to the nearest new face, within their limit.
//! 5. The collapse is done: faces, quadrics and samples of the star change, edges of the new star are ranked.

use glam::DVec3;

use super::energy::{Facet, Quadric};
use super::queue::{Candidate, Queue};
use super::star::Stars;
use super::{Collapse, MOST_CLASSES, NONE};
use crate::geo::Rect;

/// A vertex that must not move: faces outside the block use it, or two walls cross in it.
pub const LOCKED: u8 = 1;
/// A vertex on a wall x = constant: its x must not change.
pub const FIX_X: u8 = 2;
/// A vertex on a wall y = constant.
pub const FIX_Y: u8 = 4;
/// A vertex on an open border of the surface.
pub const BORDER: u8 = 8;

/// An edge is filed again, not collapsed, when its energy grew by more than this since it was ranked.
const STALE_FACTOR: f32 = 1.1;
/// Refused edges are tried again when the limit has grown by this.
const RETRY_FACTOR: f64 = 1.5;

/// What an energy is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Energy {
    /// Planes of the current faces (Lindstrom & Turk 1998), weighted by area: the most accurate.
    Memoryless,
    /// Sums of the source's planes (Garland & Heckbert 1997), weighted by area: the baseline.
    Accumulated,
    /// Volume between the current and the new surface (Lindstrom & Turk 1998, as printed).
    Volume,
    /// As `Accumulated`, multiplied by the class's factor and raised across creases (the paper's §2.3).
    Paper,
}

/// How far samples may be from the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Limit {
    /// Samples are not followed.
    Untracked,
    /// t times their budget.
    Scale(f64),
    /// t times their budget, where t grows with the root mean square of all samples' deviations, from `first` on; the
    /// collapse ends before t passes `last`.
    Growing {
        /// Least t.
        first: f64,
        /// The end.
        last: f64,
    },
}

/// How a block collapses.
#[derive(Debug, Clone, Copy)]
pub struct Rules {
    /// Order and placement.
    pub energy: Energy,
    /// True: a collapse keeps one of its ends where it is.
    pub half_edge: bool,
    /// What samples allow.
    pub limit: Limit,
    /// Open borders nearer than this may join across the gap, metres; 0: never.
    pub gap_reach_m: f64,
    /// Tunnels with a loop shorter than this close, at the price of a non-manifold edge, metres; 0: never.
    pub loop_reach_m: f64,
    /// Positions are multiples of this, metres, a power of two.
    pub grid_m: f64,
    /// Ends when no more faces are left.
    pub stop_faces: usize,
    /// Keep the deviations of every event.
    pub recorded: bool,
}

/// What a block is made of. All indices are local to the block; positions are relative to `origin`.
pub struct Block<'a> {
    /// Local positions are relative to this point.
    pub origin: DVec3,
    /// Per vertex: global id. Empty: its own.
    pub vertex_ids: Vec<u32>,
    /// Per vertex.
    pub positions: Vec<DVec3>,
    /// Per vertex: `LOCKED`, `FIX_X`, `FIX_Y`, `BORDER`.
    pub flags: Vec<u8>,
    /// Per face: corners.
    pub faces: Vec<[u32; 3]>,
    /// Per face: Σ P(c|f)/b_c², 1/m².
    pub omega: Vec<f32>,
    /// Per face: weight of its class under `Energy::Paper`, empty otherwise.
    pub paper_weight: Vec<f32>,
    /// Per face: index into `boxes`. Empty: one group without walls.
    pub group: Vec<u32>,
    /// Where the faces of a group must stay, in plan.
    pub boxes: &'a [Rect],
    /// Per tracked sample.
    pub samples: Vec<Sample>,
    /// See there.
    pub rules: Rules,
}

/// A point of the source that the surface must stay near.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Relative to the block's origin.
    pub point: DVec3,
    /// Share of the source's area · Σ P(c|f)/b_c².
    pub weight: f32,
    /// Metres at scale 1.
    pub budget_m: f32,
    /// Squared distance to the surface, m².
    pub squared_m2: f32,
    /// The face it rides on.
    pub face: u32,
    /// The classes of the faces around it in the source, a bit each; the last bit stands for all later ones.
    pub classes: u8,
}

/// How many faces a vertex shares with the ends of the edge under test; valid while `stamp` is the run's.
#[derive(Clone, Copy, Default)]
pub(super) struct Mark {
    pub stamp: u32,
    pub of_u: u16,
    pub of_v: u16,
    /// Faces counted that will not be there.
    pub dying: u16,
}

/// A face of a star as it would be after the collapse under test.
#[derive(Clone, Copy)]
pub(super) struct Corner {
    pub face: u32,
    pub group: u32,
    pub dies: bool,
    pub facet: Facet,
    pub corners: [DVec3; 3],
}

/// The running state behind [`Block::collapse`].
pub(super) struct Run<'a> {
    pub block: Block<'a>,
    pub facets: Vec<Facet>,
    pub quadrics: Vec<Quadric>,
    pub version: Vec<u32>,
    pub stars: Stars,
    pub sample_head: Vec<u32>,
    pub sample_next: Vec<u32>,
    pub queue: Queue,
    pub mark: Vec<Mark>,
    pub stamp: u32,
    pub star: Vec<Corner>,
    /// Faces that the collapse under test folds onto each other: one of v, one of u, and whether both point one way.
    pub pairs: Vec<(u32, u32, bool)>,
    /// Samples that the collapse under test moves: sample, new face, squared distance.
    pub moved: Vec<(u32, u32, f64)>,
    pub ring: Vec<u32>,
    pub living: usize,
    /// Current t of the limit.
    pub scale: f64,
    /// Σ weight · squared distance over all samples: m² · squared budgets.
    deviation: f64,
    /// Of all faces at the start, m².
    area_m2: f64,
    held: Vec<Candidate>,
    held_at: f64,
    log: Vec<Collapse>,
    folded: Vec<(u32, u32)>,
    deviations: Vec<[f32; MOST_CLASSES]>,
}

/// What a collapse leaves.
pub struct Collapsed<'a> {
    /// Faces that died have `NONE` as first corner; positions of vertices that died are stale.
    pub block: Block<'a>,
    /// What was done, in order.
    pub log: Vec<Collapse>,
    /// Faces that died because they folded onto others: index into `log`, face.
    pub folded: Vec<(u32, u32)>,
    /// Per event, if recorded: see [`CollapseLog`](super::CollapseLog).
    pub deviations: Vec<[f32; MOST_CLASSES]>,
    /// Scale reached.
    pub scale: f64,
}

/// What became of a candidate.
enum Verdict {
    /// Nothing, or collapsed.
    Done,
    /// Its samples refuse it at this scale.
    TooFar,
    /// The limit would pass the last scale.
    End,
}

impl<'a> Block<'a> {
    /// Collapses until the rules end it or no admissible edge is left.
    pub fn collapse(self) -> Collapsed<'a> {
        let mut run = Run::new(self);
        run.rank_all();
        if run.block.rules.gap_reach_m > 0.0 {
            run.rank_gaps();
        }
        while run.living > run.block.rules.stop_faces {
            let Some(candidate) = run.queue.pop() else { if run.widen() { continue } else { break } };
            match run.consider(candidate) {
                Verdict::Done => {}
                Verdict::TooFar => run.held.push(candidate),
                Verdict::End => break,
            }
        }
        let Run { block, log, folded, deviations, scale, .. } = run;
        Collapsed { block, log, folded, deviations, scale }
    }
}

impl<'a> Run<'a> {
    fn new(block: Block<'a>) -> Self {
        let (vertices, faces) = (block.positions.len(), block.faces.len());
        let tracked = block.rules.limit != Limit::Untracked;
        let scale = match block.rules.limit {
            Limit::Untracked => f64::INFINITY,
            Limit::Scale(t) => t,
            Limit::Growing { first, .. } => first,
        };
        let mut run = Self {
            facets: Vec::new(),
            quadrics: vec![Quadric::default(); vertices],
            version: vec![0; vertices],
            stars: Stars::of(vertices, &block.faces),
            sample_head: vec![NONE; if tracked { faces } else { 0 }],
            sample_next: vec![NONE; block.samples.len()],
            queue: Queue::new(),
            mark: vec![Mark::default(); vertices],
            stamp: 0,
            star: Vec::new(),
            pairs: Vec::new(),
            moved: Vec::new(),
            ring: Vec::new(),
            living: faces,
            scale,
            deviation: block.samples.iter().map(|s| f64::from(s.weight) * f64::from(s.squared_m2)).sum(),
            area_m2: 0.0,
            held: Vec::new(),
            held_at: scale,
            log: Vec::new(),
            folded: Vec::new(),
            deviations: Vec::new(),
            block,
        };
        run.facets = (0..faces as u32).map(|f| Facet::of(run.corners(f))).collect();
        run.area_m2 = run.facets.iter().map(|f| f64::from(f.area)).sum();
        for (s, sample) in run.block.samples.iter().enumerate().rev() {
            run.sample_next[s] = run.sample_head[sample.face as usize];
            run.sample_head[sample.face as usize] = s as u32;
        }
        run.sum_quadrics();
        run
    }

    /// Every vertex's quadric, face by face.
    fn sum_quadrics(&mut self) {
        for f in 0..self.block.faces.len() as u32 {
            let quadric = self.face_quadric(f);
            for v in self.block.faces[f as usize] {
                self.quadrics[v as usize] += quadric;
            }
        }
        for v in 0..self.block.positions.len() as u32 {
            if self.block.flags[v as usize] & BORDER != 0 {
                let border = self.border_of(v);
                self.quadrics[v as usize] += border;
            }
        }
    }

    pub(super) fn corners(&self, f: u32) -> [DVec3; 3] {
        self.block.faces[f as usize].map(|v| self.block.positions[v as usize])
    }

    pub(super) fn group_of(&self, f: u32) -> u32 {
        self.block.group.get(f as usize).copied().unwrap_or(0)
    }

    pub(super) fn shared_faces(&self, v: u32, w: u32) -> usize {
        self.stars.faces(v).iter().filter(|&&f| self.block.faces[f as usize].contains(&w)).count()
    }

    pub(super) fn face_quadric(&self, f: u32) -> Quadric {
        let first = self.block.positions[self.block.faces[f as usize][0] as usize];
        self.facets[f as usize].quadric(first, f64::from(self.block.omega[f as usize]))
    }

    fn rank_all(&mut self) {
        let mut around: Vec<u32> = Vec::new();
        // Backwards: of equal energies the queue hands out the last one first.
        for v in (0..self.block.positions.len() as u32).rev() {
            around.clear();
            for &f in self.stars.faces(v) {
                around.extend(self.block.faces[f as usize].iter().filter(|&&w| w > v));
            }
            around.sort_unstable();
            around.dedup();
            for &w in around.iter().rev() {
                self.rank(v, w);
            }
        }
    }

    pub(super) fn rank(&mut self, u: u32, v: u32) {
        if let Some((_, energy)) = self.place(u, v, false) {
            let stamp = self.version[u as usize] + self.version[v as usize];
            self.queue.push(Candidate { u, v, stamp, energy });
        }
    }

    fn consider(&mut self, candidate: Candidate) -> Verdict {
        let Candidate { u, v, stamp, energy: filed } = candidate;
        if self.stars.count(u) == 0 || self.stars.count(v) == 0 {
            return Verdict::Done;
        }
        if self.version[u as usize] + self.version[v as usize] != stamp {
            return Verdict::Done;
        }
        let Some((p, mut energy)) = self.place(u, v, true) else { return Verdict::Done };
        let stale = |energy: f32| energy > filed * STALE_FACTOR && energy > f32::MIN_POSITIVE;
        if stale(energy) {
            self.queue.push(Candidate { energy, ..candidate });
            return Verdict::Done;
        }
        if !self.link_allows(u, v) || !self.faces_allow(u, v, p) {
            return Verdict::Done;
        }
        let mut share = 0.0;
        if self.block.rules.limit != Limit::Untracked {
            let Some(moved) = self.samples_allow().filter(|_| self.growing() || self.spans_allow()) else {
                return Verdict::TooFar;
            };
            share = moved.share;
            energy = energy.max(moved.change as f32);
            if stale(energy) && self.block.rules.energy == Energy::Memoryless {
                self.queue.push(Candidate { energy, ..candidate });
                return Verdict::Done;
            }
            if !self.grow(moved.change) {
                return Verdict::End;
            }
        } else {
            energy += self.folded_energy();
            if stale(energy) {
                self.queue.push(Candidate { energy, ..candidate });
                return Verdict::Done;
            }
        }
        self.perform(u, v, p, energy, share);
        Verdict::Done
    }

    fn growing(&self) -> bool {
        matches!(self.block.rules.limit, Limit::Growing { .. })
    }

    /// Takes a change of Σ weight · squared distance into account; false when the limit would pass the last scale.
    fn grow(&mut self, change: f64) -> bool {
        let Limit::Growing { last, .. } = self.block.rules.limit else { return true };
        let total = self.deviation + change;
        let rms = (total.max(0.0) / self.area_m2.max(f64::MIN_POSITIVE)).sqrt();
        let scale = self.scale.max(super::SPREAD * rms);
        if scale > last {
            return false;
        }
        self.deviation = total;
        self.scale = scale;
        if scale > RETRY_FACTOR * self.held_at {
            self.release();
        }
        true
    }

    /// When nothing is left: a larger limit, if the rules have one and something waits for it.
    fn widen(&mut self) -> bool {
        let Limit::Growing { last, .. } = self.block.rules.limit else { return false };
        let scale = self.scale * RETRY_FACTOR;
        if self.held.is_empty() || scale > last {
            return false;
        }
        self.scale = scale;
        self.release();
        true
    }

    fn release(&mut self) {
        self.held_at = self.scale;
        for candidate in std::mem::take(&mut self.held) {
            self.queue.push(candidate);
        }
    }

    fn perform(&mut self, u: u32, v: u32, p: DVec3, energy: f32, share: f32) {
        let star = std::mem::take(&mut self.star);
        let memoryless = matches!(self.block.rules.energy, Energy::Memoryless | Energy::Volume);
        self.list_ring(&star, u, v);
        if memoryless {
            self.take_borders();
        }
        for corner in &star {
            let face = self.block.faces[corner.face as usize];
            let old = if memoryless { self.face_quadric(corner.face) } else { Quadric::default() };
            for w in face.into_iter().filter(|&w| w != u && w != v) {
                if memoryless {
                    self.quadrics[w as usize] -= old;
                }
                if corner.dies {
                    self.stars.remove(w, corner.face);
                }
            }
        }
        self.note_folds(&star, u, v);
        self.record(u, v, p, energy, share);
        self.block.positions[u as usize] = p;
        self.block.flags[u as usize] |= self.block.flags[v as usize];
        let mut sum = Quadric::default();
        for corner in &star {
            let f = corner.face as usize;
            if corner.dies {
                self.block.faces[f] = [NONE; 3];
                self.living -= 1;
                continue;
            }
            self.facets[f] = corner.facet;
            let face = self.block.faces[f].map(|w| if w == v { u } else { w });
            self.block.faces[f] = face;
            if memoryless {
                let new = self.face_quadric(corner.face);
                sum += new;
                for w in face.into_iter().filter(|&w| w != u) {
                    self.quadrics[w as usize] += new;
                }
            }
        }
        self.stars.replace(u, star.iter().filter(|c| !c.dies).map(|c| c.face));
        self.stars.replace(v, std::iter::empty());
        self.move_samples(&star);
        self.star = star;
        self.version[u as usize] += self.version[v as usize] + 1;
        if memoryless {
            self.quadrics[u as usize] = sum;
            self.add_borders(u);
        } else {
            let other = self.quadrics[v as usize];
            self.quadrics[u as usize] += other;
        }
        let ring = std::mem::take(&mut self.ring);
        for &w in &ring {
            if self.stars.count(w) > 0 {
                self.rank(u, w);
            }
        }
        self.ring = ring;
    }

    /// Lists the folded faces, and marks their vertices: they may be on an open border now.
    fn note_folds(&mut self, star: &[Corner], u: u32, v: u32) {
        if self.pairs.is_empty() {
            return;
        }
        let event = self.log.len() as u32;
        for corner in star.iter().filter(|c| c.dies) {
            let face = self.block.faces[corner.face as usize];
            if !(face.contains(&u) && face.contains(&v)) {
                self.folded.push((event, corner.face));
            }
            face.iter().for_each(|&w| self.block.flags[w as usize] |= BORDER);
        }
    }

    /// Lists the vertices around the star of `uv`.
    fn list_ring(&mut self, star: &[Corner], u: u32, v: u32) {
        self.ring.clear();
        for corner in star {
            for w in self.block.faces[corner.face as usize] {
                if w != u && w != v && !self.ring.contains(&w) {
                    self.ring.push(w);
                }
            }
        }
    }

    /// Takes the border planes out of the quadrics of the ring, before anything changes.
    fn take_borders(&mut self) {
        for i in 0..self.ring.len() {
            let w = self.ring[i];
            if self.block.flags[w as usize] & BORDER != 0 {
                let border = self.border_of(w);
                self.quadrics[w as usize] -= border;
            }
        }
    }

    /// Adds the border planes of `u` and its ring as they are now.
    fn add_borders(&mut self, u: u32) {
        for i in 0..=self.ring.len() {
            let w = self.ring.get(i).copied().unwrap_or(u);
            if self.block.flags[w as usize] & BORDER != 0 {
                let border = self.border_of(w);
                self.quadrics[w as usize] += border;
            }
        }
    }

    fn record(&mut self, u: u32, v: u32, position: DVec3, energy: f32, share: f32) {
        let id = |v: u32| self.block.vertex_ids.get(v as usize).copied().unwrap_or(v);
        let (kept, gone) = (id(u), id(v));
        self.log.push(Collapse { kept, gone, position: self.block.origin + position, energy, share });
        if self.block.rules.recorded {
            let mut squared = [0f64; MOST_CLASSES];
            for &(s, _, far) in &self.moved {
                let classes = self.block.samples[s as usize].classes;
                for (_, most) in squared.iter_mut().enumerate().filter(|(c, _)| classes >> c & 1 != 0) {
                    *most = most.max(far);
                }
            }
            self.deviations.push(squared.map(|s| s.sqrt() as f32));
        }
    }
}
