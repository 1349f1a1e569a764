//! Scenes whose pictures can be worked out on paper, rendered by both methods.

use std::f64::consts::PI;
use std::ops::Range;

use ambience_bench::judge::{load, render};
use glam::{Vec2, Vec3};
use worker::frame::Frame;
use worker::scene::{self, Camera, DistantLight, Material, PointLight, Rgb, Scene, Spot, Surface, Texture};
use worker::scene::{Triangle, Wrap};
use worker::settings::{ALL_BOUNCES, Method, Settings};
use worker::solo::{self, Order};

/// Edge of most pictures here, in pixels.
const SIZE: u32 = 16;

fn matter(color: f32, surface: Surface) -> Material {
    Material { surface, ..Material::diffuse(Rgb::splat(color)) }
}

fn lamp(radiance: f32) -> Material {
    Material { emission: Rgb::splat(radiance), double_sided: false, ..matter(0.0, Surface::Diffuse) }
}

fn add_quad(scene: &mut Scene, corners: [Vec3; 4], material: u32) {
    let uv = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y];
    for [a, b, c] in [[0, 1, 2], [0, 2, 3]] {
        let (positions, uvs) = ([corners[a], corners[b], corners[c]], [uv[a], uv[b], uv[c]]);
        scene.triangles.push(Triangle { positions, normals: None, uvs, material });
    }
}

/// A horizontal square about (0, `height`, 0), front upwards, or downwards when `half` is negative.
fn level_square(half: f32, height: f32) -> [Vec3; 4] {
    let h = half.abs();
    [[-h, half], [h, half], [h, -half], [-h, -half]].map(|[x, z]| Vec3::new(x, height, z))
}

/// A floor at y = 0 of a material.
fn floor(half: f32, material: Material) -> Scene {
    let mut scene = Scene { materials: vec![material], ..Scene::default() };
    add_quad(&mut scene, level_square(half, 0.0), 0);
    scene
}

fn read(text: &str) -> Scene {
    let file = tempfile::Builder::new().suffix(".rad").tempfile().expect("temporary file");
    std::fs::write(file.path(), text).expect("written");
    scene::load(file.path()).unwrap_or_else(|e| panic!("{e}"))
}

/// Sees 1 x 1 of the floor about (0.25, 0, 0.125) from a height of 0.5: straight down, along parallel rays or not.
fn above(parallel: bool) -> Camera {
    let size = if parallel { 1.0 } else { 2.0 * 1f32.atan() };
    Camera::look(Vec3::new(0.25, 0.5, 0.125), Vec3::NEG_Y, Vec3::NEG_Z, size, size, parallel).expect("view")
}

fn sized(camera: Camera, method: Method, spp: u32) -> Settings {
    Settings { method, spp, rays: 4096, a: 0.1, ..Settings::new(camera, SIZE, SIZE) }
}

/// What a camera above sees of a floor of radiance `radiance(point)`: the means over the pixels' squares.
fn expected(settings: &Settings, radiance: impl Fn(Vec3) -> f64) -> Vec<f64> {
    const GRID: u32 = 8;
    let place = |i: u32| (i as f32 + 0.5) / GRID as f32;
    let sub = |x: u32, y: u32, i: u32| {
        let (origin, direction) = settings.ray(x as f32 + place(i % GRID), y as f32 + place(i / GRID));
        radiance(origin - direction * (origin.y / direction.y))
    };
    let pixels = (0..settings.height).flat_map(|y| (0..settings.width).map(move |x| (x, y)));
    pixels.map(|(x, y)| (0..GRID * GRID).map(|i| sub(x, y, i)).sum::<f64>() / f64::from(GRID * GRID)).collect()
}

