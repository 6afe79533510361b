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

const LEAF_FACES: usize = 4;
const BINS: usize = 16;
const PARALLEL_FACES: usize = 1 << 15;
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
        for p in positions {
            (low, high) = (low.min(*p), high.max(*p));
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

/// A node of the binary tree.
#[derive(Clone, Copy)]
struct Half {
    min: Vec3,
    /// Inner: index of the right child (the left one follows the node). Leaf: first triangle.
    at: u32,
    max: Vec3,
    /// 0 for an inner node.
    count: u32,
}

/// The binary tree with up to four children a node, in preorder.
fn widened(halves: &[Half]) -> Vec<Node> {
    let mut nodes = Vec::with_capacity(halves.len() / 5 + 1);
    widen(halves, 0, &mut nodes);
    nodes
}

/// Appends the node of `halves[at]` and all below it.
fn widen(halves: &[Half], at: usize, nodes: &mut Vec<Node>) {
    // The largest inner one gives way to its two as long as there is room; a tree of one leaf is a node of one child.
    let mut slots = [at, 0, 0, 0];
    let mut count = 1;
    while count < 4 {
        let area = |i: usize| half_area(halves[i].max - halves[i].min);
        let inner = (0..count).filter(|&k| halves[slots[k]].count == 0);
        let Some(k) = inner.max_by(|&a, &b| area(slots[a]).total_cmp(&area(slots[b])).then(b.cmp(&a))) else { break };
        slots.copy_within(k + 1..count.min(3), k + 2);
        let opened = slots[k];
        (slots[k], slots[k + 1]) = (opened + 1, halves[opened].at as usize);
        count += 1;
    }
    let own = nodes.len();
    // Boxes of nothing touch nothing.
    let nowhere = [Vec4::INFINITY; 3];
    nodes.push(Node { min: nowhere, max: nowhere.map(|v| -v), children: [NO_CHILD; 4] });
    for (k, &slot) in slots[..count].iter().enumerate() {
        let half = halves[slot];
        let child = if half.count > 0 { LEAF | (half.count - 1) << COUNT_SHIFT | half.at } else { nodes.len() as u32 };
        let node = &mut nodes[own];
        for axis in 0..3 {
            (node.min[axis][k], node.max[axis][k]) = (half.min[axis], half.max[axis]);
        }
        node.children[k] = child;
        if half.count == 0 {
            widen(halves, slot, nodes);
        }
    }
}

/// Nodes of `order[..]` in preorder; `first` is where `order` starts among all triangles.
fn build(boxes: &[(Vec3, Vec3)], order: &mut [u32], first: u32, depth: u32) -> Vec<Half> {
    let mut scratch = Vec::new();
    if order.len() <= PARALLEL_FACES {
        let mut nodes = Vec::with_capacity(order.len());
        grow(boxes, order, (first, depth), &mut nodes, &mut scratch);
        return nodes;
    }
    let around = Around::of(boxes, order);
    let middle = split(boxes, order, &around, depth, &mut scratch);
    let (left, right) = order.split_at_mut(middle);
    let second = first + middle as u32;
    let (left, right) = rayon::join(|| build(boxes, left, first, depth + 1), || build(boxes, right, second, depth + 1));
    let mut nodes = Vec::with_capacity(1 + left.len() + right.len());
    let right_at = 1 + left.len() as u32;
    nodes.push(Half { min: around.min, at: right_at, max: around.max, count: 0 });
    for (offset, part) in [(1, left), (right_at, right)] {
        nodes.extend(part.into_iter().map(|n| if n.count == 0 { Half { at: n.at + offset, ..n } } else { n }));
    }
    nodes
}

/// Appends the nodes of `order[..]` in preorder.
fn grow(
    boxes: &[(Vec3, Vec3)],
    order: &mut [u32],
    (first, depth): (u32, u32),
    nodes: &mut Vec<Half>,
    scratch: &mut Vec<u32>,
) {
    let around = Around::of(boxes, order);
    let own = nodes.len();
    nodes.push(Half { min: around.min, at: first, max: around.max, count: order.len() as u32 });
    if order.len() <= LEAF_FACES {
        return;
    }
    let middle = split(boxes, order, &around, depth, scratch);
    let (left, right) = order.split_at_mut(middle);
    grow(boxes, left, (first, depth + 1), nodes, scratch);
    (nodes[own].at, nodes[own].count) = (nodes.len() as u32, 0);
    grow(boxes, right, (first + middle as u32, depth + 1), nodes, scratch);
}

/// The box of faces, and that of their centres, doubled.
struct Around {
    min: Vec3,
    max: Vec3,
    cmin: Vec3,
    cmax: Vec3,
}

impl Around {
    fn of(boxes: &[(Vec3, Vec3)], order: &[u32]) -> Self {
        let (low, high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        let mut around = Self { min: low, max: high, cmin: low, cmax: high };
        for &f in order {
            let (lo, hi) = boxes[f as usize];
            (around.min, around.max) = (around.min.min(lo), around.max.max(hi));
            let c = lo + hi;
            (around.cmin, around.cmax) = (around.cmin.min(c), around.cmax.max(c));
        }
        around
    }
}

/// Reorders `order` about the best of the binned splits and returns where the right half begins.
fn split(boxes: &[(Vec3, Vec3)], order: &mut [u32], around: &Around, depth: u32, scratch: &mut Vec<u32>) -> usize {
    let (cmin, cmax) = (around.cmin, around.cmax);
    let extent = cmax - cmin;
    let axis = if extent.x >= extent.y && extent.x >= extent.z { 0 } else { usize::from(extent.y < extent.z) + 1 };
    let half = order.len() / 2;
    if extent[axis] <= 0.0 || depth >= SPLIT_DEPTH {
        return half;
    }
    let scale = BINS as f32 / extent[axis];
    let bin_of = |f: u32| {
        let (lo, hi) = boxes[f as usize];
        (((lo[axis] + hi[axis] - cmin[axis]) * scale) as usize).min(BINS - 1)
    };
    let mut bins = [(0usize, Vec3::INFINITY, Vec3::NEG_INFINITY); BINS];
    for &f in order.iter() {
        let (lo, hi) = boxes[f as usize];
        let bin = &mut bins[bin_of(f)];
        *bin = (bin.0 + 1, bin.1.min(lo), bin.2.max(hi));
    }
    let grow = |b: &mut (usize, Vec3, Vec3), c: &(usize, Vec3, Vec3)| {
        *b = (b.0 + c.0, b.1.min(c.1), b.2.max(c.2));
        if b.0 == 0 { 0.0 } else { b.0 as f32 * half_area(b.2 - b.1) }
    };
    let mut right_cost = [0f32; BINS];
    let mut right = (0, Vec3::INFINITY, Vec3::NEG_INFINITY);
    for i in (1..BINS).rev() {
        right_cost[i] = grow(&mut right, &bins[i]);
    }
    let (mut best, mut best_cost) = (0, f32::INFINITY);
    let mut left = (0, Vec3::INFINITY, Vec3::NEG_INFINITY);
    for i in 1..BINS {
        let cost = grow(&mut left, &bins[i - 1]) + right_cost[i];
        if left.0 > 0 && left.0 < order.len() && cost < best_cost {
            (best, best_cost) = (i, cost);
        }
    }
    if best == 0 {
        return half;
    }
    // A stable partition keeps the order, and with it the tree, independent of the machine.
    scratch.clear();
    let mut left = 0;
    for i in 0..order.len() {
        let f = order[i];
        if bin_of(f) < best {
            order[left] = f;
            left += 1;
        } else {
            scratch.push(f);
        }
    }
    order[left..].copy_from_slice(scratch);
    left
}

fn half_area(d: Vec3) -> f32 {
    d.x * d.y + d.y * d.z + d.z * d.x
}

/// The point of triangle `abc` closest to `p` (Ericson, Real-Time Collision Detection, 2005, §5.1.5).
///
/// Degenerate triangles are handled as their edges.
pub fn closest_on_triangle(p: DVec3, &[a, b, c]: &[DVec3; 3]) -> DVec3 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * ratio(d1, d1 - d3);
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * ratio(d2, d2 - d6);
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return b + (c - b) * ratio(d4 - d3, (d4 - d3) + (d5 - d6));
    }
    let sum = va + vb + vc;
    if sum <= 0.0 {
        // A sliver whose area underflows: its longest edge stands for it.
        return a + ab * ratio(d1.max(0.0), d1.max(0.0) + (-d3).max(0.0));
    }
    a + ab * (vb / sum) + ac * (vc / sum)
}

