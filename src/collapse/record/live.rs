//! The mesh while it is refined: who uses a vertex, and its star in an order that both directions can name.
//!
//! Numbers are the record's own: vertices and faces in the order in which they appear. Any triangles will do: nothing
//! is assumed of how many faces an edge has or which way they turn.

use super::super::NONE;
use super::split::Split;

/// Grid coordinates of a vertex.
pub type Grid = [i64; 3];

/// A mesh that grows by splits.
#[derive(Debug, Clone, Default)]
pub struct Live {
    /// Per vertex.
    pub points: Vec<Grid>,
    /// Per face.
    pub faces: Vec<[u32; 3]>,
    /// Per face: class.
    pub classes: Vec<u8>,
    head: Vec<u32>,
    next: Vec<u32>,
}

/// A face that both ends of the new edge use.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Wing {
    /// Its third vertex.
    pub apex: u32,
    /// It runs gone, kept, apex instead of kept, gone, apex.
    pub turned: bool,
    /// Its class.
    pub class: u8,
    /// The encoder's own name of the face; not coded.
    pub tag: u32,
}

/// A face that the collapse folded onto another one and took away.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Fold {
    /// It is the new vertex's, not the old one's.
    pub of_new: bool,
    /// It runs from that vertex to `a` to `b`.
    pub a: u32,
    /// See `a`.
    pub b: u32,
    /// Its class.
    pub class: u8,
    /// The encoder's own name of the face; not coded.
    pub tag: u32,
}

/// A face around the vertex to be split.
#[derive(Debug, Clone, Copy)]
pub struct Spoke {
    /// 3 · face + corner.
    pub corner: u32,
    /// The face runs from the vertex to `a` to `b`.
    pub a: u32,
    /// See `a`.
    pub b: u32,
    /// Begins a fan: shares no edge with the face before it.
    pub begins: bool,
    /// Its fan is closed.
    pub closed: bool,
    /// Faces of its fan that follow it.
    pub left: u32,
}

/// A vertex next to the one to be split.
#[derive(Debug, Clone, Copy)]
pub struct Rim {
    /// The vertex.
    pub vertex: u32,
    /// The first spoke that uses it.
    pub spoke: u32,
    /// The last spoke that uses it, known after the sides are.
    pub other: u32,
    /// Spokes that use it and stay, counted after the sides are known.
    pub stay: u32,
    /// Spokes that use it and go to the new vertex.
    pub leave: u32,
}

/// The star of a vertex.
#[derive(Debug, Clone, Default)]
pub struct Star {
    /// Its faces, fan by fan.
    pub spokes: Vec<Spoke>,
    /// Its neighbours, in the order of the spokes.
    pub rims: Vec<Rim>,
    found: Vec<Spoke>,
    used: Vec<bool>,
}

/// Stars of more faces than this are taken as they lie, because ordering them is quadratic.
const MOST_ORDERED: usize = 64;

impl Live {
    /// Empty, with room for a mesh that is known beforehand.
    pub fn with_room(vertices: usize, faces: usize) -> Self {
        Self {
            points: Vec::with_capacity(vertices),
            faces: Vec::with_capacity(faces),
            classes: Vec::with_capacity(faces),
            head: Vec::with_capacity(vertices),
            next: Vec::with_capacity(3 * faces),
        }
    }

    /// Adds a vertex without faces.
    pub fn add_vertex(&mut self, point: Grid) -> u32 {
        self.points.push(point);
        self.head.push(NONE);
        self.points.len() as u32 - 1
    }

    /// Adds a face of three vertices that exist.
    pub fn add_face(&mut self, face: [u32; 3], class: u8) {
        let f = self.faces.len() as u32;
        self.faces.push(face);
        self.classes.push(class);
        for (k, v) in face.into_iter().enumerate() {
            self.next.push(self.head[v as usize]);
            self.head[v as usize] = 3 * f + k as u32;
        }
    }

    /// Fills `star` with the faces and neighbours of `v`.
    pub fn star(&self, v: u32, star: &mut Star) {
        star.spokes.clear();
        star.rims.clear();
        star.found.clear();
        let mut corner = self.head[v as usize];
        while corner != NONE {
            let face = self.faces[corner as usize / 3];
            let k = corner as usize % 3;
            let (a, b) = (face[(k + 1) % 3], face[(k + 2) % 3]);
            star.found.push(Spoke { corner, a, b, begins: true, closed: false, left: 0 });
            corner = self.next[corner as usize];
        }
        if star.found.len() > MOST_ORDERED {
            star.found.sort_unstable_by_key(|s| s.corner);
            star.spokes.append(&mut star.found);
        } else {
            star.walk();
        }
        star.list_rims();
    }

    /// Performs a split of the vertex of `star`: the faces that leave go to a new vertex, wings and folds appear, the old
    /// vertex moves.
    pub fn split(&mut self, star: &Star, split: &Split) {
        let Split { kept, leaves, wings, folds, kept_at, gone_at, .. } = split;
        let kept = *kept;
        let new = self.add_vertex(*gone_at);
        self.points[kept as usize] = *kept_at;
        self.head[kept as usize] = NONE;
        for (spoke, leaves) in star.spokes.iter().zip(leaves).rev() {
            let owner = if *leaves { new } else { kept };
            self.faces[spoke.corner as usize / 3][spoke.corner as usize % 3] = owner;
            self.next[spoke.corner as usize] = self.head[owner as usize];
            self.head[owner as usize] = spoke.corner;
        }
        for wing in wings {
            let (a, b) = if wing.turned { (new, kept) } else { (kept, new) };
            self.add_face([a, b, wing.apex], wing.class);
        }
        for fold in folds {
            self.add_face([if fold.of_new { new } else { kept }, fold.a, fold.b], fold.class);
        }
    }
}

