//! Reads a record back, from the base to the detail wanted.
//!
//! # Promises   whatever the bytes: an error or a valid mesh, in memory that the size of the file bounds

use std::path::{Path, PathBuf};

use glam::DVec3;

use super::MAX_CLASSES;
use super::base::{Growth, Next};
use super::coder::Decoder;
use super::file::{ChunkInfo, Header, Layout};
use super::level::size_of;
use super::live::{Grid, Live, Star};
use super::progressive::Progressive;
use super::split::{GROUP, Models, Split};
use crate::error::Place;
use crate::{Error, Result};

/// A record in memory, its header read and checked.
#[derive(Debug, Clone)]
pub struct Record {
    path: PathBuf,
    bytes: Vec<u8>,
    layout: Layout,
}

/// Faces looked at for an event, on average, at most. Real meshes have six; only a hub of thousands needs more.
const MOST_WORK: usize = 4096;

impl Record {
    /// Takes the bytes of a record; `path` is for messages.
    ///
    /// # Errors
    /// [`Error::Input`] for bytes that are no whole record, [`Error::Unsupported`] for a later version.
    pub fn open(path: &Path, bytes: Vec<u8>) -> Result<Self> {
        let layout = Layout::read(path, &bytes)?;
        Ok(Self { path: path.to_path_buf(), bytes, layout })
    }

    /// What it says about itself.
    pub fn header(&self) -> &Header {
        &self.layout.header
    }

    /// Bytes of the file up to and including each part: base, then chunks from coarse to fine.
    pub fn bytes_through(&self) -> impl Iterator<Item = usize> + '_ {
        self.layout.places.iter().map(|p| p.end)
    }

    /// Chunks to decode for a mesh of at least `faces` faces, or all of them.
    pub fn chunks_for_faces(&self, faces: usize) -> usize {
        self.header().chunks.iter().position(|c| c.faces as usize >= faces).unwrap_or(self.header().chunks.len())
    }

    /// Chunks to decode for a mesh that keeps every class within its limit, metres; none if deviations were not
    /// recorded.
    pub fn chunks_within(&self, limits_m: &[f64; MAX_CLASSES]) -> Option<usize> {
        let fits = |c: &ChunkInfo| c.bounds.iter().zip(limits_m).all(|(l, m)| size_of(*l) <= *m);
        self.header().chunks.iter().position(fits).filter(|_| self.header().about.tracked)
    }

    /// Chunks in the first `bytes` of the file; none if not even the base is.
    pub fn chunks_in_bytes(&self, bytes: usize) -> Option<usize> {
        self.bytes_through().filter(|end| *end <= bytes).count().checked_sub(1)
    }

    /// Header and payloads, for tests that put them together wrongly.
    #[cfg(test)]
    pub(super) fn taken_apart(&self) -> (Header, Vec<Vec<u8>>) {
        let parts = self.layout.places.iter().map(|p| self.bytes[p.clone()].to_vec());
        (self.layout.header.clone(), parts.collect())
    }

    /// Decodes the base and the first `chunks` chunks (all, if there are fewer). Later bytes are not looked at.
    ///
    /// # Errors
    /// [`Error::Input`] for a part that is damaged or nonsense.
    pub fn decode(&self, chunks: usize) -> Result<Progressive> {
        let header = &self.layout.header;
        let classes = header.about.scheme.len();
        let mut reader = Reader {
            models: Models::new(header.about.tracked_classes(), header.grid_m),
            classes: classes as u8,
            live: Live::default(),
            group: Vec::new(),
            star: Star::default(),
            energy: 0,
            work: 0,
            grid_m: header.grid_m,
        };
        let fault = |i: usize| {
            move |what: &str| {
                let place = Place::Byte(self.layout.places[i].start as u64);
                Error::input_at(&self.path, place, format!("part {i} is nonsense: {what}; record again"))
            }
        };
        let base = header.chunks[0];
        let payload = self.layout.payload(&self.path, &self.bytes, 0)?;
        reader.base(payload, base.faces as usize, base.vertices as usize).map_err(fault(0))?;
        let metres = |p: Grid| DVec3::new(p[0] as f64, p[1] as f64, p[2] as f64) * header.grid_m;
        let mut out = Progressive {
            about: header.about.clone(),
            base_points: reader.live.points().map(metres).collect(),
            base_faces: base.faces,
            finest: header.chunks[chunks.min(header.chunks.len() - 1)].bounds,
            ..Progressive::default()
        };
        for (i, chunk) in header.chunks.iter().enumerate().skip(1).take(chunks) {
            let payload = self.layout.payload(&self.path, &self.bytes, i)?;
            let faces = chunk.faces as usize;
            reader.chunk(payload, chunk.events, faces, &mut out).map_err(fault(i))?;
        }
        (out.faces, out.classes) = reader.live.into_faces();
        Ok(out)
    }
}

