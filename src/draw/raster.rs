//! Which face is seen at which pixel.
//!
//! In: a view, positions, faces. Out: [`Seen`], per pixel the nearest face and its depth; colours come later
//! ([`super::shade`]), so that one pass of visibility serves any number of pictures.
//! # Method
//! 1. Vertices go to fixed-point pixels ([`ONE`] parts a pixel); few triangles reach behind the camera or far
//!    beyond the picture, and those are cut.
//! 2. Faces are listed per band of rows, in their order.
//! 3. Bands are filled in parallel: integer edge functions with a top-left rule, nearest face wins, the earlier of two
//!    at equal depth.
//! # Promises
//! Edge functions are exact, so a pixel on a shared edge belongs to exactly one of the two faces; back faces are drawn
//! too. The same bytes for any number of threads: every pixel depends on the order of faces alone.
//! # Limits
//! No transparency, no smoothing: draw a [`View::enlarged`] picture and halve it.

use glam::DVec3;
use rayon::prelude::*;

use super::view::View;

/// Fixed-point parts of a pixel.
const ONE: i64 = 1 << 12;
/// Half a pixel: where pixel centres are.
const HALF: i64 = ONE / 2;
/// Farthest fixed-point place from the picture's centre, pixels: 2¹⁶ · 2¹² squared leaves an i64 room for sums.
const GUARD_PX: f64 = 65536.0 - 16384.0;
/// Rows filled by one task.
const BAND_ROWS: usize = 32;
/// Faces listed by one task.
const CHUNK_FACES: usize = 1 << 15;
/// Marks pixels without a face.
pub const NO_FACE: u32 = u32::MAX;
/// x of a vertex that has no fixed-point place.
const OUTSIDE: i32 = i32::MIN;

/// What a view shows: per pixel the nearest face and how near it is.
#[derive(Debug, Clone)]
pub struct Seen {
    view: View,
    /// Per pixel, row by row: index into the faces, or [`NO_FACE`].
    faces: Vec<u32>,
    /// Per pixel: grows towards the camera, minus infinity for the background.
    nearness: Vec<f64>,
}

#[derive(Clone, Copy)]
struct Corner {
    x: i32,
    y: i32,
    nearness: f64,
}

impl Seen {
    /// Draws `faces` (indices into `positions`, local metres); faces with corners that are not finite are left out.
    ///
    /// # Panics
    /// If a face names a vertex that is not there.
    pub fn of(view: &View, positions: &[DVec3], faces: &[[u32; 3]]) -> Self {
        let [width, height] = view.size_px().map(|side| side as usize);
        let planes = view.clip_planes(GUARD_PX);
        let corners: Vec<Corner> = positions.par_iter().map(|&p| corner(view, &planes, p)).collect();
        let mesh = Projection { view, positions, faces, corners: &corners };
        let bands = height.div_ceil(BAND_ROWS);
        let lists: Vec<Vec<Vec<u32>>> = faces
            .par_chunks(CHUNK_FACES)
            .enumerate()
            .map(|(i, chunk)| mesh.list(i * CHUNK_FACES, chunk, bands))
            .collect();
        let mut seen = vec![NO_FACE; width * height];
        let mut nearness = vec![f64::NEG_INFINITY; width * height];
        let rows = BAND_ROWS * width;
        seen.par_chunks_mut(rows).zip(nearness.par_chunks_mut(rows)).enumerate().for_each(|(i, (faces, nearness))| {
            let mut band = Band { width: width as i64, top: (i * BAND_ROWS) as i64, faces, nearness };
            for &face in lists.iter().flat_map(|list| &list[i]) {
                mesh.for_each_triangle(face, |tri| band.fill(tri, face));
            }
        });
        Self { view: *view, faces: seen, nearness }
    }

