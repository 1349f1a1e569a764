//! Keeps a [`Replica`] following the server's log of its namespace, and gives back to the server what it lost.

use std::future::Future;
use std::pin::pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cache_core::{Namespace, Record, RecordId, Tag};
use cache_proto::{convert, v1};
use tokio::sync::{Notify, watch};
use tokio::task::JoinHandle;
use tonic::{Code, Status};
use tracing::{debug, info, warn};

use crate::client::{self, Backoff, Cache};
use crate::job::Dropped;
use crate::replica::Replica;
use crate::threads::{lock, off_thread};

/// How often someone who waits for records looks whether that is still of use.
const LOOK: Duration = Duration::from_millis(200);

/// How long a log that has come to its end is left alone, unless someone waits for its records.
const REST: Duration = Duration::from_secs(30);

/// A replica and the task that feeds it. Dropping it ends the subscription.
pub struct Follower {
    held: Arc<Mutex<Held>>,
    reached: Arc<Progress>,
    /// The last epoch whose log is not to be followed any more.
    left: watch::Sender<u64>,
    wanted: Arc<Notify>,
    received: Arc<AtomicU64>,
    task: JoinHandle<()>,
}

/// All that is held of a namespace.
struct Held {
    replica: Replica,
    /// What the logs before this one held, until the server has it again.
    aside: Option<Replica>,
}

/// How far a replica is, and how its subscription stands.
#[derive(Clone, Default)]
pub struct State {
    /// Which log.
    pub epoch: u64,
    /// How much of it is here.
    pub position: u64,
    /// How long it was when the subscription began.
    pub end: u64,
    /// Whether there is a subscription.
    pub open: bool,
    /// Why the last one ended, if there is none.
    pub ended: Option<Status>,
    /// How many have ended.
    pub attempts: u64,
}

impl State {
    /// The server does not let us read the namespace.
    fn refused(&self) -> Option<Status> {
        self.ended.clone().filter(|status| matches!(status.code(), Code::PermissionDenied | Code::Unauthenticated))
    }
}

/// What is reached, and who waits for it: woken in the order in which they began to wait, so that a simulation of a
/// farm replays.
struct Progress {
    reached: Mutex<State>,
    changed: Notify,
}

impl Progress {
    fn now(&self) -> State {
        lock(&self.reached).clone()
    }

    fn change(&self, change: impl FnOnce(&mut State)) {
        change(&mut lock(&self.reached));
        self.changed.notify_waiters();
    }

    async fn reaches(&self, position: u64) {
        loop {
            let changed = self.changed.notified();
            if self.now().position >= position {
                return;
            }
            changed.await;
        }
    }
}

impl Drop for Follower {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Follower {
    /// Subscribes to `namespace`.
    pub fn start(cache: Cache, namespace: Namespace) -> Self {
        let held = Arc::new(Mutex::new(Held { replica: Replica::new(namespace), aside: None }));
        let reached = Mutex::new(State { epoch: 1, ..State::default() });
        let reached = Arc::new(Progress { reached, changed: Notify::new() });
        let (left, leaving) = watch::channel(0);
        let (wanted, received) = (Arc::new(Notify::new()), Arc::new(AtomicU64::new(0)));
        let feed = Feed {
            cache,
            namespace,
            held: held.clone(),
            reached: reached.clone(),
            left: leaving,
            wanted: wanted.clone(),
            received: received.clone(),
        };
        Self { held, reached, left, wanted, received, task: tokio::spawn(feed.run()) }
    }

    /// Bytes of records received since the last call.
    pub fn take_received(&self) -> u64 {
        self.received.swap(0, Ordering::Relaxed)
    }

