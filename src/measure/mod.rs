//! Judges how far one surface is from another: the numbers that every promise about accuracy is held against.
//!
//! In: a reference [`Surface`], with a class per face or without, and simplified ones. Out: a [`Comparison`] each.
//! Knows nothing of what made the surfaces and shares no error code with the builder: it judges it.
//!
//! # Method
//! 1. `surface`: join equal vertices, move to the reference's centre, build a tree.
//! 2. `sample`, `distance`: stratified points on either surface, by area, each to the nearest point of the other; the
//!    same from every vertex. Mean, RMS, percentiles; `two_sided` gives both directions half the weight each.
//! 3. `certify`: an interval that provably holds the largest distance over all points, per direction and class.
//! 4. `signed`: on which side; `quality`: what is wrong with each mesh in itself.
//!
//! A distance counts for the class of the reference at either end: that of the point's face, or, measured from the
//! simplified surface, that of the face nearest to the point. Simplified vertices and faces likewise.
//!
//! # Numbers
//! see [`MeasureConfig`]; `_m` is the unit of the coordinates, metres by convention; `_rel` is by the diagonal of the
//! reference's box.
//!
//! # Promises
//! Same input, same numbers for any number of threads (`the_number_of_threads_changes_nothing`); the interval holds
//! every sampled distance (`the_interval_holds_what_brute_force_finds`); no panic on empty or degenerate surfaces.
//!
//! # Limits
//! Sides need outward faces; see `signed`. Percentiles are of samples, so parts below a sample's share of the area may
//! be missed by all figures but the interval.
//!
//! # Cost
//! Measured on a scan of 295 k faces against 10 % of them, one thread, optimised build: 2.9 µs of processor time a
//! reference face for all but the samples (welding, edges, both trees, all vertices both ways 2.3; certified interval
//! of 2 cm both ways and three classes 0.6), 0.8 µs a sample. At 2 mm the interval cost the same. 126 MB in all.
//!
//! # References
//! The paper's Eq. 17 and 18 are reported and nothing more: they are measured at simplified vertices only, so that a
//! simplifier that keeps a subset of them scores 0 whatever it lost, and Eq. 18 as printed is the root of a mean
//! distance, in m^½, not a root mean square.

use serde::Serialize;

mod certify;
mod distance;
mod parts;
mod quality;
mod sample;
mod signed;
mod surface;
#[cfg(test)]
mod tests;

pub use certify::Interval;
pub use distance::Summary;
pub use parts::{Piecewise, Whole};
pub use quality::Quality;
pub use signed::SignedBounds;
pub use surface::Surface;

use self::certify::{Classes, Search};
use self::distance::{Labels, Pass, Series};
use self::quality::Edges;
use self::sample::Sampler;
use self::signed::{Normals, Sides};
use self::surface::{Near, Prepared};
use crate::ids::ClassId;

/// How closely to look.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasureConfig {
    /// Points on either surface. Default: 1 million.
    pub samples: usize,
    /// Of the points' places. Default: 1.
    pub seed: u64,
    /// Wanted width of certified intervals, metres, > 0. Default: none, meaning 2 cm, or 2e-4 of the reference's
    /// diagonal where that is less.
    pub tolerance_m: Option<f64>,
    /// Pieces that 256 faces may be cut into before their interval is left wider. Default: 2 million.
    pub most_pieces: usize,
}

impl Default for MeasureConfig {
    fn default() -> Self {
        Self { samples: 1_000_000, seed: 1, tolerance_m: None, most_pieces: 2_000_000 }
    }
}

/// Default width of certified intervals, metres.
const TOLERANCE_M: f64 = 0.02;
/// And by the reference's diagonal, for small things and other units.
const TOLERANCE_REL: f64 = 2e-4;

/// One simplified surface, measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// The simplified mesh in itself.
    pub quality: Quality,
    /// Simplified faces by the reference's, as given.
    pub face_share: f64,
    /// All classes together.
    pub all: Figures,
    /// Each class that the reference has, in order; empty if it has none.
    pub by_class: Vec<ClassFigures>,
    /// Angle between the reference's faces and the simplified ones nearest to their samples.
    pub normals: Option<NormalFigures>,
}

/// The figures of a class.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassFigures {
    /// The class.
    pub class: ClassId,
    /// Its figures.
    #[serde(flatten)]
    pub figures: Figures,
}

