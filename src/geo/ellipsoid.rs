//! WGS 84: geodetic positions to and from Earth-centred metres, and the east-north-up axes of a place.
//!
//! # References
//! B. R. Bowring, The accuracy of geodetic latitude and height equations, Survey Review 28 (1985), iterated on the
//! reduced latitude.

use glam::{DMat3, DMat4, DVec3};

/// Semi-major axis of WGS 84, metres (defining).
pub const A_M: f64 = 6_378_137.0;
/// Flattening of WGS 84 (defining).
pub const F: f64 = 1.0 / 298.257_223_563;
/// First eccentricity squared.
pub const E2: f64 = F * (2.0 - F);
const B_M: f64 = A_M * (1.0 - F);
/// Second eccentricity squared.
const EP2: f64 = E2 / (1.0 - E2);

/// Rounds of Bowring's formula: one is good to 1e-9 m below 10 km of height, three to thousands of kilometres.
const ROUNDS: usize = 3;

/// A place on or above WGS 84.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Geodetic {
    /// East positive, radians.
    pub lon_rad: f64,
    /// North positive, geodetic, radians.
    pub lat_rad: f64,
    /// Above the ellipsoid (not the geoid), metres.
    pub height_m: f64,
}

impl Geodetic {
    /// From degrees, longitude first as in x, y.
    pub fn from_degrees(lon_deg: f64, lat_deg: f64, height_m: f64) -> Self {
        Self { lon_rad: lon_deg.to_radians(), lat_rad: lat_deg.to_radians(), height_m }
    }
}

/// Earth-centred metres of a place.
pub fn ecef_from_geodetic(place: Geodetic) -> DVec3 {
    let (sin_lat, cos_lat) = place.lat_rad.sin_cos();
    let (sin_lon, cos_lon) = place.lon_rad.sin_cos();
    let prime_vertical_m = A_M / (1.0 - E2 * sin_lat * sin_lat).sqrt();
    let from_axis_m = (prime_vertical_m + place.height_m) * cos_lat;
    DVec3::new(from_axis_m * cos_lon, from_axis_m * sin_lon, (prime_vertical_m * (1.0 - E2) + place.height_m) * sin_lat)
}

/// The place of Earth-centred metres.
///
/// Good to well under a micrometre from 1000 km below the ellipsoid outwards; near the Earth's centre, where the answer
/// is not unique, it is merely finite.
pub fn geodetic_from_ecef(ecef: DVec3) -> Geodetic {
    let from_axis_m = ecef.x.hypot(ecef.y);
    // Reduced latitude, first guess exact on the ellipsoid.
    let mut reduced = (ecef.z * A_M).atan2(from_axis_m * B_M);
    let mut lat_rad = 0.0;
    for _ in 0..ROUNDS {
        let (sin, cos) = reduced.sin_cos();
        lat_rad = f64::atan2(ecef.z + EP2 * B_M * sin.powi(3), from_axis_m - E2 * A_M * cos.powi(3));
        reduced = ((1.0 - F) * lat_rad.sin()).atan2(lat_rad.cos());
    }
    let (sin_lat, cos_lat) = lat_rad.sin_cos();
    // This form of the height has no division and so no weak latitude.
    let height_m = from_axis_m * cos_lat + ecef.z * sin_lat - A_M * (1.0 - E2 * sin_lat * sin_lat).sqrt();
    Geodetic { lon_rad: ecef.y.atan2(ecef.x), lat_rad, height_m }
}

/// Unit axes east, north, up of a place, as columns: the rotation from its tangent frame to ECEF.
pub fn enu_basis(place: Geodetic) -> DMat3 {
    let (sin_lat, cos_lat) = place.lat_rad.sin_cos();
    let (sin_lon, cos_lon) = place.lon_rad.sin_cos();
    DMat3::from_cols(
        DVec3::new(-sin_lon, cos_lon, 0.0),
        DVec3::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat),
        DVec3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat),
    )
}

/// The rigid transform from a place's tangent frame (metres east, north, up) to ECEF.
pub fn ecef_from_enu(place: Geodetic) -> DMat4 {
    let axes = enu_basis(place);
    DMat4::from_cols(
        axes.x_axis.extend(0.0),
        axes.y_axis.extend(0.0),
        axes.z_axis.extend(0.0),
        ecef_from_geodetic(place).extend(1.0),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn known_places_have_their_textbook_positions() {
        let at = |lon, lat, h| ecef_from_geodetic(Geodetic::from_degrees(lon, lat, h));
        assert!((at(0.0, 0.0, 0.0) - DVec3::new(A_M, 0.0, 0.0)).length() < 1e-9);
        assert!((at(0.0, 90.0, 10.0) - DVec3::new(0.0, 0.0, 6_356_752.314_245_179 + 10.0)).length() < 1e-9);
        // PROJ 9.5.1, +proj=cart +ellps=WGS84.
        let munich = DVec3::new(4_182_118.210_020_571, 850_861.566_290_411, 4_724_696.307_258_27);
        assert!((at(11.5, 48.1, 520.0) - munich).length() < 1e-8, "{}", at(11.5, 48.1, 520.0));
    }

    #[test]
    fn axes_are_right_handed_and_up_points_away_from_the_earth() {
        let place = Geodetic::from_degrees(-71.0, -33.0, 100.0);
        let axes = enu_basis(place);
        assert!((axes.determinant() - 1.0).abs() < 1e-15);
        let higher = ecef_from_geodetic(Geodetic { height_m: 101.0, ..place }) - ecef_from_geodetic(place);
        assert!((higher - axes.z_axis).length() < 1e-8);
        let norther = ecef_from_geodetic(Geodetic { lat_rad: place.lat_rad + 1e-7, ..place });
        assert!((norther - ecef_from_geodetic(place)).normalize().dot(axes.y_axis) > 1.0 - 1e-9);
    }

    proptest! {
        #[test]
        fn geodetic_to_ecef_and_back_stays_within_a_micrometre(
            lon in -180.0..180.0f64, lat in -90.0..=90.0f64, height in -11_000.0..400_000.0f64,
        ) {
            let ecef = ecef_from_geodetic(Geodetic::from_degrees(lon, lat, height));
            let back = geodetic_from_ecef(ecef);
            prop_assert!((ecef_from_geodetic(back) - ecef).length() < 1e-6);
            prop_assert!((back.height_m - height).abs() < 1e-6);
        }
    }
}
