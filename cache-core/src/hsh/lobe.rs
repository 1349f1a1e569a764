//! Glossy lobes in harmonics, and which of them an order can tell (Krivanek et al. 2005, 4.1).
//!
//! A lobe is BRDF times cosine, one number for a pair of directions, the same wherever the pair is turned about the normal and
//! if it is mirrored at a plane through it: the isotropic models. Colours are the caller's: a lobe that changes colour with the
//! angle is a sum of such lobes times colours.

use std::f64::consts::PI;

use glam::{DVec3, Vec2, Vec3};

use super::{COEFFICIENTS_MAX, Gauss, ORDER_MAX, harmonics, order};

/// Tabulated outgoing elevations, evenly spaced in tan(θ/2) from the normal to the horizon (as parabolic maps are).
const ROWS: usize = 65;

/// Nodes of the rule a lobe is integrated by, along each angle of half a hemisphere: lobes down to some 2 degrees wide.
const NODES: usize = 96;

/// A lobe's coefficients for each outgoing elevation.
#[derive(Clone, Debug)]
pub struct Lobe {
    rows: Vec<Row>,
}

/// One outgoing direction, at azimuth 0: there are no sines.
#[derive(Clone, Copy, Debug)]
struct Row {
    /// ∫ f H dω_i, 1/√sr.
    coefficients: [f32; COEFFICIENTS_MAX],
    /// ∫ f² dω_i, 1/sr.
    energy: f32,
    /// Of that, what each order from 1 misses (Gautron 2004 eq. 15), 1/sr.
    missed: [f32; ORDER_MAX],
}

impl Lobe {
    /// The lobe `f` of unit directions (outgoing, incoming), local, z along the normal; BRDF times incoming cosine, 1/sr.
    pub fn new(f: impl Fn(Vec3, Vec3) -> f32) -> Self {
        let outgoing: Vec<_> = (0..ROWS)
            .map(|row| {
                // Light leaves along the surface only in the limit.
                let r = (row as f32 / (ROWS - 1) as f32).min(0.999);
                Vec3::new(2.0 * r, 0.0, 1.0 - r * r) / (1.0 + r * r)
            })
            .collect();
        let mut sums = vec![([0.0; COEFFICIENTS_MAX], 0.0); ROWS];
        let rule = Gauss::new(NODES);
        for (z, height) in rule.on(0.0, 1.0) {
            let s = (1.0 - z * z).sqrt();
            for (phi, width) in rule.on(0.0, PI) {
                let d = DVec3::new(s * libm::cos(phi), s * libm::sin(phi), z);
                let h = harmonics::<COEFFICIENTS_MAX>(d);
                for (outgoing, (coefficients, energy)) in outgoing.iter().zip(&mut sums) {
                    let value = f64::from(f(*outgoing, d.as_vec3()));
                    // Twice, for the other half, which takes from the sines what this one brings.
                    let weight = 2.0 * height * width * value;
                    *energy += weight * value;
                    coefficients.iter_mut().zip(&h).for_each(|(sum, h)| *sum += weight * h);
                }
            }
        }
        let rows = sums.into_iter().map(|(coefficients, energy)| Row::new(coefficients, energy));
        Self { rows: rows.collect() }
    }

    /// Its coefficients for an outgoing direction, local, in the order of [`harmonics`]; interpolated.
    #[inline]
    pub fn coefficients<const N: usize>(&self, outgoing: Vec3) -> [f32; N] {
        let order = const { order(N) };
        let (row, share) = place(outgoing.z);
        let [here, next] = [&self.rows[row].coefficients, &self.rows[row + 1].coefficients];
        let azimuth = Vec2::new(outgoing.x, outgoing.y).normalize_or(Vec2::X);
        let mut coefficients = [0.0; N];
        let mut multiple = Vec2::X;
        for m in 0..order {
            for l in m..order {
                let (plus, minus) = (l * l + l + m, l * l + l - m);
                let value = here[plus] + (next[plus] - here[plus]) * share;
                coefficients[minus] = value * multiple.y;
                coefficients[plus] = value * multiple.x;
            }
            multiple = azimuth.rotate(multiple);
        }
        coefficients
    }

    /// ∫ f² dω_i where the outgoing direction has this cosine, and what of it an order misses, 1/sr; both interpolated.
    #[inline]
    pub fn energy(&self, cosine: f32, order: usize) -> (f32, f32) {
        let (row, share) = place(cosine);
        let [here, next] = [&self.rows[row], &self.rows[row + 1]];
        let between = |a: f32, b: f32| a + (b - a) * share;
        (between(here.energy, next.energy), between(here.missed[order - 1], next.missed[order - 1]))
    }
}

impl Row {
    fn new(mut sums: [f64; COEFFICIENTS_MAX], energy: f64) -> Self {
        (0..ORDER_MAX).for_each(|l| sums[l * l..l * l + l].fill(0.0));
        let missed = |i: usize| {
            let captured: f64 = sums[..(i + 1) * (i + 1)].iter().map(|c| c * c).sum();
            (energy - captured).max(0.0) as f32
        };
        let missed = std::array::from_fn(missed);
        Self { energy: energy as f32, missed, coefficients: sums.map(|sum| sum as f32) }
    }
}

/// Where an outgoing cosine lies between two rows.
#[inline]
fn place(cosine: f32) -> (usize, f32) {
    let z = cosine.clamp(0.0, 1.0);
    let at = ((1.0 - z) / (1.0 + z)).sqrt() * (ROWS - 1) as f32;
    let row = (at as usize).min(ROWS - 2);
    (row, at - row as f32)
}

