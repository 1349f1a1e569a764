//! How light becomes records and records become pixels.

pub mod scene;
