//! The door to durable storage. What goes through it are the wire's own entries, so that a journal needs to know nothing
//! about records, and what comes back is checked like anything else from outside.
//!
//! - [`Nowhere`] keeps nothing; [`disk`] keeps appends in a redb file.
//! - [`value`]: one append as it lies there, recognisable by itself.
//! - [`salvage`]: finds values in the bytes of any file; [`recovery`]: opens what may be damaged, and mends it.
//! - [`survey`]: reads a journal without writing to it.
//! - [`device`]: the file under redb.

pub mod device;
pub mod disk;
pub mod recovery;
pub mod salvage;
pub mod survey;
pub mod value;

use std::io;

use cache_proto::v1::Entry;

/// Keeps entries, in order. Entries merge by union: repeats and order do no harm.
pub trait Journal: Send {
    /// Keeps sound entries. They are acknowledged, and shown to others, only after this returned.
    ///
    /// # Errors
    /// When they are not safely kept; the caller takes none of them for kept then.
    fn append(&mut self, entries: &[Entry]) -> io::Result<()>;

    /// Calls `each` with every entry kept, in the order they were appended.
    ///
    /// # Errors
    /// When the journal cannot be read, or the first error of `each`.
    fn replay(&mut self, each: &mut dyn FnMut(Entry) -> io::Result<()>) -> io::Result<()>;

    /// Whether `append` waits for a device, and must be kept off the async threads.
    fn waits(&self) -> bool;
}

/// The journal that keeps nothing: records live as long as the server's memory.
#[derive(Clone, Copy, Debug, Default)]
pub struct Nowhere;

impl Journal for Nowhere {
    fn append(&mut self, _: &[Entry]) -> io::Result<()> {
        Ok(())
    }

    fn replay(&mut self, _: &mut dyn FnMut(Entry) -> io::Result<()>) -> io::Result<()> {
        Ok(())
    }

    fn waits(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests;
