//! How light becomes records and records become pixels.
//!
//! In the order of the flow, one sentence each:
//!
//! - [`scene`]: the scene as plain data, and its loaders.
//! - [`settings`]: what a picture depends on besides the scene.
//! - [`frame`]: a scene ready to be rendered, and the two kinds of work on it.
//! - [`spec`]: settings on the wire.
//! - [`client`]: the connection to a server.
//! - [`replica`]: a copy of a namespace's log, and the caches sealed from a prefix of it.
//! - [`follow`]: keeps a replica following the server.
//! - [`task`]: the CPU work of one lease.
//! - [`farm`]: the worker process.
//! - [`film`]: tiles become OUT.exr and OUT.png.
//! - [`compare`]: how far a picture is from a reference.

pub mod scene;
pub mod settings;

pub mod frame;

pub mod client;
pub mod farm;
pub mod follow;
pub mod replica;
pub mod spec;
pub mod task;

pub mod compare;
pub mod film;
