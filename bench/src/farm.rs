//! One frame by farms of many sizes: the real service in a process of its own, the real worker protocol in this one, each
//! worker on a connection of its own. Only the work is pretended ([`crate::work`]): a gather is a wait.
//!
//! All workers share this machine with the server. What they pay for the protocol (reading, checking and keeping every
//! record of the frame, once each) takes CPU time from it that machines of their own would not take; the table says how
//! much that was.

use std::collections::BTreeMap;
use std::error::Error;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use cache_core::RecordId;
use cache_proto::v1;
use cache_proto::v1::frame_event::Event;
use worker::client;
use worker::farm::Worker;
use worker::job::Known;
use worker::traffic::Traffic;

use crate::host::{self, Host, Kind, Usage};
use crate::relay::Relay;
use crate::report::{Curve, Report, curves, quantile};
use crate::work::{self, Pretended, lock, watch};

/// How often replicas are looked into for the records that are watched.
const LOOK: Duration = Duration::from_millis(1);

const PHASES: [&str; 3] = ["level 2", "level 1", "pixels"];

/// Arguments of the simulation.
#[derive(Clone, Debug, clap::Args)]
pub struct FarmArgs {
    /// Sizes of the farms
    #[arg(default_values_t = [1, 8, 64, 256, 1024])]
    workers: Vec<u32>,
    /// Mean time of one gather, microseconds
    #[arg(long, default_value_t = 16000)]
    gather: u32,
    /// Relays between the workers and the server, each with an equal share of them
    #[arg(long, default_value_t = 0)]
    relays: usize,
    /// Width of the picture; its height is 9/16 of that
    #[arg(long, default_value_t = 960)]
    width: u32,
    /// Keep table and chart in bench/results, under this name
    #[arg(long, value_name = "NAME")]
    save: Option<String>,
}

/// Renders the frame with every farm and prints a line for each.
///
/// # Errors
/// When a server does not come up, or a frame fails.
pub fn run(args: &FarmArgs) -> Result<(), Box<dyn Error>> {
    let sizes: Vec<_> = args.workers.iter().map(u32::to_string).collect();
    let command = format!(
        "cargo run --release -p ambience-bench -- farm {} --gather {} --relays {} --width {}",
        sizes.join(" "),
        args.gather,
        args.relays,
        args.width
    );
    let mut report = Report::begin(&command);
    report.line(&format!(
        "{:>7} {:>8} {:>8} {:>21} {:>8} {:>8} {:>6} {:>6} {:>9} {:>16} {:>8} {:>8} {:>8}",
        "workers",
        "wall s",
        "ideal s",
        "idle % lvl2/lvl1/pix",
        "leases",
        "records",
        "twice",
        "lost",
        "MB out",
        "visible ms",
        "server",
        "server",
        "workers"
    ));
    report.line(&format!(
        "{:>7} {:>8} {:>8} {:>21} {:>8} {:>8} {:>6} {:>6} {:>9} {:>16} {:>8} {:>8} {:>8}",
        "", "", "", "", "", "", "made", "leases", "a worker", "p50 / p99", "CPU s", "peak MB", "CPU s"
    ));
    let mut runs = Vec::new();
    for &workers in &args.workers {
        let run = frame(args, workers)?;
        report.line(&run.to_string());
        if args.relays > 0 {
            let Usage { cpu, peak } = run.relay;
            report.line(&format!("        a relay took {cpu:.1} CPU s and {:.0} MB at its peak", peak / 1e6));
        }
        runs.push(run);
    }
    if let Some(name) = &args.save {
        report.save(name)?;
        chart(name, &runs)?;
    }
    Ok(())
}

/// What one farm did.
struct Run {
    workers: f64,
    /// Seconds from opening the frame to its last tile.
    wall: f64,
    /// Seconds of each phase.
    phases: BTreeMap<&'static str, f64>,
    /// Seconds of work, all workers together.
    busy: BTreeMap<&'static str, f64>,
    done: v1::FrameDone,
    made: u64,
    leases: u64,
    /// Milliseconds from the end of a gather until every replica has the record.
    visible: [f64; 2],
    /// Bytes of records each worker received.
    received: f64,
    server: Usage,
    /// Mean CPU of the relays, and the most memory of one.
    relay: Usage,
    clients: f64,
}

