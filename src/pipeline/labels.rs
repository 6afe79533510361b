//! Gives every face its class, window by window.
//!
//! In: a [`City`]. Out: the `labels` page of each leaf, and [`Labels`] about the whole.
//!
//! # Method
//! A window of leaves is read with a halo around it, joined to one mesh, and classified as if it were all there is; the
//! halo's labels are thrown away. The ground grid starts at a whole metre, so that windows see the same cells.
//!
//! # Promises
//! Where the halo reaches far enough the labels are those of an uncut run (`windows_give_the_classes_of_the_whole`).
//!
//! # Limits
//! Hills, long roofs and filled ground reach further than any halo: of 3.0 million faces on 600 m × 400 m, cut in two or
//! in four windows with 64 m around them, 0.5 % of the area differed from an uncut run, nearly all of it in the tenth of
//! the leaves that lie along the cuts.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::ingest::{City, leaf_mesh};
use super::report::ClassShare;
use super::windows::{self, Weighed};
use crate::classes::{self, Confusion};
use crate::config::Config;
use crate::ids::ClassId;
use crate::mesh::Mesh;
use crate::planes;
use crate::report::Reporter;
use crate::store::Store;
use crate::tiles::Quadtree;
use crate::tiles::soup::bits;
use crate::{Error, Result};

/// A window and its halo have at most this many times the faces a window may have.
const MOST_WITH_HALO: f64 = 2.5;
/// How far the halo reaches, metres: the widest building that the ground runs under is 62 m, and the ground is found
/// twice, the second time by the slope of the first.
const HALO_M: f64 = 128.0;

/// What is known of the classes of the whole.
pub(super) struct Labels {
    pub median_edge_m: f64,
    pub shares: Vec<ClassShare>,
    pub accuracy: Option<Confusion>,
}

/// What a finished window leaves beside the leaves' pages.
#[derive(Serialize, Deserialize)]
struct Finished {
    regions: usize,
    faces: usize,
    median_edge_m: f64,
}

/// Classes and weights of a leaf's faces.
pub(super) fn leaf_labels(store: &Store, cell: u32) -> Result<(Vec<ClassId>, Vec<f32>)> {
    let mut page = store.read(&format!("labels/{cell}"))?;
    let labels = page.take::<u8>()?.into_iter().map(ClassId).collect();
    let omega = page.take()?;
    page.finish()?;
    Ok((labels, omega))
}

/// Classifies all leaves that have no labels yet.
pub(super) fn label(
    city: &City,
    config: &Config,
    labels_are_truth: bool,
    store: &Store,
    reporter: &Reporter,
) -> Result<Labels> {
    let cells = city.leaves.iter().map(|l| Weighed { cell: l.cell, weight: l.faces as u64 }).collect();
    let windows = windows::split(&city.tree, cells, config.levels.window_faces as u64, false);
    let stage = reporter.stage("classes", windows.len() as u64);
    let mut all: Vec<Finished> = Vec::new();
    for (w, window) in windows.iter().enumerate() {
        reporter.check()?;
        let name = format!("labels/window-{w}.json");
        let known = store.read_file(&name)?.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        let finished = match known {
            Some(finished) => finished,
            None => {
                let finished = label_window(city, config, window, store, reporter)?;
                let bytes = serde_json::to_vec(&finished).map_err(|e| Error::Bug(format!("labels: {e}")))?;
                store.write_file(&name, &bytes)?;
                finished
            }
        };
        all.push(finished);
        stage.step(1);
    }
    let faces: usize = all.iter().map(|w| w.faces).sum();
    let median_edge_m = all.iter().map(|w| w.median_edge_m * w.faces as f64).sum::<f64>() / faces.max(1) as f64;
    let (shares, accuracy) = tally(city, config, labels_are_truth, store)?;
    let total: f64 = shares.iter().map(|s| s.area_m2).sum();
    let parts: Vec<String> = shares.iter().map(|s| format!("{} {:.0} %", s.class, 100.0 * s.area_m2 / total)).collect();
    let regions: usize = all.iter().map(|w| w.regions).sum();
    let count = windows.len();
    stage
        .finish(format!("{} in {count} windows, {regions} planes, median edge {median_edge_m:.3} m", parts.join(", ")));
    Ok(Labels { median_edge_m, shares, accuracy })
}

fn label_window(
    city: &City,
    config: &Config,
    window: &[Weighed],
    store: &Store,
    reporter: &Reporter,
) -> Result<Finished> {
    let most = (config.levels.window_faces as f64 * MOST_WITH_HALO) as u64;
    let halo = windows::halo(&city.tree, &city.leaves, window, HALO_M, most);
    // In the order of the whole: where planes compete for a face, the order of faces decides.
    let mut cells: Vec<u32> = window.iter().map(|w| w.cell).chain(halo).collect();
    cells.sort_unstable();
    let (mut mesh, starts) = joined(store, &city.tree, &cells)?;
    align(&mut mesh, city.floor_m);
    reporter.check()?;
    let planes = planes::grow(&mesh, &config.planes);
    reporter.check()?;
    let classes = classes::label(&mesh, &planes, &config.classes, &config.classify);
    let budgets: Vec<f64> = config.classes.0.iter().map(|c| c.budget_m).collect();
    let weight = |f: usize| {
        let sum = classes.of(f).iter().zip(&budgets).map(|(p, b)| f64::from(*p) / (b * b)).sum::<f64>();
        sum as f32
    };
    for w in window {
        let i = cells.binary_search(&w.cell).unwrap_or_else(|_| unreachable!("a window holds its own cells"));
        let range = starts[i]..starts[i + 1];
        let labels: Vec<u8> = classes.label[range.clone()].iter().map(|l| l.0).collect();
        let mut page = store.page(&format!("labels/{}", w.cell))?;
        page.put(&labels)?;
        page.put(&range.map(weight).collect::<Vec<f32>>())?;
        page.finish()?;
    }
    let faces = window.iter().map(|w| w.weight as usize).sum();
    Ok(Finished { regions: planes.regions.len(), faces, median_edge_m: planes.median_edge_m })
}

