//! Turns a signed distance into a welded triangle mesh by dual contouring on a lattice.
//!
//! # Method
//! 1. Signs at all lattice nodes, marching down columns and skipping by distance.
//! 2. Where the sign changes along a lattice edge: the crossing and its normal.
//! 3. One vertex for every loop of crossings around a cell, at the least-squares meeting point of their tangent
//!    planes, so that eaves and house corners stay sharp.
//! 4. One quad around every crossed edge, cut along the diagonal nearer to the surface.
//!
//! # References
//! Ju, Losasso, Schaefer, Warren, "Dual contouring of Hermite data", 2002; Nielson, "Dual marching cubes", 2004
//! (several vertices a cell). We regularise the quadric towards the mean crossing instead of truncating eigenvalues.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::field::Field;

/// A closed-up-to-its-border surface.
#[derive(Debug, Default, Clone)]
pub(super) struct Surface {
    pub(super) positions: Vec<DVec3>,
    pub(super) faces: Vec<[u32; 3]>,
}

/// The lattice: node (i, j, k) is at `low + voxel_m * (i, j, k)`.
struct Lattice {
    voxel_m: f64,
    low: DVec3,
    /// Nodes per axis.
    n: [usize; 3],
    /// Words of 64 signs per column.
    words: usize,
    /// Bit set: inside. Column (i, j) starts at `(j * n[0] + i) * words`.
    inside: Vec<u64>,
}

/// A crossed lattice edge from node k of a column along an axis.
#[derive(Clone, Copy)]
struct Crossing {
    /// `k * 4 + axis`.
    key: u32,
    point: DVec3,
    normal: DVec3,
}

/// The vertices of a crossed cell.
struct Cell {
    k: u32,
    /// First vertex, in the column until columns are joined.
    first: u32,
    /// Vertex of each of the cell's 12 edges, relative to `first`; 255 where not crossed.
    loops: [u8; 12],
}

/// Items by column, columns in order.
struct Columns<T> {
    start: Vec<u32>,
    items: Vec<T>,
}

impl<T: Send> Columns<T> {
    fn collect(count: usize, make: impl Fn(usize) -> Vec<T> + Send + Sync) -> Self {
        let lists: Vec<Vec<T>> = (0..count).into_par_iter().map(make).collect();
        let mut start = Vec::with_capacity(count + 1);
        let mut items = Vec::with_capacity(lists.iter().map(Vec::len).sum());
        start.push(0);
        for list in lists {
            items.extend(list);
            start.push(items.len() as u32);
        }
        Self { start, items }
    }

    fn of(&self, column: usize) -> &[T] {
        &self.items[self.start[column] as usize..self.start[column + 1] as usize]
    }
}

/// Meshes the zero level of `field` over a square of `extent_m` about the origin.
pub(super) fn extract(field: &Field, extent_m: f64, voxel_m: f64) -> Surface {
    let lattice = Lattice::sample(field, extent_m, voxel_m);
    let crossings = lattice.crossings(field);
    let (cells, positions) = lattice.cells(&crossings);
    let faces = lattice.faces(field, &crossings, &cells, &positions);
    Surface { positions, faces }
}

impl Lattice {
    fn sample(field: &Field, extent_m: f64, voxel_m: f64) -> Self {
        let half = (extent_m / 2.0 / voxel_m).floor() * voxel_m;
        let across = (2.0 * half / voxel_m).round() as usize + 1;
        let plan = |i: usize, j: usize| DVec3::new(-half + i as f64 * voxel_m, -half + j as f64 * voxel_m, 0.0);
        let columns = across * across;
        let heights: Vec<f64> = (0..columns)
            .into_par_iter()
            .map(|c| field.ground.height(plan(c % across, c / across).truncate()))
            .collect();
        let floor = heights.iter().copied().fold(f64::INFINITY, f64::min) - 2.0 * voxel_m;
        let tops = (0..columns).map(|c| field.top(plan(c % across, c / across).truncate(), heights[c]));
        let top = tops.fold(f64::NEG_INFINITY, f64::max) + 2.0 * voxel_m;
        let low = DVec3::new(-half, -half, floor);
        let nz = ((top - floor) / voxel_m).ceil() as usize + 1;
        let words = nz.div_ceil(64);
        let mut lattice = Self { voxel_m, low, n: [across, across, nz], words, inside: Vec::new() };
        lattice.inside = (0..columns).into_par_iter().flat_map_iter(|c| lattice.column(field, c, heights[c])).collect();
        lattice
    }

