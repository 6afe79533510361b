//! Turns glTF 1.0, as old b3dm hold it, into the glTF 2.0 that is read: objects by name become lists.
//!
//! Shaders and techniques are only looked at for the image they show. `WEB3D_quantized_attributes` is kept as a matrix
//! for each accessor.

use std::collections::BTreeMap;

use serde_json::{Map, Value};

use super::refusal::{Refusal, refuse};
use crate::input::gltf::schema as gltf;
use crate::input::gltf::schema::Int;

const GLB1_HEADER_BYTES: usize = 20;

/// Primitives over all nodes; meshes that nodes share are repeated.
const MAX_PRIMITIVES: usize = 1_000_000;

/// By accessor, the matrix (column-major, 3×3 or 4×4) that turns stored into real values.
pub type Decode = BTreeMap<u64, Vec<f64>>;

/// A glTF 1.0 as a 2.0.
pub struct Upgraded<'a> {
    pub root: gltf::Root,
    pub decode: Decode,
    pub bin: Option<&'a [u8]>,
}

/// The glTF 1.0 in `bytes`, binary or JSON; `None` if it is no 1.0.
pub fn read(bytes: &[u8]) -> Result<Option<Upgraded<'_>>, Refusal> {
    let (json, bin) = match split(bytes)? {
        Some(parts) => parts,
        None if !bytes.starts_with(b"glTF") && is_old_json(bytes) => (bytes, None),
        None => return Ok(None),
    };
    let end = json.iter().rposition(|&b| b != 0 && !b.is_ascii_whitespace()).map_or(0, |last| last + 1);
    let value: Value = serde_json::from_slice(&json[..end])
        .map_err(|e| Refusal::new("broken-gltf", format!("its JSON is not that of a glTF 1.0: {e}")))?;
    let mut names = Names::of(&value, bin.map_or(0, |bin| bin.len() as u64));
    let root = names.root(&value, bin.is_some())?;
    Ok(Some(Upgraded { root, decode: names.decode, bin }))
}

/// JSON and body of a GLB.
type Chunks<'a> = (&'a [u8], Option<&'a [u8]>);

fn split(bytes: &[u8]) -> Result<Option<Chunks<'_>>, Refusal> {
    let word = |at: usize| bytes.get(at..at + 4).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
    if !bytes.starts_with(b"glTF") || word(4) != Some(1) {
        return Ok(None);
    }
    let cut = || Refusal::new("broken-gltf", format!("a GLB 1.0 of {} bytes is cut short", bytes.len()));
    let (length, json) = (word(8).ok_or_else(cut)? as usize, word(12).ok_or_else(cut)? as usize);
    if word(16).ok_or_else(cut)? != 0 {
        return refuse("unsupported-gltf", "is a GLB 1.0 whose scene is not JSON");
    }
    let bytes = bytes.get(..length).ok_or_else(cut)?;
    let body = GLB1_HEADER_BYTES.checked_add(json).ok_or_else(cut)?;
    Ok(Some((bytes.get(GLB1_HEADER_BYTES..body).ok_or_else(cut)?, Some(&bytes[body..]))))
}

/// Lists have become objects in 1.0, so that its JSON is told by the kind of `meshes` where the version is missing.
fn is_old_json(bytes: &[u8]) -> bool {
    #[derive(serde::Deserialize, Default)]
    #[serde(default)]
    struct Asset {
        version: Value,
    }
    #[derive(serde::Deserialize, Default)]
    #[serde(default)]
    struct Head {
        asset: Option<Asset>,
    }
    let Ok(head) = serde_json::from_slice::<Head>(bytes) else { return false };
    match head.asset.map(|asset| asset.version) {
        Some(Value::String(version)) => version.starts_with("1."),
        Some(Value::Number(version)) => version.as_f64() == Some(1.0),
        _ => false,
    }
}

/// Where the named things of each kind are in the lists.
#[derive(Default)]
struct Names<'a> {
    buffers: BTreeMap<&'a str, u64>,
    views: BTreeMap<&'a str, u64>,
    accessors: BTreeMap<&'a str, u64>,
    nodes: BTreeMap<&'a str, u64>,
    materials: BTreeMap<&'a str, u64>,
    textures: BTreeMap<&'a str, u64>,
    images: BTreeMap<&'a str, u64>,
    decode: Decode,
    body_bytes: u64,
    primitives: usize,
}

const BODY: [&str; 2] = ["binary_glTF", "KHR_binary_glTF"];

fn table<'a>(value: &'a Value, kind: &str) -> impl Iterator<Item = (&'a str, &'a Value)> {
    value.get(kind).and_then(Value::as_object).into_iter().flat_map(Map::iter).map(|(name, v)| (name.as_str(), v))
}

