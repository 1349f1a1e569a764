use std::fs;
use std::path::{Path, PathBuf};

use cache_core::{Irradiance, Radiance, RecordId, Shrink};
use glam::{Vec2, Vec3};
use proptest::prelude::*;

use super::*;
use crate::journal::Journal as _;
use crate::journal::device::Sync;
use crate::journal::disk::{Disk, FILE};
use crate::journal::survey::State;

const NAMESPACE: Namespace = Namespace([7; 32]);
const DRAFT: Namespace = Namespace([9; 32]);
const OTHER: Namespace = Namespace([3; 32]);

fn record(id: u32, x: f32) -> Irradiance {
    Irradiance {
        id: RecordId(u128::from(id) << 64 | 5),
        position: Vec3::new(x, 1e-30, -0.0),
        normal: Vec3::Z,
        radius: 0.1,
        radius_min: 1e-7,
        radius_max: 16_777_217.0,
        irradiance: Vec3::new(1.0 / 3.0, 0.0, 5e9),
        gradient_t: [Vec2::new(0.1, -f32::MIN_POSITIVE); 3],
        gradient_r: [Vec2::new(1e20, 3.402_823e38); 3],
        ellipse: [0.0; 3],
        noise: 0.0,
    }
}

fn batch(namespace: Namespace, level: u32, step: u32, records: &[Irradiance]) -> v1::Entry {
    v1::Entry { entry: Some(Kind::Batch(convert::pack(&namespace, Tag { level, step }, records))) }
}

fn proposals(namespace: Namespace, step: u32, of: &[(u32, u8)]) -> v1::Entry {
    let shrink = |&(of, a): &(u32, u8)| Shrink::new(record(of, 0.0).id, 0.1 + f32::from(a));
    let shrinks: Vec<_> = of.iter().map(shrink).collect();
    v1::Entry { entry: Some(Kind::Batch(convert::pack(&namespace, Tag { level: 1, step }, &shrinks))) }
}

fn label(namespace: Namespace, draft_of: Option<Namespace>) -> v1::Entry {
    let draft_of = draft_of.map_or(Vec::new(), |of| of.0.to_vec()).into();
    v1::Entry {
        entry: Some(Kind::Label(v1::Label {
            namespace: namespace.0.to_vec().into(),
            scene: "a \"scene\"\n.glb".into(),
            scene_hash: vec![1; 32].into(),
            method: "irradiance".into(),
            a: 0.3,
            rays: 2048,
            rays_by_deviation: 0.5,
            least_rays: 64,
            bounces: u32::MAX,
            seed: u64::MAX,
            owner: String::new(),
            draft_of,
        })),
    }
}

fn publication(draft: Namespace, namespace: Namespace) -> v1::Entry {
    let (draft, namespace) = (draft.0.to_vec().into(), namespace.0.to_vec().into());
    v1::Entry { entry: Some(Kind::Publication(v1::Publication { draft, namespace })) }
}

/// All kinds of entries, with repeats and conflicts.
fn entries() -> impl Strategy<Value = Vec<v1::Entry>> {
    let namespace = || prop::sample::select(vec![NAMESPACE, DRAFT, OTHER]);
    let records = prop::collection::vec((0..30u32, 0..2u8), 0..8);
    let shrinks = (namespace(), 0..3u32, records.clone()).prop_map(|(n, step, of)| proposals(n, step, &of));
    let batch = (namespace(), 1..3u32, 0..3u32, records).prop_map(|(namespace, level, step, records)| {
        let records: Vec<_> = records.iter().map(|&(id, x)| record(id, x.into())).collect();
        batch(namespace, level, step, &records)
    });
    let rare = prop::sample::select(vec![
        label(NAMESPACE, None),
        label(DRAFT, Some(NAMESPACE)),
        publication(DRAFT, NAMESPACE),
    ]);
    prop::collection::vec(prop_oneof![5 => batch, 2 => shrinks, 1 => rare], 0..12)
}

fn archive(entries: &[v1::Entry]) -> Archive {
    let mut archive = Archive::default();
    entries.iter().for_each(|entry| archive.apply(entry).expect("sound"));
    archive.settle();
    archive
}

fn read(paths: &[&Path]) -> Archive {
    let mut archive = Archive::default();
    for path in paths {
        archive.unite(path).expect("readable");
    }
    archive
}

fn binary(archive: &Archive) -> Vec<u8> {
    let mut writer = binary::Writer::new(Vec::new());
    archive.entries(&mut |entry| writer.entry(entry)).expect("memory");
    writer.end().expect("memory")
}

