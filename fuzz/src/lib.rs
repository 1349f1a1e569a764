//! What must hold for bytes from outside, one function for each way they come in. libFuzzer chooses the bytes
//! (`fuzz_targets/`); `tests/fuzz_corpus.rs` of the workspace runs the same functions on known ones.
//!
//! - [`record`](record()): packed records, and the caches sealed from them.
//! - [`batch`](batch()): entries of the wire, and the replica they amount to.
//! - [`store`](store()): files a journal is opened on.
//! - [`scene`](scene()): scene and view files, and the rays that meet what they describe.
//! - [`frame`](frame()): what owners and workers say about a frame, and the picture a worker makes of it.
//! - [`seeds`]: where the fuzzer begins.

mod batch;
mod frame;
mod record;
mod scene;
pub mod seeds;
mod store;

pub use batch::batch;
pub use frame::frame;
pub use record::record;
pub use scene::scene;
pub use store::store;

/// A name, and what it checks.
type Target = (&'static str, fn(&[u8]));

/// The targets by name.
pub const TARGETS: [Target; 5] =
    [("record", record), ("batch", batch), ("store", store), ("scene", scene), ("frame", frame)];

/// Cuts bytes into pieces, each a kind, a length in two bytes, and its bytes.
fn pieces(mut rest: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    std::iter::from_fn(move || {
        let (&[kind, low, high], tail) = rest.split_first_chunk()?;
        let (bytes, tail) = tail.split_at(usize::from(u16::from_le_bytes([low, high])).min(tail.len()));
        rest = tail;
        Some((kind, bytes))
    })
}

/// A piece of at most 65535 bytes.
fn piece(kind: u8, bytes: &[u8]) -> Vec<u8> {
    [&[kind][..], &(bytes.len() as u16).to_le_bytes(), bytes].concat()
}

/// Byte `at`, or 0.
fn byte(bytes: &[u8], at: usize) -> u8 {
    bytes.get(at).copied().unwrap_or(0)
}
