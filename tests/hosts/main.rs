//! Several machines: a server on one, workers on two, joined by a network that is slow, loses, is cut, and loses a machine for
//! good. TLS and a token; pictures compared byte by byte with that of one machine.
//!
//! It needs Linux and root; where it cannot run it says so and counts as ignored.

#![cfg_attr(not(target_os = "linux"), allow(dead_code))]

#[path = "../processes/mod.rs"]
mod processes;

#[cfg(target_os = "linux")]
mod network;
#[cfg(target_os = "linux")]
mod wire;

#[cfg(target_os = "linux")]
mod farm;

use libtest_mimic::{Arguments, Trial};

#[cfg(not(target_os = "linux"))]
mod farm {
    /// Only Linux has network namespaces.
    pub fn tests() -> Result<Vec<libtest_mimic::Trial>, String> {
        Err("it needs Linux".into())
    }
}

fn main() {
    let mut arguments = Arguments::from_args();
    // They share one network.
    arguments.test_threads = Some(1);
    let tests = farm::tests().unwrap_or_else(|why| {
        eprintln!("tests/hosts.rs is skipped: {why}");
        vec![Trial::test("several_machines", || Ok(())).with_ignored_flag(true)]
    });
    libtest_mimic::run(&arguments, tests).exit();
}
