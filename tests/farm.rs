//! One picture, whatever the farm: real processes, compared byte by byte.
//!
//! Every run is the program as users start it. What is varied may change the clock, never the picture or the records.

mod processes;

use std::path::PathBuf;
use std::process::Stdio;
use std::time::{Duration, Instant};

use processes::farm::Farm;
use processes::{alive, ambience, busy_worker, children, collect, render, signal, wait_for};

#[test]
fn the_picture_does_not_depend_on_workers_threads_transport_or_run() {
    for (scene, method, radiance) in [("cornell.glb", "auto", 0), ("glossy-floor.rad", "radiance", 100)] {
        let render = |more: &[&str]| render(scene, &[&["--method", method], more].concat());
        let first = render(&["--workers", "1"]);
        let records = &first.stats["records"];
        assert!(
            records["total"].as_u64() > Some(100) && records["radiance"].as_u64().unwrap_or(0) >= radiance,
            "{records}"
        );
        let others: [&[&str]; 6] = [
            &["--workers", "1"],
            &["--workers", "2"],
            &["--workers", "5"],
            &["--workers", "1", "--threads", "2"],
            &["--workers", "2", "--threads", "2"],
            &["--workers", "2", "--transport", "tcp"],
        ];
        for more in others {
            let other = render(more);
            assert_eq!(other.records(), first.records(), "{scene} {more:?}");
            assert!(other.exr == first.exr, "{scene} {more:?}: another picture");
        }
        // The comparison can fail: another seed gives another picture and other records.
        let seeded = render(&["--workers", "2", "--seed", "1"]);
        assert_ne!(seeded.stats["digest"], first.stats["digest"]);
        assert!(seeded.exr != first.exr);
    }
}

#[test]
fn a_worker_killed_in_the_middle_changes_nothing() {
    let settings = ["--rays", "4096", "--workers", "2"];
    let whole = render("cornell.glb", &settings);
    let directory = tempfile::tempdir().expect("temporary directory");
    let mut child = ambience(directory.path(), "cornell.glb", &settings).spawn().expect("ambience starts");
    let worker = busy_worker(&mut child);
    signal(worker, "KILL");
    assert!(child.try_wait().expect("wait").is_none(), "killed too late to matter");
    let status = child.wait().expect("wait");
    assert!(status.success(), "{status}");
    let run = collect(directory.path());
    assert_eq!(run.stats["workers_lost"], 1, "{}", run.stats);
    assert_eq!(run.records(), whole.records());
    assert!(run.exr == whole.exr, "another picture");
}

#[test]
fn interrupted_renders_leave_nothing_behind() {
    for (name, code) in [("INT", 130), ("TERM", 143)] {
        let directory = tempfile::tempdir().expect("temporary directory");
        let mut child =
            ambience(directory.path(), "cornell.glb", &["--rays", "65536"]).spawn().expect("ambience starts");
        let worker = busy_worker(&mut child);
        let family = [children(child.id(), "worker"), children(child.id(), "serve")].concat();
        assert!(family.len() >= 2, "{family:?}");
        signal(child.id(), name);
        let status = child.wait().expect("wait");
        assert_eq!(status.code(), Some(code), "{name}");
        wait_for("the children to end", || family.iter().all(|p| !alive(*p)).then_some(()));
        assert!(!alive(worker));
        let left: Vec<PathBuf> =
            std::fs::read_dir(directory.path()).expect("directory").flatten().map(|e| e.path()).collect();
        assert!(left.is_empty(), "{left:?}");
    }
}

#[test]
fn children_end_even_when_render_is_killed() {
    let directory = tempfile::tempdir().expect("temporary directory");
    let mut child = ambience(directory.path(), "cornell.glb", &["--rays", "65536"]).spawn().expect("ambience starts");
    busy_worker(&mut child);
    let family = [children(child.id(), "worker"), children(child.id(), "serve")].concat();
    child.kill().expect("kill");
    child.wait().expect("wait");
    wait_for("the children to end", || family.iter().all(|p| !alive(*p)).then_some(()));
}

/// The same parts by hand: a server, two workers, and two renders that use them one after the other.
#[test]
fn server_and_workers_started_by_hand_give_the_same_picture() {
    let farm = Farm::start(&[], 2);
    let shared = render("cornell.glb", &["--server", &farm.address]);
    // A second frame on the same server finds every record it needs.
    let again = render("cornell.glb", &["--server", &farm.address]);
    let alone = render("cornell.glb", &["--workers", "1"]);
    farm.end();
    assert_eq!(shared.stats["digest"], alone.stats["digest"]);
    assert!(shared.exr == alone.exr, "another picture");
    assert_eq!(again.stats["digest"], alone.stats["digest"], "the second frame added records");
    assert!(again.exr == alone.exr, "another picture from the records of the first");
}

/// One worker begins the picture, another joins, the first leaves in good order, a third joins and ends it.
#[test]
fn workers_that_join_and_leave_in_the_middle_change_nothing() {
    let settings = ["--rays", "4096"];
    let alone = render("cornell.glb", &[&settings[..], &["--workers", "2"]].concat());
    let mut farm = Farm::start(&[], 1);
    let directory = tempfile::tempdir().expect("temporary directory");
    let mut command =
        ambience(directory.path(), "cornell.glb", &[&settings[..], &["--server", &farm.address]].concat());
    let mut child = command.spawn().expect("ambience starts");
    for _ in 0..2 {
        farm.busy();
        farm.join();
        farm.busy();
        assert!(child.try_wait().expect("wait").is_none(), "the picture was done too early");
        // Within the grace of any scheduler, and it is no failure.
        let mut leaving = farm.workers.remove(0);
        signal(leaving.id(), "TERM");
        let asked = Instant::now();
        assert!(leaving.wait().expect("wait").success());
        assert!(asked.elapsed() < Duration::from_secs(5));
    }
    assert!(child.wait().expect("wait").success());
    let run = collect(directory.path());
    // What it had was given back, not waited for.
    assert!(run.stats["leases_lost"].as_u64() >= Some(1), "{}", run.stats);
    assert_eq!(run.records(), alone.records());
    assert!(run.exr == alone.exr, "another picture");
    farm.end();
}

/// What a server will never have room for is not asked for again and again, and the next who asks for less has it.
#[test]
fn a_permanent_bound_ends_the_frame_with_one_line() {
    for (limit, line) in [
        ("records=100", "no room for more records: this server keeps at most 100"),
        ("namespaces=1", "no room for more namespaces: this server keeps at most 1"),
    ] {
        let farm = Farm::start(&["--limit", limit], 2);
        let directory = tempfile::tempdir().expect("temporary directory");
        let mut refused = ambience(directory.path(), "cornell.glb", &["--server", &farm.address]);
        let mut refused = refused.stderr(Stdio::piped()).spawn().expect("ambience starts");
        let status = wait_for("the render to give up", || refused.try_wait().expect("wait"));
        let said = std::io::read_to_string(refused.stderr.take().expect("piped")).expect("text");
        assert_eq!(status.code(), Some(1), "{limit}: {said}");
        assert_eq!(said.lines().count(), 1, "{limit}: {said}");
        assert!(said.starts_with("ambience: ") && said.contains(line), "{limit}: {said}");
        assert!(!directory.path().join("out.exr").exists(), "{limit}: half a picture");

        let path = ["--method", "path", "--server", &farm.address];
        assert!(render("cornell.glb", &path).exr.len() > 1000, "{limit}");
        farm.end();
    }
}