/// Checks every pixel and the mean against what they must be, relative to the greatest.
fn same(name: &str, picture: &[[f64; 3]], exact: &[f64], pixel: f64, mean: f64) {
    let scale = exact.iter().copied().fold(1e-9, f64::max);
    let off = |i: usize| (picture[i][1] - exact[i]) / scale;
    let worst = (0..exact.len()).max_by(|a, b| off(*a).abs().total_cmp(&off(*b).abs())).expect("pixels");
    let bias = (0..exact.len()).map(off).sum::<f64>() / exact.len() as f64;
    println!("{name}: farthest pixel {:+.4} %, mean {:+.4} %", 100.0 * off(worst), 100.0 * bias);
    assert!(picture.iter().flatten().all(|v| v.is_finite()), "{name}: not finite");
    assert!(off(worst).abs() <= pixel, "{name}: pixel {worst} is {} instead of {}", picture[worst][1], exact[worst]);
    assert!(bias.abs() <= mean, "{name}: the mean is off by {bias}");
}

/// Renders with both methods and both kinds of camera.
fn floor_shows(name: &str, scene: &Scene, radiance: impl Fn(Vec3) -> f64, pixel: f64, mean: f64) {
    for method in Method::ALL {
        for parallel in [false, true] {
            let settings = sized(above(parallel), method, 64);
            let exact = expected(&settings, &radiance);
            let name = format!("{name}, {}, {}", method.name(), if parallel { "parallel" } else { "perspective" });
            same(&name, &render(scene.clone(), settings), &exact, pixel, mean);
        }
    }
}

const WHITE: f32 = 0.6;

fn white_floor() -> Scene {
    floor(20.0, matter(WHITE, Surface::Diffuse))
}

/// Radiance of the white floor under this irradiance.
fn reflected(irradiance: f64) -> f64 {
    irradiance * f64::from(WHITE) / PI
}

/// Distance of the disc behind the beam of a point light, and cosine at the floor.
fn towards(light: Vec3, at: Vec3) -> (f64, f64, Vec3) {
    let offset = (light - at).as_dvec3();
    (offset.length_squared(), offset.normalize().y, -offset.normalize().as_vec3())
}

#[test]
fn a_point_light_falls_off_with_the_square_of_its_distance() {
    let position = Vec3::new(0.5, 0.4, 0.0);
    let mut scene = white_floor();
    scene.points.push(PointLight { position, intensity: Rgb::splat(3.0), spot: None });
    let radiance = |at| {
        let (distance2, cosine, _) = towards(position, at);
        reflected(3.0 * cosine / distance2)
    };
    floor_shows("point", &scene, radiance, 2e-3, 2e-4);
    // With a second one, a light has to be chosen.
    let other = Vec3::new(-0.3, 0.9, 0.4);
    scene.points.push(PointLight { position: other, intensity: Rgb::splat(1.0), spot: None });
    let both = |at| {
        let (distance2, cosine, _) = towards(other, at);
        radiance(at) + reflected(cosine / distance2)
    };
    floor_shows("two points", &scene, both, 3e-2, 1e-3);
}

#[test]
fn a_spot_light_is_full_inside_falls_between_its_cones_and_ends() {
    let (position, axis) = (Vec3::new(0.2, 0.8, 0.1), Vec3::new(0.2, -1.0, 0.1).normalize());
    let (inner, outer) = (0.2f64, 0.5f64);
    let spot = Spot { axis, cos_inner: inner.cos() as f32, cos_outer: outer.cos() as f32 };
    let mut scene = white_floor();
    scene.points.push(PointLight { position, intensity: Rgb::splat(2.0), spot: Some(spot) });
    let radiance = |at| {
        let (distance2, cosine, way) = towards(position, at);
        let inside = (f64::from(way.dot(axis)) - outer.cos()) / (inner.cos() - outer.cos());
        reflected(2.0 * cosine / distance2 * inside.clamp(0.0, 1.0).powi(2))
    };
    let settings = sized(above(true), Method::Path, 1);
    let exact = expected(&settings, radiance);
    assert!(exact.contains(&0.0) && exact.iter().any(|v| *v > 0.5));
    floor_shows("spot", &scene, radiance, 1e-2, 1e-3);
}

#[test]
fn a_beam_lights_by_the_cosine_and_not_from_below() {
    for tilt in [0.0f64, 1.0, 1.5] {
        let to_light = Vec3::new(tilt.sin() as f32, tilt.cos() as f32, 0.0);
        let mut scene = white_floor();
        let beam = DistantLight { to_light, cos_half_angle: 1.0, strength: Rgb::splat(2.0) };
        scene.distant.push(beam);
        floor_shows("beam", &scene, |_| reflected(2.0 * f64::from(to_light.y)), 1e-5, 1e-5);
        scene.distant[0].to_light.y *= -1.0;
        floor_shows("beam from below", &scene, |_| 0.0, 0.0, 0.0);
    }
}

