//! A bitmap font of our own, so that pictures carry their legends without a font file.
//!
//! Capitals and digits are seven rows high, descenders reach two rows lower; widths are proportional, except that
//! digits are all five wide. Letters scale by whole numbers and are never smoothed: the same bytes everywhere.

use image::{Rgb, RgbImage};

/// Rows of a glyph at scale 1, descenders included, pixels.
pub const ROWS_PX: u32 = 9;
/// Rows above the baseline at scale 1, pixels.
pub const CAPITAL_PX: u32 = 7;
/// Columns between letters at scale 1.
const GAP_PX: u32 = 1;
/// Drawn for letters the font does not have.
const UNKNOWN: &str = "#####/#...#/#...#/#...#/#...#/#...#/#####";

/// Where the letters run to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// Left to right.
    Right,
    /// Bottom to top, for vertical axes.
    Up,
}

/// Width of `text` at `scale`, pixels; the gap after the last letter is not counted.
pub fn width_px(text: &str, scale: u32) -> u32 {
    let columns: u32 = text.chars().map(|c| columns(glyph(c)) + GAP_PX).sum();
    columns.saturating_sub(GAP_PX) * scale
}

/// Height of a line at `scale` from the top of capitals to the foot of descenders, pixels.
pub fn height_px(scale: u32) -> u32 {
    ROWS_PX * scale
}

/// Writes `text` with its top left letter corner at `at` (for [`Turn::Up`]: the bottom left); clipped by the picture.
pub fn write(picture: &mut RgbImage, text: &str, at: [i64; 2], scale: u32, turn: Turn, color: [u8; 3]) {
    let scale = i64::from(scale);
    let mut left = 0;
    for c in text.chars() {
        let glyph = glyph(c);
        for (row, line) in glyph.split('/').enumerate() {
            for (column, _) in line.bytes().enumerate().filter(|&(_, dot)| dot == b'#') {
                let (along, down) = ((left + column as i64) * scale, row as i64 * scale);
                for i in 0..scale * scale {
                    let (along, down) = (along + i % scale, down + i / scale);
                    let [x, y] = match turn {
                        Turn::Right => [at[0] + along, at[1] + down],
                        Turn::Up => [at[0] + down, at[1] - along],
                    };
                    put(picture, x, y, color);
                }
            }
        }
        left += i64::from(columns(glyph) + GAP_PX);
    }
}

/// `text` cut to `limit_px` at `scale`, with two dots where letters are missing.
pub fn shortened(text: &str, limit_px: u32, scale: u32) -> String {
    if width_px(text, scale) <= limit_px {
        return text.to_owned();
    }
    let mut kept: Vec<char> = text.chars().collect();
    loop {
        let cut: String = kept.iter().chain(&['.', '.']).collect();
        if width_px(&cut, scale) <= limit_px || kept.pop().is_none() {
            return cut;
        }
    }
}

fn put(picture: &mut RgbImage, x: i64, y: i64, color: [u8; 3]) {
    if (0..i64::from(picture.width())).contains(&x) && (0..i64::from(picture.height())).contains(&y) {
        picture.put_pixel(x as u32, y as u32, Rgb(color));
    }
}

fn columns(glyph: &str) -> u32 {
    glyph.find('/').unwrap_or(glyph.len()) as u32
}

fn glyph(c: char) -> &'static str {
    match c {
        ' '..='~' => ASCII[c as usize - 32],
        '\u{2012}'..='\u{2015}' | '\u{2212}' => ASCII['-' as usize - 32],
        '\u{a0}' => ASCII[0],
        _ => BEYOND.iter().find(|(b, _)| *b == c).map_or(UNKNOWN, |(_, glyph)| glyph),
    }
}

const BEYOND: [(char, &str); 12] = [
    ('\u{b0}', ".#./#.#/.#."),
    ('\u{b1}', "...../..#../..#../#####/..#../..#../#####"),
    ('\u{b2}', "##./..#/.#./###"),
    ('\u{b3}', "##./.##/..#/##."),
    ('\u{b5}', "..../..../#..#/#..#/#..#/#..#/###./#.../#..."),
    ('\u{b7}', "../../../##/##"),
    ('\u{d7}', "..../..../#..#/.##./.##./#..#"),
    ('\u{e7}', "..../..../.###/#.../#.../#.../.###/..#./.##."),
    ('\u{2192}', "....../....../...#../....#./######/....#./...#.."),
    ('\u{2264}', "...#/..#./.#../..#./...#/..../####"),
    ('\u{2265}', "#.../.#../..#./.#../#.../..../####"),
    ('\u{2026}', "...../...../...../...../...../...../#.#.#"),
];

