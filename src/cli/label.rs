//! `rooftile label`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::json;

use super::{Outcome, print, print_json};
use crate::classes::nine::{FEATURES, Form, Measures};
use crate::classes::scheme::PATCH_FEATURES;
use crate::classes::truth::{Agreement, agreement, overridden};
use crate::classes::{Classes, Confusion, Ground, tune};
use crate::config::Config;
use crate::geo::Georeference;
use crate::input::discover::Found;
use crate::input::{self, InputConfig, Source};
use crate::pipeline::given::{LabelSource, masks};
use crate::pipeline::{Front, figures};
use crate::report::Reporter;
use crate::write::ply::{Column, Ply};
use crate::{Error, Result};

#[derive(clap::Args)]
pub struct Args {
    /// Mesh files (.obj, .ply, .gltf, .glb) or folders of them, as for `build`.
    #[arg(value_name = "INPUT", required_unless_present_any = ["features", "tune"])]
    inputs: Vec<PathBuf>,
    /// The PLY to write: labels per face, features per vertex as scalar_NAME. With --tune: the settings, a TOML.
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Which rules tell classes apart (classify.classifier).
    #[arg(long, value_name = "NAME", value_parser = ["robust", "cgal", "paper-eq10", "paper"])]
    classifier: Option<String>,
    /// What the colours in the PLY show: class, region, or one of the features that --features lists.
    #[arg(long, value_name = "WHAT", default_value = "class")]
    color: String,
    /// Compare with labels: a mesh at the same place with labels per face or vertex or with telling materials, or
    /// `input` for those of the input itself.
    #[arg(long, value_name = "FILE|input")]
    truth: Option<String>,
    /// Let given labels override the classifier: as for --truth.
    #[arg(long, value_name = "FILE|input")]
    labels_from: Option<String>,
    /// Write pictures into this folder: the nine features, classes and regions.
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Fit the scales of the rules to the labels of this mesh and write them as settings to --out. Without INPUT the
    /// mesh is its own input.
    #[arg(long, value_name = "FILE|input", conflicts_with_all = ["truth", "labels_from", "figures"])]
    tune: Option<String>,
    /// List the features and stop.
    #[arg(long)]
    features: bool,
    /// Coordinate system of the input, as for `build`. Default: what metadata.xml or ODM's files say, else local.
    #[arg(long, value_name = "CRS")]
    crs: Option<String>,
    /// Follow paths in the input that lead out of its folder.
    #[arg(long)]
    allow_outside: bool,
    /// Settings from a TOML file, as for `build`.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// One setting, for instance classify.high_m=3. May be given more than once.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Report {
    classifier: &'static str,
    classes: Vec<Share>,
    regions: usize,
    truth: Option<Agreement>,
    warnings: Vec<crate::report::Warning>,
    stages: Vec<crate::report::StageTime>,
}

