//! Cuts the collapse into a tree of tiles.

pub mod partition;
