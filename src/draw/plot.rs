//! Charts: lines with marks on linear or log axes, and grouped bars; see [`super::sheet`] for their two forms.

use super::axis::{Range, labels};
use super::sheet::{Anchor, Shape, Sheet, Sign};
use super::text::{self, Turn};

/// sRGB of letters and axes.
const INK: [u8; 3] = [40, 40, 44];
/// sRGB of lines behind the data.
const FAINT: [u8; 3] = [222, 222, 226];
/// Colours of series without one of their own; told apart by light as well as by hue.
pub const SERIES_COLORS: [[u8; 3]; 6] =
    [[200, 72, 40], [38, 92, 170], [70, 150, 80], [226, 160, 40], [122, 70, 150], [110, 110, 116]];
const SIGNS: [Sign; 3] = [Sign::Disc, Sign::Square, Sign::Diamond];
/// Ticks wanted on an axis.
const TICKS: usize = 6;
/// Letters.
const SCALE: u32 = 1;

/// An axis before its range is known.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Axis {
    /// What is shown, with its unit.
    pub label: String,
    /// Powers of ten; values not above 0 are then left out.
    pub log: bool,
    /// The range; found from the values if none.
    pub range: Option<[f64; 2]>,
}

/// Lines over a common x.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LineChart {
    /// Above all.
    pub title: String,
    /// Horizontal.
    pub x: Axis,
    /// Vertical.
    pub y: Axis,
    /// In drawing order.
    pub series: Vec<Series>,
}

/// One line.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Series {
    /// For the legend; without one it has no entry there.
    pub name: String,
    /// x and y in the axes' units, in the order they are joined; one that is not finite breaks the line.
    pub points: Vec<[f64; 2]>,
    /// sRGB; one of [`SERIES_COLORS`] if none.
    pub color: Option<[u8; 3]>,
    /// Dashed, as for a limit or a target.
    pub dashed: bool,
    /// A mark on each point.
    pub marks: bool,
}

/// Bars in groups.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BarChart {
    /// Above all.
    pub title: String,
    /// Vertical; starts at 0 (on a log axis at a round value below the least).
    pub y: Axis,
    /// Names under the groups.
    pub groups: Vec<String>,
    /// One bar a group each.
    pub series: Vec<Bars>,
}

/// One bar of each group.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Bars {
    /// For the legend.
    pub name: String,
    /// By group; what is missing or not finite has no bar.
    pub values: Vec<f64>,
    /// sRGB; one of [`SERIES_COLORS`] if none.
    pub color: Option<[u8; 3]>,
}

impl LineChart {
    /// The chart laid out for a picture size.
    pub fn sheet(&self, size_px: [u32; 2]) -> Sheet {
        let points = || self.series.iter().flat_map(|s| &s.points).filter(|p| p[0].is_finite() && p[1].is_finite());
        let x = self.x.over(points().map(|p| p[0]), false);
        let y = self.y.over(points().map(|p| p[1]), false);
        let names: Vec<_> = self.series.iter().enumerate().map(|(i, s)| s.entry(i)).collect();
        let mut frame = Frame::new(size_px, &self.title, y, &names);
        frame.y_axis(&self.y.label);
        frame.x_ticks(x);
        frame.x_label(&self.x.label);
        for (i, series) in self.series.iter().enumerate() {
            frame.line(series, i, x);
        }
        frame.sheet
    }
}

