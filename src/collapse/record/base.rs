//! The coarsest mesh of a record: faces by growing over edges, new vertices by the parallelogram rule.
//!
//! # Method
//! 1. A stack holds the open edges of what is coded so far, the newest on top.
//! 2. The next face sits on the topmost edge that still has one; how many edges are passed over is coded, and they
//!    are dropped. Without any, a face begins afresh.
//! 3. Its third vertex is new, or at an end of an edge near the top, or named outright.
//! 4. Vertices are numbered as they appear; those without faces come last.
//!
//! # References
//! Rossignac, Edgebreaker, 1999 (the stack); Touma & Gotsman 1998 (the parallelogram). Any triangles will do here.

use std::collections::HashMap;

use super::coder::{Coder, Number, Prob, Tree};
use super::live::{Grid, Live};
use super::split::{MOST_COORDINATE, Models};

/// A face to be coded next. Vertices are the record's numbers; `live.vertices()` and up are new.
#[derive(Debug, Clone, Copy, Default)]
pub struct Next {
    /// Open edges passed over, or none to begin afresh.
    pub passed: Option<usize>,
    /// Its third vertex, or all three.
    pub corners: [u32; 3],
    /// It runs along the edge as the face before it does.
    pub turned: bool,
    /// Its class.
    pub class: u8,
    /// Places of those of `corners` that are new.
    pub points: [Grid; 3],
}

/// An open edge: from, to, and the vertex across in the face it belongs to.
pub type Edge = [u32; 3];

/// What is coded so far, seen from its edge, and what was learned from it.
pub struct Growth {
    open: Vec<Edge>,
    passed: Tree<16>,
    kind: [Prob; 3],
    near: Tree<32>,
    turned: Prob,
    sizes: Vec<Number>,
    last: Grid,
    last_class: u8,
}

/// As many passed edges are one symbol; it may be repeated.
const MANY: u32 = 14;
/// Begin afresh.
const FRESH: u32 = 15;
/// The third vertex is not near the top.
const FAR: u32 = 31;

impl Growth {
    /// Knows nothing yet.
    pub fn new() -> Self {
        Self {
            open: Vec::new(),
            passed: Tree::default(),
            kind: Default::default(),
            near: Tree::default(),
            turned: Prob::default(),
            sizes: vec![Number::default(); 64 * 3],
            last: [0; 3],
            last_class: 0,
        }
    }

    /// The open edges, the top last.
    pub fn open(&self) -> &[Edge] {
        &self.open
    }

    /// Codes one face into `live`, which may have at most `vertices`.
    ///
    /// # Errors
    /// What is wrong with it; only a decoder finds fault.
    pub fn code(
        &mut self,
        coder: &mut impl Coder,
        models: &mut Models,
        live: &mut Live,
        vertices: usize,
        next: &Next,
    ) -> Result<(), &'static str> {
        let edge = self.code_passed(coder, next.passed)?;
        let fresh = edge.is_none();
        let corners = match edge {
            Some([from, to, across]) => {
                let [a, b, c] = [from, to, across].map(|v| live.at(v));
                let guess = [0, 1, 2].map(|k| a[k] + b[k] - c[k]);
                let size = distance(a, b);
                let third = self.code_third(coder, live, vertices, next, guess, size)?;
                let turned = coder.bit(&mut self.turned, next.turned);
                if turned { [from, to, third] } else { [to, from, third] }
            }
            None => {
                let mut corners = [0; 3];
                for (k, corner) in corners.iter_mut().enumerate() {
                    *corner = self.code_any(coder, live, vertices, next.corners[k], next.points[k])?;
                }
                corners
            }
        };
        let [a, b, c] = corners;
        if a == b || b == c || c == a {
            return Err("a face with one vertex twice");
        }
        let class = models.code_class(coder, [self.last_class; 2], next.class);
        self.last_class = class;
        live.add_face(corners, class);
        if fresh {
            self.open.push([a, b, c]);
        }
        self.open.push([b, c, a]);
        self.open.push([c, a, b]);
        Ok(())
    }

    /// Drops the edges passed over and takes the one after them.
    fn code_passed(&mut self, coder: &mut impl Coder, passed: Option<usize>) -> Result<Option<Edge>, &'static str> {
        let mut left = passed;
        loop {
            let symbol = left.map_or(FRESH, |n| n.min(MANY as usize) as u32);
            let symbol = self.passed.code(coder, symbol);
            if symbol == FRESH {
                self.open.clear();
                return Ok(None);
            }
            let count = symbol as usize;
            if count >= self.open.len() {
                return Err("an edge that is not there");
            }
            self.open.truncate(self.open.len() - count);
            left = left.map(|n| n - count.min(n));
            if symbol < MANY {
                return Ok(self.open.pop());
            }
        }
    }

    fn code_third(
        &mut self,
        coder: &mut impl Coder,
        live: &mut Live,
        vertices: usize,
        next: &Next,
        guess: Grid,
        size: u64,
    ) -> Result<u32, &'static str> {
        let wanted = next.corners[2];
        if coder.bit(&mut self.kind[0], wanted as usize >= live.vertices()) {
            return self.code_new(coder, live, vertices, guess, size, next.points[2]);
        }
        let near = |i: u32| self.open.iter().rev().nth(i as usize / 2).map(|e| e[1 - (i as usize & 1)]);
        let symbol = (0..FAR).find(|&i| near(i) == Some(wanted)).unwrap_or(FAR);
        let symbol = self.near.code(coder, symbol);
        if symbol < FAR {
            let near = |i: u32| self.open.iter().rev().nth(i as usize / 2).map(|e| e[1 - (i as usize & 1)]);
            return near(symbol).ok_or("an edge that is not there");
        }
        Ok(coder.uniform(live.vertices() as u32, wanted))
    }

    fn code_any(
        &mut self,
        coder: &mut impl Coder,
        live: &mut Live,
        vertices: usize,
        wanted: u32,
        point: Grid,
    ) -> Result<u32, &'static str> {
        if coder.bit(&mut self.kind[1], wanted as usize >= live.vertices()) {
            return self.code_new(coder, live, vertices, self.last, u64::MAX, point);
        }
        if live.vertices() == 0 {
            return Err("a vertex that is not there");
        }
        Ok(coder.uniform(live.vertices() as u32, wanted))
    }

    /// Codes a vertex that is new. `size` is a length around it, grid steps.
    pub fn code_new(
        &mut self,
        coder: &mut impl Coder,
        live: &mut Live,
        vertices: usize,
        guess: Grid,
        size: u64,
        point: Grid,
    ) -> Result<u32, &'static str> {
        if live.vertices() >= vertices {
            return Err("more vertices than it says it has");
        }
        let context = (64 - size.leading_zeros() as usize).min(63);
        let mut out = [0; 3];
        for k in 0..3 {
            out[k] = guess[k] + self.sizes[3 * context + k].code(coder, point[k] - guess[k], 0);
            if out[k].unsigned_abs() > MOST_COORDINATE as u64 {
                return Err("a coordinate out of range");
            }
        }
        self.last = out;
        Ok(live.add_vertex(out))
    }

    /// Where the last vertex was put.
    pub fn last(&self) -> Grid {
        self.last
    }
}

