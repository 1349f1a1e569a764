//! Practical details of irradiance caching where they decide: bumps, excluded materials, geometry as fine as pixels.

use std::f32::consts::{FRAC_PI_4, PI};

use ambience_bench::judge::load;
use cache_core::Rgb;
use cache_core::id::Random;
use glam::{Vec2, Vec3};
use worker::frame::{CHANNELS, Counts, Frame};
use worker::scene::{Bumps, Camera, DistantLight, Material, Scene, Texture, Triangle, Wrap};
use worker::settings::{Method, Settings};
use worker::solo::{self, Order};

fn white() -> Material {
    Material::diffuse(Rgb::splat(0.5))
}

/// A floor seen from above: u runs along x, v against z.
fn floor(material: Material) -> Scene {
    let corners = [[-9.0, 9.0], [9.0, 9.0], [9.0, -9.0], [-9.0, -9.0]].map(|[x, z]| Vec3::new(x, 0.0, z));
    let uv = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
    let triangle = |[a, b, c]: [usize; 3]| Triangle {
        positions: [corners[a], corners[b], corners[c]],
        normals: None,
        uvs: [uv[a], uv[b], uv[c]],
        material: 0,
    };
    Scene { triangles: [[0, 1, 2], [0, 2, 3]].map(triangle).to_vec(), materials: vec![material], ..Scene::default() }
}

/// A disc of the sky, of radiance 1.
fn disc(to_light: Vec3, half_angle: f32) -> DistantLight {
    DistantLight { to_light, cos_half_angle: half_angle.cos(), strength: Rgb::ONE }
}

fn from_above(size: u32, method: Method) -> Settings {
    let camera = Camera::look(Vec3::new(0.2, 3.0, 0.1), Vec3::NEG_Y, Vec3::NEG_Z, 1.0, 1.0, false).expect("view");
    Settings { method, rays: 1024, spp: 16, ..Settings::new(camera, size, size) }
}

struct Picture {
    /// Mean radiance.
    mean: f32,
    records: usize,
    counts: Counts,
    filling: Counts,
}

fn render(scene: Scene, settings: Settings) -> Picture {
    let frame = Frame::new(scene, settings);
    let filled = solo::fill_ranks(&frame, Order::Rounds, cache_core::rounds::RANKS);
    let (pixels, counts) = solo::pixels(&frame, &filled.levels);
    let mean = pixels.chunks_exact(CHANNELS).map(|p| p[0]).sum::<f32>() / (pixels.len() / CHANNELS) as f32;
    Picture { mean, records: filled.levels.first().map_or(0, |l| l.len()), counts, filling: filled.counts }
}

/// A disc of half angle α that the surface sees whole gives E = π sin² α cos θ: exact for paths, to first order in the tilt for
/// records, which are those of the flat floor.
#[test]
fn bumps_tilt_the_light_and_cost_no_records() {
    let (alpha, tilt) = (0.6f32, 0.2f32);
    let light = disc(Vec3::new(FRAC_PI_4.sin(), FRAC_PI_4.cos(), 0.0), alpha);
    let scene = |bump: Vec3| {
        let texel = (bump + 1.0) * 0.5;
        let bumps = Some(Bumps { texture: 0, scale: 1.0 });
        let mut scene = floor(Material { bumps, ..white() });
        scene.textures = vec![Texture { width: 1, height: 1, texels: vec![texel], wrap: [Wrap::Repeat; 2] }];
        scene.distant = vec![light];
        scene
    };
    let mut flat = floor(white());
    flat.distant = vec![light];
    let flat = render(flat, from_above(32, Method::Irradiance));
    // Green points to where v falls: along z.
    for (bump, normal) in [
        (Vec3::Z, Vec3::Y),
        (Vec3::new(tilt.sin(), 0.0, tilt.cos()), Vec3::new(tilt.sin(), tilt.cos(), 0.0)),
        (Vec3::new(-tilt.sin(), 0.0, tilt.cos()), Vec3::new(-tilt.sin(), tilt.cos(), 0.0)),
        (Vec3::new(0.0, tilt.sin(), tilt.cos()), Vec3::new(0.0, tilt.cos(), tilt.sin())),
    ] {
        let exact = 0.5 * alpha.sin().powi(2) * normal.dot(light.to_light);
        let path = render(scene(bump), Settings { spp: 256, ..from_above(16, Method::Path) });
        assert!((path.mean / exact - 1.0).abs() < 0.01, "{bump}: paths {} where {exact} is right", path.mean);
        let cached = render(scene(bump), from_above(32, Method::Irradiance));
        let second_order = 0.6 * tilt * tilt;
        assert!((cached.mean / exact - 1.0).abs() < 0.01 + second_order, "{bump}: {} not {exact}", cached.mean);
        assert_eq!(cached.records, flat.records, "{bump}");
    }
    // A light across the other axis, so that the sign of green is seen.
    let mut across = scene(Vec3::new(0.0, tilt.sin(), tilt.cos()));
    across.distant = vec![disc(Vec3::new(0.0, FRAC_PI_4.cos(), FRAC_PI_4.sin()), alpha)];
    let exact = 0.5 * alpha.sin().powi(2) * (FRAC_PI_4 - tilt).cos();
    let cached = render(across, from_above(32, Method::Irradiance));
    assert!((cached.mean / exact - 1.0).abs() < 0.04, "{} not {exact}", cached.mean);
}

