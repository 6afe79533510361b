//! The audit as one HTML page: no script, no network, readable in two minutes.
//!
//! In: an [`Audit`] and its tileset. Out: text. The verdict comes first, then why, then the figures, the pictures of the
//! worst tiles beside what they stand for, and every limit that was applied.

use std::fmt::Write;

use glam::DVec3;

use super::cover::{Cover, Loader, Shown};
use super::distance::{Against, TileDistance, Verdict};
use super::findings::Group;
use super::{Audit, structure, verdict};
use crate::Result;
use crate::draw::panel::{Legend, Panel, grid};
use crate::draw::plot::{Axis, LineChart, Series};
use crate::draw::png;
use crate::draw::ramp::{Ramp, Scale};
use crate::draw::shade::{Paint, render};
use crate::draw::view::View;
use crate::geo::bvh::Bvh;

/// Tiles shown as pictures.
const PICTURES: usize = 4;
/// Each of three pictures of a tile.
const PICTURE_PX: [u32; 2] = [400, 300];
/// Faults written out of each code; the rest is in the JSON.
const FAULTS: usize = 10;
/// Faces drawn of one surface.
const MOST_DRAWN_FACES: usize = 3_000_000;
/// Compass bearing and height over the horizon that pictures look from, degrees.
const LOOK_FROM_DEG: [f64; 2] = [200.0, 40.0];

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;color:#222;max-width:1240px;margin:24px auto;padding:0 20px}\
h1{font-size:22px;margin:0 0 4px}h2{font-size:17px;margin:30px 0 8px;border-bottom:1px solid #ddd;padding-bottom:3px}\
.v{padding:12px 16px;border-radius:6px;font-size:18px;margin:12px 0;color:#fff}.bad{background:#a3201c}.slow{background:#9a5b00}\
.good{background:#1c6b35}.none{background:#555}table{border-collapse:collapse;font-size:13px;width:100%}\
th,td{padding:3px 7px;text-align:right;border-bottom:1px solid #e6e6e6;white-space:nowrap}th{background:#f4f4f6;position:sticky;top:0;white-space:normal}\
td.t,th.t{text-align:left;white-space:normal}tr.all td{font-weight:600;border-top:1px solid #999}.danger{color:#a3201c;font-weight:600}\
.slowly{color:#9a5b00;font-weight:600}.fine{color:#1c6b35}.small{font-size:13px;color:#555}ul{margin:6px 0;padding-left:22px}\
img{max-width:100%;height:auto}figure{margin:14px 0}figcaption{font-size:13px;color:#444}code{font-size:12px}\
.two{display:flex;flex-wrap:wrap;gap:16px}.two svg{max-width:100%;height:auto}";

/// The page.
///
/// # Errors
/// [`crate::Error::Bug`] if a picture cannot be encoded.
pub fn html(audit: &Audit, named: &str) -> Result<String> {
    let mut page = String::new();
    let title = escape(named);
    let _ = write!(
        page,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width\"><link rel=\"icon\" href=\"data:,\"><title>Audit of {title}</title><style>{STYLE}</style></head><body>\n"
    );
    head(audit, &title, &mut page);
    plainly(audit, &mut page);
    reasons(audit, &mut page);
    table(audit, &mut page);
    curves(audit, &mut page);
    loads(audit, &mut page);
    seams(audit, &mut page);
    if let Some(safe_m) = audit.config.obstacle_safe_m {
        obstacles(audit, safe_m, &mut page);
    }
    worst(audit, &mut page);
    pictures(audit, &mut page)?;
    levels(audit, &mut page);
    limits(audit, &mut page);
    page.push_str("</body></html>\n");
    Ok(page)
}

fn head(audit: &Audit, title: &str, page: &mut String) {
    let grave = audit.faults.iter().any(|f| f.group.is_grave());
    let class = match verdict(&audit.distances) {
        _ if grave => "bad",
        Verdict::Understated => "bad",
        Verdict::Overstated => "slow",
        Verdict::Unmeasured | Verdict::Finest => "none",
        Verdict::Honest | Verdict::Texture => "good",
    };
    let headline = audit.headline();
    let _ = write!(page, "<h1>Audit of {title}</h1><p class=\"v {class}\">{}</p>", escape(&headline));
    let triangles: u64 = audit.structure.levels.iter().map(|l| l.sum.triangles).sum();
    let bytes: u64 = audit.structure.levels.iter().map(|l| l.sum.bytes).sum();
    let against = match &audit.placed {
        Some(placed) => format!("the original mesh ({} triangles, {})", placed.triangles, placed.how),
        None => "the finest tiles: what these themselves lost is not seen".into(),
    };
    let generator = audit.tileset.files.first().and_then(|f| f.generator.clone()).unwrap_or("not stated".into());
    let counts: Vec<String> =
        audit.verdicts().iter().filter(|(_, n)| *n > 0).map(|(v, n)| format!("{n} {}", v.name())).collect();
    let _ = write!(
        page,
        "<p class=\"small\">{} tiles with triangles in {} levels, {triangles} triangles, {:.1} MB; generator: {}. Measured \
         against {against}. Tiles: {}. Made by rooftile {}.</p>",
        audit.distances.len(),
        audit.structure.levels.len(),
        bytes as f64 / 1e6,
        escape(&generator),
        counts.join(", "),
        env!("CARGO_PKG_VERSION"),
    );
}

/// What the figures say, for those who do not read tables.
fn plainly(audit: &Audit, page: &mut String) {
    let mut said = Vec::new();
    let measured: Vec<_> =
        audit.rows.iter().filter(|r| r.class.is_none()).filter_map(|r| Some((r, r.hausdorff?))).collect();
    let ends = [measured.first(), measured.last().filter(|_| measured.len() > 1)];
    for (row, interval) in ends.into_iter().flatten() {
        said.push(format!(
            "Level {}{}: no point is more than <b>{:.2} m</b> off (certified), 95 % are within <b>{:.2} m</b>; the shape sinks \
             in by {:.2} m at most where it was looked at.",
            row.level,
            if row.level == 0 { ", the coarsest" } else { "" },
            interval.upper_m,
            row.p95_m,
            row.inside_seen_m
        ));
    }
    let judged = audit.distances.iter().filter(|d| d.verdict != Verdict::Finest).count();
    let texture = audit.distances.iter().filter(|d| d.verdict == Verdict::Texture).count();
    if texture > 0 {
        said.push(format!(
            "{texture} of {judged} tiles state more than their shape needs, because their images do: viewers refine them for \
             sharpness."
        ));
    }
    if let Some(safe_m) = audit.config.obstacle_safe_m {
        for row in audit.envelope.iter().filter(|r| r.class == "all") {
            said.push(format!(
                "Obstacles, level {}: <b>{}</b> are gone (nothing as high, less {safe_m} m, within {safe_m} m); 90 % of the area \
                 sinks by less than {:.2} m.",
                row.level, row.obstacles_lost, row.sink_le90_m
            ));
        }
    }
    let finest = if audit.placed.is_some() { "" } else { ", and what the finest tiles lost of the original mesh" };
    said.push(format!("Not in any of these figures: the error of the survey{finest}."));
    let _ = write!(page, "<ul><li>{}</li></ul>", said.join("</li><li>"));
}

fn reasons(audit: &Audit, page: &mut String) {
    page.push_str("<h2>What is wrong</h2>");
    if audit.faults.is_empty() {
        page.push_str("<p class=\"fine\">Nothing was found, by the limits at the end of this page.</p>");
    } else {
        fault_table(audit, page);
    }
    let clean: Vec<&str> = Group::ALL
        .iter()
        .filter(|(group, _)| !audit.faults.iter().any(|f| f.group == *group))
        .filter(|(group, _)| *group != Group::Obstacles || audit.config.obstacle_safe_m.is_some())
        .map(|(_, name)| *name)
        .collect();
    let _ = write!(page, "<p class=\"small\">Looked at, and nothing found: {}.", clean.join(", "));
    if audit.config.obstacle_safe_m.is_none() {
        page.push_str(" Not looked at: obstacles.");
    }
    page.push_str("</p>");
}

/// A row for each code.
fn fault_table(audit: &Audit, page: &mut String) {
    page.push_str("<table><tr><th class=t>group</th><th class=t>fault</th><th>tiles or places</th><th class=t>the worst</th></tr>");
    for (code, count) in audit.codes_by_group() {
        let Some(first) = audit.faults.iter().find(|f| f.code == code) else { continue };
        let class = if first.group.is_grave() { "danger" } else { "slowly" };
        let at = if first.place.is_empty() { String::new() } else { format!(" <code>{}</code>", escape(&first.place)) };
        let _ = write!(
            page,
            "<tr><td class=\"t {class}\">{}</td><td class=t>{code}</td><td>{count}</td><td class=t>{}<br><code>{}</code>{at}</td></tr>",
            first.group.name(),
            escape(&first.what),
            escape(&first.path)
        );
    }
    page.push_str("</table>");
}

fn table(audit: &Audit, page: &mut String) {
    page.push_str("<h2>Error by level and class, metres</h2><table><tr><th>level</th><th class=t>class</th><th>tiles</th>\
        <th>stated error</th><th>max, certified</th><th class=t>stated against found</th><th>mean</th><th>RMS</th><th>p95</th><th>p99</th>\
        <th>sinks in</th><th>stands out</th><th>Eq. 17</th><th>Eq. 18</th></tr>");
    for row in &audit.rows {
        let found = row.hausdorff.map_or("-".into(), |h| format!("{:.3} to {:.3}", h.lower_m, h.upper_m));
        let judged = match (row.understated, row.overstated, row.texture) {
            _ if row.class.is_some() => String::new(),
            (0, 0, 0) => "<span class=fine>honest</span>".into(),
            (u, o, t) => [(u, "danger", "understated"), (o, "slowly", "overstated"), (t, "fine", "set by texture")]
                .iter()
                .filter(|(n, _, _)| *n > 0)
                .map(|(n, class, name)| format!("<span class={class}>{n} {name}</span>"))
                .collect::<Vec<_>>()
                .join(", "),
        };
        let [low, _, high] = row.stated_error_m;
        let stated = if row.class.is_some() {
            String::new()
        } else if low == high {
            format!("{high:.3}")
        } else {
            format!("{low:.3} to {high:.3}")
        };
        let _ = write!(
            page,
            "<tr{}><td>{}</td><td class=t>{}</td><td>{}</td><td>{stated}</td><td>{found}</td><td class=t>{judged}</td>\
             <td>{:.4}</td><td>{:.4}</td><td>{:.3}</td><td>{:.3}</td><td>{:.3}</td><td>{:.3}</td><td>{:.4}</td><td>{:.4}</td></tr>",
            if row.class.is_none() { " class=all" } else { "" },
            row.level,
            escape(audit.class_name(row.class)),
            row.tiles,
            row.mean_m,
            row.rms_m,
            row.p95_m,
            row.p99_m,
            row.inside_seen_m,
            row.outside_seen_m,
            row.eq17_mean_m,
            row.eq18_as_printed_sqrt_m,
        );
    }
    page.push_str("</table><p class=\"small\">Level 0 is the coarsest. Distances go both ways between a tile and what it \
        stands for. The certified maximum lies between the two numbers for certain; it and p95, p99 are of the worst tile. \
        Understated is an error below the lower number: a viewer then shows the tile where it is wrong by more than it says. \
        Eq. 17 and 18 are the paper's, at the tile's vertices only; Eq. 18 as printed is in m<sup>½</sup>.</p>");
    let incomplete = audit.distances.iter().filter(|d| d.is_incomplete).count();
    if incomplete > 0 {
        let _ = write!(
            page,
            "<p class=\"danger\">{incomplete} tiles stand for some that cannot be read: of these only what is there is compared.</p>"
        );
    }
    if audit.distances.iter().any(|d| d.is_guessed_class) {
        page.push_str(
            "<p class=\"small\">The tileset names no classes: these are our classifier's guess from shape.</p>",
        );
    }
    if audit.distances.iter().any(|d| d.against == Against::NextTiles) {
        page.push_str(
            "<p class=\"small\">Some tiles stand for more triangles than are compared at once: these were measured \
            against the next finer tiles, whose own bounds were added.</p>",
        );
    }
}

fn curves(audit: &Audit, page: &mut String) {
    let of_level =
        |level: u32| audit.structure.levels.iter().find(|l| l.level == level).map(|l| l.sum.triangles as f64);
    let rows: Vec<_> = audit.rows.iter().filter(|r| r.class.is_none()).collect();
    if rows.len() < 2 {
        return;
    }
    let series = |name: &str, dashed: bool, of: &dyn Fn(&super::summary::Row) -> f64| Series {
        name: name.into(),
        points: rows.iter().filter_map(|r| Some([of(r), of_level(r.level)?])).filter(|p| p[0] > 0.0).collect(),
        dashed,
        marks: true,
        ..Series::default()
    };
    let axis = |label: &str| Axis { label: label.into(), log: true, range: None };
    let errors = LineChart {
        title: "Triangles of a level against its error".into(),
        x: axis("error, m"),
        y: axis("triangles"),
        series: vec![
            series("stated (median)", true, &|r| r.stated_error_m[1]),
            series("certified max", false, &|r| r.hausdorff.map_or(0.0, |h| h.upper_m)),
            series("p95", false, &|r| r.p95_m),
            series("mean", false, &|r| r.mean_m),
        ],
    };
    let texels: Vec<[f64; 2]> =
        audit.structure.levels.iter().filter_map(|l| Some([f64::from(l.level), l.metres_per_texel?])).collect();
    let by_level =
        |of: &dyn Fn(&super::summary::Row) -> f64| rows.iter().map(|r| [f64::from(r.level), of(r)]).collect();
    let line = |name: &str, dashed: bool, points: Vec<[f64; 2]>| Series {
        name: name.into(),
        points,
        dashed,
        marks: true,
        ..Series::default()
    };
    let ladder = LineChart {
        title: "Error and texel by level".into(),
        x: Axis { label: "level (0 is the coarsest)".into(), ..Axis::default() },
        y: axis("m"),
        series: vec![
            line("stated (median)", true, by_level(&|r| r.stated_error_m[1])),
            line("certified max", false, by_level(&|r| r.hausdorff.map_or(0.0, |h| h.upper_m))),
            line("texel", false, texels),
        ],
    };
    let _ = write!(
        page,
        "<h2>Curves</h2><div class=two>{}{}</div>",
        errors.sheet([580, 360]).svg(),
        ladder.sheet([580, 360]).svg()
    );
}

fn loads(audit: &Audit, page: &mut String) {
    let _ = write!(
        page,
        "<h2>What a viewer loads</h2><table><tr><th class=t>from</th><th>triangles, stated errors</th><th>tiles</th><th>MB</th>\
         <th>memory, MB</th><th>triangles, certified errors</th><th>triangles, p95 as errors</th></tr>"
    );
    for s in &audit.stations {
        let _ = write!(
            page,
            "<tr><td class=t>{:.0} m over the middle</td><td>{}</td><td>{}</td><td>{:.1}</td><td>{:.0}</td><td>{}</td><td>{}</td></tr>",
            s.height_m,
            s.stated.triangles,
            s.stated.tiles,
            s.stated.bytes as f64 / 1e6,
            s.stated.memory_bytes as f64 / 1e6,
            s.measured.triangles,
            s.p95.triangles
        );
    }
    if let Some([stated, measured]) = &audit.route {
        let _ = write!(
            page,
            "<tr><td class=t>the route ({:.0} m), at most</td><td>{}</td><td>{}</td><td>{:.1}</td><td>{:.0}</td><td>{}</td><td></td></tr>",
            stated.length_m,
            stated.most.triangles,
            stated.most.tiles,
            stated.most.bytes as f64 / 1e6,
            stated.most.memory_bytes as f64 / 1e6,
            measured.most.triangles
        );
    }
    page.push_str(
        "</table><p class=\"small\">At a screen-space error of 16 px, 1080 px high, 36°, nothing culled: all around is \
        loaded. Memory: vertices, indices and decoded textures of the tiles drawn and those above them.</p>",
    );
}

fn seams(audit: &Audit, page: &mut String) {
    if audit.seams.rows.is_empty() {
        return;
    }
    page.push_str("<h2>Seams</h2><table><tr><th class=t>between tiles</th><th>pairs</th><th>border edges</th><th>that do not match</th>\
        <th>gap p50, m</th><th>p95</th><th>max</th></tr>");
    for row in &audit.seams.rows {
        let _ = write!(
            page,
            "<tr><td class=t>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.3}</td><td>{:.3}</td><td>{:.3}</td></tr>",
            row.name(),
            row.pairs,
            row.edges,
            row.unmatched_edges,
            row.gap_p50_m,
            row.gap_p95_m,
            row.gap_max_m
        );
    }
    page.push_str("</table>");
}

fn obstacles(audit: &Audit, safe_m: f64, page: &mut String) {
    let _ = write!(
        page,
        "<h2>Obstacles: tiling error alone</h2><p>How far each level sinks below the true top, on a grid of {} m. Limit: {safe_m} m. \
         <b>The error of the survey comes on top.</b></p><table><tr><th>level</th><th class=t>class</th><th>m²</th><th>LE90, m</th>\
         <th>P99.9, m</th><th>max, m</th><th>lateral p95, m</th><th>lateral max, m</th><th>lost</th><th class=t>Annex 15 figure</th></tr>",
        super::envelope::CELL_M
    );
    for row in &audit.envelope {
        let _ = write!(
            page,
            "<tr{}><td>{}</td><td class=t>{}</td><td>{:.0}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{}</td><td class=t>{}</td></tr>",
            if row.class == "all" { " class=all" } else { "" },
            row.level,
            escape(&row.class),
            row.area_m2,
            row.sink_le90_m,
            row.sink_p999_m,
            row.sink_max_m,
            row.erosion_p95_m,
            row.erosion_max_m,
            row.obstacles_lost,
            row.annex_15_vertical_figure_met.join(", ")
        );
    }
    page.push_str("</table><p class=\"small\">Sinking is looked at within \
        one cell around: the foot of a wall that moved by more sinks by its height. Lost: joined cells for which nothing within the \
        limit is as high, less the limit. Lateral: how far off the height is found again. The last column names the ICAO Annex 15 areas whose vertical figure for obstacle data \
        (30, 3, 0.5, 1 m at 90 %) is not below LE90: a yardstick for one part of the error, not a statement of fitness.</p>");
}

/// The tiles to look at first: those in danger, then those furthest off.
fn by_badness(audit: &Audit) -> Vec<&TileDistance> {
    let mut tiles: Vec<&TileDistance> = audit.distances.iter().filter(|d| d.hausdorff.is_some()).collect();
    let lower = |d: &TileDistance| d.hausdorff.map_or(0.0, |h| h.lower_m);
    let rank = |d: &TileDistance| match d.verdict {
        Verdict::Understated => (0, lower(d) - d.stated_error_m),
        Verdict::Overstated => (1, d.factor.unwrap_or(0.0)),
        _ => (2, lower(d)),
    };
    tiles.sort_by(|a, b| {
        let (a_rank, b_rank) = (rank(a), rank(b));
        a_rank.0.cmp(&b_rank.0).then(b_rank.1.total_cmp(&a_rank.1)).then(a.tile.cmp(&b.tile))
    });
    tiles
}

fn worst(audit: &Audit, page: &mut String) {
    let tiles = by_badness(audit);
    if tiles.is_empty() {
        return;
    }
    page.push_str("<h2>The ten tiles to look at first</h2><table><tr><th class=t>tile</th><th>level</th><th class=t>verdict</th>\
        <th>states, m</th><th>certified max, m</th><th>p95, m</th><th>texel, m</th><th class=t>furthest point</th></tr>");
    for (i, d) in tiles.iter().take(10).enumerate() {
        let path = escape(&audit.tileset.trail(d.tile));
        let path = if i < PICTURES { format!("<a href=\"#tile-{}\">{path}</a>", d.tile) } else { path };
        let class = match d.verdict {
            Verdict::Understated => "danger",
            Verdict::Overstated => "slowly",
            _ => "fine",
        };
        let factor = d.factor.map_or(String::new(), |f| format!(" {f:.1}×"));
        let h = d.hausdorff.map_or("-".into(), |h| format!("{:.3} to {:.3}", h.lower_m, h.upper_m));
        let p95 = super::view::p95(d).map_or("-".into(), |p| format!("{p:.3}"));
        let texel = d.texture_error_m.map_or("-".into(), |t| format!("{:.3}", t / structure::SSE_PX));
        let place = d.worst.map_or(String::new(), |w| {
            let side = if w.is_on_reference { "lost" } else { "invented" };
            format!("<code>{}</code> {side}", super::cover::place(&audit.tileset, DVec3::from_array(w.local_m)))
        });
        let _ = write!(
            page,
            "<tr><td class=t>{path}</td><td>{}</td><td class=\"t {class}\">{}{factor}</td><td>{:.3}</td><td>{h}</td><td>{p95}</td><td>{texel}</td><td class=t>{place}</td></tr>",
            d.level,
            d.verdict.name(),
            d.stated_error_m
        );
    }
    page.push_str("</table><p class=\"small\">All tiles are in the JSON (<code>--json</code>). Places: latitude, longitude, height \
        above the ellipsoid; without a place on the Earth x y z.</p>");
    if audit.faults.is_empty() {
        return;
    }
    page.push_str("<h2>Faults in full</h2><ul class=small>");
    for (code, _) in audit.codes_by_group() {
        for fault in audit.faults.iter().filter(|f| f.code == code).take(FAULTS) {
            let at =
                if fault.place.is_empty() { String::new() } else { format!(" <code>{}</code>", escape(&fault.place)) };
            let _ = write!(
                page,
                "<li><b>{code}</b> <code>{}</code>: {}{at}</li>",
                escape(&fault.path),
                escape(&fault.what)
            );
        }
    }
    page.push_str("</ul>");
}

fn pictures(audit: &Audit, page: &mut String) -> Result<()> {
    let mut loader = Loader::new(&audit.tileset);
    let cover = Cover::of(&audit.tileset);
    let of_tiles: Vec<&TileDistance> = by_badness(audit)
        .into_iter()
        .filter(|d| d.against == Against::FinestTiles && d.reference_triangles <= MOST_DRAWN_FACES)
        .take(PICTURES)
        .collect();
    if of_tiles.is_empty() {
        return Ok(());
    }
    page.push_str("<h2>Where they are wrong</h2>");
    for d in of_tiles {
        let shown = loader.load(d.tile);
        let reference = loader.union(&cover.finest(&audit.tileset, d.tile));
        let picture = panels(d, &shown, &reference);
        let _ = write!(
            page,
            "<figure id=\"tile-{}\"><img alt=\"\" width=\"{}\" height=\"{}\" src=\"data:image/png;base64,{}\"><figcaption>{}: {}, \
             states {:.3} m.</figcaption></figure>",
            d.tile,
            picture.width(),
            picture.height(),
            base64(&png::bytes(&picture)?),
            escape(&audit.tileset.trail(d.tile)),
            d.verdict.name(),
            d.stated_error_m
        );
    }
    Ok(())
}

/// The tile, the tile by its distance, and the reference by what was lost, on one scale.
fn panels(d: &TileDistance, shown: &Shown, reference: &Shown) -> image::RgbImage {
    use rayon::prelude::*;
    let distances = |from: &Shown, to: &Shown| -> Vec<f64> {
        let bvh = Bvh::new(&to.surface.positions, &to.surface.faces);
        let far = |p: &DVec3| bvh.closest(*p, f64::INFINITY).map_or(f64::NAN, |hit| hit.distance);
        from.surface.positions.par_iter().map(far).collect()
    };
    let (own, lost) = (distances(shown, reference), distances(reference, shown));
    // Red is the stated error, unless nothing comes near it.
    let p99 = d.comparison.as_ref().and_then(|c| c.all.two_sided.as_ref()).map_or(0.0, |s| s.p99_m);
    let lower_m = d.hausdorff.map_or(0.0, |h| h.lower_m);
    let high =
        if d.stated_error_m > 0.0 && d.stated_error_m < lower_m { d.stated_error_m } else { lower_m.min(4.0 * p99) };
    let scale = Scale::new(Ramp::BlueRed, 0.0, high.max(1e-3), "m");
    let points: Vec<DVec3> = reference.surface.positions.iter().chain(&shown.surface.positions).copied().collect();
    let view = View::oblique(&points, LOOK_FROM_DEG[0], LOOK_FROM_DEG[1], PICTURE_PX);
    let draw = |of: &Shown, paint: Paint| render(&view, &of.surface.positions, &of.surface.faces, paint);
    let panel = |title: &str, picture| Panel { title: title.into(), picture, legend: None };
    let panels = [
        panel("what it stands for", draw(reference, Paint::Solid([186, 190, 196]))),
        panel("what it lost of it", draw(reference, Paint::VertexValues(&lost, &scale))),
        panel("the tile: what it invented", draw(shown, Paint::VertexValues(&own, &scale))),
    ];
    grid("", &panels, 3, Some(&Legend::Scale(scale)), 1)
}

fn levels(audit: &Audit, page: &mut String) {
    page.push_str("<h2>Levels</h2><table><tr><th>level</th><th>tiles</th><th>unread</th><th>triangles</th><th>MB</th><th>most triangles</th>\
        <th>most draw calls</th><th>most texture, MB</th><th>m per texel</th><th>texels per pixel</th><th>image detail</th><th>of the finer's</th><th>out of volume, m</th></tr>");
    for l in &audit.structure.levels {
        let or_dash = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.3}"));
        let detail = audit.textures.iter().find(|t| t.level == l.level);
        let _ = write!(
            page,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.2}</td><td>{}</td><td>{}</td><td>{:.1}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.3}</td></tr>",
            l.level,
            l.tiles,
            l.refused,
            l.sum.triangles,
            l.sum.bytes as f64 / 1e6,
            l.most_triangles,
            l.most_draw_calls,
            l.most_texture_rgba_bytes as f64 / 1e6,
            or_dash(l.metres_per_texel),
            or_dash(l.texels_per_pixel),
            or_dash(detail.map(|d| d.detail_share)),
            or_dash(detail.and_then(|d| d.share_of_finer)),
            l.sum.outside_tile_m
        );
    }
    page.push_str("</table><p class=\"small\">Texels per pixel: at the distance where a tile is replaced; below 1 it is seen blurred \
        before. Image detail: of an image at its own resolution, by the most in the octaves below; of blurred ones it is small. Of the finer's: by the detail \
        that the next finer tiles have at that resolution; 1 is as sharp as can be.</p>");
}

fn limits(audit: &Audit, page: &mut String) {
    page.push_str("<h2>Limits applied</h2><table><tr><th class=t>limit</th><th class=t>value</th></tr>");
    let thresholds = audit.thresholds();
    for (key, value) in thresholds.as_object().into_iter().flatten() {
        let value = if value.is_null() { "not looked at".into() } else { value.to_string() };
        let _ = write!(page, "<tr><td class=t><code>{key}</code></td><td class=t>{}</td></tr>", escape(&value));
    }
    page.push_str("</table>");
    if audit.warnings.is_empty() {
        return;
    }
    page.push_str("<h2>Odd, but read</h2><ul class=small>");
    for w in &audit.warnings {
        let _ = write!(
            page,
            "<li>{} × {}: <code>{}</code>: {}</li>",
            w.count,
            w.code,
            escape(&w.first_path.display().to_string()),
            escape(&w.first)
        );
    }
    page.push_str("</ul>");
}

/// Text from files must not become markup.
fn escape(text: &str) -> String {
    text.chars().fold(String::with_capacity(text.len()), |mut out, c| {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            _ => out.push(c),
        }
        out
    })
}

fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = (0..3).fold(0u32, |w, i| w << 8 | u32::from(chunk.get(i).copied().unwrap_or(0)));
        for i in 0..4 {
            let letter = LETTERS[(word >> (18 - 6 * i) & 63) as usize];
            text.push(if i <= chunk.len() { char::from(letter) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_is_as_in_the_standard_and_names_are_no_markup() {
        let known = ["", "Zg==", "Zm8=", "Zm9v", "Zm9vYg==", "Zm9vYmE=", "Zm9vYmFy"];
        (0..7).for_each(|n| assert_eq!(base64(&b"foobar"[..n]), known[n]));
        assert_eq!(escape("<a href=\"x\">&'"), "&lt;a href=&quot;x&quot;&gt;&amp;&#39;");
    }
}