#[cfg(test)]
mod tests {
    use super::super::tests::hemisphere;
    use super::*;

    /// Phong's lobe, as reflecting all light at normal incidence, times the cosine.
    fn phong(exponent: i32) -> impl Fn(Vec3, Vec3) -> f32 {
        move |outgoing, incoming| {
            let mirrored = Vec3::new(-outgoing.x, -outgoing.y, outgoing.z);
            let lobe = mirrored.dot(incoming).max(0.0).powi(exponent);
            lobe * incoming.z * (exponent + 2) as f32 / std::f32::consts::TAU
        }
    }

    fn outgoing(theta: f32, phi: f32) -> Vec3 {
        Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos())
    }

    /// Coefficients and energy by another rule over the whole hemisphere, for one outgoing direction itself.
    fn exact<const N: usize>(f: impl Fn(Vec3, Vec3) -> f32, outgoing: Vec3) -> ([f64; N], f64) {
        let (mut sums, mut energy) = ([0.0; N], 0.0);
        for (d, weight) in hemisphere(160) {
            let value = f64::from(f(outgoing, d.as_vec3()));
            energy += weight * value * value;
            sums.iter_mut().zip(harmonics::<N>(d)).for_each(|(sum, h)| *sum += weight * value * h);
        }
        (sums, energy)
    }

    #[test]
    fn coefficients_are_those_of_the_lobe_at_any_outgoing_direction() {
        for exponent in [1, 5, 22, 60] {
            let lobe = Lobe::new(phong(exponent));
            for out in [outgoing(0.0, 0.0), outgoing(0.37, 1.0), outgoing(0.9, -2.1), outgoing(1.4, 4.0)] {
                let (exact, _) = exact::<100>(phong(exponent), out);
                let table = lobe.coefficients::<100>(out);
                let size = exact.iter().map(|e| e * e).sum::<f64>();
                let off = exact.iter().zip(table).map(|(e, t)| (e - f64::from(t)).powi(2)).sum::<f64>();
                let error = (off / size).sqrt();
                eprintln!("Phong {exponent} at {out}: table off by {error:.1e}");
                assert!(error < 0.01, "{exponent} {out}: {error}");
                assert_eq!(lobe.coefficients::<16>(out), table[..16], "a smaller order is the beginning");
            }
        }
    }

    /// Light reflected by dot product is light reflected by the integral.
    #[test]
    fn reflected_light_is_the_dot_product() {
        let light = |d: DVec3| 2.0 + d.x - 0.5 * d.y * d.z + d.x * d.x;
        let mut incoming = [[0.0f32; 100]; 3];
        for (d, weight) in hemisphere(64) {
            let h = harmonics::<100>(d);
            incoming[1].iter_mut().zip(h).for_each(|(sum, h)| *sum += (weight * h * light(d)) as f32);
        }
        let lobe = Lobe::new(phong(10));
        for out in [outgoing(0.2, 1.0), outgoing(1.0, -2.1)] {
            let exact: f64 = hemisphere(100).map(|(d, w)| w * light(d) * f64::from(phong(10)(out, d.as_vec3()))).sum();
            let reflected = crate::radiance::reflected(&[lobe.coefficients(out); 3], &incoming);
            assert!((f64::from(reflected.y) / exact - 1.0).abs() < 0.005, "{out}: {reflected} {exact}");
            assert_eq!((reflected.x, reflected.z), (0.0, 0.0));
        }
    }

    /// Least order that misses at most the fraction `error` of the energy, if one does.
    fn least(lobe: &Lobe, cosine: f32, error: f32) -> Option<usize> {
        (1..=ORDER_MAX).find(|order| {
            let (energy, missed) = lobe.energy(cosine, *order);
            missed <= error * energy
        })
    }

    #[test]
    fn sharper_lobes_need_higher_orders_until_none_suffices() {
        let needed = |error: f32| {
            [1, 2, 5, 10, 22, 50, 100, 400].map(|exponent| {
                let lobe = Lobe::new(phong(exponent));
                [0.0f32, 45.0, 75.0].map(|angle| least(&lobe, angle.to_radians().cos(), error))
            })
        };
        let five = needed(0.05);
        eprintln!("orders at 5 %, at 0, 45 and 75 degrees: {five:?}");
        eprintln!("orders at 1 %: {:?}", needed(0.01));
        let rank = |order: Option<usize>| order.unwrap_or(ORDER_MAX + 1);
        for angle in 0..3 {
            assert!(five.iter().is_sorted_by_key(|orders| rank(orders[angle])), "{five:?}");
        }
        assert_eq!(five[7], [None; 3]);
        // The least order indeed.
        let (out, least) = (outgoing(45f32.to_radians(), 0.0), rank(five[3][1]));
        let (coefficients, energy) = exact::<100>(phong(10), out);
        let missed = |order: usize| 1.0 - coefficients[..order * order].iter().map(|c| c * c).sum::<f64>() / energy;
        assert!(missed(least) <= 0.05 && missed(least - 1) > 0.05, "{least}: {}", missed(least - 1));
    }

    #[test]
    fn a_diffuse_lobe_has_two_bands() {
        let lobe = Lobe::new(|_, incoming| incoming.z / PI as f32);
        for cosine in [1.0, 0.5, 0.0] {
            assert_eq!(least(&lobe, cosine, 1e-6), Some(2));
        }
        let dark = Lobe::new(|_, _| 0.0);
        assert_eq!(least(&dark, 0.5, 0.0), Some(1));
    }
}
