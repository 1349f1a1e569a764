//! Machines with addresses of their own, on one machine: network namespaces, joined by a bridge and a wire.
//!
//! ```text
//! w1, w2 --veth-- bridge --wire-- server
//! ```

use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;

use crate::wire::Wire;

/// Where the server's machine is.
pub const SERVER: &str = "10.77.0.1";

/// The machines of workers, and their addresses.
pub const WORKERS: [(&str, &str); 2] = [("w1", "10.77.0.2"), ("w2", "10.77.0.3")];

const OTHERS: [&str; 2] = ["serve", "rack"];

/// All of them; taken down when dropped.
pub struct Network {
    pub wire: Arc<Wire>,
    tag: String,
}

impl Network {
    /// Builds it.
    ///
    /// # Errors
    /// What this machine does not do.
    pub fn build() -> Result<Self, String> {
        if std::fs::metadata("/proc/self").map_err(|e| e.to_string())?.uid() != 0 {
            return Err("it needs root, to make network namespaces".into());
        }
        let tag = format!("ambience-{}", std::process::id());
        let ends = ["up", "down"].map(|end| format!("amb{end}{}", std::process::id()));
        let wire = Wire::new([&ends[0], &ends[1]]).map_err(|e| format!("no TAP interface: {e}"))?;
        let network = Self { wire, tag };
        let [serve, rack] = OTHERS.map(|name| network.namespace(name));
        let names = WORKERS.iter().map(|(name, _)| *name).chain(OTHERS);
        for name in names {
            ip(&["netns", "add", &network.namespace(name)])?;
            ip(&["-n", &network.namespace(name), "link", "set", "lo", "up"])?;
        }
        ip(&["-n", &rack, "link", "add", "bridge", "type", "bridge"])?;
        ip(&["-n", &rack, "link", "set", "bridge", "up"])?;
        for (end, namespace) in ends.iter().zip([&rack, &serve]) {
            ip(&["link", "set", end, "netns", namespace])?;
        }
        ip(&["-n", &rack, "link", "set", &ends[0], "master", "bridge"])?;
        ip(&["-n", &rack, "link", "set", &ends[0], "up"])?;
        ip(&["-n", &serve, "addr", "add", &format!("{SERVER}/24"), "dev", &ends[1]])?;
        ip(&["-n", &serve, "link", "set", &ends[1], "up"])?;
        for (name, address) in WORKERS {
            let worker = network.namespace(name);
            ip(&["-n", &rack, "link", "add", name, "type", "veth", "peer", "name", "net", "netns", &worker])?;
            ip(&["-n", &rack, "link", "set", name, "master", "bridge", "up"])?;
            ip(&["-n", &worker, "addr", "add", &format!("{address}/24"), "dev", "net"])?;
            ip(&["-n", &worker, "link", "set", "net", "up"])?;
        }
        Ok(network)
    }

    /// A command on a machine, under its host name; the files below `hidden` are not there.
    pub fn command(&self, host: &str, hidden: Option<&Path>, program: &str) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.namespace(host), "unshare", "--uts", "--mount", "sh", "-c"]);
        command.arg("hostname \"$0\" && if [ -n \"$1\" ]; then mount -t tmpfs none \"$1\"; fi && shift && exec \"$@\"");
        command.arg(host).arg(hidden.unwrap_or(Path::new(""))).arg(program);
        command
    }

    /// Cuts a worker's link for good.
    pub fn cut(&self, host: &str) {
        ip(&["-n", &self.namespace("rack"), "link", "del", host]).expect("the link");
    }

    fn namespace(&self, name: &str) -> String {
        format!("{}-{name}", self.tag)
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        for name in WORKERS.iter().map(|(name, _)| *name).chain(OTHERS) {
            // It may not have come to be.
            drop(ip(&["netns", "del", &self.namespace(name)]));
        }
    }
}

fn ip(args: &[&str]) -> Result<(), String> {
    let failed = |why: &dyn std::fmt::Display| format!("`ip {}`: {why}", args.join(" "));
    let run: io::Result<Output> = Command::new("ip").args(args).output();
    let output = run.map_err(|e| failed(&e))?;
    if output.status.success() { Ok(()) } else { Err(failed(&String::from_utf8_lossy(&output.stderr).trim())) }
}
