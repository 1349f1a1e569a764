//! The sealed caches of exactly the records that a step of a frame may read.

use std::collections::HashSet;

use cache_core::RecordId;
use cache_core::details::Details;
use cache_core::id::Digest;

use crate::levels::{Level, Levels};
use crate::replica::{Mark, Part, ReplicaError};

/// The caches of one frame: its base, and its draft's records of lower steps.
///
/// Frames that share a namespace share its [`Replica`](crate::replica::Replica), but each has its own caches: their
/// steps read different parts at the same time.
///
/// Invariant: the caches are made of the base and of the part of the draft that `mark` says, and of nothing else.
pub struct Caches {
    a: f32,
    levels: Levels,
    base: HashSet<RecordId>,
    mark: Mark,
    /// Of the draft's records, those that are in the base as well included.
    digest: Digest,
}

impl Caches {
    /// Empty caches that count with the allowed error `a`, one for each of `levels` levels. Records of deeper levels,
    /// which another client may have shared, go into none.
    pub fn new(a: f32, levels: u32) -> Self {
        let levels = (0..levels).map(|_| Level::new(a, Details::default())).collect();
        Self { a, levels, base: HashSet::new(), mark: Mark::default(), digest: Digest::default() }
    }

    /// How much of the draft is in the caches.
    pub fn mark(&self) -> Mark {
        self.mark
    }

    /// Starts over with a base, which must have `digest`, and nothing of a draft.
    ///
    /// # Errors
    /// [`ReplicaError::Digest`]; nothing changes then.
    pub fn begin(&mut self, base: &Part, digest: Digest) -> Result<(), ReplicaError> {
        check(Digest::default(), base, digest)?;
        *self = Self::new(self.a, self.levels.len() as u32);
        self.file(base);
        self.base = base.records.iter().map(|(_, r)| r.id()).collect();
        Ok(())
    }

    /// Adds a part of the draft that was asked for [`Self::mark`]; with what is here it must have `digest`. A record of
    /// the base is not added twice.
    ///
    /// # Errors
    /// [`ReplicaError::Digest`]; nothing changes then.
    pub fn extend(&mut self, part: &Part, digest: Digest) -> Result<Levels, ReplicaError> {
        check(self.digest, part, digest)?;
        self.file(part);
        (self.mark, self.digest) = (part.to, digest);
        Ok(self.levels.clone())
    }

    fn file(&mut self, part: &Part) {
        for (level, sealed) in (1..).zip(&mut self.levels) {
            let own = part.records.iter().filter(|(tag, r)| tag.level == level && !self.base.contains(&r.id()));
            sealed.unite(own.map(|(_, record)| record));
        }
    }
}

fn check(mut united: Digest, part: &Part, expected: Digest) -> Result<(), ReplicaError> {
    part.records.iter().for_each(|(_, record)| united.add(record.id()));
    if united == expected {
        return Ok(());
    }
    let Mark { epoch, position, .. } = part.to;
    Err(ReplicaError::Digest { epoch, position, got: united.0, expected: expected.0 })
}

#[cfg(test)]
mod tests {
    use cache_core::{Query, Record, Tag};
    use glam::Vec3;
    use proptest::prelude::*;

    use super::*;
    use crate::replica::tests::{digest, entries, feed, latest, record, replica, server};

    /// Bits of the answers of both levels on a grid of points.
    fn answers(levels: &Levels) -> Vec<Option<[u32; 3]>> {
        let points = (0..27).map(|i| Vec3::new((i % 3) as f32, (i / 3 % 3) as f32, (i / 9) as f32) * 0.9);
        points
            .flat_map(|position| {
                let query = Query::new(position, Vec3::Z);
                levels.iter().map(move |l| l.irradiance.ask(&query).map(|a| a.irradiance.to_array().map(f32::to_bits)))
            })
            .collect()
    }

    fn counts(levels: &Levels) -> Vec<(usize, Digest)> {
        levels.iter().map(|l| (l.len(), l.digest())).collect()
    }

