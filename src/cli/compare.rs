//! `rooftile compare`.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::look::{Alike, Looks};
use super::{Outcome, print, print_json};
use crate::draw::png;
use crate::ids::{ClassId, ClassScheme};
use crate::input::{self, InputConfig, Source};
use crate::measure::{Comparison, Figures, Interval, MeasureConfig, Quality, Reference, Summary, Surface};
use crate::report::Reporter;
use crate::write::output::Output;
use crate::{Error, Result};

#[derive(clap::Args)]
pub struct Args {
    /// The original: a file or folder as for `build`.
    #[arg(value_name = "REF")]
    reference: PathBuf,
    /// What was made of it. All in the same coordinates.
    #[arg(value_name = "SIMPLIFIED", required = true)]
    simplified: Vec<PathBuf>,
    /// Classes of REF: one integer a line for each of its faces or vertices in file order, or a PLY with labels.
    /// Default: those in REF itself, if any.
    #[arg(long, value_name = "FILE")]
    labels: Option<PathBuf>,
    /// What the lines of --labels stand for, where both would fit.
    #[arg(long, value_enum, value_name = "KIND")]
    label_kind: Option<Kind>,
    /// Sample points on either surface.
    #[arg(long, value_name = "N", default_value_t = MeasureConfig::default().samples)]
    samples: usize,
    /// Of the sample points' places.
    #[arg(long, value_name = "N", default_value_t = MeasureConfig::default().seed)]
    seed: u64,
    /// Wanted width of certified intervals, metres. Default: 0.02, or 2e-4 of REF's diagonal where that is less.
    #[arg(long, value_name = "METRES", allow_negative_numbers = true)]
    tolerance: Option<f64>,
    /// Also draw REF and SIMPLIFIED with their textures from so many places around, and say how alike the pictures are.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=360))]
    views: Option<u32>,
    /// The folder to make for those pictures, REF on the left.
    #[arg(long, value_name = "DIR", requires = "views")]
    pictures: Option<PathBuf>,
    /// Follow paths in the inputs that lead out of their folder.
    #[arg(long)]
    allow_outside: bool,
}

#[derive(Clone, Copy, PartialEq, clap::ValueEnum)]
enum Kind {
    /// A line a face.
    Face,
    /// A line a vertex.
    Vertex,
}

/// More sample points than this do not fit the memory of the usual machine.
const MOST_SAMPLES: usize = 100_000_000;

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    let config = config(args)?;
    let output = args.pictures.as_deref().map(|folder| Output::begin(folder, false)).transpose()?;
    let read = InputConfig { allow_outside: args.allow_outside, root: None };
    let stage = reporter.stage("input", 0);
    let (source, _) = input::read(std::slice::from_ref(&args.reference), &read, reporter)?;
    let labels = labels(args, &source, reporter)?;
    let (names, class) = labels.map(|l| named(&args.reference, &l)).transpose()?.unzip();
    let names = names.unwrap_or_default();
    let looks = args.views.map(|n| Looks::of(&args.reference, &source, n, reporter)).transpose()?;
    let reference = Reference::new(&Surface { class, ..surface(source) });
    stage.finish(format!("{} triangles in {} classes", reference.quality().faces_in_file, names.len()));

    let mut compared = Vec::new();
    for (i, path) in args.simplified.iter().enumerate() {
        reporter.check()?;
        let stage = reporter.stage("measure", 0);
        let (source, _) = input::read(std::slice::from_ref(path), &read, reporter)?;
        let alike = match &looks {
            Some(looks) => {
                let (alike, pictures) = looks.compare(path, &source, reporter)?;
                for (view, picture) in pictures.iter().enumerate() {
                    if let Some(output) = &output {
                        output.write(&format!("{i}-{view:02}.png"), &png::bytes(picture)?)?;
                    }
                }
                Some(alike)
            }
            None => None,
        };
        let comparison = reference.compare(&surface(source), &config);
        stage.finish(format!("{}: {} triangles", path.display(), comparison.quality.faces_in_file));
        compared.push(Compared { path: path.clone(), alike, comparison });
    }
    output.map_or(Ok(()), Output::commit)?;
    let report = Report {
        reference: ReferenceReport {
            path: args.reference.clone(),
            diagonal_m: reference.diagonal_m(),
            quality: reference.quality().clone(),
            classes: names,
        },
        samples: config.samples,
        seed: config.seed,
        tolerance_m: reference.tolerance_m(&config),
        simplified: compared,
        warnings: reporter.warnings(),
    };
    if json {
        print_json(&report)?
    } else {
        print(report.to_string().trim_end())?
    }
    Ok(Outcome::Fine)
}

