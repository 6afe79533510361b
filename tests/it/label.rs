//! `rooftile label`: what it writes, how it is held against labels, schemes of other classes, tuning.

use std::path::{Path, PathBuf};

use rooftile::demo::{City, CityConfig, generate};
use rooftile::input::{ImageRef, InputConfig, Source, ply};
use rooftile::inspect;
use rooftile::report::Reporter;
use rooftile::write::ply::{Column, Ply};
use serde_json::Value;

use crate::common::{build, data, names, rooftile, town};

const CLASSES: [&str; 4] = ["terrain", "facade", "roof", "clutter"];

/// A synthetic quarter as a textured PLY whose faces carry their true classes; only the parts that `take` picks.
fn quarter(city: &City, folder: &Path, take: impl Fn(usize) -> bool) -> PathBuf {
    let mut ply =
        Ply { comments: CLASSES.iter().enumerate().map(|(i, c)| format!("label {i} {c}")).collect(), ..Ply::default() };
    let (mut positions, mut faces, mut uvs) = (Vec::new(), Vec::new(), Vec::new());
    let (mut labels, mut textures) = (Vec::new(), Vec::new());
    let taken = city.source.parts.iter().enumerate().filter(|(p, _)| take(*p));
    for (count, (p, part)) in (0..).zip(taken) {
        let first = positions.len() as u32;
        positions.extend_from_slice(&part.positions);
        faces.extend(part.faces.iter().map(|f| f.map(|v| v + first)));
        uvs.extend_from_slice(&part.corner_uvs);
        labels.extend(part.face_labels.iter().map(|l| i32::from(*l)));
        textures.resize(faces.len(), count);
        let ImageRef::Pixels(pixels) = &city.source.images[p] else { panic!("pixels in memory") };
        pixels.save(folder.join(format!("{p}.jpg"))).expect("an image");
        ply.comments.push(format!("TextureFile {p}.jpg"));
    }
    ply.vertex.extend(Column::positions(&positions));
    ply.faces = faces.into();
    ply.face.push(Column::texcoords(&uvs));
    ply.face.push(Column::i32("texnumber", textures));
    ply.face.push(Column::i32("label", labels));
    let path = folder.join("quarter.ply");
    ply.write(&path).expect("a file");
    path
}

/// Four of the sixteen parts: enough for houses, trees and a street.
fn corner(folder: &Path) -> PathBuf {
    quarter(town::city(), folder, |p| matches!(p, 1 | 2 | 5 | 6))
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

fn read(path: &Path) -> Source {
    let mut source = Source::default();
    ply::read(path, &InputConfig::default(), &Reporter::new(true), &mut source).expect("a PLY");
    source
}

fn number(value: &Value) -> f64 {
    value.as_f64().expect("a number")
}

#[test]
fn every_classifier_is_held_against_the_truth_of_a_synthetic_quarter() {
    let seeds: &[u64] = if std::env::var_os("ROOFTILE_SEEDS").is_some() { &[7, 11] } else { &[7] };
    for seed in seeds {
        let folder = tempfile::tempdir().expect("a folder");
        let city = generate(&CityConfig { seed: *seed, ..CityConfig::default() });
        let input = quarter(&city, folder.path(), |_| true);
        for (classifier, least) in [("paper", 0.0), ("paper-eq10", 0.3), ("cgal", 0.6), ("robust", 0.85)] {
            let args = ["label", text(&input), "--truth", "input", "--classifier", classifier, "--json", "-q"];
            let report = rooftile(args).wants(0).json();
            let (by_area, by_face) = (&report["truth"]["by_area"], &report["truth"]["by_face"]);
            let right = number(&by_area["overall_accuracy"]);
            println!(
                "seed {seed} {classifier:10} by area: {:.1} % right, mean IoU {:.1} %, IoU {}; by face: {:.1} %, {:.1} %",
                100.0 * right,
                100.0 * number(&by_area["mean_iou"]),
                by_area["iou"],
                100.0 * number(&by_face["overall_accuracy"]),
                100.0 * number(&by_face["mean_iou"]),
            );
            assert_eq!(report["truth"]["faces"], city.truth.len() as u64);
            assert!(right >= least, "{classifier}: {right}");
            let facade = report["classes"][1]["triangles"].as_u64().expect("a count");
            let warned = report["warnings"].to_string().contains("nothing is ever called facade");
            assert_eq!((facade == 0, warned), (classifier == "paper", classifier == "paper"), "{classifier}");
        }
    }
}

#[test]
fn what_label_writes_is_truth_for_itself_and_the_same_for_any_number_of_threads() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = corner(folder.path());
    let out = |name: &str, threads: &str| {
        let out = folder.path().join(name);
        rooftile(["label", text(&input), "-o", text(&out), "-q", "--threads", threads]).wants(0);
        out
    };
    let (one, two) = (out("one.ply", "1"), out("two.ply", "2"));
    assert_eq!(std::fs::read(&one).expect("a file"), std::fs::read(&two).expect("a file"));

    let (given, written) = (read(&input), read(&one));
    let (given, written) = (&given.parts[0], &written.parts[0]);
    assert_eq!(written.faces.len(), given.faces.len());
    let far = written.positions.iter().zip(&given.positions).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
    assert!(far < 1e-3 || written.positions.len() != given.positions.len(), "coordinates are the input's: {far}");
    assert!(written.face_labels.iter().all(|l| (0..4).contains(l)));
    let bytes = std::fs::read(&one).expect("a file");
    let header = String::from_utf8_lossy(&bytes[..2000]).into_owned();
    for line in [
        "comment label 2 roof",
        "property float scalar_planarity",
        "property float scalar_greenness",
        "property int label",
    ] {
        assert!(header.contains(line), "{line} in {header}");
    }

    let report = rooftile(["label", text(&input), "--truth", text(&one), "--json", "-q"]).wants(0).json();
    assert_eq!(report["truth"]["by_area"]["overall_accuracy"], 1.0, "{}", report["truth"]);
    let shown = rooftile(["label", text(&input), "--truth", text(&one), "-q"]).wants(0).stdout;
    assert!(shown.contains("100.0 % right, mean IoU 100.0 %") && shown.contains("truth, by faces"), "{shown}");
}

