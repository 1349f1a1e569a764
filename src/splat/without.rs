//! Built without splatting.

use worker::credentials::Credentials;
use worker::farm::WorkerArgs;

use super::SplatArgs;
use crate::failure::Failure;

/// Says how to get what an option asks for.
///
/// # Errors
/// [`Failure::Usage`].
pub fn check(option: &str) -> Result<(), Failure> {
    Err(Failure::usage(format!("{option}: this ambience was built without splatting; build it with --features splat")))
}

/// As [`check`].
///
/// # Errors
/// As [`check`].
pub fn work(_: WorkerArgs, _: &Credentials) -> Result<(), Failure> {
    check("--splat")
}

/// As [`check`].
///
/// # Errors
/// As [`check`].
pub async fn run(_: SplatArgs) -> Result<(), Failure> {
    check("splat")
}
