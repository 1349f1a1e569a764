//! The services as clients see them: over a real Unix socket and over TCP, through the generated client.

use std::convert::Infallible;
use std::time::Duration;

use cache_core::{Irradiance, Namespace, Query, Record, RecordId, Sealed, Shrink, Tag};
use cache_proto::v1::cache_client::CacheClient;
use cache_proto::v1::frame_event::Event;
use cache_proto::v1::frames_client::FramesClient;
use cache_proto::{VERSION, VERSION_KEY, convert, v1};
use cache_server::{Config, Listen, ServeError, bind, serve};
use glam::{Vec2, Vec3};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Status};

const NAMESPACE: Namespace = Namespace([3; 32]);

/// No step of these tests takes near as long; what does has hung.
const PATIENCE: Duration = Duration::from_secs(20);

/// A server in this process, and a connection to it.
struct Server {
    channel: Channel,
    address: Listen,
    stop: oneshot::Sender<()>,
    running: JoinHandle<Result<(), ServeError>>,
    folder: tempfile::TempDir,
}

impl Server {
    async fn start(listen: impl FnOnce(&std::path::Path) -> Listen) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let bound = bind(&listen(folder.path()), false).expect("bound");
        let address = bound.address().clone();
        let (stop, stopped) = oneshot::channel();
        let shutdown = async {
            let _ = stopped.await;
        };
        let running = tokio::spawn(serve(vec![bound], Config::default(), shutdown));
        let uri = match &address {
            Listen::Tcp(address) => format!("http://{address}"),
            unix => unix.to_string(),
        };
        let channel = Endpoint::from_shared(uri).expect("a URI").connect().await.expect("connected");
        Self { channel, address, stop, running, folder }
    }

    async fn unix() -> Self {
        Self::start(|folder| Listen::Unix(folder.join("cache.sock"))).await
    }

    async fn tcp() -> Self {
        Self::start(|_| "127.0.0.1:0".parse().expect("an address")).await
    }

    fn cache(&self) -> CacheClient<Channel> {
        CacheClient::new(self.channel.clone())
    }

    fn frames(&self) -> FramesClient<Channel> {
        FramesClient::new(self.channel.clone())
    }

    async fn stop(self) {
        let _ = self.stop.send(());
        soon(self.running).await.expect("no panic").expect("served");
        if let Listen::Unix(path) = &self.address {
            assert!(!path.exists(), "the socket's file is removed");
        }
        drop(self.folder);
    }
}

async fn soon<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future).await.expect("in time")
}

fn record(id: u32) -> Irradiance {
    let x = (id % 100) as f32 * 0.1;
    Irradiance {
        id: RecordId(u128::from(id) << 64 | 1),
        position: Vec3::new(x, (id / 100) as f32 * 0.1, 0.0),
        normal: Vec3::Z,
        radius: 0.5 + x,
        radius_min: 0.1,
        radius_max: 10.0,
        irradiance: Vec3::new(1.0 + x, 2.0, 3.0),
        gradient_t: [Vec2::new(0.1, 0.2); 3],
        gradient_r: [Vec2::new(0.3, -0.4); 3],
        ellipse: [0.0; 3],
        noise: 0.0,
    }
}

fn records(ids: std::ops::Range<u32>) -> Vec<Irradiance> {
    ids.map(record).collect()
}

async fn insert(cache: &mut CacheClient<Channel>, batches: Vec<v1::RecordBatch>) -> Result<v1::InsertResponse, Status> {
    let requests = batches.into_iter().map(|batch| v1::InsertRequest { batch: Some(batch) });
    let requests: Vec<_> = requests.collect();
    soon(cache.insert(tokio_stream::iter(requests))).await.map(tonic::Response::into_inner)
}

fn subscribe(position: u64) -> v1::SubscribeRequest {
    v1::SubscribeRequest { namespace: NAMESPACE.0.to_vec().into(), position, digest: Default::default() }
}

/// Subscribes; the stream must say that it starts at `from`.
async fn subscribed(
    cache: &mut CacheClient<Channel>,
    request: v1::SubscribeRequest,
    from: u64,
) -> tonic::Streaming<v1::SubscribeResponse> {
    let mut stream = soon(cache.subscribe(request)).await.expect("accepted").into_inner();
    let start = soon(stream.message()).await.expect("no error").expect("no end");
    assert_eq!((start.position, start.batch), (from, None));
    stream
}

