//! The numbers of a cut that the paper reports, for one class or several together.

use serde::Serialize;

use crate::ids::ClassScheme;
use crate::measure::{ClassFigures, Figures, Summary};

/// How far a cut is off, metres.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Numbers {
    /// Faces of the source.
    pub source_faces: usize,
    /// Faces of the cut; each is of the class that its middle is nearest to.
    pub cut_faces: usize,
    /// Two-sided mean distance.
    pub mean_m: f64,
    /// Two-sided root mean square.
    pub rms_m: f64,
    /// The mean by the diagonal of the source's box.
    pub mean_rel: f64,
    /// Mean from the source to the cut: what was lost.
    pub source_to_cut_mean_m: Option<f64>,
    /// Mean from the cut to the source: what was invented.
    pub cut_to_source_mean_m: Option<f64>,
    /// The largest distance, both ways, is certainly not above this.
    pub hausdorff_upper_m: Option<f64>,
    /// The paper's metrics; none where the cut has no vertex of the class.
    pub paper: Option<PaperNumbers>,
}

/// Eq. 17 and 18, at vertices of the cut.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PaperNumbers {
    /// N.
    pub vertices: usize,
    /// Eq. 17, the mean distance.
    pub eq17_mean_m: f64,
    /// Eq. 18 as printed: the root of the mean distance, m^½.
    pub eq18_as_printed_sqrt_m: f64,
    /// The root of the mean square that Eq. 18 is named after.
    pub true_rms_m: f64,
}

/// The numbers of a class.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassNumbers {
    /// The class's name.
    pub name: String,
    /// Its numbers.
    #[serde(flatten)]
    pub numbers: Numbers,
}

impl ClassNumbers {
    /// None for a class that the scheme does not have or that nothing was measured of.
    pub(super) fn of(scheme: &ClassScheme, class: &ClassFigures) -> Option<Self> {
        let name = scheme.0.get(class.class.index())?.name.clone();
        Some(Self { name, numbers: Numbers::of(&[&class.figures])? })
    }
}

impl Numbers {
    /// Several classes as one: samples are spread by area, so each class counts by its number of them.
    pub(super) fn of(parts: &[&Figures]) -> Option<Self> {
        let there = Moments::of(parts.iter().filter_map(|f| f.reference_to_simplified.as_ref()));
        let back = Moments::of(parts.iter().filter_map(|f| f.simplified_to_reference.as_ref()));
        let both = match (there, back) {
            (Some(there), Some(back)) => there.halfway(back),
            (one, other) => one.or(other)?,
        };
        let summaries = || parts.iter().filter_map(|f| f.two_sided.as_ref()).find(|s| s.mean_m > 0.0);
        let diagonal_m = summaries().map_or(f64::INFINITY, |s| s.mean_m / s.mean_rel);
        let uppers = parts.iter().filter_map(|f| f.hausdorff.two_sided).map(|i| i.upper_m);
        Some(Self {
            source_faces: parts.iter().map(|f| f.reference_faces).sum(),
            cut_faces: parts.iter().map(|f| f.simplified_faces).sum(),
            mean_m: both.mean,
            rms_m: both.mean_square.sqrt(),
            mean_rel: both.mean / diagonal_m,
            source_to_cut_mean_m: there.map(|m| m.mean),
            cut_to_source_mean_m: back.map(|m| m.mean),
            hausdorff_upper_m: uppers.reduce(f64::max),
            paper: paper(parts),
        })
    }
}

fn paper(parts: &[&Figures]) -> Option<PaperNumbers> {
    let found: Vec<_> = parts.iter().filter_map(|f| f.paper).collect();
    let vertices: usize = found.iter().map(|p| p.vertices).sum();
    if vertices == 0 {
        return None;
    }
    let mean = |of: fn(&crate::measure::PaperFigures) -> f64| {
        found.iter().map(|p| p.vertices as f64 * of(p)).sum::<f64>() / vertices as f64
    };
    let eq17_mean_m = mean(|p| p.eq17_mean_m);
    Some(PaperNumbers {
        vertices,
        eq17_mean_m,
        eq18_as_printed_sqrt_m: eq17_mean_m.sqrt(),
        true_rms_m: mean(|p| p.true_rms_m * p.true_rms_m).sqrt(),
    })
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Moments {
    mean: f64,
    mean_square: f64,
}

impl Moments {
    fn of<'a>(parts: impl Iterator<Item = &'a Summary>) -> Option<Self> {
        let mut sums = [0.0; 3];
        for part in parts {
            let count = part.samples as f64;
            for (sum, term) in sums.iter_mut().zip([1.0, part.mean_m, part.rms_m * part.rms_m]) {
                *sum += count * term;
            }
        }
        let [count, mean, square] = sums;
        (count > 0.0).then(|| Self { mean: mean / count, mean_square: square / count })
    }

    fn halfway(self, other: Self) -> Self {
        Self { mean: (self.mean + other.mean) / 2.0, mean_square: (self.mean_square + other.mean_square) / 2.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::ClassId;
    use crate::measure::{MeasureConfig, Surface, compare};
    use glam::DVec3;

    /// Strips of a square metre each at the heights given, of the classes 0, 1, 2 …
    fn strips(heights: &[f64]) -> Surface {
        let mut surface = Surface { class: Some(Vec::new()), ..Surface::default() };
        for (i, z) in heights.iter().enumerate() {
            let (x, first) = (3.0 * i as f64, surface.positions.len() as u32);
            let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
            surface.positions.extend(corners.map(|(u, v)| DVec3::new(x + u, v, *z)));
            surface.faces.extend([[0, 1, 2], [0, 2, 3]].map(|f| f.map(|v| v + first)));
            surface.class.as_mut().unwrap().extend([ClassId(i as u8); 2]);
        }
        surface
    }

    #[test]
    fn classes_together_count_by_their_area() {
        let config = MeasureConfig { samples: 4000, ..MeasureConfig::default() };
        let found = compare(&strips(&[0.0, 0.0, 0.0]), &strips(&[0.0, 0.3, 0.1]), &config);
        let parts: Vec<_> = found.by_class[1..].iter().map(|c| &c.figures).collect();
        let key = Numbers::of(&parts).unwrap();
        assert!((key.mean_m - 0.2).abs() < 1e-3, "{key:?}");
        assert!((key.rms_m - 0.05f64.sqrt()).abs() < 1e-3, "{key:?}");
        let paper = key.paper.unwrap();
        assert_eq!(paper.vertices, 8);
        assert!((paper.eq17_mean_m - 0.2).abs() < 1e-9 && (paper.true_rms_m - 0.05f64.sqrt()).abs() < 1e-9);
        let all = Numbers::of(&[&found.all]).unwrap();
        assert!((all.mean_m - found.all.two_sided.as_ref().unwrap().mean_m).abs() < 1e-9);
        assert_eq!(Numbers::of(&[]), None);
    }
}
