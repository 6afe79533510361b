//! Compares the borders of all tiles and hangs skirts where they differ.
//!
//! In: [`Node`]s with their surfaces in the store. Out: a [`Hem`] for each.
//!
//! # Limits
//! The open edges on all walls are in memory at once, at 56 bytes each: about 3 bytes for each triangle of the source.

use super::Job;
use super::hierarchy::{Node, for_surfaces};
use super::ingest::City;
use crate::Result;
use crate::report::Reporter;
use crate::store::Store;
use crate::tiles::skirt::{Border, Hem, hems};
use crate::write;

/// Coordinates are f32 about an origin near the tile: no vertex moves further when it is written, metres.
const F32_ROUNDING_M: f64 = 2e-5;

/// The hem of every tile.
///
/// # Errors
/// The disk, or a wish to stop.
pub(super) fn hem(city: &City, nodes: &[Node], job: &Job, store: &Store, reporter: &Reporter) -> Result<Vec<Hem>> {
    let stage = reporter.stage("walls", 0);
    let config = job.config;
    let borders: Vec<Border> = for_surfaces(nodes, store, |t, positions, faces| {
        let plan = city.tree.cells[nodes[t].cell as usize].plan;
        // Skirts and heights make a tile wider than its cell; the step doubles, so a little room is enough.
        let rounding_m = if config.write.compress {
            write::quantization_error_of(1.5 * plan.size().max_element() + 10.0)
        } else {
            F32_ROUNDING_M
        };
        Border::of(positions, faces.iter().copied(), plan, rounding_m)
    })?;
    reporter.check()?;
    let hems = hems(&borders, config.levels.skirts);
    let widest_m = hems.iter().map(|h| h.wall_m).fold(0.0, f64::max);
    let deepest_m = hems.iter().map(|h| h.skirt_m).fold(0.0, f64::max);
    let strips: usize = hems.iter().map(|h| h.strips.len()).sum();
    stage.finish(format!(
        "tiles side by side differ by up to {widest_m:.3} m, {strips} skirts up to {deepest_m:.3} m deep"
    ));
    Ok(hems)
}
