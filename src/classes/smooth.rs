//! Neighbours agree: a mean field over face adjacency, then a vote per plane.

use glam::Vec3;
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
    let normals: Vec<Vec3> = per_face(mesh, |f| {
        let [a, b, c] = mesh.faces[f].map(|v| planes.vertex_normals[v as usize]);
        (a + b + c).normalize_or_zero()
    });
    let weights = per_face(mesh, |f| edge_weights(mesh, &normals, neighbours, f).map(|w| strength * w));
    drop(normals);
    let mut field = unary.clone();
    let mut next = unary.clone();
    for _ in 0..SWEEPS {
        next.par_iter_mut().with_min_len(4096).enumerate().for_each(|(f, scores)| {
            let mut push = [0.0f32; 4];
            for (&g, &w) in neighbours[f].iter().zip(&weights[f]).filter(|(g, _)| **g != NONE) {
                let of = &field[g as usize];
                (0..4).for_each(|c| push[c] += w * of[c]);
            }
            *scores = std::array::from_fn(|c| unary[f][c] * exp(push[c]));
            normalise(scores);
        });
        std::mem::swap(&mut field, &mut next);
    }
    field
}

/// e^x to six digits for |x| up to 80, without a call and with the same bits on every platform.
pub fn exp(x: f32) -> f32 {
    let scaled = x.clamp(-80.0, 80.0) * std::f32::consts::LOG2_E;
    let whole = scaled.floor();
    // 2^t on [0, 1] as Taylor's sum of e^(t ln 2) about one half, whose constant is the root of two.
    let t = (scaled - whole - 0.5) * std::f32::consts::LN_2;
    let sum = 1.0 + t * (1.0 + t * (0.5 + t * (1.0 / 6.0 + t * (1.0 / 24.0 + t * (1.0 / 120.0)))));
    std::f32::consts::SQRT_2 * sum * f32::from_bits(((whole as i32 + 127) as u32) << 23)
}

/// Weights of the three neighbours: shares of the perimeter, less across a crease.
fn edge_weights(mesh: &Mesh, normals: &[Vec3], neighbours: &[[u32; 3]], f: usize) -> [f32; 3] {
    let [a, b, c] = mesh.corners(f);
    let lengths = [b - a, c - b, a - c].map(|edge| edge.as_vec3().length());
    let per_perimeter = 1.0 / lengths.iter().sum::<f32>().max(1e-12);
    std::array::from_fn(|k| match neighbours[f][k] {
        NONE => 0.0,
        g => lengths[k] * per_perimeter * (0.2 + 0.8 * normals[f].dot(normals[g as usize]).max(0.0)),
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
