//! Distances from points spread over one surface to another, summed up.

use rayon::prelude::*;
use serde::Serialize;

use super::sample::Sampler;
use super::signed::{Normals, Sides};
use super::surface::{Near, Prepared, Surface};

/// A set of distances in numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// How many distances.
    pub samples: usize,
    /// Mean.
    pub mean_m: f64,
    /// Root of the mean square.
    pub rms_m: f64,
    /// Half are below.
    pub p50_m: f64,
    /// 95 % are below.
    pub p95_m: f64,
    /// 99 % are below.
    pub p99_m: f64,
    /// The largest one seen; the surface's own maximum is in [`Interval`](super::Interval).
    pub seen_max_m: f64,
    /// Mean by the reference's box diagonal.
    pub mean_rel: f64,
    /// Root of the mean square by the reference's box diagonal.
    pub rms_rel: f64,
    /// 95th percentile by the reference's box diagonal.
    pub p95_rel: f64,
    /// 99th percentile by the reference's box diagonal.
    pub p99_rel: f64,
}

/// Distances with the class each counts for.
#[derive(Debug, Default)]
pub(super) struct Series {
    pub distance: Vec<f64>,
    pub class: Vec<u8>,
}

impl Series {
    /// Adds another's distances.
    pub fn extend(&mut self, other: Self) {
        self.distance.extend(other.distance);
        self.class.extend(other.class);
    }

    /// The largest distance of each class, and of `known`.
    pub fn largest(&self, mut known: [Option<f64>; Surface::MOST_CLASSES]) -> [Option<f64>; Surface::MOST_CLASSES] {
        for (distance, class) in self.distance.iter().zip(&self.class) {
            let known = &mut known[usize::from(*class)];
            *known = Some(known.map_or(*distance, |k: f64| k.max(*distance)));
        }
        known
    }

    /// The distances of `class`, or all, in ascending order.
    pub fn sorted(&self, class: Option<u8>) -> Vec<f64> {
        let pairs = self.distance.iter().zip(&self.class);
        let mut found: Vec<f64> = pairs.filter(|(_, c)| class.is_none_or(|k| k == **c)).map(|(d, _)| *d).collect();
        found.par_sort_unstable_by(f64::total_cmp);
        found
    }
}

/// Sums up distances in ascending order; `None` if there are none.
pub(super) fn summary(sorted: &[f64], diagonal_m: f64) -> Option<Summary> {
    let largest = *sorted.last()?;
    let count = sorted.len() as f64;
    let mean = sorted.iter().sum::<f64>() / count;
    let rms = (sorted.iter().map(|d| d * d).sum::<f64>() / count).sqrt();
    let [p50, p95, p99] = [0.50, 0.95, 0.99].map(|q| percentile(sorted, q));
    Some(of([mean, rms, p50, p95, p99, largest], sorted.len(), diagonal_m))
}

/// Sums up both directions as one, each of equal weight, however many distances it has.
pub(super) fn two_sided(one: &[f64], other: &[f64], diagonal_m: f64) -> Option<Summary> {
    let (a, b) = (summary(one, diagonal_m)?, summary(other, diagonal_m)?);
    let mean = 0.5 * (a.mean_m + b.mean_m);
    let rms = (0.5 * (a.rms_m * a.rms_m + b.rms_m * b.rms_m)).sqrt();
    let [p50, p95, p99] = [0.50, 0.95, 0.99].map(|q| weighted_percentile(one, other, q));
    let largest = a.seen_max_m.max(b.seen_max_m);
    Some(of([mean, rms, p50, p95, p99, largest], one.len() + other.len(), diagonal_m))
}

fn of([mean_m, rms_m, p50_m, p95_m, p99_m, seen_max_m]: [f64; 6], samples: usize, diagonal_m: f64) -> Summary {
    let [mean_rel, rms_rel, p95_rel, p99_rel] = [mean_m, rms_m, p95_m, p99_m].map(|d| relative(d, diagonal_m));
    Summary { samples, mean_m, rms_m, p50_m, p95_m, p99_m, seen_max_m, mean_rel, rms_rel, p95_rel, p99_rel }
}

/// By the diagonal; 0 for a reference that is a single point.
pub(super) fn relative(distance_m: f64, diagonal_m: f64) -> f64 {
    if diagonal_m > 0.0 { distance_m / diagonal_m } else { 0.0 }
}

