//! A scene ready to trace: what a ray meets, and from where the next ray may start.

use cache_core::Query;
use cache_core::math::Frame;
use glam::{Vec2, Vec3};

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
    /// Unit normal of the smooth surface.
    pub smooth: Vec3,
    /// Frame round the unit shading normal, which bumps tilt.
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
        let smooth = triangle.normals.map_or(facet, |normals| {
            let smooth = blend(&normals, weights).normalize_or(geometric);
            let smooth = if front { smooth } else { -smooth };
            // Seen from behind by its own shading normal: fall back on the facet.
            if smooth.dot(direction) < 0.0 { smooth } else { facet }
        });
        let bumped = self.bumped(triangle, weights, if front { smooth } else { -smooth });
        let bumped = bumped.map(|normal| if front { normal } else { -normal });
        let shading = bumped.filter(|normal| normal.dot(direction) < 0.0).unwrap_or(smooth);
        Some(Meeting {
            position,
            distance: hit.t,
            facet,
            smooth,
            frame: Frame::around(shading),
            triangle: hit.triangle,
            front,
            weights,
            lift: lift(triangle),
        })
    }

    /// The normal that the material's bumps make of a smooth one of the front. The tangent is that of the texture coordinates.
    fn bumped(&self, triangle: &Triangle, weights: [f32; 3], smooth: Vec3) -> Option<Vec3> {
        let bumps = self.scene.materials[triangle.material as usize].bumps?;
        let [a, b, c] = triangle.positions;
        let [s, t] = [triangle.uvs[1] - triangle.uvs[0], triangle.uvs[2] - triangle.uvs[0]];
        let along = ((b - a) * t.y - (c - a) * s.y) * s.perp_dot(t).signum();
        let tangent = along.reject_from_normalized(smooth).try_normalize()?;
        let texel = self.scene.textures[bumps.texture as usize].sample(texture_place(triangle, weights)) * 2.0 - 1.0;
        // Of a mirrored picture v runs the other way. In glTF green points to where v falls.
        let beside = smooth.cross(tangent) * s.perp_dot(t).signum();
        let tilted = tangent * texel.x * bumps.scale - beside * texel.y * bumps.scale + smooth * texel.z;
        tilted.try_normalize()
    }

    /// Which material it is made of.
    pub fn material(&self, at: &Meeting) -> u32 {
        self.scene.triangles[at.triangle as usize].material
    }

    /// Whether records may answer for what is reflected there.
    pub fn cached(&self, at: &Meeting) -> bool {
        self.scene.materials[self.material(at) as usize].cached
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
                let place = texture_place(triangle, at.weights);
                material.color * self.scene.textures[texture as usize].sample(place)
            }
        };
        Some(Bsdf::new(material, color))
    }

    /// Radiance the surface emits towards the ray, W/(sr m²).
    pub fn emission(&self, at: &Meeting) -> Rgb {
        if at.front { self.scene.materials[self.material(at) as usize].emission } else { Rgb::ZERO }
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

    /// What a sealed cache is asked there.
    pub fn query(&self) -> Query {
        Query { position: self.position, normal: self.smooth, shading: self.normal() }
    }

    /// The same point of a surface without bumps.
    pub fn flattened(self) -> Self {
        Self { frame: Frame::around(self.smooth), ..self }
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

fn texture_place(triangle: &Triangle, weights: [f32; 3]) -> Vec2 {
    triangle.uvs[0] * weights[0] + triangle.uvs[1] * weights[1] + triangle.uvs[2] * weights[2]
}

fn lift(triangle: &Triangle) -> f32 {
    LIFT * triangle.positions.iter().map(|p| p.abs().max_element()).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
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
