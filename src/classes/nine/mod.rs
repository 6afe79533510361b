//! Measures the paper's nine features, and what else rules may ask for, per vertex or per face.
//!
//! In: a mesh, its planes, the ground, colours where there are any. Out: [`Measures`], which measures what it is asked
//! for and remembers what several features share.
//!
//! # Method
//! 1. `near`: the k nearest vertices and the plane through them; for larger scales the same among cell means, as CGAL's
//!    multi-scale features have it.
//! 2. `columns`: heights of the vertices within a radius in plan.
//! 3. `formula`: the features as pure functions, in three [`Form`]s.
//! 4. Faces take the mean of their corners; features of faces reach vertices as their area-weighted mean.
//!
//! # Numbers
//! see [`NineConfig`] and [`FEATURES`]
//!
//! # Limits
//! The paper speaks of vertices, so a wall of two triangles has four samples: give CAD models smaller triangles first.
//!
//! # References
//! the paper, §2.2; CGAL Classification 6.0, scales and eigen features; SUM (Gao et al. 2021), elevation radii 10, 20,
//! 40 m

use std::sync::OnceLock;

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::columns::Columns;
use self::near::{Fit, Near};
use super::Ground;
use crate::mesh::{Mesh, topology};
use crate::planes::{NONE, Planes};

mod columns;
pub mod formula;
mod near;

/// Which reading of the paper's formulas.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Form {
    /// As printed.
    Paper,
    /// Eigenvalue features as in CGAL, elevation above a ground model, curvature without a sign.
    Cgal,
    /// As `Cgal`; verticality from smoothed and region normals, region size in m², surface variation for anisotropy.
    Robust,
}

/// A feature that can be asked for.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Spec {
    /// As in tables, `--color` and PLY columns.
    pub name: &'static str,
    /// `m`, `m²`, or empty for a pure number.
    pub unit: &'static str,
    /// What it is.
    pub what: &'static str,
}

const fn spec(name: &'static str, unit: &'static str, what: &'static str) -> Spec {
    Spec { name, unit, what }
}

/// The nine of the paper, in its order, then what else there is.
pub const FEATURES: [Spec; 23] = [
    spec("distance_to_plane", "m", "distance to the plane through the nearest vertices"),
    spec("vertical_dispersion", "", "share of empty height intervals around, Eq. 1, 2"),
    spec("elevation", "m", "height above the lowest vertex (paper) or above the ground"),
    spec("vertical_range", "m", "highest minus lowest around, Eq. 3"),
    spec("verticality", "", "1 - |z| of the normal, Eq. 4"),
    spec("region_size", "", "size of the planar region: by vertices, Eq. 5 (paper, cgal), or by area"),
    spec("curvature", "", "mean deviation of the faces around from their plane, Eq. 6"),
    spec("planarity", "", "Eq. 7 as printed (paper), or (l1 - l0) / l2"),
    spec("anisotropy", "", "Eq. 8 as printed (paper), (l2 - l0) / l2 (cgal), or l0 / (l0 + l1 + l2) (robust)"),
    spec("height_m", "m", "height above the ground model"),
    spec("ground_slope", "", "slope of the ground model"),
    spec("normal_z", "", "z of the smoothed normal"),
    spec("region_area_m2", "m²", "area of the planar region, 0 for none"),
    spec("greenness", "", "G - 0.39 B - 0.61 R of the texture, 0 without colour"),
    spec("surface_variation", "", "l0 / (l0 + l1 + l2)"),
    spec("planarity_r2", "", "(l1 - l0) / l2 among cells of twice the grid"),
    spec("planarity_r4", "", "(l1 - l0) / l2 among cells of four times the grid"),
    spec("surface_variation_r2", "", "l0 / (l0 + l1 + l2) among cells of twice the grid"),
    spec("surface_variation_r4", "", "l0 / (l0 + l1 + l2) among cells of four times the grid"),
    spec("vertical_range_r5", "m", "highest minus lowest within 5 m in plan"),
    spec("vertical_range_r10", "m", "highest minus lowest within 10 m in plan"),
    spec("elevation_r20", "m", "height above the lowest within 20 m in plan"),
    spec("elevation_r40", "m", "height above the lowest within 40 m in plan"),
];

/// The paper's nine are the first nine of [`FEATURES`].
pub const NINE: usize = 9;

