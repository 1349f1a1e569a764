//! What the papers say of single gathers and records, held against exact answers and finite differences.

use cache_core::details::{Details, Gradients};
use cache_core::hemisphere::{Cells as _, Estimate, Sample, Strata};
use cache_core::id::Random;
use cache_core::{Irradiance, Query, RecordId, Rgb, Sealed};
use glam::{Vec2, Vec3};

/// Gathers at a point of the plane z = 0 in a world given by (origin, direction) -> (radiance, distance); the same jitter
/// everywhere, so that differences between points are those of the light.
fn gather(seed: u64, rays: u32, details: &Details, from: Vec2, world: impl Fn(Vec3, Vec3) -> (f32, f32)) -> Estimate {
    let strata = Strata::new(rays);
    let mut random = Random::named("papers", &[seed]);
    let samples: Vec<_> = (0..strata.rays())
        .map(|cell| {
            let direction = strata.direction(cell, Vec2::new(random.uniform(), random.uniform()));
            let (radiance, distance) = world(from.extend(0.0), direction);
            Sample { direction, radiance: Rgb::splat(radiance), distance }
        })
        .collect();
    strata.estimate(&samples, details)
}

/// A ball of radiance 1 and radius 0.5 above the plane, in a dark room so large that nothing else counts.
const HEIGHT: f32 = 1.5;
const RADIUS: f32 = 0.5;

fn ball(origin: Vec3, direction: Vec3) -> (f32, f32) {
    let offset = origin - Vec3::new(0.0, 0.0, HEIGHT);
    let b = offset.dot(direction);
    let root = b * b - offset.length_squared() + RADIUS * RADIUS;
    if root > 0.0 && b < 0.0 { (1.0, -b - root.sqrt()) } else { (0.0, 100.0) }
}

/// Its irradiance at a distance x from the point below: π r² h / (x² + h²)^(3/2).
fn below(x: f32) -> f64 {
    let (x, h, r) = (f64::from(x), f64::from(HEIGHT), f64::from(RADIUS));
    std::f64::consts::PI * r * r * h / (x * x + h * h).powf(1.5)
}

/// Slope of the logarithm of `y` over that of `x`, by least squares.
fn order(points: &[(f64, f64)]) -> f64 {
    let logs: Vec<_> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let n = logs.len() as f64;
    let (mx, my) = (logs.iter().map(|p| p.0).sum::<f64>() / n, logs.iter().map(|p| p.1).sum::<f64>() / n);
    let slope = logs.iter().map(|(x, y)| (x - mx) * (y - my)).sum::<f64>();
    slope / logs.iter().map(|(x, _)| (x - mx) * (x - mx)).sum::<f64>()
}

/// Ward, Heckbert 1992: along a line under a ball a record without gradients errs in proportion to the distance, one with
/// them by a power more. (The paper speaks of a cubic error; from a record that is not right below the ball it is the square,
/// as for any function that is not odd about it.)
#[test]
fn gradients_raise_the_order_of_the_error() {
    let at = |gradients| {
        let details = Details { gradients, ..Details::default() };
        let site = 0.25f32;
        let e = gather(1, 1_000_000, &details, Vec2::new(site, 0.0), ball);
        let record = Irradiance {
            id: RecordId(1),
            position: Vec3::new(site, 0.0, 0.0),
            normal: Vec3::Z,
            radius: 100.0,
            radius_min: 100.0,
            radius_max: 100.0,
            irradiance: e.irradiance,
            // The tangents of z are x and y.
            gradient_t: e.gradient_t,
            gradient_r: e.gradient_r,
            ellipse: [0.0; 3],
            noise: 0.0,
        };
        let mut sealed = Sealed::with(1.0, Details { gradient_by_radius: false, ..details });
        sealed.extend([record]);
        let own = f64::from(e.irradiance.x) / below(site);
        let errors = [0.1f32, 0.15, 0.2, 0.3].map(|d| {
            let answer = sealed.ask(&Query::new(Vec3::new(site + d, 0.0, 0.0), Vec3::Z)).expect("counts");
            // What the gather itself is off by says nothing of extrapolation.
            (f64::from(d), (f64::from(answer.irradiance.x) / own / below(site + d) - 1.0).abs())
        });
        println!("{gradients:?}: relative errors {errors:?}, order {:.2}", order(&errors));
        (order(&errors), errors[3].1)
    };
    let (without, with) = (at(Gradients::None), at(Gradients::Borders));
    assert!((0.8..1.4).contains(&without.0), "{without:?}");
    assert!(with.0 > 1.8 && with.1 < 0.3 * without.1, "{with:?} {without:?}");
}

/// Ward, Heckbert 1992, and the two other estimators: gradients of random triangles are those of finite differences.
#[test]
fn gradients_of_triangle_soups_are_finite_differences() {
    let mut random = Random::named("soup", &[7]);
    for soup in 0..3 {
        // Apart from each other, and none seen so much from its edge that both its borders lie in one cell.
        let mut triangle = |i: u8| loop {
            let mut point = || Vec3::new(random.uniform(), random.uniform(), random.uniform()) - 0.5;
            let cell = Vec3::new(f32::from(i % 4) - 1.5, f32::from(i / 4) - 1.0, 0.0) * 1.4 + Vec3::Z * 1.5;
            let middle = cell + point() * 0.5;
            let [a, b, c] = [0; 3].map(|_| middle + point());
            if (b - a).cross(c - a).normalize().dot(a.normalize()).abs() > 0.3 {
                return ([a, b, c], 1.0 + 3.0 * random.uniform());
            }
        };
        let triangles: Vec<([Vec3; 3], f32)> = (0..12).map(&mut triangle).collect();
        let world = |origin: Vec3, direction: Vec3| {
            let mut nearest = (0.05, 40.0);
            for (corners, radiance) in &triangles {
                nearest = match hit(origin, direction, corners) {
                    Some(t) if t < nearest.1 => (*radiance, t),
                    _ => nearest,
                };
            }
            nearest
        };
        let details = |gradients| Details { gradients, ..Details::default() };
        let irradiance =
            |x: f32, y: f32| gather(1, 1_000_000, &details(Gradients::None), Vec2::new(x, y), world).irradiance.x;
        let step = 0.04;
        let difference =
            Vec2::new(irradiance(step, 0.0) - irradiance(-step, 0.0), irradiance(0.0, step) - irradiance(0.0, -step))
                / (2.0 * step);
        let scale = irradiance(0.0, 0.0);
        for gradients in [Gradients::Borders, Gradients::Mesh, Gradients::Samples] {
            // Both borders of a thin slanting triangle nearly cancel: cells must be small against it.
            let one = |seed| gather(seed, 1_000_000, &details(gradients), Vec2::ZERO, world).gradient_t[0];
            let gradient = (one(2) + one(3)) * 0.5;
            let off = (gradient - difference).length();
            println!("soup {soup}, {gradients:?}: {gradient}, differences {difference}, E {scale}: off by {off}");
            assert!(off < 0.06 * difference.length() + 0.02 * scale, "soup {soup}, {gradients:?}");
        }
    }
}

/// Distance to a triangle along a ray, if it is met.
fn hit(origin: Vec3, direction: Vec3, [a, b, c]: &[Vec3; 3]) -> Option<f32> {
    let (e, f) = (b - a, c - a);
    let p = direction.cross(f);
    let determinant = e.dot(p);
    let s = (origin - a) / determinant;
    let q = s.cross(e);
    let (u, v, t) = (s.dot(p), direction.dot(q), f.dot(q));
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0).then_some(t)
}
