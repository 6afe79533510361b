//! Records a collapse sequence in a few bytes a triangle, and replays it to any detail.
//!
//! In: a [`Sequence`]. Out: bytes; and from bytes a [`Progressive`], whose every prefix is a mesh.
//!
//! # Method
//! 1. `encode` carries the collapses out once, then tells them backwards: a coarse base, and vertex splits that refine
//!    it, in exactly the reverse order, so that every prefix of the sequence is a prefix of the record.
//! 2. A split is the vertex, a bit a face for the side it goes to, the faces that appear, where the new vertex is (and
//!    where the old one was, if it moved), levels of the deviation per class and of the energy; see `split`.
//! 3. All of it goes through adaptive binary range coding (`coder`); what was learned is kept from chunk to chunk.
//! 4. Chunks end where the largest deviation passes a power of two, and after 8192 splits; the header says for each
//!    how many faces it leads to and how far that mesh is off, so only what is needed is decoded; see `file`.
//! 5. [`Progressive::at`] is any prefix; [`Progressive::within`] any choice of collapses that budgets per class allow.
//! 6. An event that takes its vertex to the place of the other end is told the other way round: one place, not two.
//!
//! # Names
//! A record forgets the source's numbers. Base vertices are numbered as the base is grown, and split i makes vertex
//! `base + i`; faces are numbered in the order in which they appear, and begin at any corner. `write::mesh` puts a mesh
//! into an order that does not depend on numbers, so that files can be compared.
//!
//! # Promises
//! - Every prefix is bit for bit the mesh that the collapses leave, whatever the mesh: edges of three faces, turned
//!   faces, pairs without an edge (`every_prefix_replays_bit_for_bit`).
//! - Deviations are rounded up, by 19 % at most: bounds stay bounds, for a choice by budgets too
//!   (`a_choice_by_budgets_keeps_every_source_vertex_within_them`).
//! - Damage is noticed (`any_byte_flipped_is_an_error`); nonsense under right checksums gives an error or a valid mesh,
//!   in memory bounded by the file's size (`nonsense_under_right_checksums_is_an_error_or_a_valid_mesh`).
//!
//! # Cost
//! Bytes a source triangle, down to 1 % of the faces, 1/128 m grid (`--grid 0.01`), with classes and deviations, half-edge
//! and placed freely: a building of 295 k faces (0.17 m between vertices) 2.59 and 3.62, a crossing of 240 k 2.65 and 3.71,
//! a house of 749 k 2.61 and 3.57, a campus of 146 k (1.6 m: 200 steps) 3.19 and 4.74. Of the building's 41 bits for two
//! faces 17 say which vertex, 15 where, 5 which faces go where, 3.5 how far off; on the campus it is 14 and 23, for a step
//! of the grid is a smaller part of an edge there. Per second of one
//! busy core: 0.33 M splits encoded, 0.5 M decoded (half-edge), 86 M and more replayed by
//! [`Progressive::at`], 8 M by [`Progressive::within`]. Encoding needs less memory than the collapse before it.
//! What paid in bytes (bits for two faces, building and campus, from 43.9 and 52.1): whose side a face takes by where the
//! neighbours lie, and places fitted to absolute errors (1.0, 0.7); the largest energy so far in place of each (0.8, 0.9);
//! deviations by class under those of the split before there (0.6, 0.9); folds in pairs (0.1, 0.7); plain means while
//! little is known (0.1, 0.1).
//! What paid in decoding (0.34 → 0.6 M/s in one run): stars of 32 splits told and fetched ahead, a vertex with its list in
//! half a line and a face with its class in a quarter, points read once a split, probabilities in place and without
//! branches. A third of the time left is in the coder's bits, a sixth in ordering stars.
//!
//! # Why not …
//! - Batches of independent splits in spatial order: 10 bits less for the vertex, but inside a batch the order is lost,
//!   and with it replay to an exact number of faces; keeping the order costs the same 10 bits.
//! - Filing vertices by how bent the surface is around them, or by their number of faces, and coding the file first: the
//!   vertex took 0.5 bits less and decoding half as long again. Area, height and number of faces together: 0.6.
//! - The number of neighbours as a context of places, the deviation there as one of the height, the distance of the middle
//!   of the neighbours as one of the sides: none gained.
//! - The height that energy and area tell of as a context of the coordinate off the plane: no gain.
//! - The refit as a last step of the record: it follows every source vertex to the face it is on, which is forgotten;
//!   storing the places it finds would serve one cut only.
//!
//! # References
//! Hoppe, Progressive meshes, 1996; Pajarola & Rossignac, Compressed progressive meshes, 2000 (prediction by the new
//! neighbours); Gandoin & Devillers 2002 (any triangles).

mod base;
mod coder;
mod decode;
mod encode;
mod file;
mod history;
mod level;
mod live;
mod progressive;
mod split;

pub use super::Sequence;
pub use decode::Record;
pub use encode::encode;
pub use file::{About, ChunkInfo, Header};
pub use level::{level_of, size_of};
pub use progressive::{Progressive, Replayed};

pub(crate) use super::NONE;

/// Classes with a tracked deviation of their own.
pub const MAX_CLASSES: usize = super::MOST_CLASSES;

#[cfg(test)]
mod engine_tests;
#[cfg(test)]
mod tests;
