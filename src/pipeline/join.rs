//! Makes the leaves' meshes of the pieces that files left in them.
//!
//! In: [`Buckets`]. Out: [`Joined`]; each leaf's mesh is a page of the store.
//!
//! # Method
//! Buckets become meshes by equal positions. Where several files meet, vertices on walls are welded first, all together
//! (they are few), then those inside each cell, to what is on its walls before anything else: so both sides of a wall
//! agree without seeing each other.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use glam::DVec3;
use rayon::prelude::*;

use super::cracks;
use super::ingest::{Leaf, put_mesh, take_mesh};
use crate::Result;
use crate::geo::Rect;
use crate::report::Reporter;
use crate::store::{PageReader, Store};
use crate::tiles::soup::bits;
use crate::tiles::{CellTree, Soup};

/// Pieces by leaf and file, in memory up to a size, then in pages.
pub(super) struct Buckets<'a> {
    store: &'a Store,
    open: BTreeMap<u32, Vec<(u32, Soup)>>,
    /// Pages of each leaf.
    pages: BTreeMap<u32, u32>,
    bytes: u64,
    most_bytes: u64,
}

impl<'a> Buckets<'a> {
    pub fn new(store: &'a Store, most_bytes: u64) -> Self {
        Self { store, open: BTreeMap::new(), pages: BTreeMap::new(), bytes: 0, most_bytes }
    }

    pub fn add(&mut self, leaf: u32, unit: u32, soup: Soup) -> Result<()> {
        self.bytes += soup.bytes() as u64;
        let of_leaf = self.open.entry(leaf).or_default();
        match of_leaf.last_mut() {
            Some((last, all)) if *last == unit => all.append(soup),
            _ => of_leaf.push((unit, soup)),
        }
        if self.bytes > self.most_bytes { self.flush() } else { Ok(()) }
    }

    fn flush(&mut self) -> Result<()> {
        for (leaf, segments) in std::mem::take(&mut self.open) {
            let number = self.pages.entry(leaf).or_default();
            let mut page = self.store.page(&format!("bucket/{leaf}-{number}"))?;
            *number += 1;
            let units: Vec<u32> = segments.iter().map(|s| s.0).collect();
            page.put(&units)?;
            for (_, soup) in &segments {
                soup.put(&mut page)?;
            }
            page.finish()?;
        }
        self.bytes = 0;
        Ok(())
    }

    /// Leaves that have anything.
    fn leaves(&self) -> Vec<u32> {
        self.pages.keys().chain(self.open.keys()).copied().collect::<BTreeSet<_>>().into_iter().collect()
    }

    /// All of a leaf in the order it came, and how many files it came from.
    fn gather(&self, leaf: u32) -> Result<(Soup, usize)> {
        let (mut all, mut units) = (Soup::default(), BTreeSet::new());
        for number in 0..self.pages.get(&leaf).copied().unwrap_or(0) {
            let mut page: PageReader = self.store.read(&format!("bucket/{leaf}-{number}"))?;
            for unit in page.take::<u32>()? {
                units.insert(unit);
                all.append(Soup::take(&mut page)?);
            }
            page.finish()?;
        }
        for (unit, soup) in self.open.get(&leaf).into_iter().flatten() {
            units.insert(*unit);
            all.append(soup.clone());
        }
        Ok((all, units.len()))
    }
}

/// What joining made.
pub(super) struct Joined {
    pub leaves: Vec<Leaf>,
    pub joined: usize,
    pub unmatched_m: f64,
    pub duplicate: usize,
    pub moved_m: f64,
}

/// Makes the leaves' meshes; see the module.
pub(super) struct Joiner<'a> {
    pub store: &'a Store,
    pub tree: &'a CellTree,
    pub weld_m: f64,
}

/// A leaf before files are welded.
struct Raw {
    cell: u32,
    faces: usize,
    units: usize,
    on_walls: Vec<DVec3>,
}

/// What became of a leaf when its files were welded.
#[derive(Default)]
struct Welded {
    faces: usize,
    /// Joined to others, those on walls aside.
    vertices: usize,
    duplicate: usize,
    unmatched_m: f64,
    moved_m: f64,
}

/// Borders of files this near to one another were meant to meet, metres.
const CRACK_M: f64 = 0.02;

