//! The door to durable storage. What goes through it is the wire's own batch, so that a journal needs to know nothing
//! about records, and what comes back is checked like anything else from outside.

use std::io;

use cache_proto::v1::RecordBatch;

/// Keeps batches of records, in order.
pub trait Journal: Send {
    /// Keeps a sound batch. The insert is acknowledged, and its records shown to others, only after this returned.
    ///
    /// # Errors
    /// When the batch is not safely kept; nothing of it is used then.
    fn append(&mut self, batch: &RecordBatch) -> io::Result<()>;

    /// Calls `each` with every batch kept, in the order they were appended.
    ///
    /// # Errors
    /// When the journal cannot be read, or the first error of `each`.
    fn replay(&mut self, each: &mut dyn FnMut(RecordBatch) -> io::Result<()>) -> io::Result<()>;
}

/// The journal that keeps nothing: records live as long as the server's memory.
#[derive(Clone, Copy, Debug, Default)]
pub struct Nowhere;

impl Journal for Nowhere {
    fn append(&mut self, _: &RecordBatch) -> io::Result<()> {
        Ok(())
    }

    fn replay(&mut self, _: &mut dyn FnMut(RecordBatch) -> io::Result<()>) -> io::Result<()> {
        Ok(())
    }
}