    /// Waits until the log reaches `position`: true. Gives up with false when `dropped` says that nobody waits.
    ///
    /// # Errors
    /// The server does not let us read the namespace.
    pub async fn reaches(&self, position: u64, dropped: &Dropped) -> Result<bool, Status> {
        loop {
            let changed = self.reached.changed.notified();
            let now = self.reached.now();
            if let Some(status) = now.refused() {
                return Err(status);
            }
            // What is to be left does not count.
            if now.epoch > *self.left.borrow() && now.position >= position {
                return Ok(true);
            }
            if dropped() {
                return Ok(false);
            }
            self.wanted.notify_one();
            // Look again now and then, whether or not something came.
            drop(tokio::time::timeout(LOOK, changed).await);
        }
    }

    /// How things stand.
    pub fn state(&self) -> State {
        self.reached.now()
    }

    /// The next change of [`Self::state`] after this call.
    pub fn changed(&self) -> impl Future<Output = ()> {
        self.reached.changed.notified()
    }

    /// Somebody waits: a subscription to a draft that was no more is tried again.
    pub fn ask(&self) {
        self.wanted.notify_one();
    }

    /// Follows the server's log from its beginning, if the one that is followed now is of `epoch`: it is not what the
    /// server has.
    pub fn leave(&self, epoch: u64) {
        self.left.send_if_modified(|left| {
            epoch > *left && {
                *left = epoch;
                true
            }
        });
    }

    /// Looks at the replica. The subscription waits as long.
    pub fn read<T>(&self, look: impl FnOnce(&Replica) -> T) -> T {
        look(&lock(&self.held).replica)
    }

    /// The record of an id, from this log or one before it.
    pub fn known(&self, id: RecordId) -> Option<Record> {
        let held = lock(&self.held);
        held.replica.get(id).or_else(|| held.aside.as_ref()?.get(id))
    }
}

/// The subscription's side.
struct Feed {
    cache: Cache,
    namespace: Namespace,
    held: Arc<Mutex<Held>>,
    reached: Arc<Progress>,
    left: watch::Receiver<u64>,
    wanted: Arc<Notify>,
    received: Arc<AtomicU64>,
}

impl Feed {
    /// Subscribes again and again, each time from where the replica is. How long the server may be away is decided by
    /// those who ask it for work.
    async fn run(mut self) {
        let mut backoff = Backoff::default();
        loop {
            let before = self.here();
            let ended = self.subscribe().await.err().unwrap_or_else(|| Status::unavailable("the server ended it"));
            debug!("subscription ended: {ended}");
            let gone = ended.code() == Code::NotFound;
            self.reached.change(|state| {
                (state.open, state.ended, state.attempts) = (false, Some(ended), state.attempts + 1);
            });
            if self.reached.now().refused().is_some() {
                return;
            }
            if gone {
                // A published draft: nothing comes any more, unless a frame fills it again or the server is lost.
                drop(tokio::time::timeout(REST, self.wanted.notified()).await);
            }
            if self.here() != before {
                backoff = Backoff::default();
            }
            backoff.wait().await;
        }
    }

    fn here(&self) -> (u64, u64) {
        let reached = self.reached.now();
        (reached.epoch, reached.position)
    }

    async fn subscribe(&mut self) -> Result<(), Status> {
        let left = *self.left.borrow_and_update();
        if left == self.here().0 {
            self.set_aside();
        }
        let (position, digest) = {
            let held = lock(&self.held);
            (held.replica.position(), convert::digest_bytes(held.replica.digest()))
        };
        let request = v1::SubscribeRequest { namespace: self.namespace.0.to_vec().into(), position, digest };
        let mut stream = self.cache.subscribe(request).await?.into_inner();
        let Some(first) = stream.message().await? else { return Ok(()) };
        match first.position {
            _ if first.batch.is_some() => return Err(Status::internal("the stream does not say where it starts")),
            start if start == position => {}
            0 => {
                warn!("the server has another log now, following it from its beginning");
                self.set_aside();
            }
            start => return Err(Status::internal(format!("the stream starts at {start}, asked for {position}"))),
        }
        self.reached.change(|state| (state.open, state.ended, state.end) = (true, None, first.end));
        let mut refilling = lock(&self.held).aside.is_some();
        let refill = refill(self.cache.clone(), self.namespace, self.held.clone(), self.reached.clone(), first.end);
        let mut refill = pin!(refill);
        loop {
            tokio::select! {
                biased;
                Ok(()) = self.left.changed() => return Ok(()),
                () = &mut refill, if refilling => refilling = false,
                response = stream.message() => match response? {
                    Some(response) => self.apply(response).await?,
                    None => return Ok(()),
                }
            }
        }
    }

