//! A furnished room, made up: sun and sky through a window with louvres, coloured walls, a vase of brushed metal.

use cache_core::math::sin_cos;
use glam::Vec3;

use crate::model::{Corners, Matter, Model, block, sheet, turned};

/// Extent of the room, metres.
const ROOM: Vec3 = Vec3::new(4.2, 2.8, 5.0);

/// The window in the wall at x = 0: from and to along z, and in height.
const WINDOW: [[f32; 2]; 2] = [[1.1, 3.1], [0.9, 2.3]];

/// Thickness of the outer walls.
const WALL: f32 = 0.25;

/// Louvres in the window.
const LOUVRES: u32 = 8;

/// The scene and its view.
pub fn model() -> Model {
    let matter = |name, color, surface| Matter { name, color, metal: None, surface };
    let (mut vase, foot) = (Vec::new(), Vec3::new(1.95, 0.75, 1.7));
    let belly = |k: u32| {
        let t = k as f32 / 24.0;
        (0.05 + 0.12 * sin_cos(std::f32::consts::PI * (0.1 + 0.8 * t)).0, 0.34 * t)
    };
    let profile: Vec<_> = [(0.0, 0.0)].into_iter().chain((0..=24).map(belly)).collect();
    turned(foot, &profile, 64, &mut vase);
    Model {
        name: "louvres",
        matters: vec![
            matter("white", [0.78, 0.77, 0.74], shell()),
            matter("red", [0.6, 0.16, 0.1], wall(ROOM.x)),
            matter("boards", [0.45, 0.3, 0.18], floor()),
            matter("slats", [0.7, 0.68, 0.6], slats()),
            matter("wood", [0.38, 0.22, 0.12], furniture()),
            matter("blue", [0.12, 0.25, 0.5], cushions()),
            matter("ground", [0.3, 0.28, 0.22], outside()),
            Matter { name: "brass", color: [0.9, 0.72, 0.4], metal: Some(0.08), surface: vase },
        ],
        to_sun: Vec3::new(-0.75, 0.6, -0.28).normalize(),
        sun: [30.0, 27.0, 22.0],
        sky: [2.1, 2.8, 3.8],
        eye: Vec3::new(3.3, 1.5, 4.7),
        forward: Vec3::new(-0.25, -0.18, -1.0).normalize(),
        angle: 62.0,
    }
}

/// Ceiling, back and front wall, and what is left of the wall with the window; outer walls are thick.
fn shell() -> Vec<Corners> {
    let mut soup = Vec::new();
    let [[z0, z1], [y0, y1]] = WINDOW;
    let (low, high) = (Vec3::new(-WALL, 0.0, 0.0), Vec3::new(0.0, ROOM.y, ROOM.z));
    block(low, Vec3::new(0.0, y0, high.z), &mut soup);
    block(Vec3::new(low.x, y1, 0.0), high, &mut soup);
    block(Vec3::new(low.x, y0, 0.0), Vec3::new(0.0, y1, z0), &mut soup);
    block(Vec3::new(low.x, y0, z1), Vec3::new(0.0, y1, high.z), &mut soup);
    block(Vec3::new(-WALL, ROOM.y, -WALL), ROOM + Vec3::new(WALL, WALL, WALL), &mut soup);
    block(Vec3::new(-WALL, 0.0, -WALL), Vec3::new(ROOM.x + WALL, ROOM.y, 0.0), &mut soup);
    block(Vec3::new(-WALL, 0.0, ROOM.z), Vec3::new(ROOM.x + WALL, ROOM.y, ROOM.z + WALL), &mut soup);
    soup
}

fn wall(x: f32) -> Vec<Corners> {
    let mut soup = Vec::new();
    block(Vec3::new(x, 0.0, 0.0), Vec3::new(x + WALL, ROOM.y, ROOM.z), &mut soup);
    soup
}

fn floor() -> Vec<Corners> {
    let mut soup = Vec::new();
    block(Vec3::new(-WALL, -0.2, -WALL), Vec3::new(ROOM.x + WALL, 0.0, ROOM.z + WALL), &mut soup);
    soup
}

/// Thin boards that slope down outwards.
fn slats() -> Vec<Corners> {
    let mut soup = Vec::new();
    let [[z0, z1], [y0, y1]] = WINDOW;
    for k in 0..LOUVRES {
        let y = y0 + (y1 - y0) * (k as f32 + 0.5) / LOUVRES as f32;
        for lift in [0.0, 0.012] {
            sheet(
                1,
                1,
                |s| Vec3::new(-0.2 + 0.11 * s.x, y - 0.01 + lift + 0.02 * s.x, z0 + (z1 - z0) * s.y),
                &mut soup,
            );
        }
    }
    soup
}

/// A table, a shelf with boards, a cupboard.
fn furniture() -> Vec<Corners> {
    let mut soup = Vec::new();
    let (from, to) = (Vec3::new(1.3, 0.0, 1.2), Vec3::new(2.6, 0.0, 2.3));
    block(from.with_y(0.7), to.with_y(0.75), &mut soup);
    for (x, z) in [(from.x, from.z), (to.x - 0.06, from.z), (from.x, to.z - 0.06), (to.x - 0.06, to.z - 0.06)] {
        block(Vec3::new(x, 0.0, z), Vec3::new(x + 0.06, 0.7, z + 0.06), &mut soup);
    }
    for y in [0.05, 0.5, 0.95, 1.4, 1.85] {
        block(Vec3::new(0.4, y, 0.0), Vec3::new(1.6, y + 0.03, 0.32), &mut soup);
    }
    for x in [0.4, 1.57] {
        block(Vec3::new(x, 0.0, 0.0), Vec3::new(x + 0.03, 1.88, 0.32), &mut soup);
    }
    block(Vec3::new(3.6, 0.0, 0.6), Vec3::new(ROOM.x, 1.1, 2.2), &mut soup);
    soup
}

/// Books on the shelf and a stool.
fn cushions() -> Vec<Corners> {
    let mut soup = Vec::new();
    for (k, height) in [0.3, 0.26, 0.34, 0.28, 0.31, 0.25].into_iter().enumerate() {
        let x = 0.47 + 0.05 * k as f32;
        for (y, shift) in [(0.53, 0.0), (0.98, 0.4), (1.43, 0.2)] {
            block(Vec3::new(x + shift, y, 0.03), Vec3::new(x + shift + 0.04, y + height, 0.25), &mut soup);
        }
    }
    block(Vec3::new(2.7, 0.0, 2.6), Vec3::new(3.15, 0.45, 3.05), &mut soup);
    soup
}

/// The ground before the window.
fn outside() -> Vec<Corners> {
    let mut soup = Vec::new();
    sheet(8, 8, |s| Vec3::new(-WALL - 20.0 * s.x, -0.2, -18.0 + 40.0 * s.y), &mut soup);
    soup
}
