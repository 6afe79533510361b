//! Writes a sequence of collapses backwards, as splits.
//!
//! # Method
//! 1. Collapse the source once, noting for every event which faces change hands and which die.
//! 2. Code what is left, see `base`.
//! 3. Go through the events from the last to the first and code each as a split of the mesh so far.
//! 4. Cut the stream where the largest deviation passes a power of two, and every [`MOST_EVENTS`] events.

use super::base::{Growth, Picker};
use super::coder::Encoder;
use super::file::{About, ChunkInfo, Header, Layout, least_bytes};
use super::level::level_of;
use super::live::{Fold, Grid, Live, Star, Wing};
use super::split::{MOST_COORDINATE, Models, Split};
use super::{MAX_CLASSES, NONE, Sequence};
use crate::{Error, Result};

/// Events of a chunk at most: some 50 kB.
const MOST_EVENTS: usize = 8192;

/// Encodes `sequence`.
///
/// # Errors
/// [`Error::Bug`] for a sequence that breaks its promises: a position off the grid, an event of a vertex that is gone.
pub fn encode(sequence: &Sequence, about: &About) -> Result<Vec<u8>> {
    let history = History::of(sequence)?;
    let classes: Vec<u8> = sequence.labels.iter().map(|c| c.0).collect();
    let marks = Marks::of(sequence, about.tracked_classes());
    let mut writer = Writer::new(sequence, &history, &classes, about)?;
    let mut chunks = vec![writer.base(marks.bounds(sequence.log.events.len()))?];
    let mut end = sequence.log.events.len();
    while end > 0 {
        let begin = marks.begin_of_chunk(end);
        chunks.push(writer.chunk(begin, end, &marks)?);
        end = begin;
    }
    let (infos, payloads): (Vec<ChunkInfo>, Vec<Vec<u8>>) = chunks.into_iter().unzip();
    let header = Header::new(about, sequence.grid_m, &infos);
    Ok(Layout::write(&header, &payloads))
}

/// What every event did to the faces.
struct History {
    /// Corners at the end, or at the moment the face died.
    faces: Vec<[u32; 3]>,
    alive: Vec<bool>,
    /// Faces that died in event i: `died[died_start[i]..died_start[i + 1]]`.
    died: Vec<u32>,
    died_start: Vec<u32>,
    /// Faces that went from `gone` to `kept`, in the same way.
    left: Vec<u32>,
    left_start: Vec<u32>,
    /// Faces that event i folded away, in the same way.
    folded: Vec<u32>,
    folded_start: Vec<u32>,
    /// Grid places at the end, and of vertices that are gone, at the moment they went.
    points: Vec<Grid>,
    /// Where `kept` was before event i.
    before: Vec<Grid>,
    gone: Vec<bool>,
    /// Per event, the vertex that stays where it is if one does, and the one that goes: an event that takes its vertex
    /// to the place of the other is told the other way round, so that one place is coded and not two.
    ends: Vec<[u32; 2]>,
}

