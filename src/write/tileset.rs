//! Writes tileset.json: boxes, errors, and per tile and class how wrong it is.
//!
//! In: the tree of [`TileEntry`]. Out: [`Tileset`], 3D Tiles 1.1, REPLACE, explicit, boxes in the local frame.
//!
//! # Promises
//! The schema stands in this file and nowhere else: CesiumJS reads tile metadata only where the root tileset.json
//! holds it. Property ids are identifiers whatever the classes are called. A number that is not known is left out.

use std::collections::BTreeMap;

use glam::{DMat4, DVec3};
use serde_json::{Value, json};

use super::GENERATOR;
use super::glb::surface_class;
use crate::geo::Aabb;
use crate::ids::{ClassId, ClassScheme};
use crate::schema::metadata::{Class, ClassStatistics, Entity, Property, Schema, Statistics};
use crate::schema::tileset::{Asset, BoundingVolume, Content, Tile, Tileset};

/// How wrong one class is in one tile, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClassError {
    /// Of which class.
    pub class: ClassId,
    /// Deviation allowed at the tile's scale.
    pub budget_m: f64,
    /// Certified two-sided bound.
    pub bound_m: f64,
    /// Area-weighted mean distance.
    pub mean_m: f64,
    /// Area-weighted root mean square.
    pub rms_m: f64,
    /// 95th percentile.
    pub p95_m: f64,
    /// 99th percentile.
    pub p99_m: f64,
    /// How far the tile sinks inside the true solid at most, along its normals; negative where it stays outside.
    pub inside_m: f64,
    /// How much lower than the source it is at most, within the bound sideways; negative where it stays above.
    pub sunk_m: f64,
}

/// One tile of the tree, already written.
#[derive(Debug, Clone, PartialEq)]
pub struct TileEntry {
    /// Relative to tileset.json, `/` between folders, characters that need no escaping.
    pub uri: String,
    /// Holds this tile's content and its children's boxes.
    pub box_local: Aabb,
    /// What is written as `geometricError`, metres: not above the parent's.
    pub geometric_error_m: f64,
    /// Error of the geometry alone, metres.
    pub geometry_m: f64,
    /// Size of a texel on the ground, metres; 0 without texture.
    pub texel_m: f64,
    /// Scale t: every class's bound is within t times its budget. Not above the parent's.
    pub scale: f64,
    /// Its border on the walls of its cell and those of tiles that can stand beside it are no further apart, metres.
    pub wall_m: f64,
    /// Depth of its deepest skirt, metres.
    pub skirt_m: f64,
    /// Triangles of the surface in the content.
    pub triangles: u64,
    /// Triangles of skirts in the content.
    pub skirt_triangles: u64,
    /// Bytes of the content.
    pub bytes: u64,
    /// The classes in this tile, each at most once.
    pub classes: Vec<ClassError>,
    /// 0 is the coarsest.
    pub level: u32,
    /// Finer tiles.
    pub children: Vec<TileEntry>,
}

/// What is said about the tileset as a whole.
#[derive(Debug, Clone, Copy)]
pub struct About<'a> {
    /// Places the local frame on the Earth; `None` for a dataset without coordinates.
    pub ecef_from_local: Option<DMat4>,
    /// The classes.
    pub scheme: &'a ClassScheme,
    /// Credit to show.
    pub copyright: Option<&'a str>,
    /// Errors written are at least this many texels.
    pub texel_factor: f64,
}

/// Half an axis of a box is at least this, metres: some viewers drop flat boxes.
const MIN_HALF_SIZE_M: f64 = 1e-3;

/// Describes the tree under `root`.
///
/// # Panics
/// If an error or a box is not finite: that is a bug in its maker.
pub fn tileset(root: &TileEntry, about: &About<'_>) -> Tileset {
    let prefixes = property_prefixes(about.scheme);
    let mut tile = tile(root, &prefixes);
    tile.refine = Some("REPLACE".into());
    tile.transform = about.ecef_from_local.map(|m| m.to_cols_array());
    let budgets: Vec<f64> = about.scheme.0.iter().map(|c| c.budget_m).collect();
    let names: Vec<&str> = about.scheme.0.iter().map(|c| c.name.as_str()).collect();
    let metadata = Entity {
        class: "tileset".into(),
        properties: BTreeMap::from([
            ("budgets".into(), json!(budgets)),
            ("classes".into(), json!(names)),
            ("texelFactor".into(), json!(about.texel_factor)),
        ]),
    };
    let asset = Asset {
        version: "1.1".into(),
        generator: Some(GENERATOR.into()),
        copyright: about.copyright.map(Into::into),
        ..Default::default()
    };
    let count = ClassStatistics { count: Some(count(root)) };
    Tileset {
        asset,
        properties: BTreeMap::new(),
        schema: Some(schema(about.scheme, &prefixes)),
        statistics: Some(Statistics { classes: BTreeMap::from([("tile".into(), count)]) }),
        metadata: Some(metadata),
        // Nothing drawn is wrong by no more than the size of the whole.
        geometric_error: root.geometric_error_m.max(root.box_local.min.distance(root.box_local.max)),
        root: tile,
        extensions_used: Vec::new(),
        extensions_required: Vec::new(),
        extras: None,
    }
}

