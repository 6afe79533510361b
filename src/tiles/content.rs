//! Makes the content of one tile: measures it against its source, gives it its texture, and splits its wedges.
//!
//! In: a [`Tile`](super::levels::Tile) and the partition it was cut from. Out: [`MadeTile`].
//!
//! Depends on the tile's own part of the source only, so tiles can be made in any order and at the same time.

use std::collections::HashMap;
use std::ops::Range;

use glam::{DVec3, Vec2, Vec3};

use super::error::{Deviation, Figures, Surface as Measured, directed};
use super::levels::Tile;
use super::partition::Partition;
use super::skirt::Hem;
use crate::Result;
use crate::classes::Classes;
use crate::geo::bounds::Aabb;
use crate::geo::bvh::Bvh;
use crate::ids::ClassId;
use crate::texture::{BakeSource, Baked, Images, Surface, TextureConfig, bake, encode_jpeg, repack};
use crate::write::TileContent;

/// A tile ready to be written.
pub struct MadeTile {
    /// For the writer.
    pub content: TileContent,
    /// Box of the surface, local metres.
    pub bounds: Aabb,
    /// Certified two-sided distance to the source, metres: of a leaf, what the gate and rounding moved.
    pub geometry_m: f64,
    /// Size of a texel, metres; 0 without texture.
    pub texel_m: f64,
    /// Triangles of the surface.
    pub triangles: usize,
    /// Triangles of skirts.
    pub skirt_triangles: usize,
    /// Per class that occurs in the tile or its source.
    pub classes: Vec<ClassDeviation>,
}

/// How far one class is from its source in one tile.
#[derive(Debug, Clone, Copy)]
pub struct ClassDeviation {
    /// Which class.
    pub class: ClassId,
    /// Certified two-sided bound, metres.
    pub bound_m: f64,
    /// How far the tile sinks inside the source at most, along the source's normals, metres (certified).
    pub inside_m: f64,
    /// How much lower than the source the tile is at most, metres (certified).
    pub sunk_m: f64,
    /// Area-weighted figures, metres.
    pub figures: Figures,
}

/// What all tiles of a build share.
pub struct Maker<'a> {
    /// The cut source.
    pub partition: &'a Partition,
    /// Classes of the partition's faces.
    pub classes: &'a Classes,
    /// The source's images.
    pub images: &'a Images<'a>,
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

/// Part of the source, with vertices of its own.
struct Patch {
    positions: Vec<DVec3>,
    faces: Vec<[u32; 3]>,
    uvs: Vec<[Vec2; 3]>,
    materials: Vec<u32>,
    colors: Vec<[u8; 3]>,
    labels: Vec<ClassId>,
}

