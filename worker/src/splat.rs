//! The seam for splatting: what records tell where the camera looks may come from elsewhere than the octree.

use std::sync::Mutex;

use cache_core::Query;

use crate::levels::Reflected;
use crate::lobes::Served;
use crate::threads::lock;

/// Where a sample of a pixel asks records.
pub struct Look<'a> {
    /// Column and row of the pixel it lies in.
    pub pixel: [u32; 2],
    /// The point of the surface.
    pub query: Query,
    /// Which records serve it.
    pub served: Served<'a>,
}

/// What answers in place of the octree has gone, and why.
#[derive(Clone, PartialEq, Eq, Debug, thiserror::Error)]
#[error("{0}")]
pub struct Lost(pub String);

/// Answers for the sealed records of level 1, for many points at a time.
pub trait Splat {
    /// What records say is reflected at each of the points, at most one in each pixel; `None` where none covers it.
    ///
    /// # Errors
    /// [`Lost`]: it will not answer any more.
    fn answers(&mut self, looks: &mut dyn Iterator<Item = &Look>) -> Result<Vec<Option<Reflected>>, Lost>;
}

/// For threads that trace side by side and have one device, which draws for each in turn.
impl<S: Splat> Splat for &Mutex<S> {
    fn answers(&mut self, looks: &mut dyn Iterator<Item = &Look>) -> Result<Vec<Option<Reflected>>, Lost> {
        lock(self).answers(looks)
    }
}
