//! Writes a tile as a GLB that CesiumJS and 3DTilesRendererJS draw in one call.
//!
//! In: [`TileContent`], the scheme, [`GlbOptions`]. Out: bytes.
//!
//! # Method
//! 1. Order faces for the vertex cache, vertices by first use.
//! 2. Turn z up into y up, (x, y, z) to (x, z, -y), for vertices and for the node's translation.
//! 3. Lay out one buffer view per attribute; compress each if asked.
//! 4. Name the class of every vertex: `_FEATURE_ID_0` is the row of a property table, the row is the class. Skirts have
//!    rows of their own, in the same order after the others, with the same class and `skirt` 1: they can be left out.
//!
//! # Promises
//! The same content gives the same bytes. glTF-Validator finds no errors. Property table values and all other views
//! start at multiples of 8 bytes, as `EXT_structural_metadata` asks.
//!
//! # Why not …
//! Normalised u16 positions: plain integers with the step as the node's scale are exact in f64 and as well supported.
//! Vertex codec version 1: `EXT_meshopt_compression` is version 0, readers refuse others.

use std::collections::BTreeMap;

use glam::{DVec3, Vec3};

use super::GENERATOR;
use super::content::{Grid, Order, TileContent, order};
use crate::ids::ClassScheme;
use crate::schema::gltf::*;
use crate::schema::metadata::{Class, Enum, EnumValue, Property, Schema};

/// How a GLB is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GlbOptions {
    /// 16-bit vertices (`KHR_mesh_quantization`) and `EXT_meshopt_compression`, both required of the reader.
    /// Default: false.
    pub compress: bool,
    /// A primitive and a material per class, named by it, instead of one draw call. Default: false.
    pub primitives_per_class: bool,
}

/// Name of the feature id set. CesiumJS makes it an identifier in a shader, where `class` is a reserved word: the
/// shader does not compile and nothing is drawn.
const FEATURE_LABEL: &str = "surface";

const MESHOPT: &str = "EXT_meshopt_compression";
const UNLIT: &str = "KHR_materials_unlit";

/// Writes `content` as a GLB.
///
/// # Panics
/// If [`TileContent::check`] refuses the content: behind the gate that is a bug.
pub fn glb(content: &TileContent, scheme: &ClassScheme, options: &GlbOptions) -> Vec<u8> {
    if let Err(what) = content.check(scheme) {
        panic!("broken tile content: {what}");
    }
    let order = order(content, options.primitives_per_class);
    let mut writer = Writer::new(options.compress, content.copyright.clone());
    let attributes = writer.attributes(content, &order, scheme);
    let rows = if content.skirt_vertices > 0 { 2 * scheme.len() } else { scheme.len() };
    writer.primitives(&order, attributes, rows, options);
    writer.materials(content, &order, scheme, options);
    writer.classes(scheme, rows);
    writer.finish()
}

struct Writer {
    compress: bool,
    gltf: Gltf,
    bin: Vec<u8>,
    /// Bytes of the buffer that exists only after decompression.
    fallback_bytes: u64,
}

/// glTF is y up.
fn y_up(p: DVec3) -> DVec3 {
    DVec3::new(p.x + 0.0, p.z + 0.0, 0.0 - p.y)
}

impl Writer {
    fn new(compress: bool, copyright: Option<String>) -> Self {
        let asset = Asset { version: "2.0".into(), generator: Some(GENERATOR.into()), copyright };
        let scenes = vec![Scene { nodes: vec![0] }];
        let mut gltf = Gltf { asset, scene: Some(0), scenes, ..Default::default() };
        gltf.extensions_used = vec!["EXT_mesh_features".into(), "EXT_structural_metadata".into()];
        if compress {
            gltf.extensions_required = vec![MESHOPT.into(), "KHR_mesh_quantization".into()];
            gltf.extensions_used.extend(gltf.extensions_required.clone());
        }
        Self { compress, gltf, bin: Vec::new(), fallback_bytes: 0 }
    }

    /// Appends bytes at a multiple of 8.
    fn append(&mut self, bytes: &[u8]) -> u64 {
        self.bin.resize(self.bin.len().next_multiple_of(8), 0);
        let at = self.bin.len() as u64;
        self.bin.extend_from_slice(bytes);
        at
    }

