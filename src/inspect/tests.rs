//! What is written is read back by a reader that shares nothing with the writer, and planted faults are found.

use std::io::Cursor;
use std::path::Path;

use glam::{DVec3, Vec2, Vec3};

use super::*;
use crate::geo::Aabb;
use crate::ids::{ClassId, ClassScheme};
use crate::schema::gltf::Gltf;
use crate::write::tileset::bytes;
use crate::write::{About, ClassError, GlbOptions, TileContent, TileEntry, quantization_error_m};

const PLAIN: GlbOptions = GlbOptions { compress: false, primitives_per_class: false };
const ALL: GlbOptions = GlbOptions { compress: true, primitives_per_class: true };

fn jpeg() -> Vec<u8> {
    let pixels = image::RgbImage::from_fn(32, 32, |x, y| image::Rgb([(x * 8) as u8, (y * 8) as u8, 128]));
    let mut bytes = Cursor::new(Vec::new());
    pixels.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    bytes.into_inner()
}

/// A square of ground of `size_m` from `corner`, `n` cells a side; its eastern half is a roof, 3 m higher.
fn square(corner: DVec3, size_m: f64, n: u32) -> TileContent {
    let origin = corner + DVec3::new(size_m, size_m, 0.0) * 0.5;
    let mut content =
        TileContent { origin, atlas: Some(jpeg()), copyright: Some("a city".into()), ..Default::default() };
    for (class, east, up) in [(ClassId::TERRAIN, 0.0, 0.0f64), (ClassId::ROOF, 0.5, 3.0)] {
        let first = content.positions.len() as u32;
        for i in 0..=n {
            for j in 0..=n {
                let unit = Vec2::new(i as f32 / n as f32 * 0.5 + east, j as f32 / n as f32);
                let place = corner + DVec3::new(f64::from(unit.x), f64::from(unit.y), 0.0) * size_m;
                let wave = 0.2 * (place.x * 0.7).sin() * (place.y * 0.5).cos();
                content.positions.push((place + DVec3::Z * (up + wave) - origin).as_vec3());
                content.uvs.push(Vec2::new(unit.x, 1.0 - unit.y));
                content.normals.push(Vec3::new(0.1, 0.2, 0.9).normalize());
                content.colors.push([255, 128, (i * 8) as u8]);
                content.class_of_vertex.push(class);
            }
        }
        for i in 0..n {
            for j in 0..n {
                let at = |i: u32, j: u32| first + i * (n + 1) + j;
                content.faces.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
                content.faces.push([at(i, j + 1), at(i + 1, j), at(i + 1, j + 1)]);
            }
        }
    }
    content
}

fn entry(uri: &str, content: &TileContent, level: u32, error_m: f64, children: Vec<TileEntry>) -> TileEntry {
    let local = |p: &Vec3| content.origin + p.as_dvec3();
    let own = content.positions.iter().map(local);
    let below = children.iter().flat_map(|c: &TileEntry| [c.box_local.min, c.box_local.max]);
    let points: Vec<DVec3> = own.chain(below).collect();
    let (budget_m, bound_m) = (error_m, error_m);
    let class = |class| ClassError {
        class,
        budget_m,
        bound_m,
        mean_m: 0.1,
        rms_m: 0.2,
        p95_m: 0.3,
        p99_m: 0.4,
        inside_m: 0.0,
        sunk_m: 0.0,
    };
    TileEntry {
        uri: uri.into(),
        box_local: Aabb {
            min: points.iter().copied().reduce(DVec3::min).unwrap(),
            max: points.iter().copied().reduce(DVec3::max).unwrap(),
        },
        geometric_error_m: error_m,
        geometry_m: error_m,
        texel_m: 0.05,
        scale: 1.0,
        wall_m: 0.0,
        skirt_m: 0.0,
        skirt_triangles: 0,
        triangles: content.faces.len() as u64,
        bytes: 0,
        classes: vec![class(ClassId::TERRAIN), class(ClassId::ROOF)],
        level,
        children,
    }
}

/// A coarse root and a fine child, in a folder of their own.
struct Town {
    dir: tempfile::TempDir,
    root: TileEntry,
    scheme: ClassScheme,
}

impl Town {
    fn build(options: &GlbOptions) -> Self {
        let scheme = ClassScheme::default();
        let dir = tempfile::tempdir().unwrap();
        let (coarse, fine) = (square(DVec3::ZERO, 80.0, 2), square(DVec3::ZERO, 80.0, 16));
        std::fs::create_dir(dir.path().join("1")).unwrap();
        std::fs::write(dir.path().join("0.glb"), crate::write::glb(&coarse, &scheme, options)).unwrap();
        std::fs::write(dir.path().join("1/0.glb"), crate::write::glb(&fine, &scheme, options)).unwrap();
        let root = entry("0.glb", &coarse, 0, 4.0, vec![entry("1/0.glb", &fine, 1, 0.0, vec![])]);
        Self { dir, root, scheme }
    }

