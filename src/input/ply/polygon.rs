//! Cuts a polygon into a fan of triangles.

use glam::DVec3;

/// Corners tried as the fan's hub; bounds the work on polygons of a million corners.
const MAX_HUBS: usize = 16;

/// The triangles of a polygon of three or more corners, as indices into `points`.
///
/// The hub is the corner whose fan folds back least; of equals in a quadrilateral the one on the shorter diagonal.
pub fn triangulate(points: &[DVec3], triangles: &mut Vec<[usize; 3]>) {
    triangles.clear();
    let n = points.len();
    let fan = |hub: usize| (1..n.saturating_sub(1)).map(move |k| [hub, (hub + k) % n, (hub + k + 1) % n]);
    let cross = |[a, b, c]: [usize; 3]| (points[b] - points[a]).cross(points[c] - points[a]);
    let normal: DVec3 = fan(0).map(cross).sum();
    let folded = |hub: usize| fan(hub).map(|t| (-cross(t).dot(normal)).max(0.0)).sum::<f64>();
    let diagonal = |hub: usize| if n == 4 { points[hub].distance_squared(points[(hub + 2) % 4]) } else { 0.0 };
    let best = |a: &usize, b: &usize| folded(*a).total_cmp(&folded(*b)).then(diagonal(*a).total_cmp(&diagonal(*b)));
    let hub = if n < 4 { 0 } else { (0..n.min(MAX_HUBS)).min_by(best).unwrap_or(0) };
    triangles.extend(fan(hub));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dart_is_cut_through_its_notch_and_a_kite_along_its_short_diagonal() {
        let flat = |points: &[(f64, f64)]| points.iter().map(|&(x, y)| DVec3::new(x, y, 0.0)).collect::<Vec<_>>();
        let mut triangles = Vec::new();
        triangulate(&flat(&[(0.0, 0.0), (2.0, 0.5), (0.0, 1.0), (0.5, 0.5)]), &mut triangles);
        assert_eq!(triangles, [[1, 2, 3], [1, 3, 0]]);
        triangulate(&flat(&[(0.0, 0.0), (1.0, -1.0), (9.0, 0.0), (1.0, 1.0)]), &mut triangles);
        assert_eq!(triangles, [[1, 2, 3], [1, 3, 0]]);
    }
}