    fn view(&mut self, view: BufferView) -> u32 {
        self.gltf.buffer_views.push(view);
        self.gltf.buffer_views.len() as u32 - 1
    }

    /// A view that is never compressed: images and tables.
    fn plain(&mut self, bytes: &[u8]) -> u32 {
        let byte_offset = Some(self.append(bytes));
        self.view(BufferView { byte_offset, byte_length: bytes.len() as u64, ..Default::default() })
    }

    /// A view of vertices or indices; `coded` are its compressed bytes.
    fn geometry(&mut self, bytes: &[u8], stride: u64, target: u32, coded: Option<Vec<u8>>) -> u32 {
        let byte_length = bytes.len() as u64;
        let byte_stride = (target == ARRAY_BUFFER).then_some(stride);
        let target = Some(target);
        let Some(coded) = coded else {
            let byte_offset = Some(self.append(bytes));
            return self.view(BufferView { byte_offset, byte_length, byte_stride, target, ..Default::default() });
        };
        let mode = if byte_stride.is_some() { "ATTRIBUTES" } else { "TRIANGLES" };
        let meshopt = Meshopt {
            buffer: 0,
            byte_offset: Some(self.append(&coded)),
            byte_length: coded.len() as u64,
            byte_stride: stride,
            count: byte_length / stride,
            mode: mode.into(),
            filter: None,
        };
        let byte_offset = self.fallback_bytes.next_multiple_of(8);
        self.fallback_bytes = byte_offset + byte_length;
        let extensions = Some(BufferViewExtensions { meshopt: Some(meshopt) });
        let byte_offset = Some(byte_offset);
        self.view(BufferView { buffer: 1, byte_offset, byte_length, byte_stride, target, extensions })
    }

    fn accessor(&mut self, accessor: Accessor) -> u32 {
        self.gltf.accessors.push(accessor);
        self.gltf.accessors.len() as u32 - 1
    }

    /// A vertex attribute of rows of `N` bytes, `N` a multiple of 4.
    fn attribute<const N: usize>(&mut self, rows: &[[u8; N]], kind: &str, component_type: u32) -> Accessor {
        let coded = self.compress.then(|| {
            // 2 is the codec's default level; 0 the format version that the extension fixes.
            meshopt::encode_vertex_buffer_level(rows, 2, Some(0)).expect("vertices in memory can be encoded")
        });
        let view = self.geometry(rows.as_flattened(), N as u64, ARRAY_BUFFER, coded);
        Accessor {
            buffer_view: Some(view),
            component_type,
            count: rows.len() as u64,
            kind: kind.into(),
            ..Default::default()
        }
    }

    /// Writes all attributes and the node that places them.
    fn attributes(&mut self, content: &TileContent, order: &Order, scheme: &ClassScheme) -> BTreeMap<String, u32> {
        let mut attributes = BTreeMap::new();
        let of = |v: &u32| *v as usize;
        let position = self.positions(content, order);
        attributes.insert("POSITION".into(), self.accessor(position));
        if !content.uvs.is_empty() {
            let uvs: Vec<[f32; 2]> = order.vertices.iter().map(|v| content.uvs[of(v)].to_array()).collect();
            let accessor = self.uvs(&uvs);
            attributes.insert("TEXCOORD_0".into(), self.accessor(accessor));
        }
        if !content.normals.is_empty() {
            let normals: Vec<Vec3> = order.vertices.iter().map(|v| content.normals[of(v)]).collect();
            let accessor = self.normals(&normals);
            attributes.insert("NORMAL".into(), self.accessor(accessor));
        }
        if !content.colors.is_empty() {
            let linear = linear_of_srgb();
            let row = |v: &u32| {
                let [r, g, b] = content.colors[of(v)].map(|c| linear[usize::from(c)]);
                rows_u16([r, g, b, u16::MAX])
            };
            let rows: Vec<[u8; 8]> = order.vertices.iter().map(row).collect();
            let accessor = Accessor { normalized: true, ..self.attribute(&rows, "VEC4", UNSIGNED_SHORT) };
            attributes.insert("COLOR_0".into(), self.accessor(accessor));
        }
        // One byte in rows of four: attributes start at multiples of 4.
        let skirts_from = scheme.len() as u8;
        let row = |v: &u32| {
            let class = content.class_of_vertex[of(v)].0;
            [if content.is_skirt(*v) { skirts_from + class } else { class }, 0, 0, 0]
        };
        let rows: Vec<[u8; 4]> = order.vertices.iter().map(row).collect();
        let accessor = self.attribute(&rows, "SCALAR", UNSIGNED_BYTE);
        attributes.insert("_FEATURE_ID_0".into(), self.accessor(accessor));
        attributes
    }

