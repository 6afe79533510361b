//! The audit on kinds of tilesets and with kinds of references: implicit and packed, added to, compressed, on the globe.

use std::io::Write;
use std::path::{Path, PathBuf};

use glam::{DMat4, DVec3};
use rooftile::audit::budget::Budget;
use rooftile::audit::distance::{Against, Verdict};
use rooftile::audit::rewrite::{Policy, rewrite};
use rooftile::audit::source::OriginalConfig;
use rooftile::audit::{Audit, AuditConfig, audit};
use rooftile::geo::{Frame, Georeference};
use rooftile::measure::Interval;
use rooftile::report::Reporter;
use serde_json::{Value, json};

use crate::audit::{glb, house, run};
use crate::common::{rooftile, town};

const PLACE: &str = "ENU:53.5,10.0,20";

fn text(path: &Path) -> String {
    path.to_str().expect("UTF-8").to_owned()
}

fn edit(folder: &Path, change: impl Fn(&mut Value)) {
    let path = folder.join("tileset.json");
    let mut json: Value = serde_json::from_slice(&std::fs::read(&path).expect("a file")).expect("JSON");
    change(&mut json);
    std::fs::write(path, json.to_string()).expect("written");
}

#[track_caller]
fn holds(interval: Option<Interval>, wanted_m: f64) {
    let interval = interval.expect("an interval");
    let holds = interval.lower_m <= wanted_m + 1e-4 && wanted_m <= interval.upper_m + 1e-4;
    assert!(holds && interval.upper_m - interval.lower_m < 0.021, "{interval:?} {wanted_m}");
}

/// The original of the house, with a chimney of 2 m, moved by `by`.
fn original(folder: &Path, by: DVec3) -> PathBuf {
    let path = folder.join("house.obj");
    let mut obj = String::new();
    let corners = [[0., 0., 5.], [20., 0., 5.], [20., 20., 5.], [0., 20., 5.], [10., 10., 7.], [10.5, 10., 7.]];
    for p in corners.into_iter().chain([[10.5, 10.5, 7.]]) {
        let p = DVec3::from(p) + by;
        obj.push_str(&format!("v {} {} {}\n", p.x, p.y, p.z));
    }
    obj.push_str("f 1 2 3\nf 1 3 4\nf 5 6 7\n");
    std::fs::write(&path, obj).expect("written");
    path
}

fn against(folder: &Path, path: PathBuf, georeference: Option<Georeference>) -> (Audit, Vec<&'static str>) {
    let original = Some(OriginalConfig { inputs: vec![path], georeference });
    let reporter = Reporter::new(true);
    let found = audit(folder, &AuditConfig { original, ..AuditConfig::default() }, &reporter).expect("an audit");
    let codes = found.warnings.iter().map(|w| w.code).collect();
    (found, codes)
}

#[test]
fn an_original_in_its_own_coordinates_is_laid_over_a_tileset_on_the_globe() {
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 0.2);
    let place = || Georeference::parse(PLACE).expect("a place");
    let frame = Frame::of(place(), DVec3::ZERO).expect("a frame");
    let to_globe: DMat4 = frame.ecef_from_local().expect("on the globe");
    edit(temp.path(), |json| json["root"]["transform"] = json!(to_globe.to_cols_array()));

    let (found, codes) = against(temp.path(), original(temp.path(), DVec3::ZERO), Some(place()));
    let placed = found.placed.as_ref().expect("a place");
    assert_eq!((placed.how, placed.triangles), ("globe", 3));
    let shift = DVec3::from_array(placed.shift_m);
    // The original's chimney is half a metre higher.
    assert!(shift.truncate().length() < 1e-3 && (shift.z - 0.25).abs() < 1e-3, "{shift}");
    assert!(!codes.contains(&"source-shifted"), "{codes:?}");
    holds(found.distances[0].hausdorff, 2.0);
    // A corner of the finest tile's chimney, as far from the roof below as from the triangle above.
    holds(found.distances[1].hausdorff, 1.03125);
    assert!(found.distances.iter().all(|d| d.against == Against::Original));
    assert_eq!((found.distances[0].verdict, found.distances[1].verdict), (Verdict::Understated, Verdict::Finest));

    // 3 m to the north: the distances are believed by nobody, and it is said how far.
    let north = original(temp.path(), DVec3::new(0.0, 3.0, 0.0));
    let (found, codes) = against(temp.path(), north, Some(place()));
    assert!(codes.contains(&"source-shifted"), "{codes:?}");
    let warning = found.warnings.iter().find(|w| w.code == "source-shifted").expect("it");
    assert!(warning.first.contains("north 3.0"), "{}", warning.first);
}

