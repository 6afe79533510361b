//! Where stages speak: counted warnings, one line a stage, progress, and the wish to stop.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, Mutex};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use crate::store::memory;
use crate::{Error, Result};

/// The signal that asked this process to stop, 0 while none has.
pub static STOP_SIGNAL: LazyLock<Arc<AtomicUsize>> = LazyLock::new(Arc::default);

/// One kind of warning, with the first place it was seen.
#[derive(Debug, Clone, Serialize)]
pub struct Warning {
    /// Stable name, for instance `missing-texture`.
    pub code: &'static str,
    /// How often it was seen.
    pub count: u64,
    /// The first file it was seen in.
    pub first_path: PathBuf,
    /// The first message, whole.
    pub first: String,
}

/// One finished stage.
#[derive(Debug, Clone, Serialize)]
pub struct StageTime {
    /// The stage's name, as in the pipeline.
    pub stage: &'static str,
    /// Wall time.
    pub seconds: f64,
    /// What it did, in one line of numbers.
    pub summary: String,
}

/// Collects what a run has to say. Shared by reference between threads.
pub struct Reporter {
    quiet: bool,
    warnings: Mutex<BTreeMap<&'static str, Warning>>,
    stages: Mutex<Vec<StageTime>>,
    started: Instant,
}

impl Reporter {
    /// Speaks on standard error unless `quiet`.
    pub fn new(quiet: bool) -> Self {
        Self { quiet, warnings: Mutex::default(), stages: Mutex::default(), started: Instant::now() }
    }

    /// Counts a warning; only the first of a `code` is kept whole.
    pub fn warn(&self, code: &'static str, path: &Path, what: impl Into<String>) {
        self.warn_many(code, path, 1, what);
    }

    /// Counts `count` warnings of one kind at once; does nothing for 0.
    pub fn warn_many(&self, code: &'static str, path: &Path, count: u64, what: impl Into<String>) {
        if count == 0 {
            return;
        }
        let mut warnings = self.warnings.lock().unwrap_or_else(|e| e.into_inner());
        let entry = warnings.entry(code);
        if let std::collections::btree_map::Entry::Occupied(mut seen) = entry {
            seen.get_mut().count += count;
            return;
        }
        entry.or_insert(Warning { code, count, first_path: path.to_path_buf(), first: what.into() });
    }

    /// All warnings, by code.
    pub fn warnings(&self) -> Vec<Warning> {
        self.warnings.lock().unwrap_or_else(|e| e.into_inner()).values().cloned().collect()
    }

    /// Stages finished so far, in order.
    pub fn stages(&self) -> Vec<StageTime> {
        self.stages.lock().unwrap_or_else(|e| e.into_inner()).clone()
    }

    /// Seconds since this reporter was made.
    pub fn elapsed_s(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Begins a stage of `total` steps (0: unknown); a bar with an ETA on a terminal.
    pub fn stage(&self, name: &'static str, total: u64) -> Stage<'_> {
        use std::io::IsTerminal;
        let bar = if self.quiet || !std::io::stderr().is_terminal() {
            ProgressBar::hidden()
        } else if total == 0 {
            let bar = ProgressBar::new_spinner();
            bar.set_style(template("{spinner} {msg:10} {elapsed}"));
            bar
        } else {
            let bar = ProgressBar::new(total);
            bar.set_style(template("{msg:10} {wide_bar} {pos}/{len} eta {eta} {prefix}"));
            bar
        };
        bar.set_message(name);
        bar.enable_steady_tick(Duration::from_millis(200));
        Stage { reporter: self, name, bar, started: Instant::now() }
    }

    /// An error if the user asked to stop; stages call it between steps.
    ///
    /// # Errors
    /// [`Error::Cancelled`] after SIGINT or SIGTERM.
    pub fn check(&self) -> Result<()> {
        match STOP_SIGNAL.load(Ordering::Relaxed) {
            0 => Ok(()),
            signal => Err(Error::Cancelled { signal: signal as i32, resumable: false }),
        }
    }

    /// A line for people, on standard error.
    pub fn say(&self, line: &str) {
        if !self.quiet {
            // Nobody reading (`2>&1 | head -1`) is no reason to fail, let alone to panic as `eprintln` does.
            let _ = writeln!(std::io::stderr(), "{line}");
        }
    }
}

fn template(text: &str) -> ProgressStyle {
    ProgressStyle::with_template(text).unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// A running stage; see [`Reporter::stage`].
pub struct Stage<'a> {
    reporter: &'a Reporter,
    name: &'static str,
    bar: ProgressBar,
    started: Instant,
}

impl Stage<'_> {
    /// One step further. May be called from any thread.
    pub fn step(&self, steps: u64) {
        self.bar.inc(steps);
        if let Some(bytes) = memory::in_use().filter(|_| !self.bar.is_hidden()) {
            self.bar.set_prefix(format!("{} MB", bytes / 1_000_000));
        }
    }

    /// Ends the stage with its one line of numbers.
    pub fn finish(self, summary: String) {
        let seconds = self.started.elapsed().as_secs_f64();
        self.finish_after(seconds, summary);
    }

    /// Ends a stage that others took turns with, and that took `seconds` itself.
    pub fn finish_after(self, seconds: f64, summary: String) {
        self.bar.finish_and_clear();
        self.reporter.say(&format!("{:10} {summary} ({seconds:.1} s)", self.name));
        let mut stages = self.reporter.stages.lock().unwrap_or_else(|e| e.into_inner());
        stages.push(StageTime { stage: self.name, seconds, summary });
    }
}
