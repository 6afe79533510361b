//! Coordinate reference systems: from a code, WKT, a proj string or ODM's shorthand to a horizontal transform.
//!
//! In: text. Out: [`Crs`], which turns easting and northing into WGS 84 longitude and latitude and leaves heights alone.
//!
//! # Method
//! 1. Find the definition: `crs-definitions` by EPSG code, or WKT's own parameters, or the proj string as given.
//! 2. Keep only parameters that are understood; settle units, vertical unit and datum shift here.
//! 3. Hand the rest to proj4rs.
//!
//! # Promises
//! - No file is ever opened: grid shifts named by a text (`+nadgrids`) are left out and reported.
//! - Heights are in the vertical system's unit, else in the projection's linear unit, else in metres.
//!
//! # Limits
//! Shifts to WGS 84 are Helmert's, mostly from crs-definitions: good to 1 to 5 m for most systems in use, a mean over a
//! continent for some old ones. Where only a grid shift is published (NAD27) or none at all, positions as a whole are
//! off by metres to hundreds of metres; [`Crs::datum_doubt`] says so. A wrong shift also stretches and turns by some
//! 10 ppm, 1 cm over a kilometre.

use std::fmt;
use std::sync::Arc;

use proj4rs::Proj;
use proj4rs::transform::transform;
use serde::{Deserialize, Serialize};

use super::wkt;
use crate::{Error, Result};

/// International foot, metres (exact).
const FOOT_M: f64 = 0.3048;
/// US survey foot, metres (exact ratio).
const US_FOOT_M: f64 = 1200.0 / 3937.0;
/// British foot (1936), metres.
const BRITISH_FOOT_M: f64 = 0.304_800_749_1;

/// EPSG's upward vertical systems that are not in metres, as listed by PROJ 9.5.
const VERTICAL_UNITS_M: [(u32, f64); 9] = [
    (5702, US_FOOT_M),
    (5754, BRITISH_FOOT_M),
    (6130, FOOT_M),
    (6131, FOOT_M),
    (6132, FOOT_M),
    (6360, US_FOOT_M),
    (8050, FOOT_M),
    (8052, US_FOOT_M),
    (8228, FOOT_M),
];

/// Shifts that crs-definitions 0.6 lacks or has with a wrong sign, found by comparing it with PROJ 9.5 datum by datum;
/// proj's position-vector convention, metres, arc seconds and parts per million.
const MENDED_SHIFTS: [(&[u32], &str); 5] = [
    // S-JTSK (EPSG:5239): the three parameters there are 10 m off and ignore a turn of 36 ppm.
    (&[2065, 4156, 4818, 5221, 5513, 5514], "572.213,85.334,461.94,4.9732,1.529,5.2484,3.5378"),
    // Stereo70 of Romania: the rotations there are turned the wrong way, 38 m.
    (&[3844], "2.329,-147.042,-92.08,-0.309,0.325,0.497,5.69"),
    // Israel 1993 and Israeli Grid 05/12: 10 m, and 78 m without any shift.
    (&[2039, 4141, 6990, 6991], "23.772,17.49,17.859,-0.3132,-1.85274,1.67299,-5.4262"),
    // German railways' DB_REF: no shift there, 217 m.
    (&[5681, 5682, 5683, 5684, 5685], "584.9636,107.7175,413.8067,1.1155,0.2824,-3.1384,7.9922"),
    // Fatu Iva 72: wrong way round, 4.7 km.
    (&[3303, 4688], "347.175,1077.618,2623.677,33.9058,-70.6776,9.4013,186.0647"),
];

/// Parameters that define a projection and are passed on.
const KEPT: [&str; 33] = [
    "proj", "lat_0", "lat_1", "lat_2", "lat_ts", "lon_0", "lonc", "alpha", "gamma", "k", "k_0", "x_0", "y_0", "zone",
    "south", "ellps", "datum", "a", "b", "rf", "R", "towgs84", "pm", "units", "to_meter", "axis", "no_uoff", "no_off",
    "approx", "azi", "guam", "over", "algo",
];
/// Parameters that say nothing about the horizontal position.
const DROPPED: [&str; 7] = ["no_defs", "type", "wktext", "geoidgrids", "vunits", "vto_meter", "geoid_crs"];

/// What the numbers of a system are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// x east and y north in a linear unit, z up.
    Projected,
    /// x longitude and y latitude in degrees, z up.
    Geographic,
    /// Earth-centred metres.
    Geocentric,
}

