//! Colours, tangent frames, and functions whose bits are the same on every machine.
//!
//! Sums, products and square roots are exact by IEEE 754; sines and their like differ between C libraries, so whatever
//! decides a record's bits takes them from the `libm` crate, through this file.

use glam::{Vec2, Vec3};

/// Linear RGB.
pub type Rgb = Vec3;

/// Sine and cosine of `x` radians.
pub fn sin_cos(x: f32) -> (f32, f32) {
    (libm::sinf(x), libm::cosf(x))
}

/// An orthonormal frame whose z axis is a surface normal.
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    /// First tangent.
    pub x: Vec3,
    /// Second tangent; x × y = z.
    pub y: Vec3,
    /// The normal.
    pub z: Vec3,
}

impl Frame {
    /// The frame of a unit normal; the same normal always gives the same frame
    /// (Duff et al. 2017, "Building an orthonormal basis, revisited").
    #[inline]
    pub fn around(normal: Vec3) -> Self {
        let n = normal;
        let sign = 1f32.copysign(n.z);
        let a = -1.0 / (sign + n.z);
        let b = n.x * n.y * a;
        Self {
            x: Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x),
            y: Vec3::new(b, sign + n.y * n.y * a, -n.y),
            z: n,
        }
    }

    /// World direction of local coordinates.
    #[inline]
    pub fn to_world(&self, local: Vec3) -> Vec3 {
        self.x * local.x + self.y * local.y + self.z * local.z
    }

    /// Local coordinates of a world direction.
    #[inline]
    pub fn to_local(&self, world: Vec3) -> Vec3 {
        Vec3::new(world.dot(self.x), world.dot(self.y), world.dot(self.z))
    }

    /// Tangential part of a world vector, in the frame's x and y.
    #[inline]
    pub fn tangential(&self, world: Vec3) -> Vec2 {
        Vec2::new(world.dot(self.x), world.dot(self.y))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn frames_are_orthonormal_and_right_handed(x in -1f32..1.0, y in -1f32..1.0, z in -1f32..1.0) {
            let v = Vec3::new(x, y, z);
            prop_assume!(v.length() > 1e-3);
            let f = Frame::around(v.normalize());
            prop_assert!(f.x.dot(f.y).abs() < 1e-5 && f.x.dot(f.z).abs() < 1e-5 && f.y.dot(f.z).abs() < 1e-5);
            prop_assert!((f.x.cross(f.y) - f.z).length() < 1e-5);
            let w = Vec3::new(0.3, -0.5, 0.7);
            prop_assert!((f.to_world(f.to_local(w)) - w).length() < 1e-5);
        }
    }
}
