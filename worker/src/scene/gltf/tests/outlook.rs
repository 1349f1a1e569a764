//! Lights and cameras.

use glam::Vec3;
use serde_json::{Value, json};

use super::File;
use crate::scene::Scene;

/// A scene of one node, turned a quarter about X so that its -Z looks along +Y, which shows `light`.
fn lit(light: Value) -> File {
    let mut file = File::empty();
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let reference = json!({"KHR_lights_punctual": {"light": 0}});
    file.json["nodes"] = json!([{
        "name": "lamp", "translation": [1, 2, 3], "rotation": [half, 0, 0, half], "scale": [2, 2, 2],
        "extensions": reference,
    }]);
    file.json["scenes"][0]["nodes"] = json!([0]);
    file.json["extensions"] = json!({"KHR_lights_punctual": {"lights": [light]}});
    file
}

fn seen(camera: Value, node: Value) -> File {
    let mut file = File::empty();
    file.json["nodes"] = json!([node]);
    file.json["nodes"][0]["camera"] = json!(0);
    file.json["scenes"][0]["nodes"] = json!([0]);
    file.json["cameras"] = json!([camera]);
    file
}

fn is_empty(scene: &Scene) -> bool {
    scene.triangles.is_empty() && scene.points.is_empty() && scene.distant.is_empty()
}

#[test]
fn directional_light_is_a_beam_of_its_irradiance() {
    let scene = lit(json!({"type": "directional", "color": [1, 0.5, 0], "intensity": 4})).scene();
    let light = scene.distant[0];
    assert!(light.is_beam());
    assert!(light.to_light.abs_diff_eq(Vec3::NEG_Y, 1e-6), "{}", light.to_light);
    assert_eq!(light.strength, Vec3::new(4.0, 2.0, 0.0));
}

#[test]
fn point_light_has_its_intensity() {
    let scene = lit(json!({"type": "point", "intensity": 4, "range": 10})).scene();
    let light = scene.points[0];
    assert_eq!((light.position, light.intensity), (Vec3::new(1.0, 2.0, 3.0), Vec3::splat(4.0)));
    assert!(light.spot.is_none());
    assert!(scene.warnings[0].ends_with("light 0: range is ignored; light falls off by distance alone"));
}

#[test]
fn spot_light_has_a_cone() {
    let scene = lit(json!({"type": "spot", "spot": {"innerConeAngle": 0.5}})).scene();
    let spot = scene.points[0].spot.unwrap();
    assert!(spot.axis.abs_diff_eq(Vec3::Y, 1e-6));
    assert!((spot.cos_inner - 0.5f32.cos()).abs() < 1e-6);
    assert!((spot.cos_outer - std::f32::consts::FRAC_1_SQRT_2).abs() < 1e-6);
}

#[test]
fn broken_lights_are_refused() {
    for (light, part) in [
        (json!({"type": "spot"}), "light 0: spot: is missing"),
        (json!({"type": "spot", "spot": {"innerConeAngle": 0.8}}), "expected 0 <= inner < outer <= pi/2"),
        (json!({"type": "spot", "spot": {"outerConeAngle": 2}}), "expected 0 <= inner < outer <= pi/2"),
        (json!({"type": "area", "name": "x"}), "light \"x\": unknown type"),
        (json!({"type": "point", "intensity": -1}), "is not a strength"),
        (json!({"type": "point", "color": [1, -1, 1]}), "is not a strength"),
        (json!({"type": "point", "intensity": 1e39}), "is not a strength"),
    ] {
        let fault = lit(light).fault();
        assert!(fault.starts_with("node \"lamp\": ") && fault.contains(part), "{fault}");
    }
    let mut file = lit(json!({"type": "point"}));
    file.node()["extensions"]["KHR_lights_punctual"]["light"] = json!(1);
    assert!(file.fault().contains("light 1 does not exist; the last one is 0"));
    let mut file = lit(json!({"type": "directional"}));
    file.node()["scale"] = json!([0, 0, 0]);
    assert!(file.fault().contains("its node has no orientation"));
}

#[test]
fn cameras_look_along_minus_z() {
    let lens =
        json!({"type": "perspective", "name": "lens", "perspective": {"yfov": 1.0, "aspectRatio": 2, "znear": 1}});
    let scene = seen(lens, json!({"name": "eye", "translation": [1, 2, 3]})).scene();
    let camera = &scene.cameras[0];
    assert_eq!((camera.name.as_str(), camera.eye, camera.forward), ("eye", Vec3::new(1.0, 2.0, 3.0), Vec3::NEG_Z));
    let top = 0.5f32.tan();
    assert!(camera.up.abs_diff_eq(Vec3::Y * top, 1e-6), "{}", camera.up);
    assert!(camera.right.abs_diff_eq(Vec3::X * 2.0 * top, 1e-6), "{}", camera.right);
    assert!(!camera.parallel && is_empty(&scene));
}

#[test]
fn without_aspect_ratio_the_picture_is_square() {
    let lens = json!({"type": "perspective", "name": "lens", "perspective": {"yfov": 1.0, "znear": 1}});
    let scene = seen(lens, json!({})).scene();
    assert!((scene.cameras[0].aspect() - 1.0).abs() < 1e-6);
    assert_eq!(scene.cameras[0].name, "lens");
}

#[test]
fn orthographic_cameras_are_parallel() {
    let lens = json!({"type": "orthographic", "orthographic": {"xmag": 3, "ymag": 2, "znear": 0, "zfar": 1}});
    let camera = seen(lens, json!({})).scene().cameras.remove(0);
    assert!(camera.parallel);
    assert_eq!((camera.right, camera.up), (Vec3::X * 3.0, Vec3::Y * 2.0));
}

#[test]
fn broken_cameras_are_refused() {
    let perspective = |values: Value| json!({"type": "perspective", "perspective": values});
    for (lens, part) in [
        (perspective(json!({"yfov": 4, "znear": 1})), "yfov is 4; expected between 0 and pi"),
        (perspective(json!({"yfov": 1, "znear": 1, "aspectRatio": 0})), "aspectRatio is 0"),
        (json!({"type": "perspective"}), "the values of that type are missing"),
        (json!({"type": "fisheye"}), "unknown type"),
        (json!({"type": "orthographic", "orthographic": {"xmag": 1, "ymag": -1, "znear": 0, "zfar": 1}}), "ymag is -1"),
    ] {
        let fault = seen(lens, json!({"name": "eye"})).fault();
        assert!(fault.starts_with("node \"eye\": camera 0: ") && fault.contains(part), "{fault}");
    }
    let mut file = seen(perspective(json!({"yfov": 1, "znear": 1})), json!({}));
    file.json["cameras"] = json!([]);
    assert!(file.fault().contains("camera 0 does not exist; the file has none"));
}
