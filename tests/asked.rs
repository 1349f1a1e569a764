//! A picture is about as far from the truth as was asked for, and asking for less costs less.

use ambience_bench::judge::{judge, load, reference, rgb, settings};
use worker::frame::{Counts, Frame};
use worker::pilot;
use worker::solo::{self, Order};

/// Renders what an error asks for: the error met, the one believed, and the rays it took.
fn asked(scene: &str, error: f32) -> (f64, f64, u64) {
    let truth = reference(&format!("{scene}.full"));
    let (file, camera) = load(&format!("{scene}.glb"));
    let (frame, forecast) = pilot::choose(Frame::new(file, settings(camera, "full")), error);
    let filled = solo::fill_ranks(&frame, Order::Rounds, cache_core::rounds::RANKS);
    let (pixels, counts) = solo::pixels(&frame, &filled.levels);
    let image = rgb(&pixels);
    let rays = |c: &Counts| c.path_rays + c.shadow_rays;
    let all = rays(&forecast.counts) + rays(&filled.counts) + rays(&counts);
    (judge(&image, &truth).rmse, pilot::reached(&counts, &forecast).total(), all)
}

#[test]
fn the_error_met_is_the_one_asked_for() {
    let mut wrong = Vec::new();
    for scene in ["cornell", "stairs", "leak", "sphere-plane", "glossy-floor"] {
        let mut before = 0;
        for error in [0.05, 0.02] {
            let (met, believed, rays) = asked(scene, error);
            let line = format!("{scene}: asked {error}, met {met:.4}, believed {believed:.4}, {rays} rays");
            println!("{line}");
            let error = f64::from(error);
            if !(error / 3.0..=1.2 * error).contains(&met) || !(0.5..2.0).contains(&(believed / met)) || rays <= before
            {
                wrong.push(line);
            }
            before = rays;
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Where every sample is exact there is no error to have, whatever was asked for.
#[test]
fn a_furnace_is_right_at_any_error() {
    let (met, believed, _) = asked("white-furnace", 0.05);
    assert!(met < 0.01 && believed < 0.01, "met {met}, believed {believed}");
}
