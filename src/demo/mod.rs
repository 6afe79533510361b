//! Makes a synthetic city quarter that looks and behaves like an oblique-photogrammetry mesh, with known classes.
//!
//! In: [`CityConfig`]. Out: [`City`], a textured [`Source`] in metres (z up, origin in its middle) and the class of
//! every face.
//!
//! # Method
//! 1. `ground`, `plan`: hills, a bent street grid and four kinds of blocks; what stands on them.
//! 2. `solid`, `field`: all of it as one signed distance, inner corners rounded as reconstruction rounds them.
//! 3. `surface`: its outside, dual-contoured on a lattice; no interiors, open at the border of the square.
//! 4. Classes by the nearest thing and surface; then correlated noise on the positions.
//! 5. `light`, `paint`, `atlas`: one part and one image per spatial tile, charts painted texel by texel.
//!
//! # Numbers
//! - noise: 3.5 cm at 1.6 m, 2 cm at 0.7 m, 1 cm per vertex (standard deviations; typical of 5 to 8 cm imagery);
//! - lattice 0.8 m (small), 0.65 m (medium), 0.55 m (large): the face counts of [`Size`].
//!
//! # Promises
//! - Same configuration, same bytes, for any number of threads: `the_same_seed_gives_the_same_bytes_on_1_and_2_threads`.
//! - Parts share coinciding vertices exactly; the surface is closed but for its border: `nearly_every_edge_has_two_faces`.
//!
//! - Things stand on the ground: `hardly_anything_floats`.
//!
//! # Limits
//! The lattice is even: flat ground is as dense as trees; things thinner than a lattice step are thickened, and
//! windows are shallower than their 25 cm on the coarser lattices. No water, bridges or interiors.
//!
//! # Cost
//! One core: 2.2 s and 0.1 GB (small), 10 s and 0.4 GB (medium), 28 s and 0.9 GB (large, mostly images).

use std::path::PathBuf;
use std::sync::Arc;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::ids::ClassId;
use crate::input::{ImageRef, Material, Part, Source};

mod atlas;
mod field;
mod ground;
mod light;
mod noise;
mod paint;
mod plan;
mod solid;
mod surface;

use atlas::TileMesh;
use field::Field;
use light::Light;
use surface::Surface;

/// A city and its truth.
#[derive(Debug, Clone)]
pub struct City {
    /// One part, material and image per spatial tile. Parts hold the truth too, as
    /// [`Part::face_labels`] in **class ids** (0 terrain, 1 facade, 2 roof, 3 clutter), not in SUM's numbering.
    pub source: Source,
    /// Class of face i, counting through the parts in order.
    pub truth: Vec<ClassId>,
}

/// How large a city.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Size {
    /// About 120 000 faces on 130 m by 130 m, 16 images of 1024².
    #[default]
    Small,
    /// About 600 000 faces on 230 m by 230 m, 16 images of 2048².
    Medium,
    /// About 2.5 million faces on 400 m by 400 m, 36 images of 2048².
    Large,
}

/// What city to make.
#[derive(Debug, Clone, PartialEq)]
pub struct CityConfig {
    /// Everything random follows from it. Default: 7.
    pub seed: u64,
    /// Default: [`Size::Small`].
    pub size: Size,
    /// Standard deviation of the coarsest noise along the normal, metres; the finer parts follow in proportion. 0 for
    /// none. Default: 0.035.
    pub noise_m: f64,
}

impl Default for CityConfig {
    fn default() -> Self {
        Self { seed: 7, size: Size::Small, noise_m: 0.035 }
    }
}

/// Extents that follow from a [`Size`].
#[derive(Debug, Clone, Copy)]
struct Dimensions {
    /// Side of the square, metres.
    extent_m: f64,
    /// Lattice spacing, metres.
    voxel_m: f64,
    /// Tiles per side.
    tiles: usize,
    /// Side of a tile's image.
    image_px: u32,
}

impl Size {
    fn dimensions(self) -> Dimensions {
        let (extent_m, voxel_m, tiles, image_px) = match self {
            Self::Small => (130.0, 0.8, 4, 1024),
            Self::Medium => (230.0, 0.65, 4, 2048),
            Self::Large => (400.0, 0.55, 6, 2048),
        };
        Dimensions { extent_m, voxel_m, tiles, image_px }
    }
}

