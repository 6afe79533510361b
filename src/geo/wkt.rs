//! Well-known text, versions 1 and 2, as far as it names or defines a projected system.
//!
//! # Method
//! 1. Read the text into a tree of `KEYWORD[arguments]`.
//! 2. Find the horizontal part and take its EPSG code where it has one.
//! 3. Else write a proj string from its method, parameters, ellipsoid, meridian, unit and `TOWGS84`.
//!
//! # Limits
//! Without a code: Transverse Mercator, Lambert conformal conic, Mercator and geographic systems only.

use super::crs::{Crs, proj_of, shortened};
use crate::{Error, Result};

/// A WKT longer than this is no coordinate system, bytes. The longest of EPSG's is 7 kB.
const LONGEST_BYTES: usize = 256 << 10;
/// Brackets deeper than this are no coordinate system. EPSG's reach 7.
const DEEPEST: usize = 32;

/// The vertical part of a compound.
pub(super) struct Vertical {
    /// `EPSG:n` or the name; none for heights above the ellipsoid.
    pub name: Option<String>,
    /// Metres in its unit.
    pub unit_m: Option<f64>,
}

#[derive(Debug, PartialEq)]
enum Argument {
    Text(String),
    Number(f64),
    /// A bare word that is not a number (`EAST`).
    Word,
    Node(Node),
}

#[derive(Debug, PartialEq)]
struct Node {
    /// Upper case.
    keyword: String,
    arguments: Vec<Argument>,
}

/// Reads a horizontal or compound system.
pub(super) fn parse(text: &str) -> Result<Crs> {
    let refuse = |why: String| Error::Config(format!("WKT '{}': {why}", shortened(text)));
    let tree = Node::read(text).map_err(&refuse)?;
    let horizontal = tree.horizontal(0).ok_or_else(|| {
        refuse(format!("found {} without a projected or geographic system, wanted PROJCS or PROJCRS", tree.keyword))
    })?;
    let crs = match horizontal.epsg() {
        // A code that is not known here may still be spelt out.
        Some(code) => Crs::from_epsg(code, None).or_else(|unknown| {
            horizontal.proj_string().map_or(Err(unknown), |p| Crs::build(&p, p.clone(), Some(code)))
        }),
        None => {
            let proj = horizontal.proj_string().map_err(&refuse)?;
            Crs::build(&proj, proj.clone(), None)
        }
    }?;
    crs.with_wkt(text, tree.vertical())
}

/// The vertical part of a definition's own WKT.
pub(super) fn vertical_of(text: &str) -> Option<Vertical> {
    // Most definitions have none, and the search spares building their trees.
    text.contains("VERT").then(|| Node::read(text).ok()).flatten()?.vertical()
}

impl Node {
    fn read(text: &str) -> Result<Self, String> {
        if text.len() > LONGEST_BYTES {
            return Err(format!("found {} bytes, read at most {LONGEST_BYTES}", text.len()));
        }
        let mut reader = Reader { rest: text };
        let keyword = reader.word().to_owned();
        let node = reader.node(&keyword, 0)?;
        match reader.rest.trim_start() {
            "" => Ok(node),
            rest => Err(format!("found '{}' after its end", shortened(rest))),
        }
    }

    fn nodes(&self) -> impl Iterator<Item = &Self> {
        self.arguments.iter().filter_map(|argument| match argument {
            Argument::Node(node) => Some(node),
            _ => None,
        })
    }

    fn child(&self, keywords: &[&str]) -> Option<&Self> {
        self.nodes().find(|node| keywords.contains(&node.keyword.as_str()))
    }

    fn name(&self) -> &str {
        match self.arguments.first() {
            Some(Argument::Text(text)) => text,
            _ => "",
        }
    }

    /// The `index`th argument as a number.
    fn number(&self, index: usize) -> Option<f64> {
        match self.arguments.get(index) {
            Some(Argument::Number(number)) => Some(*number),
            _ => None,
        }
    }

