//! The dataset's own east-north-up frame, and the way into it from source coordinates and out of it to the Earth.
//!
//! In: a [`Georeference`] and an anchor. Out: [`Frame`].
//!
//! # Method
//! 1. The origin of `local` is the anchor itself: its longitude and latitude, and its height above the ellipsoid.
//! 2. A projected vertex goes to longitude and latitude (height untouched), to ECEF, and into the tangent frame.
//! 3. ENU and Earth-centred sources differ from `local` by one rigid motion; local ones by a translation.
//!
//! # Numbers
//! - heights: `(z + origin.z) * unit of height + offset`, see [`Crs::height_unit_m`];
//! - `SCALE_WARNED` 1 %: a metre of the grid may differ from a metre on the ground by that much before it is doubted.
//!
//! # Promises
//! - Absolute and relative positions agree with PROJ 9.5 within 2 cm (`positions_agree_with_proj`).
//! - The same points come out for any number of threads; of several bad points the first is named.
//!
//! # Limits
//! Scaling is the projection's only: a mesh whose heights are orthometric is not bent along the geoid.
//!
//! # Cost
//! 1.8 million points a second on one core, measured on a million points in UTM, Lambert and shifted Gauss-Krueger.

use std::fmt;
use std::path::Path;

use glam::{DMat3, DMat4, DVec3};
use rayon::prelude::*;
use serde::Serialize;

use super::crs::{Crs, Kind, shortened};
use super::ellipsoid::{self, Geodetic};
pub use super::georeference::{Georeference, Vertical};
use crate::report::Reporter;
use crate::{Error, Result};

/// Points a task moves at once. Fixed, so that results cannot depend on the number of threads.
const CHUNK: usize = 4096;
/// Grid metre against ground metre: beyond this the position is doubted. Country-wide conic systems reach 0.5 %.
const SCALE_WARNED: f64 = 0.01;
/// Beyond this factor either way the position is refused; no survey grid is used there.
const SCALE_REFUSED: f64 = 1.2;
/// There and back must meet again to this, metres.
const ROUND_TRIP_M: f64 = 0.01;
/// Half the step of the differences that measure convergence and scale, metres.
const STEP_M: f64 = 10.0;

/// The ways between source, local and ECEF coordinates of one dataset.
#[derive(Debug, Clone)]
pub struct Frame {
    georeference: Georeference,
    anchor: DVec3,
    earth: Option<Earth>,
    /// How ENU and Earth-centred sources lie in `local`.
    rigid: Rigid,
    grid: Option<Grid>,
}

/// Where `local` is on the Earth.
#[derive(Debug, Clone, Copy)]
struct Earth {
    origin: Geodetic,
    origin_ecef: DVec3,
    /// Columns east, north, up.
    axes: DMat3,
}

/// `local = turn * (source + before) + after`; the two steps keep large coordinates out of the product.
#[derive(Debug, Clone, Copy)]
struct Rigid {
    before: DVec3,
    turn: DMat3,
    after: DVec3,
}

/// How a projection lies at the anchor.
#[derive(Debug, Clone, Copy)]
struct Grid {
    convergence_deg: f64,
    scale: f64,
}

impl Earth {
    fn at(origin: Geodetic) -> Self {
        let origin_ecef = ellipsoid::ecef_from_geodetic(origin);
        Self { origin, origin_ecef, axes: ellipsoid::enu_basis(origin) }
    }

    fn local_from_ecef(&self, ecef: DVec3) -> DVec3 {
        self.axes.transpose() * (ecef - self.origin_ecef)
    }

    fn ecef_from_local(&self, local: DVec3) -> DVec3 {
        self.axes * local + self.origin_ecef
    }
}