/// Makes the city of a configuration.
pub fn generate(config: &CityConfig) -> City {
    build(config, config.size.dimensions())
}

fn build(config: &CityConfig, size: Dimensions) -> City {
    let ground = ground::Ground::new(config.seed, size.extent_m);
    let things = plan::lay_out(&ground, config.seed, size.extent_m, size.voxel_m);
    let field = Field::new(ground, things, size.extent_m);
    let surface = surface::extract(&field, size.extent_m, size.voxel_m);
    let scene = Scene::new(config, &field, surface);
    let tiles = scene.tiles(size);
    let painted: Vec<(Part, image::RgbImage)> =
        tiles.par_iter().enumerate().map(|(t, faces)| scene.part(t, size, faces)).collect();
    let truth = tiles.iter().flatten().map(|&f| scene.labels[f as usize]).collect();
    let mut source = Source { copyright: Vec::new(), ..Source::default() };
    for (t, (part, image)) in painted.into_iter().enumerate() {
        source.materials.push(Material { name: tile_name(t, size), base_color: [255; 3], image: Some(t as u32) });
        source.images.push(ImageRef::Pixels(Arc::new(image)));
        source.parts.push(part);
    }
    City { source, truth }
}

fn tile_name(tile: usize, size: Dimensions) -> String {
    format!("tile_{}_{}", tile % size.tiles, tile / size.tiles)
}

/// The meshed city with all that painting needs.
struct Scene<'a> {
    field: &'a Field,
    /// Noisy positions.
    positions: Vec<DVec3>,
    faces: Vec<[u32; 3]>,
    /// Per face, before noise.
    face_normals: Vec<DVec3>,
    /// Per vertex, before noise.
    normals: Vec<DVec3>,
    labels: Vec<ClassId>,
    /// Per face and per vertex: the nearest thing.
    face_owner: Vec<u32>,
    owner: Vec<u32>,
    light: Light,
}

impl<'a> Scene<'a> {
    fn new(config: &CityConfig, field: &'a Field, surface: Surface) -> Self {
        let cross = |face: &[u32; 3]| {
            let [a, b, c] = face.map(|v| surface.positions[v as usize]);
            (b - a).cross(c - a)
        };
        let face_normals = surface.faces.iter().map(|f| cross(f).normalize_or(DVec3::Z)).collect();
        let mut normals = vec![DVec3::ZERO; surface.positions.len()];
        for face in &surface.faces {
            face.iter().for_each(|&v| normals[v as usize] += cross(face));
        }
        normals.iter_mut().for_each(|n| *n = n.normalize_or(DVec3::Z));
        let light = Light::new(field, &surface, &normals);
        let owner = surface.positions.par_iter().map(|&p| field.nearest(p).0).collect();
        let found: Vec<(u32, ClassId)> = surface
            .faces
            .par_iter()
            .map(|face| {
                let [a, b, c] = face.map(|v| surface.positions[v as usize]);
                field.nearest((a + b + c) / 3.0)
            })
            .collect();
        let (face_owner, labels) = found.into_iter().unzip();
        let positions = surface.positions.par_iter().zip(&normals).map(|(&p, &n)| disturb(config, p, n)).collect();
        Self { field, positions, faces: surface.faces, face_normals, normals, labels, face_owner, owner, light }
    }

    /// Faces of each tile, by their middle.
    fn tiles(&self, size: Dimensions) -> Vec<Vec<u32>> {
        let mut tiles = vec![Vec::new(); size.tiles * size.tiles];
        let side = size.extent_m / size.tiles as f64;
        let cell = |x: f64| (((x + size.extent_m / 2.0) / side).max(0.0) as usize).min(size.tiles - 1);
        for (f, face) in self.faces.iter().enumerate() {
            let [a, b, c] = face.map(|v| self.positions[v as usize]);
            let middle = (a + b + c) / 3.0;
            tiles[cell(middle.y) * size.tiles + cell(middle.x)].push(f as u32);
        }
        tiles
    }