const SPLIT: &str = r#"
[levels]
leaf_faces = 8000
[[classes]]
name = "soil"
of = ["terrain"]
budget_m = 0.1
color = [166, 124, 82]
[[classes]]
name = "building"
of = ["facade", "roof"]
budget_m = 0.05
color = [58, 104, 190]
[[classes]]
name = "vegetation"
of = ["clutter"]
when = [{ feature = "patch_greenness", above = 2.0, width = 1.0 }]
budget_m = 0.3
color = [86, 158, 74]
[[classes]]
name = "vehicle"
of = ["clutter"]
when = [
  { feature = "patch_greenness", below = 2.0, width = 1.0 },
  { feature = "patch_top_m", below = 2.5, width = 0.5 },
  { feature = "patch_area_m2", above = 4.0, below = 60.0, width = 4.0 },
]
budget_m = 0.2
color = [230, 180, 40]
[[classes]]
name = "clutter"
budget_m = 0.1
color = [120, 120, 120]
"#;

#[test]
fn a_scheme_with_vegetation_and_vehicles_goes_from_label_to_tileset() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = corner(folder.path());
    let config = folder.path().join("classes.toml");
    std::fs::write(&config, SPLIT).expect("a file");
    let shares = |classifier: &str| {
        let args = ["label", text(&input), "--config", text(&config), "--classifier", classifier, "--json", "-q"];
        let report = rooftile(args).wants(0).json();
        let classes = report["classes"].as_array().expect("classes").clone();
        classes.iter().map(|c| number(&c["area_m2"])).collect::<Vec<f64>>()
    };
    let robust = shares("robust");
    println!("soil, building, vegetation, vehicle, clutter: {robust:?}");
    assert!(robust[2] > 100.0, "the quarter has trees: {robust:?}");
    assert!(robust[3] > 50.0, "and parked cars: {robust:?}");
    let cgal = shares("cgal");
    assert!(cgal[1] > 100.0 && cgal.len() == 5, "{cgal:?}");

    let out = folder.path().join("tiles");
    let report = build(&input, &out, &["--config", text(&config), "--json"]).wants(0).json();
    assert_eq!(inspect::check(&out).expect("a tileset"), []);
    let built: Vec<&str> =
        report["classes"].as_array().expect("classes").iter().filter_map(|c| c["class"].as_str()).collect();
    assert_eq!(built, ["soil", "building", "vegetation", "vehicle", "clutter"]);
    let tileset = std::fs::read_to_string(out.join("tileset.json")).expect("a tileset");
    assert!(tileset.contains("\"vegetation\"") && tileset.contains("\"vehicle\""));
    let metadata: Value = serde_json::from_str(&tileset).expect("JSON");
    let values = metadata["schema"]["enums"]["surfaceClass"]["values"].as_array().expect("classes").len();
    assert_eq!(values, 5);
}

