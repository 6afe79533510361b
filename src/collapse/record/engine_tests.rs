//! What the engine itself does, recorded and replayed on small random scenes: exact where a cut is a prefix, within the
//! budgets where it is a choice.

use std::path::Path;

use glam::DVec3;
use proptest::prelude::*;

use super::*;
use crate::classes::Classes;
use crate::collapse::{Method, Simplified, SimplifyConfig, Target, simplify};
use crate::geo::bvh::closest_on_triangle;
use crate::ids::{ClassId, ClassScheme};
use crate::mesh::Mesh;

const GRID_M: f64 = 1.0 / 128.0;

/// Rough ground of n × n cells of a metre with a block on it, in patches of all four classes.
fn scene(seed: u64, n: u32) -> (Mesh, Classes) {
    let mut state = seed;
    let mut random = move |below: u64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) % below
    };
    let patch: Vec<u8> = (0..16).map(|_| random(4) as u8).collect();
    let mut mesh = Mesh::default();
    for y in 0..=n {
        for x in 0..=n {
            let block = if x > n / 3 && x < n * 2 / 3 && y > n / 3 { 3.0 } else { 0.0 };
            mesh.positions.push(DVec3::new(f64::from(x), f64::from(y), block + random(64) as f64 * GRID_M));
        }
    }
    let mut label = Vec::new();
    for y in 0..n {
        for x in 0..n {
            let a = y * (n + 1) + x;
            mesh.faces.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
            label.extend([ClassId(patch[(x * 4 / n + y * 4 / n * 4) as usize]); 2]);
        }
    }
    mesh.face_material = vec![0; mesh.faces.len()];
    let scheme = ClassScheme::default();
    let posterior = label.iter().flat_map(|c| scheme.ids().map(move |of| f32::from(u8::from(of == *c)))).collect();
    (mesh, Classes { scheme, posterior, label })
}

fn cut(mesh: &Mesh, classes: &Classes, method: Method, faces: usize, record: bool) -> Simplified {
    let target = Target::Faces(faces);
    simplify(mesh, classes, &SimplifyConfig { method, target, grid_m: GRID_M, refit: false, record })
}

fn bytes_of(mesh: &Mesh, classes: &Classes, method: Method, faces: usize) -> Vec<u8> {
    let sequence = cut(mesh, classes, method, faces, true).sequence.unwrap();
    let about = About { scheme: classes.scheme.clone(), method: "test".into(), tracked: true, ..About::default() };
    encode(sequence, &about).unwrap()
}

fn open(bytes: Vec<u8>) -> crate::Result<Progressive> {
    Record::open(Path::new("x.record"), bytes).and_then(|record| record.decode(usize::MAX))
}

/// Triangles as places, turned to begin at the least, with their classes, in order.
fn triangles(at: &[DVec3], faces: &[[u32; 3]], classes: impl Iterator<Item = u8>) -> Vec<([[u64; 3]; 3], u8)> {
    let key = |v: u32| at[v as usize].to_array().map(|x| (x + 0.0).to_bits());
    let turned = faces.iter().map(|f| {
        let [x, y, z] = f.map(key);
        [[x, y, z], [y, z, x], [z, x, y]].into_iter().min().unwrap()
    });
    let mut all: Vec<_> = turned.zip(classes).collect();
    all.sort_unstable();
    all
}

/// Faces of three corners, none twice, at most two to an edge.
fn check_surface(mesh: &Replayed) {
    let mut edges = Vec::new();
    let mut keys = Vec::new();
    for &[a, b, c] in &mesh.faces {
        assert!((a.max(b).max(c) as usize) < mesh.positions.len() && a != b && b != c && c != a);
        edges.extend([(a, b), (b, c), (c, a)].map(|(u, v)| (u.min(v), u.max(v))));
        let mut key = [a, b, c];
        key.sort_unstable();
        keys.push(key);
    }
    edges.sort_unstable();
    assert!(edges.chunk_by(|a, b| a == b).all(|uses| uses.len() <= 2), "an edge of three faces");
    keys.sort_unstable();
    assert!(keys.windows(2).all(|pair| pair[0] != pair[1]), "a face twice");
}

