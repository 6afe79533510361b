//! The audit: what the builder promises holds, and faults that were planted are found, named, and found where they are.

use std::path::{Path, PathBuf};

use glam::DVec3;
use rooftile::audit::distance::Verdict;
use rooftile::audit::findings::Group;
use rooftile::audit::{Audit, AuditConfig, audit, page};
use rooftile::report::Reporter;
use serde_json::{Value, json};

use crate::common::town::{Node, town};
use crate::common::{files, rooftile};

pub fn run(folder: &Path, obstacle_safe_m: Option<f64>) -> Audit {
    let config = AuditConfig { obstacle_safe_m, ..AuditConfig::default() };
    audit(folder, &config, &Reporter::new(true)).expect("an audit")
}

/// A copy of the town that may be harmed.
fn copy(into: &Path) -> PathBuf {
    let folder = into.join("town");
    for (path, bytes) in files(&town().folder) {
        let to = folder.join(path);
        match bytes {
            None => std::fs::create_dir_all(to).expect("a folder"),
            Some(bytes) => {
                std::fs::create_dir_all(to.parent().expect("a parent")).expect("a folder");
                std::fs::write(to, bytes).expect("a file");
            }
        }
    }
    folder
}

/// A GLB taken apart: its JSON and where its bytes begin.
struct Glb {
    path: PathBuf,
    bytes: Vec<u8>,
    json: Value,
    bin_at: usize,
}

impl Glb {
    fn open(folder: &Path, node: &Node) -> Self {
        let path = folder.join(&node.uri);
        let bytes = std::fs::read(&path).expect("a tile");
        let length = u32::from_le_bytes(bytes[12..16].try_into().expect("4 bytes")) as usize;
        let json = serde_json::from_slice(&bytes[20..20 + length]).expect("JSON");
        Self { path, bytes, json, bin_at: 28 + length }
    }

    fn attribute(&self, name: &str) -> (usize, usize, usize) {
        let accessor = self.json["meshes"][0]["primitives"][0]["attributes"][name].as_u64().expect("an accessor");
        let accessor = &self.json["accessors"][accessor as usize];
        let view = &self.json["bufferViews"][accessor["bufferView"].as_u64().expect("a view") as usize];
        let or_0 = |v: &Value| v.as_u64().unwrap_or(0) as usize;
        let size = if name == "POSITION" { 12 } else { 1 };
        let stride = view["byteStride"].as_u64().map_or(size, |s| s as usize);
        let from = self.bin_at + or_0(&view["byteOffset"]) + or_0(&accessor["byteOffset"]);
        (from, stride, or_0(&accessor["count"]))
    }

    /// Moves the vertices that `by` says something of: index, and metres up.
    fn lift(mut self, by: impl Fn(usize) -> f64) {
        let (from, stride, count) = self.attribute("POSITION");
        for v in 0..count {
            // y is up.
            let at = from + v * stride + 4;
            let y = f32::from_le_bytes(self.bytes[at..at + 4].try_into().expect("f32")) + by(v) as f32;
            self.bytes[at..at + 4].copy_from_slice(&y.to_le_bytes());
        }
        std::fs::write(&self.path, &self.bytes).expect("written");
    }

    fn swap_classes(mut self, a: u8, b: u8) {
        let (from, stride, count) = self.attribute("_FEATURE_ID_0");
        for v in 0..count {
            let id = &mut self.bytes[from + v * stride];
            *id = if *id == a {
                b
            } else if *id == b {
                a
            } else {
                *id
            };
        }
        std::fs::write(&self.path, &self.bytes).expect("written");
    }

    fn blur(mut self) {
        let view = self.json["images"][0]["bufferView"].as_u64().expect("an image inside") as usize;
        let view = &self.json["bufferViews"][view];
        let from = self.bin_at + view["byteOffset"].as_u64().unwrap_or(0) as usize;
        let length = view["byteLength"].as_u64().expect("a length") as usize;
        let picture = image::load_from_memory(&self.bytes[from..from + length]).expect("an image").to_rgb8();
        let picture = image::imageops::fast_blur(&picture, 3.0);
        let mut smaller = Vec::new();
        let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut smaller, 80);
        picture.write_with_encoder(encoder).expect("a JPEG");
        assert!(smaller.len() <= length, "a blurred image takes less room: {} of {length}", smaller.len());
        smaller.resize(length, 0);
        self.bytes[from..from + length].copy_from_slice(&smaller);
        std::fs::write(&self.path, &self.bytes).expect("written");
    }
}

