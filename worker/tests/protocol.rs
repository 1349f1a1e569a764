//! What a worker does when its server is lost, replaced, full or shut: real client code, a scripted server.

mod script;

use std::sync::Arc;
use std::time::Duration;

use cache_core::id::Digest;
use cache_core::{Irradiance, Namespace, Record, RecordId, Tag};
use cache_proto::{convert, v1};
use glam::{Vec2, Vec3};
use script::{Script, State};
use tonic::{Code, Status};
use worker::client;
use worker::farm::Worker;
use worker::follow::Follower;
use worker::job::{Job, Work};
use worker::scenes::Scenes;
use worker::task::Done;
use worker::traffic::Traffic;

const SCENE: Namespace = Namespace([1; 32]);
const DRAFT: Namespace = Namespace([2; 32]);

fn entry(id: u128, step: u32) -> (Tag, Record) {
    let record = Irradiance {
        id: RecordId(id),
        position: Vec3::ZERO,
        normal: Vec3::Z,
        radius: 1.0,
        radius_min: 0.1,
        radius_max: 3.0,
        irradiance: Vec3::ONE,
        gradient_t: [Vec2::ZERO; 3],
        gradient_r: [Vec2::ZERO; 3],
        ellipse: [0.0; 3],
        noise: 0.0,
    };
    (Tag { level: 1, step }, record.into())
}

fn digest(ids: &[u128]) -> Digest {
    let mut digest = Digest::default();
    ids.iter().for_each(|id| digest.add(RecordId(*id)));
    digest
}

/// Gathers one record a tile, whose id is the number of the tile after 1000.
struct Tiles;

impl Job for Tiles {
    async fn prepare(_: u64, _: &v1::DescribeResponse, _: &Scenes) -> Result<Self, String> {
        Ok(Self)
    }

    fn levels(&self) -> u32 {
        1
    }

    fn a(&self) -> f32 {
        0.3
    }

    async fn run(self: Arc<Self>, work: Work) -> Result<Option<Done>, String> {
        let mut done = Done::default();
        for tile in work.tiles {
            let new = entry(1000 + u128::from(tile), work.step.index);
            match (work.known)(new.1.id()) {
                Some(_) => done.counts.reused += 1,
                None => done.counts.path_rays += 1,
            }
            done.records.push(new);
        }
        // Tells the test what the step could read.
        done.counts.queries = work.levels[0].len() as u64;
        Ok(Some(done))
    }
}

fn described(base: &[u128]) -> v1::DescribeResponse {
    v1::DescribeResponse {
        spec: Some(v1::FrameSpec { namespace: SCENE.0.to_vec().into(), ..Default::default() }),
        draft: DRAFT.0.to_vec().into(),
        base_position: base.len() as u64,
        base_digest: convert::digest_bytes(digest(base)),
    }
}

/// A lease of step `index`, which reads `lower` of the draft, all below `position`.
fn lease(id: u64, frame: u64, index: u32, position: u64, lower: &[u128], tiles: std::ops::Range<u32>) -> v1::Lease {
    let step = v1::Step {
        index,
        level: 1,
        sealed_position: position,
        sealed_digest: convert::digest_bytes(digest(lower)),
        ..Default::default()
    };
    v1::Lease { id, frame, step: Some(step), tile_from: tiles.start, tile_to: tiles.end }
}

fn count(completed: &v1::CompleteRequest, name: &str) -> u64 {
    completed.counts.iter().find(|count| count.name == name).map_or(0, |count| count.value as u64)
}

/// Waits for the completion of a lease; says how many records it could read and reuse.
async fn completed(script: &Script, lease: u64) -> (u64, u64) {
    let found = script.until(|state| state.completed.iter().find(|c| c.lease == lease).cloned()).await;
    (count(&found, "queries"), count(&found, "reused"))
}

fn at_work(channel: worker::client::Line) -> tokio::task::JoinHandle<Status> {
    tokio::spawn(Arc::new(Worker::<Tiles>::new("worker".into(), channel, Traffic::default())).work(1))
}

/// A follower that has read a log of these.
async fn follower(script: &Script, channel: &worker::client::Line, ids: std::ops::Range<u128>) -> Follower {
    let end = ids.end - ids.start;
    script.insert(SCENE, &ids.map(|id| entry(id, 0)).collect::<Vec<_>>());
    let follower = Follower::start(client::cache(channel.clone()), SCENE);
    let dropped: worker::job::Dropped = Arc::new(|| false);
    assert!(follower.reaches(end as u64, &dropped).await.expect("open"));
    follower
}

#[tokio::test(start_paused = true)]
async fn a_server_that_lost_everything_is_refilled_in_order() {
    let (script, channel) = Script::start();
    let follower = follower(&script, &channel, 1..9001).await;
    script.replace(State::default());
    // Not a moment passes in which what was known is not.
    for id in [1, 4097, 9000] {
        assert!(follower.known(RecordId(id)).is_some());
    }
    script.until(|state| state.logs.get(&SCENE).is_some_and(|log| log.len() == 9000).then_some(())).await;
    assert_eq!(script.ids(SCENE), (1..9001).collect::<Vec<_>>());
    assert_eq!(script.with(|state| state.inserts.clone()), [4096, 4096, 808]);
    assert!(follower.known(RecordId(9000)).is_some());
}