/// How far two surfaces, or what is of one class, are apart. `None` where there is nothing to measure.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Figures {
    /// Faces of the reference.
    pub reference_faces: usize,
    /// Their area by the reference's.
    pub reference_area_share: f64,
    /// Simplified faces; each is of the class that its middle is nearest to.
    pub simplified_faces: usize,
    /// From samples on the reference: sees what was lost.
    pub reference_to_simplified: Option<Summary>,
    /// From samples on the simplified surface: sees what was invented.
    pub simplified_to_reference: Option<Summary>,
    /// Both, half the weight each; the one alone where the other has nothing, as with a class that was lost.
    pub two_sided: Option<Summary>,
    /// From every vertex of the reference: small parts count here, as vertices crowd where there is detail.
    pub reference_vertices_to_simplified: Option<Summary>,
    /// Certified bounds of the largest distance.
    pub hausdorff: Hausdorff,
    /// How far on either side.
    pub signed: Option<SignedBounds>,
    /// The paper's own figures.
    pub paper: Option<PaperFigures>,
}

/// Certified largest distances.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Hausdorff {
    /// Over all points of the reference.
    pub reference_to_simplified: Option<Interval>,
    /// Over all points of the simplified surface.
    pub simplified_to_reference: Option<Interval>,
    /// The larger of the two.
    pub two_sided: Option<Interval>,
    /// The same by the reference's diagonal: lower, upper.
    pub two_sided_rel: Option<[f64; 2]>,
}

/// The paper's figures, over the simplified vertices.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PaperFigures {
    /// N.
    pub vertices: usize,
    /// Eq. 17: the mean distance.
    pub eq17_mean_m: f64,
    /// The same by the reference's diagonal.
    pub eq17_mean_rel: f64,
    /// Eq. 18 as printed: the root of the mean distance, m^½.
    pub eq18_as_printed_sqrt_m: f64,
    /// What Eq. 18 is called: the root of the mean square distance.
    pub true_rms_m: f64,
}

/// Angles between normals.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct NormalFigures {
    /// Mean.
    pub mean_deg: f64,
    /// Root of the mean square.
    pub rms_deg: f64,
    /// 95 % are below.
    pub p95_deg: f64,
    /// Share of the area that turned by more than 30°.
    pub share_above_30: f64,
    /// Share of the area that turned by more than 90°: folded or flipped.
    pub share_above_90: f64,
}

/// Measures `simplified` against `reference`.
pub fn compare(reference: &Surface, simplified: &Surface, config: &MeasureConfig) -> Comparison {
    Reference::new(reference).compare(simplified, config)
}

/// What a comparison shows beside its figures.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Detail {
    /// The vertex of the reference that is furthest from the simplified surface, and how far, metres.
    pub worst_of_reference: Option<(glam::DVec3, f64)>,
    /// The same the other way.
    pub worst_of_simplified: Option<(glam::DVec3, f64)>,
    /// For each simplified face the class of the reference nearest to its middle; empty if the reference has none, or
    /// if a simplified face could not be used.
    pub nearest_class: Vec<ClassId>,
}

/// What there is of a reference, by class.
#[derive(Debug, Clone, Default)]
struct Tally {
    faces_in_file: usize,
    faces: [usize; Surface::MOST_CLASSES],
    area_m2: [f64; Surface::MOST_CLASSES],
    diagonal_m: f64,
    /// Empty if it has no classes.
    classes: Vec<ClassId>,
}

impl Tally {
    fn add(&mut self, surface: &Prepared) {
        self.faces_in_file += surface.faces.len() + surface.left_out;
        for f in 0..surface.faces.len() as u32 {
            let class = usize::from(surface.class_of(f));
            self.faces[class] += 1;
            self.area_m2[class] += surface.area(f);
        }
        if !surface.class.is_empty() {
            let present = (0..Surface::MOST_CLASSES).filter(|&k| self.faces[k] > 0);
            self.classes = present.map(|k| ClassId(k as u8)).collect();
        }
    }
}

/// A reference with all that is worth making once for many simplified surfaces.
pub struct Reference {
    surface: Prepared,
    center: glam::DVec3,
    edges: Edges,
    tally: Tally,
    /// Node masks if there are classes.
    masks: Option<Vec<u32>>,
    /// Per point. On the border of classes a vertex counts for one of them.
    vertex_class: Vec<u8>,
}

impl Reference {
    /// Prepares a reference.
    pub fn new(surface: &Surface) -> Self {
        let used = surface.faces.iter().flatten().filter_map(|&v| surface.positions.get(v as usize));
        let aabb = crate::geo::Aabb::of(used.copied().filter(|p| p.is_finite()));
        let prepared = Prepared::new(surface, aabb.center());
        let mut tally = Tally { diagonal_m: aabb.size().length(), ..Tally::default() };
        tally.add(&prepared);
        Self::of(prepared, aabb.center(), tally)
    }

