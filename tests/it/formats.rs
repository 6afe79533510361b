//! Hundreds of odd and broken files of other projects, through the program: no panic, no hang, no memory.
//!
//! Every truncation and every flipped byte of small files are tested beside the readers.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rayon::prelude::*;
use rooftile::input::discover::ending;
use rooftile::inspect;

use crate::common::{ROOFTILE, build, data, names, shapes};

/// Nothing in the corpus is larger than 2 MB; a file that takes this long is a hang.
const MOST_TIME: Duration = Duration::from_secs(20);

/// Address space, kB: a process of this program has about 0.3 GB before it reads anything.
const MOST_MEMORY_KB: u32 = 1_300_000;

fn meshes(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let entry = entry.expect("an entry");
        let kind = entry.file_type().expect("a kind");
        if kind.is_dir() {
            meshes(&entry.path(), found);
        } else if kind.is_file() && ending(&entry.path()).is_some() {
            found.push(entry.path());
        }
    }
}

/// Builds a file in a process of limited memory; the exit code, or what was wrong.
fn try_to_build(path: &Path) -> Result<i32, String> {
    let temp = tempfile::tempdir().map_err(|e| e.to_string())?;
    let out = temp.path().join("tiles");
    let script = format!("ulimit -v {MOST_MEMORY_KB}; exec \"$0\" build -q --threads 1 \"$1\" -o \"$2\"");
    let mut child = Command::new("sh")
        .args(["-c", &script, ROOFTILE])
        .args([path, &out])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|e| e.to_string())?;
    let begun = Instant::now();
    let status = loop {
        match child.try_wait().map_err(|e| e.to_string())? {
            Some(status) => break status,
            None if begun.elapsed() > MOST_TIME => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(format!("took more than {MOST_TIME:?}"));
            }
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    let mut said = String::new();
    let pipe = child.stderr.as_mut().ok_or("no standard error")?;
    pipe.read_to_string(&mut said).map_err(|e| format!("said something that is not UTF-8: {e}"))?;
    let code = status.code().ok_or_else(|| format!("ended by {status}: {said}"))?;
    let is_refused = matches!(code, 3 | 4);
    let sentences = said.lines().filter(|l| !l.trim().is_empty()).count();
    let left = names(temp.path());
    match (code, sentences) {
        (0, 0) if left == ["tiles"] => match inspect::check(&out) {
            Ok(findings) if findings.is_empty() => Ok(code),
            other => Err(format!("built, and found wanting: {other:?}")),
        },
        (_, 1) if is_refused && !said.contains("panicked") && left.is_empty() => Ok(code),
        _ => Err(format!("exit code {code}, left {left:?}: {said}")),
    }
}

#[cfg(unix)]
#[test]
fn the_nasty_corpus_is_built_or_refused_in_one_sentence() {
    let Some(folder) = data("nasty") else { return };
    let mut files = Vec::new();
    meshes(&folder, &mut files);
    files.sort();
    assert!(files.len() > 200, "only {} files", files.len());
    let results: Vec<_> = files.par_iter().map(|path| (path, try_to_build(path))).collect();
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    let mut faults = Vec::new();
    for (path, result) in results {
        let kind = ending(path).unwrap_or_default();
        match result {
            Ok(code) => *counts.entry(format!("{kind} exit {code}")).or_default() += 1,
            Err(what) => faults.push(format!("{}: {what}", path.display())),
        }
    }
    eprintln!("nasty: {counts:?}");
    assert!(faults.is_empty(), "{} of {}:\n{}", faults.len(), files.len(), faults.join("\n"));
    assert!(counts.keys().any(|k| k.ends_with("exit 0")) && counts.keys().any(|k| k.ends_with("exit 3")));
}

/// A textured PLY and a glTF in a folder of their own, with texture and buffer in the folder beside it.
fn beside(temp: &Path) -> PathBuf {
    let input = temp.join("in");
    for folder in ["a", "b", "shared"] {
        std::fs::create_dir_all(input.join(folder)).expect("a folder");
    }
    let ply = "ply\nformat ascii 1.0\ncomment TextureFile ../shared/T.PNG\nelement vertex 3\nproperty float x\n\
               property float y\nproperty float z\nproperty float s\nproperty float t\nelement face 1\n\
               property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n9 0 0 1 0\n0 9 0 0 1\n3 0 1 2\n";
    std::fs::write(input.join("a/x.ply"), ply).expect("a file");
    let mut json = shapes::triangle_gltf();
    json["buffers"][0]["uri"] = "../shared/b.bin".into();
    std::fs::write(input.join("b/y.gltf"), json.to_string()).expect("a file");
    std::fs::write(input.join("shared/b.bin"), shapes::triangle_bytes([0, 1, 2])).expect("a file");
    image::RgbImage::new(8, 8).save(input.join("shared/t.png")).expect("an image");
    input
}

#[test]
fn files_of_a_named_folder_may_refer_to_all_of_it_in_every_format() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = beside(temp.path());
    let run = build(&input, &temp.path().join("tiles"), &["--json"]).wants(0);
    assert_eq!(run.json()["warnings"], serde_json::json!([]));
    // Named alone, they may not.
    for file in ["a/x.ply", "b/y.gltf"] {
        let said = build(&input.join(file), &temp.path().join("other"), &[]).wants(3).stderr;
        assert!(said.contains(file) && said.contains("--allow-outside"), "{said}");
        build(&input.join(file), &temp.path().join(file), &["--allow-outside"]).wants(0);
    }
}
