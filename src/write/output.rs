//! A folder that appears whole or not at all.
//!
//! # Method
//! 1. Lock `<dir>.lock`; a second run on the same output is refused.
//! 2. Put right what a killed run left: with the lock held, every leftover is nobody's.
//! 3. Write into `.<name>.partial-<pid>` beside the output, on the same file system.
//! 4. Commit: sync files and folders, move the old output aside, rename the new one in, remove the old.
//!
//! # Promises
//! At every moment the output is absent, old, or complete. Dropping an [`Output`] leaves no trace of it.
//! `--force` replaces tilesets only: a folder without tileset.json or build.json is never removed.
//!
//! # Limits
//! Between the two renames of a forced commit the output is absent; a run killed there is mended by the next.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::path::{Component, Path, PathBuf};

use crate::{Error, Result};

/// An output in the making.
#[derive(Debug)]
pub struct Output {
    dir: PathBuf,
    partial: PathBuf,
    old: PathBuf,
    force: bool,
    /// Declared last: released after the folders are gone.
    _lock: Lock,
}

/// Files of which one marks a folder as written by us or another tiler.
const MARKS: [&str; 2] = ["tileset.json", "build.json"];

impl Output {
    /// Takes the output `dir` for this process; makes its parents if need be.
    ///
    /// # Errors
    /// [`Error::Output`] if it is a file, or holds something and `force` is not set, or holds something that is no
    /// tileset, or another run writes it. [`Error::Io`] if the system refuses.
    pub fn begin(dir: &Path, force: bool) -> Result<Self> {
        let dir = resolve(dir)?;
        let (Some(name), Some(parent)) = (dir.file_name(), dir.parent()) else {
            return Err(refusal(&dir, "names no folder that could be made; name a new one"));
        };
        let beside = |suffix: &str| {
            let mut hidden = OsString::from(".");
            hidden.push(name);
            hidden.push(suffix);
            hidden
        };
        let lock = Lock::take(&dir)?;
        let (partials, olds) = (beside(".partial-"), beside(".old-"));
        mend(&dir, parent, &partials, &olds)?;
        admit(&dir, parent, force)?;
        let own = |mut prefix: OsString| {
            prefix.push(std::process::id().to_string());
            parent.join(prefix)
        };
        let (partial, old) = (own(partials), own(olds));
        fs::create_dir(&partial).map_err(Error::io("create", &partial))?;
        Ok(Self { dir, partial, old, force, _lock: lock })
    }

    /// The work folder, to read back what was written; gone after `commit`.
    pub fn work_dir(&self) -> &Path {
        &self.partial
    }

    /// Writes one file; `relative` has `/` between folders. May be called from any thread.
    ///
    /// # Errors
    /// [`Error::Io`], for instance on a full disk; [`Error::Bug`] if `relative` leaves the output.
    pub fn write(&self, relative: &str, bytes: &[u8]) -> Result<()> {
        let inside = Path::new(relative).components().all(|c| matches!(c, Component::Normal(_)));
        if !inside || relative.is_empty() {
            return Err(Error::Bug(format!("{relative:?} is no path inside the output")));
        }
        let path = self.partial.join(relative);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
        }
        fs::write(&path, bytes).map_err(Error::io("write", &path))
    }

    /// The path of a hidden folder beside the output, of its name and `suffix`.
    pub fn beside(&self, suffix: &str) -> PathBuf {
        let mut name = OsString::from(".");
        name.push(self.dir.file_name().unwrap_or_default());
        name.push(suffix);
        self.dir.with_file_name(name)
    }

    /// Takes a finished file from elsewhere on the same file system, which keeps it; copies it where links are not.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn adopt(&self, from: &Path, relative: &str) -> Result<()> {
        let path = self.partial.join(relative);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
        }
        fs::hard_link(from, &path).or_else(|_| fs::copy(from, &path).map(|_| ())).map_err(Error::io("write", &path))
    }

    /// Publishes everything written, at once.
    ///
    /// # Errors
    /// [`Error::Io`]; the old output, if any, is back in its place.
    pub fn commit(self) -> Result<()> {
        sync_tree(&self.partial)?;
        let parent = self.dir.parent().unwrap_or(Path::new("."));
        // Somebody may have put something there since `begin`.
        admit(&self.dir, parent, self.force)?;
        let replaced = self.dir.exists();
        if replaced {
            fs::rename(&self.dir, &self.old).map_err(Error::io("rename", &self.dir))?;
        }
        if let Err(source) = fs::rename(&self.partial, &self.dir) {
            if replaced {
                fs::rename(&self.old, &self.dir).map_err(Error::io("put back", &self.dir))?;
            }
            return Err(Error::Io { path: self.dir.clone(), action: "rename", source });
        }
        sync(parent)?;
        if replaced {
            // The new output is in place: a failure here is no reason to fail, the next `begin` tries again.
            let _ = fs::remove_dir_all(&self.old);
        }
        Ok(())
    }
}

