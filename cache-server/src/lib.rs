//! How records survive and spread, and how frames are filled in rounds.
//!
//! In the order of the flow, one sentence each:
//!
//! - [`refusal`]: what a peer can be refused for; every other room returns these.
//! - [`access`]: tokens, and the tenants they stand for.
//! - [`limits`]: every bound that can be set.
//! - [`journal`]: the door to durable storage: an insert is acknowledged only after it took the batch.
//! - [`replica`]: the record sets of all namespaces, as logs that can be read by position; no I/O.
//! - [`store`]: the replica shared between tasks, and the one task that writes: journal, memory, acknowledgement.
//! - [`archive`]: caches as files: united, exported, imported.
//! - [`query`]: sealed levels kept ready to answer clients that hold no replica.
//! - [`spec`]: what a frame asks for, checked once.
//! - [`expected`]: how long tiles will take, by how long they took; no I/O.
//! - [`round`]: the tiles of one step: pending, leased or done; no I/O.
//! - [`frame`]: one frame: its plan, its current round, and what its owner has still to be told; no I/O.
//! - [`frames`]: all frames and workers: who gets which lease, and when it is lost; no I/O, time is passed in.
//! - [`scenes`]: scenes on their way from owners of frames to workers that lack them.
//! - [`clock`]: the only place that asks what time it is.
//! - [`bell`]: wakes every task that waits for a change.
//! - [`cache_service`] and [`frames_service`]: the two gRPC services, thin over the rooms above.
//! - [`door`]: how many connections there may be, and how long one may stay without a call.
//! - [`gate`]: what every call passes first: a number for the logs, the token.
//! - [`inflow`]: bytes of messages that are on their way.
//! - [`metrics`](mod@metrics): everything that is counted, for Prometheus.
//! - [`listen`]: addresses, and the sockets bound to them.
//! - [`tls`]: the server's certificate and key.
//! - [`health`]: whether the server is ready, as the gRPC health service tells it.
//! - [`serve`](mod@serve): all of these on sockets, and how it ends.
//! - [`files`]: how many files may be open.
//! - [`cli`]: the arguments of `cache-server`, which `ambience serve` re-uses.

pub mod refusal;

pub mod access;
pub mod limits;

pub mod archive;
pub mod journal;
pub mod query;
pub mod replica;
pub mod store;

pub mod expected;
pub mod frame;
pub mod frames;
pub mod round;
pub mod scenes;
pub mod spec;

pub mod bell;
pub mod clock;

pub mod cache_service;
pub mod frames_service;

pub mod door;
pub mod gate;
pub mod inflow;
pub mod metrics;
mod scrape;

pub mod health;
pub mod listen;
pub mod serve;
pub mod tls;

pub mod cli;
pub mod files;

pub use cli::{ServeArgs, run, run_as};
pub use limits::Limits;
pub use listen::{Bound, Listen, ServeError, bind, bind_health};
pub use serve::{Config, Node, serve, serve_on};
