//! Rooms of many triangles, and rays in them: made up, the same every time.

use std::f32::consts::PI;

use cache_core::id::Random;
use cache_core::math::{Frame, sin_cos};
use glam::Vec3;

use crate::model::{Corners, sheet};

/// A ray of unit direction, and how far a shadow ray goes along it.
pub struct Ray {
    /// Just off a surface.
    pub origin: Vec3,
    /// Cosine-distributed about the surface's normal for closest hits.
    pub direction: Vec3,
    /// Length of the shadow ray.
    pub t_max: f32,
}

/// Height of the ground, and of what is on the balls, at a place: waves of shrinking length.
fn waves(at: Vec3) -> f32 {
    let wave = |k: f32, shift: f32| {
        let [x, y, z] = (at * k).to_array();
        sin_cos(x + shift).0 * sin_cos(y + 2.0 * shift).1 + sin_cos(z + 0.7 * shift).0
    };
    0.5 * wave(5.0, 0.3) + 0.25 * wave(13.0, 1.1) + 0.1 * wave(37.0, 2.3) + 0.04 * wave(101.0, 0.9)
}

/// A closed room, 4 x 4 x 2, with hilly ground and a dozen bumpy balls: about 80 000 `detail`² triangles.
pub fn room(detail: f32) -> Vec<Corners> {
    let cells = |n: f32| (n * detail).round() as u32;
    let mut soup = Vec::new();
    sheet(
        cells(128.0),
        cells(128.0),
        |s| {
            let at = Vec3::new(4.0 * s.x, 4.0 * s.y, 0.0);
            at.with_z(0.25 + 0.12 * waves(at))
        },
        &mut soup,
    );
    let mut random = Random::named("balls of a benchmark", &[]);
    for _ in 0..12 {
        let radius = 0.15 + 0.2 * random.uniform();
        let middle = Vec3::new(0.6 + 2.8 * random.uniform(), 0.6 + 2.8 * random.uniform(), 0.5 + random.uniform());
        sheet(
            cells(64.0),
            cells(32.0),
            |s| {
                let ((sin_phi, cos_phi), (sin, cos)) = (sin_cos(2.0 * PI * s.x), sin_cos(PI * (0.001 + 0.998 * s.y)));
                let out = Vec3::new(sin * cos_phi, sin * sin_phi, cos);
                middle + out * radius * (1.0 + 0.15 * waves(out + middle))
            },
            &mut soup,
        );
    }
    let corner = |i: usize| Vec3::new((i & 1) as f32 * 4.0, (i >> 1 & 1) as f32 * 4.0, (i >> 2) as f32 * 2.0);
    for side in [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]] {
        let [a, b, c, d] = side.map(corner);
        soup.extend([[a, b, c], [a, c, d]]);
    }
    soup
}

/// Incoherent rays, as gathers send them: from points of the surface into their hemispheres. Shadow rays go up to a
/// unit far.
pub fn rays(soup: &[Corners], count: usize) -> Vec<Ray> {
    let mut random = Random::named("rays of a benchmark", &[soup.len() as u64]);
    let mut next = || random.uniform();
    let ray = |_| {
        let [a, b, c] = soup[((next() * soup.len() as f32) as usize).min(soup.len() - 1)];
        let (s, t) = (next().sqrt(), next());
        let point = a * (1.0 - s) + b * (s * (1.0 - t)) + c * (s * t);
        let inwards = Vec3::new(2.0, 2.0, 1.0) - point;
        let normal = (b - a).cross(c - a).normalize_or(Vec3::Z);
        // Half of them look at the ground, half about.
        let normal = if normal.dot(inwards) < 0.0 { -normal } else { normal };
        let (u, (sin_phi, cos_phi)) = (next(), sin_cos(2.0 * PI * next()));
        let local = Vec3::new(u.sqrt() * cos_phi, u.sqrt() * sin_phi, (1.0 - u).max(1e-6).sqrt());
        let direction = Frame::around(normal).to_world(local).normalize();
        Ray { origin: point + normal * 1e-4, direction, t_max: next() }
    };
    (0..count).map(ray).collect()
}
