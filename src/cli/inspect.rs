//! `rooftile inspect`.

use std::path::{Path, PathBuf};

use super::{Outcome, print, print_json};
use crate::input::{self, InputConfig};
use crate::report::Reporter;
use crate::{Result, inspect};

#[derive(clap::Args)]
pub struct Args {
    /// A tileset (its folder or tileset.json), or an input as for `build`.
    #[arg(value_name = "X")]
    path: PathBuf,
    /// Follow paths in an input that lead out of its folder.
    #[arg(long)]
    allow_outside: bool,
}

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    if is_tileset(&args.path) {
        return tileset(&args.path, json);
    }
    let read = InputConfig { allow_outside: args.allow_outside, root: None };
    let (source, _) = input::read(std::slice::from_ref(&args.path), &read, reporter)?;
    let summary = inspect::source(&source);
    let warnings = reporter.warnings();
    if json {
        print_json(&serde_json::json!({ "input": summary, "warnings": warnings }))?;
        return Ok(Outcome::Fine);
    }
    print(summary.to_string().trim_end())?;
    warnings.iter().try_for_each(|w| print(&format!("warning    {} × {}: {}", w.count, w.code, w.first)))?;
    Ok(Outcome::Fine)
}

fn is_tileset(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) || path.join("tileset.json").is_file()
}

/// Findings make the exit code 1, so that a script can stop on them.
fn tileset(path: &Path, json: bool) -> Result<Outcome> {
    let summary = inspect::tileset(path)?;
    let findings = inspect::check(path)?;
    if json {
        print_json(&serde_json::json!({ "tileset": summary, "findings": findings }))?;
    } else {
        print(summary.to_string().trim_end())?;
        findings.iter().try_for_each(|f| print(&f.to_string()))?;
    }
    let broken = findings.iter().any(|f| f.severity == inspect::Severity::Error);
    Ok(if broken { Outcome::Findings } else { Outcome::Fine })
}
