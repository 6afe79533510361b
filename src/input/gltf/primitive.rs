//! One primitive under one transform becomes one [`Part`].

use glam::{DVec3, Vec2};

use super::accessor::{Elements, Use};
use super::data::Data;
use super::material::{Paint, Palette, srgb};
use super::scene::Instance;
use super::schema::{Int, Primitive, TextureTransform};
use crate::input::{Part, Source};
use crate::report::Reporter;
use crate::{Error, Result};

const TRIANGLES: u64 = 4;
const STRIP: u64 = 5;
const FAN: u64 = 6;

/// Geometry that primitives and nodes share may be repeated to this many corners over what the buffers hold.
const MAX_REPEATED_CORNERS: u64 = 20_000_000;

/// What the primitives of one file have in common.
pub struct Builder<'a> {
    pub data: &'a Data<'a>,
    pub palette: Palette<'a>,
    pub reporter: &'a Reporter,
    /// Added to positions after they are turned z-up (`CESIUM_RTC`).
    pub center: DVec3,
    /// Corners read so far.
    pub corners: u64,
}

impl<'a> Builder<'a> {
    /// Adds `primitive` as `instance` places it; nothing if it has no triangles.
    pub fn add(&mut self, primitive: &Primitive, instance: &Instance, source: &mut Source) -> Result<()> {
        let (data, reporter) = (self.data, self.reporter);
        let skip = |what: String| reporter.warn("skipped-primitive", data.path, what);
        // One that is skipped costs a little too, or it could be repeated for ever.
        self.charge(1)?;
        let mode = primitive.mode.map_or(TRIANGLES, |mode| mode.0);
        match mode {
            0..TRIANGLES => {
                skip(format!("a primitive of points or lines (mode {mode}) was skipped"));
                return Ok(());
            }
            TRIANGLES..=FAN => {}
            _ => return Err(data.refuse(format!("primitive mode {mode} does not exist"))),
        }
        let Some(&position) = primitive.attributes.get("POSITION") else {
            skip("a primitive without POSITION was skipped".into());
            return Ok(());
        };
        let positions = Elements::of(data, position, Use::Position)?;
        if positions.is_virtual() && primitive.extensions.draco.is_some() {
            return Err(super::draco(data.path));
        }
        let faces = self.faces(primitive, mode, &positions)?;
        let paint = self.palette.paint(primitive.material)?;
        let uvs = self.uvs(primitive, &paint, positions.count)?;
        let colors = self.attribute(primitive, "COLOR_0", Use::Color, positions.count)?;
        let overlays = [Some(&positions), uvs.as_ref(), colors.as_ref()].into_iter().flatten();
        self.charge(overlays.map(Elements::sparse_count).sum())?;

        let mut part = Part { path: data.path.to_path_buf(), ..Part::default() };
        let used = self.place(&faces, &positions, instance, &mut part);
        if part.faces.is_empty() {
            return Ok(());
        }
        let material = self.palette.place(primitive.material, uvs.is_some(), source)?;
        part.face_material = vec![material; part.faces.len()];
        if let Some(colors) = colors {
            let color = |&vertex: &u32| {
                let linear = colors.get::<3>(vertex);
                std::array::from_fn(|k| srgb(linear[k] * paint.factor[k]))
            };
            part.vertex_colors = used.iter().map(color).collect();
        }
        // The material may have lost its image: then there is nothing to look up.
        if let Some(uvs) = uvs.filter(|_| source.materials[material as usize].image.is_some()) {
            self.lay(&uvs, paint.transform, &used, &mut part);
        }
        source.parts.push(part);
        Ok(())
    }

    /// Counts work done against what the buffers read so far can honestly ask for.
    pub fn charge(&mut self, corners: u64) -> Result<()> {
        self.corners = self.corners.saturating_add(corners);
        let limit = self.data.loaded_bytes().saturating_add(MAX_REPEATED_CORNERS);
        if self.corners > limit {
            let what = format!("shared geometry is repeated to over {limit} corners; split the file");
            return Err(Error::Limit { path: self.data.path.into(), what });
        }
        Ok(())
    }

