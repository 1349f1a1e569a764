//! Stratified directions of a gather, and what their samples say: irradiance, both gradients, and R.
//!
//! The hemisphere is cut into M polar by N azimuthal cells of equal projected solid angle, N ≈ πM. Paper: Ward, Heckbert
//! 1992 (eqs. 2, 3), with the sign of the rotational gradient as finite differences demand: tilting the normal towards
//! a bright sample raises E.

use std::f32::consts::PI;

use glam::{Vec2, Vec3};

use crate::math::{Rgb, sin_cos};

/// What one gather ray brought back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Incoming radiance, W/(sr m²).
    pub radiance: Rgb,
    /// Distance to what it hit, world length; infinite for nothing.
    pub distance: f32,
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
    /// Harmonic mean of the distances, limited by |E| / |∇_t E| (Krivanek 2006 eq. 2); world length, may be infinite.
    pub radius: f32,
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

    /// How many rays a gather traces: M N.
    pub fn rays(&self) -> usize {
        self.polar * self.azimuthal
    }

    /// Local unit direction (z along the normal) of cell `index`, jittered by `u` in [0, 1)². Cells of one ring follow
    /// each other.
    pub fn direction(&self, index: usize, u: Vec2) -> Vec3 {
        let (j, k) = (index / self.azimuthal, index % self.azimuthal);
        let s2 = (j as f32 + u.x) / self.polar as f32;
        let (sin_phi, cos_phi) = sin_cos((k as f32 + u.y) * (2.0 * PI / self.azimuthal as f32));
        let s = s2.sqrt();
        Vec3::new(s * cos_phi, s * sin_phi, (1.0 - s2).max(0.0).sqrt())
    }

    /// Sums the samples of all cells, in cell order.
    ///
    /// # Panics
    /// If there are not exactly [`Self::rays`] samples.
    pub fn estimate(&self, samples: &[Sample]) -> Estimate {
        assert_eq!(samples.len(), self.rays());
        let mut sum = Rgb::ZERO;
        let mut inverse = 0.0f32;
        // Per channel would need the transposed layout: keep x and y parts as colours instead.
        let (mut tx, mut ty, mut rx, mut ry) = (Rgb::ZERO, Rgb::ZERO, Rgb::ZERO, Rgb::ZERO);
        let n = self.azimuthal;
        for (j, ring) in self.rings.iter().enumerate() {
            for (k, sector) in self.sectors.iter().enumerate() {
                let here = &samples[j * n + k];
                sum += here.radiance;
                inverse += 1.0 / here.distance;
                rx += here.radiance * (ring.tilt * sector.turn.x);
                ry += here.radiance * (ring.tilt * sector.turn.y);
                if j > 0 {
                    let inner = &samples[(j - 1) * n + k];
                    let change = (here.radiance - inner.radiance) * (ring.border / here.distance.min(inner.distance));
                    tx += change * sector.middle.x;
                    ty += change * sector.middle.y;
                }
                let beside = &samples[j * n + (k + n - 1) % n];
                let change = (here.radiance - beside.radiance) * (ring.side / here.distance.min(beside.distance));
                tx += change * sector.border.x;
                ty += change * sector.border.y;
            }
        }
        let rays = self.rays() as f32;
        let irradiance = sum * (PI / rays);
        let mean = |c: Rgb| c.element_sum();
        let slope = Vec2::new(mean(tx), mean(ty)).length();
        let by_gradient = if slope > 0.0 { mean(irradiance) / slope } else { f32::INFINITY };
        Estimate {
            irradiance,
            gradient_t: std::array::from_fn(|c| Vec2::new(tx[c], ty[c])),
            gradient_r: std::array::from_fn(|c| Vec2::new(rx[c], ry[c])),
            radius: (rays / inverse).min(by_gradient),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::id::Random;

    /// Gathers at `position` with unit normal `normal` in a world given by direction -> (radiance, distance).
    fn gather(rays: u32, world: impl Fn(Vec3) -> (f32, f32)) -> Estimate {
        let strata = Strata::new(rays);
        let mut random = Random::named("test", &[1]);
        let samples: Vec<_> = (0..strata.rays())
            .map(|i| {
                let (radiance, distance) = world(strata.direction(i, Vec2::new(random.uniform(), random.uniform())));
                Sample { radiance: Rgb::splat(radiance), distance }
            })
            .collect();
        strata.estimate(&samples)
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

    #[test]
    fn half_lit_sphere_value_and_both_gradients() {
        let e = gather(40_000, |d| half_lit_sphere(Vec3::ZERO, d));
        assert!((e.irradiance.x - PI / 2.0).abs() < 5e-3);
        // Turning about y brings in the bright half: E = π/2 (1 + sin α), dE/dα = π/2.
        assert!((e.gradient_r[0].y - PI / 2.0).abs() < 0.02, "{:?}", e.gradient_r[0]);
        // Moving along x: the boundary great circle, seen from the centre at distance 1, sweeps 2 per unit length
        // (∫ cos θ dθ over it); finite differences agree.
        let step = 0.05;
        let shifted = |x: f32| gather(40_000, |d| half_lit_sphere(Vec3::X * x, d)).irradiance.x;
        let difference = (shifted(step) - shifted(-step)) / (2.0 * step);
        assert!((e.gradient_t[0].x - difference).abs() < 0.05 * difference, "{:?} {difference}", e.gradient_t[0]);
        assert!((e.gradient_t[0].x - 2.0).abs() < 0.05, "{:?}", e.gradient_t[0]);
        assert!(e.gradient_t[0].y.abs() < 0.05);
    }

    /// Below a bright square lamp, off its middle: finite differences of the exact integral.
    #[test]
    fn the_translational_gradient_agrees_with_finite_differences_under_a_lamp() {
        let lamp = |from: Vec3, d: Vec3| {
            let at = from + d * (1.0 / d.z.max(1e-6));
            let on = (at.x - 0.8).abs() < 0.4 && (at.y + 0.3).abs() < 0.5 && d.z > 1e-6;
            (f32::from(on), if on { 1.0 / d.z } else { 50.0 })
        };
        let e = gather(90_000, |d| lamp(Vec3::ZERO, d));
        for (axis, estimate) in [(Vec3::X, e.gradient_t[0].x), (Vec3::Y, e.gradient_t[0].y)] {
            let shifted = |s: f32| gather(90_000, |d| lamp(axis * s, d)).irradiance.x;
            let difference = (shifted(0.05) - shifted(-0.05)) / 0.1;
            assert!((estimate - difference).abs() < 0.06 * difference.abs(), "{estimate} {difference}");
        }
    }
}
