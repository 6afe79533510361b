//! The original mesh, in the tileset's frame, cut to a tile's part of it.

use std::path::PathBuf;

use glam::DVec3;
use serde::Serialize;

use super::budget::Budget;
use super::cells::{Cells, Writer};
use super::cover::Shown;
use super::read::Tileset;
use crate::geo::{Aabb, Frame, Georeference};
use crate::input::discover::{Found, discover};
use crate::input::{self, InputConfig, Source};
use crate::measure::Surface;
use crate::report::Reporter;
use crate::{Error, Result};

/// Where the original is, and in which coordinates.
#[derive(Debug, Clone, Default)]
pub struct OriginalConfig {
    /// Files or folders, as for a build.
    pub inputs: Vec<PathBuf>,
    /// Its coordinates; what its own files say if none.
    pub georeference: Option<Georeference>,
}

/// The original, ready to be cut: its triangles are on disk.
pub struct Original {
    cells: Cells,
    /// Tiles lie above one another: parts are cut from above and below too.
    is_stacked: bool,
    /// How it was brought into the tileset's frame.
    pub placed: Placed,
}

/// How the original lies to the tileset.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Placed {
    /// `globe` through Earth-centred coordinates; `same` coordinates; `centred`, as builds without a place on the Earth do.
    pub how: &'static str,
    /// Triangles with finite corners.
    pub triangles: usize,
    /// From the middle of the finest tiles' box to that of the original's, metres.
    pub shift_m: [f64; 3],
    /// Of the finest tiles' box, metres.
    pub diagonal_m: f64,
}

/// Boxes whose middles are this far apart are not those of one model, metres; or this share of the diagonal.
const SHIFT_M: f64 = 0.5;
const SHIFT_REL: f64 = 0.005;

impl Original {
    /// Reads the original and brings it into the frame of `tileset`, whose finest tiles lie in `box_local`.
    ///
    /// Warns `source-shifted` where the two do not lie over each other.
    ///
    /// # Errors
    /// Those of the readers; [`Error::Limit`] for a file that does not fit into `budget`; a place on the Earth that is not
    /// the tileset's.
    pub fn read(
        config: &OriginalConfig,
        tileset: &Tileset,
        box_local: Aabb,
        budget: Budget,
        reporter: &Reporter,
    ) -> Result<Self> {
        let stage = reporter.stage("source", 0);
        let found = discover(&config.inputs, reporter)?;
        let georeference = match (&config.georeference, &found.metadata_xml, &found.odm_coords) {
            (Some(georeference), _, _) => georeference.clone(),
            (None, Some(path), _) => input::georeference::read_metadata_xml(path)?,
            (None, None, Some(path)) => input::georeference::read_odm(path)?,
            (None, None, None) => Georeference::Local,
        };
        fits(&found, budget)?;
        let mut writer = Writer::new()?;
        let at_once = budget.original_bytes() / 4;
        input::read_each(&found, &InputConfig::default(), at_once, reporter, |mut source| {
            place(&mut source, &georeference, tileset)?;
            for part in &source.parts {
                for face in &part.faces {
                    let corners = face.map(|v| part.positions[v as usize]);
                    if corners.iter().all(|p| p.is_finite()) {
                        writer.push(corners)?;
                    }
                }
            }
            Ok(())
        })?;
        let path = config.inputs.first().cloned().unwrap_or_default();
        if writer.count == 0 {
            return Err(Error::input(path, "has no surface to compare with"));
        }
        let (by, how) = match georeference {
            Georeference::Local => centred(writer.aabb, box_local),
            _ => (DVec3::ZERO, "globe"),
        };
        let cells = writer.finish(by)?;
        let shift = cells.aabb.center() - box_local.center();
        let diagonal_m = box_local.size().length();
        let placed = Placed { how, triangles: cells.count, shift_m: shift.to_array(), diagonal_m };
        if shift.length() > SHIFT_M.max(SHIFT_REL * diagonal_m) {
            let what = format!(
                "the original's middle is {:.2} m from that of the finest tiles (east {:.2}, north {:.2}, up {:.2}); \
                 check its coordinates before you believe a distance",
                shift.length(),
                shift.x,
                shift.y,
                shift.z
            );
            reporter.warn("source-shifted", &path, what);
        }
        stage.finish(format!("{} triangles, {how}", cells.count));
        Ok(Self { cells, is_stacked: is_stacked(tileset), placed })
    }

    /// About how many faces [`Original::part`] cuts.
    pub fn count(&self, aabb: Aabb) -> usize {
        self.cells.about(&aabb)
    }

    /// What went wrong while parts were cut.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn check(&self) -> Result<()> {
        self.cells.check()
    }

    /// Tiles that do not lie above one another stand for what is there at any height.
    fn within(&self, aabb: Aabb) -> Aabb {
        let mut within = aabb;
        if !self.is_stacked {
            within.min.z = f64::NEG_INFINITY;
            within.max.z = f64::INFINITY;
        }
        within
    }

    /// The part of the original within `aabb`; of tiles that do not lie above one another at any height.
    pub fn part(&self, aabb: Aabb) -> Shown {
        let within = self.within(aabb);
        let mut surface = Surface::default();
        let mut aabb = Aabb::EMPTY;
        self.cells.visit(&within, &mut |corners| {
            let polygon = clipped(corners, &within);
            let base = surface.positions.len() as u32;
            for k in 2..polygon.len() as u32 {
                surface.faces.push([base, base + k - 1, base + k]);
            }
            if polygon.len() >= 3 {
                polygon.iter().for_each(|&p| aabb.extend(p));
                surface.positions.extend(polygon);
            }
        });
        Shown { surface, aabb, refused: None }
    }
}