#[test]
fn an_original_without_a_place_is_not_laid_over_a_tileset_without_one_by_guess() {
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 0.2);
    let path = original(temp.path(), DVec3::ZERO);
    let run = rooftile(["audit", &text(temp.path()), "--source", &text(&path), "--source-crs", PLACE, "-q"]).wants(3);
    assert!(run.stderr.contains("place on the Earth"), "{}", run.stderr);
    let path = original(temp.path(), DVec3::new(0.0, 0.0, 4.0));
    let (_, codes) = against(temp.path(), path, None);
    assert!(codes.contains(&"source-shifted"), "{codes:?}");
}

#[test]
fn a_route_loads_by_stated_and_by_measured_errors() {
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 0.2);
    let fly = |height_m: f64| {
        let path = temp.path().join("route.geojson");
        let line = json!({ "type": "Feature", "properties": {}, "geometry": {
            "type": "LineString", "coordinates": [[0, 10, height_m], [20, 10, height_m]] } });
        std::fs::write(&path, line.to_string()).expect("written");
        let run = rooftile(["audit", &text(temp.path()), "--route", &text(&path), "--json", "-q"]).wants(0);
        let route = run.json()["route"].clone();
        assert_eq!(route["stated"]["length_m"], 20.0);
        ["stated", "measured"].map(|errors| route[errors]["most"]["triangles"].as_u64().expect("triangles"))
    };
    // 0.2 m cover 16 px from 20 m away, the true 1.5 m from 156 m: the lie shows a roof without its chimney.
    assert_eq!(fly(16.0), [12, 12]);
    assert_eq!(fly(100.0), [2, 12]);
    assert_eq!(fly(400.0), [2, 2]);
    std::fs::write(temp.path().join("no.geojson"), "{}").expect("written");
    rooftile(["audit", &text(temp.path()), "--route", &text(&temp.path().join("no.geojson")), "-q"]).wants(3);
}

#[test]
fn policies_of_a_rewrite_give_the_errors_that_they_name() {
    let town = town::town();
    let audit = run(&town.folder, None);
    let temp = tempfile::tempdir().expect("a folder");
    let errors = |policy, name: &str| {
        let out = temp.path().join(name);
        let told = rewrite(&audit, &town.folder, &out, policy).expect("rewritten");
        let json: Value =
            serde_json::from_slice(&std::fs::read(out.join("tileset.json")).expect("a file")).expect("JSON");
        let (mut written, mut open) = (Vec::new(), vec![&json["root"]]);
        while let Some(tile) = open.pop() {
            written.push(tile["geometricError"].as_f64().expect("an error"));
            let children = tile["children"].as_array().into_iter().flatten();
            assert!(children.clone().all(|c| c["geometricError"].as_f64() <= tile["geometricError"].as_f64()));
            open.extend(children.rev());
        }
        assert_eq!(written.len(), told.len());
        assert!(written.iter().zip(&told).all(|(a, b)| (a - b).abs() < 1e-9), "{written:?} {told:?}");
        told
    };
    let strict = errors(Policy::Strict, "strict");
    let p95 = errors(Policy::P95, "p95");
    let semantic = errors(Policy::Semantic, "semantic");
    for d in audit.distances.iter().filter(|d| d.verdict != Verdict::Finest) {
        let (t, upper) = (d.tile, d.hausdorff.expect("an interval").upper_m);
        assert!(strict[t] >= upper && p95[t] < strict[t], "{t}: {} {upper} {}", strict[t], p95[t]);
        assert!(semantic[t] <= strict[t] + 1e-9, "{t}: {} {}", semantic[t], strict[t]);
        // Roofs and facades are within it for certain.
        for class in &d.comparison.as_ref().expect("figures").by_class {
            let name = &audit.classes[class.class.index()];
            let certified = class.figures.hausdorff.two_sided.expect("an interval").upper_m;
            assert!(!["roof", "facade"].contains(&name.as_str()) || certified <= semantic[t] + 1e-9, "{t} {name}");
        }
    }
    assert!(semantic != strict && semantic != p95, "the three differ");
    let again = run(&temp.path().join("strict"), None);
    assert!(again.distances.iter().all(|d| !matches!(d.verdict, Verdict::Understated | Verdict::Overstated)));
}

