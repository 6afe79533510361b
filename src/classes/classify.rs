//! One door to all classifiers: picks the one asked for and gives its classes the scheme's names.

use serde::{Deserialize, Serialize};

use super::nine::{Measures, Scene};
use super::paper::{Evidence, Table, posterior};
use super::scheme::{BASE, looks_at, spread};
use super::{Classes, ClassesConfig, Ground, robust};
use crate::ids::ClassScheme;

/// Which rules tell classes apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Classifier {
    /// The paper's, as printed: Eq. 9, 13, 14, 15. It never yields façade.
    Paper,
    /// The paper's with Eq. 10 for Eq. 13.
    PaperEq10,
    /// The paper's tables over CGAL's features, scales of their size, and a ground model.
    Cgal,
    /// Product rules, mean field, votes and context; see [`super`].
    #[default]
    Robust,
}

impl Classifier {
    /// The name in settings and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::PaperEq10 => "paper-eq10",
            Self::Cgal => "cgal",
            Self::Robust => "robust",
        }
    }
}

impl ClassesConfig {
    /// The table that drives the classifier: the configured one, else the embedded one; none for `robust`.
    pub fn table(&self) -> Option<&Table> {
        match self.classifier {
            Classifier::Robust => None,
            other => self.table.as_ref().or_else(|| Table::embedded(other.name())),
        }
    }

    /// What a user should know about the classifier before trusting it; a sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let Some(table) = self.table() else { return Vec::new() };
        let one = |(class, winner, least): (String, String, f64)| {
            format!(
                "with {} nothing is ever called {class}: its energy exceeds that of {winner} by at least {least:.2}, \
                 whatever the features say; use --classifier robust",
                self.classifier.name()
            )
        };
        table.unreachable().into_iter().map(one).collect()
    }
}

/// Does the labelling look at colours? Then the scene should have them.
pub fn looks_at_colors(scheme: &ClassScheme, config: &ClassesConfig) -> bool {
    let in_table = |table: &Table| table.rows.iter().any(|r| r.feature == "greenness");
    looks_at(scheme, "greenness") || looks_at(scheme, "patch_greenness") || config.table().is_some_and(in_table)
}

/// Gives every face its probabilities with the configured classifier.
///
/// # Panics
/// If the scheme is empty, which its check refuses.
pub fn classify(scene: Scene, scheme: &ClassScheme, config: &ClassesConfig) -> Classes {
    let ground = Ground::of(scene.mesh, scene.planes, config);
    let measures = Measures::new(scene, &ground, &config.nine);
    classify_measured(scene, &ground, &measures, scheme, config)
}

/// The same with ground and measures made before.
///
/// # Panics
/// If the scheme is empty, which its check refuses.
pub fn classify_measured(
    scene: Scene,
    ground: &Ground,
    measures: &Measures,
    scheme: &ClassScheme,
    config: &ClassesConfig,
) -> Classes {
    assert!(!scheme.is_empty(), "a class scheme without classes passed its check");
    let neighbours = &scene.planes.neighbours;
    let base = || BASE.iter().map(|s| (*s).to_owned()).collect();
    let (sources, chances): (Vec<String>, Vec<f32>) = match config.table() {
        None => (base(), robust(scene, neighbours, ground, config).into_flattened()),
        Some(table) => {
            let evidence = Evidence::of(measures, scene.mesh, table);
            (table.classes.clone(), posterior(scene.mesh, &evidence, table))
        }
    };
    spread(scene.mesh, measures, neighbours, scheme, &sources, chances)
}
