//! Points spread evenly over a surface, the same ones every time.
//!
//! The surface's area is laid out on a line, face after face, and cut into equal strata; each holds one point at a
//! place drawn from a seeded counter. So any chunk of points can be made alone, in any order, by any thread.

use glam::DVec3;
use rayon::prelude::*;

use super::surface::Prepared;

/// Points of one work item.
pub(super) const SAMPLES_PER_CHUNK: usize = 4096;

/// A point on a surface.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub point: DVec3,
    pub face: u32,
}

/// The areas of a surface, summed up face by face.
pub(super) struct Sampler<'a> {
    surface: &'a Prepared,
    /// Area of the faces up to and including this one, m².
    cumulated: Vec<f64>,
    count: usize,
    seed: u64,
}

impl<'a> Sampler<'a> {
    /// Will give `count` points, or none if the surface has no area.
    pub fn new(surface: &'a Prepared, count: usize, seed: u64) -> Self {
        let faces = 0..surface.faces.len() as u32;
        let mut cumulated: Vec<f64> = faces.into_par_iter().map(|f| surface.area(f)).collect();
        let mut sum = 0.0;
        for area in &mut cumulated {
            sum += *area;
            *area = sum;
        }
        let count = if sum > 0.0 && sum.is_finite() { count } else { 0 };
        Self { surface, cumulated, count, seed }
    }

    pub fn chunks(&self) -> usize {
        self.count.div_ceil(SAMPLES_PER_CHUNK)
    }

    /// The points of chunk `chunk`, along the surface's faces.
    pub fn chunk(&self, chunk: usize) -> impl Iterator<Item = Sample> {
        let first = chunk * SAMPLES_PER_CHUNK;
        let total = self.cumulated.last().copied().unwrap_or(0.0);
        let step = total / self.count.max(1) as f64;
        let mut face = self.cumulated.partition_point(|&sum| sum <= first as f64 * step);
        (first..self.count.min(first + SAMPLES_PER_CHUNK)).map(move |i| {
            let [along, r, s] = [0, 1, 2].map(|k| self.unit(3 * i as u64 + k));
            let at = (i as f64 + along) * step;
            while face + 1 < self.cumulated.len() && self.cumulated[face] <= at {
                face += 1;
            }
            let [a, b, c] = self.surface.corners(face as u32);
            let r = r.sqrt();
            Sample { point: a * (1.0 - r) + b * (r * (1.0 - s)) + c * (r * s), face: face as u32 }
        })
    }

    /// The `i`th number of the sequence, 0 to 1 (SplitMix64, Steele, Lea, Flood 2014).
    fn unit(&self, i: u64) -> f64 {
        let mut z = (self.seed ^ 0x5851_F42D_4C95_7F2D)
            .wrapping_mul(0xD129_0B26_2D4E_65E3)
            .wrapping_add(i.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::Surface;

    fn two_triangles() -> Prepared {
        let at = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let positions = vec![at(0., 0.), at(1., 0.), at(0., 1.), at(10., 0.), at(13., 0.), at(10., 3.)];
        let faces = vec![[0, 1, 2], [0, 0, 1], [3, 4, 5]];
        Prepared::new(&Surface { positions, faces, class: None }, DVec3::ZERO)
    }

    #[test]
    fn faces_get_points_by_their_area_and_points_are_spread_over_each() {
        let surface = two_triangles();
        let sampler = Sampler::new(&surface, 10_000, 7);
        let all: Vec<Sample> = (0..sampler.chunks()).flat_map(|c| sampler.chunk(c)).collect();
        assert_eq!(all.len(), 10_000);
        let of = |f: u32| all.iter().filter(|s| s.face == f).count();
        assert_eq!((of(0), of(1), of(2)), (1000, 0, 9000));
        let mean = all.iter().filter(|s| s.face == 2).map(|s| s.point).sum::<DVec3>() / 9000.0;
        assert!((mean - DVec3::new(11.0, 1.0, 0.0)).length() < 0.03, "{mean}");
        assert!(all.iter().all(|s| surface.distance_to_face(s.point, s.face) < 1e-12));
    }

    #[test]
    fn another_seed_is_another_set_and_the_same_seed_the_same() {
        let surface = two_triangles();
        let points = |seed| Sampler::new(&surface, 50, seed).chunk(0).map(|s| s.point).collect::<Vec<_>>();
        assert_eq!(points(1), points(1));
        assert_ne!(points(1), points(2));
    }

    #[test]
    fn a_surface_without_area_gives_no_points() {
        let line = Surface { positions: vec![DVec3::ZERO, DVec3::X], faces: vec![[0, 1, 0]], class: None };
        for surface in [line, Surface::default()] {
            let prepared = Prepared::new(&surface, DVec3::ZERO);
            assert_eq!(Sampler::new(&prepared, 100, 1).chunks(), 0);
        }
    }
}