    /// `AUTHORITY["EPSG","n"]` or `ID["EPSG",n]` of this node itself.
    fn epsg(&self) -> Option<u32> {
        let id = self.child(&["AUTHORITY", "ID"])?;
        if !id.name().eq_ignore_ascii_case("EPSG") {
            return None;
        }
        match id.arguments.get(1)? {
            Argument::Text(text) => text.trim().parse().ok(),
            Argument::Number(number) if number.fract() == 0.0 && (1.0..1e9).contains(number) => Some(*number as u32),
            _ => None,
        }
    }

    fn horizontal(&self, depth: usize) -> Option<&Self> {
        match self.keyword.as_str() {
            "PROJCS" | "PROJCRS" | "PROJECTEDCRS" | "GEOGCS" | "GEOGCRS" | "GEOGRAPHICCRS" | "GEODCRS"
            | "GEODETICCRS" | "GEOCCS" => Some(self),
            "COMPD_CS" | "COMPOUNDCRS" | "BOUNDCRS" | "SOURCECRS" if depth < DEEPEST => {
                self.nodes().find_map(|node| node.horizontal(depth + 1))
            }
            _ => None,
        }
    }

    fn vertical(&self) -> Option<Vertical> {
        let inner = match self.keyword.as_str() {
            "BOUNDCRS" => return self.child(&["SOURCECRS"])?.nodes().next()?.vertical(),
            "COMPD_CS" | "COMPOUNDCRS" => self,
            _ => return None,
        };
        let part = inner.child(&["VERT_CS", "VERTCS", "VERTCRS", "VERTICALCRS", "BOUNDCRS"])?;
        let part = match part.child(&["SOURCECRS"]) {
            Some(source) => source.nodes().next()?,
            None => part,
        };
        // Esri writes heights above an ellipsoid as a vertical system on a geodetic datum.
        let ellipsoidal = part.child(&["DATUM"]).is_some_and(|datum| datum.ellipsoid().is_some())
            || part.name().to_ascii_lowercase().contains("ellipsoid");
        let name = part.epsg().map_or_else(|| part.name().to_owned(), |code| format!("EPSG:{code}"));
        Some(Vertical { name: (!ellipsoidal).then_some(name), unit_m: part.length_unit_m() })
    }

    fn ellipsoid(&self) -> Option<&Self> {
        self.child(&["SPHEROID", "ELLIPSOID"])
    }

    /// The linear unit of a system: its own, or that of its axes.
    fn length_unit_m(&self) -> Option<f64> {
        let own = self.child(&["UNIT", "LENGTHUNIT"]);
        let of_axis = || self.child(&["AXIS"])?.child(&["UNIT", "LENGTHUNIT"]);
        own.or_else(of_axis)?.number(1)
    }

    fn proj_string(&self) -> Result<String, String> {
        let base = self.child(&["GEOGCS", "BASEGEOGCRS", "BASEGEODCRS"]);
        let Some(base) = base else {
            return match self.keyword.as_str() {
                "GEOGCS" | "GEOGCRS" | "GEOGRAPHICCRS" => Ok(format!("+proj=longlat{} +no_defs", self.datum()?)),
                _ => Err(format!("{} names no EPSG code and no projection; give EPSG:n", self.keyword)),
            };
        };
        let holder = self.child(&["CONVERSION"]).unwrap_or(self);
        let method = holder.child(&["PROJECTION", "METHOD"]).map_or("", Self::name);
        let mut proj = format!("+proj={}", projection(method)?);
        let unit_m = self.length_unit_m().unwrap_or(1.0);
        for parameter in holder.nodes().filter(|node| node.keyword == "PARAMETER") {
            let value =
                parameter.number(1).ok_or_else(|| format!("'{}' has no number", shortened(parameter.name())))?;
            let (key, length) = parameter_key(parameter.name(), method)?;
            // WKT 2 gives every parameter its own unit, WKT 1 the system's; proj wants metres and degrees.
            let own_unit = parameter.child(&["LENGTHUNIT", "ANGLEUNIT", "UNIT"]).and_then(|unit| unit.number(1));
            let value = match (length, own_unit) {
                (true, own) => value * own.unwrap_or(unit_m),
                (false, Some(radians)) if key.starts_with("l") => in_degrees(value, radians),
                (false, _) => value,
            };
            proj += &format!(" +{key}={value}");
        }
        Ok(format!("{proj}{} +to_meter={unit_m} +no_defs", base.datum()?))
    }