#[derive(Serialize)]
struct Share {
    class: String,
    triangles: u64,
    area_m2: f64,
}

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    if args.features {
        return list_features(json);
    }
    let config = settings(args)?;
    let form = config.classify.table().map_or(Form::Robust, |table| table.form);
    if !matches!(args.color.as_str(), "class" | "region") && !FEATURES.iter().any(|f| f.name == args.color) {
        let what = "wanted class, region or a feature; `rooftile label --features` lists them";
        return Err(Error::Config(format!("--color {}: {what}", args.color)));
    }
    let inputs = match (&args.tune, args.inputs.is_empty()) {
        (Some(tune), true) if tune == "input" => {
            return Err(Error::Config("--tune input: INPUT is missing".into()));
        }
        (Some(tune), true) => vec![PathBuf::from(tune)],
        _ => args.inputs.clone(),
    };
    let (source, found) = read(&inputs, args, reporter)?;
    let georeference = match &args.crs {
        Some(crs) => Georeference::parse(crs)?,
        None => georeference(&found)?,
    };
    // The PLY has greenness among its columns, and pictures show the input.
    let shows_colors = args.tune.is_none() && (args.out.is_some() || args.figures.is_some());
    let front = Front::of(source, &georeference, &config, shows_colors, reporter)?;
    if let Some(from) = &args.tune {
        return tuned(args, from, &found, &front, &config, json, reporter);
    }

    let ground = Ground::of(&front.mesh, &front.planes, &config.classify);
    let measures = Measures::new(front.scene(), &ground, &config.classify.nine);
    let mut classes = front.classify(&ground, &measures, &config, reporter);
    let given = |from: &Option<String>| {
        let source = from.as_ref().map(|from| label_source(from, &found, args.allow_outside, reporter)).transpose()?;
        let edge_m = front.planes.median_edge_m;
        source.map(|source| masks(&source, &front.mesh, edge_m, &front.frame, &config.classes)).transpose()
    };
    if let Some(masks) = given(&args.labels_from)? {
        classes = overridden(classes, &masks);
    }
    let truth = given(&args.truth)?.map(|masks| agreement(&classes, &masks, &front.areas_m2()));
    reporter.check()?;
    if let Some(out) = &args.out {
        let stage = reporter.stage("write", 0);
        labelled_ply(&front, &measures, &classes, form, &args.color)?.write(out)?;
        stage.finish(out.display().to_string());
    }
    if let Some(folder) = &args.figures {
        let stage = reporter.stage("figures", 0);
        let written = figures::write(&front, &measures, &classes, form, folder)?;
        stage.finish(written.join(", "));
    }
    let report = report(&front, &classes, &config, truth, reporter);
    if json {
        print_json(&report)?;
    } else {
        print(report_text(&report)?.trim_end())?;
    }
    Ok(Outcome::Fine)
}

fn settings(args: &Args) -> Result<Config> {
    let mut set = args.set.clone();
    set.extend(args.classifier.iter().map(|name| format!("classify.classifier=\"{name}\"")));
    Config::layered(args.config.as_deref(), &set)
}

fn read(inputs: &[PathBuf], args: &Args, reporter: &Reporter) -> Result<(Source, Found)> {
    let stage = reporter.stage("input", 0);
    let read = InputConfig { allow_outside: args.allow_outside, root: None };
    let (source, found) = input::read(inputs, &read, reporter)?;
    let triangles: usize = source.parts.iter().map(|p| p.faces.len()).sum();
    stage.finish(format!("{} files, {triangles} triangles, {} images", found.files.len(), source.images.len()));
    Ok((source, found))
}

fn georeference(found: &Found) -> Result<Georeference> {
    match (&found.metadata_xml, &found.odm_coords) {
        (Some(path), _) => input::georeference::read_metadata_xml(path),
        (None, Some(path)) => input::georeference::read_odm(path),
        (None, None) => Ok(Georeference::Local),
    }
}

/// Labels of the input itself, or read from a file.
pub(super) fn label_source(from: &str, found: &Found, allow_outside: bool, reporter: &Reporter) -> Result<LabelSource> {
    if from == "input" {
        return Ok(LabelSource::Input(input::label_names::names(&found.files)?));
    }
    let read = InputConfig { allow_outside, root: None };
    let (source, found) = input::read(&[PathBuf::from(from)], &read, reporter)?;
    Ok(LabelSource::File(Box::new(source), input::label_names::names(&found.files)?))
}

fn list_features(json: bool) -> Result<Outcome> {
    let all: Vec<_> = FEATURES.iter().chain(&PATCH_FEATURES).collect();
    if json {
        print_json(&json!({ "features": all }))?;
    } else {
        all.iter().try_for_each(|f| print(&format!("{:22} {:3} {}", f.name, f.unit, f.what)))?;
    }
    Ok(Outcome::Fine)
}

