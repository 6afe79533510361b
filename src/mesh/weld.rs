//! Welds the parts of a source by position and drops faces that carry no surface.
//!
//! In: a [`Source`] whose positions are already local metres. Out: a valid [`Mesh`] and what was done, in numbers.
//!
//! # Method
//! 1. Every vertex is filed under its grid cell and under each neighbouring cell it lies within the tolerance of.
//! 2. Inside a cell, vertices closer than the tolerance are joined; the lowest index of a group stands for it, so
//!    positions that survive are positions of the source.
//! 3. Faces are renumbered; those with a repeated vertex, without area, or with the vertices of an earlier face go.
//!
//! The paper's preprocessing (§2.1) in our stages: *triangulation* is the readers' (`input::triangulate`), *removal of
//! duplicate geometric structures* (equal and near-equal points, repeated faces) is this file, and *centroid
//! normalisation* is the frame's (`geo::frame`: the middle of the surface becomes the origin, in f64 throughout).
//!
//! # Promises
//! No position moves by more than the tolerance times the longest chain of joins; seams stay apart because texture
//! coordinates sit on corners, not on vertices. Same result for any number of threads.

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Mesh, on_grid};
use crate::input::Source;
use crate::report::Reporter;
use crate::{Error, Result};

/// How the gate cleans.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GateConfig {
    /// Vertices closer than this are one, metres. Default: 0.001, well under any photogrammetric noise and above the
    /// rounding of published coordinates. 0 welds equal positions only.
    pub weld_m: f64,
}

impl Default for GateConfig {
    fn default() -> Self {
        Self { weld_m: 0.001 }
    }
}

/// What the gate did.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GateReport {
    /// Vertices in the source.
    pub vertices_in: usize,
    /// Vertices after welding that a face uses.
    pub vertices: usize,
    /// Triangles in the source.
    pub faces_in: usize,
    /// Triangles kept.
    pub faces: usize,
    /// Triangles dropped for a repeated vertex or no area.
    pub degenerate: usize,
    /// Triangles dropped because an earlier one has the same three vertices.
    pub duplicate: usize,
    /// Triangles dropped for a vertex that is not finite.
    pub not_finite: usize,
    /// Vertices of different files that were welded, where the input is several.
    pub joined: usize,
    /// Length of borders that lie within two centimetres of another border and were not welded to it, where the input is
    /// several files, metres.
    pub unmatched_m: f64,
    /// Furthest that welding moved a vertex, metres: part of every tile's error.
    pub moved_m: f64,
}

/// Grid cells are this many tolerances wide, so that few vertices lie near a cell's border.
const CELL_TOLERANCES: f64 = 8.0;
/// Used as cell size when the tolerance is 0, metres.
const EXACT_CELL_M: f64 = 0.01;

/// Welds and cleans; positions must be local metres already.
///
/// # Errors
/// An input without any usable triangle, or with more than 2³² − 2 vertices.
pub fn gate(source: Source, config: &GateConfig, reporter: &Reporter) -> Result<(Mesh, GateReport)> {
    let name = source.parts.first().map(|p| p.path.clone()).unwrap_or_default();
    let (mesh, report) = gate_unit(source, config, reporter)?;
    report.say(&name, reporter)?;
    Ok((mesh, report))
}

/// [`gate`] for one of several units of an input, which may be empty; the sum of the reports is to be said at the end.
///
/// # Errors
/// More than 2³² − 2 vertices.
pub fn gate_unit(source: Source, config: &GateConfig, reporter: &Reporter) -> Result<(Mesh, GateReport)> {
    let name = source.parts.first().map(|p| p.path.clone()).unwrap_or_default();
    let faces_in: usize = source.parts.iter().map(|p| p.faces.len()).sum();
    let vertices_in: usize = source.parts.iter().map(|p| p.positions.len()).sum();
    if vertices_in >= u32::MAX as usize - 1 || faces_in >= u32::MAX as usize / 4 {
        return Err(Error::Limit {
            path: name,
            what: format!(
                "{vertices_in} vertices and {faces_in} triangles in one build; split the input and build it in parts"
            ),
        });
    }
    let textured = source.parts.iter().any(|p| !p.corner_uvs.is_empty());
    let colored = source.parts.iter().any(|p| !p.vertex_colors.is_empty());
    let labelled = source.parts.iter().any(|p| !p.face_labels.is_empty());
    let mut report = GateReport { vertices_in, faces_in, ..GateReport::default() };
    let mut mesh = Mesh { materials: source.materials, ..Mesh::default() };
    mesh.positions.reserve_exact(vertices_in);
    mesh.faces.reserve_exact(faces_in);
    for part in source.parts {
        let base = mesh.positions.len() as u32;
        let count = part.faces.len();
        mesh.positions.extend(part.positions.iter().map(|p| on_grid(*p)));
        mesh.faces.extend(part.faces.iter().map(|f| f.map(|v| v + base)));
        mesh.face_material.extend(part.face_material);
        extend_or(&mut mesh.corner_uvs, part.corner_uvs, textured.then_some(count), Default::default());
        extend_or(&mut mesh.vertex_colors, part.vertex_colors, colored.then_some(part.positions.len()), [200; 3]);
        extend_or(&mut mesh.face_labels, part.face_labels, labelled.then_some(count), -1);
    }
    reporter.check()?;
    let root = weld(&mesh.positions, config.weld_m);
    let moved = |v: usize| (mesh.positions[root[v] as usize] - mesh.positions[v]).length();
    report.moved_m = (0..root.len()).filter(|&v| root[v] as usize != v).map(moved).fold(0.0, f64::max);
    for face in &mut mesh.faces {
        *face = face.map(|v| root[v as usize]);
    }
    reporter.check()?;
    clean(&mut mesh, &mut report);
    compact(&mut mesh);
    (report.vertices, report.faces) = (mesh.positions.len(), mesh.faces.len());
    Ok((mesh, report))
}

