//! Laws of the frames, whatever workers do: random interleavings of leasing, completing, dying, falling silent and
//! completing too late.

use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use cache_core::rounds::{Plan, Step};
use cache_proto::convert;
use cache_proto::v1::frame_event::Event;
use proptest::prelude::*;

use super::*;
use crate::frame::UNDELIVERED_MAX;
use crate::spec::tests::spec;

/// Enough that leases are ranges of several tiles, cut and put back.
const TILES: u32 = 23;

/// What happens next; the numbers pick a worker, a lease, a time in ms.
#[derive(Clone, Debug)]
enum Act {
    Lease(u8),
    Complete(usize),
    CompleteLost(usize),
    Renew(u8),
    Leave(u8),
    Pass(u64),
    Listen,
}

fn acts() -> impl Strategy<Value = Vec<Act>> {
    let act = prop_oneof![
        8 => (0..4u8).prop_map(Act::Lease),
        6 => any::<usize>().prop_map(Act::Complete),
        2 => any::<usize>().prop_map(Act::CompleteLost),
        1 => (0..4u8).prop_map(Act::Renew),
        1 => (0..4u8).prop_map(Act::Leave),
        2 => (0..4000u64).prop_map(Act::Pass),
        2 => Just(Act::Listen),
    ];
    prop::collection::vec(act, 0..400)
}

/// What a tile gathers in a step: the same whoever does it. In the second pass one tile alone decides whether there is a
/// third, so that no lease's count may be lost; then nothing, so that levels end.
fn gathers(step: &v1::Step, tile: u32) -> u64 {
    match (step.level, step.pass) {
        (0, _) | (_, 2..) => 0,
        (_, 1) => u64::from(step.rank_from == 0 && tile == TILES / 2),
        _ => u64::from((step.index + tile) % 3),
    }
}

/// The steps a frame must go through, and what each gathers.
fn model(levels: u32) -> Vec<(Step, u64)> {
    let (mut plan, mut all, mut last) = (Plan::new(levels, false, 1), Vec::new(), 0);
    while let Some(step) = plan.next(last) {
        let wire = convert::step(all.len() as u32, &step, 0, Default::default());
        last = (0..TILES).map(|tile| gathers(&wire, tile)).sum();
        all.push((step, last));
    }
    all
}

struct Farm {
    frames: Frames,
    frame: u64,
    now: Duration,
    /// Length of the log: grows with every lease, so that a step's mark tells when it was taken.
    log: Cell<u64>,
    held: Vec<(String, v1::Lease)>,
    lost: Vec<(String, v1::Lease)>,
    /// Steps seen, by index, with the tiles done in each and what they gathered.
    steps: BTreeMap<u32, (v1::Step, BTreeSet<u32>, u64)>,
    tiles: BTreeSet<u32>,
    losses: u32,
    done: Option<v1::FrameDone>,
}

impl Farm {
    fn new(levels: u32) -> Self {
        let mut frames = Frames::new(Limits::default(), 1);
        let frame = opened(&mut frames, spec(TILES, levels)).expect("room");
        Self {
            frames,
            frame,
            now: Duration::ZERO,
            log: Cell::new(0),
            held: vec![],
            lost: vec![],
            steps: BTreeMap::new(),
            tiles: BTreeSet::new(),
            losses: 0,
            done: None,
        }
    }

    fn act(&mut self, act: &Act) {
        let name = |w: &u8| format!("worker {w}");
        match act {
            Act::Lease(w) => drop(self.lease(&name(w))),
            Act::Complete(i) if !self.held.is_empty() => {
                let (worker, lease) = self.held.swap_remove(i % self.held.len());
                assert!(self.complete(&worker, &lease), "a lease that is held is accepted");
                assert!(!self.complete(&worker, &lease), "only once");
            }
            Act::CompleteLost(i) if !self.lost.is_empty() => {
                let (worker, lease) = self.lost[i % self.lost.len()].clone();
                assert!(!self.complete(&worker, &lease), "a lost lease is not accepted");
            }
            Act::Renew(w) => {
                let mine = self.held.iter().filter(|h| h.0 == name(w)).map(|h| h.1.id).collect();
                let mut kept = self.frames.renew(&name(w), &mine, self.now);
                kept.sort_unstable();
                let mut held: Vec<_> = self.held.iter().filter(|h| h.0 == name(w)).map(|h| h.1.id).collect();
                held.sort_unstable();
                assert_eq!(kept, held);
            }
            Act::Leave(w) => {
                self.frames.leave(&name(w));
                self.lose(|worker, _| worker == name(w));
            }
            Act::Pass(ms) => {
                self.now += Duration::from_millis(*ms);
                let before: BTreeSet<u64> = self.kept();
                self.frames.tick(self.now);
                let after = self.kept();
                assert!(after.is_subset(&before));
                self.lose(|_, lease| !after.contains(&lease));
            }
            Act::Listen => self.listen(),
            Act::Complete(_) | Act::CompleteLost(_) => (),
        }
    }

