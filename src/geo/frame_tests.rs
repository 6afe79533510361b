//! Tests of `frame`: against PROJ's numbers, closed forms, and typical mistakes.

use proptest::prelude::*;
use serde::Deserialize;

use super::*;

#[derive(Deserialize)]
struct Fixture {
    systems: Vec<System>,
}

#[derive(Deserialize)]
struct System {
    epsg: u32,
    origin: DVec3,
    points: Vec<Known>,
}

#[derive(Deserialize)]
struct Known {
    offset: DVec3,
    ecef: DVec3,
}

fn projected(text: &str, origin: DVec3) -> Georeference {
    Georeference::parse(text).unwrap().with_origin(origin)
}

/// UTM 32 at 60 N, 2.9 degrees east of the central meridian.
const ZONE_EDGE: DVec3 = DVec3::new(661_715.0, 6_655_200.0, 0.0);

#[test]
fn positions_agree_with_proj() {
    let fixture: Fixture = serde_json::from_str(include_str!("../../fixtures/crs_points.json")).unwrap();
    assert!(fixture.systems.len() >= 18);
    for System { epsg, origin, points } in fixture.systems {
        let frame = Frame::of(projected(&format!("EPSG:{epsg}"), origin), DVec3::ZERO).unwrap();
        let ecef_from_local = frame.ecef_from_local().unwrap();
        let axes = DMat3::from_mat4(ecef_from_local);
        let origin_ecef = points[0].ecef;
        let (mut absolute_m, mut relative_m) = (0.0f64, 0.0f64);
        for Known { offset, ecef } in &points {
            let local = frame.local_from_source(*offset).unwrap();
            absolute_m = absolute_m.max((ecef_from_local.transform_point3(local) - *ecef).length());
            relative_m = relative_m.max((local - axes.transpose() * (*ecef - origin_ecef)).length());
            let back = frame.source_from_local(local).unwrap();
            assert!((back - *offset).length() < 1e-6, "EPSG:{epsg}: {offset} came back as {back}");
        }
        println!("EPSG:{epsg}: absolute {absolute_m:.2e} m, relative {relative_m:.2e} m; {}", frame.describe());
        assert!(absolute_m < 0.02, "EPSG:{epsg}: absolute {absolute_m} m");
        assert!(relative_m < 0.02, "EPSG:{epsg}: relative {relative_m} m");
    }
}

#[test]
fn grid_north_near_a_zone_edge_at_60_north_is_2_6_degrees_off() {
    let frame = Frame::of(projected("EPSG:32632", ZONE_EDGE), DVec3::ZERO).unwrap();
    let summary = frame.describe();
    let (lon, lat) = (summary.origin_lon_deg.unwrap(), summary.origin_lat_deg.unwrap());
    // Convergence of a transverse Mercator grid to first order: longitude from the meridian times sine of latitude.
    let expected_deg = (lon - 9.0) * lat.to_radians().sin();
    let north = frame.local_from_source(DVec3::new(0.0, 500.0, 0.0)).unwrap();
    let turned_deg = north.x.atan2(north.y).to_degrees();
    assert!((turned_deg - expected_deg).abs() < 0.01, "{turned_deg} against {expected_deg}");
    assert!((2.4..2.7).contains(&turned_deg), "{turned_deg}");
    assert!((summary.convergence_deg.unwrap() - turned_deg).abs() < 1e-3);
    // What a program that takes grid axes for east and north gets wrong at 500 m.
    assert!((north - DVec3::new(0.0, 500.0, 0.0)).length() > 20.0);
    let scale = summary.scale.unwrap();
    assert!((500.0 / north.truncate().length() - scale).abs() < 1e-5, "{scale}");
}

#[test]
fn the_origin_is_the_anchor_and_up_is_up() {
    let origin = DVec3::new(452_315.0, 5_410_985.0, 0.0);
    let anchor = DVec3::new(120.0, -80.0, 35.0);
    let frame = Frame::of(projected("EPSG:32631", origin), anchor).unwrap();
    assert!(frame.local_from_source(anchor).unwrap().length() < 1e-8);
    let up = frame.local_from_source(anchor + DVec3::Z * 100.0).unwrap();
    assert!((up - DVec3::Z * 100.0).length() < 1e-8, "{up}");
    assert!((frame.describe().origin_height_m.unwrap() - 35.0).abs() < 1e-9);
    assert!((frame.geodetic_from_local(up).unwrap().height_m - 135.0).abs() < 1e-6);
}

