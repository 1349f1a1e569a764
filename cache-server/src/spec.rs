//! What a frame asks for, checked once. Past this the sizes can be trusted.

use cache_core::Namespace;
use cache_proto::{convert, v1};

use crate::refusal::Refusal;

/// Most tiles in one frame.
pub const TILES_MAX: u64 = 4 << 20;

/// Most bytes in the name of a worker, a method or a count.
pub const NAME_MAX: usize = 64;

/// Most bytes a finished pixel may have: 16 layers of float32.
pub const PIXEL_BYTES_MAX: usize = 64;

const SCENE_MAX: usize = 4096;

/// A checked frame.
#[derive(Clone, Debug)]
pub struct Job {
    /// What the workers are told.
    pub spec: v1::FrameSpec,
    /// Where the frame's records belong.
    pub namespace: Namespace,
    /// Tiles of the picture, numbered row by row; at least 1.
    pub tiles: u32,
}

impl Job {
    /// Checks what a client asks for.
    ///
    /// # Errors
    /// The first field that is outside its range.
    pub fn check(spec: v1::FrameSpec) -> Result<Self, Refusal> {
        let namespace = convert::namespace(&spec.namespace)?;
        size("scene", spec.scene.len(), 1..=SCENE_MAX)?;
        size("scene_hash", spec.scene_hash.len(), 32..=32)?;
        size("method", spec.method.len(), 1..=NAME_MAX)?;
        camera(spec.camera.as_ref())?;
        range("width", spec.width, 1..=65536)?;
        range("height", spec.height, 1..=65536)?;
        range("tile_size", spec.tile_size, 1..=256)?;
        range("spp", spec.spp, 1..=65536)?;
        range("levels", spec.levels, 0..=8)?;
        if spec.levels > 0 {
            range("rays", spec.rays, 1..=1 << 20)?;
            if !(spec.a > 0.0 && spec.a <= 10.0) {
                return Err(Refusal::field("a", format!("is {}, expected more than 0 and at most 10", spec.a)));
            }
        }
        if let Some(v1::Effort { rays, samples, .. }) = spec.effort
            && !(rays > 0.0 && rays.is_finite() && samples > 0.0 && samples.is_finite())
        {
            return Err(Refusal::field("effort", format!("is {rays} and {samples}, expected both to be more than 0")));
        }
        let [columns, rows] = [spec.width, spec.height].map(|edge| u64::from(edge.div_ceil(spec.tile_size)));
        let tiles = columns * rows;
        if tiles > TILES_MAX {
            return Err(Refusal::field("tile_size", format!("makes {tiles} tiles, expected at most {TILES_MAX}")));
        }
        Ok(Self { spec, namespace, tiles: tiles as u32 })
    }

    /// Pixels in a tile; those at the right and bottom edge may be smaller.
    pub fn pixels(&self, tile: u32) -> usize {
        let v1::FrameSpec { width, height, tile_size: edge, .. } = self.spec;
        let columns = width.div_ceil(edge);
        let span = |at: u32, end: u32| edge.min(end - at * edge) as usize;
        span(tile % columns, width) * span(tile / columns, height)
    }

    /// Most bytes a finished tile can have.
    pub fn tile_bytes_max(&self) -> usize {
        (self.spec.tile_size * self.spec.tile_size) as usize * PIXEL_BYTES_MAX
    }
}

fn camera(camera: Option<&v1::CameraSpec>) -> Result<(), Refusal> {
    let camera = camera.ok_or(Refusal::Malformed(convert::Malformed::Missing("camera")))?;
    let vectors = [
        ("camera.eye", camera.eye),
        ("camera.forward", camera.forward),
        ("camera.right", camera.right),
        ("camera.up", camera.up),
    ];
    for (field, vector) in vectors {
        let v = vector.ok_or(Refusal::Malformed(convert::Malformed::Missing(field)))?;
        if ![v.x, v.y, v.z].iter().all(|x| x.is_finite()) {
            return Err(Refusal::field(field, "is not finite"));
        }
    }
    Ok(())
}

/// Checks the name of a worker.
///
/// # Errors
/// [`Refusal::Field`] unless it has 1 to [`NAME_MAX`] bytes.
pub fn worker_name(name: &str) -> Result<(), Refusal> {
    size("worker", name.len(), 1..=NAME_MAX)
}

/// Checks how many bytes a field has.
///
/// # Errors
/// [`Refusal::Field`].
pub fn size(field: &'static str, got: usize, fit: std::ops::RangeInclusive<usize>) -> Result<(), Refusal> {
    if fit.contains(&got) {
        return Ok(());
    }
    Err(Refusal::field(field, format!("has {got} bytes, expected {} to {}", fit.start(), fit.end())))
}

fn range(field: &'static str, got: u32, fit: std::ops::RangeInclusive<u32>) -> Result<(), Refusal> {
    if fit.contains(&got) {
        return Ok(());
    }
    Err(Refusal::field(field, format!("is {got}, expected {} to {}", fit.start(), fit.end())))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A sound frame of `tiles` x 1 tiles.
    pub(crate) fn spec(tiles: u32, levels: u32) -> v1::FrameSpec {
        let vector = Some(v1::Vector { x: 1.0, y: 0.0, z: 0.0 });
        v1::FrameSpec {
            scene: "scene.glb".into(),
            scene_hash: vec![1; 32].into(),
            namespace: vec![2; 32].into(),
            camera: Some(v1::CameraSpec { eye: vector, forward: vector, right: vector, up: vector, parallel: false }),
            width: tiles * 4,
            height: 3,
            tile_size: 4,
            spp: 1,
            method: "irradiance".into(),
            a: 0.5,
            rays: 64,
            bounces: 1,
            seed: 0,
            levels,
            adaptive: false,
            splat: false,
            effort: None,
        }
    }

    #[test]
    fn every_bound_is_checked_by_name() {
        type Spoil = fn(&mut v1::FrameSpec);
        let spoilt: [(&str, Spoil); 15] = [
            ("scene:", |s| s.scene.clear()),
            ("scene_hash", |s| s.scene_hash = vec![0; 31].into()),
            ("namespace", |s| s.namespace = vec![].into()),
            ("camera is missing", |s| s.camera = None),
            ("camera.up", |s| s.camera.as_mut().expect("there").up = None),
            ("width", |s| s.width = 0),
            ("height", |s| s.height = 65537),
            ("tile_size", |s| s.tile_size = 0),
            ("tile_size", |s| s.tile_size = 257),
            ("tile_size", |s| (s.width, s.height, s.tile_size) = (65536, 65536, 1)),
            ("spp", |s| s.spp = 0),
            ("method", |s| s.method = "m".repeat(65)),
            ("a:", |s| s.a = f32::NAN),
            ("rays", |s| s.rays = 0),
            ("levels", |s| s.levels = 9),
        ];
        for (field, spoil) in spoilt {
            let mut spec = spec(5, 1);
            spoil(&mut spec);
            let message = Job::check(spec).expect_err(field).to_string();
            assert!(message.contains(field), "{field}: {message}");
        }
    }

    #[test]
    fn tiles_cover_every_pixel_once() {
        let job = Job::check(v1::FrameSpec { width: 9, height: 7, ..spec(1, 0) }).expect("sound");
        assert_eq!(job.tiles, 6);
        assert_eq!((0..6).map(|t| job.pixels(t)).collect::<Vec<_>>(), [16, 16, 4, 12, 12, 3]);
    }
}
