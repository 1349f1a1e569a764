//! The only place that asks what time it is. Everything else takes `now` as an argument.
#![allow(clippy::disallowed_methods, reason = "this is the substitute the ban names")]

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use tokio::time::Instant;

/// Time since the server started. It runs on tokio's clock, which tests can pause and simulators can drive.
#[derive(Clone, Copy, Debug)]
pub struct Clock(Instant);

impl Clock {
    /// A clock that shows 0 now.
    pub fn start() -> Self {
        Self(Instant::now())
    }

    /// Time since the start.
    pub fn now(&self) -> Duration {
        self.0.elapsed()
    }
}

/// Time since 1970, for what says in dates how long it holds. Nothing else may depend on it.
pub fn date() -> Duration {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}
