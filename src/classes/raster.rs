//! Operations on height grids: running extremes, means, gradients, filling. Row-major, `nx` × `ny` cells.

use rayon::prelude::*;

/// Height differences per cell along x and y: the gentler of both sides', zero at the bottom of a valley.
pub fn gradient(z: &[f32], nx: usize, ny: usize) -> (Vec<f32>, Vec<f32>) {
    let gentler = |a: f32, b: f32| {
        let is_valley = a < 0.0 && b > 0.0;
        if is_valley { 0.0 } else { a.abs().min(b.abs()) }
    };
    let one = |cell: usize, at: usize, n: usize, step: usize| {
        let before = if at > 0 { Some(z[cell] - z[cell - step]) } else { None };
        let after = if at + 1 < n { Some(z[cell + step] - z[cell]) } else { None };
        match (before, after) {
            (Some(a), Some(b)) => gentler(a, b),
            (a, b) => a.or(b).unwrap_or(0.0).abs(),
        }
    };
    let all = |of: &(dyn Fn(usize) -> f32 + Sync)| (0..z.len()).into_par_iter().with_min_len(4096).map(of).collect();
    (all(&|cell| one(cell, cell % nx, nx, 1)), all(&|cell| one(cell, cell / nx, ny, nx)))
}

pub fn neighbourhood(i: usize, j: usize, nx: usize, ny: usize) -> impl Iterator<Item = (usize, usize)> {
    let (xs, ys) = (i.saturating_sub(1)..(i + 2).min(nx), j.saturating_sub(1)..(j + 2).min(ny));
    ys.flat_map(move |y| xs.clone().map(move |x| (x, y)))
}

/// Minimum or maximum over windows of (2 half + 1)² cells, cut off at the grid's rim. Infinite cells take part.
///
/// Windows double until two of them cover the wanted one: log₂ passes of the simplest kind. Cells repeated beyond
/// the rim are in every window that reaches there anyway.
pub fn extreme(z: &[f32], nx: usize, ny: usize, half: usize, pick: impl Fn(f32, f32) -> f32 + Copy + Sync) -> Vec<f32> {
    let window = 2 * half + 1;
    let mut rows = vec![0.0; z.len()];
    rows.par_chunks_mut(nx).zip(z.par_chunks(nx)).with_min_len(16).for_each_init(
        || (Vec::new(), Vec::new()),
        |(padded, next), (out, row)| {
            let beyond = |cell: f32| std::iter::repeat_n(cell, half);
            padded.clear();
            padded.extend(beyond(row[0]).chain(row.iter().copied()).chain(beyond(row[nx - 1])));
            let mut have = 1;
            while 2 * have <= window {
                next.clear();
                next.extend(padded.iter().zip(&padded[have..]).map(|(a, b)| pick(*a, *b)));
                std::mem::swap(padded, next);
                have *= 2;
            }
            let ends = padded.iter().zip(&padded[window - have..]);
            out.iter_mut().zip(ends).for_each(|(out, (a, b))| *out = pick(*a, *b));
        },
    );
    columns(&rows, nx, ny, window, pick)
}

/// The same along columns, whole rows at a time.
fn columns(z: &[f32], nx: usize, ny: usize, window: usize, pick: impl Fn(f32, f32) -> f32 + Copy + Sync) -> Vec<f32> {
    let half = window / 2;
    let both = |from: &[f32], a: usize, b: usize, out: &mut [f32]| {
        let (a, b) = (&from[a * nx..(a + 1) * nx], &from[b * nx..(b + 1) * nx]);
        out.iter_mut().zip(a.iter().zip(b)).for_each(|(out, (a, b))| *out = pick(*a, *b));
    };
    let mut padded = Vec::with_capacity((ny + 2 * half) * nx);
    (0..half).for_each(|_| padded.extend_from_slice(&z[..nx]));
    padded.extend_from_slice(z);
    (0..half).for_each(|_| padded.extend_from_slice(&z[(ny - 1) * nx..]));
    let mut next = vec![0.0; padded.len()];
    let mut have = 1;
    let mut left = ny + 2 * half;
    while 2 * have <= window {
        left -= have;
        let rows = next[..left * nx].par_chunks_mut(nx).with_min_len(16).enumerate();
        rows.for_each(|(j, out)| both(&padded, j, j + have, out));
        std::mem::swap(&mut padded, &mut next);
        have *= 2;
    }
    next.truncate(ny * nx);
    let rows = next.par_chunks_mut(nx).with_min_len(16).enumerate();
    rows.for_each(|(j, out)| both(&padded, j, j + window - have, out));
    next
}

/// `f32::min` without its care for NaN, which the grid cannot hold: half the time.
pub fn lower(a: f32, b: f32) -> f32 {
    if b < a { b } else { a }
}

/// See [`lower`].
pub fn higher(a: f32, b: f32) -> f32 {
    if b > a { b } else { a }
}

fn transposed(z: &[f32], nx: usize, ny: usize) -> Vec<f32> {
    let mut out = vec![0.0; z.len()];
    out.par_chunks_mut(ny).enumerate().for_each(|(i, column)| {
        column.iter_mut().enumerate().for_each(|(j, out)| *out = z[j * nx + i]);
    });
    out
}

