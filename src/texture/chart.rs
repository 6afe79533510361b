//! Cuts a mesh into nearly flat charts that are projected along one direction each.
//!
//! # Method
//! 1. Grow charts over shared edges from the largest face left, while normals stay near the chart's mean normal.
//! 2. Give charts of a few texels to a neighbour that faces roughly their way: each chart costs gutters.
//! 3. Project along the mean normal; walls keep the vertical, others turn to their smallest bounding rectangle.
//! 4. Faces that overlap an earlier one of the chart, seen at the texel's size, start over at 1.

use std::collections::VecDeque;

use glam::{DVec2, DVec3};

use super::mask::Mask;
use super::raster::centers;

/// Charts smaller than a square of this side are given to a neighbour, texels.
const TINY_PX: f64 = 16.0;
/// … if it faces within 75° of theirs: cos 75°.
const TINY_COS: f64 = 0.2588;
/// Faces steeper than this to the projection would be stretched fivefold: cos 78.5°.
const MIN_FACING: f64 = 0.2;
/// Rounds of growing what was thrown out, before each face left becomes a chart.
const MAX_ROUNDS: u32 = 12;
/// A chart whose normal is less upright than this is a wall.
const WALL_BELOW_Z: f64 = 0.5;
/// Texels the overlap test looks at per chart; larger charts are tested coarser.
const MAX_TEST_TEXELS: f64 = (1 << 23) as f64;

/// Faces that share a projection without overlaps.
#[derive(Debug, Clone)]
pub(super) struct Chart {
    /// Sorted as grown.
    pub faces: Vec<u32>,
    /// Right, down and towards the viewer, as seen in the atlas; orthonormal.
    pub axes: [DVec3; 3],
    /// Smallest right and down coordinates, metres.
    pub low: DVec2,
    /// Largest ones.
    pub high: DVec2,
}

impl Chart {
    /// Right and down coordinates of a point, metres.
    pub fn project(&self, p: DVec3) -> DVec2 {
        DVec2::new(p.dot(self.axes[0]), p.dot(self.axes[1]))
    }
}

/// Charts that hold every face exactly once, without overlaps at `texel_m` metres a texel.
pub(super) fn charts(positions: &[DVec3], faces: &[[u32; 3]], texel_m: f64, angle_deg: f64) -> Vec<Chart> {
    let grower = Grower::of(positions, faces, angle_deg.to_radians().cos());
    let mut order: Vec<u32> = (0..faces.len() as u32).collect();
    let area = |f: u32| grower.cross[f as usize].length_squared();
    order.sort_by(|&a, &b| area(b).total_cmp(&area(a)).then(a.cmp(&b)));
    let mut pieces = grower.grow(&order);
    grower.merge_tiny(&mut pieces, (TINY_PX * texel_m).powi(2));
    let mut done = Vec::new();
    let mut test = Test { taken: Mask::new(1, 1), spans: Vec::new() };
    for round in 0.. {
        let mut ejected = Vec::new();
        for piece in pieces {
            let (chart, rest) = grower.flatten(piece, texel_m, &mut test);
            done.push(chart);
            ejected.extend(rest);
        }
        if ejected.is_empty() {
            break;
        }
        ejected.sort_by(|&a, &b| area(b).total_cmp(&area(a)).then(a.cmp(&b)));
        pieces = if round < MAX_ROUNDS { grower.grow(&ejected) } else { ejected.iter().map(|&f| vec![f]).collect() };
    }
    done
}

const NONE: u32 = u32::MAX;

/// Looks for overlaps in one chart.
struct Test {
    taken: Mask,
    /// Rows of the face that is looked at, from and to: drawn once, for the question and the answer.
    spans: Vec<[u32; 3]>,
}

struct Grower<'a> {
    positions: &'a [DVec3],
    faces: &'a [[u32; 3]],
    /// Normal times twice the area.
    cross: Vec<DVec3>,
    /// Across each edge, `NONE` at borders and where more than two faces meet.
    neighbors: Vec<[u32; 3]>,
    min_cos: f64,
}

impl<'a> Grower<'a> {
    fn of(positions: &'a [DVec3], faces: &'a [[u32; 3]], min_cos: f64) -> Self {
        let cross = |face: &[u32; 3]| {
            let [a, b, c] = face.map(|v| positions[v as usize]);
            (b - a).cross(c - a)
        };
        Self { positions, faces, cross: faces.iter().map(cross).collect(), neighbors: neighbors(faces), min_cos }
    }