    fn positions(&mut self, content: &TileContent, order: &Order) -> Accessor {
        let mut node = Node { mesh: Some(0), ..Default::default() };
        let old = order.vertices.iter().map(|&v| content.positions[v as usize]);
        let mut accessor;
        if self.compress {
            let grid = Grid::of(content);
            // North becomes -z: z counts down from the grid's northern edge so that steps stay positive.
            let northern = grid.corner() + DVec3::Y * (f64::from(u16::MAX) * grid.step_m);
            node.translation = Some(y_up(northern).to_array());
            node.scale = Some([grid.step_m; 3]);
            let steps: Vec<[u16; 3]> = old
                .map(|p| {
                    let [x, y, z] = grid.steps(content, p);
                    [x, z, u16::MAX - y]
                })
                .collect();
            let rows: Vec<[u8; 8]> = steps.iter().map(|&[x, y, z]| rows_u16([x, y, z, 0])).collect();
            accessor = self.attribute(&rows, "VEC3", UNSIGNED_SHORT);
            (accessor.min, accessor.max) = bounds(steps.iter().map(|s| s.map(f64::from)));
        } else {
            node.translation = Some(y_up(content.origin).to_array());
            // Adding 0 makes -0 a 0: which of the two is the minimum is left open by IEEE 754.
            let turned: Vec<[f32; 3]> = old.map(|p| [p.x + 0.0, p.z + 0.0, 0.0 - p.y]).collect();
            let rows: Vec<[u8; 12]> = turned.iter().map(|&p| rows_f32(p)).collect();
            accessor = self.attribute(&rows, "VEC3", FLOAT);
            (accessor.min, accessor.max) = bounds(turned.iter().map(|p| p.map(f64::from)));
        }
        self.gltf.nodes = vec![node];
        accessor
    }

    fn uvs(&mut self, uvs: &[[f32; 2]]) -> Accessor {
        let inside = uvs.iter().flatten().all(|c| (0.0..=1.0).contains(c));
        if self.compress && inside {
            let unit = |c: f32| (f64::from(c) * 65535.0).round() as u16;
            let rows: Vec<[u8; 4]> = uvs.iter().map(|uv| rows_u16(uv.map(unit))).collect();
            return Accessor { normalized: true, ..self.attribute(&rows, "VEC2", UNSIGNED_SHORT) };
        }
        let rows: Vec<[u8; 8]> = uvs.iter().map(|&uv| rows_f32(uv)).collect();
        self.attribute(&rows, "VEC2", FLOAT)
    }

    fn normals(&mut self, normals: &[Vec3]) -> Accessor {
        let turned = normals.iter().map(|n| {
            let n = n.normalize_or(Vec3::Z);
            [n.x, n.z, -n.y]
        });
        if self.compress {
            let byte = |c: f32| ((c * 127.0).round() as i8) as u8;
            let rows: Vec<[u8; 4]> = turned.map(|[x, y, z]| [byte(x), byte(y), byte(z), 0]).collect();
            return Accessor { normalized: true, ..self.attribute(&rows, "VEC3", BYTE) };
        }
        let rows: Vec<[u8; 12]> = turned.map(rows_f32).collect();
        self.attribute(&rows, "VEC3", FLOAT)
    }

