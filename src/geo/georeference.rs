//! What the user or a file says about coordinates, before any of it is computed.

use std::path::Path;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::crs::{Crs, Kind, shortened, strip_prefix_ignore_case};
use crate::report::Reporter;
use crate::{Error, Result};

/// How heights become heights above the ellipsoid.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub enum Vertical {
    /// They are taken as ellipsoidal. Default.
    #[default]
    Ellipsoidal,
    /// Metres to add, for instance the geoid's height above the ellipsoid at the place.
    Offset(f64),
}

impl Vertical {
    /// Metres to add to a height in metres.
    pub fn offset_m(self) -> f64 {
        match self {
            Self::Ellipsoidal => 0.0,
            Self::Offset(offset_m) => offset_m,
        }
    }
}

/// Where a model's coordinates are meant to lie.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub enum Georeference {
    /// Metres in a system of the model's own; the tiles get no place on the Earth. Default.
    #[default]
    Local,
    /// Metres east, north, up of a place.
    Enu {
        /// Geodetic latitude, degrees.
        lat_deg: f64,
        /// Longitude, degrees.
        lon_deg: f64,
        /// Above the ellipsoid, metres.
        height_m: f64,
        /// Added to every vertex, metres in that frame.
        offset: DVec3,
    },
    /// A projected or geographic (x longitude, y latitude, degrees) system.
    Projected {
        /// The system.
        crs: Crs,
        /// Added to every vertex, in the system's units.
        origin: DVec3,
        /// What is done about heights.
        vertical: Vertical,
    },
    /// Earth-centred metres on WGS 84 (EPSG:4978).
    Geocentric {
        /// Added to every vertex, metres.
        origin: DVec3,
    },
}

impl Georeference {
    /// Reads `local`, `ENU:lat,lon[,h]` (latitude first, degrees, metres), or any system [`Crs::parse`] reads.
    /// An empty text is `local`.
    ///
    /// # Errors
    /// [`Error::Config`] naming the text and what would be understood.
    pub fn parse(text: &str) -> Result<Self> {
        let text = text.trim().trim_start_matches('\u{feff}').trim();
        if text.is_empty() || text.eq_ignore_ascii_case("local") {
            return Ok(Self::Local);
        }
        if let Some(place) = strip_prefix_ignore_case(text, "ENU:") {
            return Self::parse_enu(text, place);
        }
        let crs = Crs::parse(text)?;
        Ok(match crs.kind() {
            Kind::Geocentric => Self::Geocentric { origin: DVec3::ZERO },
            _ => Self::Projected { crs, origin: DVec3::ZERO, vertical: Vertical::default() },
        })
    }

    fn parse_enu(text: &str, place: &str) -> Result<Self> {
        let wrong = |why: &str| Error::Config(format!("'{}': {why}", shortened(text)));
        let numbers = numbers(place).map_err(|why| wrong(&why))?;
        let (lat_deg, lon_deg, height_m) = match numbers[..] {
            [lat_deg, lon_deg] => (lat_deg, lon_deg, 0.0),
            [lat_deg, lon_deg, height_m] => (lat_deg, lon_deg, height_m),
            _ => return Err(wrong("wanted ENU:latitude,longitude or ENU:latitude,longitude,height")),
        };
        check_place(lat_deg, lon_deg).map_err(|why| wrong(&format!("{why} (ENU is written latitude first)")))?;
        Ok(Self::Enu { lat_deg, lon_deg, height_m, offset: DVec3::ZERO })
    }

    /// The same with `origin` (source units) added to every vertex. A local system has no origin to speak of.
    pub fn with_origin(mut self, added: DVec3) -> Self {
        match &mut self {
            Self::Local => {}
            Self::Enu { offset, .. } => *offset = added,
            Self::Projected { origin, .. } | Self::Geocentric { origin } => *origin = added,
        }
        self
    }

    /// The same with `offset_m` added to every height, which are thereby declared ellipsoidal.
    ///
    /// # Errors
    /// [`Error::Config`] for a number that is not finite, and for systems without heights (local, Earth-centred).
    pub fn with_height_offset(mut self, offset_m: f64) -> Result<Self> {
        if !offset_m.is_finite() {
            return Err(Error::Config(format!("found a height offset of {offset_m}, wanted metres")));
        }
        match &mut self {
            Self::Enu { height_m, .. } => *height_m += offset_m,
            Self::Projected { vertical, .. } => *vertical = Vertical::Offset(offset_m),
            Self::Local | Self::Geocentric { .. } => {
                return Err(Error::Config(
                    "a height offset was given, but the coordinates are local or Earth-centred and hold no heights; \
                     give --crs or leave the offset out"
                        .into(),
                ));
            }
        }
        Ok(self)
    }