/// All but the count of conflicts, which depends on what met what.
fn summaries(archive: &Archive) -> Vec<Summary> {
    archive.summaries().into_iter().map(|summary| Summary { conflicts: 0, ..summary }).collect()
}

/// A cache that was filled by a server.
fn cache(directory: &Path, name: &str, entries: &[v1::Entry]) -> PathBuf {
    let path = directory.join(name);
    let (mut disk, _) = Disk::open(&path, Sync::PageCache).expect("a journal");
    entries.chunks(3).for_each(|group| disk.append(group).expect("room"));
    path
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn merging_is_a_union_in_any_order(a in entries(), b in entries(), turn in 0..12usize) {
        let ab = archive(&[&a[..], &b].concat());
        let mut mixed = [&b[..], &a, &a].concat();
        let middle = turn % mixed.len().max(1);
        mixed.rotate_left(middle);
        let ba = archive(&mixed);
        prop_assert_eq!(summaries(&ab), summaries(&ba));
        prop_assert_eq!(binary(&ab), binary(&ba));
    }

    /// Every form holds all there is, to the bit.
    #[test]
    fn every_form_comes_back_as_it_was(a in entries(), b in entries()) {
        let directory = tempfile::tempdir().expect("a directory");
        let at = |name: &str| directory.path().join(name);
        let (one, two) = (cache(directory.path(), "a", &a), cache(directory.path(), "b", &b));
        let both = archive(&[&a[..], &b].concat());
        let united = read(&[&two, &one, &two]);
        prop_assert_eq!(binary(&united), binary(&both));

        united.make(&at("c")).expect("made");
        united.export(&at("c.jsonl")).expect("written");
        united.export(&at("c.ambience")).expect("written");
        prop_assert_eq!(fs::read(at("c.ambience")).expect("there"), binary(&both));
        for form in ["c", "c.jsonl", "c.ambience"] {
            prop_assert_eq!(binary(&read(&[&at(form)])), binary(&both), "{}", form);
        }
        read(&[&at("c"), &at("c.ambience")]).export(&at("again.jsonl")).expect("written");
        prop_assert_eq!(fs::read(at("c.jsonl")).expect("there"), fs::read(at("again.jsonl")).expect("there"));

        // Adding to a cache that exists, then once more.
        let (added, _) = read(&[&at("c.jsonl")]).add_to(&one).expect("added");
        let before: u64 = archive(&a).sets().map(|(_, set)| set.len() as u64).sum();
        let after: u64 = both.sets().map(|(_, set)| set.len() as u64).sum();
        prop_assert!(added + before >= after);
        prop_assert_eq!(binary(&read(&[&one])), binary(&both));
        let again = || read(&[&at("c.ambience")]).add_to(&one).expect("added");
        let (once, twice) = (again(), again());
        prop_assert_eq!((once.0, twice.0, once.1.appends), (0, 0, twice.1.appends));
    }

    #[test]
    fn files_that_are_not_whole_are_refused(cut in 0.0..1.0f64, flip: bool, bit in 0..8u8, noise: Vec<u8>) {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("a.ambience");
        let mut bytes = binary(&archive(&[label(NAMESPACE, None), batch(NAMESPACE, 1, 0, &[record(1, 0.0)])]));
        let at = (cut * bytes.len() as f64) as usize;
        if flip {
            bytes[at] ^= 1 << bit;
        } else {
            bytes.truncate(at);
        }
        let _ = binary::read(&noise[..], &mut |_| Ok(()));
        let _ = json::read(&noise[..], &mut |_| Ok(()));
        fs::write(&path, &bytes).expect("written");
        let error = Archive::default().unite(&path).expect_err("not whole");
        prop_assert_eq!(error.exit_code(), 2);
        prop_assert!(error.to_string().contains("a.ambience: byte "), "{}", error);
    }
}

#[test]
fn more_publications_than_a_server_remembers_merge_in_any_order() {
    let draft = |number: u32| {
        let mut bytes = [1; 32];
        bytes[..4].copy_from_slice(&number.to_le_bytes());
        Namespace(bytes)
    };
    let published: Vec<_> = (0..5000).map(|number| publication(draft(number), NAMESPACE)).collect();
    let late = [label(draft(0), Some(NAMESPACE)), batch(draft(0), 1, 4, &[record(1, 0.0)])];
    let before = archive(&[&late[..], &published].concat());
    let after = archive(&[&published[..], &late].concat());
    assert_eq!(binary(&before), binary(&after));
    assert_eq!(after.summaries().len(), 1);
}

