//! Edge-preserving surface normals: what the surface does at the scale of walls, not of noise.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::{Grain, PlanesConfig};
use crate::mesh::Mesh;
use crate::mesh::topology::{self, NONE};

/// Faces a task takes at once: large enough to hide the cost of scheduling.
const CHUNK: usize = 4096;

/// Medians are taken over this many evenly spaced faces: a tenth of a percent is all they need.
const SAMPLES: usize = 100_000;

/// A face's centre relative to the mesh's first vertex, metres, and its area, m²: side by side as they are read.
#[derive(Clone, Copy)]
struct Place {
    centre: Vec3,
    area: f32,
}

/// What region growing wants to know of each face.
pub struct Surface {
    /// Face behind each edge.
    pub neighbours: Vec<[u32; 3]>,
    /// Filtered unit normals of faces; zero for faces without area.
    pub normals: Vec<Vec3>,
    /// Areas, m².
    pub areas: Vec<f32>,
    /// How far the filtered surface is from flat at each face: 0 flat, about 1 at creases and in trees.
    pub bend: Vec<f32>,
    /// Of the whole that the mesh is part of.
    pub grain: Grain,
}

/// Measures and filters. Each sweep moves a normal towards its edge neighbours' mean, weighted by area,
/// closeness (none beyond the radius) and agreement (none across right angles).
pub fn surface(mesh: &Mesh, config: &PlanesConfig, known: Option<Grain>) -> Surface {
    let neighbours = topology::face_neighbours(mesh);
    let median_edge_m = known.map_or_else(|| median_edge(mesh), |g| g.median_edge_m);
    let origin = mesh.positions.first().copied().unwrap_or(DVec3::ZERO);
    let per_radius = 1.0 / (config.smoothing_radius_m * config.smoothing_radius_m).max(1e-12) as f32;
    let (mut normals, mut places) = (Vec::new(), Vec::new());
    let raw = |f: usize| {
        let [a, b, c] = mesh.corners(f).map(|p| p - origin);
        let half = (0.5 * (b - a).cross(c - a)).as_vec3();
        (half.normalize_or_zero(), Place { centre: ((a + b + c) / 3.0).as_vec3(), area: half.length() })
    };
    let faces = 0..mesh.faces.len();
    faces.into_par_iter().with_min_len(CHUNK).map(raw).unzip_into_vecs(&mut normals, &mut places);
    // What each neighbour weighs, as far as normals have no say in it.
    let pull_of = |f: usize| {
        neighbours[f].map(|g| {
            let Some(there) = places.get(g as usize) else { return 0.0 };
            let close = 1.0 - there.centre.distance_squared(places[f].centre) * per_radius;
            there.area * close.max(0.0)
        })
    };
    let pulls: Vec<[f32; 3]> = per_face(mesh, pull_of);
    let areas: Vec<f32> = places.iter().map(|place| place.area).collect();
    drop(places);

    // The reach of diffusion grows with the root of the sweeps; ten are where more stops to pay.
    let sweeps = (config.smoothing_radius_m / median_edge_m.max(1e-6)).ceil().clamp(1.0, 10.0) as usize;
    let mut next = vec![Vec3::ZERO; normals.len()];
    for _ in 0..sweeps {
        next.par_iter_mut().with_min_len(CHUNK).enumerate().for_each(|(f, out)| {
            let normal = normals[f];
            let mut sum = normal * areas[f];
            for (&g, &pull) in neighbours[f].iter().zip(&pulls[f]).filter(|(g, _)| **g != NONE) {
                let other = normals[g as usize];
                let agree = other.dot(normal).max(0.0);
                sum += other * (pull * agree * agree * agree);
            }
            *out = sum.normalize_or_zero();
        });
        std::mem::swap(&mut normals, &mut next);
    }
    drop((next, pulls));
    let mean = |f: usize, of: &dyn Fn(usize) -> f32| {
        let around = neighbours[f].iter().filter(|&&g| g != NONE);
        let (sum, n) = around.map(|&g| of(g as usize)).fold((0.0f32, 0u32), |(sum, n), value| (sum + value, n + 1));
        (n > 0).then(|| sum / n as f32)
    };
    let bend = per_face(mesh, |f| mean(f, &|g| 1.0 - normals[g].dot(normals[f])).unwrap_or(1.0));
    let measured = || {
        let some = (0..mesh.faces.len()).step_by(mesh.faces.len() / SAMPLES + 1);
        let centre = |f: usize| {
            let [a, b, c] = mesh.corners(f).map(|p| p - origin);
            ((a + b + c) / 3.0).as_vec3()
        };
        let offset = |f: usize| mean(f, &|g| (centre(g) - centre(f)).dot(normals[f]).abs()).unwrap_or(0.0);
        let mut offsets: Vec<f32> = some.map(offset).collect();
        Grain { median_edge_m, noise_m: f64::from(median(&mut offsets)) }
    };
    let grain = known.unwrap_or_else(measured);
    Surface { neighbours, normals, areas, bend, grain }
}

