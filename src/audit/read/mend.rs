//! JSON as exporters write it, brought to what the standard says: one slip must not lose a tileset.
//!
//! # Method
//! 1. as it stands, without a byte order mark
//! 2. if that fails: UTF-16 and broken UTF-8 are decoded, comments and commas before a closing bracket dropped, lone
//!    backslashes in strings doubled, numbers that JSON has not (`NaN`, `inf`, `+1`, `.5`) written as it has them or as
//!    null; of keys that stand twice the last counts
//!
//! Members of a wrong type count as missing: see the readers at the end.

use std::borrow::Cow;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer};
use serde_json::Value;

use super::json::Content;

/// Reads `bytes`; true if they had to be mended.
pub fn read<T: DeserializeOwned>(bytes: &[u8]) -> serde_json::Result<(T, bool)> {
    let plain = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    serde_json::from_slice(plain).map(|found| (found, false)).or_else(|error| {
        let mended: serde_json::Result<T> = serde_json::from_str::<Value>(&mend(bytes)).and_then(T::deserialize);
        // What is wrong with the file as it stands says more than what is wrong with a guess.
        mended.map(|found| (found, true)).map_err(|_| error)
    })
}

fn mend(bytes: &[u8]) -> String {
    let text = decoded(bytes);
    let text = text.trim_end_matches(|c: char| c == '\0' || c.is_whitespace());
    let mut rest = text;
    let mut into = String::with_capacity(text.len());
    while let Some(c) = rest.chars().next() {
        let length = match c {
            '"' => string(rest, &mut into),
            '/' => comment(rest),
            ',' if is_last(&rest[1..]) => 1,
            _ if is_word(c) => word(rest, &mut into),
            _ => {
                into.push(c);
                c.len_utf8()
            }
        };
        rest = &rest[length..];
    }
    into
}

fn decoded(bytes: &[u8]) -> Cow<'_, str> {
    let wide = |of: fn([u8; 2]) -> u16| {
        let units = bytes[2..].chunks_exact(2).map(move |pair| of([pair[0], pair[1]]));
        char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect::<String>().into()
    };
    match bytes {
        [0xFF, 0xFE, ..] => wide(u16::from_le_bytes),
        [0xFE, 0xFF, ..] => wide(u16::from_be_bytes),
        _ => String::from_utf8_lossy(bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes)),
    }
}

/// Copies the string that `rest` begins with; says how long it was.
fn string(rest: &str, into: &mut String) -> usize {
    into.push('"');
    let mut chars = rest.char_indices().skip(1);
    while let Some((at, c)) = chars.next() {
        match c {
            '"' => {
                into.push('"');
                return at + 1;
            }
            '\\' => match chars.next() {
                Some((_, next)) if "\"\\/bfnrtu".contains(next) => into.extend(['\\', next]),
                Some((_, next)) => into.extend(['\\', '\\', next]),
                None => {}
            },
            c if c < ' ' => into.push_str(&format!("\\u{:04x}", c as u32)),
            c => into.push(c),
        }
    }
    rest.len()
}

/// The length of the comment that `rest` begins with; of a lone slash 1.
fn comment(rest: &str) -> usize {
    if rest.starts_with("//") {
        return rest.find('\n').unwrap_or(rest.len());
    }
    if rest.starts_with("/*") {
        return rest.find("*/").map_or(rest.len(), |end| end + 2);
    }
    1
}

/// True if a bracket closes next.
fn is_last(mut rest: &str) -> bool {
    loop {
        rest = rest.trim_start();
        match rest.as_bytes() {
            [b'/', b'/' | b'*', ..] => rest = &rest[comment(rest)..],
            [b'}' | b']', ..] => return true,
            _ => return false,
        }
    }
}

fn is_word(c: char) -> bool {
    c.is_ascii_alphanumeric() || "+-.#_".contains(c)
}

/// Copies the number or name that `rest` begins with, or null for what is none; says how long it was.
fn word(rest: &str, into: &mut String) -> usize {
    let end = rest.find(|c| !is_word(c)).unwrap_or(rest.len());
    let word = &rest[..end];
    let is_json = serde_json::from_str::<Value>(word).is_ok();
    let number = word.parse::<f64>().ok().filter(|n| n.is_finite());
    match number {
        _ if is_json => into.push_str(word),
        Some(number) => into.push_str(&serde_json::json!(number).to_string()),
        None => into.push_str("null"),
    }
    end
}

/// A number, also as text.
pub fn number<'de, D: Deserializer<'de>>(from: D) -> Result<Option<f64>, D::Error> {
    Ok(as_number(&Value::deserialize(from)?))
}

/// Numbers; NaN where one is none, so that the others keep their places.
pub fn numbers<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Vec<f64>>, D::Error> {
    let Value::Array(all) = Value::deserialize(from)? else { return Ok(None) };
    Ok(Some(all.iter().map(|value| as_number(value).unwrap_or(f64::NAN)).collect()))
}

/// Text, also as a number.
pub fn text<'de, D: Deserializer<'de>>(from: D) -> Result<Option<String>, D::Error> {
    Ok(match Value::deserialize(from)? {
        Value::String(text) => Some(text),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    })
}

/// Whatever it is to be, or nothing.
pub fn loose<'de, D: Deserializer<'de>, T: DeserializeOwned>(from: D) -> Result<Option<T>, D::Error> {
    Ok(T::deserialize(Value::deserialize(from)?).ok())
}

/// A content, also as its URI alone.
pub fn content<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Content>, D::Error> {
    Ok(match Value::deserialize(from)? {
        Value::String(uri) => Some(Content { uri: Some(uri), ..Content::default() }),
        other => Content::deserialize(other).ok(),
    })
}

fn as_number(value: &Value) -> Option<f64> {
    match value {
        Value::Number(number) => number.as_f64(),
        Value::String(text) => text.trim().parse().ok().filter(|number: &f64| number.is_finite()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn what_is_no_json_is_read_as_it_was_meant() {
        let said = br#"{ "a": [1, NaN, -Infinity, +2, .5, 1.#QNAN, 1e999,], // three
            "b": "Data\Tile\u0041\"", /* , ] */ "c": tru, "a2": [true,false,null , ] , }"#;
        let (found, is_mended) = read::<Value>(said).unwrap();
        assert!(is_mended);
        assert_eq!(
            found,
            json!({ "a": [1, null, null, 2.0, 0.5, null, null], "b": "Data\\TileA\"", "c": null, "a2": [true, false, null] })
        );
    }

    #[test]
    fn other_encodings_are_decoded_and_sound_json_is_left_alone() {
        let wide: Vec<u8> = "\u{FEFF}{\"a\":\"屋\"}".encode_utf16().flat_map(u16::to_le_bytes).collect();
        assert_eq!(read::<Value>(&wide).unwrap(), (json!({ "a": "屋" }), true));
        assert_eq!(read::<Value>(b"\xEF\xBB\xBF[1]").unwrap(), (json!([1]), false));
        // GB 18030, as some write it: the name is lost, the rest is not.
        let (found, _) = read::<Value>(b"{\"a\":\"\xCE\xDD\",\"b\":1}\0\0").unwrap();
        assert_eq!(found["b"], 1);
    }

    #[test]
    fn what_cannot_be_mended_is_told_of_as_it_stands() {
        for said in [&b"{\"a\":"[..], b"", b"\"", b"{\"a\" 1}", b"/*", b"[1", b"\xFF\xFE", b"\xFE\xFF{", b"\\"] {
            assert!(read::<Value>(said).is_err(), "{said:?}");
        }
    }
}
