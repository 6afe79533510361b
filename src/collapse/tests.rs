use glam::{DVec2, DVec3};

use super::window::{Patch, StepSettings, step};
use super::*;
use crate::classes::Classes;
use crate::geo::Rect;
use crate::geo::bvh::Bvh;
use crate::ids::{ClassId, ClassScheme};
use crate::mesh::{Mesh, on_grid};

/// A bumpy square of n × n cells, 1 m each, with a box-like step in it.
fn terrain(n: u32) -> Mesh {
    let mut mesh = Mesh::default();
    for y in 0..=n {
        for x in 0..=n {
            let noise = f64::from((x * 7919 + y * 104_729) % 97) / 97.0 * 0.04;
            let tower = if x > n / 4 && x < n / 2 && y > n / 4 && y < n / 2 { 5.0 } else { 0.0 };
            mesh.positions.push(on_grid(DVec3::new(f64::from(x), f64::from(y), tower + noise)));
        }
    }
    for y in 0..n {
        for x in 0..n {
            let a = y * (n + 1) + x;
            mesh.faces.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
        }
    }
    mesh.face_material = vec![0; mesh.faces.len()];
    mesh
}

fn one_class(mesh: &Mesh) -> Classes {
    let scheme = ClassScheme::default();
    let posterior = mesh.faces.iter().flat_map(|_| [1.0, 0.0, 0.0, 0.0]).collect();
    Classes { scheme, posterior, label: vec![ClassId::TERRAIN; mesh.faces.len()] }
}

fn everywhere() -> Rect {
    Rect { min: DVec2::splat(-1e9), max: DVec2::splat(1e9) }
}

/// The parts of a mesh whose faces have the numbers 0, 1 … in `group`.
fn patches(mesh: &Mesh, group: &[u32]) -> Vec<Patch> {
    let classes = one_class(mesh);
    let budgets: Vec<f64> = classes.scheme.0.iter().map(|c| c.budget_m).collect();
    let count = group.iter().max().map_or(0, |last| last + 1);
    let of_group = |g: u32| {
        let faces: Vec<[u32; 3]> = (0..group.len()).filter(|f| group[*f] == g).map(|f| mesh.faces[f]).collect();
        let mut used: Vec<u32> = faces.iter().flatten().copied().collect();
        used.sort_unstable();
        used.dedup();
        let positions = used.iter().map(|&v| mesh.positions[v as usize]).collect();
        let faces: Vec<[u32; 3]> = faces.iter().map(|f| f.map(|v| used.binary_search(&v).unwrap() as u32)).collect();
        let (labels, omega) = (vec![ClassId::TERRAIN; faces.len()], vec![100.0; faces.len()]);
        Patch::of_source(positions, faces, labels, omega, &budgets)
    };
    (0..count).map(of_group).collect()
}

fn stepped(mut patches: Vec<Patch>, boxes: &[Rect], block_faces: usize, scales: &[f64]) -> Vec<Patch> {
    for (i, &scale) in scales.iter().enumerate() {
        let settings = StepSettings { scale, strictest_m: 0.05, classes: 4, block_faces, odd: i % 2 == 1 };
        patches = step(patches, boxes, |_| false, &settings).0;
    }
    patches
}

fn run(mesh: &Mesh, block_faces: usize, scales: &[f64]) -> Patch {
    stepped(patches(mesh, &vec![0; mesh.faces.len()]), &[everywhere()], block_faces, scales).remove(0)
}

#[test]
fn samples_stay_within_their_budget() {
    let mesh = terrain(40);
    for t in [0.5, 2.0, 8.0] {
        let cut = run(&mesh, 400, &[0.25, t]);
        assert!(cut.faces.len() < mesh.faces.len(), "nothing collapsed at {t}");
        let bvh = Bvh::new(&cut.positions, &cut.faces);
        for p in &mesh.positions {
            let d = bvh.closest(*p, f64::INFINITY).unwrap().distance;
            assert!(d <= t * 0.10 + 1e-9, "{d} m from the cut at scale {t}");
        }
    }
}

