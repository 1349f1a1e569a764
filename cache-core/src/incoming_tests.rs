use glam::DVec3;

use super::*;
use crate::hemisphere::Strata;
use crate::id::Random;

type World = fn(Vec3, Vec3) -> (f32, f32);

/// A square lamp above, off the middle, before a far dark wall.
fn lamp(from: Vec3, d: Vec3) -> (f32, f32) {
    let at = from + d * (1.0 / d.z.max(1e-6));
    let on = (at.x - 0.8).abs() < 0.4 && (at.y + 0.3).abs() < 0.5 && d.z > 1e-6;
    (f32::from(on), if on { 1.0 / d.z } else { 50.0 })
}

/// Seen from a point inside a unit sphere whose half x > 0 is bright.
fn half_lit_sphere(from: Vec3, direction: Vec3) -> (f32, f32) {
    let b = from.dot(direction);
    let t = -b + (b * b + 1.0 - from.length_squared()).sqrt();
    (f32::from((from + t * direction).x > 0.0), t)
}

fn furnace(_: Vec3, _: Vec3) -> (f32, f32) {
    (1.0, 2.0)
}

fn samples(cells: &Bands, seed: u64, world: World, from: Vec3) -> Vec<Sample> {
    let mut random = Random::named("incoming", &[seed]);
    let mut sample = |i| {
        let direction = cells.direction(i, Vec2::new(random.uniform(), random.uniform()));
        let (radiance, distance) = world(from, direction);
        Sample { direction, radiance: Rgb::new(1.0, 0.5, 0.0) * radiance, distance }
    };
    (0..cells.rays()).map(&mut sample).collect()
}

fn gather<const N: usize>(rays: u32, seed: u64, world: World, from: Vec3) -> Estimate<N> {
    let cells = Bands::new(rays);
    cells.estimate(&samples(&cells, seed, world, from), &Details::default())
}

fn norm<const N: usize>(c: &[f32; N]) -> f32 {
    c.iter().map(|v| v * v).sum::<f32>().sqrt()
}

fn distance<const N: usize>(a: &[f32; N], b: &[f32; N]) -> f32 {
    norm(&std::array::from_fn::<f32, N, _>(|i| a[i] - b[i]))
}

fn off<const N: usize>(a: &[f32; N], b: &[f32; N]) -> f32 {
    distance(a, b) / norm(b)
}

/// Coefficients of the first channel by brute force, and their derivatives by finite differences of it.
fn exact<const N: usize>(world: World) -> ([f32; N], [[f32; N]; 2]) {
    let at = |from: Vec3| {
        let mut sum = [0.0f64; N];
        let (rings, sectors) = (600, 2400);
        for i in 0..rings * sectors {
            let z = (f64::from(i / sectors) + 0.5) / f64::from(rings);
            let phi = std::f64::consts::TAU * (f64::from(i % sectors) + 0.5) / f64::from(sectors);
            let s = (1.0 - z * z).sqrt();
            let d = DVec3::new(s * phi.cos(), s * phi.sin(), z);
            let light = f64::from(world(from, d.as_vec3()).0);
            if light > 0.0 {
                let weight = light * std::f64::consts::TAU / f64::from(rings * sectors);
                sum.iter_mut().zip(harmonics::<N>(d)).for_each(|(sum, h)| *sum += weight * h);
            }
        }
        sum
    };
    const STEP: f32 = 0.05;
    let difference = |axis: Vec3| {
        let (ahead, behind) = (at(axis * STEP), at(axis * -STEP));
        std::array::from_fn(|i| ((ahead[i] - behind[i]) / f64::from(2.0 * STEP)) as f32)
    };
    (at(Vec3::ZERO).map(|v| v as f32), [difference(Vec3::X), difference(Vec3::Y)])
}

