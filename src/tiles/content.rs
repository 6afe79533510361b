//! Makes the content of one tile: measures it against its source, gives it its texture, and splits its wedges.
//!
//! In: a tile's surface and the [`Reference`] it stands for. Out: [`MadeTile`].
//!
//! Depends on the tile's own part of the source only, so tiles can be made in any order and at the same time. Where that
//! part does not fit into memory, finer tiles stand for it: their own certified error is added to every bound (the
//! triangle inequality), and the tile is painted from their textures.

use glam::{DVec3, Vec2, Vec3};
use serde::{Deserialize, Serialize};

use super::error::{Deviation, Figures, Surface as Measured, from_source, from_tile};
use super::levels::TileMesh;
use super::skirt::Hem;
use crate::geo::bounds::Aabb;
use crate::geo::bvh::Bvh;
use crate::geo::hash::BitsMap;
use crate::ids::{ClassId, ClassScheme};
use crate::input::Material;
use crate::texture::{BakeSource, Baked, Images, Surface, TextureConfig, bake, encode_jpeg, repack};
use crate::write::TileContent;
use crate::{Error, Result};

/// A tile ready to be written.
pub struct MadeTile {
    /// For the writer.
    pub content: TileContent,
    /// Box of the surface, local metres.
    pub bounds: Aabb,
    /// Certified two-sided distance to the source, metres: of a leaf, what the gate and rounding moved.
    pub geometry_m: f64,
    /// Of it, what f32 vertices moved.
    pub rounding_m: f64,
    /// Size of a texel, metres; 0 without texture.
    pub texel_m: f64,
    /// Size of a texel of what the tile was painted from; of a leaf its own.
    pub reference_texel_m: f64,
    /// Triangles of the surface.
    pub triangles: usize,
    /// Triangles of skirts.
    pub skirt_triangles: usize,
    /// Per class that occurs in the tile or its source.
    pub classes: Vec<ClassDeviation>,
    /// Texture coordinates of every corner of the tile's surface, in its atlas; empty without texture.
    pub corner_uvs: Vec<[Vec2; 3]>,
    /// Colour of every vertex of the tile's surface; empty with texture, or where the source has none.
    pub vertex_colors: Vec<[u8; 3]>,
}

/// How far one class is from its source in one tile.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct ClassDeviation {
    /// Which class.
    pub class: ClassId,
    /// Certified two-sided bound, metres.
    pub bound_m: f64,
    /// How far the tile sinks inside the source at most, along the source's normals, metres (certified).
    pub inside_m: f64,
    /// How much lower than the source the tile is at most, sideways within the bound, metres (certified).
    pub sunk_m: f64,
    /// Area-weighted figures, metres.
    pub figures: Figures,
}

/// What all tiles of a build share.
pub struct Maker<'a> {
    /// The classes.
    pub scheme: &'a ClassScheme,
    /// How textures are made.
    pub texture: &'a TextureConfig,
    /// Pixels of error at which the viewer swaps a tile: k in `geometricError` ≥ k·texel.
    pub texel_factor: f64,
    /// Passed on into every tile.
    pub copyright: Option<&'a str>,
    /// Write vertex normals.
    pub normals: bool,
    /// Furthest that any vertex of the source was moved before it came here, metres: added to every bound.
    pub moved_m: f64,
}

/// A surface a tile stands for, with vertices of its own; arrays that no face needs are empty.
#[derive(Debug, Clone, Default)]
pub struct Reference {
    /// Local metres.
    pub positions: Vec<DVec3>,
    /// Corners.
    pub faces: Vec<[u32; 3]>,
    /// Per face and corner.
    pub corner_uvs: Vec<[Vec2; 3]>,
    /// Per face, index into `materials`.
    pub face_material: Vec<u32>,
    /// Per vertex sRGB.
    pub vertex_colors: Vec<[u8; 3]>,
    /// Class of each face.
    pub labels: Vec<ClassId>,
    /// Referenced by `face_material`.
    pub materials: Vec<Material>,
    /// Per class, how far the surface is from the source's; empty for the source itself.
    pub apart: Vec<Apart>,
}

/// How far a surface is from the source's, certified, metres.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Apart {
    /// Both ways.
    pub bound_m: f64,
    /// Along the source's normals.
    pub inside_m: f64,
    /// Straight down, sideways within the bound.
    pub sunk_m: f64,
}

/// How large a tile may be.
pub struct Fit<'a> {
    /// Largest atlas side, texels.
    pub atlas_px: u32,
    /// The tile's file has at most this many bytes, as far as a smaller texture can do it.
    pub most_bytes: u64,
    /// Encodes the file.
    pub encode: &'a dyn Fn(&TileContent) -> Vec<u8>,
}

