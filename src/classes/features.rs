//! What the rules look at: per face height and uprightness, per region size, texture and top.

use glam::Vec3;
use rayon::prelude::*;

use super::ground::Ground;
use crate::mesh::Mesh;
use crate::planes::{NONE, Planes};

/// Measurements of a mesh; index by face or by region.
pub struct Features {
    /// Height above ground of the face's centre, metres.
    pub height_m: Vec<f32>,
    /// Smoothed unit normal.
    pub normals: Vec<Vec3>,
    /// Slope of the ground there, metres per metre.
    pub ground_slope: Vec<f32>,
    /// Per region.
    pub regions: Vec<RegionFeatures>,
}

/// Measurements of one planar region.
#[derive(Debug, Clone, Copy, Default)]
pub struct RegionFeatures {
    /// Area, m².
    pub area_m2: f32,
    /// Number of faces.
    pub faces: u32,
    /// z of its plane's unit normal, -1 to 1.
    pub normal_z: f32,
    /// Area-weighted mean of 1 - cos between faces as they are and the plane: its texture. 0 smooth, 0.3 foliage.
    pub spread: f32,
    /// Root mean square distance of its faces' centres from the plane, metres.
    pub rms_m: f32,
    /// Height above ground that its upper tenth reaches, metres (mean plus 1.3 deviations).
    pub top_m: f32,
}

/// Sums from which [`RegionFeatures`] come.
#[derive(Clone, Copy, Default)]
struct Sums {
    area: f64,
    spread: f64,
    square: f64,
    height: f64,
    height_squared: f64,
}

impl Features {
    /// Measures every face and region.
    pub fn of(mesh: &Mesh, planes: &Planes, ground: &Ground) -> Self {
        let faces = (0..mesh.faces.len()).into_par_iter().with_min_len(4096);
        let (mut height_m, mut ground_slope) = (Vec::new(), Vec::new());
        let at = |f: usize| {
            let [a, b, c] = mesh.corners(f);
            ground.height_and_slope((a + b + c) / 3.0)
        };
        faces.clone().map(at).unzip_into_vecs(&mut height_m, &mut ground_slope);
        let normals: Vec<Vec3> = faces
            .map(|f| {
                let [a, b, c] = mesh.faces[f].map(|v| planes.vertex_normals[v as usize]);
                (a + b + c).normalize_or_zero()
            })
            .collect();
        let mut sums = vec![Sums::default(); planes.regions.len()];
        for (f, &r) in planes.face_region.iter().enumerate().filter(|(_, r)| **r != NONE) {
            let (sum, region) = (&mut sums[r as usize], &planes.regions[r as usize]);
            let [a, b, c] = mesh.corners(f);
            let cross = (b - a).cross(c - a);
            let (area, height) = (0.5 * cross.length(), f64::from(height_m[f]));
            sum.area += area;
            sum.spread += area - 0.5 * cross.dot(region.normal);
            let distance = ((a + b + c) / 3.0 - region.centroid).dot(region.normal);
            sum.square += area * distance * distance;
            sum.height += area * height;
            sum.height_squared += area * height * height;
        }
        let regions = sums.iter().zip(&planes.regions).map(|(sum, region)| {
            let area = sum.area.max(1e-12);
            let mean = sum.height / area;
            let deviation = (sum.height_squared / area - mean * mean).max(0.0).sqrt();
            RegionFeatures {
                area_m2: sum.area as f32,
                faces: region.faces,
                normal_z: region.normal.z as f32,
                spread: (sum.spread / area) as f32,
                rms_m: (sum.square / area).sqrt() as f32,
                top_m: (mean + 1.3 * deviation) as f32,
            }
        });
        Self { height_m, normals, ground_slope, regions: regions.collect() }
    }
}
