//! A glossy ball and a glossy torus in the Cornell box, in place of its blocks.

use glam::{Vec2, Vec3};
use worker::math::sin_cos;
use worker::scene::{Camera, Material, Rgb, Scene, Surface, Triangle};

use crate::judge::load;

/// Pieces along each angle.
const PIECES: [usize; 2] = [96, 48];

/// The scene, both bodies of metal of this roughness.
pub fn rounded(alpha: f32) -> (Scene, Camera) {
    let (mut scene, camera) = load("cornell.glb");
    // The blocks stand apart from all walls.
    let of_wall = |p: &Vec3| p.x < 0.01 || p.x > 0.54 || p.z < 0.01 || p.z > 0.55 || p.y > 0.5;
    scene.triangles.retain(|t| t.positions.iter().any(of_wall));
    let material = scene.materials.len() as u32;
    let roughness = alpha.sqrt();
    let surface = Surface::Gltf { metallic: 1.0, roughness, specular: 1.0, specular_color: Rgb::ONE, ior: 1.5 };
    scene.materials.push(Material { surface, ..Material::diffuse(Rgb::splat(0.8)) });
    // Around the axis, then round the tube; the ball's tube goes half round.
    let ball = |u: f32, v: f32| {
        let ((s, c), (around, along)) = (sin_cos(v * 0.5 - std::f32::consts::FRAC_PI_2), sin_cos(u));
        let normal = Vec3::new(c * along, s, c * around);
        (Vec3::new(0.37, 0.11, 0.36) + normal * 0.1, normal)
    };
    let torus = |u: f32, v: f32| {
        let ((s, c), (around, along)) = (sin_cos(v), sin_cos(u));
        let (out, middle) = (Vec3::new(along, 0.0, around), Vec3::new(0.18, 0.06, 0.19));
        let normal = out * c + Vec3::Y * s;
        (middle + out * 0.1 + normal * 0.045, normal)
    };
    add(&mut scene, material, ball);
    add(&mut scene, material, torus);
    (scene, camera)
}

/// Adds a surface given by two angles, 0 to 2 pi each: points and unit normals.
fn add(scene: &mut Scene, material: u32, surface: impl Fn(f32, f32) -> (Vec3, Vec3)) {
    let corner = |i: usize, j: usize| {
        let angle = |k: usize, pieces: usize| std::f32::consts::TAU * k as f32 / pieces as f32;
        surface(angle(i, PIECES[0]), angle(j, PIECES[1]))
    };
    for (i, j) in (0..PIECES[0]).flat_map(|i| (0..PIECES[1]).map(move |j| (i, j))) {
        let square = [corner(i, j), corner(i, j + 1), corner(i + 1, j + 1), corner(i + 1, j)];
        for corners in [[0, 1, 2], [0, 2, 3]] {
            let positions = corners.map(|k: usize| square[k].0);
            let [a, b, c] = positions;
            // At the poles of the ball one side has no length.
            if (b - a).cross(c - a).length() > 1e-9 {
                let normals = Some(corners.map(|k| square[k].1));
                scene.triangles.push(Triangle { positions, normals, uvs: [Vec2::ZERO; 3], material });
            }
        }
    }
}
