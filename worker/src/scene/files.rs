//! Where the files of a scene come from: the disk, or whoever sent them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use crate::threads::lock;

/// The files of one scene, by the paths that its reader asks for. Cheap to clone.
#[derive(Clone, Default)]
pub struct Files(Arc<Source>);

#[derive(Default)]
enum Source {
    #[default]
    Disk,
    /// The disk; what is read is kept.
    Kept(Mutex<BTreeMap<PathBuf, Vec<u8>>>),
    /// Nothing of the disk is looked at: these paths are names that somebody else chose.
    Sent(BTreeMap<PathBuf, Vec<u8>>),
}

impl Files {
    /// Files of the disk that will be sent to somebody.
    pub(super) fn kept() -> Self {
        Self(Arc::new(Source::Kept(Mutex::default())))
    }

    /// Files that came from somebody.
    pub fn sent(files: BTreeMap<PathBuf, Vec<u8>>) -> Self {
        Self(Arc::new(Source::Sent(files)))
    }

    pub(super) fn into_kept(self) -> BTreeMap<PathBuf, Vec<u8>> {
        match &*self.0 {
            Source::Kept(read) => std::mem::take(&mut *lock(read)),
            _ => BTreeMap::new(),
        }
    }

    pub(super) fn has(&self, path: &Path) -> bool {
        match &*self.0 {
            Source::Disk | Source::Kept(_) => path.is_file(),
            Source::Sent(files) => files.contains_key(path),
        }
    }

    /// Only regular files: a scene must not make us wait for a pipe or read a device without end.
    pub(super) fn read(&self, path: &Path) -> Result<Vec<u8>, String> {
        if let Source::Sent(files) = &*self.0 {
            return files.get(path).cloned().ok_or_else(|| "was not sent".into());
        }
        let metadata = std::fs::metadata(path).map_err(|e| e.to_string())?;
        if !metadata.is_file() {
            return Err("not a regular file".into());
        }
        let bytes = std::fs::read(path).map_err(|e| e.to_string())?;
        if let Source::Kept(read) = &*self.0 {
            lock(read).insert(path.into(), bytes.clone());
        }
        Ok(bytes)
    }
}
