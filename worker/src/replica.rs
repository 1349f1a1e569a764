//! A worker's copy of one namespace, and the sealed caches of exactly the part of it that a step may read.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use cache_core::id::Digest;
use cache_core::set::Inserted;
use cache_core::{Irradiance, Namespace, RecordId, RecordSet, Sealed, Tag};
use cache_proto::{convert, v1};

use crate::frame::Levels;

/// Why a replica could not take a batch or give its caches.
#[derive(Clone, PartialEq, Debug, thiserror::Error)]
pub enum ReplicaError {
    /// A batch that is not sound, or not of this namespace.
    #[error("batch from the server: {0}")]
    Malformed(String),
    /// Records are missing between what is here and what came.
    #[error("batch begins at position {got}, expected at most {expected}")]
    Gap {
        /// Where the log ends here.
        expected: u64,
        /// Where the batch begins.
        got: u64,
    },
    /// The server's log holds a record that changes nothing, so positions would disagree.
    #[error("the server's log repeats a record at position {0}")]
    Repeated(u64),
    /// Asked for a position before what was already sealed: the lease is of a step long done.
    #[error("lease outdated: it reads up to position {asked}, sealed already up to {sealed}")]
    Outdated {
        /// What the lease reads up to.
        asked: u64,
        /// What is sealed here.
        sealed: u64,
    },
    /// Asked for a position that has not arrived yet.
    #[error("position {asked} has not arrived, the log ends at {have}")]
    Behind {
        /// What the lease reads up to.
        asked: u64,
        /// Where the log ends here.
        have: u64,
    },
    /// The records up to the position are not those the server sealed.
    #[error("records up to position {position} have digest {got:032x}, the server sealed {expected:032x}")]
    Digest {
        /// The position.
        position: u64,
        /// Digest here.
        got: u128,
        /// Digest in the step.
        expected: u128,
    },
}

/// A copy of a namespace's log.
///
/// Invariant: it is a prefix of the server's, entry by entry.
pub struct Replica {
    namespace: Namespace,
    set: RecordSet<Irradiance>,
    /// Positions whose record took the place of an earlier one.
    replaced: HashSet<usize>,
}

impl Replica {
    /// An empty copy.
    pub fn new(namespace: Namespace) -> Self {
        Self { namespace, set: RecordSet::default(), replaced: HashSet::new() }
    }

    /// Where the next batch should begin.
    pub fn position(&self) -> u64 {
        self.set.position() as u64
    }

    /// All records with their levels, in the order of the log.
    pub fn log(&self) -> &[(Tag, Irradiance)] {
        self.set.since(0)
    }

    /// Takes a batch of the subscription whose first record stands at `position`; says where the next one begins. What
    /// is known already is skipped.
    ///
    /// # Errors
    /// A batch that is malformed, of another namespace, or leaves a gap; nothing of it is used.
    pub fn apply(&mut self, position: u64, batch: &v1::RecordBatch) -> Result<u64, ReplicaError> {
        let (namespace, tag, records) =
            convert::unpack::<Irradiance>(batch).map_err(|e| ReplicaError::Malformed(e.to_string()))?;
        if namespace != self.namespace {
            return Err(ReplicaError::Malformed("it is of another namespace".into()));
        }
        let Some(known) = self.position().checked_sub(position) else {
            return Err(ReplicaError::Gap { expected: self.position(), got: position });
        };
        for record in records.into_iter().skip(usize::try_from(known).unwrap_or(usize::MAX)) {
            let at = self.set.position();
            match self.set.insert(tag, record) {
                Inserted::Added => {}
                Inserted::Replaced => drop(self.replaced.insert(at)),
                Inserted::Known => return Err(ReplicaError::Repeated(at as u64)),
            }
        }
        Ok(self.position())
    }

    /// What caches that were sealed at position `from` need to be sealed at `to`.
    ///
    /// # Errors
    /// [`ReplicaError::Outdated`] when `to` lies before `from`, [`ReplicaError::Behind`] when it has not arrived.
    pub fn part(&self, from: u64, to: u64) -> Result<Part, ReplicaError> {
        if to < from {
            return Err(ReplicaError::Outdated { asked: to, sealed: from });
        }
        if to > self.position() {
            return Err(ReplicaError::Behind { asked: to, have: self.position() });
        }
        // Both are at most the log's length.
        let range = from as usize..to as usize;
        // A sealed cache can only grow, and what was replaced may be in one.
        let anew = range.clone().any(|at| self.replaced.contains(&at));
        let records = if anew { latest(&self.log()[..range.end]) } else { self.log()[range].to_vec() };
        Ok(Part { to, anew, records })
    }
}

