//! Cuts a mesh along the walls of an adaptive quadtree, without a crack.
//!
//! In: [`Mesh`] and a weight per face. Out: [`Partition`]: the same surface with every face inside one leaf cell.
//!
//! # Method
//! 1. Cells are split by the weight of the face centres in them until a leaf holds at most the weight allowed.
//! 2. Vertices within [`SNAP_M`] of a wall of their cell move onto it, so that no cut leaves a sliver.
//! 3. A face is clipped down the tree, x before y; a cut on an edge depends on the edge and the tree alone, so both faces
//!    of an edge get the same vertex. Edges that lie on a wall are cut where the cells of the other side cut them.
//! 4. The pieces, convex, are triangulated; texture coordinates follow by barycentric interpolation (affine, so exact).
//!
//! # Promises
//! Area and topology stay (`the_cut_surface_is_the_same_surface`); no T-junctions (`every_inner_edge_has_two_faces`).
//! No vertex of the source moves by more than [`SNAP_M`].

use std::collections::HashMap;

use glam::{DVec2, DVec3, Vec2};
use rayon::prelude::*;

use crate::geo::Rect;
use crate::mesh::{GRID_PER_M, Mesh, on_grid};

/// Vertices this near to a wall are moved onto it, metres: the rounding of published coordinates.
pub const SNAP_M: f64 = 1e-4;
/// The tree is never deeper.
const DEEPEST: u8 = 14;

/// A cell of the quadtree in plan.
#[derive(Debug, Clone)]
pub struct Cell {
    /// Where it is, local metres.
    pub plan: Rect,
    /// Root: 0.
    pub depth: u8,
    /// South-west, south-east, north-west, north-east; none for a leaf.
    pub children: Option<[u32; 4]>,
    /// Root: itself.
    pub parent: u32,
}

/// A mesh whose faces each lie in one leaf cell, ordered by leaf.
#[derive(Debug, Clone, Default)]
pub struct Partition {
    /// The cut surface.
    pub mesh: Mesh,
    /// The face of the uncut mesh each face comes from.
    pub origin: Vec<u32>,
    /// The leaf cell of each face.
    pub leaf: Vec<u32>,
    /// All cells, root first, parents before children.
    pub cells: Vec<Cell>,
    /// Furthest that a vertex was moved onto a wall, metres.
    pub moved_m: f64,
}

impl Partition {
    /// Cuts `mesh` into leaves of at most `most` weight where the depth allows it.
    pub fn of(mesh: Mesh, weight: impl Fn(usize) -> f64 + Sync, most: f64) -> Self {
        let cells = grow(&mesh, &weight, most);
        let tree = Tree(&cells);
        let mut mesh = mesh;
        let snapped: Vec<DVec3> = mesh.positions.par_iter().map(|p| tree.snapped(*p)).collect();
        let moved_m = mesh.positions.iter().zip(&snapped).map(|(p, q)| (*p - *q).length()).fold(0.0, f64::max);
        mesh.positions = snapped;
        let pieces: Vec<Vec<Piece>> =
            (0..mesh.faces.len()).into_par_iter().map(|f| tree.clip(mesh.corners(f))).collect();
        Self { moved_m, ..Cutter::new(&mesh).assemble(pieces, cells) }
    }

    /// The ancestor of leaf `cell` at `depth`, or the leaf itself if it is not deeper.
    pub fn ancestor(&self, cell: u32, depth: u8) -> u32 {
        let mut at = cell;
        while self.cells[at as usize].depth > depth {
            at = self.cells[at as usize].parent;
        }
        at
    }

    /// A name for a cell: `r` for the root, then a digit a level (0 south-west, 1 south-east, 2 north-west, 3 north-east).
    pub fn key(&self, cell: u32) -> String {
        let mut digits = Vec::new();
        let mut at = cell;
        while self.cells[at as usize].depth > 0 {
            let parent = self.cells[at as usize].parent;
            let first = self.cells[parent as usize].children.map_or(at, |c| c[0]);
            digits.push(char::from(b'0' + (at - first) as u8));
            at = parent;
        }
        digits.push('r');
        digits.iter().rev().collect()
    }

