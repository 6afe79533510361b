//! Lines, names and numbers of the text formats, as bytes: no encoding is assumed and none is refused.
//!
//! Lines end in LF, CRLF or CR; a `\` at the end of a line joins the next one, except in a comment, where exporters
//! write Windows folders. Knows nothing about what a line means.

use memchr::memchr2;

/// The longest line read, bytes. Real polygons stay far below; a file without line ends would be read whole.
pub const LINE_LIMIT_BYTES: usize = 1 << 20;

/// Calls `take` with the number (from 1) and the bytes of every logical line; returns the number of physical lines.
///
/// # Errors
/// The byte offset of the first line over [`LINE_LIMIT_BYTES`].
pub fn for_each_line(bytes: &[u8], mut take: impl FnMut(u32, &[u8])) -> Result<u32, usize> {
    let (mut at, mut number) = (0, 0);
    let (mut joined, mut joined_from) = (Vec::new(), 0);
    while at < bytes.len() {
        let rest = &bytes[at..];
        let end = memchr2(b'\n', b'\r', rest).unwrap_or(rest.len());
        let line = &rest[..end];
        if line.len() + joined.len() > LINE_LIMIT_BYTES {
            return Err(at);
        }
        number += 1;
        at += end + if rest[end..].starts_with(b"\r\n") { 2 } else { 1 };
        let head = line.strip_suffix(b"\\");
        if joined.is_empty() {
            if head.is_none() || trim_start(line).first() == Some(&b'#') {
                take(number, line);
                continue;
            }
            joined_from = number;
        }
        joined.extend_from_slice(head.unwrap_or(line));
        if head.is_some() {
            joined.push(b' ');
        } else {
            take(joined_from, &joined);
            joined.clear();
        }
    }
    if !joined.is_empty() {
        take(joined_from, &joined);
    }
    Ok(number)
}

/// The first offset in `bytes` at which a logical line is sure to begin, or `None` if more bytes are needed.
///
/// The first line end may close a line that was begun before `bytes`, so the cut comes after the next whole line
/// that is not continued.
pub fn first_sure_line_start(bytes: &[u8]) -> Option<usize> {
    let mut begin = next_line(bytes, 0)?;
    loop {
        let after = next_line(bytes, begin)?;
        let line = bytes[begin..after].trim_ascii_end();
        if line.last() != Some(&b'\\') {
            return Some(after);
        }
        begin = after;
    }
}

fn next_line(bytes: &[u8], from: usize) -> Option<usize> {
    let end = from + memchr2(b'\n', b'\r', &bytes[from..])?;
    match (bytes[end], bytes.get(end + 1)) {
        (b'\n', _) => Some(end + 1),
        // The LF of a CRLF may lie just past the window.
        (_, None) => None,
        (_, Some(b'\n')) => Some(end + 2),
        _ => Some(end + 1),
    }
}

/// How a file says it is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// ASCII, UTF-8 or any 8-bit code page, after a mark of this many bytes.
    Bytes(usize),
    /// UTF-16, big-endian if true, after a mark of two bytes.
    Utf16(bool),
}

impl Encoding {
    /// Reads the byte order mark, if there is one.
    pub fn of(bytes: &[u8]) -> Self {
        match bytes {
            [0xEF, 0xBB, 0xBF, ..] => Self::Bytes(3),
            [0xFF, 0xFE, ..] => Self::Utf16(false),
            [0xFE, 0xFF, ..] => Self::Utf16(true),
            _ => Self::Bytes(0),
        }
    }
}

/// The bytes without their mark, UTF-16 turned into UTF-8.
pub fn decoded(bytes: Vec<u8>) -> Vec<u8> {
    match Encoding::of(&bytes) {
        Encoding::Bytes(0) => bytes,
        Encoding::Bytes(mark) => bytes[mark..].to_vec(),
        Encoding::Utf16(big) => {
            let unit = |pair: &[u8]| match big {
                true => u16::from_be_bytes([pair[0], pair[1]]),
                false => u16::from_le_bytes([pair[0], pair[1]]),
            };
            let units = bytes[2..].chunks_exact(2).map(unit);
            let text: String = char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect();
            text.into_bytes()
        }
    }
}

/// Bytes as text: UTF-8 where it is that, else Latin-1, so that every byte survives.
pub fn text(bytes: &[u8]) -> String {
    match std::str::from_utf8(bytes) {
        Ok(text) => text.to_owned(),
        Err(_) => bytes.iter().map(|&b| char::from(b)).collect(),
    }
}

/// Blank, tab, vertical tab, form feed; line ends are gone before this is asked.
pub fn is_space(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t' | 0x0B | 0x0C)
}

/// Without leading blanks.
pub fn trim_start(mut line: &[u8]) -> &[u8] {
    while let [first, rest @ ..] = line
        && is_space(*first)
    {
        line = rest;
    }
    line
}

