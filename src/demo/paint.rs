//! The colour of every point of the city, before light: asphalt, lawns, tiles, plaster, glass, leaves, cars.
//!
//! Colours are sRGB, 0 to 1; texels are 5 to 8 cm, so nothing finer than that is drawn.

use glam::{DVec2, DVec3, Vec3};

use super::field::Field;
use super::ground::{PAVEMENT_M, Use};
use super::noise::{lattice, value2, value3};
use super::solid::{Building, Car, Kind, Matter, Opening, Roof, Shape, Skin, Tree, box2};

fn rgb(c: [f32; 3]) -> Vec3 {
    Vec3::from_array(c)
}

fn gray(v: f32) -> Vec3 {
    Vec3::splat(v)
}

/// A number in [0, 1] for a thing and a salt.
fn dice(seed: u32, salt: u32) -> f32 {
    0.5 + 0.5 * lattice(salt as i32, 17, 3, seed)
}

/// Colour of a point of thing `id` (or of the ground) with a surface normal.
pub(super) fn color(field: &Field, id: u32, p: DVec3, normal: DVec3) -> Vec3 {
    match field.things.get(id as usize).map(|t| &t.shape) {
        None => ground(field, p.truncate()),
        Some(Shape::Building(b)) => building(b, p, normal),
        Some(Shape::Tree(t)) => tree(t, p),
        Some(Shape::Car(c)) => car(c, c.frame.local(p), normal),
        Some(Shape::Lamp { foot, .. }) => gray(if p.z - foot.z > 4.9 { 0.72 } else { 0.34 }),
        Some(Shape::Fence { matter: Matter::Hedge, .. }) => leaves(p, [0.24, 0.34, 0.14]),
        Some(Shape::Fence { frame, half, .. }) => {
            let l = frame.local(p);
            if l.z > half.z - 0.15 { gray(0.55) } else { masonry(DVec2::new(l.x, l.z), [0.66, 0.60, 0.52], 0.5) }
        }
    }
}

fn leaves(p: DVec3, base: [f32; 3]) -> Vec3 {
    let clumps = 0.24 * value3(p / 0.6, 11) + 0.30 * value3(p / 0.19, 12);
    let warm = 0.03 * value3(p / 1.3, 13);
    (rgb(base) + Vec3::new(warm, warm * 0.4, 0.0)) * (1.0 + clumps)
}

// ---- ground

fn asphalt(p: DVec2) -> Vec3 {
    let mut v = 0.40 + 0.035 * value2(p / 7.0, 21) + 0.02 * value2(p / 0.9, 22) + 0.03 * value2(p / 0.13, 23);
    let crack = value2(p / 2.7 + DVec2::splat(f64::from(value2(p / 0.8, 24)) * 0.12), 25);
    if crack.abs() < 0.012 && value2(p / 11.0, 26) > 0.1 {
        v -= 0.12;
    }
    Vec3::new(v, v, v * 1.02)
}

fn grass(p: DVec2) -> Vec3 {
    let dry = 0.5 + 0.5 * value2(p / 6.0, 31);
    let base = rgb([0.32, 0.40, 0.20]).lerp(rgb([0.47, 0.47, 0.29]), dry * 0.6);
    let bare = value2(p / 3.3, 34) + 0.4 * value2(p / 0.7, 35);
    let base = if bare > 0.95 { rgb([0.48, 0.40, 0.29]) } else { base };
    base * (1.0 + 0.10 * value2(p / 0.7, 32) + 0.13 * value2(p / 0.16, 33))
}

fn sand(p: DVec2) -> Vec3 {
    rgb([0.69, 0.62, 0.50]) * (1.0 + 0.06 * value2(p / 2.0, 36) + 0.07 * value2(p / 0.14, 37))
}

fn slabs(at: DVec2, size: f64, base: [f32; 3]) -> Vec3 {
    let cell = (at / size).floor();
    let edge = ((at / size - cell) - 0.5).abs().max_element();
    let tone = 1.0 + 0.05 * lattice(cell.x as i32, cell.y as i32, 0, 41) + 0.05 * value2(at / 0.15, 42);
    let stain = 1.0 + 0.06 * value2(at / 2.5, 43);
    rgb(base) * (tone * stain * if edge > 0.5 - 0.045 / size { 0.80 } else { 1.0 })
}

