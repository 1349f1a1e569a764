//! A journal's process is killed in the midst of appending: what it was told is kept, is there.

use std::io::{BufRead as _, BufReader};
use std::path::PathBuf;
use std::process::{Command, Stdio};

use cache_proto::v1::{Entry, RecordBatch, entry};
use cache_server::journal::Journal as _;
use cache_server::journal::device::Sync;
use cache_server::journal::disk::Disk;

/// Tells the process that is to be killed where its journal is.
const DIRECTORY: &str = "AMBIENCE_TEST_JOURNAL";

fn entry(number: u32) -> Entry {
    let records = vec![number as u8; 112 * (1 + number as usize % 700)].into();
    let batch = RecordBatch { namespace: vec![1; 32].into(), kind: 1, level: 1, records, step: number };
    Entry { entry: Some(entry::Entry::Batch(batch)) }
}

/// No test: what the test below starts and kills.
#[test]
fn appends_until_it_is_killed() {
    let Some(directory) = std::env::var_os(DIRECTORY).map(PathBuf::from) else { return };
    let (mut disk, report) = Disk::open(&directory, Sync::Device).expect("a journal");
    for number in report.appends as u32.. {
        disk.append(&[entry(number)]).expect("room");
        eprintln!("kept {number}");
    }
}

#[test]
fn what_was_kept_survives_kill_9() {
    let directory = tempfile::tempdir().expect("a directory");
    let mut kept = 0;
    for round in 1..=6 {
        let mut child = Command::new(std::env::current_exe().expect("this test"))
            .args(["--exact", "appends_until_it_is_killed", "--nocapture"])
            .env(DIRECTORY, directory.path())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("started");
        let lines = BufReader::new(child.stderr.take().expect("piped")).lines().map_while(Result::ok);
        let told = lines.filter_map(|line| line.strip_prefix("kept ")?.parse::<u64>().ok());
        for number in told {
            kept = number + 1;
            if number % (7 * round) == 6 {
                // It goes on appending meanwhile.
                let _ = child.kill();
            }
        }
        child.wait().expect("ended");

        let (mut disk, report) = Disk::open(directory.path(), Sync::Device).expect("a journal");
        assert!(report.appends >= kept && report.damage.is_none(), "{report:?}, {kept} were kept");
        let mut number = 0;
        disk.replay(&mut |found| {
            assert_eq!(found, entry(number));
            number += 1;
            Ok(())
        })
        .expect("readable");
        assert_eq!(u64::from(number), report.appends);
    }
    assert!(kept > 6 * 6, "{kept}");
}
