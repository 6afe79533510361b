//! Tables 1 and 2 as data: which feature favours which class, and at which scale.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use super::super::nine::{self, Form};

/// What a table-driven classifier goes by.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Table {
    /// How effects are added up.
    pub energy: Energy,
    /// Which reading of the features.
    pub form: Form,
    /// Probabilities sum to 1 at each vertex before they are averaged. Eq. 14 does not; then loud vertices dominate.
    pub normalise: bool,
    /// How often Eq. 15 is applied, 0 to 20. The paper: once.
    pub sweeps: u32,
    /// Names of classes: of the scheme, or `terrain`, `facade`, `roof`, `clutter`.
    pub classes: Vec<String>,
    /// One per feature.
    pub rows: Vec<Row>,
}

/// The sum whose negative exponential is a class's probability.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Energy {
    /// Σ F, as in CGAL.
    Eq10,
    /// Σ w·F, as the paper's Eq. 13 has it.
    Eq13,
}

/// A line of Tables 1 and 2. Exactly one of the three scales is given.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// One of [`nine::FEATURES`].
    pub feature: String,
    /// The value at which the feature saturates, in its unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// The same as a multiple of the data set's greatest value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of_greatest: Option<f64>,
    /// The same as a multiple of the median over vertices in planar regions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of_median: Option<f64>,
    /// F, N or P per class, with spaces between.
    pub effects: String,
}

/// Effect of a high value on a class.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    /// The class is preferred.
    Favours,
    /// No effect: 0.5.
    Neutral,
    /// The class is avoided.
    Penalises,
}

impl Effect {
    /// Eq. 9 of the saturated value `t` = clamp(f / w, 0, 1). An energy: low is good.
    pub fn energy(self, t: f64) -> f64 {
        match self {
            Self::Favours => 1.0 - t,
            Self::Neutral => 0.5,
            Self::Penalises => t,
        }
    }
}

impl Row {
    /// The effects in order; letters other than F, N, P are refused by [`Table::faults`] and count as N.
    pub fn effects(&self) -> Vec<Effect> {
        let letter = |word: &str| match word {
            "F" => Effect::Favours,
            "P" => Effect::Penalises,
            _ => Effect::Neutral,
        };
        self.effects.split_whitespace().map(letter).collect()
    }

    /// The one number that `tune` varies: whichever scale is given.
    pub fn factor_mut(&mut self) -> Option<&mut f64> {
        self.scale.as_mut().or(self.of_greatest.as_mut()).or(self.of_median.as_mut())
    }
}

/// The embedded tables, by the classifier's name.
static EMBEDDED: LazyLock<BTreeMap<String, Table>> =
    LazyLock::new(|| toml::from_str(include_str!("tables.toml")).expect("the embedded tables are read by a test"));

