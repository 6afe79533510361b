//! The part of glTF 2.0 that we write and read back.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::metadata::Schema;

/// Component type of bytes.
pub const UNSIGNED_BYTE: u32 = 5121;
/// Component type of signed bytes.
pub const BYTE: u32 = 5120;
/// Component type of i16.
pub const SHORT: u32 = 5122;
/// Component type of u16.
pub const UNSIGNED_SHORT: u32 = 5123;
/// Component type of u32.
pub const UNSIGNED_INT: u32 = 5125;
/// Component type of f32.
pub const FLOAT: u32 = 5126;
/// Target of vertex attributes.
pub const ARRAY_BUFFER: u32 = 34962;
/// Target of indices.
pub const ELEMENT_ARRAY_BUFFER: u32 = 34963;
/// Primitive mode of triangle lists.
pub const TRIANGLES: u32 = 4;

/// The JSON chunk.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Gltf {
    /// Version and origin.
    pub asset: Asset,
    /// The scene to show.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene: Option<u32>,
    /// Lists of root nodes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub scenes: Vec<Scene>,
    /// A forest.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<Node>,
    /// Referenced by nodes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub meshes: Vec<Mesh>,
    /// Referenced by primitives.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub materials: Vec<Material>,
    /// Referenced by materials.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub textures: Vec<Texture>,
    /// Referenced by textures.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub images: Vec<Image>,
    /// Referenced by textures.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub samplers: Vec<Sampler>,
    /// Typed views.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub accessors: Vec<Accessor>,
    /// Slices of buffers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub buffer_views: Vec<BufferView>,
    /// Bytes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub buffers: Vec<Buffer>,
    /// What the features mean.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub extensions: Option<RootExtensions>,
    /// Names.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub extensions_used: Vec<String>,
    /// Names of those one cannot do without.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub extensions_required: Vec<String>,
}

/// Version and origin of a glTF.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Asset {
    /// `2.0`.
    pub version: String,
    /// Program and version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub generator: Option<String>,
    /// Credit to show.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub copyright: Option<String>,
}

/// Root nodes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// Node indices.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<u32>,
}

/// A placed mesh.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Node {
    /// Mesh index.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mesh: Option<u32>,
    /// By columns; instead of the three below.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub matrix: Option<[f64; 16]>,
    /// Metres, y up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub translation: Option<[f64; 3]>,
    /// Quaternion x, y, z, w.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation: Option<[f64; 4]>,
    /// Factor per axis.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<[f64; 3]>,
    /// Node indices.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub children: Vec<u32>,
}

/// Primitives drawn together.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Mesh {
    /// One draw call each.
    pub primitives: Vec<Primitive>,
}

/// One draw call.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Primitive {
    /// Accessor by semantic.
    pub attributes: BTreeMap<String, u32>,
    /// Accessor of indices.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub indices: Option<u32>,
    /// Material index.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub material: Option<u32>,
    /// Absent means triangles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mode: Option<u32>,
    /// Feature ids.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub extensions: Option<PrimitiveExtensions>,
}

/// Extensions of a primitive.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PrimitiveExtensions {
    /// Feature ids.
    #[serde(rename = "EXT_mesh_features", default, skip_serializing_if = "Option::is_none")]
    pub mesh_features: Option<MeshFeatures>,
}

/// `EXT_mesh_features`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MeshFeatures {
    /// Sets of ids.
    #[serde(rename = "featureIds")]
    pub feature_ids: Vec<FeatureIds>,
}

/// A set of feature ids.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct FeatureIds {
    /// Ids are below this.
    pub feature_count: u32,
    /// `_FEATURE_ID_n`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attribute: Option<u32>,
    /// Name of the set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub label: Option<String>,
    /// Id i is row i of this table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub property_table: Option<u32>,
}

/// Extensions of the root.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RootExtensions {
    /// Tables of features.
    #[serde(rename = "EXT_structural_metadata", default, skip_serializing_if = "Option::is_none")]
    pub structural_metadata: Option<StructuralMetadata>,
}

/// `EXT_structural_metadata`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct StructuralMetadata {
    /// Classes and enums.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub schema: Option<Schema>,
    /// One row per feature.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub property_tables: Vec<PropertyTable>,
}

/// Values by column.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct PropertyTable {
    /// For people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Class in the schema.
    pub class: String,
    /// Number of rows.
    pub count: u32,
    /// By property id.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub properties: BTreeMap<String, Column>,
}