/// Four quarters of a roof, one of them with a chimney of 1.5 m, below the roof without it.
fn implicit(folder: &Path) {
    let square = |x: f32, y: f32, size: f32, z: f32| {
        vec![[x, y, z], [x + size, y, z], [x + size, y + size, z], [x, y + size, z]]
    };
    let faces = |first: u32| [[first, first + 1, first + 2], [first, first + 2, first + 3]];
    std::fs::write(folder.join("0_0_0.glb"), glb(&square(-10., -10., 20., 5.), &faces(0))).expect("written");
    for (x, y) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
        let (mut points, mut all) = (square(x as f32 * 10. - 10., y as f32 * 10. - 10., 10., 5.), faces(0).to_vec());
        if (x, y) == (1, 0) {
            points.extend(square(5., -5., 0.5, 6.5));
            all.extend(faces(4));
        }
        std::fs::write(folder.join(format!("1_{x}_{y}.glb")), glb(&points, &all)).expect("written");
    }
    let subtree = json!({ "tileAvailability": { "constant": 1 }, "contentAvailability": [{ "constant": 1 }],
                          "childSubtreeAvailability": { "constant": 0 } });
    std::fs::write(folder.join("0.0.0.subtree"), subtree.to_string()).expect("written");
    let tileset = json!({
        "asset": { "version": "1.1" }, "geometricError": 50,
        "root": {
            "boundingVolume": { "box": [0, 0, 5.75, 10, 0, 0, 0, 10, 0, 0, 0, 0.75] }, "geometricError": 2, "refine": "REPLACE",
            "content": { "uri": "{level}_{x}_{y}.glb" },
            "implicitTiling": { "subdivisionScheme": "QUADTREE", "subtreeLevels": 2, "availableLevels": 2,
                                "subtrees": { "uri": "{level}.{x}.{y}.subtree" } }
        }
    });
    std::fs::write(folder.join("tileset.json"), tileset.to_string()).expect("written");
}

#[test]
fn implicit_tiles_are_measured_in_a_folder_and_in_an_archive_alike() {
    let temp = tempfile::tempdir().expect("a folder");
    implicit(temp.path());
    let found = run(temp.path(), None);
    assert_eq!(found.distances.len(), 5);
    assert_eq!(found.codes(), [].into(), "{:?}", found.faults);
    holds(found.distances[0].hausdorff, 1.5);
    assert_eq!(found.distances[0].verdict, Verdict::Honest);

    let path = temp.path().join("roof.3tz");
    let mut archive = zip::ZipWriter::new(std::fs::File::create(&path).expect("a file"));
    for name in ["tileset.json", "0.0.0.subtree", "0_0_0.glb", "1_0_0.glb", "1_0_1.glb", "1_1_0.glb", "1_1_1.glb"] {
        archive.start_file(name, zip::write::SimpleFileOptions::default()).expect("an entry");
        archive.write_all(&std::fs::read(temp.path().join(name)).expect("a file")).expect("written");
    }
    archive.finish().expect("an archive");
    let packed = run(&path, None);
    assert_eq!(packed.distances, found.distances);
    let out = text(&temp.path().join("out"));
    rooftile(["audit", &text(&path), "--rewrite", &out, "-q"]).wants(3);
}

