//! The plan by which a frame is filled: coarse to fine, level by level, independent of the farm.
//!
//! Every pixel has a rank in a 64 x 64 pattern (an ordered dither): pixels of low rank lie far apart, and any range of
//! ranks is spread evenly. A round tests the candidates of a range of ranks against the cache as sealed before it. The
//! ranges grow geometrically, so that each round adds a fixed fraction of the points tested before it: that keeps the
//! candidates of one round apart and the records close in number to strictly sequential filling.
//!
//! The plan knows nothing of workers; what comes next depends only on how many records each step gathered.

use std::ops::Range;

/// Edge of the pattern in pixels.
pub const PATTERN: u32 = 1 << RANK_BITS;
/// Ranks in the pattern.
pub const RANKS: u32 = PATTERN * PATTERN;
const RANK_BITS: u32 = 6;

/// Each round of the first pass ends at this many times the ranks tested before it.
const GROWTH: f32 = 1.25;

/// Points looked at in each pixel for level 1, one a pass: the camera sees edges cross its pixels.
const LOOKS: u32 = 4;

/// The same for a deeper level: a gather ray that meets a hole goes on as a path.
const LOOKS_DEEPER: u32 = 2;

/// Candidates of a pass over level 1, at most about: a larger picture shows the same light with more pixels, and all looks
/// together still leave none of them between points much nearer each other than records can be.
const CANDIDATES: u64 = 1 << 16;

/// The same for a deeper level, whose holes cost a path each.
const CANDIDATES_DEEPER: u64 = 1 << 14;

/// Rounds of a pass that looks where no pass has looked before, after the first.
const ROUNDS_LATER: u32 = 8;

/// Rounds of a pass that looks again: it only finds what clamping has uncovered since.
const ROUNDS_AGAIN: u32 = 2;

/// The first round of a pass that refines, as a fraction of the pass; each round goes twice as far as the one before it. What
/// shrank left holes of many pixels.
const REFINING_FROM: u32 = 64;

/// Most passes that refine; Krivanek 2006 needed at most 11.
pub const REFINING_MAX: u32 = 11;

/// A level is full when every look was filled once and a pass gathers for at most one in so many of its candidates. Clamping
/// uncovers a few more in each pass; finding them takes longer than what their pixels gather for themselves.
const HOLES: u64 = 1024;

/// Passes before the plan gives up on a level's last holes.
pub const PASSES_MAX: u32 = 16;

/// Rank of a pixel: bits of x^y and y interleaved, finest differences first.
pub fn rank(x: u32, y: u32) -> u32 {
    static RANK: [[u16; PATTERN as usize]; PATTERN as usize] = pattern();
    RANK[(y % PATTERN) as usize][(x % PATTERN) as usize].into()
}

const fn pattern() -> [[u16; PATTERN as usize]; PATTERN as usize] {
    let mut pattern = [[0; PATTERN as usize]; PATTERN as usize];
    let mut at = 0;
    while at < RANKS {
        let (x, y) = (at % PATTERN, at / PATTERN);
        let (mut rank, mut bit) = (0, 0);
        while bit < RANK_BITS {
            rank = rank << 2 | ((x ^ y) >> bit & 1) << 1 | y >> bit & 1;
            bit += 1;
        }
        pattern[y as usize][x as usize] = rank as u16;
        at += 1;
    }
    pattern
}

/// One step of a frame.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Step {
    /// A round: test the candidates of these ranks, gather where the sealed cache does not cover.
    Fill {
        /// Level being filled, counted from the camera: 1, 2, ...
        level: u32,
        /// Pass over the level, from 0. Each tests one point of every pixel: the [`look`] of its pass.
        pass: u32,
        /// Ranks whose candidates are tested.
        ranks: Range<u32>,
    },
    /// Interpolate every sample of every pixel from the sealed cache.
    Pixels,
}

/// Which point of its pixels a pass looks at: 0 their middle, 1 and so on others. After a round of looks it starts again,
/// until hardly a point is found uncovered.
pub fn look(level: u32, pass: u32) -> u32 {
    pass % looks(level)
}

/// Whether a pass of an adaptive plan also looks for visible steps between records (Krivanek 2006, Algorithm 1): at level
/// 1, when every look has been filled once.
pub fn refines(level: u32, pass: u32) -> bool {
    level == 1 && (LOOKS..LOOKS + REFINING_MAX).contains(&pass)
}

fn looks(level: u32) -> u32 {
    if level == 1 { LOOKS } else { LOOKS_DEEPER }
}

