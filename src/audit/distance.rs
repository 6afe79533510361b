//! Measures every tile against the finest surface it stands for, and compares with the error it states.
//!
//! In: a [`Tileset`], its figures, optionally the [`Original`] mesh. Out: a [`TileDistance`] for each tile with triangles.
//!
//! # Method
//! 1. without the original: a tile against the union of the finest tiles below it; with it, against the part of the
//!    original in the box of the tile and the finest tiles below it
//! 2. figures and certified interval of [`measure`](crate::measure), in all and per class
//! 3. the stated error against the interval: below its lower end it is understated, more than the slack above its upper
//!    end it is overstated, unless the tile's texels need it
//!
//! # Promises
//! Memory: one tile, a part of its reference ([`finer`](super::finer)), and a few tiles that are kept. Where the finest
//! tiles have more faces than [`DistanceConfig::most_reference_faces`], which would take minutes, the tile is measured
//! against the next finer tiles and their own intervals are added: wider, but still a proof (triangle inequality).
//! A tile is called understated only on the distance of a point that was found; where part of the reference could not be
//! read, only points of the rest count.
//!
//! # Limits
//! A tile is compared with what is within its own cell: at its border the nearest point may lie in a neighbour.

use glam::DVec3;
use serde::Serialize;

use super::cover::{ClassNames, Cover, Loader, Shown};
use super::finer::{Finer, Known, PART_FACES};
use super::read::Tileset;
use super::source::Original;
use super::structure::{SSE_PX, TileFigures};
use crate::Result;
use crate::geo::Aabb;
use crate::ids::ClassId;
use crate::measure::{Comparison, Detail, Interval, MeasureConfig, Piecewise, Surface};
use crate::report::Reporter;

/// How closely to look, and from where on a stated error is wrong.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DistanceConfig {
    /// Wanted width of certified intervals, metres. Default: 0.02, or 2e-4 of the reference's diagonal.
    pub tolerance_m: Option<f64>,
    /// A stated error this many times the certified upper end is overstated. Default: 4.
    pub max_slack: f64,
    /// Stated errors may be this much below the certified lower end: rounding of coordinates, metres. Default: 0.001.
    pub rounding_m: f64,
    /// Faces of a reference. Default: 50 million, minutes for one tile.
    pub most_reference_faces: usize,
    /// Faces of a reference loaded at once. Default: 250 000, about 100 MB.
    pub part_faces: usize,
    /// Faces of a reference without classes that our classifier is asked about. Default: 1.5 million; 0 is never.
    pub most_classified_faces: usize,
    /// Points on either surface, for each face of the reference. Default: 2, but 20 000 to 500 000 in all.
    pub samples_per_face: f64,
}

impl Default for DistanceConfig {
    fn default() -> Self {
        Self {
            tolerance_m: None,
            max_slack: 4.0,
            rounding_m: 1e-3,
            most_reference_faces: 50_000_000,
            part_faces: PART_FACES,
            most_classified_faces: 1_500_000,
            samples_per_face: 2.0,
        }
    }
}

const SAMPLES: [f64; 2] = [20_000.0, 500_000.0];

/// An error of up to this many times what the texels need at [`SSE_PX`] is the texels' doing.
const TEXEL_SLACK: f64 = 1.25;

/// What to think of a stated error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// Not below what was found, and not far above what is possible.
    Honest,
    /// Below what was found: viewers draw the tile where it is visibly, or dangerously, wrong.
    Understated,
    /// Far above what is possible: viewers load finer tiles for nothing.
    Overstated,
    /// Far above the geometry's error, but the texture needs it to be sharp.
    Texture,
    /// Nothing finer to compare with; viewers do not look at its error.
    Finest,
    /// Could not be measured.
    Unmeasured,
}

impl Verdict {
    /// For people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Honest => "honest",
            Self::Understated => "understated",
            Self::Overstated => "overstated",
            Self::Texture => "set by texture",
            Self::Finest => "finest",
            Self::Unmeasured => "unmeasured",
        }
    }
}

