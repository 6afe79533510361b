//! Finds the mesh files of an input and what says where on Earth they are.
//!
//! In: what the user named: files or folders. Out: [`Found`]. Knows three layouts: a tiled export
//! (`Data/Tile_+000_+000/*.obj` beside `metadata.xml`), an ODM project or its `odm_texturing`, and any folder.
//! Symbolic links inside a folder are not followed: what they show is either found anyway or lies outside.

use std::collections::{BTreeMap, HashSet};
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use crate::report::Reporter;
use crate::{Error, Result};

/// Endings that are read, best first where one model is there several times.
const ENDINGS: [&str; 4] = ["obj", "glb", "gltf", "ply"];
/// How deep folders are searched.
const MAX_DEPTH: usize = 16;
/// How many folders above a mesh its `metadata.xml` may lie: `Data/Tile_+000_+000/x.obj` has two.
const METADATA_LEVELS: usize = 3;

/// The files of an input.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Found {
    /// Mesh files, sorted, each once.
    pub files: Vec<PathBuf>,
    /// Per file, the folder whose inside it may refer to: the folder the user named, or the file's own.
    pub roots: Vec<PathBuf>,
    /// The folder that holds all `roots`.
    pub root: PathBuf,
    /// `metadata.xml` of a tiled export.
    pub metadata_xml: Option<PathBuf>,
    /// ODM's `coords.txt` or `odm_georeferencing_model_geo.txt`.
    pub odm_coords: Option<PathBuf>,
}

/// Finds the mesh files that `inputs` mean.
///
/// Warnings: `coarser-levels-skipped`, `same-model-skipped`, `link-skipped`, `too-deep`, `odm-not-georeferenced`.
///
/// # Errors
/// [`Error::Input`] if there is no mesh, or files that say different things of where the meshes are;
/// [`Error::Unsupported`] for a file of another kind; [`Error::Io`].
pub fn discover(inputs: &[PathBuf], reporter: &Reporter) -> Result<Found> {
    if inputs.is_empty() {
        return Err(Error::Config(format!("no input; name a mesh file ({}) or a folder of them", endings())));
    }
    let mut pairs = Vec::new();
    for input in inputs {
        let kind = fs::metadata(input).map_err(Error::io("read", input))?;
        if kind.is_dir() {
            let files = in_folder(input, reporter)?;
            if files.is_empty() {
                let what = format!(
                    "no mesh found; looked for files ending in {} here and up to {MAX_DEPTH} folders below",
                    endings()
                );
                return Err(Error::input(input, what));
            }
            pairs.extend(files.into_iter().map(|file| (file, input.clone())));
        } else if ending(input).is_none() {
            let what = format!("is of a kind that is not read; wanted is a file ending in {}, or a folder", endings());
            return Err(Error::Unsupported { path: input.clone(), what });
        } else if !kind.is_file() {
            return Err(Error::input(input, "is a pipe or a device; a regular file is wanted"));
        } else {
            pairs.push((input.clone(), parent(input).to_path_buf()));
        }
    }
    pairs.sort();
    let mut seen = HashSet::new();
    pairs.retain(|(file, _)| seen.insert(fs::canonicalize(file).unwrap_or_else(|_| file.clone())));
    let (files, roots): (Vec<_>, Vec<_>) = pairs.into_iter().unzip();
    let metadata_xml = one_of(metadata_of(&files))?;
    let odm_coords = one_of(coords_of(&files, reporter))?;
    let root = common_folder(&roots)?;
    Ok(Found { files, roots, root, metadata_xml, odm_coords })
}

/// `obj`, `glb`, … in lower case if `path` ends in one that is read.
pub fn ending(path: &Path) -> Option<&'static str> {
    let found = path.extension()?;
    ENDINGS.into_iter().find(|known| found.eq_ignore_ascii_case(known))
}

fn endings() -> String {
    ENDINGS.map(|e| format!(".{e}")).join(", ")
}

