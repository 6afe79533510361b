//! The command line; everything it does is in the library.

fn main() -> std::process::ExitCode {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    give_memory_back();
    rooftile::cli::run()
}

/// Starts `simplify` again in an environment in which the C library hands large blocks back when they are freed.
///
/// Unless told, it keeps every block smaller than the largest one freed so far, up to 32 MB, for later: of a mesh of 0.3
/// million triangles that was a third of the peak (316 bytes a face in place of 212, in the same time). It can be told by
/// a call that is unsafe in Rust, or by its environment, before it starts. Where that fails all goes on as it was.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn give_memory_back() {
    use std::os::unix::process::CommandExt;

    let name = std::env::args_os().next();
    let is_told = ["MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"].iter().any(|key| std::env::var_os(key).is_some());
    let is_wanted = std::env::args_os().any(|arg| arg == "simplify");
    let (false, true, Some(name), Ok(program)) = (is_told, is_wanted, name, std::env::current_exe()) else { return };
    // Comes back only if it could not.
    let _ = std::process::Command::new(program)
        .arg0(name)
        .args(std::env::args_os().skip(1))
        .env("MALLOC_MMAP_THRESHOLD_", LARGE_BLOCK)
        .exec();
}

/// Bytes of a block that is handed back.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const LARGE_BLOCK: &str = "262144";
