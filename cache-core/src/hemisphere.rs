//! Stratified directions of a gather, and what their samples say: irradiance, both gradients, and R.
//!
//! The hemisphere is cut into M polar by N azimuthal cells of equal projected solid angle, N ≈ πM. Paper: Ward, Heckbert
//! 1992 (eqs. 2, 3), with the sign of the rotational gradient as finite differences demand: tilting the normal towards
//! a bright sample raises E.

use std::f32::consts::PI;

use glam::{Vec2, Vec3};

use crate::details::{Details, Distance, Gradients, Metric};
use crate::math::{Rgb, sin_cos};
use crate::mesh::{absolute, survey};

/// What one gather ray brought back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Where it went: unit, local, z along the normal.
    pub direction: Vec3,
    /// Incoming radiance, W/(sr m²).
    pub radiance: Rgb,
    /// Distance to what it hit, world length; infinite for nothing.
    pub distance: f32,
}

/// A hemisphere cut into cells, one ray through each.
pub trait Cells {
    /// How many rays a gather traces.
    fn rays(&self) -> usize;
    /// Local unit direction (z along the normal) of cell `index`, jittered by `u` in [0, 1)². Cells of one ring follow each
    /// other.
    fn direction(&self, index: usize, u: Vec2) -> Vec3;
}

/// What the samples of a gather say.
pub trait Estimated {
    /// Standard error of what is estimated, root mean square over the channels.
    fn noise(&self) -> f32;
    /// What two independent gathers at one site say together; `rays` is how many each of them traced. How far the record
    /// reaches is for this one to say, which should be the larger.
    fn united(self, rays: f32, other: &Self, others: f32) -> Self;
}

/// What a whole gather says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// E, W/m².
    pub irradiance: Rgb,
    /// ∇_t E, W/m³, per channel, in the local x and y.
    pub gradient_t: [Vec2; 3],
    /// ∇_r E, W/m² per radian, per channel: change when the normal turns about the local x and y.
    pub gradient_r: [Vec2; 3],
    /// Harmonic mean of the distances, or the least of them, limited by |E| / |∇_t E| (Krivanek 2006 eq. 2); world length, may
    /// be infinite.
    pub radius: f32,
    /// (xx, xy, yy) of M, 1/m²: at a distance d the second derivatives change E by (dᵀ M d) E. 0 where they were not asked for.
    pub ellipse: [f32; 3],
    /// Standard error of E, root mean square over the channels, W/m².
    pub noise: f32,
}

impl Estimated for Estimate {
    fn noise(&self) -> f32 {
        self.noise
    }

    fn united(self, rays: f32, other: &Self, others: f32) -> Self {
        let (own, theirs) = (rays / (rays + others), others / (rays + others));
        let both = |a: [Vec2; 3], b: [Vec2; 3]| std::array::from_fn(|c| a[c] * own + b[c] * theirs);
        Self {
            irradiance: self.irradiance * own + other.irradiance * theirs,
            gradient_t: both(self.gradient_t, other.gradient_t),
            gradient_r: both(self.gradient_r, other.gradient_r),
            noise: ((self.noise * own).powi(2) + (other.noise * theirs).powi(2)).sqrt(),
            ..self
        }
    }
}

/// The cells of a hemisphere, with the constants each brings to the sums.
#[derive(Clone, Debug)]
pub struct Strata {
    polar: usize,
    azimuthal: usize,
    rings: Vec<Ring>,
    sectors: Vec<Sector>,
}

/// One polar band, between θ_j- and θ_j+.
#[derive(Clone, Copy, Debug)]
struct Ring {
    /// sin θ_j- cos² θ_j- 2π / N: how fast the inner border sweeps projected solid angle.
    border: f32,
    /// sin θ_j+ - sin θ_j-: the same for the borders between sectors.
    side: f32,
    /// ∫ sin² θ dθ 2π / N: how fast the band gains when the normal tilts.
    tilt: f32,
}

