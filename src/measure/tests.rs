use glam::DVec3;
use proptest::prelude::*;

use super::*;
use crate::geo::Aabb;

fn v(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::new(x, y, z)
}

fn surface(positions: &[DVec3], faces: &[[u32; 3]]) -> Surface {
    Surface { positions: positions.to_vec(), faces: faces.to_vec(), class: None }
}

/// A grid of n × n unit squares at the heights `z` gives.
fn grid(n: u32, z: impl Fn(u32, u32) -> f64) -> Surface {
    let row = n + 1;
    let positions = (0..row * row).map(|i| v(f64::from(i % row), f64::from(i / row), z(i % row, i / row))).collect();
    let square = |i: u32| {
        let a = i / n * row + i % n;
        [[a, a + 1, a + 1 + row], [a, a + 1 + row, a + row]]
    };
    Surface { positions, faces: (0..n * n).flat_map(square).collect(), class: None }
}

fn flat(n: u32, z: f64) -> Surface {
    grid(n, |_, _| z)
}

/// One square from `(x, y)`, `size` wide.
fn square(x: f64, y: f64, size: f64, z: f64) -> Surface {
    let corners = [v(x, y, z), v(x + size, y, z), v(x + size, y + size, z), v(x, y + size, z)];
    surface(&corners, &[[0, 1, 2], [0, 2, 3]])
}

fn few() -> MeasureConfig {
    MeasureConfig { samples: 20_000, ..MeasureConfig::default() }
}

fn close(a: f64, b: f64, within: f64) -> bool {
    (a - b).abs() <= within
}

#[test]
fn two_parallel_squares_are_their_distance_apart_everywhere() {
    let result = compare(&flat(4, 0.0), &square(0.0, 0.0, 4.0, 0.5), &few());
    let all = result.all;
    for summary in [&all.reference_to_simplified, &all.simplified_to_reference, &all.two_sided] {
        let s = summary.as_ref().unwrap();
        for figure in [s.mean_m, s.rms_m, s.p50_m, s.p95_m, s.p99_m, s.seen_max_m] {
            assert!(close(figure, 0.5, 1e-12), "{s:?}");
        }
        assert!(close(s.mean_rel, 0.5 / 32f64.sqrt(), 1e-12));
    }
    let h = all.hausdorff.two_sided.unwrap();
    assert!(close(h.lower_m, 0.5, 1e-12) && h.upper_m >= 0.5 && h.upper_m < 0.5 + 1e-9, "{h:?}");
    let signed = all.signed.unwrap();
    assert!(close(signed.outside_seen_m, 0.5, 1e-12) && signed.inside_seen_m == 0.0, "above is outside: {signed:?}");
    let paper = all.paper.unwrap();
    assert_eq!(paper.vertices, 4);
    assert!(close(paper.eq17_mean_m, 0.5, 1e-12) && close(paper.eq18_as_printed_sqrt_m, 0.5f64.sqrt(), 1e-12));
    assert!(close(paper.true_rms_m, 0.5, 1e-12));
    assert_eq!((all.reference_faces, all.simplified_faces, result.face_share), (32, 2, 2.0 / 32.0));
}

#[test]
fn a_surface_is_no_distance_from_itself() {
    let hills = grid(12, |x, y| (f64::from(x) * 0.7).sin() + (f64::from(y) * 1.3).cos());
    let result = compare(&hills, &hills, &few());
    assert!(result.all.two_sided.unwrap().seen_max_m < 1e-12);
    assert!(result.all.hausdorff.two_sided.unwrap().lower_m < 1e-12);
    assert!(result.normals.unwrap().mean_deg < 1e-3);
    assert_eq!(result.quality.border_edges, 48);
}

