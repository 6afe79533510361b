//! The nine features of the paper's §2.2 as pure functions, each as printed and as it can be used.
//!
//! # References
//! The paper, §2.2, Eq. 1 to 8; CGAL Classification (`Vertical_dispersion.h`, `Verticality.h`, `Eigen.h`,
//! `Distance_to_plane.h`), from which the paper's features descend.

use glam::DVec3;

/// Eigenvalues below this are rounding, m²: the printed Eq. 7 and 8 divide by the smallest one.
pub const LEAST_EIGENVALUE: f64 = 1e-15;
/// Area at which a region's size has reached 63 % of its robust value, m².
pub const REGION_AREA_M2: f64 = 10.0;

/// (1) Distance of a point to the plane fitted to its neighbourhood: metres, ≥ 0. No equation is printed.
pub fn distance_to_plane_m(point: DVec3, centroid: DVec3, normal: DVec3) -> f64 {
    (point - centroid).dot(normal).abs()
}

/// (2) Vertical dispersion, Eq. 1 and 2: share of the height intervals of `step_m` between the lowest and the highest
/// of `heights_m` that hold none of them; no unit, 0 (gapless) to 1. `heights_m` must be in ascending order.
pub fn vertical_dispersion(heights_m: &[f64], step_m: f64) -> f64 {
    let (Some(low), Some(high)) = (heights_m.first(), heights_m.last()) else { return 0.0 };
    let interval = |z: f64| ((z - low) / step_m).floor();
    let total = interval(*high) + 1.0;
    let (mut occupied, mut last) = (0.0, -1.0);
    for z in heights_m {
        let own = interval(*z);
        if own != last {
            (occupied, last) = (occupied + 1.0, own);
        }
    }
    1.0 - occupied / total
}

/// (3) Elevation as printed: the point's height above the lowest of the data set, metres, ≥ 0. (The raw z of the paper
/// up to a constant; without it the feature would depend on where z = 0 lies.)
pub fn elevation_paper_m(z: f64, lowest: f64) -> f64 {
    z - lowest
}

/// (4) Vertical range, Eq. 3: metres, ≥ 0.
pub fn vertical_range_m(lowest: f64, highest: f64) -> f64 {
    highest - lowest
}

/// (5) Verticality, Eq. 4, with the vertical for the ground's normal: no unit, 0 (level) to 1 (upright).
pub fn verticality(normal: DVec3) -> f64 {
    1.0 - normal.z.abs()
}

/// (6) Region size as printed, Eq. 5: no unit, 0 to 1 between the fewest and the most vertices of any region.
pub fn region_size_paper(vertices: f64, fewest: f64, most: f64) -> f64 {
    if most > fewest { (vertices - fewest) / (most - fewest) } else { 0.0 }
}

/// (6) Region size that does not depend on the data set's largest plane: 1 - exp(-area / 10 m²); no unit, 0 to 1.
pub fn region_size(area_m2: f64) -> f64 {
    1.0 - (-area_m2 / REGION_AREA_M2).exp()
}

/// (7) Curvature, Eq. 6: mean of 1 - n·nᵢ over the faces around a vertex; no unit, 0 to 2 when `signed` (as printed: a
/// plane's normal that happens to point inwards gives 2 on a perfect plane), else 0 to 1.
pub fn curvature(plane: DVec3, faces: impl Iterator<Item = DVec3>, signed: bool) -> f64 {
    let one = |n: DVec3| 1.0 - if signed { plane.dot(n) } else { plane.dot(n).abs() };
    let (sum, count) = faces.fold((0.0, 0.0), |(sum, count), n| (sum + one(n), count + 1.0));
    if count > 0.0 { sum / count } else { 0.0 }
}

/// (8) Planarity as printed, Eq. 7: (λ₂ - λ₀) / λ₀ of ascending eigenvalues; no unit, ≥ 0, without bound on planes. The
/// numerator is that of CGAL's anisotropy: the paper's two names are swapped, and both divide by the wrong eigenvalue.
pub fn planarity_paper([l0, _, l2]: [f64; 3]) -> f64 {
    (l2 - l0) / l0.max(LEAST_EIGENVALUE)
}

/// (8) Planarity as CGAL and everyone else has it: (λ₁ - λ₀) / λ₂; no unit, 0 to 1.
pub fn planarity([l0, l1, l2]: [f64; 3]) -> f64 {
    if l2 < LEAST_EIGENVALUE { 0.0 } else { (l1 - l0) / l2 }
}

/// (9) Anisotropy as printed, Eq. 8: (λ₁ - λ₀) / λ₀; no unit, ≥ 0, without bound. See [`planarity_paper`].
pub fn anisotropy_paper([l0, l1, _]: [f64; 3]) -> f64 {
    (l1 - l0) / l0.max(LEAST_EIGENVALUE)
}

