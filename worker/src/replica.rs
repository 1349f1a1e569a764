//! A worker's copy of one namespace's log.

use std::collections::{BTreeMap, HashSet};

use cache_core::id::Digest;
use cache_core::set::Inserted;
use cache_core::{Namespace, Record, RecordId, RecordSet, Tag};
use cache_proto::{convert, v1};

/// Why a replica could not take a batch or give a part of its log.
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
    /// Asked for less than was sealed before: the lease is of a step long done.
    #[error("lease outdated: its step is {asked}, sealed already for step {sealed}")]
    Outdated {
        /// Step of the lease.
        asked: u32,
        /// Step the caches are sealed for.
        sealed: u32,
    },
    /// Asked for a position that has not arrived yet.
    #[error("position {asked} has not arrived, the log ends at {have}")]
    Behind {
        /// What is asked for.
        asked: u64,
        /// Where the log ends here.
        have: u64,
    },
    /// The records up to the position are not those the server means.
    #[error("records up to position {position} have digest {got:032x}, the server's have {expected:032x}")]
    Digest {
        /// Epoch of the log here.
        epoch: u64,
        /// The position.
        position: u64,
        /// Digest here.
        got: u128,
        /// Digest there.
        expected: u128,
    },
}

/// How much of a draft's log is in some caches: of the log of `epoch`, below `position`, the records of steps below
/// `step`. The default is nothing of any log.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub struct Mark {
    /// Which log: they count from 1.
    pub epoch: u64,
    /// Below which position.
    pub position: u64,
    /// Below which step.
    pub step: u32,
}

/// Records on their way from a log into caches.
#[derive(Clone, Default, Debug)]
pub struct Part {
    /// Whence they lead, with what is in the caches already.
    pub to: Mark,
    /// These are all records: the caches start over.
    pub anew: bool,
    /// The records, each id once.
    pub records: Vec<(Tag, Record)>,
}

/// A copy of a namespace's log.
///
/// Invariant: it is a prefix of the server's, entry by entry, unless the server has another log than before; then this
/// one is set aside ([`Self::set_aside`]) and the next begins.
#[derive(Clone, Debug)]
pub struct Replica {
    namespace: Namespace,
    epoch: u64,
    set: RecordSet,
    /// Positions whose record took the place of an earlier one, and the position of that one.
    replaced: BTreeMap<usize, usize>,
    /// Positions of each step's records, ascending.
    steps: BTreeMap<u32, Vec<usize>>,
}

impl Replica {
    /// An empty copy, of epoch 1.
    pub fn new(namespace: Namespace) -> Self {
        Self { namespace, epoch: 1, set: RecordSet::default(), replaced: BTreeMap::new(), steps: BTreeMap::new() }
    }

    /// Which of the logs followed so far this is.
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Where the next batch should begin.
    pub fn position(&self) -> u64 {
        self.set.position() as u64
    }

    /// Digest of all records.
    pub fn digest(&self) -> Digest {
        self.set.digest()
    }

    /// The record of an id.
    pub fn get(&self, id: RecordId) -> Option<Record> {
        self.set.get(id).map(|(_, record)| record.clone())
    }

    /// Takes a batch of the subscription whose first record stands at `position`; says where the next one begins. What
    /// is known already is skipped.
    ///
    /// # Errors
    /// A batch that is malformed, of another namespace, or leaves a gap; nothing of it is used.
    pub fn apply(&mut self, position: u64, batch: &v1::RecordBatch) -> Result<u64, ReplicaError> {
        let (namespace, tag, records) = convert::unpack(batch).map_err(|e| ReplicaError::Malformed(e.to_string()))?;
        if namespace != self.namespace {
            return Err(ReplicaError::Malformed("it is of another namespace".into()));
        }
        let Some(known) = self.position().checked_sub(position) else {
            return Err(ReplicaError::Gap { expected: self.position(), got: position });
        };
        for record in records.into_iter().skip(usize::try_from(known).unwrap_or(usize::MAX)) {
            if self.insert(tag, record) == Inserted::Known {
                return Err(ReplicaError::Repeated(self.position()));
            }
        }
        Ok(self.position())
    }

