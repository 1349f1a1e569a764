//! What a simulated worker computes: nothing. It waits as long as a renderer would gather, and makes records up.
//!
//! Which candidates find no record, how long a gather takes and what a record holds are drawn from hashes of pixel, pass
//! and level, so every farm does the same work. What a real fill looks like is kept: nearly all candidates of the first
//! ranks are uncovered, fewer and fewer later; corners need more than walls.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use cache_core::rounds::{PATTERN, Step, look, rank};
use cache_core::{RecordId, Tag};
use cache_proto::{convert, v1};
use worker::frame::CHANNELS;
use worker::job::{Job, Known, Work};
use worker::scenes::Scenes;
use worker::task::Done;

use crate::records;

/// Edge of a tile in pixels.
const TILE: u32 = 16;

/// Share of candidates uncovered at rank r of the first pass: SHARE (r + 1)^FALL, at most all.
const SHARE: f32 = 1.1;
const FALL: f32 = -0.75;

/// Share uncovered in later passes that look elsewhere.
const LATER: f32 = 1e-3;

/// Time to test one candidate, and to make one pixel, microseconds.
const TEST: f32 = 2.0;
const PIXEL: f32 = 20.0;

/// What all workers of this process tell the benchmark.
#[derive(Default)]
pub struct Watch {
    /// Leases worked on.
    pub leases: AtomicU64,
    /// Mean time of a gather, microseconds.
    pub gather: AtomicU64,
    /// Records made, those made twice included.
    pub made: AtomicU64,
    /// How each worker finds what its replica holds.
    pub replicas: Mutex<Vec<Known>>,
    /// Records whose way is watched, and when they were made.
    pub watched: Mutex<Vec<(RecordId, Instant)>>,
}

/// One of so many records is watched.
const WATCH_EVERY: u64 = 64;

/// Where they tell it: a worker makes its jobs itself.
pub fn watch() -> &'static Watch {
    static WATCH: OnceLock<Watch> = OnceLock::new();
    WATCH.get_or_init(Watch::default)
}

/// One worker's part of the frame.
pub struct Pretended {
    width: u32,
    height: u32,
    /// Mean time of a gather, microseconds.
    gather: f32,
    /// Time worked but not yet waited for, or waited for in advance, microseconds: clocks tick in milliseconds.
    owed: Mutex<f64>,
    known: OnceLock<()>,
}

/// The frame: what a renderer would ask for.
pub fn spec(width: u32, height: u32) -> v1::FrameSpec {
    let vector = Some(v1::Vector { x: 1.0, y: 0.0, z: 0.0 });
    v1::FrameSpec {
        scene: "simulated".into(),
        scene_hash: vec![1; 32].into(),
        namespace: records::NAMESPACE.0.to_vec().into(),
        camera: Some(v1::CameraSpec { eye: vector, forward: vector, right: vector, up: vector, parallel: false }),
        width,
        height,
        tile_size: TILE,
        spp: 32,
        method: "irradiance".into(),
        a: records::A,
        rays: 2048,
        bounces: 2,
        seed: 0,
        levels: 2,
        adaptive: false,
        splat: false,
        effort: None,
    }
}

impl Job for Pretended {
    async fn prepare(_: u64, described: &v1::DescribeResponse, _: &Scenes) -> Result<Self, String> {
        let spec = described.spec.clone().ok_or("no frame described")?;
        let v1::FrameSpec { width, height, .. } = spec;
        let gather = watch().gather.load(Ordering::Relaxed) as f32;
        Ok(Self { width, height, gather, owed: Mutex::default(), known: OnceLock::new() })
    }

    /// One level, which its records are not of: they are kept and their digest is checked, but no cache is made of them.
    fn levels(&self) -> u32 {
        1
    }

    fn a(&self) -> f32 {
        records::A
    }

    async fn run(self: Arc<Self>, work: Work) -> Result<Option<Done>, String> {
        self.known.get_or_init(|| lock(&watch().replicas).push(work.known.clone()));
        watch().leases.fetch_add(1, Ordering::Relaxed);
        let mut done = Done::default();
        let mut micros = 0.0;
        for tile in work.tiles.start..work.tiles.end.min(self.tiles()) {
            match convert::plan_step(&work.step) {
                Step::Fill { level, pass, ranks } => {
                    micros += self.fill(tile, level, pass, ranks, work.step.index, &mut done);
                }
                Step::Pixels => {
                    let pixels = self.pixels(tile);
                    micros += PIXEL * pixels as f32;
                    let pixels = vec![0x3f; pixels * CHANNELS * 4].into();
                    done.tiles.push(v1::FrameTile { tile, pixels });
                }
            }
        }
        done.cpu_seconds = f64::from(micros) * 1e-6;
        self.wait(f64::from(micros)).await;
        if let Some((_, record)) = done.records.first() {
            let before = watch().made.fetch_add(done.records.len() as u64, Ordering::Relaxed);
            if (before + done.records.len() as u64) / WATCH_EVERY > before / WATCH_EVERY {
                lock(&watch().watched).push((record.id(), Instant::now()));
            }
        }
        Ok(Some(done))
    }
}

