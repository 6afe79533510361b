//! Says how far the borders of tiles of different levels are apart, and hangs skirts that close the gaps.
//!
//! In: the [`Border`] of every tile: its open edges on the walls of its cell. Out: a [`Hem`] for each: the distance to
//! the borders of all tiles that can stand beside it, and the skirts that hide it.
//!
//! # Method
//! 1. Walls are vertical planes and borders are polylines in them, so a gap is a region of the wall between two
//!    polylines. Tiles that can be neighbours in some cut of the tree are those on the two sides of one plane.
//! 2. Every point of a neighbour's polyline that lies inside this tile's solid (the inner side of its nearest edge)
//!    demands a skirt as deep as its distance from that edge. Segments are halved until the largest distance is certain
//!    ([`CERTAIN_M`], [`CERTAIN_SHARE`]).
//!    What sticks out of a neighbour, a fence that it lost, has no such point near its top: there the demand is the own
//!    point's distance, but no more than half of how thick the solid is: the circle that touches the border there from
//!    inside and crosses it nowhere.
//! 3. A skirt is a strip in the wall: from the edge along the wall into the solid, at right angles to the edge. Below
//!    ground it hangs down, behind a façade that crosses the wall it goes into the building, above the soffit of an eave
//!    it goes up. Corners are mitred, so that strips join.
//!
//! # Promises
//! - A point between the borders of two neighbours is inside one of them and outside the other, and lies in the skirt of
//!   the one it is inside of (`the_skirts_of_two_levels_close_the_gap_between_them`).
//! - [`Hem::wall_m`] is not below the distance of any two borders that can meet, either way.
//! - A skirt lies in the wall and inside the tile's own solid: from above it has no area.
//!
//! # Limits
//! Beside a façade a skirt may run on along the wall beyond its cell's corner, so a box can be a little wider than its
//! cell. A solid thinner than the gap beside it is pierced by its skirt. Where windings disagree the inner side is a guess.
//! Cells that meet at a corner only are not compared: their tiles share a line.

use std::collections::BTreeMap;

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use border::{Edge, SIDES, key};
use gap::{Side, Wall};

use crate::geo::hash::BitsMap;

mod border;
mod gap;
#[cfg(test)]
mod tests;

pub use border::Border;

/// Skirts are deeper than the gap by this share and this length, metres: edges that only touch let light through.
const MARGIN_SHARE: f64 = 0.05;
const MARGIN_M: f64 = 1e-3;
/// Borders nearer than this are the same, metres: the grid of the source.
const SAME_M: f64 = 1e-6;
/// A mitre is at most this many times as long as the skirt is deep.
const LONGEST_MITRE: f64 = 3.0;

/// Which skirts tiles get.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Skirts {
    /// As deep as the gaps they close.
    #[default]
    Auto,
    /// None.
    Off,
    /// All of one depth, metres.
    Metres(f64),
}

impl Skirts {
    /// Reads `auto`, `off` or metres; `None` for anything else.
    pub fn parse(text: &str) -> Option<Self> {
        match text.trim() {
            "auto" => Some(Self::Auto),
            "off" => Some(Self::Off),
            number => number.parse().ok().filter(|m| (0.0..=1000.0).contains(m)).map(Self::Metres),
        }
    }
}

impl Serialize for Skirts {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Auto => serializer.serialize_str("auto"),
            Self::Off => serializer.serialize_str("off"),
            Self::Metres(m) => serializer.serialize_f64(*m),
        }
    }
}

impl<'de> Deserialize<'de> for Skirts {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Number(f64),
            Word(String),
        }
        let read = match Written::deserialize(deserializer) {
            Ok(Written::Number(m)) => Self::parse(&m.to_string()),
            Ok(Written::Word(word)) => Self::parse(&word),
            Err(_) => None,
        };
        read.ok_or_else(|| serde::de::Error::custom("levels.skirts: wanted \"auto\", \"off\" or 0 to 1000 metres"))
    }
}

