//! Randomness that depends on nothing but a seed: a small generator and value noise on hashed lattices.

use glam::{DVec2, DVec3};

/// Scrambles 64 bits (the finaliser of splitmix64, Steele, Lea and Flood 2014).
pub(super) fn scramble(mut x: u64) -> u64 {
    x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// A stream of random numbers.
#[derive(Debug, Clone)]
pub(super) struct Rng(u64);

impl Rng {
    /// A stream of its own for every (seed, a, b), so that one block's content does not shift another's.
    pub(super) fn new(seed: u64, a: i64, b: i64) -> Self {
        Self(scramble(seed ^ scramble(a as u64 ^ scramble(b as u64))))
    }

    pub(super) fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        scramble(self.0)
    }

    /// Uniform in [0, 1).
    pub(super) fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in [low, high).
    pub(super) fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    pub(super) fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// Uniform in 0..n; 0 for n = 0.
    pub(super) fn below(&mut self, n: usize) -> usize {
        ((self.unit() * n as f64) as usize).min(n.saturating_sub(1))
    }
}

/// A lattice point's value in [-1, 1].
pub(super) fn lattice(x: i32, y: i32, z: i32, seed: u32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f)
        ^ seed.wrapping_mul(0x9e37_79b1);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 13)).wrapping_mul(0x297a_2d39);
    h ^= h >> 16;
    (h >> 8) as f32 * (2.0 / 16_777_215.0) - 1.0
}

fn ease(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

fn blend(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// Smooth noise in [-1, 1] of wavelength 1.
pub(super) fn value2(p: DVec2, seed: u32) -> f32 {
    let cell = p.floor();
    let (x, y) = (cell.x as i32, cell.y as i32);
    let t = (p - cell).as_vec2();
    let (tx, ty) = (ease(t.x), ease(t.y));
    blend(
        blend(lattice(x, y, 0, seed), lattice(x + 1, y, 0, seed), tx),
        blend(lattice(x, y + 1, 0, seed), lattice(x + 1, y + 1, 0, seed), tx),
        ty,
    )
}

/// Smooth noise in [-1, 1] of wavelength 1.
pub(super) fn value3(p: DVec3, seed: u32) -> f32 {
    let cell = p.floor();
    let (x, y, z) = (cell.x as i32, cell.y as i32, cell.z as i32);
    let t = (p - cell).as_vec3();
    let (tx, ty) = (ease(t.x), ease(t.y));
    let layer = |z| {
        blend(
            blend(lattice(x, y, z, seed), lattice(x + 1, y, z, seed), tx),
            blend(lattice(x, y + 1, z, seed), lattice(x + 1, y + 1, z, seed), tx),
            ty,
        )
    };
    blend(layer(z), layer(z + 1), ease(t.z))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_continuous_across_lattice_cells_and_stays_in_range() {
        for i in 0..200 {
            let p = DVec3::new(f64::from(i) * 0.37 - 20.0, 3.0, -5.5);
            let step = (value3(p, 1) - value3(p + DVec3::splat(1e-6), 1)).abs();
            assert!(step < 1e-3, "{step} at {p}");
            assert!(value3(p, 1).abs() <= 1.0 && value2(p.truncate(), 1).abs() <= 1.0);
        }
    }

    #[test]
    fn streams_of_different_blocks_differ_and_repeat() {
        let draw = |b| Rng::new(7, 1, b).bits();
        assert_eq!(draw(2), draw(2));
        assert_ne!(draw(2), draw(3));
    }
}