/// Mean over windows of (2 half + 1)² cells, cut off at the rim.
pub fn mean(z: &[f32], nx: usize, ny: usize, half: usize) -> Vec<f32> {
    let along_rows = |z: &[f32], nx: usize| -> Vec<f32> {
        let mut out = vec![0.0; z.len()];
        out.par_chunks_mut(nx).zip(z.par_chunks(nx)).for_each(|(out, row)| {
            for (i, out) in out.iter_mut().enumerate() {
                let around = &row[i.saturating_sub(half)..(i + half + 1).min(row.len())];
                *out = around.iter().sum::<f32>() / around.len() as f32;
            }
        });
        out
    };
    let turned = transposed(&along_rows(z, nx), nx, ny);
    transposed(&along_rows(&turned, ny), ny, nx)
}

/// Interpolates infinite cells: averages go up a pyramid, come down bilinearly and are relaxed towards a membrane.
/// `first` are the numbers of the first cell: of cells 2 i and 2 i + 1 the pyramid makes one, so that grids that are parts
/// of one lattice are filled alike.
pub fn fill(z: Vec<f32>, nx: usize, ny: usize, first: [i64; 2]) -> Vec<f32> {
    if z.iter().all(|v| v.is_finite()) {
        return z;
    }
    if nx * ny == 1 {
        return vec![0.0];
    }
    // Two cells around zero would stay two for ever.
    let first = if nx.max(ny) <= 2 { [0, 0] } else { first };
    let odd = first.map(|n| n.rem_euclid(2) as usize);
    let (cx, cy) = ((nx + odd[0]).div_ceil(2), (ny + odd[1]).div_ceil(2));
    let mut coarse = vec![f32::INFINITY; cx * cy];
    for (cell, out) in coarse.iter_mut().enumerate() {
        let both = |p: usize, odd: usize, n: usize| (2 * p).saturating_sub(odd)..(2 * p + 2 - odd).min(n);
        let (xs, ys) = (both(cell % cx, odd[0], nx), both(cell / cx, odd[1], ny));
        let known = ys.flat_map(|y| xs.clone().map(move |x| y * nx + x)).map(|at| z[at]);
        let (sum, n) = known.filter(|v| v.is_finite()).fold((0.0, 0), |(s, n), v| (s + v, n + 1));
        if n > 0 {
            *out = sum / n as f32;
        }
    }
    let coarse = fill(coarse, cx, cy, first.map(|n| n.div_euclid(2)));
    let holes: Vec<usize> = (0..z.len()).filter(|&cell| !z[cell].is_finite()).collect();
    let mut out = z;
    for &cell in &holes {
        let at = |p: usize, odd: usize, n: usize| {
            let q = ((p + odd) as f32 - 0.5) / 2.0;
            let q = q.clamp(0.0, (n - 1) as f32);
            (q as usize, (q as usize + 1).min(n - 1), q.fract())
        };
        let ((i, k, u), (j, l, v)) = (at(cell % nx, odd[0], cx), at(cell / nx, odd[1], cy));
        let lower = coarse[j * cx + i] * (1.0 - u) + coarse[j * cx + k] * u;
        let upper = coarse[l * cx + i] * (1.0 - u) + coarse[l * cx + k] * u;
        out[cell] = lower * (1.0 - v) + upper * v;
    }
    // Gauss-Seidel in cell order: deterministic, and the pyramid leaves only short waves to smooth.
    for _ in 0..12 {
        for &cell in &holes {
            let (i, j) = (cell % nx, cell / nx);
            let left = out[if i > 0 { cell - 1 } else { cell }];
            let right = out[if i + 1 < nx { cell + 1 } else { cell }];
            let below = out[if j > 0 { cell - nx } else { cell }];
            let above = out[if j + 1 < ny { cell + nx } else { cell }];
            out[cell] = 0.25 * (left + right + below + above);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_running_minimum_agrees_with_the_plain_one() {
        for (nx, ny) in [(53, 7), (7, 53), (1, 9), (20, 20)] {
            let z: Vec<f32> = (0..nx * ny).map(|i| ((i * 37) % 101) as f32).collect();
            for half in [1, 2, 3, 4, 7, 11, 25, 26, 40] {
                let out = extreme(&z, nx, ny, half, lower);
                for (cell, found) in out.iter().enumerate() {
                    let (i, j) = (cell % nx, cell / nx);
                    let near = |other: &usize| (other % nx).abs_diff(i) <= half && (other / nx).abs_diff(j) <= half;
                    let plain = (0..z.len()).filter(near).map(|other| z[other]).fold(f32::INFINITY, f32::min);
                    assert_eq!(*found, plain, "half {half}, cell {i}, {j} of {nx} × {ny}");
                }
            }
        }
    }

    #[test]
    fn holes_in_a_ramp_are_filled_with_the_ramp() {
        let (nx, ny) = (40, 30);
        let ramp: Vec<f32> = (0..nx * ny).map(|c| 0.5 * (c % nx) as f32).collect();
        let inside = |c: usize| (10..25).contains(&(c % nx)) && (8..20).contains(&(c / nx));
        let holed = (0..nx * ny).map(|c| if inside(c) { f32::INFINITY } else { ramp[c] }).collect();
        let filled = fill(holed, nx, ny, [0, 0]);
        let worst = filled.iter().zip(&ramp).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 0.5, "{worst}");
    }
}
