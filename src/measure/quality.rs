//! What is wrong with a mesh in itself: edges of many faces, folds, faces without area.
//!
//! Counted on vertices joined where they are equal to the last bit, without the faces that this collapses.

use rayon::prelude::*;
use serde::Serialize;

use super::surface::Prepared;

/// Neighbours folded back by more than this count as folded, degrees.
const FOLDED_DEG: f64 = 150.0;
/// A face thinner than this share of its longest edge is a sliver.
const SLIVER: f64 = 0.01;

/// No neighbour across an edge: a border, or an edge with three faces and more.
pub(super) const NONE: u32 = u32::MAX;

/// Counts of one mesh.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Quality {
    /// Faces as given, those that could not be used included.
    pub faces_in_file: usize,
    /// Faces left out for a corner that is not finite or an index out of range.
    pub faces_left_out: usize,
    /// Faces with three different vertices.
    pub faces: usize,
    /// Places that a face uses.
    pub vertices: usize,
    /// Pairs of vertices that a face joins.
    pub edges: usize,
    /// Sum of the faces' areas.
    pub area_m2: f64,
    /// Faces with three different vertices and no area.
    pub zero_area_faces: usize,
    /// Faces thinner than 1 % of their longest edge.
    pub sliver_faces: usize,
    /// Faces that repeat the three vertices of another.
    pub duplicate_faces: usize,
    /// Edges of one face.
    pub border_edges: usize,
    /// Sum of their lengths.
    pub border_length_m: f64,
    /// Edges of more than two faces.
    pub nonmanifold_edges: usize,
    /// Edges whose two faces are turned different ways: one of them is flipped.
    pub inconsistent_edges: usize,
    /// Edges at which the surface turns by more than 150°.
    pub folded_edges: usize,
}

/// The edges of a surface: what [`Quality`] counts, and who is whose neighbour.
pub(super) struct Edges {
    pub quality: Quality,
    /// Per face the one other face at the edge from corner `k` to `k + 1`, or [`NONE`].
    pub neighbours: Vec<[u32; 3]>,
}

impl Edges {
    pub fn of(surface: &Prepared) -> Self {
        let mut quality = Quality {
            faces_in_file: surface.faces.len() + surface.left_out,
            faces_left_out: surface.left_out,
            ..Quality::default()
        };
        count_faces(surface, &mut quality);
        let mut neighbours = vec![[NONE; 3]; surface.faces.len()];
        // Sorted by edge, then by face: the same order for any number of threads.
        let mut half_edges: Vec<(u64, u32)> = (0..surface.faces.len() as u32)
            .into_par_iter()
            .filter(|&f| has_three_vertices(surface.faces[f as usize]))
            .flat_map_iter(|f| {
                let face = surface.faces[f as usize];
                (0..3).map(move |k| {
                    let (a, b) = (face[k], face[(k + 1) % 3]);
                    ((u64::from(a.min(b)) << 32) | u64::from(a.max(b)), 4 * f + k as u32)
                })
            })
            .collect();
        half_edges.par_sort_unstable();
        for edge in half_edges.chunk_by(|a, b| a.0 == b.0) {
            quality.edges += 1;
            let (low, high) = ((edge[0].0 >> 32) as usize, edge[0].0 as u32 as usize);
            match *edge {
                [_] => {
                    quality.border_edges += 1;
                    quality.border_length_m += (surface.points[low] - surface.points[high]).length();
                }
                [(_, one), (_, two)] => {
                    let ((f, k), (g, l)) = ((one / 4, one % 4), (two / 4, two % 4));
                    neighbours[f as usize][k as usize] = g;
                    neighbours[g as usize][l as usize] = f;
                    let flipped = surface.faces[f as usize][k as usize] == surface.faces[g as usize][l as usize];
                    quality.inconsistent_edges += usize::from(flipped);
                    let cos = surface.normal(f).dot(surface.normal(g)) * if flipped { -1.0 } else { 1.0 };
                    quality.folded_edges += usize::from(cos < FOLDED_DEG.to_radians().cos());
                }
                _ => quality.nonmanifold_edges += 1,
            }
        }
        Self { quality, neighbours }
    }
}

fn has_three_vertices([a, b, c]: [u32; 3]) -> bool {
    a != b && b != c && c != a
}

fn count_faces(surface: &Prepared, quality: &mut Quality) {
    let mut used = vec![false; surface.points.len()];
    let mut sorted = Vec::with_capacity(surface.faces.len());
    for (f, face) in surface.faces.iter().enumerate().filter(|(_, face)| has_three_vertices(**face)) {
        let [a, b, c] = surface.corners(f as u32);
        let longest = (a - b).length().max((b - c).length()).max((c - a).length());
        let area = surface.area(f as u32);
        quality.area_m2 += area;
        quality.zero_area_faces += usize::from(area == 0.0);
        quality.sliver_faces += usize::from(longest > 0.0 && 2.0 * area < SLIVER * longest * longest);
        face.iter().for_each(|&v| used[v as usize] = true);
        let mut ids = *face;
        ids.sort_unstable();
        sorted.push(ids);
    }
    quality.faces = sorted.len();
    quality.vertices = used.iter().filter(|&&u| u).count();
    sorted.par_sort_unstable();
    sorted.dedup();
    quality.duplicate_faces = quality.faces - sorted.len();
}
