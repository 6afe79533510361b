//! Who touches whom: adjacency of a triangle mesh, derived where it is needed and never stored in it.
//!
//! In: faces of a [`Mesh`]. Out: flat arrays of ids. Knows nothing of positions.
//!
//! # Method      counting sort of half-edges by their smaller vertex, then a sort inside each (small) bucket
//! # Promises    deterministic; worst case O(n log n) even for fans of a million faces
//! # Cost        linear; 24 bytes a face while it runs, 12 of them kept (counted)

use super::Mesh;

/// No neighbour: a border, or an edge with three faces and more.
pub const NONE: u32 = u32::MAX;

/// Per face, the face behind each edge; edge `k` runs from corner `k` to corner `k + 1`.
///
/// [`NONE`] on borders and on non-manifold edges. The two faces of an edge are neighbours even when their
/// orientations disagree. The relation is symmetric. Meshes of up to 1.4 billion faces.
pub fn face_neighbours(mesh: &Mesh) -> Vec<[u32; 3]> {
    let faces = &mesh.faces;
    let ends = |half_edge: u32| {
        let face = faces[(half_edge / 3) as usize];
        let k = (half_edge % 3) as usize;
        let (a, b) = (face[k], face[(k + 1) % 3]);
        (a.min(b), a.max(b))
    };
    let half_edges = 3 * faces.len() as u32;
    let buckets = Incidence::of(mesh.positions.len(), (0..half_edges).map(|h| ends(h).0));
    let mut neighbours = vec![[NONE; 3]; faces.len()];
    let mut bucket: Vec<(u32, u32)> = Vec::new();
    for vertex in 0..mesh.positions.len() {
        bucket.clear();
        bucket.extend(buckets.of_vertex(vertex).iter().map(|&h| (ends(h).1, h)));
        bucket.sort_unstable();
        for edge in bucket.chunk_by(|a, b| a.0 == b.0) {
            if let [(_, first), (_, second)] = *edge {
                neighbours[(first / 3) as usize][(first % 3) as usize] = second / 3;
                neighbours[(second / 3) as usize][(second % 3) as usize] = first / 3;
            }
        }
    }
    neighbours
}

/// Per vertex, the faces around it, in ascending order.
pub fn vertex_faces(mesh: &Mesh) -> Incidence {
    let mut incidence = Incidence::of(mesh.positions.len(), mesh.faces.iter().flatten().copied());
    incidence.items.iter_mut().for_each(|corner| *corner /= 3);
    incidence
}

/// A list of items per vertex, in two flat arrays.
#[derive(Debug, Clone)]
pub struct Incidence {
    /// Items of vertex `v` are `items[start[v]..start[v + 1]]`.
    start: Vec<u32>,
    items: Vec<u32>,
}

impl Incidence {
    /// Groups the places `0, 1, 2, …` of `keys` by key, by counting.
    fn of(vertices: usize, keys: impl Iterator<Item = u32> + Clone) -> Self {
        let mut start = vec![0u32; vertices + 1];
        for key in keys.clone() {
            start[key as usize + 1] += 1;
        }
        for v in 0..vertices {
            start[v + 1] += start[v];
        }
        let mut items = vec![0u32; start[vertices] as usize];
        let mut next = start.clone();
        for (place, key) in keys.enumerate() {
            let slot = &mut next[key as usize];
            items[*slot as usize] = place as u32;
            *slot += 1;
        }
        Self { start, items }
    }

    /// The items of vertex `v`.
    pub fn of_vertex(&self, v: usize) -> &[u32] {
        &self.items[self.start[v] as usize..self.start[v + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn mesh(vertices: usize, faces: &[[u32; 3]]) -> Mesh {
        Mesh { positions: vec![DVec3::ZERO; vertices], faces: faces.to_vec(), ..Mesh::default() }
    }

    #[test]
    fn two_triangles_meet_at_their_shared_edge() {
        let neighbours = face_neighbours(&mesh(4, &[[0, 1, 2], [2, 1, 3]]));
        assert_eq!(neighbours, [[NONE, 1, NONE], [0, NONE, NONE]]);
    }

    #[test]
    fn disagreeing_orientations_are_still_neighbours() {
        let neighbours = face_neighbours(&mesh(4, &[[0, 1, 2], [1, 2, 3]]));
        assert_eq!(neighbours, [[NONE, 1, NONE], [0, NONE, NONE]]);
    }

    #[test]
    fn an_edge_of_three_faces_has_no_neighbours() {
        let neighbours = face_neighbours(&mesh(5, &[[0, 1, 2], [1, 0, 3], [0, 1, 4]]));
        assert!(neighbours.iter().all(|n| n[0] == NONE));
    }

    #[test]
    fn a_tetrahedron_is_closed_and_symmetric() {
        let neighbours = face_neighbours(&mesh(4, &[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]));
        for (f, of) in neighbours.iter().enumerate() {
            for &g in of {
                assert!(neighbours[g as usize].contains(&(f as u32)));
            }
        }
    }

    #[test]
    fn faces_around_a_vertex_come_in_order() {
        let around = vertex_faces(&mesh(4, &[[0, 1, 2], [2, 1, 3]]));
        assert_eq!(around.of_vertex(1), [0, 1]);
        assert_eq!(around.of_vertex(3), [1]);
    }
}
