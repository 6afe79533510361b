//! A triangle soup as it is measured: welded, centred, with a tree for closest-point queries.

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;

use crate::geo::Aabb;
use crate::geo::bvh::{Bvh, Hit, closest_on_triangle};
use crate::ids::ClassId;

/// Triangles to be compared. Only positions count: textures and colours are not looked at.
#[derive(Debug, Clone, Default)]
pub struct Surface {
    /// Metres, any origin and axes shared by all surfaces that are compared.
    pub positions: Vec<DVec3>,
    /// Indices into `positions`; faces with an index out of range or a corner that is not finite are left out.
    pub faces: Vec<[u32; 3]>,
    /// Per face. Looked at on the reference only. Up to [`Surface::MOST_CLASSES`] of them; higher ids count as the last.
    pub class: Option<Vec<ClassId>>,
}

impl Surface {
    /// Classes are kept as bits of a word.
    pub const MOST_CLASSES: usize = 32;
}

/// Queries of a chunk begin at the face that the last one found, so chunks are long; all results are in chunk order.
const POINTS_PER_CHUNK: usize = 4096;

/// A [`Surface`] made ready. Vertices are joined where they are equal to the last bit, as all judges of meshes do.
pub(super) struct Prepared {
    /// Metres about the reference's centre; every one is used by a face.
    pub points: Vec<DVec3>,
    /// Into `points`. Faces without area are kept: they are part of the surface too.
    pub faces: Vec<[u32; 3]>,
    /// Per face, below 32; empty if there are no classes.
    pub class: Vec<u8>,
    /// Faces of the surface that were left out for an index out of range or a corner that is not finite.
    pub left_out: usize,
    bvh: Bvh,
}

/// Where a point's nearest neighbour on a surface lies.
#[derive(Debug, Clone, Copy)]
pub(super) struct Near {
    /// Metres.
    pub distance: f64,
    /// Face of the surface asked.
    pub face: u32,
}

impl Prepared {
    pub fn new(surface: &Surface, center: DVec3) -> Self {
        let mut ids: HashMap<[u64; 3], u32> = HashMap::with_capacity(surface.positions.len());
        let mut points = Vec::new();
        let mut new_id = vec![u32::MAX; surface.positions.len()];
        let mut faces = Vec::with_capacity(surface.faces.len());
        let mut class = Vec::new();
        for (f, face) in surface.faces.iter().enumerate() {
            let usable = |v: &u32| surface.positions.get(*v as usize).is_some_and(|p| p.is_finite());
            if !face.iter().all(usable) {
                continue;
            }
            faces.push(face.map(|v| {
                let id = &mut new_id[v as usize];
                if *id == u32::MAX {
                    let p = surface.positions[v as usize];
                    // Plus zero: -0 and 0 are one place.
                    *id = *ids.entry((p + 0.0).to_array().map(f64::to_bits)).or_insert_with(|| {
                        points.push(p - center);
                        points.len() as u32 - 1
                    });
                }
                *id
            }));
            if let Some(all) = &surface.class {
                let id = all.get(f).map_or(0, |c| c.index());
                class.push(id.min(Surface::MOST_CLASSES - 1) as u8);
            }
        }
        let left_out = surface.faces.len() - faces.len();
        let bvh = Bvh::new(&points, &faces);
        Self { points, faces, class, left_out, bvh }
    }

    pub fn corners(&self, f: u32) -> [DVec3; 3] {
        self.faces[f as usize].map(|v| self.points[v as usize])
    }

    /// Its length is twice the area, its direction the normal.
    pub fn cross(&self, f: u32) -> DVec3 {
        let [a, b, c] = self.corners(f);
        (b - a).cross(c - a)
    }

    /// Unit length, or zero for a face without area.
    pub fn normal(&self, f: u32) -> DVec3 {
        self.cross(f).normalize_or_zero()
    }

    pub fn area(&self, f: u32) -> f64 {
        0.5 * self.cross(f).length()
    }

    /// The face's class, 0 without classes.
    pub fn class_of(&self, f: u32) -> u8 {
        self.class.get(f as usize).copied().unwrap_or(0)
    }

    pub fn distance_to_face(&self, p: DVec3, f: u32) -> f64 {
        (closest_on_triangle(p, &self.corners(f)) - p).length()
    }

    /// The point of face `f` that is nearest to `p`; `None` if that cannot be said.
    pub fn hit(&self, p: DVec3, f: u32) -> Option<Hit> {
        let point = closest_on_triangle(p, &self.corners(f));
        let distance = (point - p).length();
        distance.is_finite().then_some(Hit { face: f, point, distance })
    }

    /// The nearest point; `start` is a face thought near. `None` only without faces.
    pub fn nearest(&self, p: DVec3, start: u32) -> Option<Hit> {
        if self.faces.is_empty() {
            return None;
        }
        self.bvh.closest_from(p, start, &self.corners(start))
    }

    /// [`Prepared::nearest`] of many points, in parallel. The surface must have faces.
    pub fn nearest_of(&self, points: &[DVec3]) -> Vec<Near> {
        let chunk = |points: &[DVec3]| {
            let mut start = None;
            let near = |p: &DVec3| {
                let hit = match start {
                    Some(face) => self.nearest(*p, face),
                    None => self.bvh.closest(*p, f64::INFINITY),
                };
                start = hit.map(|h| h.face).or(start);
                hit.map_or(Near { distance: f64::INFINITY, face: 0 }, |h| Near { distance: h.distance, face: h.face })
            };
            points.iter().map(near).collect::<Vec<_>>()
        };
        points.par_chunks(POINTS_PER_CHUNK).flat_map_iter(chunk).collect()
    }

    /// The class of the face nearest to each point. The surface must have faces.
    pub fn nearest_classes(&self, points: &[DVec3]) -> Vec<u8> {
        self.nearest_of(points).iter().map(|near| self.class_of(near.face)).collect()
    }

    /// The middle of each face.
    pub fn middles(&self) -> Vec<DVec3> {
        (0..self.faces.len() as u32).map(|f| self.corners(f).iter().sum::<DVec3>() / 3.0).collect()
    }

    /// Triangles that are measured from and not to: they have no tree.
    pub fn without_tree(triangles: &[[DVec3; 3]]) -> Self {
        let mut ids: HashMap<[u64; 3], u32> = HashMap::with_capacity(triangles.len());
        let mut points = Vec::new();
        let mut id = |p: DVec3| {
            *ids.entry((p + 0.0).to_array().map(f64::to_bits)).or_insert_with(|| {
                points.push(p);
                points.len() as u32 - 1
            })
        };
        let faces = triangles.iter().map(|corners| corners.map(&mut id)).collect();
        Self { points, faces, class: Vec::new(), left_out: 0, bvh: Bvh::new(&[], &[]) }
    }

    /// Node masks of the classes; see [`Bvh::masks`].
    pub fn class_masks(&self) -> Vec<u32> {
        self.bvh.masks(|f| 1 << self.class_of(f))
    }

    /// Classes among `wanted` that have a face within `radius` of `p`.
    pub fn classes_within(&self, masks: &[u32], p: DVec3, radius: f64, wanted: u32) -> u32 {
        self.bvh.mask_within(masks, |f| 1 << self.class_of(f), p, radius, wanted)
    }

    pub fn aabb(&self) -> Aabb {
        Aabb::of(self.points.iter().copied())
    }
}