impl Frame {
    /// The frame about `anchor`, a point in source coordinates such as the middle of the model's bounding box.
    ///
    /// # Errors
    /// [`Error::Config`] when the georeference is nonsense or puts the anchor where its system does not reach.
    pub fn of(georeference: Georeference, anchor: DVec3) -> Result<Self> {
        if !anchor.is_finite() {
            return Err(Error::Config(format!("the model's middle is not finite: {anchor}")));
        }
        georeference.check()?;
        let still = Rigid { before: -anchor, turn: DMat3::IDENTITY, after: DVec3::ZERO };
        let mut frame = Self { georeference, anchor, earth: None, rigid: still, grid: None };
        match frame.georeference.clone() {
            Georeference::Local => {}
            Georeference::Enu { lat_deg, lon_deg, height_m, offset } => {
                let place = Earth::at(Geodetic::from_degrees(lon_deg, lat_deg, height_m));
                let earth = Earth::at(ellipsoid::geodetic_from_ecef(place.ecef_from_local(anchor + offset)));
                frame.rigid = Rigid {
                    before: offset,
                    turn: earth.axes.transpose() * place.axes,
                    after: earth.local_from_ecef(place.origin_ecef),
                };
                frame.earth = Some(earth);
            }
            Georeference::Geocentric { origin } => {
                let earth = Earth::at(ellipsoid::geodetic_from_ecef(anchor + origin));
                check_geocentric(&earth, anchor + origin)?;
                frame.rigid =
                    Rigid { before: origin - earth.origin_ecef, turn: earth.axes.transpose(), after: DVec3::ZERO };
                frame.earth = Some(earth);
            }
            Georeference::Projected { crs, origin, vertical } => {
                let projected = Projected { crs: &crs, origin, offset_m: vertical.offset_m() };
                let geodetic = projected.geodetic(anchor).ok_or_else(|| projected.misplaced(anchor))?;
                frame.earth = Some(Earth::at(geodetic));
                frame.grid = projected.grid(anchor)?;
                let back = frame.source_from_local(DVec3::ZERO).ok_or_else(|| projected.misplaced(anchor))?;
                let again = projected.geodetic(back).ok_or_else(|| projected.misplaced(anchor))?;
                let gap_m = (ellipsoid::ecef_from_geodetic(again) - ellipsoid::ecef_from_geodetic(geodetic)).length();
                // Written so that a NaN is refused too.
                if !matches!(gap_m.partial_cmp(&ROUND_TRIP_M), Some(std::cmp::Ordering::Less)) {
                    return Err(projected.misplaced(anchor));
                }
            }
        }
        Ok(frame)
    }

    /// What the frame was built from.
    pub fn georeference(&self) -> &Georeference {
        &self.georeference
    }

    /// Local metres of a vertex; none where the projection does not reach.
    pub fn local_from_source(&self, source: DVec3) -> Option<DVec3> {
        let mut point = [source];
        self.move_chunk(&mut point).then_some(point[0])
    }

    /// Turns source into local coordinates in place, in parallel.
    ///
    /// # Errors
    /// [`Error::Input`] naming `path` and the first vertex that has no place; the points are then in no defined state.
    pub fn locals_from_sources(&self, path: &Path, points: &mut [DVec3]) -> Result<()> {
        let first_bad = points
            .par_chunks_mut(CHUNK)
            .enumerate()
            .filter_map(|(chunk, points)| {
                let sources = points.to_vec();
                if self.move_chunk(points) {
                    return None;
                }
                let bad = sources.iter().position(|source| self.local_from_source(*source).is_none())?;
                Some((chunk * CHUNK + bad, sources[bad]))
            })
            .min_by_key(|(index, _)| *index);
        match first_bad {
            None => Ok(()),
            Some((index, source)) => Err(Error::input(path, self.lost(index, source))),
        }
    }

    /// The source coordinates of a local point; none where the projection does not reach.
    pub fn source_from_local(&self, local: DVec3) -> Option<DVec3> {
        let source = match (&self.georeference, &self.earth) {
            (Georeference::Projected { crs, origin, vertical }, Some(earth)) => {
                let place = ellipsoid::geodetic_from_ecef(earth.ecef_from_local(local));
                let (x, y) = crs.xy_of_lon_lat(place.lon_rad, place.lat_rad, place.height_m)?;
                DVec3::new(x, y, (place.height_m - vertical.offset_m()) / crs.height_unit_m()) - *origin
            }
            _ => self.rigid.turn.transpose() * (local - self.rigid.after) - self.rigid.before,
        };
        source.is_finite().then_some(source)
    }

