//! Bounds, frames and spatial search; knows nothing of files.

pub mod bvh;
