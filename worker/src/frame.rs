//! One frame as a worker sees it: the scene ready to trace, and the two kinds of work it leases.

use std::ops::Range;

use cache_core::details::Spacing;
use cache_core::hemisphere::Strata;
use cache_core::id::Random;
use cache_core::incoming::Bands;
use cache_core::{Namespace, Query, Record, RecordId, rounds};
use glam::Vec3;

use crate::bsdf::Part;
use crate::gather::{Gather, Rays, Site};
use crate::levels::{Level, Levels};
use crate::lights::Lights;
use crate::lobes::{Lobes, Served};
use crate::pixel::{Pixel, deviations};
use crate::refine::Proposals;
use crate::sampler::Sampler;
use crate::scene::Scene;
use crate::settings::{Method, Settings};
use crate::splat::{Lost, Splat};
use crate::task::CpuClock;
use crate::trace::Tracer;
use crate::world::World;

/// Floats a pixel in a finished tile: beauty, direct, indirect, irradiance (RGB each), and how many records answered.
pub const CHANNELS: usize = 13;

/// Levels of records worth filling; deeper light continues as paths.
const LEVELS_MAX: u32 = 3;

/// Reach a record has at least, as a fraction of the picture's height projected at its site: level 1, deeper levels. A
/// larger picture shows the same light with more pixels, it needs few more records.
const REACH_MIN_HEIGHT: [f32; 2] = [1.0 / 128.0, 1.0 / 40.0];

/// The same in pixels, for small pictures (course slides: 1.5 to 3).
const REACH_MIN_PIXELS: [f32; 2] = [1.5, 4.0];

/// The same as a fraction of the scene's radius.
const REACH_MIN_WORLD: [f32; 2] = [1.0 / 150.0, 1.0 / 50.0];

/// Greatest over least reach (course slides: Tabellion and Lamorlette 2004 about 7). 32 makes hardly fewer records and
/// nearly doubles the worst block of the stairs.
const REACH_RATIO: f32 = 8.0;

/// Rays of a deeper level's gather, as a fraction: its error is averaged over many rays of the level above.
const DEEPER_RAYS: f32 = 0.5;

/// The same for gathers that trace as many rays as light varies.
const DEEPER_EFFORT: f32 = 0.25;

/// From which part of a pass on a tile may show that records do not pay there.
const DENSE_FROM: f32 = 0.5;

/// From how many candidates of a tile in one round.
const DENSE_TESTED: usize = 8;

/// Shadow rays of each sample of a pixel, where samples are as many as light varies.
const LOOKS: u32 = 4;

/// Samples by which a pixel finds out.
const FIRST_SAMPLES: u32 = 4;

/// Rays gathered for a sample of a pixel that no record covers, as a fraction of the least of a record, or of a quarter of those
/// that are the same everywhere: its pixel's other samples share the error.
const MISSED_RAYS: f32 = 0.25;

/// No records.
static NONE: Levels = Levels::new();

/// What was counted while working, for the statistics.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Counts {
    /// Rays that look for surfaces, of pixels, gathers and their paths.
    pub path_rays: u64,
    /// Rays that only ask whether a light is hidden.
    pub shadow_rays: u64,
    /// Points that wanted an answer from the cache.
    pub queries: u64,
    /// Those that found no record and went on as paths.
    pub misses: u64,
    /// Of the misses, samples of pixels that gathered for themselves.
    pub regathers: u64,
    /// Candidates left uncovered because records would have been as dense as pixels.
    pub dense: u64,
    /// Records that were found and not gathered again.
    pub reused: u64,
    /// Samples of finished pixels.
    pub samples: u64,
    /// Of these, those of pixels that a device interpolated.
    pub splatted: u64,
    /// Devices that were lost in the middle of that.
    pub devices_lost: u64,
    /// What finished pixels that see surfaces alone add up to.
    pub surfaces: Sums,
    /// What the others add up to, which look straight into light.
    pub lights: Sums,
    /// CPU seconds of candidates' tests: whether records cover them, and what shows that records should shrink.
    pub test_seconds: f64,
}

