//! Reads a journal without writing to it: neither a crash nor damage keeps what is sound from being read, and nothing is
//! mended.

use std::fs::{File, TryLockError};
use std::io;
use std::path::Path;

use cache_proto::v1::Entry;

use super::disk::{self, FILE, LOCK, Wrong};
use super::recovery::{OpenError, contained};
use super::salvage::{self, Found, Gaps};
use super::value;

/// A journal that is only read. No process writes to it meanwhile.
pub struct Survey {
    file: File,
    found: Found,
    /// Size of its file in bytes.
    pub bytes: u64,
    /// How it was left.
    pub state: State,
    _lock: Option<File>,
}

/// How a journal was left.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum State {
    /// As it should be.
    Closed,
    /// By a process that was killed: whole, but for an append nobody was told is kept.
    Crashed,
    /// Its bytes are not those that were written.
    Damaged {
        /// How that shows.
        reason: String,
        /// What is missing before the last append that can be read; whether there were more cannot be known.
        gaps: Gaps,
    },
}

impl Survey {
    /// Looks through the journal in a directory.
    ///
    /// # Errors
    /// [`OpenError`].
    pub fn open(directory: &Path) -> Result<Self, OpenError> {
        let path = directory.join(FILE);
        let failed = |error: io::Error| OpenError::File { path: path.clone(), error };
        let lock = lock(directory)?;
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Err(OpenError::Absent(directory.into())),
            Err(error) => return Err(failed(error)),
        };
        let bytes = file.metadata().map_err(failed)?.len();
        if !salvage::ours(&file).map_err(failed)? {
            return Err(OpenError::Foreign(path));
        }
        let found = Found::scan(&file).map_err(failed)?;
        let gaps = found.gaps();
        let newer = |format| OpenError::Newer { path: path.clone(), found: format };
        if let (Some(format), true) = (found.newer, found.values.is_empty()) {
            return Err(newer(format));
        }
        let read = contained(|| disk::open_read_only(&path).map(|database| disk::read(&database, |_, _| true)));
        let state = match read {
            _ if bytes == 0 => State::Closed,
            Ok(Ok(Ok(_))) if gaps == Gaps::default() => State::Closed,
            Ok(Err(redb::Error::RepairAborted)) if gaps == Gaps::default() => State::Crashed,
            Ok(Ok(Err(Wrong::Newer(format)))) => return Err(newer(format)),
            Ok(Ok(Err(Wrong::Damaged(reason)))) | Err(reason) => State::Damaged { reason, gaps },
            Ok(Err(error)) => State::Damaged { reason: error.to_string(), gaps },
            Ok(Ok(Ok(_))) => State::Damaged { reason: "appends are missing".into(), gaps },
        };
        Ok(Self { file, found, bytes, state, _lock: lock })
    }

    /// Calls `each` with every entry that can be read, in the order they were appended.
    ///
    /// # Errors
    /// When the file cannot be read, or the first error of `each`, with the number of the append it is in.
    pub fn replay(&self, each: &mut dyn FnMut(Entry) -> io::Result<()>) -> io::Result<()> {
        for (at, header) in &self.found.values {
            let payload = salvage::payload(&self.file, *at, header)?;
            value::entries(&payload)
                .try_for_each(|entry| each(entry.map_err(io::Error::other)?))
                .map_err(|error| io::Error::other(format!("append {}: {error}", header.sequence)))?;
        }
        Ok(())
    }
}

/// Keeps writers away, if there ever was one: nothing is made here, so that what cannot be written to can be read.
fn lock(directory: &Path) -> Result<Option<File>, OpenError> {
    let file = match File::open(directory.join(LOCK)) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(OpenError::Directory { directory: directory.into(), error }),
    };
    match file.try_lock_shared() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Err(OpenError::InUse(directory.into())),
        Err(TryLockError::Error(error)) => Err(OpenError::Directory { directory: directory.into(), error }),
    }
}
