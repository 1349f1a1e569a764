//! The scripts, on a cluster of one node that is started for them.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use crate::processes::wait_for;
use crate::{SMALL, Test, alone, deploy, needs, path, run, scene, views};

pub fn test() -> Test {
    let tools = ["slurmctld", "slurmd", "munged", "sbatch"].into_iter().try_for_each(needs);
    let root = || match std::os::unix::fs::MetadataExt::uid(&std::fs::metadata("/proc/self").expect("/proc")) {
        0 => Ok(()),
        _ => Err("it needs root, to start a cluster".to_string()),
    };
    ("slurm_survives_preemption_and_a_requeued_server", tools.and_then(|()| root()).map(|()| Box::new(farm) as _))
}

fn farm() {
    let cluster = Cluster::start();
    let folder = cluster.folder.path();
    let (views, out) = (views(folder), folder.join("out"));
    let mut submit = Command::new(deploy("slurm/submit"));
    submit.arg(scene()).arg(&views).args(["2", "4"]).arg(&out).args(SMALL.split(' ')).args(["--rays", "4096"]);
    let last = run(cluster.set(&mut submit));
    // The prepass is in the middle of its work: one worker and the server are preempted.
    let log = |job: &str| std::fs::read_to_string(cluster.log(&out, job)).unwrap_or_default();
    wait_for("the prepass", || log("serve").contains("frame opened").then_some(()));
    let jobs = |name: &str| run(cluster.set(Command::new("squeue").args(["-h", "-r", "-o", "%i", "-n", name])));
    let works = jobs("work");
    assert_eq!(works.lines().count(), 4, "{works}");
    let serve = jobs("serve");
    for job in [works.lines().next().expect("a worker"), serve.trim()] {
        run(cluster.set(Command::new("scontrol").args(["requeue", job])));
    }
    assert!(!out.join("1.exr").exists(), "done too early to be preempted");
    wait_for("the last job to begin", || {
        let left = run(cluster.set(Command::new("squeue").args(["-h", "-j", last.trim()])));
        left.trim().is_empty().then_some(())
    });
    wait_for("the farm to end", || jobs("work,serve").trim().is_empty().then_some(()));
    let log = log("serve");
    assert_eq!(log.matches("listening address").count(), 2, "begun again: {log}");
    assert!(log.contains("recovered") && log.contains("shutting down"), "{log}");
    let expected = alone(folder, &views, &["--rays", "4096"]);
    assert!(std::fs::read(out.join("1.exr")).expect("a picture") == expected, "another picture");
    assert!(out.join("2.exr").is_file());
}

/// Slurm and munge, for this test alone.
struct Cluster {
    daemons: Vec<Child>,
    folder: tempfile::TempDir,
}

impl Cluster {
    fn start() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let place = folder.path().to_path_buf();
        let at = |name: &str| place.join(name).display().to_string();
        for name in ["state", "spool"] {
            std::fs::create_dir(at(name)).expect("a folder");
        }
        // A node name of its own; all daemons are on this machine.
        let port = std::net::TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound").port();
        let next = if port == u16::MAX { port - 1 } else { port + 1 };
        let host = run(&mut Command::new("hostname"));
        let text = include_str!("slurm.conf").replace("HOST", host.trim()).replace("FOLDER", &at(""));
        let text = text.replace("PORT1", &port.to_string()).replace("PORT2", &next.to_string());
        std::fs::write(at("slurm.conf"), text).expect("written");
        std::fs::write(at("munge.key"), [7; 64]).expect("written");
        std::fs::set_permissions(at("munge.key"), std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("set");
        let mut cluster = Self { daemons: Vec::new(), folder };
        let files = ["key-file=munge.key", "socket=munge.socket", "pid-file=munge.pid", "log-file=munge.log"];
        let files = files.into_iter().chain(["seed-file=munge.seed"]).filter_map(|file| file.split_once('='));
        let munge = files.map(|(option, file)| format!("--{option}={}", at(file)));
        cluster.daemon(Command::new("munged").args(["--foreground", "--force"]).args(munge));
        wait_for("munge", || Path::new(&at("munge.socket")).exists().then_some(()));
        for program in ["slurmctld", "slurmd"] {
            cluster.daemon(Command::new(program).arg("-D"));
        }
        wait_for("an idle node", || {
            let output = cluster.set(Command::new("sinfo").args(["-h", "-o", "%t"])).output().expect("sinfo");
            (output.stdout.trim_ascii() == b"idle").then_some(())
        });
        cluster
    }

    fn daemon(&mut self, command: &mut Command) {
        let command = self.set(command).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let child = command.spawn().expect("it starts");
        self.daemons.push(child);
    }

    /// A command of this cluster.
    fn set<'a>(&self, command: &'a mut Command) -> &'a mut Command {
        command.env("SLURM_CONF", self.folder.path().join("slurm.conf")).env("PATH", path())
    }

    /// The log of the first job of a name.
    fn log(&self, out: &Path, job: &str) -> PathBuf {
        let logs = std::fs::read_dir(out.join("farm")).into_iter().flatten().flatten().map(|entry| entry.path());
        let named = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(job));
        logs.into_iter().find(named).unwrap_or_default()
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        drop(self.set(Command::new("scancel").args(["--user", "root", "--full"])).output());
        for daemon in self.daemons.iter_mut().rev() {
            // It may have ended.
            drop(daemon.kill());
            drop(daemon.wait());
        }
    }
}