/// Ranks whose pixels a pass looks at in a picture of so many: all, or so few that candidates do not grow with it, then others in each look.
pub fn ranks(level: u32, pass: u32, pixels: u64) -> Range<u32> {
    let candidates = if level == 1 { CANDIDATES } else { CANDIDATES_DEEPER };
    let count = (u64::from(RANKS) * candidates / pixels.max(1)).clamp(1, RANKS.into()) as u32;
    let share = RANKS / looks(level);
    let from = if count <= share { look(level, pass) * share } else { 0 };
    from..from + count
}

/// Gives a frame's steps one after another: levels deepest first, each in passes through all looks and on until one gathers
/// next to nothing, then the pixels.
#[derive(Clone, Debug)]
pub struct Plan {
    adaptive: bool,
    pixels: u64,
    level: u32,
    pass: u32,
    from: u32,
    gathered: u64,
    /// Passes over level 1 so far.
    passes: u32,
    done: bool,
}

impl Plan {
    /// A plan for `levels` levels of records (0: pixels only) of a picture of so many pixels; an adaptive one has passes that
    /// refine.
    pub fn new(levels: u32, adaptive: bool, pixels: u64) -> Self {
        Self { adaptive, pixels, level: levels, pass: 0, from: 0, gathered: 0, passes: 0, done: false }
    }

    /// Passes over level 1 so far.
    pub fn passes(&self) -> u32 {
        self.passes
    }

    /// The next step, told how many records and proposals the previous one made (0 before the first); `None` when all is
    /// done.
    pub fn next(&mut self, gathered: u64) -> Option<Step> {
        self.gathered += gathered;
        if self.level > 0 && self.from == ranks(self.level, self.pass, self.pixels).end {
            let full = self.pass >= self.passes_min() && self.gathered * HOLES <= self.candidates();
            self.pass += 1;
            if full || self.pass == self.passes_max() {
                self.pass = 0;
                self.level -= 1;
            }
            self.gathered = 0;
            self.from = ranks(self.level, self.pass, self.pixels).start;
        }
        if self.level > 0 {
            if self.level == 1 {
                self.passes = self.pass + 1;
            }
            let from = self.from;
            self.from = self.round_end();
            return Some(Step::Fill { level: self.level, pass: self.pass, ranks: from..self.from });
        }
        (!std::mem::replace(&mut self.done, true)).then_some(Step::Pixels)
    }

    /// Candidates of a pass, at most.
    fn candidates(&self) -> u64 {
        let ranks = ranks(self.level, self.pass, self.pixels).len() as u64;
        self.pixels.saturating_mul(ranks) / u64::from(RANKS)
    }

    /// The first pass that may show a level to be full: the last look, or, where records shrink, the first that refines.
    fn passes_min(&self) -> u32 {
        if self.adaptive && self.level == 1 { LOOKS } else { looks(self.level) - 1 }
    }

    fn passes_max(&self) -> u32 {
        // The holes the last shrinking left are filled, too.
        if self.adaptive && self.level == 1 { LOOKS + REFINING_MAX + LOOKS } else { PASSES_MAX }
    }

