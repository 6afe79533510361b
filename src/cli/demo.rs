//! `rooftile demo`.

use std::path::PathBuf;

use super::build::Settings;
use super::{Outcome, print_json};
use crate::demo::{CityConfig, Size, generate};
use crate::geo::Georeference;
use crate::pipeline::{self, Job};
use crate::report::Reporter;
use crate::{Result, inspect};

#[derive(clap::Args)]
pub struct Args {
    /// The folder to make; a tileset already there is replaced.
    #[arg(short, long, value_name = "DIR", default_value = "rooftile-demo")]
    out: PathBuf,
    /// How large a quarter.
    #[arg(long, value_enum, default_value = "small")]
    size: Extent,
    /// Another seed, another city.
    #[arg(long, default_value_t = CityConfig::default().seed)]
    seed: u64,
    #[command(flatten)]
    settings: Settings,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Extent {
    /// About 120 thousand triangles.
    Small,
    /// About 600 thousand.
    Medium,
    /// About 2.5 million.
    Large,
}

/// The quarter stands on a fixed place: so viewers show it on the globe.
const PLACE: &str = "ENU:53.5,10.0,20";

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    let config = args.settings.layered()?;
    let size = match args.size {
        Extent::Small => Size::Small,
        Extent::Medium => Size::Medium,
        Extent::Large => Size::Large,
    };
    let stage = reporter.stage("city", 0);
    let city = generate(&CityConfig { seed: args.seed, size, ..CityConfig::default() });
    stage.finish(format!("{} triangles, {} images", city.truth.len(), city.source.images.len()));

    let georeference = Georeference::parse(PLACE)?;
    let job = Job {
        out: &args.out,
        force: true,
        config: &config,
        georeference,
        inputs: Vec::new(),
        labels_are_truth: true,
        labels: None,
    };
    let report = pipeline::build(city.source, &job, reporter)?;
    let findings = inspect::check(&args.out)?;
    reporter.say(&report.to_string());
    if findings.is_empty() {
        reporter.say("check      boxes, errors, references, geometry and features: nothing to complain of");
    }
    for finding in &findings {
        reporter.say(&format!("check      {finding}"));
    }
    reporter
        .say(&format!("\nLook at it: rooftile serve {}  (or cargo run --release -- serve {0})", args.out.display()));
    if json {
        print_json(&serde_json::json!({ "build": report, "findings": findings }))?;
    }
    Ok(if findings.is_empty() { Outcome::Fine } else { Outcome::Findings })
}