    /// Takes over what `other`, drawn with the same view, shows nearer to the camera; says at which pixels. Its faces are
    /// counted on from `first`.
    ///
    /// # Panics
    /// If the views differ.
    pub fn merge(&mut self, other: &Self, first: u32) -> Vec<usize> {
        assert_eq!(self.view, other.view, "pixels have to mean the same places");
        let nearer: Vec<usize> = (0..self.faces.len()).filter(|&i| other.nearness[i] > self.nearness[i]).collect();
        for &i in &nearer {
            self.faces[i] = other.faces[i].saturating_add(first);
            self.nearness[i] = other.nearness[i];
        }
        nearer
    }

    /// The view it was drawn with.
    pub fn view(&self) -> &View {
        &self.view
    }

    /// Per pixel, row by row from the top: the face seen, or [`NO_FACE`].
    pub fn faces(&self) -> &[u32] {
        &self.faces
    }

    /// Depth of pixel `i` (row by row), metres in front of the camera's plane; none for the background.
    pub fn depth_m(&self, i: usize) -> Option<f64> {
        (self.faces[i] != NO_FACE).then(|| self.view.depth_m(self.nearness[i]))
    }
}

/// Fixed-point place of a vertex, or the mark that it has none.
fn corner(view: &View, planes: &[(DVec3, f64); 5], p: DVec3) -> Corner {
    let camera = view.camera_from_local(p);
    // The test that cuts, so that a vertex is inside for all of its faces or for none.
    let inside = planes.iter().all(|(normal, offset)| normal.dot(camera) + offset >= 0.0);
    inside.then(|| place(view, camera)).flatten().unwrap_or(Corner { x: OUTSIDE, y: 0, nearness: 0.0 })
}

/// Fixed-point place of a point within the clip planes.
fn place(view: &View, camera: DVec3) -> Option<Corner> {
    const LIMIT_PX: f64 = GUARD_PX * 1.25;
    let [x, y, nearness] = view.picture_from_camera(camera)?;
    // Parts of a pixel to the nearest even one, which is one instruction.
    let fixed = |v: f64| (v.clamp(-LIMIT_PX, LIMIT_PX) * ONE as f64).round_ties_even() as i32;
    Some(Corner { x: fixed(x), y: fixed(y), nearness })
}

/// A mesh in a view.
struct Projection<'a> {
    view: &'a View,
    positions: &'a [DVec3],
    faces: &'a [[u32; 3]],
    corners: &'a [Corner],
}

impl Projection<'_> {
    /// Per band the faces of a chunk that may touch a pixel centre in it.
    fn list(&self, first: usize, chunk: &[[u32; 3]], bands: usize) -> Vec<Vec<u32>> {
        let [width, height] = self.view.size_px().map(i64::from);
        let mut lists = vec![Vec::new(); bands];
        for face in (first..first + chunk.len()).map(|f| f as u32) {
            let (mut first, mut last) = (i64::MAX, i64::MIN);
            self.for_each_triangle(face, |tri| {
                let (x, y) = (centers(tri.map(|c| c.x), width), centers(tri.map(|c| c.y), height));
                if x[0] <= x[1] && y[0] <= y[1] {
                    first = first.min(y[0]);
                    last = last.max(y[1]);
                }
            });
            if first <= last {
                for list in &mut lists[first as usize / BAND_ROWS..=last as usize / BAND_ROWS] {
                    list.push(face);
                }
            }
        }
        lists
    }

    /// The face as drawn: one triangle, or the fan of what is left of it within the guard.
    fn for_each_triangle(&self, face: u32, mut take: impl FnMut([Corner; 3])) {
        let indices = self.faces[face as usize];
        let tri = indices.map(|v| self.corners[v as usize]);
        if tri.iter().all(|c| c.x != OUTSIDE) {
            return take(tri);
        }
        let polygon = cut(self.view, indices.map(|v| self.view.camera_from_local(self.positions[v as usize])));
        let Some(polygon) = polygon.into_iter().map(|p| place(self.view, p)).collect::<Option<Vec<_>>>() else {
            return;
        };
        for i in 2..polygon.len() {
            take([polygon[0], polygon[i - 1], polygon[i]]);
        }
    }
}

