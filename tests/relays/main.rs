//! Relays between workers and the server: the same picture, byte by byte, whatever tree they make and whatever befalls it.

mod access;
#[path = "../processes/mod.rs"]
mod processes;

use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use cache_proto::v1;
use processes::{ambience, collect, cpu_ticks, render, signal, wait_for};
use tempfile::TempDir;
use worker::client;
use worker::credentials::Credentials;

/// Long enough to do something in the middle.
const SLOW: [&str; 4] = ["--rays", "4096", "--workers", "0"];

/// A process that ends with the test.
struct Process(Child);

impl Process {
    fn start(command: &mut Command) -> Self {
        let command = command.stdin(Stdio::null()).stdout(Stdio::null());
        Self(command.spawn().expect("it starts"))
    }

    fn kill(mut self) {
        self.0.kill().expect("kill");
        self.0.wait().expect("wait");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended.
        drop(self.0.kill());
        drop(self.0.wait());
    }
}

/// Servers, relays and workers, by the names of their sockets in a folder.
struct Tree(TempDir);

impl Tree {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a folder"))
    }

    fn at(&self, name: &str) -> String {
        format!("unix:{}", self.0.path().join(name).display())
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
        command.args(args).env("RUST_LOG", "error");
        command
    }

    fn serve(&self, name: &str, more: &[&str]) -> Process {
        let mut command = self.command(&["serve", "--listen", &self.at(name)]);
        let process = Process::start(command.args(more).stderr(Stdio::null()));
        let socket = self.0.path().join(name);
        wait_for("the socket", || socket.exists().then_some(()));
        process
    }

    fn relay(&self, name: &str, above: &str) -> Process {
        self.serve(name, &["--upstream", &self.at(above)])
    }

    fn worker(&self, at: &str) -> Process {
        Process::start(&mut self.command(&["worker", "--threads", "1", "--server", &self.at(at)]))
    }

    fn render(&self, scene: &str, at: &str, out: &Path, more: &[&str]) -> Child {
        let mut command = ambience(out, scene, &[more, &["--server", &self.at(at)]].concat());
        command.stderr(Stdio::null()).spawn().expect("ambience starts")
    }
}

/// Waits for a worker that is in the middle of its work.
fn busy(worker: &Process) {
    let before = cpu_ticks(worker.0.id());
    wait_for("a busy worker", || (cpu_ticks(worker.0.id()) > before + 30).then_some(()));
}

fn finish(mut render: Child, out: &Path) -> processes::Run {
    let status = wait_for("the picture", || render.try_wait().expect("wait"));
    assert!(status.success(), "{status}");
    collect(out)
}

#[test]
fn a_tree_of_relays_gives_the_same_picture_over_one_subscription_each() {
    let tree = Tree::new();
    let _processes = [
        tree.serve("root", &[]),
        tree.relay("left", "root"),
        tree.relay("right", "root"),
        tree.relay("low", "left"),
        tree.worker("low"),
        tree.worker("low"),
        tree.worker("low"),
        tree.worker("right"),
    ];
    let out = tempfile::tempdir().expect("a folder");
    // Records of both kinds.
    let (scene, settings) = ("glossy-floor.glb", ["--rays", "1024", "--method", "radiance", "--workers"]);
    let mut render = tree.render(scene, "low", out.path(), &[&settings[..], &["0"]].concat());
    let root: client::Address = tree.at("root").parse().expect("an address");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let mut most = 0;
    let mut asking =
        runtime.block_on(async { client::cache(client::connect(&root, &Credentials::default()).expect("a line")) });
    let status = wait_for("the picture", || {
        let info = runtime.block_on(asking.info(v1::InfoRequest {})).expect("info").into_inner();
        most = most.max(info.subscribers);
        assert!(info.workers <= 4);
        render.try_wait().expect("wait")
    });
    assert!(status.success(), "{status}");
    // The draft, once for the left and once for the right.
    assert_eq!(most, 2, "subscriptions at the root");
    let (run, alone) = (collect(out.path()), processes::render(scene, &[&settings[..], &["2"]].concat()));
    assert!(run.stats["records"]["radiance"].as_u64() > Some(100), "{}", run.stats);
    assert_eq!(run.records(), alone.records());
    assert!(run.exr == alone.exr, "another picture");
}

