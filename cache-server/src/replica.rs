//! The record sets of all namespaces, as logs that can be read by position. No I/O, no locks: [`crate::store`] shares it.
//!
//! It is what a list of entries amounts to, in whatever order and however often they come: every server, journal and
//! archive is read through [`Replica::apply`].

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;

use cache_core::id::Digest;
use cache_core::set::Sum;
use cache_core::{Namespace, Record, RecordSet, Tag};
use cache_proto::convert::{self, Checked};
use cache_proto::v1;
use prost::Message as _;

use crate::limits::Limits;
use crate::refusal::Refusal;

/// Published drafts remembered, so that what comes for them late still finds its namespace.
const PUBLISHED_MAX: usize = 4096;

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
    /// The records up to there; of a draft, those of the steps asked for.
    pub sum: Sum,
}

/// One namespace.
#[derive(Debug, Default)]
struct Kept {
    set: RecordSet,
    label: Option<v1::Label>,
    draft_of: Option<Namespace>,
    /// Frames that fill this draft now.
    holds: usize,
}

impl Kept {
    /// Whether anything is known of it.
    fn has_something(&self) -> bool {
        !self.set.is_empty() || self.label.is_some()
    }
}

/// A draft that was published: whose it is now, and which part of that log it is.
#[derive(Debug)]
struct Published {
    namespace: Namespace,
    range: Range<usize>,
}

/// All records this server holds.
#[derive(Debug)]
pub struct Replica {
    limits: Limits,
    kept: BTreeMap<Namespace, Kept>,
    published: BTreeMap<Namespace, Published>,
    /// Oldest first.
    publications: VecDeque<Namespace>,
    /// Sum of the logs' lengths.
    held: usize,
}

impl Replica {
    /// An empty replica.
    pub fn new(limits: Limits) -> Self {
        let (kept, published, publications) = Default::default();
        Self { limits, kept, published, publications, held: 0 }
    }

    /// Unites with an entry.
    ///
    /// # Errors
    /// [`Refusal::Full`]; nothing of the entry is used then.
    pub fn apply(&mut self, entry: Checked) -> Result<Added, Refusal> {
        match entry {
            Checked::Batch(namespace, tag, records) => self.insert(namespace, tag, &records),
            Checked::Label(namespace, draft_of, label) => {
                self.label(namespace, draft_of, *label).map(|()| Added::default())
            }
            Checked::Publication { draft, namespace } => self.publish(draft, namespace),
        }
    }

    /// Whether there is room for `count` more records of a namespace, large ones as several, should all of them be new. Makes room by giving up
    /// drafts no frame fills: they are what interrupted frames left.
    ///
    /// # Errors
    /// [`Refusal::Full`].
    pub fn admit(&mut self, namespace: &Namespace, count: usize) -> Result<(), Refusal> {
        if self.room(namespace, count).is_err() {
            let idle = |(n, kept): &(&Namespace, &Kept)| kept.draft_of.is_some() && kept.holds == 0 && *n != namespace;
            let idle: Vec<_> = self.kept.iter().filter(idle).map(|(n, _)| *n).collect();
            idle.iter().for_each(|draft| self.forget(draft));
        }
        self.room(namespace, count)
    }

    /// Gives up a namespace. Drafts published to it are drafts no more: their records are gone.
    fn forget(&mut self, namespace: &Namespace) {
        let Some(kept) = self.kept.remove(namespace) else { return };
        self.held -= kept.set.units();
        self.published.retain(|_, published| published.namespace != *namespace);
        self.publications.retain(|draft| self.published.contains_key(draft));
    }

    fn room(&self, namespace: &Namespace, count: usize) -> Result<(), Refusal> {
        if self.held + count > self.limits.records {
            return Err(Refusal::Full { what: "records", most: self.limits.records });
        }
        // What is there only because a frame holds it stays when the frame ends, as soon as it has something.
        let known = self.kept.get(namespace).is_some_and(Kept::has_something);
        if !known && self.kept.values().filter(|kept| kept.has_something()).count() >= self.limits.namespaces {
            return Err(Refusal::Full { what: "namespaces", most: self.limits.namespaces });
        }
        Ok(())
    }