    /// Pieces of the faces in `order`, which also is the order of seeds.
    fn grow(&self, order: &[u32]) -> Vec<Vec<u32>> {
        let mut free = vec![false; self.faces.len()];
        order.iter().for_each(|&f| free[f as usize] = true);
        let mut pieces = Vec::new();
        let mut queue = VecDeque::new();
        for &seed in order {
            if !free[seed as usize] {
                continue;
            }
            free[seed as usize] = false;
            let mut sum = self.cross[seed as usize];
            let mut piece = vec![seed];
            queue.push_back(seed);
            while let Some(f) = queue.pop_front() {
                for g in self.neighbors[f as usize] {
                    if g != NONE && free[g as usize] && self.faces_along(g, sum, self.min_cos) {
                        free[g as usize] = false;
                        sum += self.cross[g as usize];
                        piece.push(g);
                        queue.push_back(g);
                    }
                }
            }
            pieces.push(piece);
        }
        pieces
    }

    /// Whether the angle between a face's normal and `direction` has at least this cosine; true without a normal.
    fn faces_along(&self, f: u32, direction: DVec3, min_cos: f64) -> bool {
        let cross = self.cross[f as usize];
        cross.dot(direction) >= min_cos * cross.length() * direction.length()
    }

    fn merge_tiny(&self, pieces: &mut Vec<Vec<u32>>, tiny_m2: f64) {
        let mut of = vec![NONE; self.faces.len()];
        for (id, piece) in pieces.iter().enumerate() {
            piece.iter().for_each(|&f| of[f as usize] = id as u32);
        }
        let mut sums: Vec<DVec3> =
            pieces.iter().map(|piece| piece.iter().map(|&f| self.cross[f as usize]).sum()).collect();
        let area = |sums: &[DVec3], id: usize| sums[id].length() / 2.0;
        let mut tiny: Vec<usize> = (0..pieces.len()).filter(|&id| area(&sums, id) < tiny_m2).collect();
        tiny.sort_by(|&a, &b| area(&sums, a).total_cmp(&area(&sums, b)).then(a.cmp(&b)));
        for id in tiny {
            // It may have grown by taking in a smaller one.
            if area(&sums, id) >= tiny_m2 {
                continue;
            }
            let Some(into) = self.best_neighbor(&pieces[id], id as u32, &of, &sums) else { continue };
            let moved = std::mem::take(&mut pieces[id]);
            moved.iter().for_each(|&f| of[f as usize] = into);
            let sum = sums[id];
            sums[into as usize] += sum;
            pieces[into as usize].extend(moved);
        }
        pieces.retain(|piece| !piece.is_empty());
    }

    /// The neighbour with the longest common border that all faces of the piece face.
    fn best_neighbor(&self, piece: &[u32], id: u32, of: &[u32], sums: &[DVec3]) -> Option<u32> {
        let mut borders: Vec<(u32, f64)> = Vec::new();
        for &f in piece {
            for (side, g) in self.neighbors[f as usize].into_iter().enumerate() {
                if g == NONE || of[g as usize] == id {
                    continue;
                }
                let face = self.faces[f as usize];
                let ends = [face[side], face[(side + 1) % 3]].map(|v| self.positions[v as usize]);
                let length = ends[0].distance(ends[1]);
                match borders.iter_mut().find(|border| border.0 == of[g as usize]) {
                    Some(border) => border.1 += length,
                    None => borders.push((of[g as usize], length)),
                }
            }
        }
        borders.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        let fits = |into: u32| piece.iter().all(|&f| self.faces_along(f, sums[into as usize], TINY_COS));
        borders.into_iter().map(|(into, _)| into).find(|&into| fits(into))
    }

    /// Projects a piece; returns the chart and the faces that could not stay in it.
    fn flatten(&self, piece: Vec<u32>, texel_m: f64, test: &mut Test) -> (Chart, Vec<u32>) {
        let normal = |faces: &[u32]| {
            let sum: DVec3 = faces.iter().map(|&f| self.cross[f as usize]).sum();
            sum.try_normalize().unwrap_or(DVec3::Z)
        };
        let n = normal(&piece);
        let (mut kept, mut ejected): (Vec<u32>, Vec<u32>) =
            piece.into_iter().partition(|&f| self.faces_along(f, n, MIN_FACING));
        if kept.is_empty() {
            kept = vec![ejected.remove(0)];
        }
        let axes = self.axes(&kept, normal(&kept));
        let mut chart = Chart { faces: Vec::new(), axes, low: DVec2::ZERO, high: DVec2::ZERO };
        let (low, high) = self.bounds(&kept, &chart);
        let size = high - low;
        let test_m = texel_m.max((size.x * size.y / MAX_TEST_TEXELS).sqrt()).max(size.max_element() / 65536.0);
        let window = [size.x, size.y].map(|s| (s / test_m).ceil() as u32 + 1);
        test.taken.reset(window[0], window[1]);
        for f in kept {
            if self.draw(f, &chart, low, test_m, window, test) { chart.faces.push(f) } else { ejected.push(f) }
        }
        (chart.low, chart.high) = self.bounds(&chart.faces, &chart);
        (chart, ejected)
    }

