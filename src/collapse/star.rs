//! Which faces each vertex has, as lists in one arena.
//!
//! A vertex that takes over another's faces gets a new list at the arena's end; lists only shrink in place. So a star is
//! read in one run of memory, on non-manifold meshes too, and the arena about doubles by the time 10 % of the faces are
//! left.

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
pub struct Arena(Vec<u32>);

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
        let mut arena = Vec::with_capacity(total as usize / 2 * 5);
        arena.resize(total as usize, 0);
        for (f, face) in faces.iter().enumerate() {
            for &v in face {
                let span = &mut spans[v as usize];
                arena[(span.start + span.len) as usize] = f as u32;
                span.len += 1;
            }
        }
        (Self(arena), spans)
    }

    /// The faces of a list.
    pub fn faces(&self, Span { start, len }: Span) -> &[u32] {
        &self.0[start as usize..(start + len) as usize]
    }

    /// Takes `face` out of a list; the order of the others may change.
    pub fn remove(&mut self, span: &mut Span, face: u32) {
        let list = &mut self.0[span.start as usize..(span.start + span.len) as usize];
        if let Some(i) = list.iter().position(|&f| f == face) {
            list.swap(i, list.len() - 1);
            span.len -= 1;
        }
    }

    /// A new list.
    pub fn list(&mut self, faces: impl Iterator<Item = u32>) -> Span {
        let start = self.0.len() as u32;
        self.0.extend(faces);
        Span { start, len: self.0.len() as u32 - start }
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
        let end = self.arena.0.len() as u32;
        self.arena.0.extend_from_within(start as usize..(start + len) as usize);
        self.arena.0.push(face);
        self.spans[v as usize] = Span { start: end, len: len + 1 };
    }
}
