//! Labels that somebody gave, brought onto the mesh of a run: as truth, or instead of a classifier.

use glam::DVec3;
use rayon::prelude::*;

use crate::classes::truth::{Mask, mask_among, mask_of_name};
use crate::geo::Frame;
use crate::geo::bvh::Bvh;
use crate::ids::{ClassId, ClassScheme};
use crate::input::label_names::Names;
use crate::input::{Material, Source};
use crate::mesh::Mesh;
use crate::{Error, Result};

/// Where labels come from.
#[derive(Debug, Clone)]
pub enum LabelSource {
    /// The input itself: labels of its faces, else the names of its materials.
    Input(Names),
    /// Another surface at the same place, in the same coordinates.
    File(Box<Source>, Names),
}

impl LabelSource {
    /// Tells labels apart: a digest of all that can change a class.
    pub(super) fn digest(&self) -> String {
        let mut hash = blake3::Hasher::new();
        let mut text = |text: &str| {
            hash.update(&(text.len() as u64).to_le_bytes());
            hash.update(text.as_bytes());
        };
        let (Self::Input(names) | Self::File(_, names)) = self;
        names.iter().for_each(|(label, name)| text(&format!("{label} {name}")));
        if let Self::File(source, _) = self {
            source.materials.iter().for_each(|m| text(&m.name));
            for part in &source.parts {
                hash.update(bytemuck::cast_slice(&part.positions));
                hash.update(bytemuck::cast_slice(&part.faces));
                hash.update(bytemuck::cast_slice(&part.face_material));
                hash.update(bytemuck::cast_slice(&part.face_labels));
            }
        }
        hash.finalize().to_hex().to_string()
    }
}

/// A face of ours takes the label of the nearest labelled face within this many median edges, and 0.1 m.
const REACH_EDGES: f64 = 2.0;
/// Above this z of its normal a face of a `building` without further word is roof, and below it wall: 17° from upright.
const UPRIGHT: f64 = 0.3;

/// Labels ready to be brought onto meshes.
pub struct Given<'a> {
    from: &'a LabelSource,
    nearest: Option<Labelled>,
}

impl<'a> Given<'a> {
    /// Takes labels to the local frame.
    ///
    /// # Errors
    /// Those of a frame that does not reach the labels.
    pub fn of(from: &'a LabelSource, frame: &Frame, scheme: &ClassScheme) -> Result<Self> {
        let nearest = match from {
            LabelSource::Input(_) => None,
            LabelSource::File(source, names) => Some(Labelled::of(source, names, frame, scheme)?),
        };
        Ok(Self { from, nearest })
    }

    /// The classes each face of `mesh` may have, 0 where nobody says.
    pub fn masks(&self, mesh: &Mesh, median_edge_m: f64, scheme: &ClassScheme) -> Vec<Mask> {
        match (&self.nearest, self.from) {
            (Some(labelled), _) => labelled.masks(mesh, median_edge_m),
            (None, LabelSource::Input(names) | LabelSource::File(_, names)) => {
                let faces = Faces {
                    labels: &mesh.face_labels,
                    materials: &mesh.materials,
                    face_material: &mesh.face_material,
                    names,
                };
                (0..mesh.faces.len()).map(|f| faces.mask(scheme, f, mesh.cross(f))).collect()
            }
        }
    }

    /// What to say where no face got a label; `materials` are the input's.
    pub fn nothing(&self, materials: &[Material], scheme: &ClassScheme) -> Error {
        let found: Vec<String> = match self.from {
            LabelSource::Input(names) => known(names, materials),
            LabelSource::File(source, names) => known(names, &source.materials),
        };
        let classes: Vec<&str> = scheme.0.iter().map(|c| c.name.as_str()).collect();
        Error::Config(format!(
            "no face gets a label: found the names {}; wanted those of the classes ({}) or of SUM, CityGML, 3dfier, at \
             the place of the input",
            found.join(", "),
            classes.join(", ")
        ))
    }
}

/// The classes each face of `mesh` may have, 0 where nobody says.
///
/// # Errors
/// [`Error::Config`] when nothing is labelled; those of a frame that does not reach the labels.
pub fn masks(
    from: &LabelSource,
    mesh: &Mesh,
    median_edge_m: f64,
    frame: &Frame,
    scheme: &ClassScheme,
) -> Result<Vec<Mask>> {
    let given = Given::of(from, frame, scheme)?;
    let masks = given.masks(mesh, median_edge_m, scheme);
    if masks.iter().all(|m| *m == 0) { Err(given.nothing(&mesh.materials, scheme)) } else { Ok(masks) }
}

fn known(names: &Names, materials: &[Material]) -> Vec<String> {
    names.iter().map(|n| n.1.clone()).chain(materials.iter().map(|m| m.name.clone())).take(12).collect()
}

/// What is known of the faces of a surface.
struct Faces<'a> {
    labels: &'a [i16],
    materials: &'a [Material],
    face_material: &'a [u32],
    names: &'a Names,
}

