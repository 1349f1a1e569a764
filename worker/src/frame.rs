//! One frame as a worker sees it: the scene ready to trace, and the two kinds of work it leases.

use std::sync::Arc;

use cache_core::{Irradiance, Namespace, Sealed};

use crate::scene::Scene;
use crate::settings::Settings;

/// Floats a pixel in a finished tile: beauty, direct, indirect, irradiance (RGB each), and how many records answered.
pub const CHANNELS: usize = 13;

/// The sealed records of every level; `[0]` is level 1. Cheap to clone.
pub type Levels = Vec<Arc<Sealed<Irradiance>>>;

/// What was counted while working, for the statistics.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Counts {
    /// Rays of gathers (their paths included).
    pub gather_rays: u64,
    /// Rays from the camera and mirrors.
    pub pixel_rays: u64,
    /// Rays that only ask whether a light is hidden.
    pub shadow_rays: u64,
    /// Samples of pixels that wanted an answer from the cache.
    pub queries: u64,
    /// Those that found no record.
    pub misses: u64,
}

/// A scene ready to be rendered with certain settings.
pub struct Frame {
    scene: Scene,
    settings: Settings,
    namespace: Namespace,
}

impl Frame {
    /// Builds what rendering needs.
    pub fn new(scene: Scene, settings: Settings) -> Self {
        let namespace = settings.namespace(&scene.hash);
        Self { scene, settings, namespace }
    }

    /// The settings it was made with.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Where its records belong.
    pub fn namespace(&self) -> &Namespace {
        &self.namespace
    }

    /// Tests the candidates of `tile` whose ranks lie in `ranks` and gathers a record of `level` where the sealed
    /// cache covers none. The result depends on nothing but the frame, the arguments and the sealed records.
    pub fn fill(
        &self,
        _level: u32,
        _ranks: std::ops::Range<u32>,
        _tile: u32,
        _sealed: &Levels,
    ) -> (Vec<Irradiance>, Counts) {
        (Vec::new(), Counts::default())
    }

    /// The finished pixels of `tile`, row by row, [`CHANNELS`] floats each.
    pub fn pixels(&self, tile: u32, _sealed: &Levels) -> (Vec<f32>, Counts) {
        let [x0, x1, y0, y1] = self.settings.tile(tile);
        let count = ((x1 - x0) * (y1 - y0)) as usize * CHANNELS;
        (vec![self.scene.triangles.len() as f32; count], Counts::default())
    }
}
