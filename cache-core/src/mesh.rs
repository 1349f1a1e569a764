//! A gather's samples as a mesh of triangles round the site: how irradiance changes as the site moves, to second order.
//!
//! Paper: Schwarzhaupt, Jensen, Jarosz 2012. Neighbouring samples span triangles whose corners are the points the rays
//! met; each triangle shines with the radiance of its farthest corner, so that where a near surface ends it is the near
//! edge that moves against what lies behind it.
//!
//! The irradiance of a polygon of radiance L is L/2 Σ Θ m·n over its edges (Lambert): Θ the angle the edge subtends, m
//! the unit normal of the plane through the edge and the site. Here the first and second derivative of one summand are
//! written with the directions u and the *inverse* distances ρ of the edge's ends, for along an edge ρ is sinusoidal in the
//! angle: nothing cancels, and what is infinitely far needs no case of its own.

use glam::{Vec2, Vec3};

use crate::hemisphere::Sample;
use crate::math::Rgb;

/// An end of an edge, seen from the site.
#[derive(Clone, Copy, Debug)]
pub struct End {
    /// Unit direction, local: z along the normal.
    pub direction: Vec3,
    /// 1 / distance, in 1/m; 0 for what is infinitely far.
    pub inverse: f32,
}

/// Derivatives of an edge's Θ m·n by the position of the site in its tangent plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Change {
    /// First, 1/m.
    pub gradient: Vec2,
    /// Second: (xx, xy, yy), 1/m².
    pub hessian: [f32; 3],
}

/// How Θ m·n of the edge from `a` to `b`, counterclockwise round the triangle it belongs to, changes.
pub fn edge(a: End, b: End) -> Change {
    let plane = a.direction.cross(b.direction);
    let sine = plane.length();
    if sine < 1e-6 {
        return Change::default();
    }
    let angle = libm::atan2f(sine, a.direction.dot(b.direction));
    let height = plane.z / sine;
    // n × e |a|⁻¹|b|⁻¹, e the edge.
    let along = b.direction * a.inverse - a.direction * b.inverse;
    let across = Vec2::new(-along.y, along.x) / sine;
    // ∫ u ρ dφ and ∫ ρ² (8 u uᵀ - 2) dφ along the edge; two points are exact to third order in the angle.
    let (mut first, mut second) = (Vec2::ZERO, [0f32; 3]);
    for (near, far) in NODES {
        let bend = |t: f32| t * (1.0 + (1.0 - t * t) * angle * angle * (1.0 / 6.0));
        let (of_a, of_b) = (bend(near), bend(far));
        let u = (a.direction * of_a + b.direction * of_b).truncate();
        let inverse = a.inverse * of_a + b.inverse * of_b;
        first += u * inverse;
        let square = inverse * inverse;
        second[0] += square * (8.0 * u.x * u.x - 2.0);
        second[1] += square * (8.0 * u.x * u.y);
        second[2] += square * (8.0 * u.y * u.y - 2.0);
    }
    let half = 0.5 * angle;
    first *= half;
    let mixed = [across.x * first.x * 2.0, across.x * first.y + across.y * first.x, across.y * first.y * 2.0];
    Change {
        gradient: across * angle + first * (2.0 * height),
        hessian: std::array::from_fn(|i| 2.0 * mixed[i] + height * half * second[i]),
    }
}

/// How the irradiance of a whole hemisphere changes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Survey {
    /// ∇_t E per channel, W/m³, in the local x and y.
    pub gradient: [Vec2; 3],
    /// Second derivatives of the mean of E over the channels: (xx, xy, yy), W/m⁴.
    pub hessian: [f32; 3],
}

