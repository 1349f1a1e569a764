//! Where a record of light lies on a surface and how far it counts: what all rooms of such records have in common.

use glam::{Vec2, Vec3};

use crate::cached::{Invalid, Query};
use crate::math::Frame;

/// No scene is larger: squares of such lengths still fit a float, so nothing derived from a record overflows.
const LENGTH_MAX: f32 = 1e18;

/// Least R, as part of the record's distance from the origin and of radius_max: 2^-32, some 500 times less than the
/// spacing of floats.
const RADIUS_LEAST: f32 = 1.0 / (1u64 << 32) as f32;

/// R of a record must be more than this: far below the spacing of floats at its place it tells nothing, and clamped by it all
/// records around would be worth nothing.
pub fn radius_least(position: Vec3, radius_max: f32) -> f32 {
    RADIUS_LEAST * position.abs().max_element().max(radius_max)
}

/// How far, in R, a record may lie in front of a query and still count: enough for curved surfaces made of facets.
const IN_FRONT_TOLERANCE: f32 = 0.01;

/// The error e of a record (Ward 1988 eq. 5), its summand for the distance being that of the ellipse where that says more; and
/// the summand for the turn of the normal. `None` where it does not count.
#[inline]
pub(crate) fn error(
    (position, normal, ellipse): (Vec3, Vec3, [f32; 3]),
    query: &Query,
    radius: f32,
    a: f32,
) -> Option<(f32, f32)> {
    let (mut translation, rotation) = split_sphere(position, normal, query, radius, a)?;
    let [xx, xy, yy] = ellipse;
    if xx + yy > 0.0 {
        let Vec2 { x, y } = Frame::around(normal).tangential(query.position - position);
        translation = translation.max((x * x * xx + 2.0 * x * y * xy + y * y * yy).max(0.0).sqrt());
    }
    Some((translation + rotation, rotation))
}

/// Whether the finite (xx, xy, yy) of a record's M are sound. A record reaches as far as R lets it at most, so an ellipse
/// without end in some direction does no harm.
///
/// # Errors
/// Where it has a negative axis.
pub(crate) fn check_ellipse(ellipse: [f32; 3]) -> Result<(), Invalid> {
    let [xx, xy, yy] = ellipse.map(f64::from);
    if xx < 0.0 || yy < 0.0 || xy * xy > xx * yy * (1.0 + 1e-5) {
        return Err(Invalid::Range { field: "ellipse", value: ellipse[1], expected: "no negative axis" });
    }
    Ok(())
}

/// Both summands of the error e of a record at `position` with unit `normal` that counts with `radius`, for the distance and
/// for the turn of the normal (Ward 1988 eq. 5); `None` where their sum is not below `a`. A record in front of the query (Ward
/// 1988 eq. 6) does not count; the test's tolerance scales with R.
#[inline]
fn split_sphere(position: Vec3, normal: Vec3, query: &Query, radius: f32, a: f32) -> Option<(f32, f32)> {
    let offset = query.position - position;
    let translation = offset.length() / radius;
    // sqrt(1 - n·n_i) without its cancellation: |n - n_i|² = 2 (1 - n·n_i) for unit vectors.
    let rotation = (query.normal - normal).length() * std::f32::consts::FRAC_1_SQRT_2;
    if translation + rotation >= a {
        return None;
    }
    let behind = offset.dot(query.normal + normal) * 0.5;
    (behind >= -IN_FRONT_TOLERANCE * radius).then_some((translation, rotation))
}

/// Whether finite `position`, `normal`, R and its bounds are sound.
///
/// # Errors
/// The first that is not.
pub(crate) fn check(
    position: Vec3,
    normal: Vec3,
    radius: f32,
    (radius_min, radius_max): (f32, f32),
) -> Result<(), Invalid> {
    let length = normal.length();
    if (length - 1.0).abs() > 1e-3 {
        return Err(Invalid::Normal { length });
    }
    let positive =
        |field, value: f32| (value > 0.0).then_some(()).ok_or(Invalid::Range { field, value, expected: "more than 0" });
    let reach = position.abs().max_element();
    if reach > LENGTH_MAX {
        return Err(Invalid::Range { field: "position", value: reach, expected: "at most 1e18" });
    }
    positive("radius", radius)?;
    positive("radius_min", radius_min)?;
    if radius_max <= RADIUS_LEAST * reach {
        let expected = "more than 2^-32 of its distance from the origin";
        return Err(Invalid::Range { field: "radius_max", value: radius_max, expected });
    }
    if radius <= radius_least(position, radius_max) {
        let expected = "more than 2^-32 of its distance from the origin and of radius_max";
        return Err(Invalid::Range { field: "radius", value: radius, expected });
    }
    for (field, value) in [("radius", radius), ("radius_max", radius_max)] {
        if value > LENGTH_MAX {
            return Err(Invalid::Range { field, value, expected: "at most 1e18" });
        }
    }
    if radius_max < radius_min {
        return Err(Invalid::Range { field: "radius_max", value: radius_max, expected: "at least radius_min" });
    }
    Ok(())
}