/// A disc of half angle h wholly above the horizon gives pi L sin² h cos(tilt); a tilted hemisphere pi L (1 + cos) / 2.
#[test]
fn discs_of_the_sky_give_their_projected_solid_angle() {
    for kind in ["light", "glow"] {
        for (angle, tilt) in [(0.2, 0.7), (0.5, 0.0), (0.5, 1.2), (3.0, 1.0), (10.0, 0.7), (60.0, 0.9)] {
            let (half, radiance) = (f64::to_radians(angle / 2.0), 10.0 / angle);
            let range = if kind == "glow" { "4 {r} {r} {r} 0" } else { "3 {r} {r} {r}" };
            let text = format!(
                "void plastic white 0 0 5 {WHITE} {WHITE} {WHITE} 0 0\nvoid {kind} sun 0 0 {}\n\
                 white polygon floor 0 0 12 -20 0 20 20 0 20 20 0 -20 -20 0 -20\n\
                 sun source sky 0 0 4 {} {} 0 {angle}\n",
                range.replace("{r}", &radiance.to_string()),
                f64::sin(tilt),
                f64::cos(tilt),
            );
            let exact = reflected(PI * radiance * half.sin().powi(2) * tilt.cos());
            // Gathered light is that of one record here, for one covers the floor: 60 degrees are a quarter of its rays.
            let (pixel, mean) = if angle > 50.0 { (0.15, 0.02) } else { (0.02, 1e-3) };
            floor_shows(&format!("{kind} of {angle} degrees"), &read(&text), |_| exact, pixel, mean);
        }
    }
}

#[test]
fn the_sky_gives_a_floor_its_albedo() {
    for kind in ["light sky 0 0 3 1 1 1", "glow sky 0 0 4 1 1 1 0"] {
        for angle in [180, 360] {
            let text = format!(
                "void plastic white 0 0 5 {WHITE} {WHITE} {WHITE} 0 0\nvoid {kind}\n\
                 white polygon floor 0 0 12 -20 0 20 20 0 20 20 0 -20 -20 0 -20\n\
                 sky source above 0 0 4 0 1 0 {angle}\n"
            );
            let name = format!("{kind} {angle}");
            floor_shows(&name, &read(&text), |_| f64::from(WHITE), 0.15, 2e-3);
            // Nothing but cosine-distributed rays into an even sky: no noise at all.
            let picture = render(read(&text), sized(above(true), Method::Irradiance, 4));
            same(&name, &picture, &[f64::from(WHITE); (SIZE * SIZE) as usize], 1e-5, 1e-5);
        }
    }
}

/// Irradiance of a square lamp of radiance 1 at height 1 over a point of the floor, by the midpoint rule.
fn under_lamp(half: f64, at: Vec3) -> f64 {
    const N: u32 = 64;
    let place = |i: u32| (f64::from(i) + 0.5) / f64::from(N) * 2.0 * half - half;
    let part = |x: f64, z: f64| {
        let distance2 = (x - f64::from(at.x)).powi(2) + (z - f64::from(at.z)).powi(2) + 1.0;
        1.0 / distance2.powi(2)
    };
    let sum: f64 = (0..N * N).map(|i| part(place(i % N), place(i / N))).sum();
    sum * (2.0 * half / f64::from(N)).powi(2)
}

#[test]
fn a_square_lamp_lights_what_is_before_it_alone() {
    // Small lamps over broad floors are sampled; over a small floor the same lamp is an eighth of all, and gathered.
    for (half, around, gathered) in [(0.05f32, 20.0f32, false), (0.5, 20.0, false), (0.5, 1.2, true)] {
        let mut scene = floor(around, matter(WHITE, Surface::Diffuse));
        scene.materials.push(lamp(4.0));
        add_quad(&mut scene, level_square(-half, 1.0), 1);
        let (pixel, mean) = if gathered { (0.08, 5e-3) } else { (0.08, 2e-3) };
        let radiance = |at| reflected(4.0 * under_lamp(half.into(), at));
        floor_shows(&format!("lamp of {half} on {around}"), &scene, radiance, pixel, mean);
        // Turned round it shows its back.
        scene.triangles.truncate(2);
        add_quad(&mut scene, level_square(half, 1.0), 1);
        floor_shows("lamp from behind", &scene, |_| 0.0, 0.0, 0.0);
    }
}