    /// Leases the frames think are held.
    fn kept(&self) -> BTreeSet<u64> {
        let round = self.frames.frames[&self.frame].round();
        let held = |w| round.map_or(vec![], |round| round.held_by(&format!("worker {w}")).collect());
        (0..4).flat_map(held).collect()
    }

    fn lose(&mut self, lost: impl Fn(&str, u64) -> bool) {
        let (lost, held): (Vec<_>, Vec<_>) = self.held.drain(..).partition(|(worker, lease)| lost(worker, lease.id));
        self.losses += lost.len() as u32;
        self.held = held;
        self.lost.extend(lost);
    }

    fn lease(&mut self, worker: &str) -> bool {
        let Some(lease) = self.frames.lease(&Tenant::default(), worker, 1, self.now).expect("room") else {
            return false;
        };
        self.log.set(self.log.get() + 1);
        let step = lease.step.clone().expect("a step");
        assert!(lease.tile_from < lease.tile_to && lease.tile_to <= TILES);
        for index in 0..step.index {
            assert_eq!(self.steps[&index].1.len(), TILES as usize, "step {index} is complete before {}", step.index);
        }
        let seen = self.steps.entry(step.index).or_insert_with(|| (step.clone(), BTreeSet::new(), 0));
        assert_eq!(seen.0, step, "every lease of a step is told the same");
        self.held.push((worker.into(), lease));
        true
    }

    fn complete(&mut self, worker: &str, lease: &v1::Lease) -> bool {
        let step = lease.step.clone().expect("a step");
        let tiles = lease.tile_from..lease.tile_to;
        let pixels = |tile| v1::FrameTile { tile, pixels: vec![0; 4 * 4 * 3].into() };
        let gathered = tiles.clone().map(|tile| gathers(&step, tile)).sum();
        let request = v1::CompleteRequest {
            worker: worker.into(),
            lease: lease.id,
            frame: lease.frame,
            gathered,
            tiles: if step.level == 0 { tiles.clone().map(pixels).collect() } else { vec![] },
            counts: vec![v1::Count { name: "rays".into(), value: tiles.len() as f64 }],
            worked_seconds: 0.0,
            used: None,
        };
        let position = self.log.get();
        let mark = |_: &Namespace, _| Mark { position, ..Mark::default() };
        let accepted = self.frames.complete(request, self.now, mark).expect("sound");
        if accepted {
            let seen = self.steps.get_mut(&step.index).expect("leased before");
            assert!(tiles.into_iter().all(|tile| seen.1.insert(tile)), "each tile is done once");
            seen.2 += gathered;
            let round = self.frames.frames[&self.frame].round().filter(|round| round.step().index == step.index);
            assert!(round.is_none_or(|round| round.gathered() == seen.2), "only what was accepted counts");
        }
        accepted
    }

    fn listen(&mut self) {
        while let News::Tell(event) = self.frames.news(self.frame, |_, _| Mark::default()) {
            assert!(self.done.is_none(), "nothing is told after the end");
            match event.event.expect("an event") {
                Event::Tile(tile) => assert!(self.tiles.insert(tile.tile), "each tile is delivered once"),
                Event::Done(done) => self.done = Some(done),
                _ => (),
            }
        }
    }

    /// The workers left behave, and the frame ends.
    fn finish(&mut self) {
        self.act(&Act::Pass(7000));
        while self.lease("worker 0") {
            self.act(&Act::Complete(0));
        }
        self.frames.published(self.frame);
        self.listen();
    }
}