/// The least and the greatest value of a feature in a form, by its formula; infinite where there is no bound.
pub fn range(name: &str, form: Form) -> Option<[f64; 2]> {
    let infinite = f64::INFINITY;
    Some(match (name, form) {
        ("vertical_dispersion" | "verticality" | "region_size", _) => [0.0, 1.0],
        ("curvature", Form::Paper) => [0.0, 2.0],
        ("curvature", _) => [0.0, 1.0],
        ("planarity", Form::Cgal | Form::Robust) | ("anisotropy", Form::Cgal) => [0.0, 1.0],
        ("planarity_r2" | "planarity_r4", _) => [0.0, 1.0],
        ("surface_variation" | "surface_variation_r2" | "surface_variation_r4", _) => [0.0, 1.0 / 3.0],
        ("anisotropy", Form::Robust) => [0.0, 1.0 / 3.0],
        ("normal_z", _) => [-1.0, 1.0],
        ("greenness", _) => [-255.0, 255.0],
        ("elevation", Form::Cgal | Form::Robust) | ("height_m", _) => [-infinite, infinite],
        (name, _) if FEATURES.iter().any(|f| f.name == name) => [0.0, infinite],
        _ => return None,
    })
}

/// Neighbourhoods of the features.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NineConfig {
    /// Vertices a local plane is fitted to, the vertex itself among them, 4 to 64. Default: 12, as CGAL.
    pub neighbours: u32,
    /// Height of the intervals of vertical dispersion and width of the cells, metres, > 0. Default: none, which takes
    /// max(0.5, 1.25 times the median edge): no gaps on a sampled wall.
    pub grid_m: Option<f64>,
    /// Radius in plan of vertical dispersion and vertical range, metres, > 0. Default: none, which takes 2.5 times
    /// `grid_m`.
    pub radius_m: Option<f64>,
}

impl Default for NineConfig {
    fn default() -> Self {
        Self { neighbours: 12, grid_m: None, radius_m: None }
    }
}

impl NineConfig {
    /// Every setting that is out of its range, as a sentence.
    pub fn check(&self) -> Vec<String> {
        let mut wrong = Vec::new();
        if !(4..=64).contains(&self.neighbours) {
            wrong.push(format!("classify.nine.neighbours is {}, wanted 4 to 64", self.neighbours));
        }
        for (name, value) in [("grid_m", self.grid_m), ("radius_m", self.radius_m)] {
            if value.is_some_and(|v| !(1e-3..=1e4).contains(&v)) {
                wrong.push(format!("classify.nine.{name} is {value:?}, wanted 0.001 to 10000"));
            }
        }
        wrong
    }
}

/// What features are measured on.
#[derive(Clone, Copy)]
pub struct Scene<'a> {
    /// The mesh.
    pub mesh: &'a Mesh,
    /// Its planes.
    pub planes: &'a Planes,
    /// Mean sRGB per face; empty where nothing has colour.
    pub face_colors: &'a [[u8; 3]],
}

/// Features of a scene, measured when first asked for.
pub struct Measures<'a> {
    scene: Scene<'a>,
    ground: &'a Ground,
    neighbours: usize,
    grid_m: f64,
    radius_m: f64,
    around: OnceLock<topology::Incidence>,
    fits: [OnceLock<Vec<Fit>>; 3],
    regions: OnceLock<Vec<u32>>,
}

/// Scales of [`Measures::fits`], in grid cells; the first is the vertices themselves.
const SCALES: [f64; 3] = [0.0, 2.0, 4.0];

impl<'a> Measures<'a> {
    /// Prepares to measure; nothing is measured yet.
    pub fn new(scene: Scene<'a>, ground: &'a Ground, config: &NineConfig) -> Self {
        let grid_m = config.grid_m.unwrap_or((1.25 * scene.planes.median_edge_m).max(0.5));
        Self {
            scene,
            ground,
            neighbours: config.neighbours as usize,
            grid_m,
            radius_m: config.radius_m.unwrap_or(columns::CELLS_PER_RADIUS * grid_m),
            around: OnceLock::new(),
            fits: Default::default(),
            regions: OnceLock::new(),
        }
    }

