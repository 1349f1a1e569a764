//! The worker as a program of its own: `worker --server ADDR [--threads N]`.

use std::io::Write as _;
use std::process::ExitCode;

use clap::Parser;
use worker::farm::{self, WorkerArgs};
use worker::frame::Frame;

/// Renders for a server of Ambience until it is told to stop.
#[derive(Parser)]
#[command(version)]
struct Args {
    #[command(flatten)]
    worker: WorkerArgs,
}

fn main() -> ExitCode {
    let args = Args::parse();
    farm::log_to_stderr();
    // Nobody is left to tell if that fails.
    let say = |why: String| drop(writeln!(std::io::stderr(), "worker: {why}"));
    let credentials = match args.worker.credentials.load(&args.worker.server) {
        Ok(credentials) => credentials,
        Err(why) => {
            say(why);
            return ExitCode::from(2);
        }
    };
    match farm::block_on::<Frame>(args.worker, &credentials) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            say(format!("{e:#}"));
            ExitCode::FAILURE
        }
    }
}
