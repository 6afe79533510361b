use super::*;

fn noise(i: u64) -> f64 {
    let mut z = i.wrapping_add(0x9E37_79B9_7F4A_7C15).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

fn soup(count: u64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let at = |i: u64| DVec3::new(noise(3 * i), noise(3 * i + 1), noise(3 * i + 2));
    let mut positions = Vec::new();
    for i in 0..count {
        let p = at(i) * 100.0 + DVec3::splat(5e5);
        positions.extend([p, p + at(i + 7777) * 3.0, p + at(i + 9999) * 3.0]);
    }
    let faces = (0..count as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    (positions, faces)
}

#[test]
fn closest_point_equals_brute_force() {
    let (positions, faces) = soup(2000);
    let bvh = Bvh::new(&positions, &faces);
    for i in 0..500 {
        let q = DVec3::new(noise(i * 5), noise(i * 5 + 1), noise(i * 5 + 2)) * 110.0 + DVec3::splat(5e5 - 5.0);
        let brute = faces
            .iter()
            .map(|f| (closest_on_triangle(q, &f.map(|v| positions[v as usize])) - q).length())
            .fold(f64::INFINITY, f64::min);
        let hit = bvh.closest(q, f64::INFINITY).unwrap();
        assert!((hit.distance - brute).abs() < 1e-12, "{} {brute}", hit.distance);
    }
}

#[test]
fn a_start_face_changes_how_fast_the_closest_point_is_found_and_not_where() {
    let (positions, faces) = soup(300);
    let bvh = Bvh::new(&positions, &faces);
    for i in 0..200 {
        let q = DVec3::new(noise(i * 5), noise(i * 5 + 1), noise(i * 5 + 2)) * 110.0 + DVec3::splat(5e5 - 5.0);
        let start = (i * 7 % 300) as u32;
        let corners = faces[start as usize].map(|v| positions[v as usize]);
        let hit = bvh.closest_from(q, start, &corners).unwrap();
        assert_eq!(hit.distance, bvh.closest(q, f64::INFINITY).unwrap().distance);
    }
}

#[test]
fn the_mask_of_a_ball_is_that_of_the_faces_in_it() {
    let (positions, faces) = soup(500);
    let bvh = Bvh::new(&positions, &faces);
    let bit = |f: u32| 1 << (f % 7);
    let masks = bvh.masks(bit);
    for i in 0..100 {
        let q = DVec3::new(noise(i * 5), noise(i * 5 + 1), noise(i * 5 + 2)) * 110.0 + DVec3::splat(5e5 - 5.0);
        let radius = 12.0 * noise(i + 50_000);
        let near = |f: &u32| {
            let corners = faces[*f as usize].map(|v| positions[v as usize]);
            (closest_on_triangle(q, &corners) - q).length() <= radius
        };
        let truth = (0..500).filter(near).fold(0, |mask, f| mask | bit(f));
        assert_eq!(bvh.mask_within(&masks, bit, q, radius, u32::MAX), truth);
        assert_eq!(bvh.mask_within(&masks, bit, q, radius, 1), truth & 1);
    }
}

#[test]
fn a_tree_of_sizes_that_never_end_is_no_deeper_than_the_stack() {
    // Each pair of faces is half as large as the one before and half as far from the middle.
    let sizes = (0..240).map(|i| if i % 2 == 0 { 1e15 } else { -1e15 } * 0.5f64.powi(i / 2));
    let positions: Vec<DVec3> =
        sizes.flat_map(|s| [DVec3::new(s, 0.0, 0.0), DVec3::new(s, s, 0.0), DVec3::new(s, 0.0, s)]).collect();
    let faces: Vec<[u32; 3]> = (0..240).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    let boxes: Vec<(Vec3, Vec3)> = (faces.iter())
        .map(|f| f.map(|v| positions[v as usize].as_vec3()))
        .map(|[a, b, c]| (a.min(b).min(c), a.max(b).max(c)))
        .collect();
    let halves = build(&boxes, &mut (0..240).collect::<Vec<u32>>(), 0, 0);
    let mut depths = vec![0; halves.len()];
    for (at, half) in halves.iter().enumerate().filter(|(_, half)| half.count == 0) {
        (depths[at + 1], depths[half.at as usize]) = (depths[at] + 1, depths[at] + 1);
    }
    let deepest = depths.into_iter().max().unwrap();
    assert!((20..=MOST_DEPTH).contains(&deepest), "{deepest}");
    let bvh = Bvh::new(&positions, &faces);
    for p in positions.iter().step_by(7) {
        assert_eq!(bvh.closest(*p, f64::INFINITY).unwrap().distance, 0.0);
    }
}

#[test]
fn equal_faces_are_all_found() {
    let faces = vec![[0, 1, 2]; 1000];
    let positions = [DVec3::ZERO, DVec3::X, DVec3::Y];
    let bvh = Bvh::new(&positions, &faces);
    let mut found = Vec::new();
    bvh.overlapping(DVec3::ZERO, DVec3::ONE, &mut |f| found.push(f));
    found.sort_unstable();
    assert_eq!(found, (0..1000).collect::<Vec<u32>>());
    assert_eq!(bvh.closest(DVec3::Z, 2.0).unwrap().distance, 1.0);
    assert_eq!(bvh.masks(|f| 1 << (f % 5))[0], 31);
}

#[test]
fn nothing_is_found_beyond_the_limit() {
    let (positions, faces) = soup(10);
    let bvh = Bvh::new(&positions, &faces);
    assert!(bvh.closest(DVec3::splat(5e5 - 1000.0), 10.0).is_none());
    assert!(Bvh::new(&[], &[]).closest(DVec3::ZERO, 1.0).is_none());
}

#[test]
fn a_box_query_finds_every_overlapping_face() {
    let (positions, faces) = soup(2000);
    let bvh = Bvh::new(&positions, &faces);
    let (min, max) = (DVec3::splat(5e5 + 20.0), DVec3::splat(5e5 + 60.0));
    let mut found = Vec::new();
    bvh.overlapping(min, max, &mut |f| found.push(f));
    found.sort_unstable();
    let inside = |f: &[u32; 3]| {
        let [a, b, c] = f.map(|v| positions[v as usize]);
        a.min(b).min(c).cmple(max).all() && a.max(b).max(c).cmpge(min).all()
    };
    let wanted: Vec<u32> = (0..faces.len() as u32).filter(|&f| inside(&faces[f as usize])).collect();
    assert!(!wanted.is_empty() && wanted.iter().all(|f| found.binary_search(f).is_ok()));
}

#[test]
fn a_turned_box_finds_every_face_in_it() {
    let (positions, faces) = soup(2000);
    let bvh = Bvh::new(&positions, &faces);
    for i in 0..20 {
        let n = DVec3::new(noise(i), noise(i + 1), noise(i + 2)).normalize();
        let u = n.any_orthonormal_vector();
        let axes = [u, n.cross(u), n];
        let (center, half) = (DVec3::splat(5e5 + 5.0 * i as f64), DVec3::new(20.0, 5.0, 1.0));
        let mut found = Vec::new();
        bvh.overlapping_turned(center, &axes, half, &mut |f, corners| {
            assert_eq!(*corners, faces[f as usize].map(|v| positions[v as usize]));
            found.push(f);
        });
        found.sort_unstable();
        let is_in = |p: DVec3| (0..3).all(|k| (p - center).dot(axes[k]).abs() <= half[k]);
        let wanted = (0..2000u32).filter(|&f| faces[f as usize].iter().any(|&v| is_in(positions[v as usize])));
        assert!(wanted.into_iter().all(|f| found.binary_search(&f).is_ok()));
        assert!(found.len() < 400, "{} of 2000 in a box of a tenth of the side and less", found.len());
    }
}

#[test]
fn near_enough_ends_the_search_and_nothing_else_changes() {
    let (positions, faces) = soup(2000);
    let bvh = Bvh::new(&positions, &faces);
    for i in 0..200 {
        let q = DVec3::new(noise(i * 5), noise(i * 5 + 1), noise(i * 5 + 2)) * 110.0 + DVec3::splat(5e5 - 5.0);
        let exact = bvh.closest(q, f64::INFINITY).unwrap();
        for enough in [exact.distance * 0.5, exact.distance * 2.0] {
            let hit = bvh.closest_until(q, f64::INFINITY, enough).unwrap();
            assert!(hit == exact || (hit.distance <= enough && hit.distance >= exact.distance));
        }
    }
}

#[test]
fn degenerate_triangles_answer_as_their_edges() {
    let t = [DVec3::ZERO, DVec3::X, DVec3::X * 2.0];
    assert!((closest_on_triangle(DVec3::new(1.5, 1.0, 0.0), &t) - DVec3::new(1.5, 0.0, 0.0)).length() < 1e-12);
    assert_eq!(closest_on_triangle(DVec3::Y, &[DVec3::ZERO; 3]), DVec3::ZERO);
}