/// A table of its own with a fifth class, as settings.
const TABLE: &str = r#"
[[classes]]
name = "terrain"
budget_m = 0.1
color = [166, 124, 82]
[[classes]]
name = "building"
of = ["facade", "roof"]
budget_m = 0.05
color = [58, 104, 190]
[[classes]]
name = "tree"
budget_m = 0.3
color = [86, 158, 74]
[[classes]]
name = "clutter"
budget_m = 0.1
color = [120, 120, 120]
[classify]
classifier = "cgal"
[classify.table]
energy = "eq10"
form = "robust"
normalise = true
sweeps = 2
classes = ["terrain", "facade", "roof", "tree"]
rows = [
  { feature = "elevation",   scale = 4.0,  effects = "P N F F" },
  { feature = "verticality", scale = 1.0,  effects = "P F P N" },
  { feature = "surface_variation", scale = 0.1, effects = "P P P F" },
  { feature = "greenness",   scale = 6.0,  effects = "N P P F" },
]
"#;

#[test]
fn a_table_may_have_its_own_classes_and_features() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = corner(folder.path());
    let config = folder.path().join("table.toml");
    std::fs::write(&config, TABLE).expect("a file");
    let report = rooftile(["label", text(&input), "--config", text(&config), "--json", "-q"]).wants(0).json();
    let areas: Vec<f64> =
        report["classes"].as_array().expect("classes").iter().map(|c| number(&c["area_m2"])).collect();
    assert!(areas[..3].iter().all(|a| *a > 50.0) && areas[3] == 0.0, "{areas:?}");
    std::fs::write(&config, TABLE.replace("N P P F", "N P P")).expect("a file");
    let run = rooftile(["label", text(&input), "--config", text(&config), "-q"]).wants(2);
    assert!(run.stderr.contains("greenness") && run.stderr.contains("\"N P P\""), "{}", run.stderr);
}

/// A box of 10 m on a lawn, its surfaces named as in CityGML.
const NAMED: &str = "\
v -20 -20 0\nv 20 -20 0\nv 20 20 0\nv -20 20 0\n\
v -5 -5 0\nv 5 -5 0\nv 5 5 0\nv -5 5 0\n\
v -5 -5 6\nv 5 -5 6\nv 5 5 6\nv -5 5 6\n\
usemtl GroundSurface\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n\
usemtl WallSurface\nf 5 6 10 9\nf 6 7 11 10\nf 7 8 12 11\nf 8 5 9 12\n\
usemtl RoofSurface\nf 9 10 11 12\n";

#[test]
fn names_of_materials_are_truth_and_override_on_request() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = folder.path().join("box.obj");
    std::fs::write(&input, NAMED).expect("a file");
    let args = ["label", text(&input), "--labels-from", "input", "--truth", "input", "--json", "-q"];
    let report = rooftile(args).wants(0).json();
    assert_eq!(report["truth"]["by_area"]["overall_accuracy"], 1.0);
    let triangles: Vec<u64> =
        report["classes"].as_array().expect("classes").iter().filter_map(|c| c["triangles"].as_u64()).collect();
    assert_eq!(triangles, [8, 8, 2, 0]);
    let out = folder.path().join("tiles");
    let built = build(&input, &out, &["--labels-from", "input", "--json"]).wants(0).json();
    assert_eq!(number(&built["classes"][2]["area_m2"]), 100.0, "{}", built["classes"]);
    // A model whose materials say nothing.
    std::fs::write(&input, NAMED.replace("usemtl", "#")).expect("a file");
    let run = rooftile(["label", text(&input), "--truth", "input", "-q"]).wants(2);
    assert!(run.stderr.contains("no face gets a label"), "{}", run.stderr);
}