#[test]
fn a_pyramid_that_was_flattened_is_known_in_closed_form() {
    // Its top over the middle of a square of 2 m, height h: the mean height over the faces is h / 3.
    let h = 0.75;
    let bump = surface(
        &[v(0., 0., 0.), v(2., 0., 0.), v(2., 2., 0.), v(0., 2., 0.), v(1., 1., h)],
        &[[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
    );
    let result = compare(&bump, &square(0.0, 0.0, 2.0, 0.0), &MeasureConfig { samples: 200_000, ..few() });
    let there = result.all.reference_to_simplified.as_ref().unwrap();
    assert!(close(there.mean_m, h / 3.0, 2e-4), "{there:?}");
    assert!(close(there.rms_m, h / 6f64.sqrt(), 3e-4), "{there:?}");
    // A point at height z has the share (1 - z / h)² of the area above it.
    assert!(close(there.p95_m, h * (1.0 - 0.05f64.sqrt()), 2e-3) && close(there.p99_m, h * 0.9, 2e-3), "{there:?}");
    let h_there = result.all.hausdorff.reference_to_simplified.unwrap();
    assert!(close(h_there.lower_m, h, 1e-12) && h_there.upper_m < h + 1e-9, "{h_there:?}");
    // Back: the point below the top is nearest to the pyramid's slope, h cos of its steepness away.
    let back = result.all.hausdorff.simplified_to_reference.unwrap();
    let truth = h / (1.0 + h * h).sqrt();
    assert!(back.lower_m <= truth && truth <= back.upper_m, "{back:?} {truth}");
    assert!(back.upper_m - back.lower_m <= 6e-4, "2e-4 of the diagonal: {back:?}");
    let signed = result.all.signed.unwrap();
    assert!(close(signed.inside_seen_m, h, 1e-12) && signed.outside_seen_m == 0.0, "{signed:?}");
    // Eq. 17 looks at the four vertices left and sees nothing of it.
    assert_eq!(result.all.paper.unwrap().eq17_mean_m, 0.0);
}

#[test]
fn a_lowered_roof_is_found_in_its_class_and_on_the_inside() {
    let heights =
        |roof: f64| move |x: u32, y: u32| if (3..=6).contains(&x) && (3..=6).contains(&y) { roof } else { 0.0 };
    let mut reference = grid(10, heights(5.0));
    let is_roof = |f: &[u32; 3]| f.iter().all(|&i| reference.positions[i as usize].z == 5.0);
    let class: Vec<_> =
        reference.faces.iter().map(|f| if is_roof(f) { ClassId::ROOF } else { ClassId::TERRAIN }).collect();
    reference.class = Some(class);
    let result = compare(&reference, &grid(10, heights(4.7)), &few());
    let [terrain, roof] = &result.by_class[..] else { panic!("{:?}", result.by_class) };
    assert_eq!((terrain.class, roof.class), (ClassId::TERRAIN, ClassId::ROOF));
    assert_eq!((roof.figures.reference_faces, terrain.figures.reference_faces), (18, 182));
    let mean = |f: &Figures| f.reference_to_simplified.as_ref().unwrap().mean_m;
    assert!(close(mean(&roof.figures), 0.3, 1e-9), "{}", mean(&roof.figures));
    assert!(mean(&terrain.figures) < 0.02);
    let h = roof.figures.hausdorff.reference_to_simplified.unwrap();
    assert!(close(h.lower_m, 0.3, 1e-9) && h.upper_m < 0.3 + 3e-3, "{h:?}");
    assert!(close(roof.figures.signed.unwrap().inside_seen_m, 0.3, 1e-9));
    assert_eq!(roof.figures.signed.unwrap().outside_seen_m, 0.0);
    let whole = result.all.hausdorff.two_sided.unwrap();
    for class in &result.by_class {
        let part = class.figures.hausdorff.two_sided.unwrap();
        assert!(part.lower_m <= whole.lower_m && part.upper_m <= whole.upper_m);
    }
}

#[test]
fn a_chimney_that_was_cut_off_counts_as_sunk_in_by_its_height() {
    let height = |x: u32, y: u32| if (x, y) == (5, 5) { 1.2 } else { 0.0 };
    let result = compare(&grid(10, height), &flat(10, 0.0), &few());
    let signed = result.all.signed.unwrap();
    assert!(close(signed.inside_seen_m, 1.2, 1e-12) && signed.outside_seen_m < 1e-12, "{signed:?}");
    assert!(signed.either_upper_m >= 1.2);
}

#[test]
fn one_moved_vertex_among_thousands_is_not_missed() {
    let moved = |x: u32, y: u32| if (x, y) == (41, 17) { 0.4 } else { 0.0 };
    let no_samples = MeasureConfig { samples: 50, ..few() };
    let result = compare(&flat(60, 0.0), &grid(60, moved), &no_samples);
    let h = result.all.hausdorff.two_sided.unwrap();
    assert!(close(h.lower_m, 0.4, 1e-12) && h.upper_m < 0.42, "{h:?}");
    let [there, back] = Reference::new(&flat(60, 0.0)).certify(&grid(60, moved), &no_samples).unwrap();
    assert!(close(there.max(back).lower_m, 0.4, 1e-12) && there.max(back).upper_m < 0.42, "{there:?} {back:?}");
}

#[test]
fn far_from_the_origin_nothing_changes_but_the_last_digits() {
    let (one, two) = (grid(5, |x, y| f64::from(x * y) * 0.1), flat(5, 0.3));
    let far = |s: &Surface| Surface {
        positions: s.positions.iter().map(|p| p + v(4_512_345.0, 5_430_000.0, 312.0)).collect(),
        ..s.clone()
    };
    let (near, moved) = (compare(&one, &two, &few()), compare(&far(&one), &far(&two), &few()));
    let mean = |c: &Comparison| c.all.two_sided.as_ref().unwrap().mean_m;
    assert!(close(mean(&near), mean(&moved), 1e-8));
    let upper = |c: &Comparison| c.all.hausdorff.two_sided.unwrap().upper_m;
    assert!(close(upper(&near), upper(&moved), 1e-8));
}

#[test]
fn empty_degenerate_and_broken_surfaces_are_measured_as_far_as_they_go() {
    let good = flat(2, 0.0);
    let nan = surface(&[v(f64::NAN, 0., 0.), v(1., 0., 0.), v(0., 1., 0.)], &[[0, 1, 2], [0, 1, 9]]);
    let line = surface(&[v(0., 0., 1.), v(2., 0., 1.)], &[[0, 1, 0], [1, 1, 1]]);
    for (a, b) in [(&good, &Surface::default()), (&Surface::default(), &good), (&good, &nan), (&nan, &nan)] {
        let result = compare(a, b, &few());
        assert_eq!((result.all.two_sided, result.all.hausdorff.two_sided), (None, None));
        assert_eq!(Reference::new(a).certify(b, &few()), None);
    }
    assert_eq!(Reference::new(&nan).quality().faces_left_out, 2);
    let result = compare(&good, &line, &few());
    assert!(result.all.simplified_to_reference.is_none(), "a line has no area to sample");
    let h = result.all.hausdorff.two_sided.unwrap();
    let truth = 5f64.sqrt();
    assert!(h.lower_m <= truth + 1e-12 && truth <= h.upper_m && h.upper_m < truth + 1e-2, "{h:?}");
    compare(&line, &good, &few());
    compare(&line, &line, &few());
}

#[test]
fn flaws_of_a_mesh_are_counted() {
    let positions = [v(0., 0., 0.), v(1., 0., 0.), v(1., 1., 0.), v(0., 1., 0.), v(0.5, 0.5, 1.), v(0.001, 1., 0.)];
    let quality = |faces: &[[u32; 3]]| Reference::new(&surface(&positions, faces)).quality().clone();
    assert_eq!(quality(&[[0, 1, 2], [0, 2, 3]]).inconsistent_edges, 0);
    assert_eq!(quality(&[[0, 1, 2], [0, 3, 2]]).inconsistent_edges, 1);
    assert_eq!(quality(&[[0, 1, 2], [0, 2, 3], [0, 2, 4]]).nonmanifold_edges, 1);
    let twice = quality(&[[0, 1, 2], [2, 0, 1], [0, 0, 1]]);
    assert_eq!((twice.duplicate_faces, twice.faces, twice.faces_in_file), (1, 2, 3));
    let folded = quality(&[[0, 1, 2], [1, 0, 2]]);
    assert_eq!(folded.folded_edges, 3);
    assert_eq!(quality(&[[0, 5, 3]]).sliver_faces, 1);
    assert!(close(quality(&[[0, 1, 2]]).border_length_m, 2.0 + 2f64.sqrt(), 1e-12));
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let mut hills = grid(40, |x, y| (f64::from(x) * 0.7).sin() + (f64::from(y) * 1.3).cos());
    hills.class = Some((0..hills.faces.len()).map(|f| ClassId((f / 900) as u8)).collect());
    let rough = grid(40, |x, y| (f64::from(x) * 0.7).sin() + (f64::from(y) * 1.3).cos() * 0.9);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| serde_json::to_string(&compare(&hills, &rough, &few())).unwrap())
    };
    assert_eq!(run(1), run(4));
}

