//! One error type, split by whose problem it is; every variant has a designed exit code.

use std::path::{Path, PathBuf};

/// The crate's result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What stopped a command. A message says where, what was found, what was wanted, and what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The input is broken: the user has to mend or replace it.
    #[error("{}{}: {what}", path.display(), place(*at))]
    Input {
        /// The file.
        path: PathBuf,
        /// Where in the file.
        at: Place,
        /// What was found, what was wanted, and what to do, in one clause.
        what: String,
    },
    /// The input is sound but asks for something that is not read.
    #[error("{}: {what}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What it asks for and what to do instead.
        what: String,
    },
    /// The command line or the configuration is wrong.
    #[error("{0}")]
    Config(String),
    /// A limit was reached that is there to protect the machine.
    #[error("{}: {what}", path.display())]
    Limit {
        /// The file that would pass the limit.
        path: PathBuf,
        /// Value found, limit, and how to raise it.
        what: String,
    },
    /// The output exists or another run holds it.
    #[error("{}: {what}", path.display())]
    Output {
        /// The output.
        path: PathBuf,
        /// Why it is refused and what to do.
        what: String,
    },
    /// The operating system refused; trying again may help.
    #[error("{}: cannot {action}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// `read`, `create`, `rename`, …
        action: &'static str,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The user asked to stop.
    #[error("stopped by signal {signal}; {}", left(*resumable))]
    Cancelled {
        /// 2 (SIGINT) or 15 (SIGTERM).
        signal: i32,
        /// What was done so far is kept for `--resume`.
        resumable: bool,
    },
    /// A promise of ours was broken.
    #[error("internal error, please report it: {0}")]
    Bug(String),
}

/// Where in a file something was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// The file as a whole.
    File,
    /// A line, from 1.
    Line(u64),
    /// A byte offset, from 0.
    Byte(u64),
}

fn left(resumable: bool) -> &'static str {
    if resumable {
        "the work so far is kept: the same command with --resume goes on from there, without it the build begins afresh"
    } else {
        "nothing was left behind"
    }
}

fn place(at: Place) -> String {
    match at {
        Place::File => String::new(),
        Place::Line(line) => format!(", line {line}"),
        Place::Byte(byte) => format!(", byte {byte}"),
    }
}

impl Error {
    /// A refusal of the file as a whole.
    pub fn input(path: impl Into<PathBuf>, what: impl Into<String>) -> Self {
        Self::Input { path: path.into(), at: Place::File, what: what.into() }
    }

    /// A refusal that names a place in the file.
    pub fn input_at(path: impl Into<PathBuf>, at: Place, what: impl Into<String>) -> Self {
        Self::Input { path: path.into(), at, what: what.into() }
    }

    /// Wraps an I/O error with its path; for `map_err(Error::io("read", path))`.
    pub fn io(action: &'static str, path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_path_buf();
        move |source| Self::Io { path, action, source }
    }

    /// The process exit code of this error.
    ///
    /// 1 is left to findings (a check that failed), 0 to success.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Config(_) => 2,
            Self::Input { .. } | Self::Unsupported { .. } => 3,
            Self::Limit { .. } => 4,
            Self::Output { .. } => 5,
            // A path that is simply not there is the user's to mend, not worth a retry.
            Self::Io { source, action: "read", .. } if source.kind() == std::io::ErrorKind::NotFound => 3,
            Self::Io { .. } => 6,
            Self::Bug(_) => 7,
            Self::Cancelled { signal, .. } => 128 + *signal as u8,
        }
    }
}