/// The source vertex furthest from `cut` in budgets of the strictest class around it, by looking at every face.
fn worst(source: &Replayed, cut: &Replayed, budgets_m: &[f64; MAX_CLASSES]) -> f64 {
    let mut strictest = vec![f64::INFINITY; source.positions.len()];
    for (face, class) in source.faces.iter().zip(&source.classes) {
        for &v in face {
            strictest[v as usize] = strictest[v as usize].min(budgets_m[usize::from(*class)]);
        }
    }
    let share = |(p, budget): (&DVec3, &f64)| {
        let squared = cut.faces.iter().map(|f| {
            let corners = f.map(|v| cut.positions[v as usize]);
            (closest_on_triangle(*p, &corners) - *p).length_squared()
        });
        squared.fold(f64::INFINITY, f64::min).sqrt() / budget
    };
    source.positions.iter().zip(&strictest).filter(|(_, b)| b.is_finite()).map(share).fold(0.0, f64::max)
}

fn method(half_edge: bool) -> Method {
    if half_edge { Method::HalfEdge } else { Method::Semantic }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn every_prefix_is_a_surface_and_the_mesh_simplified_straight_to_it(seed: u64, n in 3u32..12, half: bool) {
        let (mesh, classes) = scene(seed, n);
        let all = open(bytes_of(&mesh, &classes, method(half), 4)).unwrap();
        for splits in 0..=all.len() {
            check_surface(&all.at(splits));
        }
        prop_assert!(!half || all.kept_at == all.coarse_at, "a half-edge's record has one place an event");
        for share in [0.9, 0.6, 0.3, 0.15] {
            let faces = ((mesh.faces.len() as f64 * share) as usize).max(8);
            let straight = cut(&mesh, &classes, method(half), faces, false);
            let replayed = all.at(all.splits_for_faces(straight.faces.len()));
            prop_assert_eq!(
                triangles(&replayed.positions, &replayed.faces, replayed.classes.iter().copied()),
                triangles(&straight.positions, &straight.faces, straight.labels.iter().map(|c| c.0))
            );
        }
    }

    #[test]
    fn a_choice_by_budgets_keeps_every_source_vertex_within_them(
        seed: u64, n in 3u32..14, half: bool, budgets in prop::array::uniform4(-2.0..0.6f64),
    ) {
        let (mesh, classes) = scene(seed, n);
        let all = open(bytes_of(&mesh, &classes, method(half), 4)).unwrap();
        let mut budgets_m = [f64::INFINITY; MAX_CLASSES];
        budgets_m.iter_mut().zip(budgets).for_each(|(m, exponent)| *m = 10f64.powf(exponent));
        let source = all.at(usize::MAX);
        let chosen = all.within(&budgets_m);
        check_surface(&chosen);
        let prefix = all.splits_within(&budgets_m).unwrap();
        prop_assert!(chosen.faces.len() <= all.faces_at(prefix), "a choice is at least as coarse as a prefix");
        let share = worst(&source, &chosen, &budgets_m);
        prop_assert!(share <= 1.0 + 1e-6, "{share} budgets off");
        prop_assert!(chosen.bounds_m.iter().zip(&budgets_m).all(|(bound, budget)| bound <= budget));
    }

    #[test]
    fn any_byte_of_an_engines_record_flipped_is_an_error(seed: u64, place: prop::sample::Index, bit in 0u8..8) {
        let (mesh, classes) = scene(seed, 6);
        let mut bytes = bytes_of(&mesh, &classes, Method::Semantic, 4);
        let at = place.index(bytes.len());
        bytes[at] ^= 1 << bit;
        let message = open(bytes).unwrap_err().to_string();
        prop_assert!(message.starts_with("x.record") && message.len() > 30, "{message}");
    }
}

#[test]
fn a_lax_class_is_coarse_beside_a_strict_one() {
    let (mesh, mut classes) = scene(3, 24);
    // Ground to the west, roof to the east.
    classes.label.iter_mut().enumerate().for_each(|(f, label)| *label = ClassId(if f / 2 % 24 < 12 { 0 } else { 2 }));
    let all = open(bytes_of(&mesh, &classes, Method::Semantic, 4)).unwrap();
    let with = |terrain_m: f64| {
        let mut budgets_m = [0.02; MAX_CLASSES];
        budgets_m[0] = terrain_m;
        all.within(&budgets_m)
    };
    let of_terrain = |mesh: &Replayed| mesh.classes.iter().filter(|c| **c == 0).count();
    let (strict, lax) = (of_terrain(&with(0.02)), of_terrain(&with(2.0)));
    // Roof that stays holds the ground beside it.
    assert!(lax * 5 < strict * 4, "{lax} triangles of terrain where 2 m are allowed, {strict} at 2 cm");
}