    /// Tells what will be assumed about heights and datum: warnings `vertical-datum` and `datum-shift`.
    pub fn warn(&self, reporter: &Reporter, path: &Path) {
        let Self::Projected { crs, vertical, .. } = self else { return };
        if let (Some(system), Vertical::Ellipsoidal) = (crs.vertical(), vertical) {
            reporter.warn(
                "vertical-datum",
                path,
                format!(
                    "heights are in {system} but taken as heights above the ellipsoid, which may differ by up to 100 m; \
                     give --height-offset METRES (the geoid's height at the place)"
                ),
            );
        }
        if let Some(doubt) = crs.datum_doubt() {
            reporter.warn(
                "datum-shift",
                path,
                format!("{}: {doubt}; give a proj string with +towgs84=… to mend it", shortened(&crs.to_string())),
            );
        }
    }

    /// Refuses numbers that no place on the Earth has.
    pub(super) fn check(&self) -> Result<()> {
        match self {
            Self::Enu { lat_deg, lon_deg, height_m, offset } => {
                check_place(*lat_deg, *lon_deg).map_err(Error::Config)?;
                finite(*offset + DVec3::Z * *height_m)
            }
            Self::Projected { origin, vertical, .. } => finite(*origin + DVec3::Z * vertical.offset_m()),
            Self::Geocentric { origin } => finite(*origin),
            Self::Local => Ok(()),
        }
    }
}

/// Reads `x,y` or `x,y,z` (commas, semicolons or blanks between; z defaults to 0).
///
/// # Errors
/// [`Error::Config`] naming the text and what was wanted.
pub fn parse_origin(text: &str) -> Result<DVec3> {
    let wrong = |why: &str| Error::Config(format!("origin '{}': {why}", shortened(text)));
    let numbers = numbers(text).map_err(|why| wrong(&why))?;
    match numbers[..] {
        [x, y] => Ok(DVec3::new(x, y, 0.0)),
        [x, y, z] => Ok(DVec3::new(x, y, z)),
        _ => Err(wrong(&format!("found {} numbers, wanted x,y or x,y,z with decimal points", numbers.len()))),
    }
}

/// Finite numbers between commas, semicolons or blanks.
pub(crate) fn numbers(text: &str) -> Result<Vec<f64>, String> {
    const MOST: usize = 16;
    let parts: Vec<&str> = match text.find([',', ';']) {
        Some(_) => text.split([',', ';']).map(str::trim).take(MOST).collect(),
        None => text.split_whitespace().take(MOST).collect(),
    };
    parts
        .into_iter()
        .map(|part| match part.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(format!("'{}' is not a number", shortened(part))),
        })
        .collect()
}

fn check_place(lat_deg: f64, lon_deg: f64) -> Result<(), String> {
    if lat_deg.abs() <= 90.0 && lon_deg.abs() <= 180.0 {
        return Ok(());
    }
    // Longitudes beyond 90 read as latitudes are the classic.
    let swapped = lat_deg.abs() <= 180.0 && lon_deg.abs() <= 90.0;
    let hint = if swapped { "; latitude and longitude look swapped" } else { "" };
    Err(format!("found latitude {lat_deg} and longitude {lon_deg}, wanted -90 to 90 and -180 to 180 degrees{hint}"))
}

fn finite(point: DVec3) -> Result<()> {
    if point.is_finite() {
        return Ok(());
    }
    Err(Error::Config(format!("found an origin that is not finite: {point}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn command_line_texts_are_read() {
        assert_eq!(Georeference::parse("local").unwrap(), Georeference::Local);
        let enu = Georeference::Enu { lat_deg: -33.5, lon_deg: 151.0, height_m: 12.5, offset: DVec3::ZERO };
        assert_eq!(Georeference::parse("enu: -33.5, 151, 12.5").unwrap(), enu);
        let projected = Georeference::parse("EPSG:25832").unwrap().with_origin(DVec3::ONE);
        assert!(matches!(projected, Georeference::Projected { origin: DVec3::ONE, .. }));
        assert!(Georeference::parse("ENU:48.1").unwrap_err().to_string().contains("wanted ENU:latitude,longitude"));
    }

    #[test]
    fn origins_have_two_or_three_numbers() {
        assert_eq!(parse_origin(" 1, 2.5 ,-3e2 ").unwrap(), DVec3::new(1.0, 2.5, -300.0));
        assert_eq!(
            parse_origin("671842.3164090217 5336500").unwrap(),
            DVec3::new(671_842.316_409_021_7, 5_336_500.0, 0.0)
        );
        for text in ["", "1", "1,2,3,4", "1,,2", "1,inf", "a,b"] {
            assert_eq!(parse_origin(text).unwrap_err().exit_code(), 2, "{text}");
        }
    }

    #[test]
    fn a_height_offset_needs_heights() {
        assert!(Georeference::Local.with_height_offset(40.0).is_err());
        assert!(Georeference::parse("EPSG:25832").unwrap().with_height_offset(f64::NAN).is_err());
    }

    #[test]
    fn a_georeference_survives_being_written_and_read() {
        let given = Georeference::parse("EPSG:2263+5703").unwrap().with_origin(DVec3::new(0.1, 0.2, 0.3));
        let given = given.with_height_offset(-32.1).unwrap();
        let text = serde_json::to_string(&given).unwrap();
        let again: Georeference = serde_json::from_str(&text).unwrap();
        assert_eq!(again, given);
        assert!(serde_json::from_str::<Georeference>(&text.replace("2263", "1")).is_err());
    }
}
