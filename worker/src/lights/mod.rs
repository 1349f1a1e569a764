//! Where light comes from, and how shadow rays find it: one light per request, chosen by what it may give there
//! (`tree`).
//!
//! Light is *sampled* (shadow rays look for it; rays that meet it by chance count only by multiple importance sampling)
//! or *gathered* (only rays that meet it by chance count; a record of irradiance includes it). Which one makes no
//! difference to a converged picture: small bright lights are found by looking, broad dim ones by chance.

#[cfg(test)]
mod tests;
mod tree;

use std::f32::consts::PI;

use glam::Vec3;

use crate::math::{Frame, luminance, sin_cos};
use crate::scene::{DistantLight, PointLight, Rgb};
use crate::spherical::SphericalTriangle;
use crate::world::{World, facet};

pub use tree::Place;
use tree::{Lamp, LightTree, Shines};

/// A material whose light covers at least this much of all surface is gathered by methods that gather: a gather's rays
/// meet it often, and shadow rays to so broad a light would be noisy.
const BROAD: f32 = 0.125;

/// A distant light at least this broad (cosine of its half angle) is gathered.
const BROAD_COSINE: f32 = 0.9;

/// What shadow rays can ask.
pub struct Lights {
    /// Those of the tree, in its order, then those infinitely far away.
    lights: Vec<Light>,
    tree: LightTree,
    /// For every triangle its light, or `NONE`.
    of_triangle: Vec<u32>,
    /// For every distant light its light, or `NONE`.
    of_distant: Vec<u32>,
    /// Whether any light is left for rays to meet by chance alone.
    gathered: bool,
}

const NONE: u32 = u32::MAX;

#[derive(Clone, Copy)]
enum Light {
    Triangle { index: u32, area: f32, normal: Vec3, emission: Rgb },
    Point(PointLight),
    Distant(DistantLight),
}

/// Light from one direction.
#[derive(Clone, Copy, Debug)]
pub struct Arrival {
    /// Unit direction towards the light.
    pub direction: Vec3,
    /// Where the shadow ray ends; `None`: never.
    pub end: Option<Vec3>,
    /// Radiance over density; for light without extent its irradiance on a facing surface over the chance of choosing it.
    pub weight: Rgb,
    /// Density by solid angle, 1/sr; `None` for light without extent, which no other ray can meet.
    pub pdf: Option<f32>,
}

impl Lights {
    /// Lists the lights of a scene. With `gather_broad`, broad ones are left to gathers; without, all are sampled.
    pub fn new(world: &World, gather_broad: bool) -> Self {
        let scene = &world.scene;
        let sampled = sampled_materials(world, gather_broad);
        let (mut near, mut lamps, mut far) = (Vec::new(), Vec::new(), Vec::new());
        let (mut of_triangle, mut of_distant) = (vec![NONE; scene.triangles.len()], vec![NONE; scene.distant.len()]);
        let mut gathered = false;
        for (i, triangle) in scene.triangles.iter().enumerate() {
            let emission = scene.materials[triangle.material as usize].emission;
            let area = area(&triangle.positions);
            let power = luminance(emission) * area;
            if power > 0.0 && sampled[triangle.material as usize] {
                let normal = facet(triangle);
                let middle = triangle.positions.into_iter().sum::<Vec3>() * (1.0 / 3.0);
                let radius = triangle.positions.iter().map(|p| p.distance(middle)).fold(0.0, f32::max);
                near.push(Light::Triangle { index: i as u32, area, normal, emission });
                lamps.push(Lamp { middle, radius, power, area, shines: Shines::Front(normal) });
            } else if power > 0.0 {
                gathered = true;
            }
        }
        for point in &scene.points {
            let shines = point.spot.map_or(Shines::Round, Shines::Cone);
            let power = luminance(point.intensity);
            near.push(Light::Point(*point));
            lamps.push(Lamp { middle: point.position, radius: 0.0, power, area: 0.0, shines });
        }
        let (tree, order) = LightTree::new(&lamps);
        let mut lights: Vec<_> = order.iter().map(|&i| near[i as usize]).collect();
        for (at, light) in lights.iter().enumerate() {
            if let Light::Triangle { index, .. } = light {
                of_triangle[*index as usize] = at as u32;
            }
        }
        for (i, distant) in scene.distant.iter().enumerate() {
            let broad = distant.cos_half_angle < BROAD_COSINE;
            if !distant.is_beam() && gather_broad && broad {
                gathered = true;
            } else {
                if !distant.is_beam() {
                    of_distant[i] = (lights.len() + far.len()) as u32;
                }
                far.push(Light::Distant(*distant));
            }
        }
        lights.append(&mut far);
        Self { lights, tree, of_triangle, of_distant, gathered }
    }

