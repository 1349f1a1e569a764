//! Clients that mean harm, or are broken, against a server process: each time another client goes on as if they were not
//! there, and at the end the server's memory is as small as it says.

mod support;

use std::io::{BufRead as _, BufReader};
use std::pin::Pin;
use std::process::{Child, Command, Stdio};
use std::task::{Context, Poll};

use cache_core::{Irradiance, Namespace, Tag};
use cache_proto::v1::cache_client::CacheClient;
use cache_proto::{convert, v1};
use support::{insert, record, soon, subscribe};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tonic::body::Body;
use tonic::codegen::http::{Request, header};
use tonic::codegen::{Bytes, Service as _};
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status};

const MIB: u64 = 1 << 20;

/// A server process. Every test has its own, so that its memory tells what one attack costs.
struct Server {
    process: Child,
    port: u16,
}

impl Server {
    fn start(limits: &[&str]) -> Self {
        let mut process = Command::new(env!("CARGO_BIN_EXE_cache-server"))
            .args(["--listen", "127.0.0.1:0"])
            .args(limits.iter().flat_map(|limit| ["--limit", limit]))
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("started");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let port = line.trim().rsplit(':').next().and_then(|port| port.parse().ok()).expect("a port");
        Self { process, port }
    }

    async fn connect(&self) -> Channel {
        let uri = format!("http://127.0.0.1:{}", self.port);
        soon(Endpoint::from_shared(uri).expect("a URI").connect()).await.expect("connected")
    }

    async fn raw(&self) -> TcpStream {
        soon(TcpStream::connect(("127.0.0.1", self.port))).await.expect("connected")
    }

    /// The most memory it ever used, bytes; not told on every system.
    fn peak(&self) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        line.trim().strip_suffix(" kB")?.parse::<u64>().ok().map(|kib| kib << 10)
    }

    fn ends_below(mut self, bytes: u64) {
        if let Some(peak) = self.peak() {
            assert!(peak < bytes, "{} MiB used, expected less than {} MiB", peak / MIB, bytes / MIB);
        }
        assert!(self.process.try_wait().expect("a child").is_none(), "it still runs");
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A well-behaved client that shares the server with the others.
struct Neighbour {
    cache: CacheClient<Channel>,
    namespace: Namespace,
    sent: u32,
}

impl Neighbour {
    async fn new(server: &Server) -> Self {
        Self { cache: CacheClient::new(server.connect().await), namespace: Namespace([0x77; 32]), sent: 0 }
    }

    /// Inserts a batch and reads everything back.
    async fn works(&mut self) {
        let added = soon(self.cache.insert(insert(self.namespace, self.sent..self.sent + 500))).await;
        self.sent += 500;
        assert_eq!(added.expect("inserted").into_inner().position, u64::from(self.sent));
        let mut stream = soon(self.cache.subscribe(subscribe(self.namespace))).await.expect("accepted").into_inner();
        let mut read = 0;
        while read < self.sent as usize {
            let batch = soon(stream.message()).await.expect("no error").expect("no end").batch;
            read += batch.map_or(0, |batch| convert::unpack(&batch).expect("sound").2.len());
        }
    }
}

/// The bytes of a call's body, and whether it ends after them or stalls.
struct Bytewise {
    bytes: Vec<u8>,
    at: usize,
    ends: bool,
}

impl http_body::Body for Bytewise {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        let end = self.bytes.len().min(self.at + (64 << 10));
        let piece = Bytes::copy_from_slice(&self.bytes[self.at..end]);
        self.at = end;
        match (piece.is_empty(), self.ends) {
            (false, _) => Poll::Ready(Some(Ok(http_body::Frame::data(piece)))),
            (true, true) => Poll::Ready(None),
            (true, false) => Poll::Pending,
        }
    }
}

/// Calls a method with these very bytes.
async fn call(channel: &Channel, method: &str, bytes: Vec<u8>, ends: bool) -> Result<(), Status> {
    let request = Request::post(format!("http://server/ambience.v1.{method}"))
        .header(header::CONTENT_TYPE, "application/grpc")
        .header(header::TE, "trailers")
        .body(Body::new(Bytewise { bytes, at: 0, ends }))
        .expect("a request");
    let mut channel = channel.clone();
    std::future::poll_fn(|context| channel.poll_ready(context)).await.map_err(|e| Status::from_error(e.into()))?;
    let response = channel.call(request).await.map_err(|e| Status::from_error(e.into()))?;
    Status::from_header_map(response.headers()).map_or(Ok(()), Err)
}

/// What stands before a message.
fn prefix(flag: u8, length: u32) -> Vec<u8> {
    [&[flag][..], &length.to_be_bytes()].concat()
}

fn message(bytes: &[u8]) -> Vec<u8> {
    [prefix(0, bytes.len() as u32), bytes.to_vec()].concat()
}

