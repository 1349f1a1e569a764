//! Records outlive what made them: renders that use a cache directory, and processes that die, compared byte by byte.

mod processes;

use std::path::Path;
use std::process::{Command, Stdio};

use ambience_bench::judge::file;
use processes::{Run, alive, ambience, busy_worker, children, collect, render, signal, wait_for};

/// A render with a cache directory, and what it said.
fn cached(cache: &Path, scene: &str, more: &[&str]) -> (Run, String) {
    let directory = tempfile::tempdir().expect("temporary directory");
    let mut command = ambience(directory.path(), scene, more);
    let output = command.arg("--cache").arg(cache).stderr(Stdio::piped()).output().expect("ambience starts");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{scene} {more:?}: {said}");
    (collect(directory.path()), said)
}

impl Run {
    fn count(&self, name: &str) -> u64 {
        self.stats["records"][name].as_u64().unwrap_or(0)
    }

    /// Records the frame gathered.
    fn gathered(&self) -> u64 {
        self.count("total") - self.count("base")
    }
}

#[test]
fn a_second_render_gathers_nothing_and_a_moved_camera_only_what_it_newly_sees() {
    let cache = tempfile::tempdir().expect("temporary directory");
    let alone = render("cornell.glb", &[]);
    let (first, _) = cached(cache.path(), "cornell.glb", &[]);
    assert_eq!(first.records(), alone.records());
    assert!(first.exr == alone.exr, "a cache that is empty changes nothing");

    let (again, said) = cached(cache.path(), "cornell.glb", &["--workers", "3"]);
    assert_eq!((again.gathered(), again.count("base")), (0, first.count("total")), "{}", again.stats);
    assert!(again.exr == first.exr, "the same view, another picture");
    assert!(!said.contains("new namespace"), "{said}");

    // A step aside, and the whole picture from elsewhere for comparison.
    let view = cache.path().join("aside.vf");
    std::fs::write(&view, "rvu -vtv -vp 0.32 0.25 -0.8 -vd -0.03 0.01 1 -vu 0 1 0 -vh 41 -vv 35\n").expect("written");
    let view = view.display().to_string();
    let moved_alone = render("cornell.glb", &["--camera", &view]);
    let (moved, _) = cached(cache.path(), "cornell.glb", &["--camera", &view]);
    let (new, whole) = (moved.gathered(), moved_alone.count("total"));
    assert!(new > 0 && new < whole / 2, "{new} new records, {whole} without the cache");

    // Records another view added clamp those of the first here and there: it mends a few holes.
    let (back, _) = cached(cache.path(), "cornell.glb", &[]);
    assert!(back.gathered() * 100 < first.count("total"), "{}", back.stats);
}

#[test]
fn a_moved_camera_finds_records_of_settings_a_step_from_its_own() {
    let cache = tempfile::tempdir().expect("temporary directory");
    let view = cache.path().join("aside.vf");
    std::fs::write(&view, "rvu -vtv -vp 0.32 0.25 -0.8 -vd -0.03 0.01 1 -vu 0 1 0 -vh 41 -vv 35\n").expect("written");
    let asked = |more: &[&str]| {
        let directory = tempfile::tempdir().expect("temporary directory");
        let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
        command.arg("render").arg(file("scenes").join("cornell.glb")).arg("-o").arg(directory.path().join("out.exr"));
        command.arg("--stats").arg(directory.path().join("stats.json"));
        command.args(["--quiet", "--size", "96x96", "--error", "0.3"]).args(more);
        assert!(command.status().expect("ambience starts").success());
        collect(directory.path())
    };
    let (view, kept) = (view.to_str().expect("UTF-8"), cache.path().join("cache"));
    let kept = ["--cache", kept.to_str().expect("UTF-8")];
    let rays = |run: &Run| run.stats["settings"]["rays_by_deviation"].as_f64().expect("a number");
    let (alone, first) = (asked(&["--camera", view]), asked(&kept));
    assert!(rays(&alone) != rays(&first), "the pilot chose the same for both: other views show it");
    let moved = asked(&[&kept[..], &["--camera", view]].concat());
    assert_eq!((rays(&moved), moved.count("base")), (rays(&first), first.count("total")), "{}", moved.stats);
    assert!(moved.gathered() * 4 < alone.count("total"), "{}", moved.stats);
    // The same view is the same picture still.
    let again = asked(&[&kept[..], &["--camera", view]].concat());
    assert!(again.gathered() == 0 && again.exr == moved.exr, "{}", again.stats);
}