fn ground(field: &Field, p: DVec2) -> Vec3 {
    let land = &field.ground;
    let town = land.town(p);
    let spot = land.spot(town);
    if spot.kerb_m < 0.0 {
        let (u, v) = (land.us[spot.across_u.0], land.vs[spot.across_v.0]);
        let (du, dv) = (spot.across_u.1.abs() - u.half, spot.across_v.1.abs() - v.half);
        return match (du < 0.0, dv < 0.0) {
            (true, true) => asphalt(p),
            (true, false) => road(p, spot.across_u.1, town.y, dv, u.half),
            _ => road(p, spot.across_v.1, town.x, du, v.half),
        };
    }
    if spot.kerb_m < 0.25 {
        return gray(0.66 + 0.04 * value2(p / 0.2, 44));
    }
    if spot.kerb_m < PAVEMENT_M {
        return slabs(town, 0.8, [0.62, 0.60, 0.57]);
    }
    let Some((i, j)) = land.block(town) else { return grass(p) };
    let (low, high) = land.rect(i, j);
    let (at, size) = (town - low, high - low);
    match land.land_use(i, j) {
        Use::Perimeter if value2(p / 9.0, 45) > -0.15 => grass(p),
        Use::Perimeter => slabs(town, 0.6, [0.58, 0.52, 0.47]),
        Use::Houses => garden(p, town, at, size),
        Use::Slabs => car_park(p, at, size),
        Use::Park => park(p, at, size),
    }
}

/// A carriageway: `across` from its middle, `along` it, `to_crossing` metres from the next crossing.
fn road(p: DVec2, across: f64, along: f64, to_crossing: f64, half: f64) -> Vec3 {
    let mut base = asphalt(p);
    let repair = lattice((along / 11.0).floor() as i32, (across / 2.3).floor() as i32, 0, 51);
    if repair > 0.72 {
        base *= 0.86;
    }
    let wear = 0.5 + 0.5 * value2(p / 0.5, 52);
    let white = base.lerp(gray(0.88), 0.65 + 0.35 * wear);
    let dashed = across.abs() < 0.08 && along.rem_euclid(6.0) < 3.0 && to_crossing > 6.0;
    let parking = (across.abs() - (half - 2.1)).abs() < 0.06 && to_crossing > 5.5;
    let bay = across.abs() > half - 2.1 && (along - 3.1).rem_euclid(6.2) < 0.12 && to_crossing > 5.5;
    let zebra =
        (0.8..3.8).contains(&to_crossing) && across.abs() < half - 0.3 && (across + 100.0).rem_euclid(1.0) < 0.5;
    if dashed || parking || bay || zebra {
        return white;
    }
    let cover = DVec2::new(across - 0.9, (along + 7.0).rem_euclid(23.0) - 11.0).length();
    if cover < 0.38 {
        return gray(if cover > 0.3 { 0.22 } else { 0.30 });
    }
    // Tyres darken two tracks a lane; gutters collect dirt.
    let track = ((across.abs() - 1.5).abs() - 0.75).abs();
    base * (1.0 - 0.05 * (1.0 - (track / 0.4).min(1.0)) as f32 - if across.abs() > half - 0.25 { 0.12 } else { 0.0 })
}