#[test]
fn a_white_furnace_is_its_mean_and_has_no_gradients() {
    let e = gather::<36>(4096, 1, furnace, Vec3::ZERO);
    assert!((e.coefficients[0][0] - TAU.sqrt()).abs() < 1e-6);
    assert_eq!(e.coefficients[2], [0.0; 36]);
    assert!(e.coefficients[0][1..].iter().all(|c| c.abs() < 0.02), "{:?}", e.coefficients[0]);
    assert!(e.gradient.as_flattened().as_flattened().iter().all(|g| g.abs() < 1e-4));
    assert!((e.radius - 2.0).abs() < 1e-5 && e.noise == 0.0);
}

#[test]
fn coefficients_and_derivatives_agree_with_finite_differences() {
    for (name, world) in [("lamp", lamp as World), ("half-lit sphere", half_lit_sphere)] {
        let (value, [x, y]) = exact::<36>(world);
        let e = gather::<36>(90_000, 1, world, Vec3::ZERO);
        // Of the derivative along x: along y nothing changes in the half-lit sphere.
        let value = off(&e.coefficients[0], &value);
        let errors = [value, off(&e.gradient[0][0], &x), distance(&e.gradient[1][0], &y) / norm(&x)];
        eprintln!("{name}: Λ and its derivatives off by {errors:?}");
        assert!(errors[0] < 0.003 && errors[1] < 0.02 && errors[2] < 0.02, "{name}: {errors:?}");
        // Channels keep apart.
        let half = std::array::from_fn(|i| e.gradient[0][0][i] * 0.5);
        assert!(off(&e.gradient[0][1], &half) < 1e-4 && e.gradient[0][2] == [0.0; 36]);
    }
}

/// The formula as printed: harmonics where the samples lie.
fn printed<const N: usize>(cells: &Bands, samples: &[Sample]) -> [[f32; N]; 2] {
    let n = cells.sectors.len();
    let mut sum = [[0.0; N]; 2];
    let mut add = |along: Vec2, here: &Sample, beside: &Sample, speed: f32| {
        let change = change(here, beside).x * speed;
        let h = harmonics::<N>(here.direction.as_dvec3());
        (0..N).for_each(|i| (0..2).for_each(|a| sum[a][i] += along[a] * change * h[i] as f32));
    };
    for (i, here) in samples.iter().enumerate() {
        let (j, k) = (i / n, i % n);
        if j > 0 {
            add(cells.sectors[k].middle[1], here, &samples[i - n], cells.rings[j].border.1);
        }
        let sine = (1.0 - here.direction.z * here.direction.z).sqrt();
        let before = &samples[j * n + (k + n - 1) % n];
        add(cells.sectors[k].border[1].perp(), here, before, 1.0 / (sine * cells.polar as f32));
    }
    sum
}

#[test]
fn harmonics_where_borders_move_come_nearer_than_as_printed() {
    for (name, world) in [("lamp", lamp as World), ("half-lit sphere", half_lit_sphere)] {
        let (_, [x, _]) = exact::<36>(world);
        let cells = Bands::new(1000);
        let (mut own, mut other) = (0.0, 0.0);
        for seed in 0..50 {
            let samples = samples(&cells, seed, world, Vec3::ZERO);
            let e: Estimate<36> = cells.estimate(&samples, &Details::default());
            own += off(&e.gradient[0][0], &x) / 50.0;
            other += off(&printed::<36>(&cells, &samples)[0], &x) / 50.0;
        }
        eprintln!("{name}: derivative off by {own:.3}, as printed by {other:.3}");
        assert!(own < other, "{name}: {own} {other}");
    }
}

