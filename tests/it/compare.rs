//! `rooftile compare` from outside: shapes whose figures are known in closed form, labels, refusals.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::common::{data, rooftile};

fn temp() -> tempfile::TempDir {
    tempfile::tempdir().expect("a folder")
}

/// A grid of n × n unit squares at the heights `z` gives, as text PLY, with a label a face if wanted.
fn grid(path: PathBuf, n: usize, z: impl Fn(usize, usize) -> f64, label: Option<fn(usize) -> i32>) -> PathBuf {
    let row = n + 1;
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         element face {}\nproperty list uchar int vertex_indices\n{}end_header\n",
        row * row,
        2 * n * n,
        if label.is_some() { "property int label\n" } else { "" }
    );
    for i in 0..row * row {
        writeln!(text, "{} {} {}", i % row, i / row, z(i % row, i / row)).expect("text");
    }
    for i in 0..n * n {
        let a = i / n * row + i % n;
        for (k, [p, q]) in [[a + 1, a + 1 + row], [a + 1 + row, a + row]].into_iter().enumerate() {
            let label = label.map(|of| of(2 * i + k).to_string()).unwrap_or_default();
            writeln!(text, "3 {a} {p} {q} {label}").expect("text");
        }
    }
    fs::write(&path, text).expect("a file");
    path
}

fn compare(args: &[&Path]) -> Value {
    let fixed = ["compare", "-q", "--json", "--samples", "20000"].map(std::ffi::OsStr::new);
    rooftile(fixed.into_iter().chain(args.iter().map(|a| a.as_os_str()))).wants(0).json()
}

#[track_caller]
fn is(value: &Value, wanted: f64, within: f64) {
    let found = value.as_f64().unwrap_or(f64::NAN);
    assert!((found - wanted).abs() <= within, "{value}, wanted {wanted}");
}

#[test]
fn several_simplified_meshes_are_measured_against_one_reference() {
    let temp = temp();
    let reference = grid(temp.path().join("ref.ply"), 6, |_, _| 0.0, None);
    let low = grid(temp.path().join("low.ply"), 6, |_, _| -0.25, None);
    let high = grid(temp.path().join("high.ply"), 6, |_, _| 0.5, None);
    let report = compare(&[&reference, &low, &high]);
    is(&report["reference"]["diagonal_m"], 72f64.sqrt(), 1e-12);
    let [low, high] = &report["simplified"].as_array().expect("a list")[..] else { panic!("two") };
    for (one, height, side, other) in
        [(low, 0.25, "inside_seen_m", "outside_seen_m"), (high, 0.5, "outside_seen_m", "inside_seen_m")]
    {
        for direction in ["reference_to_simplified", "simplified_to_reference", "two_sided"] {
            is(&one["all"][direction]["mean_m"], height, 1e-9);
            is(&one["all"][direction]["p99_rel"], height / 72f64.sqrt(), 1e-9);
            is(&one["all"]["hausdorff"][direction]["lower_m"], height, 1e-9);
            is(&one["all"]["hausdorff"][direction]["upper_m"], height, 1e-6);
        }
        is(&one["all"]["signed"][side], height, 1e-9);
        is(&one["all"]["signed"][other], 0.0, 0.0);
        is(&one["all"]["paper"]["eq17_mean_m"], height, 1e-9);
        is(&one["all"]["paper"]["eq18_as_printed_sqrt_m"], height.sqrt(), 1e-9);
        is(&one["face_share"], 1.0, 0.0);
        assert_eq!(one["by_class"].as_array().map(Vec::len), Some(0));
        assert_eq!(one["quality"]["border_edges"], 24);
    }
}

