//! A bounding-volume hierarchy over triangles for closest-point and box queries.
//!
//! In: positions and faces. Out: [`Bvh`], immutable.
//!
//! # Method
//! 1. Binned surface-area heuristic over face centroids (Wald 2007), 16 bins; subtrees above 32k faces in parallel.
//! 2. Two levels of the binary tree become one of nodes with up to four children, whose boxes are tested together.
//! 3. Nodes in preorder with f32 boxes about the mesh's centre, rounded outwards; triangles in f64, in leaf order.
//! 4. Closest point: depth first, nearest child first, pruned by the best distance so far.
//!
//! # Promises
//! The tree and every answer are the same for any number of threads. Distances are exact in f64: boxes only prune
//! (`closest_point_equals_brute_force`).
//!
//! # Cost
//! About 0.5 s a million faces to build on one core, 120 bytes a face.

use glam::{DVec3, Vec3, Vec4};

use grow::{build, widened};
pub use triangle::closest_on_triangle;

mod grow;
mod triangle;

/// Below this depth faces are halved as they lie: with no more than 2²⁸ of them the tree ends before
/// [`MOST_DEPTH`], whatever their shape.
const SPLIT_DEPTH: u32 = 40;
const MOST_DEPTH: usize = SPLIT_DEPTH as usize + 28;
/// Children that may wait: three of each node on the way down, and one.
const STACK: usize = 3 * MOST_DEPTH + 1;

/// See the module.
pub struct Bvh {
    center: DVec3,
    nodes: Vec<Node>,
    /// In leaf order, as are boxes and faces.
    triangles: Vec<[DVec3; 3]>,
    boxes: Vec<(Vec3, Vec3)>,
    faces: Vec<u32>,
}

/// The nearest point found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Index into the faces the tree was built from.
    pub face: u32,
    /// The point on that face.
    pub point: DVec3,
    /// Its distance from the query, metres.
    pub distance: f64,
}

/// Up to four children, the first slots first; lanes of the boxes are children.
#[derive(Clone, Copy)]
struct Node {
    min: [Vec4; 3],
    max: [Vec4; 3],
    children: [Child; 4],
}

/// A node, or a leaf: with [`LEAF`], the count of its triangles less one at [`COUNT_SHIFT`], and the first of them.
type Child = u32;

const LEAF: u32 = 1 << 31;
const COUNT_SHIFT: u32 = 29;
const NO_CHILD: Child = u32::MAX >> 1;

/// The triangles of a leaf, none for a node.
fn leaf(child: Child) -> Option<std::ops::Range<usize>> {
    let first = (child & ((1 << COUNT_SHIFT) - 1)) as usize;
    (child & LEAF != 0).then(|| first..first + 1 + (child >> COUNT_SHIFT & 3) as usize)
}

impl Bvh {
    /// Builds over `faces`; indices must be valid and positions finite.
    pub fn new(positions: &[DVec3], faces: &[[u32; 3]]) -> Self {
        let corners = |f: u32| faces[f as usize].map(|v| positions[v as usize]);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for p in (0..faces.len() as u32).flat_map(corners) {
            (low, high) = (low.min(p), high.max(p));
        }
        let center = if faces.is_empty() { DVec3::ZERO } else { (low + high) * 0.5 };
        let boxes: Vec<(Vec3, Vec3)> = (0..faces.len() as u32)
            .map(|f| {
                let [a, b, c] = corners(f).map(|p| p - center);
                (round_down(a.min(b).min(c)), round_up(a.max(b).max(c)))
            })
            .collect();
        let mut order: Vec<u32> = (0..faces.len() as u32).collect();
        let nodes = if order.is_empty() { Vec::new() } else { widened(&build(&boxes, &mut order, 0, 0)) };
        let triangles = order.iter().map(|&f| corners(f)).collect();
        let boxes = order.iter().map(|&f| boxes[f as usize]).collect();
        Self { center, nodes, triangles, boxes, faces: order }
    }

    /// The closest point within `max` metres of `p`; on a tie the one found first.
    pub fn closest(&self, p: DVec3, max: f64) -> Option<Hit> {
        self.closest_until(p, max, -1.0)
    }

