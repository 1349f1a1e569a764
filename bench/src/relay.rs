//! What a relay costs: records down and up, calls that pass through, latency and memory, beside the same without one.
//!
//! The server, each relay (`ambience serve --upstream`) and all clients are processes on this machine, joined by Unix
//! sockets; the server keeps its records in memory.

use std::error::Error;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cache_proto::v1;
use nix::time::clock_getcpuclockid;
use nix::unistd::Pid;
use tempfile::TempDir;
use tokio::net::UnixStream;
use worker::client::{self, Cache, Line, connect_with};

use crate::host::{Host, Kind, Usage, peak};
use crate::peers::program;
use crate::records::{self, NAMESPACE};
use crate::report::{Report, quantile};
use crate::service::{follow, pings, read, send};

/// Records of one measurement.
const RECORDS: u64 = 1 << 18;

/// Subscribers at once.
const SUBSCRIBERS: [u64; 3] = [1, 8, 40];

/// Callers at once that insert as workers do, and the records in one of their calls.
const CALLERS: u64 = 16;
const CALL_RECORDS: u64 = 64;

/// Calls that pass through, one after another.
const CALLS: u64 = 4000;

/// How long a relay may take to listen.
const START: Duration = Duration::from_secs(10);

/// Arguments of the benchmark.
#[derive(Clone, Debug, clap::Args)]
pub struct RelayArgs {
    /// Rounds; the median counts
    #[arg(long, default_value_t = 3)]
    rounds: usize,
    /// Keep the tables in bench/results
    #[arg(long)]
    save: bool,
}

/// A relay in a process of its own. Dropping it ends the process.
pub struct Relay {
    child: Child,
    folder: TempDir,
}

