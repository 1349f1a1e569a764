//! `--stats`: one JSON object about a render.

use std::collections::BTreeMap;
use std::time::Instant;

use cache_proto::v1;
use serde_json::{Map, Value, json};

/// What there is to tell at the end, as it is collected.
#[derive(Default)]
pub struct Stats {
    /// Wall seconds by phase, in order.
    wall: Vec<(String, f64)>,
    now: Option<(String, Instant)>,
    /// Own workers started at the beginning.
    pub workers: usize,
    /// Own workers that died.
    pub workers_lost: u32,
    /// Records the frame began with.
    pub base: u64,
    /// Own servers that died.
    pub servers_lost: u32,
    /// Packed pixels that came, bytes.
    pub tile_bytes: u64,
}

impl Stats {
    /// Ends the phase before, if it was another, and begins this one. Returning to a phase adds to it.
    pub fn phase(&mut self, name: &str) {
        if self.now.as_ref().is_some_and(|(now, _)| now == name) {
            return;
        }
        self.end();
        self.now = Some((name.into(), Instant::now()));
    }

    /// Ends the phase.
    pub fn end(&mut self) {
        let Some((name, began)) = self.now.take() else { return };
        let seconds = began.elapsed().as_secs_f64();
        match self.wall.iter_mut().find(|(known, _)| *known == name) {
            Some((_, sum)) => *sum += seconds,
            None => self.wall.push((name, seconds)),
        }
    }

    /// Wall seconds so far.
    pub fn seconds(&self) -> f64 {
        self.wall.iter().map(|(_, s)| s).sum::<f64>()
            + self.now.as_ref().map_or(0.0, |(_, began)| began.elapsed().as_secs_f64())
    }

    /// The object. `told` is what the caller knows about scene and settings.
    ///
    /// `bytes` counts packed records and packed pixels only, where they enter the wire or leave it: inserted by workers,
    /// received by workers' subscriptions, sent by workers in tiles, received here in tiles. Message framing, HTTP/2 and
    /// retries are in `hosts` only, which counts what went through the sockets of each machine's workers.
    pub fn json(mut self, told: Map<String, Value>, done: &v1::FrameDone) -> Value {
        self.end();
        let counts: BTreeMap<&str, f64> = done.counts.iter().map(|c| (c.name.as_str(), c.value)).collect();
        let count = |name: &str| whole(counts.get(name).copied().unwrap_or(0.0));
        let by_phase = |prefix: &str, number: fn(f64) -> Value| -> Map<String, Value> {
            let of = counts.iter().filter_map(|(name, v)| Some((name.strip_prefix(prefix)?.to_string(), number(*v))));
            of.collect()
        };
        let total = self.seconds();
        let mut wall: Map<String, Value> = self.wall.into_iter().map(|(n, s)| (n, json!(s))).collect();
        wall.insert("total".into(), json!(total));
        let usage = usage();
        let mut cpu = by_phase("cpu_seconds.", |v| json!(v));
        cpu.insert("render_process".into(), json!(usage.cpu_self));
        cpu.insert("own_children".into(), json!(usage.cpu_children));
        let mut records = by_phase("records.", whole);
        records.insert("base".into(), json!(self.base));
        records.insert("reused".into(), count("reused"));
        records.insert("total".into(), json!(done.records));
        let bytes_of = |name| counts.get(name).copied().unwrap_or(0.0);
        let bytes = bytes_of("bytes.inserted") + bytes_of("bytes.subscribed") + bytes_of("bytes.tiles");
        let mut object = told;
        let rest = json!({
            "digest": hex(&done.digest),
            "wall_seconds": wall,
            "cpu_seconds": cpu,
            "records": records,
            "rays": { "path": by_phase("rays.path.", whole), "shadow": by_phase("rays.shadow.", whole) },
            "queries": count("queries"),
            "misses": count("misses"),
            "gathered_per_sample": count("regathers"),
            "candidates_left_dense": count("dense"),
            "samples": count("samples"),
            "samples_splatted": count("samples.splatted"),
            "devices_lost": count("devices_lost"),
            "bytes": {
                "records_inserted": count("bytes.inserted"),
                "records_subscribed": count("bytes.subscribed"),
                "tiles_sent": count("bytes.tiles"),
                "tiles_received": self.tile_bytes,
                "total": whole(bytes + self.tile_bytes as f64),
            },
            "hosts": hosts(done),
            "rounds": done.rounds,
            "passes": done.passes,
            "proposals": count("proposals"),
            "leases_lost": done.leases_lost,
            "workers": self.workers,
            "workers_lost": self.workers_lost,
            "servers_lost": self.servers_lost,
            "peak_memory_bytes": { "render_process": usage.peak_self, "largest_child": usage.peak_children },
        });
        if let Value::Object(rest) = rest {
            object.extend(rest);
        }
        Value::Object(object)
    }
}

