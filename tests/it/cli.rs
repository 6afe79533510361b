//! The program as a user meets it: flags, exit codes, what it prints and what it leaves on disk.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use crate::common::town::town;
use crate::common::{Run, build, command, files, names, rooftile, shapes};

/// Longer than anything here takes on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);

fn temp() -> tempfile::TempDir {
    tempfile::tempdir().expect("a folder")
}

#[test]
fn help_and_version_are_answers_and_wrong_flags_are_not() {
    for args in [&["--help"][..], &["--version"], &["build", "--help"], &["demo", "--help"], &["serve", "--help"]] {
        let run = rooftile(args).wants(0);
        assert!(!run.stdout.is_empty() && run.stderr.is_empty(), "{args:?}");
    }
    assert!(rooftile(["--version"]).stdout.contains(env!("CARGO_PKG_VERSION")));
    let wrong = [
        &["build", "--no-such-flag"][..],
        &["build"],
        &["build", "x.obj"],
        &["nonsense"],
        &[],
        &["demo", "--size", "huge"],
        &["inspect", "x.obj", "--threads", "many"],
    ];
    for args in wrong {
        let run = rooftile(args).wants(2);
        assert!(run.stdout.is_empty() && !run.stderr.is_empty(), "{args:?}");
    }
}

#[test]
fn the_dumped_config_reads_back_as_itself() {
    let temp = temp();
    let file = temp.path().join("all.toml");
    let dumped = rooftile(["build", "--dump-config", "--compress", "--set", "levels.leaf_faces=1234"]).wants(0).stdout;
    let settings: toml::Table = dumped.parse().expect("TOML");
    assert_eq!(settings["levels"]["leaf_faces"].as_integer(), Some(1234));
    assert_eq!(settings["write"]["compress"].as_bool(), Some(true));
    fs::write(&file, &dumped).expect("a file");
    let again = rooftile(["build", "--dump-config", "--config", file.to_str().expect("UTF-8")]).wants(0).stdout;
    assert_eq!(again, dumped);
    let over =
        ["build", "--dump-config", "--config", file.to_str().expect("UTF-8"), "--set", "levels.leaf_faces=99999"];
    assert!(rooftile(over).wants(0).stdout.contains("leaf_faces = 99999"), "--set wins over the file");
}

#[test]
fn faults_in_settings_are_named_with_what_is_wanted() {
    let cases = [
        ("levels.leaf_face=3", "leaf_face"),
        ("levels.leaf_faces=many", "invalid type"),
        ("levels.step_ratio=9", "step_ratio"),
        ("levels", "KEY=VALUE"),
        ("=3", "KEY=VALUE"),
        ("gate.weld_m=-1", "wanted 0 to 1"),
        ("gate.weld_m=nan", "weld_m"),
        ("write.texel_factor=inf", "texel_factor"),
        ("texture.jpeg_quality=101", "jpeg_quality"),
    ];
    for (set, says) in cases {
        let run = rooftile(["build", "--dump-config", "--set", set]).wants(2);
        assert!(run.stderr.contains(says), "{set}: {}", run.stderr);
        assert_eq!(run.stderr.lines().count(), 1, "{}", run.stderr);
        assert!(run.stdout.is_empty());
    }
}

#[test]
fn an_existing_output_is_refused_and_untouched_without_force() {
    let temp = temp();
    let house = shapes::house(&temp.path().join("in"));
    let out = temp.path().join("out");
    build(&house, &out, &[]).wants(0);
    let before = files(temp.path());
    let run = build(&house, &out, &["--compress"]).wants(5);
    assert!(run.stderr.contains("--force"), "{}", run.stderr);
    assert!(files(temp.path()) == before, "something changed");
    build(&house, &out, &["--compress", "--force"]).wants(0);
    assert!(files(temp.path()) != before, "--force did not replace it");
    assert_eq!(names(temp.path()), ["in", "out"]);
    // A folder of somebody's own is never replaced.
    let own = temp.path().join("own");
    fs::create_dir(&own).expect("a folder");
    fs::write(own.join("thesis.tex"), "years").expect("a file");
    build(&house, &own, &["--force"]).wants(5);
    assert_eq!(names(&own), ["thesis.tex"]);
}

