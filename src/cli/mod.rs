//! The command line: arguments as typed, then as meant; one file a verb.
//!
//! Data goes to standard output, people's text to standard error; `--json` prints one object. Exit codes are those of
//! [`Error::exit_code`], and 1 for findings.

mod audit;
mod build;
mod compare;
mod demo;
mod experiment;
mod inspect;
mod label;
mod look;
mod replay;
mod serve;
mod simplify;

use std::io::Write;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::report::{Reporter, STOP_SIGNAL};
use crate::{Error, Result};

/// Turns heavy photogrammetry meshes into 3D Tiles 1.1 with a measured geometric error per class.
#[derive(Parser)]
#[command(version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
    #[command(flatten)]
    common: Common,
}

/// Options of every verb.
#[derive(clap::Args)]
struct Common {
    /// Print one JSON object on standard output.
    #[arg(long, global = true)]
    json: bool,
    /// Say nothing but errors.
    #[arg(short, long, global = true)]
    quiet: bool,
    /// Worker threads; the output does not depend on it. Default: one for each processor.
    #[arg(long, global = true, value_name = "N")]
    threads: Option<usize>,
}

#[derive(Subcommand)]
enum Verb {
    /// Generate a synthetic city quarter with known classes, build its tileset, check it, and say how to look at it.
    Demo(demo::Args),
    /// Turn OBJ, glTF or PLY into a 3D Tiles 1.1 tileset.
    Build(Box<build::Args>),
    /// Say which faces are terrain, facade, roof or clutter, and why; compare with labels, draw figures, tune.
    Label(Box<label::Args>),
    /// Simplify a mesh by collapsing edges within the budgets of its classes, and record how.
    Simplify(Box<simplify::Args>),
    /// Take a mesh of any size or error out of a record.
    Replay(replay::Args),
    /// Serve a tileset and a page that shows it in CesiumJS.
    Serve(serve::Args),
    /// Say in numbers what is in an input or a tileset, and what is wrong with a tileset.
    Inspect(inspect::Args),
    /// Measure the errors of anybody's tileset, and say what is wrong with it.
    Audit(Box<audit::Args>),
    /// Measure how far simplified meshes are from their original, in all and per class.
    Compare(compare::Args),
    /// Repeat the paper's experiment on a mesh: methods at equal sizes and at equal accuracy, as numbers and figures.
    Experiment(experiment::Args),
}

/// Whether a verb found something to complain of.
pub(crate) enum Outcome {
    /// All is well.
    Fine,
    /// Exit code 1.
    Findings,
}

/// Runs the command line and returns the process's exit code.
pub fn run() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            let _ = error.print();
            // Help and version are answers, not errors.
            return ExitCode::from(if error.use_stderr() { 2 } else { 0 });
        }
    };
    match catch_signals().and_then(|()| dispatch(cli)) {
        Ok(Outcome::Fine) => ExitCode::SUCCESS,
        Ok(Outcome::Findings) => ExitCode::from(1),
        Err(error) => {
            explain(&error);
            ExitCode::from(error.exit_code())
        }
    }
}

fn dispatch(cli: Cli) -> Result<Outcome> {
    let Common { json, quiet, threads } = cli.common;
    if let Some(threads) = threads {
        if !(1..=1024).contains(&threads) {
            return Err(Error::Config(format!("--threads {threads}: wanted 1 to 1024")));
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
        pool.map_err(|e| Error::Config(format!("--threads {threads}: {e}")))?;
    }
    let reporter = Reporter::new(quiet);
    match cli.verb {
        Verb::Demo(args) => demo::run(&args, json, &reporter),
        Verb::Build(args) => build::run(&args, json, &reporter),
        Verb::Label(args) => label::run(&args, json, &reporter),
        Verb::Simplify(args) => simplify::run(&args, json, &reporter),
        Verb::Replay(args) => replay::run(&args, json, &reporter),
        Verb::Serve(args) => serve::run(&args, &reporter),
        Verb::Inspect(args) => inspect::run(&args, json, &reporter),
        Verb::Audit(args) => audit::run(&args, json, &reporter),
        Verb::Compare(args) => compare::run(&args, json, &reporter),
        Verb::Experiment(args) => experiment::run(&args, json, &reporter),
    }
}

/// The first SIGINT or SIGTERM asks the stages to stop and clean up; the second ends the process at once.
fn catch_signals() -> Result<()> {
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        let asked = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
        let hooks = signal_hook::flag::register_conditional_default(signal, asked.clone())
            .and_then(|_| signal_hook::flag::register(signal, asked))
            .and_then(|_| signal_hook::flag::register_usize(signal, STOP_SIGNAL.clone(), signal as usize));
        hooks.map_err(|e| Error::Bug(format!("signal {signal}: {e}")))?;
    }
    Ok(())
}

fn explain(error: &Error) {
    let mut text = format!("rooftile: {error}");
    let mut source = std::error::Error::source(error);
    while let Some(cause) = source {
        text.push_str(&format!(": {cause}"));
        source = cause.source();
    }
    // Not `eprintln`, which panics when nobody reads: the exit code has to stay.
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Prints a line of data; a reader that went away is no error.
pub(crate) fn print(text: &str) -> Result<()> {
    match writeln!(std::io::stdout(), "{text}") {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::io("write", "standard output")(e)),
        _ => Ok(()),
    }
}

pub(crate) fn print_json(value: &impl serde::Serialize) -> Result<()> {
    print(&serde_json::to_string(value).map_err(|e| Error::Bug(format!("report: {e}")))?)
}
