//! Whether a picture is as far from the truth as was asked for, and what that costs.

use std::error::Error;

use worker::frame::Frame;
use worker::pilot;
use worker::solo::{self, Order};
use worker::task::CpuClock;

use crate::judge::{SIZE, judge, load, reduce, reference, rgb, settings};
use crate::own;
use crate::strip::{Panel, Strip};

/// Which errors to ask for, and of what.
#[derive(clap::Args)]
pub struct AskedArgs {
    /// Scenes as SCENE.DEPTH
    #[arg(default_values = ["cornell.full", "stairs.full", "leak.full", "sphere-plane.full", "glossy-floor.full", "white-furnace.full"])]
    scenes: Vec<String>,
    /// The scenes of our own, that nothing was tuned on, in place of these; their references take minutes, once
    #[arg(long)]
    own: bool,
    /// Errors to ask for
    #[arg(long, value_delimiter = ',', default_values_t = [0.05f32, 0.02, 0.01])]
    error: Vec<f32>,
    /// Write DIR/SCENE.DEPTH-ERROR.png: reference, picture, the picture four times as bright, and how much brighter or darker than
    /// the reference it is, white and black being 5 %
    #[arg(long, value_name = "DIR")]
    pictures: Option<std::path::PathBuf>,
    /// Edge of the pictures, a multiple of 128
    #[arg(long, default_value_t = SIZE as u32)]
    edge: u32,
}

/// Prints one line a picture.
///
/// # Errors
/// Names that are no SCENE.DEPTH.
pub fn run(args: &AskedArgs) -> Result<(), Box<dyn Error>> {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    println!(
        "{0}x{0}, one thread; believed: sampling, noise, interpolation. CPU seconds: pilot, fill, pixels",
        args.edge
    );
    println!("scene              asked    RMSE   bias  worst | believed                     | a     spp records | CPU");
    let own: Vec<_> = own::NAMES.iter().map(|name| format!("{name}.full")).collect();
    for name in if args.own { &own } else { &args.scenes } {
        let (scene, depth) = name.split_once('.').ok_or("expected SCENE.DEPTH, for instance stairs.full")?;
        let (scene, camera, truth) = if args.own {
            own::load(scene)?
        } else {
            let (scene, camera) = load(&format!("{scene}.glb"));
            (scene, camera, reference(name))
        };
        for &error in &args.error {
            let base =
                worker::settings::Settings { width: args.edge, height: args.edge, ..settings(camera.clone(), depth) };
            let frame = Frame::new(scene.clone(), base);
            let (frame, forecast, records, pixels, counts, seconds) = one_thread.install(|| {
                let clock = CpuClock::start();
                let (frame, forecast) = pilot::choose(frame, error);
                let chosen = clock.seconds();
                let levels = solo::fill(&frame, Order::Rounds);
                let filled = clock.seconds();
                let (pixels, counts) = solo::pixels(&frame, &levels);
                let seconds = [chosen, filled - chosen, clock.seconds() - filled];
                (frame, forecast, levels.iter().map(|l| l.len()).collect::<Vec<_>>(), pixels, counts, seconds)
            });
            let image = rgb(&pixels);
            let image = reduce(&image);
            let v = judge(&image, &truth);
            if let Some(folder) = &args.pictures {
                std::fs::create_dir_all(folder)?;
                let panels = [
                    Panel::Light(&truth.image, 1.0),
                    Panel::Light(&image, 1.0),
                    Panel::Light(&image, 4.0),
                    Panel::Difference(&image, &truth.image, 0.05),
                ];
                let strip = Strip { place: [0; 2], crop: SIZE, enlarged: 2 };
                strip.of(&panels).save(folder.join(format!("{name}-{error}.png")))?;
            }
            let e = pilot::reached(&counts, &forecast);
            let percent = |v: f64| 100.0 * v;
            println!(
                "{name:18} {:4.1}% {:6.2}% {:+5.2}% {:5.2}% | {:5.2}% = {:5.2} {:5.2} {:5.2} (a {:.2}) | {:.2} {:5.1} {records:?} | {:.2} {:.2} {:.2}",
                percent(error.into()),
                percent(v.rmse),
                percent(v.bias),
                percent(v.worst),
                percent(e.total()),
                percent(e.sampling),
                percent(e.noise),
                percent(e.interpolation),
                frame.settings().a,
                frame.settings().a,
                counts.samples as f64 / f64::from(args.edge * args.edge),
                seconds[0],
                seconds[1],
                seconds[2],
            );
        }
    }
    Ok(())
}
