//! Neighbours agree: a mean field over face adjacency, then a vote per plane.

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
