//! The number of faces at which one method is as accurate as another: Figure 8.

use serde::Serialize;

use super::{Bench, Curve, Cut};
use crate::Result;
use crate::collapse::Method;
use crate::report::Reporter;

/// The search ends where the mean is that near, as a share of the one wanted.
pub(super) const TOLERANCE: f64 = 0.005;
/// Where cuts are too coarse for that, a nearest one this near still tells the number by its curve.
const LOOSE: f64 = 0.03;
/// Or after this many cuts: the guesses are good to 5 % by the third.
const MOST_CUTS: usize = 6;
/// One guess is at most this many times the last.
const WIDEST_STEP: f64 = 4.0;
/// No guess is below: a closed island needs as many.
const FEWEST_FACES: usize = 4;

/// Faces at equal accuracy (mean distance, all classes).
#[derive(Debug, Clone, Serialize)]
pub struct Equal {
    /// The method's name.
    pub method: String,
    /// Faces of the cuts compared, as asked for.
    pub asked: String,
    /// Faces the baseline has there.
    pub baseline_faces: usize,
    /// The baseline's mean there, metres.
    pub baseline_mean_m: f64,
    /// Faces that the method needs for that mean; none if it was not found.
    pub faces: Option<usize>,
    /// Share of the baseline's faces that it spares.
    pub spared: Option<f64>,
    /// Faces that the baseline needs for the method's mean at the same number of faces: the paper's Figure 8.
    pub baseline_faces_for_method_mean: Option<usize>,
    /// Share of these that the method spares: the paper's 23 %.
    pub spared_as_in_paper: Option<f64>,
}

/// Every method but the baseline at each number of faces; what was measured on the way goes to `curves`.
pub(super) fn find(bench: &Bench, cuts: &[Cut], curves: &mut [Curve], reporter: &Reporter) -> Result<Vec<Equal>> {
    let methods = &bench.config.methods;
    let mut found = Vec::new();
    for row in cuts.chunks(methods.len().max(1)) {
        let Some((base, others)) = row.split_first() else { continue };
        for (i, cut) in others.iter().enumerate() {
            let mut search = |of: usize, wanted_m: f64| -> Result<Option<usize>> {
                let Some((method, curve)) = methods.get(of).zip(curves.get_mut(of)) else { return Ok(None) };
                faces_for(bench, method.0, wanted_m, &mut curve.points, reporter)
            };
            let faces = search(i + 1, base.all.mean_m)?;
            let baseline = search(0, cut.all.mean_m)?;
            found.push(Equal {
                method: cut.method.clone(),
                asked: cut.asked.clone(),
                baseline_faces: base.faces,
                baseline_mean_m: base.all.mean_m,
                faces,
                spared: faces.map(|f| 1.0 - f as f64 / base.faces as f64),
                baseline_faces_for_method_mean: baseline,
                spared_as_in_paper: baseline.map(|f| 1.0 - cut.faces as f64 / f as f64),
            });
        }
    }
    Ok(found)
}

/// Cuts until the mean is as wanted; begins from what is known of the method and adds to it.
fn faces_for(
    bench: &Bench,
    method: Method,
    wanted_m: f64,
    known: &mut Vec<(usize, f64)>,
    reporter: &Reporter,
) -> Result<Option<usize>> {
    for _ in 0..MOST_CUTS {
        reporter.check()?;
        let Some((faces, off)) = guess(known, wanted_m, bench.mesh.faces.len()) else { return Ok(None) };
        // A cut has the faces asked for or one less.
        let is_known = known.iter().any(|k| k.0 == faces || k.0 + 1 == faces);
        if off <= TOLERANCE || is_known {
            return Ok((off <= LOOSE).then_some(faces));
        }
        known.push(bench.mean(method, faces));
    }
    let last = guess(known, wanted_m, bench.mesh.faces.len());
    Ok(last.and_then(|(faces, off)| (off <= LOOSE).then_some(faces)))
}

/// The next number of faces to try, and how far the nearest known mean is off, as a share of the one wanted.
///
/// The mean falls about as a power of the number of faces, so that between the two nearest known cuts, or beyond them,
/// its logarithm is a straight line.
fn guess(known: &[(usize, f64)], wanted_m: f64, most: usize) -> Option<(usize, f64)> {
    let usable = |k: &&(usize, f64)| k.1 > 0.0 && k.1.is_finite();
    let mut near: Vec<(usize, f64)> = known.iter().filter(usable).copied().collect();
    if near.is_empty() || wanted_m.is_nan() || wanted_m <= 0.0 {
        return None;
    }
    let off = |k: &(usize, f64)| (k.1 / wanted_m).ln();
    near.sort_by(|a, b| off(a).abs().total_cmp(&off(b).abs()).then(a.0.cmp(&b.0)));
    let first = near[0];
    // On both sides of it, if there are such.
    let second = near.iter().skip(1).find(|k| off(k) * off(&first) < 0.0).or(near.get(1));
    let power = second.map_or(1.0, |s| {
        let slope = -(s.1 / first.1).ln() / (s.0 as f64 / first.0 as f64).ln();
        if slope.is_finite() && slope > 0.2 { slope } else { 1.0 }
    });
    let step = (off(&first) / power).exp().clamp(1.0 / WIDEST_STEP, WIDEST_STEP);
    let faces = (first.0 as f64 * step).round() as usize;
    Some((faces.clamp(FEWEST_FACES.min(most), most), off(&first).abs()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn guesses_come_to_the_faces_of_the_mean_that_is_wanted() {
        let mean = |faces: usize| 3.0 * (faces as f64).powf(-0.8) + 1e-4;
        let mut known = vec![(10_000, mean(10_000))];
        let wanted = mean(6200);
        for cuts in 0.. {
            assert!(cuts < 5, "{known:?}");
            let (faces, off) = guess(&known, wanted, 100_000).unwrap();
            if off <= TOLERANCE {
                assert!((6150..6250).contains(&faces), "{faces}");
                break;
            }
            known.push((faces, mean(faces)));
        }
    }

    #[test]
    fn what_cannot_be_reached_is_not_guessed_beyond_the_source() {
        let (faces, off) = guess(&[(1000, 0.5)], 0.01, 2000).unwrap();
        assert!(faces == 2000 && off > LOOSE);
        assert_eq!(guess(&[(1000, 0.5)], 0.0, 2000), None);
        assert_eq!(guess(&[(1000, 0.0)], 0.1, 2000), None);
    }
}