#[test]
fn a_flat_square_needs_few_faces() {
    let mut mesh = terrain(30);
    mesh.positions.iter_mut().for_each(|p| p.z = 0.0);
    assert!(run(&mesh, 10_000, &[1.0]).faces.len() <= 60);
}

#[test]
fn every_prefix_of_the_log_is_a_valid_mesh() {
    let mesh = terrain(20);
    let cut = faces_at(&mesh, &one_class(&mesh), Method::Semantic, 40);
    let Sequence { positions, faces, log, .. } = cut.sequence.unwrap();
    let source = Mesh { positions, faces, ..Mesh::default() };
    let mut last = usize::MAX;
    for events in (0..=log.events.len()).step_by(7) {
        let (_, faces) = log.replay(&source, events);
        let mut keys: Vec<[u32; 3]> = faces.iter().map(|f| f.1).collect();
        keys.iter_mut().for_each(|k| k.sort_unstable());
        keys.sort_unstable();
        assert!(keys.windows(2).all(|w| w[0] != w[1]), "two faces fold onto each other after {events}");
        assert!(faces.len() < last && !faces.is_empty());
        last = faces.len();
    }
}

#[test]
fn walls_are_kept() {
    let mesh = terrain(32);
    let boxes: Vec<Rect> = (0..4)
        .map(|i| {
            let min = DVec2::new(f64::from(i % 2), f64::from(i / 2)) * 16.0;
            Rect { min, max: min + 16.0 }
        })
        .collect();
    let group: Vec<u32> = (0..mesh.faces.len())
        .map(|f| {
            let c = mesh.corners(f).iter().sum::<DVec3>() / 3.0;
            u32::from(c.x > 16.0) + 2 * u32::from(c.y > 16.0)
        })
        .collect();
    let cells = stepped(patches(&mesh, &group), &boxes, 300, &[0.3, 1.0, 3.0, 9.0, 9.0]);
    let count: usize = cells.iter().map(|c| c.faces.len()).sum();
    assert!(count < mesh.faces.len() / 10, "{count} faces");
    for (cell, plan) in cells.iter().zip(&boxes) {
        assert!(cell.positions.iter().all(|p| plan.contains(p.truncate(), 0.0)));
    }
    // The border of each pair along x = 16 is the same set of vertices from both sides.
    let along = |side: usize| {
        let of_side = cells[side].positions.iter().chain(&cells[side + 2].positions);
        let mut on: Vec<[u64; 3]> = of_side.filter(|p| p.x == 16.0).map(|p| p.to_array().map(f64::to_bits)).collect();
        on.sort_unstable();
        on.dedup();
        on
    };
    assert_eq!(along(0), along(1));
    assert!(along(0).len() > 2);
}

#[test]
fn a_cell_keeps_its_own_surface() {
    // A ribbon that enters the western cell by 3 m only: without samples of its own that end could slip away east.
    let mut mesh = terrain(20);
    mesh.positions.iter_mut().for_each(|p| p.y *= 0.1);
    let wall = 3.0;
    let boxes = [DVec2::new(-10.0, -10.0), DVec2::new(wall, -10.0)]
        .map(|min| Rect { min, max: DVec2::new(if min.x < 0.0 { wall } else { 30.0 }, 30.0) });
    let group: Vec<u32> =
        (0..mesh.faces.len()).map(|f| u32::from(mesh.corners(f).iter().any(|p| p.x > wall))).collect();
    let t = 20.0;
    let cells = stepped(patches(&mesh, &group), &boxes, 10_000, &[2.0, 6.0, t, t]);
    for (side, cell) in cells.iter().enumerate() {
        let bvh = Bvh::new(&cell.positions, &cell.faces);
        for (f, face) in mesh.faces.iter().enumerate().filter(|(f, _)| group[*f] as usize == side) {
            let worst = face
                .iter()
                .map(|&v| bvh.closest(mesh.positions[v as usize], f64::INFINITY).map_or(f64::INFINITY, |h| h.distance));
            assert!(worst.fold(0.0, f64::max) <= t * 0.10 + 1e-9, "face {f} of side {side}");
        }
    }
}

#[test]
fn threads_do_not_change_the_result() {
    let mesh = terrain(40);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let cut = pool.install(|| run(&mesh, 300, &[0.3, 1.0, 3.0]));
        (cut.positions, cut.faces, cut.samples)
    };
    assert_eq!(with(1), with(2));
}