/// What a tile was measured against.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Against {
    /// The finest tiles below it.
    FinestTiles,
    /// The next finer tiles, with their own errors added.
    NextTiles,
    /// The original mesh.
    Original,
    /// Nothing.
    Nothing,
}

/// A class's certificate, from the tileset's own metadata, against what was measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Certificate {
    /// The property, such as `roofBound`.
    pub property: String,
    /// What it says, metres.
    pub stated_m: f64,
    /// What was measured.
    pub measured: Interval,
    /// It is not below what was found.
    pub holds: bool,
}

/// The furthest point found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Worst {
    /// In the tileset's local frame, metres east, north, up.
    pub local_m: [f64; 3],
    /// From the other surface, metres.
    pub distance_m: f64,
    /// The point is on the reference: something was lost there; else something was invented.
    pub is_on_reference: bool,
}

/// Area of a tile that has another class than the reference's nearest face.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassSwap {
    /// The reference's class.
    pub reference: String,
    /// The tile's.
    pub tile: String,
    /// Of the tile's area.
    pub area_share: f64,
}

/// One tile, measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TileDistance {
    /// Index of the tile.
    pub tile: usize,
    /// Tiles with content above it.
    pub level: u32,
    /// What to think of its error.
    pub verdict: Verdict,
    /// How many times too small or too large the stated error is; `None` where it is not, or states 0.
    pub factor: Option<f64>,
    /// `geometricError`, scaled as the tile is, metres.
    pub stated_error_m: f64,
    /// Certified bounds of the largest distance, both ways; of an incomplete reference from it only.
    pub hausdorff: Option<Interval>,
    /// What it was measured against.
    pub against: Against,
    /// Faces of that.
    pub reference_triangles: usize,
    /// Its area, m².
    pub reference_area_m2: f64,
    /// Part of the reference could not be read: only what is there is compared.
    pub is_incomplete: bool,
    /// The reference's classes are our classifier's guess.
    pub is_guessed_class: bool,
    /// All figures.
    pub comparison: Option<Comparison>,
    /// Where it is worst.
    pub worst: Option<Worst>,
    /// Classes that changed, the largest area first; empty if the tile has none of its own.
    pub class_swaps: Vec<ClassSwap>,
    /// The file's own certificates.
    pub certificates: Vec<Certificate>,
    /// The error that the texels ask for, so that none covers more than a pixel at the switching distance, metres.
    pub texture_error_m: Option<f64>,
    /// Why it was not measured.
    pub why: Option<String>,
}

/// Looks on while tiles are measured: whatever is loaded is loaded once.
pub trait Watch {
    /// A tile is about to be compared with a reference around which lies the box.
    fn begin(&mut self, shown: &Shown, reference: Aabb);
    /// A part of its reference.
    fn part(&mut self, part: &Shown);
    /// It was measured; those without a reference never began.
    fn end(&mut self, names: &ClassNames, one: &TileDistance, shown: &Shown);
}

/// Measures all tiles; those below come before those above.
///
/// # Errors
/// [`crate::Error::Cancelled`].
pub fn measure(
    loader: &mut Loader,
    figures: &[TileFigures],
    original: Option<&Original>,
    config: &DistanceConfig,
    reporter: &Reporter,
    watch: &mut dyn Watch,
) -> Result<Vec<TileDistance>> {
    let tileset = loader.tileset;
    let cover = Cover::of(tileset);
    let mut found: Vec<TileDistance> = Vec::new();
    let order = bottom_up(tileset);
    let stage = reporter.stage("distance", order.len() as u64);
    let mut upper_m = vec![None; tileset.tiles.len()];
    let mut around = vec![Aabb::EMPTY; tileset.tiles.len()];
    let mut known = vec![Known::NOTHING; tileset.tiles.len()];
    for tile in order {
        reporter.check()?;
        let mut at = Some(tile);
        known[tile] = Known::of(&loader.load(tile));
        while let Some(id) = at.filter(|_| original.is_some()) {
            around[id] = around[id].union(known[tile].aabb);
            at = tileset.tiles[id].parent;
        }
        let job = Job {
            cover: &cover,
            figures,
            known: &known,
            original,
            config,
            upper_m: &upper_m,
            around: around[tile],
            reporter,
        };
        let mut one = job.measure(loader, tile, watch)?;
        judge(tileset, &mut one, figures.get(tile), config);
        upper_m[tile] = match one.verdict {
            Verdict::Finest => Some(0.0),
            _ => one.hausdorff.filter(|_| !one.is_incomplete).map(|h| h.upper_m),
        };
        let shown = loader.load(tile);
        watch.end(&loader.names, &one, &shown);
        found.push(one);
        stage.step(1);
    }
    let measured = found.iter().filter(|t| t.hausdorff.is_some()).count();
    stage.finish(format!("{measured} of {} tiles measured", found.len()));
    found.sort_by_key(|one| one.tile);
    Ok(found)
}

