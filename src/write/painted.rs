//! Writes a mesh with a texture as a GLB that holds its picture, or as OBJ, MTL and JPEG side by side.
//!
//! # Promises
//! Names of the files beside an OBJ are its own with other endings; [`admit_beside`] sees to it that they are nobody
//! else's.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

use glam::{DVec3, Vec2};

use super::content::TileContent;
use super::glb::{GlbOptions, glb};
use super::mesh::{Format, Plain};
use crate::ids::{ClassId, ClassScheme};
use crate::{Error, Result};

/// The material of a mesh without classes.
const ONLY_MATERIAL: &str = "surface";

/// The texture of a [`Plain`] mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Paint {
    /// Per face and corner, into the picture, 0 to 1, v down.
    pub corner_uvs: Vec<[Vec2; 3]>,
    /// The picture, as JPEG.
    pub jpeg: Vec<u8>,
}

/// The files beside `out` that a painted mesh takes.
pub fn beside(out: &Path, format: Format) -> Vec<PathBuf> {
    match format {
        Format::Obj => vec![out.with_extension("mtl"), out.with_extension("jpg")],
        Format::Ply | Format::Glb => Vec::new(),
    }
}

/// Refuses to write beside an OBJ that is not there yet what others have already, and ever to write over `taken`: so no
/// picture of an input is lost.
///
/// # Errors
/// [`Error::Output`] that names the file.
pub fn admit_beside(out: &Path, format: Format, taken: &[PathBuf]) -> Result<()> {
    for path in beside(out, format) {
        let real = path.canonicalize().ok();
        let is_taken =
            taken.contains(&path) || (real.is_some() && taken.iter().any(|input| input.canonicalize().ok() == real));
        if is_taken || (real.is_some() && !out.exists()) {
            let what = format!("is there already and does not belong to {}; name another output", out.display());
            return Err(Error::Output { path, what });
        }
    }
    Ok(())
}