/// The tile of the tileset JSON with this content.
fn tile<'a>(root: &'a mut Value, uri: &str) -> Option<&'a mut Value> {
    if root["content"]["uri"] == uri {
        return Some(root);
    }
    root["children"].as_array_mut()?.iter_mut().find_map(|child| tile(child, uri))
}

fn edit(folder: &Path, change: impl Fn(&mut Value)) {
    let path = folder.join("tileset.json");
    let mut json: Value = serde_json::from_slice(&std::fs::read(&path).expect("a file")).expect("JSON");
    change(&mut json["root"]);
    std::fs::write(path, json.to_string()).expect("written");
}

#[track_caller]
fn wants(audit: &Audit, code: &str, node: &Node) {
    let found = audit.faults.iter().any(|f| f.code == code && f.path.ends_with(&node.uri));
    let list: Vec<String> = audit.faults.iter().map(|f| format!("{} {} {}", f.code, f.path, f.what)).collect();
    assert!(found, "no {code} at {}; found\n{}", node.uri, list.join("\n"));
}

#[test]
fn the_builders_certificates_hold_and_a_sound_tileset_has_no_grave_fault() {
    let audit = run(&town().folder, None);
    let grave: Vec<_> = audit.faults.iter().filter(|f| f.group.is_grave()).collect();
    assert!(grave.is_empty(), "{grave:#?}");
    let measured: Vec<_> = audit.distances.iter().filter(|d| d.comparison.is_some()).collect();
    assert!(measured.len() >= 3 && audit.distances.iter().all(|d| d.verdict != Verdict::Unmeasured));
    let mut certificates = 0;
    for d in &measured {
        let interval = d.hausdorff.expect("an interval");
        assert!(interval.upper_m - interval.lower_m <= 0.021 && interval.lower_m > 0.0, "{interval:?}");
        for c in &d.certificates {
            assert!(c.holds, "{c:?}");
            certificates += 1;
        }
        let node = &town().nodes[d.tile];
        assert!(node.geometry_m + 1e-3 >= interval.lower_m, "{} {interval:?}", node.geometry_m);
        assert!(matches!(d.verdict, Verdict::Honest | Verdict::Texture), "{d:?}");
    }
    assert!(certificates > 2 * measured.len(), "per class too: {certificates}");
    let page = page::html(&audit, "town").expect("a page");
    let outside = ["<script", "http://", "https://", "<link rel=\"stylesheet"];
    let used: Vec<_> = outside.iter().filter(|text| page.replace("http://www.w3.org", "").contains(**text)).collect();
    assert!(used.is_empty(), "the page needs {used:?}");
    assert!(page.matches("data:image/png;base64,").count() >= 3);
}

