//! Tilesets of others, valid and invalid ones: walked and loaded to the end, or refused by a reason that is counted.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rooftile::audit::read::{self, Tileset};
use rooftile::audit::structure::{self, StructureConfig};
use rooftile::report::Reporter;

use crate::common::{data, town};

/// Nothing in the corpus is larger than a few hundred kB; a tileset that takes this long is a hang.
const MOST_TIME: Duration = Duration::from_secs(10);

/// What became of tilesets and their contents, by reason.
#[derive(Debug, Default)]
struct Counts {
    tilesets: BTreeMap<String, usize>,
    contents: BTreeMap<String, usize>,
    warnings: BTreeMap<String, u64>,
    triangles: usize,
    tiles: usize,
}

fn files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            files(&path, found);
        } else {
            found.push(path);
        }
    }
}

/// Loads every tile; what is loaded must be sound.
fn load_all(tileset: &Tileset, counts: &mut Counts) -> Result<(), String> {
    let reporter = Reporter::new(true);
    for (id, tile) in tileset.tiles.iter().enumerate() {
        if tile.parent.is_some_and(|parent| parent >= id) || tile.children.iter().any(|&child| child <= id) {
            return Err(format!("{} comes before its parent", tileset.trail(id)));
        }
        for content in (0..tile.contents.len()).filter(|&c| !tile.contents[c].is_tileset) {
            match tileset.load_content(id, content, &reporter) {
                Ok(meshes) => {
                    *counts.contents.entry("read".into()).or_default() += 1;
                    for mesh in meshes {
                        counts.triangles += mesh.faces.len();
                        let vertices = mesh.positions.len() as u32;
                        let is_sound = mesh.faces.iter().flatten().all(|&v| v < vertices)
                            && mesh.positions.iter().all(|p| p.is_finite())
                            && (mesh.uvs.is_empty() || mesh.uvs.len() == mesh.positions.len())
                            && mesh.parts.iter().map(|part| part.faces.len()).sum::<usize>() == mesh.faces.len()
                            && mesh.classes.as_ref().is_none_or(|c| c.of_face.len() == mesh.faces.len());
                        if !is_sound {
                            return Err(format!("{}: the mesh is not sound", tileset.trail(id)));
                        }
                    }
                }
                Err(refusal) => *counts.contents.entry(refusal.code.into()).or_default() += 1,
            }
        }
    }
    counts.tiles += tileset.tiles.len();
    for warning in tileset.warnings.iter().chain(&reporter.warnings()) {
        *counts.warnings.entry(warning.code.into()).or_default() += warning.count;
    }
    Ok(())
}

fn try_file(path: &Path, counts: &mut Counts) -> Result<(), String> {
    let begun = Instant::now();
    let outcome = match read::open(path) {
        Ok(tileset) => {
            let loaded = load_all(&tileset, counts);
            *counts.tilesets.entry("read".into()).or_default() += 1;
            loaded
        }
        Err(error) => {
            let said = error.to_string();
            let reason = ["no tileset", "no root", "archive", "not there"].into_iter().find(|r| said.contains(r));
            *counts.tilesets.entry(reason.unwrap_or("other").into()).or_default() += 1;
            Ok(())
        }
    };
    match outcome {
        Ok(()) if begun.elapsed() > MOST_TIME => Err(format!("took {:?}", begun.elapsed())),
        other => other.map_err(|what| format!("{}: {what}", path.display())),
    }
}

