//! `KHR_draco_mesh_compression` (feature `draco`), by a decoder in Rust that is young and has unchecked indexing inside.
//!
//! What it can be guarded against is: counts are compared before it runs, a panic is caught, indices are checked after.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

use draco_oxide_core::attribute::{Attribute, ComponentDataType};

use super::refusal::{Refusal, of_gltf, refuse};
use crate::input::gltf::data::Data;
use crate::input::gltf::schema::{Draco, Int};

/// Triangles or points of one stream at most.
const MAX_COUNT: u64 = 20_000_000;

const HEADER_BYTES: usize = 11;
const SEQUENTIAL: u8 = 0;

/// A decoded primitive.
pub struct Unpacked {
    /// Indices below `points`.
    pub faces: Vec<[u32; 3]>,
    pub points: u32,
    /// By glTF attribute.
    columns: BTreeMap<String, Column>,
}

struct Column {
    width: usize,
    values: Vec<f64>,
}

impl Unpacked {
    /// The value of attribute `name` at `point`; components it does not have are zero.
    pub fn get<const N: usize>(&self, name: &str, point: u32) -> Option<[f64; N]> {
        let column = self.columns.get(name)?;
        let values = column.values.get(point as usize * column.width..)?.get(..column.width)?;
        Some(std::array::from_fn(|i| values.get(i).copied().unwrap_or(0.0)))
    }
}

/// Decodes what `wire` names.
pub fn unpack(data: &Data<'_>, wire: &Draco) -> Result<Unpacked, Refusal> {
    let broken = |what: &str| Refusal::new("broken-draco", what.to_string());
    let view = wire.buffer_view.ok_or_else(|| broken("KHR_draco_mesh_compression names no bufferView"))?;
    let bytes = data.view(view).map_err(of_gltf)?.bytes;
    check(bytes)?;
    let decoded = catch_unwind(AssertUnwindSafe(|| draco_oxide_decoder::decode_mesh(bytes)));
    let mesh = match decoded {
        Ok(Ok(mesh)) => mesh,
        Ok(Err(error)) => return refuse("broken-draco", format!("its Draco stream is not read: {error}")),
        Err(_) => return refuse("broken-draco", "its Draco stream breaks the decoder"),
    };
    let mut columns = BTreeMap::new();
    for (name, Int(id)) in &wire.attributes {
        let found = mesh.get_attributes().iter().find(|a| a.get_id().as_usize() as u64 == *id);
        if let Some(column) = found.and_then(column) {
            columns.insert(name.clone(), column);
        }
    }
    let position = columns.get("POSITION").filter(|column| column.width == 3);
    let points = position.ok_or_else(|| broken("its Draco stream has no positions"))?.values.len() / 3;
    let faces: Vec<[u32; 3]> =
        mesh.get_faces().iter().map(|face| face.map(|point| usize::from(point) as u32)).collect();
    if faces.iter().flatten().any(|&point| point as usize >= points) {
        return Err(broken("its Draco stream has an index out of range"));
    }
    Ok(Unpacked { faces, points: points as u32, columns })
}

/// Compares the counts that the stream states with what may be.
fn check(bytes: &[u8]) -> Result<(), Refusal> {
    let cut = || Refusal::new("broken-draco", "its Draco stream is cut short");
    let header = bytes.get(..HEADER_BYTES).filter(|header| header.starts_with(b"DRACO")).ok_or_else(cut)?;
    // The counts come after the metadata, whose length only its reader knows.
    if header[10] & 0x80 != 0 {
        return refuse("draco", "its Draco stream has metadata, which is not read");
    }
    let mut at = if header[8] == SEQUENTIAL { HEADER_BYTES } else { HEADER_BYTES + 1 };
    for _ in 0..2 {
        let mut count = 0u64;
        for shift in (0..35).step_by(7) {
            let byte = *bytes.get(at).ok_or_else(cut)?;
            at += 1;
            count |= u64::from(byte & 0x7F) << shift;
            if byte < 0x80 {
                break;
            }
        }
        if count > MAX_COUNT {
            return refuse("too-large", format!("its Draco stream states {count} triangles or points"));
        }
    }
    Ok(())
}

/// Values of an attribute by point. `None` for kinds that glTF has not.
fn column(attribute: &Attribute) -> Option<Column> {
    let (bytes, width) = (attribute.get_data_as_bytes(), attribute.get_num_components());
    let kind = attribute.get_component_type();
    let size = match kind {
        ComponentDataType::I8 | ComponentDataType::U8 => 1,
        ComponentDataType::I16 | ComponentDataType::U16 => 2,
        ComponentDataType::I32 | ComponentDataType::U32 | ComponentDataType::F32 => 4,
        _ => return None,
    };
    let read = |b: &[u8]| match kind {
        ComponentDataType::I8 => f64::from(b[0] as i8),
        ComponentDataType::U8 => f64::from(b[0]),
        ComponentDataType::I16 => f64::from(i16::from_le_bytes([b[0], b[1]])),
        ComponentDataType::U16 => f64::from(u16::from_le_bytes([b[0], b[1]])),
        ComponentDataType::I32 => f64::from(i32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        ComponentDataType::U32 => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        _ => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
    };
    let unique: Vec<f64> = bytes.chunks_exact(size).map(read).collect();
    let values = match attribute.point_map_as_slice() {
        None => unique,
        Some(map) => {
            let mut values = Vec::with_capacity(map.len().checked_mul(width)?);
            for &at in map {
                let from = usize::from(at).checked_mul(width)?;
                values.extend(unique.get(from..from.checked_add(width)?)?);
            }
            values
        }
    };
    (width > 0).then_some(Column { width, values })
}