    /// Ellipsoid, shift and meridian of a geographic system as proj parameters.
    fn datum(&self) -> Result<String, String> {
        let datum = self.child(&["DATUM", "GEODETICDATUM", "TRF", "ENSEMBLE"]);
        let ellipsoid = datum.and_then(Self::ellipsoid).ok_or("no ellipsoid is given; give EPSG:n instead")?;
        let size = ellipsoid.number(1).zip(ellipsoid.number(2));
        let (a_m, inverse_flattening) = size.ok_or("its ellipsoid has no size")?;
        let unit_m = ellipsoid.child(&["LENGTHUNIT"]).and_then(|unit| unit.number(1)).unwrap_or(1.0);
        // Named where a name exists, so that the datum's kinship to WGS 84 is seen.
        let mut proj = match ((a_m * unit_m).to_bits(), inverse_flattening.to_bits()) {
            size if size == (6_378_137.0f64.to_bits(), 298.257_223_563f64.to_bits()) => " +ellps=WGS84".to_owned(),
            size if size == (6_378_137.0f64.to_bits(), 298.257_222_101f64.to_bits()) => " +ellps=GRS80".to_owned(),
            _ if inverse_flattening == 0.0 => format!(" +R={}", a_m * unit_m),
            _ => format!(" +a={} +rf={inverse_flattening}", a_m * unit_m),
        };
        if let Some(shift) = datum.and_then(|datum| datum.child(&["TOWGS84"])) {
            let numbers: Vec<String> =
                (0..shift.arguments.len()).filter_map(|i| shift.number(i)).map(|n| n.to_string()).collect();
            proj += &format!(" +towgs84={}", numbers.join(","));
        } else if let Some(definition) = self.epsg().and_then(proj_of) {
            // The geographic system has a code even where the projected one has none.
            let same = |token: &&str| token.starts_with("+towgs84=") || token.starts_with("+datum=");
            if let Some(token) = definition.split_whitespace().find(same) {
                proj += &format!(" {token}");
            }
        }
        match self.child(&["PRIMEM", "PRIMEMERIDIAN"]).and_then(|meridian| meridian.number(1)) {
            Some(degrees) if degrees != 0.0 => Ok(format!("{proj} +pm={degrees}")),
            _ => Ok(proj),
        }
    }
}

fn in_degrees(value: f64, radians: f64) -> f64 {
    const DEGREE_RAD: f64 = std::f64::consts::PI / 180.0;
    // Written degrees are rounded to 15 digits or so; multiplying by their unit and back would only add noise.
    if (radians - DEGREE_RAD).abs() < 1e-12 { value } else { (value * radians).to_degrees() }
}

fn plain(name: &str) -> String {
    name.to_ascii_lowercase().replace([' ', '-'], "_").replace(['(', ')'], "")
}

fn projection(method: &str) -> Result<&'static str, String> {
    match plain(method).as_str() {
        "transverse_mercator" | "gauss_kruger" | "transverse_mercator_complex" => Ok("tmerc"),
        "lambert_conformal_conic"
        | "lambert_conformal_conic_2sp"
        | "lambert_conformal_conic_1sp"
        | "lambert_conic_conformal_2sp"
        | "lambert_conic_conformal_1sp" => Ok("lcc"),
        "mercator" | "mercator_1sp" | "mercator_2sp" | "mercator_variant_a" | "mercator_variant_b" => Ok("merc"),
        _ => Err(format!(
            "it names no EPSG code, and its projection '{}' is read by code only; give EPSG:n or a proj string",
            shortened(method)
        )),
    }
}

