//! Accessors: every element they can give out was checked to lie in its buffer.

use super::data::Data;
use super::schema::{Int, Sparse};
use crate::{Error, Result};

/// How one component is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

impl Component {
    fn of(code: Int) -> Option<Self> {
        Some(match code.0 {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }

    /// The value at the start of `bytes`, which hold at least one component.
    fn read(self, bytes: &[u8], normalized: bool) -> f64 {
        let (value, full) = match self {
            Self::I8 => (f64::from(bytes[0] as i8), 127.0),
            Self::U8 => (f64::from(bytes[0]), 255.0),
            Self::I16 => (f64::from(i16::from_le_bytes([bytes[0], bytes[1]])), 32767.0),
            Self::U16 => (f64::from(u16::from_le_bytes([bytes[0], bytes[1]])), 65535.0),
            Self::U32 => (f64::from(self.read_u32(bytes)), f64::from(u32::MAX)),
            Self::F32 => return f64::from(f32::from_bits(self.read_u32(bytes))),
        };
        if normalized { (value / full).max(-1.0) } else { value }
    }

    /// The unsigned integer, or the bits of a float, at the start of `bytes`.
    fn read_u32(self, bytes: &[u8]) -> u32 {
        match self.bytes() {
            1 => u32::from(bytes[0]),
            2 => u32::from(u16::from_le_bytes([bytes[0], bytes[1]])),
            _ => u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
        }
    }
}

/// What an accessor is wanted for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Use {
    Position,
    Uv,
    Color,
    Indices,
    FeatureId,
}

impl Use {
    /// Shapes and component types allowed, those of `KHR_mesh_quantization` among them.
    fn allows(self, shape: &str, component: Component) -> bool {
        use Component::{F32, I8, I16, U8, U16, U32};
        match self {
            Self::Position => shape == "VEC3" && matches!(component, F32 | I8 | U8 | I16 | U16),
            Self::Uv => shape == "VEC2" && matches!(component, F32 | I8 | U8 | I16 | U16),
            Self::Color => matches!(shape, "VEC3" | "VEC4") && matches!(component, F32 | U8 | U16),
            Self::FeatureId => shape == "SCALAR" && matches!(component, F32 | U8 | U16 | U32),
            Self::Indices => shape == "SCALAR" && matches!(component, U8 | U16 | U32),
        }
    }
}

/// An accessor, checked.
pub struct Elements<'a> {
    pub count: u64,
    component: Component,
    normalized: bool,
    width: usize,
    /// Bytes from the first element on, and the stride; `None`: all zero.
    dense: Option<(&'a [u8], usize)>,
    /// Ascending indices and their tightly packed elements.
    sparse: Option<(Vec<u32>, &'a [u8])>,
}

impl<'a> Elements<'a> {
    /// Accessor `index`, if it fits `usage`.
    pub fn of(data: &'a Data<'a>, index: Int, usage: Use) -> Result<Self> {
        let refuse = |what: String| data.refuse(format!("accessor {}: {what}", index.0));
        let accessor = data.at(&data.root.accessors, index, "accessor")?;
        let shape = accessor.shape.as_deref().unwrap_or_default();
        let code = accessor.component_type.ok_or_else(|| refuse("has no componentType".into()))?;
        let component = Component::of(code).filter(|&c| usage.allows(shape, c));
        let component = component
            .ok_or_else(|| refuse(format!("{shape:?} of component type {} is not allowed for {usage:?}", code.0)))?;
        let width = match shape {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            _ => 4,
        };
        let count = accessor.count.ok_or_else(|| refuse("has no count".into()))?.0;
        if count > u64::from(u32::MAX) {
            return Err(refuse(format!("count {count} is over 2^32")));
        }
        // Integer colours are normalized by definition; some writers forget to say so.
        let normalized = accessor.normalized || (usage == Use::Color && component != Component::F32);
        let size = width * component.bytes();
        let dense = match accessor.buffer_view {
            None => None,
            Some(view) => {
                let offset = accessor.byte_offset.map_or(0, |o| o.0);
                Some(strided(data, view, offset, count, size as u64, &refuse)?)
            }
        };
        let sparse = accessor.sparse.as_ref().map(|s| overlay(data, s, count, size as u64, &refuse)).transpose()?;
        Ok(Self { count, component, normalized, width, dense, sparse })
    }

    /// True if no byte of the file backs the elements.
    pub fn is_virtual(&self) -> bool {
        self.dense.is_none() && self.sparse.is_none()
    }

    /// Elements replaced by a sparse overlay.
    pub fn sparse_count(&self) -> u64 {
        self.sparse.as_ref().map_or(0, |(indices, _)| indices.len() as u64)
    }

    /// Component type's largest value, which restarts a primitive.
    pub fn restart(&self) -> u32 {
        match self.component.bytes() {
            1 => u32::from(u8::MAX),
            2 => u32::from(u16::MAX),
            _ => u32::MAX,
        }
    }

    /// Element `i` (below `count`) as numbers; components it does not have are zero.
    pub fn get<const N: usize>(&self, i: u32) -> [f64; N] {
        let bytes = self.bytes(i);
        let mut values = [0.0; N];
        for (value, at) in values.iter_mut().zip(bytes.chunks_exact(self.component.bytes())) {
            *value = self.component.read(at, self.normalized);
        }
        values
    }

    /// Element `i` (below `count`) as an index.
    pub fn index(&self, i: u32) -> u32 {
        let bytes = self.bytes(i);
        if bytes.is_empty() { 0 } else { self.component.read_u32(bytes) }
    }

    /// The bytes of element `i`; empty if it is zero because nothing backs it.
    fn bytes(&self, i: u32) -> &'a [u8] {
        let size = self.width * self.component.bytes();
        if let Some((indices, values)) = &self.sparse
            && let Ok(rank) = indices.binary_search(&i)
        {
            return &values[rank * size..][..size];
        }
        self.dense.map_or(&[], |(bytes, stride)| &bytes[i as usize * stride..][..size])
    }
}

/// Bytes and stride of `count` elements of `size` bytes, all inside `view`.
fn strided<'a>(
    data: &'a Data<'a>,
    view: Int,
    offset: u64,
    count: u64,
    size: u64,
    refuse: &dyn Fn(String) -> Error,
) -> Result<(&'a [u8], usize)> {
    let seen = data.view(view)?;
    let stride = seen.stride.unwrap_or(size);
    if stride < size {
        return Err(refuse(format!("byteStride {stride} is less than the {size} bytes of an element")));
    }
    let need = count.checked_sub(1).map_or(Some(0), |last| last.checked_mul(stride)?.checked_add(size));
    let end = need.and_then(|need| need.checked_add(offset)).filter(|&end| end <= seen.bytes.len() as u64);
    let Some(end) = end else {
        let held = seen.bytes.len();
        return Err(refuse(format!(
            "{count} elements, {stride} bytes apart from byte {offset} on, leave bufferView {}, which has {held} bytes",
            view.0
        )));
    };
    Ok((&seen.bytes[offset as usize..end as usize], stride as usize))
}

