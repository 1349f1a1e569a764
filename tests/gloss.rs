//! Glossy surfaces by records of radiance: as near to the truth as their scenes demand, and what they cost.

use ambience_bench::judge::{judge, load, reference, rgb, settings};
use cache_core::Record;
use cache_core::details::Details;
use worker::frame::Frame;
use worker::scene::{Scene, Surface};
use worker::settings::{Method, Settings};
use worker::solo::{self, Order};

/// Gives the metal of a scene another roughness.
fn of_roughness(scene: &mut Scene, alpha: f32) {
    for material in &mut scene.materials {
        if let Surface::Gltf { metallic: 1.0, roughness, .. } = &mut material.surface {
            *roughness = alpha.sqrt();
        }
    }
}

/// Records of irradiance and of radiance at level 1.
fn filled(scene: Scene, settings: Settings) -> [usize; 2] {
    let frame = Frame::new(scene, settings);
    let levels = solo::fill(&frame, Order::Rounds);
    [levels[0].irradiance.len(), levels[0].len() - levels[0].irradiance.len()]
}

/// Both models of the glossy floor at default settings, and the one of glTF with records wherever there is gloss.
#[test]
fn the_glossy_floor_meets_the_bar() {
    let cases = [
        ("glossy-floor.glb", "glossy-floor.full", Method::Auto),
        ("glossy-floor.rad", "glossy-floor-ward.full", Method::Auto),
        ("glossy-floor.glb", "glossy-floor.full", Method::Radiance),
    ];
    for (file, name, method) in cases {
        let (scene, camera) = load(file);
        let frame = Frame::new(scene, Settings { method, ..settings(camera, "full") });
        let levels = solo::fill(&frame, Order::Rounds);
        let verdict = judge(&rgb(&solo::pixels(&frame, &levels).0), &reference(name));
        let glossy = levels[0].len() - levels[0].irradiance.len();
        println!("{file} {}: {verdict:?}, {glossy} records of radiance", method.name());
        assert!(verdict.rmse < 0.03 && verdict.bias.abs() < 0.01 && verdict.worst < 0.08, "{file}: {verdict:?}");
        assert_eq!(glossy > 300, method == Method::Radiance);
    }
}

/// Broad lobes have records by default, sharp ones have none: their light is sampled.
#[test]
fn auto_tells_broad_lobes_from_sharp_ones() {
    let records = [0.6f32, 0.3, 0.1].map(|alpha| {
        let (mut scene, camera) = load("glossy-floor.glb");
        of_roughness(&mut scene, alpha);
        let small = Settings { width: 64, height: 64, rays: 64, ..settings(camera, "full") };
        filled(scene, Settings { method: Method::Auto, ..small })
    });
    println!("alpha 0.6, 0.3, 0.1: {records:?} records of irradiance and radiance");
    assert!(records[0][1] > 50 && records[1][1] > 10 && records[2][1] == 0, "{records:?}");
    assert!(records.iter().all(|[irradiance, _]| *irradiance > 200), "walls are diffuse: {records:?}");
}

/// Krivanek 2006: adaptive caching makes more records the sharper a surface shows its surroundings.
#[test]
fn adaptive_caching_makes_more_records_for_sharper_gloss() {
    let details = Details { adaptive: true, ..Details::default() };
    let records = [0.6f32, 0.3, 0.15].map(|alpha| {
        let (mut scene, camera) = load("glossy-floor.glb");
        of_roughness(&mut scene, alpha);
        let settings = Settings { a: 0.8, rays: 1024, details, ..settings(camera, "full") };
        filled(scene, Settings { method: Method::Radiance, ..settings })[1]
    });
    println!("alpha 0.6, 0.3, 0.15: {records:?} records of radiance");
    assert!(records.is_sorted_by(|a, b| a * 11 < b * 10), "{records:?}");
}

/// The same records, whoever makes them: gathered twice they have the same bits, and all are sound.
#[test]
fn records_of_radiance_depend_on_their_site_alone() {
    let fill = || {
        let (scene, camera) = load("glossy-floor.glb");
        let small = Settings { width: 32, height: 32, rays: 64, ..settings(camera, "full") };
        let frame = Frame::new(scene, Settings { method: Method::Radiance, ..small });
        let (records, _) = frame.fill(1, 0, 0..4096, 2, &Vec::new(), &|_| None);
        records
    };
    let (records, again) = (fill(), fill());
    assert_eq!(records, again);
    let glossy = records.iter().filter(|record| matches!(record, Record::Radiance(_))).count();
    assert!(glossy > 20 && records.iter().all(|record| record.check().is_ok()), "{glossy}");
}
