//! An Ethernet wire between two interfaces, in this process: it delays and loses frames, whatever the kernel was built with.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use rand_core::{Rng as _, SeedableRng as _};
use rand_pcg::Pcg32;
use tun_rs::{DeviceBuilder, Layer, SyncDevice};

/// Longest frame: the interfaces' 1500 bytes and their header.
const FRAME: usize = 1600;

/// Frames on their way at most; more are lost, as in any queue.
const QUEUE: usize = 4096;

/// What a wire does to frames, in both directions alike.
#[derive(Default)]
pub struct Wire {
    delay_ms: AtomicU64,
    /// Of a hundred frames.
    lost: AtomicU32,
    /// Frames lost so far.
    dropped: AtomicU64,
}

impl Wire {
    /// A wire between two new interfaces of these names.
    pub fn new(names: [&str; 2]) -> io::Result<Arc<Self>> {
        let end = |name: &str| DeviceBuilder::new().name(name).layer(Layer::L2).build_sync().map(Arc::new);
        let [a, b] = [end(names[0])?, end(names[1])?];
        let wire = Arc::new(Self::default());
        wire.carry(a.clone(), b.clone(), 1);
        wire.carry(b, a, 2);
        Ok(wire)
    }

    /// From now on, each way.
    pub fn set(&self, delay: Duration, lost: u32) {
        self.delay_ms.store(delay.as_millis() as u64, Relaxed);
        self.lost.store(lost, Relaxed);
    }

    /// How many frames were lost on purpose.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Relaxed)
    }

    /// One direction, for as long as this process lives.
    fn carry(self: &Arc<Self>, from: Arc<SyncDevice>, to: Arc<SyncDevice>, seed: u64) {
        let (queue, frames) = mpsc::sync_channel::<(Instant, Vec<u8>)>(QUEUE);
        std::thread::spawn(move || {
            for (due, frame) in frames {
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
                // An interface that is down loses it.
                drop(to.send(&frame));
            }
        });
        let wire = self.clone();
        std::thread::spawn(move || {
            let (mut buffer, mut random) = ([0; FRAME], Pcg32::seed_from_u64(seed));
            loop {
                let Ok(bytes) = from.recv(&mut buffer) else {
                    std::thread::sleep(Duration::from_millis(10));
                    continue;
                };
                if random.next_u32() % 100 < wire.lost.load(Relaxed) {
                    wire.dropped.fetch_add(1, Relaxed);
                    continue;
                }
                let due = Instant::now() + Duration::from_millis(wire.delay_ms.load(Relaxed));
                drop(queue.try_send((due, buffer[..bytes].to_vec())));
            }
        });
    }
}
