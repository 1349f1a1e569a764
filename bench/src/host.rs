//! A server in a process of its own, so that its CPU time and memory can be told from its clients'.

use std::error::Error;
use std::fs::File;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::Arc;

use cache_proto::v1::cache_server::CacheServer;
use cache_server::journal::Journal;
use cache_server::journal::device::Sync;
use cache_server::journal::disk::Disk;
use cache_server::serve::{CACHE_MESSAGE_MAX, CONNECTION_WINDOW, STREAM_WINDOW};
use cache_server::{Config, Listen};
use nix::sys::resource::{UsageWho, getrusage};
use tempfile::TempDir;
use tokio::net::{UnixListener, UnixStream};
use tokio_stream::wrappers::UnixListenerStream;
use tonic::transport::Server;
use worker::client::{Line, connect_with};

use crate::bare::Bare;
use crate::records;

/// What is behind the socket.
#[derive(Clone, Copy, PartialEq, Eq, Debug, clap::ValueEnum)]
pub enum Kind {
    /// Nothing: the bare stream, its messages forgotten.
    Bare,
    /// Nothing, but the messages are kept in memory as they came.
    Keep,
    /// Nothing, but the messages are kept in memory, and their bytes written to a file.
    Write,
    /// The service, records in memory only.
    Memory,
    /// The service, records durable in the kernel's page cache.
    Page,
    /// The service, records durable on the device.
    Device,
}

/// The server's arguments.
#[derive(Clone, Debug, clap::Args)]
pub struct HostArgs {
    kind: Kind,
    /// Folder for the socket and the journal.
    folder: PathBuf,
    /// Records in all, and in one batch, that a bare stream has to send.
    prepared: u64,
    size: u64,
}

/// CPU time and memory of a process.
#[derive(Clone, Copy, Default, Debug)]
pub struct Usage {
    /// CPU seconds, all threads, user and system.
    pub cpu: f64,
    /// Most memory resident so far, bytes.
    pub peak: f64,
}

/// A running server. Dropping it ends the process.
pub struct Host {
    child: Child,
    ask: ChildStdin,
    answers: BufReader<ChildStdout>,
    /// Goes with the last server that was started in it.
    folder: Arc<TempDir>,
}

impl Host {
    /// Starts a server and waits until it listens. A bare stream has `prepared` records to send in batches of `size`.
    ///
    /// # Errors
    /// When it does not come up.
    pub fn start(kind: Kind, prepared: u64, size: u64) -> Result<Self, Box<dyn Error>> {
        // Not in memory, whatever the system's own choice is: journals are measured.
        let folder = tempfile::Builder::new().prefix("ambience-bench-").tempdir_in("/var/tmp")?;
        Self::start_in(folder.into(), kind, prepared, size)
    }

