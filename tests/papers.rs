//! What the papers of irradiance caching report of whole pictures, measured again. What did not come out as reported says so.

use ambience_bench::judge::{judge, load, reference, rgb, settings};
use ambience_bench::plane::{Missing, integrate, rasterise, weights};
use ambience_bench::rasterise::{Case, rms};
use cache_core::details::{Details, Gradients, Metric, Spacing, Weighting};
use glam::Vec2;
use worker::frame::{CHANNELS, Frame};
use worker::settings::Settings;
use worker::solo::{self, Order};

/// Ward 1988: the split sphere alone.
fn ward() -> Details {
    Details {
        metric: Metric::SplitSphere,
        gradients: Gradients::None,
        rotation: false,
        radius_by_gradient: false,
        gradient_by_radius: false,
        neighbor_clamping: false,
        weighting: Weighting::Inverse,
        spacing: Spacing::Free,
        ..Details::default()
    }
}

/// Records of level 1, and each pixel's irradiance from them (green); one indirect bounce.
fn irradiance(scene: &str, seed: u64, a: f32, rays: u32, details: Details) -> (usize, Vec<f64>) {
    let (scene, camera) = load(scene);
    let small = Settings { seed, a, rays, spp: 2, ..settings(camera, "one") };
    let frame = Frame::new(scene, Settings { details, ..small });
    let levels = solo::fill(&frame, Order::Rounds);
    let pixels = solo::pixels(&frame, &levels).0;
    (levels[0].len(), pixels.chunks_exact(CHANNELS).map(|pixel| f64::from(pixel[10])).collect())
}

/// Ward 1988, figure 8: the error is proportional to a, on average about a quarter of it. The greatest errors are about
/// twice a in the paper; here one pixel in a hundred errs by more than four times a, relative to the picture's mean.
#[test]
fn the_error_under_a_sphere_is_linear_in_a() {
    let fine = Details { metric: Metric::SplitSphere, spacing: Spacing::Free, ..Details::default() };
    let (_, truth) = irradiance("sphere-plane.glb", 9, 0.06, 8192, fine);
    let mean = truth.iter().sum::<f64>() / truth.len() as f64;
    // Few records lie where they happen to: four sets of them.
    let points: Vec<(f64, f64)> = [0.1f32, 0.15, 0.2, 0.25, 0.3]
        .map(|a| {
            let (mut records, mut off) = (0, Vec::new());
            for seed in 0..4 {
                let (count, image) = irradiance("sphere-plane.glb", seed, a, 2048, ward());
                records += count;
                off.extend(image.iter().zip(&truth).map(|(v, t)| (v - t).abs() / mean));
            }
            off.sort_by(f64::total_cmp);
            let (error, most) = (off.iter().sum::<f64>() / off.len() as f64, off[off.len() * 99 / 100]);
            println!("a {a}: {records} records in four sets, mean error {error:.4}, 99 % below {most:.4}");
            (f64::from(a), error)
        })
        .to_vec();
    let n = points.len() as f64;
    let [mx, my] = [|p: &(f64, f64)| p.0, |p: &(f64, f64)| p.1].map(|of| points.iter().map(of).sum::<f64>() / n);
    let covariance: f64 = points.iter().map(|p| (p.0 - mx) * (p.1 - my)).sum();
    let [vx, vy] =
        [points.iter().map(|p| (p.0 - mx).powi(2)).sum::<f64>(), points.iter().map(|p| (p.1 - my).powi(2)).sum()];
    let (slope, r2) = (covariance / vx, covariance * covariance / (vx * vy));
    println!("slope {slope:.3}, R² {r2:.3}");
    assert!(r2 > 0.95 && (0.15..0.4).contains(&slope), "slope {slope}, R² {r2}");
}

fn rendered(scene: &str, a: f32, details: Details) -> (usize, f64, f64) {
    let (name, depth) = scene.split_once('.').expect("SCENE.DEPTH");
    let (content, camera) = load(&format!("{name}.glb"));
    let frame = Frame::new(content, Settings { a, rays: 1024, spp: 16, details, ..settings(camera, depth) });
    let levels = solo::fill(&frame, Order::Rounds);
    let verdict = judge(&rgb(&solo::pixels(&frame, &levels).0), &reference(scene));
    println!("{scene} a {a} {details:?}: {} records, {verdict:?}", levels[0].len());
    (levels[0].len(), verdict.rmse, verdict.worst)
}

/// Krivanek 2005b: RMS 0.125 with Ward's estimator and 0.131 with that of each sample's own angle, on a diffuse Cornell box. The
/// order is the same here, the distance is larger: a third more error.
#[test]
fn ward_s_estimator_of_the_translational_gradient_is_the_better_one() {
    let [borders, samples] = [Gradients::Borders, Gradients::Samples]
        .map(|g| rendered("cornell.full", 0.4, Details { gradients: g, ..Details::default() }));
    assert!(samples.1 > borders.1 && samples.1 < 1.5 * borders.1, "{borders:?} {samples:?}");
}

/// RMS error of irradiance by a plane of 64 x 64 pixels, what it misses black, by ratio, and by extended borders.
fn planes(scene: &str) -> [f64; 3] {
    let case = Case::load(scene, 256).expect("a scene");
    let (truth, doubt) = case.reference();
    let seen: Vec<_> = case.eyes.iter().map(|eye| rasterise(&case.bvh, eye, 64, Vec2::ZERO)).collect();
    let told = Missing::ALL.map(|missing| {
        let weights = weights(64, missing);
        let of = |eye, seen: &[u32]| integrate(&case.world.scene.triangles, &case.glow, eye, seen, &weights);
        rms(&case.eyes.iter().zip(&seen).map(|(eye, seen)| of(eye, seen)).collect::<Vec<_>>(), &truth)
    });
    println!("{scene}: {told:.4?} over {} records, the reference to {doubt:.4}", case.eyes.len());
    assert!(doubt < 0.002 && case.eyes.len() == 256, "{doubt}, {} records", case.eyes.len());
    told
}

/// Gautron 2005, table 1: a sampling plane errs by 18.1 %, divided by its share of the hemisphere (Larsen and Christensen 2004) by
/// 10.4 %, with extended borders by 5.8 %. The same order and much the same numbers on the stairs; but where light has bounced
/// only once, and comes from the ceiling alone, dividing is worse than leaving the plane as it is.
#[test]
fn plane_sampling_18_1_ratio_10_4_border_compensation_5_8_percent() {
    let [black, ratio, border] = planes("stairs.full");
    assert!(border < 0.7 * ratio && ratio < 0.8 * black, "{black} {ratio} {border}");
    let [black, ratio, border] = planes("stairs.one");
    assert!(border < 0.8 * black && black < 0.8 * ratio, "{black} {ratio} {border}");
}
