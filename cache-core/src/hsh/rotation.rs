//! Coefficients seen from another frame: what a record says where the surface has turned (Gautron 2004, section 4).
//!
//! A turn about the normal is exact and cheap. A tilt is a matrix tabulated over the distance between both normals, between
//! whose entries it is interpolated. Where the tilted hemisphere looks below the record's horizon nothing is known:
//! there it sees what lies as far above it. So a furnace stays a furnace; Gautron's zeros would darken it.

use std::f64::consts::PI;
use std::sync::OnceLock;

use glam::{DVec3, Vec2};

use super::{Gauss, ORDER_MAX, harmonics, order};
use crate::math::Frame;

/// Greatest sqrt(1 - n·n_i) between two normals, some 69 degrees: beyond, one sees little of what the other saw.
pub const TURN_MAX: f32 = 0.8;

/// The same as a distance between unit normals.
const CHORD_MAX: f32 = TURN_MAX * std::f32::consts::SQRT_2;

/// Tabulated tilts, beside none at all: denser at small ones, where harmonics steep at the horizon make entries bend.
pub const STEPS: usize = 48;

/// Nodes of the rule a tilt is integrated by, along each piece of the hemisphere that no edge crosses.
const NODES: usize = 24;

/// From one tangent frame to another.
#[derive(Clone, Copy, Debug)]
pub struct Rotation {
    /// Cosine and sine of the azimuth towards which the normal tilts.
    from: Vec2,
    /// Distance between both normals.
    chord: f32,
    /// Cosine and sine of the azimuth the same direction, tilted, has in the new frame.
    to: Vec2,
}

impl Rotation {
    /// The one that turns what `from` sees into what `to` sees; farther than [`TURN_MAX`] it tilts no more.
    #[inline]
    pub fn between(from: &Frame, to: &Frame) -> Self {
        let chord = (to.z - from.z).length();
        let azimuth = from.tangential(to.z).normalize_or(Vec2::X);
        // Towards the tilt, perpendicular to the new normal.
        let towards = from.x * azimuth.x + from.y * azimuth.y;
        let tilted = to.tangential(towards - to.z * towards.dot(to.z)).normalize_or(Vec2::X);
        Self { from: azimuth, chord, to: tilted }
    }

    /// Rotates the coefficients of each channel.
    #[inline]
    pub fn apply<const N: usize>(&self, coefficients: &mut [[f32; N]; 3]) {
        coefficients.iter_mut().for_each(|c| turn(c, self.from));
        if self.chord > 0.0 {
            tilts::<N>().apply(self.chord, coefficients);
        }
        coefficients.iter_mut().for_each(|c| turn(c, Vec2::new(self.to.x, -self.to.y)));
    }
}

/// Turns the frame about its z axis by an angle given as (cosine, sine).
#[inline]
pub fn turn<const N: usize>(coefficients: &mut [f32; N], angle: Vec2) {
    let order = const { order(N) };
    let mut multiple = angle;
    for m in 1..order {
        for l in m..order {
            let (plus, minus) = (l * l + l + m, l * l + l - m);
            let (c, s) = (coefficients[plus], coefficients[minus]);
            coefficients[plus] = c * multiple.x + s * multiple.y;
            coefficients[minus] = s * multiple.x - c * multiple.y;
        }
        multiple = angle.rotate(multiple);
    }
}