impl Pretended {
    fn tiles(&self) -> u32 {
        self.width.div_ceil(TILE) * self.height.div_ceil(TILE)
    }

    /// Where a tile stands among the others.
    fn place(&self, tile: u32) -> [u32; 2] {
        let columns = self.width.div_ceil(TILE);
        [tile % columns, tile / columns]
    }

    /// How many pixels a tile has; those at the edges are cut.
    fn pixels(&self, tile: u32) -> usize {
        let [column, row] = self.place(tile);
        let span = |at: u32, end: u32| TILE.min(end - at * TILE) as usize;
        span(column, self.width) * span(row, self.height)
    }

    /// Gathers what is uncovered in a tile; says how long that takes, microseconds.
    fn fill(&self, tile: u32, level: u32, pass: u32, ranks: Range<u32>, step: u32, done: &mut Done) -> f32 {
        let mut micros = 0.0;
        // Few tiles need much, most need little.
        let need = 0.25 * 16f32.powf(uniform(&[tile, level])) * 0.74;
        let [column, row] = self.place(tile);
        let pixels = pixels_by_rank(column, row);
        let [from, to] = [ranks.start, ranks.end].map(|end| pixels.partition_point(|[rank, ..]| *rank < end));
        for [rank, x, y] in &pixels[from..to] {
            let [x, y] = [column * TILE + x, row * TILE + y];
            if x >= self.width || y >= self.height {
                continue;
            }
            micros += TEST;
            let share = match pass {
                0 => SHARE * ((*rank + 1) as f32).powf(FALL) * need,
                pass if look(level, pass) == pass => LATER * need / pass as f32,
                _ => 0.0,
            };
            if uniform(&[x, y, level, pass]) < share {
                let site = [x as f32, y as f32, level as f32, pass as f32];
                micros += self.gather * 0.25 * 16f32.powf(uniform(&[x, y, level, pass, 1])) * 0.74;
                // Of a level nobody seals here; see `levels`.
                done.records.push((Tag { level: 2, step }, records::at(&site, 0.01).into()));
            }
        }
        micros
    }

    async fn wait(&self, micros: f64) {
        let due = {
            let mut owed = lock(&self.owed);
            *owed += micros;
            *owed
        };
        if due < 1000.0 {
            return;
        }
        let start = Instant::now();
        tokio::time::sleep(Duration::from_secs_f64(due * 1e-6)).await;
        *lock(&self.owed) -= start.elapsed().as_secs_f64() * 1e6;
    }
}

/// A number in [0, 1) that depends on `numbers` alone (splitmix64).
fn uniform(numbers: &[u32]) -> f32 {
    let mut hash = 0u64;
    for &number in numbers {
        hash = (hash ^ u64::from(number)).wrapping_add(0x9E37_79B9_7F4A_7C15);
        hash = (hash ^ hash >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        hash = (hash ^ hash >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        hash ^= hash >> 31;
    }
    (hash >> 40) as f32 / (1 << 24) as f32
}

/// Whoever panicked with it was reported.
pub fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// The pixels of a tile of each place in the pattern, lowest ranks first.
fn pixels_by_rank(column: u32, row: u32) -> &'static [[u32; 3]] {
    static TILES: OnceLock<Vec<Vec<[u32; 3]>>> = OnceLock::new();
    const PERIOD: u32 = PATTERN / TILE;
    let tile = |at: u32| {
        let (left, top) = (at % PERIOD * TILE, at / PERIOD * TILE);
        let pixels = (0..TILE * TILE).map(|i| [i % TILE, i / TILE]);
        let mut ranked: Vec<_> = pixels.map(|[x, y]| [rank(left + x, top + y), x, y]).collect();
        ranked.sort_unstable();
        ranked
    };
    let tiles = TILES.get_or_init(|| (0..PERIOD * PERIOD).map(tile).collect());
    &tiles[(row % PERIOD * PERIOD + column % PERIOD) as usize]
}
