//! Follows the paths an input mentions, never out of the input's folder.
//!
//! In: the folder whose inside is allowed, the folder a path is relative to, the path as written. Out: a canonical
//! path to a regular file. Every step is canonicalised and compared before the next, so neither `..` nor a symbolic
//! link leads out, and no folder outside is even listed. Names that differ only in case are found by look-up.

use std::collections::HashMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::{fs, io};

use super::{InputConfig, lines};
use crate::error::Place;
use crate::{Error, Result};

/// Resolves `reference`, as written in a file of the folder `base`, to a canonical path of a regular file.
///
/// Backslashes count as slashes. Unless `allow_outside`, absolute paths, drive letters, UNC paths and whatever
/// leaves `root` are refused; URLs always are. Percent-decoding is the caller's.
///
/// # Errors
/// [`Error::Input`] for a refused path; [`Error::Io`] for one that cannot be read; a file that is not there is the
/// latter, see [`is_missing`].
pub fn safe_path(root: &Path, base: &Path, reference: &str, allow_outside: bool) -> Result<PathBuf> {
    let found = Resolver::new(root, allow_outside)?.resolve(base, reference);
    found.map_err(|refusal| refusal.into_error(base, Place::File, reference))
}

/// Resolves what `file` refers to: from its folder, inside of [`InputConfig::root`] or else of that folder.
///
/// # Errors
/// As of [`safe_path`], naming `file`.
pub fn referred(file: &Path, reference: &str, config: &InputConfig) -> Result<PathBuf> {
    let base = file.parent().unwrap_or(Path::new(""));
    let found = Resolver::new(config.root.as_deref().unwrap_or(base), config.allow_outside)?.resolve(base, reference);
    found.map_err(|refusal| refusal.into_error(file, Place::File, reference))
}

/// True for the error of [`safe_path`] that says the file is not there.
pub fn is_missing(error: &Error) -> bool {
    matches!(error, Error::Io { action: "read", source, .. } if source.kind() == io::ErrorKind::NotFound)
}

/// Why a path is not followed.
#[derive(Debug)]
pub enum Refusal {
    /// Nothing of that name.
    Missing,
    /// It leaves the input's folder; says how.
    Outside(&'static str),
    /// A pipe, a device or a socket.
    NotAFile,
    /// The operating system refused.
    Unreadable(io::Error),
}

impl Refusal {
    /// As an error about `reference`, found at `at` in `path`.
    pub fn into_error(self, path: &Path, at: Place, reference: &str) -> Error {
        let shown: String = reference.chars().take(200).collect();
        match self {
            Self::Missing => Error::Io {
                path: path.join(&shown),
                action: "read",
                source: io::Error::new(io::ErrorKind::NotFound, "no such file"),
            },
            Self::Outside(how) => Error::input_at(
                path,
                at,
                format!(
                    "the path `{shown}` {how}; only files inside the input's folder are read: move the file there or \
                     pass --allow-outside"
                ),
            ),
            Self::NotAFile => {
                Error::input_at(path, at, format!("`{shown}` is a pipe or a device; a regular file is wanted"))
            }
            Self::Unreadable(source) => Error::Io { path: path.join(&shown), action: "read", source },
        }
    }
}

/// Resolves many paths against one root; remembers folder listings.
#[derive(Debug)]
pub struct Resolver {
    /// Canonical; `None` if everything is allowed.
    root: Option<PathBuf>,
    /// Per canonical folder, names by their lower-case text. For look-up only.
    listings: HashMap<PathBuf, HashMap<String, OsString>>,
}

impl Resolver {
    /// A resolver for the inside of `root`.
    ///
    /// # Errors
    /// [`Error::Io`] if `root` cannot be read.
    pub fn new(root: &Path, allow_outside: bool) -> Result<Self> {
        let root = if allow_outside { None } else { Some(canonical(root).map_err(Error::io("read", root))?) };
        Ok(Self { root, listings: HashMap::new() })
    }

