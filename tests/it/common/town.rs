//! The demo city's tileset, built once by the program for all tests, and the city it was built from.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use glam::DVec3;
use rooftile::demo::{City, CityConfig, generate};
use rooftile::geo::{Frame, Georeference};
use serde_json::Value;

use super::glb::{self, Tile};
use super::{Run, rooftile};

/// Smaller tiles than by default: three or four levels from a small city. Smaller windows and references, too: what only
/// large cities meet otherwise.
const SETTINGS: [&str; 5] = [
    "levels.leaf_faces=5000",
    "levels.tile_faces=5000",
    "levels.root_faces=3000",
    "levels.window_faces=40000",
    "levels.reference_faces=40000",
];

/// One tile of the tree with what it draws.
pub struct Node {
    pub uri: String,
    pub error_m: f64,
    /// Centre, then half sizes.
    pub middle: DVec3,
    pub half: DVec3,
    pub level: u64,
    /// Certified error of the geometry, metres, from the tile's metadata.
    pub geometry_m: f64,
    /// All of its metadata.
    pub properties: Value,
    pub parent: Option<usize>,
    pub is_leaf: bool,
    pub tile: Tile,
}

/// The demo tileset.
pub struct Town {
    pub folder: PathBuf,
    /// The run that built it, with `--json`.
    pub run: Run,
    /// Parents before children.
    pub nodes: Vec<Node>,
    /// The city's surface in the tileset's frame.
    pub positions: Vec<DVec3>,
    pub faces: Vec<[u32; 3]>,
}

/// The small city of the demo.
pub fn city() -> &'static City {
    static CITY: OnceLock<City> = OnceLock::new();
    CITY.get_or_init(|| generate(&CityConfig::default()))
}

/// The tileset; built at the first call.
pub fn town() -> &'static Town {
    static TOWN: OnceLock<Town> = OnceLock::new();
    TOWN.get_or_init(|| make("town", &[]))
}

/// The same city with roofs and façades kept; built at the first call.
pub fn flight_town() -> &'static Town {
    static TOWN: OnceLock<Town> = OnceLock::new();
    TOWN.get_or_init(|| make("flight", &["--preset", "flight"]))
}

fn make(name: &str, more: &[&str]) -> Town {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    let mut args = vec!["demo", "--json", "-q", "-o", folder.to_str().expect("a path in UTF-8")];
    SETTINGS.iter().for_each(|set| args.extend(["--set", set]));
    args.extend(more);
    let run = rooftile(args).wants(0);

    let read = |name: &str| -> Value {
        serde_json::from_slice(&std::fs::read(folder.join(name)).expect("a file")).expect("JSON")
    };
    let (tileset, build) = (read("tileset.json"), read("build.json"));
    let mut nodes = Vec::new();
    walk(&folder, &tileset["root"], None, &mut nodes);

    let anchor = vector(&build["frame"]["origin_source"]);
    let frame = Frame::of(Georeference::parse("ENU:53.5,10.0,20").expect("a place"), anchor).expect("a frame");
    let (mut positions, mut faces) = (Vec::new(), Vec::new());
    for part in &city().source.parts {
        let first = positions.len() as u32;
        positions.extend(part.positions.iter().map(|&p| frame.local_from_source(p).expect("a place")));
        faces.extend(part.faces.iter().map(|f| f.map(|v| v + first)));
    }
    Town { folder, run, nodes, positions, faces }
}

fn vector(value: &Value) -> DVec3 {
    DVec3::from_array(serde_json::from_value(value.clone()).expect("three numbers"))
}

fn walk(folder: &Path, tile: &Value, parent: Option<usize>, nodes: &mut Vec<Node>) {
    let volume: Vec<f64> = serde_json::from_value(tile["boundingVolume"]["box"].clone()).expect("a box");
    let uri = tile["content"]["uri"].as_str().expect("every tile has content").to_owned();
    let own = nodes.len();
    let properties = &tile["metadata"]["properties"];
    nodes.push(Node {
        error_m: tile["geometricError"].as_f64().expect("a number"),
        middle: DVec3::new(volume[0], volume[1], volume[2]),
        half: DVec3::new(volume[3], volume[7], volume[11]),
        level: properties["level"].as_u64().expect("a level"),
        geometry_m: properties["geometryError"].as_f64().expect("an error"),
        properties: properties.clone(),
        parent,
        is_leaf: tile["children"].as_array().is_none_or(Vec::is_empty),
        tile: glb::read(&std::fs::read(folder.join(&uri)).expect("the content is there")),
        uri,
    });
    for child in tile["children"].as_array().into_iter().flatten() {
        walk(folder, child, Some(own), nodes);
    }
}

impl Node {
    /// A number from its metadata.
    pub fn number(&self, id: &str) -> Option<f64> {
        self.properties[id].as_f64()
    }
}

impl Town {
    /// A tileset of which nothing else is known: its leaves stand for its source.
    pub fn of_leaves(folder: &Path, run: Run) -> Self {
        let json = std::fs::read(folder.join("tileset.json")).expect("a file");
        let tileset: Value = serde_json::from_slice(&json).expect("JSON");
        let mut nodes = Vec::new();
        walk(folder, &tileset["root"], None, &mut nodes);
        let mut town = Self { folder: folder.to_path_buf(), run, nodes, positions: Vec::new(), faces: Vec::new() };
        (town.positions, town.faces) = town.joined(&town.leaves(0));
        town
    }

    /// All parents of a tile.
    pub fn ancestors(&self, node: usize) -> Vec<usize> {
        std::iter::successors(self.nodes[node].parent, |&n| self.nodes[n].parent).collect()
    }

    /// The leaves below a tile; itself if it is one.
    pub fn leaves(&self, node: usize) -> Vec<usize> {
        let is_below = |mut at: usize| loop {
            if at == node {
                return true;
            }
            match self.nodes[at].parent {
                Some(parent) => at = parent,
                None => return false,
            }
        };
        (0..self.nodes.len()).filter(|&n| self.nodes[n].is_leaf && is_below(n)).collect()
    }

    /// The surfaces of several tiles as one.
    pub fn joined(&self, nodes: &[usize]) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let (mut positions, mut faces) = (Vec::new(), Vec::new());
        for &n in nodes {
            let (tile, first) = (&self.nodes[n].tile, positions.len() as u32);
            positions.extend(&tile.positions);
            faces.extend(tile.faces.iter().map(|f| f.map(|v| v + first)));
        }
        (positions, faces)
    }
}