fn tuned(
    args: &Args,
    from: &str,
    found: &Found,
    front: &Front,
    config: &Config,
    json: bool,
    reporter: &Reporter,
) -> Result<Outcome> {
    let Some(out) = &args.out else {
        return Err(Error::Config("--tune writes settings: name a file for them with --out".into()));
    };
    // A mesh that is its own input has its own labels: no search for the nearest face.
    let own = if args.inputs.is_empty() { "input" } else { from };
    let source = label_source(own, found, args.allow_outside, reporter)?;
    let truth = masks(&source, &front.mesh, front.planes.median_edge_m, &front.frame, &config.classes)?;
    let stage = reporter.stage("tune", 0);
    let proceed = || {
        stage.step(1);
        reporter.check()
    };
    let tuned = tune::tune(front.scene(), &truth, &config.classes, &config.classify, proceed)?;
    stage.finish(format!("{} labellings, {} scales changed", tuned.tried, tuned.changed.len()));
    write_settings(out, config, &tuned)?;
    if json {
        print_json(&tuned)?;
        return Ok(Outcome::Fine);
    }
    for (name, old, new) in &tuned.changed {
        print(&format!("{name:22} {old:>9} → {new}"))?;
    }
    for (when, agreement) in [("before", &tuned.before), ("after", &tuned.after)] {
        let Confusion { overall_accuracy, mean_iou, .. } = &agreement.by_area;
        print(&format!(
            "{when:7} {:5.1} % right, mean IoU {:5.1} %, by area",
            100.0 * overall_accuracy,
            100.0 * mean_iou
        ))?;
    }
    Ok(Outcome::Fine)
}

/// The settings that `--config` reads, with a word on where they come from.
fn write_settings(out: &Path, config: &Config, tuned: &tune::Tuned) -> Result<()> {
    #[derive(Serialize)]
    struct Section<'a> {
        classify: &'a crate::classes::ClassesConfig,
        #[serde(skip_serializing_if = "Option::is_none")]
        classes: Option<&'a crate::ids::ClassScheme>,
    }
    let classes = Some(&config.classes).filter(|scheme| **scheme != crate::ids::ClassScheme::default());
    let text = toml::to_string_pretty(&Section { classify: &tuned.config, classes });
    let text = text.map_err(|e| Error::Bug(format!("settings: {e}")))?;
    let (before, after) = (&tuned.before.by_area, &tuned.after.by_area);
    let head = format!(
        "# Fitted to {} labelled faces by `rooftile label --tune`: {:.1} % right before, {:.1} % after (mean IoU {:.1} and \
         {:.1} %).\n",
        tuned.after.faces,
        100.0 * before.overall_accuracy,
        100.0 * after.overall_accuracy,
        100.0 * before.mean_iou,
        100.0 * after.mean_iou
    );
    std::fs::write(out, head + &text).map_err(Error::io("write", out))
}

/// Labels, regions and colours per face; colours and all features per vertex.
fn labelled_ply<'a>(
    front: &'a Front,
    measures: &Measures,
    classes: &Classes,
    form: Form,
    color: &str,
) -> Result<Ply<'a>> {
    let mesh = &front.mesh;
    let in_source: Option<Vec<_>> = mesh.positions.iter().map(|p| front.frame.source_from_local(*p)).collect();
    let is_metric = matches!(front.frame.describe().kind, "local" | "projected" | "enu");
    let (positions, where_to) = match in_source.filter(|_| is_metric) {
        Some(positions) => (positions, "as in the input"),
        None => (mesh.positions.clone(), "metres east, north and up of the middle of the input"),
    };
    let mut ply = Ply { comments: vec![format!("coordinates: {where_to}")], ..Ply::default() };
    // The same comments that SUM's and CGAL's labelled meshes have, so that numbers are never mistaken.
    ply.comments.extend(classes.scheme.ids().map(|id| format!("label {} {}", id.0, classes.scheme[id].name)));
    let face_colors = figures::face_colors(front, measures, classes, form, color);
    ply.vertex.extend(Column::positions(&positions));
    ply.vertex.extend(Column::colors(&figures::vertex_colors(mesh, &face_colors)));
    for feature in FEATURES {
        let values = measures.of_vertices(feature.name, form).unwrap_or_default();
        ply.vertex.push(Column::f32(format!("scalar_{}", feature.name), values));
    }
    let certainty: Vec<f32> = (0..mesh.faces.len()).map(|f| classes.of(f)[classes.label[f].index()]).collect();
    let of_face: Vec<f32> = classes.label.iter().map(|l| f32::from(l.0)).collect();
    ply.vertex.push(Column::f32("scalar_class", figures::vertex_values(mesh, &of_face)));
    ply.faces = mesh.faces.as_slice().into();
    ply.face.push(Column::i32("label", classes.label.iter().map(|l| i32::from(l.0)).collect::<Vec<_>>()));
    // No region is -1, as no label is.
    ply.face.push(Column::i32("region", front.planes.face_region.iter().map(|r| *r as i32).collect::<Vec<_>>()));
    ply.face.push(Column::f32("certainty", certainty));
    ply.face.extend(Column::colors(&face_colors));
    Ok(ply)
}

