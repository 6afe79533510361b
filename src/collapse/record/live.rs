//! The mesh while it is refined: who uses a vertex, and its star in an order that both directions can name.
//!
//! Numbers are the record's own: vertices and faces in the order in which they appear. Any triangles will do: nothing
//! is assumed of how many faces an edge has or which way they turn.

use glam::DVec3;

use super::super::NONE;
use super::split::Split;

/// Grid coordinates of a vertex.
pub type Grid = [i64; 3];

/// A mesh that grows by splits.
#[derive(Debug, Clone, Default)]
pub struct Live {
    vertices: Vec<Vertex>,
    faces: Vec<Face>,
    /// Lists of corners, 3 · face + corner, with the room that [`room`] gives them.
    corners: Vec<u32>,
}

/// A vertex in half a line of memory.
#[derive(Debug, Clone, Copy)]
struct Vertex {
    at: Grid,
    /// Where its list is.
    start: u32,
    len: u32,
}

#[derive(Debug, Clone, Copy)]
struct Face {
    corners: [u32; 3],
    class: u8,
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

impl Fold {
    /// On the same edge, and of the other vertex.
    pub fn is_twin_of(&self, other: &Self) -> bool {
        self.of_new != other.of_new && [[other.a, other.b], [other.b, other.a]].contains(&[self.a, self.b])
    }
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
    /// Places of `a` and `b` among the rims.
    pub rims: [u32; 2],
    /// The class of the face.
    pub class: u8,
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
    /// Where it is, grid steps.
    pub at: DVec3,
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

/// Room for a list of `len` corners. Lists outgrow it now and then, and leave a hole.
fn room(len: u32) -> u32 {
    if len <= 16 { len.next_multiple_of(4) } else { len.next_power_of_two() }
}

impl Live {
    /// Empty, with room for a mesh that is known beforehand.
    pub fn with_room(vertices: usize, faces: usize) -> Self {
        Self {
            vertices: Vec::with_capacity(vertices),
            faces: Vec::with_capacity(faces),
            corners: Vec::with_capacity(6 * faces),
        }
    }

    /// Number of vertices.
    pub fn vertices(&self) -> usize {
        self.vertices.len()
    }

    /// Number of faces.
    pub fn faces(&self) -> usize {
        self.faces.len()
    }

    /// Where `v` is.
    pub fn at(&self, v: u32) -> Grid {
        self.vertices[v as usize].at
    }

    /// Where all vertices are.
    pub fn points(&self) -> impl Iterator<Item = Grid> + '_ {
        self.vertices.iter().map(|v| v.at)
    }

    /// Corners and classes of all faces.
    pub fn into_faces(self) -> (Vec<[u32; 3]>, Vec<u8>) {
        let classes = self.faces.iter().map(|f| f.class).collect();
        (self.faces.into_iter().map(|f| f.corners).collect(), classes)
    }

    /// Classes of the faces from `first` on.
    pub fn classes_from(&self, first: usize) -> impl Iterator<Item = u8> + '_ {
        self.faces[first..].iter().map(|f| f.class)
    }

    /// Adds a vertex without faces.
    pub fn add_vertex(&mut self, at: Grid) -> u32 {
        self.vertices.push(Vertex { at, start: 0, len: 0 });
        self.vertices.len() as u32 - 1
    }

    /// Adds a face of three vertices that exist.
    pub fn add_face(&mut self, corners: [u32; 3], class: u8) {
        let f = self.faces.len() as u32;
        self.faces.push(Face { corners, class });
        for (v, k) in corners.into_iter().zip(0..) {
            self.add_corner(v, 3 * f + k);
        }
    }

    fn add_corner(&mut self, v: u32, corner: u32) {
        let Vertex { start, len, .. } = self.vertices[v as usize];
        if len == room(len) {
            self.vertices[v as usize].start = self.corners.len() as u32;
            self.corners.extend_from_within(start as usize..(start + len) as usize);
            let end = self.vertices[v as usize].start + room(len + 1);
            self.corners.resize(end as usize, NONE);
        }
        let vertex = &mut self.vertices[v as usize];
        vertex.len += 1;
        self.corners[(vertex.start + len) as usize] = corner;
    }

    fn list(&self, v: u32) -> &[u32] {
        let Vertex { start, len, .. } = self.vertices[v as usize];
        &self.corners[start as usize..(start + len) as usize]
    }

    /// Reads what the stars of `vertices` are made of, all at once, so that the waits for memory overlap.
    pub fn fetch(&self, vertices: &[u32]) {
        let present = || vertices.iter().filter(|v| (**v as usize) < self.vertices.len());
        let mut read = present().fold(0, |read, v| read ^ self.vertices[*v as usize].len);
        read = present().fold(read, |read, v| read ^ self.list(*v).first().copied().unwrap_or(0));
        let near = || present().flat_map(|v| self.list(*v).iter().take(MOST_ORDERED));
        read = near().fold(read, |read, c| read ^ self.faces[*c as usize / 3].corners[0]);
        let corners = near().flat_map(|c| self.faces[*c as usize / 3].corners);
        read = corners.fold(read, |read, v| read ^ self.vertices[v as usize].len);
        std::hint::black_box(read);
    }