    /// Whether rays can meet light that no shadow ray looks for.
    pub fn any_gathered(&self) -> bool {
        self.gathered
    }

    /// Whether there is any light for shadow rays to look for.
    pub fn any_sampled(&self) -> bool {
        !self.lights.is_empty()
    }

    /// Whether shadow rays look for the light of a triangle.
    pub fn samples_triangle(&self, triangle: u32) -> bool {
        self.of_triangle[triangle as usize] != NONE
    }

    /// Chooses a light by `u` in [0, 1), and tells the chance it had; `None` when none shines there.
    fn choose(&self, place: &Place, u: f32) -> Option<(usize, f32)> {
        let (near, total) = self.totals(place);
        let share = near / total;
        if u < share {
            return self.tree.choose(place, u / share).map(|(light, chance)| (light, chance * share));
        }
        let mut rest = u * total - near;
        let mut choice = None;
        for (at, light) in self.far() {
            let share = far_share(light, place);
            if share > 0.0 {
                choice = Some((at, share / total));
                rest -= share;
                if rest < 0.0 {
                    break;
                }
            }
        }
        choice
    }

    /// The chance of choosing a light.
    fn chance(&self, place: &Place, light: u32) -> f32 {
        let (near, total) = self.totals(place);
        let at = light as usize;
        if total <= 0.0 {
            0.0
        } else if at < self.tree.len() {
            self.tree.chance(place, at) * (near / total)
        } else {
            far_share(&self.lights[at], place) / total
        }
    }

    /// Roughly the irradiance the tree's lights, and all, would give, unhidden.
    fn totals(&self, place: &Place) -> (f32, f32) {
        let near = self.tree.total(place);
        (near, self.far().fold(near, |sum, (_, light)| sum + far_share(light, place)))
    }

    fn far(&self) -> impl Iterator<Item = (usize, &Light)> {
        self.lights.iter().enumerate().skip(self.tree.len())
    }

    /// Density, by solid angle, of looking from a place for the light of a triangle, where a ray from there along
    /// `direction` met it at `distance`; 0 for light that is not sampled.
    pub fn pdf_triangle(&self, world: &World, triangle: u32, place: &Place, direction: Vec3, distance: f32) -> f32 {
        let light = self.of_triangle[triangle as usize];
        if light == NONE {
            return 0.0;
        }
        let Light::Triangle { area, normal, .. } = self.lights[light as usize] else { return 0.0 };
        let density = match SphericalTriangle::near(place.position, &world.scene.triangles[triangle as usize].positions)
        {
            Some(near) => 1.0 / near.solid_angle,
            None => distance * distance / (area * normal.dot(direction).abs()),
        };
        // Seen along its plane the density has no bound, and no bound times no chance is no number.
        let chance = self.chance(place, light);
        if chance > 0.0 { chance * density } else { 0.0 }
    }

    /// What a ray that meets nothing sees: the radiance of each distant light in that direction, and its number where
    /// shadow rays look for it.
    pub fn beyond<'a>(&'a self, world: &'a World, direction: Vec3) -> impl Iterator<Item = (Rgb, Option<u32>)> + 'a {
        let seen = move |d: &DistantLight| !d.is_beam() && direction.dot(d.to_light) >= d.cos_half_angle;
        let sampled = |light: u32| (light != NONE).then_some(light);
        let all = world.scene.distant.iter().zip(&self.of_distant);
        all.filter(move |(d, _)| seen(d)).map(move |(d, &light)| (d.strength, sampled(light)))
    }

    /// Density, by solid angle, of looking from a place for the light of this number, one of those of [`Self::beyond`].
    pub fn pdf_distant(&self, place: &Place, light: u32) -> f32 {
        let Light::Distant(distant) = self.lights[light as usize] else { return 0.0 };
        self.chance(place, light) / (2.0 * PI * (1.0 - distant.cos_half_angle))
    }