/// What is left of a triangle (camera metres) inside the clip planes. A shared edge is cut at the same bits for both
/// faces, as cuts run from the inner end to the outer.
fn cut(view: &View, tri: [DVec3; 3]) -> Vec<DVec3> {
    if !tri.iter().all(|p| p.is_finite()) {
        return Vec::new();
    }
    let mut polygon = tri.to_vec();
    for (normal, offset) in view.clip_planes(GUARD_PX) {
        let inside: Vec<f64> = polygon.iter().map(|p| normal.dot(*p) + offset).collect();
        let mut kept = Vec::with_capacity(polygon.len() + 1);
        for i in 0..polygon.len() {
            let next = (i + 1) % polygon.len();
            if inside[i] >= 0.0 {
                kept.push(polygon[i]);
            }
            if (inside[i] >= 0.0) != (inside[next] >= 0.0) {
                let (inner, outer) = if inside[i] >= 0.0 { (i, next) } else { (next, i) };
                let t = inside[inner] / (inside[inner] - inside[outer]);
                kept.push(polygon[inner] + (polygon[outer] - polygon[inner]) * t);
            }
        }
        polygon = kept;
    }
    polygon
}

/// First and last pixel whose centre is within the extent of three fixed-point coordinates.
fn centers([a, b, c]: [i32; 3], side: i64) -> [i64; 2] {
    let (low, high) = (i64::from(a.min(b).min(c)), i64::from(a.max(b).max(c)));
    // Shifts round down, also below zero.
    let first = (low - HALF + ONE - 1) >> ONE.trailing_zeros();
    let last = (high - HALF) >> ONE.trailing_zeros();
    [first.max(0), last.min(side - 1)]
}

/// Some rows of a picture.
struct Band<'a> {
    width: i64,
    top: i64,
    faces: &'a mut [u32],
    nearness: &'a mut [f64],
}

impl Band<'_> {
    fn fill(&mut self, tri: [Corner; 3], face: u32) {
        let [a, mut b, mut c] = tri;
        let mut area2 = side(a, b, c.x.into(), c.y.into());
        if area2 < 0 {
            (b, c, area2) = (c, b, -area2);
        }
        let height = self.faces.len() as i64 / self.width;
        let columns = centers([a.x, b.x, c.x], self.width);
        let rows = centers([a.y, b.y, c.y], self.top + height);
        let rows = [rows[0].max(self.top), rows[1]];
        if area2 == 0 || columns[0] > columns[1] || rows[0] > rows[1] {
            return;
        }
        let edges = [(b, c), (c, a), (a, b)];
        let (x, y) = (columns[0] * ONE + HALF, rows[0] * ONE + HALF);
        // On the border a pixel belongs to the face only if the edge is a left or a top one.
        let own = edges.map(|(p, q)| if q.y < p.y || (q.y == p.y && q.x > p.x) { 0 } else { -1 });
        let mut start: [i64; 3] = std::array::from_fn(|i| side(edges[i].0, edges[i].1, x, y));
        let right = edges.map(|(p, q)| -(i64::from(q.y) - i64::from(p.y)) * ONE);
        let down = edges.map(|(p, q)| (i64::from(q.x) - i64::from(p.x)) * ONE);
        let share = 1.0 / area2 as f64;
        for row in rows[0]..=rows[1] {
            let mut at = start;
            let offset = (row - self.top) * self.width;
            let mut was_inside = false;
            for column in columns[0]..=columns[1] {
                if ((at[0] + own[0]) | (at[1] + own[1]) | (at[2] + own[2])) >= 0 {
                    was_inside = true;
                    let (wb, wc) = (at[1] as f64 * share, at[2] as f64 * share);
                    let near = a.nearness + wb * (b.nearness - a.nearness) + wc * (c.nearness - a.nearness);
                    let i = (offset + column) as usize;
                    if near > self.nearness[i] {
                        self.nearness[i] = near;
                        self.faces[i] = face;
                    }
                } else if was_inside {
                    break;
                }
                at = std::array::from_fn(|i| at[i] + right[i]);
            }
            start = std::array::from_fn(|i| start[i] + down[i]);
        }
    }
}

