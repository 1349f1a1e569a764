//! A frame without a farm: filled and finished in this process, for tests, charts and comparisons.

use std::sync::Arc;

use cache_core::Sealed;
use cache_core::rounds::{Plan, RANKS, Step};
use rayon::prelude::*;

use crate::frame::{CHANNELS, Counts, Frame, Levels};

/// In which order candidates are tested.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Order {
    /// By the plan, as a farm does: every round against the cache as sealed before it.
    Rounds,
    /// One after another in order of rank, each against all records before it: the fewest records, but no two workers
    /// could share the work.
    Sequential,
}

/// Fills every level of a frame.
pub fn fill(frame: &Frame, order: Order) -> Levels {
    fill_ranks(frame, order, RANKS).0
}

/// Fills every level of a frame as far as pixels of ranks below `end` want it; fewer than all in one pass.
pub fn fill_ranks(frame: &Frame, order: Order, end: u32) -> (Levels, Counts) {
    let mut counts = Counts::default();
    let (a, details) = (frame.settings().a, frame.settings().details);
    let mut levels: Levels = (0..frame.levels()).map(|_| Arc::new(Sealed::with(a, details))).collect();
    let mut plan = Plan::new(frame.levels());
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
                done.iter().for_each(|(_, counted)| counts.add(counted));
                let new: Vec<_> = done.into_iter().flat_map(|(records, _)| records).collect();
                gathered += new.len() as u64;
                Arc::make_mut(&mut levels[level as usize - 1]).extend(new);
            }
        }
    }
    (levels, counts)
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
