//! A set of records nothing more will be added to in this round, ready to be asked.
//!
//! Everything here is derived from the records and `a` alone: two replicas with the same set answer with the same bits,
//! whatever order the records came in. Asking never writes.

use std::cmp::Ordering;

use hashbrown::HashMap;
use smallvec::SmallVec;

use crate::cached::{Cached, Query};
use crate::clamp::Clamp;
use crate::details::Details;
use crate::id::{Digest, RecordId};
use crate::octree::{self, Octree};
use crate::record::Record;
use crate::shrink::Shrink;

/// A new record's allowed error over its nearest neighbour's (Krivanek 2006, 4.2).
const FIRST_OVER_NEAREST: f32 = 1.4;

/// Records of one level, clamped, shrunk and filed.
#[derive(Clone, Debug)]
pub struct Sealed<C> {
    a: f32,
    details: Details,
    /// In Morton order of their sites, those of one site by id: the order of sums.
    records: Vec<C>,
    /// Of each record.
    derived: Vec<Derived>,
    /// Least allowed error proposed for each record, those that are not here (yet) included.
    proposed: HashMap<RecordId, f32>,
    octree: Octree,
    digest: Digest,
}

/// What follows from a record and its neighbours.
#[derive(Clone, Copy, Debug)]
struct Derived {
    /// R*: raw R clamped by the neighbours' raw R.
    clamped: f32,
    /// a_i: the least of the global a and what was proposed.
    a: f32,
}

/// How a record counts among its neighbours.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Counting {
    /// R it counts with, world length: clamped, and within its bounds.
    pub radius: f32,
    /// Its allowed error a_i.
    pub a: f32,
    /// How much of its gradients holds, in [0, 1].
    pub limit: f32,
}

/// What one record says at a query.
#[derive(Clone, Debug)]
pub struct Contribution<C: Cached> {
    /// Which.
    pub record: C,
    /// Its relative error there, below its a_i.
    pub error: f32,
    /// Least a_i it can have: its reach is then the least.
    pub a_min: f32,
    /// Its weight, more than 0.
    pub weight: f32,
    /// Its estimate.
    pub answer: C::Answer,
}

impl<C: Cached> Sealed<C> {
    /// An empty set whose records will count with the allowed error `a` (greater than 0).
    pub fn new(a: f32) -> Self {
        Self::with(a, Details::default())
    }

    /// The same with other details than the usual ones.
    pub fn with(a: f32, details: Details) -> Self {
        let (records, derived, proposed) = (Vec::new(), Vec::new(), HashMap::new());
        Self { a, details, records, derived, proposed, octree: Octree::default(), digest: Digest::default() }
    }

    /// Opens the set, adds records that are not in it yet, and seals it again. The result depends on the united set
    /// only: extending in one step, in many, or in another order gives the same answers.
    pub fn extend(&mut self, new: impl IntoIterator<Item = C>) {
        let mut new: Vec<C> = new.into_iter().collect();
        if new.is_empty() {
            return;
        }
        new.sort_unstable_by(order);
        new.iter().for_each(|record| self.digest.add(record.id()));
        let fresh = self.clamp(&new);
        for (record, derived) in self.records.iter().zip(&mut self.derived) {
            derived.clamped = fresh.clamp(record.position(), derived.clamped);
        }
        let count = self.records.len() + new.len();
        let (mut records, mut derived) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let mut new = new.into_iter().peekable();
        // R* of what is new is found when all are in their places; one that is infinite indeed is found again.
        let unknown = Derived { clamped: f32::INFINITY, a: self.a };
        for (old, known) in self.records.drain(..).zip(self.derived.drain(..)) {
            while let Some(record) = new.next_if(|record| order(record, &old).is_lt()) {
                records.push(record);
                derived.push(unknown);
            }
            records.push(old);
            derived.push(known);
        }
        derived.resize(count, unknown);
        records.extend(new);
        (self.records, self.derived) = (records, derived);
        let all = self.clamp(&self.records);
        for (record, derived) in self.records.iter().zip(&mut self.derived) {
            if derived.clamped == f32::INFINITY {
                derived.clamped = all.clamp(record.position(), record.radius());
            }
        }
        self.file();
    }