/// Refuses files that would need more memory than there is, before they are read.
fn fits(found: &Found, budget: Budget) -> Result<()> {
    for path in &found.files {
        let bytes = std::fs::metadata(path).map_or(0, |m| m.len());
        if bytes > budget.original_bytes() {
            let what = format!(
                "has {} MB; files of an original may have {} MB with --memory {} MB: give four times the file's size or more, \
                 or split it",
                bytes / 1_000_000,
                budget.original_bytes() / 1_000_000,
                budget.0 / 1_000_000
            );
            return Err(Error::Limit { path: path.clone(), what });
        }
    }
    Ok(())
}

/// What to move by, and what that is called: builds without a place on the Earth put the middle at (0, 0). What lies
/// nearer is taken.
fn centred(bounds: Aabb, box_local: Aabb) -> (DVec3, &'static str) {
    let anchor = bounds.center().with_z(bounds.min.z).round();
    let off = |by: DVec3| (bounds.center() - by - box_local.center()).length();
    if off(anchor) < off(DVec3::ZERO) { (anchor, "centred") } else { (DVec3::ZERO, "same") }
}

/// Brings positions of a place on the Earth into the tileset's frame.
fn place(source: &mut Source, georeference: &Georeference, tileset: &Tileset) -> Result<()> {
    if let Georeference::Local = georeference {
        return Ok(());
    }
    let corners = source.parts.iter().flat_map(|p| p.faces.iter().flatten().map(|&v| p.positions[v as usize]));
    let bounds = Aabb::of(corners.filter(|p| p.is_finite()));
    if bounds.is_empty() {
        return Ok(());
    }
    let path = source.parts.first().map(|p| p.path.clone()).unwrap_or_default();
    let frame = Frame::of(georeference.clone(), bounds.center().with_z(bounds.min.z).round())?;
    let Some(ecef_from_source_local) = frame.ecef_from_local().filter(|_| tileset.frame.origin.is_some()) else {
        let what = "the original has a place on the Earth and the tileset has none; give --source-crs local";
        return Err(Error::input(path, what));
    };
    let local_from_source_local = tileset.frame.local_from_root * ecef_from_source_local;
    for part in &mut source.parts {
        frame.locals_from_sources(&part.path, &mut part.positions)?;
        part.positions.iter_mut().for_each(|p| *p = local_from_source_local.transform_point3(*p));
    }
    Ok(())
}

/// True if two tiles of one parent lie one above the other.
fn is_stacked(tileset: &Tileset) -> bool {
    /// Pairs of one parent looked at.
    const MOST_CHILDREN: usize = 64;
    tileset.tiles.iter().any(|tile| {
        let places: Vec<(DVec3, f64)> = tile
            .children
            .iter()
            .take(MOST_CHILDREN)
            .filter_map(|&child| tileset.tiles[child].volume)
            .map(|v| (tileset.frame.local_from_root.transform_point3(v.centre()), v.radius_m()))
            .collect();
        let is_above = |&(a, radius): &(DVec3, f64), &(b, other): &(DVec3, f64)| {
            let size = radius.min(other);
            (a - b).truncate().length() < 0.25 * size && (a.z - b.z).abs() > 0.25 * size
        };
        (0..places.len()).any(|i| (0..i).any(|j| is_above(&places[i], &places[j])))
    })
}

/// The corners of the part of a triangle inside a box; fewer than three if there is none.
fn clipped(corners: [DVec3; 3], within: &Aabb) -> Vec<DVec3> {
    let mut polygon = corners.to_vec();
    for axis in 0..3 {
        for (limit, sign) in [(within.min[axis], 1.0), (within.max[axis], -1.0)] {
            if !limit.is_finite() {
                continue;
            }
            let depth = |p: &DVec3| (p[axis] - limit) * sign;
            if polygon.iter().all(|p| depth(p) >= 0.0) {
                continue;
            }
            let mut kept = Vec::with_capacity(polygon.len() + 1);
            for (i, p) in polygon.iter().enumerate() {
                let q = &polygon[(i + 1) % polygon.len()];
                let (of_p, of_q) = (depth(p), depth(q));
                if of_p >= 0.0 {
                    kept.push(*p);
                }
                if (of_p < 0.0) != (of_q < 0.0) {
                    let mut cut = *p + (*q - *p) * (of_p / (of_p - of_q));
                    cut[axis] = limit;
                    kept.push(cut);
                }
            }
            polygon = kept;
        }
    }
    polygon
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_triangle_is_cut_to_the_part_inside() {
        let corners = [DVec3::ZERO, DVec3::new(4.0, 0.0, 1.0), DVec3::new(0.0, 4.0, 1.0)];
        let within = Aabb { min: DVec3::new(1.0, 1.0, f64::NEG_INFINITY), max: DVec3::new(9.0, 9.0, f64::INFINITY) };
        let polygon = clipped(corners, &within);
        let area: f64 =
            (2..polygon.len()).map(|k| (polygon[k - 1] - polygon[0]).cross(polygon[k] - polygon[0]).z / 2.0).sum();
        assert!((area - 2.0).abs() < 1e-12, "{polygon:?}");
        assert!(clipped(corners, &Aabb { min: DVec3::splat(5.0), max: DVec3::splat(6.0) }).len() < 3);
        assert_eq!(clipped(corners, &Aabb { min: DVec3::splat(-1.0), max: DVec3::splat(6.0) }).len(), 3);
    }
}
