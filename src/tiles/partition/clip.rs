//! Cuts faces along the walls of a [`CellTree`].

use glam::DVec3;
use rayon::prelude::*;

use super::{CellTree, Side, Wall};
use crate::mesh::{GRID_PER_M, Mesh, on_grid};
use crate::tiles::soup::Soup;

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

impl CellTree {
    /// Moves the vertices of a mesh that are within `near_m` of a wall onto it; returns how far at most, metres.
    pub fn snap(&self, mesh: &mut Mesh, near_m: f64) -> f64 {
        let moved = |p: &mut DVec3| {
            let before = *p;
            self.snap_from(self.top(), p, near_m);
            (*p - before).length()
        };
        mesh.positions.par_iter_mut().map(moved).reduce(|| 0.0, f64::max)
    }

    /// The faces of `range`, cut, with their leaf cells, by face. The mesh was snapped.
    pub fn cut(&self, mesh: &Mesh, range: std::ops::Range<usize>) -> Vec<(u32, Soup)> {
        let pieces: Vec<Vec<Piece>> = range.clone().into_par_iter().map(|f| self.clip(mesh.corners(f))).collect();
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

    fn snap_from(&self, side: Side, p: &mut DVec3, near_m: f64) {
        let Side::Wall(wall) = side else { return };
        let Wall { axis, at_m, sides: [below, above] } = self.walls[wall as usize];
        if (p[axis] - at_m).abs() <= near_m {
            // Walls of either side may end here.
            p[axis] = at_m;
            self.snap_from(below, p, near_m);
            self.snap_from(above, p, near_m);
        } else {
            self.snap_from(if p[axis] < at_m { below } else { above }, p, near_m);
        }
    }

    /// The pieces of a triangle, by leaf.
    fn clip(&self, triangle: [DVec3; 3]) -> Vec<Piece> {
        let shares = [DVec3::X, DVec3::Y, DVec3::Z];
        let corners: Vec<Corner> = (0..3).map(|k| Corner { at: triangle[k], share: shares[k] }).collect();
        let mut pieces = Vec::new();
        self.clip_into(self.top(), corners, &mut pieces);
        let single = pieces.len() == 1;
        for piece in &mut pieces {
            self.insert_hanging(&mut piece.corners);
            piece.whole = single && piece.corners.len() == 3;
        }
        pieces
    }

    fn clip_into(&self, side: Side, polygon: Vec<Corner>, pieces: &mut Vec<Piece>) {
        match side {
            _ if polygon.len() < 3 => {}
            Side::Leaf(leaf) => pieces.push(Piece { leaf, corners: polygon, whole: false }),
            Side::Wall(wall) => {
                let Wall { axis, at_m, sides: [below, above] } = self.walls[wall as usize];
                let (low, high) = split(polygon, axis, at_m);
                self.clip_into(below, low, pieces);
                self.clip_into(above, high, pieces);
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
                self.cut_side(self.top(), a, b, &mut all);
            }
        }
        *corners = all;
    }

    /// Pushes the cuts strictly between `a` and `b`, in order, that walls from `side` on make.
    fn cut_side(&self, side: Side, a: Corner, b: Corner, cuts: &mut Vec<Corner>) {
        let Side::Wall(wall) = side else { return };
        let Wall { axis, at_m, sides: [below, above] } = self.walls[wall as usize];
        let (da, db) = (a.at[axis] - at_m, b.at[axis] - at_m);
        if da * db < 0.0 {
            let (first, second) = if da < 0.0 { (below, above) } else { (above, below) };
            let r = cut(&a, &b, axis, at_m);
            self.cut_side(first, a, r, cuts);
            if r.at != a.at && r.at != b.at {
                cuts.push(r);
            }
            self.cut_side(second, r, b, cuts);
        } else if da == 0.0 && db == 0.0 {
            // On this wall: the cells of both sides may cut it.
            let mut found = Vec::new();
            self.cut_side(below, a, b, &mut found);
            self.cut_side(above, a, b, &mut found);
            let along = b.at - a.at;
            found.sort_by(|p, q| along.dot(p.at).total_cmp(&along.dot(q.at)));
            found.dedup_by(|p, q| p.at == q.at);
            cuts.extend(found);
        } else {
            self.cut_side(if da + db < 0.0 { below } else { above }, a, b, cuts);
        }
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