    fn round_end(&self) -> u32 {
        let refining = self.adaptive && self.level == 1;
        let Range { start, end } = ranks(self.level, self.pass, self.pixels);
        let (done, all) = (self.from - start, end - start);
        let done = match self.pass {
            0 => ((done as f32 * GROWTH) as u32).max(done + 1),
            pass if pass < looks(self.level) => done + all.div_ceil(ROUNDS_LATER),
            _ if refining => (2 * done).max(all.div_ceil(REFINING_FROM)),
            _ => done + all.div_ceil(ROUNDS_AGAIN),
        };
        start + done.min(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_rank_stands_once_in_the_pattern_and_low_ranks_lie_apart() {
        let mut seen = vec![false; RANKS as usize];
        for y in 0..64 {
            for x in 0..64 {
                assert!(!std::mem::replace(&mut seen[rank(x, y) as usize], true));
            }
        }
        // The first 4^k ranks form a grid of spacing 64 / 2^k.
        for y in 0..64 {
            for x in 0..64 {
                assert_eq!(rank(x, y) < 16, x % 16 == 0 && y % 16 == 0);
            }
        }
    }

    fn steps(levels: u32, gathered: impl FnMut(&Step) -> u64) -> Vec<Step> {
        all_steps(Plan::new(levels, false, 1), gathered)
    }

    fn all_steps(mut plan: Plan, mut gathered: impl FnMut(&Step) -> u64) -> Vec<Step> {
        let (mut all, mut last) = (Vec::new(), 0);
        while let Some(step) = plan.next(last) {
            last = gathered(&step);
            all.push(step);
        }
        all
    }

    #[test]
    fn each_pass_tests_every_rank_once_deepest_level_first() {
        let all = steps(2, |_| 0);
        assert_eq!(all.last(), Some(&Step::Pixels));
        let mut expected = vec![];
        for level in [2, 1] {
            for pass in 0..looks(level) {
                let mut at = 0;
                for step in &all {
                    if let Step::Fill { level: l, pass: p, ranks } = step
                        && (*l, *p) == (level, pass)
                    {
                        assert_eq!(ranks.start, at);
                        assert!(ranks.end > ranks.start);
                        at = ranks.end;
                        expected.push(step.clone());
                    }
                }
                assert_eq!(at, RANKS);
            }
        }
        assert_eq!(all[..all.len() - 1], expected);
    }

    /// At 512 x 512 all looks of level 1 together test every pixel once; small pictures are tested whole by each.
    #[test]
    fn a_large_picture_is_tested_by_other_pixels_in_each_look() {
        let tested = |level, pixels| (0..looks(level)).map(move |pass| ranks(level, pass, pixels)).collect::<Vec<_>>();
        assert_eq!(tested(1, 128 * 128), vec![0..RANKS; LOOKS as usize]);
        assert_eq!(tested(1, 512 * 512), [0..1024, 1024..2048, 2048..3072, 3072..4096]);
        assert_eq!(tested(2, 512 * 512), [0..256, 2048..2304]);
        assert_eq!(tested(1, 65536 * 65536)[1..3], [1024..1025, 2048..2049]);
        for pixels in [1, 300 * 300, 1000 * 1000, 65536 * 65536] {
            let mut plan = Plan::new(2, false, pixels);
            let mut at = 0;
            while let Some(Step::Fill { level, pass, ranks: round }) = plan.next(0) {
                let all = ranks(level, pass, pixels);
                assert!(!round.is_empty() && (round.start == all.start || round.start == at), "{round:?} of {all:?}");
                at = round.end;
                assert!(at <= all.end);
            }
        }
    }

    #[test]
    fn a_level_is_full_when_a_pass_gathers_next_to_nothing_or_gives_up() {
        assert_eq!(steps(0, |_| 0), [Step::Pixels]);
        // 2048 pixels: two holes in a pass are few, three are not.
        let passes = |levels, found: &dyn Fn(u32) -> u64| {
            let first = |ranks: &Range<u32>| ranks.start == 0;
            let all = all_steps(Plan::new(levels, false, 2048), |step| match step {
                Step::Fill { pass, ranks, .. } if first(ranks) => found(*pass),
                _ => 0,
            });
            all.iter().filter(|step| matches!(step, Step::Fill { ranks, .. } if first(ranks))).count() as u32
        };
        assert_eq!(passes(1, &|_| 0), LOOKS);
        assert_eq!(passes(2, &|_| 0), LOOKS + LOOKS_DEEPER);
        assert_eq!(passes(1, &|_| 3), PASSES_MAX);
        // What earlier looks found does not matter, and a look that found little is the last.
        assert_eq!(passes(1, &|pass| if pass < 3 { 100 } else { 2 }), LOOKS);
        assert_eq!(passes(1, &|pass| if pass < 5 { 3 } else { 2 }), 6);
    }

    #[test]
    fn an_adaptive_plan_refines_level_1_until_a_pass_finds_nothing() {
        let passes = |level: u32, found: &dyn Fn(&Step) -> u64| {
            let all = all_steps(Plan::new(2, true, 1), found);
            let pass = |step: &Step| match step {
                Step::Fill { level: l, pass, ranks } if *l == level && ranks.start == 0 => Some(*pass),
                _ => None,
            };
            all.iter().filter_map(pass).collect::<Vec<_>>()
        };
        let refining = |passes: &[u32], level| passes.iter().filter(|pass| refines(level, **pass)).count() as u32;
        let nothing = passes(1, &|_| 0);
        // Looks that were not refined say nothing about steps.
        assert_eq!((nothing.len() as u32, refining(&nothing, 1)), (LOOKS + 1, 1));
        assert_eq!(passes(2, &|_| 0).len() as u32, LOOKS_DEEPER);
        let once = passes(1, &|step| u64::from(matches!(step, Step::Fill { pass: 4 | 5, .. })));
        assert_eq!(refining(&once, 1), 3);
        // Without end, the holes of the last shrinking are still filled.
        let always = passes(1, &|_| 1);
        assert_eq!((always.len() as u32, refining(&always, 1)), (2 * LOOKS + REFINING_MAX, REFINING_MAX));
        assert!(always[always.len() - LOOKS as usize..].iter().all(|pass| !refines(1, *pass)));
    }
}