/// The proj parameter of a WKT parameter, and whether it is a length.
fn parameter_key(name: &str, method: &str) -> Result<(&'static str, bool), String> {
    let mercator = projection(method) == Ok("merc");
    Ok(match plain(name).as_str() {
        "false_easting" | "easting_at_false_origin" => ("x_0", true),
        "false_northing" | "northing_at_false_origin" => ("y_0", true),
        "central_meridian" | "longitude_of_natural_origin" | "longitude_of_false_origin" | "longitude_of_origin" => {
            ("lon_0", false)
        }
        "latitude_of_origin" | "latitude_of_natural_origin" | "latitude_of_false_origin" => ("lat_0", false),
        "scale_factor" | "scale_factor_at_natural_origin" => ("k_0", false),
        "standard_parallel_1" | "latitude_of_1st_standard_parallel" if mercator => ("lat_ts", false),
        "standard_parallel_1" | "latitude_of_1st_standard_parallel" => ("lat_1", false),
        "standard_parallel_2" | "latitude_of_2nd_standard_parallel" => ("lat_2", false),
        _ => return Err(format!("its parameter '{}' is not understood; give EPSG:n instead", shortened(name))),
    })
}

struct Reader<'a> {
    rest: &'a str,
}

impl<'a> Reader<'a> {
    fn word(&mut self) -> &'a str {
        self.rest = self.rest.trim_start();
        let end = self.rest.find(|c: char| !(c.is_alphanumeric() || "_+-.:".contains(c))).unwrap_or(self.rest.len());
        let (word, rest) = self.rest.split_at(end);
        self.rest = rest.trim_start();
        word
    }

    fn take(&mut self, wanted: &[char]) -> bool {
        match self.rest.trim_start().strip_prefix(wanted) {
            Some(rest) => {
                self.rest = rest;
                true
            }
            None => false,
        }
    }

    /// Reads what follows `keyword`, from its opening to its closing bracket.
    fn node(&mut self, keyword: &str, depth: usize) -> Result<Node, String> {
        if keyword.is_empty() || !self.take(&['[', '(']) {
            return Err(format!("wanted KEYWORD[…] at '{}'", shortened(self.rest)));
        }
        if depth == DEEPEST {
            return Err(format!("its brackets are nested more than {DEEPEST} deep"));
        }
        let mut arguments = Vec::new();
        loop {
            arguments.push(self.argument(depth)?);
            if self.take(&[']', ')']) {
                return Ok(Node { keyword: keyword.to_ascii_uppercase(), arguments });
            }
            if !self.take(&[',']) {
                return Err(match self.rest.trim() {
                    "" => format!("it ends inside {}", shortened(keyword)),
                    rest => format!("wanted ',' or ']' at '{}'", shortened(rest)),
                });
            }
        }
    }

    fn argument(&mut self, depth: usize) -> Result<Argument, String> {
        if self.take(&['"']) {
            return self.text().map(Argument::Text);
        }
        let word = self.word();
        if self.rest.starts_with(['[', '(']) {
            return self.node(word, depth + 1).map(Argument::Node);
        }
        match word.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(Argument::Number(number)),
            _ => Ok(Argument::Word),
        }
    }

    /// The rest of a quoted text; `""` stands for a quote.
    fn text(&mut self) -> Result<String, String> {
        let mut text = String::new();
        loop {
            let Some((part, rest)) = self.rest.split_once('"') else {
                return Err("a quoted name does not end".into());
            };
            text += part;
            self.rest = rest;
            match rest.strip_prefix('"') {
                Some(after) => self.rest = after,
                None => return Ok(text),
            }
            text.push('"');
        }
    }
}