/// Looks at the origin from above, `tilt` off the vertical, along parallel rays.
fn slanted(tilt: f32, extent: f32) -> Camera {
    let direction = Vec3::new(tilt.sin(), -tilt.cos(), 0.0);
    Camera::look(-direction * 3.0, direction, Vec3::Z, extent, extent, true).expect("view")
}

fn only(name: &str, scene: &Scene, camera: Camera, spp: u32, value: f64, tolerance: Range<f64>) {
    for method in Method::ALL {
        let picture = render(scene.clone(), sized(camera.clone(), method, spp));
        let exact = [value; (SIZE * SIZE) as usize];
        same(&format!("{name}, {}", method.name()), &picture, &exact, tolerance.end, tolerance.start);
    }
}

#[test]
fn light_and_reflection_come_from_the_right_side_alone() {
    let exact = 0.0..0.0;
    for up in [1.0, -1.0] {
        let glowing = floor(2.0 * up, lamp(3.0));
        only("lamp", &glowing, slanted(0.5, 0.5), 4, if up > 0.0 { 3.0 } else { 0.0 }, exact.clone());
        for double_sided in [false, true] {
            let mut scene = floor(2.0 * up, Material { double_sided, ..matter(0.5, Surface::Diffuse) });
            let beam = DistantLight { to_light: Vec3::Y, cos_half_angle: 1.0, strength: Rgb::ONE };
            scene.distant.push(beam);
            let value = if up > 0.0 || double_sided { 0.5 / PI } else { 0.0 };
            only("one side", &scene, slanted(0.5, 0.5), 4, value, 1e-6..1e-6);
        }
    }
}

#[test]
fn a_mirror_shows_the_lamp_times_its_reflectance() {
    for (surface, color, reflectance) in [
        (Surface::Metal { specular: 1.0, roughness: 0.0 }, 0.8, 0.8),
        (Surface::Metal { specular: 0.5, roughness: 0.0 }, 0.0, 0.0),
        (Surface::Plastic { specular: 0.25, roughness: 0.0 }, 0.0, 0.25),
    ] {
        let mut scene = floor(2.0, matter(color, surface));
        scene.materials.push(lamp(4.0));
        // The camera looks down along +x; the lamp stands behind the mirror point and faces back.
        let wall = [[3.0, -9.0], [3.0, 9.0], [9.0, 9.0], [9.0, -9.0]].map(|[y, z]| Vec3::new(4.0, y - 3.0, z));
        add_quad(&mut scene, wall, 1);
        let back: Vec<_> = scene.triangles[2..].iter().map(worker::world::facet).collect();
        assert!(back.iter().all(|n| n.x < -0.9), "{back:?}");
        only("mirror", &scene, slanted(0.8, 0.5), 4, 4.0 * reflectance, 1e-6..1e-6);
    }
    // A coat over a colour: under an even sky each gives its share.
    let coated = Surface::Plastic { specular: 0.25, roughness: 0.0 };
    let mut scene = floor(2.0, matter(0.5, coated));
    scene.distant.push(sky(1.0));
    only("coat", &scene, slanted(0.8, 0.5), 256, 0.25 + 0.75 * 0.5, 5e-3..0.08);
}

fn sky(radiance: f32) -> DistantLight {
    DistantLight { to_light: Vec3::Y, cos_half_angle: -1.0, strength: Rgb::splat(radiance) }
}