/// Twice the area of p, q and (x, y), positive where y points down and the three run clockwise on screen.
fn side(p: Corner, q: Corner, x: i64, y: i64) -> i64 {
    let (px, py) = (i64::from(p.x), i64::from(p.y));
    (i64::from(q.x) - px) * (y - py) - (i64::from(q.y) - py) * (x - px)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::view::corners;
    use super::*;
    use crate::geo::Aabb;

    const SIDE: usize = 9;

    /// A square of 8 m, cut to a grid whose inner vertices are shaken and whose diagonals turn at random.
    fn shaken(shifts: &[(f64, f64)], diagonals: &[bool]) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let mut positions = Vec::new();
        for (i, shift) in shifts.iter().enumerate() {
            let (x, y) = (i % SIDE, i / SIDE);
            let (dx, dy) = if x % (SIDE - 1) == 0 || y % (SIDE - 1) == 0 { (0.0, 0.0) } else { *shift };
            positions.push(DVec3::new(x as f64 + dx, y as f64 + dy, 0.0));
        }
        let mut faces = Vec::new();
        for (i, &diagonal) in diagonals.iter().enumerate() {
            let a = (i / (SIDE - 1) * SIDE + i % (SIDE - 1)) as u32;
            let [a, b, c, d] = [a, a + 1, a + 1 + SIDE as u32, a + SIDE as u32];
            faces.extend(if diagonal { [[a, b, c], [c, a, d]] } else { [[b, a, d], [b, c, d]] });
        }
        (positions, faces)
    }

    fn count(view: &View, positions: &[DVec3], faces: &[[u32; 3]]) -> Vec<u32> {
        let mut count = vec![0; view.size_px().iter().product::<u32>() as usize];
        for face in faces {
            let seen = Seen::of(view, positions, std::slice::from_ref(face));
            count.iter_mut().zip(seen.faces()).for_each(|(n, &f)| *n += u32::from(f != NO_FACE));
        }
        count
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn every_pixel_of_a_cut_plane_is_covered_exactly_once(
            shifts in prop::collection::vec((-0.3..0.3_f64, -0.3..0.3_f64), SIDE * SIDE),
            diagonals in prop::collection::vec(any::<bool>(), (SIDE - 1) * (SIDE - 1)),
            scale in prop::sample::select(vec![1.0, 2.0, 4.0, 3.3, 7.0]),
        ) {
            let (positions, faces) = shaken(&shifts, &diagonals);
            // The picture's rows and columns run right through grid points: many centres lie on edges.
            let size = (8.0 * scale) as u32;
            let half = 0.5 / scale;
            let view = View::above_at(DVec3::new(half, 8.0 - half, 1.0), scale, [size - 1, size - 1]);
            let count = count(&view, &positions, &faces);
            prop_assert!(count.iter().all(|&n| n == 1), "{:?}", count);
        }

        #[test]
        fn a_plane_that_runs_behind_the_camera_has_no_gaps_before_it(
            shifts in prop::collection::vec((-0.3..0.3_f64, -0.3..0.3_f64), SIDE * SIDE),
            diagonals in prop::collection::vec(any::<bool>(), (SIDE - 1) * (SIDE - 1)),
        ) {
            let (mut positions, faces) = shaken(&shifts, &diagonals);
            positions.iter_mut().for_each(|p| *p = (*p - DVec3::new(4.0, 4.0, 0.0)) * 500.0);
            // From 2 m above the ground, in the middle of faces of 500 m: all below the horizon is ground.
            let view = View::from_eye(DVec3::new(0.0, 0.0, 2.0), DVec3::new(3.0, 4.0, 1.0), 70.0, [64, 64]);
            let count = count(&view, &positions, &faces);
            for (i, &n) in count.iter().enumerate() {
                if i / 64 >= 40 {
                    prop_assert_eq!(n, 1, "pixel {} {}", i % 64, i / 64);
                }
            }
        }
    }

    #[test]
    fn the_nearer_face_is_seen_in_either_order_and_orientation() {
        let at = |z: f64| [DVec3::new(0.0, 0.0, z), DVec3::new(9.0, 0.0, z), DVec3::new(0.0, 9.0, z)];
        let positions = [at(1.0), at(2.0)].concat();
        let view = View::above_at(DVec3::new(0.0, 9.0, 10.0), 1.0, [9, 9]);
        for (faces, top) in [([[0, 1, 2], [3, 5, 4]], 1), ([[3, 4, 5], [0, 2, 1]], 0)] {
            let seen = Seen::of(&view, &positions, &faces);
            let pixel = 8 * 9;
            assert_eq!(seen.faces()[pixel], top);
            assert_eq!(seen.depth_m(pixel), Some(8.0));
            assert_eq!(seen.faces()[8], NO_FACE);
            assert_eq!(seen.depth_m(8), None);
        }
        let seen = Seen::of(&view, &positions, &[[0, 1, 2], [0, 2, 1]]);
        assert_eq!(seen.faces()[8 * 9], 0, "the earlier of two equal ones");
    }

    #[test]
    fn crossing_faces_change_over_where_they_cross() {
        let positions = [
            DVec3::new(0.0, 0.0, 0.0),
            DVec3::new(20.0, 0.0, 0.0),
            DVec3::new(0.0, 20.0, 0.0),
            DVec3::new(0.0, 0.0, -5.0),
            DVec3::new(20.0, 0.0, 15.0),
            DVec3::new(0.0, 20.0, -5.0),
        ];
        let view = View::above_at(DVec3::new(0.0, 20.0, 30.0), 1.0, [20, 20]);
        let seen = Seen::of(&view, &positions, &[[0, 1, 2], [3, 4, 5]]);
        // Row at y = 0.5: the slope passes zero at x = 5.
        let row = &seen.faces()[19 * 20..];
        assert_eq!(row[4], 0);
        assert_eq!(row[5], 1);
    }

    #[test]
    fn nonsense_positions_draw_nothing_and_far_ones_do_no_harm() {
        let positions = [DVec3::NAN, DVec3::ZERO, DVec3::X, DVec3::splat(1e300), DVec3::new(-1e9, 1e9, 3.0)];
        let view = View::above(&corners(&Aabb { min: DVec3::ZERO, max: DVec3::ONE }), [16, 16]);
        assert!(Seen::of(&view, &positions, &[[0, 1, 2]]).faces().iter().all(|&f| f == NO_FACE));
        Seen::of(&view, &positions, &[[1, 2, 3], [2, 3, 4], [1, 2, 4]]);
        let view = View::from_eye(DVec3::new(0.2, -1.0, 0.5), DVec3::ZERO, 50.0, [16, 16]);
        Seen::of(&view, &positions, &[[1, 2, 3], [2, 3, 4], [1, 2, 4], [0, 3, 4]]);
    }

    #[test]
    fn one_thread_and_four_see_the_same() {
        let (positions, faces) = shaken(&[(0.2, -0.1); SIDE * SIDE], &[true; (SIDE - 1) * (SIDE - 1)]);
        let view = View::oblique(&positions, 30.0, 35.0, [333, 222]);
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            pool.install(|| Seen::of(&view, &positions, &faces))
        };
        let (one, four) = (run(1), run(4));
        assert_eq!(one.faces, four.faces);
        assert_eq!(one.nearness, four.nearness);
    }
}
