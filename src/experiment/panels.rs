//! Figures 5 and 9 as pictures: the source beside the cuts, whole and class by class, and where the cuts are off.

use glam::DVec3;
use image::RgbImage;
use rayon::prelude::*;

use super::{Cut, Experiment, plots::asked};
use crate::Result;
use crate::classes::Classes;
use crate::draw::panel::{Legend, Panel, grid};
use crate::draw::png;
use crate::draw::ramp::{Ramp, Scale, class_color};
use crate::draw::raster::Seen;
use crate::draw::shade::{Hit, Paint, color, halved, lit, render};
use crate::draw::view::View;
use crate::geo::Aabb;
use crate::geo::bvh::Bvh;
use crate::ids::{ClassId, ClassScheme};
use crate::mesh::Mesh;

/// Pictures of whole meshes, and of one class, pixels.
const LARGE_PX: [u32; 2] = [640, 480];
const SMALL_PX: [u32; 2] = [420, 320];
/// From the south-west, as high as the paper's figures look.
const AZIMUTH_DEG: f64 = 215.0;
const ELEVATION_DEG: f64 = 38.0;
/// The close look at a class shows one of so many parts of its box on each axis of the plan.
const CELLS: usize = 4;
/// Edges are lines this wide, pixels of the picture.
const EDGE_PX: f64 = 0.8;
/// Light left on an edge, share.
const EDGE_LIGHT: f64 = 0.45;
/// Share of the distances that the scale leaves out at its upper end.
const CUT_OFF: f64 = 0.02;
/// Letters.
const TEXT_SCALE: u32 = 2;

/// What is drawn.
struct Shown<'a> {
    title: String,
    positions: &'a [DVec3],
    faces: &'a [[u32; 3]],
    labels: &'a [ClassId],
}

pub(super) fn files(mesh: &Mesh, classes: &Classes, experiment: &Experiment) -> Result<Vec<(String, Vec<u8>)>> {
    let pictures = [
        ("fig5-models.png", models(mesh, classes, experiment)),
        ("fig5-distance.png", distances(mesh, experiment)),
        ("fig9-classes.png", by_class(mesh, classes, experiment)),
    ];
    pictures.iter().map(|(name, picture)| Ok(((*name).to_owned(), png::bytes(picture)?))).collect()
}

/// The source, then the cuts.
fn shown<'a>(mesh: &'a Mesh, classes: &'a Classes, cuts: impl Iterator<Item = &'a Cut>) -> Vec<Shown<'a>> {
    let source = Shown {
        title: format!("source, {} faces", mesh.faces.len()),
        positions: &mesh.positions,
        faces: &mesh.faces,
        labels: &classes.label,
    };
    let of_cut = |cut: &'a Cut| Shown {
        title: format!("{}, {}", cut.method, cut.asked),
        positions: &cut.mesh.positions,
        faces: &cut.mesh.faces,
        labels: &cut.mesh.labels,
    };
    std::iter::once(source).chain(cuts.map(of_cut)).collect()
}

/// A row for each number of faces: the source and each method's cut, by class.
fn models(mesh: &Mesh, classes: &Classes, experiment: &Experiment) -> RgbImage {
    let view = View::oblique(&mesh.positions, AZIMUTH_DEG, ELEVATION_DEG, LARGE_PX);
    let mut panels = Vec::new();
    for share in asked(experiment) {
        for shown in shown(mesh, classes, experiment.cuts.iter().filter(|c| c.asked == share)) {
            let colors: Vec<_> = shown.labels.iter().map(|l| class_color(&classes.scheme, *l)).collect();
            let picture = render(&view, shown.positions, shown.faces, Paint::Faces(&colors));
            panels.push(Panel { title: shown.title, picture, legend: None });
        }
    }
    let legend = Legend::of_classes(&classes.scheme);
    grid("", &panels, experiment.curves.len() + 1, Some(&legend), TEXT_SCALE)
}

/// The source, coloured by how far each of its vertices is from the cut: a row for each number of faces.
fn distances(mesh: &Mesh, experiment: &Experiment) -> RgbImage {
    let view = View::oblique(&mesh.positions, AZIMUTH_DEG, ELEVATION_DEG, LARGE_PX);
    let all: Vec<Vec<f64>> = experiment.cuts.iter().map(|cut| vertex_distances(mesh, cut)).collect();
    // One scale for all, or the pictures could not be compared.
    let together: Vec<f64> = all.iter().flatten().copied().filter(|d| d.is_finite()).collect();
    let mut scale = Scale::over(Ramp::BlueRed, &together, CUT_OFF, "m");
    scale.low = 0.0;
    let panel = |(cut, values): (&Cut, &Vec<f64>)| Panel {
        title: format!("{}, {}", cut.method, cut.asked),
        picture: render(&view, &mesh.positions, &mesh.faces, Paint::VertexValues(values, &scale)),
        legend: None,
    };
    let panels: Vec<Panel> = experiment.cuts.iter().zip(&all).map(panel).collect();
    let title = "Distance of the source from the cut";
    grid(title, &panels, experiment.curves.len(), Some(&Legend::Scale(scale.clone())), TEXT_SCALE)
}

