//! All frames and workers: who gets which lease, and when it is lost. No I/O; time and the state of the record sets are
//! passed in, so that a test or a simulator decides both.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use cache_core::Namespace;
use cache_proto::v1;

use crate::access::Tenant;
use crate::frame::{Frame, News, Origin};
use crate::limits::Limits;
use crate::metrics;
use crate::refusal::Refusal;
use crate::replica::Mark;
use crate::round::Round;
use crate::spec::Job;

/// A lease that is neither completed nor renewed for this long is given to somebody else.
pub const LEASE_TIME: Duration = Duration::from_secs(6);

/// A worker not heard of for this long is forgotten. Longer than it may wait for a lease without a word.
pub const WORKER_TIME: Duration = Duration::from_secs(15);

/// Who has to be woken after a change.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Changes {
    /// There may be work where there was none: workers that wait for a lease.
    pub work: bool,
    /// There may be something to tell: owners of frames.
    pub news: bool,
    /// The draft of a frame that makes records is whole and is to be published.
    pub filled: Option<Filled>,
}

/// A frame whose records are all there.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Filled {
    /// Which.
    pub frame: u64,
    /// Where its records are.
    pub draft: Namespace,
    /// Where they belong.
    pub namespace: Namespace,
}

/// Every open frame, and every worker heard of lately.
#[derive(Debug)]
pub struct Frames {
    limits: Limits,
    /// Oldest first, because numbers count up.
    frames: BTreeMap<u64, Frame>,
    /// When each worker was last heard of.
    workers: BTreeMap<Arc<str>, Heard>,
    next: u64,
    changes: Changes,
}

/// When a worker was heard of last, and how many leases it works on at a time.
#[derive(Clone, Copy, Debug)]
struct Heard {
    at: Duration,
    threads: u32,
}

/// Tells the state of a draft, as far as the steps before the given one gathered it.
pub trait Marks: FnOnce(&Namespace, u32) -> Mark {}

impl<F: FnOnce(&Namespace, u32) -> Mark> Marks for F {}

impl Frames {
    /// No frames yet; numbers of frames and leases count up from `first`. A server that restarts should begin
    /// elsewhere, or a worker that lived on could complete a lease it was never given.
    pub fn new(limits: Limits, first: u64) -> Self {
        Self { limits, frames: BTreeMap::new(), workers: BTreeMap::new(), next: first, changes: Changes::default() }
    }

    /// Opens a frame. Returns its number.
    ///
    /// # Errors
    /// [`Refusal::Full`].
    pub fn open(&mut self, job: Job, origin: Origin, mark: impl Marks) -> Result<u64, Refusal> {
        let most = self.limits.frames;
        if self.frames.len() >= most {
            return Err(Refusal::Full { what: "frames", most });
        }
        let (id, draft) = (self.number(), origin.draft);
        self.frames.insert(id, Frame::new(id, job, origin, |step| mark(&draft, step)));
        (self.changes.work, self.changes.news) = (true, true);
        Ok(id)
    }

    /// Cancels a frame or forgets a finished one: leases are revoked, memory is freed.
    pub fn close(&mut self, frame: u64) {
        self.frames.remove(&frame);
    }

    /// A tenant's frame.
    ///
    /// # Errors
    /// [`Refusal::NoFrame`].
    pub fn frame(&self, tenant: &Tenant, frame: u64) -> Result<&Frame, Refusal> {
        let own = self.frames.get(&frame).filter(|frame| frame.origin().tenant == *tenant);
        own.ok_or(Refusal::NoFrame(frame))
    }

    /// Work for a thread of a tenant's worker that has so many (0 counts as 1), from the oldest frame that has some. `None`: nothing now, ask again after the next
    /// change.
    ///
    /// # Errors
    /// [`Refusal::Full`] when there are too many workers, or this one holds too many leases.
    pub fn lease(
        &mut self,
        tenant: &Tenant,
        worker: &str,
        threads: u32,
        now: Duration,
    ) -> Result<Option<v1::Lease>, Refusal> {
        let worker = self.hear(worker, now)?;
        let threads = threads.clamp(1, self.limits.leases as u32);
        self.workers.entry(worker.clone()).and_modify(|heard| heard.threads = threads);
        if self.frames.values().map(|frame| frame.held_by(&worker)).sum::<usize>() >= self.limits.leases {
            return Err(Refusal::Full { what: "leases of one worker", most: self.limits.leases });
        }
        let number = self.number();
        let all = self.workers.values().map(|heard| heard.threads).fold(0, u32::saturating_add);
        let threads = |worker: &Arc<str>| self.workers.get(worker).map_or(0, |heard| heard.threads);
        let mut own = self.frames.values_mut().filter(|frame| frame.origin().tenant == *tenant);
        let lease = own.find_map(|frame| {
            let unfit = frame.unfit().map(threads).fold(0, u32::saturating_add);
            frame.lease(number, &worker, all.saturating_sub(unfit).max(1), now)
        });
        if lease.is_some() {
            metrics::leased();
        }
        Ok(lease)
    }

    /// A worker says that it lives: the leases it names get a new deadline. Returns the leases it still holds.
    pub fn renew(&mut self, worker: &str, leases: &BTreeSet<u64>, now: Duration) -> Vec<u64> {
        if let Some(heard) = self.workers.get_mut(worker) {
            heard.at = now;
        }
        self.frames.values_mut().flat_map(|frame| frame.renew(worker, leases, now + LEASE_TIME)).collect()
    }

