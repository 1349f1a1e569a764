//! The worker process: leases work from a server, does it, says what came of it.
//!
//! Each of its threads holds one lease at a time. What a lease yields depends on the frame, the step and the tiles alone,
//! so a lease that is lost on the way is simply done again by somebody.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{BuildHasher as _, Hasher as _};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use cache_core::Namespace;
use cache_proto::{VERSION, convert, v1};
use tokio::sync::OnceCell;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tonic::{Code, Status};
use tracing::{debug, info, warn};

use crate::client::{self, Address, Cache, Frames};
use crate::follow::{self, Follower};
use crate::frame::Frame;
use crate::job::{Dropped, Job, Known, Work, off_thread};
use crate::replica::{Caches, ReplicaError};
use crate::task::Done;

/// Leases live a few seconds on the server; this is several times as often.
const RENEW: Duration = Duration::from_millis(1500);

/// Frames kept ready, the last used ones.
const FRAMES_KEPT: usize = 4;

/// How long a departing worker waits for the server to hear of it.
const FAREWELL: Duration = Duration::from_secs(2);

/// Pause when the server had no work and said so at once.
const IDLE: Duration = Duration::from_millis(100);

/// Most threads, since the server lets a worker hold so many leases.
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
}

/// Works for a server until a signal ends it: SIGTERM, SIGINT, or its terminal going away.
///
/// # Errors
/// The server is of another version, or has been away for [`client::PATIENCE`].
pub async fn run(args: WorkerArgs) -> anyhow::Result<()> {
    let threads = args.threads.map_or_else(|| cores().min(THREADS_MAX as usize), usize::from);
    let worker = Arc::new(Worker::<Frame>::new(args.name.unwrap_or_else(unique_name), client::connect(&args.server)));
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
pub fn block_on(args: WorkerArgs) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let ended = runtime.block_on(run(args));
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

/// Why a lease did not come to its end.
enum Fault {
    /// It is no longer ours, or its frame is gone.
    Gone,
    /// This worker cannot do the frame, and why.
    Unfit(String),
    /// The server.
    Server(Status),
}

impl From<Status> for Fault {
    fn from(status: Status) -> Self {
        if status.code() == Code::NotFound { Self::Gone } else { Self::Server(status) }
    }
}

/// A frame made ready.
struct Loaded<J> {
    job: Arc<J>,
    /// Where its records go.
    draft: Namespace,
    /// Absent for methods without records.
    follower: Option<Arc<Follower>>,
    caches: Arc<Mutex<Caches>>,
}

type Slot<J> = Arc<OnceCell<Arc<Loaded<J>>>>;

/// One worker process as the server knows it, and the kind of job it does.
pub struct Worker<J> {
    name: String,
    cache: Cache,
    frames: Frames,
    /// Leases being worked on, which the server has not declared lost.
    held: Mutex<BTreeSet<u64>>,
    /// Last used last.
    loaded: Mutex<Vec<(u64, Slot<J>)>>,
    followers: Mutex<BTreeMap<Namespace, Arc<Follower>>>,
    /// Frames declined; every thread may hold a lease of one, its owner is told once.
    declined: Mutex<BTreeSet<u64>>,
}

impl<J: Job> Worker<J> {
    /// A worker named `name` for the server behind `channel`.
    pub fn new(name: String, channel: tonic::transport::Channel) -> Self {
        Self {
            name,
            cache: client::cache(channel.clone()),
            frames: client::frames(channel),
            held: Mutex::default(),
            loaded: Mutex::default(),
            followers: Mutex::default(),
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
            tasks.spawn(async move { leasing.lease().await });
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
            let request = v1::RenewRequest { worker: self.name.clone() };
            let renewed = client::retry(|| {
                let (mut frames, request) = (self.frames.clone(), request.clone());
                async move { frames.renew(request).await }
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

    async fn lease(self: Arc<Self>) -> Status {
        loop {
            let asked = Instant::now();
            let request = v1::LeaseRequest { worker: self.name.clone(), version: VERSION.into() };
            let leased = client::retry(|| {
                let (mut frames, request) = (self.frames.clone(), request.clone());
                async move { frames.lease(request).await }
            });
            let lease = match leased.await {
                Ok(response) => response.lease,
                Err(status) if status.code() == Code::ResourceExhausted => {
                    debug!("{status}");
                    tokio::time::sleep(FULL).await;
                    continue;
                }
                Err(status) => return status,
            };
            let Some(lease) = lease else {
                if asked.elapsed() < IDLE {
                    tokio::time::sleep(IDLE).await;
                }
                continue;
            };
            lock(&self.held).insert(lease.id);
            let outcome = self.do_lease(&lease).await;
            lock(&self.held).remove(&lease.id);
            match outcome {
                Ok(()) => {}
                Err(Fault::Gone) => debug!(lease.id, "lease is gone"),
                Err(Fault::Unfit(reason)) => {
                    if let Err(status) = self.decline(lease.frame, reason).await {
                        return status;
                    }
                }
                Err(Fault::Server(status)) => return status,
            }
        }
    }

    async fn decline(&self, frame: u64, reason: String) -> Result<(), Status> {
        if !lock(&self.declined).insert(frame) {
            return Ok(());
        }
        warn!(frame, reason, "declining");
        let request = v1::DeclineRequest { worker: self.name.clone(), frame, reason };
        let declined = client::retry(|| {
            let (mut frames, request) = (self.frames.clone(), request.clone());
            async move { frames.decline(request).await }
        });
        match declined.await {
            Err(status) if status.code() != Code::NotFound => Err(status),
            _ => Ok(()),
        }
    }

    /// A lease from its records' arrival to its acknowledged end.
    async fn do_lease(self: &Arc<Self>, lease: &v1::Lease) -> Result<(), Fault> {
        let step = lease.step.clone().ok_or_else(|| Fault::Unfit("the server sent a lease without a step".into()))?;
        let loaded = self.frame(lease.frame).await?;
        let done = self.do_tiles(lease, &step, &loaded).await?;
        let namespace = &loaded.draft;
        let mut bytes_records = 0;
        if !done.records.is_empty() {
            let inserted = client::retry(|| {
                let (mut cache, records) = (self.cache.clone(), done.records.clone());
                async move { follow::insert(&mut cache, namespace, &records).await.map(tonic::Response::new) }
            });
            bytes_records = inserted.await.map_err(|status| match status.code() {
                // The border found a record unsound: gathered again it would be the same.
                Code::InvalidArgument => Fault::Unfit(format!("the server refused records: {}", status.message())),
                _ => Fault::from(status),
            })?;
        }
        let received = loaded.follower.as_ref().map_or(0, |f| f.take_received());
        let request = v1::CompleteRequest {
            worker: self.name.clone(),
            lease: lease.id,
            frame: lease.frame,
            gathered: done.records.len() as u64,
            counts: done.counts(&step, bytes_records, received),
            tiles: done.tiles,
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

    /// The CPU work of a lease, off the runtime's threads.
    async fn do_tiles(
        self: &Arc<Self>,
        lease: &v1::Lease,
        step: &v1::Step,
        loaded: &Arc<Loaded<J>>,
    ) -> Result<Done, Fault> {
        let (worker, id) = (self.clone(), lease.id);
        let dropped: Dropped = Arc::new(move || !lock(&worker.held).contains(&id));
        let digest = convert::digest(&step.sealed_digest).map_err(|e| Fault::Unfit(e.to_string()))?;
        if let Some(follower) = &loaded.follower
            && !follower.reaches(step.sealed_position, &*dropped).await
        {
            return Err(Fault::Gone);
        }
        let (ready, position) = (loaded.clone(), step.sealed_position);
        let sealing = off_thread(move || match &ready.follower {
            Some(follower) => {
                let mut caches = lock(&ready.caches);
                let part = follower.part(caches.position(), position)?;
                caches.seal(&part, digest)
            }
            None => Ok(Vec::new()),
        });
        let levels = match sealing.await.map_err(Fault::Unfit)? {
            Ok(levels) => levels,
            Err(ReplicaError::Outdated { .. }) => return Err(Fault::Gone),
            Err(e @ ReplicaError::Digest { .. }) => {
                // The server may have come back with another log than the one followed so far.
                warn!("{e}; following the server's log anew");
                self.forget(lease.frame, loaded);
                return Err(Fault::Gone);
            }
            Err(e) => return Err(Fault::Unfit(e.to_string())),
        };
        let known: Known = Arc::new(|_| None);
        let work = Work { step: step.clone(), tiles: lease.tile_from..lease.tile_to, levels, known, dropped };
        loaded.job.clone().run(work).await.map_err(Fault::Unfit)?.ok_or(Fault::Gone)
    }

    /// A frame made ready, once, whoever asks first.
    async fn frame(self: &Arc<Self>, id: u64) -> Result<Arc<Loaded<J>>, Fault> {
        let slot = {
            let mut loaded = lock(&self.loaded);
            let slot = match loaded.iter().position(|(known, _)| *known == id) {
                Some(at) => loaded.remove(at).1,
                None => Slot::default(),
            };
            loaded.push((id, slot.clone()));
            if loaded.len() > FRAMES_KEPT {
                loaded.remove(0);
            }
            let used: Vec<_> = loaded.iter().filter_map(|(_, s)| Some(s.get()?.draft)).collect();
            // Frames evicted while in use keep their follower by themselves.
            lock(&self.followers).retain(|namespace, _| used.contains(namespace));
            slot
        };
        slot.get_or_try_init(|| self.load(id)).await.cloned()
    }

    async fn load(self: &Arc<Self>, id: u64) -> Result<Arc<Loaded<J>>, Fault> {
        let described = client::retry(|| {
            let mut frames = self.frames.clone();
            async move { frames.describe(v1::DescribeRequest { frame: id }).await }
        });
        let described = described.await?;
        let job = J::prepare(&described).await.map_err(Fault::Unfit)?;
        let draft = convert::namespace(&described.draft).map_err(|e| Fault::Unfit(e.to_string()))?;
        let start = || Arc::new(Follower::start(self.cache.clone(), draft));
        let follower = (job.levels() > 0).then(|| lock(&self.followers).entry(draft).or_insert_with(start).clone());
        let caches = Arc::new(Mutex::new(Caches::new(job.a(), job.levels())));
        Ok(Arc::new(Loaded { job: Arc::new(job), draft, follower, caches }))
    }

    /// Makes the next lease of a frame start over with an empty replica.
    fn forget(&self, frame: u64, loaded: &Arc<Loaded<J>>) {
        let mut frames = lock(&self.loaded);
        // Another thread may have done so already, and a new one be on its way.
        frames.retain(|(id, slot)| *id != frame || !slot.get().is_some_and(|l| Arc::ptr_eq(l, loaded)));
        let mut followers = lock(&self.followers);
        let namespace = &loaded.draft;
        let same = |f: &Arc<Follower>| loaded.follower.as_ref().is_some_and(|mine| Arc::ptr_eq(f, mine));
        if followers.get(namespace).is_some_and(same) {
            followers.remove(namespace);
        }
    }
}

/// A panic while holding one of these locks has been reported by then.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
