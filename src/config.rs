//! Every setting of a build, in one tree, and how its layers are merged: defaults, then a preset, then a file, then
//! `--set key=value`. In every layer `budget.NAME` is short for the budget of one class.

use std::path::Path;

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::classes::{ClassesConfig, scheme};
use crate::collapse::CollapseConfig;
use crate::ids::ClassScheme;
use crate::mesh::GateConfig;
use crate::planes::PlanesConfig;
use crate::preset::Preset;
use crate::texture::TextureConfig;
use crate::tiles::LevelsConfig;
use crate::{Error, Result};

/// All settings that change the bytes of a build. Threads, paths and progress are not among them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The gate: welding and cleaning.
    pub gate: GateConfig,
    /// Planar regions.
    pub planes: PlanesConfig,
    /// Classification.
    pub classify: ClassesConfig,
    /// Simplification.
    pub collapse: CollapseConfig,
    /// The hierarchy.
    pub levels: LevelsConfig,
    /// Atlases.
    pub texture: TextureConfig,
    /// The files written.
    pub write: WriteConfig,
    /// Classes, their budgets in metres, their colours.
    pub classes: ClassScheme,
}

/// What is written into tiles and tileset.json.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WriteConfig {
    /// KHR_mesh_quantization and EXT_meshopt_compression. Default: false.
    pub compress: bool,
    /// A primitive per class instead of one draw call a tile. Default: false.
    pub primitives_per_class: bool,
    /// Vertex normals, for lit renderers. Default: false.
    pub normals: bool,
    /// k in `geometricError` = max(geometry, k·texel): the screen-space error, in pixels, of the viewer the tileset is
    /// for. Default: 16, CesiumJS's own; use 1 or 2 for viewers that ask for one or two pixels.
    pub texel_factor: f64,
    /// A simplified tile's texture shrinks until the file has at most this many bytes. Default: 1 500 000.
    pub tile_bytes: u64,
    /// The same of the root, the first thing a viewer loads. Default: 500 000.
    pub root_bytes: u64,
    /// Credit to show, added to any found in the input.
    pub copyright: String,
}

impl Default for WriteConfig {
    fn default() -> Self {
        Self {
            compress: false,
            primitives_per_class: false,
            normals: false,
            texel_factor: 16.0,
            tile_bytes: 1_500_000,
            root_bytes: 500_000,
            copyright: String::new(),
        }
    }
}

/// More classes than this do not fit a feature id byte with room to spare.
const MOST_CLASSES: usize = 32;
/// Budgets at scale 1, metres.
const BUDGETS_M: std::ops::RangeInclusive<f64> = 1e-4..=1e3;

impl Config {
    /// Merges the layers without a preset and checks the result.
    ///
    /// # Errors
    /// Those of [`Self::layered_on`].
    pub fn layered(file: Option<&Path>, sets: &[String]) -> Result<Self> {
        Self::layered_on(None, file, sets)
    }

    /// Merges the layers, a later one over an earlier one, and checks the result.
    ///
    /// # Errors
    /// A file that cannot be read or parsed, an unknown key, a value of the wrong type, or settings out of range: all
    /// of them in one message.
    pub fn layered_on(preset: Option<&Preset>, file: Option<&Path>, sets: &[String]) -> Result<Self> {
        let mut merged = Table::try_from(Self::default()).map_err(|e| Error::Bug(format!("defaults: {e}")))?;
        for (key, value) in preset.into_iter().flat_map(|p| p.settings) {
            layer(&mut merged, parse_set(&format!("{key}={value}"))?)?;
        }
        if let Some(path) = file {
            let text = std::fs::read_to_string(path)
                .map_err(|e| Error::Config(format!("--config {}: cannot be read: {e}", path.display())))?;
            let table: Table = text
                .parse()
                .map_err(|e: toml::de::Error| Error::Config(format!("{}: {}", path.display(), e.message())))?;
            layer(&mut merged, table)?;
        }
        for set in sets {
            layer(&mut merged, parse_set(set)?)?;
        }
        let config: Self = Value::Table(merged).try_into().map_err(|e: toml::de::Error| {
            Error::Config(format!(
                "settings: {}; --dump-config prints every setting with its default",
                e.message().trim()
            ))
        })?;
        config.check()?;
        Ok(config)
    }