/// Tiles with a mesh, children before parents and near ones together, so that what was loaded is still there.
fn bottom_up(tileset: &Tileset) -> Vec<usize> {
    let mut order = Vec::new();
    let mut open = vec![(0, false)];
    while let Some((id, is_done)) = open.pop() {
        if is_done {
            order.extend(tileset.tiles[id].has_mesh().then_some(id));
        } else {
            open.push((id, true));
            open.extend(tileset.tiles[id].children.iter().rev().map(|&child| (child, false)));
        }
    }
    order
}

struct Job<'a> {
    cover: &'a Cover,
    figures: &'a [TileFigures],
    known: &'a [Known],
    original: Option<&'a Original>,
    config: &'a DistanceConfig,
    /// Of tiles measured so far the certified upper end, metres.
    upper_m: &'a [Option<f64>],
    /// Around the tile and all below.
    around: Aabb,
    reporter: &'a Reporter,
}

impl Job<'_> {
    fn measure(&self, loader: &mut Loader, tile: usize, watch: &mut dyn Watch) -> Result<TileDistance> {
        let tileset = loader.tileset;
        let of = &tileset.tiles[tile];
        let mut one = TileDistance {
            tile,
            level: tileset.level(tile),
            verdict: Verdict::Unmeasured,
            factor: None,
            stated_error_m: of.geometric_error_m,
            hausdorff: None,
            against: Against::Nothing,
            reference_triangles: 0,
            reference_area_m2: 0.0,
            is_incomplete: false,
            is_guessed_class: false,
            comparison: None,
            worst: None,
            class_swaps: Vec::new(),
            certificates: Vec::new(),
            texture_error_m: self.figures.get(tile).and_then(TileFigures::metres_per_texel).map(|m| SSE_PX * m),
            why: None,
        };
        let shown = loader.load(tile);
        if shown.surface.faces.is_empty() {
            let why = shown.refused.map_or("it has no triangles".into(), |code| format!("it cannot be read: {code}"));
            one.why = Some(why);
            return Ok(one);
        }
        let Some((finer, added_m)) = self.reference(loader, tile, &mut one) else { return Ok(one) };
        one.is_incomplete = finer.all().is_refused;
        one.reference_triangles = finer.all().faces;
        if finer.all().faces == 0 {
            one.why = Some("nothing of what it stands for can be read".into());
            return Ok(one);
        }
        let most = loader.budget.measured_faces();
        let needed = shown.surface.faces.len() + finer.largest();
        if needed > most {
            one.why = Some(format!("{needed} faces at once are more than the {most} that fit into --memory"));
            return Ok(one);
        }
        watch.begin(&shown, finer.all().aabb);
        let finer = finer.within(most.saturating_sub(shown.surface.faces.len()));
        self.compare(loader, &shown, &finer, added_m, &mut one, watch)?;
        Ok(one)
    }

    /// What the tile is compared with, and what that itself may be wrong by. `None` for the finest tiles.
    fn reference(&self, loader: &Loader, tile: usize, one: &mut TileDistance) -> Option<(Finer<'_>, f64)> {
        let part_faces = self.config.part_faces;
        let tileset = loader.tileset;
        let finest = self.cover.finest(tileset, tile);
        let faces = |tiles: &[usize]| {
            tiles.iter().map(|&t| self.figures.get(t).map_or(0, |f| f.triangles as usize)).sum::<usize>()
        };
        let fits = |tiles: &[usize]| faces(tiles) <= self.config.most_reference_faces;
        if let Some(original) = self.original {
            one.against = Against::Original;
            return Some((Finer::original(original, self.around, part_faces), 0.0));
        }
        if !self.cover.has_finer(tile) {
            one.verdict = Verdict::Finest;
            return None;
        }
        if fits(&finest) {
            one.against = Against::FinestTiles;
            return Some((Finer::tiles(&finest, self.known, part_faces), 0.0));
        }
        let next = self.cover.next(tileset, tile);
        let below: Option<Vec<f64>> = next.iter().map(|&t| self.upper_m.get(t).copied().flatten()).collect();
        match below {
            Some(below) if fits(&next) && !self.cover.has_add(tileset, tile) => {
                one.against = Against::NextTiles;
                Some((Finer::tiles(&next, self.known, part_faces), below.into_iter().fold(0.0, f64::max)))
            }
            _ => {
                let most = self.config.most_reference_faces;
                one.why = Some(format!("{} faces below it are more than the {most} that are compared", faces(&finest)));
                None
            }
        }
    }

    fn compare(
        &self,
        loader: &mut Loader,
        shown: &Shown,
        finer: &Finer<'_>,
        added_m: f64,
        one: &mut TileDistance,
        watch: &mut dyn Watch,
    ) -> Result<()> {
        let config = self.config;
        let samples = (config.samples_per_face * finer.all().faces as f64).clamp(SAMPLES[0], SAMPLES[1]);
        let measure =
            MeasureConfig { samples: samples as usize, tolerance_m: config.tolerance_m, ..MeasureConfig::default() };
        let mut pieces = Piecewise::new(&shown.surface, finer.whole(), &finer.boxes(), &measure);
        for part in 0..finer.parts() {
            self.reporter.check()?;
            let (reference, is_guessed) = finer.load(loader, part, config.most_classified_faces);
            one.is_guessed_class |= is_guessed;
            watch.part(&reference);
            let own = &reference.surface;
            pieces.add(own, &mut |within| finer.around(loader, part, own, within));
            if finer.is_too_large() {
                let most = loader.budget.measured_faces();
                one.why = Some(format!(
                    "a part of what it stands for has more than {most} faces about it, and no more fit into --memory"
                ));
                return Ok(());
            }
        }
        self.original.map_or(Ok(()), Original::check)?;
        one.reference_area_m2 = pieces.area_m2();
        let (comparison, detail) = pieces.finish();
        let hausdorff = comparison.all.hausdorff;
        // Where tiles are missing, what stands where they were is not wrong.
        let whole = if one.is_incomplete { hausdorff.reference_to_simplified } else { hausdorff.two_sided };
        one.hausdorff =
            whole.map(|h| Interval { lower_m: (h.lower_m - added_m).max(0.0), upper_m: h.upper_m + added_m });
        one.worst = worst(&detail, one.is_incomplete);
        one.class_swaps = swaps(&shown.surface, &detail.nearest_class, &loader.names);
        one.certificates = certificates(loader, one, &comparison, added_m);
        one.comparison = Some(comparison);
        Ok(())
    }
}