    fn insert(&mut self, tag: Tag, record: Record) -> Inserted {
        let (at, earlier) = (self.set.position(), self.set.position_of(record.id()));
        let inserted = self.set.insert(tag, record);
        if inserted != Inserted::Known {
            self.steps.entry(tag.step).or_default().push(at);
            self.replaced.extend(earlier.map(|earlier| (at, earlier)));
        }
        inserted
    }

    /// What stands at a position: records of one tag and kind, as many as fit one batch, and how many those are.
    pub fn batch(&self, position: u64) -> Option<(u64, v1::RecordBatch)> {
        let rest = self.set.since(usize::try_from(position).ok()?);
        convert::batches(&self.namespace, rest).next().map(|(count, batch)| (count as u64, batch))
    }

    /// Digest of the records below `position`, if they are here.
    pub fn digest_at(&self, position: u64) -> Option<Digest> {
        self.arrived(position).ok().map(|end| self.set.prefix(end).digest)
    }

    /// All records below `position`.
    ///
    /// # Errors
    /// [`ReplicaError::Behind`].
    pub fn prefix(&self, position: u64) -> Result<Part, ReplicaError> {
        let end = self.arrived(position)?;
        let to = Mark { epoch: self.epoch, position, step: 0 };
        Ok(Part { to, anew: true, records: self.at(end, 0..end) })
    }

    /// What caches sealed at `from` need to hold the records below `position` of steps below `step`.
    ///
    /// # Errors
    /// [`ReplicaError::Outdated`] when that is less than they hold, [`ReplicaError::Behind`] when it has not arrived.
    pub fn part(&self, from: Mark, position: u64, step: u32) -> Result<Part, ReplicaError> {
        let followed = from.epoch == self.epoch;
        if followed && (position < from.position || step < from.step) {
            return Err(ReplicaError::Outdated { asked: step, sealed: from.step });
        }
        let end = self.arrived(position)?;
        // A sealed cache can only grow, and what was replaced may be in one.
        let anew = !followed || self.replaced.range(from.position as usize..end).next().is_some();
        let from = if anew { Mark::default() } else { from };
        let begin = from.position as usize;
        let log = self.set.since(0);
        let waited =
            self.steps.range(from.step..step).flat_map(|(_, of_step)| of_step).copied().filter(|at| *at < begin);
        let came = (begin..end).filter(|at| log[*at].0.step < step);
        let to = Mark { epoch: self.epoch, position, step };
        Ok(Part { to, anew, records: self.at(end, waited.chain(came)) })
    }

    fn arrived(&self, position: u64) -> Result<usize, ReplicaError> {
        if position > self.position() {
            return Err(ReplicaError::Behind { asked: position, have: self.position() });
        }
        Ok(position as usize)
    }

    /// The entries at `positions`, but those that another one below `end` replaced.
    fn at(&self, end: usize, positions: impl Iterator<Item = usize>) -> Vec<(Tag, Record)> {
        let gone: HashSet<usize> = self.replaced.range(..end).map(|(_, earlier)| *earlier).collect();
        let log = self.set.since(0);
        positions.filter(|at| !gone.contains(at)).map(|at| log[at].clone()).collect()
    }

    /// Gives the log away, for an empty one of the next epoch.
    pub fn set_aside(&mut self) -> Self {
        let next = Self { epoch: self.epoch + 1, ..Self::new(self.namespace) };
        std::mem::replace(self, next)
    }

    /// Adds what another copy holds besides, in its order.
    pub fn unite(&mut self, other: &Self) {
        for (tag, record) in other.set.since(0) {
            self.insert(*tag, record.clone());
        }
    }

