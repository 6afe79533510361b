//! What a generated city promises.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::OnceLock;

use super::*;

/// A corner of a city, quick to make.
const PATCH: Dimensions = Dimensions { extent_m: 44.0, voxel_m: 0.8, tiles: 2, image_px: 256 };

fn small() -> &'static City {
    static CITY: OnceLock<City> = OnceLock::new();
    CITY.get_or_init(|| generate(&CityConfig::default()))
}

fn pixels(image: &ImageRef) -> &image::RgbImage {
    match image {
        ImageRef::Pixels(pixels) => pixels,
        other => panic!("the demo makes pixels, not {other:?}"),
    }
}

fn fingerprint(city: &City) -> blake3::Hash {
    let mut hash = blake3::Hasher::new();
    for part in &city.source.parts {
        part.positions.iter().flat_map(|p| p.to_array()).for_each(|v| _ = hash.update(&v.to_le_bytes()));
        part.faces.iter().flatten().for_each(|v| _ = hash.update(&v.to_le_bytes()));
        part.corner_uvs.iter().flatten().flat_map(|p| p.to_array()).for_each(|v| _ = hash.update(&v.to_le_bytes()));
    }
    city.truth.iter().for_each(|c| _ = hash.update(&[c.0]));
    city.source.images.iter().for_each(|image| _ = hash.update(pixels(image).as_raw()));
    hash.finalize()
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_1_and_2_threads() {
    let make = |seed, threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| fingerprint(&build(&CityConfig { seed, ..CityConfig::default() }, PATCH)))
    };
    let one = make(7, 1);
    assert_eq!(one, make(7, 1));
    assert_eq!(one, make(7, 2));
    assert_ne!(one, make(8, 2));
}

#[test]
fn a_small_city_has_all_four_classes_in_plausible_shares() {
    let city = small();
    let mut area = [0.0; 4];
    let faces = city.source.parts.iter().flat_map(|part| part.faces.iter().map(move |f| (part, f)));
    for ((part, face), class) in faces.zip(&city.truth) {
        let [a, b, c] = face.map(|v| part.positions[v as usize]);
        area[class.index()] += (b - a).cross(c - a).length() / 2.0;
    }
    let all: f64 = area.iter().sum();
    let wanted = [0.35..0.65, 0.10..0.35, 0.08..0.25, 0.05..0.30];
    for (class, range) in wanted.iter().enumerate() {
        assert!(range.contains(&(area[class] / all)), "class {class}: {:.3} of {all:.0} m²", area[class] / all);
    }
    assert!((100_000..150_000).contains(&city.truth.len()), "{} faces", city.truth.len());
}

#[test]
fn truth_follows_the_parts_and_repeats_as_face_labels() {
    let labels: Vec<i16> = small().source.parts.iter().flat_map(|p| p.face_labels.iter().copied()).collect();
    let truth: Vec<i16> = small().truth.iter().map(|c| i16::from(c.0)).collect();
    assert_eq!(labels, truth);
}

#[test]
fn everything_a_part_refers_to_is_there() {
    let source = &small().source;
    for part in &source.parts {
        assert!(part.positions.iter().all(|p| p.is_finite()));
        assert!(part.faces.iter().flatten().all(|&v| (v as usize) < part.positions.len()));
        assert!(part.faces.iter().all(|[a, b, c]| a != b && b != c && c != a));
        assert_eq!(part.faces.len(), part.corner_uvs.len());
        assert_eq!(part.faces.len(), part.face_material.len());
        let in_image = |v: f32| (0.0..=1.0).contains(&v);
        assert!(part.corner_uvs.iter().flatten().all(|uv| in_image(uv.x) && in_image(uv.y)));
        for &m in &part.face_material {
            let image = source.materials[m as usize].image.unwrap();
            assert_eq!(pixels(&source.images[image as usize]).dimensions(), (1024, 1024));
        }
    }
}