/// Where a tile's border is relative to its neighbours', and its skirts.
#[derive(Debug, Clone, Default)]
pub struct Hem {
    /// No point of the tile's border is further from the border of any tile that can stand beside it, nor the other way
    /// round, metres (certified). 0 where nothing can stand beside it.
    pub wall_m: f64,
    /// Depth of the deepest skirt, metres.
    pub skirt_m: f64,
    /// The skirts.
    pub strips: Vec<Strip>,
}

/// A skirt under one edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strip {
    /// Place of the face among the tile's.
    pub face: u32,
    /// The edge goes from this corner of the face to the next.
    pub corner: u8,
    /// The ends of the strip's lower edge, below that corner and the next, local metres.
    pub below: [DVec3; 2],
}

/// The hem of every tile. `borders` are those of all tiles of the tree.
pub fn hems(borders: &[Border], skirts: Skirts) -> Vec<Hem> {
    // Plane by plane: of all borders together the trees alone were half a gigabyte for 48 million triangles.
    let mut by_plane: BTreeMap<(usize, u64), Vec<(usize, usize)>> = BTreeMap::new();
    for (tile, border) in borders.iter().enumerate() {
        for side in (0..4).filter(|&s| border.count(s) > 0) {
            if let Some((place, _)) = border.wall(side) {
                by_plane.entry((SIDES[side].0, (place + 0.0).to_bits())).or_default().push((tile, side));
            }
        }
    }
    let planes: Vec<_> = by_plane.into_values().collect();
    let of_plane = |plane: &Vec<(usize, usize)>| -> Vec<Wall> {
        let sides: Vec<Side> = plane.iter().filter_map(|&(t, side)| Side::of(t, side, &borders[t])).collect();
        sides.par_iter().map(|own| own.demands(&sides)).collect()
    };
    let mut walls: Vec<Wall> = planes.par_iter().flat_map_iter(of_plane).collect();
    walls.sort_unstable_by_key(|wall| (wall.tile, wall.side));
    let mut hems = vec![Hem::default(); borders.len()];
    for wall in &walls {
        for &(other, distance_m) in &wall.pairs {
            for tile in [wall.tile, other] {
                hems[tile].wall_m = hems[tile].wall_m.max(distance_m);
            }
        }
    }
    for wall in walls.into_iter().filter(|_| skirts != Skirts::Off) {
        let demand_m = match skirts {
            Skirts::Metres(depth_m) => vec![depth_m; wall.demand_m.len()],
            _ => wall.demand_m,
        };
        if demand_m.iter().any(|d| *d > 0.0) {
            hang(&borders[wall.tile].edges(wall.side), &demand_m, &mut hems[wall.tile]);
        }
    }
    hems
}

/// Adds the strips of one wall: at each vertex as deep as the deeper of its edges asks.
fn hang(edges: &[Edge], demand_m: &[f64], hem: &mut Hem) {
    let mut depths: BitsMap<[u64; 3], f64> = BitsMap::default();
    for (edge, &demand_m) in edges.iter().zip(demand_m).filter(|(_, d)| **d > 0.0) {
        for end in edge.ends {
            let depth = depths.entry(key(end)).or_default();
            *depth = depth.max(demand_m * (1.0 + MARGIN_SHARE) + MARGIN_M);
        }
    }
    for edge in edges {
        let depth_m = edge.ends.map(|p| depths.get(&key(p)).copied().unwrap_or(0.0));
        if depth_m[0].max(depth_m[1]) <= 0.0 {
            continue;
        }
        hem.skirt_m = hem.skirt_m.max(depth_m[0]).max(depth_m[1]);
        let below = [0, 1].map(|k| edge.ends[k] + mitre(edge, k) * depth_m[k]);
        hem.strips.push(Strip { face: edge.face, corner: edge.corner, below });
    }
}

/// From the end of an edge to the strip's lower edge, for a strip of depth 1. The same for both edges of a vertex, so
/// that their strips join, and at least 1 deep under each of them where the corner is not too sharp.
fn mitre(edge: &Edge, end: usize) -> DVec3 {
    let Some(direction) = edge.inward_at_ends[end].try_normalize() else { return edge.inward };
    let reach = direction.dot(edge.inward);
    if reach <= 1.0 / LONGEST_MITRE { direction * LONGEST_MITRE } else { direction / reach }
}