#[test]
fn a_height_offset_lifts_the_origin_and_nothing_else() {
    let origin = DVec3::new(691_000.0, 5_334_000.0, 500.0);
    let plain = Frame::of(projected("EPSG:25832", origin), DVec3::ZERO).unwrap();
    let lifted = projected("EPSG:25832+7837", origin).with_height_offset(46.5).unwrap();
    let lifted = Frame::of(lifted, DVec3::ZERO).unwrap();
    let height = |frame: &Frame| frame.describe().origin_height_m.unwrap();
    assert!((height(&lifted) - height(&plain) - 46.5).abs() < 1e-9);
    let point = DVec3::new(0.0, 0.0, 12.0);
    assert!((lifted.local_from_source(point).unwrap() - point).length() < 1e-8);
}

#[test]
fn orthometric_heights_and_doubtful_datums_are_warned_of() {
    let codes = |text: &str, origin: DVec3, offset: Option<f64>| {
        let mut georeference = projected(text, origin);
        if let Some(offset) = offset {
            georeference = georeference.with_height_offset(offset).unwrap();
        }
        let reporter = Reporter::new(true);
        Frame::of(georeference, DVec3::ZERO).unwrap().warn(&reporter, Path::new("metadata.xml"));
        reporter.warnings().iter().map(|warning| warning.code).collect::<Vec<_>>()
    };
    let munich = DVec3::new(691_000.0, 5_334_000.0, 500.0);
    assert_eq!(codes("EPSG:25832", munich, None), [""; 0]);
    assert_eq!(codes("EPSG:25832+7837", munich, None), ["vertical-datum"]);
    assert_eq!(codes("EPSG:25832+7837", munich, Some(46.5)), [""; 0]);
    assert_eq!(codes("EPSG:26718", DVec3::new(585_000.0, 4_511_000.0, 0.0), None), ["datum-shift"]);
    // Swiss coordinates the wrong way round, and a model whose origin was forgotten.
    assert_eq!(codes("EPSG:2056", DVec3::new(1_199_880.0, 2_600_865.0, 0.0), None), ["crs-area"]);
    assert_eq!(codes("EPSG:25832", DVec3::ZERO, None), ["crs-area"]);
}

#[test]
fn feet_scale_east_north_and_height() {
    let origin = DVec3::new(989_791.0, 212_523.0, 0.0);
    let frame = Frame::of(projected("EPSG:2263", origin), DVec3::ZERO).unwrap();
    let foot_m = 1200.0 / 3937.0;
    let up = frame.local_from_source(DVec3::Z * 1000.0).unwrap();
    assert!((up - DVec3::Z * 1000.0 * foot_m).length() < 1e-6, "{up}");
    let east = frame.local_from_source(DVec3::X * 1000.0).unwrap();
    assert!((east.length() / (1000.0 * foot_m) - 1.0).abs() < 1e-4, "{east}");
    // Heights of NAVD88 in metres over a grid in feet, and in feet over a grid in metres.
    let metres = Frame::of(projected("EPSG:2263+5703", origin), DVec3::ZERO).unwrap();
    assert!((metres.local_from_source(DVec3::Z * 100.0).unwrap().z - 100.0).abs() < 1e-8);
    let feet = Frame::of(projected("EPSG:26918+6360", DVec3::new(585_000.0, 4_511_000.0, 0.0)), DVec3::ZERO).unwrap();
    assert!((feet.local_from_source(DVec3::Z * 100.0).unwrap().z - 100.0 * foot_m).abs() < 1e-8);
}

#[test]
fn local_frames_only_move_the_anchor_to_zero() {
    let anchor = DVec3::new(1e6, -2e6, 100.0);
    let frame = Frame::of(Georeference::Local, anchor).unwrap();
    assert_eq!(frame.local_from_source(anchor + DVec3::X), Some(DVec3::X));
    assert_eq!(frame.source_from_local(DVec3::Y), Some(anchor + DVec3::Y));
    assert_eq!((frame.ecef_from_local(), frame.geodetic_from_local(DVec3::ZERO)), (None, None));
    assert_eq!(frame.describe().kind, "local");
}

#[test]
fn enu_sources_keep_their_place_when_the_frame_moves_to_the_anchor() {
    let georeference = projected("ENU:48.14,11.58,520", DVec3::new(100.0, 200.0, 3.0));
    let place = ellipsoid::ecef_from_enu(Geodetic::from_degrees(11.58, 48.14, 520.0));
    for anchor in [DVec3::ZERO, DVec3::new(3000.0, -2000.0, 40.0)] {
        let frame = Frame::of(georeference.clone(), anchor).unwrap();
        assert!(frame.local_from_source(anchor).unwrap().length() < 1e-8);
        for source in [DVec3::ZERO, DVec3::new(-1500.0, 700.0, 90.0)] {
            let expected = place.transform_point3(source + DVec3::new(100.0, 200.0, 3.0));
            let local = frame.local_from_source(source).unwrap();
            let found = frame.ecef_from_local().unwrap().transform_point3(local);
            assert!((found - expected).length() < 1e-8, "{found} against {expected}");
            assert!((frame.source_from_local(local).unwrap() - source).length() < 1e-8);
        }
    }
}

