//! One pixel as its samples come in: sums of all layers, and how much the samples scatter.

use std::ops::Range;

use cache_core::Rgb;
use cache_core::id::Random;
use glam::Vec3;

use crate::frame::{CHANNELS, Counts};
use crate::levels::Reflected;
use crate::sampler::Sampler;
use crate::settings::Settings;
use crate::splat::Look;
use crate::trace::{Chance, Seen, Tracer};

/// What Sobol points leave of the variance that as many random points would have, four of them; more leave less. Fitted to
/// the errors met with 4 to 64 samples on cornell, stairs and glossy-floor.
pub const SPREAD: f64 = 0.45;

/// A pixel being sampled.
pub struct Pixel {
    x: u32,
    y: u32,
    seed: u32,
    /// Sums of the layers, as [`CHANNELS`] says.
    pub sum: [f32; CHANNELS],
    reflected: Rgb,
    squares: Rgb,
    noise: f32,
    /// Samples so far.
    pub samples: u32,
    /// Whether one of them looks straight into light.
    pub sees_light: bool,
}

impl Pixel {
    /// No samples yet.
    pub fn new(settings: &Settings, x: u32, y: u32) -> Self {
        let seed = Random::named("pixel", &[settings.seed, x.into(), y.into()]).uniform();
        let seed = (seed * (1 << 24) as f32) as u32;
        Self {
            x,
            y,
            seed,
            sum: [0.0; CHANNELS],
            reflected: Rgb::ZERO,
            squares: Rgb::ZERO,
            sees_light: false,
            noise: 0.0,
            samples: 0,
        }
    }

    /// Takes samples of these numbers.
    pub fn sample(&mut self, numbers: Range<u32>, tracer: &Tracer, settings: &Settings, counts: &mut Counts) {
        for index in numbers {
            let (ray, mut sampler) = self.ray(index, settings);
            let seen = tracer.see(ray, 1, Chance::All, &mut sampler, counts);
            self.add(&seen);
        }
    }

    /// The ray of a sample, and the random numbers that are left.
    fn ray(&self, index: u32, settings: &Settings) -> ((Vec3, Vec3), Sampler) {
        let mut sampler = Sampler::pixel(index, self.seed);
        let [u, v, ..] = sampler.next4();
        (settings.ray(self.x as f32 + u, self.y as f32 + v), sampler)
    }

    /// Where a sample asks records, and which; `None`: nowhere.
    pub fn look<'a>(
        &self,
        index: u32,
        tracer: &'a Tracer,
        settings: &Settings,
        counts: &mut Counts,
    ) -> Option<Look<'a>> {
        let (query, served) = tracer.look(self.ray(index, settings).0, counts)?;
        Some(Look { pixel: [self.x, self.y], query, served })
    }

    /// Takes the sample of a number whose [`Self::look`] was answered elsewhere.
    pub fn sample_told(
        &mut self,
        index: u32,
        told: Option<Reflected>,
        tracer: &Tracer,
        settings: &Settings,
        counts: &mut Counts,
    ) {
        let (ray, mut sampler) = self.ray(index, settings);
        let seen = tracer.see_told(ray, told, &mut sampler, counts);
        self.add(&seen);
    }

    fn add(&mut self, seen: &Seen) {
        let total = seen.total();
        let layers = [total, seen.direct, seen.indirect, seen.irradiance];
        let floats = layers.iter().flat_map(|l| l.to_array()).chain([seen.records as f32]);
        self.sum.iter_mut().zip(floats).for_each(|(sum, value)| *sum += value);
        let reflected = total - seen.emission;
        self.reflected += reflected;
        self.squares += reflected * reflected;
        self.sees_light |= seen.emission != Rgb::ZERO;
        self.noise += seen.noise;
        self.samples += 1;
    }

    /// Mean radiance, W/(sr m²).
    pub fn mean(&self) -> Rgb {
        Rgb::from_slice(&self.sum) / self.samples as f32
    }

    /// Squared standard error of the reflected light, mean of the channels, (W/(sr m²))².
    pub fn squared_error(&self) -> f64 {
        let n = f64::from(self.samples.max(1));
        self.variance() / n * SPREAD * (4.0 / n).min(1.0).powf(0.25)
    }

    /// Standard error that records bring, W/(sr m²): its samples share their records, so more samples do not lessen it.
    pub fn record_deviation(&self) -> f64 {
        f64::from(self.noise / self.samples as f32)
    }

    /// Variance of the reflected light of one sample, mean of the channels, (W/(sr m²))². How an edge of a lamp is covered
    /// is another matter: no number of samples would do where it is a thousand times brighter than what it lights.
    pub fn variance(&self) -> f64 {
        let n = self.samples as f32;
        if n < 2.0 {
            return 0.0;
        }
        let mean = self.reflected / n;
        f64::from(((self.squares / n - mean * mean) * (n / (n - 1.0))).max(Rgb::ZERO).element_sum()) / 3.0
    }
}

/// Standard deviation of one sample of each pixel of a tile of `width` by `height`, W/(sr m²): few samples may agree by
/// chance where a shadow begins, so a pixel's neighbours, as far as they are in the tile, have a say.
pub fn deviations(pixels: &[Pixel], width: usize, height: usize) -> Vec<f32> {
    let variances: Vec<f64> = pixels.iter().map(Pixel::variance).collect();
    let around = |at: usize, end: usize| at.saturating_sub(1)..(at + 2).min(end);
    let of = |x: usize, y: usize| {
        let near = around(y, height).flat_map(|y| around(x, width).map(move |x| y * width + x));
        let (sum, count) = near.fold((0.0, 0), |(sum, count), i| (sum + variances[i], count + 1));
        (0.5 * (variances[y * width + x] + sum / f64::from(count))).sqrt() as f32
    };
    (0..pixels.len()).map(|i| of(i % width, i / width)).collect()
}
