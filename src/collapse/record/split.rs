//! What a split is made of, and how each part of it is predicted.
//!
//! # Method
//! 1. Which vertex splits: any of those that live; of [`GROUP`] splits at once.
//! 2. Which faces go to the new vertex: a bit a face around the fan, under how often the side has changed so far, and how
//!    far the face lies on the side to which the neighbours lie.
//! 3. Which faces appear: for each neighbour their number, under how many faces on either side use it; then their turn,
//!    that their neighbours foretell, and their class.
//! 4. Where the new vertex is: off a mean of its neighbours; along the surface first, then off its plane.
//! 5. Where the old vertex was, if it moved.
//! 6. The largest deviation of each class, off the distance from the new vertex to the coarse faces, under what it was when
//!    the vertex was split last; the energy.

use glam::DVec3;

use super::coder::{Coder, Number, Prob, Tree};
use super::level::level_of;
use super::live::{Fold, Grid, Live, Star, Wing, vec};
use crate::collapse::record::MAX_CLASSES;
use crate::geo::bvh::closest_on_triangle;

/// A split in the record's own numbers.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Split {
    /// The vertex that splits.
    pub kept: u32,
    /// Per face of its star: goes to the new vertex.
    pub leaves: Vec<bool>,
    /// Faces that appear between the two.
    pub wings: Vec<Wing>,
    /// Faces that appear beside those they were folded onto.
    pub folds: Vec<Fold>,
    /// Where the vertex is afterwards.
    pub kept_at: Grid,
    /// Where the new one is.
    pub gone_at: Grid,
    /// Level of the largest deviation of each class that the collapse caused.
    pub deviation: [u8; MAX_CLASSES],
}

/// The vertices of so many splits are told ahead, so that a reader can fetch their stars at once.
pub const GROUP: usize = 32;

/// Coordinates beyond this are nonsense: they could not be told apart in f64.
pub const MOST_COORDINATE: i64 = 1 << 51;

/// Everything learned while coding.
pub struct Models {
    sides: Vec<Prob>,
    wings: Vec<Prob>,
    far: Prob,
    folds: [Prob; 7],
    turned: [Prob; 2],
    class_as: Vec<Prob>,
    class: Tree<32>,
    moved: [Prob; 2],
    /// By kind of axis, then by the size of what is around.
    along: Vec<Number>,
    off: Vec<Number>,
    has: Vec<Prob>,
    deviation: Vec<Number>,
    same: [Prob; 4],
    /// Per vertex: the levels of the split that made it or, later, split it.
    near: Vec<[u8; MAX_CLASSES]>,
    energy: [Number; 2],
    was_moved: bool,
    was_level: i16,
    was_energy_delta: bool,
    classes: usize,
    step_m: f64,
    /// An empty list that has room already.
    spare: Vec<Wing>,
}

/// Where the new vertex lies, seen from the one it splits off: so many times the mean of the neighbours that go to it, of
/// the two that both have, and of those that stay; for one, two, three and more neighbours that go. First where vertices
/// stay, then where they move. Fitted to the absolute errors of a campus and a building, which agree.
const SHARES: [[[f64; 3]; 4]; 2] = [
    [[0.27, 0.2, -0.06], [0.4, 0.07, -0.05], [0.43, -0.01, -0.04], [0.42, -0.06, -0.03]],
    [[0.225, 0.13, -0.04], [0.29, 0.045, -0.015], [0.28, -0.01, 0.0], [0.2, -0.02, 0.01]],
];
/// The same where there are others than those two: so much of the way to the middle of all.
const SHARE_OF_ALL: f64 = 0.7;
/// Faces by how far they lie towards the middle of the neighbours, where the new vertex is to be looked for.
const BENDS: [f64; 7] = [-0.2, -0.08, -0.02, 0.03, 0.1, 0.2, 0.4];
/// Contexts of one kind of size: a power of two each.
const SIZES: usize = 64;

