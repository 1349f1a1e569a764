//! A frame without a farm: filled and finished in this process, for tests, charts and comparisons.

use std::collections::BTreeMap;

use cache_core::Record;
use cache_core::rounds::{Plan, RANKS, Step};
use rayon::prelude::*;

use crate::frame::{CHANNELS, Counts, Frame};
use crate::levels::{Level, Levels};
use crate::task::CpuClock;

/// In which order candidates are tested.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Order {
    /// By the plan, as a farm does: every round against the cache as sealed before it.
    Rounds,
    /// One after another in order of rank, each against all records before it: the fewest records, but no two workers
    /// could share the work.
    Sequential,
}

/// A frame filled, and what that took.
pub struct Filled {
    /// Its records.
    pub levels: Levels,
    /// What was counted.
    pub counts: Counts,
    /// Passes over level 1.
    pub passes: u32,
    /// Proposals that records shrink.
    pub proposals: u64,
    /// CPU seconds of sealing, of the thread that asks.
    pub sealing_seconds: f64,
}

/// Fills every level of a frame.
pub fn fill(frame: &Frame, order: Order) -> Levels {
    fill_ranks(frame, order, RANKS).levels
}

/// Fills every level of a frame as far as pixels of ranks below `end` want it; fewer than all in one pass.
pub fn fill_ranks(frame: &Frame, order: Order, end: u32) -> Filled {
    let (a, details) = (frame.settings().a, frame.settings().details);
    let mut levels: Levels = (0..frame.levels()).map(|_| Level::new(a, details)).collect();
    let (mut counts, mut proposals, mut sealing_seconds) = (Counts::default(), 0, 0.0);
    let mut plan = Plan::new(frame.levels(), details.adaptive, frame.settings().size());
    let mut gathered = 0;
    while let Some(Step::Fill { level, pass, ranks }) = plan.next(gathered) {
        gathered = 0;
        if end < RANKS && (pass > 0 || ranks.start >= end) {
            continue;
        }
        let ranks = ranks.start..ranks.end.min(end);
        let steps: Vec<_> = match order {
            Order::Rounds => vec![ranks],
            Order::Sequential => ranks.map(|r| r..r + 1).collect(),
        };
        for ranks in steps {
            // The pixels of one rank are 64 apart; strictly sequential filling seals after each of them all the same.
            let chunk = if order == Order::Rounds { u32::MAX } else { 1 };
            for tiles in chunks(frame.settings().tiles(), chunk) {
                let work = |tile| frame.fill(level, pass, ranks.clone(), tile, &levels, &|_| None);
                let done: Vec<_> = tiles.into_par_iter().map(work).collect();
                // Two tiles may propose the same.
                let mut new = BTreeMap::new();
                for (records, counted) in done {
                    counts.add(&counted);
                    gathered += records.len() as u64;
                    new.extend(records.into_iter().map(|record| (record.id(), record)));
                }
                proposals += new.values().filter(|record| matches!(record, Record::Shrink(_))).count() as u64;
                let clock = CpuClock::start();
                levels[level as usize - 1].unite(new.values());
                sealing_seconds += clock.seconds();
            }
        }
    }
    Filled { levels, counts, passes: plan.passes(), proposals, sealing_seconds }
}

fn chunks(tiles: u32, size: u32) -> impl Iterator<Item = std::ops::Range<u32>> {
    (0..tiles).step_by(size as usize).map(move |from| from..tiles.min(from.saturating_add(size)))
}

/// The finished pixels of a frame, row by row, [`CHANNELS`] floats each.
pub fn pixels(frame: &Frame, levels: &Levels) -> (Vec<f32>, Counts) {
    let settings = frame.settings();
    let mut picture = vec![0.0; settings.width as usize * settings.height as usize * CHANNELS];
    let mut counts = Counts::default();
    let tiles: Vec<_> = (0..settings.tiles()).into_par_iter().map(|t| frame.pixels(t, levels)).collect();
    for (tile, (pixels, counted)) in tiles.into_iter().enumerate() {
        counts.add(&counted);
        for ([x, y], pixel) in settings.pixels(tile as u32).zip(pixels.chunks_exact(CHANNELS)) {
            let at = (y as usize * settings.width as usize + x as usize) * CHANNELS;
            picture[at..at + CHANNELS].copy_from_slice(pixel);
        }
    }
    (picture, counts)
}
