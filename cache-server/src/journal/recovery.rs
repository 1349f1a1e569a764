//! Opening a file that may be anything: new, as it was left, left by a crash, damaged, or somebody else's.
//!
//! A damaged file is read by [`super::salvage`]; what is sound goes into a new file beside it, which is checked value by
//! value before it takes the place of the damaged one. The damaged one stays, under another name.

use std::fs::{self, File};
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use redb::Database;

use super::device::{Sync, Undo};
use super::disk::{self, Wrong};
use super::salvage::{self, Found, Gaps};
use super::value::{self, FORMAT, Place};

/// Values written to a repaired file in one transaction.
const VALUES_AT_ONCE: usize = 64;

/// Why there is no journal to work with.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// Another process holds it.
    #[error("{} is in use by another process", .0.display())]
    InUse(PathBuf),
    /// The file holds nothing of ours; it was not touched.
    #[error("{} is no journal of ambience; move it away, or name another directory", .0.display())]
    Foreign(PathBuf),
    /// A newer build wrote it; it was not touched.
    #[error("{} has format {found}, this build reads up to format {FORMAT}; use a newer ambience", path.display())]
    Newer {
        /// The file.
        path: PathBuf,
        /// Its format.
        found: u32,
    },
    /// The directory has no journal.
    #[error("{} holds no cache: there is no {}", .0.display(), disk::FILE)]
    Absent(PathBuf),
    /// The directory cannot be used.
    #[error("cannot use {}: {error}", directory.display())]
    Directory {
        /// Which.
        directory: PathBuf,
        /// Why.
        error: io::Error,
    },
    /// A file cannot be read or written.
    #[error("{}: {error}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        error: io::Error,
    },
}

impl OpenError {
    /// The exit code of a command that ends with this.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Foreign(_) | Self::Absent(_) | Self::Newer { .. } | Self::Directory { .. } => 2,
            Self::InUse(_) | Self::File { .. } => 1,
        }
    }
}

/// What was found when a journal was opened.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Report {
    /// Appends it holds.
    pub appends: u64,
    /// Records in them, repeats included.
    pub records: u64,
    /// After a crash: sequence number of an append that was begun and is not whole. If the crash cut it, nobody was told
    /// that it is kept.
    pub torn: Option<u64>,
    /// What was wrong with the file; it is mended.
    pub damage: Option<Damage>,
}

/// What was wrong with a file.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Damage {
    /// How it was found out.
    pub reason: String,
    /// What is lost before the last append that could be read. Whether there were more behind it cannot be known.
    pub gaps: Gaps,
    /// Sequence number of the last append that could be read.
    pub last: Option<u64>,
    /// Where the damaged file is now.
    pub kept_as: PathBuf,
}

impl std::fmt::Display for Damage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "was damaged ({}): {}", self.reason, self.gaps)?;
        match self.last {
            Some(last) => write!(f, "; whether more came after append {last} cannot be known")?,
            None => f.write_str("; nothing in it could be read")?,
        }
        write!(f, "; repaired, the damaged file is {}", self.kept_as.display())
    }
}

/// Opens a file whose directory is locked.
pub(super) fn open(path: &Path, sync: Sync) -> Result<(Database, Place, Report), OpenError> {
    let failed = |error: io::Error| OpenError::File { path: path.into(), error };
    // What a repair left that did not end.
    remove(&beside(path, "new")).map_err(failed)?;
    let known = match fs::metadata(path) {
        Ok(data) if !data.is_file() => return Err(failed(io::Error::other("is not a file"))),
        Ok(data) => data.len() > 0,
        Err(error) if error.kind() == io::ErrorKind::NotFound => false,
        Err(error) => return Err(failed(error)),
    };
    if !known {
        let database = disk::open(path, sync, Undo::default()).map_err(|e| failed(disk::plain(e)))?;
        disk::begin(&database).map_err(|e| failed(disk::plain(e)))?;
        sync_directory(path).map_err(failed)?;
        return Ok((database, Place::default(), Report::default()));
    }
    if !salvage::ours(&File::open(path).map_err(failed)?).map_err(failed)? {
        return Err(OpenError::Foreign(path.into()));
    }
    let damage = match check(path, sync)? {
        Ok(sound) => return Ok(sound),
        Err(reason) => repair(path, reason)?,
    };
    match check(path, sync)? {
        Ok((database, place, report)) => Ok((database, place, Report { damage: Some(damage), ..report })),
        Err(reason) => Err(failed(io::Error::other(format!("damaged again at once: {reason}")))),
    }
}

/// Opens a file and checks every value of it; what is wrong with it otherwise, and the file is as it was.
fn check(path: &Path, sync: Sync) -> Result<Result<(Database, Place, Report), String>, OpenError> {
    let undo = Undo::noting();
    let checked = check_noting(path, sync, &undo);
    match checked {
        Ok(Ok(_)) => undo.keep(),
        _ => undo.apply(path).map_err(|error| OpenError::File { path: path.into(), error })?,
    }
    checked
}

