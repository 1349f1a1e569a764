//! What the fuzz targets check, on their seeds and on every input kept in `fuzz/findings/TARGET/`: no fuzzer is needed.

#[path = "../fuzz/src/lib.rs"]
mod fuzz;

use std::path::Path;

fn run(target: &str) {
    let (_, check) = fuzz::TARGETS.into_iter().find(|(name, _)| *name == target).expect("a target");
    let seeds = fuzz::seeds::seeds(target);
    assert!(!seeds.is_empty());
    seeds.iter().for_each(|seed| check(seed));
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/findings").join(target);
    for file in std::fs::read_dir(folder).into_iter().flatten() {
        check(&std::fs::read(file.expect("readable").path()).expect("readable"));
    }
}

#[test]
fn records() {
    run("record");
}

#[test]
fn batches() {
    run("batch");
}

#[test]
fn stores() {
    run("store");
}

#[test]
fn scenes() {
    run("scene");
}

#[test]
fn frames() {
    run("frame");
}
