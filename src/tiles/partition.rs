//! Cuts meshes along the walls of an adaptive quadtree, without a crack.
//!
//! In: where the weight of the faces lies, then meshes part by part. Out: [`Quadtree`] and [`Soup`]s: the same surface
//! with every face inside one leaf cell.
//!
//! # Method
//! 1. Cells are split by the weight of the face centres in them until a leaf holds at most the weight allowed.
//! 2. Vertices within [`SNAP_M`] of a wall of their cell move onto it, so that no cut leaves a sliver; of several files
//!    those within the weld tolerance, so that files that meet near a wall meet on it.
//! 3. A face is clipped down the tree, x before y; a cut on an edge depends on the edge and the tree alone, so both faces
//!    of an edge get the same vertex. Edges that lie on a wall are cut where the cells of the other side cut them.
//! 4. The pieces, convex, are triangulated; texture coordinates follow by barycentric interpolation (affine, so exact).
//!
//! A vertex is its position: welded vertices differ in it, and both sides of a wall compute the same bits.
//!
//! # Promises
//! Area and topology stay (`the_cut_surface_is_the_same_surface`); no T-junctions (`every_inner_edge_has_two_faces`).
//! No vertex of the source moves by more than is asked for.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::soup::Soup;
use crate::geo::Rect;
use crate::mesh::{GRID_PER_M, Mesh, on_grid};

/// Vertices this near to a wall are moved onto it, metres: the rounding of published coordinates.
pub const SNAP_M: f64 = 1e-4;
/// The tree is never deeper.
const DEEPEST: u8 = 14;

/// A cell of the quadtree in plan.
#[derive(Debug, Clone, Serialize, Deserialize)]
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

/// The cells, root first, parents before children.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Quadtree(pub Vec<Cell>);

/// Where in a square the faces are: a Morton code of [`DEEPEST`] levels for each face's centre, with its weight.
#[derive(Debug, Clone)]
pub struct Census {
    square: Rect,
    weights: Vec<(u32, f32)>,
    /// Levels that codes have lost, so that the list stays short.
    coarser: u32,
}

/// A census longer than this is merged one level coarser, entries of 8 bytes.
const MOST_ENTRIES: usize = 1 << 26;

impl Census {
    /// An empty one over the square that holds `bounds`.
    pub fn over(bounds: Rect) -> Self {
        // A square on the grid whose halves stay on the grid down to the deepest cell.
        let unit = f64::from(1u32 << DEEPEST) / GRID_PER_M;
        let half = ((bounds.size().max_element() * 0.5 + SNAP_M) / unit).ceil().max(1.0) * unit;
        let center = (bounds.center() / unit).round() * unit;
        let half = half + unit;
        Self { square: Rect { min: center - half, max: center + half }, weights: Vec::new(), coarser: 0 }
    }

    /// Counts the faces of a mesh.
    pub fn count(&mut self, mesh: &Mesh, weight: impl Fn(usize) -> f64 + Sync) {
        let side = self.square.size().x;
        let most = f64::from((1u32 << DEEPEST) - 1);
        let coarser = self.coarser;
        let entry = |f: usize| {
            let center = mesh.corners(f).iter().map(|p| p.truncate()).sum::<DVec2>() / 3.0;
            let at = ((center - self.square.min) / side * f64::from(1u32 << DEEPEST)).floor();
            let at = at.clamp(DVec2::ZERO, DVec2::splat(most));
            (interleaved(at.x as u32, at.y as u32) >> (2 * coarser), weight(f) as f32)
        };
        self.weights.par_extend((0..mesh.faces.len()).into_par_iter().map(entry));
        while self.weights.len() > MOST_ENTRIES && u32::from(DEEPEST) > self.coarser + 1 {
            self.coarser += 1;
            self.weights.iter_mut().for_each(|w| w.0 >>= 2);
            // Stable, so that sums have one order.
            self.weights.sort_by_key(|w| w.0);
            let mut merged: Vec<(u32, f32)> = Vec::new();
            for &(code, weight) in &self.weights {
                match merged.last_mut() {
                    Some(last) if last.0 == code => last.1 += weight,
                    _ => merged.push((code, weight)),
                }
            }
            self.weights = merged;
        }
    }
}

/// The bits of `x` at even, of `y` at odd places.
fn interleaved(x: u32, y: u32) -> u32 {
    (0..u32::from(DEEPEST)).fold(0, |code, bit| code | (x >> bit & 1) << (2 * bit) | (y >> bit & 1) << (2 * bit + 1))
}