    /// Triangles as indices below the vertex count, in the winding of the file.
    pub fn faces(&mut self, primitive: &Primitive, mode: u64, positions: &Elements<'_>) -> Result<Vec<[u32; 3]>> {
        let data = self.data;
        let indices = primitive.indices.map(|index| Elements::of(data, index, Use::Indices)).transpose()?;
        let corners = indices.as_ref().map_or(positions.count, |indices| indices.count);
        self.charge(corners + indices.as_ref().map_or(0, Elements::sparse_count))?;
        let mut restarts = 0;
        let mut stops = Vec::new();
        let mut list = Vec::with_capacity(corners as usize);
        for i in 0..corners as u32 {
            let Some(indices) = &indices else {
                list.push(i);
                continue;
            };
            let vertex = indices.index(i);
            if vertex == indices.restart() {
                restarts += 1;
                // A list has no strips to end: its triangle is lost, told by an index no vertex has.
                if mode == TRIANGLES { list.push(u32::MAX) } else { stops.push(list.len()) }
            } else if u64::from(vertex) < positions.count {
                list.push(vertex);
            } else {
                let accessor = primitive.indices.map_or(0, |index| index.0);
                let what =
                    format!("accessor {accessor}: index {vertex} at {i}, but there are {} vertices", positions.count);
                return Err(data.refuse(what));
            }
        }
        let what = "an index is the primitive restart value, which glTF forbids; its triangle was dropped";
        self.reporter.warn_many("primitive-restart", data.path, restarts, what);
        if mode == TRIANGLES && !list.len().is_multiple_of(3) {
            let what = format!("a triangle list has {} indices; the last {} were dropped", list.len(), list.len() % 3);
            self.reporter.warn("trailing-indices", data.path, what);
        }
        Ok(triangles(mode, &list, &stops))
    }

    /// Fills positions and faces of `part`; returns the vertices used, ascending.
    fn place(&self, faces: &[[u32; 3]], positions: &Elements<'_>, instance: &Instance, part: &mut Part) -> Vec<u32> {
        let (mut used, mut kept) = compact(faces);
        let place = |&vertex: &u32| {
            let scene = instance.scene_from_mesh.transform_point3(DVec3::from_array(positions.get(vertex)));
            // y up to z up.
            DVec3::new(scene.x, -scene.z, scene.y) + self.center
        };
        part.positions = used.iter().map(place).collect();
        if !part.positions.iter().all(|point| point.is_finite()) {
            kept.retain(|face| face.iter().all(|&vertex| part.positions[vertex as usize].is_finite()));
            let (still, compacted) = compact(&kept);
            part.positions = still.iter().map(|&vertex| part.positions[vertex as usize]).collect();
            used = still.iter().map(|&vertex| used[vertex as usize]).collect();
            kept = compacted;
            let what = "a position is not finite; the faces that use it were dropped";
            self.reporter.warn_many("bad-vertex", self.data.path, (faces.len() - kept.len()) as u64, what);
        }
        if instance.scene_from_mesh.determinant() < 0.0 {
            kept.iter_mut().for_each(|face| face.swap(1, 2));
        }
        part.faces = kept;
        used
    }

    fn uvs(&self, primitive: &Primitive, paint: &Paint, count: u64) -> Result<Option<Elements<'a>>> {
        let Some(set) = paint.uv_set else { return Ok(None) };
        let uvs = self.attribute(primitive, &format!("TEXCOORD_{set}"), Use::Uv, count)?;
        if uvs.is_none() {
            let what = format!("a textured primitive has no TEXCOORD_{set}; its faces are grey");
            self.reporter.warn("missing-uv", self.data.path, what);
        }
        Ok(uvs)
    }

    pub fn attribute(&self, primitive: &Primitive, name: &str, usage: Use, count: u64) -> Result<Option<Elements<'a>>> {
        let Some(&index) = primitive.attributes.get(name) else { return Ok(None) };
        let elements = Elements::of(self.data, index, usage)?;
        if elements.count < count {
            let Int(index) = index;
            let what = format!("accessor {index}: {name} has {} elements for {count} vertices", elements.count);
            return Err(self.data.refuse(what));
        }
        Ok(Some(elements))
    }

    /// Fills the corner UVs of `part`, whose vertices are `used`.
    fn lay(&self, uvs: &Elements<'_>, transform: Option<TextureTransform>, used: &[u32], part: &mut Part) {
        let mut bad = 0;
        let mut lay = |&vertex: &u32| {
            let uv = moved(uvs.get(vertex), transform);
            if uv.is_finite() {
                uv
            } else {
                bad += 1;
                Vec2::ZERO
            }
        };
        let vertex_uvs: Vec<Vec2> = used.iter().map(&mut lay).collect();
        part.corner_uvs = part.faces.iter().map(|face| face.map(|vertex| vertex_uvs[vertex as usize])).collect();
        let what = "a texture coordinate is not finite; (0, 0) is used";
        self.reporter.warn_many("bad-uv", self.data.path, bad, what);
    }
}

