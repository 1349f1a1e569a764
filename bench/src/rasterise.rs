//! Gathers rasterised on a device against gathers traced: error against time, at the sites of real records, all looking at the same
//! light.

use std::error::Error;
use std::sync::Arc;
use std::time::{Duration, Instant};

use cache_core::hemisphere::{Cells as _, Strata};
use cache_core::id::Random;
use glam::Vec2;
use nix::time::{ClockId, clock_gettime};
use rayon::prelude::*;
use shaders::device::Gpu;
use worker::bvh::Bvh;
use worker::frame::{Counts, Frame};
use worker::sampler::Sampler;
use worker::scene::{self, Rgb};
use worker::settings::Settings;
use worker::solo::{self, Order};
use worker::trace::Chance;
use worker::world::World;

use crate::glow::{Glow, with_tracer};
use crate::plane::{Eye, Missing, weights};
use crate::rasteriser::Rasteriser;
use crate::report::{Curve, Report, SeriesLabelPosition, logarithmic, quantile};
use crate::{judge, own};

/// What to measure.
#[derive(clap::Args)]
pub struct RasteriseArgs {
    /// Scenes, as SCENE.DEPTH: light of one bounce, or all of it
    #[arg(default_values_t = ["stairs.one", "stairs.full", "cornell.full", "arcade.full"].map(String::from))]
    scenes: Vec<String>,
    /// Sites of records
    #[arg(long, default_value_t = 256)]
    records: usize,
    /// Rounds that take turns; medians are printed
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Keep table and chart in bench/results
    #[arg(long)]
    save: bool,
}

/// Pixels of a plane's edge.
const SIZES: [u32; 5] = [16, 32, 64, 128, 256];

/// Rays of a traced gather.
const RAYS: [u32; 9] = [64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384];

/// Rays of each of the two gathers a reference is the mean of.
const REFERENCE_RAYS: u32 = 1 << 16;

/// Paths that tell what a cell of a triangle sends out.
const PATHS: u32 = 32;

/// A scene, what its surfaces send out, and where its records look from.
pub struct Case {
    /// The scene.
    pub world: World,
    /// Its tree.
    pub bvh: Bvh,
    /// What gathers see.
    pub glow: Glow,
    /// Eyes of records, in an order that says nothing of where they lie.
    pub eyes: Vec<Eye>,
    settings: Settings,
}

impl Case {
    /// A scene as SCENE.DEPTH, with at most so many records.
    ///
    /// # Errors
    /// A name that is none; the disk's.
    pub fn load(name: &str, records: usize) -> Result<Self, Box<dyn Error>> {
        let (name, depth) = name.split_once('.').ok_or_else(|| format!("{name}: expected SCENE.DEPTH"))?;
        let (scene, camera) = match own::file(name)? {
            Some(path) => (scene::load(&path)?, scene::load_view(&path.with_extension("vf"))?),
            None => judge::load(&format!("{name}.glb")),
        };
        let settings = judge::settings(camera, depth);
        let frame = Frame::new(scene.clone(), Settings { rays: 64, bounces: 1, ..settings.clone() });
        let mut sites = Vec::new();
        solo::fill(&frame, Order::Rounds)[0].counting(None, &mut |r| sites.push((r.id, r.position, r.normal)));
        sites.sort_unstable_by_key(|site| site.0);
        let world = World::new(scene);
        let eyes = sites.into_iter().take(records).map(|(_, at, normal)| Eye::new(at, normal, world.radius)).collect();
        let (bvh, glow) = (Bvh::new(&world.scene.triangles), Glow::traced(&world, &settings, PATHS));
        Ok(Self { world, bvh, glow, eyes, settings })
    }

