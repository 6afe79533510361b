use glam::DVec2;

use super::*;
use crate::geo::Rect;
use crate::geo::bvh::closest_on_triangle;

/// A strip of ground 4 m long beside the wall x = 0, on its west (`west`) or east side; `heights` at even distances
/// along the wall.
fn strip(heights: &[f64], west: bool, low: f64, high: f64) -> (Vec<DVec3>, Vec<[u32; 3]>, Rect) {
    let n = heights.len();
    let far = if west { -2.0 } else { 2.0 };
    let mut positions = Vec::new();
    for (i, z) in heights.iter().enumerate() {
        let y = low + (high - low) * i as f64 / (n - 1) as f64;
        positions.extend([DVec3::new(0.0, y, *z), DVec3::new(far, y, *z)]);
    }
    let mut faces = Vec::new();
    for i in 0..n as u32 - 1 {
        let [a, b, c, d] = [2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 3];
        faces.extend(if west { [[a, c, b], [b, c, d]] } else { [[a, b, c], [b, d, c]] });
    }
    let plan = if west {
        Rect { min: DVec2::new(-2.0, low), max: DVec2::new(0.0, high) }
    } else {
        Rect { min: DVec2::new(0.0, low), max: DVec2::new(2.0, high) }
    };
    (positions, faces, plan)
}

fn border(of: &(Vec<DVec3>, Vec<[u32; 3]>, Rect)) -> Border {
    Border::of(&of.0, of.1.iter().copied(), of.2, 0.0)
}

#[test]
fn only_open_edges_on_walls_are_borders_and_the_solid_is_below_ground() {
    let ground = strip(&[0.0, 0.0, 0.0], true, 0.0, 4.0);
    let border = border(&ground);
    assert_eq!([0, 1, 2, 3].map(|side| border.count(side)), [2, 2, 1, 1]);
    for edge in (0..4).flat_map(|side| border.edges(side)) {
        assert!((edge.inward - DVec3::NEG_Z).length() < 1e-12, "{}", edge.inward);
    }
}

#[test]
fn a_facade_that_crosses_the_wall_has_its_solid_behind_it() {
    // South face of a house, seen from the south; the wall is x = 0 on its east, the house lies to the north.
    let positions = vec![DVec3::new(-1.0, 1.0, 0.0), DVec3::new(0.0, 1.0, 0.0), DVec3::new(0.0, 1.0, 3.0)];
    let plan = Rect { min: DVec2::new(-1.0, 0.0), max: DVec2::new(0.0, 4.0) };
    let border = Border::of(&positions, [[0, 1, 2]].into_iter(), plan, 0.0);
    assert_eq!(border.count(1), 1);
    assert!((border.edges(1)[0].inward - DVec3::Y).length() < 1e-12);
}

#[test]
fn the_skirts_of_two_levels_close_the_gap_between_them() {
    let fine = strip(&[0.0, 0.3, -0.4, 0.2, 0.0], true, 0.0, 4.0);
    let coarse = strip(&[0.1, 0.0], false, 0.0, 4.0);
    let hems = hems(&[border(&fine), border(&coarse)], Skirts::Auto);
    // The lowest point of the fine border is 0.45 m below the coarse line, as the crow flies a hair less.
    for hem in &hems {
        assert!((0.44..0.47).contains(&hem.wall_m), "{}", hem.wall_m);
    }
    // Where the coarse tile is higher its skirt goes down to the fine border, and the other way round.
    assert!(hems[1].skirt_m > 0.44 && hems[1].skirt_m < 0.5, "{}", hems[1].skirt_m);
    assert!((0.2..0.3).contains(&hems[0].skirt_m), "{}", hems[0].skirt_m);
    let at = |s: f64, ends: [(f64, f64); 2]| {
        let [(y0, z0), (y1, z1)] = ends;
        let low = y0.min(y1) - 1e-9;
        (low..=y0.max(y1) + 1e-9).contains(&s).then(|| z0 + (z1 - z0) * (s - y0) / (y1 - y0))
    };
    let line = |of: &(Vec<DVec3>, Vec<[u32; 3]>, Rect), s: f64| {
        of.1.iter().find_map(|f| {
            let on: Vec<DVec3> = f.map(|v| of.0[v as usize]).into_iter().filter(|p| p.x == 0.0).collect();
            (on.len() == 2).then(|| at(s, [(on[0].y, on[0].z), (on[1].y, on[1].z)])).flatten()
        })
    };
    let foot = |hem: &Hem, s: f64| {
        let side = hem.strips.iter().filter(|strip| strip.below.iter().all(|p| p.x == 0.0));
        let lows = side.filter_map(|strip| at(s, strip.below.map(|p| (p.y, p.z))));
        lows.fold(f64::INFINITY, f64::min)
    };
    for i in 1..400 {
        let s = f64::from(i) / 100.0;
        let (a, b) = (line(&fine, s).unwrap(), line(&coarse, s).unwrap());
        let (high, low) = if a > b { (&hems[0], b) } else { (&hems[1], a) };
        assert!((a - b).abs() < 1e-9 || foot(high, s) < low, "at {s}: {a} {b} {}", foot(high, s));
    }
}

