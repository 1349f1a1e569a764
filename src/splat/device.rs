//! Built with splatting.

use shaders::device::Gpu;
use shaders::node::Node;
use worker::credentials::Credentials;
use worker::farm::{self, WorkerArgs};

use crate::failure::Failure;

pub use super::preview::run;

/// Whether this machine can do what an option asks for.
///
/// # Errors
/// [`Failure::Failed`]: there is no adapter.
pub fn check(option: &str) -> Result<(), Failure> {
    Gpu::new(true).map(drop).map_err(|lost| Failure::failed(format!("{option}: {lost}")))
}

/// Works for a server, with a device.
///
/// # Errors
/// As [`check`], or as [`farm::run`].
pub fn work(args: WorkerArgs, credentials: &Credentials) -> Result<(), Failure> {
    check("--splat")?;
    farm::block_on::<Node>(args, credentials).map_err(|e| Failure::failed(format!("{e:#}")))
}