proptest! {
    #[test]
    fn the_farm_does_not_change_the_frame(acts in acts(), levels in 0..3u32) {
        let mut farm = Farm::new(levels);
        for act in &acts {
            farm.act(act);
        }
        farm.finish();

        let done = farm.done.clone().expect("the frame ended");
        let steps: Vec<_> = farm.steps.values().map(|(step, _, gathered)| (convert::plan_step(step), *gathered)).collect();
        prop_assert_eq!(&steps, &model(levels), "same steps, same sums");
        prop_assert!(farm.steps.values().all(|(_, tiles, _)| tiles.len() == TILES as usize));
        prop_assert_eq!(farm.tiles.len(), TILES as usize);
        prop_assert_eq!(done.leases_lost, farm.losses);
        prop_assert_eq!(done.rounds as usize, steps.len() - 1);
        let begins = |(step, _): &&(Step, u64)| matches!(step, Step::Fill { level: 1, ranks, .. } if ranks.start == 0);
        prop_assert_eq!(done.passes as usize, steps.iter().filter(begins).count());
        prop_assert_eq!(done.counts, vec![v1::Count { name: "rays".into(), value: (steps.len() as u32 * TILES).into() }]);
        let sealed: Vec<_> = farm.steps.values().map(|(step, ..)| step.sealed_position).collect();
        prop_assert!(sealed.is_sorted(), "each step reads what the one before left");
    }
}

fn lease(frames: &mut Frames, worker: &str, seconds: u64) -> Option<v1::Lease> {
    frames.lease(&Tenant::default(), worker, 1, Duration::from_secs(seconds)).expect("room")
}

fn opened(frames: &mut Frames, spec: v1::FrameSpec) -> Result<u64, Refusal> {
    let job = Job::check(spec).expect("sound");
    let origin = Origin { tenant: Tenant::default(), base: Mark::default(), draft: job.namespace, filled: false };
    frames.open(job, origin, |_, _| Mark::default())
}

fn open(frames: &mut Frames, tiles: u32, levels: u32) -> u64 {
    opened(frames, spec(tiles, levels)).expect("room")
}

fn complete(frames: &mut Frames, worker: &str, lease: &v1::Lease, bytes: usize) -> Result<bool, Refusal> {
    complete_at(frames, worker, lease, bytes, Duration::ZERO)
}

fn complete_at(
    frames: &mut Frames,
    worker: &str,
    lease: &v1::Lease,
    bytes: usize,
    now: Duration,
) -> Result<bool, Refusal> {
    let tile = |tile| v1::FrameTile { tile, pixels: vec![0; bytes].into() };
    let request = v1::CompleteRequest {
        worker: worker.into(),
        lease: lease.id,
        frame: lease.frame,
        tiles: (lease.tile_from..lease.tile_to).map(tile).collect(),
        worked_seconds: now.as_secs_f64(),
        ..Default::default()
    };
    frames.complete(request, now, |_, _| Mark::default())
}

#[test]
fn leases_shrink_as_work_runs_out_and_lost_tiles_are_given_first() {
    let mut frames = Frames::new(Limits::default(), 1);
    open(&mut frames, 64, 0);
    let range = |lease: Option<v1::Lease>| lease.map(|l| l.tile_from..l.tile_to);
    assert_eq!(range(lease(&mut frames, "a", 0)), Some(0..32));
    assert_eq!(range(lease(&mut frames, "b", 0)), Some(32..40));
    frames.leave("a");
    assert!(frames.take_changes().work);
    assert_eq!(range(lease(&mut frames, "b", 0)), Some(0..28));
    assert_eq!(range(lease(&mut frames, "b", 0)), Some(28..32));
}

/// Each thread wants its share.
#[test]
fn a_worker_of_many_threads_gets_smaller_leases() {
    let mut frames = Frames::new(Limits::default(), 1);
    open(&mut frames, 64, 0);
    let mut tiles = |worker, threads| {
        let lease = frames.lease(&Tenant::default(), worker, threads, Duration::ZERO).expect("room").expect("work");
        lease.tile_to - lease.tile_from
    };
    assert_eq!([tiles("a", 8), tiles("a", 8)], [4, 3]);
    assert_eq!([tiles("b", 0), tiles("c", u32::MAX)], [3, 1]);
}

