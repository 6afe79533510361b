//! What every event of a sequence did to the faces, made by carrying the sequence out once.
//!
//! The sequence is used up: its faces, positions and events are overwritten by what the record needs in their place, for
//! two copies of a large mesh were the peak of a whole run.

use super::live::Grid;
use super::split::MOST_COORDINATE;
use super::{NONE, Sequence};
use crate::collapse::Collapse;
use crate::{Error, Result};

/// A sequence, carried out.
pub struct History {
    /// Corners at the end, or at the moment the face died.
    pub faces: Vec<[u32; 3]>,
    /// Faces that are left at the end.
    pub alive: Vec<bool>,
    /// Faces that died in event i: `died[died_start[i]..died_start[i + 1]]`.
    died: Vec<u32>,
    died_start: Vec<u32>,
    /// Faces that went from `gone` to `kept`, in the same way.
    left: Vec<u32>,
    left_start: Vec<u32>,
    /// Faces that events folded away: event, face. In order.
    folded: Vec<(u32, u32)>,
    /// Grid places at the end, and of vertices that are gone, at the moment they went.
    pub points: Vec<Grid>,
    /// Vertices that are not left at the end.
    pub gone: Vec<bool>,
    /// The events, but `position` is where `kept` was before, and `kept` the vertex that stays where it is if one does: an
    /// event that takes its vertex to the place of the other is told the other way round, so that one place is coded and
    /// not two.
    pub events: Vec<Collapse>,
    /// Positions are multiples of this, metres.
    pub grid_m: f64,
}

impl History {
    /// Carries `sequence` out.
    ///
    /// # Errors
    /// [`Error::Bug`] for a sequence that breaks its promises.
    pub fn of(sequence: Sequence) -> Result<Self> {
        let Sequence { positions, faces, grid_m, log, .. } = sequence;
        let vertices = positions.len();
        let points = positions.into_iter().map(|p| on_grid(p.to_array(), grid_m));
        let mut history = Self {
            alive: vec![true; faces.len()],
            died: Vec::with_capacity(faces.len()),
            died_start: vec![0],
            left: Vec::new(),
            left_start: vec![0],
            folded: Vec::new(),
            points: points.collect::<Result<_>>()?,
            gone: vec![false; vertices],
            events: log.events,
            faces,
            grid_m,
        };
        let mut corners = Corners::of(vertices, &history.faces)?;
        // What each vertex of the sequence is called here.
        let mut name: Vec<u32> = (0..vertices as u32).collect();
        let mut folded = log.folded.iter().copied().peekable();
        for i in 0..history.events.len() {
            let to = history.tell(i, &mut name)?;
            while let Some((_, f)) = folded.next_if(|f| f.0 as usize == i) {
                history.fold(i, f)?;
            }
            history.carry_out(i, to, &mut corners);
        }
        Ok(history)
    }

    /// Puts event `i` into the terms of this history; where its vertex goes.
    fn tell(&mut self, i: usize, name: &mut [u32]) -> Result<Grid> {
        let event = self.events[i];
        let [mut kept, mut gone] =
            [event.kept, event.gone].map(|v| name.get(v as usize).copied().unwrap_or(NONE) as usize);
        if kept == gone || kept.max(gone) >= name.len() || self.gone[kept] || self.gone[gone] {
            return Err(Error::Bug(format!("event {i} of a sequence merges vertex {gone} into {kept}")));
        }
        let to = on_grid(event.position.to_array(), self.grid_m)?;
        if to == self.points[gone] && to != self.points[kept] {
            name[event.kept as usize] = gone as u32;
            (kept, gone) = (gone, kept);
        }
        (self.events[i].kept, self.events[i].gone) = (kept as u32, gone as u32);
        Ok(to)
    }

    /// Takes away face `f`, which event `i` folds.
    fn fold(&mut self, i: usize, f: u32) -> Result<()> {
        let Collapse { kept, gone, .. } = self.events[i];
        let face = self.faces.get(f as usize).filter(|_| self.alive[f as usize]);
        let Some(face) = face else {
            return Err(Error::Bug(format!("event {i} of a sequence folds face {f}, which is not there")));
        };
        match (face.contains(&kept), face.contains(&gone)) {
            // It dies in any case.
            (true, true) => return Ok(()),
            (false, false) => {
                return Err(Error::Bug(format!("event {i} of a sequence folds face {f}, which it does not touch")));
            }
            _ => {}
        }
        self.alive[f as usize] = false;
        self.folded.push((i as u32, f));
        Ok(())
    }

