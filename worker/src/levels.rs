//! The sealed records of a frame: of each level those of irradiance, and of the first those of radiance by their order.

use std::collections::BTreeMap;
use std::f32::consts::FRAC_1_PI;
use std::sync::Arc;

use cache_core::details::Details;
use cache_core::id::Digest;
use cache_core::radiance::{self, Coefficients};
use cache_core::sealed::{Contribution, Counting};
use cache_core::shrink::Share;
use cache_core::{Irradiance, Query, Radiance, Record, RecordId, Sealed, of_order};
use glam::Vec3;
use smallvec::SmallVec;

use crate::lobes::{Reflection, Served};
use crate::math::luminance;
use crate::scene::Rgb;

/// Every level; `[0]` is level 1. Cheap to clone.
pub type Levels = Vec<Level>;

/// One level.
#[derive(Clone)]
pub struct Level {
    a: f32,
    details: Details,
    /// Diffuse light.
    pub irradiance: Arc<Sealed<Irradiance>>,
    /// Light for glossy surfaces, by the order of the records.
    radiance: BTreeMap<usize, Arc<dyn Glossy>>,
}

/// What records say a surface reflects.
#[derive(Clone, Copy, Debug, Default)]
pub struct Reflected {
    /// Outgoing radiance, W/(sr m²).
    pub radiance: Rgb,
    /// Irradiance, W/m².
    pub irradiance: Rgb,
    /// How many records answered.
    pub records: u32,
    /// Standard error of the radiance for the records' noise, root mean square over the channels, W/(sr m²).
    pub noise: f32,
}

/// A record as it counts in its level: what a splat is made of.
pub struct CountingRecord<'r> {
    /// Identity.
    pub id: RecordId,
    /// Site, world.
    pub position: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// How it counts.
    pub counting: Counting,
    /// (xx, xy, yy) of M, 1/m².
    pub ellipse: [f32; 3],
    /// Standard error of its value.
    pub noise: f32,
    /// E, ∇_t E and ∇_r E channel by channel; or Λ, ∂Λ/∂x and ∂Λ/∂y, each channel by channel.
    pub values: &'r [f32],
}

/// Values of a record of irradiance.
pub const IRRADIANCE_VALUES: usize = 15;

impl Level {
    /// An empty one whose records will count with the allowed error `a`.
    pub fn new(a: f32, details: Details) -> Self {
        let irradiance = Arc::new(Sealed::with(a, details));
        Self { a, details, irradiance, radiance: BTreeMap::new() }
    }