#[test]
fn a_second_view_of_a_glossy_floor_needs_few_new_records() {
    let cache = tempfile::tempdir().expect("temporary directory");
    let (first, _) = cached(cache.path(), "glossy-floor.glb", &["--method", "radiance"]);
    assert!(first.count("radiance") > 100, "{}", first.stats);
    let view = cache.path().join("aside.vf");
    std::fs::write(&view, "rvu -vtv -vp 0.33 0.30 -0.78 -vd -0.06 -0.03 1 -vu 0 1 0 -vh 39 -vv 39\n").expect("written");
    let (moved, _) =
        cached(cache.path(), "glossy-floor.glb", &["--method", "radiance", "--camera", &view.display().to_string()]);
    let (new, all) = (moved.gathered(), first.gathered());
    println!("{new} new records, {} of radiance, after {all}", moved.count("radiance"));
    assert!(new * 3 < all && moved.count("radiance") * 3 < first.count("radiance"), "{}", moved.stats);
}

#[test]
fn what_changes_records_opens_a_new_namespace_and_says_so() {
    let cache = tempfile::tempdir().expect("temporary directory");
    let (first, said) = cached(cache.path(), "cornell.glb", &[]);
    assert!(!said.contains("new namespace"), "{said}");
    let (fewer, said) = cached(cache.path(), "cornell.glb", &["--rays", "128"]);
    assert!(said.contains("made with --rays 256") && said.contains("new namespace"), "{said}");
    assert_eq!(fewer.count("base"), 0);
    let (other, said) = cached(cache.path(), "stairs.glb", &[]);
    assert!(said.contains("records of cornell.glb only"), "{said}");
    assert_eq!(other.count("base"), 0);
    assert!(other.exr == render("stairs.glb", &[]).exr, "records of another scene were mixed in");
    let (again, said) = cached(cache.path(), "cornell.glb", &["--spp", "2"]);
    assert_eq!((again.count("base"), again.gathered()), (first.count("total"), 0), "spp changes no record");
    assert!(!said.contains("namespace"), "{said}");
}

#[test]
fn a_render_killed_in_the_middle_goes_on_where_it_was_and_gives_the_same_picture() {
    let settings = ["--rays", "4096", "--workers", "2"];
    let whole = render("cornell.glb", &settings);
    for name in ["KILL", "TERM"] {
        let cache = tempfile::tempdir().expect("temporary directory");
        let directory = tempfile::tempdir().expect("temporary directory");
        let mut command = ambience(directory.path(), "cornell.glb", &settings);
        let mut child = command.arg("--cache").arg(cache.path()).spawn().expect("ambience starts");
        busy_worker(&mut child);
        let family = [children(child.id(), "worker"), children(child.id(), "serve")].concat();
        signal(child.id(), name);
        assert!(!child.wait().expect("wait").success());
        wait_for("the children to end", || family.iter().all(|p| !alive(*p)).then_some(()));

        let (resumed, _) = cached(cache.path(), "cornell.glb", &settings);
        assert!(resumed.count("reused") > 0, "{}", resumed.stats);
        assert_eq!(resumed.stats["digest"], whole.stats["digest"]);
        assert!(resumed.exr == whole.exr, "{name}: another picture");
    }
}