    /// A feature at every vertex; `None` for a name that [`FEATURES`] lacks.
    pub fn of_vertices(&self, name: &str, form: Form) -> Option<Vec<f32>> {
        if let Some(of_faces) = self.natural_to_faces(name) {
            return Some(self.vertices_from_faces(&of_faces));
        }
        let positions = &self.scene.mesh.positions;
        let columns = |radius_m: f64| Columns::of(positions, radius_m);
        let range = |radius_m: f64| columns(radius_m).per_point_extremes(formula::vertical_range_m);
        let above_lowest = |radius_m: f64| {
            let lowest = columns(radius_m).per_point_extremes(|low, _| low);
            positions.iter().zip(lowest).map(|(p, low)| p.z as f32 - low).collect()
        };
        Some(match name {
            "distance_to_plane" => {
                let fits = self.fits(0);
                let distance = |v: usize| formula::distance_to_plane_m(positions[v], fits[v].centroid, fits[v].normal);
                self.per_vertex(distance)
            }
            "vertical_dispersion" => {
                columns(self.radius_m).per_point(|heights| formula::vertical_dispersion(heights, self.grid_m))
            }
            "vertical_range" => range(self.radius_m),
            "vertical_range_r5" => range(5.0),
            "vertical_range_r10" => range(10.0),
            "elevation" => self.elevation(form),
            "elevation_r20" => above_lowest(20.0),
            "elevation_r40" => above_lowest(40.0),
            "height_m" => self.per_vertex(|v| f64::from(self.ground.height_above(positions[v]))),
            "verticality" => self.verticality(form),
            "region_size" => self.region_size(form),
            "curvature" => self.curvature(form),
            "planarity" => match form {
                Form::Paper => self.eigen(0, formula::planarity_paper),
                Form::Cgal | Form::Robust => self.eigen(0, formula::planarity),
            },
            "anisotropy" => match form {
                Form::Paper => self.eigen(0, formula::anisotropy_paper),
                Form::Cgal => self.eigen(0, formula::anisotropy),
                Form::Robust => self.eigen(0, formula::surface_variation),
            },
            "surface_variation" => self.eigen(0, formula::surface_variation),
            "planarity_r2" => self.eigen(1, formula::planarity),
            "planarity_r4" => self.eigen(2, formula::planarity),
            "surface_variation_r2" => self.eigen(1, formula::surface_variation),
            "surface_variation_r4" => self.eigen(2, formula::surface_variation),
            _ => return None,
        })
    }

    /// A feature of every face; `None` for a name that [`FEATURES`] lacks.
    pub fn of_faces(&self, name: &str, form: Form) -> Option<Vec<f32>> {
        if let Some(of_faces) = self.natural_to_faces(name) {
            return Some(of_faces);
        }
        let of_vertices = self.of_vertices(name, form)?;
        Some(
            self.scene
                .mesh
                .faces
                .iter()
                .map(|f| f.iter().map(|v| of_vertices[*v as usize]).sum::<f32>() / 3.0)
                .collect(),
        )
    }

