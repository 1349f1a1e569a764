//! One frame: its plan, its current round, and what its owner has still to be told. No I/O; time is passed in.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use cache_core::Namespace;
use cache_core::rounds::Plan;
use cache_proto::v1::frame_event::Event;
use cache_proto::{convert, v1};

use crate::access::Tenant;
use crate::expected::Expected;
use crate::frames::LEASE_TIME;
use crate::metrics;
use crate::refusal::Refusal;
use crate::replica::Mark;
use crate::round::{Held, Round};
use crate::spec::{self, Job, PIXEL_BYTES_MAX};

/// Most bytes of finished tiles that wait for the owner or are being made; past it no more pixels are leased.
pub const UNDELIVERED_MAX: usize = 64 << 20;

/// Most bytes of tiles one `Complete` brings, so that it fits a message; one tile always does.
const COMPLETE_BYTES_MAX: usize = 4 << 20;

/// Most reasons of workers that wait for the owner; more are dropped, the first ones say enough.
const DECLINES_MAX: usize = 64;

/// Most bytes of a worker's reason; the rest is cut.
const REASON_MAX: usize = 1024;

/// Most distinct names of counts in one frame.
const COUNTS_MAX: usize = 64;

/// Most machines told apart in one frame.
const HOSTS_MAX: usize = 4096;

/// Longest time one `Complete` may tell of, so that no sum can overflow.
const SECONDS_MAX: f64 = 1e9;

/// What an owner's stream does next.
#[derive(Clone, PartialEq, Debug)]
pub enum News {
    /// Tells this.
    Tell(Box<v1::FrameEvent>),
    /// Waits.
    Wait,
    /// Ends: everything was told.
    End,
}

/// Whose a frame is, and what it reads.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Origin {
    /// Whose.
    pub tenant: Tenant,
    /// The records of its namespace it reads besides its own.
    pub base: Mark,
    /// Where its own records go.
    pub draft: Namespace,
    /// The base ends with what the same view gathered: only pixels are left to be made.
    pub filled: bool,
}

/// One frame.
#[derive(Debug)]
pub struct Frame {
    id: u64,
    job: Job,
    origin: Origin,
    plan: Plan,
    /// The step at work; `None` when all are done.
    round: Option<Round>,
    steps: u32,
    fills: u32,
    leases_lost: u32,
    counts: BTreeMap<String, f64>,
    hosts: BTreeMap<String, v1::HostUse>,
    unfit: BTreeSet<Arc<str>>,
    /// Its records are all there and are not published yet.
    publishing: bool,
    outbox: Outbox,
}

/// What the owner has still to be told. Bounded: one opening, one progress, one question for the scene,
/// [`DECLINES_MAX`] reasons, about [`UNDELIVERED_MAX`] bytes of tiles, one end.
#[derive(Debug, Default)]
struct Outbox {
    opening: bool,
    progress: bool,
    /// A worker lacks the scene.
    scene: bool,
    scene_asked: bool,
    declined: VecDeque<v1::FrameDeclined>,
    tiles: VecDeque<v1::FrameTile>,
    tile_bytes: usize,
    ended: bool,
}

impl Frame {
    /// A frame; `mark` tells the state of its draft, as far as the steps before the given one gathered it.
    pub fn new(id: u64, job: Job, origin: Origin, mark: impl FnOnce(u32) -> Mark) -> Self {
        let levels = if origin.filled { 0 } else { job.spec.levels };
        let mut frame = Self {
            id,
            plan: Plan::new(levels, job.spec.adaptive, u64::from(job.spec.width) * u64::from(job.spec.height)),
            job,
            origin,
            round: None,
            steps: 0,
            fills: 0,
            leases_lost: 0,
            counts: BTreeMap::new(),
            hosts: BTreeMap::new(),
            unfit: BTreeSet::new(),
            publishing: false,
            outbox: Outbox { opening: true, progress: true, ..Outbox::default() },
        };
        frame.advance(0, mark);
        frame
    }

    /// What the frame asks for.
    pub fn job(&self) -> &Job {
        &self.job
    }

