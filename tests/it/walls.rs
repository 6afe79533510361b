//! Where tiles of different levels meet: gaps are as wide as stated, and skirts close them.

use std::collections::BTreeMap;

use glam::DVec3;
use rayon::prelude::*;
use rooftile::draw::raster::Seen;
use rooftile::draw::view::View;
use rooftile::geo::bvh::{Bvh, closest_on_triangle};

use crate::common::town::{Node, Town, flight_town, town};
use crate::common::{build, data};

/// Two tiles round their vertices apart, metres.
const ROUNDING_M: f64 = 1e-5;

/// Edges of a tile's surface in the plane of an axis at a place: those of an odd number of faces, and those of several on
/// the same side, for a scan may have the same sheet twice.
struct Edges {
    odd: Vec<[DVec3; 2]>,
    doubled: Vec<[DVec3; 2]>,
}

impl Edges {
    fn of(node: &Node, axis: usize, place: f64) -> Self {
        let at = |v: u32| node.tile.positions[v as usize];
        let near = |p: DVec3| (p[axis] - place).abs() < ROUNDING_M;
        let key = |p: DVec3| p.to_array().map(|c| (c * 1e4).round() as i64);
        let mut found: BTreeMap<[[i64; 3]; 2], (i32, i32, [DVec3; 2])> = BTreeMap::new();
        for face in &node.tile.faces {
            for k in 0..3 {
                let ends = [at(face[k]), at(face[(k + 1) % 3])];
                if ends.into_iter().all(near) {
                    let [from, to] = ends.map(key);
                    let entry = found.entry([from.min(to), from.max(to)]).or_insert((0, 0, ends));
                    entry.0 += 1;
                    entry.1 += if from < to { 1 } else { -1 };
                }
            }
        }
        let (odd, even): (Vec<_>, Vec<_>) = found.into_values().partition(|(count, ..)| count % 2 == 1);
        let doubled = even.into_iter().filter(|(count, sides, _)| sides.abs() == *count);
        Self {
            odd: odd.into_iter().map(|(.., ends)| ends).collect(),
            doubled: doubled.map(|(.., ends)| ends).collect(),
        }
    }
}

/// The open edges alone.
fn border(node: &Node, axis: usize, place: f64) -> Vec<[DVec3; 2]> {
    Edges::of(node, axis, place).odd
}

/// Largest distance of points of `from`, at most `step_m` apart and within a span along the wall, from `to`.
fn gap_m(from: &[[DVec3; 2]], to: &[[DVec3; 2]], along: usize, [low, high]: [f64; 2], step_m: f64) -> f64 {
    let positions: Vec<DVec3> = to.iter().flatten().copied().collect();
    let faces: Vec<[u32; 3]> = (0..to.len() as u32).map(|e| [2 * e, 2 * e + 1, 2 * e + 1]).collect();
    let tree = Bvh::new(&positions, &faces);
    let points = from.iter().flat_map(|[a, b]| {
        let parts = ((*b - *a).length() / step_m).ceil().max(1.0);
        (0..=parts as usize).map(move |i| *a + (*b - *a) * (i as f64 / parts))
    });
    let inside = points.filter(|p| (low..=high).contains(&p[along]));
    inside.map(|p| tree.closest(p, f64::INFINITY).map_or(0.0, |h| h.distance)).fold(0.0, f64::max)
}

/// Two tiles that may be drawn side by side, and where their cells meet.
struct Pair {
    tiles: [usize; 2],
    /// Across the wall.
    axis: usize,
    place: f64,
    /// Of both, along the wall.
    span: [f64; 2],
}

/// All pairs of tiles with a piece of wall between them, none above the other.
fn pairs(town: &Town) -> Vec<Pair> {
    // Of the surface: a skirt may run on along the wall beyond its cell's corner.
    let extents: Vec<(DVec3, DVec3)> = (town.nodes.iter())
        .map(|n| {
            let all = || n.tile.faces.iter().flatten().map(|&v| n.tile.positions[v as usize]);
            (all().fold(DVec3::INFINITY, DVec3::min), all().fold(DVec3::NEG_INFINITY, DVec3::max))
        })
        .collect();
    let ancestors: Vec<Vec<usize>> = (0..town.nodes.len()).map(|n| town.ancestors(n)).collect();
    let mut pairs = Vec::new();
    for a in 0..town.nodes.len() {
        for b in (0..town.nodes.len()).filter(|&b| b != a) {
            let related = ancestors[a].contains(&b) || ancestors[b].contains(&a);
            let ((low_a, high_a), (low_b, high_b)) = (extents[a], extents[b]);
            for axis in (0..2).filter(|&axis| !related && (high_a[axis] - low_b[axis]).abs() < ROUNDING_M) {
                let along = 1 - axis;
                let span = [low_a[along].max(low_b[along]), high_a[along].min(high_b[along])];
                // Those that meet at a corner only share a line.
                if span[1] - span[0] > 0.01 {
                    pairs.push(Pair { tiles: [a, b], axis, place: high_a[axis], span });
                }
            }
        }
    }
    pairs
}