#[test]
fn what_is_added_to_a_tile_counts_as_its_finer_surface() {
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 0.2);
    // The chimney alone, as the fine content, beside the roof.
    let top = [[10.0, 10.0, 6.5], [10.5, 10.0, 6.5], [10.5, 10.5, 6.5]];
    std::fs::write(temp.path().join("fine.glb"), glb(&top, &[[0, 1, 2]])).expect("written");
    edit(temp.path(), |json| json["root"]["refine"] = json!("ADD"));
    let found = run(temp.path(), None);
    let root = &found.distances[0];
    assert_eq!((root.reference_triangles, root.verdict), (3, Verdict::Understated));
    holds(root.hausdorff, 1.5);
    assert_eq!(found.distances[1].verdict, Verdict::Finest);
    // From far away it is the roof alone, from near both are drawn.
    assert_eq!(found.stations[0].measured.triangles, 3);
}

/// A b3dm, or a composite of some, around GLBs.
fn b3dm(gltf: &[u8]) -> Vec<u8> {
    let mut bytes = b"b3dm".to_vec();
    [1, 28 + gltf.len() as u32, 0, 0, 0, 0].iter().for_each(|word: &u32| bytes.extend(word.to_le_bytes()));
    bytes.extend(gltf);
    bytes
}

#[test]
fn a_composite_is_measured_as_one_surface() {
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 2.0);
    let before = run(temp.path(), None);
    let half = |a: u32, b: u32, c: u32| {
        let roof = [[0.0, 0.0, 5.0], [20.0, 0.0, 5.0], [20.0, 20.0, 5.0], [0.0, 20.0, 5.0]];
        b3dm(&glb(&roof, &[[a, b, c]]))
    };
    let inner = [half(0, 1, 2), half(0, 2, 3)].concat();
    let mut cmpt = b"cmpt".to_vec();
    [1, 16 + inner.len() as u32, 2].iter().for_each(|word: &u32| cmpt.extend(word.to_le_bytes()));
    cmpt.extend(inner);
    std::fs::write(temp.path().join("coarse.cmpt"), cmpt).expect("written");
    edit(temp.path(), |json| json["root"]["content"]["uri"] = json!("coarse.cmpt"));
    let found = run(temp.path(), None);
    assert_eq!(found.distances[0].hausdorff, before.distances[0].hausdorff);
    assert_eq!(found.structure.tiles[0].triangles, 2);
}

#[test]
fn compressed_and_quantized_tiles_are_as_far_off_as_plain_ones() {
    let temp = tempfile::tempdir().expect("a folder");
    let mut obj = String::new();
    let n = 60;
    for i in 0..=n {
        for j in 0..=n {
            let (x, y) = (f64::from(i), f64::from(j));
            obj.push_str(&format!("v {x} {y} {}\n", (x * 0.37).sin() * 2.0 + (y * 0.23).cos() * 3.0));
        }
    }
    for i in 0..n {
        for j in 0..n {
            let a = i * (n + 1) + j + 1;
            obj.push_str(&format!("f {a} {} {}\nf {a} {} {}\n", a + n + 1, a + n + 2, a + n + 2, a + 1));
        }
    }
    let input = temp.path().join("hills.obj");
    std::fs::write(&input, obj).expect("written");
    let build = |compress: &str| {
        let out = temp.path().join(compress);
        let sets = ["levels.leaf_faces=2000", "levels.tile_faces=1500", "levels.root_faces=500", compress];
        let mut args = vec!["build".to_owned(), text(&input), "-o".into(), text(&out), "-q".into()];
        args.extend(sets.iter().flat_map(|set| ["--set".to_owned(), (*set).to_owned()]));
        rooftile(args.iter().map(String::as_str)).wants(0);
        run(&out, None)
    };
    let (plain, packed) = (build("write.compress=false"), build("write.compress=true"));
    let size = |audit: &Audit| audit.structure.levels.iter().map(|l| l.sum.bytes).sum::<u64>();
    assert!(size(&packed) * 2 < size(&plain), "{} {}", size(&packed), size(&plain));
    assert_eq!(plain.distances.len(), packed.distances.len());
    let pairs = plain.distances.iter().zip(&packed.distances).filter(|(a, _)| a.hausdorff.is_some());
    assert!(pairs.clone().count() > 0);
    for (a, b) in pairs {
        let (x, y) = (a.hausdorff.expect("an interval"), b.hausdorff.expect("an interval"));
        assert!((x.lower_m - y.lower_m).abs() < 0.02, "{x:?} {y:?}");
        assert!(b.certificates.iter().all(|c| c.holds) && b.verdict != Verdict::Understated, "{b:?}");
    }
}

