//! What a peer can be refused for, and the one function that puts it on the wire.

use cache_core::Namespace;
use cache_proto::convert::Malformed;
use tonic::Status;

/// Why a call was refused. Each kind says by its status what the client has to do.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// Bytes that are not what the wire says. Correct the input.
    #[error(transparent)]
    Malformed(#[from] Malformed),
    /// One batch of an insert is unsound; those before it are kept. Correct the input.
    #[error("batch {index}: {reason}")]
    Batch {
        /// Which batch of the stream, from 0.
        index: u64,
        /// What is unsound about it.
        reason: Box<Refusal>,
    },
    /// A field outside its range. Correct the input.
    #[error("{field}: {reason}")]
    Field {
        /// Which, as the .proto file spells it.
        field: &'static str,
        /// What it was and what would have been right.
        reason: String,
    },
    /// A stated bound of what the server keeps is reached. Ask for less.
    #[error("no room for more {what}: this server keeps at most {most}")]
    Full {
        /// Of what.
        what: &'static str,
        /// The bound.
        most: usize,
    },
    /// Others use all there is of something just now. Come again later.
    #[error("no room for more {what}: this server takes at most {most}")]
    Busy {
        /// Of what.
        what: &'static str,
        /// The bound.
        most: usize,
    },
    /// There are as many connections as the server takes. Use fewer, or come again later.
    #[error("this server takes at most {0} connections")]
    Connections(usize),
    /// Client and server are of different builds. Install the same.
    #[error("client is version {client}, server is version {server}; they must be the same")]
    Version {
        /// What the client says it is (at most 64 characters of it).
        client: String,
        /// What the server is.
        server: &'static str,
    },
    /// A subscriber asked for what this server never had. Resynchronise from position 0.
    #[error("position {asked} is past the end of the log, which is {end}; start again from 0")]
    PastEnd {
        /// Where the subscriber wanted to start.
        asked: u64,
        /// Length of the namespace's log.
        end: u64,
    },
    /// The draft's records belong to its namespace now, and no frame fills it any more. Nothing will come: stop asking.
    #[error("the draft is published; its records are in its namespace")]
    Published,
    /// No token, or one that is not known. Ask the one who runs the server.
    #[error("{0}")]
    Unknown(&'static str),
    /// The namespace belongs to another token. Use that.
    #[error("namespace {}... belongs to another token", short(.0))]
    Foreign(Namespace),
    /// The frame is over, was cancelled, or never was.
    #[error("there is no frame {0}")]
    NoFrame(u64),
    /// The server is going away. Connect again later.
    #[error("the server is shutting down")]
    Closing,
    /// The journal did not take a batch, so it was not acknowledged. Try again later.
    #[error("the journal failed: {0}")]
    Journal(#[from] std::io::Error),
    /// A task of the server died: a bug.
    #[error("internal error: {0}")]
    Internal(String),
}

impl Refusal {
    /// A field outside its range.
    pub fn field(field: &'static str, reason: impl Into<String>) -> Self {
        Self::Field { field, reason: reason.into() }
    }
}

/// Enough of a namespace to tell it from others.
fn short(namespace: &Namespace) -> String {
    namespace.0[..4].iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The status a refusal has on the wire.
impl From<Refusal> for Status {
    fn from(refusal: Refusal) -> Self {
        let message = refusal.to_string();
        match refusal {
            Refusal::Malformed(_) | Refusal::Field { .. } => Status::invalid_argument(message),
            Refusal::Batch { reason, .. } => Status::new(Status::from(*reason).code(), message),
            Refusal::Full { .. } | Refusal::Connections(_) => Status::resource_exhausted(message),
            Refusal::Version { .. } => Status::failed_precondition(message),
            Refusal::PastEnd { .. } => Status::out_of_range(message),
            Refusal::NoFrame(_) | Refusal::Published => Status::not_found(message),
            Refusal::Unknown(_) => Status::unauthenticated(message),
            Refusal::Foreign(_) => Status::permission_denied(message),
            Refusal::Busy { .. } | Refusal::Closing | Refusal::Journal(_) => Status::unavailable(message),
            Refusal::Internal(_) => Status::internal(message),
        }
    }
}

/// Refuses clients of another build.
///
/// # Errors
/// [`Refusal::Version`] unless `client` is [`cache_proto::VERSION`].
pub fn same_version(client: &str) -> Result<(), Refusal> {
    if client == cache_proto::VERSION {
        return Ok(());
    }
    // Cut, because the message travels in a header.
    Err(Refusal::Version { client: client.chars().take(64).collect(), server: cache_proto::VERSION })
}
