//! The vertex element: positions, colours, texture coordinates, labels.

use glam::{DVec3, Vec2};

use super::body::{Body, Broken};
use super::header::{Element, Kind, Type};

/// Columns of the vertex element; each that is not there is empty.
#[derive(Debug, Default)]
pub struct Vertices {
    pub positions: Vec<DVec3>,
    pub colors: Vec<[u8; 3]>,
    pub uvs: Vec<Vec2>,
    pub labels: Vec<i16>,
}

const SLOTS: usize = 9;
const XYZ: usize = 0;
const RGB: usize = 3;
const UV: usize = 6;
const LABEL: usize = 8;

/// Names a group of columns goes by; the first group that is there whole is taken.
const COLOR_NAMES: [[&str; 3]; 3] =
    [["red", "green", "blue"], ["diffuse_red", "diffuse_green", "diffuse_blue"], ["r", "g", "b"]];
const UV_NAMES: [[&str; 2]; 4] = [["s", "t"], ["u", "v"], ["texture_u", "texture_v"], ["texture_s", "texture_t"]];

/// Which columns of a vertex row go where.
pub struct Plan {
    steps: Vec<(Kind, Option<usize>)>,
    color_kind: Option<[Type; 3]>,
    has_uvs: bool,
    has_labels: bool,
}

impl Plan {
    /// `None` if x, y or z are missing.
    pub fn of(element: &Element) -> Option<Self> {
        let has = |name: &&str| element.scalar(name).is_some();
        let colors = COLOR_NAMES.iter().find(|names| names.iter().all(has));
        let uvs = UV_NAMES.iter().find(|names| names.iter().all(has));
        let label = label_name(element);
        let mut slots: Vec<(&str, usize)> = vec![("x", XYZ), ("y", XYZ + 1), ("z", XYZ + 2)];
        if !slots.iter().all(|(name, _)| has(name)) {
            return None;
        }
        slots.extend(colors.into_iter().flatten().copied().zip(RGB..));
        slots.extend(uvs.into_iter().flatten().copied().zip(UV..));
        slots.extend(label.map(|name| (name, LABEL)));
        let slot = |name: &str| slots.iter().find(|(wanted, _)| *wanted == name).map(|&(_, slot)| slot);
        let color_kind = colors.map(|names| names.map(|name| element.scalar(name).unwrap_or(Type::U8)));
        let steps = element.properties.iter().map(|p| (p.kind, slot(&p.name))).collect();
        Some(Self { steps, color_kind, has_uvs: uvs.is_some(), has_labels: label.is_some() })
    }

    /// Reads the next row into `vertices`.
    pub fn read<B: Body>(&self, body: &mut B, vertices: &mut Vertices) -> Result<(), Broken> {
        body.begin_row()?;
        let mut row = [0.0; SLOTS];
        for &(kind, slot) in &self.steps {
            match (kind, slot) {
                (Kind::Scalar(kind), Some(slot)) => row[slot] = body.number(kind)?,
                (Kind::Scalar(kind), None) => body.skip(kind, 1)?,
                (Kind::List { length, item }, _) => {
                    let length = body.length(length)?;
                    body.skip(item, length)?;
                }
            }
        }
        vertices.positions.push(DVec3::new(row[XYZ], row[XYZ + 1], row[XYZ + 2]));
        if let Some(kinds) = self.color_kind {
            vertices.colors.push(std::array::from_fn(|k| color(row[RGB + k], kinds[k])));
        }
        if self.has_uvs {
            vertices.uvs.push(v_down(row[UV], row[UV + 1]));
        }
        if self.has_labels {
            vertices.labels.push(label(row[LABEL]));
        }
        Ok(())
    }
}

/// The property that holds a class: `label`, a name for it, or CloudCompare's `scalar_…`.
pub fn label_name(element: &Element) -> Option<&str> {
    const NAMES: [&str; 5] = ["label", "labels", "class", "classification", "class_id"];
    let scalars = || element.properties.iter().filter(|p| matches!(p.kind, Kind::Scalar(_))).map(|p| p.name.as_str());
    let is_scalar_field = |name: &&str| {
        let field = name.strip_prefix("scalar_").unwrap_or_default();
        (field.contains("label") || field.contains("class")) && !field.contains("prob")
    };
    NAMES.iter().find_map(|wanted| scalars().find(|name| name == wanted)).or_else(|| scalars().find(is_scalar_field))
}

/// A label as found; -1 (unknown) for what is no 16-bit number.
pub fn label(value: f64) -> i16 {
    let rounded = value.round();
    if rounded >= f64::from(i16::MIN) && rounded <= f64::from(i16::MAX) { rounded as i16 } else { -1 }
}

/// PLY's v runs up; ours down.
pub fn v_down(u: f64, v: f64) -> Vec2 {
    Vec2::new(u as f32, (1.0 - v) as f32)
}

/// A colour component as 8 bits: floats run from 0 to 1, 16-bit integers to 65535, others to 255.
fn color(value: f64, kind: Type) -> u8 {
    let scale = match kind {
        Type::F32 | Type::F64 => 255.0,
        Type::U16 => 255.0 / 65535.0,
        _ => 1.0,
    };
    // A cast saturates, and NaN becomes 0.
    (value * scale).round() as u8
}