fn distance(a: Grid, b: Grid) -> u64 {
    (0..3).map(|k| a[k].abs_diff(b[k])).max().unwrap_or(0)
}

/// Chooses the next face of a mesh to be encoded.
pub struct Picker<'a> {
    faces: &'a [[u32; 3]],
    classes: &'a [u8],
    points: &'a [Grid],
    beside: HashMap<(u32, u32), Vec<u32>>,
    done: Vec<bool>,
    from: usize,
    /// Per vertex of the mesh: the record's number.
    pub number: Vec<u32>,
    /// Per vertex of the record: the mesh's.
    pub named: Vec<u32>,
    /// Faces in the order picked.
    pub order: Vec<u32>,
}

impl<'a> Picker<'a> {
    /// For `faces`, of `classes`, over `points`.
    pub fn new(faces: &'a [[u32; 3]], classes: &'a [u8], points: &'a [Grid]) -> Self {
        let mut beside: HashMap<(u32, u32), Vec<u32>> = HashMap::new();
        for (f, face) in faces.iter().enumerate() {
            for k in 0..3 {
                beside.entry(key(face[k], face[(k + 1) % 3])).or_default().push(f as u32);
            }
        }
        Self {
            faces,
            classes,
            points,
            beside,
            done: vec![false; faces.len()],
            from: 0,
            number: vec![u32::MAX; points.len()],
            named: Vec::new(),
            order: Vec::new(),
        }
    }

    /// The next face, none after the last; its vertices are numbered.
    pub fn pick(&mut self, open: &[Edge]) -> Option<Next> {
        let on_edge = open.iter().rev().enumerate().find_map(|(passed, edge)| {
            let ends = key(self.named[edge[0] as usize], self.named[edge[1] as usize]);
            self.beside.get(&ends)?.iter().find(|f| !self.done[**f as usize]).map(|f| (passed, *edge, *f as usize))
        });
        let mut next = Next::default();
        let f = match on_edge {
            Some((passed, edge, f)) => {
                next.passed = Some(passed);
                let [from, to] = [edge[0], edge[1]].map(|v| self.named[v as usize]);
                let face = self.faces[f];
                let k = (0..3).find(|&k| face[k] != from && face[k] != to)?;
                next.turned = face[(k + 1) % 3] == from;
                next.points[2] = self.points[face[k] as usize];
                next.corners[2] = self.numbered(face[k]);
                f
            }
            None => {
                while *self.done.get(self.from)? {
                    self.from += 1;
                }
                let face = self.faces[self.from];
                next.points = face.map(|v| self.points[v as usize]);
                next.corners = face.map(|v| self.numbered(v));
                self.from
            }
        };
        self.done[f] = true;
        self.order.push(f as u32);
        next.class = self.classes[f];
        Some(next)
    }

    /// The record's number of vertex `v`, a new one if need be.
    pub fn numbered(&mut self, v: u32) -> u32 {
        let number = &mut self.number[v as usize];
        if *number == u32::MAX {
            *number = self.named.len() as u32;
            self.named.push(v);
        }
        *number
    }
}

fn key(a: u32, b: u32) -> (u32, u32) {
    (a.min(b), a.max(b))
}
