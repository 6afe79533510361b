//! tileset.json of 3D Tiles 1.0 and 1.1, explicit tiling.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::metadata::{Entity, Schema, Statistics};

/// The file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Tileset {
    /// Who wrote it.
    pub asset: Asset,
    /// Legacy ranges of per-feature properties.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub properties: BTreeMap<String, Range>,
    /// Classes of `metadata`, here and in the tiles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub schema: Option<Schema>,
    /// Counts over the metadata.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub statistics: Option<Statistics>,
    /// Values for the whole tileset.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metadata: Option<Entity>,
    /// Error in metres if nothing is drawn.
    pub geometric_error: f64,
    /// The coarsest tile.
    pub root: Tile,
    /// Names of extensions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub extensions_used: Vec<String>,
    /// Names of extensions one cannot do without.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub extensions_required: Vec<String>,
    /// Anything.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub extras: Option<Value>,
}

/// Version and origin of a tileset.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Asset {
    /// `1.0` or `1.1`.
    pub version: String,
    /// Version of the data.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tileset_version: Option<String>,
    /// Program and version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub generator: Option<String>,
    /// Credit to show.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub copyright: Option<String>,
}

/// Legacy range of a property.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Range {
    /// Largest value.
    pub maximum: f64,
    /// Smallest value.
    pub minimum: f64,
}

/// A tile and what refines it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Tile {
    /// Holds the content of the tile and of all below.
    pub bounding_volume: BoundingVolume,
    /// Error in metres if this tile is drawn and its children are not.
    pub geometric_error: f64,
    /// `REPLACE` or `ADD`; inherited where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refine: Option<String>,
    /// From the tile's to its parent's frame, by columns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transform: Option<[f64; 16]>,
    /// What to draw.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub content: Option<Content>,
    /// What to draw, if several. We do not write it: viewers draw nothing.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub contents: Vec<Content>,
    /// Values for this tile.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metadata: Option<Entity>,
    /// Read only, to say that it is not followed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub implicit_tiling: Option<Value>,
    /// Finer tiles.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub children: Vec<Tile>,
    /// Anything.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub extras: Option<Value>,
}

/// One of three shapes; we write boxes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct BoundingVolume {
    /// Centre and three half axes.
    #[serde(rename = "box", default, skip_serializing_if = "Option::is_none")]
    pub oriented_box: Option<[f64; 12]>,
    /// West, south, east, north in radians, lowest and highest in metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub region: Option<[f64; 6]>,
    /// Centre and radius.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sphere: Option<[f64; 4]>,
}

/// A file to draw.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Content {
    /// Relative to tileset.json.
    pub uri: String,
    /// Tighter than the tile's.
    #[serde(rename = "boundingVolume", default, skip_serializing_if = "Option::is_none")]
    pub bounding_volume: Option<BoundingVolume>,
    /// Values for this content.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metadata: Option<Entity>,
}
