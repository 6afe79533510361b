//! Neighbours agree: a mean field over face adjacency, then a vote per plane.

use glam::Vec3;
use rayon::prelude::*;

use super::ClassesConfig;
use super::rules::Scores;
use crate::mesh::Mesh;
use crate::planes::{NONE, Planes};

/// Jacobi sweeps of the mean field; more change less than one face in a thousand.
const SWEEPS: usize = 6;

/// Everything in turn. `normals` are the smoothed ones of faces.
pub fn smooth(
    mesh: &Mesh,
    planes: &Planes,
    neighbours: &[[u32; 3]],
    normals: Vec<Vec3>,
    config: &ClassesConfig,
    unary: Vec<Scores>,
) -> Vec<Scores> {
    let strength = config.smoothing as f32;
    let weights = per_face(mesh, |f| edge_weights(mesh, &normals, neighbours, f).map(|w| strength * w));
    drop(normals);
    let mut field = mean_field(neighbours, &weights, unary);
    drop(weights);
    vote(mesh, planes, config, &mut field);
    field
}

/// Potts mean field: Q(c) ∝ P(c) exp(Σ w Q'(c)), w by shared edge and agreeing normals. Every sweep reads only
/// the last one's result, so threads do not matter.
fn mean_field(neighbours: &[[u32; 3]], weights: &[[f32; 3]], unary: Vec<Scores>) -> Vec<Scores> {
    let swept = |from: &[Scores], f: usize| {
        let mut push = [0.0f32; 4];
        for (&g, &w) in neighbours[f].iter().zip(&weights[f]).filter(|(g, _)| **g != NONE) {
            let of = &from[g as usize];
            (0..4).for_each(|c| push[c] += w * of[c]);
        }
        let mut scores = std::array::from_fn(|c| unary[f][c] * exp(push[c]));
        normalise(&mut scores);
        scores
    };
    let mut field: Vec<Scores> = Vec::new();
    let faces = (0..unary.len()).into_par_iter().with_min_len(4096);
    faces.map(|f| swept(&unary, f)).collect_into_vec(&mut field);
    let mut next = vec![[0.0; 4]; unary.len()];
    for _ in 1..SWEEPS {
        next.par_iter_mut().with_min_len(4096).enumerate().for_each(|(f, scores)| *scores = swept(&field, f));
        std::mem::swap(&mut field, &mut next);
    }
    field
}

/// 1.5 · 2²³: what is added to it is rounded to a whole number, which then stands in the lowest bits.
const ROUNDER: f32 = 12_582_912.0;

/// e^x to six digits for |x| up to 80, without a call or a branch and with the same bits on every platform.
#[inline]
pub fn exp(x: f32) -> f32 {
    let scaled = x.clamp(-80.0, 80.0) * std::f32::consts::LOG2_E;
    let shifted = scaled + ROUNDER;
    let whole = shifted.to_bits().wrapping_sub(ROUNDER.to_bits());
    // Taylor's sum of e^(t ln 2) for t within one half.
    let t = (scaled - (shifted - ROUNDER)) * std::f32::consts::LN_2;
    let sum = 1.0 + t * (1.0 + t * (0.5 + t * (1.0 / 6.0 + t * (1.0 / 24.0 + t * (1.0 / 120.0)))));
    sum * f32::from_bits(whole.wrapping_add(127) << 23)
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
        let per_sum = 1.0 / sum;
        scores.iter_mut().for_each(|s| *s *= per_sum);
    } else {
        *scores = [0.25; 4];
    }
}

fn per_face<T: Send>(mesh: &Mesh, of: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    (0..mesh.faces.len()).into_par_iter().with_min_len(4096).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_has_six_digits() {
        for i in -8000..=8000 {
            let x = i as f32 * 0.01;
            let error = f64::from(exp(x)) / f64::from(x).exp() - 1.0;
            assert!(error.abs() < 1e-5, "{x}: {error}");
        }
        assert_eq!((exp(0.0), exp(-1e9), exp(1e9)), (1.0, exp(-80.0), exp(80.0)));
    }
}
