//! Tells roof, façade, terrain and clutter apart without training.

use crate::ids::{ClassId, ClassScheme};

/// A probability per class for every face.
#[derive(Debug, Clone)]
pub struct Classes {
    /// The classes and their budgets.
    pub scheme: ClassScheme,
    /// `face * scheme.len() + class`: P(class | face), each face sums to 1.
    pub posterior: Vec<f32>,
    /// The most probable class per face.
    pub label: Vec<ClassId>,
}

impl Classes {
    /// P(class | face) over all classes of face `f`.
    pub fn of(&self, f: usize) -> &[f32] {
        let n = self.scheme.len();
        &self.posterior[f * n..(f + 1) * n]
    }
}