/// How many of some edges are above a point of the wall.
fn above(edges: &[[DVec3; 2]], at: DVec3, along: usize) -> usize {
    let is_above = |[a, b]: &&[DVec3; 2]| {
        (a[along] <= at[along]) != (b[along] <= at[along])
            && a.z + (b.z - a.z) * (at[along] - a[along]) / (b[along] - a[along]) > at.z
    };
    edges.iter().filter(is_above).count()
}

fn nearest_m(edges: &[[DVec3; 2]], at: DVec3) -> f64 {
    let to = |[a, b]: &[DVec3; 2]| (closest_on_triangle(at, &[*a, *b, *b]) - at).length();
    edges.iter().map(to).fold(f64::INFINITY, f64::min)
}

/// What was found in all gaps of a tileset.
#[derive(Debug, Default)]
struct Gaps {
    /// Pairs of tiles of two levels.
    mixed: usize,
    /// The widest gap between two of them, metres.
    widest_m: f64,
    /// Points between two borders.
    between: usize,
    /// Of them, those that no skirt covers.
    open: usize,
}

/// Points on lines from a border to the nearest of the other that lie between both, and how many of them no skirt hides.
fn between(town: &Town, pair: &Pair, of: &[Vec<[DVec3; 2]>; 2]) -> (usize, usize) {
    let Pair { tiles, axis, place, span } = pair;
    let along = 1 - axis;
    let (mut positions, mut faces) = (Vec::new(), Vec::new());
    for tile in tiles.map(|t| &town.nodes[t].tile) {
        for face in &tile.skirts {
            let corners = face.map(|v| tile.positions[v as usize]);
            if corners.iter().all(|p| (p[*axis] - place).abs() < ROUNDING_M) {
                let first = positions.len() as u32;
                positions.extend(corners);
                faces.push([first, first + 1, first + 2]);
            }
        }
    }
    let skirts = Bvh::new(&positions, &faces);
    let (mut seen, mut open) = (0, 0);
    for (from, to) in [(&of[0], &of[1]), (&of[1], &of[0])] {
        let ends: Vec<DVec3> = to.iter().flatten().copied().collect();
        let lines: Vec<[u32; 3]> = (0..to.len() as u32).map(|e| [2 * e, 2 * e + 1, 2 * e + 1]).collect();
        let tree = Bvh::new(&ends, &lines);
        for [a, b] in from {
            let Some(hit) = tree.closest((*a + *b) * 0.5, f64::INFINITY) else { continue };
            for share in [0.1, 0.5, 0.9] {
                let at = ((*a + *b) * 0.5).lerp(hit.point, share);
                let is_inside = (span[0]..=span[1]).contains(&at[along]);
                if !is_inside || hit.distance < 0.01 || of.iter().map(|e| above(e, at, along)).sum::<usize>() % 2 == 0 {
                    continue;
                }
                seen += 1;
                open += usize::from(skirts.closest(at, 1e-4).is_none() && nearest_m(from, at) > HAIR_M);
            }
        }
    }
    (seen, open)
}

