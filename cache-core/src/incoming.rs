//! What a gather says of the radiance that comes in by direction: coefficients, their derivatives, and R.
//!
//! The hemisphere is cut into M polar by N azimuthal cells of equal solid angle, N ≈ 4M: those of irradiance, of equal
//! projected solid angle, hardly look along the surface, where glossy lobes do. Paper: Krivanek et al. 2005b, with the
//! harmonics of its gradients taken where borders move, not where samples lie beside them: of 1000 rays that is some four
//! times nearer to finite differences.

use std::f32::consts::TAU;

use glam::{Vec2, Vec3};

use crate::details::{Details, Gradients, Metric};
use crate::hemisphere::{Cells, Estimated, Sample, distance, variance};
use crate::hsh::rotation::turn;
use crate::hsh::{ORDER_MAX, harmonics, order, polar};
use crate::math::{Rgb, sin_cos};
use crate::mesh::{absolute, survey, turned};
use crate::radiance::{Coefficients, irradiance};

/// What a whole gather says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate<const N: usize> {
    /// Λ, W/(√sr m²), in the local frame.
    pub coefficients: Coefficients<N>,
    /// ∂Λ/∂x and ∂Λ/∂y, W/(√sr m³).
    pub gradient: [Coefficients<N>; 2],
    /// Harmonic mean of the distances, or the least of them, limited by |E| / |∇_t E| (Krivanek 2006 eq. 2); world length, may
    /// be infinite.
    pub radius: f32,
    /// (xx, xy, yy) of M, 1/m²: at a distance d the second derivatives change E by (dᵀ M d) E. 0 where they were not asked for.
    pub ellipse: [f32; 3],
    /// Standard error of each coefficient, root mean square over the channels, W/(√sr m²).
    pub noise: f32,
}

impl<const N: usize> Estimate<N> {
    /// The same in a frame turned about the normal by an angle given as (cosine, sine).
    pub fn turned(mut self, angle: Vec2) -> Self {
        self.coefficients.iter_mut().chain(self.gradient.as_flattened_mut()).for_each(|c| turn(c, angle));
        self.ellipse = turned(self.ellipse, angle);
        let [along_x, along_y] = &mut self.gradient;
        for (x, y) in along_x.as_flattened_mut().iter_mut().zip(along_y.as_flattened_mut()) {
            (*x, *y) = (*x * angle.x + *y * angle.y, *y * angle.x - *x * angle.y);
        }
        self
    }
}

impl<const N: usize> Estimated for Estimate<N> {
    fn noise(&self) -> f32 {
        self.noise
    }

    fn united(mut self, rays: f32, other: &Self, others: f32) -> Self {
        let (own, theirs) = (rays / (rays + others), others / (rays + others));
        let all = self.coefficients.iter_mut().chain(self.gradient.as_flattened_mut()).flatten();
        let others = other.coefficients.iter().chain(other.gradient.as_flattened()).flatten();
        all.zip(others).for_each(|(a, b)| *a = *a * own + b * theirs);
        self.noise = ((self.noise * own).powi(2) + (other.noise * theirs).powi(2)).sqrt();
        self
    }
}

/// Cells of equal solid angle.
#[derive(Clone, Debug)]
pub struct Bands {
    polar: usize,
    rings: Vec<Ring>,
    sectors: Vec<Sector>,
}

/// One polar band, between θ_j- and θ_j+.
#[derive(Clone, Copy, Debug)]
struct Ring {
    /// cos θ_j-, and how fast the inner border sweeps solid angle: sin θ_j- cos θ_j- 2π / N.
    border: (f64, f32),
    /// Cosine at the middle of the borders between sectors, and how fast they sweep: θ_j+ - θ_j-.
    side: (f64, f32),
}

/// One azimuthal sector.
#[derive(Clone, Copy, Debug)]
struct Sector {
    /// (cos mφ, sin mφ) at the middle φ_k, for each m.
    middle: [Vec2; ORDER_MAX],
    /// The same at the lower border φ_k-.
    border: [Vec2; ORDER_MAX],
}

impl Bands {
    /// Cells for at most `rays` rays (at least 4), N ≈ 4M.
    pub fn new(rays: u32) -> Self {
        let rays = rays.max(4) as usize;
        let polar = ((rays as f32).sqrt() * 0.5) as usize;
        let azimuthal = rays / polar;
        let sector_angle = TAU / azimuthal as f32;
        let height = |j: usize| 1.0 - j as f32 / polar as f32;
        let rings = (0..polar)
            .map(|j| {
                let (z, next) = (height(j), height(j + 1));
                let sine = (1.0 - z * z).max(0.0).sqrt();
                let (low, high) = (libm::acosf(z), libm::acosf(next));
                let middle = libm::cosf((low + high) * 0.5);
                Ring { border: (z.into(), sine * z * sector_angle), side: (middle.into(), high - low) }
            })
            .collect();
        let multiples = |angle: f32| {
            std::array::from_fn(|m| {
                let (s, c) = sin_cos(m as f32 * angle);
                Vec2::new(c, s)
            })
        };
        let sector = |k: usize| Sector {
            middle: multiples((k as f32 + 0.5) * sector_angle),
            border: multiples(k as f32 * sector_angle),
        };
        Self { polar, rings, sectors: (0..azimuthal).map(sector).collect() }
    }

