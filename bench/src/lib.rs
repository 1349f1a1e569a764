//! The charts: speed against accuracy, on scenes with trusted references.
//!
//! - [`judge`]: scenes with references, and the measure pictures of them are held to; the tests use it too.

pub mod judge;
