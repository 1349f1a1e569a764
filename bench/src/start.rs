//! From the start of the program to its first rays, and how much memory that takes, in the arcade: `ambience render` of one tile,
//! one sample a pixel, to its end.

use std::error::Error;
use std::process::Command;

use serde_json::Value;
use worker::scene;

use crate::report::{Report, quantile};
use crate::{judge, own, peers};

/// Arguments of the benchmark.
#[derive(Clone, Debug, clap::Args)]
pub struct StartArgs {
    /// Rounds; the median counts
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Keep the table in bench/results
    #[arg(long)]
    save: bool,
}

/// Measures and prints.
///
/// # Errors
/// The disk's, and those of a render that fails.
pub fn run(args: &StartArgs) -> Result<(), Box<dyn Error>> {
    let (program, arcade) = (peers::program()?, own::file("arcade")?.ok_or("no arcade")?);
    let folder = tempfile::tempdir()?;
    let [picture, stats] = ["picture.exr", "stats.json"].map(|name| folder.path().join(name));
    let mut report = Report::begin("cargo run --release -p ambience-bench -- start");
    report.line(&format!(
        "ambience render --size 16x16 --method path --spp 1, one worker, {} rounds, medians; peak: of the larger of the two processes \
         that hold the scene; bytes a triangle: over the first scene's",
        args.rounds
    ));
    report.line("scene         triangles   wall s    CPU s    peak MiB   bytes a triangle");
    let mut least = None;
    for path in [judge::file("scenes/cornell.glb"), arcade.with_extension("glb"), arcade.clone()] {
        let mut figures: [Vec<f64>; 3] = Default::default();
        for _ in 0..args.rounds {
            let mut command = Command::new(&program);
            command.args(["render", "--quiet", "--size", "16x16", "--method", "path", "--spp", "1", "--workers", "1"]);
            command.arg(&path).arg("-o").arg(&picture).arg("--stats").arg(&stats);
            let [wall, cpu] = peers::timed(&mut command)?;
            let told: Value = serde_json::from_slice(&std::fs::read(&stats)?)?;
            let peaks = &told["peak_memory_bytes"];
            let peak = ["render_process", "largest_child"].map(|name| peaks[name].as_f64().unwrap_or(f64::NAN));
            [wall, cpu, peak[0].max(peak[1])].into_iter().zip(&mut figures).for_each(|(value, all)| all.push(value));
        }
        let [wall, cpu, peak] = figures.each_mut().map(|values| quantile(values, 0.5));
        let triangles = scene::load(&path)?.triangles.len();
        let each = (peak - *least.get_or_insert(peak)) / triangles as f64;
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        report.line(&format!("{name:12} {triangles:10} {wall:8.3} {cpu:8.3} {:11.1} {each:10.0}", peak / 1_048_576.0));
    }
    if args.save {
        report.save("start")?;
    }
    Ok(())
}
