//! Small scenes as height fields of half-metre squares with a little noise: walls lean by one square.

use glam::DVec3;

use super::*;
use crate::planes::{PlanesConfig, grow};

const STEP_M: f64 = 0.5;

/// Deterministic noise in [-1, 1].
fn noise(i: usize, j: usize) -> f64 {
    let h = (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (j as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F);
    let h = (h ^ (h >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    (h >> 40) as f64 / f64::from(1 << 23) - 1.0
}

/// Squares over [0, size]² metres; `height` gives z, or nothing where nothing was captured.
fn scene(size_m: f64, height: impl Fn(f64, f64) -> Option<f64>) -> Mesh {
    let n = (size_m / STEP_M) as usize;
    let mut mesh = Mesh::default();
    let mut id = vec![None; (n + 1) * (n + 1)];
    for j in 0..=n {
        for i in 0..=n {
            let (x, y) = (i as f64 * STEP_M, j as f64 * STEP_M);
            if let Some(z) = height(x, y) {
                id[j * (n + 1) + i] = Some(mesh.positions.len() as u32);
                mesh.positions.push(DVec3::new(x, y, z + 0.02 * noise(i, j)));
            }
        }
    }
    for j in 0..n {
        for i in 0..n {
            let a = j * (n + 1) + i;
            if let (Some(a), Some(b), Some(c), Some(d)) = (id[a], id[a + 1], id[a + n + 2], id[a + n + 1]) {
                mesh.faces.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    mesh
}

fn labelled(mesh: &Mesh) -> Classes {
    let planes = grow(mesh, &PlanesConfig::default());
    label(mesh, &planes, &ClassScheme::default(), &ClassesConfig::default())
}

/// Share of the area chosen by `is_in` (face centre, normal z) that has a class.
fn share(mesh: &Mesh, classes: &Classes, class: ClassId, is_in: impl Fn(DVec3, f64) -> bool) -> f64 {
    let (mut have, mut all) = (0.0, 0.0);
    for f in 0..mesh.faces.len() {
        let [a, b, c] = mesh.corners(f);
        let cross = mesh.cross(f);
        if is_in((a + b + c) / 3.0, cross.z / cross.length()) {
            all += cross.length();
            have += if classes.label[f] == class { cross.length() } else { 0.0 };
        }
    }
    assert!(all > 0.0, "the test looks at nothing");
    have / all
}

/// Inside the house's walls by a margin (negative: outside them).
fn in_house(p: DVec3, margin: f64) -> bool {
    (p.x - 30.0).abs() < 5.0 - margin && (p.y - 30.0).abs() < 7.0 - margin
}

/// A gabled house of 10 m × 14 m, eaves 4 m above its uphill ground, on a slope of 15 %.
fn house(x: f64, y: f64) -> Option<f64> {
    let ground = 0.15 * x;
    let roof = 0.15 * 35.0 + 4.0 + 0.8 * (5.0 - (x - 30.0).abs());
    Some(if in_house(DVec3::new(x, y, 0.0), 0.0) { roof } else { ground })
}

#[test]
fn a_gabled_house_on_a_slope_has_a_roof_and_walls_and_stands_on_terrain() {
    let mesh = scene(60.0, house);
    let classes = labelled(&mesh);
    let roof = share(&mesh, &classes, ClassId::ROOF, |p, _| in_house(p, 1.0));
    let wall = share(&mesh, &classes, ClassId::FACADE, |_, up| up < 0.3);
    let terrain = share(&mesh, &classes, ClassId::TERRAIN, |p, _| !in_house(p, -1.5));
    assert!(roof > 0.97 && wall > 0.9 && terrain > 0.99, "roof {roof}, wall {wall}, terrain {terrain}");
}

#[test]
fn a_bush_is_clutter_and_no_building() {
    let bush = |x: f64, y: f64| {
        let r = (x - 15.0).hypot(y - 15.0);
        let (i, j) = ((x / STEP_M) as usize, (y / STEP_M) as usize);
        Some(if r < 4.0 { 1.0 + 1.2 * (16.0 - r * r).sqrt() + 0.4 * noise(j, i) } else { 0.0 })
    };
    let mesh = scene(30.0, bush);
    let classes = labelled(&mesh);
    let clutter = share(&mesh, &classes, ClassId::CLUTTER, |p, _| (p.x - 15.0).hypot(p.y - 15.0) < 3.5);
    let building =
        share(&mesh, &classes, ClassId::ROOF, |_, _| true) + share(&mesh, &classes, ClassId::FACADE, |_, _| true);
    assert!(clutter > 0.95 && building < 0.01, "clutter {clutter}, building {building}");
}

#[test]
fn a_steep_crater_wall_is_neither_facade_nor_roof() {
    // Walls of 63° all around a floor, a rim that stands 4 m above the plain.
    let crater = |x: f64, y: f64| {
        let r = (x - 40.0).hypot(y - 40.0);
        let wall = (2.0 * (r - 22.0)).clamp(0.0, 16.0);
        Some(wall - 0.4 * (r - 30.0).clamp(0.0, 10.0))
    };
    let mesh = scene(80.0, crater);
    let classes = labelled(&mesh);
    for class in [ClassId::FACADE, ClassId::ROOF] {
        let found = share(&mesh, &classes, class, |_, _| true);
        assert!(found < 0.01, "class {} {found}", class.0);
    }
    let floor = share(&mesh, &classes, ClassId::TERRAIN, |p, _| (p.x - 40.0).hypot(p.y - 40.0) < 21.0);
    assert!(floor > 0.99, "{floor}");
}

#[test]
fn a_building_captured_without_ground_is_still_a_building() {
    let alone = |x: f64, y: f64| {
        let inside = (3.0..=17.0).contains(&x) && (3.0..=17.0).contains(&y);
        let beside = (2.5..=17.5).contains(&x) && (2.5..=17.5).contains(&y);
        if inside {
            Some(8.0)
        } else if beside {
            Some(0.0)
        } else {
            None
        }
    };
    let mesh = scene(20.0, alone);
    let classes = labelled(&mesh);
    let wall = share(&mesh, &classes, ClassId::FACADE, |_, up| up < 0.3);
    let roof = share(&mesh, &classes, ClassId::ROOF, |p, up| up > 0.9 && p.z > 7.0);
    assert!(wall > 0.9 && roof > 0.9, "wall {wall}, roof {roof}");
}

#[test]
fn posteriors_sum_to_one_and_the_label_is_their_argmax() {
    let classes = labelled(&scene(60.0, house));
    for f in 0..classes.label.len() {
        let of = classes.of(f);
        assert!((of.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        assert!(of.iter().all(|p| *p <= of[classes.label[f].index()]));
    }
}

#[test]
fn moving_the_mesh_by_five_hundred_kilometres_changes_no_label() {
    let mut mesh = scene(60.0, house);
    let here = labelled(&mesh);
    let far = DVec3::new(500_000.0, 500_000.0, 3_000.0);
    mesh.positions.iter_mut().for_each(|p| *p += far);
    assert_eq!(here.label, labelled(&mesh).label);
}

#[test]
fn one_thread_and_three_give_the_same_bits() {
    let mesh = scene(60.0, house);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| labelled(&mesh))
    };
    let (one, three) = (with(1), with(3));
    assert!(one.posterior.iter().zip(&three.posterior).all(|(a, b)| a.to_bits() == b.to_bits()));
    assert_eq!(one.label, three.label);
}

#[test]
fn a_scheme_without_facade_and_roof_gives_their_share_to_building() {
    let mut scheme = ClassScheme::default();
    scheme.0[1].name = "building".into();
    scheme.0.remove(2);
    let mesh = scene(60.0, house);
    let planes = grow(&mesh, &PlanesConfig::default());
    let classes = label(&mesh, &planes, &scheme, &ClassesConfig::default());
    assert!(share(&mesh, &classes, ClassId(1), |p, _| in_house(p, 1.0)) > 0.97);
}

#[test]
fn meshes_of_nothing_and_of_one_face_get_labels() {
    assert!(labelled(&Mesh::default()).label.is_empty());
    let positions = vec![DVec3::ZERO, DVec3::X, DVec3::Y];
    let mesh = Mesh { positions, faces: vec![[0, 1, 2]], ..Mesh::default() };
    assert_eq!(labelled(&mesh).label, [ClassId::TERRAIN]);
}

#[test]
fn the_default_configurations_pass_their_checks_and_nonsense_does_not() {
    assert!(ClassesConfig::default().check().is_empty() && PlanesConfig::default().check().is_empty());
    let wrong = ClassesConfig { high_m: 0.1, smoothing: f64::NAN, ..Default::default() };
    assert_eq!(wrong.check().len(), 2, "{:?}", wrong.check());
}

/// Terraces 30 m wide and one that is wider, each 20 m above the last, held by walls; on two of them stands a house of 10 m × 14 m and 7 m.
fn old_town(x: f64, y: f64) -> Option<f64> {
    let step = ((x - 40.0) / 30.0).floor().clamp(-1.0, 2.0) + 1.0;
    let house = |at: f64| if (x - at).abs() < 5.0 && (y - 30.0).abs() < 7.0 { 7.0 } else { 0.0 };
    Some(20.0 * step + house(28.0) + house(56.0))
}

#[test]
fn walls_that_hold_a_terrace_are_no_building_and_the_houses_between_them_are() {
    let mesh = scene(190.0, |x, y| if y > 60.0 { None } else { old_town(x, y) });
    let classes = labelled(&mesh);
    let in_house =
        |p: &DVec3, by: f64| [28.0, 56.0].iter().any(|at| (p.x - at).abs() < 5.0 + by && (p.y - 30.0).abs() < 7.0 + by);
    let is_far = |p: DVec3| !in_house(&p, 3.0);
    let building = share(&mesh, &classes, ClassId::ROOF, |p, _| is_far(p))
        + share(&mesh, &classes, ClassId::FACADE, |p, _| is_far(p));
    let flat = share(&mesh, &classes, ClassId::TERRAIN, |p, up| is_far(p) && up > 0.9);
    let roofs = share(&mesh, &classes, ClassId::ROOF, |p, _| in_house(&p, -1.0));
    let walls = share(&mesh, &classes, ClassId::FACADE, |p, up| in_house(&p, 1.0) && up < 0.3);
    assert!(building < 0.005, "{building} of the terraces and their walls is building");
    assert!(flat > 0.99 && roofs > 0.97 && walls > 0.9, "terrain {flat}, roofs {roofs}, walls {walls}");
}

#[test]
fn a_terrace_cut_off_by_the_border_of_the_capture_is_no_building() {
    let mesh = scene(70.0, |x, _| Some(if x < 45.0 { 0.0 } else { 20.0 }));
    let classes = labelled(&mesh);
    let building =
        share(&mesh, &classes, ClassId::ROOF, |_, _| true) + share(&mesh, &classes, ClassId::FACADE, |_, _| true);
    assert!(building < 0.005, "{building}");
}

#[test]
fn turning_the_mesh_about_the_vertical_changes_hardly_any_label() {
    let mesh = scene(60.0, house);
    let here = labelled(&mesh);
    let area = |f: usize| mesh.cross(f).length();
    let all: f64 = (0..mesh.faces.len()).map(area).sum();
    for degrees in [17.0f64, 90.0] {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let mut turned = mesh.clone();
        turned.positions.iter_mut().for_each(|p| *p = DVec3::new(cos * p.x - sin * p.y, sin * p.x + cos * p.y, p.z));
        let there = labelled(&turned);
        let changed: f64 = (0..mesh.faces.len()).filter(|&f| here.label[f] != there.label[f]).map(area).sum();
        assert!(changed / all < 0.005, "{degrees}°: {} of the area", changed / all);
    }
}

#[test]
fn a_car_park_raised_by_a_metre_and_a_half_is_terrain_and_the_cars_on_it_are_clutter() {
    let is_car = |x: f64, y: f64| x.rem_euclid(6.0) < 2.5 && y.rem_euclid(12.0) < 5.0 && (20.0..60.0).contains(&x);
    let is_lot = |x: f64, y: f64| (15.0..65.0).contains(&x) && (12.0..68.0).contains(&y);
    let height = |x: f64, y: f64| match (is_lot(x, y), is_car(x, y)) {
        (true, true) => 3.0,
        (true, false) => 1.5,
        _ => 0.0,
    };
    let mesh = scene(80.0, |x, y| Some(height(x, y)));
    let classes = labelled(&mesh);
    let lot = share(&mesh, &classes, ClassId::TERRAIN, |p, up| up > 0.9 && is_lot(p.x, p.y) && p.z < 1.6);
    let cars = share(&mesh, &classes, ClassId::CLUTTER, |p, up| up > 0.9 && is_lot(p.x, p.y) && p.z > 2.5);
    let building =
        share(&mesh, &classes, ClassId::ROOF, |_, _| true) + share(&mesh, &classes, ClassId::FACADE, |_, _| true);
    assert!(lot > 0.95 && cars > 0.95 && building < 0.01, "lot {lot}, cars {cars}, building {building}");
}
