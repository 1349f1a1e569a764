//! Frames made ready: the job of each, the logs it follows, and its sealed caches.

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::{Arc, Mutex, Weak};

use cache_core::Namespace;
use cache_core::id::Digest;
use cache_proto::{convert, v1};
use tokio::sync::OnceCell;
use tonic::{Code, Status};
use tracing::warn;

use crate::caches::Caches;
use crate::client::Cache;
use crate::follow::Follower;
use crate::job::{Dropped, Job, Known};
use crate::levels::Levels;
use crate::replica::{Part, ReplicaError};
use crate::scenes::Scenes;
use crate::task::CpuClock;
use crate::threads::{lock, off_thread};

/// Frames kept ready, the last used ones.
const FRAMES_KEPT: usize = 4;

/// Why a lease did not come to its end.
#[derive(Debug)]
pub enum Fault {
    /// It is no longer ours, or its frame is gone.
    Gone,
    /// This worker cannot do the frame, and why.
    Unfit(String),
    /// Nobody can do the frame, and why.
    Hopeless(String),
    /// The server.
    Server(Status),
}

impl From<Status> for Fault {
    fn from(status: Status) -> Self {
        if status.code() == Code::NotFound { Self::Gone } else { Self::Server(status) }
    }
}

/// A frame made ready.
pub struct Ready<J> {
    /// What computes it.
    pub job: Arc<J>,
    /// Where its records go.
    pub draft: Namespace,
    /// Absent for methods without records.
    records: Option<Arc<Records>>,
}

/// The records a frame reads.
struct Records {
    draft: Arc<Follower>,
    /// Absent when the frame reads nothing but its own.
    base: Option<Base>,
    caches: Mutex<Caches>,
}

struct Base {
    follower: Arc<Follower>,
    position: u64,
    digest: Digest,
}

impl<J: Job> Ready<J> {
    /// The sealed records that a step reads, once they have arrived, and the CPU seconds this took.
    ///
    /// # Errors
    /// As in [`Fault`].
    pub async fn levels(&self, step: &v1::Step, dropped: &Dropped) -> Result<(Levels, f64), Fault> {
        let Some(records) = &self.records else { return Ok((Levels::new(), 0.0)) };
        let (position, index) = (step.sealed_position, step.index);
        let digest = convert::digest(&step.sealed_digest).map_err(|e| Fault::Unfit(e.to_string()))?;
        let mut left: Vec<Arc<Follower>> = Vec::new();
        loop {
            let base = records.base.as_ref().map(|base| (&base.follower, base.position));
            for (log, position) in base.into_iter().chain([(&records.draft, position)]) {
                if !log.reaches(position, dropped).await? {
                    return Err(Fault::Gone);
                }
            }
            let sealing = records.clone();
            match off_thread(move || sealing.seal(position, index, digest)).await.map_err(Fault::Unfit)? {
                Ok(sealed) => return Ok(sealed),
                Err((ReplicaError::Outdated { .. }, _)) => return Err(Fault::Gone),
                // Set aside meanwhile.
                Err((ReplicaError::Behind { .. }, _)) => {}
                // The server may have come back with another log than the one followed so far.
                Err((e @ ReplicaError::Digest { epoch, .. }, log)) if !left.iter().any(|l| Arc::ptr_eq(l, &log)) => {
                    warn!("{e}; following the server's log from its beginning");
                    log.leave(epoch);
                    left.push(log);
                }
                Err((e, _)) => return Err(Fault::Unfit(e.to_string())),
            }
        }
    }

    /// Finds what was gathered under the draft before.
    pub fn known(&self) -> Known {
        match self.records.clone() {
            Some(records) => Arc::new(move |id| records.draft.known(id)),
            None => Arc::new(|_| None),
        }
    }

    /// Bytes of records received since the last call.
    pub fn take_received(&self) -> u64 {
        let records = self.records.iter();
        let logs = records.flat_map(|r| [Some(&r.draft), r.base.as_ref().map(|base| &base.follower)]);
        logs.flatten().map(|log| log.take_received()).sum()
    }
}