    /// Depth of the deepest leaf.
    pub fn depth(&self) -> u8 {
        self.cells.iter().map(|c| c.depth).max().unwrap_or(0)
    }
}

fn grow(mesh: &Mesh, weight: &(impl Fn(usize) -> f64 + Sync), most: f64) -> Vec<Cell> {
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for p in &mesh.positions {
        (low, high) = (low.min(p.truncate()), high.max(p.truncate()));
    }
    // A square on the grid whose halves stay on the grid down to the deepest cell.
    let unit = f64::from(1u32 << DEEPEST) / GRID_PER_M;
    let half = (((high - low).max_element() * 0.5 + SNAP_M) / unit).ceil().max(1.0) * unit;
    let center = ((low + high) * 0.5 / unit).round() * unit;
    let half = half + unit;
    let root = Cell { plan: Rect { min: center - half, max: center + half }, depth: 0, children: None, parent: 0 };
    let centers: Vec<(DVec2, f64)> = (0..mesh.faces.len())
        .into_par_iter()
        .map(|f| (mesh.corners(f).iter().map(|p| p.truncate()).sum::<DVec2>() / 3.0, weight(f)))
        .collect();
    let mut cells = vec![root];
    let mut open = vec![(0u32, (0..mesh.faces.len() as u32).collect::<Vec<_>>())];
    while let Some((at, faces)) = open.pop() {
        let total: f64 = faces.iter().map(|&f| centers[f as usize].1).sum();
        let Cell { plan, depth, .. } = cells[at as usize];
        if total <= most || depth == DEEPEST {
            continue;
        }
        let middle = plan.center();
        let mut parts: [Vec<u32>; 4] = Default::default();
        for f in faces {
            parts[quadrant(centers[f as usize].0, middle)].push(f);
        }
        let first = cells.len() as u32;
        cells[at as usize].children = Some([first, first + 1, first + 2, first + 3]);
        for (i, part) in parts.into_iter().enumerate() {
            let low = DVec2::new(
                if i & 1 == 0 { plan.min.x } else { middle.x },
                if i & 2 == 0 { plan.min.y } else { middle.y },
            );
            let high = DVec2::new(
                if i & 1 == 0 { middle.x } else { plan.max.x },
                if i & 2 == 0 { middle.y } else { plan.max.y },
            );
            cells.push(Cell { plan: Rect { min: low, max: high }, depth: depth + 1, children: None, parent: at });
            open.push((first + i as u32, part));
        }
    }
    cells
}

fn quadrant(p: DVec2, middle: DVec2) -> usize {
    usize::from(p.x >= middle.x) + 2 * usize::from(p.y >= middle.y)
}

/// A corner of a piece: where it is, and its barycentric coordinates in the face it was cut from.
#[derive(Debug, Clone, Copy)]
struct Corner {
    at: DVec3,
    share: DVec3,
}

/// The part of a face in one leaf, convex, possibly with corners inside straight sides.
#[derive(Debug, Clone)]
struct Piece {
    leaf: u32,
    corners: Vec<Corner>,
    /// The face as it was: nothing was cut.
    whole: bool,
}

#[derive(Clone, Copy)]
struct Tree<'a>(&'a [Cell]);

