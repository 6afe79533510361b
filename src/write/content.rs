//! What a tile holds, its order for the GPU, and the grid its vertices are rounded to when compressed.

use glam::{DVec3, I64Vec3, Vec2, Vec3};

use crate::ids::{ClassId, ClassScheme};

/// The mesh of one tile. Arrays are per vertex; an empty one is left out of the file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TileContent {
    /// Local metres; becomes the node's translation, so that f32 vertices stay within ± the tile's size.
    pub origin: DVec3,
    /// Metres relative to `origin`, z up.
    pub positions: Vec<Vec3>,
    /// Indices into `positions`.
    pub faces: Vec<[u32; 3]>,
    /// Into `atlas`, v down; or empty.
    pub uvs: Vec<Vec2>,
    /// sRGB, multiplied with the atlas if there is one; or empty.
    pub colors: Vec<[u8; 3]>,
    /// Unit normals, z up; or empty.
    pub normals: Vec<Vec3>,
    /// Vertices are split so that all corners of a face carry its class.
    pub class_of_vertex: Vec<ClassId>,
    /// So many vertices at the end belong to skirts, and so do the faces that use them.
    pub skirt_vertices: usize,
    /// JPEG (or PNG) bytes.
    pub atlas: Option<Vec<u8>>,
    /// Credit to show.
    pub copyright: Option<String>,
}

impl TileContent {
    /// Says what is wrong with this content, if anything.
    ///
    /// # Errors
    /// The first broken promise, for a bug report: the builder makes no such content.
    pub fn check(&self, scheme: &ClassScheme) -> Result<(), String> {
        let n = self.positions.len();
        if n == 0 || self.faces.is_empty() || n > u32::MAX as usize - 1 {
            return Err(format!("a tile of {n} vertices and {} faces cannot be written", self.faces.len()));
        }
        let optional = [("uvs", self.uvs.len()), ("colors", self.colors.len()), ("normals", self.normals.len())];
        if let Some((what, len)) = optional.into_iter().find(|&(_, len)| len != 0 && len != n) {
            return Err(format!("{len} {what} for {n} vertices"));
        }
        if self.class_of_vertex.len() != n {
            return Err(format!("{} classes for {n} vertices", self.class_of_vertex.len()));
        }
        if let Some(class) = self.class_of_vertex.iter().find(|c| c.index() >= scheme.len()) {
            return Err(format!("class {} of {}", class.0, scheme.len()));
        }
        let finite = self.origin.is_finite()
            && self.positions.iter().chain(&self.normals).all(|p| p.is_finite())
            && self.uvs.iter().all(|uv| uv.is_finite());
        if !finite {
            return Err("a position, normal or uv is not finite".into());
        }
        if self.atlas.is_some() == self.uvs.is_empty() {
            return Err("an atlas needs uvs and uvs an atlas".into());
        }
        for (f, face) in self.faces.iter().enumerate() {
            if face.iter().any(|&v| v as usize >= n) {
                return Err(format!("face {f} points past {n} vertices"));
            }
            let [a, b, c] = face.map(|v| self.is_skirt(v));
            if a != b || b != c {
                return Err(format!("face {f} is half a skirt"));
            }
            let [a, b, c] = face.map(|v| self.class_of_vertex[v as usize]);
            if a != b || b != c {
                return Err(format!("the corners of face {f} have different classes"));
            }
        }
        Ok(())
    }

    /// True for a vertex of a skirt.
    pub(super) fn is_skirt(&self, vertex: u32) -> bool {
        vertex as usize + self.skirt_vertices >= self.positions.len()
    }

    /// Class of face `f`.
    pub(super) fn class(&self, f: usize) -> ClassId {
        self.class_of_vertex[self.faces[f][0] as usize]
    }
}

/// Faces in drawing order, by range, and the old index of every vertex that is kept.
pub(super) struct Order {
    /// Class of the range (the first one if ranges hold all classes) and its indices into `vertices`.
    pub ranges: Vec<(ClassId, Vec<u32>)>,
    /// Old vertex by new vertex, by first use.
    pub vertices: Vec<u32>,
}

/// Orders faces for the vertex cache and vertices by first use; drops vertices that no face uses.
///
/// `content` is checked: the optimiser must never see an index out of range. It is one thread of integer tables,
/// so the same faces give the same order.
pub(super) fn order(content: &TileContent, by_class: bool) -> Order {
    let mut classes: Vec<ClassId> = (0..content.faces.len()).map(|f| content.class(f)).collect();
    if !by_class {
        let first = classes[0];
        classes.fill(first);
    }
    let mut present = classes.clone();
    present.sort_unstable();
    present.dedup();
    let mut new_of_old = vec![u32::MAX; content.positions.len()];
    let mut vertices = Vec::with_capacity(content.positions.len());
    let mut range = |class: ClassId| {
        let faces = content.faces.iter().zip(&classes).filter(|&(_, &c)| c == class);
        let indices: Vec<u32> = faces.flat_map(|(face, _)| *face).collect();
        let mut indices = meshopt::optimize_vertex_cache(&indices, content.positions.len());
        for v in &mut indices {
            let new = &mut new_of_old[*v as usize];
            if *new == u32::MAX {
                *new = vertices.len() as u32;
                vertices.push(*v);
            }
            *v = *new;
        }
        (class, indices)
    };
    let ranges = present.into_iter().map(&mut range).collect();
    Order { ranges, vertices }
}

/// Steps along an axis that 16 bits can count.
const STEPS: i64 = u16::MAX as i64;

/// Finest step, metres: 2^-20, far below any survey.
const FINEST_STEP_M: f64 = 1.0 / 1_048_576.0;

