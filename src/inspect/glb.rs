//! Reads a GLB back: triangles in the tile's frame, feature ids, classes. Independent of the writer.
//!
//! # Promises
//! No panic and no allocation beyond what the file's size (or [`MAX_DECODED_BYTES`], when compressed) allows,
//! whatever the bytes say. The meshopt decoder sees only sizes that were checked.
//!
//! # Limits
//! Triangle lists; no external buffers, sparse accessors, Draco or KTX2: such files are refused as `unsupported`.

use glam::{DMat4, DQuat, DVec3};

use crate::schema::gltf::*;

/// Why a GLB was refused.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Broken {
    /// Stable name.
    pub code: &'static str,
    /// Value found, value wanted.
    pub what: String,
}

type Result<T> = std::result::Result<T, Broken>;

fn broken<T>(what: impl Into<String>) -> Result<T> {
    Err(Broken { code: "broken-glb", what: what.into() })
}

fn unsupported<T>(what: impl Into<String>) -> Result<T> {
    Err(Broken { code: "unsupported", what: what.into() })
}

/// Decompressed bytes of one file at most: 1 GiB, some ten times the largest tile that any viewer would draw.
pub(super) const MAX_DECODED_BYTES: u64 = 1 << 30;

/// Vertices and indices of all primitives of one file at most.
const MAX_ELEMENTS: u64 = 50_000_000;

const REQUIRED_KNOWN: [&str; 6] = [
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "KHR_mesh_quantization",
    "KHR_materials_unlit",
    "EXT_mesh_features",
    "EXT_structural_metadata",
];

/// A file taken apart; views are decompressed.
pub(super) struct Glb {
    pub gltf: Gltf,
    bin: Vec<u8>,
    /// Per buffer view: its bytes where they were compressed.
    decoded: Vec<Option<Vec<u8>>>,
}

/// One draw call's triangles.
pub(super) struct Triangles {
    /// In the tile's frame: after the nodes' transforms, z up.
    pub positions: Vec<DVec3>,
    pub faces: Vec<[u32; 3]>,
    /// Per vertex, of the first feature id set; empty if there is none.
    pub feature_ids: Vec<u32>,
    /// From id to class.
    pub features: Option<Features>,
    /// Rounding step of the positions in the tile's frame, metres; 0 for floats.
    pub step_m: f64,
}

/// What the first feature id set says.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Features {
    pub count: u32,
    /// Name of the enum value of each row; empty without a property table with an enum.
    pub class_names: Vec<String>,
    /// Rows that are skirts, which are no part of the surface; empty: none are.
    pub skirts: Vec<bool>,
}

/// Takes a GLB apart.
pub(super) fn parse(bytes: &[u8]) -> Result<Glb> {
    let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    if bytes.get(..4) != Some(b"glTF") {
        return broken("does not begin with `glTF`");
    }
    let (Some(2), Some(length)) = (word(4), word(8)) else { return broken("is not of version 2") };
    if length != bytes.len() {
        return broken(format!("says it has {length} bytes and has {}", bytes.len()));
    }
    let (mut json, mut bin, mut at) = (None, None, 12);
    while at < length {
        let (Some(size), Some(kind)) = (word(at), bytes.get(at + 4..at + 8)) else {
            return broken(format!("is cut in the header of the chunk at byte {at}"));
        };
        let Some(data) = bytes.get(at + 8..).and_then(|rest| rest.get(..size)) else {
            return broken(format!("the chunk at byte {at} of {size} bytes passes the end"));
        };
        match kind {
            b"JSON" if json.is_none() => json = Some(data),
            b"BIN\0" if bin.is_none() => bin = Some(data.to_vec()),
            _ => {}
        }
        at += 8 + size;
    }
    let Some(json) = json else { return broken("has no JSON chunk") };
    let gltf: Gltf = match serde_json::from_slice(json) {
        Ok(gltf) => gltf,
        Err(error) => return broken(format!("the JSON chunk is no glTF: {error}")),
    };
    if let Some(name) = gltf.extensions_required.iter().find(|e| !REQUIRED_KNOWN.contains(&e.as_str())) {
        return unsupported(format!("requires {name}, which is not read here"));
    }
    let mut glb = Glb { gltf, bin: bin.unwrap_or_default(), decoded: Vec::new() };
    glb.decoded = glb.decompress()?;
    Ok(glb)
}

