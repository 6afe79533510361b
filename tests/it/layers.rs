//! Who may import whom, read off the source text: a judge must not know the builder, a stage not the file formats.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Modules, and what they must not import; tests are exempt.
const FORBIDDEN: [(&[&str], &[&str], &str); 11] = [
    (
        &["audit"],
        &["write", "tiles", "pipeline", "texture", "cli"],
        "the judge of anybody's tilesets knows nothing of the builder",
    ),
    (
        &["planes", "classes", "collapse"],
        &["input", "tiles", "texture", "write", "pipeline", "cli", "serve", "inspect", "demo", "config"],
        "stages behind the gate know meshes only",
    ),
    (
        &["inspect", "serve"],
        &["write", "tiles", "pipeline", "texture", "collapse", "classes", "planes", "mesh", "cli"],
        "judges are strangers: they read published files",
    ),
    (
        &["measure"],
        &[
            "input", "mesh", "planes", "classes", "collapse", "tiles", "texture", "write", "pipeline", "cli", "serve",
            "inspect", "demo", "config",
        ],
        "the judge of surfaces knows nothing of what made them",
    ),
    (
        &["geo", "ids", "error", "report"],
        &["input", "mesh", "planes", "classes", "collapse", "tiles", "texture", "write", "pipeline", "cli", "config"],
        "the ground floor knows nothing of what stands on it",
    ),
    (
        &["store"],
        &[
            "geo", "ids", "input", "mesh", "planes", "classes", "collapse", "tiles", "texture", "write", "pipeline",
            "cli",
        ],
        "the store keeps arrays, whatever they mean",
    ),
    (
        &["schema"],
        &["error", "report", "geo", "ids", "input", "mesh", "tiles", "texture", "write", "inspect", "serve", "cli"],
        "wire formats hold no logic",
    ),
    (
        &["input"],
        &["mesh", "planes", "classes", "collapse", "tiles", "texture", "write", "pipeline", "cli", "config"],
        "readers know nothing of what becomes of their output",
    ),
    (
        &["mesh", "texture", "tiles", "write", "demo"],
        &["pipeline", "cli", "config", "inspect", "serve"],
        "stages know neither their driver nor their judges",
    ),
    (
        &["write"],
        &["input", "mesh", "planes", "classes", "collapse", "tiles", "texture"],
        "the writer is given content",
    ),
    (&["pipeline", "config"], &["cli", "serve", "inspect"], "the library does not need its command line"),
];

fn sources() -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("src")];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") && stem != "tests" && !stem.ends_with("_tests") {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

/// The code of a file: no comments, no tests.
fn code(path: &Path) -> String {
    let text = std::fs::read_to_string(path).expect("a source file");
    let untested = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
    untested.lines().map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// The modules named after `crate::`, in groups too.
fn imports(code: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for (at, _) in code.match_indices("crate::") {
        let rest = &code[at + "crate::".len()..];
        let Some(group) = rest.strip_prefix('{') else {
            found.insert(name(rest));
            continue;
        };
        let mut depth = 0;
        let mut begins = true;
        for (i, c) in group.char_indices() {
            if begins && depth == 0 && !c.is_whitespace() {
                found.insert(name(&group[i..]));
            }
            begins = c == ',' || (begins && c.is_whitespace());
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                _ => {}
            }
        }
    }
    found.remove("");
    found
}

fn name(text: &str) -> String {
    text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
}

/// The top module of a file.
fn module(path: &Path) -> String {
    let inside = path.strip_prefix(Path::new(env!("CARGO_MANIFEST_DIR")).join("src")).expect("inside src");
    inside.components().next().map(|c| c.as_os_str().to_string_lossy().replace(".rs", "")).unwrap_or_default()
}

#[test]
fn the_reader_of_imports_sees_single_and_grouped_ones() {
    let text = "use crate::mesh::Mesh;\nuse crate::{Error, geo::{self, bvh::Bvh}, write};\nlet x = crate::tiles::of();";
    let found: Vec<String> = imports(text).into_iter().collect();
    assert_eq!(found, ["Error", "geo", "mesh", "tiles", "write"]);
}

#[test]
fn no_module_imports_what_it_must_not_know() {
    let mut by_module: BTreeMap<String, BTreeMap<String, PathBuf>> = BTreeMap::new();
    for path in sources() {
        let known = by_module.entry(module(&path)).or_default();
        imports(&code(&path)).into_iter().for_each(|name| {
            known.entry(name).or_insert_with(|| path.clone());
        });
    }
    let mut faults = Vec::new();
    for (modules, forbidden, why) in FORBIDDEN {
        for module in modules {
            let known = by_module.get(*module).unwrap_or_else(|| panic!("there is no module {module}"));
            for name in forbidden.iter().filter(|name| name != &module) {
                if let Some(path) = known.get(*name) {
                    faults.push(format!("{} imports {name}: {why}", path.display()));
                }
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn the_command_line_is_known_to_its_own_module_only() {
    for path in sources().into_iter().filter(|p| module(p) != "cli") {
        let code = code(&path);
        assert!(!code.contains("clap"), "{} speaks of clap", path.display());
        let is_program = module(&path) == "main";
        assert!(is_program || !imports(&code).contains("cli"), "{} imports cli", path.display());
    }
}

#[test]
fn the_schema_needs_serde_and_nothing_else() {
    for path in sources().into_iter().filter(|p| module(p) == "schema") {
        for line in code(&path).lines().filter_map(|l| l.trim().strip_prefix("use ")) {
            let root = name(line);
            let allowed = ["std", "serde", "serde_json", "super"].contains(&root.as_str());
            assert!(allowed, "{} uses {root}", path.display());
        }
    }
}
