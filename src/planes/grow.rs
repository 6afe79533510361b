//! Region growing, reassignment, merging.

use std::collections::VecDeque;

use glam::DVec3;
use rayon::prelude::*;

use super::fit::{Moments, Plane};
use super::normals::Surface;
use super::{NONE, PlanesConfig, Region, Seeds};
use crate::mesh::Mesh;

/// A region is refitted each time it has grown by this factor: O(log n) refits a region.
const REFIT_GROWTH: f64 = 1.25;
/// Faces that bend more than this (mean of 1 - cos towards the neighbours) do not start a region: about 25°.
const SEED_BEND: f32 = 0.1;
/// Steps of the flatness by which seeds are sorted.
const SEED_STEPS: usize = 1024;
/// Sweeps in which border faces may change sides.
const BORDER_SWEEPS: usize = 3;
/// Regions of few faces survive above this area: in models made by hand a wall is two triangles.
const FEW_FACES_AREA_M2: f64 = 8.0;

/// A plane that takes faces; distances in metres.
struct Gate {
    distance_m: f64,
    cos_angle: f64,
}

impl Gate {
    /// How badly a face fits a plane, 0 to 1; `None` if it fails one of the two thresholds. Corners, which are far apart
    /// in memory, are asked for only where the angle passes.
    #[inline]
    fn misfit(&self, corners: impl FnOnce() -> [DVec3; 3], face_normal: DVec3, plane: &Plane) -> Option<f64> {
        let agree = face_normal.dot(plane.normal);
        if agree < self.cos_angle {
            return None;
        }
        let [a, b, c] = corners().map(|p| (p - plane.centroid).dot(plane.normal));
        let (centre, corner) = (((a + b + c) / 3.0).abs(), a.abs().max(b.abs()).max(c.abs()));
        if centre > self.distance_m || corner > 2.0 * self.distance_m {
            return None;
        }
        Some(0.5 * centre / self.distance_m + 0.5 * (1.0 - agree) / (1.0 - self.cos_angle))
    }
}

/// The largest distance from a plane, metres.
fn distance(surface: &Surface, config: &PlanesConfig) -> f64 {
    // Half an edge is what a mesher's staircase needs; four times the median offset covers 99 % of Gaussian noise.
    config.distance_m.unwrap_or((0.5 * surface.grain.median_edge_m).max(4.0 * surface.grain.noise_m).clamp(0.05, 0.5))
}

/// Regions of a mesh: the id per face and the planes, largest first.
pub fn regions(mesh: &Mesh, surface: &Surface, config: &PlanesConfig) -> (Vec<u32>, Vec<Region>) {
    let gate =
        Gate { distance_m: distance(surface, config), cos_angle: config.angle_deg.to_radians().cos().min(0.9999) };
    let mut growth = Growth::new(mesh, surface, config, &gate);
    for seed in seeds(surface, config.seeds) {
        growth.grow(seed);
    }
    let Growth { region: grown, mut patches, .. } = growth;
    let mut region = settle_borders(mesh, surface, &gate, &grown, &patches);
    for f in (0..region.len()).filter(|&f| region[f] != grown[f]) {
        if grown[f] != NONE {
            patches[grown[f] as usize].remove(mesh.corners(f));
        }
        if region[f] != NONE {
            patches[region[f] as usize].add(mesh.corners(f));
        }
    }
    drop(grown);
    if config.seeds == Seeds::Planar {
        merge(surface, &gate, &mut region, &mut patches);
    }
    finish(surface, config, region, &patches)
}

/// Flat faces, flattest first, ties by id; or every face in an order that looks random and is always the same.
fn seeds(surface: &Surface, kind: Seeds) -> Vec<u32> {
    if kind == Seeds::Random {
        let mut order: Vec<u32> = (0..surface.bend.len() as u32).collect();
        order.par_sort_unstable_by_key(|&f| (scattered(f), f));
        return order;
    }
    let step = |f: usize| ((surface.bend[f] / SEED_BEND * SEED_STEPS as f32) as usize).min(SEED_STEPS);
    let mut start = vec![0usize; SEED_STEPS + 2];
    let faces = surface.bend.len();
    (0..faces).for_each(|f| start[step(f) + 1] += 1);
    for i in 0..=SEED_STEPS {
        start[i + 1] += start[i];
    }
    let mut order = vec![0u32; faces];
    for f in 0..faces {
        let slot = &mut start[step(f)];
        order[*slot] = f as u32;
        *slot += 1;
    }
    // After the fill, `start[k]` is where bucket k ends; the last bucket bends too much.
    order.truncate(start[SEED_STEPS - 1]);
    order
}

