use proptest::prelude::*;

use super::tree::{Lamp, LightTree, Place, Shines};
use super::*;
use crate::scene::Spot;

fn vector() -> impl Strategy<Value = Vec3> {
    prop::array::uniform3(-1f32..1.0).prop_map(Vec3::from)
}

fn unit() -> impl Strategy<Value = Vec3> {
    vector().prop_filter("a direction", |v| v.length() > 0.1).prop_map(Vec3::normalize)
}

fn lamp() -> impl Strategy<Value = Lamp> {
    let spot = |axis| Spot { axis, cos_inner: 0.9, cos_outer: 0.7 };
    let shines = prop_oneof![
        4 => unit().prop_map(Shines::Front),
        1 => Just(Shines::Round),
        1 => unit().prop_map(move |axis| Shines::Cone(spot(axis))),
    ];
    (vector(), shines, 0.01f32..10.0, 0.001f32..0.2).prop_map(|(middle, shines, power, radius)| {
        let flat = matches!(shines, Shines::Front(_));
        let radius = if flat { radius } else { 0.0 };
        Lamp { middle, radius, power, area: radius * radius, shines }
    })
}

proptest! {
    /// Chances are those with which lamps are chosen, sum to no more than one, and are nothing only for lamps that give
    /// nothing.
    #[test]
    fn lamps_are_chosen_by_their_chances(lamps in prop::collection::vec(lamp(), 1..100), position in vector(), normal in unit()) {
        let place = Place { position, normal };
        let (tree, order) = LightTree::new(&lamps);
        prop_assert_eq!(order.len(), lamps.len());
        let chances: Vec<f32> = (0..lamps.len()).map(|i| tree.chance(&place, i)).collect();
        prop_assert!(chances.iter().sum::<f32>() < 1.001);
        const LOOKS: usize = 4096;
        let mut chosen = vec![0; lamps.len()];
        for k in 0..LOOKS {
            if let Some((lamp, chance)) = tree.choose(&place, (k as f32 + 0.5) / LOOKS as f32) {
                prop_assert_eq!(chance.to_bits(), chances[lamp].to_bits());
                chosen[lamp] += 1;
            }
        }
        for (lamp, &chance) in chances.iter().enumerate() {
            // Each lamp's numbers lie side by side: what two ends can miss.
            prop_assert!((chosen[lamp] as f32 - chance * LOOKS as f32).abs() < 3.0, "{} {}", chosen[lamp], chance);
            let Lamp { middle, shines, .. } = lamps[order[lamp] as usize];
            let offset = middle - position;
            let shone = match shines {
                Shines::Front(front) => -front.dot(offset) > 1e-3,
                Shines::Round => true,
                Shines::Cone(spot) => spot.falloff(-spot.axis.dot(offset.normalize())) > 1e-3,
            };
            prop_assert!(!shone || normal.dot(offset) < 1e-3 || chance > 0.0);
        }
    }
}

/// Near lamps are chosen more often than far ones, those behind not at all: what a tree is for.
#[test]
fn near_lamps_are_preferred() {
    let lamp = |k: u32| Lamp {
        middle: Vec3::new(k as f32, 0.0, 1.0),
        radius: 0.1,
        power: 1.0,
        area: 0.01,
        shines: Shines::Front(-Vec3::Z),
    };
    let lamps: Vec<_> = (0..1000).map(lamp).collect();
    let (tree, order) = LightTree::new(&lamps);
    let place = |z: f32| Place { position: Vec3::new(700.0, 0.0, z), normal: Vec3::Z };
    let near: f32 = (0..1000).filter(|&i| order[i].abs_diff(700) < 3).map(|i| tree.chance(&place(0.0), i)).sum();
    assert!(near > 0.4, "{near}: by power it would be 0.005");
    assert!(tree.choose(&place(1.5), 0.5).is_none(), "behind and below all of them");
}

/// A point of a lamp a rounding behind or before a place on it has no direction from there.
#[test]
fn light_on_a_lamp_itself_is_finite() {
    use crate::scene::{Material, Rgb, Scene, Triangle};
    let corners = [Vec3::new(1.25, 2.25, 1.5), Vec3::new(1.75, 2.125, 1.375), Vec3::new(1.5, 2.5, 1.625)];
    let material = Material { emission: Rgb::ONE, ..Material::diffuse(Rgb::ZERO) };
    let triangle = Triangle { positions: corners, normals: None, uvs: [glam::Vec2::ZERO; 3], material: 0 };
    let world = World::new(Scene { triangles: vec![triangle], materials: vec![material], ..Scene::default() });
    let lights = Lights::new(&world, false);
    let mut random = cache_core::id::Random::named("on a lamp", &[]);
    for _ in 0..100_000 {
        let [s, t] = [random.uniform().sqrt(), random.uniform()];
        let position = corners[0] * (1.0 - s) + corners[1] * (s * (1.0 - t)) + corners[2] * (s * t);
        let place = Place { position, normal: -facet(&world.scene.triangles[0]) };
        let u = std::array::from_fn(|_| random.uniform());
        let arrival = lights.sample(&world, &place, u);
        assert!(arrival.is_none_or(|a| a.direction.is_normalized() && a.weight.is_finite()), "{position:?}");
        let density = lights.pdf_triangle(&world, 0, &place, corners[1] - position, (corners[1] - position).length());
        assert!(!density.is_nan(), "{position:?}");
    }
    // Far away in a lamp's plane: no chance, and a density without bound.
    let level = [Vec3::ZERO, Vec3::X, Vec3::Y];
    let world = World::new(Scene {
        triangles: vec![Triangle { positions: level, ..triangle }],
        materials: world.scene.materials,
        ..Scene::default()
    });
    let place = Place { position: Vec3::X * 50.0, normal: Vec3::NEG_X };
    assert_eq!(Lights::new(&world, false).pdf_triangle(&world, 0, &place, Vec3::NEG_X, 49.5), 0.0);
}
