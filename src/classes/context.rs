//! Second thoughts: what the neighbourhood says about a patch that its own faces cannot know.
//!
//! 1. Roofs that touch in plan are one building. It has a minimal footprint, its rim ends in the air (beyond it the
//!    surface is down near the ground; a hill's top slopes away instead), and walls stand under that rim.
//! 2. A wall belongs to a building, or is large enough to be the rest of one that was not captured.
//! 3. What lies under a roof, or is enclosed by roofs and walls, belongs to the building: balconies, dormers,
//!    parapets, recesses. What is tiny belongs to what is around it.

use glam::DVec3;

use super::ClassesConfig;
use super::ground::Ground;
use super::nine::Scene;
use super::rules::Scores;
use super::smooth::best;
use crate::mesh::Mesh;
use crate::planes::{NONE, Planes};

const TERRAIN: usize = 0;
const FACADE: usize = 1;
const ROOF: usize = 2;
const CLUTTER: usize = 3;

/// How far beyond a rim one looks, metres: past a gutter, a rounded edge.
const BEYOND_RIM_M: f64 = 1.5;
/// Share of a rim's height above ground to which the surface beyond must fall.
const FALL: f32 = 0.5;
/// Share of its rim at which a building must end in the air if walls stand under it; the rest may be neighbours,
/// trees, a courtyard's smear.
const FREE_WALLED_RIM: f64 = 0.15;
/// The same for roofs without walls: canopies, petrol stations.
const FREE_RIM: f64 = 0.8;
/// Less free than this and without walls it is a hill; in between it is the top of something round, as trees are.
const FREE_HILL: f64 = 0.35;
/// Share of the area under the free rim that has to be wall. Measured: buildings 0.13 to 1.4, nature 0.00.
const WALLED: f64 = 0.1;
/// What is larger than this many least footprints and ends with the capture along most of its rim is a terrace cut
/// off by it: of a building that large one would see more sides.
const WIDE: f64 = 40.0;
/// See [`WIDE`].
const CUT_OFF_RIM: f64 = 0.6;
/// A wall farther than this from every building must stand for itself, metres.
const NEAR_M: f64 = 3.0;
/// A wall that stands for itself has at least this many times the least footprint.
const LONE_WALL: f64 = 3.0;
/// Share of a patch's rim on roofs and walls that makes it part of the building.
const ENCLOSED: f64 = 0.8;
/// A patch above this many times the least footprint is not enclosed, whatever its rim.
const ENCLOSED_AREA: f64 = 5.0;
/// What looks up from less than this below a roof's surface is part of the roof, metres; a balcony is lower.
const STOREY_M: f64 = 2.0;
/// z of the normal of what looks up: 60°.
const UPWARD: f64 = 0.5;
/// Clearance under a roof's surface where walls begin, metres.
const UNDER_ROOF_M: f64 = 0.5;

/// Revises the scores in place.
pub fn revise(scene: Scene, neighbours: &[[u32; 3]], ground: &Ground, config: &ClassesConfig, field: &mut [Scores]) {
    let Scene { mesh, planes, .. } = scene;
    let footprints = Footprints::of(mesh, neighbours, ground, config, field);
    judge_roofs(mesh, ground, &footprints, field);
    judge_walls(mesh, planes, ground, config, &footprints, field);
    shelter(mesh, ground, &footprints, field);
    settle_patches(mesh, neighbours, config, field);
}

#[derive(Clone, Copy, PartialEq)]
enum Verdict {
    Building,
    Hill,
    /// A hill so wide that the walls at its edge hold it.
    Terrace,
    Clutter,
}

/// What is known of a group of roofs that touch.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Footprint, m².
    area: f64,
    /// Length of the rim beyond which something was captured, metres.
    rim: f64,
    /// Length of the rim at which the surface ends and beyond which nothing was.
    open: f64,
    /// Of that, what ends in the air.
    free: f64,
    /// What would hang from the free rim to the ground, m².
    curtain: f64,
    /// Façades in its cells or touching them, m².
    walls: f64,
}

impl Sums {
    fn is_wide(&self, config: &ClassesConfig) -> bool {
        self.area > WIDE * config.min_footprint_m2
    }

    fn verdict(&self, config: &ClassesConfig) -> Verdict {
        let is_walled = self.walls > WALLED * self.curtain;
        let is_cut_off = self.is_wide(config) && self.open > CUT_OFF_RIM * (self.open + self.rim);
        if self.area < config.min_footprint_m2 {
            Verdict::Clutter
        } else if is_cut_off {
            Verdict::Terrace
        } else if self.free >= if is_walled { FREE_WALLED_RIM } else { FREE_RIM } * self.rim {
            Verdict::Building
        } else if self.free < FREE_HILL * self.rim {
            if self.is_wide(config) { Verdict::Terrace } else { Verdict::Hill }
        } else {
            Verdict::Clutter
        }
    }
}

