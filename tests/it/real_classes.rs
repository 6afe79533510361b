//! Classes on real meshes and clean models made to look captured: held against labels, or against what is not there.
//!
//! The labels of others tell apart what they tell apart: SUM and CGAL know `building`, not roofs and façades.

use std::path::{Path, PathBuf};
use std::process::Command;

use glam::DVec3;
use rooftile::geo::bvh::Bvh;
use rooftile::write::ply::{Column, Ply};
use serde_json::Value;

use crate::common::{data, rooftile};

/// What `rooftile label` says about a file.
fn labelled(input: &Path, more: &[&str]) -> Value {
    let input = input.to_str().expect("a path in UTF-8");
    rooftile(["label", input, "--json", "-q"].iter().chain(more)).wants(0).json()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number, not {value}"))
}

/// Roofs and façades by area, as a share of all.
fn built(folder: &str, file: &str) -> Option<f64> {
    let report = labelled(&data(folder)?.join(file), &[]);
    let area = |wanted: &[&str]| -> f64 {
        let classes = report["classes"].as_array().expect("classes").iter();
        let taken = classes.filter(|c| c["class"].as_str().is_some_and(|name| wanted.contains(&name)));
        taken.map(|c| number(&c["area_m2"])).sum()
    };
    let share = area(&["roof", "facade"]) / area(&["terrain", "facade", "roof", "clutter"]);
    println!("{folder}: {:.2} % of the area is roof or façade", 100.0 * share);
    Some(share)
}

#[test]
fn a_labelled_street_corner_is_told_apart() {
    let Some(folder) = data("sum-tiny") else { return };
    let report = labelled(&folder.join("tiny_test_c.ply"), &["--truth", "input"]);
    let right = number(&report["truth"]["by_area"]["overall_accuracy"]);
    println!("sum-tiny: {:.1} % right by area", 100.0 * right);
    assert_eq!(report["truth"]["faces"], 1973);
    assert!(right >= 0.88, "{}", report["truth"]);
}

#[test]
fn a_crossing_and_a_crater_have_no_buildings() {
    if let Some(share) = built("crossing-116e39n", "crossing.obj") {
        assert!(share < 0.03, "{share} of the crossing is built");
    }
    if let Some(share) = built("nasa-crater", "crater.obj") {
        assert!(share < 0.01, "{share} of the crater is built");
    }
}

/// A mesh as OFF: its corners, three numbers a line, and its triangles.
fn off(path: &Path) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let text = std::fs::read_to_string(path).expect("a text");
    let mut words = text.split_whitespace().skip(1).map(|w| w.parse::<f64>().expect("a number"));
    let mut next = move || words.next().expect("one more number");
    let (vertices, faces) = (next() as usize, next() as usize);
    next();
    let positions = (0..vertices).map(|_| DVec3::new(next(), next(), next())).collect();
    let triangle = |_| {
        assert_eq!(next() as usize, 3, "triangles only");
        [next() as u32, next() as u32, next() as u32]
    };
    (positions, (0..faces).map(triangle).collect())
}

/// The points of a text PLY that has x y z only.
fn text_points(path: &Path) -> Vec<DVec3> {
    let text = std::fs::read_to_string(path).expect("a text");
    let (_, body) = text.split_once("end_header\n").expect("a header");
    let numbers: Vec<f64> = body.split_whitespace().map(|w| w.parse().expect("a number")).collect();
    numbers.chunks_exact(3).map(|p| DVec3::new(p[0], p[1], p[2])).collect()
}

/// Points with labels of a binary PLY with double x y z, three colours, int label.
fn labelled_points(path: &Path) -> Vec<(DVec3, i32)> {
    let bytes = std::fs::read(path).expect("a file");
    let end = b"end_header\n";
    let start = bytes.windows(end.len()).position(|w| w == end).expect("a header") + end.len();
    let point = |record: &[u8]| {
        let at = |i: usize| f64::from_le_bytes(record[8 * i..8 * i + 8].try_into().expect("eight bytes"));
        (DVec3::new(at(0), at(1), at(2)), i32::from_le_bytes(record[27..31].try_into().expect("four bytes")))
    };
    bytes[start..].chunks_exact(31).map(point).collect()
}