/// A coordinate reference system, ready to transform.
#[derive(Clone, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct Crs {
    name: String,
    epsg: Option<u32>,
    vertical: Option<String>,
    kind: Kind,
    unit_m: f64,
    height_unit_m: f64,
    engine: Arc<Engine>,
}

/// The two ends of the horizontal transform, and how far it can be trusted.
struct Engine {
    system: Proj,
    wgs84: Proj,
    towgs84: Option<String>,
    datum_doubt: Option<&'static str>,
}

impl fmt::Debug for Crs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Crs").field("name", &self.name).field("kind", &self.kind).finish_non_exhaustive()
    }
}

impl PartialEq for Crs {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl fmt::Display for Crs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

impl From<Crs> for String {
    fn from(crs: Crs) -> Self {
        crs.name
    }
}

impl TryFrom<String> for Crs {
    type Error = Error;
    fn try_from(text: String) -> Result<Self> {
        Self::parse(&text)
    }
}

impl Crs {
    /// Reads `EPSG:n`, `EPSG:n+m`, WKT 1 or 2, a proj string, or ODM's `WGS84 UTM 32N`.
    ///
    /// # Errors
    /// [`Error::Config`] naming the text and what would be understood.
    pub fn parse(text: &str) -> Result<Self> {
        let text = text.trim().trim_start_matches('\u{feff}').trim();
        if let Some(codes) = strip_prefix_ignore_case(text, "EPSG:") {
            return Self::parse_codes(text, codes.trim());
        }
        if text.starts_with('+') || text.starts_with("proj=") {
            return Self::from_proj_string(text);
        }
        if let Some(code) = utm_code(text) {
            return Self::from_epsg(code, None);
        }
        if text.contains(['[', '(']) {
            return wkt::parse(text);
        }
        Err(Error::Config(format!(
            "'{}' is not a coordinate system that is understood; wanted EPSG:n, EPSG:n+m, WKT, a proj string \
             (+proj=…), ENU:lat,lon or local",
            shortened(text)
        )))
    }

    fn parse_codes(text: &str, codes: &str) -> Result<Self> {
        let wrong = || Error::Config(format!("'{}': wanted EPSG:n or EPSG:n+m with whole numbers", shortened(text)));
        let code = |part: &str| {
            let part = part.trim();
            let digits = strip_prefix_ignore_case(part, "EPSG:").unwrap_or(part);
            digits.parse::<u32>().map_err(|_| wrong())
        };
        match codes.split_once('+') {
            Some((horizontal, vertical)) => Self::from_epsg(code(horizontal)?, Some(code(vertical)?)),
            None => Self::from_epsg(code(codes)?, None),
        }
    }

    /// The system of an EPSG code, with the vertical system `vertical` where the text named one.
    ///
    /// # Errors
    /// [`Error::Config`] for an unknown code, or one whose projection is not implemented.
    pub fn from_epsg(code: u32, vertical: Option<u32>) -> Result<Self> {
        let unknown = || {
            Error::Config(format!(
                "EPSG:{code} is not a horizontal system known here; give it as WKT or a proj string (+proj=…) instead"
            ))
        };
        let definition = u16::try_from(code).ok().and_then(crs_definitions::from_code).ok_or_else(unknown)?;
        let proj = proj_of(code).filter(|proj| !proj.is_empty()).ok_or_else(unknown)?;
        let own_vertical = wkt::vertical_of(definition.wkt);
        if let (Some(_), Some(other)) = (&own_vertical, vertical) {
            return Err(Error::Config(format!(
                "EPSG:{code}+{other}: EPSG:{code} already holds a vertical system; give EPSG:{code} alone"
            )));
        }
        let mut crs = Self::build(&proj, format!("EPSG:{code}"), Some(code))?;
        if let Some(own) = own_vertical {
            crs.vertical = own.name;
        } else if let Some(vertical) = vertical {
            crs.set_vertical(vertical)?;
        }
        Ok(crs)
    }

    /// The system of a proj string (`+proj=…`, or `+init=epsg:n`).
    ///
    /// # Errors
    /// [`Error::Config`] for parameters that are not understood or do not make a projection.
    pub fn from_proj_string(text: &str) -> Result<Self> {
        for token in text.split_whitespace() {
            let token = token.trim_start_matches('+');
            if let Some(code) = token.strip_prefix("init=").and_then(|v| strip_prefix_ignore_case(v, "epsg:")) {
                return Self::parse_codes(text, code);
            }
        }
        let name = text.split_whitespace().collect::<Vec<_>>().join(" ");
        Self::build(text, name, None)
    }