#[test]
fn a_reference_in_parts_gives_the_same_figures() {
    let mut hills = grid(40, |x, y| (f64::from(x) * 0.7).sin() + (f64::from(y) * 1.3).cos());
    hills.class = Some((0..hills.faces.len()).map(|f| ClassId((f / 900) as u8)).collect());
    let rough = grid(40, |x, y| (f64::from(x) * 0.7).sin() + (f64::from(y) * 1.3).cos() * 0.8);
    let config = MeasureConfig { samples: 200_000, ..few() };
    let (one, detail) = Reference::new(&hills).compare_in_detail(&rough, &config);
    // Four parts, row by row.
    let part = |i: usize| {
        let faces = 800 * i..800 * (i + 1);
        let class = hills.class.as_ref().map(|class| class[faces.clone()].to_vec());
        Surface { positions: hills.positions.clone(), faces: hills.faces[faces].to_vec(), class }
    };
    let around = |s: &Surface| Aabb::of(s.faces.iter().flatten().map(|&v| s.positions[v as usize]));
    let boxes: Vec<Aabb> = (0..4).map(|i| around(&part(i))).collect();
    let area = |f: &[u32; 3]| {
        let [a, b, c] = f.map(|v| hills.positions[v as usize]);
        (b - a).cross(c - a).length() / 2.0
    };
    let whole = Whole { aabb: around(&hills), area_m2: hills.faces.iter().map(area).sum() };
    let mut pieces = Piecewise::new(&rough, whole, &boxes, &config);
    for i in 0..4 {
        pieces.add(&part(i), &mut |within| {
            let mut near = hills.clone();
            let touches = |f: usize| {
                let corners = hills.faces[f].map(|v| hills.positions[v as usize]);
                Aabb::of(corners).min.cmple(within.max).all() && Aabb::of(corners).max.cmpge(within.min).all()
            };
            let kept: Vec<usize> = (0..hills.faces.len()).filter(|&f| f / 800 == i || touches(f)).collect();
            assert!(kept.len() < hills.faces.len(), "not all is near");
            near.faces = kept.iter().map(|&f| hills.faces[f]).collect();
            near.class = hills.class.as_ref().map(|class| kept.iter().map(|&f| class[f]).collect());
            Some(near)
        });
    }
    assert!(close(pieces.area_m2(), whole.area_m2, 1e-9));
    let (many, detail_of_many) = pieces.finish();
    assert_eq!(many.by_class.len(), one.by_class.len());
    let pairs = one.by_class.iter().zip(&many.by_class).map(|(a, b)| (&a.figures, &b.figures));
    for (a, b) in pairs.chain([(&one.all, &many.all)]) {
        assert_eq!(a.reference_faces, b.reference_faces);
        // On the border of two classes either may be nearest.
        assert!(a.simplified_faces.abs_diff(b.simplified_faces) <= 45, "{} {}", a.simplified_faces, b.simplified_faces);
        assert!(close(a.reference_area_share, b.reference_area_share, 1e-12));
        let (x, y) = (a.hausdorff.two_sided.unwrap(), b.hausdorff.two_sided.unwrap());
        assert!(x.lower_m <= y.upper_m && y.lower_m <= x.upper_m && y.upper_m - y.lower_m < 0.012, "{x:?} {y:?}");
        let (x, y) = (a.two_sided.as_ref().unwrap(), b.two_sided.as_ref().unwrap());
        for (x, y) in [(x.mean_m, y.mean_m), (x.rms_m, y.rms_m), (x.p95_m, y.p95_m), (x.p99_m, y.p99_m)] {
            assert!(close(x, y, 0.01 * x), "{x} {y}");
        }
        let (x, y) = (a.signed.unwrap(), b.signed.unwrap());
        // Seen at vertices and at samples, which lie elsewhere.
        let is_close = close(x.inside_seen_m, y.inside_seen_m, 0.02) && close(x.outside_seen_m, y.outside_seen_m, 0.02);
        assert!(is_close, "{x:?} {y:?}");
        let (x, y) = (a.paper.unwrap(), b.paper.unwrap());
        assert!(x.vertices.abs_diff(y.vertices) <= 45 && close(x.eq17_mean_m, y.eq17_mean_m, 0.02), "{x:?} {y:?}");
    }
    assert_eq!(one.all.paper.map(|p| p.vertices), many.all.paper.map(|p| p.vertices));
    for (a, b) in [
        (detail.worst_of_reference, detail_of_many.worst_of_reference),
        (detail.worst_of_simplified, detail_of_many.worst_of_simplified),
    ] {
        assert!(close(a.unwrap().1, b.unwrap().1, 1e-12));
    }
    assert_eq!(detail.nearest_class.len(), detail_of_many.nearest_class.len());
}

