//! Processor time of the certified interval: µs a face of the source and level, at 2 cm, on one thread.
//!
//! `cargo bench --bench certify -- MESH…`. The levels are the mesh simplified to 50, 20, 10, 5 and 2 %. One JSON line a
//! level; `prepare_s` is the source's tree, made once for all levels.

use std::path::Path;

use rooftile::classes::Classes;
use rooftile::collapse::{Method, SimplifyConfig, Target, simplify};
use rooftile::ids::{ClassId, ClassScheme};
use rooftile::measure::{MeasureConfig, Reference, Surface};

use common::{cpu_s, mesh, on_one_thread};

mod common;

fn run(path: &Path) {
    let mesh = mesh(path);
    let faces = mesh.faces.len();
    let start = cpu_s();
    let reference =
        Reference::new(&Surface { positions: mesh.positions.clone(), faces: mesh.faces.clone(), class: None });
    let prepare_s = cpu_s() - start;
    let config = MeasureConfig { tolerance_m: Some(0.02), ..MeasureConfig::default() };
    let one = ClassId(0);
    let classes = Classes { scheme: ClassScheme::default(), posterior: Vec::new(), label: vec![one; faces] };
    for percent in [50, 20, 10, 5, 2] {
        let settings = SimplifyConfig {
            method: Method::Memoryless,
            target: Target::Faces(faces * percent / 100),
            ..SimplifyConfig::default()
        };
        let level = simplify(&mesh, &classes, &settings);
        let level = Surface { positions: level.positions, faces: level.faces, class: None };
        let start = cpu_s();
        let [there, back] = reference.certify(&level, &config).expect("a surface");
        let cpu_s = cpu_s() - start;
        let us = 1e6 * cpu_s / faces as f64;
        println!(
            "{{\"mesh\": {:?}, \"faces\": {faces}, \"level_faces\": {}, \"prepare_s\": {prepare_s:.3}, \
             \"cpu_s\": {cpu_s:.3}, \"us_per_face\": {us:.2}, \"there_m\": [{:.4}, {:.4}], \"back_m\": [{:.4}, {:.4}]}}",
            path.display().to_string(),
            level.faces.len(),
            there.lower_m,
            there.upper_m,
            back.lower_m,
            back.upper_m,
        );
    }
}

fn main() {
    on_one_thread(|paths| {
        if paths.is_empty() {
            eprintln!("certify: give it a mesh");
        }
        paths.iter().for_each(|path| run(path));
    });
}
