//! The worker process: leases work from a server, does it, says what came of it.
//!
//! Each of its threads works on one lease at a time, while it tells of the one before. What a lease yields depends on the
//! frame, the step and the tiles alone, so a lease that is lost on the way is simply done again by somebody.

use std::collections::BTreeSet;
use std::hash::{BuildHasher as _, Hasher as _};
use std::pin::pin;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cache_core::{Namespace, Record, Tag};
use cache_proto::v1;
use tokio::task::{JoinError, JoinSet};
use tokio::time::Instant;
use tonic::{Code, Status};
use tracing::{debug, info, warn};

use crate::client::{self, Address, Backoff, Cache, Frames, Line};
use crate::credentials::{CredentialArgs, Credentials};
use crate::follow;
use crate::job::{Dropped, Job, Work};
use crate::ready::{Fault, Ready, Shelf};
use crate::scenes::Scenes;
use crate::task::Done;
use crate::threads::lock;
use crate::traffic::Traffic;

/// Leases live a few seconds on the server; this is several times as often.
const RENEW: Duration = Duration::from_millis(1500);

/// How long a departing worker waits for the server to hear of it.
const FAREWELL: Duration = Duration::from_secs(2);

/// Pause when the server had no work and said so at once.
const IDLE: Duration = Duration::from_millis(100);

/// Most threads: the server lets a worker hold two leases for each.
const THREADS_MAX: i64 = 64;

/// Pause when the server has no room for one more worker or lease.
const FULL: Duration = Duration::from_secs(1);

/// Arguments of the worker.
#[derive(Clone, Debug, clap::Args)]
pub struct WorkerArgs {
    /// Server to work for: HOST:PORT or unix:PATH.
    #[arg(long, value_name = "ADDR")]
    pub server: Address,
    /// Leases worked on at a time, each on a thread of its own [default: one per core].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=THREADS_MAX))]
    pub threads: Option<u16>,
    /// Name towards the server, at most 64 bytes.
    #[arg(long, hide = true)]
    pub name: Option<String>,
    /// How to call it.
    #[command(flatten)]
    pub credentials: CredentialArgs,
}

/// Works for a server until a signal ends it: SIGTERM, SIGINT, or its terminal going away.
///
/// # Errors
/// The server is of another version, or has been away for [`client::PATIENCE`].
pub async fn run<J: Job>(args: WorkerArgs, credentials: &Credentials) -> anyhow::Result<()> {
    let threads = args.threads.map_or_else(|| cores().min(THREADS_MAX as usize), usize::from);
    let traffic = Traffic::default();
    let line = client::connect_counted(&args.server, credentials, &traffic).map_err(anyhow::Error::msg)?;
    let worker = Arc::new(Worker::<J>::new(args.name.unwrap_or_else(unique_name), line, traffic));
    info!(name = worker.name, %args.server, threads, "working");
    let ended = tokio::select! {
        lost = worker.clone().work(threads) => Err(lost),
        () = stopped() => Ok(()),
    };
    worker.leave().await;
    ended.map_err(|lost| match lost.code() {
        _ if client::is_passing(&lost) => anyhow::anyhow!(
            "server {} has been away for {} s: {}",
            args.server,
            client::PATIENCE.as_secs(),
            lost.message()
        ),
        _ => anyhow::anyhow!("server {}: {}", args.server, lost.message()),
    })
}

/// [`run`] on a runtime of its own. Two threads suffice, the work itself has others; a lease in the middle of its work
/// does not hold up the end.
///
/// # Errors
/// As [`run`].
pub fn block_on<J: Job>(args: WorkerArgs, credentials: &Credentials) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let ended = runtime.block_on(run::<J>(args, credentials));
    runtime.shutdown_background();
    ended
}

/// Log lines to stderr; RUST_LOG chooses which, warnings and above by default.
pub fn log_to_stderr() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env();
    let filter = filter.unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn"));
    let colored = std::io::IsTerminal::is_terminal(&std::io::stderr());
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(colored)
        .without_time()
        .init();
}

/// Cores this process may use.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// A name no other worker has: process id and 64 random bits.
pub fn unique_name() -> String {
    let random = std::hash::RandomState::new().build_hasher().finish();
    format!("worker-{}-{random:016x}", std::process::id())
}

#[cfg(unix)]
async fn stopped() {
    use tokio::signal::unix::{SignalKind, signal};
    let wait = async |kind| match signal(kind) {
        Ok(mut signal) => drop(signal.recv().await),
        Err(_) => std::future::pending().await,
    };
    tokio::select! {
        () = wait(SignalKind::terminate()) => {}
        () = wait(SignalKind::interrupt()) => {}
        () = wait(SignalKind::hangup()) => {}
    }
}

#[cfg(not(unix))]
async fn stopped() {
    if tokio::signal::ctrl_c().await.is_err() {
        std::future::pending().await
    }
}

/// A lease whose work is done and of which the server does not know yet.
struct Finished<J> {
    ready: Arc<Ready<J>>,
    step: v1::Step,
    done: Done,
    /// CPU time it took to seal what the work read.
    sealing_seconds: f64,
}

