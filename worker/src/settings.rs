//! What a picture depends on besides the scene: the settings users choose, and the namespace they lead to.

use cache_core::Namespace;
use cache_core::details::Details;
use glam::Vec3;

use crate::scene::Camera;

/// How indirect light is computed.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Method {
    /// Path tracing, no records: the unbiased reference.
    Path,
    /// Irradiance caching on diffuse reflection; glossy reflection is sampled per pixel.
    Irradiance,
    /// Radiance caching on all glossy reflection but mirrors, irradiance caching on the rest.
    Radiance,
    /// Radiance caching where it is as good as sampling, else as [`Self::Irradiance`].
    Auto,
}

impl Method {
    /// Every method, in the order to show them.
    pub const ALL: [Method; 4] = [Method::Path, Method::Irradiance, Method::Radiance, Method::Auto];

    /// Its name on the command line and on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Method::Path => "path",
            Method::Irradiance => "irradiance",
            Method::Radiance => "radiance",
            Method::Auto => "auto",
        }
    }

    /// The method of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.name() == name)
    }
}

/// The defaults of every picture: what they reach is charted in the README.
pub mod defaults {
    /// Rows of the picture.
    pub const HEIGHT: u32 = 512;
    /// Samples a pixel.
    pub const SPP: u32 = 32;
    /// Allowed interpolation error a.
    pub const A: f32 = 0.3;
    /// Rays in one gather.
    pub const RAYS: u32 = 6144;
    /// Seed.
    pub const SEED: u64 = 0;
}

/// `bounces` for "until Russian roulette ends the path".
pub const ALL_BOUNCES: u32 = u32::MAX;

/// Rays and samples in proportion to what they scatter by, which spends least for a given mean square (Neyman 1934).
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Effort {
    /// Rays of a gather per W/(sr m²) by which reflected radiance would deviate with one ray; positive.
    pub rays: f32,
    /// Rays at least, 4 to 1048576: so many find out how much light varies. Too few miss what is small and bright.
    pub least_rays: u32,
    /// Samples of a pixel per W/(sr m²) of standard deviation of one; positive.
    pub samples: f32,
}

/// Everything about a picture but its scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// View; its aspect is already that of the picture.
    pub camera: Camera,
    /// Pixels in a row, 1 to 65536.
    pub width: u32,
    /// Rows, 1 to 65536.
    pub height: u32,
    /// Samples a pixel, 1 to 65536.
    pub spp: u32,
    /// How indirect light is computed.
    pub method: Method,
    /// Allowed interpolation error a (Ward 1988), more than 0 and at most 10.
    pub a: f32,
    /// Rays in one gather, 4 to 1048576.
    pub rays: u32,
    /// Indirect bounces, or [`ALL_BOUNCES`].
    pub bounces: u32,
    /// Turns to another, equally good, set of random numbers.
    pub seed: u64,
    /// Work goes where light varies: `rays` and `spp` are then the most there may be. `None`: the same everywhere.
    pub effort: Option<Effort>,
    /// Practical details; only the usual ones travel over the wire.
    pub details: Details,
}

/// Edge of a tile in pixels.
pub const TILE: u32 = 16;

impl Settings {
    /// The defaults, for a picture of `width` by `height` pixels.
    pub fn new(camera: Camera, width: u32, height: u32) -> Self {
        Self {
            camera: camera.with_aspect(width as f32 / height as f32),
            width,
            height,
            spp: defaults::SPP,
            method: Method::Irradiance,
            a: defaults::A,
            rays: defaults::RAYS,
            bounces: ALL_BOUNCES,
            seed: defaults::SEED,
            effort: None,
            details: Details::default(),
        }
    }

    /// Pixels of the picture.
    pub fn size(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    /// Tiles of the picture, numbered row by row.
    pub fn tiles(&self) -> u32 {
        self.width.div_ceil(TILE) * self.height.div_ceil(TILE)
    }

    /// Pixels of a tile: x from, x to, y from, y to.
    pub fn tile(&self, tile: u32) -> [u32; 4] {
        let columns = self.width.div_ceil(TILE);
        let (x, y) = (tile % columns * TILE, tile / columns * TILE);
        [x, (x + TILE).min(self.width), y, (y + TILE).min(self.height)]
    }

    /// The pixels of a tile, row by row.
    pub fn pixels(&self, tile: u32) -> impl Iterator<Item = [u32; 2]> + use<> {
        let [x0, x1, y0, y1] = self.tile(tile);
        (y0..y1).flat_map(move |y| (x0..x1).map(move |x| [x, y]))
    }

    /// Origin and unit direction of the ray through pixel coordinates; (0, 0) is the top left corner of the picture.
    pub fn ray(&self, x: f32, y: f32) -> (Vec3, Vec3) {
        self.camera.ray(2.0 * x / self.width as f32 - 1.0, 1.0 - 2.0 * y / self.height as f32)
    }

    /// Edge of a pixel projected `way` along its ray, world length.
    pub fn pixel_size(&self, way: f32) -> f32 {
        let edge = 2.0 * self.camera.up.length() / self.height as f32;
        if self.camera.parallel { edge } else { edge * way }
    }

    /// The namespace of the records: scene content and what changes a record's value. The camera, the size and `spp`
    /// are not part of it: they decide which records are made, not what is in them.
    pub fn namespace(&self, scene_hash: &[u8; 32]) -> Namespace {
        let mut hasher = blake3::Hasher::new_derive_key("ambience namespace v1");
        hasher.update(scene_hash);
        hasher.update(self.method.name().as_bytes());
        hasher.update(&self.a.to_le_bytes());
        hasher.update(&self.rays.to_le_bytes());
        hasher.update(&self.bounces.to_le_bytes());
        hasher.update(&self.seed.to_le_bytes());
        if let Some(effort) = self.effort {
            hasher.update(&effort.rays.to_le_bytes());
            hasher.update(&effort.least_rays.to_le_bytes());
        }
        Namespace(*hasher.finalize().as_bytes())
    }
}