    /// One primitive per range of indices; all share the vertices.
    fn primitives(&mut self, order: &Order, attributes: BTreeMap<String, u32>, rows: usize, options: &GlbOptions) {
        // 65535 itself would restart the strip on some machines.
        let narrow = order.vertices.len() <= usize::from(u16::MAX);
        let mut primitives = Vec::new();
        for (range, (_, indices)) in order.ranges.iter().enumerate() {
            let (bytes, stride, component_type): (Vec<u8>, u64, u32) = if narrow {
                (indices.iter().flat_map(|&i| (i as u16).to_le_bytes()).collect(), 2, UNSIGNED_SHORT)
            } else {
                (indices.iter().flat_map(|i| i.to_le_bytes()).collect(), 4, UNSIGNED_INT)
            };
            let coded = self.compress.then(|| {
                meshopt::encode_index_buffer(indices, order.vertices.len()).expect("indices in memory can be encoded")
            });
            let view = self.geometry(&bytes, stride, ELEMENT_ARRAY_BUFFER, coded);
            let indices = self.accessor(Accessor {
                buffer_view: Some(view),
                component_type,
                count: indices.len() as u64,
                kind: "SCALAR".into(),
                ..Default::default()
            });
            let features = FeatureIds {
                feature_count: rows as u32,
                attribute: Some(0),
                label: Some(FEATURE_LABEL.into()),
                property_table: Some(0),
            };
            let features = MeshFeatures { feature_ids: vec![features] };
            primitives.push(Primitive {
                attributes: attributes.clone(),
                indices: Some(indices),
                material: Some(if options.primitives_per_class { range as u32 } else { 0 }),
                mode: Some(TRIANGLES),
                extensions: Some(PrimitiveExtensions { mesh_features: Some(features) }),
            });
        }
        self.gltf.meshes = vec![Mesh { primitives }];
    }

    /// One material, or one per class. Photos are shown as they are, unlit; a bare mesh is grey and lit.
    fn materials(&mut self, content: &TileContent, order: &Order, scheme: &ClassScheme, options: &GlbOptions) {
        let mut pbr = Pbr { metallic_factor: Some(0.0), roughness_factor: Some(1.0), ..Default::default() };
        if let Some(bytes) = &content.atlas {
            let png = bytes.starts_with(b"\x89PNG");
            let mime_type = Some(if png { "image/png" } else { "image/jpeg" }.into());
            let view = self.plain(bytes);
            self.gltf.images = vec![Image { mime_type, buffer_view: Some(view), uri: None }];
            // Linear in all three directions, clamped to the edge: an atlas must not bleed around its border.
            self.gltf.samplers = vec![Sampler {
                mag_filter: Some(9729),
                min_filter: Some(9987),
                wrap_s: Some(33071),
                wrap_t: Some(33071),
            }];
            self.gltf.textures = vec![Texture { sampler: Some(0), source: Some(0) }];
            pbr.base_color_texture = Some(TextureInfo { index: 0 });
        }
        let mut extensions = BTreeMap::new();
        if content.atlas.is_some() || !content.colors.is_empty() {
            extensions.insert(UNLIT.to_string(), serde_json::json!({}));
            self.gltf.extensions_used.push(UNLIT.into());
        } else {
            pbr.base_color_factor = Some([0.6, 0.6, 0.6, 1.0]);
        }
        // Photogrammetry has open surfaces: eaves, trees and the borders of a scan are seen from both sides.
        let material = |name: Option<String>| Material {
            name,
            pbr_metallic_roughness: Some(pbr.clone()),
            double_sided: true,
            extensions: extensions.clone(),
        };
        self.gltf.materials = if options.primitives_per_class {
            order.ranges.iter().map(|(class, _)| material(Some(scheme[*class].name.clone()))).collect()
        } else {
            vec![material(None)]
        };
    }

    /// The property table: row i is class i, with its enum value and its name; then the same for skirts.
    fn classes(&mut self, scheme: &ClassScheme, rows: usize) {
        let all = || scheme.0.iter().cycle().take(rows);
        let ids: Vec<u8> = (0..rows).map(|row| (row % scheme.len()) as u8).collect();
        let skirts: Vec<u8> = (0..rows).map(|row| u8::from(row >= scheme.len())).collect();
        let names: String = all().map(|c| c.name.as_str()).collect();
        let mut ends = vec![0u32];
        for class in all() {
            ends.push(ends[ends.len() - 1] + class.name.len() as u32);
        }
        let offsets: Vec<u8> = ends.iter().flat_map(|o| o.to_le_bytes()).collect();
        let column = |values, string_offsets: Option<u32>| Column {
            values,
            string_offsets,
            string_offset_type: string_offsets.map(|_| "UINT32".into()),
        };
        let mut properties = BTreeMap::from([("class".to_string(), column(self.plain(&ids), None))]);
        properties.insert("skirt".into(), column(self.plain(&skirts), None));
        let (names, offsets) = (self.plain(names.as_bytes()), self.plain(&offsets));
        properties.insert("name".into(), column(names, Some(offsets)));
        let table =
            PropertyTable { name: Some("classes".into()), class: "feature".into(), count: rows as u32, properties };
        let metadata = StructuralMetadata { schema: Some(feature_schema(scheme)), property_tables: vec![table] };
        self.gltf.extensions = Some(RootExtensions { structural_metadata: Some(metadata) });
    }

