//! Tilesets put together as the exporters in use write them, faults and all, each of known triangles: all must be read.
//!
//! What is odd about them was taken from reports of their users: keys of drafts, up axes, paths of Windows, packed files.

use std::io::Write;

use glam::DVec3;
use serde_json::json;

use super::tests::{Z_UP, b3dm, body, cmpt, folder, glb, glb1, gltf2, is_the_triangle, leaf, load, text, tileset};
use super::*;
use crate::geo::ellipsoid::ecef_from_geodetic;

type Files = Vec<(&'static str, Vec<u8>)>;

fn model() -> Vec<u8> {
    glb(&gltf2(), &body())
}

/// Opens the set and loads everything; `count` contents, all of them the triangle, which may be moved.
#[track_caller]
fn is_read(files: &Files, count: usize) -> Tileset {
    let temp = folder(files);
    let set = open(temp.path()).unwrap();
    let mut read = 0;
    for tile in (0..set.tiles.len()).filter(|&tile| set.tiles[tile].has_mesh()) {
        let meshes = set.load(tile, &Reporter::new(true)).unwrap_or_else(|r| panic!("{}: {r}", set.trail(tile)));
        for mesh in meshes {
            let [a, b, c] = mesh.positions[..] else { panic!("{:?}", mesh.positions) };
            let sides = [a.distance(b), b.distance(c), c.distance(a)];
            let wanted = [3.0, 34f64.sqrt(), 5.0];
            assert!(sides.iter().zip(wanted).all(|(side, wanted)| (side - wanted).abs() < 1e-3), "{sides:?}");
            read += 1;
        }
    }
    assert_eq!(read, count, "{:?}", set.warnings);
    set
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(bytes).unwrap();
    packed.finish().unwrap()
}

fn codes(set: &Tileset) -> Vec<&'static str> {
    set.warnings.iter().map(|warning| warning.code).collect()
}

/// A tileset for each block, keys of the drafts, glTF 1.0 with z up, paths with plus signs and backslashes.
#[test]
fn blocks_in_folders_with_keys_of_the_drafts() {
    let block = json!({
        "asset": { "version": "1.0", "gltfUpAxis": "Z" }, "geometricError": 30,
        "root": { "boundingVolume": { "sphere": [0, 0, 0, 20] }, "geometricError": 20, "refine": "replace",
                  "content": { "url": "Tile_+000_+001_L17_0.b3dm" },
                  "children": [{ "boundingVolume": { "sphere": [0, 0, 0, 20] }, "geometricError": 0,
                                 "content": { "url": ".\\Tile_+000_+001_L18_00.b3dm" }, "children": null }] }
    });
    let root = json!({
        "asset": { "version": "0.0", "gltfUpAxis": "Z" }, "geometricError": 1000,
        "root": { "boundingVolume": { "sphere": [0, 0, 0, 50] }, "geometricError": 50, "refine": "ADD",
                  "children": [
                      { "boundingVolume": { "sphere": [0, 0, 0, 50] }, "geometricError": 30,
                        "content": { "url": "Data/Tile_+000_+001/Tile_+000_+001.json" } },
                      { "boundingVolume": { "sphere": [0, 0, 0, 50] }, "geometricError": 30,
                        "content": { "url": "Data\\Tile_+000_+001\\Tile_+000_+001.json" } }] }
    });
    let set = is_read(
        &vec![
            ("tileset.json", text(root)),
            ("Data/Tile_+000_+001/Tile_+000_+001.json", text(block)),
            ("Data/Tile_+000_+001/Tile_+000_+001_L17_0.b3dm", b3dm(&glb1(), "")),
            ("Data/Tile_+000_+001/Tile_+000_+001_L18_00.b3dm", b3dm(&glb1(), "")),
        ],
        4,
    );
    assert!(set.tiles.iter().filter(|tile| tile.has_mesh()).all(|tile| tile.refine == Refine::Replace));
    assert_eq!(codes(&set), [""; 0]);
}

