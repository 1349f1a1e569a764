//! A record is made: stratified rays from a site, each bringing back what it sees where it lands.

use std::f32::consts::SQRT_2;

use cache_core::details::Details;
use cache_core::hemisphere::{Cells, Estimated, Sample, Strata};
use cache_core::id::{Origin, Random};
use cache_core::incoming::Bands;
use cache_core::math::Frame;
use cache_core::mesh::turned;
use cache_core::{
    Irradiance, Namespace, Packed as _, Query, Radiance, Record, RecordId, of_order, radiance, radius_least,
};

use glam::{Vec2, Vec3};

use crate::frame::Counts;
use crate::sampler::Sampler;
use crate::trace::Tracer;
use crate::world::Meeting;

/// Greatest ratio of an ellipse's semi-axes.
const ELONGATION: f32 = 2.0;

/// Farthest the least R stretches what the gather met, times R: a record made in a gap of a tenth of a millimetre, where a ray
/// leaked into it, says nothing of the pixels beside it (course notes, "ray leaking").
const STRETCH: f32 = 16.0;

/// Where a record is wanted.
pub struct Site {
    /// The surface there.
    pub at: Meeting,
    /// Unit direction of the ray that met it.
    pub direction: Vec3,
    /// Least and greatest R of the record, world lengths.
    pub radius_bounds: (f32, f32),
    /// Order of the record of radiance that is wanted; `None`: one of irradiance.
    pub order: Option<usize>,
    /// Deviation of reflected radiance, W/(sr m²), per deviation of the record.
    pub gain: f32,
}

/// How many rays a gather traces.
pub enum Rays<'a, C> {
    /// One for each of these cells.
    Fixed(&'a C),
    /// As many as their variance asks for: first those of the first cells, then those of others of the ladder.
    Varied {
        /// Cells, each set of twice as many as the one before.
        ladder: &'a [C],
        /// Rays per W/(sr m²) by which reflected radiance would deviate with one ray.
        per_deviation: f32,
    },
}

impl Site {
    /// What a sealed cache is asked there.
    pub fn query(&self) -> Query {
        self.at.query()
    }
}

/// What a gather needs besides its site.
pub struct Gather<'a> {
    /// Traces its rays; reads the sealed levels below.
    pub tracer: &'a Tracer<'a>,
    /// Namespace of the record.
    pub namespace: &'a Namespace,
    /// The user's seed.
    pub seed: u64,
    /// Level of the record.
    pub level: u32,
    /// Cells of the hemisphere for irradiance.
    pub strata: Rays<'a, Strata>,
    /// The same for radiance.
    pub bands: Rays<'a, Bands>,
    /// What its samples become.
    pub details: &'a Details,
}