#[test]
fn an_excluded_material_has_no_records_and_the_same_light() {
    let lit = |cached: bool| {
        let mut scene = floor(Material { cached, ..white() });
        scene.distant = vec![disc(Vec3::Y, PI * 0.5)];
        render(scene, Settings { spp: 64, ..from_above(32, Method::Irradiance) })
    };
    let (with, without) = (lit(true), lit(false));
    assert!(with.records > 0 && without.records == 0 && without.counts.queries == 0);
    assert!((with.mean - 0.5).abs() < 0.005 && (without.mean - 0.5).abs() < 0.005, "{} {}", with.mean, without.mean);
}

/// Blades of grass, each narrower than a pixel, that lean in all directions.
fn grass() -> Scene {
    let mut scene = floor(white());
    let mut random = Random::named("grass", &[0]);
    for _ in 0..20_000 {
        let mut around = |size: f32| (random.uniform() - 0.5) * size;
        let root = Vec3::new(around(4.0), 0.0, around(4.0));
        let width = Vec3::new(around(0.03), 0.0, around(0.03));
        let tip = root + Vec3::new(around(0.3), 0.25 + around(0.1), around(0.3));
        scene.triangles.push(Triangle {
            positions: [root - width, root + width, tip],
            normals: None,
            uvs: [Vec2::ZERO; 3],
            material: 0,
        });
    }
    scene.distant = vec![disc(Vec3::Y, PI * 0.5)];
    scene
}

#[test]
fn where_records_would_be_as_dense_as_pixels_samples_gather_for_themselves() {
    let settings = |method, spp| Settings { rays: 256, spp, bounces: 2, ..from_above(64, method) };
    let cached = render(grass(), settings(Method::Irradiance, 16));
    let truth = render(grass(), settings(Method::Path, 256));
    println!("grass: {} records, {:?}, mean {} of {}", cached.records, cached.counts, cached.mean, truth.mean);
    let share = cached.counts.regathers as f64 / cached.counts.samples as f64;
    assert!(cached.filling.dense > 0 && share > 0.2, "{share} gathered for themselves");
    // Left to itself, filling makes 9000.
    assert!(cached.records < 3000, "{} records", cached.records);
    assert!((cached.mean / truth.mean - 1.0).abs() < 0.015, "{} not {}", cached.mean, truth.mean);
    // A room is not grass.
    for name in ["cornell.glb", "stairs.glb"] {
        let (scene, camera) = load(name);
        let room = render(scene, Settings { rays: 64, spp: 1, ..Settings::new(camera, 128, 128) });
        let share = room.filling.dense as f64 / (room.filling.dense as f64 + room.records as f64);
        assert!(share < 0.02, "{name}: {} candidates left", room.filling.dense);
    }
}