/// Reads one component.
type Read = fn(&[u8]) -> f64;

impl Glb {
    fn buffer(&self, index: u32) -> Result<&[u8]> {
        match self.gltf.buffers.get(index as usize) {
            Some(Buffer { uri: Some(_), .. }) => unsupported("keeps a buffer outside of the file"),
            Some(buffer) if index == 0 => match self.bin.get(..buffer.byte_length as usize) {
                Some(bytes) => Ok(bytes),
                None => broken(format!("buffer 0 wants {} bytes of {}", buffer.byte_length, self.bin.len())),
            },
            _ => broken(format!("there are no bytes for buffer {index}")),
        }
    }

    fn slice(&self, buffer: u32, offset: Option<u64>, length: u64) -> Result<&[u8]> {
        let (bytes, offset) = (self.buffer(buffer)?, offset.unwrap_or(0));
        match offset.checked_add(length).and_then(|end| bytes.get(offset as usize..end as usize)) {
            Some(slice) => Ok(slice),
            None => broken(format!("{length} bytes at {offset} pass the {} of buffer {buffer}", bytes.len())),
        }
    }

    fn decompress(&self) -> Result<Vec<Option<Vec<u8>>>> {
        let mut total = 0u64;
        let mut decoded = Vec::new();
        for (v, view) in self.gltf.buffer_views.iter().enumerate() {
            let Some(m) = view.extensions.as_ref().and_then(|e| e.meshopt.as_ref()) else {
                decoded.push(None);
                continue;
            };
            let size = m.count.saturating_mul(m.byte_stride);
            total = total.saturating_add(size);
            if total > MAX_DECODED_BYTES {
                return broken(format!("decompresses to more than {MAX_DECODED_BYTES} bytes"));
            }
            if size != view.byte_length {
                return broken(format!("view {v} of {} bytes decompresses to {size}", view.byte_length));
            }
            let coded = self.slice(m.buffer, m.byte_offset, m.byte_length)?;
            match decode(coded, m) {
                Some(bytes) => decoded.push(Some(bytes)),
                None => {
                    return broken(format!("view {v} cannot be decompressed as {} of {} bytes", m.mode, m.byte_stride));
                }
            }
        }
        Ok(decoded)
    }

    /// Bytes of a view, decompressed.
    pub fn view(&self, index: u32) -> Result<&[u8]> {
        let Some(view) = self.gltf.buffer_views.get(index as usize) else {
            return broken(format!("there is no buffer view {index}"));
        };
        match self.decoded.get(index as usize) {
            Some(Some(bytes)) => Ok(bytes),
            _ => self.slice(view.buffer, view.byte_offset, view.byte_length),
        }
    }

