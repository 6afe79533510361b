//! All that is wrong with a tileset, in one list: a code, a tile, a place, and the numbers in words.

use serde::Serialize;

use super::Audit;
use super::distance::{TileDistance, Verdict};
use super::seams::Crack;
use super::textures::Than;
use glam::DVec3;

/// What a CI gate can be told to fail on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Group {
    /// Errors below what was found, certificates that do not hold.
    Understated,
    /// Errors far above what is possible.
    Overstated,
    /// Cracks and holes.
    Cracks,
    /// Content or children outside of volumes.
    Bounds,
    /// Errors that grow downwards, empty tiles that replace others.
    Tree,
    /// Tiles that cannot be read, or were not measured.
    Unread,
    /// Classes that changed.
    Classes,
    /// Obstacles sunk or lost.
    Obstacles,
    /// Textures without detail.
    Textures,
    /// Tiles too large.
    Sizes,
}

impl Group {
    /// All, with the names of `--fail-on`.
    pub const ALL: [(Self, &'static str); 10] = [
        (Self::Understated, "understated"),
        (Self::Overstated, "overstated"),
        (Self::Cracks, "cracks"),
        (Self::Bounds, "bounds"),
        (Self::Tree, "tree"),
        (Self::Unread, "unread"),
        (Self::Classes, "classes"),
        (Self::Obstacles, "obstacles"),
        (Self::Textures, "textures"),
        (Self::Sizes, "sizes"),
    ];

    /// As in `--fail-on`.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(group, _)| *group == self).map_or("", |(_, name)| name)
    }

    /// True where somebody may be hurt or something is missing; else it is slow or ugly.
    pub fn is_grave(self) -> bool {
        !matches!(self, Self::Overstated | Self::Textures | Self::Sizes)
    }
}

/// Something wrong.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fault {
    /// Stable name.
    pub code: &'static str,
    /// What it counts as.
    pub group: Group,
    /// Index of the tile.
    pub tile: usize,
    /// Where the tile is in the files.
    pub path: String,
    /// Where on the globe, or in local metres; empty where it is the whole tile.
    pub place: String,
    /// How bad, in the code's own unit.
    pub amount: f64,
    /// Value found, value wanted.
    pub what: String,
}

/// A tile's area that may change its class before it is told of.
pub const SWAP_SHARE: f64 = 0.10;

/// Everything wrong with `audit`.
pub fn of(audit: &Audit) -> Vec<Fault> {
    let mut faults = Vec::new();
    of_structure(audit, &mut faults);
    audit.distances.iter().for_each(|one| of_distance(audit, one, &mut faults));
    let seams = &audit.seams;
    let within = "tiles of one level do not meet";
    seams.cracks.iter().for_each(|crack| faults.push(crack_of(audit, "crack", crack, within)));
    let across = "a tile and its finer neighbour are further apart than the error and the skirts of either account for";
    seams.cracks_across.iter().for_each(|crack| faults.push(crack_of(audit, "crack-across-levels", crack, across)));
    of_openings(audit, &mut faults);
    of_obstacles(audit, &mut faults);
    for blurred in &audit.blurred {
        let share = 100.0 * blurred.share;
        let what = match blurred.than {
            Than::Finer => format!(
                "its image has {share:.0} % of the detail that the next finer tiles have at its resolution: blurred"
            ),
            Than::Level => format!("its image has {share:.0} % of the detail that others of its level have: blurred"),
            Than::Itself => format!(
                "its image has {share:.0} % of its detail at its own resolution: blurred, or larger than it need be"
            ),
        };
        faults.push(fault(
            audit,
            "texture-blurred",
            Group::Textures,
            blurred.tile,
            1.0 / blurred.share.max(1e-6),
            what,
        ));
    }
    faults.sort_by(|a, b| {
        (a.group, a.code).cmp(&(b.group, b.code)).then(b.amount.total_cmp(&a.amount)).then(a.tile.cmp(&b.tile))
    });
    faults
}

fn of_structure(audit: &Audit, faults: &mut Vec<Fault>) {
    for found in &audit.structure.findings {
        let group = match found.code {
            "content-outside-volume" | "content-outside-own-volume" | "child-outside-parent" => Group::Bounds,
            "error-negative" | "error-not-monotone" => Group::Tree,
            // Without a tile of its own in between nothing is lost.
            "empty-replace" if found.amount == 0.0 => continue,
            "empty-replace" => Group::Tree,
            _ => Group::Sizes,
        };
        faults.push(fault(audit, found.code, group, found.tile, found.amount, found.what.clone()));
    }
    for (tile, figures) in audit.structure.tiles.iter().enumerate() {
        if let Some(code) = figures.refused {
            let what = format!("its content cannot be read: {code}");
            faults.push(fault(audit, "tile-unreadable", Group::Unread, tile, 1.0, what));
        }
    }
    let not_entered = ["external-not-read", "implicit-not-read", "tileset-cycle", "tileset-depth", "too-many-tiles"];
    for warning in audit.tileset.warnings.iter().filter(|w| not_entered.contains(&w.code)) {
        let what = format!("{} ({} times)", warning.first, warning.count);
        let path = warning.first_path.display().to_string();
        faults.push(Fault { path, ..fault(audit, warning.code, Group::Unread, 0, warning.count as f64, what) });
    }
}

