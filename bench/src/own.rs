//! Scenes of our own, made up when they are asked for, and references of them by our own path tracer: nothing was tuned on
//! them, and what only they need is no file of the repository.

use std::error::Error;
use std::path::PathBuf;

use worker::frame::Frame;
use worker::scene::{self, Camera, Scene};
use worker::settings::{Method, Settings};
use worker::solo;

use crate::judge::{Reference, rgb, settings};
use crate::model::Model;
use crate::{arcade, louvres};

/// Their names.
pub const NAMES: [&str; 2] = ["arcade", "louvres"];

/// Pictures a reference is the mean of, and samples a pixel of each. Their scatter is its standard error.
const PICTURES: u64 = 16;
const SPP: u32 = 128;

fn model(name: &str) -> Option<Model> {
    [arcade::model, louvres::model].map(|model| model()).into_iter().find(|model| model.name == name)
}

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../target/own")
}

/// Writes the files of a scene of that name, if there is one, and names its .rad.
///
/// # Errors
/// The disk's.
pub fn file(name: &str) -> std::io::Result<Option<PathBuf>> {
    let Some(model) = model(name) else { return Ok(None) };
    model.write(&folder())?;
    Ok(Some(folder().join(format!("{name}.rad"))))
}

/// A scene of its name, as its .rad file says, with its view and reference; the reference is made once and kept under
/// target/.
///
/// # Errors
/// The disk's; a name that is none of [`NAMES`].
pub fn load(name: &str) -> Result<(Scene, Camera, Reference), Box<dyn Error>> {
    let path = file(name)?.ok_or_else(|| format!("{name}: expected one of {}", NAMES.join(", ")))?;
    let (scene, camera) = (scene::load(&path)?, scene::load_view(&path.with_extension("vf"))?);
    let reference = reference(name, &scene, &camera)?;
    Ok((scene, camera, reference))
}

/// Linear RGB by the path tracer, all bounces, at the size of references.
fn traced(scene: &Scene, settings: Settings, spp: u32, seed: u64) -> Vec<[f64; 3]> {
    let frame = Frame::new(scene.clone(), Settings { method: Method::Path, spp, seed, ..settings });
    rgb(&solo::pixels(&frame, &Vec::new()).0)
}

/// A reference of a scene of that name, made once and kept under target/.
///
/// # Errors
/// The disk's.
pub fn reference(name: &str, scene: &Scene, camera: &Camera) -> Result<Reference, Box<dyn Error>> {
    let view = blake3::hash(format!("{camera:?}").as_bytes());
    std::fs::create_dir_all(folder())?;
    let digest = hex::encode(&scene.hash[..4]) + &hex::encode(&view.as_bytes()[..4]);
    let path = folder().join(format!("{name}-{digest}-{}.exr", PICTURES * u64::from(SPP)));
    if path.exists() {
        return Ok(Reference::read(&path)?);
    }
    eprintln!("{name}: making its reference, {PICTURES} pictures of {SPP} samples a pixel: minutes, once");
    let base = settings(camera.clone(), "full");
    // Seeds no render uses by default.
    let pictures: Vec<_> = (0..PICTURES).map(|k| traced(scene, base.clone(), SPP, 1_000_003 + k)).collect();
    let n = PICTURES as f64;
    let pixels = (0..base.size() as usize).map(|i| {
        let mean: [f64; 3] = std::array::from_fn(|c| pictures.iter().map(|p| p[i][c]).sum::<f64>() / n);
        let squares = |c: usize| pictures.iter().map(|p| (p[i][c] - mean[c]).powi(2)).sum::<f64>() / (n - 1.0) / n;
        (mean, ((squares(0) + squares(1) + squares(2)) / 3.0).sqrt())
    });
    let (image, error) = pixels.unzip();
    let reference = Reference { image, error };
    reference.write(&path)?;
    Ok(reference)
}

/// A test of a model: its two files hold the same surfaces, and give pictures whose means do not differ.
#[cfg(test)]
pub(crate) fn both_files_give_one_picture(model: &Model) {
    let folder = tempfile::tempdir().expect("a folder");
    model.write(folder.path()).expect("written");
    let file = |ending: &str| folder.path().join(format!("{}.{ending}", model.name));
    let bytes = ["rad", "vf", "glb"].map(|ending| std::fs::read(file(ending)).expect("a file"));
    let scenes = ["rad", "glb"].map(|ending| scene::load(&file(ending)).expect("a scene"));
    assert!(scenes.iter().all(|s| s.warnings.is_empty()), "{:?}", scenes[0].warnings);
    let count = scenes[0].triangles.len();
    assert_eq!(count, model.triangles());
    let same = scenes[0].triangles.iter().zip(&scenes[1].triangles).all(|(a, b)| a.positions == b.positions);
    assert!(same, "the surfaces differ");
    let cameras = [scene::load_view(&file("vf")).expect("a view"), scenes[1].cameras[0].clone()];
    // Mean of each channel, and what it scatters by, of eight pictures.
    let [rad, glb] = [0, 1].map(|k| {
        let small = Settings { width: 32, height: 32, ..settings(cameras[k].clone(), "full") };
        let means: Vec<[f64; 3]> = (0..8)
            .map(|seed| {
                let image = traced(&scenes[k], small.clone(), 32, seed);
                std::array::from_fn(|c| image.iter().map(|p| p[c]).sum::<f64>() / image.len() as f64)
            })
            .collect();
        [0, 1, 2].map(|c| {
            let mean = means.iter().map(|m| m[c]).sum::<f64>() / 8.0;
            (mean, means.iter().map(|m| (m[c] - mean).powi(2)).sum::<f64>() / 7.0 / 8.0)
        })
    });
    for (c, ((a, scatter_a), (b, scatter_b))) in rad.into_iter().zip(glb).enumerate() {
        let sigma = (scatter_a + scatter_b).sqrt();
        println!("{c}: {a} {b}, sigma {sigma}");
        assert!(sigma < 0.005 * a, "too noisy to tell: {sigma} of {a}");
        assert!((a - b).abs() < 4.0 * sigma, "channel {c}: .rad {a}, .glb {b}, sigma {sigma}");
    }
    model.write(folder.path()).expect("written again");
    assert_eq!(bytes, ["rad", "vf", "glb"].map(|ending| std::fs::read(file(ending)).expect("a file")));
}