/// Numbers without rhyme, the same each time.
fn noise(seed: u64) -> impl Iterator<Item = u8> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    std::iter::repeat_with(move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 32) as u8
    })
}

#[tokio::test]
async fn random_bytes_and_cut_frames() {
    let server = Server::start(&[]);
    let mut neighbour = Neighbour::new(&server).await;
    let preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";
    for seed in 0..300u64 {
        let mut bytes: Vec<u8> = if seed % 2 == 0 { vec![] } else { preface.to_vec() };
        if seed % 4 == 3 {
            // A frame of headers that says it is longer than it is.
            bytes.extend([0, 0x20, 0, 1, 4, 0, 0, 0, 1]);
        }
        bytes.extend(noise(seed).take((seed * 17 % 4096) as usize));
        let mut stream = server.raw().await;
        // The server may have closed it already.
        let _ = stream.write_all(&bytes).await;
        if seed % 3 == 0 {
            let _ = stream.shutdown().await;
            let mut answer = Vec::new();
            let _ = soon(stream.read_to_end(&mut answer)).await;
        }
        if seed % 60 == 0 {
            neighbour.works().await;
        }
    }
    neighbour.works().await;
    server.ends_below(64 * MIB);
}

#[tokio::test]
async fn messages_that_are_not_what_they_say() {
    let server = Server::start(&[]);
    let mut neighbour = Neighbour::new(&server).await;
    let channel = server.connect().await;
    // Of field 1, the batch, its field 4, the records: 112 GB of them.
    let billion = [&[0x0a, 0x0a, 0x22][..], &[0x80, 0x80, 0x80, 0x80, 0xc0, 0x35], &[0; 3]].concat();
    let spoilt: Vec<(&str, Vec<u8>, Code)> = vec![
        ("4 GiB claimed", prefix(0, u32::MAX), Code::OutOfRange),
        ("2 MiB claimed, 100 bytes sent", [prefix(0, 2 << 20), vec![0; 100]].concat(), Code::Internal),
        ("half a prefix", vec![0, 0], Code::Internal),
        (
            "compressed",
            message(b"x").into_iter().enumerate().map(|(at, b)| if at == 0 { 1 } else { b }).collect(),
            Code::Internal,
        ),
        ("a flag that is none", prefix(7, 4), Code::Internal),
        ("a billion records", message(&billion), Code::Internal),
        ("noise", message(&noise(1).take(100_000).collect::<Vec<_>>()), Code::Internal),
    ];
    for method in ["Cache/Insert", "Frames/Open", "Frames/Complete"] {
        for (what, bytes, code) in &spoilt {
            let refused = soon(call(&channel, method, bytes.clone(), true)).await.expect_err(what);
            assert_eq!(refused.code(), *code, "{method}, {what}: {refused}");
        }
        neighbour.works().await;
    }
    // As many claims at a time as the server takes calls: nothing is set aside for what has not come.
    for _ in 0..8 {
        let calls = (0..200).map(|_| {
            let channel = channel.clone();
            tokio::spawn(async move { drop(call(&channel, "Frames/Complete", prefix(0, 8 << 20), false).await) })
        });
        let calls: Vec<_> = calls.collect();
        neighbour.works().await;
        calls.iter().for_each(tokio::task::JoinHandle::abort);
    }
    neighbour.works().await;
    server.ends_below(64 * MIB);
}

#[tokio::test]
async fn records_that_are_none() {
    let server = Server::start(&[]);
    let mut neighbour = Neighbour::new(&server).await;
    let mut cache = CacheClient::new(server.connect().await);
    let spoil = |change: fn(&mut Irradiance)| {
        let mut record = record(1);
        change(&mut record);
        record
    };
    let spoilt = [
        ("irradiance", spoil(|r| r.irradiance.x = f32::NAN)),
        ("irradiance", spoil(|r| r.irradiance.z = -1.0)),
        ("position", spoil(|r| r.position.y = f32::INFINITY)),
        ("normal", spoil(|r| r.normal *= 2.0)),
        ("radius", spoil(|r| r.radius = 0.0)),
        ("radius", spoil(|r| r.radius = -f32::from_bits(1))),
        ("radius", spoil(|r| (r.radius, r.radius_min) = (1e-30, 1e-30))),
        ("radius", spoil(|r| r.radius_max = f32::NAN)),
        ("gradient", spoil(|r| r.gradient_t[1].x = f32::NEG_INFINITY)),
    ];
    for (what, record) in spoilt {
        let batch = convert::pack(&Namespace([9; 32]), Tag::level(1), &[record]);
        let request = tokio_stream::once(v1::InsertRequest { batch: Some(batch) });
        let refused = soon(cache.insert(request)).await.expect_err(what);
        assert_eq!(refused.code(), Code::InvalidArgument, "{refused}");
        assert!(refused.message().contains(what), "{what}: {refused}");
    }
    neighbour.works().await;
    server.ends_below(64 * MIB);
}