#[test]
fn planted_faults_are_found_and_named() {
    let town = town();
    let temp = tempfile::tempdir().expect("a folder");
    let folder = copy(temp.path());
    let inner: Vec<usize> = (1..town.nodes.len()).filter(|&n| !town.nodes[n].is_leaf).collect();
    assert!(inner.len() >= 4, "{inner:?}");
    let of_class = |n: usize, class: u32| town.nodes[n].tile.feature_ids.iter().filter(|&&c| c == class).count();

    // A vertex of one, and the roofs of another, moved by more than they state.
    let moved = &town.nodes[inner[0]];
    // The highest: on a wall it would only slide along.
    let highest = |a: &&DVec3, b: &&DVec3| a.z.total_cmp(&b.z);
    let at = *moved.tile.positions.iter().max_by(highest).expect("vertices");
    let is_it = |v: usize| moved.tile.positions[v].distance(at) < 1e-6;
    Glb::open(&folder, moved).lift(|v| if is_it(v) { moved.error_m + 2.0 } else { 0.0 });
    let lowered = inner[1..].iter().copied().max_by_key(|&n| of_class(n, 2)).expect("a tile");
    let roofs = &town.nodes[lowered];
    Glb::open(&folder, roofs).lift(|v| if roofs.tile.feature_ids[v] == 2 { -roofs.error_m - 3.0 } else { 0.0 });
    let rest: Vec<usize> = inner[1..].iter().copied().filter(|&n| n != lowered).collect();
    let swapped = rest.iter().copied().max_by_key(|&n| of_class(n, 1).min(of_class(n, 2))).expect("a tile");
    Glb::open(&folder, &town.nodes[swapped]).swap_classes(1, 2);
    let liar = *rest.iter().find(|&&n| n != swapped).expect("a tile");

    // A border vertex of a leaf by 5 cm; the image of another leaf blurred; the box of a third one shrunk.
    let leaves: Vec<usize> = (0..town.nodes.len()).filter(|&n| town.nodes[n].is_leaf).collect();
    let (cracked, border) = shared(&leaves);
    let cracked = &town.nodes[cracked];
    let is_border = |v: usize| cracked.tile.positions[v].distance(border) < 1e-3;
    Glb::open(&folder, cracked).lift(|v| if is_border(v) { 0.05 } else { 0.0 });
    let deepest = leaves.iter().map(|&n| town.nodes[n].level).max().expect("a level");
    let blurred =
        *leaves.iter().find(|&&n| town.nodes[n].level == deepest && town.nodes[n].uri != cracked.uri).expect("one");
    Glb::open(&folder, &town.nodes[blurred]).blur();
    let shrunk = *leaves.iter().rev().find(|&&n| n != blurred).expect("a leaf");
    edit(&folder, |root| {
        let one = tile(root, &town.nodes[shrunk].uri).expect("the tile");
        for i in 3..12 {
            one["boundingVolume"]["box"][i] = json!(0.5 * one["boundingVolume"]["box"][i].as_f64().expect("a number"));
        }
        let one = tile(root, &town.nodes[liar].uri).expect("the tile");
        one["geometricError"] = json!(0.01);
    });

    let audit = run(&folder, Some(1.0));
    wants(&audit, "understated", moved);
    wants(&audit, "understated", roofs);
    wants(&audit, "obstacle-lost", roofs);
    wants(&audit, "class-changed", &town.nodes[swapped]);
    wants(&audit, "understated", &town.nodes[liar]);
    wants(&audit, "texture-blurred", &town.nodes[blurred]);
    wants(&audit, "content-outside-volume", &town.nodes[shrunk]);
    // The roofs that were lowered tear their tile's border too.
    let names = |tile: usize| town.nodes[tile].uri == cracked.uri;
    let crack = audit.seams.cracks.iter().find(|c| names(c.tile) || names(c.neighbour)).expect("a crack");
    assert!((0.03..0.06).contains(&crack.gap_m), "{crack:?}");
    // The two frames have other origins: heights differ.
    assert!((DVec3::from_array(crack.local_m) - border).truncate().length() < 3.0, "{crack:?} {border}");
    assert_eq!(audit.seams.cracks.len(), audit.faults.iter().filter(|f| f.code == "crack").count());
    // The place of the moved vertex is named.
    let worst = audit.distances.iter().find(|d| town.nodes[d.tile].uri == moved.uri).and_then(|d| d.worst);
    let worst = DVec3::from_array(worst.expect("a place").local_m);
    assert!((worst - at).truncate().length() < 3.0, "{worst} {at}");
    assert_eq!(audit.reasons(&[Group::Understated, Group::Cracks, Group::Sizes]).len(), 2);
}

/// A leaf with a vertex that another leaf has too, and the vertex.
fn shared(leaves: &[usize]) -> (usize, DVec3) {
    let nodes = &town().nodes;
    let key = |p: DVec3| (p * 1000.0).round().to_array().map(|c| c as i64);
    for (i, &a) in leaves.iter().enumerate() {
        let own: std::collections::BTreeSet<_> = nodes[a].tile.positions.iter().map(|&p| key(p)).collect();
        for &b in &leaves[i + 1..] {
            let both: Vec<DVec3> = nodes[b].tile.positions.iter().copied().filter(|&p| own.contains(&key(p))).collect();
            if both.len() > 10 {
                return (b, both[both.len() / 2]);
            }
        }
    }
    panic!("no leaves meet");
}

/// Changes the numbers of a tile and of all below.
fn restate(tile: &mut Value, change: &impl Fn(&mut Value)) {
    change(tile);
    tile["children"].as_array_mut().into_iter().flatten().for_each(|child| restate(child, change));
}

