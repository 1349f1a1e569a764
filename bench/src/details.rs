//! What each practical detail of irradiance caching buys: error and records with one choice changed at a time.

use std::error::Error;

use cache_core::details::{Details, Distance, Gradients, Metric, Spacing, Weighting};
use cache_core::rounds::RANKS;
use worker::frame::{CHANNELS, Frame};
use worker::settings::Settings;
use worker::solo::{self, Order};
use worker::task::CpuClock;

use crate::judge::{SIZE, judge, load, reference, settings};

/// Which choices to measure, and on what.
#[derive(clap::Args)]
pub struct DetailsArgs {
    /// Scenes as SCENE.DEPTH
    #[arg(default_values = ["stairs.full", "cornell.full", "leak.full"])]
    scenes: Vec<String>,
    /// Only choices whose name holds this
    #[arg(long)]
    only: Option<String>,
    /// Allowed errors to measure each choice at
    #[arg(long, value_delimiter = ',', default_values_t = [0.6f32, 0.4, 0.3, 0.2])]
    a: Vec<f32>,
    /// Rays in one gather
    #[arg(long, default_value_t = 1024)]
    rays: u32,
    /// Samples a pixel
    #[arg(long, default_value_t = 64)]
    spp: u32,
}

/// Prints one line for every choice and allowed error.
///
/// # Errors
/// Names that are no SCENE.DEPTH.
pub fn run(args: &DetailsArgs) -> Result<(), Box<dyn Error>> {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    println!(
        "{SIZE}x{SIZE}, --rays {} --spp {}; records of level 1, of all; CPU seconds of the fill; RMSE, bias, worst block; passes, \
         proposals, tests and sealing as shares of the fill",
        args.rays, args.spp
    );
    for name in &args.scenes {
        let (scene, depth) = name.split_once('.').ok_or("expected SCENE.DEPTH, for instance stairs.full")?;
        let truth = reference(name);
        let (scene, camera) = load(&format!("{scene}.glb"));
        for (choice, details) in choices() {
            if args.only.as_ref().is_some_and(|only| !choice.contains(only.as_str())) {
                continue;
            }
            for &a in &args.a {
                let base = settings(camera.clone(), depth);
                let frame = Frame::new(scene.clone(), Settings { a, rays: args.rays, spp: args.spp, details, ..base });
                let (filled, pixels, seconds) = one_thread.install(|| {
                    let clock = CpuClock::start();
                    let filled = solo::fill_ranks(&frame, Order::Rounds, RANKS);
                    let seconds = clock.seconds();
                    let pixels = solo::pixels(&frame, &filled.levels).0;
                    (filled, pixels, seconds)
                });
                let image: Vec<_> =
                    pixels.chunks_exact(CHANNELS).map(|p| [p[0].into(), p[1].into(), p[2].into()]).collect();
                let v = judge(&image, &truth);
                let first = filled.levels.first().map_or(0, |l| l.len());
                let all: usize = filled.levels.iter().map(|l| l.len()).sum();
                let testing = 100.0 * filled.counts.test_seconds / seconds;
                println!(
                    "{name:16} {choice:34} a {a:<4} {first:6} {all:6} {seconds:7.2} s  {:5.2}% {:+5.2}% {:5.2}%  {:3} {:6} {testing:5.1}% {:5.1}%",
                    100.0 * v.rmse,
                    100.0 * v.bias,
                    100.0 * v.worst,
                    filled.passes,
                    filled.proposals,
                    100.0 * filled.sealing_seconds / seconds,
                );
            }
        }
    }
    Ok(())
}

/// The default, and the default with one thing changed.
fn choices() -> Vec<(&'static str, Details)> {
    let usual = Details::default();
    let ward = Details {
        metric: Metric::SplitSphere,
        radius_by_gradient: false,
        gradient_by_radius: false,
        neighbor_clamping: false,
        weighting: Weighting::Inverse,
        ..usual
    };
    vec![
        ("usual", usual),
        ("Ward 1992: split sphere alone", ward),
        ("split sphere", Details { metric: Metric::SplitSphere, ..usual }),
        ("split sphere, nearest", Details { metric: Metric::SplitSphere, distance: Distance::Nearest, ..usual }),
        ("Hessian", Details { metric: Metric::Hessian, ..usual }),
        ("Hessian, R not by gradient", Details { metric: Metric::Hessian, radius_by_gradient: false, ..usual }),
        ("no neighbor clamping", Details { neighbor_clamping: false, ..usual }),
        ("Hessian, no clamping", Details { metric: Metric::Hessian, neighbor_clamping: false, ..usual }),
        ("gradients: none", Details { gradients: Gradients::None, rotation: false, ..usual }),
        ("gradients: samples", Details { gradients: Gradients::Samples, ..usual }),
        ("gradients: mesh", Details { gradients: Gradients::Mesh, ..usual }),
        ("gradients: shared by colours", Details { gradients_per_channel: false, ..usual }),
        ("no rotational gradient", Details { rotation: false, ..usual }),
        ("R not limited by gradient", Details { radius_by_gradient: false, ..usual }),
        ("gradient not limited by R", Details { gradient_by_radius: false, ..usual }),
        ("weights 1/e", Details { weighting: Weighting::Inverse, ..usual }),
        ("weights 1 - e/a", Details { weighting: Weighting::Linear, ..usual }),
        ("spacing: world", Details { spacing: Spacing::World, ..usual }),
        ("adaptive", Details { adaptive: true, ..usual }),
        ("spacing: free", Details { spacing: Spacing::Free, ..usual }),
    ]
}
