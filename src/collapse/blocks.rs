//! Cuts a mesh into blocks, and marks the vertices that a block must not move freely.

use std::cmp::Ordering;

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::NONE;
use super::block::{FIX_X, FIX_Y};
use crate::geo::Rect;

/// Faces by block: a k-d tree over `centers`, cut at `share` of the faces until no block has more than `most`.
pub fn split_faces(mut faces: Vec<u32>, centers: &[DVec2], most: usize, share: f64) -> Vec<Vec<u32>> {
    if faces.len() <= most {
        return if faces.is_empty() { Vec::new() } else { vec![faces] };
    }
    let at = |f: &u32| centers[*f as usize];
    let low = faces.iter().map(at).fold(DVec2::INFINITY, DVec2::min);
    let high = faces.iter().map(at).fold(DVec2::NEG_INFINITY, DVec2::max);
    let axis = usize::from(high.y - low.y > high.x - low.x);
    let by_axis = |a: &u32, b: &u32| -> Ordering { at(a)[axis].total_cmp(&at(b)[axis]).then(a.cmp(b)) };
    let middle = (faces.len() as f64 * share) as usize;
    faces.select_nth_unstable_by(middle, by_axis);
    let mut upper = faces.split_off(middle);
    // Selection leaves halves in no particular order; the blocks' order must be the mesh's.
    rayon::join(|| faces.par_sort_unstable(), || upper.par_sort_unstable());
    let (mut a, b) =
        rayon::join(|| split_faces(faces, centers, most, share), || split_faces(upper, centers, most, share));
    a.extend(b);
    a
}

/// Vertices on an edge with one face. Edges are filed under their lower end: six of them are sorted sooner than all.
pub fn border_of(vertices: usize, faces: &[[u32; 3]]) -> Vec<bool> {
    let edges = || faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
    let mut start = vec![0u32; vertices + 1];
    edges().for_each(|(a, b)| start[a.min(b) as usize] += 1);
    let mut total = 0;
    for at in &mut start {
        total += *at;
        *at = total;
    }
    let mut upper = vec![0u32; total as usize];
    for (a, b) in edges() {
        let at = &mut start[a.min(b) as usize];
        *at -= 1;
        upper[*at as usize] = a.max(b);
    }
    let mut border = vec![false; vertices];
    for v in 0..vertices {
        let filed = &mut upper[start[v] as usize..start[v + 1] as usize];
        filed.sort_unstable();
        for group in filed.chunk_by(|a, b| a == b).filter(|g| g.len() == 1) {
            border[v] = true;
            border[group[0] as usize] = true;
        }
    }
    border
}

/// Sets `FIX_X` and `FIX_Y` on vertices that faces of several groups share.
pub fn mark_walls(flags: &mut [u8], positions: &[DVec3], faces: &[[u32; 3]], group: &[u32], boxes: &[Rect]) {
    let mut first = vec![NONE; positions.len()];
    let mut shared = vec![false; positions.len()];
    for (face, &g) in faces.iter().zip(group) {
        for &v in face {
            let seen = &mut first[v as usize];
            shared[v as usize] |= *seen != NONE && *seen != g;
            *seen = g;
        }
    }
    for (face, &g) in faces.iter().zip(group) {
        let cell = &boxes[g as usize];
        for &v in face.iter().filter(|&&v| shared[v as usize]) {
            let p = positions[v as usize];
            if p.x == cell.min.x || p.x == cell.max.x {
                flags[v as usize] |= FIX_X;
            }
            if p.y == cell.min.y || p.y == cell.max.y {
                flags[v as usize] |= FIX_Y;
            }
        }
    }
}
