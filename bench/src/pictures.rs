//! Speed against accuracy: every method at several settings, on the scenes with references, one thread.
//!
//! Larger pictures than the references are averaged down before they are judged. Seconds are those of one thread,
//! filling and pixels together, loading apart.

use std::error::Error;

use crate::judge::{SIZE, judge, load, reduce, reference, rgb, settings};
use worker::frame::Frame;
use worker::settings::{Method, Settings};
use worker::solo::{self, Order};
use worker::task::CpuClock;

const SCENES: [&str; 5] = ["cornell.full", "stairs.full", "leak.full", "sphere-plane.one", "glossy-floor.full"];

/// Prints one line a setting. `asked`: EDGE of the pictures, a multiple of 128, and names SCENE.DEPTH, both optional.
///
/// # Errors
/// Arguments that are none of these.
pub fn run(mut asked: Vec<String>) -> Result<(), Box<dyn Error>> {
    let edge = match asked.first().and_then(|first| first.parse::<u32>().ok()) {
        Some(edge) if edge > 0 && (edge as usize).is_multiple_of(SIZE) => edge,
        Some(edge) => return Err(format!("{edge}: expected a multiple of {SIZE}").into()),
        None => SIZE as u32,
    };
    asked.retain(|a| a.parse::<u32>().is_err());
    let names: Vec<&str> = if asked.is_empty() { SCENES.to_vec() } else { asked.iter().map(String::as_str).collect() };
    println!("{edge}x{edge}, one thread; errors relative to the reference's mean");
    println!(
        "{:20} {:28} {:>8} {:>8} {:>7} {:>7} {:>7}",
        "scene", "settings", "CPU s", "records", "RMSE", "bias", "worst"
    );
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    for name in names {
        let (scene, depth) = name.split_once('.').ok_or("expected SCENE.DEPTH, for instance cornell.full")?;
        let truth = reference(name);
        let (scene, camera) = load(&format!("{scene}.glb"));
        let base = Settings { width: edge, height: edge, ..settings(camera, depth) };
        let cached = |rays, spp, a| Settings { rays, spp, a, ..base.clone() };
        let path = |spp| Settings { method: Method::Path, spp, ..base.clone() };
        let ladder = [cached(512, 16, 0.4), base.clone(), cached(8192, 128, 0.2), path(16), path(64), path(256)];
        for settings in ladder {
            let label = match settings.method {
                Method::Path => format!("path --spp {}", settings.spp),
                _ => format!("--rays {} --a {} --spp {}", settings.rays, settings.a, settings.spp),
            };
            let frame = Frame::new(scene.clone(), settings);
            let (levels, pixels, seconds) = one_thread.install(|| {
                let clock = CpuClock::start();
                let levels = solo::fill(&frame, Order::Rounds);
                let pixels = solo::pixels(&frame, &levels).0;
                (levels, pixels, clock.seconds())
            });
            let records: usize = levels.iter().map(|l| l.len()).sum();
            let image = rgb(&pixels);
            let v = judge(&reduce(&image), &truth);
            println!(
                "{name:20} {label:28} {seconds:8.2} {records:8} {:6.2}% {:+6.2}% {:6.2}%",
                100.0 * v.rmse,
                100.0 * v.bias,
                100.0 * v.worst
            );
        }
    }
    Ok(())
}
