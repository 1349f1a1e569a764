//! A ray made ready: for the box test by reciprocals, for the triangle test by turning it to run along z.

use glam::Vec3;

/// What rounding can move a hit by, as a fraction of the farthest corner's distance from the ray's origin (the largest
/// component of the offset counts).
///
/// Where the triangle test says a ray hits, the ray passes the exact triangle within 6 roundings of that distance, and
/// the distance it finds along the ray is off by no more than 5 others (Woop, Benthin and Wald 2013, section 4); the box test
/// adds 3. So much larger, boxes hold every hit. A rounding is 2^-24.
const SLACK: f32 = 16.0 / (1 << 24) as f32;

/// A ray as boxes and triangles ask for it.
pub struct Ray {
    /// For each axis, which of a box's planes the ray meets first: 0 the low one, 1 the high one.
    pub first: [usize; 3],
    /// Origins towards the near and the far planes: moved so that boxes are wider by the slack.
    pub origins: [[f32; 3]; 2],
    /// 1 / direction; infinite along planes, and where a box's plane holds the origin exactly, NaN counts as met.
    pub inverse: [f32; 3],
    /// x, y and z of the turned ray.
    pub axes: [usize; 3],
    /// Origin along these.
    pub origin: [f32; 3],
    /// What shears it to run along z with unit speed.
    pub shear: [f32; 3],
}

impl Ray {
    /// A ray through a scene within `bounds` (low and high corner).
    #[inline]
    pub fn new(origin: Vec3, direction: Vec3, bounds: &[Vec3; 2]) -> Self {
        let z = direction.abs().max_position();
        let (mut x, mut y) = ((z + 1) % 3, (z + 2) % 3);
        if direction[z] < 0.0 {
            std::mem::swap(&mut x, &mut y);
        }
        let shear = [direction[x] / direction[z], direction[y] / direction[z], 1.0 / direction[z]];
        let farthest = (bounds[0] - origin).abs().max((bounds[1] - origin).abs()).max_element();
        let slack = farthest * SLACK;
        let mut ray = Self {
            first: [0; 3],
            origins: [[0.0; 3]; 2],
            inverse: [0.0; 3],
            axes: [x, y, z],
            origin: [origin[x], origin[y], origin[z]],
            shear,
        };
        for axis in 0..3 {
            let (o, d) = (origin[axis], direction[axis]);
            let wider = [(o + slack).next_up(), (o - slack).next_down()];
            let backwards = usize::from(d.is_sign_negative());
            ray.first[axis] = backwards;
            ray.origins[0][axis] = wider[backwards];
            ray.origins[1][axis] = wider[1 - backwards];
            ray.inverse[axis] = 1.0 / d;
        }
        ray
    }
}
