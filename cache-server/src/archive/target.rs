//! Writes archives: a new cache or file is there whole or not at all; a cache that exists only grows.

use std::fs::{self, File, Permissions};
use std::io::{self, BufWriter, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use cache_proto::v1::Entry;

use super::source::Form;
use super::{Archive, ArchiveError, binary, json};
use crate::journal::Journal as _;
use crate::journal::device::Sync;
use crate::journal::disk::Disk;
use crate::journal::recovery::{Report, sync_directory};
use crate::journal::value;

/// Entries appended to a journal at once: at most half a megabyte each.
const ENTRIES_AT_ONCE: usize = 16;

/// Whether a cache may be made here.
///
/// # Errors
/// [`ArchiveError::Input`] unless the path is free or an empty directory, in a directory that is there.
pub fn free(path: &Path) -> Result<(), ArchiveError> {
    let wrong = |reason: &str| Err(ArchiveError::Input(format!("{}: {reason}", path.display())));
    match fs::read_dir(path).map(|mut content| content.next().is_some()) {
        Ok(false) => Ok(()),
        Ok(true) => wrong("is not empty; name a new directory"),
        Err(error) if error.kind() == io::ErrorKind::NotFound => match parent(path).is_dir() {
            true => Ok(()),
            false => wrong(&format!("{} is not a directory", parent(path).display())),
        },
        Err(error) => wrong(&error.to_string()),
    }
}

impl Archive {
    /// Makes a cache of it in a directory that is not there yet, or empty.
    ///
    /// # Errors
    /// [`ArchiveError`]; there is nothing new then.
    pub fn make(&self, path: &Path) -> Result<(), ArchiveError> {
        free(path)?;
        self.build(path).map_err(|error| ArchiveError::failed(path, &error))
    }

    fn build(&self, path: &Path) -> io::Result<()> {
        // As if made by mkdir: the user's umask says who may look in.
        let directory = tempfile::Builder::new()
            .prefix(".ambience-")
            .permissions(Permissions::from_mode(0o777))
            .tempdir_in(parent(path))?;
        let (mut disk, _) = Disk::open(directory.path(), Sync::Device).map_err(io::Error::other)?;
        self.append(&mut disk, Some)?;
        drop(disk);
        fs::rename(directory.path(), path)?;
        // It has another name now: there is nothing to clean up.
        let _ = directory.keep();
        sync_directory(path)
    }

    /// Adds what a cache lacks to it; makes the cache if there is none. Returns how many records were new, and how the
    /// cache was found.
    ///
    /// # Errors
    /// [`ArchiveError`]; a part may have been added then, and doing it again does no harm.
    pub fn add_to(&self, path: &Path) -> Result<(u64, Report), ArchiveError> {
        if free(path).is_ok() {
            self.make(path)?;
            let count = |set: &cache_core::RecordSet| set.len() as u64;
            return Ok((self.sets().map(|(_, set)| count(set)).sum(), Report::default()));
        }
        let failed = |error: io::Error| ArchiveError::failed(path, &error);
        if !path.join(crate::journal::disk::FILE).exists() {
            return Err(ArchiveError::Input(format!("{}: neither a cache nor an empty directory", path.display())));
        }
        let (mut disk, report) = Disk::open(path, Sync::Device)?;
        let mut held = Self::default();
        disk.replay(&mut |entry| held.apply(&entry).map_err(io::Error::other)).map_err(failed)?;
        held.settle();
        let mut added = 0;
        let lacking = |entry| held.lacks(entry).inspect(|entry| added += value::records(entry));
        self.append(&mut disk, lacking).map_err(failed)?;
        Ok((added, report))
    }

    fn append(&self, disk: &mut Disk, mut choose: impl FnMut(Entry) -> Option<Entry>) -> io::Result<()> {
        let mut waiting = Vec::with_capacity(ENTRIES_AT_ONCE);
        self.entries(&mut |entry| {
            waiting.extend(choose(entry));
            if waiting.len() == ENTRIES_AT_ONCE {
                disk.append(&waiting)?;
                waiting.clear();
            }
            Ok(())
        })?;
        disk.append(&waiting)
    }

    /// Writes it to a file, in place of the one that may be there.
    ///
    /// # Errors
    /// [`ArchiveError`]; the file is as it was then.
    pub fn export(&self, path: &Path) -> Result<(), ArchiveError> {
        let form = Form::of(path)?;
        if fs::metadata(path).is_ok_and(|data| !data.is_file()) {
            return Err(ArchiveError::Input(format!("{}: not a file", path.display())));
        }
        if !parent(path).is_dir() {
            return Err(ArchiveError::Input(format!(
                "{}: {} is not a directory",
                path.display(),
                parent(path).display()
            )));
        }
        self.write(path, form).map_err(|error| ArchiveError::failed(path, &error))
    }

    fn write(&self, path: &Path, form: Form) -> io::Result<()> {
        let file = tempfile::Builder::new()
            .prefix(".ambience-")
            .permissions(Permissions::from_mode(0o666))
            .tempfile_in(parent(path))?;
        let mut out = BufWriter::with_capacity(1 << 20, file);
        match form {
            Form::JsonLines => self.entries(&mut |entry| json::write(&mut out, &entry))?,
            Form::Binary => {
                let mut writer = binary::Writer::new(&mut out);
                self.entries(&mut |entry| writer.entry(entry))?;
                writer.end()?;
            }
        }
        out.flush()?;
        let file = out.into_inner().map_err(|error| error.into_error())?;
        file.as_file().sync_all()?;
        let _: File = file.persist(path).map_err(|error| error.error)?;
        sync_directory(path)
    }
}

fn parent(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}
