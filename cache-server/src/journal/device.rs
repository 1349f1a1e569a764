//! The file under the store, and what it means for it to have been written.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// What an append waits for.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Sync {
    /// The device: what was appended survives a power cut.
    Device,
    /// The kernel's page cache: it survives the process alone. For measuring what waiting for the device costs.
    PageCache,
}

/// redb writes pages of a power of two, of which a value may fill little more than half. The zeros behind it are not
/// written where the file has them already, in whole blocks of so many bytes.
const BLOCK: usize = 4096;

/// One file. Whoever opens it holds the directory's lock.
#[derive(Debug)]
pub(super) struct Device {
    file: File,
    sync: Sync,
    undo: Undo,
    #[cfg(test)]
    room: tests::Room,
    #[cfg(test)]
    unsynced: Option<tests::Unsynced>,
}

impl Device {
    pub(super) fn new(file: File, sync: Sync, undo: Undo) -> Self {
        Self {
            file,
            sync,
            undo,
            #[cfg(test)]
            room: tests::ROOM.with_borrow(Clone::clone),
            #[cfg(test)]
            unsynced: tests::UNSYNCED.with_borrow(Clone::clone),
        }
    }
}

/// What a file was before it was changed, for as long as nobody knows whether it is sound: redb writes to a file while it
/// is opened, and a damaged one is to be kept as it was found. What was overwritten or cut off is held in memory; a process
/// killed before it is taken back leaves the file as any crash does.
#[derive(Clone, Default, Debug)]
pub(super) struct Undo(Arc<Mutex<Option<Vec<Before>>>>);

/// A file's length, and some of its bytes, before a change.
#[derive(Clone, Debug)]
struct Before {
    length: u64,
    offset: u64,
    bytes: Vec<u8>,
}

impl Before {
    /// Of a change to `count` bytes from `offset` on, or to all behind it.
    fn of(file: &File, offset: u64, count: usize) -> io::Result<Self> {
        let length = file.metadata()?.len();
        let mut bytes = vec![0; count.min(length.saturating_sub(offset) as usize)];
        file.read_exact_at(&mut bytes, offset)?;
        Ok(Self { length, offset, bytes })
    }
}

impl Undo {
    /// One that notes every change until they are kept or taken back.
    pub(super) fn noting() -> Self {
        Self(Arc::new(Mutex::new(Some(Vec::new()))))
    }

    fn note(&self, file: &File, offset: u64, count: usize) -> io::Result<()> {
        if let Some(noted) = &mut *self.0.lock().unwrap_or_else(PoisonError::into_inner) {
            noted.push(Before::of(file, offset, count)?);
        }
        Ok(())
    }

    /// The changes stay, and no more are noted.
    pub(super) fn keep(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }

    /// Makes a file, which no device has open any more, what it was.
    pub(super) fn apply(&self, path: &Path) -> io::Result<()> {
        let noted = self.0.lock().unwrap_or_else(PoisonError::into_inner).take().unwrap_or_default();
        if noted.is_empty() {
            return Ok(());
        }
        let file = File::options().write(true).open(path)?;
        for before in noted.iter().rev() {
            file.write_all_at(&before.bytes, before.offset)?;
            file.set_len(before.length)?;
        }
        file.sync_data()
    }
}

impl redb::StorageBackend for Device {
    fn len(&self) -> io::Result<u64> {
        Ok(self.file.metadata()?.len())
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.file.read_exact_at(out, offset)
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        #[cfg(test)]
        self.unsynced.iter().try_for_each(|unsynced| unsynced.changes(&self.file, len, usize::MAX))?;
        self.undo.note(&self.file, len, usize::MAX)?;
        self.file.set_len(len)
    }

    fn sync_data(&self) -> io::Result<()> {
        match self.sync {
            Sync::Device => {
                #[cfg(test)]
                self.unsynced.iter().try_for_each(|unsynced| unsynced.synced(&self.file))?;
                self.file.sync_data()
            }
            Sync::PageCache => Ok(()),
        }
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        #[cfg(test)]
        tests::take(&self.room, data.len())?;
        #[cfg(test)]
        self.unsynced.iter().try_for_each(|unsynced| unsynced.changes(&self.file, offset, data.len()))?;
        self.undo.note(&self.file, offset, data.len())?;
        let zeros = data.rchunks(BLOCK).take_while(|block| block.iter().fold(0, |all, byte| all | byte) == 0);
        let used = data.len() - zeros.map(<[u8]>::len).sum::<usize>();
        if used < data.len() && self.is_hole(offset + used as u64, (data.len() - used) as u64) {
            return self.file.write_all_at(&data[..used], offset);
        }
        self.file.write_all_at(data, offset)
    }
}

