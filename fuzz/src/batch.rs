use std::collections::{BTreeMap, BTreeSet};

use cache_core::set::Sum;
use cache_core::{Irradiance, Namespace, Record, RecordId, Shrink, Tag};
use cache_proto::convert::{self, Checked};
use cache_proto::v1;
use cache_server::journal::value;
use cache_server::limits::Limits;
use cache_server::replica::Replica;
use glam::{Vec2, Vec3};
use prost::Message as _;

use super::{byte, pieces};

const STEPS_MAX: usize = 128;

/// Small, so that every bound is reached.
fn limits() -> Limits {
    Limits { namespaces: 4, records: 24, ..Limits::default() }
}

/// What happens to a replica.
#[allow(clippy::large_enum_variant, reason = "there are few at a time")]
pub enum Step {
    Entry(Checked),
    Hold(Namespace),
    Release(Namespace),
}

/// What decodes is sound. A replica keeps its bounds whatever comes; entries amount to the same in any order and however
/// often they come.
pub fn batch(data: &[u8]) {
    if let Ok(request) = v1::InsertRequest::decode(data)
        && let Some(batch) = &request.batch
    {
        unpack(batch);
    }
    let mut steps = Vec::new();
    for (kind, bytes) in pieces(data) {
        match kind % 8 {
            0 => steps.extend(entries(bytes).into_iter().map(Step::Entry)),
            1 => steps.push(Step::Hold(namespace(byte(bytes, 0)))),
            2 => steps.push(Step::Release(namespace(byte(bytes, 0)))),
            kind => steps.extend(short(kind, bytes).map(Step::Entry)),
        }
        steps.truncate(STEPS_MAX);
    }
    bounded(&steps);
    let entries: Vec<_> =
        steps.into_iter().filter_map(|step| if let Step::Entry(entry) = step { Some(entry) } else { None }).collect();
    united(&entries);
}

/// The sound entries of a payload.
fn entries(payload: &[u8]) -> Vec<Checked> {
    let sound = |entry: v1::Entry| {
        if let Some(v1::entry::Entry::Batch(batch)) = &entry.entry {
            unpack(batch);
        }
        convert::entry(&entry).ok()
    };
    value::entries(payload).map_while(Result::ok).take(STEPS_MAX).filter_map(sound).collect()
}

fn unpack(batch: &v1::RecordBatch) {
    let Ok((namespace, tag, records)) = convert::unpack(batch) else { return };
    for record in &records {
        assert_eq!(record.check(), Ok(()));
    }
    assert!(records.is_empty() || convert::pack(&namespace, tag, &records) == *batch);
    let mut replica = worker::replica::Replica::new(namespace);
    for position in [0, 1, u64::MAX] {
        drop(replica.apply(position, batch));
    }
    assert!(replica.position() <= records.len() as u64);
}

/// One of eight, so that they meet.
fn namespace(byte: u8) -> Namespace {
    Namespace([byte % 8; 32])
}

/// An entry in a few bytes.
fn short(kind: u8, bytes: &[u8]) -> Option<Checked> {
    let [first, second] = [0, 1].map(|at| byte(bytes, at));
    match kind {
        3 => {
            let (draft, namespace) = (namespace(first), namespace(second));
            (draft != namespace).then_some(Checked::Publication { draft, namespace })
        }
        4 => {
            let draft_of = (second % 2 == 1).then(|| namespace(second >> 1));
            let label = v1::Label { seed: second.into(), ..Default::default() };
            Some(Checked::Label(namespace(first), draft_of, Box::new(label)))
        }
        _ => {
            let tag = Tag { level: 1 + u32::from(second % 4), step: (second >> 4).into() };
            let records = bytes.iter().skip(2).take(32).map(|id| record(*id)).collect();
            Some(Checked::Batch(namespace(first), tag, records))
        }
    }
}

/// Two contents for each id; every fourth is a proposal for the record before it.
fn record(byte: u8) -> Record {
    let id = |byte: u8| RecordId(u128::from(byte >> 1) << 64 | 1);
    if byte >> 1 & 3 == 3 {
        return Shrink { id: id(byte), of: id(byte - 2), a: f32::from(1 + (byte & 1)) }.into();
    }
    let record = Irradiance {
        id: id(byte),
        position: Vec3::splat((byte & 1).into()),
        normal: Vec3::Y,
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

fn bounded(steps: &[Step]) {
    let mut replica = Replica::new(limits());
    let mut holds = BTreeMap::<_, usize>::new();
    for step in steps {
        match step {
            Step::Entry(entry) => drop(replica.apply(entry.clone())),
            Step::Hold(draft) => {
                *holds.entry(*draft).or_default() += 1;
                replica.hold(*draft);
            }
            // As the server does: a frame that ends has begun.
            Step::Release(draft) => {
                if let Some(count) = holds.get_mut(draft).filter(|count| **count > 0) {
                    *count -= 1;
                    replica.release(draft);
                }
            }
        }
        let held = holds.values().filter(|count| **count > 0).count();
        let (records, namespaces) = replica.census();
        let logs = replica.namespaces().filter_map(|n| replica.set(n)).map(|set| set.position() as u64).sum::<u64>();
        assert_eq!(records, logs);
        assert!(records <= limits().records as u64, "{records} records");
        assert!(namespaces <= (limits().namespaces + held) as u64, "{namespaces} namespaces, {held} of them held");
    }
    let mut namespaces = replica.namespaces();
    assert!(namespaces.all(|n| replica.read(n, 0).is_ok_and(|first| first.is_none_or(|(count, _)| count > 0))));
}

/// What a replica of all entries holds: records by digest, labels.
fn held<'a>(entries: impl Iterator<Item = &'a Checked>) -> Vec<(Namespace, Sum, Option<v1::Label>)> {
    let mut replica = Replica::new(Limits::default());
    for entry in entries {
        replica.apply(entry.clone()).expect("room");
    }
    let content = |n: &Namespace| (*n, replica.mark(n).sum, replica.label_of(n).cloned());
    replica.namespaces().map(content).collect()
}

fn united(entries: &[Checked]) {
    let once = held(entries.iter());
    let publications = entries.iter().filter_map(|entry| match entry {
        Checked::Publication { draft, namespace } => Some((*draft, *namespace)),
        _ => None,
    });
    let publications: BTreeSet<_> = publications.collect();
    let drafts: BTreeSet<_> = publications.iter().map(|(draft, _)| *draft).collect();
    // A server publishes a draft to one namespace, which is no draft.
    let proper = drafts.len() == publications.len() && publications.iter().all(|(_, n)| !drafts.contains(n));
    if proper {
        assert_eq!(once, held(entries.iter().chain(entries)));
        assert_eq!(once, held(entries.iter().rev()));
    }
}
