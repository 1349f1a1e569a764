//! How light becomes records and records become pixels.

pub mod frame;
pub mod scene;
pub mod settings;