    /// Elements of an accessor as stored (`raw`) or after normalisation.
    fn elements<const N: usize>(&self, index: u32, raw: bool) -> Result<Vec<[f64; N]>> {
        let Some(a) = self.gltf.accessors.get(index as usize) else {
            return broken(format!("there is no accessor {index}"));
        };
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][N - 1];
        if a.kind != kind {
            return broken(format!("accessor {index} is {} where {kind} is wanted", a.kind));
        }
        let (None, Some(view_index)) = (&a.sparse, a.buffer_view) else {
            return unsupported(format!("accessor {index} is sparse or empty"));
        };
        let (size, read, unit): (usize, Read, f64) = match a.component_type {
            BYTE => (1, |b| f64::from(b[0] as i8), 127.0),
            UNSIGNED_BYTE => (1, |b| f64::from(b[0]), 255.0),
            SHORT => (2, |b| f64::from(i16::from_le_bytes([b[0], b[1]])), 32767.0),
            UNSIGNED_SHORT => (2, |b| f64::from(u16::from_le_bytes([b[0], b[1]])), 65535.0),
            UNSIGNED_INT => (4, |b| f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])), 4294967295.0),
            FLOAT => (4, |b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
            other => return broken(format!("accessor {index} has the component type {other}")),
        };
        let bytes = self.view(view_index)?;
        let stride = self.gltf.buffer_views[view_index as usize].byte_stride.unwrap_or((N * size) as u64);
        let offset = a.byte_offset.unwrap_or(0);
        let last = a.count.checked_sub(1).and_then(|n| n.checked_mul(stride)?.checked_add(offset));
        let end = last.and_then(|last| last.checked_add((N * size) as u64));
        if stride < (N * size) as u64 || end.is_none_or(|end| end > bytes.len() as u64) {
            return broken(format!(
                "accessor {index} of {} elements passes its view of {} bytes",
                a.count,
                bytes.len()
            ));
        }
        let scale = if a.normalized && !raw && a.component_type != FLOAT { unit } else { 1.0 };
        let element = |i: u64| {
            let at = (offset + i * stride) as usize;
            // -128 stands for -1 too. Not for floats: `max` would make a number of NaN.
            let value = |c: usize| read(&bytes[at + c * size..]);
            std::array::from_fn(|c| if scale > 1.0 { (value(c) / scale).max(-1.0) } else { value(c) })
        };
        Ok((0..a.count).map(element).collect())
    }

    /// All triangles of the scene, a list per primitive.
    pub fn triangles(&self) -> Result<Vec<Triangles>> {
        let scene = self.gltf.scenes.get(self.gltf.scene.unwrap_or(0) as usize);
        let roots = scene.map(|s| s.nodes.clone()).unwrap_or_default();
        // glTF is y up, tiles are z up: (x, y, z) to (x, -z, y).
        let z_up = DMat4::from_cols_array(&[1., 0., 0., 0., 0., 0., 1., 0., 0., -1., 0., 0., 0., 0., 0., 1.]);
        let mut stack: Vec<(u32, DMat4)> = roots.into_iter().rev().map(|n| (n, z_up)).collect();
        let mut seen = vec![false; self.gltf.nodes.len()];
        let (mut lists, mut elements) = (Vec::new(), 0u64);
        while let Some((n, parent)) = stack.pop() {
            let Some(node) = self.gltf.nodes.get(n as usize) else { return broken(format!("there is no node {n}")) };
            if std::mem::replace(&mut seen[n as usize], true) {
                return broken(format!("node {n} has two parents"));
            }
            let tile_from_node = parent * transform(node);
            if !tile_from_node.is_finite() {
                return broken(format!("the transform of node {n} is not finite"));
            }
            stack.extend(node.children.iter().rev().map(|&c| (c, tile_from_node)));
            let Some(m) = node.mesh else { continue };
            let Some(mesh) = self.gltf.meshes.get(m as usize) else { return broken(format!("there is no mesh {m}")) };
            for primitive in &mesh.primitives {
                // Primitives may share accessors: what they name together has to be bounded too.
                let named = primitive.attributes.get("POSITION").into_iter().chain(&primitive.indices);
                let counts = named.filter_map(|&a| Some(self.gltf.accessors.get(a as usize)?.count));
                elements = counts.fold(elements, u64::saturating_add);
                if elements > MAX_ELEMENTS {
                    return broken(format!("draws more than {MAX_ELEMENTS} vertices and indices"));
                }
                lists.push(self.primitive(primitive, tile_from_node)?);
            }
        }
        Ok(lists)
    }

    fn primitive(&self, primitive: &Primitive, tile_from_node: DMat4) -> Result<Triangles> {
        if primitive.mode.unwrap_or(TRIANGLES) != TRIANGLES {
            return unsupported(format!("draws in mode {:?}, not triangles", primitive.mode));
        }
        let Some(&position) = primitive.attributes.get("POSITION") else {
            return broken("a primitive has no POSITION");
        };
        let raw = self.elements::<3>(position, true)?;
        self.check_bounds(position, &raw)?;
        let used =
            if self.gltf.accessors[position as usize].normalized { self.elements::<3>(position, false)? } else { raw };
        let positions: Vec<DVec3> = used.iter().map(|&p| tile_from_node.transform_point3(p.into())).collect();
        if let Some(v) = positions.iter().position(|p| !p.is_finite()) {
            return broken(format!("the position of vertex {v} is not finite"));
        }
        let faces = self.faces(primitive, positions.len())?;
        let (features, feature_ids) = self.features(primitive, positions.len())?;
        let step_m = self.step_m(position, tile_from_node);
        Ok(Triangles { positions, faces, feature_ids, features, step_m })
    }

    /// The stated bounds must be those of the data: viewers cull and fit depth by them.
    fn check_bounds(&self, position: u32, raw: &[[f64; 3]]) -> Result<()> {
        let a = &self.gltf.accessors[position as usize];
        for axis in 0..3 {
            let values = || raw.iter().map(|p| p[axis]);
            if let Some(v) = raw.iter().position(|p| !p[axis].is_finite()) {
                return broken(format!("the position of vertex {v} is not finite"));
            }
            let (min, max) = (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
            let stated = (a.min.get(axis), a.max.get(axis));
            if stated != (Some(&min), Some(&max)) {
                let what = format!("POSITION runs from {min} to {max} on axis {axis} and states {stated:?}");
                return Err(Broken { code: "wrong-bounds", what });
            }
        }
        Ok(())
    }

    fn faces(&self, primitive: &Primitive, vertices: usize) -> Result<Vec<[u32; 3]>> {
        let indices: Vec<u32> = match primitive.indices {
            Some(accessor) => self.elements::<1>(accessor, true)?.into_iter().map(|[i]| i as u32).collect(),
            None => (0..vertices as u32).collect(),
        };
        if let Some(&index) = indices.iter().find(|&&i| i as usize >= vertices) {
            return Err(Broken { code: "index-range", what: format!("index {index} of {vertices} vertices") });
        }
        if !indices.len().is_multiple_of(3) {
            return broken(format!("{} indices make no triangles", indices.len()));
        }
        Ok(indices.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect())
    }

    fn features(&self, primitive: &Primitive, vertices: usize) -> Result<(Option<Features>, Vec<u32>)> {
        let set = primitive.extensions.as_ref().and_then(|e| e.mesh_features.as_ref()?.feature_ids.first());
        let Some((set, attribute)) = set.and_then(|s| Some((s, s.attribute?))) else { return Ok((None, Vec::new())) };
        let Some(&accessor) = primitive.attributes.get(&format!("_FEATURE_ID_{attribute}")) else {
            return broken(format!("there is no attribute _FEATURE_ID_{attribute}"));
        };
        let ids: Vec<u32> = self.elements::<1>(accessor, true)?.into_iter().map(|[i]| i as u32).collect();
        if ids.len() != vertices {
            return broken(format!("{} feature ids for {vertices} vertices", ids.len()));
        }
        if let Some(id) = ids.iter().find(|&&id| id >= set.feature_count) {
            return Err(Broken { code: "feature-range", what: format!("feature id {id} of {}", set.feature_count) });
        }
        let (class_names, skirts) = match set.property_table {
            Some(table) => (self.class_names(table, set.feature_count)?, self.skirts(table)),
            None => (Vec::new(), Vec::new()),
        };
        Ok((Some(Features { count: set.feature_count, class_names, skirts }), ids))
    }

    /// Names of the first enum property of a table, by row. Enums of one byte only.
    fn class_names(&self, index: u32, features: u32) -> Result<Vec<String>> {
        let metadata = self.gltf.extensions.as_ref().and_then(|e| e.structural_metadata.as_ref());
        let table = metadata.and_then(|m| m.property_tables.get(index as usize));
        let (Some(metadata), Some(table)) = (metadata, table) else {
            return broken(format!("there is no property table {index}"));
        };
        if table.count < features {
            return broken(format!("property table {index} has {} rows for {features} features", table.count));
        }
        let Some(schema) = &metadata.schema else { return Ok(Vec::new()) };
        let Some(class) = schema.classes.get(&table.class) else {
            return broken(format!("property table {index} has the class {}, which the schema lacks", table.class));
        };
        let Some((id, property)) = class.properties.iter().find(|(_, p)| p.kind == "ENUM" && !p.array) else {
            return Ok(Vec::new());
        };
        let kind = property.enum_type.as_ref().and_then(|e| schema.enums.get(e));
        let (Some(kind), Some(column)) = (kind, table.properties.get(id)) else {
            return broken(format!("property {id} of table {index} has no enum or no values"));
        };
        if kind.value_type.as_deref() != Some("UINT8") {
            return Ok(Vec::new());
        }
        let values = self.view(column.values)?;
        if values.len() < table.count as usize {
            return broken(format!("property {id} has {} values for {} rows", values.len(), table.count));
        }
        let name = |value: &u8| kind.values.iter().find(|v| v.value == i64::from(*value)).map(|v| v.name.clone());
        match values[..table.count as usize].iter().map(name).collect() {
            Some(names) => Ok(names),
            None => broken(format!("property {id} has a value that its enum lacks")),
        }
    }

    /// Which rows of a table are skirts, by this program's own property; none where it is missing.
    fn skirts(&self, index: u32) -> Vec<bool> {
        let metadata = self.gltf.extensions.as_ref().and_then(|e| e.structural_metadata.as_ref());
        let column = metadata.and_then(|m| m.property_tables.get(index as usize)?.properties.get("skirt"));
        let values = column.and_then(|c| self.view(c.values).ok());
        values.map(|v| v.iter().map(|&b| b == 1).collect()).unwrap_or_default()
    }

    fn step_m(&self, position: u32, tile_from_node: DMat4) -> f64 {
        let a = &self.gltf.accessors[position as usize];
        let unit = match (a.component_type, a.normalized) {
            (FLOAT, _) => return 0.0,
            (_, false) => 1.0,
            (UNSIGNED_BYTE, _) => 1.0 / 255.0,
            (BYTE, _) => 1.0 / 127.0,
            (SHORT, _) => 1.0 / 32767.0,
            _ => 1.0 / 65535.0,
        };
        let scale =
            [tile_from_node.x_axis, tile_from_node.y_axis, tile_from_node.z_axis].map(|c| c.truncate().length());
        scale.into_iter().fold(0.0, f64::max) * unit
    }
}