/// Reads a subscription until `count` records have come; returns them with their levels.
async fn read(stream: &mut tonic::Streaming<v1::SubscribeResponse>, from: u64, count: usize) -> Vec<(Tag, Record)> {
    let mut all = Vec::new();
    while all.len() < count {
        let response = soon(stream.message()).await.expect("no error").expect("no end");
        assert_eq!(response.position, from + all.len() as u64);
        let batch = response.batch.expect("a batch");
        let (namespace, level, records) = convert::unpack(&batch).expect("sound");
        assert_eq!(namespace, NAMESPACE);
        all.extend(records.into_iter().map(|record| (level, record)));
    }
    all
}

#[tokio::test]
async fn what_is_inserted_is_streamed_counted_and_digested() {
    for server in [Server::unix().await, Server::tcp().await] {
        let mut cache = server.cache();
        // A namespace that is not there yet: the subscriber waits.
        let mut early = subscribed(&mut cache, subscribe(0), 0).await;
        let batches = vec![
            convert::pack(&NAMESPACE, Tag::level(1), &records(0..4096)),
            convert::pack(&NAMESPACE, Tag::level(2), &records(4096..5000)),
        ];
        let added = insert(&mut cache, batches.clone()).await.expect("sound");
        assert_eq!((added.added, added.position), (5000, 5000));
        let again = insert(&mut cache, batches).await.expect("harmless");
        assert_eq!((again.added, again.position), (0, 5000));

        let expected: Vec<_> =
            (0..5000).map(|id| (Tag::level(if id < 4096 { 1 } else { 2 }), record(id).into())).collect();
        assert_eq!(read(&mut early, 0, 5000).await, expected);
        let mut late = subscribed(&mut cache, subscribe(4990), 4990).await;
        assert_eq!(read(&mut late, 4990, 10).await, expected[4990..]);

        let info = soon(cache.info(v1::InfoRequest {})).await.expect("info").into_inner();
        let mut set = cache_core::RecordSet::default();
        for (tag, record) in expected {
            set.insert(tag, record);
        }
        assert_eq!((info.version.as_str(), info.subscribers, info.namespaces.len()), (VERSION, 2, 1));
        assert_eq!((info.namespaces[0].records, info.namespaces[0].conflicts), (5000, 0));
        assert_eq!(info.namespaces[0].digest, convert::digest_bytes(set.digest()));

        let past = soon(cache.subscribe(subscribe(6000))).await.expect_err("past the end");
        assert_eq!(past.code(), Code::OutOfRange);
        assert!(past.message().contains("6000") && past.message().contains("5000"), "{past}");
        server.stop().await;
    }
}

#[tokio::test]
async fn a_bad_batch_is_refused_by_name_and_the_connection_stays_usable() {
    let server = Server::unix().await;
    let mut cache = server.cache();
    let good = convert::pack(&NAMESPACE, Tag::level(1), &records(0..10));
    let mut bad = record(11);
    bad.irradiance.y = f32::NAN;
    let spoilt = [
        ("record 1 of the batch: irradiance", convert::pack(&NAMESPACE, Tag::level(1), &[record(10), bad])),
        ("namespace has 3 bytes", v1::RecordBatch { namespace: vec![0; 3].into(), ..good.clone() }),
        ("kind 9", v1::RecordBatch { kind: 9, ..good.clone() }),
        ("level is 0", v1::RecordBatch { level: 0, ..good.clone() }),
        ("at most 4096", convert::pack(&NAMESPACE, Tag::level(1), &records(0..4097))),
        ("expected 128", v1::RecordBatch { records: good.records.slice(1..129 + 5), ..good.clone() }),
    ];
    for (named, batch) in spoilt {
        let refused = insert(&mut cache, vec![good.clone(), batch]).await.expect_err(named);
        assert_eq!(refused.code(), Code::InvalidArgument, "{named}");
        let message = refused.message();
        assert!(message.starts_with("batch 1: "), "{message}");
    }
    let missing = soon(cache.insert(tokio_stream::iter([v1::InsertRequest { batch: None }]))).await;
    assert!(missing.expect_err("missing").message().contains("batch is missing"));
    // What came before an unsound batch is kept; nothing else.
    assert_eq!(insert(&mut cache, vec![good]).await.expect("sound").position, 10);
    server.stop().await;
}