    /// What clamps these records' neighbours.
    fn clamp(&self, records: &[C]) -> Clamp {
        let records = if self.details.neighbor_clamping { records } else { &[] };
        Clamp::new(records.iter().map(|r| (r.position(), r.radius())).collect())
    }

    /// Files every record by its reach of now.
    fn file(&mut self) {
        for (record, derived) in self.records.iter().zip(&mut self.derived) {
            let radius = derived.radius(record);
            let proposed = if self.proposed.is_empty() { None } else { self.proposed.get(&record.id()) };
            // Whatever was proposed, the record counts out to the least reach.
            let least = self.a * record.radius_bounds().0 / radius;
            derived.a = proposed.map_or(self.a, |proposed| proposed.max(least).min(self.a));
        }
        // By the global a, so that what shrank is still found as a neighbour; it is tested by its own.
        let reach = |(record, derived): (&C, &Derived)| (record.position(), self.a * derived.radius(record));
        self.octree = Octree::new(self.records.iter().zip(&self.derived).map(reach));
    }

    /// Opens the set, adds proposals that are not in it yet, of records that may come later, and seals it again. Neither their
    /// order matters nor whether they come before or after their records.
    pub fn shrink(&mut self, new: impl IntoIterator<Item = Shrink>) {
        let mut lower = false;
        for shrink in new {
            self.digest.add(shrink.id);
            let least = self.proposed.entry(shrink.of).or_insert(f32::INFINITY);
            if shrink.a < *least {
                (*least, lower) = (shrink.a, true);
            }
        }
        if lower {
            self.file();
        }
    }

    /// What was proposed: of each record the least, in no order.
    pub fn proposals(&self) -> impl Iterator<Item = Shrink> {
        self.proposed.iter().map(|(of, a)| Shrink::new(*of, *a))
    }

    /// [`Self::extend`] and [`Self::shrink`] in one: what is of neither kind is left out.
    pub fn unite<'a>(&mut self, new: impl IntoIterator<Item = &'a Record>)
    where
        C: for<'r> TryFrom<&'r Record>,
    {
        let (mut records, mut shrinks) = (Vec::new(), Vec::new());
        for record in new {
            match record {
                Record::Shrink(shrink) => shrinks.push(*shrink),
                other => records.extend(C::try_from(other).ok()),
            }
        }
        self.extend(records);
        self.shrink(shrinks);
    }

    /// Relative error and weight of a record at a query.
    #[inline]
    fn weigh(&self, i: usize, query: &Query) -> (f32, f32) {
        let (record, derived) = (&self.records[i], &self.derived[i]);
        let error = record.error(query, derived.radius(record), derived.a);
        (error, self.details.weighting.weight(error, derived.a))
    }

    /// How much of the gradients holds out to the R a record counts with: R* / R where its lower bound stretched it, else 1.
    #[inline]
    fn limit(&self, i: usize) -> f32 {
        let derived = &self.derived[i];
        let limited = self.details.gradient_by_radius;
        if limited { (derived.clamped / derived.radius(&self.records[i])).min(1.0) } else { 1.0 }
    }

    /// Whether any record counts at `query`.
    pub fn covers(&self, query: &Query) -> bool {
        let mut found = false;
        self.octree.visit(query.position, |i| {
            found = self.weigh(i, query).1 > 0.0;
            !found
        });
        found
    }

    /// The weighted mean of all records that count at `query`, summed in Morton order; `None` where there is none.
    pub fn ask(&self, query: &Query) -> Option<C::Answer> {
        let (mut answer, mut weights) = (C::Answer::default(), 0.0);
        self.octree.visit(query.position, |i| {
            let (_, weight) = self.weigh(i, query);
            if weight > 0.0 {
                self.records[i].add(query, weight, self.limit(i), &mut answer);
                weights += weight;
            }
            true
        });
        (weights > 0.0).then(|| {
            C::finish(&mut answer, weights);
            answer
        })
    }

    /// What each record that counts at `query` says there, in id order.
    pub fn contributions(&self, query: &Query) -> SmallVec<[Contribution<C>; 8]> {
        let mut near = SmallVec::new();
        self.octree.visit(query.position, |i| {
            let (record, derived) = (self.records[i], &self.derived[i]);
            let (error, weight) = self.weigh(i, query);
            if weight > 0.0 {
                let mut answer = C::Answer::default();
                record.add(query, 1.0, self.limit(i), &mut answer);
                let a_min = self.a * record.radius_bounds().0 / derived.radius(&record);
                near.push(Contribution { record, error, a_min, weight, answer });
            }
            true
        });
        near.sort_unstable_by_key(|n: &Contribution<C>| n.record.id());
        near
    }

    /// The allowed error a record made at `query` should begin with (Krivanek 2006, 4.2): 1.4 times that of the nearest
    /// record that would count there had it not shrunk, at most the global a.
    pub fn first_a(&self, query: &Query) -> f32 {
        let mut nearest = (f32::INFINITY, RecordId(0), self.a);
        self.octree.visit(query.position, |i| {
            let (record, derived) = (&self.records[i], &self.derived[i]);
            let error = record.error(query, derived.radius(record), self.a);
            if error < self.a && (error, record.id()) < (nearest.0, nearest.1) {
                nearest = (error, record.id(), derived.a);
            }
            true
        });
        (FIRST_OVER_NEAREST * nearest.2).min(self.a)
    }

    /// The records, in the order of sums.
    pub fn records(&self) -> &[C] {
        &self.records
    }

    /// The records as they count, in the order of sums.
    pub fn counting(&self) -> impl Iterator<Item = (&C, Counting)> {
        self.records.iter().zip(&self.derived).enumerate().map(|(i, (record, derived))| {
            (record, Counting { radius: derived.radius(record), a: derived.a, limit: self.limit(i) })
        })
    }

    /// Bytes the records take, all that is derived from them included.
    pub fn bytes(&self) -> usize {
        let each = size_of::<C>() + size_of::<Derived>();
        self.records.len() * each + self.octree.bytes() + self.proposed.allocation_size()
    }

    /// Records in the set.
    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// Order-free digest of the ids of records and proposals.
    pub fn digest(&self) -> Digest {
        self.digest
    }
}