    /// The rigid transform from local to ECEF, fit for a tileset's root; none for local systems.
    pub fn ecef_from_local(&self) -> Option<DMat4> {
        self.earth.map(|earth| ellipsoid::ecef_from_enu(earth.origin))
    }

    /// The place of a local point; none for local systems.
    pub fn geodetic_from_local(&self, local: DVec3) -> Option<Geodetic> {
        self.earth.map(|earth| ellipsoid::geodetic_from_ecef(earth.ecef_from_local(local)))
    }

    /// The frame in a few numbers.
    pub fn describe(&self) -> FrameSummary {
        let origin = self.earth.map(|earth| earth.origin);
        let (kind, crs) = match &self.georeference {
            Georeference::Local => ("local", None),
            Georeference::Enu { .. } => ("enu", None),
            Georeference::Geocentric { .. } => ("geocentric", None),
            Georeference::Projected { crs, .. } if crs.kind() == Kind::Geographic => ("geographic", Some(crs)),
            Georeference::Projected { crs, .. } => ("projected", Some(crs)),
        };
        FrameSummary {
            kind,
            crs: crs.map(Crs::to_string),
            epsg: crs.and_then(Crs::epsg),
            towgs84: crs.and_then(Crs::towgs84).map(str::to_owned),
            origin_source: self.anchor,
            origin_lon_deg: origin.map(|o| o.lon_rad.to_degrees()),
            origin_lat_deg: origin.map(|o| o.lat_rad.to_degrees()),
            origin_height_m: origin.map(|o| o.height_m),
            convergence_deg: self.grid.map(|g| g.convergence_deg),
            scale: self.grid.map(|g| g.scale),
        }
    }

    /// Tells what was assumed or looks odd: `vertical-datum`, `datum-shift`, `crs-area`.
    pub fn warn(&self, reporter: &Reporter, path: &Path) {
        self.georeference.warn(reporter, path);
        let (Georeference::Projected { crs, origin, vertical }, Some(grid)) = (&self.georeference, self.grid) else {
            return;
        };
        let projected = Projected { crs, origin: *origin, offset_m: vertical.offset_m() };
        if !crs.is_world_map() && (grid.scale - 1.0).abs() > SCALE_WARNED {
            let (scale, hint) = (grid.scale, projected.hint(self.anchor));
            let (place, crs) = (projected.absolute(self.anchor), shortened(&crs.to_string()));
            reporter.warn(
                "crs-area",
                path,
                format!("{place} is far outside the area {crs} is made for (its scale there is {scale:.4}){hint}"),
            );
        } else if projected.is_near_zero(self.anchor) {
            reporter.warn(
                "crs-area",
                path,
                format!(
                    "the model lies at the zero point of {}; its origin seems to be missing, give --origin",
                    shortened(&crs.to_string())
                ),
            );
        }
    }

    fn move_chunk(&self, points: &mut [DVec3]) -> bool {
        if let (Georeference::Projected { crs, origin, vertical }, Some(earth)) = (&self.georeference, &self.earth) {
            let projected = Projected { crs, origin: *origin, offset_m: vertical.offset_m() };
            return projected.locals(earth, points);
        }
        let Rigid { before, turn, after } = self.rigid;
        for point in points.iter_mut() {
            *point = turn * (*point + before) + after;
        }
        points.iter().all(|point| point.is_finite())
    }

    fn lost(&self, index: usize, source: DVec3) -> String {
        let Georeference::Projected { crs, origin, vertical } = &self.georeference else {
            return format!("vertex {} at {source} is not finite", index + 1);
        };
        let projected = Projected { crs, origin: *origin, offset_m: vertical.offset_m() };
        format!(
            "vertex {} at {source} becomes {}, which lies outside {}; is the origin inside the area of that system?{}",
            index + 1,
            projected.absolute(source),
            shortened(&crs.to_string()),
            projected.hint(source)
        )
    }
}