    /// Whose it is, and what it reads.
    pub fn origin(&self) -> &Origin {
        &self.origin
    }

    /// The step at work; `None` when all are done.
    pub fn round(&self) -> Option<&Round> {
        self.round.as_ref()
    }

    /// Workers that cannot do it.
    pub fn unfit(&self) -> impl Iterator<Item = &Arc<str>> {
        self.unfit.iter()
    }

    /// Leases tiles to a worker, for one of the `threads` of all that can do the frame. `None` when there is nothing for it
    /// now.
    pub fn lease(&mut self, lease: u64, worker: &Arc<str>, threads: u32, now: Duration) -> Option<v1::Lease> {
        if self.unfit.contains(worker) {
            return None;
        }
        let room = self.room();
        let round = self.round.as_mut()?;
        let tiles = (room > 0).then(|| round.grant(lease, worker.clone(), threads, room, now, now + LEASE_TIME))??;
        let step = Some(round.step().clone());
        Some(v1::Lease { id: lease, frame: self.id, step, tile_from: tiles.start, tile_to: tiles.end })
    }

    /// Whether there is something to lease.
    pub fn has_work(&self) -> bool {
        self.round.as_ref().is_some_and(|round| round.pending_tiles() > 0) && self.room() > 0
    }

    /// Most tiles one lease may have now: what the owner can still take, if they are pixels.
    fn room(&self) -> u32 {
        let Some(round) = self.round.as_ref().filter(|round| round.makes_pixels()) else { return u32::MAX };
        let tile = self.job.tile_bytes_max();
        let taken = self.outbox.tile_bytes.saturating_add(round.leased_tiles() as usize * tile);
        let free = UNDELIVERED_MAX.saturating_sub(taken);
        if free == 0 { 0 } else { (free.min(COMPLETE_BYTES_MAX) / tile).max(1) as u32 }
    }

    /// Moves the deadline of leases a worker names; returns the numbers of those it holds.
    pub fn renew(&mut self, worker: &str, leases: &BTreeSet<u64>, deadline: Duration) -> Vec<u64> {
        let Some(round) = &mut self.round else { return Vec::new() };
        round.renew(worker, leases, deadline);
        round.held_by(worker).collect()
    }

    /// How many leases a worker holds.
    pub fn held_by(&self, worker: &str) -> usize {
        self.round.as_ref().map_or(0, |round| round.held_by(worker).count())
    }

    /// Ends a lease: false when `worker` does not hold it any more, and then nothing of the request is used. `mark`
    /// tells the state of the draft, as far as the steps before the given one gathered it.
    ///
    /// # Errors
    /// What is unsound about the request; the worker keeps the lease then.
    pub fn complete(
        &mut self,
        request: v1::CompleteRequest,
        now: Duration,
        mark: impl FnOnce(u32) -> Mark,
    ) -> Result<bool, Refusal> {
        let Some(round) = &mut self.round else { return Ok(false) };
        let Some(held) = round.held(request.lease, &request.worker) else { return Ok(false) };
        let expected = if round.makes_pixels() { held.tiles.clone() } else { 0..0 };
        check_gathered(request.gathered)?;
        let worked = worked(request.worked_seconds)?;
        check_tiles(&self.job, expected, &request.tiles)?;
        check_counts(&self.counts, &request.counts)?;
        let used = request.used.unwrap_or_default();
        check_used(&used)?;

        round.complete(request.lease, request.gathered, worked, now);
        for count in request.counts {
            *self.counts.entry(count.name).or_default() += count.value;
        }
        add_used(&mut self.hosts, used);
        self.outbox.progress = true;
        self.outbox.tile_bytes += request.tiles.iter().map(|tile| tile.pixels.len()).sum::<usize>();
        self.outbox.tiles.extend(request.tiles);
        if round.is_over() {
            let gathered = round.gathered();
            self.advance(gathered, mark);
            let filled = self.round.as_ref().is_some_and(Round::makes_pixels) && self.job.spec.levels > 0;
            self.publishing |= filled;
        }
        Ok(true)
    }