    /// The same, or the first point found that is within `enough` metres: most questions are only whether there is one.
    pub fn closest_until(&self, p: DVec3, max: f64, enough: f64) -> Option<Hit> {
        if self.nodes.is_empty() {
            return None;
        }
        let q = Query::of((p - self.center).as_vec3());
        let mut best = Hit { face: u32::MAX, point: p, distance: 0.0 };
        let mut best_squared = max * max;
        let mut limit = (best_squared as f32).next_up();
        let enough_squared = if enough >= 0.0 { enough * enough } else { -1.0 };
        let mut stack = [(0 as Child, 0f32); STACK];
        let mut top = 1;
        'open: while top > 0 {
            top -= 1;
            let (child, bound) = stack[top];
            if bound > limit {
                continue;
            }
            if let Some(range) = leaf(child) {
                for i in range {
                    // A box costs a fifth of a triangle, and half of the triangles of a leaf are further than the best.
                    let (min, max) = self.boxes[i];
                    if q.squared_to(min, max) > limit {
                        continue;
                    }
                    let point = closest_on_triangle(p, &self.triangles[i]);
                    let d = (point - p).length_squared();
                    if d < best_squared || (best.face == u32::MAX && d <= best_squared) {
                        best_squared = d;
                        limit = (d as f32).next_up();
                        best = Hit { face: self.faces[i], point, distance: 0.0 };
                        if d <= enough_squared {
                            break 'open;
                        }
                    }
                }
                continue;
            }
            let node = &self.nodes[child as usize];
            let squared = q.squared_to_four(node).to_array();
            let first = top;
            for (child, squared) in node.children.into_iter().zip(squared) {
                if child == NO_CHILD {
                    break;
                }
                if squared > limit {
                    continue;
                }
                // The nearest on top; of equals the first.
                let mut at = top;
                while at > first && stack[at - 1].1 <= squared {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (child, squared);
                top += 1;
            }
        }
        (best.face != u32::MAX).then(|| Hit { distance: best_squared.sqrt(), ..best })
    }

    /// The closest point to `p`, begun from a face that is thought near; `None` without faces or for an unknown one.
    ///
    /// Any `face` gives the same distance; a near one gives it sooner.
    pub fn closest_from(&self, p: DVec3, face: u32, corners: &[DVec3; 3]) -> Option<Hit> {
        let point = closest_on_triangle(p, corners);
        let distance = (point - p).length();
        if self.nodes.is_empty() || !distance.is_finite() {
            return None;
        }
        Some(self.closest(p, distance).filter(|hit| hit.distance < distance).unwrap_or(Hit { face, point, distance }))
    }

    /// The union of `mask_of` over all faces, and then for each child of each node over the faces below it: for
    /// [`Bvh::mask_within`].
    pub fn masks(&self, mask_of: impl Fn(u32) -> u32) -> Vec<u32> {
        let mut masks = vec![0; if self.nodes.is_empty() { 0 } else { 1 + 4 * self.nodes.len() }];
        // Children come after their parent.
        for (at, node) in self.nodes.iter().enumerate().rev() {
            for (k, child) in node.children.into_iter().enumerate().filter(|(_, c)| *c != NO_CHILD) {
                masks[1 + 4 * at + k] = match leaf(child) {
                    Some(range) => self.faces[range].iter().fold(0, |mask, &f| mask | mask_of(f)),
                    None => masks[1 + 4 * child as usize..][..4].iter().fold(0, |mask, of_child| mask | of_child),
                };
            }
        }
        if let Some(all) = masks.get(1..5).map(|root| root.iter().fold(0, |mask, of_child| mask | of_child)) {
            masks[0] = all;
        }
        masks
    }

    /// The union of `mask_of` over the faces within `radius` metres of `p`, looked for among the bits of `wanted` only;
    /// `masks` are of [`Bvh::masks`].
    pub fn mask_within(&self, masks: &[u32], mask_of: impl Fn(u32) -> u32, p: DVec3, radius: f64, wanted: u32) -> u32 {
        if self.nodes.is_empty() {
            return 0;
        }
        let q = Query::of((p - self.center).as_vec3());
        let (mut found, limit) = (0, radius * radius);
        let limit_above = (limit as f32).next_up();
        let mut stack = [(0 as Child, 0u32); STACK];
        stack[0] = (0, masks[0]);
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let (child, mask) = stack[top];
            if mask & wanted & !found == 0 {
                continue;
            }
            if let Some(range) = leaf(child) {
                for i in range {
                    let new = mask_of(self.faces[i]) & wanted & !found;
                    if new != 0 && (closest_on_triangle(p, &self.triangles[i]) - p).length_squared() <= limit {
                        found |= new;
                    }
                }
                continue;
            }
            let node = &self.nodes[child as usize];
            let squared = q.squared_to_four(node).to_array();
            for k in (0..4).rev() {
                if node.children[k] != NO_CHILD && squared[k] <= limit_above {
                    stack[top] = (node.children[k], masks[1 + 4 * child as usize + k]);
                    top += 1;
                }
            }
        }
        found
    }

    /// Calls `visit` for every face whose box touches the box `min..max`, in the tree's order.
    pub fn overlapping(&self, min: DVec3, max: DVec3, visit: &mut dyn FnMut(u32)) {
        let (min, max) = (round_down(min - self.center), round_up(max - self.center));
        let touching = |node: &Node| {
            let mut bits = 0b1111;
            for k in 0..3 {
                bits &= node.max[k].cmpge(Vec4::splat(min[k])).bitmask();
                bits &= node.min[k].cmple(Vec4::splat(max[k])).bitmask();
            }
            bits
        };
        self.walk(touching, &mut |i| {
            let (low, high) = self.boxes[i];
            if !(high.cmplt(min).any() || low.cmpgt(max).any()) {
                visit(self.faces[i]);
            }
        });
    }

    /// Calls `visit` with every face whose box touches a turned box, and its corners, in the tree's order: some that only
    /// come close are among them. `axes` are orthonormal, `half` are half its sides along them, metres.
    pub fn overlapping_turned(
        &self,
        center: DVec3,
        axes: &[DVec3; 3],
        half: DVec3,
        visit: &mut dyn FnMut(u32, &[DVec3; 3]),
    ) {
        let turned = Turned::of((center - self.center).as_vec3(), axes.map(|a| a.as_vec3()), half.as_vec3());
        self.walk(|node| turned.touches_four(node), &mut |i| {
            let (low, high) = self.boxes[i];
            if turned.touches(low, high) {
                visit(self.faces[i], &self.triangles[i]);
            }
        });
    }

    /// Calls `visit` for the triangles of all leaves that `touching`, a bit for each child, leads to.
    fn walk(&self, touching: impl Fn(&Node) -> u32, visit: &mut dyn FnMut(usize)) {
        if self.nodes.is_empty() {
            return;
        }
        let mut stack = [0 as Child; STACK];
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let child = stack[top];
            if let Some(range) = leaf(child) {
                range.for_each(&mut *visit);
                continue;
            }
            let node = &self.nodes[child as usize];
            let bits = touching(node);
            for k in (0..4).rev() {
                if bits >> k & 1 == 1 && node.children[k] != NO_CHILD {
                    stack[top] = node.children[k];
                    top += 1;
                }
            }
        }
    }
}

