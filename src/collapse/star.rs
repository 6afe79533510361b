//! Which faces each vertex has, as lists in one arena.
//!
//! A vertex that takes over another's faces gets a new list at the arena's end; lists only shrink in place. So a star is
//! read in one run of memory, on non-manifold meshes too, and the arena grows by about a third of its first size.

/// Faces by vertex.
pub struct Stars {
    arena: Vec<u32>,
    start: Vec<u32>,
    len: Vec<u32>,
}

impl Stars {
    /// The stars of `vertices` vertices.
    pub fn of(vertices: usize, faces: &[[u32; 3]]) -> Self {
        let mut len = vec![0u32; vertices];
        faces.iter().flatten().for_each(|&v| len[v as usize] += 1);
        let mut total = 0;
        let start: Vec<u32> = len
            .iter()
            .map(|n| {
                total += n;
                total - n
            })
            .collect();
        let mut at = start.clone();
        let mut arena = vec![0; total as usize];
        for (f, face) in faces.iter().enumerate() {
            for &v in face {
                arena[at[v as usize] as usize] = f as u32;
                at[v as usize] += 1;
            }
        }
        Self { arena, start, len }
    }

    /// Faces of `v`; empty once it has merged into another vertex.
    pub fn faces(&self, v: u32) -> &[u32] {
        let start = self.start[v as usize] as usize;
        &self.arena[start..start + self.len[v as usize] as usize]
    }

    /// Number of faces of `v`.
    pub fn count(&self, v: u32) -> u32 {
        self.len[v as usize]
    }

    /// Takes `face` out of the list of `v`; the order of the others may change.
    pub fn remove(&mut self, v: u32, face: u32) {
        let start = self.start[v as usize] as usize;
        let list = &mut self.arena[start..start + self.len[v as usize] as usize];
        if let Some(i) = list.iter().position(|&f| f == face) {
            list.swap(i, list.len() - 1);
            self.len[v as usize] -= 1;
        }
    }

    /// Adds `face` to the list of `v`.
    pub fn add(&mut self, v: u32, face: u32) {
        let start = self.start[v as usize] as usize;
        let end = self.arena.len() as u32;
        self.arena.extend_from_within(start..start + self.len[v as usize] as usize);
        self.arena.push(face);
        self.start[v as usize] = end;
        self.len[v as usize] += 1;
    }

    /// Gives `v` this list instead of its own.
    pub fn replace(&mut self, v: u32, faces: impl Iterator<Item = u32>) {
        self.start[v as usize] = self.arena.len() as u32;
        self.arena.extend(faces);
        self.len[v as usize] = self.arena.len() as u32 - self.start[v as usize];
    }
}