    /// Sums the samples of all cells, in cell order.
    ///
    /// # Panics
    /// If there are not exactly [`Self::rays`] samples.
    pub fn estimate<const N: usize>(&self, samples: &[Sample], details: &Details) -> Estimate<N> {
        assert_eq!(samples.len(), self.rays());
        let solid_angle = TAU / self.rays() as f32;
        // What is the same all round is known without error: all other harmonics integrate to 0. Noise is of the rest.
        let mean = samples.iter().map(|s| s.radiance).sum::<Rgb>() / self.rays() as f32;
        let mut sums = [[0.0f64; N]; 3];
        for (sum, mean) in sums.iter_mut().zip(mean.to_array()) {
            sum[0] = f64::from(mean) * std::f64::consts::TAU.sqrt();
        }
        for sample in samples {
            let h = harmonics::<N>(sample.direction.as_dvec3());
            for (sum, light) in sums.iter_mut().zip(((sample.radiance - mean) * solid_angle).to_array()) {
                sum.iter_mut().zip(&h).for_each(|(sum, h)| *sum += f64::from(light) * h);
            }
        }
        let coefficients = sums.map(|sums| sums.map(|sum| sum as f32));
        let gradient = match details.gradients {
            Gradients::None => [[[0.0; N]; 3]; 2],
            _ => self.gradient(samples),
        };
        let [along_x, along_y] = gradient.each_ref().map(|g| irradiance(g).element_sum());
        let slope = Vec2::new(along_x, along_y).length();
        let limited = details.radius_by_gradient && slope > 0.0;
        let by_gradient = if limited { irradiance(&coefficients).element_sum().abs() / slope } else { f32::INFINITY };
        let mean = irradiance(&coefficients).element_sum() * (1.0 / 3.0);
        let ellipse = match details.metric {
            Metric::Hessian if mean > 0.0 => {
                absolute(survey(samples, self.polar, self.sectors.len()).hessian).map(|h| h / (2.0 * mean))
            }
            _ => [0.0; 3],
        };
        Estimate {
            coefficients,
            gradient,
            radius: distance(samples, details.distance).min(by_gradient),
            ellipse,
            noise: (variance(samples, self.sectors.len()) * solid_angle).sqrt(),
        }
    }

    /// Krivanek 2005b, section 3: borders between cells move, as fast as the nearer of both sides demands.
    fn gradient<const N: usize>(&self, samples: &[Sample]) -> [Coefficients<N>; 2] {
        let mut gradient = [[[0.0; N]; 3]; 2];
        let n = self.sectors.len();
        let rows: Vec<_> = samples.chunks_exact(n).collect();
        for (j, ring) in self.rings.iter().enumerate() {
            if j > 0 {
                let moves = self.sectors.iter().enumerate().map(|(k, sector)| {
                    let [_, along, ..] = sector.middle;
                    (along, &sector.middle, change(&rows[j][k], &rows[j - 1][k]))
                });
                shift(&mut gradient, ring.border, moves);
            }
            let moves = self.sectors.iter().enumerate().map(|(k, sector)| {
                let [_, along, ..] = sector.border;
                (along.perp(), &sector.border, change(&rows[j][k], &rows[j][(k + n - 1) % n]))
            });
            shift(&mut gradient, ring.side, moves);
        }
        gradient
    }
}

/// Directions by Krivanek 2005b eq. 1.
impl Cells for Bands {
    fn rays(&self) -> usize {
        self.polar * self.sectors.len()
    }

    fn direction(&self, index: usize, u: Vec2) -> Vec3 {
        let azimuthal = self.sectors.len();
        let (j, k) = (index / azimuthal, index % azimuthal);
        let z = 1.0 - (j as f32 + u.x) / self.polar as f32;
        let (sin_phi, cos_phi) = sin_cos((k as f32 + u.y) * (TAU / azimuthal as f32));
        let s = (1.0 - z * z).max(0.0).sqrt();
        Vec3::new(s * cos_phi, s * sin_phi, z)
    }
}

/// What a border's move by its sweep brings, W/(sr m³).
fn change(here: &Sample, beside: &Sample) -> Rgb {
    (here.radiance - beside.radiance) / here.distance.min(beside.distance)
}

/// Adds what the borders at one height bring: each moves along a tangent, has (cos mφ, sin mφ), and a change.
fn shift<'a, const N: usize>(
    gradient: &mut [Coefficients<N>; 2],
    (height, speed): (f64, f32),
    moves: impl Iterator<Item = (Vec2, &'a [Vec2; ORDER_MAX], Rgb)>,
) {
    let order = const { order(N) };
    // All round first: harmonics of one height differ by factors of m alone.
    let mut sums = [[[Vec2::ZERO; ORDER_MAX]; 3]; 2];
    for (along, multiples, change) in moves {
        for (sums, along) in sums.iter_mut().zip(along.to_array()) {
            for (sums, change) in sums.iter_mut().zip(change.to_array()) {
                let change = change * along;
                sums[..order].iter_mut().zip(multiples).for_each(|(sum, multiple)| *sum += *multiple * change);
            }
        }
    }
    let heights = polar::<N>(height).map(|h| h as f32 * speed);
    for (gradient, sums) in gradient.iter_mut().flatten().zip(sums.iter().flatten()) {
        for l in 0..order {
            for (m, sum) in sums[..=l].iter().enumerate() {
                let (plus, minus) = (l * l + l + m, l * l + l - m);
                gradient[plus] += heights[plus] * sum.x;
                if m > 0 {
                    gradient[minus] += heights[minus] * sum.y;
                }
            }
        }
    }
}

#[cfg(test)]
#[path = "incoming_tests.rs"]
mod tests;
