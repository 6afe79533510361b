//! The points of the source that the surface must stay near.

use std::collections::HashMap;

use glam::DVec3;

use super::block::Sample;
use super::{MOST_CLASSES, NONE};
use crate::classes::Classes;
use crate::ids::ClassId;
use crate::mesh::Mesh;

/// The tracked samples: one for each source vertex, and one more for each further leaf that has it on its wall, so that
/// every leaf's part of the surface is held down by samples of its own.
#[derive(Default)]
pub struct Samples {
    /// The source vertex it is at.
    pub vertex: Vec<u32>,
    /// Current face each rides on (index into `Collapser::faces`), `NONE` for a vertex no face uses.
    pub face: Vec<u32>,
    pub budget_m: Vec<f32>,
    pub omega: Vec<f32>,
    /// A third of the area of the faces around it, m².
    pub area_m2: Vec<f32>,
    /// Squared distance to the surface, m².
    pub squared_m2: Vec<f32>,
    pub class: Vec<ClassId>,
    /// See [`Sample::classes`].
    pub classes: Vec<u8>,
}

impl Samples {
    /// A sample takes the strictest budget of the faces around its vertex, so that an edge between ground and wall is
    /// kept as well as the wall, and the class and weight of the largest of them in its leaf.
    pub fn of(mesh: &Mesh, leaf_of_face: &[u32], classes: &Classes, omega: &[f32], budgets: &[f64]) -> Self {
        let count = mesh.positions.len();
        let mut samples = Self {
            vertex: (0..count as u32).collect(),
            face: vec![NONE; count],
            budget_m: vec![f32::INFINITY; count],
            omega: vec![0.0; count],
            area_m2: vec![0.0; count],
            squared_m2: vec![0.0; count],
            class: vec![ClassId(0); count],
            classes: vec![0; count],
        };
        let mut strictest = vec![f32::INFINITY; count];
        let mut around = vec![0u8; count];
        let mut largest = vec![-1f32; count];
        // Sample of a vertex in a leaf other than that of its first face.
        let mut further: HashMap<(u32, u32), u32> = HashMap::new();
        for (f, face) in mesh.faces.iter().enumerate() {
            let area = mesh.cross(f).length() as f32;
            let bit = 1 << classes.label[f].index().min(MOST_CLASSES - 1);
            for &v in face {
                around[v as usize] |= bit;
                strictest[v as usize] = strictest[v as usize].min(budgets[classes.label[f].index()] as f32);
                let first = samples.face[v as usize];
                let own = first == NONE || leaf_of_face[first as usize] == leaf_of_face[f];
                let s = if own { v } else { *further.entry((v, leaf_of_face[f])).or_insert_with(|| samples.push(v)) }
                    as usize;
                largest.resize(samples.vertex.len(), -1.0);
                samples.area_m2[s] += area / 6.0;
                if area > largest[s] {
                    largest[s] = area;
                    samples.face[s] = f as u32;
                    samples.omega[s] = omega[f];
                    samples.class[s] = classes.label[f];
                }
            }
        }
        for (budget, &v) in samples.budget_m.iter_mut().zip(&samples.vertex) {
            *budget = strictest[v as usize];
        }
        for (own, &v) in samples.classes.iter_mut().zip(&samples.vertex) {
            *own = around[v as usize];
        }
        samples
    }

    /// Sample `s` as a block has it, riding on the block's face `face`.
    pub fn placed(&self, s: u32, face: u32, source: &Mesh, origin: DVec3) -> Sample {
        let s = s as usize;
        Sample {
            point: source.positions[self.vertex[s] as usize] - origin,
            weight: self.area_m2[s] * self.omega[s],
            budget_m: self.budget_m[s],
            squared_m2: self.squared_m2[s],
            face,
            classes: self.classes[s],
        }
    }

    fn push(&mut self, vertex: u32) -> u32 {
        self.vertex.push(vertex);
        self.face.push(NONE);
        self.budget_m.push(f32::INFINITY);
        self.omega.push(0.0);
        self.area_m2.push(0.0);
        self.squared_m2.push(0.0);
        self.class.push(ClassId(0));
        self.classes.push(0);
        self.vertex.len() as u32 - 1
    }
}
