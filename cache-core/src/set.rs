//! Id to record: the grow-only set every replica holds. Union is the only merge: idempotent, commutative, associative.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::BuildHasher as _;

use hashbrown::DefaultHashBuilder;
use hashbrown::hash_table::{Entry, HashTable};

use crate::id::{Digest, RecordId};
use crate::record::Record;

/// Records looked up together before they are placed: each look-up waits for memory, but none for another.
const TOGETHER: usize = 64;

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

/// Records of one namespace, of all kinds and levels, in order of arrival.
///
/// - Invariant: every id stands once in the index; the log holds it once, and once more for each replacement.
/// - Two sets that saw the same records, in any order and with repeats, hold the same id-to-bytes mapping.
/// - Equal ids with different bytes come from different builds or machines; the smaller bytes win everywhere.
#[derive(Clone, Debug, Default)]
pub struct RecordSet {
    log: Vec<(Tag, Record)>,
    index: Index,
    /// What each step gathered.
    steps: BTreeMap<u32, Sum>,
    /// Positions whose record took the place of an earlier one.
    replaced: BTreeSet<usize>,
    conflicts: u64,
    /// Of all in the log.
    units: usize,
}

/// Where the record of each id stands in the log.
#[derive(Clone, Debug, Default)]
struct Index {
    slots: HashTable<Slot>,
    /// Keyed: ids are hashes already, but a peer may choose its own.
    hasher: DefaultHashBuilder,
}

/// A position, and the hash of the id that stands there: growing the table does not read the log, and few other ids do.
#[derive(Clone, Copy, Debug)]
struct Slot {
    hash: u32,
    at: u32,
}

impl Index {
    fn hash(&self, id: RecordId) -> u32 {
        self.hasher.hash_one(id.0) as u32
    }

    fn position(&self, log: &[(Tag, Record)], id: RecordId) -> Option<usize> {
        let hash = self.hash(id);
        let slot = self.slots.find(spread(hash), |slot| slot.hash == hash && log[slot.at as usize].1.id() == id);
        slot.map(|slot| slot.at as usize)
    }

    fn entry(&mut self, log: &[(Tag, Record)], id: RecordId) -> (Slot, Entry<'_, Slot>) {
        let at = u32::try_from(log.len()).expect("no memory holds a log of 2^32 records");
        let hash = self.hash(id);
        let same = |slot: &Slot| slot.hash == hash && log[slot.at as usize].1.id() == id;
        (Slot { hash, at }, self.slots.entry(spread(hash), same, |slot| spread(slot.hash)))
    }
}

/// The table looks at the lowest and the highest bits.
fn spread(hash: u32) -> u64 {
    u64::from(hash).wrapping_mul(0x9E37_79B9_7F4A_7C15)
}

impl RecordSet {
    /// Unites with one record.
    pub fn insert(&mut self, tag: Tag, record: impl Into<Record>) -> Inserted {
        self.place(tag, &record.into())
    }

    /// Unites with records of one tag: the same as [`Self::insert`] of one after the other, in less time. Which of them took
    /// the place of other contents.
    pub fn extend(&mut self, tag: Tag, records: &[Record]) -> Vec<RecordId> {
        let mut replaced = Vec::new();
        for some in records.chunks(TOGETHER) {
            self.index.slots.reserve(some.len(), |slot| spread(slot.hash));
            let known = some.iter().filter(|record| self.position_of(record.id()).is_some()).count();
            self.log.reserve(some.len() - known);
            let took = |record: &&Record| self.place(tag, record) == Inserted::Replaced;
            replaced.extend(some.iter().filter(took).map(Record::id));
        }
        replaced
    }

    fn place(&mut self, tag: Tag, record: &Record) -> Inserted {
        let id = record.id();
        let (new, slot) = self.index.entry(&self.log, id);
        let mut slot = match slot {
            Entry::Vacant(slot) => {
                slot.insert(new);
                self.steps.entry(tag.step).or_default().add(id);
                self.push(tag, record);
                return Inserted::Added;
            }
            Entry::Occupied(slot) => slot,
        };
        let (known, held) = &self.log[slot.get().at as usize];
        let order = (tag, bytes(record)).cmp(&(*known, bytes(held)));
        if order.is_ne() {
            self.conflicts += 1;
        }
        if order.is_ge() {
            return Inserted::Known;
        }
        if let Some(sum) = self.steps.get_mut(&known.step) {
            sum.remove(id);
        }
        self.steps.entry(tag.step).or_default().add(id);
        *slot.get_mut() = new;
        self.replaced.insert(new.at as usize);
        self.push(tag, record);
        Inserted::Replaced
    }

    fn push(&mut self, tag: Tag, record: &Record) {
        self.units += record.units();
        self.log.push((tag, record.clone()));
    }

    /// [`Record::units`] of the whole log.
    pub fn units(&self) -> usize {
        self.units
    }

    /// Records in the set.
    pub fn len(&self) -> usize {
        self.index.slots.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.index.slots.is_empty()
    }

    /// Length of the log: where the next record will stand.
    pub fn position(&self) -> usize {
        self.log.len()
    }

    /// The record of an id.
    pub fn get(&self, id: RecordId) -> Option<&(Tag, Record)> {
        self.position_of(id).map(|at| &self.log[at])
    }

    /// Where the record of an id stands in the log.
    pub fn position_of(&self, id: RecordId) -> Option<usize> {
        self.index.position(&self.log, id)
    }

    /// The log from a position on, in order of arrival. Empty past the end.
    pub fn since(&self, position: usize) -> &[(Tag, Record)] {
        &self.log[position.min(self.log.len())..]
    }

