//! The server and workers a render starts for itself: spawned, watched, and always reaped.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt as _, AsyncRead, BufReader};
use tokio::process::{Child, Command};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use worker::client::Address;
use worker::credentials::Credentials;

use crate::failure::Failure;

/// How long a server may take until it listens; one that recovers a large cache takes seconds.
const READY: Duration = Duration::from_secs(120);

/// How long a server may take to close its cache.
const CLOSE: Duration = Duration::from_secs(10);

/// What the server prints before its address; see `cache_server::run`.
const LISTENING: &str = "listening on ";

/// How own children reach their server.
#[derive(Clone, Copy, PartialEq, Eq, Debug, clap::ValueEnum)]
pub enum Transport {
    /// A Unix socket in a private folder.
    Unix,
    /// A free port of the loopback address.
    Tcp,
}

impl Default for Transport {
    fn default() -> Self {
        if cfg!(unix) { Self::Unix } else { Self::Tcp }
    }
}

/// Something the children did.
#[derive(Debug)]
pub enum Event {
    /// A line a child wrote to stderr, with the child's title.
    Line(String, String),
    /// The server ended.
    ServerEnded(ExitStatus),
    /// The worker of this name ended; its title is for messages.
    WorkerEnded {
        /// Name towards the server.
        name: String,
        /// What users call it.
        title: String,
        /// How it ended.
        status: ExitStatus,
    },
}

/// One child. Dropping it ends the process; [`Children::stop`] also waits for its end.
struct Running {
    end: oneshot::Sender<()>,
    watch: JoinHandle<()>,
}

/// All children of a render. What they do comes out of [`Children::next`].
pub struct Children {
    program: PathBuf,
    folder: Option<TempDir>,
    /// Where the server listens; one started in its place listens there too.
    address: Option<Address>,
    server: Option<Running>,
    /// By name.
    workers: BTreeMap<String, Running>,
    started: usize,
    events: (mpsc::UnboundedSender<Event>, mpsc::UnboundedReceiver<Event>),
}

impl Children {
    /// None yet.
    ///
    /// # Errors
    /// When this program's own file cannot be found.
    pub fn new() -> Result<Self, Failure> {
        let program = std::env::current_exe()
            .map_err(|e| Failure::failed(format!("cannot find the program's own file to start workers: {e}")))?;
        let events = mpsc::unbounded_channel();
        Ok(Self { program, folder: None, address: None, server: None, workers: BTreeMap::new(), started: 0, events })
    }

    /// Starts a server and waits until it listens: its address, which stays the same for one started after it ended.
    ///
    /// # Errors
    /// When it does not come up.
    pub async fn start_server(&mut self, transport: Transport, cache: Option<&Path>) -> Result<Address, Failure> {
        let failed = |e: &dyn std::fmt::Display| Failure::failed(format!("cannot start a server: {e}"));
        let folder = match self.folder.take() {
            Some(folder) => folder,
            // Private (0700) by tempfile's own doing.
            None => tempfile::Builder::new().prefix("ambience-").tempdir().map_err(|e| failed(&e))?,
        };
        let mut command = self.command("serve");
        command.arg("--private").arg(folder.path());
        let listen = match (&self.address, transport) {
            (Some(address), _) => address.to_string(),
            (None, Transport::Unix) => format!("unix:{}", socket(folder.path())),
            (None, Transport::Tcp) => "127.0.0.1:0".into(),
        };
        command.args(["--listen", &listen]);
        if let Some(cache) = cache {
            command.arg("--data").arg(cache);
        }
        self.folder = Some(folder);
        let mut child = command.stdout(Stdio::piped()).spawn().map_err(|e| failed(&e))?;
        let stdout = child.stdout.take();
        let patience = cache.map_or(Duration::ZERO, |_| CLOSE);
        self.server = Some(self.watch(child, "server".into(), patience, Event::ServerEnded));
        let stdout = stdout.ok_or_else(|| failed(&"it has no output"))?;
        let address = tokio::time::timeout(READY, listening(stdout));
        let address = address.await.map_err(|_| failed(&format!("not listening after {} s", READY.as_secs())))?;
        let Some(address) = address else { return Err(self.why().await) };
        let address: Address = address.parse().map_err(|e: String| failed(&e))?;
        self.address = Some(address.clone());
        Ok(address)
    }

    /// What a server said that ended before it listened.
    async fn why(&mut self) -> Failure {
        let mut said = Vec::new();
        let wait = async {
            while let Some(event) = self.events.1.recv().await {
                match event {
                    Event::Line(_, line) => said.push(line),
                    _ => break,
                }
            }
        };
        drop(tokio::time::timeout(Duration::from_secs(2), wait).await);
        Failure::failed(format!("cannot start a server: {}", said.join("; ")))
    }