    /// Builds from a definition; `name` is what [`Crs::parse`] reads back.
    pub(super) fn build(definition: &str, name: String, epsg: Option<u32>) -> Result<Self> {
        let refuse = |why: String| Error::Config(format!("coordinate system '{}': {why}", shortened(&name)));
        let parts = Parts::of(definition).map_err(&refuse)?;
        let system = Proj::from_proj_string(&parts.kept)
            .map_err(|why| refuse(format!("the projection is not supported ({why}); reproject the model")))?;
        let wgs84 = Proj::from_proj_string("+proj=longlat +datum=WGS84")
            .map_err(|why| Error::Bug(format!("WGS 84 cannot be set up: {why}")))?;
        let kind = match (system.is_latlong(), system.is_geocent()) {
            (true, _) => Kind::Geographic,
            (_, true) => Kind::Geocentric,
            _ => Kind::Projected,
        };
        if kind == Kind::Geocentric && (parts.towgs84.is_some() || parts.doubt.is_some()) {
            return Err(refuse("only WGS 84 and its kin are read as Earth-centred; use EPSG:4978".into()));
        }
        let unit_m = if kind == Kind::Projected { system.to_meter() } else { 1.0 };
        let height_unit_m = parts.height_unit_m.unwrap_or(unit_m);
        if !(unit_m.is_normal() && unit_m > 0.0 && height_unit_m.is_normal() && height_unit_m > 0.0) {
            return Err(refuse(format!("found units of {unit_m} and {height_unit_m} metres, wanted positive ones")));
        }
        Ok(Self {
            name,
            epsg,
            vertical: None,
            kind,
            unit_m,
            height_unit_m,
            engine: Arc::new(Engine { system, wgs84, towgs84: parts.towgs84, datum_doubt: parts.doubt }),
        })
    }

    /// Adds the vertical system of a compound and with it the heights' unit.
    pub(super) fn set_vertical(&mut self, code: u32) -> Result<()> {
        if self.kind == Kind::Geocentric {
            return Err(Error::Config(format!("{}+{code}: an Earth-centred system has no heights", self.name)));
        }
        let unit = VERTICAL_UNITS_M.iter().find(|(listed, _)| *listed == code);
        self.height_unit_m = unit.map_or(1.0, |(_, unit_m)| *unit_m);
        self.vertical = Some(format!("EPSG:{code}"));
        self.name = format!("{}+{code}", self.name);
        Ok(())
    }

    /// Adds what a WKT says of itself: its vertical system, and its text as the name unless codes say it all.
    pub(super) fn with_wkt(mut self, text: &str, vertical: Option<wkt::Vertical>) -> Result<Self> {
        let coded = self.name.starts_with("EPSG:");
        match vertical {
            None if coded => return Ok(self),
            Some(wkt::Vertical { name: Some(name), .. }) if coded && name.starts_with("EPSG:") => {
                self.set_vertical(name["EPSG:".len()..].parse().unwrap_or_default())?;
                return Ok(self);
            }
            Some(vertical) => {
                self.height_unit_m = vertical.unit_m.unwrap_or(self.height_unit_m);
                self.vertical = vertical.name;
            }
            None => {}
        }
        self.name = text.split_whitespace().collect::<Vec<_>>().join(" ");
        Ok(self)
    }

    /// EPSG code of the horizontal (or whole) system, where known.
    pub fn epsg(&self) -> Option<u32> {
        self.epsg
    }

    /// The orthometric vertical system of a compound, by code or name.
    pub fn vertical(&self) -> Option<&str> {
        self.vertical.as_deref()
    }

    /// What the numbers are.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// Metres in one unit of easting; 1 for geographic systems, whose unit is the degree.
    pub fn unit_m(&self) -> f64 {
        self.unit_m
    }

    /// Metres in one unit of height.
    pub fn height_unit_m(&self) -> f64 {
        self.height_unit_m
    }

    /// The shift to WGS 84 that is applied, as proj writes it; none for WGS 84's kin and for proj's named datums.
    pub fn towgs84(&self) -> Option<&str> {
        self.engine.towgs84.as_deref()
    }

