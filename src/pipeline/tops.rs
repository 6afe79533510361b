//! Raises simplified tiles to the roofs and façades of the source, where that is asked for.
//!
//! In: [`Node`]s with their surfaces in the store. Out: a page of rises for each tile that has any.
//!
//! # Method
//! 1. Each tile is held against the leaves below it, one after the other: how far each of its vertices has to rise.
//! 2. Vertices on walls at one place in tiles of one step rise alike, by the most that any of the tiles asks: borders
//!    stay shared, and whatever was one vertex stays one.
//! 3. Again, up to [`ROUNDS`] times, as what has risen may now be nearest to something else.

use std::collections::HashMap;

use rayon::prelude::*;

use super::Job;
use super::hierarchy::{Node, leaves_below, surface};
use super::ingest::{City, leaf_mesh};
use super::labels::leaf_labels;
use crate::Result;
use crate::geo::Rect;
use crate::report::Reporter;
use crate::store::Store;
use crate::tiles::TileMesh;
use crate::tiles::raise::{Rises, limits_m};
use crate::tiles::soup::bits;

const ROUNDS: usize = 5;
/// Rises below this are not worth a round, metres.
const LEAST_M: f64 = 1e-3;
const FINISHED: &str = "tops/finished";

/// Rise of each vertex of a tile's surface, metres; empty where none rises.
pub(super) fn rises(store: &Store, tile: usize) -> Result<Vec<f64>> {
    let name = page_name(tile);
    if !store.has(&name) {
        return Ok(Vec::new());
    }
    let mut page = store.read(&name)?;
    let rises = page.take()?;
    page.finish()?;
    Ok(rises)
}

fn page_name(tile: usize) -> String {
    format!("tops/{tile}")
}

/// Raises all simplified tiles, unless a run before did.
///
/// # Errors
/// The disk, or a wish to stop.
pub(super) fn keep(city: &City, nodes: &[Node], job: &Job, store: &Store, reporter: &Reporter) -> Result<()> {
    let stage = reporter.stage("tops", ROUNDS as u64);
    if !store.has(FINISHED) {
        store.remove("tops");
        let limits_m = limits_m(&job.config.classes);
        let inner: Vec<usize> = (0..nodes.len()).filter(|t| !nodes[*t].is_leaf()).collect();
        for _ in 0..ROUNDS {
            reporter.check()?;
            let asked: Result<Vec<Vec<f64>>> =
                inner.par_iter().map(|&tile| asked_by(nodes, tile, &limits_m, store, reporter)).collect();
            let asked = asked?;
            if asked.iter().flatten().copied().fold(0.0, f64::max) < LEAST_M {
                break;
            }
            let plan = |tile: usize| &city.tree.0[nodes[tile].cell as usize].plan;
            let mut on_walls: HashMap<_, f64> = HashMap::new();
            for (&tile, asked) in inner.iter().zip(&asked) {
                let mesh = surface(store, tile)?;
                for (p, rise) in
                    mesh.positions.iter().zip(asked).filter(|(p, r)| **r > 0.0 && is_on_wall(plan(tile), p))
                {
                    let known = on_walls.entry((nodes[tile].scale.to_bits(), bits(*p))).or_default();
                    *known = known.max(*rise);
                }
            }
            inner.par_iter().zip(asked).try_for_each(|(&tile, mut asked)| {
                let mesh = surface(store, tile)?;
                for (p, rise) in mesh.positions.iter().zip(&mut asked).filter(|(p, _)| is_on_wall(plan(tile), p)) {
                    let key = (nodes[tile].scale.to_bits(), bits(*p));
                    *rise = on_walls.get(&key).copied().unwrap_or(0.0);
                }
                add(store, tile, asked)
            })?;
            stage.step(1);
        }
        store.write_file(FINISHED, b"")?;
    }
    stage.finish("simplified tiles are raised to the roofs and façades of the source".into());
    Ok(())
}

fn is_on_wall(plan: &Rect, p: &glam::DVec3) -> bool {
    (0..2).any(|k| p[k] == plan.min[k] || p[k] == plan.max[k])
}

/// How far each vertex of a tile still has to rise.
fn asked_by(nodes: &[Node], tile: usize, limits_m: &[f64], store: &Store, reporter: &Reporter) -> Result<Vec<f64>> {
    let mesh: TileMesh = surface(store, tile)?;
    let mut rises = Rises::of(&mesh, limits_m);
    for leaf in leaves_below(nodes, tile) {
        reporter.check()?;
        let source = leaf_mesh(store, leaf)?;
        let (labels, _) = leaf_labels(store, leaf)?;
        rises.hold(labels.iter().enumerate().map(|(f, class)| (source.corners(f), *class)));
    }
    Ok(rises.into_metres())
}

fn add(store: &Store, tile: usize, more: Vec<f64>) -> Result<()> {
    if more.iter().all(|r| *r == 0.0) {
        return Ok(());
    }
    let mut all = rises(store, tile)?;
    all.resize(more.len(), 0.0);
    all.iter_mut().zip(more).for_each(|(rise, more)| *rise += more);
    let mut page = store.page(&page_name(tile))?;
    page.put(&all)?;
    page.finish()
}
