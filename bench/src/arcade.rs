//! An arcade of some 65 000 triangles, made up: groin vaults on columns along a sunlit court.

use std::f32::consts::{PI, TAU};

use cache_core::math::sin_cos;
use glam::{Vec2, Vec3};

use crate::model::{Corners, Matter, Model, block, sheet, turned};

/// Edge of a bay, metres: as wide along the arcade as across, and how many there are.
const BAY: f32 = 3.4;
const BAYS: u32 = 8;
const LENGTH: f32 = BAY * BAYS as f32;

/// Height where arches and vaults begin.
const SPRING: f32 = 3.0;

/// Thickness of the front's wall, and half the width of a pier above a capital.
const WALL: f32 = 0.6;
const PIER: f32 = 0.3;

/// Height of the walls round the court, and how far off the one across is.
const TOP: f32 = 6.2;
const COURT: f32 = 13.0;

/// The scene and its view: along the arcade, the court to the left.
pub fn model() -> Model {
    let matter = |name, color, surface| Matter { name, color, metal: None, surface };
    let [light, dark] = paving();
    Model {
        name: "arcade",
        matters: vec![
            matter("stone", [0.62, 0.55, 0.45], stone()),
            matter("plaster", [0.78, 0.74, 0.67], plaster()),
            matter("ochre", [0.66, 0.42, 0.25], wall_across()),
            matter("light", [0.6, 0.56, 0.5], light),
            matter("dark", [0.3, 0.2, 0.17], dark),
            matter("grass", [0.17, 0.24, 0.08], grass()),
        ],
        to_sun: Vec3::new(0.5, 0.9, -0.55).normalize(),
        sun: [9.0, 8.1, 6.6],
        sky: [0.42, 0.6, 0.9],
        eye: Vec3::new(0.9, 1.7, 2.35),
        forward: Vec3::new(1.0, 0.06, -0.36).normalize(),
        angle: 68.0,
    }
}

/// Columns, arches above them with their mouldings, a cornice, and a fountain in the court.
fn stone() -> Vec<Corners> {
    let mut soup = Vec::new();
    let mut profile = vec![(0.33, 0.12), (0.36, 0.17), (0.36, 0.22), (0.29, 0.26), (0.31, 0.3), (0.26, 0.34)];
    // The shaft swells (entasis).
    profile.extend((0..=20).map(|k| {
        let t = k as f32 / 20.0;
        (0.24 - 0.04 * t * t + 0.012 * sin_cos(PI * t).0, 0.36 + 2.2 * t)
    }));
    profile.extend([(0.24, 2.58), (0.24, 2.62), (0.21, 2.66), (0.25, 2.76), (0.33, 2.86), (0.34, 2.88)]);
    for k in 0..=BAYS {
        let foot = Vec3::new(k as f32 * BAY, 0.0, -WALL / 2.0);
        block(foot - Vec3::new(0.38, 0.0, 0.38), foot + Vec3::new(0.38, 0.12, 0.38), &mut soup);
        turned(foot, &profile, 32, &mut soup);
        block(foot + Vec3::new(-0.36, 2.88, -0.36), foot + Vec3::new(0.36, SPRING, 0.36), &mut soup);
    }
    for k in 0..BAYS {
        arch((k as f32 + 0.5) * BAY, &mut soup);
    }
    block(Vec3::new(0.0, TOP - 0.25, -WALL - 0.25), Vec3::new(LENGTH, TOP, -WALL), &mut soup);
    let bowl = [(0.0, 0.25), (1.0, 0.25), (1.15, 0.6), (1.3, 0.75), (1.3, 0.85), (1.15, 0.85), (1.0, 0.5), (0.2, 0.5)];
    let jet = [(0.2, 0.5), (0.14, 1.2), (0.6, 1.45), (0.62, 1.52), (0.1, 1.4), (0.07, 1.9), (0.0, 1.95)];
    let middle = Vec3::new(4.3 * BAY, -0.3, -6.4);
    turned(middle, &bowl, 48, &mut soup);
    turned(middle, &jet, 48, &mut soup);
    soup
}

/// One bay of the front: wall over an arch on both faces, the arch's soffit, and a round moulding along its edge.
fn arch(x: f32, soup: &mut Vec<Corners>) {
    let radius = BAY / 2.0 - PIER;
    let curve = |t: f32| {
        let (sin, cos) = sin_cos(PI * t);
        Vec3::new(x - radius * cos, SPRING + radius * sin, 0.0)
    };
    for z in [-WALL, 0.0] {
        sheet(
            40,
            3,
            |s| {
                let low = curve(s.x);
                low.with_y(low.y + (TOP - low.y) * s.y) + Vec3::Z * z
            },
            soup,
        );
        for side in [-BAY / 2.0, radius] {
            sheet(1, 1, |s| Vec3::new(x + side + PIER * s.x, SPRING + (TOP - SPRING) * s.y, z), soup);
        }
    }
    sheet(40, 4, |s| curve(s.x) - Vec3::Z * (WALL * s.y), soup);
    sheet(
        40,
        10,
        |s| {
            let ((sin, cos), (out, across)) = (sin_cos(PI * s.x), sin_cos(TAU * s.y));
            let radius = radius + 0.1 + 0.07 * out;
            Vec3::new(x - radius * cos, SPRING + radius * sin, -WALL + 0.07 * across)
        },
        soup,
    );
}