impl Run {
    fn ideal(&self) -> f64 {
        self.busy.values().sum::<f64>() / self.workers
    }

    fn idle(&self, phase: &str) -> f64 {
        let of = |map: &BTreeMap<&str, f64>| map.get(phase).copied().unwrap_or_default();
        100.0 * (1.0 - of(&self.busy) / (self.workers * of(&self.phases)))
    }
}

impl std::fmt::Display for Run {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [a, b, c] = PHASES.map(|phase| self.idle(phase));
        let [p50, p99] = self.visible;
        write!(
            f,
            "{:7} {:8.1} {:8.1} {:>21} {:8} {:8} {:6} {:6} {:9.2} {:>16} {:8.1} {:8.0} {:8.1}",
            self.workers,
            self.wall,
            self.ideal(),
            format!("{a:.0} / {b:.0} / {c:.0}"),
            self.leases,
            self.done.records,
            self.made - self.done.records,
            self.done.leases_lost,
            self.received / 1e6,
            format!("{p50:.1} / {p99:.1}"),
            self.server.cpu,
            self.server.peak / 1e6,
            self.clients,
        )
    }
}

fn frame(args: &FarmArgs, workers: u32) -> Result<Run, Box<dyn Error>> {
    watch().made.store(0, Ordering::Relaxed);
    watch().leases.store(0, Ordering::Relaxed);
    lock(&watch().replicas).clear();
    lock(&watch().watched).clear();
    let mut host = Host::start(Kind::Memory, 0, 1)?;
    let relays = (0..args.relays).map(|_| Relay::start(&host.address())).collect::<Result<Vec<_>, _>>()?;
    // One thread for the protocol, few for keeping records: the machine is the server's, too.
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(1).max_blocking_threads(2).enable_all().build()?;
    watch().gather.store(args.gather.into(), Ordering::Relaxed);
    let spec = work::spec(args.width, args.width * 9 / 16);
    let (over, visible) = look();
    let result = runtime.block_on(async {
        for number in 0..workers {
            let relay = (number as usize).checked_rem(relays.len()).map(|at| &relays[at]);
            let line = relay.map_or_else(|| host.connect(), Relay::connect);
            let worker = Arc::new(Worker::<Pretended>::new(format!("simulated-{number}"), line, Traffic::default()));
            tokio::spawn(async move {
                let lost = worker.work(1).await;
                eprintln!("simulated-{number}: {lost}");
            });
        }
        let mut cache = client::cache(host.connect());
        while cache.info(v1::InfoRequest {}).await?.into_inner().workers < u64::from(workers) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        let before = (host.usage()?.cpu, host::usage()?.cpu);
        let (start, mut phase) = (Instant::now(), (Instant::now(), PHASES[0]));
        let mut phases = BTreeMap::new();
        let request = v1::OpenRequest { spec: Some(spec), ..Default::default() };
        let mut events = client::frames(host.connect()).open(request).await?.into_inner();
        let done = loop {
            let event = events.message().await?.and_then(|event| event.event);
            let now = match event.ok_or("the frame has ended early")? {
                Event::Progress(progress) => match progress.step.map_or(0, |step| step.level) {
                    0 => PHASES[2],
                    level => PHASES[2 - level as usize],
                },
                Event::Done(done) => break done,
                Event::Declined(declined) => return Err(declined.reason.into()),
                Event::Opened(_) | Event::Tile(_) | Event::SceneWanted(_) => continue,
            };
            if now != phase.1 {
                phases.insert(phase.1, phase.0.elapsed().as_secs_f64());
                phase = (Instant::now(), now);
            }
        };
        phases.insert(phase.1, phase.0.elapsed().as_secs_f64());
        let wall = start.elapsed().as_secs_f64();
        let (server, clients) = (host.usage()?, host::usage()?.cpu - before.1);
        Ok::<_, Box<dyn Error>>((wall, phases, done, Usage { cpu: server.cpu - before.0, ..server }, clients))
    });
    over.store(true, Ordering::Relaxed);
    runtime.shutdown_background();
    let (wall, phases, done, server, clients) = result?;
    let mut visible = visible.recv()?;
    let counts: BTreeMap<_, _> = done.counts.iter().map(|count| (count.name.as_str(), count.value)).collect();
    let count = |name: &str| counts.get(name).copied().unwrap_or_default();
    Ok(Run {
        workers: workers.into(),
        wall,
        phases,
        busy: PHASES.map(|phase| (phase, count(&format!("cpu_seconds.{phase}")))).into(),
        made: watch().made.load(Ordering::Relaxed),
        leases: watch().leases.load(Ordering::Relaxed),
        visible: [0.5, 0.99].map(|q| quantile(&mut visible, q)),
        received: count("bytes.subscribed") / f64::from(workers),
        done,
        server,
        relay: mean(&relays)?,
        clients,
    })
}

