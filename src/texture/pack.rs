//! Packs rectangles into a small atlas along a skyline.

/// Atlas sides are multiples of this: the block size of GPU texture formats.
const BLOCK_PX: u32 = 4;

/// Where everything went.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Packing {
    /// Width and height of the atlas.
    pub size: [u32; 2],
    /// Top-left corner of each rectangle.
    pub at: Vec<[u32; 2]>,
}

/// Packs what `sizes` gives at scale 1, or at the largest scale tried below it that fits `max_px`.
///
/// `None` if gutters alone do not fit.
pub(super) fn fit(
    max_px: u32,
    power_of_two: bool,
    sizes: impl Fn(f64) -> Vec<[u32; 2]>,
) -> Option<(f64, Vec<[u32; 2]>, Packing)> {
    const SMALLEST_SCALE: f64 = 1e-9;
    let mut scale = 1.0;
    while scale > SMALLEST_SCALE {
        let rects = sizes(scale);
        if let Some(packing) = pack(&rects, max_px, power_of_two) {
            return Some((scale, rects, packing));
        }
        let room = f64::from(max_px) * f64::from(max_px);
        let area: f64 = rects.iter().map(|r| f64::from(r[0]) * f64::from(r[1])).sum();
        let side = rects.iter().flatten().copied().max().unwrap_or(0);
        let factor = (room / area).sqrt().min(f64::from(max_px) / f64::from(side));
        // At least 4 % smaller each time; gutters do not shrink, so one step may not do.
        scale *= factor.min(0.96);
    }
    None
}

/// Packs into the smallest atlas found, at most `max_px` a side; `None` if none was found.
pub(super) fn pack(rects: &[[u32; 2]], max_px: u32, power_of_two: bool) -> Option<Packing> {
    let max_px = if power_of_two { 1 << max_px.max(1).ilog2() } else { max_px / BLOCK_PX * BLOCK_PX };
    let round = |px: u32| {
        if power_of_two { px.max(BLOCK_PX).next_power_of_two() } else { px.max(1).next_multiple_of(BLOCK_PX) }
    };
    let widest = rects.iter().map(|r| r[0]).max().unwrap_or(1);
    let tallest = rects.iter().map(|r| r[1]).max().unwrap_or(1);
    if widest > max_px || tallest > max_px {
        return None;
    }
    let area: u64 = rects.iter().map(|r| u64::from(r[0]) * u64::from(r[1])).sum();
    if area > u64::from(max_px) * u64::from(max_px) {
        return None;
    }
    let mut order: Vec<usize> = (0..rects.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(rects[i][1]), std::cmp::Reverse(rects[i][0]), i));
    // Widths around that of a square of this area; the last one is tried only when nothing else fits.
    let square = (area as f64).sqrt();
    let width_of = |factor: f64| round(((square * factor).ceil() as u32).max(widest)).min(max_px);
    let mut widths: Vec<u32> = [0.71, 0.87, 1.0, 1.03, 1.07, 1.15, 1.25, 1.41, 2.0].map(width_of).to_vec();
    widths.push(max_px);
    let mut best: Option<(u64, u32, Packing)> = None;
    for (i, &width) in widths.iter().enumerate() {
        if widths[..i].contains(&width) || (i + 1 == widths.len() && best.is_some()) {
            continue;
        }
        let Some((at, used)) = place_all(rects, &order, width, max_px) else { continue };
        let size = used.map(round);
        if size[0] > max_px || size[1] > max_px {
            continue;
        }
        let key = (u64::from(size[0]) * u64::from(size[1]), size[0].abs_diff(size[1]));
        if best.as_ref().is_none_or(|(area, skew, _)| key < (*area, *skew)) {
            best = Some((key.0, key.1, Packing { size, at }));
        }
    }
    best.map(|(_, _, packing)| packing)
}

/// One stretch of the skyline: from `x` on, up to the next one, `y` is free.
#[derive(Clone, Copy)]
struct Ledge {
    x: u32,
    y: u32,
}