/// Spans the mesh over samples of `rings` rings round the zenith, inner first, each of `sectors` samples counterclockwise.
///
/// # Panics
/// Unless there are `rings * sectors` samples.
pub fn survey(samples: &[Sample], rings: usize, sectors: usize) -> Survey {
    assert_eq!(samples.len(), rings * sectors);
    let at = |j: usize, k: usize| &samples[j * sectors + k];
    let mut sum = Sum::default();
    let inner = &samples[..sectors];
    let zenith = Sample {
        direction: Vec3::Z,
        radiance: inner.iter().map(|s| s.radiance).sum::<Rgb>() / sectors as f32,
        distance: sectors as f32 / inner.iter().map(|s| 1.0 / s.distance).sum::<f32>(),
    };
    for j in 0..rings {
        for k in 0..sectors {
            let (next, before) = ((k + 1) % sectors, (k + sectors - 1) % sectors);
            let (a, d) = (at(j, k), at(j, next));
            let inside = if j > 0 { at(j - 1, k) } else { &zenith };
            let within = seen_through(inside, a, d);
            if j + 1 < rings {
                let (b, c) = (at(j + 1, k), at(j + 1, next));
                let (outer, turned) = (seen_through(a, b, c), seen_through(a, c, d));
                sum.add(a, b, outer - seen_through(at(j, before), b, a));
                sum.add(a, c, turned - outer);
                sum.add(a, d, within - turned);
            } else {
                // From the outermost samples the mesh goes on level to the horizon, which cuts it off.
                let beyond = seen_through(a, d, d);
                sum.add(a, d, within - beyond);
                sum.add(a, &at_horizon(a), beyond - seen_through(at(j, before), a, a));
                sum.add(&at_horizon(a), &at_horizon(d), beyond);
            }
            if j == 0 {
                sum.add(&zenith, a, within - seen_through(&zenith, at(0, before), a));
            }
        }
    }
    Survey { gradient: sum.gradient.map(|g| g * 0.5), hessian: sum.hessian.map(|h| h * 0.5) }
}

fn at_horizon(sample: &Sample) -> Sample {
    Sample { direction: sample.direction.truncate().normalize_or_zero().extend(0.0), ..*sample }
}

/// Radiance of a triangle: that of its farthest corner.
#[inline]
fn seen_through(a: &Sample, b: &Sample, c: &Sample) -> Rgb {
    let farther = if b.distance > a.distance { b } else { a };
    if c.distance > farther.distance { c.radiance } else { farther.radiance }
}

#[derive(Default)]
struct Sum {
    gradient: [Vec2; 3],
    hessian: [f32; 3],
}

impl Sum {
    /// Adds an edge whose left side, looking outwards from the site, outshines the right by `step`.
    #[inline]
    fn add(&mut self, from: &Sample, to: &Sample, step: Rgb) {
        if step == Rgb::ZERO {
            return;
        }
        let end = |s: &Sample| End { direction: s.direction, inverse: 1.0 / s.distance };
        let change = edge(end(from), end(to));
        let mean = step.element_sum() * (1.0 / 3.0);
        for c in 0..3 {
            self.gradient[c] += change.gradient * step[c];
            self.hessian[c] += change.hessian[c] * mean;
        }
    }
}

/// Gauss-Legendre points of [0, 1], from either end.
const NODES: [(f32, f32); 2] = [(0.788_675_1, 0.211_324_87), (0.211_324_87, 0.788_675_1)];

/// |H| of a symmetric matrix (xx, xy, yy): the same axes, the sizes of its eigenvalues.
pub fn absolute([xx, xy, yy]: [f32; 3]) -> [f32; 3] {
    // The positive root of H², by Cayley and Hamilton; scaled, so that squares neither vanish nor overflow.
    let scale = xx.abs().max(xy.abs()).max(yy.abs());
    if scale == 0.0 || !scale.is_finite() {
        return [0.0; 3];
    }
    let [xx, xy, yy] = [xx / scale, xy / scale, yy / scale].map(f64::from);
    let square = [xx * xx + xy * xy, xy * (xx + yy), xy * xy + yy * yy];
    let root = (xx * yy - xy * xy).abs();
    let trace = (square[0] + square[2] + 2.0 * root).sqrt();
    [square[0] + root, square[1], square[2] + root].map(|v| (v / trace) as f32 * scale)
}