fn config(args: &Args) -> Result<MeasureConfig> {
    if !(1..=MOST_SAMPLES).contains(&args.samples) {
        return Err(Error::Config(format!("--samples {}: wanted 1 to {MOST_SAMPLES}", args.samples)));
    }
    if let Some(t) = args.tolerance.filter(|t| !(t.is_finite() && *t > 0.0)) {
        return Err(Error::Config(format!("--tolerance {t}: wanted more than 0 metres")));
    }
    let (samples, seed, tolerance_m) = (args.samples, args.seed, args.tolerance);
    Ok(MeasureConfig { samples, seed, tolerance_m, ..MeasureConfig::default() })
}

fn surface(source: Source) -> Surface {
    let mut surface = Surface::default();
    for part in source.parts {
        let base = surface.positions.len() as u32;
        surface.positions.extend(part.positions);
        surface.faces.extend(part.faces.iter().map(|f| f.map(|v| v + base)));
    }
    surface
}

/// A label per face of the reference.
fn labels(args: &Args, source: &Source, reporter: &Reporter) -> Result<Option<Vec<i16>>> {
    let Some(path) = &args.labels else { return Ok(own_labels(source)) };
    let (faces, vertices) = counts(source);
    let is_ply = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
    let found = if is_ply {
        let (other, _) = input::read(std::slice::from_ref(path), &InputConfig::default(), reporter)?;
        own_labels(&other).ok_or_else(|| Error::input(path, "has no labels on faces or vertices"))?
    } else {
        input::labels::read(path)?
    };
    let fits = |kind, count| (args.label_kind.is_none_or(|k| k == kind)) && found.len() == count;
    match (fits(Kind::Face, faces), !is_ply && fits(Kind::Vertex, vertices)) {
        (true, false) => Ok(Some(found)),
        (false, true) => Ok(Some(of_faces(source, &found))),
        (true, true) => Err(Error::Config(format!(
            "--labels {}: {} labels fit faces and vertices; say which with --label-kind",
            path.display(),
            found.len()
        ))),
        (false, false) => Err(Error::input(
            path,
            format!(
                "has {} labels; {} has {faces} triangles and {vertices} vertices",
                found.len(),
                args.reference.display()
            ),
        )),
    }
}

fn counts(source: &Source) -> (usize, usize) {
    let sum = |of: fn(&input::Part) -> usize| source.parts.iter().map(of).sum();
    (sum(|p| p.faces.len()), sum(|p| p.positions.len()))
}

fn own_labels(source: &Source) -> Option<Vec<i16>> {
    if source.parts.iter().all(|p| p.face_labels.is_empty()) {
        return None;
    }
    let of_part =
        |p: &input::Part| if p.face_labels.is_empty() { vec![-1; p.faces.len()] } else { p.face_labels.clone() };
    Some(source.parts.iter().flat_map(of_part).collect())
}

/// What most of a face's corners say; the first where all differ.
fn of_faces(source: &Source, labels: &[i16]) -> Vec<i16> {
    let mut base = 0;
    let mut found = Vec::new();
    for part in &source.parts {
        found.extend(part.faces.iter().map(|face| {
            let [a, b, c] = face.map(|v| labels[base + v as usize]);
            if b == c { b } else { a }
        }));
        base += part.positions.len();
    }
    found
}

/// A class as it is printed.
#[derive(Serialize)]
struct Name {
    class: ClassId,
    label: i16,
    name: String,
}

/// Numbers the labels in ascending order. They have the default scheme's names if they look like its ids: 0 is among
/// them and none is beyond the last (SUM's numbering begins with 1).
fn named(path: &Path, labels: &[i16]) -> Result<(Vec<Name>, Vec<ClassId>)> {
    let mut present = labels.to_vec();
    present.sort_unstable();
    present.dedup();
    if present.len() > Surface::MOST_CLASSES {
        let what = format!("has {} different labels; at most {} are compared", present.len(), Surface::MOST_CLASSES);
        return Err(Error::input(path, what));
    }
    let scheme = ClassScheme::default();
    let is_ours = present.contains(&0) && present.last().is_some_and(|&l| (l as usize) < scheme.len());
    let name = |label: i16| match u8::try_from(label) {
        Ok(id) if is_ours => scheme[ClassId(id)].name.clone(),
        _ if label == -1 => "unlabelled".into(),
        _ => format!("label {label}"),
    };
    let id = |label: &i16| ClassId(present.partition_point(|l| l < label) as u8);
    let names = present.iter().map(|l| Name { class: id(l), label: *l, name: name(*l) }).collect();
    Ok((names, labels.iter().map(id).collect()))
}

#[derive(Serialize)]
struct Report {
    reference: ReferenceReport,
    samples: usize,
    seed: u64,
    tolerance_m: f64,
    simplified: Vec<Compared>,
    warnings: Vec<crate::report::Warning>,
}

