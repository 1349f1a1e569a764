//! Where records make visible steps in the picture, and how far they should shrink for that (Krivanek 2006, 4).
//!
//! Every shading point is tested against the cache as sealed before the round. What is proposed for a record in one tile
//! is one proposal, the least: tiles are the same whoever does them.

use cache_core::shrink::exclude;
use cache_core::{RecordId, Shrink};
use std::collections::BTreeMap;

use crate::frame::Counts;
use crate::gather::Site;
use crate::levels::Level;
use crate::lobes::Served;
use crate::math::luminance;
use crate::trace::Tracer;

/// What a tile proposes: for each record the least a_i.
#[derive(Default)]
pub struct Proposals(BTreeMap<RecordId, f32>);

impl Proposals {
    /// Tests a shading point; false where no record covers it.
    pub fn test(&mut self, tracer: &Tracer, site: &Site, own: &Level, served: &Served, counts: &mut Counts) -> bool {
        let shares = own.shares(&site.query(), served);
        if shares.len() < 2 {
            return !shares.is_empty();
        }
        let Some(bsdf) = tracer.world.bsdf(&site.at) else { return true };
        exclude(shares, || luminance(tracer.direct(site, &bsdf, counts)), |shrink| self.add(shrink));
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