/// One azimuthal sector: unit vectors in the tangent plane.
#[derive(Clone, Copy, Debug)]
struct Sector {
    /// u_k at the middle.
    middle: Vec2,
    /// v_k at the middle: a quarter turn on.
    turn: Vec2,
    /// v_k- at the lower border: a quarter turn on.
    border: Vec2,
}

impl Strata {
    /// Cells for at most `rays` rays (at least 4), N ≈ πM.
    pub fn new(rays: u32) -> Self {
        let rays = rays.max(4) as usize;
        let polar = ((rays as f32 / PI).sqrt() as usize).max(1);
        let azimuthal = rays / polar;
        let sector_angle = 2.0 * PI / azimuthal as f32;
        // sin²θ is uniform over the cells; ∫ sin² θ dθ = (θ - sin θ cos θ) / 2.
        let at = |j: usize| {
            let s2 = j as f32 / polar as f32;
            let (s, c) = (s2.sqrt(), (1.0 - s2).max(0.0).sqrt());
            (s, c, (libm::atan2f(s, c) - s * c) / 2.0)
        };
        let rings = (0..polar)
            .map(|j| {
                let ((s, c, low), (s_next, _, high)) = (at(j), at(j + 1));
                Ring { border: s * c * c * sector_angle, side: s_next - s, tilt: (high - low) * sector_angle }
            })
            .collect();
        let sectors = (0..azimuthal)
            .map(|k| {
                let (s, c) = sin_cos((k as f32 + 0.5) * sector_angle);
                let (s_border, c_border) = sin_cos(k as f32 * sector_angle);
                Sector { middle: Vec2::new(c, s), turn: Vec2::new(-s, c), border: Vec2::new(-s_border, c_border) }
            })
            .collect();
        Self { polar, azimuthal, rings, sectors }
    }

    /// Sums the samples of all cells, in cell order.
    ///
    /// # Panics
    /// If there are not exactly [`Self::rays`] samples.
    pub fn estimate(&self, samples: &[Sample], details: &Details) -> Estimate {
        assert_eq!(samples.len(), self.rays());
        let rays = self.rays() as f32;
        let irradiance = irradiance(samples);
        let mesh = (details.metric == Metric::Hessian || details.gradients == Gradients::Mesh)
            .then(|| survey(samples, self.polar, self.azimuthal));
        let mut gradient_t = match (details.gradients, &mesh) {
            (Gradients::None, _) => [Vec2::ZERO; 3],
            (Gradients::Mesh, Some(mesh)) => mesh.gradient,
            (Gradients::Samples, _) => self.by_samples(samples),
            _ => self.by_borders(samples),
        };
        let mut gradient_r = if details.rotation { self.rotation(samples) } else { [Vec2::ZERO; 3] };
        if !details.gradients_per_channel {
            for gradients in [&mut gradient_t, &mut gradient_r] {
                let relative = gradients.iter().sum::<Vec2>() / irradiance.element_sum().max(f32::MIN_POSITIVE);
                *gradients = std::array::from_fn(|c| relative * irradiance[c]);
            }
        }
        let distance = distance(samples, details.distance);
        let slope = gradient_t.iter().sum::<Vec2>().length();
        let by_gradient =
            if details.radius_by_gradient && slope > 0.0 { irradiance.element_sum() / slope } else { f32::INFINITY };
        let mean = irradiance.element_sum() * (1.0 / 3.0);
        let ellipse = match (details.metric, mesh) {
            (Metric::Hessian, Some(mesh)) if mean > 0.0 => absolute(mesh.hessian).map(|h| h / (2.0 * mean)),
            _ => [0.0; 3],
        };
        let noise = PI * variance(samples, self.azimuthal).sqrt() / rays.sqrt();
        Estimate { irradiance, gradient_t, gradient_r, radius: distance.min(by_gradient), ellipse, noise }
    }

