use std::time::Instant;
use cache_core::{Irradiance, Namespace, RecordId, RecordSet, Tag, Cached};
use cache_proto::convert;
use glam::{Vec2, Vec3};
fn record(i: u64) -> Irradiance {
    let h = (i as u128).wrapping_mul(0x9E3779B97F4A7C15_F39CC0605CEDC835) ^ ((i as u128) << 77);
    let h = h.wrapping_mul(0xBF58476D1CE4E5B9_94D049BB133111EB);
    Irradiance { id: RecordId(h), position: Vec3::new(i as f32, 1.0, 2.0), normal: Vec3::Z, radius: 1.0, radius_min: 0.1, radius_max: 10.0,
        irradiance: Vec3::ONE, gradient_t: [Vec2::ONE; 3], gradient_r: [Vec2::ONE; 3] }
}
fn main() {
    let n = Namespace([1; 32]);
    let count = 1u64 << 20;
    let batches: Vec<_> = (0..count / 4096).map(|b| { let r: Vec<_> = (b * 4096..(b + 1) * 4096).map(record).collect(); convert::pack(&n, Tag::level(1), &r) }).collect();
    for _ in 0..3 {
        let t = Instant::now();
        let mut sum = 0;
        for b in &batches { sum += convert::unpack::<Irradiance>(b).unwrap().2.len(); }
        let unpack = t.elapsed().as_secs_f64() * 1e9 / sum as f64;
        let mut set = RecordSet::default();
        let (mut insert, mut worst) = (0.0, 0f64);
        let mut all: Vec<f64> = vec![];
        for b in &batches {
            let r = convert::unpack::<Irradiance>(b).unwrap().2;
            let t = Instant::now();
            for r in &r { set.insert(Tag::level(1), *r); }
            let s = t.elapsed().as_secs_f64();
            insert += s; worst = worst.max(s); all.push(s);
        }
        all.sort_by(f64::total_cmp);
        let t = Instant::now();
        let mut bytes = 0;
        for p in set.since(0).chunks(4096) { bytes += convert::pack(&n, Tag::level(1), p.iter().map(|(_, r)| r)).records.len(); }
        let pack = t.elapsed().as_secs_f64() * 1e9 / (bytes / Irradiance::BYTES) as f64;
        println!("unpack {unpack:.1} ns, insert {:.1} ns/record: batch of 4096 mean {:.2} ms p50 {:.2} worst {:.1} ms; pack {pack:.1} ns", insert * 1e9 / count as f64, insert * 1e3 / batches.len() as f64, all[all.len()/2]*1e3, worst * 1e3);
    }
}
