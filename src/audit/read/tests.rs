//! Handmade tilesets of every kind, each with one triangle that is known.

use std::io::Write;
use std::path::Path;

use glam::{DVec3, Vec2};
use serde_json::{Value, json};

use super::*;
use crate::audit::structure::{self, StructureConfig};

/// One triangle in glTF axes (y up): (1, 2, 3), (4, 2, 3), (1, 7, 3), with UVs over half of an image.
pub(super) const POSITIONS: [[f32; 3]; 3] = [[1.0, 2.0, 3.0], [4.0, 2.0, 3.0], [1.0, 7.0, 3.0]];
/// The same with z up, as tiles have it.
pub(super) const Z_UP: [[f64; 3]; 3] = [[1.0, -3.0, 2.0], [4.0, -3.0, 2.0], [1.0, -3.0, 7.0]];
pub(super) const UVS: [[f32; 2]; 3] = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];

pub(super) fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

pub(super) fn png() -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(8, 4).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

/// Positions, UVs, indices, PNG.
pub(super) fn body() -> Vec<u8> {
    let mut bytes = floats(POSITIONS.as_flattened());
    bytes.extend(floats(UVS.as_flattened()));
    bytes.extend([0u16, 1, 2, 0].iter().flat_map(|i| i.to_le_bytes()));
    bytes.extend(png());
    while !bytes.len().is_multiple_of(4) {
        bytes.push(0);
    }
    bytes
}

