//! Id to record: the grow-only set every replica holds. Union is the only merge: idempotent, commutative, associative.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashMap};

use crate::cached::Cached;
use crate::id::{Digest, RecordId};

/// What a set knows of a record besides its content.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub struct Tag {
    /// Bounce the record answers for, from 1.
    pub level: u32,
    /// In the draft of a frame: the step that gathered it; later steps read it. Elsewhere 0.
    pub step: u32,
}

impl Tag {
    /// A record of `level` that no frame's step gathered.
    pub fn level(level: u32) -> Self {
        Self { level, step: 0 }
    }
}

/// How many records, and which.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Sum {
    /// How many.
    pub records: u64,
    /// Order-free digest of their ids.
    pub digest: Digest,
}

impl Sum {
    fn add(&mut self, id: RecordId) {
        self.records += 1;
        self.digest.add(id);
    }

    fn remove(&mut self, id: RecordId) {
        self.records -= 1;
        self.digest.remove(id);
    }

    /// Both together; they must have no record in common.
    pub fn and(self, other: Self) -> Self {
        Self { records: self.records + other.records, digest: self.digest.and(other.digest) }
    }
}

/// What became of an inserted record.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Inserted {
    /// It was new.
    Added,
    /// It was there already, with the same bytes (or smaller ones, which stay).
    Known,
    /// The same id was there with other bytes; these are smaller and take its place.
    Replaced,
}

/// Records of one namespace and kind, of all levels, in order of arrival.
///
/// - Invariant: every id stands once in the index; the log holds it once, and once more for each replacement.
/// - Two sets that saw the same records, in any order and with repeats, hold the same id-to-bytes mapping.
/// - Equal ids with different bytes come from different builds or machines; the smaller bytes win everywhere.
#[derive(Clone, Debug)]
pub struct RecordSet<C> {
    log: Vec<(Tag, C)>,
    index: HashMap<RecordId, usize>,
    /// What each step gathered.
    steps: BTreeMap<u32, Sum>,
    /// Positions whose record took the place of an earlier one.
    replaced: BTreeSet<usize>,
    conflicts: u64,
}

impl<C> Default for RecordSet<C> {
    fn default() -> Self {
        Self { log: Vec::new(), index: HashMap::new(), steps: BTreeMap::new(), replaced: BTreeSet::new(), conflicts: 0 }
    }
}

impl<C: Cached> RecordSet<C> {
    /// Unites with one record.
    pub fn insert(&mut self, tag: Tag, record: C) -> Inserted {
        let (id, position) = (record.id(), self.log.len());
        match self.index.entry(id) {
            Entry::Vacant(slot) => {
                slot.insert(position);
                self.steps.entry(tag.step).or_default().add(id);
                self.log.push((tag, record));
                Inserted::Added
            }
            Entry::Occupied(mut slot) => {
                let (known, held) = &self.log[*slot.get()];
                let order = (tag, bytes(&record)).cmp(&(*known, bytes(held)));
                if order.is_ne() {
                    self.conflicts += 1;
                }
                if order.is_lt() {
                    if let Some(sum) = self.steps.get_mut(&known.step) {
                        sum.remove(id);
                    }
                    self.steps.entry(tag.step).or_default().add(id);
                    slot.insert(position);
                    self.replaced.insert(position);
                    self.log.push((tag, record));
                    return Inserted::Replaced;
                }
                Inserted::Known
            }
        }
    }

    /// Records in the set.
    pub fn len(&self) -> usize {
        self.index.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.index.is_empty()
    }

    /// Length of the log: where the next record will stand.
    pub fn position(&self) -> usize {
        self.log.len()
    }

    /// The record of an id.
    pub fn get(&self, id: RecordId) -> Option<&(Tag, C)> {
        self.position_of(id).map(|at| &self.log[at])
    }

    /// Where the record of an id stands in the log.
    pub fn position_of(&self, id: RecordId) -> Option<usize> {
        self.index.get(&id).copied()
    }

    /// The log from a position on, in order of arrival. Empty past the end.
    pub fn since(&self, position: usize) -> &[(Tag, C)] {
        &self.log[position.min(self.log.len())..]
    }

    /// The records of one level, in order of arrival, replaced ones left out.
    pub fn level(&self, level: u32) -> impl Iterator<Item = &C> {
        self.log
            .iter()
            .enumerate()
            .filter(move |(at, (tag, r))| tag.level == level && self.index.get(&r.id()) == Some(at))
            .map(|(_, (_, r))| r)
    }

    /// All records.
    pub fn sum(&self) -> Sum {
        self.steps.values().copied().fold(Sum::default(), Sum::and)
    }

    /// The records of steps before `step`.
    pub fn before(&self, step: u32) -> Sum {
        self.steps.range(..step).map(|(_, sum)| *sum).fold(Sum::default(), Sum::and)
    }

    /// The records before a position of the log. Takes time with the position.
    pub fn prefix(&self, position: usize) -> Sum {
        self.prefixes().nth(position).unwrap_or_else(|| self.sum())
    }

    /// The shortest beginning of the log whose records have this digest: where it ends.
    pub fn find(&self, digest: Digest) -> Option<usize> {
        self.prefixes().position(|sum| sum.digest == digest)
    }