#[test]
fn an_open_border_does_not_shrink() {
    let mesh = terrain(30);
    let used = run(&mesh, 10_000, &[2.0]).positions;
    let low = used.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let high = used.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    assert!(low.truncate().length() < 0.2 && (high.truncate() - 30.0).length() < 0.2, "{low} {high}");
}

#[test]
fn cracked_borders_grow_together() {
    // Two halves that meet along x = 15 with a gap of 2 cm, one side twice as dense as the other.
    let mut mesh = terrain(30);
    mesh.positions.iter_mut().for_each(|p| p.z = (p.x * 0.7).sin() * 0.3 + (p.y * 0.9).cos() * 0.3);
    let left = |f: &[u32; 3], m: &Mesh| f.iter().all(|&v| m.positions[v as usize].x <= 15.0);
    let faces = mesh.faces.clone();
    let base = mesh.positions.len() as u32;
    let twins: Vec<DVec3> = mesh.positions.iter().map(|p| on_grid(*p + DVec3::new(0.02, 0.0, 0.0))).collect();
    mesh.positions.extend(twins);
    mesh.faces = faces.iter().map(|f| if left(f, &mesh) { *f } else { f.map(|v| v + base) }).collect();
    let open = |cut: &Patch| {
        let mut edges: Vec<(u32, u32)> = cut
            .faces
            .iter()
            .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
            .map(|(u, v)| (u.min(v), u.max(v)))
            .collect();
        edges.sort_unstable();
        let inner = |v: u32| {
            (1.0..29.0).contains(&cut.positions[v as usize].y) && (1.0..29.0).contains(&cut.positions[v as usize].x)
        };
        edges.chunk_by(|a, b| a == b).filter(|g| g.len() == 1 && inner(g[0].0) && inner(g[0].1)).count()
    };
    let before = run(&mesh, 10_000, &[]);
    assert!(open(&before) >= 50, "{}", open(&before));
    let cut = run(&mesh, 10_000, &[0.5, 1.0, 2.0]);
    assert_eq!(open(&cut), 0);
}

fn faces_at(mesh: &Mesh, classes: &Classes, method: Method, faces: usize) -> Simplified {
    let config = SimplifyConfig { method, target: Target::Faces(faces), record: true, ..SimplifyConfig::default() };
    simplify(mesh, classes, &config)
}

/// Mean and largest distance of the mesh's vertices from the cut.
fn distances(mesh: &Mesh, cut: &Simplified) -> (f64, f64) {
    let bvh = Bvh::new(&cut.positions, &cut.faces);
    let far: Vec<f64> =
        mesh.positions.iter().map(|p| bvh.closest(*p, f64::INFINITY).map_or(f64::INFINITY, |h| h.distance)).collect();
    (far.iter().sum::<f64>() / far.len() as f64, far.iter().copied().fold(0.0, f64::max))
}

fn edge_uses(faces: &[[u32; 3]]) -> Vec<usize> {
    let mut edges: Vec<(u32, u32)> =
        faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).map(|(u, v)| (u.min(v), u.max(v))).collect();
    edges.sort_unstable();
    edges.chunk_by(|a, b| a == b).map(<[_]>::len).collect()
}

#[test]
fn every_method_reaches_the_faces_it_was_asked_for() {
    let mesh = terrain(30);
    let classes = one_class(&mesh);
    for method in
        [Method::Semantic, Method::Memoryless, Method::HalfEdge, Method::Plain, Method::LindstromTurk, Method::Paper]
    {
        let cut = faces_at(&mesh, &classes, method, 300);
        assert!((299..=300).contains(&cut.faces.len()), "{method:?}: {} faces", cut.faces.len());
        assert_eq!((cut.face_ids.len(), cut.labels.len()), (cut.faces.len(), cut.faces.len()));
        assert!(cut.faces.iter().flatten().all(|&v| (v as usize) < cut.positions.len()));
        let far = distances(&mesh, &cut).1;
        assert!(far < 2.6, "{method:?}: {far} m");
    }
}

