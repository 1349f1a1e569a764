//! The record sets of all namespaces, as logs that can be read by position. No I/O, no locks: [`crate::store`] shares it.

use std::collections::HashMap;

use cache_core::id::Digest;
use cache_core::{Irradiance, Namespace, RecordSet, Tag, set};
use cache_proto::convert::{self, BATCH_RECORDS_MAX};
use cache_proto::v1;

use crate::refusal::Refusal;

/// Bounds of what one server keeps.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Most namespaces.
    pub namespaces: usize,
    /// Most records in all logs together; one takes about 170 bytes of memory.
    pub records: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { namespaces: 1024, records: 32 << 20 }
    }
}

/// What an insert did.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Added {
    /// Records that were new.
    pub added: u64,
    /// Length of the namespace's log afterwards.
    pub position: u64,
}

/// A state of one namespace's log.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Mark {
    /// Length of the log.
    pub position: u64,
    /// Digest of the records up to there.
    pub digest: Digest,
    /// Distinct records up to there.
    pub records: u64,
}

/// All records this server holds.
#[derive(Debug)]
pub struct Replica {
    limits: Limits,
    sets: HashMap<Namespace, RecordSet<Irradiance>>,
    /// Sum of the logs' lengths.
    held: usize,
}

impl Replica {
    /// An empty replica.
    pub fn new(limits: Limits) -> Self {
        Self { limits, sets: HashMap::new(), held: 0 }
    }

    /// Whether there is room for `count` more records of a namespace, should all of them be new.
    ///
    /// # Errors
    /// [`Refusal::Full`].
    pub fn admit(&self, namespace: &Namespace, count: usize) -> Result<(), Refusal> {
        if self.held + count > self.limits.records {
            return Err(Refusal::Full { what: "records", most: self.limits.records });
        }
        if self.sets.len() >= self.limits.namespaces && !self.sets.contains_key(namespace) {
            return Err(Refusal::Full { what: "namespaces", most: self.limits.namespaces });
        }
        Ok(())
    }

    /// Unites with a batch.
    ///
    /// # Errors
    /// [`Refusal::Full`]; nothing of the batch is used then.
    pub fn insert(&mut self, namespace: Namespace, tag: Tag, records: &[Irradiance]) -> Result<Added, Refusal> {
        if records.is_empty() {
            return Ok(Added { added: 0, position: self.mark(&namespace).position });
        }
        self.admit(&namespace, records.len())?;
        let set = self.sets.entry(namespace).or_default();
        let (before, known) = (set.position(), set.len());
        for record in records {
            let outcome = set.insert(tag, *record);
            if outcome == set::Inserted::Replaced {
                tracing::warn!(id = format_args!("{:032x}", record.id.0), "a record came twice with different content");
            }
        }
        self.held += set.position() - before;
        Ok(Added { added: (set.len() - known) as u64, position: set.position() as u64 })
    }

    /// What stands at a position of the log: records of one tag, as many as fit one batch, and how many those are.
    /// `None` at the end.
    ///
    /// # Errors
    /// [`Refusal::PastEnd`].
    pub fn read(&self, namespace: &Namespace, position: u64) -> Result<Option<(u64, v1::RecordBatch)>, Refusal> {
        let rest = self.since(namespace, position)?;
        let Some(&(tag, _)) = rest.first() else { return Ok(None) };
        let count = rest.iter().take(BATCH_RECORDS_MAX).take_while(|(t, _)| *t == tag).count();
        let run = rest[..count].iter().map(|(_, record)| record);
        Ok(Some((count as u64, convert::pack(namespace, tag, run))))
    }

    /// The log of a namespace from a position on: in order of arrival.
    ///
    /// # Errors
    /// [`Refusal::PastEnd`].
    pub fn since(&self, namespace: &Namespace, position: u64) -> Result<&[(Tag, Irradiance)], Refusal> {
        let set = self.sets.get(namespace);
        let end = set.map_or(0, RecordSet::position) as u64;
        if position > end {
            return Err(Refusal::PastEnd { asked: position, end });
        }
        Ok(set.map_or(&[], |set| set.since(position as usize)))
    }

    /// Where a namespace's log stands now.
    pub fn mark(&self, namespace: &Namespace) -> Mark {
        self.sets.get(namespace).map_or(Mark::default(), |set| Mark {
            position: set.position() as u64,
            digest: set.digest(),
            records: set.len() as u64,
        })
    }

    /// The records of one level, replaced ones left out.
    pub fn level(&self, namespace: &Namespace, level: u32) -> Vec<Irradiance> {
        self.sets.get(namespace).map_or(Vec::new(), |set| set.level(level).copied().collect())
    }