#[test]
fn too_few_pieces_make_the_interval_wide_and_never_wrong() {
    let hills = grid(20, |x, y| (f64::from(x) * 0.7).sin() + (f64::from(y) * 1.3).cos());
    let big = square(0.0, 0.0, 20.0, 0.3);
    let h = |most_pieces, tolerance_m| {
        let config = MeasureConfig { most_pieces, tolerance_m: Some(tolerance_m), ..few() };
        compare(&hills, &big, &config).all.hausdorff.two_sided.unwrap()
    };
    let (fine, coarse) = (h(2_000_000, 1e-4), h(3, 1e-4));
    assert!(fine.upper_m - fine.lower_m <= 1e-4 + 1e-9, "{fine:?}");
    assert!(coarse.lower_m <= fine.upper_m && coarse.upper_m >= fine.lower_m && coarse.upper_m >= fine.upper_m);
    // Tighter than rounding allows: ends, and still holds the truth.
    let none = h(20_000, 0.0);
    assert!(none.lower_m <= fine.upper_m && none.upper_m >= fine.lower_m);
}

/// Some triangles in a box, with a class each.
fn soup(faces: std::ops::Range<usize>) -> impl Strategy<Value = Surface> {
    let corner = (0.0..4.0, 0.0..4.0, 0.0..2.0f64);
    let face = ((corner.clone(), corner.clone(), corner), 0..3u8);
    prop::collection::vec(face, faces).prop_map(|all| {
        let points = |((a, b, c), _): &((_, _, _), u8)| [*a, *b, *c].map(|(x, y, z): (f64, f64, f64)| v(x, y, z));
        Surface {
            positions: all.iter().flat_map(points).collect(),
            faces: (0..all.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
            class: Some(all.iter().map(|(_, class)| ClassId(*class)).collect()),
        }
    })
}

/// The largest distance from a dense grid on every face of `from`, for one class of the reference or all.
fn brute(from: &Surface, to: &Surface, class_of_to: bool, class: Option<ClassId>) -> Option<f64> {
    let corners = |s: &Surface, f: usize| s.faces[f].map(|i| s.positions[i as usize]);
    let class_at = |s: &Surface, f: usize| s.class.as_ref().map_or(ClassId(0), |c| c[f]);
    let n = 12;
    let mut largest = None;
    for f in 0..from.faces.len() {
        let [a, b, c] = corners(from, f);
        for i in 0..=n {
            for j in 0..=n - i {
                let (s, t) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
                let p = a + (b - a) * s + (c - a) * t;
                let far = |g: usize| (crate::geo::bvh::closest_on_triangle(p, &corners(to, g)) - p).length();
                let near = (0..to.faces.len()).min_by(|&g, &h| far(g).total_cmp(&far(h))).unwrap();
                let is_of = if class_of_to { class_at(to, near) } else { class_at(from, f) };
                if class.is_none_or(|k| k == is_of) {
                    largest = Some(far(near).max(largest.unwrap_or(0.0)));
                }
            }
        }
    }
    largest
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    #[test]
    fn the_interval_holds_what_brute_force_finds(reference in soup(1..9), simplified in soup(1..6), fine in any::<bool>()) {
        let tolerance_m = if fine { 1e-3 } else { 0.1 };
        let config = MeasureConfig { samples: 300, tolerance_m: Some(tolerance_m), ..few() };
        let result = compare(&reference, &simplified, &config);
        let all = result.by_class.iter().map(|c| (Some(c.class), &c.figures)).chain([(None, &result.all)]);
        for (class, figures) in all {
            let directions = [
                (brute(&reference, &simplified, false, class), figures.hausdorff.reference_to_simplified,
                    &figures.reference_to_simplified),
                (brute(&simplified, &reference, true, class), figures.hausdorff.simplified_to_reference,
                    &figures.simplified_to_reference),
            ];
            for (found, interval, sampled) in directions {
                let sampled = sampled.as_ref().map(|s| s.seen_max_m);
                for found in [found, sampled].into_iter().flatten() {
                    let interval = interval.unwrap();
                    prop_assert!(found <= interval.upper_m, "{class:?} {found} {interval:?}");
                    prop_assert!(interval.upper_m - interval.lower_m <= tolerance_m + 1e-9, "{interval:?}");
                    if Some(found) == sampled {
                        prop_assert!(interval.lower_m >= found, "{interval:?} {found}");
                    }
                }
                // A dense grid comes near the lower bound: it is no invention.
                if let (Some(found), Some(interval), None) = (found, interval, class) {
                    prop_assert!(interval.lower_m <= found + 0.45, "{interval:?} {found}");
                }
            }
        }
        let [there, back] = Reference::new(&reference).certify(&simplified, &config).unwrap();
        let upper = result.all.hausdorff.two_sided.unwrap().upper_m;
        prop_assert!((there.max(back).upper_m - upper).abs() <= tolerance_m + 1e-9);
    }
}
