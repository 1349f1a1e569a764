//! Hemispherical harmonics: an orthonormal basis of functions on the hemisphere z ≥ 0 (Gautron et al. 2004).
//!
//! They are spherical harmonics shifted by cos θ -> 2 cos θ - 1. Order n has n bands l = 0 .. n - 1 and n² coefficients, that of
//! (l, m) at l² + l + m: a smaller order is the beginning of a larger one. `N` is always the number of coefficients.
//!
//! Fails where light is sharp: a truncated sum rings about small bright lamps, and at the horizon, which the shift makes one
//! point, it is the same all round.

pub mod lobe;
pub mod rotation;
#[cfg(test)]
mod sh;

use std::sync::LazyLock;

use glam::DVec3;

/// Greatest order.
pub const ORDER_MAX: usize = 10;

/// Coefficients of the greatest order.
pub const COEFFICIENTS_MAX: usize = ORDER_MAX * ORDER_MAX;

/// The order that has `coefficients` coefficients.
///
/// # Panics
/// When compiled, for a number that no order up to [`ORDER_MAX`] has.
pub const fn order(coefficients: usize) -> usize {
    let mut order = 1;
    while order * order < coefficients {
        order += 1;
    }
    assert!(order * order == coefficients && order <= ORDER_MAX, "not the square of an order");
    order
}

/// The harmonics along a unit direction of the hemisphere z ≥ 0.
pub fn harmonics<const N: usize>(direction: DVec3) -> [f64; N] {
    let DVec3 { x, y, z } = direction;
    // sin θ' e^iφ with cos θ' = 2 z - 1: sqrt(1 - (2 z - 1)²) / sqrt(1 - z²) = 2 sqrt(z / (1 + z)), so that nothing is
    // divided by 0 at the pole.
    let shift = 2.0 * (z.max(0.0) / (1.0 + z)).sqrt();
    let (re, im) = (x * shift, y * shift);
    let (mut cosines, mut sines) = ([1.0; ORDER_MAX], [0.0; ORDER_MAX]);
    for m in 1..const { order(N) } {
        cosines[m] = cosines[m - 1] * re - sines[m - 1] * im;
        sines[m] = cosines[m - 1] * im + sines[m - 1] * re;
    }
    harmonics_by(z, &cosines, &sines)
}

/// The harmonics at height z = cos θ without their factors cos mφ and sin |m|φ.
pub fn polar<const N: usize>(z: f64) -> [f64; N] {
    let sine = 2.0 * (z * (1.0 - z)).max(0.0).sqrt();
    let mut powers = [1.0; ORDER_MAX];
    for m in 1..const { order(N) } {
        powers[m] = powers[m - 1] * sine;
    }
    harmonics_by(z, &powers, &powers)
}

/// Recurrences of the associated Legendre polynomials (Gautron 2004 eqs. 27 to 29), sinᵐ θ' in `cosines` and `sines`.
fn harmonics_by<const N: usize>(z: f64, cosines: &[f64; ORDER_MAX], sines: &[f64; ORDER_MAX]) -> [f64; N] {
    let x = 2.0 * z - 1.0;
    let order = const { order(N) };
    let scale = &*SCALE;
    let mut values = [0.0; N];
    let mut sectoral = 1.0;
    for m in 0..order {
        let (mut before, mut legendre) = (0.0, sectoral);
        for l in m..order {
            let value = scale[l][m] * legendre;
            values[l * l + l + m] = value * cosines[m];
            if m > 0 {
                values[l * l + l - m] = value * sines[m];
            }
            let next = (x * (2 * l + 1) as f64 * legendre - (l + m) as f64 * before) * RECIPROCAL[l + 1 - m];
            (before, legendre) = (legendre, next);
        }
        sectoral *= -((2 * m + 1) as f64);
    }
    values
}

/// 1 / i.
const RECIPROCAL: [f64; ORDER_MAX + 1] = {
    let mut reciprocal = [0.0; ORDER_MAX + 1];
    let mut i = 1;
    while i <= ORDER_MAX {
        reciprocal[i] = 1.0 / i as f64;
        i += 1;
    }
    reciprocal
};

/// Gautron 2004 eq. 9, times sqrt 2 for m > 0; by band l and m ≥ 0.
static SCALE: LazyLock<[[f64; ORDER_MAX]; ORDER_MAX]> = LazyLock::new(|| {
    std::array::from_fn(|l| {
        std::array::from_fn(|m| {
            let factorials: f64 = (l.saturating_sub(m) + 1..=l + m).map(|i| i as f64).product();
            let twice = if m > 0 { 2.0 } else { 1.0 };
            (twice * (2 * l + 1) as f64 / (std::f64::consts::TAU * factorials)).sqrt()
        })
    })
});

/// A Gauss-Legendre rule: nodes and weights on [0, 1].
struct Gauss(Vec<(f64, f64)>);

