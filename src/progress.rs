//! Tells the user on stderr how far a render is: a bar in a terminal, a line every few seconds elsewhere.

use std::time::{Duration, Instant};

use cache_core::rounds;
use cache_proto::v1;
use indicatif::{HumanDuration, ProgressBar, ProgressStyle};

use crate::say;

/// Between two lines where there is no terminal.
const LINES: Duration = Duration::from_secs(5);

/// An estimate from less than this would be a guess.
const SHARE_MIN: f64 = 0.02;
const TIME_MIN: Duration = Duration::from_secs(1);

/// Steps of the bar.
const BAR: u64 = 1000;

/// How progress is told.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default, clap::ValueEnum)]
pub enum Told {
    /// A bar in a terminal, a line every few seconds elsewhere, on stderr
    #[default]
    Auto,
    /// Lines openjd_progress and openjd_status on stdout, as Open Job Description has them
    Openjd,
}

enum Shown {
    Bar(ProgressBar),
    /// When the last line was.
    Lines(Instant),
    /// Whole percents told so far.
    OpenJd(u32),
    Nothing,
}

/// What the user sees while waiting.
pub struct Progress {
    shown: Shown,
    phase: String,
    since: Instant,
    /// Whether workers are on their way without anybody's doing.
    own: bool,
}

impl Progress {
    /// A bar if stderr is a terminal, else lines; nothing if `quiet`. With `own` workers nobody need be told to start some.
    pub fn new(told: Told, quiet: bool, own: bool) -> Self {
        let shown = if told == Told::Openjd {
            Shown::OpenJd(0)
        } else if quiet {
            Shown::Nothing
        } else if console_is_terminal() {
            let bar = ProgressBar::new(BAR);
            let style = ProgressStyle::with_template("{msg} [{bar:24}] {percent:>3} %{prefix}");
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            Shown::Bar(bar)
        } else {
            Shown::Lines(Instant::now())
        };
        Self { shown, phase: String::new(), since: Instant::now(), own }
    }

    /// Shows a phase of which no share is known.
    pub fn phase(&mut self, phase: &str) {
        self.show(phase, phase.to_string(), None);
    }

    /// Shows what the server said of a picture of so many pixels and levels.
    pub fn frame(&mut self, progress: &v1::FrameProgress, pixels: u64, levels: u32) {
        let Some(step) = &progress.step else { return };
        let phase = phase_name(step);
        if progress.workers == 0 && !self.own {
            return self.wait("waiting for workers");
        }
        let shown = match step.level {
            0 => format!("pixels · {} records", progress.records),
            level => format!("level {level} pass {} · {} records", step.pass + 1, progress.records),
        };
        let share = share(progress, pixels);
        if let Shown::OpenJd(told) = &mut self.shown {
            let percent = (100.0 * whole(step, share, levels)) as u32;
            if percent > *told {
                *told = percent;
                drop(say::result(format_args!("openjd_progress: {percent}")));
            }
        }
        self.show(&format!("{phase} {}", step.pass), shown, Some(share));
    }

    /// Shows what others have to do first; as a line that stays where there is no bar.
    pub fn wait(&mut self, what: &str) {
        if matches!(self.shown, Shown::Lines(_)) && self.phase != what {
            self.note(what);
        }
        self.phase(what);
    }

    fn show(&mut self, phase: &str, text: String, share: Option<f64>) {
        let now = Instant::now();
        let new = self.phase != phase;
        if new {
            (self.phase, self.since) = (phase.into(), now);
        }
        let left = share.and_then(|share| remaining(now - self.since, share));
        match &mut self.shown {
            Shown::OpenJd(_) if new => drop(say::result(format_args!("openjd_status: {text}"))),
            Shown::Bar(bar) => {
                bar.set_position((share.unwrap_or(0.0) * BAR as f64) as u64);
                bar.set_prefix(left.map_or(String::new(), |l| format!(", {} left in this phase", HumanDuration(l))));
                bar.set_message(text);
            }
            Shown::Lines(last) if now - *last >= LINES => {
                *last = now;
                let left = left.map_or(String::new(), |l| format!(", {} s left in this phase", l.as_secs()));
                let share = share.map_or(String::new(), |s| format!(", {:.0} %", s * 100.0));
                say::line(format_args!("{text}{share}{left}"));
            }
            _ => {}
        }
    }

    /// Prints a line that stays.
    pub fn note(&self, line: &str) {
        match &self.shown {
            Shown::Bar(bar) => bar.suspend(|| say::line(line)),
            _ => say::line(line),
        }
    }