fn mean(relays: &[Relay]) -> Result<Usage, Box<dyn Error>> {
    let mut all = Usage::default();
    for relay in relays {
        let Usage { cpu, peak } = relay.usage()?;
        all = Usage { cpu: all.cpu + cpu / relays.len() as f64, peak: all.peak.max(peak) };
    }
    Ok(all)
}

/// Looks into every replica for the records that are watched, until told that the frame is over; then tells how many
/// milliseconds each took to be in all of them.
fn look() -> (Arc<AtomicBool>, mpsc::Receiver<Vec<f64>>) {
    let (over, (times, visible)) = (Arc::new(AtomicBool::new(false)), mpsc::channel());
    let ended = over.clone();
    std::thread::spawn(move || {
        let mut all = Vec::new();
        let mut pending: Vec<(RecordId, Instant, Vec<Known>)> = Vec::new();
        while !ended.load(Ordering::Relaxed) {
            std::thread::sleep(LOOK);
            for (id, made) in lock(&watch().watched).drain(..) {
                pending.push((id, made, lock(&watch().replicas).clone()));
            }
            pending.retain_mut(|(id, made, lacking)| {
                while lacking.pop_if(|known| known(*id).is_some()).is_some() {}
                if lacking.is_empty() {
                    all.push(made.elapsed().as_secs_f64() * 1e3);
                }
                !lacking.is_empty()
            });
        }
        // Who asked for them may be gone.
        let _ = times.send(all);
    });
    (over, visible)
}

fn chart(name: &str, runs: &[Run]) -> Result<(), Box<dyn Error>> {
    let curve = |name: &str, value: &dyn Fn(&Run) -> f64| -> Curve {
        (name.into(), runs.iter().map(|run| (run.workers, value(run))).collect())
    };
    let idle: Vec<_> = PHASES.iter().map(|phase| curve(phase, &|run| run.idle(phase))).collect();
    let panels = [
        (
            "speed-up over one worker",
            vec![curve("measured", &|run| run.ideal() * run.workers / run.wall), curve("ideal", &|run| run.workers)],
        ),
        ("idle share of workers, %", idle),
        (
            "from gathered to in every replica, ms",
            vec![curve("p50", &|run| run.visible[0]), curve("p99", &|run| run.visible[1])],
        ),
        (
            "CPU seconds of the frame",
            vec![curve("server", &|run| run.server.cpu), curve("all workers' protocol", &|run| run.clients)],
        ),
        (
            "megabytes",
            vec![
                curve("server's peak memory", &|run| run.server.peak / 1e6),
                curve("records to each worker", &|run| run.received / 1e6),
            ],
        ),
        (
            "work done twice, %",
            vec![
                curve("records", &|run| 100.0 * (run.made as f64 / run.done.records as f64 - 1.0)),
                curve("leases lost", &|run| 100.0 * run.done.leases_lost as f64 / run.leases as f64),
            ],
        ),
    ];
    curves(name, &panels)
}
