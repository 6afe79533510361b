//! The paper's classifier, and its better readings, driven by a [`Table`].
//!
//! In: features of vertices, a table. Out: a probability per class of the table, for every face.
//!
//! # Method
//! 1. Eq. 9: each feature, divided by its scale and clamped, favours or penalises a class or leaves it alone.
//! 2. Eq. 10 or 13: their sum, S; 13 multiplies by the scale once more.
//! 3. Eq. 14: P = exp(-S); `normalise` makes it sum to 1.
//! 4. Eq. 15: the mean of P over the nearest vertices. (Printed with the sums over Nb(i); meant is Nb(n).)
//! 5. Eq. 16 names the class of a vertex. A face takes the mean of its three corners' P, made to sum to 1.
//!
//! # Numbers
//! `tables.toml`
//!
//! # Limits
//! Eq. 13 with the printed tables never yields façade; [`Table::unreachable`] proves it for any table.
//! Eq. 12, the sum over all classes, is constant at a vertex, decides nothing, and is left out.
//!
//! # References
//! the paper, §2.2, §3.2, Tables 1 and 2; CGAL Classification, `Sum_of_weighted_features_classifier.h`

use rayon::prelude::*;

use super::nine::Measures;
use crate::mesh::Mesh;
use crate::planes::NONE;

mod table;

pub use table::{Effect, Energy, Row, Table};

/// Everything a table needs of a mesh; made once, judged by many tables of the same features.
pub struct Evidence {
    /// Per row of the table, the feature at each vertex.
    features: Vec<Vec<f32>>,
    /// Per row, the greatest value and the median over vertices in planar regions.
    extremes: Vec<[f64; 2]>,
    neighbourhoods: Vec<Vec<u32>>,
}

impl Evidence {
    /// Measures what the rows of `table` name. Names that do not exist, which `faults` refuses, count as 0.
    pub fn of(measures: &Measures, mesh: &Mesh, table: &Table) -> Self {
        let count = mesh.positions.len();
        let one = |row: &Row| measures.of_vertices(&row.feature, table.form).unwrap_or_else(|| vec![0.0; count]);
        let features: Vec<Vec<f32>> = table.rows.iter().map(one).collect();
        let regions = measures.vertex_regions();
        let extremes = features.iter().map(|values| {
            let greatest = values.iter().copied().fold(0.0f32, f32::max);
            let mut planar: Vec<f32> =
                values.iter().zip(regions).filter(|(_, r)| **r != NONE).map(|(v, _)| *v).collect();
            let middle = planar.len() / 2;
            let median = if planar.is_empty() { 0.0 } else { *planar.select_nth_unstable_by(middle, f32::total_cmp).1 };
            [f64::from(greatest), f64::from(median)]
        });
        let extremes = extremes.collect();
        Self { features, extremes, neighbourhoods: measures.neighbourhoods() }
    }
}

/// A probability per class of `table` and face, flat.
pub fn posterior(mesh: &Mesh, evidence: &Evidence, table: &Table) -> Vec<f32> {
    let classes = table.classes.len();
    let mut of_vertices = initial(evidence, table, mesh.positions.len());
    for _ in 0..table.sweeps {
        of_vertices = smoothed(&of_vertices, &evidence.neighbourhoods, classes);
    }
    let of_face = |face: &[u32; 3]| -> Vec<f32> {
        let sum = |c: usize| face.iter().map(|v| of_vertices[*v as usize * classes + c]).sum::<f64>();
        let sums: Vec<f64> = (0..classes).map(sum).collect();
        let all: f64 = sums.iter().sum();
        sums.iter().map(|s| if all > 0.0 { (s / all) as f32 } else { 1.0 / classes as f32 }).collect()
    };
    mesh.faces.par_iter().with_min_len(4096).flat_map_iter(of_face).collect()
}

/// Eq. 9, 10 or 13, and 14: a probability per vertex and class, flat.
fn initial(evidence: &Evidence, table: &Table, vertices: usize) -> Vec<f64> {
    struct Judge<'a> {
        values: &'a [f32],
        scale: f64,
        weight: f64,
        effects: Vec<Effect>,
    }
    let judges: Vec<Judge> = table
        .rows
        .iter()
        .zip(evidence.features.iter().zip(&evidence.extremes))
        .map(|(row, (values, [greatest, median]))| {
            let scale = row.scale.or(row.of_greatest.map(|s| s * greatest)).or(row.of_median.map(|s| s * median));
            // A feature that is 0 everywhere has no scale and says nothing.
            let scale = scale.unwrap_or(1.0).max(1e-12);
            let weight = if table.energy == Energy::Eq13 { scale } else { 1.0 };
            Judge { values, scale, weight, effects: row.effects() }
        })
        .collect();
    let classes = table.classes.len();
    let of_vertex = |v: usize| -> Vec<f64> {
        let mut energies = vec![0.0; classes];
        for judge in &judges {
            let t = (f64::from(judge.values[v]) / judge.scale).clamp(0.0, 1.0);
            for (energy, effect) in energies.iter_mut().zip(&judge.effects) {
                *energy += judge.weight * effect.energy(t);
            }
        }
        let mut chances: Vec<f64> = energies.iter().map(|s| (-s).exp()).collect();
        if table.normalise {
            let sum: f64 = chances.iter().sum();
            chances.iter_mut().for_each(|p| *p /= sum.max(f64::MIN_POSITIVE));
        }
        chances
    };
    (0..vertices).into_par_iter().with_min_len(4096).flat_map_iter(of_vertex).collect()
}