#[test]
fn a_fence_that_the_neighbour_lost_is_closed_to_its_top() {
    // 3 m high, 0.4 m thick, of several edges on each side.
    let places = [0.0, 1.8, 1.8, 1.8, 1.8, 2.2, 2.2, 2.2, 2.2, 4.0];
    let heights = [0.0, 0.0, 1.0, 2.0, 3.0, 3.0, 2.0, 1.0, 0.0, 0.0];
    let mut fence = strip(&heights, true, 0.0, 4.0);
    (0..places.len()).for_each(|i| (0..2).for_each(|k| fence.0[2 * i + k].y = places[i]));
    let flat = strip(&[0.0, 0.0], false, 0.0, 4.0);
    let hems = hems(&[border(&fence), border(&flat)], Skirts::Auto);
    let on_wall = hems[0].strips.iter().filter(|s| s.below.iter().all(|p| p.x == 0.0));
    let strips: Vec<[DVec3; 4]> = on_wall
        .map(|s| {
            let face = fence.1[s.face as usize];
            let [a, b] = [0, 1].map(|k| fence.0[face[(s.corner as usize + k) % 3] as usize]);
            [a, b, s.below[1], s.below[0]]
        })
        .collect();
    let covers = |p: DVec3, s: &[DVec3; 4]| {
        let near = |t: [DVec3; 3]| (closest_on_triangle(p, &t) - p).length() < 1e-9;
        near([s[0], s[1], s[2]]) || near([s[0], s[2], s[3]])
    };
    for i in 1..30 {
        for y in [1.82, 1.9, 1.99, 2.05, 2.15] {
            let p = DVec3::new(0.0, y, 0.1 * f64::from(i));
            assert!(strips.iter().any(|s| covers(p, s)), "{p}");
        }
    }
    let widest_y = strips.iter().flatten().map(|p| (p.y - 2.0).abs()).filter(|y| *y < 1.0).fold(0.0, f64::max);
    assert!(widest_y < 0.23, "the skirts of one side do not come out of the other: {widest_y}");
    assert!(hems[1].strips.is_empty());
}

#[test]
fn equal_borders_need_no_skirts_and_fixed_ones_hang_everywhere() {
    let (west, east) = (strip(&[0.0, 1.0, 0.5], true, 0.0, 4.0), strip(&[0.0, 1.0, 0.5], false, 0.0, 4.0));
    let borders = [border(&west), border(&east)];
    for hem in hems(&borders, Skirts::Auto) {
        assert!(hem.wall_m < 1e-9 && hem.strips.is_empty());
    }
    for hem in hems(&borders, Skirts::Metres(0.5)) {
        assert!(hem.strips.len() >= 2 && hem.skirt_m >= 0.5);
    }
    assert!(hems(&borders, Skirts::Off).iter().all(|hem| hem.strips.is_empty()));
}

#[test]
fn tiles_that_cannot_meet_are_not_compared() {
    let (west, east) = (strip(&[0.0, 0.0], true, 0.0, 4.0), strip(&[5.0, 5.0], false, 4.0, 8.0));
    assert!(hems(&[border(&west), border(&east)], Skirts::Auto).iter().all(|hem| hem.wall_m == 0.0));
}

#[test]
fn what_skirts_may_be_is_read_and_written_alike() {
    assert_eq!(Skirts::parse("auto"), Some(Skirts::Auto));
    assert_eq!(Skirts::parse("0.5"), Some(Skirts::Metres(0.5)));
    for wrong in ["", "on", "-1", "nan", "inf", "1e9"] {
        assert_eq!(Skirts::parse(wrong), None, "{wrong}");
    }
}

#[test]
fn a_border_that_ends_hangs_no_deeper_than_the_ground_beside_it_goes() {
    // The western ground ends after 1 m of 40, the eastern one goes on half a metre lower.
    let mut west = strip(&[0.5, 0.5], true, 0.0, 1.0);
    west.2.max.y = 40.0;
    let hems = hems(&[border(&west), border(&strip(&[0.0, 0.0, 0.0], false, 0.0, 40.0))], Skirts::Auto);
    assert!(hems[0].wall_m > 38.9, "the borders are that far apart: {}", hems[0].wall_m);
    assert!((0.5..0.6).contains(&hems[0].skirt_m), "{}", hems[0].skirt_m);
}
