//! A thousand emissive triangles against one of the same power: what the same work costs, and how long the same error takes.

use std::error::Error;

use cache_core::id::Random;
use glam::{Vec2, Vec3};
use worker::frame::{CHANNELS, Frame};
use worker::scene::{Camera, Material, Rgb, Scene, Triangle};
use worker::settings::{Method, Settings};
use worker::solo::{self, Order};
use worker::task::CpuClock;

use crate::judge::{SIZE, settings};
use crate::report::{Report, bars, quantile};
use crate::soups;

/// Numbers of lamps; all together shine alike.
const LAMPS: [usize; 4] = [1, 10, 100, 1000];

/// Arguments of the benchmark.
#[derive(Clone, Debug, clap::Args)]
pub struct LampsArgs {
    /// Pictures of each, of another seed each, at least 2; the median of their seconds counts
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u16).range(2..=64))]
    pictures: u16,
    /// Keep tables and charts in bench/results
    #[arg(long)]
    save: bool,
}

/// Measures and prints.
///
/// # Errors
/// The disk's.
pub fn run(args: &LampsArgs) -> Result<(), Box<dyn Error>> {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let mut report = Report::begin("cargo run --release -p ambience-bench -- lamps");
    report.line(&format!(
        "a room of {} triangles beside the lamps, {SIZE}x{SIZE}, {} pictures of each, one thread; deviation: of pictures of \
         different seeds, relative to their mean; time to equal error: CPU seconds times its square, over one lamp's",
        scene(1).triangles.len() - 1,
        args.pictures
    ));
    report.line("method       lamps    CPU s    / one   deviation   time to equal error / one");
    let mut chart = Vec::new();
    for (name, method) in [("path", Method::Path), ("irradiance", Method::Irradiance)] {
        let mut one = None;
        for lamps in LAMPS {
            let scene = scene(lamps);
            let (mut seconds, mut pictures) = (Vec::new(), Vec::new());
            for seed in 0..args.pictures.into() {
                let base = settings(camera()?, "full");
                let frame = Frame::new(scene.clone(), Settings { method, spp: 16, rays: 512, seed, ..base });
                let (pixels, time) = one_thread.install(|| {
                    let clock = CpuClock::start();
                    let levels = solo::fill(&frame, Order::Rounds);
                    (solo::pixels(&frame, &levels).0, clock.seconds())
                });
                if let Some(at) = pixels.iter().position(|v| !v.is_finite()) {
                    let pixel = at / CHANNELS;
                    return Err(format!("{name}, {lamps} lamps, seed {seed}: pixel {pixel} is not finite").into());
                }
                seconds.push(time);
                pictures.push(pixels);
            }
            let (seconds, deviation) = (quantile(&mut seconds, 0.5), deviation(&pictures));
            let (first, error) = *one.get_or_insert((seconds, seconds * deviation.powi(2)));
            let (cost, equal) = (seconds / first, seconds * deviation.powi(2) / error);
            let percent = 100.0 * deviation;
            report.line(&format!("{name:10} {lamps:7} {seconds:8.2} {cost:8.2} {percent:9.2} % {equal:15.2}"));
            chart.push((format!("{name}, {lamps} lamps: equal samples"), cost));
            chart.push((format!("{name}, {lamps} lamps: equal error"), equal));
        }
    }
    if args.save {
        report.save("lamps")?;
        bars("lamps", "CPU seconds over those with one lamp", &chart, 2.0)?;
    }
    Ok(())
}

/// Standard deviation of a channel of a pixel from picture to picture, root mean square over all, relative to their mean.
fn deviation(pictures: &[Vec<f32>]) -> f64 {
    let n = pictures.len() as f64;
    let (mut squares, mut sum, mut count) = (0.0, 0.0, 0.0);
    for at in (0..pictures[0].len()).filter(|at| at % CHANNELS < 3) {
        let mean = pictures.iter().map(|p| f64::from(p[at])).sum::<f64>() / n;
        squares += pictures.iter().map(|p| (f64::from(p[at]) - mean).powi(2)).sum::<f64>() / (n - 1.0);
        sum += mean;
        count += 1.0;
    }
    (squares / count).sqrt() / (sum / count)
}

/// Looks down: lamps seen directly would be most of the deviation.
fn camera() -> Result<Camera, String> {
    Camera::look(Vec3::new(0.3, 0.3, 1.0), Vec3::new(1.0, 1.0, -1.2), Vec3::Z, 1.2, 1.2, false)
}

/// The room, and lamps all over the upper half of it that face every way; all together have the power of one. One alone hangs
/// in the middle and looks down.
fn scene(lamps: usize) -> Scene {
    let material = |color, emission| Material { emission, ..Material::diffuse(color) };
    let materials = vec![material(Rgb::splat(0.6), Rgb::ZERO), material(Rgb::ZERO, Rgb::splat(100.0))];
    let triangle = |positions, material| Triangle { positions, normals: None, uvs: [Vec2::ZERO; 3], material };
    let mut triangles: Vec<_> = soups::room(0.3).into_iter().map(|corners| triangle(corners, 0)).collect();
    let mut random = Random::named("lamps of a benchmark", &[lamps as u64]);
    let edge = 0.2 / (lamps as f32).sqrt();
    for _ in 0..lamps {
        let mut vector = || Vec3::from([(); 3].map(|()| random.uniform()));
        let place = Vec3::new(0.2, 0.2, 1.2) + vector() * Vec3::new(3.6, 3.6, 0.7);
        let (x, y) = ((vector() - 0.5).normalize_or(Vec3::X), (vector() - 0.5).normalize_or(Vec3::Y));
        let y = (y - x * x.dot(y)).normalize_or(x.any_orthonormal_vector());
        let (place, x, y) = if lamps == 1 { (Vec3::new(2.0, 2.0, 1.9), Vec3::Y, Vec3::X) } else { (place, x, y) };
        triangles.push(triangle([place, place + x * edge, place + y * edge], 1));
    }
    Scene { triangles, materials, ..Scene::default() }
}