pub(super) fn gltf2() -> Value {
    json!({
        "asset": { "version": "2.0" },
        "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0, "TEXCOORD_0": 1 }, "indices": 2, "material": 0 }] }],
        "materials": [{ "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } }],
        "textures": [{ "source": 0 }], "images": [{ "bufferView": 3, "mimeType": "image/png" }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3" },
            { "bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2" },
            { "bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR" }
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": 36 }, { "buffer": 0, "byteOffset": 36, "byteLength": 24 },
            { "buffer": 0, "byteOffset": 60, "byteLength": 6 }, { "buffer": 0, "byteOffset": 68, "byteLength": png().len() }
        ],
        "buffers": [{ "byteLength": body().len() }]
    })
}

pub(super) fn glb(json: &Value, bin: &[u8]) -> Vec<u8> {
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut bytes = b"glTF".to_vec();
    let total = 12 + 8 + text.len() + 8 + bin.len();
    for word in [2, total as u32, text.len() as u32, 0x4E4F_534A] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend(&text);
    bytes.extend((bin.len() as u32).to_le_bytes());
    bytes.extend(b"BIN\0");
    bytes.extend(bin);
    bytes
}

/// The same triangle in glTF 1.0, binary, with a shader, as the first tilers wrote it.
pub(super) fn glb1() -> Vec<u8> {
    let json = json!({
        "asset": { "version": "1.0" }, "extensionsUsed": ["KHR_binary_glTF"],
        "scene": "defaultScene", "scenes": { "defaultScene": { "nodes": ["n"] } }, "nodes": { "n": { "meshes": ["m"] } },
        "meshes": { "m": { "primitives": [{
            "attributes": { "POSITION": "p", "TEXCOORD_0": "t" }, "indices": "i", "material": "mat", "mode": 4 }] } },
        "materials": { "mat": { "technique": "tech", "values": { "tex": "texture" } } },
        "techniques": { "tech": { "program": "prog" } }, "programs": { "prog": { "vertexShader": "vs" } },
        "shaders": { "vs": { "type": 35633, "uri": "data:,", "extensions": { "KHR_binary_glTF": { "bufferView": "b3" } } } },
        "textures": { "texture": { "source": "image" } },
        "images": { "image": { "uri": "data:,", "extensions": { "KHR_binary_glTF": { "bufferView": "b3" } } } },
        "accessors": {
            "p": { "bufferView": "b0", "byteOffset": 0, "byteStride": 12, "componentType": 5126, "count": 3, "type": "VEC3" },
            "t": { "bufferView": "b0", "byteOffset": 36, "byteStride": 8, "componentType": 5126, "count": 3, "type": "VEC2" },
            "i": { "bufferView": "b1", "byteOffset": 0, "byteStride": 0, "componentType": 5123, "count": 3, "type": "SCALAR" }
        },
        "bufferViews": {
            "b0": { "buffer": "binary_glTF", "byteOffset": 0, "byteLength": 60 },
            "b1": { "buffer": "binary_glTF", "byteOffset": 60, "byteLength": 6 },
            "b3": { "buffer": "binary_glTF", "byteOffset": 68, "byteLength": png().len() }
        },
        "buffers": { "binary_glTF": { "byteLength": body().len(), "uri": "data:," } }
    });
    let text = json.to_string().into_bytes();
    let mut bytes = b"glTF".to_vec();
    for word in [1, (20 + text.len() + body().len()) as u32, text.len() as u32, 0] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend(text);
    bytes.extend(body());
    bytes
}

pub(super) fn b3dm(gltf: &[u8], feature_table: &str) -> Vec<u8> {
    let batch_table = br#"{"name":["a"]}  "#;
    let sizes = [feature_table.len(), 0, batch_table.len(), 0];
    let total = 28 + sizes.iter().sum::<usize>() + gltf.len();
    let mut bytes = b"b3dm".to_vec();
    for word in [1, total].into_iter().chain(sizes) {
        bytes.extend((word as u32).to_le_bytes());
    }
    bytes.extend(feature_table.as_bytes());
    bytes.extend(batch_table);
    bytes.extend(gltf);
    bytes
}

pub(super) fn cmpt(tiles: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = b"cmpt".to_vec();
    for word in [1, 16 + tiles.iter().map(Vec::len).sum::<usize>(), tiles.len()] {
        bytes.extend((word as u32).to_le_bytes());
    }
    bytes.extend(tiles.concat());
    bytes
}

pub(super) fn leaf(uri: &str) -> Value {
    json!({ "boundingVolume": { "box": [0, 0, 0, 9, 0, 0, 0, 9, 0, 0, 0, 9] }, "geometricError": 0, "content": { "uri": uri } })
}

pub(super) fn tileset(root: Value) -> Value {
    json!({ "asset": { "version": "1.0" }, "geometricError": 8, "root": root })
}

/// A folder of files.
pub(super) fn folder(files: &[(&str, Vec<u8>)]) -> tempfile::TempDir {
    let temp = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        let path = temp.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    temp
}

pub(super) fn text(value: Value) -> Vec<u8> {
    value.to_string().into_bytes()
}

/// Loads the content `bytes` of a one-tile set.
pub(super) fn load(name: &str, bytes: Vec<u8>) -> Result<Vec<TileMesh>, Refusal> {
    let temp = folder(&[("tileset.json", text(tileset(leaf(name)))), (name, bytes)]);
    open(temp.path()).unwrap().load(0, &Reporter::new(true))
}

#[track_caller]
pub(super) fn same(found: &[DVec3], wanted: &[[f64; 3]]) {
    assert_eq!(found.len(), wanted.len());
    for (found, &wanted) in found.iter().zip(wanted) {
        assert!(found.distance(wanted.into()) < 1e-6, "{found} {wanted:?}");
    }
}

#[track_caller]
pub(super) fn is_the_triangle(mesh: &TileMesh) {
    same(&mesh.positions, &Z_UP);
    assert_eq!(mesh.faces, [[0, 1, 2]]);
    assert_eq!(mesh.uvs, UVS.map(Vec2::from));
    assert_eq!(mesh.parts, [Part { faces: 0..1, texture: Some(0) }]);
    assert_eq!((mesh.textures[0].size_px, mesh.textures[0].format), (Some([8, 4]), "png"));
}

#[test]
fn a_glb_is_turned_z_up() {
    let meshes = load("a.glb", glb(&gltf2(), &body())).unwrap();
    is_the_triangle(&meshes[0]);
    assert_eq!(meshes[0].bytes, glb(&gltf2(), &body()).len() as u64);
}

#[test]
fn a_gltf_finds_its_buffer_beside_it_and_nowhere_else() {
    let mut json = gltf2();
    json["buffers"][0]["uri"] = "../shared/b%20b.bin".into();
    let set = text(tileset(leaf("t/a.gltf")));
    let temp = folder(&[("tileset.json", set.clone()), ("t/a.gltf", text(json.clone())), ("shared/b b.bin", body())]);
    is_the_triangle(&open(temp.path()).unwrap().load(0, &Reporter::new(true)).unwrap()[0]);
    json["buffers"][0]["uri"] = "../../b.bin".into();
    let temp = folder(&[("in/tileset.json", set), ("in/t/a.gltf", text(json)), ("b.bin", body())]);
    let refusal = open(&temp.path().join("in")).unwrap().load(0, &Reporter::new(true)).unwrap_err();
    assert!(refusal.what.contains("leads out"), "{refusal}");
}

#[test]
fn a_b3dm_of_either_gltf_is_read_and_moved_by_its_center() {
    is_the_triangle(&load("a.b3dm", b3dm(&glb(&gltf2(), &body()), "")).unwrap()[0]);
    for inner in [glb(&gltf2(), &body()), glb1()] {
        let meshes = load("a.b3dm", b3dm(&inner, r#"{"BATCH_LENGTH":0,"RTC_CENTER":[10,20,30]}  "#)).unwrap();
        same(&meshes[0].positions, &Z_UP.map(|[x, y, z]| [x + 10.0, y + 20.0, z + 30.0]));
        assert_eq!(meshes[0].textures[0].size_px, Some([8, 4]));
    }
}

#[test]
fn a_binary_gltf_of_version_1_is_read() {
    is_the_triangle(&load("a.glb", glb1()).unwrap()[0]);
}

#[test]
fn a_composite_gives_what_it_holds_and_a_lone_point_cloud_is_refused() {
    let points = b"pnts\x01\0\0\0\x1c\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0".to_vec();
    let inner = cmpt(&[b3dm(&glb1(), ""), points.clone()]);
    let meshes = load("a.cmpt", cmpt(&[inner, b3dm(&glb(&gltf2(), &body()), "")])).unwrap();
    assert_eq!(meshes.len(), 2);
    meshes.iter().for_each(is_the_triangle);
    assert_eq!(load("a.cmpt", cmpt(std::slice::from_ref(&points))).unwrap_err().code, "pnts");
    assert_eq!(load("a.pnts", points).unwrap_err().code, "pnts");
    let deep = (0..20).fold(b3dm(&glb1(), ""), |inner, _| cmpt(&[inner]));
    assert_eq!(load("a.cmpt", deep).unwrap_err().code, "broken-cmpt");
}

#[test]
fn no_cut_or_flipped_content_panics() {
    let whole = cmpt(&[b3dm(&glb1(), r#"{"RTC_CENTER":[1,2,3]}  "#), b3dm(&glb(&gltf2(), &body()), "")]);
    let temp = folder(&[("tileset.json", text(tileset(leaf("a.cmpt")))), ("a.cmpt", whole.clone())]);
    let set = open(temp.path()).unwrap();
    let path = temp.path().join("a.cmpt");
    for cut in (0..whole.len()).step_by(3) {
        std::fs::write(&path, &whole[..cut]).unwrap();
        assert!(set.load(0, &Reporter::new(true)).is_err(), "cut at {cut}");
    }
    for byte in (0..whole.len()).step_by(2) {
        let mut flipped = whole.clone();
        flipped[byte] ^= 1 << (byte / 2 % 8);
        std::fs::write(&path, &flipped).unwrap();
        let _ = set.load(0, &Reporter::new(true));
    }
}

#[test]
fn transforms_chain_over_external_tilesets_and_the_up_axis_is_inherited() {
    let shift = |x: f64| json!([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, 0, 0, 1]);
    let mut outer = leaf("sub/inner.json?v=1");
    outer["transform"] = shift(100.0);
    let mut inner = leaf("a.glb");
    inner["transform"] = shift(1000.0);
    let mut set = tileset(outer);
    set["asset"]["gltfUpAxis"] = "Z".into();
    let files =
        [("tileset.json", text(set)), ("sub/inner.json", text(tileset(inner))), ("sub/a.glb", glb(&gltf2(), &body()))];
    let set = open(folder(&files).path()).map(|set| (set.tiles.len(), set)).unwrap();
    assert_eq!((set.0, set.1.files.len(), set.1.tiles[1].parent), (2, 2, Some(0)));
    let temp = folder(&files);
    let mesh = open(temp.path()).unwrap().load(1, &Reporter::new(true)).unwrap().remove(0);
    let z_up = POSITIONS.map(|p| [f64::from(p[0]) + 1100.0, f64::from(p[1]), f64::from(p[2])]);
    same(&mesh.positions, &z_up);
    let x_up = UpAxis::X.z_up().transform_point3(DVec3::new(1.0, 2.0, 3.0));
    assert!(x_up.distance(DVec3::new(-3.0, 2.0, 1.0)) < 1e-12);
}

#[test]
fn tilesets_that_refer_to_each_other_end() {
    let files = [("tileset.json", text(tileset(leaf("b.json")))), ("b.json", text(tileset(leaf("tileset.json"))))];
    let set = open(folder(&files).path()).unwrap();
    assert_eq!(set.tiles.len(), 2);
    assert_eq!(set.warnings.iter().map(|w| w.code).collect::<Vec<_>>(), ["tileset-cycle"]);
}

#[test]
fn a_tileset_on_the_globe_is_loaded_about_its_centre() {
    let place = Geodetic::from_degrees(11.5, 48.1, 520.0);
    let mut root = leaf("a.glb");
    root["transform"] = json!(ecef_from_enu(place).to_cols_array());
    let temp = folder(&[("tileset.json", text(tileset(root))), ("a.glb", glb(&gltf2(), &body()))]);
    let set = open(temp.path()).unwrap();
    assert!((set.frame.origin.unwrap().height_m - 520.0).abs() < 1e-6);
    is_the_triangle(&set.load(0, &Reporter::new(true)).unwrap()[0]);
}

/// A quadtree of two levels in subtrees of one: the root, and its children 0 and 3 by a bitstream.
fn implicit(is_binary: bool) -> Vec<(&'static str, Vec<u8>)> {
    let mut root = json!({
        "boundingVolume": { "box": [0, 0, 0, 8, 0, 0, 0, 8, 0, 0, 0, 8] }, "geometricError": 4, "refine": "REPLACE",
        "implicitTiling": { "subdivisionScheme": "QUADTREE", "subtreeLevels": 1, "availableLevels": 2,
                            "subtrees": { "uri": "s/{level}.{x}.{y}.subtree" } }
    });
    root["contents"] = json!([{ "uri": "{level}/{x}/{y}.glb" }, { "uri": "never.glb" }]);
    let head = json!({
        "buffers": [{ "byteLength": 1, "uri": "bits.bin" }], "bufferViews": [{ "buffer": 0, "byteLength": 1 }],
        "tileAvailability": { "constant": 1 }, "contentAvailability": [{ "constant": 1 }, { "constant": 0 }],
        "childSubtreeAvailability": { "bitstream": 0 }
    });
    let top = if is_binary {
        let mut head = head.clone();
        head["buffers"][0].as_object_mut().unwrap().remove("uri");
        let mut json = text(head);
        json.resize(json.len().next_multiple_of(8), b' ');
        let mut bytes = b"subt\x01\0\0\0".to_vec();
        bytes.extend((json.len() as u64).to_le_bytes());
        bytes.extend(8u64.to_le_bytes());
        bytes.extend(json);
        bytes.extend([0b1001, 0, 0, 0, 0, 0, 0, 0]);
        bytes
    } else {
        text(head)
    };
    let low = json!({ "tileAvailability": { "constant": 1 }, "contentAvailability": [{ "constant": 1 }],
                      "childSubtreeAvailability": { "constant": 1 } });
    vec![
        ("tileset.json", text(tileset(root))),
        ("s/0.0.0.subtree", top),
        ("s/bits.bin", vec![0b1001]),
        ("s/1.0.0.subtree", text(low.clone())),
        ("s/1.1.1.subtree", text(low)),
        ("1/1/1.glb", glb(&gltf2(), &body())),
    ]
}

#[test]
fn implicit_tiles_are_those_of_their_subtrees() {
    for is_binary in [false, true] {
        let temp = folder(&implicit(is_binary));
        let set = open(temp.path()).unwrap();
        assert_eq!(set.warnings.iter().map(|w| &w.first).collect::<Vec<_>>(), Vec::<&String>::new());
        let uris: Vec<&str> = set.tiles.iter().map(|tile| &*tile.contents[0].uri).collect();
        assert_eq!(uris, ["0/0/0.glb", "1/0/0.glb", "1/1/1.glb"]);
        assert!(set.tiles.iter().all(|tile| tile.contents.len() == 1));
        assert_eq!((set.tiles[2].geometric_error_m, set.tiles[2].implicit), (2.0, Some([1, 1, 1, 0])));
        let half = [DVec3::X * 4.0, DVec3::Y * 4.0, DVec3::Z * 8.0];
        assert_eq!(set.tiles[2].volume, Some(Volume::Box { centre: DVec3::new(4.0, 4.0, 0.0), half }));
        is_the_triangle(&set.load(2, &Reporter::new(true)).unwrap()[0]);
        assert_eq!(set.load(1, &Reporter::new(true)).unwrap_err().code, "missing");
    }
}

#[test]
fn a_subtree_that_claims_everything_ends() {
    let all = json!({ "tileAvailability": { "constant": 1 }, "contentAvailability": { "constant": 1 },
                      "childSubtreeAvailability": { "constant": 1 } });
    let root = json!({
        "boundingVolume": { "region": [0, 0, 1, 1, 0, 1] }, "geometricError": 4,
        "implicitTiling": { "subdivisionScheme": "OCTREE", "subtreeLevels": 3, "availableLevels": 1_000_000,
                            "subtrees": { "uri": "s.subtree" } }
    });
    let temp = folder(&[("tileset.json", text(tileset(root))), ("s.subtree", text(all))]);
    let set = open(temp.path()).unwrap();
    assert!(set.tiles.len() <= tree::MAX_TILES);
    assert!(set.warnings.iter().any(|w| w.code == "too-many-tiles"));
}

#[test]
fn archives_are_read_stored_and_deflated_and_not_left() {
    use zip::write::SimpleFileOptions;
    for method in [zip::CompressionMethod::Stored, zip::CompressionMethod::Deflated] {
        let temp = tempfile::tempdir().unwrap();
        let path = temp.path().join("a.3tz");
        let mut archive = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
        let options = SimpleFileOptions::default().compression_method(method);
        for (name, bytes) in [("tileset.json", text(tileset(leaf("t/a.glb")))), ("t/a.glb", glb(&gltf2(), &body()))] {
            archive.start_file(name, options).unwrap();
            archive.write_all(&bytes).unwrap();
        }
        archive.finish().unwrap();
        is_the_triangle(&open(&path).unwrap().load(0, &Reporter::new(true)).unwrap()[0]);
        // The same as a content of a tileset in a folder.
        std::fs::write(temp.path().join("tileset.json"), text(tileset(leaf("a.3tz")))).unwrap();
        let set = open(temp.path()).unwrap();
        is_the_triangle(&set.load(1, &Reporter::new(true)).unwrap()[0]);
    }
}

#[test]
fn classes_come_from_any_property_table_with_an_enum() {
    let mut json = gltf2();
    json["meshes"][0]["primitives"][0]["attributes"]["_FEATURE_ID_0"] = 3.into();
    json["meshes"][0]["primitives"][0]["extensions"] =
        json!({ "EXT_mesh_features": { "featureIds": [{ "featureCount": 2, "attribute": 0, "propertyTable": 0 }] } });
    json["extensions"] = json!({ "EXT_structural_metadata": {
        "schema": {
            "enums": { "E": { "valueType": "UINT8", "values": [{ "name": "roof", "value": 7 }, { "name": "wall", "value": 9 }] } },
            "classes": { "c": { "properties": { "surfaceClass": { "type": "ENUM", "enumType": "E" } } } } },
        "propertyTables": [{ "class": "c", "count": 2, "properties": { "surfaceClass": { "values": 5 } } }] } });
    let mut bin = body();
    let at = bin.len();
    bin.extend(floats(&[1.0, 1.0, 1.0]));
    bin.extend([9, 7, 0, 0]);
    json["accessors"]
        .as_array_mut()
        .unwrap()
        .push(json!({ "bufferView": 4, "componentType": 5126, "count": 3, "type": "SCALAR" }));
    for (offset, length) in [(at, 12), (at + 12, 2)] {
        let view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": length });
        json["bufferViews"].as_array_mut().unwrap().push(view);
    }
    json["buffers"][0]["byteLength"] = bin.len().into();
    let meshes = load("a.glb", glb(&json, &bin)).unwrap();
    assert_eq!(meshes[0].classes, Some(FaceClasses { names: vec!["roof".into()], of_face: vec![0] }));
}

/// A Draco stream of the triangle, sequential and uncompressed.
fn draco_stream() -> Vec<u8> {
    let mut bytes = b"DRACO\x02\x02\x01\0\0\0".to_vec();
    // Triangles, points, plain indices; one attribute decoder with one attribute: positions, floats, 3, id 0; raw.
    bytes.extend([1, 3, 1, 0, 1, 2, 1, 1, 0, 9, 3, 0, 0, 0]);
    bytes.extend(floats(POSITIONS.as_flattened()));
    bytes
}

fn draco_glb() -> Vec<u8> {
    let mut json = gltf2();
    let bin = draco_stream();
    json["extensionsRequired"] = json!(["KHR_draco_mesh_compression"]);
    json["meshes"][0]["primitives"][0] = json!({ "attributes": { "POSITION": 0 }, "indices": 1,
        "extensions": { "KHR_draco_mesh_compression": { "bufferView": 0, "attributes": { "POSITION": 0 } } } });
    json["accessors"] = json!([{ "componentType": 5126, "count": 3, "type": "VEC3" },
                               { "componentType": 5123, "count": 3, "type": "SCALAR" }]);
    json["bufferViews"] = json!([{ "buffer": 0, "byteLength": bin.len() }]);
    json["images"] = json!([]);
    json["buffers"][0]["byteLength"] = bin.len().into();
    glb(&json, &bin)
}

#[cfg(feature = "draco")]
#[test]
fn a_draco_stream_is_decoded_and_no_flipped_one_panics() {
    let whole = draco_glb();
    let mesh = load("a.glb", whole.clone()).unwrap().remove(0);
    same(&mesh.positions, &Z_UP);
    assert_eq!(mesh.faces, [[0, 1, 2]]);
    let from = whole.len() - draco_stream().len();
    for bit in 0..8 * draco_stream().len() {
        let mut flipped = whole.clone();
        flipped[from + bit / 8] ^= 1 << (bit % 8);
        let _ = load("a.glb", flipped);
    }
}

/// A sheet of 7 × 7 vertices as a common packer writes it, with connectivity and predictions.
#[cfg(feature = "draco")]
#[test]
fn a_draco_stream_of_a_common_packer_is_the_sheet_that_was_packed() {
    let whole = include_bytes!("../../../fixtures/draco_grid.glb");
    let mesh = load("a.glb", whole.to_vec()).unwrap().remove(0);
    assert_eq!((mesh.faces.len(), mesh.positions.len()), (72, 49));
    for p in &mesh.positions {
        // z up: x is i / 2, y is j / 2.
        let height = (p.x / 0.5 * 0.9).sin() * (p.y / 0.5 * 0.7).cos();
        assert!((p.z - height).abs() < 1e-3, "{p}");
    }
    let area = |f: &[u32; 3]| {
        let [a, b, c] = f.map(|v| mesh.positions[v as usize].truncate());
        (b - a).perp_dot(c - a) / 2.0
    };
    assert!((mesh.faces.iter().map(area).sum::<f64>() - 9.0).abs() < 1e-2, "all faces are turned upwards");
    for at in (0..whole.len()).step_by(7) {
        let mut flipped = whole.to_vec();
        flipped[at] ^= 0x55;
        let _ = load("a.glb", flipped);
    }
}

/// Serves a folder on a port of this machine, one request at a time; ends with the test.
#[cfg(feature = "http")]
fn serve(folder: std::path::PathBuf) -> String {
    use std::io::{BufRead, BufReader};
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let origin = format!("http://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
            let first = lines.next().unwrap().unwrap();
            lines.map_while(Result::ok).take_while(|line| !line.is_empty()).for_each(drop);
            let path = first.split(' ').nth(1).unwrap();
            // The token comes with every request.
            let (path, query) = path.split_once('?').unwrap_or((path, ""));
            let file =
                std::fs::read(folder.join(path.trim_start_matches('/'))).ok().filter(|_| query.contains("token=7"));
            let (status, body) = file.map_or(("404 Not Found", Vec::new()), |body| ("200 OK", body));
            let head = format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
            let _ = stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(&body));
        }
    });
    origin
}

#[cfg(feature = "http")]
#[test]
fn a_tileset_on_a_server_is_read_over_external_tilesets_and_what_is_missing_is_told() {
    let mut root = leaf("a.b3dm");
    let outside = leaf("http://127.0.0.2/x.glb");
    root["children"] = json!([leaf("b/tileset.json?v=2&token=7"), leaf("none.glb"), outside]);
    let model = glb(&gltf2(), &body());
    let temp = folder(&[
        ("set/tileset.json", text(tileset(root))),
        ("set/a.b3dm", b3dm(&model, "")),
        ("set/b/tileset.json", text(tileset(leaf("../c.glb")))),
        ("set/c.glb", model),
    ]);
    let origin = serve(temp.path().to_path_buf());
    let set = open(Path::new(&format!("{origin}/set/?token=7"))).unwrap();
    let reporter = Reporter::new(true);
    let found: Vec<Result<usize, &str>> = (0..set.tiles.len())
        .filter(|&tile| set.tiles[tile].has_mesh())
        .map(|tile| set.load(tile, &reporter).map(|meshes| meshes.len()).map_err(|refusal| refusal.code))
        .collect();
    assert_eq!(found, [Ok(1), Ok(1), Err("missing"), Err("bad-uri")], "{:?}", set.warnings);
    is_the_triangle(&set.load(0, &reporter).unwrap()[0]);
    assert!(open(Path::new(&format!("{origin}/set/tileset.json"))).is_err(), "without the token there is nothing");
}

#[cfg(not(feature = "draco"))]
#[test]
fn draco_without_a_decoder_is_refused_by_name() {
    let refusal = load("a.glb", draco_glb()).unwrap_err();
    assert_eq!(refusal.code, "draco");
}

#[test]
fn the_old_key_of_a_content_and_old_headers_of_b3dm_are_known() {
    let mut root = leaf("a.b3dm");
    root["content"] = json!({ "url": "a.b3dm" });
    let gltf = glb(&gltf2(), &body());
    let batch = br#"{"a":[1]}   "#;
    let mut old = b"b3dm".to_vec();
    for word in [1, 20 + batch.len() + gltf.len(), 1, batch.len()] {
        old.extend((word as u32).to_le_bytes());
    }
    old.extend(batch);
    old.extend(gltf);
    let temp = folder(&[("tileset.json", text(tileset(root))), ("a.b3dm", old)]);
    is_the_triangle(&open(temp.path()).unwrap().load(0, &Reporter::new(true)).unwrap()[0]);
}

/// Findings of a parent over a child, both with the triangle.
fn findings(change: impl Fn(&mut Value)) -> Vec<(&'static str, usize)> {
    let mut root = leaf("a.glb");
    root["geometricError"] = 4.into();
    root["refine"] = "REPLACE".into();
    root["children"] = json!([leaf("a.glb")]);
    change(&mut root);
    let temp = folder(&[("tileset.json", text(tileset(root))), ("a.glb", glb(&gltf2(), &body()))]);
    let set = open(temp.path()).unwrap();
    let found = structure::measure(&set, &StructureConfig::default(), &Reporter::new(true)).unwrap();
    found.findings.iter().map(|finding| (finding.code, finding.tile)).collect()
}

#[test]
fn planted_faults_of_structure_are_found_and_sound_sets_have_none() {
    assert_eq!(findings(|_| {}), []);
    assert_eq!(
        findings(|root| root["children"][0]["boundingVolume"]["box"][11] = 5.into()),
        [("content-outside-volume", 1)]
    );
    assert_eq!(
        findings(|root| root["children"][0]["boundingVolume"]["box"][0] = 1.into()),
        [("child-outside-parent", 1)]
    );
    assert_eq!(findings(|root| root["children"][0]["geometricError"] = 5.into()), [("error-not-monotone", 1)]);
    assert_eq!(findings(|root| root["geometricError"] = 9.into()), [("error-not-monotone", 0)]);
    let empty = |root: &mut Value| drop(root["children"][0].as_object_mut().unwrap().remove("content"));
    assert_eq!(findings(empty), [("empty-replace", 1)]);
    let own = json!({ "uri": "a.glb", "boundingVolume": { "sphere": [0, 0, 0, 1] } });
    assert_eq!(findings(|root| root["content"] = own.clone()), [("content-outside-own-volume", 0)]);
}

#[test]
fn texels_and_bytes_are_counted_as_they_are() {
    let mut root = leaf("a.glb");
    root["geometricError"] = 4.into();
    let bytes = glb(&gltf2(), &body());
    let temp = folder(&[("tileset.json", text(tileset(root))), ("a.glb", bytes.clone())]);
    let set = open(temp.path()).unwrap();
    let found = structure::measure(&set, &StructureConfig::default(), &Reporter::new(true)).unwrap();
    let level = &found.levels[0];
    assert_eq!(
        (level.tiles, level.sum.triangles, level.sum.draw_calls, level.sum.bytes),
        (1, 1, 1, bytes.len() as u64)
    );
    assert_eq!((level.sum.texture_px, level.sum.texture_rgba_bytes), (32, 128));
    // 7.5 m² over half of 8 × 4 texels.
    let metres_per_texel = level.metres_per_texel.unwrap();
    assert!((metres_per_texel - (7.5f64 / 16.0).sqrt()).abs() < 1e-6);
    assert!((level.texels_per_pixel.unwrap() - 4.0 / 16.0 / metres_per_texel).abs() < 1e-6);
}

#[test]
fn a_path_that_is_no_tileset_says_so() {
    assert!(open(Path::new("/does/not/exist")).is_err());
    let temp = folder(&[("tileset.json", b"{}".to_vec())]);
    let said = open(temp.path()).err().unwrap().to_string();
    assert!(said.contains("no root"), "{said}");
}