/// The bytes of tileset.json.
pub fn bytes(tileset: &Tileset) -> Vec<u8> {
    serde_json::to_vec(tileset).expect("tileset structs can be written as JSON")
}

fn count(tile: &TileEntry) -> u64 {
    1 + tile.children.iter().map(count).sum::<u64>()
}

fn tile(entry: &TileEntry, prefixes: &[String]) -> Tile {
    let finite =
        entry.geometric_error_m.is_finite() && entry.box_local.min.is_finite() && entry.box_local.max.is_finite();
    assert!(finite, "tile {} has no finite error and box: {entry:?}", entry.uri);
    Tile {
        bounding_volume: BoundingVolume { oriented_box: Some(oriented_box(&entry.box_local)), ..Default::default() },
        geometric_error: entry.geometric_error_m,
        content: Some(Content { uri: entry.uri.clone(), ..Default::default() }),
        metadata: Some(Entity { class: "tile".into(), properties: tile_properties(entry, prefixes) }),
        children: entry.children.iter().map(|child| tile(child, prefixes)).collect(),
        ..Default::default()
    }
}

fn oriented_box(aabb: &Aabb) -> [f64; 12] {
    let centre = (aabb.min + aabb.max) * 0.5;
    // Rounding the centre may cut a corner by an ulp: measure from the centre as written.
    let half = (aabb.max - centre).max(centre - aabb.min).max(DVec3::splat(MIN_HALF_SIZE_M));
    [centre.x, centre.y, centre.z, half.x, 0.0, 0.0, 0.0, half.y, 0.0, 0.0, 0.0, half.z]
}

/// Suffix of a property id, what it means, and its value.
type Measure = (&'static str, &'static str, fn(&ClassError) -> f64);

const MEASURES: [Measure; 8] = [
    ("Budget", "deviation allowed at the tile's scale", |e| e.budget_m),
    ("Bound", "certified two-sided bound of the deviation", |e| e.bound_m),
    ("Mean", "area-weighted mean deviation", |e| e.mean_m),
    ("Rms", "area-weighted root mean square deviation", |e| e.rms_m),
    ("P95", "95th percentile of the deviation", |e| e.p95_m),
    ("P99", "99th percentile of the deviation", |e| e.p99_m),
    (
        "Inside",
        "certified bound of how far the tile sinks inside the source along its normals, negative where it stays outside",
        |e| e.inside_m,
    ),
    (
        "Sunk",
        "certified bound of how much lower than the source the tile is, within its bound sideways; negative where it stays \
         above",
        |e| e.sunk_m,
    ),
];

fn tile_properties(entry: &TileEntry, prefixes: &[String]) -> BTreeMap<String, Value> {
    let mut values = BTreeMap::from([
        ("geometryError".to_string(), json!(entry.geometry_m)),
        ("texelSize".into(), json!(entry.texel_m)),
        ("level".into(), json!(entry.level)),
        ("triangles".into(), json!(entry.triangles)),
        ("skirtTriangles".into(), json!(entry.skirt_triangles)),
        ("scale".into(), json!(entry.scale)),
        ("wallDeviation".into(), json!(entry.wall_m)),
        ("skirtDepth".into(), json!(entry.skirt_m)),
    ]);
    for error in &entry.classes {
        for (suffix, _, value) in MEASURES {
            let value = value(error);
            if value.is_finite() {
                values.insert(format!("{}{suffix}", prefixes[error.class.index()]), json!(value));
            }
        }
    }
    // JSON has no word for them.
    values.retain(|_, value| !value.is_null());
    values
}

