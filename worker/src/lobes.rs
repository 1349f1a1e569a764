//! The gloss of materials as records of radiance see it: lobes in hemispherical harmonics (Krivanek et al. 2005, 4.1).
//!
//! A material's gloss is a sum of colours times lobes that depend on its roughness alone ([`Shape`](crate::bsdf::Shape)); colours may come from
//! textures. What the least order that suffices misses decides whether records serve it at all; where the camera looks along
//! the surface lobes are sharper, and single samples go without.

use std::collections::HashMap;
use std::f32::consts::FRAC_1_PI;
use std::sync::Arc;

use cache_core::hsh::COEFFICIENTS_MAX;
use cache_core::hsh::lobe::Lobe;
use cache_core::radiance::{Coefficients, ORDERS};
use glam::Vec3;
use smallvec::SmallVec;

use crate::bsdf::Bsdf;
use crate::scene::{Material, Rgb};
use crate::settings::Method;

/// Of the energy a surface reflects, what records may miss.
const MISSED: f32 = 0.1;

/// Cosine of the outgoing direction a material's order is chosen for.
const VIEWED: f32 = 0.3;

/// ∫ (cos θ / π)² dω.
const DIFFUSE_ENERGY: f32 = 2.0 / 3.0 * FRAC_1_PI;

/// The lobes of every material that records of radiance serve.
pub struct Lobes {
    materials: Vec<Option<Suited>>,
    /// Whether samples go without records where these miss too much.
    strict: bool,
}

/// Which records serve a surface seen from somewhere, and what it does with their light.
pub enum Served<'a> {
    /// Records of irradiance: a diffuse part of this albedo.
    Diffuse(Rgb),
    /// Records of radiance of this order: all that it reflects.
    Gloss(usize, Reflection<'a>),
}

/// A material that records of radiance serve.
struct Suited {
    /// Of which order its records are.
    order: usize,
    /// One for each summand of its gloss.
    lobes: SmallVec<[Arc<Lobe>; 3]>,
}

impl Lobes {
    /// Those of a scene's materials under a method. `order`: of all that gloss, whatever they need.
    pub fn new(materials: &[Material], method: Method, order: Option<usize>) -> Self {
        let mut known = HashMap::new();
        let mut served = |material: &Material| {
            let bsdf = Bsdf::new(material, material.color);
            let shapes = bsdf.lobes();
            if !material.cached || shapes.is_empty() {
                return None;
            }
            let lobes = shapes.iter().map(|(shape, _)| {
                let lobe = || Arc::new(Lobe::new(|outgoing, incoming| shape.value(outgoing, incoming)));
                known.entry(*shape).or_insert_with(lobe).clone()
            });
            let mut served = Suited { order: ORDERS[ORDERS.len() - 1], lobes: lobes.collect() };
            let outgoing = Vec3::new((1.0 - VIEWED * VIEWED).sqrt(), 0.0, VIEWED);
            let suffices = |order: &usize| served.reflection(&bsdf, outgoing).missed(*order) <= MISSED;
            match (order.or_else(|| ORDERS.into_iter().find(suffices)), method) {
                (Some(order), _) => served.order = order,
                (None, Method::Radiance) => {}
                (None, _) => return None,
            }
            Some(served)
        };
        let wanted = matches!(method, Method::Auto | Method::Radiance);
        let materials = materials.iter().map(|material| if wanted { served(material) } else { None }).collect();
        Self { materials, strict: method == Method::Auto }
    }

    /// Which records serve a point of a surface with this material, seen from `outgoing`, local; `None`: it reflects nothing
    /// that records know. Irradiance is all that is known of deeper levels: their glossy light goes on as paths.
    #[inline]
    pub fn serve(&self, material: u32, bsdf: &Bsdf, outgoing: Vec3, level: u32) -> Option<Served<'_>> {
        if let Some(suited) = self.materials[material as usize].as_ref().filter(|_| level == 1) {
            let reflection = suited.reflection(bsdf, outgoing);
            if !self.strict || reflection.missed(suited.order) <= MISSED {
                return Some(Served::Gloss(suited.order, reflection));
            }
        }
        (bsdf.diffuse() != Rgb::ZERO).then(|| Served::Diffuse(bsdf.diffuse()))
    }
}

impl Suited {
    /// What the surface does with light on its way to `outgoing`, local.
    fn reflection<'a>(&'a self, bsdf: &Bsdf, outgoing: Vec3) -> Reflection<'a> {
        let lobes = self.lobes.iter().map(Arc::as_ref).zip(bsdf.lobes().iter().map(|(_, color)| *color)).collect();
        Reflection { flat: bsdf.flat(), lobes, outgoing }
    }
}

/// How incoming radiance in harmonics is reflected to one direction.
pub struct Reflection<'a> {
    /// Albedo of what reflects to all directions alike.
    flat: Rgb,
    lobes: SmallVec<[(&'a Lobe, Rgb); 3]>,
    outgoing: Vec3,
}

impl Served<'_> {
    /// Deviation of reflected radiance, W/(sr m²), per deviation of a record: of its irradiance, or of its coefficients.
    pub fn gain(&self) -> f32 {
        match self {
            Self::Diffuse(albedo) => albedo.element_sum() * (1.0 / 3.0) * FRAC_1_PI,
            Self::Gloss(order, reflection) => reflection.gain(*order),
        }
    }
}

impl Reflection<'_> {
    fn gain(&self, order: usize) -> f32 {
        let all = self.coefficients::<COEFFICIENTS_MAX>();
        let squares = all.iter().map(|c| c[..order * order].iter().map(|f| f * f).sum::<f32>());
        (squares.sum::<f32>() * (1.0 / 3.0)).sqrt()
    }

    /// Coefficients of the whole lobe, channel by channel, 1/√sr.
    pub fn coefficients<const N: usize>(&self) -> Coefficients<N> {
        let mut sum = [[0.0; N]; 3];
        for (lobe, color) in &self.lobes {
            let coefficients = lobe.coefficients::<N>(self.outgoing);
            for (sum, color) in sum.iter_mut().zip(color.to_array()) {
                sum.iter_mut().zip(&coefficients).for_each(|(sum, c)| *sum += color * c);
            }
        }
        for (sum, albedo) in sum.iter_mut().zip(self.flat.to_array()) {
            let [first, second] = cache_core::radiance::COSINE;
            sum[0] += albedo * FRAC_1_PI * first;
            sum[2] += albedo * FRAC_1_PI * second;
        }
        sum
    }

    /// Part of the energy of the whole lobe that an order misses.
    pub fn missed(&self, order: usize) -> f32 {
        let square = |color: Rgb| color.length_squared() * (1.0 / 3.0);
        let (mut energy, mut missed) = (square(self.flat) * DIFFUSE_ENERGY, 0.0);
        for (lobe, color) in &self.lobes {
            let (own, lost) = lobe.energy(self.outgoing.z, order);
            energy += square(*color) * own;
            missed += square(*color) * lost;
        }
        if energy > 0.0 { missed / energy } else { 0.0 }
    }
}