    /// Ends a lease. False when it was lost before, or completed: nothing of the request is used then.
    ///
    /// # Errors
    /// What is unsound about the request; the worker keeps the lease then.
    pub fn complete(&mut self, request: v1::CompleteRequest, now: Duration, mark: impl Marks) -> Result<bool, Refusal> {
        if let Some(heard) = self.workers.get_mut(request.worker.as_str()) {
            heard.at = now;
        }
        let Some(frame) = self.frames.get_mut(&request.frame) else { return Ok(false) };
        let (number, draft) = (request.frame, frame.origin().draft);
        let (step, had_work) = (frame.round().map(|round| round.step().index), frame.has_work());
        let since = frame.round().and_then(|round| round.held(request.lease, &request.worker)).map(|held| held.since);
        let accepted = frame.complete(request, now, |step| mark(&draft, step))?;
        self.changes.news |= accepted;
        if let Some(since) = since.filter(|_| accepted) {
            metrics::completed(now.saturating_sub(since));
        }
        // A lease of pixels that brought less than the most a tile can have leaves room for others.
        let pixels = frame.round().is_some_and(|round| round.makes_pixels());
        let advanced = step != frame.round().map(|round| round.step().index);
        self.changes.work |= frame.has_work() && (!had_work || advanced);
        if accepted && pixels && advanced && frame.job().spec.levels > 0 {
            self.changes.filled = Some(Filled { frame: number, draft, namespace: frame.job().namespace });
        }
        Ok(accepted)
    }

    /// A frame that was filled is published, or will not be: its owner may be told that it is done.
    pub fn published(&mut self, frame: u64) {
        if let Some(frame) = self.frames.get_mut(&frame) {
            frame.published();
            self.changes.news = true;
        }
    }

    /// Whether a frame is open.
    pub fn is_open(&self, frame: u64) -> bool {
        self.frames.contains_key(&frame)
    }

    /// A worker cannot do a frame, and says why: it gets no more of it, the owner is told.
    ///
    /// # Errors
    /// [`Refusal::NoFrame`], or [`Refusal::Full`] when there are too many workers.
    pub fn decline(&mut self, request: v1::DeclineRequest, now: Duration) -> Result<(), Refusal> {
        let v1::DeclineRequest { worker, frame, reason, for_all } = request;
        if !self.frames.contains_key(&frame) {
            return Err(Refusal::NoFrame(frame));
        }
        let worker = self.hear(&worker, now)?;
        if let Some(frame) = self.frames.get_mut(&frame) {
            frame.decline(worker, reason, for_all);
        }
        (self.changes.work, self.changes.news) = (true, true);
        Ok(())
    }

    /// A worker lacks the scene of an open frame: its owner is asked for it.
    pub fn want_scene(&mut self, frame: u64) {
        if let Some(frame) = self.frames.get_mut(&frame) {
            frame.want_scene();
            self.changes.news = true;
        }
    }

    /// Gives back everything a worker holds, and forgets it.
    pub fn leave(&mut self, worker: &str) {
        if self.workers.remove(worker).is_none() {
            return;
        }
        for frame in self.frames.values_mut() {
            self.changes.work |= frame.lose(|held| &*held.worker == worker);
            frame.forget(worker);
        }
    }

    /// Takes back every lease whose deadline has come, and forgets workers that are silent. To be called a few times a
    /// second; a lease holds until then.
    pub fn tick(&mut self, now: Duration) {
        for frame in self.frames.values_mut() {
            self.changes.work |= frame.lose(|held| held.deadline <= now);
        }
        let frames = &mut self.frames;
        self.workers.retain(|worker, heard| {
            let silent = heard.at + WORKER_TIME <= now;
            if silent {
                // Its leases are lost already: they end sooner than this.
                frames.values_mut().for_each(|frame| frame.forget(worker));
            }
            !silent
        });
    }

    /// What a frame's owner is told next.
    pub fn news(&mut self, frame: u64, mark: impl Marks) -> News {
        let workers = self.workers.len() as u32;
        let Some(frame) = self.frames.get_mut(&frame) else { return News::End };
        let draft = frame.origin().draft;
        let (news, room) = frame.news(workers, |step| mark(&draft, step));
        self.changes.work |= room;
        news
    }

    /// Frames that are open.
    pub fn frames(&self) -> usize {
        self.frames.len()
    }

    /// Workers heard of lately.
    pub fn workers(&self) -> usize {
        self.workers.len()
    }

    /// Leases that are held, and since when the oldest is.
    pub fn leases(&self) -> (usize, Option<Duration>) {
        let held = || self.frames.values().filter_map(Frame::round).flat_map(Round::leases);
        (held().count(), held().map(|held| held.since).min())
    }

    /// What changed since the last call.
    pub fn take_changes(&mut self) -> Changes {
        std::mem::take(&mut self.changes)
    }

    fn number(&mut self) -> u64 {
        let number = self.next;
        self.next += 1;
        number
    }

    fn hear(&mut self, worker: &str, now: Duration) -> Result<Arc<str>, Refusal> {
        let most = self.limits.workers;
        if self.workers.len() >= most && !self.workers.contains_key(worker) {
            return Err(Refusal::Full { what: "workers", most });
        }
        let name = self.workers.get_key_value(worker).map_or_else(|| Arc::from(worker), |(name, _)| name.clone());
        self.workers.entry(name.clone()).or_insert(Heard { at: now, threads: 1 }).at = now;
        Ok(name)
    }
}

#[cfg(test)]
#[path = "frames_tests.rs"]
mod tests;
