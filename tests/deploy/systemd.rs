//! The units: sound, and shut in as far as the tool that judges them can see. What their filters let through nobody tries here.

use std::process::Command;

use crate::{Test, deploy, needs, run, takes};

/// Highest exposure that `systemd-analyze security` may find, in tenths: "OK" ends at 4.9.
const EXPOSURE: &str = "--threshold=20";

pub fn test() -> Test {
    ("systemd_units_are_sound_and_shut_in", needs("systemd-analyze").map(|()| Box::new(units) as _))
}

fn units() {
    let folder = tempfile::tempdir().expect("a folder");
    for unit in ["ambience-server.service", "ambience-worker.service"] {
        let text = std::fs::read_to_string(deploy("systemd").join(unit)).expect("a unit");
        // Where this build is.
        let text = text.replace("/usr/bin/ambience ", &format!("{} ", env!("CARGO_BIN_EXE_ambience")));
        let path = folder.path().join(unit);
        std::fs::write(&path, &text).expect("written");
        let said = run(Command::new("systemd-analyze").arg("verify").arg(&path));
        assert_eq!(said, "", "{unit}");
        run(Command::new("systemd-analyze").args(["security", "--offline=yes", EXPOSURE]).arg(&path));
        // The command line is one that the program takes: what is missing are only the files.
        let line = text.replace("\\\n", " ");
        let line = line.lines().find_map(|line| line.strip_prefix("ExecStart=")).expect("a command");
        let line = line.replace("${CREDENTIALS_DIRECTORY}", "/nowhere").replace("${AMBIENCE_SERVER}", "farm:4670");
        let mut words = line.split_whitespace().map(String::from);
        assert_eq!(words.next().as_deref(), Some(env!("CARGO_BIN_EXE_ambience")), "{unit}");
        takes(&words.collect::<Vec<_>>(), &[], "/nowhere/");
    }
}
