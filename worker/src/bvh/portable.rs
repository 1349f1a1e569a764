//! Eight at once in plain Rust. What [`super::avx2`] must agree with, operation by operation.

use super::ray::Ray;
use super::traverse::{Lanes, Met};
use super::{Node, WIDTH};

/// Works everywhere.
#[derive(Clone, Copy)]
pub struct Portable;

impl Lanes for Portable {
    #[inline(always)]
    fn boxes<const ANY: bool>(self, node: &Node, ray: &Ray, t_max: f32) -> (u32, [f32; WIDTH]) {
        let mut near = [0.0; WIDTH];
        let mut far = [t_max; WIDTH];
        for axis in 0..3 {
            let inverse = ray.inverse[axis];
            let (entries, exits) = (&node.planes[ray.first[axis]][axis], &node.planes[1 - ray.first[axis]][axis]);
            for lane in 0..WIDTH {
                let entry = (entries[lane] - ray.origins[0][axis]) * inverse;
                let exit = (exits[lane] - ray.origins[1][axis]) * inverse;
                near[lane] = if entry > near[lane] { entry } else { near[lane] };
                far[lane] = if exit < far[lane] { exit } else { far[lane] };
            }
        }
        let mut mask = 0;
        for lane in 0..WIDTH {
            mask |= u32::from(near[lane] <= far[lane]) << lane;
        }
        (mask, near)
    }

    #[inline(always)]
    fn triangles<const ANY: bool>(self, leaf: &[f32], count: usize, ray: &Ray, t_max: f32) -> (u32, Met) {
        let [x, y, z] = ray.axes;
        let [shear_x, shear_y, shear_z] = ray.shear;
        let mut met = Met::default();
        let mut mask = 0;
        for lane in 0..count.min(WIDTH) {
            let turned: [_; 3] = std::array::from_fn(|corner| {
                let at = |axis: usize| leaf[(3 * corner + axis) * count + lane];
                let c = [at(x) - ray.origin[0], at(y) - ray.origin[1], at(z) - ray.origin[2]];
                [c[0] - shear_x * c[2], c[1] - shear_y * c[2], shear_z * c[2]]
            });
            let [a, b, c] = turned;
            let edges = [c[0] * b[1] - c[1] * b[0], a[0] * c[1] - a[1] * c[0], b[0] * a[1] - b[1] * a[0]];
            let [u, v, w] = if edges.contains(&0.0) { on_edge(a, b, c) } else { edges };
            if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
                continue;
            }
            let det = u + v + w;
            let t = (u * a[2] + v * b[2] + w * c[2]) / det;
            if t > 0.0 && t <= t_max && det != 0.0 {
                mask |= 1 << lane;
                (met.t[lane], met.v[lane], met.w[lane], met.det[lane]) = (t, v, w, det);
            }
        }
        (mask, met)
    }

    #[inline(always)]
    fn prefetch<T>(self, _from: &[T], _bytes: usize) {}
}

/// On an edge, single precision cannot tell the sides apart.
pub fn on_edge(a: [f32; 3], b: [f32; 3], c: [f32; 3]) -> [f32; 3] {
    let wide =
        |p: [f32; 3], q: [f32; 3]| (f64::from(p[0]) * f64::from(q[1]) - f64::from(p[1]) * f64::from(q[0])) as f32;
    [wide(c, b), wide(a, c), wide(b, a)]
}