impl Derived {
    /// R the record counts with: R* within the record's bounds.
    #[inline]
    fn radius(&self, record: &impl Cached) -> f32 {
        let (min, max) = record.radius_bounds();
        self.clamped.min(max).max(min)
    }
}

/// Where records stand: in Morton order, those of one site by id.
fn order<C: Cached>(a: &C, b: &C) -> Ordering {
    octree::order(a.position(), b.position()).then_with(|| a.id().cmp(&b.id()))
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
            proposed in prop::collection::vec((0usize..70, 0.01f32..1.0), 0..60),
            cut in 0usize..60,
        ) {
            // Some are of records that never come.
            let of = |i: usize| records.get(i).map_or(RecordId(i as u128), |r| r.id);
            let mut shrinks: Vec<_> = proposed.iter().map(|(i, a)| Shrink::new(of(*i), *a)).collect();
            let mut at_once = Sealed::new(0.8);
            at_once.extend(records.iter().copied());
            at_once.shrink(shrinks.iter().copied());
            let middle = cut % records.len();
            records.rotate_left(middle);
            shrinks.reverse();
            let mut in_steps = Sealed::new(0.8);
            let mut shrinks = shrinks.chunks(5);
            for step in records.chunks(7) {
                in_steps.shrink(shrinks.next().unwrap_or_default().iter().copied());
                in_steps.extend(step.iter().copied());
            }
            in_steps.shrink(shrinks.flatten().copied());
            prop_assert_eq!(at_once.digest(), in_steps.digest());
            for p in points {
                let query = Query::new(Vec3::from(p), Vec3::Z);
                let (a, b) = (at_once.ask(&query), in_steps.ask(&query));
                prop_assert_eq!(a.map(|a| a.irradiance.to_array().map(f32::to_bits)),
                                b.map(|b| b.irradiance.to_array().map(f32::to_bits)));
                prop_assert_eq!(a.is_some(), at_once.covers(&query));
                let near = at_once.contributions(&query);
                prop_assert_eq!(near.len(), a.map_or(0, |a| a.records as usize));
                prop_assert_eq!(at_once.first_a(&query).to_bits(), in_steps.first_a(&query).to_bits());
            }
            for record in &records {
                let site = Query::new(record.position, record.normal);
                prop_assert!(at_once.covers(&site));
            }
        }

        /// The weakest shrink that excludes a point.
        #[test]
        fn an_error_proposed_excludes_there_and_no_nearer(
            records in prop::collection::vec(irradiance(), 1..20),
            points in prop::collection::vec(prop::array::uniform3(0f32..2.0), 20),
        ) {
            let mut sealed = Sealed::new(0.8);
            sealed.extend(records.iter().copied());
            for p in points {
                let query = Query::new(Vec3::from(p), Vec3::Z);
                let near = sealed.contributions(&query);
                for c in near.iter().filter(|c| c.error > c.a_min) {
                    let counts = |a: f32| {
                        let mut shrunk = sealed.clone();
                        shrunk.shrink([Shrink::new(c.record.id, a)]);
                        shrunk.contributions(&query).iter().any(|other| other.record.id == c.record.id)
                    };
                    prop_assert!(!counts(c.error) && counts(c.error * 1.0001));
                }
            }
        }
    }

    /// Whichever came first.
    #[test]
    fn records_of_one_site_are_summed_by_id() {
        let record = crate::irradiance::tests::sound();
        let each = |i: u8| {
            let irradiance = Vec3::splat([0.3, 0.4, 0.45, 1e7][usize::from(i)]);
            Irradiance { id: RecordId(i.into()), irradiance, ..record }
        };
        let answer = |ids: [u8; 4]| {
            let mut sealed = Sealed::new(0.3);
            ids.into_iter().for_each(|i| sealed.extend([each(i)]));
            let at = Query::new(record.position + Vec3::X * 0.1, record.normal);
            sealed.ask(&at).map(|a| a.irradiance.x.to_bits())
        };
        let first = answer([0, 1, 2, 3]);
        for ids in [[3, 2, 1, 0], [2, 0, 3, 1], [1, 3, 0, 2]] {
            assert_eq!(answer(ids), first, "{ids:?}");
        }
    }

    /// What the packed record and its place in the octree take, no more.
    #[test]
    fn a_record_of_irradiance_takes_at_most_160_bytes() {
        let record = crate::irradiance::tests::sound();
        let place = |i: u32| Vec3::new((i % 100) as f32, (i / 100) as f32, 0.0);
        let mut sealed = Sealed::new(0.3);
        sealed.extend((0..10_000).map(|i| Irradiance { id: RecordId(i.into()), position: place(i), ..record }));
        assert!(sealed.bytes() <= 160 * sealed.len(), "{} bytes", sealed.bytes() as f32 / sealed.len() as f32);
    }

    #[test]
    fn a_new_record_begins_with_a_little_more_than_the_nearest_that_shrank() {
        let null = |id, x| Null { id: RecordId(id), position: Vec3::X * x, radius: 1.0 };
        let mut sealed = Sealed::new(1.0);
        sealed.extend([null(1, 0.0), null(2, 0.5)]);
        let at = |x| Query::new(Vec3::X * x, Vec3::Z);
        assert_eq!(sealed.first_a(&at(0.3)), 1.0);
        sealed.shrink([Shrink::new(RecordId(1), 0.1), Shrink::new(RecordId(2), 0.2), Shrink::new(RecordId(1), 0.3)]);
        assert!(!sealed.covers(&at(0.2)) && sealed.covers(&at(0.09)) && sealed.covers(&at(0.31)));
        assert_eq!([0.2, 0.3, 7.0].map(|x| sealed.first_a(&at(x))), [1.4 * 0.1, 1.4 * 0.2, 1.0]);
        // Nothing lets a record count less far than its least R.
        sealed.shrink([Shrink::new(RecordId(1), 1e-30)]);
        assert!(sealed.covers(&at(0.0)));
    }

    #[test]
    fn the_empty_room_is_filed_clamped_and_asked() {
        let null = |id, x, radius| Null { id: RecordId(id), position: Vec3::X * x, radius };
        let mut sealed = Sealed::new(1.0);
        sealed.extend([null(1, 0.0, 10.0), null(2, 1.0, 0.5)]);
        let at = |x| Query::new(Vec3::X * x, Vec3::Z);
        // The second record clamps the first to 0.5 + 1.
        assert_eq!(sealed.ask(&at(-1.4)), Some(1));
        assert_eq!(sealed.ask(&at(-1.6)), None);
        assert_eq!(sealed.ask(&at(0.8)), Some(2));
    }
}
