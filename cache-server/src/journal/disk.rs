//! The journal on disk: a redb file of one value per append, each sealed (see [`super::value`]).
//!
//! An append is one transaction, so it is there whole or not at all; when it returned it is on the device. A file that
//! is not as it was written is found out when it is opened: [`super::recovery`] then makes a sound one of what is left.

use std::fs::{File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};

use cache_proto::v1::Entry;
use redb::{Database, ReadableDatabase as _, ReadableTable as _, ReadableTableMetadata as _, TableDefinition};

use super::Journal;
use super::device::{Device, Sync, Undo};
use super::recovery::{self, OpenError, Report};
use super::value::{self, FORMAT, MAGIC, Place};

/// Name of the file in its directory.
pub const FILE: &str = "journal.redb";

/// Name of the file whose lock says that a process uses the directory.
pub(super) const LOCK: &str = "journal.lock";

/// Memory redb may keep pages in, bytes: a few of the largest values that are usual. A journal is read once, and pages
/// kept after they are written are memory that the next do not use again.
const CACHE_BYTES: usize = 16 << 20;

/// Sealed appends by their sequence number.
const VALUES: TableDefinition<u64, &[u8]> = TableDefinition::new("values");

/// One row: [`MAGIC`] to the journal's format. It makes even an empty journal's file known as one.
const FORMATS: TableDefinition<&[u8], u32> = TableDefinition::new("format");

/// A journal in a directory.
pub struct Disk {
    path: PathBuf,
    sync: Sync,
    /// `None` after a failure: redb takes nothing more until it is opened again.
    database: Option<Database>,
    next: Place,
    /// Where values are sealed.
    value: Vec<u8>,
    _lock: File,
}

/// What is wrong with a file that redb has opened.
pub(super) enum Wrong {
    /// Its bytes are not those that were written.
    Damaged(String),
    /// The journal's format is newer than this build's.
    Newer(u32),
}

impl Disk {
    /// Opens the journal in `directory`, which is made if it is not there, repairing it if need be. Every value's
    /// checksum is checked.
    ///
    /// # Errors
    /// [`OpenError`]; the directory is as it was then.
    pub fn open(directory: &Path, sync: Sync) -> Result<(Self, Report), OpenError> {
        let lock = lock(directory)?;
        let path = directory.join(FILE);
        let (database, next, report) = recovery::open(&path, sync)?;
        Ok((Self { path, sync, database: Some(database), next, value: Vec::new(), _lock: lock }, report))
    }

    /// The database, opened again if an append failed.
    fn database(&mut self) -> io::Result<&Database> {
        if self.database.is_none() {
            let database = open(&self.path, self.sync, Undo::default()).map_err(plain)?;
            let next = last(&database).map_err(plain)?;
            if next.sequence < self.next.sequence {
                let (there, kept) = (next.sequence, self.next.sequence);
                return Err(io::Error::other(format!("it holds {there} appends, {kept} were kept")));
            }
            // More than was thought kept: the append that failed had got through. Keeping it does no harm.
            self.next = next;
            self.database = Some(database);
        }
        self.database.as_ref().ok_or_else(|| io::Error::other("closed"))
    }
}

impl Journal for Disk {
    fn append(&mut self, entries: &[Entry]) -> io::Result<()> {
        let groups = value::split(entries)?;
        self.database()?;
        let (mut next, mut value) = (self.next, std::mem::take(&mut self.value));
        let written = write(self.database()?, |table| {
            groups.into_iter().try_for_each(|group| {
                let sequence = next.sequence;
                next.seal_into(&mut value, group);
                table.insert(sequence, value.as_slice()).map(drop)
            })
        });
        self.value = value;
        match written {
            Ok(()) => self.next = next,
            Err(_) => self.database = None,
        }
        written.map_err(plain)
    }