    /// Adds records of all kinds, and proposals that records shrink.
    pub fn unite<'r>(&mut self, new: impl IntoIterator<Item = &'r Record>) {
        let new: Vec<_> = new.into_iter().collect();
        if new.is_empty() {
            return;
        }
        for record in &new {
            let Record::Radiance(record) = record else { continue };
            if !self.radiance.contains_key(&record.order())
                && let Some(mut set) = empty(record.order(), self.a, self.details)
            {
                // What was proposed so far may be of records that come only now.
                let proposed: Vec<_> = self.irradiance.proposals().map(Record::from).collect();
                Arc::get_mut(&mut set).expect("new").unite(&proposed.iter().collect::<Vec<_>>());
                self.radiance.insert(record.order(), set);
            }
        }
        Arc::make_mut(&mut self.irradiance).unite(new.iter().copied());
        for set in self.radiance.values_mut() {
            if Arc::get_mut(set).is_none() {
                *set = set.copied();
            }
            if let Some(set) = Arc::get_mut(set) {
                set.unite(&new);
            }
        }
    }

    /// What a surface reflects by the records that serve it; `None` where none covers the query.
    #[inline]
    pub fn ask(&self, query: &Query, served: &Served) -> Option<Reflected> {
        match served {
            Served::Diffuse(albedo) => self.irradiance.ask(query).map(|answer| Reflected {
                radiance: *albedo * answer.irradiance * FRAC_1_PI,
                irradiance: answer.irradiance,
                records: answer.records,
                noise: answer.noise * albedo.length() * (FRAC_1_PI / 3f32.sqrt()),
            }),
            Served::Gloss(order, reflection) => self.radiance.get(order)?.ask(query, reflection),
        }
    }

    /// Whether any of these records counts at a query.
    pub fn covers(&self, query: &Query, served: &Served) -> bool {
        match served {
            Served::Diffuse(_) => self.irradiance.covers(query),
            Served::Gloss(order, _) => self.radiance.get(order).is_some_and(|set| set.covers(query)),
        }
    }

    /// What each record that counts at a query brings to what is reflected there.
    pub fn shares(&self, query: &Query, served: &Served) -> SmallVec<[Share; 8]> {
        match served {
            Served::Diffuse(albedo) => {
                let reflected = *albedo * FRAC_1_PI;
                let share = |c: &Contribution<Irradiance>| Share {
                    id: c.record.id,
                    weight: c.weight,
                    luminance: luminance(reflected * c.answer.irradiance),
                    noise: luminance(reflected) * c.record.noise,
                    error: c.error,
                    a_min: c.a_min,
                };
                self.irradiance.contributions(query).iter().map(share).collect()
            }
            Served::Gloss(order, reflection) => {
                self.radiance.get(order).map_or_else(SmallVec::new, |set| set.shares(query, reflection))
            }
        }
    }

    /// The allowed error a record made at a query should begin with.
    pub fn first_a(&self, query: &Query, served: &Served) -> f32 {
        match served {
            Served::Diffuse(_) => self.irradiance.first_a(query),
            Served::Gloss(order, _) => self.radiance.get(order).map_or(self.a, |set| set.first_a(query)),
        }
    }

    /// Orders of its records of radiance.
    pub fn orders(&self) -> impl Iterator<Item = usize> {
        self.radiance.keys().copied()
    }

    /// Tells of every record of irradiance, or of radiance of an order, in the order of sums.
    pub fn counting(&self, order: Option<usize>, tell: &mut dyn FnMut(CountingRecord)) {
        match order {
            None => {
                for (r, counting) in self.irradiance.counting() {
                    let mut values = [0.0; IRRADIANCE_VALUES];
                    let pairs = r.gradient_t.iter().chain(&r.gradient_r).flat_map(|pair| pair.to_array());
                    values.iter_mut().zip(r.irradiance.to_array().into_iter().chain(pairs)).for_each(|(to, v)| *to = v);
                    let (id, position, normal, ellipse, noise) = (r.id, r.position, r.normal, r.ellipse, r.noise);
                    tell(CountingRecord { id, position, normal, counting, ellipse, noise, values: &values });
                }
            }
            Some(order) => {
                if let Some(set) = self.radiance.get(&order) {
                    set.counting(tell);
                }
            }
        }
    }

    /// Records of all kinds.
    pub fn len(&self) -> usize {
        self.irradiance.len() + self.radiance.values().map(|set| set.len()).sum::<usize>()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Digest of what gathers of the level above read.
    pub fn digest(&self) -> Digest {
        self.irradiance.digest()
    }
}

/// Sealed records of radiance, of whatever order.
trait Glossy: Send + Sync {
    /// Adds records of its order, and proposals that records shrink.
    fn unite(&mut self, new: &[&Record]);
    /// The same set again.
    fn copied(&self) -> Arc<dyn Glossy>;
    /// Tells of every record.
    fn counting(&self, tell: &mut dyn FnMut(CountingRecord));
    /// How many records.
    fn len(&self) -> usize;
    /// Whether any record counts at a query.
    fn covers(&self, query: &Query) -> bool;
    /// The allowed error a record made at a query should begin with.
    fn first_a(&self, query: &Query) -> f32;
    /// What is reflected at a query.
    fn ask(&self, query: &Query, reflection: &Reflection) -> Option<Reflected>;
    /// What each record that counts at a query brings to that.
    fn shares(&self, query: &Query, reflection: &Reflection) -> SmallVec<[Share; 8]>;
}

impl<const N: usize> Glossy for Sealed<Radiance<N>> {
    fn unite(&mut self, new: &[&Record]) {
        self.unite(new.iter().copied());
    }

    fn copied(&self) -> Arc<dyn Glossy> {
        Arc::new(self.clone())
    }

    fn counting(&self, tell: &mut dyn FnMut(CountingRecord)) {
        let mut values = Vec::with_capacity(9 * N);
        for (r, counting) in self.counting() {
            values.clear();
            values.extend_from_slice(r.coefficients.as_flattened());
            values.extend_from_slice(r.gradient.as_flattened().as_flattened());
            let (id, position, normal, ellipse, noise) = (r.id, r.position, r.normal, r.ellipse, r.noise);
            tell(CountingRecord { id, position, normal, counting, ellipse, noise, values: &values });
        }
    }