impl Maker<'_> {
    /// Makes one tile with its skirts.
    ///
    /// # Errors
    /// Only a broken promise of the texture stage.
    pub fn make(&self, tile: &Tile, hem: &Hem) -> Result<MadeTile> {
        let source = self.patch(&tile.source);
        match &tile.mesh {
            None => self.make_leaf(&source, hem),
            Some(_) => self.make_inner(tile, &source, hem),
        }
    }

    /// The source itself, its texels copied.
    fn make_leaf(&self, source: &Patch, hem: &Hem) -> Result<MadeTile> {
        let paint = source
            .surface(self)
            .is_painted()
            .then(|| repack(&source.surface(self), self.images, self.texture))
            .transpose()?;
        let quality = self.texture.jpeg_quality;
        let exact = source.labels.iter().fold(vec![false; self.classes.scheme.len()], |mut seen, l| {
            seen[l.index()] = true;
            seen
        });
        let classes = (self.classes.scheme.ids().filter(|c| exact[c.index()]))
            .map(|class| ClassDeviation {
                class,
                bound_m: 0.0,
                inside_m: 0.0,
                sunk_m: 0.0,
                figures: Figures::default(),
            })
            .collect();
        Ok(self.assemble(source, paint, quality, 0.0, classes, hem))
    }

    /// The simplified surface, measured against its source and painted from it.
    fn make_inner(&self, tile: &Tile, source: &Patch, hem: &Hem) -> Result<MadeTile> {
        let mesh = tile.mesh.as_ref().unwrap_or_else(|| unreachable!("inner tiles have a surface"));
        let tree = Bvh::new(&source.positions, &source.faces);
        let (classes, geometry_m) = self.measure(mesh, source, &tree);
        let mut patch = Patch {
            positions: mesh.positions.clone(),
            faces: mesh.faces.clone(),
            labels: mesh.labels.clone(),
            uvs: Vec::new(),
            materials: Vec::new(),
            colors: Vec::new(),
        };
        let painted = source.surface(self).is_painted();
        let config = TextureConfig { max_atlas_px: self.atlas_px(tile), ..self.texture.clone() };
        let paint = if painted {
            let texel_m = (geometry_m / self.texel_factor).max(source.surface(self).texel_m(self.images));
            let from = BakeSource { surface: source.surface(self), bvh: &tree };
            Some(bake(&patch.surface(self), &from, self.images, texel_m, &config)?)
        } else {
            patch.colors = nearest_colors(&mesh.positions, source, &tree);
            None
        };
        Ok(self.assemble(&patch, paint, self.texture.coarse_jpeg_quality, geometry_m, classes, hem))
    }

    /// The first view is one tile: its texture is kept small.
    fn atlas_px(&self, tile: &Tile) -> u32 {
        let px = if tile.level == 0 { self.texture.root_atlas_px } else { self.texture.coarse_atlas_px };
        px.min(self.texture.max_atlas_px)
    }

    fn measure(&self, mesh: &super::TileMesh, source: &Patch, source_tree: &Bvh) -> (Vec<ClassDeviation>, f64) {
        let count = self.classes.scheme.len();
        let fine = Measured { positions: &source.positions, faces: &source.faces, labels: &source.labels };
        let coarse = Measured { positions: &mesh.positions, faces: &mesh.faces, labels: &mesh.labels };
        let forward = directed(fine, coarse, &Bvh::new(&mesh.positions, &mesh.faces), count, true);
        let backward = directed(coarse, fine, source_tree, count, false);
        let both = forward.into_iter().zip(backward).map(|(f, b)| Deviation::two_sided(f, b));
        let classes: Vec<ClassDeviation> = (self.classes.scheme.ids().zip(both))
            .filter(|(_, d)| !d.is_empty())
            .map(|(class, d)| ClassDeviation {
                class,
                bound_m: d.upper_m,
                inside_m: d.inside_m,
                sunk_m: d.sunk_m,
                figures: d.figures(),
            })
            .collect();
        let worst = classes.iter().map(|c| c.bound_m).fold(0.0, f64::max);
        (classes, worst)
    }

    /// Gathers faces with the vertices they use.
    fn patch(&self, ranges: &[Range<usize>]) -> Patch {
        let mesh = &self.partition.mesh;
        let all = || ranges.iter().flat_map(|r| r.clone());
        let mut used: Vec<u32> = all().flat_map(|f| mesh.faces[f]).collect();
        used.sort_unstable();
        used.dedup();
        let local = |v: u32| used.binary_search(&v).unwrap_or_else(|_| unreachable!("every corner was listed")) as u32;
        let of_vertices = |f: &dyn Fn(u32) -> [u8; 3]| used.iter().map(|&v| f(v)).collect();
        Patch {
            positions: used.iter().map(|&v| mesh.positions[v as usize]).collect(),
            faces: all().map(|f| mesh.faces[f].map(local)).collect(),
            uvs: if mesh.corner_uvs.is_empty() { Vec::new() } else { all().map(|f| mesh.corner_uvs[f]).collect() },
            materials: all().map(|f| mesh.face_material[f]).collect(),
            colors: if mesh.vertex_colors.is_empty() {
                Vec::new()
            } else {
                of_vertices(&|v| mesh.vertex_colors[v as usize])
            },
            labels: all().map(|f| self.classes.label[f]).collect(),
        }
    }

    /// Splits vertices where texture coordinates or classes differ, and puts all relative to the tile's origin.
    fn assemble(
        &self,
        patch: &Patch,
        paint: Option<Baked>,
        quality: u8,
        geometry_m: f64,
        classes: Vec<ClassDeviation>,
        hem: &Hem,
    ) -> MadeTile {
        let bounds = Aabb::of(patch.positions.iter().copied());
        // Origins on a coarse grid print short and are exact in f32.
        let origin = (bounds.center() * ORIGINS_PER_M).round() / ORIGINS_PER_M;
        let texel_m = paint.as_ref().map_or(0.0, |p| p.texel_m);
        let mut content =
            TileContent { origin, copyright: self.copyright.map(str::to_owned), ..TileContent::default() };
        let mut wedges: HashMap<(u32, [u32; 2], ClassId), u32> = HashMap::new();
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
                            .push(patch.colors.get(v as usize).copied().unwrap_or(self.classes.scheme[label].color));
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
        content.atlas = paint.map(|p| encode_jpeg(&p.atlas, quality));
        // What a viewer sees: f32 vertices about the origin.
        let seen = |p: DVec3| origin + (p - origin).as_vec3().as_dvec3();
        let rounding_m = patch.positions.iter().map(|p| (seen(*p) - *p).length()).fold(0.0, f64::max);
        let added_m = self.moved_m + rounding_m;
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
            texel_m,
            triangles,
            skirt_triangles: content.faces.len() - triangles,
            classes,
            content,
        }
    }
}

/// Adds skirts: vertices and faces of their own at the end, which take class, texture coordinates, colours and normals
/// from the edges they hang from.
fn hang(content: &mut TileContent, hem: &Hem) {
    let first = content.positions.len();
    let mut made: HashMap<(u32, [u32; 3]), u32> = HashMap::new();
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

impl Patch {
    fn surface<'a>(&'a self, maker: &'a Maker) -> Surface<'a> {
        Surface {
            positions: &self.positions,
            faces: &self.faces,
            corner_uvs: &self.uvs,
            face_material: &self.materials,
            vertex_colors: &self.colors,
            materials: &maker.partition.mesh.materials,
        }
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
fn nearest_colors(positions: &[DVec3], source: &Patch, tree: &Bvh) -> Vec<[u8; 3]> {
    if source.colors.is_empty() {
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
    positions.iter().map(|p| nearest_corner(p).map_or([128; 3], |v| source.colors[v as usize])).collect()
}