/// What the workers' machines used, by name; how long an answer took is a mean, where one was waited for.
fn hosts(done: &v1::FrameDone) -> Map<String, Value> {
    let told = |host: &v1::HostUse| {
        let trips = host.round_trips;
        let ms = (trips > 0).then(|| host.round_trip_seconds / trips as f64 * 1e3);
        json!({ "bytes_sent": host.sent_bytes, "bytes_received": host.received_bytes, "round_trip_ms": ms })
    };
    done.hosts.iter().map(|host| (host.host.clone(), told(host))).collect()
}

fn whole(value: f64) -> Value {
    json!(value as u64)
}

/// Lower-case hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

#[derive(Default)]
struct Usage {
    cpu_self: f64,
    cpu_children: f64,
    peak_self: u64,
    peak_children: u64,
}

/// Of this process, and of its children that have been reaped.
#[cfg(unix)]
fn usage() -> Usage {
    use nix::sys::resource::{UsageWho, getrusage};
    // Kilobytes everywhere but on macOS.
    let unit = if cfg!(target_os = "macos") { 1 } else { 1024 };
    let of = |who| {
        let Ok(usage) = getrusage(who) else { return (0.0, 0) };
        let seconds = |t: nix::sys::time::TimeVal| t.tv_sec() as f64 + t.tv_usec() as f64 * 1e-6;
        (seconds(usage.user_time()) + seconds(usage.system_time()), usage.max_rss().max(0) as u64 * unit)
    };
    let ((cpu_self, peak_self), (cpu_children, peak_children)) =
        (of(UsageWho::RUSAGE_SELF), of(UsageWho::RUSAGE_CHILDREN));
    Usage { cpu_self, cpu_children, peak_self, peak_children }
}

#[cfg(not(unix))]
fn usage() -> Usage {
    Usage::default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_sorted_into_the_object() {
        let count = |name: &str, value| v1::Count { name: name.into(), value };
        let done = v1::FrameDone {
            rounds: 3,
            records: 12,
            digest: vec![0xab; 16].into(),
            counts: vec![
                count("cpu_seconds.level 2", 1.5),
                count("records.level 2", 12.0),
                count("rays.path.pixels", 9.0),
                count("bytes.inserted", 100.0),
                count("queries", 5.0),
            ],
            hosts: vec![v1::HostUse {
                host: "b".into(),
                round_trips: 4,
                round_trip_seconds: 0.1,
                ..Default::default()
            }],
            ..Default::default()
        };
        let mut stats = Stats { tile_bytes: 11, ..Stats::default() };
        stats.phase("load");
        stats.phase("pixels");
        let json = stats.json(Map::new(), &done);
        assert_eq!(json["digest"], "ab".repeat(16));
        assert_eq!(json["cpu_seconds"]["level 2"], 1.5);
        assert_eq!(json["records"], json!({ "level 2": 12, "base": 0, "reused": 0, "total": 12 }));
        assert_eq!(json["rays"]["path"]["pixels"], 9);
        assert_eq!(json["bytes"]["total"], 111);
        assert_eq!(json["hosts"]["b"], json!({ "bytes_sent": 0, "bytes_received": 0, "round_trip_ms": 25.0 }));
        assert_eq!((&json["queries"], &json["misses"], &json["rounds"]), (&json!(5), &json!(0), &json!(3)));
        let wall = json["wall_seconds"].as_object().expect("object");
        assert!(wall.contains_key("load") && wall.contains_key("pixels") && wall.contains_key("total"));
    }
}