    fn len(&self) -> usize {
        self.len()
    }

    fn covers(&self, query: &Query) -> bool {
        self.covers(query)
    }

    fn first_a(&self, query: &Query) -> f32 {
        self.first_a(query)
    }

    fn ask(&self, query: &Query, reflection: &Reflection) -> Option<Reflected> {
        self.ask(query).map(|answer| reflected(&answer, &reflection.coefficients()))
    }

    fn shares(&self, query: &Query, reflection: &Reflection) -> SmallVec<[Share; 8]> {
        let lobe = reflection.coefficients::<N>();
        let gain = radiance::gain(&lobe);
        let share = |c: &Contribution<Radiance<N>>| Share {
            id: c.record.id,
            weight: c.weight,
            luminance: luminance(radiance::reflected(&lobe, &c.answer.coefficients)),
            noise: gain * c.record.noise,
            error: c.error,
            a_min: c.a_min,
        };
        self.contributions(query).iter().map(share).collect()
    }
}

fn empty(order: usize, a: f32, details: Details) -> Option<Arc<dyn Glossy>> {
    of_order!(order, N => Arc::new(Sealed::<Radiance<N>>::with(a, details)))
}

fn reflected<const N: usize>(answer: &radiance::Answer<N>, lobe: &Coefficients<N>) -> Reflected {
    Reflected {
        // A sum that rings may be negative.
        radiance: radiance::reflected(lobe, &answer.coefficients).max(Rgb::ZERO),
        irradiance: radiance::irradiance(&answer.coefficients).max(Rgb::ZERO),
        records: answer.records,
        noise: radiance::gain(lobe) * answer.noise,
    }
}

#[cfg(test)]
mod tests {
    use cache_core::Shrink;

    use super::*;
    use crate::bsdf::Bsdf;
    use crate::lobes::Lobes;
    use crate::scene::{Material, Surface};
    use crate::settings::Method;

    fn record(id: u128, irradiance: bool) -> Record {
        let (position, normal) = (Vec3::ZERO, Vec3::Z);
        let (radius, radius_min, radius_max) = (1.0, 0.01, 2.0);
        let (id, ellipse, noise) = (RecordId(id), [0.0; 3], 0.0);
        if irradiance {
            let gradient = Default::default();
            let (irradiance, gradient_t, gradient_r) = (Vec3::ONE, gradient, gradient);
            return Irradiance {
                id,
                position,
                normal,
                radius,
                radius_min,
                radius_max,
                irradiance,
                gradient_t,
                gradient_r,
                ellipse,
                noise,
            }
            .into();
        }
        let (coefficients, gradient) = ([[0.5; 16]; 3], [[[0.0; 16]; 3]; 2]);
        Radiance { id, position, normal, radius, radius_min, radius_max, ellipse, noise, coefficients, gradient }.into()
    }

    /// In whatever order records of both kinds and proposals for them come.
    #[test]
    fn proposals_shrink_records_of_both_kinds_whenever_they_come() {
        let surface = Surface::Metal { specular: 1.0, roughness: 0.3 };
        let metal = Material { surface, ..Material::diffuse(Rgb::ONE) };
        let bsdf = Bsdf::new(&metal, Rgb::ONE);
        let lobes = Lobes::new(&[metal], Method::Radiance, Some(4));
        let gloss = lobes.serve(0, &bsdf, Vec3::Z, 1).expect("it glosses");
        let diffuse = Served::Diffuse(Rgb::ONE);
        let at = Query::new(Vec3::X * 0.4, Vec3::Z);
        let covered = |records: &[Record]| {
            let mut level = Level::new(0.5, Details::default());
            records.iter().for_each(|record| level.unite([record]));
            [&diffuse, &gloss].map(|served| level.covers(&at, served))
        };
        let [flat, round] = [record(1, true), record(2, false)];
        let less = [1, 2].map(|id| Record::from(Shrink::new(RecordId(id), 0.2)));
        assert_eq!(covered(&[flat.clone(), round.clone()]), [true, true]);
        assert_eq!(covered(&[flat.clone(), round.clone(), less[1].clone()]), [true, false]);
        let [one, two] = less;
        assert_eq!(covered(&[one.clone(), two.clone(), flat.clone(), round.clone()]), [false, false]);
        assert_eq!(covered(&[flat, one, two, round]), [false, false]);
    }
}
