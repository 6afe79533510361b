//! A build that was killed goes on where it was, and the bytes are those of one that was not.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use crate::common::{build, command, files, names, shapes};

const PATIENCE: Duration = Duration::from_secs(300);
/// Many cells and windows from a small input.
const SETS: [&str; 8] = [
    "--set",
    "levels.leaf_faces=1200",
    "--set",
    "levels.tile_faces=1200",
    "--set",
    "levels.window_faces=6000",
    "--set",
    "levels.reference_faces=9000",
];

/// Files whose borders agree to within the tolerance: hills, and the same mirrored beside them, and, if `more`, once more
/// beside those.
fn input(folder: &Path, more: bool) -> PathBuf {
    let hills = shapes::hills(&folder.join("in/a"), 90);
    let text = std::fs::read_to_string(&hills).expect("a file");
    let mirrored: String = text
        .lines()
        .map(|line| match line.strip_prefix("v ").and_then(|rest| rest.split_once(' ')) {
            Some((x, rest)) => format!("v {} {rest}\n", 90.0 * 2.0 - x.parse::<f64>().expect("a number") + 0.0004),
            None => match line.strip_prefix("f ") {
                // A mirrored face turns over: the other way round it looks up again.
                Some(face) => format!("f {}\n", face.split(' ').rev().collect::<Vec<_>>().join(" ")),
                None => format!("{line}\n"),
            },
        })
        .collect();
    std::fs::create_dir_all(folder.join("in/b")).expect("a folder");
    std::fs::write(folder.join("in/b/hills.obj"), mirrored).expect("a file");
    if more {
        let beside = |line: &str| match line.strip_prefix("v ").and_then(|rest| rest.split_once(' ')) {
            Some((x, rest)) => format!("v {} {rest}\n", x.parse::<f64>().expect("a number") + 180.0008),
            None => format!("{line}\n"),
        };
        std::fs::create_dir_all(folder.join("in/c")).expect("a folder");
        std::fs::write(folder.join("in/c/hills.obj"), text.lines().map(beside).collect::<String>()).expect("a file");
    }
    folder.join("in")
}

/// Starts a build, kills it as soon as `page` is in its work folder; false if it ended before.
#[cfg(unix)]
fn killed_at(input: &Path, out: &Path, page: &str) -> bool {
    let Some(mut run) = begun(input, out, page) else { return false };
    run.kill().expect("a kill");
    run.wait().expect("an end");
    true
}

/// A build that has written `page`; none if it ended before that was seen.
#[cfg(unix)]
fn begun(input: &Path, out: &Path, page: &str) -> Option<Child> {
    let mut args = SETS.to_vec();
    args.extend(["-q", "--threads", "1", "--resume"]);
    let mut run = command();
    run.arg("build").arg(input).arg("-o").arg(out).args(args).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut run = run.spawn().expect("the program starts");
    let page = out.with_file_name(".out.work").join(page);
    let begun = Instant::now();
    while !page.exists() {
        if run.try_wait().expect("a state").is_some() {
            return None;
        }
        assert!(begun.elapsed() < PATIENCE, "{} never came", page.display());
        std::thread::sleep(Duration::from_millis(1));
    }
    Some(run)
}

fn whole(input: &Path, out: &Path, more: &[&str]) -> BTreeMap<PathBuf, Option<Vec<u8>>> {
    build(input, out, &[&SETS[..], more].concat()).wants(0);
    files(out)
}

#[cfg(unix)]
#[test]
fn a_build_killed_again_and_again_ends_with_the_same_bytes() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = input(temp.path(), false);
    let wanted = whole(&input, &temp.path().join("whole"), &[]);
    assert!(wanted.len() > 20, "{:?}", wanted.keys());
    let out = temp.path().join("out");
    let mut kills = 0;
    for page in [
        "raw/0",
        "source/9",
        "ingest.json",
        "labels/window-0.json",
        "step/0.json",
        "step/4.json",
        "surface",
        "tile/3.json",
        "tile/30.json",
    ] {
        kills += u32::from(killed_at(&input, &out, page));
        assert!(!out.exists(), "an unfinished output appeared after {page}");
    }
    assert!(kills >= 6, "{kills} kills");
    assert!(names(temp.path()).contains(&".out.work".to_owned()), "nothing was kept");
    let resumed = whole(&input, &out, &["--resume"]);
    assert_eq!(resumed.keys().collect::<Vec<_>>(), wanted.keys().collect::<Vec<_>>());
    for (path, bytes) in &wanted {
        assert!(resumed[path] == *bytes, "{} differs", path.display());
    }
    assert_eq!(names(temp.path()), ["in", "out", "whole"], "something was left behind");
}

