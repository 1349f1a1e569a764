//! A farm by hand: a server and workers, each a process.

use std::process::{Child, Command, Stdio};

use tempfile::TempDir;

use super::{cpu_ticks, signal, wait_for};

/// Starts the program, silent.
pub fn start(args: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
    command.args(args).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().expect("ambience starts")
}

/// A server and workers of one thread, started by hand.
pub struct Farm {
    /// Where the server listens.
    pub address: String,
    /// Those that came last are last.
    pub workers: Vec<Child>,
    /// The server.
    pub server: Child,
    _directory: TempDir,
}

impl Farm {
    /// A server with these options besides, and workers.
    pub fn start(options: &[&str], workers: u32) -> Self {
        let directory = tempfile::tempdir().expect("temporary directory");
        let socket = directory.path().join("socket");
        let address = format!("unix:{}", socket.display());
        let server = start(&[&["serve", "--listen", &address], options].concat());
        wait_for("the socket", || socket.exists().then_some(()));
        let mut farm = Self { workers: Vec::new(), server, address, _directory: directory };
        (0..workers).for_each(|_| farm.join());
        farm
    }

    /// One worker more.
    pub fn join(&mut self) {
        self.workers.push(start(&["worker", "--server", &self.address, "--threads", "1"]));
    }

    /// Waits until the worker that came last is in the middle of its work.
    pub fn busy(&self) {
        let last = self.workers.last().expect("a worker").id();
        let before = cpu_ticks(last);
        wait_for("a busy worker", || (cpu_ticks(last) >= before + 20).then_some(()));
    }

    /// Ends it in good order.
    pub fn end(mut self) {
        for process in self.workers.iter_mut().chain([&mut self.server]) {
            signal(process.id(), "TERM");
            assert!(process.wait().expect("wait").success());
        }
    }
}

/// Nothing is left running by a test that failed.
impl Drop for Farm {
    fn drop(&mut self) {
        for process in self.workers.iter_mut().chain([&mut self.server]) {
            // It may have ended.
            drop(process.kill());
        }
    }
}
