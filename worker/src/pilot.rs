//! Settings from an error: a small part of the picture is rendered, and what it shows decides how the rest is.
//!
//! Three things keep a picture from the truth, and each is measured on the same few pixels: *sampling* (what samples of one
//! pixel scatter by), *noise* (what the rays of one gather scatter by), and *interpolation* (what records say between them
//! against gathers made there). Each gets a share of the mean square that is asked for; what one cannot use falls
//! to the others. The pilot depends on scene, view, error and seed alone, so its choice is the same everywhere.

use cache_core::Query;
use cache_core::hemisphere::Strata;
use cache_core::id::Random;
use cache_core::rounds::{RANKS, rank};

use crate::frame::{Counts, Frame, Levels};
use crate::gather::{Gather, Rays};
use crate::pixel::Pixel;
use crate::settings::{Effort, Settings};
use crate::solo::{self, Order};

/// Least and greatest error that may be asked for.
pub const ERROR_RANGE: (f32, f32) = (0.001, 0.5);

/// Pixels the pilot looks at, about: it fills records for them and samples them.
const PIXELS: u32 = 4096;

/// Of those, where records are tested against a gather of their own.
const PROBES: usize = 256;

/// Allowed error a of the pilot's records, and rays of their gathers.
const A: f32 = 0.6;
const RAYS: u32 = 128;

/// Rays of a gather that records are tested against.
const PROBE_RAYS: u32 = 512;

/// Samples of each of the pilot's pixels.
const SPP: u32 = 8;

/// What a picture may reach for, as a fraction of the error asked: forecasts err.
const AIM: f64 = 0.75;

/// Shares of the mean square for sampling, noise and interpolation.
const SHARES: [f64; 3] = [0.4, 0.35, 0.25];

/// A record's noise over that of an answer, which is the mean of several records.
const RECORDS_AT_ONCE: f64 = 1.7;

/// Bounds of what may be chosen.
const A_RANGE: (f64, f64) = (0.2, 1.0);
const RAYS_MOST: u32 = 16384;
const SPP_MOST: u32 = 4096;

/// Standard errors, relative to the picture's mean radiance.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    /// For the samples of a pixel.
    pub sampling: f64,
    /// For the rays of the gathers.
    pub noise: f64,
    /// For what lies between records.
    pub interpolation: f64,
}

impl Errors {
    /// All together.
    pub fn total(&self) -> f64 {
        self.sampling.hypot(self.noise).hypot(self.interpolation)
    }
}

/// What the pilot saw.
#[derive(Clone, Copy, Debug, Default)]
pub struct Forecast {
    /// Mean radiance of the picture, mean of the channels, W/(sr m²).
    pub radiance: f64,
    /// What the chosen settings should reach.
    pub errors: Errors,
    /// Pixels it looked at.
    pub pixels: usize,
    /// What it cost.
    pub counts: Counts,
}

/// Chooses settings for a picture whose relative RMSE should be `error`, within [`ERROR_RANGE`]: the frame with them, and
/// why. What `frame`'s settings say of view, size, bounces, method and seed stays.
pub fn choose(frame: Frame, error: f32) -> (Frame, Forecast) {
    let asked = frame.settings().clone();
    let trial = Settings { a: A, rays: RAYS, spp: SPP, effort: None, ..asked.clone() };
    let frame = frame.with(trial);
    let seen = look(&frame);
    let most = 1.0 / seen.radiance.max(f64::MIN_POSITIVE);
    let aim = (f64::from(error) * AIM).powi(2);

    // Mean squares relative to the mean radiance: sampling and noise for an effort of 1, interpolation at the pilot's a.
    let sampling = seen.deviation * most * most;
    let noise = seen.noise * f64::from(RAYS).sqrt() / RECORDS_AT_ONCE * most * most;
    let interpolation = seen.interpolation * most * most;
    // What each can reach at most: with the fewest samples, the fewest rays, the greatest a.
    let cached = frame.levels() > 0;
    let greatest = interpolation * (A_RANGE.1 / f64::from(A)).powi(2);
    let mut shares = SHARES.map(|share| share * aim);
    if !cached {
        shares = [aim, 0.0, 0.0];
    } else if greatest < shares[2] {
        let rest = shares[2] - greatest;
        shares = [shares[0] + rest * 0.5, shares[1] + rest * 0.5, greatest];
    }
    let a = if interpolation > 0.0 { f64::from(A) * (shares[2] / interpolation).sqrt() } else { A_RANGE.1 };
    let a = a.clamp(A_RANGE.0, A_RANGE.1);
    let samples = sampling / shares[0];
    let rays = if cached { noise / shares[1] } else { 1.0 };
    let errors = Errors {
        sampling: shares[0].sqrt(),
        noise: shares[1].sqrt(),
        interpolation: interpolation.sqrt() * a / f64::from(A),
    };
    let positive = |effort: f64| (effort as f32).clamp(f32::MIN_POSITIVE, f32::MAX);
    let effort = Effort { rays: positive(rays / most), samples: positive(samples / most) };
    let chosen = Settings { a: a as f32, rays: RAYS_MOST, spp: SPP_MOST, effort: Some(effort), ..asked };
    let forecast = Forecast { radiance: seen.radiance, errors, pixels: seen.pixels, counts: seen.counts };
    (frame.with(chosen), forecast)
}

