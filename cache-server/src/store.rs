//! The replica shared between tasks, and the one task that writes to it: journal first, then memory, then the
//! acknowledgement.
//!
//! Entries wait in a bounded queue; whatever stands there when the journal is free is made durable together. The
//! replica's lock is held for the time of one entry at most and never across an await.

use std::collections::BTreeMap;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard};

use cache_core::Namespace;
use cache_proto::convert::{self, Checked};
use cache_proto::v1::entry::Entry as Kind;
use cache_proto::v1::{Entry, Label, Publication, RecordBatch};
use tokio::sync::{mpsc, oneshot};

use crate::bell::Bell;
use crate::clock::Clock;
use crate::journal::Journal;
use crate::limits::Limits;
use crate::metrics;
use crate::refusal::Refusal;
use crate::replica::{Added, Mark, Replica};

/// Most entries that wait to be written; whoever brings more waits. An entry has at most half a megabyte.
const QUEUE_MAX: usize = 64;

/// Most entries made durable together.
const GROUP_MAX: usize = 64;

/// Everything the server keeps.
pub struct Store {
    shared: Arc<Shared>,
    queue: mpsc::Sender<Pending>,
    subscribers: AtomicU64,
    subscribers_max: usize,
}

#[derive(Debug)]
struct Shared {
    replica: RwLock<Replica>,
    grown: Bell,
    /// The journal did not take the last group.
    failing: AtomicBool,
}

/// An entry on its way, and whom to tell.
struct Pending {
    entry: Entry,
    checked: Checked,
    /// Whose batch or label it is; publications are the server's own.
    tenant: Option<String>,
    kept: oneshot::Sender<Result<Added, Refusal>>,
}

/// An entry that waits to be kept.
pub struct Keeping(oneshot::Receiver<Result<Added, Refusal>>);

impl Keeping {
    /// Waits until it is durable and can be read by others. It then may be acknowledged.
    ///
    /// # Errors
    /// [`Refusal::Full`], [`Refusal::Foreign`] or [`Refusal::Journal`]; nothing of the entry is used then.
    /// [`Refusal::Closing`].
    pub async fn kept(self) -> Result<Added, Refusal> {
        self.0.await.unwrap_or(Err(Refusal::Closing))
    }
}

impl Store {
    /// A store that begins with what the journal kept, and its writer, to be run for as long as the store lives.
    ///
    /// # Errors
    /// When the journal cannot be read, holds an unsound entry, or more than the limits allow.
    pub fn open(limits: Limits, mut journal: Box<dyn Journal>) -> io::Result<(Self, Writer)> {
        let mut replica = Replica::new(limits);
        journal.replay(&mut |entry| {
            let checked = convert::entry(&entry).map_err(io::Error::other)?;
            replica.apply(checked).map(drop).map_err(io::Error::other)
        })?;
        let shared =
            Arc::new(Shared { replica: RwLock::new(replica), grown: Bell::default(), failing: AtomicBool::new(false) });
        let (queue, waiting) = mpsc::channel(QUEUE_MAX);
        let writer = Writer { journal: Some(journal), waiting, shared: shared.clone() };
        Ok((Self { shared, queue, subscribers: AtomicU64::new(0), subscribers_max: limits.subscribers }, writer))
    }

    /// Checks a batch a tenant sent and queues it; waits while the queue is full. The first batch of a namespace makes it
    /// the tenant's.
    ///
    /// # Errors
    /// What is unsound about the batch, or [`Refusal::Foreign`].
    pub async fn insert(&self, tenant: &str, batch: RecordBatch) -> Result<Keeping, Refusal> {
        let entry = Entry { entry: Some(Kind::Batch(batch)) };
        let checked = convert::entry(&entry)?;
        if let Checked::Batch(namespace, ..) = &checked {
            self.claim(tenant, namespace).await?;
        }
        self.queue(entry, checked, Some(tenant.into())).await
    }

    /// Makes a namespace a tenant's, unless it belongs to somebody. Nobody's namespaces need no label for that.
    async fn claim(&self, tenant: &str, namespace: &Namespace) -> Result<(), Refusal> {
        self.replica().belongs(namespace, tenant)?;
        if tenant.is_empty() || self.replica().is_known(namespace) {
            return Ok(());
        }
        let label = Label { namespace: namespace.0.to_vec().into(), owner: tenant.into(), ..Default::default() };
        self.label(label).await
    }

    /// Says what a namespace is, unless that is known.
    ///
    /// # Errors
    /// As [`Keeping::kept`].
    pub async fn label(&self, label: Label) -> Result<(), Refusal> {
        let namespace = convert::namespace(&label.namespace)?;
        if self.replica().label_of(&namespace).is_some() {
            return Ok(());
        }
        self.keep(Kind::Label(label)).await.map(drop)
    }