/// Without leading and trailing blanks.
pub fn trim(line: &[u8]) -> &[u8] {
    let mut line = trim_start(line);
    while let [rest @ .., last] = line
        && is_space(*last)
    {
        line = rest;
    }
    line
}

/// The first word of a line and what follows it, trimmed at its start.
pub fn split_word(line: &[u8]) -> (&[u8], &[u8]) {
    let line = trim_start(line);
    let end = line.iter().position(|&b| is_space(b)).unwrap_or(line.len());
    (&line[..end], trim_start(&line[end..]))
}

/// A name without the comment behind it. A `#` that begins the name or stands inside a word belongs to it.
pub fn without_comment(name: &[u8]) -> &[u8] {
    let comment = (1..name.len()).find(|&i| name[i] == b'#' && is_space(name[i - 1]));
    trim(&name[..comment.unwrap_or(name.len())])
}

/// The numbers of a line, up to its end or a comment. What is not a number comes out as NaN.
pub struct Numbers<'a>(pub &'a [u8]);

impl Iterator for Numbers<'_> {
    type Item = f64;

    fn next(&mut self) -> Option<f64> {
        let line = trim_start(self.0);
        if line.first().is_none_or(|&b| b == b'#') {
            return None;
        }
        if let Ok((value, used)) = fast_float2::parse_partial::<f64, _>(line)
            && line.get(used).is_none_or(|&b| is_space(b))
        {
            self.0 = &line[used..];
            return Some(value);
        }
        self.0 = split_word(line).1;
        Some(f64::NAN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(bytes: &[u8]) -> Vec<(u32, String)> {
        let mut found = Vec::new();
        for_each_line(bytes, |n, line| found.push((n, text(line)))).unwrap();
        found
    }

    #[test]
    fn all_three_line_ends_are_one_line_each() {
        let expected: Vec<_> = [(1, "a"), (2, "b"), (3, "c"), (4, "d")].map(|(n, s)| (n, s.to_owned())).into();
        assert_eq!(lines(b"a\nb\r\nc\rd"), expected);
    }

    #[test]
    fn a_backslash_joins_lines_but_not_out_of_a_comment() {
        let found = lines(b"f 1 \\\r\n2 3\n# C:\\folder\\\nv 1");
        assert_eq!(found[0], (1, "f 1  2 3".into()));
        assert_eq!(found[1], (3, "# C:\\folder\\".into()));
        assert_eq!(found[2], (4, "v 1".into()));
    }

    #[test]
    fn a_line_over_the_limit_is_an_error_also_when_continued() {
        assert_eq!(for_each_line(&vec![b'a'; LINE_LIMIT_BYTES], |_, _| ()), Ok(1));
        assert_eq!(for_each_line(&vec![b'a'; LINE_LIMIT_BYTES + 1], |_, _| ()), Err(0));
        let long = b"aaaaaaa\\\n".repeat(LINE_LIMIT_BYTES / 8 + 2);
        assert!(for_each_line(&long, |_, _| ()).is_err());
    }

    #[test]
    fn a_cut_never_falls_into_a_continued_line_or_a_crlf() {
        assert_eq!(first_sure_line_start(b"tail\nwhole\nx"), Some(11));
        assert_eq!(first_sure_line_start(b"tail\\\nmore\\\r\nend\nx"), Some(17));
        assert_eq!(first_sure_line_start(b"tail\r\nwhole\r\nx"), Some(13));
        assert_eq!(first_sure_line_start(b"tail\rwhole\r"), None);
        assert_eq!(first_sure_line_start(b"tail\n"), None);
    }

    #[test]
    fn numbers_in_every_usual_spelling_are_read_and_the_rest_is_nan() {
        let read: Vec<f64> = Numbers(b" +1 -2. .5 1e2 .8e-001 2.E+1\t007 # 9").collect();
        assert_eq!(read, [1.0, -2.0, 0.5, 100.0, 0.08, 20.0, 7.0]);
        assert!(Numbers(b"1,5 1.#IND 3.1+e2 0x10 abc - + e5 1e400 nan -inf").all(|n| !n.is_finite()));
        assert_eq!(Numbers(b"1,5 1.#IND abc 4").count(), 4);
    }

    #[test]
    fn latin_1_and_utf_16_become_text() {
        assert_eq!(text(b"caf\xe9"), "café");
        assert_eq!(decoded(b"\xFE\xFF\0v\0 \x20\xAC".to_vec()), "v €".as_bytes());
        assert_eq!(decoded(b"\xFF\xFEv\0 \0\xAC\x20".to_vec()), "v €".as_bytes());
        assert_eq!(decoded(b"\xEF\xBB\xBFv".to_vec()), b"v");
    }
}
