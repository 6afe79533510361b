//! Takes tile contents apart: b3dm and cmpt down to the glTF inside. What is what is told by the first bytes.

use glam::DVec3;
use serde_json::Value;

use super::mesh::{self, Job, TileMesh};
use super::refusal::{Refusal, refuse};

/// Composites within composites.
const MAX_COMPOSITES: u32 = 8;

const B3DM_HEADER_BYTES: usize = 28;
const CMPT_HEADER_BYTES: usize = 16;

/// Sizes from here on are text: the headers of two old drafts are shorter, and JSON stands where a size should.
const LEGACY_FROM: u32 = 0x2200_0000;

/// The meshes of a content.
pub fn load(bytes: &[u8], job: &Job<'_>) -> Result<Vec<TileMesh>, Refusal> {
    load_at(bytes, job, 0)
}

fn load_at(bytes: &[u8], job: &Job<'_>, depth: u32) -> Result<Vec<TileMesh>, Refusal> {
    match bytes.get(..4) {
        Some(b"glTF") => Ok(vec![mesh::read(bytes, DVec3::ZERO, job)?]),
        Some(b"b3dm") => b3dm(bytes, job),
        Some(b"cmpt") => cmpt(bytes, job, depth),
        Some(b"i3dm") => refuse("i3dm", "is an instanced model (i3dm), which is not read"),
        Some(b"pnts") => refuse("pnts", "is a point cloud (pnts), which is not read"),
        Some(b"vctr") => refuse("vctr", "is vector data (vctr), which is not read"),
        Some(b"geom") => refuse("geom", "is geometry of shapes (geom), which is not read"),
        Some(b"subt") => refuse("unknown-content", "is a subtree where a content is wanted"),
        _ => json(bytes, job),
    }
}

fn json(bytes: &[u8], job: &Job<'_>) -> Result<Vec<TileMesh>, Refusal> {
    if bytes.is_empty() {
        return refuse("empty-file", "is empty");
    }
    let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes).trim_ascii_start();
    if !text.starts_with(b"{") {
        return refuse("unknown-content", "begins like no content that is known");
    }
    let has = |name: &[u8]| memchr::memmem::find(text, name).is_some();
    if has(b"\"geometricError\"") && has(b"\"root\"") {
        return refuse("tileset-as-content", "is a tileset, by a name that does not say so");
    }
    if has(b"\"FeatureCollection\"") || has(b"\"Feature\"") {
        return refuse("geojson", "is GeoJSON, which is not read");
    }
    Ok(vec![mesh::read(bytes, DVec3::ZERO, job)?])
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes)
}

fn b3dm(bytes: &[u8], job: &Job<'_>) -> Result<Vec<TileMesh>, Refusal> {
    let stated = word(bytes, 8).map_or(0, |length| length as usize);
    // Padding that one of the two does not count is common.
    if stated.abs_diff(bytes.len()) >= 8 {
        job.warn("b3dm-length", &format!("a b3dm says that it has {stated} bytes and has {}", bytes.len()));
    }
    let (gltf, rtc_center) = split_b3dm(bytes)?;
    Ok(vec![mesh::read(gltf, rtc_center, job)?])
}

/// The glTF of a b3dm and its `RTC_CENTER`.
///
/// What the header says of the whole length is not looked at, as a GLB knows its own; where its lengths of tables lead to
/// nothing that is a glTF, the GLB is searched for.
fn split_b3dm(bytes: &[u8]) -> Result<(&[u8], DVec3), Refusal> {
    let broken = |what: String| Refusal::new("broken-b3dm", what);
    let cut = || broken(format!("a b3dm of {} bytes is cut short", bytes.len()));
    let at = |at: usize| word(bytes, at).ok_or_else(cut);
    let sizes = [at(12)?, at(16)?, at(20)?, at(24)?];
    let (header, sizes) = match sizes {
        [_, batch_json, json_start, _] if json_start >= LEGACY_FROM => (20, [0, 0, batch_json, 0]),
        [batch_json, batch_binary, _, json_start] if json_start >= LEGACY_FROM => {
            (24, [0, 0, batch_json, batch_binary])
        }
        sizes => (B3DM_HEADER_BYTES, sizes),
    };
    let mut from = header;
    let mut parts = [&bytes[..0]; 4];
    for (part, size) in parts.iter_mut().zip(sizes) {
        let end = from.saturating_add(size as usize).min(bytes.len());
        *part = &bytes[from.min(end)..end];
        from = end;
    }
    let is_gltf = |gltf: &[u8]| gltf.starts_with(b"glTF") || gltf.trim_ascii_start().starts_with(b"{");
    let mut gltf = &bytes[from..];
    if !is_gltf(gltf) {
        let found = memchr::memmem::find(&bytes[header.min(bytes.len())..], b"glTF").map(|at| header + at);
        gltf = &bytes[found.ok_or_else(|| broken("a b3dm holds no glTF".into()))?..];
    }
    Ok((gltf, rtc_center(parts[0], parts[1])?))
}

