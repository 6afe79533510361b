//! Serves a tileset folder, and a page that shows it, over HTTP.
//!
//! In: a folder with a `tileset.json`, as published. Out: answers.
//!
//! # Method
//! 1. Walk the folder once into an immutable table of request paths (`index`).
//! 2. Answer a request from that table (`handler`): a path that is not in it never reaches the file system.
//! 3. Tag a body by the hash of its content; honour conditions and single ranges (`conditions`).
//! 4. Read bodies in pieces on blocking threads (`body`); accept, limit and drain connections (`net`).
//!
//! When `tileset.json` itself is replaced, by a new build, the whole table is made anew.
//!
//! # Paths
//! `/` the page · `/viewer/…` its files · `/viewer/cesium/…` CesiumJS, when found on disk · `/healthz` · all
//! else: the folder's files at their relative paths, `/tileset.json` first of all.
//!
//! # Promises
//! No path string is answered with 5xx (`no_path_string_reaches_a_file_outside_or_fails_the_server`); symbolic
//! links are not followed (`symbolic_links_and_hidden_files_are_not_served`).
//!
//! # Limits
//! HTTP/1.1 without TLS and without a limit per client: put a reverse proxy in front of anything public.

mod body;
mod conditions;
mod handler;
mod index;
mod net;

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};

use crate::report::Reporter;
use crate::{Error, Result};

use index::Site;

/// Serves the tileset in `root` (its folder, or the `tileset.json` in it) until SIGINT or SIGTERM.
///
/// Blocks. Says on standard error which URL to open; port 0 takes a free one.
///
/// # Errors
/// [`Error::Input`] where there is no `tileset.json`, [`Error::Io`] where the folder cannot be read or the
/// address cannot be listened on. Being asked to stop is not an error.
pub fn run(root: &Path, bind: SocketAddr, reporter: &Reporter) -> Result<()> {
    let (site, skipped) = Site::open(root, index::find_cesium())?;
    for skip in &skipped {
        reporter.warn(skip.code, &skip.path, skip.what);
    }
    let listen = || Error::io("listen on", bind.to_string());
    let listener = TcpListener::bind(bind).map_err(listen())?;
    let address = listener.local_addr().map_err(listen())?;
    listener.set_nonblocking(true).map_err(listen())?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .max_blocking_threads(net::READ_THREADS)
        .build()
        .map_err(listen())?;

    reporter.say(&site.describe());
    for warning in reporter.warnings() {
        reporter.say(&format!("warning: {} ({}x): {}", warning.first, warning.count, warning.first_path.display()));
    }
    reporter.say(&format!("open http://{}/ (Ctrl-C stops)", reachable(address)));
    let router = handler::router(site);
    runtime.block_on(net::serve(listener, router)).map_err(listen())?;
    runtime.shutdown_timeout(net::DRAIN);
    Ok(())
}

/// The same answers without a socket, for tests and for embedding in another server.
///
/// # Errors
/// As [`run`], but for the address.
pub fn router(root: &Path) -> Result<axum::Router> {
    Ok(handler::router(Site::open(root, index::find_cesium())?.0))
}

/// An address a browser on this machine can open: "any address" is not one.
fn reachable(mut address: SocketAddr) -> SocketAddr {
    if address.ip().is_unspecified() {
        address.set_ip(if address.is_ipv4() { Ipv4Addr::LOCALHOST.into() } else { Ipv6Addr::LOCALHOST.into() });
    }
    address
}

/// The folder that holds the tileset, without symbolic links.
fn tileset_folder(root: &Path) -> Result<PathBuf> {
    let real = root.canonicalize().map_err(Error::io("read", root))?;
    let folder = match real.file_name() {
        Some(name) if name == "tileset.json" && real.is_file() => real.parent().map(Path::to_path_buf).unwrap_or(real),
        _ => real,
    };
    if !folder.is_dir() {
        let what = "is not a folder; give the folder that `rooftile build -o` wrote, or unpack the archive first";
        return Err(Error::input(root, what));
    }
    match std::fs::symlink_metadata(folder.join("tileset.json")) {
        Ok(found) if found.is_file() => Ok(folder),
        _ => Err(Error::input(
            root,
            "has no file tileset.json, so it is not a tileset; give the folder that `rooftile build -o` wrote, \
             or make one with `rooftile demo`",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_without_a_tileset_is_refused_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let error = router(folder.path()).unwrap_err();
        assert_eq!(error.exit_code(), 3);
        assert!(error.to_string().contains("rooftile build"), "{error}");
    }

    #[test]
    fn a_missing_folder_and_a_plain_file_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(router(&folder.path().join("nothing")).unwrap_err().exit_code(), 3);
        let file = folder.path().join("town.3tz");
        std::fs::write(&file, b"PK").unwrap();
        assert!(router(&file).unwrap_err().to_string().contains("not a folder"));
    }

    #[test]
    fn the_tileset_json_itself_may_be_given() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("tileset.json"), b"{}").unwrap();
        assert!(router(&folder.path().join("tileset.json")).is_ok());
    }

    #[test]
    fn a_taken_port_is_an_error_that_names_the_address() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("tileset.json"), b"{}").unwrap();
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = taken.local_addr().unwrap();
        let error = run(folder.path(), address, &Reporter::new(true)).unwrap_err();
        assert_eq!(error.exit_code(), 6);
        assert_eq!(error.to_string(), format!("{address}: cannot listen on"));
    }

    #[test]
    fn any_address_is_opened_on_this_machine() {
        assert_eq!(reachable("0.0.0.0:80".parse().unwrap()).to_string(), "127.0.0.1:80");
        assert_eq!(reachable("[::]:80".parse().unwrap()).to_string(), "[::1]:80");
        assert_eq!(reachable("10.0.0.7:80".parse().unwrap()).to_string(), "10.0.0.7:80");
    }
}
