//! The file under the store, and what it means for it to have been written.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;

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
    #[cfg(test)]
    room: tests::Room,
}

impl Device {
    pub(super) fn new(file: File, sync: Sync) -> Self {
        Self {
            file,
            sync,
            #[cfg(test)]
            room: tests::ROOM.with_borrow(Clone::clone),
        }
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
        self.file.set_len(len)
    }

    fn sync_data(&self) -> io::Result<()> {
        match self.sync {
            Sync::Device => self.file.sync_data(),
            Sync::PageCache => Ok(()),
        }
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        #[cfg(test)]
        tests::take(&self.room, data.len())?;
        let used = data.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
        let used = used.next_multiple_of(BLOCK).min(data.len());
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
    use std::io;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// Bytes that can still be written before the disk is full.
    pub(crate) type Room = Arc<AtomicUsize>;

    thread_local! {
        /// The room on the disk of devices this thread opens.
        pub(crate) static ROOM: RefCell<Room> = RefCell::new(Arc::new(AtomicUsize::new(usize::MAX)));
    }

    pub(super) fn take(room: &Room, bytes: usize) -> io::Result<()> {
        let less = |room: usize| if room == usize::MAX { Some(room) } else { room.checked_sub(bytes) };
        let taken = room.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less);
        taken.map(drop).map_err(|_| io::ErrorKind::StorageFull.into())
    }
}