    /// Irradiance at an eye by one ray through each cell.
    pub fn traced(&self, eye: &Eye, strata: &Strata, random: &mut Random) -> Rgb {
        let ray = |cell| {
            let local = strata.direction(cell, Vec2::new(random.uniform(), random.uniform()));
            let hit = self.bvh.closest(eye.position.into(), eye.to_world(local), f32::INFINITY)?;
            Some(self.glow.at(hit.triangle, hit.uv))
        };
        let sum: Rgb = (0..strata.rays()).filter_map(ray).sum();
        sum * (std::f32::consts::PI / strata.rays() as f32)
    }

    /// Irradiance at every eye by many rays, and what it may be off by, relative, root mean square.
    pub fn reference(&self) -> (Vec<Rgb>, f64) {
        let strata = Strata::new(REFERENCE_RAYS);
        let gather = |seed: u64| -> Vec<Rgb> {
            let one = |(i, eye)| self.traced(eye, &strata, &mut Random::named("reference", &[seed, i as u64]));
            self.eyes.par_iter().enumerate().map(one).collect()
        };
        let (a, b) = (gather(0), gather(1));
        let mean: Vec<Rgb> = a.iter().zip(&b).map(|(a, b)| (*a + *b) / 2.0).collect();
        (mean, rms(&a, &b) / 2.0)
    }

    /// CPU seconds of a gather ray of the renderer that finds its light by a shadow ray, at depth one.
    fn own_ray(&self, strata: &Strata) -> f64 {
        let settings = Settings { bounces: 1, ..self.settings.clone() };
        with_tracer(&self.world, &settings, |tracer| {
            let (mut counts, mut sampler) = (Counts::default(), Sampler::Stream(Random::named("own", &[])));
            let start = cpu();
            let mut sum = Rgb::ZERO;
            for (eye, cell) in self.eyes.iter().flat_map(|eye| (0..strata.rays()).map(move |cell| (eye, cell))) {
                let [u, v, ..] = sampler.next4();
                let way = eye.to_world(strata.direction(cell, Vec2::new(u, v))).normalize();
                sum += tracer.see((eye.position.into(), way), 2, Chance::Gathered, &mut sampler, &mut counts).total();
            }
            std::hint::black_box(sum);
            (cpu() - start) / (self.eyes.len() * strata.rays()) as f64
        })
    }
}

/// Root mean square of the difference over the mean of the truth.
pub fn rms(told: &[Rgb], truth: &[Rgb]) -> f64 {
    let squares: f64 = told.iter().zip(truth).map(|(a, b)| f64::from((*a - *b).length_squared())).sum();
    let mean = truth.iter().map(|v| f64::from(v.element_sum())).sum::<f64>() / (3 * truth.len()) as f64;
    (squares / (3 * truth.len()) as f64).sqrt() / mean
}

/// CPU seconds of this process: the threads of a device that is the processor count as well.
fn cpu() -> f64 {
    clock_gettime(ClockId::CLOCK_PROCESS_CPUTIME_ID).map_or(f64::NAN, |time| Duration::from(time).as_secs_f64())
}

/// One way to gather.
enum Way {
    Rasterised(Box<Rasteriser>),
    Traced(Strata),
}

impl Way {
    fn gather(&self, case: &Case) -> Result<Vec<Rgb>, Box<dyn Error>> {
        Ok(match self {
            Self::Rasterised(rasteriser) => rasteriser.gather(&case.eyes)?,
            Self::Traced(strata) => {
                let one = |(i, eye)| case.traced(eye, strata, &mut Random::named("traced", &[i as u64]));
                case.eyes.iter().enumerate().map(one).collect()
            }
        })
    }
}

