//! `ambience cache` as users type it: what it makes, what it says, how it fails.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use ambience_bench::judge::file;
use serde_json::Value;

fn ambience(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ambience")).args(args).stdin(Stdio::null()).output().expect("ambience starts")
}

fn cache(args: &[&str]) -> String {
    let output = ambience(&[&["cache"], args].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{args:?}: {said}");
    said
}

fn refused(args: &[&str], code: i32, words: &[&str]) {
    let output = ambience(&[&["cache"], args].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{args:?}: {said}");
    assert_eq!(said.trim_end().lines().count(), 1, "{args:?}: {said}");
    for word in words {
        assert!(said.contains(word), "{args:?}: no '{word}' in: {said}");
    }
}

fn info(path: &str) -> Value {
    let output = ambience(&["cache", "info", path, "--json"]);
    assert!(output.status.success(), "{path}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one JSON object")
}

/// What does not depend on where a cache lies or how it came to be.
fn held(path: &str) -> Vec<(Value, Value, Value, Value)> {
    let of = |n: &Value| (n["namespace"].clone(), n["label"].clone(), n["levels"].clone(), n["digest"].clone());
    info(path)["namespaces"].as_array().expect("a list").iter().map(of).collect()
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("temporary directory"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn name(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }

    fn write(&self, name: &str, content: impl AsRef<[u8]>) -> String {
        fs::write(self.path(name), content).expect("written");
        self.name(name)
    }

    fn bytes(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
    }

    fn names(&self) -> usize {
        fs::read_dir(self.0.path()).expect("directory").count()
    }
}

fn line(id: u32, level: u32) -> String {
    let namespace = "07".repeat(32);
    format!(
        "{{\"type\":\"record\",\"namespace\":\"{namespace}\",\"kind\":\"irradiance\",\"level\":{level},\"step\":0,\
         \"id\":\"{id:032x}\",\"position\":[{id}.5,2.0,3.0],\"normal\":[0.0,0.0,1.0],\"radius\":1.0,\"radius_min\":0.1,\
         \"radius_max\":10.0,\"irradiance\":[1.0,2.0,3.0],\"gradient_t\":[[0.0,0.1],[0.2,0.3],[0.4,0.5]],\
         \"gradient_r\":[[0.0,0.1],[0.2,0.3],[0.4,0.5]],\"ellipse\":[1.0,0.5,1.0],\"noise\":0.25}}\n"
    )
}

fn lines(ids: std::ops::Range<u32>) -> String {
    ids.map(|id| line(id, 1 + id % 2)).collect()
}

fn render(folder: &Folder, camera: &str, cache: &str) -> Vec<u8> {
    let out = folder.name("out.exr");
    let scene = file("scenes/cornell.glb").display().to_string();
    let small = ["--size", "48x40", "--rays", "64", "--spp", "1", "--quiet", "--cache", cache];
    let output = ambience(&[&["render", &scene, "-o", &out], &small[..], &["--camera", camera]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    folder.bytes("out.exr")
}

/// Two servers that ran apart on one scene.
#[test]
fn caches_filled_apart_unite_in_either_order_to_the_same() {
    let folder = Folder::new();
    let one = folder.write("one.vf", "rvu -vtv -vp 0.28 0.27 -0.8 -vd 0 0 1 -vu 0 1 0 -vh 40 -vv 35\n");
    let two = folder.write("two.vf", "rvu -vtv -vp 0.35 0.25 -0.7 -vd -0.1 0 1 -vu 0 1 0 -vh 40 -vv 35\n");
    let name = |name: &str| folder.name(name);
    render(&folder, &one, &name("a"));
    render(&folder, &two, &name("b"));
    cache(&["merge", &name("a"), &name("b"), "-o", &name("ab")]);
    cache(&["export", &name("b"), "-o", &name("b.ambience")]);
    cache(&["merge", &name("b.ambience"), &name("a"), &name("b"), &name("a"), "-o", &name("ba")]);

    let union = held(&name("ab"));
    assert_eq!(union, held(&name("ba")));
    assert_eq!(union.len(), 1, "one scene, one namespace: {union:?}");
    assert_eq!(union[0].1["scene"], "cornell.glb");
    let count = |held: &[(Value, Value, Value, Value)]| held[0].2["1"].as_u64().expect("records");
    let (a, b) = (count(&held(&name("a"))), count(&held(&name("b"))));
    assert!(count(&union) > a.max(b) && count(&union) <= a + b, "{a} and {b}: {union:?}");
    for form in ["ambience", "jsonl"] {
        let (ab, ba) = (format!("ab.{form}"), format!("ba.{form}"));
        cache(&["export", &name("ab"), "-o", &name(&ab)]);
        cache(&["export", &name("ba"), "-o", &name(&ba)]);
        assert!(folder.bytes(&ab) == folder.bytes(&ba), "{form}");
        let back = format!("{form}.back");
        cache(&["import", &name(&ab), "-o", &name(&back)]);
        assert_eq!(held(&name(&back)), union, "{form}");
    }
    // The same records make the same picture.
    assert!(render(&folder, &one, &name("ab")) == render(&folder, &one, &name("ba")));
}

#[test]
fn what_is_imported_is_told_and_comes_back() {
    let folder = Folder::new();
    let (some, more) = (folder.write("some.jsonl", lines(0..10)), folder.write("more.jsonl", lines(5..12)));
    let (c, out) = (folder.name("c"), folder.name("out.jsonl"));
    cache(&["import", &some, "-o", &c]);
    cache(&["import", &more, &some, "-o", &c]);
    let told = info(&c);
    assert_eq!((&told["state"], &told["damage"], &told["publications"]), (&"closed".into(), &Value::Null, &0.into()));
    let namespace = &told["namespaces"][0];
    assert_eq!(namespace["levels"], serde_json::json!({ "1": 6, "2": 6 }));
    assert_eq!((&namespace["records"], &namespace["conflicts"]), (&12.into(), &0.into()));
    assert_eq!(namespace["digest"], format!("{:032x}", (0..12).sum::<u128>()));
    let text = String::from_utf8(ambience(&["cache", "info", &c]).stdout).expect("text");
    assert!(text.contains("whole\nnamespace 0707") && text.contains("12 (6 of level 1, 6 of level 2)"), "{text}");

    cache(&["export", &c, "-o", &out]);
    let mut expected: Vec<_> = (0..12).map(|id| (1 + id % 2, line(id, 1 + id % 2))).collect();
    expected.sort_by_key(|(level, _)| *level);
    assert_eq!(fs::read_to_string(&out).expect("text"), expected.into_iter().map(|(_, line)| line).collect::<String>());
}

#[test]
fn damage_is_told_by_info_and_merging_mends_it() {
    let folder = Folder::new();
    let c = folder.name("c");
    for from in 0..4u32 {
        let part = folder.write("part.jsonl", lines(from * 10..from * 10 + 10));
        cache(&["import", &part, "-o", &c]);
    }
    let journal = Path::new(&c).join("journal.redb");
    let mut bytes = fs::read(&journal).expect("there");
    // Every place where the records of the second import lie.
    let id = 13u128.to_le_bytes();
    let mut spoilt = 0;
    for at in 0..bytes.len() - id.len() {
        if bytes[at..at + id.len()] == id {
            bytes[at] ^= 128;
            spoilt += 1;
        }
    }
    assert!(spoilt > 0);
    fs::write(&journal, &bytes).expect("written");
    let told = info(&c);
    assert_eq!(told["state"], "damaged");
    assert_eq!(told["damage"]["records_lost"], 10, "{told}");
    assert_eq!(fs::read(&journal).expect("there"), bytes, "info changed it");

    let said = cache(&["merge", &c, "-o", &folder.name("sound")]);
    assert!(said.contains("is damaged") && said.contains("10 records"), "{said}");
    assert_eq!(info(&folder.name("sound"))["state"], "closed");
    assert_eq!(info(&folder.name("sound"))["namespaces"][0]["records"], 30);
    let part = folder.write("part.jsonl", lines(10..20));
    let said = cache(&["import", &part, "-o", &c]);
    assert!(said.contains("journal.redb.damaged-1"), "{said}");
    assert_eq!(info(&c)["namespaces"][0]["records"], 40);
}

#[test]
fn what_cannot_be_read_or_written_is_one_line() {
    let folder = Folder::new();
    let good = folder.write("good.jsonl", lines(0..3));
    let bad = folder.write("bad.jsonl", lines(0..3).replacen("\"radius\":1.0", "\"radius\":-1.0", 2));
    let (c, new) = (folder.name("c"), folder.name("new"));
    cache(&["import", &good, "-o", &c]);
    cache(&["export", &c, "-o", &folder.name("cut.ambience")]);
    let mut cut = folder.bytes("cut.ambience");
    cut.truncate(cut.len() - 1);
    let cut = folder.write("cut.ambience", cut);
    let foreign = folder.name("foreign");
    fs::create_dir(&foreign).expect("made");
    fs::write(Path::new(&foreign).join("journal.redb"), "a letter").expect("written");
    let names = folder.names();

    refused(&["import", &bad, "-o", &new], 2, &["bad.jsonl: line 1: radius is -1"]);
    refused(&["import", &good, &cut, "-o", &new], 2, &["cut.ambience: byte ", "cut short"]);
    refused(&["import", &c, "-o", &new], 2, &[".jsonl or .ambience"]);
    refused(&["import", &good, "-o", &foreign], 2, &["is no journal of ambience"]);
    refused(&["info", &folder.name("missing")], 2, &["missing", "No such file"]);
    refused(&["info", folder.0.path().to_str().expect("text")], 2, &["holds no cache"]);
    refused(&["info", &foreign], 2, &["is no journal of ambience"]);
    refused(&["merge", &c, "-o", &foreign], 2, &["is not empty"]);
    refused(&["merge", &c, &bad, "-o", &new], 2, &["bad.jsonl: line 1"]);
    refused(&["merge", &c], 2, &["--output"]);
    refused(&["merge", &c, "-o", &folder.name("no/where")], 2, &["is not a directory"]);
    refused(&["export", &c, "-o", &folder.name("out.csv")], 2, &["out.csv", ".jsonl or .ambience"]);
    refused(&["export", &c, "-o", &folder.name("no/out.jsonl")], 2, &["is not a directory"]);
    assert_eq!(folder.names(), names, "something was left");
    assert_eq!(fs::read(Path::new(&foreign).join("journal.redb")).expect("there"), b"a letter");
}