/// What pixels add up to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sums {
    /// How many.
    pub pixels: u64,
    /// Radiance, mean of the channels, W/(sr m²).
    pub radiance: f64,
    /// Standard deviation of one sample, W/(sr m²).
    pub deviation: f64,
    /// Squared standard error, as far as samples tell; mean of the channels, (W/(sr m²))².
    pub sampling: f64,
    /// Standard error that records bring, root mean square over the channels, W/(sr m²).
    pub noise: f64,
    /// The same squared.
    pub noise_squared: f64,
}

impl Sums {
    /// Adds what was summed elsewhere.
    pub fn add(&mut self, other: &Self) {
        self.pixels += other.pixels;
        self.radiance += other.radiance;
        self.deviation += other.deviation;
        self.sampling += other.sampling;
        self.noise += other.noise;
        self.noise_squared += other.noise_squared;
    }
}

impl Counts {
    /// Adds what was counted elsewhere.
    pub fn add(&mut self, other: &Self) {
        self.path_rays += other.path_rays;
        self.shadow_rays += other.shadow_rays;
        self.queries += other.queries;
        self.misses += other.misses;
        self.regathers += other.regathers;
        self.dense += other.dense;
        self.reused += other.reused;
        self.samples += other.samples;
        self.splatted += other.splatted;
        self.devices_lost += other.devices_lost;
        self.surfaces.add(&other.surfaces);
        self.lights.add(&other.lights);
        self.test_seconds += other.test_seconds;
    }

    /// Counts a finished pixel.
    pub fn finish(&mut self, pixel: &Pixel) {
        let (variance, noise) = (pixel.variance(), pixel.record_deviation());
        self.samples += u64::from(pixel.samples);
        let sums = if pixel.sees_light { &mut self.lights } else { &mut self.surfaces };
        sums.add(&Sums {
            pixels: 1,
            radiance: f64::from(pixel.mean().element_sum()) / 3.0,
            deviation: variance.sqrt(),
            sampling: pixel.squared_error(),
            noise,
            noise_squared: noise * noise,
        });
    }

    /// What counts in an error: pixels that see surfaces; all, where more than one in twenty looks into light.
    pub fn judged(&self) -> Sums {
        let mut sums = self.surfaces;
        if self.lights.pixels * 20 > self.surfaces.pixels + self.lights.pixels {
            sums.add(&self.lights);
        }
        sums
    }
}

/// A scene ready to be rendered with certain settings.
pub struct Frame {
    world: World,
    lights: Lights,
    lobes: Lobes,
    settings: Settings,
    namespace: Namespace,
    /// Cells of a gather of irradiance at level 1, at deeper ones, and for a sample of a pixel that no record covers.
    strata: [Strata; 3],
    /// Cells of gathers of irradiance that trace as many rays as light varies.
    ladder: Vec<Strata>,
    /// The same for radiance, at level 1.
    bands: Vec<Bands>,
}

impl Frame {
    /// Builds what rendering needs.
    pub fn new(scene: Scene, settings: Settings) -> Self {
        let lobes = Lobes::new(&scene.materials, settings.method, settings.details.order);
        Self::of(World::new(scene), lobes, settings)
    }

    fn of(world: World, lobes: Lobes, settings: Settings) -> Self {
        let namespace = settings.namespace(&world.scene.hash);
        let lights = Lights::new(&world, settings.method != Method::Path);
        let missed = settings.effort.map_or(settings.rays / 4, |effort| effort.least_rays);
        let share = |of: u32, part: f32| Strata::new((of as f32 * part) as u32);
        let strata = [share(settings.rays, 1.0), share(settings.rays, DEEPER_RAYS), share(missed, MISSED_RAYS)];
        let rungs: Vec<_> = settings.effort.map_or_else(Vec::new, |effort| {
            let rungs = std::iter::successors(Some(effort.least_rays), |rays| rays.checked_mul(2));
            rungs.take_while(|rays| *rays <= settings.rays.max(effort.least_rays)).collect()
        });
        let ladder = rungs.iter().copied().map(Strata::new).collect();
        let bands = if rungs.is_empty() { vec![settings.rays] } else { rungs }.into_iter().map(Bands::new).collect();
        Self { world, lights, lobes, settings, namespace, strata, ladder, bands }
    }

