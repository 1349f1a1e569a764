//! Why a command ended without success, and with which exit code.

use std::fmt;

/// The one line a user reads, by what it means for the exit code.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Failure {
    /// Wrong usage or input: 2.
    Usage(String),
    /// Everything else: 1.
    Failed(String),
    /// Ended by a signal of this number: 128 and the number.
    Signal(u8),
}

impl Failure {
    /// The exit code it stands for.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Failed(_) => 1,
            Self::Signal(number) => 128 + number,
        }
    }

    /// Wrong usage or input.
    pub fn usage(reason: impl fmt::Display) -> Self {
        Self::Usage(reason.to_string())
    }

    /// Everything else.
    pub fn failed(reason: impl fmt::Display) -> Self {
        Self::Failed(reason.to_string())
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Usage(reason) | Self::Failed(reason) => f.write_str(reason),
            Self::Signal(2) => f.write_str("interrupted"),
            Self::Signal(number) => write!(f, "ended by signal {number}"),
        }
    }
}