fn ratio(part: f64, whole: f64) -> f64 {
    if whole > 0.0 { (part / whole).clamp(0.0, 1.0) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(i: u64) -> f64 {
        let mut z = i.wrapping_add(0x9E37_79B9_7F4A_7C15).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn soup(count: u64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let at = |i: u64| DVec3::new(noise(3 * i), noise(3 * i + 1), noise(3 * i + 2));
        let mut positions = Vec::new();
        for i in 0..count {
            let p = at(i) * 100.0 + DVec3::splat(5e5);
            positions.extend([p, p + at(i + 7777) * 3.0, p + at(i + 9999) * 3.0]);
        }
        let faces = (0..count as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        (positions, faces)
    }

    #[test]
    fn closest_point_equals_brute_force() {
        let (positions, faces) = soup(2000);
        let bvh = Bvh::new(&positions, &faces);
        for i in 0..500 {
            let q = DVec3::new(noise(i * 5), noise(i * 5 + 1), noise(i * 5 + 2)) * 110.0 + DVec3::splat(5e5 - 5.0);
            let brute = faces
                .iter()
                .map(|f| (closest_on_triangle(q, &f.map(|v| positions[v as usize])) - q).length())
                .fold(f64::INFINITY, f64::min);
            let hit = bvh.closest(q, f64::INFINITY).unwrap();
            assert!((hit.distance - brute).abs() < 1e-12, "{} {brute}", hit.distance);
        }
    }

    #[test]
    fn a_start_face_changes_how_fast_the_closest_point_is_found_and_not_where() {
        let (positions, faces) = soup(300);
        let bvh = Bvh::new(&positions, &faces);
        for i in 0..200 {
            let q = DVec3::new(noise(i * 5), noise(i * 5 + 1), noise(i * 5 + 2)) * 110.0 + DVec3::splat(5e5 - 5.0);
            let start = (i * 7 % 300) as u32;
            let corners = faces[start as usize].map(|v| positions[v as usize]);
            let hit = bvh.closest_from(q, start, &corners).unwrap();
            assert_eq!(hit.distance, bvh.closest(q, f64::INFINITY).unwrap().distance);
        }
    }

    #[test]
    fn the_mask_of_a_ball_is_that_of_the_faces_in_it() {
        let (positions, faces) = soup(500);
        let bvh = Bvh::new(&positions, &faces);
        let bit = |f: u32| 1 << (f % 7);
        let masks = bvh.masks(bit);
        for i in 0..100 {
            let q = DVec3::new(noise(i * 5), noise(i * 5 + 1), noise(i * 5 + 2)) * 110.0 + DVec3::splat(5e5 - 5.0);
            let radius = 12.0 * noise(i + 50_000);
            let near = |f: &u32| {
                let corners = faces[*f as usize].map(|v| positions[v as usize]);
                (closest_on_triangle(q, &corners) - q).length() <= radius
            };
            let truth = (0..500).filter(near).fold(0, |mask, f| mask | bit(f));
            assert_eq!(bvh.mask_within(&masks, bit, q, radius, u32::MAX), truth);
            assert_eq!(bvh.mask_within(&masks, bit, q, radius, 1), truth & 1);
        }
    }

    #[test]
    fn a_tree_of_sizes_that_never_end_is_no_deeper_than_the_stack() {
        // Each pair of faces is half as large as the one before and half as far from the middle.
        let sizes = (0..240).map(|i| if i % 2 == 0 { 1e15 } else { -1e15 } * 0.5f64.powi(i / 2));
        let positions: Vec<DVec3> =
            sizes.flat_map(|s| [DVec3::new(s, 0.0, 0.0), DVec3::new(s, s, 0.0), DVec3::new(s, 0.0, s)]).collect();
        let faces: Vec<[u32; 3]> = (0..240).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        let boxes: Vec<(Vec3, Vec3)> = (faces.iter())
            .map(|f| f.map(|v| positions[v as usize].as_vec3()))
            .map(|[a, b, c]| (a.min(b).min(c), a.max(b).max(c)))
            .collect();
        let halves = build(&boxes, &mut (0..240).collect::<Vec<u32>>(), 0, 0);
        let mut depths = vec![0; halves.len()];
        for (at, half) in halves.iter().enumerate().filter(|(_, half)| half.count == 0) {
            (depths[at + 1], depths[half.at as usize]) = (depths[at] + 1, depths[at] + 1);
        }
        let deepest = depths.into_iter().max().unwrap();
        assert!((20..=MOST_DEPTH).contains(&deepest), "{deepest}");
        let bvh = Bvh::new(&positions, &faces);
        for p in positions.iter().step_by(7) {
            assert_eq!(bvh.closest(*p, f64::INFINITY).unwrap().distance, 0.0);
        }
    }

    #[test]
    fn equal_faces_are_all_found() {
        let faces = vec![[0, 1, 2]; 1000];
        let positions = [DVec3::ZERO, DVec3::X, DVec3::Y];
        let bvh = Bvh::new(&positions, &faces);
        let mut found = Vec::new();
        bvh.overlapping(DVec3::ZERO, DVec3::ONE, &mut |f| found.push(f));
        found.sort_unstable();
        assert_eq!(found, (0..1000).collect::<Vec<u32>>());
        assert_eq!(bvh.closest(DVec3::Z, 2.0).unwrap().distance, 1.0);
        assert_eq!(bvh.masks(|f| 1 << (f % 5))[0], 31);
    }

    #[test]
    fn nothing_is_found_beyond_the_limit() {
        let (positions, faces) = soup(10);
        let bvh = Bvh::new(&positions, &faces);
        assert!(bvh.closest(DVec3::splat(5e5 - 1000.0), 10.0).is_none());
        assert!(Bvh::new(&[], &[]).closest(DVec3::ZERO, 1.0).is_none());
    }

    #[test]
    fn a_box_query_finds_every_overlapping_face() {
        let (positions, faces) = soup(2000);
        let bvh = Bvh::new(&positions, &faces);
        let (min, max) = (DVec3::splat(5e5 + 20.0), DVec3::splat(5e5 + 60.0));
        let mut found = Vec::new();
        bvh.overlapping(min, max, &mut |f| found.push(f));
        found.sort_unstable();
        let inside = |f: &[u32; 3]| {
            let [a, b, c] = f.map(|v| positions[v as usize]);
            a.min(b).min(c).cmple(max).all() && a.max(b).max(c).cmpge(min).all()
        };
        let wanted: Vec<u32> = (0..faces.len() as u32).filter(|&f| inside(&faces[f as usize])).collect();
        assert!(!wanted.is_empty() && wanted.iter().all(|f| found.binary_search(f).is_ok()));
    }

    #[test]
    fn a_turned_box_finds_every_face_in_it() {
        let (positions, faces) = soup(2000);
        let bvh = Bvh::new(&positions, &faces);
        for i in 0..20 {
            let n = DVec3::new(noise(i), noise(i + 1), noise(i + 2)).normalize();
            let u = n.any_orthonormal_vector();
            let axes = [u, n.cross(u), n];
            let (center, half) = (DVec3::splat(5e5 + 5.0 * i as f64), DVec3::new(20.0, 5.0, 1.0));
            let mut found = Vec::new();
            bvh.overlapping_turned(center, &axes, half, &mut |f, corners| {
                assert_eq!(*corners, faces[f as usize].map(|v| positions[v as usize]));
                found.push(f);
            });
            found.sort_unstable();
            let is_in = |p: DVec3| (0..3).all(|k| (p - center).dot(axes[k]).abs() <= half[k]);
            let wanted = (0..2000u32).filter(|&f| faces[f as usize].iter().any(|&v| is_in(positions[v as usize])));
            assert!(wanted.into_iter().all(|f| found.binary_search(&f).is_ok()));
            assert!(found.len() < 400, "{} of 2000 in a box of a tenth of the side and less", found.len());
        }
    }

    #[test]
    fn near_enough_ends_the_search_and_nothing_else_changes() {
        let (positions, faces) = soup(2000);
        let bvh = Bvh::new(&positions, &faces);
        for i in 0..200 {
            let q = DVec3::new(noise(i * 5), noise(i * 5 + 1), noise(i * 5 + 2)) * 110.0 + DVec3::splat(5e5 - 5.0);
            let exact = bvh.closest(q, f64::INFINITY).unwrap();
            for enough in [exact.distance * 0.5, exact.distance * 2.0] {
                let hit = bvh.closest_until(q, f64::INFINITY, enough).unwrap();
                assert!(hit == exact || (hit.distance <= enough && hit.distance >= exact.distance));
            }
        }
    }

    #[test]
    fn degenerate_triangles_answer_as_their_edges() {
        let t = [DVec3::ZERO, DVec3::X, DVec3::X * 2.0];
        assert!((closest_on_triangle(DVec3::new(1.5, 1.0, 0.0), &t) - DVec3::new(1.5, 0.0, 0.0)).length() < 1e-12);
        assert_eq!(closest_on_triangle(DVec3::Y, &[DVec3::ZERO; 3]), DVec3::ZERO);
    }
}