#[tokio::test(start_paused = true)]
async fn only_what_is_lacking_is_given_back_and_a_shared_prefix_is_not_read_again() {
    let (script, channel) = Script::start();
    let follower = follower(&script, &channel, 1..101).await;
    // Came back with its disk, and more than before.
    let mut logs = script.with(|state| std::mem::take(&mut state.logs));
    logs.get_mut(&SCENE).map(|log| log.insert(Tag::level(1), entry(500, 0).1));
    script.replace(State { logs, ..State::default() });
    let dropped: worker::job::Dropped = Arc::new(|| false);
    assert!(follower.reaches(101, &dropped).await.expect("open"));
    assert_eq!(script.with(|state| (state.starts.clone(), state.inserts.clone())), (vec![100], vec![]));

    // Came back with another worker's half, in another order.
    let mut log = cache_core::RecordSet::default();
    for id in [500, 60, 3, 700] {
        log.insert(Tag::level(1), entry(id, 0).1);
    }
    script.replace(State { logs: [(SCENE, log)].into(), ..State::default() });
    script.until(|state| state.logs.get(&SCENE).is_some_and(|log| log.len() == 102).then_some(())).await;
    assert_eq!(script.with(|state| (state.starts.clone(), state.inserts.clone())), (vec![0], vec![98]));
    assert_eq!(script.ids(SCENE)[..6], [500, 60, 3, 700, 1, 2]);
    assert!(follower.known(RecordId(700)).is_some());
}

#[tokio::test(start_paused = true)]
async fn a_server_without_room_is_refilled_when_it_has_some() {
    let (script, channel) = Script::start();
    let _follower = follower(&script, &channel, 1..11).await;
    let full = || Status::unavailable("no space left on device");
    script.replace(State { refusals: [full(), Status::unavailable("away"), full()].into(), ..State::default() });
    script.until(|state| state.logs.get(&SCENE).is_some_and(|log| log.len() == 10).then_some(())).await;
}

#[tokio::test(start_paused = true)]
async fn steps_read_base_and_lower_steps_and_a_frame_begun_again_gathers_nothing_twice() {
    let (script, channel) = Script::start();
    // In the base; of a later step of an interrupted attempt; in both.
    script.insert(SCENE, &[entry(1, 0), entry(2, 0), entry(3, 0)]);
    script.insert(DRAFT, &[entry(1001, 1), entry(2, 0)]);
    script.with(|state| {
        state.frames.insert(7, described(&[1, 2]));
        state.leases.push_back(lease(10, 7, 0, 2, &[], 0..1));
    });
    let working = at_work(channel);
    assert_eq!(completed(&script, 10).await, (2, 0));
    script.with(|state| state.leases.push_back(lease(11, 7, 1, 3, &[2, 1000], 1..3)));
    assert_eq!(completed(&script, 11).await, (3, 1));
    assert_eq!(script.ids(DRAFT), [1001, 2, 1000, 1002]);

    // The server loses everything, and the frame is opened again.
    script.replace(State::default());
    script.until(|state| state.logs.get(&SCENE).filter(|log| log.len() == 3).map(drop)).await;
    script.until(|state| state.logs.get(&DRAFT).filter(|log| log.len() == 4).map(drop)).await;
    assert_eq!(script.ids(SCENE)[..2], [1, 2]);
    script.with(|state| {
        state.frames.insert(8, described(&[1, 2]));
        state.leases.push_back(lease(20, 8, 0, 4, &[], 0..1));
        state.leases.push_back(lease(21, 8, 1, 4, &[2, 1000], 1..3));
        state.leases.push_back(lease(22, 8, 2, 4, &[2, 1000, 1001, 1002], 3..4));
    });
    assert_eq!(completed(&script, 20).await, (2, 1));
    assert_eq!(completed(&script, 21).await, (3, 2));
    assert_eq!(completed(&script, 22).await, (5, 0));
    assert!(script.with(|state| state.declined.is_empty()));
    assert!(!working.is_finished());
}

#[tokio::test(start_paused = true)]
async fn what_was_set_aside_is_reused_before_it_is_back() {
    let (script, channel) = Script::start();
    script.with(|state| {
        state.frames.insert(7, described(&[]));
        state.leases.push_back(lease(10, 7, 0, 0, &[], 0..3));
    });
    let _working = at_work(channel);
    completed(&script, 10).await;
    script.with(|state| state.leases.push_back(lease(11, 7, 1, 3, &[1000, 1001, 1002], 3..3)));
    completed(&script, 11).await;

    // No refill succeeds, but the frame goes on all the same; then its own records do not either, for a while.
    let mut state = State { refusals: vec![Status::unavailable("full"); 8].into(), ..State::default() };
    state.frames.insert(8, described(&[]));
    state.leases.push_back(lease(20, 8, 0, 0, &[], 0..4));
    script.replace(state);
    assert_eq!(completed(&script, 20).await, (0, 3));
    assert!(script.with(|state| state.declined.is_empty() && state.refusals.is_empty()));
}

