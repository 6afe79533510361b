//! `rooftile simplify`.

use std::path::{Path, PathBuf};

use glam::DVec3;
use serde_json::json;

use super::build::presets;
use super::{Outcome, print, print_json};
use crate::classes::{self, Classes, ClassesConfig};
use crate::collapse::record::{self, About, MAX_CLASSES};
use crate::collapse::{self, Simplified, SimplifyConfig, Target};
use crate::config::Config;
use crate::geo::Aabb;
use crate::ids::{ClassId, ClassScheme};
use crate::input::{self, ImageRef, InputConfig, Source, label_names};
use crate::mesh::{self, GRID_PER_M, GateConfig, Mesh};
use crate::pipeline::given::classes_of_labels;
use crate::planes::{self, PlanesConfig};
use crate::preset::Preset;
use crate::report::Reporter;
use crate::texture::{Images, Surface, TextureConfig, encode_jpeg, paint_cut};
use crate::write::mesh::{Format, Plain, admit, write_all};
use crate::write::painted::{self, Paint};
use crate::{Error, Result};

#[derive(clap::Args)]
#[command(group = clap::ArgGroup::new("target").required(true))]
pub struct Args {
    /// Mesh files (.obj, .ply, .gltf, .glb) or folders of them.
    #[arg(value_name = "INPUT", required = true)]
    inputs: Vec<PathBuf>,
    /// The file to write, .ply, .obj or .glb; one that is there is replaced when the new one is whole. A textured input
    /// gives a texture baked anew: inside a .glb, beside an .obj as .mtl and .jpg, none for a .ply.
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// At most so many triangles: a number, or a share of the input's as in 10%.
    #[arg(long, value_name = "N|P%", group = "target")]
    faces: Option<Faces>,
    /// Until a class is so many of its budgets off.
    #[arg(long, value_name = "T", group = "target", value_parser = positive)]
    scale: Option<f64>,
    /// Until a class is so many metres off.
    #[arg(long, value_name = "METRES", group = "target", value_parser = positive)]
    error: Option<f64>,
    /// How edges are ranked and placed.
    #[arg(long, value_enum, default_value = "semantic")]
    method: Method,
    /// Classes of the input's triangles, in its order: one number a line, or a mesh with labels. Numbers mean what a
    /// PLY's header says, else class ids if 0 is among them and none is beyond the last, else SUM's. Default: those in the
    /// input, else by its shape.
    #[arg(long, value_name = "FILE")]
    labels: Option<PathBuf>,
    #[command(flatten)]
    budgets: Budgets,
    /// Write the collapse sequence here, for `replay`. The mesh is then what `replay` gives: not refitted. Its size is set by
    /// --grid: 3 to 5 bytes a triangle at 0.01, twice that by default.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Positions are rounded to a grid of the power of two below this, metres. Default: 2^-20.
    #[arg(long, value_name = "METRES", value_parser = grid)]
    grid: Option<f64>,
    /// Leave vertices where collapses put them, as a record has them; semantic fits them to the source once more.
    #[arg(long)]
    no_refit: bool,
    /// Largest side of the texture, texels. Default: 4096; smaller where the input or the cut's error is coarser.
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(64..=16384))]
    texture_size: Option<u32>,
    /// Write the surface without a texture, in the colours of its classes.
    #[arg(long, conflicts_with = "texture_size")]
    no_texture: bool,
    /// Follow paths in an input that lead out of its folder.
    #[arg(long)]
    allow_outside: bool,
}

/// The ways to simplify.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// Energy weighted by the budgets of classes, deviations tracked, the result refitted.
    Semantic,
    /// Energy of the current faces, area weighted.
    Memoryless,
    /// Accumulated quadrics (Garland and Heckbert 1997).
    Plain,
    /// As semantic, but vertices stay at places of the source.
    HalfEdge,
    /// Volume and boundary preserved (Lindstrom and Turk 1998).
    LindstromTurk,
    /// The paper's own priority.
    Paper,
}

impl Method {
    /// Says how far each class is off.
    fn is_tracked(self) -> bool {
        matches!(self, Self::Semantic | Self::HalfEdge)
    }

    /// The engine's name for it.
    pub(super) fn meant(self) -> collapse::Method {
        match self {
            Self::Semantic => collapse::Method::Semantic,
            Self::Memoryless => collapse::Method::Memoryless,
            Self::Plain => collapse::Method::Plain,
            Self::HalfEdge => collapse::Method::HalfEdge,
            Self::LindstromTurk => collapse::Method::LindstromTurk,
            Self::Paper => collapse::Method::Paper,
        }
    }