#[test]
fn a_server_that_is_away_behind_its_relays_changes_nothing() {
    let alone = render("cornell.glb", &["--rays", "4096", "--workers", "2"]);
    let tree = Tree::new();
    let data = tree.0.path().join("data").display().to_string();
    // With its disk, and without: then the relays and their workers bring back what was lost.
    for more in [vec!["--data", &data], vec![]] {
        let root = tree.serve("root", &more);
        let _relays = [tree.relay("left", "root"), tree.relay("right", "root")];
        let workers = [tree.worker("left"), tree.worker("right")];
        let out = tempfile::tempdir().expect("a folder");
        let render = tree.render("cornell.glb", "left", out.path(), &SLOW);
        busy(&workers[0]);
        root.kill();
        std::fs::remove_file(tree.0.path().join("root")).expect("its socket");
        std::thread::sleep(Duration::from_secs(3));
        let _root = tree.serve("root", &more);
        let run = finish(render, out.path());
        assert!(run.stats["records"]["reused"].as_u64() > Some(0), "{}", run.stats);
        assert_eq!(run.stats["digest"], alone.stats["digest"], "{more:?}");
        assert!(run.exr == alone.exr, "{more:?}: another picture");
        for name in ["root", "left", "right"] {
            std::fs::remove_file(tree.0.path().join(name)).expect("its socket");
        }
    }
}

#[test]
fn a_worker_that_moves_to_another_relay_changes_nothing() {
    let alone = render("cornell.glb", &["--rays", "4096", "--workers", "2"]);
    let tree = Tree::new();
    let _root = tree.serve("root", &[]);
    let (left, _right) = (tree.relay("left", "root"), tree.relay("right", "root"));
    let near = tree.0.path().join("near");
    symlink(tree.0.path().join("left"), &near).expect("linked");
    // The only one, so that nobody else finishes the picture.
    let worker = tree.worker("near");
    let out = tempfile::tempdir().expect("a folder");
    let render = tree.render("cornell.glb", "right", out.path(), &SLOW);
    busy(&worker);
    std::fs::remove_file(&near).expect("there");
    symlink(tree.0.path().join("right"), &near).expect("linked");
    left.kill();
    let run = finish(render, out.path());
    assert_eq!(run.records(), alone.records());
    assert!(run.exr == alone.exr, "another picture");
}

#[test]
fn relays_in_a_circle_are_refused_with_one_line() {
    let tree = Tree::new();
    let circle = |of: &[(&str, &str)]| {
        let start = |(name, above): &(&str, &str)| {
            let mut command = tree.command(&["serve", "--listen", &tree.at(name), "--upstream", &tree.at(above)]);
            Process::start(command.stderr(Stdio::piped()))
        };
        let mut relays: Vec<_> = of.iter().map(start).collect();
        let at =
            wait_for("a refusal", || relays.iter_mut().position(|relay| relay.0.try_wait().expect("wait").is_some()));
        let mut refused = relays.swap_remove(at);
        let said = std::io::read_to_string(refused.0.stderr.take().expect("piped")).expect("text");
        assert_eq!(refused.0.wait().expect("wait").code(), Some(2), "{said}");
        assert_eq!(said.lines().count(), 1, "{said}");
        assert!(said.starts_with("ambience: --upstream unix:") && said.contains("circle"), "{said}");
    };
    circle(&[("itself", "itself")]);
    circle(&[("one", "two"), ("two", "one")]);
    circle(&[("a", "b"), ("b", "c"), ("c", "a")]);
}

#[test]
fn a_relay_that_loses_its_server_for_good_ends_its_clients_in_time() {
    let tree = Tree::new();
    let root = tree.serve("root", &[]);
    let relay = tree.relay("near", "root");
    let mut worker = Process::start(
        tree.command(&["worker", "--threads", "1", "--server", &tree.at("near")]).stderr(Stdio::piped()),
    );
    root.kill();
    let status = wait_for("the worker to give up", || worker.0.try_wait().expect("wait"));
    let said = std::io::read_to_string(worker.0.stderr.take().expect("piped")).expect("text");
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains("has been away for 30 s") && said.contains(&tree.at("root")), "{said}");
    signal(relay.0.id(), "TERM");
}
