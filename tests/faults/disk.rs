//! A disk that outlives the server on it.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard};

use cache_core::id::{Digest, Random};
use cache_core::{Namespace, Record, Tag};
use cache_proto::v1::Entry;
use cache_server::Limits;
use cache_server::journal::Journal;
use cache_server::replica::Replica;

use crate::events;

/// A journal in memory. What was appended stays when its server crashes, until the disk itself is lost.
#[derive(Clone)]
pub struct Disk(Arc<Mutex<Inner>>);

struct Inner {
    entries: Vec<Entry>,
    full: bool,
    /// How often all that was on it was lost.
    losses: u32,
    random: Random,
}

impl Disk {
    /// An empty disk, whose failures are drawn from the seed.
    pub fn new(seed: u64) -> Self {
        let random = Random::named("disk", &[seed]);
        Self(Arc::new(Mutex::new(Inner { entries: Vec::new(), full: false, losses: 0, random })))
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().expect("nothing panics under it")
    }

    /// Loses all that is on it.
    pub fn lose(&self) {
        let mut disk = self.lock();
        disk.entries.clear();
        disk.losses += 1;
    }

    /// How often all that was on it was lost.
    pub fn losses(&self) -> u32 {
        self.lock().losses
    }

    /// Whether it takes no more from now on.
    pub fn fill(&self, full: bool) {
        self.lock().full = full;
    }

    /// What a server started on it now would hold.
    pub fn replica(&self) -> Replica {
        let mut replica = Replica::new(Limits::default());
        for entry in &self.lock().entries {
            let checked = cache_proto::convert::entry(entry).expect("only sound entries are appended");
            replica.apply(checked).expect("there is room");
        }
        replica
    }

    /// The beginning of a namespace's log whose records have this digest.
    pub fn prefix(&self, namespace: &Namespace, digest: Digest) -> Option<Vec<(Tag, Record)>> {
        let replica = self.replica();
        let end = replica.find(namespace, digest)?.position as usize;
        let log = replica.since(namespace, 0).ok()?;
        Some(log[..end].to_vec())
    }
}

impl Journal for Disk {
    fn append(&mut self, entries: &[Entry]) -> io::Result<()> {
        let mut disk = self.lock();
        if disk.full {
            // Some of it may be there all the same.
            let kept = (disk.random.uniform() * (entries.len() + 1) as f32) as usize;
            disk.entries.extend_from_slice(&entries[..kept]);
            events::note("disk", format_args!("full: {kept} of {} entries kept", entries.len()));
            return Err(io::ErrorKind::StorageFull.into());
        }
        disk.entries.extend_from_slice(entries);
        events::note("disk", format_args!("{} entries", entries.len()));
        Ok(())
    }

    fn replay(&mut self, each: &mut dyn FnMut(Entry) -> io::Result<()>) -> io::Result<()> {
        let entries = self.lock().entries.clone();
        entries.into_iter().try_for_each(each)
    }

    fn waits(&self) -> bool {
        false
    }
}