/// Fibonacci hashing, twice.
fn scattered(f: u32) -> u64 {
    let once = (u64::from(f) + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    (once ^ (once >> 31)).wrapping_mul(0xD6E8_FEB8_6659_FD93)
}

/// A region while it may still change.
struct Patch {
    /// As fitted when growing ended; joined regions are fitted again.
    plane: Plane,
    /// About `origin`: local, so nothing is lost far from the dataset's origin.
    moments: Moments,
    origin: DVec3,
    faces: u32,
}

impl Patch {
    fn add(&mut self, corners: [DVec3; 3]) {
        self.moments.add(corners.map(|p| p - self.origin));
        self.faces += 1;
    }

    fn remove(&mut self, corners: [DVec3; 3]) {
        self.moments.remove(corners.map(|p| p - self.origin));
        self.faces -= 1;
    }

    fn centroid(&self) -> DVec3 {
        self.origin + self.moments.centroid()
    }
}

struct Growth<'a> {
    mesh: &'a Mesh,
    surface: &'a Surface,
    config: &'a PlanesConfig,
    gate: &'a Gate,
    region: Vec<u32>,
    /// Seeds whose region stayed too small; they may join others but not start again.
    failed: Vec<bool>,
    patches: Vec<Patch>,
    queue: VecDeque<u32>,
    members: Vec<u32>,
}

impl<'a> Growth<'a> {
    fn new(mesh: &'a Mesh, surface: &'a Surface, config: &'a PlanesConfig, gate: &'a Gate) -> Self {
        let faces = mesh.faces.len();
        Self {
            mesh,
            surface,
            config,
            gate,
            region: vec![NONE; faces],
            failed: vec![false; faces],
            patches: Vec::new(),
            queue: VecDeque::new(),
            members: Vec::new(),
        }
    }

    fn grow(&mut self, seed: u32) {
        let first = seed as usize;
        if self.region[first] != NONE || self.failed[first] || self.surface.areas[first] <= 0.0 {
            return;
        }
        let id = self.patches.len() as u32;
        let origin = self.mesh.corners(first)[0];
        let normal = self.surface.normals[first].as_dvec3();
        let centroid = self.mesh.corners(first).iter().map(|p| *p - origin).sum::<DVec3>() / 3.0;
        let mut plane = Plane { normal, centroid, rms_m: 0.0 };
        let mut moments = Moments::default();
        let mut refit_at = 12.0f64;
        self.members.clear();
        self.queue.clear();
        self.queue.push_back(seed);
        self.region[first] = id;
        while let Some(f) = self.queue.pop_front() {
            self.members.push(f);
            moments.add(self.mesh.corners(f as usize).map(|p| p - origin));
            if self.members.len() as f64 >= refit_at {
                plane = moments.plane();
                refit_at *= REFIT_GROWTH;
            }
            for &g in &self.surface.neighbours[f as usize] {
                if g == NONE || self.region[g as usize] != NONE {
                    continue;
                }
                let g_normal = self.surface.normals[g as usize].as_dvec3();
                let corners = || self.mesh.corners(g as usize).map(|p| p - origin);
                if self.gate.misfit(corners, g_normal, &plane).is_some() {
                    self.region[g as usize] = id;
                    self.queue.push_back(g);
                }
            }
        }
        if is_too_small(moments.area, self.members.len() as u32, self.config) {
            for &f in &self.members {
                self.region[f as usize] = NONE;
                self.failed[f as usize] = true;
            }
            return;
        }
        let fitted = moments.plane();
        let plane = Plane { centroid: fitted.centroid + origin, ..fitted };
        self.patches.push(Patch { plane, moments, origin, faces: self.members.len() as u32 });
    }
}

fn is_too_small(area_m2: f64, faces: u32, config: &PlanesConfig) -> bool {
    area_m2 < config.min_area_m2 || (faces < config.min_faces && area_m2 < FEW_FACES_AREA_M2)
}