    fn of(prepared: Prepared, center: glam::DVec3, tally: Tally) -> Self {
        let edges = Edges::of(&prepared);
        let masks = (!prepared.class.is_empty()).then(|| prepared.class_masks());
        let mut vertex_class = vec![0; prepared.points.len()];
        for k in 0..3 {
            for (f, face) in prepared.faces.iter().enumerate() {
                vertex_class[face[k] as usize] = prepared.class_of(f as u32);
            }
        }
        Self { center, edges, tally, masks, vertex_class, surface: prepared }
    }

    /// The reference in itself.
    pub fn quality(&self) -> &Quality {
        &self.edges.quality
    }

    /// Diagonal of the box around all its faces, metres.
    pub fn diagonal_m(&self) -> f64 {
        self.tally.diagonal_m
    }

    /// Width that certified intervals are to have, metres.
    pub fn tolerance_m(&self, config: &MeasureConfig) -> f64 {
        tolerance_m(config, self.diagonal_m())
    }

    /// Certified bounds of the largest distance alone, all classes together: reference to simplified and back.
    ///
    /// What [`Reference::compare`] reports as `hausdorff`, without samples to begin from. `None` if either is empty.
    pub fn certify(&self, simplified: &Surface, config: &MeasureConfig) -> Option<[Interval; 2]> {
        let simplified = Prepared::new(simplified, self.center);
        let near = Nearest::of(&self.surface, &simplified)?;
        let whole = |all: Vec<Option<Interval>>| all.into_iter().flatten().reduce(Interval::max);
        let seen = [None; Surface::MOST_CLASSES];
        let there = self.search(&self.surface, &simplified, &near.of_reference, seen, config);
        let back = self.search(&simplified, &self.surface, &near.of_simplified, seen, config);
        Some([whole(there.run())?, whole(back.run())?])
    }

    fn search<'a>(
        &self,
        from: &'a Prepared,
        to: &'a Prepared,
        near: &'a [Near],
        seen: [Option<f64>; Surface::MOST_CLASSES],
        config: &MeasureConfig,
    ) -> Search<'a> {
        let tolerance_m = self.tolerance_m(config);
        Search { from, to, near, classes: Classes::One, seen, tolerance_m, most_pieces: config.most_pieces }
    }

    /// Measures one simplified surface.
    pub fn compare(&self, simplified: &Surface, config: &MeasureConfig) -> Comparison {
        self.compare_in_detail(simplified, config).0
    }

    /// Measures one simplified surface, and says where it is worst.
    pub fn compare_in_detail(&self, simplified: &Surface, config: &MeasureConfig) -> (Comparison, Detail) {
        // Whatever classes it has, the reference's decide.
        let simplified = &Prepared::new(simplified, self.center);
        let edges = Edges::of(simplified);
        let measured = Measured::of(self, simplified, &edges, config);
        let detail = measured.as_ref().map(|m| m.detail(self.center, &self.tally, simplified)).unwrap_or_default();
        (comparison(&self.tally, measured.as_ref(), edges.quality), detail)
    }
}

fn tolerance_m(config: &MeasureConfig, diagonal_m: f64) -> f64 {
    config.tolerance_m.unwrap_or(TOLERANCE_M.min(TOLERANCE_REL * diagonal_m))
}

fn comparison(tally: &Tally, measured: Option<&Measured>, quality: Quality) -> Comparison {
    let figures =
        |class: Option<ClassId>| figures(tally, quality.faces_in_file - quality.faces_left_out, measured, class);
    let classed = |&class: &ClassId| ClassFigures { class, figures: figures(Some(class)) };
    Comparison {
        face_share: quality.faces_in_file as f64 / tally.faces_in_file.max(1) as f64,
        all: figures(None),
        by_class: tally.classes.iter().map(classed).collect(),
        normals: measured.and_then(|m| normal_figures(&m.there.turn_deg)),
        quality,
    }
}

