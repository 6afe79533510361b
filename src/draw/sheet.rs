//! A sheet of flat shapes, written as SVG text or as pixels: charts are laid out once for both.
//!
//! Coordinates are pixels, x right, y down. Later shapes cover earlier ones.

use std::fmt::Write;

use image::{Rgb, RgbImage};

use super::text::{self, Turn};

/// Shapes on white.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Sheet {
    /// Width and height, pixels.
    pub size_px: [u32; 2],
    /// In drawing order.
    pub shapes: Vec<Shape>,
}

/// A shape of one colour.
#[derive(Debug, Clone, PartialEq)]
pub enum Shape {
    /// A filled box from `low` to `high` corner.
    Box {
        /// Upper left corner.
        low: [f64; 2],
        /// Lower right corner.
        high: [f64; 2],
        /// sRGB.
        color: [u8; 3],
    },
    /// A line through points.
    Line {
        /// Its corners.
        points: Vec<[f64; 2]>,
        /// Thickness.
        width: f64,
        /// Lengths of dash and gap; none for a solid line.
        dash: Option<[f64; 2]>,
        /// sRGB.
        color: [u8; 3],
    },
    /// A sign at a point.
    Mark {
        /// Its middle.
        at: [f64; 2],
        /// Half its width.
        radius: f64,
        /// Its outline.
        sign: Sign,
        /// sRGB.
        color: [u8; 3],
    },
    /// A line of text.
    Text {
        /// Left end, middle or right end (see `anchor`) of the middle between baseline and top of capitals.
        at: [f64; 2],
        /// Where `at` is along the text.
        anchor: Anchor,
        /// Which way it runs.
        turn: Turn,
        /// Font scale.
        scale: u32,
        /// sRGB.
        color: [u8; 3],
        /// The letters.
        text: String,
    },
}

/// Outlines of marks, so that series differ in print too.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sign {
    /// A disc.
    Disc,
    /// An upright square.
    Square,
    /// A square on its corner.
    Diamond,
}

/// Where along a text its place is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Anchor {
    /// At its first letter.
    Start,
    /// In its middle.
    Middle,
    /// At its last letter.
    End,
}

impl Sheet {
    /// The sheet as a self-contained SVG file.
    pub fn svg(&self) -> String {
        let [width, height] = self.size_px;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
             font-family=\"sans-serif\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n"
        );
        for shape in &self.shapes {
            // Writing to a String cannot fail.
            let _ = shape.svg(&mut svg);
        }
        svg.push_str("</svg>\n");
        svg
    }

    /// The sheet as pixels.
    pub fn picture(&self) -> RgbImage {
        let mut picture = RgbImage::from_pixel(self.size_px[0], self.size_px[1], Rgb([255; 3]));
        for shape in &self.shapes {
            shape.paint(&mut picture);
        }
        picture
    }
}

impl Shape {
    fn svg(&self, svg: &mut String) -> std::fmt::Result {
        match self {
            Self::Box { low, high, color } => writeln!(
                svg,
                "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" fill=\"{}\"/>",
                number(low[0]),
                number(low[1]),
                number(high[0] - low[0]),
                number(high[1] - low[1]),
                hex(*color)
            ),
            Self::Line { points, width, dash, color } => {
                let points: Vec<String> = points.iter().map(|p| format!("{},{}", number(p[0]), number(p[1]))).collect();
                let dash =
                    dash.map_or(String::new(), |[a, b]| format!(" stroke-dasharray=\"{} {}\"", number(a), number(b)));
                let (points, width, color) = (points.join(" "), number(*width), hex(*color));
                writeln!(
                    svg,
                    "<polyline points=\"{points}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"{width}\"{dash}/>"
                )
            }
            Self::Mark { at: [x, y], radius, sign: Sign::Disc, color } => {
                writeln!(
                    svg,
                    "<circle cx=\"{}\" cy=\"{}\" r=\"{}\" fill=\"{}\"/>",
                    number(*x),
                    number(*y),
                    number(*radius),
                    hex(*color)
                )
            }
            Self::Mark { at: [x, y], radius: r, sign, color } => {
                let corners = if *sign == Sign::Square {
                    [[x - r, y - r], [x + r, y - r], [x + r, y + r], [x - r, y + r]]
                } else {
                    [[x - r, *y], [*x, y - r], [x + r, *y], [*x, y + r]]
                };
                let corners = corners.map(|p| format!("{},{}", number(p[0]), number(p[1])));
                writeln!(svg, "<polygon points=\"{}\" fill=\"{}\"/>", corners.join(" "), hex(*color))
            }
            Self::Text { at: [x, y], anchor, turn, scale, color, text } => {
                let anchor = ["start", "middle", "end"][*anchor as usize];
                // Capitals of common fonts are about 0.72 of the font size high.
                let size = f64::from(text::CAPITAL_PX * scale) / 0.72;
                let turned = match turn {
                    Turn::Right => String::new(),
                    Turn::Up => format!(" transform=\"rotate(-90 {} {})\"", number(*x), number(*y)),
                };
                writeln!(
                    svg,
                    "<text x=\"{}\" y=\"{}\" dy=\"0.36em\" font-size=\"{}\" text-anchor=\"{anchor}\" fill=\"{}\"{turned}>{}</text>",
                    number(*x),
                    number(*y),
                    number(size),
                    hex(*color),
                    escaped(text)
                )
            }
        }
    }

