use std::fmt::Write;
use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use super::*;
use crate::input::ImageRef;

const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

/// A folder with the files named, removed with the value.
struct Folder(tempfile::TempDir);

impl Folder {
    fn of(files: &[(&str, &[u8])]) -> Self {
        let folder = Self(tempfile::tempdir().unwrap());
        for (name, bytes) in files {
            fs::create_dir_all(folder.path(name).parent().unwrap()).unwrap();
            fs::write(folder.path(name), bytes).unwrap();
        }
        folder
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn read_in(
        &self,
        name: &str,
        config: &InputConfig,
        chunk_bytes: u64,
    ) -> (Result<Source>, Vec<(&'static str, u64)>) {
        let reporter = Reporter::new(true);
        let mut source = Source::default();
        let outcome = read_chunked(&self.path(name), config, &reporter, &mut source, chunk_bytes);
        (outcome.map(|()| source), reporter.warnings().iter().map(|w| (w.code, w.count)).collect())
    }

    fn read(&self, name: &str) -> (Result<Source>, Vec<(&'static str, u64)>) {
        self.read_in(name, &InputConfig::default(), CHUNK_BYTES)
    }
}

fn read_bytes(bytes: &[u8]) -> (Result<Source>, Vec<(&'static str, u64)>) {
    Folder::of(&[("x.obj", bytes)]).read("x.obj")
}

/// The part of a text that is read without a warning.
fn part(text: &str) -> Part {
    let (source, warnings) = read_bytes(text.as_bytes());
    assert_eq!(warnings, [], "{text}");
    source.unwrap().parts.remove(0)
}

fn warned(text: &str) -> (Part, Vec<(&'static str, u64)>) {
    let (source, warnings) = read_bytes(text.as_bytes());
    (source.unwrap().parts.remove(0), warnings)
}

fn refusal(text: &str) -> Error {
    read_bytes(text.as_bytes()).0.unwrap_err()
}

#[test]
fn all_four_corner_forms_are_read_and_may_be_mixed() {
    for face in ["1 2 3", "1/1 2/2 3/3", "1//1 2//1 3//1", "1/1/1 2/2/1 3/3/1", "1 2/ 3//", "1 2/2 3/3/9"] {
        let part = part(&format!("{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nf {face}\n"));
        assert_eq!(part.faces, [[0, 1, 2]], "{face}");
    }
}

#[test]
fn texture_coordinates_are_turned_v_down_per_corner() {
    let found = part(&format!("{SQUARE}vt 0.25 0.75 0\nvt 1\nvt 0.5 1.0 # top\nf 1/1 2/2 3/3\nf 1/3 3/2 4/1\n"));
    let corners = [(0.25, 0.25), (1.0, 1.0), (0.5, 0.0)].map(Vec2::from);
    assert_eq!(found.corner_uvs, [corners, [corners[2], corners[1], corners[0]]]);
    assert!(part(&format!("{SQUARE}vt 0 0\nf 1 2 3\n")).corner_uvs.is_empty());
}

#[test]
fn vertices_may_carry_a_weight_or_a_colour_and_colours_may_be_partial() {
    let found = part("v 0 0 0 1.0\nv 1 0 0 0 0.5 1\nv 1 1 0\nv 0 1 0 1 1 1 1\nf 1 2 3 4\n");
    assert_eq!(found.vertex_colors, [DEFAULT_COLOR, [0, 128, 255], DEFAULT_COLOR, [255; 3]]);
    assert_eq!(found.positions[3], DVec3::new(0.0, 1.0, 0.0));
    let found = part("v 0 0 0 255 128 1\nv 1 0 0 0 0 0\nv 1 1 0 1 1 1\nf 1 2 3\n");
    assert_eq!(found.vertex_colors, [[255, 128, 1], [0; 3], [1; 3]]);
    assert!(part(&format!("{SQUARE}f 1 2 3\n")).vertex_colors.is_empty());
}

#[test]
fn polygons_are_triangulated_also_where_they_are_dented() {
    assert_eq!(part(&format!("{SQUARE}f 1 2 3 4\n")).faces, [[0, 1, 2], [0, 2, 3]]);
    let dented = part("v 0 0 0\nv 4 0 0\nv 1 1 0\nv 0 4 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n");
    assert_eq!(dented.faces, [[0, 1, 2], [0, 2, 3]]);
    let turned = part("v 4 0 0\nv 1 1 0\nv 0 4 0\nv 0 0 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n");
    assert_eq!(turned.faces, [[1, 2, 3], [1, 3, 0]]);
    assert_eq!(turned.corner_uvs[1], [(1.0, 1.0), (0.0, 0.0), (0.0, 1.0)].map(Vec2::from));
}

#[test]
fn negative_indices_count_back_from_where_they_stand() {
    let part = part("v 9 9 9\nv 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 0 1 0\nf -4 -2 -1\n");
    assert_eq!(part.faces, [[1, 2, 3], [1, 3, 4]]);
}

#[test]
fn a_face_may_stand_before_its_vertices() {
    assert_eq!(part(&format!("f 1 2 3\n{SQUARE}f 1 3 4")).faces, [[0, 1, 2], [0, 2, 3]]);
}

#[test]
fn line_ends_blanks_marks_continuations_and_comments_change_nothing() {
    let plain = format!("{SQUARE}usemtl a\nf 1 2 3 4\n");
    let expected = part(&plain);
    let same = |text: &[u8]| {
        let (source, warnings) = read_bytes(text);
        let found = source.unwrap().parts.remove(0);
        assert_eq!((&found.positions, &found.faces, warnings), (&expected.positions, &expected.faces, vec![]));
    };
    same(plain.replace('\n', "\r\n").as_bytes());
    same(plain.replace('\n', "\r").as_bytes());
    same(plain.replace(' ', "\t  ").as_bytes());
    same(plain.replace(' ', "\x0b").as_bytes());
    same(plain.trim_end().as_bytes());
    same(plain.replace('\n', " # comment\n\n  # C:\\folder\\\n").as_bytes());
    same(plain.replace("2 3 4", "2 \\\n3 \\\r\n4").as_bytes());
    same(format!("\u{feff}{plain}").as_bytes());
    same(format!("o x\ng a b\ns 1\nvn 0 0 1\nl 1 2\np 1\nvp 1\nfoo\n{plain}").as_bytes());
    for big in [false, true] {
        let units = format!("\u{feff}{plain}");
        let bytes = units.encode_utf16().flat_map(|u| if big { u.to_be_bytes() } else { u.to_le_bytes() });
        same(&bytes.collect::<Vec<_>>());
    }
}

#[test]
fn faces_of_one_or_two_corners_are_skipped_and_counted() {
    let (part, warnings) = warned(&format!("{SQUARE}f 1 2 3\nf 1\nf 1 2\nf\nf # none\n"));
    assert_eq!((part.faces.len(), warnings), (1, vec![("short-face", 4)]));
}

#[test]
fn faces_with_coordinates_that_are_no_numbers_are_dropped_and_counted() {
    for bad in ["nan 0 0", "0 inf 0", "1e400 0 0", "1,5 0 0", "0 0", "1.#IND 0 0", "x y z"] {
        let (part, warnings) = warned(&format!("v {bad}\n{SQUARE}f 2 3 4\nf 2 4 5\nf 1 2 3\n"));
        assert_eq!((part.faces, warnings), (vec![[1, 2, 3], [1, 3, 4]], vec![("bad-coordinate", 1)]), "{bad}");
        assert!(part.positions.iter().all(|p| p.is_finite()));
    }
}

#[test]
fn faces_with_indices_out_of_range_are_dropped_and_counted() {
    for bad in ["0 1 2", "5 1 2", "-5 1 2", "99999999999999999999 1 2", "-99999999999999999999 1 2", "1.5 1 2", "a 1 2"]
    {
        let (part, warnings) = warned(&format!("{SQUARE}f 1 2 3\nf {bad}\nf 1 3 4\n"));
        assert_eq!((part.faces, warnings), (vec![[0, 1, 2], [0, 2, 3]], vec![("bad-index", 1)]), "{bad}");
    }
}

#[test]
fn a_file_most_of_whose_faces_are_bad_is_refused_and_the_first_named() {
    let error = refusal(&format!("{SQUARE}f 1 2 3\nf 0 1 2\nf 1 2 9\n")).to_string();
    assert!(error.contains("line 6") && error.contains("2 of 3"), "{error}");
    let error = refusal(&SQUARE.replace(' ', " 1,").add_face()).to_string();
    assert!(error.contains("line 5") && error.contains("line 1 has the coordinates `1,0 1,0 1,0`"), "{error}");
}

trait AddFace {
    fn add_face(&self) -> String;
}

impl AddFace for String {
    fn add_face(&self) -> String {
        format!("{self}f 1 2 3\n")
    }
}

#[test]
fn what_holds_no_mesh_is_refused() {
    for text in ["", "\n\n", SQUARE, "v 0 0 0\np 1\n", "<html></html>", "\u{feff}", "f 1 2\n"] {
        assert!(matches!(refusal(text), Error::Input { .. }), "{text:?}");
    }
    assert!(matches!(refusal(&format!("{SQUARE}f 1 2 3\n\0")), Error::Input { at: Place::Byte(40), .. }));
    assert!(matches!(
        read_bytes(&SQUARE.encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<_>>()).0,
        Err(Error::Input { .. })
    ));
}

#[test]
fn a_line_over_a_mebibyte_is_over_the_limit_in_whatever_chunk() {
    let long = format!("{SQUARE}f 1 2 3\n# {}\n{SQUARE}", "x".repeat(1 << 20));
    let folder = Folder::of(&[("x.obj", long.as_bytes())]);
    for chunk_bytes in [64, 100_000, CHUNK_BYTES] {
        let (outcome, _) = folder.read_in("x.obj", &InputConfig::default(), chunk_bytes);
        assert!(matches!(outcome, Err(Error::Limit { .. })));
    }
    let endless = vec![b'1'; 5 << 20];
    assert!(matches!(read_bytes(&endless).0, Err(Error::Limit { .. })));
}

#[test]
fn a_bad_texture_coordinate_costs_the_image_and_not_the_face() {
    let text = "mtllib m.mtl\nvt 0 0\nvt nan 0\nusemtl a\nf 1/1 2/1 3/1\nf 1/1 2/2 3/1\nf 1/1 2/9 3/1\nf 1 3 4\n";
    let folder = Folder::of(&[
        ("x.obj", format!("{SQUARE}{text}").as_bytes()),
        ("m.mtl", b"newmtl a\nmap_Kd t.jpg\n"),
        ("t.jpg", b"x"),
    ]);
    let (source, warnings) = folder.read("x.obj");
    let source = source.unwrap();
    assert_eq!(warnings, [("bad-uv", 2), ("missing-uv", 3)]);
    let images: Vec<_> = source.parts[0].face_material.iter().map(|&m| source.materials[m as usize].image).collect();
    assert_eq!(images, [Some(0), None, None, None]);
    assert_eq!(source.materials.len(), 2);
}

#[test]
fn materials_come_in_order_of_use_with_the_names_they_have() {
    let text = "f 1 2 3\nusemtl unused\nusemtl roof 1 # red\nf 1 2 3\nf 1 3 4\nusemtl +WallSurface\nf 1 2 4\nusemtl roof 1\nf 2 3 4\n";
    let (source, warnings) = read_bytes(format!("{SQUARE}{text}").as_bytes());
    let source = source.unwrap();
    let names: Vec<_> = source.materials.iter().map(|m| m.name.as_str()).collect();
    assert_eq!((names, warnings), (vec!["", "roof 1", "+WallSurface"], vec![]));
    assert_eq!(source.parts[0].face_material, [0, 1, 1, 2, 1]);
}

#[test]
fn latin_1_names_match_between_the_files() {
    let folder = Folder::of(&[
        ("x.obj", &[SQUARE.as_bytes(), b"mtllib fa\xe7ade.mtl\nusemtl fa\xe7ade\nf 1 2 3\n"].concat()),
        ("façade.mtl", b"newmtl fa\xe7ade\nKd 1 0 0\n"),
    ]);
    let (source, warnings) = folder.read("x.obj");
    assert_eq!(warnings, []);
    assert_eq!(source.unwrap().materials[0], Material { name: "façade".into(), base_color: [255, 0, 0], image: None });
}

fn with_library(mtllib: &str, files: &[(&str, &[u8])]) -> (Result<Source>, Vec<(&'static str, u64)>) {
    let text = format!("{SQUARE}mtllib {mtllib}\nusemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\n");
    let folder = Folder::of(&[("in/x.obj", text.as_bytes())]);
    for (name, bytes) in files {
        fs::create_dir_all(folder.path(name).parent().unwrap()).unwrap();
        fs::write(folder.path(name), bytes).unwrap();
    }
    folder.read("in/x.obj")
}

#[test]
fn several_libraries_and_names_with_spaces_are_found() {
    let red: (&str, &[u8]) = ("in/my red.mtl", b"newmtl a\nKd 1 0 0\n");
    let blue: (&str, &[u8]) = ("in/sub/my blue.mtl", b"newmtl b\nKd 0 0 1\n");
    for names in [
        "my red.mtl sub/my blue.mtl",
        "MY RED.MTL\tsub\\my\\ blue.mtl # both",
        "my red.mtl\nmtllib \"sub/my blue.mtl\"",
    ] {
        let (source, warnings) = with_library(names, &[red, blue]);
        let colors: Vec<_> = source.unwrap().materials.iter().map(|m| m.base_color).collect();
        assert_eq!((colors, warnings), (vec![[255, 0, 0], [0, 0, 255]], vec![]), "{names}");
    }
    let (source, warnings) = with_library("not there.mtl my red.mtl gone.mtl", &[red]);
    assert_eq!(source.unwrap().materials[0].base_color, [255, 0, 0]);
    assert_eq!(warnings, [("missing-material", 1), ("missing-mtl", 2)]);
}

#[test]
fn what_is_missing_is_grey_and_counted() {
    let (source, warnings) = with_library("gone.mtl", &[]);
    assert_eq!(source.unwrap().materials[1].base_color, DEFAULT_COLOR);
    assert_eq!(warnings, [("missing-mtl", 1)]);
    let (source, warnings) =
        with_library("m.mtl", &[("in/m.mtl", b"newmtl a\nmap_Kd gone.jpg\nnewmtl b\nmap_Kd .\nnewmtl a\n")]);
    assert!(source.unwrap().materials.iter().all(|m| m.image.is_none()));
    assert_eq!(warnings, [("missing-texture", 2), ("repeated-material", 1)]);
}

#[test]
fn one_image_by_two_names_is_one_image() {
    let text = format!("{SQUARE}mtllib m.mtl\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\nusemtl b\nf 1/1 3/1 4/1\n");
    let folder = Folder::of(&[
        ("x.obj", text.as_bytes()),
        ("m.mtl", b"newmtl a\nmap_Kd -s 1 1 1 tex/My Roof.jpg\nnewmtl b\nmap_Kd .\\TEX\\my roof.JPG\n"),
        ("tex/My Roof.jpg", b"x"),
    ]);
    let (source, warnings) = folder.read("x.obj");
    let source = source.unwrap();
    assert_eq!(warnings, []);
    assert_eq!(source.materials.iter().map(|m| m.image).collect::<Vec<_>>(), [Some(0), Some(0)]);
    assert!(matches!(&source.images[..], [ImageRef::File(path)] if path.ends_with("tex/My Roof.jpg")));
}

#[test]
fn paths_out_of_the_folder_are_refused_unless_allowed() {
    let outside: [(&str, &[u8]); 2] = [("out.mtl", b"newmtl a\nKd 1 0 0\n"), ("out.jpg", b"x")];
    for name in ["../out.mtl", "/out.mtl", "C:\\out.mtl", "\\\\host\\out.mtl", "http://host/out.mtl"] {
        assert!(matches!(with_library(name, &outside).0, Err(Error::Input { .. })), "{name}");
    }
    let mtl: (&str, &[u8]) = ("in/m.mtl", b"newmtl a\nmap_Kd ../out.jpg\n");
    assert!(matches!(with_library("m.mtl", &[mtl, outside[1]]).0, Err(Error::Input { at: Place::Line(2), .. })));
    let folder =
        Folder::of(&[("in/x.obj", format!("{SQUARE}mtllib ../out.mtl\nusemtl a\nf 1 2 3\n").as_bytes()), outside[0]]);
    let wider = [
        InputConfig { allow_outside: true, root: None },
        InputConfig { allow_outside: false, root: Some(folder.path("")) },
    ];
    for config in wider {
        let (source, warnings) = folder.read_in("in/x.obj", &config, CHUNK_BYTES);
        assert_eq!((source.unwrap().materials[0].base_color, warnings), ([255, 0, 0], vec![]));
    }
}

/// A bumpy grid of `n`² quads with uvs, in several materials, every third face by negative indices.
fn grid(n: usize) -> String {
    let mut text = String::from("mtllib m.mtl\n");
    for row in 0..=n {
        for column in 0..=n {
            let height = ((row * 7 + column * 13) % 11) as f64 * 0.173;
            writeln!(
                text,
                "v {}.25 {:.3} {height:.4}\nvt {} {:.4}",
                column,
                row as f64 * 0.7,
                column as f64 / 8.0,
                height
            )
            .unwrap();
        }
        if row == 0 {
            continue;
        }
        writeln!(text, "usemtl m{}", row % 3).unwrap();
        for column in 1..=n {
            let d = (row * (n + 1) + column + 1) as i64;
            let [a, b, c] = [d - n as i64 - 2, d - n as i64 - 1, d - 1];
            let far = ((row + 1) * (n + 1)) as i64 + 1;
            if column % 3 == 0 {
                let [a, b, d, c] = [a, b, d, c].map(|i| i - far);
                writeln!(text, "f {a}/{a} {b}/{b} {d}/{d} {c}/{c}").unwrap();
            } else {
                writeln!(text, "f {a}/{a} {b}/{b} {d}/{d}\nf {a}/{a} {d}/{d} {c}/{c}").unwrap();
            }
        }
    }
    text
}

#[test]
fn chunk_size_and_thread_count_change_nothing() {
    let text = grid(12).replace("f 1/1 2/2", "f 1/1 \\\n2/2") + "f 1 2 99999\nf 1\nv nan 0 0 1 0 0\nf -1 1 2\n";
    let folder = Folder::of(&[("x.obj", text.as_bytes()), ("m.mtl", b"newmtl m1\nKd 1 0 0\nnewmtl m2\n")]);
    let read = |chunk_bytes| {
        let (source, warnings) = folder.read_in("x.obj", &InputConfig::default(), chunk_bytes);
        (format!("{:?}", source.unwrap()), warnings)
    };
    let whole = read(CHUNK_BYTES);
    assert_eq!(whole.1, [("bad-coordinate", 1), ("bad-index", 1), ("missing-material", 1), ("short-face", 1)]);
    for threads in [1, 2, 7] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        for chunk_bytes in [1, 30, 64, 333, 5000] {
            assert_eq!(pool.install(|| read(chunk_bytes)), whole, "{threads} threads, {chunk_bytes} bytes");
        }
    }
}

#[test]
fn every_cut_of_a_small_file_into_chunks_reads_the_same() {
    let text = format!("# c\\\r\n{SQUARE}f 1 \\\r\n 2\\\n 3\r\rusemtl b\r\nf -4 \\\n\\\n-2 -1\nv 1 2 3\n");
    let folder = Folder::of(&[("x.obj", text.as_bytes())]);
    for chunk_bytes in 1..text.len() as u64 {
        let (source, warnings) = folder.read_in("x.obj", &InputConfig::default(), chunk_bytes);
        let source = source.unwrap();
        assert_eq!((&source.parts[0].faces[..], warnings), (&[[0, 1, 2], [0, 2, 3]][..], vec![]), "{chunk_bytes}");
        assert_eq!((source.parts[0].positions.len(), source.materials.len()), (5, 2));
    }
}

#[test]
fn a_benign_file_reads_as_with_another_reader() {
    let folder = Folder::of(&[("x.obj", grid(20).as_bytes()), ("m.mtl", b"newmtl m0\nnewmtl m1\nnewmtl m2\n")]);
    let (source, warnings) = folder.read_in("x.obj", &InputConfig::default(), 1000);
    assert_eq!(warnings, []);
    let ours = source.unwrap().parts.remove(0);
    let options = tobj::LoadOptions { triangulate: true, ..Default::default() };
    let (models, _) = tobj::load_obj(folder.path("x.obj"), &options).unwrap();
    assert_eq!(models.iter().map(|m| m.mesh.indices.len()).sum::<usize>(), ours.faces.len() * 3);
    // tobj renumbers per model, so triangles are compared by what their corners hold. It splits a dented quad along
    // the other diagonal than we do, hence whole quads: none of the grid's is dented.
    let mut at = 0;
    for mesh in models.iter().map(|model| &model.mesh) {
        for (p, t) in mesh.indices.iter().zip(&mesh.texcoord_indices) {
            let position = ours.positions[ours.faces[at / 3][at % 3] as usize].as_vec3().to_array();
            assert_eq!(&mesh.positions[*p as usize * 3..][..3], position);
            let uv = ours.corner_uvs[at / 3][at % 3];
            let [u, v] = [mesh.texcoords[*t as usize * 2], mesh.texcoords[*t as usize * 2 + 1]];
            assert!(uv.x == u && (uv.y - (1.0 - v)).abs() < 1e-6);
            at += 1;
        }
    }
}

#[test]
fn every_truncation_is_read_or_refused() {
    let obj =
        format!("\u{feff}mtllib m.mtl\r\n{SQUARE}vt 0 1\r\nusemtl a\nf 1/1/1 2/1/1 \\\n3/1/1 4/1/1\nf -4 -3 -2\n");
    let mtl = "newmtl a\nKd 1 0.5 0\nmap_Kd -s 1 1 1 t.jpg\n";
    for end in 0..=obj.len() {
        let folder = Folder::of(&[("x.obj", &obj.as_bytes()[..end]), ("m.mtl", mtl.as_bytes()), ("t.jpg", b"x")]);
        let _ = folder.read("x.obj");
    }
    for end in 0..=mtl.len() {
        let folder = Folder::of(&[("x.obj", obj.as_bytes()), ("m.mtl", &mtl.as_bytes()[..end]), ("t.jpg", b"x")]);
        assert!(folder.read("x.obj").0.is_ok());
    }
}

#[test]
fn every_flipped_byte_is_read_or_refused() {
    let obj = format!("mtllib m.mtl\n{SQUARE}vt 0 1\nusemtl a\nf 1/1/1 2/1/1 3/1/1 4/1/1\nf -4 -3 -2\n").into_bytes();
    let folder = Folder::of(&[("m.mtl", b"newmtl a\n")]);
    for at in 0..obj.len() {
        for byte in [0, b'\n', b'\\', b'-', b'/', b'9', b' ', 0xFF, obj[at] ^ 0x40] {
            let mut bytes = obj.clone();
            bytes[at] = byte;
            fs::write(folder.path("x.obj"), &bytes).unwrap();
            let (outcome, _) = folder.read_in("x.obj", &InputConfig::default(), 50);
            for part in outcome.iter().flat_map(|source| &source.parts) {
                assert!(part.faces.iter().flatten().all(|&v| (v as usize) < part.positions.len()));
            }
        }
    }
}

/// The nearest folder of public bad inputs, if it was unpacked.
fn data(inner: &str) -> Option<PathBuf> {
    let Some(data) = std::env::var_os("ROOFTILE_DATA") else {
        eprintln!("SKIPPED: ROOFTILE_DATA is not set, so `{inner}` is not read");
        return None;
    };
    Some(PathBuf::from(data).join(inner))
}

fn files_below(folder: &std::path::Path, found: &mut Vec<PathBuf>) {
    let mut paths: Vec<_> = fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
    paths.sort();
    for path in paths {
        if path.is_dir() {
            files_below(&path, found);
        } else {
            found.push(path);
        }
    }
}

#[test]
fn public_bad_inputs_are_read_or_refused_in_time() {
    let Some(folder) = data("nasty") else { return };
    let mut files = Vec::new();
    files_below(&folder, &mut files);
    let ending = |path: &PathBuf| path.extension().map(|e| e.to_ascii_lowercase().to_string_lossy().into_owned());
    let (mut read, mut refused) = (0, 0);
    for path in &files {
        let stand_in;
        let (object, config) = match ending(path).as_deref() {
            Some("obj") => (path.clone(), InputConfig::default()),
            // An MTL is read through an OBJ that uses every material it names.
            Some("mtl") => {
                let mut text = format!("mtllib {}\n{SQUARE}vt 0 0\n", path.file_name().unwrap().to_string_lossy());
                for line in lines_of(path).iter().filter(|line| line.trim_start().starts_with("newmtl")) {
                    writeln!(text, "usemtl {}\nf 1/1 2/1 3/1", line.trim_start().trim_start_matches("newmtl")).unwrap();
                }
                stand_in = Folder::of(&[("x.obj", text.as_bytes())]);
                fs::copy(path, stand_in.path(&path.file_name().unwrap().to_string_lossy())).unwrap();
                (stand_in.path("x.obj"), InputConfig::default())
            }
            _ => continue,
        };
        let reporter = Reporter::new(true);
        let mut source = Source::default();
        let started = Instant::now();
        let outcome = super::read(&object, &config, &reporter, &mut source);
        assert!(started.elapsed() < Duration::from_secs(60), "{} takes too long", path.display());
        let warnings: Vec<_> = reporter.warnings().iter().map(|w| format!("{} {}", w.count, w.code)).collect();
        let shown = path.strip_prefix(&folder).unwrap().display();
        match outcome {
            Ok(()) => {
                read += 1;
                let part = &source.parts[0];
                assert!(part.faces.iter().flatten().all(|&v| (v as usize) < part.positions.len()));
                assert!(part.face_material.iter().all(|&m| (m as usize) < source.materials.len()));
                assert!(part.positions.iter().all(|p| p.is_finite()));
                assert!(part.corner_uvs.is_empty() || part.corner_uvs.len() == part.faces.len());
                eprintln!(
                    "read    {shown}: {} faces, {} materials; {warnings:?}",
                    part.faces.len(),
                    source.materials.len()
                );
            }
            Err(error) => {
                refused += 1;
                eprintln!("refused {shown}: {error}");
            }
        }
    }
    eprintln!("{read} read, {refused} refused");
    assert!(read > 5 * refused, "most of these files are odd, not broken");
}

fn lines_of(path: &std::path::Path) -> Vec<String> {
    fs::read(path).unwrap().split(|&b| b == b'\n' || b == b'\r').map(crate::input::lines::text).collect()
}

#[test]
fn a_large_file_is_timed() {
    let Some(path) = data("machangara/machangara.obj") else { return };
    let (mut source, reporter) = (Source::default(), Reporter::new(true));
    let started = Instant::now();
    super::read(&path, &InputConfig::default(), &reporter, &mut source).unwrap();
    let seconds = started.elapsed().as_secs_f64();
    let part = &source.parts[0];
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find(|line| line.starts_with("VmHWM")).unwrap_or("").to_owned();
    eprintln!("{} faces, {} vertices in {seconds:.2} s; {peak}", part.faces.len(), part.positions.len());
    assert_eq!(reporter.warnings().iter().map(|w| w.code).collect::<Vec<_>>(), Vec::<&str>::new());
}
