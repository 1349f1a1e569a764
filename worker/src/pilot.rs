//! Settings from an error: a small part of the picture is rendered, and what it shows decides how the rest is.
//!
//! Three things keep a picture from the truth, and each is measured on the same few pixels: *sampling* (what samples of one
//! pixel scatter by), *noise* (what the rays of one gather scatter by), and *interpolation* (what records say between them
//! against gathers made there). Each gets a share of the mean square that is asked for; what one cannot use falls
//! to the others. The pilot depends on scene, view, error and seed alone, so its choice is the same everywhere.

use cache_core::hemisphere::Strata;
use cache_core::id::Random;
use cache_core::incoming::Bands;
use cache_core::rounds::{RANKS, rank};

use crate::frame::{Counts, Frame, Sums};
use crate::gather::{Gather, Rays};
use crate::levels::{Level, Levels};
use crate::pixel::{Pixel, SPREAD};
use crate::settings::{Effort, Settings};
use crate::solo::{self, Order};

/// Least and greatest error that may be asked for.
pub const ERROR_RANGE: (f32, f32) = (0.001, 0.5);

/// Pixels the pilot looks at, about: it fills records for them and samples them.
const PIXELS: u32 = 4096;

/// Of those, where records are tested against a gather of their own.
const PROBES: usize = 256;

/// Allowed error a of the pilot's records. What they err by grows with its square: their gradients take the linear part.
const A: f32 = 0.6;

/// Rays of their gathers, times the square of the error asked for: their noise must not hide what interpolation errs by.
const RAYS: f32 = 0.4;
const RAYS_RANGE: (f32, f32) = (64.0, 2048.0);

/// What interpolation errs by at that a where probes cannot tell, relative to the picture's mean radiance: cornell, stairs and
/// glossy-floor are within twice of it.
const INTERPOLATION: f64 = 0.01;

/// Pixels beyond which a picture has no more candidates for records.
const PIXELS_TESTED: u64 = 1 << 18;

/// Samples of each of the pilot's pixels.
const SPP: u32 = 8;

/// What a picture may reach for, as a fraction of the error asked: forecasts err.
const AIM: f64 = 0.75;

/// Divisions of the mean square that are weighed against each other, and one for pictures without light.
const STEPS: u32 = 63;
const SHARES: [f64; 3] = [0.4, 0.35, 0.25];

/// What more samples than the pilot's leave of the variance, besides [`SPREAD`].
const WELL_SPREAD: f64 = 0.7;

/// A record's noise over that of an answer, which is the mean of several records.
const RECORDS_AT_ONCE: f64 = 1.3;

/// A gather traces at least an average one's rays divided by this.
const LEAST: f64 = 2.0;
const LEAST_RANGE: (u32, u32) = (16, 2048);

/// Time a look into the cache takes, in rays.
const RAYS_A_QUERY: f64 = 8.0;

/// Bounds of what may be chosen.
const A_RANGE: (f64, f64) = (0.2, 0.8);
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
    /// What it cost.
    pub counts: Counts,
}

/// Chooses settings for a picture whose relative RMSE should be `error`, within [`ERROR_RANGE`]: the frame with them, and
/// why. What `frame`'s settings say of view, size, bounces, method and seed stays.
pub fn choose(frame: Frame, error: f32) -> (Frame, Forecast) {
    let asked = frame.settings().clone();
    let few = (RAYS / (error * error)).clamp(RAYS_RANGE.0, RAYS_RANGE.1) as u32;
    let trial = Settings { a: A, rays: few, spp: SPP, effort: None, ..asked.clone() };
    let frame = frame.with(trial);
    let seen = look(&frame);
    let most = 1.0 / seen.radiance.max(f64::MIN_POSITIVE);
    let aim = (f64::from(error) * AIM).powi(2);

    // Mean squares relative to the mean radiance: sampling and noise for an effort of 1, interpolation at the pilot's a.
    let sampling = seen.deviation * most * most * SPREAD * WELL_SPREAD;
    let noise = seen.noise * f64::from(few).sqrt() / RECORDS_AT_ONCE * most * most;
    let interpolation = seen.interpolation.filled(asked.size()).believed(INTERPOLATION / most) * most * most;
    let [for_sampling, for_noise, for_interpolation] = if frame.levels() == 0 {
        [aim, f64::INFINITY, f64::INFINITY]
    } else {
        // Rays it takes to bring either mean square to 1: of all pixels, and of as many records as the pilot made.
        let pixels = asked.size() as f64;
        let by_sampling = pixels * seen.rays_a_sample * seen.deviation * sampling;
        let by_noise = seen.rays_of_fill * (seen.noise * most).powi(2);
        divide(aim, [by_sampling, by_noise], interpolation)
    };
    let a = f64::from(A) * (for_interpolation / interpolation).powf(0.25);
    let a = stepped(if a.is_nan() { A_RANGE.1 } else { a.clamp(A_RANGE.0, A_RANGE.1) });
    let (samples, rays) = (sampling / for_sampling, stepped(noise / for_noise));
    let errors = Errors {
        sampling: for_sampling.sqrt(),
        noise: if for_noise.is_finite() { for_noise.sqrt() } else { 0.0 },
        interpolation: interpolation.sqrt() * (a / f64::from(A)).powi(2),
    };
    let positive = |effort: f64| (effort as f32).clamp(f32::MIN_POSITIVE, f32::MAX);
    // The rays an average gather will trace.
    let average = rays * seen.noise * f64::from(few).sqrt() * RECORDS_AT_ONCE;
    let least_rays = ((average / LEAST) as u32).clamp(LEAST_RANGE.0, LEAST_RANGE.1).next_power_of_two();
    let effort = Effort { rays: positive(rays), least_rays, samples: positive(samples) };
    let chosen = Settings { a: a as f32, rays: RAYS_MOST, spp: SPP_MOST, effort: Some(effort), ..asked };
    let forecast = Forecast { radiance: seen.radiance, errors, counts: seen.counts };
    (frame.with(chosen), forecast)
}