/// Cells under roofs, grouped by touching.
struct Footprints {
    /// Group per cell, `NONE` outside.
    group: Vec<u32>,
    /// Highest roof per cell, as [`Ground::level`].
    top: Vec<f64>,
    verdicts: Vec<Verdict>,
}

impl Footprints {
    fn of(mesh: &Mesh, neighbours: &[[u32; 3]], ground: &Ground, config: &ClassesConfig, field: &[Scores]) -> Self {
        let mut top = vec![f64::NEG_INFINITY; ground.cells()];
        for f in (0..field.len()).filter(|f| best(&field[*f]) == ROOF) {
            ground.for_cells(mesh.corners(f), |cell, z| top[cell] = top[cell].max(z));
        }
        let (group, groups) = ground.groups(|cell| top[cell].is_finite());
        let mut sums = vec![Sums::default(); groups];
        for f in 0..field.len() {
            match best(&field[f]) {
                ROOF => {
                    let Some(own) = group_at(ground, &group, centre(mesh, f)) else { continue };
                    let sum = &mut sums[own as usize];
                    sum.area += 0.5 * mesh.cross(f).z.abs();
                    for (edge, beyond, is_end) in rim(mesh, neighbours, f, |g| best(&field[g]) == ROOF) {
                        let length = edge[0].distance(edge[1]);
                        let Some(drop) = ground.drop_below(beyond) else {
                            // A wall below the rim shows that this is no cut.
                            sum.open += if is_end { length } else { 0.0 };
                            continue;
                        };
                        if group_at(ground, &group, beyond) == Some(own) {
                            continue;
                        }
                        let height = ground.height_above((edge[0] + edge[1]) / 2.0);
                        sum.rim += length;
                        if height - drop < FALL * height {
                            sum.free += length;
                            sum.curtain += length * f64::from(height);
                        }
                    }
                }
                FACADE => {
                    let near = ground.cell(centre(mesh, f)).and_then(|cell| ground.touching(cell, &group));
                    if let Some(own) = near {
                        sums[own as usize].walls += 0.5 * mesh.cross(f).length();
                    }
                }
                _ => {}
            }
        }
        Self { group, top, verdicts: sums.iter().map(|sum| sum.verdict(config)).collect() }
    }

    fn verdict(&self, ground: &Ground, p: DVec3) -> Option<Verdict> {
        group_at(ground, &self.group, p).map(|g| self.verdicts[g as usize])
    }
}

fn group_at(ground: &Ground, group: &[u32], p: DVec3) -> Option<u32> {
    ground.cell(p).map(|cell| group[cell]).filter(|g| *g != NONE)
}

fn centre(mesh: &Mesh, f: usize) -> DVec3 {
    let [a, b, c] = mesh.corners(f);
    (a + b + c) / 3.0
}

/// Edges of a face behind which `is_same` does not hold, each with a point beyond it at the edge's height and whether
/// the surface ends there.
fn rim<'a>(
    mesh: &'a Mesh,
    neighbours: &'a [[u32; 3]],
    f: usize,
    is_same: impl Fn(usize) -> bool + 'a,
) -> impl Iterator<Item = ([DVec3; 2], DVec3, bool)> + 'a {
    let (corners, middle) = (mesh.corners(f), centre(mesh, f));
    let open = (0..3).filter(move |&k| neighbours[f][k] == NONE || !is_same(neighbours[f][k] as usize));
    open.map(move |k| {
        let edge = [corners[k], corners[(k + 1) % 3]];
        let halfway = (edge[0] + edge[1]) / 2.0;
        let mut out = (edge[1] - edge[0]).truncate().perp().normalize_or_zero();
        if out.dot((halfway - middle).truncate()) < 0.0 {
            out = -out;
        }
        (edge, halfway + BEYOND_RIM_M * out.extend(0.0), neighbours[f][k] == NONE)
    })
}

/// Roofs of hills become terrain, roofs of nothing clutter. The face keeps its doubts: two classes trade places.
fn judge_roofs(mesh: &Mesh, ground: &Ground, footprints: &Footprints, field: &mut [Scores]) {
    for (f, scores) in field.iter_mut().enumerate().filter(|(_, scores)| best(*scores) == ROOF) {
        match footprints.verdict(ground, centre(mesh, f)) {
            Some(Verdict::Building) => {}
            Some(Verdict::Hill | Verdict::Terrace) => scores.swap(ROOF, TERRAIN),
            Some(Verdict::Clutter) | None => scores.swap(ROOF, CLUTTER),
        }
    }
}

