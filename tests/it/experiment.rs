//! `rooftile experiment` from outside: what is in its folder and in its numbers, and what it refuses.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::common::{Run, names, rooftile};

/// A bumpy square of 2·n² triangles, a metre each side; its eastern half is roof, the rest terrain.
fn bumps(folder: &Path, n: usize) -> PathBuf {
    let row = n + 1;
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\nelement face \
         {}\nproperty list uchar int vertex_indices\nproperty int label\nend_header\n",
        row * row,
        2 * n * n
    );
    for i in 0..row * row {
        let (x, y) = ((i % row) as f64, (i / row) as f64);
        let z = 2.0 * (x / 6.0).sin() * (y / 5.0).cos() + 0.2 * (x * 1.9 + y * 2.3).sin();
        writeln!(text, "{x} {y} {z:.4}").expect("text");
    }
    for i in 0..n * n {
        let a = i / n * row + i % n;
        let label = if i % n < n / 2 { 0 } else { 2 };
        writeln!(text, "3 {a} {} {} {label}", a + 1, a + 1 + row).expect("text");
        writeln!(text, "3 {a} {} {} {label}", a + 1 + row, a + row).expect("text");
    }
    let path = folder.join("bumps.ply");
    fs::write(&path, text).expect("a file");
    path
}

fn experiment(input: &Path, out: &Path, more: &[&str]) -> Run {
    let (input, out) = (input.to_str().expect("UTF-8"), out.to_str().expect("UTF-8"));
    let mut args = vec!["experiment", input, "-o", out, "-q", "--samples", "20000"];
    args.extend(more);
    rooftile(args)
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

#[test]
fn the_experiment_is_written_whole() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = bumps(temp.path(), 40);
    let out = temp.path().join("out");
    let report = experiment(&input, &out, &["--json"]).wants(0).json();
    let mut wanted = vec!["experiment.json", "fig5-distance.png", "fig5-models.png", "fig9-classes.png", "table.txt"];
    let charts: Vec<String> = ["curve", "fig6-mean", "fig6-mean-eq17", "fig7-rms", "fig7-rms-eq18", "fig8-faces"]
        .iter()
        .flat_map(|name| [format!("{name}.png"), format!("{name}.svg")])
        .collect();
    wanted.extend(charts.iter().map(String::as_str));
    wanted.sort_unstable();
    assert_eq!(names(&out), wanted);
    for name in wanted.iter().filter(|n| n.ends_with("png")) {
        let picture = image::open(out.join(name)).expect("a picture").to_rgb8();
        let first = picture.pixels().next().copied();
        assert!(picture.width() > 300 && picture.pixels().any(|p| Some(*p) != first), "{name}");
    }
    let text = fs::read(out.join("experiment.json")).expect("a file");
    assert_eq!(serde_json::from_slice::<Value>(&text).expect("JSON"), report);

    let cuts = report["cuts"].as_array().expect("cuts");
    let kinds: Vec<_> = cuts.iter().map(|c| [c["method"].as_str(), c["asked"].as_str()].map(Option::unwrap)).collect();
    assert_eq!(kinds, [["plain", "10%"], ["semantic", "10%"], ["plain", "5%"], ["semantic", "5%"]]);
    for (i, pair) in cuts.chunks(2).enumerate() {
        let [plain, semantic] = pair else { panic!("two methods") };
        let limit = [320.0, 160.0][i];
        for cut in pair {
            assert!((limit - 1.0..=limit).contains(&number(&cut["faces"])), "{cut}");
            assert!(number(&cut["all"]["rms_m"]) > number(&cut["all"]["mean_m"]));
            let paper = &cut["all"]["paper"];
            let (eq17, eq18) = (number(&paper["eq17_mean_m"]), number(&paper["eq18_as_printed_sqrt_m"]));
            assert!((eq17.sqrt() - eq18).abs() < 1e-12);
            // One key class: it is the key.
            let roof = cut["by_class"].as_array().expect("classes").iter().find(|c| c["name"] == "roof").expect("roof");
            assert!((number(&roof["mean_m"]) - number(&cut["key"]["mean_m"])).abs() < 1e-9);
        }
        for part in ["all", "key"] {
            let [ours, theirs] = [semantic, plain].map(|c| number(&c[part]["mean_m"]));
            assert!(ours <= theirs, "{part}: {ours} of semantic, {theirs} of plain");
        }
        let equal = &report["equal_accuracy"][i];
        assert!(number(&equal["faces"]) < number(&plain["faces"]), "{equal}");
        assert!(number(&equal["baseline_faces_for_method_mean"]) > number(&semantic["faces"]), "{equal}");
    }
}

#[test]
fn the_same_input_gives_the_same_files_on_one_thread_and_on_two() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = bumps(temp.path(), 16);
    let methods = ["--methods", "plain,lindstrom-turk,semantic", "--faces", "20%"];
    let files = ["1", "2"].map(|threads| {
        let out = temp.path().join(threads);
        let run = experiment(&input, &out, &[&methods[..], &["--threads", threads]].concat()).wants(0);
        assert!(run.stdout.contains("lindstrom-turk") && run.stdout.contains("20%"), "{}", run.stdout);
        crate::common::files(&out)
    });
    assert!(files[0] == files[1]);
}

#[test]
fn budgets_decide_which_class_keeps_its_triangles() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = bumps(temp.path(), 24);
    let roof_mean = |name: &str, budget: &str| {
        let flags = ["--methods", "plain,semantic", "--faces", "20%", "--budget", budget, "--json"];
        let report = experiment(&input, &temp.path().join(name), &flags).wants(0).json();
        let wanted: f64 = budget.split(['=', ',']).nth(1).and_then(|b| b.parse().ok()).expect("metres");
        assert_eq!(number(&report["budgets_m"]["roof"]), wanted);
        let semantic = report["cuts"].as_array().and_then(|c| c.iter().find(|c| c["method"] == "semantic")).cloned();
        let by_class = semantic.expect("a cut")["by_class"].as_array().cloned().expect("classes");
        number(&by_class.iter().find(|c| c["name"] == "roof").expect("roof")["mean_m"])
    };
    let (strict, lax) = (roof_mean("strict", "roof=0.02,terrain=0.5"), roof_mean("lax", "roof=0.5,terrain=0.02"));
    assert!(strict < 0.7 * lax, "{strict} and {lax} m");
    experiment(&input, &temp.path().join("none"), &["--budget", "rof=1"]).wants(2);
}

#[test]
fn what_is_refused_leaves_nothing_behind() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = bumps(temp.path(), 4);
    let out = temp.path().join("out");
    experiment(&input, &out, &["--methods", "plain,plain"]).wants(2);
    experiment(&input, &out, &["--faces", "10%,5%,10%"]).wants(2);
    experiment(&input, &out, &["--faces", "0"]).wants(2);
    experiment(&temp.path().join("none.ply"), &out, &[]).wants(3);
    assert_eq!(names(temp.path()), ["bumps.ply"]);
    fs::create_dir(&out).expect("a folder");
    fs::write(out.join("thesis.tex"), "years").expect("a file");
    experiment(&input, &out, &[]).wants(5);
    assert_eq!(names(&out), ["thesis.tex"]);
}
