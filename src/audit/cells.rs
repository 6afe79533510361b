//! Triangles on disk, found again by place: what an original of any size is while it is a reference.
//!
//! # Method
//! 1. triangles are written one after another as they are read; how many and where is counted
//! 2. they are written again by cells of a plan grid, and the first file goes
//! 3. a box is answered by reading the cells that touch it
//!
//! # Promises
//! The same triangles in the same order for any amount of memory. Some 80 MB are held, whatever there is on disk; the
//! file goes when it is no longer needed.

use std::fs::{File, OpenOptions};
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use glam::DVec3;

use crate::geo::Aabb;
use crate::{Error, Result};

/// Corners as they lie on disk.
type Raw = [f64; 9];
const RAW_BYTES: u64 = 72;
/// Triangles of a cell, on average.
const CELL_FACES: u64 = 20_000;
/// Cells along a side at most.
const MOST_SIDE: usize = 32;
/// Triangles of a cell that are written at once.
const CHUNK: usize = 1024;
/// Squares along a side in which triangles are counted.
const COUNTED_SIDE: usize = 256;

/// A file that nobody else knows of, gone when it is dropped.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Result<(Self, File)> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        loop {
            let own = NEXT.fetch_add(1, Ordering::Relaxed);
            let path = std::env::temp_dir().join(format!("rooftile-audit-{}-{own}", std::process::id()));
            match OpenOptions::new().read(true).write(true).create_new(true).open(&path) {
                // What is there already belongs to somebody, perhaps to a run that was killed, and may lead elsewhere.
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(Error::io("create", &path)(e)),
                Ok(file) => return Ok((Self(path), file)),
            }
        }
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// Takes triangles up.
pub struct Writer {
    file: BufWriter<File>,
    scratch: Scratch,
    /// Triangles so far.
    pub count: u64,
    /// Around them.
    pub aabb: Aabb,
}

impl Writer {
    /// Nothing yet.
    ///
    /// # Errors
    /// [`Error::Io`] if no file can be made in the system's folder for such files.
    pub fn new() -> Result<Self> {
        let (scratch, file) = Scratch::new()?;
        Ok(Self { file: BufWriter::with_capacity(1 << 18, file), scratch, count: 0, aabb: Aabb::EMPTY })
    }

    /// Adds a triangle, whose corners are finite.
    ///
    /// # Errors
    /// [`Error::Io`], of full disks.
    pub fn push(&mut self, corners: [DVec3; 3]) -> Result<()> {
        corners.iter().for_each(|&p| self.aabb.extend(p));
        self.count += 1;
        self.file.write_all(bytemuck::bytes_of(&raw(corners))).map_err(Error::io("write", &self.scratch.0))
    }

    /// Sorts all into cells, moved by `-by`.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn finish(self, by: DVec3) -> Result<Cells> {
        let from = self.scratch;
        let mut file = self.file.into_inner().map_err(|e| Error::io("write", &from.0)(e.into_error()))?;
        file.seek(SeekFrom::Start(0)).map_err(Error::io("read", &from.0))?;
        let mut file = BufReader::with_capacity(1 << 18, file);
        let (scratch, out) = Scratch::new()?;
        let aabb = Aabb { min: self.aabb.min - by, max: self.aabb.max - by };
        let side = ((self.count as f64 / CELL_FACES as f64).sqrt().ceil() as usize).clamp(1, MOST_SIDE);
        let mut cells = Cells {
            file: Mutex::new(out),
            cells: (0..side * side).map(|_| Cell { extents: Vec::new(), aabb: Aabb::EMPTY }).collect(),
            counted: vec![0; COUNTED_SIDE * COUNTED_SIDE],
            aabb,
            count: self.count as usize,
            trouble: Mutex::new(None),
            scratch,
        };
        let mut waiting: Vec<Vec<Raw>> = vec![Vec::new(); side * side];
        let (mut end, mut one): (u64, Raw) = (0, [0.0; 9]);
        for _ in 0..self.count {
            file.read_exact(bytemuck::bytes_of_mut(&mut one)).map_err(Error::io("read", &from.0))?;
            let corners = corners(&one).map(|p| p - by);
            let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
            cells.counted[square(&aabb, middle, COUNTED_SIDE)] += 1;
            let at = square(&aabb, middle, side);
            corners.iter().for_each(|&p| cells.cells[at].aabb.extend(p));
            waiting[at].push(raw(corners));
            if waiting[at].len() == CHUNK {
                cells.write(at, &mut waiting[at], &mut end)?;
            }
        }
        for (at, waiting) in waiting.iter_mut().enumerate() {
            cells.write(at, waiting, &mut end)?;
        }
        Ok(cells)
    }
}

struct Cell {
    /// First triangle and number, of each stretch in the file.
    extents: Vec<(u64, usize)>,
    aabb: Aabb,
}

/// Triangles by place.
pub struct Cells {
    file: Mutex<File>,
    cells: Vec<Cell>,
    /// Middles of triangles by squares of the plan.
    counted: Vec<u32>,
    /// Around all.
    pub aabb: Aabb,
    /// All.
    pub count: usize,
    trouble: Mutex<Option<Error>>,
    scratch: Scratch,
}

