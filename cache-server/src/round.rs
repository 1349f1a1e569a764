//! The tiles of one step: each is pending, leased to one worker, or done. No I/O; time is passed in.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use cache_core::rounds::{PATTERN, rank};
use cache_proto::v1;

use crate::expected::Expected;
use crate::spec::Job;

/// A lease is this fraction of an equal share of what is pending: large at first, small near the end, so that all
/// workers finish a step together (guided self-scheduling).
const SHARES: f64 = 2.0;

/// What a lease should take at least, as far as is known: a small part of that is spent on giving it out. Where a whole
/// step is little work, some of many workers get none of it.
const LEASE_LEAST: Duration = Duration::from_millis(10);

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
    /// Sum of what is expected of them.
    pending_work: f64,
    leases: BTreeMap<u64, Held>,
    leased_tiles: u32,
    tiles: u32,
    empty: Empty,
    gathered: u64,
    expected: Expected,
    /// Of each tile, what is expected of it in this step, seconds, 0 where there is nothing to do; one each where nothing is
    /// known.
    work: Vec<f32>,
    known: bool,
}

/// Which tiles have nothing to do: no pixel whose rank the step tests lies in them.
#[derive(Debug)]
struct Empty {
    columns: u32,
    /// The pattern repeats after so many tiles, across and down.
    period: u32,
    of_period: Vec<bool>,
}

impl Empty {
    fn new(step: &v1::Step, spec: &v1::FrameSpec) -> Self {
        let (edge, columns) = (spec.tile_size, spec.width.div_ceil(spec.tile_size));
        if step.level == 0 || !PATTERN.is_multiple_of(edge) {
            return Self { columns, period: 1, of_period: vec![false] };
        }
        let (period, ranks) = (PATTERN / edge, step.rank_from..step.rank_to);
        let mut of_period = vec![true; (period * period) as usize];
        for (x, y) in (0..PATTERN * PATTERN).map(|at| (at % PATTERN, at / PATTERN)) {
            if ranks.contains(&rank(x, y)) {
                of_period[(y / edge * period + x / edge) as usize] = false;
            }
        }
        Self { columns, period, of_period }
    }

    fn has(&self, tile: u32) -> bool {
        let (column, row) = (tile % self.columns % self.period, tile / self.columns % self.period);
        self.of_period[(row * self.period + column) as usize]
    }
}

impl Round {
    /// A step with all tiles of the picture pending; `expected` knows what they took in the steps before.
    pub fn new(step: v1::Step, job: &Job, mut expected: Expected) -> Self {
        let (tiles, empty) = (job.tiles, Empty::new(&step, &job.spec));
        let (mut work, known) = expected.of(step.level);
        (0..tiles).filter(|tile| empty.has(*tile)).for_each(|tile| work[tile as usize] = 0.0);
        Self {
            pending_work: sum(&work),
            step,
            pending: BTreeMap::from([(0, tiles)]),
            pending_tiles: tiles,
            leases: BTreeMap::new(),
            leased_tiles: 0,
            tiles,
            empty,
            gathered: 0,
            expected,
            work,
            known,
        }
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

    /// What its tiles took, for the step after it.
    pub fn into_expected(self) -> Expected {
        self.expected
    }

    /// How much of what is expected one of `threads` should get now.
    fn share(&self, threads: u32) -> f64 {
        let least = if self.known { LEASE_LEAST.as_secs_f64() } else { 0.0 };
        (self.pending_work / f64::from(threads) / SHARES).max(least)
    }

    /// Leases one of `threads` its share of the work in the lowest pending tiles, contiguous, at least one and at most `most`,
    /// and the empty ones behind them: a lease costs more than looking at nothing. `None` when none is pending.
    pub fn grant(
        &mut self,
        lease: u64,
        worker: Arc<str>,
        threads: u32,
        most: u32,
        since: Duration,
        deadline: Duration,
    ) -> Option<Range<u32>> {
        let share = self.share(threads.max(1));
        let (from, to) = self.pending.pop_first()?;
        let (mut cut, mut work) = (from, 0.0);
        while cut < to {
            let next = f64::from(self.work[cut as usize]);
            if work > 0.0 && next > 0.0 && (work + next > share || cut - from >= most) {
                break;
            }
            work += next;
            cut += 1;
        }
        if cut < to {
            self.pending.insert(cut, to);
        }
        self.pending_tiles -= cut - from;
        self.pending_work -= work;
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

    /// Ends a lease whose tiles are done and took so long to work on. Unknown leases change nothing.
    pub fn complete(&mut self, lease: u64, gathered: u64, worked: Duration, now: Duration) {
        if let Some(held) = self.leases.remove(&lease) {
            self.leased_tiles -= held.tiles.end - held.tiles.start;
            self.gathered += gathered;
            // Nobody works longer than it has the work.
            let worked = worked.min(now.saturating_sub(held.since));
            self.expected.took(held.tiles, |tile| self.empty.has(tile), worked);
        }
    }

    /// Puts back the tiles of all leases that `lost` picks; returns how many leases that were.
    pub fn put_back(&mut self, lost: impl Fn(&Held) -> bool) -> u32 {
        let (pending, pending_tiles, leased_tiles) =
            (&mut self.pending, &mut self.pending_tiles, &mut self.leased_tiles);
        let (pending_work, work) = (&mut self.pending_work, &self.work);
        let before = self.leases.len();
        self.leases.retain(|_, held| {
            if !lost(held) {
                return true;
            }
            pending.insert(held.tiles.start, held.tiles.end);
            *pending_work += sum(&work[held.tiles.start as usize..held.tiles.end as usize]);
            *pending_tiles += held.tiles.end - held.tiles.start;
            *leased_tiles -= held.tiles.end - held.tiles.start;
            false
        });
        (before - self.leases.len()) as u32
    }
}

fn sum(work: &[f32]) -> f64 {
    work.iter().map(|seconds| f64::from(*seconds)).sum()
}