impl BarChart {
    /// The chart laid out for a picture size.
    pub fn sheet(&self, size_px: [u32; 2]) -> Sheet {
        let values = self.series.iter().flat_map(|s| s.values.iter().copied().take(self.groups.len()));
        let y = self.y.over(values, true);
        let color = |i: usize, bars: &Bars| bars.color.unwrap_or(SERIES_COLORS[i % SERIES_COLORS.len()]);
        let names: Vec<_> = self
            .series
            .iter()
            .enumerate()
            .map(|(i, s)| Entry { name: &s.name, color: color(i, s), sign: Sign::Square })
            .collect();
        let mut frame = Frame::new(size_px, &self.title, y, &names);
        frame.y_axis(&self.y.label);
        let [left, top] = frame.low;
        let [right, bottom] = frame.high;
        let group = (right - left) / self.groups.len().max(1) as f64;
        let bar = group * 0.8 / self.series.len().max(1) as f64;
        let zero = if y.log { 0.0 } else { y.place(0.0).clamp(0.0, 1.0) };
        for (g, name) in self.groups.iter().enumerate() {
            let start = left + group * g as f64;
            for (i, series) in self.series.iter().enumerate() {
                let place = y.place(series.values.get(g).copied().unwrap_or(f64::NAN)).clamp(0.0, 1.0);
                if place.is_nan() {
                    continue;
                }
                let x = start + group * 0.1 + bar * i as f64;
                let height = |t: f64| bottom - (bottom - top) * t;
                let (low, high) =
                    ([x, height(place.max(zero))], [x + bar - bar.min(2.0) / 2.0, height(place.min(zero))]);
                frame.sheet.shapes.push(Shape::Box { low, high, color: color(i, series) });
            }
            let name = text::shortened(name, group as u32, SCALE);
            frame.text([start + group / 2.0, bottom + 11.0], Anchor::Middle, Turn::Right, SCALE, &name);
        }
        frame.border(zero);
        frame.sheet
    }
}

impl Axis {
    /// The range given, or that of the values.
    fn over(&self, values: impl Iterator<Item = f64>, with_zero: bool) -> Range {
        match self.range {
            Some([low, high]) if low < high && (!self.log || low > 0.0) => Range { low, high, log: self.log },
            _ => Range::over(values.chain((with_zero && !self.log).then_some(0.0)), self.log),
        }
    }
}

impl Series {
    fn entry(&self, i: usize) -> Entry<'_> {
        let color = self.color.unwrap_or(SERIES_COLORS[i % SERIES_COLORS.len()]);
        Entry { name: &self.name, color, sign: SIGNS[i % SIGNS.len()] }
    }
}

/// A name in the legend.
struct Entry<'a> {
    name: &'a str,
    color: [u8; 3],
    sign: Sign,
}

/// A chart under construction: title, legend and margins are done.
struct Frame {
    sheet: Sheet,
    /// Corners of the room for data.
    low: [f64; 2],
    high: [f64; 2],
    y: Range,
}

impl Frame {
    fn new(size_px: [u32; 2], title: &str, y: Range, names: &[Entry]) -> Self {
        let widest = labels(&y.ticks(TICKS)).iter().map(|t| text::width_px(t, SCALE)).max().unwrap_or(0);
        let size = size_px.map(f64::from);
        let left = f64::from(widest) + 30.0;
        let mut frame = Self {
            sheet: Sheet { size_px, shapes: Vec::new() },
            low: [left, 10.0],
            high: [size[0] - 16.0, size[1] - 38.0],
            y,
        };
        if !title.is_empty() {
            let title = text::shortened(title, size_px[0].saturating_sub(16), SCALE + 1);
            frame.text([size[0] / 2.0, 16.0], Anchor::Middle, Turn::Right, SCALE + 1, &title);
            frame.low[1] = 34.0;
        }
        frame.legend(names);
        frame.high = [frame.high[0].max(frame.low[0] + 1.0), frame.high[1].max(frame.low[1] + 1.0)];
        frame
    }

