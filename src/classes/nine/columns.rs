//! What stands above each other: heights of points by cells of a plan grid that stores occupied cells only.
//!
//! # Promises    cells are counted from the first point's, so moving everything moves nothing
//! # Cost        one sort; memory by occupied cells, whatever the extent

use glam::DVec3;
use rayon::prelude::*;

/// A disc has this many cells along its radius: 21 cells in all, what CGAL's grid of a fifth of the neighbourhood has.
pub const CELLS_PER_RADIUS: f64 = 2.5;

/// Points by plan cell.
pub struct Columns {
    /// Occupied cells, by row and then column, in order.
    keys: Vec<(i64, i64)>,
    /// Heights of cell c: `heights[start[c]..start[c + 1]]`, ascending.
    start: Vec<u32>,
    heights: Vec<f64>,
    /// Cell of each point.
    cell_of: Vec<u32>,
}

impl Columns {
    /// Files points for discs of `radius_m`.
    pub fn of(points: &[DVec3], radius_m: f64) -> Self {
        let cell_m = radius_m / CELLS_PER_RADIUS;
        let origin = points.first().copied().unwrap_or(DVec3::ZERO);
        let key = |p: &DVec3| {
            let q = ((*p - origin) / cell_m).floor();
            (q.y as i64, q.x as i64)
        };
        let mut order: Vec<((i64, i64), f64, u32)> =
            points.par_iter().enumerate().map(|(i, p)| (key(p), p.z, i as u32)).collect();
        order.par_sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        let mut columns =
            Self { keys: Vec::new(), start: Vec::new(), heights: Vec::new(), cell_of: vec![0; points.len()] };
        for (at, (key, z, point)) in order.into_iter().enumerate() {
            if columns.keys.last() != Some(&key) {
                columns.keys.push(key);
                columns.start.push(at as u32);
            }
            columns.heights.push(z);
            columns.cell_of[point as usize] = columns.keys.len() as u32 - 1;
        }
        columns.start.push(columns.heights.len() as u32);
        columns
    }

    /// For each point a value made of the ascending heights in the disc about its cell.
    pub fn per_point(&self, value: impl Fn(&[f64]) -> f64 + Sync) -> Vec<f32> {
        let of_cell = |gathered: &mut Vec<f64>, cell: usize| {
            gathered.clear();
            self.disc(cell, |heights| gathered.extend_from_slice(heights));
            gathered.sort_unstable_by(f64::total_cmp);
            value(gathered) as f32
        };
        let cells = (0..self.keys.len()).into_par_iter().with_min_len(256).map_init(Vec::new, of_cell);
        let values: Vec<f32> = cells.collect();
        self.cell_of.iter().map(|c| values[*c as usize]).collect()
    }

    /// For each point a value made of the lowest and the highest height in the disc; cheaper than [`Self::per_point`].
    pub fn per_point_extremes(&self, value: impl Fn(f64, f64) -> f64 + Sync) -> Vec<f32> {
        let of_cell = |cell: usize| {
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            self.disc(cell, |heights| {
                (low, high) = (low.min(heights[0]), high.max(heights[heights.len() - 1]));
            });
            value(low, high) as f32
        };
        let values: Vec<f32> = (0..self.keys.len()).into_par_iter().with_min_len(256).map(of_cell).collect();
        self.cell_of.iter().map(|c| values[*c as usize]).collect()
    }

    /// Visits the occupied cells whose centres lie within the radius of a cell's centre.
    fn disc(&self, cell: usize, mut visit: impl FnMut(&[f64])) {
        let (row, column) = self.keys[cell];
        let reach = CELLS_PER_RADIUS as i64;
        for dy in -reach..=reach {
            let wide = (CELLS_PER_RADIUS * CELLS_PER_RADIUS - (dy * dy) as f64).max(0.0).sqrt() as i64;
            let from = self.keys.partition_point(|k| *k < (row + dy, column - wide));
            for c in from..self.keys.len() {
                if self.keys[c] > (row + dy, column + wide) {
                    break;
                }
                visit(&self.heights[self.start[c] as usize..self.start[c + 1] as usize]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disc_sees_what_is_near_in_plan_and_nothing_else() {
        // A mast of three points, one a metre beside it, one far away.
        let points = [[0.1, 0.1, 0.0], [0.1, 0.1, 5.0], [0.2, 0.1, 9.0], [1.0, 0.1, -2.0], [30.0, 0.0, 50.0]];
        let points = points.map(DVec3::from_array);
        let columns = Columns::of(&points, 1.25);
        assert_eq!(columns.per_point(|z| z.len() as f64), [4.0, 4.0, 4.0, 4.0, 1.0]);
        assert_eq!(columns.per_point_extremes(|low, high| high - low), [11.0, 11.0, 11.0, 11.0, 0.0]);
        assert_eq!(columns.per_point(|z| z[0]), columns.per_point_extremes(|low, _| low));
    }

    #[test]
    fn extents_of_thousands_of_kilometres_take_no_memory() {
        let columns = Columns::of(&[DVec3::ZERO, DVec3::splat(8e6)], 0.01);
        assert_eq!(columns.keys.len(), 2);
    }
}