    /// Fills `star` with the faces and neighbours of `v`.
    pub fn star(&self, v: u32, star: &mut Star) {
        star.spokes.clear();
        star.rims.clear();
        star.found.clear();
        for &corner in self.list(v) {
            let Face { corners, class } = self.faces[corner as usize / 3];
            let k = corner as usize % 3;
            let (a, b) = (corners[(k + 1) % 3], corners[(k + 2) % 3]);
            star.found.push(Spoke { corner, a, b, rims: [0; 2], class, begins: true, closed: false, left: 0 });
        }
        if star.found.len() > MOST_ORDERED {
            star.found.sort_unstable_by_key(|s| s.corner);
            star.spokes.append(&mut star.found);
        } else {
            star.walk();
        }
        star.list_rims();
        for rim in &mut star.rims {
            rim.at = vec(self.at(rim.vertex));
        }
    }

    /// Performs a split of the vertex of `star`: the faces that leave go to a new vertex, wings and folds appear, the old
    /// vertex moves.
    pub fn split(&mut self, star: &Star, split: &Split) {
        let Split { kept, leaves, wings, folds, kept_at, gone_at, .. } = split;
        let kept = *kept;
        let new = self.add_vertex(*gone_at);
        let leave = leaves.iter().filter(|l| **l).count() as u32;
        let stay = leaves.len() as u32 - leave;
        // The longer list takes the old place: so a corner moves to a new one only as often as its list halves.
        let old = self.vertices[kept as usize].start;
        let end = self.corners.len() as u32;
        let starts = if stay >= leave { [old, end] } else { [end, old] };
        self.corners.resize((end + room(stay.min(leave))) as usize, NONE);
        self.vertices[kept as usize] = Vertex { at: *kept_at, start: starts[0], len: 0 };
        self.vertices[new as usize].start = starts[1];
        for (spoke, leaves) in star.spokes.iter().zip(leaves) {
            let owner = if *leaves { new } else { kept };
            self.faces[spoke.corner as usize / 3].corners[spoke.corner as usize % 3] = owner;
            let vertex = &mut self.vertices[owner as usize];
            self.corners[(vertex.start + vertex.len) as usize] = spoke.corner;
            vertex.len += 1;
        }
        for wing in wings {
            let (a, b) = if wing.turned { (new, kept) } else { (kept, new) };
            self.add_face([a, b, wing.apex], wing.class);
        }
        for fold in folds {
            self.add_face([if fold.of_new { new } else { kept }, fold.a, fold.b], fold.class);
        }
        if self.corners.len() > MOST_HOLES * 3 * self.faces.len() + (1 << 16) {
            self.tidy();
        }
    }

    /// Moves all lists together. Real meshes never get there.
    fn tidy(&mut self) {
        let mut corners = Vec::with_capacity(self.vertices.iter().map(|v| room(v.len) as usize).sum());
        for vertex in &mut self.vertices {
            let start = std::mem::replace(&mut vertex.start, corners.len() as u32);
            corners.extend_from_slice(&self.corners[start as usize..(start + vertex.len) as usize]);
            corners.resize((vertex.start + room(vertex.len)) as usize, NONE);
        }
        self.corners = corners;
    }
}

/// Lists may take this many times the corners there are.
const MOST_HOLES: usize = 8;

/// Grid coordinates as numbers to calculate with.
pub fn vec(p: Grid) -> DVec3 {
    DVec3::new(p[0] as f64, p[1] as f64, p[2] as f64)
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
        let rim = |vertex, spoke| Rim { vertex, at: DVec3::ZERO, spoke, other: spoke, stay: 0, leave: 0 };
        if many {
            self.rims.extend(self.spokes.iter().zip(0..).flat_map(|(s, i)| [rim(s.a, i), rim(s.b, i)]));
            self.rims.sort_unstable_by_key(|r| (r.vertex, r.spoke));
            self.rims.dedup_by_key(|r| r.vertex);
        }
        for (i, spoke) in self.spokes.iter_mut().enumerate() {
            spoke.rims = [spoke.a, spoke.b].map(|vertex| {
                let known = if many {
                    self.rims.binary_search_by_key(&vertex, |r| r.vertex).ok()
                } else {
                    self.rims.iter().rposition(|r| r.vertex == vertex)
                };
                known.unwrap_or_else(|| {
                    self.rims.push(rim(vertex, i as u32));
                    self.rims.len() - 1
                }) as u32
            });
        }
    }

    /// Where the corners of a spoke other than the vertex are.
    pub fn ends(&self, spoke: &Spoke) -> [DVec3; 2] {
        spoke.rims.map(|i| self.rims[i as usize].at)
    }

    /// Counts for every rim the spokes on either side.
    pub fn count_sides(&mut self, leaves: &[bool]) {
        for (place, (spoke, &leaves)) in self.spokes.iter().zip(leaves).enumerate() {
            for i in spoke.rims {
                let rim = &mut self.rims[i as usize];
                rim.other = place as u32;
                *(if leaves { &mut rim.leave } else { &mut rim.stay }) += 1;
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
