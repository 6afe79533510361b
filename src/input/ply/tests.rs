//! One test a rule, on a square built here in all three formats.

use std::path::Path;

use glam::{dvec3, vec2};
use ply_rs_bw::ply::{DefaultElement, Ply, Property};

use crate::input::{ImageRef, InputConfig, Source};
use crate::report::Reporter;
use crate::{Error, Result};

/// A value in a row.
#[derive(Clone, Copy)]
enum Cell {
    U8(u8),
    I32(i32),
    F32(f32),
    F64(f64),
}
use Cell::{F32, F64, I32, U8};

const FORMATS: [&str; 3] = ["ascii", "binary_little_endian", "binary_big_endian"];

/// A file of the given format; `header` is all between the format line and end_header.
fn file(format: &str, header: &str, rows: &[Vec<Cell>]) -> Vec<u8> {
    let mut bytes = format!("ply\nformat {format} 1.0\n{header}end_header\n").into_bytes();
    for row in rows {
        for &cell in row {
            match format {
                "ascii" => bytes.extend(match cell {
                    U8(v) => format!("{v} ").into_bytes(),
                    I32(v) => format!("{v} ").into_bytes(),
                    F32(v) => format!("{v} ").into_bytes(),
                    F64(v) => format!("{v} ").into_bytes(),
                }),
                "binary_little_endian" => match cell {
                    U8(v) => bytes.push(v),
                    I32(v) => bytes.extend(v.to_le_bytes()),
                    F32(v) => bytes.extend(v.to_le_bytes()),
                    F64(v) => bytes.extend(v.to_le_bytes()),
                },
                _ => match cell {
                    U8(v) => bytes.push(v),
                    I32(v) => bytes.extend(v.to_be_bytes()),
                    F32(v) => bytes.extend(v.to_be_bytes()),
                    F64(v) => bytes.extend(v.to_be_bytes()),
                },
            }
        }
        if format == "ascii" {
            bytes.push(b'\n');
        }
    }
    bytes
}

const XYZ: &str = "element vertex 4\nproperty double x\nproperty double y\nproperty double z\n";
const TRIANGLES: &str = "element face 2\nproperty list uchar int vertex_indices\n";

fn corners() -> Vec<Vec<Cell>> {
    [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.25], [0., 1., 0.]].map(|p| p.map(F64).to_vec()).to_vec()
}

fn face(corners: &[i32]) -> Vec<Cell> {
    [U8(corners.len() as u8)].into_iter().chain(corners.iter().map(|&c| I32(c))).collect()
}

/// The square of two triangles.
fn square(format: &str) -> Vec<u8> {
    file(format, &format!("{XYZ}{TRIANGLES}"), &[corners(), vec![face(&[0, 1, 2]), face(&[0, 2, 3])]].concat())
}

/// Text with its header lines given whole.
fn text(header: &str, body: &str) -> Outcome {
    read(format!("ply\nformat ascii 1.0\n{header}end_header\n{body}").as_bytes())
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
}

fn read(bytes: &[u8]) -> Outcome {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("t.jpg"), b"jpeg").unwrap();
    let path = folder.path().join("mesh.ply");
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
fn a_square_is_the_same_in_text_and_both_byte_orders() {
    for format in FORMATS {
        let outcome = read(&square(format));
        let part = &outcome.source().parts[0];
        assert_eq!(part.positions[2], dvec3(1., 1., 0.25), "{format}");
        assert_eq!(part.faces, [[0, 1, 2], [0, 2, 3]], "{format}");
        assert_eq!((part.face_material.as_slice(), part.corner_uvs.len()), (&[0, 0][..], 0));
        assert_eq!(outcome.source().materials[0].base_color, [128; 3]);
        assert!(outcome.reporter.warnings().is_empty());
    }
}

#[test]
fn another_reader_finds_the_same_vertices_and_faces() {
    for format in ["ascii", "binary_little_endian"] {
        let bytes = square(format);
        let parser = ply_rs_bw::parser::Parser::<DefaultElement>::new();
        let oracle: Ply<DefaultElement> = parser.read_ply(&mut &bytes[..]).unwrap();
        let outcome = read(&bytes);
        let part = &outcome.source().parts[0];
        assert_eq!(oracle.payload["vertex"].len(), part.positions.len());
        for (theirs, ours) in oracle.payload["vertex"].iter().zip(&part.positions) {
            let axis = |name: &str| match theirs[name] {
                Property::Double(v) => v,
                ref other => panic!("{other:?}"),
            };
            assert_eq!(dvec3(axis("x"), axis("y"), axis("z")), *ours);
        }
        for (theirs, ours) in oracle.payload["face"].iter().zip(&part.faces) {
            assert_eq!(theirs["vertex_indices"], Property::ListInt(ours.map(|v| v as i32).to_vec()));
        }
    }
}

