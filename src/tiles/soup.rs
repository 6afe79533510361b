//! Triangles without shared vertices, as they gather in a cell before it is whole.
//!
//! A vertex is its position, so a soup becomes a mesh again by joining equal positions.

use glam::{DVec3, Vec2};

use crate::Result;
use crate::geo::hash::BitsMap;
use crate::mesh::Mesh;
use crate::store::{PageReader, PageWriter};

/// Triangles with all they carry; arrays that no face needs are empty.
#[derive(Debug, Clone, Default)]
pub struct Soup {
    corners: Vec<[DVec3; 3]>,
    materials: Vec<u32>,
    uvs: Vec<[Vec2; 3]>,
    colors: Vec<[[u8; 3]; 3]>,
    labels: Vec<i16>,
}

impl Soup {
    /// Number of triangles.
    pub fn len(&self) -> usize {
        self.corners.len()
    }

    /// True without triangles.
    pub fn is_empty(&self) -> bool {
        self.corners.is_empty()
    }

    /// Bytes it holds, about.
    pub fn bytes(&self) -> usize {
        self.len() * (size_of::<[DVec3; 3]>() + size_of::<[Vec2; 3]>() + 15)
    }

    /// Adds a part of face `f` of `mesh`; `shares` are the barycentric coordinates of its corners, none for all of it.
    pub fn push(&mut self, mesh: &Mesh, f: usize, corners: [DVec3; 3], shares: Option<[DVec3; 3]>) {
        self.corners.push(corners);
        self.materials.push(mesh.face_material[f]);
        if let Some(uvs) = mesh.corner_uvs.get(f) {
            let mix = |s: DVec3| {
                let [a, b, c] = uvs.map(|uv: Vec2| uv.as_dvec2());
                (a * s.x + b * s.y + c * s.z).as_vec2()
            };
            self.uvs.push(shares.map_or(*uvs, |shares| shares.map(mix)));
        }
        if !mesh.vertex_colors.is_empty() {
            let of = mesh.faces[f].map(|v| mesh.vertex_colors[v as usize]);
            let mix =
                |s: DVec3| [0, 1, 2].map(|i| (0..3).map(|k| f64::from(of[k][i]) * s[k]).sum::<f64>().round() as u8);
            self.colors.push(shares.map_or(of, |shares| shares.map(mix)));
        }
        if let Some(label) = mesh.face_labels.get(f) {
            self.labels.push(*label);
        }
    }

    /// Adds all of `other`, which carries the same.
    pub fn append(&mut self, mut other: Self) {
        self.corners.append(&mut other.corners);
        self.materials.append(&mut other.materials);
        self.uvs.append(&mut other.uvs);
        self.colors.append(&mut other.colors);
        self.labels.append(&mut other.labels);
    }

    /// The mesh with one vertex for each position, in the order of first use, and its faces in order. Faces whose
    /// corners are not three stay out.
    pub fn into_mesh(self) -> Mesh {
        self.into_mesh_by(|p| p)
    }

    /// The same, each position replaced first.
    pub fn into_mesh_by(self, place: impl Fn(DVec3) -> DVec3) -> Mesh {
        let mut mesh = Mesh::default();
        let mut ids: BitsMap<[u64; 3], u32> = BitsMap::with_capacity_and_hasher(self.len(), Default::default());
        for (f, corners) in self.corners.iter().enumerate() {
            let places = corners.map(&place);
            let [a, b, c] = places;
            if a == b || b == c || c == a {
                continue;
            }
            let face = [0, 1, 2].map(|k| {
                *ids.entry(bits(places[k])).or_insert_with(|| {
                    mesh.positions.push(places[k]);
                    if let Some(colors) = self.colors.get(f) {
                        mesh.vertex_colors.push(colors[k]);
                    }
                    mesh.positions.len() as u32 - 1
                })
            });
            mesh.faces.push(face);
            mesh.face_material.push(self.materials[f]);
            mesh.corner_uvs.extend(self.uvs.get(f));
            mesh.face_labels.extend(self.labels.get(f));
        }
        mesh
    }

    /// Writes it to a page.
    ///
    /// # Errors
    /// Those of the page.
    pub fn put(&self, page: &mut PageWriter) -> Result<()> {
        page.put(&self.corners)?;
        page.put(&self.materials)?;
        page.put(&self.uvs)?;
        page.put(&self.colors)?;
        page.put(&self.labels)
    }

    /// Reads it from a page.
    ///
    /// # Errors
    /// Those of the page.
    pub fn take(page: &mut PageReader) -> Result<Self> {
        Ok(Self {
            corners: page.take()?,
            materials: page.take()?,
            uvs: page.take()?,
            colors: page.take()?,
            labels: page.take()?,
        })
    }
}

/// A position as a key; there is one zero.
pub fn bits(p: DVec3) -> [u64; 3] {
    (p + 0.0).to_array().map(f64::to_bits)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_positions_become_one_vertex_and_flat_faces_go() {
        let [a, b, c, d] = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(1.0, 1.0, 0.0)];
        let mesh = Mesh {
            positions: vec![a, b, c, d, -a],
            faces: vec![[0, 1, 2], [1, 3, 2], [0, 1, 4]],
            face_material: vec![7, 8, 9],
            ..Mesh::default()
        };
        let mut soup = Soup::default();
        (0..3).for_each(|f| soup.push(&mesh, f, mesh.corners(f), None));
        let mesh = soup.into_mesh();
        mesh.check().unwrap();
        assert_eq!((mesh.positions.len(), mesh.faces), (4, vec![[0, 1, 2], [1, 3, 2]]));
        assert_eq!(mesh.face_material, [7, 8]);
    }
}