    fn finish(mut self) -> Vec<u8> {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        self.gltf.buffers = vec![Buffer { byte_length: self.bin.len() as u64, ..Default::default() }];
        if self.compress {
            let extensions = Some(BufferExtensions { meshopt: Some(MeshoptFallback { fallback: true }) });
            self.gltf.buffers.push(Buffer { byte_length: self.fallback_bytes, uri: None, extensions });
        }
        self.gltf.extensions_used.sort_unstable();
        let mut json = serde_json::to_vec(&self.gltf).expect("glTF structs can be written as JSON");
        // To 8 rather than 4, so that the BIN chunk's views are at multiples of 8 in the file too.
        json.resize((json.len() + 28).next_multiple_of(8) - 28, b' ');
        let length = 12 + 8 + json.len() + 8 + self.bin.len();
        let mut out = Vec::with_capacity(length);
        out.extend_from_slice(b"glTF");
        for word in [2, length as u32, json.len() as u32] {
            out.extend_from_slice(&word.to_le_bytes());
        }
        out.extend_from_slice(b"JSON");
        out.extend_from_slice(&json);
        out.extend_from_slice(&(self.bin.len() as u32).to_le_bytes());
        out.extend_from_slice(b"BIN\0");
        out.extend_from_slice(&self.bin);
        out
    }
}

/// The scheme as an enum of the 3D Metadata schema.
pub(super) fn surface_class(scheme: &ClassScheme) -> Enum {
    let values = scheme.ids().map(|id| EnumValue { name: scheme[id].name.clone(), value: i64::from(id.0) }).collect();
    Enum { description: Some("What a surface is part of".into()), value_type: Some("UINT8".into()), values }
}

fn feature_schema(scheme: &ClassScheme) -> Schema {
    let class = Property {
        description: Some("Class of the surface".into()),
        kind: "ENUM".into(),
        enum_type: Some("surfaceClass".into()),
        required: true,
        ..Default::default()
    };
    let name = Property {
        description: Some("Name of the class".into()),
        kind: "STRING".into(),
        required: true,
        ..Default::default()
    };
    let skirt = Property {
        description: Some("1: hides gaps between tiles and is no part of the surface; 0: surface".into()),
        kind: "SCALAR".into(),
        component_type: Some("UINT8".into()),
        required: true,
        ..Default::default()
    };
    let properties = BTreeMap::from([("class".into(), class), ("name".into(), name), ("skirt".into(), skirt)]);
    Schema {
        id: "rooftile_features".into(),
        description: None,
        enums: BTreeMap::from([("surfaceClass".into(), surface_class(scheme))]),
        classes: BTreeMap::from([("feature".into(), Class { description: None, properties })]),
    }
}

/// `COLOR_0` is linear; 16 bits keep the darks apart.
fn linear_of_srgb() -> [u16; 256] {
    std::array::from_fn(|c| {
        let s = c as f64 / 255.0;
        let linear = if s <= 0.04045 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) };
        (linear * 65535.0).round() as u16
    })
}

fn bounds<const N: usize>(values: impl Iterator<Item = [f64; N]>) -> (Vec<f64>, Vec<f64>) {
    let mut min = vec![f64::INFINITY; N];
    let mut max = vec![f64::NEG_INFINITY; N];
    for value in values {
        for axis in 0..N {
            min[axis] = min[axis].min(value[axis]);
            max[axis] = max[axis].max(value[axis]);
        }
    }
    (min, max)
}

fn rows_u16<const N: usize, const M: usize>(values: [u16; N]) -> [u8; M] {
    let mut row = [0; M];
    for (to, from) in row.chunks_exact_mut(2).zip(values) {
        to.copy_from_slice(&from.to_le_bytes());
    }
    row
}

fn rows_f32<const N: usize, const M: usize>(values: [f32; N]) -> [u8; M] {
    let mut row = [0; M];
    for (to, from) in row.chunks_exact_mut(4).zip(values) {
        to.copy_from_slice(&from.to_le_bytes());
    }
    row
}