/// What a task that tells of a lease came to.
fn ended_well(ended: Result<Result<(), Status>, JoinError>) -> Result<(), Status> {
    ended.unwrap_or_else(|e| Err(Status::internal(format!("a task of the worker failed: {e}"))))
}

/// One worker process as the server knows it, and the kind of job it does.
pub struct Worker<J> {
    name: String,
    cache: Cache,
    frames: Frames,
    /// Leases being worked on, which the server has not declared lost.
    held: Mutex<BTreeSet<u64>>,
    shelf: Shelf<J>,
    /// Frames declined; every thread may hold a lease of one, its owner is told once.
    declined: Mutex<BTreeSet<u64>>,
    traffic: Traffic,
}

impl<J: Job> Worker<J> {
    /// A worker named `name` for the server behind `line`, whose bytes `traffic` counts.
    pub fn new(name: String, line: Line, traffic: Traffic) -> Self {
        let (cache, frames) = (client::cache(line.clone()), client::frames(line));
        Self {
            name,
            shelf: Shelf::new(cache.clone(), Scenes::new(frames.clone())),
            cache,
            frames,
            traffic,
            held: Mutex::default(),
            declined: Mutex::default(),
        }
    }

    /// Works on `threads` leases at a time. Returns only when the server is lost: its last answer.
    pub async fn work(self: Arc<Self>, threads: usize) -> Status {
        let mut tasks = JoinSet::new();
        let renewing = self.clone();
        tasks.spawn(async move { renewing.renew().await });
        for _ in 0..threads {
            let leasing = self.clone();
            tasks.spawn(async move { leasing.lease(threads).await });
        }
        match tasks.join_next().await {
            Some(Ok(lost)) => lost,
            Some(Err(e)) => Status::internal(format!("a task of the worker failed: {e}")),
            None => Status::internal("no task"),
        }
    }

    /// Gives everything back, if the server still listens.
    pub async fn leave(&self) {
        let request = v1::LeaveRequest { worker: self.name.clone() };
        let mut frames = self.frames.clone();
        drop(tokio::time::timeout(FAREWELL, frames.leave(request)).await);
    }

    async fn renew(&self) -> Status {
        loop {
            tokio::time::sleep(RENEW).await;
            // Leases that come while the question is on its way are not in the answer.
            let asked = lock(&self.held).clone();
            if asked.is_empty() {
                continue;
            }
            let request = v1::RenewRequest { worker: self.name.clone(), leases: asked.iter().copied().collect() };
            let renewed = client::retry(|| {
                let (mut frames, request) = (self.frames.clone(), request.clone());
                async move { self.traffic.time(frames.renew(request)).await }
            });
            match renewed.await {
                Ok(kept) => {
                    let kept: BTreeSet<u64> = kept.leases.into_iter().collect();
                    lock(&self.held).retain(|lease| kept.contains(lease) || !asked.contains(lease));
                }
                Err(status) if status.code() == Code::NotFound => lock(&self.held).retain(|l| !asked.contains(l)),
                Err(status) => return status,
            }
        }
    }

    /// Works on one lease after another. While what came of one is on its way to the server, the next is worked on.
    async fn lease(self: Arc<Self>, threads: usize) -> Status {
        // At most one.
        let mut ending = JoinSet::new();
        loop {
            let mut asked = pin!(self.ask(threads));
            let leased = loop {
                tokio::select! {
                    leased = &mut asked => break leased,
                    Some(ended) = ending.join_next() => if let Err(lost) = ended_well(ended) { return lost },
                }
            };
            let lease = match leased {
                Ok(Some(lease)) => lease,
                Ok(None) => continue,
                Err(lost) => return lost,
            };
            lock(&self.held).insert(lease.id);
            let done = self.do_lease(&lease).await;
            if let Some(Err(lost)) = ending.join_next().await.map(ended_well) {
                return lost;
            }
            ending.spawn(self.clone().end(lease, done));
        }
    }

    /// Asks for a lease for one of so many threads; `None` when there was none to be had for a while.
    async fn ask(&self, threads: usize) -> Result<Option<v1::Lease>, Status> {
        let asked = Instant::now();
        let request = v1::LeaseRequest { worker: self.name.clone(), threads: threads as u32 };
        let leased = client::retry(|| {
            let (mut frames, request) = (self.frames.clone(), request.clone());
            async move { frames.lease(request).await }
        });
        let lease = match leased.await {
            Ok(response) => response.lease,
            Err(status) if status.code() == Code::ResourceExhausted => {
                debug!("{status}");
                tokio::time::sleep(FULL).await;
                None
            }
            Err(status) => return Err(status),
        };
        if lease.is_none() && asked.elapsed() < IDLE {
            tokio::time::sleep(IDLE).await;
        }
        Ok(lease)
    }

