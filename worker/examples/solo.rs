use cache_core::{
    Sealed,
    rounds::{Plan, Step},
};
use std::sync::Arc;
use worker::{frame::*, scene, settings::*};
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
    let tiles = settings.tiles();
    let frame = Frame::new(scene, settings.clone());
    let mut levels: Levels = (0..frame.levels()).map(|_| Arc::new(Sealed::new(settings.a))).collect();
    let mut plan = Plan::new(frame.levels());
    let mut last = 0;
    let t0 = std::time::Instant::now();
    let mut rounds = 0;
    let run = |f: &(dyn Fn(u32) -> (Vec<f32>, Vec<cache_core::Irradiance>, Counts) + Sync)| {
        let next = std::sync::atomic::AtomicU32::new(0);
        let mut out: Vec<_> = std::thread::scope(|s| {
            let hs: Vec<_> = (0..2)
                .map(|_| {
                    s.spawn(|| {
                        let mut v = vec![];
                        loop {
                            let t = next.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                            if t >= tiles {
                                return v;
                            }
                            v.push((t, f(t)));
                        }
                    })
                })
                .collect();
            hs.into_iter().flat_map(|h| h.join().unwrap()).collect()
        });
        out.sort_by_key(|o| o.0);
        out
    };
    while let Some(step) = plan.next(last) {
        match step {
            Step::Fill { level, pass, ranks } => {
                rounds += 1;
                let out = run(&|t| {
                    let (r, c) = frame.fill(level, ranks.clone(), t, &levels);
                    (vec![], r, c)
                });
                let new: Vec<_> = out.into_iter().flat_map(|o| o.1.1).collect();
                last = new.len() as u64;
                Arc::make_mut(&mut levels[level as usize - 1]).extend(new);
                if ranks.end == 4096 {
                    eprintln!(
                        "level {level} pass {pass} round {rounds}: {} records {:.1}s",
                        levels[level as usize - 1].len(),
                        t0.elapsed().as_secs_f32()
                    );
                }
            }
            Step::Pixels => {
                let out = run(&|t| {
                    let (p, c) = frame.pixels(t, &levels);
                    (p, vec![], c)
                });
                let mut img = vec![0f32; (size * size * 3) as usize];
                let (mut q, mut m, mut pr, mut sr) = (0, 0, 0, 0);
                for (t, (p, _, c)) in out {
                    q += c.queries;
                    m += c.misses;
                    pr += c.path_rays;
                    sr += c.shadow_rays;
                    for (i, [x, y]) in settings.pixels(t).enumerate() {
                        for k in 0..3 {
                            img[((y * size + x) * 3 + k) as usize] = p[i * CHANNELS + k as usize];
                        }
                    }
                }
                eprintln!("pixels {:.1}s queries {q} misses {m} rays {pr} shadow {sr}", t0.elapsed().as_secs_f32());
                let bytes: Vec<u8> = img.iter().flat_map(|f| f.to_le_bytes()).collect();
                std::fs::write(&a[6], bytes).unwrap();
            }
        }
    }
}
