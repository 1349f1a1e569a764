//! What goes wrong, and when: drawn from the seed before the simulation begins.

use std::time::Duration;

use cache_core::id::Random;

use crate::network::SERVER;

/// The witness that stays well where a disk is lost, so that one replica lives.
pub const STEADY: &str = "witness-1";

/// Hosts with owners of frames.
pub const OWNERS: [&str; 2] = ["owner-1", "owner-2"];

/// Hosts with workers.
pub const WORKERS: [&str; 3] = ["worker-1", "worker-2", "worker-3"];

/// Hosts that follow and keep.
pub const WITNESSES: [&str; 2] = [STEADY, "witness-2"];

/// Inserts records that belong to no frame.
pub const SHARER: &str = "sharer";
/// Subscribes and never reads.
pub const SLEEPER: &str = "sleeper";

/// What goes wrong. Network faults lie between a host and the server.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Fault {
    /// Nothing gets through.
    Partition(&'static str),
    /// What the host sends is lost.
    Mute(&'static str),
    /// What is sent to the host is lost.
    Deaf(&'static str),
    /// Nothing gets through, and all of it at the end: seen from elsewhere, a process that was stopped.
    Stop(&'static str),
    /// Messages are lost now and then.
    Drops(&'static str),
    /// Messages take up to seconds.
    Slow(&'static str),
    /// A machine crashes and comes back.
    Crash(&'static str),
    /// As a crash, but nobody hears of it: a machine that lost its power.
    PowerLoss(&'static str),
    /// The server crashes and comes back, or another in its place, without its disk.
    DiskLost,
    /// The server's disk takes no more.
    DiskFull,
    /// The server's clock jumps, as after a pause of its machine.
    ClockJump(Duration),
    /// The owners go away and open their frames again.
    Away,
}

/// A fault and its time.
#[derive(Clone, Copy, Debug)]
pub struct Planned {
    /// When it begins.
    pub from: Duration,
    /// When it ends.
    pub to: Duration,
    /// What.
    pub fault: Fault,
}

impl Fault {
    /// Whether it befalls the links of its host.
    pub fn is_of_network(&self) -> bool {
        use Fault::{Deaf, Drops, Mute, Partition, PowerLoss, Slow, Stop};
        matches!(self, Partition(_) | Mute(_) | Deaf(_) | Stop(_) | Drops(_) | Slow(_) | PowerLoss(_))
    }

    /// The host it befalls.
    pub fn host(&self) -> &'static str {
        match self {
            Self::Partition(host) | Self::Mute(host) | Self::Deaf(host) | Self::Stop(host) => host,
            Self::Drops(host) | Self::Slow(host) | Self::Crash(host) | Self::PowerLoss(host) => host,
            Self::DiskLost | Self::DiskFull | Self::ClockJump(_) => SERVER,
            Self::Away => OWNERS[0],
        }
    }
}

/// One simulation's faults and sizes.
#[derive(Clone, Debug)]
pub struct Schedule {
    /// Faults by their beginning. No two befall one host at a time.
    pub faults: Vec<Planned>,
    /// Longest time a message takes, ms.
    pub latency: u64,
    /// How many owners, workers, and leases at a time each worker has.
    pub owners: usize,
    /// Workers.
    pub workers: usize,
    /// Leases at a time.
    pub threads: usize,
    /// Levels of records, and tiles of a picture.
    pub levels: u32,
    /// Tiles.
    pub tiles: u32,
}

/// One more than the most faults.
const FAULTS: usize = 14;

/// Within this time faults begin, ms.
const WINDOW: f32 = 12_000.0;

/// A fault's longest time, ms: longer than a lease, shorter than a client's patience.
const LONGEST: f32 = 9_000.0;

impl Schedule {
    /// The schedule of a seed.
    pub fn of(seed: u64) -> Self {
        let mut random = Random::named("schedule", &[seed]);
        let mut below = |n: usize| ((random.uniform() * n as f32) as usize).min(n - 1);
        let latency = [1, 5, 20, 50][below(4)];
        let owners = [1, 1, 2][below(3)];
        let workers = 1 + below(3);
        let threads = 1 + below(2);
        let levels = if below(8) == 0 { 2 } else { 1 };
        let tiles = 1 + below(4) as u32;
        let count = below(FAULTS);
        let mut faults: Vec<Planned> = Vec::new();
        for _ in 0..count {
            let hosts = hosts(owners, workers);
            let host = hosts[below(hosts.len())];
            let fault = match below(12) {
                0 => Fault::Partition(host),
                1 => Fault::Mute(host),
                2 => Fault::Deaf(host),
                3 => Fault::Stop(host),
                4 => Fault::Drops(host),
                5 => Fault::Slow(host),
                6 => Fault::Crash(host),
                7 => Fault::PowerLoss(host),
                8 => Fault::DiskLost,
                9 => Fault::DiskFull,
                10 => Fault::ClockJump(Duration::from_millis(below(20_000) as u64)),
                _ => Fault::Away,
            };
            let from = (below(1 << 20) as f32 / (1 << 20) as f32) * WINDOW;
            let time = (below(1 << 20) as f32 / (1 << 20) as f32).powi(2) * LONGEST + 100.0;
            let [from, to] = [from, from + time].map(|ms| Duration::from_millis(ms as u64));
            let planned = Planned { from, to, fault };
            if faults.iter().all(|other| other.suits(&planned)) {
                faults.push(planned);
            }
        }
        faults.sort_by_key(|planned| planned.from);
        Self { faults, latency, owners, workers, threads, levels, tiles }
    }
}

impl Planned {
    /// Whether both can be: not on one host or link at a time; and where the disk is lost one replica lives, and finds the
    /// server within the time that it waits for its records.
    fn suits(&self, other: &Self) -> bool {
        let apart = self.to < other.from || other.to < self.from;
        let pair = [self.fault, other.fault];
        let same_host = self.fault.host() == other.fault.host();
        let same_link = pair.iter().all(Fault::is_of_network) && pair.iter().any(|fault| fault.host() == SERVER);
        let spoils = |fault: Fault| {
            fault.host() == STEADY
                || fault.host() == SERVER && fault.is_of_network()
                || matches!(fault, Fault::DiskFull | Fault::ClockJump(_))
        };
        let hopeless = pair.contains(&Fault::DiskLost) && pair.into_iter().any(spoils);
        (apart || !same_host && !same_link) && !hopeless
    }
}

/// The hosts of a simulation: the server twice as likely as any other to be drawn.
pub fn hosts(owners: usize, workers: usize) -> Vec<&'static str> {
    [&[SERVER, SERVER], &OWNERS[..owners], &WORKERS[..workers], &WITNESSES, &[SHARER, SLEEPER]].concat()
}
