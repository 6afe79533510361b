//! Labels that somebody gave: what their names mean in a scheme, how well classes agree with them, how they override.
//!
//! A label is a set of classes, as a bit mask: SUM's `building` is façade or roof and says no more.

use serde::Serialize;

use super::scheme::BASE;
use super::{Classes, Confusion, confusion};
use crate::ids::{ClassId, ClassScheme};

/// The classes a face may have, bit c for class c; 0: not labelled.
pub type Mask = u32;

/// Names by what they mean, most telling first; a name means the first of which it contains a word.
const MEANINGS: [(&[&str], &[&str]); 9] = [
    (&["unclassified", "unknown", "unlabel", "none", "interior", "buildingfloor", "floorsurface"], &[]),
    (&["roof", "dormer", "chimney", "rooflight"], &["roof"]),
    (
        &[
            "buildingwall",
            "wallsurface",
            "facade",
            "façade",
            "window",
            "door",
            "closuresurface",
            "ceilingsurface",
            "balcony",
        ],
        &["facade"],
    ),
    (&["buildingfurniture"], &["clutter"]),
    (&["building"], &["facade", "roof"]),
    (
        &["ground", "terrain", "road", "landuse", "plantcover", "soil", "grass", "pavement", "lowvegetation"],
        &["terrain"],
    ),
    (&["water", "river", "lake"], &["water", "terrain"]),
    (&["vegetation", "tree", "forest", "bush", "hedge"], &["vegetation", "clutter"]),
    (
        &["vehicle", "car", "boat", "clutter", "generic", "furniture", "fence", "separation", "bridge", "pole"],
        &["clutter"],
    ),
];

/// What a name (of a label, a material, a CityGML surface) means in a scheme; 0 for a name that means nothing here.
pub fn mask_of_name(scheme: &ClassScheme, name: &str) -> Mask {
    let name = name.trim().to_lowercase();
    // What is split off a base class is part of it: `clutter` means its vegetation, too, unless a label says so.
    if let Some(id) = scheme.id(&name) {
        return if BASE.contains(&name.as_str()) { mask_of_base(scheme, &name) } else { 1 << id.0 };
    }
    if BASE.contains(&name.as_str()) {
        return mask_of_base(scheme, &name);
    }
    // "high vegetation", "Low_Vegetation", "roof-surface" are one word each.
    let word: String = name.chars().filter(|c| c.is_alphanumeric()).collect();
    if word == "wall" {
        return mask_of_base(scheme, "facade");
    }
    let Some((_, means)) = MEANINGS.iter().find(|(words, _)| words.iter().any(|w| word.contains(w))) else { return 0 };
    if let Some(id) = means.first().filter(|m| !BASE.contains(m)).and_then(|m| scheme.id(m)) {
        return 1 << id.0;
    }
    means.iter().map(|m| mask_of_base(scheme, m)).fold(0, |a, b| a | b)
}

/// The same where the other names that occur are known: `clutter` beside `vegetation` is clutter that is no vegetation.
pub fn mask_among(scheme: &ClassScheme, name: &str, names: &[&str]) -> Mask {
    let mask = mask_of_name(scheme, name);
    let is_named = |c: usize| names.iter().any(|n| n.trim().to_lowercase() == scheme.0[c].name);
    let all_named = (0..scheme.len()).all(|c| (mask >> c) & 1 == 0 || is_named(c));
    match scheme.id(&name.trim().to_lowercase()) {
        Some(id) if all_named => 1 << id.0,
        _ => mask,
    }
}

/// All classes that are a base class or part of it.
fn mask_of_base(scheme: &ClassScheme, base: &str) -> Mask {
    let has = |of: &[String], name: &str| if of.is_empty() { name == base } else { of.iter().any(|o| o == base) };
    let of = scheme.0.iter().enumerate().filter(|(_, c)| has(&c.of, &c.name));
    let mask = of.fold(0, |mask, (i, _)| mask | (1 << i));
    let kindred = match base {
        "terrain" => "ground",
        "facade" | "roof" => "building",
        _ => "vegetation",
    };
    if mask != 0 || !BASE.contains(&base) { mask } else { scheme.id(kindred).map_or(0, |id| 1 << id.0) }
}

/// Agreement with given labels.
#[derive(Debug, Clone, Serialize)]
pub struct Agreement {
    /// What is told apart: classes, joined by `+` where the labels do not tell them apart.
    pub names: Vec<String>,
    /// Faces with a label.
    pub faces: usize,
    /// Weighted by area, m².
    pub by_area: Confusion,
    /// Every face counts one.
    pub by_face: Confusion,
}

/// Holds classes against labels; faces without a label do not count.
pub fn agreement(classes: &Classes, truth: &[Mask], areas_m2: &[f64]) -> Agreement {
    let scheme = &classes.scheme;
    let group = groups(scheme, truth);
    let mut heads: Vec<usize> = group.clone();
    heads.sort_unstable();
    heads.dedup();
    let place = |class: usize| ClassId(heads.partition_point(|h| *h < group[class]) as u8);
    let labelled = || (0..truth.len()).filter(|f| truth[*f] != 0);
    let wanted: Vec<ClassId> = labelled().map(|f| place(truth[f].trailing_zeros() as usize)).collect();
    let found: Vec<ClassId> = labelled().map(|f| place(classes.label[f].index())).collect();
    let areas: Vec<f64> = labelled().map(|f| areas_m2[f]).collect();
    let name = |head: &usize| {
        let members = (0..scheme.len()).filter(|c| group[*c] == *head).map(|c| scheme.0[c].name.as_str());
        members.collect::<Vec<_>>().join("+")
    };
    Agreement {
        names: heads.iter().map(name).collect(),
        faces: wanted.len(),
        by_area: confusion(&wanted, &found, &areas),
        by_face: confusion(&wanted, &found, &vec![1.0; wanted.len()]),
    }
}

