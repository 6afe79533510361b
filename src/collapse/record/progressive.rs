//! A decoded record: any prefix of its splits is a mesh, and so is any choice of them that budgets allow.
//!
//! Vertices are numbered in the order in which refinement makes them, and so are faces: the mesh after n splits has
//! the first vertices and the first faces, so a viewer appends to its buffers and never moves what is there.

use glam::DVec3;

use super::MAX_CLASSES;
use super::file::About;
use super::level::size_of;

/// A base and the splits that refine it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Progressive {
    /// About the whole.
    pub about: About,
    /// Vertices of the base, local metres.
    pub base_points: Vec<DVec3>,
    /// Faces of the base.
    pub base_faces: u32,
    /// Levels of the largest deviation of each class in the finest mesh: 0 if all was decoded.
    pub finest: [u8; MAX_CLASSES],
    /// Per split: the vertex that splits; the new vertex is number `base_points.len() + split`.
    pub kept: Vec<u32>,
    /// Per split: where `kept` was before it.
    pub coarse_at: Vec<DVec3>,
    /// Per split: where `kept` is after it.
    pub kept_at: Vec<DVec3>,
    /// Per split: where the new vertex is.
    pub gone_at: Vec<DVec3>,
    /// Per split: levels of the largest deviation per class that its collapse caused.
    pub deviation: Vec<[u8; MAX_CLASSES]>,
    /// Per split: half the binary logarithm of the largest energy of its collapse and those before it, rounded up.
    pub energy: Vec<i16>,
    /// Per split: faces after it.
    pub faces_after: Vec<u32>,
    /// All faces, corners as after the last split.
    pub faces: Vec<[u32; 3]>,
    /// Per face: class.
    pub classes: Vec<u8>,
    /// Neighbours of the two vertices after the split, but for each other; of split i from `rims_end[i - 1]` (or 0) to `rims_end[i]`.
    pub rims: Vec<u32>,
    /// See `rims`.
    pub rims_end: Vec<usize>,
}

/// A mesh out of a record.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Replayed {
    /// Local metres.
    pub positions: Vec<DVec3>,
    /// Indices into `positions`.
    pub faces: Vec<[u32; 3]>,
    /// Per face: class.
    pub classes: Vec<u8>,
    /// Per class: no tracked sample is further from the mesh, metres; 0 for all if nothing was tracked.
    pub bounds_m: [f64; MAX_CLASSES],
    /// Splits that it has.
    pub splits: usize,
}

