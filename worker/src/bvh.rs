//! Rays against triangles: a BVH built by obvhs, and a watertight triangle test (Woop, Benthin, Wald 2013).
//!
//! Every worker builds the same tree from the same scene, and a ray asks nothing but the tree and the scene, so a hit has
//! the same bits everywhere.

use glam::{Vec3, Vec3A};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2;
use obvhs::ray::{Ray, RayHit};

use crate::scene::Triangle;

/// Margin round every box, as a fraction of the scene's largest coordinate: some eight roundings.
const MARGIN: f32 = 1e-6;

/// Where a ray met a triangle.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Index into the scene's triangles.
    pub triangle: u32,
    /// Distance in lengths of the ray's direction.
    pub t: f32,
    /// Barycentric weights of the triangle's second and third corner.
    pub uv: [f32; 2],
}

/// The triangles of a scene, ready to trace.
pub struct Bvh {
    tree: Bvh2,
    /// Corners in the tree's leaf order.
    corners: Vec<[Vec3; 3]>,
    /// Scene index of each.
    triangles: Vec<u32>,
}

impl Bvh {
    /// Builds the tree.
    pub fn new(triangles: &[Triangle]) -> Self {
        let corner = |t: &Triangle, pick: fn(Vec3A, Vec3A) -> Vec3A| {
            let [a, b, c] = t.positions.map(Vec3A::from);
            pick(pick(a, b), c)
        };
        // The tree's box test rounds: without a margin, rays along a box's face or edge could slip past its triangles.
        let reach = triangles.iter().map(|t| corner(t, |a, b| a.abs().max(b.abs())).max_element()).fold(0.0, f32::max);
        let margin = Vec3A::splat(reach * MARGIN);
        let boxes: Vec<_> = triangles
            .iter()
            .map(|t| Aabb::new(corner(t, Vec3A::min) - margin, corner(t, Vec3A::max) + margin))
            .collect();
        let tree = build_bvh2(&boxes, BvhBuildParams::medium_build(), &mut std::time::Duration::default());
        let order = tree.primitive_indices.clone();
        let corners = order.iter().map(|&i| triangles[i as usize].positions).collect();
        Self { tree, corners, triangles: order }
    }

    /// The nearest hit with 0 < t < `t_max`; rays meet both faces.
    pub fn closest(&self, origin: Vec3, direction: Vec3, t_max: f32) -> Option<Hit> {
        if self.triangles.is_empty() {
            return None;
        }
        let shear = Shear::new(origin, direction);
        let mut best = None;
        let ray = Ray::new(Vec3A::from(origin), Vec3A::from(direction), 0.0, t_max);
        self.tree.ray_traverse(ray, &mut RayHit::none(), |ray, id| {
            match shear.intersect(&self.corners[id], ray.tmax) {
                Some((t, uv)) => {
                    best = Some(Hit { triangle: self.triangles[id], t, uv });
                    t
                }
                None => f32::INFINITY,
            }
        });
        best
    }

    /// Whether anything lies between 0 and `t_max`, in lengths of `direction`.
    pub fn occluded(&self, origin: Vec3, direction: Vec3, t_max: f32) -> bool {
        if self.triangles.is_empty() {
            return false;
        }
        let shear = Shear::new(origin, direction);
        let ray = Ray::new(Vec3A::from(origin), Vec3A::from(direction), 0.0, t_max);
        !self.tree.ray_traverse_miss(ray, |ray, id| {
            shear.intersect(&self.corners[id], ray.tmax).map_or(f32::INFINITY, |(t, _)| t)
        })
    }
}

/// A ray turned so that it runs along z: edges shared by two triangles are then decided by the same arithmetic.
struct Shear {
    origin: Vec3,
    axes: [usize; 3],
    shear: Vec3,
}

impl Shear {
    fn new(origin: Vec3, direction: Vec3) -> Self {
        let z = direction.abs().max_position();
        let (mut x, mut y) = ((z + 1) % 3, (z + 2) % 3);
        if direction[z] < 0.0 {
            std::mem::swap(&mut x, &mut y);
        }
        let shear = Vec3::new(direction[x] / direction[z], direction[y] / direction[z], 1.0 / direction[z]);
        Self { origin, axes: [x, y, z], shear }
    }