    /// The word on the command line.
    pub(super) fn name(self) -> String {
        clap::ValueEnum::to_possible_value(&self).map(|v| v.get_name().to_owned()).unwrap_or_default()
    }
}

/// A number of faces, or a share of those there are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Faces {
    /// So many.
    Number(usize),
    /// A share, 0 to 1.
    Share(f64),
}

impl std::str::FromStr for Faces {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wanted = || "wanted a number of triangles from 1, or a share as in 10%".to_owned();
        match text.strip_suffix('%') {
            Some(percent) => {
                let percent: f64 = percent.trim().parse().map_err(|_| wanted())?;
                if percent > 0.0 && percent <= 100.0 { Ok(Self::Share(percent / 100.0)) } else { Err(wanted()) }
            }
            None => match text.parse() {
                Ok(number) if number > 0 => Ok(Self::Number(number)),
                _ => Err(wanted()),
            },
        }
    }
}

impl std::fmt::Display for Faces {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Number(number) => write!(f, "{number}"),
            // Seven digits: 0.07 · 100 is not 7.
            Self::Share(share) => write!(f, "{}%", (share * 1e7).round() / 1e5),
        }
    }
}

impl Faces {
    /// The number, of `all` faces; a share is rounded down, but never to 0.
    pub fn of(self, all: usize) -> usize {
        match self {
            Self::Number(number) => number,
            Self::Share(share) => ((all as f64 * share) as usize).max(1),
        }
    }
}

/// A finite number above 0.
pub fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(x) if x > 0.0 && x.is_finite() => Ok(x),
        _ => Err("wanted a number above 0".into()),
    }
}

/// The power of two not above a length, metres.
fn grid(text: &str) -> Result<f64, String> {
    let exponent = positive(text)?.log2().floor();
    if (-24.0..=10.0).contains(&exponent) {
        Ok(2f64.powi(exponent as i32))
    } else {
        Err("wanted metres from 1e-7 to 1000".into())
    }
}

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    let format = Format::of(&args.out)?;
    let outputs: Vec<&Path> = std::iter::once(&args.out).chain(&args.record).map(PathBuf::as_path).collect();
    let inputs: Vec<&Path> = args.inputs.iter().chain(&args.labels).map(PathBuf::as_path).collect();
    admit(&outputs, &inputs)?;
    if args.faces.is_none() && !args.method.is_tracked() {
        let what = "knows nothing of deviations; ask for --faces, or use semantic or half-edge";
        return Err(Error::Config(format!("--method {}: it {what}", args.method.name())));
    }

    let scheme = args.budgets.scheme()?;
    let wanted = |mesh: &Mesh| are_classes_wanted(mesh, args);
    let front = front(&args.inputs, args.labels.as_deref(), args.allow_outside, wanted, reporter)?;
    let Front { mut mesh, mut classes, gate, origin, images: refs } = front;
    classes.scheme = scheme;
    let is_painted = format != Format::Ply && !args.no_texture && Surface::from(&mesh).is_painted();
    if is_painted {
        let taken: Vec<PathBuf> = files_of(&refs).into_iter().chain(args.record.clone()).collect();
        painted::admit_beside(&args.out, format, &taken)?;
    }

    let stage = reporter.stage("simplify", 0);
    let config = SimplifyConfig {
        method: args.method.meant(),
        target: target(args, &mesh, &classes.scheme),
        grid_m: args.grid.unwrap_or(1.0 / GRID_PER_M),
        refit: !args.no_refit && args.record.is_none(),
        record: args.record.is_some(),
    };
    let (source_faces, keeps_classes) = (mesh.faces.len(), are_classes_wanted(&mesh, args));
    let scheme = classes.scheme.clone();
    let mut simple = if is_painted {
        collapse::simplify(&mesh, &classes, &config)
    } else {
        collapse::simplify_owned(std::mem::take(&mut mesh), classes, &config)
    };
    stage.finish(format!("{source_faces} → {} triangles", simple.faces.len()));
    reporter.check()?;

    let plain = Plain {
        positions: simple.positions.iter().map(|p| *p + origin).collect(),
        faces: simple.faces.clone(),
        classes: if keeps_classes { simple.labels.clone() } else { Vec::new() },
    };
    let plain = plain.ordered();
    let texture = if is_painted { Some(paint(&plain, origin, &mesh, refs, args, reporter)?) } else { None };
    reporter.check()?;

    let stage = reporter.stage("write", 0);
    let about = About { origin, scheme: scheme.clone(), method: args.method.name(), tracked: args.method.is_tracked() };
    let made = match &texture {
        Some(texture) => painted::files(&plain, &texture.paint, &args.out, format, &scheme)?,
        None => vec![(args.out.clone(), plain.bytes(format, &scheme)?)],
    };
    let bounds = bounds(&simple, &about);
    let collapses = simple.sequence.as_ref().map(|s| s.log.events.len());
    let recorded = simple.sequence.take().map(|sequence| record::encode(sequence, &about)).transpose()?;
    let mut files: Vec<(&Path, &[u8])> = made.iter().map(|(path, bytes)| (path.as_path(), bytes.as_slice())).collect();
    let bytes: usize = files.iter().map(|f| f.1.len()).sum();
    files.extend(args.record.as_deref().zip(recorded.as_deref()));
    write_all(&files)?;
    let record_bytes = recorded.as_ref().map(Vec::len);
    let noted =
        record_bytes.map(|n| format!(", record {n} bytes, {:.2} a source triangle", n as f64 / gate.faces as f64));
    stage.finish(format!("{bytes} bytes{}", noted.unwrap_or_default()));

    let report = json!({
        "out": args.out,
        "method": args.method.name(),
        "source_faces": source_faces,
        "faces": plain.faces.len(),
        "collapses": collapses,
        "bounds_m": bounds_by_name(&about, &bounds),
        "bytes": bytes,
        "texture": texture.as_ref().map(|t| json!({ "size_px": t.size_px, "texel_m": t.texel_m })),
        "record_bytes": record_bytes,
        "gate": gate,
        "warnings": reporter.warnings(),
        "stages": reporter.stages(),
    });
    if json {
        print_json(&report)?
    } else {
        print(&text(plain.faces.len(), &about, &bounds))?
    }
    Ok(Outcome::Fine)
}