#[tokio::test]
async fn a_subscriber_that_does_not_read_holds_nobody_back() {
    let server = Server::tcp().await;
    let mut cache = server.cache();
    let deaf = subscribed(&mut cache, subscribe(0), 0).await;
    let mut keen = subscribed(&mut cache, subscribe(0), 0).await;
    for at in 0..40 {
        let batch = convert::pack(&NAMESPACE, Tag::level(1), &records(at * 4096..(at + 1) * 4096));
        insert(&mut cache, vec![batch]).await.expect("sound");
        assert_eq!(read(&mut keen, u64::from(at) * 4096, 4096).await.len(), 4096);
    }
    drop(deaf);
    server.stop().await;
}

fn points(queries: &[Query]) -> Vec<u8> {
    let floats = |q: &Query| q.position.to_array().into_iter().chain(q.normal.to_array());
    queries.iter().flat_map(floats).flat_map(f32::to_le_bytes).collect()
}

#[tokio::test]
async fn many_subscribers_hear_everything() {
    let server = Server::unix().await;
    let mut cache = server.cache();
    let mut streams = Vec::new();
    for _ in 0..128 {
        streams.push(subscribed(&mut cache, subscribe(0), 0).await);
    }
    let all: Vec<Record> = records(0..100).into_iter().map(Record::from).collect();
    for record in &all {
        insert(&mut cache, vec![convert::pack(&NAMESPACE, Tag::level(1), [record])]).await.expect("kept");
    }
    for stream in &mut streams {
        let heard: Vec<_> = read(stream, 0, all.len()).await.into_iter().map(|(_, record)| record).collect();
        assert_eq!(heard, all);
    }
    server.stop().await;
}

#[tokio::test]
async fn query_answers_what_a_replica_would_bit_for_bit() {
    let server = Server::tcp().await;
    let mut cache = server.cache();
    let queries: Vec<_> = (0..500)
        .map(|i| Query::new(Vec3::new((i % 50) as f32 * 0.21, (i / 50) as f32 * 0.07, 0.01), Vec3::Z))
        .collect();
    // Twice, because the second has to see what was added after the first.
    for (from, to) in [(0, 150), (150, 300)] {
        let mut added = records(from..to);
        added.reverse();
        insert(&mut cache, vec![convert::pack(&NAMESPACE, Tag::level(2), &added)]).await.expect("sound");
        let shrinks = |ids: std::ops::Range<u32>| ids.map(|id| Shrink::new(record(id).id, 0.1)).collect::<Vec<_>>();
        insert(&mut cache, vec![convert::pack(&NAMESPACE, Tag::level(2), &shrinks(from..from + 50))])
            .await
            .expect("sound");
        let mut local = Sealed::new(0.3);
        local.extend(records(0..to));
        local.shrink([shrinks(0..50), if from > 0 { shrinks(150..200) } else { Vec::new() }].concat());
        let expected: Vec<u8> = queries
            .iter()
            .flat_map(|query| {
                let answer = local.ask(query).unwrap_or_default();
                let irradiance = answer.irradiance.to_array().into_iter().flat_map(f32::to_le_bytes);
                irradiance.chain(answer.records.to_le_bytes()).collect::<Vec<_>>()
            })
            .collect();
        assert!(queries.iter().any(|query| local.covers(query)));
        let request = v1::QueryRequest {
            namespace: NAMESPACE.0.to_vec().into(),
            level: 2,
            a: 0.3,
            points: points(&queries).into(),
        };
        for _ in 0..2 {
            let answers = soon(cache.query(request.clone())).await.expect("answered").into_inner().answers;
            assert!(answers == expected);
        }
    }
    server.stop().await;
}

