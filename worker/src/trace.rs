//! The second door: what a ray sees where it lands. Light emitted there, light from lamps, and indirect light: answered
//! by the sealed records of that depth where they cover the point, else by following the path.
//!
//! Path tracing is this door without records: next-event estimation with multiple importance sampling (power heuristic,
//! Veach 1997) and Russian roulette. It is unbiased and every method is measured against it.
//!
//! Depth counts surfaces from the camera: at depth 1 reflected light is direct light, at depth d its d - 1st bounce.

use std::f32::consts::FRAC_1_PI;

use cache_core::Query;
use cache_core::hemisphere::{Cells, Sample, Strata, irradiance};
use cache_core::id::Random;
use glam::{Vec2, Vec3};

use crate::bsdf::{Bsdf, Part};
use crate::frame::Counts;
use crate::gather::Site;
use crate::levels::{Levels, Reflected};
use crate::lights::{Lights, Place};
use crate::lobes::{Lobes, Served};
use crate::math::Frame;
use crate::sampler::Sampler;
use crate::scene::Rgb;
use crate::world::{Meeting, World};

/// Paths shorter than this many surfaces are never ended by Russian roulette.
const SURE_DEPTH: u32 = 3;

/// Chance at most with which Russian roulette lets a path go on: every path ends.
const SURVIVAL_MAX: f32 = 0.95;

/// Shadow rays that tell how much light there is at a point.
const DIRECT_LOOKS: u32 = 4;

/// All a ray needs to know.
pub struct Tracer<'a> {
    /// What there is to meet.
    pub world: &'a World,
    /// What there is to look for.
    pub lights: &'a Lights,
    /// Which surfaces records of radiance serve.
    pub lobes: &'a Lobes,
    /// The sealed records; empty for the path tracer.
    pub levels: &'a Levels,
    /// Indirect bounces to follow.
    pub bounces: u32,
    /// Whether diffuse light may be left to records: then beyond the last bounce there is none to look for by chance.
    pub cached: bool,
    /// Shadow rays of each point the camera sees: what else it takes to find such a point is paid once for all of them.
    pub looks: u32,
    /// Where no record covers what the camera sees, gather there and then with these cells; `None`: follow the path.
    pub regather: Option<&'a Strata>,
}

/// What light a ray may bring back from lamps it meets by chance.
#[derive(Clone, Copy, Debug)]
pub enum Chance {
    /// All: nobody looks for lamps where the ray comes from (camera, mirror).
    All,
    /// Only light that is gathered: the ray's origin has looked for the rest (gathers).
    Gathered,
    /// Gathered light wholly, sampled light by the power heuristic against the density of the ray.
    Weighed {
        /// Density of the ray by solid angle, 1/sr.
        density: f32,
        /// Where lamps were looked for: their chances there count, not those where the ray starts, just off the surface.
        from: Place,
        /// Whether the ray is for sampled light alone: records have told all the rest.
        alone: bool,
    },
}

/// What a ray brought back. Radiance in W/(sr m²).
#[derive(Clone, Copy, Debug, Default)]
pub struct Seen {
    /// Light without bounce.
    pub direct: Rgb,
    /// Light with at least one bounce, and gathered light.
    pub indirect: Rgb,
    /// Of the direct light, what shines straight into the ray.
    pub emission: Rgb,
    /// Irradiance records gave at the first surface, W/m².
    pub irradiance: Rgb,
    /// How many records gave it.
    pub records: u32,
    /// Standard error of the radiance for the noise of the records, root mean square over the channels.
    pub noise: f32,
    /// Distance of the first surface; infinite for none.
    pub distance: f32,
}

impl<'a> Tracer<'a> {
    /// Follows a ray whose first surface has depth `first`.
    pub fn see(
        &self,
        ray: (Vec3, Vec3),
        first: u32,
        chance: Chance,
        sampler: &mut Sampler,
        counts: &mut Counts,
    ) -> Seen {
        self.follow(ray, first, chance, None, sampler, counts)
    }

    /// Follows a ray from the camera where others have asked what records tell of its first surface, as [`Self::look`] found it.
    pub fn see_told(
        &self,
        ray: (Vec3, Vec3),
        told: Option<Reflected>,
        sampler: &mut Sampler,
        counts: &mut Counts,
    ) -> Seen {
        self.follow(ray, 1, Chance::All, Some(told), sampler, counts)
    }

    /// Where the first surface along a ray from the camera asks records, and which; `None`: nowhere.
    pub fn look(&self, (origin, direction): (Vec3, Vec3), counts: &mut Counts) -> Option<(Query, Served<'a>)> {
        counts.path_rays += 1;
        let at = self.world.meet(origin, direction)?;
        let bsdf = self.world.bsdf(&at)?;
        let served = self.served(&at, &bsdf, at.frame.to_local(-direction), 1)?;
        Some((at.query(), served))
    }