#[derive(Serialize)]
struct ReferenceReport {
    path: PathBuf,
    diagonal_m: f64,
    quality: Quality,
    classes: Vec<Name>,
}

#[derive(Serialize)]
struct Compared {
    path: PathBuf,
    #[serde(skip_serializing_if = "Option::is_none")]
    alike: Option<Alike>,
    #[serde(flatten)]
    comparison: Comparison,
}

impl std::fmt::Display for Report {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let q = &self.reference.quality;
        writeln!(
            f,
            "{}: {} faces, {:.1} m², diagonal {:.2} m\n{}",
            self.reference.path.display(),
            q.faces_in_file,
            q.area_m2,
            self.reference.diagonal_m,
            flaws(q)
        )?;
        for compared in &self.simplified {
            writeln!(f)?;
            compared.write(f, &self.reference.classes)?;
        }
        writeln!(
            f,
            "\nMetres, both directions with equal weight, {} samples each. max: certified to hold the largest distance \
             of all points,\nboth ways. in, out: the furthest seen that the simplified surface sinks into the solid or \
             stands out of it. Eq.17 and\nEq.18 (as printed, m^½): the paper's, at simplified vertices only.",
            self.samples
        )
    }
}

fn flaws(q: &Quality) -> String {
    format!(
        "  {} non-manifold, {} inconsistent, {} folded, {} border edges; {} without area, {} duplicate, {} sliver faces",
        q.nonmanifold_edges,
        q.inconsistent_edges,
        q.folded_edges,
        q.border_edges,
        q.zero_area_faces,
        q.duplicate_faces,
        q.sliver_faces
    )
}

impl Compared {
    fn write(&self, f: &mut std::fmt::Formatter<'_>, names: &[Name]) -> std::fmt::Result {
        let c = &self.comparison;
        let share = 100.0 * c.face_share;
        writeln!(f, "{}: {} faces, {share:.2} %", self.path.display(), c.quality.faces_in_file)?;
        writeln!(f, "{}", flaws(&c.quality))?;
        if let Some(alike) = &self.alike {
            writeln!(f, "{alike}")?;
        }
        if let Some(n) = &c.normals {
            let (half, over) = (100.0 * n.share_above_30, 100.0 * n.share_above_90);
            let (mean, p95) = (n.mean_deg, n.p95_deg);
            writeln!(
                f,
                "  normals turn by {mean:.1}° mean, {p95:.1}° p95; {half:.2} % over 30°, {over:.2} % over 90°"
            )?;
        }
        writeln!(
            f,
            "  {:12} {:>9} {:>6} {:>8} {:>8} {:>8} {:>8} {:>17} {:>8} {:>8} {:>8} {:>8}",
            "class", "faces", "area", "mean", "rms", "p95", "p99", "max", "in", "out", "Eq.17", "Eq.18"
        )?;
        for class in &c.by_class {
            let name = names.iter().find(|n| n.class == class.class).map_or("?", |n| &n.name);
            writeln!(f, "  {}", row(name, &class.figures))?;
        }
        writeln!(f, "  {}", row("all", &c.all))
    }
}

fn row(name: &str, of: &Figures) -> String {
    let mut text = format!("{name:12} {:>9} {:>5.1}%", of.simplified_faces, 100.0 * of.reference_area_share);
    let parts: [fn(&Summary) -> f64; 4] = [|s| s.mean_m, |s| s.rms_m, |s| s.p95_m, |s| s.p99_m];
    for part in parts {
        let _ = write!(text, " {:>8}", metres(of.two_sided.as_ref().map(part)));
    }
    let interval = |i: Interval| format!("{}..{}", metres(Some(i.lower_m)), metres(Some(i.upper_m)));
    let _ = write!(text, " {:>17}", of.hausdorff.two_sided.map_or("-".into(), interval));
    let sides = [of.signed.map(|s| s.inside_seen_m), of.signed.map(|s| s.outside_seen_m)];
    let paper = [of.paper.map(|p| p.eq17_mean_m), of.paper.map(|p| p.eq18_as_printed_sqrt_m)];
    for figure in sides.into_iter().chain(paper) {
        let _ = write!(text, " {:>8}", metres(figure));
    }
    text
}

/// Four digits that count.
fn metres(distance: Option<f64>) -> String {
    match distance {
        None => "-".into(),
        Some(d) if d >= 1000.0 => format!("{d:.0}"),
        Some(d) if d >= 10.0 => format!("{d:.2}"),
        Some(d) if d >= 0.001 || d == 0.0 => format!("{d:.4}"),
        Some(d) => format!("{d:.1e}"),
    }
}
