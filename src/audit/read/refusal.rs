//! Why something of a tileset is not read; the rest of it is.

use crate::Error;

/// Why a file or a tile is not read: counted by its code, said once in words.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// Stable name, such as `missing`, `draco`, `broken-gltf`.
    pub code: &'static str,
    /// What was found and what was wanted.
    pub what: String,
}

impl Refusal {
    /// A refusal of the kind `code`.
    pub fn new(code: &'static str, what: impl Into<String>) -> Self {
        Self { code, what: what.into() }
    }
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} ({})", self.what, self.code)
    }
}

/// Shorthand for `Err(Refusal)`.
pub(super) fn refuse<T>(code: &'static str, what: impl Into<String>) -> Result<T, Refusal> {
    Err(Refusal::new(code, what))
}

/// What the glTF reader says, as a refusal of the tile. Its paths are not shown twice.
pub(super) fn of_gltf(error: Error) -> Refusal {
    let (code, what) = match error {
        Error::Input { what, .. } => ("broken-gltf", what),
        Error::Unsupported { what, .. } => ("unsupported-gltf", what),
        Error::Limit { what, .. } => ("too-large", what),
        other => ("unreadable", other.to_string()),
    };
    Refusal::new(code, what)
}
