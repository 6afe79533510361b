//! Cuts meshes along the walls of an adaptive tree of cells, without a crack.
//!
//! In: where the weight of the faces lies, then meshes part by part. Out: a [`CellTree`] and [`Soup`]s: the same surface
//! with every face inside one leaf cell.
//!
//! # Method
//! 1. Cells are halved, by the weight of the face centres in them, until a leaf holds at most the weight allowed; walls
//!    stand where few faces cross them, see [`Census`]. Every second halving makes a level of tiles, the even or the
//!    odd ones, whichever are fewer: a tile has two to four children.
//! 2. Vertices within [`SNAP_M`] of a wall of their cell move onto it, so that no cut leaves a sliver; of several files
//!    those within the weld tolerance, so that files that meet near a wall meet on it.
//! 3. A face is clipped wall by wall down the tree; a cut on an edge depends on the edge and the tree alone, so both faces
//!    of an edge get the same vertex. Edges that lie on a wall are cut where the cells of the other side cut them.
//! 4. The pieces, convex, are triangulated; texture coordinates follow by barycentric interpolation (affine, so exact).
//!
//! A vertex is its position: welded vertices differ in it, and both sides of a wall compute the same bits.
//!
//! # Promises
//! Area and topology stay (`the_cut_surface_is_the_same_surface`); no T-junctions (`every_inner_edge_has_two_faces`).
//! No vertex of the source moves by more than is asked for.
//!
//! [`Soup`]: super::Soup

mod census;
mod clip;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::geo::Rect;

pub use census::Census;
use census::Grown;

/// Vertices this near to a wall are moved onto it, metres: the rounding of published coordinates.
pub const SNAP_M: f64 = 1e-4;

/// A cell in plan.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Cell {
    /// Where it is, local metres.
    pub plan: Rect,
    /// Root: 0.
    pub depth: u8,
    /// Up to four, which fill it; none for a leaf.
    pub children: Vec<u32>,
    /// Root: itself.
    pub parent: u32,
}

impl Cell {
    /// True without children.
    pub fn is_leaf(&self) -> bool {
        self.children.is_empty()
    }
}

/// Nested cells and the walls between them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct CellTree {
    /// Root first, parents before children.
    pub cells: Vec<Cell>,
    /// The wall through the root first.
    walls: Vec<Wall>,
}

/// A vertical plane through a region, which it halves.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Wall {
    /// Normal to it: x 0, y 1.
    axis: usize,
    /// Where on the axis, local metres.
    at_m: f64,
    /// Below it and above.
    sides: [Side; 2],
}

/// What is on a side of a wall.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
enum Side {
    Wall(u32),
    Leaf(u32),
}

impl CellTree {
    /// Halves cells until leaves have at most `most` weight, where the places of faces allow it.
    pub fn of(mut census: Census, most: f64) -> Self {
        let grown = census.grow(most);
        let plan = census.square;
        let root = Cell { plan, depth: 0, children: Vec::new(), parent: 0 };
        let mut tree = Self { cells: vec![root], walls: Vec::new() };
        let [even, odd] = grown.halved();
        tree.halve(&census, &grown, plan, 0, u32::from(odd < even));
        tree
    }

    /// Halves `plan`, all of the cell `within` or a part of it, as it has grown; every second halving makes cells, and so
    /// does this one if `halvings` is odd.
    fn halve(&mut self, census: &Census, grown: &Grown, plan: Rect, within: u32, halvings: u32) -> Side {
        let Grown::Cut { axis, column, sides } = grown else { return Side::Leaf(within) };
        let (axis, at_m) = (*axis, census.line_m(*axis, *column));
        let (mut below, mut above) = (plan, plan);
        below.max[axis] = at_m;
        above.min[axis] = at_m;
        let wall = self.walls.len();
        self.walls.push(Wall { axis, at_m, sides: [Side::Leaf(within); 2] });
        for (i, (plan, grown)) in [below, above].into_iter().zip(sides.iter()).enumerate() {
            let is_cell = halvings % 2 == 1 || matches!(grown, Grown::Leaf);
            let cell = if is_cell { self.add(plan, within) } else { within };
            self.walls[wall].sides[i] = self.halve(census, grown, plan, cell, halvings + 1);
        }
        Side::Wall(wall as u32)
    }

    /// Adds a cell.
    fn add(&mut self, plan: Rect, parent: u32) -> u32 {
        let cell = self.cells.len() as u32;
        let depth = self.cells[parent as usize].depth + 1;
        self.cells.push(Cell { plan, depth, children: Vec::new(), parent });
        self.cells[parent as usize].children.push(cell);
        cell
    }

