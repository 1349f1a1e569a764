//! The cache service against the bare stream under it, in one run, as ratios.
//!
//! Server and client are processes of their own on a Unix socket; the bare stream is the same generated service, messages
//! and windows with nothing behind it ([`crate::bare`]). Each figure is the median of several rounds, in which the bare
//! stream and all kinds of journal take turns, so that what else the machine does falls on all of them.

use std::error::Error;
use std::time::{Duration, Instant};

use cache_core::{Namespace, Sealed};
use cache_proto::v1;
use cache_server::journal::device::Sync;
use cache_server::journal::disk::Disk;
use tokio::time::MissedTickBehavior;
use tonic::Streaming;
use worker::client::{self, Cache};

use crate::bare::LIVE;
use crate::host::{Host, Kind, journal_in};
use crate::records::{self, A, NAMESPACE};
use crate::report::{Report, bars, quantile};

/// Records of the streams.
const RECORDS: u64 = 1 << 20;

/// Records that queries are answered from, and points of one request.
const ASKED: u64 = 50_000;
const POINTS: u64 = 16384;

/// Batches whose latency is measured, the records in one, and the time between two.
const PINGS: usize = 400;
const PING_RECORDS: u64 = 16;
const PING_EVERY: Duration = Duration::from_millis(4);

/// The load of a busy farm, in another namespace: batches of 256, each such time.
const LOAD_EVERY: Duration = Duration::from_millis(2);

const KINDS: [(Kind, &str); 6] = [
    (Kind::Bare, "bare stream"),
    (Kind::Keep, "bare stream, bytes kept"),
    (Kind::Write, "the same, and written"),
    (Kind::Memory, "in memory"),
    (Kind::Page, "durable in the page cache"),
    (Kind::Device, "durable on the device"),
];

/// What is measured.
#[derive(Clone, Copy, PartialEq, Eq, Debug, clap::ValueEnum)]
enum Part {
    In,
    Out,
    Queries,
    Latency,
    Start,
}

/// Arguments of the benchmark.
#[derive(Clone, Debug, clap::Args)]
pub struct ServiceArgs {
    /// What is measured; everything, if nothing is named
    parts: Vec<Part>,
    /// Rounds; the median counts
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Keep table and chart in bench/results
    #[arg(long)]
    save: bool,
}

/// Measures and prints everything.
///
/// # Errors
/// When a server does not come up or answers with an error.
pub fn run(args: &ServiceArgs) -> Result<(), Box<dyn Error>> {
    let mut report = Report::begin("cargo run --release -p ambience-bench -- service");
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let mut chart = Vec::new();
    let named = |part| args.parts.is_empty() || args.parts.contains(&part);
    runtime.block_on(async {
        for size in [4096, 256].into_iter().filter(|_| named(Part::In)) {
            insert(&mut report, &mut chart, args.rounds, size).await?;
        }
        for subscribers in [1, 4].into_iter().filter(|_| named(Part::Out)) {
            subscribe(&mut report, &mut chart, args.rounds, subscribers).await?;
        }
        if named(Part::Queries) {
            query(&mut report, &mut chart, args.rounds).await?;
        }
        for load in [false, true].into_iter().filter(|_| named(Part::Latency)) {
            latency(&mut report, load).await?;
        }
        if named(Part::Start) {
            starts(&mut report, args.rounds).await?;
        }
        Ok::<_, Box<dyn Error>>(())
    })?;
    if args.save {
        report.save("service")?;
        let title = "rate of the service / rate of the bare stream (of the local octree for queries)";
        bars("service", title, &chart, 0.5)?;
    }
    Ok(())
}

/// What one round of one kind gave.
struct Sample {
    /// Records a second.
    rate: f64,
    /// CPU microseconds of the server a record.
    cpu: f64,
    /// Bytes by which the server's memory grew for a record.
    memory: f64,
}

fn median(samples: &[Sample], pick: impl Fn(&Sample) -> f64) -> f64 {
    quantile(&mut samples.iter().map(pick).collect::<Vec<_>>(), 0.5)
}

