//! The ground under a scene: a height grid that runs below buildings and trees but follows slopes and cliffs.
//!
//! # Method
//! 1. A grid that lies askew to the mesh's own walls, so that it turns with the mesh. Lowest upward-facing surface per
//!    cell; feet of tall walls where nothing upward lies near them (buildings captured without their surroundings);
//!    small pits (reconstruction noise below ground) are filled. Beyond the border of the capture what is wide goes on.
//! 2. Openings with windows that grow cell by cell: what one step cuts off by more than the terrain's slope
//!    explains stands on the ground. Twice: the first pass allows [`STEEPEST`] everywhere and yields the local
//!    slope for the second. A cliff or terrace survives, since an opening cuts only what falls on all sides.
//! 3. Cells that were cut, and cells without surface, are interpolated from the others, coarse to fine.
//!
//! # Limits
//! a hill with vertical sides narrower than the widest window is an object; a building that hangs on a
//! slope without a free side is ground; skirts below a tile's rim can pass for wall feet; in the last five metres where a
//! cliff meets the border of the capture, heights lean on ground that is made up beyond
//!
//! # References
//! Zhang et al., A progressive morphological filter for removing nonground measurements, 2003

use glam::{DVec2, DVec3};

use super::ClassesConfig;
use super::raster::{extreme, fill, gradient, higher, lower, mean, neighbourhood};
use crate::mesh::Mesh;
use crate::planes::{NONE, Planes, Region};

/// Steepest ground the first pass believes in, metres per metre: 63°. Steep roofs still fall with their walls.
const STEEPEST: f32 = 2.0;
/// What a step may cut off beyond the slope's share, metres: kerbs, noise.
const STEP_SLACK_M: f32 = 0.3;
/// Slope allowed beyond the one measured in the first pass.
const SLOPE_SLACK: f32 = 0.15;
/// How far around a cell the slope is looked at, metres. Where the first pass left a house on the ground, its walls pass
/// for a slope that would keep it there: over 4 m such houses came and went with the place of the grid (roofs of a
/// hillside with three houses 4.6 to 5.6 % of its area, here 5.5 to 5.7); over 12 m steep banks are taken for objects.
const SLOPE_REACH_M: f64 = 8.0;
/// A face counts as upward above this z of its normal: 66°.
const UPWARD: f32 = 0.4;
/// Pits deeper than this and smaller than [`PIT_AREA_M2`] are noise.
const PIT_DEPTH_M: f32 = 1.5;
/// See [`PIT_DEPTH_M`]; alleys are longer, wells rarer than noise.
const PIT_AREA_M2: f64 = 12.0;
/// Walls at least this tall mark the ground with their feet.
const WALL_HEIGHT_M: f64 = 2.5;
/// Samples a single face may leave in the grid: bounds the time for huge faces.
const MAX_SAMPLES: f64 = 4096.0;
/// A height difference within 3 × 3 cells beyond this slope is a cliff: 63°.
const CLIFF: f32 = 2.0;

/// Empty cells around the mesh beyond half the widest window: closing a pit looks two cells far, and the border of a
/// capture has to look the same wherever it lies. The fraction keeps models whose vertices have a grid of their own off
/// the borders of cells, where rounding decides.
const MARGIN: f64 = 3.31;
/// What is narrower than twice this does not go on beyond the border of the capture, metres. Of a street corner with
/// trees at its border 87 % were right where they went on, 93 % are so.
const BORDER_M: f64 = 7.0;
/// What `max_cells` is at least: the margins alone take a hundred.
pub(super) const MIN_CELLS: u32 = 1024;
/// The grid lies askew to the walls, as far from along them as from diagonal: of a wall that follows a row of cells all
/// cells or none have ground in them, of one that crosses rows every other one has.
const ASKEW_DEG: f64 = 22.5;