/// The tilts of an order as others may interpolate them: at chord c the cubic through the four steps round
/// √(c / (√2 [`TURN_MAX`])) ([`STEPS`]).
pub struct Table {
    /// Coefficients with m ≥ 0, then those with m < 0: which each row and column of a matrix is.
    pub index: [&'static [usize]; 2],
    /// For each of both, the matrices of all steps 0..=[`STEPS`], each column by column.
    pub matrices: [&'static [f32]; 2],
}

/// The tilts of records of `N` coefficients.
pub fn table<const N: usize>() -> Table {
    let Tilts { even, odd } = tilts::<N>();
    Table { index: [&even.index, &odd.index], matrices: [&even.matrices, &odd.matrices] }
}

/// Tilts of one order. What is even in y (m ≥ 0) and what is odd (m < 0) stay apart.
struct Tilts {
    even: Blocks,
    odd: Blocks,
}

/// One of both parts.
struct Blocks {
    /// Which coefficients.
    index: Vec<usize>,
    /// A matrix for each step, column by column: what a coefficient brings to all others.
    matrices: Vec<f32>,
}

/// The table of an order, made when it is first wanted.
fn tilts<const N: usize>() -> &'static Tilts {
    const { assert!(N > 1, "one band has nothing to tilt") };
    static TILTS: [OnceLock<Tilts>; ORDER_MAX] = [const { OnceLock::new() }; ORDER_MAX];
    TILTS[const { order(N) } - 1].get_or_init(|| {
        let [even, odd] = parts(const { order(N) });
        let mut tilts = Tilts {
            even: Blocks { index: even, matrices: Vec::new() },
            odd: Blocks { index: odd, matrices: Vec::new() },
        };
        let rule = Gauss::new(NODES);
        for step in 0..=STEPS {
            let [even, odd] = tilt::<N>(&rule, f64::from(CHORD_MAX) * (step * step) as f64 / (STEPS * STEPS) as f64);
            tilts.even.matrices.extend(even.iter().map(|v| *v as f32));
            tilts.odd.matrices.extend(odd.iter().map(|v| *v as f32));
        }
        tilts
    })
}

/// Coefficients with m ≥ 0 and those with m < 0.
fn parts(order: usize) -> [Vec<usize>; 2] {
    let bands = |part: fn(usize) -> std::ops::Range<usize>| (0..order).flat_map(part).collect();
    [bands(|l| l * l + l..l * l + 2 * l + 1), bands(|l| l * l..l * l + l)]
}

impl Tilts {
    /// Cubic between the four nearest steps.
    #[inline]
    fn apply<const N: usize>(&self, chord: f32, coefficients: &mut [[f32; N]; 3]) {
        let at = (chord / CHORD_MAX).min(1.0).sqrt() * STEPS as f32;
        let first = (at as usize).clamp(1, STEPS - 2) - 1;
        let [a, b, c, d] = [0.0, 1.0, 2.0, 3.0].map(|step| at - first as f32 - step);
        let shares = [b * c * d / -6.0, a * c * d / 2.0, a * b * d / -2.0, a * b * c / 6.0];
        self.even.apply(first, shares, coefficients);
        self.odd.apply(first, shares, coefficients);
    }
}

impl Blocks {
    #[inline]
    fn apply<const N: usize>(&self, first: usize, shares: [f32; 4], coefficients: &mut [[f32; N]; 3]) {
        let count = self.index.len();
        let matrix = |step| self.matrices[(first + step) * count * count..].chunks_exact(count);
        let mut sums = [[0.0f32; N]; 3];
        let columns = matrix(0).zip(matrix(1)).zip(matrix(2)).zip(matrix(3));
        for ((((p, q), r), s), j) in columns.zip(&self.index) {
            let [red, green, blue] = [0, 1, 2].map(|c| coefficients[c][*j]);
            let [x, y, z] = &mut sums;
            for i in 0..count {
                let entry = p[i] * shares[0] + q[i] * shares[1] + r[i] * shares[2] + s[i] * shares[3];
                x[i] += entry * red;
                y[i] += entry * green;
                z[i] += entry * blue;
            }
        }
        for (c, sums) in coefficients.iter_mut().zip(&sums) {
            self.index.iter().zip(sums).for_each(|(i, sum)| c[*i] = *sum);
        }
    }
}

/// The tilt about y whose normals are `chord` apart: ∫ H_i(ω) H_j(R ω) dω, where R ω is mirrored at the horizon (after
/// Gautron 2004 eq. 14). Both parts, column by column.
fn tilt<const N: usize>(rule: &Gauss, chord: f64) -> [Vec<f64>; 2] {
    let cos = 1.0 - chord * chord / 2.0;
    let sin = (1.0 - cos * cos).max(0.0).sqrt();
    let parts = parts(const { order(N) });
    let mut matrices = parts.each_ref().map(|part| vec![0.0; part.len() * part.len()]);
    let mut node = |z: f64, phi: f64, weight: f64| {
        let s = (1.0 - z * z).max(0.0).sqrt();
        let d = DVec3::new(s * libm::cos(phi), s * libm::sin(phi), z);
        let seen = DVec3::new(cos * d.x + sin * d.z, d.y, (cos * d.z - sin * d.x).abs());
        let (rows, values) = (harmonics::<N>(d), harmonics::<N>(seen));
        for (part, matrix) in parts.iter().zip(&mut matrices) {
            let mut packed = [0.0; N];
            packed.iter_mut().zip(part).for_each(|(row, i)| *row = rows[*i]);
            for (column, j) in matrix.chunks_exact_mut(part.len()).zip(part) {
                let value = values[*j] * weight;
                column.iter_mut().zip(&packed).for_each(|(sum, row)| *sum += row * value);
            }
        }
    };
    // Half the hemisphere is enough, twice. Below the height `sin` the record's horizon crosses the circle.
    for (z, weight) in rule.on(sin, 1.0) {
        rule.on(0.0, PI).for_each(|(phi, width)| node(z, phi, 2.0 * weight * width));
    }
    for (z, weight) in rule.on(0.0, sin) {
        let edge = libm::acos((z * cos / ((1.0 - z * z).sqrt() * sin)).min(1.0));
        rule.on(0.0, edge).for_each(|(phi, width)| node(z, phi, 2.0 * weight * width));
        rule.on(edge, PI).for_each(|(phi, width)| node(z, phi, 2.0 * weight * width));
    }
    matrices
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::super::sh;
    use super::super::tests::hemisphere;
    use super::*;

    fn angle(chord: f64) -> f64 {
        2.0 * (chord / 2.0).asin()
    }

    fn noise<const N: usize>(seed: u64) -> [[f32; N]; 3] {
        let mut random = crate::id::Random::named("coefficients", &[seed]);
        std::array::from_fn(|_| std::array::from_fn(|_| random.uniform() - 0.5))
    }

    /// The tilt itself, whole.
    fn exact<const N: usize>(nodes: usize, chord: f64) -> Vec<[f64; N]> {
        let mut columns = vec![[0.0; N]; N];
        for (part, matrix) in parts(order(N)).iter().zip(tilt::<N>(&Gauss::new(nodes), chord)) {
            for (column, j) in matrix.chunks_exact(part.len()).zip(part) {
                column.iter().zip(part).for_each(|(value, i)| columns[*j][*i] = *value);
            }
        }
        columns
    }

    /// Less is lost there than by interpolation.
    #[test]
    fn tilts_are_integrated_by_nodes_enough() {
        for chord in [0.01, 0.2, 0.7, f64::from(CHORD_MAX)] {
            let error = distance(&exact::<100>(NODES, chord), &exact::<100>(3 * NODES, chord)).1;
            eprintln!("order 10, tilt {:.1} degrees: integrated but for {error:.1e}", angle(chord).to_degrees());
            assert!(error < 2e-3, "{error}");
        }
    }

    /// Frobenius distance of two matrices over the norm of the second, and the longest difference of two columns: what is
    /// made wrong of a harmonic of unit energy.
    fn distance<const N: usize>(one: &[[f64; N]], other: &[[f64; N]]) -> (f64, f64) {
        let norm = |c: &[f64; N]| c.iter().map(|v| v * v).sum::<f64>();
        let column = |(a, b): (&[f64; N], &[f64; N])| norm(&std::array::from_fn(|i| a[i] - b[i]));
        let (mut sum, mut worst) = (0.0, 0f64);
        for error in one.iter().zip(other).map(column) {
            (sum, worst) = (sum + error, worst.max(error));
        }
        ((sum / other.iter().map(norm).sum::<f64>()).sqrt(), worst.sqrt())
    }

    /// The tilt as rendering does it.
    fn fast<const N: usize>(chord: f64) -> Vec<[f64; N]> {
        (0..N)
            .map(|j| {
                let mut unit = [[0.0; N]; 3];
                unit[1][j] = 1.0;
                tilts::<N>().apply(chord as f32, &mut unit);
                assert!(unit[0].iter().chain(&unit[2]).all(|v| *v == 0.0), "channels do not mix");
                unit[1].map(f64::from)
            })
            .collect()
    }

    /// Conversion to spherical harmonics of `bands` bands, of what is mirrored at the horizon, and back (Gautron 2004 eq. 18).
    fn by_spherical<const N: usize>(bands: usize, chord: f64) -> Vec<[f64; N]> {
        let mut conversion = vec![[0.0; N]; bands * bands];
        for (d, weight) in hemisphere(64) {
            let (h, y) = (harmonics::<N>(d), sh::spherical(bands, d));
            for (row, y) in conversion.iter_mut().zip(y) {
                row.iter_mut().zip(h).for_each(|(sum, h)| *sum += weight * h * y);
            }
        }
        let mirrored = |j: usize| {
            // Y_l^m(x, y, -z) = (-1)^(l + m) Y_l^m: what is odd vanishes, what is even counts twice.
            let of = |l: usize| (l * l..(l + 1) * (l + 1)).map(move |i| (i, (i - l * l).is_multiple_of(2)));
            let even = (0..bands).flat_map(of);
            even.map(|(i, even)| if even { 2.0 * conversion[i][j] } else { 0.0 }).collect::<Vec<_>>()
        };
        (0..N)
            .map(|j| {
                let tilted = sh::tilt(bands, &mirrored(j), angle(chord));
                std::array::from_fn(|i| conversion.iter().zip(&tilted).map(|(row, t)| row[i] * t).sum())
            })
            .collect()
    }

    /// The more bands, the nearer: both exact routes meet.
    #[test]
    fn tilts_are_those_of_spherical_harmonics_with_many_bands() {
        for chord in [0.2, 0.7, f64::from(CHORD_MAX)] {
            let exact = exact::<16>(NODES, chord);
            let errors = [6, 12, 24].map(|bands| distance(&by_spherical::<16>(bands, chord), &exact).0);
            eprintln!("tilt {:.1} degrees, order 4 by 6, 12, 24 bands: {errors:?}", angle(chord).to_degrees());
            assert!(errors[1] < errors[0] / 5.0 && errors[2] < errors[1] / 5.0, "{errors:?}");
        }
    }

    fn fast_against_exact<const N: usize>() -> (f64, f64) {
        let mut worst = (0f64, 0f64);
        for i in 0..101 {
            // Between the steps too.
            let chord = f64::from(CHORD_MAX) * f64::from(i) / 100.0;
            let (mean, column) = distance(&fast::<N>(chord), &exact::<N>(2 * NODES, chord));
            worst = (worst.0.max(mean), worst.1.max(column));
        }
        eprintln!("order {}: fast tilt off by {:.1e} relative RMS, {:.1e} at worst", order(N), worst.0, worst.1);
        worst
    }

    #[test]
    fn the_fast_tilt_is_the_exact_one_as_far_as_records_count() {
        let worst = [fast_against_exact::<4>(), fast_against_exact::<16>(), fast_against_exact::<36>()];
        assert!(worst[0].1 < 1e-3 && worst[1].1 < 3e-3 && worst[2].1 < 6e-3, "{worst:?}");
        assert!(fast_against_exact::<100>().1 < 2e-2);
    }

    #[test]
    fn a_rotated_furnace_stays_a_furnace() {
        for normal in [Vec3::new(0.1, 0.0, 1.0), Vec3::new(-0.8, 0.3, 0.6), Vec3::new(0.2, -0.9, 0.5)] {
            let (from, to) = (Frame::around(Vec3::Z), Frame::around(normal.normalize()));
            let mut furnace = [[0.0f32; 36]; 3];
            furnace.iter_mut().zip([1.0, 2.0, 0.0]).for_each(|(c, light)| c[0] = light);
            let before = furnace;
            Rotation::between(&from, &to).apply(&mut furnace);
            let change = furnace.iter().flatten().zip(before.iter().flatten()).map(|(a, b)| (a - b).abs());
            assert!(change.fold(0.0, f32::max) < 1e-6, "{furnace:?}");
        }
    }

    /// The value of a function, rotated by frames, along one and the same world direction.
    #[test]
    fn a_rotated_function_is_the_same_seen_from_another_frame() {
        // Away from the horizon, and so low that a tilt needs no more bands: 1 + z² + x z.
        let light = |d: DVec3| 1.0 + d.z * d.z + d.x * d.z;
        let from = Frame::around(Vec3::new(0.3, -0.5, 0.8).normalize());
        let mut local = [0.0; 100];
        for (d, weight) in hemisphere(32) {
            let h = harmonics::<100>(d);
            local.iter_mut().zip(h).for_each(|(sum, h)| *sum += weight * h * light(d));
        }
        for normal in [Vec3::new(0.4, -0.5, 0.7), Vec3::new(0.2, -0.4, 0.9), Vec3::new(0.3, -0.5, 0.8)] {
            // A frame with any tangent.
            let around = Frame::around(normal.normalize());
            let to = Frame { x: around.x * 0.6 + around.y * 0.8, y: around.y * 0.6 - around.x * 0.8, z: around.z };
            let mut seen = [local.map(|v| v as f32); 3];
            Rotation::between(&from, &to).apply(&mut seen);
            for d in [Vec3::new(0.1, 0.2, 0.9), Vec3::new(-0.5, 0.1, 0.8), Vec3::new(0.3, 0.6, 0.7)] {
                let d = d.normalize();
                let value: f64 =
                    harmonics::<100>(d.as_dvec3()).iter().zip(seen[0]).map(|(h, c)| h * f64::from(c)).sum();
                let exact = light(from.to_local(to.to_world(d)).as_dvec3());
                assert!((value - exact).abs() < 0.02 * exact, "{normal} {d}: {value} {exact}");
            }
        }
    }

    #[test]
    fn rotations_compose() {
        let frame = |n: Vec3| Frame::around(n.normalize());
        let [a, b] = [0.4f32, 1.9].map(|t| Vec2::new(t.cos(), t.sin()));
        let mut turns = noise::<100>(1);
        let mut once = turns;
        turns.iter_mut().for_each(|c| [a, b].iter().for_each(|t| turn(c, *t)));
        once.iter_mut().for_each(|c| turn(c, a.rotate(b)));
        assert!(turns.iter().flatten().zip(once.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-5));
        // Tilts lose what goes below the horizon and beyond the order: of a lobe far from there next to nothing.
        let frames = [Vec3::new(0.0, 0.0, 1.0), Vec3::new(0.2, 0.1, 1.0), Vec3::new(0.3, -0.2, 1.0)].map(frame);
        let mut lobe = [[0.0f32; 100]; 3];
        for (d, weight) in hemisphere(32) {
            let h = harmonics::<100>(d);
            lobe[1].iter_mut().zip(h).for_each(|(sum, h)| *sum += (weight * h * d.z.powi(16)) as f32);
        }
        let to = |c: &[[f32; 100]; 3], from: usize, to: usize| {
            let mut c = *c;
            Rotation::between(&frames[from], &frames[to]).apply(&mut c);
            c
        };
        let off = |a: &[[f32; 100]; 3], b: &[[f32; 100]; 3]| {
            a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt()
        };
        let (direct, detour) = (to(&lobe, 0, 2), to(&to(&lobe, 0, 1), 1, 2));
        let back = to(&direct, 2, 0);
        let changed = off(&direct, &lobe);
        let errors = [off(&direct, &detour) / changed, off(&back, &lobe) / changed];
        eprintln!("two tilts against one, and there and back: {errors:?} of the change");
        assert!(errors[0] < 0.01 && errors[1] < 0.01, "{errors:?}");
    }

    /// What no record can know, the light below its horizon: with light mirrored there it comes nearer than with none.
    #[test]
    fn a_tilt_of_a_smooth_sky_loses_less_than_darkness_below_the_horizon() {
        let mut random = crate::id::Random::named("sky", &[]);
        for tilt in [0.1f64, 0.3, 0.7] {
            let (s, c) = (tilt.sin() as f32, tilt.cos() as f32);
            let from = Frame { x: Vec3::X, y: Vec3::Y, z: Vec3::Z };
            let to = Frame { x: Vec3::new(c, 0.0, -s), y: Vec3::Y, z: Vec3::new(s, 0.0, c) };
            let (mut own, mut dark, mut all) = (0.0, 0.0, 0.0);
            for _ in 0..20 {
                // A sky of four bands, everywhere positive but for chance.
                let sky: Vec<f64> =
                    (0..16).map(|i| if i == 0 { 4.0 } else { f64::from(random.uniform()) - 0.5 }).collect();
                let light = |d: DVec3| sh::spherical(4, d).iter().zip(&sky).map(|(y, s)| y * s).sum::<f64>();
                let mut sums = [[0.0; 36]; 3];
                for (d, weight) in hemisphere(32) {
                    let (h, seen) = (harmonics::<36>(d), sh::turned(d, tilt));
                    let known = if seen.z > 0.0 { light(seen) } else { 0.0 };
                    for (sums, value) in sums.iter_mut().zip([light(d), light(seen), known]) {
                        sums.iter_mut().zip(h).for_each(|(sum, h)| *sum += weight * h * value);
                    }
                }
                let [record, exact, known] = sums;
                let mut tilted = [record.map(|v| v as f32); 3];
                Rotation::between(&from, &to).apply(&mut tilted);
                all += exact.iter().map(|v| v * v).sum::<f64>();
                own += exact.iter().zip(tilted[0]).map(|(a, b)| (a - f64::from(b)).powi(2)).sum::<f64>();
                dark += exact.iter().zip(known).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
            }
            let [own, dark] = [own, dark].map(|v: f64| (v / all).sqrt());
            eprintln!("tilt {tilt} of a smooth sky: off by {own:.3}, with darkness below by {dark:.3}");
            assert!(own < 0.5 * dark);
        }
    }
}