    /// A draft's records belong to a namespace from now on.
    ///
    /// # Errors
    /// As [`Keeping::kept`].
    pub async fn publish(&self, draft: Namespace, namespace: Namespace) -> Result<(), Refusal> {
        let (draft, namespace) = (draft.0.to_vec().into(), namespace.0.to_vec().into());
        self.keep(Kind::Publication(Publication { draft, namespace })).await.map(drop)
    }

    async fn keep(&self, entry: Kind) -> Result<Added, Refusal> {
        let entry = Entry { entry: Some(entry) };
        let checked = convert::entry(&entry)?;
        let tenant = if let Checked::Label(_, _, label) = &checked { Some(label.owner.clone()) } else { None };
        self.queue(entry, checked, tenant).await?.kept().await
    }

    async fn queue(&self, entry: Entry, checked: Checked, tenant: Option<String>) -> Result<Keeping, Refusal> {
        let (kept, keeping) = oneshot::channel();
        let pending = Pending { entry, checked, tenant, kept };
        self.queue.send(pending).await.map_err(|_| Refusal::Closing)?;
        Ok(Keeping(keeping))
    }

    /// The replica, to read from: for a short time, not across an await.
    pub fn replica(&self) -> RwLockReadGuard<'_, Replica> {
        self.shared.replica.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// A frame begins to fill a draft.
    pub fn hold(&self, draft: Namespace) {
        self.shared.write(|replica| replica.hold(draft));
    }

    /// A frame that filled a draft has ended.
    pub fn release(&self, draft: &Namespace) {
        self.shared.write(|replica| replica.release(draft));
    }

    /// Where a namespace's log stands now.
    pub fn mark(&self, namespace: &Namespace) -> Mark {
        self.replica().mark(namespace)
    }

    /// Rung after each entry.
    pub fn grown(&self) -> &Bell {
        &self.shared.grown
    }

    /// Whether the journal takes what is brought, as far as is known.
    pub fn works(&self) -> bool {
        !self.shared.failing.load(Ordering::Relaxed)
    }

    /// How many subscriptions are open.
    pub fn subscribers(&self) -> u64 {
        self.subscribers.load(Ordering::Relaxed)
    }

    /// Counts one subscription for as long as the result lives.
    ///
    /// # Errors
    /// [`Refusal::Full`].
    pub fn count_subscriber(self: &Arc<Self>) -> Result<Counted, Refusal> {
        let before = self.subscribers.fetch_add(1, Ordering::Relaxed);
        let (counted, most) = (Counted(self.clone()), self.subscribers_max);
        if before >= most as u64 { Err(Refusal::Full { what: "subscribers", most }) } else { Ok(counted) }
    }
}

impl Shared {
    fn write<T>(&self, change: impl FnOnce(&mut Replica) -> T) -> T {
        change(&mut self.replica.write().unwrap_or_else(PoisonError::into_inner))
    }

    /// Shows what is durable, and acknowledges it.
    fn show(&self, group: Group) {
        for pending in group.pending {
            let kept = self.write(|replica| replica.apply(pending.checked));
            self.grown.ring();
            // Who does not wait for the answer any more will ask again.
            drop(pending.kept.send(kept));
        }
    }
}

impl Group {
    /// Tells that it is not kept.
    fn refuse(self, error: &io::Error) {
        for pending in self.pending {
            let refusal = Refusal::Journal(io::Error::new(error.kind(), error.to_string()));
            drop(pending.kept.send(Err(refusal)));
        }
    }
}

/// The only task that changes what the store keeps.
pub struct Writer {
    /// Away while it works on another thread.
    journal: Option<Box<dyn Journal>>,
    waiting: mpsc::Receiver<Pending>,
    shared: Arc<Shared>,
}

/// Entries that are made durable together, then shown.
#[derive(Default)]
struct Group {
    pending: Vec<Pending>,
    /// Records of its batches.
    records: usize,
    /// Whose the namespaces are that it names.
    owners: BTreeMap<Namespace, String>,
}

impl Writer {
    /// Writes until the store is dropped: while one group is made durable, the one before it is shown.
    pub async fn run(mut self) {
        let (mut durable, mut waiting) = (Group::default(), Vec::new());
        loop {
            if durable.pending.is_empty() {
                if self.waiting.recv_many(&mut waiting, GROUP_MAX).await == 0 {
                    return;
                }
            } else {
                let more = std::iter::from_fn(|| self.waiting.try_recv().ok());
                waiting.extend(more.take(GROUP_MAX));
            }
            let group = self.admitted(waiting.drain(..), &durable);
            let shared = self.shared.clone();
            let appending = self.append(group.pending.iter().map(|pending| pending.entry.clone()).collect());
            let (appended, ()) = tokio::join!(biased; appending, async { shared.show(std::mem::take(&mut durable)) });
            match appended {
                Ok(()) => durable = group,
                Err(error) => group.refuse(&error),
            }
        }
    }