impl Records {
    /// The caches of a step and the CPU seconds of sealing them, or what is wrong with which log.
    fn seal(&self, position: u64, step: u32, digest: Digest) -> Result<(Levels, f64), (ReplicaError, Arc<Follower>)> {
        let clock = CpuClock::start();
        let mut caches = lock(&self.caches);
        let of_draft = |e| (e, self.draft.clone());
        let part = self.draft.read(|log| log.part(caches.mark(), position, step)).map_err(of_draft)?;
        if part.anew {
            match &self.base {
                Some(Base { follower, position, digest }) => {
                    let base = follower.read(|log| log.prefix(*position));
                    base.and_then(|base| caches.begin(&base, *digest)).map_err(|e| (e, follower.clone()))?;
                }
                None => caches.begin(&Part::default(), Digest::default()).map_err(of_draft)?,
            }
        }
        let levels = caches.extend(&part, digest).map_err(of_draft)?;
        Ok((levels, clock.seconds()))
    }
}

type Slot<J> = Arc<OnceCell<Arc<Ready<J>>>>;

/// The frames a worker keeps ready. A log is followed as long as one of them, or a lease, reads it.
pub struct Shelf<J> {
    cache: Cache,
    scenes: Scenes,
    /// Last used last.
    frames: Mutex<Vec<(u64, Slot<J>)>>,
    logs: Mutex<BTreeMap<Namespace, Weak<Follower>>>,
}

impl<J: Job> Shelf<J> {
    /// An empty one, for frames of the server that both are connected to.
    pub fn new(cache: Cache, scenes: Scenes) -> Self {
        Self { cache, scenes, frames: Mutex::default(), logs: Mutex::default() }
    }

    /// A frame made ready, once, whoever asks first.
    ///
    /// # Errors
    /// As in [`Fault`], or what `describe` failed with.
    pub async fn frame<D>(&self, id: u64, describe: impl FnOnce() -> D) -> Result<Arc<Ready<J>>, Fault>
    where
        D: Future<Output = Result<v1::DescribeResponse, Status>>,
    {
        let slot = {
            let mut frames = lock(&self.frames);
            let slot = match frames.iter().position(|(known, _)| *known == id) {
                Some(at) => frames.remove(at).1,
                None => Slot::default(),
            };
            frames.push((id, slot.clone()));
            if frames.len() > FRAMES_KEPT {
                frames.remove(0);
            }
            slot
        };
        slot.get_or_try_init(async || self.prepare(id, describe().await?).await).await.cloned()
    }

    async fn prepare(&self, frame: u64, described: v1::DescribeResponse) -> Result<Arc<Ready<J>>, Fault> {
        let unfit = |e: convert::Malformed| Fault::Unfit(e.to_string());
        let draft = convert::namespace(&described.draft).map_err(unfit)?;
        let job = J::prepare(frame, &described, &self.scenes).await.map_err(Fault::Unfit)?;
        if job.levels() == 0 {
            return Ok(Arc::new(Ready { job: Arc::new(job), draft, records: None }));
        }
        let base = match (&described.spec, described.base_position) {
            (Some(spec), position @ 1..) => Some(Base {
                follower: self.follow(convert::namespace(&spec.namespace).map_err(unfit)?),
                position,
                digest: convert::digest(&described.base_digest).map_err(unfit)?,
            }),
            _ => None,
        };
        let caches = Mutex::new(Caches::new(job.a(), job.levels()));
        let records = Some(Arc::new(Records { draft: self.follow(draft), base, caches }));
        Ok(Arc::new(Ready { job: Arc::new(job), draft, records }))
    }

    fn follow(&self, namespace: Namespace) -> Arc<Follower> {
        let mut logs = lock(&self.logs);
        logs.retain(|_, log| log.strong_count() > 0);
        if let Some(log) = logs.get(&namespace).and_then(Weak::upgrade) {
            return log;
        }
        let log = Arc::new(Follower::start(self.cache.clone(), namespace));
        logs.insert(namespace, Arc::downgrade(&log));
        log
    }
}