    /// Starts a worker process.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn start_worker(
        &mut self,
        server: &Address,
        credentials: &Credentials,
        threads: u16,
        splat: bool,
    ) -> Result<(), Failure> {
        self.started += 1;
        let (name, title) = (worker::farm::unique_name(), format!("worker {}", self.started));
        let mut command = self.command("worker");
        command.arg("--server").arg(server.to_string());
        command.args(["--threads", &threads.to_string(), "--name", &name]);
        // One device is enough for all that a machine's processors trace.
        command.args((splat && self.started == 1).then_some("--splat"));
        command.args(credentials.insecure().then_some("--insecure")).envs(credentials.environment());
        let child = command.spawn().map_err(|e| Failure::failed(format!("cannot start a worker: {e}")))?;
        let ended = {
            let (name, title) = (name.clone(), title.clone());
            move |status| Event::WorkerEnded { name, title, status }
        };
        let running = self.watch(child, title, Duration::ZERO, ended);
        self.workers.insert(name, running);
        Ok(())
    }

    /// The next thing a child did. Pends for ever when there are none.
    pub async fn next(&mut self) -> Event {
        let event = self.events.1.recv().await;
        match &event {
            Some(Event::WorkerEnded { name, .. }) => drop(self.workers.remove(name)),
            Some(Event::ServerEnded(_)) => self.server = None,
            _ => {}
        }
        match event {
            Some(event) => event,
            None => std::future::pending().await,
        }
    }

    /// Names of the workers that run.
    pub fn names(&self) -> impl Iterator<Item = &String> {
        self.workers.keys()
    }

    /// Ends and reaps every child, and removes the private folder. Nothing they were doing is of use any more.
    pub async fn stop(&mut self) {
        let all: Vec<_> = std::mem::take(&mut self.workers).into_values().chain(self.server.take()).collect();
        let watches: Vec<_> = all.into_iter().map(|r| (drop(r.end), r.watch).1).collect();
        for watch in watches {
            // It only fails when the runtime is going away.
            drop(watch.await);
        }
        while self.events.1.try_recv().is_ok() {}
        (self.folder, self.address) = (None, None);
    }

    fn command(&self, subcommand: &str) -> Command {
        let mut command = Command::new(&self.program);
        command.arg(subcommand).args(["--exit-with-parent", &std::process::id().to_string()]);
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).kill_on_drop(true);
        // Ours are for somebody else's server.
        for variable in Credentials::VARIABLES {
            command.env_remove(variable);
        }
        if std::env::var_os("RUST_LOG").is_none() {
            command.env("RUST_LOG", "warn");
        }
        // Ctrl-C in a terminal reaches the whole foreground group; children end by our doing alone.
        #[cfg(unix)]
        command.process_group(0);
        command
    }

    /// Forwards a child's stderr, waits for its end or ends it: kills it, or if it is given `patience` asks it to end and
    /// kills it after that.
    fn watch(
        &self,
        mut child: Child,
        title: String,
        patience: Duration,
        ended: impl FnOnce(ExitStatus) -> Event + Send + 'static,
    ) -> Running {
        let events = self.events.0.clone();
        let (end, asked) = oneshot::channel::<()>();
        let lines = child.stderr.take().map(|stderr| tokio::spawn(forward(stderr, title, events.clone())));
        let watch = tokio::spawn(async move {
            let by_itself = tokio::select! {
                status = child.wait() => Some(status),
                _ = asked => None,
            };
            match by_itself {
                Some(status) => {
                    if let Some(lines) = lines {
                        // What it said last comes before that it ended.
                        drop(lines.await);
                    }
                    if let Ok(status) = status {
                        drop(events.send(ended(status)));
                    }
                }
                None => {
                    terminate(&child, patience);
                    drop(tokio::time::timeout(patience, child.wait()).await);
                    // Fails only when it has ended.
                    drop(child.kill().await);
                }
            }
        });
        Running { end, watch }
    }
}

/// Asks a child to end, if it is given time for that.
fn terminate(child: &Child, patience: Duration) {
    #[cfg(unix)]
    if let Some(pid) = child.id().and_then(|id| i32::try_from(id).ok()).filter(|_| !patience.is_zero()) {
        use nix::sys::signal::{Signal, kill};
        // Fails only when it has ended.
        let _ = kill(nix::unistd::Pid::from_raw(pid), Signal::SIGTERM);
    }
}

fn socket(folder: &Path) -> String {
    folder.join("socket").display().to_string()
}

/// The address in the first line that names one. Reads on for ever after, so that the server never writes to a closed
/// pipe.
async fn listening(stdout: impl AsyncRead + Unpin + Send + 'static) -> Option<String> {
    let mut lines = BufReader::new(stdout).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        if let Some(address) = line.strip_prefix(LISTENING) {
            let address = address.to_string();
            tokio::spawn(async move { while let Ok(Some(_)) = lines.next_line().await {} });
            return Some(address);
        }
    }
    None
}

async fn forward(stderr: impl AsyncRead + Unpin, title: String, events: mpsc::UnboundedSender<Event>) {
    let mut lines = BufReader::new(stderr).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        drop(events.send(Event::Line(title.clone(), line)));
    }
}

/// How a process ended, in words.
pub fn how(status: ExitStatus) -> String {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        return format!("killed by signal {signal}");
    }
    match status.code() {
        Some(code) => format!("exit code {code}"),
        None => "for an unknown reason".into(),
    }
}
