//! Values and classes become colours.

use crate::ids::{ClassId, ClassScheme};

/// sRGB of values that are not there (not a number), and of faces without a class.
pub const NO_DATA: [u8; 3] = [150, 150, 150];

/// A colour ramp: stops at equal distances, straight lines between them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ramp {
    /// Blue over green and yellow to red, as in the paper's Figure 3: low is blue, high is red.
    BlueRed,
    /// Dark violet to pale yellow; each step is lighter than the one before, in print and for the colour-blind too.
    Even,
    /// Blue through white to red, for signed values whose zero is in the middle.
    Signed,
}

impl Ramp {
    /// The stops from low to high, sRGB.
    pub fn stops(self) -> &'static [[u8; 3]] {
        match self {
            Self::BlueRed => &[[28, 46, 204], [26, 156, 222], [62, 178, 92], [240, 214, 48], [214, 32, 30]],
            Self::Even => {
                &[[38, 18, 72], [70, 48, 140], [44, 110, 158], [46, 162, 136], [142, 204, 84], [250, 238, 120]]
            }
            Self::Signed => &[[30, 60, 170], [122, 164, 222], [244, 244, 242], [234, 146, 112], [176, 26, 38]],
        }
    }

    /// The colour at `t`, 0 lowest to 1 highest; values outside take the end's colour, NaN is [`NO_DATA`].
    pub fn at(self, t: f64) -> [u8; 3] {
        if t.is_nan() {
            return NO_DATA;
        }
        let stops = self.stops();
        let place = t.clamp(0.0, 1.0) * (stops.len() - 1) as f64;
        let low = (place as usize).min(stops.len() - 2);
        let t = place - low as f64;
        std::array::from_fn(|c| {
            let (a, b) = (f64::from(stops[low][c]), f64::from(stops[low + 1][c]));
            (a + (b - a) * t + 0.5) as u8
        })
    }
}

/// A ramp over a stated range of values.
#[derive(Debug, Clone, PartialEq)]
pub struct Scale {
    /// The colours.
    pub ramp: Ramp,
    /// Value of the first colour, in `unit`.
    pub low: f64,
    /// Value of the last colour, in `unit`.
    pub high: f64,
    /// Equal factors, not equal differences, are equal distances on the ramp. Needs 0 < `low`.
    pub log: bool,
    /// Unit for the legend; empty for pure numbers.
    pub unit: String,
}

impl Scale {
    /// A linear scale from `low` to `high`.
    pub fn new(ramp: Ramp, low: f64, high: f64, unit: &str) -> Self {
        Self { ramp, low, high, log: false, unit: unit.to_owned() }
    }

    /// A linear scale over the finite `values` without the `cut` share at each end: one outlier must not turn
    /// everything else into one colour. Without finite values the range is 0 to 1.
    pub fn over(ramp: Ramp, values: &[f64], cut: f64, unit: &str) -> Self {
        let mut values: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
        values.sort_unstable_by(f64::total_cmp);
        let Some(last) = values.len().checked_sub(1) else { return Self::new(ramp, 0.0, 1.0, unit) };
        let skip = ((cut.clamp(0.0, 0.5) * last as f64) as usize).min(last / 2);
        Self::new(ramp, values[skip], values[last - skip], unit)
    }

    /// Where `value` is on the ramp, 0 to 1 inside the range; NaN stays NaN.
    pub fn place(&self, value: f64) -> f64 {
        let (value, low, high) =
            if self.log { (value.max(0.0).ln(), self.low.ln(), self.high.ln()) } else { (value, self.low, self.high) };
        let t = (value - low) / (high - low);
        // A range without width has one colour, the lowest; only values that are not there are grey.
        if high == low && !value.is_nan() { f64::from(u8::from(value > high)) } else { t }
    }

    /// The colour of `value`.
    pub fn color(&self, value: f64) -> [u8; 3] {
        if value.is_nan() { NO_DATA } else { self.ramp.at(self.place(value)) }
    }
}

/// The scheme's colour of `class`; [`NO_DATA`] for a class the scheme does not have.
pub fn class_color(scheme: &ClassScheme, class: ClassId) -> [u8; 3] {
    scheme.0.get(class.index()).map_or(NO_DATA, |spec| spec.color)
}