    /// A worker lacks the scene: the owner is asked for it, once.
    pub fn want_scene(&mut self) {
        self.outbox.scene |= !std::mem::replace(&mut self.outbox.scene_asked, true);
    }

    /// Its records are published, or will not be: who is told that it is done may rely on that.
    pub fn published(&mut self) {
        self.publishing = false;
    }

    fn advance(&mut self, gathered: u64, mark: impl FnOnce(u32) -> Mark) {
        let expected = self.round.take().map_or_else(|| Expected::nothing(self.job.tiles), Round::into_expected);
        self.round = self.plan.next(gathered).map(|step| {
            let mark = mark(self.steps);
            let step = convert::step(self.steps, &step, mark.position, mark.sum.digest);
            Round::new(step, &self.job, expected)
        });
        if let Some(round) = &self.round {
            self.steps += 1;
            self.fills += u32::from(!round.makes_pixels());
        }
    }

    /// Puts back the tiles of the leases that `lost` picks, and counts them as lost. Whether there were any.
    pub fn lose(&mut self, lost: impl Fn(&Held) -> bool) -> bool {
        let count = self.round.as_mut().map_or(0, |round| round.put_back(lost));
        self.leases_lost += count;
        metrics::leases_lost(count);
        count > 0
    }

    /// Gives a worker no more of this frame, and tells the owner why.
    pub fn decline(&mut self, worker: Arc<str>, mut reason: String, for_all: bool) {
        if let Some(round) = &mut self.round {
            round.put_back(|held| held.worker == worker);
        }
        let cut = (0..=REASON_MAX.min(reason.len())).rev().find(|&at| reason.is_char_boundary(at));
        reason.truncate(cut.unwrap_or(0));
        if self.outbox.declined.len() < DECLINES_MAX {
            self.outbox.declined.push_back(v1::FrameDeclined { worker: worker.to_string(), reason, for_all });
        }
        self.unfit.insert(worker);
    }

    /// Forgets that a worker ever was.
    pub fn forget(&mut self, worker: &str) {
        self.unfit.remove(worker);
    }

    /// What the owner is told next; `mark` tells the state of the draft as in [`Self::complete`]. The second value is whether there
    /// is room for pixels again where there was none.
    pub fn news(&mut self, workers: u32, mark: impl FnOnce(u32) -> Mark) -> (News, bool) {
        let blocked = self.room() == 0;
        let Some(event) = self.event(workers, mark) else {
            return (if self.outbox.ended { News::End } else { News::Wait }, false);
        };
        (News::Tell(Box::new(v1::FrameEvent { event: Some(event) })), blocked && self.room() > 0)
    }

    fn event(&mut self, workers: u32, mark: impl FnOnce(u32) -> Mark) -> Option<Event> {
        let outbox = &mut self.outbox;
        if std::mem::take(&mut outbox.opening) {
            let Origin { base: Mark { sum, .. }, filled, .. } = self.origin;
            return Some(Event::Opened(v1::FrameOpened {
                frame: self.id,
                base: convert::digest_bytes(sum.digest),
                base_records: sum.records,
                filled,
            }));
        }
        if std::mem::take(&mut outbox.scene) {
            return Some(Event::SceneWanted(v1::SceneWanted {}));
        }
        if let Some(declined) = outbox.declined.pop_front() {
            return Some(Event::Declined(declined));
        }
        if let Some(round) = self.round.as_ref().filter(|_| outbox.progress) {
            outbox.progress = false;
            return Some(Event::Progress(v1::FrameProgress {
                step: Some(round.step().clone()),
                tiles_done: round.done_tiles(),
                tiles_total: round.tiles(),
                records: self.origin.base.sum.records + mark(u32::MAX).sum.records,
                workers,
            }));
        }
        if let Some(tile) = outbox.tiles.pop_front() {
            outbox.tile_bytes -= tile.pixels.len();
            return Some(Event::Tile(tile));
        }
        if self.round.is_some() || self.publishing || std::mem::replace(&mut outbox.ended, true) {
            return None;
        }
        // The last step made the pixels; what it read is what the steps before it gathered.
        let read = self.origin.base.sum.and(mark(self.steps.saturating_sub(1)).sum);
        let count = |(name, value): (&String, &f64)| v1::Count { name: name.clone(), value: *value };
        Some(Event::Done(v1::FrameDone {
            rounds: self.fills,
            passes: self.plan.passes(),
            leases_lost: self.leases_lost,
            digest: convert::digest_bytes(read.digest),
            records: read.records,
            counts: self.counts.iter().map(count).collect(),
            hosts: self.hosts.iter().map(|(host, sum)| v1::HostUse { host: host.clone(), ..sum.clone() }).collect(),
        }))
    }
}

