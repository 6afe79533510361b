//! The worst tiles: a list, their faults in full, and pictures beside what they stand for.

use std::fmt::Write;

use glam::DVec3;

use super::super::cover::{self, Cover, Loader, Shown};
use super::super::distance::{Against, TileDistance, Verdict};
use super::super::{Audit, structure, view};
use super::escape;
use crate::Result;
use crate::draw::panel::{Legend, Panel, grid};
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

pub(super) fn worst(audit: &Audit, page: &mut String) {
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
        let p95 = view::p95(d).map_or("-".into(), |p| format!("{p:.3}"));
        let texel = d.texture_error_m.map_or("-".into(), |t| format!("{:.3}", t / structure::SSE_PX));
        let place = d.worst.map_or(String::new(), |w| {
            let side = if w.is_on_reference { "lost" } else { "invented" };
            format!("<code>{}</code> {side}", cover::place(&audit.tileset, DVec3::from_array(w.local_m)))
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

pub(super) fn pictures(audit: &Audit, page: &mut String) -> Result<()> {
    let mut loader = Loader::new(&audit.tileset, audit.config.budget);
    let cover = Cover::of(&audit.tileset);
    let most_faces = audit.config.budget.drawn_faces().min(MOST_DRAWN_FACES);
    let faces_below = |d: &TileDistance| {
        let finest = cover.finest(&audit.tileset, d.tile);
        finest.iter().map(|&t| audit.structure.tiles.get(t).map_or(0, |f| f.triangles as usize)).sum::<usize>()
    };
    let of_tiles: Vec<&TileDistance> = by_badness(audit)
        .into_iter()
        .filter(|d| d.against != Against::NextTiles && cover.has_finer(d.tile) && faces_below(d) <= most_faces)
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
    let stands_for = if d.against == Against::Original { "the finest tiles below it" } else { "what it stands for" };
    let panel = |title: &str, picture| Panel { title: title.into(), picture, legend: None };
    let panels = [
        panel(stands_for, draw(reference, Paint::Solid([186, 190, 196]))),
        panel("what it lost of it", draw(reference, Paint::VertexValues(&lost, &scale))),
        panel("the tile: what it invented", draw(shown, Paint::VertexValues(&own, &scale))),
    ];
    grid("", &panels, 3, Some(&Legend::Scale(scale)), 1)
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
    fn base64_is_as_in_the_standard() {
        let known = ["", "Zg==", "Zm8=", "Zm9v", "Zm9vYg==", "Zm9vYmE=", "Zm9vYmFy"];
        (0..7).for_each(|n| assert_eq!(base64(&b"foobar"[..n]), known[n]));
    }
}
