//! On a small scene: a floor of one-metre squares, a wall 8 m high along x = 10, nothing else.

use super::*;
use crate::classes::ClassesConfig;
use crate::planes::{PlanesConfig, grow};

/// Vertices every metre: floor x 0 to 10, then up the wall; y 0 to 10.
fn corner() -> Mesh {
    let mut mesh = Mesh::default();
    for i in 0..=18 {
        for y in 0..=10 {
            let (x, z) = if i <= 10 { (i, 0) } else { (10, i - 10) };
            mesh.positions.push(DVec3::new(f64::from(x), f64::from(y), f64::from(z)));
        }
    }
    for i in 0..18 {
        for y in 0..10 {
            let a = i * 11 + y;
            mesh.faces.extend([[a, a + 11, a + 12], [a, a + 12, a + 1]]);
        }
    }
    mesh.face_material = vec![0; mesh.faces.len()];
    mesh
}

const FLOOR: usize = 3 * 11 + 5;
const WALL: usize = 15 * 11 + 5;

fn with<T>(mesh: &Mesh, colors: &[[u8; 3]], look: impl FnOnce(&Measures) -> T) -> T {
    let planes = grow(mesh, &PlanesConfig::default());
    let ground = Ground::of(mesh, &planes, &ClassesConfig::default());
    let scene = Scene { mesh, planes: &planes, face_colors: colors };
    look(&Measures::new(scene, &ground, &NineConfig::default()))
}

#[test]
fn every_feature_has_a_finite_value_in_its_range_in_every_form() {
    let mesh = corner();
    with(&mesh, &[], |measures| {
        for feature in FEATURES {
            for form in [Form::Paper, Form::Cgal, Form::Robust] {
                let [low, high] = range(feature.name, form).expect("a range");
                let values = measures.of_vertices(feature.name, form).expect("a feature");
                let faces = measures.of_faces(feature.name, form).expect("a feature");
                assert_eq!((values.len(), faces.len()), (mesh.positions.len(), mesh.faces.len()));
                for value in values.iter().chain(&faces) {
                    let value = f64::from(*value);
                    let fits = value.is_finite() && (low - 1e-6..=high + 1e-6).contains(&value);
                    assert!(fits, "{} {form:?}: {value}", feature.name);
                }
            }
        }
        assert!(measures.of_vertices("colour", Form::Paper).is_none() && range("colour", Form::Paper).is_none());
    });
}

#[test]
fn floor_and_wall_differ_where_they_should() {
    let mesh = corner();
    with(&mesh, &[], |measures| {
        let at = |name: &str, form| {
            let values = measures.of_vertices(name, form).expect("a feature");
            (values[FLOOR], values[WALL])
        };
        for form in [Form::Paper, Form::Cgal, Form::Robust] {
            let (floor, wall) = at("verticality", form);
            assert!(floor < 0.01 && wall > 0.99, "{form:?} {floor} {wall}");
            let (floor, wall) = at("elevation", form);
            assert!(floor.abs() < 0.2 && (wall - 5.0).abs() < 0.2, "{form:?} {floor} {wall}");
        }
        let (floor, wall) = at("vertical_range", Form::Paper);
        assert_eq!((floor, wall), (0.0, 8.0));
        assert_eq!(at("vertical_dispersion", Form::Paper), (0.0, 0.0), "a sampled wall has no gaps");
        assert_eq!(at("region_size", Form::Paper), (1.0, 0.0), "the larger and the smaller of two regions");
        let (floor, wall) = at("region_size", Form::Robust);
        assert!(floor > 0.99 && wall > 0.99, "both are large");
        let (printed, usual) = (at("planarity", Form::Paper), at("planarity", Form::Cgal));
        assert!(printed.0 > 1e6 && usual.0 > 0.5, "{printed:?} {usual:?}");
    });
}

#[test]
fn greenness_is_the_colours_of_the_faces_and_zero_without() {
    let mesh = corner();
    let green: Vec<[u8; 3]> = (0..mesh.faces.len()).map(|f| if f < 200 { [60, 90, 40] } else { [120; 3] }).collect();
    let values = with(&mesh, &green, |m| m.of_vertices("greenness", Form::Robust).expect("a feature"));
    assert!(values[FLOOR] > 30.0 && values[WALL].abs() < 1e-3);
    let none = with(&mesh, &[], |m| m.of_vertices("greenness", Form::Robust).expect("a feature"));
    assert!(none.iter().all(|v| *v == 0.0));
}

#[test]
fn moving_the_scene_changes_no_bit_of_any_feature() {
    let mesh = corner();
    let mut moved = mesh.clone();
    moved.positions.iter_mut().for_each(|p| *p += DVec3::new(500_000.0, -500_000.0, 1_000.0));
    for feature in &FEATURES[..NINE] {
        let of = |mesh: &Mesh| with(mesh, &[], |m| m.of_faces(feature.name, Form::Cgal).expect("a feature"));
        let (here, there) = (of(&mesh), of(&moved));
        let worst = here.iter().zip(&there).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-5, "{} {worst}", feature.name);
    }
}

#[test]
fn a_mesh_of_nothing_has_no_values() {
    with(&Mesh::default(), &[], |measures| {
        for feature in FEATURES {
            assert_eq!(measures.of_vertices(feature.name, Form::Paper), Some(Vec::new()), "{}", feature.name);
        }
    });
}
