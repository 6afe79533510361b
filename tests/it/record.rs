//! Recording and replaying, by the program and on real scans: what is written is what was simplified, every cut holds
//! what it promises by an oracle of the tests' own, and damage is noticed.

use std::fs;
use std::path::{Path, PathBuf};

use glam::DVec3;
use rooftile::geo::bvh::Bvh;
use rooftile::input::{self, InputConfig};
use rooftile::report::Reporter;
use serde_json::Value;

use crate::common::{Run, data, names, rooftile, shapes};

/// Hills of some thousand triangles, simplified to a few hundred and recorded.
struct Recorded {
    temp: tempfile::TempDir,
    input: PathBuf,
    record: PathBuf,
    run: Run,
}

fn recorded(more: &[&str]) -> Recorded {
    let temp = tempfile::tempdir().expect("a folder");
    let input = shapes::hills(temp.path(), 48);
    let record = temp.path().join("hills.record");
    let run = verb("simplify", &input, &temp.path().join("coarse.ply"), &record_flags(&record, more)).wants(0);
    Recorded { temp, input, record, run }
}

fn record_flags<'a>(record: &'a Path, more: &[&'a str]) -> Vec<&'a str> {
    let mut flags = vec!["--record", record.to_str().expect("UTF-8"), "--faces", "400"];
    flags.extend(more);
    flags
}

fn verb(verb: &str, input: &Path, out: &Path, more: &[&str]) -> Run {
    let (input, out) = (input.to_str().expect("UTF-8"), out.to_str().expect("UTF-8"));
    let mut args = vec![verb, input, "-o", out, "-q", "--json"];
    args.extend(more);
    rooftile(args)
}

fn read(path: &Path) -> (Vec<DVec3>, Vec<[u32; 3]>, Vec<i16>) {
    let (source, _) =
        input::read(&[path.to_path_buf()], &InputConfig::default(), &Reporter::new(true)).expect("a mesh");
    let (mut positions, mut faces, mut labels) = (Vec::new(), Vec::new(), Vec::new());
    for part in source.parts {
        let first = positions.len() as u32;
        positions.extend(part.positions);
        faces.extend(part.faces.iter().map(|f| f.map(|v| v + first)));
        labels.extend(part.face_labels);
    }
    (positions, faces, labels)
}

#[test]
fn a_replay_to_the_same_size_is_the_same_file() {
    let recorded = recorded(&[]);
    let folder = recorded.temp.path();
    for faces in ["400", "900", "37%"] {
        let straight = folder.join("straight.ply");
        let replayed = folder.join("replayed.ply");
        verb("simplify", &recorded.input, &straight, &["--faces", faces, "--no-refit"]).wants(0);
        let report = verb("replay", &recorded.record, &replayed, &["--faces", faces]).wants(0).json();
        assert_eq!(fs::read(&straight).expect("a file"), fs::read(&replayed).expect("a file"), "{faces}");
        let (_, found, _) = read(&replayed);
        assert_eq!(report["faces"], found.len());
    }
    assert_eq!(fs::read(folder.join("coarse.ply")).expect("a file"), {
        verb("replay", &recorded.record, &folder.join("base.ply"), &["--faces", "400"]).wants(0);
        fs::read(folder.join("base.ply")).expect("a file")
    });
}

#[test]
fn cuts_hold_their_limits_and_need_fewer_bytes_the_coarser_they_are() {
    let recorded = recorded(&[]);
    let folder = recorded.temp.path();
    let (source, ..) = read(&recorded.input);
    let all = fs::metadata(&recorded.record).expect("a file").len();
    let out = folder.join("cut.ply");
    let mut faces_before = u64::MAX;
    for limit in ["0.02", "0.1", "0.3"] {
        let metres: f64 = limit.parse().expect("a number");
        let by_error = verb("replay", &recorded.record, &out, &["--error", limit]).wants(0).json();
        let faces = by_error["faces"].as_u64().expect("a number");
        assert!(faces <= faces_before && by_error["bytes_read"].as_u64().expect("a number") <= all);
        faces_before = faces;
        check(&source, &out, &by_error, metres);
        let each = ["terrain", "facade", "roof", "clutter"].map(|c| format!("{c}={limit}")).join(",");
        let by_budget = verb("replay", &recorded.record, &out, &["--budget", &each]).wants(0).json();
        assert!(by_budget["faces"].as_u64().expect("a number") <= faces, "a choice is at least as coarse as a prefix");
        check(&source, &out, &by_budget, metres);
    }
}

/// Every source vertex is within `limit_m` of the mesh, and so are the report's bounds.
fn check(source: &[DVec3], out: &Path, report: &Value, limit_m: f64) {
    let (positions, faces, labels) = read(out);
    assert_eq!(labels.len(), faces.len());
    let bounds = report["bounds_m"].as_object().expect("bounds");
    assert!(bounds.len() == 4 && bounds.values().all(|b| b.as_f64().expect("metres") <= limit_m));
    let surface = Bvh::new(&positions, &faces);
    for (i, p) in source.iter().enumerate() {
        let d = surface.closest(*p, f64::INFINITY).expect("faces").distance;
        // The grids of the gate and of the record move a vertex by up to half a step of 2^-20 m along each axis.
        assert!(d <= limit_m + 2e-6, "vertex {i} is {d} m off, and {limit_m} m are allowed");
    }
}

#[test]
fn a_byte_budget_is_what_is_read() {
    let recorded = recorded(&[]);
    let out = recorded.temp.path().join("cut.obj");
    let all = fs::metadata(&recorded.record).expect("a file").len();
    let mut faces_before = 0;
    for bytes in [all / 2, all * 3 / 4, all] {
        let report = verb("replay", &recorded.record, &out, &["--bytes", &bytes.to_string()]).wants(0).json();
        assert!(report["bytes_read"].as_u64().expect("a number") <= bytes);
        let faces = report["faces"].as_u64().expect("a number");
        assert!(faces >= faces_before);
        faces_before = faces;
    }
    assert_eq!(faces_before, 2 * 48 * 48);
    verb("replay", &recorded.record, &out, &["--bytes", "10"]).wants(2);
}

#[test]
fn wishes_that_cannot_be_met_are_named_and_leave_nothing() {
    let recorded = recorded(&[]);
    let folder = recorded.temp.path();
    let out = folder.join("none.ply");
    let before = names(folder);
    let cases = [
        (&["--faces", "3"][..], 2, "coarsest mesh has"),
        (&["--faces", "0"], 2, "share as in 10%"),
        (&["--budget", "rof=1"], 2, "terrain, facade, roof, clutter"),
        (&["--budget", "roof"], 2, "CLASS=METRES"),
        (&["--budget", "roof=-1"], 2, "metres from 0"),
        (&["--error", "0.1", "--faces", "9"], 2, "cannot be used with"),
    ];
    for (flags, code, says) in cases {
        let run = verb("replay", &recorded.record, &out, flags).wants(code);
        assert!(run.stderr.contains(says), "{flags:?}: {}", run.stderr);
    }
    let stl = folder.join("a.stl");
    assert!(verb("replay", &recorded.record, &stl, &[]).wants(2).stderr.contains(".ply, .obj or .glb"));
    assert!(verb("replay", &recorded.record, &folder.join("no/a.ply"), &[]).wants(5).stderr.contains("does not exist"));
    assert!(verb("replay", &recorded.record, &recorded.record, &[]).wants(2).stderr.contains("wanted a name"));
    assert!(verb("replay", &recorded.input, &out, &[]).wants(3).stderr.contains("is no record"));
    assert!(verb("simplify", &recorded.input, &out, &[]).wants(2).stderr.contains("--faces"));
    let labels = folder.join("labels.txt");
    fs::write(&labels, "1\n2\n").expect("a file");
    let flags = ["--faces", "50%", "--labels", labels.to_str().expect("UTF-8")];
    assert!(verb("simplify", &recorded.input, &out, &flags).wants(3).stderr.contains("2 labels for 4608 triangles"));
    fs::remove_file(&labels).expect("a file");
    assert_eq!(names(folder), before);
}

#[test]
fn a_damaged_record_is_refused_wherever_the_damage_is() {
    let recorded = recorded(&[]);
    let whole = fs::read(&recorded.record).expect("a file");
    let out = recorded.temp.path().join("none.ply");
    let broken = recorded.temp.path().join("broken.record");
    for part in 0..12 {
        let mut bytes = whole.clone();
        let at = (whole.len() - 1) * part / 11;
        bytes[at] ^= 0x10;
        fs::write(&broken, &bytes).expect("a file");
        let run = verb("replay", &broken, &out, &[]).wants(3);
        assert!(run.stderr.contains("broken.record") && run.stderr.lines().count() == 1, "{}", run.stderr);
        fs::write(&broken, &whole[..at]).expect("a file");
        verb("replay", &broken, &out, &[]).wants(3);
    }
    assert!(!out.exists());
}

#[test]
fn labels_say_which_class_a_triangle_is_of_and_every_format_is_written() {
    let recorded = recorded(&[]);
    let folder = recorded.temp.path();
    let labels = folder.join("labels.txt");
    fs::write(&labels, (0..2 * 48 * 48).map(|f| if f < 2304 { "0\n" } else { "2\n" }).collect::<String>())
        .expect("a file");
    let flags = ["--faces", "20%", "--labels", labels.to_str().expect("UTF-8")];
    let ply = folder.join("out.ply");
    verb("simplify", &recorded.input, &ply, &flags).wants(0);
    let (_, _, found) = read(&ply);
    assert!(found.contains(&0) && found.contains(&2) && found.iter().all(|l| [0, 2].contains(l)));
    for name in ["out.obj", "out.glb"] {
        verb("simplify", &recorded.input, &folder.join(name), &flags).wants(0);
        assert_eq!(read(&folder.join(name)).1.len(), found.len(), "{name}");
    }
}

#[test]
fn the_report_counts_what_was_written() {
    let recorded = recorded(&[]);
    let report = recorded.run.json();
    assert_eq!(report["record_bytes"], fs::metadata(&recorded.record).expect("a file").len());
    assert_eq!(report["source_faces"], 2 * 48 * 48);
    let faces = report["faces"].as_u64().expect("a number");
    assert!((398..=400).contains(&faces), "{faces}");
}

#[test]
fn a_real_building_takes_few_bytes_a_triangle() {
    let Some(input) = data("agi-hq").map(|folder| folder.join("agi_hq.obj")) else { return };
    let temp = tempfile::tempdir().expect("a folder");
    let record = temp.path().join("hq.record");
    let out = temp.path().join("hq.ply");
    for (method, most) in [("half-edge", 3.6), ("semantic", 5.3)] {
        let flags = ["--faces", "1%", "--grid", "0.01", "--method", method, "--record"];
        let report = verb("simplify", &input, &out, &[&flags[..], &[record.to_str().expect("UTF-8")]].concat());
        let report = report.wants(0).json();
        let replayed = temp.path().join("replayed.ply");
        verb("replay", &record, &replayed, &["--faces", "1%"]).wants(0);
        assert_eq!(fs::read(&out).expect("a file"), fs::read(&replayed).expect("a file"));
        let number = |name: &str| report[name].as_f64().expect("a number");
        let each = number("record_bytes") / number("source_faces");
        eprintln!("{method}: {each:.2} bytes a source triangle");
        assert!(each < most, "{method}: {each} bytes a source triangle");
    }
}
