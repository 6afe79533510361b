//! Says what is in an input or a published tileset, and checks a tileset as a stranger would.
//!
//! In: published files (or a [`Source`](crate::input::Source)). Out: summaries for people and for `--json`, findings.
//! Knows nothing of the builder: GLBs are read by a reader of its own.

mod check;
mod glb;
mod source;
mod summary;
#[cfg(test)]
mod tests;
mod walk;

pub use check::{Finding, Severity, check};
pub use source::{ImageSummary, SourceSummary, source};
pub use summary::{ClassShare, LevelSummary, Place, TilesetSummary, tileset};
