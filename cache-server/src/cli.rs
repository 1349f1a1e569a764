//! The arguments of `cache-server`, which `ambience serve` re-uses, and what it does with them.

use std::io::Write as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use tokio::signal::unix::{SignalKind, signal};
use tonic::service::Routes;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::LevelFilter;

use crate::access::{TOKEN_VARIABLE, Tokens};
use crate::journal::Journal;
use crate::journal::device::Sync;
use crate::journal::disk::{self, Disk};
use crate::journal::recovery::OpenError;
use crate::limits::{self, Limits, Setting};
use crate::listen::{Bound, Listen, ServeError, bind, bind_health};
use crate::serve::{Config, serve};
use crate::tls::Tls;
use crate::{clock, files, metrics};

/// Keeps records and gives out work until it is told to stop.
#[derive(Clone, Debug, clap::Args)]
pub struct ServeArgs {
    /// Where to listen: HOST:PORT (port 0: any free one) or unix:/path; may be given several times
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:4670")]
    pub listen: Vec<Listen>,
    /// Certificate of this server, PEM, and those that lead to the authority clients know: TCP is encrypted
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub tls_cert: Option<PathBuf>,
    /// Its key, PEM
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub tls_key: Option<PathBuf>,
    /// Who may call: lines NAME TOKEN [default: the token in the environment variable AMBIENCE_TOKEN, if it is set]
    ///
    /// Each call then has to bring a token. A namespace belongs to the name whose token wrote to it first.
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Allow addresses that other machines can reach without certificate and tokens
    #[arg(long)]
    pub insecure: bool,
    /// Keep records in this directory: what was acknowledged survives the server [default: in memory only]
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Set a bound, such as records=1000000; --help lists them
    #[arg(long, value_name = "NAME=VALUE", long_help = limits::help())]
    pub limit: Vec<Setting>,
    /// Where Prometheus reads metrics: HOST:PORT, over plain HTTP
    #[arg(long, value_name = "ADDR")]
    pub metrics: Option<SocketAddr>,
    /// Answer calls of grpc.health.v1 alone here, unencrypted, for probes that know no TLS: HOST:PORT
    #[arg(long, value_name = "ADDR")]
    pub health: Option<SocketAddr>,
    /// How log lines on stderr look
    #[arg(long, value_name = "FORMAT", value_enum, default_value_t)]
    pub log_format: LogFormat,
    /// Check all of this, say what would be served, and end: exit code 0 if it would be served, else 2
    #[arg(long)]
    pub check: bool,
}

/// How log lines look.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, clap::ValueEnum)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

/// Runs a server until Ctrl-C or SIGTERM, then lets running calls end. Prints `listening on ADDR` to stdout for each
/// address once clients can connect.
///
/// # Errors
/// What keeps it from running, in one line; [`ServeError::exit_code`] says how to exit.
pub async fn run(args: ServeArgs) -> Result<(), ServeError> {
    run_as(args, None).await
}

