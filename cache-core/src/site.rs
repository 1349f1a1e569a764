//! Where a record of light lies on a surface and how far it counts: what all rooms of such records have in common.

use glam::Vec3;

use crate::cached::{Invalid, Query};

/// No scene is larger: squares of such lengths still fit a float, so nothing derived from a record overflows.
const LENGTH_MAX: f32 = 1e18;

/// Least R, as part of the record's distance from the origin and of radius_max: 2^-32, some 500 times less than the
/// spacing of floats.
const RADIUS_LEAST: f32 = 1.0 / (1u64 << 32) as f32;

/// How far, in R, a record may lie in front of a query and still count: enough for curved surfaces made of facets.
const IN_FRONT_TOLERANCE: f32 = 0.01;

/// Both summands of the error e of a record at `position` with unit `normal` that counts with `radius`, for the distance and
/// for the turn of the normal (Ward 1988 eq. 5); `None` where their sum is not below `a`. A record in front of the query (Ward
/// 1988 eq. 6) does not count; the test's tolerance scales with R.
#[inline]
pub(crate) fn error(position: Vec3, normal: Vec3, query: &Query, radius: f32, a: f32) -> Option<(f32, f32)> {
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
    // Far below the spacing of floats there, R tells nothing; clamped by it, all records around would be worth nothing.
    if radius <= RADIUS_LEAST * reach.max(radius_max) {
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
