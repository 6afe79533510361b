//! `rooftile build`.

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::{Outcome, print, print_json};
use crate::config::Config;
use crate::geo::{Georeference, georeference};
use crate::input::discover::{Found, discover};
use crate::input::{self, InputConfig};
use crate::pipeline::{self, Feed, InputDigest, Job, Resources};
use crate::preset::{PRESETS, Preset};
use crate::report::Reporter;
use crate::store::memory;
use crate::tiles::skirt::Skirts;
use crate::{Error, Result};

#[derive(clap::Args)]
pub struct Args {
    /// Mesh files (.obj, .ply, .gltf, .glb) or folders of them: a tiled export with its metadata.xml, an ODM project.
    #[arg(value_name = "INPUT", required_unless_present = "dump_config")]
    inputs: Vec<PathBuf>,
    /// The folder to make. It appears when the build is done, whole.
    #[arg(short, long, value_name = "DIR", required_unless_present = "dump_config")]
    out: Option<PathBuf>,
    /// Replace an existing tileset.
    #[arg(long)]
    force: bool,
    /// Coordinate system of the input: EPSG:n, EPSG:n+m, ENU:lat,lon[,h], WKT, a PROJ string, or local. Default: what
    /// metadata.xml or ODM's files say, else local.
    #[arg(long, value_name = "CRS")]
    crs: Option<String>,
    /// Added to every vertex, in units of the coordinate system: x,y[,z].
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    origin: Option<String>,
    /// Height of the input's zero above the ellipsoid (geoid undulation), metres.
    #[arg(long, value_name = "METRES", allow_hyphen_values = true)]
    height_offset: Option<f64>,
    /// Let given labels override the classifier: a labelled mesh at the same place, or `input` for the labels or the
    /// telling material names of the input itself.
    #[arg(long, value_name = "FILE|input")]
    labels_from: Option<String>,
    /// Memory to stay within, for instance 2GB or 4GiB; the output does not depend on it. Default: a third of the
    /// machine's.
    #[arg(long, value_name = "BYTES")]
    memory: Option<String>,
    /// Go on with what a run that was stopped or killed, or whose disk was full, left beside the output; without this a
    /// build begins afresh.
    #[arg(long)]
    resume: bool,
    /// Follow paths in the input that lead out of its folder.
    #[arg(long)]
    allow_outside: bool,
    #[command(flatten)]
    settings: Settings,
    /// Print every setting as it would be used, as TOML, and stop.
    #[arg(long)]
    dump_config: bool,
}

/// Options that change settings; also those of `demo`.
#[derive(clap::Args)]
pub struct Settings {
    /// A named set of settings, under those of --config, --set and the flags.
    #[arg(long, value_name = "NAME", value_parser = presets())]
    preset: Option<String>,
    /// Metres that classes may deviate at scale 1, for instance roof=0.05,facade=0.05,terrain=0.1,clutter=0.1.
    #[arg(long, value_name = "CLASS=METRES,…")]
    budget: Option<String>,
    /// Strips that hide gaps between tiles of different levels: as deep as the gaps (auto), none (off), or of one depth
    /// (levels.skirts).
    #[arg(long, value_name = "auto|off|METRES")]
    skirts: Option<String>,
    /// Settings from a TOML file.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// One setting, for instance levels.leaf_faces=20000. May be given more than once.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Write KHR_mesh_quantization and EXT_meshopt_compression (write.compress).
    #[arg(long)]
    compress: bool,
    /// Write textures with power-of-two sides (texture.power_of_two).
    #[arg(long)]
    power_of_two: bool,
    /// Write a primitive per class instead of one draw call a tile (write.primitives_per_class).
    #[arg(long)]
    per_class: bool,
    /// Write vertex normals (write.normals).
    #[arg(long)]
    normals: bool,
    /// Credit to show in viewers (write.copyright).
    #[arg(long, value_name = "TEXT")]
    copyright: Option<String>,
}

/// The help text of a preset is its definition.
pub(super) fn presets() -> clap::builder::PossibleValuesParser {
    PRESETS.map(|p| clap::builder::PossibleValue::new(p.name).help(p.describe())).into()
}