    async fn apply(&self, response: v1::SubscribeResponse) -> Result<(), Status> {
        let Some(batch) = response.batch else { return Ok(()) };
        self.received.fetch_add(batch.records.len() as u64, Ordering::Relaxed);
        let held = self.held.clone();
        // Checking takes CPU time, and others hold the lock while they copy.
        let applied = off_thread(move || lock(&held).replica.apply(response.position, &batch)).await;
        let position = applied.map_err(Status::internal)?.map_err(|e| {
            warn!("{e}");
            Status::internal(e.to_string())
        })?;
        self.reached.change(|reached| reached.position = position);
        Ok(())
    }

    fn set_aside(&self) {
        let mut held = lock(&self.held);
        let old = held.replica.set_aside();
        match &mut held.aside {
            Some(aside) => aside.unite(&old),
            None => held.aside = Some(old),
        }
        let epoch = held.replica.epoch();
        self.reached.change(|reached| (reached.epoch, reached.position) = (epoch, 0));
    }
}

/// Gives the server what earlier logs held and this one does not, once it has been read up to `end`.
async fn refill(mut cache: Cache, namespace: Namespace, held: Arc<Mutex<Held>>, reached: Arc<Progress>, mut end: u64) {
    let mut backoff = Backoff::default();
    loop {
        reached.reaches(end).await;
        let mut from = 0;
        // Looked up before each batch: others hold the same records and give them back at the same time.
        while let Some((records, next)) = lacking(&held, from).await {
            match insert(&mut cache, &namespace, &records).await {
                Ok(kept) => {
                    info!(records = records.len(), "gave back to the server");
                    (from, end, backoff) = (next, kept.position, Backoff::default());
                }
                Err(status) if client::is_passing(&status) => {
                    debug!("{status}");
                    backoff.wait().await;
                }
                Err(status) => {
                    warn!("the server does not take back what it lost: {}", status.message());
                    lock(&held).aside = None;
                    return;
                }
            }
        }
        if from == 0 {
            lock(&held).aside = None;
            return;
        }
    }
}

async fn lacking(held: &Arc<Mutex<Held>>, from: usize) -> Option<(Vec<(Tag, Record)>, usize)> {
    let held = held.clone();
    let looking = off_thread(move || {
        let held = lock(&held);
        held.aside.as_ref()?.lacking(&held.replica, from, convert::BATCH_RECORDS_MAX)
    });
    looking.await.ok()?
}

/// What became of inserted records.
pub struct Kept {
    /// Bytes of records sent.
    pub bytes: u64,
    /// Length of the server's log after them.
    pub position: u64,
}

/// Inserts records, each tag's and kind's in batches, and waits until the server keeps them. Repeating it is harmless.
///
/// # Errors
/// The server's.
pub async fn insert(cache: &mut Cache, namespace: &Namespace, records: &[(Tag, Record)]) -> Result<Kept, Status> {
    let batches = convert::batches(namespace, records).map(|(_, batch)| v1::InsertRequest { batch: Some(batch) });
    let batches: Vec<_> = batches.collect();
    let bytes = batches.iter().flat_map(|b| &b.batch).map(|b| b.records.len() as u64).sum();
    let response = cache.insert(tokio_stream::iter(batches)).await?.into_inner();
    Ok(Kept { bytes, position: response.position })
}
