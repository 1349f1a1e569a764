//! The scripts, on a cluster of two nodes that is started for them.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crate::processes::wait_for;
use crate::{SMALL, Test, alone, deploy, needs, path, run, scene, views};

/// The nodes: the first has room for the server and two workers.
const NODES: [&str; 2] = ["one", "two"];

pub fn tests() -> [Test; 2] {
    let tools = ["slurmctld", "slurmd", "munged", "sbatch", "unshare"].into_iter().try_for_each(needs);
    let root = || match std::os::unix::fs::MetadataExt::uid(&std::fs::metadata("/proc/self").expect("/proc")) {
        0 => Ok(()),
        _ => Err("it needs root, to start a cluster".to_string()),
    };
    let able = tools.and_then(|()| root());
    let test = |run: fn()| able.clone().map(|()| Box::new(run) as _);
    [("slurm_survives_preemption_and_a_requeued_server", test(preempted)), ("slurm_survives_a_lost_node", test(lost))]
}

fn preempted() {
    let cluster = Cluster::start();
    let farm = Farm::submit(&cluster);
    // One worker and the server are preempted.
    let works = cluster.jobs("work", "%i");
    assert_eq!(works.lines().count(), 4, "{works}");
    for job in [works.lines().next().expect("a worker"), cluster.jobs("serve", "%i").trim()] {
        run(cluster.set(Command::new("scontrol").args(["requeue", job])));
    }
    farm.finish(&cluster);
    let log = farm.log("serve");
    assert_eq!(log.matches("listening address").count(), 2, "begun again: {log}");
    assert!(log.contains("recovered") && log.contains("shutting down"), "{log}");
}

/// A node ends without a word, with all that runs there: two workers and the frame's owner.
fn lost() {
    let mut cluster = Cluster::start();
    let farm = Farm::submit(&cluster);
    wait_for("work on both nodes", || {
        let there = cluster.jobs("work,prepass", "%j %N");
        let count = |job: &str| there.lines().filter(|line| *line == format!("{job} {}", NODES[1])).count();
        (count("work") == 2 && count("prepass") == 1).then_some(())
    });
    // Of the two seconds the prepass takes.
    std::thread::sleep(Duration::from_millis(500));
    let node = &mut cluster.nodes[1];
    node.kill().expect("kill");
    node.wait().expect("wait");
    let set = |cluster: &Cluster, state: &str| {
        let (node, state) = (format!("NodeName={}", NODES[1]), format!("State={state}"));
        run(cluster.set(Command::new("scontrol").args(["update", &node, &state, "Reason=lost"])));
    };
    set(&cluster, "DOWN");
    let waiting = cluster.jobs("work,prepass", "%j %T");
    assert_eq!(waiting.matches("PENDING").count(), 3, "{waiting}");
    cluster.nodes[1] = node_of(cluster.folder.path(), NODES[1]);
    set(&cluster, "RESUME");
    farm.finish(&cluster);
    let log = farm.log("serve");
    assert_eq!(log.matches("frame opened").count(), 3, "the prepass twice, and the second frame: {log}");
}

/// A prepass and two frames, by the script.
struct Farm {
    folder: tempfile::TempDir,
    views: PathBuf,
    out: PathBuf,
    last: String,
}

impl Farm {
    /// Submits it, and waits until the prepass is in the middle of its work.
    fn submit(cluster: &Cluster) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let (views, out) = (views(folder.path()), folder.path().join("out"));
        let mut submit = Command::new(deploy("slurm/submit"));
        submit.arg(scene()).arg(&views).args(["2", "4"]).arg(&out).args(SMALL.split(' ')).args(["--rays", "4096"]);
        let last = run(cluster.set(&mut submit));
        let farm = Self { folder, views, out, last };
        wait_for("the prepass", || farm.log("serve").contains("frame opened").then_some(()));
        farm
    }

    /// Waits until it is done, which it must not be yet, and compares the picture.
    fn finish(&self, cluster: &Cluster) {
        assert!(!self.out.join("1.exr").exists(), "done too early");
        wait_for("the last job to begin", || {
            let left = run(cluster.set(Command::new("squeue").args(["-h", "-j", self.last.trim()])));
            left.trim().is_empty().then_some(())
        });
        wait_for("the farm to end", || cluster.jobs("work,serve", "%i").trim().is_empty().then_some(()));
        let expected = alone(self.folder.path(), &self.views, &["--rays", "4096"]);
        assert!(std::fs::read(self.out.join("1.exr")).expect("a picture") == expected, "another picture");
        assert!(self.out.join("2.exr").is_file());
    }

    /// What the first job of a name logged.
    fn log(&self, job: &str) -> String {
        let logs = std::fs::read_dir(self.out.join("farm")).into_iter().flatten().flatten().map(|entry| entry.path());
        let named = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(job));
        logs.into_iter().find(named).and_then(|path| std::fs::read_to_string(path).ok()).unwrap_or_default()
    }
}

