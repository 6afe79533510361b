//! Tilesets on web servers, over a small blocking client. One origin only.

use std::time::Duration;

use super::refusal::{Refusal, refuse};
use super::store::{MAX_FILE_BYTES, has_scheme, join};
use crate::input::gltf::data::shorten;

/// A server that says nothing for so long is taken to be gone.
const TIMEOUT: Duration = Duration::from_secs(60);

/// A web server, by its origin; nothing is asked of any other.
pub struct Server {
    agent: ureq::Agent,
    /// `https://host:port`.
    origin: String,
    /// Path of the tileset.json, from `/` on.
    start: String,
    /// Query of the URL named, which carries the access token of many services; sent with every request without one.
    query: String,
}

impl Server {
    /// The server of the tileset at `url`; a URL that ends in `/` means the tileset.json there.
    pub fn of(url: &str) -> Result<Self, Refusal> {
        let url = url.split('#').next().unwrap_or_default();
        let (address, query) = url.split_once('?').unwrap_or((url, ""));
        let Some((scheme, rest)) = address.split_once("://") else { return refuse("bad-uri", "is no URL") };
        let (authority, path) = rest.split_once('/').unwrap_or((rest, ""));
        let path =
            if path.is_empty() || path.ends_with('/') { format!("{path}tileset.json") } else { path.to_string() };
        let config = ureq::Agent::config_builder().timeout_global(Some(TIMEOUT)).max_redirects(3).build();
        Ok(Self {
            agent: config.into(),
            origin: format!("{scheme}://{authority}"),
            start: format!("/{path}"),
            query: query.to_string(),
        })
    }

    /// The URL of the tileset.json.
    pub fn start(&self) -> String {
        self.with_query(&self.start, "")
    }

    fn with_query(&self, path: &str, query: &str) -> String {
        let query = if query.is_empty() { &self.query } else { query };
        if query.is_empty() { format!("{}{path}", self.origin) } else { format!("{}{path}?{query}", self.origin) }
    }

    /// The URL that `uri` in the file `base` means.
    pub fn resolve(&self, base: &str, uri: &str) -> Result<String, Refusal> {
        let uri = uri.split('#').next().unwrap_or_default();
        let (path, query) = uri.split_once('?').unwrap_or((uri, ""));
        let outside = || Refusal::new("outside", format!("the URI {:?} leads to another origin", shorten(uri)));
        let local = if path.starts_with("//") {
            return Err(outside());
        } else if has_scheme(path) {
            let rest = path.strip_prefix(&self.origin).filter(|rest| rest.starts_with('/')).ok_or_else(outside)?;
            join("", rest)
        } else if path.starts_with('/') {
            join("", path)
        } else {
            let base = base.strip_prefix(&self.origin).unwrap_or(base);
            join(base.split('?').next().unwrap_or_default(), path)
        };
        let local = local.ok_or_else(outside)?;
        Ok(self.with_query(&format!("/{local}"), query))
    }

    /// The file at `url`, and its size.
    pub fn get(&self, url: &str) -> Result<(Vec<u8>, u64), Refusal> {
        let failed = |e: ureq::Error| match e {
            ureq::Error::StatusCode(404) => Refusal::new("missing", "the server answers 404".to_string()),
            other => Refusal::new("http", format!("the server answers: {other}")),
        };
        let mut response = self.agent.get(url).call().map_err(failed)?;
        let bytes = response.body_mut().with_config().limit(MAX_FILE_BYTES).read_to_vec().map_err(failed)?;
        let stored = bytes.len() as u64;
        Ok((bytes, stored))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_stay_on_their_origin_and_keep_the_token() {
        let server = Server::of("https://a.example:8080/x/y/tileset.json?token=7").unwrap();
        let base = server.start();
        assert_eq!(base, "https://a.example:8080/x/y/tileset.json?token=7");
        let resolve = |uri| server.resolve(&base, uri);
        assert_eq!(resolve("../z/1.glb").unwrap(), "https://a.example:8080/x/z/1.glb?token=7");
        assert_eq!(resolve("/1.glb?v=2").unwrap(), "https://a.example:8080/1.glb?v=2");
        assert_eq!(resolve("https://a.example:8080/1.glb").unwrap(), "https://a.example:8080/1.glb?token=7");
        for uri in ["https://b.example/1.glb", "//b.example/1.glb", "file:///etc/passwd", "https://a.example:80801/x"] {
            assert_eq!(resolve(uri).unwrap_err().code, "outside", "{uri}");
        }
    }
}