fn figures(tally: &Tally, simplified_faces: usize, measured: Option<&Measured>, class: Option<ClassId>) -> Figures {
    let is_of = |k: usize| class.is_none_or(|c| c.index() == k);
    let kept = || (0..Surface::MOST_CLASSES).filter(|&k| is_of(k));
    let whole_m2 = tally.area_m2.iter().sum::<f64>();
    let area_m2 = kept().map(|k| tally.area_m2[k]).sum::<f64>();
    let mut figures = Figures {
        reference_faces: kept().map(|k| tally.faces[k]).sum(),
        reference_area_share: if whole_m2 > 0.0 { area_m2 / whole_m2 } else { 0.0 },
        simplified_faces,
        reference_to_simplified: None,
        simplified_to_reference: None,
        two_sided: None,
        reference_vertices_to_simplified: None,
        hausdorff: Hausdorff {
            reference_to_simplified: None,
            simplified_to_reference: None,
            two_sided: None,
            two_sided_rel: None,
        },
        signed: None,
        paper: None,
    };
    let Some(measured) = measured else { return figures };
    let (key, diagonal) = (class.map(|c| c.0), tally.diagonal_m);
    figures.simplified_faces = measured.face_class.iter().filter(|k| is_of(usize::from(**k))).count();
    let (there, back) = (measured.there.series.sorted(key), measured.back.series.sorted(key));
    figures.reference_to_simplified = distance::summary(&there, diagonal);
    figures.simplified_to_reference = distance::summary(&back, diagonal);
    let alone = || figures.reference_to_simplified.clone().or_else(|| figures.simplified_to_reference.clone());
    figures.two_sided = distance::two_sided(&there, &back, diagonal).or_else(alone);
    figures.reference_vertices_to_simplified = distance::summary(&measured.reference_vertices.sorted(key), diagonal);
    figures.hausdorff = measured.hausdorff(key, diagonal);
    figures.signed = measured.signed(key, figures.hausdorff.two_sided);
    figures.paper = paper(&measured.simplified_vertices.sorted(key), diagonal);
    figures
}

/// Nearest points of all vertices, both ways.
struct Nearest {
    of_reference: Vec<Near>,
    of_simplified: Vec<Near>,
}

impl Nearest {
    fn of(reference: &Prepared, simplified: &Prepared) -> Option<Self> {
        if reference.faces.is_empty() || simplified.faces.is_empty() {
            return None;
        }
        let of_reference = simplified.nearest_of(&reference.points);
        Some(Self { of_reference, of_simplified: reference.nearest_of(&simplified.points) })
    }
}

/// All distances of one comparison, with the classes they count for.
#[derive(Default)]
struct Measured {
    there: Pass,
    back: Pass,
    reference_vertices: Series,
    simplified_vertices: Series,
    sides: SidesBothWays,
    intervals: [Vec<Option<Interval>>; 2],
    face_class: Vec<u8>,
    /// Of the reference and of the simplified surface, about the centre.
    furthest: [Option<(glam::DVec3, f64)>; 2],
}

/// Per class how far the simplified surface sinks in and stands out, seen from either.
#[derive(Default)]
struct SidesBothWays {
    inside: Vec<f64>,
    outside: Vec<f64>,
}

impl Measured {
    /// `None` if either surface is empty.
    fn of(reference: &Reference, simplified: &Prepared, edges: &Edges, config: &MeasureConfig) -> Option<Self> {
        let surface = &reference.surface;
        let near = Nearest::of(surface, simplified)?;
        let (normals, other_normals) =
            (Normals::of(surface, &reference.edges.neighbours), Normals::of(simplified, &edges.neighbours));

        let sampler = Sampler::new(surface, config.samples, config.seed);
        let there = distance::measure(surface, &sampler, simplified, &other_normals, Labels::AtPoint);
        let sampler = Sampler::new(simplified, config.samples, config.seed.wrapping_add(1));
        let back = distance::measure(simplified, &sampler, surface, &normals, Labels::AtNearest);

        let reference_vertices = distance::vertex_series(&near.of_reference, |v| reference.vertex_class[v]);
        let simplified_vertices =
            distance::vertex_series(&near.of_simplified, |v| surface.class_of(near.of_simplified[v].face));
        let sides = SidesBothWays::of(
            (&there.sides, see_vertices(surface, &near.of_reference, &reference_vertices, simplified, &other_normals)),
            (&back.sides, see_vertices(simplified, &near.of_simplified, &simplified_vertices, surface, &normals)),
        );

        let search = |from, to, near, seen: &Series| {
            let floor = seen.largest([None; Surface::MOST_CLASSES]);
            reference.search(from, to, near, floor, config)
        };
        let forward = search(surface, simplified, &near.of_reference, &there.series);
        let backward = search(simplified, surface, &near.of_simplified, &back.series);
        let [forward, backward] = match &reference.masks {
            Some(masks) => [
                Search { classes: Classes::OfFrom, ..forward }.run(),
                Search { classes: Classes::OfTo(masks), ..backward }.run(),
            ],
            None => [forward.run(), backward.run()],
        };

        let face_class = surface.nearest_classes(&simplified.middles());
        let intervals = [forward, backward];
        let furthest = [furthest(surface, &near.of_reference), furthest(simplified, &near.of_simplified)];
        Some(Self { there, back, reference_vertices, simplified_vertices, sides, intervals, face_class, furthest })
    }