fn garden(p: DVec2, town: DVec2, at: DVec2, size: DVec2) -> Vec3 {
    let lots = (size.x / 16.5).round().max(1.0);
    let width = size.x / lots;
    let x = at.x.rem_euclid(width) - width / 2.0;
    let y = at.y.min(size.y - at.y);
    let drive = x > width / 2.0 - 4.2 && x < width / 2.0 - 0.5 && y < 9.0;
    let path = (x + width / 2.0 - 6.0).abs() < 0.6 && y < 7.0;
    let terrace = x < 1.0 && x > -width / 2.0 + 2.0 && (13.0..17.0).contains(&y);
    if drive || path {
        return slabs(town, 0.5, [0.57, 0.52, 0.50]);
    }
    if terrace {
        return slabs(town, 0.6, [0.68, 0.63, 0.55]);
    }
    let lot = (at.x / width).floor() as i32;
    let bed = lattice(lot, (at.y > size.y / 2.0).into(), 0, 61) > 0.1 && x > 1.5 && (18.0..22.0).contains(&y);
    if bed {
        let row = (at.y.rem_euclid(0.8) - 0.4).abs() < 0.2;
        let tint = if row { rgb([0.30, 0.36, 0.17]) } else { rgb([0.42, 0.33, 0.24]) };
        return tint * (1.0 + 0.15 * value2(p / 0.18, 62));
    }
    grass(p)
}

fn car_park(p: DVec2, at: DVec2, size: DVec2) -> Vec3 {
    let v = at.y - size.y / 2.0;
    let within = (2.5..size.x - 2.5).contains(&at.x);
    if v.abs() < 8.2 && within {
        let bays = ((size.x - 8.0) / 2.6).floor();
        let x = at.x - 4.0;
        let line = v.abs() > 3.0 && (-0.1..bays * 2.6 + 0.1).contains(&x) && (x + 0.05).rem_euclid(2.6) < 0.11;
        let base = asphalt(p + DVec2::splat(31.0)) * 0.95;
        return if line { base.lerp(gray(0.86), 0.8) } else { base };
    }
    let path = (v.abs() - 9.6).abs() < 0.9 && within;
    if path { slabs(at, 0.6, [0.62, 0.60, 0.57]) } else { grass(p) }
}

fn park(p: DVec2, at: DVec2, size: DVec2) -> Vec3 {
    let cross = (at.x - 0.5 * size.x).abs().min((at.y - 0.35 * size.y).abs());
    let round = (at.distance(size * DVec2::new(0.5, 0.35)) - 6.0).max(0.0);
    let church = box2(at - size * DVec2::new(0.30, 0.62), DVec2::new(15.0, 8.0)).max(0.0);
    let wobble = 0.25 * f64::from(value2(p / 1.5, 71));
    if cross.min(round).min(church) < 1.5 + wobble { sand(p) } else { grass(p) }
}

// ---- buildings

fn masonry(at: DVec2, base: [f32; 3], size: f64) -> Vec3 {
    let row = (at.y / (size * 0.5)).floor();
    let x = at.x / size + 0.5 * row.rem_euclid(2.0);
    let joint = (x - x.floor() < 0.12) || (at.y / (size * 0.5) - row) < 0.2;
    let tone = 1.0 + 0.10 * lattice(x.floor() as i32, row as i32, 0, 81);
    rgb(base) * if joint { 1.12 } else { tone }
}

fn building(b: &Building, p: DVec3, normal: DVec3) -> Vec3 {
    let l = b.frame.local(p);
    let facing = DVec3::new(b.frame.x.dot(normal.truncate()), b.frame.x.perp_dot(normal.truncate()), normal.z);
    match b.distance(l).1 {
        Skin::Wall => wall(b, l),
        Skin::Roof => roof(b, l, facing),
        Skin::Fixture(i) => {
            let fixture = b.fixtures[usize::from(i)];
            let q = l - fixture.centre;
            match fixture.kind {
                Kind::Chimney if q.z > fixture.half.z - 0.2 => gray(0.30),
                Kind::Chimney => masonry(DVec2::new(q.x + q.y, q.z), [0.55, 0.33, 0.26], 0.3),
                Kind::Unit if normal.z > 0.7 => gray(0.66 + 0.03 * value3(p / 0.4, 82)),
                Kind::Unit => gray(if q.z.rem_euclid(0.3) < 0.09 { 0.46 } else { 0.62 }),
                Kind::Balcony => balcony(b, q, fixture.half, normal.z),
                Kind::Dormer => dormer(b, q, fixture.half, normal.z, l),
            }
        }
    }
}

