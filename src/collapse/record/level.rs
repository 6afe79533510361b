//! Sizes on a logarithmic scale that rounds up, so that a bound stays a bound.

/// Steps to a factor of two: what is read back is at most 19 % more than what was written.
const STEPS: i32 = 4;
/// The finest level above 0 is 2^-20 m, a step of the finest grid.
const LEAST_EXPONENT: i32 = -20;
/// 2^(k/4).
const PARTS: [f64; 4] = [1.0, 1.189_207_115_002_721, std::f64::consts::SQRT_2, 1.681_792_830_507_429];

/// The lowest level not below `size_m`; 0 for 0, at most 255 (2^43.5 m).
pub fn level_of(size_m: f64) -> u8 {
    // Also sends what is not a number to the top.
    if size_m <= 0.0 {
        return 0;
    }
    if !size_m.is_finite() {
        return u8::MAX;
    }
    let bits = size_m.to_bits();
    let exponent = ((bits >> 52) & 0x7FF) as i32 - 1023;
    let mantissa = f64::from_bits((bits & ((1 << 52) - 1)) | (1023 << 52));
    let above = PARTS.iter().filter(|&&p| mantissa > p).count() as i32;
    (STEPS * (exponent - LEAST_EXPONENT) + above + 1).clamp(1, 255) as u8
}

/// The size a level stands for, metres.
pub fn size_of(level: u8) -> f64 {
    if level == 0 {
        return 0.0;
    }
    let steps = i32::from(level) - 1;
    let exponent = LEAST_EXPONENT + steps / STEPS;
    // A power of two, made exactly.
    f64::from_bits(((exponent + 1023) as u64) << 52) * PARTS[(steps % STEPS) as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_is_never_below_and_at_most_a_step_above() {
        assert_eq!((level_of(0.0), size_of(0)), (0, 0.0));
        let mut size = 1e-6;
        while size < 1e9 {
            let back = size_of(level_of(size));
            assert!(back >= size && back <= size * 1.19, "{size} reads back as {back}");
            assert_eq!(level_of(back), level_of(size), "a level is its own");
            size *= 1.0137;
        }
    }

    #[test]
    fn what_is_no_size_is_the_largest() {
        assert_eq!(level_of(f64::NAN), 255);
        assert_eq!(level_of(f64::INFINITY), 255);
        assert_eq!(level_of(1e-9), 1);
    }
}