impl Relay {
    /// Starts a relay under the server or relay at the address, and waits until it listens.
    ///
    /// # Errors
    /// No program `ambience` beside this one, or it does not come up.
    pub fn start(upstream: &str) -> Result<Self, Box<dyn Error>> {
        let folder = tempfile::Builder::new().prefix("ambience-bench-").tempdir()?;
        let mut command = Command::new(program()?);
        command
            .args(["serve", "--upstream", upstream, "--listen"])
            .arg(format!("unix:{}/socket", folder.path().display()));
        let child = command.env("RUST_LOG", "error").stdin(Stdio::null()).stdout(Stdio::null()).spawn()?;
        let mut relay = Self { child, folder };
        let start = Instant::now();
        while std::os::unix::net::UnixStream::connect(relay.folder.path().join("socket")).is_err() {
            if relay.child.try_wait()?.is_some() || start.elapsed() > START {
                return Err("the relay does not come up".into());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(relay)
    }

    /// Where it listens.
    pub fn address(&self) -> String {
        format!("unix:{}/socket", self.folder.path().display())
    }

    /// A new connection.
    pub fn connect(&self) -> Line {
        let path = self.folder.path().join("socket");
        connect_with(move || UnixStream::connect(path.clone()))
    }

    /// What it has used so far.
    ///
    /// # Errors
    /// When it has ended.
    pub fn usage(&self) -> Result<Usage, Box<dyn Error>> {
        let id = self.child.id();
        let cpu = clock_getcpuclockid(Pid::from_raw(id.try_into()?))?.now()?;
        let peak = peak(&id.to_string()).ok_or("the relay has ended")?;
        Ok(Usage { cpu: Duration::from(cpu).as_secs_f64(), peak })
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A server, and relays one above the other.
struct Stand {
    host: Host,
    relays: Vec<Relay>,
}

impl Stand {
    fn new(levels: usize) -> Result<Self, Box<dyn Error>> {
        let host = Host::start(Kind::Memory, 0, 1)?;
        let mut relays: Vec<Relay> = Vec::new();
        for _ in 0..levels {
            let above = relays.last().map_or_else(|| host.address(), Relay::address);
            relays.push(Relay::start(&above)?);
        }
        Ok(Self { host, relays })
    }

    fn connect(&self) -> Line {
        self.relays.last().map_or_else(|| self.host.connect(), Relay::connect)
    }

    fn cache(&self) -> Cache {
        client::cache(self.connect())
    }

    /// Of the server, and of the relay that clients call.
    fn usage(&mut self) -> Result<[Usage; 2], Box<dyn Error>> {
        let relay = self.relays.last().map(Relay::usage).transpose()?;
        Ok([self.host.usage()?, relay.unwrap_or_default()])
    }
}

/// Measures and prints everything.
///
/// # Errors
/// When a server or relay does not come up or answers with an error.
pub fn run(args: &RelayArgs) -> Result<(), Box<dyn Error>> {
    let mut report = Report::begin("cargo run --release -p ambience-bench -- relay");
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    runtime.block_on(async {
        down(&mut report, args.rounds).await?;
        up(&mut report, args.rounds).await?;
        calls(&mut report).await?;
        latency(&mut report).await
    })?;
    if args.save {
        report.save("relay")?;
    }
    Ok(())
}

/// Medians of some rounds: CPU microseconds of the server and of the relay for each of `count`, and bytes by which the
/// relay's memory grew for each.
async fn costs(
    rounds: usize,
    levels: usize,
    kept: u64,
    count: u64,
    work: impl AsyncFn(&Stand) -> Result<(), Box<dyn Error>>,
) -> Result<[f64; 3], Box<dyn Error>> {
    let mut samples = [(); 3].map(|()| Vec::new());
    for _ in 0..rounds {
        let mut stand = Stand::new(levels)?;
        send(&mut client::cache(stand.host.connect()), records::batches(&NAMESPACE, kept, 4096)).await?;
        stand.cache().info(v1::InfoRequest {}).await?;
        let before = stand.usage()?;
        work(&stand).await?;
        let after = stand.usage()?;
        let each = |from: f64, to: f64| (to - from) / count as f64;
        let [server, relay] = [0, 1].map(|at| each(before[at].cpu, after[at].cpu) * 1e6);
        for (all, one) in samples.iter_mut().zip([server, relay, each(before[1].peak, after[1].peak)]) {
            all.push(one);
        }
    }
    Ok(samples.map(|mut all| quantile(&mut all, 0.5)))
}

fn way(levels: usize) -> &'static str {
    ["to the server", "through a relay", "through two relays"][levels]
}

/// Records down: a log of the server's, each subscriber on a connection of its own.
async fn down(report: &mut Report, rounds: usize) -> Result<(), Box<dyn Error>> {
    report.line(&format!("\ndown: {RECORDS} records to subscribers at once; us of CPU for a record of the log"));
    let heads = ["", "server", "relay", "relay, each subscriber", "relay's bytes"];
    report.line(&format!("{:36} {:>8} {:>8} {:>24} {:>14}", heads[0], heads[1], heads[2], heads[3], heads[4]));
    for (subscribers, levels) in SUBSCRIBERS.into_iter().flat_map(|count| [(count, 0), (count, 1)]) {
        let [server, relay, bytes] = costs(rounds, levels, RECORDS, RECORDS, async |stand: &Stand| {
            let mut readers = Vec::new();
            for _ in 0..subscribers {
                let stream = follow(&mut stand.cache(), &NAMESPACE, 0).await?;
                readers.push(tokio::spawn(read(stream, RECORDS)));
            }
            for reader in readers {
                reader.await??;
            }
            Ok(())
        })
        .await?;
        let name = format!("{subscribers} {}", way(levels));
        let each = relay / subscribers as f64;
        report.line(&format!("{name:36} {server:8.3} {relay:8.3} {each:24.3} {bytes:14.0}"));
    }
    Ok(())
}

/// Records up: in one call, and by callers who each wait for their answer.
async fn up(report: &mut Report, rounds: usize) -> Result<(), Box<dyn Error>> {
    report.line(&format!("\nup: {RECORDS} records; us of CPU for a record"));
    report.line(&format!("{:52} {:>8} {:>8}", "", "server", "relay"));
    for (callers, size) in [(1, 4096), (CALLERS, CALL_RECORDS)] {
        for levels in [0, 1] {
            let [server, relay, _] = costs(rounds, levels, 0, RECORDS, async |stand: &Stand| {
                let batches = records::batches(&NAMESPACE, RECORDS, size);
                let share = batches.len() / callers as usize;
                let inserting = batches.chunks(share).map(|mine| {
                    let (mut cache, mine) = (stand.cache(), mine.to_vec());
                    tokio::spawn(async move {
                        // One caller brings all in one call.
                        let together = if callers == 1 { mine.len() } else { 1 };
                        for call in mine.chunks(together) {
                            send(&mut cache, call.to_vec()).await?;
                        }
                        Ok::<_, tonic::Status>(())
                    })
                });
                for done in inserting.collect::<Vec<_>>() {
                    done.await??;
                }
                Ok(())
            })
            .await?;
            let name = format!("{callers} caller(s), batches of {size}, {}", way(levels));
            report.line(&format!("{name:52} {server:8.3} {relay:8.3}"));
        }
    }
    Ok(())
}

/// Calls of `Frames`, which a relay does not decode: a lease is asked for, kept and given back by calls such as these.
async fn calls(report: &mut Report) -> Result<(), Box<dyn Error>> {
    report.line(&format!("\ncalls: {CALLS} of Frames.Renew, one after another"));
    report.line(&format!("{:28} {:>10} {:>10} {:>14} {:>14}", "", "p50 us", "p99 us", "server us CPU", "relay us CPU"));
    for levels in [0, 1] {
        let mut stand = Stand::new(levels)?;
        let mut frames = client::frames(stand.connect());
        let request = v1::RenewRequest { worker: "bench".into(), ..Default::default() };
        frames.renew(request.clone()).await?;
        let before = stand.usage()?;
        let mut times = Vec::new();
        for _ in 0..CALLS {
            let start = Instant::now();
            frames.renew(request.clone()).await?;
            times.push(start.elapsed().as_secs_f64() * 1e6);
        }
        let after = stand.usage()?;
        let [server, relay] = [0, 1].map(|at| (after[at].cpu - before[at].cpu) / CALLS as f64 * 1e6);
        let [p50, p99] = [0.5, 0.99].map(|q| quantile(&mut times, q));
        report.line(&format!("{:28} {p50:10.0} {p99:10.0} {server:14.1} {relay:14.1}", way(levels)));
    }
    Ok(())
}

/// From the call that inserts a few records until a subscriber has them, both beside each other.
async fn latency(report: &mut Report) -> Result<(), Box<dyn Error>> {
    report.line("\nlatency: 16 records from the call of Insert to a subscriber; idle");
    report.line(&format!("{:28} {:>10} {:>10} {:>10}", "", "p50 us", "p99 us", "added p50"));
    let mut direct = f64::NAN;
    for levels in [0, 1, 2] {
        let stand = Stand::new(levels)?;
        let [p50, p99] = pings(stand.cache(), stand.cache(), 0).await?;
        if levels == 0 {
            direct = p50;
        }
        report.line(&format!("{:28} {p50:10.0} {p99:10.0} {:10.0}", way(levels), p50 - direct));
    }
    Ok(())
}
