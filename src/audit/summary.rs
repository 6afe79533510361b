//! Figures by level and class: many tiles in one row.
//!
//! Means are weighted by the reference's area; percentiles and maxima are those of the worst tile. Sides and the paper's
//! figures of tiles whose reference is incomplete are not told: there a tile stands out of what is missing.

use serde::Serialize;

use super::distance::{TileDistance, Verdict};
use crate::ids::ClassId;
use crate::measure::{Figures, Interval, Summary};

/// The tiles of a level, in all or of one class.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Tiles with content above.
    pub level: u32,
    /// The class by id; all together if none.
    pub class: Option<ClassId>,
    /// Tiles measured.
    pub tiles: u64,
    /// Of these, with an error that is understated.
    pub understated: u64,
    /// Of these, with an error that is overstated.
    pub overstated: u64,
    /// Of these, with an error set by texture.
    pub texture: u64,
    /// Smallest, median, and largest stated error, metres.
    pub stated_error_m: [f64; 3],
    /// Area of the reference, m².
    pub area_m2: f64,
    /// Both ways, weighted by area.
    pub mean_m: f64,
    /// Both ways, weighted by area.
    pub rms_m: f64,
    /// Of the worst tile.
    pub p95_m: f64,
    /// Of the worst tile.
    pub p99_m: f64,
    /// Certified, of the worst tile.
    pub hausdorff: Option<Interval>,
    /// The furthest seen that a tile sinks into the solid.
    pub inside_seen_m: f64,
    /// The furthest seen that a tile stands out of the solid.
    pub outside_seen_m: f64,
    /// The paper's Eq. 17 over all tiles, weighted by their vertices.
    pub eq17_mean_m: f64,
    /// The paper's Eq. 18 as printed: the root of the mean distance, m^½.
    pub eq18_as_printed_sqrt_m: f64,
}

/// Rows of all levels, the coarsest first; of each first all, then its classes.
pub fn rows(distances: &[TileDistance]) -> Vec<Row> {
    let measured: Vec<&TileDistance> = distances.iter().filter(|d| d.comparison.is_some()).collect();
    let mut levels: Vec<u32> = measured.iter().map(|d| d.level).collect();
    levels.sort_unstable();
    levels.dedup();
    let mut rows = Vec::new();
    for level in levels {
        let of_level: Vec<&TileDistance> = measured.iter().copied().filter(|d| d.level == level).collect();
        let classes = of_level.iter().flat_map(|d| d.comparison.iter().flat_map(|c| &c.by_class)).map(|c| c.class);
        let mut classes: Vec<ClassId> = classes.collect();
        classes.sort_unstable();
        classes.dedup();
        rows.push(row(level, None, &of_level));
        // One class is all.
        if classes.len() > 1 {
            rows.extend(classes.into_iter().map(|class| row(level, Some(class), &of_level)));
        }
    }
    rows
}

fn figures(of: &TileDistance, class: Option<ClassId>) -> Option<&Figures> {
    let comparison = of.comparison.as_ref()?;
    match class {
        None => Some(&comparison.all),
        Some(class) => comparison.by_class.iter().find(|c| c.class == class).map(|c| &c.figures),
    }
}

/// Both ways; where part of the reference is missing, what is there of it to the tile.
fn distances(of: &(&TileDistance, &Figures)) -> Option<Summary> {
    let (tile, figures) = of;
    if tile.is_incomplete { figures.reference_to_simplified.clone() } else { figures.two_sided.clone() }
}

fn interval(of: &(&TileDistance, &Figures)) -> Option<Interval> {
    let (tile, figures) = of;
    let hausdorff = &figures.hausdorff;
    if tile.is_incomplete { hausdorff.reference_to_simplified } else { hausdorff.two_sided }
}

fn row(level: u32, class: Option<ClassId>, tiles: &[&TileDistance]) -> Row {
    let with: Vec<(&TileDistance, &Figures)> =
        tiles.iter().filter_map(|d| figures(d, class).map(|f| (*d, f))).collect();
    let count = |verdict: Verdict| with.iter().filter(|(d, _)| d.verdict == verdict).count() as u64;
    let mut stated: Vec<f64> = with.iter().map(|(d, _)| d.stated_error_m).collect();
    stated.sort_by(f64::total_cmp);
    let at = |i: usize| stated.get(i).copied().unwrap_or_default();
    let area = |(d, f): &(&TileDistance, &Figures)| d.reference_area_m2 * f.reference_area_share;
    let area_m2: f64 = with.iter().map(area).sum();
    let sums: Vec<(f64, Summary)> = with.iter().filter_map(|w| Some((area(w), distances(w)?))).collect();
    let mean = |of: fn(&Summary) -> f64| sums.iter().map(|(m2, s)| m2 * of(s)).sum::<f64>() / area_m2.max(1e-12);
    let worst = |of: fn(&Summary) -> f64| sums.iter().map(|(_, s)| of(s)).fold(0.0, f64::max);
    let whole = || with.iter().filter(|w| !w.0.is_incomplete);
    let most = |of: fn(&Figures) -> f64| whole().map(|w| of(w.1)).fold(0.0, f64::max);
    let paper = |of: fn(&crate::measure::PaperFigures) -> f64| {
        let (sum, count) = whole().filter_map(|w| w.1.paper.as_ref()).fold((0.0, 0.0), |(sum, count), p| {
            let n = p.vertices as f64;
            (sum + n * of(p), count + n)
        });
        if count > 0.0 { sum / count } else { 0.0 }
    };
    Row {
        level,
        class,
        tiles: with.len() as u64,
        understated: count(Verdict::Understated),
        overstated: count(Verdict::Overstated),
        texture: count(Verdict::Texture),
        stated_error_m: [at(0), at(stated.len() / 2), at(stated.len().max(1) - 1)],
        area_m2,
        mean_m: mean(|s| s.mean_m),
        rms_m: mean(|s| s.rms_m * s.rms_m).sqrt(),
        p95_m: worst(|s| s.p95_m),
        p99_m: worst(|s| s.p99_m),
        hausdorff: match class {
            None => with.iter().filter_map(|w| w.0.hausdorff).reduce(Interval::max),
            Some(_) => with.iter().filter_map(interval).reduce(Interval::max),
        },
        inside_seen_m: most(|f| f.signed.map_or(0.0, |s| s.inside_seen_m)),
        outside_seen_m: most(|f| f.signed.map_or(0.0, |s| s.outside_seen_m)),
        eq17_mean_m: paper(|p| p.eq17_mean_m),
        eq18_as_printed_sqrt_m: paper(|p| p.eq17_mean_m).sqrt(),
    }
}