fn parent(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

fn in_folder(folder: &Path, reporter: &Reporter) -> Result<Vec<PathBuf>> {
    for texturing in [folder.to_path_buf(), folder.join("odm_texturing")] {
        for name in ["odm_textured_model_geo", "odm_textured_model"] {
            for ending in ["obj", "glb"] {
                let file = texturing.join(name).with_extension(ending);
                if file.is_file() {
                    return Ok(vec![file]);
                }
            }
        }
    }
    let mut files = Vec::new();
    walk(folder, 0, &mut files, reporter)?;
    files.sort();
    Ok(finest(best_ending(files, reporter), reporter))
}

fn walk(folder: &Path, depth: usize, files: &mut Vec<PathBuf>, reporter: &Reporter) -> Result<()> {
    reporter.check()?;
    if depth > MAX_DEPTH {
        reporter.warn("too-deep", folder, format!("lies more than {MAX_DEPTH} folders deep and is not searched"));
        return Ok(());
    }
    for entry in fs::read_dir(folder).map_err(Error::io("read", folder))? {
        let entry = entry.map_err(Error::io("read", folder))?;
        let path = entry.path();
        // Hidden files: `._x.obj` is what one system leaves beside every `x.obj`.
        if entry.file_name().as_encoded_bytes().starts_with(b".") {
            continue;
        }
        let kind = entry.file_type().map_err(Error::io("read", &path))?;
        if kind.is_dir() {
            walk(&path, depth + 1, files, reporter)?;
        } else if ending(&path).is_some() && kind.is_file() {
            files.push(path);
        } else if kind.is_symlink() && (ending(&path).is_some() || path.is_dir()) {
            reporter.warn("link-skipped", &path, "is a symbolic link; name what it points to as an input to read it");
        }
    }
    Ok(())
}

/// Of files that differ only in their ending, the one read best.
fn best_ending(files: Vec<PathBuf>, reporter: &Reporter) -> Vec<PathBuf> {
    let rank = |file: &Path| ENDINGS.iter().position(|known| Some(*known) == ending(file));
    let mut best: BTreeMap<PathBuf, PathBuf> = BTreeMap::new();
    for file in &files {
        let kept = best.entry(file.with_extension("")).or_insert_with(|| file.clone());
        if rank(file) < rank(kept) {
            *kept = file.clone();
        }
    }
    let (kept, skipped): (Vec<_>, Vec<_>) =
        files.into_iter().partition(|file| best.get(&file.with_extension("")) == Some(file));
    for file in &skipped {
        reporter.warn("same-model-skipped", file, "lies beside a file of the same name in a format read in its place");
    }
    kept
}

/// Of each tile, the files of the finest level: those without a level, else those of the highest.
fn finest(files: Vec<PathBuf>, reporter: &Reporter) -> Vec<PathBuf> {
    let mut best: BTreeMap<(PathBuf, String), u32> = BTreeMap::new();
    let key = |file: &Path| {
        let (tile, level) = tile_level(file.file_stem()?)?;
        Some(((parent(file).to_path_buf(), tile), level))
    };
    for (tile, level) in files.iter().filter_map(|file| key(file)) {
        let finest = best.entry(tile).or_insert(level);
        *finest = level.max(*finest);
    }
    let (kept, skipped): (Vec<_>, Vec<_>) =
        files.into_iter().partition(|file| key(file).is_none_or(|(tile, level)| best.get(&tile) == Some(&level)));
    for file in &skipped {
        let what = "is a coarser level of a tile; only the finest is read, levels of detail are made anew";
        reporter.warn("coarser-levels-skipped", file, what);
    }
    kept
}

/// `Tile_+001_-002_L17_0` is level 17 of `TILE_+001_-002`; a name without level is the finest.
fn tile_level(stem: &OsStr) -> Option<(String, u32)> {
    let stem = stem.to_str()?.to_ascii_uppercase();
    let mut parts = stem.split('_');
    let is_number = |part: &str| {
        let digits = part.strip_prefix(['+', '-']).unwrap_or(part);
        !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit())
    };
    let (tile, column, row) = (parts.next()?, parts.next()?, parts.next()?);
    if tile != "TILE" || !is_number(column) || !is_number(row) {
        return None;
    }
    let level = match parts.next() {
        None => u32::MAX,
        Some(part) => part.strip_prefix('L')?.parse().ok()?,
    };
    Some((format!("{tile}_{column}_{row}"), level))
}

