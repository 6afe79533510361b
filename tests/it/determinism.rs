//! Same input and settings, same bytes: for any number of threads, any folder, any name of the output.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rooftile::config::Config;
use rooftile::geo::Georeference;
use rooftile::input::Source;
use rooftile::pipeline::{self, Job};
use rooftile::report::Reporter;

use crate::common::{build, files, shapes, town};

/// The four tiles in the middle of the demo city: a quarter of it, 30 000 triangles with four images.
fn quarter() -> Source {
    let mut source = town::city().source.clone();
    let mut number = 0;
    source.parts.retain(|_| {
        number += 1;
        [5, 6, 9, 10].contains(&(number - 1))
    });
    source
}

fn built(out: &Path, threads: usize, compress: bool) -> BTreeMap<PathBuf, Option<Vec<u8>>> {
    let sets = ["levels.leaf_faces=4000", "levels.tile_faces=3000", "levels.root_faces=1500"].map(String::from);
    let mut config = Config::layered(None, &sets).expect("settings");
    config.write.compress = compress;
    let georeference = Georeference::parse("EPSG:25832").expect("a system").with_origin(glam::dvec3(566e3, 5.93e6, 0.));
    let job = Job {
        out,
        force: false,
        config: &config,
        georeference,
        inputs: Vec::new(),
        labels_are_truth: false,
        labels: None,
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
    pool.install(|| pipeline::build(quarter(), &job, &Reporter::new(true))).expect("a build");
    files(out)
}

#[track_caller]
fn assert_same(a: &BTreeMap<PathBuf, Option<Vec<u8>>>, b: &BTreeMap<PathBuf, Option<Vec<u8>>>) {
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for (path, bytes) in a {
        assert!(b[path] == *bytes, "{} differs", path.display());
    }
}

fn threads_do_not_matter(compress: bool) {
    let temp = tempfile::tempdir().expect("a folder");
    let one = built(&temp.path().join("one"), 1, compress);
    assert!(one.len() > 10, "{:?}", one.keys());
    assert_same(&one, &built(&temp.path().join("two"), 2, compress));
}

#[test]
fn one_and_two_threads_write_the_same_bytes() {
    threads_do_not_matter(false);
}

#[test]
fn one_and_two_threads_write_the_same_compressed_bytes() {
    threads_do_not_matter(true);
}

#[test]
fn neither_threads_nor_the_folders_of_input_and_output_show_in_the_bytes() {
    let temp = tempfile::tempdir().expect("a folder");
    let run = |name: &str, threads: &str| {
        let input = shapes::house(&temp.path().join(name));
        let out = temp.path().join(format!("{name}-tiles"));
        build(&input, &out, &["--threads", threads]).wants(0);
        files(&out)
    };
    assert_same(&run("here", "1"), &run("elsewhere", "3"));
}