impl Tree<'_> {
    fn middle(&self, cell: u32) -> DVec2 {
        self.0[cell as usize].plan.center()
    }

    /// `p`, on each wall of its cells that it is within `SNAP_M` of.
    fn snapped(&self, mut p: DVec3) -> DVec3 {
        let mut at = 0;
        while let Some(children) = self.0[at as usize].children {
            let middle = self.middle(at);
            for k in 0..2 {
                if (p[k] - middle[k]).abs() <= SNAP_M {
                    p[k] = middle[k];
                }
            }
            at = children[quadrant(p.truncate(), middle)];
        }
        p
    }

    /// The pieces of a triangle, by leaf.
    fn clip(&self, triangle: [DVec3; 3]) -> Vec<Piece> {
        let shares = [DVec3::X, DVec3::Y, DVec3::Z];
        let corners: Vec<Corner> = (0..3).map(|k| Corner { at: triangle[k], share: shares[k] }).collect();
        let mut pieces = Vec::new();
        self.clip_into(0, corners, &mut pieces);
        let single = pieces.len() == 1;
        for piece in &mut pieces {
            self.insert_hanging(&mut piece.corners);
            piece.whole = single && piece.corners.len() == 3;
        }
        pieces
    }

    fn clip_into(&self, cell: u32, polygon: Vec<Corner>, pieces: &mut Vec<Piece>) {
        let Some(children) = self.0[cell as usize].children else {
            pieces.push(Piece { leaf: cell, corners: polygon, whole: false });
            return;
        };
        let middle = self.middle(cell);
        let (west, east) = split(polygon, 0, middle.x);
        for (i, half) in [west, east].into_iter().enumerate() {
            let (south, north) = split(half, 1, middle.y);
            for (j, quarter) in [south, north].into_iter().enumerate() {
                if quarter.len() >= 3 {
                    self.clip_into(children[i + 2 * j], quarter, pieces);
                }
            }
        }
    }

    /// Adds the cuts that cells across a wall make on sides that lie on it.
    fn insert_hanging(&self, corners: &mut Vec<Corner>) {
        let on_wall = |a: &Corner, b: &Corner| a.at.x == b.at.x || a.at.y == b.at.y;
        if !(0..corners.len()).any(|i| on_wall(&corners[i], &corners[(i + 1) % corners.len()])) {
            return;
        }
        let mut all = Vec::with_capacity(corners.len() + 2);
        for i in 0..corners.len() {
            let (a, b) = (corners[i], corners[(i + 1) % corners.len()]);
            all.push(a);
            if on_wall(&a, &b) {
                self.cut_side(0, a, b, &mut all);
            }
        }
        *corners = all;
    }

    /// Pushes the cuts strictly between `a` and `b`, in order, that the closed cells below `cell` make.
    fn cut_side(&self, cell: u32, a: Corner, b: Corner, cuts: &mut Vec<Corner>) {
        let Cell { plan, children, .. } = &self.0[cell as usize];
        let Some(children) = children else { return };
        let (low, high) = (a.at.min(b.at).truncate(), a.at.max(b.at).truncate());
        if low.cmpgt(plan.max).any() || high.cmplt(plan.min).any() {
            return;
        }
        let middle = self.middle(cell);
        for k in 0..2 {
            let (da, db) = (a.at[k] - middle[k], b.at[k] - middle[k]);
            if da * db < 0.0 {
                let r = cut(&a, &b, k, middle[k]);
                if r.at != a.at && r.at != b.at {
                    self.cut_side(cell, a, r, cuts);
                    cuts.push(r);
                    self.cut_side(cell, r, b, cuts);
                    return;
                }
            }
        }
        let mut found: Vec<Corner> = Vec::new();
        for child in children {
            let mut more = Vec::new();
            self.cut_side(*child, a, b, &mut more);
            // A side on a wall is inside two children; both may cut it.
            found.extend(more);
        }
        let along = b.at - a.at;
        found.sort_by(|p, q| along.dot(p.at).total_cmp(&along.dot(q.at)));
        found.dedup_by(|p, q| p.at == q.at);
        cuts.extend(found);
    }
}