#[test]
fn classes_come_from_the_reference_or_from_a_file_and_have_names_where_they_are_ours() {
    let temp = temp();
    let bump = |x: usize, y: usize| if (x, y) == (2, 2) { 0.4 } else { 0.0 };
    let halves = |f: usize| if f < 36 { 0 } else { 2 };
    let labelled = grid(temp.path().join("ref.ply"), 6, bump, Some(halves));
    let plain = grid(temp.path().join("plain.ply"), 6, bump, None);
    let flat = grid(temp.path().join("flat.ply"), 6, |_, _| 0.0, None);
    let own = compare(&[&labelled, &flat]);
    let classes = own["simplified"][0]["by_class"].as_array().expect("classes");
    assert_eq!(own["reference"]["classes"][1]["name"], "roof");
    assert_eq!((classes.len(), &classes[0]["reference_faces"]), (2, &Value::from(36)));
    is(&classes[0]["hausdorff"]["two_sided"]["lower_m"], 0.4, 1e-9);
    // Points within the tolerance of being nearest to the other class count for both.
    let tolerance_m = own["tolerance_m"].as_f64().expect("a number");
    is(&classes[1]["hausdorff"]["two_sided"]["lower_m"], 0.0, tolerance_m);
    // The same classes from a file of faces, of vertices, and from another PLY.
    let faces = temp.path().join("faces.txt");
    fs::write(&faces, (0..72).map(|f| format!("{}\n", halves(f))).collect::<String>()).expect("a file");
    let vertices = temp.path().join("vertices.txt");
    fs::write(&vertices, (0..49).map(|v| if v < 28 { "0\n" } else { "2\n" }).collect::<String>()).expect("a file");
    for file in [&faces, &vertices, &labelled] {
        let from_file = compare(&[&plain, &flat, Path::new("--labels"), file]);
        let part = &from_file["simplified"][0]["by_class"][0]["hausdorff"]["two_sided"]["lower_m"];
        is(part, 0.4, 1e-9);
    }
    // Another numbering keeps its numbers.
    fs::write(&faces, (0..72).map(|f| format!("{}\n", halves(f) - 1)).collect::<String>()).expect("a file");
    let other = compare(&[&plain, &flat, Path::new("--labels"), &faces]);
    assert_eq!(other["reference"]["classes"][0]["name"], "unlabelled");
    assert_eq!(other["reference"]["classes"][1]["name"], "label 1");
}

#[test]
fn the_table_is_for_people_and_fits_a_screen() {
    let temp = temp();
    let reference = grid(temp.path().join("ref.ply"), 6, |_, _| 0.0, Some(|f| i32::from(f > 30)));
    let other = grid(temp.path().join("other.ply"), 3, |_, _| 0.1, None);
    let args = [Path::new("compare"), &reference, &other, &other, Path::new("--samples"), Path::new("500")];
    let run = rooftile(args).wants(0);
    assert!(run.stdout.lines().count() <= 24, "{}", run.stdout);
    for line in run.stdout.lines().filter(|l| !l.contains("ply")) {
        assert!(line.chars().count() <= 130, "{line}");
    }
    for word in ["terrain", "facade", "all", "Eq.17", "p99", "25.00 %"] {
        assert!(run.stdout.contains(word), "{word}: {}", run.stdout);
    }
}

#[test]
fn what_does_not_fit_is_refused_in_a_sentence() {
    let temp = temp();
    let reference = grid(temp.path().join("ref.ply"), 6, |_, _| 0.0, None);
    let labels = temp.path().join("labels.txt");
    let path = |p: &Path| p.to_str().expect("UTF-8").to_owned();
    let run = |more: &[&str]| {
        let base = ["compare".to_owned(), path(&reference), path(&reference)];
        rooftile(base.into_iter().chain(more.iter().map(ToString::to_string)))
    };
    fs::write(&labels, "0\n1\n").expect("a file");
    let few = run(&["--labels", &path(&labels)]).wants(3);
    assert!(few.stderr.contains("2 labels") && few.stderr.contains("72 triangles"), "{}", few.stderr);
    fs::write(&labels, "0\nx\n").expect("a file");
    assert!(run(&["--labels", &path(&labels)]).wants(3).stderr.contains("line 2"));
    fs::write(&labels, (0..72).map(|f| format!("{f}\n")).collect::<String>()).expect("a file");
    assert!(run(&["--labels", &path(&labels)]).wants(3).stderr.contains("at most 32"));
    assert!(run(&["--labels", &path(&reference)]).wants(3).stderr.contains("no labels"));
    run(&["--samples", "0"]).wants(2);
    run(&["--tolerance", "-1"]).wants(2);
    run(&["--tolerance", "nan"]).wants(2);
    rooftile(["compare", &path(&reference)]).wants(2);
    rooftile(["compare", &path(&reference), &path(&temp.path().join("none.ply"))]).wants(3);
}

#[test]
fn a_real_labelled_scan_is_no_distance_from_itself() {
    let Some(scan) = data("sum-tiny").map(|folder| folder.join("tiny_test_c.ply")) else { return };
    let report = compare(&[&scan, &scan]);
    let all = &report["simplified"][0]["all"];
    is(&all["two_sided"]["seen_max_m"], 0.0, 1e-6);
    is(&all["hausdorff"]["two_sided"]["lower_m"], 0.0, 1e-6);
    let classes = report["reference"]["classes"].as_array().expect("classes");
    assert!(classes.len() >= 3 && classes.iter().all(|c| c["name"] != "roof"), "SUM's numbering is not ours");
}