    /// Marks the texels of a face unless one of them is taken; a texel on an edge belongs to nobody.
    fn draw(&self, f: u32, chart: &Chart, low: DVec2, texel_m: f64, window: [u32; 2], test: &mut Test) -> bool {
        const SHRINK_PX: f64 = -0.01;
        let tri = self.faces[f as usize].map(|v| (chart.project(self.positions[v as usize]) - low) / texel_m);
        let Test { taken, spans } = test;
        spans.clear();
        centers(tri, SHRINK_PX, window, |y, x0, x1| spans.push([y, x0, x1]));
        let clash = spans.iter().any(|&[y, x0, x1]| taken.any_in_span(y, x0, x1));
        if !clash {
            spans.iter().for_each(|&[y, x0, x1]| taken.set_span(y, x0, x1));
        }
        !clash
    }

    fn bounds(&self, faces: &[u32], chart: &Chart) -> (DVec2, DVec2) {
        let points =
            faces.iter().flat_map(|&f| self.faces[f as usize]).map(|v| chart.project(self.positions[v as usize]));
        points.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
    }

    fn axes(&self, faces: &[u32], n: DVec3) -> [DVec3; 3] {
        // Down for walls; south for ground and roofs, so that the atlas is a map.
        let down = if n.z.abs() < WALL_BELOW_Z { DVec3::NEG_Z } else { DVec3::NEG_Y };
        let down = (down - n * n.dot(down)).normalize_or(n.any_orthonormal_vector());
        let right = n.cross(down);
        if n.z.abs() < WALL_BELOW_Z {
            return [right, down, n];
        }
        self.smallest_rectangle(faces, [right, down, n])
    }

    /// Turns the axes about the normal to the smallest of a few bounding rectangles.
    fn smallest_rectangle(&self, faces: &[u32], axes: [DVec3; 3]) -> [DVec3; 3] {
        const TURNS: u32 = 12;
        // A rectangle has to be this much smaller before the map is turned.
        const GAIN: f64 = 0.95;
        let mut best = (f64::INFINITY, axes);
        for turn in 0..TURNS {
            let (sin, cos) = (f64::from(turn) / f64::from(TURNS) * std::f64::consts::FRAC_PI_2).sin_cos();
            let turned = [axes[0] * cos + axes[1] * sin, axes[1] * cos - axes[0] * sin, axes[2]];
            let chart = Chart { faces: Vec::new(), axes: turned, low: DVec2::ZERO, high: DVec2::ZERO };
            let (low, high) = self.bounds(faces, &chart);
            let area = (high - low).element_product();
            if turn == 0 || area < best.0 * GAIN {
                best = (area, turned);
            }
        }
        best.1
    }
}

