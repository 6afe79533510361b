//! Presets: names for sets of settings, each defined by what it changes and nothing else.

/// A name for some settings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Preset {
    /// As typed.
    pub name: &'static str,
    /// What it is for, in a few words.
    pub purpose: &'static str,
    /// Keys and values that it changes, as for `--set`; `budget.NAME` is the budget of a class, metres.
    pub settings: &'static [(&'static str, &'static str)],
}

/// All of them.
pub const PRESETS: [Preset; 4] = [
    Preset {
        name: "draft",
        purpose: "a first look, quick and small",
        settings: &[
            ("budget.roof", "0.1"),
            ("budget.facade", "0.1"),
            ("budget.terrain", "0.2"),
            ("budget.clutter", "0.4"),
            ("levels.step_ratio", "4.0"),
            ("texture.max_atlas_px", "2048"),
            ("texture.jpeg_quality", "75"),
            ("texture.coarse_jpeg_quality", "65"),
            ("write.compress", "true"),
        ],
    },
    Preset {
        name: "city",
        purpose: "a city on the web: buildings sharp, ground and trees rough",
        settings: &[
            ("budget.roof", "0.05"),
            ("budget.facade", "0.05"),
            ("budget.terrain", "0.2"),
            ("budget.clutter", "0.2"),
            ("write.compress", "true"),
        ],
    },
    Preset {
        name: "survey",
        purpose: "measuring on screen: all classes alike, no rounding, fine textures",
        settings: &[
            ("budget.roof", "0.05"),
            ("budget.facade", "0.05"),
            ("budget.terrain", "0.05"),
            ("budget.clutter", "0.05"),
            ("texture.jpeg_quality", "95"),
            ("texture.coarse_jpeg_quality", "88"),
            ("write.compress", "false"),
        ],
    },
    Preset {
        name: "flight",
        purpose: "obstacles: tiles are raised until no roof or façade stands out by more than its budget",
        settings: &[
            ("budget.roof", "0.05"),
            ("budget.facade", "0.05"),
            ("budget.terrain", "0.1"),
            ("budget.clutter", "0.1"),
            ("levels.keep_tops", "true"),
            ("write.compress", "false"),
        ],
    },
];

impl Preset {
    /// The preset called `name`.
    pub fn of(name: &str) -> Option<&'static Self> {
        PRESETS.iter().find(|p| p.name == name)
    }

    /// Purpose and settings in one line, for help texts.
    pub fn describe(&self) -> String {
        let settings: Vec<String> = self.settings.iter().map(|(key, value)| format!("{key}={value}")).collect();
        format!("{}: {}", self.purpose, settings.join(" "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_is_found_by_its_name_and_says_what_it_changes() {
        for preset in &PRESETS {
            assert_eq!(Preset::of(preset.name), Some(preset));
            assert!(preset.settings.iter().all(|(key, value)| preset.describe().contains(&format!("{key}={value}"))));
        }
        assert_eq!(Preset::of("Draft"), None);
    }
}
