//! A real scan, from end to end.

use rooftile::inspect;

use crate::common::{build, data};

#[test]
fn a_real_headquarters_becomes_a_sound_tileset() {
    // The folder holds the same model a second time, welded.
    let Some(input) = data("agi-hq").map(|folder| folder.join("agi_hq.obj")) else { return };
    let temp = tempfile::tempdir().expect("a folder");
    let out = temp.path().join("tiles");
    let run = build(&input, &out, &["--json"]).wants(0);
    assert_eq!(run.stderr, "", "a quiet build says nothing");
    let report = run.json();
    assert_eq!(inspect::check(&out).expect("a tileset"), []);
    let faces = report["gate"]["faces"].as_u64().expect("a count");
    assert!((140_000..150_000).contains(&faces), "{faces} triangles");
    let roof = report["classes"].as_array().expect("classes").iter().find(|c| c["class"] == "roof");
    let roof_m2 = roof.and_then(|c| c["area_m2"].as_f64()).expect("roofs");
    assert!(roof_m2 > 100.0, "{roof_m2} m² of roof");
    let levels = report["levels"].as_array().expect("levels");
    assert!(levels.len() >= 2, "{} levels", levels.len());
}
