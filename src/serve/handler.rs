//! Answers one request from the table.

use std::ops::Range;
use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::header::{self, HeaderName, HeaderValue};
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse, Response};

use super::body::{self, FileBody, Opened};
use super::conditions::{self, Wanted};
use super::index::{Entry, Site, Source};

const METHODS: HeaderValue = HeaderValue::from_static("GET, HEAD, OPTIONS");

/// Every request goes to one handler: the table is the router.
pub(super) fn router(site: Site) -> Router {
    Router::new().fallback(answer).with_state(Arc::new(site))
}

async fn answer(State(site): State<Arc<Site>>, request: Request) -> Response {
    let method = request.method();
    let mut response = if method == Method::OPTIONS {
        preflight(request.headers())
    } else if method == Method::GET || method == Method::HEAD {
        look_up(site, request.uri().path(), request.headers(), method == Method::GET).await
    } else {
        (StatusCode::METHOD_NOT_ALLOWED, [(header::ALLOW, METHODS)], "only GET, HEAD and OPTIONS\n").into_response()
    };
    let headers = response.headers_mut();
    // Tiles are for any viewer on any page.
    headers.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, HeaderValue::from_static("*"));
    let exposed = "Accept-Ranges, Content-Encoding, Content-Length, Content-Range, ETag";
    headers.insert(header::ACCESS_CONTROL_EXPOSE_HEADERS, HeaderValue::from_static(exposed));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(HeaderName::from_static("cross-origin-resource-policy"), HeaderValue::from_static("cross-origin"));
    response
}

/// Allows what a page on another origin asks leave for.
fn preflight(asked: &HeaderMap) -> Response {
    let mut response = StatusCode::NO_CONTENT.into_response();
    let headers = response.headers_mut();
    headers.insert(header::ALLOW, METHODS);
    headers.insert(header::ACCESS_CONTROL_ALLOW_METHODS, METHODS);
    headers.insert(header::ACCESS_CONTROL_MAX_AGE, HeaderValue::from_static("86400"));
    if let Some(wanted) = asked.get(header::ACCESS_CONTROL_REQUEST_HEADERS) {
        headers.insert(header::ACCESS_CONTROL_ALLOW_HEADERS, wanted.clone());
    }
    response
}

async fn look_up(site: Arc<Site>, path: &str, headers: &HeaderMap, is_get: bool) -> Response {
    let Some(path) = decode(path) else {
        return refuse(StatusCode::BAD_REQUEST, "a % is not followed by two hexadecimal digits\n");
    };
    let Some(path) = path.and_then(|path| table_key(&path)) else {
        return refuse(StatusCode::NOT_FOUND, "no such file\n");
    };
    // The file system may be slow: never wait for it on the thread that serves everybody.
    let found = tokio::task::spawn_blocking(move || find(&site, &path)).await;
    let Ok(Some((entry, opened))) = found else {
        return refuse(StatusCode::NOT_FOUND, "no such file\n");
    };
    match (&entry.source, opened) {
        (Source::Memory { bytes, etag }, _) => {
            let wanted = conditions::weigh(headers, etag, bytes.len() as u64, is_get);
            let part = |range: Range<u64>| Body::from(bytes.slice(range.start as usize..range.end as usize));
            respond(&entry, etag, bytes.len() as u64, wanted, is_get, part)
        }
        (Source::File { .. }, Some(Opened { file, bytes, etag, is_gzip })) => {
            let wanted = conditions::weigh(headers, &etag, bytes, is_get);
            let part = |range| Body::new(FileBody::new(file, range));
            let mut response = respond(&entry, &etag, bytes, wanted, is_get, part);
            if is_gzip {
                response.headers_mut().insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
            }
            response
        }
        (Source::File { .. }, None) => refuse(StatusCode::NOT_FOUND, "no such file\n"),
    }
}

/// The entry, and its file opened; blocks. A file that went away or cannot be read is as good as none.
fn find(site: &Site, path: &str) -> Option<(Arc<Entry>, Option<Opened>)> {
    site.refresh_for(path);
    let entry = site.find(path)?;
    let opened = match &entry.source {
        Source::File { path, etag } => Some(body::open(path, etag).ok().flatten()?),
        Source::Memory { .. } => None,
    };
    Some((entry, opened))
}

fn respond(
    entry: &Entry,
    etag: &str,
    bytes: u64,
    wanted: Wanted,
    is_get: bool,
    part: impl FnOnce(Range<u64>) -> Body,
) -> Response {
    let (status, range) = match wanted {
        Wanted::Whole => (StatusCode::OK, Some(0..bytes)),
        Wanted::Part(range) => (StatusCode::PARTIAL_CONTENT, Some(range)),
        Wanted::NotModified => (StatusCode::NOT_MODIFIED, None),
        Wanted::Failed => (StatusCode::PRECONDITION_FAILED, None),
        Wanted::Unsatisfiable => (StatusCode::RANGE_NOT_SATISFIABLE, None),
    };
    let mut response = status.into_response();
    let headers = response.headers_mut();
    // Text of our own making, always ASCII.
    let mut set = |name, value: String| HeaderValue::try_from(value).ok().map(|value| headers.insert(name, value));
    set(header::ETAG, etag.to_owned());
    set(header::CACHE_CONTROL, entry.cache_control.to_owned());
    set(header::ACCEPT_RANGES, "bytes".to_owned());
    match (&range, status) {
        (Some(range), StatusCode::PARTIAL_CONTENT) => {
            set(header::CONTENT_RANGE, format!("bytes {}-{}/{bytes}", range.start, range.end - 1));
        }
        (None, StatusCode::RANGE_NOT_SATISFIABLE) => {
            set(header::CONTENT_RANGE, format!("bytes */{bytes}"));
        }
        _ => {}
    }
    if let Some(range) = range {
        set(header::CONTENT_TYPE, entry.content_type.to_owned());
        set(header::CONTENT_LENGTH, (range.end - range.start).to_string());
        if is_get {
            *response.body_mut() = part(range);
        }
    }
    response
}

fn refuse(status: StatusCode, why: &'static str) -> Response {
    (status, [(header::CONTENT_TYPE, "text/plain; charset=utf-8")], why).into_response()
}

/// Undoes percent-encoding once. `None`: malformed; `Some(None)`: not text, so it names nothing we have.
fn decode(path: &str) -> Option<Option<String>> {
    let mut decoded = Vec::with_capacity(path.len());
    let mut bytes = path.bytes();
    while let Some(byte) = bytes.next() {
        if byte == b'%' {
            let mut digit = || char::from(bytes.next()?).to_digit(16);
            decoded.push((digit()? * 16 + digit()?) as u8);
        } else {
            decoded.push(byte);
        }
    }
    Some(String::from_utf8(decoded).ok())
}

/// A path as the table has it: no leading slash, and no doubled ones, which 3DTilesRendererJS makes when
/// tileset.json is at the top of a server.
fn table_key(path: &str) -> Option<String> {
    let mut key = path.strip_prefix('/')?.trim_start_matches('/').to_owned();
    while key.contains("//") {
        key = key.replace("//", "/");
    }
    Some(key)
}

#[cfg(test)]
#[path = "handler_tests.rs"]
mod tests;