/// Heights of the ground and of the lowest surface over a plan grid.
#[derive(Debug, Clone)]
pub struct Ground {
    /// A vertex in plan, from which everything is counted, so that moving the mesh moves nothing; the zero of all
    /// heights here.
    anchor: DVec3,
    /// The grid's first axis, a unit vector in plan.
    along: DVec2,
    /// Lower left corner of cell (0, 0) from the anchor along the grid's axes, metres.
    corner: DVec2,
    /// Number of the first cell along both axes of the lattice.
    first: [i64; 2],
    cell_m: f64,
    per_m: f64,
    nx: usize,
    ny: usize,
    /// Ground per cell centre.
    height: Vec<f32>,
    /// Highest ground of 3 × 3 cells.
    upper: Vec<f32>,
    /// Lowest surface per cell, infinite where there is none.
    lowest: Vec<f32>,
}

impl Ground {
    /// Models the ground of a mesh.
    pub fn of(mesh: &Mesh, planes: &Planes, config: &ClassesConfig) -> Self {
        Self::on(None, mesh, planes, config)
    }

    /// Models the ground of a mesh that may be a part of something larger with a lattice of its own.
    pub fn on(lattice: Option<Lattice>, mesh: &Mesh, planes: &Planes, config: &ClassesConfig) -> Self {
        let mut ground = Self::grid(lattice, mesh, planes, config);
        let (lowest, feet) = ground.lowest_surface(mesh, planes);
        ground.lowest = lowest;
        let widest = ((0.5 * config.widest_building_m / ground.cell_m).ceil() as usize).max(1);
        let cell = ground.cell_m as f32;
        let surface = ground.surface(&feet);
        let allowed = vec![STEEPEST * cell + STEP_SLACK_M; surface.len()];
        let first = ground.without_objects(&surface, &allowed, widest);
        let slope = ground.slope(&first);
        let allowed: Vec<f32> = slope.iter().map(|s| (s + SLOPE_SLACK).min(STEEPEST) * cell + STEP_SLACK_M).collect();
        let second = ground.without_objects(&surface, &allowed, widest);
        ground.height = ground.recentred(&second);
        ground.upper = extreme(&ground.height, ground.nx, ground.ny, 1, higher);
        ground
    }

    /// An empty grid with cells of a median edge (1 m to 3 m), coarser where the extent would need too many or most
    /// would be empty.
    fn grid(lattice: Option<Lattice>, mesh: &Mesh, planes: &Planes, config: &ClassesConfig) -> Self {
        let is_part = lattice.is_some();
        let Lattice { anchor, along, edge_m } = lattice.unwrap_or_else(|| {
            let first = mesh.positions.first().copied().unwrap_or(DVec3::ZERO);
            Lattice::over(&planes.regions, first, planes.median_edge_m)
        });
        let (mut low, mut high, mut least_z) = (DVec2::INFINITY, DVec2::NEG_INFINITY, f64::INFINITY);
        for p in &mesh.positions {
            let q = turned(along, *p - anchor);
            (low, high, least_z) = (low.min(q), high.max(q), least_z.min(p.z));
        }
        if mesh.positions.is_empty() {
            (low, high, least_z) = (DVec2::ZERO, DVec2::ZERO, 0.0);
        }
        let size = high - low;
        let worthwhile = 65_536.0 + 2.0 * mesh.faces.len() as f64;
        let mut cell_m = edge_m.clamp(1.0, 3.0);
        let margin = |cell: f64| (0.5 * config.widest_building_m / cell).ceil() + MARGIN;
        // A part may begin anywhere in a cell.
        let ends = if is_part { 2.0 } else { 1.0 };
        let cells = |extent: f64, cell: f64| (extent / cell + 2.0 * margin(cell)).floor() + ends;
        let most = f64::from(config.max_cells.max(MIN_CELLS));
        while size.x * size.y > worthwhile * cell_m * cell_m || cells(size.x, cell_m) * cells(size.y, cell_m) > most {
            cell_m *= 1.25;
        }
        // Parts of one lattice have their corners at whole cells of it.
        let first = if is_part { (low / cell_m - margin(cell_m)).floor() } else { DVec2::ZERO };
        let corner = if is_part { (first + MARGIN.fract()) * cell_m } else { low - margin(cell_m) * cell_m };
        Self {
            anchor: if is_part { anchor } else { anchor.with_z(least_z) },
            along,
            corner,
            first: [first.x as i64, first.y as i64],
            cell_m,
            per_m: 1.0 / cell_m,
            nx: cells(size.x, cell_m) as usize,
            ny: cells(size.y, cell_m) as usize,
            height: Vec::new(),
            upper: Vec::new(),
            lowest: Vec::new(),
        }
    }