    /// Unites with a batch. What is published already goes where it was published to, too.
    fn insert(&mut self, namespace: Namespace, tag: Tag, records: &[Record]) -> Result<Added, Refusal> {
        if records.is_empty() {
            return Ok(Added { added: 0, position: self.mark(&namespace).position });
        }
        let units = records.iter().map(Record::units).sum::<usize>();
        let published = self.published.get(&namespace).map(|published| published.namespace);
        if let Some(into) = published {
            let held = self.kept.contains_key(&namespace);
            self.admit(&into, 2 * units)?;
            if held {
                self.admit(&namespace, 2 * units)?;
            }
            self.unite(into, tag, records);
            if !held {
                return Ok(Added::default());
            }
        }
        self.admit(&namespace, units)?;
        Ok(self.unite(namespace, tag, records))
    }

    /// Unites with records there is room for.
    fn unite(&mut self, namespace: Namespace, tag: Tag, records: &[Record]) -> Added {
        let set = &mut self.kept.entry(namespace).or_default().set;
        let (before, known) = (set.units(), set.len());
        for id in set.extend(tag, records) {
            tracing::warn!(id = format_args!("{:032x}", { id.0 }), "a record came twice with different content");
        }
        self.held += set.units() - before;
        Added { added: (set.len() - known) as u64, position: set.position() as u64 }
    }

    /// Names a namespace. Of different labels for one, the smaller bytes stay, so that the order does not matter.
    fn label(&mut self, namespace: Namespace, draft_of: Option<Namespace>, label: v1::Label) -> Result<(), Refusal> {
        if self.published.contains_key(&namespace) && !self.kept.contains_key(&namespace) {
            return Ok(());
        }
        self.admit(&namespace, 0)?;
        let kept = self.kept.entry(namespace).or_default();
        if kept.label.as_ref().is_none_or(|known| label.encode_to_vec() < known.encode_to_vec()) {
            (kept.label, kept.draft_of) = (Some(label), draft_of);
        }
        Ok(())
    }

    /// The records of a draft belong to a namespace from now on, and so do those that come later.
    fn publish(&mut self, draft: Namespace, namespace: Namespace) -> Result<Added, Refusal> {
        let log = self.kept.get(&draft).map_or(Vec::new(), |kept| kept.set.since(0).to_vec());
        let start = self.mark(&namespace).position;
        // Nothing comes of a draft without records: limits do not count a namespace nothing is known of.
        let added = if log.is_empty() {
            Added { added: 0, position: start }
        } else {
            self.admit(&namespace, units(&log))?;
            self.copy(namespace, log)
        };
        // Said again, it brings nothing new: the first time tells which part of the log the draft is.
        if let Entry::Vacant(first) = self.published.entry(draft) {
            first.insert(Published { namespace, range: start as usize..added.position as usize });
            self.publications.push_back(draft);
            if self.publications.len() > PUBLISHED_MAX {
                self.publications.pop_front().map(|oldest| self.published.remove(&oldest));
            }
        }
        self.retire(&draft);
        Ok(added)
    }

    /// Unites with a part of a log there is room for.
    fn copy(&mut self, into: Namespace, log: Vec<(Tag, Record)>) -> Added {
        let set = &mut self.kept.entry(into).or_default().set;
        let (before, known) = (set.units(), set.len());
        for (tag, record) in log {
            set.insert(tag, record);
        }
        self.held += set.units() - before;
        Added { added: (set.len() - known) as u64, position: set.position() as u64 }
    }

