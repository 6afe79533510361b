//! Turns textured photogrammetry meshes into 3D Tiles 1.1 whose geometric error is measured per class.
//!
//! The pipeline, one noun per arrow (see [`pipeline`]):
//!
//! ```text
//! input ─► mesh ─► cells ─► planes ─► classes ─► collapse ─► tiles    ─► texture ─► write
//! Source   Mesh    leaves   Planes    Classes    Patch       MadeTile    Baked      GLB, tileset.json
//! ```
//!
//! From `cells` on a build holds a window of the whole in memory; the rest lies in a [`store`] beside the output.
//!
//! `input` is the only module that sees untrusted bytes and `mesh` the only gate behind it: past the gate the
//! stages cannot fail. `serve` and `inspect` read published files only and know nothing of the builder.

pub mod audit;
pub mod classes;
pub mod cli;
pub mod collapse;
pub mod config;
pub mod demo;
pub mod draw;
pub mod error;
pub mod experiment;
pub mod geo;
pub mod ids;
pub mod input;
pub mod inspect;
pub mod measure;
pub mod mesh;
pub mod pipeline;
pub mod planes;
pub mod preset;
pub mod report;
pub mod schema;
pub mod serve;
pub mod store;
pub mod texture;
pub mod tiles;
pub mod write;

pub use error::{Error, Result};