    /// Hands the faces of `gone` to `kept`, which moves.
    fn carry_out(&mut self, i: usize, to: Grid, corners: &mut Corners) {
        let Collapse { kept, gone, .. } = self.events[i];
        let mut corner = std::mem::replace(&mut corners.head[gone as usize], NONE);
        while corner != NONE {
            let (f, k) = (corner as usize / 3, corner as usize % 3);
            let following = corners.next[corner as usize];
            if self.alive[f] && self.faces[f].contains(&kept) {
                self.alive[f] = false;
                self.died.push(f as u32);
            } else if self.alive[f] {
                self.faces[f][k] = kept;
                self.left.push(f as u32);
                corners.next[corner as usize] = corners.head[kept as usize];
                corners.head[kept as usize] = corner;
            }
            corner = following;
        }
        self.died_start.push(self.died.len() as u32);
        self.left_start.push(self.left.len() as u32);
        self.gone[gone as usize] = true;
        let before = std::mem::replace(&mut self.points[kept as usize], to);
        self.events[i].position = before.map(|x| x as f64 * self.grid_m).into();
    }

    /// Lets go what is known of the events from `end` on, for what is written of them takes as much again.
    pub fn forget(&mut self, end: usize) {
        fn cut<T>(items: &mut Vec<T>, end: usize) {
            items.truncate(end);
            items.shrink_to_fit();
        }
        cut(&mut self.died, self.died_start[end] as usize);
        cut(&mut self.left, self.left_start[end] as usize);
        cut(&mut self.died_start, end + 1);
        cut(&mut self.left_start, end + 1);
        cut(&mut self.events, end);
    }

    /// Faces that event `i` folded: with its number.
    pub fn folded(&self, i: usize) -> &[(u32, u32)] {
        let begin = self.folded.partition_point(|f| (f.0 as usize) < i);
        let count = self.folded[begin..].iter().take_while(|f| f.0 as usize == i).count();
        &self.folded[begin..begin + count]
    }

    /// Faces that died in event `i`.
    pub fn died(&self, i: usize) -> &[u32] {
        &self.died[self.died_start[i] as usize..self.died_start[i + 1] as usize]
    }

    /// Faces that went from the vertex that goes to the one that stays in event `i`.
    pub fn left(&self, i: usize) -> &[u32] {
        &self.left[self.left_start[i] as usize..self.left_start[i + 1] as usize]
    }
}

/// Corners by vertex, as lists; a corner is 3 · face + its number.
struct Corners {
    head: Vec<u32>,
    next: Vec<u32>,
}

impl Corners {
    fn of(vertices: usize, faces: &[[u32; 3]]) -> Result<Self> {
        let mut corners = Self { head: vec![NONE; vertices], next: vec![NONE; 3 * faces.len()] };
        for (f, face) in faces.iter().enumerate().rev() {
            let [a, b, c] = *face;
            if a == b || b == c || c == a || face.iter().any(|&v| v as usize >= vertices) {
                return Err(Error::Bug(format!(
                    "face {f} of a sequence has corners {a} {b} {c} of {vertices} vertices"
                )));
            }
            for (k, &v) in face.iter().enumerate() {
                corners.next[3 * f + k] = corners.head[v as usize];
                corners.head[v as usize] = (3 * f + k) as u32;
            }
        }
        Ok(corners)
    }
}

/// The grid steps of a position.
///
/// # Errors
/// [`Error::Bug`] if it is between them.
pub fn on_grid(p: [f64; 3], grid_m: f64) -> Result<Grid> {
    let steps = p.map(|x| x / grid_m);
    let fine = steps.iter().all(|s| s.fract() == 0.0 && s.abs() <= MOST_COORDINATE as f64);
    if fine { Ok(steps.map(|s| s as i64)) } else { Err(Error::Bug(format!("{p:?} is not on a grid of {grid_m} m"))) }
}