/// Reflectance of a BRDF `f(outgoing, incoming)` for light from everywhere, by the midpoint rule over half vectors'
/// hemisphere, dense towards the pole where lobes are narrow.
fn albedo(tilt: f64, f: impl Fn(glam::DVec3, glam::DVec3) -> f64) -> f64 {
    use glam::DVec3;
    const N: u32 = 600;
    let outgoing = DVec3::new(tilt.sin(), 0.0, tilt.cos());
    let mut sum = 0.0;
    for i in 0..N {
        // theta = pi/2 s³: most steps near the pole.
        let s = (f64::from(i) + 0.5) / f64::from(N);
        let theta = PI / 2.0 * s.powi(3);
        let d_theta = PI / 2.0 * 3.0 * s * s / f64::from(N);
        for j in 0..N {
            let phi = (f64::from(j) + 0.5) / f64::from(N) * PI;
            let half = DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            let cosine = outgoing.dot(half);
            let incoming = half * (2.0 * cosine) - outgoing;
            if cosine > 0.0 && incoming.z > 0.0 {
                // Twice for the other half circle; d incoming = 4 (o·h) d half.
                let measure = 2.0 * theta.sin() * d_theta * PI / f64::from(N) * 4.0 * cosine;
                sum += f(outgoing, incoming) * incoming.z * measure;
            }
        }
    }
    sum
}

/// glTF 2.0, appendix B, in f64 and in its own words: D, G (as V) and F.
fn ggx(alpha: f64, o: glam::DVec3, i: glam::DVec3) -> (f64, f64) {
    let h = (o + i).normalize();
    let a2 = alpha * alpha;
    let d = a2 / (PI * (h.z * h.z * (a2 - 1.0) + 1.0).powi(2));
    let v = |c: f64| 1.0 / (c + (a2 + (1.0 - a2) * c * c).sqrt());
    (d * v(o.z) * v(i.z), (1.0 - o.dot(h)).powi(5))
}

#[test]
fn glossy_surfaces_reflect_an_even_sky_by_the_integral_of_their_brdf() {
    let gltf =
        |metallic, roughness| Surface::Gltf { metallic, roughness, specular: 1.0, specular_color: Rgb::ONE, ior: 1.5 };
    for tilt in [0.2f64, 0.9, 1.3] {
        for roughness in [0.3f32, 0.7, 1.0] {
            let alpha = f64::from(roughness * roughness);
            let mut scene = floor(9.0, matter(1.0, gltf(1.0, roughness)));
            scene.distant.push(sky(1.0));
            let exact = albedo(tilt, |o, i| ggx(alpha, o, i).0);
            assert!(exact <= 1.0 + 1e-6, "{exact}");
            only(&format!("metal {roughness} at {tilt}"), &scene, slanted(tilt as f32, 0.5), 256, exact, 2e-3..0.15);

            scene.materials[0] = matter(0.5, gltf(0.0, roughness));
            let coat = |o, i| {
                let (lobe, grazing) = ggx(alpha, o, i);
                let fresnel = 0.04 + 0.96 * grazing;
                fresnel * lobe + (1.0 - fresnel) * 0.5 / PI
            };
            let exact = albedo(tilt, coat);
            assert!(exact <= 1.0);
            only(&format!("coat {roughness} at {tilt}"), &scene, slanted(tilt as f32, 0.5), 256, exact, 5e-3..0.1);
        }
        for roughness in [0.05f32, 0.2, 0.5] {
            let alpha = f64::from(roughness);
            let mut scene = floor(9.0, matter(1.0, Surface::Metal { specular: 1.0, roughness }));
            scene.distant.push(sky(1.0));
            let ward = |o: glam::DVec3, i: glam::DVec3| {
                let sum = o + i;
                let tan2 = (sum.x * sum.x + sum.y * sum.y) / (sum.z * sum.z);
                (-tan2 / (alpha * alpha)).exp() * sum.length_squared() / (PI * alpha * alpha * sum.z.powi(4))
            };
            let exact = albedo(tilt, ward);
            assert!(exact <= 1.0 + 1e-6, "{exact}");
            only(&format!("ward {roughness} at {tilt}"), &scene, slanted(tilt as f32, 0.5), 256, exact, 2e-3..0.15);
        }
    }
}