    /// All there is.
    fn top(&self) -> Side {
        if self.walls.is_empty() { Side::Leaf(0) } else { Side::Wall(0) }
    }

    /// The ancestor of `cell` at `depth`, or the cell itself if it is not deeper.
    pub fn ancestor(&self, cell: u32, depth: u8) -> u32 {
        let mut at = cell;
        while self.cells[at as usize].depth > depth {
            at = self.cells[at as usize].parent;
        }
        at
    }

    /// A name for a cell: `r` for the root, then a digit a level: which child it is.
    pub fn key(&self, cell: u32) -> String {
        let mut digits = Vec::new();
        let mut at = cell;
        while self.cells[at as usize].depth > 0 {
            let parent = self.cells[at as usize].parent;
            let before = self.cells[parent as usize].children.iter().take_while(|&&child| child != at).count();
            digits.push(char::from(b'0' + before as u8));
            at = parent;
        }
        digits.push('r');
        digits.iter().rev().collect()
    }

    /// Depth of the deepest leaf.
    pub fn depth(&self) -> u8 {
        self.cells.iter().map(|c| c.depth).max().unwrap_or(0)
    }

    /// The cells of `depth`, and leaves above it, whose closed plan holds `p`: several where `p` is on a wall.
    pub fn touching(&self, p: DVec2, depth: u8, mut visit: impl FnMut(u32)) {
        let mut open = vec![0u32];
        while let Some(at) = open.pop() {
            let cell = &self.cells[at as usize];
            if cell.is_leaf() || cell.depth >= depth {
                visit(at);
            } else {
                open.extend(cell.children.iter().copied().filter(|&c| self.cells[c as usize].plan.contains(p, 0.0)));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use glam::DVec3;

    use super::*;
    use crate::mesh::{Mesh, on_grid};
    use crate::tiles::soup::Soup;

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
    fn cut(mut mesh: Mesh) -> (Mesh, Vec<u32>, CellTree) {
        let mut bounds = crate::geo::Aabb::of(mesh.positions.iter().copied()).plan();
        bounds = Rect { min: bounds.min, max: bounds.max };
        let mut census = Census::over(bounds);
        census.count(&mesh, |_| 1.0);
        let tree = CellTree::of(census, 40.0);
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
            let plan = tree.cells[leaf as usize].plan;
            assert!(tree.cells[leaf as usize].is_leaf());
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
    fn the_cells_of_a_depth_fill_the_square_and_share_their_walls() {
        let (.., tree) = cut(sheet());
        let root = tree.cells[0].plan;
        for depth in 0..=tree.depth() {
            let mut area = 0.0;
            for (c, cell) in tree.cells.iter().enumerate() {
                if cell.depth != depth && !(cell.is_leaf() && cell.depth < depth) {
                    continue;
                }
                let touching = |p: DVec2| {
                    let mut found = Vec::new();
                    tree.touching(p, depth, |c| found.push(c));
                    assert!(found.iter().all(|&c| tree.cells[c as usize].plan.contains(p, 0.0)));
                    found
                };
                let Rect { min, max } = cell.plan;
                area += cell.plan.size().element_product();
                assert_eq!(touching(cell.plan.center()), [c as u32]);
                for corner in [min, DVec2::new(max.x, min.y), max, DVec2::new(min.x, max.y)] {
                    let is_inner = corner.cmpgt(root.min).all() && corner.cmplt(root.max).all();
                    let found = touching(corner);
                    assert!(found.contains(&(c as u32)) && (!is_inner || found.len() >= 3), "{corner} {found:?}");
                }
                assert!(cell.children.len() != 1 && cell.children.len() <= 4);
                assert!(depth == 0 || cell.depth == tree.cells[cell.parent as usize].depth + 1);
            }
            assert!((area / root.size().element_product() - 1.0).abs() < 1e-12, "depth {depth}");
        }
    }

    #[test]
    fn a_cell_is_named_after_the_way_to_it() {
        let (.., tree) = cut(sheet());
        let keys: Vec<String> = (0..tree.cells.len() as u32).map(|c| tree.key(c)).collect();
        assert_eq!(keys[0], "r");
        for (c, cell) in tree.cells.iter().enumerate() {
            for (i, &child) in cell.children.iter().enumerate() {
                assert_eq!(keys[child as usize], format!("{}{i}", keys[c]));
            }
        }
    }
}
