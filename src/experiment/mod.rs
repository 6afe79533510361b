//! The paper's experiment on any mesh: a baseline and other methods at equal numbers of faces, and the number of faces
//! they need to be as accurate (the paper's §3, Figures 5 to 9).
//!
//! In: [`Mesh`], [`Classes`], [`ExperimentConfig`]. Out: [`Experiment`], and as files: [`files`].
//!
//! # Method
//! 1. Every method simplifies the mesh to every share of its faces; each cut is measured against the mesh.
//! 2. `equal`: each method but the baseline is cut again, to ever better guesses of the number of faces at which its
//!    mean distance is the baseline's, and the baseline likewise to reach the other's mean.
//! 3. `plots`, `panels`, `table`: Figures 6 to 8 as charts, 5 and 9 as pictures, all numbers as text.
//!
//! # Numbers
//! Distances are two-sided (source to cut and back, half the weight each), by area, unless they are called Eq. 17 or
//! 18: those are the paper's, at the vertices of the cut only, see [`measure`](crate::measure). Key classes are roof
//! and facade together.
//!
//! # Promises
//! Same input, same bytes, for any number of threads; what was cut and measured is what is drawn
//! (`the_experiment_is_written_whole`).
//!
//! # Limits
//! Equal accuracy is found to [`TOLERANCE`](equal::TOLERANCE) of the mean. The paper gives Figure 8 as the faces the
//! baseline needs to match the semantic cut; both directions are in the report, and the chart has the other one, as
//! the semantic cut at the baseline's accuracy is the one that is delivered.
//!
//! # References
//! The paper's §3.2 and Figures 5 to 9. It scores Eq. 17 and 18 alone, which see only what simplified vertices do; here
//! they stand beside the distances of the surfaces themselves.

mod equal;
mod figures;
mod panels;
mod plots;
mod table;

use std::collections::BTreeMap;

use serde::Serialize;

use crate::Result;
use crate::classes::Classes;
use crate::collapse::{self, Method, Simplified, SimplifyConfig, Target};
use crate::ids::{ClassId, ClassScheme};
use crate::measure::{MeasureConfig, Reference, Surface};
use crate::mesh::Mesh;
use crate::report::Reporter;

pub use equal::Equal;
pub use figures::{ClassNumbers, Numbers, PaperNumbers};

/// Classes whose details the paper keeps.
const KEY: [&str; 2] = ["facade", "roof"];

/// What to compare.
#[derive(Debug, Clone)]
pub struct ExperimentConfig {
    /// The baseline, then what is compared with it, each with its name.
    pub methods: Vec<(Method, String)>,
    /// Faces of the cuts with the names these numbers go by, for instance `10%`.
    pub faces: Vec<(usize, String)>,
    /// How closely to measure.
    pub measure: MeasureConfig,
}

/// What came out.
#[derive(Debug, Clone, Serialize)]
pub struct Experiment {
    /// The mesh that was simplified.
    pub source: SourceNumbers,
    /// The classes that count as key, of those the mesh has.
    pub key: Vec<String>,
    /// Budget of every class at scale 1, metres.
    pub budgets_m: BTreeMap<String, f64>,
    /// Points on either surface per measurement.
    pub samples: usize,
    /// Of the points' places.
    pub seed: u64,
    /// By number of faces as asked, then by method.
    pub cuts: Vec<Cut>,
    /// What each method spares against the baseline at the same number of faces: by faces, then by method.
    pub against_baseline: Vec<Against>,
    /// Faces at equal accuracy, by faces, then by method.
    pub equal_accuracy: Vec<Equal>,
    /// Everything measured, in ascending number of faces, by method: also the cuts made to find equal accuracy.
    pub curves: Vec<Curve>,
}

/// The source in numbers.
#[derive(Debug, Clone, Serialize)]
pub struct SourceNumbers {
    /// Triangles.
    pub faces: usize,
    /// Vertices, welded.
    pub vertices: usize,
    /// Diagonal of its box, metres.
    pub diagonal_m: f64,
}