    /// Sets budgets from `NAME=METRES,…`, the names those of the classes, and checks the result.
    ///
    /// # Errors
    /// A name that no class has, one that is there twice, or a value that is no length in range.
    pub fn set_budgets(&mut self, text: &str) -> Result<()> {
        let mut seen = Vec::new();
        for part in text.split(',') {
            let names: Vec<&str> = self.classes.0.iter().map(|c| c.name.as_str()).collect();
            let refuse = |what: String| {
                let names = names.join(", ");
                Error::Config(format!("--budget {text}: {what}; wanted NAME=METRES,… with the names {names}"))
            };
            let (name, value) =
                part.split_once('=').ok_or_else(|| refuse(format!("{:?} has no value", part.trim())))?;
            let (name, value) = (name.trim(), value.trim());
            let id = self.classes.id(name).ok_or_else(|| refuse(format!("there is no class {name:?}")))?;
            let metres = value.parse::<f64>().ok().filter(|m| BUDGETS_M.contains(m));
            let budget_m = metres.ok_or_else(|| {
                refuse(format!("{value:?} is not {} to {} metres", BUDGETS_M.start(), BUDGETS_M.end()))
            })?;
            if seen.contains(&id) {
                return Err(refuse(format!("{name} is there twice")));
            }
            seen.push(id);
            self.classes.0[id.index()].budget_m = budget_m;
        }
        self.check()
    }

    /// As TOML, every setting.
    ///
    /// # Errors
    /// Never in practice: the tree serialises.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|e| Error::Bug(format!("settings: {e}")))
    }

    /// Lists every setting out of its range.
    ///
    /// # Errors
    /// [`Error::Config`] naming all of them.
    pub fn check(&self) -> Result<()> {
        let mut faults = self.levels.faults();
        faults.extend(self.planes.check());
        faults.extend(self.classify.check());
        if let Err(error) = self.texture.check() {
            faults.push(error.to_string());
        }
        if !(0.0..=1.0).contains(&self.gate.weld_m) {
            faults.push(format!("gate.weld_m is {} m, wanted 0 to 1", self.gate.weld_m));
        }
        if self.collapse.block_faces < 1000 {
            faults.push(format!("collapse.block_faces is {}, wanted at least 1000", self.collapse.block_faces));
        }
        if !(0.1..=1000.0).contains(&self.write.texel_factor) {
            faults.push(format!("write.texel_factor is {}, wanted 0.1 to 1000", self.write.texel_factor));
        }
        self.check_classes(&mut faults);
        if faults.is_empty() { Ok(()) } else { Err(Error::Config(format!("settings: {}", faults.join("; ")))) }
    }

    fn check_classes(&self, faults: &mut Vec<String>) {
        let scheme = &self.classes;
        if !(1..=MOST_CLASSES).contains(&scheme.len()) {
            faults.push(format!("{} classes, wanted 1 to {MOST_CLASSES}", scheme.len()));
        }
        let table = self.classify.table();
        let also = table.map_or(&[][..], |table| &table.classes);
        faults.extend(scheme::faults(scheme, also));
        if let Some(table) = table {
            faults.extend(table.faults(|name| scheme.id(name).is_some() || scheme::BASE.contains(&name)));
        }
        for class in &scheme.0 {
            if !BUDGETS_M.contains(&class.budget_m) {
                faults.push(format!("the budget of {} is {} m, wanted 0.0001 to 1000", class.name, class.budget_m));
            }
        }
    }
}

/// `a.b=value`, the value as in TOML, or a bare word as text.
fn parse_set(set: &str) -> Result<Table> {
    let wanted = || Error::Config(format!("--set {set}: wanted KEY=VALUE, for instance levels.leaf_faces=20000"));
    let (key, value) = set.split_once('=').ok_or_else(wanted)?;
    let (key, value) = (key.trim(), value.trim());
    if key.is_empty() || !key.chars().all(|c| c.is_ascii_alphanumeric() || "._-".contains(c)) {
        return Err(wanted());
    }
    let as_toml = format!("{key} = {value}");
    let as_text = || format!("{key} = {}", Value::String(value.to_owned()));
    as_toml.parse().or_else(|_| as_text().parse()).map_err(|_: toml::de::Error| wanted())
}

/// One layer over those before it; `budget.NAME` goes to the class of that name.
fn layer(into: &mut Table, mut from: Table) -> Result<()> {
    let budgets = from.remove("budget");
    merge(into, from)?;
    let Some(budgets) = budgets else { return Ok(()) };
    let classes = into.get_mut("classes").and_then(Value::as_array_mut);
    let (Value::Table(budgets), Some(classes)) = (budgets, classes) else {
        return Err(Error::Config("settings: budget is a group of settings; set budget.NAME".into()));
    };
    for (name, value) in budgets {
        let named = |c: &&mut Value| c.get("name").and_then(Value::as_str) == Some(&name);
        let class = classes.iter_mut().find(named).and_then(Value::as_table_mut);
        let metres = value.as_float().or(value.as_integer().map(|i| i as f64));
        let (Some(class), Some(metres)) = (class, metres) else {
            return Err(Error::Config(format!("settings: budget.{name} = {value}: wanted a class and metres")));
        };
        class.insert("budget_m".into(), Value::Float(metres));
    }
    Ok(())
}