    /// A frame begins to fill a draft. One that was published comes back as it was, if there is room.
    pub fn hold(&mut self, draft: Namespace) {
        let known = self.kept.contains_key(&draft);
        let again = self.published.get(&draft).filter(|_| !known).and_then(|published| {
            let log = self.kept.get(&published.namespace)?.set.since(0);
            log.get(published.range.clone()).map(<[_]>::to_vec)
        });
        let again = again.filter(|log| self.admit(&draft, units(log)).is_ok());
        self.kept.entry(draft).or_default().holds += 1;
        self.copy(draft, again.unwrap_or_default());
    }

    /// A frame has ended: a draft no other frame fills is forgotten if it was published, or nothing is known of it.
    pub fn release(&mut self, draft: &Namespace) {
        if let Some(kept) = self.kept.get_mut(draft) {
            kept.holds = kept.holds.saturating_sub(1);
        }
        self.retire(draft);
    }

    fn retire(&mut self, draft: &Namespace) {
        let Some(kept) = self.kept.get(draft).filter(|kept| kept.holds == 0) else { return };
        if self.published.contains_key(draft) || !kept.has_something() {
            self.forget(draft);
        }
    }

    /// What stands at a position of the log: records of one tag and kind, as many as fit one batch, and how many those are.
    /// `None` at the end.
    ///
    /// # Errors
    /// [`Refusal::PastEnd`], [`Refusal::Published`].
    pub fn read(&self, namespace: &Namespace, position: u64) -> Result<Option<(u64, v1::RecordBatch)>, Refusal> {
        let first = convert::batches(namespace, self.since(namespace, position)?).next();
        Ok(first.map(|(count, batch)| (count as u64, batch)))
    }

    /// The log of a namespace from a position on, in order of arrival.
    ///
    /// # Errors
    /// [`Refusal::PastEnd`], or [`Refusal::Published`] for a draft that is no more.
    pub fn since(&self, namespace: &Namespace, position: u64) -> Result<&[(Tag, Record)], Refusal> {
        let Some(kept) = self.kept.get(namespace) else {
            return match position {
                _ if self.published.contains_key(namespace) => Err(Refusal::Published),
                0 => Ok(&[]),
                asked => Err(Refusal::PastEnd { asked, end: 0 }),
            };
        };
        let end = kept.set.position() as u64;
        if position > end {
            return Err(Refusal::PastEnd { asked: position, end });
        }
        Ok(kept.set.since(position as usize))
    }

    /// Where a namespace's log stands now.
    pub fn mark(&self, namespace: &Namespace) -> Mark {
        let mark = |set: &RecordSet| Mark { position: set.position() as u64, sum: set.sum() };
        self.set(namespace).map(mark).unwrap_or_default()
    }

    /// Where a draft's log stands now, and what the steps before `step` gathered.
    pub fn mark_before(&self, draft: &Namespace, step: u32) -> Mark {
        let mark = |set: &RecordSet| Mark { position: set.position() as u64, sum: set.before(step) };
        self.set(draft).map(mark).unwrap_or_default()
    }

    /// Where a namespace's log stood when its records had this digest.
    pub fn find(&self, namespace: &Namespace, digest: Digest) -> Option<Mark> {
        if digest == Digest::default() {
            return Some(Mark::default());
        }
        let set = self.set(namespace)?;
        let position = set.find(digest)?;
        Some(Mark { position: position as u64, sum: set.prefix(position) })
    }

    /// Whether the log up to a position ends with what a frame gathered whose draft was `draft` of the digest before it: then a
    /// frame of the same view finds everything.
    pub fn is_filled(&self, namespace: &Namespace, position: u64, draft: impl Fn(Digest) -> Namespace) -> bool {
        let Some(set) = self.set(namespace) else { return false };
        let last = |published: &Published| {
            published.namespace == *namespace && published.range.end as u64 == position && !published.range.is_empty()
        };
        let mut last = self.published.iter().filter(|(_, published)| last(published));
        last.any(|(name, published)| *name == draft(set.prefix(published.range.start).digest))
    }

