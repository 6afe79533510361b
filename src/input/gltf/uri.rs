//! URIs as bytes: `data:` payloads and %-escapes.

/// True for a URI that carries its bytes itself.
pub fn is_data(uri: &str) -> bool {
    uri.get(..5).is_some_and(|scheme| scheme.eq_ignore_ascii_case("data:"))
}

/// Media type and bytes of a base64 `data:` URI; never more than 3/4 of its text. `None` if it is not base64.
pub fn data(uri: &str) -> Option<(&str, Vec<u8>)> {
    let (head, payload) = uri.get(5..)?.split_once(',')?;
    let media = head.strip_suffix(";base64")?;
    Some((media, base64(payload.as_bytes())?))
}

/// Decodes RFC 4648 base64, either alphabet, with or without padding, spaces skipped.
fn base64(text: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let (mut bits, mut held) = (0u32, 0u32);
    let end = text.iter().rposition(|&b| b != b'=' && !b.is_ascii_whitespace()).map_or(0, |last| last + 1);
    for &byte in &text[..end] {
        let digit = match byte {
            b'A'..=b'Z' => byte - b'A',
            b'a'..=b'z' => byte - b'a' + 26,
            b'0'..=b'9' => byte - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            b' ' | b'\t' | b'\r' | b'\n' => continue,
            _ => return None,
        };
        bits = bits << 6 | u32::from(digit);
        held += 6;
        if held >= 8 {
            held -= 8;
            bytes.push((bits >> held) as u8);
        }
    }
    // One digit left over is six bits of nothing: the text was cut.
    (held < 6).then_some(bytes)
}

/// `%41` becomes `A`; an escape that is none stays as it is. `None` if the result is not UTF-8.
pub fn percent_decode(uri: &str) -> Option<String> {
    let text = uri.as_bytes();
    let hex = |at: usize| text.get(at).and_then(|&b| (b as char).to_digit(16));
    let mut bytes = Vec::with_capacity(text.len());
    let mut at = 0;
    while at < text.len() {
        match (text[at], hex(at + 1), hex(at + 2)) {
            (b'%', Some(high), Some(low)) => {
                bytes.push((high << 4 | low) as u8);
                at += 3;
            }
            (byte, ..) => {
                bytes.push(byte);
                at += 1;
            }
        }
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_follows_the_rfc_and_refuses_the_rest() {
        for (text, bytes) in [("", ""), ("Zg==", "f"), ("Zm8=", "fo"), ("Zm9v", "foo"), ("Zm9vYg", "foob")] {
            assert_eq!(base64(text.as_bytes()).as_deref(), Some(bytes.as_bytes()), "{text}");
        }
        assert_eq!(base64(b"-_8="), Some(vec![0xFB, 0xFF]));
        assert_eq!(base64(b"Zm9vY"), None);
        assert_eq!(base64(b"Zm*v"), None);
        assert_eq!(data("data:application/octet-stream;base64,Zg=="), Some(("application/octet-stream", vec![b'f'])));
        assert_eq!(data("data:text/plain,hello"), None);
    }

    #[test]
    fn escapes_are_decoded_once_and_bad_utf8_is_refused() {
        assert_eq!(percent_decode("a%20b%2520%"), Some("a b%20%".into()));
        assert_eq!(percent_decode("%ff%fe.bin"), None);
    }
}
