//! Spherical harmonics: what hemispherical ones are proven against (Gautron 2004 eqs. 2 to 4, 18).

use std::f64::consts::PI;

use glam::DVec3;

use super::tests::hemisphere;
use super::{COEFFICIENTS_MAX, ORDER_MAX, harmonics};

/// The spherical harmonics of `bands` bands along a unit direction.
pub fn spherical(bands: usize, direction: DVec3) -> Vec<f64> {
    let DVec3 { x, y, z } = direction;
    let mut values = vec![0.0; bands * bands];
    let (mut re, mut im, mut sectoral) = (1.0, 0.0, 1.0);
    for m in 0..bands {
        let (mut before, mut legendre) = (0.0, sectoral);
        for l in m..bands {
            let factorials: f64 = (l - m + 1..=l + m).map(|i| i as f64).product();
            let k = ((2 * l + 1) as f64 / (4.0 * PI * factorials)).sqrt() * if m > 0 { 2f64.sqrt() } else { 1.0 };
            values[l * l + l + m] = k * legendre * re;
            if m > 0 {
                values[l * l + l - m] = k * legendre * im;
            }
            let next = (z * (2 * l + 1) as f64 * legendre - (l + m) as f64 * before) / (l + 1 - m) as f64;
            (before, legendre) = (legendre, next);
        }
        (re, im) = (re * x - im * y, re * y + im * x);
        sectoral *= -((2 * m + 1) as f64);
    }
    values
}

/// Wigner's d^l_{m k}(β), by its sum.
fn wigner(l: i64, m: i64, k: i64, beta: f64) -> f64 {
    let factorial = |n: i64| (1..=n).map(|i| i as f64).product::<f64>();
    let root = (factorial(l + m) * factorial(l - m) * factorial(l + k) * factorial(l - k)).sqrt();
    let (s, c) = (beta / 2.0).sin_cos();
    (0.max(k - m)..=(l + k).min(l - m))
        .map(|j| {
            let sign = if (m - k + j) % 2 == 0 { 1.0 } else { -1.0 };
            let below = factorial(l + k - j) * factorial(j) * factorial(m - k + j) * factorial(l - m - j);
            sign * root / below * c.powi((2 * l + k - m - 2 * j) as i32) * s.powi((m - k + 2 * j) as i32)
        })
        .sum()
}

/// A function's coefficients as seen in a frame turned about y by β: f'(ω) = f(R_y(β) ω), by Wigner's d, exact.
pub fn tilt(bands: usize, coefficients: &[f64], beta: f64) -> Vec<f64> {
    let mut tilted = vec![0.0; bands * bands];
    for l in 0..bands as i64 {
        let at = |m: i64| (l * l + l + m) as usize;
        // Real harmonics: cosines and sines do not mix. (-1)^m as harmonics have it.
        let parity = |m: i64| if m % 2 == 0 { 1.0 } else { -1.0 };
        for m in 0..=l {
            for k in 0..=l {
                let (same, other) = (wigner(l, k, m, beta), wigner(l, k, -m, beta) * parity(m));
                let half = |m: i64| if m == 0 { 0.5f64.sqrt() } else { 1.0 };
                let both = half(m) * half(k);
                tilted[at(m)] += both * (same + other) * coefficients[at(k)];
                if m > 0 && k > 0 {
                    tilted[at(-m)] += (same - other) * coefficients[at(-k)];
                }
            }
        }
    }
    tilted
}

fn direction(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::new(x, y, z).normalize()
}

/// R_y(β) d.
pub fn turned(d: DVec3, beta: f64) -> DVec3 {
    let (s, c) = beta.sin_cos();
    DVec3::new(c * d.x + s * d.z, d.y, c * d.z - s * d.x)
}

