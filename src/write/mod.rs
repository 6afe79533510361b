//! Writes tiles and tilesets: the last stage, and the only one that touches the output.
//!
//! In: [`TileContent`] and [`TileEntry`]. Out: GLB bytes, tileset.json, and a folder that appears whole or not at all.

mod content;
pub mod glb;
pub mod mesh;
pub mod obj;
pub mod output;
pub mod painted;
pub mod ply;
pub mod tileset;

pub use content::{TileContent, quantization_error_m, quantization_error_of};
pub use glb::{GlbOptions, glb};
pub use output::Output;
pub use ply::Ply;
pub use tileset::{About, ClassError, TileEntry, tileset};

/// What stands in `asset.generator`.
pub const GENERATOR: &str = concat!("rooftile ", env!("CARGO_PKG_VERSION"));