/// The same, with what was changed noted.
///
/// redb may go back to the append before the last. The values beyond, which lie there all the same, are added again: they
/// were sound before they were appended.
fn check_noting(path: &Path, sync: Sync, undo: &Undo) -> Result<Result<(Database, Place, Report), String>, OpenError> {
    let failed = |error: io::Error| OpenError::File { path: path.into(), error };
    let file = File::open(path).map_err(failed)?;
    // Before redb writes to it.
    let (closed, found) = (disk::is_closed(&file), Found::scan(&file).map_err(failed)?);
    let database = match contained(|| disk::open(path, sync, undo.clone())) {
        Ok(Ok(database)) => database,
        Ok(Err(redb::Error::Io(error))) if of_the_disk(&error) => return Err(failed(error)),
        Ok(Err(error)) => return Ok(Err(error.to_string())),
        Err(panic) => return Ok(Err(panic)),
    };
    let place = match contained(|| disk::read(&database, |_, _| true)) {
        Ok(Ok(place)) => place,
        Ok(Err(Wrong::Newer(found))) => return Err(OpenError::Newer { path: path.into(), found }),
        Ok(Err(Wrong::Damaged(reason))) | Err(reason) => return Ok(Err(reason)),
    };
    let torn = Some(place.sequence).filter(|next| !closed && found.broken.contains(next));
    let beyond: Vec<_> = found.values.into_iter().filter(|(_, header)| header.sequence >= place.sequence).collect();
    match contained(|| copy(&file, &beyond, &database, place)) {
        Ok(Ok(place)) => {
            let torn = torn.filter(|torn| *torn >= place.sequence);
            let report = Report { appends: place.sequence, records: place.before, torn, damage: None };
            Ok(Ok((database, place, report)))
        }
        Ok(Err(error)) => Err(failed(error)),
        Err(panic) => Ok(Err(panic)),
    }
}

/// Whether an error says nothing about the file's content.
fn of_the_disk(error: &io::Error) -> bool {
    use io::ErrorKind::{PermissionDenied, QuotaExceeded, ReadOnlyFilesystem, StorageFull};
    matches!(error.kind(), PermissionDenied | QuotaExceeded | ReadOnlyFilesystem | StorageFull)
}

/// Makes a sound file of what is left of a damaged one.
fn repair(path: &Path, reason: String) -> Result<Damage, OpenError> {
    let failed = |error: io::Error| OpenError::File { path: path.into(), error };
    let file = File::open(path).map_err(failed)?;
    let found = Found::scan(&file).map_err(failed)?;
    if let (Some(newer), true) = (found.newer, found.values.is_empty()) {
        return Err(OpenError::Newer { path: path.into(), found: newer });
    }
    let new = beside(path, "new");
    let build = || -> io::Result<()> {
        {
            let database = disk::open(&new, Sync::Device, Undo::default()).map_err(disk::plain)?;
            disk::begin(&database).map_err(disk::plain)?;
            copy(&file, &found.values, &database, Place::default())?;
        }
        // Nothing is believed that was not read back.
        let database = disk::open(&new, Sync::Device, Undo::default()).map_err(disk::plain)?;
        let mut rest = found.values.iter();
        let same = disk::read(&database, |_, read| {
            let written = rest.next().map(|(at, header)| salvage::payload(&file, *at, header));
            matches!(written, Some(Ok(written)) if written == read)
        });
        if same.is_err() || rest.next().is_some() {
            return Err(io::Error::other("the repaired file does not hold what was written to it"));
        }
        Ok(())
    };
    let kept_as = build().and_then(|()| replace(path, &new)).inspect_err(|_| drop(remove(&new))).map_err(failed)?;
    let last = found.values.last().map(|(_, header)| header.sequence);
    Ok(Damage { reason, gaps: found.gaps(), last, kept_as })
}

/// Appends values of a file to a database; returns the place behind them.
fn copy(from: &File, values: &[(u64, value::Header)], to: &Database, mut place: Place) -> io::Result<Place> {
    for chunk in values.chunks(VALUES_AT_ONCE) {
        let mut sealed = Vec::with_capacity(chunk.len());
        for (at, header) in chunk {
            let payload = salvage::payload(from, *at, header)?;
            sealed.push((place.sequence, place.seal_payload(header.records, &payload)));
        }
        let insert = |table: &mut redb::Table<'_, u64, &'static [u8]>| {
            sealed.iter().try_for_each(|(sequence, value)| table.insert(sequence, value.as_slice()).map(drop))
        };
        disk::write(to, insert).map_err(disk::plain)?;
    }
    Ok(place)
}

/// Puts a new file in the place of the old one, which stays under the name returned. There is a file of that name at
/// all times.
fn replace(path: &Path, new: &Path) -> io::Result<PathBuf> {
    File::open(new)?.sync_all()?;
    let mut number = 1;
    let kept = loop {
        let kept = beside(path, &format!("damaged-{number}"));
        match fs::hard_link(path, &kept) {
            Ok(()) => break kept,
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(error),
        }
    };
    fs::rename(new, path)?;
    sync_directory(path)?;
    Ok(kept)
}

/// Makes the names in a file's directory last.
pub(crate) fn sync_directory(path: &Path) -> io::Result<()> {
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(parent)?.sync_all()
}

fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(ending);
    name.into()
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Runs what may panic on bytes that redb did not write: it promises errors there, and this makes sure.
pub(super) fn contained<T>(work: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(work)).map_err(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
        format!("redb failed on it: {}", text.unwrap_or("unknown"))
    })
}