fn overlay<'a>(
    data: &'a Data<'a>,
    sparse: &Sparse,
    count: u64,
    size: u64,
    refuse: &dyn Fn(String) -> Error,
) -> Result<(Vec<u32>, &'a [u8])> {
    let component = Component::of(sparse.indices.component_type)
        .filter(|&c| Use::Indices.allows("SCALAR", c))
        .ok_or_else(|| refuse(format!("sparse indices of component type {}", sparse.indices.component_type.0)))?;
    let packed = |view, offset: Option<Int>, size| {
        let (bytes, stride) = strided(data, view, offset.map_or(0, |o| o.0), sparse.count.0, size, refuse)?;
        let tight = stride as u64 == size || sparse.count.0 < 2;
        if tight { Ok(bytes) } else { Err(refuse(format!("sparse bufferView {} has a byteStride", view.0))) }
    };
    let width = component.bytes();
    let indices = packed(sparse.indices.buffer_view, sparse.indices.byte_offset, width as u64)?;
    let values = packed(sparse.values.buffer_view, sparse.values.byte_offset, size)?;
    let indices: Vec<u32> = indices.chunks_exact(width).map(|bytes| component.read_u32(bytes)).collect();
    let rising = indices.windows(2).all(|pair| pair[0] < pair[1]);
    if !rising || indices.last().is_some_and(|&last| u64::from(last) >= count) {
        return Err(refuse(format!("sparse indices must rise and stay below {count}")));
    }
    Ok((indices, values))
}