/// Prints one line for each size of plane and number of rays.
///
/// # Errors
/// No adapter, or one that is lost; the disk's.
pub fn run(args: &RasteriseArgs) -> Result<(), Box<dyn Error>> {
    let gpu = Arc::new(Gpu::new(true)?);
    let about = gpu.device.adapter_info();
    let processor = about.device_type == wgpu::DeviceType::Cpu;
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    let mut report = Report::begin(&format!("cargo run --release -p ambience-bench -- {}", arguments.join(" ")));
    report.line(&format!(
        "{}, {}{}",
        about.name,
        about.driver_info,
        if processor { ": the processor itself" } else { "" }
    ));
    let clock = if processor { "CPU" } else { "wall" };
    report.line(&format!(
        "medians of {} rounds in turn; microseconds a record, CPU of all threads and wall",
        args.rounds
    ));
    let mut panels = Vec::new();
    for name in &args.scenes {
        let curves = scene(&mut report, args, name, &gpu, processor)?;
        panels.push((format!("{name}: RMS error, %"), curves));
    }
    if args.save {
        report.save("rasterise")?;
        logarithmic("rasterise", &format!("{clock} µs a record"), SeriesLabelPosition::LowerLeft, &panels)?;
    }
    Ok(())
}

fn scene(
    report: &mut Report,
    args: &RasteriseArgs,
    name: &str,
    gpu: &Arc<Gpu>,
    processor: bool,
) -> Result<Vec<Curve>, Box<dyn Error>> {
    let case = Case::load(name, args.records)?;
    let triangles = &case.world.scene.triangles;
    let (truth, doubt) = case.reference();
    report.line("");
    report.line(&format!(
        "{name}: {} records, {} triangles of {} cells; the reference is good to {:.3} %",
        case.eyes.len(),
        triangles.len(),
        case.glow.cells * (case.glow.cells + 1) / 2,
        100.0 * doubt
    ));
    let mut ways = Vec::new();
    for (of, missing) in ["black", "ratio", "border"].into_iter().zip(Missing::ALL) {
        for size in SIZES {
            let rasteriser = Rasteriser::new(gpu.clone(), triangles, &case.glow, &weights(size, missing));
            ways.push((format!("rasterised, {of}"), format!("{size} x {size}"), Way::Rasterised(Box::new(rasteriser))));
        }
    }
    for rays in RAYS {
        let strata = Strata::new(rays);
        ways.push(("traced".into(), format!("{} rays", strata.rays()), Way::Traced(strata)));
    }
    let mut times = vec![[const { Vec::new() }; 2]; ways.len()];
    let mut errors = vec![0.0; ways.len()];
    for round in 0..=args.rounds {
        for (((_, _, way), times), error) in ways.iter().zip(&mut times).zip(&mut errors) {
            let (start, wall) = (cpu(), Instant::now());
            let told = way.gather(&case)?;
            // The first round makes ready.
            if round > 0 {
                let per = 1e6 / case.eyes.len() as f64;
                times[0].push((cpu() - start) * per);
                times[1].push(wall.elapsed().as_secs_f64() * per);
            }
            *error = 100.0 * rms(&told, &truth);
        }
    }
    report.line(&format!("{:20} {:>12} {:>9} {:>11} {:>11}", "", "", "RMS error", "CPU", "wall"));
    let mut curves: Vec<Curve> = Vec::new();
    for (((of, samples, _), times), error) in ways.iter().zip(times).zip(errors) {
        let [cpu, wall] = times.map(|mut times| quantile(&mut times, 0.5));
        report.line(&format!("{of:20} {samples:>12} {error:7.2} % {cpu:8.1} µs {wall:8.1} µs"));
        if curves.last().is_none_or(|curve| curve.0 != *of) {
            curves.push((of.clone(), Vec::new()));
        }
        curves.last_mut().expect("one").1.push((if processor { cpu } else { wall }, error));
    }
    let strata = Strata::new(1024);
    let own = 1e6 * case.own_ray(&strata);
    let start = cpu();
    Way::Traced(Strata::new(1024)).gather(&case)?;
    let seen = 1e6 * (cpu() - start) / (case.eyes.len() * strata.rays()) as f64;
    report.line(&format!(
        "a ray of these: {seen:.3} µs CPU; one of the renderer, with a shadow ray and shading: {own:.3} µs"
    ));
    Ok(curves)
}