#[test]
fn a_server_killed_in_the_middle_is_refilled_and_changes_nothing() {
    let settings = ["--rays", "4096", "--workers", "2"];
    let whole = render("cornell.glb", &settings);
    let cache = tempfile::tempdir().expect("temporary directory");
    // In memory: its workers bring back what it lost. With a directory: so does the disk.
    for more in [vec![], vec!["--cache", cache.path().to_str().expect("UTF-8")], vec!["--transport", "tcp"]] {
        let directory = tempfile::tempdir().expect("temporary directory");
        let mut command = ambience(directory.path(), "cornell.glb", &[&settings, &more[..]].concat());
        let mut child = command.stderr(Stdio::null()).spawn().expect("ambience starts");
        busy_worker(&mut child);
        signal(children(child.id(), "serve")[0], "KILL");
        assert!(child.wait().expect("wait").success());
        let run = collect(directory.path());
        assert_eq!(run.stats["servers_lost"], 1, "{}", run.stats);
        assert!(run.count("reused") > 0, "{}", run.stats);
        assert_eq!(run.stats["digest"], whole.stats["digest"]);
        assert!(run.exr == whole.exr, "{more:?}: another picture");
    }
}

#[test]
fn a_worker_stopped_in_the_middle_loses_its_lease_and_changes_nothing() {
    let settings = ["--rays", "4096", "--workers", "2"];
    let whole = render("cornell.glb", &settings);
    // Between two leases it has none to lose; that is rare.
    let lost = (0..5).any(|_| {
        let directory = tempfile::tempdir().expect("temporary directory");
        let mut child = ambience(directory.path(), "cornell.glb", &settings).spawn().expect("ambience starts");
        let worker = busy_worker(&mut child);
        signal(worker, "STOP");
        assert!(child.wait().expect("wait").success());
        let run = collect(directory.path());
        assert_eq!(run.records(), whole.records());
        assert!(run.exr == whole.exr, "another picture");
        run.stats["leases_lost"].as_u64() >= Some(1)
    });
    assert!(lost, "no lease was lost in five attempts");
}

#[test]
fn server_and_worker_killed_together_change_nothing() {
    let settings = ["--rays", "4096", "--workers", "2"];
    let whole = render("cornell.glb", &settings);
    let directory = tempfile::tempdir().expect("temporary directory");
    let mut child =
        ambience(directory.path(), "cornell.glb", &settings).stderr(Stdio::null()).spawn().expect("ambience starts");
    let worker = busy_worker(&mut child);
    signal(children(child.id(), "serve")[0], "KILL");
    signal(worker, "KILL");
    assert!(child.wait().expect("wait").success());
    let run = collect(directory.path());
    assert_eq!((&run.stats["servers_lost"], &run.stats["workers_lost"]), (&1.into(), &1.into()), "{}", run.stats);
    assert_eq!(run.stats["digest"], whole.stats["digest"]);
    assert!(run.exr == whole.exr, "another picture");
}

#[test]
fn a_cache_in_use_or_that_is_a_file_is_one_line() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let file = directory.path().join("file");
    std::fs::write(&file, "precious").expect("written");
    let refused = |more: &[&str], cache: &Path| {
        let mut command = ambience(directory.path(), "cornell.glb", more);
        let output = command.arg("--cache").arg(cache).stderr(Stdio::piped()).output().expect("ambience starts");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(said.trim_end().lines().count(), 1, "{said}");
        (output.status.code(), said)
    };
    let (code, said) = refused(&[], &file);
    assert!(code == Some(2) && said.contains("expected a directory"), "{said}");

    let cache = directory.path().join("cache");
    let mut command = ambience(directory.path(), "cornell.glb", &["--rays", "65536"]);
    let mut child = command.arg("--cache").arg(&cache).spawn().expect("ambience starts");
    busy_worker(&mut child);
    let (code, said) = refused(&[], &cache);
    assert!(code == Some(1) && said.contains("in use by another process"), "{said}");
    signal(child.id(), "TERM");
    child.wait().expect("wait");
}
