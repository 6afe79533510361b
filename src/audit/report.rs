//! The audit as JSON, and in words.
//!
//! # Schema
//! One object; every length, size or angle has its unit at the end of its key (`_m`, `_m2`, `_bytes`, `_px`).
//!
//! | key | what |
//! |---|---|
//! | `schema` | `rooftile-audit/1`; another number when a key changes its meaning |
//! | `tileset` | counts, versions, generators, the place on the globe |
//! | `verdict` | the worst verdict of any tile, and how many tiles have which |
//! | `counts` | faults by group and by code |
//! | `thresholds` | every limit that was applied |
//! | `levels` | sizes, texels and errors of each level |
//! | `table` | distances by level and class (`class` null: all together) |
//! | `tiles` | each tile: stated error, certified interval, verdict, factor, figures, worst point |
//! | `seams` | gaps within levels and across; cracks |
//! | `openings` | holes seen from all around, of tiles that have any |
//! | `envelope` | with `--obstacle-safe`: sinking below the true top by level and class; tiling error alone |
//! | `textures` | detail of images by level |
//! | `stations`, `route` | what viewers load by stated and by measured errors |
//! | `faults` | all that is wrong: `code`, `group`, `tile`, `path`, `place`, `amount`, `what` |
//! | `warnings` | what was odd in the files, counted by code |

use std::collections::BTreeMap;
use std::fmt::Write;

use serde_json::{Value, json};

use super::distance::Verdict;
use super::findings::Group;
use super::view::{FOVY_DEG, HEIGHT_PX};
use super::{Audit, structure, verdict};

const ALL_VERDICTS: [Verdict; 6] = [
    Verdict::Understated,
    Verdict::Overstated,
    Verdict::Texture,
    Verdict::Honest,
    Verdict::Finest,
    Verdict::Unmeasured,
];

impl Audit {
    /// How many tiles have which verdict.
    pub fn verdicts(&self) -> Vec<(Verdict, usize)> {
        let count = |v: Verdict| self.distances.iter().filter(|d| d.verdict == v).count();
        ALL_VERDICTS.iter().map(|&v| (v, count(v))).collect()
    }