/// An audit of the town's tiles in parts of `part_faces`, within `bytes`.
fn within(bytes: u64, part_faces: usize) -> Audit {
    let mut config = AuditConfig { budget: Budget(bytes), obstacle_safe_m: Some(1.0), ..AuditConfig::default() };
    config.distance.part_faces = part_faces;
    audit(&town::town().folder, &config, &Reporter::new(true)).expect("an audit")
}

#[test]
fn the_figures_do_not_depend_on_the_memory_there_is() {
    let [little, plenty] = [Budget::LEAST_BYTES, 64_000_000_000].map(|bytes| within(bytes, 10_000));
    assert!(little.json() == plenty.json());
    // Parts of another size have other samples and the same surface.
    let whole = within(Budget::LEAST_BYTES, 1_000_000);
    let mut compared = 0;
    for (a, b) in little.distances.iter().zip(&whole.distances) {
        let (Some(of_a), Some(of_b)) = (&a.comparison, &b.comparison) else { continue };
        let (Some(a_m), Some(b_m)) = (a.hausdorff, b.hausdorff) else { continue };
        assert!(a_m.lower_m <= b_m.upper_m && b_m.lower_m <= a_m.upper_m, "{a_m:?} {b_m:?}");
        let [one, other] = [of_a, of_b].map(|c| c.all.two_sided.as_ref().expect("distances").mean_m);
        assert!((one / other - 1.0).abs() < 0.05, "{one} {other}");
        compared += 1;
    }
    assert!(compared >= 3, "{compared}");
}

#[test]
fn what_does_not_fit_into_memory_is_refused_with_the_numbers_and_nothing_is_guessed() {
    let found = within(12_000_000, 10_000);
    let whys: Vec<_> = found.distances.iter().filter_map(|d| d.why.as_deref()).collect();
    assert!(whys.iter().any(|why| why.contains("--memory")), "{whys:?}");
    let unmeasured = found.distances.iter().filter(|d| d.verdict == Verdict::Unmeasured);
    assert!(unmeasured.clone().count() > 0 && unmeasured.into_iter().all(|d| d.hausdorff.is_none()));
    assert!(found.faults.iter().any(|f| f.code == "tile-unmeasured" || f.code == "tile-unreadable"));
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 2.0);
    let path = original(temp.path(), DVec3::ZERO);
    let config = AuditConfig {
        original: Some(OriginalConfig { inputs: vec![path], georeference: None }),
        budget: Budget(100),
        ..AuditConfig::default()
    };
    let refused = audit(temp.path(), &config, &Reporter::new(true)).err().map(|e| e.to_string()).unwrap_or_default();
    assert!(refused.contains("house.obj") && refused.contains("--memory"), "{refused}");
    let folder = text(temp.path());
    for memory in ["1MB", "many"] {
        let run = rooftile(["audit", folder.as_str(), "--memory", memory]).wants(2);
        assert!(run.stderr.contains("750MB"), "{}", run.stderr);
    }
    rooftile(["audit", folder.as_str(), "--memory", "1GB", "-q"]).wants(0);
}

#[test]
fn a_finest_tile_has_no_comparison_in_the_json_either() {
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 2.0);
    let tiles = run(temp.path(), None).json()["tiles"].clone();
    assert!(tiles[0]["comparison"]["all"]["two_sided"]["mean_m"].is_f64());
    assert!(tiles[1]["comparison"].is_null(), "{}", tiles[1]["comparison"]);
}