    /// Names in lines above the data, where they hide nothing.
    fn legend(&mut self, names: &[Entry]) {
        let mut at = [self.low[0], self.low[1]];
        let shown: Vec<&Entry> = names.iter().filter(|e| !e.name.is_empty()).collect();
        for entry in &shown {
            let width = 14.0 + f64::from(text::width_px(entry.name, SCALE)) + 16.0;
            if at[0] > self.low[0] && at[0] + width > self.high[0] {
                at = [self.low[0], at[1] + 13.0];
            }
            self.sheet.shapes.push(Shape::Mark {
                at: [at[0] + 5.0, at[1]],
                radius: 4.0,
                sign: entry.sign,
                color: entry.color,
            });
            self.text([at[0] + 14.0, at[1]], Anchor::Start, Turn::Right, SCALE, entry.name);
            at[0] += width;
        }
        if !shown.is_empty() {
            self.low[1] = at[1] + 13.0;
        }
    }

    fn text(&mut self, at: [f64; 2], anchor: Anchor, turn: Turn, scale: u32, text: &str) {
        self.sheet.shapes.push(Shape::Text { at, anchor, turn, scale, color: INK, text: text.to_owned() });
    }

    fn stroke(&mut self, points: Vec<[f64; 2]>, width: f64, color: [u8; 3]) {
        self.sheet.shapes.push(Shape::Line { points, width, dash: None, color });
    }

    fn y_axis(&mut self, label: &str) {
        let ticks = self.y.ticks(TICKS);
        for (tick, label) in ticks.iter().zip(labels(&ticks)) {
            // At the middle of a pixel, so that the line is sharp.
            let y = (self.high[1] - (self.high[1] - self.low[1]) * self.y.place(*tick)).round() + 0.5;
            self.stroke(vec![[self.low[0], y], [self.high[0], y]], 1.0, FAINT);
            self.text([self.low[0] - 5.0, y], Anchor::End, Turn::Right, SCALE, &label);
        }
        let middle = (self.low[1] + self.high[1]) / 2.0;
        let label = text::shortened(label, (self.high[1] - self.low[1] + 30.0) as u32, SCALE);
        self.text([10.0, middle], Anchor::Middle, Turn::Up, SCALE, &label);
    }

    fn x_ticks(&mut self, x: Range) {
        let ticks = x.ticks(TICKS);
        for (tick, label) in ticks.iter().zip(labels(&ticks)) {
            let at = (self.low[0] + (self.high[0] - self.low[0]) * x.place(*tick)).round() + 0.5;
            self.stroke(vec![[at, self.low[1]], [at, self.high[1]]], 1.0, FAINT);
            self.text([at, self.high[1] + 11.0], Anchor::Middle, Turn::Right, SCALE, &label);
        }
        self.border(0.0);
    }

    fn x_label(&mut self, label: &str) {
        let at = [(self.low[0] + self.high[0]) / 2.0, self.high[1] + 27.0];
        let label = text::shortened(label, self.sheet.size_px[0], SCALE);
        self.text(at, Anchor::Middle, Turn::Right, SCALE, &label);
    }

    /// The left border and the line at `zero` (0 to 1 of the height).
    fn border(&mut self, zero: f64) {
        let [left, top] = self.low.map(|v| v.round() + 0.5);
        let [right, bottom] = self.high.map(|v| v.round() + 0.5);
        let at = (bottom - (self.high[1] - self.low[1]) * zero).round() - 0.5;
        self.stroke(vec![[left, top], [left, bottom]], 1.0, INK);
        self.stroke(vec![[left, at.max(top)], [right, at.max(top)]], 1.0, INK);
    }

