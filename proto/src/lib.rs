//! The wire: generated types of `ambience.v1`, and their conversion to and from core types.
//!
//! - [`v1`]: what protox and prost generate from `proto/ambience/v1/cache.proto`, which documents every field.
//! - [`convert`]: the only place where bytes from the wire become records.

pub mod convert;

/// Generated from `ambience/v1/cache.proto`, which documents it.
#[allow(missing_docs, clippy::all)]
pub mod v1 {
    tonic::include_proto!("ambience.v1");
}

/// Serialised file descriptors of `ambience.v1`, for gRPC reflection.
pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));

/// Most bytes of a scene that is sent to workers, names of files included.
pub const SCENE_BYTES_MAX: usize = 256 << 20;

/// Version of this build; client and server must agree on it.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Metadata by which a caller says its version.
pub const VERSION_KEY: &str = "ambience-version";