#[test]
fn the_scale_bounds_every_vertex() {
    let mesh = terrain(30);
    let classes = one_class(&mesh);
    for t in [1.0, 4.0] {
        let config = SimplifyConfig { target: Target::Scale(t), ..SimplifyConfig::default() };
        let cut = simplify(&mesh, &classes, &config);
        assert!(cut.scale <= t && cut.faces.len() < mesh.faces.len(), "{} faces at {t}", cut.faces.len());
        let far = distances(&mesh, &cut).1;
        assert!(far <= cut.scale * 0.10 + 1e-6, "{far} m at scale {}", cut.scale);
    }
}

#[test]
fn the_refit_brings_the_cut_nearer() {
    let mesh = terrain(40);
    let classes = one_class(&mesh);
    let mean = |refit| {
        let target = Target::Faces(400);
        let cut = simplify(&mesh, &classes, &SimplifyConfig { target, refit, ..SimplifyConfig::default() });
        distances(&mesh, &cut).0
    };
    let (before, after) = (mean(false), mean(true));
    assert!(after < 0.93 * before, "{before} to {after} m");
}

#[test]
fn a_refitted_cut_keeps_the_number_of_faces_the_limits_and_the_upper_side() {
    let mesh = terrain(40);
    let classes = one_class(&mesh);
    for wanted in [60, 200, 900, 2500] {
        let target = Target::Faces(wanted);
        let cut = simplify(&mesh, &classes, &SimplifyConfig { target, ..SimplifyConfig::default() });
        assert!((wanted - 1..=wanted).contains(&cut.faces.len()), "{} faces of {wanted}", cut.faces.len());
        let far = distances(&mesh, &cut).1;
        assert!(far <= cut.scale * 0.10 + 1e-6, "{far} m at scale {}", cut.scale);
        assert!(edge_uses(&cut.faces).into_iter().all(|n| n <= 2));
        for face in &cut.faces {
            let [a, b, c] = face.map(|v| cut.positions[v as usize]);
            let up = (b - a).cross(c - a).z;
            assert!(up > 0.0, "{face:?} of {wanted} faces: {up}");
        }
    }
}

#[test]
fn what_the_refit_gains_is_spent_at_a_given_scale() {
    let mesh = terrain(40);
    let classes = one_class(&mesh);
    let faces = |refit| {
        let target = Target::Scale(0.5);
        simplify(&mesh, &classes, &SimplifyConfig { target, refit, ..SimplifyConfig::default() }).faces.len()
    };
    let (before, after) = (faces(false), faces(true));
    assert!(after < before, "{before} to {after} faces");
}

#[test]
fn no_edge_gets_a_third_face() {
    // Two sheets 5 cm apart, joined by tunnels, which cannot close without an edge of four faces.
    let mut mesh = terrain(24);
    mesh.positions.iter_mut().for_each(|p| p.z = 0.0);
    let count = mesh.positions.len() as u32;
    let hole = |f: usize| (f / 2) % 5 == 2 && (f / 48) % 5 == 2;
    let top: Vec<[u32; 3]> = mesh.faces.iter().enumerate().filter(|(f, _)| !hole(*f)).map(|(_, t)| *t).collect();
    let low = mesh.positions.iter().map(|p| on_grid(*p - DVec3::Z * 0.05)).collect::<Vec<_>>();
    mesh.positions.extend(low);
    mesh.faces = top.iter().copied().chain(top.iter().map(|[a, b, c]| [a + count, c + count, b + count])).collect();
    let uses = |faces: &[[u32; 3]], u: u32, v: u32| faces.iter().filter(|f| f.contains(&u) && f.contains(&v)).count();
    for [a, b, c] in &top {
        for (u, v) in [(*a, *b), (*b, *c), (*c, *a)] {
            if uses(&top, u, v) == 1 {
                mesh.faces.extend([[v, u, u + count], [v, u + count, v + count]]);
            }
        }
    }
    mesh.face_material = vec![0; mesh.faces.len()];
    assert!(edge_uses(&mesh.faces).into_iter().all(|n| n == 2), "the model is closed");
    let classes = one_class(&mesh);
    let cut = faces_at(&mesh, &classes, Method::Semantic, 60);
    assert!(cut.faces.len() < mesh.faces.len() / 4, "{} of {} faces", cut.faces.len(), mesh.faces.len());
    assert!(edge_uses(&cut.faces).into_iter().all(|n| n <= 2));
}