/// How far classes may deviate.
#[derive(clap::Args)]
pub(super) struct Budgets {
    /// The budgets of a preset of `build`: survey treats all classes alike, city keeps buildings at the cost of the rest.
    /// Its other settings do not count here.
    #[arg(long, value_name = "NAME", value_parser = presets())]
    preset: Option<String>,
    /// Metres that a class may deviate at scale 1, for those named, over the preset: what is strict gets the triangles.
    /// Default: roof=0.05, facade=0.05, terrain=0.1, clutter=0.1.
    #[arg(long, value_name = "CLASS=METRES,…")]
    budget: Option<String>,
}

impl Budgets {
    /// The default classes with the budgets asked for.
    pub fn scheme(&self) -> Result<ClassScheme> {
        let mut config = Config::layered_on(self.preset.as_deref().and_then(Preset::of), None, &[])?;
        self.budget.as_deref().map_or(Ok(()), |budgets| config.set_budgets(budgets))?;
        Ok(config.classes)
    }
}

/// A mesh behind the gate with its classes, ready to be simplified.
pub(super) struct Front {
    /// About `origin`.
    pub mesh: Mesh,
    /// Of its faces.
    pub classes: Classes,
    /// What the gate did.
    pub gate: mesh::GateReport,
    /// Where its local metres begin, in the input's coordinates.
    pub origin: DVec3,
    /// What its materials refer to.
    pub images: Vec<ImageRef>,
}

/// Reads, cleans and classifies; all faces are terrain where classes are not `wanted`.
pub(super) fn front(
    inputs: &[PathBuf],
    labels: Option<&Path>,
    allow_outside: bool,
    wanted: impl Fn(&Mesh) -> bool,
    reporter: &Reporter,
) -> Result<Front> {
    let stage = reporter.stage("input", 0);
    let read = InputConfig { allow_outside, root: None };
    let (mut source, found) = input::read(inputs, &read, reporter)?;
    let mut files = found.files.clone();
    if let Some(path) = labels {
        give_labels(&mut source, path, reporter)?;
        files = vec![path.to_path_buf()];
    }
    let triangles: usize = source.parts.iter().map(|p| p.faces.len()).sum();
    stage.finish(format!("{} files, {triangles} triangles", found.files.len()));
    reporter.check()?;

    let origin = to_local(&mut source)?;
    let images = std::mem::take(&mut source.images);
    let (mesh, gate) = mesh::gate(source, &GateConfig::default(), reporter)?;
    let classes = classify(&mesh, &files, wanted(&mesh), reporter)?;
    reporter.check()?;
    Ok(Front { mesh, classes, gate, origin, images })
}

