//! Keeps a [`Replica`] following the server's log of its namespace.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use cache_core::{Irradiance, Namespace, Tag};
use cache_proto::{convert, v1};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tonic::{Code, Status};
use tracing::{debug, warn};

use crate::client::{Backoff, Cache};
use crate::replica::{Part, Replica, ReplicaError};

/// How often someone who waits for records looks whether that is still of use.
const LOOK: Duration = Duration::from_millis(200);

/// A replica and the task that feeds it. Dropping it ends the subscription.
pub struct Follower {
    replica: Arc<Mutex<Replica>>,
    position: watch::Receiver<u64>,
    received: Arc<AtomicU64>,
    task: JoinHandle<()>,
}

impl Drop for Follower {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Follower {
    /// Subscribes to `namespace`.
    pub fn start(cache: Cache, namespace: Namespace) -> Self {
        let replica = Arc::new(Mutex::new(Replica::new(namespace)));
        let (sender, position) = watch::channel(0);
        let received = Arc::new(AtomicU64::new(0));
        let feed = Feed { cache, namespace, replica: replica.clone(), position: sender, received: received.clone() };
        Self { replica, position, received, task: tokio::spawn(feed.run()) }
    }

    /// Bytes of records received since the last call.
    pub fn take_received(&self) -> u64 {
        self.received.swap(0, Ordering::Relaxed)
    }

    /// Waits until the log reaches `position`: true. Gives up with false when `dropped` says that nobody waits.
    pub async fn reaches(&self, position: u64, dropped: impl Fn() -> bool) -> bool {
        let mut here = self.position.clone();
        while *here.borrow_and_update() < position {
            if dropped() {
                return false;
            }
            // Ran out of time, or the subscription ended for good: look again, at the same pace.
            if let Ok(Err(_)) = tokio::time::timeout(LOOK, here.changed()).await {
                tokio::time::sleep(LOOK).await;
            }
        }
        true
    }

    /// As [`Replica::part`]. Takes CPU time: not for the runtime's threads.
    ///
    /// # Errors
    /// As [`Replica::part`].
    pub fn part(&self, from: u64, to: u64) -> Result<Part, ReplicaError> {
        lock(&self.replica).part(from, to)
    }
}

/// A panic elsewhere cannot leave a replica half changed in a way that matters: digests are checked.
fn lock(replica: &Mutex<Replica>) -> MutexGuard<'_, Replica> {
    replica.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The subscription's side.
struct Feed {
    cache: Cache,
    namespace: Namespace,
    replica: Arc<Mutex<Replica>>,
    position: watch::Sender<u64>,
    received: Arc<AtomicU64>,
}

impl Feed {
    /// Subscribes again and again, each time from where the replica is. How long the server may be away is decided by
    /// those who ask it for work.
    async fn run(mut self) {
        let mut backoff = Backoff::default();
        loop {
            let before = *self.position.borrow();
            let end = self.subscribe().await;
            if *self.position.borrow() != before {
                backoff = Backoff::default();
            }
            match end {
                Ok(()) => debug!("the server ended the subscription"),
                Err(status) if status.code() == Code::OutOfRange => {
                    // Records of an interrupted frame would change the one begun in its place: follow the new log.
                    warn!("the server lost its records, beginning anew: {}", status.message());
                    *lock(&self.replica) = Replica::new(self.namespace);
                    self.position.send_replace(0);
                }
                Err(status) => debug!("subscription ended: {status}"),
            }
            backoff.wait().await;
        }
    }

    async fn subscribe(&mut self) -> Result<(), Status> {
        let position = *self.position.borrow();
        let request =
            v1::SubscribeRequest { namespace: self.namespace.0.to_vec().into(), position, ..Default::default() };
        let mut stream = self.cache.subscribe(request).await?.into_inner();
        while let Some(response) = stream.message().await? {
            let Some(batch) = response.batch else { continue };
            self.received.fetch_add(batch.records.len() as u64, Ordering::Relaxed);
            let replica = self.replica.clone();
            // Off the runtime: checking takes CPU time, and others hold the lock while they copy.
            let applied = tokio::task::spawn_blocking(move || lock(&replica).apply(response.position, &batch));
            let applied = applied.await.map_err(|e| Status::internal(e.to_string()))?;
            let position = applied.map_err(|e| {
                warn!("{e}");
                Status::internal(e.to_string())
            })?;
            self.position.send_replace(position);
        }
        Ok(())
    }
}

/// Inserts records, each tag's in batches, and waits until the server keeps them. Says how many bytes of
/// records it sent. Repeating it is harmless.
///
/// # Errors
/// The server's.
pub async fn insert(cache: &mut Cache, namespace: &Namespace, records: &[(Tag, Irradiance)]) -> Result<u64, Status> {
    let mut batches = Vec::new();
    for run in records.chunk_by(|a, b| a.0 == b.0) {
        for part in run.chunks(convert::BATCH_RECORDS_MAX) {
            let batch = convert::pack(namespace, part[0].0, part.iter().map(|(_, r)| r));
            batches.push(v1::InsertRequest { batch: Some(batch) });
        }
    }
    let bytes = batches.iter().flat_map(|b| &b.batch).map(|b| b.records.len() as u64).sum();
    cache.insert(tokio_stream::iter(batches)).await?;
    Ok(bytes)
}
