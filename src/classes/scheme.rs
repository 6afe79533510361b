//! From the classes that rules speak of to the classes of a scheme: renamed, merged, or split by cues.
//!
//! In: a probability per source class and face. Out: [`Classes`] of the scheme.
//!
//! # Method
//! 1. A source class (`terrain`, `facade`, `roof`, `clutter`, or one that a table names) stands for the classes of the
//!    scheme that are `of` it; one without cues is the rest of it.
//! 2. Classes with cues get the product of their cues' beliefs, the rest what no cue claims; smoothed over neighbours.
//! 3. The source's probability is shared in proportion.
//!
//! # Limits
//! cues look at one face, its region or its patch, not at what stands beside

use rayon::prelude::*;

use super::nine::{self, FEATURES, Form, Measures, Spec};
use super::{Classes, smooth};
use crate::ids::{ClassId, ClassScheme, ClassSpec, Cue};
use crate::mesh::Mesh;
use crate::mesh::topology::NONE;

/// The classes that the rules of `robust` speak of, in the order of their scores.
pub const BASE: [&str; 4] = ["terrain", "facade", "roof", "clutter"];

/// Features that only cues may name, since they need a first labelling.
pub const PATCH_FEATURES: [Spec; 3] = [
    Spec { name: "patch_area_m2", unit: "m²", what: "area of the connected faces of the same source class" },
    Spec {
        name: "patch_greenness",
        unit: "",
        what: "mean greenness of those faces: a tree with its trunk and shadows",
    },
    Spec { name: "patch_top_m", unit: "m", what: "greatest height above ground of those faces" },
];

/// Sweeps of the mean over edge neighbours that beliefs go through: texture is noisier than surface.
const SWEEPS: usize = 4;
/// Least width of a cue.
const LEAST_WIDTH: f64 = 1e-6;

/// Which of [`BASE`] a class is, or is part of.
fn bases_of(spec: &ClassSpec) -> Vec<usize> {
    let place = |name: &str| BASE.iter().position(|b| *b == name);
    if !spec.of.is_empty() {
        return spec.of.iter().filter_map(|name| place(name)).collect();
    }
    match spec.name.as_str() {
        "ground" => vec![0],
        "wall" => vec![1],
        name => place(name).into_iter().collect(),
    }
}

/// Every mistake in a scheme, as a sentence. `also` are classes that a table of its own speaks of.
pub fn faults(scheme: &ClassScheme, also: &[String]) -> Vec<String> {
    let mut faults = Vec::new();
    for (i, class) in scheme.0.iter().enumerate() {
        let name = &class.name;
        if name.is_empty() || !name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b"-_ ".contains(&b))
        {
            faults.push(format!("class {i} is called {name:?}, wanted lower-case letters, digits, - or _"));
        }
        if scheme.0[..i].iter().any(|c| c.name == *name) {
            faults.push(format!("class {name:?} stands there twice"));
        }
        for of in class.of.iter().filter(|of| !BASE.contains(&of.as_str())) {
            faults.push(format!("class {name} is of {of:?}, wanted some of terrain, facade, roof, clutter"));
        }
        let is_known = !bases_of(class).is_empty() || fallback(scheme).contains(&i) || also.contains(name);
        if !is_known {
            faults.push(format!(
                "nothing is ever called {name}: say what it is part of, for instance of = [\"clutter\"]"
            ));
        }
        for cue in &class.when {
            faults.extend(cue_faults(name, cue));
        }
    }
    for (base, name) in BASE.iter().enumerate().filter(|(_, name)| !also.iter().any(|a| a == *name)) {
        let rests: Vec<&str> = (scheme.0.iter().filter(|c| bases_of(c).contains(&base) && c.when.is_empty()))
            .map(|c| c.name.as_str())
            .collect();
        if rests.len() > 1 {
            faults.push(format!("{} are all the rest of {name}: give all but one a `when`", rests.join(" and ")));
        }
        if rests.is_empty() && fallback(scheme)[base] == usize::MAX {
            faults.push(format!("no class is what is left of {name}: add of = [{name:?}] to one without `when`"));
        }
    }
    faults
}