/// The nearest `metadata.xml` of every file, each once.
fn metadata_of(files: &[PathBuf]) -> Vec<PathBuf> {
    let nearest = |folder: &PathBuf| {
        let full = fs::canonicalize(folder).unwrap_or_else(|_| folder.clone());
        full.ancestors().take(METADATA_LEVELS).map(|f| f.join("metadata.xml")).find(|f| f.is_file())
    };
    distinct(folders(files).iter().filter_map(nearest))
}

/// The nearest ODM offset of every file, each once.
fn coords_of(files: &[PathBuf], reporter: &Reporter) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for file in files {
        let folder = fs::canonicalize(parent(file)).unwrap_or_else(|_| parent(file).to_path_buf());
        let names = ["coords.txt", "odm_georeferencing_model_geo.txt"];
        let in_folder = |folder: &Path| names.iter().map(|name| folder.join(name)).find(|f| f.is_file());
        let of_project = || in_folder(&parent(&folder).join("odm_georeferencing"));
        let Some(coords) = in_folder(&folder).or_else(of_project) else { continue };
        // The plain model is in the frame of the reconstruction, to which the offset does not belong.
        if file.file_stem() == Some(OsStr::new("odm_textured_model")) {
            let what = "is not georeferenced, so the project's coordinates are not used; wanted is \
                        odm_textured_model_geo.obj";
            reporter.warn("odm-not-georeferenced", file, what);
            continue;
        }
        found.push(coords);
    }
    distinct(found.into_iter())
}

fn folders(files: &[PathBuf]) -> Vec<PathBuf> {
    distinct(files.iter().map(|file| parent(file).to_path_buf()))
}

fn distinct(paths: impl Iterator<Item = PathBuf>) -> Vec<PathBuf> {
    let mut paths: Vec<_> = paths.collect();
    paths.sort();
    paths.dedup();
    paths
}

/// The first of files that must all say the same.
fn one_of(candidates: Vec<PathBuf>) -> Result<Option<PathBuf>> {
    let Some((first, others)) = candidates.split_first() else { return Ok(None) };
    if !others.is_empty() {
        let text = fs::read(first).map_err(Error::io("read", first))?;
        for other in others {
            if fs::read(other).map_err(Error::io("read", other))? != text {
                let what = format!(
                    "says something else than {}, and both belong to this input; convert their meshes one by one",
                    first.display()
                );
                return Err(Error::input(other, what));
            }
        }
    }
    Ok(Some(first.clone()))
}