    fn detail(&self, center: glam::DVec3, tally: &Tally, simplified: &Prepared) -> Detail {
        let [worst_of_reference, worst_of_simplified] = self.furthest.map(|f| f.map(|(p, d)| (p + center, d)));
        let is_told = !tally.classes.is_empty() && simplified.left_out == 0;
        let nearest_class = if is_told { self.face_class.iter().map(|&k| ClassId(k)).collect() } else { Vec::new() };
        Detail { worst_of_reference, worst_of_simplified, nearest_class }
    }

    fn hausdorff(&self, class: Option<u8>, diagonal_m: f64) -> Hausdorff {
        let of = |intervals: &[Option<Interval>]| match class {
            Some(k) => intervals.get(usize::from(k)).copied().flatten(),
            None => intervals.iter().flatten().copied().reduce(Interval::max),
        };
        let [there, back] = [of(&self.intervals[0]), of(&self.intervals[1])];
        let two_sided = [there, back].into_iter().flatten().reduce(Interval::max);
        Hausdorff {
            reference_to_simplified: there,
            simplified_to_reference: back,
            two_sided,
            two_sided_rel: two_sided.map(|i| [i.lower_m, i.upper_m].map(|d| distance::relative(d, diagonal_m))),
        }
    }

    fn signed(&self, class: Option<u8>, certified: Option<Interval>) -> Option<SignedBounds> {
        let largest = |of: &[f64]| match class {
            Some(k) => of.get(usize::from(k)).copied().unwrap_or(0.0),
            None => of.iter().copied().fold(0.0, f64::max),
        };
        Some(SignedBounds {
            inside_seen_m: largest(&self.sides.inside),
            outside_seen_m: largest(&self.sides.outside),
            either_upper_m: certified?.upper_m,
        })
    }
}

impl SidesBothWays {
    /// In front of the simplified surface, the reference stands out: there the simplified one is inside.
    fn of(there: (&Sides, Sides), back: (&Sides, Sides)) -> Self {
        let merged = |(samples, mut vertices): (&Sides, Sides)| {
            vertices.merge(samples);
            vertices
        };
        let (there, back) = (merged(there), merged(back));
        let larger = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a.max(*b)).collect();
        Self { inside: larger(&there.outside, &back.inside), outside: larger(&there.inside, &back.outside) }
    }
}

/// The point that is furthest, the first of equals.
fn furthest(from: &Prepared, near: &[Near]) -> Option<(glam::DVec3, f64)> {
    let larger = |a: usize, b: usize| if near[b].distance > near[a].distance { b } else { a };
    (0..near.len()).reduce(larger).map(|v| (from.points[v], near[v].distance))
}

fn see_vertices(from: &Prepared, near: &[Near], series: &Series, to: &Prepared, normals: &Normals) -> Sides {
    let mut sides = Sides::default();
    for (v, near) in near.iter().enumerate() {
        if let Some(hit) = to.hit(from.points[v], near.face) {
            sides.see(series.class[v], from.points[v], &hit, to, normals);
        }
    }
    sides
}

fn paper(sorted: &[f64], diagonal_m: f64) -> Option<PaperFigures> {
    let summary = distance::summary(sorted, diagonal_m)?;
    Some(PaperFigures {
        vertices: summary.samples,
        eq17_mean_m: summary.mean_m,
        eq17_mean_rel: summary.mean_rel,
        eq18_as_printed_sqrt_m: summary.mean_m.sqrt(),
        true_rms_m: summary.rms_m,
    })
}

fn normal_figures(turn_deg: &[f32]) -> Option<NormalFigures> {
    let mut sorted: Vec<f64> = turn_deg.iter().map(|&d| f64::from(d)).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let all = distance::summary(&sorted, 1.0)?;
    let share = |limit: f64| (sorted.len() - sorted.partition_point(|d| *d <= limit)) as f64 / sorted.len() as f64;
    Some(NormalFigures {
        mean_deg: all.mean_m,
        rms_deg: all.rms_m,
        p95_deg: all.p95_m,
        share_above_30: share(30.0),
        share_above_90: share(90.0),
    })
}