fn cue_faults(class: &str, cue: &Cue) -> Vec<String> {
    let mut faults = Vec::new();
    let Cue { feature, above, below, width } = cue;
    if !FEATURES.iter().chain(&PATCH_FEATURES).any(|f| f.name == feature) {
        faults.push(format!("class {class}: there is no feature {feature:?}; `rooftile label --features` lists them"));
    }
    let limits = [above, below];
    if limits.iter().all(|l| l.is_none()) || limits.iter().any(|l| l.is_some_and(|l| !l.is_finite())) {
        faults.push(format!("class {class}: the cue on {feature} wants a finite `above` or `below`, or both"));
    }
    if !(LEAST_WIDTH..=1e9).contains(width) {
        faults.push(format!("class {class}: the cue on {feature} has width {width}, wanted {LEAST_WIDTH} to 1e9"));
    }
    faults
}

/// Where terrain, façade, roof and clutter go when no class is `of` them: by kindred names; `usize::MAX` for nowhere.
fn fallback(scheme: &ClassScheme) -> [usize; 4] {
    let find = |names: &[&str]| names.iter().find_map(|n| scheme.id(n)).map_or(usize::MAX, ClassId::index);
    [find(&["ground"]), find(&["wall", "building"]), find(&["building"]), find(&["vegetation"])]
}

/// The classes that share a source class.
struct Group {
    /// Takes what no cue claims.
    rest: Option<usize>,
    /// Have cues.
    special: Vec<usize>,
}

fn group(scheme: &ClassScheme, sources: &[String], source: &str) -> Group {
    let direct = |i: usize| scheme.0[i].name != source && sources.contains(&scheme.0[i].name);
    let Some(base) = BASE.iter().position(|b| *b == source) else {
        return Group { rest: scheme.id(source).map(ClassId::index), special: Vec::new() };
    };
    let members: Vec<usize> =
        (0..scheme.len()).filter(|i| !direct(*i) && bases_of(&scheme.0[*i]).contains(&base)).collect();
    let (special, rest): (Vec<usize>, Vec<usize>) = members.into_iter().partition(|i| !scheme.0[*i].when.is_empty());
    let kindred = Some(fallback(scheme)[base]).filter(|i| *i != usize::MAX);
    // A scheme that passed its check never needs the last resort.
    let last = if special.is_empty() { Some(0) } else { None };
    Group { rest: rest.first().copied().or(kindred).or(last), special }
}

/// Does any class look at this feature?
pub fn looks_at(scheme: &ClassScheme, feature: &str) -> bool {
    scheme.0.iter().flat_map(|c| &c.when).any(|cue| cue.feature == feature)
}

/// Shares probabilities of source classes (`face * sources.len() + source`) among the classes of a scheme.
pub fn spread(
    mesh: &Mesh,
    measures: &Measures,
    neighbours: &[[u32; 3]],
    scheme: &ClassScheme,
    sources: &[String],
    chances: Vec<f32>,
) -> Classes {
    let (count, width) = (scheme.len(), sources.len());
    let groups: Vec<Group> = sources.iter().map(|s| group(scheme, sources, s)).collect();
    let is_itself = |(i, group): (usize, &Group)| group.rest == Some(i) && group.special.is_empty();
    if count == width && groups.iter().enumerate().all(is_itself) {
        return labelled(scheme, chances);
    }
    let chances = chances.as_slice();
    let patches = groups.iter().any(|g| !g.special.is_empty()).then(|| Patches::of(mesh, neighbours, width, chances));
    let belief = |class: usize| -> Vec<f32> {
        let columns: Vec<(&Cue, Vec<f32>)> = (scheme.0[class].when.iter())
            .map(|cue| (cue, column(measures, patches.as_ref(), mesh, &cue.feature)))
            .collect();
        let of_face =
            |f: usize| columns.iter().map(|(cue, values)| cue.belief(f64::from(values[f]))).product::<f64>() as f32;
        smoothed((0..mesh.faces.len()).into_par_iter().map(of_face).collect(), neighbours)
    };
    let beliefs: Vec<Option<Vec<f32>>> =
        (0..count).map(|class| groups.iter().any(|g| g.special.contains(&class)).then(|| belief(class))).collect();
    let mut posterior = vec![0.0f32; mesh.faces.len() * count];
    posterior.par_chunks_mut(count).enumerate().for_each(|(f, out)| {
        for (group, chance) in groups.iter().zip(&chances[f * width..(f + 1) * width]) {
            share(group, *chance, |class| beliefs[class].as_ref().map_or(0.0, |b| b[f]), out);
        }
    });
    labelled(scheme, posterior)
}