#[test]
fn earth_centred_and_geographic_sources_find_the_same_place() {
    let place = Geodetic::from_degrees(11.58, 48.14, 520.0);
    let ecef = ellipsoid::ecef_from_geodetic(place);
    let geocentric = Frame::of(projected("EPSG:4978", ecef), DVec3::ZERO).unwrap();
    let geographic = Frame::of(projected("EPSG:4979", DVec3::ZERO), DVec3::new(11.58, 48.14, 520.0)).unwrap();
    for frame in [&geocentric, &geographic] {
        let found = frame.ecef_from_local().unwrap().transform_point3(DVec3::ZERO);
        assert!((found - ecef).length() < 1e-8, "{found}");
    }
    let point = DVec3::new(5.0, -6.0, 7.0);
    let local = geocentric.local_from_source(point).unwrap();
    assert!((local.length() - point.length()).abs() < 1e-8);
    assert!((geocentric.source_from_local(local).unwrap() - point).length() < 1e-8);
    assert!(Frame::of(projected("EPSG:4978", DVec3::ZERO), DVec3::ONE).is_err());
}

#[test]
fn misplaced_models_are_refused_with_a_hint() {
    let refusal = |text: &str, origin: DVec3| Frame::of(projected(text, origin), DVec3::ZERO).unwrap_err().to_string();
    let swapped = refusal("EPSG:25832", DVec3::new(5_334_000.0, 691_000.0, 0.0));
    assert!(swapped.contains("with x and y swapped it would fit"), "{swapped}");
    let degrees = refusal("EPSG:4326", DVec3::new(48.1, 111.5, 0.0));
    assert!(degrees.contains("x and y look swapped"), "{degrees}");
    let far = refusal("EPSG:25832", DVec3::new(1e12, 0.0, 0.0));
    assert!(far.contains("where that system does not reach"), "{far}");
    let mirrored = refusal("EPSG:8352", DVec3::new(1_043_823.0, 743_011.0, 0.0));
    assert!(mirrored.contains("mirrored"), "{mirrored}");
    assert!(Frame::of(Georeference::Local, DVec3::NAN).is_err());
    let enu = Georeference::Enu { lat_deg: 111.0, lon_deg: 48.0, height_m: 0.0, offset: DVec3::ZERO };
    assert!(Frame::of(enu, DVec3::ZERO).unwrap_err().to_string().contains("look swapped"));
}

#[test]
fn the_first_bad_vertex_is_named_whichever_thread_meets_it() {
    let frame = Frame::of(projected("EPSG:32632", ZONE_EDGE), DVec3::ZERO).unwrap();
    let mut points = vec![DVec3::ZERO; 3 * CHUNK];
    points[CHUNK + 7] = DVec3::new(f64::NAN, 0.0, 0.0);
    points[2 * CHUNK + 1] = DVec3::new(1e12, 0.0, 0.0);
    let refusal = frame.locals_from_sources(Path::new("a.obj"), &mut points).unwrap_err();
    assert_eq!(refusal.exit_code(), 3);
    assert!(refusal.to_string().starts_with(&format!("a.obj: vertex {} at", CHUNK + 8)), "{refusal}");
}

#[test]
fn many_points_move_as_each_one_does() {
    let frame = Frame::of(projected("EPSG:31467", DVec3::new(3_477_184.0, 5_552_691.0, 0.0)), DVec3::ZERO).unwrap();
    let sources: Vec<DVec3> = (0..CHUNK + 100).map(|i| DVec3::new(i as f64 * 0.5, i as f64 * 0.25, 1.0)).collect();
    let mut locals = sources.clone();
    let start = std::time::Instant::now();
    frame.locals_from_sources(Path::new("a.obj"), &mut locals).unwrap();
    println!("{:.2} million points a second", sources.len() as f64 / start.elapsed().as_secs_f64() / 1e6);
    for (source, local) in sources.iter().zip(&locals) {
        assert_eq!(frame.local_from_source(*source), Some(*local));
    }
}

proptest! {
    #[test]
    fn local_points_come_back_from_their_sources(
        x in -5000.0..5000.0f64, y in -5000.0..5000.0f64, z in -100.0..4000.0f64,
    ) {
        let frame = Frame::of(projected("EPSG:28992", DVec3::new(84_477.0, 447_347.0, 0.0)), DVec3::ZERO).unwrap();
        let source = frame.source_from_local(DVec3::new(x, y, z)).unwrap();
        let back = frame.local_from_source(source).unwrap();
        prop_assert!((back - DVec3::new(x, y, z)).length() < 1e-6, "{back}");
    }
}