/// As [`run`]; what others answer `instead` of its own store and frames, they answer behind the same door.
///
/// # Errors
/// As [`run`].
pub async fn run_as(args: ServeArgs, instead: Option<Routes>) -> Result<(), ServeError> {
    if args.check {
        return args.check().map_err(|error| ServeError::Usage(error.to_string()));
    }
    let failed = |error: std::io::Error| ServeError::Failed(format!("cannot wait for signals: {error}"));
    // Before binding, so that a signal at any time after removes the sockets' files.
    let mut interrupt = signal(SignalKind::interrupt()).map_err(failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(failed)?;
    let mut config = Config { instead, ..args.config()? };
    if let Some(address) = args.metrics {
        metrics::publish(args.allowed(address, "--metrics")?)?;
    }
    files::allow(config.limits.connections);
    let mut sockets = args.bind(&config)?;
    if let Some(directory) = &args.data {
        config.journal = open(directory)?;
    }
    for socket in &sockets {
        tracing::info!(address = %socket.address(), version = cache_proto::VERSION, "listening");
        // Nobody may read it; that is no reason not to serve.
        let _ = writeln!(std::io::stdout(), "listening on {}", socket.address());
    }
    // Clients are not told of it.
    sockets.extend(args.health.map(bind_health).transpose()?);
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
    let (journal, report) = Disk::open(directory, Sync::Device).map_err(no_data)?;
    tracing::info!(directory = %directory.display(), records = report.records, "recovered");
    if let Some(torn) = report.torn {
        tracing::warn!("{}: append {torn} was begun before a crash and is not whole", directory.display());
    }
    if let Some(damage) = report.damage {
        tracing::warn!("{} {damage}", directory.display());
    }
    Ok(Box::new(journal))
}

fn no_data(error: OpenError) -> ServeError {
    match error.exit_code() {
        2 => ServeError::Usage(format!("--data: {error}")),
        _ => ServeError::Failed(format!("--data: {error}")),
    }
}

impl ServeArgs {
    /// What the files and the environment say.
    fn config(&self) -> Result<Config, ServeError> {
        let tokens = match (&self.token_file, std::env::var(TOKEN_VARIABLE)) {
            (Some(path), _) => Tokens::load(path),
            (None, Ok(token)) => Tokens::single(&token),
            (None, Err(std::env::VarError::NotPresent)) => Ok(Tokens::default()),
            (None, Err(error)) => Err(format!("{TOKEN_VARIABLE}: {}", without_value(&error))),
        };
        let tls = match (&self.tls_cert, &self.tls_key) {
            (Some(certificate), Some(key)) => Some(Tls::load(certificate, key, clock::date())),
            _ => None,
        };
        Ok(Config {
            limits: Limits::with(&self.limit),
            tokens: tokens.map_err(ServeError::Usage)?,
            tls: tls.transpose().map_err(ServeError::Usage)?,
            ..Config::default()
        })
    }

    fn bind(&self, config: &Config) -> Result<Vec<Bound>, ServeError> {
        let guarded = config.tls.is_some() && !config.tokens.is_empty();
        self.listen.iter().map(|listen| bind(listen, self.insecure || guarded)).collect()
    }

    /// An address without guard.
    fn allowed(&self, address: SocketAddr, option: &str) -> Result<SocketAddr, ServeError> {
        if address.ip().is_loopback() || self.insecure {
            return Ok(address);
        }
        let reason = "can be reached by others and asks for no token: use a loopback address, or say --insecure";
        Err(ServeError::Usage(format!("{option} {address} {reason}")))
    }

    /// Does everything up to serving, and says what would be served.
    fn check(&self) -> Result<(), ServeError> {
        let config = self.config()?;
        let mut would = Vec::new();
        if let Some(address) = self.metrics {
            let bound = bind(&Listen::Tcp(self.allowed(address, "--metrics")?), true)?;
            would.push(format!("metrics on http://{}/metrics", bound.address()));
        }
        for socket in self.bind(&config)? {
            let encrypted = config.tls.is_some() && matches!(socket.address(), Listen::Tcp(_));
            let how = if encrypted { "TLS" } else { "not encrypted" };
            would.push(format!("would listen on {}, {how}", socket.address()));
        }
        if let Some(address) = self.health {
            would.push(format!("health on {}, not encrypted", bind_health(address)?.address()));
        }
        would.push(match config.tokens.names() {
            names if names.is_empty() => "no tokens: whoever can connect may read and change everything".into(),
            names => format!("tokens of {}", names.join(", ")),
        });
        would.push(match &self.data {
            Some(directory) => {
                disk::usable(directory).map_err(no_data)?;
                format!("records in {}", directory.display())
            }
            None => "records in memory only".into(),
        });
        let files = files::needed(config.limits.connections);
        if let Some(most) = files::most().filter(|most| *most < files) {
            would.push(format!("warning: {files} open files may be needed and {most} are allowed; see ulimit -n"));
        }
        // Nobody may read it; the exit code says the same.
        let _ = writeln!(std::io::stdout(), "{}", would.join("\n"));
        Ok(())
    }
}

/// What is wrong with a variable, but not what it holds.
fn without_value(error: &std::env::VarError) -> &'static str {
    match error {
        std::env::VarError::NotPresent => "is not set",
        std::env::VarError::NotUnicode(_) => "has bytes that are not printable ASCII",
    }
}

/// Sends logs to stderr, as much as RUST_LOG says (default: info). For programs, once; libraries only log.
pub fn log_to_stderr(format: LogFormat) {
    let filter = EnvFilter::builder().with_default_directive(LevelFilter::INFO.into()).from_env_lossy();
    let colored = std::io::IsTerminal::is_terminal(&std::io::stderr());
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    match format {
        LogFormat::Text => log.with_ansi(colored).init(),
        LogFormat::Json => log.json().flatten_event(true).with_span_list(false).init(),
    }
}