    fn paint(&self, picture: &mut RgbImage) {
        match self {
            Self::Box { low, high, color } => {
                let [low, high] = [low, high].map(|p| p.map(|v| v.round()));
                cover(picture, low, high, *color, |x, y| {
                    f64::from(u8::from(x > low[0] && x < high[0] && y > low[1] && y < high[1]))
                });
            }
            Self::Line { points, width, dash, color } => {
                let mut walked = 0.0;
                for ends in points.windows(2) {
                    segment(picture, [ends[0], ends[1]], *width, dash.map(|d| (d, walked)), *color);
                    walked += (ends[1][0] - ends[0][0]).hypot(ends[1][1] - ends[0][1]);
                }
            }
            Self::Mark { at, radius, sign, color } => {
                let (low, high) = (at.map(|v| v - radius - 1.0), at.map(|v| v + radius + 1.0));
                cover(picture, low, high, *color, |x, y| {
                    let (dx, dy) = ((x - at[0]).abs(), (y - at[1]).abs());
                    let distance = match sign {
                        Sign::Disc => dx.hypot(dy),
                        Sign::Square => dx.max(dy),
                        Sign::Diamond => dx + dy,
                    };
                    radius + 0.5 - distance
                });
            }
            Self::Text { at, anchor, turn, scale, color, text } => {
                let back = f64::from(text::width_px(text, *scale)) * [0.0, 0.5, 1.0][*anchor as usize];
                let half = f64::from(text::CAPITAL_PX * scale) / 2.0;
                let corner = match turn {
                    Turn::Right => [at[0] - back, at[1] - half],
                    Turn::Up => [at[0] - half, at[1] + back],
                };
                text::write(picture, text, corner.map(|v| v.round() as i64), *scale, *turn, *color);
            }
        }
    }
}

/// A line of round ends; dashes are counted from `walked` pixels on.
fn segment(picture: &mut RgbImage, [a, b]: [[f64; 2]; 2], width: f64, dash: Option<([f64; 2], f64)>, color: [u8; 3]) {
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    let length2 = dx * dx + dy * dy;
    let reach = width / 2.0 + 1.0;
    let low = [a[0].min(b[0]) - reach, a[1].min(b[1]) - reach];
    let high = [a[0].max(b[0]) + reach, a[1].max(b[1]) + reach];
    cover(picture, low, high, color, |x, y| {
        let (px, py) = (x - a[0], y - a[1]);
        let t = if length2 > 0.0 { ((px * dx + py * dy) / length2).clamp(0.0, 1.0) } else { 0.0 };
        if let Some(([on, off], walked)) = dash
            && (walked + t * length2.sqrt()).rem_euclid((on + off).max(1e-9)) > on
        {
            return 0.0;
        }
        width / 2.0 + 0.5 - (px - t * dx).hypot(py - t * dy)
    });
}

/// Mixes `color` into the pixels from `low` to `high` by `share` of their centres, clamped to 0 to 1.
fn cover(picture: &mut RgbImage, low: [f64; 2], high: [f64; 2], color: [u8; 3], share: impl Fn(f64, f64) -> f64) {
    // Casting saturates, so shapes far outside cost nothing.
    let range = |c: usize, side: u32| (low[c].floor() as u32, (high[c].ceil().max(0.0) as u32).min(side));
    let ((x0, x1), (y0, y1)) = (range(0, picture.width()), range(1, picture.height()));
    for y in y0..y1 {
        for x in x0..x1 {
            let share = share(f64::from(x) + 0.5, f64::from(y) + 0.5).clamp(0.0, 1.0);
            if share > 0.0 {
                let pixel = picture.get_pixel_mut(x, y);
                pixel.0 = std::array::from_fn(|c| {
                    (f64::from(pixel.0[c]) * (1.0 - share) + f64::from(color[c]) * share + 0.5) as u8
                });
            }
        }
    }
}

/// Two decimals at most: enough for pixels, and the same text wherever the last bits differ.
fn number(value: f64) -> String {
    let text = format!("{value:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

fn hex([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

fn escaped(text: &str) -> String {
    // Control letters are not allowed in XML at all.
    let text: String = text.chars().filter(|c| !c.is_control()).collect();
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sheet(shape: Shape) -> Sheet {
        Sheet { size_px: [20, 10], shapes: vec![shape] }
    }

    #[test]
    fn a_line_has_its_thickness() {
        let line = |dash| Shape::Line { points: vec![[-5.0, 5.0], [25.0, 5.0]], width: 2.0, dash, color: [0; 3] };
        let dark = |dash| sheet(line(dash)).picture().pixels().filter(|p| p.0 == [0; 3]).count();
        assert_eq!(dark(None), 40);
        assert_eq!(dark(Some([5.0, 5.0])), 20);
    }

    #[test]
    fn shapes_outside_of_the_sheet_are_left_out() {
        for at in [[-1e12, 3.0], [f64::NAN, 5.0], [1e300, -1e300]] {
            let mark = Shape::Mark { at, radius: 3.0, sign: Sign::Diamond, color: [0; 3] };
            assert!(sheet(mark).picture().pixels().all(|p| p.0 == [255; 3]));
        }
    }

    #[test]
    fn svg_text_is_escaped_and_numbers_are_short() {
        let text = Shape::Text {
            at: [1.0 / 3.0, -0.001],
            anchor: Anchor::Middle,
            turn: Turn::Up,
            scale: 1,
            color: [1, 2, 255],
            text: "a < b & \"c\"\n".into(),
        };
        let svg = sheet(text).svg();
        assert!(svg.contains("x=\"0.33\" y=\"0\"") && svg.contains(">a &lt; b &amp; &quot;c&quot;</text>"), "{svg}");
        assert!(svg.contains("fill=\"#0102ff\"") && svg.contains("rotate(-90 0.33 0)"), "{svg}");
        assert!(roxmltree::Document::parse(&svg).is_ok());
    }
}