    fn follow(
        &self,
        (mut origin, mut direction): (Vec3, Vec3),
        first: u32,
        mut chance: Chance,
        mut told: Option<Option<Reflected>>,
        sampler: &mut Sampler,
        counts: &mut Counts,
    ) -> Seen {
        let mut seen = Seen { distance: f32::INFINITY, ..Seen::default() };
        let mut throughput = Rgb::ONE;
        let mut depth = first;
        loop {
            counts.path_rays += 1;
            let meeting = self.world.meet(origin, direction);
            let emitted = match &meeting {
                Some(at) => self.emitted(at, direction, chance),
                None => self.beyond(direction, chance),
            };
            seen.add(throughput * emitted, depth <= first + 1 && first == 1);
            if depth == first {
                seen.emission = emitted;
            }
            if matches!(chance, Chance::Weighed { alone: true, .. }) {
                break;
            }
            let Some(at) = meeting else { break };
            if depth == first {
                seen.distance = at.distance;
            }
            if depth - 1 > self.bounces {
                break;
            }
            let Some(bsdf) = self.world.bsdf(&at) else { break };
            let outgoing = at.frame.to_local(-direction);
            let four = sampler.next4();
            let served = self.served(&at, &bsdf, outgoing, depth);
            let told = told.take();
            let answer = served.as_ref().and_then(|served| match told {
                Some(told) => {
                    counts.queries += 1;
                    told.or_else(|| self.missed(&at, served, depth, sampler, counts))
                }
                None => self.answer(&at, served, depth, sampler, counts),
            });
            let alone = answer.is_some() && matches!(served, Some(Served::Gloss(..)));
            let part = match answer {
                Some(answer) => {
                    seen.indirect += throughput * answer.radiance;
                    if depth == first {
                        (seen.irradiance, seen.records) = (answer.irradiance, answer.records);
                        seen.noise = answer.noise;
                    }
                    Part::Gloss
                }
                None => Part::All,
            };
            let mut lamps = self.lamps(&at, &bsdf, outgoing, part, [four[0], four[1], four[2]], counts);
            if depth == 1 && self.looks > 1 {
                for _ in 1..self.looks {
                    let [u, v, w, _] = sampler.next4();
                    lamps += self.lamps(&at, &bsdf, outgoing, part, [u, v, w], counts);
                }
                lamps /= self.looks as f32;
            }
            seen.add(throughput * lamps, depth == 1);
            let next = sampler.next4();
            let Some(scatter) = bsdf.sample(outgoing, part, [next[0], next[1], next[2]]) else { break };
            throughput *= scatter.weight;
            let incoming = at.frame.to_world(scatter.incoming).normalize();
            if incoming.dot(at.facet) <= 0.0 {
                break;
            }
            if depth >= SURE_DEPTH {
                let survival = throughput.abs().max_element().min(SURVIVAL_MAX);
                if next[3] >= survival {
                    break;
                }
                throughput /= survival;
            }
            chance = match scatter.pdf {
                density if density.is_finite() => Chance::Weighed { density, from: at.place(), alone },
                _ => Chance::All,
            };
            (origin, direction) = (at.leave(incoming), incoming);
            depth += 1;
        }
        seen
    }

