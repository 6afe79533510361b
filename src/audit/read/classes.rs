//! Class names of features, from `EXT_mesh_features` and `EXT_structural_metadata` of any tiler.
//!
//! The property is the one called like a class; else the first enum; else there are no classes.

use std::collections::BTreeMap;
use std::rc::Rc;

use serde::Deserialize;
use serde_json::Value;

use crate::input::gltf::data::Data;
use crate::input::gltf::schema::{Int, Primitive};

/// Names that say that a property is a class, lower case.
const NAMES: [&str; 5] = ["class", "category", "semantic", "label", "classification"];

/// Feature id sets of one primitive that are looked at.
const MAX_SETS: usize = 16;

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct MeshFeatures {
    feature_ids: Vec<FeatureIds>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct FeatureIds {
    attribute: Option<Int>,
    property_table: Option<Int>,
    null_feature_id: Option<u32>,
    texture: Option<Value>,
}

/// Where a primitive's classes are.
pub struct Source<'a> {
    /// Attribute with an id for each vertex; `None`: the vertex's index is the id.
    pub attribute: Option<String>,
    /// Id of what has no class.
    null_id: Option<u32>,
    column: Rc<Column<'a>>,
}

/// The class columns of one glTF, by property table; read once, whatever the number of primitives.
#[derive(Default)]
pub struct Columns<'a>(BTreeMap<u64, Option<Rc<Column<'a>>>>);

/// A property of a table, by row.
struct Column<'a> {
    count: u64,
    values: &'a [u8],
    kind: Kind<'a>,
    /// Where 1 says that a feature hides gaps between tiles and is no surface.
    skirts: Option<&'a [u8]>,
}

enum Kind<'a> {
    /// Integers; with an enum's names by value.
    Integers {
        scalar: Scalar,
        names: Option<BTreeMap<i64, String>>,
    },
    Strings {
        offsets: &'a [u8],
        scalar: Scalar,
    },
}

#[derive(Clone, Copy)]
struct Scalar {
    bytes: usize,
    is_signed: bool,
}

impl Scalar {
    fn of(name: &str) -> Option<Self> {
        let (is_signed, bits) = match name.strip_prefix("UINT") {
            Some(bits) => (false, bits),
            None => (true, name.strip_prefix("INT")?),
        };
        let bytes = ["8", "16", "32", "64"].iter().position(|&b| b == bits).map(|i| 1 << i)?;
        Some(Self { bytes, is_signed })
    }

    /// Integer `i` of `values`.
    fn read(self, values: &[u8], i: u64) -> Option<i64> {
        let from = usize::try_from(i).ok()?.checked_mul(self.bytes)?;
        let bytes = values.get(from..from.checked_add(self.bytes)?)?;
        let mut word = [0u8; 8];
        word[..self.bytes].copy_from_slice(bytes);
        let unused = 64 - 8 * self.bytes as u32;
        let word = u64::from_le_bytes(word) << unused;
        Some(if self.is_signed { word as i64 >> unused } else { (word >> unused) as i64 })
    }
}

impl<'a> Source<'a> {
    /// The classes of `primitive`; `None` if it has none that can be read.
    pub fn of(data: &'a Data<'a>, columns: &mut Columns<'a>, primitive: &Primitive) -> Option<Self> {
        let features = MeshFeatures::deserialize(primitive.extensions.mesh_features.as_ref()?).ok()?;
        let metadata = data.root.extensions.structural_metadata.as_ref()?;
        let sets = features.feature_ids.iter().take(MAX_SETS).filter(|set| set.texture.is_none());
        sets.into_iter().find_map(|set| {
            let table = set.property_table?;
            let read = || Column::of(data, metadata, table).map(Rc::new);
            let column = columns.0.entry(table.0).or_insert_with(read).clone()?;
            let attribute = set.attribute.map(|Int(n)| format!("_FEATURE_ID_{n}"));
            Some(Self { attribute, null_id: set.null_feature_id, column })
        })
    }

