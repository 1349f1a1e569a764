//! Scenes with references, and the measure pictures of them are held to.

use std::path::{Path, PathBuf};

use exr::prelude::*;
use worker::frame::{CHANNELS, Frame};
use worker::scene::{self, Camera, Scene};
use worker::settings::{ALL_BOUNCES, Settings};
use worker::solo::{self, Order};

/// Edge of the references in pixels.
pub const SIZE: usize = 128;

/// A file of the tests.
pub fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests").join(name)
}

/// A scene of `tests/scenes` and its camera.
///
/// # Panics
/// If the file is missing or damaged: it belongs to the repository.
pub fn load(name: &str) -> (Scene, Camera) {
    let path = file("scenes").join(name);
    let scene = scene::load(&path).unwrap_or_else(|e| panic!("{e}"));
    let camera = match scene.cameras.first() {
        Some(camera) => camera.clone(),
        None => scene::load_view(&path.with_extension("vf")).unwrap_or_else(|e| panic!("{e}")),
    };
    (scene, camera)
}

/// Default settings for a square picture of `SIZE` pixels; `depth` is "one" or "full".
pub fn settings(camera: Camera, depth: &str) -> Settings {
    let bounces = if depth == "one" { 1 } else { ALL_BOUNCES };
    Settings { bounces, ..Settings::new(camera, SIZE as u32, SIZE as u32) }
}

/// Renders in this process; linear RGB, row by row.
pub fn render(scene: Scene, settings: Settings) -> Vec<[f64; 3]> {
    let frame = Frame::new(scene, settings);
    let levels = solo::fill(&frame, Order::Rounds);
    rgb(&solo::pixels(&frame, &levels).0)
}

/// Linear RGB of a finished frame's pixels.
pub fn rgb(pixels: &[f32]) -> Vec<[f64; 3]> {
    pixels.chunks_exact(CHANNELS).map(|p| [p[0].into(), p[1].into(), p[2].into()]).collect()
}

/// Averages a square picture down to the references' size.
///
/// # Panics
/// Unless its edge is a multiple of [`SIZE`].
pub fn reduce(image: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let edge = image.len().isqrt();
    assert!(edge * edge == image.len() && edge.is_multiple_of(SIZE), "a square picture of a multiple of {SIZE} pixels");
    let factor = edge / SIZE;
    let mut small = vec![[0.0; 3]; SIZE * SIZE];
    for (i, pixel) in image.iter().enumerate() {
        let at = &mut small[i / edge / factor * SIZE + i % edge / factor];
        *at = std::array::from_fn(|c| at[c] + pixel[c] / (factor * factor) as f64);
    }
    small
}

/// A reference picture with its standard error, pixel by pixel.
pub struct Reference {
    /// Linear RGB radiance, row by row.
    pub image: Vec<[f64; 3]>,
    /// Standard error of each pixel's luminance, or of its channels' root mean square.
    pub error: Vec<f64>,
}

