//! Neighbours agree: a mean field over face adjacency, a vote per plane, and the end of small islands.

use glam::DVec3;
use rayon::prelude::*;

use super::ClassesConfig;
use super::rules::Scores;
use crate::mesh::Mesh;
use crate::planes::{NONE, Planes};

/// Jacobi sweeps of the mean field; more change less than one face in a thousand.
const SWEEPS: usize = 6;

/// Everything in turn, in place.
pub fn smooth(
    mesh: &Mesh,
    planes: &Planes,
    neighbours: &[[u32; 3]],
    config: &ClassesConfig,
    unary: Vec<Scores>,
) -> Vec<Scores> {
    let mut field = mean_field(mesh, planes, neighbours, config.smoothing as f32, unary);
    vote(mesh, planes, config, &mut field);
    drop_islands(mesh, neighbours, config.island_m2, &mut field);
    field
}

/// Potts mean field: Q(c) ∝ P(c) exp(λ Σ w Q'(c)), w by shared edge and agreeing normals. Every sweep reads only
/// the last one's result, so threads do not matter.
fn mean_field(mesh: &Mesh, planes: &Planes, neighbours: &[[u32; 3]], strength: f32, unary: Vec<Scores>) -> Vec<Scores> {
    let weights: Vec<[f32; 3]> = per_face(mesh, |f| edge_weights(mesh, planes, neighbours, f));
    let mut field = unary.clone();
    for _ in 0..SWEEPS {
        field = per_face(mesh, |f| {
            let mut push = [0.0f32; 4];
            for (&g, &w) in neighbours[f].iter().zip(&weights[f]).filter(|(g, _)| **g != NONE) {
                let of = field[g as usize];
                (0..4).for_each(|c| push[c] += w * of[c]);
            }
            let mut scores: Scores = std::array::from_fn(|c| unary[f][c] * (strength * push[c]).exp());
            normalise(&mut scores);
            scores
        });
    }
    field
}

/// Weights of the three neighbours: shares of the perimeter, less across a crease.
fn edge_weights(mesh: &Mesh, planes: &Planes, neighbours: &[[u32; 3]], f: usize) -> [f32; 3] {
    let corners = mesh.corners(f);
    let lengths: [f64; 3] = std::array::from_fn(|k| corners[k].distance(corners[(k + 1) % 3]));
    let perimeter = lengths.iter().sum::<f64>().max(1e-12);
    let normal = |f: usize| -> DVec3 {
        let of = |v: u32| planes.vertex_normals[v as usize].as_dvec3();
        let [a, b, c] = mesh.faces[f];
        (of(a) + of(b) + of(c)).normalize_or_zero()
    };
    let own = normal(f);
    std::array::from_fn(|k| match neighbours[f][k] {
        NONE => 0.0,
        g => (lengths[k] / perimeter * (0.2 + 0.8 * own.dot(normal(g as usize)).max(0.0))) as f32,
    })
}

/// Faces of a large plane share one opinion: the area-weighted mean of theirs.
fn vote(mesh: &Mesh, planes: &Planes, config: &ClassesConfig, field: &mut [Scores]) {
    let voters = planes.regions.partition_point(|r| r.area_m2 > config.vote_area_m2);
    let mut ballots = vec![[0.0f64; 4]; voters];
    let region = |f: usize| Some(planes.face_region[f] as usize).filter(|r| *r < voters);
    for (f, scores) in field.iter().enumerate() {
        if let Some(r) = region(f) {
            let area = 0.5 * mesh.cross(f).length();
            (0..4).for_each(|c| ballots[r][c] += area * f64::from(scores[c]));
        }
    }
    for (f, scores) in field.iter_mut().enumerate() {
        if let Some(r) = region(f) {
            *scores = ballots[r].map(|v| v as f32);
            normalise(scores);
        }
    }
}

/// Patches of one class smaller than `island_m2` take the class that surrounds them most.
fn drop_islands(mesh: &Mesh, neighbours: &[[u32; 3]], island_m2: f64, field: &mut [Scores]) {
    let label: Vec<u8> = field.iter().map(|s| best(s) as u8).collect();
    let mut seen = vec![false; label.len()];
    let mut patch: Vec<u32> = Vec::new();
    for start in 0..label.len() {
        if seen[start] {
            continue;
        }
        let own = label[start];
        patch.clear();
        patch.push(start as u32);
        seen[start] = true;
        let (mut area, mut rim, mut next) = (0.0, [0.0f64; 4], 0);
        while next < patch.len() {
            let f = patch[next] as usize;
            next += 1;
            area += 0.5 * mesh.cross(f).length();
            let corners = mesh.corners(f);
            for k in 0..3 {
                let g = neighbours[f][k];
                if g == NONE {
                    continue;
                }
                let g = g as usize;
                if label[g] != own {
                    rim[label[g] as usize] += corners[k].distance(corners[(k + 1) % 3]);
                } else if !seen[g] {
                    seen[g] = true;
                    patch.push(g as u32);
                }
            }
        }
        let around = (0..4).fold(0, |a, c| if rim[c] > rim[a] { c } else { a });
        if area < island_m2 && rim[around] > 0.0 {
            for &f in &patch {
                // The face keeps its doubts: the two classes trade places.
                field[f as usize].swap(around, own as usize);
            }
        }
    }
}

/// The most probable class, the first of equals.
pub fn best(scores: &[f32]) -> usize {
    (1..scores.len()).fold(0, |a, c| if scores[c] > scores[a] { c } else { a })
}

fn normalise(scores: &mut Scores) {
    let sum: f32 = scores.iter().sum();
    if sum > 0.0 {
        scores.iter_mut().for_each(|s| *s /= sum);
    } else {
        *scores = [0.25; 4];
    }
}

fn per_face<T: Send>(mesh: &Mesh, of: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    (0..mesh.faces.len()).into_par_iter().with_min_len(4096).map(of).collect()
}
