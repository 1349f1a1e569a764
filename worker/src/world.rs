//! A scene ready to trace: what a ray meets, and from where the next ray may start.

use cache_core::math::Frame;
use glam::Vec3;

use crate::bsdf::Bsdf;
use crate::bvh::Bvh;
use crate::lights::Place;
use crate::scene::{Rgb, Scene, Triangle};

/// Distance a new ray starts from its surface, as a fraction of the largest coordinate there: some sixteen roundings,
/// whatever the unit of length and however far from the origin.
const LIFT: f32 = 2e-6;

/// Triangles, tree and extent of a scene.
pub struct World {
    /// The plain data.
    pub scene: Scene,
    bvh: Bvh,
    /// Centre of the bounding sphere.
    pub center: Vec3,
    /// Radius of the bounding sphere, world length; positive.
    pub radius: f32,
}

/// A point where a ray met a surface. Normals lie on the side the ray came from.
#[derive(Clone, Copy, Debug)]
pub struct Meeting {
    /// World position.
    pub position: Vec3,
    /// Length of the way.
    pub distance: f32,
    /// Unit geometric normal.
    pub facet: Vec3,
    /// Frame round the unit shading normal.
    pub frame: Frame,
    /// Which triangle.
    pub triangle: u32,
    /// Whether its front was met.
    pub front: bool,
    /// Barycentric weights of the corners.
    weights: [f32; 3],
    lift: f32,
}

impl World {
    /// Builds the tree.
    pub fn new(scene: Scene) -> Self {
        let bvh = Bvh::new(&scene.triangles);
        let corners = || scene.triangles.iter().flat_map(|t| t.positions);
        let low = corners().fold(Vec3::INFINITY, Vec3::min);
        let high = corners().fold(Vec3::NEG_INFINITY, Vec3::max);
        let (center, radius) = if scene.triangles.is_empty() {
            (Vec3::ZERO, 1.0)
        } else {
            ((low + high) * 0.5, ((high - low).length() * 0.5).max(f32::MIN_POSITIVE))
        };
        Self { scene, bvh, center, radius }
    }

    /// The nearest surface along a ray of unit direction.
    pub fn meet(&self, origin: Vec3, direction: Vec3) -> Option<Meeting> {
        let hit = self.bvh.closest(origin, direction, f32::INFINITY)?;
        let triangle = &self.scene.triangles[hit.triangle as usize];
        let weights = [1.0 - hit.uv[0] - hit.uv[1], hit.uv[0], hit.uv[1]];
        let position = blend(&triangle.positions, weights);
        let geometric = facet(triangle);
        let front = geometric.dot(direction) < 0.0;
        let facet = if front { geometric } else { -geometric };
        let normal = triangle.normals.map_or(facet, |normals| {
            let smooth = blend(&normals, weights).normalize_or(geometric);
            let smooth = if front { smooth } else { -smooth };
            // Seen from behind by its own shading normal: fall back on the facet.
            if smooth.dot(direction) < 0.0 { smooth } else { facet }
        });
        let frame = Frame::around(normal);
        Some(Meeting {
            position,
            distance: hit.t,
            facet,
            frame,
            triangle: hit.triangle,
            front,
            weights,
            lift: lift(triangle),
        })
    }

    /// Whether something lies between two points that are already off their surfaces.
    pub fn hidden(&self, from: Vec3, to: Vec3) -> bool {
        let way = to - from;
        let length = way.length();
        length > 0.0 && self.bvh.occluded(from, way / length, length)
    }

    /// Whether something lies in a direction.
    pub fn shaded(&self, from: Vec3, direction: Vec3) -> bool {
        self.bvh.occluded(from, direction, f32::INFINITY)
    }

    /// How the surface scatters there. The back of a single-sided surface is black.
    pub fn bsdf(&self, at: &Meeting) -> Option<Bsdf> {
        let triangle = &self.scene.triangles[at.triangle as usize];
        let material = &self.scene.materials[triangle.material as usize];
        if !at.front && !material.double_sided {
            return None;
        }
        let color = match material.texture {
            None => material.color,
            Some(texture) => {
                let weights = at.weights;
                let at = triangle.uvs[0] * weights[0] + triangle.uvs[1] * weights[1] + triangle.uvs[2] * weights[2];
                material.color * self.scene.textures[texture as usize].sample(at)
            }
        };
        Some(Bsdf::new(material, color))
    }

    /// Radiance the surface emits towards the ray, W/(sr m²).
    pub fn emission(&self, at: &Meeting) -> Rgb {
        let triangle = &self.scene.triangles[at.triangle as usize];
        if at.front { self.scene.materials[triangle.material as usize].emission } else { Rgb::ZERO }
    }

    /// A point on a triangle, moved just off its front.
    pub fn off_front(&self, triangle: u32, point: Vec3) -> Vec3 {
        let triangle = &self.scene.triangles[triangle as usize];
        point + facet(triangle) * lift(triangle)
    }
}

impl Meeting {
    /// Where a ray that leaves along `direction` starts: just off the surface, on the side it leaves to.
    pub fn leave(&self, direction: Vec3) -> Vec3 {
        self.position + self.facet * self.lift.copysign(direction.dot(self.facet))
    }

    /// Where light is looked for.
    pub fn place(&self) -> Place {
        Place { position: self.position, normal: self.normal() }
    }

    /// Unit shading normal.
    pub fn normal(&self) -> Vec3 {
        self.frame.z
    }
}

/// Unit geometric normal of a triangle's front.
pub fn facet(triangle: &Triangle) -> Vec3 {
    let [a, b, c] = triangle.positions;
    // Edges are scaled first so that tiny triangles do not underflow.
    let (e, f) = (b - a, c - a);
    let scale = 1.0 / e.abs().max_element().max(f.abs().max_element());
    (e * scale).cross(f * scale).normalize_or(Vec3::Z)
}

fn blend(corners: &[Vec3; 3], weights: [f32; 3]) -> Vec3 {
    corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2]
}

fn lift(triangle: &Triangle) -> f32 {
    LIFT * triangle.positions.iter().map(|p| p.abs().max_element()).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use glam::Vec2;

    use super::*;

    #[test]
    fn tiny_surfaces_cast_shadows() {
        for scale in (0..40).map(|k| 0.5f32.powi(k)) {
            let corners = [[4.0, 1.3, 0.4], [3.9, 1.7, 0.4], [4.1, 1.5, 0.7]].map(|c| Vec3::from(c) * scale);
            let triangle = Triangle { positions: corners, normals: None, uvs: [Vec2::ZERO; 3], material: 0 };
            let world = World::new(Scene { triangles: vec![triangle], ..Scene::default() });
            let (from, to, beside) = (Vec3::ZERO, Vec3::new(8.0, 3.0, 1.0) * scale, Vec3::new(8.0, 1.0, 1.0) * scale);
            assert!(world.hidden(from, to) && world.hidden(to, from), "{scale}");
            assert!(!world.hidden(from, beside) && !world.hidden(beside, to), "{scale}");
            assert!(!world.hidden(to, to), "nothing lies between a point and itself");
        }
    }
}