/// Requires that no gap is wider than stated.
fn require_stated_gaps(town: &Town) -> Gaps {
    let found: Vec<(f64, bool, (usize, usize))> = pairs(town)
        .into_par_iter()
        .filter_map(|pair| {
            let Pair { tiles: [a, b], axis, place, span } = pair;
            let edges = [a, b].map(|n| Edges::of(&town.nodes[n], axis, place));
            let all = [0, 1].map(|i| [&edges[i].odd[..], &edges[i].doubled].concat());
            let of = edges.map(|edges| edges.odd);
            if of.iter().any(Vec::is_empty) {
                return None;
            }
            let gap_m = |i: usize| gap_m(&of[i], &all[1 - i], 1 - axis, span, 0.02);
            let measured_m = gap_m(0).max(gap_m(1));
            let stated = |n: usize| town.nodes[n].number("wallDeviation").expect("a number");
            let (uris, stated_m) = ([a, b].map(|n| &town.nodes[n].uri), stated(a).min(stated(b)));
            assert!(measured_m <= stated_m + ROUNDING_M, "{uris:?}: {measured_m} m apart, stated {stated_m} m");
            Some((measured_m, town.nodes[a].level != town.nodes[b].level, between(town, &pair, &of)))
        })
        .collect();
    let mut gaps = Gaps::default();
    for (measured_m, is_mixed, (between, open)) in found {
        gaps.mixed += usize::from(is_mixed);
        gaps.widest_m = gaps.widest_m.max(measured_m);
        gaps.between += between;
        gaps.open += open;
    }
    println!("{gaps:?}");
    gaps
}

#[test]
fn no_gap_between_tiles_that_can_meet_is_wider_than_stated_and_skirts_cover_them() {
    for town in [town(), flight_town()] {
        let gaps = require_stated_gaps(town);
        assert!(gaps.mixed > 20, "{gaps:?}");
        assert!(gaps.widest_m > 0.05, "levels that never differ prove nothing: {gaps:?}");
        assert!(gaps.between > 5000 && 1000 * gaps.open <= gaps.between, "{gaps:?}");
    }
}

/// Numbers that are the same in every run.
struct Dice(u64);

impl Dice {
    fn below(&mut self, sides: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % sides
    }
}

/// Tiles that a viewer may draw together: each point of the city in exactly one of them.
fn random_cut(town: &Town, dice: &mut Dice) -> Vec<usize> {
    let refine_in_4 = 1 + dice.below(3);
    let (mut cut, mut open) = (Vec::new(), vec![0]);
    while let Some(n) = open.pop() {
        let children: Vec<usize> = (0..town.nodes.len()).filter(|&c| town.nodes[c].parent == Some(n)).collect();
        // A tile alone has no neighbours.
        let alone = open.is_empty() && cut.is_empty();
        if !children.is_empty() && alone || (!children.is_empty() && dice.below(4) < refine_in_4) {
            open.extend(children);
        } else {
            cut.push(n);
        }
    }
    cut
}

fn joined(town: &Town, cut: &[usize], with_skirts: bool) -> (Vec<DVec3>, Vec<[u32; 3]>, usize) {
    let (mut positions, mut faces) = town.joined(cut);
    let surface = faces.len();
    let mut first = 0;
    for &n in cut.iter().filter(|_| with_skirts) {
        let tile = &town.nodes[n].tile;
        faces.extend(tile.skirts.iter().map(|f| f.map(|v| v + first)));
        first += tile.positions.len() as u32;
    }
    positions.shrink_to_fit();
    (positions, faces, surface)
}

/// Views of the whole city and of some tiles of it.
fn views(town: &Town) -> Vec<View> {
    let corners = |n: &Node| {
        let of = |i: usize| DVec3::from_array([0, 1, 2].map(|k| if i >> k & 1 == 0 { -1.0 } else { 1.0 }));
        (0..8).map(|i| n.middle + n.half * of(i)).collect::<Vec<_>>()
    };
    let some = town.nodes.iter().filter(|n| n.level == 1 || n.is_leaf).take(24);
    let all = [&town.nodes[0]].into_iter().chain(some);
    all.enumerate()
        .map(|(i, n)| {
            let (azimuth_deg, elevation_deg) = (73.0 * i as f64, [25.0, 60.0, 40.0][i % 3]);
            View::oblique(&corners(n), azimuth_deg, elevation_deg, [640, 400])
        })
        .collect()
}

/// What cuts show where the whole surface is.
#[derive(Debug, Default)]
struct Shown {
    /// Background seen through a wall, between the borders of two tiles, pixels.
    open_px: u64,
    /// Background seen past all tiles, pixels: an outline that one tile covers at one level, another at the other.
    past_px: u64,
    /// Background if the skirts are left out, pixels.
    bare_px: u64,
    /// Cuts of more than one level.
    mixed: usize,
}

/// The tiles of one level, and the leaves that end above it.
fn uniform_cut(town: &Town, level: u64) -> Vec<usize> {
    let is_shown =
        |n: &usize| town.nodes[*n].level == level || (town.nodes[*n].is_leaf && town.nodes[*n].level < level);
    (0..town.nodes.len()).filter(is_shown).collect()
}