impl GateReport {
    /// Adds what another unit reports.
    pub fn add(&mut self, other: &Self) {
        self.vertices_in += other.vertices_in;
        self.vertices += other.vertices;
        self.faces_in += other.faces_in;
        self.faces += other.faces;
        self.degenerate += other.degenerate;
        self.duplicate += other.duplicate;
        self.not_finite += other.not_finite;
        self.moved_m = self.moved_m.max(other.moved_m);
    }

    /// Warns of what was dropped from the input `name`.
    ///
    /// # Errors
    /// An input of which nothing is left.
    pub fn say(&self, name: &std::path::Path, reporter: &Reporter) -> Result<()> {
        reporter.warn_many("dropped-degenerate", name, self.degenerate as u64, "triangles without area");
        reporter.warn_many("dropped-duplicate", name, self.duplicate as u64, "triangles that repeat another");
        let what = "triangles with a vertex that is not a finite number";
        reporter.warn_many("dropped-not-finite", name, self.not_finite as u64, what);
        if self.unmatched_m > 0.0 {
            let what = format!(
                "{:.1} m of borders of the input's files almost meet and do not; gate.weld_m closes wider gaps",
                self.unmatched_m
            );
            reporter.warn("cracks-between-files", name, what);
        }
        if self.faces == 0 {
            let what = format!("none of its {} triangles has an area; nothing to build", self.faces_in);
            return Err(Error::input(name, what));
        }
        Ok(())
    }
}

fn extend_or<T: Clone>(all: &mut Vec<T>, part: Vec<T>, wanted: Option<usize>, fill: T) {
    match wanted {
        Some(count) if part.is_empty() => all.resize(all.len() + count, fill),
        Some(_) => all.extend(part),
        None => {}
    }
}

/// For every vertex the lowest index of the group it is joined to.
fn weld(positions: &[DVec3], tolerance_m: f64) -> Vec<u32> {
    let cell_m = if tolerance_m > 0.0 { tolerance_m * CELL_TOLERANCES } else { EXACT_CELL_M };
    let mut filed: Vec<(u64, u32)> = (0..positions.len() as u32)
        .into_par_iter()
        .flat_map_iter(|v| {
            let p = positions[v as usize];
            let low = ((p - tolerance_m) / cell_m).floor();
            let high = ((p + tolerance_m) / cell_m).floor();
            let axis = |k: usize| [low[k], high[k]].into_iter().take(if low[k] == high[k] { 1 } else { 2 });
            let cells = axis(0).flat_map(move |x| axis(1).flat_map(move |y| axis(2).map(move |z| [x, y, z])));
            cells.map(move |cell| (hash(cell), v)).collect::<Vec<_>>()
        })
        .collect();
    filed.par_sort_unstable();
    let mut root: Vec<u32> = (0..positions.len() as u32).collect();
    let mut kept: Vec<u32> = Vec::new();
    for group in filed.chunk_by(|a, b| a.0 == b.0) {
        kept.clear();
        for &(_, v) in group {
            let p = positions[v as usize];
            let near =
                kept.iter().find(|&&k| (positions[k as usize] - p).length_squared() <= tolerance_m * tolerance_m);
            match near {
                Some(&k) => join(&mut root, k, v),
                None if p.is_finite() => kept.push(v),
                None => {}
            }
        }
    }
    for v in 0..root.len() as u32 {
        root[v as usize] = find(&root, v);
    }
    root
}

fn find(root: &[u32], mut v: u32) -> u32 {
    while root[v as usize] != v {
        v = root[v as usize];
    }
    v
}

fn join(root: &mut [u32], a: u32, b: u32) {
    let (a, b) = (find(root, a), find(root, b));
    root[a.max(b) as usize] = a.min(b);
}

/// Collisions cost time, never a wrong join: distances are checked.
fn hash(cell: [f64; 3]) -> u64 {
    cell.iter().fold(0x9E37_79B9_7F4A_7C15u64, |h, c| {
        (h ^ (*c as i64 as u64)).wrapping_mul(0xD6E8_FEB8_6659_FD93).rotate_left(29)
    })
}