#[test]
fn an_output_inside_its_input_or_around_it_is_refused() {
    let temp = temp();
    let house = shapes::house(&temp.path().join("a/in"));
    let input = house.parent().expect("a folder");
    let before = files(temp.path());
    for (input, out) in [(input, input.join("tiles")), (input, input.to_path_buf()), (&house, temp.path().join("a"))] {
        let run = build(input, &out, &["--force"]).wants(5);
        assert!(run.stderr.contains("name a folder beside it"), "{}", run.stderr);
    }
    assert!(files(temp.path()) == before, "something changed");
    // Beside its input file is fine.
    build(&house, &input.join("tiles"), &[]).wants(0);
}

#[test]
fn json_is_one_object_on_standard_output_and_a_quiet_run_says_nothing_else() {
    let temp = temp();
    let house = shapes::house(&temp.path().join("in"));
    let out = temp.path().join("out");
    let run = build(&house, &out, &["--json"]).wants(0);
    let report = run.json();
    assert_eq!((run.stdout.lines().count(), run.stderr.as_str()), (1, ""));
    assert_eq!(report["gate"]["faces"], 22, "{report}");
    assert_eq!(report["warnings"], serde_json::json!([]));
    let stages: Vec<&str> =
        report["stages"].as_array().expect("stages").iter().filter_map(|s| s["stage"].as_str()).collect();
    assert_eq!(stages, ["input", "frame", "mesh", "cells", "classes", "collapse", "walls", "tiles"]);
    // Without --json nothing is data; without -q people are told a line a stage.
    let run = command().arg("build").arg(&house).arg("-o").arg(&out).arg("--force").output().expect("a run");
    let run = Run::from(run).wants(0);
    assert!(run.stdout.is_empty() && stages.iter().all(|s| run.stderr.contains(s)), "{}", run.stderr);
}

#[test]
fn the_crs_option_places_the_tileset_and_build_json_repeats_the_build() {
    let temp = temp();
    let house = shapes::house(&temp.path().join("in"));
    let out = temp.path().join("out");
    let run = build(&house, &out, &["--json", "--crs", "EPSG:25832", "--origin", "566000,5930000,10"]).wants(0);
    assert_eq!(run.json()["frame"]["epsg"], 25832);
    let tileset: serde_json::Value =
        serde_json::from_slice(&fs::read(out.join("tileset.json")).expect("a file")).expect("JSON");
    let at: Vec<f64> = serde_json::from_value(tileset["root"]["transform"].clone()).expect("a transform");
    let radius_m = at[12].hypot(at[13]).hypot(at[14]);
    assert!((6.35e6..6.39e6).contains(&radius_m), "{radius_m} m from the centre of the Earth");
    let build: serde_json::Value =
        serde_json::from_slice(&fs::read(out.join("build.json")).expect("a file")).expect("JSON");
    assert_eq!(build["inputs"][0]["name"], "house.obj");
    assert_eq!(build["inputs"][0]["bytes"], shapes::HOUSE.len());
    assert!(!build.to_string().contains(temp.path().to_str().expect("UTF-8")), "build.json names a folder: {build}");
}

#[test]
fn inspect_speaks_of_inputs_and_of_tilesets() {
    let temp = temp();
    let house = shapes::house(temp.path());
    let input = rooftile(["inspect", house.to_str().expect("UTF-8"), "--json"]).wants(0).json();
    assert_eq!((&input["input"]["faces"], &input["input"]["materials"]), (&22.into(), &1.into()), "{input}");
    let town = town().folder.to_str().expect("UTF-8");
    let tileset = rooftile(["inspect", town, "--json"]).wants(0).json();
    assert_eq!(tileset["findings"], serde_json::json!([]));
    let by_file = rooftile(["inspect", &format!("{town}/tileset.json"), "--json"]).wants(0).json();
    assert_eq!(by_file["tileset"]["tiles"], tileset["tileset"]["tiles"]);
    let text = rooftile(["inspect", town]).wants(0).stdout;
    assert!(text.contains("terrain") && text.contains("roof"), "{text}");
    rooftile(["inspect", "no-such-thing.obj"]).wants(3);
}

