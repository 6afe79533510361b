//! Which faces each vertex has, as lists in one arena.
//!
//! A vertex that takes over another's faces gets a new list at the arena's end; lists only shrink in place. So a star is
//! read in one run of memory, on non-manifold meshes too. When the arena is full, all lists move to its front: four times
//! on the way to 10 % of the faces, for an eighth more room than the first lists took.

/// Where the list of a vertex is in an [`Arena`].
#[derive(Debug, Clone, Copy, Default)]
pub struct Span {
    start: u32,
    len: u32,
}

impl Span {
    /// Number of faces.
    pub fn len(self) -> u32 {
        self.len
    }
}

/// Lists of faces.
pub struct Arena {
    faces: Vec<u32>,
    /// Lists move together before there are more than this.
    most: usize,
}

/// Marks the number of an owner among those of faces, of which there are fewer than this.
const OWNER: u32 = 1 << 31;

impl Arena {
    /// The stars of `vertices` vertices.
    pub fn of(vertices: usize, faces: &[[u32; 3]]) -> (Self, Vec<Span>) {
        let mut spans = vec![Span::default(); vertices];
        faces.iter().flatten().for_each(|&v| spans[v as usize].len += 1);
        let mut total = 0;
        for span in &mut spans {
            span.start = total;
            total += span.len;
            span.len = 0;
        }
        let most = total as usize / 8 * 9 + 64;
        let mut arena = Vec::with_capacity(most);
        arena.resize(total as usize, 0);
        for (f, face) in faces.iter().enumerate() {
            for &v in face {
                let span = &mut spans[v as usize];
                arena[(span.start + span.len) as usize] = f as u32;
                span.len += 1;
            }
        }
        (Self { faces: arena, most }, spans)
    }

    /// The faces of a list.
    pub fn faces(&self, Span { start, len }: Span) -> &[u32] {
        &self.faces[start as usize..(start + len) as usize]
    }

    /// Takes `face` out of a list; the order of the others may change.
    pub fn remove(&mut self, span: &mut Span, face: u32) {
        let list = &mut self.faces[span.start as usize..(span.start + span.len) as usize];
        if let Some(i) = list.iter().position(|&f| f == face) {
            list.swap(i, list.len() - 1);
            span.len -= 1;
        }
    }

    /// A new list.
    pub fn list(&mut self, faces: impl Iterator<Item = u32>) -> Span {
        let start = self.faces.len() as u32;
        self.faces.extend(faces);
        Span { start, len: self.faces.len() as u32 - start }
    }

    /// True when a list of `count` faces would not fit.
    pub fn is_full(&self, count: usize) -> bool {
        self.faces.len() + count > self.most
    }

    /// Moves the lists of `owners` to the front, in the order in which they are; what no list has is gone.
    pub fn tidy<T>(&mut self, owners: &mut [T], span: impl Fn(&mut T) -> &mut Span) {
        if owners.len() >= OWNER as usize {
            return;
        }
        // A list's first face and its owner change places: that is the way back from the list to the owner.
        for (owner, v) in owners.iter_mut().zip(OWNER..) {
            let Span { start, len } = span(owner);
            // An empty list begins where there always is something.
            *start = if *len > 0 { std::mem::replace(&mut self.faces[*start as usize], v) } else { 0 };
        }
        let (mut from, mut to) = (0, 0);
        while from < self.faces.len() {
            let word = self.faces[from];
            if word < OWNER {
                from += 1;
                continue;
            }
            let Span { start, len } = span(&mut owners[(word - OWNER) as usize]);
            self.faces[to] = std::mem::replace(start, to as u32);
            self.faces.copy_within(from + 1..from + *len as usize, to + 1);
            (from, to) = (from + *len as usize, to + *len as usize);
        }
        self.faces.truncate(to);
    }
}

/// Faces by vertex.
pub struct Stars {
    arena: Arena,
    spans: Vec<Span>,
}

impl Stars {
    /// The stars of `vertices` vertices.
    pub fn of(vertices: usize, faces: &[[u32; 3]]) -> Self {
        let (arena, spans) = Arena::of(vertices, faces);
        Self { arena, spans }
    }

    /// Faces of `v`.
    pub fn faces(&self, v: u32) -> &[u32] {
        self.arena.faces(self.spans[v as usize])
    }

    /// Takes `face` out of the list of `v`; the order of the others may change.
    pub fn remove(&mut self, v: u32, face: u32) {
        self.arena.remove(&mut self.spans[v as usize], face);
    }

    /// Adds `face` to the list of `v`.
    pub fn add(&mut self, v: u32, face: u32) {
        let Span { start, len } = self.spans[v as usize];
        let arena = &mut self.arena.faces;
        let end = arena.len() as u32;
        arena.extend_from_within(start as usize..(start + len) as usize);
        arena.push(face);
        self.spans[v as usize] = Span { start: end, len: len + 1 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tidied_arena_has_the_same_lists() {
        let faces = [[0, 1, 2], [1, 3, 2], [2, 3, 4], [4, 3, 5]];
        let (mut arena, mut spans) = Arena::of(7, &faces);
        arena.remove(&mut spans[3], 1);
        spans[1] = Span::default();
        spans[2] = arena.list([2, 0, 3].into_iter());
        let lists = |arena: &Arena, spans: &[Span]| -> Vec<Vec<u32>> {
            spans.iter().map(|s| arena.faces(*s).to_vec()).collect()
        };
        let before = lists(&arena, &spans);
        assert!(arena.faces.len() == 15);
        arena.tidy(&mut spans, |s| s);
        assert_eq!(lists(&arena, &spans), before);
        assert_eq!(arena.faces.len(), before.iter().map(Vec::len).sum::<usize>());
    }
}
