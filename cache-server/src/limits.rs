//! Every bound that can be set, in one table: `--limit NAME=VALUE` reads it and `--help` prints it.

use std::fmt::Write as _;
use std::ops::RangeInclusive;
use std::str::FromStr;

/// Bounds of what one server keeps and takes on. Past one of them a call is refused with RESOURCE_EXHAUSTED, and what is
/// there already goes on.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Limits {
    /// Most records in all logs together.
    pub records: usize,
    /// Most namespaces, drafts of frames among them.
    pub namespaces: usize,
    /// Most connections.
    pub connections: usize,
    /// Most calls at once on one connection.
    pub calls: usize,
    /// Most bytes of messages that have begun to come and are not whole yet, beyond 2 MiB of each connection.
    pub inflow: usize,
    /// Most subscriptions.
    pub subscribers: usize,
    /// Most frames open.
    pub frames: usize,
    /// Most workers.
    pub workers: usize,
    /// Most leases of one worker, over all frames.
    pub leases: usize,
}

/// One bound: its name, what it counts, where it may be set, and its place.
struct Bound {
    name: &'static str,
    about: &'static str,
    default: usize,
    range: RangeInclusive<usize>,
    place: fn(&mut Limits) -> &mut usize,
}

const fn bound(
    name: &'static str,
    about: &'static str,
    default: usize,
    range: RangeInclusive<usize>,
    place: fn(&mut Limits) -> &mut usize,
) -> Bound {
    Bound { name, about, default, range, place }
}

/// Wide enough for any server; what stands on it stays far from overflow.
const ANY: RangeInclusive<usize> = 1..=1 << 20;

const BOUNDS: [Bound; 9] = [
    bound("records", "records in all namespaces together", 32 << 20, 1..=(1 << 32) - 1, |l| &mut l.records),
    bound("namespaces", "namespaces, drafts of frames among them", 1024, ANY, |l| &mut l.namespaces),
    bound("connections", "connections; each may use 4 MiB", 2048, ANY, |l| &mut l.connections),
    bound("calls", "calls at once on one connection", 256, 8..=1 << 16, |l| &mut l.calls),
    bound("inflow", "bytes of unfinished messages beyond 2 MiB a connection", 256 << 20, 8 << 20..=1 << 40, |l| {
        &mut l.inflow
    }),
    bound("subscribers", "subscriptions", 8192, ANY, |l| &mut l.subscribers),
    bound("frames", "frames open at once", 64, ANY, |l| &mut l.frames),
    bound("workers", "workers", 4096, ANY, |l| &mut l.workers),
    bound("leases", "leases one worker holds at once, two for each of its threads", 128, 1..=1024, |l| &mut l.leases),
];

impl Default for Limits {
    fn default() -> Self {
        let mut limits = Self {
            records: 0,
            namespaces: 0,
            connections: 0,
            calls: 0,
            inflow: 0,
            subscribers: 0,
            frames: 0,
            workers: 0,
            leases: 0,
        };
        for bound in &BOUNDS {
            *(bound.place)(&mut limits) = bound.default;
        }
        limits
    }
}

impl Limits {
    /// The defaults, but for what was set; the last setting of a name counts.
    pub fn with(set: &[Setting]) -> Self {
        let mut limits = Self::default();
        for setting in set {
            *(BOUNDS[setting.bound].place)(&mut limits) = setting.value;
        }
        limits
    }
}

/// One bound set by the user: `NAME=VALUE`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Setting {
    bound: usize,
    value: usize,
}

impl FromStr for Setting {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE")?;
        let bound = BOUNDS.iter().position(|bound| bound.name == name).ok_or_else(|| {
            let names: Vec<_> = BOUNDS.iter().map(|bound| bound.name).collect();
            format!("there is no limit {name:?}; expected one of {}", names.join(", "))
        })?;
        let range = &BOUNDS[bound].range;
        let value = value.parse().ok().filter(|value| range.contains(value));
        let value = value.ok_or_else(|| format!("expected {} to {}", range.start(), range.end()))?;
        Ok(Self { bound, value })
    }
}

/// What `--help` says: names, meanings, defaults and ranges.
pub fn help() -> String {
    let mut text = String::from(
        "Set a bound; may be given several times. Past a bound calls are refused, and what is there goes on:",
    );
    for Bound { name, about, default, range, .. } in &BOUNDS {
        // Writing to a string does not fail.
        let _ = write!(text, "\n  {name:<12} {about} [{default}; {} to {}]", range.start(), range.end());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_name_sets_its_own_bound_within_its_range() {
        for bound in &BOUNDS {
            assert!(bound.range.contains(&bound.default), "{}", bound.name);
            let (least, most) = (*bound.range.start(), *bound.range.end());
            let set: Setting = format!("{}={least}", bound.name).parse().expect("in range");
            let mut limits = Limits::with(&[format!("{}={most}", bound.name).parse().expect("in range"), set]);
            assert_eq!(*(bound.place)(&mut limits), least);
            *(bound.place)(&mut limits) = bound.default;
            assert_eq!(limits, Limits::default(), "{} sets nothing else", bound.name);
            for outside in [least - 1, most + 1] {
                let error = format!("{}={outside}", bound.name).parse::<Setting>().expect_err("outside");
                assert!(error.contains(&least.to_string()) && error.contains(&most.to_string()), "{error}");
            }
            assert!(help().contains(bound.name));
            let row = format!("| `{}` |", bound.name);
            assert!(include_str!("../../docs/operating.md").contains(&row), "docs/operating.md has no row {row}");
        }
        assert!("record=5".parse::<Setting>().expect_err("no such").contains("namespaces"));
        assert!("records".parse::<Setting>().is_err() && "records=many".parse::<Setting>().is_err());
    }
}