impl Drop for Output {
    fn drop(&mut self) {
        // After a commit there is nothing; a failure here is mended by the next `begin`.
        let _ = fs::remove_dir_all(&self.partial);
    }
}

fn refusal(path: &Path, what: impl Into<String>) -> Error {
    Error::Output { path: path.to_path_buf(), what: what.into() }
}

/// The output's full path, without links; its parents exist afterwards.
fn resolve(dir: &Path) -> Result<PathBuf> {
    if dir.symlink_metadata().is_ok() {
        return dir.canonicalize().map_err(Error::io("follow", dir));
    }
    let Some(name) = dir.file_name() else {
        return Err(refusal(dir, "names no folder that could be made; name a new one"));
    };
    let parent = match dir.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
    Ok(parent.canonicalize().map_err(Error::io("follow", parent))?.join(name))
}

/// Refuses an output that stands in the way.
fn admit(dir: &Path, parent: &Path, force: bool) -> Result<()> {
    let Ok(meta) = dir.symlink_metadata() else { return Ok(()) };
    if !meta.is_dir() {
        return Err(refusal(dir, "is a file where a folder is to be written; name another output"));
    }
    if device(dir) != device(parent) {
        return Err(refusal(dir, "is a mount point and cannot be replaced as a whole; name a folder inside it"));
    }
    let mut entries = fs::read_dir(dir).map_err(Error::io("list", dir))?;
    if entries.next().is_none() {
        return Ok(());
    }
    if !force {
        return Err(refusal(dir, "exists and is not empty; name another output or replace it with --force"));
    }
    if !MARKS.iter().any(|mark| dir.join(mark).is_file()) {
        let what = "holds files but neither tileset.json nor build.json, so it is not replaced even with --force; \
                    empty it by hand or name another output";
        return Err(refusal(dir, what));
    }
    Ok(())
}

/// Puts back an output that a killed commit had moved aside, and removes unfinished ones.
fn mend(dir: &Path, parent: &Path, partials: &OsString, olds: &OsString) -> Result<()> {
    let is_one_of = |name: &OsString, prefix: &OsString| {
        let (name, prefix) = (name.as_encoded_bytes(), prefix.as_encoded_bytes());
        name.strip_prefix(prefix).is_some_and(|pid| !pid.is_empty() && pid.iter().all(u8::is_ascii_digit))
    };
    let mut leftovers = Vec::new();
    for entry in fs::read_dir(parent).map_err(Error::io("list", parent))? {
        leftovers.push(entry.map_err(Error::io("list", parent))?.file_name());
    }
    leftovers.sort_unstable();
    for name in leftovers {
        let path = parent.join(&name);
        if is_one_of(&name, olds) && dir.symlink_metadata().is_err() {
            fs::rename(&path, dir).map_err(Error::io("put back", dir))?;
        } else if is_one_of(&name, olds) || is_one_of(&name, partials) {
            fs::remove_dir_all(&path).map_err(Error::io("remove", &path))?;
        }
    }
    Ok(())
}

/// Syncs all files, then the folders that name them.
fn sync_tree(dir: &Path) -> Result<()> {
    for entry in fs::read_dir(dir).map_err(Error::io("list", dir))? {
        let path = entry.map_err(Error::io("list", dir))?.path();
        if path.is_dir() { sync_tree(&path)? } else { sync(&path)? }
    }
    sync(dir)
}

fn sync(path: &Path) -> Result<()> {
    // Windows cannot open folders, and needs no sync of them.
    if cfg!(windows) && path.is_dir() {
        return Ok(());
    }
    let file = File::open(path).map_err(Error::io("open", path))?;
    file.sync_all().map_err(Error::io("sync", path))
}

#[cfg(unix)]
fn device(path: &Path) -> Option<u64> {
    use std::os::unix::fs::MetadataExt;
    path.metadata().ok().map(|m| m.dev())
}

#[cfg(not(unix))]
fn device(_: &Path) -> Option<u64> {
    None
}

/// A locked file beside the output; removed on drop.
#[derive(Debug)]
struct Lock {
    path: PathBuf,
    file: File,
}

impl Lock {
    fn take(dir: &Path) -> Result<Self> {
        let mut path = dir.as_os_str().to_owned();
        path.push(".lock");
        let path = PathBuf::from(path);
        loop {
            let file = OpenOptions::new().create(true).truncate(false).write(true).open(&path);
            let file = file.map_err(Error::io("create", &path))?;
            match file.try_lock() {
                Ok(()) if is_at(&file, &path) => return Ok(Self { path, file }),
                // Its last holder removed it between our opening and our locking.
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    return Err(refusal(
                        dir,
                        "is busy: another run writes it; wait for its end or name another output",
                    ));
                }
                Err(TryLockError::Error(source)) => return Err(Error::Io { path, action: "lock", source }),
            }
        }
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        // While still locked: whoever opened it before will see that it is gone, see `is_at`.
        let _ = fs::remove_file(&self.path);
        let _ = self.file.unlock();
    }
}

