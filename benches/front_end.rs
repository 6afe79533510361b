//! Processor time and memory of the front end: normals, regions, features, classes, on one thread.
//!
//! `cargo bench --bench front_end [-- MESH…]`. Without a mesh: three flat-roofed towns of 0.25, 1 and 4 million faces,
//! for the growth per face. One JSON line a mesh.

use std::path::PathBuf;

use glam::DVec3;
use rooftile::classes::{ClassesConfig, label};
use rooftile::ids::ClassScheme;
use rooftile::mesh::Mesh;
use rooftile::planes::{PlanesConfig, grow};

use common::{cpu_s, mesh, on_one_thread};

mod common;

/// A figure of the process in bytes, as `VmRSS` and `VmHWM`; 0 where it is not told.
fn memory(name: &str) -> f64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
    line.and_then(|rest| rest.split_whitespace().next()?.parse::<f64>().ok()).unwrap_or(0.0) * 1024.0
}

/// A field of 0.4 m squares with a block of 12 m by 12 m and 9 m every 20 m, and a little noise.
fn town(faces: usize) -> Mesh {
    let n = ((faces / 2) as f64).sqrt() as usize;
    let mut mesh = Mesh::default();
    for j in 0..=n {
        for i in 0..=n {
            let (x, y) = (i as f64 * 0.4, j as f64 * 0.4);
            let hash = ((i * 73_856_093) ^ (j * 19_349_663)) % 1024;
            let roof = if x % 20.0 < 12.0 && y % 20.0 < 12.0 { 9.0 } else { 0.0 };
            mesh.positions.push(DVec3::new(x, y, roof + 0.03 * hash as f64 / 1024.0));
        }
    }
    let row = n as u32 + 1;
    for j in 0..n as u32 {
        for a in j * row..j * row + n as u32 {
            mesh.faces.extend([[a, a + 1, a + row + 1], [a, a + row + 1, a + row]]);
        }
    }
    mesh
}

fn measure(name: &str, mesh: &Mesh) {
    // Where the kernel allows it the high-water mark starts anew, so that reading the mesh does not count.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    let (before, start) = (memory("VmRSS"), cpu_s());
    let planes = grow(mesh, &PlanesConfig::default());
    let planes_s = cpu_s() - start;
    let classes = label(mesh, &planes, &ClassScheme::default(), &ClassesConfig::default());
    let cpu = cpu_s() - start;
    let faces = mesh.faces.len() as f64;
    assert_eq!(classes.label.len(), mesh.faces.len());
    println!(
        "{{\"mesh\": {name:?}, \"faces\": {faces}, \"planes_s\": {planes_s:.3}, \"cpu_s\": {cpu:.3}, \
         \"faces_per_s\": {:.0}, \"bytes_per_face\": {:.0}}}",
        faces / cpu,
        (memory("VmHWM") - before) / faces
    );
}

fn run(paths: &[PathBuf]) {
    if paths.is_empty() {
        // Growing, so that the high-water mark is each mesh's own.
        for faces in [250_000, 1_000_000, 4_000_000] {
            measure("town", &town(faces));
        }
    }
    for path in paths {
        measure(&path.display().to_string(), &mesh(path));
    }
}

fn main() {
    on_one_thread(run);
}
