//! What a device makes of hemispheres, against the twins in Rust and exact answers.
//!
//! Without an adapter each test counts as ignored, and says so.

use std::f32::consts::PI;
use std::sync::Arc;

use ambience_bench::glow::Glow;
use ambience_bench::model::sheet;
use ambience_bench::plane::{Eye, Missing, integrate, rasterise, weights};
use ambience_bench::rasterise::Case;
use ambience_bench::rasteriser::Rasteriser;
use cache_core::math::sin_cos;
use glam::{Vec2, Vec3};
use libtest_mimic::{Arguments, Failed, Trial};
use shaders::device::Gpu;
use worker::scene::{Rgb, Triangle};

type Test = (&'static str, fn(&Arc<Gpu>));

const TESTS: [Test; 3] = [
    ("pixels_see_what_rays_through_them_meet", pixels_see_what_rays_through_them_meet),
    ("sums_are_those_of_the_twin", sums_are_those_of_the_twin),
    ("rooms_and_balls_are_exact", rooms_and_balls_are_exact),
];

fn main() {
    let arguments = Arguments::from_args();
    let gpu = Gpu::new(true).map(Arc::new);
    let trials = TESTS.map(|(name, test)| match &gpu {
        Ok(gpu) => {
            let gpu = gpu.clone();
            Trial::test(name, move || {
                let run = std::panic::AssertUnwindSafe(|| test(&gpu));
                std::panic::catch_unwind(run).map_err(|panic| {
                    let said = panic.downcast_ref::<String>().cloned();
                    Failed::from(said.unwrap_or_else(|| "it panicked".into()))
                })
            })
        }
        Err(lost) => {
            eprintln!("bench/tests/device: {name} is skipped: {lost}");
            Trial::test(name, || Ok(())).with_ignored_flag(true)
        }
    });
    libtest_mimic::run(&arguments, trials.into()).exit();
}

/// As in `plane.rs`: what the plane covers of the hemisphere.
const SHARE: f32 = 0.831_029;

/// Odd sizes, and more records than one picture holds of the large ones.
const SIZES: [u32; 4] = [16, 33, 64, 256];

fn case(records: usize) -> Case {
    Case::load("stairs.one", records).expect("a scene")
}

fn pixels_see_what_rays_through_them_meet(gpu: &Arc<Gpu>) {
    let case = case(80);
    for size in SIZES {
        let rasteriser =
            Rasteriser::new(gpu.clone(), &case.world.scene.triangles, &case.glow, &weights(size, Missing::Border));
        let all = rasteriser.seen(&case.eyes).expect("a device");
        assert_eq!(all.len(), case.eyes.len());
        let (mut off, mut odd, mut seen) = (0, 0, 0);
        for (drawn, eye) in all.iter().zip(&case.eyes) {
            let met = |beside| rasterise(&case.bvh, eye, size, beside);
            let middle = met(Vec2::ZERO);
            seen += middle.iter().filter(|triangle| **triangle != 0).count();
            let differ: Vec<usize> = (0..middle.len()).filter(|at| middle[*at] != drawn[*at]).collect();
            off += differ.len();
            if !differ.is_empty() {
                // Devices round corners to a 256th of a pixel.
                let around: Vec<_> = (0..8).map(|k| met(Vec2::from_angle(PI * k as f32 / 4.0) / 128.0)).collect();
                odd += differ.iter().filter(|at| around.iter().all(|met| met[**at] != drawn[**at])).count();
            }
        }
        let pixels = all.len() * (size * size) as usize;
        println!("{size}: {off} of {pixels} pixels differ, {odd} of them where no edge is near");
        assert!(seen * 100 > pixels * 99, "the room is closed");
        // Tips of triangles narrower than the rounding.
        assert!(off * 500 < pixels && odd * 10_000 < pixels, "{size}: {off}, {odd} of {pixels}");
    }
}

fn sums_are_those_of_the_twin(gpu: &Arc<Gpu>) {
    let case = case(300);
    let triangles = &case.world.scene.triangles;
    for (size, missing) in SIZES.into_iter().zip(Missing::ALL.into_iter().cycle()) {
        let weights = weights(size, missing);
        let rasteriser = Rasteriser::new(gpu.clone(), triangles, &case.glow, &weights);
        let told = rasteriser.gather(&case.eyes).expect("a device");
        let seen = rasteriser.seen(&case.eyes).expect("a device");
        assert_eq!(told.len(), case.eyes.len());
        let mut lit = 0;
        let off = |((told, seen), eye): ((&Rgb, &Vec<u32>), &Eye)| {
            let twin = integrate(triangles, &case.glow, eye, seen, &weights);
            lit += usize::from(twin != Rgb::ZERO);
            (*told - twin).abs().max_element() / twin.max_element().max(1e-6)
        };
        let mut off: Vec<f32> = told.iter().zip(&seen).zip(&case.eyes).map(off).collect();
        off.sort_by(f32::total_cmp);
        assert!(lit * 10 > off.len() * 9, "light comes almost everywhere");
        let [middle, most] = [off[off.len() / 2], off[off.len() - 1]];
        println!("{size} {missing:?}: median {middle:.1e}, most {most:.1e}");
        // A rounding moves a pixel to the next cell.
        assert!(middle < 1e-5 && most < 1e-3, "{size} {missing:?}: {middle} {most}");
    }
}

fn triangle(positions: [Vec3; 3]) -> Triangle {
    Triangle { positions, normals: None, uvs: [Vec2::ZERO; 3], material: 0 }
}

/// E = π in a white room, and π sin² α cos θ under a white ball.
fn rooms_and_balls_are_exact(gpu: &Arc<Gpu>) {
    let corner = |i: usize| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) * 4.0;
    let sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
    let room: Vec<_> = sides
        .iter()
        .flat_map(|side| {
            let [a, b, c, d] = side.map(corner);
            [triangle([a, b, c]), triangle([a, c, d])]
        })
        .collect();
    let eyes = [(Vec3::new(1.0, 3.5, 0.0), Vec3::Z), (Vec3::new(0.0, 0.01, 2.0), Vec3::X)]
        .map(|(at, normal)| Eye::new(at, normal, 3.0));
    let glow = Glow::of(room.iter().map(|_| Rgb::new(1.0, 0.5, 0.0)));
    let told = |triangles: &[Triangle], glow: &Glow, missing| {
        Rasteriser::new(gpu.clone(), triangles, glow, &weights(128, missing)).gather(&eyes).expect("a device")
    };
    for (missing, share) in Missing::ALL.into_iter().zip([SHARE, 1.0, 1.0]) {
        for e in told(&room, &glow, missing) {
            let off = (e / PI - Rgb::new(share, share * 0.5, 0.0)).abs().max_element();
            assert!(off < 1e-4, "{missing:?}: {e}");
        }
    }

    let (middle, radius) = (Vec3::new(1.2, 3.3, 1.5), 0.6);
    let mut ball = Vec::new();
    let surface = |s: Vec2| {
        let ((sin_phi, cos_phi), (sin, cos)) = (sin_cos(2.0 * PI * s.x), sin_cos(PI * s.y));
        middle + Vec3::new(sin * cos_phi, sin * sin_phi, cos) * radius
    };
    sheet(96, 48, surface, &mut ball);
    let ball: Vec<_> = ball.into_iter().map(triangle).collect();
    let away = middle - Vec3::from(eyes[0].position);
    let truth = PI * (radius / away.length()).powi(2) * away.normalize().z;
    let glow = Glow::of(ball.iter().map(|_| Rgb::ONE));
    for (missing, share) in Missing::ALL.into_iter().zip([1.0, 1.0 / SHARE, 1.0]) {
        let e = told(&ball, &glow, missing)[0].x / truth;
        println!("ball, {missing:?}: {e}");
        assert!((e - share).abs() < 5e-3, "{missing:?}: {e} of the truth, not {share}");
    }
}
