//! Grows the tree: binned surface-area heuristic over face centroids, then two levels of the binary tree to one.
//!
//! In: a box per face. Out: the faces in leaf order, and the nodes of four children in preorder.

use glam::{Vec3, Vec4};

use super::{COUNT_SHIFT, LEAF, NO_CHILD, Node, SPLIT_DEPTH};

const LEAF_FACES: usize = 4;
const BINS: usize = 16;
const PARALLEL_FACES: usize = 1 << 15;

/// A node of the binary tree.
#[derive(Clone, Copy)]
pub(super) struct Half {
    min: Vec3,
    /// Inner: index of the right child (the left one follows the node). Leaf: first triangle.
    at: u32,
    max: Vec3,
    /// 0 for an inner node.
    count: u32,
}

/// The binary tree with up to four children a node, in preorder.
pub(super) fn widened(halves: &[Half]) -> Vec<Node> {
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
pub(super) fn build(boxes: &[(Vec3, Vec3)], order: &mut [u32], first: u32, depth: u32) -> Vec<Half> {
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