    /// Chooses a light and a point on it by `u` in [0, 1)³, as seen from a place; `None` when it does not shine there.
    pub fn sample(&self, world: &World, place: &Place, u: [f32; 3]) -> Option<Arrival> {
        let from = place.position;
        let (choice, chance) = self.choose(place, u[0])?;
        match self.lights[choice] {
            Light::Triangle { index, area, normal, emission } => {
                let corners = &world.scene.triangles[index as usize].positions;
                let (end, density) = point_on(corners, normal, area, from, [u[1], u[2]])?;
                // All but in the lamp's own plane the point may be the place itself.
                let (pdf, direction) = (chance * density, (end - from).try_normalize()?);
                let end = world.off_front(index, end);
                (pdf > 0.0 && pdf.is_finite() && end.is_finite()).then(|| Arrival {
                    direction,
                    end: Some(end),
                    weight: emission / pdf,
                    pdf: Some(pdf),
                })
            }
            Light::Point(point) => {
                let offset = point.position - from;
                let (distance2, direction) = (offset.length_squared(), offset.try_normalize()?);
                let falloff = point.spot.map_or(1.0, |spot| spot.falloff(-direction.dot(spot.axis)));
                let weight = point.intensity * (falloff / (distance2 * chance));
                (falloff > 0.0).then_some(Arrival { direction, end: Some(point.position), weight, pdf: None })
            }
            Light::Distant(light) if light.is_beam() => {
                Some(Arrival { direction: light.to_light, end: None, weight: light.strength / chance, pdf: None })
            }
            Light::Distant(light) => {
                let z = 1.0 - u[1] * (1.0 - light.cos_half_angle);
                let (sin_phi, cos_phi) = sin_cos(2.0 * PI * u[2]);
                let s = (1.0 - z * z).max(0.0).sqrt();
                let direction = Frame::around(light.to_light).to_world(Vec3::new(s * cos_phi, s * sin_phi, z));
                let pdf = chance / (2.0 * PI * (1.0 - light.cos_half_angle));
                Some(Arrival { direction, end: None, weight: light.strength / pdf, pdf: Some(pdf) })
            }
        }
    }
}

/// Roughly the irradiance a light infinitely far away gives, unhidden; 0 only if it gives none.
fn far_share(light: &Light, place: &Place) -> f32 {
    let Light::Distant(light) = light else { return 0.0 };
    let cosine = light.to_light.dot(place.normal);
    match light.is_beam() {
        true => luminance(light.strength) * cosine.max(0.0),
        // Some of its disc may rise above the horizon.
        false => luminance(light.strength) * 2.0 * PI * (1.0 - light.cos_half_angle) * cosine.max(0.05),
    }
}

/// A point on a lamp and its density by solid angle, as seen from its front side; `None` from behind.
fn point_on(corners: &[Vec3; 3], normal: Vec3, area: f32, from: Vec3, [u, v]: [f32; 2]) -> Option<(Vec3, f32)> {
    let height = normal.dot(corners[0] - from);
    if height >= 0.0 {
        return None;
    }
    if let Some(near) = SphericalTriangle::near(from, corners) {
        let direction = near.sample(u, v);
        return Some((from + direction * (height / normal.dot(direction)), 1.0 / near.solid_angle));
    }
    let s = u.sqrt();
    let end = corners[0] * (1.0 - s) + corners[1] * (s * (1.0 - v)) + corners[2] * (s * v);
    let offset = end - from;
    let cosine = -normal.dot(offset) / offset.length();
    Some((end, offset.length_squared() / (area * cosine)))
}

/// Which materials' light shadow rays look for.
fn sampled_materials(world: &World, gather_broad: bool) -> Vec<bool> {
    let scene = &world.scene;
    if !gather_broad {
        return vec![true; scene.materials.len()];
    }
    let mut areas = vec![0f64; scene.materials.len()];
    for triangle in &scene.triangles {
        areas[triangle.material as usize] += f64::from(area(&triangle.positions));
    }
    let total: f64 = areas.iter().sum();
    let broad = |area: f64| area >= f64::from(BROAD) * total;
    areas.into_iter().map(|area| !broad(area)).collect()
}

fn area(corners: &[Vec3; 3]) -> f32 {
    (corners[1] - corners[0]).cross(corners[2] - corners[0]).length() * 0.5
}
