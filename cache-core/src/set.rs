//! Id to record: the grow-only set every replica holds. Union is the only merge: idempotent, commutative, associative.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use crate::cached::Cached;
use crate::id::{Digest, RecordId};

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
    log: Vec<(u32, C)>,
    index: HashMap<RecordId, usize>,
    digest: Digest,
    conflicts: u64,
}

impl<C> Default for RecordSet<C> {
    fn default() -> Self {
        Self { log: Vec::new(), index: HashMap::new(), digest: Digest::default(), conflicts: 0 }
    }
}

impl<C: Cached> RecordSet<C> {
    /// Unites with one record of `level`.
    pub fn insert(&mut self, level: u32, record: C) -> Inserted {
        let position = self.log.len();
        match self.index.entry(record.id()) {
            Entry::Vacant(slot) => {
                slot.insert(position);
                self.digest.add(record.id());
                self.log.push((level, record));
                Inserted::Added
            }
            Entry::Occupied(mut slot) => {
                let order = bytes(level, &record).cmp(&bytes_at(&self.log, *slot.get()));
                if order.is_ne() {
                    self.conflicts += 1;
                }
                if order.is_lt() {
                    slot.insert(position);
                    self.log.push((level, record));
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

    /// The log from a position on: (level, record) in order of arrival. Empty past the end.
    pub fn since(&self, position: usize) -> &[(u32, C)] {
        &self.log[position.min(self.log.len())..]
    }

    /// The records of one level, in order of arrival, replaced ones left out.
    pub fn level(&self, level: u32) -> impl Iterator<Item = &C> {
        self.log
            .iter()
            .enumerate()
            .filter(move |(at, (l, r))| *l == level && self.index.get(&r.id()) == Some(at))
            .map(|(_, (_, r))| r)
    }

    /// Order-free digest of the ids.
    pub fn digest(&self) -> Digest {
        self.digest
    }

    /// How often an id came with other bytes than before.
    pub fn conflicts(&self) -> u64 {
        self.conflicts
    }
}

fn bytes<C: Cached>(level: u32, record: &C) -> Vec<u8> {
    let mut bytes = level.to_le_bytes().to_vec();
    record.encode(&mut bytes);
    bytes
}

fn bytes_at<C: Cached>(log: &[(u32, C)], at: usize) -> Vec<u8> {
    bytes(log[at].0, &log[at].1)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;

    use super::*;
    use crate::null::Null;

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
            set.insert(1, *record);
        }
        set
    }

    /// What a set holds, whatever way it came there.
    fn content(set: &RecordSet<Null>) -> (Digest, Vec<(u128, Vec<u8>)>) {
        let mut all: Vec<_> = set.level(1).map(|r| (r.id.0, bytes(1, r))).collect();
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
            for (level, record) in near.since(far.position()) {
                far.insert(*level, *record);
            }
            prop_assert_eq!(content(&far), content(&near));
        }
    }

    #[test]
    fn smaller_bytes_win_and_the_conflict_is_counted() {
        let at = |x: f32| Null { id: RecordId(1), position: Vec3::splat(x), radius: 1.0 };
        let mut set = union(&[&[at(1.0)]]);
        // Little endian: 2.0 begins 00 00 00, 1.0 begins 00 00 80.
        assert_eq!(set.insert(1, at(2.0)), Inserted::Replaced);
        assert_eq!(set.insert(1, at(1.0)), Inserted::Known);
        assert_eq!(set.level(1).next().map(|r| r.position.x), Some(2.0));
        assert_eq!((set.len(), set.position(), set.conflicts()), (1, 2, 2));
    }
}
