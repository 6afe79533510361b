//! Writes Wavefront OBJ: places in decimals that read back as the same doubles, a material name per class.

use std::io::Write;

use glam::DVec3;

use crate::ids::{ClassId, ClassScheme};

/// The file's bytes; faces by class, inside a class in the order given. `classes` may be empty.
pub fn obj(positions: &[DVec3], faces: &[[u32; 3]], classes: &[ClassId], scheme: &ClassScheme) -> Vec<u8> {
    let mut out = Vec::with_capacity(32 * positions.len() + 24 * faces.len());
    // Writing into memory does not fail.
    for p in positions {
        let _ = writeln!(out, "v {} {} {}", p.x, p.y, p.z);
    }
    let mut put = |of: Option<ClassId>| {
        let wanted = (0..faces.len()).filter(|&f| classes.get(f).copied() == of);
        for (i, f) in wanted.enumerate() {
            if let Some(class) = of.filter(|_| i == 0) {
                let _ = writeln!(out, "usemtl {}", scheme[class].name);
            }
            let [a, b, c] = faces[f].map(|v| v + 1);
            let _ = writeln!(out, "f {a} {b} {c}");
        }
    };
    if classes.is_empty() {
        put(None);
    } else {
        scheme.ids().for_each(|class| put(Some(class)));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faces_stand_under_the_name_of_their_class() {
        let positions = [DVec3::new(0.1, 1e7, -2.5), DVec3::X, DVec3::Y];
        let classes = [ClassId::ROOF, ClassId::TERRAIN];
        let text = obj(&positions, &[[0, 1, 2], [2, 1, 0]], &classes, &ClassScheme::default());
        let text = String::from_utf8(text).unwrap();
        assert_eq!(text, "v 0.1 10000000 -2.5\nv 1 0 0\nv 0 1 0\nusemtl terrain\nf 3 2 1\nusemtl roof\nf 1 2 3\n");
    }
}