/// `KHR_texture_transform`: scale, then rotation (counter-clockwise as seen, with v down), then offset.
pub fn moved([u, v]: [f64; 2], transform: Option<TextureTransform>) -> Vec2 {
    let Some(transform) = transform else { return Vec2::new(u as f32, v as f32) };
    let [scale_u, scale_v] = transform.scale.unwrap_or([1.0; 2]);
    let [offset_u, offset_v] = transform.offset.unwrap_or_default();
    let (sin, cos) = transform.rotation.unwrap_or(0.0).sin_cos();
    let (u, v) = (u * scale_u, v * scale_v);
    Vec2::new((cos * u + sin * v + offset_u) as f32, (cos * v - sin * u + offset_v) as f32)
}

/// The vertices `faces` use, ascending, and the faces in terms of their ranks.
///
/// Exporters put many primitives into one vertex buffer; only what a primitive uses is looked at.
pub fn compact(faces: &[[u32; 3]]) -> (Vec<u32>, Vec<[u32; 3]>) {
    /// A table over the range of indices is faster than sorting them unless it is this much larger than they are.
    const MAX_TABLE_RATIO: usize = 8;
    let corners = faces.as_flattened();
    let (Some(&first), Some(&last)) = (corners.iter().min(), corners.iter().max()) else {
        return (Vec::new(), Vec::new());
    };
    let range = (last - first) as usize + 1;
    if range / MAX_TABLE_RATIO > corners.len() {
        let mut used = corners.to_vec();
        used.sort_unstable();
        used.dedup();
        let rank = |vertex| used.partition_point(|&other| other < vertex) as u32;
        let ranked = faces.iter().map(|face| face.map(rank)).collect();
        return (used, ranked);
    }
    let mut rank = vec![u32::MAX; range];
    corners.iter().for_each(|&vertex| rank[(vertex - first) as usize] = 0);
    let mut used = Vec::new();
    for (vertex, rank) in (first..=last).zip(&mut rank).filter(|(_, rank)| **rank == 0) {
        *rank = used.len() as u32;
        used.push(vertex);
    }
    let ranked = faces.iter().map(|face| face.map(|vertex| rank[(vertex - first) as usize])).collect();
    (used, ranked)
}

/// Triangles of a list, strip or fan; strips and fans end at each of `stops`.
fn triangles(mode: u64, list: &[u32], stops: &[usize]) -> Vec<[u32; 3]> {
    if mode == TRIANGLES {
        return list.as_chunks::<3>().0.iter().filter(|face| !face.contains(&u32::MAX)).copied().collect();
    }
    let mut faces = Vec::with_capacity(list.len());
    let mut start = 0;
    for &stop in stops.iter().chain([&list.len()]) {
        let run = &list[start..stop];
        if mode == STRIP {
            // Every other triangle of a strip is wound the other way round.
            let turned = |(i, w): (usize, &[u32])| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[0], w[2], w[1]] };
            faces.extend(run.windows(3).enumerate().map(turned));
        } else if let Some((&hub, rim)) = run.split_first() {
            faces.extend(rim.windows(2).map(|w| [w[0], w[1], hub]));
        }
        start = stop;
    }
    // Strips are stitched together with triangles of no area.
    faces.retain(|[a, b, c]| a != b && b != c && c != a);
    faces
}