    /// The next records, from position `from` of this log on, that `other` lacks: in the order of this log, at most
    /// `most` (not 0); and where to look next. `None`: it lacks none.
    pub fn lacking(&self, other: &Self, from: usize, most: usize) -> Option<(Vec<(Tag, Record)>, usize)> {
        let (mut records, mut next) = (Vec::new(), from);
        for (at, (_, record)) in self.set.since(from).iter().enumerate().map(|(i, entry)| (from + i, entry)) {
            next = at + 1;
            // Each id where it first stood, so that prefixes hold the same ids again, with the entry that counts.
            if self.replaced.contains_key(&at) || other.set.get(record.id()).is_some() {
                continue;
            }
            records.extend(self.set.get(record.id()).cloned());
            if records.len() == most {
                break;
            }
        }
        (!records.is_empty()).then_some((records, next))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use cache_core::{Irradiance, Shrink};
    use glam::{Vec2, Vec3};
    use proptest::prelude::*;

    use super::*;

    pub(crate) const NAMESPACE: Namespace = Namespace([7; 32]);

    pub(crate) fn record(id: u128, position: Vec3, radius: f32) -> Irradiance {
        Irradiance {
            id: RecordId(id << 64 | id),
            position,
            normal: Vec3::Z,
            radius,
            radius_min: 0.1,
            radius_max: 3.0,
            irradiance: position + 1.0,
            gradient_t: [Vec2::ZERO; 3],
            gradient_r: [Vec2::ZERO; 3],
            ellipse: [0.0; 3],
            noise: 0.0,
        }
    }

    /// Few ids, so that replacements are common; steps in any order, as leftovers of an interrupted attempt are.
    pub(crate) fn entries() -> impl Strategy<Value = Vec<(Tag, Record)>> {
        let one = (0u128..24, 1u32..4, 0u32..4, prop::array::uniform3(0f32..2.0), 0.2f32..2.0, 0..3).prop_map(
            |(id, level, step, p, radius, kind)| {
                let record = record(id, Vec3::from(p), radius);
                let shrink = Shrink::new(record.id, [0.2, 0.4][(p[0] > 1.0) as usize]);
                (Tag { level, step }, if kind == 0 { shrink.into() } else { record.into() })
            },
        );
        prop::collection::vec(one, 0..40)
    }

    /// The server's log after these came.
    pub(crate) fn server(entries: &[(Tag, Record)]) -> Vec<(Tag, Record)> {
        let mut set = RecordSet::default();
        for (tag, record) in entries {
            set.insert(*tag, record.clone());
        }
        set.since(0).to_vec()
    }

    pub(crate) fn feed(replica: &mut Replica, log: &[(Tag, Record)]) {
        for (at, (tag, record)) in log.iter().enumerate() {
            replica.apply(at as u64, &convert::pack(&NAMESPACE, *tag, [record])).expect("sound batch");
        }
    }

    pub(crate) fn replica(log: &[(Tag, Record)]) -> Replica {
        let mut replica = Replica::new(NAMESPACE);
        feed(&mut replica, log);
        replica
    }

    /// Each id's last entry in a piece of the log, which is the one that counts.
    pub(crate) fn latest(log: &[(Tag, Record)]) -> Vec<(Tag, Record)> {
        let counts = |at: usize| log[at + 1..].iter().all(|(_, later)| later.id() != log[at].1.id());
        (0..log.len()).filter(|at| counts(*at)).map(|at| log[at].clone()).collect()
    }

    pub(crate) fn digest(records: &[(Tag, Record)]) -> Digest {
        let mut digest = Digest::default();
        records.iter().for_each(|(_, r)| digest.add(r.id()));
        digest
    }

    proptest! {
        /// Batches that come again, whole or in part, change nothing.
        #[test]
        fn repeated_batches_are_skipped(entries in entries(), again in 0usize..40) {
            let log = server(&entries);
            let mut replica = replica(&log);
            feed(&mut replica, &log[..again.min(log.len())]);
            prop_assert_eq!(replica.position(), log.len() as u64);
            prop_assert_eq!(replica.digest(), digest(&latest(&log)));
            let all = replica.prefix(replica.position()).expect("arrived");
            prop_assert_eq!(all.records, latest(&log));
        }

        /// Whatever the server has again by itself, and whatever comes from others between two batches: in the end it
        /// lacks nothing, and nothing is sent that it has.
        #[test]
        fn what_was_lost_comes_back(lost in entries(), has in entries(), meanwhile in entries(), most in 1usize..5) {
            let (aside, mut there) = (replica(&server(&lost)), replica(&server(&has)));
            let (mut from, mut others) = (0, meanwhile.chunks(3));
            while let Some((records, next)) = aside.lacking(&there, from, most) {
                prop_assert!((1..=most).contains(&records.len()) && next > from);
                for (tag, record) in records {
                    prop_assert_eq!(there.insert(tag, record), Inserted::Added);
                }
                for (tag, record) in others.next().unwrap_or_default() {
                    there.insert(*tag, record.clone());
                }
                from = next;
            }
            prop_assert!(aside.lacking(&there, 0, most).is_none());
            for (_, record) in &lost {
                prop_assert!(there.get(record.id()).is_some());
            }
        }

        /// An empty server gets its log back so that every prefix of the old one, thus every base, is a prefix again; of
        /// two that give back at the same time as well. Tags and contents are those that counted.
        #[test]
        fn a_log_comes_back_in_its_order(lost in entries(), shorter in 0usize..40, most in 1usize..5) {
            let log = server(&lost);
            let (aside, mut there) = (replica(&log), replica(&[]));
            let behind = replica(&log[..shorter.min(log.len())]);
            let mut from = [0; 2];
            let mut lacked = true;
            while lacked {
                lacked = false;
                // Both look before either's records arrive.
                let found = [(0, &aside), (1, &behind)].map(|(i, r)| (i, r.lacking(&there, from[i], most)));
                for (i, (records, next)) in found.into_iter().filter_map(|(i, found)| Some((i, found?))) {
                    records.iter().for_each(|(tag, record)| _ = there.insert(*tag, record.clone()));
                    (from[i], lacked) = (next, true);
                }
            }
            let prefixes: Vec<_> = (0..=there.position()).map(|p| digest(&there.prefix(p).expect("held").records)).collect();
            for end in 0..=log.len() {
                prop_assert!(prefixes.contains(&digest(&latest(&log[..end]))), "prefix of {}", end);
            }
            for (tag, record) in latest(&log) {
                prop_assert_eq!(there.set.get(record.id()), Some(&(tag, record)));
            }
        }

        /// Logs followed one after another and lost one after another: nothing of any is forgotten.
        #[test]
        fn copies_unite(one in entries(), other in entries()) {
            let (mut aside, later) = (replica(&server(&one)), replica(&server(&other)));
            aside.unite(&later);
            let both: Vec<_> = server(&one).into_iter().chain(server(&other)).collect();
            prop_assert_eq!(aside.prefix(aside.position()).expect("held").records, latest(&server(&both)));
        }
    }

    #[test]
    fn what_cannot_be_right_is_refused_and_changes_nothing() {
        let batch = |id| convert::pack(&NAMESPACE, Tag::level(1), [&record(id, Vec3::ZERO, 1.0)]);
        let mut replica = Replica::new(NAMESPACE);
        assert_eq!(replica.apply(1, &batch(5)), Err(ReplicaError::Gap { expected: 0, got: 1 }));
        let foreign = v1::RecordBatch { namespace: vec![8; 32].into(), ..batch(5) };
        assert!(replica.apply(0, &foreign).expect_err("foreign").to_string().contains("another namespace"));
        assert_eq!(replica.apply(0, &batch(5)), Ok(1));
        assert_eq!(replica.apply(1, &batch(5)), Err(ReplicaError::Repeated(1)));
        assert_eq!(replica.apply(1, &batch(6)), Ok(2));

        let reason = |part: Result<Part, ReplicaError>| part.expect_err("refused").to_string();
        assert_eq!(reason(replica.prefix(3)), "position 3 has not arrived, the log ends at 2");
        let sealed = Mark { epoch: 1, position: 2, step: 5 };
        assert_eq!(reason(replica.part(sealed, 3, 5)), "position 3 has not arrived, the log ends at 2");
        assert_eq!(reason(replica.part(sealed, 2, 4)), "lease outdated: its step is 4, sealed already for step 5");
        assert!(replica.part(sealed, 2, 5).is_ok_and(|part| !part.anew && part.records.is_empty()));
    }
}
