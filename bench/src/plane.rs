//! A hemisphere seen through a square plane above a point (Larsen and Christensen 2004, Gautron et al. 2005), and the twins in Rust
//! of what draws it: `wgsl/rasterise.wgsl` and `wgsl/integrate.wgsl`.

use bytemuck::{Pod, Zeroable};
use cache_core::math::Frame;
use glam::{Vec2, Vec3};
use worker::bvh::Bvh;
use worker::scene::{Rgb, Triangle};

use crate::glow::Glow;

/// Slope of the plane's edges: the aperture of 126.87° of Larsen and Christensen 2004.
pub const HALF: f32 = 2.0;

/// Distance of an eye from its surface, and least height that is drawn above the eye, as fractions of the scene's radius.
const LIFT: f32 = 1e-5;

/// What is made of the directions the plane does not cover.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Missing {
    /// No light comes from there.
    Black,
    /// On average as much light comes from there as through the plane: the sum is divided by the plane's share of the
    /// hemisphere (Larsen and Christensen 2004, as Gautron 2005, section 5.2, describes it).
    Ratio,
    /// Each pixel at the border stands for what lies between it and the horizon (Gautron 2005, figure 6).
    Border,
}

impl Missing {
    /// In the order of the paper's table 1.
    pub const ALL: [Self; 3] = [Self::Black, Self::Ratio, Self::Border];
}

/// Projected solid angle that each pixel of a plane of `size` by `size` stands for, row by row; but for [`Missing::Black`] their sum
/// is π.
///
/// The paper gives a border pixel cos θ δΦ more *solid* angle. Irradiance takes a cosine with it: what lies between the plane's
/// edge and the horizon has, exactly, (δΦ - Γ cos ν) / 2, where Γ is the pixel's edge as an angle and ν the tilt of its great
/// circle (Lambert).
pub fn weights(size: u32, missing: Missing) -> Vec<f32> {
    let half = f64::from(HALF);
    let at = |i: u32| half * (2.0 * f64::from(i) / f64::from(size) - 1.0);
    // Projected solid angle between the middle and a corner.
    let corner = |x: f64, y: f64| {
        let side = |x: f64, y: f64| x / (1.0 + x * x).sqrt() * (y / (1.0 + x * x).sqrt()).atan();
        (side(x, y) + side(y, x)) / 2.0
    };
    let far = (1.0 + half * half).sqrt();
    let beyond = |i: u32| {
        let angle = |per: f64| (at(i + 1) / per).atan() - (at(i) / per).atan();
        (angle(half) - angle(far) * half / far) / 2.0
    };
    let all = std::f64::consts::PI / (4.0 * corner(half, half));
    let weight = |x: u32, y: u32| {
        let [l, r, t, b] = [at(x), at(x + 1), at(y), at(y + 1)];
        let own = corner(r, b) - corner(l, b) - corner(r, t) + corner(l, t);
        let ends = |i: u32| f64::from(u32::from(i == 0) + u32::from(i == size - 1));
        (match missing {
            Missing::Black => own,
            Missing::Ratio => own * all,
            Missing::Border => own + ends(x) * beyond(y) + ends(y) * beyond(x),
        }) as f32
    };
    (0..size).flat_map(|y| (0..size).map(move |x| weight(x, y))).collect()
}

/// Where a record looks from; as in `wgsl/plane.wgsl`.
#[derive(Clone, Copy, PartialEq, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Eye {
    /// World position, just off the surface.
    pub position: [f32; 3],
    /// Least height above the eye that is drawn, world length.
    pub near: f32,
    x: [f32; 3],
    pad0: u32,
    y: [f32; 3],
    pad1: u32,
    z: [f32; 3],
    pad2: u32,
}

impl Eye {
    /// One at a point of a surface with this unit normal, in a scene of this radius.
    pub fn new(position: Vec3, normal: Vec3, radius: f32) -> Self {
        let Frame { x, y, z } = Frame::around(normal);
        let [x, y, z] = [x, y, z].map(|v| v.to_array());
        let position = (position + normal * (LIFT * radius)).to_array();
        Self { position, near: LIFT * radius, x, pad0: 0, y, pad1: 0, z, pad2: 0 }
    }

    /// The world direction of a local one.
    pub fn to_world(&self, local: Vec3) -> Vec3 {
        Vec3::from(self.x) * local.x + Vec3::from(self.y) * local.y + Vec3::from(self.z) * local.z
    }
}

