//! Records a collapse sequence in a few bytes a triangle, and replays it at any detail.
mod base;
mod coder;
mod decode;
mod encode;
mod file;
mod level;
mod live;
mod progressive;
mod split;
mod stand_in;

pub use decode::Record;
pub use encode::encode;
pub use file::{About, ChunkInfo, Header};
pub use level::{level_of, size_of};
pub use progressive::{Progressive, Replayed};
pub use stand_in::{Event, Sequence, Simplified, Target, simplify};

pub(crate) use super::NONE;

/// Classes with a tracked deviation of their own.
pub const MAX_CLASSES: usize = 8;

#[cfg(test)]
mod tests;
