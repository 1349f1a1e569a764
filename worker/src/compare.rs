//! How far a picture is from a reference.

use crate::film::Picture;

/// Edge of the blocks whose means are compared, pixels.
const BLOCK: usize = 8;

/// The differences of a picture A from a reference B, over all three channels of linear RGB.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Difference {
    /// Root of the mean squared difference, divided by the mean of B.
    pub relative_rmse: f64,
    /// Mean of A divided by mean of B, minus 1.
    pub bias: f64,
    /// Greatest difference of the means of an 8 x 8 block in one channel, divided by the mean of B.
    pub worst_block: f64,
    /// Upper left pixel (x, y) of that block.
    pub worst_at: (usize, usize),
    /// Pixels in a row and rows compared, after averaging.
    pub size: (usize, usize),
}

/// Compares `a` with the reference `b`. The larger picture is box-averaged to the size of the smaller.
///
/// # Errors
/// One line: sizes that do not divide evenly, a pixel that is not finite, a reference whose mean is not positive.
pub fn compare(a: &Picture, b: &Picture) -> Result<Difference, String> {
    for (picture, name) in [(a, "the picture"), (b, "the reference")] {
        if let Some(at) = picture.rgb.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
            let (x, y) = (at % picture.width, at / picture.width);
            return Err(format!("{name} has a pixel that is not finite at x {x}, y {y}"));
        }
    }
    let size = (a.width.min(b.width), a.height.min(b.height));
    let shrunk = |p: &Picture| shrink(p, size);
    let (Some(pa), Some(pb)) = (shrunk(a), shrunk(b)) else {
        return Err(format!("sizes {}x{} and {}x{} do not divide evenly", a.width, a.height, b.width, b.height));
    };
    let count = (size.0 * size.1 * 3) as f64;
    let mean = |p: &[[f64; 3]]| p.iter().flatten().sum::<f64>() / count;
    let (mean_a, mean_b) = (mean(&pa), mean(&pb));
    if mean_b <= 0.0 {
        return Err(format!("the reference's mean is {mean_b}, nothing can be relative to it"));
    }
    let squares: f64 = pa.iter().flatten().zip(pb.iter().flatten()).map(|(a, b)| (a - b) * (a - b)).sum();
    let (worst, worst_at) = worst_block(&pa, &pb, size);
    Ok(Difference {
        relative_rmse: (squares / count).sqrt() / mean_b,
        bias: mean_a / mean_b - 1.0,
        worst_block: worst / mean_b,
        worst_at,
        size,
    })
}

/// Means over boxes of equal whole numbers of pixels both ways; `None` if there are none.
fn shrink(picture: &Picture, (width, height): (usize, usize)) -> Option<Vec<[f64; 3]>> {
    let factor = picture.width / width;
    if (width * factor, height * factor) != (picture.width, picture.height) {
        return None;
    }
    let mut out = vec![[0.0; 3]; width * height];
    let share = 1.0 / (factor * factor) as f64;
    for (i, pixel) in picture.rgb.iter().enumerate() {
        let (x, y) = (i % picture.width / factor, i / picture.width / factor);
        for (sum, value) in out[y * width + x].iter_mut().zip(pixel) {
            *sum += f64::from(*value) * share;
        }
    }
    Some(out)
}

/// Blocks at the right and lower edge may be smaller.
fn worst_block(a: &[[f64; 3]], b: &[[f64; 3]], (width, height): (usize, usize)) -> (f64, (usize, usize)) {
    let mut worst = (0.0, (0, 0));
    for y in (0..height).step_by(BLOCK) {
        for x in (0..width).step_by(BLOCK) {
            let (x1, y1) = ((x + BLOCK).min(width), (y + BLOCK).min(height));
            let mut sums = [0.0f64; 3];
            for at in (y..y1).flat_map(|y| (x..x1).map(move |x| y * width + x)) {
                for (sum, (a, b)) in sums.iter_mut().zip(a[at].iter().zip(&b[at])) {
                    *sum += a - b;
                }
            }
            let pixels = ((x1 - x) * (y1 - y)) as f64;
            let greatest = sums.iter().fold(0.0f64, |m, s| m.max(s.abs() / pixels));
            if greatest > worst.0 {
                worst = (greatest, (x, y));
            }
        }
    }
    worst
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: usize, height: usize, pixel: impl Fn(usize, usize) -> [f32; 3]) -> Picture {
        let rgb = (0..width * height).map(|i| pixel(i % width, i / width)).collect();
        Picture { width, height, rgb }
    }

    #[test]
    fn equal_pictures_do_not_differ() {
        let p = picture(20, 12, |x, y| [x as f32, y as f32, 1.0]);
        let d = compare(&p, &p).expect("comparable");
        assert_eq!((d.relative_rmse, d.bias, d.worst_block), (0.0, 0.0, 0.0));
    }

    #[test]
    fn numbers_by_hand() {
        // One channel of one block of 64 pixels is 2 too bright, the reference is 4 everywhere.
        let b = picture(16, 16, |_, _| [4.0; 3]);
        let a = picture(16, 16, |x, y| if x >= 8 && y < 8 { [4.0, 6.0, 4.0] } else { [4.0; 3] });
        let d = compare(&a, &b).expect("comparable");
        // 64 of 768 values are off by 2: rms = 2 sqrt(1/12).
        assert!((d.relative_rmse - 2.0 * (1.0f64 / 12.0).sqrt() / 4.0).abs() < 1e-12);
        assert!((d.bias - 2.0 / 12.0 / 4.0).abs() < 1e-12);
        assert_eq!((d.worst_block, d.worst_at), (0.5, (8, 0)));
    }

    #[test]
    fn larger_pictures_are_averaged() {
        let small = picture(4, 2, |_, _| [1.0; 3]);
        let large = picture(12, 6, |x, _| [[0.0, 1.0, 2.0][x % 3]; 3]);
        for (a, b) in [(&small, &large), (&large, &small)] {
            let d = compare(a, b).expect("comparable");
            assert_eq!(d.size, (4, 2));
            assert!(d.relative_rmse < 1e-12 && d.bias.abs() < 1e-12);
        }
        let uneven = compare(&small, &picture(8, 6, |_, _| [1.0; 3])).expect_err("uneven");
        assert_eq!(uneven, "sizes 4x2 and 8x6 do not divide evenly");
    }

    #[test]
    fn what_cannot_be_compared_is_said() {
        let black = picture(4, 2, |_, _| [0.0; 3]);
        assert!(compare(&black, &black).expect_err("black").contains("mean is 0"));
        let broken = picture(4, 2, |x, y| if (x, y) == (3, 1) { [f32::NAN; 3] } else { [1.0; 3] });
        let message = compare(&broken, &black).expect_err("not finite");
        assert_eq!(message, "the picture has a pixel that is not finite at x 3, y 1");
    }
}