/// What `geometryError` and `<class>Bound` in the tile's metadata promise. A class is that of the reference: which class a
/// point of the tile belongs to is a matter of taste, and nobody is accused over that.
fn certificates(loader: &Loader, one: &TileDistance, comparison: &Comparison, added_m: f64) -> Vec<Certificate> {
    let metadata = loader.tileset.tiles[one.tile].metadata.as_ref();
    let properties = metadata.and_then(|m| m.get("properties")).and_then(|p| p.as_object());
    let mut found = Vec::new();
    for (property, value) in properties.into_iter().flatten() {
        let Some(stated_m) = value.as_f64() else { continue };
        let measured = if property == "geometryError" {
            one.hausdorff
        } else {
            let class = loader.names.of_property(property, "Bound");
            let of_class = class.and_then(|class| comparison.by_class.iter().find(|c| c.class == class));
            let interval = of_class.and_then(|c| c.figures.hausdorff.reference_to_simplified);
            interval.map(|i| Interval { lower_m: (i.lower_m - added_m).max(0.0), upper_m: i.upper_m + added_m })
        };
        let Some(measured) = measured.filter(|_| !one.is_incomplete) else { continue };
        let holds = stated_m + 1e-3 >= measured.lower_m;
        found.push(Certificate { property: property.clone(), stated_m, measured, holds });
    }
    found
}