/// The files of `mesh` with its `paint`: the one at `out` first. A PLY has no place for it.
///
/// # Errors
/// [`Error::Bug`] for a mesh that does not hold together or coordinates that are not one for each of its corners.
pub fn files(
    mesh: &Plain,
    paint: &Paint,
    out: &Path,
    format: Format,
    scheme: &ClassScheme,
) -> Result<Vec<(PathBuf, Vec<u8>)>> {
    if paint.corner_uvs.len() != mesh.faces.len() || paint.corner_uvs.iter().flatten().any(|uv| !uv.is_finite()) {
        let what = format!("{} faces with texture coordinates of {}", paint.corner_uvs.len(), mesh.faces.len());
        return Err(Error::Bug(what));
    }
    mesh.check(scheme)?;
    match format {
        Format::Ply => Ok(vec![(out.into(), mesh.bytes(format, scheme)?)]),
        Format::Glb => {
            let content = content(mesh, paint);
            content.check(scheme).map_err(Error::Bug)?;
            Ok(vec![(out.into(), glb(&content, scheme, &GlbOptions::default()))])
        }
        Format::Obj => {
            let [mtl_path, jpg_path] = [out.with_extension("mtl"), out.with_extension("jpg")];
            let mtl = mtl(mesh, scheme, &name_of(&jpg_path));
            let obj = obj(mesh, paint, scheme, &name_of(&mtl_path));
            Ok(vec![(out.into(), obj), (mtl_path, mtl), (jpg_path, paint.jpeg.clone())])
        }
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A vertex for each place in the picture and class that uses it, in the order of faces.
fn content(mesh: &Plain, paint: &Paint) -> TileContent {
    let origin = mesh.origin();
    let mut content = TileContent { origin, atlas: Some(paint.jpeg.clone()), ..TileContent::default() };
    let mut numbers: BTreeMap<(u32, [u32; 2], ClassId), u32> = BTreeMap::new();
    for (f, face) in mesh.faces.iter().enumerate() {
        let class = mesh.classes.get(f).copied().unwrap_or(ClassId(0));
        let corners = [0, 1, 2].map(|k| {
            let (v, uv) = (face[k], paint.corner_uvs[f][k]);
            *numbers.entry((v, uv.to_array().map(f32::to_bits), class)).or_insert_with(|| {
                content.positions.push((mesh.positions[v as usize] - origin).as_vec3());
                content.class_of_vertex.push(class);
                content.uvs.push(uv);
                content.positions.len() as u32 - 1
            })
        });
        content.faces.push(corners);
    }
    content
}

/// Materials in the order of classes: name, and the faces of it.
fn materials<'a>(mesh: &Plain, scheme: &'a ClassScheme) -> Vec<(&'a str, Vec<usize>)> {
    let all = || 0..mesh.faces.len();
    if mesh.classes.is_empty() {
        return vec![(ONLY_MATERIAL, all().collect())];
    }
    let of = |class: ClassId| (scheme[class].name.as_str(), all().filter(|&f| mesh.classes[f] == class).collect());
    scheme.ids().map(of).filter(|(_, faces): &(&str, Vec<usize>)| !faces.is_empty()).collect()
}

/// A material name per class, all painted from one picture.
fn mtl(mesh: &Plain, scheme: &ClassScheme, picture: &str) -> Vec<u8> {
    let each = materials(mesh, scheme).into_iter();
    each.map(|(name, _)| format!("newmtl {name}\nKd 1 1 1\nillum 0\nmap_Kd {picture}\n"))
        .collect::<String>()
        .into_bytes()
}

fn obj(mesh: &Plain, paint: &Paint, scheme: &ClassScheme, library: &str) -> Vec<u8> {
    let mut out = Vec::with_capacity(32 * mesh.positions.len() + 96 * mesh.faces.len());
    // Writing into memory does not fail.
    let _ = writeln!(out, "mtllib {library}");
    for DVec3 { x, y, z } in &mesh.positions {
        let _ = writeln!(out, "v {x} {y} {z}");
    }
    let mut numbers: BTreeMap<[u32; 2], usize> = BTreeMap::new();
    for uv in paint.corner_uvs.iter().flatten() {
        let next = numbers.len() + 1;
        numbers.entry(uv.to_array().map(f32::to_bits)).or_insert_with(|| {
            // OBJ counts v upwards.
            let _ = writeln!(out, "vt {} {}", uv.x, 1.0 - uv.y);
            next
        });
    }
    for (name, faces) in materials(mesh, scheme) {
        let _ = writeln!(out, "usemtl {name}");
        for f in faces {
            let corner =
                |k: usize| (mesh.faces[f][k] + 1, numbers[&paint.corner_uvs[f][k].to_array().map(f32::to_bits)]);
            let [(a, i), (b, j), (c, k)] = [0, 1, 2].map(corner);
            let _ = writeln!(out, "f {a}/{i} {b}/{j} {c}/{k}");
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> (Plain, Paint) {
        let positions = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]];
        let mesh = Plain {
            positions: positions.iter().map(|[x, y]| DVec3::new(*x, *y, 100.0)).collect(),
            faces: vec![[0, 1, 2], [0, 2, 3]],
            classes: vec![ClassId::ROOF, ClassId::TERRAIN],
        };
        let uv = |v: u32| Vec2::new(mesh.positions[v as usize].x as f32, mesh.positions[v as usize].y as f32) / 8.0;
        let paint = Paint { corner_uvs: mesh.faces.iter().map(|f| f.map(uv)).collect(), jpeg: vec![0xFF, 0xD8] };
        (mesh, paint)
    }

    #[test]
    fn an_obj_names_its_material_file_and_that_its_picture() {
        let (mesh, paint) = square();
        let files = files(&mesh, &paint, Path::new("x/a.obj"), Format::Obj, &ClassScheme::default()).unwrap();
        let names: Vec<&str> = files.iter().map(|f| f.0.to_str().unwrap()).collect();
        assert_eq!(names, ["x/a.obj", "x/a.mtl", "x/a.jpg"]);
        let text = |i: usize| String::from_utf8(files[i].1.clone()).unwrap();
        assert!(text(0).starts_with("mtllib a.mtl\nv 0 0 100\n"), "{}", text(0));
        assert!(
            text(0).ends_with("vt 0 0.5\nusemtl terrain\nf 1/1 3/3 4/4\nusemtl roof\nf 1/1 2/2 3/3\n"),
            "{}",
            text(0)
        );
        assert_eq!(text(1).matches("map_Kd a.jpg\n").count(), 2);
        assert_eq!(files[2].1, paint.jpeg);
    }

    #[test]
    fn a_glb_splits_vertices_by_place_in_the_picture_and_class() {
        let (mesh, mut paint) = square();
        paint.corner_uvs[1][0] = Vec2::ONE;
        let content = content(&mesh, &paint);
        assert_eq!((content.positions.len(), content.uvs.len()), (6, 6));
        content.check(&ClassScheme::default()).unwrap();
    }

    #[test]
    fn coordinates_that_do_not_fit_the_mesh_are_our_bug() {
        let (mesh, mut paint) = square();
        paint.corner_uvs.pop();
        let all = [Format::Ply, Format::Obj, Format::Glb];
        for format in all {
            let error = files(&mesh, &paint, Path::new("a"), format, &ClassScheme::default()).unwrap_err();
            assert_eq!(error.exit_code(), 7);
        }
    }

    #[test]
    fn files_of_others_beside_an_obj_stay() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("a.obj");
        admit_beside(&out, Format::Obj, &[]).unwrap();
        let picture = folder.path().join("a.jpg");
        std::fs::write(&picture, b"").unwrap();
        assert!(admit_beside(&out, Format::Obj, &[]).unwrap_err().to_string().contains("a.jpg"));
        admit_beside(&out, Format::Glb, &[]).unwrap();
        std::fs::write(&out, b"").unwrap();
        admit_beside(&out, Format::Obj, &[]).unwrap();
        assert!(admit_beside(&out, Format::Obj, &[picture]).is_err());
    }
}
