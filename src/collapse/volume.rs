//! The baseline of Lindstrom & Turk, Fast and Memory Efficient Polygonal Simplification, 1998, as printed: the new vertex
//! keeps the volume and the border's area, then moves them least; the cost is the volume and border area swept.

use glam::{DMat3, DVec3};

use super::block::BORDER;
use super::run::Run;

/// Constraints closer to each other than 1° are one (§4, as in the authors' code).
const ALPHA_COS: f64 = 0.999_847_7;
const ALPHA_SIN: f64 = 0.017_452_4;
/// Share of volume and border in the cost (§5).
const VOLUME_SHARE: f64 = 0.5;
const BORDER_SHARE: f64 = 0.5;

/// Planes n·x = b that the vertex has to meet, at most three.
#[derive(Default)]
struct Constraints {
    normals: Vec<DVec3>,
    offsets: Vec<f64>,
}

impl Constraints {
    /// Adds a plane unless it nearly follows from those before.
    fn add(&mut self, normal: DVec3, offset: f64) {
        let length = normal.length();
        if length <= 0.0 || !length.is_finite() {
            return;
        }
        let (n, b) = (normal / length, offset / length);
        let independent = match self.normals[..] {
            [] => true,
            [a] => a.dot(n).abs() < ALPHA_COS,
            [a, c] => a.cross(c).normalize_or_zero().dot(n).abs() > ALPHA_SIN,
            _ => false,
        };
        if independent {
            self.normals.push(n);
            self.offsets.push(b);
        }
    }

    /// Adds what is left of "the gradient H·x + c is zero" in the directions still free.
    fn add_gradient(&mut self, h: DMat3, c: DVec3) {
        let free: Vec<DVec3> = match self.normals[..] {
            [] => vec![DVec3::X, DVec3::Y, DVec3::Z],
            [a] => {
                let q = a.any_orthonormal_vector();
                vec![q, a.cross(q)]
            }
            [a, b] => vec![a.cross(b)],
            _ => Vec::new(),
        };
        for q in free {
            self.add(h * q, -q.dot(c));
        }
    }

    fn solve(&self) -> Option<DVec3> {
        let [a, b, c] = <[DVec3; 3]>::try_from(&self.normals[..]).ok()?;
        let m = DMat3::from_cols(a, b, c).transpose();
        let x = m.inverse() * DVec3::new(self.offsets[0], self.offsets[1], self.offsets[2]);
        x.is_finite().then_some(x)
    }
}

/// Position and cost of the collapse of `uv`; none where the constraints leave the vertex free.
pub(super) fn place(run: &Run, u: u32, v: u32) -> Option<(DVec3, f64)> {
    let middle = (run.at(u) + run.at(v)) * 0.5;
    let mut faces: Vec<u32> = run.star_of(u).to_vec();
    faces.extend(run.star_of(v).iter().filter(|&&f| !run.faces[f as usize].corners.contains(&u)));
    let planes: Vec<(DVec3, f64)> = faces
        .iter()
        .map(|&f| {
            let [a, b, c] = run.corners(f).map(|p| p - middle);
            ((b - a).cross(c - a), a.dot(b.cross(c)))
        })
        .collect();
    let border = border_edges(run, u, v, &faces, middle);

    let mut constraints = Constraints::default();
    constraints.add(planes.iter().map(|p| p.0).sum(), planes.iter().map(|p| p.1).sum());
    if !border.is_empty() {
        let along: DVec3 = border.iter().map(|(a, b)| *b - *a).sum();
        let moment: DVec3 = border.iter().map(|(a, b)| a.cross(*b)).sum();
        let h = DMat3::from_diagonal(DVec3::splat(along.length_squared())) - outer(along, along);
        constraints.add_gradient(h, along.cross(moment));
    }
    let h = planes.iter().fold(DMat3::ZERO, |h, (n, _)| h + outer(*n, *n));
    constraints.add_gradient(h, -planes.iter().map(|(n, d)| *n * *d).sum::<DVec3>());
    let mut ring = DVec3::ZERO;
    let mut count = 0.0;
    for w in faces.iter().flat_map(|&f| run.faces[f as usize].corners).filter(|&w| w != u && w != v) {
        ring += run.at(w) - middle;
        count += 1.0;
    }
    constraints.add_gradient(DMat3::from_diagonal(DVec3::splat(count)), -ring);

    let x = constraints.solve()?;
    let volume = planes.iter().map(|(n, d)| (n.dot(x) - d).powi(2)).sum::<f64>() / 36.0;
    let swept = border.iter().map(|(a, b)| (*a - x).cross(*b - x).length_squared()).sum::<f64>() / 4.0;
    let length_squared = (run.at(u) - run.at(v)).length_squared();
    Some((middle + x, VOLUME_SHARE * volume + BORDER_SHARE * swept * length_squared))
}

/// Open edges at u and v, each once, in the direction of its face, relative to `middle`.
fn border_edges(run: &Run, u: u32, v: u32, faces: &[u32], middle: DVec3) -> Vec<(DVec3, DVec3)> {
    let mut edges = Vec::new();
    if (run.vertices[u as usize].mark.flags | run.vertices[v as usize].mark.flags) & BORDER == 0 {
        return edges;
    }
    for &f in faces {
        let face = run.faces[f as usize].corners;
        for k in 0..3 {
            let (a, b) = (face[k], face[(k + 1) % 3]);
            if [a, b].iter().any(|&w| w == u || w == v) && run.shared_faces(a, b) == 1 {
                edges.push((run.at(a) - middle, run.at(b) - middle));
            }
        }
    }
    edges
}

fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}