#[tokio::test]
async fn unsound_queries_are_refused_by_name() {
    let server = Server::unix().await;
    let mut cache = server.cache();
    let point = Query::new(Vec3::ONE, Vec3::X);
    let many = |count| points(&vec![point; count]).into();
    let good = v1::QueryRequest { namespace: NAMESPACE.0.to_vec().into(), level: 1, a: 1.0, points: many(65536) };
    let spoilt = [
        ("points", v1::QueryRequest { points: many(65537), ..good.clone() }),
        ("points", v1::QueryRequest { points: vec![0; 23].into(), ..good.clone() }),
        ("point 0 has a normal", v1::QueryRequest { points: vec![0; 24].into(), ..good.clone() }),
        ("point 0 is not finite", v1::QueryRequest { points: vec![0xff; 24].into(), ..good.clone() }),
        ("a: is 0", v1::QueryRequest { a: 0.0, ..good.clone() }),
        ("a: is NaN", v1::QueryRequest { a: f32::NAN, ..good.clone() }),
        ("level", v1::QueryRequest { level: 0, ..good.clone() }),
        ("namespace", v1::QueryRequest { namespace: vec![].into(), ..good.clone() }),
    ];
    for (named, request) in spoilt {
        let refused = soon(cache.query(request)).await.expect_err(named);
        assert_eq!(refused.code(), Code::InvalidArgument);
        assert!(refused.message().contains(named), "{named}: {refused}");
    }
    // A namespace that is not there answers nothing, and as many points as are allowed fit.
    let answers = soon(cache.query(good)).await.expect("answered").into_inner().answers;
    assert_eq!(answers, vec![0; 65536 * 16]);
    server.stop().await;
}

fn spec() -> v1::FrameSpec {
    let vector = Some(v1::Vector { x: 0.0, y: 1.0, z: 0.0 });
    v1::FrameSpec {
        scene: "box.glb".into(),
        scene_hash: vec![1; 32].into(),
        namespace: NAMESPACE.0.to_vec().into(),
        camera: Some(v1::CameraSpec { eye: vector, forward: vector, right: vector, up: vector, parallel: false }),
        width: 40,
        height: 16,
        tile_size: 16,
        spp: 1,
        method: "irradiance".into(),
        a: 0.5,
        rays: 64,
        bounces: 0,
        seed: 0,
        levels: 1,
        adaptive: false,
        splat: false,
        effort: None,
    }
}

fn open() -> v1::OpenRequest {
    v1::OpenRequest { spec: Some(spec()), ..Default::default() }
}

fn ask(worker: &str) -> v1::LeaseRequest {
    v1::LeaseRequest { worker: worker.into(), threads: 1 }
}

/// Does whatever it is given, for ever: one record for each tile in the first step, then none.
async fn work(server: &Server, name: &str) -> Infallible {
    let (mut cache, mut frames) = (server.cache(), server.frames());
    loop {
        let lease = soon(frames.lease(ask(name))).await.expect("served").into_inner().lease;
        let Some(lease) = lease else { continue };
        let step = lease.step.expect("a step");
        let tiles = lease.tile_from..lease.tile_to;
        let gathered = if step.index == 0 { records(tiles.clone()) } else { vec![] };
        let described = soon(frames.describe(v1::DescribeRequest { frame: lease.frame })).await.expect("there");
        let draft = convert::namespace(&described.into_inner().draft).expect("32 bytes");
        let batch = convert::pack(&draft, Tag { level: 1, step: step.index }, &gathered);
        insert(&mut cache, vec![batch]).await.expect("sound");
        // The last of the three tiles is half as wide.
        let pixels = |tile| v1::FrameTile { tile, pixels: vec![1; if tile == 2 { 8 } else { 16 } * 16 * 52].into() };
        let request = v1::CompleteRequest {
            worker: name.into(),
            lease: lease.id,
            frame: lease.frame,
            gathered: gathered.len() as u64,
            tiles: if step.level == 0 { tiles.map(pixels).collect() } else { vec![] },
            counts: vec![v1::Count { name: "leases".into(), value: 1.0 }],
            worked_seconds: 0.0,
            used: Some(v1::HostUse { host: name.into(), sent_bytes: 7, ..Default::default() }),
        };
        soon(frames.complete(request)).await.expect("sound");
    }
}

