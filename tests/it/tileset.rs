//! What a published tileset promises, measured on the demo city with readers and oracles of the tests' own.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use glam::DVec3;
use rayon::prelude::*;
use rooftile::geo::bvh::Bvh;
use rooftile::inspect;

use crate::common::glb::area_m2;
use crate::common::town::{Node, town};

/// Coordinates are f32 about an origin less than 128 m away: half a step is 4 µm, and two tiles may round apart.
const ROUNDING_M: f64 = 1e-5;

#[test]
fn the_programs_own_check_finds_nothing() {
    assert_eq!(inspect::check(&town().folder).expect("a tileset"), []);
}

#[test]
fn the_tree_has_several_levels_and_every_tile_has_content() {
    let nodes = &town().nodes;
    let levels: BTreeSet<u64> = nodes.iter().map(|n| n.level).collect();
    assert!(levels.len() >= 3, "{levels:?}");
    assert_eq!(levels.iter().copied().collect::<Vec<_>>(), (0..levels.len() as u64).collect::<Vec<_>>());
    for node in nodes {
        assert!(!node.tile.faces.is_empty(), "{}", node.uri);
        assert_eq!(node.tile.primitives, 1, "{} is not one draw call", node.uri);
    }
    let leaf_faces: usize = nodes.iter().filter(|n| n.is_leaf).map(|n| n.tile.faces.len()).sum();
    assert!(nodes[0].tile.faces.len() * 10 < leaf_faces, "the root is hardly simpler than the leaves");
}

#[test]
fn errors_never_grow_towards_the_leaves_and_leaves_have_only_what_rounding_moved() {
    let nodes = &town().nodes;
    for node in nodes {
        if let Some(parent) = node.parent {
            assert!(node.error_m <= nodes[parent].error_m, "{} is worse than its parent", node.uri);
        }
        // Snapping to walls and f32: a tenth of a millimetre each.
        let rounding_m = 5e-4;
        assert_eq!(node.is_leaf, node.error_m < rounding_m, "{}: {} m", node.uri, node.error_m);
    }
}

#[test]
fn boxes_hold_their_content_and_their_children_and_leaves_fill_theirs() {
    let nodes = &town().nodes;
    let edges = |n: &Node| (n.middle - n.half, n.middle + n.half);
    for node in nodes {
        let (min, max) = edges(node);
        let all = &node.tile.positions;
        let (low, high) = (all.iter().copied().fold(all[0], DVec3::min), all.iter().copied().fold(all[0], DVec3::max));
        let slack = DVec3::splat(1e-9);
        assert!(low.cmpge(min - slack).all() && high.cmple(max + slack).all(), "{} leaves its box", node.uri);
        if node.is_leaf {
            // 2 mm: flat boxes are given a thickness.
            let gap = (low - min).max(max - high).max_element();
            assert!(gap < 2e-3, "the box of {} is {gap} m too large", node.uri);
        }
        if let Some(parent) = node.parent {
            let outer = edges(&nodes[parent]);
            let inside = min.cmpge(outer.0 - slack).all() && max.cmple(outer.1 + slack).all();
            assert!(inside, "the box of {} leaves its parent's", node.uri);
        }
    }
}

/// Points of a triangle on an even lattice, its corners among them.
fn lattice([a, b, c]: [DVec3; 3], parts: usize) -> impl Iterator<Item = DVec3> {
    let at = move |i: usize, j: usize| a + (b - a) * (i as f64 / parts as f64) + (c - a) * (j as f64 / parts as f64);
    (0..=parts).flat_map(move |i| (0..=parts - i).map(move |j| at(i, j)))
}

