//! `rooftile replay`.

use std::path::PathBuf;

use serde_json::json;

use super::simplify::{Faces, bounds_by_name, positive, text};
use super::{Outcome, print, print_json};
use crate::collapse::record::{MAX_CLASSES, Record, Replayed};
use crate::ids::{ClassId, ClassScheme};
use crate::report::Reporter;
use crate::write::mesh::{Format, Plain, admit, write_all};
use crate::{Error, Result};

#[derive(clap::Args)]
#[command(group = clap::ArgGroup::new("detail"))]
pub struct Args {
    /// A record, as `simplify --record` writes it.
    #[arg(value_name = "RECORD")]
    record: PathBuf,
    /// The file to write, .ply, .obj or .glb; one that is there is replaced when the new one is whole. It has no texture:
    /// a record holds geometry and classes.
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// The finest mesh of at most so many triangles: a number, or a share of the source's as in 10%.
    #[arg(long, value_name = "N|P%", group = "detail")]
    faces: Option<Faces>,
    /// The coarsest mesh that is off by at most so many budgets of each class.
    #[arg(long, value_name = "T", group = "detail", value_parser = positive)]
    scale: Option<f64>,
    /// The coarsest mesh that is off by at most so many metres.
    #[arg(long, value_name = "METRES", group = "detail", value_parser = positive)]
    error: Option<f64>,
    /// The finest mesh that the first N bytes of the record hold.
    #[arg(long, value_name = "N", group = "detail")]
    bytes: Option<usize>,
    /// As coarse as each class may be, in metres, each place by its own class: roof=0.1,facade=0.1,terrain=2. Classes
    /// not named are not limited.
    #[arg(long, value_name = "CLASS=METRES,…", group = "detail")]
    budget: Option<String>,
}

pub fn run(args: &Args, json: bool, reporter: &Reporter) -> Result<Outcome> {
    let format = Format::of(&args.out)?;
    admit(&[&args.out], &[&args.record])?;
    let stage = reporter.stage("decode", 0);
    let bytes = std::fs::read(&args.record).map_err(Error::io("read", &args.record))?;
    let record = Record::open(&args.record, bytes)?;
    let (mesh, chunks) = cut(args, &record)?;
    let read = record.bytes_through().nth(chunks).or(record.bytes_through().last()).unwrap_or(0);
    stage.finish(format!("{} splits out of {read} bytes", mesh.splits));
    reporter.check()?;

    let stage = reporter.stage("write", 0);
    let about = &record.header().about;
    let plain = Plain {
        positions: mesh.positions.iter().map(|p| *p + about.origin).collect(),
        faces: mesh.faces,
        classes: mesh.classes.iter().map(|c| ClassId(*c)).collect(),
    };
    let written = plain.ordered().bytes(format, &about.scheme)?;
    write_all(&[(&args.out, &written)])?;
    stage.finish(format!("{} bytes", written.len()));

    let report = json!({
        "out": args.out,
        "method": about.method,
        "source_faces": record.header().chunks.last().map_or(0, |c| c.faces),
        "faces": plain.faces.len(),
        "splits": mesh.splits,
        "bounds_m": bounds_by_name(about, &mesh.bounds_m),
        "bytes_read": read,
        "bytes": written.len(),
        "warnings": reporter.warnings(),
        "stages": reporter.stages(),
    });
    if json {
        print_json(&report)?
    } else {
        print(&text(plain.faces.len(), about, &mesh.bounds_m))?
    }
    Ok(Outcome::Fine)
}

/// The mesh asked for, and how many chunks it took.
fn cut(args: &Args, record: &Record) -> Result<(Replayed, usize)> {
    let header = record.header();
    let scheme = &header.about.scheme;
    let last = header.chunks.len() - 1;
    if let Some(faces) = args.faces {
        let all = header.chunks[last].faces as usize;
        let wanted = faces.of(all);
        let base = header.chunks[0].faces as usize;
        if wanted < base {
            let what = format!("the record's coarsest mesh has {base}; ask for more, or record further down");
            return Err(Error::Config(format!("--faces {wanted}: {what}")));
        }
        // One more chunk than holds them: splits that follow may add no face.
        let chunks = record.chunks_for_faces(wanted + 1);
        let decoded = record.decode(chunks)?;
        return Ok((decoded.at(decoded.splits_for_faces(wanted)), chunks));
    }
    if let Some(bytes) = args.bytes {
        let least = record.bytes_through().next().unwrap_or(0);
        let chunks = record.chunks_in_bytes(bytes).ok_or_else(|| {
            Error::Config(format!("--bytes {bytes}: the coarsest mesh alone takes {least}; ask for at least as many"))
        })?;
        return Ok((record.decode(chunks)?.at(usize::MAX), chunks));
    }
    let Some(limits) = limits(args, scheme)? else { return Ok((record.decode(last)?.at(usize::MAX), last)) };
    let Some(chunks) = record.chunks_within(&limits) else {
        return Err(Error::input(
            &args.record,
            "holds no deviations: it was recorded without tracking; ask for --faces or --bytes, or record again",
        ));
    };
    let decoded = record.decode(chunks)?;
    if args.budget.is_some() {
        return Ok((decoded.within(&limits), chunks));
    }
    let splits = decoded.splits_within(&limits).ok_or_else(|| Error::Bug("limits that a chunk keeps".into()))?;
    Ok((decoded.at(splits), chunks))
}

/// Metres per class, from whichever of the flags is given.
fn limits(args: &Args, scheme: &ClassScheme) -> Result<Option<[f64; MAX_CLASSES]>> {
    let mut limits = [f64::INFINITY; MAX_CLASSES];
    if let Some(error) = args.error {
        return Ok(Some([error; MAX_CLASSES]));
    }
    if let Some(scale) = args.scale {
        limits.iter_mut().zip(&scheme.0).for_each(|(limit, class)| *limit = scale * class.budget_m);
        return Ok(Some(limits));
    }
    let Some(budget) = &args.budget else { return Ok(None) };
    for part in budget.split(',') {
        let names = || scheme.0.iter().map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ");
        let wanted = |what: &str| Error::Config(format!("--budget {part}: {what}; the record has {}", names()));
        let (name, metres) = part.split_once('=').ok_or_else(|| wanted("wanted CLASS=METRES"))?;
        let class = scheme.id(name.trim()).ok_or_else(|| wanted("there is no such class"))?;
        let limit = limits.get_mut(class.index()).ok_or_else(|| wanted("deviations of this class are not recorded"))?;
        *limit = positive_or_zero(metres.trim()).ok_or_else(|| wanted("wanted metres from 0"))?;
    }
    Ok(Some(limits))
}

fn positive_or_zero(text: &str) -> Option<f64> {
    text.parse::<f64>().ok().filter(|x| *x >= 0.0 && x.is_finite())
}
