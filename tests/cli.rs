//! Bad input gets one clear line, exit code 2, and leaves nothing half done.

use std::path::Path;
use std::process::{Command, Output, Stdio};

use ambience_bench::judge::file;

fn ambience(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ambience")).args(args).stdin(Stdio::null()).output().expect("ambience starts")
}

/// Runs and expects exit code 2 and one line that has every one of `words`.
fn refused(args: &[&str], words: &[&str]) {
    let output = ambience(args);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
    assert_eq!(message.trim_end().lines().count(), 1, "{args:?}: {message}");
    assert!(message.starts_with("ambience: "), "{args:?}: {message}");
    for word in words {
        assert!(message.contains(word), "{args:?}: no '{word}' in: {message}");
    }
}

fn scene(directory: &Path, name: &str, content: &str) -> String {
    let path = directory.join(name);
    std::fs::write(&path, content).expect("scene written");
    path.display().to_string()
}

const VIEW: &str = "rvu -vtv -vp 0 0 5 -vd 0 0 -1 -vu 0 1 0 -vh 40 -vv 40\n";

#[test]
fn wrong_usage_is_one_line() {
    let cornell = file("scenes/cornell.glb").display().to_string();
    let directory = tempfile::tempdir().expect("temporary directory");
    let out = directory.path().join("out.exr").display().to_string();
    let with = |more: &[&str], words: &[&str]| {
        let args: Vec<&str> = ["render", &cornell, "-o", &out].into_iter().chain(more.iter().copied()).collect();
        refused(&args, words);
    };
    refused(&["render"], &["SCENE"]);
    refused(&["render", &cornell], &["-o"]);
    refused(&["render", &cornell, "-o", "out.jpg"], &["out.jpg", ".exr"]);
    refused(&["render", &cornell, "-o", "/no/such/folder/out.exr"], &["/no/such/folder"]);
    with(&["--size", "0x10"], &["--size"]);
    with(&["--size", "10"], &["--size", "10"]);
    with(&["--spp", "0"], &["--spp"]);
    with(&["--a", "nan"], &["--a"]);
    with(&["--rays", "1"], &["--rays"]);
    with(&["--method", "magic"], &["magic", "irradiance"]);
    with(&["--camera", "nobody"], &["nobody", "camera"]);
    with(&["--error", "0"], &["--error", "expected a number from 0.001 to 0.5"]);
    with(&["--cache", &cornell], &["--cache", "expected a directory"]);
    with(&["--server", "nonsense"], &["nonsense"]);
    with(&["--stats", &out], &["--stats", "out.exr", "another file"]);
    with(&["--stats", &out.replace(".exr", ".png")], &["--stats", "out.png", "another file"]);
    with(&["--stats", &cornell], &["--stats", "cornell.glb", "is the scene"]);
    let folder = directory.path().join("folder.png");
    std::fs::create_dir(&folder).expect("folder");
    with(&["-o", &folder.with_extension("exr").display().to_string()], &["folder.png", "is a directory"]);
    std::fs::remove_dir(&folder).expect("empty folder");
    assert!(std::fs::read_dir(directory.path()).expect("directory").next().is_none(), "something was left");
}

#[test]
fn scenes_that_cannot_be_read_are_named_with_their_line() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let out = directory.path().join("out.exr").display().to_string();
    scene(directory.path(), "bad.vf", VIEW);
    let bad = |name: &str, content: &str, words: &[&str]| {
        let path = scene(directory.path(), name, content);
        let view = directory.path().join("bad.vf").display().to_string();
        refused(&["render", &path, "-o", &out, "--camera", &view], words);
    };
    refused(&["render", "missing.glb", "-o", &out], &["missing.glb"]);
    refused(&["render", "missing.xyz", "-o", &out], &["missing.xyz", ".rad"]);
    bad("not.glb", "hello", &["not.glb"]);
    bad("a.rad", "# comment\nvoid dielectric d\n0\n0\n5 1 1 1 1.5 0\n", &["a.rad:2", "dielectric"]);
    bad(
        "b.rad",
        "void plastic p\n0\n0\n5 .5 .5 .5 0 0\n\np polygon q\n0\n0\n9 0 0 0 1 0 0 0 nan 0\n",
        &["b.rad:", "polygon q"],
    );
    bad("c.rad", "void plastic p\n0\n0\n5 .5 .5 .5 0 0\np sphere s\n0\n0\n4 0 0 0 -1\n", &["c.rad:5", "sphere s"]);
    bad("d.rad", "!rm -rf everything\n", &["d.rad:1"]);
    assert!(!Path::new(&out).exists());
}

