//! What sharing the work costs: records made in rounds against records made one after another.

use ambience_bench::judge::{load, settings};
use worker::frame::Frame;
use worker::settings::Settings;
use worker::solo::{self, Order};

#[test]
fn rounds_cost_at_most_a_tenth_more_records_than_sequential_filling() {
    for name in ["cornell.glb", "stairs.glb"] {
        let count = |order| {
            let (scene, camera) = load(name);
            // Few rays: how many records there are hardly depends on them.
            let frame = Frame::new(scene, Settings { rays: 256, ..settings(camera, "full") });
            solo::fill(&frame, order).iter().map(|level| level.len()).collect::<Vec<_>>()
        };
        let (rounds, sequential) = (count(Order::Rounds), count(Order::Sequential));
        let (r, s): (usize, usize) = (rounds.iter().sum(), sequential.iter().sum());
        let more = r as f64 / s as f64 - 1.0;
        println!("{name}: {r} records in rounds {rounds:?}, {s} one by one {sequential:?}: {:+.1} %", 100.0 * more);
        assert!(more < 0.10, "{name}: {:.1} % more", 100.0 * more);
    }
}