impl History {
    fn of(sequence: &Sequence) -> Result<Self> {
        let vertices = sequence.positions.len();
        let mut history = Self {
            faces: sequence.faces.clone(),
            alive: vec![true; sequence.faces.len()],
            died: Vec::new(),
            died_start: vec![0],
            left: Vec::new(),
            left_start: vec![0],
            folded: Vec::new(),
            folded_start: vec![0],
            points: Vec::with_capacity(vertices),
            before: Vec::with_capacity(sequence.log.events.len()),
            gone: vec![false; vertices],
            ends: Vec::with_capacity(sequence.log.events.len()),
        };
        // What each vertex of the sequence is called here.
        let mut name: Vec<u32> = (0..vertices as u32).collect();
        for p in &sequence.positions {
            history.points.push(on_grid(p.to_array(), sequence.grid_m)?);
        }
        let mut head = vec![NONE; vertices];
        let mut next = vec![NONE; 3 * sequence.faces.len()];
        for (f, face) in sequence.faces.iter().enumerate().rev() {
            let [a, b, c] = *face;
            if a == b || b == c || c == a || face.iter().any(|&v| v as usize >= vertices) {
                return Err(Error::Bug(format!(
                    "face {f} of a sequence has corners {a} {b} {c} of {vertices} vertices"
                )));
            }
            for (k, &v) in face.iter().enumerate() {
                next[3 * f + k] = head[v as usize];
                head[v as usize] = (3 * f + k) as u32;
            }
        }
        for (i, event) in sequence.log.events.iter().enumerate() {
            let [mut kept, mut gone] =
                [event.kept, event.gone].map(|v| name.get(v as usize).copied().unwrap_or(NONE) as usize);
            if kept == gone || kept.max(gone) >= vertices || history.gone[kept] || history.gone[gone] {
                return Err(Error::Bug(format!("event {i} of a sequence merges vertex {gone} into {kept}")));
            }
            let to = on_grid(event.position.to_array(), sequence.grid_m)?;
            if to == history.points[gone] && to != history.points[kept] {
                name[event.kept as usize] = gone as u32;
                (kept, gone) = (gone, kept);
            }
            history.ends.push([kept as u32, gone as u32]);
            history.fold(sequence, i)?;
            let mut corner = std::mem::replace(&mut head[gone], NONE);
            while corner != NONE {
                let (f, k) = (corner as usize / 3, corner as usize % 3);
                let following = next[corner as usize];
                if history.alive[f] && history.faces[f].contains(&(kept as u32)) {
                    history.alive[f] = false;
                    history.died.push(f as u32);
                } else if history.alive[f] {
                    history.faces[f][k] = kept as u32;
                    history.left.push(f as u32);
                    next[corner as usize] = head[kept];
                    head[kept] = corner;
                }
                corner = following;
            }
            history.died_start.push(history.died.len() as u32);
            history.left_start.push(history.left.len() as u32);
            history.gone[gone] = true;
            history.before.push(history.points[kept]);
            history.points[kept] = to;
        }
        Ok(history)
    }

    /// Takes away the faces that event `i` folds.
    fn fold(&mut self, sequence: &Sequence, i: usize) -> Result<()> {
        let begin = sequence.log.folded.partition_point(|f| (f.0 as usize) < i);
        for &(_, f) in sequence.log.folded[begin..].iter().take_while(|f| f.0 as usize == i) {
            let face = self.faces.get(f as usize).filter(|_| self.alive[f as usize]);
            let Some(face) = face else {
                return Err(Error::Bug(format!("event {i} of a sequence folds face {f}, which is not there")));
            };
            let [kept, gone] = self.ends[i];
            match (face.contains(&kept), face.contains(&gone)) {
                // It dies in any case.
                (true, true) => continue,
                (false, false) => {
                    return Err(Error::Bug(format!("event {i} of a sequence folds face {f}, which it does not touch")));
                }
                _ => {}
            }
            self.alive[f as usize] = false;
            self.folded.push(f);
        }
        self.folded_start.push(self.folded.len() as u32);
        Ok(())
    }

    fn folded(&self, i: usize) -> &[u32] {
        &self.folded[self.folded_start[i] as usize..self.folded_start[i + 1] as usize]
    }

    fn died(&self, i: usize) -> &[u32] {
        &self.died[self.died_start[i] as usize..self.died_start[i + 1] as usize]
    }

    fn left(&self, i: usize) -> &[u32] {
        &self.left[self.left_start[i] as usize..self.left_start[i + 1] as usize]
    }
}

fn on_grid(p: [f64; 3], grid_m: f64) -> Result<Grid> {
    let steps = p.map(|x| x / grid_m);
    let fine = steps.iter().all(|s| s.fract() == 0.0 && s.abs() <= MOST_COORDINATE as f64);
    if fine { Ok(steps.map(|s| s as i64)) } else { Err(Error::Bug(format!("{p:?} is not on a grid of {grid_m} m"))) }
}

/// How far the mesh has deviated after each event, and where chunks end.
struct Marks {
    /// Levels of each class's largest deviation, per event; of that event alone.
    own: Vec<[u8; MAX_CLASSES]>,
    /// The same, of all events up to and including this one.
    running: Vec<[u8; MAX_CLASSES]>,
    energy: Vec<i16>,
    octave: Vec<i16>,
}

