//! Image files of textures, decoded to linear RGB.

use std::io::Cursor;

use ::gltf::json::Image;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader};

use super::Fault;
use super::container::Document;
use crate::scene::Rgb;

/// Most texels of a picture, about 67 million: a header of a few bytes must not make us allocate without bounds.
const MOST_TEXELS: u64 = 1 << 26;

/// A decoded image.
pub(super) struct Picture {
    /// Texels per row.
    pub(super) width: u32,
    /// Rows.
    pub(super) height: u32,
    /// Linear RGB, row by row from the top.
    pub(super) texels: Vec<Rgb>,
    /// Whether some texel is not opaque.
    pub(super) has_alpha: bool,
}

/// What the numbers of an image mean.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Meaning {
    /// Colours, as sRGB has them.
    Colors,
    /// What they say, 0 to 1.
    Numbers,
}

/// Reads and decodes an image.
pub(super) fn read(document: &Document, image: &Image, meaning: Meaning) -> Result<Picture, Fault> {
    match (image.buffer_view, &image.uri) {
        (Some(view), _) => decode(document.view(view)?, meaning),
        (None, Some(uri)) => decode(&document.resource(uri)?, meaning),
        (None, None) => Err("has neither a uri nor a bufferView".into()),
    }
}

fn decode(bytes: &[u8], meaning: Meaning) -> Result<Picture, Fault> {
    let format = image::guess_format(bytes).ok();
    let Some(format) = format.filter(|f| [ImageFormat::Png, ImageFormat::Jpeg].contains(f)) else {
        return Err("is neither a PNG nor a JPEG".into());
    };
    let cannot = |e: image::ImageError| format!("cannot be decoded: {e}");
    let decoder = ImageReader::with_format(Cursor::new(bytes), format).into_decoder().map_err(cannot)?;
    let (width, height) = decoder.dimensions();
    if u64::from(width) * u64::from(height) > MOST_TEXELS {
        return Err(format!("has {width} x {height} texels; expected at most {MOST_TEXELS}"));
    }
    let image = DynamicImage::from_decoder(decoder).map_err(cannot)?;
    if width == 0 || height == 0 {
        return Err("has no texels".into());
    }
    Ok(Picture { width, height, texels: linear(&image, meaning), has_alpha: has_alpha(&image) })
}

/// The texels, decoded with as many bits as the file has.
fn linear(image: &DynamicImage, meaning: Meaning) -> Vec<Rgb> {
    if meaning == Meaning::Numbers {
        return image.to_rgb32f().pixels().map(|p| p.0.into()).collect();
    }
    if image.color().bytes_per_pixel() / image.color().channel_count() > 1 {
        let table = srgb_table(u16::MAX);
        return image.to_rgb16().pixels().map(|p| p.0.map(|v| table[usize::from(v)]).into()).collect();
    }
    let table = srgb_table(u8::MAX.into());
    image.to_rgb8().pixels().map(|p| p.0.map(|v| table[usize::from(v)]).into()).collect()
}

fn has_alpha(image: &DynamicImage) -> bool {
    image.color().has_alpha() && image.to_rgba16().pixels().any(|p| p.0[3] != u16::MAX)
}

/// Linear values, 0 to 1, of the sRGB codes 0 to `largest` (IEC 61966-2-1).
fn srgb_table(largest: u16) -> Vec<f32> {
    let decode = |code: u16| {
        let c = f64::from(code) / f64::from(largest);
        if c <= 0.04045 { c / 12.92 } else { libm::pow((c + 0.055) / 1.055, 2.4) }
    };
    (0..=largest).map(|code| decode(code) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_is_decoded_exactly_at_the_ends_and_known_points() {
        let table = srgb_table(255);
        assert_eq!((table.len(), table[0], table[255]), (256, 0.0, 1.0));
        assert!((table[188] - 0.502_886_5).abs() < 1e-6, "{}", table[188]);
        assert!((table[10] - 10.0 / 255.0 / 12.92).abs() < 1e-7);
        assert!(table.is_sorted());
    }

    #[test]
    fn anything_but_png_and_jpeg_is_refused() {
        for bytes in [&b""[..], b"GIF89a", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0"] {
            assert!(decode(bytes, Meaning::Colors).is_err());
        }
    }
}
