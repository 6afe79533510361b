//! The experiment as a table for people.

use std::fmt::{Display, Formatter, Result};

use super::{Against, Cut, Equal, Experiment, Numbers};

impl Display for Experiment {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        let source = &self.source;
        writeln!(f, "source: {} faces, diagonal {:.2} m", source.faces, source.diagonal_m)?;
        writeln!(
            f,
            "\n{:<15} {:>6} {:>8} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}",
            "method", "asked", "faces", "mean", "key", "rms", "key rms", "Eq.17", "key", "Eq.18", "vtx rms"
        )?;
        self.cuts.iter().try_for_each(|cut| cut_row(f, cut))?;
        by_class(f, &self.cuts)?;
        if !self.against_baseline.is_empty() {
            let base = self.curves.first().map_or("", |c| &c.method);
            writeln!(
                f,
                "\n{:<15} {:>6} {:>8} {:>8} {:>8} {:>8} {:>8}",
                format!("against {base}"),
                "asked",
                "mean",
                "key",
                "rms",
                "Eq.17",
                "key"
            )?;
            self.against_baseline.iter().try_for_each(|a| against_row(f, a))?;
            writeln!(
                f,
                "\n{:<15} {:>6} {:>12} {:>12} {:>8} {:>15} {:>8}",
                "equal accuracy", "asked", "baseline has", "method needs", "spared", "baseline needs", "spared"
            )?;
            self.equal_accuracy.iter().try_for_each(|e| equal_row(f, e))?;
        }
        let key = if self.key.is_empty() { "no class here".to_owned() } else { self.key.join(" and ") };
        writeln!(
            f,
            "\nMillimetres: mean and rms both ways with equal weight, {} samples each; key: {key}. Eq.17, Eq.18 (as \
             printed,\nm^½) and vtx rms: the paper's, at vertices of the cut only. Spared: first at the baseline's mean, \
             then at the\nmethod's (as the paper has it).",
            self.samples
        )
    }
}

fn cut_row(f: &mut Formatter<'_>, cut: &Cut) -> Result {
    write!(f, "{:<15} {:>6} {:>8}", cut.method, cut.asked, cut.faces)?;
    let key = |of: fn(&Numbers) -> f64| cut.key.as_ref().map(of);
    let (paper, key_paper) = (cut.all.paper, cut.key.as_ref().and_then(|k| k.paper));
    let distances = [
        Some(cut.all.mean_m),
        key(|n| n.mean_m),
        Some(cut.all.rms_m),
        key(|n| n.rms_m),
        paper.map(|p| p.eq17_mean_m),
        key_paper.map(|p| p.eq17_mean_m),
    ];
    for distance in distances {
        write!(f, " {:>9}", millimetres(distance))?;
    }
    let eq18 = paper.map_or("-".into(), |p| format!("{:.4}", p.eq18_as_printed_sqrt_m));
    writeln!(f, " {eq18:>9} {:>9}", millimetres(paper.map(|p| p.true_rms_m)))
}

/// Mean distances of each class.
fn by_class(f: &mut Formatter<'_>, cuts: &[Cut]) -> Result {
    let names: Vec<&str> =
        cuts.first().map(|c| c.by_class.iter().map(|k| k.name.as_str()).collect()).unwrap_or_default();
    write!(f, "\n{:<15} {:>6}", "mean by class", "asked")?;
    names.iter().try_for_each(|name| write!(f, " {:>17}", format!("{name} (faces)")))?;
    writeln!(f)?;
    for cut in cuts {
        write!(f, "{:<15} {:>6}", cut.method, cut.asked)?;
        for name in &names {
            let found = cut.by_class.iter().find(|k| k.name == *name).map(|k| &k.numbers);
            let text = found.map_or("-".into(), |n| format!("{} ({})", millimetres(Some(n.mean_m)), n.cut_faces));
            write!(f, " {text:>17}")?;
        }
        writeln!(f)?;
    }
    Ok(())
}

fn against_row(f: &mut Formatter<'_>, against: &Against) -> Result {
    write!(f, "{:<15} {:>6}", against.method, against.asked)?;
    let changes = [against.mean, against.key_mean, against.rms, against.eq17, against.key_eq17];
    for change in changes {
        write!(f, " {:>8}", change.map_or("-".into(), |c| format!("{:+.1} %", 100.0 * c)))?;
    }
    writeln!(f)
}

fn equal_row(f: &mut Formatter<'_>, equal: &Equal) -> Result {
    let number = |n: Option<usize>| n.map_or("-".into(), |n| n.to_string());
    let share = |s: Option<f64>| s.map_or("-".into(), |s| format!("{:.1} %", 100.0 * s));
    writeln!(
        f,
        "{:<15} {:>6} {:>12} {:>12} {:>8} {:>15} {:>8}",
        equal.method,
        equal.asked,
        equal.baseline_faces,
        number(equal.faces),
        share(equal.spared),
        number(equal.baseline_faces_for_method_mean),
        share(equal.spared_as_in_paper)
    )
}

/// Four digits that count.
fn millimetres(distance_m: Option<f64>) -> String {
    match distance_m.map(|d| d * 1000.0) {
        None => "-".into(),
        Some(d) if d >= 1000.0 => format!("{d:.0}"),
        Some(d) if d >= 100.0 => format!("{d:.1}"),
        Some(d) if d >= 1.0 || d == 0.0 => format!("{d:.2}"),
        Some(d) => format!("{d:.4}"),
    }
}