/// Reads `tests/references/NAME.exr`, for instance "cornell.full".
///
/// # Panics
/// If the file is missing or damaged: it belongs to the repository.
pub fn reference(name: &str) -> Reference {
    let path = file("references").join(format!("{name}.exr"));
    Reference::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

impl Reference {
    /// Reads a file with the channels R, G, B and stderr.
    ///
    /// # Errors
    /// One that is missing or damaged.
    pub fn read(path: &Path) -> Result<Self> {
        let image = read_first_flat_layer_from_file(path)?;
        let channels = image.layer_data.channel_data.list;
        let values = |name: &str| -> Result<Vec<f64>> {
            let channel =
                channels.iter().find(|c| c.name.eq(name)).ok_or(Error::Invalid("a missing channel".into()))?;
            Ok(channel.sample_data.values_as_f32().map(f64::from).collect())
        };
        let [r, g, b] = [values("R")?, values("G")?, values("B")?];
        let image = r.iter().zip(&g).zip(&b).map(|((r, g), b)| [*r, *g, *b]).collect();
        Ok(Self { image, error: values("stderr")? })
    }

    /// Writes such a file, as high as wide.
    ///
    /// # Errors
    /// The disk's.
    pub fn write(&self, path: &Path) -> Result<()> {
        let channel = |name, values: Vec<f64>| {
            let values: Vec<f32> = values.into_iter().map(|v| v as f32).collect();
            AnyChannel::new(name, FlatSamples::F32(values))
        };
        let color = |c: usize| self.image.iter().map(|p| p[c]).collect();
        let channels = [channel("R", color(0)), channel("G", color(1)), channel("B", color(2))];
        let list = channels.into_iter().chain([channel("stderr", self.error.clone())]).collect();
        let edge = self.error.len().isqrt();
        Image::from_channels((edge, edge), AnyChannels::sort(list)).write().to_file(path)
    }
}

/// How far a picture is from a reference, relative to the reference's mean.
#[derive(Debug)]
pub struct Verdict {
    /// Root mean square over all channels, the reference's own noise subtracted.
    pub rmse: f64,
    /// Difference of the means.
    pub bias: f64,
    /// Largest difference of an 8 x 8 block's mean.
    pub worst: f64,
    /// Left and top of that block.
    pub place: [usize; 2],
}

/// Judges a picture; pixels that see a lamp, and their neighbours, are left out: how edges of lamps are covered says
/// nothing about indirect light.
pub fn judge(image: &[[f64; 3]], reference: &Reference) -> Verdict {
    let hot = lamps(&reference.image);
    let cold: Vec<usize> = (0..image.len()).filter(|i| !hot[*i]).collect();
    let mean = |im: &[[f64; 3]]| cold.iter().flat_map(|&i| im[i]).sum::<f64>() / (3 * cold.len()) as f64;
    let scale = mean(&reference.image);
    let squares: f64 =
        cold.iter().flat_map(|&i| (0..3).map(move |c| (image[i][c] - reference.image[i][c]).powi(2))).sum();
    let noise: f64 = cold.iter().map(|&i| reference.error[i].powi(2)).sum::<f64>() / cold.len() as f64;
    let (mut worst, mut place) = (0f64, [0; 2]);
    for block in 0..(SIZE / 8).pow(2) {
        let (x0, y0) = (block % (SIZE / 8) * 8, block / (SIZE / 8) * 8);
        let inside: Vec<usize> = (0..64).map(|k| (y0 + k / 8) * SIZE + x0 + k % 8).filter(|i| !hot[*i]).collect();
        if inside.len() > 32 {
            let sums = inside.iter().fold([0.0; 3], |sums: [f64; 3], &i| {
                std::array::from_fn(|c| sums[c] + image[i][c] - reference.image[i][c])
            });
            let apart = sums.map(|sum| (sum / inside.len() as f64).abs()).into_iter().fold(0.0, f64::max);
            if apart > worst {
                (worst, place) = (apart, [x0, y0]);
            }
        }
    }
    Verdict {
        rmse: (squares / (3 * cold.len()) as f64 - noise).max(0.0).sqrt() / scale,
        bias: mean(image) / scale - 1.0,
        worst: worst / scale,
        place,
    }
}

fn lamps(image: &[[f64; 3]]) -> Vec<bool> {
    let brightest: Vec<f64> = image.iter().map(|p| p.iter().copied().fold(0.0, f64::max)).collect();
    let mut sorted = brightest.clone();
    sorted.sort_by(f64::total_cmp);
    let limit = 1.3 * sorted[sorted.len() * 98 / 100];
    let lit = |x: usize, y: usize| brightest[y % SIZE * SIZE + x % SIZE] > limit;
    let near = |i: usize| {
        let (x, y) = (i % SIZE + SIZE, i / SIZE + SIZE);
        (0..9).any(|k| lit(x + k % 3 - 1, y + k / 3 - 1))
    };
    let hot: Vec<bool> = (0..image.len()).map(near).collect();
    let share = hot.iter().filter(|h| **h).count() as f64 / hot.len() as f64;
    if share > 0.05 { vec![false; hot.len()] } else { hot }
}
