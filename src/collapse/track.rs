//! Samples of the source that ride on the current surface.

use super::NONE;
use super::run::{Corner, Run};
use crate::geo::bvh::closest_on_triangle;
use glam::DVec3;

/// What a collapse would do to the samples of its star.
pub(super) struct Moved {
    /// Largest deviation, as a share of that sample's limit.
    pub share: f32,
    /// Change of Σ weight · squared distance.
    pub change: f64,
}

impl Run<'_> {
    /// Finds the new face of every sample of the star, in the sample's own group; none if one would be further from its
    /// group's surface than its limit.
    pub(super) fn samples_allow(&mut self) -> Option<Moved> {
        let mut moved = std::mem::take(&mut self.moved);
        moved.clear();
        let (mut worst, mut change) = (0f64, 0.0);
        let allowed = self.star.iter().all(|corner| {
            let mut s = self.sample_head[corner.face as usize];
            while s != NONE {
                let sample = &self.block.samples[s as usize];
                let (face, squared) = nearest(&self.star, corner, sample.point);
                let limit = self.scale * f64::from(sample.budget_m);
                if squared > limit * limit {
                    return false;
                }
                worst = worst.max(squared / (limit * limit));
                change += f64::from(sample.weight) * (squared - f64::from(sample.squared_m2));
                moved.push((s, face, squared));
                s = self.sample_next[s as usize];
            }
            true
        });
        self.moved = moved;
        allowed.then_some(Moved { share: worst.sqrt() as f32, change })
    }

    /// Puts the samples onto the faces that `samples_allow` found.
    pub(super) fn move_samples(&mut self, star: &[Corner]) {
        if self.sample_head.is_empty() {
            return;
        }
        star.iter().for_each(|corner| self.sample_head[corner.face as usize] = NONE);
        for i in (0..self.moved.len()).rev() {
            let (s, face, squared) = self.moved[i];
            self.sample_next[s as usize] = self.sample_head[face as usize];
            self.sample_head[face as usize] = s;
            let sample = &mut self.block.samples[s as usize];
            (sample.face, sample.squared_m2) = (face, squared as f32);
        }
    }
}

/// The living face of `star` in the group of `own` that is nearest to `p`, `own` tried first, and the squared distance.
fn nearest(star: &[Corner], own: &Corner, p: DVec3) -> (u32, f64) {
    let mut best = (NONE, f64::INFINITY);
    let own_first = std::iter::once(own).chain(star.iter().filter(|c| c.face != own.face));
    for corner in own_first.filter(|c| !c.dies && c.group == own.group) {
        let off_plane = corner.facet.normal.as_dvec3().dot(p - corner.corners[0]);
        if off_plane * off_plane < best.1 {
            let squared = (closest_on_triangle(p, &corner.corners) - p).length_squared();
            if squared < best.1 {
                best = (corner.face, squared);
            }
        }
    }
    best
}