impl Table {
    /// The embedded table called `paper`, `paper-eq10` or `cgal`.
    pub fn embedded(name: &str) -> Option<&'static Self> {
        EMBEDDED.get(name)
    }

    /// Every mistake, as a sentence. `is_class` tells the names that classes may have.
    pub fn faults(&self, is_class: impl Fn(&str) -> bool) -> Vec<String> {
        let mut faults = Vec::new();
        let mut fault = |what: String| faults.push(format!("classify.table: {what}"));
        if self.classes.is_empty() || self.rows.is_empty() {
            fault("wanted at least one class and one row".into());
        }
        if self.sweeps > 20 {
            fault(format!("sweeps is {}, wanted 0 to 20", self.sweeps));
        }
        for (i, class) in self.classes.iter().enumerate() {
            if !is_class(class) {
                fault(format!("class {class:?} is neither in the scheme nor one of terrain, facade, roof, clutter"));
            } else if self.classes[..i].contains(class) {
                fault(format!("class {class:?} stands there twice"));
            }
        }
        for row in &self.rows {
            let name = &row.feature;
            if nine::range(name, self.form).is_none() {
                fault(format!("there is no feature {name:?}; `rooftile label --features` lists them"));
            }
            let words: Vec<&str> = row.effects.split_whitespace().collect();
            if words.len() != self.classes.len() || words.iter().any(|w| !matches!(*w, "F" | "N" | "P")) {
                let wanted = self.classes.len();
                fault(format!("effects of {name} are {:?}, wanted {wanted} of F, N, P", row.effects));
            }
            let scales = [row.scale, row.of_greatest, row.of_median];
            if scales.iter().flatten().count() != 1 || scales.iter().flatten().any(|s| !(1e-9..=1e9).contains(s)) {
                fault(format!("{name} wants one positive number: scale, of_greatest or of_median"));
            }
        }
        faults
    }

    /// Classes that lose to another one whatever the features' values: (class, winner, least difference of energies).
    ///
    /// Exact for a pair: each feature's share of the difference is linear in its saturated value t in [0, `t_max`], where
    /// `t_max` < 1 for a feature whose range ends before its scale, so the least sum is the sum of the least shares. Rows
    /// whose scale depends on the data are taken over all t in [0, 1]; their scale in Eq. 13 may be any from 0 to 1e9
    /// times, so a pair that differs there is never called unreachable.
    pub fn unreachable(&self) -> Vec<(String, String, f64)> {
        let mut found = Vec::new();
        for (a, loser) in self.classes.iter().enumerate() {
            let against = |b: usize| self.least_difference(a, b);
            let best = (0..self.classes.len()).filter(|b| *b != a).map(|b| (b, against(b)));
            let best = best.filter(|(_, least)| *least > 0.0).max_by(|x, y| x.1.total_cmp(&y.1).then(y.0.cmp(&x.0)));
            if let Some((b, least)) = best {
                found.push((loser.clone(), self.classes[b].clone(), least));
            }
        }
        found
    }

    /// The least of S(a) - S(b) over all values of all features.
    fn least_difference(&self, a: usize, b: usize) -> f64 {
        let share = |row: &Row| {
            let effects = row.effects();
            let (Some(ea), Some(eb)) = (effects.get(a), effects.get(b)) else { return f64::NEG_INFINITY };
            if ea == eb {
                return 0.0;
            }
            let (t_max, weight) = match (row.scale, self.energy) {
                (Some(scale), energy) => {
                    let [_, high] = nine::range(&row.feature, self.form).unwrap_or([0.0, f64::INFINITY]);
                    ((high / scale).min(1.0), if energy == Energy::Eq13 { scale } else { 1.0 })
                }
                (None, Energy::Eq10) => (1.0, 1.0),
                (None, Energy::Eq13) => return f64::NEG_INFINITY,
            };
            let at = |t: f64| weight * (ea.energy(t) - eb.energy(t));
            at(0.0).min(at(t_max))
        };
        self.rows.iter().map(share).sum()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn table(name: &str) -> Table {
        Table::embedded(name).expect("an embedded table").clone()
    }

    const BASE: [&str; 4] = ["terrain", "facade", "roof", "clutter"];

    #[test]
    fn the_embedded_tables_have_no_faults_and_are_those_of_the_paper() {
        for name in ["paper", "paper-eq10", "cgal"] {
            assert_eq!(table(name).faults(|c| BASE.contains(&c)), Vec::<String>::new(), "{name}");
        }
        let (paper, eq10) = (table("paper"), table("paper-eq10"));
        assert_eq!((paper.rows.len(), &paper.rows), (9, &eq10.rows), "they differ in the energy alone");
        let scales: Vec<_> = paper.rows.iter().map(|r| r.scale.or(r.of_greatest).unwrap_or(0.0)).collect();
        assert_eq!(scales, [5.0, 5.0, 5.0, 2.0, 5.0, 0.01, 0.5, 2.5, 2.5], "Table 2");
        let effects: Vec<String> = paper.rows.iter().map(|r| r.effects.replace(' ', "")).collect();
        assert_eq!(effects, ["NNNF", "NNNF", "PFFP", "PFPP", "PFPN", "FFFP", "PPPF", "FFFP", "FFFP"], "Table 1");
        assert_eq!(Table::embedded("robust"), None);
    }

    /// S of façade minus S of roof, Eq. 13, for the saturated values of the nine features.
    fn facade_minus_roof(table: &Table, values: &[f64]) -> f64 {
        table
            .rows
            .iter()
            .zip(values)
            .map(|(row, value)| {
                let scale = row.scale.or(row.of_greatest).unwrap_or(1.0);
                let t = (value / scale).clamp(0.0, 1.0);
                let effects = row.effects();
                let weight = if table.energy == Energy::Eq13 { scale } else { 1.0 };
                weight * (effects[1].energy(t) - effects[2].energy(t))
            })
            .sum()
    }

    #[test]
    fn equation_13_with_tables_1_and_2_never_yields_facade() {
        // Façade and roof differ in vertical range (F, P; w = 2) and verticality (F, P; w = 5, at most 1):
        // (2 - 2 vr) + (5 - 2 v) with vr <= 2 and v <= 1 is at least -2 + 3 = 1.
        let unreachable = table("paper").unreachable();
        let facade = unreachable.iter().find(|(class, _, _)| class == "facade").expect("the paper's flaw");
        assert!(facade.1 == "roof" && (facade.2 - 1.0).abs() < 1e-12, "{facade:?}");
    }

    #[test]
    fn equation_10_with_the_same_tables_can_yield_facade_and_so_can_cgal() {
        for name in ["paper-eq10", "cgal"] {
            assert!(!table(name).unreachable().iter().any(|(class, _, _)| class == "facade"), "{name}");
        }
        let wall = [0.0, 0.0, 10.0, 8.0, 1.0, 1.0, 0.0, 1e3, 1e3];
        assert!(facade_minus_roof(&table("paper-eq10"), &wall) < 0.0);
    }

    #[test]
    fn a_grid_over_all_feature_values_finds_no_facade_under_equation_13() {
        let paper = table("paper");
        let steps = |feature: &str| {
            let high = nine::range(feature, Form::Paper).expect("a range")[1].min(20.0);
            (0..=4).map(move |k| high * f64::from(k) / 4.0)
        };
        let mut least = f64::INFINITY;
        for range in steps("vertical_range") {
            for upright in steps("verticality") {
                for rest in 0..=4 {
                    let r = f64::from(rest) * 5.0;
                    least = least.min(facade_minus_roof(&paper, &[r, 0.5, r, range, upright, 1.0, 1.0, r, r]));
                }
            }
        }
        assert!((least - 1.0).abs() < 1e-12, "the bound is met, and met exactly: {least}");
    }

    proptest! {
        #[test]
        fn no_values_of_the_nine_features_make_facade_win_under_equation_13(
            values in prop::collection::vec(0.0f64..1e4, 9), unit in prop::collection::vec(0.0f64..=1.0, 3),
        ) {
            let mut values = values;
            (values[1], values[4], values[5]) = (unit[0], unit[1], unit[2]);
            prop_assert!(facade_minus_roof(&table("paper"), &values) >= 1.0 - 1e-9);
        }
    }

    #[test]
    fn mistakes_in_a_table_are_named_all_at_once() {
        let mut wrong = table("paper");
        wrong.classes[3] = "roof".into();
        wrong.rows[0].feature = "colour".into();
        wrong.rows[1].effects = "F N X P".into();
        wrong.rows[2].of_median = Some(1.0);
        wrong.rows[3].scale = Some(-1.0);
        let faults = wrong.faults(|c| BASE.contains(&c)).join("\n");
        for word in ["twice", "colour", "F N X P", "elevation wants one", "vertical_range wants one"] {
            assert!(faults.contains(word), "{word} in {faults}");
        }
        assert!(table("paper").faults(|_| false).len() == 4);
    }
}