/// Records to add to sealed caches.
#[derive(Clone, Debug)]
pub struct Part {
    to: u64,
    /// These are all records: start from empty caches.
    anew: bool,
    records: Vec<(Tag, Irradiance)>,
}

/// The caches of one frame, sealed from a prefix of its namespace's log.
///
/// Frames that share a namespace share its [`Replica`], but each has its own caches: their steps read different
/// prefixes at the same time.
///
/// Invariant: the caches are made of the log below `position` and of nothing after.
pub struct Caches {
    a: f32,
    levels: Levels,
    position: u64,
    digest: Digest,
}

impl Caches {
    /// Empty caches that count with the allowed error `a`, one for each of `levels` levels. Records of deeper levels,
    /// which another client may have shared, go into none.
    pub fn new(a: f32, levels: u32) -> Self {
        let levels = (0..levels).map(|_| Arc::new(Sealed::new(a))).collect();
        Self { a, levels, position: 0, digest: Digest::default() }
    }

    /// Up to where the log is in the caches.
    pub fn position(&self) -> u64 {
        self.position
    }

    /// Adds a part of the log that begins at [`Self::position`]; all records up to its end must have `digest`.
    ///
    /// # Errors
    /// [`ReplicaError::Digest`]; nothing changes then.
    pub fn seal(&mut self, part: &Part, digest: Digest) -> Result<Levels, ReplicaError> {
        let mut united = if part.anew { Digest::default() } else { self.digest };
        for (_, record) in &part.records {
            united.add(record.id);
        }
        if united != digest {
            return Err(ReplicaError::Digest { position: part.to, got: united.0, expected: digest.0 });
        }
        if part.anew {
            self.levels.fill_with(|| Arc::new(Sealed::new(self.a)));
        }
        for (level, sealed) in (1..).zip(&mut self.levels) {
            let of_level: Vec<_> = part.records.iter().filter(|(t, _)| t.level == level).map(|(_, r)| *r).collect();
            if !of_level.is_empty() {
                Arc::make_mut(sealed).extend(of_level);
            }
        }
        (self.position, self.digest) = (part.to, united);
        Ok(self.levels.clone())
    }
}

/// Each id's last entry in a piece of the log, which is the one that counts.
fn latest(log: &[(Tag, Irradiance)]) -> Vec<(Tag, Irradiance)> {
    let last: HashMap<RecordId, usize> = log.iter().enumerate().map(|(at, (_, r))| (r.id, at)).collect();
    log.iter().enumerate().filter(|(at, (_, r))| last[&r.id] == *at).map(|(_, entry)| *entry).collect()
}

#[cfg(test)]
mod tests {
    use cache_core::Query;
    use glam::{Vec2, Vec3};
    use proptest::prelude::*;

    use super::*;

    const NAMESPACE: Namespace = Namespace([7; 32]);

    /// Few ids, so that replacements are common; the same level for an id mostly.
    fn entries() -> impl Strategy<Value = Vec<(Tag, Irradiance)>> {
        let one =
            (0u128..24, 1u32..4, prop::array::uniform3(0f32..2.0), 0.2f32..2.0).prop_map(|(id, level, p, radius)| {
                let record = Irradiance {
                    id: RecordId(id << 64 | id),
                    position: Vec3::from(p),
                    normal: Vec3::Z,
                    radius,
                    radius_min: 0.1,
                    radius_max: 3.0,
                    irradiance: Vec3::from(p) + 1.0,
                    gradient_t: [Vec2::ZERO; 3],
                    gradient_r: [Vec2::ZERO; 3],
                };
                (Tag::level(level), record)
            });
        prop::collection::vec(one, 1..40)
    }

    /// The server's side: its log and the digest of every prefix.
    fn server(entries: &[(Tag, Irradiance)]) -> (Vec<(Tag, Irradiance)>, Vec<Digest>) {
        let (mut set, mut digests) = (RecordSet::default(), vec![Digest::default()]);
        for (tag, record) in entries {
            if set.insert(*tag, *record) != Inserted::Known {
                digests.push(set.digest());
            }
        }
        (set.since(0).to_vec(), digests)
    }

    fn feed(replica: &mut Replica, log: &[(Tag, Irradiance)], from: usize) {
        for (at, (tag, record)) in log.iter().enumerate().skip(from) {
            replica.apply(at as u64, &convert::pack(&NAMESPACE, *tag, [record])).expect("sound batch");
        }
    }