#[test]
fn a_checked_floor_shows_its_texels() {
    const EDGE: u32 = 4;
    let dark = |x: i64, y: i64| (x.rem_euclid(EDGE.into()) + y.rem_euclid(EDGE.into())) % 2 == 0;
    let texel = |x, y| if dark(x, y) { 0.25 } else { 1.0 };
    let texels = (0..EDGE * EDGE).map(|i| Rgb::splat(texel((i % EDGE).into(), (i / EDGE).into()) as f32)).collect();
    let mut scene = floor(1.0, Material { texture: Some(0), ..matter(0.8, Surface::Diffuse) });
    scene.textures.push(Texture { width: EDGE, height: EDGE, texels, wrap: [Wrap::Repeat; 2] });
    scene.distant.push(sky(1.0));
    let radiance = |at: Vec3| {
        // The square's first corner, where u = v = 0, is (-1, 0, 1).
        let place = |c: f64| c * f64::from(EDGE) - 0.5;
        let (u, v) = (place((f64::from(at.x) + 1.0) / 2.0), place((1.0 - f64::from(at.z)) / 2.0));
        let (x, y) = (u.floor() as i64, v.floor() as i64);
        let (s, t) = (u - u.floor(), v - v.floor());
        let row = |y| texel(x, y) * (1.0 - s) + texel(x + 1, y) * s;
        0.8 * (row(y) * (1.0 - t) + row(y + 1) * t)
    };
    floor_shows("checks", &scene, radiance, 0.15, 3e-3);
    let settings = sized(above(true), Method::Irradiance, 64);
    let exact = expected(&settings, radiance);
    same("checks without noise", &render(scene, settings), &exact, 2e-3, 1e-4);
}

/// A closed cube whose faces are cut into `cuts`² squares; every triangle has one of `materials` materials in turn.
fn cube(cuts: u32, materials: u32) -> Scene {
    let wall = Material { emission: Rgb::ONE, ..matter(0.5, Surface::Diffuse) };
    let mut scene = Scene { materials: vec![wall; materials as usize], ..Scene::default() };
    for axis in 0..3 {
        for side in [-1.0f32, 1.0] {
            for i in 0..cuts * cuts {
                let at = |u: u32, v: u32| {
                    let place = |k: u32| 2.0 * k as f32 / cuts as f32 - 1.0;
                    let mut corner = Vec3::ZERO;
                    corner[axis] = side;
                    corner[(axis + 1) % 3] = place(u);
                    corner[(axis + 2) % 3] = place(v);
                    corner
                };
                let (u, v) = (i % cuts, i / cuts);
                let mut corners = [at(u, v), at(u + 1, v), at(u + 1, v + 1), at(u, v + 1)];
                // Fronts are inside.
                if side > 0.0 {
                    corners.reverse();
                }
                add_quad(&mut scene, corners, 0);
            }
        }
    }
    for (i, triangle) in scene.triangles.iter_mut().enumerate() {
        triangle.material = i as u32 % materials;
    }
    scene
}

#[test]
fn every_bounce_in_a_furnace_adds_half_of_the_one_before() {
    // One material is broad and gathered; twelve and more are each too small for that and sampled.
    for (cuts, materials) in [(1, 1), (1, 12), (2, 48)] {
        for (bounces, exact) in [(0, 1.5), (1, 1.75), (2, 1.875), (3, 1.9375), (5, 1.984375), (ALL_BOUNCES, 2.0)] {
            for method in Method::ALL {
                let camera =
                    Camera::look(Vec3::new(0.1, 0.2, -0.3), Vec3::new(1.0, 0.3, 0.2), Vec3::Y, 1.6, 1.6, false);
                // Beside a corner, sampled light of the other wall is noisy where records leave nothing to weigh it with.
                let (spp, pixel, mean) = match method {
                    Method::Path => (256, 0.03, 5e-4),
                    _ if materials == 1 => (4, 5e-3, 2e-3),
                    _ => (64, 0.5, 0.01),
                };
                let settings = Settings { bounces, a: 0.3, rays: 2048, ..sized(camera.expect("view"), method, spp) };
                let picture = render(cube(cuts, materials), settings);
                let name = format!("furnace of {materials}, {bounces} bounces, {}", method.name());
                same(&name, &picture, &[exact; (SIZE * SIZE) as usize], pixel, mean);
            }
        }
    }
}