/// (9) Anisotropy as CGAL has it: (λ₂ - λ₀) / λ₂; no unit, 0 to 1. Near 1 on every surface, so of little use.
pub fn anisotropy([l0, _, l2]: [f64; 3]) -> f64 {
    if l2 < LEAST_EIGENVALUE { 0.0 } else { (l2 - l0) / l2 }
}

/// (9) Surface variation, what `robust` takes for anisotropy: λ₀ / Σλ; no unit, 0 (flat) to 1/3 (a ball).
pub fn surface_variation(eigenvalues: [f64; 3]) -> f64 {
    let sum: f64 = eigenvalues.iter().sum();
    if sum < LEAST_EIGENVALUE { 0.0 } else { eigenvalues[0] / sum }
}

/// Greenness of an sRGB colour, G - 0.39 B - 0.61 R: no unit, -255 to 255; grass and leaves have 10 and more.
pub fn greenness([r, g, b]: [u8; 3]) -> f64 {
    f64::from(g) - 0.39 * f64::from(b) - 0.61 * f64::from(r)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// λ of a flat patch with a little noise: 1 m² in the plane, 1 cm² across it.
    const FLAT: [f64; 3] = [1e-4, 1.0, 1.0];
    /// λ of a ball.
    const ROUND: [f64; 3] = [1.0; 3];

    #[test]
    fn printed_eigenvalue_features_saturate_on_planes_and_the_others_do_not() {
        assert!(planarity_paper(FLAT) > 9e3 && anisotropy_paper(FLAT) > 9e3);
        assert_eq!((planarity_paper(ROUND), anisotropy_paper(ROUND)), (0.0, 0.0));
        assert!((planarity(FLAT) - 0.9999).abs() < 1e-9 && planarity(ROUND) == 0.0);
        assert!(anisotropy(FLAT) > 0.99 && surface_variation(FLAT) < 1e-4);
        assert!((surface_variation(ROUND) - 1.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn a_perfect_plane_divides_by_no_zero() {
        for of in [planarity_paper, anisotropy_paper, planarity, anisotropy, surface_variation] {
            assert!(of([0.0, 1.0, 1.0]).is_finite() && of([0.0; 3]).is_finite());
        }
    }

    #[test]
    fn dispersion_counts_empty_intervals() {
        // Ground at 0, a crown from 4 m to 5 m: intervals 0, 8, 9, 10 of eleven are occupied.
        let tree = [0.0, 0.1, 4.0, 4.2, 4.6, 5.0];
        assert!((vertical_dispersion(&tree, 0.5) - 7.0 / 11.0).abs() < 1e-12);
        let wall: Vec<f64> = (0..20).map(|i| 0.25 * f64::from(i)).collect();
        assert_eq!(vertical_dispersion(&wall, 0.5), 0.0);
        assert_eq!((vertical_dispersion(&[], 0.5), vertical_dispersion(&[3.0], 0.5)), (0.0, 0.0));
    }

    #[test]
    fn a_wall_is_upright_and_a_roof_between() {
        assert_eq!((verticality(DVec3::Z), verticality(-DVec3::Z), verticality(DVec3::X)), (0.0, 0.0, 1.0));
        assert!((verticality(DVec3::new(1.0, 0.0, 1.0).normalize()) - 0.293).abs() < 1e-3);
    }

    #[test]
    fn curvature_as_printed_doubles_on_a_plane_that_faces_the_wrong_way() {
        let around = || [DVec3::Z; 6].into_iter();
        assert_eq!(curvature(DVec3::Z, around(), true), 0.0);
        assert_eq!(curvature(-DVec3::Z, around(), true), 2.0);
        assert_eq!(curvature(-DVec3::Z, around(), false), 0.0);
        assert_eq!(curvature(DVec3::Z, [].into_iter(), true), 0.0);
    }

    #[test]
    fn region_size_as_printed_hangs_on_the_largest_region_and_the_other_does_not() {
        assert_eq!([2.0, 6.0, 10.0].map(|x| region_size_paper(x, 2.0, 10.0)), [0.0, 0.5, 1.0]);
        assert_eq!(region_size_paper(5.0, 5.0, 5.0), 0.0);
        assert!((region_size(10.0) - 0.632).abs() < 1e-3 && region_size(0.0) == 0.0);
    }

    #[test]
    fn leaves_are_green_and_asphalt_is_not() {
        assert!(greenness([60, 90, 40]) > 30.0 && greenness([120; 3]).abs() < 1e-9 && greenness([160, 80, 60]) < -30.0);
    }

    #[test]
    fn elevation_range_and_distance_are_what_they_say() {
        assert_eq!((elevation_paper_m(7.0, 5.0), vertical_range_m(5.0, 9.0)), (2.0, 4.0));
        assert_eq!(distance_to_plane_m(DVec3::new(9.0, 9.0, 3.0), DVec3::Z, -DVec3::Z), 2.0);
    }
}