    /// The plan position of a point, in cells from the corner of the first.
    fn plan(&self, p: DVec3) -> DVec2 {
        (turned(self.along, p - self.anchor) - self.corner) * self.per_m
    }

    /// Height of a point above the ground, metres. Beside a cliff the ground is its upper edge, so that the edge
    /// itself is not in the air.
    pub fn height_above(&self, p: DVec3) -> f32 {
        self.height_and_slope(p).0
    }

    /// Height above the ground as [`Self::height_above`], and its slope across the 3 × 3 cells around, metres per metre:
    /// large beside cliffs, small on roads and lawns.
    pub fn height_and_slope(&self, p: DVec3) -> (f32, f32) {
        let q = self.plan(p);
        let inside = |x: f64, n: usize| x.clamp(0.0, (n - 1) as f64);
        let (x, y) = (inside(q.x - 0.5, self.nx), inside(q.y - 0.5, self.ny));
        let (i, j) = ((x as usize).min(self.nx.saturating_sub(2)), (y as usize).min(self.ny.saturating_sub(2)));
        let (u, v) = ((x - i as f64) as f32, (y - j as f64) as f32);
        let at = |i: usize, j: usize| self.height[j.min(self.ny - 1) * self.nx + i.min(self.nx - 1)];
        let lower = at(i, j) * (1.0 - u) + at(i + 1, j) * u;
        let upper = at(i, j + 1) * (1.0 - u) + at(i + 1, j + 1) * u;
        let ground = lower * (1.0 - v) + upper * v;
        let cell = inside(q.y, self.ny) as usize * self.nx + inside(q.x, self.nx) as usize;
        let edge = self.upper[cell];
        let slope = (edge - self.height[cell]) * self.per_m as f32;
        let ground = if edge - ground > CLIFF * self.cell_m as f32 { edge } else { ground };
        (self.level(p) as f32 - ground, slope)
    }

    /// How far the lowest surface at the plan position of `p` lies below `p`; `None` where there is no surface.
    pub fn drop_below(&self, p: DVec3) -> Option<f32> {
        let low = self.lowest[self.cell(p)?];
        low.is_finite().then_some(self.level(p) as f32 - low)
    }

    /// Height of a point over the zero of the grid, metres.
    pub fn level(&self, p: DVec3) -> f64 {
        p.z - self.anchor.z
    }

    /// The cell at the plan position of `p`; `None` outside the grid.
    pub fn cell(&self, p: DVec3) -> Option<usize> {
        let q = self.plan(p);
        let (i, j) = (q.x as usize, q.y as usize);
        (q.x >= 0.0 && q.y >= 0.0 && i < self.nx && j < self.ny).then(|| j * self.nx + i)
    }

    /// Lowest upward surface per cell, completed by wall feet, without pits; and the feet that complete it, infinite
    /// elsewhere.
    fn lowest_surface(&self, mesh: &Mesh, planes: &Planes) -> (Vec<f32>, Vec<f32>) {
        let mut low = vec![f32::INFINITY; self.nx * self.ny];
        for f in 0..mesh.faces.len() {
            let normal: f32 = mesh.faces[f].iter().map(|&v| planes.vertex_normals[v as usize].z).sum::<f32>() / 3.0;
            if normal > UPWARD {
                self.for_cells(mesh.corners(f), |cell, z| {
                    low[cell] = low[cell].min(z as f32);
                });
            }
        }
        let mut feet = self.wall_feet(mesh, planes);
        let around = extreme(&low, self.nx, self.ny, 1, lower);
        for (cell, foot) in feet.iter_mut().enumerate() {
            if *foot + 2.0 < around[cell] {
                low[cell] = low[cell].min(*foot);
            } else {
                *foot = f32::INFINITY;
            }
        }
        (self.fill_pits(low), feet)
    }

