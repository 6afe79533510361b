//! The tables and curves of the page.

use std::fmt::Write;

use super::super::Audit;
use super::super::distance::Against;
use super::super::envelope::CELL_M;
use super::super::summary::Row;
use super::escape;
use crate::draw::plot::{Axis, LineChart, Series};

pub(super) fn table(audit: &Audit, page: &mut String) {
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

pub(super) fn curves(audit: &Audit, page: &mut String) {
    let of_level =
        |level: u32| audit.structure.levels.iter().find(|l| l.level == level).map(|l| l.sum.triangles as f64);
    let rows: Vec<_> = audit.rows.iter().filter(|r| r.class.is_none()).collect();
    if rows.len() < 2 {
        return;
    }
    let series = |name: &str, dashed: bool, of: &dyn Fn(&Row) -> f64| Series {
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
    let by_level = |of: &dyn Fn(&Row) -> f64| rows.iter().map(|r| [f64::from(r.level), of(r)]).collect();
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

pub(super) fn loads(audit: &Audit, page: &mut String) {
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

pub(super) fn seams(audit: &Audit, page: &mut String) {
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

pub(super) fn obstacles(audit: &Audit, safe_m: f64, page: &mut String) {
    let _ = write!(
        page,
        "<h2>Obstacles: tiling error alone</h2><p>How far each level sinks below the true top, on a grid of {} m. Limit: {safe_m} m. \
         <b>The error of the survey comes on top.</b></p><table><tr><th>level</th><th class=t>class</th><th>m²</th><th>LE90, m</th>\
         <th>P99.9, m</th><th>max, m</th><th>lateral p95, m</th><th>lateral max, m</th><th>lost</th><th class=t>Annex 15 figure</th></tr>",
        CELL_M
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

pub(super) fn levels(audit: &Audit, page: &mut String) {
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