    /// Bits of the answers of both levels on a grid of points.
    fn answers(levels: &Levels) -> Vec<Option<[u32; 3]>> {
        let points = (0..27).map(|i| Vec3::new((i % 3) as f32, (i / 3 % 3) as f32, (i / 9) as f32) * 0.9);
        points
            .flat_map(|position| {
                let query = Query { position, normal: Vec3::Z };
                levels.iter().map(move |l| l.ask(&query).map(|a| a.irradiance.to_array().map(f32::to_bits)))
            })
            .collect()
    }

    proptest! {
        /// However much of the log arrived, in whatever steps it was sealed before: the caches are those of the prefix.
        #[test]
        fn caches_are_exactly_those_of_the_prefix(entries in entries(), cuts in prop::collection::vec(0usize..40, 0..5), end in 0usize..40) {
            let (log, digests) = server(&entries);
            let end = end.min(log.len());
            let mut steps: Vec<_> = cuts.into_iter().map(|c| c.min(end)).collect();
            steps.sort_unstable();
            steps.push(end);

            let (mut lived, mut caches) = (Replica::new(NAMESPACE), Caches::new(0.8, 2));
            feed(&mut lived, &log, 0);
            let mut last = Levels::new();
            for step in steps {
                let part = lived.part(caches.position(), step as u64).expect("arrived");
                last = caches.seal(&part, digests[step]).expect("same records");
            }
            let mut expected: Levels = (0..2).map(|_| Arc::new(Sealed::new(0.8))).collect();
            for (tag, record) in latest(&log[..end]) {
                if let Some(sealed) = expected.get_mut(tag.level as usize - 1) {
                    Arc::make_mut(sealed).extend([record]);
                }
            }
            prop_assert_eq!(answers(&last), answers(&expected));
            let counts = |levels: &Levels| levels.iter().map(|l| (l.len(), l.digest())).collect::<Vec<_>>();
            prop_assert_eq!(counts(&last), counts(&expected));
        }

        /// Batches that come again, whole or in part, change nothing.
        #[test]
        fn repeated_batches_are_skipped(entries in entries(), again in 0usize..40) {
            let (log, digests) = server(&entries);
            let mut replica = Replica::new(NAMESPACE);
            feed(&mut replica, &log, 0);
            feed(&mut replica, &log, again.min(log.len()));
            prop_assert_eq!(replica.position(), log.len() as u64);
            let part = replica.part(0, replica.position()).expect("arrived");
            prop_assert!(Caches::new(0.8, 2).seal(&part, digests[log.len()]).is_ok());
        }
    }

    #[test]
    fn what_cannot_be_right_is_refused_and_changes_nothing() {
        let record = |id: u128| Irradiance {
            id: RecordId(id),
            position: Vec3::ZERO,
            normal: Vec3::Z,
            radius: 1.0,
            radius_min: 0.1,
            radius_max: 3.0,
            irradiance: Vec3::ONE,
            gradient_t: [Vec2::ZERO; 3],
            gradient_r: [Vec2::ZERO; 3],
        };
        let batch = |id| convert::pack(&NAMESPACE, Tag::level(1), [&record(id)]);
        let mut replica = Replica::new(NAMESPACE);
        assert_eq!(replica.apply(1, &batch(5)), Err(ReplicaError::Gap { expected: 0, got: 1 }));
        let foreign = convert::pack(&Namespace([8; 32]), Tag::level(1), [&record(5)]);
        assert!(replica.apply(0, &foreign).expect_err("foreign").to_string().contains("another namespace"));
        assert_eq!(replica.apply(0, &batch(5)), Ok(1));
        assert_eq!(replica.apply(1, &batch(5)), Err(ReplicaError::Repeated(1)));
        assert_eq!(replica.apply(1, &batch(6)), Ok(2));

        let mut caches = Caches::new(0.3, 2);
        let mut ask = |position, digest| {
            let part = replica.part(caches.position(), position).map_err(|e| e.to_string())?;
            caches.seal(&part, Digest(digest)).map(|l| l[0].len()).map_err(|e| e.to_string())
        };
        assert_eq!(ask(3, 11), Err("position 3 has not arrived, the log ends at 2".into()));
        let mismatch = ask(1, 4).expect_err("mismatch");
        assert!(mismatch.starts_with("records up to position 1 have digest 0000"), "{mismatch}");
        assert_eq!(ask(1, 5), Ok(1));
        assert_eq!(ask(2, 11), Ok(2));
        assert_eq!(ask(2, 11), Ok(2));
        assert!(ask(1, 5).expect_err("zombie").starts_with("lease outdated"));
    }
}