/// On the globe without a transform: the box in ECEF and the model's centre in the feature table or in CESIUM_RTC.
#[test]
fn models_that_are_put_on_the_globe_by_their_own_centre() {
    let place = Geodetic { lon_rad: 1.94, lat_rad: 0.69, height_m: 50.0 };
    let centre = ecef_from_geodetic(place);
    let volume = json!({ "box": [centre.x, centre.y, centre.z, 60.0, 0, 0, 0, 60.0, 0, 0, 0, 60.0] });
    let mut own = gltf2();
    own["extensions"] = json!({ "CESIUM_RTC": { "center": centre.to_array() } });
    own["extensionsUsed"] = json!(["CESIUM_RTC", "KHR_materials_unlit"]);
    own["extensionsRequired"] = json!(["CESIUM_RTC", "KHR_materials_unlit"]);
    let table = json!({ "BATCH_LENGTH": 0, "RTC_CENTER": centre.to_array() }).to_string();
    let block = json!({
        "asset": { "gltfUpAxis": "Z", "version": "0.0" }, "geometricError": 457.9,
        "root": { "boundingVolume": volume, "geometricError": 40, "refine": "REPLACE", "content": { "uri": "BlockY.b3dm" },
                  "children": [{ "boundingVolume": volume, "geometricError": 0, "content": { "uri": "BlockYA.b3dm" } }] }
    });
    let root = json!({
        "asset": { "gltfUpAxis": "Z", "version": "0.0" }, "geometricError": 1570.6,
        "root": { "boundingVolume": volume, "geometricError": 1570.6, "refine": "REPLACE",
                  "children": [{ "boundingVolume": volume, "geometricError": 457.9, "refine": "REPLACE",
                                 "content": { "uri": "BlockXYXY/tileset.json" } }] }
    });
    let set = is_read(
        &vec![
            ("tileset.json", text(root)),
            ("BlockXYXY/tileset.json", text(block)),
            ("BlockXYXY/BlockY.b3dm", b3dm(&glb(&own, &body()), "")),
            ("BlockXYXY/BlockYA.b3dm", b3dm(&model(), &table)),
        ],
        2,
    );
    let origin = set.frame.origin.expect("a place");
    assert!((origin.lon_rad - place.lon_rad).abs() < 1e-6 && (origin.height_m - 50.0).abs() < 1.0, "{origin:?}");
}

/// Packed twice over: gzip under names that do not say so, a byte order mark, queries, a refine beside the root.
#[test]
fn packed_contents_and_a_byte_order_mark() {
    let inner = json!({
        "asset": { "generatetool": "osgb2tiles", "version": "1.0" }, "geometricError": 9, "refine": "REPLACE",
        "root": { "boundingVolume": { "box": [0, 0, 0, 9, 0, 0, 0, 9, 0, 0, 0, 9] }, "geometricError": 0.65,
                  "content": { "uri": "./L19.b3dm?v=1.1&id=3" }, "transform": null }
    });
    let mut root = b"\xEF\xBB\xBF".to_vec();
    root.extend(text(json!({
        "asset": { "generatetool": "osgb2tiles", "version": "1.0" }, "geometricError": 163.4, "refine": "REPLACE",
        "root": { "boundingVolume": { "box": [0, 0, 0, 9, 0, 0, 0, 9, 0, 0, 0, 9] }, "refine": "REPLACE", "geometricError": 20,
                  "children": [{ "boundingVolume": { "region": [1.9, 0.69, 1.91, 0.7, 5.0, 50.0] }, "geometricError": 0.65,
                                 "content": { "uri": "./Tile_+000_+000/Tile_+000_+000.json" }, "refine": "REPLACE" }] }
    })));
    let set = is_read(
        &vec![
            ("tileset.json", root),
            ("Tile_+000_+000/Tile_+000_+000.json", gzip(&text(inner))),
            ("Tile_+000_+000/L19.b3dm", gzip(&b3dm(&model(), ""))),
        ],
        1,
    );
    assert_eq!(codes(&set), [""; 0]);
}

/// Names beyond ASCII, escaped or not, and files that are named as their URI is written.
#[test]
fn names_beyond_ascii_and_names_with_escapes() {
    let mut root = leaf("%E6%95%B0%E6%8D%AE/a%20b.b3dm");
    root["children"] = json!([leaf("数据/a b.b3dm"), leaf("as%20written.b3dm"), leaf("mesh.b3dm?id=7")]);
    root["geometricError"] = 5.into();
    let set = is_read(
        &vec![
            ("tileset.json", text(tileset(root))),
            ("数据/a b.b3dm", b3dm(&model(), "")),
            ("as%20written.b3dm", b3dm(&model(), "")),
            ("mesh.b3dm?id=7", b3dm(&model(), "")),
        ],
        4,
    );
    assert_eq!(codes(&set), [""; 0]);
}

/// Half axes below zero, errors that are missing or text, numbers that are none.
#[test]
fn members_that_are_missing_or_of_a_wrong_kind_do_not_lose_the_rest() {
    let root = json!({
        "asset": { "version": 1.0, "generator": null }, "geometricError": "9.029",
        "root": {
            "transform": null, "geometricError": "9.0", "refine": 1, "content": "LOD-2/Mesh-XL-YL.b3dm",
            "boundingVolume": { "box": [2, -3, 4, 3.5, 0, 0, 0, -2.4, 0, 0, 0, 4.7] },
            "children": [
                { "boundingVolume": { "box": [0, 0, 0, 9, 0, null, 0, 9, 0, 0, 0, 9] }, "content": { "uri": "LOD-0/a.b3dm" } },
                { "boundingVolume": null, "geometricError": null, "content": { "uri": "LOD-0/a.b3dm" }, "children": [] },
                { "boundingVolume": { "region": [1.9, 0.6, 1.91, 0.7, 90.0, 5.0] }, "geometricError": -1,
                  "content": { "url": "LOD-0/a.b3dm", "boundingVolume": "none" }, "extensions": 3, "contents": {} }
            ]
        }
    });
    let set = is_read(
        &vec![
            ("tileset.json", text(root)),
            ("LOD-2/Mesh-XL-YL.b3dm", b3dm(&model(), "")),
            ("LOD-0/a.b3dm", b3dm(&model(), "")),
        ],
        4,
    );
    assert_eq!(set.tiles[0].geometric_error_m, 9.0);
    assert_eq!(set.tiles[0].volume.expect("a box").outside_m(DVec3::new(2.0, -5.0, 4.0)), 0.0);
    for code in ["bad-refine", "bad-volume", "volume-missing", "geometric-error-missing"] {
        assert!(codes(&set).contains(&code), "{code}: {:?}", set.warnings);
    }
}

