//! scratch
use worker::{frame::*, scene, settings::*, solo};
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let scene = scene::load(std::path::Path::new(&a[1])).unwrap();
    let size: u32 = a[3].parse().unwrap();
    let spp: u32 = a[4].parse().unwrap();
    let method = Method::from_name(&a[2]).unwrap();
    let bounces: u32 = a[5].parse().map(|b: i64| if b < 0 { ALL_BOUNCES } else { b as u32 }).unwrap();
    let rays = a.get(7).map_or(1024, |r| r.parse().unwrap());
    let aa = a.get(8).map_or(0.3, |r| r.parse().unwrap());
    let camera = scene.cameras[0].clone().with_aspect(1.0);
    let settings = Settings { camera, width: size, height: size, spp, method, a: aa, rays, bounces, seed: 0 };
    let frame = Frame::new(scene, settings.clone());
    let t0 = std::time::Instant::now();
    let levels =
        solo::fill(&frame, if std::env::var("SEQ").is_ok() { solo::Order::Sequential } else { solo::Order::Rounds });
    let t1 = t0.elapsed().as_secs_f32();
    let (p, c) = solo::pixels(&frame, &levels);
    eprintln!(
        "pixels fill {t1:.1}s pixels {:.1}s records {:?} {c:?}",
        t0.elapsed().as_secs_f32() - t1,
        levels.iter().map(|l| l.len()).collect::<Vec<_>>()
    );
    let bytes: Vec<u8> =
        p.chunks(CHANNELS).flat_map(|p| p[..3].iter().flat_map(|f| f.to_le_bytes()).collect::<Vec<_>>()).collect();
    std::fs::write(&a[6], bytes).unwrap();
}
