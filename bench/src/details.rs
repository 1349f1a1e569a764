//! What each practical detail of irradiance caching buys: error and records with one choice changed at a time.

use std::error::Error;
use std::path::{Path, PathBuf};

use cache_core::details::{Details, Distance, Gradients, Metric, Spacing, Weighting};
use cache_core::rounds::RANKS;
use worker::frame::Frame;
use worker::settings::Settings;
use worker::solo::{self, Filled, Order};
use worker::task::CpuClock;

use crate::judge::{Reference, SIZE, Verdict, judge, load, reference, rgb, settings};
use crate::report::quantile;
use crate::strip::{Panel, Strip};

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
    /// How many seeds; medians are printed
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    /// In place of the table: for each detail a place where a picture without it errs, into this folder
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

/// Prints one line for every choice and allowed error.
///
/// # Errors
/// Names that are no SCENE.DEPTH.
pub fn run(args: &DetailsArgs) -> Result<(), Box<dyn Error>> {
    if let Some(folder) = &args.pictures {
        return pictures(args, folder);
    }
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    println!(
        "{SIZE}x{SIZE}, --rays {} --spp {}, medians of {} seeds; records of level 1, of all; CPU seconds of the fill; RMSE, bias, worst block, and that of \
         the worst seed; passes, proposals, tests and sealing as shares of the fill",
        args.rays, args.spp, args.seeds
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
                let seeds = (0..args.seeds).map(|seed| {
                    let base = settings(camera.clone(), depth);
                    Settings { a, seed, rays: args.rays, spp: args.spp, details, ..base }
                });
                let all =
                    seeds.map(|settings| one_thread.install(|| measure(&Frame::new(scene.clone(), settings), &truth)));
                let all: Vec<Measured> = all.collect();
                let of = |value: fn(&Measured) -> f64| quantile(&mut all.iter().map(value).collect::<Vec<_>>(), 0.5);
                let worst = all.iter().map(|m| m.verdict.worst).fold(0.0, f64::max);
                println!(
                    "{name:16} {choice:34} a {a:<4} {:6} {:6} {:7.2} s  {:5.2}% {:+5.2}% {:5.2}% {:5.2}%  {:3} {:6} {:5.1}% {:5.1}%",
                    of(|m| m.records[0] as f64),
                    of(|m| m.records.iter().sum::<usize>() as f64),
                    of(|m| m.seconds),
                    100.0 * of(|m| m.verdict.rmse),
                    100.0 * of(|m| m.verdict.bias),
                    100.0 * of(|m| m.verdict.worst),
                    100.0 * worst,
                    of(|m| m.filled.passes.into()),
                    of(|m| m.filled.proposals as f64),
                    100.0 * of(|m| m.filled.counts.test_seconds / m.seconds),
                    100.0 * of(|m| m.filled.sealing_seconds / m.seconds),
                );
            }
        }
    }
    Ok(())
}

/// What came of one picture.
struct Measured {
    /// Of each level.
    records: Vec<usize>,
    filled: Filled,
    /// CPU seconds of the fill.
    seconds: f64,
    verdict: Verdict,
}

fn measure(frame: &Frame, truth: &Reference) -> Measured {
    let clock = CpuClock::start();
    let filled = solo::fill_ranks(frame, Order::Rounds, RANKS);
    let seconds = clock.seconds();
    let verdict = judge(&rgb(&solo::pixels(frame, &filled.levels).0), truth);
    let records = filled.levels.iter().map(|level| level.len()).collect();
    Measured { records, filled: Filled { levels: Vec::new(), ..filled }, seconds, verdict }
}

/// Where a detail shows.
struct Shown {
    name: &'static str,
    /// The scene that breaks without it.
    scene: &'static str,
    /// The allowed error there.
    a: f32,
    with: Details,
    without: Details,
    /// What is looked at; else where the picture without it errs most.
    place: Option<[usize; 2]>,
}

