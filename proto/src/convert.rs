//! The only place where bytes from the wire become records, and core's steps become messages.

use std::borrow::Borrow;

use cache_core::id::Digest;
use cache_core::set::Tag;
use cache_core::{Invalid, Irradiance, Namespace, Packed as _, Record, rounds};

use crate::v1;

/// Most records in one batch.
pub const BATCH_RECORDS_MAX: usize = 4096;

/// Most bytes of them: large records are fewer.
const BATCH_BYTES_MAX: usize = BATCH_RECORDS_MAX * Irradiance::BYTES;

/// Most records of a kind in one batch; 0 for a kind this build does not know.
fn batch_max(kind: u32) -> usize {
    Record::bytes(kind).map_or(0, |size| (BATCH_BYTES_MAX / size).min(BATCH_RECORDS_MAX))
}

/// Why a message was refused.
#[derive(Debug, thiserror::Error)]
pub enum Malformed {
    /// A fixed-size field of another size.
    #[error("{field} has {got} bytes, expected {expected}")]
    Size {
        /// Which.
        field: &'static str,
        /// What there was.
        got: usize,
        /// What would have been right.
        expected: usize,
    },
    /// A message field that is absent.
    #[error("{0} is missing")]
    Missing(&'static str),
    /// Records of a kind this build does not know.
    #[error("records of kind {0}: made by a newer build?")]
    Kind(u32),
    /// A level no record can have.
    #[error("level is {0}, expected 1 to 64")]
    Level(u32),
    /// An entry that says nothing this build understands.
    #[error("entry of an unknown kind: made by a newer build?")]
    Unknown,
    /// A draft that would be published to itself.
    #[error("publication: draft and namespace are the same")]
    Itself,
    /// A text that is too long.
    #[error("{field} has {got} bytes, expected at most {most}")]
    Long {
        /// Which.
        field: &'static str,
        /// What there was.
        got: usize,
        /// What would have been right.
        most: usize,
    },
    /// A number that is none, or without end.
    #[error("{field} is {got}, expected a finite number")]
    Number {
        /// Which.
        field: &'static str,
        /// What it was.
        got: f32,
    },
    /// More records than one batch may carry.
    #[error("batch has {got} bytes of records, expected at most {most} records")]
    TooMany {
        /// Bytes there were.
        got: usize,
        /// Records there may be.
        most: usize,
    },
    /// A record that is not sound.
    #[error("record {index} of the batch: {reason}")]
    Record {
        /// Which, from 0.
        index: usize,
        /// Why.
        reason: Invalid,
    },
}

/// Reads a namespace.
///
/// # Errors
/// [`Malformed::Size`] unless there are 32 bytes.
pub fn namespace(bytes: &[u8]) -> Result<Namespace, Malformed> {
    let sized = <[u8; 32]>::try_from(bytes);
    sized.map(Namespace).map_err(|_| Malformed::Size { field: "namespace", got: bytes.len(), expected: 32 })
}

/// Reads a digest.
///
/// # Errors
/// [`Malformed::Size`] unless there are 16 bytes.
pub fn digest(bytes: &[u8]) -> Result<Digest, Malformed> {
    let sized = <[u8; 16]>::try_from(bytes);
    let sized = sized.map_err(|_| Malformed::Size { field: "digest", got: bytes.len(), expected: 16 })?;
    Ok(Digest(u128::from_le_bytes(sized)))
}

/// Packs a digest.
pub fn digest_bytes(digest: Digest) -> prost::bytes::Bytes {
    prost::bytes::Bytes::copy_from_slice(&digest.0.to_le_bytes())
}

/// Packs records of one tag and kind, all into one batch. A server accepts no more of them than [`batches`] puts into one.
pub fn pack<'a, R: Into<Record> + Clone + 'a>(
    namespace: &Namespace,
    tag: Tag,
    records: impl IntoIterator<Item = &'a R>,
) -> v1::RecordBatch {
    let mut records = records.into_iter().map(|record| -> Record { record.clone().into() }).peekable();
    let kind = records.peek().map_or(Irradiance::KIND, Record::kind);
    let mut bytes = Vec::with_capacity(records.size_hint().0 * Record::bytes(kind).unwrap_or(0));
    for record in records {
        debug_assert_eq!(record.kind(), kind);
        record.encode(&mut bytes);
    }
    v1::RecordBatch {
        namespace: prost::bytes::Bytes::copy_from_slice(&namespace.0),
        kind,
        level: tag.level,
        records: bytes.into(),
        step: tag.step,
    }
}

/// The batches that records make, in their order, and how many each holds: those of one tag and kind that follow each other,
/// as many as a server accepts.
pub fn batches<R: Borrow<(Tag, Record)>>(
    namespace: &Namespace,
    mut records: &[R],
) -> impl Iterator<Item = (usize, v1::RecordBatch)> {
    std::iter::from_fn(move || {
        let (tag, first) = records.first()?.borrow();
        let kind = first.kind();
        let alike = |entry: &&R| {
            let (other, record): &(Tag, Record) = (*entry).borrow();
            (other, record.kind()) == (tag, kind)
        };
        let count = records.iter().take(batch_max(kind)).take_while(alike).count();
        let (run, rest) = records.split_at(count);
        records = rest;
        Some((count, pack(namespace, *tag, run.iter().map(|entry| &entry.borrow().1))))
    })
}

/// Reads and checks a batch: its namespace, tag and records.
///
/// # Errors
/// The first thing that is not sound. Nothing of an unsound batch is used.
pub fn unpack(batch: &v1::RecordBatch) -> Result<(Namespace, Tag, Vec<Record>), Malformed> {
    let namespace = namespace(&batch.namespace)?;
    let size = Record::bytes(batch.kind).ok_or(Malformed::Kind(batch.kind))?;
    if !(1..=64).contains(&batch.level) {
        return Err(Malformed::Level(batch.level));
    }
    let most = batch_max(batch.kind);
    if batch.records.len() > most * size {
        return Err(Malformed::TooMany { got: batch.records.len(), most });
    }
    // Collecting results would not know how many come.
    let mut records = Vec::with_capacity(batch.records.len().div_ceil(size));
    for (index, bytes) in batch.records.chunks(size).enumerate() {
        let record = Record::decode(batch.kind, bytes).ok_or(Malformed::Kind(batch.kind))?;
        records.push(record.map_err(|reason| Malformed::Record { index, reason })?);
    }
    Ok((namespace, Tag { level: batch.level, step: batch.step }, records))
}

/// An entry of a store whose parts are sound.
#[derive(Clone, PartialEq, Debug)]
pub enum Checked {
    /// Records of a namespace.
    Batch(Namespace, Tag, Vec<Record>),
    /// What a namespace is; second, for a draft, whose.
    Label(Namespace, Option<Namespace>, Box<v1::Label>),
    /// A draft belongs to a namespace from now on.
    Publication {
        /// Whose records.
        draft: Namespace,
        /// Where they belong.
        namespace: Namespace,
    },
}

/// Reads and checks an entry.
///
/// # Errors
/// The first thing that is not sound. Nothing of an unsound entry is used.
pub fn entry(entry: &v1::Entry) -> Result<Checked, Malformed> {
    match &entry.entry {
        Some(v1::entry::Entry::Batch(batch)) => {
            let (namespace, tag, records) = unpack(batch)?;
            Ok(Checked::Batch(namespace, tag, records))
        }
        Some(v1::entry::Entry::Label(label)) => {
            for (field, text, most) in
                [("scene", &label.scene, 4096), ("method", &label.method, 64), ("owner", &label.owner, 64)]
            {
                if text.len() > most {
                    return Err(Malformed::Long { field, got: text.len(), most });
                }
            }
            if label.scene_hash.len() > 32 {
                return Err(Malformed::Long { field: "scene_hash", got: label.scene_hash.len(), most: 32 });
            }
            for (field, got) in [("a", label.a), ("rays_by_deviation", label.rays_by_deviation)] {
                if !got.is_finite() {
                    return Err(Malformed::Number { field, got });
                }
            }
            let draft_of = (!label.draft_of.is_empty()).then(|| namespace(&label.draft_of)).transpose()?;
            Ok(Checked::Label(namespace(&label.namespace)?, draft_of, Box::new(label.clone())))
        }
        Some(v1::entry::Entry::Publication(publication)) => {
            let (draft, namespace) = (namespace(&publication.draft)?, namespace(&publication.namespace)?);
            if draft == namespace { Err(Malformed::Itself) } else { Ok(Checked::Publication { draft, namespace }) }
        }
        None => Err(Malformed::Unknown),
    }
}

/// What a step of the plan looks like on the wire, sealed at a position of the namespace's log.
pub fn step(index: u32, step: &rounds::Step, sealed_position: u64, sealed_digest: Digest) -> v1::Step {
    let (level, pass, ranks) = match step {
        rounds::Step::Fill { level, pass, ranks } => (*level, *pass, ranks.clone()),
        rounds::Step::Pixels => (0, 0, 0..0),
    };
    v1::Step {
        index,
        level,
        pass,
        rank_from: ranks.start,
        rank_to: ranks.end,
        sealed_position,
        sealed_digest: digest_bytes(sealed_digest),
    }
}

/// The plan's step in a message.
pub fn plan_step(step: &v1::Step) -> rounds::Step {
    match step.level {
        0 => rounds::Step::Pixels,
        level => rounds::Step::Fill { level, pass: step.pass, ranks: step.rank_from..step.rank_to },
    }
}

#[cfg(test)]
mod tests {
    use cache_core::{Radiance, RecordId, Shrink};
    use glam::Vec3;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn random_bytes_never_panic_and_never_pass_unsound(bytes in prop::collection::vec(any::<u8>(), 0..600), kind in prop_oneof![0u32..3, 16u32..28], level in 0u32..70) {
            let batch = v1::RecordBatch { namespace: vec![0; 32].into(), kind, level, records: bytes.into(), step: 0 };
            if let Ok((namespace, tag, records)) = unpack(&batch) {
                for record in &records {
                    prop_assert!(record.check().is_ok());
                }
                prop_assert!(records.is_empty() || pack(&namespace, tag, &records) == batch);
            }
        }
    }

