//! The collapse of one block.
//!
//! # Method
//! 1. `rank`: every edge gets an energy; the queue orders them.
//! 2. `place`: a popped edge is placed. It is filed anew if its energy grew, or if its samples say that the true change of squared
//!    distance is larger than the energy: forms see the last surface only, samples remember the source.
//! 3. `legal`: no flips, no new non-manifold edges; faces that fold onto each other vanish in pairs.
//! 4. `track`: samples of the two stars move to the nearest new face, within their limit.
//! 5. `change`: the collapse is done.

use glam::{DVec3, Vec3};

use super::block::{Block, Collapsed, Energy, Limit};
use super::energy::{Facet, Form, Quadric, SmallForm};
use super::log::Moves;
use super::queue::{Candidate, Queue};
use super::star::{Arena, Span};
use super::track::{Move, Rider};
use super::{Collapse, MOST_CLASSES, NONE};

/// An edge is filed again, not collapsed, when its energy is this many times the least of its bucket. More than a bucket
/// is wide, or it would be filed where it came from.
const STALE_FACTOR: f32 = 1.35;
/// Refused edges are tried again when the limit has grown by this.
const RETRY_FACTOR: f64 = 1.5;
/// Candidates that are fetched together.
const BATCH: usize = 24;
/// Version of a vertex without faces: no sum with it is one that an edge was filed under.
pub(super) const GONE: u32 = 1 << 30;

/// A vertex of the surface, in one line of memory: stars are visited in no order that a cache could know.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub(super) struct Vertex {
    /// Where it is.
    pub at: DVec3,
    /// Planes of its faces (memoryless).
    pub form: SmallForm,
    /// Its faces.
    pub star: Span,
    /// See there.
    pub mark: Mark,
}

// A byte more, and the alignment would make it two lines.
const _: () = assert!(size_of::<Vertex>() == 64 && size_of::<Face>() == 32);

/// A face of the surface, in 32 bytes.
#[derive(Clone, Copy)]
pub(super) struct Face {
    /// Vertices; all `NONE`: it is gone.
    pub corners: [u32; 3],
    /// Unit, zero without area.
    pub normal: Vec3,
    /// Area · ω.
    pub weight: f32,
    /// Σ P(c|f)/b_c², 1/m².
    pub omega: f32,
}

impl Face {
    pub fn form(&self) -> Form {
        Form::of_plane(self.normal.as_dvec3(), f64::from(self.weight))
    }

    pub fn lie(&mut self, facet: &Facet) {
        (self.normal, self.weight) = (facet.normal, facet.area * self.omega);
    }
}

/// How many faces a vertex shares with the ends of the edge under test, valid while `stamp` is the run's; and what it may
/// do at all times.
#[derive(Clone, Copy)]
pub(super) struct Mark {
    pub stamp: u32,
    /// `LOCKED`, `FIX_X`, `FIX_Y`, `BORDER`.
    pub flags: u8,
    pub of_u: u8,
    pub of_v: u8,
    /// Faces counted that will not be there.
    pub dying: u8,
}

impl Mark {
    fn of(flags: u8) -> Self {
        Self { stamp: 0, flags, of_u: 0, of_v: 0, dying: 0 }
    }

    /// Of no face yet, for the run's `stamp`.
    pub fn renew(&mut self, stamp: u32) {
        *self = Self { stamp, ..Self::of(self.flags) };
    }
}

/// A face of a star as it would be after the collapse under test.
#[derive(Clone, Copy)]
pub(super) struct Corner {
    pub face: u32,
    pub group: u32,
    pub dies: bool,
    /// Vertices as they are before it.
    pub ids: [u32; 3],
    pub facet: Facet,
    pub corners: [DVec3; 3],
    /// Around them.
    pub around: Around,
}

/// A box: a test of it costs a fifth of one of the triangle in it.
#[derive(Clone, Copy, Default)]
pub(super) struct Around {
    low: DVec3,
    high: DVec3,
}

impl Around {
    pub fn of([a, b, c]: [DVec3; 3]) -> Self {
        Self { low: a.min(b).min(c), high: a.max(b).max(c) }
    }

