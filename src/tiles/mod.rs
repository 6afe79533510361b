//! Cuts the collapse into a tree of tiles and measures each of them.

pub mod content;
pub mod error;
pub mod levels;
pub mod partition;
pub mod raise;
pub mod skirt;
pub mod soup;

pub use levels::{LevelsConfig, TileMesh};
pub use partition::{CellTree, Census};
pub use soup::Soup;