    fn path(&self) -> &Path {
        self.dir.path()
    }

    /// Writes tileset.json and checks.
    fn findings(&self) -> Vec<Finding> {
        let about = About { ecef_from_local: None, scheme: &self.scheme, copyright: None, texel_factor: 1.0 };
        let tileset = crate::write::tileset(&self.root, &about);
        std::fs::write(self.path().join("tileset.json"), bytes(&tileset)).unwrap();
        check(self.path()).unwrap()
    }

    fn codes(&self) -> Vec<(&'static str, String)> {
        self.findings().into_iter().map(|f| (f.code, f.place)).collect()
    }

    fn child(&mut self) -> &mut TileEntry {
        &mut self.root.children[0]
    }

    fn put(&self, uri: &str, bytes: &[u8]) {
        std::fs::write(self.path().join(uri), bytes).unwrap();
    }
}

fn found(code: &'static str, place: &str) -> Vec<(&'static str, String)> {
    vec![(code, place.to_string())]
}

/// Takes a GLB apart, lets `spoil` at it, and puts it together again.
fn spoiled(glb: &[u8], spoil: impl FnOnce(&mut Gltf, &mut [u8])) -> Vec<u8> {
    let json_bytes = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let mut gltf: Gltf = serde_json::from_slice(&glb[20..20 + json_bytes]).unwrap();
    let mut bin = glb[28 + json_bytes..].to_vec();
    spoil(&mut gltf, &mut bin);
    let mut json = serde_json::to_vec(&gltf).unwrap();
    json.resize(json.len().next_multiple_of(4), b' ');
    let length = (28 + json.len() + bin.len()) as u32;
    let word = |n: u32| n.to_le_bytes().to_vec();
    [b"glTF".to_vec(), word(2), word(length), word(json.len() as u32), b"JSON".to_vec(), json]
        .into_iter()
        .chain([word(bin.len() as u32), b"BIN\0".to_vec(), bin])
        .flatten()
        .collect()
}

#[test]
fn a_tileset_as_written_has_no_findings() {
    for compress in [false, true] {
        for primitives_per_class in [false, true] {
            let town = Town::build(&GlbOptions { compress, primitives_per_class });
            assert_eq!(town.findings(), [], "compress {compress}, per class {primitives_per_class}");
        }
    }
}

#[test]
fn what_is_read_back_is_what_was_written() {
    let scheme = ClassScheme::default();
    let content = square(DVec3::new(1234.5, -987.6, 55.5), 80.0, 6);
    // Faces as sets of rounded corners with their class: order is the writer's business.
    let key = |corners: [DVec3; 3], class: &str| {
        let mut corners = corners.map(|c| (c * 50.0).round().as_i64vec3().to_array());
        corners.sort_unstable();
        (corners, class.to_string())
    };
    let local = |v: u32| content.origin + content.positions[v as usize].as_dvec3();
    let name = |v: u32| scheme[content.class_of_vertex[v as usize]].name.as_str();
    let mut wanted: Vec<_> = content.faces.iter().map(|f| key(f.map(local), name(f[0]))).collect();
    wanted.sort();
    for options in [PLAIN, ALL] {
        let lists = glb::parse(&crate::write::glb(&content, &scheme, &options)).unwrap().triangles().unwrap();
        let allowed_m = if options.compress { quantization_error_m(&content) } else { 1e-5 };
        let mut got = Vec::new();
        for list in &lists {
            let names = &list.features.as_ref().unwrap().class_names;
            for face in &list.faces {
                let corners = face.map(|v| {
                    let p = list.positions[v as usize];
                    let nearest = (0..content.positions.len() as u32)
                        .map(local)
                        .min_by(|a, b| a.distance(p).total_cmp(&b.distance(p)));
                    let nearest = nearest.unwrap();
                    assert!(nearest.distance(p) <= allowed_m, "{p} is {} m off", nearest.distance(p));
                    nearest
                });
                let [a, b, c] = corners;
                assert!((b - a).cross(c - a).z > 0.0, "a face is turned over");
                got.push(key(corners, &names[list.feature_ids[face[0] as usize] as usize]));
            }
        }
        got.sort();
        assert_eq!(got, wanted);
        assert_eq!(lists.len(), if options.primitives_per_class { 2 } else { 1 });
    }
}