/// A colour for a region by its number: neighbours in number differ clearly, equal numbers never do.
pub fn region_color(region: u32) -> [u8; 3] {
    // Multiples of the golden ratio spread hues evenly for any count; three levels of light help where hues come close.
    const GOLDEN: u32 = 0x9E37_79B9;
    let hue = region.wrapping_mul(GOLDEN) >> 16;
    let (sixth, t) = ((hue * 6) >> 16, ((hue * 6) & 0xFFFF) as f64 / 65536.0);
    let top = [230.0, 190.0, 150.0][region as usize % 3];
    let low = top * 0.32;
    let (rise, fall) = (low + (top - low) * t, top - (top - low) * t);
    let [r, g, b] = match sixth {
        0 => [top, rise, low],
        1 => [fall, top, low],
        2 => [low, top, rise],
        3 => [low, fall, top],
        4 => [rise, low, top],
        _ => [top, low, fall],
    };
    [r as u8, g as u8, b as u8]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn light([r, g, b]: [u8; 3]) -> f64 {
        0.2126 * f64::from(r).powf(2.2) + 0.7152 * f64::from(g).powf(2.2) + 0.0722 * f64::from(b).powf(2.2)
    }

    #[test]
    fn low_is_blue_and_high_is_red() {
        let scale = Scale::new(Ramp::BlueRed, 2.0, 4.0, "m");
        let (low, high) = (scale.color(2.0), scale.color(4.0));
        assert!(low[2] > low[0] && high[0] > high[2]);
        assert_eq!(scale.color(-50.0), low);
        assert_eq!(scale.color(f64::INFINITY), high);
        assert_eq!(scale.color(3.0), Ramp::BlueRed.stops()[2]);
        assert_eq!(scale.color(f64::NAN), NO_DATA);
    }

    #[test]
    fn the_even_ramp_gets_lighter_at_every_step() {
        let lights: Vec<f64> = (0..=100).map(|i| light(Ramp::Even.at(f64::from(i) / 100.0))).collect();
        assert!(lights.windows(2).all(|w| w[1] > w[0]));
    }

    #[test]
    fn a_range_without_width_is_no_grey() {
        let scale = Scale::over(Ramp::Even, &[3.0, 3.0, f64::NAN], 0.02, "m");
        assert_eq!([scale.low, scale.high], [3.0, 3.0]);
        assert_eq!(scale.color(3.0), Ramp::Even.at(0.0));
        assert_eq!(Scale::over(Ramp::Even, &[], 0.02, "").high, 1.0);
    }

    #[test]
    fn outliers_do_not_widen_the_range() {
        let mut values: Vec<f64> = (0..=100).map(f64::from).collect();
        values[50] = 1e9;
        let scale = Scale::over(Ramp::Even, &values, 0.02, "m");
        assert_eq!([scale.low, scale.high], [2.0, 99.0]);
    }

    #[test]
    fn equal_factors_are_equal_distances_on_a_log_scale() {
        let scale = Scale { log: true, ..Scale::new(Ramp::Even, 0.01, 1.0, "m") };
        assert!((scale.place(0.1) - 0.5).abs() < 1e-12);
        assert_eq!(scale.color(0.0), Ramp::Even.at(0.0));
        assert_eq!(scale.color(-1.0), Ramp::Even.at(0.0));
    }

    #[test]
    fn regions_next_in_number_differ_clearly() {
        let distance =
            |a: [u8; 3], b: [u8; 3]| -> i32 { (0..3).map(|c| (i32::from(a[c]) - i32::from(b[c])).abs()).sum() };
        assert!((0..5000).all(|i| distance(region_color(i), region_color(i + 1)) > 60));
    }

    #[test]
    fn a_class_outside_the_scheme_is_grey() {
        let scheme = ClassScheme::default();
        assert_eq!(class_color(&scheme, ClassId::ROOF), scheme[ClassId::ROOF].color);
        assert_eq!(class_color(&scheme, ClassId(77)), NO_DATA);
    }
}
