//! Triangles for curved surfaces, with smooth normals.
//!
//! The mesh is blown up a little so that its area is that of the true surface: an emitter keeps its power. Every corner
//! is computed once and shared, so that meshes are closed where the surface is.

use std::f64::consts::PI;
use std::sync::LazyLock;

use glam::{DVec3, Vec3};

/// Segments round a circle. Even, so that the rims of a cylinder and of the ring that closes it meet whichever way
/// their axes point.
const SEGMENTS: usize = 128;
/// Meridians of a sphere.
const SLICES: usize = 64;
/// Bands of a sphere, from pole to pole.
const BANDS: usize = 32;

/// A triangle in world coordinates, front counter-clockwise.
pub(super) struct Facet {
    /// Corners.
    pub(super) corners: [DVec3; 3],
    /// Unit normals on the front's side; `None` where the surface is flat.
    pub(super) normals: Option<[Vec3; 3]>,
}

impl Facet {
    /// The same triangle seen from behind.
    pub(super) fn flipped(self) -> Facet {
        let ([a, b, c], normals) = (self.corners, self.normals);
        Facet { corners: [a, c, b], normals: normals.map(|[l, m, n]| [-l, -n, -m]) }
    }
}

/// Unit directions and triangles of a sphere's mesh.
struct Globe {
    directions: Vec<DVec3>,
    corners: Vec<[usize; 3]>,
    /// Radius of the mesh over the radius of the sphere of the same area.
    swell: f64,
}

static GLOBE: LazyLock<Globe> = LazyLock::new(|| {
    let mut directions = vec![DVec3::Z];
    for band in 1..BANDS {
        let (sin, cos) = libm::sincos(PI * band as f64 / BANDS as f64);
        directions.extend(circle(SLICES).map(|(x, y)| DVec3::new(sin * x, sin * y, cos)));
    }
    directions.push(DVec3::NEG_Z);
    let at = |band: usize, slice: usize| match band {
        0 => 0,
        BANDS => 1 + (BANDS - 1) * SLICES,
        _ => 1 + (band - 1) * SLICES + slice % SLICES,
    };
    let mut corners = Vec::new();
    for band in 0..BANDS {
        for slice in 0..SLICES {
            let (top, bottom) = (band, band + 1);
            if bottom < BANDS {
                corners.push([at(top, slice), at(bottom, slice), at(bottom, slice + 1)]);
            }
            if top > 0 {
                let low = if bottom < BANDS { slice + 1 } else { slice };
                corners.push([at(top, slice), at(bottom, low), at(top, slice + 1)]);
            }
        }
    }
    let double: f64 = corners
        .iter()
        .map(|&[a, b, c]| (directions[b] - directions[a]).cross(directions[c] - directions[a]).length())
        .sum();
    Globe { directions, corners, swell: (4.0 * PI / (double / 2.0)).sqrt() }
});

/// Cosine and sine of equal steps round a circle.
fn circle(segments: usize) -> impl Iterator<Item = (f64, f64)> {
    (0..segments).map(move |i| {
        let (sin, cos) = libm::sincos(2.0 * PI * i as f64 / segments as f64);
        (cos, sin)
    })
}

/// A sphere, front outside.
pub(super) fn sphere(centre: DVec3, radius: f64) -> impl Iterator<Item = Facet> {
    let globe = &*GLOBE;
    globe.corners.iter().map(move |corners| Facet {
        corners: corners.map(|i| centre + globe.directions[i] * (radius * globe.swell)),
        normals: Some(corners.map(|i| globe.directions[i].as_vec3().normalize())),
    })
}

/// The mantle of a frustum, front outside: a circle of radius `bottom` about `base`, another of radius `top` about
/// `base + axis * height`. A height of zero makes a flat ring; it faces along the axis when `bottom` is the larger.
pub(super) fn frustum(base: DVec3, axis: DVec3, height: f64, bottom: f64, top: f64) -> Vec<Facet> {
    let (across, along) = frame(axis);
    let spokes: Vec<DVec3> = circle(SEGMENTS).map(|(x, y)| across * x + along * y).collect();
    let swell = swell(height, bottom - top);
    let low: Vec<DVec3> = spokes.iter().map(|&s| base + s * (bottom * swell)).collect();
    let high: Vec<DVec3> = spokes.iter().map(|&s| base + axis * height + s * (top * swell)).collect();
    let slant: Vec<DVec3> = spokes.iter().map(|&s| (s * height + axis * (bottom - top)).normalize_or_zero()).collect();
    let facet = |corners: [DVec3; 3], normals: [DVec3; 3]| Facet {
        corners,
        normals: (height > 0.0).then(|| normals.map(|n| n.as_vec3().normalize_or_zero())),
    };
    let mut facets = Vec::with_capacity(2 * SEGMENTS);
    for i in 0..SEGMENTS {
        let j = (i + 1) % SEGMENTS;
        // The tip of a cone has no normal of its own; each facet has that of its middle there.
        let middle = slant[i] + slant[j];
        if top == 0.0 {
            facets.push(facet([low[i], low[j], high[i]], [slant[i], slant[j], middle]));
        } else if bottom == 0.0 {
            facets.push(facet([low[i], high[j], high[i]], [middle, slant[j], slant[i]]));
        } else {
            facets.push(facet([low[i], low[j], high[j]], [slant[i], slant[j], slant[j]]));
            facets.push(facet([low[i], high[j], high[i]], [slant[i], slant[j], slant[i]]));
        }
    }
    facets
}

/// Two unit vectors that with `axis` make a right-handed frame.
fn frame(axis: DVec3) -> (DVec3, DVec3) {
    let mut least = DVec3::ZERO;
    least[axis.abs().min_position()] = 1.0;
    let across = least.cross(axis).normalize();
    (across, axis.cross(across))
}

/// By how much the radii of a frustum grow so that its mantle of flat trapezia has the area of the round one.
///
/// With half a segment's angle a and the radii's difference d, the trapezia's area is
/// `segments sin(a) k (r0 + r1) sqrt(h^2 + k^2 d^2 cos(a)^2)`, to be `pi (r0 + r1) sqrt(h^2 + d^2)`: quadratic in k^2.
fn swell(height: f64, difference: f64) -> f64 {
    let (sin, cos) = libm::sincos(PI / SEGMENTS as f64);
    // Only the shape matters; lengths near 1 keep the fourth powers in range.
    let size = libm::hypot(height, difference);
    let (h2, d2) = ((height / size).powi(2), (difference / size * cos).powi(2));
    let goal = (PI / SEGMENTS as f64 / sin).powi(2);
    (2.0 * goal / (h2 + (h2 * h2 + 4.0 * d2 * goal).sqrt())).sqrt()
}