impl Gather<'_> {
    /// Which record belongs to a site.
    pub fn id(&self, site: &Site) -> RecordId {
        let (position, normal) = (site.at.position, site.at.normal());
        let (radius_min, radius_max) = site.radius_bounds;
        let read = self.tracer.levels.get(self.level as usize).map(|l| l.digest()).unwrap_or_default();
        let key = [position.x, position.y, position.z, normal.x, normal.y, normal.z, radius_min, radius_max];
        let origin = Origin {
            namespace: self.namespace,
            kind: site.order.map_or(Irradiance::KIND, radiance::kind),
            level: self.level,
            site: &key,
            seed: self.seed,
            read,
        };
        origin.id()
    }

    /// Makes the record `id` of a site: the same record, bit for bit, whoever makes it and when.
    pub fn record(&self, id: RecordId, site: &Site, counts: &mut Counts) -> Record {
        match site.order {
            None => self.irradiance(id, site, counts).into(),
            Some(order) => {
                of_order!(order, N => self.radiance::<N>(id, site, counts).into()).expect("there are records of it")
            }
        }
    }

    /// Makes a record of irradiance.
    fn irradiance(&self, id: RecordId, site: &Site, counts: &mut Counts) -> Irradiance {
        let sum = |strata: &Strata, samples: &[Sample]| strata.estimate(samples, self.details);
        let (estimate, frame) = self.estimate(id, site, &self.strata, sum, counts);
        let (radius, radius_min) = self.radius(site, estimate.radius);
        let own = |v: Vec2| site.at.frame.tangential(frame.x * v.x + frame.y * v.y);
        let ellipse = turned(estimate.ellipse, back(site, frame));
        Irradiance {
            id,
            position: site.at.position,
            normal: site.at.normal(),
            radius,
            radius_min,
            radius_max: site.radius_bounds.1,
            // A coat's share is negative: by noise a dark sum can be, too.
            irradiance: estimate.irradiance.max(Vec3::ZERO),
            gradient_t: estimate.gradient_t.map(own),
            gradient_r: estimate.gradient_r.map(own),
            ellipse: limited(ellipse, site.radius_bounds.0),
            noise: estimate.noise,
        }
    }

    /// Makes a record of radiance.
    fn radiance<const N: usize>(&self, id: RecordId, site: &Site, counts: &mut Counts) -> Radiance<N> {
        let sum = |bands: &Bands, samples: &[Sample]| bands.estimate::<N>(samples, self.details);
        let (estimate, frame) = self.estimate(id, site, &self.bands, sum, counts);
        let (radius, radius_min) = self.radius(site, estimate.radius);
        let estimate = estimate.turned(back(site, frame));
        Radiance {
            id,
            position: site.at.position,
            normal: site.at.normal(),
            radius,
            radius_min,
            radius_max: site.radius_bounds.1,
            ellipse: limited(estimate.ellipse, site.radius_bounds.0),
            noise: estimate.noise,
            coefficients: estimate.coefficients,
            gradient: estimate.gradient,
        }
    }

    /// Gathers at a site, as often as its rays ask for; in which frame.
    fn estimate<C: Cells, E: Estimated>(
        &self,
        id: RecordId,
        site: &Site,
        rays: &Rays<C>,
        sum: impl Fn(&C, &[Sample]) -> E,
        counts: &mut Counts,
    ) -> (E, Frame) {
        let mut random = Random::of(id);
        // A turn of the cells about the normal, so that neighbouring records do not err alike.
        let frame = spun(site.at.frame, random.uniform());
        let mut sampler = Sampler::Stream(random);
        let mut gather =
            |cells: &C| sum(cells, &self.tracer.hemisphere(&site.at, frame, self.level, cells, &mut sampler, counts));
        let estimate = match *rays {
            Rays::Fixed(cells) => gather(cells),
            Rays::Varied { ladder, per_deviation } => {
                let first = gather(&ladder[0]);
                let have = ladder[0].rays() as f32;
                let deviation = first.noise() * have.sqrt() * site.gain;
                match ladder.iter().rev().find(|c| c.rays() as f32 <= per_deviation * deviation * SQRT_2) {
                    Some(cells) => gather(cells).united(cells.rays() as f32, &first, have),
                    None => first,
                }
            }
        };
        (estimate, frame)
    }

    /// R of a record, and the least it counts with.
    fn radius(&self, site: &Site, met: f32) -> (f32, f32) {
        // In a crack rays end at no distance at all: the record is for its own site alone.
        let least = 2.0 * radius_least(site.at.position, site.radius_bounds.1);
        let radius = met.min(4.0 * self.tracer.world.radius).max(least);
        (radius, site.radius_bounds.0.min(STRETCH * radius))
    }
}

