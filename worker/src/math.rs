//! Functions whose bits must be the same on every machine, beside those of `cache_core::math`.

pub use cache_core::math::{Frame, sin_cos};

/// e to the `x`.
pub fn exp(x: f32) -> f32 {
    libm::expf(x)
}

/// Natural logarithm of `x`.
pub fn ln(x: f32) -> f32 {
    libm::logf(x)
}

/// Angle of the vector (`x`, `y`), radians.
pub fn atan2(y: f32, x: f32) -> f32 {
    libm::atan2f(y, x)
}

/// Luminance of linear RGB (Rec. 709).
pub fn luminance(c: glam::Vec3) -> f32 {
    c.dot(glam::Vec3::new(0.2126, 0.7152, 0.0722))
}