impl Faces<'_> {
    fn mask(&self, scheme: &ClassScheme, f: usize, cross: DVec3) -> Mask {
        if let Some(label) = self.labels.get(f) {
            let name = self.names.iter().find(|n| n.0 == *label);
            let all: Vec<&str> = self.names.iter().map(|n| n.1.as_str()).collect();
            return name.map_or(0, |n| mask_among(scheme, &n.1, &all));
        }
        let material = self.face_material.get(f).and_then(|m| self.materials.get(*m as usize));
        let Some(material) = material else { return 0 };
        let mask = mask_of_name(scheme, &material.name);
        let (facade, roof) = (mask_of_name(scheme, "facade"), mask_of_name(scheme, "roof"));
        if mask != facade | roof || facade == roof {
            return mask;
        }
        // A material `Building` on a clean model: its normal says which part.
        match cross.normalize_or_zero().z {
            z if z > UPRIGHT => roof,
            z if z < -UPRIGHT => 0,
            _ => facade,
        }
    }
}

/// One class for each face of `mesh` by the numbers on its faces alone: a building that is not told apart is façade or
/// roof by its normal, and what has no label is clutter.
///
/// # Errors
/// [`Error::Config`] for a number without a name.
pub fn classes_of_labels(mesh: &Mesh, names: &Names, scheme: &ClassScheme) -> Result<Vec<ClassId>> {
    let unknown = |label: &&i16| **label != -1 && names.iter().all(|n| n.0 != **label);
    if let Some(label) = mesh.face_labels.iter().find(unknown) {
        let named: Vec<String> = names.iter().map(|n| format!("{} {}", n.0, n.1)).collect();
        let what = format!("a triangle has the label {label}; wanted one of {}, or -1 for none", named.join(", "));
        return Err(Error::Config(what));
    }
    let faces = Faces { labels: &mesh.face_labels, materials: &[], face_material: &[], names };
    let [facade, roof, clutter] = ["facade", "roof", "clutter"].map(|name| mask_of_name(scheme, name));
    let class = |f: usize| {
        let cross = mesh.cross(f);
        let mask = match faces.mask(scheme, f, cross) {
            0 => clutter,
            mask if mask & facade != 0 && mask & roof != 0 => {
                if cross.normalize_or_zero().z > UPRIGHT {
                    roof
                } else {
                    facade
                }
            }
            mask => mask,
        };
        ClassId(mask.trailing_zeros().min(scheme.len() as u32 - 1) as u8)
    };
    Ok((0..mesh.faces.len()).map(class).collect())
}

/// Another surface, with what may be said of each of its faces.
struct Labelled {
    tree: Bvh,
    masks: Vec<Mask>,
}

impl Labelled {
    fn of(source: &Source, names: &Names, frame: &Frame, scheme: &ClassScheme) -> Result<Self> {
        let (mut positions, mut faces, mut masks) = (Vec::new(), Vec::new(), Vec::new());
        for part in &source.parts {
            let first = positions.len();
            if first + part.positions.len() >= u32::MAX as usize {
                let what = "has too many vertices for one set of labels; label the input in parts".into();
                return Err(Error::Limit { path: part.path.clone(), what });
            }
            positions.extend_from_slice(&part.positions);
            frame.locals_from_sources(&part.path, &mut positions[first..])?;
            let own = Faces {
                labels: &part.face_labels,
                materials: &source.materials,
                face_material: &part.face_material,
                names,
            };
            for (f, face) in part.faces.iter().enumerate() {
                let face = face.map(|v| v + first as u32);
                let [a, b, c] = face.map(|v| positions[v as usize]);
                let mask = own.mask(scheme, f, (b - a).cross(c - a));
                faces.push(face);
                masks.push(mask);
            }
        }
        Ok(Self { tree: Bvh::new(&positions, &faces), masks })
    }

    /// By the nearest face.
    fn masks(&self, mesh: &Mesh, median_edge_m: f64) -> Vec<Mask> {
        let reach = (REACH_EDGES * median_edge_m).max(0.1);
        let of_face = |f: usize| {
            let [a, b, c] = mesh.corners(f);
            self.tree.closest((a + b + c) / 3.0, reach).map_or(0, |hit| self.masks[hit.face as usize])
        };
        (0..mesh.faces.len()).into_par_iter().with_min_len(1024).map(of_face).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_building_is_roof_or_facade_by_its_normal_and_an_unknown_number_is_named() {
        let positions = vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        let faces = vec![[0, 1, 2], [0, 2, 3], [0, 1, 3], [0, 1, 2]];
        let mut mesh = Mesh { positions, faces, face_labels: vec![3, 3, 1, -1], ..Mesh::default() };
        let scheme = ClassScheme::default();
        let names = crate::input::label_names::names(&[]).unwrap();
        let found = classes_of_labels(&mesh, &names, &scheme).unwrap();
        assert_eq!(found, [ClassId::ROOF, ClassId::FACADE, ClassId::TERRAIN, ClassId::CLUTTER]);
        mesh.face_labels[2] = 9;
        let error = classes_of_labels(&mesh, &names, &scheme).unwrap_err().to_string();
        assert!(error.contains("label 9") && error.contains("3 building"), "{error}");
    }
}