    /// Why the shift to WGS 84 is not to be trusted, if so.
    pub fn datum_doubt(&self) -> Option<&'static str> {
        self.engine.datum_doubt
    }

    /// True for maps of the whole world, whose scale is far from one over most of it without anything being wrong.
    pub fn is_world_map(&self) -> bool {
        let name = self.engine.system.projname();
        matches!(name, "merc" | "webmerc" | "eqc" | "cea" | "mill" | "sinu" | "moll" | "robin" | "eqearth")
    }

    /// Easting of the central meridian, metres.
    pub(super) fn false_easting_m(&self) -> f64 {
        self.engine.system.false_easting()
    }

    /// Takes points (x, y in source units, height in metres) to (longitude, latitude in radians, untouched height).
    ///
    /// A datum shift moves heights too; that height is of no use (it belongs to no vertical system) and is dropped, as
    /// PROJ does for two-dimensional systems. False when any point failed; the points are then in no defined state.
    pub(super) fn to_lon_lat(&self, points: &mut [(f64, f64, f64)], heights_m: &[f64]) -> bool {
        self.scale_degrees(points);
        if transform(&self.engine.system, &self.engine.wgs84, points).is_err() {
            return false;
        }
        let mut sound = true;
        for (point, height_m) in points.iter_mut().zip(heights_m) {
            point.2 = *height_m;
            sound &= point.0.is_finite() && point.1.abs() <= std::f64::consts::FRAC_PI_2;
        }
        sound
    }

    fn scale_degrees(&self, points: &mut [(f64, f64, f64)]) {
        if self.kind == Kind::Geographic {
            for point in points {
                (point.0, point.1) = (point.0.to_radians(), point.1.to_radians());
            }
        }
    }

    /// The source x, y of a longitude and latitude (radians) at a height; the inverse of [`Crs::to_lon_lat`].
    pub(super) fn xy_of_lon_lat(&self, lon_rad: f64, lat_rad: f64, height_m: f64) -> Option<(f64, f64)> {
        // The way back is not the exact inverse of a datum shift: it linearises the rotation (millimetres) and needs
        // the height on the far side. So aim, look where the way out leads, and correct; each round gains 1e-5.
        let mut aim = (lon_rad, lat_rad, height_m);
        let mut xy = (0.0, 0.0);
        for _ in 0..3 {
            let mut point = aim;
            transform(&self.engine.wgs84, &self.engine.system, &mut point).ok()?;
            xy = (point.0, point.1);
            point.2 = height_m;
            transform(&self.engine.system, &self.engine.wgs84, &mut point).ok()?;
            aim = (aim.0 + short_way(lon_rad - point.0), aim.1 + lat_rad - point.1, point.2);
        }
        if self.kind == Kind::Geographic {
            xy = (xy.0.to_degrees(), xy.1.to_degrees());
        }
        (xy.0.is_finite() && xy.1.is_finite()).then_some(xy)
    }
}

/// An angle without its whole turns, radians: across the date line, longitudes differ by one.
fn short_way(angle_rad: f64) -> f64 {
    use std::f64::consts::TAU;
    angle_rad - (angle_rad / TAU).round() * TAU
}

/// A proj definition taken apart.
struct Parts {
    /// What proj4rs gets.
    kept: String,
    height_unit_m: Option<f64>,
    /// Null shifts left out.
    towgs84: Option<String>,
    doubt: Option<&'static str>,
}

