//! What stands for what: tiles as surfaces, and the finest tiles that a tile is a stand-in for.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;

use glam::DVec3;

use super::budget::Budget;
use super::read::{FaceClasses, Refine, TileMesh, Tileset};
use crate::classes::{self, ClassesConfig};
use crate::geo::Aabb;
use crate::geo::bvh::Bvh;
use crate::ids::{ClassId, ClassScheme};
use crate::input::{Part, Source};
use crate::measure::Surface;
use crate::mesh::{GateConfig, gate};
use crate::planes::{self, PlanesConfig};
use crate::report::Reporter;

/// All that a tile shows, joined.
#[derive(Debug, Clone, Default)]
pub struct Shown {
    /// Its triangles in the tileset's local frame; classes if the file names any.
    pub surface: Surface,
    /// Around its faces.
    pub aabb: Aabb,
    /// Why some of it could not be read: a code.
    pub refused: Option<&'static str>,
}

impl Shown {
    /// Adds another's triangles. Faces without a class become `unknown` where others have one.
    pub fn add(&mut self, other: &Self, unknown: ClassId) {
        let base = self.surface.positions.len() as u32;
        let before = self.surface.faces.len();
        self.surface.positions.extend(&other.surface.positions);
        self.surface.faces.extend(other.surface.faces.iter().map(|f| f.map(|v| v + base)));
        if self.surface.class.is_some() || other.surface.class.is_some() {
            let class = self.surface.class.get_or_insert_with(|| vec![unknown; before]);
            match &other.surface.class {
                Some(of_other) => class.extend(of_other),
                None => class.resize(self.surface.faces.len(), unknown),
            }
        }
        self.aabb = self.aabb.union(other.aabb);
        self.refused = self.refused.or(other.refused);
    }
}

/// The names of classes met, in the order of ids; the last place is kept for what has none.
#[derive(Debug, Clone, Default)]
pub struct ClassNames(Vec<String>);

impl ClassNames {
    /// What faces without a class, and classes beyond the most that are told apart, count as.
    pub const UNKNOWN: ClassId = ClassId(Surface::MOST_CLASSES as u8 - 1);

    /// The id of `name`; a new one if it is met for the first time.
    pub fn id(&mut self, name: &str) -> ClassId {
        if let Some(known) = self.0.iter().position(|n| n == name) {
            return ClassId(known as u8);
        }
        if self.0.len() + 1 >= Surface::MOST_CLASSES {
            return Self::UNKNOWN;
        }
        self.0.push(name.into());
        ClassId(self.0.len() as u8 - 1)
    }

    /// The names by id.
    pub fn all(&self) -> Vec<String> {
        self.0.clone()
    }

    /// What `id` is called.
    pub fn name(&self, id: ClassId) -> &str {
        self.0.get(id.index()).map_or("unclassified", String::as_str)
    }

    /// The name of `property`, such as `roofBound`, without its `suffix`, if it is a class.
    pub fn of_property(&self, property: &str, suffix: &str) -> Option<ClassId> {
        let prefix = property.strip_suffix(suffix)?;
        self.0.iter().position(|name| name == prefix).map(|i| ClassId(i as u8))
    }
}

/// Loads tiles, and keeps the last few: a tile and those above it are asked for the same ones.
pub struct Loader<'a> {
    /// Whose tiles.
    pub tileset: &'a Tileset,
    /// Classes met so far.
    pub names: ClassNames,
    kept: VecDeque<(usize, Arc<Shown>)>,
    kept_faces: usize,
    /// What may be loaded.
    pub budget: Budget,
}

impl<'a> Loader<'a> {
    /// Has nothing loaded yet; will keep as much as the budget says.
    pub fn new(tileset: &'a Tileset, budget: Budget) -> Self {
        Self { tileset, names: ClassNames::default(), kept: VecDeque::new(), kept_faces: 0, budget }
    }

    /// What tile `tile` shows. What cannot be read is left out, and marked.
    pub fn load(&mut self, tile: usize) -> Arc<Shown> {
        if let Some(at) = self.kept.iter().position(|(id, _)| *id == tile) {
            let found = self.kept.remove(at).map(|(_, shown)| shown).unwrap_or_default();
            self.kept.push_back((tile, Arc::clone(&found)));
            return found;
        }
        // Oddities were reported when the structure was looked at.
        let quiet = Reporter::new(true);
        let mut shown = Shown { aabb: Aabb::EMPTY, ..Shown::default() };
        for content in 0..self.tileset.tiles.get(tile).map_or(0, |t| t.contents.len()) {
            match self.tileset.load_content(tile, content, &quiet) {
                Ok(meshes) => {
                    for mesh in &meshes {
                        let one = self.shown(mesh);
                        shown.add(&one, ClassNames::UNKNOWN);
                    }
                }
                Err(refusal) => shown.refused = shown.refused.or(Some(refusal.code)),
            }
        }
        let shown = Arc::new(shown);
        self.kept_faces += shown.surface.faces.len();
        self.kept.push_back((tile, Arc::clone(&shown)));
        while self.kept_faces > self.budget.kept_faces() && self.kept.len() > 1 {
            if let Some((_, old)) = self.kept.pop_front() {
                self.kept_faces -= old.surface.faces.len();
            }
        }
        shown
    }

    fn shown(&mut self, mesh: &TileMesh) -> Shown {
        let class = mesh.classes.as_ref().map(|classes| self.class(classes));
        let surface = Surface { positions: mesh.positions.clone(), faces: mesh.faces.clone(), class };
        Shown { aabb: around(&surface), surface, refused: None }
    }