#[test]
fn line_ends_of_every_machine_are_understood() {
    let bytes = square("ascii");
    let text = String::from_utf8(bytes).unwrap();
    for end in ["\r\n", "\r"] {
        assert_eq!(read(text.replace('\n', end).as_bytes()).source().parts[0].faces.len(), 2, "{end:?}");
    }
    // A binary body that begins with the byte of a line feed.
    let mut first = corners();
    first[0][0] = F64(f64::from_le_bytes([b'\n', b'\r', b'\n', 0, 0, 0, 0xF0, 0x3F]));
    let header = format!("{XYZ}{TRIANGLES}");
    let bytes = file("binary_little_endian", &header, &[first, vec![face(&[0, 1, 2]), face(&[0, 2, 3])]].concat());
    assert_eq!(read(&bytes).source().parts[0].faces.len(), 2);
    let at = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let dos = String::from_utf8(bytes[..at].to_vec()).unwrap().replace('\n', "\r\n").into_bytes();
    assert_eq!(read(&[&dos[..], &bytes[at..]].concat()).source().parts[0].faces.len(), 2);
}

#[test]
fn elements_and_properties_nobody_knows_are_passed_over() {
    let header = "element edge 2\nproperty int a\nproperty list uchar float w\nelement camera 1\nproperty double f\n\
        element vertex 3\nproperty uchar x\nproperty list int uchar junk\nproperty float y\nproperty double z\nproperty int k\n\
        element face 1\nproperty list uchar float odd\nproperty list uchar int vertex_index\nproperty uchar flag\n\
        element tail 4000000000\nproperty int t\n";
    let vertex = |x, y| vec![U8(x), I32(2), U8(7), U8(8), F32(y), F64(0.), I32(9)];
    let rows = vec![
        vec![I32(1), U8(1), F32(0.5)],
        vec![I32(1), U8(0)],
        vec![F64(1.)],
        vertex(0, 0.),
        vertex(1, 0.),
        vertex(0, 1.),
        vec![U8(1), F32(1.), U8(3), I32(0), I32(1), I32(2), U8(1)],
    ];
    for format in FORMATS {
        assert_eq!(read(&file(format, header, &rows)).source().parts[0].positions[2], dvec3(0., 1., 0.), "{format}");
    }
}

#[test]
fn faces_may_come_before_vertices() {
    let rows = [vec![face(&[0, 1, 2]), face(&[0, 2, 3])], corners()].concat();
    for format in FORMATS {
        assert_eq!(read(&file(format, &format!("{TRIANGLES}{XYZ}"), &rows)).source().parts[0].faces.len(), 2);
    }
}

#[test]
fn polygons_are_cut_and_short_ones_dropped() {
    // A dart: only the cut from its tip to its notch stays inside.
    let body = "0 0 0\n2 0.5 0\n0 1 0\n0.5 0.5 0\n4 0 1 2 3\n2 0 1\n";
    let outcome = text(&format!("{XYZ}{TRIANGLES}"), body);
    let faces = &outcome.source().parts[0].faces;
    assert!(faces.len() == 2 && faces.iter().all(|f| f.contains(&1) && f.contains(&3)), "{faces:?}");
    assert_eq!(outcome.warned("short-polygon"), 1);
}

#[test]
fn strips_alternate_and_start_again_after_minus_one() {
    let header = format!("{XYZ}element tristrips 1\nproperty list int int vertex_indices\n");
    let strip = [0, 1, 3, 2, -1, 0, 2, 3].map(I32);
    for format in FORMATS {
        let rows = [corners(), vec![[&[I32(8)][..], &strip].concat()]].concat();
        let outcome = read(&file(format, &header, &rows));
        assert_eq!(outcome.source().parts[0].faces, [[0, 1, 3], [3, 1, 2], [0, 2, 3]]);
    }
}