/// Ranges of tiles leased to a worker of two threads, round by round, until there are pixels to make. Every round tests a pixel
/// of each of the `tiles`; `took` says how many seconds the worker claims to have worked on one.
fn shared(tiles: u32, took: impl Fn(u32) -> f64) -> Vec<Vec<Range<u32>>> {
    let mut frames = Frames::new(Limits::default(), 1);
    opened(&mut frames, v1::FrameSpec { width: 64, height: 64 * tiles, tile_size: 64, ..spec(1, 1) }).expect("room");
    let (mut rounds, mut now) = (BTreeMap::<u32, Vec<_>>::new(), Duration::ZERO);
    while let Some(work) = frames.lease(&Tenant::default(), "a", 2, now).expect("room") {
        let step = work.step.as_ref().expect("a step");
        if step.level == 0 {
            break;
        }
        now += Duration::from_secs(10);
        let range = work.tile_from..work.tile_to;
        let request = v1::CompleteRequest {
            worker: "a".into(),
            lease: work.id,
            frame: work.frame,
            worked_seconds: range.clone().map(&took).sum(),
            ..Default::default()
        };
        assert!(frames.complete(request, now, |_, _| Mark::default()).expect("sound"));
        rounds.entry(step.index).or_default().push(range);
    }
    rounds.into_values().collect()
}

/// As a picture with sky above and one window below.
#[test]
fn a_round_is_shared_by_what_tiles_took_before() {
    let rounds = shared(64, |tile| if tile == 60 { 0.9 } else { 1e-4 });
    let last = rounds.last().expect("rounds");
    let hardest = last.iter().find(|range| range.contains(&60)).expect("somebody does it");
    assert!(hardest.len() <= 4 && last.len() <= 8, "{last:?}");
}

#[test]
fn leases_are_as_long_as_the_work_takes_however_long_it_waits() {
    // Ten milliseconds of work, or half of an equal share where that is more.
    let tenths = |took: f64| shared(40, |_| took).last().expect("rounds").iter().map(Range::len).collect::<Vec<_>>();
    assert_eq!(tenths(1e-3), [10, 10, 10, 10]);
    assert_eq!(tenths(1.9e-3), [10, 7, 5, 5, 5, 5, 3]);
    assert_eq!(tenths(0.2), [10, 7, 5, 4, 3, 2, 2, 1, 1, 1, 1, 1, 1, 1]);
}

/// Nobody works longer than it has a lease: else all other work would seem nothing.
#[test]
fn a_worker_that_lies_takes_no_work_from_others() {
    let rounds = shared(64, |tile| if tile == 63 { 1e9 } else { 1.0 });
    assert!(rounds.last().expect("rounds").len() > 5, "{rounds:?}");
}

#[test]
fn a_lease_has_something_to_do() {
    let mut frames = Frames::new(Limits::default(), 1);
    // Tiles of 4 x 4 pixels in a row: the first round tests one pixel of the first tile, and then of every 16th.
    open(&mut frames, 64, 1);
    let range = |lease: Option<v1::Lease>| lease.map(|l| l.tile_from..l.tile_to);
    assert_eq!(range(lease(&mut frames, "a", 0)), Some(0..32));
    assert_eq!(range(lease(&mut frames, "b", 0)), Some(32..48));
    frames.leave("a");
    assert_eq!(range(lease(&mut frames, "b", 0)), Some(0..16));
    assert_eq!(range(lease(&mut frames, "c", 0)), Some(16..32));
    // The pattern fits no other tiles, and the rows below the picture are nobody's.
    let odd = v1::FrameSpec { width: 64 * 5, height: 5, tile_size: 5, ..spec(1, 1) };
    opened(&mut frames, odd).expect("room");
    assert_eq!(range(lease(&mut frames, "d", 0)), Some(48..64));
    assert_eq!(range(lease(&mut frames, "d", 0)), Some(0..10));
}

#[test]
fn workers_that_wait_are_woken_for_work_alone() {
    let mut frames = Frames::new(Limits::default(), 1);
    open(&mut frames, 2, 0);
    let held = [0, 1].map(|_| lease(&mut frames, "a", 0).expect("work"));
    assert_eq!(lease(&mut frames, "b", 0), None);
    frames.take_changes();
    assert!(complete(&mut frames, "a", &held[0], 4 * 4 * 3).expect("sound"));
    assert!(!frames.take_changes().work, "all tiles are leased");
}