fn shown() -> Vec<Shown> {
    let usual = Details::default();
    let without = |name, scene, a, without| Shown { name, scene, a, with: usual, without, place: None };
    vec![
        without("metric", "stairs.full", 0.4, Details { metric: Metric::SplitSphere, ..usual }),
        without("neighbor-clamping", "stairs.full", 0.4, Details { neighbor_clamping: false, ..usual }),
        without("translational-gradient", "cornell.full", 0.4, Details { gradients: Gradients::None, ..usual }),
        without("rotational-gradient", "sphere-plane.full", 0.4, Details { rotation: false, ..usual }),
        without("gradients-per-channel", "cornell.full", 0.4, Details { gradients_per_channel: false, ..usual }),
        without("radius-by-gradient", "cornell.full", 0.4, Details { radius_by_gradient: false, ..usual }),
        without("gradient-by-radius", "stairs.full", 0.2, Details { gradient_by_radius: false, ..usual }),
        without("weights", "cornell.full", 0.4, Details { weighting: Weighting::Inverse, ..usual }),
        without("distance", "leak.full", 0.4, Details { distance: Distance::Nearest, ..usual }),
        without("spacing", "stairs.full", 0.2, Details { spacing: Spacing::World, ..usual }),
        // The front of the tall block, where the top of the short one comes into sight.
        Shown {
            with: Details { adaptive: true, ..usual },
            place: Some([30, 50]),
            ..without("adaptive", "cornell.full", 0.25, usual)
        },
    ]
}

/// One picture for each detail, DIR/NAME.png: reference, with it, without it, and how much brighter or darker than the reference
/// these two are, white and black being 5 %; and a line.
fn pictures(args: &DetailsArgs, folder: &Path) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir_all(folder)?;
    println!(
        "128x128, --rays {} --spp {}; with -> without: records of level 1, RMSE, worst block",
        args.rays, args.spp
    );
    for Shown { name, scene, a, with, without, place } in shown() {
        if args.only.as_ref().is_some_and(|only| !name.contains(only.as_str())) {
            continue;
        }
        let (file, depth) = scene.split_once('.').ok_or("expected SCENE.DEPTH")?;
        let truth = reference(scene);
        let render = |details: Details| {
            let (scene, camera) = load(&format!("{file}.glb"));
            let base = settings(camera, depth);
            let frame = Frame::new(scene, Settings { a, rays: args.rays, spp: args.spp, details, ..base });
            let levels = solo::fill(&frame, Order::Rounds);
            let image = rgb(&solo::pixels(&frame, &levels).0);
            let verdict = judge(&image, &truth);
            (image, levels.first().map_or(0, |level| level.len()), verdict)
        };
        let (with, without) = (render(with), render(without));
        let percent = |v: f64| 100.0 * v;
        println!(
            "{name:24} {scene:18} a {a} {:6} -> {:6}  {:5.2} % -> {:5.2} %  {:5.2} % -> {:5.2} %",
            with.1,
            without.1,
            percent(with.2.rmse),
            percent(without.2.rmse),
            percent(with.2.worst),
            percent(without.2.worst),
        );
        let worst = without.2.place.map(|at| at.saturating_sub(CROP / 2 - 4).min(SIZE - CROP));
        let strip = Strip { place: place.unwrap_or(worst), crop: CROP, enlarged: ENLARGED };
        let lights = [&truth.image, &with.0, &without.0].map(|picture| Panel::Light(picture, 1.0));
        let off = [&with.0, &without.0].map(|picture| Panel::Difference(picture, &truth.image, 0.05));
        strip.of(&lights.into_iter().chain(off).collect::<Vec<_>>()).save(folder.join(format!("{name}.png")))?;
    }
    Ok(())
}

/// Edge of what is shown of a picture, and how much it is enlarged.
const CROP: usize = 48;
const ENLARGED: usize = 4;

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
        ("no neighbor clamping", Details { neighbor_clamping: false, ..usual }),
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
