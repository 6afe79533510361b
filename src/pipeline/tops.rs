//! Raises simplified tiles to the roofs and façades of the source, where that is asked for.
//!
//! In: [`Node`]s with their surfaces in the store. Out: a page for each simplified tile: rises, and what holds with them.
//!
//! # Method
//! 1. Each tile is held against the leaves below it, one after the other: how far each of its vertices has to rise.
//! 2. Vertices on walls at one place in tiles of one step rise alike, by the most that any of the tiles asks: borders
//!    stay shared, and whatever was one vertex stays one. What is higher still holds.

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
use crate::tiles::raise::{Held, Rises, limits_m};
use crate::tiles::soup::bits;

const FINISHED: &str = "tops/finished";

/// Rise of each vertex of a tile's surface, metres; empty where tops are not kept, and of leaves.
pub(super) fn rises(store: &Store, tile: usize) -> Result<Vec<f64>> {
    Ok(page(store, tile)?.0)
}

/// By class what holds of a tile; empty where tops are not kept, and of leaves.
pub(super) fn held(store: &Store, tile: usize) -> Result<Vec<Held>> {
    let (_, reach_m, sunk_m) = page(store, tile)?;
    Ok(reach_m.into_iter().zip(sunk_m).map(|(reach_m, sunk_m)| Held { reach_m, sunk_m }).collect())
}

type Page = (Vec<f64>, Vec<f64>, Vec<f64>);

fn page(store: &Store, tile: usize) -> Result<Page> {
    let name = page_name(tile);
    if !store.has(&name) {
        return Ok(Page::default());
    }
    let mut page = store.read(&name)?;
    let of_tile = (page.take()?, page.take()?, page.take()?);
    page.finish()?;
    Ok(of_tile)
}

fn page_name(tile: usize) -> String {
    format!("tops/{tile}")
}

/// Raises all simplified tiles, unless a run before did.
///
/// # Errors
/// The disk, or a wish to stop.
pub(super) fn keep(city: &City, nodes: &[Node], job: &Job, store: &Store, reporter: &Reporter) -> Result<()> {
    let inner: Vec<usize> = (0..nodes.len()).filter(|t| !nodes[*t].is_leaf()).collect();
    let stage = reporter.stage("tops", inner.len() as u64);
    if !store.has(FINISHED) {
        store.remove("tops");
        let limits_m = limits_m(&job.config.classes);
        let asked: Result<Vec<(Vec<f64>, Vec<Held>)>> = (inner.par_iter())
            .map(|&tile| {
                let asked = asked_by(nodes, tile, &limits_m, store, reporter);
                stage.step(1);
                asked
            })
            .collect();
        let asked = asked?;
        let plan = |tile: usize| &city.tree.cells[nodes[tile].cell as usize].plan;
        let mut on_walls: HashMap<_, f64> = HashMap::new();
        for (&tile, (rises, _)) in inner.iter().zip(&asked) {
            let mesh = surface(store, tile)?;
            for (p, rise) in mesh.positions.iter().zip(rises).filter(|(p, r)| **r > 0.0 && is_on_wall(plan(tile), p)) {
                let known = on_walls.entry((nodes[tile].scale.to_bits(), bits(*p))).or_default();
                *known = known.max(*rise);
            }
        }
        inner.par_iter().zip(asked).try_for_each(|(&tile, (mut rises, held))| {
            let mesh = surface(store, tile)?;
            for (p, rise) in mesh.positions.iter().zip(&mut rises).filter(|(p, _)| is_on_wall(plan(tile), p)) {
                let key = (nodes[tile].scale.to_bits(), bits(*p));
                *rise = on_walls.get(&key).copied().unwrap_or(0.0);
            }
            let mut page = store.page(&page_name(tile))?;
            page.put(&rises)?;
            page.put(&held.iter().map(|h| h.reach_m).collect::<Vec<f64>>())?;
            page.put(&held.iter().map(|h| h.sunk_m).collect::<Vec<f64>>())?;
            page.finish()
        })?;
        store.write_file(FINISHED, b"")?;
    }
    stage.finish("simplified tiles are raised to the roofs and façades of the source".into());
    Ok(())
}

fn is_on_wall(plan: &Rect, p: &glam::DVec3) -> bool {
    (0..2).any(|k| p[k] == plan.min[k] || p[k] == plan.max[k])
}

/// How far each vertex of a tile has to rise, and what holds then.
fn asked_by(
    nodes: &[Node],
    tile: usize,
    limits_m: &[f64],
    store: &Store,
    reporter: &Reporter,
) -> Result<(Vec<f64>, Vec<Held>)> {
    let mesh: TileMesh = surface(store, tile)?;
    let mut rises = Rises::of(&mesh, limits_m);
    for leaf in leaves_below(nodes, tile) {
        reporter.check()?;
        let source = leaf_mesh(store, leaf)?;
        let (labels, _) = leaf_labels(store, leaf)?;
        rises.hold(labels.iter().enumerate().map(|(f, class)| (source.corners(f), *class)));
    }
    Ok(rises.finish())
}