    /// See [`safe_path`].
    ///
    /// # Errors
    /// Why the path is not followed.
    pub fn resolve(&mut self, base: &Path, reference: &str) -> Result<PathBuf, Refusal> {
        let slashed = reference.replace('\\', "/");
        let absolute = absolute_kind(&slashed);
        match absolute {
            Some(Absolute::Url) => return Err(Refusal::Outside("is a URL, which is never fetched,")),
            Some(Absolute::Path(how)) if self.root.is_some() => return Err(Refusal::Outside(how)),
            _ => {}
        }
        if slashed.contains('\0') || slashed.trim().is_empty() {
            return Err(Refusal::Missing);
        }
        let here = match absolute {
            Some(_) => canonical(Path::new(&slashed)).map_err(unreadable)?,
            None => self.walk(base, &slashed)?,
        };
        let kind = fs::metadata(&here).map_err(unreadable)?.file_type();
        match (kind.is_file(), kind.is_dir()) {
            (true, _) => Ok(here),
            (_, true) => Err(Refusal::Missing),
            _ => Err(Refusal::NotAFile),
        }
    }

    fn walk(&mut self, base: &Path, slashed: &str) -> Result<PathBuf, Refusal> {
        let mut here = canonical(base).map_err(unreadable)?;
        self.check_inside(&here)?;
        for name in slashed.split('/').filter(|name| !matches!(*name, "" | ".")) {
            if name == ".." {
                here.pop();
            } else {
                here = self.step(&here, name)?;
            }
            self.check_inside(&here)?;
        }
        Ok(here)
    }

    fn check_inside(&self, path: &Path) -> Result<(), Refusal> {
        match &self.root {
            Some(root) if !path.starts_with(root) => Err(Refusal::Outside("leaves the input's folder")),
            _ => Ok(()),
        }
    }

    fn step(&mut self, folder: &Path, name: &str) -> Result<PathBuf, Refusal> {
        let exact = folder.join(name);
        if fs::symlink_metadata(&exact).is_ok() {
            return canonical(&exact).map_err(unreadable);
        }
        let listing = self.listings.entry(folder.to_path_buf()).or_insert_with(|| list(folder));
        let found = listing.get(&name.to_lowercase()).ok_or(Refusal::Missing)?;
        canonical(&folder.join(found)).map_err(unreadable)
    }
}

fn canonical(path: &Path) -> io::Result<PathBuf> {
    // The parent of a bare file name is the empty path.
    fs::canonicalize(if path.as_os_str().is_empty() { Path::new(".") } else { path })
}

fn unreadable(error: io::Error) -> Refusal {
    match error.kind() {
        io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => Refusal::Missing,
        _ => Refusal::Unreadable(error),
    }
}

/// A folder's names by lower-case text; of two that differ only in case the lesser wins. Empty if unreadable.
fn list(folder: &Path) -> HashMap<String, OsString> {
    let mut names: Vec<_> = fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.file_name()).collect();
    names.sort_unstable();
    let key = |name: &OsString| lines::text(name.as_encoded_bytes()).to_lowercase();
    names.into_iter().rev().map(|name| (key(&name), name)).collect()
}