#[tokio::test]
async fn a_frame_is_filled_by_two_workers_and_told_to_its_owner() {
    let server = Server::unix().await;
    let mut frames = server.frames();
    let mut events = soon(frames.open(open())).await.expect("opened").into_inner();
    let (mut tiles, mut steps, mut frame) = (vec![], 0, None);
    let owner = async {
        while let Some(event) = events.message().await.expect("no error") {
            match event.event.expect("an event") {
                Event::Opened(opened) => frame = Some(opened.frame),
                Event::Progress(progress) => {
                    let index = progress.step.expect("a step").index;
                    assert!(index >= steps, "steps only go on");
                    steps = index;
                }
                Event::Tile(tile) => tiles.push(tile.tile),
                Event::Done(done) => return done,
                Event::Declined(declined) => panic!("{declined:?}"),
                Event::SceneWanted(_) => panic!("nobody lacks the scene"),
            }
        }
        panic!("ended without an end");
    };
    let done = tokio::select! {
        done = soon(owner) => done,
        never = work(&server, "a") => match never {},
        never = work(&server, "b") => match never {},
    };
    assert!(soon(events.message()).await.expect("no error").is_none(), "the stream ends");
    tiles.sort_unstable();
    assert_eq!(tiles, [0, 1, 2]);
    assert_eq!((done.records, done.leases_lost, done.counts.len()), (3, 0, 1));
    assert_eq!(done.rounds, steps);
    // What the frame gathered is the namespace's now, and the draft is no more.
    let info = soon(server.cache().info(v1::InfoRequest {})).await.expect("info").into_inner();
    let held: Vec<_> = info.namespaces.iter().map(|n| (n.namespace.to_vec(), n.records, n.digest.clone())).collect();
    assert_eq!(held, [(NAMESPACE.0.to_vec(), 3, done.digest.clone())]);
    assert_eq!(info.namespaces[0].label.as_ref().map(|l| l.scene.as_str()), Some("box.glb"));
    let mut again = soon(frames.open(open())).await.expect("opened").into_inner();
    let told = soon(again.message()).await.expect("no error").expect("told").event;
    assert!(matches!(told, Some(Event::Opened(o)) if o.base_records == 3 && o.base == done.digest && o.filled));
    // Begun again after the loss of a server, it is what it was.
    for filled in [false, true] {
        let request = v1::OpenRequest { base: done.digest.clone(), filled, ..open() };
        let mut again = soon(frames.open(request)).await.expect("opened").into_inner();
        let told = soon(again.message()).await.expect("no error").expect("told").event;
        assert!(matches!(told, Some(Event::Opened(o)) if o.base_records == 3 && o.filled == filled));
    }
    let described = soon(frames.describe(v1::DescribeRequest { frame: frame.expect("opened") })).await;
    assert!(described.is_err_and(|status| status.code() == Code::NotFound), "a finished frame is forgotten");
    server.stop().await;
}

#[tokio::test]
async fn an_owner_that_goes_away_cancels_its_frame() {
    let server = Server::tcp().await;
    let mut frames = server.frames();
    // A worker that waits already is woken by the frame.
    let (waiting, opened) = {
        let mut other = server.frames();
        tokio::join!(async move { soon(other.lease(ask("w"))).await }, soon(frames.open(open())))
    };
    let lease = waiting.expect("served").into_inner().lease.expect("work");
    let described = soon(frames.describe(v1::DescribeRequest { frame: lease.frame })).await.expect("open");
    assert_eq!(described.into_inner().spec, Some(spec()));
    let renewed =
        soon(frames.renew(v1::RenewRequest { worker: "w".into(), leases: vec![lease.id] })).await.expect("renewed");
    assert_eq!(renewed.into_inner().leases, [lease.id]);

    drop(opened);
    let gone = async {
        while frames.describe(v1::DescribeRequest { frame: lease.frame }).await.is_ok() {
            tokio::task::yield_now().await;
        }
    };
    soon(gone).await;
    let renewed =
        soon(frames.renew(v1::RenewRequest { worker: "w".into(), leases: vec![lease.id] })).await.expect("renewed");
    assert!(renewed.into_inner().leases.is_empty(), "its leases are revoked");
    let late = v1::CompleteRequest { worker: "w".into(), lease: lease.id, frame: lease.frame, ..Default::default() };
    assert!(!soon(frames.complete(late)).await.expect("harmless").into_inner().accepted);
    server.stop().await;
}

