//! Every kind of broken input ends in one sentence that names the culprit, the designed exit code, and nothing on disk.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

use crate::common::{Run, build, command, files, shapes};

/// A way to fail.
struct Case {
    name: &'static str,
    code: i32,
    /// All of this is in the sentence, the culprit among it.
    says: &'static [&'static str],
    /// Makes the input in a folder of its own, and says what to give to `build`, relative to that folder.
    make: fn(&Path) -> Vec<String>,
}

fn put(folder: &Path, name: &str, bytes: impl AsRef<[u8]>) -> Vec<String> {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
    fs::write(path, bytes).expect("a file");
    vec![name.into()]
}

fn args(args: &[&str]) -> Vec<String> {
    args.iter().map(|a| (*a).to_owned()).collect()
}

/// The house and more arguments.
fn house(folder: &Path, more: &[&str]) -> Vec<String> {
    shapes::house(folder);
    args(&[&["house.obj"], more].concat())
}

const TRIANGLE: &str = "v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n";

fn gltf(folder: &Path, change: impl Fn(&mut Value)) -> Vec<String> {
    let mut json = shapes::triangle_gltf();
    change(&mut json);
    put(folder, "x.glb", shapes::glb(&json, &shapes::triangle_bytes([0, 1, 2])))
}

fn requiring(folder: &Path, extension: &str) -> Vec<String> {
    gltf(folder, |json| {
        json["extensionsRequired"] = json!([extension]);
        json["extensionsUsed"] = json!([extension]);
    })
}

/// Beside a triangle.
fn metadata(folder: &Path, text: &str) -> Vec<String> {
    put(folder, "metadata.xml", text);
    put(folder, "x.obj", TRIANGLE)
}

const PLY: &str = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
                   property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n";