impl Progressive {
    /// Splits decoded.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// True if only the base was decoded.
    pub fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }

    /// Faces of the mesh after `splits`.
    pub fn faces_at(&self, splits: usize) -> usize {
        (if splits == 0 { self.base_faces } else { self.faces_after[splits - 1] }) as usize
    }

    /// The most splits that leave at most `faces` faces; 0 if even the base has more.
    pub fn splits_for_faces(&self, faces: usize) -> usize {
        self.faces_after.partition_point(|&n| n as usize <= faces)
    }

    /// Where vertices are after `splits`.
    pub fn positions_at(&self, splits: usize) -> Vec<DVec3> {
        let mut positions = Vec::with_capacity(self.base_points.len() + splits);
        positions.extend_from_slice(&self.base_points);
        for ((&kept, &at), &gone) in self.kept[..splits].iter().zip(&self.kept_at).zip(&self.gone_at) {
            positions[kept as usize] = at;
            positions.push(gone);
        }
        positions
    }

    /// The mesh after the first `splits`; all of them if there are fewer.
    pub fn at(&self, splits: usize) -> Replayed {
        let splits = splits.min(self.len());
        let positions = self.positions_at(splits);
        let live = positions.len();
        // A vertex merges into one that was there before it: going up, every target is final.
        let mut into: Vec<u32> = self.kept[splits..].to_vec();
        for i in 0..into.len() {
            if let Some(older) = (into[i] as usize).checked_sub(live) {
                into[i] = into[older];
            }
        }
        let count = self.faces_at(splits);
        let corner = |v: u32| (v as usize).checked_sub(live).map_or(v, |i| into[i]);
        let faces = self.faces[..count].iter().map(|f| f.map(corner)).collect();
        let bounds_m = self.bounds(|i| i >= splits);
        Replayed { positions, faces, classes: self.classes[..count].to_vec(), bounds_m, splits }
    }

    /// Collapses, finest first, every edge whose collapse kept each class within its budget, metres, and whose
    /// surroundings are just as they were when it was recorded: the distances of its samples are then those recorded.
    ///
    /// A collapse left out marks its vertices and those of the faces that it would have taken away; one with a marked
    /// vertex in its star is left out too. So no source vertex is further off than the strictest budget of the classes
    /// around it (`a_choice_by_budgets_keeps_every_source_vertex_within_them`), and the result is as regular as a prefix.
    pub fn within(&self, budgets_m: &[f64; MAX_CLASSES]) -> Replayed {
        let fits = |levels: &[u8; MAX_CLASSES]| levels.iter().zip(budgets_m).all(|(l, b)| size_of(*l) <= *b);
        let base = self.base_points.len();
        let mut marked = vec![false; base + self.len()];
        let mut done = vec![false; self.len()];
        for i in (0..self.len()).rev() {
            let (kept, gone) = (self.kept[i] as usize, base + i);
            let begin = if i == 0 { 0 } else { self.rims_end[i - 1] };
            let touched = marked[kept] || marked[gone] || {
                self.rims[begin..self.rims_end[i]].iter().any(|&v| marked[v as usize])
            };
            done[i] = !touched && fits(&self.deviation[i]);
            if !done[i] {
                marked[kept] = true;
                marked[gone] = true;
                let first = if i == 0 { self.base_faces } else { self.faces_after[i - 1] };
                for &corner in self.faces[first as usize..self.faces_after[i] as usize].iter().flatten() {
                    // Faces name vertices of the finest mesh; this one and what it had merged into by then.
                    let mut v = corner as usize;
                    marked[v] = true;
                    while v > base + i {
                        v = self.kept[v - base] as usize;
                        marked[v] = true;
                    }
                }
            }
        }
        self.chosen(&done)
    }

    /// The finest mesh with the collapses in `done` carried out.
    fn chosen(&self, done: &[bool]) -> Replayed {
        let base = self.base_points.len();
        let mut places = self.positions_at(self.len());
        for i in (0..self.len()).rev().filter(|&i| done[i]) {
            places[self.kept[i] as usize] = self.coarse_at[i];
        }
        // New numbers, going up: a vertex that stays gets the next, one that merges that of its target.
        let mut number = vec![0u32; places.len()];
        let mut positions = Vec::new();
        for v in 0..places.len() {
            number[v] = match v.checked_sub(base).filter(|&i| done[i]) {
                Some(i) => number[self.kept[i] as usize],
                None => {
                    positions.push(places[v]);
                    positions.len() as u32 - 1
                }
            };
        }
        // A face goes with the collapse that took it away, which is the split that brings it back.
        let begins = std::iter::once(self.base_faces).chain(self.faces_after.iter().copied());
        let ranges = begins.zip(&self.faces_after).zip(done).filter(|(_, done)| !**done);
        let brought = ranges.flat_map(|((begin, &end), _)| begin..end);
        let (faces, classes) = (0..self.base_faces)
            .chain(brought)
            .map(|f| (self.faces[f as usize].map(|v| number[v as usize]), self.classes[f as usize]))
            .unzip::<_, _, Vec<_>, Vec<u8>>();
        let splits = done.iter().filter(|d| !**d).count();
        Replayed { positions, faces, classes, bounds_m: self.bounds(|i| done[i]), splits }
    }

    /// The fewest splits whose mesh keeps every class within its limit, metres: the coarsest such prefix. None if even
    /// the finest does not, or nothing is known of errors.
    pub fn splits_within(&self, limits_m: &[f64; MAX_CLASSES]) -> Option<usize> {
        let fits = |levels: &[u8; MAX_CLASSES]| levels.iter().zip(limits_m).all(|(l, m)| size_of(*l) <= *m);
        if !self.about.tracked || !fits(&self.finest) {
            return None;
        }
        Some(self.deviation.iter().rposition(|own| !fits(own)).map_or(0, |i| i + 1))
    }

    /// The largest deviations of the collapses that `done` says are carried out.
    fn bounds(&self, done: impl Fn(usize) -> bool) -> [f64; MAX_CLASSES] {
        let mut levels = self.finest;
        for (_, own) in self.deviation.iter().enumerate().filter(|(i, _)| done(*i)) {
            levels.iter_mut().zip(own).for_each(|(l, o)| *l = (*l).max(*o));
        }
        levels.map(size_of)
    }
}
