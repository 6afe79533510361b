//! The audit as one HTML page: no script, no network, readable in two minutes.
//!
//! In: an [`Audit`] and its tileset. Out: text. The verdict comes first, then why, then the figures, the pictures of the
//! worst tiles beside what they stand for, and every limit that was applied.

use std::fmt::Write;

use self::figures::{curves, levels, loads, obstacles, seams, table};
use self::pictures::{pictures, worst};
use super::distance::Verdict;
use super::findings::Group;
use super::{Audit, verdict};
use crate::Result;

mod figures;
mod pictures;

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_no_markup() {
        assert_eq!(escape("<a href=\"x\">&'"), "&lt;a href=&quot;x&quot;&gt;&amp;&#39;");
    }
}
