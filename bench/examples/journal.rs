//! What durability costs, and how long a journal of a million records takes to come back.
//!
//! `cargo run --release -p ambience-bench --example journal [RECORDS]` prints seconds: appending with and without waiting
//! for the device, and opening the file as it was closed, as a crash leaves it, and with a megabyte of it zeroed;
//! opening includes checking every value and filling a replica with its records.

use std::fs;
use std::io;
use std::path::Path;
use std::time::Instant;

use cache_core::{Irradiance, Namespace, RecordId, Tag};
use cache_proto::convert;
use cache_proto::v1::{Entry, entry};
use cache_server::journal::Journal as _;
use cache_server::journal::device::Sync;
use cache_server::journal::disk::{Disk, FILE};
use cache_server::limits::Limits;
use cache_server::replica::Replica;
use glam::{Vec2, Vec3};

type Failed = Box<dyn std::error::Error>;

fn main() -> Result<(), Failed> {
    let records: u64 = std::env::args().nth(1).map_or(Ok(1_000_000), |count| count.parse())?;
    println!("{records} records of 128 bytes");
    println!("{:44} {:>9} {:>12} {:>9}", "", "seconds", "records/s", "MB");
    for size in [256, 4096] {
        for (sync, waits) in [(Sync::Device, "device"), (Sync::PageCache, "page cache")] {
            let directory = tempfile::tempdir()?;
            let batches: Vec<_> =
                (0..records).step_by(size as usize).map(|from| batch(from..records.min(from + size))).collect();
            let start = Instant::now();
            let (mut disk, _) = Disk::open(directory.path(), sync)?;
            for batch in &batches {
                disk.append(std::slice::from_ref(batch))?;
            }
            line(&format!("append, {size} at once, to the {waits}"), start, records, directory.path())?;
            if sync == Sync::PageCache {
                let file = directory.path().join(FILE);
                let crashed = fs::read(&file)?;
                drop(disk);
                let closed = fs::read(&file)?;
                let mut damaged = closed.clone();
                let at = damaged.len() / 4;
                damaged[at..].iter_mut().take(1 << 20).for_each(|byte| *byte = 0);
                for (how, bytes) in [("closed", closed), ("crashed", crashed), ("damaged", damaged)] {
                    open(&format!("open, {size} at once, {how}"), &bytes)?;
                }
            }
        }
    }
    Ok(())
}

/// Opens a file of these bytes and fills a replica with it.
fn open(what: &str, bytes: &[u8]) -> Result<(), Failed> {
    let directory = tempfile::tempdir()?;
    fs::write(directory.path().join(FILE), bytes)?;
    let start = Instant::now();
    let (mut disk, report) = Disk::open(directory.path(), Sync::Device)?;
    let checked = start.elapsed().as_secs_f64();
    let mut replica = Replica::new(Limits::default());
    disk.replay(&mut |entry| {
        let checked = convert::entry(&entry).map_err(io::Error::other)?;
        replica.apply(checked).map(drop).map_err(io::Error::other)
    })?;
    line(what, start, report.records, directory.path())?;
    println!("  {checked:.2} s until it is open and checked, the rest fills the replica");
    if let Some(damage) = report.damage {
        println!("  {damage}");
    }
    Ok(())
}

fn line(what: &str, start: Instant, records: u64, directory: &Path) -> Result<(), Failed> {
    let seconds = start.elapsed().as_secs_f64();
    let size = fs::metadata(directory.join(FILE))?.len() as f64 / 1e6;
    println!("{what:44} {seconds:9.2} {:12.0} {size:9.0}", records as f64 / seconds);
    Ok(())
}

fn batch(ids: std::ops::Range<u64>) -> Entry {
    let record = |id: u64| Irradiance {
        // Spread like a hash.
        id: RecordId(u128::from(id.wrapping_mul(0x9e37_79b9_7f4a_7c15)) << 32),
        position: Vec3::new(id as f32, 1.0, 2.0),
        normal: Vec3::Z,
        radius: 1.0,
        radius_min: 0.1,
        radius_max: 10.0,
        irradiance: Vec3::ONE,
        gradient_t: [Vec2::ONE; 3],
        gradient_r: [Vec2::ONE; 3],
        ellipse: [0.0; 3],
        noise: 0.0,
    };
    let records: Vec<_> = ids.map(record).collect();
    Entry { entry: Some(entry::Entry::Batch(convert::pack(&Namespace([1; 32]), Tag::level(1), &records))) }
}