/// Puts each rectangle as high up as it goes, then as far left; also returns the used width and height.
fn place_all(rects: &[[u32; 2]], order: &[usize], width: u32, max_height: u32) -> Option<(Vec<[u32; 2]>, [u32; 2])> {
    let mut at = vec![[0, 0]; rects.len()];
    let mut used = [1, 1];
    // Closed by a ledge at the right border that nothing can stand on.
    let mut skyline = vec![Ledge { x: 0, y: 0 }, Ledge { x: width, y: u32::MAX }];
    for &i in order {
        let [w, h] = rects[i];
        let (first, y) = lowest(&skyline, w)?;
        if y.checked_add(h)? > max_height {
            return None;
        }
        let x = skyline[first].x;
        at[i] = [x, y];
        used = [used[0].max(x + w), used[1].max(y + h)];
        raise(&mut skyline, first, x + w, y + h);
    }
    Some((at, used))
}

/// The ledge where a rectangle of width `w` gets the smallest y, the leftmost of equals.
fn lowest(skyline: &[Ledge], w: u32) -> Option<(usize, u32)> {
    let right = skyline.last()?.x;
    let mut best: Option<(usize, u32)> = None;
    for first in 0..skyline.len() - 1 {
        let end = skyline[first].x + w;
        if end > right {
            break;
        }
        let limit = best.map_or(u32::MAX, |(_, y)| y);
        let mut y = 0;
        for ledge in skyline[first..].iter().take_while(|ledge| ledge.x < end) {
            y = y.max(ledge.y);
            if y >= limit {
                break;
            }
        }
        if y < limit {
            best = Some((first, y));
        }
    }
    best
}

/// Raises the skyline from ledge `first` to x = `end` to height `y`.
fn raise(skyline: &mut Vec<Ledge>, first: usize, end: u32, y: u32) {
    let past = first + skyline[first..].iter().take_while(|ledge| ledge.x < end).count();
    let rest = Ledge { x: end, y: skyline[past - 1].y };
    let keeps_rest = skyline[past].x > end;
    let start = Ledge { x: skyline[first].x, y };
    skyline.splice(first..past, [start].into_iter().chain(keeps_rest.then_some(rest)));
    if first > 0 && skyline[first - 1].y == y {
        skyline.remove(first);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn check(rects: &[[u32; 2]], packing: &Packing) {
        let mut taken = vec![false; (packing.size[0] * packing.size[1]) as usize];
        for (rect, at) in rects.iter().zip(&packing.at) {
            for y in at[1]..at[1] + rect[1] {
                for x in at[0]..at[0] + rect[0] {
                    assert!(x < packing.size[0] && y < packing.size[1], "outside");
                    let cell = &mut taken[(y * packing.size[0] + x) as usize];
                    assert!(!*cell, "two rectangles at {x}, {y}");
                    *cell = true;
                }
            }
        }
    }

    proptest! {
        #[test]
        fn rectangles_stay_inside_and_apart(
            rects in prop::collection::vec([1..60_u32, 1..60_u32], 0..80),
            power_of_two: bool,
        ) {
            let packing = pack(&rects, 512, power_of_two).unwrap();
            check(&rects, &packing);
            prop_assert!(packing.size.iter().all(|s| s % 4 == 0 && (!power_of_two || s.is_power_of_two())));
            prop_assert_eq!(pack(&rects, 512, power_of_two).unwrap(), packing);
        }
    }

    #[test]
    fn equal_squares_waste_little() {
        let rects = vec![[16, 16]; 256];
        assert_eq!(pack(&rects, 4096, false).unwrap().size, [256, 256]);
    }

    #[test]
    fn mixed_rectangles_fill_four_fifths() {
        let rects: Vec<_> = (0..400_u32).map(|i| [4 + i * 7919 % 61, 4 + i * 104_729 % 53]).collect();
        let packing = pack(&rects, 4096, false).unwrap();
        check(&rects, &packing);
        let area: u32 = rects.iter().map(|r| r[0] * r[1]).sum();
        assert!(f64::from(area) > 0.8 * f64::from(packing.size[0] * packing.size[1]), "{area} of {:?}", packing.size);
    }

    #[test]
    fn what_does_not_fit_is_scaled_down_until_it_does() {
        let sizes = |scale: f64| vec![[(1000.0 * scale).ceil() as u32 + 4, (10.0 * scale).ceil() as u32 + 4]; 20];
        let (scale, rects, packing) = fit(256, false, sizes).unwrap();
        check(&rects, &packing);
        assert!(packing.size[0] <= 256 && scale > 0.2 && scale < 0.26, "{scale}");
        assert!(fit(64, false, |_| vec![[65, 1]]).is_none());
        assert!(pack(&[[u32::MAX, u32::MAX]], 64, false).is_none());
    }
}
