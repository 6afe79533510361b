//! Wire formats as plain structs: what stands in the files, without logic.
//!
//! Maps are sorted and absent values are left out, so the same content gives the same bytes. Unknown fields are
//! ignored on reading: files of other tools are read too.

pub mod gltf;
pub mod metadata;
pub mod tileset;