/// Atlases are not made smaller than this for the sake of bytes, texels.
const LEAST_ATLAS_PX: u32 = 256;

impl Fit<'_> {
    /// The atlas side at which a tile too large with one of `side_px` should fit; none if it fits, or cannot.
    fn smaller(&self, made: &MadeTile, file: &[u8], side_px: u32) -> Option<u32> {
        let bytes = file.len() as u64;
        let atlas = made.content.atlas.as_ref().map_or(0, |a| a.len() as u64);
        if bytes <= self.most_bytes || atlas == 0 || side_px <= LEAST_ATLAS_PX {
            return None;
        }
        let wanted = (self.most_bytes + atlas).saturating_sub(bytes) as f64 / atlas as f64;
        // Bytes fall a little slower than texels do.
        let px = 0.95 * wanted.sqrt() * f64::from(side_px);
        Some((px as u32).clamp(LEAST_ATLAS_PX, side_px - 1))
    }
}

impl Maker<'_> {
    /// Makes a leaf: the source itself, its texels copied. `images` cover it.
    ///
    /// # Errors
    /// Only a broken promise of the texture stage.
    pub fn make_leaf(&self, source: &Reference, hem: &Hem, images: &Images) -> Result<MadeTile> {
        let paint = source.is_painted().then(|| repack(&source.surface(), images, self.texture)).transpose()?;
        let quality = self.texture.jpeg_quality;
        let exact = source.labels.iter().fold(vec![false; self.scheme.len()], |mut seen, l| {
            seen[l.index()] = true;
            seen
        });
        let classes = (self.scheme.ids().filter(|c| exact[c.index()]))
            .map(|class| ClassDeviation {
                class,
                bound_m: 0.0,
                inside_m: 0.0,
                sunk_m: 0.0,
                figures: Figures::default(),
            })
            .collect();
        Ok(self.assemble(source, paint, quality, (0.0, self.moved_m), classes, hem))
    }

    /// Makes an inner tile and its file: the simplified surface, measured against what it stands for and painted from it.
    /// `images` cover the reference.
    ///
    /// # Errors
    /// Only a broken promise of the texture stage.
    pub fn make_inner(
        &self,
        mesh: &TileMesh,
        source: &Reference,
        hem: &Hem,
        images: &Images,
        fit: &Fit,
    ) -> Result<(MadeTile, Vec<u8>)> {
        let tree = Bvh::new(&source.positions, &source.faces);
        let (classes, geometry_m) = self.measure(mesh, source, &tree);
        let mut patch = Reference {
            positions: mesh.positions.clone(),
            faces: mesh.faces.clone(),
            labels: mesh.labels.clone(),
            ..Reference::default()
        };
        // The errors of finer tiles hold what was moved already.
        let moved_m = if source.apart.is_empty() { self.moved_m } else { 0.0 };
        let quality = self.texture.coarse_jpeg_quality;
        if !source.is_painted() {
            patch.vertex_colors = nearest_colors(&mesh.positions, source, &tree);
            let made = self.assemble(&patch, None, quality, (geometry_m, moved_m), classes, hem);
            let file = (fit.encode)(&made.content);
            return Ok((made, file));
        }
        let reference_texel_m = source.surface().texel_m(images);
        let texel_m = (geometry_m / self.texel_factor).max(reference_texel_m);
        let from = BakeSource { surface: source.surface(), bvh: &tree };
        let mut max_atlas_px = fit.atlas_px.min(self.texture.max_atlas_px);
        let mut larger = None;
        loop {
            let config = TextureConfig { max_atlas_px, ..self.texture.clone() };
            let paint = match (bake(&patch.surface(), &from, images, texel_m, &config), larger.take()) {
                // Gutters alone leave no room. What fitted stays, however large; what never did gets more.
                (Err(Error::Config(_)), Some(made)) => return Ok(made),
                (Err(Error::Config(_)), None) if max_atlas_px < self.texture.max_atlas_px => {
                    max_atlas_px = max_atlas_px.saturating_mul(2).min(self.texture.max_atlas_px);
                    continue;
                }
                (paint, _) => paint?,
            };
            let side_px = paint.atlas.width().max(paint.atlas.height());
            let made = self.assemble(&patch, Some(paint), quality, (geometry_m, moved_m), classes.clone(), hem);
            let file = (fit.encode)(&made.content);
            let smaller = fit.smaller(&made, &file, side_px);
            let made = (MadeTile { reference_texel_m, ..made }, file);
            match smaller {
                Some(px) => (max_atlas_px, larger) = (px, Some(made)),
                None => return Ok(made),
            }
        }
    }

    fn measure(&self, mesh: &TileMesh, source: &Reference, source_tree: &Bvh) -> (Vec<ClassDeviation>, f64) {
        let count = self.scheme.len();
        let fine = Measured { positions: &source.positions, faces: &source.faces, labels: &source.labels };
        let coarse = Measured { positions: &mesh.positions, faces: &mesh.faces, labels: &mesh.labels };
        let forward = from_source(fine, coarse, &Bvh::new(&mesh.positions, &mesh.faces), count);
        let backward = from_tile(coarse, fine, source_tree, &known(&forward, &source.apart));
        let apart = chained(&forward, &backward, &source.apart);
        let both = forward.into_iter().zip(backward).map(|(f, b)| Deviation::two_sided(f, b));
        let classes: Vec<ClassDeviation> = (self.scheme.ids().zip(both).zip(apart))
            // A class that the reference lost is still the source's.
            .filter(|((class, d), _)| !d.is_empty() || source.apart.get(class.index()).is_some_and(|a| a.bound_m > 0.0))
            .map(|((class, d), Apart { bound_m, inside_m, sunk_m })| ClassDeviation {
                class,
                bound_m,
                inside_m,
                sunk_m,
                figures: d.figures(),
            })
            .collect();
        let worst = classes.iter().map(|c| c.bound_m).fold(0.0, f64::max);
        (classes, worst)
    }

    /// Splits vertices where texture coordinates or classes differ, and puts all relative to the tile's origin.
    fn assemble(
        &self,
        patch: &Reference,
        paint: Option<Baked>,
        quality: u8,
        (geometry_m, moved_m): (f64, f64),
        classes: Vec<ClassDeviation>,
        hem: &Hem,
    ) -> MadeTile {
        let bounds = Aabb::of(patch.positions.iter().copied());
        // Origins on a coarse grid print short and are exact in f32.
        let origin = (bounds.center() * ORIGINS_PER_M).round() / ORIGINS_PER_M;
        let texel_m = paint.as_ref().map_or(0.0, |p| p.texel_m);
        let mut content =
            TileContent { origin, copyright: self.copyright.map(str::to_owned), ..TileContent::default() };
        let mut wedges: BitsMap<(u32, [u32; 2], ClassId), u32> = BitsMap::default();
        let normals = if self.normals { patch.vertex_normals() } else { Vec::new() };
        for (f, face) in patch.faces.iter().enumerate() {
            let label = patch.labels[f];
            let corner = |k: usize| {
                let v = face[k];
                let uv = paint.as_ref().map_or(Vec2::ZERO, |p| p.corner_uvs[f][k]);
                *wedges.entry((v, uv.to_array().map(f32::to_bits), label)).or_insert_with(|| {
                    content.positions.push((patch.positions[v as usize] - origin).as_vec3());
                    content.class_of_vertex.push(label);
                    if paint.is_some() {
                        content.uvs.push(uv);
                    } else {
                        content
                            .colors
                            .push(patch.vertex_colors.get(v as usize).copied().unwrap_or(self.scheme[label].color));
                    }
                    if let Some(normal) = normals.get(v as usize) {
                        content.normals.push(normal.as_vec3());
                    }
                    content.positions.len() as u32 - 1
                })
            };
            content.faces.push([0, 1, 2].map(corner));
        }
        let triangles = content.faces.len();
        hang(&mut content, hem);
        content.atlas = paint.as_ref().map(|p| encode_jpeg(&p.atlas, quality));
        // What a viewer sees: f32 vertices about the origin.
        let seen = |p: DVec3| origin + (p - origin).as_vec3().as_dvec3();
        let rounding_m = patch.positions.iter().map(|p| (seen(*p) - *p).length()).fold(0.0, f64::max);
        let added_m = moved_m + rounding_m;
        let moved = |c: ClassDeviation| ClassDeviation {
            bound_m: c.bound_m + added_m,
            inside_m: c.inside_m + added_m,
            sunk_m: c.sunk_m + added_m,
            ..c
        };
        let classes = classes.into_iter().map(moved).collect();
        MadeTile {
            bounds: Aabb::of(content.positions.iter().map(|p| origin + p.as_dvec3())),
            geometry_m: geometry_m + added_m,
            rounding_m,
            texel_m,
            reference_texel_m: texel_m,
            triangles,
            skirt_triangles: content.faces.len() - triangles,
            classes,
            content,
            corner_uvs: paint.map_or_else(Vec::new, |p| p.corner_uvs),
            vertex_colors: patch.vertex_colors.clone(),
        }
    }
}