    /// Those whose namespaces are their tenants', and that there is room for, should all of their records be new.
    ///
    /// Who asked before may have been overtaken: whose a namespace is, the first here decides. `before` is as good as
    /// shown.
    fn admitted(&self, waiting: impl Iterator<Item = Pending>, before: &Group) -> Group {
        let mut group = Group::default();
        for pending in waiting {
            let named = match (&pending.checked, &pending.tenant) {
                (Checked::Batch(namespace, _, records), Some(tenant)) => Some((namespace, tenant, records.len())),
                (Checked::Label(namespace, ..), Some(tenant)) => Some((namespace, tenant, 0)),
                _ => None,
            };
            let admit = |replica: &mut Replica| {
                let Some((namespace, tenant, records)) = named else { return Ok(()) };
                replica.belongs(namespace, tenant)?;
                let owners = &mut group.owners;
                let owner = before.owners.get(namespace).unwrap_or(owners.entry(*namespace).or_insert(tenant.clone()));
                if owner != tenant {
                    return Err(Refusal::Foreign(*namespace));
                }
                replica.admit(namespace, before.records + group.records + records)?;
                group.records += records;
                Ok(())
            };
            match self.shared.write(admit) {
                Ok(()) => group.pending.push(pending),
                Err(refusal) => drop(pending.kept.send(Err(refusal))),
            }
        }
        group
    }

    async fn append(&mut self, entries: Vec<Entry>) -> io::Result<()> {
        if entries.is_empty() {
            return Ok(());
        }
        let (count, clock) = (entries.len(), Clock::start());
        let appended = self.append_now(entries).await;
        self.shared.failing.store(appended.is_err(), Ordering::Relaxed);
        match &appended {
            Ok(()) => metrics::appended(count, clock.now()),
            Err(error) => {
                tracing::error!(%error, "the journal failed");
                metrics::append_failed();
            }
        }
        appended
    }

    async fn append_now(&mut self, entries: Vec<Entry>) -> io::Result<()> {
        let lost = || io::Error::other("it is gone; see the log");
        let mut journal = self.journal.take().ok_or_else(lost)?;
        if !journal.waits() {
            let appended = journal.append(&entries);
            self.journal = Some(journal);
            return appended;
        }
        let work = tokio::task::spawn_blocking(move || {
            let appended = journal.append(&entries);
            (journal, appended)
        });
        let (journal, appended) = work.await.map_err(|panic| io::Error::other(panic.to_string()))?;
        self.journal = Some(journal);
        appended
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

#[cfg(test)]
mod tests {
    use cache_core::{Irradiance, RecordId, Tag};
    use glam::{Vec2, Vec3};

    use super::*;
    use crate::journal::Nowhere;

    fn batch(id: u128) -> RecordBatch {
        let record = Irradiance {
            id: RecordId(id),
            position: Vec3::ZERO,
            normal: Vec3::Z,
            radius: 1.0,
            radius_min: 0.1,
            radius_max: 10.0,
            irradiance: Vec3::ONE,
            gradient_t: [Vec2::ZERO; 3],
            gradient_r: [Vec2::ZERO; 3],
            ellipse: [0.0; 3],
            noise: 0.0,
        };
        convert::pack(&Namespace([7; 32]), Tag::level(1), [&record])
    }

    /// Both ask before either is heard; "a" would be the smaller label, "b" comes first.
    #[tokio::test]
    async fn of_two_tenants_that_begin_a_namespace_at_once_one_is_refused() {
        let (store, writer) = Store::open(Limits::default(), Box::new(Nowhere)).expect("nothing to read");
        let insert = async |tenant: &'static str, id| store.insert(tenant, batch(id)).await?.kept().await;
        let (first, second) = tokio::select! {
            biased;
            both = async { tokio::join!(insert("b", 1), insert("a", 2)) } => both,
            () = writer.run() => panic!("the store lives"),
        };
        assert_eq!(first.map(|added| added.added).map_err(|refusal| refusal.to_string()), Ok(1));
        assert!(matches!(second, Err(Refusal::Foreign(_))));
        assert_eq!(store.mark(&Namespace([7; 32])).sum.records, 1);
        assert!(store.replica().belongs(&Namespace([7; 32]), "b").is_ok());
    }
}
