//! A set of records nothing more will be added to in this round, ready to be asked.
//!
//! Everything here is derived from the records and `a` alone: two replicas with the same set answer with the same bits,
//! whatever order the records came in. Asking never writes.

use smallvec::SmallVec;

use crate::cached::{Cached, Query};
use crate::clamp::Clamp;
use crate::details::Details;
use crate::id::{Digest, RecordId};
use crate::octree::Octree;

/// Records of one level, clamped and filed.
#[derive(Clone, Debug)]
pub struct Sealed<C> {
    a: f32,
    details: Details,
    records: Vec<C>,
    derived: Vec<Derived>,
    octree: Octree,
    digest: Digest,
}

/// What follows from a record and its neighbours.
#[derive(Clone, Copy, Debug)]
struct Derived {
    /// R*: raw R clamped by the neighbours' raw R.
    clamped: f32,
    /// R the record counts with: R* within the record's bounds.
    radius: f32,
    /// How much of the gradients holds out to `radius`: R* / R where the lower bound stretched it, else 1.
    limit: f32,
}

impl Derived {
    fn new<C: Cached>(record: &C, clamped: f32, details: &Details) -> Self {
        let (min, max) = record.radius_bounds();
        let radius = clamped.min(max).max(min);
        let limit = if details.gradient_by_radius { (clamped / radius).min(1.0) } else { 1.0 };
        Self { clamped, radius, limit }
    }
}

impl<C: Cached> Sealed<C> {
    /// An empty set whose records will count with the allowed error `a` (greater than 0).
    pub fn new(a: f32) -> Self {
        Self::with(a, Details::default())
    }

    /// The same with other details than the usual ones.
    pub fn with(a: f32, details: Details) -> Self {
        let (records, derived, octree) = (Vec::new(), Vec::new(), Octree::default());
        Self { a, details, records, derived, octree, digest: Digest::default() }
    }

    /// Opens the set, adds records that are not in it yet, and seals it again. The result depends on the united set
    /// only: extending in one step, in many, or in another order gives the same answers.
    pub fn extend(&mut self, new: impl IntoIterator<Item = C>) {
        let known = self.records.len();
        self.records.extend(new);
        if self.records.len() == known {
            return;
        }
        let clamps = |records: &[C]| {
            let records = if self.details.neighbor_clamping { records } else { &[] };
            Clamp::new(records.iter().map(|r| (r.position(), r.radius())).collect())
        };
        let (all, fresh) = (clamps(&self.records), clamps(&self.records[known..]));
        for (record, derived) in self.records.iter().zip(&mut self.derived) {
            let clamped = fresh.clamp(record.position(), derived.clamped);
            if clamped < derived.clamped {
                *derived = Derived::new(record, clamped, &self.details);
            }
        }
        for (i, record) in self.records.iter().enumerate().skip(known) {
            let (min, max) = record.radius_bounds();
            // Filed by the greatest reach the record can ever have, so that clamping never moves it.
            self.octree.insert(i as u32, record.position(), self.a * record.radius().min(max).max(min));
            let clamped = all.clamp(record.position(), record.radius());
            self.derived.push(Derived::new(record, clamped, &self.details));
            self.digest.add(record.id());
        }
    }

    /// Whether any record counts at `query`.
    pub fn covers(&self, query: &Query) -> bool {
        let mut found = false;
        self.octree.visit(query.position, |i| {
            found =
                self.records[i as usize].weight(query, self.derived[i as usize].radius, self.a, self.details.weighting)
                    > 0.0;
            !found
        });
        found
    }

    /// The weighted mean of all records that count at `query`, summed in id order; `None` where there is none.
    pub fn ask(&self, query: &Query) -> Option<C::Answer> {
        let mut near: SmallVec<[(RecordId, u32, f32); 32]> = SmallVec::new();
        self.octree.visit(query.position, |i| {
            let record = &self.records[i as usize];
            let weight = record.weight(query, self.derived[i as usize].radius, self.a, self.details.weighting);
            if weight > 0.0 {
                near.push((record.id(), i, weight));
            }
            true
        });
        if near.is_empty() {
            return None;
        }
        near.sort_unstable_by_key(|n| n.0);
        let (mut answer, mut weights) = (C::Answer::default(), 0.0);
        for &(_, i, weight) in &near {
            self.records[i as usize].add(query, weight, self.derived[i as usize].limit, &mut answer);
            weights += weight;
        }
        C::finish(&mut answer, weights);
        Some(answer)
    }

    /// Records in the set.
    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// Order-free digest of the ids.
    pub fn digest(&self) -> Digest {
        self.digest
    }
}

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec3};
    use proptest::prelude::*;

    use super::*;
    use crate::irradiance::Irradiance;
    use crate::null::Null;

    fn irradiance() -> impl Strategy<Value = Irradiance> {
        (any::<u128>(), prop::array::uniform3(0f32..2.0), 0.05f32..3.0, prop::array::uniform9(0f32..1.0)).prop_map(
            |(id, p, radius, v)| Irradiance {
                id: RecordId(id),
                position: Vec3::from(p),
                normal: Vec3::new(v[0] - 0.5, v[1] - 0.5, 0.7).normalize(),
                radius,
                radius_min: 0.2,
                radius_max: 2.0,
                irradiance: Vec3::new(v[2], v[3], v[4]),
                gradient_t: [Vec2::new(v[5], v[6]); 3],
                gradient_r: [Vec2::new(v[7], v[8]); 3],
                ellipse: [0.0; 3],
                noise: 0.0,
            },
        )
    }

    proptest! {
        #[test]
        fn answers_do_not_depend_on_order_or_steps(
            mut records in prop::collection::vec(irradiance(), 1..60),
            points in prop::collection::vec(prop::array::uniform3(0f32..2.0), 20),
            cut in 0usize..60,
        ) {
            let mut at_once = Sealed::new(0.8);
            at_once.extend(records.iter().copied());
            let middle = cut % records.len();
            records.rotate_left(middle);
            let mut in_steps = Sealed::new(0.8);
            for step in records.chunks(7) {
                in_steps.extend(step.iter().copied());
            }
            prop_assert_eq!(at_once.digest(), in_steps.digest());
            for p in points {
                let query = Query { position: Vec3::from(p), normal: Vec3::Z };
                let (a, b) = (at_once.ask(&query), in_steps.ask(&query));
                prop_assert_eq!(a.map(|a| a.irradiance.to_array().map(f32::to_bits)),
                                b.map(|b| b.irradiance.to_array().map(f32::to_bits)));
                prop_assert_eq!(a.is_some(), at_once.covers(&query));
            }
        }
    }

    #[test]
    fn the_empty_room_is_filed_clamped_and_asked() {
        let null = |id, x, radius| Null { id: RecordId(id), position: Vec3::X * x, radius };
        let mut sealed = Sealed::new(1.0);
        sealed.extend([null(1, 0.0, 10.0), null(2, 1.0, 0.5)]);
        let at = |x| Query { position: Vec3::X * x, normal: Vec3::Z };
        // The second record clamps the first to 0.5 + 1.
        assert_eq!(sealed.ask(&at(-1.4)), Some(1));
        assert_eq!(sealed.ask(&at(-1.6)), None);
        assert_eq!(sealed.ask(&at(0.8)), Some(2));
    }
}