#[test]
fn gaps_between_levels_are_cracks_where_neither_error_nor_skirt_accounts_for_them() {
    let temp = tempfile::tempdir().expect("a folder");
    let folder = copy(temp.path());
    let across = || {
        let faults = run(&folder, None).faults;
        faults.iter().filter(|fault| fault.code == "crack-across-levels").count()
    };
    edit(&folder, |root| restate(root, &|tile| tile["geometricError"] = 0.001.into()));
    assert_eq!(across(), 0, "skirts hide them");
    edit(&folder, |root| restate(root, &|tile| tile["metadata"]["properties"]["skirtDepth"] = 0.into()));
    assert!(across() > 0);
}

#[test]
fn a_missing_tile_is_named_and_the_tiles_above_are_not_accused_for_it() {
    let town = town();
    let temp = tempfile::tempdir().expect("a folder");
    let folder = copy(temp.path());
    let lost = town.nodes.iter().rev().find(|n| n.is_leaf).expect("a leaf");
    std::fs::remove_file(folder.join(&lost.uri)).expect("removed");
    let audit = run(&folder, None);
    wants(&audit, "tile-unreadable", lost);
    let parent = lost.parent.expect("a parent");
    wants(&audit, "hole-in-finer", &town.nodes[parent]);
    let above = audit.distances.iter().find(|d| d.tile == parent).expect("the parent");
    assert!(above.is_incomplete && above.verdict != Verdict::Understated, "{above:?}");
}

/// A GLB of triangles, z up turned to y up.
pub fn glb(positions: &[[f32; 3]], faces: &[[u32; 3]]) -> Vec<u8> {
    let mut bin: Vec<u8> = positions.iter().flat_map(|&[x, y, z]| [x, z, -y]).flat_map(f32::to_le_bytes).collect();
    bin.extend(faces.iter().flatten().flat_map(|v| v.to_le_bytes()));
    let json = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "buffers": [{ "byteLength": bin.len() }],
        "bufferViews": [
            { "buffer": 0, "byteLength": 12 * positions.len() },
            { "buffer": 0, "byteOffset": 12 * positions.len(), "byteLength": 12 * faces.len() }
        ],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": positions.len(), "type": "VEC3",
              "min": [-1e3, -1e3, -1e3], "max": [1e3, 1e3, 1e3] },
            { "bufferView": 1, "componentType": 5125, "count": 3 * faces.len(), "type": "SCALAR" }
        ]
    });
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let word = |n: usize| (n as u32).to_le_bytes();
    [
        b"glTF".to_vec(),
        word(2).to_vec(),
        word(28 + text.len() + bin.len()).to_vec(),
        word(text.len()).to_vec(),
        b"JSON".to_vec(),
        text,
        word(bin.len()).to_vec(),
        b"BIN\0".to_vec(),
        bin,
    ]
    .concat()
}

/// A flat roof of 20 m with a chimney of 0.5 m and 1.5 m height, and a coarser tile without it.
pub fn house(folder: &Path, error_m: f64) {
    let roof = vec![[0.0, 0.0, 5.0], [20.0, 0.0, 5.0], [20.0, 20.0, 5.0], [0.0, 20.0, 5.0]];
    let faces = vec![[0, 1, 2], [0, 2, 3]];
    std::fs::write(folder.join("coarse.glb"), glb(&roof, &faces)).expect("written");
    let (mut fine, mut fine_faces) = (roof, faces);
    for z in [5.0, 6.5] {
        fine.extend([[10.0, 10.0, z], [10.5, 10.0, z], [10.5, 10.5, z], [10.0, 10.5, z]]);
    }
    for i in 0..4 {
        let (a, b) = (4 + i, 4 + (i + 1) % 4);
        fine_faces.extend([[a, b, b + 4], [a, b + 4, a + 4]]);
    }
    fine_faces.extend([[8, 9, 10], [8, 10, 11]]);
    std::fs::write(folder.join("fine.glb"), glb(&fine, &fine_faces)).expect("written");
    let volume = json!({ "box": [10, 10, 5.75, 10, 0, 0, 0, 10, 0, 0, 0, 0.75] });
    let tileset = json!({
        "asset": { "version": "1.1" }, "geometricError": 50,
        "root": {
            "boundingVolume": volume, "geometricError": error_m, "refine": "REPLACE", "content": { "uri": "coarse.glb" },
            "children": [{ "boundingVolume": volume, "geometricError": 0, "content": { "uri": "fine.glb" } }]
        }
    });
    std::fs::write(folder.join("tileset.json"), tileset.to_string()).expect("written");
}