fn check_geocentric(earth: &Earth, ecef: DVec3) -> Result<()> {
    /// Deeper and higher than anything photographed, metres.
    const NEAR_M: f64 = 100_000.0;
    if earth.origin.height_m.abs() <= NEAR_M {
        return Ok(());
    }
    Err(Error::Config(format!(
        "Earth-centred coordinates were expected, but {ecef} is {:.0} km off the ellipsoid; is the origin missing, or \
         are these local coordinates?",
        earth.origin.height_m / 1000.0
    )))
}

/// A projected georeference with its parts at hand.
struct Projected<'a> {
    crs: &'a Crs,
    origin: DVec3,
    offset_m: f64,
}

impl Projected<'_> {
    fn absolute(&self, source: DVec3) -> DVec3 {
        source + self.origin
    }

    fn height_m(&self, source: DVec3) -> f64 {
        (source.z + self.origin.z) * self.crs.height_unit_m() + self.offset_m
    }

    fn locals(&self, earth: &Earth, points: &mut [DVec3]) -> bool {
        let heights_m: Vec<f64> = points.iter().map(|point| self.height_m(*point)).collect();
        let mut moved: Vec<(f64, f64, f64)> = points
            .iter()
            .zip(&heights_m)
            .map(|(point, height_m)| (point.x + self.origin.x, point.y + self.origin.y, *height_m))
            .collect();
        if !self.crs.to_lon_lat(&mut moved, &heights_m) {
            return false;
        }
        let mut sound = true;
        for (point, (lon_rad, lat_rad, height_m)) in points.iter_mut().zip(moved) {
            let place = Geodetic { lon_rad, lat_rad, height_m };
            *point = earth.local_from_ecef(ellipsoid::ecef_from_geodetic(place));
            sound &= point.is_finite();
        }
        sound
    }

    fn geodetic(&self, source: DVec3) -> Option<Geodetic> {
        let at = self.absolute(source);
        self.geodetic_at(at.x, at.y, self.height_m(source))
    }

    fn geodetic_at(&self, x: f64, y: f64, height_m: f64) -> Option<Geodetic> {
        let degrees_fit = self.crs.kind() != Kind::Geographic || (x.abs() <= 360.0 && y.abs() <= 90.0);
        let mut point = [(x, y, height_m)];
        if !degrees_fit || !self.crs.to_lon_lat(&mut point, &[height_m]) {
            return None;
        }
        let (lon_rad, lat_rad, height_m) = point[0];
        height_m.is_finite().then_some(Geodetic { lon_rad, lat_rad, height_m })
    }

    /// Convergence and scale at the anchor; none for geographic systems.
    fn grid(&self, anchor: DVec3) -> Result<Option<Grid>> {
        if self.crs.kind() == Kind::Geographic {
            return Ok(None);
        }
        let at = self.absolute(anchor);
        let [east, north] = self.grid_axes(at.x, at.y).ok_or_else(|| self.misplaced(anchor))?;
        if east.cross(north).z < 0.0 {
            return Err(Error::Config(format!(
                "{}: its axes make a mirrored model (x runs south, y west); export the model with easting and northing \
                 and name the system whose axes those are",
                shortened(&self.crs.to_string())
            )));
        }
        let scale = 2.0 * STEP_M / north.length();
        if !self.crs.is_world_map() && !(1.0 / SCALE_REFUSED..=SCALE_REFUSED).contains(&scale) {
            return Err(self.misplaced(anchor));
        }
        Ok(Some(Grid { convergence_deg: north.x.atan2(north.y).to_degrees(), scale }))
    }

    /// What twice the step along x and along y is on the ellipsoid, metres east and north.
    fn grid_axes(&self, x: f64, y: f64) -> Option<[DVec3; 2]> {
        let step = STEP_M / self.crs.unit_m();
        let middle = Earth::at(self.geodetic_at(x, y, 0.0)?);
        let at = |dx: f64, dy: f64| {
            let place = self.geodetic_at(x + dx * step, y + dy * step, 0.0)?;
            Some(middle.local_from_ecef(ellipsoid::ecef_from_geodetic(place)))
        };
        let axes = [at(1.0, 0.0)? - at(-1.0, 0.0)?, at(0.0, 1.0)? - at(0.0, -1.0)?];
        axes.iter().all(|axis| axis.is_finite()).then_some(axes)
    }

    fn misplaced(&self, source: DVec3) -> Error {
        Error::Config(format!(
            "{}: the model's middle {source} becomes {}, where that system does not reach; is the origin in this \
             system?{}",
            shortened(&self.crs.to_string()),
            self.absolute(source),
            self.hint(source)
        ))
    }

    /// The likely mistake, as a clause to append.
    fn hint(&self, source: DVec3) -> String {
        let DVec3 { x, y, .. } = self.absolute(source);
        if self.crs.kind() == Kind::Geographic {
            let swapped = x.abs() <= 90.0 && y.abs() <= 180.0;
            return if swapped { "; longitude comes first, x and y look swapped" } else { "; wanted degrees" }.into();
        }
        if x.abs() <= 180.0 && y.abs() <= 180.0 {
            return "; these look like degrees, wanted easting and northing".into();
        }
        let unit_m = 2.0 * STEP_M;
        let fits = |x, y| {
            let axes = self.grid_axes(x, y);
            axes.is_some_and(|[_, north]| (unit_m / north.length() - 1.0).abs() < SCALE_WARNED)
        };
        if !fits(x, y) && fits(y, x) { "; with x and y swapped it would fit (easting comes first)" } else { "" }.into()
    }

    /// True at the zero point of a grid whose area lies far from it.
    fn is_near_zero(&self, source: DVec3) -> bool {
        /// Nearer than any survey to a zero point that was put out of the way on purpose, metres.
        const NEAR_M: f64 = 10_000.0;
        let at = self.absolute(source) * self.crs.unit_m();
        self.crs.false_easting_m().abs() > 10.0 * NEAR_M && at.x.abs() < NEAR_M && at.y.abs() < NEAR_M
    }
}

