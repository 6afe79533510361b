//! A quick hasher for maps whose keys are bits of coordinates or ids.
//!
//! The standard one withstands keys chosen by an enemy and costs several times as much. Whoever prepares an input so that
//! all its vertices collide makes his own build slow.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

/// A map with [`BitsHasher`]. Its order means nothing, as that of any other.
pub type BitsMap<K, V> = HashMap<K, V, BuildHasherDefault<BitsHasher>>;

/// Multiplies and folds, word by word.
#[derive(Debug, Clone, Copy, Default)]
pub struct BitsHasher(u64);

/// 2⁶⁴ over the golden ratio, odd.
const FACTOR: u64 = 0x9E37_79B9_7F4A_7C15;

impl Hasher for BitsHasher {
    fn write(&mut self, bytes: &[u8]) {
        let mut words = bytes.chunks_exact(8);
        for word in &mut words {
            self.write_u64(word.iter().rev().fold(0, |all, byte| all << 8 | u64::from(*byte)));
        }
        if !words.remainder().is_empty() {
            self.write_u64(words.remainder().iter().fold(1, |all, byte| all << 8 | u64::from(*byte)));
        }
    }

    fn write_u8(&mut self, word: u8) {
        self.write_u64(word.into());
    }

    fn write_u32(&mut self, word: u32) {
        self.write_u64(word.into());
    }

    fn write_u64(&mut self, word: u64) {
        // Both halves of the product: coordinates differ in their upper bits, ids in their lower ones.
        let product = u128::from(self.0 ^ word) * u128::from(FACTOR);
        self.0 = (product as u64) ^ ((product >> 64) as u64).rotate_left(32);
    }

    fn write_usize(&mut self, word: usize) {
        self.write_u64(word as u64);
    }

    fn finish(&self) -> u64 {
        // The map takes its place from the lower bits and a tag from the upper ones.
        (self.0 ^ self.0 >> 29).wrapping_mul(FACTOR).rotate_left(26)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::hash::{BuildHasher, BuildHasherDefault};

    use super::*;

    /// Places in a table of 2¹⁶, and tags, that 2¹⁶ keys take.
    fn spread<K: std::hash::Hash>(keys: impl Iterator<Item = K>) -> (usize, usize) {
        let hashes: Vec<u64> = keys.map(|k| BuildHasherDefault::<BitsHasher>::default().hash_one(k)).collect();
        let distinct = |of: fn(u64) -> u64| hashes.iter().map(|h| of(*h)).collect::<HashSet<_>>().len();
        (distinct(|h| h & 0xFFFF), distinct(|h| h >> 57))
    }

    #[test]
    fn places_on_a_grid_and_small_ids_spread_as_chance_would() {
        let at = |i: u32, j: u32| [f64::from(i) / 8.0, f64::from(j) / 8.0, 100.0].map(f64::to_bits);
        let (places, tags) = spread((0..256).flat_map(|i| (0..256).map(move |j| at(i, j))));
        // Chance fills 1 - 1/e of the places.
        assert!(places > 37_000 && tags == 128, "{places} {tags}");
        let (places, tags) = spread((0..1u32 << 16).map(|i| (i, [i * 3, 7], 2u8)));
        assert!(places > 37_000 && tags == 128, "{places} {tags}");
    }
}