/// Eq. 15: the mean over each neighbourhood.
fn smoothed(chances: &[f64], neighbourhoods: &[Vec<u32>], classes: usize) -> Vec<f64> {
    let of_vertex = |near: &Vec<u32>| -> Vec<f64> {
        let count = near.len().max(1) as f64;
        (0..classes).map(|c| near.iter().map(|v| chances[*v as usize * classes + c]).sum::<f64>() / count).collect()
    };
    neighbourhoods.par_iter().with_min_len(4096).flat_map_iter(of_vertex).collect()
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// Four vertices, two faces, one feature with values by hand.
    fn two_faces(values: [f32; 4]) -> (Mesh, Evidence) {
        let positions = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::new(1.0, 1.0, 0.0)];
        let mesh = Mesh { positions, faces: vec![[0, 1, 2], [1, 3, 2]], ..Mesh::default() };
        let neighbourhoods = vec![vec![0, 1], vec![1], vec![2], vec![3]];
        (mesh, Evidence { features: vec![values.to_vec()], extremes: vec![[4.0, 2.0]], neighbourhoods })
    }

    fn table(energy: Energy, row: Row) -> Table {
        let classes = vec!["roof".into(), "terrain".into()];
        let form = super::super::nine::Form::Paper;
        Table { energy, form, normalise: false, sweeps: 0, classes, rows: vec![row] }
    }

    fn row(scale: Option<f64>, of_greatest: Option<f64>, of_median: Option<f64>) -> Row {
        Row { feature: "elevation".into(), scale, of_greatest, of_median, effects: "F P".into() }
    }

    #[test]
    fn equations_9_10_and_14_by_hand() {
        let (mesh, evidence) = two_faces([2.0; 4]);
        // t = 2 / 8: roof pays 0.75, terrain 0.25.
        let found = posterior(&mesh, &evidence, &table(Energy::Eq10, row(Some(8.0), None, None)));
        let (roof, terrain) = ((-0.75f64).exp(), (-0.25f64).exp());
        assert!((f64::from(found[0]) - roof / (roof + terrain)).abs() < 1e-6, "{found:?}");
        assert!((found[0] + found[1] - 1.0).abs() < 1e-6);
    }

    #[test]
    fn equation_13_multiplies_by_the_scale_again() {
        let (mesh, evidence) = two_faces([2.0; 4]);
        let found = posterior(&mesh, &evidence, &table(Energy::Eq13, row(Some(8.0), None, None)));
        let (roof, terrain) = ((-6.0f64).exp(), (-2.0f64).exp());
        assert!((f64::from(found[0]) - roof / (roof + terrain)).abs() < 1e-6, "{found:?}");
    }

    #[test]
    fn scales_may_follow_the_data() {
        let (mesh, evidence) = two_faces([2.0; 4]);
        let of = |row: Row| posterior(&mesh, &evidence, &table(Energy::Eq10, row));
        assert_eq!(of(row(None, Some(2.0), None)), of(row(Some(8.0), None, None)), "twice the greatest, 4");
        assert_eq!(of(row(None, None, Some(4.0))), of(row(Some(8.0), None, None)), "four times the median, 2");
    }

    #[test]
    fn equation_15_averages_probabilities_over_the_neighbours() {
        let (mesh, evidence) = two_faces([0.0, 8.0, 0.0, 0.0]);
        let mut table = table(Energy::Eq10, row(Some(8.0), None, None));
        table.normalise = true;
        let raw = initial(&evidence, &table, 4);
        let smooth = smoothed(&raw, &evidence.neighbourhoods, 2);
        assert!((smooth[0] - (raw[0] + raw[2]) / 2.0).abs() < 1e-12, "vertex 0 hears itself and vertex 1");
        assert_eq!(smooth[2..], raw[2..], "the others hear themselves");
        assert!((raw[0] + raw[1] - 1.0).abs() < 1e-12 && mesh.faces.len() == 2);
    }
}
