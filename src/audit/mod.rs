//! Judges anybody's tileset by its published files: reads them, measures, and says what is wrong.
//!
//! Independent of the builder on purpose: nothing of `tiles`, `write` or `pipeline` is imported here.

pub mod read;
pub mod structure;