    /// Two levels of these records.
    fn sealed(records: impl IntoIterator<Item = (Tag, Record)>) -> Levels {
        let mut levels: Levels = (0..2).map(|_| Level::new(0.8, Details::default())).collect();
        for (tag, record) in records {
            if let Some(sealed) = levels.get_mut(tag.level as usize - 1) {
                sealed.unite([&record]);
            }
        }
        levels
    }

    proptest! {
        /// However much of the logs arrived, in whatever steps they were sealed before, however often the draft's log
        /// was replaced by one in another order: the caches are those of the base and of the draft's lower steps.
        #[test]
        fn caches_are_the_base_and_lower_steps(
            base in entries(),
            base_end in 0usize..40,
            mut draft in entries(),
            asks in prop::collection::vec((0usize..40, 0u32..5, prop::option::of(0usize..40)), 1..6),
        ) {
            let base = server(&base);
            let (held_base, base_end) = (replica(&base), base_end.min(base.len()));
            let base = latest(&base[..base_end]);
            let mut log = server(&draft);
            let mut held = replica(&log);
            let mut caches = Caches::new(0.8, 2);
            for (position, step, rotated) in asks {
                let (mut position, step) = (position.min(log.len()), step.max(caches.mark().step));
                match rotated {
                    Some(by) => {
                        let by = by % draft.len().max(1);
                        draft.rotate_left(by);
                        log = server(&draft);
                        held.set_aside();
                        feed(&mut held, &log);
                        position = position.min(log.len());
                    }
                    None => position = position.max(caches.mark().position as usize),
                }
                let lower: Vec<_> = latest(&log[..position]).into_iter().filter(|(tag, _)| tag.step < step).collect();
                let part = held.part(caches.mark(), position as u64, step).expect("arrived");
                if part.anew {
                    caches.begin(&held_base.prefix(base_end as u64).expect("arrived"), digest(&base)).expect("same base");
                }
                let levels = caches.extend(&part, digest(&lower)).expect("same records");
                let own = lower.into_iter().filter(|(_, r)| base.iter().all(|(_, b)| b.id() != r.id()));
                let expected = sealed(base.iter().cloned().chain(own));
                prop_assert_eq!(answers(&levels), answers(&expected));
                prop_assert_eq!(counts(&levels), counts(&expected));
            }
        }
    }

    #[test]
    fn a_step_adds_no_more_than_it_reads() {
        let at = |id: u128, step| (Tag { level: 1, step }, record(id, Vec3::ZERO, 1.0).into());
        let replica = replica(&[at(1, 0), at(4, 2), at(2, 1), at(8, 1)]);
        let mut mark = Mark::default();
        let mut added = |position, step| {
            let part = replica.part(mark, position, step).expect("arrived");
            mark = part.to;
            (part.anew, part.records.iter().map(|(_, r)| r.id().0 as u64).collect::<Vec<_>>())
        };
        assert_eq!(added(2, 1), (true, vec![1]));
        assert_eq!(added(3, 2), (false, vec![2]));
        // What came first and was of a later step; what came late.
        assert_eq!(added(4, 3), (false, vec![4, 8]));
        assert_eq!(added(4, 3), (false, vec![]));
    }

    #[test]
    fn other_records_than_the_servers_are_refused_and_change_nothing() {
        let at = |id: u128| (Tag { level: 1, step: 0 }, record(id, Vec3::ZERO, 1.0).into());
        let replica = replica(&[at(1), at(2)]);
        let mut caches = Caches::new(0.3, 2);
        let prefix = replica.prefix(1).expect("arrived");
        let refused = caches.begin(&prefix, digest(&[at(2)])).expect_err("another base").to_string();
        assert!(refused.starts_with("records up to position 1 have digest 0000"), "{refused}");
        caches.begin(&prefix, digest(&[at(1)])).expect("the base");
        let part = replica.part(caches.mark(), 2, 1).expect("arrived");
        assert!(caches.extend(&part, digest(&[at(2)])).is_err());
        assert_eq!(caches.mark(), Mark::default());
        // In the base and in the draft: once.
        let levels = caches.extend(&part, digest(&[at(1), at(2)])).expect("the draft");
        assert_eq!(levels[0].len(), 2);
    }
}
