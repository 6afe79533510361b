//! `rooftile experiment`.

use std::path::PathBuf;

use super::simplify::{Budgets, Faces, Front, Method, front};
use super::{Outcome, print, print_json};
use crate::experiment::{self, ExperimentConfig};
use crate::measure::MeasureConfig;
use crate::report::Reporter;
use crate::write::output::Output;
use crate::{Error, Result};

/// Distances kept of a run: 16 bytes a sample, each way.
const MOST_SAMPLES: usize = 100_000_000;
/// Cuts of more sizes, or more methods, are not drawn legibly.
const MOST_SIZES: usize = 8;

#[derive(clap::Args)]
pub struct Args {
    /// Mesh files (.obj, .ply, .gltf, .glb) or folders of them.
    #[arg(value_name = "INPUT", required = true)]
    inputs: Vec<PathBuf>,
    /// The folder to make: experiment.json, table.txt, charts as PNG and SVG, pictures.
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
    /// Sizes of the cuts: numbers of triangles, or shares of the input's.
    #[arg(long, value_name = "N|P%,…", value_delimiter = ',', default_value = "10%,5%")]
    faces: Vec<Faces>,
    /// The baseline, then what to compare with it.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "plain,semantic")]
    methods: Vec<Method>,
    /// Classes of the input's triangles, as for `simplify`. Default: those in the input, else by its shape.
    #[arg(long, value_name = "FILE")]
    labels: Option<PathBuf>,
    #[command(flatten)]
    budgets: Budgets,
    /// Points on either surface for each measurement.
    #[arg(long, value_name = "N", default_value_t = 500_000)]
    samples: usize,
    /// Of the points' places.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Follow paths in an input that lead out of its folder.
    #[arg(long)]
    allow_outside: bool,
}

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    check(args)?;
    let scheme = args.budgets.scheme()?;
    // Before anything is computed: an output that stands in the way is known at once.
    let output = Output::begin(&args.out, false)?;
    let front = front(&args.inputs, args.labels.as_deref(), args.allow_outside, |_| true, reporter)?;
    let Front { mesh, mut classes, .. } = front;
    classes.scheme = scheme;
    let config = ExperimentConfig {
        methods: args.methods.iter().map(|m| (m.meant(), m.name())).collect(),
        faces: args.faces.iter().map(|f| (f.of(mesh.faces.len()), f.to_string())).collect(),
        measure: MeasureConfig { samples: args.samples, seed: args.seed, ..MeasureConfig::default() },
    };
    let found = experiment::run(&mesh, &classes, &config, reporter)?;

    let stage = reporter.stage("draw", 0);
    let files = experiment::files(&mesh, &classes, &found)?;
    reporter.check()?;
    for (name, bytes) in &files {
        output.write(name, bytes)?;
    }
    output.commit()?;
    stage.finish(format!("{} files", files.len()));
    if json {
        print_json(&found)?
    } else {
        print(found.to_string().trim_end())?
    }
    Ok(Outcome::Fine)
}

fn check(args: &Args) -> Result<()> {
    if !(1..=MOST_SAMPLES).contains(&args.samples) {
        return Err(Error::Config(format!("--samples {}: wanted 1 to {MOST_SAMPLES}", args.samples)));
    }
    if args.faces.len() > MOST_SIZES {
        return Err(Error::Config(format!("--faces: {} sizes, wanted at most {MOST_SIZES}", args.faces.len())));
    }
    if let Some(twice) = args.faces.iter().enumerate().find(|(i, f)| args.faces[..*i].contains(f)) {
        return Err(Error::Config(format!("--faces: {} is there twice; name each size once", twice.1)));
    }
    if let Some(twice) = args.methods.iter().enumerate().find(|(i, m)| args.methods[..*i].contains(m)) {
        return Err(Error::Config(format!("--methods: {} is there twice; name each once", twice.1.name())));
    }
    Ok(())
}
