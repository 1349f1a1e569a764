//! Everything that is counted and measured, for Prometheus: what there is, in one table, and one function for each thing
//! that happens.

use std::net::SocketAddr;
use std::time::Duration;

use metrics::{Unit, counter, describe_counter, describe_gauge, describe_histogram, gauge, histogram};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder};
use tonic::Code;

use crate::listen::ServeError;
use crate::scrape;

/// Upper bounds of the histograms of times, seconds: from a page cache to a disk that is in trouble; and of a lease.
const JOURNAL_SECONDS: [f64; 10] = [0.0001, 0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0];
const LEASE_SECONDS: [f64; 9] = [0.1, 0.3, 1.0, 3.0, 6.0, 15.0, 60.0, 300.0, 1800.0];

const JOURNAL_APPEND: &str = "ambience_journal_append_seconds";
const LEASE_AGE: &str = "ambience_lease_age_seconds";

/// Lets Prometheus read the metrics at `http://ADDRESS/metrics`. To be called once, before anything is counted.
///
/// # Errors
/// When the address cannot be bound.
pub fn publish(address: SocketAddr) -> Result<(), ServeError> {
    let failed =
        |error: &dyn std::fmt::Display| ServeError::Failed(format!("cannot publish metrics on {address}: {error}"));
    let buckets = [(JOURNAL_APPEND, &JOURNAL_SECONDS[..]), (LEASE_AGE, &LEASE_SECONDS[..])];
    let builder = buckets.into_iter().try_fold(PrometheusBuilder::new(), |builder, (name, bounds)| {
        builder.set_buckets_for_metric(Matcher::Full(name.into()), bounds)
    });
    let page = builder.and_then(PrometheusBuilder::install_recorder).map_err(|error| failed(&error))?;
    scrape::publish(address, page).map_err(|error| failed(&error))?;
    describe();
    Ok(())
}

fn describe() {
    describe_gauge!("ambience_records", Unit::Count, "Records held, in the logs of all namespaces together");
    describe_gauge!("ambience_namespaces", Unit::Count, "Namespaces held, drafts of frames among them");
    describe_gauge!("ambience_connections", Unit::Count, "Open connections, those past the bound included");
    describe_gauge!("ambience_subscribers", Unit::Count, "Open subscriptions");
    describe_gauge!("ambience_frames", Unit::Count, "Open frames");
    describe_gauge!("ambience_workers", Unit::Count, "Workers heard of in the last 15 seconds");
    describe_gauge!("ambience_leases", Unit::Count, "Leases that workers hold");
    describe_gauge!("ambience_lease_oldest_seconds", Unit::Seconds, "Age of the oldest lease that is held");
    describe_gauge!("ambience_ready", Unit::Count, "1 while health says SERVING, else 0");
    describe_counter!("ambience_received_bytes_total", Unit::Bytes, "Bytes received, as they were on the network");
    describe_counter!("ambience_sent_bytes_total", Unit::Bytes, "Bytes sent, as they were on the network");
    describe_counter!("ambience_calls_total", Unit::Count, "Calls begun, by method");
    describe_counter!("ambience_calls_refused_total", Unit::Count, "Calls refused or failed, by method and status");
    describe_counter!(
        "ambience_connections_refused_total",
        Unit::Count,
        "Connections past the bound, or cut without a call"
    );
    describe_counter!("ambience_leases_total", Unit::Count, "Leases given to workers");
    describe_counter!(
        "ambience_leases_lost_total",
        Unit::Count,
        "Leases taken back: their worker left, died or was slow"
    );
    describe_histogram!(LEASE_AGE, Unit::Seconds, "Age of leases when they were completed");
    describe_histogram!(JOURNAL_APPEND, Unit::Seconds, "Time to make one group of entries durable");
    describe_counter!("ambience_journal_entries_total", Unit::Count, "Entries made durable");
    describe_counter!("ambience_journal_failures_total", Unit::Count, "Groups the journal did not take");
}

/// What there is at a moment.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct Census {
    /// Records in all logs.
    pub records: u64,
    /// Namespaces.
    pub namespaces: u64,
    /// Connections.
    pub connections: u64,
    /// Subscriptions.
    pub subscribers: u64,
    /// Open frames.
    pub frames: u64,
    /// Workers.
    pub workers: u64,
    /// Leases held.
    pub leases: u64,
    /// Age of the oldest of them.
    pub oldest_lease: Duration,
    /// Whether health says so.
    pub ready: bool,
}

/// Shows what there is.
pub fn show(census: Census) {
    gauge!("ambience_records").set(census.records as f64);
    gauge!("ambience_namespaces").set(census.namespaces as f64);
    gauge!("ambience_connections").set(census.connections as f64);
    gauge!("ambience_subscribers").set(census.subscribers as f64);
    gauge!("ambience_frames").set(census.frames as f64);
    gauge!("ambience_workers").set(census.workers as f64);
    gauge!("ambience_leases").set(census.leases as f64);
    gauge!("ambience_lease_oldest_seconds").set(census.oldest_lease.as_secs_f64());
    gauge!("ambience_ready").set(f64::from(census.ready));
}

/// A worker was given a lease.
pub fn leased() {
    counter!("ambience_leases_total").increment(1);
}

/// A lease was completed at this age.
pub fn completed(age: Duration) {
    histogram!(LEASE_AGE).record(age);
}

/// Leases were taken back.
pub fn leases_lost(count: u32) {
    counter!("ambience_leases_lost_total").increment(count.into());
}

/// The journal took a group of entries, in this time.
pub fn appended(entries: usize, time: Duration) {
    counter!("ambience_journal_entries_total").increment(entries as u64);
    histogram!(JOURNAL_APPEND).record(time);
}

/// The journal did not take a group.
pub fn append_failed() {
    counter!("ambience_journal_failures_total").increment(1);
}

/// A connection was past the bound, or brought no call.
pub fn connection_refused() {
    counter!("ambience_connections_refused_total").increment(1);
}

/// The methods of both services, as labels: a label never comes from a peer.
const METHODS: [&str; 13] = [
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
    "Frames/Scene",
    "Frames/Offer",
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

#[cfg(test)]
mod tests {
    #[test]
    fn the_page_for_operators_tells_of_every_metric() {
        let named =
            include_str!("metrics.rs").split('"').filter(|name| name.starts_with("ambience_") && *name != "ambience_");
        for name in named {
            let row = format!("| `{name}` |");
            assert!(include_str!("../../docs/operating.md").contains(&row), "docs/operating.md has no row {row}");
        }
    }
}