/// Pixels that show a surface, as do all around them.
fn covered(seen: &Seen) -> Vec<bool> {
    let [width, height] = seen.view().size_px().map(|side| side as usize);
    let has = |x: usize, y: usize| seen.depth_m(y * width + x).is_some();
    let around = |at: usize, side: usize| at.saturating_sub(1)..(at + 2).min(side);
    let is_covered = |i: usize| around(i / width, height).all(|y| around(i % width, width).all(|x| has(x, y)));
    (0..width * height).map(is_covered).collect()
}

/// A border within this of a line of sight may be a crack of its own, metres.
const HAIR_M: f64 = 2e-3;

/// Whether lines of sight pass between the borders of two tiles of a cut, or so near to one that they might.
struct Walls<'a> {
    town: &'a Town,
    /// Pairs of the cut, with the borders of both.
    pairs: Vec<(&'a Pair, [Vec<[DVec3; 2]>; 2])>,
}

impl<'a> Walls<'a> {
    fn of(town: &'a Town, cut: &[usize], all: &'a [Pair]) -> Self {
        let shown = all.iter().filter(|p| p.tiles.iter().all(|t| cut.contains(t)));
        let pairs = shown.map(|p| (p, p.tiles.map(|t| border(&town.nodes[t], p.axis, p.place)))).collect();
        Self { town, pairs }
    }

    fn are_open_at(&self, view: &View, px: usize) -> bool {
        let [width, height] = view.size_px().map(|side| side as usize);
        let offset = |at: usize, side: usize| (at as f64 + 0.5 - side as f64 * 0.5) * view.m_per_px(1.0);
        let ray = view.forward() + view.right() * offset(px % width, width) - view.up() * offset(px / width, height);
        self.pairs.iter().any(|(Pair { tiles, axis, place, span }, borders)| {
            let t = (place - view.eye()[*axis]) / ray[*axis];
            let at = view.eye() + ray * t;
            let along = 1 - axis;
            if !(t > 0.0 && (span[0] - HAIR_M..=span[1] + HAIR_M).contains(&at[along])) {
                return false;
            }
            let nearest_m = nearest_m(&borders[0], at).min(nearest_m(&borders[1], at));
            let wide_m = tiles.map(|n| self.town.nodes[n].number("wallDeviation").expect("a number"));
            let is_between = borders.iter().map(|edges| above(edges, at, along)).sum::<usize>() % 2 == 1;
            nearest_m <= HAIR_M || is_between && nearest_m <= wide_m[0].max(wide_m[1])
        })
    }
}

/// Draws random cuts. A pixel is open where a cut shows background and the source does not, nor any of the cut's levels
/// when it is drawn alone: so what simplifying lost, leaves of trees against the sky, is not taken for a crack.
fn show(town: &Town, cuts: usize) -> Shown {
    let views = views(town);
    let levels = town.nodes.iter().map(|n| n.level).max().unwrap_or(0);
    let uniform: Vec<_> = (0..=levels).map(|level| joined(town, &uniform_cut(town, level), false)).collect();
    let reference = |view: &View| -> (Vec<bool>, Vec<Vec<bool>>) {
        let of_level = |all: &(Vec<DVec3>, Vec<[u32; 3]>, usize)| covered(&Seen::of(view, &all.0, &all.1));
        (covered(&Seen::of(view, &town.positions, &town.faces)), uniform.iter().map(of_level).collect())
    };
    let references: Vec<_> = views.par_iter().map(reference).collect();
    let all = pairs(town);
    let mut dice = Dice(7);
    let mut shown = Shown::default();
    for i in 0..cuts {
        let cut = random_cut(town, &mut dice);
        let mut levels: Vec<usize> = cut.iter().map(|&n| town.nodes[n].level as usize).collect();
        levels.sort_unstable();
        levels.dedup();
        shown.mixed += usize::from(levels.len() > 1);
        let (view, (full, of_level)) = (&views[i % views.len()], &references[i % views.len()]);
        let is_wanted = |px: &usize| full[*px] && levels.iter().all(|&l| of_level[l][*px]);
        let background = |with_skirts| -> Vec<usize> {
            let (positions, faces, _) = joined(town, &cut, with_skirts);
            let seen = Seen::of(view, &positions, &faces);
            (0..full.len()).filter(is_wanted).filter(|px| seen.depth_m(*px).is_none()).collect()
        };
        let (with, without) = (background(true), background(false));
        if !with.is_empty() {
            let walls = Walls::of(town, &cut, &all);
            let open = with.iter().filter(|px| walls.are_open_at(view, **px)).count();
            println!(
                "cut {i} of {} tiles: {open} of {} pixels, {} without skirts",
                cut.len(),
                with.len(),
                without.len()
            );
            shown.open_px += open as u64;
            shown.past_px += (with.len() - open) as u64;
        }
        shown.bare_px += without.len() as u64;
    }
    println!("{cuts} cuts: {shown:?}");
    shown
}