#[test]
fn wedge_coordinates_turn_v_down_and_go_with_their_texture() {
    let header = format!(
        "comment TextureFile t.jpg\ncomment TextureFile gone away.jpg\n{XYZ}element face 4\n\
        property list uchar float texcoord\nproperty list uchar int vertex_indices\nproperty int texnumber\n"
    );
    let body = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n\
        6 0 0 1 0 1 0.75 3 0 1 2 0\n6 0 0 1 0 1 1 3 0 1 2 1\n0 3 0 2 3 0\n4 0 0 1 0 3 0 2 3 0\n";
    let outcome = text(&header, body);
    let (source, part) = (outcome.source(), &outcome.source().parts[0]);
    assert_eq!(part.corner_uvs[0], [vec2(0., 1.), vec2(1., 1.), vec2(1., 0.25)]);
    assert_eq!(part.face_material, [0, 1, 2, 2]);
    let images: Vec<_> = source.materials.iter().map(|m| (m.name.as_str(), m.image)).collect();
    assert_eq!(images, [("t.jpg", Some(0)), ("gone away.jpg", None), ("untextured", None)]);
    assert!(matches!(&source.images[..], [ImageRef::File(path)] if path.ends_with("t.jpg")));
    assert_eq!((outcome.warned("missing-texture"), outcome.warned("bad-texcoord")), (1, 1));
}

#[test]
fn wedges_of_a_polygon_follow_its_corners() {
    let header = format!(
        "comment TextureFile t.jpg\n{XYZ}element face 1\nproperty list uchar int vertex_indices\n\
        property list uchar float texcoord\n"
    );
    let outcome = text(&header, "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 8 0 0 1 0 1 1 0 1\n");
    let part = &outcome.source().parts[0];
    for (face, uvs) in part.faces.iter().zip(&part.corner_uvs) {
        for (&vertex, uv) in face.iter().zip(uvs) {
            let position = part.positions[vertex as usize];
            assert_eq!((position.x as f32, 1. - position.y as f32), (uv.x, uv.y));
        }
    }
}

#[test]
fn vertex_coordinates_are_taken_by_any_of_their_names() {
    for names in [["s", "t"], ["u", "v"], ["texture_u", "texture_v"]] {
        let header = format!(
            "comment TextureFile t.jpg\n{XYZ}property float {}\nproperty float {}\n{TRIANGLES}",
            names[0], names[1]
        );
        let outcome = text(&header, "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 0.75\n0 1 0 0 nan\n3 0 1 2\n3 0 2 3\n");
        let uvs = &outcome.source().parts[0].corner_uvs;
        assert_eq!(uvs[0], [vec2(0., 1.), vec2(1., 1.), vec2(1., 0.25)]);
        assert_eq!((uvs[1][2], outcome.warned("bad-uv")), (vec2(0., 0.), 1));
    }
}

#[test]
fn a_texture_outside_the_folder_is_refused() {
    let header =
        |name: &str| format!("comment TextureFile {name}\n{XYZ}property float s\nproperty float t\n{TRIANGLES}");
    let body = "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 0\n0 1 0 0 0\n3 0 1 2\n3 0 2 3\n";
    text(&header("../t.jpg"), body).refused("only files inside the input's folder");
    text(&header("/etc/passwd"), body).refused("only files inside the input's folder");
}

#[test]
fn colors_are_bytes_or_floats() {
    let with = |kind: &str, color: &str| {
        let header = format!("{XYZ}property {kind} red\nproperty {kind} green\nproperty {kind} blue\n{TRIANGLES}");
        let rows = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"].map(|xyz| format!("{xyz} {color}\n")).concat();
        text(&header, &format!("{rows}3 0 1 2\n3 0 2 3\n")).source().parts[0].vertex_colors[3]
    };
    assert_eq!(with("uchar", "255 0 128"), [255, 0, 128]);
    assert_eq!(with("float", "1 -3 0.5"), [255, 0, 128]);
    assert_eq!(with("ushort", "65535 0 32896"), [255, 0, 128]);
}

#[test]
fn face_labels_are_read_whatever_their_type_and_name() {
    for property in ["int label", "uchar class", "float scalar_Label", "double scalar_my_label"] {
        let header = format!("{XYZ}{TRIANGLES}property float label_probabilities\nproperty {property}\n");
        let outcome = text(&header, "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 0.5 3\n3 0 2 3 0.5 -1\n");
        assert_eq!(outcome.source().parts[0].face_labels, [3, -1], "{property}");
    }
}

#[test]
fn vertex_labels_vote_for_the_face() {
    let header = format!("{XYZ}property uchar label\n{TRIANGLES}");
    let outcome = text(&header, "0 0 0 3\n1 0 0 2\n1 1 0 3\n0 1 0 1\n3 0 1 2\n3 1 2 3\n");
    assert_eq!(outcome.source().parts[0].face_labels, [3, 1]);
}