/// The texture of a cut, and its figures.
struct Texture {
    paint: Paint,
    /// Width and height, texels.
    size_px: [u32; 2],
    /// Metres.
    texel_m: f64,
}

/// Bakes a texture for `plain`, which is in source coordinates, from the images of `mesh`, which is local.
fn paint(
    plain: &Plain,
    origin: DVec3,
    mesh: &Mesh,
    refs: Vec<ImageRef>,
    args: &Args,
    reporter: &Reporter,
) -> Result<Texture> {
    let stage = reporter.stage("texture", 0);
    let source = Surface::from(mesh);
    let mut images = Images::new(refs, reporter);
    images.cover(&source);
    let config = TextureConfig { max_atlas_px: args.texture_size.unwrap_or(TEXTURE_PX), ..TextureConfig::default() };
    let positions: Vec<DVec3> = plain.positions.iter().map(|p| *p - origin).collect();
    let cut = Surface { positions: &positions, faces: &plain.faces, ..Surface::default() };
    let baked = paint_cut(&cut, &source, &images, &config).map_err(|error| match error {
        Error::Config(what) => Error::Config(format!("{what} (here: raise --texture-size, or use --no-texture)")),
        other => other,
    })?;
    let size_px = [baked.atlas.width(), baked.atlas.height()];
    stage.finish(format!("{}×{} texels of {:.4} m", size_px[0], size_px[1], baked.texel_m));
    let jpeg = encode_jpeg(&baked.atlas, config.jpeg_quality);
    Ok(Texture { paint: Paint { corner_uvs: baked.corner_uvs, jpeg }, size_px, texel_m: baked.texel_m })
}

/// Largest side of a texture unless told otherwise, texels: what every GPU takes.
const TEXTURE_PX: u32 = 4096;

/// Images of the input that are files.
fn files_of(refs: &[ImageRef]) -> Vec<PathBuf> {
    let file = |r: &ImageRef| match r {
        ImageRef::File(path) => Some(path.clone()),
        _ => None,
    };
    refs.iter().filter_map(file).collect()
}

/// Where to stop. A distance holds for all classes: the scale at which none may be further off.
fn target(args: &Args, mesh: &Mesh, scheme: &ClassScheme) -> Target {
    if let Some(faces) = args.faces {
        return Target::Faces(faces.of(mesh.faces.len()));
    }
    let widest_m = scheme.0.iter().map(|c| c.budget_m).fold(0.0, f64::max);
    Target::Scale(args.scale.or(args.error.map(|m| m / widest_m)).unwrap_or(0.0))
}

/// How far each class may be off, metres: the largest deviation recorded, or what the scale reached allows.
fn bounds(simple: &Simplified, about: &About) -> [f64; MAX_CLASSES] {
    let mut most = [0f64; MAX_CLASSES];
    match &simple.sequence {
        Some(sequence) => most = sequence.log.most_m.map(f64::from),
        None => most.iter_mut().zip(&about.scheme.0).for_each(|(m, c)| *m = simple.scale * c.budget_m),
    }
    most
}

/// Bounds by the names of their classes; null without tracking.
pub fn bounds_by_name(about: &About, bounds_m: &[f64; MAX_CLASSES]) -> serde_json::Value {
    if !about.tracked {
        return serde_json::Value::Null;
    }
    about
        .scheme
        .0
        .iter()
        .zip(bounds_m)
        .map(|(c, m)| (c.name.clone(), json!(m)))
        .collect::<serde_json::Map<_, _>>()
        .into()
}

/// Two lines for people.
pub fn text(faces: usize, about: &About, bounds_m: &[f64; MAX_CLASSES]) -> String {
    let each = about.scheme.0.iter().zip(bounds_m).map(|(c, m)| format!("{} {m:.3} m", c.name));
    let bounds = if about.tracked { each.collect::<Vec<_>>().join(", ") } else { "not tracked".into() };
    format!("triangles  {faces}\nno source vertex is further off than  {bounds}")
}