    /// What it holds, namespaces in byte order.
    pub fn info(&self) -> Vec<v1::NamespaceInfo> {
        let mut all: Vec<_> = self.sets.iter().collect();
        all.sort_by_key(|(namespace, _)| **namespace);
        let info = |(namespace, set): (&Namespace, &RecordSet<Irradiance>)| v1::NamespaceInfo {
            namespace: namespace.0.to_vec().into(),
            records: set.len() as u64,
            digest: convert::digest_bytes(set.digest()),
            conflicts: set.conflicts(),
            label: None,
        };
        all.into_iter().map(info).collect()
    }
}

#[cfg(test)]
mod tests {
    use cache_core::RecordId;
    use glam::{Vec2, Vec3};
    use proptest::prelude::*;

    use super::*;

    const NAMESPACE: Namespace = Namespace([7; 32]);

    fn record(id: u32, x: f32) -> Irradiance {
        Irradiance {
            id: RecordId(id.into()),
            position: Vec3::X * x,
            normal: Vec3::Z,
            radius: 1.0,
            radius_min: 0.1,
            radius_max: 10.0,
            irradiance: Vec3::ONE,
            gradient_t: [Vec2::ZERO; 3],
            gradient_r: [Vec2::ZERO; 3],
        }
    }

    /// Reads batches from a position to the end into another replica.
    fn follow(from: &Replica, position: &mut u64, to: &mut Replica) {
        while let Some((count, batch)) = from.read(&NAMESPACE, *position).expect("not past the end") {
            let (namespace, tag, records) = convert::unpack(&batch).expect("sound");
            assert_eq!(records.len() as u64, count);
            to.insert(namespace, tag, &records).expect("room");
            *position += count;
        }
    }

    proptest! {
        #[test]
        fn a_follower_catches_up_and_agrees(
            batches in prop::collection::vec((1..3u32, prop::collection::vec((0..40u32, 0..2u8), 0..20)), 0..12),
        ) {
            let (mut near, mut far) = (Replica::new(Limits::default()), Replica::new(Limits::default()));
            let mut position = 0;
            for (at, (level, records)) in batches.iter().enumerate() {
                let records: Vec<_> = records.iter().map(|&(id, x)| record(id, x.into())).collect();
                let before = near.mark(&NAMESPACE);
                let added = near.insert(NAMESPACE, Tag::level(*level), &records).expect("room");
                let after = near.mark(&NAMESPACE);
                prop_assert_eq!((added.added, added.position), (after.records - before.records, after.position));
                if at % 3 == 0 {
                    follow(&near, &mut position, &mut far);
                }
            }
            follow(&near, &mut position, &mut far);
            let held = |r: &Replica| (r.mark(&NAMESPACE).records, r.mark(&NAMESPACE).digest);
            prop_assert_eq!(held(&near), held(&far));
            for level in 1..3 {
                prop_assert_eq!(near.level(&NAMESPACE, level), far.level(&NAMESPACE, level));
            }
        }
    }

    #[test]
    fn batches_hold_one_level_and_at_most_4096_records() {
        let mut replica = Replica::new(Limits::default());
        let records: Vec<_> = (0..5000).map(|id| record(id, 0.0)).collect();
        replica.insert(NAMESPACE, Tag::level(1), &records).expect("room");
        replica.insert(NAMESPACE, Tag::level(2), &[record(5000, 0.0)]).expect("room");
        let count = |position| replica.read(&NAMESPACE, position).map(|read| read.map(|(count, b)| (count, b.level)));
        assert_eq!(count(0).expect("there"), Some((4096, 1)));
        assert_eq!(count(4096).expect("there"), Some((904, 1)));
        assert_eq!(count(5000).expect("there"), Some((1, 2)));
        assert_eq!(count(5001).expect("the end"), None);
        let error = count(5002).expect_err("past the end").to_string();
        assert!(error.contains("5002") && error.contains("5001"), "{error}");
    }

    #[test]
    fn past_the_limits_nothing_of_a_batch_is_used() {
        let mut replica = Replica::new(Limits { namespaces: 1, records: 3 });
        replica.insert(NAMESPACE, Tag::level(1), &[record(1, 0.0), record(2, 0.0)]).expect("room");
        let full = replica.insert(NAMESPACE, Tag::level(1), &[record(3, 0.0), record(4, 0.0)]);
        assert!(full.expect_err("full").to_string().contains("at most 3"));
        assert_eq!(replica.mark(&NAMESPACE).records, 2);
        let full = replica.insert(Namespace([8; 32]), Tag::level(1), &[record(3, 0.0)]);
        assert!(full.expect_err("full").to_string().contains("namespaces"));
        assert_eq!(replica.insert(Namespace([9; 32]), Tag::level(1), &[]).expect("nothing"), Added::default());
    }
}