    /// No point of what is inside is nearer, m².
    #[inline(always)]
    pub fn squared_to(&self, p: DVec3) -> f64 {
        (self.low - p).max(p - self.high).max(DVec3::ZERO).length_squared()
    }
}

/// The running state behind [`Block::collapse`].
pub(super) struct Run<'a> {
    /// Without what is below.
    pub block: Block<'a>,
    pub vertices: Vec<Vertex>,
    pub faces: Vec<Face>,
    /// Planes of the past by vertex, for energies that have them.
    pub quadrics: Vec<Quadric>,
    /// By vertex: grows when edges filed before are no longer what they were.
    pub version: Vec<u32>,
    pub arena: Arena,
    /// By face: the first sample on it.
    pub rider_head: Vec<u32>,
    pub riders: Vec<Rider>,
    pub queue: Queue,
    pub stamp: u32,
    /// Faces at the ends of the edge under test, as they are: those of `u`, then those of `v` that are not of `u`.
    pub near: Vec<(u32, Face)>,
    /// How many of them are of `u`.
    pub near_u: usize,
    pub star: Vec<Corner>,
    /// The faces of `star` as they are.
    pub old: Vec<(Around, [DVec3; 3])>,
    /// Faces that the collapse under test folds onto each other: one of v, one of u, and whether both point one way.
    pub pairs: Vec<(u32, u32, bool)>,
    /// Samples that the collapse under test moves.
    pub moved: Vec<Move>,
    /// Vertices around the edge under test.
    pub ring: Vec<u32>,
    pub living: usize,
    /// Current t of the limit.
    pub scale: f64,
    /// Σ weight · squared distance over all samples: m² · squared budgets.
    deviation: f64,
    /// Of all faces at the start, m².
    area_m2: f64,
    held: Vec<(Candidate, f32)>,
    held_at: f64,
    pub log: Vec<Collapse>,
    pub moves: Moves,
    pub folded: Vec<(u32, u32)>,
    pub levels: Vec<[u8; MOST_CLASSES]>,
    pub most_m: [f32; MOST_CLASSES],
    /// Collapses so far.
    pub count: u32,
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

impl<'a> Run<'a> {
    pub fn new(mut block: Block<'a>) -> Self {
        let tracked = block.rules.limit != Limit::Untracked;
        let scale = match block.rules.limit {
            Limit::Untracked => f64::INFINITY,
            Limit::Scale(t) => t,
            Limit::Growing { first, .. } => first,
        };
        let (arena, spans) = Arena::of(block.positions.len(), &block.faces);
        let flags = std::mem::take(&mut block.flags);
        let vertices = std::mem::take(&mut block.positions).into_iter().zip(flags).zip(spans);
        let vertex = |((at, flags), star)| Vertex { at, form: SmallForm::default(), star, mark: Mark::of(flags) };
        let vertices: Vec<Vertex> = vertices.map(vertex).collect();
        let omega = std::mem::take(&mut block.omega);
        let mut area_m2 = 0.0;
        let face = |(corners, f): ([u32; 3], usize)| {
            let omega = omega.get(f).copied().unwrap_or(1.0);
            let facet = Facet::of(corners.map(|v| vertices[v as usize].at));
            area_m2 += f64::from(facet.area);
            Face { corners, normal: facet.normal, weight: facet.area * omega, omega }
        };
        let faces: Vec<Face> = std::mem::take(&mut block.faces).into_iter().zip(0..).map(face).collect();
        let samples = std::mem::take(&mut block.samples);
        let (riders, rider_head) = Rider::all(samples, if tracked { faces.len() } else { 0 });
        let deviation = riders.iter().map(|s| f64::from(s.weight) * f64::from(s.squared_m2)).sum();
        // Room that is not used costs nothing; to move what grows leaves holes.
        let most = if block.rules.recorded { faces.len().saturating_sub(block.rules.stop_faces) / 2 } else { 0 };
        let mut run = Self {
            deviation,
            quadrics: Vec::new(),
            version: vec![0; vertices.len()],
            arena,
            rider_head,
            riders,
            queue: Queue::new(),
            stamp: 0,
            near: Vec::new(),
            near_u: 0,
            star: Vec::new(),
            old: Vec::new(),
            pairs: Vec::new(),
            moved: Vec::new(),
            ring: Vec::new(),
            living: faces.len(),
            scale,
            area_m2,
            held: Vec::new(),
            held_at: scale,
            log: Vec::new(),
            moves: Moves::new(most, block.rules.grid_m),
            folded: Vec::new(),
            levels: Vec::with_capacity(most),
            most_m: [0.0; MOST_CLASSES],
            count: 0,
            vertices,
            faces,
            block,
        };
        run.sum_planes();
        run
    }

