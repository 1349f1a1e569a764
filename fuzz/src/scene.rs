use std::fs;

use glam::Vec3;
use worker::scene::{Camera, Scene};
use worker::world::World;

use super::byte;

const BYTES_MAX: usize = 64 << 10;

/// Most copies the arrays of a .rad file may ask for here; the loader allows many more, which take time and memory.
const COPIES_MAX: u64 = 512;

/// Scenes that are traced; larger ones are only loaded.
const TRIANGLES_MAX: usize = 20_000;

/// A file is read or refused with one line; what is read keeps the promises of [`Scene`], and rays can meet it.
///
/// The first byte chooses the kind of file. Beside it lies `part.rad`, a triangle.
pub fn scene(data: &[u8]) {
    let Some((kind, bytes)) = data.split_first() else { return };
    if bytes.len() > BYTES_MAX || (kind % 4 == 2 && copies(bytes) > COPIES_MAX) {
        return;
    }
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join(["a.glb", "a.gltf", "a.rad", "a.vf"][usize::from(kind % 4)]);
    fs::write(&path, bytes).expect("room");
    let part = b"void light lamp 0 0 3 1 1 1 lamp polygon face 0 0 9 0 0 0 1 0 0 0 1 0\n";
    fs::write(directory.path().join("part.rad"), part).expect("room");
    let said = if kind % 4 == 3 {
        worker::scene::load_view(&path).map(|camera| seen(&camera, 1.0))
    } else {
        worker::scene::load(&path).map(|scene| sound(scene, byte(bytes, 0)))
    };
    if let Err(error) = said {
        one_line(&error.to_string());
    }
}

/// The product of all counts after `-a`.
fn copies(text: &[u8]) -> u64 {
    let text = String::from_utf8_lossy(text);
    let mut words = text.split(|c: char| !c.is_ascii_digit() && c != '-' && c != 'a');
    let mut copies = 1u64;
    while let Some(word) = words.next() {
        if word.ends_with("-a") {
            let count = words.by_ref().find(|word| !word.is_empty()).unwrap_or("");
            copies = copies.saturating_mul(count.parse().unwrap_or(COPIES_MAX + 1).max(1));
        }
    }
    copies
}

fn one_line(text: &str) {
    assert!(!text.is_empty() && !text.contains(char::is_control), "{text:?}");
}

fn seen(camera: &Camera, aspect: f32) {
    let camera = camera.clone().with_aspect(aspect);
    assert!((camera.forward.length() - 1.0).abs() < 1e-3, "{camera:?}");
    assert!([camera.eye, camera.right, camera.up].iter().all(|v| v.is_finite()), "{camera:?}");
    assert!(camera.aspect() > 0.0, "{camera:?}");
}

fn sound(scene: Scene, seed: u8) {
    scene.warnings.iter().for_each(|warning| one_line(warning));
    scene.cameras.iter().for_each(|camera| seen(camera, 1.5));
    assert_ne!(scene.hash, [0; 32]);
    let unit = |v: Vec3| (v.length() - 1.0).abs() < 1e-3;
    for triangle in &scene.triangles {
        assert!(triangle.positions.iter().all(|p| p.is_finite()), "{triangle:?}");
        assert!(triangle.normals.is_none_or(|normals| normals.into_iter().all(unit)), "{triangle:?}");
        assert!(triangle.uvs.iter().all(|uv| uv.is_finite()), "{triangle:?}");
        assert!((triangle.material as usize) < scene.materials.len(), "{triangle:?}");
    }
    let strength = |v: Vec3| v.is_finite() && v.min_element() >= 0.0;
    for material in &scene.materials {
        assert!(strength(material.color) && strength(material.emission), "{material:?}");
        assert!(material.texture.is_none_or(|t| (t as usize) < scene.textures.len()), "{material:?}");
    }
    for texture in &scene.textures {
        assert_eq!(texture.texels.len() as u64, u64::from(texture.width) * u64::from(texture.height));
    }
    assert!(scene.points.iter().all(|light| light.position.is_finite() && strength(light.intensity)));
    assert!(scene.distant.iter().all(|light| unit(light.to_light) && strength(light.strength)));
    if scene.triangles.len() > TRIANGLES_MAX {
        return;
    }
    let targets: Vec<Vec3> =
        scene.triangles.iter().step_by(97).take(64).map(|t| (t.positions[0] + t.positions[1]) / 2.0).collect();
    let world = World::new(scene);
    let origin = world.center + Vec3::new(0.3, f32::from(seed) / 64.0, 2.0) * world.radius;
    for target in targets {
        if let Some(direction) = (target - origin).try_normalize() {
            world.meet(origin, direction);
        }
    }
}
