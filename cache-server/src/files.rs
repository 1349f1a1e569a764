//! How many files this process may have open: each connection is one.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// Files besides connections: the journal, listening sockets, metrics, connections that are being refused.
const BESIDES: usize = 256;

/// How many may be needed for so many connections.
pub fn needed(connections: usize) -> u64 {
    (connections + BESIDES) as u64
}

/// How many the system would let this process have open.
pub fn most() -> Option<u64> {
    getrlimit(Resource::RLIMIT_NOFILE).ok().map(|(_, hard)| hard)
}

/// Asks the system for as many as so many connections need. The usual allowance is far below what may be had for asking.
pub fn allow(connections: usize) {
    let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_NOFILE) else { return };
    let needed = needed(connections);
    if hard < needed {
        tracing::warn!(needed, allowed = hard, "not as many open files are allowed as may be needed; see ulimit -n");
    }
    if soft < needed
        && let Err(error) = setrlimit(Resource::RLIMIT_NOFILE, needed.min(hard), hard)
    {
        tracing::warn!(%error, soft, "the number of open files cannot be raised");
    }
}
