//! What is looked at: a scene, through a camera, on so many pixels.

use std::path::{Path, PathBuf};

use worker::scene::{self, Camera, Scene};
use worker::settings::defaults;

use crate::failure::Failure;

/// Scene, camera and size.
#[derive(Clone, Debug, clap::Args)]
pub struct ViewArgs {
    /// Scene file: .glb, .gltf or .rad
    pub scene: PathBuf,
    /// Size in pixels [default: 512 high, as wide as the camera's aspect]. Another aspect than the camera's keeps the
    /// vertical field of view
    #[arg(long, value_name = "WxH", value_parser = size)]
    pub size: Option<[u32; 2]>,
    /// Camera of the scene by name, or a Radiance view file [default: the scene's first; SCENE.vf for SCENE.rad]
    #[arg(long, value_name = "NAME | FILE.vf")]
    pub camera: Option<String>,
}

impl ViewArgs {
    /// The camera for the loaded scene, and the size of the picture.
    ///
    /// # Errors
    /// [`Failure::Usage`]: no such camera.
    pub fn of(&self, scene: &Scene) -> Result<(Camera, [u32; 2]), Failure> {
        let camera = self.find_camera(scene)?;
        let [width, height] = self.size.unwrap_or_else(|| {
            let width = (defaults::HEIGHT as f32 * camera.aspect()).round().clamp(1.0, 65536.0);
            [width as u32, defaults::HEIGHT]
        });
        // The default size is the camera's own aspect but for rounding; what is inside the picture follows its size.
        Ok((camera.with_aspect(width as f32 / height as f32), [width, height]))
    }

    fn find_camera(&self, scene: &Scene) -> Result<Camera, Failure> {
        let view = |path: &Path| scene::load_view(path).map_err(Failure::usage);
        if let Some(name) = &self.camera {
            if Path::new(name).extension().is_some_and(|e| e.eq_ignore_ascii_case("vf")) {
                return view(name.as_ref());
            }
            let named = scene.cameras.iter().find(|c| c.name == *name).cloned();
            return named.ok_or_else(|| {
                Failure::usage(format!("--camera {name}: {} has {}", self.scene.display(), cameras(scene)))
            });
        }
        let beside = self.scene.with_extension("vf");
        if self.scene.extension().is_some_and(|e| e.eq_ignore_ascii_case("rad")) && beside.is_file() {
            return view(&beside);
        }
        scene.cameras.first().cloned().ok_or_else(|| {
            let scene = self.scene.display();
            Failure::usage(format!("{scene} has no camera: name a view file with --camera FILE.vf"))
        })
    }
}

/// The cameras there are, in words.
fn cameras(scene: &Scene) -> String {
    let names: Vec<_> = scene.cameras.iter().map(|c| format!("{:?}", c.name)).collect();
    if names.is_empty() { "no cameras".into() } else { format!("the cameras {}", names.join(", ")) }
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let parsed = text.split_once(['x', 'X']).and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    match parsed {
        Some([w, h]) if (1..=65536).contains(&w) && (1..=65536).contains(&h) => Ok([w, h]),
        _ => Err("expected WIDTHxHEIGHT in pixels, each 1 to 65536".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_two_numbers() {
        assert_eq!(size("640x480"), Ok([640, 480]));
        for wrong in ["0x5", "5", "axb", "5x70000", "5x"] {
            assert!(size(wrong).is_err());
        }
    }
}
