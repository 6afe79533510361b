//! Panels: pictures in a grid with titles, a colour bar or a class legend below.

use image::{Rgb, RgbImage};

use super::axis::{Range, labels};
use super::ramp::{NO_DATA, Scale};
use super::text::{self, Turn};

/// sRGB of letters and lines.
const INK: [u8; 3] = [40, 40, 44];
/// Room around and between pictures, pixels at text scale 1.
const GAP_PX: u32 = 6;

/// A picture and what it is called.
#[derive(Debug, Clone)]
pub struct Panel {
    /// Above the picture; may be empty.
    pub title: String,
    /// The picture.
    pub picture: RgbImage,
    /// Below the picture: one for all is better given to [`grid`].
    pub legend: Option<Legend>,
}

/// What colours mean.
#[derive(Debug, Clone, PartialEq)]
pub enum Legend {
    /// A colour bar with ticks and unit.
    Scale(Scale),
    /// A box of colour for each name.
    Names(Vec<(String, [u8; 3])>),
}

impl Legend {
    /// The legend of a class scheme, in its order.
    pub fn of_classes(scheme: &crate::ids::ClassScheme) -> Self {
        Self::Names(scheme.0.iter().map(|class| (class.name.clone(), class.color)).collect())
    }

    /// The legend as a picture of `width_px`; its height follows.
    pub fn picture(&self, width_px: u32, scale: u32) -> RgbImage {
        match self {
            Self::Scale(values) => bar(values, width_px.max(1), scale.max(1)),
            Self::Names(names) => boxes(names, width_px.max(1), scale.max(1)),
        }
    }
}

/// Puts `panels` in a grid of `columns`, row by row, on white; `scale` is that of the letters.
///
/// Columns are as wide as their widest picture, rows as high as their highest. `title` goes above all, `legend` below;
/// without panels there is nothing but these.
pub fn grid(title: &str, panels: &[Panel], columns: usize, legend: Option<&Legend>, scale: u32) -> RgbImage {
    let scale = scale.max(1);
    let gap = GAP_PX * scale;
    let columns = columns.clamp(1, panels.len().max(1));
    let blocks: Vec<RgbImage> = panels.iter().map(|panel| block(panel, scale)).collect();
    let widths: Vec<u32> =
        (0..columns).map(|c| blocks.iter().skip(c).step_by(columns).map(RgbImage::width).max().unwrap_or(0)).collect();
    let heights: Vec<u32> =
        blocks.chunks(columns).map(|row| row.iter().map(RgbImage::height).max().unwrap_or(0)).collect();
    let inner = (widths.iter().map(|w| w + gap).sum::<u32>().saturating_sub(gap)).max(60 * scale);
    let head = if title.is_empty() { 0 } else { text::height_px(scale + 1) + gap };
    let foot = legend.map(|legend| legend.picture(inner, scale));
    let height =
        gap + head + heights.iter().map(|h| h + gap).sum::<u32>() + foot.as_ref().map_or(0, |f| f.height() + gap);
    let mut sheet = white(inner + 2 * gap, height);
    let title = text::shortened(title, inner, scale + 1);
    text::write(&mut sheet, &title, [gap.into(), gap.into()], scale + 1, Turn::Right, INK);
    let mut y = gap + head;
    for (row, height) in blocks.chunks(columns).zip(&heights) {
        let mut x = gap;
        for (block, width) in row.iter().zip(&widths) {
            paste(&mut sheet, block, [x, y]);
            x += width + gap;
        }
        y += height + gap;
    }
    if let Some(foot) = foot {
        paste(&mut sheet, &foot, [gap, y]);
    }
    sheet
}

/// Title, picture, legend, one below the other.
fn block(panel: &Panel, scale: u32) -> RgbImage {
    let width = panel.picture.width();
    let head = if panel.title.is_empty() { 0 } else { text::height_px(scale) + scale };
    let foot = panel.legend.as_ref().map(|legend| legend.picture(width, scale));
    let gap = GAP_PX * scale / 2;
    let foot_height = foot.as_ref().map_or(0, |f| f.height() + gap);
    let mut block = white(width, head + panel.picture.height() + foot_height);
    let title = text::shortened(&panel.title, width, scale);
    text::write(&mut block, &title, [0, 0], scale, Turn::Right, INK);
    paste(&mut block, &panel.picture, [0, head]);
    if let Some(foot) = foot {
        paste(&mut block, &foot, [0, head + panel.picture.height() + gap]);
    }
    block
}