    /// One tile with its own vertices and its painted image.
    fn part(&self, tile: usize, size: Dimensions, faces: &[u32]) -> (Part, image::RgbImage) {
        let mut used: Vec<u32> = faces.iter().flat_map(|&f| self.faces[f as usize]).collect();
        used.sort_unstable();
        used.dedup();
        let own = |v: u32| used.partition_point(|&u| u < v) as u32;
        let positions: Vec<DVec3> = used.iter().map(|&v| self.positions[v as usize]).collect();
        let local: Vec<[u32; 3]> = faces.iter().map(|&f| self.faces[f as usize].map(own)).collect();
        let normals: Vec<DVec3> = faces.iter().map(|&f| self.face_normals[f as usize]).collect();
        let axis = self.field.ground.along_u();
        let mesh = TileMesh { positions: &positions, faces: &local, normals: &normals, axis };
        let candidates: Vec<([u32; 4], usize)> = faces.iter().map(|&f| self.candidates(f)).collect();
        let atlas = atlas::bake(&mesh, size.image_px, |f, w| self.texel(faces[f], &candidates[f], w));
        let part = Part {
            path: PathBuf::from(tile_name(tile, size)),
            face_material: vec![tile as u32; faces.len()],
            face_labels: faces.iter().map(|&f| i16::from(self.labels[f as usize].0)).collect(),
            corner_uvs: atlas.corner_uvs,
            vertex_colors: Vec::new(),
            positions,
            faces: local,
        };
        (part, atlas.image)
    }

    /// The different things a face may show: its own and its corners'.
    fn candidates(&self, face: u32) -> ([u32; 4], usize) {
        let [a, b, c] = self.faces[face as usize].map(|v| self.owner[v as usize]);
        let mut all = [self.face_owner[face as usize], a, b, c];
        let mut count = 1;
        for n in 1..4 {
            if !all[..count].contains(&all[n]) {
                all[count] = all[n];
                count += 1;
            }
        }
        (all, count)
    }

    /// Lit colour of a point of a face.
    fn texel(&self, face: u32, (things, count): &([u32; 4], usize), weights: [f64; 3]) -> Vec3 {
        let corners = self.faces[face as usize];
        let p = (0..3).map(|n| self.positions[corners[n] as usize] * weights[n]).sum::<DVec3>();
        let id = if *count == 1 {
            things[0]
        } else {
            let far = |id: &u32| self.field.distance_to(*id, p);
            things[..*count].iter().copied().min_by(|a, b| far(a).total_cmp(&far(b))).unwrap_or(things[0])
        };
        let flat = self.face_normals[face as usize];
        let smooth = (0..3).map(|n| self.normals[corners[n] as usize] * weights[n]).sum::<DVec3>();
        // Built things are faceted, grown things are round.
        let normal = if self.labels[face as usize] == ClassId::CLUTTER { smooth.normalize_or(flat) } else { flat };
        let openness = (0..3).map(|n| self.light.openness[corners[n] as usize] * weights[n] as f32).sum();
        develop(paint::color(self.field, id, p, normal) * self.light.at(p, normal, openness))
    }
}

/// Mutes colours and lifts shadows a little, as air and camera do.
fn develop(color: Vec3) -> Vec3 {
    let gray = Vec3::splat(color.dot(Vec3::new(0.30, 0.59, 0.11)));
    color.lerp(gray, 0.16) * 0.96 + Vec3::new(0.025, 0.03, 0.04)
}

/// Moves a vertex as matching noise does: smoothly along the normal, a little at random.
fn disturb(config: &CityConfig, p: DVec3, normal: DVec3) -> DVec3 {
    /// Standard deviation of value noise of unit amplitude, as measured over a million points.
    const VALUE_SIGMA: f64 = 0.36;
    let seed = config.seed as u32;
    let coarse = f64::from(noise::value3(p / 1.6, seed ^ 0xa1)) / VALUE_SIGMA;
    let fine = f64::from(noise::value3(p / 0.7, seed ^ 0xa2)) / VALUE_SIGMA;
    let cell = (p * 1000.0).round();
    let jitter =
        |salt| f64::from(noise::lattice(cell.x as i32, cell.y as i32, cell.z as i32, seed ^ salt)) * 3f64.sqrt();
    let shift = DVec3::new(jitter(1), jitter(2), jitter(3)) * (0.01 / 3f64.sqrt());
    (normal * (0.035 * coarse + 0.02 * fine) + shift) * (config.noise_m / 0.035) + p
}

#[cfg(test)]
mod tests;
