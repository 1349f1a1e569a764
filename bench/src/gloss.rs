//! Where records of radiance pay: error and cost against the sharpness of gloss, for every order of their harmonics, for
//! sampling each pixel, and for what `auto` picks.

use std::error::Error;

use cache_core::details::Details;
use cache_core::radiance::ORDERS;
use cache_core::rounds::RANKS;
use worker::frame::Frame;
use worker::pilot;
use worker::scene::{Camera, Rgb, Scene, Surface};
use worker::settings::{Method, Settings};
use worker::solo::{self, Order};
use worker::task::CpuClock;

use crate::judge::{SIZE, judge, load, reduce, rgb, settings};
use crate::own;
use crate::report::{Curve, Report, SeriesLabelPosition, logarithmic};
use crate::rounded::rounded;

/// Scenes there are.
const SCENES: [&str; 3] = ["floor", "curved", "coated"];

/// Allowed errors adaptive caching is measured at: without it, and with it.
const ADAPTIVE: [&[f32]; 2] = [&[0.8, 0.6, 0.4, 0.3, 0.2], &[0.8, 0.6, 0.4]];

/// What to measure.
#[derive(clap::Args)]
pub struct GlossArgs {
    /// Roughness alpha of the glossy surfaces
    #[arg(default_values_t = [0.6f32, 0.4, 0.3, 0.2, 0.15, 0.1])]
    alpha: Vec<f32>,
    /// What glosses: the floor of the box, a ball and a torus in place of its blocks, or a coat on everything
    #[arg(long, value_parser = SCENES, default_value = "floor")]
    scene: String,
    /// Error to ask of sampling, of records wherever there is gloss, and of auto; each order of records is measured as it is
    #[arg(long, default_value_t = 0.02)]
    error: f32,
    /// Edge of the pictures, a multiple of 128; orders are measured at 128
    #[arg(long, default_value_t = SIZE as u32)]
    edge: u32,
    /// Adaptive caching against the same number of records without it, in place of all this
    #[arg(long)]
    adaptive: bool,
    /// Keep table and chart in bench/results
    #[arg(long)]
    save: bool,
}

/// One picture.
struct Measured {
    renderer: String,
    alpha: f32,
    /// Percent.
    rmse: f64,
    worst: f64,
    /// CPU seconds.
    cpu: f64,
}

/// Prints one line a picture.
///
/// # Errors
/// The disk's.
pub fn run(args: &GlossArgs) -> Result<(), Box<dyn Error>> {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    let mut report = Report::begin(&format!("cargo run --release -p ambience-bench -- {}", arguments.join(" ")));
    report.line("RMSE, bias, worst block; CPU seconds; records of irradiance and of radiance; passes, tests as a share of the fill");
    let mut all = Vec::new();
    for &alpha in &args.alpha {
        let name = format!("{}-{alpha}", args.scene);
        let (scene, camera) = match args.scene.as_str() {
            "curved" => rounded(alpha),
            "coated" => coated(alpha),
            _ => floor(alpha),
        };
        let truth = own::reference(&name, &scene, &camera)?;
        let base = Settings { width: args.edge, height: args.edge, ..settings(camera, "full") };
        let mut measure = |renderer: &str, settings: Settings, error: Option<f32>| {
            let (pixels, filled, fill, cpu) = one_thread.install(|| {
                let clock = CpuClock::start();
                let frame = Frame::new(scene.clone(), settings);
                let frame = if let Some(error) = error { pilot::choose(frame, error).0 } else { frame };
                let before = clock.seconds();
                let filled = solo::fill_ranks(&frame, Order::Rounds, RANKS);
                let fill = clock.seconds() - before;
                (solo::pixels(&frame, &filled.levels).0, filled, fill, clock.seconds())
            });
            let v = judge(&reduce(&rgb(&pixels)), &truth);
            let [rmse, bias, worst, tests] =
                [v.rmse, v.bias, v.worst, filled.counts.test_seconds / fill].map(|v| 100.0 * v);
            let (first, edge) = (&filled.levels[0], args.edge);
            let [irradiance, radiance] = [first.irradiance.len(), first.len() - first.irradiance.len()];
            report.line(&format!(
                "{name:12} {edge}x{edge} {renderer:24} {rmse:5.2}% {bias:+5.2}% {worst:5.2}% {cpu:7.2} s {irradiance:6} {radiance:6} {:3} {tests:4.1}%",
                filled.passes,
            ));
            all.push(Measured { renderer: renderer.into(), alpha, rmse, worst, cpu });
        };
        let with = |method| Settings { method, ..base.clone() };
        if args.adaptive {
            for (adaptive, allowed) in [false, true].into_iter().zip(ADAPTIVE) {
                for &a in allowed {
                    let details = Details { adaptive, ..Details::default() };
                    let settings = Settings { a, rays: 1024, details, ..with(Method::Radiance) };
                    measure(&format!("{} a {a}", if adaptive { "adaptive" } else { "plain" }), settings, None);
                }
            }
            continue;
        }
        let methods = [("sampling", Method::Irradiance), ("radiance", Method::Radiance), ("auto", Method::Auto)];
        for (renderer, method) in methods {
            measure(renderer, with(method), Some(args.error));
        }
        // Larger pictures show the same lobes.
        for order in ORDERS.into_iter().filter(|_| args.edge == SIZE as u32) {
            let details = Details { order: Some(order), ..Details::default() };
            measure(&format!("order {order}"), Settings { details, rays: 2048, ..with(Method::Radiance) }, None);
        }
    }
    if args.save {
        let name = format!("gloss-{}-{}{}", args.scene, args.edge, if args.adaptive { "-adaptive" } else { "" });
        report.save(&name)?;
        if !args.adaptive {
            logarithmic(&name, "alpha", SeriesLabelPosition::UpperRight, &panels(&args.scene, &all))?;
        }
    }
    Ok(())
}

/// Error, worst block and cost over alpha.
fn panels(scene: &str, all: &[Measured]) -> Vec<(String, Vec<Curve>)> {
    type Value = fn(&Measured) -> f64;
    let values: [(&str, Value); 3] =
        [("RMSE, %", |m| m.rmse), ("worst block, %", |m| m.worst), ("CPU seconds", |m| m.cpu)];
    let first = all.first().map(|m| m.alpha);
    let renderers: Vec<_> = all.iter().filter(|m| Some(m.alpha) == first).map(|m| m.renderer.as_str()).collect();
    let curve = |renderer: &str, value: Value| {
        let points = all.iter().filter(|m| m.renderer == renderer);
        (renderer.to_string(), points.map(|m| (f64::from(m.alpha), value(m))).collect())
    };
    let panel = |(what, value)| (format!("{scene}: {what}"), renderers.iter().map(|r| curve(r, value)).collect());
    values.into_iter().map(panel).collect()
}

/// The box with a coat on all that is diffuse.
fn coated(alpha: f32) -> (Scene, Camera) {
    let (mut scene, camera) = load("cornell.glb");
    for material in &mut scene.materials {
        let (metallic, roughness) = (0.0, alpha.sqrt());
        material.surface = Surface::Gltf { metallic, roughness, specular: 1.0, specular_color: Rgb::ONE, ior: 1.5 };
    }
    (scene, camera)
}

/// The box with the glossy floor, of another roughness.
fn floor(alpha: f32) -> (Scene, Camera) {
    let (mut scene, camera) = load("glossy-floor.glb");
    for material in &mut scene.materials {
        if let Surface::Gltf { metallic: 1.0, roughness, .. } = &mut material.surface {
            *roughness = alpha.sqrt();
        }
    }
    (scene, camera)
}