    /// Tells the server what came of a lease. Only a server that is lost is an error.
    async fn end(self: Arc<Self>, lease: v1::Lease, done: Result<Finished<J>, Fault>) -> Result<(), Status> {
        let told = match done {
            Ok(done) => self.tell(&lease, done).await,
            Err(fault) => Err(fault),
        };
        lock(&self.held).remove(&lease.id);
        match told {
            Ok(()) => Ok(()),
            Err(Fault::Gone) => {
                debug!(lease.id, "lease is gone");
                Ok(())
            }
            Err(Fault::Unfit(reason)) => self.decline(lease.frame, reason, false).await,
            Err(Fault::Hopeless(reason)) => self.decline(lease.frame, reason, true).await,
            Err(Fault::Server(status)) => Err(status),
        }
    }

    async fn decline(&self, frame: u64, reason: String, for_all: bool) -> Result<(), Status> {
        if !lock(&self.declined).insert(frame) {
            return Ok(());
        }
        warn!(frame, reason, "declining");
        let request = v1::DeclineRequest { worker: self.name.clone(), frame, reason, for_all };
        let declined = client::retry(|| {
            let (mut frames, request) = (self.frames.clone(), request.clone());
            async move { frames.decline(request).await }
        });
        match declined.await {
            Err(status) if status.code() != Code::NotFound => Err(status),
            _ => Ok(()),
        }
    }

    /// Does the work of a lease, once its records are there.
    async fn do_lease(self: &Arc<Self>, lease: &v1::Lease) -> Result<Finished<J>, Fault> {
        let step = lease.step.clone().ok_or_else(|| Fault::Unfit("the server sent a lease without a step".into()))?;
        let dropped = self.dropped(lease.id);
        let ready = self.shelf.frame(lease.frame, || self.describe(lease.frame)).await?;
        let (levels, sealing_seconds) = ready.levels(&step, &dropped).await?;
        let (tiles, known) = (lease.tile_from..lease.tile_to, ready.known());
        let work = Work { step: step.clone(), tiles, levels, known, dropped };
        let done = ready.job.clone().run(work).await.map_err(Fault::Unfit)?;
        let done = done.ok_or(Fault::Gone)?;
        Ok(Finished { ready, step, done, sealing_seconds })
    }

    /// Sends what came of a lease, and ends it.
    async fn tell(self: &Arc<Self>, lease: &v1::Lease, finished: Finished<J>) -> Result<(), Fault> {
        let Finished { ready, step, mut done, sealing_seconds } = finished;
        let worked_seconds = done.cpu_seconds;
        done.cpu_seconds += sealing_seconds;
        let bytes_records = self.insert(&ready.draft, &done.records, &self.dropped(lease.id)).await?;
        let request = v1::CompleteRequest {
            worker: self.name.clone(),
            lease: lease.id,
            frame: lease.frame,
            gathered: done.records.len() as u64,
            counts: done.counts(&step, bytes_records, ready.take_received()),
            tiles: done.tiles,
            worked_seconds,
            used: Some(self.traffic.take()),
        };
        let completed = client::retry(|| {
            let (mut frames, request) = (self.frames.clone(), request.clone());
            async move { frames.complete(request).await }
        });
        if !completed.await?.accepted {
            debug!(lease.id, "completed too late");
        }
        Ok(())
    }

    /// Whether the server has declared a lease lost.
    fn dropped(self: &Arc<Self>, lease: u64) -> Dropped {
        let worker = self.clone();
        Arc::new(move || !lock(&worker.held).contains(&lease))
    }

    async fn describe(&self, frame: u64) -> Result<v1::DescribeResponse, Status> {
        let described = client::retry(|| {
            let mut frames = self.frames.clone();
            async move { self.traffic.time(frames.describe(v1::DescribeRequest { frame })).await }
        });
        described.await
    }

    /// Inserts what a lease gathered; says how many bytes of records it sent. A server whose disk is full, or that is
    /// away, is asked again as long as the lease is ours; one that may keep no more records will not keep them later.
    async fn insert(&self, draft: &Namespace, records: &[(Tag, Record)], dropped: &Dropped) -> Result<u64, Fault> {
        if records.is_empty() {
            return Ok(0);
        }
        let mut backoff = Backoff::default();
        loop {
            let inserted = client::retry_for(Duration::ZERO, || {
                let mut cache = self.cache.clone();
                async move { follow::insert(&mut cache, draft, records).await.map(tonic::Response::new) }
            });
            match inserted.await {
                Ok(kept) => return Ok(kept.bytes),
                Err(_) if dropped() => return Err(Fault::Gone),
                Err(status) if client::is_passing(&status) => warn!("records wait: {}", status.message()),
                Err(status) if status.code() == Code::ResourceExhausted => {
                    return Err(Fault::Hopeless(format!("the server refused records: {}", status.message())));
                }
                // The border found a record unsound: gathered again it would be the same.
                Err(status) if status.code() == Code::InvalidArgument => {
                    return Err(Fault::Unfit(format!("the server refused records: {}", status.message())));
                }
                Err(status) => return Err(status.into()),
            }
            backoff.wait().await;
        }
    }
}