#[test]
fn a_lease_lives_six_seconds_from_its_last_renewal() {
    let mut frames = Frames::new(Limits::default(), 1);
    open(&mut frames, 1, 0);
    let first = lease(&mut frames, "a", 0).expect("work");
    assert_eq!(frames.renew("a", &BTreeSet::from([first.id]), Duration::from_secs(5)), [first.id]);
    frames.tick(Duration::from_secs(10));
    assert_eq!(lease(&mut frames, "b", 10), None);
    frames.tick(Duration::from_secs(11));
    assert!(frames.renew("a", &BTreeSet::from([first.id]), Duration::from_secs(11)).is_empty());
    assert!(lease(&mut frames, "b", 11).is_some());
    assert_eq!(frames.workers(), 2);
    frames.tick(Duration::from_secs(26));
    assert_eq!(frames.workers(), 0);
}

#[test]
fn older_frames_come_first_and_a_worker_that_declined_gets_the_next() {
    let mut frames = Frames::new(Limits::default(), 1);
    let (old, new) = (open(&mut frames, 4, 0), open(&mut frames, 4, 0));
    assert_eq!(lease(&mut frames, "a", 0).expect("work").frame, old);
    let reason = "no such file".repeat(1000);
    let decline = v1::DeclineRequest { worker: "a".into(), frame: old, reason, for_all: false };
    frames.decline(decline, Duration::ZERO).expect("told");
    assert_eq!(lease(&mut frames, "a", 0).expect("work").frame, new);
    assert_eq!(lease(&mut frames, "b", 0).map(|l| (l.frame, l.tile_from)), Some((old, 0)));
    let mut declined = None;
    while let News::Tell(event) = frames.news(old, |_, _| Mark::default()) {
        if let Some(Event::Declined(d)) = event.event {
            declined = Some(d);
        }
    }
    let declined = declined.expect("told");
    assert_eq!((declined.worker.as_str(), declined.reason.len()), ("a", 1024));

    frames.close(old);
    assert!(matches!(frames.frame(&Tenant::default(), old).map(Frame::job), Err(Refusal::NoFrame(_))));
    assert!(frames.renew("b", &BTreeSet::new(), Duration::ZERO).is_empty());
}

#[test]
fn pixels_wait_for_an_owner_that_does_not_read() {
    let mut frames = Frames::new(Limits::default(), 1);
    let big = v1::FrameSpec { width: 256 * 64, height: 256, tile_size: 256, ..spec(1, 0) };
    let frame = opened(&mut frames, big).expect("room");
    let bytes = 256 * 256 * 64;
    let mut done = 0;
    while let Some(work) = lease(&mut frames, "a", 0) {
        assert_eq!(work.tile_to - work.tile_from, 1, "one tile fills a message");
        assert!(complete(&mut frames, "a", &work, bytes).expect("sound"));
        done += 1;
    }
    assert_eq!(done, UNDELIVERED_MAX / bytes);
    frames.take_changes();
    while !frames.take_changes().work {
        assert!(matches!(frames.news(frame, |_, _| Mark::default()), News::Tell(_)));
    }
    assert!(lease(&mut frames, "a", 0).is_some());
}

