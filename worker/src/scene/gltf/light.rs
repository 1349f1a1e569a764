//! KHR_lights_punctual. Its photometric units are taken as radiometric ones: candela as W/sr, lux as W/m2.

use ::gltf::json::extensions::scene::khr_lights_punctual::{Light, Spot as Cone, Type};
use ::gltf::json::validation::Checked;
use ::gltf::json::{Index, Root};
use glam::{DVec3, Vec3};

use super::container::beyond;
use super::placement::Placement;
use super::{Fault, name};
use crate::scene::{DistantLight, PointLight, Rgb, Scene, Spot};

/// Adds the light `index` at `place`. It shines along -Z of its node.
pub(super) fn place(root: &Root, index: Index<Light>, place: &Placement, scene: &mut Scene) -> Result<(), Fault> {
    let lights = lights(root);
    let light = lights.get(index.value()).ok_or_else(|| format!("light {index} {}", beyond(lights.len())))?;
    add(light, place, scene)
        .map_err(|fault| format!("{}: {fault}", name("light", light.name.as_deref(), index.value())))
}

/// What the reader should know about the document's lights.
pub(super) fn warnings(root: &Root) -> impl Iterator<Item = String> {
    lights(root).iter().enumerate().filter(|(_, light)| light.range.is_some()).map(|(index, light)| {
        format!("{}: range is ignored; light falls off by distance alone", name("light", light.name.as_deref(), index))
    })
}

fn lights(root: &Root) -> &[Light] {
    root.extensions.as_ref().and_then(|e| e.khr_lights_punctual.as_ref()).map_or(&[], |e| &e.lights)
}

fn add(light: &Light, place: &Placement, scene: &mut Scene) -> Result<(), Fault> {
    let strength = strength(light)?;
    let axis = || place.direction(DVec3::NEG_Z).ok_or("its node has no orientation");
    let position = place.origin();
    if !position.is_finite() {
        return Err(format!("lies at {:?}; expected finite numbers", position.to_array()));
    }
    match light.type_ {
        Checked::Valid(Type::Directional) => {
            scene.distant.push(DistantLight { to_light: -axis()?, cos_half_angle: 1.0, strength })
        }
        Checked::Valid(Type::Point) => scene.points.push(PointLight { position, intensity: strength, spot: None }),
        Checked::Valid(Type::Spot) => {
            let spot = Some(spot(light.spot.as_ref().ok_or("spot: is missing")?, axis()?)?);
            scene.points.push(PointLight { position, intensity: strength, spot });
        }
        Checked::Invalid => return Err("unknown type; expected directional, point or spot".into()),
    }
    Ok(())
}

fn strength(light: &Light) -> Result<Rgb, Fault> {
    let strength = Rgb::from(light.color) * light.intensity;
    let valid = |value: f32| value >= 0.0 && value.is_finite();
    if valid(light.intensity) && light.color.into_iter().all(valid) && strength.is_finite() {
        return Ok(strength);
    }
    Err(format!("color {:?} times intensity {} is not a strength; expected at least 0", light.color, light.intensity))
}

fn spot(cone: &Cone, axis: Vec3) -> Result<Spot, Fault> {
    let (inner, outer) = (cone.inner_cone_angle, cone.outer_cone_angle);
    let cosine = |angle: f32| libm::cos(f64::from(angle)) as f32;
    let spot = Spot { axis, cos_inner: cosine(inner), cos_outer: cosine(outer) };
    // The cosines too: the falloff divides by their difference.
    let valid =
        inner >= 0.0 && inner < outer && outer <= std::f32::consts::FRAC_PI_2 && spot.cos_outer < spot.cos_inner;
    if valid {
        return Ok(spot);
    }
    Err(format!("innerConeAngle {inner} and outerConeAngle {outer}; expected 0 <= inner < outer <= pi/2"))
}
