//! What tilers wrote before glTF 2.0 was settled and still do: techniques that carry the image, quantized attributes.
//!
//! In: the JSON of a glTF 2.0. Out: the same as a [`Root`] with a base colour, and matrices by accessor.

use memchr::memmem;
use serde::Deserialize;
use serde_json::{Value, json};

use super::gltf1::Decode;
use super::refusal::Refusal;
use crate::input::gltf::schema::Root;

/// Both spellings are found.
const TECHNIQUES: [&str; 2] = ["KHR_techniques_webgl", "KHR_technique_webgl"];
const QUANTIZED: &str = "WEB3D_quantized_attributes";

/// Extensions that may be required: these are read here, or change nothing that is looked at.
pub const KNOWN: [&str; 7] = [
    TECHNIQUES[0],
    TECHNIQUES[1],
    QUANTIZED,
    "KHR_blend",
    "AGI_articulations",
    "AGI_stk_metadata",
    "MAXAR_mesh_variants",
];

/// Reads the JSON of a glTF 2.0.
pub fn read(text: &[u8]) -> Result<(Root, Decode), Refusal> {
    let broken = |e| Refusal::new("broken-gltf", format!("its JSON is not that of a glTF: {e}"));
    let has = |name: &str| memmem::find(text, name.as_bytes()).is_some();
    if !has(QUANTIZED) && !TECHNIQUES.iter().any(|name| has(name)) {
        return Ok((serde_json::from_slice(text).map_err(broken)?, Decode::new()));
    }
    let mut value: Value = serde_json::from_slice(text).map_err(broken)?;
    let decode = matrices(&value);
    if let Some(materials) = value.get_mut("materials").and_then(Value::as_array_mut) {
        materials.iter_mut().for_each(paint);
    }
    Ok((Root::deserialize(value).map_err(broken)?, decode))
}

fn matrices(value: &Value) -> Decode {
    let accessors = value.get("accessors").and_then(Value::as_array);
    let matrix = |accessor: &Value| {
        let numbers = accessor.get("extensions")?.get(QUANTIZED)?.get("decodeMatrix")?.as_array()?;
        numbers.iter().map(Value::as_f64).collect::<Option<Vec<f64>>>()
    };
    let indexed = accessors.into_iter().flatten().zip(0u64..);
    indexed.filter_map(|(accessor, i)| Some((i, matrix(accessor)?))).collect()
}

/// Makes the image of a technique the base colour of a material without one.
fn paint(material: &mut Value) {
    if material.get("pbrMetallicRoughness").is_some_and(|pbr| pbr.get("baseColorTexture").is_some()) {
        return;
    }
    let extensions = material.get("extensions");
    let values = TECHNIQUES.iter().find_map(|name| extensions?.get(name)?.get("values")?.as_object());
    let index = |value: &Value| value.get("index").and_then(Value::as_u64);
    let is_diffuse = |name: &str| ["diff", "tex", "color"].iter().any(|part| name.to_lowercase().contains(part));
    let images = || values.into_iter().flatten().filter_map(|(name, value)| Some((name, index(value)?)));
    let chosen = images().find(|(name, _)| is_diffuse(name)).or_else(|| images().next());
    if let (Some((_, index)), true) = (chosen, material.is_object()) {
        material["pbrMetallicRoughness"] = json!({ "baseColorTexture": { "index": index } });
    }
}