/// So that no sum of them can overflow.
fn check_gathered(gathered: u64) -> Result<(), Refusal> {
    if gathered <= u64::from(u32::MAX) {
        return Ok(());
    }
    Err(Refusal::field("gathered", format!("is {gathered}, expected at most {}", u32::MAX)))
}

fn worked(seconds: f64) -> Result<Duration, Refusal> {
    Duration::try_from_secs_f64(seconds)
        .map_err(|_| Refusal::field("worked_seconds", format!("is {seconds}, expected a time")))
}

fn check_used(used: &v1::HostUse) -> Result<(), Refusal> {
    spec::size("used.host", used.host.len(), 0..=spec::NAME_MAX)?;
    let seconds = used.round_trip_seconds;
    if !(0.0..=SECONDS_MAX).contains(&seconds) {
        return Err(Refusal::field("used.round_trip_seconds", format!("is {seconds}, expected 0 to {SECONDS_MAX}")));
    }
    Ok(())
}

fn add_used(hosts: &mut BTreeMap<String, v1::HostUse>, used: v1::HostUse) {
    let told_apart = hosts.len() < HOSTS_MAX || hosts.contains_key(&used.host);
    let sum = hosts.entry(if told_apart { used.host } else { String::new() }).or_default();
    sum.sent_bytes = sum.sent_bytes.saturating_add(used.sent_bytes);
    sum.received_bytes = sum.received_bytes.saturating_add(used.received_bytes);
    sum.round_trips = sum.round_trips.saturating_add(used.round_trips);
    sum.round_trip_seconds += used.round_trip_seconds;
}

fn check_tiles(job: &Job, expected: Range<u32>, tiles: &[v1::FrameTile]) -> Result<(), Refusal> {
    let mut numbers: Vec<u32> = tiles.iter().map(|tile| tile.tile).collect();
    numbers.sort_unstable();
    if !numbers.iter().copied().eq(expected.clone()) {
        let reason = format!("has {} tiles, expected each of {} to {} once", tiles.len(), expected.start, expected.end);
        return Err(Refusal::field("tiles", reason));
    }
    for tile in tiles {
        let (pixels, bytes) = (job.pixels(tile.tile), tile.pixels.len());
        if bytes == 0 || !bytes.is_multiple_of(4 * pixels) || bytes > pixels * PIXEL_BYTES_MAX {
            let reason = format!(
                "tile {} has {bytes} bytes, expected a multiple of 4 bytes for each of its {pixels} pixels, at most 64",
                tile.tile
            );
            return Err(Refusal::field("tiles", reason));
        }
    }
    Ok(())
}

fn check_counts(known: &BTreeMap<String, f64>, counts: &[v1::Count]) -> Result<(), Refusal> {
    let mut new = BTreeSet::new();
    for count in counts {
        spec::size("counts.name", count.name.len(), 1..=spec::NAME_MAX)?;
        if !count.value.is_finite() {
            return Err(Refusal::field("counts.value", format!("{} is {}", count.name, count.value)));
        }
        if !known.contains_key(&count.name) {
            new.insert(&count.name);
        }
    }
    if known.len() + new.len() > COUNTS_MAX {
        return Err(Refusal::field("counts", format!("more than {COUNTS_MAX} different names in one frame")));
    }
    Ok(())
}
