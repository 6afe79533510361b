//! Product rules: how well each class explains a face.
//!
//! Every cue is a sigmoid in [0, 1]; a class is the product of what it needs. The forms are those of Verdie,
//! Lafarge and Alliez (LOD generation for urban scenes, 2015), the cues our own.

use super::ClassesConfig;
use super::features::{Features, RegionFeatures};

/// Terrain, façade, roof, clutter.
pub type Scores = [f32; 4];

/// Least score of a class: no rule is so sure that neighbours could not overrule it.
const FLOOR: f32 = 0.02;

/// 0 far below `at`, 1 far above; `width` is the distance over which it goes from 0.27 to 0.73.
fn above(x: f32, at: f32, width: f32) -> f32 {
    1.0 / (1.0 + (-2.0 * (x - at) / width).exp())
}

/// Scores of face `f`, which sum to 1.
pub fn scores(features: &Features, f: usize, region: Option<&RegionFeatures>, config: &ClassesConfig) -> Scores {
    let height = features.height_m[f];
    let low = 1.0 - above(height, config.low_m as f32, 0.4);
    let high = above(height, config.high_m as f32, 0.7);
    let between = (1.0 - low - high).max(0.0);
    let flat = features.normal_z[f].abs();
    let mut scores = match region {
        Some(r) => {
            let smooth = 1.0 - above(r.spread, config.foliage_spread as f32, 0.06);
            let large = 1.0 - (-r.area_m2 / config.area_scale_m2 as f32).exp();
            let planar = smooth * (0.25 + 0.75 * large);
            let upright = 1.0 - above(r.normal_z.abs(), config.upright_deg.to_radians().sin() as f32, 0.06);
            // A wall stands free: its top is in the air. A cliff's top is ground.
            let free = above(r.top_m, config.wall_height_m as f32, 0.6);
            let rim = 0.7 + 0.3 * above(r.drop, 0.25, 0.2);
            [
                low * (1.0 - upright * free) * (0.5 + 0.5 * planar),
                planar * upright * free,
                planar * (1.0 - upright) * high * rim,
                (1.0 - planar) * (1.0 - low) + between * (1.0 - upright) + 0.3 * (1.0 - planar) * low * (1.0 - flat),
            ]
        }
        None => {
            let steep = 1.0 - above(flat, 0.4, 0.2);
            [low * (1.0 - 0.5 * steep), 0.15 * steep * (1.0 - low), 0.1 * (1.0 - steep) * high, (1.0 - low) * 0.75]
        }
    };
    let sum: f32 = scores.iter().sum::<f32>() + 4.0 * FLOOR;
    scores.iter_mut().for_each(|s| *s = (*s + FLOOR) / sum);
    scores
}