#[test]
fn a_thousand_odd_tilesets_are_read_or_refused_by_a_reason() {
    let Some(folder) = data("nasty").map(|folder| folder.join("3d-tiles-validator")) else { return };
    let mut found = Vec::new();
    files(&folder, &mut found);
    found.sort();
    assert!(found.len() > 900, "only {} files", found.len());
    let mut counts = Counts::default();
    let faults: Vec<String> = found.iter().filter_map(|path| try_file(path, &mut counts).err()).collect();
    eprintln!("{counts:#?}");
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

/// Every file of the corpus as the only content of a tileset: glTF, b3dm and worse, under any name.
#[test]
fn any_odd_file_may_be_a_content() {
    let Some(folder) = data("nasty") else { return };
    let mut found = Vec::new();
    for name in ["3d-tiles-validator", "gltf-validator", "assimp", "obj2gltf"] {
        files(&folder.join(name), &mut found);
    }
    found.sort();
    let mut counts = Counts::default();
    let mut faults = Vec::new();
    for path in &found {
        let temp = tempfile::tempdir().expect("a folder");
        let name = path.file_name().unwrap_or_default().to_string_lossy().replace(['%', '#', '?'], "_");
        let copy = temp.path().join(format!("x.{name}.b3dm"));
        std::fs::copy(path, &copy).expect("a copy");
        let json = serde_json::json!({
            "asset": { "version": "1.1" }, "geometricError": 1,
            "root": { "boundingVolume": { "sphere": [0, 0, 0, 1] }, "geometricError": 0,
                      "content": { "uri": copy.file_name().map(|n| n.to_string_lossy().into_owned()) } }
        });
        std::fs::write(temp.path().join("tileset.json"), json.to_string()).expect("a file");
        faults.extend(try_file(temp.path(), &mut counts).err());
    }
    eprintln!("{counts:#?}");
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn our_own_tileset_is_read_whole_with_its_classes() {
    let mut counts = Counts::default();
    let tileset = read::open(&town::town().folder).expect("a tileset");
    load_all(&tileset, &mut counts).expect("sound meshes");
    assert_eq!(counts.contents.keys().collect::<Vec<_>>(), ["read"], "{counts:?}");
    assert!(counts.warnings.is_empty(), "{counts:?}");
    let meshes = tileset.load(1, &Reporter::new(true)).expect("a tile");
    let classes = meshes[0].classes.as_ref().expect("classes");
    assert!(classes.names.iter().any(|name| name == "roof"), "{:?}", classes.names);
    assert!(classes.of_face.iter().all(|&class| usize::from(class) < classes.names.len()));
    let found = structure::measure(&tileset, &StructureConfig::default(), &Reporter::new(true)).expect("not cancelled");
    assert_eq!(found.findings, []);
    assert!(found.levels.windows(2).all(|pair| pair[0].error_m[1] > pair[1].error_m[1]), "{:?}", found.levels);
}

/// Every tileset below the folder that `ROOFTILE_TILESETS` names; at least 19 of 20 contents have to be read.
#[test]
fn tilesets_named_by_the_environment_are_read() {
    let Some(folder) = std::env::var_os("ROOFTILE_TILESETS").map(PathBuf::from) else {
        eprintln!("SKIPPED: ROOFTILE_TILESETS names no folder of tilesets");
        return;
    };
    let mut found = Vec::new();
    files(&folder, &mut found);
    let is_root = |path: &PathBuf| {
        path.file_name().is_some_and(|n| n == "tileset.json") || path.extension().is_some_and(|e| e == "3tz")
    };
    found.retain(is_root);
    found.sort();
    let (mut contents, mut refused) = (0, 0);
    for path in &found {
        let reporter = Reporter::new(true);
        let tileset = match read::open(path) {
            Ok(tileset) => tileset,
            Err(error) => {
                eprintln!("{}: {error}", path.display());
                continue;
            }
        };
        let begun = Instant::now();
        let found = structure::measure(&tileset, &StructureConfig::default(), &reporter).expect("not cancelled");
        let has_mesh = tileset.tiles.iter().filter(|tile| tile.has_mesh()).count();
        let mut reasons: BTreeMap<&str, usize> = BTreeMap::new();
        found
            .tiles
            .iter()
            .filter_map(|figures| figures.refused)
            .for_each(|code| *reasons.entry(code).or_default() += 1);
        let mut findings: BTreeMap<&str, (usize, f64)> = BTreeMap::new();
        for finding in &found.findings {
            let entry = findings.entry(finding.code).or_default();
            *entry = (entry.0 + 1, entry.1.max(finding.amount));
        }
        contents += has_mesh;
        refused += reasons.values().sum::<usize>();
        eprintln!(
            "{}: {} tiles, {has_mesh} with content, refused {reasons:?}, findings {findings:?}, {:?}",
            path.display(),
            tileset.tiles.len(),
            begun.elapsed()
        );
        for warning in tileset.warnings.iter().chain(&reporter.warnings()) {
            eprintln!("    {} × {}: {}: {}", warning.count, warning.code, warning.first_path.display(), warning.first);
        }
        for level in &found.levels {
            eprintln!("    {level:?}");
        }
    }
    assert!(refused * 20 <= contents, "{refused} of {contents} tiles were refused");
}
