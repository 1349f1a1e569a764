//! Pictures side by side, to be looked at.

use crate::judge::SIZE;

/// Which part of pictures is shown, and how.
pub struct Strip {
    /// Left and top of the part.
    pub place: [usize; 2],
    /// Its edge, pixels.
    pub crop: usize,
    /// By how much it is enlarged.
    pub enlarged: usize,
    /// How bright: at 1 the first picture's brightest there just fit.
    pub exposure: f64,
}

impl Strip {
    /// A whole picture.
    pub fn whole(exposure: f64) -> Self {
        Self { place: [0; 2], crop: SIZE, enlarged: 3, exposure }
    }

    /// Pictures of the references' size side by side, in sRGB.
    pub fn of(&self, pictures: &[&[[f64; 3]]]) -> image::RgbImage {
        let (crop, [left, top]) = (self.crop, self.place);
        let at = |picture: &[[f64; 3]], x: usize, y: usize| picture[(top + y) * SIZE + left + x];
        let mut bright: Vec<f64> = (0..crop * crop).flat_map(|i| at(pictures[0], i % crop, i / crop)).collect();
        bright.sort_by(f64::total_cmp);
        let exposure = self.exposure * 0.9 / bright[bright.len() * 98 / 100];
        let gap = crop * self.enlarged + 8;
        image::RgbImage::from_fn((gap * pictures.len() - 8) as u32, (crop * self.enlarged) as u32, |x, y| {
            let (which, x, y) = (x as usize / gap, x as usize % gap / self.enlarged, y as usize / self.enlarged);
            if x >= crop {
                return image::Rgb([255; 3]);
            }
            image::Rgb(at(pictures[which], x, y).map(|v| worker::film::srgb((v * exposure) as f32)))
        })
    }
}