/// Adds skirts: vertices and faces of their own at the end, which take class, texture coordinates, colours and normals
/// from the edges they hang from.
fn hang(content: &mut TileContent, hem: &Hem) {
    let first = content.positions.len();
    let mut made: BitsMap<(u32, [u32; 3]), u32> = BitsMap::default();
    for strip in &hem.strips {
        let face = content.faces[strip.face as usize];
        let corners = [0, 1].map(|k| face[(usize::from(strip.corner) + k) % 3]);
        let edge = corners.map(|v| content.positions[v as usize]);
        let below = strip.below.map(|p| (p - content.origin).as_vec3());
        let mut vertex = |of: u32, at: Vec3| {
            *made.entry((of, at.to_array().map(f32::to_bits))).or_insert_with(|| {
                let v = of as usize;
                content.positions.push(at);
                content.class_of_vertex.push(content.class_of_vertex[v]);
                if let Some(&uv) = content.uvs.get(v) {
                    content.uvs.push(uv);
                }
                if let Some(&color) = content.colors.get(v) {
                    content.colors.push(color);
                }
                if let Some(&normal) = content.normals.get(v) {
                    content.normals.push(normal);
                }
                content.positions.len() as u32 - 1
            })
        };
        let tops = [0, 1].map(|k| vertex(corners[k], edge[k]));
        let feet = [0, 1].map(|k| vertex(corners[k], below[k]));
        // The edge runs the other way round, so that both faces look out of the solid and the cell.
        let triangles = [[tops[1], tops[0], feet[0]], [tops[1], feet[0], feet[1]]];
        content.faces.extend(triangles.into_iter().filter(|[a, b, c]| a != b && b != c && c != a));
    }
    content.skirt_vertices = content.positions.len() - first;
}

