//! Judges anybody's tileset by its published files: reads them, measures, and says what is wrong.
//!
//! Independent of the builder on purpose: nothing of `tiles`, `write` or `pipeline` is imported here.

//!
//! In: a tileset, perhaps its original mesh and a route. Out: an [`Audit`]: findings, and the figures they rest on.
//!
//! # Method
//! 1. [`read`]: the tree; [`structure`]: sizes, volumes, errors, texels
//! 2. [`distance`]: every tile against the finest surface, or the original; while a tile is loaded its border
//!    ([`seams`]) and its outline from above ([`envelope`]) are kept
//! 3. [`view`]: what viewers load with the stated errors, and would load with measured ones
//! 4. [`findings`]: all that is wrong, in one list

use std::path::Path;

use glam::DVec3;
use serde::Serialize;

use self::budget::Budget;
use self::cover::{ClassNames, Cover, Loader, Shown};
use self::distance::{DistanceConfig, TileDistance, Verdict, Watch};
use self::envelope::{EnvelopeRow, EnvelopeTile, Sinkings, Tops};
use self::findings::Fault;
use self::gaps::Openings;
use self::read::Tileset;
use self::seams::{Border, SeamConfig, Seams};
use self::source::{Original, OriginalConfig, Placed};
use self::structure::{Structure, StructureConfig};
use self::summary::Row;
use self::view::{Load, RouteLoad};
use crate::Result;
use crate::geo::Aabb;
use crate::report::{Reporter, Warning};

pub mod budget;
pub mod cells;
pub mod cover;
pub mod distance;
pub mod envelope;
pub mod findings;
pub mod finer;
pub mod gaps;
pub mod page;
pub mod read;
pub mod report;
pub mod rewrite;
pub mod seams;
pub mod source;
pub mod structure;
pub mod summary;
pub mod textures;
pub mod view;

/// What to look at.
#[derive(Debug, Clone, Default)]
pub struct AuditConfig {
    /// Sizes, volumes, errors.
    pub structure: StructureConfig,
    /// Distances and verdicts.
    pub distance: DistanceConfig,
    /// Seams.
    pub seams: SeamConfig,
    /// The original mesh, if it is to be the reference.
    pub original: Option<OriginalConfig>,
    /// Obstacles may sink by so much, metres; not looked at if none.
    pub obstacle_safe_m: Option<f64>,
    /// A route to fly: a GeoJSON file.
    pub route: Option<std::path::PathBuf>,
    /// Memory to stay within; the figures do not depend on it.
    pub budget: Budget,
}

/// What viewers load from over the middle of the dataset, by the errors as stated and by measured ones.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Station {
    /// Over the finest surface at the middle, metres.
    pub height_m: f64,
    /// The eye in the local frame.
    pub eye_local_m: [f64; 3],
    /// With the errors as stated.
    pub stated: Load,
    /// With the certified upper ends as errors.
    pub measured: Load,
    /// With 95th percentiles as errors.
    pub p95: Load,
}

impl Station {
    /// The eye in the local frame.
    pub fn eye(&self) -> DVec3 {
        DVec3::from_array(self.eye_local_m)
    }
}

/// A tileset, judged.
pub struct Audit {
    /// The tree.
    pub tileset: Tileset,
    /// Sizes, volumes, textures.
    pub structure: Structure,
    /// Each tile with triangles.
    pub distances: Vec<TileDistance>,
    /// By level and class.
    pub rows: Vec<Row>,
    /// Borders.
    pub seams: Seams,
    /// Obstacles by level and class.
    pub envelope: Vec<EnvelopeRow>,
    /// Of each tile what was lost.
    pub envelope_tiles: Vec<EnvelopeTile>,
    /// Tiles with openings.
    pub openings: Vec<(usize, Openings)>,
    /// Detail of images by level.
    pub textures: Vec<textures::LevelDetail>,
    /// Tiles whose images have less detail than others of their level.
    pub blurred: Vec<textures::Blurred>,
    /// From over the middle.
    pub stations: Vec<Station>,
    /// Along the route, by stated and by measured errors.
    pub route: Option<[RouteLoad; 2]>,
    /// How the original lies to the tileset.
    pub placed: Option<Placed>,
    /// Names of classes by id, as in the figures.
    pub classes: Vec<String>,
    /// All that is wrong, the worst first within a code.
    pub faults: Vec<Fault>,
    /// What was odd, counted.
    pub warnings: Vec<Warning>,
    /// What was looked at.
    pub config: AuditConfig,
}

