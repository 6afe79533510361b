//! An adaptive binary range coder, and models of numbers made of its bits.
//!
//! Encoder and decoder share one trait: a function written once against [`Coder`] describes both directions, so they
//! cannot drift apart. Encoding passes values through; decoding ignores the values passed in and returns those read.
//!
//! # Method      the carry-less byte-wise range coder of LZMA; a probability is the mean of a fast and a slow average, that
//! begin as plain means
//! # Promises    deterministic; a decoder never panics, and reading past the end is noticed, see [`Decoder::overrun`]
//! # References  Martin, Range encoding, 1979; Pavlov's LZMA specification; Mahoney on mixing two rates

/// Probability that a bit is 0, in 1/65536: the mean of all bits so far, then of late ones, at two speeds.
#[derive(Debug, Clone, Copy)]
pub struct Prob {
    fast: u16,
    slow: u16,
    /// Bits so far, as far as it matters.
    seen: u16,
}

impl Default for Prob {
    fn default() -> Self {
        Self { fast: 1 << 15, slow: 1 << 15, seen: 0 }
    }
}

/// Bits that the two averages reach back at most: the fast one follows changes of scale, the slow one settles.
const FAST: u16 = 30;
const SLOW: u16 = 254;
/// 2^15 / (n + 2).
const SHARES: [i32; SLOW as usize + 1] = {
    let mut shares = [0; SLOW as usize + 1];
    let mut n = 0;
    while n < shares.len() {
        shares[n] = (1 << 15) / (n as i32 + 2);
        n += 1;
    }
    shares
};
/// Probabilities stay this far from 0 and 1, in 1/65536: no bit may become impossible.
const LEAST: u32 = 32;

impl Prob {
    fn of_zero(self) -> u32 {
        ((u32::from(self.fast) + u32::from(self.slow)) >> 1).clamp(LEAST, 65_536 - LEAST)
    }

    fn learn(&mut self, bit: bool) {
        // Both are made: no branch would be foreseen.
        let to = if bit { 0 } else { i32::from(u16::MAX) };
        let next = |p: u16, n: u16| {
            let p = i32::from(p);
            // Of one before all others a half: never beyond either end.
            (p + (((to - p) * SHARES[usize::from(n)] + (1 << 14)) >> 15)) as u16
        };
        (self.fast, self.slow) = (next(self.fast, self.seen.min(FAST)), next(self.slow, self.seen));
        self.seen = (self.seen + 1).min(SLOW);
    }
}

/// Both directions of coding.
pub trait Coder {
    /// A bit under an adaptive probability.
    fn bit(&mut self, prob: &mut Prob, bit: bool) -> bool;

    /// A number below `n`, all equally likely. `n` is 1 to 65536.
    fn small(&mut self, n: u32, value: u32) -> u32;

    /// A number below `n`, all (nearly) equally likely; `n` > 0.
    fn uniform(&mut self, n: u32, value: u32) -> u32 {
        let low_bits = (32 - (n - 1).leading_zeros()).saturating_sub(16);
        let high = self.small(((n - 1) >> low_bits) + 1, value >> low_bits);
        let low = self.raw(low_bits, u64::from(value)) as u32;
        // Only a decoder of nonsense gets past the end.
        ((high << low_bits) | low).min(n - 1)
    }

    /// The lowest `bits` bits of a number, without a model.
    fn raw(&mut self, bits: u32, value: u64) -> u64 {
        let mut out = 0;
        let mut left = bits;
        while left > 0 {
            let step = left.min(16);
            left -= step;
            let part = self.small(1 << step, ((value >> left) & ((1 << step) - 1)) as u32);
            out = (out << step) | u64::from(part);
        }
        out
    }
}

/// Turns symbols into bytes.
pub struct Encoder {
    low: u64,
    range: u32,
    cache: u8,
    /// Bytes held back because a carry may still change them, the cache among them.
    held: u64,
    bytes: Vec<u8>,
}

/// Below this the range is widened by a byte.
const TOP: u32 = 1 << 24;

