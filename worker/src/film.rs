//! Finished tiles become a picture: OUT.exr with its layers, and OUT.png for looking.
//!
//! The EXR has one part with 13 float32 channels: beauty as `R`, `G`, `B`, and the layers `direct`, `indirect`,
//! `irradiance` (`.R`, `.G`, `.B` each) and `records.N`; ZIP compression, scan lines from top to bottom. Its bytes depend
//! on the pixels and the attributes alone: no time, no machine, no order of arrival.
//!
//! The PNG shows the beauty in 8-bit sRGB, exposed so that the 98th percentile of luminance becomes 0.8 in linear light
//! (about 0.9 encoded); brighter is clipped.

use std::io::{Cursor, Write as _};
use std::path::{Path, PathBuf};

use exr::prelude::{
    AnyChannel, AnyChannels, AttributeValue, Blocks, Compression, Encoding, FlatSamples, Image, Layer, LayerAttributes,
    LineOrder, Text, Vec2, WritableImage as _,
};
use tempfile::NamedTempFile;

use crate::frame::CHANNELS;
use crate::settings::Settings;

/// Names of the channels, in the order of a tile's floats.
pub const NAMES: [&str; CHANNELS] = [
    "R",
    "G",
    "B",
    "direct.R",
    "direct.G",
    "direct.B",
    "indirect.R",
    "indirect.G",
    "indirect.B",
    "irradiance.R",
    "irradiance.G",
    "irradiance.B",
    "records.N",
];

/// Where the PNG's exposure puts the 98th percentile of luminance, linear.
const EXPOSED: f32 = 0.8;

/// Why a film cannot take a tile or become a file.
#[derive(Debug, thiserror::Error)]
pub enum FilmError {
    /// A tile the picture does not have.
    #[error("tile {0} is outside the picture")]
    Tile(u32),
    /// A tile with another number of bytes than its pixels need.
    #[error("tile {tile} has {got} bytes, expected {expected}")]
    Size {
        /// Which.
        tile: u32,
        /// Bytes there were.
        got: usize,
        /// Bytes of its pixels.
        expected: usize,
    },
    /// The encoder's complaint.
    #[error("cannot encode the picture: {0}")]
    Encode(String),
    /// A file that cannot be written or read.
    #[error("{}: {reason}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

/// A picture being put together.
pub struct Film {
    settings: Settings,
    /// One plane a channel, row by row.
    planes: [Vec<f32>; CHANNELS],
    have: Vec<bool>,
}

impl Film {
    /// An empty picture.
    pub fn new(settings: &Settings) -> Self {
        let pixels = settings.width as usize * settings.height as usize;
        Self {
            settings: settings.clone(),
            planes: std::array::from_fn(|_| vec![0.0; pixels]),
            have: vec![false; settings.tiles() as usize],
        }
    }