/// The matrix (xx, xy, yy) in a frame turned by an angle given as (cosine, sine).
pub fn turned([xx, xy, yy]: [f32; 3], Vec2 { x: c, y: s }: Vec2) -> [f32; 3] {
    [
        xx * c * c + 2.0 * xy * s * c + yy * s * s,
        (yy - xx) * s * c + xy * (c * c - s * s),
        xx * s * s - 2.0 * xy * s * c + yy * c * c,
    ]
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::*;

    fn end(at: DVec3) -> End {
        End { direction: at.normalize().as_vec3(), inverse: at.length().recip() as f32 }
    }

    /// Θ m·n from a site at (x, y, 0).
    fn exact(a: DVec3, b: DVec3, x: f64, y: f64) -> f64 {
        let from = DVec3::new(x, y, 0.0);
        let (a, b) = (a - from, b - from);
        let plane = a.cross(b);
        plane.length().atan2(a.dot(b)) * plane.z / plane.length()
    }

    proptest! {
        #[test]
        fn derivatives_agree_with_finite_differences(
            phi in -3.1f64..3.1, z in 0.05f64..0.95, turn in -0.12f64..0.12, tilt in -0.1f64..0.1,
            near in 0.5f64..4.0, far in 0.5f64..40.0,
        ) {
            let direction = |phi: f64, z: f64| DVec3::new(phi.cos(), phi.sin(), 0.0) * (1.0 - z * z).sqrt() + DVec3::Z * z;
            prop_assume!(turn.abs() + tilt.abs() > 0.02);
            let a = direction(phi, z) * near;
            let b = direction(phi + turn, (z + tilt).clamp(0.02, 0.98)) * far;
            let change = edge(end(a), end(b));
            let f = |x: f64, y: f64| exact(a, b, x, y);
            let h = 1e-4 * near.min(far);
            let gradient = [(f(h, 0.0) - f(-h, 0.0)) / (2.0 * h), (f(0.0, h) - f(0.0, -h)) / (2.0 * h)];
            let middle = f(0.0, 0.0);
            let hessian = [
                (f(h, 0.0) - 2.0 * middle + f(-h, 0.0)) / (h * h),
                (f(h, h) - f(h, -h) - f(-h, h) + f(-h, -h)) / (4.0 * h * h),
                (f(0.0, h) - 2.0 * middle + f(0.0, -h)) / (h * h),
            ];
            let size = near.min(far).recip();
            for (ours, theirs) in change.gradient.to_array().into_iter().zip(gradient) {
                prop_assert!((f64::from(ours) - theirs).abs() < 2e-3 * size, "{change:?} {gradient:?}");
            }
            for (ours, theirs) in change.hessian.into_iter().zip(hessian) {
                prop_assert!((f64::from(ours) - theirs).abs() < 1e-2 * size * size, "{change:?} {hessian:?}");
            }
        }

        #[test]
        fn the_absolute_matrix_has_the_same_square(xx in -3f32..3.0, xy in -3f32..3.0, yy in -3f32..3.0) {
            let square = |[xx, xy, yy]: [f32; 3]| [xx * xx + xy * xy, xy * (xx + yy), xy * xy + yy * yy];
            let root = absolute([xx, xy, yy]);
            for (one, other) in square(root).into_iter().zip(square([xx, xy, yy])) {
                prop_assert!((one - other).abs() < 1e-4, "{root:?}");
            }
            prop_assert!(root[0] >= 0.0 && root[2] >= 0.0 && root[0] * root[2] - root[1] * root[1] > -1e-4);
        }
    }

    #[test]
    fn what_is_infinitely_far_does_not_change() {
        let far = |x: f32| End { direction: Vec3::new(x, 0.3, 0.5).normalize(), inverse: 0.0 };
        assert_eq!(edge(far(0.1), far(0.2)), Change::default());
        assert_eq!(edge(far(0.1), far(0.1)), Change::default());
        assert_eq!(absolute([0.0; 3]), [0.0; 3]);
    }
}
