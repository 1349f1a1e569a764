//! A farm with a device that splats: real processes, the picture compared with that of the octree.
//!
//! Without a graphics adapter those that need one count as ignored, and say so.

mod processes;

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use ambience_bench::judge::file;
use libtest_mimic::{Arguments, Failed, Trial};
use processes::farm::Farm;
use processes::{ambience, busy_worker, collect, render, signal, wait_for};
use shaders::device::Gpu;
use worker::film;

const TESTS: [(&str, fn()); 6] = [
    ("the_picture_is_that_of_the_octree", the_picture_is_that_of_the_octree),
    ("a_splat_node_that_dies_is_done_without", a_splat_node_that_dies_is_done_without),
    ("who_did_not_ask_gets_the_bits_of_the_octree", who_did_not_ask_gets_the_bits_of_the_octree),
    ("a_farm_without_devices_does_what_is_asked", a_farm_without_devices_does_what_is_asked),
    ("a_preview_ends_as_the_picture", a_preview_ends_as_the_picture),
    ("a_preview_says_when_its_server_is_gone", a_preview_says_when_its_server_is_gone),
];

fn main() {
    let arguments = Arguments::from_args();
    let adapter = Gpu::new(true);
    let trial = |(name, test): (&'static str, fn())| match &adapter {
        Ok(_) => Trial::test(name, move || ran(test)),
        Err(lost) => {
            eprintln!("tests/splat: {name} is skipped: {lost}");
            Trial::test(name, || Ok(())).with_ignored_flag(true)
        }
    };
    let bare = ("without_an_adapter_it_ends_with_a_line", without_an_adapter_it_ends_with_a_line as fn());
    let trials = TESTS.into_iter().map(trial).chain([Trial::test(bare.0, move || ran(bare.1))]);
    libtest_mimic::run(&arguments, trials.collect()).exit();
}

fn ran(test: fn()) -> Result<(), Failed> {
    std::panic::catch_unwind(test).map_err(|panic| {
        let said = panic.downcast_ref::<String>().cloned();
        Failed::from(said.unwrap_or_else(|| "it panicked".into()))
    })
}

/// Holds that all but one in a thousand pixels differ by at most one in ten thousand; how many differ at all.
fn same(a: &Path, b: &Path) -> usize {
    let [a, b] = [a, b].map(|path| film::read(path).expect("a picture").rgb);
    assert_eq!(a.len(), b.len());
    let differs = |(a, b): (&[f32; 3], &[f32; 3]), most: f32| {
        let scale = a.iter().chain(b).fold(1e-6f32, |scale, v| scale.max(*v));
        a.iter().zip(b).any(|(a, b)| (a - b).abs() > most * scale)
    };
    let off = a.iter().zip(&b).filter(|pair| differs(*pair, 1e-4)).count();
    assert!(off * 1000 <= a.len(), "{off} of {} pixels are off", a.len());
    a.iter().zip(&b).filter(|pair| differs(*pair, 0.0)).count()
}

/// A small render; its folder.
fn rendered(scene: &str, more: &[&str]) -> (tempfile::TempDir, processes::Run) {
    let directory = tempfile::tempdir().expect("temporary directory");
    let status = ambience(directory.path(), scene, more).status().expect("ambience starts");
    assert!(status.success(), "{scene} {more:?}: {status}");
    let run = collect(directory.path());
    (directory, run)
}

fn the_picture_is_that_of_the_octree() {
    for (scene, method) in [("cornell.glb", "auto"), ("glossy-floor.glb", "radiance")] {
        let settings = ["--method", method];
        let (asked, by_octree) = rendered(scene, &[&settings[..], &["--workers", "2"]].concat());
        let (splat, by_device) = rendered(scene, &[&settings[..], &["--workers", "1", "--splat"]].concat());
        assert_eq!(by_device.records(), by_octree.records(), "records never come from a device");
        let samples = &by_device.stats["samples"];
        assert_eq!((&by_device.stats["samples_splatted"], samples.as_u64() > Some(0)), (samples, true));
        assert_eq!(by_octree.stats["samples_splatted"], 0);
        // It is another way to the same sums, not the same one.
        assert!(same(&asked.path().join("out.exr"), &splat.path().join("out.exr")) > 0, "{scene}");
        // With more samples where light varies.
        let error = ["--error", "0.1", "--workers", "1"];
        let varied = |more: &[&str]| {
            let directory = tempfile::tempdir().expect("temporary directory");
            let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
            command.arg("render").arg(file("scenes").join(scene)).args(["--size", "48x40", "--quiet"]);
            command.args(error).args(settings).args(more).arg("-o").arg(directory.path().join("out.exr"));
            assert!(command.status().expect("ambience starts").success());
            directory
        };
        let (asked, splat) = (varied(&[]), varied(&["--splat"]));
        same(&asked.path().join("out.exr"), &splat.path().join("out.exr"));
    }
}

fn a_splat_node_that_dies_is_done_without() {
    let settings = ["--rays", "4096", "--workers", "1"];
    let (whole, by_octree) = rendered("cornell.glb", &settings);
    let directory = tempfile::tempdir().expect("temporary directory");
    let mut child =
        ambience(directory.path(), "cornell.glb", &[&settings[..], &["--splat"]].concat()).spawn().expect("it starts");
    signal(busy_worker(&mut child), "KILL");
    assert!(child.wait().expect("wait").success());
    let run = collect(directory.path());
    assert_eq!((&run.stats["workers_lost"], run.records()), (&1.into(), by_octree.records()));
    // The one started in its place has no device.
    assert_eq!(run.stats["samples_splatted"], 0);
    assert_eq!(same(&whole.path().join("out.exr"), &directory.path().join("out.exr")), 0);
}