/// The parts of a convex polygon below and above `value` on an axis; corners on the wall go to both.
fn split(polygon: Vec<Corner>, axis: usize, value: f64) -> (Vec<Corner>, Vec<Corner>) {
    if polygon.iter().all(|c| c.at[axis] <= value) {
        // A face that lies in the wall belongs below it, and only there.
        return (polygon, Vec::new());
    }
    if polygon.iter().all(|c| c.at[axis] >= value) {
        return (Vec::new(), polygon);
    }
    let (mut below, mut above) = (Vec::with_capacity(polygon.len() + 1), Vec::with_capacity(polygon.len() + 1));
    for i in 0..polygon.len() {
        let (a, b) = (polygon[i], polygon[(i + 1) % polygon.len()]);
        let (da, db) = (a.at[axis] - value, b.at[axis] - value);
        if da <= 0.0 {
            below.push(a);
        }
        if da >= 0.0 {
            above.push(a);
        }
        if da * db < 0.0 {
            let r = cut(&a, &b, axis, value);
            below.push(r);
            above.push(r);
        }
    }
    (below, above)
}

/// Where side `ab` meets the wall. The same bits for `ba`, and for every face that has the side.
fn cut(a: &Corner, b: &Corner, axis: usize, value: f64) -> Corner {
    let key = |c: &Corner| [c.at.x, c.at.y, c.at.z];
    let (a, b) = if key(a) <= key(b) { (a, b) } else { (b, a) };
    let t = (value - a.at[axis]) / (b.at[axis] - a.at[axis]);
    let mut at = on_grid(a.at + (b.at - a.at) * t);
    at[axis] = value;
    // A side along the other wall stays on it.
    let other = 1 - axis;
    if a.at[other] == b.at[other] {
        at[other] = a.at[other];
    }
    Corner { at, share: a.share + (b.share - a.share) * t }
}

/// A triangle of the cut mesh.
struct Row {
    leaf: u32,
    /// The face it is part of.
    face: u32,
    corners: [u32; 3],
    /// Barycentric coordinates of its corners in that face, where they are not the face's own.
    shares: Option<[DVec3; 3]>,
}

/// Puts pieces together into one mesh.
struct Cutter<'a> {
    mesh: &'a Mesh,
    positions: Vec<DVec3>,
    colors: Vec<[u8; 3]>,
    made: HashMap<[u64; 3], u32>,
}

impl<'a> Cutter<'a> {
    fn new(mesh: &'a Mesh) -> Self {
        Self { mesh, positions: mesh.positions.clone(), colors: mesh.vertex_colors.clone(), made: HashMap::new() }
    }

    fn assemble(mut self, pieces: Vec<Vec<Piece>>, cells: Vec<Cell>) -> Partition {
        let mut rows: Vec<Row> = Vec::with_capacity(pieces.len());
        for (f, of_face) in pieces.into_iter().enumerate() {
            for piece in of_face {
                if piece.whole {
                    rows.push(Row { leaf: piece.leaf, face: f as u32, corners: self.mesh.faces[f], shares: None });
                    continue;
                }
                let ids: Vec<u32> = piece.corners.iter().map(|c| self.vertex(f, c)).collect();
                for triangle in triangulate(&piece.corners) {
                    let [a, b, c] = triangle.map(|i| ids[i]);
                    if a != b && b != c && c != a {
                        let shares = Some(triangle.map(|i| piece.corners[i].share));
                        rows.push(Row { leaf: piece.leaf, face: f as u32, corners: [a, b, c], shares });
                    }
                }
            }
        }
        rows.sort_by_key(|r| r.leaf);
        let mesh = self.mesh;
        let corner_uvs = |row: &Row| {
            let uvs = mesh.corner_uvs[row.face as usize];
            row.shares.map_or(uvs, |shares| {
                shares.map(|s| {
                    let [a, b, c] = uvs.map(|uv: Vec2| uv.as_dvec2());
                    (a * s.x + b * s.y + c * s.z).as_vec2()
                })
            })
        };
        let by_face = |row: &Row| row.face as usize;
        Partition {
            leaf: rows.iter().map(|r| r.leaf).collect(),
            origin: rows.iter().map(|r| r.face).collect(),
            mesh: Mesh {
                positions: self.positions,
                faces: rows.iter().map(|r| r.corners).collect(),
                corner_uvs: if mesh.corner_uvs.is_empty() { Vec::new() } else { rows.iter().map(corner_uvs).collect() },
                face_material: rows.iter().map(|r| mesh.face_material[by_face(r)]).collect(),
                face_labels: if mesh.face_labels.is_empty() {
                    Vec::new()
                } else {
                    rows.iter().map(|r| mesh.face_labels[by_face(r)]).collect()
                },
                vertex_colors: self.colors,
                materials: mesh.materials.clone(),
            },
            cells,
            moved_m: 0.0,
        }
    }

