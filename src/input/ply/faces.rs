//! The face element: polygons with wedge coordinates, texture numbers and labels, cut into triangles.

use std::path::Path;

use glam::{DVec3, Vec2};

use super::body::{Body, Broken};
use super::header::{Element, Kind, Type};
use super::vertices::{Vertices, label, label_name, v_down};
use crate::input::triangulate::Triangulator;
use crate::report::Reporter;

/// What a column of a face row is for.
#[derive(Debug, Clone, Copy)]
enum Role {
    Corners,
    Wedges,
    Texture,
    Label,
    Other,
}

/// Which columns of a face row go where.
pub struct Plan {
    steps: Vec<(Kind, Role)>,
    pub has_wedges: bool,
    pub has_labels: bool,
}

impl Plan {
    /// `None` if there is no list of vertex indices.
    pub fn of(element: &Element) -> Option<Self> {
        let label = label_name(element);
        let role = |name: &str, kind| match (name, kind) {
            ("vertex_indices" | "vertex_index", Kind::List { .. }) => Role::Corners,
            ("texcoord", Kind::List { .. }) => Role::Wedges,
            ("texnumber", Kind::Scalar(_)) => Role::Texture,
            (name, Kind::Scalar(_)) if Some(name) == label => Role::Label,
            _ => Role::Other,
        };
        let steps: Vec<_> = element.properties.iter().map(|p| (p.kind, role(&p.name, p.kind))).collect();
        let has = |wanted: fn(&Role) -> bool| steps.iter().any(|(_, role)| wanted(role));
        let has_wedges = has(|role| matches!(role, Role::Wedges));
        let has_labels = has(|role| matches!(role, Role::Label));
        has(|role| matches!(role, Role::Corners)).then_some(Self { steps, has_wedges, has_labels })
    }
}

/// One row, reused from row to row.
#[derive(Debug, Default)]
struct Row {
    corners: Vec<u32>,
    wedges: Vec<f64>,
    texture: Option<f64>,
    label: Option<i16>,
}

/// Triangles so far, and what was wrong with some.
pub struct Faces<'a> {
    vertices: &'a Vertices,
    texture_count: usize,
    has_uvs: bool,
    has_labels: bool,
    row: Row,
    points: Vec<DVec3>,
    cut: Vec<[u32; 3]>,
    triangulator: Triangulator,
    crossed: u64,
    pub corners: Vec<[u32; 3]>,
    /// Empty if nothing is textured.
    pub uvs: Vec<[Vec2; 3]>,
    /// Texture per face; the texture count stands for none.
    pub textures: Vec<u32>,
    /// Empty if there are none.
    pub labels: Vec<i16>,
    short: u64,
    bad_vertex: u64,
    bad_wedges: u64,
    bad_uv: u64,
}

impl<'a> Faces<'a> {
    /// For `texture_count` textures; `with_wedges` and `with_labels` as the face element has them.
    pub fn new(vertices: &'a Vertices, texture_count: usize, with_wedges: bool, with_labels: bool) -> Self {
        Self {
            vertices,
            texture_count,
            has_uvs: texture_count > 0 && (with_wedges || !vertices.uvs.is_empty()),
            has_labels: with_labels || !vertices.labels.is_empty(),
            row: Row::default(),
            points: Vec::new(),
            cut: Vec::new(),
            triangulator: Triangulator::default(),
            crossed: 0,
            corners: Vec::new(),
            uvs: Vec::new(),
            textures: Vec::new(),
            labels: Vec::new(),
            short: 0,
            bad_vertex: 0,
            bad_wedges: 0,
            bad_uv: 0,
        }
    }

    /// Makes room for `count` triangles.
    pub fn reserve(&mut self, count: usize) {
        self.corners.reserve(count);
        self.textures.reserve(count);
        self.uvs.reserve(if self.has_uvs { count } else { 0 });
        self.labels.reserve(if self.has_labels { count } else { 0 });
    }

    /// Reads the next row of a face element.
    pub fn read<B: Body>(&mut self, body: &mut B, plan: &Plan) -> Result<(), Broken> {
        body.begin_row()?;
        self.row.corners.clear();
        self.row.wedges.clear();
        (self.row.texture, self.row.label) = (None, None);
        for &(kind, role) in &plan.steps {
            match (role, kind) {
                (Role::Corners, Kind::List { length, item }) => {
                    for _ in 0..body.length(length)? {
                        let corner = self.index(body, item)?;
                        self.row.corners.push(corner);
                    }
                }
                (Role::Wedges, Kind::List { length, item }) => {
                    for _ in 0..body.length(length)? {
                        self.row.wedges.push(body.number(item)?);
                    }
                }
                (Role::Texture, Kind::Scalar(kind)) => self.row.texture = Some(body.number(kind)?),
                (Role::Label, Kind::Scalar(kind)) => self.row.label = Some(label(body.number(kind)?)),
                (_, Kind::Scalar(kind)) => body.skip(kind, 1)?,
                (_, Kind::List { length, item }) => {
                    let length = body.length(length)?;
                    body.skip(item, length)?;
                }
            }
        }
        self.polygon(plan.has_wedges);
        Ok(())
    }

    /// Reads a strip, or several ended by -1, of which every other triangle is wound the other way round.
    pub fn read_strip<B: Body>(&mut self, body: &mut B, element: &Element) -> Result<(), Broken> {
        body.begin_row()?;
        for property in &element.properties {
            match property.kind {
                Kind::List { length, item } if property.name == "vertex_indices" => self.strip(body, length, item)?,
                Kind::List { length, item } => {
                    let length = body.length(length)?;
                    body.skip(item, length)?;
                }
                Kind::Scalar(kind) => body.skip(kind, 1)?,
            }
        }
        Ok(())
    }