#[test]
fn two_hundred_random_cuts_show_no_background_where_the_city_is() {
    let shown = show(town(), 200);
    assert!(shown.mixed > 120, "{shown:?}");
    assert!(shown.bare_px > 100, "the test sees nothing: {shown:?}");
    assert_eq!(shown.open_px, 0, "{shown:?}");
    // Where a wall cuts what stands against the sky the outline is one level's on one side and another's on the other.
    assert!(200 * shown.past_px <= shown.bare_px, "{shown:?}");
}

#[test]
fn random_cuts_of_a_real_scan_show_no_background_either() {
    let Some(input) = data("suncrest-house") else { return };
    let temp = tempfile::tempdir().expect("a folder");
    let folder = temp.path().join("tiles");
    let sets =
        ["--set", "levels.leaf_faces=8000", "--set", "levels.tile_faces=6000", "--set", "levels.root_faces=3000"];
    let run = build(&input, &folder, &sets).wants(0);
    let town = Town::of_leaves(&folder, run);
    let gaps = require_stated_gaps(&town);
    // Where the surface itself ends near a wall, what lies between two borders is a guess.
    assert!(100 * gaps.open <= gaps.between, "{gaps:?}");
    let shown = show(&town, 200);
    assert!(shown.mixed > 100, "{shown:?}");
    assert!(shown.bare_px > 200, "the test sees nothing: {shown:?}");
    // Five of them, of one twig that ends at a wall.
    assert!(1000 * shown.open_px <= shown.bare_px, "{shown:?}");
    // Leaves of trees against the sky.
    assert!(20 * shown.past_px <= shown.bare_px, "{shown:?}");
}

#[test]
fn from_above_no_skirt_is_seen() {
    let town = town();
    let mut dice = Dice(11);
    for _ in 0..10 {
        let cut = random_cut(town, &mut dice);
        let (positions, faces, surface) = joined(town, &cut, true);
        assert!(faces.len() > surface, "no skirts at all");
        let seen = Seen::of(&View::above(&positions, [1200, 1200]), &positions, &faces);
        let skirts = seen.faces().iter().filter(|&&f| f as usize >= surface && (f as usize) < faces.len()).count();
        assert_eq!(skirts, 0, "pixels of skirts from straight above");
    }
}

#[test]
fn skirts_hang_from_edges_of_their_class_inside_the_box() {
    let town = town();
    let mut skirts = 0;
    for node in &town.nodes {
        let tile = &node.tile;
        assert_eq!(node.number("skirtTriangles"), Some(tile.skirts.len() as f64), "{}", node.uri);
        assert_eq!(node.number("triangles"), Some(tile.faces.len() as f64), "{}", node.uri);
        let of_class: Vec<(u32, [DVec3; 3])> =
            (0..tile.faces.len()).map(|f| (tile.feature_ids[tile.faces[f][0] as usize], tile.corners(f))).collect();
        let deep_m = node.number("skirtDepth").expect("a number") * 3.0 + 1e-3;
        for face in tile.skirts.iter().step_by(17) {
            skirts += 1;
            let corners = face.map(|v| tile.positions[v as usize]);
            let class = tile.feature_ids[face[0] as usize] - 4;
            let own = of_class.iter().filter(|(c, _)| *c == class);
            let near = own.map(|(_, t)| {
                corners.iter().map(|p| (closest_on_triangle(*p, t) - *p).length()).fold(f64::INFINITY, f64::min)
            });
            assert!(near.fold(f64::INFINITY, f64::min) < 1e-6, "a skirt of {} hangs from nothing", node.uri);
            let upright = (0..2).any(|k| corners.iter().all(|p| (p[k] - corners[0][k]).abs() < ROUNDING_M));
            assert!(upright, "a skirt of {} leaves its wall: {corners:?}", node.uri);
            assert!((corners[1] - corners[0]).length() > 0.0 && deep_m > 0.0);
        }
    }
    assert!(skirts > 50, "{skirts}");
}