fn balcony(b: &Building, q: DVec3, half: DVec3, up: f64) -> Vec3 {
    if up > 0.6 {
        return gray(0.60);
    }
    if q.z < -half.z + 0.22 || q.z > half.z - 0.12 {
        return rgb(b.style.wall) * 0.95;
    }
    let bar = (q.x + q.y).rem_euclid(0.24) < 0.1;
    if b.style.band_windows { gray(0.74).lerp(rgb(b.style.roof), 0.25) } else { gray(if bar { 0.30 } else { 0.5 }) }
}

fn dormer(b: &Building, q: DVec3, half: DVec3, up: f64, l: DVec3) -> Vec3 {
    if up > 0.45 {
        return tiles(b, DVec2::new(q.y, q.z * 1.6), 0.95, l);
    }
    // The front: a window in a light frame.
    if half.y - q.y.abs() < 0.35 {
        let frame = (DVec2::new(q.x, q.z - 0.05).abs() - DVec2::new(0.55, 0.62)).max_element();
        let cross = q.x.abs() < 0.05;
        return if frame < -0.08 && !cross {
            gray(0.17)
        } else if frame < 0.06 {
            gray(0.88)
        } else {
            gray(0.72)
        };
    }
    rgb(b.style.roof) * 0.72
}

/// Rows of roof tiles; `at` runs along the eaves and up the slope.
fn tiles(b: &Building, at: DVec2, tone: f32, l: DVec3) -> Vec3 {
    let (row, column) = ((at.y / 0.34).floor(), at.x / 0.26 + 0.5 * (at.y / 0.34).floor().rem_euclid(2.0));
    let lap = at.y / 0.34 - row;
    let mut v = tone * (1.0 + 0.10 * lattice(column.floor() as i32, row as i32, 0, b.style.seed));
    v *= if lap < 0.22 { 0.78 } else { 1.0 } * if column - column.floor() < 0.2 { 0.93 } else { 1.0 };
    // Dirt runs down the slope; moss grows in patches.
    v *= 1.0 + 0.10 * value2(DVec2::new(at.x / 0.5, at.y / 5.0), b.style.seed ^ 1) + 0.08 * value3(l / 3.0, 91);
    let moss = (value3(l / 1.9, b.style.seed ^ 2) - 0.45).max(0.0) * 0.6;
    (rgb(b.style.roof) * v).lerp(rgb([0.35, 0.36, 0.22]), moss)
}

fn roof(b: &Building, l: DVec3, facing: DVec3) -> Vec3 {
    let plan = box2(l.truncate(), b.half);
    if let Roof::Flat { thickness_m, .. } = b.roof {
        if plan > -thickness_m + 0.1 {
            return gray(0.70) * (1.0 + 0.05 * value3(l / 0.8, 92));
        }
        let grain = 0.10 * value2(l.truncate() / 0.14, 93) + 0.05 * value2(l.truncate() / 0.6, 94);
        let damp = (value2(l.truncate() / 3.7, b.style.seed) - 0.25).max(0.0) * 0.5;
        let sheet = if (l.x + 50.0).rem_euclid(4.0) < 0.1 { 0.85 } else { 1.0 };
        return rgb(b.style.roof) * ((1.0 + grain) * (1.0 - damp) * sheet);
    }
    if matches!(b.roof, Roof::Shed(s) if s < 0.1) {
        let seam = if (l.x + 50.0).rem_euclid(1.0) < 0.1 { 0.8 } else { 1.0 };
        return rgb(b.style.roof) * (seam * (1.0 + 0.05 * value3(l / 0.5, 95)));
    }
    let gutter = plan > -0.16 && l.z < b.eave + 0.5;
    if gutter {
        return gray(0.36);
    }
    if b.ridge() - l.z < 0.14 {
        return rgb(b.style.roof) * 1.1;
    }
    let up = l.z - b.eave;
    let on_hip = facing.x.abs() > facing.y.abs();
    let (along, mut inset) = if on_hip { (l.y, b.half.x - l.x.abs()) } else { (l.x, b.half.y - l.y.abs()) };
    let tangent = match b.roof {
        Roof::Gable(s) | Roof::Hip(s) => s,
        Roof::Shed(s) => {
            inset = l.y + b.half.y;
            s
        }
        // The steep part or the shallow one, see `Building::over_roof`.
        _ => {
            if facing.z < 0.7 {
                2.6
            } else {
                0.3
            }
        }
    };
    // Along the slope itself, which noise across the slope does not move.
    let cosine = 1.0 / (1.0 + tangent * tangent).sqrt();
    let up_slope = (inset + up * tangent) * cosine;
    let top = (b.ridge() - b.eave) / (tangent * cosine);
    // The street side of gables, all of a shed.
    let solar_side = l.y < 0.0 || matches!(b.roof, Roof::Shed(_));
    if b.style.solar && !on_hip && solar_side && b.roof != Roof::Mansard {
        let (x, y) = (along + 0.62 * b.half.x, up_slope - 0.3 * top);
        if (0.0..1.2 * b.half.x).contains(&x) && (0.0..0.5 * top).contains(&y) {
            let rim = x.rem_euclid(1.0) < 0.08 || y.rem_euclid(1.6) < 0.08;
            return if rim { gray(0.55) } else { rgb([0.10, 0.13, 0.22]) * (1.0 + 0.1 * value2(DVec2::new(x, y), 96)) };
        }
    }
    tiles(b, DVec2::new(along, up_slope), 1.0, l)
}