    /// The records of one level, in order of arrival, replaced ones left out.
    pub fn level(&self, level: u32) -> impl Iterator<Item = &Record> {
        let of_level = self.log.iter().enumerate().filter(move |(_, (tag, _))| tag.level == level);
        // Nearly always there is nothing to look up.
        let current = move |at, id| self.replaced.is_empty() || self.position_of(id) == Some(at);
        of_level.filter(move |(at, (_, record))| current(*at, record.id())).map(|(_, (_, record))| record)
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
        let next = move |(at, (_, record)): (usize, &(Tag, Record))| {
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

/// What decides between two contents of one id.
fn bytes(record: &Record) -> (u32, Vec<u8>) {
    let mut bytes = Vec::new();
    record.encode(&mut bytes);
    (record.kind(), bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::shrink::Shrink;

    const ONE: Tag = Tag { level: 1, step: 0 };

    /// Few ids and few contents, so that repeats and conflicts are common.
    fn records() -> impl Strategy<Value = Vec<Shrink>> {
        let one = (0u128..12, 0..3u8).prop_map(|(id, a)| record(id, f32::from(a)));
        prop::collection::vec(one, 0..40)
    }

    /// The smallest record there is.
    fn record(id: u128, a: f32) -> Shrink {
        Shrink { id: RecordId(id), of: RecordId(0), a }
    }

    fn union(parts: &[&[Shrink]]) -> RecordSet {
        let mut set = RecordSet::default();
        for record in parts.iter().copied().flatten() {
            set.insert(ONE, *record);
        }
        set
    }

    fn shrink(record: &Record) -> Option<Shrink> {
        if let Record::Shrink(shrink) = record { Some(*shrink) } else { None }
    }

    /// What a set holds, whatever way it came there.
    type Content = (Digest, Vec<(RecordId, (u32, Vec<u8>))>);

    fn content(set: &RecordSet) -> Content {
        let mut all: Vec<_> = set.level(1).map(|r| (r.id(), bytes(r))).collect();
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
            let held = |s: &RecordSet| s.level(1).filter_map(shrink).collect::<Vec<_>>();
            prop_assert_eq!(content(&union(&[&held(&ab), &c])), content(&union(&[&a, &held(&bc)])));
        }

        #[test]
        fn extending_is_inserting_one_after_the_other(parts in prop::collection::vec((0..3u32, records()), 0..6)) {
            let (mut at_once, mut singly) = (RecordSet::default(), RecordSet::default());
            for (step, part) in &parts {
                let tag = Tag { level: 1, step: *step };
                // More than are looked up together.
                let part: Vec<_> = part.iter().cycle().take(3 * part.len()).map(|r| Record::from(*r)).collect();
                let took = part.iter().filter(|r| singly.insert(tag, Record::clone(r)) == Inserted::Replaced).map(Record::id);
                let took: Vec<_> = took.collect();
                prop_assert_eq!(at_once.extend(tag, &part), took);
            }
            prop_assert_eq!(at_once.since(0), singly.since(0));
            prop_assert_eq!((at_once.sum(), at_once.before(1)), (singly.sum(), singly.before(1)));
            prop_assert_eq!((at_once.conflicts(), at_once.replaced()), (singly.conflicts(), singly.replaced()));
        }

        #[test]
        fn a_log_replayed_from_any_position_catches_up(a in records(), b in records()) {
            let mut far = union(&[&a]);
            let near = union(&[&a, &b]);
            for (tag, record) in near.since(far.position()) {
                far.insert(*tag, record.clone());
            }
            prop_assert_eq!(content(&far), content(&near));
        }
    }

    #[test]
    fn smaller_bytes_win_and_the_conflict_is_counted() {
        let at = |a: f32| record(1, a);
        let mut set = union(&[&[at(1.0)]]);
        // Little endian: 2.0 begins 00 00 00, 1.0 begins 00 00 80.
        assert_eq!(set.insert(ONE, at(2.0)), Inserted::Replaced);
        assert_eq!(set.insert(ONE, at(1.0)), Inserted::Known);
        assert_eq!(set.level(1).next().and_then(shrink).map(|r| r.a), Some(2.0));
        assert_eq!((set.len(), set.position(), set.conflicts()), (1, 2, 2));
        assert_eq!((set.prefix(0).records, set.prefix(1), set.prefix(2)), (0, set.sum(), set.sum()));
    }

    #[test]
    fn a_beginning_of_the_log_is_found_by_its_digest() {
        let any = |id| record(id, 1.0);
        let set = union(&[&[any(4), any(1), any(9)]]);
        assert_eq!([0, 4, 5, 14, 9].map(|digest| set.find(Digest(digest))), [Some(0), Some(1), Some(2), Some(3), None]);
    }

    #[test]
    fn what_a_step_may_read_does_not_depend_on_arrival() {
        let any = |id| record(id, 1.0);
        let at = |step| Tag { level: 1, step };
        let mut entries = [(at(2), any(4)), (at(0), any(1)), (at(1), any(2)), (at(1), any(9))];
        for _ in 0..4 {
            entries.rotate_left(1);
            let mut set = RecordSet::default();
            for (tag, record) in entries {
                set.insert(tag, record);
            }
            let sums: Vec<_> = (0..4).map(|step| (set.before(step).records, set.before(step).digest.0)).collect();
            assert_eq!(sums, [(0, 0), (1, 1), (3, 12), (4, 16)]);
            // The same record from a lower step: it takes the place, and counts there.
            assert_eq!(set.insert(at(0), any(4)), Inserted::Replaced);
            assert_eq!((set.before(1).digest.0, set.before(3).digest.0, set.sum().records), (5, 16, 4));
        }
    }
}