    fn replay(&mut self, each: &mut dyn FnMut(Entry) -> io::Result<()>) -> io::Result<()> {
        let mut entries = |header: &value::Header, payload: &[u8]| {
            let at = header.sequence;
            let unsound = |e: value::Unsound| io::Error::other(format!("append {at}: {e}"));
            value::entries(payload).try_for_each(|entry| each(entry.map_err(unsound)?))
        };
        let mut failed = None;
        let read = read(self.database()?, |header, payload| {
            entries(header, payload).map_err(|error| failed = Some(error)).is_ok()
        });
        match (failed, read) {
            (Some(error), _) => Err(error),
            (None, Ok(_)) => Ok(()),
            (None, Err(Wrong::Damaged(reason))) => Err(io::Error::new(io::ErrorKind::InvalidData, reason)),
            (None, Err(Wrong::Newer(format))) => Err(io::Error::other(format!("it has format {format}"))),
        }
    }

    fn waits(&self) -> bool {
        true
    }
}

/// Opens or makes a file, checking every page redb knows of.
pub(super) fn open(path: &Path, sync: Sync, undo: Undo) -> Result<Database, redb::Error> {
    let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
    check_roots(&file)?;
    let mut builder = Database::builder();
    builder.set_cache_size(CACHE_BYTES).set_check_integrity_on_open(true);
    Ok(builder.create_with_backend(Device::new(file, sync, undo))?)
}

/// Whether the last process to use a file closed it: the flag `recovery_required` of redb's header says so (its
/// docs/design.md). An open that checks calls for a repair always, one that does not trusts whatever sizes it finds.
pub(super) fn is_closed(file: &File) -> bool {
    let mut flags = [0];
    file.read_exact_at(&mut flags, 9).is_ok() && flags[0] & 2 == 0
}

/// Refuses a file whose header names roots larger than itself: redb makes room for a page before it reads it, 8 TiB for
/// what a damaged header may say, and memory that is not there ends the process. Two slots of two roots each, and a page's
/// size as a power of two in the five highest bits of its number: redb's docs/design.md.
fn check_roots(file: &File) -> Result<(), redb::Error> {
    let (mut header, length) = ([0; 320], file.metadata()?.len());
    if length < header.len() as u64 {
        return Ok(());
    }
    file.read_exact_at(&mut header, 0)?;
    for slot in [&header[64..192], &header[192..]] {
        for highest in [slot[15], slot[47]] {
            if 4096 << (highest >> 3) > length {
                return Err(redb::Error::Corrupted("its header names pages larger than the file".into()));
            }
        }
    }
    Ok(())
}

/// Opens a file that must not be written to; [`redb::Error::RepairAborted`] says that its last process did not close it.
pub(super) fn open_read_only(path: &Path) -> Result<redb::ReadOnlyDatabase, redb::Error> {
    let file = File::open(path)?;
    check_roots(&file)?;
    let mut builder = Database::builder();
    builder.set_cache_size(CACHE_BYTES);
    Ok(builder.open_read_only_with_backend(Device::new(file, Sync::PageCache, Undo::default()))?)
}

/// Makes a new file a journal.
pub(super) fn begin(database: &Database) -> Result<(), redb::Error> {
    let transaction = database.begin_write()?;
    transaction.open_table(FORMATS)?.insert(&MAGIC[..], FORMAT)?;
    transaction.open_table(VALUES)?;
    Ok(transaction.commit()?)
}

/// Adds values in one transaction.
pub(super) fn write(
    database: &Database,
    insert: impl FnOnce(&mut redb::Table<'_, u64, &'static [u8]>) -> Result<(), redb::StorageError>,
) -> Result<(), redb::Error> {
    let transaction = database.begin_write()?;
    insert(&mut transaction.open_table(VALUES)?)?;
    Ok(transaction.commit()?)
}