    /// See [`Block::collapse`].
    pub fn collapse(mut self) -> Collapsed<'a> {
        self.rank_all();
        if self.block.rules.gap_reach_m > 0.0 {
            self.rank_gaps();
        }
        let mut batch = Vec::with_capacity(BATCH);
        self.queue.settle();
        'all: while self.living > self.block.rules.stop_faces {
            let version = &self.version;
            let current = |c: &Candidate| version[c.u as usize] + version[c.v as usize] == c.stamp;
            if self.queue.is_full() {
                self.queue.tidy(current);
            }
            let Some(filed) = self.queue.pop(BATCH, &mut batch, current) else {
                if self.widen() { continue } else { break }
            };
            self.fetch(&mut batch);
            while let Some(candidate) = batch.pop() {
                match self.consider(candidate, filed) {
                    Verdict::Done => {}
                    Verdict::TooFar => self.held.push((candidate, filed)),
                    Verdict::End => break 'all,
                }
                if self.living <= self.block.rules.stop_faces {
                    break 'all;
                }
                // What is new comes first.
                if self.queue.has_below(filed) {
                    batch.drain(..).for_each(|candidate| self.queue.push(candidate, filed));
                }
            }
        }
        let Self { mut block, vertices, faces, riders, rider_head, scale, queue, arena, version, .. } = self;
        let Self { log, moves, folded, levels, most_m, .. } = self;
        drop((queue, arena, version));
        block.samples = Rider::samples(riders, &rider_head);
        drop(rider_head);
        block.faces = faces.iter().map(|f| f.corners).collect();
        block.omega = faces.iter().map(|f| f.omega).collect();
        drop(faces);
        block.flags = vertices.iter().map(|v| v.mark.flags).collect();
        block.positions = vertices.iter().map(|v| v.at).collect();
        Collapsed { block, log, moves, folded, levels, most_m, scale }
    }

    /// Every vertex's planes.
    fn sum_planes(&mut self) {
        match self.block.rules.energy {
            Energy::Volume => {}
            Energy::Memoryless => {
                for f in 0..self.faces.len() {
                    let Face { corners, .. } = self.faces[f];
                    let form = self.faces[f].form();
                    corners.iter().for_each(|&v| self.add_form(v, form));
                }
                (0..self.vertices.len() as u32).for_each(|v| self.add_border(v));
            }
            Energy::Accumulated | Energy::Paper => self.sum_quadrics(),
        }
    }

    fn sum_quadrics(&mut self) {
        self.quadrics = vec![Quadric::default(); self.vertices.len()];
        for face in &self.faces {
            let n = face.normal.as_dvec3();
            let at = self.vertices[face.corners[0] as usize].at;
            let quadric = Quadric::of_plane(n, -n.dot(at), f64::from(face.weight));
            face.corners.iter().for_each(|&v| self.quadrics[v as usize] += quadric);
        }
        for v in 0..self.vertices.len() as u32 {
            let mut sum = self.quadrics[v as usize];
            let at = self.vertices[v as usize].at;
            self.borders_of(v, |n, weight| sum += Quadric::of_plane(n, -n.dot(at), weight));
            self.quadrics[v as usize] = sum;
        }
    }

    pub(super) fn at(&self, v: u32) -> DVec3 {
        self.vertices[v as usize].at
    }

    pub(super) fn corners(&self, f: u32) -> [DVec3; 3] {
        self.faces[f as usize].corners.map(|v| self.at(v))
    }

    pub(super) fn group_of(&self, f: u32) -> u32 {
        self.block.group.get(f as usize).copied().unwrap_or(0)
    }

    /// The faces of `v`; none once it has merged into another vertex.
    pub(super) fn star_of(&self, v: u32) -> &[u32] {
        self.arena.faces(self.vertices[v as usize].star)
    }

    pub(super) fn shared_faces(&self, v: u32, w: u32) -> usize {
        self.star_of(v).iter().filter(|&&f| self.faces[f as usize].corners.contains(&w)).count()
    }

    fn rank_all(&mut self) {
        let mut around: Vec<u32> = Vec::new();
        // Backwards: of equal energies the queue hands out the last one first.
        for v in (0..self.vertices.len() as u32).rev() {
            around.clear();
            for &f in self.star_of(v) {
                around.extend(self.faces[f as usize].corners.iter().filter(|&&w| w > v));
            }
            around.sort_unstable();
            around.dedup();
            for &w in around.iter().rev() {
                self.rank(v, w);
            }
        }
    }

    pub(super) fn rank(&mut self, u: u32, v: u32) {
        if let Some(energy) = self.estimate(u, v) {
            let stamp = self.version[u as usize] + self.version[v as usize];
            self.queue.push(Candidate { u, v, stamp }, energy);
        }
    }

    /// Drops candidates that are out of date, and reads what the others will need: of several at once, so that the waits
    /// for memory overlap.
    fn fetch(&self, batch: &mut Vec<Candidate>) {
        batch.retain(|c| self.version[c.u as usize] + self.version[c.v as usize] == c.stamp);
        let mut spans = [Span::default(); 2 * BATCH];
        let ends = batch.iter().flat_map(|c| [c.u, c.v]);
        spans.iter_mut().zip(ends).for_each(|(span, v)| *span = self.vertices[v as usize].star);
        let spans = &spans[..2 * batch.len()];
        let mut read = 0;
        for &span in spans {
            for &f in self.arena.faces(span) {
                read ^= self.faces[f as usize].corners[0];
                read ^= self.rider_head.get(f as usize).copied().unwrap_or(0);
            }
        }
        for &span in spans {
            for &f in self.arena.faces(span) {
                for w in self.faces[f as usize].corners {
                    read ^= u32::from(self.vertices[w as usize].mark.flags);
                }
                let first = self.rider_head.get(f as usize).copied().unwrap_or(NONE);
                read ^= self.riders.get(first as usize).map_or(0, |rider| rider.next);
            }
        }
        std::hint::black_box(read);
    }

    fn consider(&mut self, candidate: Candidate, filed: f32) -> Verdict {
        let Candidate { u, v, stamp } = candidate;
        if self.version[u as usize] + self.version[v as usize] != stamp {
            return Verdict::Done;
        }
        self.gather(u, v);
        let Some((p, mut energy)) = self.place(u, v) else { return Verdict::Done };
        let stale = |energy: f32| energy > filed * STALE_FACTOR && energy > f32::MIN_POSITIVE;
        if stale(energy) {
            self.queue.push(candidate, energy);
            return Verdict::Done;
        }
        if !self.link_allows(u, v) || !self.faces_allow(u, v, p) {
            return Verdict::Done;
        }
        if self.block.rules.limit != Limit::Untracked {
            let Some(change) = self.samples_allow().filter(|_| self.growing() || self.spans_allow()) else {
                return Verdict::TooFar;
            };
            energy = energy.max(change as f32);
            if stale(energy) && self.block.rules.energy == Energy::Memoryless {
                self.queue.push(candidate, energy);
                return Verdict::Done;
            }
            if !self.grow(change) {
                return Verdict::End;
            }
        } else {
            energy += self.folded_energy();
            if stale(energy) {
                self.queue.push(candidate, energy);
                return Verdict::Done;
            }
        }
        self.perform(u, v, p, energy);
        Verdict::Done
    }

    /// Fills `near`: all that is read at random here is read at once, so that the waits overlap.
    fn gather(&mut self, u: u32, v: u32) {
        let Self { near, arena, vertices, faces, .. } = self;
        let [of_u, of_v] = [u, v].map(|v| arena.faces(vertices[v as usize].star));
        near.clear();
        near.extend(of_u.iter().map(|&f| (f, faces[f as usize])));
        self.near_u = near.len();
        near.extend(of_v.iter().map(|&f| (f, faces[f as usize])));
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
        for (candidate, filed) in std::mem::take(&mut self.held) {
            self.queue.push(candidate, filed);
        }
    }
}
