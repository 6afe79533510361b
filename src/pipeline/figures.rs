//! The paper's Figures 2 to 4 of any input: features from blue to red, regions, classes.

use std::path::Path;

use image::RgbImage;

use crate::classes::Classes;
use crate::classes::nine::{FEATURES, Form, Measures, NINE, range};
use crate::draw::panel::{Legend, Panel, grid};
use crate::draw::png;
use crate::draw::ramp::{NO_DATA, Ramp, Scale, class_color, region_color};
use crate::draw::shade::{Paint, render};
use crate::draw::view::View;
use crate::mesh::{Mesh, topology};
use crate::pipeline::Front;
use crate::planes::NONE;
use crate::{Error, Result};

/// Pictures are this large, pixels.
const FEATURE_PX: [u32; 2] = [420, 315];
const LARGE_PX: [u32; 2] = [1000, 750];
/// From the south-west, as high as the paper's figures look.
const AZIMUTH_DEG: f64 = 215.0;
const ELEVATION_DEG: f64 = 38.0;
/// Share of the values at either end that a scale leaves out.
const CUT: f64 = 0.02;
/// sRGB of an input without colours.
const BARE: [u8; 3] = [190, 190, 186];

/// Writes `features.png` (the paper's Figure 3), `regions.png` (Figure 2) and `classes.png` (Figure 4), each beside the
/// input, into a folder, which is made; returns their names.
///
/// # Errors
/// [`Error::Io`] if the disk refuses.
pub fn write(front: &Front, measures: &Measures, classes: &Classes, form: Form, folder: &Path) -> Result<Vec<String>> {
    std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    let features = features(front, measures, form);
    let of = |what: &str| face_colors(front, measures, classes, form, what);
    let legend = Legend::of_classes(&classes.scheme);
    let mut names = Vec::new();
    for (name, picture) in [
        ("features.png", features),
        ("regions.png", beside_input(front, "planar regions", &of("region"), None)),
        ("classes.png", beside_input(front, "classes", &of("class"), Some(legend))),
    ] {
        png::write(&picture, &folder.join(name))?;
        names.push(name.to_owned());
    }
    Ok(names)
}

/// The input and the nine features, blue to red.
fn features(front: &Front, measures: &Measures, form: Form) -> RgbImage {
    let mesh = &front.mesh;
    let view = View::oblique(&mesh.positions, AZIMUTH_DEG, ELEVATION_DEG, FEATURE_PX);
    let mut panels = vec![Panel { title: "(a) input".into(), picture: input(front, &view), legend: None }];
    panels.extend(FEATURES[..NINE].iter().zip('b'..).map(|(feature, letter)| {
        let values = measures.of_vertices(feature.name, form).unwrap_or_default();
        let values: Vec<f64> = values.into_iter().map(f64::from).collect();
        let scale = scale(&values, feature.name, feature.unit, form);
        Panel {
            title: format!("({letter}) {}", feature.name.replace('_', " ")),
            picture: render(&view, &mesh.positions, &mesh.faces, Paint::VertexValues(&values, &scale)),
            legend: Some(Legend::Scale(scale)),
        }
    }));
    grid("", &panels, 5, None, 2)
}

fn beside_input(front: &Front, title: &str, colors: &[[u8; 3]], legend: Option<Legend>) -> RgbImage {
    let mesh = &front.mesh;
    let view = View::oblique(&mesh.positions, AZIMUTH_DEG, ELEVATION_DEG, LARGE_PX);
    let picture = render(&view, &mesh.positions, &mesh.faces, Paint::Faces(colors));
    let left = Panel { title: "input".into(), picture: input(front, &view), legend: None };
    grid("", &[left, Panel { title: title.into(), picture, legend }], 2, None, 2)
}

/// The input by the mean colours of its faces.
fn input(front: &Front, view: &View) -> RgbImage {
    let colors = &front.face_colors;
    let paint = if colors.is_empty() { Paint::Solid(BARE) } else { Paint::Faces(colors) };
    render(view, &front.mesh.positions, &front.mesh.faces, paint)
}

/// Blue to red without the outliers; logarithmic for the pure numbers that have no bound, Eq. 7 and 8 as printed.
fn scale(values: &[f64], name: &str, unit: &str, form: Form) -> Scale {
    let mut scale = Scale::over(Ramp::BlueRed, values, CUT, unit);
    let is_bounded = range(name, form).is_none_or(|[_, high]| high.is_finite());
    scale.log = !is_bounded && unit.is_empty() && scale.low > 0.0;
    scale
}

/// A colour per face: `class`, `region`, or a feature's name.
pub fn face_colors(front: &Front, measures: &Measures, classes: &Classes, form: Form, what: &str) -> Vec<[u8; 3]> {
    match what {
        "class" => classes.label.iter().map(|label| class_color(&classes.scheme, *label)).collect(),
        "region" => {
            let color = |r: &u32| if *r == NONE { NO_DATA } else { region_color(*r) };
            front.planes.face_region.iter().map(color).collect()
        }
        feature => {
            let values = measures.of_faces(feature, form).unwrap_or_else(|| vec![f32::NAN; front.mesh.faces.len()]);
            let values: Vec<f64> = values.into_iter().map(f64::from).collect();
            let scale = scale(&values, feature, "", form);
            values.iter().map(|v| scale.color(*v)).collect()
        }
    }
}

/// The value of the largest face around each vertex; 0 for a vertex of no face.
pub fn vertex_values(mesh: &Mesh, of_faces: &[f32]) -> Vec<f32> {
    strongest(mesh).iter().map(|face| face.map_or(0.0, |f| of_faces[f])).collect()
}

/// The colour of the largest face around each vertex: colours that stand for something must not be mixed.
pub fn vertex_colors(mesh: &Mesh, of_faces: &[[u8; 3]]) -> Vec<[u8; 3]> {
    strongest(mesh).iter().map(|face| face.map_or(NO_DATA, |f| of_faces[f])).collect()
}

/// The largest face around each vertex, the first of equals.
fn strongest(mesh: &Mesh) -> Vec<Option<usize>> {
    let around = topology::vertex_faces(mesh);
    let area = |f: usize| mesh.cross(f).length();
    let largest = |v: usize| {
        let faces = around.of_vertex(v).iter().map(|f| *f as usize);
        faces.reduce(|best, f| if area(f) > area(best) { f } else { best })
    };
    (0..mesh.positions.len()).map(largest).collect()
}