#[test]
fn a_removed_chimney_is_an_obstacle_lost_and_an_error_understated() {
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 0.2);
    let audit = run(temp.path(), Some(1.0));
    let one = &audit.distances[0];
    let interval = one.hausdorff.expect("an interval");
    assert!(interval.lower_m <= 1.5 + 1e-6 && 1.5 <= interval.upper_m + 1e-6, "{interval:?}");
    assert!((one.factor.expect("a factor") - 7.5).abs() < 0.2, "{one:?}");
    let codes = audit.codes();
    assert!(codes.contains_key("understated") && codes.contains_key("obstacle-lost"), "{codes:?}");
    assert!((audit.envelope_tiles[0].lost[0].sink_m - 1.5).abs() < 1e-3, "{:?}", audit.envelope_tiles[0].lost);
    let place = DVec3::from_array(one.worst.expect("a place").local_m);
    assert!(place.distance(DVec3::new(10.25, 10.25, 6.5)) < 0.5, "{place}");
}

#[test]
fn the_gate_speaks_in_exit_codes_and_a_rewritten_tileset_passes_it() {
    let temp = tempfile::tempdir().expect("a folder");
    let (folder, out) = (temp.path().join("in"), temp.path().join("out"));
    std::fs::create_dir(&folder).expect("a folder");
    house(&folder, 0.2);
    let text = |p: &Path| p.to_str().expect("UTF-8").to_owned();
    let fail_on = ["--fail-on", "understated,cracks,bounds"];
    rooftile(["audit", &text(&folder)]).wants(0);
    let failed = rooftile(["audit", &text(&folder), fail_on[0], fail_on[1]]).wants(1);
    assert!(failed.stderr.contains("understated") && failed.stderr.contains("coarse.glb"), "{}", failed.stderr);
    rooftile(["audit", &text(&folder), "--fail-on", "luck"]).wants(2);
    rooftile(["audit", &text(&folder), "--max-slack", "0.5"]).wants(2);

    let html = temp.path().join("page.html");
    let run =
        rooftile(["audit", &text(&folder), "--json", "-q", "--rewrite", &text(&out), "--html", &text(&html)]).wants(0);
    let json = run.json();
    assert_eq!(json["schema"], "rooftile-audit/1");
    assert_eq!(json["verdict"]["worst"], "understated");
    assert_eq!(json["rewrite"].as_array().map(Vec::len), Some(4));
    assert!(std::fs::read_to_string(&html).expect("a page").contains("UNDERSTATED"));
    rooftile(["audit", &text(&out), fail_on[0], fail_on[1], "-q"]).wants(0);
    rooftile(["audit", &text(&folder), "--rewrite", &text(&out)]).wants(5);
    rooftile(["audit", &text(&folder.join("nothing"))]).wants(3);
}

#[test]
fn against_the_original_a_finest_tile_has_an_error_too() {
    let temp = tempfile::tempdir().expect("a folder");
    house(temp.path(), 2.0);
    // The original: the house with its chimney 0.5 m higher.
    let obj =
        "v 0 0 5\nv 20 0 5\nv 20 20 5\nv 0 20 5\nv 10 10 7\nv 10.5 10 7\nv 10.5 10.5 7\nf 1 2 3\nf 1 3 4\nf 5 6 7\n";
    std::fs::write(temp.path().join("house.obj"), obj).expect("written");
    let original =
        rooftile::audit::source::OriginalConfig { inputs: vec![temp.path().join("house.obj")], georeference: None };
    let config = AuditConfig { original: Some(original), ..AuditConfig::default() };
    let audit = audit(temp.path(), &config, &Reporter::new(true)).expect("an audit");
    let fine = audit.distances.iter().find(|d| d.level == 1).expect("the finest tile");
    let interval = fine.hausdorff.expect("an interval");
    assert!(interval.lower_m >= 0.4 && fine.verdict == Verdict::Finest, "{fine:?}");
    let coarse = audit.distances.iter().find(|d| d.level == 0).expect("the coarse tile");
    assert!((coarse.hausdorff.expect("an interval").lower_m - 2.0).abs() < 1e-6, "{coarse:?}");
}
