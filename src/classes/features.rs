//! What the rules look at: per face its height and uprightness, per region its size, texture and rim.

use glam::DVec3;
use rayon::prelude::*;

use super::ground::Ground;
use crate::mesh::Mesh;
use crate::planes::{NONE, Planes};

/// A rim is a drop where the lowest surface beyond it is this far down, metres.
const DROP_M: f32 = 2.0;
/// How far beyond a rim one looks, metres: past a gutter, a parapet, a rounded edge.
const BEYOND_RIM_M: f64 = 1.5;

/// Measurements of a mesh; index by face or by region.
pub struct Features {
    /// Height above ground of the face's centre, metres.
    pub height_m: Vec<f32>,
    /// z of the smoothed normal, -1 to 1.
    pub normal_z: Vec<f32>,
    /// Per region.
    pub regions: Vec<RegionFeatures>,
}

/// Measurements of one planar region.
#[derive(Debug, Clone, Copy, Default)]
pub struct RegionFeatures {
    /// Area, m².
    pub area_m2: f32,
    /// z of its plane's unit normal, -1 to 1.
    pub normal_z: f32,
    /// Area-weighted mean of 1 - cos between faces as they are and the plane: its texture. 0 smooth, 0.3 foliage.
    pub spread: f32,
    /// Height above ground that its upper tenth reaches, metres (mean plus 1.3 deviations).
    pub top_m: f32,
    /// Share of its rim beyond which the lowest surface lies more than two metres down, 0 to 1.
    pub drop: f32,
}

/// Sums from which [`RegionFeatures`] come.
#[derive(Clone, Copy, Default)]
struct Sums {
    area: f64,
    spread: f64,
    height: f64,
    height_squared: f64,
    rim: f64,
    dropping: f64,
}

impl Features {
    /// Measures every face and region.
    pub fn of(mesh: &Mesh, planes: &Planes, neighbours: &[[u32; 3]], ground: &Ground) -> Self {
        let faces = (0..mesh.faces.len()).into_par_iter().with_min_len(4096);
        let height_m: Vec<f32> = faces
            .clone()
            .map(|f| {
                let [a, b, c] = mesh.corners(f);
                ground.height_above((a + b + c) / 3.0)
            })
            .collect();
        let normal_z: Vec<f32> = faces
            .clone()
            .map(|f| {
                let of = |v: u32| planes.vertex_normals[v as usize];
                let [a, b, c] = mesh.faces[f];
                (of(a) + of(b) + of(c)).normalize_or_zero().z
            })
            .collect();
        let rims: Vec<(f32, f32)> = faces.map(|f| rim(mesh, planes, neighbours, ground, f)).collect();
        let mut sums = vec![Sums::default(); planes.regions.len()];
        for (f, &r) in planes.face_region.iter().enumerate().filter(|(_, r)| **r != NONE) {
            let (sum, region) = (&mut sums[r as usize], &planes.regions[r as usize]);
            let cross = mesh.cross(f);
            let (area, height) = (0.5 * cross.length(), f64::from(height_m[f]));
            sum.area += area;
            sum.spread += area - 0.5 * cross.dot(region.normal);
            sum.height += area * height;
            sum.height_squared += area * height * height;
            sum.rim += f64::from(rims[f].0);
            sum.dropping += f64::from(rims[f].1);
        }
        let regions = sums.iter().zip(&planes.regions).map(|(sum, region)| {
            let area = sum.area.max(1e-12);
            let mean = sum.height / area;
            let deviation = (sum.height_squared / area - mean * mean).max(0.0).sqrt();
            RegionFeatures {
                area_m2: sum.area as f32,
                normal_z: region.normal.z as f32,
                spread: (sum.spread / area) as f32,
                top_m: (mean + 1.3 * deviation) as f32,
                drop: if sum.rim > 0.0 { (sum.dropping / sum.rim) as f32 } else { 0.0 },
            }
        });
        Self { height_m, normal_z, regions: regions.collect() }
    }
}

/// Length of the rim of a region at face `f`, and of the part beyond which the surface drops, metres.
fn rim(mesh: &Mesh, planes: &Planes, neighbours: &[[u32; 3]], ground: &Ground, f: usize) -> (f32, f32) {
    let own = planes.face_region[f];
    if own == NONE {
        return (0.0, 0.0);
    }
    let corners = mesh.corners(f);
    let centre = (corners[0] + corners[1] + corners[2]) / 3.0;
    let mut lengths = (0.0, 0.0);
    for k in 0..3 {
        let behind = neighbours[f][k];
        if behind != NONE && planes.face_region[behind as usize] == own {
            continue;
        }
        let (a, b) = (corners[k], corners[(k + 1) % 3]);
        let middle = 0.5 * (a + b);
        let along = (b - a).truncate();
        let mut out = along.perp().normalize_or_zero();
        if out.dot((middle - centre).truncate()) < 0.0 {
            out = -out;
        }
        let beyond = DVec3::new(middle.x + BEYOND_RIM_M * out.x, middle.y + BEYOND_RIM_M * out.y, middle.z);
        // Where nothing was captured nothing is known.
        if let Some(drop) = ground.drop_below(beyond) {
            let length = (b - a).length() as f32;
            lengths.0 += length;
            lengths.1 += if drop > DROP_M { length } else { 0.0 };
        }
    }
    lengths
}
