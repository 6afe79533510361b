//! Reads glTF 2.0, as `.gltf` with its files or as `.glb`.
//!
//! In: a path. Out: one [`Part`](crate::input::Part) per primitive and node that shows it, materials, images undecoded.
//!
//! # Method
//! 1. split the container into JSON and binary chunk
//! 2. refuse versions and required extensions that are not read
//! 3. walk the scene to meshes under transforms (f64)
//! 4. read each primitive through checked accessors, turn it z-up: (x, −z, y)
//!
//! # Promises
//! Nothing is indexed, allocated or opened on the file's word: offsets are added in u64 and compared with what is there;
//! geometry shared by primitives and nodes is repeated to a limit; paths stay in the input's folder. The tests cut a GLB
//! at every byte and flip a bit in each.
//!
//! # Limits
//! Draco is refused. Skins, morph targets, animation, GPU instancing are not applied (a warning says so). Only the base
//! colour is used; KTX2 images are grey.
//!
//! # Why not `gltf::import`
//! It follows `file:` and `..` and panics on bad accessors.

use std::path::Path;

use glam::DVec3;

use self::data::{Data, Files};
use self::material::Palette;
use self::primitive::Builder;
use self::schema::{Int, Root};
use crate::input::{InputConfig, Source};
use crate::report::Reporter;
use crate::{Error, Result};

pub(crate) mod accessor;
pub(crate) mod container;
pub(crate) mod data;
pub(crate) mod material;
mod meshopt;
pub(crate) mod primitive;
pub(crate) mod scene;
pub(crate) mod schema;
#[cfg(test)]
mod tests;
pub(crate) mod uri;

/// Extensions a file may require: read, or without effect on shape and base colour.
pub(crate) const KNOWN_EXTENSIONS: [&str; 20] = [
    "CESIUM_RTC",
    "CESIUM_primitive_outline",
    "EXT_feature_metadata",
    "EXT_instance_features",
    "EXT_mesh_features",
    "EXT_meshopt_compression",
    "EXT_structural_metadata",
    "EXT_texture_avif",
    "EXT_texture_webp",
    "KHR_lights_punctual",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_meshopt_compression",
    "KHR_texture_basisu",
    "KHR_texture_transform",
    "KHR_xmp",
    "KHR_xmp_json_ld",
    "MSFT_texture_dds",
    "NGA_gpm_local",
    "KHR_animation_pointer",
];
/// All of these change how light falls on a surface, which is not read.
pub(crate) const MATERIAL_EXTENSIONS: &str = "KHR_materials_";

/// Reads the glTF or GLB file at `path` into `source`.
///
/// # Errors
/// [`Error::Input`] if the file is broken or shows no triangles, [`Error::Unsupported`] for glTF 1.0 and for required
/// extensions that are not read, [`Error::Limit`] for geometry repeated beyond reason, [`Error::Io`], [`Error::Cancelled`].
pub fn read(path: &Path, config: &InputConfig, reporter: &Reporter, source: &mut Source) -> Result<()> {
    let is_file = std::fs::metadata(path).map_err(Error::io("read", path))?.is_file();
    if !is_file {
        return Err(Error::input(path, "is not a regular file"));
    }
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    let container = container::split(path, &bytes, reporter)?;
    let root: Root = serde_json::from_slice(container.json)
        .map_err(|error| Error::input(path, format!("its JSON is not that of a glTF: {error}")))?;
    check_version(path, &root)?;
    check_extensions(path, &root)?;

    let data = Data::new(path, &root, container.bin, Files::Beside(config));
    let center = root.extensions.cesium_rtc.as_ref().map_or(DVec3::ZERO, |rtc| DVec3::from_array(rtc.center));
    let palette = Palette::new(&data, reporter);
    let mut builder = Builder { data: &data, palette, reporter, center, corners: 0 };
    let parts_before = source.parts.len();
    for instance in scene::instances(&data, reporter)? {
        reporter.check()?;
        for primitive in &data.at(&root.meshes, instance.mesh, "mesh")?.primitives {
            builder.add(primitive, &instance, source)?;
        }
    }
    if source.parts.len() == parts_before {
        return Err(data.refuse(nothing_found(&root)));
    }
    source.copyright.extend(root.asset.copyright.iter().filter(|text| !text.trim().is_empty()).cloned());
    Ok(())
}

fn check_version(path: &Path, root: &Root) -> Result<()> {
    let unsupported = |version: &str| {
        let what = format!("is glTF {:?}; convert it to glTF 2.0", data::shorten(version));
        Err(Error::Unsupported { path: path.into(), what })
    };
    match root.asset.version.as_deref() {
        None => return Err(Error::input(path, "asset.version is missing; is this a glTF?")),
        Some(version) if version.split('.').next() != Some("2") => return unsupported(version),
        _ => {}
    }
    match root.asset.min_version.as_deref() {
        Some(version) if version != "2.0" => unsupported(version),
        _ => Ok(()),
    }
}

fn check_extensions(path: &Path, root: &Root) -> Result<()> {
    for name in &root.extensions_required {
        if name == "KHR_draco_mesh_compression" {
            return Err(draco(path));
        }
        if !KNOWN_EXTENSIONS.contains(&name.as_str()) && !name.starts_with(MATERIAL_EXTENSIONS) {
            let what = format!("requires the extension {:?}; re-export without it", data::shorten(name));
            return Err(Error::Unsupported { path: path.into(), what });
        }
    }
    Ok(())
}

/// The refusal of Draco.
fn draco(path: &Path) -> Error {
    let what = "is compressed with KHR_draco_mesh_compression; re-export without Draco (meshopt is read)";
    Error::Unsupported { path: path.into(), what: what.into() }
}

fn nothing_found(root: &Root) -> String {
    let scene = root.scene.unwrap_or(Int(0)).0;
    format!(
        "shows no triangles: scene {scene} of {} with {} nodes and {} meshes; export meshes within a scene",
        root.scenes.len(),
        root.nodes.len(),
        root.meshes.len()
    )
}