/// Tile origins are multiples of 1/8 m.
const ORIGINS_PER_M: f64 = 8.0;

/// Per class the distance from the source, by way of a reference that is `apart` from it: a point of class c of the source
/// has a point of the reference, of whatever class, as near as that says for c; a point of the tile is nearest to some
/// point of the reference, again of whatever class. What a tile sinks adds up straight down, and along the source's
/// normals by its whole distance from the reference.
fn chained(forward: &[Deviation], backward: &[Deviation], apart: &[Apart]) -> Vec<Apart> {
    let worst = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
    let forward_m = worst(&mut forward.iter().map(|d| d.upper_m));
    let sunk_m = worst(&mut forward.iter().map(|d| d.sunk_m));
    let reference_m = worst(&mut apart.iter().map(|a| a.bound_m));
    let of_class = |(c, (f, b)): (usize, (&Deviation, &Deviation))| match apart.get(c) {
        Some(own) => Apart {
            bound_m: (own.bound_m + forward_m).max(b.upper_m + reference_m),
            inside_m: own.inside_m + forward_m,
            sunk_m: own.sunk_m + sunk_m,
        },
        None => Apart { bound_m: f.upper_m.max(b.upper_m), inside_m: f.inside_m, sunk_m: f.sunk_m },
    };
    forward.iter().zip(backward).enumerate().map(of_class).collect()
}

/// Per class, how far the tile may be from the reference without adding to what the other direction says already.
fn known(forward: &[Deviation], apart: &[Apart]) -> Vec<f64> {
    let blank = vec![Deviation::default(); forward.len()];
    let reference_m = apart.iter().map(|a| a.bound_m).fold(0.0, f64::max);
    // Rounded down: the sum of both is not to be more than what is known.
    chained(forward, &blank, apart).iter().map(|a| ((a.bound_m - reference_m) * (1.0 - 1e-12)).max(0.0)).collect()
}

impl Reference {
    /// Adds a part; materials and errors are the whole's.
    pub fn append(&mut self, part: Self) {
        let first = self.positions.len() as u32;
        let faces = self.faces.len();
        // A part without what others have still needs its places.
        if !part.corner_uvs.is_empty() || !self.corner_uvs.is_empty() {
            self.corner_uvs.resize(faces, Default::default());
            self.corner_uvs.extend(part.corner_uvs);
            self.corner_uvs.resize(faces + part.faces.len(), Default::default());
        }
        if !part.vertex_colors.is_empty() || !self.vertex_colors.is_empty() {
            self.vertex_colors.resize(self.positions.len(), [128; 3]);
            self.vertex_colors.extend(part.vertex_colors);
            self.vertex_colors.resize(self.positions.len() + part.positions.len(), [128; 3]);
        }
        self.positions.extend(part.positions);
        self.faces.extend(part.faces.into_iter().map(|f| f.map(|v| v + first)));
        self.face_material.extend(part.face_material);
        self.labels.extend(part.labels);
    }

