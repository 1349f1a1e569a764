//! One picture, whatever the farm: real processes, compared byte by byte.
//!
//! Every run is the program as users start it. What is varied may change the clock, never the picture or the records.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ambience_bench::judge::file;
use serde_json::Value;

/// What a run left behind.
struct Run {
    exr: Vec<u8>,
    stats: Value,
}

impl Run {
    fn records(&self) -> (&Value, &Value, &Value) {
        (&self.stats["digest"], &self.stats["records"], &self.stats["rounds"])
    }
}

fn ambience(directory: &Path, scene: &str, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
    command.arg("render").arg(file("scenes").join(scene));
    command.arg("-o").arg(directory.join("out.exr")).arg("--stats").arg(directory.join("stats.json"));
    command.args(["--quiet", "--size", "96x80", "--rays", "256", "--spp", "4"]).args(more);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::inherit());
    command
}

fn collect(directory: &Path) -> Run {
    let read = |name: &str| std::fs::read(directory.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    Run { exr: read("out.exr"), stats: serde_json::from_slice(&read("stats.json")).expect("one JSON object") }
}

fn render(scene: &str, more: &[&str]) -> Run {
    let directory = tempfile::tempdir().expect("temporary directory");
    let status = ambience(directory.path(), scene, more).status().expect("ambience starts");
    assert!(status.success(), "{scene} {more:?}: {status}");
    collect(directory.path())
}

/// Children of a process whose command line has `word` among its arguments.
fn children(parent: u32, word: &str) -> Vec<u32> {
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
fn cpu_ticks(pid: u32) -> u64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let fields: Vec<_> = stat.rsplit(") ").next().unwrap_or_default().split(' ').collect();
    fields.get(11).and_then(|t| t.parse().ok()).unwrap_or(0)
}

/// Waits until `ready` gives something, looking often; panics after a minute.
fn wait_for<T>(what: &str, mut ready: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = ready() {
            return value;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "waited a minute for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn signal(pid: u32, name: &str) {
    let status = Command::new("kill").args([&format!("-{name}"), &pid.to_string()]).status().expect("kill");
    assert!(status.success());
}

/// A worker of `render` that is in the middle of its work.
fn busy_worker(render: &mut Child) -> u32 {
    let pid = render.id();
    wait_for("a busy worker", || {
        assert!(render.try_wait().expect("wait").is_none(), "render ended before its workers were busy");
        children(pid, "worker").into_iter().find(|w| cpu_ticks(*w) >= 20)
    })
}

#[test]
fn the_picture_does_not_depend_on_workers_threads_transport_or_run() {
    for scene in ["cornell.glb", "glossy-floor.rad"] {
        let first = render(scene, &["--workers", "1"]);
        assert!(first.stats["records"]["irradiance"]["total"].as_u64() > Some(100), "{}", first.stats);
        let others: [&[&str]; 6] = [
            &["--workers", "1"],
            &["--workers", "2"],
            &["--workers", "5"],
            &["--workers", "1", "--threads", "2"],
            &["--workers", "2", "--threads", "2"],
            &["--workers", "2", "--transport", "tcp"],
        ];
        for more in others {
            let other = render(scene, more);
            assert_eq!(other.records(), first.records(), "{scene} {more:?}");
            assert!(other.exr == first.exr, "{scene} {more:?}: another picture");
        }
        // The comparison can fail: another seed gives another picture and other records.
        let seeded = render(scene, &["--workers", "2", "--seed", "1"]);
        assert_ne!(seeded.stats["digest"], first.stats["digest"]);
        assert!(seeded.exr != first.exr);
    }
}

#[test]
fn a_worker_killed_in_the_middle_changes_nothing() {
    let settings = ["--rays", "4096", "--workers", "2"];
    let whole = render("cornell.glb", &settings);
    let directory = tempfile::tempdir().expect("temporary directory");
    let mut child = ambience(directory.path(), "cornell.glb", &settings).spawn().expect("ambience starts");
    let worker = busy_worker(&mut child);
    signal(worker, "KILL");
    assert!(child.try_wait().expect("wait").is_none(), "killed too late to matter");
    let status = child.wait().expect("wait");
    assert!(status.success(), "{status}");
    let run = collect(directory.path());
    assert_eq!(run.stats["workers_lost"], 1, "{}", run.stats);
    assert_eq!(run.records(), whole.records());
    assert!(run.exr == whole.exr, "another picture");
}

#[test]
fn interrupted_renders_leave_nothing_behind() {
    for (name, code) in [("INT", 130), ("TERM", 143)] {
        let directory = tempfile::tempdir().expect("temporary directory");
        let mut child =
            ambience(directory.path(), "cornell.glb", &["--rays", "65536"]).spawn().expect("ambience starts");
        let worker = busy_worker(&mut child);
        let family = [children(child.id(), "worker"), children(child.id(), "serve")].concat();
        assert!(family.len() >= 2, "{family:?}");
        signal(child.id(), name);
        let status = child.wait().expect("wait");
        assert_eq!(status.code(), Some(code), "{name}");
        wait_for("the children to end", || family.iter().all(|p| !alive(*p)).then_some(()));
        assert!(!alive(worker));
        let left: Vec<PathBuf> =
            std::fs::read_dir(directory.path()).expect("directory").flatten().map(|e| e.path()).collect();
        assert!(left.is_empty(), "{left:?}");
    }
}

#[test]
fn children_end_even_when_render_is_killed() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let mut child = ambience(directory.path(), "cornell.glb", &["--rays", "65536"]).spawn().expect("ambience starts");
    busy_worker(&mut child);
    let family = [children(child.id(), "worker"), children(child.id(), "serve")].concat();
    child.kill().expect("kill");
    child.wait().expect("wait");
    wait_for("the children to end", || family.iter().all(|p| !alive(*p)).then_some(()));
}

fn alive(pid: u32) -> bool {
    // A zombie has ended: its parent has only not asked yet.
    std::fs::read_to_string(format!("/proc/{pid}/stat"))
        .is_ok_and(|s| !s.rsplit(") ").next().unwrap_or("").starts_with('Z'))
}

/// The same parts by hand: a server, two workers, and two renders that use them one after the other.
#[test]
fn server_and_workers_started_by_hand_give_the_same_picture() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let address = format!("unix:{}", directory.path().join("socket").display());
    let start = |args: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_ambience"))
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("ambience starts")
    };
    let mut server = start(&["serve", "--listen", &address]);
    wait_for("the socket", || directory.path().join("socket").exists().then_some(()));
    let mut workers: Vec<_> = (0..2).map(|_| start(&["worker", "--server", &address, "--threads", "1"])).collect();
    let shared = render("cornell.glb", &["--server", &address]);
    // A second frame on the same server finds every record it needs.
    let again = render("cornell.glb", &["--server", &address]);
    let alone = render("cornell.glb", &["--workers", "1"]);
    for process in workers.iter_mut().chain([&mut server]) {
        signal(process.id(), "TERM");
        assert!(process.wait().expect("wait").success());
    }
    assert_eq!(shared.stats["digest"], alone.stats["digest"]);
    assert!(shared.exr == alone.exr, "another picture");
    assert_eq!(again.stats["digest"], alone.stats["digest"], "the second frame added records");
    assert!(again.exr == alone.exr, "another picture from the records of the first");
}