    #[inline]
    fn intersect(&self, corners: &[Vec3; 3], t_max: f32) -> Option<(f32, [f32; 2])> {
        let [x, y, z] = self.axes;
        let s = self.shear;
        let turned = corners.map(|c| {
            let c = c - self.origin;
            (c[x] - s.x * c[z], c[y] - s.y * c[z], s.z * c[z])
        });
        let [a, b, c] = turned;
        let mut u = c.0 * b.1 - c.1 * b.0;
        let mut v = a.0 * c.1 - a.1 * c.0;
        let mut w = b.0 * a.1 - b.1 * a.0;
        if u == 0.0 || v == 0.0 || w == 0.0 {
            // On an edge, single precision cannot tell the sides apart.
            let wide = |p: (f32, f32, f32), q: (f32, f32, f32)| {
                (f64::from(p.0) * f64::from(q.1) - f64::from(p.1) * f64::from(q.0)) as f32
            };
            (u, v, w) = (wide(c, b), wide(a, c), wide(b, a));
        }
        if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
            return None;
        }
        let det = u + v + w;
        if det == 0.0 {
            return None;
        }
        let t = (u * a.2 + v * b.2 + w * c.2) / det;
        (t > 0.0 && t < t_max).then(|| (t, [v / det, w / det]))
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec2;
    use proptest::prelude::*;

    use super::*;

    fn triangle(positions: [Vec3; 3]) -> Triangle {
        Triangle { positions, normals: None, uvs: [Vec2::ZERO; 3], material: 0 }
    }

    fn soup() -> impl Strategy<Value = Vec<Triangle>> {
        let corner = || prop::array::uniform3(-1f32..1.0).prop_map(Vec3::from);
        prop::collection::vec((corner(), corner(), corner()).prop_map(|(a, b, c)| triangle([a, b, c])), 1..60)
    }

    proptest! {
        #[test]
        fn the_tree_agrees_with_trying_every_triangle(soup in soup(), o in prop::array::uniform3(-2f32..2.0), to in prop::array::uniform3(-1f32..1.0)) {
            let (origin, direction) = (Vec3::from(o), Vec3::from(to) - Vec3::from(o));
            prop_assume!(direction.length() > 1e-3);
            let bvh = Bvh::new(&soup);
            let shear = Shear::new(origin, direction);
            let nearest = soup.iter().filter_map(|t| shear.intersect(&t.positions, f32::INFINITY)).map(|h| h.0).fold(f32::INFINITY, f32::min);
            let hit = bvh.closest(origin, direction, f32::INFINITY);
            prop_assert_eq!(hit.map_or(f32::INFINITY, |h| h.t), nearest);
            prop_assert_eq!(bvh.occluded(origin, direction, f32::INFINITY), hit.is_some());
            if let Some(hit) = hit {
                prop_assert!(!bvh.occluded(origin, direction, hit.t));
            }
        }

        /// A closed box of 12 triangles lets no ray out, even aimed at edges and corners.
        #[test]
        fn shared_edges_are_watertight(o in prop::array::uniform3(-0.9f32..0.9), edge in 0usize..12, along in -1f32..1.0) {
            let corner = |i: usize| Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) * 2.0 - 1.0;
            let sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
            let soup: Vec<_> = sides.iter().flat_map(|s| {
                [triangle([corner(s[0]), corner(s[1]), corner(s[2])]), triangle([corner(s[0]), corner(s[2]), corner(s[3])])]
            }).collect();
            let axis = edge / 4;
            let mut at = Vec3::splat(-1.0);
            at[axis] = along;
            at[(axis + 1) % 3] = if edge & 1 == 0 { -1.0 } else { 1.0 };
            at[(axis + 2) % 3] = if edge & 2 == 0 { -1.0 } else { 1.0 };
            let origin = Vec3::from(o);
            prop_assert!(Bvh::new(&soup).closest(origin, at - origin, f32::INFINITY).is_some());
        }
    }

    #[test]
    fn an_empty_scene_is_never_hit() {
        let bvh = Bvh::new(&[]);
        assert!(bvh.closest(Vec3::ZERO, Vec3::X, f32::INFINITY).is_none());
        assert!(!bvh.occluded(Vec3::ZERO, Vec3::X, 1.0));
    }
}
