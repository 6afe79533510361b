//! Unpacks `EXT_meshopt_compression` and `KHR_meshopt_compression` views with meshoptimizer's decoders.
//!
//! The decoders are safe on hostile bytes but trust the sizes they are told, so those are checked here.

use std::path::Path;

use super::schema::Meshopt;
use crate::{Error, Result};

/// No stream unpacks to more than this many times its size: version 1 of the vertex codec spends at least a byte on
/// four bytes of stride for a block of 256 vertices.
const MAX_RATIO: u64 = 1024;
/// Any stream may unpack to this much.
const MIN_ALLOWED_BYTES: u64 = 64 << 10;

/// The bytes `packed` stands for. `declared` is the view's own byteLength.
pub fn unpack(
    packed: &Meshopt,
    bytes: &[u8],
    declared: Option<u64>,
    path: &Path,
    refuse: impl Fn(String) -> Error,
) -> Result<Vec<u8>> {
    let (count, stride) = (packed.count.0, packed.byte_stride.0);
    let size = count.checked_mul(stride).filter(|&size| declared.is_none_or(|d| d == size));
    let size = size.ok_or_else(|| refuse(format!("{count} elements of {stride} bytes are not its byteLength")))?;
    if size > (bytes.len() as u64).saturating_mul(MAX_RATIO).max(MIN_ALLOWED_BYTES) {
        return Err(refuse(format!("{} compressed bytes cannot hold the {size} bytes it claims", bytes.len())));
    }
    if count == 0 {
        return Ok(Vec::new());
    }
    let count = count as usize;
    let unsupported = |what: String| Error::Unsupported { path: path.into(), what };
    let broken = |_| refuse(format!("its meshopt-compressed {} do not decode", packed.mode.to_lowercase()));
    let mut unpacked = match (packed.mode.as_str(), stride) {
        ("ATTRIBUTES", _) => vertices(bytes, count, stride)
            .ok_or_else(|| unsupported(format!("meshopt vertex stride {stride}; re-export without it")))?
            .map_err(broken)?,
        ("TRIANGLES", _) if !count.is_multiple_of(3) => {
            return Err(refuse(format!("{count} indices are not triangles")));
        }
        ("TRIANGLES", 2) => words16(::meshopt::decode_index_buffer::<u16>(bytes, count).map_err(broken)?),
        ("TRIANGLES", 4) => words32(::meshopt::decode_index_buffer::<u32>(bytes, count).map_err(broken)?),
        ("INDICES", 2) => words16(::meshopt::decode_index_sequence::<u16>(bytes, count).map_err(broken)?),
        ("INDICES", 4) => words32(::meshopt::decode_index_sequence::<u32>(bytes, count).map_err(broken)?),
        (mode, _) => return Err(refuse(format!("meshopt mode {mode:?} with byteStride {stride} does not exist"))),
    };
    match packed.filter.as_deref() {
        None | Some("NONE") => {}
        Some("EXPONENTIAL") => unpacked.as_chunks_mut::<4>().0.iter_mut().for_each(exponential),
        Some("COLOR") if stride == 4 => color::<u8>(&mut unpacked),
        Some("COLOR") if stride == 8 => color::<u16>(&mut unpacked),
        Some(other) => {
            return Err(unsupported(format!(
                "meshopt filter {other} on positions, UVs or colours; re-export without it"
            )));
        }
    }
    Ok(unpacked)
}

/// One element of `N` bytes, as the decoder wants it.
#[derive(Clone, Copy)]
struct Element<const N: usize>([u8; N]);

impl<const N: usize> Default for Element<N> {
    fn default() -> Self {
        Self([0; N])
    }
}

/// `None` for a stride no exporter writes.
fn vertices(bytes: &[u8], count: usize, stride: u64) -> Option<::meshopt::Result<Vec<u8>>> {
    fn decode<const N: usize>(bytes: &[u8], count: usize) -> ::meshopt::Result<Vec<u8>> {
        let elements = ::meshopt::decode_vertex_buffer::<Element<N>>(bytes, count)?;
        Ok(elements.iter().flat_map(|e| e.0).collect())
    }
    macro_rules! by_stride {
        ($($n:literal)*) => { match stride { $($n => decode::<$n>(bytes, count),)* _ => return None } };
    }
    Some(by_stride!(4 8 12 16 20 24 28 32 36 40 44 48 52 56 60 64))
}

fn words16(words: Vec<u16>) -> Vec<u8> {
    words.iter().flat_map(|w| w.to_le_bytes()).collect()
}

fn words32(words: Vec<u32>) -> Vec<u8> {
    words.iter().flat_map(|w| w.to_le_bytes()).collect()
}

/// 24 bits of mantissa m and 8 bits of exponent e become the float m·2^e.
fn exponential(bytes: &mut [u8; 4]) {
    let word = i32::from_le_bytes(*bytes);
    let value = f64::from((word << 8) >> 8) * 2f64.powi(word >> 24);
    *bytes = (value as f32).to_le_bytes();
}

/// YCoCg back to RGB, in place.
fn color<C: bytemuck::Pod + ::meshopt::FilterComponent>(bytes: &mut [u8]) {
    let mut pixels: Vec<[C; 4]> = bytes.chunks_exact(4 * size_of::<C>()).map(bytemuck::pod_read_unaligned).collect();
    ::meshopt::decode_filter_color(&mut pixels);
    bytes.copy_from_slice(bytemuck::cast_slice(&pixels));
}

#[cfg(test)]
mod tests {
    use super::super::schema::Int;
    use super::*;

    #[test]
    fn filtered_colors_come_back_within_two_steps() {
        let colors = [[1.0f32, 0.5, 0.25, 1.0], [0.0, 0.8, 0.1, 1.0]];
        let wanted = colors.map(|c| c.map(|v| (v * 255.0).round() as u8));
        let filtered = ::meshopt::encode_filter_color::<u8>(&colors, 8);
        let bytes = ::meshopt::encode_vertex_buffer(&filtered).unwrap();
        let packed = Meshopt {
            buffer: Int(0),
            byte_offset: None,
            byte_length: Int(bytes.len() as u64),
            byte_stride: Int(4),
            count: Int(2),
            mode: "ATTRIBUTES".into(),
            filter: Some("COLOR".into()),
        };
        let path = Path::new("a.glb");
        let found = unpack(&packed, &bytes, Some(8), path, |what| Error::input(path, what)).unwrap();
        for (found, wanted) in found.iter().zip(wanted.as_flattened()) {
            assert!(found.abs_diff(*wanted) <= 2, "{found} {wanted}");
        }
    }
}