fn wall(b: &Building, l: DVec3) -> Vec3 {
    let (side, _) = b.wall_at(l);
    let along = if side < 2 { l.x } else { l.y };
    let style = &b.style;
    if let Some(found) = b.opening(side, l).and_then(|opening| window(b, &opening)) {
        return found;
    }
    let mut base = if style.brick {
        masonry(DVec2::new(along, l.z), style.wall, 0.34)
    } else {
        rgb(style.wall) * (1.0 + 0.02 * value2(DVec2::new(along, l.z) / 0.15, 101))
    };
    // Rain streaks from above, splashes from below.
    base *= 1.0 + 0.06 * value2(DVec2::new(along / 0.6, l.z / 5.0), style.seed) + 0.05 * value3(l / 4.0, 102);
    if l.z < 0.55 {
        base = base.lerp(gray(0.45), 0.65);
    }
    let shop_sign = style.shop && side == 0 && b.windows[0] && (2.65..3.05).contains(&l.z) && b.floors > 1;
    if shop_sign {
        let hue = dice(style.seed, 7);
        return rgb([0.25 + 0.4 * hue, 0.22 + 0.1 * dice(style.seed, 8), 0.55 - 0.4 * hue]);
    }
    let storey = l.z.rem_euclid(b.floor_m);
    if b.windows[side] && dice(style.seed, 9) > 0.5 && b.floors > 2 && l.z > 1.0 && l.z < b.eave && storey < 0.16 {
        base *= 1.10;
    }
    if l.z > b.eave - 0.3 && l.z < b.eave + 0.05 {
        // Shade and cornice under the eaves.
        base *= if l.z > b.eave - 0.12 { 0.62 } else { 0.82 };
    }
    base
}