/// Moves one point cloud onto another with the same points in the same order.
fn offset(from: &[(DVec3, i32)], to: &[DVec3]) -> DVec3 {
    let median = |axis: usize| {
        let mut apart: Vec<f64> = from.iter().zip(to).map(|((a, _), b)| b[axis] - a[axis]).collect();
        apart.sort_by(f64::total_cmp);
        apart[apart.len() / 2]
    };
    DVec3::new(median(0), median(1), median(2))
}

#[test]
fn sparse_labels_of_points_agree_with_the_faces_nearest_to_them() {
    let Some(folder) = data("cgal-b9") else { return };
    let (positions, faces) = off(&folder.join("b9_mesh.off"));
    let points = labelled_points(&folder.join("b9_training.ply"));
    let shift = offset(&points, &text_points(&folder.join("b9.ply")));
    let tree = Bvh::new(&positions, &faces);
    let mut labels = vec![-1; faces.len()];
    for (p, label) in points.iter().filter(|(_, label)| *label >= 0) {
        if let Some(hit) = tree.closest(*p + shift, 1.0) {
            labels[hit.face as usize] = *label;
        }
    }
    let comments = ["label 0 ground", "label 1 vegetation", "label 2 building"].map(String::from).to_vec();
    let mut ply = Ply { comments, faces: faces.into(), ..Ply::default() };
    ply.vertex.extend(Column::positions(&positions));
    ply.face.push(Column::i32("label", labels));
    let temp = tempfile::tempdir().expect("a folder");
    let path = temp.path().join("b9.ply");
    ply.write(&path).expect("a file");
    let report = labelled(&path, &["--truth", "input"]);
    let right = number(&report["truth"]["by_face"]["overall_accuracy"]);
    println!("cgal-b9: {:.1} % of {} labelled faces right", 100.0 * right, report["truth"]["faces"]);
    assert!(number(&report["truth"]["faces"]) > 800.0, "{}", report["truth"]);
    assert!(right >= 0.88, "{}", report["truth"]);
}

/// A clean model as photogrammetry would have made it, by `tools/remesh_sampled.py`; none, loudly, without its tools.
fn remeshed(input: &Path, more: &[&str], folder: &Path) -> Option<PathBuf> {
    let has_tools = Command::new("python3").args(["-c", "import numpy, scipy"]).output();
    if !has_tools.is_ok_and(|o| o.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "CI has to have python3 with numpy and scipy");
        eprintln!("SKIPPED: python3 with numpy and scipy");
        return None;
    }
    let out = folder.join("captured.ply");
    let tool = Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/remesh_sampled.py");
    let done = Command::new("python3").arg(tool).arg(input).arg(&out).args(more).output().expect("python3 starts");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    Some(out)
}

/// The least that roofs and façades of a clean model have to agree with its labels, once it looks captured.
fn is_told_apart(set: &str, file: &str, more: &[&str]) {
    let Some(folder) = data(set) else { return };
    let temp = tempfile::tempdir().expect("a folder");
    let Some(mesh) = remeshed(&folder.join(file), more, temp.path()) else { return };
    let report = labelled(&mesh, &["--truth", "input"]);
    let truth = &report["truth"];
    let names = truth["names"].as_array().expect("names");
    for class in ["roof", "facade"] {
        let at = names.iter().position(|name| name == class).expect("a class that is told apart");
        let iou = number(&truth["by_area"]["iou"][at]);
        println!("{set}: {class} IoU {:.1} % by area", 100.0 * iou);
        assert!(iou >= 0.85, "{set}: {class} {iou}: {truth}");
    }
}

#[test]
fn a_block_of_prisms_made_to_look_captured_is_told_apart() {
    is_told_apart("3dfier-testarea", "example_data/output/testarea.obj", &[]);
}

#[test]
fn a_street_of_detailed_houses_on_a_sheet_of_terrain_is_told_apart() {
    // The model has no terrain of its own; without any the heights have nothing to stand on.
    is_told_apart("ingolstadt-lod3", "ingolstadt_lod3.obj", &["--ground"]);
}