#[derive(Clone, Copy)]
enum Absolute {
    Url,
    Path(&'static str),
}

fn absolute_kind(slashed: &str) -> Option<Absolute> {
    if let Some((scheme, rest)) = slashed.split_once(':') {
        let plain = scheme.starts_with(|c: char| c.is_ascii_alphabetic())
            && scheme.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '+' | '-' | '.'));
        if plain && scheme.len() == 1 {
            return Some(Absolute::Path("begins with a drive letter"));
        }
        // A colon alone is legal in file names; these schemes are what inputs use.
        let known = ["file", "http", "https", "ftp", "data"].iter().any(|s| scheme.eq_ignore_ascii_case(s));
        if plain && (known || rest.starts_with("//")) {
            return Some(Absolute::Url);
        }
    }
    if slashed.starts_with("//") {
        return Some(Absolute::Path("is a network (UNC) path"));
    }
    slashed.starts_with('/').then_some(Absolute::Path("is absolute"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("in");
        fs::create_dir_all(root.join("a/b")).unwrap();
        for name in ["in/a/Roof.JPG", "in/top.jpg", "in/sp ace.jpg", "in/co:lon.jpg", "secret.jpg"] {
            fs::write(folder.path().join(name), "x").unwrap();
        }
        (folder, root)
    }

    fn refused(root: &Path, base: &Path, reference: &str) -> bool {
        matches!(safe_path(root, base, reference, false), Err(Error::Input { .. }))
    }

    #[test]
    fn paths_inside_are_found_whatever_their_case_and_slashes() {
        let (_folder, root) = tree();
        let real = fs::canonicalize(&root).unwrap();
        let base = root.join("a");
        for (reference, file) in [
            ("Roof.JPG", "a/Roof.JPG"),
            ("rOOF.jpg", "a/Roof.JPG"),
            (".\\roof.jpg", "a/Roof.JPG"),
            ("b\\..\\roof.jpg", "a/Roof.JPG"),
            ("..\\A\\\\roof.jpg", "a/Roof.JPG"),
            ("../sp ace.jpg", "sp ace.jpg"),
            ("../co:lon.jpg", "co:lon.jpg"),
        ] {
            assert_eq!(safe_path(&root, &base, reference, false).unwrap(), real.join(file), "{reference}");
        }
    }

    #[test]
    fn what_leaves_the_folder_is_refused_unless_allowed() {
        let (folder, root) = tree();
        let secret = folder.path().join("secret.jpg");
        for reference in ["../secret.jpg", "a/../../secret.jpg", "..\\secret.jpg", "../in/../secret.jpg", "../nothing"]
        {
            assert!(refused(&root, &root, reference), "{reference}");
        }
        for reference in
            ["/etc/passwd", "C:\\x.jpg", "c:x.jpg", "\\\\host\\x.jpg", "//host/x", secret.to_str().unwrap()]
        {
            assert!(refused(&root, &root, reference), "{reference}");
        }
        let real = fs::canonicalize(&secret).unwrap();
        assert_eq!(safe_path(&root, &root, "../secret.jpg", true).unwrap(), real);
        assert_eq!(safe_path(&root, &root, secret.to_str().unwrap(), true).unwrap(), real);
    }

    #[test]
    fn urls_are_refused_even_when_outside_is_allowed() {
        let (_folder, root) = tree();
        for reference in
            ["http://x/y.jpg", "file:///etc/passwd", "FILE:/etc/passwd", "s3://b/k", "data:image/png;base64,"]
        {
            assert!(refused(&root, &root, reference), "{reference}");
            assert!(matches!(safe_path(&root, &root, reference, true), Err(Error::Input { .. })), "{reference}");
        }
    }

    #[test]
    fn what_is_not_there_is_missing_and_not_refused() {
        let (_folder, root) = tree();
        for reference in ["none.jpg", "none/../top.jpg", "top.jpg/x", "a", "", " ", "a\0b", &"x".repeat(300)] {
            let error = safe_path(&root, &root, reference, false).unwrap_err();
            assert!(is_missing(&error), "{reference}: {error:?}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn symbolic_links_are_followed_inside_and_refused_outside() {
        use std::os::unix::fs::symlink;
        let (folder, root) = tree();
        symlink(root.join("top.jpg"), root.join("near.jpg")).unwrap();
        symlink(folder.path().join("secret.jpg"), root.join("far.jpg")).unwrap();
        symlink(folder.path(), root.join("up")).unwrap();
        symlink("loop.jpg", root.join("loop.jpg")).unwrap();
        symlink("gone.jpg", root.join("dangling.jpg")).unwrap();
        assert!(safe_path(&root, &root, "near.jpg", false).is_ok());
        assert!(refused(&root, &root, "far.jpg"));
        assert!(refused(&root, &root, "up/secret.jpg"));
        assert!(refused(&root, &root, "up/in/top.jpg"));
        assert!(safe_path(&root, &root, "loop.jpg", false).is_err());
        assert!(is_missing(&safe_path(&root, &root, "dangling.jpg", false).unwrap_err()));
    }

    #[cfg(unix)]
    #[test]
    fn a_device_or_a_pipe_is_refused() {
        use std::os::unix::net::UnixListener;
        let (_folder, root) = tree();
        let _socket = UnixListener::bind(root.join("s")).unwrap();
        assert!(refused(&root, &root, "s"));
        assert!(matches!(safe_path(&root, &root, "/dev/zero", true), Err(Error::Input { .. })));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_file_named_in_latin_1_bytes_is_found() {
        use std::os::unix::ffi::OsStrExt;
        let (_folder, root) = tree();
        fs::write(root.join(std::ffi::OsStr::from_bytes(b"caf\xe9.jpg")), "x").unwrap();
        assert!(safe_path(&root, &root, "café.jpg", false).is_ok());
    }
}