#[test]
fn a_closed_piece_on_a_vertex_folds_away() {
    let mut mesh = terrain(16);
    let ground = mesh.faces.len();
    let (u, first) = (5 * 17 + 5, mesh.positions.len() as u32);
    let foot = mesh.positions[u as usize];
    for offset in [DVec3::new(0.1, 0.0, 0.2), DVec3::new(0.0, 0.1, 0.2), DVec3::new(0.1, 0.1, 0.1)] {
        mesh.positions.push(on_grid(foot + offset));
    }
    let [v, a, b] = [first, first + 1, first + 2];
    mesh.faces.extend([[u, v, a], [v, u, b], [u, a, b], [v, b, a]]);
    mesh.face_material = vec![0; mesh.faces.len()];
    let classes = one_class(&mesh);
    for method in [Method::Semantic, Method::Memoryless] {
        let cut = faces_at(&mesh, &classes, method, 60);
        assert!(cut.face_ids.iter().all(|&f| (f as usize) < ground), "{method:?}: the tetrahedron is still there");
    }
}

#[test]
fn pieces_in_the_air_go_before_the_ground_is_spoilt() {
    let mut mesh = terrain(16);
    let ground = mesh.faces.len() as u32;
    let corners = [[0.0, 0.0, 0.01], [0.02, 0.0, 0.01], [0.0, 0.02, 0.01], [0.01, 0.01, 0.03]].map(DVec3::from_array);
    for k in 0..20u32 {
        let first = mesh.positions.len() as u32;
        let foot = mesh.positions[(18 + 13 * k) as usize];
        mesh.positions.extend(corners.map(|c| on_grid(foot + c)));
        mesh.faces.extend([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]].map(|f| f.map(|v: u32| v + first)));
    }
    mesh.face_material = vec![0; mesh.faces.len()];
    let config = SimplifyConfig { target: Target::Faces(120), ..SimplifyConfig::default() };
    let cut = simplify(&mesh, &one_class(&mesh), &config);
    let of_ground = cut.face_ids.iter().filter(|&&f| f < ground).count();
    // With all pieces the ground would have 40.
    assert!(cut.faces.len() <= 120 && of_ground > 60, "{of_ground} of {} faces are the ground's", cut.faces.len());
}

#[test]
fn a_sequence_replays_to_every_cut() {
    let mesh = terrain(20);
    let classes = one_class(&mesh);
    let config = |faces| SimplifyConfig {
        target: Target::Faces(faces),
        record: true,
        refit: false,
        ..SimplifyConfig::default()
    };
    let all = simplify(&mesh, &classes, &config(20)).sequence.unwrap();
    let source = Mesh { positions: all.positions, faces: all.faces, ..Mesh::default() };
    for faces in [600, 300, 100, 20] {
        let cut = simplify(&mesh, &classes, &config(faces));
        let own = &cut.sequence.as_ref().unwrap().log.events;
        assert_eq!(all.log.events[..own.len()], own[..], "a cut is a prefix");
        let (positions, replayed) = all.log.replay(&source, own.len());
        let place = |v: &u32| positions[*v as usize];
        let live: Vec<[DVec3; 3]> = cut.faces.iter().map(|f| f.map(|v| cut.positions[v as usize])).collect();
        assert_eq!(replayed.iter().map(|(_, f)| f.each_ref().map(place)).collect::<Vec<_>>(), live);
    }
}

#[test]
fn half_edges_keep_source_vertices() {
    let mesh = terrain(20);
    let classes = one_class(&mesh);
    let cut = faces_at(&mesh, &classes, Method::HalfEdge, 100);
    assert!(cut.positions.iter().all(|p| mesh.positions.contains(p)));
}

#[test]
fn an_empty_mesh_stays_empty() {
    let mesh = Mesh::default();
    assert!(simplify(&mesh, &one_class(&mesh), &SimplifyConfig::default()).faces.is_empty());
}