impl Encoder {
    /// Starts empty.
    pub fn new() -> Self {
        Self { low: 0, range: u32::MAX, cache: 0, held: 1, bytes: Vec::new() }
    }

    /// The bytes written.
    pub fn finish(mut self) -> Vec<u8> {
        for _ in 0..5 {
            self.shift_low();
        }
        self.bytes
    }

    fn shift_low(&mut self) {
        if self.low < 0xFF00_0000 || self.low > 0xFFFF_FFFF {
            let carry = (self.low >> 32) as u8;
            self.bytes.push(self.cache.wrapping_add(carry));
            for _ in 1..self.held {
                self.bytes.push(0xFFu8.wrapping_add(carry));
            }
            self.held = 0;
            self.cache = (self.low >> 24) as u8;
        }
        self.held += 1;
        self.low = (self.low & 0x00FF_FFFF) << 8;
    }

    fn normalize(&mut self) {
        while self.range < TOP {
            self.range <<= 8;
            self.shift_low();
        }
    }
}

impl Coder for Encoder {
    fn bit(&mut self, prob: &mut Prob, bit: bool) -> bool {
        let bound = (self.range >> 16) * prob.of_zero();
        if bit {
            self.low += u64::from(bound);
            self.range -= bound;
        } else {
            self.range = bound;
        }
        prob.learn(bit);
        self.normalize();
        bit
    }

    fn small(&mut self, n: u32, value: u32) -> u32 {
        self.range /= n;
        self.low += u64::from(value) * u64::from(self.range);
        self.normalize();
        value
    }
}

/// Turns bytes into symbols.
pub struct Decoder<'a> {
    bytes: &'a [u8],
    at: usize,
    range: u32,
    code: u32,
}

impl<'a> Decoder<'a> {
    /// Starts at the first byte.
    pub fn new(bytes: &'a [u8]) -> Self {
        let mut decoder = Self { bytes, at: 0, range: u32::MAX, code: 0 };
        for _ in 0..5 {
            decoder.take();
        }
        decoder
    }

    /// True once bytes were wanted that are not there.
    pub fn overrun(&self) -> bool {
        self.at > self.bytes.len()
    }

    fn take(&mut self) {
        let byte = self.bytes.get(self.at).copied().unwrap_or(0);
        self.at += 1;
        self.code = (self.code << 8) | u32::from(byte);
    }

    fn normalize(&mut self) {
        while self.range < TOP {
            self.range <<= 8;
            self.take();
        }
    }
}

impl Coder for Decoder<'_> {
    fn bit(&mut self, prob: &mut Prob, _: bool) -> bool {
        let bound = (self.range >> 16) * prob.of_zero();
        let bit = self.code >= bound;
        if bit {
            self.code -= bound;
            self.range -= bound;
        } else {
            self.range = bound;
        }
        prob.learn(bit);
        self.normalize();
        bit
    }

    fn small(&mut self, n: u32, _: u32) -> u32 {
        self.range /= n;
        let value = (self.code / self.range).min(n - 1);
        self.code -= value * self.range;
        self.normalize();
        value
    }
}

/// A number below `LEAVES`, a power of two: every bit under the bits above it.
#[derive(Debug, Clone, Copy)]
pub struct Tree<const LEAVES: usize> {
    probs: [Prob; LEAVES],
}

impl<const LEAVES: usize> Default for Tree<LEAVES> {
    fn default() -> Self {
        Self { probs: [Prob::default(); LEAVES] }
    }
}

impl<const LEAVES: usize> Tree<LEAVES> {
    /// Codes `value`, which is below `LEAVES`.
    pub fn code(&mut self, coder: &mut impl Coder, value: u32) -> u32 {
        let mut node = 1usize;
        for k in (0..LEAVES.trailing_zeros()).rev() {
            let bit = coder.bit(&mut self.probs[node & (LEAVES - 1)], (value >> k) & 1 == 1);
            node = (node << 1) | usize::from(bit);
        }
        (node - LEAVES) as u32
    }
}

