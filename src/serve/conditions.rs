//! Which part of a body a request wants, if any: entity tags and byte ranges (RFC 9110, sections 13 and 14).

use std::ops::Range;

use axum::http::{HeaderMap, HeaderName, header};

/// What to send of a body.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Wanted {
    /// 200.
    Whole,
    /// 206: these bytes.
    Part(Range<u64>),
    /// 304.
    NotModified,
    /// 412.
    Failed,
    /// 416.
    Unsatisfiable,
}

/// Weighs the conditions of a GET (`ranges`: HEAD has none) against a body of `bytes` bytes tagged `etag`.
pub(super) fn weigh(headers: &HeaderMap, etag: &str, bytes: u64, ranges: bool) -> Wanted {
    let if_match: Vec<&str> = values(headers, header::IF_MATCH);
    if !if_match.is_empty() && !if_match.iter().any(|tag| *tag == "*" || *tag == etag) {
        return Wanted::Failed;
    }
    // If-None-Match compares weakly: a proxy may have marked our strong tag `W/`.
    let if_none_match = values(headers, header::IF_NONE_MATCH);
    if if_none_match.iter().any(|tag| *tag == "*" || tag.strip_prefix("W/").unwrap_or(tag) == etag) {
        return Wanted::NotModified;
    }
    // If-Range compares strongly; a date never equals, as we send none.
    let stale = headers.get(header::IF_RANGE).is_some_and(|tag| tag.as_bytes() != etag.as_bytes());
    match headers.get(header::RANGE) {
        Some(range) if ranges && !stale => part(range.as_bytes(), bytes),
        _ => Wanted::Whole,
    }
}

/// The members of a comma-separated header, over all its lines. Our tags hold no comma.
fn values(headers: &HeaderMap, name: HeaderName) -> Vec<&str> {
    let lines = headers.get_all(name).into_iter().filter_map(|line| line.to_str().ok());
    lines.flat_map(|line| line.split(',')).map(str::trim).filter(|value| !value.is_empty()).collect()
}

/// Reads `bytes=first-last`, `bytes=first-` or `bytes=-suffix`; other units and several ranges mean the whole.
fn part(range: &[u8], bytes: u64) -> Wanted {
    let Some((unit, set)) = std::str::from_utf8(range).ok().and_then(|text| text.split_once('=')) else {
        return Wanted::Unsatisfiable;
    };
    if !unit.trim().eq_ignore_ascii_case("bytes") || set.contains(',') {
        return Wanted::Whole;
    }
    let Some((first, last)) = set.trim().split_once('-') else {
        return Wanted::Unsatisfiable;
    };
    let range = match (first.is_empty(), last.is_empty()) {
        (true, false) => number(last).map(|suffix| bytes.saturating_sub(suffix)..bytes),
        (false, true) => number(first).map(|first| first..bytes),
        (false, false) => match (number(first), number(last)) {
            (Some(first), Some(last)) if first <= last => Some(first..bytes.min(last.saturating_add(1))),
            _ => None,
        },
        (true, true) => None,
    };
    match range {
        Some(range) if range.start < range.end => Wanted::Part(range),
        _ => Wanted::Unsatisfiable,
    }
}

/// Digits only; a number past `u64` is simply past every end.
fn number(text: &str) -> Option<u64> {
    let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    digits.then(|| text.parse().unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(HeaderName, &str)]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(name.clone(), value.parse().unwrap());
        }
        headers
    }

    #[test]
    fn every_form_of_a_range_is_read_as_the_rfc_says() {
        let cases = [
            ("bytes=0-3", Wanted::Part(0..4)),
            ("bytes=4-", Wanted::Part(4..10)),
            ("bytes=-3", Wanted::Part(7..10)),
            ("bytes=-30", Wanted::Part(0..10)),
            ("bytes=9-9", Wanted::Part(9..10)),
            ("bytes=5-100", Wanted::Part(5..10)),
            ("bytes=0-99999999999999999999999", Wanted::Part(0..10)),
            ("BYTES= 0-3", Wanted::Part(0..4)),
            ("bytes=10-", Wanted::Unsatisfiable),
            ("bytes=10-20", Wanted::Unsatisfiable),
            ("bytes=99999999999999999999999-", Wanted::Unsatisfiable),
            ("bytes=-0", Wanted::Unsatisfiable),
            ("bytes=5-4", Wanted::Unsatisfiable),
            ("bytes=-", Wanted::Unsatisfiable),
            ("bytes=", Wanted::Unsatisfiable),
            ("bytes", Wanted::Unsatisfiable),
            ("bytes=a-b", Wanted::Unsatisfiable),
            ("bytes=+1-3", Wanted::Unsatisfiable),
            ("bytes=1--3", Wanted::Unsatisfiable),
            ("bytes=0-1,3-4", Wanted::Whole),
            ("tiles=0-1", Wanted::Whole),
        ];
        for (range, wanted) in cases {
            assert_eq!(part(range.as_bytes(), 10), wanted, "{range}");
        }
        assert_eq!(part(b"bytes=0-", 0), Wanted::Unsatisfiable, "an empty body has no byte 0");
        assert_eq!(part(b"bytes=\xff-", 10), Wanted::Unsatisfiable);
    }

    #[test]
    fn a_known_tag_is_not_sent_again() {
        let ask = |tag: &str| weigh(&headers(&[(header::IF_NONE_MATCH, tag)]), "\"a\"", 10, true);
        for tag in ["\"a\"", "*", "W/\"a\"", "\"b\", \"a\""] {
            assert_eq!(ask(tag), Wanted::NotModified, "{tag}");
        }
        for tag in ["\"b\"", "a", "\"A\""] {
            assert_eq!(ask(tag), Wanted::Whole, "{tag}");
        }
        let two = headers(&[(header::IF_NONE_MATCH, "\"b\""), (header::IF_NONE_MATCH, "\"a\"")]);
        assert_eq!(weigh(&two, "\"a\"", 10, true), Wanted::NotModified);
    }

    #[test]
    fn a_range_of_another_version_is_answered_with_the_whole() {
        let ask = |tag: &str| {
            let headers = headers(&[(header::RANGE, "bytes=1-2"), (header::IF_RANGE, tag)]);
            weigh(&headers, "\"a\"", 10, true)
        };
        assert_eq!(ask("\"a\""), Wanted::Part(1..3));
        for tag in ["\"b\"", "W/\"a\"", "Sat, 21 Nov 2026 10:00:00 GMT"] {
            assert_eq!(ask(tag), Wanted::Whole, "{tag}");
        }
    }

    #[test]
    fn if_match_fails_on_another_version() {
        let ask = |tag: &str| weigh(&headers(&[(header::IF_MATCH, tag)]), "\"a\"", 10, true);
        assert_eq!(ask("\"b\""), Wanted::Failed);
        assert_eq!(ask("W/\"a\""), Wanted::Failed);
        assert_eq!(ask("\"a\""), Wanted::Whole);
        assert_eq!(ask("*"), Wanted::Whole);
    }

    #[test]
    fn a_head_request_has_no_range() {
        let asked = headers(&[(header::RANGE, "bytes=1-2")]);
        assert_eq!(weigh(&asked, "\"a\"", 10, false), Wanted::Whole);
    }
}