#[test]
fn a_broken_tileset_is_a_finding_and_ends_with_1() {
    let temp = temp();
    let house = shapes::house(&temp.path().join("in"));
    let out = temp.path().join("out");
    build(&house, &out, &[]).wants(0);
    let tile = files(&out).into_keys().find(|p| p.extension().is_some_and(|e| e == "glb")).expect("a tile");
    fs::remove_file(out.join(&tile)).expect("removed");
    let path = out.to_str().expect("UTF-8");
    let run = rooftile(["inspect", path, "--json"]).wants(1);
    assert_eq!(run.json()["findings"][0]["code"], "missing-file");
    assert!(rooftile(["inspect", path]).wants(1).stdout.contains("missing-file"));
    fs::write(out.join(&tile), "glTF").expect("a file");
    assert_eq!(rooftile(["inspect", path, "--json"]).wants(1).json()["findings"][0]["code"], "broken-glb");
    fs::write(out.join("tileset.json"), "{").expect("a file");
    assert!(rooftile(["inspect", path]).wants(3).stderr.contains("is no tileset"));
}

/// Runs to the end although nobody reads the given streams.
fn with_nobody_reading(args: &[&str], stdout: bool, stderr: bool) -> i32 {
    let mut child = command().args(args).spawn().expect("the program starts");
    if stdout {
        drop(child.stdout.take());
    }
    if stderr {
        drop(child.stderr.take());
    }
    child.wait_with_output().expect("an end").status.code().unwrap_or(-1)
}

#[test]
fn a_reader_that_goes_away_is_no_error() {
    let town = town().folder.to_str().expect("UTF-8");
    for args in [&["inspect", town][..], &["inspect", town, "--json"], &["build", "--dump-config"], &["--help"]] {
        assert_eq!(with_nobody_reading(args, true, false), 0, "{args:?}");
    }
}

#[test]
fn nobody_reading_messages_is_no_error_either() {
    let temp = temp();
    let house = shapes::house(&temp.path().join("in"));
    let house = house.to_str().expect("UTF-8");
    let out = temp.path().join("out");
    let out = out.to_str().expect("UTF-8");
    assert_eq!(with_nobody_reading(&["build", house, "-o", out, "--json"], true, true), 0, "rooftile … 2>&1 | head -1");
    assert!(Path::new(out).join("tileset.json").is_file());
    assert_eq!(with_nobody_reading(&["build", house, "-o", out], true, true), 5, "the exit code stays");
}

/// A build that is under way: it holds its output.
struct UnderWay {
    child: Child,
    out: PathBuf,
}

