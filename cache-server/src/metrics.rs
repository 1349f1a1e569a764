//! Everything that is counted and measured, for Prometheus: one function for each, named by what happened.

use metrics::counter;
use tonic::Code;

/// The methods of both services, as labels: a label never comes from a peer.
const METHODS: [&str; 11] = [
    "Cache/Insert",
    "Cache/Subscribe",
    "Cache/Query",
    "Cache/Info",
    "Frames/Open",
    "Frames/Describe",
    "Frames/Lease",
    "Frames/Renew",
    "Frames/Complete",
    "Frames/Decline",
    "Frames/Leave",
];

/// The label of a call's path.
pub fn method(path: &str) -> &'static str {
    let known = path.strip_prefix("/ambience.v1.");
    METHODS.into_iter().find(|method| known == Some(method)).unwrap_or("other")
}

/// Bytes came from a peer.
pub fn received(bytes: usize) {
    counter!("ambience_received_bytes_total").increment(bytes as u64);
}

/// Bytes went to a peer.
pub fn sent(bytes: usize) {
    counter!("ambience_sent_bytes_total").increment(bytes as u64);
}

/// A call began.
pub fn called(method: &'static str) {
    counter!("ambience_calls_total", "method" => method).increment(1);
}

/// A call was refused or failed.
pub fn refused(method: &'static str, code: Code) {
    counter!("ambience_calls_refused_total", "method" => method, "code" => code_name(code)).increment(1);
}

fn code_name(code: Code) -> &'static str {
    match code {
        Code::InvalidArgument => "invalid_argument",
        Code::NotFound => "not_found",
        Code::PermissionDenied => "permission_denied",
        Code::ResourceExhausted => "resource_exhausted",
        Code::FailedPrecondition => "failed_precondition",
        Code::OutOfRange => "out_of_range",
        Code::Unavailable => "unavailable",
        Code::Unauthenticated => "unauthenticated",
        Code::Unimplemented => "unimplemented",
        Code::Cancelled => "cancelled",
        Code::Internal => "internal",
        _ => "other",
    }
}