/// Local direction, of height 1, through the middle of a pixel.
pub fn direction(size: u32, pixel: u32) -> Vec3 {
    let slope = |i: u32| HALF * ((i as f32 + 0.5) / size as f32 * 2.0 - 1.0);
    Vec3::new(slope(pixel % size), -slope(pixel / size), 1.0)
}

/// The twin of `rasterise.wgsl`: of each pixel the number of the triangle a ray through it meets, plus one; 0: none. `beside`: so many
/// pixels to the right of and above its middle.
pub fn rasterise(bvh: &Bvh, eye: &Eye, size: u32, beside: Vec2) -> Vec<u32> {
    let off = (beside * (2.0 * HALF / size as f32)).extend(0.0);
    let pixel = |pixel| {
        let way = eye.to_world(direction(size, pixel) + off);
        bvh.closest(eye.position.into(), way, f32::INFINITY).map_or(0, |hit| hit.triangle + 1)
    };
    (0..size * size).map(pixel).collect()
}

/// The twin of `integrate.wgsl`: irradiance, W/m².
pub fn integrate(triangles: &[Triangle], glow: &Glow, eye: &Eye, seen: &[u32], weights: &[f32]) -> Rgb {
    let size = seen.len().isqrt() as u32;
    let shine = |(pixel, (&seen, &weight)): (u32, (&u32, &f32))| {
        let triangle = seen.checked_sub(1)?;
        let [a, b, c] = triangles[triangle as usize].positions;
        let (b, c, away) = (b - a, c - a, Vec3::from(eye.position) - a);
        let way = eye.to_world(direction(size, pixel));
        let p = way.cross(c);
        let scale = 1.0 / b.dot(p);
        Some(glow.at(triangle, [away.dot(p) * scale, way.dot(away.cross(b)) * scale]) * weight)
    };
    (0..).zip(seen.iter().zip(weights)).filter_map(shine).sum()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    /// The plane's share of the hemisphere, by projected solid angle: 4 / π · 2 / √5 · atan(2 / √5).
    const SHARE: f64 = 0.831_029;

    /// Irradiance from a sky given by direction.
    fn under(sky: impl Fn(Vec3) -> f32, size: u32, missing: Missing) -> f64 {
        let pixels = (0..).zip(weights(size, missing));
        pixels.map(|(pixel, weight)| f64::from(sky(direction(size, pixel).normalize()) * weight)).sum()
    }

    #[test]
    fn a_white_sky_gives_pi_unless_what_the_plane_misses_is_black() {
        for size in [1, 2, 3, 16, 64, 256] {
            for (missing, share) in Missing::ALL.into_iter().zip([SHARE, 1.0, 1.0]) {
                let told = under(|_| 1.0, size, missing) / PI;
                assert!((told - share).abs() < 1e-5, "{missing:?} at {size}: {told}");
            }
        }
    }

    #[test]
    fn half_a_white_sky_gives_half_of_it() {
        for half in [|d: Vec3| d.x > 0.0, |d: Vec3| d.y < 0.0] {
            let told = under(|d| half(d).into(), 64, Missing::Border) / PI;
            assert!((told - 0.5).abs() < 1e-5, "{told}");
        }
    }

    /// π sin² α cos θ for a ball of half angle α, θ from the normal, wholly above the horizon (Nusselt).
    #[test]
    fn a_ball_within_the_plane_is_exact_unless_divided_by_the_plane_s_share() {
        let (axis, sine) = (Vec3::new(0.3, -0.2, 1.0).normalize(), 0.5f32);
        let ball = |d: Vec3| f32::from(u8::from(d.dot(axis) > (1.0 - sine * sine).sqrt()));
        let truth = PI * f64::from(sine * sine * axis.z);
        for (missing, share) in Missing::ALL.into_iter().zip([1.0, 1.0 / SHARE, 1.0]) {
            let told = under(ball, 256, missing) / truth;
            assert!((told - share).abs() < 2e-3, "{missing:?}: {told}");
        }
    }

    /// Light that comes from the horizon's side alone: what is bright beyond the border is bright at the border too.
    #[test]
    fn extended_borders_bring_light_from_where_it_comes() {
        // Radiance sin⁸ θ: E = 2π ∫ sin⁹ θ cos θ dθ = π / 5.
        let told = Missing::ALL.map(|missing| under(|d| (1.0 - d.z * d.z).powi(4), 256, missing) / (PI / 5.0));
        let [black, ratio, border] = told.map(|told| (told - 1.0).abs());
        println!("{told:?}");
        assert!(border < ratio && ratio < black, "{told:?}");
    }
}