#[tokio::test]
async fn records_that_reach_hardly_anywhere_or_everywhere() {
    let server = Server::start(&[]);
    let mut neighbour = Neighbour::new(&server).await;
    let mut cache = CacheClient::new(server.connect().await);
    let namespace = Namespace([9; 32]);
    // Sound one by one; filed together they must neither dig an octree without end nor lie in every cell of one.
    let strange = |id: u32| {
        // The least the border lets in, twice it, and as far as there is.
        let least = 2.4e-10 * record(id).position.abs().max_element().max(1e-3);
        let radius = [least, 2.0 * least, 1.0, 1e18][id as usize % 4];
        Irradiance { radius, radius_min: radius, radius_max: radius, ..record(id) }
    };
    let records: Vec<_> = (0..4000).map(strange).collect();
    let batch = convert::pack(&namespace, Tag::level(1), &records);
    let request = tokio_stream::once(v1::InsertRequest { batch: Some(batch) });
    soon(cache.insert(request)).await.expect("sound");
    let point: Vec<u8> = [0f32, 0.0, 0.0, 0.0, 0.0, 1.0].into_iter().flat_map(f32::to_le_bytes).collect();
    let points = point.repeat(1000).into();
    let query = v1::QueryRequest { namespace: namespace.0.to_vec().into(), level: 1, a: 1.0, points };
    let (answers, ()) = tokio::join!(soon(cache.query(query)), neighbour.works());
    assert_eq!(answers.expect("answered").into_inner().answers.len(), 16_000);
    server.ends_below(64 * MIB);
}

#[tokio::test]
async fn those_who_begin_and_do_not_go_on() {
    let server = Server::start(&["inflow=16777216"]);
    let mut neighbour = Neighbour::new(&server).await;
    let channels = [server.connect().await, server.connect().await];
    let (mut stalled, mut deaf) = (Vec::new(), Vec::new());
    for at in 0..200 {
        // All but the last byte of the longest message, on many calls; some send nothing at all.
        let bytes = if at % 4 == 0 { vec![] } else { [prefix(0, 2 << 20), vec![1; (2 << 20) - 1]].concat() };
        let channel = channels[at % 2].clone();
        stalled.push(tokio::spawn(async move { call(&channel, "Cache/Insert", bytes, false).await }));
    }
    // Subscribers who never read.
    for at in 0..50 {
        let mut cache = CacheClient::new(channels[at % 2].clone());
        deaf.push(soon(cache.subscribe(subscribe(neighbour.namespace))).await);
    }
    for _ in 0..10 {
        neighbour.works().await;
    }
    let mut told = 0;
    for call in &mut stalled {
        if call.is_finished() {
            let status = call.await.expect("no panic").expect_err("refused");
            assert_eq!(status.code(), Code::Unavailable, "{status}");
            told += 1;
        }
    }
    assert!(told > 100, "{told} of 150 were told that it is too much");
    drop(deaf);
    server.ends_below(64 * MIB);
}

#[tokio::test]
async fn a_flood_of_connections() {
    let server = Server::start(&["connections=20"]);
    let mut neighbour = Neighbour::new(&server).await;
    neighbour.works().await;
    let mut silent = Vec::new();
    for _ in 0..19 {
        silent.push(server.raw().await);
    }
    // One more is answered, and told why it is not served.
    let mut cache = CacheClient::new(server.connect().await);
    let status = soon(cache.info(v1::InfoRequest {})).await.expect_err("too many");
    assert_eq!(
        (status.code(), status.message()),
        (Code::ResourceExhausted, "this server takes at most 20 connections")
    );
    // Very many more are closed at once.
    for _ in 0..500 {
        silent.push(server.raw().await);
    }
    let mut last = silent.pop().expect("there");
    assert_eq!(soon(last.read(&mut [0; 9])).await.unwrap_or(0), 0, "closed");
    neighbour.works().await;
    drop((silent, last, cache));
    // Their places are free again, as soon as the server has seen that they are gone.
    let mut served = false;
    while !served {
        served = soon(CacheClient::new(server.connect().await).info(v1::InfoRequest {})).await.is_ok();
    }
    neighbour.works().await;
    server.ends_below(64 * MIB);
}

#[tokio::test]
async fn a_flood_of_calls_that_are_taken_back() {
    let server = Server::start(&[]);
    let mut neighbour = Neighbour::new(&server).await;
    let channel = server.connect().await;
    for round in 0..40 {
        for _ in 0..500 {
            let mut cache = CacheClient::new(channel.clone());
            let begun = cache.subscribe(subscribe(Namespace([1; 32])));
            // Begun, and dropped after one look.
            tokio::select! {
                biased;
                _ = begun => (),
                () = tokio::task::yield_now() => (),
            }
        }
        if round % 8 == 0 {
            neighbour.works().await;
        }
    }
    neighbour.works().await;
    server.ends_below(64 * MIB);
}