/// A colour bar: the ramp, ticks under it, the unit after the last number, grey for values that are not there.
fn bar(values: &Scale, width: u32, scale: u32) -> RgbImage {
    let high = 8 * scale;
    let mut picture = white(width, high + 3 * scale + text::height_px(scale));
    let range = Range { low: values.low, high: values.high, log: values.log };
    let unit = if values.unit.is_empty() { String::new() } else { format!(" {}", values.unit) };
    // Half of the first number and half of the last with its unit reach beyond the ends.
    let ticks = if range.low < range.high { range.ticks(ticks_that_fit(width, scale)) } else { vec![range.low] };
    let texts = labels(&ticks);
    let side = texts.iter().map(|t| text::width_px(t, scale)).max().unwrap_or(0) / 2 + 1;
    let (left, right) = (side.min(width / 4), (side + text::width_px(&unit, scale)).min(width / 2));
    let length = width.saturating_sub(left + right).max(1);
    for x in 0..length {
        let t = (f64::from(x) + 0.5) / f64::from(length);
        fill(&mut picture, [left + x, 0], [left + x + 1, high], values.ramp.at(t));
    }
    let mut free_from = 0;
    for (i, (tick, label)) in ticks.iter().zip(&texts).enumerate() {
        let place = range.place(*tick);
        let place = if place.is_finite() { place.clamp(0.0, 1.0) } else { 0.0 };
        let x = left + (place * f64::from(length - 1)).round() as u32;
        fill(&mut picture, [x, high], [x + scale.min(2), high + 2 * scale], INK);
        let start = i64::from(x) - i64::from(text::width_px(label, scale) / 2);
        if start < free_from {
            continue;
        }
        let label = if i + 1 == ticks.len() { format!("{label}{unit}") } else { label.clone() };
        text::write(&mut picture, &label, [start.max(0), (high + 3 * scale).into()], scale, Turn::Right, INK);
        free_from = start + i64::from(text::width_px(&label, scale) + 4 * scale);
    }
    picture
}

fn ticks_that_fit(width: u32, scale: u32) -> usize {
    (width / (34 * scale)).clamp(2, 8) as usize
}

/// Boxes of colour with their names, in as many lines as needed.
fn boxes(names: &[(String, [u8; 3])], width: u32, scale: u32) -> RgbImage {
    let (side, line) = (text::CAPITAL_PX * scale, text::height_px(scale) + 2 * scale);
    let mut places = Vec::new();
    let (mut x, mut y) = (0, 0);
    for (name, color) in names {
        let name = text::shortened(name, width.saturating_sub(side + 2 * scale), scale);
        let needed = side + 2 * scale + text::width_px(&name, scale);
        if x > 0 && x + needed > width {
            (x, y) = (0, y + line);
        }
        places.push((x, y, name, *color));
        x += needed + 6 * scale;
    }
    let mut picture = white(width, y + line);
    for (x, y, name, color) in places {
        fill(&mut picture, [x, y], [x + side, y + side], color);
        text::write(&mut picture, &name, [(x + side + 2 * scale).into(), y.into()], scale, Turn::Right, INK);
    }
    picture
}

/// The legend entry for values that are not there.
pub fn no_data() -> (String, [u8; 3]) {
    ("no data".to_owned(), NO_DATA)
}

fn white(width: u32, height: u32) -> RgbImage {
    RgbImage::from_pixel(width, height, Rgb([255; 3]))
}

fn fill(picture: &mut RgbImage, low: [u32; 2], high: [u32; 2], color: [u8; 3]) {
    for y in low[1]..high[1].min(picture.height()) {
        for x in low[0]..high[0].min(picture.width()) {
            picture.put_pixel(x, y, Rgb(color));
        }
    }
}

fn paste(sheet: &mut RgbImage, picture: &RgbImage, at: [u32; 2]) {
    image::imageops::replace(sheet, picture, at[0].into(), at[1].into());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::ramp::Ramp;

    fn panel(title: &str, width: u32, height: u32, color: [u8; 3]) -> Panel {
        Panel { title: title.into(), picture: RgbImage::from_pixel(width, height, Rgb(color)), legend: None }
    }

    fn area(picture: &RgbImage, color: [u8; 3]) -> usize {
        picture.pixels().filter(|p| p.0 == color).count()
    }

    #[test]
    fn pictures_of_different_sizes_do_not_overlap() {
        let panels = [panel("a", 30, 20, [1, 0, 0]), panel("", 50, 10, [2, 0, 0]), panel("c", 10, 40, [3, 0, 0])];
        let sheet = grid("All", &panels, 2, None, 1);
        assert_eq!([1, 2, 3].map(|c| area(&sheet, [c, 0, 0])), [600, 500, 400]);
        assert_eq!(sheet.width(), 30 + 50 + 3 * GAP_PX);
    }

    #[test]
    fn a_colour_bar_runs_from_the_first_colour_to_the_last() {
        let scale = Scale::new(Ramp::Signed, -2.0, 2.0, "cm");
        let picture = Legend::Scale(scale).picture(200, 1);
        let row: Vec<[u8; 3]> = (0..200).map(|x| picture.get_pixel(x, 3).0).filter(|c| *c != [255; 3]).collect();
        let near = |a: [u8; 3], b: [u8; 3]| (0..3).all(|c| a[c].abs_diff(b[c]) < 5);
        assert!(near(row[0], Ramp::Signed.at(0.0)) && near(row[row.len() - 1], Ramp::Signed.at(1.0)));
        assert!(row.len() > 150);
    }

    #[test]
    fn legends_of_any_range_are_drawn() {
        for (low, high, log) in
            [(0.0, 0.0, false), (1e-9, 1e9, true), (f64::NAN, 1.0, false), (3.0, 2.0, false), (0.0, 5.0, true)]
        {
            let legend = Legend::Scale(Scale { log, ..Scale::new(Ramp::Even, low, high, "m") });
            assert_eq!(legend.picture(120, 2).width(), 120);
        }
    }

    #[test]
    fn every_class_has_its_box_even_where_room_is_short() {
        let scheme = crate::ids::ClassScheme::default();
        for width in [40, 90, 400] {
            let picture = Legend::of_classes(&scheme).picture(width, 1);
            assert!(scheme.0.iter().all(|class| area(&picture, class.color) == 49), "{width}");
        }
        assert!(grid("", &[], 3, None, 1).width() > 0);
    }
}