/// The grid of a compressed tile.
///
/// Steps are powers of two and the grid hangs on the local frame, not on the tile: a vertex shared by two tiles of the
/// same step is rounded to the same place, so borders stay closed. That costs up to a factor 2 against the finest
/// grid that would fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    /// Metres.
    pub step_m: f64,
    /// Lowest corner, in steps from the local origin.
    pub lowest: I64Vec3,
}

impl Grid {
    /// The finest grid that holds `content`.
    pub fn of(content: &TileContent) -> Self {
        let local = |p: &Vec3| content.origin + p.as_dvec3();
        let min = content.positions.iter().map(local).fold(DVec3::INFINITY, DVec3::min);
        let max = content.positions.iter().map(local).fold(DVec3::NEG_INFINITY, DVec3::max);
        let mut step_m = FINEST_STEP_M;
        loop {
            let (lowest, highest) = (round(min, step_m), round(max, step_m));
            if (highest - lowest).max_element() <= STEPS {
                return Self { step_m, lowest };
            }
            step_m *= 2.0;
        }
    }

    /// Steps of a vertex from the lowest corner.
    pub fn steps(&self, content: &TileContent, p: Vec3) -> [u16; 3] {
        let steps = round(content.origin + p.as_dvec3(), self.step_m) - self.lowest;
        steps.to_array().map(|s| s.clamp(0, STEPS) as u16)
    }

    /// The lowest corner, local metres; exact.
    pub fn corner(&self) -> DVec3 {
        self.lowest.as_dvec3() * self.step_m
    }
}

fn round(p: DVec3, step_m: f64) -> I64Vec3 {
    (p / step_m).round().as_i64vec3()
}

/// How far compression may move a vertex of a tile this wide, metres, when the tile is not at hand yet.
pub fn quantization_error_of(extent_m: f64) -> f64 {
    let mut step_m = FINEST_STEP_M;
    while extent_m / step_m > (STEPS - 1) as f64 {
        step_m *= 2.0;
    }
    step_m * 0.5 * 3f64.sqrt()
}

/// How far compression may move a vertex of this tile, metres: half a step along each axis.
///
/// One-sided and two-sided distance alike: every vertex moves at most this far, hence every point of every face.
pub fn quantization_error_m(content: &TileContent) -> f64 {
    Grid::of(content).step_m * 0.5 * 3f64.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strip(offset: f64) -> TileContent {
        let positions = (0..9u8).map(|i| Vec3::new(f32::from(i / 3) * 33.3, f32::from(i % 3) * 11.1, 1.0)).collect();
        TileContent {
            origin: DVec3::new(offset, -2.0 * offset, 3.25),
            positions,
            faces: vec![[0, 1, 3], [3, 1, 4], [4, 5, 8]],
            class_of_vertex: vec![ClassId::ROOF; 9],
            ..Default::default()
        }
    }

    #[test]
    fn rounding_stays_within_the_stated_error_far_from_the_origin() {
        for offset in [0.0, 17.3, 2.0e6] {
            let content = strip(offset);
            let (grid, bound) = (Grid::of(&content), quantization_error_m(&content));
            for &p in &content.positions {
                let back = grid.corner() + DVec3::from(grid.steps(&content, p).map(f64::from)) * grid.step_m;
                let off = back.distance(content.origin + p.as_dvec3());
                assert!(off <= bound, "{off} > {bound}");
            }
            assert!(bound < 0.002, "{bound}");
        }
    }

    #[test]
    fn a_vertex_shared_by_two_tiles_is_rounded_to_one_place() {
        let (a, mut b) = (strip(0.0), strip(0.0));
        b.origin += DVec3::new(66.6, 5.0, 0.0);
        b.positions.iter_mut().for_each(|p| p.y -= 5.0);
        b.positions[0] = Vec3::new((66.6f32 as f64 - 66.6) as f32, 6.1, 1.0);
        let place = |c: &TileContent, p| {
            let g = Grid::of(c);
            g.corner() + DVec3::from(g.steps(c, p).map(f64::from)) * g.step_m
        };
        assert_eq!(place(&a, a.positions[7]), place(&b, b.positions[0]));
    }

    #[test]
    fn unused_vertices_are_dropped_and_ranges_split_by_class() {
        let mut content = strip(0.0);
        let one = order(&content, false);
        assert_eq!((one.ranges.len(), one.ranges[0].1.len(), one.vertices.len()), (1, 9, 6));
        content.positions.push(Vec3::ZERO);
        content.faces[2] = [6, 7, 8];
        content.class_of_vertex = [vec![ClassId::ROOF; 6], vec![ClassId::TERRAIN; 4]].concat();
        assert_eq!(content.check(&ClassScheme::default()), Ok(()));
        let two = order(&content, true);
        assert_eq!(
            two.ranges.iter().map(|r| (r.0, r.1.len())).collect::<Vec<_>>(),
            [(ClassId::TERRAIN, 3), (ClassId::ROOF, 6)]
        );
        assert_eq!(two.vertices.len(), 7);
    }

    #[test]
    fn broken_content_is_named() {
        let scheme = ClassScheme::default();
        let broken = |spoil: fn(&mut TileContent)| {
            let mut c = strip(0.0);
            spoil(&mut c);
            c.check(&scheme).unwrap_err()
        };
        assert!(broken(|c| c.faces[0][1] = 9).contains("past 9"));
        assert!(broken(|c| c.positions[0].x = f32::NAN).contains("finite"));
        assert!(broken(|c| c.class_of_vertex[8] = ClassId(1)).contains("different classes"));
        assert!(broken(|c| c.class_of_vertex[8] = ClassId(9)).contains("class 9 of 4"));
        assert!(broken(|c| c.uvs = vec![Vec2::ZERO; 9]).contains("atlas"));
        assert!(broken(|c| c.faces.clear()).contains("cannot be written"));
    }
}