    /// ∇_t E by Ward, Heckbert 1992 eq. 2.
    fn by_borders(&self, samples: &[Sample]) -> [Vec2; 3] {
        let mut sum = [Vec2::ZERO; 3];
        let n = self.azimuthal;
        for (j, ring) in self.rings.iter().enumerate() {
            for (k, sector) in self.sectors.iter().enumerate() {
                let here = &samples[j * n + k];
                if j > 0 {
                    let inner = &samples[(j - 1) * n + k];
                    move_border(&mut sum, sector.middle * ring.border, here, inner);
                }
                move_border(&mut sum, sector.border * ring.side, here, &samples[j * n + (k + n - 1) % n]);
            }
        }
        sum
    }

    /// ∇_t E by Krivanek et al. 2005b, section 3, "irradiance gradient".
    fn by_samples(&self, samples: &[Sample]) -> [Vec2; 3] {
        let mut sum = [Vec2::ZERO; 3];
        let n = self.azimuthal;
        for (j, ring) in self.rings.iter().enumerate() {
            let cosine = |j: usize| (1.0 - j as f32 / self.polar as f32).sqrt();
            for (k, sector) in self.sectors.iter().enumerate() {
                let here = &samples[j * n + k];
                let cos = here.direction.z;
                let sin = (1.0 - cos * cos).max(0.0).sqrt().max(1e-3);
                if j > 0 {
                    let inner = &samples[(j - 1) * n + k];
                    // sin θ_j- cos θ_j-, times the sample's own cosine.
                    let speed = ring.border / cosine(j) * cos;
                    move_border(&mut sum, sector.middle * speed, here, inner);
                }
                let speed = cos * (cosine(j) - cosine(j + 1)) / sin;
                move_border(&mut sum, sector.border * speed, here, &samples[j * n + (k + n - 1) % n]);
            }
        }
        sum
    }

    /// ∇_r E by Ward, Heckbert 1992 eq. 3, its sign as finite differences demand.
    fn rotation(&self, samples: &[Sample]) -> [Vec2; 3] {
        let mut sum = [Vec2::ZERO; 3];
        for (ring, row) in self.rings.iter().zip(samples.chunks_exact(self.azimuthal)) {
            for (sector, sample) in self.sectors.iter().zip(row) {
                let turn = sector.turn * ring.tilt;
                (0..3).for_each(|c| sum[c] += turn * sample.radiance[c]);
            }
        }
        sum
    }
}

impl Cells for Strata {
    fn rays(&self) -> usize {
        self.polar * self.azimuthal
    }

    fn direction(&self, index: usize, u: Vec2) -> Vec3 {
        let (j, k) = (index / self.azimuthal, index % self.azimuthal);
        let s2 = (j as f32 + u.x) / self.polar as f32;
        let (sin_phi, cos_phi) = sin_cos((k as f32 + u.y) * (2.0 * PI / self.azimuthal as f32));
        let s = s2.sqrt();
        Vec3::new(s * cos_phi, s * sin_phi, (1.0 - s2).max(0.0).sqrt())
    }
}

/// Variance of one sample about what its cell sees, mean of the channels, (W/(sr m²))². The samples come ring by ring,
/// `azimuthal` in each.
///
/// By second differences round each ring: what changes evenly from cell to cell is no noise. (The standard deviation of
/// every second ray, Krivanek 2006, sees even changes as noise too.)
pub(crate) fn variance(samples: &[Sample], azimuthal: usize) -> f32 {
    let n = azimuthal;
    let bend = |row: &[Sample], k: usize| {
        let [before, here, after] = [(k + n - 1) % n, k, (k + 1) % n].map(|k| row[k].radiance);
        (before - here * 2.0 + after).length_squared()
    };
    let rows = samples.chunks_exact(n);
    let sum: f32 = rows.map(|row| (0..n).map(|k| bend(row, k)).sum::<f32>()).sum();
    // A second difference of independent samples varies six times as much as one of them.
    sum / (6.0 * 3.0 * samples.len() as f32)
}

/// What is taken as the distance of all that the samples met, world length; may be infinite.
pub(crate) fn distance(samples: &[Sample], kind: Distance) -> f32 {
    match kind {
        Distance::Harmonic => samples.len() as f32 / samples.iter().map(|s| 1.0 / s.distance).sum::<f32>(),
        Distance::Nearest => samples.iter().map(|s| s.distance).fold(f32::INFINITY, f32::min),
    }
}