/// Sets the verdict and the factor.
fn judge(tileset: &Tileset, one: &mut TileDistance, figures: Option<&TileFigures>, config: &DistanceConfig) {
    let Some(interval) = one.hausdorff else { return };
    let stated_m = one.stated_error_m;
    let is_finest = tileset.tiles[one.tile].children.is_empty();
    // Viewers do not look at the error of a tile without children; 0 says that it is as good as it gets.
    if is_finest && stated_m == 0.0 {
        one.verdict = Verdict::Finest;
        return;
    }
    if stated_m + config.rounding_m < interval.lower_m {
        one.verdict = Verdict::Understated;
        one.factor = (stated_m > 0.0).then(|| interval.lower_m / stated_m);
        return;
    }
    // Surfaces that are equal have an interval as wide as the tolerance: nothing is as slow as to be told of.
    let upper_m = interval.upper_m.max(config.rounding_m);
    let factor = stated_m / upper_m;
    if factor <= config.max_slack || one.is_incomplete {
        one.verdict = Verdict::Honest;
        return;
    }
    one.factor = Some(factor);
    let texel = figures.and_then(TileFigures::metres_per_texel).map(|m| TEXEL_SLACK * SSE_PX * m);
    let geometry =
        tileset.tiles[one.tile].metadata.as_ref().and_then(|m| m.get("properties")?.get("geometryError")?.as_f64());
    let geometry_is_honest = geometry.is_some_and(|g| g < stated_m && g / upper_m <= config.max_slack);
    let is_texture = texel.is_some_and(|texel| stated_m <= texel || geometry_is_honest);
    one.verdict = if is_texture { Verdict::Texture } else { Verdict::Overstated };
}

/// The worst vertex.
fn worst(detail: &Detail, is_incomplete: bool) -> Option<Worst> {
    let of = |found: Option<(DVec3, f64)>, is_on_reference| {
        found.map(|(p, distance_m)| Worst { local_m: p.to_array(), distance_m, is_on_reference })
    };
    // Where tiles are missing, the tile itself is far from what is left.
    let on_tile = of(detail.worst_of_simplified, false).filter(|_| !is_incomplete);
    let both = [of(detail.worst_of_reference, true), on_tile];
    both.into_iter().flatten().max_by(|a, b| a.distance_m.total_cmp(&b.distance_m))
}

/// Classes of faces against those of the reference nearest to them.
fn swaps(tile: &Surface, nearest: &[ClassId], names: &ClassNames) -> Vec<ClassSwap> {
    let Some(own) = tile.class.as_ref().filter(|own| own.len() == nearest.len()) else { return Vec::new() };
    let mut area = std::collections::BTreeMap::<(ClassId, ClassId), f64>::new();
    let mut whole = 0.0;
    for ((face, class), wanted) in tile.faces.iter().zip(own).zip(nearest) {
        let [a, b, c] = face.map(|v| tile.positions[v as usize]);
        let m2 = (b - a).cross(c - a).length() / 2.0;
        whole += m2;
        if wanted != class {
            *area.entry((*wanted, *class)).or_default() += m2;
        }
    }
    let mut found: Vec<ClassSwap> = area
        .into_iter()
        .map(|((wanted, class), m2)| ClassSwap {
            reference: names.name(wanted).into(),
            tile: names.name(class).into(),
            area_share: if whole > 0.0 { m2 / whole } else { 0.0 },
        })
        .collect();
    found.sort_by(|a, b| b.area_share.total_cmp(&a.area_share));
    found
}