impl Models {
    /// Knows nothing yet. `classes` is at most [`MAX_CLASSES`].
    pub fn new(classes: usize, step_m: f64) -> Self {
        Self {
            sides: vec![Prob::default(); 128 * (BENDS.len() + 1)],
            wings: vec![Prob::default(); 81],
            far: Prob::default(),
            folds: Default::default(),
            turned: Default::default(),
            class_as: vec![Prob::default(); 96],
            class: Tree::default(),
            moved: Default::default(),
            along: vec![Number::default(); 6 * SIZES],
            off: vec![Number::default(); 2 * SIZES],
            has: vec![Prob::default(); 8 * MAX_CLASSES],
            deviation: vec![Number::default(); 41],
            same: Default::default(),
            near: Vec::new(),
            energy: Default::default(),
            was_moved: false,
            was_level: 0,
            was_energy_delta: false,
            classes,
            step_m,
            spare: Vec::new(),
        }
    }

    /// Codes which vertex splits, of so many.
    pub fn code_kept(&mut self, coder: &mut impl Coder, vertices: usize, kept: u32) -> u32 {
        coder.uniform(vertices as u32, kept)
    }

    /// Codes the rest of `split`, whose star is `star`, with at most `most` new faces.
    ///
    /// # Errors
    /// What is wrong with it; only a decoder finds fault.
    pub fn code(
        &mut self,
        coder: &mut impl Coder,
        live: &Live,
        star: &mut Star,
        split: &mut Split,
        most: usize,
    ) -> Result<(), &'static str> {
        self.code_sides(coder, star, vec(live.at(split.kept)), &mut split.leaves);
        star.count_sides(&split.leaves);
        self.code_wings(coder, live, star, split, most)?;
        self.code_folds(coder, live, star, split, most)?;
        self.code_positions(coder, live, star, split)?;
        self.code_deviation(coder, live, star, split);
        Ok(())
    }

    fn code_sides(&mut self, coder: &mut impl Coder, star: &Star, at: DVec3, leaves: &mut Vec<bool>) {
        leaves.resize(star.spokes.len(), false);
        let count = star.rims.len().max(1) as f64;
        let middle = star.rims.iter().map(|r| r.at - at).sum::<DVec3>() / count;
        let reach = star.rims.iter().map(|r| (r.at - at).length()).sum::<f64>() / count;
        let towards = if reach > 0.0 { middle / (reach * reach) } else { DVec3::ZERO };
        let (mut before, mut changes, mut run) = (false, 0usize, 0u32);
        for (spoke, leaves) in star.spokes.iter().zip(leaves.iter_mut()) {
            let left = spoke.left.min(3) as usize;
            let context = if spoke.begins {
                (changes, run) = (0, 0);
                120 + 4 * usize::from(spoke.closed) + left
            } else {
                let of_run = run.min(2) as usize - 1;
                (((usize::from(spoke.closed) * 3 + changes.min(2)) * 2 + usize::from(before)) * 4 + left) * 2 + of_run
            };
            let [a, b] = star.ends(spoke);
            let share = ((a + b) * 0.5 - at).dot(towards);
            let bend = BENDS.iter().filter(|b| share > **b).count();
            *leaves = coder.bit(&mut self.sides[context * (BENDS.len() + 1) + bend], *leaves);
            let same = spoke.begins || *leaves == before;
            changes += usize::from(!same);
            run = if same { run + 1 } else { 1 };
            before = *leaves;
        }
    }

    fn code_wings(
        &mut self,
        coder: &mut impl Coder,
        live: &Live,
        star: &Star,
        split: &mut Split,
        most: usize,
    ) -> Result<(), &'static str> {
        let mut given = std::mem::replace(&mut split.wings, std::mem::take(&mut self.spare));
        let wings = &mut split.wings;
        for rim in &star.rims {
            for so_far in 0.. {
                let next = given.iter().position(|w| w.apex == rim.vertex);
                let sides = rim.stay.min(2) as usize * 3 + rim.leave.min(2) as usize;
                let context = (sides * 3 + so_far.min(2)) * 3 + wings.len().min(2);
                if !coder.bit(&mut self.wings[context], next.is_some()) {
                    break;
                }
                if wings.len() >= most {
                    return Err("more faces than it says it has");
                }
                let mut wing = next.map_or_else(Wing::default, |i| given.remove(i));
                wing.apex = rim.vertex;
                let spoke = star.spokes[rim.spoke as usize];
                // The face beside it runs the other way along the edge they share.
                let hint = (rim.vertex == spoke.a) == split.leaves[rim.spoke as usize];
                wing.turned = coder.bit(&mut self.turned[0], wing.turned != hint) != hint;
                let beside = [rim.spoke, rim.other].map(|i| star.spokes[i as usize].class);
                wing.class = self.code_class(coder, beside, wing.class);
                wings.push(wing);
            }
        }
        // Faces whose apex no other face of the star uses.
        while coder.bit(&mut self.far, !given.is_empty()) {
            if wings.len() >= most {
                return Err("more faces than it says it has");
            }
            let mut wing = given.pop().unwrap_or_default();
            wing.apex = coder.uniform(live.vertices() as u32, wing.apex);
            if wing.apex == split.kept {
                return Err("a face with one vertex twice");
            }
            wing.turned = coder.bit(&mut self.turned[1], wing.turned);
            let like = star.spokes.first().map_or(0, |s| s.class);
            wing.class = self.code_class(coder, [like; 2], wing.class);
            wings.push(wing);
        }
        given.clear();
        self.spare = given;
        Ok(())
    }

    /// Codes the faces that were folded away, which mostly come in pairs on one edge, one of each vertex.
    fn code_folds(
        &mut self,
        coder: &mut impl Coder,
        live: &Live,
        star: &Star,
        split: &mut Split,
        most: usize,
    ) -> Result<(), &'static str> {
        let given = std::mem::take(&mut split.folds);
        let like = star.spokes.first().map_or(0, |s| s.class);
        for so_far in 0.. {
            let next = given.get(so_far);
            let second = so_far % 2 == 1;
            let context = if second { 1 } else { 2 * so_far.min(1) };
            if !coder.bit(&mut self.folds[context], next.is_some()) {
                break;
            }
            if split.wings.len() + split.folds.len() >= most {
                return Err("more faces than it says it has");
            }
            let mut fold = next.copied().unwrap_or_default();
            let before = split.folds.last().filter(|_| second).copied();
            if let Some(one) = before.filter(|one| coder.bit(&mut self.folds[3], fold.is_twin_of(one))) {
                let turned = coder.bit(&mut self.folds[4], fold.a != one.a);
                let (a, b) = if turned { (one.b, one.a) } else { (one.a, one.b) };
                let class = self.code_class(coder, [one.class; 2], fold.class);
                split.folds.push(Fold { of_new: !one.of_new, a, b, class, ..fold });
                continue;
            }
            fold.of_new = coder.bit(&mut self.folds[5], fold.of_new);
            fold.a = self.code_neighbour(coder, live, star, fold.a);
            fold.b = self.code_neighbour(coder, live, star, fold.b);
            if fold.a == fold.b || fold.a == split.kept || fold.b == split.kept {
                return Err("a face with one vertex twice");
            }
            fold.class = self.code_class(coder, [like; 2], fold.class);
            split.folds.push(fold);
        }
        Ok(())
    }

    /// Codes a vertex that is probably next to the one that splits.
    fn code_neighbour(&mut self, coder: &mut impl Coder, live: &Live, star: &Star, v: u32) -> u32 {
        let place = star.rims.iter().position(|r| r.vertex == v);
        if coder.bit(&mut self.folds[6], place.is_none()) || star.rims.is_empty() {
            return coder.uniform(live.vertices() as u32, v);
        }
        let count = (star.rims.len() as u32).min(1 << 16);
        star.rims[coder.uniform(count, place.unwrap_or(0) as u32) as usize].vertex
    }

    /// Codes a class that is probably one of two.
    pub fn code_class(&mut self, coder: &mut impl Coder, [one, two]: [u8; 2], class: u8) -> u8 {
        let context = usize::from(one & 31) + if one == two { 32 } else { 0 };
        if !coder.bit(&mut self.class_as[context], class != one) {
            return one;
        }
        if one != two && !coder.bit(&mut self.class_as[64 + usize::from(two & 31)], class != two) {
            return two;
        }
        self.class.code(coder, u32::from(class)) as u8
    }

    fn code_positions(
        &mut self,
        coder: &mut impl Coder,
        live: &Live,
        star: &Star,
        split: &mut Split,
    ) -> Result<(), &'static str> {
        let coarse = live.at(split.kept);
        let is_apex = |v: u32| split.wings.iter().any(|w| w.apex == v);
        let ring = |leaving: bool| {
            star.rims.iter().filter(move |r| (if leaving { r.leave } else { r.stay }) > 0 || is_apex(r.vertex))
        };
        let normal = normal_of(star, &split.leaves, vec(coarse));
        let around = Around::of(ring(true).map(|r| r.at), vec(coarse), normal);
        let guess = guess_of(star, is_apex, vec(coarse), self.was_moved);
        split.gone_at = self.code_point(coder, &around, guess, split.gone_at, 0)?;
        split.kept_at = if coder.bit(&mut self.moved[usize::from(self.was_moved)], split.kept_at != coarse) {
            self.was_moved = true;
            let around = Around::of(ring(false).map(|r| r.at), vec(split.gone_at), normal);
            // Placement pulls towards the middle of the edge; the ring says less (half the guess: 0.8 bytes more).
            let mirrored = 2.0 * vec(coarse) - vec(split.gone_at);
            self.code_point(coder, &around, mirrored, split.kept_at, 3)?
        } else {
            self.was_moved = false;
            coarse
        };
        Ok(())
    }

    /// Codes a point near `guess`: two coordinates along the surface, the third off its plane.
    fn code_point(
        &mut self,
        coder: &mut impl Coder,
        around: &Around,
        guess: DVec3,
        point: Grid,
        kind: usize,
    ) -> Result<Grid, &'static str> {
        let [u, v, w] = around.axes;
        let mut out = [0i64; 3];
        let code = |model: &mut Number, coder: &mut _, guess: f64, value: i64, side: usize| {
            let guess = guess.round_ties_even() as i64;
            guess.saturating_add(model.code(coder, value.saturating_sub(guess), side))
        };
        out[u] = code(&mut self.along[kind * SIZES + around.reach], coder, guess[u], point[u], around.side[u]);
        let du = out[u] as f64 - guess[u];
        let second = kind + 1 + usize::from(size_class(du) >= around.reach);
        out[v] = code(&mut self.along[second * SIZES + around.reach], coder, guess[v], point[v], around.side[v]);
        let dv = out[v] as f64 - guess[v];
        let on_plane = guess[w] - around.slope[0] * du - around.slope[1] * dv;
        out[w] = code(&mut self.off[(kind / 3) * SIZES + around.rough], coder, on_plane, point[w], around.side[w]);
        if out.iter().any(|x| x.unsigned_abs() > MOST_COORDINATE as u64) {
            return Err("a coordinate out of range");
        }
        Ok(out)
    }

    fn code_deviation(&mut self, coder: &mut impl Coder, live: &Live, star: &Star, split: &mut Split) {
        if self.classes == 0 {
            return;
        }
        let (near, coarse) = (vec(split.gone_at), vec(live.at(split.kept)));
        let mut in_star = 0u32;
        let mut squared = f64::INFINITY;
        for spoke in &star.spokes {
            in_star |= 1 << spoke.class;
            let [a, b] = star.ends(spoke);
            let corners = [coarse, a, b];
            squared = squared.min((closest_on_triangle(near, &corners) - near).length_squared());
        }
        split.wings.iter().for_each(|w| in_star |= 1 << w.class);
        let guide = if star.spokes.is_empty() { 0 } else { i64::from(level_of(squared.sqrt() * self.step_m)) };
        let before = self.near.get(split.kept as usize).copied().unwrap_or_default();
        // The class coded last.
        let mut last = None;
        for class in 0..self.classes {
            let (level, prior) = (&mut split.deviation[class], before[class]);
            let is_here = (in_star >> class) & 1 == 1;
            let context = 4 * usize::from(is_here) + 2 * usize::from(last.is_some()) + usize::from(prior > 0);
            if !coder.bit(&mut self.has[8 * class + context], *level > 0) {
                *level = 0;
                continue;
            }
            // A vertex between classes counts for both, so they often are the same.
            let twin = last
                .replace(class)
                .map(|other| &mut self.same[2 * usize::from(prior == 0) + usize::from(prior == before[other])]);
            let is_first = twin.is_none();
            if twin.is_some_and(|prob| coder.bit(prob, i16::from(*level) == self.was_level)) {
                *level = self.was_level as u8;
                continue;
            }
            let context = if prior > 0 {
                16 * usize::from(!is_first) + ((guide - i64::from(prior)).clamp(-23, 7).div_euclid(2) + 12) as usize
            } else {
                32 + ((guide - i64::from(self.was_level)).clamp(-28, 28) / 8 + 4) as usize
            };
            let delta = self.deviation[context].code(coder, i64::from(*level) - guide, 0);
            *level = (guide + delta).clamp(1, 255) as u8;
            self.was_level = i16::from(*level);
        }
        let new = live.vertices();
        self.near.resize(self.near.len().max(new + 1), [0; MAX_CLASSES]);
        self.near[split.kept as usize] = split.deviation;
        self.near[new] = split.deviation;
    }

    /// Codes the energy's level off that of the split before.
    pub fn code_energy(&mut self, coder: &mut impl Coder, before: i16, energy: i16) -> i16 {
        let model = &mut self.energy[usize::from(self.was_energy_delta)];
        let delta = model.code(coder, i64::from(energy) - i64::from(before), 0);
        self.was_energy_delta = delta != 0;
        (i64::from(before) + delta).clamp(i64::from(i16::MIN), i64::from(i16::MAX)) as i16
    }
}