/// Means over the pilot's pixels; radiance in W/(sr m²).
#[derive(Default)]
struct Seen {
    radiance: f64,
    /// Standard deviation of one sample.
    deviation: f64,
    /// Standard error that records bring.
    noise: f64,
    /// Mean square of what interpolation is off by.
    interpolation: f64,
    pixels: usize,
    counts: Counts,
}

fn look(frame: &Frame) -> Seen {
    let settings = frame.settings();
    let size = settings.width * settings.height;
    let ranks = (u64::from(RANKS) * u64::from(PIXELS) / u64::from(size.max(1))).clamp(1, RANKS.into()) as u32;
    let levels = solo::fill_ranks(frame, Order::Rounds, ranks);
    let mut seen = Seen::default();
    let tracer = frame.tracer(&levels);
    let pixels = || (0..settings.height).flat_map(|y| (0..settings.width).map(move |x| [x, y]));
    for [x, y] in pixels().filter(|[x, y]| rank(*x, *y) < ranks) {
        let mut pixel = Pixel::new(settings, x, y);
        pixel.sample(0..SPP, &tracer, settings, &mut seen.counts);
        seen.radiance += f64::from(pixel.mean().element_sum()) / 3.0;
        seen.deviation += pixel.variance().sqrt();
        seen.noise += pixel.record_deviation();
        seen.pixels += 1;
    }
    let count = seen.pixels.max(1) as f64;
    seen.radiance /= count;
    seen.deviation /= count;
    seen.noise /= count;
    if !levels.is_empty() {
        seen.interpolation = probe(frame, &levels, &mut seen.counts);
    }
    seen
}

/// Mean square by which interpolated radiance differs from gathered, less what noise of both explains.
fn probe(frame: &Frame, levels: &Levels, counts: &mut Counts) -> f64 {
    let settings = frame.settings();
    let mut random = Random::named("probe", &[settings.seed]);
    let mut place = |size: u32| ((random.uniform() * size as f32) as u32).min(size - 1);
    let strata = Strata::new(PROBE_RAYS);
    let gather = Gather {
        tracer: &frame.tracer(levels),
        namespace: frame.namespace(),
        seed: settings.seed,
        level: 1,
        rays: Rays::Fixed(&strata),
        details: &settings.details,
    };
    let (mut sum, mut found) = (0.0, 0);
    for _ in 0..PROBES {
        // Another point of the pixel than the one records are made for.
        let Some(site) = frame.site(1, 1, place(settings.width), place(settings.height), counts) else { continue };
        let query = Query { position: site.at.position, normal: site.at.normal() };
        let Some(answer) = levels[0].ask(&query) else { continue };
        let truth = gather.record(gather.id(&site), &site, counts);
        let square = (truth.irradiance - answer.irradiance).length_squared() / 3.0;
        let explained = truth.noise * truth.noise + answer.noise * answer.noise;
        sum += f64::from((square - explained) * (site.reflectance * std::f32::consts::FRAC_1_PI).powi(2));
        found += 1;
    }
    (sum / f64::from(found.max(1))).max(0.0)
}

/// What was reached, as far as the finished picture itself can tell: sampling and noise are measured on all its pixels,
/// interpolation is the forecast's.
pub fn reached(counts: &Counts, forecast: &Forecast) -> Errors {
    let pixels = counts.pixels.max(1) as f64;
    let mean = (counts.radiance / pixels).max(f64::MIN_POSITIVE);
    Errors {
        sampling: (counts.pixel_variance / pixels).sqrt() / mean,
        noise: (counts.record_variance / pixels).sqrt() / mean,
        interpolation: forecast.errors.interpolation,
    }
}