    /// True if the feature `id` is a skirt: it hides gaps between tiles and is no part of the surface.
    pub fn is_skirt(&self, id: u32) -> bool {
        let value = self.column.skirts.and_then(|values| values.get(usize::try_from(id).ok()?));
        value.is_some_and(|value| *value != 0)
    }

    /// The class of the feature `id`.
    pub fn name(&self, id: u32) -> Option<String> {
        if self.null_id == Some(id) || u64::from(id) >= self.column.count {
            return None;
        }
        self.column.name(u64::from(id))
    }
}

impl<'a> Column<'a> {
    fn of(data: &'a Data<'a>, metadata: &'a Value, table: Int) -> Option<Self> {
        let table = metadata.get("propertyTables")?.get(usize::try_from(table.0).ok()?)?;
        let count = table.get("count")?.as_u64()?;
        let columns = table.get("properties")?.as_object()?;
        let schema = metadata.get("schema")?;
        let properties = schema.get("classes")?.get(table.get("class")?.as_str()?)?.get("properties")?.as_object()?;
        let is_called_class = |id: &str| NAMES.iter().any(|name| id.to_ascii_lowercase().ends_with(name));
        let is_single = |p: &Value| p.get("array").and_then(Value::as_bool) != Some(true);
        let is_enum = |p: &Value| p.get("type").and_then(Value::as_str) == Some("ENUM");
        let mut usable = properties.iter().filter(|(id, p)| columns.contains_key(*id) && is_single(p));
        let (id, property) = usable
            .clone()
            .find(|(id, p)| is_called_class(id) && is_enum(p))
            .or_else(|| usable.clone().find(|(id, _)| is_called_class(id)))
            .or_else(|| usable.find(|(_, p)| is_enum(p)))?;
        let column = columns.get(id)?;
        let view = |name: &str| {
            let view = column.get(name)?.as_u64()?;
            data.view(Int(view)).ok().map(|view| view.bytes)
        };
        let text = |of: &'a Value, name: &str| of.get(name).and_then(Value::as_str);
        let kind = match text(property, "type")? {
            "ENUM" => {
                let kind = schema.get("enums")?.get(text(property, "enumType")?)?;
                let scalar = Scalar::of(text(kind, "valueType").unwrap_or("UINT16"))?;
                let named = |v: &Value| Some((v.get("value")?.as_i64()?, v.get("name")?.as_str()?.to_string()));
                let names = kind.get("values")?.as_array()?.iter().filter_map(named).collect();
                Kind::Integers { scalar, names: Some(names) }
            }
            "SCALAR" => Kind::Integers { scalar: Scalar::of(text(property, "componentType")?)?, names: None },
            "STRING" => {
                let scalar = Scalar::of(text(column, "stringOffsetType").unwrap_or("UINT32"))?;
                Kind::Strings { offsets: view("stringOffsets")?, scalar }
            }
            _ => return None,
        };
        let is_byte = |p: &Value| p.get("componentType").and_then(Value::as_str) == Some("UINT8");
        let skirts = properties.get("skirt").filter(|p| is_byte(p)).and_then(|_| {
            let view = columns.get("skirt")?.get("values")?.as_u64()?;
            data.view(Int(view)).ok().map(|view| view.bytes)
        });
        Some(Self { count, values: view("values")?, kind, skirts })
    }

    fn name(&self, row: u64) -> Option<String> {
        match &self.kind {
            Kind::Integers { scalar, names } => {
                let value = scalar.read(self.values, row)?;
                match names {
                    Some(names) => names.get(&value).cloned(),
                    None => Some(value.to_string()),
                }
            }
            Kind::Strings { offsets, scalar } => {
                let at = |i| usize::try_from(scalar.read(offsets, i)?).ok();
                let bytes = self.values.get(at(row)?..at(row + 1)?)?;
                std::str::from_utf8(bytes).ok().map(str::to_string)
            }
        }
    }
}
