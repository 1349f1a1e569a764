//! What needs a device that draws: `ambience splat`, and workers that splat. Compiled with the feature `splat`; without it the
//! command line is the same, and says how to get it.

use std::path::PathBuf;

use worker::client::Address;
use worker::credentials::CredentialArgs;

use crate::view::ViewArgs;

#[cfg(feature = "splat")]
mod preview;

#[cfg_attr(feature = "splat", path = "device.rs")]
#[cfg_attr(not(feature = "splat"), path = "without.rs")]
mod device;

pub use device::{check, run, work};

/// Watches a picture while its records come in.
#[derive(Clone, Debug, clap::Args)]
pub struct SplatArgs {
    #[command(flatten)]
    pub view: ViewArgs,
    /// The server that has the records: HOST:PORT or unix:PATH
    #[arg(long, value_name = "ADDR")]
    pub server: Address,
    /// How to call it.
    #[command(flatten)]
    pub credentials: CredentialArgs,
    /// Picture to write, again and again
    #[arg(short, long, value_name = "OUT.png", default_value = "preview.png")]
    pub output: PathBuf,
    /// Seconds from one picture to the next
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u16).range(1..=3600), default_value_t = 5)]
    pub every: u16,
    /// Warnings and errors only
    #[arg(long)]
    pub quiet: bool,
}