impl Quadtree {
    /// Splits cells until leaves have at most `most` weight, where the depth allows it.
    pub fn of(census: Census, most: f64) -> Self {
        let Census { square, mut weights, coarser } = census;
        weights.par_sort_by_key(|w| w.0);
        let deepest = DEEPEST - coarser as u8;
        let mut cells = vec![Cell { plan: square, depth: 0, children: None, parent: 0 }];
        let mut open = vec![(0u32, 0..weights.len())];
        while let Some((at, range)) = open.pop() {
            let total: f64 = weights[range.clone()].iter().map(|w| f64::from(w.1)).sum();
            let Cell { plan, depth, .. } = cells[at as usize];
            if total <= most || depth == deepest {
                continue;
            }
            let shift = 2 * u32::from(deepest - depth - 1);
            let middle = plan.center();
            let first = cells.len() as u32;
            cells[at as usize].children = Some([first, first + 1, first + 2, first + 3]);
            let mut start = range.start;
            for i in 0..4u32 {
                let end = start + weights[start..range.end].partition_point(|w| w.0 >> shift & 3 <= i);
                let low = DVec2::new(
                    if i & 1 == 0 { plan.min.x } else { middle.x },
                    if i & 2 == 0 { plan.min.y } else { middle.y },
                );
                let high = DVec2::new(
                    if i & 1 == 0 { middle.x } else { plan.max.x },
                    if i & 2 == 0 { middle.y } else { plan.max.y },
                );
                cells.push(Cell { plan: Rect { min: low, max: high }, depth: depth + 1, children: None, parent: at });
                open.push((first + i, start..end));
                start = end;
            }
        }
        Self(cells)
    }

    /// The ancestor of `cell` at `depth`, or the cell itself if it is not deeper.
    pub fn ancestor(&self, cell: u32, depth: u8) -> u32 {
        let mut at = cell;
        while self.0[at as usize].depth > depth {
            at = self.0[at as usize].parent;
        }
        at
    }

    /// A name for a cell: `r` for the root, then a digit a level (0 south-west, 1 south-east, 2 north-west, 3 north-east).
    pub fn key(&self, cell: u32) -> String {
        let mut digits = Vec::new();
        let mut at = cell;
        while self.0[at as usize].depth > 0 {
            let parent = self.0[at as usize].parent;
            let first = self.0[parent as usize].children.map_or(at, |c| c[0]);
            digits.push(char::from(b'0' + (at - first) as u8));
            at = parent;
        }
        digits.push('r');
        digits.iter().rev().collect()
    }

    /// Depth of the deepest leaf.
    pub fn depth(&self) -> u8 {
        self.0.iter().map(|c| c.depth).max().unwrap_or(0)
    }

    /// The cells of `depth`, and leaves above it, whose closed plan holds `p`: several where `p` is on a wall.
    pub fn touching(&self, p: DVec2, depth: u8, mut visit: impl FnMut(u32)) {
        let mut open = vec![0u32];
        while let Some(at) = open.pop() {
            match self.0[at as usize].children {
                Some(children) if self.0[at as usize].depth < depth => {
                    open.extend(children.into_iter().filter(|&c| self.0[c as usize].plan.contains(p, 0.0)));
                }
                _ => visit(at),
            }
        }
    }

    /// Moves the vertices of a mesh that are within `near_m` of a wall onto it; returns how far at most, metres.
    pub fn snap(&self, mesh: &mut Mesh, near_m: f64) -> f64 {
        let tree = Tree(&self.0);
        let moved = |p: &mut DVec3| {
            let at = tree.snapped(*p, near_m);
            let by = (at - *p).length();
            *p = at;
            by
        };
        mesh.positions.par_iter_mut().map(moved).reduce(|| 0.0, f64::max)
    }

    /// The faces of `range`, cut, with their leaf cells, by face. The mesh was snapped.
    pub fn cut(&self, mesh: &Mesh, range: std::ops::Range<usize>) -> Vec<(u32, Soup)> {
        let tree = Tree(&self.0);
        let pieces: Vec<Vec<Piece>> = range.clone().into_par_iter().map(|f| tree.clip(mesh.corners(f))).collect();
        let mut by_leaf: std::collections::BTreeMap<u32, Soup> = Default::default();
        for (f, pieces) in range.zip(pieces) {
            for piece in pieces {
                let soup = by_leaf.entry(piece.leaf).or_default();
                if piece.whole {
                    soup.push(mesh, f, mesh.corners(f), None);
                    continue;
                }
                for triangle in triangulate(&piece.corners) {
                    let [a, b, c] = triangle.map(|i| piece.corners[i].at);
                    if a != b && b != c && c != a {
                        soup.push(mesh, f, [a, b, c], Some(triangle.map(|i| piece.corners[i].share)));
                    }
                }
            }
        }
        by_leaf.into_iter().collect()
    }
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