    /// Faults by code.
    pub fn codes(&self) -> BTreeMap<&'static str, usize> {
        let mut codes = BTreeMap::new();
        self.faults.iter().for_each(|f| *codes.entry(f.code).or_default() += 1);
        codes
    }

    /// The same, the gravest groups first.
    pub fn codes_by_group(&self) -> Vec<(&'static str, usize)> {
        let mut codes: Vec<(&'static str, usize)> = Vec::new();
        for fault in &self.faults {
            match codes.iter_mut().find(|(code, _)| *code == fault.code) {
                Some((_, count)) => *count += 1,
                None => codes.push((fault.code, 1)),
            }
        }
        codes
    }

    /// What an id of a class is called; all together without one.
    pub fn class_name(&self, class: Option<crate::ids::ClassId>) -> &str {
        class.map_or("all", |c| self.classes.get(c.index()).map_or("unclassified", String::as_str))
    }

    /// Faults of `groups`, in words.
    pub fn reasons(&self, groups: &[Group]) -> Vec<String> {
        let of = |group: &Group| {
            let faults: Vec<_> = self.faults.iter().filter(|f| f.group == *group).collect();
            faults.first().map(|f| {
                let at = if f.place.is_empty() { String::new() } else { format!(" at {}", f.place) };
                format!("{}: {} faults; the first: {}: {}{at}", group.name(), faults.len(), f.path, f.what)
            })
        };
        groups.iter().filter_map(of).collect()
    }

    /// The whole audit as JSON; see the module for its keys.
    pub fn json(&self) -> Value {
        let groups: BTreeMap<&str, usize> = Group::ALL
            .iter()
            .map(|(group, name)| (*name, self.faults.iter().filter(|f| f.group == *group).count()))
            .collect();
        let verdicts: BTreeMap<String, usize> =
            self.verdicts().iter().map(|(v, n)| (v.name().replace(' ', "_"), *n)).collect();
        let origin = self.tileset.frame.origin;
        let generators: Vec<_> = self.tileset.files.iter().filter_map(|f| f.generator.clone()).take(1).collect();
        let tiles: Vec<Value> = self.distances.iter().map(|d| self.tile_json(d)).collect();
        let table: Vec<Value> = self
            .rows
            .iter()
            .map(|row| {
                let mut value = json!(row);
                value["class"] = row.class.map_or(Value::Null, |c| json!(self.class_name(Some(c))));
                value
            })
            .collect();
        json!({
            "schema": "rooftile-audit/1",
            "tileset": {
                "tiles": self.tileset.tiles.len(),
                "tiles_with_triangles": self.distances.len(),
                "files": self.tileset.files.len(),
                "version": self.tileset.files.first().and_then(|f| f.version.clone()),
                "generators": generators,
                "origin_deg": origin.map(|o| [o.lat_rad.to_degrees(), o.lon_rad.to_degrees()]),
                "origin_height_m": origin.map(|o| o.height_m),
                "classes": self.classes,
            },
            "verdict": { "worst": verdict(&self.distances), "tiles": verdicts },
            "counts": { "groups": groups, "codes": self.codes() },
            "thresholds": self.thresholds(),
            "source": self.placed,
            "levels": self.structure.levels,
            "table": table,
            "tiles": tiles,
            "openings": self.openings.iter().map(|(tile, openings)| json!({"tile": tile, "openings": openings})).collect::<Vec<_>>(),
            "seams": self.seams,
            "envelope": self.envelope,
            "textures": self.textures,
            "stations": self.stations,
            "route": self.route.as_ref().map(|[stated, measured]| json!({"stated": stated, "measured": measured})),
            "faults": self.faults,
            "warnings": self.warnings,
        })
    }

    fn tile_json(&self, d: &super::TileDistance) -> Value {
        let mut value = json!(d);
        value["path"] = json!(self.tileset.trail(d.tile));
        value["size"] = json!(self.structure.tiles.get(d.tile));
        // Indexing would make an object of what is null.
        let classes = value.get_mut("comparison").and_then(|c| c.get_mut("by_class"));
        if let Some(classes) = classes.and_then(Value::as_array_mut) {
            for class in classes {
                let id = class["class"].as_u64().map(|id| crate::ids::ClassId(id as u8));
                class["class"] = json!(self.class_name(id));
            }
        }
        value
    }

    /// Every limit that was applied.
    pub fn thresholds(&self) -> Value {
        let (s, d, seams) = (&self.config.structure, &self.config.distance, &self.config.seams);
        json!({
            "max_slack": d.max_slack,
            "obstacle_safe_m": self.config.obstacle_safe_m,
            "plan_cell_m": super::envelope::CELL_M,
            "texture_detail_share": super::textures::LEAST_SHARE,
            "understated_rounding_m": d.rounding_m,
            "certified_tolerance_m": d.tolerance_m.map_or(json!("0.02 or 2e-4 of the diagonal"), |t| json!(t)),
            "seam_match_m": seams.match_m,
            "seam_crack_m": seams.crack_m,
            "seam_reach_m": seams.reach_m,
            "outside_volume_m": s.outside_m,
            "tile_bytes": s.tile_bytes,
            "tile_triangles": s.tile_triangles,
            "tile_draw_calls": s.tile_draw_calls,
            "tile_texture_bytes": s.tile_texture_bytes,
            "class_changed_area_share": super::findings::SWAP_SHARE,
            "screen_space_error_px": structure::SSE_PX,
            "picture_height_px": HEIGHT_PX,
            "fovy_deg": FOVY_DEG,
        })
    }

    /// The audit in words, for a terminal.
    pub fn text(&self) -> String {
        let mut text = String::new();
        let _ = self.write_text(&mut text);
        text
    }

    fn write_text(&self, f: &mut String) -> std::fmt::Result {
        let measured = self.distances.iter().filter(|d| d.hausdorff.is_some()).count();
        writeln!(f, "{}", self.headline())?;
        let counts: Vec<String> =
            self.verdicts().iter().filter(|(_, n)| *n > 0).map(|(v, n)| format!("{n} {}", v.name())).collect();
        writeln!(f, "{} tiles with triangles, {measured} measured: {}\n", self.distances.len(), counts.join(", "))?;
        writeln!(
            f,
            "{:>5} {:12} {:>6} {:>19} {:>8} {:>8} {:>8} {:>8} {:>17} {:>7} {:>7} {:>8}",
            "level", "class", "tiles", "stated", "mean", "rms", "p95", "p99", "max certified", "in", "out", "m/texel"
        )?;
        for row in &self.rows {
            let level = self.structure.levels.iter().find(|l| l.level == row.level);
            let texel = level.and_then(|l| l.metres_per_texel).filter(|_| row.class.is_none());
            let interval = row.hausdorff.map_or("-".into(), |i| format!("{:.3}..{:.3}", i.lower_m, i.upper_m));
            writeln!(
                f,
                "{:>5} {:12} {:>6} {:>19} {:>8.4} {:>8.4} {:>8.3} {:>8.3} {:>17} {:>7.3} {:>7.3} {:>8}",
                row.level,
                self.class_name(row.class),
                row.tiles,
                format!("{:.3}..{:.3}", row.stated_error_m[0], row.stated_error_m[2]),
                row.mean_m,
                row.rms_m,
                row.p95_m,
                row.p99_m,
                interval,
                row.inside_seen_m,
                row.outside_seen_m,
                texel.map_or(String::new(), |t| format!("{t:.3}")),
            )?;
        }
        writeln!(
            f,
            "\nMetres, both ways; p95, p99 and max of the worst tile. in, out: sinks into, stands out of the solid."
        )?;
        for row in &self.seams.rows {
            let name = row.name();
            let (p50, p95, max) = (row.gap_p50_m, row.gap_p95_m, row.gap_max_m);
            let (edges, open) = (row.edges, row.unmatched_edges);
            writeln!(
                f,
                "seams {name}: {open} of {edges} border edges do not match; gaps p50 {p50:.3}, p95 {p95:.3}, max {max:.3} m"
            )?;
        }
        if let Some(safe_m) = self.config.obstacle_safe_m {
            self.write_envelope(f, safe_m)?;
        }
        writeln!(f, "\nA viewer at {} px of error loads:", structure::SSE_PX)?;
        for s in &self.stations {
            writeln!(
                f,
                "  at +{:<4} m {:>9} triangles in {:>4} tiles; by measured errors {:>9} in {:>4}; by p95 {:>9} in {:>4}",
                s.height_m,
                s.stated.triangles,
                s.stated.tiles,
                s.measured.triangles,
                s.measured.tiles,
                s.p95.triangles,
                s.p95.tiles
            )?;
        }
        if let Some([stated, measured]) = &self.route {
            let (length, most, by) = (stated.length_m, stated.most, measured.most);
            writeln!(
                f,
                "  on the route ({length:.0} m) at most {} triangles, {:.0} MB in memory; by measured errors {}, {:.0} MB",
                most.triangles,
                most.memory_bytes as f64 / 1e6,
                by.triangles,
                by.memory_bytes as f64 / 1e6
            )?;
        }
        if self.faults.is_empty() {
            writeln!(f, "\nNothing wrong was found.")?;
        }
        for (code, count) in self.codes_by_group() {
            let Some(first) = self.faults.iter().find(|x| x.code == code) else { continue };
            let place = if first.place.is_empty() { String::new() } else { format!(" at {}", first.place) };
            writeln!(
                f,
                "\n{count} × {code} ({}); the worst: {}{place}\n    {}",
                first.group.name(),
                first.path,
                first.what
            )?;
        }
        for w in &self.warnings {
            writeln!(f, "warning    {} × {}: {}: {}", w.count, w.code, w.first_path.display(), w.first)?;
        }
        Ok(())
    }

    fn write_envelope(&self, f: &mut String, safe_m: f64) -> std::fmt::Result {
        writeln!(
            f,
            "\nObstacles, tiling error alone (the survey's comes on top), more than {safe_m} m below the true top:"
        )?;
        writeln!(
            f,
            "{:>5} {:12} {:>9} {:>9} {:>9} {:>9} {:>9} {:>6}  Annex 15 figure (LE90, a yardstick only)",
            "level", "class", "m²", "LE90", "P99.9", "max", "lateral", "lost"
        )?;
        for row in &self.envelope {
            writeln!(
                f,
                "{:>5} {:12} {:>9.0} {:>9.2} {:>9.2} {:>9.2} {:>9.2} {:>6}  {}",
                row.level,
                row.class,
                row.area_m2,
                row.sink_le90_m,
                row.sink_p999_m,
                row.sink_max_m,
                row.erosion_p95_m,
                row.obstacles_lost,
                row.annex_15_vertical_figure_met.join(", ")
            )?;
        }
        Ok(())
    }

    /// The verdict in one sentence.
    pub fn headline(&self) -> String {
        let judged: Vec<_> =
            self.distances.iter().filter(|d| !matches!(d.verdict, Verdict::Finest | Verdict::Unmeasured)).collect();
        let count = |v: Verdict| judged.iter().filter(|d| d.verdict == v).count();
        let worst = |v: Verdict| judged.iter().filter(|d| d.verdict == v).filter_map(|d| d.factor).fold(0.0, f64::max);
        let (under, over) = (count(Verdict::Understated), count(Verdict::Overstated));
        let of = judged.len();
        let times = |v: Verdict| match worst(v) {
            0.0 => String::new(),
            factor if factor < 2.0 => format!(", up to {factor:.2} times"),
            factor => format!(", up to {factor:.1} times"),
        };
        let errors = match (under, over) {
            _ if of == 0 => "no tile could be compared with anything finer".to_string(),
            (0, 0) => format!("the geometric errors are honest in all {of} tiles judged"),
            (0, _) => format!(
                "the geometric errors are safe but overstated in {over} of {of} tiles{}",
                times(Verdict::Overstated)
            ),
            (_, 0) => {
                format!("the geometric errors are UNDERSTATED in {under} of {of} tiles{}", times(Verdict::Understated))
            }
            _ => format!(
                "the geometric errors are UNDERSTATED in {under} of {of} tiles{}, and overstated in {over}{}",
                times(Verdict::Understated),
                times(Verdict::Overstated)
            ),
        };
        let is_other = |code: &str| {
            self.faults.iter().any(|f| f.code == code && f.group.is_grave() && f.group != Group::Understated)
        };
        let grave: Vec<String> = self
            .codes_by_group()
            .into_iter()
            .filter(|(code, _)| is_other(code))
            .map(|(code, count)| format!("{count} × {code}"))
            .collect();
        let other = match grave.is_empty() {
            true => "no other grave fault".to_string(),
            false => format!("but also {}", grave.join(", ")),
        };
        format!("Verdict: {errors}; {other}.")
    }
}