fn transform(node: &Node) -> DMat4 {
    if let Some(matrix) = &node.matrix {
        return DMat4::from_cols_array(matrix);
    }
    DMat4::from_scale_rotation_translation(
        node.scale.unwrap_or([1.0; 3]).into(),
        DQuat::from_array(node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0])),
        node.translation.unwrap_or([0.0; 3]).into(),
    )
}

/// Decompresses one view whose size was checked; `None` if the bytes or the parameters are wrong.
fn decode(coded: &[u8], m: &Meshopt) -> Option<Vec<u8>> {
    let count = m.count as usize;
    let filter = m.filter.as_deref().unwrap_or("NONE");
    match (m.mode.as_str(), m.byte_stride) {
        ("ATTRIBUTES", 4) => vertices::<1>(coded, count, filter),
        ("ATTRIBUTES", 8) => vertices::<2>(coded, count, filter),
        ("ATTRIBUTES", 12) => vertices::<3>(coded, count, filter),
        ("ATTRIBUTES", 16) => vertices::<4>(coded, count, filter),
        ("ATTRIBUTES", 20) => vertices::<5>(coded, count, filter),
        ("ATTRIBUTES", 24) => vertices::<6>(coded, count, filter),
        ("ATTRIBUTES", 28) => vertices::<7>(coded, count, filter),
        ("ATTRIBUTES", 32) => vertices::<8>(coded, count, filter),
        ("TRIANGLES", 2 | 4) if !count.is_multiple_of(3) => None,
        ("TRIANGLES", 2) => le_u16(&meshopt::decode_index_buffer::<u16>(coded, count).ok()?),
        ("TRIANGLES", 4) => le_u32(&meshopt::decode_index_buffer::<u32>(coded, count).ok()?),
        ("INDICES", 2) => le_u16(&meshopt::decode_index_sequence::<u16>(coded, count).ok()?),
        ("INDICES", 4) => le_u32(&meshopt::decode_index_sequence::<u32>(coded, count).ok()?),
        _ => None,
    }
}

fn vertices<const WORDS: usize>(coded: &[u8], count: usize, filter: &str) -> Option<Vec<u8>>
where
    [u32; WORDS]: Default,
{
    let mut rows = meshopt::decode_vertex_buffer::<[u32; WORDS]>(coded, count).ok()?;
    if filter == "EXPONENTIAL" {
        meshopt::decode_filter_exp(&mut rows);
    }
    // Other filters hold normals, rotations and colours, which are not looked at here.
    // The decoder writes bytes, whatever the machine's order: no conversion.
    Some(bytemuck::cast_slice(rows.as_flattened()).to_vec())
}

fn le_u16(indices: &[u16]) -> Option<Vec<u8>> {
    Some(indices.iter().flat_map(|i| i.to_le_bytes()).collect())
}

fn le_u32(indices: &[u32]) -> Option<Vec<u8>> {
    Some(indices.iter().flat_map(|i| i.to_le_bytes()).collect())
}