    /// Positions of the log whose record took the place of an earlier one.
    pub fn replaced(&self) -> &BTreeSet<usize> {
        &self.replaced
    }

    /// The records before positions 0, 1, ... of the log.
    fn prefixes(&self) -> impl Iterator<Item = Sum> {
        let mut sum = Sum::default();
        let next = move |(at, (_, record)): (usize, &(Tag, C))| {
            if !self.replaced.contains(&at) {
                sum.add(record.id());
            }
            sum
        };
        std::iter::once(Sum::default()).chain(self.log.iter().enumerate().map(next))
    }

    /// Order-free digest of the ids.
    pub fn digest(&self) -> Digest {
        self.sum().digest
    }

    /// How often an id came with other bytes than before.
    pub fn conflicts(&self) -> u64 {
        self.conflicts
    }
}

fn bytes<C: Cached>(record: &C) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(C::BYTES);
    record.encode(&mut bytes);
    bytes
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;

    use super::*;
    use crate::null::Null;

    const ONE: Tag = Tag { level: 1, step: 0 };

    /// Few ids and few contents, so that repeats and conflicts are common.
    fn records() -> impl Strategy<Value = Vec<Null>> {
        let one = (0u128..12, 0..3u8).prop_map(|(id, x)| Null {
            id: RecordId(id),
            position: Vec3::splat(f32::from(x)),
            radius: 1.0,
        });
        prop::collection::vec(one, 0..40)
    }

    fn union(parts: &[&[Null]]) -> RecordSet<Null> {
        let mut set = RecordSet::default();
        for record in parts.iter().copied().flatten() {
            set.insert(ONE, *record);
        }
        set
    }

    /// What a set holds, whatever way it came there.
    fn content(set: &RecordSet<Null>) -> (Digest, Vec<(u128, Vec<u8>)>) {
        let mut all: Vec<_> = set.level(1).map(|r| (r.id.0, bytes(r))).collect();
        all.sort();
        (set.digest(), all)
    }

    proptest! {
        #[test]
        fn merging_is_idempotent(a in records()) {
            prop_assert_eq!(content(&union(&[&a, &a])), content(&union(&[&a])));
        }

        #[test]
        fn merging_is_commutative(a in records(), b in records()) {
            prop_assert_eq!(content(&union(&[&a, &b])), content(&union(&[&b, &a])));
        }

        #[test]
        fn merging_is_associative(a in records(), b in records(), c in records()) {
            let (ab, bc) = (union(&[&a, &b]), union(&[&b, &c]));
            let held = |s: &RecordSet<Null>| s.level(1).copied().collect::<Vec<_>>();
            prop_assert_eq!(content(&union(&[&held(&ab), &c])), content(&union(&[&a, &held(&bc)])));
        }

        #[test]
        fn a_log_replayed_from_any_position_catches_up(a in records(), b in records()) {
            let mut far = union(&[&a]);
            let near = union(&[&a, &b]);
            for (tag, record) in near.since(far.position()) {
                far.insert(*tag, *record);
            }
            prop_assert_eq!(content(&far), content(&near));
        }
    }

    #[test]
    fn smaller_bytes_win_and_the_conflict_is_counted() {
        let at = |x: f32| Null { id: RecordId(1), position: Vec3::splat(x), radius: 1.0 };
        let mut set = union(&[&[at(1.0)]]);
        // Little endian: 2.0 begins 00 00 00, 1.0 begins 00 00 80.
        assert_eq!(set.insert(ONE, at(2.0)), Inserted::Replaced);
        assert_eq!(set.insert(ONE, at(1.0)), Inserted::Known);
        assert_eq!(set.level(1).next().map(|r| r.position.x), Some(2.0));
        assert_eq!((set.len(), set.position(), set.conflicts()), (1, 2, 2));
        assert_eq!((set.prefix(0).records, set.prefix(1), set.prefix(2)), (0, set.sum(), set.sum()));
    }

    #[test]
    fn a_beginning_of_the_log_is_found_by_its_digest() {
        let null = |id| Null { id: RecordId(id), position: Vec3::ZERO, radius: 1.0 };
        let set = union(&[&[null(4), null(1), null(9)]]);
        assert_eq!([0, 4, 5, 14, 9].map(|digest| set.find(Digest(digest))), [Some(0), Some(1), Some(2), Some(3), None]);
    }

    #[test]
    fn what_a_step_may_read_does_not_depend_on_arrival() {
        let null = |id| Null { id: RecordId(id), position: Vec3::ZERO, radius: 1.0 };
        let at = |step| Tag { level: 1, step };
        let mut entries = [(at(2), null(4)), (at(0), null(1)), (at(1), null(2)), (at(1), null(9))];
        for _ in 0..4 {
            entries.rotate_left(1);
            let mut set = RecordSet::default();
            for (tag, record) in entries {
                set.insert(tag, record);
            }
            let sums: Vec<_> = (0..4).map(|step| (set.before(step).records, set.before(step).digest.0)).collect();
            assert_eq!(sums, [(0, 0), (1, 1), (3, 12), (4, 16)]);
            // The same record from a lower step: it takes the place, and counts there.
            assert_eq!(set.insert(at(0), null(4)), Inserted::Replaced);
            assert_eq!((set.before(1).digest.0, set.before(3).digest.0, set.sum().records), (5, 16, 4));
        }
    }
}