#[test]
fn no_sample_of_either_surface_is_further_than_the_geometric_error() {
    let town = town();
    let source = Bvh::new(&town.positions, &town.faces);
    let found: Vec<(usize, f64)> = (0..town.nodes.len())
        .into_par_iter()
        .filter(|&n| !town.nodes[n].is_leaf)
        .map(|n| {
            let tile = &town.nodes[n].tile;
            let farthest = |tree: &Bvh, points: &mut dyn Iterator<Item = DVec3>| {
                points.map(|p| tree.closest(p, f64::INFINITY).expect("a surface").distance).fold(0.0, f64::max)
            };
            let mut of_tile = (0..tile.faces.len()).flat_map(|f| lattice(tile.corners(f), 4));
            let to_source = farthest(&source, &mut of_tile);
            // The leaves below are the part of the source that the tile stands for; another test says so.
            let (positions, faces) = town.joined(&town.leaves(n));
            let corners = |f: usize| faces[f].map(|v: u32| positions[v as usize]);
            let own = Bvh::new(&tile.positions, &tile.faces);
            let step = (faces.len() / 20_000).max(1);
            let mut of_source =
                (0..faces.len()).step_by(step).flat_map(|f| lattice(corners(f), 1).chain([centre(corners(f))]));
            (n, to_source.max(farthest(&own, &mut of_source)))
        })
        .collect();
    assert!(found.len() >= 3);
    for (n, sampled_m) in found {
        let Node { uri, error_m, geometry_m, .. } = &town.nodes[n];
        assert!(*error_m >= *geometry_m, "{uri}: {error_m} < {geometry_m}");
        assert!(geometry_m + ROUNDING_M >= sampled_m, "{uri}: stated {geometry_m} m, sampled {sampled_m} m");
        // A bound that says nothing would pass as well.
        assert!(*geometry_m <= 2.0 * sampled_m + 0.01, "{uri}: stated {geometry_m} m, sampled only {sampled_m} m");
    }
}

fn centre([a, b, c]: [DVec3; 3]) -> DVec3 {
    (a + b + c) / 3.0
}

#[test]
fn the_leaves_are_the_source() {
    let town = town();
    let (positions, faces) = town.joined(&town.leaves(0));
    let area = |positions: &[DVec3], faces: &[[u32; 3]]| -> f64 {
        faces.iter().map(|f| area_m2(f.map(|v| positions[v as usize]))).sum()
    };
    let (of_leaves, of_source) = (area(&positions, &faces), area(&town.positions, &town.faces));
    assert!((of_leaves / of_source - 1.0).abs() < 1e-3, "{of_leaves} m² of {of_source} m²");

    let leaves = Bvh::new(&positions, &faces);
    let near = |tree: &Bvh, p: &DVec3| tree.closest(*p, 1e-3).is_some();
    let lost = town.positions.par_iter().filter(|p| !near(&leaves, p)).count();
    assert_eq!(lost, 0, "source vertices more than 1 mm off the leaves, of {}", town.positions.len());
    let source = Bvh::new(&town.positions, &town.faces);
    let added = faces.par_iter().filter(|f| !near(&source, &centre(f.map(|v| positions[v as usize])))).count();
    assert_eq!(added, 0, "leaf triangles more than 1 mm off the source, of {}", faces.len());
}

/// Gives points within [`ROUNDING_M`] of each other one number.
#[derive(Default)]
struct Welder {
    cells: HashMap<[i64; 3], Vec<(DVec3, usize)>>,
    count: usize,
}

impl Welder {
    const CELL_M: f64 = 1e-3;

    fn number(&mut self, p: DVec3) -> usize {
        let cell = |p: DVec3| (p / Self::CELL_M).floor().to_array().map(|c| c as i64);
        let reach = DVec3::splat(ROUNDING_M);
        let (low, high) = (cell(p - reach), cell(p + reach));
        for x in low[0]..=high[0] {
            for y in low[1]..=high[1] {
                for z in low[2]..=high[2] {
                    let mut known = self.cells.get(&[x, y, z]).into_iter().flatten();
                    if let Some((_, number)) = known.find(|(q, _)| (*q - p).abs().max_element() < ROUNDING_M) {
                        return *number;
                    }
                }
            }
        }
        self.cells.entry(cell(p)).or_default().push((p, self.count));
        self.count += 1;
        self.count - 1
    }
}

/// An edge along a wall between cells.
struct WallEdge {
    middle: DVec3,
    /// The tiles with a face at it, one entry a face.
    of: Vec<usize>,
}

/// All edges of some tiles whose ends agree in x or in y, as those on the walls of a quadtree do.
fn wall_edges(nodes: &[&Node]) -> Vec<WallEdge> {
    let mut welder = Welder::default();
    let mut edges: BTreeMap<[usize; 2], WallEdge> = BTreeMap::new();
    for (n, node) in nodes.iter().enumerate() {
        let numbers: Vec<usize> = node.tile.positions.iter().map(|p| welder.number(*p)).collect();
        for face in &node.tile.faces {
            for k in 0..3 {
                let ends = [face[k], face[(k + 1) % 3]];
                let [a, b] = ends.map(|v| node.tile.positions[v as usize]);
                if (a.x - b.x).abs() > ROUNDING_M && (a.y - b.y).abs() > ROUNDING_M {
                    continue;
                }
                let mut key = ends.map(|v| numbers[v as usize]);
                key.sort_unstable();
                edges.entry(key).or_insert_with(|| WallEdge { middle: (a + b) / 2.0, of: Vec::new() }).of.push(n);
            }
        }
    }
    edges.into_values().collect()
}

