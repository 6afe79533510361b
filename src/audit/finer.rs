//! What a tile is measured against, in parts that fit into memory one at a time.
//!
//! In: the finest tiles below a tile, or the original in its box. Out: [`Finer`], whose parts are loaded one by one, each
//! alone or with all that touches a box about it.

use std::cell::Cell;

use super::cover::{ClassNames, Loader, Shown};
use super::source::Original;
use crate::geo::Aabb;
use crate::geo::bvh::Bvh;
use crate::measure::{Surface, Whole};

/// Faces of a part: some 100 MB with trees and figures. A tile with more is a part of its own.
pub const PART_FACES: usize = 250_000;
/// Halvings of the original's box at most.
const MOST_HALVINGS: u32 = 20;

/// What is kept of every tile that was loaded.
#[derive(Debug, Clone, Copy)]
pub struct Known {
    /// Around its faces.
    pub aabb: Aabb,
    /// Of its faces, m².
    pub area_m2: f64,
    /// How many.
    pub faces: usize,
    /// It names classes.
    pub is_classed: bool,
    /// Some of it could not be read.
    pub is_refused: bool,
}

impl Known {
    /// Of a tile never loaded.
    pub const NOTHING: Self = Self { aabb: Aabb::EMPTY, area_m2: 0.0, faces: 0, is_classed: false, is_refused: false };

    /// Of what a tile shows.
    pub fn of(shown: &Shown) -> Self {
        let area = |f: &[u32; 3]| {
            let [a, b, c] = f.map(|v| shown.surface.positions[v as usize]);
            (b - a).cross(c - a).length() / 2.0
        };
        Self {
            aabb: shown.aabb,
            area_m2: shown.surface.faces.iter().map(area).sum(),
            faces: shown.surface.faces.len(),
            is_classed: shown.surface.class.is_some(),
            is_refused: shown.refused.is_some(),
        }
    }

    fn and(self, other: &Self) -> Self {
        Self {
            aabb: self.aabb.union(other.aabb),
            area_m2: self.area_m2 + other.area_m2,
            faces: self.faces + other.faces,
            is_classed: self.is_classed || other.is_classed,
            is_refused: self.is_refused || other.is_refused,
        }
    }
}

/// A reference in parts.
pub struct Finer<'a> {
    parts: Vec<Part>,
    of: Of<'a>,
    all: Known,
    /// Faces that may be loaded at once.
    most_faces: usize,
    /// A part with all about it had more: what was measured is no good.
    is_too_large: Cell<bool>,
}

struct Part {
    tiles: Vec<usize>,
    /// Of the original, where it is cut.
    within: Aabb,
    known: Known,
}

