//! Axes: round tick values and their texts, linear or in powers of ten.

/// Values on an axis, from its low to its high end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Value at the left or lower end.
    pub low: f64,
    /// Value at the other end, above `low`.
    pub high: f64,
    /// Equal factors are equal distances; then both ends are above 0.
    pub log: bool,
}

impl Range {
    /// The range of finite `values` (for `log`: of those above 0), widened to round ticks. Without any it is 0 to 1
    /// (for `log` 1 to 10).
    pub fn over(values: impl IntoIterator<Item = f64>, log: bool) -> Self {
        // Beyond these a span or a step is no longer a number.
        const LIMIT: f64 = 1e300;
        let values = values.into_iter().filter(|v| v.abs() <= LIMIT && (!log || *v >= 1.0 / LIMIT));
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            return if log { Self { low: 1.0, high: 10.0, log } } else { Self { low: 0.0, high: 1.0, log } };
        }
        if log { Self::decades(low, high) } else { Self::linear(low, high) }
    }

    fn linear(low: f64, high: f64) -> Self {
        let (low, high) =
            if high > low { (low, high) } else { (low - 0.5 * low.abs().max(1.0), high + 0.5 * high.abs().max(1.0)) };
        let step = step(high - low, 5);
        Self { low: (low / step + 1e-9).floor() * step, high: (high / step - 1e-9).ceil() * step, log: false }
    }

    /// Ends at 1, 2 or 5 times a power of ten: whole decades would leave much of a chart empty.
    fn decades(low: f64, high: f64) -> Self {
        let steps = |value: f64| {
            let decade = value.log10().floor() as i32;
            (-1..=1).flat_map(move |d| [1.0, 2.0, 5.0].map(|m| m * ten(decade + d)))
        };
        let below = steps(low).filter(|s| *s <= low * (1.0 + 1e-9)).fold(0.0, f64::max);
        let above = steps(high).filter(|s| *s >= high * (1.0 - 1e-9)).fold(f64::INFINITY, f64::min);
        let above = if above > below { above } else { below * 10.0 };
        Self { low: below, high: above, log: true }
    }

    /// 0 at the low end, 1 at the high one; outside of that beyond the ends. NaN where a value has no place.
    pub fn place(&self, value: f64) -> f64 {
        if self.log {
            (value.ln() - self.low.ln()) / (self.high.ln() - self.low.ln())
        } else {
            (value - self.low) / (self.high - self.low)
        }
    }

    /// About `count` round values within the range, rising.
    pub fn ticks(&self, count: usize) -> Vec<f64> {
        if !(self.low.is_finite() && self.high.is_finite() && self.low < self.high) || (self.log && self.low <= 0.0) {
            return vec![self.low];
        }
        if !self.log {
            let step = step(self.high - self.low, count.max(1));
            let (first, last) = ((self.low / step - 1e-9).ceil(), (self.high / step + 1e-9).floor());
            // + 0.0 turns a negative zero into zero.
            return (0..=(last - first) as usize).map(|i| (first + i as f64) * step + 0.0).collect();
        }
        let (first, last) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
        let within = |v: &f64| *v >= self.low * (1.0 - 1e-9) && *v <= self.high * (1.0 + 1e-9);
        let all = |parts: &[f64]| -> Vec<f64> {
            (first..=last).flat_map(|d| parts.iter().map(move |m| m * ten(d))).filter(within).collect()
        };
        let fine = all(&[1.0, 2.0, 5.0]);
        if fine.len() <= count.max(3) {
            return fine;
        }
        let whole = all(&[1.0]);
        if whole.len() < 2 {
            return fine;
        }
        let every = whole.len().div_ceil(count.max(2) + 1);
        whole.into_iter().step_by(every).collect()
    }
}