    /// The vertex of a corner: the face's own, or one made at that very place before, or a new one.
    fn vertex(&mut self, f: usize, corner: &Corner) -> u32 {
        let face = self.mesh.faces[f];
        if let Some(k) = (0..3).find(|&k| corner.share[k] == 1.0) {
            return face[k];
        }
        let key = corner.at.to_array().map(f64::to_bits);
        *self.made.entry(key).or_insert_with(|| {
            self.positions.push(corner.at);
            if !self.colors.is_empty() {
                let mix = |i: usize| {
                    (0..3)
                        .map(|k| f64::from(self.mesh.vertex_colors[face[k] as usize][i]) * corner.share[k])
                        .sum::<f64>()
                };
                self.colors.push([0, 1, 2].map(|i| mix(i).round() as u8));
            }
            self.positions.len() as u32 - 1
        })
    }
}

/// Triangles of a convex polygon by clipping ears, the roundest first; corners inside straight sides are welcome.
fn triangulate(corners: &[Corner]) -> Vec<[usize; 3]> {
    let mut left: Vec<usize> = (0..corners.len()).collect();
    let mut triangles = Vec::with_capacity(corners.len().saturating_sub(2));
    let roundness = |[a, b, c]: [usize; 3]| {
        let [a, b, c] = [a, b, c].map(|i| corners[i].at);
        let sides = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
        if sides > 0.0 { (b - a).cross(c - a).length() / sides } else { 0.0 }
    };
    while left.len() >= 3 {
        let n = left.len();
        let ear = |i: usize| [left[(i + n - 1) % n], left[i], left[(i + 1) % n]];
        // An ear that leaves only corners of one straight side would open the surface there.
        let value = |i: usize| if n == 3 || leaves_area(corners, &left, i) { roundness(ear(i)) } else { -1.0 };
        let best = (0..n).max_by(|&i, &j| value(i).total_cmp(&value(j)).then(j.cmp(&i))).unwrap_or(0);
        let triangle = ear(best);
        if roundness(triangle) > 0.0 {
            triangles.push(triangle);
        }
        left.remove(best);
    }
    triangles
}