/// A cut, measured.
#[derive(Debug, Clone, Serialize)]
pub struct Cut {
    /// The method's name.
    pub method: String,
    /// Faces as asked for.
    pub asked: String,
    /// Faces it has.
    pub faces: usize,
    /// All classes together.
    pub all: Numbers,
    /// Roof and facade together; none where the source has neither.
    pub key: Option<Numbers>,
    /// Each class that the source has.
    pub by_class: Vec<ClassNumbers>,
    /// The cut itself.
    #[serde(skip)]
    pub mesh: Simplified,
}

/// How much less a method is off than the baseline; -0.3 is 30 % less. None where the baseline is not off at all.
#[derive(Debug, Clone, Serialize)]
pub struct Against {
    /// The method's name.
    pub method: String,
    /// Faces as asked for.
    pub asked: String,
    /// Change of the mean distance (Figure 6).
    pub mean: Option<f64>,
    /// Change of the mean distance of key classes (Figure 6).
    pub key_mean: Option<f64>,
    /// Change of the root mean square (Figure 7).
    pub rms: Option<f64>,
    /// Change of Eq. 17.
    pub eq17: Option<f64>,
    /// Change of Eq. 17 over key classes.
    pub key_eq17: Option<f64>,
}

/// Mean distance over faces.
#[derive(Debug, Clone, Serialize)]
pub struct Curve {
    /// The method's name.
    pub method: String,
    /// Faces and two-sided mean distance, metres.
    pub points: Vec<(usize, f64)>,
}

/// Runs the experiment. `config` needs a method and a number of faces at least; without them the result is empty.
///
/// # Errors
/// [`Error::Cancelled`](crate::Error::Cancelled) after a signal.
pub fn run(mesh: &Mesh, classes: &Classes, config: &ExperimentConfig, reporter: &Reporter) -> Result<Experiment> {
    let surface =
        Surface { positions: mesh.positions.clone(), faces: mesh.faces.clone(), class: Some(classes.label.clone()) };
    let bench = Bench { mesh, classes, reference: Reference::new(&surface), config };
    let stage = reporter.stage("cuts", (config.methods.len() * config.faces.len()) as u64);
    let mut cuts = Vec::new();
    for (faces, asked) in &config.faces {
        for (method, name) in &config.methods {
            reporter.check()?;
            cuts.push(bench.cut(*method, name, *faces, asked));
            stage.step(1);
        }
    }
    stage.finish(format!("{} cuts of {} triangles", cuts.len(), mesh.faces.len()));

    let mut curves: Vec<Curve> = Vec::new();
    for (_, name) in &config.methods {
        let points = cuts.iter().filter(|c| c.method == *name).map(|c| (c.faces, c.all.mean_m)).collect();
        curves.push(Curve { method: name.clone(), points });
    }
    let stage = reporter.stage("equal", 0);
    let equal_accuracy = equal::find(&bench, &cuts, &mut curves, reporter)?;
    stage.finish(format!("{} numbers of faces", equal_accuracy.len()));
    for curve in &mut curves {
        curve.points.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        curve.points.dedup();
    }
    let present = |name: &&&str| classes.scheme.id(name).is_some_and(|id| classes.label.contains(&id));
    Ok(Experiment {
        source: SourceNumbers {
            faces: mesh.faces.len(),
            vertices: mesh.positions.len(),
            diagonal_m: bench.reference.diagonal_m(),
        },
        key: KEY.iter().filter(present).map(ToString::to_string).collect(),
        budgets_m: classes.scheme.0.iter().map(|c| (c.name.clone(), c.budget_m)).collect(),
        samples: config.measure.samples,
        seed: config.measure.seed,
        against_baseline: against_baseline(&cuts, config),
        equal_accuracy,
        curves,
        cuts,
    })
}