impl Joiner<'_> {
    pub fn join(&self, buckets: Buckets, reporter: &Reporter) -> Result<Joined> {
        let raw: Result<Vec<Raw>> = buckets
            .leaves()
            .into_par_iter()
            .map(|cell| {
                reporter.check()?;
                let (soup, units) = buckets.gather(cell)?;
                let mesh = soup.into_mesh();
                put_mesh(self.store, &format!("source/{cell}"), &mesh)?;
                let on_wall = |p: &&DVec3| self.is_on_wall(cell, **p);
                Ok(Raw {
                    cell,
                    faces: mesh.faces.len(),
                    units,
                    on_walls: mesh.positions.iter().filter(on_wall).copied().collect(),
                })
            })
            .collect();
        drop(buckets);
        self.store.remove("bucket");
        let raw = raw?;
        let mut joined = Joined { leaves: Vec::new(), joined: 0, unmatched_m: 0.0, duplicate: 0, moved_m: 0.0 };
        let moves = if raw.iter().any(|r| r.units > 1) { self.weld_walls(&raw) } else { HashMap::new() };
        joined.joined = moves.len();
        let done: Result<Vec<Welded>> = raw
            .par_iter()
            .map(|leaf| {
                reporter.check()?;
                let is_moved = leaf.on_walls.iter().any(|p| moves.contains_key(&bits(*p)));
                let untouched = Welded { faces: leaf.faces, ..Welded::default() };
                if leaf.units > 1 || is_moved { self.weld_leaf(leaf, &moves) } else { Ok(untouched) }
            })
            .collect();
        for (leaf, welded) in raw.iter().zip(done?) {
            if welded.faces > 0 {
                joined.leaves.push(Leaf { cell: leaf.cell, faces: welded.faces });
            }
            joined.joined += welded.vertices;
            joined.duplicate += welded.duplicate;
            joined.unmatched_m += welded.unmatched_m;
            joined.moved_m = joined.moved_m.max(welded.moved_m);
        }
        Ok(joined)
    }

    fn is_on_wall(&self, cell: u32, p: DVec3) -> bool {
        let Rect { min, max } = self.tree.cells[cell as usize].plan;
        p.x == min.x || p.x == max.x || p.y == min.y || p.y == max.y
    }

    /// Where vertices on walls go: to a vertex within the tolerance that is on all of their walls. Those on two walls
    /// come first, then the order of positions decides, so that it does not matter which cell saw a vertex first.
    fn weld_walls(&self, raw: &[Raw]) -> HashMap<[u64; 3], DVec3> {
        let mut all: Vec<(u8, DVec3, [bool; 2])> = Vec::new();
        for leaf in raw {
            let Rect { min, max } = self.tree.cells[leaf.cell as usize].plan;
            all.extend(leaf.on_walls.iter().map(|p| {
                let on = [p.x == min.x || p.x == max.x, p.y == min.y || p.y == max.y];
                (2 - u8::from(on[0]) - u8::from(on[1]), *p, on)
            }));
        }
        let by_place = |a: &DVec3, b: &DVec3| {
            (0..3).map(|k| a[k].total_cmp(&b[k])).find(|o| o.is_ne()).unwrap_or(std::cmp::Ordering::Equal)
        };
        all.par_sort_unstable_by(|a, b| by_place(&a.1, &b.1).then(a.0.cmp(&b.0)));
        // A vertex on two walls of one cell may be on one wall of another.
        all.dedup_by(|later, kept| later.1 == kept.1);
        all.par_sort_unstable_by(|a, b| a.0.cmp(&b.0).then(by_place(&a.1, &b.1)));
        let positions: Vec<DVec3> = all.iter().map(|a| a.1).collect();
        let may = |kept: usize, v: usize| {
            (0..2).all(|k| !all[v].2[k] || (all[kept].2[k] && positions[kept][k] == positions[v][k]))
        };
        let target = greedy(&positions, self.weld_m, may);
        let moved = (0..positions.len()).filter(|&v| target[v] as usize != v);
        moved.map(|v| (bits(positions[v]), positions[target[v] as usize])).collect()
    }

    /// Welds the files of one leaf.
    fn weld_leaf(&self, leaf: &Raw, moves: &HashMap<[u64; 3], DVec3>) -> Result<Welded> {
        let name = format!("source/{}", leaf.cell);
        let mesh = take_mesh(self.store, &name)?;
        let places: Vec<DVec3> = mesh.positions.iter().map(|p| moves.get(&bits(*p)).copied().unwrap_or(*p)).collect();
        let on_wall: Vec<bool> = places.iter().map(|p| self.is_on_wall(leaf.cell, *p)).collect();
        // What is on walls is settled and comes first.
        let mut order: Vec<u32> = (0..places.len() as u32).collect();
        order.sort_by_key(|&v| (!on_wall[v as usize], v));
        let ordered: Vec<DVec3> = order.iter().map(|&v| places[v as usize]).collect();
        let target = greedy(&ordered, self.weld_m, |_, v| !on_wall[order[v] as usize]);
        let mut place = places.clone();
        for (i, &v) in order.iter().enumerate() {
            place[v as usize] = ordered[target[i] as usize];
        }
        let (mut welded, mut moved_m) = (0, 0f64);
        for (new, old) in place.iter().zip(&mesh.positions) {
            welded += usize::from(new != old && !moves.contains_key(&bits(*old)));
            moved_m = moved_m.max((*new - *old).length());
        }
        let before = mesh.faces.len();
        let mut soup = Soup::default();
        for f in 0..before {
            soup.push(&mesh, f, mesh.faces[f].map(|v| place[v as usize]), None);
        }
        let mut mesh = soup.into_mesh();
        let mut seen = std::collections::HashSet::new();
        let keep: Vec<bool> = mesh
            .faces
            .iter()
            .enumerate()
            .map(|(f, face)| {
                let mut key = *face;
                key.sort_unstable();
                mesh.cross(f).length_squared() > 0.0 && seen.insert(key)
            })
            .collect();
        let flat = before - mesh.faces.len();
        mesh.retain_faces(&keep);
        let duplicate = before - flat - mesh.faces.len();
        put_mesh(self.store, &name, &mesh)?;
        let unmatched_m = cracks::length_m(&mesh, CRACK_M, |p| self.is_on_wall(leaf.cell, p));
        Ok(Welded { faces: mesh.faces.len(), vertices: welded, duplicate, unmatched_m, moved_m })
    }
}

