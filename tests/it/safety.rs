//! Errors, budgets and sinking per class, held against the city from outside.

use glam::DVec3;
use rayon::prelude::*;
use rooftile::geo::bvh::{Bvh, closest_on_triangle};

use crate::common::town::{Town, flight_town, town};

const CLASSES: [&str; 4] = ["terrain", "facade", "roof", "clutter"];
/// Leaves state what snapping and rounding moved; samples of them are rounded too, metres.
const ROUNDING_M: f64 = 1e-3;

/// Points of the source below a tile with their class, as its leaves have them.
fn source_points(town: &Town, node: usize, most: usize) -> Vec<(usize, DVec3)> {
    let leaves = town.leaves(node);
    let faces: usize = leaves.iter().map(|&n| town.nodes[n].tile.faces.len()).sum();
    let step = (faces / most).max(1);
    let all = leaves.iter().flat_map(|&n| {
        let tile = &town.nodes[n].tile;
        (0..tile.faces.len()).map(move |f| (tile.feature_ids[tile.faces[f][0] as usize] as usize, tile.corners(f)))
    });
    all.step_by(step)
        .flat_map(|(class, [a, b, c])| [a, b, c, (a + b + c) / 3.0, (a + b) / 2.0].map(|p| (class, p)))
        .collect()
}

#[test]
fn budgets_and_bounds_of_every_class_hold_from_outside_for_all_tiles() {
    let town = town();
    let source = Bvh::new(&town.positions, &town.faces);
    let checked: usize = (0..town.nodes.len())
        .into_par_iter()
        .map(|n| {
            let node = &town.nodes[n];
            let tile = &node.tile;
            let own = Bvh::new(&tile.positions, &tile.faces);
            let mut worst_m = [0f64; 4];
            for (class, p) in source_points(town, n, 20_000) {
                worst_m[class] = worst_m[class].max(own.closest(p, f64::INFINITY).expect("a surface").distance);
            }
            for f in 0..tile.faces.len() {
                let ([a, b, c], class) = (tile.corners(f), tile.feature_ids[tile.faces[f][0] as usize] as usize);
                for p in [a, b, c, (a + b + c) / 3.0, (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0] {
                    worst_m[class] = worst_m[class].max(source.closest(p, f64::INFINITY).expect("a surface").distance);
                }
            }
            let mut checked = 0;
            for (class, name) in CLASSES.iter().enumerate() {
                let number = |what: &str| node.number(&format!("{name}{what}"));
                let Some(bound_m) = number("Bound") else {
                    assert_eq!(worst_m[class], 0.0, "{} has {name} and states nothing", node.uri);
                    continue;
                };
                let budget_m = number("Budget").expect("a budget");
                assert!(bound_m <= budget_m, "{}: {name} {bound_m} m, budget {budget_m} m", node.uri);
                let sampled_m = worst_m[class];
                assert!(sampled_m <= bound_m + ROUNDING_M, "{}: {name} {sampled_m} m, stated {bound_m} m", node.uri);
                let (mean, rms) = (number("Mean").expect("a mean"), number("Rms").expect("an rms"));
                let (p95, p99) = (number("P95").expect("p95"), number("P99").expect("p99"));
                assert!(mean <= rms + 1e-9 && p95 <= p99 && p99 <= bound_m && rms <= bound_m, "{}", node.uri);
                checked += 1;
            }
            if let Some(parent) = node.parent {
                assert!(node.number("scale") <= town.nodes[parent].number("scale"), "{}", node.uri);
            }
            checked
        })
        .sum();
    assert!(checked > 50, "{checked}");
}

/// True if the tile has a point sideways within `reach_m` of `p` that is not lower than `floor_m`.
fn stands(town: &Town, n: usize, tree: &Bvh, p: DVec3, reach_m: f64, floor_m: f64) -> bool {
    let tile = &town.nodes[n].tile;
    let mut found = false;
    let (low, high) = ((p - reach_m).with_z(floor_m), (p + reach_m).with_z(f64::INFINITY));
    tree.overlapping(low, high, &mut |f| {
        let corners = tile.corners(f as usize);
        let mut above: Vec<DVec3> = Vec::new();
        for k in 0..3 {
            let (a, b) = (corners[k], corners[(k + 1) % 3]);
            if a.z >= floor_m {
                above.push(a);
            }
            if (a.z >= floor_m) != (b.z >= floor_m) {
                above.push(a + (b - a) * ((floor_m - a.z) / (b.z - a.z)));
            }
        }
        for i in 2..above.len() {
            let part = [above[0], above[i - 1], above[i]].map(|q| q.with_z(0.0));
            let p = p.with_z(0.0);
            found |= (closest_on_triangle(p, &part) - p).length() <= reach_m;
        }
    });
    found
}

/// Source points of roofs and façades that a tile stays below by more than `depth_m` says.
fn lower_than(town: &Town, depth_m: impl Fn(usize, &str) -> f64 + Sync) -> Vec<String> {
    (0..town.nodes.len())
        .into_par_iter()
        .filter(|&n| !town.nodes[n].is_leaf)
        .flat_map(|n| {
            let node = &town.nodes[n];
            let tree = Bvh::new(&node.tile.positions, &node.tile.faces);
            let points = source_points(town, n, 8_000);
            let mut found = Vec::new();
            for (class, p) in points.into_iter().filter(|(class, _)| [1, 2].contains(class)) {
                let name = CLASSES[class];
                let reach_m = node.number(&format!("{name}Bound")).expect("a bound") + ROUNDING_M;
                let floor_m = p.z - depth_m(n, name) - ROUNDING_M;
                if !stands(town, n, &tree, p, reach_m, floor_m) {
                    found.push(format!("{}: {name} at {p}", node.uri));
                }
            }
            found
        })
        .collect()
}

#[test]
fn no_tile_is_lower_than_its_source_by_more_than_it_states() {
    let town = town();
    let stated = |n: usize, name: &str| town.nodes[n].number(&format!("{name}Sunk")).expect("a number");
    assert_eq!(lower_than(town, stated), [""; 0]);
    let deepest = (0..town.nodes.len()).filter_map(|n| town.nodes[n].number("roofSunk")).fold(0.0, f64::max);
    assert!(deepest > 0.1, "without the flight preset roofs sink, or the next test means nothing: {deepest}");
}

#[test]
fn in_flight_no_tile_sinks_below_its_budget() {
    let town = flight_town();
    let stated = |n: usize, name: &str| town.nodes[n].number(&format!("{name}Sunk")).expect("a number");
    assert_eq!(lower_than(town, stated), [""; 0], "lower than certified");
    let deepest = |t: &Town| {
        let numbers = t.nodes.iter().flat_map(|n| ["roofSunk", "facadeSunk"].map(|id| n.number(id)));
        numbers.flatten().fold(0.0, f64::max)
    };
    println!("sinks up to {:.3} m, without the preset {:.3} m", deepest(town), deepest(self::town()));
    assert!(deepest(town) <= 0.05, "{}", deepest(town));
    let warnings = &town.run.json()["build"]["warnings"];
    assert!(warnings.as_array().is_some_and(|w| w.iter().all(|w| w["code"] != "sunken-tops")), "{warnings}");
    let widest = |t: &Town| t.nodes.iter().filter_map(|n| n.number("geometryError")).fold(0.0, f64::max);
    assert!(widest(town) < 3.0 * widest(self::town()), "raised, not torn up: {}", widest(town));
}