impl Device {
    /// Whether nothing was ever written to a part of the file, so that it reads as zeros.
    #[cfg(target_os = "linux")]
    fn is_hole(&self, offset: u64, length: u64) -> bool {
        use nix::errno::Errno;
        use nix::unistd::{Whence, lseek};
        // Nobody uses the position that this moves.
        let Ok(from) = i64::try_from(offset) else { return false };
        match lseek(&self.file, from, Whence::SeekData) {
            Ok(data) => data as u64 >= offset + length,
            // No data from there to the end, which may lie before it: then what is behind has to be written.
            Err(Errno::ENXIO) => self.file.metadata().is_ok_and(|file| file.len() >= offset + length),
            Err(_) => false,
        }
    }

    #[cfg(not(target_os = "linux"))]
    fn is_hole(&self, _: u64, _: u64) -> bool {
        false
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::cell::RefCell;
    use std::fs::File;
    use std::io;
    use std::os::unix::fs::FileExt as _;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::{Arc, Mutex};

    use super::Before;

    /// Bytes that can still be written before the disk is full.
    pub(crate) type Room = Arc<AtomicUsize>;

    thread_local! {
        /// The room on the disk of devices this thread opens.
        pub(crate) static ROOM: RefCell<Room> = RefCell::new(Arc::new(AtomicUsize::new(usize::MAX)));

        /// What is noted of devices this thread opens, if anything is.
        pub(crate) static UNSYNCED: RefCell<Option<Unsynced>> = const { RefCell::new(None) };
    }

    pub(super) fn take(room: &Room, bytes: usize) -> io::Result<()> {
        let less = |room: usize| if room == usize::MAX { Some(room) } else { room.checked_sub(bytes) };
        let taken = room.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less);
        taken.map(drop).map_err(|_| io::ErrorKind::StorageFull.into())
    }

    /// What a power cut may undo: changes the device was not waited for after.
    #[derive(Clone, Default, Debug)]
    pub(crate) struct Unsynced(Arc<Mutex<Noted>>);

    #[derive(Default, Debug)]
    struct Noted {
        since: Vec<Before>,
        moments: Vec<Moment>,
    }

    /// A file as its process sees it, and what of it may not be on the device.
    #[derive(Debug)]
    pub(crate) struct Moment {
        file: Vec<u8>,
        unsynced: Vec<Before>,
    }

    impl Unsynced {
        pub(super) fn changes(&self, file: &File, offset: u64, count: usize) -> io::Result<()> {
            self.0.lock().expect("no panic").since.push(Before::of(file, offset, count)?);
            Ok(())
        }

        /// The device is about to be waited for.
        pub(super) fn synced(&self, file: &File) -> io::Result<()> {
            let moment = self.moment(file)?;
            let mut noted = self.0.lock().expect("no panic");
            noted.moments.push(moment);
            noted.since.clear();
            Ok(())
        }

        /// As it is now.
        pub(crate) fn moment(&self, file: &File) -> io::Result<Moment> {
            let mut bytes = vec![0; file.metadata()?.len() as usize];
            file.read_exact_at(&mut bytes, 0)?;
            Ok(Moment { file: bytes, unsynced: self.0.lock().expect("no panic").since.clone() })
        }

        /// Just before each wait for the device since the last call.
        pub(crate) fn take(&self) -> Vec<Moment> {
            std::mem::take(&mut self.0.lock().expect("no panic").moments)
        }
    }

    impl Moment {
        /// What is left of it when the power is cut: each change that was not waited for is there or not, as `kept` says.
        pub(crate) fn cut(&self, mut kept: impl FnMut() -> bool) -> Vec<u8> {
            let mut file = self.file.clone();
            for Before { length, offset, bytes } in self.unsynced.iter().rev().filter(|_| !kept()) {
                let end = *offset as usize + bytes.len();
                file.resize(file.len().max(end), 0);
                file[*offset as usize..end].copy_from_slice(bytes);
                if end as u64 == *length {
                    file.truncate(end);
                }
            }
            file
        }
    }
}