#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    match (file.metadata(), path.metadata()) {
        (Ok(a), Ok(b)) => (a.dev(), a.ino()) == (b.dev(), b.ino()),
        _ => false,
    }
}

#[cfg(not(unix))]
fn is_at(_: &File, _: &Path) -> bool {
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    fn what(result: Result<Output>) -> String {
        let error = result.unwrap_err();
        assert_eq!(error.exit_code(), 5, "{error}");
        error.to_string()
    }

    #[test]
    fn an_output_appears_at_commit_and_leaves_nothing_beside_it() {
        let temp = tempfile::tempdir().unwrap();
        let dir = temp.path().join("deep/er/tiles");
        let output = Output::begin(&dir, false).unwrap();
        output.write("0/1.glb", b"glb").unwrap();
        output.write("tileset.json", b"{}").unwrap();
        assert!(!dir.exists());
        output.commit().unwrap();
        assert_eq!(names(&dir), ["0", "tileset.json"]);
        assert_eq!(fs::read(dir.join("0/1.glb")).unwrap(), b"glb");
        assert_eq!(names(dir.parent().unwrap()), ["tiles"]);
    }

    #[test]
    fn dropping_an_output_leaves_no_trace_and_the_old_one_alone() {
        let temp = tempfile::tempdir().unwrap();
        let dir = temp.path().join("tiles");
        let commit = |text: &[u8]| {
            let output = Output::begin(&dir, true).unwrap();
            output.write("tileset.json", text).unwrap();
            output
        };
        commit(b"one").commit().unwrap();
        drop(commit(b"two"));
        assert_eq!(fs::read(dir.join("tileset.json")).unwrap(), b"one");
        assert_eq!(names(temp.path()), ["tiles"]);
        commit(b"three").commit().unwrap();
        assert_eq!(fs::read(dir.join("tileset.json")).unwrap(), b"three");
        assert_eq!(names(temp.path()), ["tiles"]);
    }

    #[test]
    fn what_stands_in_the_way_is_refused_with_the_remedy() {
        let temp = tempfile::tempdir().unwrap();
        let dir = temp.path().join("tiles");
        fs::write(&dir, b"a file").unwrap();
        assert!(what(Output::begin(&dir, true)).contains("is a file"));
        fs::remove_file(&dir).unwrap();
        fs::create_dir(&dir).unwrap();
        drop(Output::begin(&dir, false).unwrap());
        fs::write(dir.join("thesis.tex"), b"years").unwrap();
        assert!(what(Output::begin(&dir, false)).contains("--force"));
        assert!(what(Output::begin(&dir, true)).contains("not replaced even with --force"));
        assert_eq!(names(&dir), ["thesis.tex"]);
        assert_eq!(names(temp.path()), ["tiles"]);
    }

    #[test]
    fn a_second_run_on_the_same_output_is_told_that_it_is_busy() {
        let temp = tempfile::tempdir().unwrap();
        let dir = temp.path().join("tiles");
        let first = Output::begin(&dir, false).unwrap();
        assert!(what(Output::begin(&dir, true)).contains("busy"));
        first.write("tileset.json", b"{}").unwrap();
        first.commit().unwrap();
        drop(Output::begin(&dir, true).unwrap());
    }

    #[test]
    fn what_a_killed_run_left_is_mended() {
        let temp = tempfile::tempdir().unwrap();
        let dir = temp.path().join("tiles");
        let put = |name: &str| {
            fs::create_dir(temp.path().join(name)).unwrap();
            fs::write(temp.path().join(name).join("tileset.json"), name).unwrap();
        };
        put(".tiles.partial-1");
        put(".tiles.old-1");
        put(".tiles.partial-mine");
        put(".tiles2.partial-1");
        // The killed commit had moved the old output aside: it is back, and in the way as any other.
        assert!(what(Output::begin(&dir, false)).contains("not empty"));
        assert_eq!(fs::read(dir.join("tileset.json")).unwrap(), b".tiles.old-1");
        assert_eq!(names(temp.path()), [".tiles.partial-mine", ".tiles2.partial-1", "tiles"]);
    }

    #[test]
    fn a_path_that_leaves_the_output_is_our_bug() {
        let temp = tempfile::tempdir().unwrap();
        let output = Output::begin(&temp.path().join("tiles"), false).unwrap();
        for path in ["../a", "/etc/a", "", "a/../../b"] {
            assert_eq!(output.write(path, b"").unwrap_err().exit_code(), 7, "{path}");
        }
    }
}