/// Both rooms tell the same irradiance, and the same gradient of it.
#[test]
fn irradiance_of_the_coefficients_is_that_of_a_gather_of_its_own() {
    for world in [lamp as World, half_lit_sphere] {
        let e = gather::<4>(90_000, 1, world, Vec3::ZERO);
        let strata = Strata::new(90_000);
        let mut random = Random::named("strata", &[]);
        let mut sample = |i| {
            let direction = strata.direction(i, Vec2::new(random.uniform(), random.uniform()));
            let (radiance, distance) = world(Vec3::ZERO, direction);
            Sample { direction, radiance: Rgb::new(1.0, 0.5, 0.0) * radiance, distance }
        };
        let samples: Vec<_> = (0..strata.rays()).map(&mut sample).collect();
        let other = strata.estimate(&samples, &Details::default());
        let (own, exact) = (irradiance(&e.coefficients), other.irradiance);
        assert!((own - exact).length() < 0.01 * exact.length(), "{own} {exact}");
        let own = e.gradient.map(|g| irradiance(&g).x);
        let exact = other.gradient_t[0];
        assert!((Vec2::from(own) - exact).length() < 0.03 * exact.length(), "{own:?} {exact}");
        // Then R is limited alike.
        let by_gradient = other.irradiance.element_sum() / other.gradient_t.iter().sum::<Vec2>().length();
        assert!(e.radius < by_gradient * 1.03 && (by_gradient > 1.0 || e.radius > by_gradient * 0.97), "{}", e.radius);
    }
}

/// What coefficients of many gathers scatter by, with samples that are noisy themselves.
#[test]
fn the_noise_told_is_the_noise_met() {
    let cells = Bands::new(400);
    let estimates: Vec<Estimate<16>> = (0..400u64)
        .map(|seed| {
            let mut random = Random::named("noise", &[seed]);
            let mut samples = samples(&cells, seed, furnace, Vec3::ZERO);
            samples.iter_mut().for_each(|s| s.radiance = Rgb::splat(random.uniform() * (1.0 + s.direction.x)));
            cells.estimate(&samples, &Details::default())
        })
        .collect();
    // Of 16 coefficients together: each alone scatters by a little more or less.
    let (mut met, mut told) = (0.0, 0.0);
    for i in 0..16 {
        let mean = estimates.iter().map(|e| e.coefficients[0][i]).sum::<f32>() / 400.0;
        met += estimates.iter().map(|e| (e.coefficients[0][i] - mean).powi(2)).sum::<f32>() / 399.0;
        told += estimates.iter().map(|e| e.noise * e.noise).sum::<f32>() / 400.0;
    }
    let ratio = (told / met).sqrt();
    assert!((ratio - 1.0).abs() < 0.1, "{ratio}");
}

/// A gather whose frame is turned by some sectors has the same samples in other places.
#[test]
fn a_turned_frame_tells_the_same() {
    let cells = Bands::new(1000);
    let (n, turn) = (cells.sectors.len(), 5);
    let own = samples(&cells, 1, lamp, Vec3::ZERO);
    let angle = cells.sectors[turn].border[1];
    let turned: Vec<_> = (0..own.len())
        .map(|i| {
            let sample = own[i / n * n + (i + turn) % n];
            let around = Vec2::new(angle.x, -angle.y).rotate(Vec2::new(sample.direction.x, sample.direction.y));
            Sample { direction: around.extend(sample.direction.z), ..sample }
        })
        .collect();
    let own: Estimate<36> = cells.estimate(&own, &Details::default());
    let other: Estimate<36> = cells.estimate(&turned, &Details::default());
    let own = own.turned(angle);
    assert!(off(&other.coefficients[0], &own.coefficients[0]) < 1e-5);
    assert!(off(&other.gradient[0][0], &own.gradient[0][0]) < 1e-5);
    assert!(off(&other.gradient[1][0], &own.gradient[1][0]) < 1e-5);
}

#[test]
fn two_gathers_together_count_by_their_rays() {
    let (one, other) = (gather::<16>(300, 1, lamp, Vec3::ZERO), gather::<16>(100, 2, lamp, Vec3::ZERO));
    let both = one.united(300.0, &other, 100.0);
    let mean = |a: f32, b: f32| 0.75 * a + 0.25 * b;
    for i in 0..16 {
        assert!((both.coefficients[1][i] - mean(one.coefficients[1][i], other.coefficients[1][i])).abs() < 1e-6);
        assert!((both.gradient[1][0][i] - mean(one.gradient[1][0][i], other.gradient[1][0][i])).abs() < 1e-6);
    }
    assert!((both.noise.powi(2) - mean(0.75 * one.noise.powi(2), 0.25 * other.noise.powi(2))).abs() < 1e-6);
    assert_eq!(both.radius, one.radius);
}