    /// The settings it was made with.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.world.scene
    }

    /// Where its records belong.
    pub fn namespace(&self) -> &Namespace {
        &self.namespace
    }

    /// Levels of records worth filling: one for each bounce and one for gathered light, as far as the method goes.
    pub fn levels(&self) -> u32 {
        let s = &self.settings;
        match s.method {
            Method::Path => 0,
            Method::Irradiance | Method::Radiance | Method::Auto => {
                s.bounces.saturating_add(self.lights.any_gathered().into()).min(LEVELS_MAX)
            }
        }
    }

    /// The same scene and method with other settings.
    pub fn with(self, settings: Settings) -> Self {
        Self::of(self.world, self.lobes, settings)
    }

    /// Tests the candidates of `tile` whose ranks lie in `ranks` and gathers a record of `level` where the sealed
    /// cache covers none, unless it is `known`; where it does, an adaptive frame proposes that records shrink which make
    /// visible steps. What comes of it depends on nothing but the frame, the other arguments and the sealed records.
    pub fn fill(
        &self,
        level: u32,
        pass: u32,
        ranks: Range<u32>,
        tile: u32,
        sealed: &Levels,
        known: &dyn Fn(RecordId) -> Option<Record>,
    ) -> (Vec<Record>, Counts) {
        let mut counts = Counts::default();
        let adaptive = self.settings.details.adaptive && level == 1;
        let own: Option<&Level> = sealed.get(level as usize - 1).filter(|own| !own.is_empty());
        let tracer = self.tracer(sealed);
        let (mut uncovered, mut proposals) = (Vec::new(), Proposals::default());
        let (clock, mut tested) = (CpuClock::start(), 0);
        for [x, y] in self.settings.pixels(tile).filter(|[x, y]| ranks.contains(&rounds::rank(*x, *y))) {
            let Some(site) = self.site(level, pass, x, y, &mut counts) else { continue };
            tested += 1;
            let (site, served) = site;
            let covered = match own {
                Some(own) if adaptive && rounds::refines(level, pass) => {
                    proposals.test(&tracer, &site, own, &served, &mut counts)
                }
                Some(own) => own.covers(&site.query(), &served),
                None => false,
            };
            if !covered {
                let first_a = own.filter(|_| adaptive).map(|own| own.first_a(&site.query(), &served));
                uncovered.push((site, first_a));
            }
        }
        counts.test_seconds += clock.seconds();
        // Where most candidates still want a record of their own, records would be as dense as pixels, which gather for
        // themselves when they are made. Of deeper levels there are few candidates anyway, all over the scene.
        let late = level == 1 && self.is_late(pass, ranks.start);
        if late && tested >= DENSE_TESTED && 2 * uncovered.len() > tested {
            counts.dense += uncovered.len() as u64;
            uncovered.clear();
        }
        // The level being filled is no business of its own gathers.
        let gather = self.gather(&tracer, level);
        let mut records = Vec::with_capacity(uncovered.len());
        for (site, first_a) in &uncovered {
            let id = gather.id(site);
            let found = known(id);
            counts.reused += u64::from(found.is_some());
            records.push(found.unwrap_or_else(|| gather.record(id, site, &mut counts)));
            if let Some(first_a) = first_a {
                proposals.begin(id, *first_a, self.settings.a);
            }
        }
        records.extend(proposals.take().map(Record::from));
        (records, counts)
    }

    /// Whether a round of level 1 comes so late that a picture worth caching is covered for the most part.
    fn is_late(&self, pass: u32, rank: u32) -> bool {
        let ranks = rounds::ranks(1, pass, self.settings.size());
        pass > 0 || (rank - ranks.start) as f32 >= DENSE_FROM * ranks.len() as f32
    }

    /// Makes records of a level.
    fn gather<'a>(&'a self, tracer: &'a Tracer<'a>, level: u32) -> Gather<'a> {
        let deeper = level > 1;
        let (strata, bands) = match self.settings.effort {
            None => (Rays::Fixed(&self.strata[usize::from(deeper)]), Rays::Fixed(&self.bands[0])),
            Some(effort) => {
                let per_deviation = effort.rays * if deeper { DEEPER_EFFORT } else { 1.0 };
                (
                    Rays::Varied { ladder: &self.ladder, per_deviation },
                    Rays::Varied { ladder: &self.bands, per_deviation },
                )
            }
        };
        let (namespace, seed, details) = (&self.namespace, self.settings.seed, &self.settings.details);
        Gather { tracer, namespace, seed, level, strata, bands, details }
    }

    pub(crate) fn tracer<'a>(&'a self, levels: &'a Levels) -> Tracer<'a> {
        let cached = self.settings.method != Method::Path;
        let bounces = self.settings.bounces;
        let (world, lights, lobes) = (&self.world, &self.lights, &self.lobes);
        Tracer { world, lights, lobes, levels, bounces, cached, looks: 1, regather: None }
    }

    /// Traces samples of pixels that are as many as light varies.
    pub(crate) fn looking<'a>(&'a self, levels: &'a Levels) -> Tracer<'a> {
        Tracer { looks: if self.lights.any_sampled() { LOOKS } else { 1 }, ..self.tracer(levels) }
    }

    /// The candidate of a pixel: the surface where a path through it has its `level`th meeting, and which records serve it.
    pub(crate) fn site(
        &self,
        level: u32,
        pass: u32,
        x: u32,
        y: u32,
        counts: &mut Counts,
    ) -> Option<(Site, Served<'_>)> {
        let s = &self.settings;
        let look = rounds::look(level, pass);
        let name = [s.seed, x.into(), y.into(), level.into(), look.into()];
        let mut sampler = Sampler::Stream(Random::named("walk", &name));
        // The first look is at the middle of each pixel, others elsewhere: what only edges see is found too.
        let within = if look == 0 { [0.5; 4] } else { sampler.next4() };
        let (mut origin, mut direction) = s.ray(x as f32 + within[0], y as f32 + within[1]);
        let mut way = 0.0;
        for depth in 1.. {
            counts.path_rays += 1;
            let at = self.world.meet(origin, direction)?;
            way += at.distance;
            let bsdf = self.world.bsdf(&at)?;
            if depth == level {
                if !self.world.cached(&at) {
                    return None;
                }
                let at = at.flattened();
                let outgoing = at.frame.to_local(-direction);
                let served = self.lobes.serve(self.world.material(&at), &bsdf, outgoing, level)?;
                let deeper = usize::from(level > 1);
                let pixels = (REACH_MIN_HEIGHT[deeper] * s.height as f32).max(REACH_MIN_PIXELS[deeper]);
                let reach = match s.details.spacing {
                    Spacing::Pixels => pixels * s.pixel_size(way),
                    Spacing::World => REACH_MIN_WORLD[deeper] * self.world.radius,
                    Spacing::Free => f32::MIN_POSITIVE,
                };
                // From far away, or with a tiny `a`, everything is nearer than that; floats round the site are farther apart
                // than pixels of a camera that sees next to nothing.
                let spacing = at.position.abs().max_element() * f32::EPSILON;
                let radius_min = (reach / s.a).min(4.0 * self.world.radius).max(spacing).max(f32::MIN_POSITIVE);
                let radius_max = match s.details.spacing {
                    Spacing::Pixels => radius_min * REACH_RATIO,
                    Spacing::World | Spacing::Free => 4.0 * self.world.radius,
                };
                let radius_bounds = (radius_min, radius_max.max(radius_min));
                let order = if let Served::Gloss(order, _) = served { Some(order) } else { None };
                return Some((Site { at, direction, radius_bounds, order, gain: served.gain() }, served));
            }
            let [a, b, c, _] = sampler.next4();
            let scatter = bsdf.sample(at.frame.to_local(-direction), Part::All, [a, b, c])?;
            direction = at.frame.to_world(scatter.incoming).normalize();
            if direction.dot(at.facet) <= 0.0 {
                return None;
            }
            origin = at.leave(direction);
        }
        None
    }

    /// The finished pixels of `tile`, row by row, [`CHANNELS`] floats each.
    pub fn pixels(&self, tile: u32, sealed: &Levels) -> (Vec<f32>, Counts) {
        let (mut counts, tracer) = (Counts::default(), self.finishing(sealed));
        let mut pixels: Vec<_> = self.settings.pixels(tile).map(|[x, y]| Pixel::new(&self.settings, x, y)).collect();
        let first = self.first_samples();
        pixels.iter_mut().for_each(|pixel| pixel.sample(0..first, &tracer, &self.settings, &mut counts));
        let wanted = self.wanted(tile, &pixels);
        for (pixel, wanted) in pixels.iter_mut().zip(wanted) {
            pixel.sample(first..wanted, &tracer, &self.settings, &mut counts);
        }
        pixels.iter().for_each(|pixel| counts.finish(pixel));
        (means(&pixels), counts)
    }

    /// The same of several tiles, one after another, where `splat` answers in place of the octree: all samples of one number at a
    /// time.
    ///
    /// # Errors
    /// Those of `splat`.
    pub fn splatted(
        &self,
        tiles: Range<u32>,
        sealed: &Levels,
        splat: &mut dyn Splat,
    ) -> Result<(Vec<Vec<f32>>, Counts), Lost> {
        self.told(&self.finishing(sealed), tiles, splat)
    }

    /// The same where what no record covers is followed as paths: pixels to look at while records come in.
    ///
    /// # Errors
    /// Those of `splat`.
    pub fn preview(&self, tiles: Range<u32>, splat: &mut dyn Splat) -> Result<Vec<Vec<f32>>, Lost> {
        Ok(self.told(&self.looking(&NONE), tiles, splat)?.0)
    }

    fn told(&self, tracer: &Tracer, tiles: Range<u32>, splat: &mut dyn Splat) -> Result<(Vec<Vec<f32>>, Counts), Lost> {
        let mut counts = Counts::default();
        let new = |tile| self.settings.pixels(tile).map(|[x, y]| Pixel::new(&self.settings, x, y)).collect();
        let mut done: Vec<Vec<Pixel>> = tiles.clone().map(new).collect();
        let first = self.first_samples();
        let mut wanted: Vec<u32> = done.iter().flatten().map(|_| first).collect();
        let mut index = 0;
        while index < wanted.iter().copied().max().unwrap_or(0) {
            let look = |(pixel, wanted): (&Pixel, &u32)| {
                if index < *wanted { pixel.look(index, tracer, &self.settings, &mut counts) } else { None }
            };
            let looks: Vec<_> = done.iter().flatten().zip(&wanted).map(look).collect();
            let mut answers = splat.answers(&mut looks.iter().flatten())?.into_iter();
            for ((pixel, wanted), look) in done.iter_mut().flatten().zip(&wanted).zip(&looks) {
                if index < *wanted {
                    let told = look.as_ref().and_then(|_| answers.next().flatten());
                    pixel.sample_told(index, told, tracer, &self.settings, &mut counts);
                }
            }
            index += 1;
            if index == first {
                wanted = tiles.clone().zip(&done).flat_map(|(tile, pixels)| self.wanted(tile, pixels)).collect();
            }
        }
        done.iter().flatten().for_each(|pixel| counts.finish(pixel));
        counts.splatted = counts.samples;
        Ok((done.iter().map(|pixels| means(pixels)).collect(), counts))
    }

    /// Where the first surface along a ray from the camera asks records, and which.
    pub fn look(&self, ray: (Vec3, Vec3), counts: &mut Counts) -> Option<(Query, Served<'_>)> {
        self.tracer(&NONE).look(ray, counts)
    }

    fn finishing<'a>(&'a self, sealed: &'a Levels) -> Tracer<'a> {
        let looking = if self.settings.effort.is_some() { self.looking(sealed) } else { self.tracer(sealed) };
        Tracer { regather: Some(&self.strata[2]), ..looking }
    }

    /// Samples every pixel of a picture has.
    fn first_samples(&self) -> u32 {
        let spp = self.settings.spp;
        if self.settings.effort.is_some() { FIRST_SAMPLES.min(spp) } else { spp }
    }

    /// How many samples each pixel of a tile should have, by what the first ones scatter.
    fn wanted(&self, tile: u32, pixels: &[Pixel]) -> Vec<u32> {
        let (first, spp) = (self.first_samples(), self.settings.spp);
        let Some(effort) = self.settings.effort else { return vec![spp; pixels.len()] };
        let [x0, x1, y0, y1] = self.settings.tile(tile);
        let deviations = deviations(pixels, (x1 - x0) as usize, (y1 - y0) as usize);
        let wanted = |deviation: f32| (deviation * effort.samples).clamp(first as f32, spp as f32) as u32;
        deviations.into_iter().map(wanted).collect()
    }
}

/// Means of finished pixels, [`CHANNELS`] floats each.
fn means(pixels: &[Pixel]) -> Vec<f32> {
    pixels.iter().flat_map(|p| p.sum.map(|s| s / p.samples as f32)).collect()
}
