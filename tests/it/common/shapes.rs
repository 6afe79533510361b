//! Small inputs, written where a test wants them.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

/// A gabled house of 6 m by 8 m on a lawn of 20 m by 20 m, 22 triangles, all painted from one image.
pub const HOUSE: &str = "\
mtllib house.mtl
v -10 -10 0
v 10 -10 0
v 10 10 0
v -10 10 0
v -3 -4 0
v 3 -4 0
v 3 4 0
v -3 4 0
v -3 -4 5
v 3 -4 5
v 3 4 5
v -3 4 5
v 0 -4 8
v 0 4 8
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vt 0.5 1
usemtl paint
f 1/1 2/2 6/3 5/4
f 2/1 3/2 7/3 6/4
f 3/1 4/2 8/3 7/4
f 4/1 1/2 5/3 8/4
f 5/1 6/2 10/3 9/4
f 6/1 7/2 11/3 10/4
f 7/1 8/2 12/3 11/4
f 8/1 5/2 9/3 12/4
f 9/1 10/2 13/5
f 11/1 12/2 14/5
f 10/1 11/2 14/3 13/4
f 12/1 9/2 13/3 14/4
";

/// The material of [`HOUSE`].
pub const HOUSE_MTL: &str = "newmtl paint\nKd 1 1 1\nmap_Kd house.png\n";

/// Writes the house with its material and image; returns the path of the OBJ.
pub fn house(folder: &Path) -> PathBuf {
    fs::create_dir_all(folder).expect("a folder");
    fs::write(folder.join("house.obj"), HOUSE).expect("a file");
    fs::write(folder.join("house.mtl"), HOUSE_MTL).expect("a file");
    let pixels = image::RgbImage::from_fn(32, 32, |x, y| image::Rgb([8 * x as u8, 8 * y as u8, 120]));
    pixels.save(folder.join("house.png")).expect("an image");
    folder.join("house.obj")
}

/// Writes a hilly square of 2·n² triangles, a metre each side; returns its path.
pub fn hills(folder: &Path, n: usize) -> PathBuf {
    let mut text = String::new();
    for y in 0..=n {
        for x in 0..=n {
            let (fx, fy) = (x as f64, y as f64);
            let z = 3.0 * (fx / 9.0).sin() * (fy / 7.0).cos() + 0.3 * (fx * 1.7 + fy * 2.3).sin();
            writeln!(text, "v {x} {y} {z:.4}").expect("text");
        }
    }
    let row = n + 1;
    for y in 0..n {
        for x in 0..n {
            let a = y * row + x + 1;
            writeln!(text, "f {a} {} {} {}", a + 1, a + 1 + row, a + row).expect("text");
        }
    }
    fs::create_dir_all(folder).expect("a folder");
    let path = folder.join("hills.obj");
    fs::write(&path, text).expect("a file");
    path
}

/// The JSON of a glTF of one triangle with indices, in one buffer of 44 bytes.
pub fn triangle_gltf() -> Value {
    json!({
        "asset": { "version": "2.0" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [9, 9, 0] },
            { "bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": 36 },
            { "buffer": 0, "byteOffset": 36, "byteLength": 6 },
        ],
        "buffers": [{ "byteLength": 44 }],
    })
}

/// The bytes of the buffer of [`triangle_gltf`].
pub fn triangle_bytes(indices: [u16; 3]) -> Vec<u8> {
    let corners = [0f32, 0., 0., 9., 0., 0., 0., 9., 0.];
    let mut bytes: Vec<u8> = corners.iter().flat_map(|c| c.to_le_bytes()).collect();
    bytes.extend(indices.iter().flat_map(|i| i.to_le_bytes()));
    bytes.resize(44, 0);
    bytes
}

/// A GLB of a JSON and a binary chunk.
pub fn glb(json: &Value, bin: &[u8]) -> Vec<u8> {
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut bytes = b"glTF\x02\0\0\0".to_vec();
    bytes.extend((28 + text.len() as u32 + bin.len() as u32).to_le_bytes());
    bytes.extend((text.len() as u32).to_le_bytes());
    bytes.extend(b"JSON");
    bytes.extend(text);
    bytes.extend((bin.len() as u32).to_le_bytes());
    bytes.extend(b"BIN\0");
    bytes.extend(bin);
    bytes
}