impl Cells {
    fn write(&mut self, at: usize, waiting: &mut Vec<Raw>, end: &mut u64) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(waiting);
        super::read::lock(&self.file).write_all(bytes).map_err(Error::io("write", &self.scratch.0))?;
        self.cells[at].extents.push((*end, waiting.len()));
        *end += waiting.len() as u64;
        waiting.clear();
        Ok(())
    }

    /// About how many triangles touch the plan of `within`: those whose middles lie in squares that do.
    pub fn about(&self, within: &Aabb) -> usize {
        if within.min.cmpgt(within.max).any() {
            return 0;
        }
        let [low, high] = [within.min, within.max].map(|p| {
            let at = square(&self.aabb, p, COUNTED_SIDE);
            [at % COUNTED_SIDE, at / COUNTED_SIDE]
        });
        if low == high {
            // One triangle far away makes squares of kilometres: without a look a box would never have fewer.
            let mut count = 0;
            self.visit(within, &mut |_| count += 1);
            return count;
        }
        let row =
            |y: usize| (low[0]..=high[0]).map(move |x| self.counted[y * COUNTED_SIDE + x] as usize).sum::<usize>();
        (low[1]..=high[1]).map(row).sum()
    }

    /// Hands over the triangles whose boxes touch `within`, always in the same order.
    pub fn visit(&self, within: &Aabb, see: &mut dyn FnMut([DVec3; 3])) {
        let touches = |aabb: &Aabb| aabb.min.cmple(within.max).all() && aabb.max.cmpge(within.min).all();
        let mut buffer: Vec<Raw> = Vec::new();
        for cell in self.cells.iter().filter(|cell| touches(&cell.aabb)) {
            for &(first, count) in &cell.extents {
                buffer.resize(count, [0.0; 9]);
                if let Err(e) = self.read(first, &mut buffer) {
                    super::read::lock(&self.trouble).get_or_insert(Error::io("read", &self.scratch.0)(e));
                    return;
                }
                for corners in buffer.iter().map(corners).filter(|corners| touches(&Aabb::of(*corners))) {
                    see(corners);
                }
            }
        }
    }

    fn read(&self, first: u64, into: &mut [Raw]) -> std::io::Result<()> {
        let mut file = super::read::lock(&self.file);
        file.seek(SeekFrom::Start(first * RAW_BYTES))?;
        file.read_exact(bytemuck::cast_slice_mut(into))
    }

    /// What went wrong since it was last asked.
    ///
    /// # Errors
    /// [`Error::Io`]: what was handed over since then is not all there is.
    pub fn check(&self) -> Result<()> {
        super::read::lock(&self.trouble).take().map_or(Ok(()), Err)
    }

    /// Where the triangles are.
    pub fn path(&self) -> &Path {
        &self.scratch.0
    }
}

fn raw([a, b, c]: [DVec3; 3]) -> Raw {
    [a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z]
}

fn corners(raw: &Raw) -> [DVec3; 3] {
    [0, 3, 6].map(|k| DVec3::new(raw[k], raw[k + 1], raw[k + 2]))
}

/// The square of the plan of `aabb` that `p` lies in, or nearest to, of `side` by `side`.
fn square(aabb: &Aabb, p: DVec3, side: usize) -> usize {
    let size = aabb.size();
    let along = |axis: usize| {
        let share = (p[axis] - aabb.min[axis]) / size[axis];
        // Without an extent there is one column.
        if share.is_finite() { ((share * side as f64).max(0.0) as usize).min(side - 1) } else { 0 }
    };
    along(1) * side + along(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A strip of triangles along x, a metre each.
    fn strip(count: usize) -> Cells {
        let mut writer = Writer::new().unwrap();
        for i in 0..count {
            let at = DVec3::new(100.0 + i as f64, 7.0 + (i % 3) as f64, 0.0);
            writer.push([at, at + DVec3::X, at + DVec3::Y]).unwrap();
        }
        writer.finish(DVec3::new(100.0, 0.0, 0.0)).unwrap()
    }

    #[test]
    fn what_touches_a_box_is_found_again_once_and_moved() {
        let cells = strip(50_000);
        assert_eq!((cells.count, cells.cells.len()), (50_000, 4));
        let within = Aabb { min: DVec3::new(24_990.5, 0.0, -1.0), max: DVec3::new(25_010.5, 99.0, 1.0) };
        let mut found = Vec::new();
        cells.visit(&within, &mut |corners| found.push(corners[0].x as usize));
        found.sort_unstable();
        assert_eq!(found, (24_990..=25_010).collect::<Vec<_>>());
        assert!((21..2000).contains(&cells.about(&within)), "{}", cells.about(&within));
        assert_eq!(cells.about(&cells.aabb), 50_000);
        assert_eq!(cells.about(&Aabb::EMPTY), 0);
        cells.check().unwrap();
    }

    #[test]
    fn the_file_goes_with_the_cells_and_its_loss_is_told() {
        let cells = strip(10);
        let path = cells.path().to_path_buf();
        assert!(path.is_file());
        super::super::read::lock(&cells.file).set_len(5).unwrap();
        cells.visit(&cells.aabb.clone(), &mut |_| {});
        assert!(cells.check().is_err(), "it was cut short");
        cells.check().unwrap();
        drop(cells);
        assert!(!path.exists());
    }
}
