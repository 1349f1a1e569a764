//! The twin of `wgsl/reach.wgsl`: which pixels a record may reach.

use cache_core::math::Frame;
use glam::{Vec2, Vec3, Vec4};

use crate::layout::{Site, View};

/// Pixels a rectangle is wider than the projection, for points that lie a rounding away from their ray.
const SLACK: f32 = 0.125;

/// Slopes between which a circle at `at` (across, ahead) lies as seen from the origin; `None` where it is behind.
fn slopes(at: Vec2, radius: f32) -> Option<(f32, f32)> {
    let far = 1e30;
    let square = at.length_squared();
    if square <= radius * radius {
        return Some((-far, far));
    }
    // Directions of both tangents.
    let s = radius / square.sqrt();
    let c = (1.0 - s * s).sqrt();
    let low = Vec2::new(at.x * c - at.y * s, at.y * c + at.x * s);
    let high = Vec2::new(at.x * c + at.y * s, at.y * c - at.x * s);
    if (low.y <= 0.0 && at.x > 0.0) || (high.y <= 0.0 && at.x <= 0.0) {
        return None;
    }
    Some((if low.y > 0.0 { low.x / low.y } else { -far }, if high.y > 0.0 { high.x / high.y } else { far }))
}

/// (left, top, right, bottom) in whole pixels, clipped to the region; all 0 where the record reaches none.
pub fn reach(view: &View, site: &Site) -> Vec4 {
    let [right, down, forward] = [view.right, view.down, view.forward].map(Vec3::from);
    let (scale, centre) = (Vec2::from(view.scale), Vec2::from(view.centre));
    let away = Vec3::from(site.position) - Vec3::from(view.eye);
    let at = Vec3::new(away.dot(right), away.dot(down), away.dot(forward));
    let (parallel, radius) = (view.parallel == 1, site.a * site.radius);
    let sphere = if parallel {
        (at.z + radius >= 0.0).then(|| (at.truncate() - radius, at.truncate() + radius))
    } else {
        let both = slopes(Vec2::new(at.x, at.z), radius).zip(slopes(Vec2::new(at.y, at.z), radius));
        both.map(|(x, y)| (Vec2::new(x.0, y.0), Vec2::new(x.1, y.1)))
    };
    let Some((low, high)) = sphere else { return Vec4::ZERO };
    let (mut low, mut high) = (low * scale + centre, high * scale + centre);
    let [xx, xy, yy] = site.ellipse;
    if xx + yy > 0.0 {
        // A box round the sphere along the axes of the ellipse, cut where the ellipse ends.
        let around = Frame::around(site.normal.into());
        let (half, mean) = (0.5 * (xx - yy), 0.5 * (xx + yy));
        let root = (half * half + xy * xy).sqrt();
        let axis = if half >= 0.0 { Vec2::new(root + half, xy) } else { Vec2::new(xy, root - half) };
        let axis = axis.normalize_or(Vec2::X);
        let u = (around.x * axis.x + around.y * axis.y) * radius.min(site.a / (mean + root).sqrt());
        let least = (mean - root).max(0.0);
        let beside = if least > 0.0 { radius.min(site.a / least.sqrt()) } else { radius };
        let v = (around.y * axis.x - around.x * axis.y) * beside;
        let n = around.z * radius;
        let (mut box_low, mut box_high, mut ahead) = (Vec2::INFINITY, Vec2::NEG_INFINITY, true);
        for i in 0..8 {
            let side = |bit: u32, v: Vec3| if i & bit == bit { -v } else { v };
            let corner = away + side(1, u) + side(2, v) + side(4, n);
            let z = if parallel { 1.0 } else { corner.dot(forward) };
            // Behind the eye a corner projects to nowhere: the sphere's rectangle has to do.
            ahead &= z > 1e-3 * radius;
            let pixel = Vec2::new(corner.dot(right), corner.dot(down)) / z * scale + centre;
            (box_low, box_high) = (box_low.min(pixel), box_high.max(pixel));
        }
        if ahead {
            (low, high) = (low.max(box_low), high.min(box_high));
        }
    }
    let size = Vec2::new(view.width as f32, view.height as f32);
    let low = (low - SLACK).floor().clamp(Vec2::ZERO, size);
    let high = (high + SLACK).ceil().clamp(Vec2::ZERO, size);
    if high.x <= low.x || high.y <= low.y { Vec4::ZERO } else { Vec4::new(low.x, low.y, high.x, high.y) }
}
