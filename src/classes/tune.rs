//! Fits the scales of rules to labelled faces by a small search that always goes the same way.
//!
//! In: a classifier's settings, labels for some faces. Out: settings that agree with the labels better, or the same.
//!
//! # Method
//! Coordinate descent in log space: each scale in turn is multiplied and divided by a step and keeps what scores better;
//! steps of 2, √2 and ⁴√2; rounds until nothing improves. The score is the mean of overall accuracy and mean IoU,
//! by area: the first follows large classes, the second small ones.
//!
//! # Promises
//! Never worse on the labels it is given. Same labels, same settings: nothing is drawn at random.
//!
//! # Limits
//! Finds a local optimum, and one scene's: a few strokes on a typical block, not a benchmark.
//!
//! # Cost
//! About 40 to 150 labellings; those of tables measure features once.

use serde::Serialize;

use super::nine::{Measures, Scene};
use super::paper::{Evidence, posterior};
use super::scheme::spread;
use super::truth::{Agreement, Mask, agreement};
use super::{Classes, ClassesConfig, Ground, classify_measured};
use crate::Result;
use crate::ids::ClassScheme;

/// Steps of the search, coarse to fine.
const STEPS: [f64; 3] = [2.0, std::f64::consts::SQRT_2, 1.189_207_115_002_721];
/// Rounds at one step; most end after two.
const MOST_ROUNDS: usize = 4;
/// What counts as better: differences below this are single faces.
const LEAST_GAIN: f64 = 1e-5;

/// What the search found.
#[derive(Debug, Clone, Serialize)]
pub struct Tuned {
    /// Settings to use.
    #[serde(skip)]
    pub config: ClassesConfig,
    /// Names of the scales that changed, with the old and the new value.
    pub changed: Vec<(String, f64, f64)>,
    /// Before.
    pub before: Agreement,
    /// After.
    pub after: Agreement,
    /// Labellings tried.
    pub tried: usize,
}

/// Tunes the scales of the configured classifier to `truth`. `proceed` is asked before every labelling and may stop it.
///
/// # Errors
/// What `proceed` says.
pub fn tune(
    scene: Scene,
    truth: &[Mask],
    scheme: &ClassScheme,
    config: &ClassesConfig,
    mut proceed: impl FnMut() -> Result<()>,
) -> Result<Tuned> {
    let areas: Vec<f64> = (0..scene.mesh.faces.len()).map(|f| 0.5 * scene.mesh.cross(f).length()).collect();
    let ground = Ground::of(scene.mesh, scene.planes, config);
    let measures = Measures::new(scene, &ground, &config.nine);
    let labelling = Labelling {
        scene,
        scheme,
        ground: &ground,
        measures: &measures,
        evidence: config.table().map(|table| Evidence::of(&measures, scene.mesh, table)),
    };
    let judge = |config: &ClassesConfig| agreement(&labelling.of(config), truth, &areas);
    let before = judge(config);
    let mut tried = 1;
    let mut score = |values: &[f64]| {
        proceed()?;
        tried += 1;
        let mut config = config.clone();
        set(&mut config, values);
        // A scale out of its range is no candidate.
        if !config.check().is_empty() {
            return Ok(f64::NEG_INFINITY);
        }
        let found = judge(&config).by_area;
        Ok(0.5 * (found.overall_accuracy + found.mean_iou))
    };
    let (names, start): (Vec<String>, Vec<f64>) = scales(&mut config.clone()).into_iter().map(|(n, v)| (n, *v)).unzip();
    let values = descend(&start, &mut score)?;
    let mut tuned = config.clone();
    set(&mut tuned, &values);
    let rows = names.into_iter().zip(start.iter().zip(&values)).filter(|(_, (old, new))| old != new);
    let changed = rows.map(|(name, (old, new))| (name, *old, *new)).collect();
    Ok(Tuned { after: judge(&tuned), config: tuned, changed, before, tried })
}

