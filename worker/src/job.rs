//! What a worker computes: the seam between the protocol and the work itself.
//!
//! The renderer is one such job; a simulation of a farm has another that makes records up.

use std::future::Future;
use std::ops::Range;
use std::sync::Arc;

use cache_core::{Record, RecordId};
use cache_proto::v1;

use crate::levels::Levels;
use crate::scenes::Scenes;
use crate::task::Done;

/// Finds a record that was gathered under the frame's draft before. The same id has the same bits, whoever made it.
pub type Known = Arc<dyn Fn(RecordId) -> Option<Record> + Send + Sync>;

/// Whether nobody waits for a lease any more.
pub type Dropped = Arc<dyn Fn() -> bool + Send + Sync>;

/// One frame, ready to be worked on.
pub trait Job: Sized + Send + Sync + 'static {
    /// Makes ready what a server describes; a scene that is not on this machine comes from `scenes`.
    ///
    /// # Errors
    /// Why this worker cannot do the frame, in one line for its owner.
    fn prepare(
        frame: u64,
        described: &v1::DescribeResponse,
        scenes: &Scenes,
    ) -> impl Future<Output = Result<Self, String>> + Send;

    /// Levels of records the frame fills; 0 for methods without records.
    fn levels(&self) -> u32;

    /// Allowed error a its records count with.
    fn a(&self) -> f32;

    /// Does the work of one lease. `None` when it found that nobody waits for it. The result depends on the job, the
    /// step, the tiles and the sealed levels alone.
    ///
    /// # Errors
    /// Why this worker cannot do the frame, in one line for its owner.
    fn run(self: Arc<Self>, work: Work) -> impl Future<Output = Result<Option<Done>, String>> + Send;
}

/// The work of one lease.
pub struct Work {
    /// Step of the frame.
    pub step: v1::Step,
    /// Tiles to do; a range that goes past the frame's last tile ends there.
    pub tiles: Range<u32>,
    /// The records the step reads.
    pub levels: Levels,
    /// Records that need not be gathered again.
    pub known: Known,
    /// To be asked now and then.
    pub dropped: Dropped,
}
