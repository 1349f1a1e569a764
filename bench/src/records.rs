//! Records made up: sound, of real size, the same bits every time.

use cache_core::id::{Digest, Origin, Random};
use cache_core::{Irradiance, Namespace, Packed as _, Query, Tag};
use cache_proto::convert;
use cache_proto::v1::RecordBatch;
use glam::{Vec2, Vec3};

/// Where these records belong.
pub const NAMESPACE: Namespace = Namespace([0xA5; 32]);

/// Allowed error the records are made for.
pub const A: f32 = 0.3;

/// Radius with which `count` records on the unit square cover each of its points about six times at [`A`].
fn radius(count: u64) -> f32 {
    (6.0 / (std::f32::consts::PI * count as f32)).sqrt() / A
}

/// Record `index` of `count`, which lie on the unit square.
pub fn record(index: u64, count: u64) -> Irradiance {
    at(&[index as f32, count as f32], radius(count))
}

/// The record whose identity is `site`.
pub fn at(site: &[f32], radius: f32) -> Irradiance {
    let kind = Irradiance::KIND;
    let id = Origin { namespace: &NAMESPACE, kind, level: 1, site, seed: 0, read: Digest::default() }.id();
    let mut random = Random::of(id);
    let mut next = || random.uniform();
    Irradiance {
        id,
        position: Vec3::new(next(), next(), 0.0),
        normal: Vec3::Z,
        radius,
        radius_min: radius / 10.0,
        radius_max: radius * 10.0,
        irradiance: Vec3::new(next(), next(), next()),
        gradient_t: [(); 3].map(|()| Vec2::new(next(), next())),
        gradient_r: [(); 3].map(|()| Vec2::new(next(), next())),
        ellipse: [0.0; 3],
        noise: 0.0,
    }
}

/// Batches of `size` records each, `count` in all.
pub fn batches(namespace: &Namespace, count: u64, size: u64) -> Vec<RecordBatch> {
    let from = (0..count).step_by(size as usize);
    let batch = |from: u64| {
        let records: Vec<_> = (from..(from + size).min(count)).map(|index| record(index, count)).collect();
        convert::pack(namespace, Tag::level(1), &records)
    };
    from.map(batch).collect()
}

/// Points on the unit square, for queries.
pub fn points(count: u64) -> Vec<Query> {
    let mut random = Random::named("points of a benchmark", &[count]);
    let mut next = || random.uniform();
    (0..count).map(|_| Query::new(Vec3::new(next(), next(), 0.0), Vec3::Z)).collect()
}

/// Points as a request carries them.
pub fn pack(points: &[Query]) -> Vec<u8> {
    let floats = |q: &Query| q.position.to_array().into_iter().chain(q.normal.to_array());
    points.iter().flat_map(floats).flat_map(f32::to_le_bytes).collect()
}
