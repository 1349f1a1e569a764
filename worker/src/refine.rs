//! Where records make visible steps in the picture, and how far they should shrink for that (Krivanek 2006, 4).
//!
//! Every shading point is tested against the cache as sealed before the round. What is proposed for a record in one tile
//! is one proposal, the least: tiles are the same whoever does them.

use std::collections::BTreeMap;
use std::f32::consts::FRAC_1_PI;

use cache_core::sealed::Contribution;
use cache_core::shrink::{Share, exclude};
use cache_core::{Irradiance, RecordId, Sealed, Shrink};

use crate::frame::Counts;
use crate::gather::Site;
use crate::scene::Rgb;
use crate::trace::Tracer;

/// What a tile proposes: for each record the least a_i.
#[derive(Default)]
pub struct Proposals(BTreeMap<RecordId, f32>);

impl Proposals {
    /// Tests a shading point; false where no record covers it.
    pub fn test(&mut self, tracer: &Tracer<'_>, site: &Site, sealed: &Sealed<Irradiance>, counts: &mut Counts) -> bool {
        let near = sealed.contributions(&site.query());
        if near.len() < 2 {
            return !near.is_empty();
        }
        let Some(bsdf) = tracer.world.bsdf(&site.at) else { return true };
        let reflected = bsdf.diffuse() * FRAC_1_PI;
        let share = |c: &Contribution<Irradiance>| Share {
            id: c.record.id,
            weight: c.weight,
            luminance: luminance(reflected * c.answer.irradiance),
            noise: luminance(reflected) * c.record.noise,
            error: c.error,
            a_min: c.a_min,
        };
        exclude(near.iter().map(share), || luminance(tracer.direct(site, &bsdf, counts)), |shrink| self.add(shrink));
        true
    }

    /// What a new record begins with, where that is less than the global `a`.
    pub fn begin(&mut self, id: RecordId, first: f32, a: f32) {
        if first < a {
            self.add(Shrink::new(id, first));
        }
    }

    fn add(&mut self, Shrink { of, a, .. }: Shrink) {
        self.0.entry(of).and_modify(|least| *least = least.min(a)).or_insert(a);
    }

    /// All of them, in order of the records' ids.
    pub fn take(self) -> impl Iterator<Item = Shrink> {
        self.0.into_iter().map(|(of, a)| Shrink::new(of, a))
    }
}

/// Luminance of linear RGB with the primaries of Rec. 709.
fn luminance(light: Rgb) -> f32 {
    light.dot(Rgb::new(0.2126, 0.7152, 0.0722))
}