#[tokio::test]
async fn calls_of_another_version_are_refused() {
    fn of<T>(version: &'static str, message: T) -> Request<T> {
        let mut request = Request::new(message);
        request.metadata_mut().insert(VERSION_KEY, version.parse().expect("ASCII"));
        request
    }
    let server = Server::unix().await;
    let (mut cache, mut frames) = (server.cache(), server.frames());
    let query = || v1::QueryRequest { namespace: vec![7; 32].into(), level: 1, a: 0.3, points: Default::default() };
    let old = [
        soon(frames.open(of("0.0.0", open()))).await.expect_err("old"),
        soon(frames.lease(of("0.0.0", ask("w")))).await.expect_err("old"),
        soon(cache.insert(of("0.0.0", tokio_stream::iter([])))).await.expect_err("old"),
        soon(cache.query(of("0.0.0", query()))).await.expect_err("old"),
    ];
    for status in old {
        assert_eq!(status.code(), Code::FailedPrecondition);
        assert!(status.message().contains("0.0.0") && status.message().contains(VERSION), "{status}");
    }
    soon(cache.query(of(VERSION, query()))).await.expect("the same version");
    soon(cache.query(query())).await.expect("a client that does not say");
    server.stop().await;
}

#[tokio::test]
async fn frames_refuse_by_name() {
    let server = Server::unix().await;
    let mut frames = server.frames();
    let mut request = open();
    request.spec.as_mut().expect("there").tile_size = 1000;
    let status = soon(frames.open(request)).await.expect_err("too large");
    assert_eq!(status.code(), Code::InvalidArgument);
    assert!(status.message().contains("tile_size"), "{status}");
    let status = soon(frames.open(v1::OpenRequest { spec: None, ..open() })).await.expect_err("none");
    assert!(status.message().contains("spec is missing"), "{status}");
    let status = soon(frames.lease(ask(&"x".repeat(65)))).await.expect_err("too long");
    assert_eq!(status.code(), Code::InvalidArgument);
    let decline = v1::DeclineRequest { worker: "w".into(), frame: 1, reason: "why".into(), for_all: false };
    assert_eq!(soon(frames.decline(decline)).await.expect_err("no frame").code(), Code::NotFound);
    server.stop().await;
}

#[tokio::test]
async fn health_and_reflection_answer() {
    use tonic_health::pb::health_client::HealthClient;
    use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus};
    use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
    use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
    use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
    use tonic_reflection::pb::v1::{ServerReflectionRequest, ServiceResponse};

    let server = Server::tcp().await;
    let mut health = HealthClient::new(server.channel.clone());
    for service in ["", "ambience.v1.Cache", "ambience.v1.Frames"] {
        let response = soon(health.check(HealthCheckRequest { service: service.into() })).await.expect("known");
        assert_eq!(response.into_inner().status(), ServingStatus::Serving, "{service}");
    }
    let list = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut reflection = ServerReflectionClient::new(server.channel.clone());
    let mut answers =
        soon(reflection.server_reflection_info(tokio_stream::iter([list]))).await.expect("served").into_inner();
    let answer = soon(answers.message()).await.expect("no error").expect("an answer");
    let Some(MessageResponse::ListServicesResponse(list)) = answer.message_response else { panic!("{answer:?}") };
    let names: Vec<_> = list.service.iter().map(|ServiceResponse { name }| name.as_str()).collect();
    assert!(names.contains(&"ambience.v1.Cache") && names.contains(&"ambience.v1.Frames"), "{names:?}");
    server.stop().await;
}

#[tokio::test]
async fn shutdown_sends_away_those_who_wait() {
    let server = Server::unix().await;
    let (mut cache, mut frames) = (server.cache(), server.frames());
    let mut subscription = subscribed(&mut cache, subscribe(0), 0).await;
    let waiting = tokio::spawn(async move { frames.lease(ask("w")).await });
    // The worker is known as soon as it waits.
    let known = async { while cache.info(v1::InfoRequest {}).await.expect("info").into_inner().workers == 0 {} };
    soon(known).await;
    server.stop().await;
    let told = soon(subscription.message()).await.expect_err("told");
    assert_eq!(told.code(), Code::Unavailable, "{told}");
    let told = soon(waiting).await.expect("no panic").expect_err("told");
    assert_eq!(told.code(), Code::Unavailable, "{told}");
}