    #[test]
    fn what_is_wrong_with_a_batch_is_named() {
        let batch = |records: Vec<u8>| v1::RecordBatch {
            namespace: vec![0; 32].into(),
            kind: Irradiance::KIND,
            level: 1,
            records: records.into(),
            step: 0,
        };
        let message = |b: &v1::RecordBatch| unpack(b).expect_err("unsound").to_string();
        assert!(message(&batch(vec![0; 129])).starts_with("record 0 of the batch: normal"));
        assert!(message(&batch(vec![0; 4097 * 128])).contains("at most 4096"));
        assert!(message(&v1::RecordBatch { kind: 3, ..batch(vec![]) }).contains("kind 3: made by a newer build?"));
        assert!(message(&v1::RecordBatch { kind: 2, ..batch(vec![0; 4097 * 36]) }).contains("at most 4096"));
        assert!(message(&v1::RecordBatch { level: 65, ..batch(vec![]) }).contains("level is 65"));
        assert!(
            message(&v1::RecordBatch { namespace: vec![1].into(), ..batch(vec![]) }).contains("namespace has 1 bytes")
        );
    }

    /// It would not equal itself, and no line of JSON can hold it.
    #[test]
    fn a_label_has_no_number_that_is_none() {
        let label = |a, rays_by_deviation| {
            let label = v1::Label { namespace: vec![0; 32].into(), a, rays_by_deviation, ..Default::default() };
            entry(&v1::Entry { entry: Some(v1::entry::Entry::Label(label)) }).map(drop).map_err(|e| e.to_string())
        };
        assert_eq!(label(0.3, 0.0), Ok(()));
        assert_eq!(label(f32::NAN, 0.0), Err("a is NaN, expected a finite number".into()));
        assert_eq!(label(0.3, f32::INFINITY), Err("rays_by_deviation is inf, expected a finite number".into()));
    }