fn report(front: &Front, classes: &Classes, config: &Config, truth: Option<Agreement>, reporter: &Reporter) -> Report {
    let mut shares: Vec<Share> =
        classes.scheme.0.iter().map(|c| Share { class: c.name.clone(), triangles: 0, area_m2: 0.0 }).collect();
    for (label, area) in classes.label.iter().zip(front.areas_m2()) {
        let share = &mut shares[label.index()];
        (share.triangles, share.area_m2) = (share.triangles + 1, share.area_m2 + area);
    }
    Report {
        classifier: config.classify.classifier.name(),
        classes: shares,
        regions: front.planes.regions.len(),
        truth,
        warnings: reporter.warnings(),
        stages: reporter.stages(),
    }
}

fn report_text(report: &Report) -> Result<String> {
    let mut text = String::new();
    let broken = |_| Error::Bug("text could not be put together".into());
    for warning in &report.warnings {
        writeln!(text, "warning    {} × {}: {}", warning.count, warning.code, warning.first).map_err(broken)?;
    }
    let total: f64 = report.classes.iter().map(|s| s.area_m2).sum();
    for Share { class, triangles, area_m2 } in &report.classes {
        let percent = 100.0 * area_m2 / total.max(1e-9);
        writeln!(text, "{class:16} {triangles:>9} triangles {area_m2:>12.1} m² {percent:>5.1} %").map_err(broken)?;
    }
    if let Some(truth) = &report.truth {
        for (how, found) in [("area, m²", &truth.by_area), ("faces", &truth.by_face)] {
            write!(text, "\n{}", confusion_text(&truth.names, how, found)?).map_err(broken)?;
        }
    }
    Ok(text)
}

/// Rows are the truth, columns what was found.
fn confusion_text(names: &[String], how: &str, found: &Confusion) -> Result<String> {
    let put = |text: &mut String| -> std::fmt::Result {
        write!(text, "{:16}", format!("truth, by {how}"))?;
        names.iter().try_for_each(|name| write!(text, " {name:>12}"))?;
        writeln!(text, "  {:>6}", "IoU")?;
        for (row, name) in names.iter().enumerate() {
            let of = |column: usize| found.matrix.get(row).and_then(|r| r.get(column)).copied().unwrap_or(0.0);
            write!(text, "{name:16}")?;
            (0..names.len()).try_for_each(|column| write!(text, " {:>12.0}", of(column)))?;
            match found.iou.get(row).copied().flatten() {
                Some(iou) => writeln!(text, "  {:>5.1}%", 100.0 * iou)?,
                None => writeln!(text, "  {:>6}", "-")?,
            }
        }
        let (right, mean) = (100.0 * found.overall_accuracy, 100.0 * found.mean_iou);
        writeln!(text, "{right:.1} % right, mean IoU {mean:.1} %")
    };
    let mut text = String::new();
    put(&mut text).map_err(|_| Error::Bug("text could not be put together".into()))?;
    Ok(text)
}