/// Lets every face beside another region (or beside one while in none) choose the best of what touches it, in sweeps
/// that see what the last one did.
fn settle_borders(mesh: &Mesh, surface: &Surface, gate: &Gate, grown: &[u32], patches: &[Patch]) -> Vec<u32> {
    let all = (0..grown.len()).into_par_iter().with_min_len(4096);
    let mut region: Vec<u32> = all.map(|f| choose(mesh, surface, gate, grown, patches, f)).collect();
    let mut moved: Vec<u32> = (0..grown.len() as u32).filter(|&f| region[f as usize] != grown[f as usize]).collect();
    for _ in 1..BORDER_SWEEPS {
        // The others saw the same neighbours before and would choose the same again.
        let mut beside: Vec<u32> = moved.iter().flat_map(|f| surface.neighbours[*f as usize]).collect();
        beside.retain(|f| *f != NONE);
        beside.par_sort_unstable();
        beside.dedup();
        let choice = |f: &u32| (*f, choose(mesh, surface, gate, &region, patches, *f as usize));
        let mut choices: Vec<(u32, u32)> = beside.par_iter().with_min_len(1024).map(choice).collect();
        choices.retain(|(f, r)| region[*f as usize] != *r);
        choices.iter().for_each(|(f, r)| region[*f as usize] = *r);
        moved = choices.into_iter().map(|(f, _)| f).collect();
    }
    region
}

/// The region that a face fits best: its own or one beside it.
fn choose(mesh: &Mesh, surface: &Surface, gate: &Gate, region: &[u32], patches: &[Patch], f: usize) -> u32 {
    let own = region[f];
    let around = surface.neighbours[f].map(|g| if g == NONE { own } else { region[g as usize] });
    if around.iter().all(|&r| r == own) {
        return own;
    }
    let (corners, normal) = (mesh.corners(f), surface.normals[f].as_dvec3());
    let mut best = (f64::INFINITY, NONE);
    for r in [own, around[0], around[1], around[2]] {
        if r == NONE {
            continue;
        }
        if let Some(misfit) = gate.misfit(|| corners, normal, &patches[r as usize].plane)
            && (misfit, r) < best
        {
            best = (misfit, r);
        }
    }
    best.1
}

/// Joins neighbouring regions that are one plane, most similar first.
fn merge(surface: &Surface, gate: &Gate, region: &mut [u32], patches: &mut [Patch]) {
    let mut pairs: Vec<(u32, u32)> = Vec::new();
    for (f, of) in surface.neighbours.iter().enumerate() {
        let a = region[f];
        for &g in of.iter().filter(|&&g| g != NONE && g as usize > f) {
            let b = region[g as usize];
            if a != b && a != NONE && b != NONE {
                pairs.push((a.min(b), a.max(b)));
            }
        }
    }
    pairs.par_sort_unstable();
    pairs.dedup();
    let agree = |p: &[Patch], a: u32, b: u32| p[a as usize].plane.normal.dot(p[b as usize].plane.normal);
    pairs.retain(|&(a, b)| agree(patches, a, b) > gate.cos_angle);
    pairs.sort_by(|x, y| agree(patches, y.0, y.1).total_cmp(&agree(patches, x.0, x.1)).then(x.cmp(y)));
    let mut parent: Vec<u32> = (0..patches.len() as u32).collect();
    for (a, b) in pairs {
        let (a, b) = (root(&mut parent, a) as usize, root(&mut parent, b) as usize);
        if a == b {
            continue;
        }
        let (keep, gone) = (a.min(b), a.max(b));
        if let Some(joined) = joined(&patches[keep], &patches[gone], gate) {
            parent[gone] = keep as u32;
            patches[keep] = joined;
            patches[gone].faces = 0;
        }
    }
    region.iter_mut().filter(|r| **r != NONE).for_each(|r| *r = root(&mut parent, *r));
}

/// Both regions as one, if one plane explains both as well as a plane explains one: half the gate leaves room for
/// its tails.
fn joined(a: &Patch, b: &Patch, gate: &Gate) -> Option<Patch> {
    let moments = a.moments.joined(&b.moments.moved(b.origin - a.origin));
    let fitted = moments.plane();
    let plane = Plane { centroid: fitted.centroid + a.origin, ..fitted };
    let limit = 0.5 * gate.distance_m;
    let offset = |of: &Patch| (of.centroid() - plane.centroid).dot(plane.normal).abs();
    let turned = |of: &Patch| plane.normal.dot(of.plane.normal) < half_angle_cos(gate.cos_angle);
    if plane.rms_m > limit || offset(a).max(offset(b)) > limit || turned(a) || turned(b) {
        return None;
    }
    Some(Patch { plane, moments, origin: a.origin, faces: a.faces + b.faces })
}

/// cos(θ/2) of cos θ.
fn half_angle_cos(cos: f64) -> f64 {
    (0.5 * (1.0 + cos)).sqrt()
}

