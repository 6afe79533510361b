//! Writes a sequence of collapses backwards, as splits.
//!
//! # Method
//! 1. Collapse the source once, noting for every event which faces change hands and which die; see `history`.
//! 2. Code what is left, see `base`.
//! 3. Go through the events from the last to the first and code each as a split of the mesh so far.
//! 4. Cut the stream where the largest deviation passes a power of two, and every [`MOST_EVENTS`] events.

use super::base::{Growth, Picker};
use super::coder::Encoder;
use super::file::{About, ChunkInfo, Header, Layout, least_bytes};
use super::history::{History, on_grid};
use super::live::{Fold, Live, Star, Wing};
use super::split::{GROUP, Models, Split};
use super::{MAX_CLASSES, Sequence};
use crate::collapse::{Collapse, CollapseLog};
use crate::{Error, Result};

/// Events of a chunk at most: some 50 kB.
const MOST_EVENTS: usize = 8192;

/// Encodes `sequence`, which is used up.
///
/// # Errors
/// [`Error::Bug`] for a sequence that breaks its promises: a position off the grid, an event of a vertex that is gone.
pub fn encode(mut sequence: Sequence, about: &About) -> Result<Vec<u8>> {
    let grid_m = sequence.grid_m;
    let classes: Vec<u8> = std::mem::take(&mut sequence.labels).into_iter().map(|c| c.0).collect();
    let marks = Marks::of(&mut sequence.log, about.tracked_classes());
    let history = History::of(sequence)?;
    let events = history.events.len();
    let mut writer = Writer::new(history, &classes, about)?;
    let mut chunks = vec![writer.base(marks.bounds(events))?];
    let mut end = events;
    while end > 0 {
        let begin = marks.begin_of_chunk(end);
        chunks.push(writer.chunk(begin, end, &marks)?);
        writer.history.forget(begin);
        end = begin;
    }
    let (infos, payloads): (Vec<ChunkInfo>, Vec<Vec<u8>>) = chunks.into_iter().unzip();
    let header = Header::new(about, grid_m, &infos);
    Ok(Layout::write(&header, payloads))
}

/// How far the mesh has deviated after each event, and where chunks end.
struct Marks {
    /// Levels of each class's largest deviation, per event; of that event alone. Of classes that are not tracked, 0.
    own: Vec<[u8; MAX_CLASSES]>,
    /// The same, of all events up to and including this one.
    running: Vec<[u8; MAX_CLASSES]>,
    /// The largest energy up to each event.
    energy: Vec<i16>,
    octave: Vec<i16>,
}

impl Marks {
    /// Takes the levels out of `log`.
    fn of(log: &mut CollapseLog, classes: usize) -> Self {
        let mut own = std::mem::take(&mut log.levels);
        own.resize(log.events.len(), [0; MAX_CLASSES]);
        own.iter_mut().for_each(|levels| levels[classes..].fill(0));
        let mut most = i16::MIN;
        let energy = log.events.iter().map(|e| {
            most = most.max(energy_level(e.energy));
            most
        });
        let energy: Vec<i16> = energy.collect();
        let mut running = own.clone();
        for i in 1..running.len() {
            let before = running[i - 1];
            running[i].iter_mut().zip(before).for_each(|(r, b)| *r = (*r).max(b));
        }
        let tracked = running.last().is_some_and(|r| r.iter().any(|l| *l > 0));
        let octave = running.iter().zip(&energy).map(|(levels, energy)| {
            let worst = levels.iter().max().copied().unwrap_or(0);
            if tracked { i16::from(worst) / 4 } else { *energy }
        });
        let octave = octave.collect();
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
    history: History,
    classes: &'a [u8],
    models: Models,
    live: Live,
    star: Star,
    /// The split before, for the room its lists have.
    split: Split,
    /// Vertices that split next.
    group: Vec<u32>,
    /// Per source vertex: the record's number.
    number: Vec<u32>,
    /// Per face of the record: the source's number.
    source_face: Vec<u32>,
    /// Per source face: the event it was last marked for, plus one.
    stamp: Vec<u32>,
    energy: i16,
}

impl<'a> Writer<'a> {
    fn new(history: History, classes: &'a [u8], about: &About) -> Result<Self> {
        if classes.len() != history.faces.len() || classes.iter().any(|c| usize::from(*c) >= about.scheme.len()) {
            return Err(Error::Bug("the faces of a sequence need a class of its scheme each".into()));
        }
        Ok(Self {
            classes,
            models: Models::new(about.tracked_classes(), history.grid_m),
            live: Live::with_room(history.points.len(), history.faces.len()),
            star: Star::default(),
            split: Split::default(),
            group: Vec::with_capacity(GROUP),
            number: Vec::new(),
            source_face: Vec::with_capacity(history.faces.len()),
            stamp: vec![0; history.faces.len()],
            history,
            energy: 0,
        })
    }

