//! The tiles of one step: each is pending, leased to one worker, or done. No I/O; time is passed in.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use cache_proto::v1;

/// A range of tiles a worker does.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Held {
    /// Who.
    pub worker: Arc<str>,
    /// Which tiles.
    pub tiles: Range<u32>,
    /// Since when, in time since the server's start.
    pub since: Duration,
    /// When it is lost, in time since the server's start.
    pub deadline: Duration,
}

/// One step and its tiles.
///
/// Invariant: pending ranges, leased ranges and done tiles are disjoint and together all tiles of the frame, so no tile
/// can be done twice.
#[derive(Debug)]
pub struct Round {
    step: v1::Step,
    /// Disjoint ranges, from -> to, lowest first.
    pending: BTreeMap<u32, u32>,
    pending_tiles: u32,
    leases: BTreeMap<u64, Held>,
    leased_tiles: u32,
    tiles: u32,
    gathered: u64,
}

impl Round {
    /// A step with all its `tiles` pending.
    pub fn new(step: v1::Step, tiles: u32) -> Self {
        let pending = BTreeMap::from([(0, tiles)]);
        Self { step, pending, pending_tiles: tiles, leases: BTreeMap::new(), leased_tiles: 0, tiles, gathered: 0 }
    }

    /// What the step is.
    pub fn step(&self) -> &v1::Step {
        &self.step
    }

    /// Whether the step makes pixels (else it fills a level).
    pub fn makes_pixels(&self) -> bool {
        self.step.level == 0
    }

    /// Tiles nobody holds.
    pub fn pending_tiles(&self) -> u32 {
        self.pending_tiles
    }

    /// Tiles somebody works on.
    pub fn leased_tiles(&self) -> u32 {
        self.leased_tiles
    }

    /// Tiles that are finished.
    pub fn done_tiles(&self) -> u32 {
        self.tiles - self.pending_tiles - self.leased_tiles
    }

    /// Tiles altogether.
    pub fn tiles(&self) -> u32 {
        self.tiles
    }

    /// Whether every tile is done.
    pub fn is_over(&self) -> bool {
        self.done_tiles() == self.tiles
    }

    /// Sum of what the completed leases gathered.
    pub fn gathered(&self) -> u64 {
        self.gathered
    }

    /// Leases up to `most` of the lowest pending tiles, contiguous. `None` when none is pending.
    pub fn grant(
        &mut self,
        lease: u64,
        worker: Arc<str>,
        most: u32,
        since: Duration,
        deadline: Duration,
    ) -> Option<Range<u32>> {
        let (from, to) = self.pending.pop_first()?;
        let cut = from.saturating_add(most.max(1)).min(to);
        if cut < to {
            self.pending.insert(cut, to);
        }
        self.pending_tiles -= cut - from;
        self.leased_tiles += cut - from;
        self.leases.insert(lease, Held { worker, tiles: from..cut, since, deadline });
        Some(from..cut)
    }

    /// The lease of a number, if `worker` holds it.
    pub fn held(&self, lease: u64, worker: &str) -> Option<&Held> {
        self.leases.get(&lease).filter(|held| &*held.worker == worker)
    }

    /// All leases.
    pub fn leases(&self) -> impl Iterator<Item = &Held> {
        self.leases.values()
    }

    /// Numbers of the leases a worker holds.
    pub fn held_by(&self, worker: &str) -> impl Iterator<Item = u64> {
        self.leases.iter().filter(move |(_, held)| &*held.worker == worker).map(|(&lease, _)| lease)
    }

    /// Moves the deadline of those of the leases that a worker holds.
    pub fn renew(&mut self, worker: &str, leases: &BTreeSet<u64>, deadline: Duration) {
        let named = self.leases.iter_mut().filter(|(id, held)| leases.contains(id) && &*held.worker == worker);
        for (_, held) in named {
            held.deadline = deadline;
        }
    }

    /// Ends a lease whose tiles are done. Unknown leases change nothing.
    pub fn complete(&mut self, lease: u64, gathered: u64) {
        if let Some(held) = self.leases.remove(&lease) {
            self.leased_tiles -= held.tiles.end - held.tiles.start;
            self.gathered += gathered;
        }
    }

    /// Puts back the tiles of all leases that `lost` picks; returns how many leases that were.
    pub fn put_back(&mut self, lost: impl Fn(&Held) -> bool) -> u32 {
        let (pending, pending_tiles, leased_tiles) =
            (&mut self.pending, &mut self.pending_tiles, &mut self.leased_tiles);
        let before = self.leases.len();
        self.leases.retain(|_, held| {
            if !lost(held) {
                return true;
            }
            pending.insert(held.tiles.start, held.tiles.end);
            *pending_tiles += held.tiles.end - held.tiles.start;
            *leased_tiles -= held.tiles.end - held.tiles.start;
            false
        });
        (before - self.leases.len()) as u32
    }
}