#[test]
fn published_drafts_are_records_of_their_namespace() {
    let whole = archive(&[
        batch(DRAFT, 2, 1, &[record(1, 0.0)]),
        publication(DRAFT, NAMESPACE),
        batch(DRAFT, 1, 2, &[record(2, 0.0)]),
    ]);
    let summaries = whole.summaries();
    assert_eq!(summaries.len(), 1);
    assert_eq!((summaries[0].namespace, summaries[0].levels.clone()), (NAMESPACE, [(1, 1), (2, 1)].into()));
}

#[test]
fn what_is_wrong_with_a_line_is_named() {
    let mut lines = Vec::new();
    json::write(&mut lines, &batch(NAMESPACE, 1, 0, &[record(1, 0.0)])).expect("memory");
    json::write(&mut lines, &label(NAMESPACE, None)).expect("memory");
    json::write(&mut lines, &publication(DRAFT, NAMESPACE)).expect("memory");
    let sound = String::from_utf8(lines).expect("text");
    let mut count = 0;
    json::read(sound.as_bytes(), &mut |entry| {
        count += 1;
        convert::entry(&entry).map(drop).map_err(|error| error.to_string())
    })
    .expect("sound");
    assert_eq!(count, 3);
    let mut shrink = Vec::new();
    json::write(&mut shrink, &proposals(NAMESPACE, 2, &[(1, 0)])).expect("memory");
    let sound = format!("{sound}{}", String::from_utf8(shrink).expect("text"));
    let sevens = "07".repeat(32);
    for (from, to, says) in [
        ("\"radius\":0.1", "\"radius\":-1", "line 1: radius is -1, expected more than 0"),
        ("\"radius\":0.1", "\"radius\":\"far\"", "line 1: radius: invalid type: string \"far\", expected f32"),
        ("\"radius\":0.1", "\"radius\":1e60", "line 1: radius is not a finite number"),
        ("\"radius\":0.1,", "", "line 1: missing field `radius`"),
        ("\"radius\":0.1", "\"radius\":0.1,\"colour\":1", "line 1: colour: unknown field `colour`"),
        ("\"normal\":[0.0,", "\"normal\":[2.0,", "line 1: normal has length"),
        ("\"normal\":[0.0,", "\"normal\":[0.0,0.0,", "line 1: normal: "),
        ("\"level\":1", "\"level\":65", "line 1: level is 65"),
        ("\"id\":\"0", "\"id\":\"", "line 1: id: expected hexadecimal digits"),
        (sevens.as_str(), "0707", "line 1: namespace has 2 bytes, expected 32"),
        (
            "irradiance\",\"level",
            "light\",\"level",
            "line 1: kind: unknown variant `light`, expected one of `irradiance`, `shrink`, `radiance`",
        ),
        ("\"seed\":18446744073709551615", "\"seed\":-1", "line 2: seed: "),
        ("{\"type\":\"label\"", "{\"type\":\"lable\"", "line 2: type: unknown variant `lable`"),
        ("\"kind\":\"shrink\",", "", "line 4: kind: missing"),
        ("\"of\":\"", "\"of\":\"0", "line 4: of: expected hexadecimal digits"),
        ("\"of\":\"0000", "\"of\":\"1000", "line 4: id is not that of the content"),
        ("\"a\":0.1}", "\"a\":11}", "line 4: a is 11, expected more than 0 and at most 10"),
        ("{\"type\":\"publication\"", "[", "line 3: "),
        ("{\"type\":\"publication\"", "{}\n{\"type\":\"publication\"", "line 3: missing field `type`"),
    ] {
        let spoilt = sound.replacen(from, to, 1);
        assert_ne!(spoilt, sound, "{from}");
        let check = &mut |entry| convert::entry(&entry).map(drop).map_err(|error| error.to_string());
        let error = json::read(spoilt.as_bytes(), check).expect_err(to);
        assert!(error.starts_with(says), "{to}: {error}");
    }
    let long = "x".repeat(100_000);
    assert!(json::read(long.as_bytes(), &mut |_| Ok(())).expect_err("long").contains("line 1: longer than"));
}