const CASES: &[Case] = &[
    Case { name: "a file that is not there", code: 3, says: &["gone.obj"], make: |_| args(&["gone.obj"]) },
    Case { name: "an empty OBJ", code: 3, says: &["x.obj"], make: |f| put(f, "x.obj", "") },
    Case {
        name: "bytes that are no OBJ",
        code: 3,
        says: &["x.obj"],
        make: |f| {
            put(f, "x.obj", (0..9000u32).flat_map(|i| (i.wrapping_mul(2654435761)).to_le_bytes()).collect::<Vec<_>>())
        },
    },
    Case {
        name: "an OBJ without faces",
        code: 3,
        says: &["x.obj", "face"],
        make: |f| put(f, "x.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
    },
    Case {
        name: "an OBJ with all faces out of range",
        code: 3,
        says: &["x.obj"],
        make: |f| put(f, "x.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 7 8 9\nf -7 1 2\nf 0 1 2\n"),
    },
    Case {
        name: "an OBJ of NaN",
        code: 3,
        says: &["x.obj"],
        make: |f| put(f, "x.obj", "v nan nan nan\nv nan 0 0\nv 0 inf 1\nf 1 2 3\n"),
    },
    Case {
        name: "an OBJ whose faces have no area",
        code: 3,
        says: &["x.obj"],
        make: |f| put(f, "x.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),
    },
    Case {
        name: "an OBJ with coordinates no surface has",
        code: 3,
        says: &["x.obj"],
        make: |f| put(f, "x.obj", "v 0 0 0\nv 1e300 0 0\nv 0 1e300 0\nv 1e305 1e300 -1e305\nf 1 2 3\nf 2 3 4\n"),
    },
    Case {
        name: "a line of over 1 MiB",
        code: 4,
        says: &["x.obj", "longer than"],
        make: |f| put(f, "x.obj", [b"f".to_vec(), b" 1".repeat(1 << 20)].concat()),
    },
    Case {
        name: "an mtllib outside of the input's folder",
        code: 3,
        says: &["x.obj", "inside the input's folder"],
        make: |f| {
            put(f, "secret.mtl", "newmtl a\n");
            put(f, "in/x.obj", format!("mtllib ../secret.mtl\n{TRIANGLE}"))
        },
    },
    Case {
        name: "a texture by an absolute path",
        code: 3,
        says: &["x.mtl", "/etc/hostname"],
        make: |f| {
            put(f, "x.mtl", "newmtl a\nmap_Kd /etc/hostname\n");
            put(f, "x.obj", "mtllib x.mtl\nusemtl a\nv 0 0 0\nv 9 0 0\nv 0 9 0\nvt 0 0\nf 1/1 2/1 3/1\n")
        },
    },
    Case {
        name: "a texture outside of the input's folder",
        code: 3,
        says: &["x.mtl", "../t.png"],
        make: |f| {
            put(f, "t.png", "x");
            put(f, "in/x.mtl", "newmtl a\nmap_Kd ../t.png\n");
            put(f, "in/x.obj", "mtllib x.mtl\nusemtl a\nv 0 0 0\nv 9 0 0\nv 0 9 0\nvt 0 0\nf 1/1 2/1 3/1\n")
        },
    },
    Case {
        name: "a glTF that requires Draco",
        code: 3,
        says: &["x.glb", "draco"],
        make: |f| requiring(f, "KHR_draco_mesh_compression"),
    },
    Case {
        name: "a glTF that requires the unknown",
        code: 3,
        says: &["x.glb", "ACME_magic"],
        make: |f| requiring(f, "ACME_magic"),
    },
    Case {
        name: "a glTF without its buffer",
        code: 3,
        says: &["gone.bin"],
        make: |f| {
            let mut json = shapes::triangle_gltf();
            json["buffers"][0]["uri"] = json!("gone.bin");
            put(f, "x.gltf", json.to_string())
        },
    },
    Case {
        name: "a glTF with a buffer outside",
        code: 3,
        says: &["x.gltf", "../b.bin"],
        make: |f| {
            let mut json = shapes::triangle_gltf();
            json["buffers"][0]["uri"] = json!("../b.bin");
            put(f, "b.bin", shapes::triangle_bytes([0, 1, 2]));
            put(f, "in/x.gltf", json.to_string())
        },
    },
    Case {
        name: "a GLB that is cut",
        code: 3,
        says: &["x.glb"],
        make: |f| {
            let whole = shapes::glb(&shapes::triangle_gltf(), &shapes::triangle_bytes([0, 1, 2]));
            put(f, "x.glb", &whole[..whole.len() - 20])
        },
    },
    Case {
        name: "a GLB with another magic",
        code: 3,
        says: &["x.glb"],
        make: |f| put(f, "x.glb", b"b3dm\x01\0\0\0\x1c\0\0\0"),
    },
    Case { name: "a glTF that is no JSON", code: 3, says: &["x.gltf"], make: |f| put(f, "x.gltf", "{ \"asset\": ") },
    Case {
        name: "a GLB whose indices are out of range",
        code: 3,
        says: &["x.glb"],
        make: |f| put(f, "x.glb", shapes::glb(&shapes::triangle_gltf(), &shapes::triangle_bytes([0, 1, 999]))),
    },
    Case {
        name: "a GLB whose accessor passes its buffer",
        code: 3,
        says: &["x.glb"],
        make: |f| gltf(f, |json| json["accessors"][0]["count"] = json!(3_000_000)),
    },
    Case {
        name: "nodes in a circle",
        code: 3,
        says: &["x.glb", "node"],
        make: |f| gltf(f, |json| json["nodes"] = json!([{ "mesh": 0, "children": [1] }, { "children": [0] }])),
    },
    Case {
        name: "a glTF of points",
        code: 3,
        says: &["x.glb"],
        make: |f| gltf(f, |json| json["meshes"][0]["primitives"][0]["mode"] = json!(0)),
    },
    Case {
        name: "a PLY without end_header",
        code: 3,
        says: &["x.ply", "end_header"],
        make: |f| put(f, "x.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n"),
    },
    Case {
        name: "a binary PLY that is cut",
        code: 3,
        says: &["x.ply"],
        make: |f| put(f, "x.ply", [PLY.as_bytes(), &[0; 30]].concat()),
    },
    Case {
        name: "a PLY that claims more than it has",
        code: 3,
        says: &["x.ply"],
        make: |f| put(f, "x.ply", [PLY.replace("vertex 3", "vertex 4000000000").as_bytes(), &[0; 60]].concat()),
    },
    Case {
        name: "a point cloud",
        code: 3,
        says: &["x.ply", "point cloud"],
        make: |f| {
            put(
                f,
                "x.ply",
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n",
            )
        },
    },
    Case { name: "a file of another kind", code: 3, says: &["x.fbx", ".obj"], make: |f| put(f, "x.fbx", "Kaydara") },
    Case {
        name: "a folder without meshes",
        code: 3,
        says: &["empty", "no mesh"],
        make: |f| {
            put(f, "empty/readme.txt", "nothing");
            args(&["empty"])
        },
    },
    Case { name: "an unknown system", code: 2, says: &["EPSG:99999"], make: |f| house(f, &["--crs", "EPSG:99999"]) },
    Case { name: "no system at all", code: 2, says: &["'home'"], make: |f| house(f, &["--crs", "home"]) },
    Case {
        name: "latitude and longitude swapped",
        code: 2,
        says: &["swapped"],
        make: |f| house(f, &["--crs", "ENU:148.1,-33.5"]),
    },
    Case {
        name: "an origin that is no point",
        code: 2,
        says: &["'here'"],
        make: |f| house(f, &["--crs", "EPSG:25832", "--origin", "here,there"]),
    },
    Case {
        name: "an origin its system does not reach",
        code: 2,
        says: &["25832"],
        make: |f| house(f, &["--crs", "EPSG:25832", "--origin", "1e9,1e9,0"]),
    },
    Case {
        name: "metadata that is no XML",
        code: 3,
        says: &["metadata.xml", "XML"],
        make: |f| metadata(f, "<ModelMetadata><SRS>EPSG:25832"),
    },
    Case {
        name: "metadata with an unknown system",
        code: 3,
        says: &["metadata.xml", "EPSG:99999"],
        make: |f| metadata(f, "<ModelMetadata><SRS>EPSG:99999</SRS></ModelMetadata>"),
    },
    Case {
        name: "a config that is no TOML",
        code: 2,
        says: &["c.toml"],
        make: |f| {
            put(f, "c.toml", "levels = [");
            house(f, &["--config", "c.toml"])
        },
    },
    Case {
        name: "a config with an unknown setting",
        code: 2,
        says: &["leaf_face"],
        make: |f| {
            put(f, "c.toml", "[levels]\nleaf_face = 3\n");
            house(f, &["--config", "c.toml"])
        },
    },
    Case {
        name: "a config that is not there",
        code: 2,
        says: &["gone.toml"],
        make: |f| house(f, &["--config", "gone.toml"]),
    },
    Case { name: "no threads", code: 2, says: &["--threads 0"], make: |f| house(f, &["--threads", "0"]) },
    Case {
        name: "a height offset of no height",
        code: 2,
        says: &["height"],
        make: |f| house(f, &["--crs", "EPSG:25832", "--origin", "566000,5930000,0", "--height-offset", "nan"]),
    },
];

/// Requires the code and exactly one sentence, which has all of `says`.
fn judge(name: &str, run: &Run, code: i32, says: &[&str]) -> Result<(), String> {
    let lines: Vec<&str> = run.stderr.lines().filter(|l| !l.trim().is_empty()).collect();
    if run.code != code || lines.len() != 1 || !run.stdout.is_empty() || run.stderr.contains("panicked") {
        return Err(format!("{name}: exit code {} for {code}, {lines:?}, data {:?}", run.code, run.stdout));
    }
    match says.iter().find(|s| !lines[0].contains(*s)) {
        Some(lacks) => Err(format!("{name}: {lacks:?} is not in {:?}", lines[0])),
        None if !lines[0].starts_with("rooftile: ") || lines[0].len() < 30 => Err(format!("{name}: {:?}", lines[0])),
        None => Ok(()),
    }
}

#[test]
fn every_kind_of_bad_input_ends_in_one_sentence_and_leaves_nothing() {
    assert!(CASES.len() >= 20);
    let mut faults = Vec::new();
    for case in CASES {
        let temp = tempfile::tempdir().expect("a folder");
        let args = (case.make)(temp.path());
        let before = files(temp.path());
        let run = command().current_dir(temp.path()).args(["build", "-q", "-o", "tiles"]).args(&args).output();
        let run = Run::from(run.expect("the program starts"));
        faults.extend(judge(case.name, &run, case.code, case.says).err());
        if files(temp.path()) != before {
            faults.push(format!("{}: left {:?}", case.name, files(temp.path()).keys()));
        }
    }
    assert!(faults.is_empty(), "{} of {}:\n{}", faults.len(), CASES.len(), faults.join("\n"));
}

#[test]
fn outputs_that_cannot_be_made_are_refused() {
    let temp = tempfile::tempdir().expect("a folder");
    let house = shapes::house(&temp.path().join("in"));
    let file = temp.path().join("file");
    fs::write(&file, "mine").expect("a file");
    let before = files(temp.path());
    let mut cases = vec![
        ("an output that is a file", file.clone(), 5, "file"),
        ("an output below a file", file.join("tiles"), 6, "file"),
        ("an output deep below a file", file.join("a/b/tiles"), 6, "file"),
        ("an output that is the root", "/".into(), 5, "/"),
        ("an output of no name", temp.path().join(".."), 5, ""),
    ];
    let locked = temp.path().join("locked");
    if cfg!(unix) && !is_root() {
        cases.push(("an output in a folder that is read-only", locked.join("tiles"), 6, "locked"));
    }
    for (name, out, code, says) in cases {
        if out.starts_with(&locked) {
            fs::create_dir(&locked).expect("a folder");
            let mut mode = fs::metadata(&locked).expect("a folder").permissions();
            mode.set_readonly(true);
            fs::set_permissions(&locked, mode).expect("a mode");
        }
        let run = build(&house, &out, &[]);
        judge(name, &run, code, &[says]).unwrap();
        let _ = fs::remove_dir(&locked);
        assert!(files(temp.path()) == before, "{name} left something: {:?}", files(temp.path()).keys());
    }
}

#[test]
fn a_vertex_beyond_the_moon_is_refused() {
    let temp = tempfile::tempdir().expect("a folder");
    put(temp.path(), "x.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1e30 0 0\nf 1 2 3\nf 2 3 4\n");
    let run = build(&temp.path().join("x.obj"), &temp.path().join("tiles"), &[]);
    judge("a vertex at 1e30", &run, 3, &["x.obj"]).unwrap();
}

#[test]
fn a_vertex_of_no_face_does_not_move_the_frame() {
    let temp = tempfile::tempdir().expect("a folder");
    let text = "v 0 0 0\nv 566000 5930000 9\nv 566010 5930000 9\nv 566000 5930010 9\nf 2 3 4\n";
    put(temp.path(), "x.obj", text);
    let run =
        build(&temp.path().join("x.obj"), &temp.path().join("tiles"), &["--json", "--crs", "EPSG:25832"]).wants(0);
    assert_eq!(run.json()["frame"]["origin_source"], json!([566005.0, 5930005.0, 9.0]));
}

/// To the superuser nothing is read-only.
fn is_root() -> bool {
    let id = std::process::Command::new("id").arg("-u").output().expect("id runs");
    id.stdout.trim_ascii() == b"0"
}

#[cfg(unix)]
#[test]
fn a_pipe_in_place_of_a_file_is_refused_and_not_waited_for() {
    let temp = tempfile::tempdir().expect("a folder");
    let pipe = temp.path().join("x.obj");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo runs");
    assert!(made.success());
    judge("a pipe", &build(&pipe, &temp.path().join("tiles"), &[]), 3, &["x.obj", "pipe"]).unwrap();
}

/// Code and count of each warning of a build that has to succeed.
fn warnings(folder: &Path, more: &[&str]) -> Vec<(String, u64)> {
    let run = build(&folder.join("house.obj"), &folder.join("tiles"), &[&["--json"], more].concat()).wants(0);
    assert_eq!(run.stderr, "");
    let report = run.json();
    let list = report["warnings"].as_array().expect("warnings").iter();
    list.map(|w| (w["code"].as_str().expect("a code").to_owned(), w["count"].as_u64().expect("a count"))).collect()
}

#[test]
fn what_can_be_done_without_is_a_counted_warning() {
    type Spoil = fn(&Path);
    type Counts = &'static [(&'static str, u64)];
    let cases: [(&str, Spoil, &[&str], Counts); 9] = [
        ("nothing amiss", |_| {}, &[], &[]),
        ("no MTL", |f| fs::remove_file(f.join("house.mtl")).expect("removed"), &[], &[("missing-mtl", 1)]),
        ("no texture", |f| fs::remove_file(f.join("house.png")).expect("removed"), &[], &[("missing-texture", 1)]),
        (
            "a texture that is no image",
            |f| drop(put(f, "house.png", "not a picture")),
            &[],
            &[("unreadable-texture", 1)],
        ),
        (
            "a texture cut in the middle",
            |f| {
                let whole = fs::read(f.join("house.png")).expect("a file");
                put(f, "house.png", &whole[..whole.len() / 2]);
            },
            &[],
            &[("unreadable-texture", 1)],
        ),
        (
            "a texture of four thousand million pixels, by its header",
            |f| {
                let mut png = fs::read(f.join("house.png")).expect("a file");
                png[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]);
                put(f, "house.png", png);
            },
            &[],
            &[("unreadable-texture", 1)],
        ),
        (
            "two faces out of range and one without area",
            |f| drop(put(f, "house.obj", format!("{}f 1 2 99\nf 99 1 2\nf 1 1 2\n", shapes::HOUSE))),
            &[],
            &[("bad-index", 2), ("dropped-degenerate", 1), ("missing-uv", 1)],
        ),
        (
            "one coordinate that is no number",
            |f| drop(put(f, "house.obj", format!("{}v nan 0 0\nf 1 2 15\n", shapes::HOUSE))),
            &[],
            &[("bad-coordinate", 1)],
        ),
        ("a model at the zero point of its system", |_| {}, &["--crs", "EPSG:25832"], &[("crs-area", 1)]),
    ];
    let mut faults = Vec::new();
    for (name, spoil, more, wanted) in cases {
        let temp = tempfile::tempdir().expect("a folder");
        shapes::house(temp.path());
        spoil(temp.path());
        let found = warnings(temp.path(), more);
        if found.iter().map(|(c, n)| (c.as_str(), *n)).collect::<Vec<_>>() != wanted {
            faults.push(format!("{name}: {found:?}, wanted {wanted:?}"));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}
