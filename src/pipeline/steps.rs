//! Simplifies a surface in the store, step by step, window by window.
//!
//! In: the leaves with their labels. Out: after each step the [`Patch`] of every cell, as a page.
//!
//! # Method
//! Step k reads the pages of step k - 1 and writes its own; when the last window is done its summary is written, and
//! only then the older pages go. So a run that was killed goes on from the last window it finished. Windows are cut
//! elsewhere in odd steps than in even ones: what is locked on their borders is free in the next step.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::ingest::{City, leaf_mesh};
use super::labels::leaf_labels;
use super::windows::{self, Weighed};
use crate::collapse::window::{Patch, Sample, StepSettings, step};
use crate::config::Config;
use crate::geo::Rect;
use crate::ids::ClassId;
use crate::report::Reporter;
use crate::store::Store;
use crate::{Error, Result};

/// A window has at most this many faces and samples for each face it may have: what collapses needs less memory for
/// each than what is classified.
const ITEMS_PER_FACE: u64 = 2;

/// A window is cut into so many blocks at least, or the coarse steps would be one thread's.
const LEAST_BLOCKS: usize = 8;
/// But for that no block has fewer faces than this: borders of blocks are locked.
const SMALL_BLOCK_FACES: usize = 25_000;

/// The current surface, cell by cell.
pub(super) struct Steps<'a> {
    city: &'a City,
    config: &'a Config,
    store: &'a Store,
    reporter: &'a Reporter,
    /// Pages written so far, merges included.
    pages: u32,
    /// Steps to a scale so far.
    steps: u32,
    /// Where the surface of each cell is, and how much it is.
    state: BTreeMap<u32, State>,
    pub collapses: usize,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct State {
    page: u32,
    faces: u64,
    samples: u64,
}

/// What a finished step leaves beside the cells' pages.
#[derive(Serialize, Deserialize)]
struct Finished {
    state: BTreeMap<u32, State>,
    collapses: usize,
}

impl<'a> Steps<'a> {
    /// The source, a sample at every vertex.
    pub fn new(city: &'a City, config: &'a Config, store: &'a Store, reporter: &'a Reporter) -> Result<Self> {
        let state = BTreeMap::new();
        let mut steps = Self { city, config, store, reporter, pages: 0, steps: 0, state, collapses: 0 };
        let budgets: Vec<f64> = config.classes.0.iter().map(|c| c.budget_m).collect();
        let cells: Vec<u32> = city.leaves.iter().map(|l| l.cell).collect();
        steps.advance(|steps, page| {
            let made: Result<Vec<(u32, State)>> = cells
                .par_iter()
                .map(|&cell| {
                    steps.once(page, cell, || {
                        let mesh = leaf_mesh(store, cell)?;
                        let (labels, omega) = leaf_labels(store, cell)?;
                        Ok(Patch::of_source(mesh.positions, mesh.faces, labels, omega, &budgets))
                    })
                })
                .collect();
            Ok((made?.into_iter().collect(), 0))
        })?;
        Ok(steps)
    }

    /// Makes one patch of the patches below each inner cell of `depth`, with the samples that steps from `scale` on need.
    pub fn merge(&mut self, depth: u8, scale: f64) -> Result<()> {
        let tree = &self.city.tree;
        let mut below: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for &cell in self.state.keys() {
            below.entry(tree.ancestor(cell, depth)).or_default().push(cell);
        }
        self.advance(|steps, page| {
            let mut merged = BTreeMap::new();
            for batch in steps.batches(&below) {
                let made: Result<Vec<(u32, State)>> = batch
                    .par_iter()
                    .map(|&(cell, parts)| {
                        if *parts == [cell] {
                            return Ok((cell, steps.state[&cell].clone()));
                        }
                        steps.once(page, cell, || {
                            // One after the other: samples that steps since the last merge made too many of are the
                            // largest thing of a city, and together they were 2.5 GB of 48 million triangles.
                            let thinned = |&c| steps.patch(c).map(|patch| patch.thinned(scale));
                            let patches: Result<Vec<Patch>> = parts.iter().map(thinned).collect();
                            Ok(Patch::joined(patches?).thinned(scale))
                        })
                    })
                    .collect();
                merged.extend(made?);
            }
            Ok((merged, 0))
        })
    }

