//! The tileset JSON as tilers write it, 1.0 and 1.1; wire format only.
//!
//! Lengths of arrays and the presence of members are looked at where they are used, and a member of a wrong type counts
//! as missing: one bad tile does not lose the rest.

use serde::Deserialize;
use serde_json::Value;

use super::mend::{content, loose, number, numbers, text};

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Tileset {
    #[serde(deserialize_with = "loose")]
    pub asset: Option<Asset>,
    #[serde(deserialize_with = "number")]
    pub geometric_error: Option<f64>,
    pub root: Option<Tile>,
    #[serde(deserialize_with = "loose")]
    pub extensions_required: Option<Vec<String>>,
}

#[derive(Debug, Default, Clone, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Asset {
    #[serde(deserialize_with = "text")]
    pub version: Option<String>,
    #[serde(deserialize_with = "text")]
    pub generator: Option<String>,
    #[serde(deserialize_with = "text")]
    pub gltf_up_axis: Option<String>,
    pub extras: Option<Value>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Tile {
    #[serde(deserialize_with = "loose")]
    pub bounding_volume: Option<BoundingVolume>,
    #[serde(deserialize_with = "number")]
    pub geometric_error: Option<f64>,
    #[serde(deserialize_with = "text")]
    pub refine: Option<String>,
    #[serde(deserialize_with = "numbers")]
    pub transform: Option<Vec<f64>>,
    #[serde(deserialize_with = "content")]
    pub content: Option<Content>,
    #[serde(deserialize_with = "loose")]
    pub contents: Option<Vec<Content>>,
    pub children: Option<Vec<Tile>>,
    pub metadata: Option<Value>,
    #[serde(deserialize_with = "loose")]
    pub implicit_tiling: Option<Implicit>,
    #[serde(deserialize_with = "loose")]
    pub extensions: Option<TileExtensions>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct TileExtensions {
    #[serde(rename = "3DTILES_implicit_tiling")]
    #[serde(deserialize_with = "loose")]
    pub implicit_tiling: Option<Implicit>,
    #[serde(rename = "3DTILES_multiple_contents")]
    pub multiple_contents: Option<MultipleContents>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct MultipleContents {
    /// An early draft says `content`.
    #[serde(alias = "content")]
    #[serde(deserialize_with = "loose")]
    pub contents: Option<Vec<Content>>,
}

#[derive(Debug, Default, Clone, Deserialize)]
#[serde(default)]
pub struct BoundingVolume {
    #[serde(rename = "box", deserialize_with = "numbers")]
    pub oriented_box: Option<Vec<f64>>,
    #[serde(deserialize_with = "numbers")]
    pub region: Option<Vec<f64>>,
    #[serde(deserialize_with = "numbers")]
    pub sphere: Option<Vec<f64>>,
    pub extensions: Option<Value>,
}

#[derive(Debug, Default, Clone, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Content {
    #[serde(deserialize_with = "text")]
    pub uri: Option<String>,
    /// 3D Tiles before 1.0.
    pub url: Option<String>,
    #[serde(deserialize_with = "loose")]
    pub bounding_volume: Option<BoundingVolume>,
}

#[derive(Debug, Default, Clone, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Implicit {
    pub subdivision_scheme: Option<String>,
    pub subtree_levels: Option<u64>,
    pub available_levels: Option<u64>,
    /// The extension's name for `available_levels` − 1.
    pub maximum_level: Option<u64>,
    pub subtrees: Option<Content>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Subtree {
    pub buffers: Option<Vec<Buffer>>,
    pub buffer_views: Option<Vec<BufferView>>,
    pub tile_availability: Option<Availability>,
    pub content_availability: Option<OneOrMany>,
    pub child_subtree_availability: Option<Availability>,
    pub tile_metadata: Option<Value>,
    pub extensions: Option<SubtreeExtensions>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct SubtreeExtensions {
    #[serde(rename = "3DTILES_multiple_contents")]
    pub multiple_contents: Option<SubtreeContents>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct SubtreeContents {
    pub content_availability: Option<OneOrMany>,
}

#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub enum OneOrMany {
    One(Availability),
    Many(Vec<Availability>),
}

#[derive(Debug, Default, Clone, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Availability {
    /// The extension says `bufferView`.
    #[serde(alias = "bufferView")]
    pub bitstream: Option<u64>,
    pub constant: Option<u64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct Buffer {
    pub uri: Option<String>,
    pub byte_length: Option<u64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub struct BufferView {
    pub buffer: Option<u64>,
    pub byte_offset: Option<u64>,
    pub byte_length: Option<u64>,
}