/// Between the two nearest ranks, linearly; as numpy does.
pub(super) fn percentile(sorted: &[f64], q: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return 0.0 };
    let rank = q * last as f64;
    let (low, part) = (rank.floor() as usize, rank.fract());
    let high = (low + 1).min(last);
    sorted[low.min(last)] * (1.0 - part) + sorted[high] * part
}

/// The least distance with a share `q` of both sets, equally weighted, at or below it.
fn weighted_percentile(one: &[f64], other: &[f64], q: f64) -> f64 {
    let (mut i, mut j, mut at) = (0, 0, 0.0f64);
    let share = |i: usize, j: usize| 0.5 * (i as f64 / one.len() as f64 + j as f64 / other.len() as f64);
    while share(i, j) < q && (i < one.len() || j < other.len()) {
        let from_one = j == other.len() || (i < one.len() && one[i] <= other[j]);
        at = if from_one { one[i] } else { other[j] };
        if from_one { i += 1 } else { j += 1 }
    }
    at
}

/// Whose class a distance counts for: always that of the reference, which is on either end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Labels {
    /// The point's own face.
    AtPoint,
    /// The face that is nearest to it.
    AtNearest,
}

/// What the samples of one direction say.
#[derive(Default)]
pub(super) struct Pass {
    pub series: Series,
    /// Angle between the normals at a sample and at its nearest point, degrees.
    pub turn_deg: Vec<f32>,
    pub sides: Sides,
}

/// Measures from the sampler's points on `from` to `to`, which must have faces.
pub(super) fn measure(from: &Prepared, sampler: &Sampler, to: &Prepared, normals: &Normals, labels: Labels) -> Pass {
    let chunk = |chunk: usize| {
        let mut pass = Pass::default();
        let mut start = None;
        for sample in sampler.chunk(chunk) {
            let begin = start.unwrap_or_else(|| to.nearest_of(&[sample.point])[0].face);
            let Some(hit) = to.nearest(sample.point, begin) else { continue };
            start = Some(hit.face);
            let class = match labels {
                Labels::AtPoint => from.class_of(sample.face),
                Labels::AtNearest => to.class_of(hit.face),
            };
            pass.series.distance.push(hit.distance);
            pass.series.class.push(class);
            let cos = from.normal(sample.face).dot(to.normal(hit.face)).clamp(-1.0, 1.0);
            pass.turn_deg.push(cos.acos().to_degrees() as f32);
            pass.sides.see(class, sample.point, &hit, to, normals);
        }
        pass
    };
    let parts: Vec<Pass> = (0..sampler.chunks()).into_par_iter().map(chunk).collect();
    let mut all = Pass::default();
    parts.into_iter().for_each(|part| all.extend(part));
    all
}

impl Pass {
    /// Adds what another says.
    pub fn extend(&mut self, other: Self) {
        self.series.extend(other.series);
        self.turn_deg.extend(other.turn_deg);
        self.sides.merge(&other.sides);
    }
}

/// The distances of vertices, each counted for `class_of` it.
pub(super) fn vertex_series(near: &[Near], class_of: impl Fn(usize) -> u8) -> Series {
    Series { distance: near.iter().map(|n| n.distance).collect(), class: (0..near.len()).map(class_of).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_figures_of_one_to_hundred_and_one_are_known() {
        let sorted: Vec<f64> = (1..=101).map(f64::from).collect();
        let s = summary(&sorted, 10.0).unwrap();
        assert_eq!((s.mean_m, s.p50_m, s.p95_m, s.p99_m, s.seen_max_m), (51.0, 51.0, 96.0, 100.0, 101.0));
        assert!((s.rms_m - (101f64 * 102.0 * 203.0 / 6.0 / 101.0).sqrt()).abs() < 1e-12);
        assert!((s.mean_rel - 5.1).abs() < 1e-12);
        assert_eq!(summary(&[], 1.0), None);
    }

    #[test]
    fn both_directions_weigh_the_same_however_many_samples_they_have() {
        let (few, many) = (vec![3.0; 10], vec![1.0; 1000]);
        let s = two_sided(&few, &many, 1.0).unwrap();
        assert!((s.mean_m - 2.0).abs() < 1e-12 && (s.rms_m - 5f64.sqrt()).abs() < 1e-12);
        assert_eq!((s.p50_m, s.p95_m), (1.0, 3.0));
        assert_eq!(two_sided(&[], &many, 1.0), None);
    }
}