fn merge(into: &mut Table, from: Table) -> Result<()> {
    for (key, value) in from {
        match (into.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above)) => merge(below, above)?,
            (Some(Value::Table(_)), value) => {
                return Err(Error::Config(format!(
                    "settings: {key} is a group of settings, not {value}; set {key}.NAME"
                )));
            }
            (_, value) => {
                into.insert(key, value);
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(pairs: &[&str]) -> Result<Config> {
        Config::layered(None, &pairs.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn later_layers_win_and_the_rest_keeps_its_default() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "[levels]\nleaf_faces = 1000\ntile_faces = 2000\n").unwrap();
        let config =
            Config::layered(Some(file.path()), &["levels.leaf_faces=3000".into(), "write.copyright=City of X".into()])
                .unwrap();
        assert_eq!((config.levels.leaf_faces, config.levels.tile_faces), (3000, 2000));
        assert_eq!(config.write.copyright, "City of X");
        assert_eq!(config.gate, GateConfig::default());
    }

    #[test]
    fn a_dumped_config_reads_back_as_itself() {
        let config = set(&["write.compress=true"]).unwrap();
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), config.to_toml().unwrap()).unwrap();
        assert_eq!(Config::layered(Some(file.path()), &[]).unwrap(), config);
    }

    const SPLIT: &str = r#"
[[classes]]
name = "terrain"
budget_m = 0.1
color = [166, 124, 82]
[[classes]]
name = "building"
of = ["facade", "roof"]
budget_m = 0.05
color = [58, 104, 190]
[[classes]]
name = "vegetation"
of = ["clutter"]
when = [{ feature = "greenness", above = 10.0, width = 5.0 }]
budget_m = 0.2
color = [86, 158, 74]
[[classes]]
name = "clutter"
budget_m = 0.1
color = [120, 120, 120]
"#;

    #[test]
    fn a_scheme_of_its_own_is_read_checked_and_dumped() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), SPLIT).unwrap();
        let config = Config::layered(Some(file.path()), &[]).unwrap();
        assert_eq!((config.classes.len(), config.classes.0[2].when.len()), (4, 1));
        std::fs::write(file.path(), config.to_toml().unwrap()).unwrap();
        assert_eq!(Config::layered(Some(file.path()), &[]).unwrap(), config);
        std::fs::write(file.path(), SPLIT.replace("[\"clutter\"]", "[\"cluter\"]")).unwrap();
        let message = Config::layered(Some(file.path()), &[]).unwrap_err().to_string();
        assert!(message.contains("cluter"), "{message}");
    }

    #[test]
    fn a_table_of_its_own_is_read_checked_and_dumped() {
        let table = crate::classes::paper::Table::embedded("cgal").unwrap();
        let mut config = set(&["classify.classifier=cgal"]).unwrap();
        config.classify.table = Some(table.clone());
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), config.to_toml().unwrap()).unwrap();
        assert_eq!(Config::layered(Some(file.path()), &[]).unwrap(), config);
        config.classify.table.as_mut().unwrap().rows[0].effects = "F F".into();
        assert!(config.check().unwrap_err().to_string().contains("\"F F\""));
    }

    #[test]
    fn presets_lie_below_the_file_and_the_file_below_set_and_set_below_flags() {
        use crate::preset::PRESETS;
        for preset in &PRESETS {
            Config::layered_on(Some(preset), None, &[]).unwrap();
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "[budget]\nterrain = 3\nroof = 3.0\n[levels]\nkeep_tops = false\n").unwrap();
        let flight = Preset::of("flight");
        assert!(Config::layered_on(flight, None, &[]).unwrap().levels.keep_tops);
        let mut config = Config::layered_on(flight, Some(file.path()), &["budget.roof=4".into()]).unwrap();
        assert!(!config.levels.keep_tops);
        config.set_budgets("facade=5").unwrap();
        let budgets: Vec<f64> = config.classes.0.iter().map(|c| c.budget_m).collect();
        assert_eq!(budgets, [3.0, 5.0, 4.0, 0.1]);
    }

    #[test]
    fn a_budget_that_makes_no_sense_is_a_usage_error_that_names_the_classes() {
        for wrong in ["", "roof", "roof=", "roof=-1", "roof=nan", "roof=0.05,roof=0.06", "dach=0.05", "roof=0.05,"] {
            let error = Config::default().set_budgets(wrong).unwrap_err();
            assert_eq!(error.exit_code(), 2);
            assert!(error.to_string().contains("terrain, facade, roof, clutter"), "{error}");
        }
        assert_eq!(set(&["budget.dach=1"]).unwrap_err().exit_code(), 2);
        assert_eq!(set(&["budget=1"]).unwrap_err().exit_code(), 2);
    }

    #[test]
    fn every_fault_is_named_at_once() {
        let message = set(&["levels.step_ratio=9", "gate.weld_m=-1"]).unwrap_err().to_string();
        assert!(message.contains("step_ratio") && message.contains("weld_m"), "{message}");
        for (bad, word) in [("levels.leaf_face=3", "leaf_face"), ("levels=3", "levels"), ("nonsense", "KEY=VALUE")] {
            let error = set(&[bad]).unwrap_err();
            assert!(error.to_string().contains(word) && error.exit_code() == 2, "{error}");
        }
    }
}