fn moved(mut scene: Scene, mut camera: Camera, scale: f32, offset: Vec3) -> (Scene, Camera) {
    for triangle in &mut scene.triangles {
        triangle.positions = triangle.positions.map(|p| p * scale + offset);
    }
    for point in &mut scene.points {
        point.position = point.position * scale + offset;
        point.intensity *= scale * scale;
    }
    camera.eye = camera.eye * scale + offset;
    (scene, camera)
}

/// The picture and the records of each level.
fn picture_and_records(scene: Scene, settings: Settings) -> (Vec<f32>, Vec<usize>) {
    let frame = Frame::new(scene, settings);
    let levels = solo::fill(&frame, Order::Rounds);
    (solo::pixels(&frame, &levels).0, levels.iter().map(|l| l.len()).collect())
}

/// Mean relative difference of two pictures, and difference of the means.
fn difference(a: &[f32], b: &[f32]) -> (f64, f64) {
    let beauty = |p: &[f32]| -> Vec<f64> { p.chunks(13).flat_map(|c| c[..3].to_vec()).map(f64::from).collect() };
    let (a, b) = (beauty(a), beauty(b));
    let mean = a.iter().sum::<f64>() / a.len() as f64;
    let apart = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum::<f64>() / a.len() as f64;
    (apart / mean, b.iter().sum::<f64>() / a.len() as f64 / mean - 1.0)
}

#[test]
fn the_unit_of_length_and_the_origin_do_not_matter() {
    let mut base = load("cornell.glb");
    base.0.points.push(PointLight { position: Vec3::new(0.2, 0.4, -0.3), intensity: Rgb::splat(0.3), spot: None });
    for method in Method::ALL {
        let settings = |camera| Settings { a: 0.3, rays: 256, ..Settings::new(camera, 64, 64) };
        let shot = |scale, offset| {
            let (scene, camera) = moved(base.0.clone(), base.1.clone(), scale, offset);
            let spp = if method == Method::Path { 128 } else { 16 };
            picture_and_records(scene, Settings { method, spp, ..settings(camera) })
        };
        let (metres, records) = shot(1.0, Vec3::ZERO);
        // What is a power of two times as large has the same bits until squares underflow; a record's random numbers come from its site, though.
        let cases = [
            ("x 1024", 1024.0, Vec3::ZERO, 0.0),
            ("/ 1048576", 1.0 / 1_048_576.0, Vec3::ZERO, 0.0),
            ("x 2^30", 30f32.exp2(), Vec3::ZERO, 0.0),
            ("x 2^-30", (-30f32).exp2(), Vec3::ZERO, 1e-6),
            ("x 1000", 1000.0, Vec3::ZERO, 0.005),
            ("x 1e6", 1e6, Vec3::ZERO, 0.005),
            ("x 1000 + 1e4", 1000.0, Vec3::new(1e4, -1e4, 1e4), 0.005),
            // A millimetre is the last digit here, and rays start two centimetres off their surfaces.
            ("+ 1e4", 1.0, Vec3::new(1e4, -1e4, 1e4), 0.08),
        ];
        for (name, scale, offset, tolerance) in cases {
            let (other, others) = shot(scale, offset);
            let (apart, bias) = difference(&metres, &other);
            let name = format!("{} {name}", method.name());
            println!("{name}: apart {apart:.5}, bias {bias:+.5}, records {records:?} {others:?}");
            if method == Method::Path {
                // The last case converges to +0.12 % (512 samples a pixel): its surfaces themselves are a millimetre off.
                let most = if tolerance > 0.01 { 2e-3 } else { 1e-3 };
                assert!(apart <= tolerance && bias.abs() <= most, "{name}: {apart} apart, bias {bias}");
                assert!(tolerance > 0.0 || other == metres, "{name}: not the same bits");
            } else {
                assert!(apart <= 0.02 + tolerance && bias.abs() <= 0.01, "{name}: {apart} apart, bias {bias}");
                let more = others.iter().sum::<usize>() as f64 / records.iter().sum::<usize>() as f64 - 1.0;
                assert!(more.abs() <= 0.02 + 2.0 * tolerance, "{name}: {others:?} records instead of {records:?}");
            }
        }
    }
}