/// Rotating coefficients is rotating the function, point by point, and rotations compose.
#[test]
fn spherical_harmonics_rotate_exactly() {
    let bands = 20;
    let f: Vec<f64> = (0..bands * bands).map(|i| ((i * 37) as f64).sin()).collect();
    let value = |f: &[f64], d| spherical(bands, d).iter().zip(f).map(|(y, f)| y * f).sum::<f64>();
    for beta in [0.1, 0.7, -1.3] {
        let g = tilt(bands, &f, beta);
        for d in [direction(0.3, 0.4, 0.9), direction(-0.7, 0.2, -0.1), direction(0.1, -0.9, 0.4)] {
            let (rotated, exact) = (value(&g, d), value(&f, turned(d, beta)));
            assert!((rotated - exact).abs() < 1e-9, "{beta} {d}: {rotated} {exact}");
        }
    }
    let (once, twice) = (tilt(bands, &f, 1.1), tilt(bands, &tilt(bands, &f, 0.4), 0.7));
    assert!(once.iter().zip(twice).all(|(a, b)| (a - b).abs() < 1e-9));
}

/// Gautron 2004 eq. 18 and the matrix printed after it. What is printed has spherical harmonics in rows, hemispherical ones in
/// columns, and another weight: 2 cos θ, as cosine-distributed samples give that are summed as if they were uniform.
#[test]
fn the_conversion_matrix_is_that_of_the_paper() {
    #[rustfmt::skip]
    let printed = [
        [0.71, 0.0, 0.41, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.60, 0.0, 0.0, 0.0, 0.19, 0.0, 0.0, 0.0],
        [0.82, 0.0, 0.71, 0.0, 0.0, 0.0, 0.18, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.60, 0.0, 0.0, 0.0, 0.19, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.53, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.77, 0.0, 0.0, 0.0, 0.51, 0.0, 0.0, 0.0],
        [0.40, 0.0, 0.78, 0.0, 0.0, 0.0, 0.53, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.77, 0.0, 0.0, 0.0, 0.51, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.53],
    ];
    let (mut weighted, mut exact) = ([[0.0; 9]; 9], [[0.0; 9]; 9]);
    for (d, weight) in hemisphere(200) {
        let (h, y) = (harmonics::<9>(d), spherical(3, d));
        for (i, j) in (0..81).map(|i| (i / 9, i % 9)) {
            weighted[i][j] += 2.0 * d.z * weight * y[i] * h[j];
            exact[i][j] += weight * y[i] * h[j];
        }
    }
    for (row, printed) in weighted.iter().zip(&printed) {
        for (value, printed) in row.iter().zip(printed) {
            assert!((value - printed).abs() < 0.005, "{value} {printed}");
        }
    }
    // Without the weight it converts what both bases can tell: here the cosine.
    let cosine = |d: DVec3| (0..9).map(|j| exact[2][j] * harmonics::<9>(d)[j]).sum::<f64>() * (4.0 * PI / 3.0).sqrt();
    for (d, _) in hemisphere(4) {
        assert!((cosine(d) - d.z).abs() < 1e-9);
    }
}

/// Gautron 2004, Figure 4: for a Phong lobe of exponent 5 hemispherical harmonics hold more of the energy than as many
/// spherical ones.
#[test]
fn more_of_a_phong_lobe_is_captured_than_by_spherical_harmonics() {
    for tilt in [0.0f64, 0.5, 1.0] {
        let axis = DVec3::new(tilt.sin(), 0.0, tilt.cos());
        let (mut own, mut spherical_sums, mut energy) = ([0.0; COEFFICIENTS_MAX], vec![0.0; COEFFICIENTS_MAX], 0.0);
        for (d, weight) in hemisphere(100) {
            let f = d.dot(axis).max(0.0).powi(5);
            energy += weight * f * f;
            let (h, y) = (harmonics::<COEFFICIENTS_MAX>(d), spherical(ORDER_MAX, d));
            (0..COEFFICIENTS_MAX).for_each(|i| own[i] += weight * f * h[i]);
            (0..COEFFICIENTS_MAX).for_each(|i| spherical_sums[i] += weight * f * y[i]);
        }
        for order in 2..=ORDER_MAX {
            let share = |sums: &[f64]| sums[..order * order].iter().map(|c| c * c).sum::<f64>() / energy;
            let (own, other) = (share(&own), share(&spherical_sums));
            eprintln!("lobe at {tilt}, order {order}: {own:.4}, spherical {other:.4}");
            assert!(own > other && own < 1.0 + 1e-9, "{tilt} {order}: {own} {other}");
        }
    }
}