/// Records in: one call, acknowledged when all are kept.
async fn insert(
    report: &mut Report,
    chart: &mut Vec<(String, f64)>,
    rounds: usize,
    size: u64,
) -> Result<(), Box<dyn Error>> {
    let batches = records::batches(&NAMESPACE, RECORDS, size);
    report.line(&format!("\nin: one call of {RECORDS} records, batches of {size}"));
    report.line(&format!("{:28} {:>10} {:>8} {:>14} {:>14}", "", "M rec/s", "ratio", "us CPU/record", "bytes/record"));
    let mut samples = KINDS.map(|_| Vec::new());
    for _ in 0..rounds {
        for ((kind, _), samples) in KINDS.iter().zip(&mut samples) {
            let mut host = Host::start(*kind, 0, 1)?;
            let mut cache = client::cache(host.connect());
            // Connected, and the server warm but for memory.
            send(&mut cache, records::batches(&Namespace([1; 32]), 16, 16)).await?;
            let before = host.usage()?;
            let start = Instant::now();
            send(&mut cache, batches.clone()).await?;
            let seconds = start.elapsed().as_secs_f64();
            let after = host.usage()?;
            let each = |from: f64, to: f64| (to - from) / RECORDS as f64;
            samples.push(Sample {
                rate: RECORDS as f64 / seconds,
                cpu: each(before.cpu, after.cpu) * 1e6,
                memory: each(before.peak, after.peak),
            });
        }
    }
    let bare = median(&samples[0], |s| s.rate);
    for ((kind, name), samples) in KINDS.iter().zip(&samples) {
        let rate = median(samples, |s| s.rate);
        let (cpu, memory) = (median(samples, |s| s.cpu), median(samples, |s| s.memory));
        report.line(&format!("{name:28} {:10.2} {:8.2} {cpu:14.3} {memory:14.0}", rate / 1e6, rate / bare));
        if !matches!(kind, Kind::Bare | Kind::Keep | Kind::Write) {
            chart.push((format!("in, batches of {size}, {name}"), rate / bare));
        }
    }
    Ok(())
}

/// From the start of a server whose journal holds records until it answers.
async fn starts(report: &mut Report, rounds: usize) -> Result<(), Box<dyn Error>> {
    report.line(&format!("\nstart: a journal of {RECORDS} records in batches of 4096, until the first answer"));
    report.line(&format!("{:28} {:>10} {:>14}", "", "s", "s CPU"));
    let mut host = Host::start(Kind::Page, 0, 1)?;
    send(&mut client::cache(host.connect()), records::batches(&NAMESPACE, RECORDS, 4096)).await?;
    for (closed, name) in [(false, "after kill -9"), (true, "after it was closed")] {
        let (mut wall, mut cpu) = (Vec::new(), Vec::new());
        for _ in 0..rounds {
            let folder = host.kill()?;
            if closed {
                drop(Disk::open(&journal_in(folder.path()), Sync::PageCache).map_err(|e| e.to_string())?);
            }
            let start = Instant::now();
            host = Host::start_in(folder, Kind::Page, 0, 1)?;
            let known = loop {
                match client::cache(host.connect()).info(v1::InfoRequest {}).await {
                    Ok(info) => break info.into_inner().namespaces.iter().map(|n| n.records).sum::<u64>(),
                    Err(_) => tokio::time::sleep(Duration::from_millis(10)).await,
                }
            };
            wall.push(start.elapsed().as_secs_f64());
            cpu.push(host.usage()?.cpu);
            if known != RECORDS {
                return Err(format!("{known} records came back of {RECORDS}").into());
            }
        }
        report.line(&format!("{name:28} {:10.2} {:14.2}", quantile(&mut wall, 0.5), quantile(&mut cpu, 0.5)));
    }
    Ok(())
}