fn schema(scheme: &ClassScheme, prefixes: &[String]) -> Schema {
    let scalar = |component: &str, description: String| Property {
        description: Some(description),
        kind: "SCALAR".into(),
        component_type: Some(component.into()),
        ..Default::default()
    };
    let of_wall = "Certified distance of its border to those of all tiles that can stand beside it, both ways, metres";
    let mut of_tile = BTreeMap::from([
        ("geometryError".to_string(), scalar("FLOAT64", "Error of the geometry alone, metres".into())),
        ("texelSize".into(), scalar("FLOAT64", "Size of a texel on the surface, metres".into())),
        ("level".into(), scalar("UINT32", "Level of detail, 0 is the coarsest".into())),
        ("triangles".into(), scalar("UINT32", "Number of triangles of the surface".into())),
        ("skirtTriangles".into(), scalar("UINT32", "Number of triangles of skirts, no part of the surface".into())),
        ("scale".into(), scalar("FLOAT64", "Every class is within this many times its budget".into())),
        ("wallDeviation".into(), scalar("FLOAT64", of_wall.into())),
        ("skirtDepth".into(), scalar("FLOAT64", "Depth of the deepest skirt, metres".into())),
    ]);
    for (id, prefix) in scheme.ids().zip(prefixes) {
        for (suffix, meaning, _) in MEASURES {
            let text = format!("{}: {meaning}, metres", scheme[id].name);
            of_tile.insert(format!("{prefix}{suffix}"), scalar("FLOAT64", text));
        }
    }
    let classes = Property {
        description: Some("The classes of surfaces".into()),
        kind: "ENUM".into(),
        enum_type: Some("surfaceClass".into()),
        array: true,
        ..Default::default()
    };
    let budgets = "Deviation allowed at scale 1 for each of the classes, metres".to_string();
    let texel = "A tile's geometricError is at least its texelSize times this".to_string();
    let of_tileset = BTreeMap::from([
        ("classes".to_string(), classes),
        ("budgets".into(), Property { array: true, ..scalar("FLOAT64", budgets) }),
        ("texelFactor".into(), scalar("FLOAT64", texel)),
    ]);
    let class = |text: &str, properties| Class { description: Some(text.into()), properties };
    Schema {
        id: "rooftile_tiles".into(),
        description: Some("How far tiles deviate from the source, per class of surface".into()),
        enums: BTreeMap::from([("surfaceClass".into(), surface_class(scheme))]),
        classes: BTreeMap::from([
            ("tile".into(), class("A tile", of_tile)),
            ("tileset".into(), class("The tileset", of_tileset)),
        ]),
    }
}

/// Class names as beginnings of identifiers, all different.
fn property_prefixes(scheme: &ClassScheme) -> Vec<String> {
    let mut prefixes: Vec<String> = Vec::new();
    for (i, class) in scheme.0.iter().enumerate() {
        let mut prefix: String = class.name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        if !prefix.starts_with(|c: char| c.is_ascii_alphabetic()) {
            prefix.insert(0, '_');
        }
        if prefixes.contains(&prefix) {
            prefix = format!("{prefix}_{i}_");
        }
        prefixes.push(prefix);
    }
    prefixes
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A leaf without classes.
    pub(crate) fn entry(uri: &str, min: [f64; 3], max: [f64; 3], error_m: f64) -> TileEntry {
        TileEntry {
            uri: uri.into(),
            box_local: Aabb { min: min.into(), max: max.into() },
            geometric_error_m: error_m,
            geometry_m: error_m,
            texel_m: 0.0,
            scale: 0.0,
            wall_m: 0.0,
            skirt_m: 0.0,
            triangles: 2,
            skirt_triangles: 0,
            bytes: 0,
            classes: Vec::new(),
            level: 0,
            children: Vec::new(),
        }
    }

    fn about(scheme: &ClassScheme) -> About<'_> {
        About { ecef_from_local: None, scheme, copyright: Some("© a city"), texel_factor: 2.0 }
    }

    #[test]
    fn unknown_numbers_are_left_out_and_known_ones_stand_under_their_class() {
        let scheme = ClassScheme::default();
        let mut root = entry("a.glb", [0.0; 3], [1.0, 2.0, 2.0], 0.5);
        let class = ClassId::ROOF;
        let (bound_m, nan) = (0.25, f64::NAN);
        root.classes = vec![ClassError {
            class,
            budget_m: 0.3,
            bound_m,
            mean_m: nan,
            rms_m: nan,
            p95_m: nan,
            p99_m: nan,
            inside_m: -0.1,
            sunk_m: nan,
        }];
        let written = serde_json::to_value(tileset(&root, &about(&scheme))).unwrap();
        let properties = &written["root"]["metadata"]["properties"];
        assert_eq!(properties["roofBound"], 0.25);
        assert_eq!(properties["roofInside"], -0.1);
        assert!(properties.get("roofMean").is_none() && properties.get("facadeBound").is_none());
        assert_eq!(written["geometricError"], 3.0);
        assert_eq!(written["root"]["refine"], "REPLACE");
        assert!(written["root"].get("transform").is_none());
        for id in properties.as_object().unwrap().keys() {
            assert!(written["schema"]["classes"]["tile"]["properties"].get(id).is_some(), "{id} is not in the schema");
        }
    }

    #[test]
    fn a_flat_tile_has_a_box_with_a_volume() {
        let flat = oriented_box(&Aabb { min: DVec3::new(-1.0, 0.0, 5.0), max: DVec3::new(3.0, 2.0, 5.0) });
        assert_eq!(flat, [1.0, 1.0, 5.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1e-3]);
    }

    #[test]
    fn odd_class_names_become_different_identifiers() {
        let mut scheme = ClassScheme::default();
        scheme.0[0].name = "high-vegetation".into();
        scheme.0[1].name = "high vegetation".into();
        scheme.0[2].name = "2nd".into();
        assert_eq!(property_prefixes(&scheme), ["high_vegetation", "high_vegetation_1_", "_2nd", "clutter"]);
    }
}
