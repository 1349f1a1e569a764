//! `ambience`: the one command users type. Here it is only wired: each subcommand has its room.
//!
//! - [`args`], [`view`], [`render`], [`children`], [`familiar`], [`progress`], [`stats`]: `render`.
//! - [`compare`]: `compare`. [`cache`]: `cache`. `serve` and `worker` run the libraries `cache-server` and `worker`.
//! - [`splat`]: `splat`, and `worker --splat`. [`relay`]: `serve --upstream`.
//! - [`parent`]: children end with their parent. [`failure`]: exit codes. [`say`]: stdout and stderr.

use std::process::ExitCode;
use std::time::Duration;

use clap::error::ErrorKind;
use clap::{Parser, Subcommand};

mod args;
mod cache;
mod children;
mod compare;
mod failure;
mod familiar;
mod parent;
mod progress;
mod relay;
mod render;
mod say;
mod splat;
mod stats;
mod view;

use failure::Failure;

/// How long what runs on other threads may take to end after the command has.
const GRACE: Duration = Duration::from_millis(200);

/// A distributed cache of indirect light
#[derive(Parser)]
#[command(version, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Render a scene to OUT.exr, and OUT.png to look at
    ///
    /// Without --server, a server and workers are started on this machine and nothing is left running.
    ///
    /// OUT.exr holds linear RGB as R,G,B, the layers direct, indirect, irradiance and records, and header attributes
    /// ambience:*. OUT.png is sRGB, exposed so that the 98th percentile of luminance shows at about 0.9.
    ///
    /// Exit codes: 0 done; 2 wrong usage or input; 1 everything else; 130 after Ctrl-C, 143 after SIGTERM.
    // The last of a repeated option counts, so that scripts can append to a line of defaults.
    #[command(args_override_self = true)]
    Render(args::RenderArgs),
    /// Keep and share records, and give out work
    Serve {
        #[command(flatten)]
        serve: cache_server::ServeArgs,
        #[command(flatten)]
        relay: relay::RelayArgs,
        #[command(flatten)]
        owned: parent::OwnedArgs,
    },
    /// Render for a server until told to stop
    Worker {
        #[command(flatten)]
        worker: worker::farm::WorkerArgs,
        /// Let a GPU of this machine interpolate the pixels of frames that were asked for with --splat
        #[arg(long)]
        splat: bool,
        #[command(flatten)]
        owned: parent::OwnedArgs,
    },
    /// Watch a picture while its records come in
    ///
    /// Draws what a server knows of the scene, seen by any camera, with a GPU or Mesa's lavapipe, and writes it to OUT.png every few
    /// seconds while there is something new. Where no record answers yet, those around are asked as if they reached farther.
    Splat(splat::SplatArgs),
    /// Compare a picture with a reference
    ///
    /// Prints the relative RMSE (root mean squared difference of linear RGB over the mean of the reference), the bias
    /// (mean over mean, minus 1) and the worst 8x8 block (difference of block means over the mean of the reference). The
    /// larger picture is averaged to the size of the smaller.
    Compare(compare::CompareArgs),
    /// Look into caches, unite them, write them to files and read them back
    ///
    /// A cache is a directory that `render --cache` or `serve --data` wrote; OUT.ambience and OUT.jsonl are files made by
    /// export, described in docs/format.md. Caches unite in any order, however often, to the same records.
    #[command(subcommand)]
    Cache(cache::CacheCommand),
}

fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) if matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion) => {
            // A reader that closed the pipe early has seen enough.
            drop(error.print());
            return ExitCode::SUCCESS;
        }
        Err(error) if error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            return end(Err(Failure::usage(
                "expected a command: render, serve, worker, splat, compare or cache (see ambience --help)",
            )));
        }
        Err(error) => return end(Err(Failure::usage(one_line(&error.render().to_string())))),
    };
    end(match cli.command {
        Command::Render(args) => block_on(render::run(args)),
        Command::Serve { serve, relay, owned } => {
            owned.watch();
            cache_server::cli::log_to_stderr(serve.log_format);
            block_on(async {
                match relay.upstream.clone() {
                    Some(upstream) => relay::run(serve, relay, upstream).await,
                    None => cache_server::run(serve).await.map_err(serve_failure),
                }
            })
        }
        Command::Worker { worker, splat, owned } => {
            owned.watch();
            worker::farm::log_to_stderr();
            work(worker, splat)
        }
        Command::Splat(args) => block_on(splat::run(args)),
        Command::Compare(args) => compare::run(&args),
        Command::Cache(command) => cache::run(&command),
    })
}

fn block_on(command: impl Future<Output = Result<(), Failure>>) -> Result<(), Failure> {
    let runtime = tokio::runtime::Runtime::new().map_err(|e| Failure::failed(format!("cannot start: {e}")))?;
    let ended = runtime.block_on(command);
    runtime.shutdown_timeout(GRACE);
    ended
}

fn work(args: worker::farm::WorkerArgs, splat: bool) -> Result<(), Failure> {
    let credentials = args.credentials.load(&args.server).map_err(Failure::usage)?;
    if splat {
        return splat::work(args, &credentials);
    }
    worker::farm::block_on::<worker::frame::Frame>(args, &credentials).map_err(|e| Failure::failed(format!("{e:#}")))
}

fn serve_failure(error: cache_server::ServeError) -> Failure {
    if error.exit_code() == 2 { Failure::usage(error) } else { Failure::failed(error) }
}

fn end(ended: Result<(), Failure>) -> ExitCode {
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            say::line(&failure);
            ExitCode::from(failure.exit_code())
        }
    }
}

/// The parser's complaint without its hints, as one line.
fn one_line(text: &str) -> String {
    let complaint = text.trim_start_matches("error: ").split("\n\n").next().unwrap_or(text);
    complaint.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn complaint(line: &[&str]) -> String {
        match Cli::try_parse_from(line) {
            Ok(_) => panic!("{line:?} is not wrong"),
            Err(e) => one_line(&e.render().to_string()),
        }
    }

    #[test]
    fn the_command_line_is_sound() {
        use clap::CommandFactory as _;
        Cli::command().debug_assert();
    }

    #[test]
    fn complaints_are_one_line_that_says_what_and_where() {
        let missing = complaint(&["ambience", "render", "a.glb"]);
        assert_eq!(missing, "the following required arguments were not provided: --output <OUT.exr>");
        let size = complaint(&["ambience", "render", "a.glb", "-o", "b.exr", "--size", "5"]);
        assert!(size.starts_with("invalid value '5' for '--size <WxH>': expected WIDTHxHEIGHT"), "{size}");
        let server = complaint(&["ambience", "worker", "--server", "nowhere"]);
        assert!(server.contains("expected HOST:PORT or unix:PATH"), "{server}");
    }
}
