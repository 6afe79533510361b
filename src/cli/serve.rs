//! `rooftile serve`.

use std::net::SocketAddr;
use std::path::PathBuf;

use super::Outcome;
use crate::report::Reporter;
use crate::{Result, serve};

#[derive(clap::Args)]
pub struct Args {
    /// A folder with a tileset.json.
    #[arg(value_name = "TILESET")]
    tileset: PathBuf,
    /// Address and port to listen on; port 0 takes a free one.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8080")]
    bind: SocketAddr,
}

pub fn run(args: &Args, reporter: &Reporter) -> Result<Outcome> {
    serve::run(&args.tileset, args.bind, reporter)?;
    Ok(Outcome::Fine)
}