    fn node(&self, i: usize, j: usize, k: usize) -> DVec3 {
        self.low + self.voxel_m * DVec3::new(i as f64, j as f64, k as f64)
    }

    /// Signs of one column, from the top down.
    fn column(&self, field: &Field, column: usize, ground_m: f64) -> Vec<u64> {
        let (i, j) = (column % self.n[0], column / self.n[0]);
        let mut bits = vec![0; self.words];
        let top = field.top(self.node(i, j, 0).truncate(), ground_m) + self.voxel_m;
        let mut k = (((top - self.low.z) / self.voxel_m).ceil() as usize).min(self.n[2] - 1) as i64;
        let deep = (ground_m - self.low.z - 1.5 * self.voxel_m) / self.voxel_m;
        while k >= 0 {
            // Below the land everything is solid.
            let d = if (k as f64) < deep { -1.0 } else { field.distance_over(self.node(i, j, k as usize), ground_m) };
            // Half the distance: the things' distances are bounds, noise and rounding loosen them a little.
            let skip = 1 + (0.5 * d.abs() / self.voxel_m) as i64;
            if d < 0.0 {
                for below in (k - skip + 1).max(0)..=k {
                    bits[below as usize / 64] |= 1 << (below % 64);
                }
            }
            k -= skip;
        }
        bits
    }

    fn is_inside(&self, i: usize, j: usize, k: usize) -> bool {
        let word = self.inside[(j * self.n[0] + i) * self.words + k / 64];
        word >> (k % 64) & 1 == 1
    }

    /// Every crossed edge, listed in the column of its lower node.
    fn crossings(&self, field: &Field) -> Columns<Crossing> {
        let [nx, ny, nz] = self.n;
        Columns::collect(nx * ny, |column| {
            let (i, j) = (column % nx, column / nx);
            let mut found = Vec::new();
            for k in 0..nz - 1 {
                let here = self.is_inside(i, j, k);
                for (axis, [di, dj, dk]) in [[1, 0, 0], [0, 1, 0], [0, 0, 1]].into_iter().enumerate() {
                    let (i2, j2, k2) = (i + di, j + dj, k + dk);
                    if i2 < nx && j2 < ny && here != self.is_inside(i2, j2, k2) {
                        let (a, b) = (self.node(i, j, k), self.node(i2, j2, k2));
                        let point = if here { root(field, a, b) } else { root(field, b, a) };
                        let key = (k * 4 + axis) as u32;
                        found.push(Crossing { key, point, normal: field.normal(point) });
                    }
                }
            }
            found
        })
    }

    /// Crossed cells by column of their lower node, and their vertices.
    fn cells(&self, crossings: &Columns<Crossing>) -> (Columns<Cell>, Vec<DVec3>) {
        let [nx, ny, nz] = self.n;
        let made: Vec<(Vec<Cell>, Vec<DVec3>)> = (0..nx * ny)
            .into_par_iter()
            .map(|column| {
                let (i, j) = (column % nx, column / nx);
                let (mut cells, mut points) = (Vec::new(), Vec::new());
                if i + 1 < nx && j + 1 < ny {
                    for k in 0..nz - 1 {
                        if let Some(loops) = self.loops(i, j, k) {
                            cells.push(Cell { k: k as u32, first: points.len() as u32, loops });
                            self.place(crossings, [i, j, k], &loops, &mut points);
                        }
                    }
                }
                (cells, points)
            })
            .collect();
        let (mut start, mut items, mut positions) = (vec![0], Vec::new(), Vec::new());
        for (cells, points) in made {
            let base = positions.len() as u32;
            items.extend(cells.into_iter().map(|c| Cell { first: c.first + base, ..c }));
            positions.extend(points);
            start.push(items.len() as u32);
        }
        (Columns { start, items }, positions)
    }

