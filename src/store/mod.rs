//! A work folder of pages: what a build larger than memory keeps on disk between its steps.
//!
//! In: plain arrays. Out: the same arrays, checked. Knows nothing of meshes.
//!
//! # Method
//! A page is a magic number, arrays (length, then bytes as they lie in memory), and a BLAKE3 of it all. It is written
//! under a temporary name and renamed when whole: a page that is there is finished. The folder carries the token of the
//! build it belongs to, a digest of its inputs and settings; a resumed build with another token starts afresh.
//!
//! # Promises
//! A page is read back bit for bit or refused (`a_damaged_page_is_refused`). Killed writers leave no page.
//!
//! # Limits
//! Pages have the byte order of their machine: a work folder does not travel.

use std::fs::{self, File};
use std::io::{BufReader, BufWriter, Read, Write};
use std::path::PathBuf;

use bytemuck::{AnyBitPattern, NoUninit};

use crate::{Error, Result};

pub mod memory;

const MAGIC: [u8; 8] = *b"rooftpg1";
const TOKEN: &str = "token";
const HASH_BYTES: usize = 32;

/// A folder of pages.
#[derive(Debug)]
pub struct Store {
    dir: PathBuf,
}

impl Store {
    /// Opens the folder `dir` for the build `token`; what is in it stays only if `resume` is set and the token agrees.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn open(dir: PathBuf, token: &str, resume: bool) -> Result<Self> {
        let same = fs::read_to_string(dir.join(TOKEN)).is_ok_and(|found| found == token);
        if !(resume && same) {
            match fs::remove_dir_all(&dir) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(Error::io("remove", &dir)(e)),
                _ => {}
            }
            fs::create_dir_all(&dir).map_err(Error::io("create", &dir))?;
            let path = dir.join(TOKEN);
            fs::write(&path, token).map_err(Error::io("write", &path))?;
        }
        Ok(Self { dir })
    }

    /// True while nothing was put into it.
    pub fn is_empty(&self) -> bool {
        let mut entries = fs::read_dir(&self.dir).into_iter().flatten().flatten();
        entries.all(|entry| entry.file_name() == TOKEN)
    }

    /// Where a page or a file of this name is.
    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.join(name)
    }

    /// True for a page that was finished.
    pub fn has(&self, name: &str) -> bool {
        self.path(name).is_file()
    }

    /// Begins a page; it is there after [`PageWriter::finish`].
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn page(&self, name: &str) -> Result<PageWriter> {
        let path = self.path(name);
        let partial = path.with_extension("partial");
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
        }
        let file = File::create(&partial).map_err(Error::io("create", &partial))?;
        let mut page =
            PageWriter { file: BufWriter::with_capacity(1 << 18, file), hash: blake3::Hasher::new(), partial, path };
        page.bytes(&MAGIC)?;
        Ok(page)
    }

    /// Opens a page.
    ///
    /// # Errors
    /// [`Error::Io`], or [`Error::Input`] if it is none.
    pub fn read(&self, name: &str) -> Result<PageReader> {
        let path = self.path(name);
        let file = File::open(&path).map_err(Error::io("read", &path))?;
        let left = file.metadata().map_err(Error::io("read", &path))?.len();
        let file = BufReader::with_capacity(1 << 18, file);
        let mut page = PageReader { file, hash: blake3::Hasher::new(), left, path };
        let mut magic = [0; 8];
        page.bytes(&mut magic)?;
        if magic == MAGIC { Ok(page) } else { Err(page.damaged()) }
    }

    /// Writes a whole file at once.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write_file(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let path = self.path(name);
        let partial = path.with_extension("partial");
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(Error::io("create", parent))?;
        }
        fs::write(&partial, bytes).map_err(Error::io("write", &partial))?;
        fs::rename(&partial, &path).map_err(Error::io("rename", &partial))
    }

    /// Reads a whole file, none if it is not there.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn read_file(&self, name: &str) -> Result<Option<Vec<u8>>> {
        let path = self.path(name);
        match fs::read(&path) {
            Ok(bytes) => Ok(Some(bytes)),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(Error::io("read", &path)(e)),
        }
    }

    /// Removes a page or a folder of pages; one that is not there is as good.
    pub fn remove(&self, name: &str) {
        let path = self.path(name);
        // What cannot be removed now goes with the folder.
        let _ = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
    }

    /// Removes the folder and all in it.
    pub fn discard(&self) {
        let _ = fs::remove_dir_all(&self.dir);
    }
}

/// A page in the making.
pub struct PageWriter {
    file: BufWriter<File>,
    hash: blake3::Hasher,
    partial: PathBuf,
    path: PathBuf,
}

