//! Where records of radiance pay: error and cost against the sharpness of gloss, for every order of their harmonics, for
//! sampling each pixel, and for what `auto` picks.

use std::error::Error;

use cache_core::details::Details;
use worker::frame::Frame;
use worker::lobes::ORDERS;
use worker::pilot;
use worker::scene::{Camera, Rgb, Scene, Surface};
use worker::settings::{Method, Settings};
use worker::solo::{self, Order};
use worker::task::CpuClock;

use crate::judge::{SIZE, judge, load, reduce, rgb, settings};
use crate::own;
use crate::results::{Point, Results};
use crate::rounded::rounded;

/// What to measure.
#[derive(clap::Args)]
pub struct GlossArgs {
    /// Roughness alpha of the glossy surfaces
    #[arg(default_values_t = [0.6f32, 0.3, 0.2, 0.15, 0.1, 0.05])]
    alpha: Vec<f32>,
    /// What glosses: the floor, a ball and a torus in place of the blocks, or a coat on everything
    #[arg(long, value_parser = ["floor", "curved", "coated"], default_value = "floor")]
    scene: String,
    /// Edge of the pictures, a multiple of 128
    #[arg(long, default_value_t = SIZE as u32)]
    edge: u32,
    /// Errors to ask of each method
    #[arg(long, value_delimiter = ',', default_values_t = [0.08f32, 0.04, 0.02])]
    error: Vec<f32>,
    /// Keep table and chart in bench/results
    #[arg(long)]
    save: bool,
}

/// Prints one line a picture.
///
/// # Errors
/// The disk's.
pub fn run(args: &GlossArgs) -> Result<(), Box<dyn Error>> {
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let mut results = Results::open("gloss")?;
    for &alpha in &args.alpha {
        let name = format!("{}-{alpha}", args.scene);
        let (scene, camera) = match args.scene.as_str() {
            "curved" => rounded(alpha),
            "coated" => coated(alpha),
            _ => floor(alpha),
        };
        let truth = own::reference(&name, &scene, &camera)?;
        let mut measure = |renderer: &str, setting: String, settings: Settings, error: Option<f32>| {
            let ((pixels, records), seconds) = one_thread.install(|| {
                let clock = CpuClock::start();
                let frame = Frame::new(scene.clone(), settings);
                let frame = if let Some(error) = error { pilot::choose(frame, error).0 } else { frame };
                let levels = solo::fill(&frame, Order::Rounds);
                let records = levels.first().map_or([0; 2], |l| [l.irradiance.len(), l.len() - l.irradiance.len()]);
                ((solo::pixels(&frame, &levels).0, records), clock.seconds())
            });
            let setting = format!("{setting}; {} + {} records", records[0], records[1]);
            let verdict = judge(&reduce(&rgb(&pixels)), &truth);
            results.put(Point::new(name.clone(), args.edge, renderer.into(), setting, [seconds; 2], &verdict));
        };
        let base = Settings { width: args.edge, height: args.edge, ..settings(camera, "full") };
        let with = |method| Settings { method, ..base.clone() };
        for &error in &args.error {
            for (renderer, method) in
                [("sampling", Method::Irradiance), ("radiance", Method::Radiance), ("auto", Method::Auto)]
            {
                measure(renderer, format!("--error {error}"), with(method), Some(error));
            }
        }
        for order in ORDERS {
            let details = Details { order: Some(order), ..Details::default() };
            let settings = Settings { details, rays: 2048, ..with(Method::Radiance) };
            measure(&format!("order {order}"), "--rays 2048".into(), settings, None);
        }
    }
    if args.save { results.save() } else { Ok(()) }
}

/// The box with a coat on all that is diffuse.
fn coated(alpha: f32) -> (Scene, Camera) {
    let (mut scene, camera) = load("cornell.glb");
    for material in &mut scene.materials {
        let roughness = alpha.sqrt();
        material.surface =
            Surface::Gltf { metallic: 0.0, roughness, specular: 1.0, specular_color: Rgb::ONE, ior: 1.5 };
    }
    (scene, camera)
}

/// The box with the glossy floor, of another roughness.
fn floor(alpha: f32) -> (Scene, Camera) {
    let (mut scene, camera) = load("glossy-floor.glb");
    for material in &mut scene.materials {
        if let Surface::Gltf { metallic, roughness, .. } = &mut material.surface
            && *metallic > 0.0
        {
            *roughness = alpha.sqrt();
        }
    }
    (scene, camera)
}