/// Every file of the report with its path in the folder: `experiment.json`, `table.txt`, charts as PNG and SVG, pictures.
///
/// # Errors
/// [`Error::Bug`](crate::Error::Bug) if an encoder refuses, which no mesh causes.
pub fn files(mesh: &Mesh, classes: &Classes, experiment: &Experiment) -> Result<Vec<(String, Vec<u8>)>> {
    let json = serde_json::to_vec_pretty(experiment).map_err(|e| crate::Error::Bug(format!("experiment: {e}")))?;
    let mut files =
        vec![("experiment.json".to_owned(), json), ("table.txt".to_owned(), experiment.to_string().into_bytes())];
    files.extend(plots::files(experiment)?);
    files.extend(panels::files(mesh, classes, experiment)?);
    Ok(files)
}

/// All that cuts are made and measured with.
struct Bench<'a> {
    mesh: &'a Mesh,
    classes: &'a Classes,
    reference: Reference,
    config: &'a ExperimentConfig,
}

impl Bench<'_> {
    fn simplify(&self, method: Method, faces: usize) -> Simplified {
        let config = SimplifyConfig { method, target: Target::Faces(faces), ..SimplifyConfig::default() };
        collapse::simplify(self.mesh, self.classes, &config)
    }

    fn cut(&self, method: Method, name: &str, faces: usize, asked: &str) -> Cut {
        let mesh = self.simplify(method, faces);
        let comparison = self.reference.compare(&surface(&mesh), &self.config.measure);
        let scheme = &self.classes.scheme;
        Cut {
            method: name.to_owned(),
            asked: asked.to_owned(),
            faces: mesh.faces.len(),
            all: Numbers::of(&[&comparison.all]).unwrap_or_default(),
            key: key(scheme, &comparison),
            by_class: comparison.by_class.iter().filter_map(|c| ClassNumbers::of(scheme, c)).collect(),
            mesh,
        }
    }

    /// Faces and mean distance of a cut that is not kept.
    fn mean(&self, method: Method, faces: usize) -> (usize, f64) {
        let mesh = self.simplify(method, faces);
        // The certified interval is not looked at: one as wide as the source costs nothing.
        let tolerance_m = Some(self.reference.diagonal_m().max(f64::MIN_POSITIVE));
        let config = MeasureConfig { tolerance_m, ..self.config.measure.clone() };
        let comparison = self.reference.compare(&surface(&mesh), &config);
        (mesh.faces.len(), comparison.all.two_sided.map_or(f64::INFINITY, |s| s.mean_m))
    }
}

fn surface(cut: &Simplified) -> Surface {
    Surface { positions: cut.positions.clone(), faces: cut.faces.clone(), class: None }
}

fn key(scheme: &ClassScheme, comparison: &crate::measure::Comparison) -> Option<Numbers> {
    let ids: Vec<ClassId> = KEY.iter().filter_map(|name| scheme.id(name)).collect();
    let figures: Vec<_> = comparison.by_class.iter().filter(|c| ids.contains(&c.class)).map(|c| &c.figures).collect();
    Numbers::of(&figures)
}

/// Every method but the first against the first.
fn against_baseline(cuts: &[Cut], config: &ExperimentConfig) -> Vec<Against> {
    let change = |new: f64, old: f64| (old > 0.0).then(|| new / old - 1.0);
    let of = |rows: &[Cut]| -> Vec<Against> {
        let Some((base, others)) = rows.split_first() else { return Vec::new() };
        let keys = |cut: &Cut, of: fn(&Numbers) -> Option<f64>| {
            cut.key.as_ref().and_then(of).zip(base.key.as_ref().and_then(of)).and_then(|(new, old)| change(new, old))
        };
        let eq17 = |n: &Numbers| n.paper.map(|p| p.eq17_mean_m);
        let against = |cut: &Cut| Against {
            method: cut.method.clone(),
            asked: cut.asked.clone(),
            mean: change(cut.all.mean_m, base.all.mean_m),
            key_mean: keys(cut, |n| Some(n.mean_m)),
            rms: change(cut.all.rms_m, base.all.rms_m),
            eq17: eq17(&cut.all).zip(eq17(&base.all)).and_then(|(new, old)| change(new, old)),
            key_eq17: keys(cut, eq17),
        };
        others.iter().map(against).collect()
    };
    cuts.chunks(config.methods.len().max(1)).flat_map(of).collect()
}
