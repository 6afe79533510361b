//! The original mesh, in the tileset's frame, cut to a tile's part of it.

use std::path::PathBuf;

use glam::DVec3;
use serde::Serialize;

use super::cover::Shown;
use super::read::Tileset;
use crate::geo::bvh::Bvh;
use crate::geo::{Aabb, Frame, Georeference};
use crate::input::{self, InputConfig, Source};
use crate::measure::Surface;
use crate::mesh::{GateConfig, Mesh, gate};
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

/// The original, ready to be cut.
pub struct Original {
    mesh: Mesh,
    bvh: Bvh,
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
    /// Triangles behind the gate.
    pub triangles: usize,
    /// From the middle of the finest tiles' box to that of the original's, metres.
    pub shift_m: [f64; 3],
    /// Of the finest tiles' box, metres.
    pub diagonal_m: f64,
}

/// Boxes whose middles are this far apart are not those of one model, metres; or this share of the diagonal.
const SHIFT_M: f64 = 0.5;
const SHIFT_REL: f64 = 0.005;

/// Nothing is beyond, metres.
const FAR: DVec3 = DVec3::splat(1e9);

impl Original {
    /// Reads the original and brings it into the frame of `tileset`, whose finest tiles lie in `box_local`.
    ///
    /// Warns `source-shifted` where the two do not lie over each other.
    ///
    /// # Errors
    /// Those of the readers and the gate; a place on the Earth that is not the tileset's.
    pub fn read(config: &OriginalConfig, tileset: &Tileset, box_local: Aabb, reporter: &Reporter) -> Result<Self> {
        let (mut source, found) = input::read(&config.inputs, &InputConfig::default(), reporter)?;
        let georeference = match (&config.georeference, &found.metadata_xml, &found.odm_coords) {
            (Some(georeference), _, _) => georeference.clone(),
            (None, Some(path), _) => input::georeference::read_metadata_xml(path)?,
            (None, None, Some(path)) => input::georeference::read_odm(path)?,
            (None, None, None) => Georeference::Local,
        };
        let how = place(&mut source, georeference, tileset, box_local)?;
        let (mesh, _) = gate(source, &GateConfig::default(), reporter)?;
        let bounds = Aabb::of(mesh.positions.iter().copied());
        let shift = bounds.center() - box_local.center();
        let diagonal_m = box_local.size().length();
        let placed = Placed { how, triangles: mesh.faces.len(), shift_m: shift.to_array(), diagonal_m };
        if shift.length() > SHIFT_M.max(SHIFT_REL * diagonal_m) {
            let what = format!(
                "the original's middle is {:.2} m from that of the finest tiles (east {:.2}, north {:.2}, up {:.2}); \
                 check its coordinates before you believe a distance",
                shift.length(),
                shift.x,
                shift.y,
                shift.z
            );
            let path = config.inputs.first().cloned().unwrap_or_default();
            reporter.warn("source-shifted", &path, what);
        }
        let bvh = Bvh::new(&mesh.positions, &mesh.faces);
        Ok(Self { mesh, bvh, is_stacked: is_stacked(tileset), placed })
    }

    /// Faces whose boxes touch `aabb`.
    pub fn count(&self, aabb: Aabb) -> usize {
        let within = self.within(aabb);
        let mut count = 0;
        self.bvh.overlapping(within.min.max(-FAR), within.max.min(FAR), &mut |_| count += 1);
        count
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
        let mut faces = Vec::new();
        self.bvh.overlapping(within.min.max(-FAR), within.max.min(FAR), &mut |f| faces.push(f));
        faces.sort_unstable();
        let mut surface = Surface::default();
        let mut aabb = Aabb::EMPTY;
        for f in faces {
            let polygon = clipped(self.mesh.corners(f as usize), &within);
            let base = surface.positions.len() as u32;
            for k in 2..polygon.len() as u32 {
                surface.faces.push([base, base + k - 1, base + k]);
            }
            if polygon.len() >= 3 {
                polygon.iter().for_each(|&p| aabb.extend(p));
                surface.positions.extend(polygon);
            }
        }
        Shown { surface, aabb, refused: None }
    }
}

/// Brings positions into the tileset's frame, and says how.
fn place(source: &mut Source, georeference: Georeference, tileset: &Tileset, box_local: Aabb) -> Result<&'static str> {
    let corners = source.parts.iter().flat_map(|p| p.faces.iter().flatten().map(|&v| p.positions[v as usize]));
    let bounds = Aabb::of(corners.filter(|p| p.is_finite()));
    let path = source.parts.first().map(|p| p.path.clone()).unwrap_or_default();
    if bounds.is_empty() {
        return Err(Error::input(path, "has no surface to compare with"));
    }
    if let Georeference::Local = georeference {
        // Builds without a place on the Earth put the middle at (0, 0): take what lies nearer.
        let anchor = bounds.center().with_z(bounds.min.z).round();
        let off = |by: DVec3| (bounds.center() - by - box_local.center()).length();
        let (by, how) = if off(anchor) < off(DVec3::ZERO) { (anchor, "centred") } else { (DVec3::ZERO, "same") };
        source.parts.iter_mut().flat_map(|p| &mut p.positions).for_each(|p| *p -= by);
        return Ok(how);
    }
    let frame = Frame::of(georeference, bounds.center().with_z(bounds.min.z).round())?;
    let Some(ecef_from_source_local) = frame.ecef_from_local().filter(|_| tileset.frame.origin.is_some()) else {
        let what = "the original has a place on the Earth and the tileset has none; give --source-crs local";
        return Err(Error::input(path, what));
    };
    let local_from_source_local = tileset.frame.local_from_root * ecef_from_source_local;
    for part in &mut source.parts {
        frame.locals_from_sources(&part.path, &mut part.positions)?;
        part.positions.iter_mut().for_each(|p| *p = local_from_source_local.transform_point3(*p));
    }
    Ok("globe")
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
