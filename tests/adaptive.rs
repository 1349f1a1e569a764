//! Adaptive caching: what it buys, and that the farm does not change it.

use std::sync::Arc;

use ambience_bench::judge::{judge, load, reference, rgb, settings};
use cache_core::details::Details;
use cache_core::rounds::RANKS;
use cache_proto::v1;
use cache_proto::v1::frame_event::Event;
use cache_server::{Config, Node, serve_on};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use worker::client::{self, Line};
use worker::farm::Worker;
use worker::frame::Frame;
use worker::settings::Settings;
use worker::solo::{self, Filled, Order};
use worker::spec;
use worker::traffic::Traffic;

fn adaptive() -> Details {
    Details { adaptive: true, ..Details::default() }
}

/// Where records lie too far apart for the light, adaptive caching puts more.
#[test]
fn records_go_where_the_light_changes() {
    let truth = reference("stairs.full");
    let rendered = |a: f32, details: Details| {
        let (scene, camera) = load("stairs.glb");
        let frame = Frame::new(scene, Settings { a, rays: 1024, spp: 16, details, ..settings(camera, "full") });
        let filled = solo::fill_ranks(&frame, Order::Rounds, RANKS);
        let pixels = solo::pixels(&frame, &filled.levels).0;
        let image = rgb(&pixels);
        let (records, error) = (filled.levels.iter().map(|level| level.len()).sum::<usize>(), judge(&image, &truth));
        println!("a {a} {}: {records} records, {error:?}, {} passes", details.adaptive, filled.passes);
        error.rmse
    };
    let (plain, adapted) = (rendered(0.6, Details::default()), rendered(0.6, adaptive()));
    assert!(adapted < 0.9 * plain, "{adapted} {plain}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_picture_does_not_depend_on_the_farm() {
    let frame = || {
        let (scene, camera) = load("cornell.glb");
        Frame::new(scene, Settings { details: adaptive(), a: 0.6, rays: 64, spp: 1, ..Settings::new(camera, 64, 64) })
    };
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/scenes/cornell.glb");
    let alone = frame();
    let Filled { levels, proposals, passes, .. } = solo::fill_ranks(&alone, Order::Rounds, RANKS);
    assert!(proposals > 100 && passes > 8, "{proposals} proposals in {passes} passes");
    let floats = |tile| alone.pixels(tile, &levels).0;
    let expected: Vec<Vec<u8>> = (0..alone.settings().tiles())
        .map(|tile| floats(tile).into_iter().flat_map(f32::to_le_bytes).collect())
        .collect();
    let spec = spec::message(&alone, path, &load("cornell.glb").0.hash);
    for workers in [1, 3] {
        let (tiles, done) = farmed(spec.clone(), workers).await;
        assert!(tiles == expected, "{workers} workers make another picture");
        let counted = done.counts.iter().find(|count| count.name == "proposals").map(|count| count.value as u64);
        assert!(counted >= Some(proposals) && done.passes == passes, "{counted:?} proposals in {} passes", done.passes);
    }
}

/// Renders a frame with a server and workers of its own.
async fn farmed(spec: v1::FrameSpec, workers: usize) -> (Vec<Vec<u8>>, v1::FrameDone) {
    let (connections, accepted) = mpsc::channel::<std::io::Result<_>>(8);
    let line: Line = client::connect_with(move || {
        let connections = connections.clone();
        async move {
            let (near, far) = tokio::io::duplex(1 << 16);
            connections.send(Ok(far)).await.map_err(std::io::Error::other)?;
            Ok(near)
        }
    });
    let node = Node::new(Config::default()).expect("nothing to read");
    let mut tasks = tokio::task::JoinSet::new();
    let ticking = node.clone();
    tasks.spawn(async move { match ticking.tick().await {} });
    tasks.spawn(async move {
        drop(serve_on(node, ReceiverStream::new(accepted), std::future::pending()).await);
    });
    for number in 0..workers {
        let worker = Arc::new(Worker::<Frame>::new(format!("w{number}"), line.clone(), Traffic::default()));
        tasks.spawn(async move { drop(worker.work(1 + number % 2).await) });
    }
    let request = v1::OpenRequest { spec: Some(spec), ..Default::default() };
    let mut events = client::frames(line).open(request).await.expect("opened").into_inner();
    let mut tiles = std::collections::BTreeMap::new();
    loop {
        match events.message().await.expect("told").and_then(|event| event.event).expect("an end") {
            Event::Tile(tile) => drop(tiles.insert(tile.tile, tile.pixels.to_vec())),
            Event::Declined(declined) => panic!("{} declined: {}", declined.worker, declined.reason),
            Event::Done(done) => return (tiles.into_values().collect(), done),
            _ => (),
        }
    }
}