/// Judges the tileset that `named` means.
///
/// # Errors
/// Those of [`read::open`], of the original's readers and of the route's; a wish to stop.
pub fn audit(named: &Path, config: &AuditConfig, reporter: &Reporter) -> Result<Audit> {
    let stage = reporter.stage("read", 0);
    let mut tileset = read::open(named)?;
    tileset.most_content_bytes = config.budget.content_bytes();
    stage.finish(format!("{} tiles in {} tilesets", tileset.tiles.len(), tileset.files.len()));
    let stage = reporter.stage("structure", 0);
    let limits = StructureConfig { budget: config.budget, ..config.structure.clone() };
    let structure = structure::measure(&tileset, &limits, reporter)?;
    let triangles: u64 = structure.levels.iter().map(|l| l.sum.triangles).sum();
    stage.finish(format!("{triangles} triangles in {} levels", structure.levels.len()));

    let mut loader = Loader::new(&tileset, config.budget);
    let finest = Cover::of(&tileset).finest(&tileset, 0);
    let finest_box = finest.iter().fold(Aabb::EMPTY, |aabb, &tile| aabb.union(loader.load(tile).aabb));
    let read = |o: &OriginalConfig| Original::read(o, &tileset, finest_box, config.budget, reporter);
    let original = config.original.as_ref().map(read).transpose()?;
    let mut watcher = Watcher::new(tileset.tiles.len(), config.obstacle_safe_m);
    let distances =
        distance::measure(&mut loader, &structure.tiles, original.as_ref(), &config.distance, reporter, &mut watcher)?;
    let Watcher { borders, openings, envelope_tiles, sinkings, .. } = watcher;
    let textures = textures::measure(&tileset, &structure.tiles, config.budget, reporter)?;
    let stage = reporter.stage("seams", 0);
    let seams = seams::measure(&tileset, &borders, &config.seams);
    stage.finish(format!("{} cracks within levels", seams.cracks.len()));

    let middle = over_middle(&mut loader, &finest, finest_box);
    let measured = view::measured(&tileset, &distances, |d| d.hausdorff.map(|h| h.upper_m));
    let p95 = view::measured(&tileset, &distances, view::p95);
    let stated = view::stated(&tileset);
    let load =
        |error: &[f64], height_m: f64| view::load(&tileset, &structure.tiles, error, middle + DVec3::Z * height_m);
    let stations = view::HEIGHTS_M.map(|height_m| Station {
        height_m,
        eye_local_m: (middle + DVec3::Z * height_m).to_array(),
        stated: load(&stated, height_m),
        measured: load(&measured, height_m),
        p95: load(&p95, height_m),
    });
    let route = config.route.as_ref().map(|path| view::read_route(path, &tileset)).transpose()?;
    let fly = |error: &[f64], route: &[DVec3]| view::fly(&tileset, &structure.tiles, error, route);
    let route = route.map(|route| [fly(&stated, &route), fly(&measured, &route)]);

    let rows = summary::rows(&distances);
    let classes = loader.names.all();
    let mut audit = Audit {
        warnings: Vec::new(),
        structure,
        distances,
        rows,
        seams,
        envelope: envelope::rows(&sinkings, &loader.names),
        envelope_tiles,
        openings,
        blurred: textures.blurred,
        textures: textures.levels,
        stations: stations.to_vec(),
        route,
        placed: original.map(|o| o.placed),
        classes,
        faults: Vec::new(),
        config: config.clone(),
        tileset,
    };
    audit.faults = findings::of(&audit);
    for w in &audit.tileset.warnings {
        reporter.warn_many(w.code, &w.first_path, w.count, w.first.clone());
    }
    audit.warnings = reporter.warnings();
    Ok(audit)
}

