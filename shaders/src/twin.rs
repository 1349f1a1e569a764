//! The twins of the other passes: what the device computes, in Rust, pixel by pixel.

use cache_core::details::Weighting;
use cache_core::hsh::rotation::{Rotation, TURN_MAX};
use cache_core::math::Frame;
use cache_core::of_order;
use cache_core::radiance::{self, Coefficients};
use glam::{Vec2, Vec3};

use crate::layout::{Answer, IRRADIANCE, Point, Site, Splats, View};
use crate::reach::reach;

/// How far, in R, a record may lie in front of a point and still count.
const IN_FRONT_TOLERANCE: f32 = 0.01;

/// What the passes make of records of one kind: an answer for each point that has it, row by row; others are left as they are.
/// `lobes`: of the points' lobes the coefficients, channel by channel.
pub fn splat(view: &View, splats: &Splats, points: &[Point], lobes: &[f32], answers: &mut [Answer]) {
    let mut sums = vec![Sums::default(); points.len()];
    for (i, site) in splats.sites.iter().enumerate() {
        let values = &splats.values[i * splats.stride()..(i + 1) * splats.stride()];
        let [left, top, right, bottom] = reach(view, site).to_array().map(|v| v as usize);
        for at in (top..bottom).flat_map(|y| (left..right).map(move |x| y * view.width as usize + x)) {
            let point = &points[at];
            let weight = if point.kind == splats.kind { weigh(site, point) } else { 0.0 };
            if weight > 0.0 {
                sums[at].add(weight, site.noise, estimate(site, values, point, lobes));
            }
        }
    }
    for (sum, answer) in sums.iter().zip(answers).filter(|(sum, _)| sum.weight > 0.0) {
        *answer = sum.normalised();
    }
}

#[derive(Clone, Copy, Default)]
struct Sums {
    irradiance: Vec3,
    radiance: Vec3,
    weight: f32,
    records: f32,
    noise: f32,
}

impl Sums {
    fn add(&mut self, weight: f32, noise: f32, (irradiance, radiance): (Vec3, Vec3)) {
        self.irradiance += irradiance * weight;
        self.radiance += radiance * weight;
        self.weight += weight;
        self.records += 1.0;
        self.noise += (noise * weight) * (noise * weight);
    }

    fn normalised(&self) -> Answer {
        Answer {
            irradiance: (self.irradiance / self.weight).to_array(),
            noise: self.noise.sqrt() / self.weight,
            radiance: (self.radiance / self.weight).to_array(),
            records: self.records,
        }
    }
}

/// How much a record counts at a point; 0 where it does not.
fn weigh(site: &Site, point: &Point) -> f32 {
    let (at, normal) = (Vec3::from(site.position), Vec3::from(site.normal));
    let (offset, turned) = (Vec3::from(point.position) - at, Vec3::from(point.normal));
    let mut translation = offset.length() / site.radius;
    let rotation = (turned - normal).length() * std::f32::consts::FRAC_1_SQRT_2;
    if translation + rotation >= site.a || offset.dot(turned + normal) * 0.5 < -IN_FRONT_TOLERANCE * site.radius {
        return 0.0;
    }
    let [xx, xy, yy] = site.ellipse;
    if xx + yy > 0.0 {
        let Vec2 { x, y } = Frame::around(normal).tangential(offset);
        translation = translation.max((x * x * xx + 2.0 * x * y * xy + y * y * yy).max(0.0).sqrt());
    }
    if point.kind != IRRADIANCE && rotation > TURN_MAX {
        return 0.0;
    }
    Weighting::InverseToZero.weight(translation + rotation, site.a)
}

/// Irradiance, and the radiance that the point's lobe reflects.
fn estimate(site: &Site, values: &[f32], point: &Point, lobes: &[f32]) -> (Vec3, Vec3) {
    let normal = Vec3::from(site.normal);
    let (around, shading) = (Frame::around(normal), Vec3::from(point.shading));
    let shift = around.tangential(Vec3::from(point.position) - Vec3::from(site.position)) * site.limit;
    if point.kind == IRRADIANCE {
        let turn = around.tangential(normal.cross(shading));
        let pair = |at: usize| Vec2::new(values[at], values[at + 1]);
        let channel = |c: usize| values[c] + (pair(3 + 2 * c).dot(shift) + pair(9 + 2 * c).dot(turn));
        return (Vec3::new(channel(0), channel(1), channel(2)).max(Vec3::ZERO), Vec3::ZERO);
    }
    let told = of_order!(point.kind as usize, N => {
        let mut moved: Coefficients<N> = std::array::from_fn(|c| std::array::from_fn(|i| {
            let k = c * N + i;
            values[k] + shift.x * values[k + 3 * N] + shift.y * values[k + 6 * N]
        }));
        if shading != normal {
            Rotation::between(&around, &Frame::around(shading)).apply(&mut moved);
        }
        let lobe = |c: usize| &lobes[(point.lobe as usize * 3 + c) * N..][..N];
        let sum = |c: usize| lobe(c).iter().zip(&moved[c]).map(|(f, l)| f * l).sum();
        (radiance::irradiance(&moved), Vec3::new(sum(0), sum(1), sum(2)))
    });
    told.unwrap_or_default()
}