fn labelled(scheme: &ClassScheme, posterior: Vec<f32>) -> Classes {
    let label = posterior.par_chunks(scheme.len()).map(|p| ClassId(smooth::best(p) as u8)).collect();
    Classes { scheme: scheme.clone(), posterior, label }
}

/// Adds a source's chance to its classes.
fn share(group: &Group, chance: f32, belief: impl Fn(usize) -> f32, out: &mut [f32]) {
    let unclaimed: f32 = group.special.iter().map(|c| 1.0 - belief(*c)).product();
    let rest = if group.rest.is_some() { unclaimed } else { 0.0 };
    let sum: f32 = group.special.iter().map(|c| belief(*c)).sum::<f32>() + rest;
    let places = group.special.len() + usize::from(group.rest.is_some());
    // Where nobody claims anything all take the same.
    let part = |weight: f32| if sum > 1e-6 { chance * weight / sum } else { chance / places.max(1) as f32 };
    group.special.iter().for_each(|c| out[*c] += part(belief(*c)));
    if let Some(class) = group.rest {
        out[class] += part(rest);
    }
}

fn column(measures: &Measures, patches: Option<&Patches>, mesh: &Mesh, feature: &str) -> Vec<f32> {
    let nothing = || vec![0.0; mesh.faces.len()];
    match (feature, patches) {
        ("patch_area_m2", Some(patches)) => patches.per_face(&patches.area_m2),
        ("patch_greenness", Some(patches)) => {
            let greenness = measures.of_faces("greenness", Form::Robust).unwrap_or_else(nothing);
            patches.per_face(&patches.mean(mesh, &greenness))
        }
        ("patch_top_m", Some(patches)) => {
            let height = measures.of_faces("height_m", Form::Robust).unwrap_or_else(nothing);
            patches.per_face(&patches.greatest(&height))
        }
        _ => measures.of_faces(feature, nine::Form::Robust).unwrap_or_else(nothing),
    }
}

fn smoothed(mut values: Vec<f32>, neighbours: &[[u32; 3]]) -> Vec<f32> {
    for _ in 0..SWEEPS {
        let mean = |f: usize| {
            let around = neighbours[f].iter().filter(|g| **g != NONE).map(|g| values[*g as usize]);
            let (sum, n) = around.fold((values[f], 1.0f32), |(sum, n), v| (sum + v, n + 1.0));
            sum / n
        };
        values = (0..values.len()).into_par_iter().with_min_len(4096).map(mean).collect();
    }
    values
}

/// Connected faces of the same most probable source class.
struct Patches {
    of_face: Vec<u32>,
    area_m2: Vec<f32>,
}

impl Patches {
    fn of(mesh: &Mesh, neighbours: &[[u32; 3]], width: usize, chances: &[f32]) -> Self {
        let label: Vec<u8> = chances.chunks(width).map(|p| smooth::best(p) as u8).collect();
        let mut patches = Self { of_face: vec![NONE; label.len()], area_m2: Vec::new() };
        let mut open = Vec::new();
        for start in 0..label.len() {
            if patches.of_face[start] != NONE {
                continue;
            }
            let own = patches.area_m2.len() as u32;
            let mut area = 0.0;
            patches.of_face[start] = own;
            open.push(start);
            while let Some(f) = open.pop() {
                area += 0.5 * mesh.cross(f).length();
                for g in neighbours[f].iter().filter(|g| **g != NONE).map(|g| *g as usize) {
                    if patches.of_face[g] == NONE && label[g] == label[start] {
                        patches.of_face[g] = own;
                        open.push(g);
                    }
                }
            }
            patches.area_m2.push(area as f32);
        }
        patches
    }