/// Inserts batches in one call.
pub(crate) async fn send(
    cache: &mut Cache,
    batches: Vec<v1::RecordBatch>,
) -> Result<v1::InsertResponse, tonic::Status> {
    let requests = tokio_stream::iter(batches.into_iter().map(|batch| v1::InsertRequest { batch: Some(batch) }));
    Ok(cache.insert(requests).await?.into_inner())
}

/// Records out: every subscriber on a connection of its own, from the beginning of the log to its end.
async fn subscribe(
    report: &mut Report,
    chart: &mut Vec<(String, f64)>,
    rounds: usize,
    subscribers: usize,
) -> Result<(), Box<dyn Error>> {
    report.line(&format!("\nout: {RECORDS} records to {subscribers} at once"));
    report.line(&format!("{:28} {:>10} {:>8} {:>14}", "", "M rec/s", "ratio", "us CPU/record"));
    let kinds = [KINDS[0], KINDS[3]];
    let mut samples = [Vec::new(), Vec::new()];
    for _ in 0..rounds {
        for ((kind, _), samples) in kinds.iter().zip(&mut samples) {
            let mut host = Host::start(*kind, RECORDS, 4096)?;
            if *kind != Kind::Bare {
                send(&mut client::cache(host.connect()), records::batches(&NAMESPACE, RECORDS, 4096)).await?;
            }
            let mut streams = Vec::new();
            for _ in 0..subscribers {
                streams.push(follow(&mut client::cache(host.connect()), &NAMESPACE, 0).await?);
            }
            let before = host.usage()?;
            let start = Instant::now();
            let read = streams.into_iter().map(|stream| tokio::spawn(read(stream, RECORDS)));
            for done in read.collect::<Vec<_>>() {
                done.await??;
            }
            let count = RECORDS as f64 * subscribers as f64;
            let rate = count / start.elapsed().as_secs_f64();
            samples.push(Sample { rate, cpu: (host.usage()?.cpu - before.cpu) / count * 1e6, memory: 0.0 });
        }
    }
    let bare = median(&samples[0], |s| s.rate);
    for ((kind, name), samples) in kinds.iter().zip(&samples) {
        let (rate, cpu) = (median(samples, |s| s.rate), median(samples, |s| s.cpu));
        report.line(&format!("{name:28} {:10.2} {:8.2} {cpu:14.3}", rate / 1e6, rate / bare));
        if *kind != Kind::Bare {
            chart.push((format!("out, to {subscribers} at once"), rate / bare));
        }
    }
    Ok(())
}

/// Subscribes, and hears where the stream starts.
pub(crate) async fn follow(
    cache: &mut Cache,
    namespace: &Namespace,
    position: u64,
) -> Result<Streaming<v1::SubscribeResponse>, tonic::Status> {
    let namespace = namespace.0.to_vec().into();
    let request = v1::SubscribeRequest { namespace, position, ..Default::default() };
    let mut stream = cache.subscribe(request).await?.into_inner();
    stream.message().await?;
    Ok(stream)
}

/// Reads so many records.
pub(crate) async fn read(mut stream: Streaming<v1::SubscribeResponse>, count: u64) -> Result<(), tonic::Status> {
    let mut bytes = 0;
    while bytes < count as usize * 128
        && let Some(response) = stream.message().await?
    {
        bytes += response.batch.map_or(0, |batch| batch.records.len());
    }
    Ok(())
}