    /// Visits the cells under a triangle with its [`Ground::level`] there: its corners, and its inside where it is wider than
    /// a cell. A cell may be visited several times.
    pub fn for_cells(&self, corners: [DVec3; 3], mut visit: impl FnMut(usize, f64)) {
        let [a, b, c] = corners.map(|p| self.plan(p).extend(self.level(p)));
        let mut put =
            |p: DVec3| visit((p.y as usize).min(self.ny - 1) * self.nx + (p.x as usize).min(self.nx - 1), p.z);
        [a, b, c].into_iter().for_each(&mut put);
        let (min, max) = (a.min(b).min(c).max(DVec3::ZERO), a.max(b).max(c));
        let first = DVec2::new(min.x as usize as f64, min.y as usize as f64);
        let (wide, tall) = ((max.x - first.x) as usize + 1, (max.y - first.y) as usize + 1);
        let twice = (b - a).truncate().perp_dot((c - a).truncate());
        if wide * tall <= 2 || twice == 0.0 {
            return;
        }
        // Twice a cell and direction: a slope's lowest point is missed by a quarter cell at most.
        let stride = 0.5 * (4.0 * (wide * tall) as f64 / MAX_SAMPLES).sqrt().ceil().max(1.0);
        let mut y = first.y + 0.25;
        while y <= max.y {
            let mut x = first.x + 0.25;
            while x <= max.x {
                let p = DVec2::new(x, y) - a.truncate();
                let wb = p.perp_dot((c - a).truncate()) / twice;
                let wc = (b - a).truncate().perp_dot(p) / twice;
                if wb >= 0.0 && wc >= 0.0 && wb + wc <= 1.0 {
                    put(DVec3::new(x, y, a.z + wb * (b.z - a.z) + wc * (c.z - a.z)));
                }
                x += stride;
            }
            y += stride;
        }
    }

    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.nx * self.ny
    }

    /// Groups of cells that touch (corners count), numbered in cell order; `NONE` for cells not taken.
    pub fn groups(&self, is_taken: impl Fn(usize) -> bool) -> (Vec<u32>, usize) {
        let mut group = vec![NONE; self.cells()];
        let (mut count, mut stack) = (0, Vec::new());
        for start in 0..group.len() {
            if group[start] != NONE || !is_taken(start) {
                continue;
            }
            group[start] = count;
            stack.push(start);
            while let Some(cell) = stack.pop() {
                for (x, y) in neighbourhood(cell % self.nx, cell / self.nx, self.nx, self.ny) {
                    let next = y * self.nx + x;
                    if group[next] == NONE && is_taken(next) {
                        group[next] = count;
                        stack.push(next);
                    }
                }
            }
            count += 1;
        }
        (group, count as usize)
    }

    /// The group of a cell, or else the first one that touches it.
    pub fn touching(&self, cell: usize, group: &[u32]) -> Option<u32> {
        let around =
            neighbourhood(cell % self.nx, cell / self.nx, self.nx, self.ny).map(|(x, y)| group[y * self.nx + x]);
        std::iter::once(group[cell]).chain(around).find(|g| *g != NONE)
    }

    /// Grows a set of cells by a distance, metres (at least one cell).
    pub fn grown(&self, cells: Vec<bool>, by_m: f64) -> Vec<bool> {
        let half = ((by_m / self.cell_m).round() as usize).max(1);
        let values: Vec<f32> = cells.into_iter().map(|is_in| f32::from(u8::from(is_in))).collect();
        extreme(&values, self.nx, self.ny, half, higher).into_iter().map(|v| v > 0.5).collect()
    }

    /// Slope of the ground, see [`Self::height_and_slope`].
    pub fn steepness(&self, p: DVec3) -> f32 {
        self.height_and_slope(p).1
    }

    /// Lowest corner per cell of the faces of tall, upright planes.
    fn wall_feet(&self, mesh: &Mesh, planes: &Planes) -> Vec<f32> {
        let mut feet = vec![f32::INFINITY; self.nx * self.ny];
        let mut span = vec![(f64::INFINITY, f64::NEG_INFINITY); planes.regions.len()];
        let upright = |r: u32| r != NONE && planes.regions[r as usize].normal.z.abs() < 0.2;
        for (f, &r) in planes.face_region.iter().enumerate().filter(|(_, r)| upright(**r)) {
            for p in mesh.corners(f) {
                let span = &mut span[r as usize];
                *span = (span.0.min(p.z), span.1.max(p.z));
            }
        }
        for (f, &r) in planes.face_region.iter().enumerate().filter(|(_, r)| upright(**r)) {
            let (bottom, top) = span[r as usize];
            for p in mesh.corners(f) {
                // Only the foot itself, not every course of bricks above it.
                if top - bottom > WALL_HEIGHT_M
                    && p.z < bottom + 0.25 * (top - bottom)
                    && let Some(cell) = self.cell(p)
                {
                    feet[cell] = feet[cell].min(self.level(p) as f32);
                }
            }
        }
        feet
    }

    /// Lifts small groups of cells that lie far below everything around them.
    fn fill_pits(&self, mut low: Vec<f32>) -> Vec<f32> {
        let (nx, ny) = (self.nx, self.ny);
        let negated = |v: &[f32]| -> Vec<f32> { v.iter().map(|z| if z.is_finite() { -z } else { *z }).collect() };
        let highest = extreme(&negated(&low), nx, ny, 2, lower);
        let closed = extreme(&negated(&highest), nx, ny, 2, lower);
        let is_pit = |z: f32, cell: usize| z.is_finite() && closed[cell] - z > PIT_DEPTH_M;
        let limit = ((PIT_AREA_M2 / (self.cell_m * self.cell_m)) as u32).max(1);
        let (group, groups) = self.groups(|cell| is_pit(low[cell], cell));
        let mut sizes = vec![0u32; groups];
        group.iter().filter(|g| **g != NONE).for_each(|g| sizes[*g as usize] += 1);
        for (cell, g) in group.into_iter().enumerate() {
            if g != NONE && sizes[g as usize] <= limit {
                low[cell] = closed[cell];
            }
        }
        low
    }

    /// Progressive opening: the surface with everything that a step cuts off by more than `allowed` replaced by
    /// interpolation.
    fn without_objects(&self, surface: &[f32], allowed: &[f32], widest: usize) -> Vec<f32> {
        let (nx, ny) = (self.nx, self.ny);
        let mut is_object: Vec<bool> = self.lowest.iter().map(|z| !z.is_finite()).collect();
        let mut opened = surface.to_vec();
        let mut eroded = surface.to_vec();
        for half in 1..=widest {
            // Eroding by one cell more each time is the same as eroding by a growing window.
            eroded = extreme(&eroded, nx, ny, 1, lower);
            let next = extreme(&eroded, nx, ny, half, higher);
            for cell in 0..next.len() {
                is_object[cell] |= opened[cell] - next[cell] > allowed[cell];
            }
            opened = next;
        }
        let kept = surface.iter().zip(&is_object).map(|(z, cut)| if *cut { f32::INFINITY } else { *z });
        self.filled(kept.collect())
    }

    /// The lowest surface everywhere. Beyond the border of the capture it goes on without what is narrow, and as low as
    /// the feet of walls near it: a tree or a house there must not look as if it went on, and so as ground.
    fn surface(&self, feet: &[f32]) -> Vec<f32> {
        let (nx, ny) = (self.nx, self.ny);
        let reach = ((BORDER_M / self.cell_m).round() as usize).max(1);
        let known = |height: Vec<f32>, otherwise: f32| -> Vec<f32> {
            let all = height.into_iter().zip(&self.lowest);
            all.map(|(z, lowest)| if lowest.is_finite() { z } else { otherwise }).collect()
        };
        let eroded = known(extreme(&self.lowest, nx, ny, reach, lower), f32::NEG_INFINITY);
        let opened = extreme(&eroded, nx, ny, reach, higher).into_iter();
        let low = opened.zip(extreme(feet, nx, ny, reach, lower)).map(|(z, foot)| lower(z, foot));
        let beyond = self.filled(known(low.collect(), f32::INFINITY));
        let near = extreme(&self.lowest, nx, ny, MARGIN as usize, lower);
        let within = self.filled(self.lowest.clone()).into_iter().zip(near);
        within.zip(beyond).map(|((z, near), beyond)| if near.is_finite() { z } else { beyond }).collect()
    }

    /// Heights with their holes filled.
    fn filled(&self, height: Vec<f32>) -> Vec<f32> {
        fill(height, self.nx, self.ny, self.first)
    }

    /// What the smoothed ground falls around a cell from one window to the next, metres per metre.
    fn slope(&self, height: &[f32]) -> Vec<f32> {
        let (nx, ny) = (self.nx, self.ny);
        let reach = ((SLOPE_REACH_M / self.cell_m).round() as usize).max(1);
        let smooth = mean(height, nx, ny, reach);
        let (gx, gy) = gradient(&smooth, nx, ny);
        // A square window that grows by a cell goes down by both.
        let slope: Vec<f32> = gx.iter().zip(&gy).map(|(x, y)| (x.abs() + y.abs()) * self.per_m as f32).collect();
        extreme(&slope, nx, ny, reach, higher)
    }

    /// The lowest point of a sloping cell lies on its rim; moves every height to what it is at the centre.
    fn recentred(&self, height: &[f32]) -> Vec<f32> {
        let (gx, gy) = gradient(height, self.nx, self.ny);
        let limit = STEEPEST * self.cell_m as f32;
        height.iter().zip(gx.iter().zip(&gy)).map(|(z, (x, y))| z + 0.5 * (x.min(limit) + y.min(limit))).collect()
    }
}

