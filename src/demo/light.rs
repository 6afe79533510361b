//! The sun and sky baked into the textures, as in photographs: cast shadows, ambient occlusion, shading by normal.

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::field::Field;
use super::surface::Surface;

/// Towards the sun; a summer afternoon.
const SUN: DVec3 = DVec3::new(-0.42, -0.58, 0.70);
/// Cell of the shadow map, metres.
const CELL_M: f64 = 0.18;
/// How far a surface is moved to the sun before it is tested, metres: more than the mesh's noise.
const BIAS_M: f64 = 0.30;

/// What the sun sees, and how open every vertex is to the sky.
pub(super) struct Light {
    right: DVec3,
    up: DVec3,
    sun: DVec3,
    low: DVec2,
    size: [usize; 2],
    /// Largest coordinate towards the sun, per cell.
    depth: Vec<f32>,
    /// Per vertex, 0 (buried) to 1 (open).
    pub(super) openness: Vec<f32>,
}

impl Light {
    /// Renders the shadow map and measures openness along `normals`.
    pub(super) fn new(field: &Field, surface: &Surface, normals: &[DVec3]) -> Self {
        let sun = SUN.normalize();
        let right = sun.cross(DVec3::Z).normalize();
        let up = right.cross(sun);
        let flat = |p: DVec3| DVec2::new(right.dot(p), up.dot(p));
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for &p in &surface.positions {
            (low, high) = (low.min(flat(p)), high.max(flat(p)));
        }
        let cells = |length: f64| (length / CELL_M).max(0.0) as usize + 2;
        let size = [cells(high.x - low.x), cells(high.y - low.y)];
        let openness = surface.positions.par_iter().zip(normals).map(|(&p, &n)| openness(field, p, n)).collect();
        let depth = vec![f32::NEG_INFINITY; size[0] * size[1]];
        let mut light = Self { right, up, sun, low, size, depth, openness };
        for face in &surface.faces {
            light.cover(face.map(|v| surface.positions[v as usize]));
        }
        light
    }

    fn cell(&self, p: DVec3) -> DVec2 {
        (DVec2::new(self.right.dot(p), self.up.dot(p)) - self.low) / CELL_M
    }

    /// Draws one triangle into the shadow map.
    fn cover(&mut self, corners: [DVec3; 3]) {
        let [a, b, c] = corners.map(|p| self.cell(p));
        let [da, db, dc] = corners.map(|p| self.sun.dot(p));
        let area = (b - a).perp_dot(c - a);
        if area.abs() < 1e-9 {
            return;
        }
        let (low, high) = (a.min(b).min(c).floor(), a.max(b).max(c).ceil());
        for y in low.y.max(0.0) as usize..=(high.y as usize).min(self.size[1] - 1) {
            for x in low.x.max(0.0) as usize..=(high.x as usize).min(self.size[0] - 1) {
                let q = DVec2::new(x as f64, y as f64);
                let (wb, wc) = ((q - a).perp_dot(c - a) / area, (b - a).perp_dot(q - a) / area);
                if wb >= 0.0 && wc >= 0.0 && wb + wc <= 1.0 {
                    let depth = (da + wb * (db - da) + wc * (dc - da)) as f32;
                    let cell = &mut self.depth[y * self.size[0] + x];
                    *cell = cell.max(depth);
                }
            }
        }
    }

    /// Share of the sun that reaches a point, 0 to 1, smooth over one cell.
    fn sunlit(&self, p: DVec3) -> f32 {
        let at = self.cell(p).max(DVec2::ZERO);
        let depth = self.sun.dot(p) as f32;
        let (x, y) = ((at.x as usize).min(self.size[0] - 2), (at.y as usize).min(self.size[1] - 2));
        let (tx, ty) = ((at.x - x as f64) as f32, (at.y - y as f64) as f32);
        let lit = |x: usize, y: usize| if self.depth[y * self.size[0] + x] > depth { 0.0 } else { 1.0 };
        let row = |y: usize| lit(x, y) * (1.0 - tx) + lit(x + 1, y) * tx;
        row(y) * (1.0 - ty) + row(y + 1) * ty
    }

    /// Factor on a colour at a surface point.
    pub(super) fn at(&self, p: DVec3, normal: DVec3, openness: f32) -> Vec3 {
        const SKY: Vec3 = Vec3::new(0.56, 0.59, 0.64);
        const DIRECT: Vec3 = Vec3::new(0.70, 0.65, 0.56);
        let facing = normal.dot(self.sun).max(0.0) as f32;
        let lit = if facing > 0.0 { self.sunlit(p + (normal + self.sun) * (0.5 * BIAS_M)) } else { 0.0 };
        SKY * (openness * (0.85 + 0.15 * normal.z as f32)) + DIRECT * (facing * lit)
    }
}

/// How little of the surroundings stands within 2.5 m in front of a surface.
fn openness(field: &Field, p: DVec3, normal: DVec3) -> f32 {
    let mut blocked = 0.0;
    for (reach, weight) in [(0.5, 0.30), (1.2, 0.30), (2.5, 0.30)] {
        blocked += weight * ((reach - field.distance(p + normal * reach)) / reach).clamp(0.0, 1.0);
    }
    (1.0 - blocked).max(0.4) as f32
}