#[test]
fn a_position_that_is_not_finite_costs_its_faces() {
    let header = format!("{XYZ}property uchar red\nproperty uchar green\nproperty uchar blue\n{TRIANGLES}");
    let outcome = text(&header, "0 0 0 1 1 1\n1 nan 0 2 2 2\n1 1 0 3 3 3\n0 1 0 4 4 4\n3 0 1 2\n3 0 2 3\n");
    let part = &outcome.source().parts[0];
    assert_eq!((&part.faces[..], part.positions[1]), (&[[0, 1, 2]][..], dvec3(1., 1., 0.)));
    assert_eq!(part.vertex_colors, [[1; 3], [3; 3], [4; 3]]);
    assert_eq!(outcome.warned("bad-vertex"), 1);
}

#[test]
fn huge_counts_end_with_the_file_not_with_the_memory() {
    for format in FORMATS {
        let header = format!("{}{TRIANGLES}", XYZ.replace("vertex 4", "vertex 4000000000"));
        read(&file(format, &header, &corners())).refused("the file ends in element vertex");
        let header = format!("{XYZ}{}", TRIANGLES.replace("face 2", "face 18446744073709551615"));
        let rows = [corners(), vec![face(&[0, 1, 2])]].concat();
        read(&file(format, &header, &rows)).refused("the file ends in element face row 2 of 18446744073709551615");
        let header = format!("element moon 18446744073709551615\nproperty int a\n{XYZ}{TRIANGLES}");
        read(&file(format, &header, &rows)).refused("the file ends in element moon");
        let header = format!("element moon 18446744073709551615\n{XYZ}{TRIANGLES}");
        assert!(read(&file(format, &header, &[rows, vec![face(&[0, 2, 3])]].concat())).result.is_ok());
    }
    let header = format!("{}{TRIANGLES}", XYZ.replace("vertex 4", "vertex 5000000000"));
    assert!(matches!(text(&header, "").result, Err(Error::Limit { .. })));
}

#[test]
fn lists_of_impossible_length_are_refused() {
    let header = format!("{XYZ}element face 1\nproperty list int int vertex_indices\n");
    for format in FORMATS {
        let with = |length| read(&file(format, &header, &[corners(), vec![vec![I32(length), I32(0)]]].concat()));
        with(-1).refused("a list of length -1");
        assert!(with(i32::MAX).result.is_err());
    }
    text(&format!("{XYZ}element face 1\nproperty list float int vertex_indices\n"), "")
        .refused("floating-point length");
}

#[test]
fn indices_out_of_range_and_broken_numbers_name_their_line() {
    let with =
        |last: &str| text(&format!("{XYZ}{TRIANGLES}"), &format!("0 0 0\n1 0 0\n1 1 0\n\n0 1 0\n3 0 1 2\n{last}\n"));
    with("3 0 2 4").refused("line 16: element face row 2 of 2 names vertex 4");
    with("3 0 2 -1").refused("vertex -1");
    with("3 0 2 1.5").refused("vertex 1.5");
    with("3 0 2").refused("line 16: too few values for element face row 2 of 2");
    with("3 0 2 x").refused("not a number");
    with("3 0 2 1x").refused("not a number");
    with("3 0 2 1,5").refused("not a number");
    for format in &FORMATS[1..] {
        let rows = [corners(), vec![face(&[0, 1, 2]), face(&[0, 2, 9])]].concat();
        read(&file(format, &format!("{XYZ}{TRIANGLES}"), &rows)).refused("names vertex 9");
    }
}

#[test]
fn headers_without_sense_are_refused_with_their_line() {
    read(b"").refused("does not start with a line 'ply'");
    read(b"plyx\n").refused("does not start with a line 'ply'");
    read(b"ply\nformat ascii 1.0\n").refused("no 'end_header'");
    read(&[&b"ply\nformat ascii 1.0\n"[..], &b"comment x\n".repeat(200_000)].concat()).refused("no 'end_header'");
    read(b"ply\nelement vertex 1\nend_header\n").refused("no 'format' line");
    text("element vertex many\n", "").refused("line 3: element vertex has count \"many\"");
    text("property int x\n", "").refused("before any element");
    text(&format!("{XYZ}property quad w\n"), "").refused("type \"quad\"");
    text(&format!("{XYZ}{XYZ}"), "").refused("a second element");
    text(&format!("{XYZ}property int\n"), "").refused("broken property line");
    text("element face 1\nproperty list uchar int vertex_indices\n", "").refused("no element vertex");
    text(&format!("element vertex 0\nproperty int x\n{TRIANGLES}"), "").refused("lack x, y or z");
    text(&format!("{XYZ}element face 1\nproperty int a\n"), "0 0 0\n1 0 0\n1 1 0\n0 1 0\n1\n").refused("no list");
}