    /// Groups the crossed edges of a cell into loops; none if no edge is crossed.
    ///
    /// On a face crossed four times the inside corners are kept apart, on both sides of the face alike.
    fn loops(&self, i: usize, j: usize, k: usize) -> Option<[u8; 12]> {
        let inside: [bool; 8] = std::array::from_fn(|c| self.is_inside(i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)));
        if inside.iter().all(|&s| s) || inside.iter().all(|&s| !s) {
            return None;
        }
        let mut group: [u8; 12] = std::array::from_fn(|e| {
            let (a, b) = EDGES[e];
            if inside[a] == inside[b] { u8::MAX } else { e as u8 }
        });
        let mut join = |a: usize, b: usize| {
            let (from, to) = (group[a].max(group[b]), group[a].min(group[b]));
            group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
        };
        for axis in 0..3 {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            for side in 0..2 {
                let corner = |a: usize, b: usize| side << axis | a << u | b << v;
                let ring = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                let edges: [usize; 4] = std::array::from_fn(|n| edge_of(ring[n], ring[(n + 1) % 4]));
                let crossed = |n: usize| inside[ring[n]] != inside[ring[(n + 1) % 4]];
                let hits: Vec<usize> = (0..4).filter(|&n| crossed(n)).collect();
                if hits.len() == 2 {
                    join(edges[hits[0]], edges[hits[1]]);
                } else if hits.len() == 4 {
                    // Edges n - 1 and n meet at ring corner n.
                    (0..4).filter(|&n| inside[ring[n]]).for_each(|n| join(edges[(n + 3) % 4], edges[n]));
                }
            }
        }
        // Number the groups from 0 in order of their first edge.
        let mut names = Vec::with_capacity(4);
        for g in group.iter_mut().filter(|g| **g != u8::MAX) {
            let at = names.iter().position(|n| n == g).unwrap_or_else(|| {
                names.push(*g);
                names.len() - 1
            });
            *g = at as u8;
        }
        Some(group)
    }

    /// Appends one vertex for every loop of a cell.
    fn place(&self, crossings: &Columns<Crossing>, [i, j, k]: [usize; 3], loops: &[u8; 12], points: &mut Vec<DVec3>) {
        let count = loops.iter().filter(|&&l| l != u8::MAX).max().map_or(0, |&l| l + 1);
        for wanted in 0..count {
            let mut planes = [(DVec3::ZERO, DVec3::ZERO); 12];
            let mut n = 0;
            for (e, _) in loops.iter().enumerate().filter(|(_, l)| **l == wanted) {
                let (a, b) = EDGES[e];
                let axis = (a ^ b).trailing_zeros();
                let column = (j + (a >> 1 & 1)) * self.n[0] + i + (a & 1);
                let key = ((k + (a >> 2)) * 4) as u32 + axis;
                let list = crossings.of(column);
                if let Ok(at) = list.binary_search_by_key(&key, |c| c.key) {
                    planes[n] = (list[at].point, list[at].normal);
                    n += 1;
                }
            }
            let margin = DVec3::splat(0.04 * self.voxel_m);
            let (low, high) = (self.node(i, j, k) + margin, self.node(i + 1, j + 1, k + 1) - margin);
            points.push(meeting_point(&planes[..n]).clamp(low, high));
        }
    }

    /// Two triangles around every crossed edge that has four cells.
    fn faces(
        &self,
        field: &Field,
        crossings: &Columns<Crossing>,
        cells: &Columns<Cell>,
        positions: &[DVec3],
    ) -> Vec<[u32; 3]> {
        let [nx, ny, _] = self.n;
        let vertex = |i: usize, j: usize, k: usize, edge: usize| {
            let list = cells.of(j * nx + i);
            let cell = &list[list.binary_search_by_key(&(k as u32), |c| c.k).ok()?];
            (cell.loops[edge] != u8::MAX).then(|| cell.first + u32::from(cell.loops[edge]))
        };
        let made = Columns::collect(nx * ny, |column| {
            let (i, j) = (column % nx, column / nx);
            let mut found = Vec::new();
            for crossing in crossings.of(column) {
                let (k, axis) = ((crossing.key / 4) as usize, (crossing.key % 4) as usize);
                let at = [i, j, k];
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                if at[u] == 0 || at[v] == 0 {
                    continue;
                }
                // The four cells around the edge, turning from u to v; the edge's place in each.
                let around = [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(a, b)| {
                    let mut cell = at;
                    (cell[u], cell[v]) = (cell[u] - a, cell[v] - b);
                    let corner = a << u | b << v;
                    vertex(cell[0], cell[1], cell[2], edge_of(corner, corner | 1 << axis))
                });
                let [Some(a), Some(b), Some(c), Some(d)] = around else { continue };
                let ring = if self.is_inside(i, j, k) { [a, b, c, d] } else { [d, c, b, a] };
                found.extend(cut(field, positions, ring));
            }
            found
        });
        made.items
    }
}