/// Openings smaller than this are told of in the figures only, m².
const LEAST_OPENING_M2: f64 = 0.5;

fn of_openings(audit: &Audit, faults: &mut Vec<Fault>) {
    for (tile, openings) in &audit.openings {
        let both = [
            ("hole", openings.in_tile, "it is open where the finer surface is closed"),
            (
                "hole-in-finer",
                openings.in_finer,
                "the finer surface is open where it is closed, as if a tile were missing",
            ),
        ];
        for (code, opening, what) in both {
            let Some(o) = opening.filter(|o| o.area_m2 >= LEAST_OPENING_M2) else { continue };
            let place = super::cover::place(&audit.tileset, DVec3::from_array(o.local_m));
            let what = format!("{what}: {:.1} m² at most, {} openings in one view", o.area_m2, o.count);
            faults.push(Fault { place, ..fault(audit, code, Group::Cracks, *tile, o.area_m2, what) });
        }
    }
}

fn of_obstacles(audit: &Audit, faults: &mut Vec<Fault>) {
    let safe_m = audit.config.obstacle_safe_m.unwrap_or_default();
    for tile in audit.envelope_tiles.iter().filter(|t| t.lost_count > 0) {
        let Some(worst) = tile.lost.first() else { continue };
        let place = super::cover::place(&audit.tileset, DVec3::from_array(worst.local_m));
        let what = format!(
            "{} obstacles are gone: nothing within {:.2} m is as high, less {safe_m} m; the worst ({}) sinks by {:.2} m over {:.2} m² (tiling error alone)",
            tile.lost_count, tile.reach_m, worst.class, worst.sink_m, worst.area_m2
        );
        faults.push(Fault { place, ..fault(audit, "obstacle-lost", Group::Obstacles, tile.tile, worst.sink_m, what) });
    }
}

fn of_distance(audit: &Audit, one: &TileDistance, faults: &mut Vec<Fault>) {
    let mut add = |code, group, amount: f64, what: String| {
        let place = one.worst.map(|w| super::cover::place(&audit.tileset, DVec3::from_array(w.local_m)));
        let place = place.unwrap_or_default();
        faults.push(Fault { place, ..fault(audit, code, group, one.tile, amount, what) });
    };
    let stated_m = one.stated_error_m;
    if let (Some(why), Verdict::Unmeasured) = (&one.why, one.verdict)
        && !why.starts_with("it cannot be read")
    {
        add("tile-unmeasured", Group::Unread, 1.0, format!("not measured: {why}"));
    }
    let Some(interval) = one.hausdorff else { return };
    let side = match one.worst {
        Some(w) if w.is_on_reference => "there the finer surface has something that this tile lacks",
        _ => "there this tile has something that the finer surface lacks",
    };
    if one.verdict == Verdict::Understated {
        let times = one.factor.map_or(String::new(), |f| format!(", {f:.2} times as much"));
        let what = format!("states {stated_m:.3} m and is off by {:.3} m{times}; {side}", interval.lower_m);
        add("understated", Group::Understated, interval.lower_m - stated_m, what);
    }
    if let (Verdict::Overstated, Some(factor)) = (one.verdict, one.factor) {
        let what = format!(
            "states {stated_m:.3} m and is off by at most {:.3} m: {factor:.1} times too much",
            interval.upper_m
        );
        add("overstated", Group::Overstated, factor, what);
    }
    for certificate in one.certificates.iter().filter(|c| !c.holds) {
        let (name, stated_m, lower_m) = (&certificate.property, certificate.stated_m, certificate.measured.lower_m);
        let what = format!("its metadata say {name} {stated_m:.3} m; {lower_m:.3} m was found");
        add("certificate-broken", Group::Understated, lower_m - stated_m, what);
    }
    for swap in one.class_swaps.iter().filter(|s| s.area_share > SWAP_SHARE && !one.is_guessed_class) {
        let share = 100.0 * swap.area_share;
        let what = format!("{share:.0} % of its area is {} where the reference is {}", swap.tile, swap.reference);
        add("class-changed", Group::Classes, swap.area_share, what);
    }
}

fn crack_of(audit: &Audit, code: &'static str, crack: &Crack, what: &str) -> Fault {
    let neighbour = audit.tileset.trail(crack.neighbour);
    let (gap_m, edges) = (crack.gap_m, crack.unmatched_edges);
    let what = format!("{what}: {gap_m:.3} m, {edges} border edges do not match, with {neighbour}");
    let place = super::cover::place(&audit.tileset, DVec3::from_array(crack.local_m));
    Fault { place, ..fault(audit, code, Group::Cracks, crack.tile, gap_m, what) }
}

fn fault(audit: &Audit, code: &'static str, group: Group, tile: usize, amount: f64, what: String) -> Fault {
    Fault { code, group, tile, path: audit.tileset.trail(tile), place: String::new(), amount, what }
}