/// What no parser of JSON takes: a comma too many, NaN, single backslashes; and keys that stand twice.
#[test]
fn json_that_is_none_is_read_and_told_of() {
    let said = r#"{ "asset": { "version": "1.0" }, "geometricError": 8, "geometricError": 9, // twice
        "root": { "boundingVolume": { "box": [0,0,NaN, 9,0,0, 0,9,0, 0,0,9,] }, "geometricError": Infinity,
                  "content": { "uri": "Data\Mesh.b3dm" }, } }"#;
    let files = vec![("tileset.json", said.as_bytes().to_vec()), ("Data/Mesh.b3dm", b3dm(&model(), ""))];
    let set = is_read(&files, 1);
    assert!(codes(&set).contains(&"json-mended"), "{:?}", set.warnings);
    assert_eq!(set.files[0].geometric_error_m, Some(9.0));
}

/// Lengths in the header of a b3dm that do not count the padding, or lead nowhere.
#[test]
fn headers_of_b3dm_that_are_wrong() {
    let sound = b3dm(&model(), "");
    for (at, value) in [(8, sound.len() as u32 + 5), (8, 40), (8, 0), (20, 3), (16, 9999)] {
        let mut wrong = sound.clone();
        wrong[at..at + 4].copy_from_slice(&value.to_le_bytes());
        is_the_triangle(&load("a.b3dm", wrong).unwrap_or_else(|r| panic!("{at} {value}: {r}"))[0]);
    }
    assert_eq!(load("a.b3dm", sound[..40].to_vec()).unwrap_err().code, "broken-b3dm");
}

/// Images in techniques, positions quantized by a matrix: written into glTF 2.0 by early converters.
#[test]
fn techniques_and_quantized_attributes_in_gltf_2() {
    for name in ["KHR_techniques_webgl", "KHR_technique_webgl"] {
        let mut json = gltf2();
        json["extensionsRequired"] = json!([name]);
        json["materials"] = json!([{ "extensions": { name: { "technique": 0, "values": { "u_shine": 1.0, "u_tex": { "index": 0, "texCoord": 0 } } } } }]);
        is_the_triangle(&load("a.b3dm", b3dm(&glb(&json, &body()), "")).unwrap()[0]);
    }
    let mut json = gltf2();
    json["extensionsRequired"] = json!(["WEB3D_quantized_attributes"]);
    let matrix = [2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 1.0, 0.0, 0.0, 1.0];
    json["accessors"][0]["extensions"] = json!({ "WEB3D_quantized_attributes": { "decodeMatrix": matrix } });
    let mesh = load("a.glb", glb(&json, &body())).unwrap().remove(0);
    let wanted = Z_UP.map(|p| DVec3::from(p) * 2.0 + DVec3::X);
    assert!(mesh.positions.iter().zip(wanted).all(|(p, w)| p.distance(w) < 1e-6), "{:?}", mesh.positions);
    let mut json = gltf2();
    json["extensionsRequired"] = json!(["ACME_secret_geometry"]);
    assert_eq!(load("a.glb", glb(&json, &body())).unwrap_err().code, "required-extension");
}

/// A refused content is named with its reason; those beside it are read.
#[test]
fn what_is_refused_is_named_and_the_rest_is_read() {
    let mut root = leaf("a.b3dm");
    root["children"] = json!([leaf("b.pnts"), leaf("c.cmpt"), leaf("missing.b3dm"), leaf("http://else.where/x.b3dm")]);
    let files: Files = vec![
        ("tileset.json", text(tileset(root))),
        ("a.b3dm", b3dm(&model(), "")),
        ("b.pnts", b"pnts\x01\0\0\0".to_vec()),
        ("c.cmpt", cmpt(&[b3dm(&model(), ""), b3dm(&glb1(), "")])),
    ];
    let temp = folder(&files);
    let set = open(temp.path()).unwrap();
    let found: Vec<Result<usize, &str>> = (0..set.tiles.len())
        .map(|tile| set.load(tile, &Reporter::new(true)).map(|meshes| meshes.len()).map_err(|refusal| refusal.code))
        .collect();
    assert_eq!(found, [Ok(1), Err("pnts"), Ok(2), Err("missing"), Err("bad-uri")]);
}