/// Drops faces that carry no surface of their own.
fn clean(mesh: &mut Mesh, report: &mut GateReport) {
    let mut keys: Vec<([u32; 3], u32)> =
        mesh.faces.par_iter().enumerate().map(|(f, face)| (sorted(*face), f as u32)).collect();
    keys.par_sort_unstable();
    let mut keep = vec![true; mesh.faces.len()];
    for pair in keys.windows(2) {
        if pair[0].0 == pair[1].0 {
            keep[pair[1].1 as usize] = false;
        }
    }
    drop(keys);
    for (f, keep) in keep.iter_mut().enumerate() {
        let [a, b, c] = mesh.faces[f];
        if !mesh.corners(f).iter().all(|p| p.is_finite()) {
            report.not_finite += 1;
            *keep = false;
        } else if a == b || b == c || c == a || mesh.cross(f).length_squared() == 0.0 {
            report.degenerate += 1;
            *keep = false;
        } else if !*keep {
            report.duplicate += 1;
        }
    }
    mesh.retain_faces(&keep);
}

fn sorted(mut face: [u32; 3]) -> [u32; 3] {
    face.sort_unstable();
    face
}

/// Drops vertices that no face uses; the order of the others stays.
fn compact(mesh: &mut Mesh) {
    let mut new_id = vec![u32::MAX; mesh.positions.len()];
    for v in mesh.faces.iter().flatten() {
        new_id[*v as usize] = 0;
    }
    let mut count = 0;
    for (v, id) in new_id.iter_mut().enumerate() {
        if *id == 0 {
            *id = count;
            mesh.positions[count as usize] = mesh.positions[v];
            if !mesh.vertex_colors.is_empty() {
                mesh.vertex_colors[count as usize] = mesh.vertex_colors[v];
            }
            count += 1;
        }
    }
    mesh.positions.truncate(count as usize);
    mesh.positions.shrink_to_fit();
    mesh.vertex_colors.truncate(count as usize);
    for face in &mut mesh.faces {
        *face = face.map(|v| new_id[v as usize]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::Part;

    fn source(positions: &[[f64; 3]], faces: &[[u32; 3]]) -> Source {
        let part = Part {
            positions: positions.iter().map(|p| DVec3::from_array(*p)).collect(),
            faces: faces.to_vec(),
            face_material: vec![0; faces.len()],
            ..Part::default()
        };
        Source { parts: vec![part], ..Source::default() }
    }

    fn gated(positions: &[[f64; 3]], faces: &[[u32; 3]]) -> (Mesh, GateReport) {
        let (mesh, report) = gate(source(positions, faces), &GateConfig::default(), &Reporter::new(true)).unwrap();
        mesh.check().unwrap();
        (mesh, report)
    }

    const SQUARE: [[f64; 3]; 4] = [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [0., 1., 0.]];

    #[test]
    fn vertices_within_the_tolerance_become_one_wherever_the_grid_lies() {
        for shift in 0..40 {
            let s = f64::from(shift) * 0.0003;
            let twin = [
                [0. + s, 0., 0.],
                [1. + s, 0., 0.],
                [1. + s, 1., 0.],
                [s, 0.0, 0.0007],
                [1. + s, 1.0004, 0.],
                [s, 1., 0.],
            ];
            let (mesh, report) = gated(&twin, &[[0, 1, 2], [3, 4, 5]]);
            assert_eq!((mesh.positions.len(), report.faces), (4, 2), "shift {s}");
        }
    }

    #[test]
    fn the_report_says_how_far_welding_moved_a_vertex() {
        let near = [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [0.0008, 0., 0.], [0., 1., 0.]];
        let (mesh, report) = gated(&near, &[[0, 1, 2], [3, 2, 4]]);
        assert_eq!(mesh.positions.len(), 4);
        assert!((report.moved_m - 0.0008).abs() < 1e-5, "{}", report.moved_m);
    }

    #[test]
    fn vertices_beyond_the_tolerance_stay_apart() {
        let (mesh, _) =
            gated(&[SQUARE[0], SQUARE[1], SQUARE[2], [0., 0., 0.003], SQUARE[2], SQUARE[3]], &[[0, 1, 2], [3, 4, 5]]);
        assert_eq!(mesh.positions.len(), 5);
    }

    #[test]
    fn degenerate_duplicate_and_unbounded_faces_are_dropped_and_counted() {
        let mut positions = SQUARE.to_vec();
        positions.extend([[2., 0., 0.], [f64::NAN, 0., 0.]]);
        let faces = [[0, 1, 2], [1, 2, 0], [2, 1, 0], [0, 0, 1], [0, 1, 4], [0, 1, 5], [0, 2, 3]];
        let (mesh, report) = gated(&positions, &faces);
        assert_eq!((report.duplicate, report.degenerate, report.not_finite), (2, 2, 1));
        assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 3]]);
    }

    #[test]
    fn an_input_without_surface_is_refused() {
        let refused = gate(source(&SQUARE, &[[0, 0, 0]]), &GateConfig::default(), &Reporter::new(true));
        assert_eq!(refused.unwrap_err().exit_code(), 3);
    }
}