    /// Cells to merge at a time: as many as are a window together, so that many threads take no more memory than few.
    fn batches<'b>(&self, below: &'b BTreeMap<u32, Vec<u32>>) -> Vec<Vec<(u32, &'b Vec<u32>)>> {
        let most = ITEMS_PER_FACE * self.config.levels.window_faces as u64;
        let weight = |parts: &[u32]| -> u64 { parts.iter().map(|c| self.state[c].faces + self.state[c].samples).sum() };
        let mut batches: Vec<Vec<(u32, &Vec<u32>)>> = Vec::new();
        let mut left = 0;
        for (&cell, parts) in below {
            let own = weight(parts);
            match batches.last_mut() {
                Some(batch) if own <= left => batch.push((cell, parts)),
                _ => {
                    batches.push(vec![(cell, parts)]);
                    left = most;
                }
            }
            left = left.saturating_sub(own);
        }
        batches
    }

    /// Collapses all that `scale` admits.
    pub fn step(&mut self, scale: f64, depth: u8) -> Result<()> {
        let settings = StepSettings {
            scale,
            strictest_m: self.config.classes.0.iter().map(|c| c.budget_m).fold(f64::INFINITY, f64::min),
            classes: self.config.classes.len(),
            block_faces: self.config.collapse.block_faces,
            odd: !self.steps.is_multiple_of(2),
        };
        self.steps += 1;
        let most = ITEMS_PER_FACE * self.config.levels.window_faces as u64;
        let cells = self.state.iter().map(|(&cell, s)| Weighed { cell, weight: s.faces + s.samples }).collect();
        let windows = windows::split(&self.city.tree, cells, most, settings.odd);
        self.advance(|steps, page| {
            let (mut state, mut collapses) = (BTreeMap::new(), 0);
            for window in &windows {
                steps.reporter.check()?;
                let (made, done) = steps.run_window(window, depth, page, &settings)?;
                state.extend(made);
                collapses += done;
            }
            Ok((state, collapses))
        })
    }

    fn run_window(
        &self,
        window: &[Weighed],
        depth: u8,
        page: u32,
        settings: &StepSettings,
    ) -> Result<(Vec<(u32, State)>, usize)> {
        let tree = &self.city.tree;
        let done: Option<Vec<_>> = window.iter().map(|w| self.finished(page, w.cell).transpose()).collect();
        if let Some(done) = done {
            let done = done.into_iter().collect::<Result<Vec<_>>>()?;
            let collapses = done.iter().map(|d| d.1).sum();
            return Ok((window.iter().zip(done).map(|(w, d)| (w.cell, d.0)).collect(), collapses));
        }
        let patches: Result<Vec<Patch>> = window.par_iter().map(|w| self.patch(w.cell)).collect();
        let boxes: Vec<Rect> = window.iter().map(|w| tree.cells[w.cell as usize].plan).collect();
        let is_inside = |cell: u32| window.binary_search_by_key(&cell, |w| w.cell).is_ok();
        let is_locked = |p: glam::DVec3| {
            let mut outside = false;
            tree.touching(p.truncate(), depth, |c| outside |= !is_inside(c) && self.state.contains_key(&c));
            outside
        };
        let patches = patches?;
        let faces: usize = patches.iter().map(|p| p.faces.len()).sum();
        let block_faces = (faces / LEAST_BLOCKS).max(SMALL_BLOCK_FACES).min(settings.block_faces);
        let (patches, collapses) = step(patches, &boxes, is_locked, &StepSettings { block_faces, ..*settings });
        let write = |(i, (w, patch)): (usize, (&Weighed, Patch))| {
            // The first cell's page carries the count of its window.
            self.write(page, w.cell, &patch, if i == 0 { collapses } else { 0 }).map(|state| (w.cell, state))
        };
        let made: Result<Vec<_>> = window.par_iter().zip(patches).enumerate().map(write).collect();
        Ok((made?, collapses))
    }

    /// Runs `make` unless a run before finished it, and takes over its state.
    fn advance(&mut self, make: impl FnOnce(&Self, u32) -> Result<(BTreeMap<u32, State>, usize)>) -> Result<()> {
        let page = self.pages;
        let name = format!("step/{page}.json");
        let known = self.store.read_file(&name)?.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        let Finished { state, collapses } = match known {
            Some(finished) => finished,
            None => {
                let (state, collapses) = make(self, page)?;
                let finished = Finished { state, collapses };
                let bytes = serde_json::to_vec(&finished).map_err(|e| Error::Bug(format!("step: {e}")))?;
                self.store.write_file(&name, &bytes)?;
                finished
            }
        };
        let old = std::mem::replace(&mut self.state, state);
        for (cell, state) in old {
            if self.state.get(&cell).is_none_or(|s| s.page != state.page) {
                self.store.remove(&page_of(state.page, cell));
            }
        }
        self.pages += 1;
        self.collapses += collapses;
        Ok(())
    }

    /// Makes and writes a cell's patch unless it is there.
    fn once(&self, page: u32, cell: u32, make: impl FnOnce() -> Result<Patch>) -> Result<(u32, State)> {
        self.reporter.check()?;
        if let Some((state, _)) = self.finished(page, cell)? {
            return Ok((cell, state));
        }
        Ok((cell, self.write(page, cell, &make()?, 0)?))
    }

    /// A page that a run before wrote.
    fn finished(&self, page: u32, cell: u32) -> Result<Option<(State, usize)>> {
        let name = page_of(page, cell);
        if !self.store.has(&name) {
            return Ok(None);
        }
        let head = self.store.read(&name)?.take::<u64>()?;
        let [faces, samples, collapses] = head[..] else {
            return Err(Error::Bug(format!("page {name} has a head of {} numbers", head.len())));
        };
        Ok(Some((State { page, faces, samples }, collapses as usize)))
    }

    fn write(&self, number: u32, cell: u32, patch: &Patch, collapses: usize) -> Result<State> {
        let state = State { page: number, faces: patch.faces.len() as u64, samples: patch.samples.len() as u64 };
        let mut page = self.store.page(&page_of(number, cell))?;
        page.put(&[state.faces, state.samples, collapses as u64])?;
        page.put(&patch.positions)?;
        page.put(&patch.faces)?;
        page.put(&patch.labels.iter().map(|l| l.0).collect::<Vec<u8>>())?;
        page.put(&patch.omega)?;
        page.put(&patch.samples)?;
        page.put(&patch.rides)?;
        page.finish()?;
        Ok(state)
    }

    /// The current patch of a cell.
    pub fn patch(&self, cell: u32) -> Result<Patch> {
        let mut page = self.store.read(&page_of(self.state[&cell].page, cell))?;
        page.take::<u64>()?;
        let patch = Patch {
            positions: page.take()?,
            faces: page.take()?,
            labels: page.take::<u8>()?.into_iter().map(ClassId).collect(),
            omega: page.take()?,
            samples: page.take::<Sample>()?,
            rides: page.take()?,
        };
        page.finish()?;
        Ok(patch)
    }

    /// Cells that have a surface, with their faces.
    pub fn cells(&self) -> impl Iterator<Item = (u32, u64)> {
        self.state.iter().map(|(&cell, s)| (cell, s.faces))
    }

    /// Faces of a cell.
    pub fn faces_of(&self, cell: u32) -> usize {
        self.state.get(&cell).map_or(0, |s| s.faces as usize)
    }

    /// Faces left.
    pub fn faces(&self) -> usize {
        self.state.values().map(|s| s.faces as usize).sum()
    }

    /// Steps to a scale so far.
    pub fn count(&self) -> u32 {
        self.steps
    }
}

fn page_of(page: u32, cell: u32) -> String {
    format!("step/{page}-{cell}")
}
