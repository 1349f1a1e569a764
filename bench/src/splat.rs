//! Interpolation by splatting on a device against the octree with all cores: the same records, the same points, in turn.

use std::error::Error;
use std::sync::Arc;
use std::time::Instant;

use cache_core::details::{Details, Spacing};
use rayon::prelude::*;
use shaders::device::Gpu;
use shaders::layout::Splats;
use shaders::splatter::Splatter;
use worker::frame::{Counts, Frame};
use worker::levels::{Level, Reflected};
use worker::settings::{Method, Settings};
use worker::solo::{self, Order};
use worker::splat::{Look, Splat as _};

use crate::judge::{load, settings};

/// How many records, on how many pixels.
#[derive(clap::Args)]
pub struct SplatArgs {
    /// Records to draw
    #[arg(default_values_t = [4_000usize, 100_000])]
    records: Vec<usize>,
    /// Rounds that take turns; medians are printed
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Records of radiance, of the glossy floor, in place of those of irradiance, of the stairs
    #[arg(long)]
    gloss: bool,
    /// Sum by a compute pass, as on devices that cannot add floats to a picture
    #[arg(long)]
    compute: bool,
}

/// Sizes of the pictures.
const SIZES: [[u32; 2]; 2] = [[1000, 1000], [3840, 2160]];

/// Milliseconds: of a device, its share without points and answers on their way, and of the octree.
type Times = [Vec<f64>; 3];

/// Prints one line for each number of records and size of the picture.
///
/// # Errors
/// No adapter, or one that is lost.
pub fn run(args: &SplatArgs) -> Result<(), Box<dyn Error>> {
    let gpu = Arc::new(Gpu::new(!args.compute)?);
    let threads = rayon::current_num_threads();
    let scene = if args.gloss { "glossy-floor.glb" } else { "stairs.glb" };
    println!("{scene}; {}, octree with {threads} threads; medians of {} rounds in turn", gpu.name, args.rounds);
    println!(
        "records     picture     splat: whole, device alone     octree    octree / splat     points off by more than 1e-4"
    );
    for &count in &args.records {
        for [width, height] in SIZES {
            let (frame, level) = filled(scene, width, height, count);
            let looks = looks(&frame);
            let mut splatter = Splatter::new(gpu.clone(), frame.settings());
            splatter.take(Splats::of(&level));
            let mut times = Times::default();
            let (mut drawn, mut asked) = (Vec::new(), Vec::new());
            for _ in 0..args.rounds {
                let start = Instant::now();
                drawn = splatter.answers(&mut looks.iter())?;
                times[0].push(start.elapsed().as_secs_f64() * 1e3);
                times[1].push(splatter.device_seconds() * 1e3);
                let start = Instant::now();
                asked = looks.par_iter().map(|look| level.ask(&look.query, &look.served)).collect();
                times[2].push(start.elapsed().as_secs_f64() * 1e3);
            }
            let off = drawn.iter().zip(&asked).filter(|(a, b)| differ(a, b)).count();
            let [whole, device, octree] = times.map(|mut t| {
                t.sort_by(f64::total_cmp);
                t[t.len() / 2]
            });
            println!(
                "{:7}  {width:4} x {height:4}  {whole:10.1} ms {device:10.1} ms {octree:10.1} ms  {:10.2} x  {off} of {}",
                level.len(),
                octree / whole,
                looks.len()
            );
        }
    }
    Ok(())
}

/// A frame that some `count` records fill, gathered with few rays, and these.
fn filled(scene: &str, width: u32, height: u32, count: usize) -> (Frame, Level) {
    let method = if scene == "stairs.glb" { Method::Irradiance } else { Method::Radiance };
    let mut a = 0.3;
    loop {
        let (scene, camera) = load(scene);
        let base = settings(camera.with_aspect(width as f32 / height as f32), "one");
        let details = Details { spacing: Spacing::Free, ..Details::default() };
        let frame = Frame::new(scene, Settings { width, height, a, method, rays: 16, bounces: 1, details, ..base });
        let level = solo::fill(&frame, Order::Rounds).remove(0);
        let ratio = level.len() as f32 / count as f32;
        if (0.8..1.25).contains(&ratio) {
            return (frame, level);
        }
        // Records are as many as reaches are small.
        a *= ratio.sqrt();
    }
}

/// Where the middles of pixels ask.
fn looks(frame: &Frame) -> Vec<Look<'_>> {
    let (settings, mut counts) = (frame.settings(), Counts::default());
    let pixels = (0..settings.height).flat_map(|y| (0..settings.width).map(move |x| [x, y]));
    let look = |[x, y]: [u32; 2]| {
        let (query, served) = frame.look(settings.ray(x as f32 + 0.5, y as f32 + 0.5), &mut counts)?;
        Some(Look { pixel: [x, y], query, served })
    };
    pixels.filter_map(look).collect()
}

fn differ(a: &Option<Reflected>, b: &Option<Reflected>) -> bool {
    match (a, b) {
        (Some(a), Some(b)) => {
            (a.radiance - b.radiance).abs().max_element() > 1e-4 * a.radiance.max(b.radiance).max_element()
        }
        (None, None) => false,
        _ => true,
    }
}
