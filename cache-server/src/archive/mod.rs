//! Caches as files: what several of them hold together, and the forms it is written in.
//!
//! - [`Archive`]: the union of caches, in canonical order: equal archives are written as equal bytes.
//! - [`source`]: reads a cache directory or an exported file. [`target`]: writes one, whole or not at all.
//! - [`binary`]: the journal's own values, one behind another. [`json`]: one JSON object a line.

pub mod binary;
pub mod json;
pub mod source;
pub mod target;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::Path;

use cache_core::id::Digest;
use cache_core::{Namespace, Record, RecordSet, Tag};
use cache_proto::convert::{self, Checked, Malformed};
use cache_proto::v1;
use cache_proto::v1::entry::Entry as Kind;

use crate::limits::Limits;
use crate::replica::Replica;

/// Why a cache could not be read or written, in one line.
#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    /// The input is at fault: exit code 2.
    #[error("{0}")]
    Input(String),
    /// Everything else: exit code 1.
    #[error("{0}")]
    Failed(String),
}

impl ArchiveError {
    /// The exit code of a command that ends with this.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Input(_) => 2,
            Self::Failed(_) => 1,
        }
    }

    fn failed(path: &Path, error: &io::Error) -> Self {
        Self::Failed(format!("{}: {error}", path.display()))
    }
}

/// What is known of one namespace.
#[derive(Clone, PartialEq, Debug)]
pub struct Summary {
    /// Which.
    pub namespace: Namespace,
    /// What it is.
    pub label: Option<v1::Label>,
    /// For a draft that was not published: whose.
    pub draft_of: Option<Namespace>,
    /// How many records, by level.
    pub levels: BTreeMap<u32, u64>,
    /// Order-free digest of the records.
    pub digest: Digest,
    /// Records that came twice with different content.
    pub conflicts: u64,
}

/// What entries amount to, whatever their order and however often they come.
#[derive(Debug)]
pub struct Archive {
    replica: Replica,
    /// Drafts, and the namespaces they were published to.
    publications: BTreeSet<(Namespace, Namespace)>,
}

impl Default for Archive {
    fn default() -> Self {
        let limits = Limits { namespaces: usize::MAX, records: usize::MAX, ..Limits::default() };
        Self { replica: Replica::new(limits), publications: BTreeSet::new() }
    }
}

impl Archive {
    /// Unites with an entry.
    ///
    /// # Errors
    /// What is unsound about it; nothing of it is used then.
    pub fn apply(&mut self, entry: &v1::Entry) -> Result<(), Malformed> {
        let checked = convert::entry(entry)?;
        if let Checked::Publication { draft, namespace } = checked {
            self.publications.insert((draft, namespace));
        }
        // Without limits there is always room.
        let _ = self.replica.apply(checked);
        Ok(())
    }

    /// Publishes again what was published: a replica remembers a bounded number of publications, an archive all.
    fn settle(&mut self) {
        for &(draft, namespace) in &self.publications {
            let _ = self.replica.apply(Checked::Publication { draft, namespace });
        }
    }

    /// What it holds, namespaces in byte order.
    pub fn summaries(&self) -> Vec<Summary> {
        self.sets().map(|(namespace, set)| self.summary(namespace, set)).collect()
    }

    /// Publications it holds.
    pub fn publications(&self) -> usize {
        self.publications.len()
    }

    fn summary(&self, namespace: &Namespace, set: &RecordSet) -> Summary {
        let label = self.replica.label_of(namespace).cloned();
        let draft_of = label.as_ref().and_then(|label| convert::namespace(&label.draft_of).ok());
        let mut levels = BTreeMap::new();
        for (tag, _) in held(set) {
            *levels.entry(tag.level).or_default() += 1;
        }
        let (digest, conflicts) = (set.digest(), set.conflicts());
        Summary { namespace: *namespace, label, draft_of, levels, digest, conflicts }
    }

    fn sets(&self) -> impl Iterator<Item = (&Namespace, &RecordSet)> {
        self.replica.namespaces().filter_map(|namespace| Some((namespace, self.replica.set(namespace)?)))
    }

    /// Calls `each` with entries that amount to this archive, in canonical order: namespaces in byte order, each with
    /// its label, then its records by level, step, kind and id; then the publications.
    ///
    /// # Errors
    /// The first of `each`.
    pub fn entries(&self, each: &mut dyn FnMut(v1::Entry) -> io::Result<()>) -> io::Result<()> {
        let mut each = |entry| each(v1::Entry { entry: Some(entry) });
        for (namespace, set) in self.sets() {
            if let Some(label) = self.replica.label_of(namespace) {
                each(Kind::Label(label.clone()))?;
            }
            let mut records: Vec<_> = held(set).collect();
            records.sort_by_key(|(tag, record)| (*tag, record.kind(), record.id()));
            convert::batches(namespace, &records).try_for_each(|(_, batch)| each(Kind::Batch(batch)))?;
        }
        for (draft, namespace) in &self.publications {
            let (draft, namespace) = (draft.0.to_vec().into(), namespace.0.to_vec().into());
            each(Kind::Publication(v1::Publication { draft, namespace }))?;
        }
        Ok(())
    }

    /// What of a sound entry is not here.
    fn lacks(&self, entry: v1::Entry) -> Option<v1::Entry> {
        let Ok(checked) = convert::entry(&entry) else { return None };
        match checked {
            Checked::Batch(namespace, tag, records) => {
                let set = self.replica.set(&namespace);
                let here = |record: &Record| {
                    set.and_then(|set| set.get(record.id()))
                        .is_some_and(|(held, known)| (*held, known) == (tag, record))
                };
                let new: Vec<_> = records.into_iter().filter(|record| !here(record)).collect();
                let batch = (!new.is_empty()).then(|| convert::pack(&namespace, tag, &new));
                batch.map(|batch| v1::Entry { entry: Some(Kind::Batch(batch)) })
            }
            Checked::Label(namespace, _, label) => {
                (self.replica.label_of(&namespace) != Some(&*label)).then_some(entry)
            }
            Checked::Publication { draft, namespace } => {
                (!self.publications.contains(&(draft, namespace))).then_some(entry)
            }
        }
    }
}

/// The records of a set, replaced ones left out.
fn held(set: &RecordSet) -> impl Iterator<Item = &(Tag, Record)> {
    set.since(0).iter().filter(|record| set.get(record.1.id()).is_some_and(|held| std::ptr::eq(held, *record)))
}

#[cfg(test)]
mod tests;