/// Reads and checks all values, until `each` says false; returns the place behind the last.
pub(super) fn read(
    database: &impl redb::ReadableDatabase,
    mut each: impl FnMut(&value::Header, &[u8]) -> bool,
) -> Result<Place, Wrong> {
    let damaged = |error: redb::Error| Wrong::Damaged(error.to_string());
    let transaction = database.begin_read().map_err(|e| damaged(e.into()))?;
    let formats = transaction.open_table(FORMATS).map_err(|e| damaged(e.into()))?;
    match formats.get(&MAGIC[..]).map_err(|e| damaged(e.into()))?.map(|format| format.value()) {
        Some(FORMAT) => (),
        Some(newer) if newer > FORMAT => return Err(Wrong::Newer(newer)),
        _ => return Err(Wrong::Damaged("it does not say its format".into())),
    }
    let table = transaction.open_table(VALUES).map_err(|e| damaged(e.into()))?;
    let mut place = Place::default();
    for row in table.iter().map_err(|e| damaged(e.into()))? {
        let (key, bytes) = row.map_err(|e| damaged(e.into()))?;
        let wrong = |reason: String| Wrong::Damaged(format!("append {}: {reason}", place.sequence));
        let (header, payload) = value::open(bytes.value()).map_err(|e| wrong(e.to_string()))?;
        if !place.fits(&header) || key.value() != header.sequence {
            return Err(wrong(format!("found append {} instead", header.sequence)));
        }
        place = place.after(&header);
        if !each(&header, payload) {
            return Ok(place);
        }
    }
    let rows = table.len().map_err(|e| damaged(e.into()))?;
    if rows != place.sequence {
        return Err(Wrong::Damaged(format!("{} appends of {rows} are there", place.sequence)));
    }
    Ok(place)
}

/// The place behind the last value.
fn last(database: &Database) -> Result<Place, redb::Error> {
    let table = database.begin_read()?.open_table(VALUES)?;
    let last = table.last()?.map(|(_, bytes)| {
        let header = value::Header::read(bytes.value())?;
        Ok::<_, value::Unsound>(Place { sequence: header.sequence, before: header.before }.after(&header))
    });
    last.transpose().map(Option::unwrap_or_default).map_err(|e| redb::Error::Corrupted(e.to_string()))
}

/// Whether a journal can be opened in a directory, or the directory made. What is in it is not looked at: opening it may
/// mean to mend it.
///
/// # Errors
/// [`OpenError`].
pub fn usable(directory: &Path) -> Result<(), OpenError> {
    if directory.exists() {
        return lock(directory).map(drop);
    }
    let parent = directory.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let error = match std::fs::metadata(parent) {
        Ok(there) if there.permissions().readonly() => io::ErrorKind::PermissionDenied.into(),
        Ok(there) if !there.is_dir() => io::ErrorKind::NotADirectory.into(),
        Ok(_) => return Ok(()),
        Err(error) => error,
    };
    Err(OpenError::Directory { directory: directory.into(), error })
}

/// Takes the directory for this process, making it if it is not there.
pub(super) fn lock(directory: &Path) -> Result<File, OpenError> {
    let failed = |error: io::Error| OpenError::Directory { directory: directory.into(), error };
    match std::fs::create_dir(directory) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(failed(error)),
        _ => (),
    }
    let path = directory.join(LOCK);
    let file = OpenOptions::new().write(true).create(true).truncate(false).open(path).map_err(failed)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(OpenError::InUse(directory.into())),
        Err(TryLockError::Error(error)) => Err(failed(error)),
    }
}

/// redb's errors without its wrapping.
pub(super) fn plain(error: redb::Error) -> io::Error {
    match error {
        redb::Error::Io(error) => error,
        other => io::Error::other(other),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Makes a journal look like that of another build.
    pub(in crate::journal) fn claim_format(database: &Database, format: u32) {
        let transaction = database.begin_write().expect("writable");
        transaction.open_table(FORMATS).expect("there").insert(&MAGIC[..], format).expect("room");
        transaction.commit().expect("room");
    }
}
