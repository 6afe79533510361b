//! Samples of the source that ride on the current surface.

use super::NONE;
use super::block::Sample;
use super::run::{Corner, Run};
use crate::geo::bvh::closest_on_triangle;
use glam::DVec3;

/// A sample, and the one after it on the same face. As large as a [`Sample`], so that one becomes the other in place.
#[derive(Clone, Copy)]
pub(super) struct Rider {
    pub point: DVec3,
    pub weight: f32,
    pub budget_m: f32,
    pub squared_m2: f32,
    pub next: u32,
}

impl Rider {
    /// The samples as riders, and by face the first of them; of a face, the first in order comes first.
    pub fn all(mut samples: Vec<Sample>, faces: usize) -> (Vec<Self>, Vec<u32>) {
        let mut head = vec![NONE; faces];
        for (s, sample) in samples.iter_mut().enumerate().rev() {
            // From here on a face is the next sample.
            sample.face = std::mem::replace(&mut head[sample.face as usize], s as u32);
        }
        let rider = |Sample { point, weight, budget_m, squared_m2, face }| Self {
            point,
            weight,
            budget_m,
            squared_m2,
            next: face,
        };
        (samples.into_iter().map(rider).collect(), head)
    }

    /// The riders as samples again.
    pub fn samples(riders: Vec<Self>, head: &[u32]) -> Vec<Sample> {
        let sample = |Self { point, weight, budget_m, squared_m2, next }| Sample {
            point,
            weight,
            budget_m,
            squared_m2,
            face: next,
        };
        let mut samples: Vec<Sample> = riders.into_iter().map(sample).collect();
        for (&first, f) in head.iter().zip(0..) {
            let mut at = first;
            while at != NONE {
                at = std::mem::replace(&mut samples[at as usize].face, f);
            }
        }
        samples
    }
}

/// A sample that the collapse under test moves.
#[derive(Clone, Copy)]
pub(super) struct Move {
    /// Which.
    pub rider: u32,
    /// Index into the star of the face it was on; from then on the face it goes to.
    pub to: u32,
    /// To that face, m².
    pub squared_m2: f64,
}

impl Run<'_> {
    /// Finds the new face of every sample of the star, in the sample's own group, and the change of Σ weight · squared
    /// distance; none if one would be further from its group's surface than its limit.
    ///
    /// The first of every face is looked at, then the second, and so on, so that the waits for memory overlap; most
    /// collapses are refused before all samples have been read.
    pub(super) fn samples_allow(&mut self) -> Option<f64> {
        let mut moved = std::mem::take(&mut self.moved);
        moved.clear();
        let first = |(i, corner): (usize, &Corner)| {
            let rider = self.rider_head[corner.face as usize];
            (rider != NONE).then_some(Move { rider, to: i as u32, squared_m2: 0.0 })
        };
        moved.extend(self.star.iter().enumerate().filter_map(first));
        let mut change = 0.0;
        let mut allowed = true;
        let mut at = 0;
        while allowed && at < moved.len() {
            let round = at..moved.len();
            at = round.end;
            for i in round.clone() {
                let Move { rider, to, .. } = moved[i];
                let next = self.riders[rider as usize].next;
                if next != NONE {
                    moved.push(Move { rider: next, to, squared_m2: 0.0 });
                }
            }
            allowed = moved[round].iter_mut().all(|step| {
                let more = self.settle(step);
                change += more.unwrap_or(0.0);
                more.is_some()
            });
        }
        self.moved = moved;
        allowed.then_some(change)
    }

    /// Finds a sample's new face, and the change of its weight · squared distance; none beyond its limit.
    fn settle(&self, step: &mut Move) -> Option<f64> {
        let rider = &self.riders[step.rider as usize];
        let (face, squared) = nearest(&self.star, step.to as usize, rider.point);
        let limit = self.scale * f64::from(rider.budget_m);
        (step.to, step.squared_m2) = (face, squared);
        (squared <= limit * limit).then(|| f64::from(rider.weight) * (squared - f64::from(rider.squared_m2)))
    }

    /// Puts the samples onto the faces that `samples_allow` found.
    pub(super) fn move_samples(&mut self, star: &[Corner]) {
        if self.rider_head.is_empty() {
            return;
        }
        star.iter().for_each(|corner| self.rider_head[corner.face as usize] = NONE);
        for step in self.moved.iter().rev() {
            let head = &mut self.rider_head[step.to as usize];
            let rider = &mut self.riders[step.rider as usize];
            (rider.next, rider.squared_m2) = (*head, step.squared_m2 as f32);
            *head = step.rider;
        }
    }
}

/// The living face of `star` in the group of its face `own` that is nearest to `p`, that one tried first, and the
/// squared distance.
fn nearest(star: &[Corner], own: usize, p: DVec3) -> (u32, f64) {
    let mut best = (NONE, f64::INFINITY);
    let group = star[own].group;
    let own_first = std::iter::once(&star[own]).chain(&star[..own]).chain(&star[own + 1..]);
    for corner in own_first.filter(|c| !c.dies && c.group == group) {
        let off_plane = corner.facet.normal.as_dvec3().dot(p - corner.corners[0]);
        if off_plane * off_plane < best.1 && corner.around.squared_to(p) < best.1 {
            let squared = (closest_on_triangle(p, &corner.corners) - p).length_squared();
            if squared < best.1 {
                best = (corner.face, squared);
            }
        }
    }
    best
}