    /// Where a subscription begins that holds `position` records of `digest`: there, or at 0 if this log has others.
    pub fn resume(&self, namespace: &Namespace, position: u64, digest: Digest) -> u64 {
        let same = |set: &RecordSet| {
            usize::try_from(position).is_ok_and(|at| at <= set.position() && set.prefix(at).digest == digest)
        };
        if self.set(namespace).is_some_and(same) { position } else { 0 }
    }

    /// The records of one level, replaced ones left out.
    pub fn level(&self, namespace: &Namespace, level: u32) -> Vec<Record> {
        self.set(namespace).map_or(Vec::new(), |set| set.level(level).cloned().collect())
    }

    /// The records of a namespace.
    pub fn set(&self, namespace: &Namespace) -> Option<&RecordSet> {
        self.kept.get(namespace).map(|kept| &kept.set)
    }

    /// Whether anything is known of a namespace.
    pub fn is_known(&self, namespace: &Namespace) -> bool {
        self.kept.contains_key(namespace) || self.published.contains_key(namespace)
    }

    /// Whether a namespace is the draft of a frame, published or not.
    pub fn is_draft(&self, namespace: &Namespace) -> bool {
        self.kept.get(namespace).is_some_and(|kept| kept.draft_of.is_some()) || self.published.contains_key(namespace)
    }

    /// What a namespace is.
    pub fn label_of(&self, namespace: &Namespace) -> Option<&v1::Label> {
        self.kept.get(namespace)?.label.as_ref()
    }

    /// Refuses whom a namespace does not belong to. One that is not there yet belongs to who comes first; a published
    /// draft to whom its namespace belongs.
    ///
    /// # Errors
    /// [`Refusal::Foreign`].
    pub fn belongs(&self, namespace: &Namespace, tenant: &str) -> Result<(), Refusal> {
        let place = match self.kept.get(namespace) {
            Some(_) => namespace,
            None => self.published.get(namespace).map_or(namespace, |published| &published.namespace),
        };
        let owner = |kept: &Kept| kept.label.as_ref().map_or(String::new(), |label| label.owner.clone());
        match self.kept.get(place).map(owner) {
            Some(owner) if owner != tenant => Err(Refusal::Foreign(*namespace)),
            _ => Ok(()),
        }
    }

    /// The namespaces held, in byte order.
    pub fn namespaces(&self) -> impl Iterator<Item = &Namespace> {
        self.kept.keys()
    }

    /// Records in all logs, and namespaces.
    pub fn census(&self) -> (u64, u64) {
        (self.held as u64, self.kept.len() as u64)
    }

    /// What it holds for a tenant, namespaces in byte order.
    pub fn info(&self, tenant: &str) -> Vec<v1::NamespaceInfo> {
        let own = self.kept.iter().filter(|(namespace, _)| self.belongs(namespace, tenant).is_ok());
        let info = |(namespace, kept): (&Namespace, &Kept)| v1::NamespaceInfo {
            namespace: namespace.0.to_vec().into(),
            records: kept.set.len() as u64,
            digest: convert::digest_bytes(kept.set.digest()),
            conflicts: kept.set.conflicts(),
            label: kept.label.clone(),
        };
        own.map(info).collect()
    }
}

fn units(log: &[(Tag, Record)]) -> usize {
    log.iter().map(|(_, record)| record.units()).sum()
}

#[cfg(test)]
mod tests {
    use cache_core::{Irradiance, Radiance, RecordId, Shrink};
    use glam::{Vec2, Vec3};
    use proptest::prelude::*;

    use super::*;

    const NAMESPACE: Namespace = Namespace([7; 32]);