    /// Which records serve a surface met at a depth; `None`: those of none.
    pub fn served(&self, at: &Meeting, bsdf: &Bsdf, outgoing: Vec3, depth: u32) -> Option<Served<'a>> {
        if !self.cached || !self.world.cached(at) {
            return None;
        }
        self.lobes.serve(self.world.material(at), bsdf, outgoing, depth)
    }

    /// Light a surface reflects as far as records, or a small gather in their place, can tell it; `None`: follow the path.
    fn answer(
        &self,
        at: &Meeting,
        served: &Served,
        depth: u32,
        sampler: &mut Sampler,
        counts: &mut Counts,
    ) -> Option<Reflected> {
        let Some(level) = self.levels.get(depth as usize - 1) else {
            // The last bounce reflects lamps, which shadow rays find, and gathered light: without any, nothing is left.
            let nothing_left = depth - 1 == self.bounces && !self.lights.any_gathered();
            return nothing_left.then(Reflected::default);
        };
        counts.queries += 1;
        level.ask(&at.query(), served).or_else(|| self.missed(at, served, depth, sampler, counts))
    }

    /// A small gather in the place of records that do not cover a point; `None`: follow the path.
    fn missed(
        &self,
        at: &Meeting,
        served: &Served,
        depth: u32,
        sampler: &mut Sampler,
        counts: &mut Counts,
    ) -> Option<Reflected> {
        counts.misses += 1;
        let Served::Diffuse(albedo) = served else { return None };
        counts.regathers += u64::from(self.regather.is_some());
        self.regather.map(|strata| {
            // Only what the camera sees is worth a gather of its own: its rays follow paths.
            let tracer = Tracer { regather: None, ..*self };
            let samples = tracer.hemisphere(at, at.frame, depth, strata, &mut sampler.branch(), counts);
            let irradiance = irradiance(&samples);
            Reflected { radiance: *albedo * irradiance * FRAC_1_PI, irradiance, ..Reflected::default() }
        })
    }

    /// What the rays of a gather bring back to a surface of `depth`, cell by cell of a hemisphere round `frame`.
    pub fn hemisphere(
        &self,
        at: &Meeting,
        frame: Frame,
        depth: u32,
        cells: &impl Cells,
        sampler: &mut Sampler,
        counts: &mut Counts,
    ) -> Vec<Sample> {
        let mut ray = |cell| {
            let [u, v, ..] = sampler.next4();
            let local = cells.direction(cell, Vec2::new(u, v));
            let direction = frame.to_world(local).normalize();
            if direction.dot(at.facet) <= 0.0 {
                // Below the facet of a smooth surface: the surface hides itself, at no distance worth counting.
                return Sample { direction: local, radiance: Rgb::ZERO, distance: f32::INFINITY };
            }
            let seen = self.see((at.leave(direction), direction), depth + 1, Chance::Gathered, sampler, counts);
            // Nothing is so near that its inverse overflows.
            Sample { direction: local, radiance: seen.total(), distance: seen.distance.max(1e-30) }
        };
        (0..cells.rays()).map(&mut ray).collect()
    }

    /// Light without bounce that leaves a site for the camera, W/(sr m²).
    pub fn direct(&self, site: &Site, bsdf: &Bsdf, counts: &mut Counts) -> Rgb {
        let (at, p) = (&site.at, site.at.position);
        let mut random = Random::named("direct", &p.to_array().map(|v| v.to_bits().into()));
        let mut looks = || std::array::from_fn(|_| random.uniform());
        let lamps: Rgb = (0..DIRECT_LOOKS)
            .map(|_| self.lamps(at, bsdf, at.frame.to_local(-site.direction), Part::Gloss, looks(), counts))
            .sum();
        self.emitted(at, site.direction, Chance::All) + lamps / DIRECT_LOOKS as f32
    }

    /// Reflected light of one lamp looked for by a shadow ray. `part` is what will be followed by chance as well.
    fn lamps(&self, at: &Meeting, bsdf: &Bsdf, outgoing: Vec3, part: Part, u: [f32; 3], counts: &mut Counts) -> Rgb {
        let Some(arrival) = self.lights.sample(self.world, &at.place(), u) else { return Rgb::ZERO };
        let incoming = at.frame.to_local(arrival.direction);
        if incoming.z <= 0.0 || arrival.direction.dot(at.facet) <= 0.0 {
            return Rgb::ZERO;
        }
        let (diffuse, gloss) = bsdf.eval(outgoing, incoming);
        let share = arrival.pdf.map_or(1.0, |pdf| heuristic(pdf, bsdf.pdf(outgoing, incoming, part)));
        let reflected = match part {
            Part::All => (diffuse + gloss) * share,
            Part::Gloss if bsdf.has_gloss() => diffuse + gloss * share,
            Part::Gloss => diffuse,
        };
        let light = reflected * arrival.weight * incoming.z;
        if light == Rgb::ZERO {
            return light;
        }
        counts.shadow_rays += 1;
        let start = at.leave(arrival.direction);
        let hidden = match arrival.end {
            Some(end) => self.world.hidden(start, end),
            None => self.world.shaded(start, arrival.direction),
        };
        if hidden { Rgb::ZERO } else { light }
    }

    fn emitted(&self, at: &Meeting, direction: Vec3, chance: Chance) -> Rgb {
        let emission = self.world.emission(at);
        if emission == Rgb::ZERO {
            return emission;
        }
        let sampled = self.lights.samples_triangle(at.triangle);
        match chance {
            Chance::All => emission,
            Chance::Gathered => {
                if sampled {
                    Rgb::ZERO
                } else {
                    emission
                }
            }
            Chance::Weighed { alone: true, .. } if !sampled => Rgb::ZERO,
            Chance::Weighed { density, from, .. } => {
                let looked = self.lights.pdf_triangle(self.world, at.triangle, &from, direction, at.distance);
                emission * heuristic(density, looked)
            }
        }
    }

    fn beyond(&self, direction: Vec3, chance: Chance) -> Rgb {
        self.lights
            .beyond(self.world, direction)
            .map(|(radiance, light)| match (chance, light) {
                (Chance::Weighed { density, from, .. }, Some(light)) => {
                    radiance * heuristic(density, self.lights.pdf_distant(&from, light))
                }
                (Chance::Gathered, Some(_)) | (Chance::Weighed { alone: true, .. }, None) => Rgb::ZERO,
                _ => radiance,
            })
            .sum()
    }
}

impl Seen {
    fn add(&mut self, light: Rgb, direct: bool) {
        if direct {
            self.direct += light;
        } else {
            self.indirect += light;
        }
    }

    /// All light.
    pub fn total(&self) -> Rgb {
        self.direct + self.indirect
    }
}

/// Power heuristic: share of a strategy of density `own` against one of density `other`.
fn heuristic(own: f32, other: f32) -> f32 {
    // By the ratio, so that squares cannot overflow.
    let ratio = other / own;
    1.0 / (1.0 + ratio * ratio)
}
