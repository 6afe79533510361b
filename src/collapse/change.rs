//! Carries one collapse out: faces, forms, stars and samples change, edges of the new star are ranked.
//!
//! Forms are kept up by what changes: planes of the star's faces are taken out as they were and added as they are. On
//! open borders so are the planes along their edges, by the star's edges alone unless faces fold.

use glam::DVec3;

use super::block::{BORDER, Energy, Limit};
use super::energy::{Form, SmallForm};
use super::record::level_of;
use super::run::{Corner, GONE, Run};
use super::star::Span;
use super::{Collapse, MOST_CLASSES, NONE};

impl Run<'_> {
    pub(super) fn perform(&mut self, u: u32, v: u32, p: DVec3, energy: f32) {
        let star = std::mem::take(&mut self.star);
        let ring = std::mem::take(&mut self.ring);
        let memoryless = self.block.rules.energy == Energy::Memoryless;
        let borders =
            memoryless && ring.iter().chain([&u, &v]).any(|&w| self.vertices[w as usize].mark.flags & BORDER != 0);
        // Where faces fold, edges outside the star may open, too.
        let folds = !self.pairs.is_empty();
        match (borders, folds) {
            (true, true) => ring.iter().for_each(|&w| self.take_border(w)),
            (true, false) => self.take_star_borders(&star, u, v),
            _ => {}
        }
        for corner in &star {
            let form = if memoryless { self.faces[corner.face as usize].form() } else { Form::default() };
            for w in corner.ids.into_iter().filter(|&w| w != u && w != v) {
                if memoryless {
                    self.take_form(w, form);
                }
                if corner.dies {
                    self.arena.remove(&mut self.vertices[w as usize].star, corner.face);
                }
            }
        }
        self.note_folds(&star, u, v);
        self.record(u, v, p, energy);
        self.vertices[u as usize].at = p;
        self.vertices[u as usize].mark.flags |= self.vertices[v as usize].mark.flags;
        let mut sum = Form::default();
        for corner in &star {
            let face = &mut self.faces[corner.face as usize];
            if corner.dies {
                face.corners = [NONE; 3];
                self.living -= 1;
                continue;
            }
            face.lie(&corner.facet);
            face.corners = corner.ids.map(|w| if w == v { u } else { w });
            if memoryless {
                let form = face.form();
                sum += form;
                for w in corner.ids.into_iter().filter(|&w| w != u && w != v) {
                    self.add_form(w, form);
                }
            }
        }
        [u, v].iter().for_each(|&w| self.vertices[w as usize].star = Span::default());
        if self.arena.is_full(star.len()) {
            self.arena.tidy(&mut self.vertices, |vertex| &mut vertex.star);
        }
        self.vertices[u as usize].star = self.arena.list(star.iter().filter(|c| !c.dies).map(|c| c.face));
        self.move_samples(&star);
        self.version[u as usize] += self.version[v as usize] + 1;
        self.version[v as usize] = GONE;
        if memoryless {
            self.vertices[u as usize].form = SmallForm::of(&sum);
        } else if !self.quadrics.is_empty() {
            let other = self.quadrics[v as usize];
            self.quadrics[u as usize] += other;
        }
        match (borders || memoryless && folds, folds) {
            (true, true) => ring.iter().chain([&u]).for_each(|&w| self.add_border(w)),
            (true, false) => self.add_star_borders(&star, u, v),
            _ => {}
        }
        self.star = star;
        for &w in &ring {
            if self.vertices[w as usize].star.len() > 0 {
                self.rank(u, w);
            } else {
                self.version[w as usize] = GONE;
            }
        }
        self.ring = ring;
    }

    /// Takes the border planes of the star's edges out of the forms of the ring; forms of `u` and `v` are made anew.
    fn take_star_borders(&mut self, star: &[Corner], u: u32, v: u32) {
        for corner in star {
            for k in 0..3 {
                let (a, b) = (corner.ids[k], corner.ids[(k + 1) % 3]);
                let ends = |w: u32| (a == w) ^ (b == w);
                let other = if a == u || a == v { b } else { a };
                let mark = self.vertices[other as usize].mark;
                let is_open = match (ends(u), ends(v)) {
                    (true, true) => false,
                    (true, false) => mark.of_u == 1,
                    (false, true) => mark.of_v == 1,
                    (false, false) => self.is_border(a, b),
                };
                if is_open {
                    let (n, weight) = self.border_plane(a, b, corner.face);
                    let form = Form::of_plane(n, weight);
                    [a, b].into_iter().filter(|&w| w != u && w != v).for_each(|w| self.take_form(w, form));
                }
            }
        }
    }

    /// Adds the border planes of the new star's edges to the forms of the ring and of `u`.
    fn add_star_borders(&mut self, star: &[Corner], u: u32, v: u32) {
        let living = || star.iter().filter(|c| !c.dies);
        for corner in living() {
            for w in corner.ids {
                self.vertices[w as usize].mark.of_u = 0;
            }
        }
        for corner in living() {
            for w in corner.ids {
                let mark = &mut self.vertices[w as usize].mark;
                mark.of_u = mark.of_u.saturating_add(1);
            }
        }
        for corner in living() {
            let ids = corner.ids.map(|w| if w == v { u } else { w });
            for k in 0..3 {
                let (a, b) = (ids[k], ids[(k + 1) % 3]);
                let is_open = match (a == u, b == u) {
                    (true, _) => self.vertices[b as usize].mark.of_u == 1,
                    (_, true) => self.vertices[a as usize].mark.of_u == 1,
                    _ => self.is_border(a, b),
                };
                if is_open {
                    let (n, weight) = self.border_plane(a, b, corner.face);
                    let form = Form::of_plane(n, weight);
                    [a, b].into_iter().for_each(|w| self.add_form(w, form));
                }
            }
        }
    }

    /// True for an edge that one face has.
    fn is_border(&self, a: u32, b: u32) -> bool {
        let flags = self.vertices[a as usize].mark.flags & self.vertices[b as usize].mark.flags;
        flags & BORDER != 0 && self.shared_faces(a, b) == 1
    }

    /// Lists the folded faces, and marks their vertices: they may be on an open border now.
    fn note_folds(&mut self, star: &[Corner], u: u32, v: u32) {
        if self.pairs.is_empty() {
            return;
        }
        let event = self.count;
        for corner in star.iter().filter(|c| c.dies) {
            let face = corner.ids;
            if !(face.contains(&u) && face.contains(&v)) {
                self.folded.push((event, corner.face));
            }
            face.iter().for_each(|&w| self.vertices[w as usize].mark.flags |= BORDER);
        }
    }

    /// Takes the border planes out of the form of `w`, before anything changes.
    fn take_border(&mut self, w: u32) {
        let mut form = self.vertices[w as usize].form.form();
        self.borders_of(w, |n, weight| form -= Form::of_plane(n, weight));
        self.vertices[w as usize].form = SmallForm::of(&form);
    }

    /// Adds the border planes of `w` as they are now.
    pub(super) fn add_border(&mut self, w: u32) {
        let mut form = self.vertices[w as usize].form.form();
        self.borders_of(w, |n, weight| form += Form::of_plane(n, weight));
        self.vertices[w as usize].form = SmallForm::of(&form);
    }

    fn record(&mut self, u: u32, v: u32, position: DVec3, energy: f32) {
        let id = |v: u32| self.block.vertex_ids.get(v as usize).copied().unwrap_or(v);
        self.count += 1;
        if let Limit::Scale(_) = self.block.rules.limit {
            let position = self.block.origin + position;
            self.log.push(Collapse { kept: id(u), gone: id(v), position, energy });
        }
        if self.block.rules.recorded {
            self.moves.push(u, v, self.at(u), position, energy);
            let mut squared = [0f64; MOST_CLASSES];
            for step in &self.moved {
                let classes = self.block.sample_classes.get(step.rider as usize).copied().unwrap_or(0);
                for (_, most) in squared.iter_mut().enumerate().filter(|(c, _)| classes >> c & 1 != 0) {
                    *most = most.max(step.squared_m2);
                }
            }
            let deviations_m = squared.map(|s| s.sqrt() as f32);
            self.most_m.iter_mut().zip(deviations_m).for_each(|(most, m)| *most = most.max(m));
            self.levels.push(deviations_m.map(|m| level_of(f64::from(m))));
        }
    }

    pub(super) fn add_form(&mut self, v: u32, form: Form) {
        let sum = &mut self.vertices[v as usize].form;
        let mut f = sum.form();
        f += form;
        *sum = SmallForm::of(&f);
    }

    fn take_form(&mut self, v: u32, form: Form) {
        let sum = &mut self.vertices[v as usize].form;
        let mut f = sum.form();
        f -= form;
        *sum = SmallForm::of(&f);
    }
}
