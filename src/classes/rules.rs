//! Product rules: how well each class explains a face.
//!
//! Every cue is a sigmoid in [0, 1]; a class is the product of what it needs. The forms are those of Verdie,
//! Lafarge and Alliez (LOD generation for urban scenes, 2015), the cues our own.

use super::ClassesConfig;
use super::features::{Features, RegionFeatures};
use super::smooth::exp;

/// Terrain, façade, roof, clutter.
pub type Scores = [f32; 4];

/// Least score of a class: no rule is so sure that neighbours could not overrule it.
const FLOOR: f32 = 0.02;

/// Residual over the root of the area where a plane stops to be one.
const BENT: f32 = 0.018;
/// z of the normal of the steepest roof, a spire's: 65°.
const STEEPEST_ROOF: f32 = 0.42;

/// A level plane of this many m² that lies a metre or two above what is around it is made ground: a platform, a deck, an
/// embankment. What lies on the ground is smaller.
const MADE_GROUND_M2: f32 = 200.0;

/// 0 far below `at`, 1 far above; `width` is the distance over which it goes from 0.27 to 0.73.
fn above(x: f32, at: f32, width: f32) -> f32 {
    1.0 / (1.0 + exp(-2.0 * (x - at) / width))
}

/// Scores of face `f`, which sum to 1.
pub fn scores(features: &Features, f: usize, region: Option<&RegionFeatures>, config: &ClassesConfig) -> Scores {
    let height = features.height_m[f];
    let low = 1.0 - above(height, config.low_m as f32, 0.4);
    let high = above(height, config.high_m as f32, 0.7);
    let between = (1.0 - low - high).max(0.0);
    let flat = features.normals[f].z.abs();
    // A steep face on level ground is the side of something small: a car, a hedge, a trunk.
    let steep = 1.0 - above(flat, 0.5, 0.2);
    let aside = steep * (1.0 - above(features.ground_slope[f], 0.5, 0.3));
    let mut scores = match region {
        Some(r) => {
            let smooth = 1.0 - above(r.spread, config.foliage_spread as f32, 0.06);
            let large = 1.0 - exp(-r.area_m2 / config.area_scale_m2 as f32);
            // Noise grows with neither side of a plane; what bends departs in proportion to its size.
            let flatness = 1.0 - above(r.rms_m / r.area_m2.sqrt().max(1e-3), BENT, 0.008);
            // A plane through k rough faces is evidence in proportion to k; one without residual is at once.
            let evident = 1.0 - exp(-(r.faces as f32) / 20.0) * above(r.rms_m, 0.02, 0.01);
            let planar = smooth * flatness * evident * (0.25 + 0.75 * large);
            let upright = 1.0 - above(r.normal_z.abs(), config.upright_deg.to_radians().sin() as f32, 0.06);
            // A wall stands free: its top is in the air. A cliff's top is ground.
            let made = planar * above(r.area_m2, MADE_GROUND_M2, 80.0);
            let free = above(r.top_m, config.wall_height_m as f32, 0.6);
            [
                low * (1.0 - upright * free) * (0.5 + 0.5 * planar) * (1.0 - aside) + between * (1.0 - upright) * made,
                planar * upright * free,
                planar * above(r.normal_z, STEEPEST_ROOF, 0.12) * high,
                (1.0 - planar) * (1.0 - low)
                    + between * (1.0 - upright) * (1.0 - made)
                    + low * aside * (1.0 - planar * upright * free),
            ]
        }
        None => [
            low * (1.0 - aside),
            0.15 * steep * (1.0 - low),
            0.1 * (1.0 - steep) * high,
            (1.0 - low) * 0.75 + low * aside,
        ],
    };
    let sum: f32 = scores.iter().sum::<f32>() + 4.0 * FLOOR;
    scores.iter_mut().for_each(|s| *s = (*s + FLOOR) / sum);
    scores
}
