//! Planes and classes on the demo city, whose truth is known by construction.

use std::collections::BTreeMap;

use glam::DVec3;
use rooftile::classes::{Classes, ClassesConfig, confusion, label};
use rooftile::demo::{City, CityConfig, generate};
use rooftile::ids::{ClassId, ClassScheme};
use rooftile::mesh::Mesh;
use rooftile::mesh::topology::{NONE, face_neighbours};
use rooftile::planes::{PlanesConfig, Seeds, grow};

/// The city's parts as one mesh: equal positions are one vertex.
fn mesh_of(city: &City) -> Mesh {
    let mut known: BTreeMap<[u64; 3], u32> = BTreeMap::new();
    let mut mesh = Mesh::default();
    for part in &city.source.parts {
        let ids: Vec<u32> = part
            .positions
            .iter()
            .map(|p| {
                *known.entry(p.to_array().map(f64::to_bits)).or_insert_with(|| {
                    mesh.positions.push(*p);
                    mesh.positions.len() as u32 - 1
                })
            })
            .collect();
        mesh.faces.extend(part.faces.iter().map(|f| f.map(|v| ids[v as usize])));
    }
    mesh
}

fn labelled(mesh: &Mesh) -> Classes {
    let planes = grow(mesh, &PlanesConfig::default());
    label(mesh, &planes, &ClassScheme::default(), &ClassesConfig::default())
}

fn areas(mesh: &Mesh) -> Vec<f64> {
    (0..mesh.faces.len()).map(|f| 0.5 * mesh.cross(f).length()).collect()
}

/// Planes of the city as it was before noise: building faces that touch and whose normals agree to a degree.
/// Per face the plane, `NONE` for none; planes of less than 4 m² do not count.
fn true_planes(clean: &Mesh, truth: &[ClassId]) -> Vec<u32> {
    let neighbours = face_neighbours(clean);
    let is_building = |f: usize| matches!(truth[f], ClassId::ROOF | ClassId::FACADE);
    let normal = |f: usize| clean.cross(f).normalize_or_zero();
    let mut plane = vec![NONE; clean.faces.len()];
    let mut count = 0;
    for start in 0..plane.len() {
        if plane[start] != NONE || !is_building(start) || normal(start) == DVec3::ZERO {
            continue;
        }
        let (mut members, mut next) = (vec![start], 0);
        plane[start] = count;
        while next < members.len() {
            let f = members[next];
            next += 1;
            for g in neighbours[f].into_iter().filter(|&g| g != NONE).map(|g| g as usize) {
                if plane[g] == NONE && is_building(g) && normal(g).dot(normal(start)) > 1f64.to_radians().cos() {
                    plane[g] = count;
                    members.push(g);
                }
            }
        }
        if members.iter().map(|&f| 0.5 * clean.cross(f).length()).sum::<f64>() < 4.0 {
            members.iter().for_each(|&f| plane[f] = u32::MAX - 1);
        } else {
            count += 1;
        }
    }
    plane.iter_mut().filter(|p| **p == u32::MAX - 1).for_each(|p| *p = NONE);
    plane
}

/// Regions needed to cover nine tenths of what is covered of a true plane, its mean over all; and how much is covered.
fn regions_per_plane(mesh: &Mesh, planes: &[u32], config: &PlanesConfig) -> (f64, f64) {
    let found = grow(mesh, config);
    let mut shares: BTreeMap<u32, BTreeMap<u32, f64>> = BTreeMap::new();
    let (mut covered, mut all) = (0.0, 0.0);
    for (f, area) in areas(mesh).into_iter().enumerate().filter(|(f, _)| planes[*f] != NONE) {
        all += area;
        if found.face_region[f] != NONE {
            covered += area;
            *shares.entry(planes[f]).or_default().entry(found.face_region[f]).or_default() += area;
        }
    }
    let needed = shares.values().map(|regions| {
        let mut parts: Vec<f64> = regions.values().copied().collect();
        parts.sort_by(|a, b| b.total_cmp(a));
        let (mut left, mut count) = (0.9 * parts.iter().sum::<f64>(), 0);
        for part in parts {
            count += usize::from(left > 0.0);
            left -= part;
        }
        count as f64
    });
    (needed.sum::<f64>() / shares.len() as f64, covered / all)
}

#[test]
fn a_wall_is_one_region_where_random_seeds_break_it() {
    let city = generate(&CityConfig::default());
    let clean = mesh_of(&generate(&CityConfig { noise_m: 0.0, ..CityConfig::default() }));
    let mesh = mesh_of(&city);
    assert_eq!(mesh.faces.len(), clean.faces.len(), "noise changes positions only");
    let truth = true_planes(&clean, &city.truth);
    let of = |seeds| regions_per_plane(&mesh, &truth, &PlanesConfig { seeds, ..PlanesConfig::default() });
    let ((ours, covered), (random, randomly_covered)) = (of(Seeds::Planar), of(Seeds::Random));
    println!(
        "regions per true plane: {ours:.3} planar ({covered:.3} covered), {random:.3} random ({randomly_covered:.3})"
    );
    assert!(ours < 1.6 && ours < random, "{ours} regions per plane, {random} with random seeds");
    assert!(covered > 0.95, "{covered} of the planes' area is in a region");
}

#[test]
fn the_demo_city_is_told_apart_for_two_seeds() {
    for seed in [7, 12] {
        let city = generate(&CityConfig { seed, ..CityConfig::default() });
        let mesh = mesh_of(&city);
        let found = confusion(&city.truth, &labelled(&mesh).label, &areas(&mesh));
        println!("seed {seed}: OA {:.3}, mIoU {:.3}", found.overall_accuracy, found.mean_iou);
        assert!(found.overall_accuracy > 0.95 && found.mean_iou > 0.90, "seed {seed}: {found:?}");
    }
}

#[test]
fn a_city_keeps_its_labels_when_it_is_turned_moved_or_labelled_by_two_threads() {
    let mesh = mesh_of(&generate(&CityConfig::default()));
    let on = |threads: usize, mesh: &Mesh| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| labelled(mesh))
    };
    let one = on(1, &mesh);
    let two = on(2, &mesh);
    assert!(one.posterior.iter().zip(&two.posterior).all(|(a, b)| a.to_bits() == b.to_bits()));

    let areas = areas(&mesh);
    let all: f64 = areas.iter().sum();
    let changed = |other: &Classes| -> f64 {
        let differ = |f: &usize| one.label[*f] != other.label[*f];
        (0..areas.len()).filter(differ).map(|f| areas[f]).sum::<f64>() / all
    };
    // 500 km in each direction; the mesh sits on the grid that every difference is exact on.
    let grid = |p: DVec3| rooftile::mesh::on_grid(p);
    let mut still = mesh.clone();
    still.positions.iter_mut().for_each(|p| *p = grid(*p));
    let mut moved = still.clone();
    moved.positions.iter_mut().for_each(|p| *p += DVec3::splat(500_000.0));
    let (still, moved) = (labelled(&still), labelled(&moved));
    assert_eq!(still.label, moved.label);
    for degrees in [7.0f64, 30.0, 45.0, 83.0, 90.0] {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let mut turned = mesh.clone();
        turned.positions.iter_mut().for_each(|p| *p = DVec3::new(cos * p.x - sin * p.y, sin * p.x + cos * p.y, p.z));
        let share = changed(&labelled(&turned));
        println!("turned by {degrees}°: {:.3} % of the area changes class", 100.0 * share);
        assert!(share < 0.005, "turned by {degrees}°: {share} of the area changes class");
    }
}