    /// Puts a tile in place: packed float32 little endian, pixels row by row, [`CHANNELS`] floats each. Says whether it
    /// was new; a tile that comes again is the same tile and changes nothing.
    ///
    /// # Errors
    /// [`FilmError::Tile`], [`FilmError::Size`].
    pub fn add(&mut self, tile: u32, bytes: &[u8]) -> Result<bool, FilmError> {
        let have = self.have.get_mut(tile as usize).ok_or(FilmError::Tile(tile))?;
        let [x0, x1, y0, y1] = self.settings.tile(tile);
        let expected = ((x1 - x0) * (y1 - y0)) as usize * CHANNELS * 4;
        if bytes.len() != expected {
            return Err(FilmError::Size { tile, got: bytes.len(), expected });
        }
        if std::mem::replace(have, true) {
            return Ok(false);
        }
        self.put(tile, bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])));
        Ok(true)
    }

    /// Puts the floats of a tile of the picture in place, whether or not it has come before.
    pub fn put(&mut self, tile: u32, mut floats: impl Iterator<Item = f32>) {
        let [x0, x1, y0, y1] = self.settings.tile(tile);
        for y in y0..y1 {
            for x in x0..x1 {
                let at = y as usize * self.settings.width as usize + x as usize;
                for (plane, value) in self.planes.iter_mut().zip(&mut floats) {
                    plane[at] = value;
                }
            }
        }
    }

    /// Tiles that have not come.
    pub fn missing(&self) -> usize {
        self.have.iter().filter(|h| !**h).count()
    }

    /// Whether every pixel of the beauty is exactly 0.
    pub fn is_black(&self) -> bool {
        self.planes[..3].iter().flatten().all(|v| *v == 0.0)
    }

    /// The PNG's bytes.
    ///
    /// # Errors
    /// [`FilmError::Encode`].
    pub fn png(&self) -> Result<Vec<u8>, FilmError> {
        let [r, g, b, ..] = &self.planes;
        let luminance = |i: usize| 0.2126 * r[i] + 0.7152 * g[i] + 0.0722 * b[i];
        let mut sorted: Vec<f32> = (0..r.len()).map(luminance).filter(|l| l.is_finite()).collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let bright = sorted.get(sorted.len() * 98 / 100).copied().unwrap_or(0.0);
        let exposure = if bright > 0.0 { EXPOSED / bright } else { 1.0 };
        let mut pixels = Vec::with_capacity(r.len() * 3);
        for ((r, g), b) in r.iter().zip(g).zip(b) {
            pixels.extend([r, g, b].map(|v| srgb(v * exposure)));
        }
        let mut bytes = Cursor::new(Vec::new());
        image::write_buffer_with_format(
            &mut bytes,
            &pixels,
            self.settings.width,
            self.settings.height,
            image::ExtendedColorType::Rgb8,
            image::ImageFormat::Png,
        )
        .map_err(|e| FilmError::Encode(e.to_string()))?;
        Ok(bytes.into_inner())
    }

    /// The EXR's bytes. `attributes` go to the header as text, each name with `ambience:` before it.
    ///
    /// # Errors
    /// [`FilmError::Encode`].
    pub fn exr(self, attributes: &[(&str, String)]) -> Result<Vec<u8>, FilmError> {
        let text =
            |value: &str| Text::new_or_none(value).ok_or_else(|| FilmError::Encode(format!("attribute {value:?}")));
        let mut own = LayerAttributes { software_name: Some(text("ambience")?), ..LayerAttributes::default() };
        for (name, value) in attributes {
            own.other.insert(text(&format!("ambience:{name}"))?, AttributeValue::Text(text(value)?));
        }
        let channels = NAMES.into_iter().zip(self.planes);
        let channels = channels.map(|(name, plane)| channel(name, plane)).collect();
        // Any other order is the order in which threads happen to finish.
        let line_order = LineOrder::Increasing;
        let encoding = Encoding { compression: Compression::ZIP16, blocks: Blocks::ScanLines, line_order };
        let size = Vec2(self.settings.width as usize, self.settings.height as usize);
        let image = Image::from_layer(Layer::new(size, own, encoding, AnyChannels::sort(channels)));
        let mut bytes = Cursor::new(Vec::new());
        image.write().to_buffered(&mut bytes).map_err(|e| FilmError::Encode(e.to_string()))?;
        let mut bytes = bytes.into_inner();
        sort_header(&mut bytes).ok_or_else(|| FilmError::Encode("its header is not as expected".into()))?;
        Ok(bytes)
    }
}

fn channel(name: &str, plane: Vec<f32>) -> AnyChannel<FlatSamples> {
    // The hint is for lossy compression of colours: false everywhere, where the encoder guesses by name.
    let (quantize_linearly, sampling) = (false, Vec2(1, 1));
    AnyChannel { name: name.into(), sample_data: FlatSamples::F32(plane), quantize_linearly, sampling }
}

/// Linear light to an 8-bit sRGB value.
pub fn srgb(linear: f32) -> u8 {
    let v = linear.clamp(0.0, 1.0);
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * libm::powf(v, 1.0 / 2.4) - 0.055 };
    (encoded * 255.0 + 0.5) as u8
}

/// Puts the attributes of a one-part EXR's header into alphabetical order. The encoder keeps them in a hash map, whose
/// order differs from process to process; their total length, and so every offset after them, stays.
fn sort_header(file: &mut [u8]) -> Option<()> {
    const BEGIN: usize = 8; // after magic number and version
    let mut attributes = Vec::new();
    let mut at = BEGIN;
    while *file.get(at)? != 0 {
        let name = at + file[at..].iter().position(|b| *b == 0)? + 1;
        let kind = name + file[name..].iter().position(|b| *b == 0)? + 1;
        let size = u32::from_le_bytes(file.get(kind..kind + 4)?.try_into().ok()?);
        let end = kind + 4 + size as usize;
        attributes.push(file.get(at..end)?.to_vec());
        at = end;
    }
    attributes.sort_unstable();
    file[BEGIN..at].copy_from_slice(&attributes.concat());
    Some(())
}

