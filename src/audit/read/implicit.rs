//! Implicit tiling: makes the tiles that subtrees say to be there.

use super::json::{BoundingVolume, Content as WireContent, Implicit};
use super::refusal::{Refusal, refuse};
use super::store::Address;
use super::subtree::Subtree;
use super::tree::Walker;

/// Levels of one subtree may hold this many tiles, there or not: 12 levels of a quadtree.
const MAX_SUBTREE_NODES: u64 = 1 << 24;

/// Bits looked at over all subtrees of a tileset: seconds.
const MAX_WORK: u64 = 1 << 28;

/// Coordinates are kept in 32 bits.
const MAX_LEVELS: u64 = 32;

/// An implicit root, checked.
struct Scheme {
    /// 2 for quadtrees, 3 for octrees.
    axes: u32,
    subtree_levels: u32,
    levels: u32,
    subtrees: String,
    contents: Vec<WireContent>,
    volume: BoundingVolume,
    geometric_error_m: f64,
}

/// A place in the implicit tree.
#[derive(Clone, Copy)]
struct Place {
    level: u32,
    at: [u32; 3],
}

impl Place {
    /// The descendant `depth` levels below with the Morton index `morton`.
    fn below(self, depth: u32, morton: u64, axes: u32) -> Option<Self> {
        let mut at = [0u32; 3];
        for (axis, coordinate) in at.iter_mut().enumerate().take(axes as usize) {
            let bits = (0..depth).fold(0u32, |bits, i| bits | ((morton >> (i * axes + axis as u32) & 1) as u32) << i);
            *coordinate = (u64::from(self.at[axis]) << depth).checked_add(bits.into())?.try_into().ok()?;
        }
        Some(Self { level: self.level + depth, at })
    }

    fn fill(self, template: &str) -> String {
        let [x, y, z] = self.at;
        let mut text = template.to_string();
        for (name, value) in [("{level}", self.level), ("{x}", x), ("{y}", y), ("{z}", z)] {
            text = text.replace(name, &value.to_string());
        }
        text
    }
}

/// Adds the tiles below the implicit root `root`, which is in the list already, and its contents.
pub fn expand(
    walker: &mut Walker<'_>,
    root: usize,
    wire: &Implicit,
    contents: Vec<WireContent>,
    volume: Option<&BoundingVolume>,
) -> Result<(), Refusal> {
    let geometric_error_m = walker.tiles[root].geometric_error_m;
    let scheme = Scheme::of(wire, contents, volume, geometric_error_m)?;
    let base = walker.address_of(root).clone();
    let mut open = vec![(Place { level: 0, at: [0; 3] }, root, true)];
    while let Some((place, tile, is_root)) = open.pop() {
        let read = walker.stores.resolve(&base, &place.fill(&scheme.subtrees)).and_then(|at| scheme.read(walker, &at));
        let subtree = match read {
            Ok(subtree) => subtree,
            Err(refusal) => {
                walker.warn("subtree-not-read", tile, &refusal);
                continue;
            }
        };
        if subtree.has_metadata {
            let what = "tiles of a subtree have metadata, which are not read; errors and volumes are the implicit ones";
            walker.warn("implicit-metadata-ignored", tile, &Refusal::new("implicit", what));
        }
        let mut next = scheme.fill(walker, &base, &subtree, place, (tile, is_root));
        next.reverse();
        open.extend(next.into_iter().map(|(place, parent)| (place, parent, false)));
        if walker.is_full() {
            break;
        }
    }
    Ok(())
}

impl Scheme {
    fn of(
        wire: &Implicit,
        contents: Vec<WireContent>,
        volume: Option<&BoundingVolume>,
        geometric_error_m: f64,
    ) -> Result<Self, Refusal> {
        let bad = |what: String| Refusal::new("bad-implicit", what);
        let axes = match wire.subdivision_scheme.as_deref() {
            Some("QUADTREE") => 2,
            Some("OCTREE") => 3,
            other => return refuse("bad-implicit", format!("the subdivision scheme {other:?} does not exist")),
        };
        let subtree_levels = wire.subtree_levels.filter(|&levels| levels > 0 && levels * u64::from(axes) < 63);
        let subtree_levels = subtree_levels
            .filter(|&levels| nodes(levels as u32, axes) <= MAX_SUBTREE_NODES)
            .ok_or_else(|| bad(format!("subtreeLevels is {:?}", wire.subtree_levels)))?;
        let levels = wire.available_levels.or(wire.maximum_level.map(|level| level.saturating_add(1)));
        let levels = levels.ok_or_else(|| bad("availableLevels is missing".into()))?.min(MAX_LEVELS);
        let subtrees = wire.subtrees.as_ref().and_then(|s| s.uri.clone().or(s.url.clone()));
        let subtrees = subtrees.ok_or_else(|| bad("subtrees.uri is missing".into()))?;
        let volume = volume.filter(|v| v.oriented_box.is_some() || v.region.is_some()).cloned();
        let volume = volume.ok_or_else(|| bad("an implicit root needs a box or a region".into()))?;
        let (subtree_levels, levels) = (subtree_levels as u32, levels as u32);
        Ok(Self { axes, subtree_levels, levels, subtrees, contents, volume, geometric_error_m })
    }