/// Vertex normals: the area-weighted mean of the filtered normals around.
pub fn of_vertices(mesh: &Mesh, surface: &Surface) -> Vec<Vec3> {
    // Handing out face by face on one thread is quicker than a list of the faces around each vertex, and sums in the
    // same order.
    let mut sums = vec![Vec3::ZERO; mesh.positions.len()];
    for ((face, normal), area) in mesh.faces.iter().zip(&surface.normals).zip(&surface.areas) {
        face.iter().for_each(|v| sums[*v as usize] += *normal * *area);
    }
    sums.par_iter_mut().with_min_len(CHUNK).for_each(|sum| *sum = sum.normalize_or(Vec3::Z));
    sums
}

fn per_face<T: Send>(mesh: &Mesh, of: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    (0..mesh.faces.len()).into_par_iter().with_min_len(CHUNK).map(of).collect()
}

/// Median over about [`SAMPLES`] faces, evenly taken; 1 for a mesh without faces.
fn median_edge(mesh: &Mesh) -> f64 {
    let stride = mesh.faces.len() / SAMPLES + 1;
    let lengths = mesh.faces.iter().step_by(stride).flat_map(|&[a, b, c]| {
        [(a, b), (b, c), (c, a)].map(|(p, q)| mesh.positions[p as usize].distance(mesh.positions[q as usize]) as f32)
    });
    let mut lengths: Vec<f32> = lengths.collect();
    if lengths.is_empty() { 1.0 } else { f64::from(median(&mut lengths)) }
}

fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_of_a_rough_plane_point_up_and_a_right_angle_stays_sharp() {
        // A strip of squares along x: floor until x = 10, then a wall going up; the floor is rough.
        let mut mesh = Mesh::default();
        for i in 0..=20 {
            for y in 0..=4 {
                let (x, z) = if i <= 10 { (f64::from(i), 0.0) } else { (10.0, f64::from(i - 10)) };
                let bump = 0.2 * f64::from((i * 7 + y * 3) % 3 - 1);
                let p = DVec3::new(x, f64::from(y), z) + if i < 10 { DVec3::Z * bump } else { DVec3::ZERO };
                mesh.positions.push(p * 0.2);
            }
        }
        for i in 0..20 {
            for y in 0..4 {
                let a = i * 5 + y;
                mesh.faces.extend([[a, a + 5, a + 6], [a, a + 6, a + 1]]);
            }
        }
        let surface = surface(&mesh, &PlanesConfig::default(), None);
        assert!(mesh.cross(3).normalize().z < 0.99, "the raw floor must be rough for this test to mean something");
        let worst = |faces: std::ops::Range<usize>, want: Vec3| {
            faces.map(|f| surface.normals[f].dot(want)).fold(1.0f32, f32::min)
        };
        assert!(worst(16..64, Vec3::Z) > 0.97, "{}", worst(16..64, Vec3::Z));
        assert!(worst(80..160, -Vec3::X) > 0.97, "{}", worst(80..160, -Vec3::X));
        let vertex_normals = of_vertices(&mesh, &surface);
        assert!(vertex_normals[5 * 5 + 2].z > 0.97);
    }
}