#[test]
fn tuning_mends_a_spoilt_scale_and_its_settings_are_read_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = corner(folder.path());
    let (spoilt, tuned) = (folder.path().join("spoilt.toml"), folder.path().join("tuned.toml"));
    let table = include_str!("../../src/classes/paper/tables.toml");
    let cgal = &table[table.find("[cgal]").expect("a table")..];
    let rows = cgal.replace("[cgal]", "[classify.table]").replace("scale = 5.0", "scale = 80.0");
    std::fs::write(&spoilt, format!("[classify]\nclassifier = \"cgal\"\n{rows}")).expect("a file");
    let tune = |out: &Path| {
        let args = ["label", "--tune", text(&input), "--config", text(&spoilt), "-o", text(out), "--json", "-q"];
        rooftile(args).wants(0).json()
    };
    let report = tune(&tuned);
    let score = |when: &str| {
        number(&report[when]["by_area"]["overall_accuracy"]) + number(&report[when]["by_area"]["mean_iou"])
    };
    println!("tuned in {}: {} to {}, {}", report["tried"], score("before"), score("after"), report["changed"]);
    assert!(score("after") > score("before") + 0.05);
    let again = rooftile(["label", text(&input), "--truth", "input", "--config", text(&tuned), "--json", "-q"]);
    assert_eq!(again.wants(0).json()["truth"]["by_area"], report["after"]["by_area"]);
    let twice = folder.path().join("twice.toml");
    tune(&twice);
    assert_eq!(std::fs::read(&tuned).expect("a file"), std::fs::read(&twice).expect("a file"));
}

#[test]
fn figures_are_pictures_of_features_classes_and_regions() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = corner(folder.path());
    let figures = folder.path().join("figures");
    rooftile(["label", text(&input), "--figures", text(&figures), "-q"]).wants(0);
    assert_eq!(names(&figures), ["classes.png", "features.png", "regions.png"]);
    for name in names(&figures) {
        let picture = image::open(figures.join(&name)).expect("a picture").into_rgb8();
        let mut colors: Vec<[u8; 3]> = picture.pixels().map(|p| p.0).collect();
        colors.sort_unstable();
        colors.dedup();
        assert!(picture.width() >= 1200 && colors.len() > 500, "{name}: {} colours", colors.len());
    }
}

#[test]
fn images_are_decoded_only_for_what_looks_at_colours() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = corner(folder.path());
    let out = folder.path().join("out.ply");
    let decodes = |more: &[&str]| {
        let args = ["label", text(&input), "--json", "-q"];
        let report = rooftile(args.iter().chain(more)).wants(0).json();
        report["stages"].as_array().expect("stages").iter().any(|stage| stage["stage"] == "colours")
    };
    assert!(!decodes(&[]) && !decodes(&["--truth", "input"]));
    assert!(decodes(&["--out", text(&out)]), "greenness is one of the columns");
    let config = folder.path().join("classes.toml");
    std::fs::write(&config, SPLIT).expect("a file");
    assert!(decodes(&["--config", text(&config)]), "a class looks at greenness");
}

#[test]
fn arguments_that_make_no_sense_end_in_usage_errors() {
    let folder = tempfile::tempdir().expect("a folder");
    let input = folder.path().join("box.obj");
    std::fs::write(&input, NAMED).expect("a file");
    for (args, word) in [
        (vec!["label"], "INPUT"),
        (vec!["label", text(&input), "--color", "prettiness"], "prettiness"),
        (vec!["label", text(&input), "--classifier", "forest"], "forest"),
        (vec!["label", text(&input), "--tune", "input"], "--out"),
        (vec!["label", "--tune", "input", "-o", "x.toml"], "INPUT"),
        (vec!["label", text(&input), "--truth", "input", "--tune", "input"], "--tune"),
    ] {
        let run = rooftile(&args).wants(2);
        assert!(run.stderr.contains(word), "{args:?}: {}", run.stderr);
    }
    let listed = rooftile(["label", "--features"]).wants(0).stdout;
    assert!(listed.contains("greenness") && listed.contains("patch_top_m"), "{listed}");
}

#[test]
fn the_labelled_tile_of_sum_is_judged_by_what_its_labels_tell_apart() {
    let Some(input) = data("sum-tiny").map(|folder| folder.join("tiny_test_c.ply")) else { return };
    let report = rooftile(["label", text(&input), "--truth", "input", "--json", "-q"]).wants(0).json();
    let truth = &report["truth"];
    println!(
        "sum-tiny: {} of {} faces, IoU {}",
        truth["by_area"]["overall_accuracy"], truth["faces"], truth["by_area"]["iou"]
    );
    assert_eq!(truth["names"], serde_json::json!(["terrain", "facade+roof", "clutter"]));
    assert_eq!(truth["faces"], 1973);
}