/// Groin vaults, the wall behind with its pilasters, and the walls at both ends.
fn plaster() -> Vec<Corners> {
    let mut soup = Vec::new();
    let rise = |offset: f32| (BAY * BAY / 4.0 - offset * offset).max(0.0).sqrt();
    for k in 0..BAYS {
        sheet(
            32,
            32,
            |s| {
                // Denser towards the edges, where it is steep.
                let [x, z] = [s.x, s.y].map(|t| -BAY / 2.0 * sin_cos(PI * t).1);
                let middle = Vec3::new((k as f32 + 0.5) * BAY, SPRING, BAY / 2.0);
                middle + Vec3::new(x, rise(x).max(rise(z)), z)
            },
            &mut soup,
        );
    }
    sheet(BAYS * 4, 8, |s| Vec3::new(LENGTH * s.x, SPRING * s.y, BAY), &mut soup);
    // The lunettes above it, under each vault.
    sheet(BAYS * 4, 2, |s| Vec3::new(LENGTH * s.x, SPRING + BAY / 2.0 * s.y, BAY), &mut soup);
    for k in 0..=BAYS {
        let foot = Vec3::new(k as f32 * BAY, 0.0, BAY);
        block(foot - Vec3::new(0.22, 0.0, 0.12), foot + Vec3::new(0.22, SPRING, 0.05), &mut soup);
        block(foot + Vec3::new(-0.27, SPRING - 0.15, -0.18), foot + Vec3::new(0.27, SPRING, 0.05), &mut soup);
    }
    for x in [0.0, LENGTH] {
        sheet(4, 4, |s| Vec3::new(x, -0.4 + (TOP + 0.4) * s.y, -COURT + (COURT + BAY) * s.x), &mut soup);
    }
    soup
}

/// The wall across the court: blind arches between pilasters.
fn wall_across() -> Vec<Corners> {
    let mut soup = Vec::new();
    let depth = |s: Vec2| {
        let x = (s.x * BAYS as f32).fract() - 0.5;
        let y = s.y * TOP / BAY - 0.95;
        let inside = 0.34 - if y > 0.0 { Vec2::new(x, y).length() } else { x.abs() };
        let pilaster = if x.abs() > 0.44 { 0.15 } else { 0.0 };
        pilaster - 0.3 * (inside * 20.0).clamp(0.0, 1.0)
    };
    sheet(160, 32, |s| Vec3::new(LENGTH * s.x, -0.4 + (TOP + 0.4) * s.y, -COURT + depth(s)), &mut soup);
    soup
}

/// Flags of two colours under the arcade, by colour; the step to the court is light.
fn paving() -> [Vec<Corners>; 2] {
    let mut soups = [Vec::new(), Vec::new()];
    let (along, across) = (BAYS * 5, 6);
    let (edge, width) = (LENGTH / along as f32, (BAY + WALL + 0.3) / across as f32);
    for x in 0..along {
        for z in 0..across {
            let low = Vec2::new(x as f32 * edge, z as f32 * width - WALL - 0.3);
            sheet(
                1,
                1,
                |s| Vec3::new(low.x + edge * s.y, 0.0, low.y + width * s.x),
                &mut soups[((x + z) % 2) as usize],
            );
        }
    }
    block(Vec3::new(0.0, -0.4, -WALL - 0.75), Vec3::new(LENGTH, -0.15, -WALL - 0.3), &mut soups[0]);
    sheet(1, 1, |s| Vec3::new(LENGTH * s.x, -0.15 + 0.15 * s.y, -WALL - 0.3), &mut soups[0]);
    soups
}

/// The uneven ground of the court.
fn grass() -> Vec<Corners> {
    let mut soup = Vec::new();
    let height = |s: Vec2| 0.03 * sin_cos(s.x * 71.0 + 3.0 * s.y).0 * sin_cos(s.y * 43.0 + 5.0 * s.x).0;
    sheet(
        80,
        48,
        |s| Vec3::new(LENGTH * s.x, -0.33 + height(s), -COURT - 0.3 + (COURT + 0.3 - WALL - 0.7) * s.y),
        &mut soup,
    );
    soup
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::own;

    #[test]
    fn it_is_as_large_as_said() {
        let count = model().triangles();
        assert!((60_000..=70_000).contains(&count), "{count}");
    }

    #[test]
    fn both_files_give_one_picture() {
        own::both_files_give_one_picture(&model());
    }
}