impl Marks {
    fn of(sequence: &Sequence, classes: usize) -> Self {
        let levels = |i: usize| {
            let deviations_m = sequence.log.deviations_m.get(i).copied().unwrap_or_default();
            let mut levels = deviations_m.map(|d| level_of(f64::from(d)));
            levels[classes..].fill(0);
            levels
        };
        let own: Vec<[u8; MAX_CLASSES]> = (0..sequence.log.events.len()).map(levels).collect();
        let energy: Vec<i16> = sequence.log.events.iter().map(|e| energy_level(e.energy)).collect();
        let mut running = own.clone();
        for i in 1..running.len() {
            let before = running[i - 1];
            running[i].iter_mut().zip(before).for_each(|(r, b)| *r = (*r).max(b));
        }
        let tracked = running.last().is_some_and(|r| r.iter().any(|l| *l > 0));
        let mut most = i16::MIN;
        let octave = (0..own.len())
            .map(|i| {
                most = most.max(energy[i]);
                let worst = running[i].iter().max().copied().unwrap_or(0);
                if tracked { i16::from(worst) / 4 } else { most }
            })
            .collect();
        Self { own, running, energy, octave }
    }

    /// Bounds of the mesh after the first `events`.
    fn bounds(&self, events: usize) -> [u8; MAX_CLASSES] {
        if events == 0 { [0; MAX_CLASSES] } else { self.running[events - 1] }
    }

    /// The first event of the chunk that ends before event `end`.
    fn begin_of_chunk(&self, end: usize) -> usize {
        let octave = self.octave[end - 1];
        let least = end.saturating_sub(MOST_EVENTS);
        (least..end).rev().take_while(|&i| self.octave[i] == octave).last().unwrap_or(end - 1)
    }
}

/// Half the binary logarithm, rounded up: doublings of an error.
fn energy_level(energy: f32) -> i16 {
    if energy > 0.0 { (0.5 * f64::from(energy).log2()).ceil().clamp(-100.0, 100.0) as i16 } else { -101 }
}

struct Writer<'a> {
    history: &'a History,
    classes: &'a [u8],
    models: Models,
    live: Live,
    star: Star,
    /// Per source vertex: the record's number.
    number: Vec<u32>,
    /// Per face of the record: the source's number.
    source_face: Vec<u32>,
    /// Per source face: the event it was last marked for, plus one.
    stamp: Vec<u32>,
    energy: i16,
}

impl<'a> Writer<'a> {
    fn new(sequence: &Sequence, history: &'a History, classes: &'a [u8], about: &About) -> Result<Self> {
        if classes.len() != sequence.faces.len() || classes.iter().any(|c| usize::from(*c) >= about.scheme.len()) {
            return Err(Error::Bug("the faces of a sequence need a class of its scheme each".into()));
        }
        Ok(Self {
            history,
            classes,
            models: Models::new(about.tracked_classes(), sequence.grid_m),
            live: Live::default(),
            star: Star::default(),
            number: Vec::new(),
            source_face: Vec::new(),
            stamp: vec![0; sequence.faces.len()],
            energy: 0,
        })
    }

    fn base(&mut self, bounds: [u8; MAX_CLASSES]) -> Result<(ChunkInfo, Vec<u8>)> {
        let history = self.history;
        let ids: Vec<u32> = (0..history.faces.len() as u32).filter(|&f| history.alive[f as usize]).collect();
        let faces: Vec<[u32; 3]> = ids.iter().map(|&f| history.faces[f as usize]).collect();
        let classes: Vec<u8> = ids.iter().map(|&f| self.classes[f as usize]).collect();
        let vertices = history.gone.iter().filter(|g| !**g).count();
        let mut picker = Picker::new(&faces, &classes, &history.points);
        let mut growth = Growth::new();
        let mut coder = Encoder::new();
        let bug = |what: &str| Error::Bug(format!("a base with {what}"));
        while let Some(next) = picker.pick(growth.open()) {
            growth.code(&mut coder, &mut self.models, &mut self.live, vertices, &next).map_err(bug)?;
        }
        for v in (0..history.gone.len()).filter(|&v| !history.gone[v]) {
            if picker.number[v] == u32::MAX {
                picker.numbered(v as u32);
                let (guess, point) = (growth.last(), history.points[v]);
                growth.code_new(&mut coder, &mut self.live, vertices, guess, 0, point).map_err(bug)?;
            }
        }
        self.source_face = picker.order.iter().map(|&f| ids[f as usize]).collect();
        self.number = picker.number;
        let info = ChunkInfo {
            events: 0,
            faces: faces.len() as u32,
            vertices: vertices as u32,
            energy: [0, 0],
            bounds,
            ..ChunkInfo::default()
        };
        Ok(finished(info, coder, faces.len().max(vertices)))
    }