#[tokio::test(start_paused = true)]
async fn records_wait_for_room_and_the_frame_is_not_declined() {
    let (script, channel) = Script::start();
    script.with(|state| {
        state.refusals = vec![Status::unavailable("no space left on device"); 100].into();
        state.frames.insert(7, described(&[]));
        state.leases.push_back(lease(10, 7, 0, 0, &[], 0..2));
    });
    let working = at_work(channel);
    completed(&script, 10).await;
    assert_eq!(script.ids(DRAFT), [1000, 1001]);
    assert!(script.with(|state| state.declined.is_empty() && state.refusals.is_empty()));
    assert!(!working.is_finished());
}

#[tokio::test(start_paused = true)]
async fn a_lease_lost_while_its_records_wait_is_dropped() {
    let (script, channel) = Script::start();
    script.with(|state| {
        state.refusals = vec![Status::unavailable("disk full"); 10_000].into();
        state.frames.insert(7, described(&[]));
        state.leases.push_back(lease(10, 7, 0, 0, &[], 0..2));
    });
    let _working = at_work(channel);
    script.until(|state| (state.refusals.len() < 9_990).then_some(())).await;
    script.with(|state| state.held.clear());
    // It asks for work again, while there is still no room.
    script.with(|state| state.leases.push_back(lease(11, 7, 0, 0, &[], 0..0)));
    completed(&script, 11).await;
    assert!(script.with(|state| !state.refusals.is_empty() && state.completed.len() == 1));
}

#[tokio::test(start_paused = true)]
async fn another_log_under_the_same_connection_is_noticed_by_its_digest() {
    let (script, channel) = Script::start();
    script.insert(DRAFT, &[entry(1000, 0), entry(1001, 0)]);
    script.with(|state| {
        state.frames.insert(7, described(&[]));
        state.leases.push_back(lease(10, 7, 1, 2, &[1000, 1001], 2..3));
    });
    let _working = at_work(channel);
    assert_eq!(completed(&script, 10).await, (2, 0));
    // The same records in another order: the proof of the whole does not tell.
    let mut log = cache_core::RecordSet::default();
    for (tag, record) in [entry(1002, 1), entry(1001, 0), entry(1000, 0)] {
        log.insert(tag, record);
    }
    let mut state = State { logs: [(DRAFT, log)].into(), ..State::default() };
    state.frames.insert(8, described(&[]));
    script.replace(state);
    script.until(|state| (!state.starts.is_empty()).then_some(())).await;
    script.with(|state| state.leases.push_back(lease(20, 8, 1, 2, &[1001], 2..3)));
    assert_eq!(completed(&script, 20).await, (1, 1));
    assert_eq!(script.with(|state| (state.starts.clone(), state.inserts.clone())), (vec![3, 0], vec![1]));

    // A digest that is nobody's: declined, not asked for over and over.
    script.with(|state| state.leases.push_back(lease(21, 8, 2, 3, &[77], 3..4)));
    let reason = script.until(|state| state.declined.first().cloned()).await;
    assert!(reason.starts_with("records up to position 3 have digest"), "{reason}");
}

#[tokio::test(start_paused = true)]
async fn a_published_draft_is_left_alone_until_it_is_wanted_or_lost() {
    let (script, channel) = Script::start();
    let follower = follower(&script, &channel, 1..11).await;
    let published = || State { closed: Some(Status::not_found("published")), ..State::default() };
    script.replace(published());
    tokio::time::sleep(Duration::from_secs(95)).await;
    assert!((4..=5).contains(&script.with(|state| state.asked)));
    // A frame fills it again.
    script.with(|state| state.closed = None);
    script.insert(SCENE, &(1..12).map(|id| entry(id, 0)).collect::<Vec<_>>());
    let (dropped, began): (worker::job::Dropped, _) = (Arc::new(|| false), tokio::time::Instant::now());
    assert!(follower.reaches(11, &dropped).await.expect("open"));
    assert!(began.elapsed() < Duration::from_secs(2));
    // And the server is lost after it was published again.
    script.replace(published());
    script.until(|state| (state.asked > 0).then_some(())).await;
    script.replace(State::default());
    script.until(|state| state.logs.get(&SCENE).filter(|log| log.len() == 11).map(drop)).await;
}

#[tokio::test(start_paused = true)]
async fn a_worker_that_may_not_read_ends_and_says_so() {
    for closed in [Status::permission_denied("not your namespace"), Status::unauthenticated("no token")] {
        let (script, channel) = Script::start();
        script.with(|state| {
            state.closed = Some(closed.clone());
            state.frames.insert(7, described(&[]));
            state.leases.push_back(lease(10, 7, 1, 5, &[], 0..1));
        });
        let ended =
            tokio::time::timeout(Duration::from_secs(60), at_work(channel)).await.expect("ends").expect("no panic");
        assert_eq!((ended.code(), ended.message()), (closed.code(), closed.message()));
        assert!(matches!(ended.code(), Code::PermissionDenied | Code::Unauthenticated));
        assert!(script.with(|state| state.declined.is_empty()));
    }
}