#[test]
fn the_same_content_gives_the_same_bytes() {
    let scheme = ClassScheme::default();
    let content = square(DVec3::ZERO, 80.0, 9);
    for options in [PLAIN, ALL] {
        assert_eq!(crate::write::glb(&content, &scheme, &options), crate::write::glb(&content, &scheme, &options));
    }
}

#[test]
fn tiles_of_more_than_65535_vertices_get_wide_indices() {
    let scheme = ClassScheme::default();
    let content = square(DVec3::ZERO, 80.0, 185);
    assert!(content.positions.len() > 65_535);
    for options in [PLAIN, GlbOptions { compress: true, ..PLAIN }] {
        let glb = glb::parse(&crate::write::glb(&content, &scheme, &options)).unwrap();
        let lists = glb.triangles().unwrap();
        assert_eq!(lists[0].faces.len(), content.faces.len());
        let indices = glb.gltf.meshes[0].primitives[0].indices.unwrap();
        assert_eq!(glb.gltf.accessors[indices as usize].component_type, crate::schema::gltf::UNSIGNED_INT);
    }
}

#[test]
fn a_vertex_outside_of_its_tiles_box_is_found() {
    let town = Town::build(&PLAIN);
    let mut content = square(DVec3::ZERO, 80.0, 16);
    content.positions[7].z += 9.0;
    town.put("1/0.glb", &crate::write::glb(&content, &town.scheme, &PLAIN));
    let findings = town.findings();
    assert_eq!(findings.len(), 1);
    assert_eq!((findings[0].code, findings[0].severity), ("content-outside", Severity::Error));
    assert!(findings[0].what.contains("outside the tile's box"), "{}", findings[0]);
}

