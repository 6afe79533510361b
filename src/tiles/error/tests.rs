use super::*;

fn grid(n: usize, height: impl Fn(f64, f64) -> f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let mut positions = Vec::new();
    let mut faces = Vec::new();
    for y in 0..=n {
        for x in 0..=n {
            let (x, y) = (x as f64 / n as f64 * 10.0, y as f64 / n as f64 * 10.0);
            positions.push(DVec3::new(x, y, height(x, y)));
        }
    }
    for y in 0..n {
        for x in 0..n {
            let a = (y * (n + 1) + x) as u32;
            let m = n as u32 + 1;
            faces.extend([[a, a + 1, a + m + 1], [a, a + m + 1, a + m]]);
        }
    }
    (positions, faces)
}

fn both(a: &(Vec<DVec3>, Vec<[u32; 3]>), b: &(Vec<DVec3>, Vec<[u32; 3]>), fine: bool) -> Deviation {
    let (la, lb) = (vec![ClassId(0); a.1.len()], vec![ClassId(0); b.1.len()]);
    let sa = Surface { positions: &a.0, faces: &a.1, labels: &la };
    let sb = Surface { positions: &b.0, faces: &b.1, labels: &lb };
    let tree = Bvh::new(&b.0, &b.1);
    if fine { from_source(sa, sb, &tree, 1).remove(0) } else { from_tile(sa, sb, &tree, &[0.0]).remove(0) }
}

#[test]
fn the_interval_holds_the_dense_sample() {
    let bumpy = grid(23, |x, y| (x * 1.3).sin() * (y * 0.7).cos());
    let coarse = grid(4, |x, y| (x * 1.3).sin() * (y * 0.7).cos() * 0.8);
    for (from, to, fine) in [(&bumpy, &coarse, true), (&coarse, &bumpy, false)] {
        let found = both(from, to, fine);
        let tree = Bvh::new(&to.0, &to.1);
        let mut worst = 0f64;
        for f in &from.1 {
            let [a, b, c] = f.map(|v| from.0[v as usize]);
            for i in 0..=40 {
                for j in 0..=40 - i {
                    let p = a + (b - a) * (i as f64 / 40.0) + (c - a) * (j as f64 / 40.0);
                    worst = worst.max(tree.closest(p, f64::INFINITY).unwrap().distance);
                }
            }
        }
        assert!(found.upper_m >= worst - 1e-9, "{} < {worst}", found.upper_m);
        assert!(found.upper_m <= worst * 1.1 + TOLERANCE_M, "{} is loose for {worst}", found.upper_m);
        assert!(found.lower_m <= worst + 1e-3);
    }
}

#[test]
fn corners_cover_a_triangle_from_their_radius_and_from_no_less() {
    let corner = |x: f64, y: f64| DVec3::new(x, y, 0.0);
    let shapes = [[0.5, 0.9], [0.1, 0.05], [0.9, 0.3], [1.7, 0.2], [0.5, 1e-7], [0.0, 1.0], [0.3, 0.0]];
    for [x, y] in shapes {
        let corners = [corner(0.0, 0.0), corner(1.0, 0.0), corner(x, y)];
        let mut furthest = 0f64;
        for i in 0..=200 {
            for j in 0..=200 - i {
                let [a, b, c] = corners;
                let p = a + (b - a) * (f64::from(i) / 200.0) + (c - a) * (f64::from(j) / 200.0);
                furthest = furthest.max([a, b, c].iter().map(|q| (*q - p).length()).fold(f64::INFINITY, f64::min));
            }
        }
        let radius = cover_radius(corners);
        assert!((furthest..furthest + 0.02).contains(&radius), "{x} {y}: {radius} for {furthest}");
    }
}

#[test]
fn a_class_of_one_face_among_many_is_measured() {
    let (fine, coarse) = (grid(200, |_, _| 0.25), grid(120, |_, _| 0.0));
    let labels = |count: usize, odd: usize| (0..count).map(|f| ClassId(u8::from(f == odd))).collect::<Vec<_>>();
    let (lf, lc) = (labels(fine.1.len(), 77_777), labels(coarse.1.len(), 28_001));
    let source = Surface { positions: &fine.0, faces: &fine.1, labels: &lf };
    let tile = Surface { positions: &coarse.0, faces: &coarse.1, labels: &lc };
    let there = from_source(source, tile, &Bvh::new(&coarse.0, &coarse.1), 2);
    let back = from_tile(tile, source, &Bvh::new(&fine.0, &fine.1), &[0.0; 2]);
    for found in [there, back] {
        assert!((1..9).contains(&found[1].samples.len()), "{}", found[1].samples.len());
        assert!((0.25..0.27).contains(&found[1].upper_m), "{}", found[1].upper_m);
        assert!((0.5..3.0).contains(&(found[0].samples.len() as f64 / SAMPLES as f64)));
    }
}

#[test]
fn two_parallel_planes_are_their_distance_apart() {
    let (low, high) = (grid(8, |_, _| 0.0), grid(3, |_, _| 0.25));
    let down = both(&high, &low, false);
    let figures = down.figures();
    assert!((0.25..0.25 * (1.0 + TOLERANCE_SHARE) + 1e-9).contains(&down.upper_m), "{}", down.upper_m);
    for d in [down.lower_m, figures.mean_m, figures.rms_m, figures.p95_m, figures.p99_m] {
        assert!((d - 0.25).abs() < 1e-6, "{d}");
    }
    // The upper plane as source: the lower one sinks below it by all of the distance.
    // Rounded up to f32.
    assert!((0.25..0.25 + 1e-6).contains(&both(&high, &low, true).inside_m));
    assert!((-0.25..-0.25 + 1e-6).contains(&both(&low, &high, true).inside_m));
}

#[test]
fn a_lost_spike_is_seen_from_the_source_only() {
    let spiky = grid(20, |x, y| if (x - 5.0).hypot(y - 5.0) < 0.1 { 3.0 } else { 0.0 });
    let flat = grid(2, |_, _| 0.0);
    let seen = both(&spiky, &flat, true);
    assert!(seen.lower_m <= 3.0 && seen.upper_m >= 3.0 && seen.upper_m <= 1.05 * seen.lower_m + 1e-9, "{seen:?}");
    assert!(both(&flat, &spiky, false).upper_m < 0.5);
}