/// A point that boxes are held against.
struct Query {
    at: Vec3,
    slack: f32,
}

/// f32 rounding of a box's distance must never lift the bound above the truth: this share of its square is let go.
const KEPT_SHARE: f32 = 1.0 - 4e-6;

impl Query {
    fn of(at: Vec3) -> Self {
        Self { at, slack: 1e-6 * at.abs().max_element() }
    }

    /// A lower bound of the squared distance to anything in a box.
    fn squared_to(&self, min: Vec3, max: Vec3) -> f32 {
        let d = ((min - self.at).max(self.at - max) - self.slack).max(Vec3::ZERO);
        d.length_squared() * KEPT_SHARE
    }

    /// The same for the boxes of a node.
    fn squared_to_four(&self, node: &Node) -> Vec4 {
        let along = |k: usize| {
            let at = Vec4::splat(self.at[k]);
            let d = ((node.min[k] - at).max(at - node.max[k]) - self.slack).max(Vec4::ZERO);
            d * d
        };
        (along(0) + along(1) + along(2)) * KEPT_SHARE
    }
}

/// A turned box: nothing that it touches is told apart from it by one of its axes or of the coordinates'.
struct Turned {
    center: Vec3,
    axes: [Vec3; 3],
    half: Vec3,
    /// Half its sides along the coordinates.
    reach: Vec3,
}

impl Turned {
    fn of(center: Vec3, axes: [Vec3; 3], half: Vec3) -> Self {
        // f32 rounding must not lose anything.
        let half = half + 2e-6 * (center.abs().max_element() + half.max_element());
        let reach = axes[0].abs() * half.x + axes[1].abs() * half.y + axes[2].abs() * half.z;
        Self { center, axes, half, reach }
    }

    fn touches(&self, min: Vec3, max: Vec3) -> bool {
        let (middle, extent) = ((min + max) * 0.5 - self.center, (max - min) * 0.5);
        let room = 1e-6 * (middle.abs().max_element() + extent.max_element());
        if middle.abs().cmpgt(extent + self.reach + room).any() {
            return false;
        }
        let apart =
            |k: usize| middle.dot(self.axes[k]).abs() > extent.dot(self.axes[k].abs()) + self.half[k] + 4.0 * room;
        !(apart(0) || apart(1) || apart(2))
    }

    /// The children of a node whose boxes touch it, a bit each.
    fn touches_four(&self, node: &Node) -> u32 {
        let middle = [0, 1, 2].map(|k| (node.min[k] + node.max[k]) * 0.5 - self.center[k]);
        let extent = [0, 1, 2].map(|k| (node.max[k] - node.min[k]) * 0.5);
        let most = |v: [Vec4; 3]| v[0].max(v[1]).max(v[2]);
        let room = (most(middle.map(Vec4::abs)) + most(extent)) * 1e-6;
        let mut bits = 0b1111;
        for k in 0..3 {
            bits &= middle[k].abs().cmple(extent[k] + self.reach[k] + room).bitmask();
        }
        for k in 0..3 {
            let (axis, width) = (self.axes[k], self.axes[k].abs());
            let off = middle[0] * axis.x + middle[1] * axis.y + middle[2] * axis.z;
            let wide = extent[0] * width.x + extent[1] * width.y + extent[2] * width.z;
            bits &= off.abs().cmple(wide + self.half[k] + room * 4.0).bitmask();
        }
        bits
    }
}

fn round_down(v: DVec3) -> Vec3 {
    let f = v.as_vec3();
    Vec3::new(down(f.x, v.x), down(f.y, v.y), down(f.z, v.z))
}

fn round_up(v: DVec3) -> Vec3 {
    -round_down(-v)
}

fn down(f: f32, exact: f64) -> f32 {
    if f64::from(f) > exact { f.next_down() } else { f }
}
