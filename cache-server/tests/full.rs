//! A server process on a disk that is really full: a tmpfs of a few megabytes. Mounting one needs root; where that is not
//! allowed, the tests say so and are skipped.

mod support;

use std::collections::BTreeSet;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use cache_core::{Namespace, RecordId};
use cache_proto::convert;
use cache_proto::v1::cache_client::CacheClient;
use support::{insert, record, soon, subscribe};
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status};

const NAMESPACE: Namespace = Namespace([5; 32]);

/// Records of one insert: 128 KiB.
const BATCH: u32 = 1024;

/// A small disk, unmounted when dropped.
struct Disk(tempfile::TempDir);

impl Disk {
    /// One of so many mebibytes. `None`, after saying so, where nobody may mount one.
    fn mount(mebibytes: u32) -> Option<Self> {
        let folder = tempfile::tempdir().expect("a folder");
        if let Err(why) = mount(&format!("size={mebibytes}m"), folder.path()) {
            // Past the test harness, which swallows what passing tests print.
            let _ = writeln!(std::io::stderr(), "SKIPPED: cannot mount a tmpfs to fill: {why}");
            return None;
        }
        Some(Self(folder))
    }

    fn grow(&self, mebibytes: u32) {
        mount(&format!("remount,size={mebibytes}m"), self.0.path()).expect("remounted");
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let unmounted = Command::new("umount").arg("--lazy").arg(self.0.path()).status();
        assert!(std::thread::panicking() || unmounted.is_ok_and(|status| status.success()));
    }
}

fn mount(options: &str, at: &Path) -> Result<(), String> {
    let output = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(at).output();
    let output = output.map_err(|error| error.to_string())?;
    if output.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&output.stderr).trim().into()) }
}

/// A server process on a directory. Killed, not asked to end, when dropped.
struct Server {
    process: Child,
    cache: CacheClient<Channel>,
}

impl Server {
    async fn start(data: &Path) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cache-server"));
        command.args(["--listen", "127.0.0.1:0", "--data"]).arg(data).env_remove("AMBIENCE_TOKEN");
        let mut process = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("started");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        let port: u16 = line.trim().rsplit(':').next().and_then(|port| port.parse().ok()).expect("a port");
        let endpoint = Endpoint::from_shared(format!("http://127.0.0.1:{port}")).expect("a URI");
        Self { process, cache: CacheClient::new(soon(endpoint.connect()).await.expect("connected")) }
    }

    /// Inserts the batch of a number.
    async fn insert(&mut self, number: u32) -> Result<(), Status> {
        soon(self.cache.insert(insert(NAMESPACE, number * BATCH..(number + 1) * BATCH))).await.map(drop)
    }

    /// Inserts batches from a number on until one is refused: its number, and why.
    async fn fill(&mut self, mut number: u32) -> (u32, Status) {
        loop {
            match self.insert(number).await {
                Ok(()) => number += 1,
                Err(status) => return (number, status),
            }
        }
    }

    /// Repeats an insert as clients do, until it is kept.
    async fn insist(&mut self, number: u32) {
        let insisting = async {
            while let Err(status) = self.insert(number).await {
                assert_eq!(status.code(), Code::Unavailable, "{status}");
            }
        };
        tokio::time::timeout(support::PATIENCE, insisting).await.expect("kept, once there is room");
    }

    /// The ids of all records it shows.
    async fn held(&mut self) -> BTreeSet<RecordId> {
        let mut stream = soon(self.cache.subscribe(subscribe(NAMESPACE))).await.expect("accepted").into_inner();
        let end = soon(stream.message()).await.expect("no error").expect("where it starts").end;
        let (mut held, mut read) = (BTreeSet::new(), 0);
        while read < end {
            let batch = soon(stream.message()).await.expect("no error").expect("more").batch.expect("records");
            let (_, _, records) = convert::unpack(&batch).expect("sound");
            read += records.len() as u64;
            held.extend(records.iter().map(|record| record.id()));
        }
        held
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.process.kill().expect("running");
        self.process.wait().expect("ended");
    }
}

/// The ids of batches 0 to `end`.
fn ids(end: u32) -> BTreeSet<RecordId> {
    (0..end * BATCH).map(|id| record(id).id).collect()
}

#[tokio::test]
async fn a_full_disk_refuses_inserts_and_goes_on_once_it_has_grown() {
    let Some(disk) = Disk::mount(6) else { return };
    let data = disk.path("data");
    let mut server = Server::start(&data).await;
    let (full, refused) = server.fill(0).await;
    assert!(full > 3, "full after {full} batches");
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    assert!(refused.message().contains("No space left on device"), "{refused}");
    // It serves what it has, shows nothing of what it refused, and refuses again.
    assert_eq!(server.held().await, ids(full));
    assert_eq!(server.insert(full).await.expect_err("full").code(), Code::Unavailable);
    disk.grow(32);
    for number in full..full + 20 {
        server.insist(number).await;
    }
    assert_eq!(server.held().await, ids(full + 20));
    drop(server);
    assert_eq!(Server::start(&data).await.held().await, ids(full + 20));
}

#[tokio::test]
async fn a_server_killed_on_a_full_disk_keeps_what_it_acknowledged() {
    let Some(disk) = Disk::mount(12) else { return };
    let (data, ballast) = (disk.path("data"), disk.path("ballast"));
    std::fs::write(&ballast, vec![1; 6 << 20]).expect("room");
    let mut server = Server::start(&data).await;
    let (full, refused) = server.fill(0).await;
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    drop(server);
    std::fs::remove_file(&ballast).expect("there");
    let mut server = Server::start(&data).await;
    // What was refused may have come through.
    assert!(server.held().await.is_superset(&ids(full)));
    server.insist(full).await;
    server.insist(full + 1).await;
    assert_eq!(server.held().await, ids(full + 2));
}