/// Cuts a quad along the diagonal that lies nearer to the surface.
fn cut(field: &Field, positions: &[DVec3], [a, b, c, d]: [u32; 4]) -> [[u32; 3]; 2] {
    let off = |v: u32, w: u32| field.distance((positions[v as usize] + positions[w as usize]) / 2.0).abs();
    // 2 cm: on planes the shorter diagonal decides.
    let score = |v: u32, w: u32| off(v, w) + 0.02 * positions[v as usize].distance(positions[w as usize]);
    if score(a, c) <= score(b, d) { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] }
}

/// Corner pairs of a cell's edges; corner bits are x, y, z.
const EDGES: [(usize, usize); 12] =
    [(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)];

fn edge_of(a: usize, b: usize) -> usize {
    let (low, axis) = (a.min(b), (a ^ b).trailing_zeros() as usize);
    // The two corner bits besides the axis, in order, count edges of one axis.
    let place = match axis {
        0 => low >> 1,
        1 => (low & 1) | (low >> 1 & 2),
        _ => low & 3,
    };
    axis * 4 + place
}

/// The point between `inside` and `outside` where the field changes sign.
fn root(field: &Field, mut inside: DVec3, mut outside: DVec3) -> DVec3 {
    let (mut di, mut do_) = (field.distance(inside).min(-1e-9), field.distance(outside).max(1e-9));
    for step in 0..5 {
        // Secant steps, with a halving between against one-sided convergence.
        let t = if step == 2 { 0.5 } else { (di / (di - do_)).clamp(0.05, 0.95) };
        let p = inside.lerp(outside, t);
        let d = field.distance(p);
        if d.abs() < 0.002 {
            return p;
        }
        if d < 0.0 { (inside, di) = (p, d) } else { (outside, do_) = (p, d) }
    }
    inside.lerp(outside, di / (di - do_))
}

/// The point nearest to all tangent planes, drawn a little to the mean of their points.
fn meeting_point(planes: &[(DVec3, DVec3)]) -> DVec3 {
    /// Weight of the mean point per plane: keeps flat cells centred, rounds corners by a few centimetres.
    const PULL: f64 = 0.03;
    let count = planes.len().max(1) as f64;
    let mean = planes.iter().map(|(p, _)| *p).sum::<DVec3>() / count;
    let mut a = DMat3::from_diagonal(DVec3::splat(PULL * count));
    let mut b = DVec3::ZERO;
    for (p, n) in planes {
        a += DMat3::from_cols(*n * n.x, *n * n.y, *n * n.z);
        b += *n * n.dot(*p - mean);
    }
    mean + a.inverse() * b
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cell_edges_are_found_from_either_end() {
        for (e, (a, b)) in EDGES.into_iter().enumerate() {
            assert_eq!((edge_of(a, b), edge_of(b, a)), (e, e));
        }
    }

    #[test]
    fn three_planes_meet_near_their_corner() {
        let planes = [DVec3::X, DVec3::Y, DVec3::Z].map(|n| (DVec3::ONE - 0.5 * (DVec3::ONE - n), n));
        let planes = planes.map(|(p, n)| (p + n * (1.0 - p.dot(n)), n));
        assert!(meeting_point(&planes).distance(DVec3::ONE) < 0.1);
    }
}