#[test]
fn what_a_worker_says_wrong_is_named_and_its_lease_stays() {
    let mut frames = Frames::new(Limits::default(), 1);
    open(&mut frames, 8, 0);
    let work = lease(&mut frames, "a", 0).expect("work");
    let named = |result: Result<bool, Refusal>, field: &str| {
        let message = result.expect_err(field).to_string();
        assert!(message.starts_with(field), "{message}");
    };
    let none = v1::Lease { tile_to: work.tile_from, ..work.clone() };
    named(complete(&mut frames, "a", &none, 48), "tiles: has 0");
    named(complete(&mut frames, "a", &work, 49), "tiles: tile 0 has 49");
    named(complete(&mut frames, "a", &work, 0), "tiles: tile 0 has 0");
    named(complete(&mut frames, "a", &work, 12 * 68), "tiles: tile 0 has 816");
    let saying = |gathered, name: &str, value| v1::CompleteRequest {
        worker: "a".into(),
        lease: work.id,
        frame: work.frame,
        gathered,
        tiles: (work.tile_from..work.tile_to).map(|tile| v1::FrameTile { tile, pixels: vec![0; 48].into() }).collect(),
        counts: vec![v1::Count { name: name.into(), value }],
        worked_seconds: 0.0,
        used: None,
    };
    let mut say = |request| frames.complete(request, Duration::ZERO, |_, _| Mark::default());
    named(say(saying(u64::MAX, "rays", 1.0)), "gathered");
    named(say(saying(0, "rays", f64::NAN)), "counts.value");
    named(say(saying(0, &"x".repeat(65), 1.0)), "counts.name");
    for worked_seconds in [-1.0, f64::NAN, 1e300] {
        named(say(v1::CompleteRequest { worked_seconds, ..saying(0, "rays", 1.0) }), "worked_seconds");
    }
    let using = |host: &str, round_trip_seconds| {
        let used = Some(v1::HostUse { host: host.into(), round_trip_seconds, ..Default::default() });
        v1::CompleteRequest { used, ..saying(0, "rays", 1.0) }
    };
    named(say(using(&"x".repeat(65), 0.0)), "used.host");
    for seconds in [-1.0, f64::NAN, f64::MAX] {
        named(say(using("x", seconds)), "used.round_trip_seconds");
    }
    assert!(!say(v1::CompleteRequest { worker: "b".into(), ..saying(0, "rays", 1.0) }).expect("not b's"));
    assert!(say(saying(0, "rays", 1.0)).expect("sound"));
}

#[test]
fn an_owner_is_asked_for_the_scene_once() {
    let mut frames = Frames::new(Limits::default(), 1);
    let frame = open(&mut frames, 4, 0);
    let asked = |frames: &mut Frames| {
        let mut asked = 0;
        while let News::Tell(event) = frames.news(frame, |_, _| Mark::default()) {
            asked += usize::from(matches!(event.event, Some(v1::frame_event::Event::SceneWanted(_))));
        }
        asked
    };
    assert_eq!(asked(&mut frames), 0);
    frames.want_scene(frame);
    frames.want_scene(frame);
    assert!(frames.take_changes().news);
    assert_eq!(asked(&mut frames), 1);
    frames.want_scene(frame);
    assert_eq!(asked(&mut frames), 0);
}

#[test]
fn lists_are_bounded() {
    let mut frames = Frames::new(Limits::default(), 1);
    for _ in 0..Limits::default().frames {
        open(&mut frames, 4000, 0);
    }
    assert!(matches!(opened(&mut frames, spec(1, 0)), Err(Refusal::Full { what: "frames", .. })));
    for worker in 0..Limits::default().workers {
        lease(&mut frames, &worker.to_string(), 0);
    }
    let mut asks = |worker| frames.lease(&Tenant::default(), worker, 1, Duration::ZERO);
    assert!(matches!(asks("one more"), Err(Refusal::Full { what: "workers", .. })));
    for _ in 1..Limits::default().leases {
        assert!(matches!(asks("0"), Ok(Some(_))));
    }
    assert!(matches!(asks("0"), Err(Refusal::Full { .. })));
}

#[test]
fn a_tenants_workers_and_others_do_not_meet() {
    let mut frames = Frames::new(Limits::default(), 1);
    let frame = open(&mut frames, 4, 0);
    let other = Tenant::from("other");
    assert_eq!(frames.lease(&other, "other/a", 1, Duration::ZERO).expect("room"), None);
    assert!(matches!(frames.frame(&other, frame).map(Frame::job), Err(Refusal::NoFrame(_))));
    assert!(lease(&mut frames, "a", 0).is_some());
}