#[cfg(unix)]
#[test]
fn ctrl_c_keeps_the_work_and_says_how_to_go_on() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = input(temp.path(), false);
    let wanted = whole(&input, &temp.path().join("whole"), &[]);
    let out = temp.path().join("out");
    let stopped = |page: &str| {
        let run = begun(&input, &out, page).expect("a build that is not done");
        let kill = std::process::Command::new("kill").args(["-INT", &run.id().to_string()]).status();
        assert!(kill.expect("kill runs").success());
        let end = run.wait_with_output().expect("an end");
        (end.status.code(), String::from_utf8_lossy(&end.stderr).into_owned())
    };
    let (code, said) = stopped("labels/window-0.json");
    assert_eq!(code, Some(130), "{said}");
    assert!(said.contains("with --resume goes on") && said.contains("begins afresh"), "{said}");
    assert_eq!(names(temp.path()), [".out.work", "in", "whole"]);
    assert!(temp.path().join(".out.work/labels/window-0.json").exists(), "nothing was kept");
    assert!(whole(&input, &out, &["--resume"]) == wanted);
    assert_eq!(names(temp.path()), ["in", "out", "whole"], "something was left behind");
    // Without it, afresh, and with nothing left of the old work.
    std::fs::remove_dir_all(&out).expect("a removal");
    assert_eq!(stopped("step/0.json").0, Some(130));
    assert!(whole(&input, &out, &[]) == wanted);
    assert_eq!(names(temp.path()), ["in", "out", "whole"], "something was left behind");
}

#[cfg(unix)]
#[test]
fn work_of_other_inputs_or_settings_is_not_taken_over() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = input(temp.path(), false);
    let out = temp.path().join("out");
    assert!(killed_at(&input, &out, "step/0.json"));
    let hills = shapes::hills(&temp.path().join("other"), 60);
    let wanted = whole(&hills, &temp.path().join("whole"), &[]);
    let resumed = whole(&hills, &out, &["--resume"]);
    assert!(resumed == wanted);
}

#[test]
fn neither_memory_nor_threads_show_in_the_bytes() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = input(temp.path(), false);
    let one = whole(&input, &temp.path().join("one"), &["--threads", "1", "--memory", "1.5GB"]);
    let two = whole(&input, &temp.path().join("two"), &["--threads", "3", "--memory", "8GiB"]);
    assert!(one == two);
    for (bad, word) in [("12MB", "1.5GB"), ("lots", "2GB")] {
        let run = build(&input, &temp.path().join("three"), &["--memory", bad]).wants(2);
        assert!(run.stderr.contains(word), "{}", run.stderr);
    }
}

#[test]
fn files_that_almost_meet_are_welded() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = input(temp.path(), true);
    let run = build(&input, &temp.path().join("out"), &[&SETS[..], &["--json"]].concat()).wants(0).json();
    let joined = run["gate"]["joined"].as_u64().expect("a count");
    assert!((182..300).contains(&joined), "2 × 91 vertices of common borders, and where walls cut them: {joined}");
    assert_eq!(run["gate"]["faces"], 6 * 90 * 90);
    assert_eq!(run["gate"]["unmatched_m"], 0.0);
    // A gap that no weld closes.
    let cracked =
        build(&input, &temp.path().join("cracked"), &[&SETS[..], &["--json", "--set", "gate.weld_m=0.0001"]].concat());
    let cracked = cracked.wants(0).json();
    let unmatched_m = cracked["gate"]["unmatched_m"].as_f64().expect("a length");
    assert!((300.0..500.0).contains(&unmatched_m), "both sides of two borders of 90 m and their hills: {unmatched_m}");
    assert_eq!(cracked["warnings"][0]["code"], "cracks-between-files");
}

#[cfg(unix)]
#[test]
fn a_full_disk_ends_in_6_and_the_work_is_kept() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = input(temp.path(), false);
    let wanted = whole(&input, &temp.path().join("whole"), &[]);
    let out = temp.path().join("out");
    // No file may be larger than 350 kB: what the system answers then differs from a full disk in its number only.
    let mut shell = std::process::Command::new("sh");
    shell.args(["-c", "trap '' XFSZ; ulimit -f 700; exec \"$0\" \"$@\"", crate::common::ROOFTILE, "build"]);
    let run = shell.arg(&input).arg("-o").arg(&out).args(SETS).arg("-q").output().expect("a shell");
    let said = String::from_utf8_lossy(&run.stderr);
    assert_eq!(run.status.code(), Some(6), "{said}");
    assert!(said.contains("cannot write"), "{said}");
    assert_eq!(names(temp.path()), [".out.work", "in", "whole"]);
    assert!(whole(&input, &out, &["--resume"]) == wanted);
}
