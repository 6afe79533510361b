//! One test a rule, on a triangle and a square built here.

use std::path::Path;

use glam::{DVec3, Vec2, dvec3, vec2};
use serde_json::{Value, json};

use crate::input::{ImageRef, InputConfig, Source};
use crate::report::Reporter;
use crate::{Error, Result};

/// A glTF under construction: the JSON and the binary chunk.
#[derive(Clone)]
struct Model {
    json: Value,
    bin: Vec<u8>,
}

const PNG: &[u8] = b"\x89PNG\r\n\x1A\n and so on";

impl Model {
    /// A node, a mesh, a primitive without attributes.
    fn new() -> Self {
        let json = json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
            "meshes": [{ "primitives": [{ "attributes": {} }] }],
            "buffers": [{ "byteLength": 0 }], "bufferViews": [], "accessors": [],
        });
        Self { json, bin: Vec::new() }
    }

    /// The unit square in x and y, with indices and UVs equal to x and y.
    fn square() -> Self {
        let mut model = Self::new();
        let points = [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [0., 1., 0.]];
        model.attribute("POSITION", 5126, "VEC3", &floats(points.as_flattened()), 12);
        model.attribute("TEXCOORD_0", 5126, "VEC2", &floats(&[0., 0., 1., 0., 1., 1., 0., 1.]), 8);
        let indices = model.accessor(5123, "SCALAR", &words(&[0, 1, 2, 0, 2, 3]), 2);
        model.primitive()["indices"] = json!(indices);
        model
    }

    /// The square under material 0 with a PNG inside the file.
    fn textured() -> Self {
        let mut model = Self::square();
        let view = model.view(PNG);
        model.json["images"] = json!([{ "bufferView": view, "mimeType": "image/png" }]);
        model.json["textures"] = json!([{ "source": 0 }]);
        let info = json!({ "baseColorTexture": { "index": 0 } });
        model.json["materials"] = json!([{ "name": "brick", "pbrMetallicRoughness": info }]);
        model.primitive()["material"] = json!(0);
        model
    }

    fn primitive(&mut self) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0]
    }

    fn texture_info(&mut self) -> &mut Value {
        &mut self.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    }

    fn view(&mut self, bytes: &[u8]) -> usize {
        let view = json!({ "buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len() });
        self.bin.extend(bytes);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.json["buffers"][0]["byteLength"] = json!(self.bin.len());
        push(&mut self.json["bufferViews"], view)
    }

    fn accessor(&mut self, component: u32, shape: &str, bytes: &[u8], size: usize) -> usize {
        let view = self.view(bytes);
        let count = bytes.len() / size;
        let accessor = json!({ "bufferView": view, "componentType": component, "count": count, "type": shape });
        push(&mut self.json["accessors"], accessor)
    }

    fn attribute(&mut self, name: &str, component: u32, shape: &str, bytes: &[u8], size: usize) -> usize {
        let accessor = self.accessor(component, shape, bytes, size);
        self.primitive()["attributes"][name] = json!(accessor);
        accessor
    }

    fn glb(&self) -> Vec<u8> {
        let mut json = self.json.to_string().into_bytes();
        json.resize(json.len().next_multiple_of(4), b' ');
        chunks(&[(b"JSON", &json), (b"BIN\0", &self.bin)])
    }

    fn read(&self) -> Outcome {
        read(&self.glb())
    }
}

fn chunks(chunks: &[(&[u8; 4], &[u8])]) -> Vec<u8> {
    let mut glb = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
    for (kind, bytes) in chunks {
        glb.extend((bytes.len() as u32).to_le_bytes());
        glb.extend(*kind);
        glb.extend(*bytes);
    }
    let length = glb.len() as u32;
    glb[8..12].copy_from_slice(&length.to_le_bytes());
    glb
}

fn push(list: &mut Value, item: Value) -> usize {
    let list = list.as_array_mut().unwrap();
    list.push(item);
    list.len() - 1
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn words(values: &[u16]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// What came of reading a file.
struct Outcome {
    result: Result<Source>,
    reporter: Reporter,
}

impl Outcome {
    fn source(&self) -> &Source {
        self.result.as_ref().unwrap()
    }

    fn warned(&self, code: &str) -> u64 {
        self.reporter.warnings().iter().find(|w| w.code == code).map_or(0, |w| w.count)
    }

    /// Asserts an [`Error::Input`] whose message holds `text`.
    fn refused(&self, text: &str) {
        match &self.result {
            Err(error @ Error::Input { .. }) => assert!(error.to_string().contains(text), "{error}"),
            other => panic!("{other:?}, wanted a refusal with {text:?}"),
        }
    }

    fn unsupported(&self, text: &str) {
        match &self.result {
            Err(error @ Error::Unsupported { .. }) => assert!(error.to_string().contains(text), "{error}"),
            other => panic!("{other:?}, wanted Unsupported with {text:?}"),
        }
    }
}

fn read(bytes: &[u8]) -> Outcome {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.glb");
    std::fs::write(&path, bytes).unwrap();
    read_path(&path)
}

fn read_path(path: &Path) -> Outcome {
    let reporter = Reporter::new(true);
    let mut source = Source::default();
    let config = InputConfig::default();
    let result = super::read(path, &config, &reporter, &mut source).map(|()| source);
    Outcome { result, reporter }
}

#[test]
fn a_square_is_read_z_up_with_uvs_and_image() {
    let outcome = Model::textured().read();
    let source = outcome.source();
    let part = &source.parts[0];
    assert_eq!(part.positions, [dvec3(0., -0., 0.), dvec3(1., 0., 0.), dvec3(1., 0., 1.), dvec3(0., 0., 1.)]);
    assert_eq!(part.faces, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(part.corner_uvs[1], [vec2(0., 0.), vec2(1., 1.), vec2(0., 1.)]);
    assert_eq!(part.face_material, [0, 0]);
    assert_eq!((source.materials[0].name.as_str(), source.materials[0].image), ("brick", Some(0)));
    assert!(matches!(&source.images[0], ImageRef::Encoded { bytes, .. } if **bytes == *PNG));
    assert!(outcome.reporter.warnings().is_empty());
}

#[test]
fn a_glb_header_that_lies_is_refused_and_one_that_is_short_is_read_with_a_warning() {
    let glb = Model::square().glb();
    let with = |at: usize, value: u32| {
        let mut glb = glb.clone();
        glb[at..at + 4].copy_from_slice(&value.to_le_bytes());
        read(&glb)
    };
    with(4, 1).unsupported("glTF 1.0");
    with(4, 3).refused("GLB version 3");
    with(8, 11).refused("header says 11");
    with(8, glb.len() as u32 + 1).refused("cut short");
    with(12, u32::MAX).refused("reaches over");
    with(16, 7).refused("wanted JSON");
    let longer = read(&[&glb[..], b"\0\0\0\0"].concat());
    assert_eq!((longer.source().parts.len(), longer.warned("glb-trailing-bytes")), (1, 1));
}

#[test]
fn chunks_out_of_order_are_refused_and_unknown_ones_passed_over() {
    let model = Model::square();
    let json = model.json.to_string();
    let (json, bin) = ((b"JSON", json.as_bytes()), (b"BIN\0", &model.bin[..]));
    read(&chunks(&[json, json])).refused("second JSON");
    read(&chunks(&[json, bin, bin])).refused("BIN chunk where none may be");
    read(&chunks(&[bin, json])).refused("BIN chunk where none may be");
    read(&chunks(&[])).refused("no JSON chunk");
    assert!(read(&chunks(&[json, bin, (b"FOO\0", b"xy")])).result.is_ok());
}

#[test]
fn only_version_two_is_read() {
    let with = |asset: Value| {
        let mut model = Model::square();
        model.json["asset"] = asset;
        model.read()
    };
    with(json!({})).refused("asset.version");
    with(json!({ "version": "1.0" })).unsupported("convert it to glTF 2.0");
    with(json!({ "version": "2.1", "minVersion": "2.1" })).unsupported("2.1");
    let credited = with(json!({ "version": "2.1", "copyright": "City of X" }));
    assert_eq!(credited.source().copyright, ["City of X"]);
}

#[test]
fn an_unknown_required_extension_is_named_and_an_optional_one_ignored() {
    let with = |key: &str, name: &str| {
        let mut model = Model::square();
        model.json[key] = json!([name]);
        model.read()
    };
    with("extensionsRequired", "KHR_draco_mesh_compression").unsupported("without Draco");
    with("extensionsRequired", "EXT_moon").unsupported("EXT_moon");
    assert!(with("extensionsUsed", "EXT_moon").result.is_ok());
    assert!(with("extensionsRequired", "KHR_materials_unlit").result.is_ok());
}

#[test]
fn draco_without_the_plain_data_is_refused_even_if_optional() {
    let mut model = Model::square();
    model.json["accessors"][0].as_object_mut().unwrap().remove("bufferView");
    model.primitive()["extensions"] = json!({ "KHR_draco_mesh_compression": { "bufferView": 0 } });
    model.read().unsupported("without Draco");
}

#[test]
fn accessors_that_leave_their_view_are_refused_without_overflow() {
    let with = |key: &str, value: Value| {
        let mut model = Model::square();
        model.json["accessors"][0][key] = value;
        model.read()
    };
    with("count", json!(5)).refused("leave bufferView 0");
    with("count", json!(4_294_967_295u64)).refused("leave bufferView 0");
    with("count", json!(1u64 << 40)).refused("over 2^32");
    with("count", json!(-1)).refused("integer from 0");
    with("byteOffset", json!(1)).refused("leave bufferView 0");
    with("byteOffset", json!(9_007_199_254_740_991u64)).refused("leave bufferView 0");
    with("bufferView", json!(99)).refused("bufferView 99 is referenced but there are 3");
    with("componentType", json!(5125)).refused("not allowed for Position");
    with("componentType", json!(1)).refused("component type 1");
    with("type", json!("VEC2")).refused("not allowed for Position");
}

#[test]
fn views_that_leave_their_buffer_are_refused() {
    let with = |key: &str, value: Value| {
        let mut model = Model::square();
        model.json["bufferViews"][0][key] = value;
        model.read()
    };
    with("byteLength", json!(1_000_000)).refused("leave buffer 0");
    with("byteOffset", json!(9_007_199_254_740_991u64)).refused("leave buffer 0");
    with("buffer", json!(1)).refused("buffer 1 is referenced but there are 1");
    with("byteStride", json!(8)).refused("byteStride 8 is less than the 12 bytes");
    with("byteStride", json!(16)).refused("leave bufferView 0");
    let mut model = Model::square();
    model.json["buffers"][0]["byteLength"] = json!(100_000);
    model.read().refused("byteLength is 100000");
}

#[test]
fn interleaved_attributes_are_read_by_their_stride() {
    let mut model = Model::new();
    let rows: [[f32; 5]; 3] = [[0., 0., 0., 9., 9.], [1., 0., 0., 9., 9.], [0., 1., 0., 9., 9.]];
    let position = model.attribute("POSITION", 5126, "VEC3", &floats(rows.as_flattened()), 20);
    model.json["bufferViews"][0]["byteStride"] = json!(20);
    assert_eq!(position, 0);
    assert_eq!(model.read().source().parts[0].positions[2], dvec3(0., 0., 1.));
}

#[test]
fn a_sparse_accessor_overlays_its_elements() {
    let mut model = Model::square();
    let (indices, values) = (model.view(&[2]), model.view(&floats(&[5., 6., 7.])));
    let sparse = json!({ "count": 1, "indices": { "bufferView": indices, "componentType": 5121 }, "values": { "bufferView": values } });
    model.json["accessors"][0]["sparse"] = sparse;
    assert_eq!(model.read().source().parts[0].positions[2], dvec3(5., -7., 6.));
    model.json["accessors"][0].as_object_mut().unwrap().remove("bufferView");
    let zero = DVec3::ZERO;
    assert_eq!(model.read().source().parts[0].positions, [zero, zero, dvec3(5., -7., 6.), zero]);
    model.bin[model.json["bufferViews"][indices]["byteOffset"].as_u64().unwrap() as usize] = 4;
    model.read().refused("sparse indices");
}

#[test]
fn quantized_and_normalized_components_become_numbers() {
    let mut model = Model::new();
    let bytes: Vec<u8> = [-128i8, 0, 127, 0, 64, 0, 0, 0, 0, 127, 0, 0].iter().map(|&b| b as u8).collect();
    model.attribute("POSITION", 5120, "VEC3", &bytes, 4);
    model.json["bufferViews"][0]["byteStride"] = json!(4);
    assert_eq!(model.read().source().parts[0].positions[0], dvec3(-128., -127., 0.));
    model.json["accessors"][0]["normalized"] = json!(true);
    assert_eq!(model.read().source().parts[0].positions[0], dvec3(-1., -1., 0.));
}

#[test]
fn indices_may_be_bytes_words_long_or_none_but_not_out_of_range() {
    for (component, bytes) in
        [(5121, vec![0, 1, 2]), (5125, [0u32, 1, 2].iter().flat_map(|i| i.to_le_bytes()).collect())]
    {
        let mut model = Model::square();
        let indices = model.accessor(component, "SCALAR", &bytes, bytes.len() / 3);
        model.primitive()["indices"] = json!(indices);
        assert_eq!(model.read().source().parts[0].faces, [[0, 1, 2]]);
    }
    let mut model = Model::square();
    model.primitive().as_object_mut().unwrap().remove("indices");
    let outcome = model.read();
    assert_eq!((&outcome.source().parts[0].faces[..], outcome.warned("trailing-indices")), (&[[0, 1, 2]][..], 1));
    let indices = model.accessor(5123, "SCALAR", &words(&[0, 1, 4]), 2);
    model.primitive()["indices"] = json!(indices);
    model.read().refused("index 4 at 2, but there are 4 vertices");
    let indices = model.accessor(5126, "SCALAR", &floats(&[0., 1., 2.]), 4);
    model.primitive()["indices"] = json!(indices);
    model.read().refused("not allowed for Indices");
}

#[test]
fn strips_alternate_fans_turn_and_restarts_are_dropped_with_a_warning() {
    let with = |mode: u32, indices: &[u16]| {
        let mut model = Model::square();
        let indices = model.accessor(5123, "SCALAR", &words(indices), 2);
        model.primitive()["indices"] = json!(indices);
        model.primitive()["mode"] = json!(mode);
        model.read()
    };
    assert_eq!(with(5, &[0, 1, 3, 2]).source().parts[0].faces, [[0, 1, 3], [1, 2, 3]]);
    assert_eq!(with(5, &[0, 1, 3, 3, 2, 1]).source().parts[0].faces, [[0, 1, 3], [3, 1, 2]]);
    assert_eq!(with(6, &[0, 1, 2, 3]).source().parts[0].faces, [[1, 2, 0], [2, 3, 0]]);
    let restarted = with(5, &[0, 1, 2, 0xFFFF, 0, 2, 3]);
    assert_eq!(restarted.source().parts[0].faces, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(restarted.warned("primitive-restart"), 1);
    let list = with(4, &[0, 1, 0xFFFF, 0, 2, 3]);
    assert_eq!((&list.source().parts[0].faces[..], list.warned("primitive-restart")), (&[[0, 1, 2]][..], 1));
    let points = with(0, &[0, 1, 2]);
    assert_eq!(points.warned("skipped-primitive"), 1);
    points.refused("shows no triangles");
    with(7, &[0, 1, 2]).refused("primitive mode 7");
}

#[test]
fn transforms_multiply_down_the_tree_in_double_precision() {
    let mut model = Model::square();
    let half = std::f64::consts::FRAC_1_SQRT_2;
    model.json["nodes"] = json!([
        { "children": [1], "translation": [500000.123, 0, 0] },
        { "mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 1, 1] },
    ]);
    // (1, 0, 0) is scaled to (2, 0, 0), turned about z to (0, 2, 0), moved, and stood up.
    let found = model.read().source().parts[0].positions[1];
    assert!(found.distance(dvec3(500000.123, 0., 2.)) < 1e-9, "{found}");
    model.json["nodes"][1] = json!({ "mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 3, 1] });
    assert_eq!(model.read().source().parts[0].positions[1], dvec3(500001.123, -3., 0.));
}

#[test]
fn a_mirror_flips_the_winding() {
    let mut model = Model::square();
    model.json["nodes"][0]["scale"] = json!([-1, 1, 1]);
    assert_eq!(model.read().source().parts[0].faces, [[0, 2, 1], [0, 3, 2]]);
}

#[test]
fn cycles_are_refused_and_a_graph_of_too_many_paths_meets_its_limit() {
    let mut model = Model::square();
    model.json["nodes"] = json!([{ "children": [1] }, { "children": [0], "mesh": 0 }]);
    model.read().refused("node 0 is its own ancestor");
    let diamond = |i: usize| json!({ "children": [i + 1, i + 1] });
    let mut nodes: Vec<Value> = (0..60).map(diamond).collect();
    nodes.push(json!({ "mesh": 0 }));
    model.json["nodes"] = json!(nodes);
    assert!(matches!(model.read().result, Err(Error::Limit { .. })));
    model.json["nodes"] = json!([{ "children": [7] }]);
    model.read().refused("node 7 is referenced");
}

#[test]
fn accessors_backed_by_nothing_meet_a_limit_before_memory_is_taken() {
    let mut model = Model::new();
    model.json["accessors"] = json!([{ "componentType": 5126, "count": 4_000_000_000u64, "type": "VEC3" }]);
    model.primitive()["attributes"]["POSITION"] = json!(0);
    assert!(matches!(model.read().result, Err(Error::Limit { .. })));
    let far = model.accessor(5125, "SCALAR", &[0u32, 1, 3_999_999_999].map(u32::to_le_bytes).concat(), 4);
    model.primitive()["indices"] = json!(far);
    assert_eq!(model.read().source().parts[0].positions.len(), 3);
}

#[test]
fn without_a_scene_all_root_nodes_are_read() {
    let mut model = Model::square();
    model.json["nodes"] = json!([{ "mesh": 0 }, { "children": [0] }, { "mesh": 0 }]);
    let object = model.json.as_object_mut().unwrap();
    object.remove("scene");
    object.remove("scenes");
    assert_eq!(model.read().source().parts.len(), 2);
    model.json["scene"] = json!(3);
    model.read().refused("scene 3");
}

#[test]
fn a_position_that_is_not_finite_costs_its_faces() {
    let mut model = Model::square();
    model.bin[12..16].copy_from_slice(&f32::NAN.to_le_bytes());
    let outcome = model.read();
    let part = &outcome.source().parts[0];
    assert_eq!((&part.faces[..], part.positions.len()), (&[[0, 1, 2]][..], 3));
    assert_eq!(part.positions[1], dvec3(1., 0., 1.));
    assert_eq!(outcome.warned("bad-vertex"), 1);
}

#[test]
fn vertex_colors_and_factors_go_from_linear_to_srgb() {
    let mut model = Model::square();
    model.attribute("COLOR_0", 5121, "VEC4", &[255, 0, 55, 255].repeat(4), 4);
    model.json["accessors"][3]["normalized"] = json!(true);
    model.json["materials"] = json!([{ "pbrMetallicRoughness": { "baseColorFactor": [0.5, 1, 1, 1] } }]);
    model.primitive()["material"] = json!(0);
    let outcome = model.read();
    // 0.5 linear is 188 in sRGB, 55/255 is 128.
    assert_eq!(outcome.source().parts[0].vertex_colors, [[188, 0, 128]; 4]);
    assert_eq!(outcome.source().materials[0].base_color, [188, 255, 255]);
}

#[test]
fn the_texture_transform_scales_turns_and_moves() {
    let mut model = Model::textured();
    // The extension's own example: the lower left quadrant, turned clockwise by 90 degrees.
    let transform = json!({ "offset": [0, 1], "rotation": std::f64::consts::FRAC_PI_2, "scale": [0.5, 0.5] });
    model.texture_info()["extensions"] = json!({ "KHR_texture_transform": transform });
    let uvs = model.read().source().parts[0].corner_uvs.clone();
    let near = |found: Vec2, wanted: Vec2| assert!(found.distance(wanted) < 1e-6, "{found} {wanted}");
    near(uvs[0][0], vec2(0.0, 1.0));
    near(uvs[0][1], vec2(0.0, 0.5));
    near(uvs[0][2], vec2(0.5, 0.5));
}

#[test]
fn the_texture_coordinate_set_is_honoured_and_a_missing_one_is_grey() {
    let mut model = Model::textured();
    model.attribute("TEXCOORD_1", 5123, "VEC2", &words(&[0xFFFF; 8]), 4);
    model.json["accessors"][3]["normalized"] = json!(true);
    model.texture_info()["texCoord"] = json!(1);
    assert_eq!(model.read().source().parts[0].corner_uvs[0], [vec2(1., 1.); 3]);
    model.texture_info()["texCoord"] = json!(2);
    let outcome = model.read();
    assert!(outcome.source().parts[0].corner_uvs.is_empty());
    assert_eq!((outcome.source().materials[0].image, outcome.source().materials[0].base_color), (None, [128; 3]));
    assert_eq!(outcome.warned("missing-uv"), 1);
}

#[test]
fn webp_is_preferred_basisu_is_grey_and_its_fallback_used() {
    let mut model = Model::textured();
    let view = model.view(b"RIFF\0\0\0\0WEBPVP8 ");
    push(&mut model.json["images"], json!({ "bufferView": view }));
    let view = model.view(b"\xABKTX 20\xBB\r\n\x1A\n");
    push(&mut model.json["images"], json!({ "bufferView": view }));
    let first = |outcome: &Outcome| match outcome.source().images.first() {
        Some(ImageRef::Encoded { bytes, .. }) => bytes[..4].to_vec(),
        other => panic!("{other:?}"),
    };
    model.json["textures"][0] = json!({ "source": 0, "extensions": { "EXT_texture_webp": { "source": 1 } } });
    assert_eq!(first(&model.read()), b"RIFF");
    model.json["textures"][0] = json!({ "source": 0, "extensions": { "KHR_texture_basisu": { "source": 2 } } });
    assert_eq!(first(&model.read()), b"\x89PNG");
    model.json["extensionsRequired"] = json!(["KHR_texture_basisu"]);
    model.json["textures"][0] = json!({ "extensions": { "KHR_texture_basisu": { "source": 2 } } });
    let outcome = model.read();
    assert_eq!((outcome.source().images.len(), outcome.warned("unsupported-texture")), (0, 1));
    assert_eq!(outcome.source().materials[0].base_color, [128; 3]);
    model.json["textures"][0] = json!({ "source": 2 });
    assert_eq!(model.read().warned("unsupported-texture"), 1);
}

#[test]
fn an_rtc_center_is_added_after_the_axes_are_turned() {
    let mut model = Model::square();
    model.json["extensionsRequired"] = json!(["CESIUM_RTC"]);
    model.json["extensions"] = json!({ "CESIUM_RTC": { "center": [1e6, 2e6, 3e6] } });
    assert_eq!(model.read().source().parts[0].positions[2], dvec3(1e6 + 1., 2e6, 3e6 + 1.));
}

#[test]
fn many_nodes_that_show_many_empty_primitives_meet_the_limit() {
    let mut model = Model::square();
    model.json["meshes"][0]["primitives"] = json!(vec![json!({ "mode": 0 }); 5_000]);
    model.json["nodes"] = json!(vec![json!({ "mesh": 0 }); 5_000]);
    model.json["scenes"][0]["nodes"] = json!((0..5_000).collect::<Vec<_>>());
    assert!(matches!(model.read().result, Err(Error::Limit { .. })));
}

#[test]
fn shared_geometry_is_copied_for_every_node() {
    let mut model = Model::square();
    model.json["nodes"] = json!([{ "mesh": 0 }, { "mesh": 0, "translation": [5, 0, 0] }]);
    model.json["scenes"][0]["nodes"] = json!([0, 1]);
    let outcome = model.read();
    assert_eq!(outcome.source().parts.iter().map(|p| p.positions[0].x).collect::<Vec<_>>(), [0., 5.]);
}

#[cfg(unix)]
#[test]
fn files_beside_the_gltf_are_read_and_files_elsewhere_refused() {
    let outer = tempfile::tempdir().unwrap();
    let folder = outer.path().join("in");
    std::fs::create_dir(&folder).unwrap();
    let mut model = Model::textured();
    std::fs::write(folder.join("a b.bin"), &model.bin).unwrap();
    std::fs::write(outer.path().join("secret.bin"), &model.bin).unwrap();
    std::fs::write(folder.join("t.png"), PNG).unwrap();
    std::os::unix::fs::symlink(outer.path().join("secret.bin"), folder.join("link.bin")).unwrap();
    let path = folder.join("model.gltf");
    let mut with = |buffer: &str, image: &str| {
        model.json["buffers"][0]["uri"] = json!(buffer);
        model.json["images"][0] = json!({ "uri": image });
        std::fs::write(&path, model.json.to_string()).unwrap();
        read_path(&path)
    };
    let outcome = with("a%20b.bin", "t.png");
    assert!(matches!(&outcome.source().images[0], ImageRef::File(path) if path.ends_with("in/t.png")));
    let outcome = with("./a%20b.bin", "gone/t.png");
    assert_eq!((outcome.source().images.len(), outcome.warned("missing-texture")), (0, 1));
    assert_eq!(outcome.source().materials[0].base_color, [128; 3]);
    with("gone.bin", "t.png").refused("cannot be found");
    let absolute = outer.path().join("secret.bin").display().to_string();
    for outside in ["../secret.bin", "..%2Fsecret.bin", "..\\secret.bin", "link.bin", "//host/x", "C:/x", &absolute] {
        with(outside, "t.png").refused("only files inside the input's folder");
        with("a%20b.bin", outside).refused("only files inside the input's folder");
    }
    for url in ["http://x/y.bin", "file:///etc/passwd", "FILE:x"] {
        with(url, "t.png").refused("is a URL");
    }
    with("%ff%fe.bin", "t.png").refused("not UTF-8");
    with("%00.bin", "t.png").refused("cannot be found");
    with(".", "t.png").refused("cannot be found");
    std::fs::write(folder.join("short.bin"), b"x").unwrap();
    with("short.bin", "t.png").refused("has 1 bytes");
}

#[test]
fn outside_files_are_read_when_allowed() {
    let outer = tempfile::tempdir().unwrap();
    std::fs::create_dir(outer.path().join("in")).unwrap();
    let mut model = Model::square();
    std::fs::write(outer.path().join("a.bin"), &model.bin).unwrap();
    model.json["buffers"][0]["uri"] = json!("../a.bin");
    let path = outer.path().join("in/model.gltf");
    std::fs::write(&path, model.json.to_string()).unwrap();
    let (config, mut source) = (InputConfig { allow_outside: true, root: None }, Source::default());
    super::read(&path, &config, &Reporter::new(true), &mut source).unwrap();
    assert_eq!(source.parts[0].faces.len(), 2);
}

#[test]
fn data_uris_are_decoded_and_broken_ones_refused() {
    let mut model = Model::new();
    model.json["buffers"][0] =
        json!({ "byteLength": 36, "uri": format!("data:application/gltf-buffer;base64,{}", "AAAA".repeat(12)) });
    model.json["bufferViews"] = json!([{ "buffer": 0, "byteLength": 36 }]);
    model.json["accessors"] = json!([{ "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3" }]);
    model.primitive()["attributes"]["POSITION"] = json!(0);
    assert_eq!(read(model.json.to_string().as_bytes()).source().parts[0].positions.len(), 3);
    model.json["buffers"][0]["byteLength"] = json!(37);
    read(model.json.to_string().as_bytes()).refused("only 36 bytes");
    model.json["buffers"][0]["uri"] = json!("data:text/plain,hello");
    read(model.json.to_string().as_bytes()).refused("not base64");
}

/// The square with its positions (a meshopt filter or none) and indices compressed.
fn packed(positions: Vec<u8>, filter: Option<&str>) -> Model {
    let mut model = Model::square();
    let indices = ::meshopt::encode_index_buffer(&[0, 1, 2, 0, 2, 3], 4).unwrap();
    let (vertices, indices_view) = (model.view(&positions), model.view(&indices));
    let at = |view: usize| model.json["bufferViews"][view]["byteOffset"].clone();
    let (vertices_at, indices_at) = (at(vertices), at(indices_view));
    let mut extension = json!({ "buffer": 0, "byteOffset": vertices_at, "byteLength": positions.len(), "byteStride": 12, "count": 4, "mode": "ATTRIBUTES" });
    if let Some(filter) = filter {
        extension["filter"] = json!(filter);
    }
    model.json["buffers"][0]["byteLength"] = json!(model.bin.len());
    model.json["bufferViews"][0] = json!({ "buffer": 1, "byteLength": 48, "byteStride": 12, "extensions": { "EXT_meshopt_compression": extension } });
    let extension = json!({ "buffer": 0, "byteOffset": indices_at, "byteLength": indices.len(), "byteStride": 2, "count": 6, "mode": "TRIANGLES" });
    model.json["bufferViews"][2] =
        json!({ "buffer": 1, "byteLength": 12, "extensions": { "KHR_meshopt_compression": extension } });
    push(&mut model.json["buffers"], json!({ "byteLength": 60 }));
    model.json["extensionsRequired"] = json!(["EXT_meshopt_compression"]);
    model
}

const CORNERS: [[f32; 3]; 4] = [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [0., 1., 0.5]];

#[test]
fn meshopt_views_are_unpacked_and_lies_about_their_size_refused() {
    let model = packed(::meshopt::encode_vertex_buffer(&CORNERS).unwrap(), None);
    let outcome = model.read();
    assert_eq!(outcome.source().parts[0].positions[3], dvec3(0., -0.5, 1.));
    assert_eq!(outcome.source().parts[0].faces.len(), 2);
    let with = |key: &str, value: Value| {
        let mut model = model.clone();
        model.json["bufferViews"][0]["extensions"]["EXT_meshopt_compression"][key] = value;
        model.read()
    };
    with("count", json!(5)).refused("not its byteLength");
    with("count", json!(9_007_199_254_740_991u64)).refused("not its byteLength");
    with("byteLength", json!(3)).refused("do not decode");
    with("mode", json!("MOON")).refused("does not exist");
    with("filter", json!("OCTAHEDRAL")).unsupported("OCTAHEDRAL");
    let mut model = model.clone();
    model.json["bufferViews"][0]["byteLength"] = json!(12_000_000_000u64);
    model.json["bufferViews"][0]["extensions"]["EXT_meshopt_compression"]["count"] = json!(1_000_000_000);
    model.read().refused("cannot hold");
}

#[test]
fn the_exponential_filter_is_undone() {
    let mode = ::meshopt::EncodeExpMode::Separate;
    let filtered: Vec<[u32; 3]> = ::meshopt::encode_filter_exp(&CORNERS, 24, mode);
    let model = packed(::meshopt::encode_vertex_buffer(&filtered).unwrap(), Some("EXPONENTIAL"));
    assert_eq!(model.read().source().parts[0].positions[3], dvec3(0., -0.5, 1.));
}

#[test]
fn every_truncation_and_flipped_bit_is_read_or_refused() {
    let textured = Model::textured().glb();
    let packed = packed(::meshopt::encode_vertex_buffer(&CORNERS).unwrap(), None).glb();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.glb");
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        read_path(&path)
    };
    let mut refused = 0;
    for glb in [textured, packed] {
        for end in 0..glb.len() {
            assert!(read(&glb[..end]).result.is_err(), "cut at {end}");
        }
        for at in 0..glb.len() {
            let mut flipped = glb.clone();
            flipped[at] ^= 1 << (at % 8);
            refused += usize::from(read(&flipped).result.is_err());
        }
    }
    assert!(refused > 100, "{refused}");
}

/// Reads every file of the defect corpora; needs them unpacked below `ROOFTILE_DATA`.
///
/// Most of the validator's files show no mesh, so each `.gltf` is read again with a scene that shows all it has.
#[test]
fn defect_files_are_read_or_refused() {
    let Some(data) = std::env::var_os("ROOFTILE_DATA") else {
        eprintln!("SKIPPED: ROOFTILE_DATA is not set");
        return;
    };
    let (mut read, mut refused) = (0, 0);
    let mut tell = |path: &Path, outcome: Outcome| {
        let codes: Vec<_> = outcome.reporter.warnings().iter().map(|w| w.code).collect();
        match outcome.result {
            Ok(source) => {
                let faces: usize = source.parts.iter().map(|p| p.faces.len()).sum();
                eprintln!("read    {}: {faces} faces {codes:?}", path.display());
                read += 1;
            }
            Err(error) => {
                eprintln!("refused {}: {error} {codes:?}", path.display());
                refused += 1;
            }
        }
    };
    let mut folders = vec![Path::new(&data).join("nasty")];
    while let Some(folder) = folders.pop() {
        let copy = tempfile::tempdir().unwrap();
        let paths: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        let is = |path: &Path, names: &[&str]| path.extension().is_some_and(|e| names.iter().any(|name| e == *name));
        for path in paths.iter().filter(|path| is(path, &["bin", "png", "jpg"])) {
            std::fs::copy(path, copy.path().join(path.file_name().unwrap())).unwrap();
        }
        for path in paths.iter().filter(|path| is(path, &["gltf", "glb"])) {
            tell(path, read_path(path));
            if let Ok(Value::Object(mut json)) = serde_json::from_slice(&std::fs::read(path).unwrap()) {
                let meshes = json.get("meshes").and_then(Value::as_array).map_or(0, Vec::len);
                let nodes: Vec<Value> = (0..meshes).map(|mesh| json!({ "mesh": mesh })).collect();
                json.insert("nodes".into(), json!(nodes));
                json.remove("scenes");
                json.remove("scene");
                let shown = copy.path().join("shown.gltf");
                std::fs::write(&shown, Value::Object(json).to_string()).unwrap();
                tell(path, read_path(&shown));
            }
        }
        folders.extend(paths.into_iter().filter(|path| path.is_dir()));
    }
    eprintln!("{read} read, {refused} refused");
    assert!(read > 0 && refused > 0);
}
