//! What surfaces send out, computed once by the renderer's own code and kept on their triangles: every gather that is compared
//! then looks at the same light, and pays the same for it.

use cache_core::id::Random;
use glam::Vec3;
use rayon::prelude::*;
use worker::frame::Counts;
use worker::lights::Lights;
use worker::lobes::Lobes;
use worker::sampler::Sampler;
use worker::scene::Rgb;
use worker::settings::Settings;
use worker::trace::{Chance, Tracer};
use worker::world::{World, facet};

/// Cells there are at most, of all triangles.
const CELLS_MAX: usize = 2_000_000;

/// Cells of a triangle's edge at most.
const EDGE_MAX: usize = 64;

/// Radiance by triangle and cell; half of each square of cells is unused. Both sides shine alike.
pub struct Glow {
    /// Cells of a triangle's edge.
    pub cells: u32,
    /// Triangle by triangle, row by row; the fourth number is 0.
    pub radiance: Vec<[f32; 4]>,
}

impl Glow {
    /// Every triangle with a radiance of its own.
    pub fn of(radiance: impl Iterator<Item = Rgb>) -> Self {
        Self { cells: 1, radiance: radiance.map(|c| c.extend(0.0).to_array()).collect() }
    }

    /// Light that leaves the fronts of a scene as gathers meet it, to as many bounces as `settings` ask for, by `paths` paths a cell.
    pub fn traced(world: &World, settings: &Settings, paths: u32) -> Self {
        let scene = &world.scene;
        let per_triangle = CELLS_MAX / scene.triangles.len().max(1);
        let cells = per_triangle.isqrt().clamp(1, EDGE_MAX) as u32;
        let cell = |tracer: &Tracer, index: u32| {
            let triangle = index / (cells * cells);
            let [row, column] = [index / cells % cells, index % cells];
            if row + column >= cells {
                return [0.0; 4];
            }
            let [a, b, c] = scene.triangles[triangle as usize].positions;
            // Within the triangle in the outermost cells too.
            let [u, v] = [column, row].map(|i| (i as f32 + 1.0 / 3.0) / cells as f32);
            let start = world.off_front(triangle, a + (b - a) * u + (c - a) * v);
            let ray = (start, -facet(&scene.triangles[triangle as usize]));
            let mut sampler = Sampler::Stream(Random::named("glow", &[index.into()]));
            let mut counts = Counts::default();
            let mut see = |_| tracer.see(ray, 2, Chance::Gathered, &mut sampler, &mut counts).total();
            let sum: Rgb = (0..paths).map(&mut see).sum();
            (sum / paths as f32).extend(0.0).to_array()
        };
        let all = scene.triangles.len() as u32 * cells * cells;
        let radiance =
            with_tracer(world, settings, |tracer| (0..all).into_par_iter().map(|index| cell(tracer, index)).collect());
        Self { cells, radiance }
    }

    /// Radiance, W/(sr m²), of a triangle where its second and third corner have these weights.
    pub fn at(&self, triangle: u32, uv: [f32; 2]) -> Rgb {
        let [column, row] = uv.map(|w| ((w.max(0.0) * self.cells as f32) as u32).min(self.cells - 1));
        Vec3::from_slice(&self.radiance[((triangle * self.cells + row) * self.cells + column) as usize])
    }
}

/// Lends what gathers trace their rays with when there are no records yet.
pub fn with_tracer<R>(world: &World, settings: &Settings, with: impl FnOnce(&Tracer) -> R) -> R {
    let (lights, levels) = (Lights::new(world, true), Vec::new());
    let lobes = Lobes::new(&world.scene.materials, settings.method, None);
    let (bounces, lobes, lights, levels) = (settings.bounces, &lobes, &lights, &levels);
    with(&Tracer { world, lights, lobes, levels, bounces, cached: true, looks: 1, regather: None })
}
