//! How much memory an audit may take, and what follows from it.
//!
//! The figures do not depend on it: parts of references have a fixed size. It decides how many tiles are looked at
//! together and how many are kept for another look. What does not fit is refused with a reason, and never begun.

use rayon::prelude::*;

/// Memory, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Budget(pub u64);

/// A face kept: three corners of which some are shared, indices, a class.
const KEPT_FACE_BYTES: u64 = 64;
/// A face that is measured: joined corners, a tree, edges, normals, and copies while these are made.
const MEASURED_FACE_BYTES: u64 = 500;
/// A content as stored becomes so many times larger: unpacked, then read.
const READ_TIMES: u64 = 6;
/// A file of an original becomes so many times larger while it is read.
const ORIGINAL_TIMES: u64 = 3;
/// A pixel of an image that is looked at: its colours, its grey, what is used of it.
const PIXEL_BYTES: u64 = 10;

impl Budget {
    /// Less than this is not enough for a part of a reference with all about it, bytes.
    pub const LEAST_BYTES: u64 = 750_000_000;
    /// Faces kept at most, however much memory there is: more are not asked for again.
    const MOST_KEPT_FACES: u64 = 4_000_000;

    /// Faces that are kept after they were looked at.
    pub fn kept_faces(self) -> usize {
        (self.0 / 8 / KEPT_FACE_BYTES).min(Self::MOST_KEPT_FACES) as usize
    }

    /// Faces that may be measured at once: a tile, a part of its reference and what lies about it.
    pub fn measured_faces(self) -> usize {
        (self.0 / 2 / MEASURED_FACE_BYTES) as usize
    }

    /// Faces that may be drawn at once.
    pub fn drawn_faces(self) -> usize {
        self.measured_faces()
    }

    /// Bytes of a content that can be read, as stored.
    pub fn content_bytes(self) -> u64 {
        self.0 / 2 / READ_TIMES
    }

    /// Bytes of one file of an original that can be read, as stored.
    pub fn original_bytes(self) -> u64 {
        self.0 * 3 / 4 / ORIGINAL_TIMES
    }

    /// Pixels of an image that can be looked at.
    pub fn seen_px(self) -> u64 {
        self.0 / 2 / PIXEL_BYTES
    }

    /// What it takes to read a content of so many bytes.
    pub fn to_read(stored_bytes: u64) -> u64 {
        stored_bytes.saturating_mul(READ_TIMES)
    }

    /// What it takes to look at an image.
    pub fn to_see(pixels: u64) -> u64 {
        pixels.saturating_mul(PIXEL_BYTES)
    }

    /// Does `work` for all of `items`, in parallel as far as what they take at once, by `bytes`, is within a third; one
    /// that takes more goes alone. The results are in the order of the items.
    pub fn map<T: Sync, R: Send>(
        self,
        items: &[T],
        bytes: impl Fn(&T) -> u64,
        work: impl Fn(&T) -> R + Sync,
    ) -> Vec<R> {
        let threads = rayon::current_num_threads().max(1) as u64;
        let mut results = Vec::with_capacity(items.len());
        let mut first = 0;
        while first < items.len() {
            let (mut end, mut largest) = (first, 0);
            // As many at once as there are threads: the largest of them count.
            while let Some(item) = items.get(end) {
                largest = largest.max(bytes(item));
                if end > first && largest.saturating_mul(threads) > self.0 / 3 {
                    break;
                }
                end += 1;
            }
            if end - first == 1 {
                results.push(work(&items[first]));
            } else {
                results.par_extend(items[first..end].par_iter().map(&work));
            }
            first = end;
        }
        results
    }
}

impl Default for Budget {
    fn default() -> Self {
        Self(crate::store::memory::default_bytes().max(Self::LEAST_BYTES))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    #[test]
    fn large_items_go_alone_and_results_stay_in_order() {
        let items: Vec<u64> = vec![1, 2, 500, 3, 400, 401, 1, 1, 1];
        let (at_once, most) = (AtomicU64::new(0), AtomicU64::new(0));
        let work = |&item: &u64| {
            let now = at_once.fetch_add(item, Ordering::SeqCst) + item;
            most.fetch_max(now, Ordering::SeqCst);
            std::thread::sleep(std::time::Duration::from_millis(2));
            at_once.fetch_sub(item, Ordering::SeqCst);
            2 * item
        };
        let doubled = Budget(900).map(&items, |&item| item, work);
        assert_eq!(doubled, items.iter().map(|item| 2 * item).collect::<Vec<_>>());
        assert!(most.into_inner() <= 500, "none beside one that takes more than a third");
    }

    #[test]
    fn what_is_in_memory_at_once_is_within_the_budget() {
        for bytes in [Budget::LEAST_BYTES, 2_000_000_000, 64_000_000_000] {
            let budget = Budget(bytes);
            let kept = budget.kept_faces() as u64 * KEPT_FACE_BYTES;
            let measured = budget.measured_faces() as u64 * MEASURED_FACE_BYTES;
            assert!(kept + measured <= bytes * 3 / 4, "{bytes}");
            assert!(Budget::to_read(budget.content_bytes()) <= bytes / 2, "{bytes}");
            let part = super::super::finer::PART_FACES;
            assert!(budget.measured_faces() >= 3 * part, "a part and twice as much about it: {bytes}");
        }
    }
}