    /// All is done.
    pub fn finish(&mut self) {
        match &mut self.shown {
            Shown::OpenJd(told) if *told < 100 => {
                *told = 100;
                drop(say::result("openjd_progress: 100"));
            }
            _ => self.clear(),
        }
    }

    fn clear(&self) {
        if let Shown::Bar(bar) = &self.shown {
            bar.finish_and_clear();
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.clear();
    }
}

fn console_is_terminal() -> bool {
    std::io::IsTerminal::is_terminal(&std::io::stderr())
}

/// `level N` or `pixels`, as in the workers' counts.
pub fn phase_name(step: &v1::Step) -> String {
    match step.level {
        0 => "pixels".into(),
        level => format!("level {level}"),
    }
}

/// How much of its phase (a pass over a level, or the pixels) is done, 0 to 1.
fn share(progress: &v1::FrameProgress, pixels: u64) -> f64 {
    let Some(step) = &progress.step else { return 0.0 };
    let tiles = f64::from(progress.tiles_done) / f64::from(progress.tiles_total.max(1));
    match step.level {
        0 => tiles,
        _ => {
            let ranks = rounds::ranks(step.level, step.pass, pixels);
            let tested = |rank: u32| f64::from(rank.saturating_sub(ranks.start)) / ranks.len() as f64;
            let (from, to) = (tested(step.rank_from), tested(step.rank_to));
            let tested = from + (to - from) * tiles;
            // At first almost every candidate becomes a record, later few: a count of candidates would promise far too long
            // a wait. Later passes gather little, evenly.
            if step.pass == 0 { tested.sqrt() } else { tested }
        }
    }
}

/// How much of the whole is done, each level and the pixels taken as equal parts; later passes of a level are not counted.
fn whole(step: &v1::Step, share: f64, levels: u32) -> f64 {
    let before = levels.saturating_sub(step.level);
    let here = if step.pass > 0 && step.level > 0 { 1.0 } else { share };
    (f64::from(before) + here) / f64::from(levels + 1)
}

/// Time left if the rest goes as the part before; `None` when too little of it is done to tell.
fn remaining(elapsed: Duration, share: f64) -> Option<Duration> {
    let known = (SHARE_MIN..=1.0).contains(&share) && elapsed >= TIME_MIN;
    known.then(|| elapsed.mul_f64((1.0 - share) / share))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_counts_ranks_and_tiles() {
        let step = v1::Step { level: 2, rank_from: rounds::RANKS / 2, rank_to: rounds::RANKS, ..Default::default() };
        let progress =
            v1::FrameProgress { step: Some(step.clone()), tiles_done: 1, tiles_total: 4, ..Default::default() };
        assert_eq!(share(&progress, 1), 0.625f64.sqrt());
        let again = v1::Step { pass: 1, ..step };
        assert_eq!(share(&v1::FrameProgress { step: Some(again), ..progress.clone() }, 1), 0.625);
        // A large picture looks at other ranks in each pass.
        let large = v1::Step { level: 2, pass: 1, rank_from: 2048 + 64, rank_to: 2048 + 128, ..Default::default() };
        assert_eq!(share(&v1::FrameProgress { step: Some(large), ..progress.clone() }, 512 * 512), 0.3125);
        let pixels = v1::FrameProgress { step: Some(v1::Step::default()), ..progress };
        assert_eq!(share(&pixels, 1), 0.25);
    }

    #[test]
    fn the_whole_only_grows() {
        let step = |level, pass| v1::Step { level, pass, ..Default::default() };
        let shown = [(step(2, 0), 0.5), (step(2, 1), 0.1), (step(1, 0), 0.0), (step(1, 2), 0.9), (step(0, 0), 1.0)];
        let shown = shown.map(|(step, share)| (600.0 * whole(&step, share, 2)).round());
        assert_eq!(shown, [100.0, 200.0, 200.0, 400.0, 600.0]);
        assert_eq!(whole(&step(0, 0), 0.5, 0), 0.5);
    }

    #[test]
    fn time_left_is_only_told_when_something_is_known() {
        let s = Duration::from_secs;
        assert_eq!(remaining(s(10), 0.25), Some(s(30)));
        assert_eq!(remaining(s(10), 1.0), Some(s(0)));
        assert_eq!(remaining(s(10), 0.0), None);
        assert_eq!(remaining(Duration::from_millis(10), 0.5), None);
    }
}