    fn line(&mut self, series: &Series, i: usize, x: Range) {
        let Entry { color, sign, .. } = series.entry(i);
        let place = |p: &[f64; 2]| {
            let t = [x.place(p[0]), self.y.place(p[1])];
            let inside = t.iter().all(|t| (-1e-9..=1.0 + 1e-9).contains(t));
            let at =
                [self.low[0] + (self.high[0] - self.low[0]) * t[0], self.high[1] - (self.high[1] - self.low[1]) * t[1]];
            inside.then_some(at)
        };
        let places: Vec<Option<[f64; 2]>> = series.points.iter().map(place).collect();
        for run in places.split(Option::is_none) {
            let points: Vec<[f64; 2]> = run.iter().copied().flatten().collect();
            if points.len() > 1 {
                let dash = series.dashed.then_some([6.0, 4.0]);
                self.sheet.shapes.push(Shape::Line { points: points.clone(), width: 1.8, dash, color });
            }
            // A point without neighbours would not be seen at all.
            if series.marks || points.len() == 1 {
                self.sheet.shapes.extend(points.into_iter().map(|at| Shape::Mark { at, radius: 3.5, sign, color }));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> LineChart {
        let series = |name: &str, f: f64| Series {
            name: name.into(),
            points: (0..4).map(|i| [10f64.powi(i), f / f64::from(i + 1)]).collect(),
            marks: true,
            ..Series::default()
        };
        LineChart {
            title: "Error < budget".into(),
            x: Axis { label: "faces".into(), log: true, range: None },
            y: Axis { label: "mean, m".into(), ..Axis::default() },
            series: vec![series("ours", 1.0), series("plain", 2.0)],
        }
    }

    fn bars() -> BarChart {
        BarChart {
            title: "Mean distance".into(),
            y: Axis { label: "mm".into(), ..Axis::default() },
            groups: vec!["10 %".into(), "5 %".into()],
            series: vec![
                Bars { name: "a".into(), values: vec![1.0, -2.0], color: Some([9, 9, 9]) },
                Bars { name: "b".into(), values: vec![f64::NAN], color: Some([8, 8, 8]) },
            ],
        }
    }

    #[test]
    fn chart_text_is_stable_and_well_formed() {
        let svg = chart().sheet([480, 320]).svg();
        assert_eq!(svg, chart().sheet([480, 320]).svg());
        let document = roxmltree::Document::parse(&svg).expect("XML");
        let texts: Vec<_> =
            document.descendants().filter(|n| n.has_tag_name("text")).filter_map(|n| n.text()).collect();
        assert_eq!(
            texts,
            [
                "Error < budget",
                "ours",
                "plain",
                "0.0",
                "0.5",
                "1.0",
                "1.5",
                "2.0",
                "mean, m",
                "1",
                "10",
                "100",
                "1000",
                "faces"
            ]
        );
        let line = svg.lines().find(|l| l.starts_with("<polyline") && l.contains("#c84828")).expect("the first series");
        assert_eq!(line.matches(',').count(), 4);
    }

    #[test]
    fn bars_are_as_high_as_their_values() {
        let picture = bars().sheet([400, 300]).picture();
        let pixels = |color: [u8; 3]| picture.enumerate_pixels().filter(|p| p.2.0 == color).count();
        let sheet = bars().sheet([400, 300]);
        let boxes: Vec<_> = sheet
            .shapes
            .iter()
            .filter_map(|s| if let Shape::Box { low, high, .. } = s { Some(high[1] - low[1]) } else { None })
            .collect();
        assert_eq!(boxes.len(), 2, "what is not finite has no bar");
        assert!((boxes[1] - 2.0 * boxes[0]).abs() < 1e-9);
        assert!(pixels([9, 9, 9]) > 1000 && pixels([8, 8, 8]) < 100);
    }

    #[test]
    fn gaps_in_data_break_the_line() {
        let mut chart = chart();
        chart.series[0].points[1][1] = f64::NAN;
        let lines = |chart: &LineChart| {
            let sheet = chart.sheet([480, 320]);
            sheet.shapes.iter().filter(|s| matches!(s, Shape::Line { width, .. } if *width > 1.0)).count()
        };
        assert_eq!(lines(&chart), 2, "of the first series only the last two points are joined");
        chart.series[0].points[3][0] = -1.0;
        assert_eq!(lines(&chart), 1);
    }

    #[test]
    fn nonsense_charts_are_drawn() {
        for size in [[0, 0], [10, 10], [300, 200]] {
            LineChart::default().sheet(size).picture();
            BarChart::default().sheet(size).picture();
            chart().sheet(size).picture();
            bars().sheet(size).picture();
        }
    }
}