fn common_folder(roots: &[PathBuf]) -> Result<PathBuf> {
    let mut roots = distinct(roots.iter().cloned()).into_iter();
    let Some(first) = roots.next() else { return Ok(PathBuf::new()) };
    if roots.len() == 0 {
        return Ok(first);
    }
    let mut common = fs::canonicalize(&first).map_err(Error::io("read", &first))?;
    for root in roots {
        let root = fs::canonicalize(&root).map_err(Error::io("read", &root))?;
        while !root.starts_with(&common) {
            common.pop();
        }
    }
    Ok(common)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Tree(tempfile::TempDir);

    impl Tree {
        fn of(files: &[&str]) -> Self {
            let tree = Self(tempfile::tempdir().unwrap());
            for file in files {
                fs::create_dir_all(tree.path(file).parent().unwrap()).unwrap();
                fs::write(tree.path(file), file.rsplit('/').next().unwrap()).unwrap();
            }
            tree
        }

        fn path(&self, inner: &str) -> PathBuf {
            fs::canonicalize(self.0.path()).unwrap().join(inner)
        }

        fn find(&self, inputs: &[&str]) -> (Result<Found>, Vec<&'static str>) {
            let reporter = Reporter::new(true);
            let inputs: Vec<_> = inputs.iter().map(|input| self.path(input)).collect();
            let found = discover(&inputs, &reporter);
            (found, reporter.warnings().iter().map(|w| w.code).collect())
        }

        /// Files, metadata and coordinates relative to the tree; warnings.
        fn found(&self, inputs: &[&str]) -> (Vec<String>, Option<String>, Option<String>, Vec<&'static str>) {
            let (found, warnings) = self.find(inputs);
            let found = found.unwrap();
            let inner = |path: &PathBuf| path.strip_prefix(self.path("")).unwrap().to_str().unwrap().to_owned();
            let files = found.files.iter().map(inner).collect();
            (files, found.metadata_xml.as_ref().map(inner), found.odm_coords.as_ref().map(inner), warnings)
        }
    }

    #[test]
    fn one_file_in_any_case_is_its_folders_only_mesh() {
        let tree = Tree::of(&["a/X.OBJ", "a/y.obj"]);
        assert_eq!(tree.found(&["a/X.OBJ"]), (vec!["a/X.OBJ".into()], None, None, vec![]));
        let (found, _) = tree.find(&["a/X.OBJ"]);
        assert_eq!(found.unwrap().root, tree.path("a"));
    }

    #[test]
    fn a_tiled_export_is_found_from_its_root_its_data_folder_and_one_tile() {
        let tile = "p/Data/Tile_+000_+000/Tile_+000_+000.obj";
        let other = "p/Data/Tile_+000_+001/Tile_+000_+001.obj";
        let tree = Tree::of(&[tile, other, "p/metadata.xml"]);
        let metadata = Some("p/metadata.xml".to_owned());
        for input in ["p", "p/Data"] {
            assert_eq!(tree.found(&[input]), (vec![tile.into(), other.into()], metadata.clone(), None, vec![]));
        }
        for input in ["p/Data/Tile_+000_+000", tile] {
            assert_eq!(tree.found(&[input]), (vec![tile.into()], metadata.clone(), None, vec![]));
        }
    }

    #[test]
    fn only_the_finest_level_of_each_tile_is_kept() {
        let tree = Tree::of(&[
            "d/Tile_+000_+000_L9_0.obj",
            "d/Tile_+000_+000_L17_0.obj",
            "d/Tile_+000_+000_L17_1.obj",
            "d/Tile_+001_+000.obj",
            "d/Tile_+001_+000_L20.obj",
            "d/Tile_-001_+000_L3_0.obj",
            "d/Tile_+000_roof_L1.obj",
        ]);
        let expected = [
            "d/Tile_+000_+000_L17_0.obj",
            "d/Tile_+000_+000_L17_1.obj",
            "d/Tile_+000_roof_L1.obj",
            "d/Tile_+001_+000.obj",
            "d/Tile_-001_+000_L3_0.obj",
        ];
        let (files, _, _, warnings) = tree.found(&["d"]);
        assert_eq!((files, warnings), (expected.map(String::from).to_vec(), vec!["coarser-levels-skipped"]));
        assert_eq!(tree.found(&["d/Tile_+000_+000_L9_0.obj"]).0.len(), 1, "a file that is named is read");
    }

    #[test]
    fn an_odm_project_gives_its_georeferenced_model_and_offset() {
        let geo = "o/odm_texturing/odm_textured_model_geo.obj";
        let coords = "o/odm_georeferencing/coords.txt";
        let other = "o/odm_georeferencing/odm_georeferencing_model_geo.txt";
        let tree =
            Tree::of(&[geo, "o/odm_texturing/odm_textured_model.obj", "o/odm_meshing/odm_mesh.ply", coords, other]);
        for input in ["o", "o/odm_texturing", geo] {
            assert_eq!(tree.found(&[input]), (vec![geo.into()], None, Some(coords.into()), vec![]), "{input}");
        }
        fs::remove_file(tree.path(coords)).unwrap();
        assert_eq!(tree.found(&["o"]).2, Some(other.into()));
    }

    #[test]
    fn a_plain_odm_model_is_read_but_not_placed_by_coordinates_that_are_not_its_own() {
        let plain = "o/odm_texturing/odm_textured_model.obj";
        let tree = Tree::of(&[plain, "o/odm_georeferencing/coords.txt"]);
        assert_eq!(tree.found(&["o"]), (vec![plain.into()], None, None, vec!["odm-not-georeferenced"]));
    }

    #[test]
    fn coordinates_beside_any_mesh_are_picked_up() {
        let tree = Tree::of(&["m/x.obj", "m/coords.txt"]);
        assert_eq!(tree.found(&["m/x.obj"]).2, Some("m/coords.txt".into()));
    }

    #[test]
    fn any_other_folder_is_searched_in_depth_and_sorted_each_file_once() {
        let tree =
            Tree::of(&["f/b/2.glb", "f/a/1.PLY", "f/a/x.jpg", "f/3.obj", "f/3.ply", "f/.hid/4.obj", "f/._3.obj"]);
        let (files, _, _, warnings) = tree.found(&["f", "f/3.obj", "f/a/../3.obj"]);
        assert_eq!(files, ["f/3.obj", "f/a/1.PLY", "f/b/2.glb"]);
        assert_eq!(warnings, ["same-model-skipped"]);
    }

    #[test]
    fn several_files_share_the_folder_above_them_but_each_keeps_its_own_root() {
        let tree = Tree::of(&["f/a/1.obj", "f/b/2.obj"]);
        let found = tree.find(&["f/b/2.obj", "f/a/1.obj"]).0.unwrap();
        assert_eq!(found.roots, [tree.path("f/a"), tree.path("f/b")]);
        assert_eq!(found.root, tree.path("f"));
    }

    #[test]
    fn contradicting_metadata_is_an_error_and_equal_copies_are_not() {
        let tree = Tree::of(&["f/a/1.obj", "f/b/2.obj", "f/a/metadata.xml", "f/b/metadata.xml"]);
        assert_eq!(tree.found(&["f"]).1, Some("f/a/metadata.xml".into()));
        fs::write(tree.path("f/b/metadata.xml"), "other").unwrap();
        assert!(matches!(tree.find(&["f"]).0, Err(Error::Input { .. })));
    }

    #[test]
    fn nothing_found_says_what_was_looked_for() {
        let tree = Tree::of(&["f/x.txt"]);
        let error = tree.find(&["f"]).0.unwrap_err();
        assert!(error.to_string().contains(".obj, .glb, .gltf, .ply"), "{error}");
        assert_eq!(error.exit_code(), 3);
        assert!(matches!(tree.find(&["f/x.txt"]).0, Err(Error::Unsupported { .. })));
        assert!(matches!(tree.find(&["gone.obj"]).0, Err(Error::Io { .. })));
        assert!(matches!(tree.find(&[]).0, Err(Error::Config(_))));
    }

    #[cfg(unix)]
    #[test]
    fn symbolic_links_neither_loop_nor_lead_out() {
        use std::os::unix::fs::symlink;
        let tree = Tree::of(&["f/a/1.obj", "out/2.obj"]);
        symlink(tree.path("f"), tree.path("f/a/loop")).unwrap();
        symlink(tree.path("out/2.obj"), tree.path("f/2.obj")).unwrap();
        let (files, _, _, warnings) = tree.found(&["f"]);
        assert_eq!((files, warnings), (vec!["f/a/1.obj".to_owned()], vec!["link-skipped"]));
    }

    #[test]
    fn folders_deeper_than_the_limit_are_left_out_and_told() {
        let deep = format!("f/{}x.obj", "d/".repeat(MAX_DEPTH + 1));
        let tree = Tree::of(&["f/1.obj", &deep, &format!("f/{}y.obj", "d/".repeat(MAX_DEPTH))]);
        let (files, _, _, warnings) = tree.found(&["f"]);
        assert_eq!((files.len(), warnings), (2, vec!["too-deep"]));
    }
}
