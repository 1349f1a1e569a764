use glam::Vec2;
use proptest::prelude::*;

use super::traverse::Lanes;
use super::*;

fn triangle(positions: [Vec3; 3]) -> Triangle {
    Triangle { positions, normals: None, uvs: [Vec2::ZERO; 3], material: 0 }
}

fn soup() -> impl Strategy<Value = Vec<Triangle>> {
    let corner = || prop::array::uniform3(-1f32..1.0).prop_map(Vec3::from);
    prop::collection::vec((corner(), corner(), corner()).prop_map(|(a, b, c)| triangle([a, b, c])), 1..60)
}

/// Triangles between points of a coarse grid: many degenerate, many that touch, overlap or coincide.
fn grid_soup() -> impl Strategy<Value = Vec<Triangle>> {
    let corner = || prop::array::uniform3(-2i8..=2).prop_map(|c| Vec3::from(c.map(|x| f32::from(x) * 0.5)));
    prop::collection::vec((corner(), corner(), corner()).prop_map(|(a, b, c)| triangle([a, b, c])), 1..90)
}

/// Directions of any length, along axes and almost along them.
fn direction() -> impl Strategy<Value = Vec3> {
    let component = (-1f32..1.0, prop_oneof![Just(0), Just(1), 2i32..40]).prop_map(|(x, small)| match small {
        // Of either sign.
        0 => x * 0.0,
        k => x * 0.5f32.powi(k - 1),
    });
    (prop::array::uniform3(component), -20i32..20)
        .prop_map(|(d, scale)| Vec3::from(d) * 2f32.powi(scale))
        .prop_filter("a direction", |d| d.abs().max_element() > 1e-9)
}

/// The nearest hit found by trying every triangle; of several the first.
fn nearest(soup: &[Triangle], origin: Vec3, direction: Vec3) -> Option<Hit> {
    let ray = Ray::new(origin, direction, &[Vec3::ZERO; 2]);
    let hits = soup.iter().enumerate().filter_map(|(i, triangle)| {
        let mut leaf: Vec<f32> = triangle.positions.iter().flat_map(|p| p.to_array()).collect();
        leaf.push(0.0);
        let (mask, met) = Portable.triangles::<false>(&leaf, 1, &ray, f32::INFINITY);
        let uv = [met.v[0] / met.det[0], met.w[0] / met.det[0]];
        (mask != 0).then_some(Hit { triangle: i as u32, t: met.t[0], uv })
    });
    hits.reduce(|a, b| if b.t < a.t { b } else { a })
}

/// Both ways of tracing: with what this machine has, and without.
fn both(soup: &[Triangle]) -> [Bvh; 2] {
    [Bvh::new(soup), Bvh::new(soup).portable()]
}

proptest! {
    #[test]
    fn the_tree_agrees_with_trying_every_triangle(soup in soup(), o in prop::array::uniform3(-2f32..2.0), to in prop::array::uniform3(-1f32..1.0)) {
        let (origin, direction) = (Vec3::from(o), Vec3::from(to) - Vec3::from(o));
        prop_assume!(direction.length() > 1e-3);
        let nearest = nearest(&soup, origin, direction);
        for bvh in both(&soup) {
            let hit = bvh.closest(origin, direction, f32::INFINITY);
            prop_assert_eq!(hit, nearest);
            prop_assert_eq!(bvh.occluded(origin, direction, f32::INFINITY), hit.is_some());
            if let Some(hit) = hit {
                prop_assert!(!bvh.occluded(origin, direction, hit.t));
                prop_assert!(bvh.occluded(origin, direction, hit.t.next_up()));
            }
        }
    }

    /// Of equal distances the lowest index wins; rays along axes, edges and box faces, and components of direction far
    /// below the others, are rays like others.
    #[test]
    fn ties_and_axes_agree_too(soup in grid_soup(), o in prop::array::uniform3(-4i8..=4), direction in direction()) {
        let origin = Vec3::from(o.map(|x| f32::from(x) * 0.25));
        let nearest = nearest(&soup, origin, direction);
        for bvh in both(&soup) {
            prop_assert_eq!(bvh.closest(origin, direction, f32::INFINITY), nearest);
            prop_assert_eq!(bvh.occluded(origin, direction, f32::INFINITY), nearest.is_some());
            // However short the direction.
            let far = nearest.map(|hit| Hit { t: hit.t * 2f32.powi(40), ..hit });
            prop_assert_eq!(bvh.closest(origin, direction * 2f32.powi(-40), f32::INFINITY), far);
        }
    }

    /// A closed box of 12 triangles lets no ray out, even aimed at edges and corners, whatever the unit of length and
    /// wherever it stands.
    #[test]
    fn shared_edges_are_watertight(o in prop::array::uniform3(-0.9f32..0.9), edge in 0usize..12, along in -1f32..1.0, scale in -12i32..12, far in prop::array::uniform3(-1i8..=1)) {
        // 1e5 edges from the origin a box of this size still has a few hundred floats along each edge.
        let place = |p: Vec3| (p + Vec3::from(far.map(f32::from)) * 1e5) * 10f32.powi(scale);
        let corner = |i: usize| place(Vec3::new((i & 1) as f32, (i >> 1 & 1) as f32, (i >> 2) as f32) * 2.0 - 1.0);
        let sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
        let soup: Vec<_> = sides.iter().flat_map(|s| {
            [triangle([corner(s[0]), corner(s[1]), corner(s[2])]), triangle([corner(s[0]), corner(s[2]), corner(s[3])])]
        }).collect();
        let axis = edge / 4;
        let mut at = Vec3::splat(-1.0);
        at[axis] = along;
        at[(axis + 1) % 3] = if edge & 1 == 0 { -1.0 } else { 1.0 };
        at[(axis + 2) % 3] = if edge & 2 == 0 { -1.0 } else { 1.0 };
        let origin = place(Vec3::from(o));
        let direction = (place(at) - origin).normalize();
        for bvh in both(&soup) {
            prop_assert!(bvh.closest(origin, direction, f32::INFINITY).is_some());
            prop_assert!(bvh.occluded(origin, direction, f32::INFINITY));
        }
    }
}