/// Per class the least class that the labels do not tell from it.
fn groups(scheme: &ClassScheme, truth: &[Mask]) -> Vec<usize> {
    let mut group: Vec<usize> = (0..scheme.len()).collect();
    let mut seen: Vec<Mask> = truth.to_vec();
    seen.sort_unstable();
    seen.dedup();
    for mask in seen {
        let members: Vec<usize> = (0..scheme.len()).filter(|c| (mask >> c) & 1 == 1).collect();
        let Some(head) = members.iter().map(|c| group[*c]).min() else { continue };
        for old in members.iter().map(|c| group[*c]).collect::<Vec<_>>() {
            group.iter_mut().filter(|g| **g == old).for_each(|g| *g = head);
        }
    }
    group
}

/// Lets given labels override: a labelled face keeps only the classes its label allows.
pub fn overridden(mut classes: Classes, given: &[Mask]) -> Classes {
    let count = classes.scheme.len();
    for ((chances, label), mask) in classes.posterior.chunks_mut(count).zip(&mut classes.label).zip(given) {
        let allowed = |c: usize| (mask >> c) & 1 == 1;
        let places = (0..count).filter(|c| allowed(*c)).count();
        if places == 0 {
            continue;
        }
        let sum: f32 = (0..count).filter(|c| allowed(*c)).map(|c| chances[c]).sum();
        for (c, chance) in chances.iter_mut().enumerate() {
            *chance = match (allowed(c), sum > 1e-6) {
                (false, _) => 0.0,
                (true, true) => *chance / sum,
                (true, false) => 1.0 / places as f32,
            };
        }
        *label = ClassId(super::smooth::best(chances) as u8);
    }
    classes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::ClassSpec;

    fn classes(scheme: ClassScheme, label: &[u8]) -> Classes {
        let count = scheme.len();
        let posterior =
            label.iter().flat_map(|l| (0..count).map(move |c| if c == usize::from(*l) { 1.0 } else { 0.0 }));
        Classes { posterior: posterior.collect(), label: label.iter().map(|l| ClassId(*l)).collect(), scheme }
    }

    #[test]
    fn names_of_sum_citygml_and_3dfier_mean_what_they_should() {
        let scheme = ClassScheme::default();
        let (terrain, facade, roof, clutter) = (1, 2, 4, 8);
        for (name, mask) in [
            ("ground", terrain),
            ("water", terrain),
            ("high vegetation", clutter),
            ("vegetation", clutter),
            ("building", facade | roof),
            ("vehicle", clutter),
            ("unclassified", 0),
            ("RoofSurface", roof),
            ("WallSurface", facade),
            ("GroundSurface", terrain),
            ("BuildingWall", facade),
            ("Wall", facade),
            ("BuildingFloor", 0),
            ("RoadWall", terrain),
            ("Inst_WallSurface", facade),
            ("material_17", 0),
            ("Facade", facade),
        ] {
            assert_eq!(mask_of_name(&scheme, name), mask, "{name}");
        }
    }

    #[test]
    fn a_class_of_the_scheme_takes_its_own_name_and_parts_stand_for_the_whole() {
        let mut scheme = ClassScheme::default();
        let of = vec!["clutter".to_owned()];
        scheme.0.push(ClassSpec { of, ..ClassSpec::new("vegetation", 0.2, [0; 3]) });
        assert_eq!(mask_of_name(&scheme, "high vegetation"), 16);
        assert_eq!(mask_of_name(&scheme, "clutter"), 24, "all of it");
        assert_eq!(mask_among(&scheme, "clutter", &["clutter", "vegetation"]), 8, "what is not vegetation");
        assert_eq!(mask_among(&scheme, "clutter", &["clutter", "roof"]), 24);
        assert_eq!(mask_of_name(&scheme, "car"), 24, "a car is clutter, whichever");
    }

    #[test]
    fn labels_that_do_not_tell_facade_from_roof_judge_them_as_one() {
        let found = classes(ClassScheme::default(), &[0, 1, 2, 3, 2]);
        let judged = agreement(&found, &[1, 6, 6, 8, 0], &[1.0, 1.0, 1.0, 3.0, 100.0]);
        assert_eq!(judged.names, ["terrain", "facade+roof", "clutter"]);
        assert_eq!((judged.faces, judged.by_area.overall_accuracy), (4, 1.0));
        let judged = agreement(&found, &[1, 2, 2, 8, 0], &[1.0, 1.0, 1.0, 3.0, 100.0]);
        assert_eq!(judged.names.len(), 4);
        assert_eq!((judged.by_face.overall_accuracy, judged.by_area.overall_accuracy), (0.75, 5.0 / 6.0));
    }

    #[test]
    fn given_labels_override_and_leave_the_rest_alone() {
        let found = overridden(classes(ClassScheme::default(), &[0, 0, 2]), &[8, 6, 0]);
        assert_eq!(found.label, [ClassId(3), ClassId(1), ClassId(2)]);
        assert_eq!(found.of(0), [0.0, 0.0, 0.0, 1.0]);
        assert_eq!(found.of(1), [0.0, 0.5, 0.5, 0.0], "facade or roof, nothing tells which");
        assert_eq!(found.of(2), [0.0, 0.0, 1.0, 0.0]);
    }
}