impl Star {
    /// Orders `found` so that faces that share an edge follow each other, fans from their open ends if they have any.
    fn walk(&mut self) {
        let found = std::mem::take(&mut self.found);
        self.used.clear();
        self.used.resize(found.len(), false);
        while self.spokes.len() < found.len() {
            let begin = self.spokes.len();
            let open = |i: &usize| {
                let a = found[*i].a;
                !self.used[*i]
                    && (0..found.len()).all(|j| j == *i || self.used[j] || found[j].a != a && found[j].b != a)
            };
            let first = (0..found.len()).find(open).or_else(|| (0..found.len()).find(|i| !self.used[*i]));
            let Some(mut at) = first else { break };
            let entry = found[at].a;
            let mut exit = entry;
            loop {
                self.used[at] = true;
                self.spokes.push(Spoke { begins: self.spokes.len() == begin, ..found[at] });
                exit = if found[at].a == exit { found[at].b } else { found[at].a };
                let follows = |j: &usize| !self.used[*j] && (found[*j].a == exit || found[*j].b == exit);
                match (0..found.len()).find(follows) {
                    Some(j) => at = j,
                    None => break,
                }
            }
            let fan = &mut self.spokes[begin..];
            let closed = exit == entry && fan.len() > 2;
            let count = fan.len() as u32;
            for (i, spoke) in fan.iter_mut().enumerate() {
                spoke.closed = closed;
                spoke.left = count - 1 - i as u32;
            }
        }
        self.found = found;
    }

    fn list_rims(&mut self) {
        let many = self.spokes.len() > MOST_ORDERED;
        for (i, spoke) in self.spokes.iter().enumerate() {
            for vertex in [spoke.a, spoke.b] {
                if many || self.rims.iter().all(|r| r.vertex != vertex) {
                    self.rims.push(Rim { vertex, spoke: i as u32, other: i as u32, stay: 0, leave: 0 });
                }
            }
        }
        if many {
            self.rims.sort_unstable_by_key(|r| (r.vertex, r.spoke));
            self.rims.dedup_by_key(|r| r.vertex);
        }
    }

    /// Counts for every rim the spokes on either side.
    pub fn count_sides(&mut self, leaves: &[bool]) {
        let many = self.spokes.len() > MOST_ORDERED;
        for (place, (spoke, &leaves)) in self.spokes.iter().zip(leaves).enumerate() {
            for vertex in [spoke.a, spoke.b] {
                let rim = if many {
                    self.rims.binary_search_by_key(&vertex, |r| r.vertex).ok()
                } else {
                    self.rims.iter().position(|r| r.vertex == vertex)
                };
                if let Some(i) = rim {
                    let rim = &mut self.rims[i];
                    rim.other = place as u32;
                    *(if leaves { &mut rim.leave } else { &mut rim.stay }) += 1;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fan(faces: &[[u32; 3]]) -> Live {
        let mut live = Live::default();
        let vertices = faces.iter().flatten().max().map_or(0, |v| v + 1);
        (0..vertices).for_each(|_| {
            live.add_vertex([0; 3]);
        });
        faces.iter().for_each(|&f| live.add_face(f, 0));
        live
    }

    #[test]
    fn a_closed_star_is_walked_around_whatever_the_order_and_turn_of_its_faces() {
        let live = fan(&[[0, 1, 2], [0, 3, 4], [2, 3, 0], [0, 1, 4]]);
        let mut star = Star::default();
        live.star(0, &mut star);
        assert_eq!(star.spokes.len(), 4);
        assert!(star.spokes.iter().all(|s| s.closed));
        assert_eq!(star.spokes.iter().filter(|s| s.begins).count(), 1);
        assert_eq!(star.rims.len(), 4);
    }

    #[test]
    fn an_open_fan_is_walked_from_its_end() {
        let live = fan(&[[0, 2, 3], [0, 1, 2], [0, 3, 4]]);
        let mut star = Star::default();
        live.star(0, &mut star);
        let order: Vec<u32> = star.spokes.iter().map(|s| s.a).collect();
        assert_eq!(order, [1, 2, 3]);
        assert!(star.spokes.iter().all(|s| !s.closed));
    }

    #[test]
    fn three_faces_on_an_edge_and_a_lone_face_are_two_fans_and_more() {
        let live = fan(&[[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 5, 6]]);
        let mut star = Star::default();
        live.star(0, &mut star);
        assert_eq!(star.spokes.len(), 4);
        assert_eq!(star.rims.len(), 6);
        assert!(star.spokes.iter().filter(|s| s.begins).count() >= 2);
    }

    #[test]
    fn a_split_parts_the_star() {
        let mut live = fan(&[[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]]);
        let mut star = Star::default();
        live.star(0, &mut star);
        let leaves: Vec<bool> = star.spokes.iter().map(|s| s.a == 1 || s.a == 2).collect();
        let wings =
            [Wing { apex: 1, turned: false, class: 0, tag: 0 }, Wing { apex: 3, turned: true, class: 0, tag: 0 }];
        let split = Split { leaves, wings: wings.to_vec(), gone_at: [1; 3], ..Split::default() };
        live.split(&star, &split);
        live.star(0, &mut star);
        assert_eq!(star.spokes.len(), 4);
        live.star(5, &mut star);
        assert_eq!(star.spokes.len(), 4);
        assert!(star.spokes.iter().all(|s| s.closed));
    }
}
