//! The paper's Figures 2 to 4 of any input: features from blue to red, regions, classes.

use std::path::Path;

use crate::classes::Classes;
use crate::classes::nine::{FEATURES, Form, Measures, NINE};
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
const FEATURE_PX: [u32; 2] = [480, 360];
const LARGE_PX: [u32; 2] = [1200, 900];
/// From the south-west, as high as the paper's figures look.
const AZIMUTH_DEG: f64 = 215.0;
const ELEVATION_DEG: f64 = 38.0;
/// Share of the values at either end that a scale leaves out.
const CUT: f64 = 0.02;

/// Writes `features.png` (the paper's Figure 3), `regions.png` (Figure 2) and `classes.png` (Figure 4) into a folder,
/// which is made; returns their names.
///
/// # Errors
/// [`Error::Io`] if the disk refuses.
pub fn write(front: &Front, measures: &Measures, classes: &Classes, form: Form, folder: &Path) -> Result<Vec<String>> {
    std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    let mesh = &front.mesh;
    let mut names = Vec::new();
    let mut put = |name: &str, picture: &image::RgbImage| {
        names.push(name.to_owned());
        png::write(picture, &folder.join(name))
    };
    let view = View::oblique(&mesh.positions, AZIMUTH_DEG, ELEVATION_DEG, FEATURE_PX);
    let panels: Vec<Panel> = FEATURES[..NINE]
        .iter()
        .zip('b'..)
        .map(|(feature, letter)| {
            let values = measures.of_vertices(feature.name, form).unwrap_or_default();
            let values: Vec<f64> = values.into_iter().map(f64::from).collect();
            let scale = scale(&values, feature.unit);
            Panel {
                title: format!("({letter}) {}", feature.name.replace('_', " ")),
                picture: render(&view, &mesh.positions, &mesh.faces, Paint::VertexValues(&values, &scale)),
                legend: Some(Legend::Scale(scale)),
            }
        })
        .collect();
    put("features.png", &grid("", &panels, 3, None, 2))?;

    let view = View::oblique(&mesh.positions, AZIMUTH_DEG, ELEVATION_DEG, LARGE_PX);
    let painted = |colors: &[[u8; 3]]| render(&view, &mesh.positions, &mesh.faces, Paint::Faces(colors));
    put("regions.png", &painted(&face_colors(front, measures, classes, form, "region")))?;
    let picture = painted(&face_colors(front, measures, classes, form, "class"));
    let title = String::new();
    let legend = Some(Legend::of_classes(&classes.scheme));
    put("classes.png", &grid("", &[Panel { title, picture, legend }], 1, None, 2))?;
    if !front.face_colors.is_empty() {
        put("input.png", &painted(&front.face_colors))?;
    }
    Ok(names)
}

/// Blue to red without the outliers. Features that grow without bound are seen on a logarithmic scale.
fn scale(values: &[f64], unit: &str) -> Scale {
    let mut scale = Scale::over(Ramp::BlueRed, values, CUT, unit);
    if scale.low > 0.0 && scale.high > 1e3 * scale.low {
        scale.log = true;
    }
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
            let scale = scale(&values, "");
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