/// False where the polygon `left` without corner `gone` is flat.
fn leaves_area(corners: &[Corner], left: &[usize], gone: usize) -> bool {
    let rest: Vec<DVec3> = (0..left.len()).filter(|&i| i != gone).map(|i| corners[left[i]].at).collect();
    let fan = |i: usize| (rest[i] - rest[0]).cross(rest[i + 1] - rest[0]);
    let area: DVec3 = (1..rest.len() - 1).map(fan).sum();
    let around: f64 = (0..rest.len()).map(|i| (rest[(i + 1) % rest.len()] - rest[i]).length()).sum();
    // Flat to within the grid that positions sit on.
    area.length() > 4.0 * around / GRID_PER_M
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// A rough sheet of n × n cells with one dense corner, so that the tree is uneven.
    fn sheet() -> Mesh {
        let mut xs: Vec<f64> = (0..20).map(f64::from).collect();
        xs.extend((1..30).map(|i| 19.0 + f64::from(i) * 0.05));
        let n = xs.len();
        let mut mesh = Mesh::default();
        for y in &xs {
            for x in &xs {
                mesh.positions.push(on_grid(DVec3::new(x * 1.013, y * 0.997, (x * 3.1).sin() + (y * 1.7).cos())));
            }
        }
        for y in 0..n - 1 {
            for x in 0..n - 1 {
                let a = (y * n + x) as u32;
                let m = n as u32;
                mesh.faces.extend([[a, a + 1, a + m + 1], [a, a + m + 1, a + m]]);
            }
        }
        mesh.corner_uvs =
            mesh.faces.iter().map(|f| f.map(|v| mesh.positions[v as usize].truncate().as_vec2() / 32.0)).collect();
        mesh.face_material = vec![0; mesh.faces.len()];
        mesh
    }

    fn area(mesh: &Mesh) -> f64 {
        (0..mesh.faces.len()).map(|f| mesh.cross(f).length() * 0.5).sum()
    }

    #[test]
    fn the_cut_surface_is_the_same_surface() {
        let mesh = sheet();
        let before = area(&mesh);
        let partition = Partition::of(mesh, |_| 1.0, 40.0);
        partition.mesh.check().unwrap();
        assert!(partition.depth() >= 4, "depth {}", partition.depth());
        assert!((area(&partition.mesh) - before).abs() < 1e-3 * before.sqrt(), "{} {before}", area(&partition.mesh));
        for (f, &leaf) in partition.leaf.iter().enumerate() {
            let plan = partition.cells[leaf as usize].plan;
            assert!(partition.cells[leaf as usize].children.is_none());
            assert!(partition.mesh.corners(f).iter().all(|p| plan.contains(p.truncate(), 0.0)));
        }
    }

    #[test]
    fn every_inner_edge_has_two_faces() {
        let partition = Partition::of(sheet(), |_| 1.0, 40.0);
        let mut edges: BTreeMap<(u32, u32), u32> = BTreeMap::new();
        for &[a, b, c] in &partition.mesh.faces {
            for (u, v) in [(a, b), (b, c), (c, a)] {
                *edges.entry((u.min(v), u.max(v))).or_default() += 1;
            }
        }
        let (low, high) = partition
            .mesh
            .positions
            .iter()
            .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(l, h), p| (l.min(p.truncate()), h.max(p.truncate())));
        for ((u, v), count) in edges {
            let [p, q] = [u, v].map(|v| partition.mesh.positions[v as usize]);
            let outer = (0..2).any(|k| {
                (p[k] - low[k]).abs() < 2e-6 && (q[k] - low[k]).abs() < 2e-6
                    || (p[k] - high[k]).abs() < 2e-6 && (q[k] - high[k]).abs() < 2e-6
            });
            assert_eq!(count, if outer { 1 } else { 2 }, "{p} {q}");
        }
    }

    #[test]
    fn texture_coordinates_stay_where_they_were() {
        let partition = Partition::of(sheet(), |_| 1.0, 40.0);
        for (f, uvs) in partition.mesh.corner_uvs.iter().enumerate() {
            for (p, uv) in partition.mesh.corners(f).iter().zip(uvs) {
                assert!((p.truncate().as_vec2() / 32.0 - *uv).length() < 1e-4);
            }
        }
    }

    #[test]
    fn a_huge_triangle_beside_a_dense_patch_is_cut_only_where_it_must_be() {
        let mut mesh = sheet();
        let base = mesh.positions.len() as u32;
        mesh.positions.extend([DVec3::new(-5e4, -5e4, -9.0), DVec3::new(5e4, -5e4, -9.0), DVec3::new(0.0, 5e4, -9.0)]);
        mesh.faces.push([base, base + 1, base + 2]);
        mesh.corner_uvs.push(Default::default());
        mesh.face_material.push(0);
        let partition = Partition::of(mesh, |_| 1.0, 40.0);
        assert!(partition.mesh.faces.len() < 12_000, "{}", partition.mesh.faces.len());
    }
}
