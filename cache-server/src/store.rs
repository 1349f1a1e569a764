//! The replica shared between tasks, with its journal and the bell that tells of growth.
//!
//! Locks are held for the time of one batch at most and never across an await. Order where both are taken: journal,
//! replica.

use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard};

use cache_core::{Irradiance, Namespace};
use cache_proto::v1::entry::Entry as Kind;
use cache_proto::{convert, v1};

use crate::bell::Bell;
use crate::journal::Journal;
use crate::refusal::Refusal;
use crate::replica::{Added, Limits, Mark, Replica};

/// Everything the server keeps.
pub struct Store {
    journal: Mutex<Box<dyn Journal>>,
    replica: RwLock<Replica>,
    grown: Bell,
    subscribers: AtomicU64,
}

impl Store {
    /// A store that begins with what the journal kept.
    ///
    /// # Errors
    /// When the journal cannot be read, holds an unsound batch, or more than the limits allow.
    pub fn open(limits: Limits, mut journal: Box<dyn Journal>) -> io::Result<Self> {
        let mut replica = Replica::new(limits);
        journal.replay(&mut |entry| {
            let Some(Kind::Batch(batch)) = entry.entry else { return Ok(()) };
            let (namespace, tag, records) = convert::unpack(&batch).map_err(io::Error::other)?;
            replica.insert(namespace, tag, &records).map(drop).map_err(io::Error::other)
        })?;
        Ok(Self {
            journal: Mutex::new(journal),
            replica: RwLock::new(replica),
            grown: Bell::default(),
            subscribers: AtomicU64::new(0),
        })
    }

    /// Checks, keeps and shows one batch. When it returns the batch may be acknowledged.
    ///
    /// # Errors
    /// What is unsound about the batch, [`Refusal::Full`] or [`Refusal::Journal`]; nothing of it is used then.
    pub fn insert(&self, batch: &v1::RecordBatch) -> Result<Added, Refusal> {
        let (namespace, tag, records) = convert::unpack::<Irradiance>(batch)?;
        // The journal's lock spans both steps: the journal has the order of the log, and the limit checked is the
        // limit met.
        let mut journal = lock(&self.journal);
        self.replica().admit(&namespace, records.len())?;
        journal.append(&[v1::Entry { entry: Some(Kind::Batch(batch.clone())) }])?;
        let added = {
            let mut replica = self.replica.write().unwrap_or_else(PoisonError::into_inner);
            replica.insert(namespace, tag, &records)?
        };
        drop(journal);
        self.grown.ring();
        Ok(added)
    }

    /// The replica, to read from: for the time of one batch, not across an await.
    pub fn replica(&self) -> RwLockReadGuard<'_, Replica> {
        self.replica.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Where a namespace's log stands now.
    pub fn mark(&self, namespace: &Namespace) -> Mark {
        self.replica().mark(namespace)
    }

    /// Rung after each insert.
    pub fn grown(&self) -> &Bell {
        &self.grown
    }

    /// How many subscriptions are open.
    pub fn subscribers(&self) -> u64 {
        self.subscribers.load(Ordering::Relaxed)
    }

    /// Counts one subscription for as long as the result lives.
    pub fn count_subscriber(self: &Arc<Self>) -> Counted {
        self.subscribers.fetch_add(1, Ordering::Relaxed);
        Counted(self.clone())
    }
}

/// One open subscription.
pub struct Counted(Arc<Store>);

impl Counted {
    /// The store subscribed to.
    pub fn store(&self) -> &Store {
        &self.0
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.subscribers.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Locks, whether or not another holder panicked: every change under these locks is whole before anything can panic.
pub(crate) fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
