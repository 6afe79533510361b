//! What the tests share: running the program, looking at folders, the demo tileset.

pub mod glb;
pub mod shapes;
pub mod town;

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use serde_json::Value;

/// The program as built for these tests.
pub const ROOFTILE: &str = env!("CARGO_BIN_EXE_rooftile");

/// What a finished run left.
pub struct Run {
    /// Exit code; -1 if a signal ended the process.
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

impl From<Output> for Run {
    fn from(output: Output) -> Self {
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("the program speaks UTF-8");
        Self { code: output.status.code().unwrap_or(-1), stdout: text(output.stdout), stderr: text(output.stderr) }
    }
}

impl Run {
    /// Requires an exit code; shows what was said if it is another one.
    #[track_caller]
    pub fn wants(self, code: i32) -> Self {
        assert_eq!(self.code, code, "stderr: {}\nstdout: {}", self.stderr, self.stdout);
        self
    }

    /// Standard output as the one JSON object it has to be.
    #[track_caller]
    pub fn json(&self) -> Value {
        let value: Value = serde_json::from_str(&self.stdout).expect("standard output is one JSON value");
        assert!(value.is_object(), "{}", self.stdout);
        value
    }
}

/// The program, ready to be given arguments.
pub fn command() -> Command {
    let mut command = Command::new(ROOFTILE);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Runs the program to its end.
pub fn rooftile<A: AsRef<OsStr>>(args: impl IntoIterator<Item = A>) -> Run {
    command().args(args).output().expect("the program starts").into()
}

/// `rooftile build INPUT -o OUT -q` and more arguments.
pub fn build(input: &Path, out: &Path, more: &[&str]) -> Run {
    command()
        .arg("build")
        .arg(input)
        .arg("-o")
        .arg(out)
        .arg("-q")
        .args(more)
        .output()
        .expect("the program starts")
        .into()
}

/// All names in a folder, hidden ones too, sorted.
pub fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).expect("the folder can be listed");
    let mut names: Vec<String> =
        entries.map(|e| e.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// All files below a folder by their relative path, with their bytes; folders have none.
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Option<Vec<u8>>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_path_buf()];
    while let Some(at) = open.pop() {
        for name in names(&at) {
            let path = at.join(name);
            let kind = std::fs::symlink_metadata(&path).expect("an entry").file_type();
            let relative = path.strip_prefix(folder).expect("inside").to_path_buf();
            if kind.is_dir() {
                open.push(path);
                found.insert(relative, None);
            } else if kind.is_file() {
                found.insert(relative, Some(std::fs::read(&path).expect("a file")));
            } else {
                found.insert(relative, None);
            }
        }
    }
    found
}

/// A folder of `ROOFTILE_DATA`. Without it: `None` and a loud line, or a failure in CI.
pub fn data(name: &str) -> Option<PathBuf> {
    let found = std::env::var_os("ROOFTILE_DATA").map(|root| PathBuf::from(root).join(name)).filter(|p| p.is_dir());
    if found.is_none() {
        assert!(std::env::var_os("CI").is_none(), "ROOFTILE_DATA has no {name}, and CI may not skip it");
        eprintln!("SKIPPED: no folder {name} in ROOFTILE_DATA");
    }
    found
}