    /// By area.
    fn mean(&self, mesh: &Mesh, of_faces: &[f32]) -> Vec<f32> {
        let mut sums = vec![0.0f64; self.area_m2.len()];
        for (f, value) in of_faces.iter().enumerate() {
            sums[self.of_face[f] as usize] += 0.5 * mesh.cross(f).length() * f64::from(*value);
        }
        sums.iter().zip(&self.area_m2).map(|(sum, area)| (sum / f64::from(*area).max(1e-9)) as f32).collect()
    }

    fn greatest(&self, of_faces: &[f32]) -> Vec<f32> {
        let mut greatest = vec![f32::NEG_INFINITY; self.area_m2.len()];
        for (patch, value) in self.of_face.iter().zip(of_faces) {
            let own = &mut greatest[*patch as usize];
            *own = own.max(*value);
        }
        greatest
    }

    fn per_face(&self, values: &[f32]) -> Vec<f32> {
        self.of_face.iter().map(|patch| values[*patch as usize]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn class(name: &str, of: &[&str], when: &[Cue]) -> ClassSpec {
        let of = of.iter().map(|s| (*s).to_owned()).collect();
        ClassSpec { of, when: when.to_vec(), ..ClassSpec::new(name, 0.1, [0; 3]) }
    }

    fn cue(feature: &str, above: f64) -> Cue {
        Cue { feature: feature.into(), above: Some(above), below: None, width: 1.0 }
    }

    fn sources() -> Vec<String> {
        BASE.iter().map(|s| (*s).to_owned()).collect()
    }

    #[test]
    fn the_default_scheme_goes_straight_through() {
        let scheme = ClassScheme::default();
        assert_eq!(faults(&scheme, &[]), Vec::<String>::new());
        let groups: Vec<Option<usize>> = BASE.iter().map(|b| group(&scheme, &sources(), b).rest).collect();
        assert_eq!(groups, [Some(0), Some(1), Some(2), Some(3)]);
    }

    #[test]
    fn classes_may_be_renamed_merged_and_split() {
        let scheme = ClassScheme(vec![
            class("building", &["facade", "roof"], &[]),
            class("soil", &["terrain"], &[]),
            class("greenery", &["clutter"], &[cue("greenness", 10.0)]),
            class("other", &["clutter"], &[]),
        ]);
        assert_eq!(faults(&scheme, &[]), Vec::<String>::new());
        let rest = |base: &str| group(&scheme, &sources(), base).rest;
        assert_eq!(BASE.map(rest), [Some(1), Some(0), Some(0), Some(3)]);
        assert_eq!(group(&scheme, &sources(), "clutter").special, [2]);
        // A table that speaks of greenery itself leaves clutter to the other.
        let own: Vec<String> = ["terrain", "clutter", "greenery"].map(String::from).to_vec();
        assert_eq!(group(&scheme, &own, "greenery").rest, Some(2));
        assert!(group(&scheme, &own, "clutter").special.is_empty());
    }

    #[test]
    fn cues_share_out_what_they_claim_and_the_rest_takes_the_rest() {
        let group = Group { rest: Some(2), special: vec![0, 1] };
        let mut out = [0.0; 3];
        share(&group, 0.8, |c| if c == 0 { 1.0 } else { 0.0 }, &mut out);
        assert_eq!(out, [0.8, 0.0, 0.0]);
        let mut out = [0.0; 3];
        share(&group, 0.8, |_| 0.0, &mut out);
        assert_eq!(out, [0.0, 0.0, 0.8]);
        let mut out = [0.0; 2];
        share(&Group { rest: None, special: vec![0, 1] }, 0.6, |_| 0.0, &mut out);
        assert_eq!(out, [0.3, 0.3], "nobody claims it");
    }

    #[test]
    fn every_mistake_of_a_scheme_is_named() {
        let scheme = ClassScheme(vec![
            class("terrain", &[], &[]),
            class("Roof", &["rooof"], &[]),
            class("tree", &[], &[cue("colour", f64::NAN)]),
            class("terrain", &[], &[]),
        ]);
        let faults = faults(&scheme, &[]).join("\n");
        for word in
            ["\"Roof\"", "rooof", "tree: say what", "colour", "finite", "twice", "left of facade", "left of clutter"]
        {
            assert!(faults.contains(word), "{word} in\n{faults}");
        }
    }
}
