//! Triangles as seen from a point: their solid angle, and uniform sampling of it (Arvo 1995, "Stratified sampling of
//! spherical triangles"). Near a lamp, choosing its points by area would make light from it vary without bound.

use glam::Vec3;

use crate::math::{atan2, sin_cos};

/// A triangle projected on the unit sphere round a point.
#[derive(Clone, Copy, Debug)]
pub struct SphericalTriangle {
    corners: [Vec3; 3],
    /// Solid angle, sr.
    pub solid_angle: f32,
}

impl SphericalTriangle {
    /// Projects a triangle; `None` if it is so far away, compared with its size, that its area serves as well, or so
    /// close to edge-on that it has no solid angle to speak of.
    pub fn near(from: Vec3, corners: &[Vec3; 3]) -> Option<Self> {
        /// Longest edge over distance at which area sampling would vary by some per cent.
        const NEAR: f32 = 0.3;
        let rays = corners.map(|c| c - from);
        let [a, b, c] = rays;
        let edge2 = (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
        let nearest2 = rays.map(|r| r.length_squared()).into_iter().fold(f32::INFINITY, f32::min);
        if edge2 < NEAR * NEAR * nearest2 {
            return None;
        }
        let [a, b, c] = rays.map(Vec3::normalize);
        // Van Oosterom and Strackee 1983: exact where the sum of angles would cancel.
        let solid_angle = 2.0 * atan2(a.dot(b.cross(c)).abs(), 1.0 + a.dot(b) + b.dot(c) + c.dot(a));
        (solid_angle > 1e-4).then_some(Self { corners: [a, b, c], solid_angle })
    }

    /// A unit direction, uniform over the solid angle, by `u`, `v` in [0, 1).
    pub fn sample(&self, u: f32, v: f32) -> Vec3 {
        let [a, b, c] = self.corners;
        // The angle at a between the great circles to b and c.
        let (to_b, to_c) = ((b - a * a.dot(b)).normalize(), (c - a * a.dot(c)).normalize());
        let (sin_alpha, cos_alpha) = (to_b.cross(to_c).length(), to_b.dot(to_c));
        let alpha = atan2(sin_alpha, cos_alpha);
        // The sub-triangle of area u Ω between b, a and a point d on the arc from a to c.
        let (s, t) = sin_cos(u * self.solid_angle - alpha);
        let (k1, k2) = (t - cos_alpha, s + sin_alpha * a.dot(b));
        let cos_d = ((k2 * t - k1 * s) * cos_alpha - k2) / ((k2 * s + k1 * t) * sin_alpha);
        let cos_d = if cos_d.is_finite() { cos_d.clamp(-1.0, 1.0) } else { 1.0 };
        let d = a * cos_d + to_c * (1.0 - cos_d * cos_d).max(0.0).sqrt();
        // A point on the arc from b to d.
        let z = 1.0 - v * (1.0 - d.dot(b));
        let across = (d - b * d.dot(b)).normalize_or_zero();
        (b * z + across * (1.0 - z * z).max(0.0).sqrt()).normalize()
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::FRAC_PI_2;

    use cache_core::id::Random;

    use super::*;

    #[test]
    fn an_octant_is_an_eighth_of_the_sphere_and_sampled_evenly() {
        let octant = SphericalTriangle::near(Vec3::ZERO, &[Vec3::X, Vec3::Y * 2.0, Vec3::Z * 3.0]).expect("near");
        assert!((octant.solid_angle - FRAC_PI_2).abs() < 1e-5);
        let mut random = Random::named("octant", &[]);
        let (mut mean, n) = (Vec3::ZERO, 200_000);
        for _ in 0..n {
            let d = octant.sample(random.uniform(), random.uniform());
            assert!(d.min_element() > -1e-4 && d.is_normalized());
            mean += d / n as f32;
        }
        // By symmetry the mean of each coordinate over an octant is 1/2.
        assert!((mean - Vec3::splat(0.5)).abs().max_element() < 3e-3, "{mean}");
    }

    /// Sampling by solid angle and by area must give the same irradiance from a lamp close by.
    #[test]
    fn sampling_agrees_with_sampling_by_area() {
        let corners = [Vec3::new(-0.5, -0.2, 0.3), Vec3::new(0.9, -0.4, 0.4), Vec3::new(0.1, 1.0, 0.6)];
        let (normal, area) = {
            let n = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
            (n.normalize(), n.length() * 0.5)
        };
        let triangle = SphericalTriangle::near(Vec3::ZERO, &corners).expect("near");
        let mut random = Random::named("lamp", &[]);
        let (mut by_angle, mut by_area, n) = (0f64, 0f64, 400_000);
        for _ in 0..n {
            let (u, v) = (random.uniform(), random.uniform());
            by_angle += f64::from(triangle.sample(u, v).z * triangle.solid_angle) / f64::from(n);
            let s = u.sqrt();
            let p = corners[0] * (1.0 - s) + corners[1] * (s * (1.0 - v)) + corners[2] * (s * v);
            let d = p.normalize();
            by_area += f64::from(d.z * normal.dot(d).abs() * area / p.length_squared()) / f64::from(n);
        }
        assert!((by_angle - by_area).abs() < 5e-3 * by_area, "{by_angle} {by_area}");
    }
}