/// The frame in a few numbers, for reports and `build.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameSummary {
    /// `local`, `enu`, `geocentric`, `geographic` or `projected`.
    pub kind: &'static str,
    /// The system as text that can be read back.
    pub crs: Option<String>,
    /// Its EPSG code where known.
    pub epsg: Option<u32>,
    /// The datum shift applied, if any (see [`Crs::towgs84`]).
    pub towgs84: Option<String>,
    /// The local origin in source coordinates.
    pub origin_source: DVec3,
    /// Longitude of the local origin, degrees.
    pub origin_lon_deg: Option<f64>,
    /// Geodetic latitude of the local origin, degrees.
    pub origin_lat_deg: Option<f64>,
    /// Its height above the ellipsoid, metres.
    pub origin_height_m: Option<f64>,
    /// Grid north from true north at the origin, positive to the east, degrees.
    pub convergence_deg: Option<f64>,
    /// Grid metres per metre on the ellipsoid at the origin, along grid north.
    pub scale: Option<f64>,
}

impl fmt::Display for FrameSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.kind)?;
        if let Some(crs) = &self.crs {
            write!(f, " {}", shortened(crs))?;
        }
        if let (Some(lon), Some(lat), Some(height)) = (self.origin_lon_deg, self.origin_lat_deg, self.origin_height_m) {
            write!(f, " at lon {lon:.7} lat {lat:.7} height {height:.2} m")?;
        }
        if let (Some(convergence), Some(scale)) = (self.convergence_deg, self.scale) {
            write!(f, ", convergence {convergence:.4}°, scale {scale:.6}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "frame_tests.rs"]
mod tests;