/// Coordinates in plan along an axis and across it.
fn turned(along: DVec2, p: DVec3) -> DVec2 {
    DVec2::new(along.x * p.x + along.y * p.y, along.x * p.y - along.y * p.x)
}

/// Where the cells of grids lie.
#[derive(Debug, Clone, Copy)]
pub struct Lattice {
    /// From here cells are counted in plan; the zero of heights.
    anchor: DVec3,
    /// First axis.
    along: DVec2,
    /// Median edge, metres.
    edge_m: f64,
}

impl Lattice {
    /// The lattice of a surface with these regions and this median edge.
    pub fn over(regions: &[Region], anchor: DVec3, edge_m: f64) -> Self {
        Self { anchor, along: direction(regions, anchor), edge_m }
    }
}

/// The grid's first axis, a unit vector that turns with the mesh: [`ASKEW_DEG`] from the direction in plan that most walls
/// and roofs follow or stand across; of the four such axes the one that has most of the mesh ahead and to its left, as
/// seen from its `first` vertex.
fn direction(regions: &[Region], first: DVec3) -> DVec2 {
    let (mut fourfold, mut ahead) = (DVec2::ZERO, DVec2::ZERO);
    for region in regions {
        let level = region.normal.truncate();
        // Turned four times as far, the four directions of a rectangle are one.
        let twice = level.rotate(level);
        fourfold += twice.rotate(twice) * (region.area_m2 / level.length_squared().max(1e-12));
        ahead += (region.centroid - first).truncate() * region.area_m2;
    }
    let one = DVec2::from_angle(0.25 * fourfold.to_angle() + ASKEW_DEG.to_radians());
    let of_four = [one, one.perp(), -one, -one.perp()];
    // In the first quadrant of the axes both coordinates are positive.
    let lead = |axis: &DVec2| turned(*axis, ahead.extend(0.0)).min_element();
    of_four.into_iter().reduce(|a, b| if lead(&b) > lead(&a) { b } else { a }).unwrap_or(DVec2::X)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A raster surface as a mesh of one-metre squares, and its ground.
    fn ground_of(n: usize, height: impl Fn(f64, f64) -> f64) -> (Mesh, Ground) {
        let mut mesh = Mesh::default();
        for j in 0..=n {
            for i in 0..=n {
                let (x, y) = (i as f64, j as f64);
                mesh.positions.push(DVec3::new(x, y, height(x, y)));
            }
        }
        for j in 0..n {
            for i in 0..n {
                let a = (j * (n + 1) + i) as u32;
                let up = n as u32 + 1;
                mesh.faces.extend([[a, a + 1, a + up + 1], [a, a + up + 1, a + up]]);
            }
        }
        let planes = crate::planes::grow(&mesh, &crate::planes::PlanesConfig::default());
        let ground = Ground::of(&mesh, &planes, &ClassesConfig::default());
        (mesh, ground)
    }

    fn in_square(x: f64, y: f64, low: f64, high: f64) -> bool {
        (low..=high).contains(&x) && (low..=high).contains(&y)
    }

    #[test]
    fn a_wide_flat_building_stands_on_the_ground_and_a_pit_below_it_is_noise() {
        let height = |x: f64, y: f64| if in_square(x, y, 30.0, 84.0) { 12.0 } else { 0.0 };
        let pit = |x: f64, y: f64| if in_square(x, y, 10.0, 11.0) { -15.0 } else { 0.0 };
        let (_, ground) = ground_of(120, |x, y| height(x, y) + pit(x, y));
        assert!((ground.height_above(DVec3::new(57.0, 57.0, 12.0)) - 12.0).abs() < 0.3);
        assert!(ground.height_above(DVec3::new(14.5, 14.5, 0.0)).abs() < 0.5);
    }

    #[test]
    fn a_slope_of_forty_degrees_with_a_ridge_is_all_ground() {
        let slope = 40f64.to_radians().tan();
        let (mesh, ground) = ground_of(100, |x, _| slope * (50.0 - (x - 50.0).abs()));
        let heights: Vec<f32> = mesh.positions.iter().map(|p| ground.height_above(*p)).collect();
        let aloft = heights.iter().filter(|h| **h > 0.9).count() as f64 / heights.len() as f64;
        // The ridge itself stands out of its cell by the cell's own relief.
        assert!(aloft < 0.02 && heights.iter().all(|h| *h < 1.5), "{aloft}");
    }

    #[test]
    fn a_house_in_a_hillside_with_a_tree_beside_it_stands_on_it_wherever_the_grid_lies() {
        // Eaves three metres above the slope behind, a gable along it, and foliage that comes down from the roof.
        let slope = |x: f64| 0.3 * x;
        let (mesh, _) = ground_of(90, |x, y| {
            let tree = slope(x) + 9.0 - 1.3 * (x - 52.0).hypot(y - 57.0);
            let house = slope(50.0) + 3.0 + 0.6 * (10.0 - (y - 42.0).abs());
            let is_house = (34.0..=50.0).contains(&x) && (32.0..=52.0).contains(&y);
            if is_house { house } else { slope(x).max(tree) }
        });
        let planes = crate::planes::grow(&mesh, &crate::planes::PlanesConfig::default());
        for phase in [0.0, 0.3, 0.5, 0.8] {
            let anchor = DVec3::new(phase, 0.7 * phase, 0.0);
            let lattice = Lattice::over(&planes.regions, anchor, 1.0);
            let ground = Ground::on(Some(lattice), &mesh, &planes, &ClassesConfig::default());
            for (x, y) in [(37.0, 36.0), (42.0, 42.0), (47.0, 48.0), (42.0, 48.0)] {
                let z = slope(50.0) + 3.0 + 0.6 * (10.0 - (y - 42.0f64).abs());
                let (found, true_height) = (ground.height_above(DVec3::new(x, y, z)), z - slope(x));
                assert!(f64::from(found) > 0.6 * true_height, "phase {phase}, ({x}, {y}): {found} of {true_height} m");
            }
        }
    }

    #[test]
    fn a_terrace_of_twenty_metres_is_ground_on_both_levels() {
        let (mesh, ground) = ground_of(100, |x, _| if x < 50.0 { 0.0 } else { 20.0 });
        // Where the edge meets the border of the capture, ground beyond is made up.
        let flat = |p: &&DVec3| !(48.0..=52.0).contains(&p.x) && (6.0..=94.0).contains(&p.y);
        let worst = mesh.positions.iter().filter(flat).map(|p| ground.height_above(*p).abs()).fold(0.0f32, f32::max);
        assert!(worst < 0.5, "{worst}");
        // The edge itself is not in the air.
        assert!(ground.height_above(DVec3::new(50.0, 50.0, 20.0)) < 0.9);
    }
}
