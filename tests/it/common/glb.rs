//! A reader of uncompressed tiles of the tests' own: it shares nothing with the program's writer or reader.

use glam::DVec3;
use serde_json::Value;

/// A tile as it is drawn.
pub struct Tile {
    /// In the tileset's frame: z up, metres.
    pub positions: Vec<DVec3>,
    /// The surface.
    pub faces: Vec<[u32; 3]>,
    /// What hides gaps and is no part of the surface.
    pub skirts: Vec<[u32; 3]>,
    /// Per vertex.
    pub feature_ids: Vec<u32>,
    /// Draw calls.
    pub primitives: usize,
    pub json: Value,
}

/// Takes a tile apart; panics at whatever is not as this program writes it.
pub fn read(bytes: &[u8]) -> Tile {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes")) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let (json_end, bin_at) = (20 + word(12), 28 + word(12));
    assert_eq!((&bytes[16..20], &bytes[json_end + 4..bin_at]), (&b"JSON"[..], &b"BIN\0"[..]));
    let json: Value = serde_json::from_slice(&bytes[20..json_end]).expect("JSON");
    let bin = &bytes[bin_at..bin_at + word(json_end)];

    let node = &json["nodes"][0];
    let shift: Vec<f64> = serde_json::from_value(node["translation"].clone()).expect("three numbers");
    let (mut positions, mut faces, mut feature_ids) = (Vec::new(), Vec::new(), Vec::new());
    let primitives = json["meshes"][0]["primitives"].as_array().expect("primitives");
    for (p, primitive) in primitives.iter().enumerate() {
        // Primitives of one mesh share their vertices.
        if p == 0 {
            let attributes = &primitive["attributes"];
            let at = |f: &[u8], axis: usize| f64::from(f32::from_le_bytes(f[4 * axis..][..4].try_into().expect("f32")));
            positions = elements(&json, bin, &attributes["POSITION"], (5126, 12), |f| {
                // glTF is y up: north is -z.
                DVec3::new(at(f, 0) + shift[0], -(at(f, 2) + shift[2]), at(f, 1) + shift[1])
            });
            feature_ids = elements(&json, bin, &attributes["_FEATURE_ID_0"], (5121, 1), |f| u32::from(f[0]));
        }
        let accessor = &json["accessors"][index(&primitive["indices"])];
        let corners: Vec<u32> = match index(&accessor["componentType"]) {
            5123 => elements(&json, bin, &primitive["indices"], (5123, 2), |f| u32::from(f[0]) | u32::from(f[1]) << 8),
            _ => elements(&json, bin, &primitive["indices"], (5125, 4), |f| {
                u32::from_le_bytes(f.try_into().expect("u32"))
            }),
        };
        faces.extend(corners.chunks_exact(3).map(|c| [c[0], c[1], c[2]]));
    }
    let primitives = primitives.len();
    // The city has four classes; rows after these are skirts of the same classes.
    let (skirts, faces) = faces.into_iter().partition(|f: &[u32; 3]| feature_ids[f[0] as usize] >= 4);
    Tile { positions, faces, skirts, feature_ids, primitives, json }
}

fn index(value: &Value) -> usize {
    value.as_u64().expect("an index") as usize
}

fn elements<T>(
    json: &Value,
    bin: &[u8],
    accessor: &Value,
    (kind, size): (usize, usize),
    of: impl Fn(&[u8]) -> T,
) -> Vec<T> {
    let accessor = &json["accessors"][index(accessor)];
    assert_eq!(index(&accessor["componentType"]), kind);
    let view = &json["bufferViews"][index(&accessor["bufferView"])];
    let or_0 = |value: &Value| value.as_u64().unwrap_or(0) as usize;
    let stride = view["byteStride"].as_u64().map_or(size, |s| s as usize);
    let from = or_0(&view["byteOffset"]) + or_0(&accessor["byteOffset"]);
    (0..index(&accessor["count"])).map(|i| of(&bin[from + i * stride..][..size])).collect()
}

impl Tile {
    /// The corners of a face.
    pub fn corners(&self, face: usize) -> [DVec3; 3] {
        self.faces[face].map(|v| self.positions[v as usize])
    }
}

/// Area of a triangle, m².
pub fn area_m2([a, b, c]: [DVec3; 3]) -> f64 {
    (b - a).cross(c - a).length() * 0.5
}
