//! Looking up a picture wrapped over a surface.

use glam::Vec2;

use super::{Rgb, Texture, Wrap};

impl Texture {
    /// Linear RGB at texture coordinates `uv`, bilinear between texel centres, which lie at half integers. Coordinates
    /// that are not finite count as 0.
    pub fn sample(&self, uv: Vec2) -> Rgb {
        if self.width == 0 || self.height == 0 {
            return Rgb::ZERO;
        }
        let x = Between::new(uv.x, self.width, self.wrap[0]);
        let y = Between::new(uv.y, self.height, self.wrap[1]);
        let row = |y: u32| lerp(self.texel(x.low, y), self.texel(x.high, y), x.fraction);
        lerp(row(y.low), row(y.high), y.fraction)
    }

    fn texel(&self, x: u32, y: u32) -> Rgb {
        let index = y as usize * self.width as usize + x as usize;
        self.texels.get(index).copied().unwrap_or(Rgb::ZERO)
    }
}

/// The two texels along one axis whose centres enclose a coordinate.
struct Between {
    low: u32,
    high: u32,
    /// Share of `high`, 0 to 1.
    fraction: f32,
}

impl Between {
    fn new(coordinate: f32, size: u32, wrap: Wrap) -> Self {
        // f64, so that the place within a large picture is exact to a small part of a texel.
        let coordinate = if coordinate.is_finite() { f64::from(coordinate) } else { 0.0 };
        let inside = match wrap {
            Wrap::Repeat => coordinate - coordinate.floor(),
            Wrap::Mirror => {
                let in_period = coordinate - 2.0 * (coordinate / 2.0).floor();
                if in_period > 1.0 { 2.0 - in_period } else { in_period }
            }
            Wrap::Clamp => coordinate.clamp(0.0, 1.0),
        };
        let place = inside * f64::from(size) - 0.5;
        let below = place.floor();
        let neighbour = |index: i64| -> u32 {
            let size = i64::from(size);
            let index = match wrap {
                Wrap::Repeat => index.rem_euclid(size),
                // The picture's mirror image starts with the border texel again, so it reads as clamped.
                Wrap::Mirror | Wrap::Clamp => index.clamp(0, size - 1),
            };
            index as u32
        };
        Self { low: neighbour(below as i64), high: neighbour(below as i64 + 1), fraction: (place - below) as f32 }
    }
}

/// Exactly `a` where both are equal, so that a flat picture stays flat.
fn lerp(a: Rgb, b: Rgb, fraction: f32) -> Rgb {
    a + (b - a) * fraction
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Two texels, 0 and 1, side by side.
    fn step(wrap: Wrap) -> Texture {
        Texture { width: 2, height: 1, texels: vec![Rgb::ZERO, Rgb::ONE], wrap: [wrap; 2] }
    }

    fn red(texture: &Texture, u: f32) -> f32 {
        texture.sample(Vec2::new(u, 0.5)).x
    }

    #[test]
    fn texel_centres_are_at_half_integers() {
        for wrap in [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp] {
            let texture = step(wrap);
            assert_eq!([0.25, 0.5, 0.75].map(|u| red(&texture, u)), [0.0, 0.5, 1.0], "{wrap:?}");
        }
    }

    #[test]
    fn outside_is_wrapped() {
        assert_eq!([0.0, 1.0, 1.25, -0.25].map(|u| red(&step(Wrap::Repeat), u)), [0.5, 0.5, 0.0, 1.0]);
        assert_eq!([0.0, 1.0, 1.25, 1.75, -0.75].map(|u| red(&step(Wrap::Mirror), u)), [0.0, 1.0, 1.0, 0.0, 1.0]);
        assert_eq!([0.0, 1.0, 9.0, -9.0].map(|u| red(&step(Wrap::Clamp), u)), [0.0, 1.0, 1.0, 0.0]);
    }

    #[test]
    fn row_zero_is_at_v_zero() {
        let texture = Texture { width: 1, height: 2, texels: vec![Rgb::X, Rgb::Y], wrap: [Wrap::Clamp; 2] };
        assert_eq!(texture.sample(Vec2::new(0.5, 0.25)), Rgb::X);
        assert_eq!(texture.sample(Vec2::new(0.5, 0.75)), Rgb::Y);
    }

    #[test]
    fn empty_or_short_pictures_are_black() {
        let texture = Texture { width: 0, height: 5, texels: vec![], wrap: [Wrap::Repeat; 2] };
        assert_eq!(texture.sample(Vec2::ZERO), Rgb::ZERO);
        let texture = Texture { width: 4, height: 5, texels: vec![], wrap: [Wrap::Repeat; 2] };
        assert_eq!(texture.sample(Vec2::ONE), Rgb::ZERO);
    }

    proptest! {
        #[test]
        fn any_coordinates_give_a_colour_within_the_picture(u in any::<u32>(), v in any::<u32>(), mode in 0..3usize) {
            let wrap = [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp][mode];
            let texels = (0..15).map(|i| Rgb::splat(1.0 + i as f32)).collect();
            let texture = Texture { width: 3, height: 5, texels, wrap: [wrap; 2] };
            let colour = texture.sample(Vec2::new(f32::from_bits(u), f32::from_bits(v)));
            prop_assert!((1.0..=15.0).contains(&colour.x), "{colour}");
        }
    }
}