fn int(value: &Value, member: &str) -> Option<u64> {
    let number = value.get(member)?;
    number.as_u64().or_else(|| number.as_f64().and_then(|f| Int::try_from(f).ok()).map(|i| i.0))
}

fn text<'a>(value: &'a Value, member: &str) -> Option<&'a str> {
    value.get(member)?.as_str()
}

fn numbers<const N: usize>(value: &Value, member: &str) -> Option<[f64; N]> {
    let list: Option<Vec<f64>> = value.get(member)?.as_array()?.iter().map(Value::as_f64).collect();
    list?.try_into().ok()
}

impl<'a> Names<'a> {
    fn of(value: &'a Value, body_bytes: u64) -> Self {
        let list = |kind| table(value, kind).zip(0..).map(|((name, _), i)| (name, i)).collect();
        let mut names = Self {
            buffers: list("buffers"),
            views: list("bufferViews"),
            accessors: list("accessors"),
            nodes: list("nodes"),
            materials: list("materials"),
            textures: list("textures"),
            images: list("images"),
            body_bytes,
            ..Self::default()
        };
        // The body of a GLB is buffer 0 of a glTF 2.0.
        if let Some(body) = BODY.iter().find(|body| names.buffers.contains_key(*body)) {
            let others = table(value, "buffers").map(|(name, _)| name).filter(|name| name != body);
            names.buffers = std::iter::once(*body).chain(others).zip(0..).collect();
        }
        names
    }

    fn root(&mut self, value: &'a Value, has_body: bool) -> Result<gltf::Root, Refusal> {
        let mut root = gltf::Root::default();
        root.asset.version = Some("2.0".into());
        root.buffers = self.buffers(value, has_body);
        root.buffer_views = table(value, "bufferViews").map(|(_, v)| self.view(v)).collect();
        for (name, accessor) in table(value, "accessors") {
            let (accessor, view) = self.accessor(value, name, accessor, root.buffer_views.len() as u64);
            root.accessors.push(accessor);
            root.buffer_views.push(view);
        }
        root.images = table(value, "images").map(|(_, v)| self.image(v)).collect();
        root.textures = table(value, "textures")
            .map(|(_, v)| gltf::Texture { source: self.at(&self.images, text(v, "source")), ..Default::default() })
            .collect();
        root.materials = table(value, "materials").map(|(_, v)| self.material(value, v)).collect();
        for (_, node) in table(value, "nodes") {
            let node = self.node(value, node, &mut root.meshes)?;
            root.nodes.push(node);
        }
        if let Some((_, rtc)) = table(value, "extensions").find(|(name, _)| *name == "CESIUM_RTC") {
            root.extensions.cesium_rtc = numbers(rtc, "center").map(|center| gltf::Rtc { center });
        }
        let scenes: Vec<_> = table(value, "scenes").collect();
        let named = text(value, "scene").and_then(|scene| scenes.iter().find(|(name, _)| *name == scene));
        if let Some((_, scene)) = named.or(scenes.first()) {
            let nodes = scene.get("nodes").and_then(Value::as_array).into_iter().flatten();
            let nodes = nodes.filter_map(|n| self.at(&self.nodes, n.as_str())).collect();
            root.scenes = vec![gltf::Scene { nodes }];
        }
        Ok(root)
    }

    fn at(&self, list: &BTreeMap<&str, u64>, name: Option<&str>) -> Option<Int> {
        list.get(name?).copied().map(Int)
    }

    fn buffers(&self, value: &Value, has_body: bool) -> Vec<gltf::Buffer> {
        let mut list: Vec<(u64, gltf::Buffer)> = Vec::new();
        for (name, buffer) in table(value, "buffers") {
            let Some(&at) = self.buffers.get(name) else { continue };
            let is_body = has_body && BODY.contains(&name);
            let uri = text(buffer, "uri").filter(|_| !is_body).map(str::to_string);
            let length = int(buffer, "byteLength").filter(|&length| length > 0 || !is_body).unwrap_or(self.body_bytes);
            list.push((at, gltf::Buffer { uri, byte_length: Some(Int(length)) }));
        }
        list.sort_by_key(|(at, _)| *at);
        list.into_iter().map(|(_, buffer)| buffer).collect()
    }

    fn view(&self, view: &Value) -> gltf::BufferView {
        gltf::BufferView {
            buffer: self.at(&self.buffers, text(view, "buffer")),
            byte_offset: int(view, "byteOffset").map(Int),
            byte_length: int(view, "byteLength").map(Int),
            ..Default::default()
        }
    }