fn neighbors(faces: &[[u32; 3]]) -> Vec<[u32; 3]> {
    let mut edges = Vec::with_capacity(faces.len() * 3);
    for (f, face) in faces.iter().enumerate() {
        for side in 0..3 {
            let (a, b) = (face[side], face[(side + 1) % 3]);
            edges.push((a.min(b), a.max(b), f as u32, side));
        }
    }
    edges.sort_unstable();
    let mut neighbors = vec![[NONE; 3]; faces.len()];
    for shared in edges.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
        if let [a, b] = shared {
            neighbors[a.2 as usize][a.3] = b.2;
            neighbors[b.2 as usize][b.3] = a.2;
        }
    }
    neighbors
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A grid of `n` × `n` squares over the unit square, bent by `height`.
    pub fn grid(n: u32, height: impl Fn(f64, f64) -> f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let at = |x: u32, y: u32| (f64::from(x) / f64::from(n), f64::from(y) / f64::from(n));
        let points = (0..=n).flat_map(|y| (0..=n).map(move |x| (x, y)));
        let positions = points.map(|(x, y)| at(x, y)).map(|(x, y)| DVec3::new(x, y, height(x, y))).collect();
        let mut faces = Vec::new();
        for (x, y) in (0..n).flat_map(|y| (0..n).map(move |x| (x, y))) {
            let [a, b] = [y * (n + 1) + x, (y + 1) * (n + 1) + x];
            faces.extend([[a, a + 1, b + 1], [a, b + 1, b]]);
        }
        (positions, faces)
    }

    fn assert_partition(charts: &[Chart], faces: usize) {
        let mut all: Vec<u32> = charts.iter().flat_map(|c| c.faces.iter().copied()).collect();
        all.sort_unstable();
        assert_eq!(all, (0..faces as u32).collect::<Vec<_>>());
    }

    #[test]
    fn a_rolling_field_is_one_chart() {
        let (positions, faces) = grid(16, |x, y| 0.05 * (9.0 * x).sin() * (7.0 * y).cos());
        let charts = charts(&positions, &faces, 0.01, 50.0);
        assert_partition(&charts, faces.len());
        assert_eq!(charts.len(), 1);
        assert!((charts[0].high - charts[0].low - DVec2::ONE).abs().max_element() < 0.02);
    }

    #[test]
    fn a_box_is_six_charts_and_its_walls_stay_upright() {
        let corner =
            |i: u32| DVec3::new(f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)) * DVec3::new(4.0, 3.0, 2.0);
        let positions: Vec<_> = (0..8).map(corner).collect();
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let faces: Vec<_> = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
        let charts = charts(&positions, &faces, 0.01, 50.0);
        assert_partition(&charts, 12);
        assert_eq!(charts.len(), 6);
        for chart in charts {
            assert!((chart.axes[0].cross(chart.axes[1]) + chart.axes[2]).length() < 1e-12, "not mirrored");
            if chart.axes[2].z.abs() < 0.5 {
                assert!((chart.axes[1] - DVec3::NEG_Z).length() < 1e-12);
            }
        }
    }

    /// A ramp that winds twice around the axis: flat enough for one chart, but above itself.
    fn spiral() -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let point = |i: u32, radius: f64| {
            let angle = f64::from(i) * std::f64::consts::TAU / 24.0;
            DVec3::new(radius * angle.cos(), radius * angle.sin(), 0.02 * f64::from(i))
        };
        let positions = (0..=48).flat_map(|i| [point(i, 1.0), point(i, 2.0)]).collect();
        let faces = (0..48).flat_map(|i| [[2 * i, 2 * i + 1, 2 * i + 3], [2 * i, 2 * i + 3, 2 * i + 2]]).collect();
        (positions, faces)
    }

    #[test]
    fn a_spiral_is_cut_where_it_runs_over_itself() {
        let (positions, faces) = spiral();
        let charts = charts(&positions, &faces, 0.02, 50.0);
        assert_partition(&charts, faces.len());
        assert!((2..=4).contains(&charts.len()), "{}", charts.len());
        for chart in &charts {
            // Drawn 8 times finer, no texel belongs to two faces.
            let mut test = Test { taken: Mask::new(2000, 2000), spans: Vec::new() };
            let grower = Grower::of(&positions, &faces, 0.0);
            let clash =
                chart.faces.iter().filter(|&&f| !grower.draw(f, chart, chart.low, 0.0025, [2000, 2000], &mut test));
            assert_eq!(clash.count(), 0);
        }
    }

    #[test]
    fn folded_paper_is_two_charts() {
        let positions = [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [0., 1., 0.], [1.0, 0.5, 0.01]].map(DVec3::from);
        // The second face folds back over the first.
        let charts = charts(&positions, &[[0, 1, 2], [0, 2, 4]], 0.01, 50.0);
        assert_partition(&charts, 2);
        assert_eq!(charts.len(), 2);
    }

    #[test]
    fn degenerate_and_non_manifold_faces_end_up_in_some_chart() {
        let positions = [[0., 0., 0.], [1., 0., 0.], [0., 1., 0.], [0., 0., 1.], [2., 0., 0.]].map(DVec3::from);
        let faces = [[0, 1, 2], [0, 1, 3], [1, 0, 2], [0, 1, 4], [3, 3, 3]];
        assert_partition(&charts(&positions, &faces, 0.01, 50.0), 5);
    }

    #[test]
    fn specks_join_the_roof_they_lie_on() {
        // Steep little bumps all over a flat roof.
        let (positions, faces) =
            grid(64, |x, y| if (x * 64.0) as u32 % 8 == 4 && (y * 64.0) as u32 % 8 == 4 { 0.02 } else { 0.0 });
        let coarse = charts(&positions, &faces, 0.02, 50.0);
        assert_partition(&coarse, faces.len());
        let fine = charts(&positions, &faces, 1e-4, 50.0);
        assert!(coarse.len() == 1 && fine.len() > 50, "{} and {}", coarse.len(), fine.len());
    }
}