impl Parts {
    fn of(definition: &str) -> Result<Self, String> {
        let mut tokens: Vec<(&str, &str)> = Vec::new();
        let mut grid = None;
        let mut height_unit_m = None;
        for token in definition.split_whitespace() {
            let token = token.trim_start_matches('+');
            let (key, value) = token.split_once('=').unwrap_or((token, ""));
            // Only what projections need: quotes and paths have no place in them.
            if !value.chars().all(|c| c.is_ascii_alphanumeric() || "+-.,_@'\"°:/`".contains(c)) {
                return Err(format!("parameter '{}' has a value that is not understood", shortened(token)));
            }
            match key {
                "nadgrids" => grid = Some(value),
                "vunits" => height_unit_m = Some(unit_m(value)?),
                "vto_meter" => {
                    height_unit_m = Some(value.parse().map_err(|_| format!("'{}' is not a number", shortened(value)))?);
                }
                _ if DROPPED.contains(&key) || key.is_empty() => {}
                _ if KEPT.contains(&key) => tokens.push((key, value)),
                _ => return Err(format!("parameter '+{}' is not understood", shortened(key))),
            }
        }
        let value_of = |key: &str| tokens.iter().find(|(k, _)| *k == key).map(|(_, v)| *v);
        let has_shift = value_of("towgs84").is_some();
        let mut doubt = None;
        // Web Mercator's "@null" means: take its sphere's latitudes as WGS 84's; proj4rs knows it.
        let null_grid = grid.is_some_and(|g| g.trim_end_matches(['.', '`']) == "@null");
        if grid.is_some() && !null_grid && !has_shift {
            doubt = Some("its shift to WGS 84 needs a grid file, which is not read; positions may be metres off");
        }
        if value_of("datum") == Some("NAD27") && !has_shift {
            // The published mean shift for the conterminous US (EPSG:1173) stands in for the grids.
            tokens.retain(|(key, _)| *key != "datum");
            tokens.extend([("ellps", "clrk66"), ("towgs84", "-8,160,176")]);
            doubt = Some("NAD27 is shifted by its mean over the conterminous US; positions may be 10 m off");
        } else if !has_shift && !null_grid && doubt.is_none() && value_of("datum").is_none() {
            let twin = match value_of("ellps") {
                Some(name) => matches!(name, "GRS80" | "WGS84"),
                None => value_of("a").is_none() && value_of("R").is_none(),
            };
            if !twin {
                doubt = Some("no shift from its datum to WGS 84 is known; positions may be hundreds of metres off");
            }
        }
        let is_null = |shift: &str| shift.split(',').all(|part| part.trim().parse() == Ok(0.0));
        let shift = tokens.iter().find(|(key, _)| *key == "towgs84").map(|(_, value)| *value);
        let towgs84 = shift.filter(|shift| !is_null(shift)).map(str::to_owned);
        let mut kept: Vec<String> = tokens
            .iter()
            .map(|(key, value)| if value.is_empty() { format!("+{key}") } else { format!("+{key}={value}") })
            .collect();
        if null_grid {
            kept.push("+nadgrids=@null".into());
        }
        Ok(Self { kept: kept.join(" "), height_unit_m, towgs84, doubt })
    }
}

fn unit_m(name: &str) -> Result<f64, String> {
    match name {
        "m" => Ok(1.0),
        "ft" => Ok(FOOT_M),
        "us-ft" => Ok(US_FOOT_M),
        _ => Err(format!("vertical unit '{}' is not understood; wanted m, ft or us-ft", shortened(name))),
    }
}

/// The proj definition of an EPSG code, mended where needed; empty for systems proj cannot express.
pub(super) fn proj_of(code: u32) -> Option<String> {
    let definition = crs_definitions::from_code(u16::try_from(code).ok()?)?.proj4;
    let Some((_, shift)) = MENDED_SHIFTS.iter().find(|(codes, _)| codes.contains(&code)) else {
        return Some(definition.to_owned());
    };
    let others = definition.split_whitespace().filter(|token| !token.starts_with("+towgs84="));
    Some(others.chain([format!("+towgs84={shift}").as_str()]).collect::<Vec<_>>().join(" "))
}

/// ODM's `WGS84 UTM 32N`.
fn utm_code(text: &str) -> Option<u32> {
    let rest = strip_prefix_ignore_case(text, "WGS84 UTM")?.trim();
    let (zone, north) = match rest.strip_suffix(['N', 'n']) {
        Some(zone) => (zone, true),
        None => (rest.strip_suffix(['S', 's'])?, false),
    };
    let zone: u32 = zone.trim().parse().ok()?;
    (1..=60).contains(&zone).then_some(if north { 32600 + zone } else { 32700 + zone })
}

/// What follows `prefix`, compared without regard to case.
pub(super) fn strip_prefix_ignore_case<'a>(text: &'a str, prefix: &str) -> Option<&'a str> {
    let head = text.get(..prefix.len())?;
    head.eq_ignore_ascii_case(prefix).then(|| &text[prefix.len()..])
}

/// The first words of a text from a file, fit for a one-line message.
pub(crate) fn shortened(text: &str) -> String {
    const LONGEST: usize = 80;
    let line: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).take(LONGEST).collect();
    if text.chars().nth(LONGEST).is_some() { format!("{line}…") } else { line }
}

#[cfg(test)]
#[path = "crs_tests.rs"]
mod tests;