/// Takes positions to an origin amid the surface, whole metres, which is returned.
fn to_local(source: &mut Source) -> Result<DVec3> {
    let corners = source.parts.iter().flat_map(|p| p.faces.iter().flatten().map(|&v| p.positions[v as usize]));
    let bounds = Aabb::of(corners.filter(|p| p.is_finite()));
    if bounds.is_empty() {
        let path = source.parts.first().map(|p| p.path.clone()).unwrap_or_default();
        return Err(Error::input(path, "no vertex has finite coordinates; nothing to simplify"));
    }
    let origin = bounds.center().with_z(bounds.min.z).round();
    source.parts.iter_mut().flat_map(|p| &mut p.positions).for_each(|p| *p -= origin);
    Ok(origin)
}

/// Classes as labelled, by numbers out of `files`, or by shape.
fn classify(mesh: &Mesh, files: &[PathBuf], wanted: bool, reporter: &Reporter) -> Result<Classes> {
    let scheme = ClassScheme::default();
    if !wanted {
        return Ok(in_classes(scheme, vec![ClassId::TERRAIN; mesh.faces.len()]));
    }
    let stage = reporter.stage("classes", 0);
    let classes = if mesh.face_labels.is_empty() {
        let planes = planes::grow(mesh, &PlanesConfig::default());
        reporter.check()?;
        classes::label(mesh, &planes, &scheme, &ClassesConfig::default())
    } else {
        let names = label_names::names_of(&mesh.face_labels, files, &scheme)?;
        let classes = classes_of_labels(mesh, &names, &scheme)?;
        in_classes(scheme, classes)
    };
    stage.finish(String::from(if mesh.face_labels.is_empty() { "by shape" } else { "as labelled" }));
    Ok(classes)
}

/// Methods that look at no class need none, unless they are kept with the mesh.
fn are_classes_wanted(mesh: &Mesh, args: &Args) -> bool {
    args.method.is_tracked() || args.method == Method::Paper || args.record.is_some() || !mesh.face_labels.is_empty()
}

/// Every face certainly of its class.
fn in_classes(scheme: ClassScheme, label: Vec<ClassId>) -> Classes {
    let posterior = label.iter().flat_map(|c| scheme.ids().map(move |of| if of == *c { 1.0 } else { 0.0 })).collect();
    Classes { scheme, posterior, label }
}

/// Replaces the labels of `source` by those in `path`.
fn give_labels(source: &mut Source, path: &Path, reporter: &Reporter) -> Result<()> {
    let is_mesh =
        path.extension().is_some_and(|e| ["ply", "obj", "glb", "gltf"].iter().any(|k| e.eq_ignore_ascii_case(k)));
    let labels: Vec<i16> = if is_mesh {
        let (other, _) = input::read(&[path.to_path_buf()], &InputConfig::default(), reporter)?;
        if other.parts.iter().any(|p| p.face_labels.is_empty()) {
            return Err(Error::input(path, "has no labels on its triangles; wanted a face property `label`"));
        }
        other.parts.into_iter().flat_map(|p| p.face_labels).collect()
    } else {
        input::labels::read(path)?
    };
    let wanted: usize = source.parts.iter().map(|p| p.faces.len()).sum();
    if labels.len() != wanted {
        let what = format!("has {} labels for {wanted} triangles; wanted one each, in the input's order", labels.len());
        return Err(Error::input(path, what));
    }
    let mut rest = labels.as_slice();
    for part in &mut source.parts {
        let (own, after) = rest.split_at(part.faces.len());
        part.face_labels = own.to_vec();
        rest = after;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_is_the_power_of_two_below() {
        assert_eq!(grid("0.01"), Ok(1.0 / 128.0));
        assert_eq!(grid("0.25"), Ok(0.25));
        assert!(grid("0").is_err() && grid("1e9").is_err() && grid("nan").is_err());
    }

    #[test]
    fn faces_are_a_number_or_a_share() {
        assert_eq!("1500".parse(), Ok(Faces::Number(1500)));
        assert_eq!("10%".parse(), Ok(Faces::Share(0.1)));
        assert_eq!(Faces::Share(0.1).of(295), 29);
        assert_eq!(Faces::Share(0.001).of(295), 1);
        for bad in ["", "0", "-3", "0%", "101%", "nan%", "many", "1.5"] {
            assert!(bad.parse::<Faces>().is_err(), "{bad}");
        }
    }
}