impl Gauss {
    fn new(count: usize) -> Self {
        let n = count as f64;
        let node = |i: usize| {
            let mut x = libm::cos(std::f64::consts::PI * (i as f64 + 0.75) / (n + 0.5));
            let mut slope = 1.0;
            // Newton; the start is good to some 1e-3, each step doubles the digits.
            for _ in 0..5 {
                let (mut before, mut value) = (1.0, x);
                for k in 2..=count {
                    let k = k as f64;
                    (before, value) = (value, ((2.0 * k - 1.0) * x * value - (k - 1.0) * before) / k);
                }
                slope = n * (x * value - before) / (x * x - 1.0);
                x -= value / slope;
            }
            ((1.0 - x) * 0.5, 1.0 / ((1.0 - x * x) * slope * slope))
        };
        Self((0..count).map(node).collect())
    }

    /// The rule on [`low`, `high`].
    fn on(&self, low: f64, high: f64) -> impl Iterator<Item = (f64, f64)> {
        self.0.iter().map(move |(x, weight)| (low + (high - low) * x, (high - low) * weight))
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, TAU};

    use super::*;

    /// Unit directions of the upper hemisphere with their solid angles: exact for products of two harmonics.
    pub(super) fn hemisphere(count: usize) -> impl Iterator<Item = (DVec3, f64)> {
        Gauss::new(count).0.into_iter().flat_map(move |(z, weight)| {
            (0..2 * count).map(move |k| {
                let phi = TAU * (k as f64 + 0.5) / (2 * count) as f64;
                let s = (1.0 - z * z).sqrt();
                (DVec3::new(s * phi.cos(), s * phi.sin(), z), weight * PI / count as f64)
            })
        })
    }

    #[test]
    fn harmonics_are_orthonormal() {
        let mut products = vec![0.0; COEFFICIENTS_MAX * COEFFICIENTS_MAX];
        for (d, weight) in hemisphere(32) {
            let h = harmonics::<COEFFICIENTS_MAX>(d);
            for (row, a) in products.chunks_exact_mut(COEFFICIENTS_MAX).zip(h) {
                row.iter_mut().zip(h).for_each(|(sum, b)| *sum += weight * a * b);
            }
        }
        let error = |(i, sum): (usize, &f64)| (sum - f64::from(i % (COEFFICIENTS_MAX + 1) == 0)).abs();
        let worst = products.iter().enumerate().map(error).fold(0.0, f64::max);
        eprintln!("orthonormality: worst error {worst:e}");
        assert!(worst < 1e-6, "{worst}");
    }

    #[test]
    fn a_smaller_order_is_the_beginning_of_a_larger_one() {
        let d = DVec3::new(0.3, -0.5, 0.7).normalize();
        let all = harmonics::<COEFFICIENTS_MAX>(d);
        assert_eq!(harmonics::<9>(d), all[..9]);
        assert_eq!(harmonics::<1>(d), all[..1]);
        assert_eq!(harmonics::<49>(d), all[..49]);
    }

    #[test]
    fn a_constant_is_the_first_harmonic_alone() {
        let mut sum = [0.0; COEFFICIENTS_MAX];
        for (d, weight) in hemisphere(32) {
            let h = harmonics::<COEFFICIENTS_MAX>(d);
            sum.iter_mut().zip(h).for_each(|(s, h)| *s += weight * h);
        }
        assert!((sum[0] - TAU.sqrt()).abs() < 1e-12);
        assert!(sum[1..].iter().all(|s| s.abs() < 1e-12));
        for (d, _) in hemisphere(8) {
            assert!((sum[0] * harmonics::<1>(d)[0] - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn at_the_pole_and_the_horizon_only_m_0_remains() {
        for d in [DVec3::Z, DVec3::X, DVec3::new(0.6, 0.8, 0.0)] {
            for l in 0..ORDER_MAX {
                for m in -(l as isize)..=l as isize {
                    let value = harmonics::<COEFFICIENTS_MAX>(d)[(l * l + l).strict_add_signed(m)];
                    let exact =
                        if m == 0 { SCALE[l][0] * if d.z == 0.0 && l % 2 == 1 { -1.0 } else { 1.0 } } else { 0.0 };
                    assert!((value - exact).abs() < 1e-12, "{d} {l} {m}: {value}");
                }
            }
        }
    }

    #[test]
    fn polar_and_azimuth_make_harmonics() {
        let (z, phi) = (0.37f64, 1.1f64);
        let s = (1.0 - z * z).sqrt();
        let h = harmonics::<COEFFICIENTS_MAX>(DVec3::new(s * phi.cos(), s * phi.sin(), z));
        let p = polar::<COEFFICIENTS_MAX>(z);
        for l in 0..ORDER_MAX {
            for m in 0..=l {
                let (plus, minus) = (l * l + l + m, l * l + l - m);
                assert!((h[plus] - p[plus] * (m as f64 * phi).cos()).abs() < 1e-12);
                assert!(m == 0 || (h[minus] - p[minus] * (m as f64 * phi).sin()).abs() < 1e-12);
            }
        }
    }
}