/// `RTC_CENTER` of a feature table: as numbers, or as floats in the binary part.
fn rtc_center(json: &[u8], binary: &[u8]) -> Result<DVec3, Refusal> {
    let broken = |what: &str| Refusal::new("broken-b3dm", what.to_string());
    let end = json.iter().rposition(|&b| b != 0 && !b.is_ascii_whitespace()).map_or(0, |last| last + 1);
    if end == 0 {
        return Ok(DVec3::ZERO);
    }
    let table: Value = serde_json::from_slice(&json[..end]).map_err(|_| broken("the feature table is no JSON"))?;
    let numbers: Vec<f64> = match table.get("RTC_CENTER") {
        None => return Ok(DVec3::ZERO),
        Some(Value::Array(numbers)) => numbers.iter().filter_map(Value::as_f64).collect(),
        Some(reference) => {
            let offset = reference.get("byteOffset").and_then(Value::as_u64).unwrap_or(0);
            let offset = usize::try_from(offset).unwrap_or(usize::MAX);
            let read = |i: usize| word(binary, offset.checked_add(4 * i).filter(|&at| at < binary.len())?);
            (0..3).filter_map(read).map(|bits| f64::from(f32::from_bits(bits))).collect()
        }
    };
    match numbers[..] {
        [x, y, z] if x.is_finite() && y.is_finite() && z.is_finite() => Ok(DVec3::new(x, y, z)),
        _ => Err(broken("RTC_CENTER is not three numbers")),
    }
}

/// The tiles within. Kinds that are not read are left out with a warning as long as something else is there.
fn cmpt(bytes: &[u8], job: &Job<'_>, depth: u32) -> Result<Vec<TileMesh>, Refusal> {
    let cut = || Refusal::new("broken-cmpt", format!("a composite of {} bytes is cut short", bytes.len()));
    if depth >= MAX_COMPOSITES {
        return refuse("broken-cmpt", format!("composites are nested more than {MAX_COMPOSITES} deep"));
    }
    let length = word(bytes, 8).ok_or_else(cut)? as usize;
    let bytes = bytes.get(..length).ok_or_else(cut)?;
    let count = word(bytes, 12).ok_or_else(cut)?;
    let mut from = CMPT_HEADER_BYTES;
    let (mut meshes, mut refused, mut read) = (Vec::new(), None, 0u32);
    for _ in 0..count {
        let size = from.checked_add(8).and_then(|at| word(bytes, at)).ok_or_else(cut)? as usize;
        let end = from.checked_add(size).filter(|_| size >= CMPT_HEADER_BYTES - 4).ok_or_else(cut)?;
        let inner = bytes.get(from..end).ok_or_else(cut)?;
        match load_at(inner, job, depth + 1) {
            Ok(found) => {
                read += 1;
                meshes.extend(found);
            }
            Err(refusal) if matches!(refusal.code, "i3dm" | "pnts" | "vctr" | "geom") => {
                job.warn("composite-part-ignored", &format!("a part of a composite {}", refusal.what));
                refused.get_or_insert(refusal);
            }
            Err(refusal) => return Err(refusal),
        }
        from = end;
    }
    match refused {
        Some(refusal) if read == 0 => Err(refusal),
        _ => Ok(meshes),
    }
}