    fn read(&self, walker: &mut Walker<'_>, at: &Address) -> Result<Subtree, Refusal> {
        let leaves = 1u64 << (self.axes * self.subtree_levels);
        let nodes = nodes(self.subtree_levels, self.axes);
        walker.work = walker.work.saturating_add(nodes + leaves);
        if walker.work > MAX_WORK {
            return refuse("too-large", format!("the subtrees have more than {MAX_WORK} places for tiles"));
        }
        let subtree = Subtree::read(walker.stores, at, nodes, leaves)?;
        walker.charge(subtree.bytes)?;
        Ok(subtree)
    }

    /// Adds the tiles of `subtree` at `place` below tile `above.0` (which is its root if `above.1`); returns its child
    /// subtrees with the tiles they hang from.
    fn fill(
        &self,
        walker: &mut Walker<'_>,
        base: &Address,
        subtree: &Subtree,
        place: Place,
        (above, is_root): (usize, bool),
    ) -> Vec<(Place, usize)> {
        let mut parents: Vec<Option<usize>> = vec![Some(above)];
        let mut first = 0;
        for depth in 0..self.subtree_levels.min(self.levels.saturating_sub(place.level)) {
            let count = 1u64 << (self.axes * depth);
            let mut row = vec![None; count as usize];
            for morton in 0..count {
                let Some(at) = place.below(depth, morton, self.axes) else { continue };
                if !subtree.tiles.at(first + morton) || walker.is_full() {
                    continue;
                }
                let parent = if depth == 0 { Some(above) } else { parents[(morton >> self.axes) as usize] };
                let Some(parent) = parent else {
                    let what = format!("{} is there and its parent is not", at.fill("{level}/{x}/{y}/{z}"));
                    walker.warn("implicit-orphan", above, &Refusal::new("implicit-orphan", what));
                    continue;
                };
                let tile = if depth == 0 && is_root { above } else { self.add(walker, parent, at) };
                let there = |c: &usize| subtree.contents.get(*c).is_some_and(|bits| bits.at(first + morton));
                for content in (0..self.contents.len()).filter(there) {
                    let uri = self.contents[content].uri.as_ref().or(self.contents[content].url.as_ref());
                    let Some(uri) = uri else { continue };
                    walker.add_content(tile, base, at.fill(uri), None);
                }
                row[morton as usize] = Some(tile);
            }
            parents = row;
            first += count;
        }
        if place.level + self.subtree_levels >= self.levels {
            return Vec::new();
        }
        let leaves = 0..1u64 << (self.axes * self.subtree_levels);
        let found = leaves.filter(|&morton| subtree.children.at(morton)).filter_map(|morton| {
            let parent = *parents.get((morton >> self.axes) as usize)?;
            Some((place.below(self.subtree_levels, morton, self.axes)?, parent?))
        });
        found.collect()
    }

    fn add(&self, walker: &mut Walker<'_>, parent: usize, at: Place) -> usize {
        let geometric_error_m = self.geometric_error_m / 2f64.powi(at.level as i32);
        walker.add_implicit(parent, &self.volume_at(at), geometric_error_m, [at.level, at.at[0], at.at[1], at.at[2]])
    }

    /// The part of the root's volume that belongs to `place`.
    fn volume_at(&self, place: Place) -> BoundingVolume {
        let parts = 2f64.powi(place.level as i32);
        let mut volume = self.volume.clone();
        let splits = self.axes as usize;
        if let Some(b) = volume.oriented_box.as_mut().filter(|b| b.len() == 12) {
            for axis in 0..splits {
                let middle = (2.0 * f64::from(place.at[axis]) + 1.0) / parts - 1.0;
                for k in 0..3 {
                    b[k] += self.volume.oriented_box.as_ref().map_or(0.0, |b| b[3 + 3 * axis + k]) * middle;
                    b[3 + 3 * axis + k] /= parts;
                }
            }
        } else if let Some(r) = volume.region.as_mut().filter(|r| r.len() == 6) {
            if r[2] < r[0] {
                r[2] += std::f64::consts::TAU;
            }
            for (axis, (low, high)) in [(0, 2), (1, 3), (4, 5)].into_iter().enumerate().take(splits) {
                let (from, size) = (r[low], (r[high] - r[low]) / parts);
                r[low] = from + size * f64::from(place.at[axis]);
                r[high] = from + size * f64::from(place.at[axis] + 1);
            }
        }
        volume
    }
}

/// Tiles of a full subtree.
fn nodes(levels: u32, axes: u32) -> u64 {
    (0..levels).map(|level| 1u64 << (axes * level)).sum()
}