enum Of<'a> {
    Tiles(&'a [Known]),
    Original(&'a Original),
}

impl<'a> Finer<'a> {
    /// The tiles `tiles`, halved until neighbours are together: parts that reach into one another are measured with what
    /// is about them, which costs time and memory.
    pub fn tiles(tiles: &[usize], known: &'a [Known], part_faces: usize) -> Self {
        let sum = |tiles: &[usize]| tiles.iter().fold(Known::NOTHING, |all, &tile| all.and(&known[tile]));
        let mut parts: Vec<Part> = Vec::new();
        let with_faces = tiles.iter().copied().filter(|&tile| known[tile].faces > 0).collect();
        let mut open: Vec<Vec<usize>> = vec![with_faces];
        while let Some(mut tiles) = open.pop() {
            let own = sum(&tiles);
            if own.faces <= part_faces || tiles.len() < 2 {
                tiles.sort_unstable();
                parts.push(Part { tiles, within: own.aabb, known: own });
                continue;
            }
            let middles = Aabb::of(tiles.iter().map(|&tile| known[tile].aabb.center()));
            let size = middles.size();
            let axis = (1..3).fold(0, |best, axis| if size[axis] > size[best] { axis } else { best });
            let at = |tile: &usize| known[*tile].aabb.center()[axis];
            tiles.sort_by(|a, b| at(a).total_cmp(&at(b)).then(a.cmp(b)));
            let mut before = 0;
            let is_before = |tile: &&usize| {
                before += known[**tile].faces;
                before <= own.faces / 2
            };
            let half = tiles.iter().take_while(is_before).count().clamp(1, tiles.len() - 1);
            let rest = tiles.split_off(half);
            open.extend([rest, tiles]);
        }
        let all = sum(tiles);
        Self { parts, of: Of::Tiles(known), all, most_faces: usize::MAX, is_too_large: Cell::new(false) }
    }

    /// The original in `aabb`.
    pub fn original(original: &'a Original, aabb: Aabb, part_faces: usize) -> Self {
        let mut parts = Vec::new();
        let mut open = vec![(aabb, 0)];
        while let Some((aabb, halvings)) = open.pop() {
            let faces = original.count(aabb);
            let size = aabb.size();
            if faces <= part_faces || halvings >= MOST_HALVINGS || !size.is_finite() {
                let known = Known::of(&original.part(aabb));
                parts.push(Part { tiles: Vec::new(), within: aabb, known });
                continue;
            }
            let axis = usize::from(size.y > size.x);
            let (mut one, mut other) = (aabb, aabb);
            one.max[axis] = aabb.center()[axis];
            other.min[axis] = one.max[axis];
            open.extend([(other, halvings + 1), (one, halvings + 1)]);
        }
        let all = parts.iter().fold(Known::NOTHING, |all, part| all.and(&part.known));
        let of = Of::Original(original);
        Self { parts, of, all, most_faces: usize::MAX, is_too_large: Cell::new(false) }
    }

    /// No more than `most_faces` may be loaded at once.
    pub fn within(self, most_faces: usize) -> Self {
        Self { most_faces, ..self }
    }

    /// Faces of the largest part.
    pub fn largest(&self) -> usize {
        self.parts.iter().map(|part| part.known.faces).max().unwrap_or(0)
    }

    /// True if a part with all about it had more faces than may be loaded.
    pub fn is_too_large(&self) -> bool {
        self.is_too_large.get()
    }

    /// Number of parts.
    pub fn parts(&self) -> usize {
        self.parts.len()
    }

    /// All parts together.
    pub fn all(&self) -> &Known {
        &self.all
    }

    /// The boxes of the parts.
    pub fn boxes(&self) -> Vec<Aabb> {
        self.parts.iter().map(|part| part.known.aabb).collect()
    }

    /// What has to be known before the parts are measured.
    pub fn whole(&self) -> Whole {
        Whole { aabb: self.all.aabb, area_m2: self.all.area_m2 }
    }

    /// Loads part `part`; classes are guessed if no tile has any and there are no more than `most_classified` faces.
    /// Says whether they are.
    pub fn load(&self, loader: &mut Loader, part: usize, most_classified: usize) -> (Shown, bool) {
        let mut shown = match self.of {
            Of::Tiles(_) => loader.union(&self.parts[part].tiles),
            Of::Original(original) => original.part(self.parts[part].within),
        };
        if self.all.is_classed {
            name_all(&mut shown.surface);
            return (shown, false);
        }
        let is_guessed = self.all.faces <= most_classified && loader.classify(&mut shown, most_classified);
        if !is_guessed && self.all.faces <= most_classified {
            name_all(&mut shown.surface);
        }
        (shown, is_guessed)
    }

    /// Part `part`, which is loaded, with all of the reference that touches `within`; nothing if that is the part alone.
    pub fn around(&self, loader: &mut Loader, part: usize, own: &Surface, within: Aabb) -> Option<Surface> {
        let mut strip = Shown { aabb: Aabb::EMPTY, ..Shown::default() };
        match self.of {
            Of::Original(_) if self.parts.len() < 2 => return None,
            Of::Original(original) if own.faces.len() + original.count(within) > self.most_faces => {
                self.is_too_large.set(true);
            }
            Of::Original(original) => {
                // The part is in it too: what stands twice is no further away.
                strip = original.part(within);
            }
            Of::Tiles(known) => {
                let others = self.parts.iter().enumerate().filter(|(i, _)| *i != part).flat_map(|(_, p)| &p.tiles);
                for &tile in others.filter(|&&tile| touches(&known[tile].aabb, &within)) {
                    if own.faces.len() + strip.surface.faces.len() > self.most_faces {
                        self.is_too_large.set(true);
                        break;
                    }
                    strip.add(&touching(&loader.load(tile), &within), ClassNames::UNKNOWN);
                }
            }
        }
        if strip.surface.faces.is_empty() || self.is_too_large.get() {
            return None;
        }
        if self.all.is_classed {
            name_all(&mut strip.surface);
        } else if let (Some(class), None) = (&own.class, &strip.surface.class) {
            // A guess next door: that of the nearest face here.
            let bvh = Bvh::new(&own.positions, &own.faces);
            let nearest = strip.surface.faces.iter().map(|face| {
                let [a, b, c] = face.map(|v| strip.surface.positions[v as usize]);
                let hit = bvh.closest((a + b + c) / 3.0, f64::INFINITY);
                hit.map_or(ClassNames::UNKNOWN, |hit| class[hit.face as usize])
            });
            strip.surface.class = Some(nearest.collect());
        }
        let mut all = Shown { surface: own.clone(), aabb: Aabb::EMPTY, refused: None };
        all.add(&strip, ClassNames::UNKNOWN);
        Some(all.surface)
    }
}

/// Faces of tiles without classes count as unknown where others have some.
fn name_all(surface: &mut Surface) {
    let faces = surface.faces.len();
    surface.class.get_or_insert_with(|| vec![ClassNames::UNKNOWN; faces]);
}

fn touches(a: &Aabb, b: &Aabb) -> bool {
    a.min.cmple(b.max).all() && a.max.cmpge(b.min).all()
}

/// The faces whose boxes touch `within`.
fn touching(shown: &Shown, within: &Aabb) -> Shown {
    let surface = &shown.surface;
    let is_near = |f: &usize| {
        let corners = surface.faces[*f].map(|v| surface.positions[v as usize]);
        touches(&Aabb::of(corners), within)
    };
    let kept: Vec<usize> = (0..surface.faces.len()).filter(is_near).collect();
    let mut found = Shown { aabb: Aabb::EMPTY, ..Shown::default() };
    for &f in &kept {
        let base = found.surface.positions.len() as u32;
        found.surface.positions.extend(surface.faces[f].map(|v| surface.positions[v as usize]));
        found.surface.faces.push([base, base + 1, base + 2]);
    }
    found.surface.class = surface.class.as_ref().map(|class| kept.iter().map(|&f| class[f]).collect());
    found
}