/// E of the samples of all cells, W/m².
pub fn irradiance(samples: &[Sample]) -> Rgb {
    samples.iter().map(|s| s.radiance).sum::<Rgb>() * (PI / samples.len() as f32)
}

/// The border between two cells moves, as fast as the nearer of both demands.
#[inline]
fn move_border(sum: &mut [Vec2; 3], speed: Vec2, here: &Sample, beside: &Sample) {
    let change = (here.radiance - beside.radiance) / here.distance.min(beside.distance);
    (0..3).for_each(|c| sum[c] += speed * change[c]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::id::Random;

    /// Gathers at `position` with unit normal `normal` in a world given by direction -> (radiance, distance).
    fn gather(rays: u32, world: impl Fn(Vec3) -> (f32, f32)) -> Estimate {
        gather_by(&Details::default(), rays, world)
    }

    fn gather_by(details: &Details, rays: u32, world: impl Fn(Vec3) -> (f32, f32)) -> Estimate {
        let strata = Strata::new(rays);
        let mut random = Random::named("test", &[1]);
        let samples: Vec<_> = (0..strata.rays())
            .map(|i| {
                let direction = strata.direction(i, Vec2::new(random.uniform(), random.uniform()));
                let (radiance, distance) = world(direction);
                Sample { direction, radiance: Rgb::splat(radiance), distance }
            })
            .collect();
        strata.estimate(&samples, details)
    }

    /// Radiance and distance seen from a point inside a unit sphere whose half x > 0 is bright.
    fn half_lit_sphere(from: Vec3, direction: Vec3) -> (f32, f32) {
        let b = from.dot(direction);
        let t = -b + (b * b + 1.0 - from.length_squared()).sqrt();
        (f32::from((from + t * direction).x > 0.0), t)
    }

    #[test]
    fn a_white_furnace_has_irradiance_pi_and_no_gradients() {
        let e = gather(1024, |_| (1.0, 2.0));
        assert!((e.irradiance.x - PI).abs() < 1e-5);
        assert!(e.gradient_t[0].length() < 1e-4 && e.gradient_r[0].length() < 1e-4);
        assert!((e.radius - 2.0).abs() < 1e-5);
    }

    /// L = 1 + x gives E(n) = π + 2π/3 n·x: tilting towards x, a turn about y, gains 2π/3 a radian.
    #[test]
    fn the_rotational_gradient_raises_e_towards_the_bright_side() {
        let e = gather(20_000, |d| (1.0 + d.x, 1.0));
        assert!((e.gradient_r[0].y - 2.0 * PI / 3.0).abs() < 0.01, "{:?}", e.gradient_r[0]);
        assert!(e.gradient_r[0].x.abs() < 0.01);
    }

    const GRADIENTS: [Gradients; 3] = [Gradients::Borders, Gradients::Samples, Gradients::Mesh];

    #[test]
    fn half_lit_sphere_value_and_both_gradients() {
        for gradients in GRADIENTS {
            let details = Details { gradients, ..Details::default() };
            let gather = |from: Vec3| gather_by(&details, 40_000, |d| half_lit_sphere(from, d));
            let e = gather(Vec3::ZERO);
            assert!((e.irradiance.x - PI / 2.0).abs() < 5e-3);
            // Turning about y brings in the bright half: E = π/2 (1 + sin α), dE/dα = π/2.
            assert!((e.gradient_r[0].y - PI / 2.0).abs() < 0.02, "{:?}", e.gradient_r[0]);
            // Moving along x: the boundary great circle, seen from the centre at distance 1, sweeps 2 per unit length
            // (∫ cos θ dθ over it); finite differences agree.
            let step = 0.05;
            let shifted = |x: f32| gather(Vec3::X * x).irradiance.x;
            let difference = (shifted(step) - shifted(-step)) / (2.0 * step);
            let gradient = e.gradient_t[0];
            assert!((gradient.x - difference).abs() < 0.05 * difference, "{gradients:?} {gradient:?} {difference}");
            assert!((gradient.x - 2.0).abs() < 0.05, "{gradients:?} {gradient:?}");
            assert!(gradient.y.abs() < 0.05, "{gradients:?} {gradient:?}");
        }
    }

    /// A square lamp above, off the middle, before a far dark wall.
    fn lamp(from: Vec3, d: Vec3) -> (f32, f32) {
        let at = from + d * (1.0 / d.z.max(1e-6));
        let on = (at.x - 0.8).abs() < 0.4 && (at.y + 0.3).abs() < 0.5 && d.z > 1e-6;
        (f32::from(on), if on { 1.0 / d.z } else { 50.0 })
    }

    /// Below a lamp: finite differences of the exact integral.
    #[test]
    fn the_translational_gradient_agrees_with_finite_differences_under_a_lamp() {
        for gradients in GRADIENTS {
            let details = Details { gradients, ..Details::default() };
            let gather = |from: Vec3| gather_by(&details, 90_000, |d| lamp(from, d));
            let e = gather(Vec3::ZERO);
            for (axis, estimate) in [(Vec3::X, e.gradient_t[0].x), (Vec3::Y, e.gradient_t[0].y)] {
                let shifted = |s: f32| gather(axis * s).irradiance.x;
                let difference = (shifted(0.05) - shifted(-0.05)) / 0.1;
                assert!(
                    (estimate - difference).abs() < 0.06 * difference.abs(),
                    "{gradients:?} {estimate} {difference}"
                );
            }
        }
    }

    /// The same for the second derivatives, which the ellipse holds as |H| / 2E.
    #[test]
    fn the_ellipse_agrees_with_finite_differences_under_a_lamp() {
        let e = gather(90_000, |d| lamp(Vec3::ZERO, d));
        let at = |x: f32, y: f32| f64::from(gather(90_000, |d| lamp(Vec3::new(x, y, 0.0), d)).irradiance.x);
        let h = 0.2;
        let second = |x: f32, y: f32| (at(x, y) - 2.0 * at(0.0, 0.0) + at(-x, -y)) / f64::from(h * h);
        let mixed = (at(h, h) - at(h, -h) - at(-h, h) + at(-h, -h)) / f64::from(4.0 * h * h);
        let exact = absolute([second(h, 0.0) as f32, mixed as f32, second(0.0, h) as f32]);
        let size = exact[0].max(exact[2]);
        for (estimate, exact) in e.ellipse.into_iter().zip(exact) {
            let estimate = estimate * 2.0 * e.irradiance.x;
            assert!((estimate - exact).abs() < 0.1 * size, "{:?} {exact:?}", e.ellipse);
        }
    }

    /// What many gathers scatter by, under a lamp and with samples that are noisy themselves.
    #[test]
    fn the_noise_told_is_the_noise_met() {
        for rays in [64, 500] {
            let strata = Strata::new(rays);
            let estimates: Vec<_> = (0..400u64)
                .map(|seed| {
                    let mut random = Random::named("noise", &[seed]);
                    let samples: Vec<_> = (0..strata.rays())
                        .map(|i| {
                            let direction = strata.direction(i, Vec2::new(random.uniform(), random.uniform()));
                            let (light, distance) = lamp(Vec3::ZERO, direction);
                            let radiance = Rgb::splat(light + random.uniform() * (1.0 + direction.x));
                            Sample { direction, radiance, distance }
                        })
                        .collect();
                    strata.estimate(&samples, &Details::default())
                })
                .collect();
            let mean = estimates.iter().map(|e| e.irradiance.x).sum::<f32>() / 400.0;
            let met = (estimates.iter().map(|e| (e.irradiance.x - mean).powi(2)).sum::<f32>() / 399.0).sqrt();
            let told = (estimates.iter().map(|e| e.noise * e.noise).sum::<f32>() / 400.0).sqrt();
            assert!((told / met - 1.0).abs() < 0.25, "{rays} rays: told {told}, met {met}");
        }
    }
}
