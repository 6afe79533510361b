//! `rooftile audit`.

use std::path::PathBuf;

use super::{Outcome, print, print_json};
use crate::audit::budget::Budget;
use crate::audit::findings::Group;
use crate::audit::rewrite::{self, Policy};
use crate::audit::source::OriginalConfig;
use crate::audit::view::{self, Load};
use crate::audit::{Audit, AuditConfig, Station, audit, page};
use crate::geo::Georeference;
use crate::report::Reporter;
use crate::store::memory;
use crate::{Error, Result};

#[derive(clap::Args)]
pub struct Args {
    /// Anybody's 3D Tiles: a folder, a tileset.json, a .3tz, or a URL where the program was built with http.
    #[arg(value_name = "TILESET")]
    tileset: PathBuf,
    /// The original mesh, as for `build`: measure against it and not against the finest tiles.
    #[arg(long, value_name = "INPUT", num_args = 1..)]
    source: Vec<PathBuf>,
    /// Coordinates of the original, as --crs of `build`. Default: what its files say.
    #[arg(long, value_name = "CRS", requires = "source")]
    source_crs: Option<String>,
    /// Errors this many times the certified error are overstated.
    #[arg(long, value_name = "FACTOR", default_value_t = AuditConfig::default().distance.max_slack)]
    max_slack: f64,
    /// Wanted width of certified intervals, metres. Default: 0.02, or 2e-4 of the tile's diagonal where that is less.
    #[arg(long, value_name = "METRES")]
    tolerance: Option<f64>,
    /// A wider gap between tiles of one level is a crack, metres.
    #[arg(long, value_name = "METRES", default_value_t = AuditConfig::default().seams.crack_m)]
    crack: f64,
    /// Find what sinks by this many metres below the true top, and what is lost: tiling error alone.
    #[arg(long, value_name = "METRES")]
    obstacle_safe: Option<f64>,
    /// Write one page for people; it needs no network.
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Write the same tiles with measured errors to this new folder.
    #[arg(long, value_name = "OUT")]
    rewrite: Option<PathBuf>,
    /// The error that --rewrite writes.
    #[arg(long, value_enum, default_value = "strict", requires = "rewrite")]
    policy: PolicyName,
    /// A route to fly (GeoJSON LineString): what viewers load on it.
    #[arg(long, value_name = "FILE")]
    route: Option<PathBuf>,
    /// Memory to stay within, for instance 2GB or 4GiB; the figures do not depend on it. Default: a third of the
    /// machine's.
    #[arg(long, value_name = "BYTES")]
    memory: Option<String>,
    /// End with exit code 1 if there are faults of these groups, separated by commas.
    #[arg(long, value_name = "GROUPS", value_delimiter = ',', value_parser = groups())]
    fail_on: Vec<String>,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum PolicyName {
    /// Certified: no point is further off.
    Strict,
    /// The 95th percentile.
    P95,
    /// Certified for roofs and facades, the 95th percentile for the rest.
    Semantic,
}

fn groups() -> clap::builder::PossibleValuesParser {
    clap::builder::PossibleValuesParser::new(Group::ALL.map(|(_, name)| name))
}

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    let config = config(args)?;
    let audit = audit(&args.tileset, &config, reporter)?;
    if let Some(path) = &args.html {
        let page = page::html(&audit, &args.tileset.display().to_string())?;
        std::fs::write(path, page).map_err(Error::io("write", path))?;
        reporter.say(&format!("page       {}", path.display()));
    }
    let rewritten = args.rewrite.as_ref().map(|out| rewritten(&audit, args, out)).transpose()?;
    if json {
        let mut value = audit.json();
        value["rewrite"] = serde_json::json!(rewritten);
        print_json(&value)?;
    } else {
        print(audit.text().trim_end())?;
        rewritten.iter().flatten().try_for_each(|b| print(&b.to_string()))?;
    }
    let fail_on: Vec<Group> = Group::ALL
        .iter()
        .filter(|(_, name)| args.fail_on.iter().any(|asked| asked == name))
        .map(|(group, _)| *group)
        .collect();
    let reasons = audit.reasons(&fail_on);
    for reason in &reasons {
        reporter.say(&format!("fail       {reason}"));
    }
    Ok(if reasons.is_empty() { Outcome::Fine } else { Outcome::Findings })
}

/// What a viewer loads from a height before and after.
#[derive(serde::Serialize)]
struct BeforeAfter {
    height_m: f64,
    before: Load,
    after: Load,
}

impl std::fmt::Display for BeforeAfter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (before, after) = (self.before.triangles, self.after.triangles);
        let (from, to) = (self.before.tiles, self.after.tiles);
        write!(f, "rewrite    at +{:<4} m {before} triangles in {from} tiles become {after} in {to}", self.height_m)
    }
}

fn rewritten(audit: &Audit, args: &Args, out: &std::path::Path) -> Result<Vec<BeforeAfter>> {
    let policy = match args.policy {
        PolicyName::Strict => Policy::Strict,
        PolicyName::P95 => Policy::P95,
        PolicyName::Semantic => Policy::Semantic,
    };
    let error_m = rewrite::rewrite(audit, &args.tileset, out, policy)?;
    let pair = |s: &Station| {
        let after = view::load(&audit.tileset, &audit.structure.tiles, &error_m, s.eye());
        BeforeAfter { height_m: s.height_m, before: s.stated, after }
    };
    Ok(audit.stations.iter().map(pair).collect())
}

fn config(args: &Args) -> Result<AuditConfig> {
    let above = |name: &str, value: f64, least: f64| {
        // Written so that a NaN is refused too.
        if value.is_finite() && value >= least {
            return Ok(value);
        }
        Err(Error::Config(format!("{name} {value}: wanted {least} or more")))
    };
    let mut config = AuditConfig::default();
    config.distance.max_slack = above("--max-slack", args.max_slack, 1.0)?;
    config.distance.tolerance_m = args.tolerance.map(|t| above("--tolerance", t, 1e-6)).transpose()?;
    config.seams.crack_m = above("--crack", args.crack, 0.0)?;
    config.seams.match_m = config.seams.match_m.min(config.seams.crack_m);
    config.obstacle_safe_m = args.obstacle_safe.map(|m| above("--obstacle-safe", m, 0.01)).transpose()?;
    config.route = args.route.clone();
    if let Some(text) = &args.memory {
        let asked = memory::parse_bytes(text).filter(|&bytes| bytes >= Budget::LEAST_BYTES);
        let wanted = || Error::Config(format!("--memory {text}: wanted at least 750MB, for instance 2GB or 4GiB"));
        config.budget = Budget(asked.ok_or_else(wanted)?);
    }
    if !args.source.is_empty() {
        let georeference = args.source_crs.as_deref().map(Georeference::parse).transpose()?;
        config.original = Some(OriginalConfig { inputs: args.source.clone(), georeference });
    }
    Ok(config)
}
