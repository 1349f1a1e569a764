//! The job template: checked and run by the reference implementation's command.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::{SMALL, Test, alone, deploy, needs, path, run, scene, views};

/// The command, from PyPI.
const OPENJD: &str = "openjd-cli==0.8.0";

pub fn test() -> Test {
    ("openjd_runs_frames_on_one_server", install().map(|openjd| Box::new(move || frames(&openjd)) as _))
}

/// Where the command is; installed once, beside what is built.
fn install() -> Result<PathBuf, String> {
    needs("python3")?;
    let folder = Path::new(env!("CARGO_BIN_EXE_ambience")).parent().expect("a folder").join("openjd");
    let openjd = folder.join("bin/openjd");
    if openjd.is_file() {
        return Ok(openjd);
    }
    let run = |command: &mut Command| match command.output() {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => Err(format!("{command:?}: {}", String::from_utf8_lossy(&output.stderr).trim())),
        Err(error) => Err(error.to_string()),
    };
    run(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
    run(Command::new(folder.join("bin/pip")).args([
        "install",
        "--quiet",
        "--timeout",
        "10",
        "--retries",
        "1",
        OPENJD,
    ]))?;
    Ok(openjd)
}

fn frames(openjd: &Path) {
    let folder = tempfile::tempdir().expect("a folder");
    let (views, out) = (views(folder.path()), folder.path().join("out"));
    std::fs::create_dir(&out).expect("a folder");
    let template = deploy("openjd/frames.yaml");
    run(Command::new(openjd).arg("check").arg(&template));

    // Paths of another machine, which the rules lead to those of this one.
    let rules = folder.path().join("rules.json");
    let rule = |from: &str, to: &Path| serde_json::json!({ "source_path_format": "POSIX", "source_path": from, "destination_path": to });
    let scenes = scene().parent().expect("a folder").to_path_buf();
    let text = serde_json::json!({
        "version": "pathmapping-1.0",
        "path_mapping_rules": [rule("/artist/scenes", &scenes), rule("/artist/job", folder.path())],
    });
    std::fs::write(&rules, text.to_string()).expect("written");
    let mut command = Command::new(openjd);
    command.env("PATH", path()).env("RUST_LOG", "info").arg("run").arg(&template).args(["--step", "Frame"]);
    command.arg("--path-mapping-rules").arg(format!("file://{}", rules.display()));
    for parameter in [
        "Scene=/artist/scenes/cornell.rad",
        "Views=/artist/job/views",
        "Output=/artist/job/out",
        "Frames=1-2",
        &format!("Options={SMALL}"),
    ] {
        command.args(["-p", parameter]);
    }
    let said = run(&mut command);
    for told in ["openjd_progress: 100", "openjd_status: pixels", "openjd_status: writing"] {
        assert_eq!(said.matches(told).count(), 2, "{told}: {said}");
    }
    assert_eq!(said.matches("listening address").count(), 1, "one server: {said}");
    assert_eq!(said.matches("frame opened").count(), 2, "{said}");
    assert!(
        std::fs::read(out.join("1.exr")).expect("a picture") == alone(folder.path(), &views, &[]),
        "another picture"
    );
    assert!(out.join("2.exr").is_file());
}