    /// Neither too many nor too large, in their order, whoever packs them.
    #[test]
    fn batches_are_as_large_as_a_server_accepts() {
        let large = |id| {
            let coefficients = [[0.5; 100]; 3];
            Record::from(Radiance::<100> {
                id: RecordId(id),
                position: Vec3::ZERO,
                normal: Vec3::Y,
                radius: 1.0,
                radius_min: 0.1,
                radius_max: 2.0,
                ellipse: [0.0; 3],
                noise: 0.0,
                coefficients,
                gradient: [coefficients; 2],
            })
        };
        let shrink = |id: u128| Record::from(Shrink::new(RecordId(id), 0.1));
        let mut log: Vec<_> = (0..300).map(|id| (Tag::level(1), large(id))).collect();
        log.extend((0..5000).map(|id| (Tag::level(1), shrink(id))));
        log.extend((300..302).map(|id| (Tag::level(1 + id as u32 % 2), large(id))));
        let batches: Vec<_> = batches(&Namespace([3; 32]), &log).collect();
        let counts: Vec<_> = batches.iter().map(|(count, _)| *count).collect();
        assert_eq!(counts, [142, 142, 16, 4096, 904, 1, 1]);
        let back = batches.iter().flat_map(|(_, batch)| {
            let (_, tag, records) = unpack(batch).expect("accepted");
            records.into_iter().map(move |record| (tag, record))
        });
        assert!(back.eq(log));
    }

    #[test]
    fn batches_of_every_kind_come_back() {
        let shrinks = [Shrink::new(RecordId(1), 0.1), Shrink::new(RecordId(2), 0.2)];
        let batch = pack(&Namespace([3; 32]), Tag { level: 1, step: 9 }, &shrinks);
        assert_eq!((batch.kind, batch.records.len()), (2, 72));
        let (_, tag, records) = unpack(&batch).expect("sound");
        assert_eq!((tag.step, records), (9, shrinks.map(Record::from).to_vec()));
    }
}
