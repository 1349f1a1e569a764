//! The program as users start it, for tests that look at what processes leave behind.
#![allow(dead_code, reason = "each test file uses its part")]

pub mod farm;

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ambience_bench::judge::file;
use serde_json::Value;

/// What a run left behind.
pub struct Run {
    /// OUT.exr.
    pub exr: Vec<u8>,
    /// The statistics.
    pub stats: Value,
}

impl Run {
    /// Which records the picture was made from. Who takes a dead worker's place may find some of them made.
    pub fn records(&self) -> [Value; 3] {
        let mut records = self.stats["records"].clone();
        records.as_object_mut().expect("counts").remove("reused");
        [self.stats["digest"].clone(), records, self.stats["rounds"].clone()]
    }
}

/// A small render, to be started: its files go to a directory.
pub fn ambience(directory: &Path, scene: &str, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
    command.arg("render").arg(file("scenes").join(scene));
    command.arg("-o").arg(directory.join("out.exr")).arg("--stats").arg(directory.join("stats.json"));
    command.args(["--quiet", "--size", "96x80", "--rays", "256", "--spp", "4"]).args(more);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::inherit());
    command
}

/// What a render wrote to its directory.
pub fn collect(directory: &Path) -> Run {
    let read = |name: &str| std::fs::read(directory.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    Run { exr: read("out.exr"), stats: serde_json::from_slice(&read("stats.json")).expect("one JSON object") }
}

/// A small render.
pub fn render(scene: &str, more: &[&str]) -> Run {
    let directory = tempfile::tempdir().expect("temporary directory");
    let status = ambience(directory.path(), scene, more).status().expect("ambience starts");
    assert!(status.success(), "{scene} {more:?}: {status}");
    collect(directory.path())
}

/// Children of a process whose command line has `word` among its arguments.
pub fn children(parent: u32, word: &str) -> Vec<u32> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir("/proc").expect("/proc").flatten() {
        let Some(pid) = entry.file_name().to_str().and_then(|n| n.parse::<u32>().ok()) else { continue };
        let stat = std::fs::read_to_string(entry.path().join("stat")).unwrap_or_default();
        // After the name in parentheses: state, parent, ...
        let parent_of = stat.rsplit(") ").next().and_then(|s| s.split(' ').nth(1)).and_then(|p| p.parse().ok());
        let command = std::fs::read(entry.path().join("cmdline")).unwrap_or_default();
        if parent_of == Some(parent) && command.split(|b| *b == 0).any(|a| a == word.as_bytes()) {
            found.push(pid);
        }
    }
    found
}

/// Hundredths of seconds of CPU a process has used.
pub fn cpu_ticks(pid: u32) -> u64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let fields: Vec<_> = stat.rsplit(") ").next().unwrap_or_default().split(' ').collect();
    fields.get(11).and_then(|t| t.parse().ok()).unwrap_or(0)
}

/// Waits until `ready` gives something, looking often; panics after a minute.
pub fn wait_for<T>(what: &str, mut ready: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = ready() {
            return value;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "waited a minute for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Sends a signal by name.
pub fn signal(pid: u32, name: &str) {
    let status = Command::new("kill").args([&format!("-{name}"), &pid.to_string()]).status().expect("kill");
    assert!(status.success());
}

/// A worker of `render` that is in the middle of its work.
pub fn busy_worker(render: &mut Child) -> u32 {
    let pid = render.id();
    wait_for("a busy worker", || {
        assert!(render.try_wait().expect("wait").is_none(), "render ended before its workers were busy");
        children(pid, "worker").into_iter().find(|w| cpu_ticks(*w) >= 20)
    })
}

/// Whether a process runs.
pub fn alive(pid: u32) -> bool {
    // A zombie has ended: its parent has only not asked yet.
    std::fs::read_to_string(format!("/proc/{pid}/stat"))
        .is_ok_and(|s| !s.rsplit(") ").next().unwrap_or("").starts_with('Z'))
}
