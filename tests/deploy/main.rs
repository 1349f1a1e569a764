//! What is in deploy/, as it stands there: checked and run.
//!
//! A test whose tools are not on this machine says so and counts as ignored.

#[path = "../processes/mod.rs"]
mod processes;

mod compose;
mod container;
mod kubernetes;
mod openjd;
mod slurm;
mod systemd;

use std::path::{Path, PathBuf};
use std::process::Command;

use libtest_mimic::{Arguments, Failed, Trial};

/// A test, or why it cannot run here.
type Test = (&'static str, Result<Box<dyn FnOnce() + Send>, String>);

fn main() {
    let arguments = Arguments::from_args();
    let [preempted, lost] = slurm::tests();
    let [image, manifests] = [container::test(), kubernetes::test()];
    let trials = [compose::test(), image, manifests, openjd::test(), preempted, lost, systemd::test()].map(
        |(name, test): Test| match test {
            Ok(run) => Trial::test(name, move || {
                let ran = std::panic::catch_unwind(std::panic::AssertUnwindSafe(run));
                ran.map_err(|panic| {
                    let said = panic.downcast_ref::<String>().cloned();
                    Failed::from(said.unwrap_or_else(|| "it panicked".into()))
                })
            }),
            Err(why) => {
                eprintln!("tests/deploy: {name} is skipped: {why}");
                Trial::test(name, || Ok(())).with_ignored_flag(true)
            }
        },
    );
    libtest_mimic::run(&arguments, trials.into()).exit();
}

/// A file of deploy/.
fn deploy(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy").join(name)
}

/// Whether a program is there.
fn needs(program: &str) -> Result<(), String> {
    let found =
        std::env::var_os("PATH").is_some_and(|path| std::env::split_paths(&path).any(|p| p.join(program).is_file()));
    if found { Ok(()) } else { Err(format!("there is no {program}")) }
}

/// `PATH` with this build's `ambience` before all others.
fn path() -> std::ffi::OsString {
    let own = Path::new(env!("CARGO_BIN_EXE_ambience")).parent().expect("a folder").to_path_buf();
    let others = std::env::var_os("PATH").unwrap_or_default();
    std::env::join_paths([own].into_iter().chain(std::env::split_paths(&others))).expect("a path")
}

/// Runs a command to its end: what it wrote, which must be a success.
fn run(command: &mut Command) -> String {
    let output = command.output().expect("it starts");
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    assert!(output.status.success(), "{command:?}: {}\n{said}", output.status);
    said
}

/// Whether this build takes these arguments: what keeps it from going on is only that `missing` is not on this machine.
fn takes(arguments: &[String], environment: &[(&str, &str)], missing: &str) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
    let output = command.args(arguments).envs(environment.iter().copied()).output().expect("it starts");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && said.contains(missing), "{arguments:?}: {said}");
}

/// The documents of a file: as they are written, for the types that read them to be compared with.
fn documents(text: &str) -> Vec<serde_json::Value> {
    let documents = serde_norway::Deserializer::from_str(text);
    documents.map(|document| serde::Deserialize::deserialize(document).expect("a document")).collect()
}

/// What is written, as the type says. A type that ignores what it does not know would lose it.
fn typed<T: serde::de::DeserializeOwned + serde::Serialize>(written: &serde_json::Value) -> T {
    let read: T = serde_json::from_value(written.clone()).unwrap_or_else(|error| panic!("{error}: {written}"));
    assert_eq!(&serde_json::to_value(&read).expect("JSON"), written, "not all of it is known");
    read
}

/// A scene with two views, in `folder`.
fn views(folder: &Path) -> PathBuf {
    let scenes = ambience_bench::judge::file("scenes");
    let views = folder.join("views");
    std::fs::create_dir(&views).expect("a folder");
    let front = std::fs::read_to_string(scenes.join("cornell.vf")).expect("a view");
    let aside = front.replace("-vd 0 0 1", "-vd 0.03 0 1");
    assert_ne!(front, aside);
    std::fs::write(views.join("1.vf"), front).expect("written");
    std::fs::write(views.join("2.vf"), aside).expect("written");
    views
}

/// The scene, and settings of a small picture of it.
fn scene() -> PathBuf {
    ambience_bench::judge::file("scenes").join("cornell.rad")
}

const SMALL: &str = "--size 64x48 --rays 1024 --spp 4 --bounces 1";

/// The first view's picture, made by this machine alone.
fn alone(folder: &Path, views: &Path, more: &[&str]) -> Vec<u8> {
    let out = folder.join("alone.exr");
    let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
    command.arg("render").arg(scene()).arg("--camera").arg(views.join("1.vf")).arg("-o").arg(&out);
    run(command.arg("--quiet").args(SMALL.split(' ')).args(more));
    std::fs::read(out).expect("a picture")
}