/// Keeps of each tile what has to be compared later, and looks at it while it is there.
struct Watcher {
    obstacle_safe_m: Option<f64>,
    borders: Vec<Border>,
    openings: Vec<(usize, Openings)>,
    envelope_tiles: Vec<EnvelopeTile>,
    sinkings: Sinkings,
    look: Option<gaps::Look>,
    tops: Option<Tops>,
}

impl Watcher {
    fn new(tiles: usize, obstacle_safe_m: Option<f64>) -> Self {
        Self {
            obstacle_safe_m,
            borders: vec![Border::default(); tiles],
            openings: Vec::new(),
            envelope_tiles: Vec::new(),
            sinkings: Sinkings::default(),
            look: None,
            tops: None,
        }
    }
}

impl Watch for Watcher {
    fn begin(&mut self, shown: &Shown, reference: Aabb) {
        self.look = Some(gaps::Look::over(shown.aabb.union(reference)));
        self.tops = self.obstacle_safe_m.map(|_| Tops::over(reference));
    }

    fn part(&mut self, part: &Shown) {
        self.look.iter_mut().for_each(|look| look.add(&part.surface));
        self.tops.iter_mut().for_each(|tops| tops.add(&part.surface));
    }

    fn end(&mut self, names: &ClassNames, one: &TileDistance, shown: &Shown) {
        self.borders[one.tile] = Border::of(&shown.surface, shown.aabb);
        let (look, tops) = (self.look.take(), self.tops.take());
        let (Some(interval), Some(look)) = (one.hausdorff, look) else { return };
        // Where tiles are missing the tile stands out and nothing is known of its outline.
        let error_m = if one.is_incomplete { 0.0 } else { interval.upper_m.min(view::p95(one).unwrap_or(0.0) * 3.0) };
        let found = look.openings(&shown.surface, error_m);
        if found != Openings::default() {
            self.openings.push((one.tile, found));
        }
        if let (Some(safe_m), Some(tops)) = (self.obstacle_safe_m, tops) {
            let found = EnvelopeTile::of(one.tile, one.level, shown, tops, names, safe_m, &mut self.sinkings);
            self.envelope_tiles.push(found);
        }
    }
}

/// The surface at the middle of the finest tiles, local frame.
fn over_middle(loader: &mut Loader, finest: &[usize], finest_box: Aabb) -> DVec3 {
    /// Vertices this near to the middle count, metres.
    const NEAR_M: f64 = 10.0;
    let middle = finest_box.center();
    let mut top = None;
    for &tile in finest {
        let shown = loader.load(tile);
        if shown.aabb.plan().contains(middle.truncate(), NEAR_M) {
            let near = |p: &&DVec3| (p.truncate() - middle.truncate()).length() < NEAR_M;
            let own = shown.surface.positions.iter().filter(near).map(|p| p.z).max_by(f64::total_cmp);
            top = top.into_iter().chain(own).max_by(f64::total_cmp);
        }
    }
    middle.with_z(top.unwrap_or(middle.z))
}

/// The worst verdict of the tiles that have children: what the tileset is to be called.
pub fn verdict(distances: &[TileDistance]) -> Verdict {
    let has = |v: Verdict| distances.iter().any(|d| d.verdict == v);
    [Verdict::Understated, Verdict::Overstated, Verdict::Texture, Verdict::Honest]
        .into_iter()
        .find(|&v| has(v))
        .unwrap_or(Verdict::Unmeasured)
}