    /// Region of most of the area around each vertex, the lower id of equals; `NONE` where most has none.
    pub fn vertex_regions(&self) -> &[u32] {
        let (mesh, planes) = (self.scene.mesh, self.scene.planes);
        self.regions.get_or_init(|| {
            let around = self.around();
            let strongest = |v: usize| {
                let mut shares: Vec<(u32, f64)> = Vec::with_capacity(8);
                for f in around.of_vertex(v) {
                    let (r, area) = (planes.face_region[*f as usize], mesh.cross(*f as usize).length());
                    match shares.iter_mut().find(|s| s.0 == r) {
                        Some(share) => share.1 += area,
                        None => shares.push((r, area)),
                    }
                }
                let better = |a: &(u32, f64), b: &(u32, f64)| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0));
                shares.into_iter().max_by(better).map_or(NONE, |s| s.0)
            };
            (0..mesh.positions.len()).into_par_iter().with_min_len(4096).map(strongest).collect()
        })
    }

    /// The `neighbours` nearest vertices of each vertex, itself among them, flat; fewer for tiny meshes.
    pub(super) fn neighbourhoods(&self) -> Vec<Vec<u32>> {
        let positions = &self.scene.mesh.positions;
        let tree = Near::of(positions);
        let one = |found: &mut Vec<near::Found>, p: &DVec3| {
            tree.nearest(*p, self.neighbours, found);
            found.iter().map(|(_, id)| *id).collect()
        };
        positions.par_iter().with_min_len(1024).map_init(Vec::new, one).collect()
    }

    /// Features that faces have of themselves.
    fn natural_to_faces(&self, name: &str) -> Option<Vec<f32>> {
        let Scene { mesh, planes, face_colors } = self.scene;
        let per_face = |of: &(dyn Fn(usize) -> f32 + Sync)| -> Vec<f32> {
            (0..mesh.faces.len()).into_par_iter().with_min_len(4096).map(of).collect()
        };
        Some(match name {
            "greenness" => per_face(&|f| face_colors.get(f).map_or(0.0, |rgb| formula::greenness(*rgb) as f32)),
            "region_area_m2" => per_face(&|f| match planes.face_region[f] {
                NONE => 0.0,
                r => planes.regions[r as usize].area_m2 as f32,
            }),
            "ground_slope" => per_face(&|f| self.ground.steepness(mesh.corners(f)[0])),
            "normal_z" => per_face(&|f| {
                let [a, b, c] = mesh.faces[f].map(|v| planes.vertex_normals[v as usize]);
                (a + b + c).normalize_or_zero().z
            }),
            _ => return None,
        })
    }

    fn elevation(&self, form: Form) -> Vec<f32> {
        let positions = &self.scene.mesh.positions;
        if form == Form::Paper {
            let lowest = positions.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
            return self.per_vertex(|v| formula::elevation_paper_m(positions[v].z, lowest));
        }
        self.per_vertex(|v| f64::from(self.ground.height_above(positions[v])))
    }

    fn verticality(&self, form: Form) -> Vec<f32> {
        let planes = self.scene.planes;
        if form != Form::Robust {
            let fits = self.fits(0);
            return self.per_vertex(|v| formula::verticality(fits[v].normal));
        }
        let regions = self.vertex_regions();
        self.per_vertex(|v| {
            let smoothed = formula::verticality(planes.vertex_normals[v].as_dvec3());
            match regions[v] {
                NONE => smoothed,
                r => 0.5 * (smoothed + formula::verticality(planes.regions[r as usize].normal)),
            }
        })
    }

    fn region_size(&self, form: Form) -> Vec<f32> {
        let (planes, regions) = (self.scene.planes, self.vertex_regions());
        if form == Form::Robust {
            return self.per_vertex(|v| match regions[v] {
                NONE => 0.0,
                r => formula::region_size(planes.regions[r as usize].area_m2),
            });
        }
        let mut counts = vec![0u32; planes.regions.len()];
        regions.iter().filter(|r| **r != NONE).for_each(|r| counts[*r as usize] += 1);
        let (fewest, most) = (counts.iter().min().copied().unwrap_or(0), counts.iter().max().copied().unwrap_or(0));
        self.per_vertex(|v| match regions[v] {
            NONE => 0.0,
            r => formula::region_size_paper(counts[r as usize].into(), fewest.into(), most.into()),
        })
    }

    fn curvature(&self, form: Form) -> Vec<f32> {
        let Scene { mesh, planes, .. } = self.scene;
        let (regions, around) = (self.vertex_regions(), self.around());
        self.per_vertex(|v| {
            // Without a region the printed formula has no plane; the vertex's own normal stands in.
            let plane = match regions[v] {
                NONE => planes.vertex_normals[v].as_dvec3(),
                r => planes.regions[r as usize].normal,
            };
            let normals = around.of_vertex(v).iter().map(|f| mesh.cross(*f as usize).normalize_or_zero());
            formula::curvature(plane, normals, form == Form::Paper)
        })
    }

    fn eigen(&self, scale: usize, of: impl Fn([f64; 3]) -> f64 + Sync) -> Vec<f32> {
        let fits = self.fits(scale);
        self.per_vertex(|v| of(fits[v].eigenvalues))
    }

    fn fits(&self, scale: usize) -> &[Fit] {
        let positions = &self.scene.mesh.positions;
        self.fits[scale].get_or_init(|| {
            if scale == 0 {
                return near::fits(&Near::of(positions), positions, positions, self.neighbours);
            }
            let cells = cell_means(positions, SCALES[scale] * self.grid_m);
            near::fits(&Near::of(&cells), &cells, positions, self.neighbours)
        })
    }

    fn around(&self) -> &topology::Incidence {
        self.around.get_or_init(|| topology::vertex_faces(self.scene.mesh))
    }

    fn vertices_from_faces(&self, of_faces: &[f32]) -> Vec<f32> {
        let (mesh, around) = (self.scene.mesh, self.around());
        self.per_vertex(|v| {
            let faces = around.of_vertex(v).iter().map(|f| *f as usize);
            let (sum, area) = faces.fold((0.0, 0.0), |(sum, all), f| {
                let area = mesh.cross(f).length();
                (sum + area * f64::from(of_faces[f]), all + area)
            });
            if area > 0.0 { sum / area } else { 0.0 }
        })
    }

    fn per_vertex(&self, of: impl Fn(usize) -> f64 + Sync) -> Vec<f32> {
        (0..self.scene.mesh.positions.len()).into_par_iter().with_min_len(4096).map(|v| of(v) as f32).collect()
    }
}

/// The mean of the points in each occupied cell of a grid about the first point.
fn cell_means(points: &[DVec3], cell_m: f64) -> Vec<DVec3> {
    let origin = points.first().copied().unwrap_or(DVec3::ZERO);
    let key = |p: &DVec3| ((*p - origin) / cell_m).floor().to_array().map(|c| c as i64);
    let mut order: Vec<([i64; 3], u32)> = points.par_iter().enumerate().map(|(i, p)| (key(p), i as u32)).collect();
    order.par_sort_unstable();
    let mean = |cell: &[([i64; 3], u32)]| {
        let sum: DVec3 = cell.iter().map(|(_, i)| points[*i as usize] - origin).sum();
        origin + sum / cell.len() as f64
    };
    order.chunk_by(|a, b| a.0 == b.0).map(mean).collect()
}

#[cfg(test)]
mod tests;