impl Settings {
    /// Default, then preset, then file, then `--set`, then the flags that name a setting.
    pub fn layered(&self) -> Result<Config> {
        let preset = self.preset.as_deref().and_then(Preset::of);
        let mut config = Config::layered_on(preset, self.config.as_deref(), &self.set)?;
        if let Some(budgets) = &self.budget {
            config.set_budgets(budgets)?;
        }
        if let Some(skirts) = &self.skirts {
            let wanted = || Error::Config(format!("--skirts {skirts}: wanted auto, off, or 0 to 1000 metres"));
            config.levels.skirts = Skirts::parse(skirts).ok_or_else(wanted)?;
        }
        config.write.compress |= self.compress;
        config.write.primitives_per_class |= self.per_class;
        config.write.normals |= self.normals;
        config.texture.power_of_two |= self.power_of_two;
        if let Some(copyright) = &self.copyright {
            config.write.copyright.clone_from(copyright);
        }
        Ok(config)
    }
}

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    let config = args.settings.layered()?;
    if args.dump_config {
        print(config.to_toml()?.trim_end())?;
        return Ok(Outcome::Fine);
    }
    let Some(out) = &args.out else { return Err(Error::Config("--out is missing".into())) };
    refuse_nesting(out, &args.inputs)?;
    let asked = georeference_asked(args)?;

    let found = discover(&args.inputs, reporter)?;
    let georeference = match asked {
        Some(georeference) => georeference,
        None => georeference_found(&found, args)?,
    };
    let inputs = digests(&found.files)?;
    let read = InputConfig { allow_outside: args.allow_outside, root: None };
    let labels = args.labels_from.as_ref();
    let labels =
        labels.map(|from| super::label::label_source(from, &found, args.allow_outside, reporter)).transpose()?;
    let job = Job { out, force: args.force, config: &config, georeference, inputs, labels_are_truth: false, labels };
    let resources = Resources { memory: memory_asked(args)?, resume: args.resume };
    let report = pipeline::build_from(Feed::Files(found, read), &job, &resources, reporter)?;
    reporter.say(&report.to_string());
    if json {
        print_json(&report)?;
    }
    Ok(Outcome::Fine)
}

/// One window of cells takes up to 1.4 GB.
const LEAST_MEMORY_BYTES: u64 = 1_500_000_000;

fn memory_asked(args: &Args) -> Result<u64> {
    let Some(text) = &args.memory else { return Ok(memory::default_bytes().max(LEAST_MEMORY_BYTES)) };
    match memory::parse_bytes(text) {
        Some(bytes) if bytes >= LEAST_MEMORY_BYTES => Ok(bytes),
        _ => Err(Error::Config(format!("--memory {text}: wanted at least 1.5GB, for instance 2GB or 4GiB"))),
    }
}

/// What `--crs` and `--origin` say, if anything.
fn georeference_asked(args: &Args) -> Result<Option<Georeference>> {
    let Some(crs) = &args.crs else { return Ok(None) };
    adjusted(Georeference::parse(crs)?, args).map(Some)
}

/// What the input's own files say.
fn georeference_found(found: &Found, args: &Args) -> Result<Georeference> {
    let georeference = match (&found.metadata_xml, &found.odm_coords) {
        (Some(path), _) => input::georeference::read_metadata_xml(path)?,
        (None, Some(path)) => input::georeference::read_odm(path)?,
        (None, None) => Georeference::Local,
    };
    adjusted(georeference, args)
}

fn adjusted(mut georeference: Georeference, args: &Args) -> Result<Georeference> {
    if let Some(origin) = &args.origin {
        georeference = georeference.with_origin(georeference::parse_origin(origin)?);
    }
    if let Some(offset) = args.height_offset {
        georeference = georeference.with_height_offset(offset)?;
    }
    Ok(georeference)
}

/// An output inside its input would be read as input next time; an input inside its output would be lost to --force.
fn refuse_nesting(out: &Path, inputs: &[PathBuf]) -> Result<()> {
    let absolute = |p: &Path| {
        let whole = std::path::absolute(p).unwrap_or_else(|_| p.to_path_buf());
        // The part that exists decides: links must not hide that two paths are one.
        let exists = whole.ancestors().find_map(|a| a.canonicalize().ok().map(|c| (a.to_path_buf(), c)));
        match exists {
            Some((base, real)) => whole.strip_prefix(&base).map_or(real.clone(), |rest| real.join(rest)),
            None => whole,
        }
    };
    let out_path = absolute(out);
    for input in inputs {
        let path = absolute(input);
        let what = if out_path == path {
            "is the input itself"
        } else if path.starts_with(&out_path) {
            "holds the input"
        } else if out_path.starts_with(&path) && path.is_dir() {
            "lies inside the input folder"
        } else {
            continue;
        };
        return Err(Error::Output {
            path: out.to_path_buf(),
            what: format!("{what} {}; name a folder beside it", input.display()),
        });
    }
    Ok(())
}

fn digests(files: &[PathBuf]) -> Result<Vec<InputDigest>> {
    files
        .par_iter()
        .map(|path| {
            let mut hasher = blake3::Hasher::new();
            let file = std::fs::File::open(path).map_err(Error::io("read", path))?;
            hasher.update_reader(file).map_err(Error::io("read", path))?;
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            Ok(InputDigest { name, bytes: hasher.count(), blake3: hasher.finalize().to_hex().to_string() })
        })
        .collect()
}