/// A ball of 2 x 24 x 12 triangles, lit from within and seen from without.
fn ball(place: impl Fn(Vec3) -> Vec3) -> Vec<Triangle> {
    let corner = |i: u32, j: u32| {
        let (phi, theta) = ((i % 24) as f32 * std::f32::consts::TAU / 24.0, j as f32 * std::f32::consts::PI / 12.0);
        let ((s, c), (sin, cos)) = (crate::math::sin_cos(phi), crate::math::sin_cos(theta));
        // Exactly one point at either pole.
        let sin = if j.is_multiple_of(12) { 0.0 } else { sin };
        place(Vec3::new(sin * c, sin * s, cos))
    };
    let cells = (0..24).flat_map(|i| (0..12).map(move |j| (i, j)));
    let halves = |(i, j)| {
        let [a, b, c, d] = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
        [triangle([a, b, c]), triangle([a, c, d])]
    };
    cells.flat_map(halves).collect()
}

/// Rays from within a ball at every corner and edge of it, and from outside past it.
fn no_ray_leaves_a_ball(place: impl Fn(Vec3) -> Vec3) {
    let soup = ball(&place);
    let middle = place(Vec3::new(0.1, -0.2, 0.05));
    let beside = [place(Vec3::new(-3.0, 1.25, 0.0)), place(Vec3::new(3.0, 1.25, 0.0))];
    for bvh in both(&soup) {
        for t in &soup {
            for k in 0..16 {
                let end = t.positions[0].lerp(t.positions[1], k as f32 / 15.0);
                let way = end - middle;
                let hit = bvh.closest(middle, way.normalize(), f32::INFINITY).expect("a hit");
                assert!((hit.t / way.length() - 1.0).abs() < 0.05, "{hit:?} {}", way.length());
                assert!(!bvh.occluded(middle, way.normalize(), 0.9 * way.length()));
            }
        }
        let way = beside[1] - beside[0];
        assert!(!bvh.occluded(beside[0], way.normalize(), f32::INFINITY));
    }
}

#[test]
fn a_scene_in_millimetres_is_closed() {
    no_ray_leaves_a_ball(|p| p * 1e3);
    no_ray_leaves_a_ball(|p| p * 1e-3);
    no_ray_leaves_a_ball(|p| p * 1e-12);
}

#[test]
fn a_scene_far_from_the_origin_is_closed() {
    no_ray_leaves_a_ball(|p| p + Vec3::new(1e5, -2e5, 1e5));
    no_ray_leaves_a_ball(|p| p + Vec3::new(0.0, 0.0, 1e5));
}

#[test]
fn small_components_of_a_direction_count() {
    // A wall seen along it almost: after a length of 10 the ray is 1e-6 off.
    let (low, high) = (Vec3::new(10.0, 5e-7, -1.0), Vec3::new(10.0, 2e-6, 1.0));
    let wall = [low, Vec3::new(10.0, 5e-7, 1.0), high];
    let direction = |y: f32| Vec3::new(1.0, y, 0.0);
    for bvh in both(&[triangle(wall)]) {
        assert!(bvh.occluded(Vec3::ZERO, direction(1e-7), f32::INFINITY));
        assert!(!bvh.occluded(Vec3::ZERO, direction(4e-8), f32::INFINITY));
        assert!(!bvh.occluded(Vec3::ZERO, direction(-1e-7), f32::INFINITY));
    }
}

/// Ever smaller triangles towards a point make a deep tree.
#[test]
fn deep_trees_are_traced() {
    let at = |k: i32, x: f32, y: f32| Vec3::new(x, y, 1.0) * 1.7f32.powi(k);
    let soup: Vec<_> = (-150..150).map(|k| triangle([at(k, -1.0, -1.0), at(k, 1.0, -1.0), at(k, 0.0, 1.0)])).collect();
    for bvh in both(&soup) {
        assert!(bvh.tree.depth > 20, "{}", bvh.tree.depth);
        let from = Vec3::new(0.0, 0.0, -1.0);
        assert_eq!(bvh.closest(from, Vec3::Z, f32::INFINITY), nearest(&soup, from, Vec3::Z));
        assert_eq!(bvh.closest(Vec3::ZERO, Vec3::Z, f32::INFINITY), nearest(&soup, Vec3::ZERO, Vec3::Z));
        let top = Vec3::Z * 1.7f32.powi(150);
        assert_eq!(bvh.closest(top, -Vec3::Z, f32::INFINITY), nearest(&soup, top, -Vec3::Z));
    }
}

#[test]
fn an_empty_scene_is_never_hit() {
    for bvh in both(&[]) {
        assert!(bvh.closest(Vec3::ZERO, Vec3::X, f32::INFINITY).is_none());
        assert!(!bvh.occluded(Vec3::ZERO, Vec3::X, 1.0));
    }
}
