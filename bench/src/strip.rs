//! Pictures side by side, to be looked at.

use image::Rgb;

use crate::judge::SIZE;

type Pixels<'a> = &'a [[f64; 3]];

/// One picture of a strip.
pub enum Panel<'a> {
    /// A picture, so many times as bright as would just fit the first one.
    Light(Pixels<'a>, f64),
    /// How much brighter or darker the first is than the second, as a fraction of it: white and black are so much.
    Difference(Pixels<'a>, Pixels<'a>, f64),
}

/// Which part of pictures of the references' size is shown, and how large.
pub struct Strip {
    /// Left and top of the part.
    pub place: [usize; 2],
    /// Its edge, pixels.
    pub crop: usize,
    /// By how much it is enlarged.
    pub enlarged: usize,
}

impl Strip {
    /// Panels side by side, in sRGB.
    pub fn of(&self, panels: &[Panel]) -> image::RgbImage {
        let (crop, gap) = (self.crop, self.crop * self.enlarged + 8);
        let (Panel::Light(first, _) | Panel::Difference(_, first, _)) = panels[0];
        let mut bright: Vec<f64> = (0..crop * crop).flat_map(|i| self.at(first, i % crop, i / crop)).collect();
        bright.sort_by(f64::total_cmp);
        let fits = 0.9 / bright[bright.len() * 98 / 100];
        image::RgbImage::from_fn((gap * panels.len() - 8) as u32, (crop * self.enlarged) as u32, |x, y| {
            let (which, x, y) = (x as usize / gap, x as usize % gap / self.enlarged, y as usize / self.enlarged);
            if x >= crop {
                return Rgb([255; 3]);
            }
            match panels[which] {
                Panel::Light(picture, exposure) => {
                    Rgb(self.at(picture, x, y).map(|v| worker::film::srgb((v * exposure * fits) as f32)))
                }
                Panel::Difference(a, b, most) => {
                    let [a, b] = [a, b].map(|picture| self.at(picture, x, y).iter().sum::<f64>());
                    let share = if b > 0.0 { (a / b - 1.0) / most } else { 0.0 };
                    Rgb([(127.5 + 127.5 * share.clamp(-1.0, 1.0)) as u8; 3])
                }
            }
        })
    }

    fn at(&self, picture: Pixels, x: usize, y: usize) -> [f64; 3] {
        picture[(self.place[1] + y) * SIZE + self.place[0] + x]
    }
}