fn who_did_not_ask_gets_the_bits_of_the_octree() {
    let alone = render("cornell.glb", &["--workers", "1"]);
    let mut farm = Farm::start(&[], 0);
    farm.workers.push(processes::farm::start(&["worker", "--server", &farm.address, "--threads", "1", "--splat"]));
    let shared = render("cornell.glb", &["--server", &farm.address]);
    assert!(shared.exr == alone.exr, "another picture");
    let asked = render("cornell.glb", &["--server", &farm.address, "--splat"]);
    assert_eq!(asked.stats["samples_splatted"], asked.stats["samples"]);
    assert!(asked.exr != alone.exr, "its header says that a device made it");
    farm.end();
}

fn a_farm_without_devices_does_what_is_asked() {
    let farm = Farm::start(&[], 1);
    let asked = render("cornell.glb", &["--server", &farm.address, "--splat"]);
    assert_eq!(asked.stats["samples_splatted"], 0);
    farm.end();
}

/// The splatting command, to be ended by a signal.
fn preview(server: &str, out: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
    command.arg("splat").arg(file("scenes").join("stairs.glb")).args(["--server", server, "--every", "1"]);
    command.args(["--size", "96x80"]).arg("-o").arg(out);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn said(output: &Output) -> [String; 2] {
    [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes).into_owned())
}

fn a_preview_ends_as_the_picture() {
    let farm = Farm::start(&[], 1);
    let directory = tempfile::tempdir().expect("temporary directory");
    let out = directory.path().join("preview.png");
    let told = directory.path().join("told");
    let log = std::fs::File::create(&told).expect("a file");
    let mut child = preview(&farm.address, &out).stdout(log).stderr(Stdio::inherit()).spawn().expect("it starts");
    // It waits for records that are still to come.
    let (picture, run) = rendered("stairs.glb", &["--server", &farm.address, "--spp", "64"]);
    let records = run.stats["records"]["level 1"].as_u64().expect("a number");
    let mean = |path: &Path| {
        let bytes = image::open(path).expect("a picture").to_rgb8();
        assert_eq!(bytes.dimensions(), (96, 80));
        bytes.pixels().map(|pixel| pixel.0.map(f64::from)).collect::<Vec<_>>()
    };
    let finished = mean(&picture.path().join("out.png"));
    // In 8-bit steps: edges apart, since it has one sample a pixel, it is the picture.
    let off = |drawn: &[[f64; 3]]| {
        let differs = |(a, b): (&[f64; 3], &[f64; 3])| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 6.0);
        drawn.iter().zip(&finished).filter(|pair| differs(*pair)).count()
    };
    wait_for("the last preview", || {
        let told = std::fs::read_to_string(&told).expect("text");
        let drawn: u64 = told.lines().last()?.split(' ').nth(1)?.parse().expect("a number of records");
        (drawn >= records).then_some(())
    });
    signal(child.id(), "INT");
    assert_eq!(child.wait().expect("wait").code(), Some(130));
    let off = off(&mean(&out));
    assert!(off * 10 < finished.len(), "{off} of {}", finished.len());
    assert_eq!(std::fs::read_dir(directory.path()).expect("a folder").count(), 2, "nothing half-written");
    farm.end();
}

fn a_preview_says_when_its_server_is_gone() {
    let farm = Farm::start(&[], 0);
    let directory = tempfile::tempdir().expect("temporary directory");
    let child = preview(&farm.address, &directory.path().join("preview.png")).spawn().expect("it starts");
    std::thread::sleep(Duration::from_secs(2));
    farm.end();
    let output = child.wait_with_output().expect("wait");
    let [_, complained] = said(&output);
    assert_eq!(output.status.code(), Some(1), "{complained}");
    assert!(complained.contains("waiting for records of "), "{complained}");
    assert!(complained.lines().last().expect("a line").contains(": away for too long: "), "{complained}");
}

fn without_an_adapter_it_ends_with_a_line() {
    let bare = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
        let output = command.args(args).envs([("VK_DRIVER_FILES", "/none"), ("VK_ICD_FILENAMES", "/none")]).output();
        let output = output.expect("it starts");
        let [_, complained] = said(&output);
        assert_eq!(output.status.code(), Some(1), "{args:?}: {complained}");
        let last = complained.lines().last().unwrap_or_default().to_string();
        assert!(last.contains("there is no graphics adapter to splat with"), "{args:?}: {complained}");
    };
    let directory = tempfile::tempdir().expect("temporary directory");
    let (scene, out) = (file("scenes").join("stairs.glb"), directory.path().join("out.exr"));
    let [scene, out] = [&scene, &out].map(|path| path.to_str().expect("UTF-8"));
    bare(&["render", scene, "-o", out, "--splat"]);
    bare(&["worker", "--server", "127.0.0.1:9", "--splat"]);
    bare(&["splat", scene, "--server", "127.0.0.1:9", "-o", &out.replace("exr", "png")]);
    assert_eq!(std::fs::read_dir(directory.path()).expect("a folder").count(), 0);
}