/// The parts of a window, door or shop front around a point; none on the bare wall.
fn window(b: &Building, opening: &Opening) -> Option<Vec3> {
    let style = &b.style;
    let (at, half) = (opening.at, opening.half);
    let rim = (at.abs() - half).max_element();
    let seed = style.seed ^ opening.id.wrapping_mul(0x9e37);
    let trim = (rgb(style.wall) * 1.18).min(gray(0.95));
    if rim > 0.0 {
        let sill =
            at.y < -half.y && at.y > -half.y - 0.16 && at.x.abs() < half.x + 0.14 && !opening.door && !opening.shop;
        if sill {
            return Some(gray(0.80));
        }
        if rim < 0.13 && !style.band_windows {
            return Some(if style.brick { gray(0.78) } else { trim });
        }
        let shutter = style.shutters && at.x.abs() > half.x && at.x.abs() < half.x + 0.5 && at.y.abs() < half.y;
        if shutter && !opening.door && !opening.shop {
            let green = dice(style.seed, 3) > 0.5;
            let base = if green { rgb([0.24, 0.36, 0.28]) } else { rgb([0.42, 0.28, 0.20]) };
            return Some(base * if at.y.rem_euclid(0.18) < 0.07 { 0.78 } else { 1.0 });
        }
        return None;
    }
    if opening.door {
        let base = [[0.34, 0.22, 0.15], [0.20, 0.28, 0.24], [0.24, 0.25, 0.30]][(style.seed % 3) as usize];
        let panel = at.x.abs() > 0.1 && at.x.abs() < 0.45 && at.y.abs() > 0.1 && at.y.abs() < 0.8;
        return Some(if at.y > 0.78 { gray(0.25) } else { rgb(base) * if panel { 0.85 } else { 1.0 } });
    }
    let frame = if dice(style.seed, 4) > 0.25 { gray(0.90) } else { rgb([0.38, 0.27, 0.20]) };
    let pitch = if opening.shop || style.band_windows { 1.2 } else { 2.0 * half.x };
    let mullion = (opening.at.x + half.x).rem_euclid(pitch / 2.0);
    let bar = mullion < 0.05 || mullion > pitch / 2.0 - 0.05 || (!opening.shop && (at.y - 0.3 * half.y).abs() < 0.04);
    if rim > -0.09 || bar {
        return Some(if opening.shop { gray(0.28) } else { frame });
    }
    // Glass: dark below, sky above, now and then a curtain or a blind.
    let height = (0.5 + 0.5 * at.y / half.y) as f32;
    let sky = 0.25 + 0.5 * dice(seed, 5);
    let mut glass = rgb([0.10, 0.12, 0.15]).lerp(rgb([0.36, 0.44, 0.54]), height * sky);
    let diagonal = ((at.x + at.y) / (half.x + half.y)) as f32;
    glass += gray(0.05 * diagonal.max(0.0));
    if !opening.shop && dice(seed, 6) > 0.72 && (1.0 - height) < dice(seed, 7) {
        glass = gray(0.72 - 0.15 * dice(seed, 8));
    }
    Some(glass)
}

// ---- clutter

fn tree(t: &Tree, p: DVec3) -> Vec3 {
    let d = p - t.foot;
    if d.z < 0.3 * t.height && d.truncate().length() < 0.55 && !t.conifer {
        return rgb([0.33, 0.26, 0.20]) * (1.0 + 0.2 * value3(p / 0.2, 111));
    }
    let (young, old) = (dice(t.seed, 1), dice(t.seed, 2));
    let base = if t.conifer {
        [0.15 + 0.05 * young, 0.25 + 0.04 * old, 0.15]
    } else {
        [0.26 + 0.14 * young, 0.38 + 0.06 * old, 0.13 + 0.06 * old]
    };
    let high = ((d.z / t.height) as f32).clamp(0.0, 1.0);
    leaves(p, base) * (0.70 + 0.38 * high)
}

fn car(c: &Car, l: DVec3, normal: DVec3) -> Vec3 {
    let wheel = DVec2::new(l.x.abs() - 0.62 * c.half.x, l.z - 0.32).length();
    if wheel < 0.36 && l.y.abs() > c.half.y - 0.35 && normal.z < 0.6 {
        return gray(if wheel < 0.18 { 0.50 } else { 0.10 });
    }
    if l.z < 0.28 {
        return gray(0.14);
    }
    let top = if c.van { 2.05 } else { 1.5 };
    let glass_from = if c.van { 1.25 } else { 0.98 };
    let pillar = l.y.abs() > c.half.y - 0.3 && ((l.x + 0.25).abs() % 1.05) < 0.07;
    if l.z > glass_from && l.z < top - 0.10 && normal.z < 0.88 && !pillar && (!c.van || l.x > 0.4) {
        return rgb([0.11, 0.13, 0.16]) + gray(0.10 * normal.z.max(0.0) as f32);
    }
    if l.x.abs() > c.half.x - 0.3 && l.y.abs() > 0.45 && (0.5..0.78).contains(&l.z) {
        return if l.x > 0.0 { gray(0.90) } else { rgb([0.62, 0.08, 0.08]) };
    }
    rgb(c.paint) * (0.95 + 0.12 * normal.z.max(0.0) as f32)
}