#[test]
fn a_step_reads_what_lower_steps_gathered_and_a_filled_draft_is_told_once() {
    let mut frames = Frames::new(Limits::default(), 1);
    let job = Job::check(spec(1, 1)).expect("sound");
    let base = Mark { position: 7, sum: cache_core::set::Sum { records: 7, digest: cache_core::id::Digest(70) } };
    let draft = Namespace([9; 32]);
    // Each step gathers one record, of a digest that is the step.
    let state = |step: u32| Mark {
        position: 100,
        sum: cache_core::set::Sum { records: step.into(), digest: cache_core::id::Digest(step.into()) },
    };
    let mark = |of: &Namespace, step: u32| {
        assert_eq!(*of, draft);
        state(step)
    };
    let namespace = job.namespace;
    let frame = frames.open(job, Origin { tenant: Tenant::default(), base, draft, filled: false }, mark).expect("room");
    let (mut filled, mut steps) = (vec![], 0);
    while let Some(work) = lease(&mut frames, "a", 0) {
        let step = work.step.expect("a step");
        assert_eq!(convert::digest(&step.sealed_digest).expect("16 bytes"), state(step.index).sum.digest);
        assert_eq!(step.sealed_position, 100);
        let pixels = v1::FrameTile { tile: 0, pixels: vec![0; 4 * 12].into() };
        let tiles = if step.level == 0 { vec![pixels] } else { vec![] };
        let (lease, frame) = (work.id, work.frame);
        let request = v1::CompleteRequest { worker: "a".into(), lease, frame, tiles, ..Default::default() };
        assert!(frames.complete(request, Duration::ZERO, mark).expect("sound"));
        filled.extend(frames.take_changes().filled.map(|filled| (filled, step.index)));
        steps = step.index;
    }
    assert_eq!(filled, [(Filled { frame, draft, namespace }, steps - 1)]);
    let mut told = vec![];
    let hear = |frames: &mut Frames, told: &mut Vec<_>| {
        while let News::Tell(event) = frames.news(frame, mark) {
            told.extend(event.event);
        }
    };
    hear(&mut frames, &mut told);
    assert!(matches!(told.last(), Some(Event::Tile(_))), "done before its records are published: {told:?}");
    frames.published(frame);
    assert!(frames.take_changes().news);
    hear(&mut frames, &mut told);
    assert!(matches!(&told[0], Event::Opened(opened) if opened.base_records == 7 && opened.base[0] == 70));
    let Some(Event::Done(done)) = told.last() else { panic!("{told:?}") };
    assert_eq!(done.records, 7 + u64::from(steps));
    assert_eq!(convert::digest(&done.digest).expect("16 bytes").0, 70 + u128::from(steps));
}

#[test]
fn a_frame_whose_base_is_filled_makes_pixels_alone_and_publishes_nothing() {
    let mut frames = Frames::new(Limits::default(), 1);
    let job = Job::check(spec(1, 3)).expect("sound");
    let (base, draft) = (Mark::default(), Namespace([9; 32]));
    let origin = Origin { tenant: Tenant::default(), base, draft, filled: true };
    let frame = frames.open(job, origin, |_, _| Mark::default()).expect("room");
    let work = lease(&mut frames, "a", 0).expect("work");
    assert_eq!(work.step.as_ref().map(|step| (step.index, step.level)), Some((0, 0)));
    let tiles = vec![v1::FrameTile { tile: 0, pixels: vec![0; 4 * 12].into() }];
    let request =
        v1::CompleteRequest { worker: "a".into(), lease: work.id, frame: work.frame, tiles, ..Default::default() };
    assert!(frames.complete(request, Duration::ZERO, |_, _| Mark::default()).expect("sound"));
    assert_eq!(frames.take_changes().filled, None);
    let mut told = vec![];
    while let News::Tell(event) = frames.news(frame, |_, _| Mark::default()) {
        told.extend(event.event);
    }
    assert!(matches!(&told[0], Event::Opened(opened) if opened.filled));
    assert!(matches!(told.last(), Some(Event::Done(done)) if done.rounds == 0), "{told:?}");
}

#[test]
fn a_lease_its_worker_never_heard_of_runs_out() {
    let mut frames = Frames::new(Limits::default(), 1);
    open(&mut frames, 8, 0);
    let heard = lease(&mut frames, "a", 0).expect("work");
    let unheard = lease(&mut frames, "a", 0).expect("work");
    frames.renew("a", &BTreeSet::from([heard.id]), Duration::from_secs(5));
    frames.tick(Duration::from_secs(7));
    assert_eq!(frames.renew("a", &BTreeSet::from([heard.id, unheard.id]), Duration::from_secs(7)), [heard.id]);
}