/// The texts of `ticks`, all with the same number of decimals; powers of ten are used where numbers would get long.
pub fn labels(ticks: &[f64]) -> Vec<String> {
    let largest = ticks.iter().map(|t| t.abs()).fold(0.0, f64::max);
    let smallest = ticks.iter().map(|t| t.abs()).filter(|t| *t > 0.0).fold(f64::INFINITY, f64::min);
    let gap = ticks
        .windows(2)
        .map(|w| (w[1] - w[0]).abs())
        .fold(f64::INFINITY, f64::min)
        .min(smallest.max(f64::MIN_POSITIVE));
    let even = ticks.len() > 2 && ticks.windows(3).all(|w| (w[2] - 2.0 * w[1] + w[0]).abs() < 1e-9 * largest);
    ticks
        .iter()
        .map(|&t| {
            if largest >= 1e6 || (largest > 0.0 && largest < 1e-3) || (!even && smallest < 1e-4) {
                return if t == 0.0 { "0".to_owned() } else { format!("{t:.1e}").replace(".0e", "e") };
            }
            let decimals = if even || t == 0.0 { decimals(gap) } else { decimals(t.abs()) };
            format!("{t:.decimals$}")
        })
        .collect()
}

/// Decimals that show a value of this size to its first digit (two, for steps like 0.25).
fn decimals(value: f64) -> usize {
    (0..9)
        .find(|&d| {
            let scaled = value * ten(d);
            (scaled - scaled.round()).abs() < 1e-6 * scaled && scaled > 0.5
        })
        .unwrap_or(6) as usize
}

/// The round step (1, 2 or 5 times a power of ten) that cuts `span` into about `count` parts.
fn step(span: f64, count: usize) -> f64 {
    let raw = span / count as f64;
    let decade = ten(raw.log10().floor().clamp(-300.0, 300.0) as i32);
    // Limits are the geometric means of neighbours.
    let factor = match raw / decade {
        r if r < 2.0_f64.sqrt() => 1.0,
        r if r < 10.0_f64.sqrt() => 2.0,
        r if r < 50.0_f64.sqrt() => 5.0,
        _ => 10.0,
    };
    factor * decade
}

/// A power of ten, exactly rounded: powi is not.
fn ten(exponent: i32) -> f64 {
    format!("1e{exponent}").parse().unwrap_or(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(range: Range, count: usize) -> String {
        labels(&range.ticks(count)).join(" ")
    }

    #[test]
    fn ticks_are_round_numbers() {
        assert_eq!(texts(Range::over([0.0, 9.3], false), 5), "0 2 4 6 8 10");
        assert_eq!(texts(Range::over([-0.12, 0.31], false), 5), "-0.2 -0.1 0.0 0.1 0.2 0.3 0.4");
        assert_eq!(texts(Range::over([1.2e6, 3.1e6], false), 4), "1e6 1.5e6 2e6 2.5e6 3e6 3.5e6");
        assert_eq!(texts(Range { low: 3.2, high: 17.9, log: false }, 5), "4 6 8 10 12 14 16");
    }

    #[test]
    fn log_ticks_are_powers_of_ten_or_their_2_and_5() {
        assert_eq!(texts(Range::over([0.03, 0.8], true), 6), "0.02 0.05 0.1 0.2 0.5 1");
        assert_eq!(texts(Range::over([0.003, 70.0], true), 6), "0.01 0.1 1 10 100");
        assert_eq!(texts(Range::over([5.0, 5.0], true), 6), "5 10 20 50");
        assert!(Range::over([1e-12, 1e12], true).ticks(6).len() <= 7);
    }

    #[test]
    fn places_run_from_0_to_1() {
        let log = Range { low: 0.01, high: 1.0, log: true };
        assert!((log.place(0.1) - 0.5).abs() < 1e-12 && log.place(-3.0).is_nan());
        assert_eq!(Range { low: 2.0, high: 4.0, log: false }.place(3.0), 0.5);
    }

    #[test]
    fn nonsense_gives_an_axis_all_the_same() {
        for log in [false, true] {
            for values in
                [vec![], vec![f64::NAN, f64::INFINITY], vec![0.0], vec![-7.0, -7.0], vec![1e308, -1e308], vec![5e-324]]
            {
                let range = Range::over(values.clone(), log);
                let ticks = range.ticks(5);
                assert!(!ticks.is_empty() && ticks.len() < 40, "{values:?} {range:?}");
                assert_eq!(labels(&ticks).len(), ticks.len());
            }
        }
    }
}