#[test]
fn scenes_without_light_and_cameras_that_see_nothing_are_black_with_a_warning() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let out = directory.path().join("out.exr").display().to_string();
    let sphere = "void plastic p\n0\n0\n5 .5 .5 .5 0 0\np sphere s\n0\n0\n4 0 0 0 1\n";
    let light = "void light l\n0\n0\n3 1 1 1\nl sphere lamp\n0\n0\n4 0 9 0 1\n";
    let away = VIEW.replace("-vd 0 0 -1", "-vd 0 0 1");
    let cases =
        [("dark", sphere.to_string(), VIEW, "light"), ("away", format!("{sphere}{light}"), &away, "sees no surface")];
    for (name, content, view, warning) in cases {
        let path = scene(directory.path(), &format!("{name}.rad"), &content);
        scene(directory.path(), &format!("{name}.vf"), view);
        let output =
            ambience(&["render", &path, "-o", &out, "--size", "16x16", "--spp", "1", "--rays", "16", "--quiet"]);
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{name}: {message}");
        assert!(message.contains(warning), "{name}: no '{warning}' in: {message}");
    }
}

#[test]
fn compare_prints_error_bias_and_worst_block() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let cornell = file("scenes/cornell.glb").display().to_string();
    let picture = |name: &str, seed: &str| {
        let out = directory.path().join(name).display().to_string();
        let small = ["--size", "32x32", "--spp", "1", "--method", "path", "--quiet", "--seed", seed];
        let args: Vec<&str> = ["render", &cornell, "-o", &out].into_iter().chain(small).collect();
        assert!(ambience(&args).status.success());
        out
    };
    let (a, b) = (picture("a.exr", "0"), picture("b.exr", "1"));
    let compare = |a: &str, b: &str| -> serde_json::Value {
        let output = ambience(&["compare", a, b, "--json"]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).expect("one JSON object")
    };
    let (same, other) = (compare(&a, &a), compare(&a, &b));
    println!("{same} {other}");
    for field in ["relative_rmse", "bias", "worst_block"] {
        assert_eq!(same[field], 0.0, "{field}");
        assert!(other[field].as_f64().is_some_and(|v| v != 0.0), "{field}: {other}");
    }
    refused(&["compare", &a, "missing.exr"], &["missing.exr"]);
    refused(&["compare", &a, "/dev/zero"], &["/dev/zero", "not a file"]);
}

/// Pipes whose reader is gone, and files on a full disk.
#[test]
#[cfg(target_os = "linux")]
fn output_nobody_reads_is_no_panic() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let out = directory.path().join("out.exr").display().to_string();
    let path = lit(directory.path());
    let render = ["render", &path, "-o", &out, "--size", "8x8", "--spp", "1", "--rays", "16"];
    let closed = || Stdio::from(std::io::pipe().expect("pipe").1);
    let full = || Stdio::from(std::fs::OpenOptions::new().write(true).open("/dev/full").expect("/dev/full"));
    let code = |args: &[&str], stdout: Stdio, stderr: Stdio| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
        command.args(args).stdin(Stdio::null()).stdout(stdout).stderr(stderr).status().expect("ambience starts").code()
    };
    assert_eq!(code(&render, closed(), closed()), Some(0));
    let compare = ["compare", &out, &out];
    assert_eq!(code(&compare, closed(), closed()), Some(0));
    assert_eq!(code(&["compare", &out, "missing.exr"], closed(), full()), Some(2));
    for args in [&render[..], &compare] {
        assert_eq!(code(args, full(), Stdio::null()), Some(1), "{args:?}");
    }
}

/// A record's reach in proportion to pixels must not exceed any scene.
#[test]
fn a_tiny_allowed_error_is_rendered() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let out = directory.path().join("out.exr").display().to_string();
    let path = lit(directory.path());
    let args = ["render", &path, "-o", &out, "--size", "8x8", "--spp", "1", "--rays", "16", "--quiet", "--a", "1e-30"];
    let output = ambience(&args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// The floats round what it sees are farther apart than its pixels.
#[test]
fn a_camera_that_sees_next_to_nothing_is_rendered() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let out = directory.path().join("out.exr").display().to_string();
    let path = lit(directory.path());
    scene(directory.path(), "lit.vf", &VIEW.replace("40", "1e-9"));
    let args = ["render", &path, "-o", &out, "--size", "8x8", "--spp", "1", "--rays", "16", "--quiet"];
    let output = ambience(&args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// A ball under an even sky, and its view beside it.
fn lit(directory: &Path) -> String {
    scene(directory, "lit.vf", VIEW);
    let ball = "void plastic p\n0\n0\n5 .5 .5 .5 0 0\np sphere s\n0\n0\n4 0 0 0 1\n";
    let sky = "void glow g\n0\n0\n4 1 1 1 0\ng source sky\n0\n0\n4 0 1 0 360\n";
    scene(directory, "lit.rad", &format!("{ball}{sky}"))
}