#[test]
fn faults_of_the_tree_are_found() {
    let mut town = Town::build(&PLAIN);
    town.child().geometric_error_m = 5.0;
    assert_eq!(town.codes(), found("error-order", "1/0.glb"));
    town.child().geometric_error_m = -1.0;
    assert_eq!(town.codes(), found("error-order", "1/0.glb"));
    town.child().geometric_error_m = 0.0;
    town.child().box_local.max.x += 0.5;
    assert_eq!(town.codes(), found("box-outside", "1/0.glb"));
    town.child().box_local.max.x -= 0.5;
    town.child().uri = "2/0.glb".into();
    assert_eq!(town.codes(), found("missing-file", "2/0.glb"));
    town.child().uri = "../0.glb".into();
    assert_eq!(town.codes(), found("outside", "../0.glb"));
    town.child().uri = "1/0.glb".into();
    assert_eq!(town.codes(), []);
    let text = std::fs::read_to_string(town.path().join("tileset.json")).unwrap();
    for (from, to, code) in [
        (r#""content":{"uri":"0.glb"},"#, "", "empty-tile"),
        (r#""refine":"REPLACE","#, "", "refine"),
        (r#""version":"1.1""#, r#""version":"2""#, "version"),
        (r#""roofMean":0.1"#, r#""roofMeen":0.1"#, "metadata"),
    ] {
        assert!(text.contains(from), "{from} in {text}");
        town.put("tileset.json", text.replacen(from, to, 1).as_bytes());
        let codes: Vec<_> = check(town.path()).unwrap().into_iter().map(|f| f.code).collect();
        assert_eq!(codes, [code]);
    }
    town.put("tileset.json", text.replacen(r#""geometricError""#, r#""geometricErr""#, 1).as_bytes());
    assert_eq!(check(town.path()).unwrap_err().exit_code(), 3);
}

#[test]
fn faults_of_a_glb_are_found() {
    let town = Town::build(&PLAIN);
    let sound = std::fs::read(town.path().join("0.glb")).unwrap();
    type Spoil = fn(&mut Gltf, &mut [u8]);
    let place = |gltf: &Gltf, accessor: u32| {
        let view = gltf.accessors[accessor as usize].buffer_view.unwrap();
        gltf.buffer_views[view as usize].byte_offset.unwrap() as usize
    };
    let faults: [(&'static str, Spoil); 8] = [
        ("index-range", |gltf, bin| {
            let view = gltf.buffer_views.iter().find(|v| v.target == Some(34963)).unwrap();
            bin[view.byte_offset.unwrap() as usize] = 99;
        }),
        ("feature-range", |gltf, _| {
            let features = gltf.meshes[0].primitives[0].extensions.as_mut().unwrap().mesh_features.as_mut();
            features.unwrap().feature_ids[0].feature_count = 2;
        }),
        ("wrong-bounds", |gltf, _| gltf.accessors[0].max[1] += 0.25),
        ("broken-glb", |_, bin| bin[..4].copy_from_slice(&f32::NAN.to_le_bytes())),
        ("broken-glb", |gltf, _| gltf.accessors[0].count += 1),
        ("broken-glb", |gltf, _| gltf.nodes[0].children = vec![0]),
        ("texture", |gltf, bin| {
            let view = &gltf.buffer_views[gltf.images[0].buffer_view.unwrap() as usize];
            let (from, length) = (view.byte_offset.unwrap() as usize, view.byte_length as usize);
            bin[from + 20..from + length].fill(0);
        }),
        ("not-checked", |gltf, _| gltf.extensions_required.push("KHR_draco_mesh_compression".into())),
    ];
    let gltf = glb::parse(&sound).unwrap().gltf;
    assert_eq!(place(&gltf, 0), 0, "positions are expected first");
    for (i, (code, spoil)) in faults.into_iter().enumerate() {
        let bytes = spoiled(&sound, spoil);
        assert_ne!(bytes, sound, "fault {i}");
        town.put("0.glb", &bytes);
        assert_eq!(town.codes(), found(code, "0.glb"), "fault {i}");
    }
    town.put("0.glb", &spoiled(&sound, |_, _| {}));
    assert_eq!(town.codes(), []);
    town.put("0.glb", &sound[..sound.len() - 1]);
    assert_eq!(town.codes(), found("broken-glb", "0.glb"));
}

#[test]
fn no_cut_and_no_flipped_byte_makes_the_reader_panic() {
    let scheme = ClassScheme::default();
    let mut content = square(DVec3::ZERO, 10.0, 2);
    (content.atlas, content.uvs) = (None, Vec::new());
    for options in [PLAIN, ALL] {
        let sound = crate::write::glb(&content, &scheme, &options);
        let read = |bytes: &[u8]| glb::parse(bytes).and_then(|g| g.triangles()).map(|lists| lists.len());
        for cut in 0..sound.len() {
            assert!(read(&sound[..cut]).is_err(), "cut at {cut}");
        }
        for at in 0..sound.len() {
            for flip in [0x01, 0x80, 0xff] {
                let mut bytes = sound.clone();
                bytes[at] ^= flip;
                let _ = read(&bytes);
            }
        }
    }
}

#[test]
fn a_summary_counts_levels_and_leaf_classes() {
    let town = Town::build(&ALL);
    assert_eq!(town.findings(), []);
    let summary = tileset(town.path()).unwrap();
    let levels: Vec<_> = summary.levels.iter().map(|l| (l.tiles, l.triangles, l.draw_calls, l.max_error_m)).collect();
    assert_eq!(levels, [(1, 16, 2, 4.0), (1, 1024, 2, 0.0)]);
    assert_eq!(summary.levels[0].min_texel_m, Some(0.05));
    let classes: Vec<_> = summary.classes.iter().map(|c| (c.name.as_str(), c.triangles)).collect();
    assert_eq!(classes, [("roof", 512), ("terrain", 512)]);
    // Half of 80 m × 80 m, a little more for the waves.
    assert!((3200.0..3300.0).contains(&summary.classes[0].area_m2), "{}", summary.classes[0].area_m2);
    assert_eq!(summary.generator.as_deref(), Some(crate::write::GENERATOR));
    assert_eq!((summary.place, summary.unread.len()), (None, 0));
    let size: u64 =
        ["tileset.json", "0.glb", "1/0.glb"].iter().map(|f| town.path().join(f).metadata().unwrap().len()).sum();
    assert_eq!(summary.bytes, size);
    assert!(summary.to_string().contains("roof"), "{summary}");
    std::fs::remove_file(town.path().join("0.glb")).unwrap();
    assert_eq!(tileset(town.path()).unwrap().unread.len(), 1);
}

/// CesiumJS 1.145 turns the label of a feature id set into an identifier of its shader; with `class`, a reserved word
/// of GLSL, the shader did not compile and nothing was drawn.
#[test]
fn the_feature_label_is_no_reserved_word_of_shaders() {
    let content = square(DVec3::ZERO, 10.0, 1);
    let glb = glb::parse(&crate::write::glb(&content, &ClassScheme::default(), &PLAIN)).unwrap();
    let features = glb.gltf.meshes[0].primitives[0].extensions.as_ref().unwrap().mesh_features.as_ref().unwrap();
    assert_eq!(features.feature_ids[0].label.as_deref(), Some("surface"));
}