    /// Every third is a proposal.
    fn record(id: u32, x: f32) -> Record {
        if id % 3 == 2 {
            return Shrink::new(RecordId(id.into()), 0.1).into();
        }
        let record = Irradiance {
            id: RecordId(id.into()),
            position: Vec3::X * x,
            normal: Vec3::Z,
            radius: 1.0,
            radius_min: 0.1,
            radius_max: 10.0,
            irradiance: Vec3::ONE,
            gradient_t: [Vec2::ZERO; 3],
            gradient_r: [Vec2::ZERO; 3],
            ellipse: [0.0; 3],
            noise: 0.0,
        };
        record.into()
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
                let new = after.sum.records - before.sum.records;
                prop_assert_eq!((added.added, added.position), (new, after.position));
                if at % 3 == 0 {
                    follow(&near, &mut position, &mut far);
                }
            }
            follow(&near, &mut position, &mut far);
            prop_assert_eq!(near.mark(&NAMESPACE).sum, far.mark(&NAMESPACE).sum);
            for level in 1..3 {
                prop_assert_eq!(near.level(&NAMESPACE, level), far.level(&NAMESPACE, level));
            }
        }
    }

    /// A record of radiance of order 10 takes as much as 29 of irradiance.
    #[test]
    fn large_records_count_as_several() {
        let large = |id| Radiance::<100> {
            id: RecordId(id),
            position: Vec3::ZERO,
            normal: Vec3::Y,
            radius: 1.0,
            radius_min: 0.1,
            radius_max: 2.0,
            ellipse: [0.0; 3],
            noise: 0.0,
            coefficients: [[0.5; 100]; 3],
            gradient: [[[0.0; 100]; 3]; 2],
        };
        let mut replica = Replica::new(Limits { records: 60, ..Limits::default() });
        let mut insert = |id: u128| replica.insert(NAMESPACE, Tag::level(1), &[large(id).into()]);
        assert!(insert(1).is_ok() && insert(2).is_ok());
        assert!(matches!(insert(3), Err(Refusal::Full { what: "records", most: 60 })));
        assert_eq!(replica.census(), (58, 1));
        replica.insert(NAMESPACE, Tag::level(1), &[record(9, 0.0)]).expect("room for a small one");
    }

    #[test]
    fn batches_hold_one_level_and_kind_and_at_most_4096_records() {
        let mut replica = Replica::new(Limits::default());
        let records: Vec<_> = (0..5000).map(|id| record(3 * id, 0.0)).collect();
        replica.insert(NAMESPACE, Tag::level(1), &records).expect("room");
        replica.insert(NAMESPACE, Tag::level(2), &[record(15000, 0.0), record(15002, 0.0)]).expect("room");
        let read = |position| replica.read(&NAMESPACE, position);
        let count = |position| read(position).map(|read| read.map(|(count, b)| (count, b.level, b.kind)));
        assert_eq!(count(0).expect("there"), Some((4096, 1, 1)));
        assert_eq!(count(4096).expect("there"), Some((904, 1, 1)));
        assert_eq!(count(5000).expect("there"), Some((1, 2, 1)));
        assert_eq!(count(5001).expect("there"), Some((1, 2, 2)));
        assert_eq!(count(5002).expect("the end"), None);
        let error = count(5003).expect_err("past the end").to_string();
        assert!(error.contains("5003") && error.contains("5002"), "{error}");
    }

    #[test]
    fn past_the_limits_nothing_of_a_batch_is_used() {
        let mut replica = Replica::new(Limits { namespaces: 1, records: 3, ..Limits::default() });
        replica.insert(NAMESPACE, Tag::level(1), &[record(1, 0.0), record(2, 0.0)]).expect("room");
        let full = replica.insert(NAMESPACE, Tag::level(1), &[record(3, 0.0), record(4, 0.0)]);
        assert!(full.expect_err("full").to_string().contains("at most 3"));
        assert_eq!(replica.mark(&NAMESPACE).sum.records, 2);
        let full = replica.insert(Namespace([8; 32]), Tag::level(1), &[record(3, 0.0)]);
        assert!(full.expect_err("full").to_string().contains("namespaces"));
        assert_eq!(replica.insert(Namespace([9; 32]), Tag::level(1), &[]).expect("nothing"), Added::default());
    }

    const DRAFT: Namespace = Namespace([9; 32]);

    fn label(namespace: Namespace, draft_of: Option<Namespace>, owner: &str) -> Checked {
        let label = v1::Label { owner: owner.into(), ..Default::default() };
        Checked::Label(namespace, draft_of, Box::new(label))
    }

    fn gathered(step: u32, ids: Range<u32>) -> Checked {
        Checked::Batch(DRAFT, Tag { level: 1, step }, ids.map(|id| record(id, 0.0)).collect())
    }

    proptest! {
        /// Whatever order entries come in, and however often, the namespace ends with the same records.
        #[test]
        fn entries_amount_to_the_same_in_any_order(order in Just((0..6usize).collect::<Vec<_>>()).prop_shuffle(), again in 0..6usize) {
            let entries = [
                label(NAMESPACE, None, "b"),
                label(NAMESPACE, None, "a"),
                label(DRAFT, Some(NAMESPACE), "a"),
                gathered(0, 0..5),
                gathered(1, 5..7),
                Checked::Publication { draft: DRAFT, namespace: NAMESPACE },
            ];
            let mut replica = Replica::new(Limits::default());
            for at in order.into_iter().chain([again]) {
                replica.apply(entries[at].clone()).expect("room");
            }
            prop_assert_eq!(replica.mark(&NAMESPACE).sum.records, 7);
            let mut digest = Digest::default();
            (0..7).for_each(|id| digest.add(record(id, 0.0).id()));
            prop_assert_eq!(replica.mark(&NAMESPACE).sum.digest, digest);
            prop_assert_eq!(replica.label_of(&NAMESPACE).map(|l| l.owner.as_str()), Some("a"));
            prop_assert_eq!(replica.info("a").len(), 1);
            prop_assert!(replica.since(&DRAFT, 0).is_err());
        }
    }

    #[test]
    fn a_published_draft_lives_while_a_frame_holds_it_and_comes_back_as_it_was() {
        let mut replica = Replica::new(Limits::default());
        replica.apply(Checked::Batch(NAMESPACE, Tag::level(1), vec![record(50, 0.0)])).expect("room");
        replica.hold(DRAFT);
        replica.apply(gathered(0, 0..5)).expect("room");
        replica.apply(gathered(3, 5..7)).expect("room");
        let steps = |replica: &Replica| [0, 1, 3, 4].map(|step| replica.mark_before(&DRAFT, step).sum.records);
        assert_eq!(steps(&replica), [0, 5, 5, 7]);
        replica.apply(Checked::Publication { draft: DRAFT, namespace: NAMESPACE }).expect("room");
        assert_eq!((steps(&replica), replica.mark(&NAMESPACE).sum.records), ([0, 5, 5, 7], 8));
        assert_eq!(replica.census(), (15, 2));

        replica.release(&DRAFT);
        assert_eq!(replica.census(), (8, 1));
        assert!(matches!(replica.since(&DRAFT, 3), Err(Refusal::Published)));
        // A worker that was late.
        replica.apply(gathered(3, 7..9)).expect("room");
        assert_eq!((replica.mark(&NAMESPACE).sum.records, replica.census()), (10, (10, 1)));

        replica.hold(DRAFT);
        assert_eq!(steps(&replica), [0, 5, 5, 7]);
        replica.release(&DRAFT);
        assert_eq!(replica.census(), (10, 1));
    }

    #[test]
    fn drafts_nobody_fills_make_room() {
        let mut replica = Replica::new(Limits { namespaces: 2, records: 8, ..Limits::default() });
        replica.apply(label(DRAFT, Some(NAMESPACE), "")).expect("room");
        replica.apply(gathered(0, 0..5)).expect("room");
        replica.hold(DRAFT);
        let more = || Checked::Batch(NAMESPACE, Tag::level(1), (10..14).map(|id| record(id, 0.0)).collect());
        assert!(matches!(replica.apply(more()), Err(Refusal::Full { what: "records", .. })));
        replica.release(&DRAFT);
        replica.apply(more()).expect("room");
        assert_eq!(replica.census(), (4, 1));
    }

    #[test]
    fn a_subscriber_resumes_only_where_the_log_is_the_same() {
        let mut replica = Replica::new(Limits::default());
        let records: Vec<_> = [4, 1, 9].map(|id| record(id, 0.0)).to_vec();
        replica.insert(NAMESPACE, Tag::level(1), &records).expect("room");
        let resume = |position, digest| replica.resume(&NAMESPACE, position, Digest(digest));
        assert_eq!([resume(2, 5), resume(3, 14), resume(2, 13), resume(4, 14)], [2, 3, 0, 0]);
        assert_eq!(replica.find(&NAMESPACE, Digest(5)).map(|mark| mark.position), Some(2));
        assert_eq!(replica.find(&NAMESPACE, Digest(13)), None);
        assert_eq!(replica.find(&DRAFT, Digest(0)), Some(Mark::default()));
    }

    #[test]
    fn a_namespace_belongs_to_who_began_it() {
        let mut replica = Replica::new(Limits::default());
        assert!(replica.belongs(&NAMESPACE, "b").is_ok());
        replica.apply(label(NAMESPACE, None, "a")).expect("room");
        assert!(replica.belongs(&NAMESPACE, "a").is_ok());
        let refused = replica.belongs(&NAMESPACE, "b").expect_err("foreign").to_string();
        assert!(refused.contains("07070707"), "{refused}");
        assert!(replica.belongs(&NAMESPACE, "").is_err());
        replica.insert(DRAFT, Tag::level(1), &[record(1, 0.0)]).expect("room");
        assert!(replica.belongs(&DRAFT, "").is_ok() && replica.belongs(&DRAFT, "a").is_err());
        assert_eq!((replica.info("a").len(), replica.info("b").len(), replica.info("").len()), (1, 0, 1));
    }

    /// A draft of three records, published.
    fn published(limits: Limits) -> (Replica, Namespace) {
        let (mut replica, draft) = (Replica::new(limits), Namespace([1; 32]));
        replica.insert(draft, Tag::level(1), &[1, 2, 3].map(|id| record(id, 0.0))).expect("room");
        replica.publish(draft, NAMESPACE).expect("room");
        (replica, draft)
    }

    #[test]
    fn a_publication_said_again_changes_nothing() {
        let (mut replica, draft) = published(Limits::default());
        replica.publish(draft, NAMESPACE).expect("room");
        replica.hold(draft);
        assert_eq!(replica.mark(&draft).sum, replica.mark(&NAMESPACE).sum);
    }

    #[test]
    fn a_log_that_ends_with_what_a_view_gathered_is_filled_for_it() {
        let mut replica = Replica::new(Limits::default());
        let draft_of = |view: u8| move |base: Digest| NAMESPACE.draft(base, &[view]);
        let mut fill = |view, records: Vec<Record>| {
            let draft = draft_of(view)(replica.mark(&NAMESPACE).sum.digest);
            replica.insert(draft, Tag::level(1), &records).expect("room");
            replica.publish(draft, NAMESPACE).expect("room");
            [1, 2].map(|view| replica.is_filled(&NAMESPACE, replica.mark(&NAMESPACE).position, draft_of(view)))
        };
        assert_eq!(fill(1, vec![record(1, 0.0), record(2, 0.0)]), [true, false]);
        assert_eq!(fill(2, vec![record(3, 0.0)]), [false, true]);
        // Nothing came of it: what the second view lacks is not known.
        assert_eq!(fill(1, vec![]), [false, true]);
        assert!(replica.is_filled(&NAMESPACE, 2, draft_of(1)) && !replica.is_filled(&NAMESPACE, 1, draft_of(1)));
        // Records of others stand between.
        replica.insert(NAMESPACE, Tag::level(1), &[record(9, 0.0)]).expect("room");
        assert!(!replica.is_filled(&NAMESPACE, 4, draft_of(2)));
    }

    #[test]
    fn a_draft_comes_back_only_if_there_is_room() {
        let (mut replica, draft) = published(Limits { namespaces: 4, records: 6, ..Limits::default() });
        replica.insert(NAMESPACE, Tag::level(1), &[record(4, 0.0)]).expect("room");
        replica.hold(draft);
        assert_eq!((replica.mark(&draft).position, replica.census()), (0, (4, 2)));
    }

    #[test]
    fn a_draft_published_to_what_was_given_up_begins_anew() {
        let (mut replica, draft) = published(Limits { namespaces: 4, records: 8, ..Limits::default() });
        let label = v1::Label { namespace: NAMESPACE.0.to_vec().into(), ..Default::default() };
        replica.label(NAMESPACE, Some(draft), label).expect("room");
        let others = [11, 12, 13, 14, 15, 16].map(|id| record(id, 0.0));
        replica.insert(Namespace([2; 32]), Tag::level(1), &others).expect("room for the idle draft's");
        replica.insert(NAMESPACE, Tag::level(1), &[record(4, 0.0)]).expect("room");
        replica.hold(draft);
        assert_eq!((replica.mark(&draft).position, replica.census()), (0, (7, 3)));
    }

    /// Each such frame left a namespace more than there may be.
    #[test]
    fn a_frame_opened_when_all_is_full_leaves_nothing() {
        let mut replica = Replica::new(Limits { namespaces: 1, ..Limits::default() });
        replica.apply(Checked::Batch(NAMESPACE, Tag::level(1), vec![record(1, 0.0)])).expect("room");
        replica.hold(DRAFT);
        assert!(matches!(replica.apply(gathered(0, 0..5)), Err(Refusal::Full { what: "namespaces", .. })));
        replica.release(&DRAFT);
        assert_eq!(replica.census(), (1, 1));
    }

    #[test]
    fn drafts_nothing_came_of_are_forgotten() {
        let mut replica = Replica::new(Limits::default());
        for view in 0..9 {
            replica.hold(Namespace([view; 32]));
            replica.release(&Namespace([view; 32]));
        }
        assert_eq!(replica.census(), (0, 0));
    }

    #[test]
    fn what_is_refused_for_a_draft_is_not_in_its_namespace_either() {
        let mut replica = Replica::new(Limits { namespaces: 1, ..Limits::default() });
        let (draft, namespace) = (Namespace([1; 32]), Namespace([2; 32]));
        replica.insert(namespace, Tag::level(1), &[record(1, 0.0)]).expect("room");
        replica.hold(draft);
        replica.apply(Checked::Publication { draft, namespace }).expect("nothing to find room for");
        replica.insert(draft, Tag::level(1), &[record(2, 0.0)]).expect_err("a second namespace");
        assert_eq!(replica.mark(&namespace).position, 1);
    }

    /// Each such frame left a namespace that no limit counted.
    #[test]
    fn published_drafts_without_records_leave_nothing() {
        let mut replica = Replica::new(Limits { namespaces: 1, ..Limits::default() });
        for view in 0..9 {
            let (draft, namespace) = (Namespace([view; 32]), Namespace([100 + view; 32]));
            replica.hold(draft);
            replica.apply(Checked::Publication { draft, namespace }).expect("nothing to find room for");
            replica.release(&draft);
        }
        assert_eq!(replica.census(), (0, 0));
        // What comes late still finds its namespace.
        replica.insert(Namespace([3; 32]), Tag::level(1), &[record(1, 0.0)]).expect("room");
        assert_eq!(replica.mark(&Namespace([103; 32])).position, 1);
    }
}