    /// An accessor, and a view of its own: strides were the accessor's.
    fn accessor(&mut self, value: &Value, name: &str, old: &Value, view: u64) -> (gltf::Accessor, gltf::BufferView) {
        let parent = text(old, "bufferView").and_then(|name| value.get("bufferViews")?.get(name));
        let mut own = parent.map(|view| self.view(view)).unwrap_or_default();
        let offset = int(old, "byteOffset").unwrap_or(0);
        own.byte_offset = Some(Int(own.byte_offset.map_or(0, |o| o.0).saturating_add(offset)));
        own.byte_length = own.byte_length.map(|length| Int(length.0.saturating_sub(offset)));
        own.byte_stride = int(old, "byteStride").filter(|&stride| stride > 0).map(Int);
        let quantized = old.get("extensions").and_then(|e| e.get("WEB3D_quantized_attributes"));
        if let Some(matrix) = quantized.and_then(|q| q.get("decodeMatrix")?.as_array())
            && let Some(&at) = self.accessors.get(name)
        {
            self.decode.insert(at, matrix.iter().filter_map(Value::as_f64).collect());
        }
        let accessor = gltf::Accessor {
            buffer_view: parent.is_some().then_some(Int(view)),
            component_type: int(old, "componentType").map(Int),
            count: int(old, "count").map(Int),
            shape: text(old, "type").map(str::to_string),
            ..Default::default()
        };
        (accessor, own)
    }

    fn image(&self, image: &Value) -> gltf::Image {
        let binary = image.get("extensions").and_then(|e| BODY.iter().find_map(|body| e.get(body)));
        let buffer_view = binary.and_then(|b| self.at(&self.views, text(b, "bufferView")));
        let uri = text(image, "uri").filter(|_| buffer_view.is_none()).map(str::to_string);
        gltf::Image { uri, buffer_view }
    }

    /// The image that the material's values, or else its technique's parameters, name.
    fn material(&self, value: &Value, material: &Value) -> gltf::Material {
        /// Where tilers put the base colour.
        const COLOURS: [&str; 6] = ["diffuse", "tex", "u_tex", "diffuseTexture", "baseColorTexture", "u_diffuse"];
        let common = material.get("extensions").and_then(|e| e.get("KHR_materials_common"));
        let tables = [material.get("values"), common.and_then(|c| c.get("values"))];
        let values = || tables.iter().flatten().filter_map(|v| v.as_object());
        let named = |v: &Value| {
            let name = v.as_str().or_else(|| v.as_array()?.first()?.as_str());
            self.at(&self.textures, name)
        };
        let known = COLOURS.iter().find_map(|colour| values().find_map(|table| named(table.get(*colour)?)));
        let any = || values().flat_map(Map::values).find_map(named);
        let technique = || {
            let technique = value.get("techniques")?.get(text(material, "technique")?)?;
            technique.get("parameters")?.as_object()?.values().find_map(|p| named(p.get("value")?))
        };
        let index = known.or_else(any).or_else(technique);
        let texture = index.map(|index| gltf::TextureInfo { index: Some(index), ..Default::default() });
        let metallic = gltf::Metallic { base_color_factor: None, base_color_texture: texture };
        gltf::Material { pbr_metallic_roughness: Some(metallic), ..Default::default() }
    }

    fn node(&mut self, value: &Value, old: &Value, meshes: &mut Vec<gltf::Mesh>) -> Result<gltf::Node, Refusal> {
        let names = |member: &str| old.get(member).and_then(Value::as_array).into_iter().flatten();
        let children = names("children").filter_map(|n| self.at(&self.nodes, n.as_str())).collect();
        let mut primitives = Vec::new();
        let shown = names("meshes").chain(old.get("mesh")).filter_map(|n| value.get("meshes")?.get(n.as_str()?));
        for primitive in shown.filter_map(|mesh| mesh.get("primitives")?.as_array()).flatten() {
            self.primitives += 1;
            if self.primitives > MAX_PRIMITIVES {
                return refuse("too-large", format!("a glTF 1.0 draws more than {MAX_PRIMITIVES} primitives"));
            }
            primitives.push(self.primitive(primitive));
        }
        let mesh = (!primitives.is_empty()).then(|| {
            meshes.push(gltf::Mesh { primitives });
            Int(meshes.len() as u64 - 1)
        });
        Ok(gltf::Node {
            children,
            mesh,
            matrix: numbers(old, "matrix"),
            translation: numbers(old, "translation"),
            rotation: numbers(old, "rotation"),
            scale: numbers(old, "scale"),
            ..Default::default()
        })
    }

    fn primitive(&self, old: &Value) -> gltf::Primitive {
        let accessor = |v: &Value| self.at(&self.accessors, v.as_str());
        let named = |name: &str| if name == "TEXCOORD" { "TEXCOORD_0".to_string() } else { name.to_string() };
        let attributes = table(old, "attributes").filter_map(|(name, v)| Some((named(name), accessor(v)?))).collect();
        gltf::Primitive {
            attributes,
            indices: old.get("indices").and_then(accessor),
            material: self.at(&self.materials, text(old, "material")),
            mode: int(old, "mode").map(Int),
            ..Default::default()
        }
    }
}