/// The scales that are searched, by name.
fn scales(config: &mut ClassesConfig) -> Vec<(String, &mut f64)> {
    if config.table().is_none() {
        let ClassesConfig {
            low_m,
            high_m,
            wall_height_m,
            upright_deg,
            area_scale_m2,
            foliage_spread,
            smoothing,
            min_footprint_m2,
            ..
        } = config;
        return vec![
            ("low_m".into(), low_m),
            ("high_m".into(), high_m),
            ("wall_height_m".into(), wall_height_m),
            ("upright_deg".into(), upright_deg),
            ("area_scale_m2".into(), area_scale_m2),
            ("foliage_spread".into(), foliage_spread),
            ("smoothing".into(), smoothing),
            ("min_footprint_m2".into(), min_footprint_m2),
        ];
    }
    if config.table.is_none() {
        config.table = config.table().cloned();
    }
    let rows = config.table.iter_mut().flat_map(|table| &mut table.rows);
    rows.filter_map(|row| Some((row.feature.clone(), row.factor_mut()?))).collect()
}

fn set(config: &mut ClassesConfig, values: &[f64]) {
    scales(config).into_iter().zip(values).for_each(|((_, scale), value)| *scale = *value);
}

/// Coordinate descent by factors; see the module.
fn descend(start: &[f64], score: &mut impl FnMut(&[f64]) -> Result<f64>) -> Result<Vec<f64>> {
    let mut best = start.to_vec();
    let mut most = score(&best)?;
    for step in STEPS {
        for _ in 0..MOST_ROUNDS {
            let before = most;
            for k in 0..best.len() {
                for factor in [step, 1.0 / step] {
                    // As far as it helps in one direction; then the other need not be tried.
                    let mut moved = false;
                    loop {
                        let mut next = best.clone();
                        next[k] = rounded(next[k] * factor);
                        let found = score(&next)?;
                        if found < most + LEAST_GAIN {
                            break;
                        }
                        (best, most, moved) = (next, found, true);
                    }
                    if moved {
                        break;
                    }
                }
            }
            if most < before + LEAST_GAIN {
                break;
            }
        }
    }
    Ok(best)
}

/// To four digits: settings are read by people.
fn rounded(value: f64) -> f64 {
    let unit = 10f64.powi(value.abs().max(1e-300).log10().floor() as i32 - 3);
    let steps = (value / unit).round();
    // Dividing by a power of ten is exact where multiplying by its inverse is not.
    if unit < 1.0 { steps / (1.0 / unit).round() } else { steps * unit }
}

/// What need not be measured again for every candidate.
struct Labelling<'a> {
    scene: Scene<'a>,
    scheme: &'a ClassScheme,
    ground: &'a Ground,
    measures: &'a Measures<'a>,
    evidence: Option<Evidence>,
}

impl Labelling<'_> {
    fn of(&self, config: &ClassesConfig) -> Classes {
        match (&self.evidence, config.table()) {
            (Some(evidence), Some(table)) => {
                let chances = posterior(self.scene.mesh, evidence, table);
                spread(
                    self.scene.mesh,
                    self.measures,
                    &self.scene.planes.neighbours,
                    self.scheme,
                    &table.classes,
                    chances,
                )
            }
            _ => classify_measured(self.scene, self.ground, self.measures, self.scheme, config),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_search_finds_the_bottom_of_a_bowl_and_counts_on_nothing_else() {
        let mut asked = 0;
        let mut score = |v: &[f64]| {
            asked += 1;
            Ok(-((v[0] / 8.0).ln().powi(2) + (v[1] / 0.1).ln().powi(2)))
        };
        let found = descend(&[1.0, 1.0], &mut score).unwrap();
        assert!((found[0] / 8.0).ln().abs() < 0.1 && (found[1] / 0.1).ln().abs() < 0.1, "{found:?}");
        assert!(asked < 120, "{asked}");
    }

    #[test]
    fn a_flat_score_changes_nothing() {
        assert_eq!(descend(&[0.9, 3.0], &mut |_: &[f64]| Ok(0.5)).unwrap(), [0.9, 3.0]);
    }

    #[test]
    fn values_are_rounded_to_what_people_read() {
        assert_eq!([0.123_456, 12_345.6, 1.0, 0.05].map(rounded), [0.1235, 12_350.0, 1.0, 0.05]);
    }
}