impl UnderWay {
    /// Starts a build of `input` and waits until its work folder is there.
    fn start(input: &Path, out: &Path, more: &[&str]) -> Self {
        let mut command = command();
        command.arg("build").arg(input).arg("-o").arg(out).args(["-q", "--threads", "1"]).args(more);
        let child = command.stdout(Stdio::null()).spawn().expect("the program starts");
        let mut run = Self { child, out: out.to_path_buf() };
        let begun = Instant::now();
        while !run.has_work_folder() {
            assert!(run.child.try_wait().expect("a state").is_none(), "the build ended before it was seen");
            assert!(begun.elapsed() < PATIENCE, "no work folder after {PATIENCE:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
        run
    }

    fn has_work_folder(&self) -> bool {
        let name = format!(".{}.partial-{}", self.out.file_name().expect("a name").to_string_lossy(), self.child.id());
        self.out.with_file_name(name).is_dir()
    }

    #[cfg(unix)]
    fn signal(&self, name: &str) {
        let id = self.child.id().to_string();
        let status = std::process::Command::new("kill").args([format!("-{name}"), id]).status().expect("kill runs");
        assert!(status.success());
    }

    /// The exit code, `None` after a deadly signal, and what was said.
    fn end(mut self) -> (Option<i32>, String) {
        let begun = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().expect("a state") {
                break status;
            }
            if begun.elapsed() > PATIENCE {
                let _ = self.child.kill();
                panic!("still running after {PATIENCE:?}");
            }
            std::thread::sleep(Duration::from_millis(5));
        };
        let mut said = String::new();
        self.child.stderr.take().expect("a pipe").read_to_string(&mut said).expect("text");
        (status.code(), said)
    }
}

#[cfg(unix)]
#[test]
fn a_signal_stops_a_build_and_leaves_nothing_behind_but_work_to_go_on_with() {
    let temp = temp();
    let work = temp.path().join(".out.work");
    let hills = shapes::hills(&temp.path().join("in"), 250);
    let out = temp.path().join("out");
    for (name, code) in [("INT", 130), ("TERM", 143)] {
        let run = UnderWay::start(&hills, &out, &[]);
        run.signal(name);
        let (ended, said) = run.end();
        assert_eq!(ended, Some(code), "{said}");
        assert_eq!(said.lines().count(), 1, "{said}");
        // How far it came by then is chance; `resume` tests what is made of it.
        assert_eq!(said.contains("--resume"), work.exists(), "{said}");
        let _ = std::fs::remove_dir_all(&work);
        assert_eq!(names(temp.path()), ["in"], "after SIG{name}");
    }
    // With --force, the output that was there stays.
    let house = shapes::house(&temp.path().join("house"));
    build(&house, &out, &[]).wants(0);
    let before = files(temp.path());
    let run = UnderWay::start(&hills, &out, &["--force"]);
    run.signal("INT");
    assert_eq!(run.end().0, Some(130));
    let _ = std::fs::remove_dir_all(&work);
    assert!(files(temp.path()) == before, "something changed");
}

#[cfg(unix)]
#[test]
fn a_second_run_on_one_output_is_refused_and_a_killed_one_is_cleaned_up_after() {
    let temp = temp();
    let hills = shapes::hills(&temp.path().join("in"), 250);
    let house = shapes::house(&temp.path().join("house"));
    let out = temp.path().join("out");
    let run = UnderWay::start(&hills, &out, &[]);
    for more in [&[][..], &["--force"]] {
        let refused = build(&house, &out, more).wants(5);
        assert!(refused.stderr.contains("another run"), "{}", refused.stderr);
    }
    assert!(run.has_work_folder(), "the second run harmed the first");
    run.signal("KILL");
    assert_eq!(run.end().0, None);
    assert!(names(temp.path()).len() > 2, "a killed run cannot clean up");
    build(&house, &out, &[]).wants(0);
    assert_eq!(names(temp.path()), ["house", "in", "out"]);
}

#[test]
fn an_output_is_whole_from_the_moment_it_is_there() {
    let temp = temp();
    let hills = shapes::hills(&temp.path().join("in"), 60);
    let out = temp.path().join("out");
    let sets = ["--set", "levels.leaf_faces=500", "--set", "levels.tile_faces=500", "--set", "levels.root_faces=300"];
    let run = UnderWay::start(&hills, &out, &sets);
    let begun = Instant::now();
    while !out.exists() {
        assert!(begun.elapsed() < PATIENCE);
        std::thread::yield_now();
    }
    let seen = files(&out);
    assert_eq!(run.end().0, Some(0));
    assert!(seen.len() > 10 && seen == files(&out), "the output grew after it had appeared: {:?}", seen.keys());
    assert_eq!(names(temp.path()), ["in", "out"]);
}

#[test]
fn presets_are_defined_in_the_help_and_bad_budgets_and_skirts_are_usage_errors() {
    let help = rooftile(["build", "--help"]).wants(0).stdout;
    let flat = help.split_whitespace().collect::<Vec<_>>().join(" ");
    for preset in &rooftile::preset::PRESETS {
        for (key, value) in preset.settings {
            assert!(flat.contains(&format!("{key}={value}")), "--help does not say {key}={value} of {}", preset.name);
        }
    }
    for wrong in [
        ["--budget", "dach=0.05"],
        ["--budget", "roof=wide"],
        ["--budget", "roof=-1"],
        ["--budget", ""],
        ["--skirts", "long"],
        ["--skirts", "-1"],
        ["--preset", "City"],
    ] {
        let run = rooftile(["build", "--dump-config"].into_iter().chain(wrong));
        assert_eq!(run.code, 2, "{wrong:?}: {}", run.stderr);
    }
    let args = [
        "build",
        "--dump-config",
        "--preset",
        "flight",
        "--set",
        "budget.roof=2",
        "--budget",
        "roof=0.5",
        "--skirts",
        "0.25",
    ];
    let dumped = rooftile(args).wants(0).stdout;
    assert!(dumped.contains("keep_tops = true") && dumped.contains("skirts = 0.25"), "{dumped}");
    assert!(dumped.contains("budget_m = 0.5") && !dumped.contains("budget_m = 2"), "{dumped}");
}
