//! Look-ups a second: the sealed octree against a naive one of pointers, with the same records, questions and hits.

use std::error::Error;
use std::hint::black_box;
use std::time::Instant;

use cache_core::details::Details;
use cache_core::id::Random;
use cache_core::irradiance::Answer;
use cache_core::math::Frame as Tangents;
use cache_core::{Cached as _, Irradiance, Query, RecordId, Sealed};
use glam::Vec3;
use worker::frame::Frame;
use worker::settings::Settings;
use worker::solo::{self, Order};

use crate::judge::{load, settings};

/// How many records to ask.
#[derive(clap::Args)]
pub struct LookupsArgs {
    /// Sizes of the cache
    #[arg(default_values_t = [10_000usize, 100_000, 1_000_000])]
    records: Vec<usize>,
    /// Questions in one round
    #[arg(long, default_value_t = 200_000)]
    questions: usize,
    /// Rounds that take turns; medians are printed
    #[arg(long, default_value_t = 7)]
    rounds: usize,
}

/// Allowed error of all records.
const A: f32 = 0.3;

/// Prints one line a size.
///
/// # Errors
/// A sealed octree that finds other records than the naive one.
pub fn run(args: &LookupsArgs) -> Result<(), Box<dyn Error>> {
    let room = of_a_render();
    println!(
        "{} records of the stairs at 256 x 256, a {A}, in copies of the room side by side; {} questions within 1.5 of a record's reach, \
         medians of {} rounds in turn, one thread",
        room.len(),
        args.questions,
        args.rounds
    );
    println!(
        "records   hits    naive     sealed    ratio | made: naive, sealed, sealed again with 1 % more | bytes a record"
    );
    for &count in &args.records {
        let records = copies(&room, count);
        let questions = questions(&records, args.questions);
        let start = Instant::now();
        let naive = Naive::new(&records);
        let inserted = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let mut sealed = Sealed::with(A, Details { neighbor_clamping: false, ..Details::default() });
        sealed.extend(records[..count - count / 100].iter().copied());
        let made = start.elapsed().as_secs_f64();
        let start = Instant::now();
        sealed.extend(records[count - count / 100..].iter().copied());
        let extended = start.elapsed().as_secs_f64();
        let (mut times, mut hits) = ([Vec::new(), Vec::new()], [0u64; 2]);
        for _ in 0..args.rounds {
            for which in 0..2 {
                let ask = |q| if which == 0 { naive.ask(q) } else { sealed.ask(q) };
                let start = Instant::now();
                hits[which] = questions.iter().map(|q| u64::from(black_box(ask(q)).map_or(0, |a| a.records))).sum();
                times[which].push(start.elapsed().as_secs_f64() / questions.len() as f64 * 1e9);
            }
        }
        if hits[0] != hits[1] {
            return Err(format!("{} hits of the naive octree, {} of the sealed one", hits[0], hits[1]).into());
        }
        let [naive_ns, sealed_ns] = times.map(|mut t| {
            t.sort_by(f64::total_cmp);
            t[t.len() / 2]
        });
        println!(
            "{count:8} {:5.2} {naive_ns:6.0} ns {sealed_ns:6.0} ns  {:5.2} x | {inserted:.3} s {made:.3} s {extended:.3} s | {:.1}",
            hits[1] as f64 / questions.len() as f64,
            naive_ns / sealed_ns,
            sealed.bytes() as f64 / sealed.len() as f64,
        );
    }
    Ok(())
}

/// Records of level 1 as a render makes them.
fn of_a_render() -> Vec<Irradiance> {
    let (scene, camera) = load("stairs.glb");
    let base = Settings { width: 256, height: 256, a: A, rays: 64, ..settings(camera, "one") };
    let levels = solo::fill(&Frame::new(scene, base), Order::Rounds);
    levels[0].irradiance.records().to_vec()
}

/// `count` records: copies of the room, each in its place of a square.
fn copies(room: &[Irradiance], count: usize) -> Vec<Irradiance> {
    let low = room.iter().map(|r| r.position).fold(Vec3::INFINITY, Vec3::min);
    let size = room.iter().map(|r| r.position).fold(Vec3::NEG_INFINITY, Vec3::max) - low;
    let side = count.div_ceil(room.len()).isqrt() + 1;
    let of = |i: usize| {
        let (record, copy) = (room[i % room.len()], i / room.len());
        let shift = Vec3::new((copy % side) as f32 * size.x, 0.0, (copy / side) as f32 * size.z);
        Irradiance { id: RecordId(record.id.0 ^ i as u128), position: record.position + shift, ..record }
    };
    (0..count).map(of).collect()
}

/// Points on the tangent planes of records, somewhat farther than these reach.
fn questions(records: &[Irradiance], count: usize) -> Vec<Query> {
    let mut random = Random::named("lookups", &[]);
    let mut one = || {
        let record = &records[(random.uniform() * records.len() as f32) as usize % records.len()];
        let tangents = Tangents::around(record.normal);
        let reach = 1.5 * A * radius(record);
        let mut along = || (2.0 * random.uniform() - 1.0) * reach;
        Query::new(record.position + tangents.x * along() + tangents.y * along(), record.normal)
    };
    (0..count).map(|_| one()).collect()
}

fn radius(record: &Irradiance) -> f32 {
    let (min, max) = record.radius_bounds();
    record.radius.min(max).max(min)
}

/// An octree as one first writes it: cells and records are boxes, each record is in all cells of its size that it touches.
struct Naive {
    half: f32,
    root: Cell,
    details: Details,
}

#[derive(Default)]
struct Cell {
    children: [Option<Box<Cell>>; 8],
    records: Vec<std::sync::Arc<Irradiance>>,
}

impl Naive {
    fn new(records: &[Irradiance]) -> Self {
        let farthest = records.iter().map(|r| r.position.abs().max_element() + A * radius(r)).fold(0.0, f32::max);
        let mut root = Cell::default();
        for record in records {
            root.insert(Vec3::splat(-farthest), 2.0 * farthest, &std::sync::Arc::new(*record), A * radius(record));
        }
        Self { half: farthest, root, details: Details::default() }
    }

    fn ask(&self, query: &Query) -> Option<Answer> {
        let (mut answer, mut weights) = (Answer::default(), 0.0);
        let (mut cell, mut low, mut size) = (&self.root, Vec3::splat(-self.half), 2.0 * self.half);
        loop {
            for record in &cell.records {
                let radius = radius(record);
                let weight = self.details.weighting.weight(record.error(query, radius, A), A);
                if weight > 0.0 {
                    record.add(query, weight, (record.radius / radius).min(1.0), &mut answer);
                    weights += weight;
                }
            }
            size *= 0.5;
            let upper = query.position.cmpge(low + size);
            low = Vec3::select(upper, low + size, low);
            match &cell.children[upper.bitmask() as usize] {
                Some(child) => cell = child,
                None => break,
            }
        }
        (weights > 0.0).then(|| {
            Irradiance::finish(&mut answer, weights);
            answer
        })
    }
}

impl Cell {
    fn insert(&mut self, low: Vec3, size: f32, record: &std::sync::Arc<Irradiance>, reach: f32) {
        if size < 4.0 * reach {
            return self.records.push(record.clone());
        }
        let half = size * 0.5;
        for octant in 0..8 {
            let corner = low + half * Vec3::new((octant & 1) as f32, (octant >> 1 & 1) as f32, (octant >> 2) as f32);
            let gap = (corner - record.position).max(record.position - (corner + half)).max_element();
            if gap <= reach {
                self.children[octant].get_or_insert_default().insert(corner, half, record, reach);
            }
        }
    }
}