/// The ellipse with no semi-axis shorter than `least`, and none longer than [`ELONGATION`] times the other; none at all where
/// it says nothing.
fn limited(ellipse: [f32; 3], least: f32) -> [f32; 3] {
    // In units of the least semi-axis, so that squares fit a float whatever the unit of length.
    let [xx, xy, yy] = ellipse.map(|m| m * least * least);
    if xx + yy == 0.0 || !(xx + yy).is_finite() {
        return [0.0; 3];
    }
    let (middle, half) = ((xx + yy) * 0.5, (xx - yy) * 0.5);
    let spread = (half * half + xy * xy).sqrt();
    // Eigenvalues: squared reciprocals of the minor and the major semi-axis.
    let (minor, major) = (middle + spread, middle - spread);
    let bounded = minor.min(1.0);
    let bounds = (bounded, major.max(bounded / (ELONGATION * ELONGATION)).min(bounded));
    let (middle, scale) =
        ((bounds.0 + bounds.1) * 0.5, if spread > 0.0 { (bounds.0 - bounds.1) * 0.5 / spread } else { 0.0 });
    [middle + half * scale, xy * scale, middle - half * scale].map(|m| m / least / least)
}

/// The turn from a gather's frame back to that of its site, (cosine, sine).
fn back(site: &Site, frame: Frame) -> Vec2 {
    site.at.frame.tangential(frame.x) * Vec2::new(1.0, -1.0)
}

/// The frame turned about its normal by a fraction of a full turn.
fn spun(frame: Frame, fraction: f32) -> Frame {
    let (s, c) = cache_core::math::sin_cos(fraction * std::f32::consts::TAU);
    Frame { x: frame.x * c + frame.y * s, y: frame.y * c - frame.x * s, z: frame.z }
}

#[cfg(test)]
mod tests {
    use glam::Vec2;

    use super::*;
    use crate::frame::Frame as Picture;
    use crate::scene::{Camera, Material, Rgb, Scene, Triangle};
    use crate::settings::Settings;

    /// The record of a floor at the origin under a plate at this height; with `met` as if its rays had met something there.
    fn under_a_plate(height: f32, met: Option<f32>) -> Irradiance {
        let material = Material { emission: Rgb::ONE, ..Material::diffuse(Rgb::splat(0.5)) };
        let level = |y: f32| Triangle {
            positions: [Vec3::new(-9.0, y, -9.0), Vec3::new(0.0, y, 9.0), Vec3::new(9.0, y, -9.0)],
            normals: None,
            uvs: [Vec2::ZERO; 3],
            material: 0,
        };
        let scene = Scene { triangles: vec![level(0.0), level(height)], materials: vec![material], ..Scene::default() };
        let camera = Camera::look(Vec3::Y * height * 0.5, Vec3::NEG_Y, Vec3::X, 1.0, 1.0, false).expect("view");
        let picture = Picture::new(scene, Settings { rays: 64, ..Settings::new(camera, 8, 8) });
        let (levels, mut counts) = (Vec::new(), Counts::default());
        let site = picture.site(1, 0, 4, 4, &mut counts).expect("the floor");
        let site = Site { radius_bounds: (0.05, 0.4), ..site.0 };
        let strata = Strata::new(64);
        let gather = Gather {
            tracer: &picture.tracer(&levels),
            namespace: picture.namespace(),
            seed: 0,
            level: 1,
            strata: Rays::Fixed(&strata),
            bands: Rays::Fixed(&Bands::new(64)),
            details: &picture.settings().details,
        };
        let record = gather.irradiance(gather.id(&site), &site, &mut counts);
        let (radius, radius_min) = gather.radius(&site, met.unwrap_or(record.radius));
        Irradiance { radius, radius_min, ..record }
    }

    #[test]
    fn a_record_in_a_gap_says_nothing_of_what_lies_beside_it() {
        let gap = under_a_plate(1e-4, None);
        assert!(gap.radius < 1e-3 && gap.radius_min < 16e-3, "{gap:?}");
        assert_eq!(under_a_plate(1.0, None).radius_min, 0.05);
    }

    #[test]
    fn a_record_in_a_crack_is_sound() {
        // As on the edge of a step, in a picture of 256 x 256 of the stairs.
        assert_eq!(under_a_plate(1.0, Some(4e-12)).check(), Ok(()));
    }
}
