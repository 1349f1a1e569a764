//! What a frame's specification says on the wire, from and to [`Settings`].

use cache_core::Namespace;
use cache_core::details::Details;
use cache_proto::v1;
use glam::Vec3;

use crate::frame::Frame;
use crate::scene::Camera;
use crate::settings::{Effort, Method, Settings, TILE};

/// The message that describes a frame of the scene at `path` (as every worker can open it) with content `hash`.
pub fn message(frame: &Frame, path: &str, hash: &[u8; 32]) -> v1::FrameSpec {
    written(frame.settings(), frame.levels(), frame.namespace(), path, hash)
}

fn written(settings: &Settings, levels: u32, namespace: &Namespace, path: &str, hash: &[u8; 32]) -> v1::FrameSpec {
    let camera = &settings.camera;
    v1::FrameSpec {
        scene: path.into(),
        scene_hash: hash.to_vec().into(),
        namespace: namespace.0.to_vec().into(),
        camera: Some(v1::CameraSpec {
            eye: Some(vector(camera.eye)),
            forward: Some(vector(camera.forward)),
            right: Some(vector(camera.right)),
            up: Some(vector(camera.up)),
            parallel: camera.parallel,
        }),
        width: settings.width,
        height: settings.height,
        tile_size: TILE,
        spp: settings.spp,
        method: settings.method.name().into(),
        a: settings.a,
        rays: settings.rays,
        bounces: settings.bounces,
        seed: settings.seed,
        levels,
        effort: settings.effort.map(|Effort { rays, least_rays, samples }| v1::Effort { rays, samples, least_rays }),
        adaptive: settings.details.adaptive,
        splat: false,
    }
}

/// The settings in a message, checked.
///
/// # Errors
/// One line naming the field that is out of its range.
pub fn settings(spec: &v1::FrameSpec) -> Result<Settings, String> {
    let camera = spec.camera.as_ref().ok_or("the frame has no camera")?;
    let field = |v: &Option<v1::Vector>, name: &str| -> Result<Vec3, String> {
        let v = v.as_ref().ok_or_else(|| format!("the camera has no {name}"))?;
        let v = Vec3::new(v.x, v.y, v.z);
        if v.is_finite() { Ok(v) } else { Err(format!("the camera's {name} is not finite")) }
    };
    let settings = Settings {
        camera: Camera {
            name: String::new(),
            eye: field(&camera.eye, "eye")?,
            forward: field(&camera.forward, "forward")?,
            right: field(&camera.right, "right")?,
            up: field(&camera.up, "up")?,
            parallel: camera.parallel,
        },
        width: spec.width,
        height: spec.height,
        spp: spec.spp,
        method: Method::from_name(&spec.method).ok_or_else(|| format!("method {:?} is unknown here", spec.method))?,
        a: spec.a,
        rays: spec.rays,
        bounces: spec.bounces,
        seed: spec.seed,
        effort: spec.effort.map(|v1::Effort { rays, samples, least_rays }| Effort { rays, least_rays, samples }),
        details: Details { adaptive: spec.adaptive, ..Details::default() },
    };
    check(&settings)?;
    if spec.tile_size != TILE {
        return Err(format!("tile_size is {}, expected {TILE}", spec.tile_size));
    }
    Ok(settings)
}

/// Checks the ranges [`Settings`] documents.
///
/// # Errors
/// One line naming the first that is out of its range.
pub fn check(settings: &Settings) -> Result<(), String> {
    let range = |value: u32, from: u32, to: u32, name: &str| match value {
        v if (from..=to).contains(&v) => Ok(()),
        v => Err(format!("{name} is {v}, expected {from} to {to}")),
    };
    range(settings.width, 1, 65536, "width")?;
    range(settings.height, 1, 65536, "height")?;
    range(settings.spp, 1, 65536, "spp")?;
    range(settings.rays, 4, 1 << 20, "rays")?;
    if !(settings.a > 0.0 && settings.a <= 10.0) {
        return Err(format!("a is {}, expected more than 0 and at most 10", settings.a));
    }
    for (value, name) in settings.effort.iter().flat_map(|e| [(e.rays, "effort.rays"), (e.samples, "effort.samples")]) {
        if !(value > 0.0 && value.is_finite()) {
            return Err(format!("{name} is {value}, expected more than 0"));
        }
    }
    if let Some(effort) = settings.effort {
        range(effort.least_rays, 4, 1 << 20, "effort.least_rays")?;
    }
    Ok(())
}

fn vector(v: Vec3) -> v1::Vector {
    v1::Vector { x: v.x, y: v.y, z: v.z }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::settings::ALL_BOUNCES;

    pub(crate) fn sample() -> Settings {
        let camera = Camera::look(Vec3::new(0.1, 0.2, 0.3), Vec3::Y, Vec3::Z, 0.7, 0.5, false).expect("view");
        Settings {
            camera,
            width: 40,
            height: 20,
            spp: 4,
            method: Method::Irradiance,
            a: 0.3,
            rays: 64,
            bounces: ALL_BOUNCES,
            seed: u64::MAX,
            effort: Some(Effort { rays: 3.5, least_rays: 32, samples: 0.1 }),
            details: Details::default(),
        }
    }

    #[test]
    fn settings_survive_the_wire_bit_for_bit() {
        let spec = written(&sample(), 2, &Namespace([2; 32]), "/a", &[1; 32]);
        assert_eq!(settings(&spec), Ok(sample()));
    }

    #[test]
    fn what_is_out_of_range_is_named() {
        let spec = written(&sample(), 2, &Namespace([2; 32]), "/a", &[1; 32]);
        let wrong = |change: fn(&mut v1::FrameSpec)| {
            let mut spec = spec.clone();
            change(&mut spec);
            settings(&spec).expect_err("out of range")
        };
        assert_eq!(wrong(|s| s.effort = Some(v1::Effort::default())), "effort.rays is 0, expected more than 0");
        assert_eq!(wrong(|s| s.width = 0), "width is 0, expected 1 to 65536");
        assert_eq!(wrong(|s| s.a = f32::NAN), "a is NaN, expected more than 0 and at most 10");
        assert_eq!(wrong(|s| s.method = "magic".into()), "method \"magic\" is unknown here");
        assert_eq!(wrong(|s| s.tile_size = 8), "tile_size is 8, expected 16");
        assert_eq!(wrong(|s| s.camera = None), "the frame has no camera");
    }
}