/// A file that is written whole but does not have its name yet. Dropping it removes it.
#[derive(Debug)]
pub struct Staged {
    file: NamedTempFile,
    path: PathBuf,
}

impl Staged {
    /// Gives the file its name, in place of an older one of that name.
    ///
    /// # Errors
    /// [`FilmError::File`].
    pub fn publish(self) -> Result<(), FilmError> {
        let Self { file, path } = self;
        let failed = |reason: String| FilmError::File { path: path.clone(), reason };
        file.persist(&path).map(drop).map_err(|e| failed(e.error.to_string()))
    }
}

/// Writes `bytes` to disk beside `path`, to become `path` when published.
///
/// # Errors
/// [`FilmError::File`].
pub fn stage(path: &Path, bytes: &[u8]) -> Result<Staged, FilmError> {
    let write = || {
        let mut file = temporary(path)?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        Ok(file)
    };
    let failed = |e: std::io::Error| FilmError::File { path: path.into(), reason: reason(&e) };
    Ok(Staged { file: write().map_err(failed)?, path: path.into() })
}

/// Checks, by writing and removing an empty file, that `path` could be written.
///
/// # Errors
/// [`FilmError::File`].
pub fn check_writable(path: &Path) -> Result<(), FilmError> {
    let failed = |reason: String| FilmError::File { path: path.into(), reason };
    if path.is_dir() {
        return Err(failed("is a directory".into()));
    }
    temporary(path).map(drop).map_err(|e| failed(format!("cannot be written there: {}", reason(&e))))
}

fn temporary(path: &Path) -> std::io::Result<NamedTempFile> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    builder.prefix(".ambience-").suffix(".part");
    // As any new file would have; tempfile's own 0600 would hide the picture from other users.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

/// The plain reason, without the temporary's path that tempfile adds.
fn reason(error: &std::io::Error) -> String {
    match error.kind() {
        std::io::ErrorKind::NotFound => "no such folder".into(),
        kind => kind.to_string(),
    }
}

/// The linear RGB of an EXR file.
#[derive(Clone, PartialEq, Debug)]
pub struct Picture {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Linear RGB, row by row.
    pub rgb: Vec<[f32; 3]>,
}