/// Small walls far from any building become clutter, walls under a terrace's edge terrain, region by region.
fn judge_walls(
    mesh: &Mesh,
    planes: &Planes,
    ground: &Ground,
    config: &ClassesConfig,
    footprints: &Footprints,
    field: &mut [Scores],
) {
    let near = |verdict: Verdict| {
        let is_one = |group: &u32| *group != NONE && footprints.verdicts[*group as usize] == verdict;
        ground.grown(footprints.group.iter().map(is_one).collect(), NEAR_M)
    };
    let (building, terrace) = (near(Verdict::Building), near(Verdict::Terrace));
    let is_wall = |field: &[Scores], f: usize| best(&field[f]) == FACADE;
    let is_in = |cells: &[bool], f: usize| ground.cell(centre(mesh, f)).is_some_and(|cell| cells[cell]);
    // Per region, area near buildings and near terraces.
    let mut beside = vec![[0.0f64; 2]; planes.regions.len()];
    for f in 0..field.len() {
        if planes.face_region[f] != NONE && is_wall(field, f) {
            let area = 0.5 * mesh.cross(f).length();
            let beside = &mut beside[planes.face_region[f] as usize];
            beside[0] += if is_in(&building, f) { area } else { 0.0 };
            beside[1] += if is_in(&terrace, f) { area } else { 0.0 };
        }
    }
    for f in 0..field.len() {
        if !is_wall(field, f) {
            continue;
        }
        let (is_houses, holds, is_large) = match planes.face_region[f] {
            NONE => (is_in(&building, f), is_in(&terrace, f), false),
            r => {
                let (area, [houses, terraces]) = (planes.regions[r as usize].area_m2, beside[r as usize]);
                (houses > 0.2 * area, terraces > 0.2 * area, area > LONE_WALL * config.min_footprint_m2)
            }
        };
        // A wall whose top is ground on its other side holds it.
        if holds && !is_houses {
            field[f].swap(FACADE, TERRAIN);
        } else if !is_houses && !is_large {
            field[f].swap(FACADE, CLUTTER);
        }
    }
}

/// Clutter under a building's roof is its wall, or roof if it looks up from less than a storey below.
fn shelter(mesh: &Mesh, ground: &Ground, footprints: &Footprints, field: &mut [Scores]) {
    for (f, scores) in field.iter_mut().enumerate().filter(|(_, scores)| best(*scores) == CLUTTER) {
        let p = centre(mesh, f);
        if footprints.verdict(ground, p) != Some(Verdict::Building) {
            continue;
        }
        let Some(below) = ground.cell(p).map(|cell| footprints.top[cell] - ground.level(p)) else { continue };
        let cross = mesh.cross(f);
        let is_upward = cross.z > UPWARD * cross.length();
        if is_upward && below > 0.0 && below < STOREY_M {
            scores.swap(CLUTTER, ROOF);
        } else if below > UNDER_ROOF_M {
            scores.swap(CLUTTER, FACADE);
        }
    }
}

/// Gives enclosed clutter to the building and tiny patches of any class to what is around them.
fn settle_patches(mesh: &Mesh, neighbours: &[[u32; 3]], config: &ClassesConfig, field: &mut [Scores]) {
    let label: Vec<u8> = field.iter().map(|s| best(s) as u8).collect();
    let mut seen = vec![false; label.len()];
    let mut patch: Vec<u32> = Vec::new();
    for start in 0..label.len() {
        if seen[start] {
            continue;
        }
        let own = label[start];
        patch.clear();
        patch.push(start as u32);
        seen[start] = true;
        let (mut area, mut rim, mut next) = (0.0, [0.0f64; 4], 0);
        let is_clutter = usize::from(own) == CLUTTER;
        let enclosed = if is_clutter { ENCLOSED_AREA * config.min_footprint_m2 } else { 0.0 };
        while next < patch.len() {
            let f = patch[next] as usize;
            next += 1;
            if area >= config.island_m2.max(enclosed) {
                // Too large for either change: its faces only have to be passed over.
                for g in neighbours[f].into_iter().filter(|g| *g != NONE) {
                    if label[g as usize] == own && !seen[g as usize] {
                        seen[g as usize] = true;
                        patch.push(g);
                    }
                }
                continue;
            }
            let corners = mesh.corners(f);
            area += 0.5 * (corners[1] - corners[0]).cross(corners[2] - corners[0]).length();
            for (k, &g) in neighbours[f].iter().enumerate().filter(|(_, g)| **g != NONE) {
                let g = g as usize;
                if label[g] != own {
                    rim[label[g] as usize] += corners[k].distance(corners[(k + 1) % 3]);
                } else if !seen[g] {
                    seen[g] = true;
                    patch.push(g as u32);
                }
            }
        }
        let strongest = |of: &[usize]| of.iter().copied().reduce(|a, c| if rim[c] > rim[a] { c } else { a });
        let (building, whole) = (rim[FACADE] + rim[ROOF], rim.iter().sum::<f64>());
        let into = if area < config.island_m2 {
            strongest(&[TERRAIN, FACADE, ROOF, CLUTTER])
        } else if area < enclosed && building > ENCLOSED * whole {
            strongest(&[FACADE, ROOF])
        } else {
            None
        };
        if let Some(class) = into.filter(|c| rim[*c] > 0.0) {
            patch.iter().for_each(|&f| field[f as usize].swap(class, usize::from(own)));
        }
    }
}