/// Where the new vertex is likely to be; see [`SHARES`].
fn guess_of(star: &Star, is_apex: impl Fn(u32) -> bool, at: DVec3, moves: bool) -> DVec3 {
    // Of neighbours that go, of those that both have, that stay: sum and number.
    let mut sums = [(DVec3::ZERO, 0u32); 3];
    for rim in &star.rims {
        let both = is_apex(rim.vertex);
        for (sum, is_in) in sums.iter_mut().zip([!both && rim.leave > 0, both, !both && rim.leave == 0]) {
            if is_in {
                *sum = (sum.0 + (rim.at - at), sum.1 + 1);
            }
        }
    }
    let [go, both, _] = sums;
    if go.1 == 0 || both.1 != 2 {
        return at + SHARE_OF_ALL * (go.0 + both.0) / f64::from(go.1 + both.1 + 1);
    }
    let shares = SHARES[usize::from(moves)][go.1.min(4) as usize - 1];
    at + sums.iter().zip(shares).map(|((sum, count), share)| *sum * (share / f64::from((*count).max(1)))).sum::<DVec3>()
}

/// Bits of a length in grid steps.
fn size_class(length: f64) -> usize {
    let steps = length.abs() as u64;
    (64 - steps.leading_zeros() as usize).min(SIZES - 1)
}