struct Reader {
    models: Models,
    classes: u8,
    live: Live,
    /// Vertices that split next.
    group: Vec<u32>,
    star: Star,
    energy: i16,
    work: usize,
    grid_m: f64,
}

const TOO_SHORT: &str = "it ends too early";

impl Reader {
    fn base(&mut self, payload: &[u8], faces: usize, vertices: usize) -> Result<(), &'static str> {
        let mut coder = Decoder::new(payload);
        let mut growth = Growth::new();
        while self.live.faces() < faces {
            growth.code(&mut coder, &mut self.models, &mut self.live, vertices, &Next::default())?;
            self.check(&coder, self.live.faces() - 1)?;
        }
        while self.live.vertices() < vertices {
            let guess = growth.last();
            growth.code_new(&mut coder, &mut self.live, vertices, guess, 0, [0; 3])?;
            self.check(&coder, self.live.faces())?;
        }
        Ok(())
    }

    fn check(&self, coder: &Decoder, first_face: usize) -> Result<(), &'static str> {
        if coder.overrun() {
            return Err(TOO_SHORT);
        }
        if self.live.classes_from(first_face).any(|c| c >= self.classes) {
            return Err("a class that it does not name");
        }
        Ok(())
    }

    fn chunk(&mut self, payload: &[u8], events: u32, faces: usize, out: &mut Progressive) -> Result<(), &'static str> {
        let mut coder = Decoder::new(payload);
        let mut split = Split::default();
        if self.live.vertices() == 0 && events > 0 {
            return Err("a vertex that is not there");
        }
        let metres = |p: Grid| DVec3::new(p[0] as f64, p[1] as f64, p[2] as f64) * self.grid_m;
        for i in 0..events as usize {
            if i % GROUP == 0 {
                let first = self.live.vertices();
                let count = GROUP.min(events as usize - i);
                self.group.clear();
                self.group.extend((first..first + count).map(|n| self.models.code_kept(&mut coder, n, 0)));
                self.live.fetch(&self.group);
            }
            split.kept = self.group[i % GROUP];
            self.live.star(split.kept, &mut self.star);
            self.work += self.star.spokes.len();
            if self.work / MOST_WORK > 4 * MOST_WORK + out.kept.len() {
                return Err("vertices of too many faces");
            }
            self.energy = self.models.code_energy(&mut coder, self.energy, 0);
            let before = self.live.faces();
            split.leaves.clear();
            split.wings.clear();
            split.folds.clear();
            split.deviation = [0; MAX_CLASSES];
            self.models.code(&mut coder, &self.live, &mut self.star, &mut split, faces - before)?;
            let coarse_at = self.live.at(split.kept);
            self.live.split(&self.star, &split);
            self.check(&coder, before)?;
            out.kept.push(split.kept);
            out.coarse_at.push(metres(coarse_at));
            out.kept_at.push(metres(split.kept_at));
            out.gone_at.push(metres(split.gone_at));
            out.deviation.push(split.deviation);
            out.energy.push(self.energy);
            out.faces_after.push(self.live.faces() as u32);
            out.rims.extend(self.star.rims.iter().map(|r| r.vertex));
            let others = split.wings.iter().map(|w| w.apex).chain(split.folds.iter().flat_map(|f| [f.a, f.b]));
            out.rims.extend(others.filter(|v| self.star.rims.iter().all(|r| r.vertex != *v)));
            out.rims_end.push(out.rims.len());
        }
        if self.live.faces() != faces { Err("fewer faces than it says it has") } else { Ok(()) }
    }
}