/// Points answered a second, over the wire and by the octree itself.
async fn query(report: &mut Report, chart: &mut Vec<(String, f64)>, rounds: usize) -> Result<(), Box<dyn Error>> {
    let points = records::points(POINTS);
    let mut sealed = Sealed::new(A);
    sealed.extend((0..ASKED).map(|index| records::record(index, ASKED)));
    let host = Host::start(Kind::Memory, 0, 1)?;
    let mut cache = client::cache(host.connect());
    send(&mut cache, records::batches(&NAMESPACE, ASKED, 4096)).await?;
    let request = v1::QueryRequest {
        namespace: NAMESPACE.0.to_vec().into(),
        level: 1,
        a: A,
        points: records::pack(&points).into(),
    };
    // The first one seals the level.
    cache.query(request.clone()).await?;
    let (mut local, mut wire, mut answered) = (Vec::new(), Vec::new(), 0);
    for _ in 0..rounds * 4 {
        let start = Instant::now();
        answered = points.iter().filter_map(|query| sealed.ask(query)).map(|answer| u64::from(answer.records)).sum();
        local.push(POINTS as f64 / start.elapsed().as_secs_f64());
        let start = Instant::now();
        cache.query(request.clone()).await?;
        wire.push(POINTS as f64 / start.elapsed().as_secs_f64());
    }
    let (local, wire) = (quantile(&mut local, 0.5), quantile(&mut wire, 0.5));
    let each = answered as f64 / POINTS as f64;
    report.line(&format!("\nqueries: {POINTS} points a request, {ASKED} records, {each:.1} of them answer a point"));
    report.line(&format!("{:28} {:>10} {:>8}", "", "M points/s", "ratio"));
    report.line(&format!("{:28} {:10.2} {:8.2}", "local octree, one thread", local / 1e6, 1.0));
    report.line(&format!("{:28} {:10.2} {:8.2}", "Query, one at a time", wire / 1e6, wire / local));
    chart.push(("queries, one at a time".into(), wire / local));
    Ok(())
}

/// From the call that inserts a few records until a subscriber has them.
async fn latency(report: &mut Report, load: bool) -> Result<(), Box<dyn Error>> {
    let about = if load { "128 thousand records a second in another namespace" } else { "idle" };
    report.line(&format!("\nlatency: {PING_RECORDS} records from the call of Insert to a subscriber; {about}"));
    report.line(&format!("{:28} {:>10} {:>10} {:>10}", "", "p50 us", "p99 us", "added p50"));
    let mut bare = f64::NAN;
    for (kind, name) in KINDS.into_iter().filter(|(kind, _)| !matches!(kind, Kind::Keep | Kind::Write)) {
        let host = Host::start(kind, 0, 1)?;
        let position = if kind == Kind::Bare { LIVE } else { 0 };
        let loading = load.then(|| tokio::spawn(busy(client::cache(host.connect()))));
        let [caller, subscriber] = [(); 2].map(|()| client::cache(host.connect()));
        let [p50, p99] = pings(caller, subscriber, position).await?;
        if let Some(loading) = loading {
            loading.abort();
        }
        if kind == Kind::Bare {
            bare = p50;
        }
        report.line(&format!("{name:28} {p50:10.0} {p99:10.0} {:10.0}", p50 - bare));
    }
    Ok(())
}

/// Microseconds, p50 and p99, until a subscriber has what a caller inserts.
pub(crate) async fn pings(mut caller: Cache, mut subscriber: Cache, position: u64) -> Result<[f64; 2], Box<dyn Error>> {
    let mut stream = follow(&mut subscriber, &NAMESPACE, position).await?;
    let mut every = tokio::time::interval(PING_EVERY);
    every.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut times = Vec::new();
    for batch in records::batches(&NAMESPACE, PINGS as u64 * PING_RECORDS, PING_RECORDS) {
        every.tick().await;
        let start = Instant::now();
        let (seen, kept) = tokio::join!(stream.message(), send(&mut caller, vec![batch]));
        kept?;
        seen?.ok_or("the subscription has ended")?;
        times.push(start.elapsed().as_secs_f64() * 1e6);
    }
    Ok([0.5, 0.99].map(|q| quantile(&mut times, q)))
}

/// Inserts in another namespace until it is stopped.
async fn busy(mut cache: Cache) -> Result<(), tonic::Status> {
    let batches = records::batches(&Namespace([2; 32]), RECORDS, 256);
    let mut every = tokio::time::interval(LOAD_EVERY);
    for batch in batches {
        every.tick().await;
        send(&mut cache, vec![batch]).await?;
    }
    Ok(())
}
