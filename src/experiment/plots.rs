//! Figures 6 to 8 as charts, and the mean over the number of faces.

use super::{Cut, Experiment, Numbers};
use crate::Result;
use crate::draw::plot::{Axis, BarChart, Bars, LineChart, Series};
use crate::draw::png;
use crate::draw::sheet::Sheet;

/// Charts are this large, pixels.
const SIZE_PX: [u32; 2] = [720, 440];
/// Below this all values are shown in millimetres.
const SMALL_M: f64 = 0.5;

type Value = fn(&Numbers) -> Option<f64>;

/// Each chart as PNG and SVG.
pub(super) fn files(experiment: &Experiment) -> Result<Vec<(String, Vec<u8>)>> {
    let eq17 = |n: &Numbers| n.paper.map(|p| p.eq17_mean_m);
    let eq18 = |n: &Numbers| n.paper.map(|p| p.eq18_as_printed_sqrt_m);
    let charts = [
        ("fig6-mean", distances(experiment, "Mean distance, both ways", |n| Some(n.mean_m))),
        ("fig6-mean-eq17", distances(experiment, "Mean distance of vertices (Eq. 17)", eq17)),
        ("fig7-rms", distances(experiment, "Root mean square distance, both ways", |n| Some(n.rms_m))),
        ("fig7-rms-eq18", bars(experiment, "Eq. 18 as printed, of vertices", eq18, ("root of m", 1.0))),
        ("fig8-faces", equal_accuracy(experiment)),
        ("curve", curve(experiment)),
    ];
    let mut files = Vec::new();
    for (name, sheet) in charts {
        files.push((format!("{name}.png"), png::bytes(&sheet.picture())?));
        files.push((format!("{name}.svg"), sheet.svg().into_bytes()));
    }
    Ok(files)
}

/// Numbers of faces as asked for, each once.
pub(super) fn asked(experiment: &Experiment) -> Vec<&str> {
    let mut found: Vec<&str> = Vec::new();
    for cut in &experiment.cuts {
        if !found.contains(&cut.asked.as_str()) {
            found.push(&cut.asked);
        }
    }
    found
}

/// Metres, or millimetres where all is small.
fn unit(values: impl Iterator<Item = f64>) -> (&'static str, f64) {
    if values.fold(0.0, f64::max) < SMALL_M { ("mm", 1000.0) } else { ("m", 1.0) }
}

fn distances(experiment: &Experiment, title: &str, value: Value) -> Sheet {
    let cuts = experiment.cuts.iter();
    let all = cuts.flat_map(|c| std::iter::once(&c.all).chain(&c.key)).filter_map(value);
    bars(experiment, title, value, unit(all))
}

/// All classes and key classes, at every number of faces, by method.
fn bars(experiment: &Experiment, title: &str, value: Value, (unit, factor): (&str, f64)) -> Sheet {
    let asked = asked(experiment);
    let parts: &[&str] = if experiment.key.is_empty() { &["all"] } else { &["all", "key"] };
    let groups = parts.iter().flat_map(|part| asked.iter().map(move |a| (*part, *a)));
    let of_cut = |cut: &Cut, part: &str| {
        let numbers = if part == "key" { cut.key.as_ref() } else { Some(&cut.all) };
        numbers.and_then(value).map_or(f64::NAN, |v| v * factor)
    };
    let of_method = |method: &str| -> Vec<f64> {
        let cut = |a: &str| experiment.cuts.iter().find(|c| c.method == method && c.asked == a);
        groups.clone().map(|(part, a)| cut(a).map_or(f64::NAN, |c| of_cut(c, part))).collect()
    };
    let chart = BarChart {
        title: title.to_owned(),
        y: Axis { label: unit.to_owned(), ..Axis::default() },
        groups: groups.clone().map(|(part, a)| format!("{part}, {a} of faces")).collect(),
        series: experiment
            .curves
            .iter()
            .map(|c| Bars { name: c.method.clone(), values: of_method(&c.method), color: None })
            .collect(),
    };
    chart.sheet(SIZE_PX)
}

/// Faces of the baseline, and those that the others need to be as accurate.
fn equal_accuracy(experiment: &Experiment) -> Sheet {
    let asked = asked(experiment);
    let faces = |i: usize, method: &str, a: &str| {
        let found = experiment.equal_accuracy.iter().find(|e| e.asked == a && (i == 0 || e.method == method));
        let faces = found.and_then(|e| if i == 0 { Some(e.baseline_faces) } else { e.faces });
        faces.map_or(f64::NAN, |f| f as f64)
    };
    let series = experiment.curves.iter().enumerate().map(|(i, c)| Bars {
        name: c.method.clone(),
        values: asked.iter().map(|a| faces(i, &c.method, a)).collect(),
        color: None,
    });
    let baseline = experiment.curves.first().map_or("the baseline", |c| &c.method);
    let chart = BarChart {
        title: "Faces at equal accuracy".to_owned(),
        y: Axis { label: "faces".to_owned(), ..Axis::default() },
        groups: asked.iter().map(|a| format!("as accurate as {baseline} at {a}")).collect(),
        series: series.collect(),
    };
    chart.sheet(SIZE_PX)
}

/// Mean over faces, of everything that was measured.
fn curve(experiment: &Experiment) -> Sheet {
    let (unit, factor) = unit(experiment.curves.iter().flat_map(|c| &c.points).map(|p| p.1));
    let series = experiment.curves.iter().map(|c| Series {
        name: c.method.clone(),
        points: c.points.iter().map(|(faces, mean_m)| [*faces as f64, mean_m * factor]).collect(),
        marks: true,
        ..Series::default()
    });
    let chart = LineChart {
        title: "Mean distance, both ways".to_owned(),
        x: Axis { label: "faces".to_owned(), log: true, range: None },
        y: Axis { label: unit.to_owned(), log: true, range: None },
        series: series.collect(),
    };
    chart.sheet(SIZE_PX)
}