/// For every vertex, in order, the first kept one within the tolerance that it may join, else itself, which is then kept.
fn greedy(positions: &[DVec3], tolerance_m: f64, may: impl Fn(usize, usize) -> bool) -> Vec<u32> {
    let mut target: Vec<u32> = (0..positions.len() as u32).collect();
    if tolerance_m <= 0.0 {
        return target;
    }
    let cell_m = 8.0 * tolerance_m;
    let mut kept: HashMap<[i64; 3], Vec<u32>> = HashMap::with_capacity(positions.len() / 4);
    for (v, &p) in positions.iter().enumerate() {
        let (low, high) = (((p - tolerance_m) / cell_m).floor(), ((p + tolerance_m) / cell_m).floor());
        let (low, high) = (low.as_i64vec3(), high.as_i64vec3());
        let mut found = u32::MAX;
        for x in low.x..=high.x {
            for y in low.y..=high.y {
                for z in low.z..=high.z {
                    for &k in kept.get(&[x, y, z]).into_iter().flatten() {
                        let near = (positions[k as usize] - p).length_squared() <= tolerance_m * tolerance_m;
                        if near && k < found && may(k as usize, v) {
                            found = k;
                        }
                    }
                }
            }
        }
        if found == u32::MAX {
            let own = (p / cell_m).floor().as_i64vec3();
            kept.entry(own.to_array()).or_default().push(v as u32);
        } else {
            target[v] = found;
        }
    }
    target
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vertex_joins_the_first_kept_one_it_may() {
        let at = |x: f64| DVec3::new(x, 0.0, 0.0);
        let places = [at(0.0), at(0.0008), at(0.0016), at(0.5)];
        assert_eq!(greedy(&places, 0.001, |_, _| true), [0, 0, 2, 3], "no chains");
        assert_eq!(greedy(&places, 0.001, |k, _| k != 0), [0, 1, 1, 3]);
        assert_eq!(greedy(&places, 0.0, |_, _| true), [0, 1, 2, 3]);
    }
}