impl PageWriter {
    /// Appends an array.
    ///
    /// # Errors
    /// [`Error::Io`], for instance on a full disk.
    pub fn put<T: NoUninit>(&mut self, items: &[T]) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(items);
        self.bytes(&(bytes.len() as u64).to_le_bytes())?;
        self.bytes(bytes)
    }

    fn bytes(&mut self, bytes: &[u8]) -> Result<()> {
        self.hash.update(bytes);
        self.file.write_all(bytes).map_err(Error::io("write", &self.partial))
    }

    /// Ends the page and gives it its name.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn finish(mut self) -> Result<()> {
        let hash = self.hash.finalize();
        let written = self.file.write_all(hash.as_bytes()).and_then(|()| self.file.flush());
        written.map_err(Error::io("write", &self.partial))?;
        fs::rename(&self.partial, &self.path).map_err(Error::io("rename", &self.partial))
    }
}

/// A page being read, array by array, in the order written.
pub struct PageReader {
    file: BufReader<File>,
    hash: blake3::Hasher,
    left: u64,
    path: PathBuf,
}

impl PageReader {
    /// The next array.
    ///
    /// # Errors
    /// [`Error::Io`], or [`Error::Input`] for a page that was cut or is of another kind.
    pub fn take<T: AnyBitPattern + NoUninit>(&mut self) -> Result<Vec<T>> {
        let mut length = [0; 8];
        self.bytes(&mut length)?;
        let (length, size) = (u64::from_le_bytes(length), size_of::<T>() as u64);
        // Never allocate more than the file could fill.
        if length > self.left || length % size != 0 {
            return Err(self.damaged());
        }
        let mut items = vec![T::zeroed(); (length / size) as usize];
        self.bytes(bytemuck::cast_slice_mut(&mut items))?;
        Ok(items)
    }

    fn bytes(&mut self, into: &mut [u8]) -> Result<()> {
        if into.len() as u64 > self.left {
            return Err(self.damaged());
        }
        self.file.read_exact(into).map_err(Error::io("read", &self.path))?;
        self.left -= into.len() as u64;
        self.hash.update(into);
        Ok(())
    }

    /// Ends reading, sure that every byte was as written.
    ///
    /// # Errors
    /// [`Error::Input`] for a damaged page.
    pub fn finish(mut self) -> Result<()> {
        let hash = self.hash.finalize();
        let mut found = [0; HASH_BYTES];
        self.bytes(&mut found)?;
        if found == *hash.as_bytes() && self.left == 0 { Ok(()) } else { Err(self.damaged()) }
    }

    fn damaged(&self) -> Error {
        Error::input(
            &self.path,
            "is damaged; remove the work folder beside the output and build again without --resume",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn store() -> (tempfile::TempDir, Store) {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path().join("work"), "a", false).unwrap();
        (folder, store)
    }

    #[test]
    fn arrays_come_back_bit_for_bit() {
        let (_folder, store) = store();
        let mut page = store.page("a/1").unwrap();
        page.put(&[1.5f64, f64::NAN, -0.0]).unwrap();
        page.put::<u32>(&[]).unwrap();
        page.put(&[[1u32, 2, 3]]).unwrap();
        assert!(!store.has("a/1"), "unfinished");
        page.finish().unwrap();
        let mut page = store.read("a/1").unwrap();
        let floats: Vec<u64> = page.take::<f64>().unwrap().iter().map(|f| f.to_bits()).collect();
        assert_eq!(floats, [1.5f64, f64::NAN, -0.0].map(f64::to_bits));
        assert!(page.take::<u32>().unwrap().is_empty());
        assert_eq!(page.take::<[u32; 3]>().unwrap(), [[1, 2, 3]]);
        page.finish().unwrap();
    }

    #[test]
    fn a_damaged_page_is_refused() {
        let (_folder, store) = store();
        let mut page = store.page("p").unwrap();
        page.put(&[7u32; 100]).unwrap();
        page.finish().unwrap();
        let whole = fs::read(store.path("p")).unwrap();
        let read = || -> Result<()> {
            let mut page = store.read("p")?;
            page.take::<u32>()?;
            page.finish()
        };
        assert!(read().is_ok());
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 64;
            fs::write(store.path("p"), &bytes).unwrap();
            assert!(read().is_err(), "byte {at}");
            fs::write(store.path("p"), &whole[..at]).unwrap();
            assert!(read().is_err(), "cut at {at}");
        }
    }

    #[test]
    fn pages_stay_for_the_same_token_only() {
        let (folder, store) = store();
        store.page("p").unwrap().finish().unwrap();
        let open = |token, resume| Store::open(folder.path().join("work"), token, resume).unwrap().has("p");
        assert!(open("a", true));
        assert!(!open("b", true));
        assert!(!open("a", true), "the other build took the folder");
    }
}