    fn class(&mut self, classes: &FaceClasses) -> Vec<ClassId> {
        let ids: Vec<ClassId> = classes.names.iter().map(|name| self.names.id(name)).collect();
        let id = |&c: &u16| ids.get(usize::from(c)).copied().unwrap_or(ClassNames::UNKNOWN);
        classes.of_face.iter().map(id).collect()
    }

    /// Tiles `tiles` as one surface.
    pub fn union(&mut self, tiles: &[usize]) -> Shown {
        let mut all = Shown { aabb: Aabb::EMPTY, ..Shown::default() };
        for &tile in tiles {
            all.add(&self.load(tile), ClassNames::UNKNOWN);
        }
        all
    }

    /// Gives `shown` classes by our own classifier if it has none and is not too large; says whether it did.
    pub fn classify(&mut self, shown: &mut Shown, most_faces: usize) -> bool {
        if shown.surface.class.is_some() || shown.surface.faces.is_empty() || shown.surface.faces.len() > most_faces {
            return false;
        }
        let part = Part {
            positions: shown.surface.positions.clone(),
            faces: shown.surface.faces.clone(),
            face_material: vec![0; shown.surface.faces.len()],
            ..Part::default()
        };
        let grey = crate::input::Material { name: String::new(), base_color: crate::input::DEFAULT_COLOR, image: None };
        let source = Source { parts: vec![part], materials: vec![grey], ..Source::default() };
        let Ok((mesh, _)) = gate(source, &GateConfig::default(), &Reporter::new(true)) else { return false };
        let scheme = ClassScheme::default();
        let found =
            classes::label(&mesh, &planes::grow(&mesh, &PlanesConfig::default()), &scheme, &ClassesConfig::default());
        let ids: Vec<ClassId> = scheme.0.iter().map(|class| self.names.id(&class.name)).collect();
        // The gate leaves out and reorders faces: a face is what its middle lies on.
        let bvh = Bvh::new(&mesh.positions, &mesh.faces);
        let class = shown.surface.faces.iter().map(|face| {
            let [a, b, c] = face.map(|v| shown.surface.positions[v as usize]);
            let hit = bvh.closest((a + b + c) / 3.0, f64::INFINITY);
            hit.map_or(ClassNames::UNKNOWN, |hit| ids[found.label[hit.face as usize].index()])
        });
        shown.surface.class = Some(class.collect());
        true
    }
}

fn around(surface: &Surface) -> Aabb {
    Aabb::of(surface.faces.iter().flatten().filter_map(|&v| surface.positions.get(v as usize)).copied())
}

/// Tiles with something to show below each tile, and which of them are the finest.
pub struct Cover {
    /// For each tile: something below it has a mesh.
    has_finer: Vec<bool>,
}

impl Cover {
    /// Looks at the whole tree.
    pub fn of(tileset: &Tileset) -> Self {
        let mut has_finer = vec![false; tileset.tiles.len()];
        // Parents come first.
        for id in (0..tileset.tiles.len()).rev() {
            if let Some(parent) = tileset.tiles[id].parent
                && (has_finer[id] || tileset.tiles[id].has_mesh())
            {
                has_finer[parent] = true;
            }
        }
        Self { has_finer }
    }

    /// True if something below `tile` has a mesh.
    pub fn has_finer(&self, tile: usize) -> bool {
        self.has_finer.get(tile).copied().unwrap_or(false)
    }

    /// What is drawn of `tile` and all below once everything is refined.
    pub fn finest(&self, tileset: &Tileset, tile: usize) -> Vec<usize> {
        self.below(tileset, tile, &|id| self.has_finer(id))
    }

    /// What is drawn instead of `tile` one step finer: the nearest tiles with a mesh below it, and itself if they are
    /// added to it.
    pub fn next(&self, tileset: &Tileset, tile: usize) -> Vec<usize> {
        self.below(tileset, tile, &|id| self.has_finer(id) && (id == tile || !tileset.tiles[id].has_mesh()))
    }

    fn below(&self, tileset: &Tileset, tile: usize, is_open: &dyn Fn(usize) -> bool) -> Vec<usize> {
        let mut found = Vec::new();
        let mut open = vec![tile];
        while let Some(id) = open.pop() {
            let of = &tileset.tiles[id];
            let refined = is_open(id);
            if of.has_mesh() && (!refined || of.refine == Refine::Add) {
                found.push(id);
            }
            if refined {
                open.extend(of.children.iter().rev());
            }
        }
        found
    }

    /// True if a tile below `tile`, or itself, is added to by its children.
    pub fn has_add(&self, tileset: &Tileset, tile: usize) -> bool {
        let mut open = vec![tile];
        while let Some(id) = open.pop() {
            let of = &tileset.tiles[id];
            if of.refine == Refine::Add && of.has_mesh() && self.has_finer(id) {
                return true;
            }
            open.extend(&of.children);
        }
        false
    }
}

/// A point of the local frame as a place on the globe, for people: `lat lon height`; else x y z.
pub fn place(tileset: &Tileset, local: DVec3) -> String {
    if tileset.frame.origin.is_none() {
        return format!("{:.2} {:.2} {:.2}", local.x, local.y, local.z);
    }
    let at = crate::geo::ellipsoid::geodetic_from_ecef(tileset.frame.root_from_local.transform_point3(local));
    format!("{:.7}, {:.7}, {:.2} m", at.lat_rad.to_degrees(), at.lon_rad.to_degrees(), at.height_m)
}

/// The path a warning about a tile is filed under.
pub fn path(tileset: &Tileset, tile: usize) -> std::path::PathBuf {
    Path::new(&tileset.trail(tile)).to_path_buf()
}
