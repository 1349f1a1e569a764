//! The arguments of `cache-server`, which `ambience serve` re-uses, and what it does with them.

use std::io::Write as _;
use std::path::{Path, PathBuf};

use tokio::signal::unix::{SignalKind, signal};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::LevelFilter;

use crate::journal::Journal;
use crate::journal::device::Sync;
use crate::journal::disk::Disk;
use crate::listen::{Listen, ServeError, bind};
use crate::serve::{Config, serve};

/// Keeps records and gives out work until it is told to stop.
#[derive(Clone, Debug, clap::Args)]
pub struct ServeArgs {
    /// Where to listen: HOST:PORT (port 0: any free one) or unix:/path; may be given several times
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:4670")]
    pub listen: Vec<Listen>,
    /// Allow addresses that other machines can reach; whoever can connect may read and change everything
    #[arg(long)]
    pub insecure: bool,
    /// Keep records in this directory: what was acknowledged survives the server [default: in memory only]
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
}

/// Runs a server until Ctrl-C or SIGTERM, then lets running calls end. Prints `listening on ADDR` to stdout for each
/// address once clients can connect.
///
/// # Errors
/// What keeps it from running, in one line; [`ServeError::exit_code`] says how to exit.
pub async fn run(args: ServeArgs) -> Result<(), ServeError> {
    let failed = |error: std::io::Error| ServeError::Failed(format!("cannot wait for signals: {error}"));
    // Before binding, so that a signal at any time after removes the sockets' files.
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    let config = match &args.data {
        Some(directory) => Config { journal: open(directory)?, ..Config::default() },
        None => Config::default(),
    };
    let sockets = args.listen.iter().map(|listen| bind(listen, args.insecure)).collect::<Result<Vec<_>, _>>()?;
    for socket in &sockets {
        tracing::info!(address = %socket.address(), version = cache_proto::VERSION, "listening");
        // Nobody may read it; that is no reason not to serve.
        let _ = writeln!(std::io::stdout(), "listening on {}", socket.address());
    }
    let shutdown = async move {
        tokio::select! {
            _ = interrupt.recv() => (),
            _ = terminate.recv() => (),
        }
        tracing::info!("shutting down");
    };
    serve(sockets, config, shutdown).await
}

fn open(directory: &Path) -> Result<Box<dyn Journal>, ServeError> {
    let (journal, report) = Disk::open(directory, Sync::Device).map_err(|error| match error.exit_code() {
        2 => ServeError::Usage(format!("--data: {error}")),
        _ => ServeError::Failed(format!("--data: {error}")),
    })?;
    tracing::info!(directory = %directory.display(), records = report.records, "recovered");
    if let Some(damage) = report.damage {
        tracing::warn!("{} {damage}", directory.display());
    }
    Ok(Box::new(journal))
}

/// Sends logs to stderr, as much as RUST_LOG says (default: info). For programs, once; libraries only log.
pub fn log_to_stderr() {
    let filter = EnvFilter::builder().with_default_directive(LevelFilter::INFO.into()).from_env_lossy();
    let colored = std::io::IsTerminal::is_terminal(&std::io::stderr());
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(colored).init();
}