/// Slurm and munge, for one test alone.
struct Cluster {
    /// munge and slurmctld.
    daemons: [Child; 2],
    nodes: [Child; 2],
    folder: tempfile::TempDir,
}

impl Cluster {
    fn start() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let place = folder.path();
        let at = |name: &str| place.join(name).display().to_string();
        std::fs::create_dir(at("state")).expect("a folder");
        let listeners = [(); 3].map(|()| std::net::TcpListener::bind("127.0.0.1:0").expect("a port"));
        let ports = listeners.map(|listener| listener.local_addr().expect("bound").port().to_string());
        let host = run(&mut Command::new("hostname"));
        let mut text = include_str!("slurm.conf").replace("HOST", host.trim()).replace("FOLDER", &at(""));
        for (number, port) in ports.iter().enumerate() {
            text = text.replace(&format!("PORT{number}"), port);
        }
        std::fs::write(at("slurm.conf"), text).expect("written");
        std::fs::write(at("munge.key"), [7; 64]).expect("written");
        std::fs::set_permissions(at("munge.key"), std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("set");
        let files = ["key-file=munge.key", "socket=munge.socket", "pid-file=munge.pid", "log-file=munge.log"];
        let files = files.into_iter().chain(["seed-file=munge.seed"]).filter_map(|file| file.split_once('='));
        let munge = files.map(|(option, file)| format!("--{option}={}", at(file)));
        let munged = daemon(place, Command::new("munged").args(["--foreground", "--force"]).args(munge));
        wait_for("munge", || Path::new(&at("munge.socket")).exists().then_some(()));
        let daemons = [munged, daemon(place, Command::new("slurmctld").arg("-D"))];
        let cluster = Self { daemons, nodes: NODES.map(|name| node_of(place, name)), folder };
        wait_for("idle nodes", || {
            let output = cluster.set(Command::new("sinfo").args(["-h", "-N", "-o", "%t"])).output().expect("sinfo");
            let states = String::from_utf8_lossy(&output.stdout).into_owned();
            (states.split_whitespace().collect::<Vec<_>>() == ["idle"; 2]).then_some(())
        });
        cluster
    }

    /// A command of this cluster.
    fn set<'a>(&self, command: &'a mut Command) -> &'a mut Command {
        set(self.folder.path(), command)
    }

    /// What there is to say of the jobs of some names, a line each.
    fn jobs(&self, names: &str, what: &str) -> String {
        run(self.set(Command::new("squeue").args(["-h", "-r", "-o", what, "-n", names])))
    }
}

fn set<'a>(folder: &Path, command: &'a mut Command) -> &'a mut Command {
    command.env("SLURM_CONF", folder.join("slurm.conf")).env("PATH", path())
}

fn daemon(folder: &Path, command: &mut Command) -> Child {
    let command = set(folder, command).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().expect("it starts")
}

/// A node with processes of its own, which end with it.
fn node_of(folder: &Path, name: &str) -> Child {
    let mut command = Command::new("unshare");
    command.args(["--pid", "--fork", "--mount-proc", "--kill-child", "slurmd", "-D", "-N", name]);
    daemon(folder, &mut command)
}

impl Drop for Cluster {
    fn drop(&mut self) {
        drop(self.set(Command::new("scancel").args(["--user", "root", "--full"])).output());
        for daemon in self.nodes.iter_mut().chain(self.daemons.iter_mut().rev()) {
            // It may have ended.
            drop(daemon.kill());
            drop(daemon.wait());
        }
    }
}