/// Reads channels R, G, B of an EXR file's first part.
///
/// # Errors
/// [`FilmError::File`] for a file that is missing, damaged or without these channels.
pub fn read(path: &Path) -> Result<Picture, FilmError> {
    use exr::prelude::{ReadChannels as _, ReadLayers as _};
    let failed = |reason: String| FilmError::File { path: path.into(), reason };
    // A device may never end.
    if path.metadata().is_ok_and(|about| !about.is_file()) {
        return Err(failed("is not a file; expected a picture".into()));
    }
    let bytes = std::fs::read(path).map_err(|e| failed(e.to_string()))?;
    let reader = exr::prelude::read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
    let image = reader.all_attributes().from_buffered(Cursor::new(bytes));
    let layer = image.map_err(|e| failed(format!("is no picture that can be read: {e}")))?.layer_data;
    let plane = |name: &str| -> Result<Vec<f32>, FilmError> {
        let channel = layer.channel_data.list.iter().find(|c| c.name.eq(name));
        let channel = channel.ok_or_else(|| failed(format!("has no channel {name}")))?;
        Ok(channel.sample_data.values_as_f32().collect())
    };
    let (r, g, b) = (plane("R")?, plane("G")?, plane("B")?);
    let Vec2(width, height) = layer.size;
    if [&r, &g, &b].iter().any(|p| p.len() != width * height) {
        return Err(failed("has subsampled channels".into()));
    }
    let rgb = r.into_iter().zip(g).zip(b).map(|((r, g), b)| [r, g, b]).collect();
    Ok(Picture { width, height, rgb })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spec::tests::sample;

    /// Tall enough for many compressed blocks, which threads may finish in any order.
    fn tall() -> Settings {
        Settings { height: 900, ..sample() }
    }

    /// A picture of every kind of bits: ordinary, tiny, huge, negative zero.
    fn film(order: impl Iterator<Item = u32>) -> Film {
        let settings = tall();
        let mut film = Film::new(&settings);
        for tile in order {
            let [x0, x1, y0, y1] = settings.tile(tile);
            let mut bytes = Vec::new();
            for i in 0..(x1 - x0) * (y1 - y0) * CHANNELS as u32 {
                let value = [i as f32 * 0.01, 1e-40, 3e38, -0.0, tile as f32][i as usize % 5];
                bytes.extend(value.to_le_bytes());
            }
            assert!(film.add(tile, &bytes).expect("tile"));
            assert!(!film.add(tile, &bytes).expect("tile again"));
        }
        film
    }

    fn attributes() -> Vec<(&'static str, String)> {
        vec![("method", "irradiance".into()), ("seed", "3".into()), ("a", "0.3".into()), ("version", "1".into())]
    }

    #[test]
    fn the_file_depends_on_the_pixels_alone_and_returns_their_bits() {
        let tiles = tall().tiles();
        let planes = film(0..tiles).planes;
        let file = film(0..tiles).exr(&attributes()).expect("encoded");
        for _ in 0..8 {
            // Each has a hash map with other keys inside.
            assert!(file == film((0..tiles).rev()).exr(&attributes()).expect("encoded"));
        }
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a.exr");
        stage(&path, &file).expect("staged").publish().expect("published");
        let picture = read(&path).expect("read");
        assert_eq!((picture.width, picture.height), (40, 900));
        for (i, rgb) in picture.rgb.iter().enumerate() {
            assert_eq!(rgb.map(f32::to_bits), [planes[0][i], planes[1][i], planes[2][i]].map(f32::to_bits));
        }
    }

    #[test]
    fn every_layer_and_attribute_is_in_the_file() {
        let file = film(0..tall().tiles()).exr(&attributes()).expect("encoded");
        use exr::prelude::{ReadChannels as _, ReadLayers as _};
        let reader = exr::prelude::read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
        let layer = reader.all_attributes().from_buffered(Cursor::new(file)).expect("read").layer_data;
        let mut names: Vec<_> = layer.channel_data.list.iter().map(|c| c.name.to_string()).collect();
        names.sort();
        let mut expected = NAMES.map(String::from).to_vec();
        expected.sort();
        assert_eq!(names, expected);
        let attribute = |name: &str| layer.attributes.other.get(name.as_bytes()).cloned();
        assert_eq!(attribute("ambience:method"), Some(AttributeValue::Text("irradiance".into())));
        assert_eq!(layer.attributes.other.len(), attributes().len());
    }

    #[test]
    fn tiles_that_do_not_fit_are_refused() {
        let mut film = Film::new(&sample());
        assert_eq!(film.missing(), 6);
        assert_eq!(film.add(6, &[]).expect_err("outside").to_string(), "tile 6 is outside the picture");
        let short = film.add(0, &[0; 4]).expect_err("short").to_string();
        assert_eq!(short, "tile 0 has 4 bytes, expected 13312");
        assert_eq!(film.missing(), 6);
        assert!(film.is_black());
    }

    #[test]
    fn the_png_exposes_the_brights_to_nine_tenths() {
        let mut film = Film::new(&sample());
        for plane in &mut film.planes[..3] {
            plane.fill(7.0);
        }
        let png = image::load_from_memory(&film.png().expect("encoded")).expect("read").to_rgb8();
        assert_eq!((png.width(), png.height()), (40, 20));
        assert_eq!(png.get_pixel(3, 3).0, [srgb(0.8); 3]);
        assert_eq!([srgb(0.8), srgb(0.0), srgb(9.0), srgb(f32::NAN)], [231, 0, 255, 0]);
    }

    #[test]
    fn nothing_half_done_is_left_behind() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a.exr");
        check_writable(&path).expect("writable");
        drop(stage(&path, b"half").expect("staged"));
        assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 0);
        let missing = check_writable(&folder.path().join("none/a.exr")).expect_err("no folder").to_string();
        assert!(missing.ends_with("none/a.exr: cannot be written there: no such folder"), "{missing}");
        assert!(check_writable(folder.path()).expect_err("folder").to_string().ends_with("is a directory"));
        std::fs::write(&path, b"not a picture").expect("written");
        assert!(read(&path).expect_err("damaged").to_string().contains("a.exr: is no picture"));
    }
}