/// Shares a mean square among sampling, noise and interpolation so that it costs the fewest rays.
///
/// `costs` are the rays that bring sampling and noise to 1, in inverse proportion; `interpolation` is the mean square at
/// the pilot's a: its root falls as the number of records grows, each of which needs its rays.
fn divide(aim: f64, costs: [f64; 2], interpolation: f64) -> [f64; 3] {
    // More than the greatest a errs by cannot be had.
    let most = interpolation * (A_RANGE.1 / f64::from(A)).powi(4);
    let shares = |k: u32| {
        let noise = aim * f64::from(k) / f64::from(STEPS + 1);
        // Where the derivatives of the cost agree.
        let between = (noise * 0.5).min(most);
        [aim - noise - between, noise, between]
    };
    let cost = |[sampling, noise, between]: [f64; 3]| {
        let records = if between > 0.0 { (interpolation / between).sqrt() } else { 1.0 };
        costs[0] / sampling + costs[1] * records.max(0.1) / noise
    };
    let possible = (1..=STEPS).map(shares).filter(|shares| shares[0] > 0.0);
    possible.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(SHARES.map(|share| share * aim))
}

/// The nearest power of the root of 2: views of one scene that look much the same choose the same, and share records.
fn stepped(value: f64) -> f64 {
    if value > 0.0 && value.is_finite() { 2f64.powf((value.log2() * 2.0).round() / 2.0) } else { value }
}

/// Means over the pilot's pixels; radiance in W/(sr m²).
#[derive(Default)]
struct Seen {
    radiance: f64,
    /// Standard deviation of one sample.
    deviation: f64,
    /// Standard error that records bring.
    noise: f64,
    interpolation: Probed,
    rays_a_sample: f64,
    rays_of_fill: f64,
    counts: Counts,
}

/// Mean square of what interpolation is off by, (W/(sr m²))², as far as probes tell.
#[derive(Clone, Copy, Default)]
struct Probed {
    /// May be negative: it is what noise does not explain.
    mean: f64,
    /// Variance of that mean.
    variance: f64,
}

impl Probed {
    fn of(squares: &[f64]) -> Self {
        // One alone does not show how far it is off.
        if squares.len() < 2 {
            return Self { mean: 0.0, variance: f64::INFINITY };
        }
        let n = squares.len() as f64;
        let mean = squares.iter().sum::<f64>() / n;
        let variance = squares.iter().map(|square| (square - mean).powi(2)).sum::<f64>() / (n * (n - 1.0));
        Self { mean, variance }
    }

    /// The same of a picture of so many pixels, whose records lie nearer each other than those of the pilot's few. Fitted to
    /// probes of cornell, stairs, glossy-floor and sphere-plane filled at 128², 256² and 512².
    fn filled(self, pixels: u64) -> Self {
        let looked_at = f64::from(PIXELS) / pixels.clamp(PIXELS.into(), PIXELS_TESTED) as f64;
        let left = looked_at.powf(0.25);
        Self { mean: self.mean * left, variance: self.variance * left * left }
    }

    /// The mean between what was seen and what is `usual`, the root of a mean square known to about itself, each weighed by how
    /// well it is known: few rays say nothing of what lies below their noise.
    fn believed(self, usual: f64) -> f64 {
        let usual = usual * usual;
        let known = usual * usual / (usual * usual + self.variance).max(f64::MIN_POSITIVE);
        (usual + (self.mean - usual) * known).max(0.0)
    }
}