/// Welded across parts by exact position: per edge, its faces and its middle.
fn edges(city: &City) -> BTreeMap<(u32, u32), (u32, DVec3)> {
    let mut ids = BTreeMap::new();
    let mut edges = BTreeMap::new();
    for part in &city.source.parts {
        let id: Vec<u32> = part
            .positions
            .iter()
            .map(|p| {
                let next = ids.len() as u32;
                *ids.entry(p.to_array().map(f64::to_bits)).or_insert(next)
            })
            .collect();
        for face in &part.faces {
            for e in 0..3 {
                let (v, w) = (face[e] as usize, face[(e + 1) % 3] as usize);
                let middle = (part.positions[v] + part.positions[w]) / 2.0;
                let key = (id[v].min(id[w]), id[v].max(id[w]));
                edges.entry(key).or_insert((0, middle)).0 += 1;
            }
        }
    }
    edges
}

#[test]
fn nearly_every_edge_has_two_faces() {
    let edges = edges(small());
    let border = 65.0 - 2.0;
    let (mut open, mut crowded) = (0, 0);
    for (count, middle) in edges.values() {
        let inside = middle.truncate().abs().max_element() < border;
        open += usize::from(*count == 1 && inside);
        crowded += usize::from(*count > 2);
    }
    assert_eq!(open, 0, "open edges away from the border");
    assert!(crowded * 2000 < edges.len(), "{crowded} of {} edges are crowded", edges.len());
}

#[test]
fn neighbouring_parts_share_vertices_exactly() {
    let sets: Vec<BTreeSet<[u64; 3]>> = small()
        .source
        .parts
        .iter()
        .map(|p| p.positions.iter().map(|p| p.to_array().map(f64::to_bits)).collect())
        .collect();
    // Tiles 5 and 6 are neighbours along x; their common side is 32 m long.
    assert!(sets[5].intersection(&sets[6]).count() > 30);
    assert!(sets.iter().zip(&small().source.parts).all(|(s, p)| s.len() == p.positions.len()), "parts are welded");
}

#[test]
fn texels_show_what_the_truth_says() {
    // Lawns, leaves and hedges are the green things: green faces are terrain or clutter, hardly ever facade.
    let source = &small().source;
    let mut green = [0usize; 4];
    for part in &source.parts {
        let image = pixels(&source.images[part.face_material[0] as usize]);
        for (uvs, label) in part.corner_uvs.iter().zip(&part.face_labels) {
            let middle = (uvs[0] + uvs[1] + uvs[2]) / 3.0 * 1024.0;
            let [r, g, b] = image.get_pixel((middle.x as u32).min(1023), (middle.y as u32).min(1023)).0.map(i32::from);
            green[*label as usize] += usize::from(g > r + 6 && g > b + 12);
        }
    }
    assert!(green[0] + green[3] > 15_000, "{green:?}");
    assert!(green[1] * 20 < green[0] + green[3], "{green:?}");
}

#[test]
fn noise_has_the_deviation_that_was_asked_for() {
    let config = CityConfig::default();
    let shift = |i: i32| {
        let p = DVec3::new(f64::from(i % 100) * 0.83, f64::from(i / 100) * 0.83, 1.3);
        (disturb(&config, p, DVec3::Z) - p).z
    };
    let square = (0..10_000).map(|i| shift(i).powi(2)).sum::<f64>() / 10_000.0;
    // sqrt(3.5² + 2² + 1²/3) cm.
    assert!((square.sqrt() - 0.0407).abs() < 0.006, "{}", square.sqrt());
    let still = CityConfig { noise_m: 0.0, ..config };
    assert_eq!(disturb(&still, DVec3::ONE, DVec3::Z), DVec3::ONE);
}

#[test]
fn hardly_anything_floats() {
    // Islands of the welded surface, by union of edge ends.
    let edges = edges(small());
    let count = edges.keys().map(|e| e.1 as usize + 1).max().unwrap();
    let mut parent: Vec<u32> = (0..count as u32).collect();
    fn find(parent: &mut [u32], mut v: u32) -> u32 {
        while parent[v as usize] != v {
            parent[v as usize] = parent[parent[v as usize] as usize];
            v = parent[v as usize];
        }
        v
    }
    for &(v, w) in edges.keys() {
        let (a, b) = (find(&mut parent, v), find(&mut parent, w));
        parent[a.max(b) as usize] = a.min(b);
    }
    let ground = find(&mut parent, 0);
    let floating = (0..count as u32).filter(|&v| find(&mut parent, v) != ground).count();
    assert!(floating * 100 < count, "{floating} of {count} vertices float");
}