/// Records of every kind come back from their lines bit for bit.
#[test]
fn records_of_radiance_have_lines() {
    let mut bits = 0u32;
    let mut next = || {
        bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f32::from_bits(bits >> 9 | 0x3f80_0000) - 1.5
    };
    let mut coefficients = || [0; 3].map(|_| [0; 16].map(|_| next()));
    let record = Radiance::<16> {
        id: RecordId(77),
        position: Vec3::new(0.1, 2.0, -3.0),
        normal: Vec3::Z,
        radius: 0.3,
        radius_min: 0.01,
        radius_max: 0.7,
        ellipse: [1.0, 0.1, 2.0],
        noise: 0.003,
        coefficients: coefficients(),
        gradient: [coefficients(), coefficients()],
    };
    let batch = convert::pack(&NAMESPACE, Tag { level: 1, step: 4 }, &[record]);
    let entry = v1::Entry { entry: Some(Kind::Batch(batch)) };
    let mut lines = Vec::new();
    json::write(&mut lines, &entry).expect("memory");
    let mut back = Vec::new();
    let mut take = |entry| {
        back.push(entry);
        Ok(())
    };
    json::read(lines.as_slice(), &mut take).expect("sound");
    assert_eq!(back, [entry]);
    let short = String::from_utf8(lines).expect("text").replacen("\"coefficients\":[[", "\"coefficients\":[[1.0,", 1);
    let error = json::read(short.as_bytes(), &mut |_| Ok(())).expect_err("one too many");
    assert!(error.starts_with("line 1: coefficients is 17, expected 4, 16, 36, 64 or 100"), "{error}");
}

#[test]
fn how_a_cache_was_left_is_told_and_nothing_is_mended() {
    let directory = tempfile::tempdir().expect("a directory");
    let entries: Vec<_> = (0..9).map(|id| batch(NAMESPACE, 1, 0, &[record(id, 0.0)])).collect();
    let path = cache(directory.path(), "a", &entries);
    let left = |path: &Path| Archive::default().unite(path).map(|source| source.state);
    assert_eq!(left(&path).expect("readable"), State::Closed);

    let (disk, _) = Disk::open(&path, Sync::PageCache).expect("a journal");
    let busy = left(&path).expect_err("in use");
    assert!(busy.to_string().ends_with("is in use by another process") && busy.exit_code() == 1, "{busy}");
    let crashed = directory.path().join("crashed");
    fs::create_dir(&crashed).expect("made");
    fs::copy(path.join(FILE), crashed.join(FILE)).expect("copied");
    drop(disk);
    assert_eq!(left(&crashed).expect("readable"), State::Crashed);

    let mut bytes = fs::read(path.join(FILE)).expect("there");
    let second = memchr::memmem::find(&bytes, &record(4, 0.0).id.0.to_le_bytes()).expect("there");
    bytes[second] ^= 1;
    let spoilt = directory.path().join("spoilt");
    fs::create_dir(&spoilt).expect("made");
    fs::write(spoilt.join(FILE), &bytes).expect("written");
    let State::Damaged { gaps, .. } = left(&spoilt).expect("readable") else { panic!("not told") };
    assert_eq!((gaps.lost, gaps.records), (vec![1..=1], 3));
    assert_eq!(fs::read(spoilt.join(FILE)).expect("there"), bytes);
    assert_eq!(fs::read_dir(&spoilt).expect("there").count(), 1);

    let nothing = directory.path().join("nothing");
    fs::create_dir(&nothing).expect("made");
    assert!(left(&nothing).expect_err("nothing").to_string().contains("holds no cache"));
}

#[test]
fn caches_are_made_only_where_there_is_nothing() {
    let directory = tempfile::tempdir().expect("a directory");
    let some = archive(&[batch(NAMESPACE, 1, 0, &[record(1, 0.0)])]);
    let taken = directory.path().join("taken");
    fs::create_dir(&taken).expect("made");
    fs::write(taken.join("precious"), "x").expect("written");
    assert!(some.make(&taken).expect_err("taken").to_string().contains("is not empty"));
    assert!(some.add_to(&taken).expect_err("taken").to_string().contains("neither a cache"));
    assert!(some.make(&directory.path().join("no/where")).expect_err("no parent").exit_code() == 2);
    assert_eq!(fs::read_dir(directory.path()).expect("there").count(), 1);
    let empty = directory.path().join("empty");
    fs::create_dir(&empty).expect("made");
    some.make(&empty).expect("made");
    assert_eq!(binary(&read(&[&empty])), binary(&some));
    assert!(some.export(&directory.path().join("a.txt")).expect_err("ending").to_string().contains(".jsonl or"));
    assert_eq!(fs::read_dir(directory.path()).expect("there").count(), 2);
}
