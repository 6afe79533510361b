//! Principal axes of a symmetric 3 × 3 matrix: the one eigensolver of the planes through faces and through vertices.
//!
//! # Method      cyclic Jacobi rotations: unlike closed forms they lose nothing where two eigenvalues agree
//! # Promises    the same input gives the same bits; values ascend; the vector has unit length, whatever the matrix
//! # References  Golub, Van Loan, Matrix Computations, 4th ed., 2013, §8.5

use glam::DVec3;

/// Off-diagonal entries below this share of the diagonal's size are rounding.
const ROUNDING: f64 = 1e-15;

/// Ascending eigenvalues of a symmetric matrix (xx, yy, zz, xy, xz, yz) and the unit vector of the least; up for a
/// matrix of zeros or of what is not finite.
pub fn eigen([xx, yy, zz, xy, xz, yz]: [f64; 6]) -> ([f64; 3], DVec3) {
    let mut a = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let mut vectors = [DVec3::X, DVec3::Y, DVec3::Z];
    let tiny = ROUNDING * (xx.abs() + yy.abs() + zz.abs());
    // Convergence is quadratic: six sweeps reach rounding from anywhere.
    for _ in 0..6 {
        if a[0][1].abs() + a[0][2].abs() + a[1][2].abs() <= tiny {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] != 0.0 {
                rotate(&mut a, &mut vectors, p, q);
            }
        }
    }
    let mut order = [0, 1, 2];
    // Of equals the last: what has no axis of its own points up.
    order.sort_by(|i, j| a[*i][*i].total_cmp(&a[*j][*j]).then(j.cmp(i)));
    (order.map(|i| a[i][i]), vectors[order[0]].normalize_or(DVec3::Z))
}

/// Makes entry p, q zero.
fn rotate(a: &mut [[f64; 3]; 3], vectors: &mut [DVec3; 3], p: usize, q: usize) {
    let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
    let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    for row in a.iter_mut() {
        (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
    }
    let (above, below) = (a[p], a[q]);
    for k in 0..3 {
        a[p][k] = c * above[k] - s * below[k];
        a[q][k] = s * above[k] + c * below[k];
    }
    (vectors[p], vectors[q]) = (c * vectors[p] - s * vectors[q], s * vectors[p] + c * vectors[q]);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Σ λ v vᵀ over three orthonormal axes, the first of which is along `of`.
    fn matrix(of: DVec3, values: [f64; 3]) -> [f64; 6] {
        let first = of.normalize();
        let (second, third) = first.any_orthonormal_pair();
        let entry = |i: usize, j: usize| {
            let axes = [first, second, third].into_iter().zip(values);
            axes.map(|(v, value)| value * v[i] * v[j]).sum::<f64>()
        };
        [entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2)]
    }

    #[test]
    fn values_and_the_least_axis_of_any_matrix_come_back() {
        for (i, of) in [[1.0, 2.0, 3.0], [-1.0, 0.1, 1e-4], [0.0, 0.0, 1.0], [5.0, -5.0, 5.0]].into_iter().enumerate() {
            let of = DVec3::from_array(of);
            for want in [[1e-6, 2.0, 3.0], [0.5, 1e3, 1e3], [-0.1, 0.0, 4.0]] {
                let (values, least) = eigen(matrix(of, want));
                let scale = want[2];
                assert!(
                    values.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-13 * scale),
                    "{i}: {values:?} {want:?}"
                );
                assert!(least.dot(of.normalize()).abs() > 1.0 - 1e-12, "{i}: {least}");
            }
        }
    }

    #[test]
    fn nothing_and_nonsense_point_up() {
        assert_eq!(eigen([0.0; 6]), ([0.0; 3], DVec3::Z));
        assert_eq!(eigen([f64::NAN; 6]).1, DVec3::Z);
    }
}