fn root(parent: &mut [u32], mut of: u32) -> u32 {
    while parent[of as usize] != of {
        parent[of as usize] = parent[parent[of as usize] as usize];
        of = parent[of as usize];
    }
    of
}

/// Drops small regions, fits the others over their final faces and numbers them by area.
fn finish(surface: &Surface, config: &PlanesConfig, region: Vec<u32>, patches: &[Patch]) -> (Vec<u32>, Vec<Region>) {
    let area = |r: u32| patches[r as usize].moments.area;
    let mut order: Vec<u32> = (0..patches.len() as u32).collect();
    order.retain(|&r| {
        let faces = patches[r as usize].faces;
        faces > 0 && !is_too_small(area(r), faces, config)
    });
    order.sort_by(|&a, &b| area(b).total_cmp(&area(a)).then(a.cmp(&b)));
    let mut renumbered = vec![NONE; patches.len()];
    let mut regions = Vec::with_capacity(order.len());
    for (new, &old) in order.iter().enumerate() {
        renumbered[old as usize] = new as u32;
        let patch = &patches[old as usize];
        let plane = patch.moments.plane();
        regions.push(Region {
            normal: plane.normal,
            centroid: plane.centroid + patch.origin,
            area_m2: patch.moments.area,
            faces: patch.faces,
        });
    }
    let mut face_region = region;
    face_region.par_iter_mut().with_min_len(4096).zip(&surface.areas).for_each(|(r, &area)| {
        *r = if area > 0.0 && *r != NONE { renumbered[*r as usize] } else { NONE };
    });
    (face_region, regions)
}

#[cfg(test)]
mod tests {
    use super::super::grow;
    use super::*;

    /// A grid of n × n squares of `step` metres lifted by `height`.
    fn sheet(n: u32, step: f64, height: impl Fn(f64, f64) -> f64) -> Mesh {
        let mut mesh = Mesh::default();
        for j in 0..=n {
            for i in 0..=n {
                let (x, y) = (f64::from(i) * step, f64::from(j) * step);
                mesh.positions.push(DVec3::new(x, y, height(x, y)));
            }
        }
        for j in 0..n {
            for i in 0..n {
                let a = j * (n + 1) + i;
                mesh.faces.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
            }
        }
        mesh
    }

    #[test]
    fn a_gable_is_two_planes_with_the_right_normals_and_areas() {
        let mesh = sheet(20, 0.5, |x, _| 5.0 - (x - 5.0).abs());
        let planes = grow(&mesh, &PlanesConfig::default());
        assert_eq!(planes.regions.len(), 2);
        for region in &planes.regions {
            assert!((region.normal.z - std::f64::consts::FRAC_1_SQRT_2).abs() < 1e-3, "{}", region.normal);
            assert!((region.area_m2 - 50.0 * 2f64.sqrt()).abs() < 1.0, "{}", region.area_m2);
        }
        assert!(planes.face_region.iter().all(|&r| r != NONE));
        assert!(planes.regions[0].normal.dot(planes.regions[1].normal).abs() < 1e-3);
    }

    #[test]
    fn noise_of_a_few_centimetres_does_not_split_a_plane() {
        let noise = |x: f64, y: f64| 0.03 * ((x * 12.9898 + y * 78.233).sin() * 43758.5453).fract();
        let planes = grow(&sheet(40, 0.3, |x, y| 0.2 * x + noise(x, y)), &PlanesConfig::default());
        assert!(planes.regions[0].area_m2 > 0.98 * planes.regions.iter().map(|r| r.area_m2).sum::<f64>());
        let up = DVec3::new(-0.2, 0.0, 1.0).normalize();
        assert!(planes.regions[0].normal.dot(up) > 0.9999);
    }

    #[test]
    fn two_floors_one_metre_apart_stay_apart() {
        let planes = grow(&sheet(20, 0.5, |x, _| if x < 5.0 { 0.0 } else { 1.0 }), &PlanesConfig::default());
        let level = |z: f64| planes.regions.iter().any(|r| (r.centroid.z - z).abs() < 0.1 && r.normal.z > 0.99);
        assert!(level(0.0) && level(1.0), "{:?}", planes.regions);
    }

    #[test]
    fn an_empty_mesh_has_no_planes() {
        let planes = grow(&Mesh::default(), &PlanesConfig::default());
        assert!(planes.regions.is_empty() && planes.face_region.is_empty());
    }
}