/// Sum of the cross products of the faces that leave, or of all if none does.
fn normal_of(star: &Star, leaves: &[bool], at: DVec3) -> DVec3 {
    let all = !leaves.contains(&true);
    let mut sum = DVec3::ZERO;
    for (spoke, leaves) in star.spokes.iter().zip(leaves) {
        if all || *leaves {
            let [a, b] = star.ends(spoke);
            sum += (a - at).cross(b - at);
        }
    }
    sum
}

/// The neighbours a new point will have.
struct Around {
    /// Per coordinate: which side of it the end of the edge is that is known, for signs.
    side: [usize; 3],
    /// Size class of their distance from it.
    reach: usize,
    /// Size class of their distance from the plane through it.
    rough: usize,
    /// Two axes along the surface, then the one that is most upright on it.
    axes: [usize; 3],
    /// How much the plane falls along the first two.
    slope: [f64; 2],
}

impl Around {
    fn of(ring: impl Iterator<Item = DVec3> + Clone, and: DVec3, normal: DVec3) -> Self {
        let points = || ring.clone().chain([and]);
        let count = points().count() as f64;
        let middle = points().sum::<DVec3>() / count;
        let size = normal.abs();
        let w = if size.x > size.y && size.x > size.z {
            0
        } else if size.y > size.z {
            1
        } else {
            2
        };
        let axes = [(w + 1) % 3, (w + 2) % 3, w];
        let flat = size[w] > 0.0 && normal.is_finite();
        let slope = if flat { [normal[axes[0]] / normal[w], normal[axes[1]] / normal[w]] } else { [0.0; 2] };
        let (mut reach, mut rough) = (0.0, 0.0);
        for p in points() {
            let d = p - middle;
            reach += d.x.abs().max(d.y.abs()).max(d.z.abs());
            rough += (d[w] + slope[0] * d[axes[0]] + slope[1] * d[axes[1]]).abs();
        }
        // Twice the mean: half powers would cost more contexts than they are worth.
        let side = [0, 1, 2].map(|k| usize::from(and[k] > middle[k]));
        Self { side, reach: size_class(2.0 * reach / count), rough: size_class(2.0 * rough / count), axes, slope }
    }
}