    /// Events `begin..end`, the last one first.
    fn chunk(&mut self, begin: usize, end: usize, marks: &Marks) -> Result<(ChunkInfo, Vec<u8>)> {
        let mut coder = Encoder::new();
        let faces_before = self.live.faces.len();
        for i in (begin..end).rev() {
            self.split(&mut coder, i, marks)?;
        }
        let energies = &marks.energy[begin..end];
        let info = ChunkInfo {
            events: (end - begin) as u32,
            faces: self.live.faces.len() as u32,
            vertices: self.live.points.len() as u32,
            energy: [energies.iter().min().copied().unwrap_or(0), energies.iter().max().copied().unwrap_or(0)],
            bounds: marks.bounds(begin),
            ..ChunkInfo::default()
        };
        Ok(finished(info, coder, (end - begin).max(self.live.faces.len() - faces_before)))
    }

    fn split(&mut self, coder: &mut Encoder, i: usize, marks: &Marks) -> Result<()> {
        let history = self.history;
        let [old, gone] = history.ends[i];
        let kept = self.number[old as usize];
        self.models.code_kept(coder, &self.live, kept);
        self.live.star(kept, &mut self.star);
        for &f in history.left(i) {
            self.stamp[f as usize] = i as u32 + 1;
        }
        let leaves = |corner: u32| self.stamp[self.source_face[corner as usize / 3] as usize] == i as u32 + 1;
        let wing = |f: &u32| {
            let face = history.faces[*f as usize];
            let k = face.iter().position(|&v| v == old).unwrap_or(0);
            let turned = face[(k + 1) % 3] != gone;
            let apex = if turned { face[(k + 1) % 3] } else { face[(k + 2) % 3] };
            let apex = self.number[apex as usize];
            Wing { apex, turned, class: self.classes[*f as usize], tag: *f }
        };
        let fold = |f: &u32| {
            let face = history.faces[*f as usize];
            let of_new = face.contains(&gone);
            let owner = if of_new { gone } else { old };
            let k = face.iter().position(|&v| v == owner).unwrap_or(0);
            let [a, b] = [face[(k + 1) % 3], face[(k + 2) % 3]].map(|v| self.number[v as usize]);
            Fold { of_new, a, b, class: self.classes[*f as usize], tag: *f }
        };
        let mut split = Split {
            kept,
            folds: history.folded(i).iter().map(fold).collect(),
            leaves: self.star.spokes.iter().map(|s| leaves(s.corner)).collect(),
            wings: history.died(i).iter().map(wing).collect(),
            kept_at: history.before[i],
            gone_at: history.points[gone as usize],
            deviation: marks.own[i],
        };
        self.energy = self.models.code_energy(coder, self.energy, marks.energy[i]);
        let coded = self.models.code(coder, &self.live, &mut self.star, &mut split, usize::MAX);
        coded.map_err(|what| Error::Bug(format!("event {i} has {what}")))?;
        self.live.split(&self.star, &split);
        self.number[gone as usize] = self.live.points.len() as u32 - 1;
        self.source_face.extend(split.wings.iter().map(|w| w.tag).chain(split.folds.iter().map(|f| f.tag)));
        Ok(())
    }
}

/// Ends a chunk of `count` things; padded so that a reader may hold a file to its size.
fn finished(info: ChunkInfo, coder: Encoder, count: usize) -> (ChunkInfo, Vec<u8>) {
    let mut payload = coder.finish();
    payload.resize(payload.len().max(least_bytes(count)), 0);
    (info, payload)
}