    /// `p`, on each wall of its cells that it is within `near_m` of.
    fn snapped(&self, mut p: DVec3, near_m: f64) -> DVec3 {
        let mut at = 0;
        while let Some(children) = self.0[at as usize].children {
            let middle = self.middle(at);
            for k in 0..2 {
                if (p[k] - middle[k]).abs() <= near_m {
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
    use std::collections::BTreeMap;

    use super::*;

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

    /// The sheet cut into leaves of 40 faces, as one mesh again, and the leaf of each face.
    fn cut(mut mesh: Mesh) -> (Mesh, Vec<u32>, Quadtree) {
        let mut bounds = crate::geo::Aabb::of(mesh.positions.iter().copied()).plan();
        bounds = Rect { min: bounds.min, max: bounds.max };
        let mut census = Census::over(bounds);
        census.count(&mesh, |_| 1.0);
        let tree = Quadtree::of(census, 40.0);
        tree.snap(&mut mesh, SNAP_M);
        let (mut all, mut leaf) = (Soup::default(), Vec::new());
        for (cell, soup) in tree.cut(&mesh, 0..mesh.faces.len()) {
            leaf.extend(vec![cell; soup.len()]);
            all.append(soup);
        }
        (all.into_mesh(), leaf, tree)
    }

    fn area(mesh: &Mesh) -> f64 {
        (0..mesh.faces.len()).map(|f| mesh.cross(f).length() * 0.5).sum()
    }

    #[test]
    fn the_cut_surface_is_the_same_surface() {
        let mesh = sheet();
        let before = area(&mesh);
        let (mesh, leaf, tree) = cut(mesh);
        mesh.check().unwrap();
        assert!(tree.depth() >= 4, "depth {}", tree.depth());
        assert!((area(&mesh) - before).abs() < 1e-3 * before.sqrt(), "{} {before}", area(&mesh));
        for (f, &leaf) in leaf.iter().enumerate() {
            let plan = tree.0[leaf as usize].plan;
            assert!(tree.0[leaf as usize].children.is_none());
            assert!(mesh.corners(f).iter().all(|p| plan.contains(p.truncate(), 0.0)));
        }
    }

    #[test]
    fn every_inner_edge_has_two_faces() {
        let (mesh, ..) = cut(sheet());
        let mut edges: BTreeMap<(u32, u32), u32> = BTreeMap::new();
        for &[a, b, c] in &mesh.faces {
            for (u, v) in [(a, b), (b, c), (c, a)] {
                *edges.entry((u.min(v), u.max(v))).or_default() += 1;
            }
        }
        let plan = crate::geo::Aabb::of(mesh.positions.iter().copied()).plan();
        let (low, high) = (plan.min, plan.max);
        for ((u, v), count) in edges {
            let [p, q] = [u, v].map(|v| mesh.positions[v as usize]);
            let outer = (0..2).any(|k| {
                (p[k] - low[k]).abs() < 2e-6 && (q[k] - low[k]).abs() < 2e-6
                    || (p[k] - high[k]).abs() < 2e-6 && (q[k] - high[k]).abs() < 2e-6
            });
            assert_eq!(count, if outer { 1 } else { 2 }, "{p} {q}");
        }
    }

    #[test]
    fn texture_coordinates_stay_where_they_were() {
        let (mesh, ..) = cut(sheet());
        for (f, uvs) in mesh.corner_uvs.iter().enumerate() {
            for (p, uv) in mesh.corners(f).iter().zip(uvs) {
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
        let (mesh, ..) = cut(mesh);
        assert!(mesh.faces.len() < 12_000, "{}", mesh.faces.len());
    }

    #[test]
    fn a_point_on_a_wall_touches_the_cells_of_both_sides() {
        let (_, _, tree) = cut(sheet());
        let touching = |p: DVec2, depth: u8| {
            let mut found = Vec::new();
            tree.touching(p, depth, |c| found.push(c));
            found.sort_unstable();
            found
        };
        let middle = tree.0[0].plan.center();
        assert_eq!(touching(middle, 0), [0]);
        assert_eq!(touching(middle, 1), [1, 2, 3, 4]);
        assert_eq!(touching(middle + DVec2::new(0.0, 0.5), 1), [3, 4]);
        assert_eq!(touching(middle + DVec2::new(0.25, 0.5), 1), [4]);
    }
}
