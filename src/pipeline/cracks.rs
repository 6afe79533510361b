//! How much of a surface's border lies beside another border without meeting it.
//!
//! Deliveries in tiles end where their tiles do; where two of them agree they were welded, where they do not a crack
//! stays, and is told in metres.

use std::collections::{BTreeMap, HashMap};

use glam::{DVec3, I64Vec3};

use crate::mesh::Mesh;

/// Grid in which borders are looked up, metres: a few edges of a dense mesh.
const CELL_M: f64 = 0.5;
/// Longer borders than this many cells are not looked at: they are the rim of something made by hand.
const MOST_CELLS: i64 = 4096;

/// Length of open edges that have a vertex of another open edge within `near_m`, metres; edges of which `is_wall` holds
/// for both ends are met by another cell and do not count.
pub(super) fn length_m(mesh: &Mesh, near_m: f64, is_wall: impl Fn(DVec3) -> bool) -> f64 {
    let mut edges: BTreeMap<(u32, u32), u32> = BTreeMap::new();
    for &[a, b, c] in &mesh.faces {
        for (u, v) in [(a, b), (b, c), (c, a)] {
            *edges.entry((u.min(v), u.max(v))).or_default() += 1;
        }
    }
    let at = |v: u32| mesh.positions[v as usize];
    let is_open =
        |(&(u, v), count): (&(u32, u32), &u32)| (*count == 1 && !(is_wall(at(u)) && is_wall(at(v)))).then_some((u, v));
    let open: Vec<(u32, u32)> = edges.iter().filter_map(is_open).collect();
    let mut ends: Vec<u32> = open.iter().flat_map(|&(u, v)| [u, v]).collect();
    ends.sort_unstable();
    ends.dedup();
    let cell = |p: DVec3| (p / CELL_M).floor().as_i64vec3();
    let mut by_cell: HashMap<I64Vec3, Vec<u32>> = HashMap::new();
    ends.iter().for_each(|&v| by_cell.entry(cell(at(v))).or_default().push(v));
    let is_cracked = |&(u, v): &(u32, u32)| {
        let (low, high) = (cell(at(u).min(at(v)) - near_m), cell(at(u).max(at(v)) + near_m));
        let size = high - low + 1;
        if size.x.saturating_mul(size.y).saturating_mul(size.z) > MOST_CELLS {
            return false;
        }
        let mut cells = (low.x..=high.x)
            .flat_map(|x| (low.y..=high.y).flat_map(move |y| (low.z..=high.z).map(move |z| I64Vec3::new(x, y, z))));
        cells.any(|c| {
            let near = |w: &u32| *w != u && *w != v && distance(at(*w), at(u), at(v)) <= near_m;
            by_cell.get(&c).is_some_and(|vertices| vertices.iter().any(near))
        })
    };
    open.iter().filter(|e| is_cracked(e)).map(|&(u, v)| (at(u) - at(v)).length()).sum()
}

fn distance(p: DVec3, a: DVec3, b: DVec3) -> f64 {
    let along = b - a;
    let t = ((p - a).dot(along) / along.length_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    (a + along * t - p).length()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two strips of one square each, `gap` apart along x = 1.
    fn strips(gap: f64) -> Mesh {
        let at = |x: f64, y: f64| DVec3::new(x, y, 0.0);
        let (l, r) = (1.0, 1.0 + gap);
        let positions =
            vec![at(0., 0.), at(l, 0.), at(l, 1.), at(0., 1.), at(r, 0.), at(2., 0.), at(2., 1.), at(r, 1.)];
        Mesh { positions, faces: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], ..Mesh::default() }
    }

    #[test]
    fn both_sides_of_a_crack_count_and_a_street_does_not() {
        assert_eq!(length_m(&strips(2.0), 0.02, |_| false), 0.0);
        let cracked = length_m(&strips(0.01), 0.02, |_| false);
        // The two sides, and the four borders that end there.
        assert!((cracked - 6.0).abs() < 0.05, "{cracked}");
        assert!(length_m(&strips(0.01), 0.02, |p| p.y == 0.0 || p.y == 1.0) < 1e-9, "walls are met elsewhere");
    }
}