    fn base(&mut self, bounds: [u8; MAX_CLASSES]) -> Result<(ChunkInfo, Vec<u8>)> {
        let history = &self.history;
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
        self.source_face.extend(picker.order.iter().map(|&f| ids[f as usize]));
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
        let faces_before = self.live.faces();
        for end in (begin + 1..=end).rev().step_by(GROUP) {
            let group = (begin.max(end.saturating_sub(GROUP))..end).rev();
            self.name_kept(&mut coder, group.clone());
            for i in group {
                self.split(&mut coder, i, marks)?;
            }
        }
        let energies = &marks.energy[begin..end];
        let info = ChunkInfo {
            events: (end - begin) as u32,
            faces: self.live.faces() as u32,
            vertices: self.live.vertices() as u32,
            energy: [energies.iter().min().copied().unwrap_or(0), energies.iter().max().copied().unwrap_or(0)],
            bounds: marks.bounds(begin),
            ..ChunkInfo::default()
        };
        Ok(finished(info, coder, (end - begin).max(self.live.faces() - faces_before)))
    }

    /// Numbers the vertices that `events` bring back, and codes those that they split.
    fn name_kept(&mut self, coder: &mut Encoder, events: impl Iterator<Item = usize>) {
        self.group.clear();
        for (i, vertices) in events.zip(self.live.vertices()..) {
            let Collapse { kept, gone, .. } = self.history.events[i];
            self.number[gone as usize] = vertices as u32;
            let kept = self.number[kept as usize];
            self.models.code_kept(coder, vertices, kept);
            self.group.push(kept);
        }
        self.live.fetch(&self.group);
    }

    fn split(&mut self, coder: &mut Encoder, i: usize, marks: &Marks) -> Result<()> {
        let history = &self.history;
        let Collapse { kept: old, gone, .. } = history.events[i];
        let kept = self.number[old as usize];
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
        let Split { leaves: mut sides, mut wings, mut folds, .. } = std::mem::take(&mut self.split);
        sides.clear();
        sides.extend(self.star.spokes.iter().map(|s| leaves(s.corner)));
        wings.clear();
        wings.extend(history.died(i).iter().map(wing));
        folds.clear();
        folds.extend(history.folded(i).iter().map(|(_, f)| fold(f)));
        // Twins follow each other.
        folds.sort_by_key(|f: &Fold| (f.a.min(f.b), f.a.max(f.b), f.of_new));
        let mut split = Split {
            kept,
            leaves: sides,
            wings,
            folds,
            kept_at: on_grid(history.events[i].position.to_array(), history.grid_m)?,
            gone_at: history.points[gone as usize],
            deviation: marks.own[i],
        };
        self.energy = self.models.code_energy(coder, self.energy, marks.energy[i]);
        let coded = self.models.code(coder, &self.live, &mut self.star, &mut split, usize::MAX);
        coded.map_err(|what| Error::Bug(format!("event {i} has {what}")))?;
        self.live.split(&self.star, &split);
        debug_assert_eq!(self.number[gone as usize], self.live.vertices() as u32 - 1);
        self.source_face.extend(split.wings.iter().map(|w| w.tag).chain(split.folds.iter().map(|f| f.tag)));
        self.split = split;
        Ok(())
    }
}

/// Ends a chunk of `count` things; padded so that a reader may hold a file to its size.
fn finished(info: ChunkInfo, coder: Encoder, count: usize) -> (ChunkInfo, Vec<u8>) {
    let mut payload = coder.finish();
    payload.resize(payload.len().max(least_bytes(count)), 0);
    (info, payload)
}