/// One column of a [`PropertyTable`].
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Column {
    /// Buffer view of the values.
    pub values: u32,
    /// Buffer view of string offsets.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub string_offsets: Option<u32>,
    /// Absent means `UINT32`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub string_offset_type: Option<String>,
}

/// How a primitive is painted.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Material {
    /// For people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Colour.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pbr_metallic_roughness: Option<Pbr>,
    /// Back faces are drawn.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub double_sided: bool,
    /// `KHR_materials_unlit` and others.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub extensions: BTreeMap<String, Value>,
}

/// Colour of a material.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Pbr {
    /// Linear RGBA; absent means white.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub base_color_factor: Option<[f64; 4]>,
    /// sRGB.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub base_color_texture: Option<TextureInfo>,
    /// Absent means 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metallic_factor: Option<f64>,
    /// Absent means 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub roughness_factor: Option<f64>,
}

/// A use of a texture.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TextureInfo {
    /// Texture index.
    pub index: u32,
}

/// An image with a sampler.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Texture {
    /// Sampler index.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampler: Option<u32>,
    /// Image index.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<u32>,
}

/// Encoded pixels.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Image {
    /// `image/jpeg`, …
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mime_type: Option<String>,
    /// View of the bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub buffer_view: Option<u32>,
    /// Outside the file; we write none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uri: Option<String>,
}

/// Filters and wrapping, as OpenGL numbers.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Sampler {
    /// 9729 linear.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mag_filter: Option<u32>,
    /// 9987 linear in all three.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_filter: Option<u32>,
    /// 33071 clamp to edge.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wrap_s: Option<u32>,
    /// 33071 clamp to edge.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wrap_t: Option<u32>,
}

/// A typed view of a buffer view.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Accessor {
    /// View of the bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub buffer_view: Option<u32>,
    /// Into the view.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub byte_offset: Option<u64>,
    /// One of the constants above.
    pub component_type: u32,
    /// Integers stand for 0 to 1 (or -1 to 1).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub normalized: bool,
    /// Elements.
    pub count: u64,
    /// `SCALAR`, `VEC2`, …
    #[serde(rename = "type")]
    pub kind: String,
    /// As stored, before normalisation.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub min: Vec<f64>,
    /// As stored, before normalisation.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub max: Vec<f64>,
    /// Read only, to say that it is not followed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sparse: Option<Value>,
}

/// A slice of a buffer.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct BufferView {
    /// Buffer index.
    pub buffer: u32,
    /// Into the buffer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub byte_offset: Option<u64>,
    /// Bytes.
    pub byte_length: u64,
    /// From element to element; absent means packed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub byte_stride: Option<u64>,
    /// Vertex attributes or indices.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target: Option<u32>,
    /// Compression.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub extensions: Option<BufferViewExtensions>,
}

/// Extensions of a buffer view.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct BufferViewExtensions {
    /// Where the compressed bytes are.
    #[serde(
        rename = "EXT_meshopt_compression",
        alias = "KHR_meshopt_compression",
        default,
        skip_serializing_if = "Option::is_none"
    )]
    pub meshopt: Option<Meshopt>,
}

/// `EXT_meshopt_compression` of a buffer view.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Meshopt {
    /// Buffer index.
    pub buffer: u32,
    /// Into the buffer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub byte_offset: Option<u64>,
    /// Compressed bytes.
    pub byte_length: u64,
    /// Bytes of one decoded element.
    pub byte_stride: u64,
    /// Elements.
    pub count: u64,
    /// `ATTRIBUTES`, `TRIANGLES` or `INDICES`.
    pub mode: String,
    /// Absent means `NONE`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub filter: Option<String>,
}

/// Bytes; the first buffer of a GLB has no `uri` and is the BIN chunk.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Buffer {
    /// Bytes.
    pub byte_length: u64,
    /// Outside the file; we write none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uri: Option<String>,
    /// Compression.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub extensions: Option<BufferExtensions>,
}

/// Extensions of a buffer.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct BufferExtensions {
    /// Marks a buffer that exists only after decompression.
    #[serde(
        rename = "EXT_meshopt_compression",
        alias = "KHR_meshopt_compression",
        default,
        skip_serializing_if = "Option::is_none"
    )]
    pub meshopt: Option<MeshoptFallback>,
}

/// `EXT_meshopt_compression` of a buffer.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct MeshoptFallback {
    /// Always true where it stands.
    #[serde(default)]
    pub fallback: bool,
}