fn vertex_distances(mesh: &Mesh, cut: &Cut) -> Vec<f64> {
    let tree = Bvh::new(&cut.mesh.positions, &cut.mesh.faces);
    let distance = |p: &DVec3| tree.closest(*p, f64::INFINITY).map_or(f64::NAN, |hit| hit.distance);
    mesh.positions.par_iter().map(distance).collect()
}

/// A row for each class and number of faces: a close look at that class alone, with its edges.
fn by_class(mesh: &Mesh, classes: &Classes, experiment: &Experiment) -> RgbImage {
    let mut panels = Vec::new();
    for class in classes.scheme.ids() {
        let Some(part) = close_part(mesh, classes, class) else { continue };
        let corners = part_points(mesh, classes, class, &part);
        let view = View::oblique(&corners, AZIMUTH_DEG, ELEVATION_DEG, SMALL_PX);
        for share in asked(experiment) {
            for shown in shown(mesh, classes, experiment.cuts.iter().filter(|c| c.asked == share)) {
                let faces = faces_of(&shown, class, &part);
                let title = format!("{}: {}", classes.scheme[class].name, shown.title);
                let picture = wired(&view, shown.positions, &faces, &classes.scheme, class);
                panels.push(Panel { title, picture, legend: None });
            }
        }
    }
    grid("", &panels, experiment.curves.len() + 1, None, TEXT_SCALE)
}

/// The part of the plan with the most area of a class.
fn close_part(mesh: &Mesh, classes: &Classes, class: ClassId) -> Option<Aabb> {
    let of_class = || (0..mesh.faces.len()).filter(|&f| classes.label[f] == class);
    let bounds = Aabb::of(of_class().flat_map(|f| mesh.corners(f)));
    if bounds.is_empty() {
        return None;
    }
    let step = (bounds.size() / CELLS as f64).truncate().max(glam::DVec2::splat(f64::MIN_POSITIVE));
    let mut area = [0.0; CELLS * CELLS];
    for f in of_class() {
        let at = ((middle(&mesh.corners(f)) - bounds.min).truncate() / step).as_uvec2();
        let [x, y] = at.to_array().map(|i| (i as usize).min(CELLS - 1));
        area[y * CELLS + x] += mesh.cross(f).length();
    }
    // The first of equals.
    let most = (0..area.len()).rev().max_by(|a, b| area[*a].total_cmp(&area[*b]))?;
    let low = bounds.min.truncate() + step * glam::DVec2::new((most % CELLS) as f64, (most / CELLS) as f64);
    Some(Aabb { min: low.extend(bounds.min.z), max: (low + step).extend(bounds.max.z) })
}

fn middle(corners: &[DVec3; 3]) -> DVec3 {
    (corners[0] + corners[1] + corners[2]) / 3.0
}

fn is_in_plan(p: DVec3, part: &Aabb) -> bool {
    p.x >= part.min.x && p.x <= part.max.x && p.y >= part.min.y && p.y <= part.max.y
}

/// Corners of the source's faces of a class in the part.
fn part_points(mesh: &Mesh, classes: &Classes, class: ClassId, part: &Aabb) -> Vec<DVec3> {
    let faces = (0..mesh.faces.len()).filter(|&f| classes.label[f] == class);
    faces.map(|f| mesh.corners(f)).filter(|c| is_in_plan(middle(c), part)).flatten().collect()
}

/// Faces of a class that reach into the part: those of a cut are larger than it may be.
fn faces_of(shown: &Shown, class: ClassId, part: &Aabb) -> Vec<[u32; 3]> {
    let touches = |face: &[u32; 3]| {
        let corners = face.map(|v| shown.positions[v as usize]);
        let own = Aabb::of(corners);
        own.min.x <= part.max.x && own.max.x >= part.min.x && own.min.y <= part.max.y && own.max.y >= part.min.y
    };
    let of_class = shown.faces.iter().zip(shown.labels).filter(|(_, l)| **l == class);
    of_class.map(|(face, _)| *face).filter(touches).collect()
}

/// Faces of one colour with their edges darker.
fn wired(view: &View, positions: &[DVec3], faces: &[[u32; 3]], scheme: &ClassScheme, class: ClassId) -> RgbImage {
    let seen = Seen::of(&view.enlarged(2), positions, faces);
    let paint = class_color(scheme, class);
    let shade = |hit: &Hit| {
        let [a, b, c] = faces[hit.face as usize].map(|v| positions[v as usize]);
        let twice_area = (b - a).cross(c - a).length();
        let edges = [(c - b).length(), (a - c).length(), (b - a).length()];
        let from_edge_m = (0..3).map(|k| hit.weights[k] * twice_area / edges[k]).fold(f64::INFINITY, f64::min);
        // Half of the line lies on either face.
        let is_edge = from_edge_m < EDGE_PX / 2.0 * view.m_per_px(hit.depth_m);
        lit(paint, if is_edge { hit.light * EDGE_LIGHT } else { hit.light })
    };
    let picture = color(&seen, positions, faces, shade);
    if seen.view() == view { picture } else { halved(&picture) }
}