/// The surface of several leaves as one mesh, geometry only, and where the faces of each begin.
fn joined(store: &Store, tree: &Quadtree, cells: &[u32]) -> Result<(Mesh, Vec<usize>)> {
    let mut all = Mesh::default();
    let mut ids: std::collections::HashMap<[u64; 3], u32> = Default::default();
    let mut starts = vec![0];
    for &cell in cells {
        let mesh = leaf_mesh(store, cell)?;
        let plan = &tree.0[cell as usize].plan;
        // Only vertices on a leaf's rim can stand in two leaves.
        let on_rim = |p: &DVec3| (0..2).any(|k| p[k] == plan.min[k] || p[k] == plan.max[k]);
        let mut push = |p: DVec3| {
            all.positions.push(p);
            all.positions.len() as u32 - 1
        };
        let new: Vec<u32> = mesh
            .positions
            .iter()
            .map(|p| if on_rim(p) { *ids.entry(bits(*p)).or_insert_with(|| push(*p)) } else { push(*p) })
            .collect();
        all.faces.extend(mesh.faces.iter().map(|f| f.map(|v| new[v as usize])));
        starts.push(all.faces.len());
    }
    all.face_material = vec![0; all.faces.len()];
    Ok((all, starts))
}

/// Adds a vertex of no face, so that the ground's grid begins at a whole metre wherever the window lies.
fn align(mesh: &mut Mesh, floor_m: f64) {
    let low = mesh.positions.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    mesh.positions.push(low.floor().with_z(floor_m.floor()));
}

/// How much of the source is of each class, and how much of that is right where the source says so.
fn tally(
    city: &City,
    config: &Config,
    labels_are_truth: bool,
    store: &Store,
) -> Result<(Vec<ClassShare>, Option<Confusion>)> {
    let blank = |name: &str| ClassShare { class: name.to_owned(), triangles: 0, area_m2: 0.0 };
    let mut shares: Vec<ClassShare> = config.classes.0.iter().map(|c| blank(&c.name)).collect();
    let (mut truth, mut found, mut areas) = (Vec::new(), Vec::new(), Vec::new());
    for leaf in &city.leaves {
        let mesh = leaf_mesh(store, leaf.cell)?;
        let (labels, _) = leaf_labels(store, leaf.cell)?;
        for (f, label) in labels.iter().enumerate() {
            let area_m2 = mesh.cross(f).length() * 0.5;
            shares[label.index()].triangles += 1;
            shares[label.index()].area_m2 += area_m2;
            if labels_are_truth {
                areas.push(area_m2);
            }
        }
        if labels_are_truth {
            truth.extend(mesh.face_labels.iter().map(|l| ClassId((*l).max(0) as u8)));
            found.extend(labels);
        }
    }
    let accuracy = labels_are_truth.then(|| classes::confusion(&truth, &found, &areas));
    Ok((shares, accuracy))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::demo::{CityConfig, generate};
    use crate::geo::Georeference;
    use crate::pipeline::ingest::ingest;
    use crate::pipeline::{Feed, Job, Resources};

    /// Area that has the same class in windows of `window_faces` as in one window, as a share of all.
    fn agreement(window_faces: usize) -> f64 {
        let folder = tempfile::tempdir().unwrap();
        let sets = ["levels.leaf_faces=4000".to_owned()];
        let mut config = Config::layered(None, &sets).unwrap();
        let reporter = Reporter::new(true);
        let out = folder.path().join("out");
        let job = Job {
            out: &out,
            force: false,
            config: &config,
            georeference: Georeference::Local,
            inputs: Vec::new(),
            labels_are_truth: false,
        };
        let source = generate(&CityConfig::default()).source;
        let store = Store::open(folder.path().join("work"), "token", false).unwrap();
        let city = ingest(Feed::Memory(source), &job, &Resources::default(), &store, &reporter).unwrap();
        let all = |store: &Store| -> Vec<Vec<ClassId>> {
            city.leaves.iter().map(|l| leaf_labels(store, l.cell).unwrap().0).collect()
        };
        label(&city, &config, false, &store, &reporter).unwrap();
        let uncut = all(&store);
        store.remove("labels");
        config.levels.window_faces = window_faces;
        label(&city, &config, false, &store, &reporter).unwrap();
        assert!(store.has("labels/window-1.json"), "there is one window only");
        let (mut same, mut whole) = (0.0, 0.0);
        for (leaf, (a, b)) in city.leaves.iter().zip(uncut.iter().zip(all(&store))) {
            let mesh = leaf_mesh(&store, leaf.cell).unwrap();
            for f in 0..mesh.faces.len() {
                let area = mesh.cross(f).length();
                whole += area;
                same += if a[f] == b[f] { area } else { 0.0 };
            }
        }
        same / whole
    }

    #[test]
    fn windows_give_the_classes_of_the_whole() {
        let same = agreement(40_000);
        println!("{:.3} % of the area has the class it has in an uncut run", 100.0 * same);
        assert!(same >= 0.999, "{same}");
    }
}