fn look(frame: &Frame) -> Seen {
    let settings = frame.settings();
    let ranks = (u64::from(RANKS) * u64::from(PIXELS) / settings.size().max(1)).clamp(1, RANKS.into()) as u32;
    let solo::Filled { levels, counts: filling, .. } = solo::fill_ranks(frame, Order::Rounds, ranks);
    let rays = |counts: &Counts| (counts.path_rays + counts.shadow_rays) as f64;
    let mut seen = Seen { rays_of_fill: rays(&filling), ..Seen::default() };
    let tracer = frame.looking(&levels);
    let pixels = || (0..settings.height).flat_map(|y| (0..settings.width).map(move |x| [x, y]));
    // Where a sample finds no record it goes on as a path and scatters far more than it will in the whole picture.
    let mut covered = Counts::default();
    for [x, y] in pixels().filter(|[x, y]| rank(*x, *y) < ranks) {
        let (mut pixel, mut counts) = (Pixel::new(settings, x, y), Counts::default());
        pixel.sample(0..SPP, &tracer, settings, &mut counts);
        counts.finish(&pixel);
        seen.counts.add(&counts);
        if counts.misses == 0 {
            covered.add(&counts);
        }
    }
    let mean = |sum: f64, sums: &Sums| sum / sums.pixels.max(1) as f64;
    let (all, of) = (seen.counts.judged(), covered.judged());
    seen.rays_a_sample = (rays(&covered) + covered.queries as f64 * RAYS_A_QUERY) / covered.samples.max(1) as f64;
    seen.radiance = mean(all.radiance, &all);
    (seen.deviation, seen.noise) = (mean(of.deviation, &of), mean(of.noise, &of));
    seen.counts.add(&filling);
    if !levels.is_empty() {
        seen.interpolation = probe(frame, &levels, &mut seen.counts);
    }
    seen
}

/// Mean square by which interpolated radiance differs from gathered, less what noise of both explains.
fn probe(frame: &Frame, levels: &Levels, counts: &mut Counts) -> Probed {
    let settings = frame.settings();
    let mut random = Random::named("probe", &[settings.seed]);
    let mut place = |size: u32| ((random.uniform() * size as f32) as u32).min(size - 1);
    let (strata, bands) = (Strata::new(2 * settings.rays), Bands::new(2 * settings.rays));
    let gather = Gather {
        tracer: &frame.tracer(levels),
        namespace: frame.namespace(),
        seed: settings.seed,
        level: 1,
        strata: Rays::Fixed(&strata),
        bands: Rays::Fixed(&bands),
        details: &settings.details,
    };
    let mut squares = Vec::with_capacity(PROBES);
    for _ in 0..PROBES {
        // Another point of the pixel than the one records are made for.
        let candidate = frame.site(1, 1, place(settings.width), place(settings.height), counts);
        let Some((site, served)) = candidate else { continue };
        let Some(answer) = levels[0].ask(&site.query(), &served) else { continue };
        let mut alone = Level::new(settings.a, settings.details);
        alone.unite([&gather.record(gather.id(&site), &site, counts)]);
        let Some(truth) = alone.ask(&site.query(), &served) else { continue };
        let square = (truth.radiance - answer.radiance).length_squared() / 3.0;
        squares.push(f64::from(square - truth.noise * truth.noise - answer.noise * answer.noise));
    }
    Probed::of(&squares)
}

/// What was reached, as far as the finished picture itself can tell: sampling and noise are measured on all its pixels,
/// interpolation is the forecast's.
pub fn reached(counts: &Counts, forecast: &Forecast) -> Errors {
    let sums = counts.judged();
    let pixels = sums.pixels.max(1) as f64;
    let mean = (sums.radiance / pixels).max(f64::MIN_POSITIVE);
    Errors {
        sampling: (sums.sampling / pixels).sqrt() / mean,
        noise: (sums.noise_squared / pixels).sqrt() / mean,
        interpolation: forecast.errors.interpolation,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probes_are_believed_as_far_as_they_agree() {
        let usual = 0.01;
        let believed = |squares: &[f64]| Probed::of(squares).believed(usual).sqrt();
        assert_eq!((believed(&[]), believed(&[9.0])), (usual, usual));
        assert_eq!(believed(&[4e-4; 8]), 0.02);
        assert_eq!(believed(&[-4e-4; 8]), 0.0);
        // Of mean 4e-4, by chance as well.
        let scattered = believed(&[1.0, -0.9992]);
        assert!((scattered - usual).abs() < 1e-4, "{scattered}");
    }

    #[test]
    fn a_large_picture_errs_less_between_its_records_than_the_pilot() {
        let seen = Probed { mean: 16.0, variance: 256.0 };
        let filled = |pixels| (seen.filled(pixels).mean, seen.filled(pixels).variance);
        assert_eq!((filled(100), filled(u64::from(PIXELS))), ((16.0, 256.0), (16.0, 256.0)));
        assert_eq!(filled(16 * u64::from(PIXELS)), (8.0, 64.0));
        assert_eq!(filled(1 << 30), filled(PIXELS_TESTED));
    }
}