/// Requires that no edge on a wall between two of the tiles is there for one of them only; the number shared.
fn shared_edges(nodes: &[&Node]) -> usize {
    let reaches = |n: usize, p: DVec3| {
        let off = (p - nodes[n].middle).abs() - nodes[n].half;
        off.x < ROUNDING_M && off.y < ROUNDING_M
    };
    let mut shared = 0;
    for edge in wall_edges(nodes) {
        let tiles: BTreeSet<usize> = edge.of.iter().copied().collect();
        shared += usize::from(tiles.len() == 2);
        if edge.of.len() != 1 {
            continue;
        }
        if let Some(n) = (0..nodes.len()).find(|&n| n != edge.of[0] && reaches(n, edge.middle)) {
            let (own, other) = (&nodes[edge.of[0]].uri, &nodes[n].uri);
            panic!("the edge of {own} at {} has no partner in {other}", edge.middle);
        }
    }
    shared
}

/// Leaves fit leaves of any level, as the source fits itself, and simplified tiles those of their own level. A leaf beside
/// a simplified tile of its level does not fit it bit for bit; that gap is not judged here.
#[test]
fn neighbours_of_one_detail_share_their_borders() {
    let town = town();
    let leaves: Vec<&Node> = town.nodes.iter().filter(|n| n.is_leaf).collect();
    let of_leaves = shared_edges(&leaves);
    assert!(of_leaves > 1000, "only {of_leaves} edges between leaves were seen");
    let levels: BTreeSet<u64> = town.nodes.iter().map(|n| n.level).collect();
    let of_level = |level| town.nodes.iter().filter(|n| n.level == level && !n.is_leaf).collect::<Vec<_>>();
    let of_inner: usize = levels.into_iter().map(|level| shared_edges(&of_level(level))).sum();
    assert!(of_inner > 300, "only {of_inner} edges between simplified tiles were seen");
}

#[test]
fn every_vertex_has_a_class_and_the_classes_are_named() {
    let mut seen = BTreeSet::new();
    for node in &town().nodes {
        let json = &node.tile.json;
        let values = &json["extensions"]["EXT_structural_metadata"]["schema"]["enums"]["surfaceClass"]["values"];
        let names: Vec<&str> = values.as_array().expect("values").iter().filter_map(|v| v["name"].as_str()).collect();
        assert_eq!(names, ["terrain", "facade", "roof", "clutter"], "{}", node.uri);
        let primitive = &json["meshes"][0]["primitives"][0];
        let count = primitive["extensions"]["EXT_mesh_features"]["featureIds"][0]["featureCount"].as_u64();
        assert_eq!(node.tile.feature_ids.len(), node.tile.positions.len(), "{}", node.uri);
        let ids: BTreeSet<u32> = node.tile.feature_ids.iter().copied().collect();
        assert!(ids.iter().all(|id| *id < 8) && count.is_some_and(|c| c as usize >= ids.len()), "{}", node.uri);
        for face in &node.tile.faces {
            let [a, b, c] = face.map(|v| node.tile.feature_ids[v as usize]);
            assert!(a == b && b == c, "a face of {} has two classes", node.uri);
        }
        seen.extend(ids.iter().map(|id| id % 4));
    }
    assert_eq!(seen.len(), 4, "the city has all four classes: {seen:?}");
}

#[test]
fn the_summary_of_inspect_agrees_with_what_the_build_reported() {
    let town = town();
    let summary = inspect::tileset(&town.folder).expect("a tileset");
    let report = town.run.json();
    assert_eq!(report["findings"], serde_json::json!([]));
    let build = &report["build"];
    assert_eq!(build["tiles"].as_u64(), Some(summary.tiles));
    assert_eq!(summary.tiles as usize, town.nodes.len());
    assert_eq!(build["bytes"].as_u64(), summary.levels.iter().map(|l| Some(l.bytes)).sum());
    let accuracy = build["accuracy"]["overall_accuracy"].as_f64().expect("the demo knows the truth");
    assert!(accuracy > 0.8, "{accuracy}");
}