/// A whole number of either sign: its length in bits, its sign, its leading bits under models, the rest as they are.
#[derive(Debug, Clone)]
pub struct Number {
    is_long: Prob,
    short: Tree<16>,
    long: Tree<64>,
    sign: [Prob; 4],
    lead: [Tree<{ 1 << LEAD_BITS }>; MOST_BITS as usize + 1],
}

impl Default for Number {
    fn default() -> Self {
        Self {
            is_long: Prob::default(),
            short: Tree::default(),
            long: Tree::default(),
            sign: Default::default(),
            lead: [Tree::default(); MOST_BITS as usize + 1],
        }
    }
}

/// Longest number in bits: room for differences of positions within 2^52 steps.
const MOST_BITS: u32 = 54;
/// Shorter numbers than this have a tree of their own for their length.
const LONG_BITS: u32 = 16;
/// Bits below the leading one that have models.
const LEAD_BITS: u32 = 2;

impl Number {
    /// Codes `value`, of at most 54 bits. `sign_hint` (0 to 3) chooses the model of the sign.
    pub fn code(&mut self, coder: &mut impl Coder, value: i64, sign_hint: usize) -> i64 {
        let size = value.unsigned_abs();
        let length = 64 - size.leading_zeros();
        let length = if coder.bit(&mut self.is_long, length >= LONG_BITS) {
            self.long.code(coder, length).min(MOST_BITS)
        } else {
            self.short.code(coder, length)
        };
        if length == 0 {
            return 0;
        }
        let negative = coder.bit(&mut self.sign[sign_hint & 3], value < 0);
        let rest = length - 1;
        let led = rest.min(LEAD_BITS);
        let lead = &mut self.lead[length as usize].probs;
        let mut top = 1usize;
        for k in 0..led {
            let bit = coder.bit(&mut lead[top & ((1 << LEAD_BITS) - 1)], (size >> (rest - 1 - k)) & 1 == 1);
            top = (top << 1) | usize::from(bit);
        }
        let low = coder.raw(rest - led, size);
        let size = (((top as u64) << (rest - led)) | low) as i64;
        if negative { -size } else { size }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers() -> Vec<i64> {
        let mut all = vec![0, 1, -1, (1 << 53) - 1, -(1 << 53)];
        let mut x = 1u64;
        for k in 0..4000u32 {
            x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            all.push((x as i64) >> (12 + k % 50));
        }
        all
    }

    #[test]
    fn what_goes_in_comes_out() {
        let numbers = numbers();
        let mut encoder = Encoder::new();
        let mut model = Number::default();
        let mut prob = Prob::default();
        for &x in &numbers {
            model.code(&mut encoder, x, 0);
            encoder.bit(&mut prob, x % 3 == 0);
            encoder.uniform(1_000_003, (x.unsigned_abs() % 1_000_003) as u32);
        }
        let bytes = encoder.finish();
        let mut decoder = Decoder::new(&bytes);
        let (mut model, mut prob) = (Number::default(), Prob::default());
        for &x in &numbers {
            assert_eq!(model.code(&mut decoder, 0, 0), x);
            assert_eq!(decoder.bit(&mut prob, false), x % 3 == 0);
            assert_eq!(u64::from(decoder.uniform(1_000_003, 0)), x.unsigned_abs() % 1_000_003);
        }
        assert!(!decoder.overrun());
    }

    #[test]
    fn rare_bits_cost_little() {
        let mut encoder = Encoder::new();
        let mut prob = Prob::default();
        for k in 0..10_000 {
            encoder.bit(&mut prob, k % 1000 == 999);
        }
        let bytes = encoder.finish().len();
        assert!(bytes < 60, "{bytes} bytes for 10 rare bits among 10 000");
    }

    #[test]
    fn a_decoder_of_nonsense_ends() {
        for byte in 0..=255u8 {
            let bytes = [byte; 16];
            let mut decoder = Decoder::new(&bytes);
            let mut model = Number::default();
            for _ in 0..10_000 {
                assert!(model.code(&mut decoder, 0, 0).unsigned_abs() < 1 << MOST_BITS);
                assert!(decoder.uniform(77_777, 0) < 77_777);
            }
            assert!(decoder.overrun());
        }
    }
}