#[test]
fn a_point_cloud_is_refused_as_one() {
    for faces in ["", "element face 0\nproperty list uchar int vertex_indices\n"] {
        match text(&format!("{XYZ}{faces}"), "0 0 0\n1 0 0\n1 1 0\n0 1 0\n").result {
            Err(Error::Unsupported { what, .. }) => assert!(what.contains("point cloud: 4 points"), "{what}"),
            other => panic!("{other:?}"),
        }
    }
    text("element vertex 0\nproperty float x\nproperty float y\nproperty float z\n", "").refused("no triangles");
}

#[test]
fn every_truncation_and_flipped_bit_is_read_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mesh.ply");
    let read = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        read_path(&path)
    };
    let mut refused = 0;
    for format in FORMATS {
        let header = format!(
            "comment TextureFile t.jpg\n{XYZ}property uchar label\n{TRIANGLES}property list uchar float texcoord\n"
        );
        let labelled = corners().into_iter().map(|row| [row, vec![U8(1)]].concat()).collect();
        let wedges = [&[U8(6)][..], &[F32(0.5); 6]].concat();
        let faces = vec![[face(&[0, 1, 2]), wedges.clone()].concat(), [face(&[0, 2, 3]), wedges].concat()];
        let bytes = file(format, &header, &[labelled, faces].concat());
        assert!(read(&bytes).result.is_ok());
        // The text ends in "0.5 \n": cut there it is still whole.
        let whole = if format == "ascii" { bytes.len() - 4 } else { bytes.len() };
        for end in 0..whole {
            assert!(read(&bytes[..end]).result.is_err(), "{format} cut at {end}");
        }
        for at in 0..bytes.len() {
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << (at % 8);
            refused += usize::from(read(&flipped).result.is_err());
        }
    }
    assert!(refused > 100, "{refused}");
}

/// Reads every PLY file of the defect corpora; needs them unpacked below `ROOFTILE_DATA`.
#[test]
fn defect_files_are_read_or_refused() {
    let Some(data) = std::env::var_os("ROOFTILE_DATA") else {
        eprintln!("SKIPPED: ROOFTILE_DATA is not set");
        return;
    };
    let mut read = 0;
    let mut folders = vec![Path::new(&data).join("nasty")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "ply") {
                let outcome = read_path(&path);
                let codes: Vec<_> = outcome.reporter.warnings().iter().map(|w| w.code).collect();
                match outcome.result {
                    Ok(source) => {
                        let part = &source.parts[0];
                        let (vertices, faces, uvs) = (part.positions.len(), part.faces.len(), part.corner_uvs.len());
                        eprintln!("read    {}: {vertices} vertices {faces} faces {uvs} uvs {codes:?}", path.display());
                        read += 1;
                    }
                    Err(error) => eprintln!("refused {error} {codes:?}"),
                }
            }
        }
    }
    assert!(read > 0);
}

/// The counts are those of the publisher: ground 793, vegetation 460, building 720.
#[test]
fn the_labelled_tile_of_sum_has_its_labels() {
    let Some(data) = std::env::var_os("ROOFTILE_DATA") else {
        eprintln!("SKIPPED: ROOFTILE_DATA is not set");
        return;
    };
    let outcome = read_path(&Path::new(&data).join("sum-tiny/tiny_test_c.ply"));
    let (source, part) = (outcome.source(), &outcome.source().parts[0]);
    assert_eq!((part.positions.len(), part.faces.len(), part.corner_uvs.len()), (1110, 1973, 1973));
    let count = |label: i16| part.face_labels.iter().filter(|&&found| found == label).count();
    assert_eq!([count(1), count(2), count(3), part.face_labels.len()], [793, 460, 720, 1973]);
    assert_eq!((source.materials.len(), source.images.len()), (1, 1));
    assert!(part.corner_uvs.as_flattened().iter().all(|uv| (0. ..=1.).contains(&uv.x) && (0. ..=1.).contains(&uv.y)));
    assert!(outcome.reporter.warnings().is_empty(), "{:?}", outcome.reporter.warnings());
}
