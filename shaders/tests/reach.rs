//! Whatever a record weighs in on lies in its rectangle, and the rectangle is tight.

use bytemuck::Zeroable;
use cache_core::math::Frame;
use glam::{Vec2, Vec3, Vec4};
use proptest::prelude::*;
use shaders::layout::{Site, View};
use shaders::reach::reach;
use worker::scene::Camera;
use worker::settings::Settings;

const SIZE: [u32; 2] = [200, 120];

/// A view of the whole picture.
fn view(eye: Vec3, direction: Vec3, parallel: bool) -> View {
    let up = if direction.x.abs() < 0.9 { Vec3::X } else { Vec3::Y };
    let (across, down) = if parallel { (4.0, 2.4) } else { (1.4, 0.9) };
    let camera = Camera::look(eye, direction, up, across, down, parallel).expect("a view");
    View::new(&Settings::new(camera, SIZE[0], SIZE[1]), [0, SIZE[0], 0, SIZE[1]])
}

/// Where a point lies in the picture, in pixels; `None` behind the eye.
fn pixel(view: &View, point: Vec3) -> Option<Vec2> {
    let away = point - Vec3::from(view.eye);
    let ahead = away.dot(view.forward.into());
    let z = if view.parallel == 1 { 1.0 } else { ahead };
    let at = Vec2::new(away.dot(view.right.into()), away.dot(view.down.into())) / z;
    (ahead > 0.0).then(|| at * Vec2::from(view.scale) + Vec2::from(view.centre))
}

fn inside(rectangle: Vec4, at: Vec2) -> bool {
    let [left, top, right, bottom] = rectangle.to_array();
    at.x >= left && at.x <= right && at.y >= top && at.y <= bottom
}

/// Directions, evenly over the sphere.
fn unit() -> impl Strategy<Value = Vec3> {
    (-1f32..1.0, 0f32..std::f32::consts::TAU).prop_map(|(z, turn)| {
        let (s, c) = turn.sin_cos();
        Vec3::new(c, s, 0.0) * (1.0 - z * z).sqrt() + Vec3::Z * z
    })
}

fn place() -> impl Strategy<Value = Vec3> {
    (-2f32..2.0, -2f32..2.0, -2f32..2.0).prop_map(Vec3::from)
}

/// Records near and far, small and so large that the eye is within; half of them with an ellipse.
fn site() -> impl Strategy<Value = Site> {
    let axes = prop::option::of((0.1f32..1.0, 0f32..1.0, 0f32..std::f32::consts::PI));
    (place(), unit(), -5f32..1.5, 0.05f32..1.0, axes).prop_map(|(position, normal, scale, a, axes)| {
        let radius = scale.exp();
        // Semi-axes of the ellipse, in R; one without end now and then.
        let ellipse = axes.map_or([0.0; 3], |(minor, major, turn)| {
            let [minor, major] =
                [(minor * radius).powi(-2), if major > 0.9 { 0.0 } else { (minor * radius).powi(-2) * major }];
            let (s, c) = turn.sin_cos();
            [minor * c * c + major * s * s, (minor - major) * s * c, minor * s * s + major * c * c]
        });
        Site { position: position.into(), radius, normal: normal.into(), a, ellipse, ..Site::zeroed() }
    })
}

/// A point that a record weighs in on, in a direction and at a part of the way to where it ends.
fn reached(site: &Site, direction: Vec3, part: f32) -> Vec3 {
    let frame = Frame::around(site.normal.into());
    let v = Vec2::new(direction.dot(frame.x), direction.dot(frame.y));
    let [xx, xy, yy] = site.ellipse;
    let error = (1.0 / site.radius).max((v.x * v.x * xx + 2.0 * v.x * v.y * xy + v.y * v.y * yy).max(0.0).sqrt());
    Vec3::from(site.position) + direction * (part * site.a / error)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(20_000))]

    #[test]
    fn what_a_record_weighs_in_on_lies_in_its_rectangle(
        site in site(), aside in unit(), far in -2f32..4.0, forward in unit(), parallel: bool, direction in unit(),
        part in 0f32..0.9999,
    ) {
        let eye = Vec3::from(site.position) + aside * site.a * site.radius * far.exp();
        let view = view(eye, forward, parallel);
        if let Some(at) = pixel(&view, reached(&site, direction, part)) {
            let whole = Vec4::new(0.0, 0.0, SIZE[0] as f32, SIZE[1] as f32);
            prop_assert!(!inside(whole, at) || inside(reach(&view, &site), at), "{at} is not in {}", reach(&view, &site));
        }
    }

    /// The camera itself lies within: every pixel may be reached.
    #[test]
    fn a_record_round_the_eye_reaches_all(site in site(), forward in unit(), direction in unit(), part in 0f32..0.99) {
        let site = Site { ellipse: [0.0; 3], ..site };
        let view = view(reached(&site, direction, part), forward, false);
        prop_assert_eq!(reach(&view, &site), Vec4::new(0.0, 0.0, SIZE[0] as f32, SIZE[1] as f32));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(500))]

    /// No wider than what silhouettes show, but for whole pixels and slack.
    #[test]
    fn rectangles_of_spheres_are_tight(
        site in site(), forward in unit(), aside in unit(), far in 2f32..20.0, parallel: bool,
    ) {
        let site = Site { ellipse: [0.0; 3], ..site };
        let eye = Vec3::from(site.position) - (far * forward + 0.3 * aside) * site.a * site.radius;
        let view = view(eye, forward, parallel);
        let [mut low, mut high] = [Vec2::INFINITY, Vec2::NEG_INFINITY];
        for i in 0..4000 {
            // A spiral over the sphere.
            let z = 1.0 - (i as f32 + 0.5) / 2000.0;
            let (s, c) = (i as f32 * 2.399_963).sin_cos();
            let direction = Vec3::new(c, s, 0.0) * (1.0 - z * z).sqrt() + Vec3::Z * z;
            let at = pixel(&view, reached(&site, direction, 1.0)).expect("ahead");
            (low, high) = (low.min(at), high.max(at));
        }
        let wide = reach(&view, &site);
        let (size, slack) = (high - low, 0.02 * (high - low) + 1.2);
        let clipped = |v: Vec2| v.clamp(Vec2::ZERO, Vec2::new(SIZE[0] as f32, SIZE[1] as f32));
        let (low, high) = (clipped(low), clipped(high));
        prop_assert!(low.x - wide.x <= slack.x && wide.z - high.x <= slack.x, "{wide} for {low} to {high}, {size}");
        prop_assert!(low.y - wide.y <= slack.y && wide.w - high.y <= slack.y, "{wide} for {low} to {high}, {size}");
    }
}
