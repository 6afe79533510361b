//! What benches share: the clock, the meshes named on the command line, one thread.

use std::path::{Path, PathBuf};

use rooftile::mesh::{self, Mesh};
use rooftile::report::Reporter;

/// Processor seconds of this thread, from the kernel's own nanoseconds; 0 where it does not tell.
pub fn cpu_s() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    text.split_whitespace().next().and_then(|ns| ns.parse::<f64>().ok()).unwrap_or(0.0) * 1e-9
}

/// A file or folder as the gate lets it in, near the origin.
pub fn mesh(path: &Path) -> Mesh {
    let reporter = Reporter::new(true);
    let (mut source, _) = rooftile::input::read(&[path.into()], &Default::default(), &reporter).expect("a mesh");
    let origin = source.parts[0].positions[0].round();
    source.parts.iter_mut().flat_map(|part| &mut part.positions).for_each(|p| *p -= origin);
    mesh::gate(source, &Default::default(), &reporter).expect("a mesh").0
}

/// Runs `what` on the paths of the command line, on one thread.
pub fn on_one_thread(what: impl FnOnce(&[PathBuf]) + Send) {
    let paths: Vec<PathBuf> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).map(PathBuf::from).collect();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool of one thread");
    pool.install(|| what(&paths));
}