    fn strip<B: Body>(&mut self, body: &mut B, length: Type, item: Type) -> Result<(), Broken> {
        self.row = Row::default();
        let (mut last, mut seen) = ([0; 2], 0u64);
        for _ in 0..body.length(length)? {
            let value = body.number(item)?;
            if value == -1.0 {
                seen = 0;
                continue;
            }
            let corner = self.checked(value)?;
            seen += 1;
            let [a, b] = last;
            let face = if seen % 2 == 1 { [a, b, corner] } else { [b, a, corner] };
            if seen > 2 && a != b && b != corner && corner != a {
                self.row.corners.clear();
                self.row.corners.extend(face);
                self.polygon(false);
            }
            last = [b, corner];
        }
        Ok(())
    }

    fn index<B: Body>(&self, body: &mut B, kind: Type) -> Result<u32, Broken> {
        let value = body.number(kind)?;
        self.checked(value)
    }

    fn checked(&self, value: f64) -> Result<u32, Broken> {
        let is_vertex = value >= 0.0 && value < self.vertices.positions.len() as f64 && value.fract() == 0.0;
        if is_vertex { Ok(value as u32) } else { Err(Broken::Index(value)) }
    }

    /// Cuts the row's polygon into triangles.
    fn polygon(&mut self, with_wedges: bool) {
        let Row { corners, wedges, texture, label } = &self.row;
        if corners.len() < 3 {
            self.short += 1;
            return;
        }
        let point = |&corner: &u32| self.vertices.positions[corner as usize];
        if !corners.iter().all(|corner| point(corner).is_finite()) {
            self.bad_vertex += corners.len() as u64 - 2;
            return;
        }
        self.cut.clear();
        if corners.len() == 3 {
            self.cut.push([0, 1, 2]);
        } else {
            self.points.clear();
            self.points.extend(corners.iter().map(point));
            self.crossed += u64::from(!self.triangulator.cut(&self.points, &mut self.cut));
        }

        let wedges = if !with_wedges || wedges.len() == 2 * corners.len() { &wedges[..] } else { &[] };
        if with_wedges && !self.row.wedges.is_empty() && wedges.is_empty() {
            self.bad_wedges += 1;
        }
        let is_laid = self.has_uvs && if with_wedges { !wedges.is_empty() } else { !self.vertices.uvs.is_empty() };
        let wanted = texture.unwrap_or(0.0);
        let is_textured = is_laid && wanted >= 0.0 && wanted < self.texture_count as f64;
        let texture = if is_textured { wanted as usize } else { self.texture_count };
        for triangle in &self.cut {
            let triangle = triangle.map(|corner| corner as usize);
            let face = triangle.map(|corner| corners[corner]);
            self.corners.push(face);
            self.textures.push(texture as u32);
            if self.has_uvs {
                let mut uv = |corner: usize| {
                    let uv = match (is_textured, with_wedges) {
                        (false, _) => Vec2::ZERO,
                        (true, true) => v_down(wedges[2 * corner], wedges[2 * corner + 1]),
                        (true, false) => self.vertices.uvs[corners[corner] as usize],
                    };
                    self.bad_uv += u64::from(!uv.is_finite());
                    if uv.is_finite() { uv } else { Vec2::ZERO }
                };
                self.uvs.push(triangle.map(&mut uv));
            }
            if self.has_labels {
                let by_vertex = || self.vertices.labels.get(face[0] as usize).is_some();
                let found = label.unwrap_or_else(|| if by_vertex() { self.majority(face) } else { -1 });
                self.labels.push(found);
            }
        }
    }

    fn majority(&self, face: [u32; 3]) -> i16 {
        majority(face.map(|vertex| self.vertices.labels[vertex as usize]))
    }

    /// Tells what was dropped.
    pub fn report(&self, path: &Path, reporter: &Reporter) {
        reporter.warn_many(
            "bad-polygon",
            path,
            self.crossed,
            "a polygon crosses itself or has no area; it is covered as well as may be",
        );
        reporter.warn_many("short-polygon", path, self.short, "a face with fewer than three corners was dropped");
        let what = "a position is not finite; the faces that use it were dropped";
        reporter.warn_many("bad-vertex", path, self.bad_vertex, what);
        let what = "a face has another number of texture coordinates than corners; it is untextured";
        reporter.warn_many("bad-texcoord", path, self.bad_wedges, what);
        reporter.warn_many("bad-uv", path, self.bad_uv, "a texture coordinate is not finite; (0, 0) is used");
    }
}

/// The label two corners share; of three different ones the least that is known (not negative).
fn majority(labels: [i16; 3]) -> i16 {
    let [a, b, c] = labels;
    if a == b || a == c {
        a
    } else if b == c {
        b
    } else {
        labels.into_iter().filter(|&label| label >= 0).min().unwrap_or(-1)
    }
}

#[cfg(test)]
mod tests {
    use super::majority;

    #[test]
    fn corners_vote_and_a_tie_goes_to_the_least_known_label() {
        assert_eq!(majority([2, 3, 3]), 3);
        assert_eq!(majority([3, 2, 3]), 3);
        assert_eq!(majority([-1, -1, 3]), -1);
        assert_eq!(majority([5, -1, 3]), 3);
    }
}