    /// For the texture stage.
    pub fn surface(&self) -> Surface<'_> {
        Surface {
            positions: &self.positions,
            faces: &self.faces,
            corner_uvs: &self.corner_uvs,
            face_material: &self.face_material,
            vertex_colors: &self.vertex_colors,
            materials: &self.materials,
        }
    }

    /// True where any face has an image; a surface in plain colours needs no atlas.
    pub fn is_painted(&self) -> bool {
        self.surface().is_painted()
    }

    fn cross(&self, f: usize) -> DVec3 {
        let [a, b, c] = self.faces[f].map(|v| self.positions[v as usize]);
        (b - a).cross(c - a)
    }

    /// Area-weighted unit normals.
    fn vertex_normals(&self) -> Vec<DVec3> {
        let mut sums = vec![DVec3::ZERO; self.positions.len()];
        for (f, face) in self.faces.iter().enumerate() {
            face.iter().for_each(|&v| sums[v as usize] += self.cross(f));
        }
        sums.into_iter().map(|n| n.try_normalize().unwrap_or(DVec3::Z)).collect()
    }
}

/// Colours of the nearest source points; empty where the source has none.
fn nearest_colors(positions: &[DVec3], source: &Reference, tree: &Bvh) -> Vec<[u8; 3]> {
    if source.vertex_colors.is_empty() {
        return Vec::new();
    }
    let nearest_corner = |p: &DVec3| {
        let hit = tree.closest(*p, f64::INFINITY)?;
        let face = source.faces[hit.face as usize];
        let by_distance = |a: &u32, b: &u32| {
            let d = |v: u32| (source.positions[v as usize] - hit.point).length_squared();
            d(*a).total_cmp(&d(*b))
        };
        face.into_iter().min_by(by_distance)
    };
    positions.iter().map(|p| nearest_corner(p).map_or([128; 3], |v| source.vertex_colors[v as usize])).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use image::{Rgb, RgbImage};

    use super::*;
    use crate::input::ImageRef;
    use crate::report::Reporter;

    #[test]
    fn a_texture_of_too_many_charts_is_larger_than_wished_and_no_failure() {
        // Faces that lie apart have charts of their own, and charts have gutters.
        let corner = |f: usize, k: usize| {
            DVec3::new((f % 60) as f64 * 3.0 + [0.0, 1.0, 0.0][k], (f / 60) as f64 * 3.0 + [0.0, 0.0, 1.0][k], 0.0)
        };
        let positions: Vec<DVec3> = (0..3000).flat_map(|f| (0..3).map(move |k| corner(f, k))).collect();
        let faces: Vec<[u32; 3]> = (0..3000).map(|f| [3 * f, 3 * f + 1, 3 * f + 2]).collect();
        let labels = vec![ClassId::ROOF; faces.len()];
        let mesh = TileMesh { positions: positions.clone(), faces: faces.clone(), labels: labels.clone() };
        let source = Reference {
            positions,
            corner_uvs: vec![[Vec2::ZERO, Vec2::X, Vec2::Y]; faces.len()],
            face_material: vec![0; faces.len()],
            materials: vec![Material { name: "all".into(), base_color: [0; 3], image: Some(0) }],
            faces,
            labels,
            ..Reference::default()
        };
        let reporter = Reporter::new(true);
        let mut images =
            Images::new(vec![ImageRef::Pixels(Arc::new(RgbImage::from_pixel(64, 64, Rgb([90, 160, 30]))))], &reporter);
        images.cover(&source.surface());
        let (scheme, texture) = (ClassScheme::default(), TextureConfig::default());
        let maker = Maker {
            scheme: &scheme,
            texture: &texture,
            texel_factor: 16.0,
            copyright: None,
            normals: false,
            moved_m: 0.0,
        };
        let encode = |content: &TileContent| content.atlas.clone().unwrap_or_default();
        let side_px = |atlas_px: u32, most_bytes: u64| {
            let fit = Fit { atlas_px, most_bytes, encode: &encode };
            let (made, _) = maker.make_inner(&mesh, &source, &Hem::default(), &images, &fit).unwrap();
            let atlas = image::load_from_memory(&made.content.atlas.unwrap()).unwrap();
            atlas.width().max(atlas.height())
        };
        assert!(side_px(64, 1 << 30) > 256, "the first that its charts fit into");
        assert!(side_px(2048, 1) > 256, "the last that they did fit into");
    }
}
