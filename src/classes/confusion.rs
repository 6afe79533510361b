//! How well labels agree with the truth.

use serde::Serialize;

use crate::ids::ClassId;

/// A weighted confusion matrix and the numbers read off it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Confusion {
    /// `[truth][predicted]`, sums of weights.
    pub matrix: Vec<Vec<f64>>,
    /// Share of the weight whose label is right, 0 to 1; 1 for nothing at all.
    pub overall_accuracy: f64,
    /// Intersection over union per class; none for a class in neither truth nor prediction.
    pub iou: Vec<Option<f64>>,
    /// Mean over the classes that have an IoU.
    pub mean_iou: f64,
}

/// Compares two labellings, item by item; weights are areas as a rule. Items beyond the shortest list are ignored.
pub fn confusion(truth: &[ClassId], predicted: &[ClassId], weights: &[f64]) -> Confusion {
    let classes = truth.iter().chain(predicted).map(|c| c.index() + 1).max().unwrap_or(0);
    let mut matrix = vec![vec![0.0f64; classes]; classes];
    for ((t, p), w) in truth.iter().zip(predicted).zip(weights) {
        matrix[t.index()][p.index()] += w;
    }
    let total: f64 = matrix.iter().flatten().sum();
    let right: f64 = (0..classes).map(|c| matrix[c][c]).sum();
    let iou: Vec<Option<f64>> = (0..classes)
        .map(|c| {
            let union = matrix[c].iter().sum::<f64>() + matrix.iter().map(|row| row[c]).sum::<f64>() - matrix[c][c];
            (union > 0.0).then(|| matrix[c][c] / union)
        })
        .collect();
    let known: Vec<f64> = iou.iter().flatten().copied().collect();
    let mean_iou = if known.is_empty() { 1.0 } else { known.iter().sum::<f64>() / known.len() as f64 };
    let overall_accuracy = if total > 0.0 { right / total } else { 1.0 };
    Confusion { matrix, overall_accuracy, iou, mean_iou }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_numbers_of_a_matrix_made_by_hand_are_right() {
        let (t, r, c) = (ClassId::TERRAIN, ClassId::ROOF, ClassId::CLUTTER);
        let found = confusion(&[t, t, r, r, c], &[t, r, r, r, t], &[4.0, 1.0, 2.0, 1.0, 2.0]);
        assert_eq!(found.matrix[t.index()][r.index()], 1.0);
        assert_eq!(found.overall_accuracy, 0.7);
        // Terrain 4 of 4 + 1 + 2, façade nowhere, roof 3 of 3 + 1, clutter 0 of 2.
        assert_eq!(found.iou, [Some(4.0 / 7.0), None, Some(0.75), Some(0.0)]);
        assert!((found.mean_iou - (4.0 / 7.0 + 0.75) / 3.0).abs() < 1e-12);
    }
}