#[rustfmt::skip]
const ASCII: [&str; 95] = [
    /*   */ "...",
    /* ! */ "#/#/#/#/#/./#",
    /* " */ "#.#/#.#/#.#",
    /* # */ ".#.#./.#.#./#####/.#.#./#####/.#.#./.#.#.",
    /* $ */ "..#../.####/#.#../.###./..#.#/####./..#..",
    /* % */ "##..#/##..#/...#./..#../.#.../#..##/#..##",
    /* & */ ".##../#..#./#.#../.#.../#.#.#/#..#./.##.#",
    /* ' */ "#/#/#",
    /* ( */ "..#/.#./#../#../#../.#./..#",
    /* ) */ "#../.#./..#/..#/..#/.#./#..",
    /* * */ "...../#.#.#/.###./#####/.###./#.#.#",
    /* + */ "...../..#../..#../#####/..#../..#..",
    /* , */ "../../../../../.#/.#/#.",
    /* - */ "..../..../..../####",
    /* . */ "./././././#/#",
    /* / */ "....#/...#./...#./..#../.#.../.#.../#....",
    /* 0 */ ".###./#...#/#..##/#.#.#/##..#/#...#/.###.",
    /* 1 */ "..#../.##../#.#../..#../..#../..#../#####",
    /* 2 */ ".###./#...#/....#/...#./..#../.#.../#####",
    /* 3 */ "####./....#/....#/..##./....#/....#/####.",
    /* 4 */ "...#./..##./.#.#./#..#./#####/...#./...#.",
    /* 5 */ "#####/#..../####./....#/....#/#...#/.###.",
    /* 6 */ "..##./.#.../#..../####./#...#/#...#/.###.",
    /* 7 */ "#####/....#/...#./...#./..#../..#../..#..",
    /* 8 */ ".###./#...#/#...#/.###./#...#/#...#/.###.",
    /* 9 */ ".###./#...#/#...#/.####/....#/...#./.##..",
    /* : */ "././#/./././#",
    /* ; */ "../../.#/../../../.#/#.",
    /* < */ ".../..#/.#./#../.#./..#",
    /* = */ "..../..../####/..../####",
    /* > */ ".../#../.#./..#/.#./#..",
    /* ? */ ".###./#...#/....#/..##./..#../...../..#..",
    /* @ */ ".####./#....#/#.##.#/#.#.##/#.###./#...../.####.",
    /* A */ "..#../.#.#./#...#/#...#/#####/#...#/#...#",
    /* B */ "####./#...#/#...#/####./#...#/#...#/####.",
    /* C */ ".####/#..../#..../#..../#..../#..../.####",
    /* D */ "###../#..#./#...#/#...#/#...#/#..#./###..",
    /* E */ "#####/#..../#..../####./#..../#..../#####",
    /* F */ "#####/#..../#..../####./#..../#..../#....",
    /* G */ ".####/#..../#..../#..##/#...#/#...#/.####",
    /* H */ "#...#/#...#/#...#/#####/#...#/#...#/#...#",
    /* I */ "###/.#./.#./.#./.#./.#./###",
    /* J */ "..##/...#/...#/...#/...#/#..#/.##.",
    /* K */ "#...#/#..#./#.#../##.../#.#../#..#./#...#",
    /* L */ "#.../#.../#.../#.../#.../#.../####",
    /* M */ "#...#/##.##/#.#.#/#.#.#/#...#/#...#/#...#",
    /* N */ "#...#/##..#/##..#/#.#.#/#..##/#..##/#...#",
    /* O */ ".###./#...#/#...#/#...#/#...#/#...#/.###.",
    /* P */ "####./#...#/#...#/####./#..../#..../#....",
    /* Q */ ".###./#...#/#...#/#...#/#.#.#/#..#./.##.#",
    /* R */ "####./#...#/#...#/####./#.#../#..#./#...#",
    /* S */ ".####/#..../#..../.###./....#/....#/####.",
    /* T */ "#####/..#../..#../..#../..#../..#../..#..",
    /* U */ "#...#/#...#/#...#/#...#/#...#/#...#/.###.",
    /* V */ "#...#/#...#/#...#/#...#/.#.#./.#.#./..#..",
    /* W */ "#...#/#...#/#...#/#.#.#/#.#.#/##.##/#...#",
    /* X */ "#...#/#...#/.#.#./..#../.#.#./#...#/#...#",
    /* Y */ "#...#/#...#/.#.#./..#../..#../..#../..#..",
    /* Z */ "#####/....#/...#./..#../.#.../#..../#####",
    /* [ */ "##/#./#./#./#./#./##",
    /* \ */ "#..../.#.../.#.../..#../...#./...#./....#",
    /* ] */ "##/.#/.#/.#/.#/.#/##",
    /* ^ */ "..#../.#.#./#...#",
    /* _ */ "...../...../...../...../...../...../...../#####",
    /* ` */ "#./.#",
    /* a */ "...../...../.###./....#/.####/#...#/.####",
    /* b */ "#..../#..../####./#...#/#...#/#...#/####.",
    /* c */ "..../..../.###/#.../#.../#.../.###",
    /* d */ "....#/....#/.####/#...#/#...#/#...#/.####",
    /* e */ "...../...../.###./#...#/#####/#..../.###.",
    /* f */ "..##/.#../####/.#../.#../.#../.#..",
    /* g */ "...../...../.####/#...#/#...#/#...#/.####/....#/.###.",
    /* h */ "#..../#..../####./#...#/#...#/#...#/#...#",
    /* i */ "#/./#/#/#/#/#",
    /* j */ "..#/.../..#/..#/..#/..#/..#/..#/##.",
    /* k */ "#.../#.../#..#/#.#./##../#.#./#..#",
    /* l */ "#./#./#./#./#./#./.#",
    /* m */ "...../...../##.#./#.#.#/#.#.#/#.#.#/#.#.#",
    /* n */ "...../...../####./#...#/#...#/#...#/#...#",
    /* o */ "...../...../.###./#...#/#...#/#...#/.###.",
    /* p */ "...../...../####./#...#/#...#/#...#/####./#..../#....",
    /* q */ "...../...../.####/#...#/#...#/#...#/.####/....#/....#",
    /* r */ "..../..../#.##/##../#.../#.../#...",
    /* s */ "..../..../.###/#.../.##./...#/###.",
    /* t */ ".#../.#../####/.#../.#../.#../..##",
    /* u */ "...../...../#...#/#...#/#...#/#...#/.####",
    /* v */ "...../...../#...#/#...#/.#.#./.#.#./..#..",
    /* w */ "...../...../#...#/#.#.#/#.#.#/#.#.#/.#.#.",
    /* x */ "...../...../#...#/.#.#./..#../.#.#./#...#",
    /* y */ "...../...../#...#/#...#/#...#/#...#/.####/....#/.###.",
    /* z */ "..../..../####/...#/.##./#.../####",
    /* { */ "..#/.#./.#./#../.#./.#./..#",
    /* | */ "#/#/#/#/#/#/#/#/#",
    /* } */ "#../.#./.#./..#/.#./.#./#..",
    /* ~ */ "...../...../.#..#/#.#.#/#..#.",
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_glyph_is_a_rectangle_of_its_own_shape() {
        let mut seen: Vec<&str> = ASCII.iter().copied().chain(BEYOND.iter().map(|b| b.1)).chain([UNKNOWN]).collect();
        for glyph in &seen {
            assert!(glyph.split('/').all(|row| row.len() as u32 == columns(glyph)), "{glyph}");
            assert!(glyph.split('/').count() as u32 <= ROWS_PX, "{glyph}");
            assert!(glyph.bytes().all(|b| b"#./".contains(&b)), "{glyph}");
        }
        let count = seen.len();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen.len(), count, "two letters look the same");
    }

    #[test]
    fn digits_are_equally_wide_so_that_columns_of_numbers_align() {
        assert!(('0'..='9').all(|c| columns(glyph(c)) == 5));
        assert_eq!(width_px("10", 2), 22);
        assert_eq!(width_px("", 3), 0);
    }

    #[test]
    fn letters_stay_inside_their_width_and_are_cut_by_the_border() {
        let mut picture = RgbImage::new(40, 20);
        write(&mut picture, "Hg", [2, 3], 2, Turn::Right, [255; 3]);
        let lit: Vec<_> = picture.enumerate_pixels().filter(|p| p.2.0 != [0; 3]).map(|p| (p.0, p.1)).collect();
        assert_eq!(lit.iter().map(|p| p.0).min(), Some(2));
        assert_eq!(lit.iter().map(|p| p.0).max(), Some(2 + width_px("Hg", 2) - 1));
        assert_eq!(lit.iter().map(|p| p.1).max(), Some(19), "the foot of g is cut at row 20");
        write(&mut picture, "far away", [-1000, 1_000_000], 3, Turn::Up, [255; 3]);
    }

    #[test]
    fn long_texts_are_cut_to_the_room_they_have() {
        assert_eq!(shortened("roof", 100, 1), "roof");
        let cut = shortened("a title that is far too long", 60, 1);
        assert!(cut.ends_with("..") && width_px(&cut, 1) <= 60, "{cut}");
    }
}