    /// The same in the folder of one that was killed.
    ///
    /// # Errors
    /// When it does not come up.
    pub fn start_in(folder: Arc<TempDir>, kind: Kind, prepared: u64, size: u64) -> Result<Self, Box<dyn Error>> {
        let name = clap::ValueEnum::to_possible_value(&kind).ok_or("no such kind")?;
        let mut child = Command::new(std::env::current_exe()?)
            .args(["host", name.get_name()])
            .arg(folder.path())
            .args([prepared.to_string(), size.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let (ask, answers) = (child.stdin.take().ok_or("no stdin")?, child.stdout.take().ok_or("no stdout")?);
        let mut host = Self { child, ask, answers: BufReader::new(answers), folder };
        host.usage()?;
        Ok(host)
    }

    /// Ends the server as `kill -9` does; its folder, for another.
    ///
    /// # Errors
    /// The system's.
    pub fn kill(mut self) -> Result<Arc<TempDir>, Box<dyn Error>> {
        self.child.kill()?;
        self.child.wait()?;
        std::fs::remove_file(socket(self.folder.path()))?;
        Ok(self.folder.clone())
    }

    /// Where it listens.
    pub fn address(&self) -> String {
        format!("unix:{}", socket(self.folder.path()).display())
    }

    /// A new connection.
    pub fn connect(&self) -> Line {
        let path = socket(self.folder.path());
        connect_with(move || UnixStream::connect(path.clone()))
    }

    /// What it has used so far.
    ///
    /// # Errors
    /// When it has ended.
    pub fn usage(&mut self) -> Result<Usage, Box<dyn Error>> {
        writeln!(self.ask)?;
        let mut line = String::new();
        self.answers.read_line(&mut line)?;
        let (cpu, peak) = line.trim().split_once(' ').ok_or("the server has ended")?;
        Ok(Usage { cpu: cpu.parse()?, peak: peak.parse()? })
    }
}

impl Drop for Host {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Where its journal lies.
pub fn journal_in(folder: &Path) -> PathBuf {
    folder.join("journal")
}

fn socket(folder: &Path) -> PathBuf {
    folder.join("socket")
}

/// What this process has used so far.
///
/// # Errors
/// The system's.
pub fn usage() -> Result<Usage, nix::Error> {
    let usage = getrusage(UsageWho::RUSAGE_SELF)?;
    // Linux counts the parent's memory into `max_rss` from before the program was its own.
    let peak = peak("self").unwrap_or(usage.max_rss() as f64);
    Ok(Usage { cpu: seconds(&usage), peak })
}

/// Most memory of a process that was resident, bytes, by its name in /proc.
pub(crate) fn peak(process: &str) -> Option<f64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.trim().strip_suffix(" kB"))?;
    line.parse().ok().map(|kilobytes: f64| kilobytes * 1024.0)
}

/// CPU seconds of the children of this process that have ended, and of those they waited for.
///
/// # Errors
/// The system's.
pub fn children() -> Result<f64, nix::Error> {
    Ok(seconds(&getrusage(UsageWho::RUSAGE_CHILDREN)?))
}

fn seconds(usage: &nix::sys::resource::Usage) -> f64 {
    [usage.user_time(), usage.system_time()].iter().map(|t| t.tv_sec() as f64 + t.tv_usec() as f64 * 1e-6).sum()
}

/// The server's side: serves until its stdin ends, and answers each line there with its [`Usage`].
///
/// # Errors
/// When it cannot.
pub fn serve(args: &HostArgs) -> Result<(), Box<dyn Error>> {
    let prepared = match args.kind {
        Kind::Bare => records::batches(&records::NAMESPACE, args.prepared, args.size),
        _ => Vec::new(),
    };
    let runtime = tokio::runtime::Runtime::new()?;
    let _within = runtime.enter();
    let path = socket(&args.folder);
    let serving: std::pin::Pin<Box<dyn Future<Output = Result<(), String>> + Send>> = match journal(args)? {
        None => {
            let keeps = args.kind != Kind::Bare;
            let file = (args.kind == Kind::Write).then(|| File::create(args.folder.join("bytes"))).transpose()?;
            let incoming = UnixListenerStream::new(UnixListener::bind(&path)?);
            let bare = CacheServer::new(Bare::new(prepared, keeps, file)).max_decoding_message_size(CACHE_MESSAGE_MAX);
            let server = Server::builder()
                .initial_stream_window_size(STREAM_WINDOW)
                .initial_connection_window_size(CONNECTION_WINDOW)
                .add_service(bare);
            Box::pin(async { server.serve_with_incoming(incoming).await.map_err(|e| e.to_string()) })
        }
        Some(journal) => {
            let bound = cache_server::bind(&Listen::Unix(path), false)?;
            let config = Config { journal, ..Config::default() };
            let serving = cache_server::serve(vec![bound], config, std::future::pending());
            Box::pin(async { serving.await.map_err(|e| e.to_string()) })
        }
    };
    let serving = runtime.spawn(async {
        if let Err(error) = serving.await {
            eprintln!("host: {error}");
        }
    });
    for _ in std::io::stdin().lines() {
        let Usage { cpu, peak } = usage()?;
        println!("{cpu} {peak}");
    }
    serving.abort();
    runtime.shutdown_background();
    Ok(())
}

fn journal(args: &HostArgs) -> Result<Option<Box<dyn Journal>>, Box<dyn Error>> {
    let disk = |sync| Disk::open(&journal_in(&args.folder), sync).map(|(disk, _)| Box::new(disk) as Box<dyn Journal>);
    Ok(match args.kind {
        Kind::Bare | Kind::Keep | Kind::Write => None,
        Kind::Memory => Some(Box::new(cache_server::journal::Nowhere)),
        Kind::Page => Some(disk(Sync::PageCache).map_err(|e| e.to_string())?),
        Kind::Device => Some(disk(Sync::Device).map_err(|e| e.to_string())?),
    })
}
