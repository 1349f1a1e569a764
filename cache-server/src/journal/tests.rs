use std::fs;
use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::Ordering;

use cache_proto::v1::{RecordBatch, entry};
use memchr::memmem;
use proptest::prelude::*;
use prost::Message as _;

use super::device::{Sync, Undo, tests as device};
use super::disk::{self, Disk, FILE};
use super::recovery::{OpenError, Report};
use super::value::{self, Place};
use super::*;

/// An entry of so many records, unlike that of any other number.
fn entry(number: u64, records: usize) -> Entry {
    let bytes: Vec<u8> = (0..records as u64 * 128).map(|i| (((i ^ number) * 0x9e37_79b9) >> 7) as u8).collect();
    let namespace = vec![number as u8; 32].into();
    let batch = RecordBatch { namespace, kind: 1, level: 1, records: bytes.into(), step: number as u32 };
    Entry { entry: Some(entry::Entry::Batch(batch)) }
}

/// What is appended to the files below: some small, some of several pages.
fn appends() -> Vec<Vec<Entry>> {
    let sizes = [1, 0, 7, 300, 2, 40, 1, 1, 900, 3, 0, 64];
    let append = |(number, &records): (usize, &usize)| {
        (0..1 + number % 3).map(|part| entry((number * 8 + part) as u64, records)).collect()
    };
    sizes.iter().enumerate().map(append).collect()
}

fn open(directory: &Path) -> (Disk, Report) {
    Disk::open(directory, Sync::PageCache).expect("a journal")
}

fn held(disk: &mut Disk) -> Vec<Entry> {
    let mut held = Vec::new();
    disk.replay(&mut |entry| {
        held.push(entry);
        Ok(())
    })
    .expect("readable");
    held
}

/// The file of a journal of [`appends`]: closed as it should be, or as it lies there after `kill -9`.
fn file(closed: bool) -> &'static [u8] {
    static FILES: OnceLock<[Vec<u8>; 2]> = OnceLock::new();
    let files = FILES.get_or_init(|| {
        let directory = tempfile::tempdir().expect("a directory");
        let (mut disk, _) = open(directory.path());
        for append in appends() {
            disk.append(&append).expect("room");
        }
        let read = || fs::read(directory.path().join(FILE)).expect("the file");
        let crashed = read();
        drop(disk);
        [crashed, read()]
    });
    &files[usize::from(closed)]
}

/// The values of [`appends`] as they lie in the file.
fn values() -> Vec<Vec<u8>> {
    let mut place = Place::default();
    appends().iter().map(|append| place.seal(append)).collect()
}

#[derive(Clone, Debug)]
enum Harm {
    Cut(f64),
    Zero(f64, usize),
    Flip(f64, u8),
    Noise(f64, Vec<u8>),
    Grow(usize),
}

fn harm() -> impl Strategy<Value = Harm> {
    let at = || 0.0..1.0;
    prop_oneof![
        at().prop_map(Harm::Cut),
        (at(), prop_oneof![1..64usize, 64..300_000usize]).prop_map(|(at, size)| Harm::Zero(at, size)),
        (at(), 0..8u8).prop_map(|(at, bit)| Harm::Flip(at, bit)),
        // Most of the file is room to grow: aim at what lies at the beginning.
        (0.0..0.01, 0..8u8).prop_map(|(at, bit)| Harm::Flip(at, bit)),
        (at(), prop::collection::vec(any::<u8>(), 1..5000)).prop_map(|(at, noise)| Harm::Noise(at, noise)),
        (1..10_000usize).prop_map(Harm::Grow),
    ]
}

fn spoil(bytes: &mut Vec<u8>, harm: &Harm) {
    let at = |at: &f64| (at * bytes.len() as f64) as usize;
    match harm {
        Harm::Cut(to) => bytes.truncate(at(to)),
        Harm::Zero(from, size) => {
            let from = at(from);
            bytes.iter_mut().skip(from).take(*size).for_each(|b| *b = 0);
        }
        Harm::Flip(place, bit) => {
            let place = at(place);
            bytes.iter_mut().skip(place).take(1).for_each(|b| *b ^= 1 << bit);
        }
        Harm::Noise(from, noise) => {
            let from = at(from);
            bytes.iter_mut().skip(from).zip(noise).for_each(|(b, n)| *b = *n);
        }
        Harm::Grow(size) => bytes.resize(bytes.len() + size, 0x5a),
    }
}

/// Whatever happens to a file: nothing that was not written is read, nothing that is whole is lost, what is missing
/// is named, and the mended file is sound.
fn mends(closed: bool, harms: &[Harm]) -> Result<(), TestCaseError> {
    let mut bytes = file(closed).to_vec();
    for harm in harms {
        spoil(&mut bytes, harm);
    }
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join(FILE);
    fs::write(&path, &bytes).expect("written");

    let whole: Vec<bool> = values().iter().map(|value| memmem::find(&bytes, value).is_some()).collect();
    let (mut disk, report) = match Disk::open(directory.path(), Sync::PageCache) {
        Ok(opened) => opened,
        Err(OpenError::Foreign(_)) => {
            prop_assert!(memmem::find(&bytes, &value::MAGIC).is_none() && bytes.iter().any(|b| *b != 0));
            prop_assert_eq!(fs::read(&path).expect("there"), bytes);
            return Ok(());
        }
        Err(other) => return Err(TestCaseError::fail(other.to_string())),
    };
    let kept: Vec<_> = appends().into_iter().zip(&whole).filter(|(_, whole)| **whole).map(|(a, _)| a).collect();
    prop_assert_eq!(held(&mut disk), kept.concat());
    prop_assert_eq!(report.appends, kept.len() as u64);
    prop_assert_eq!(report.records, kept.concat().iter().map(value::records).sum::<u64>());

    let missing: Vec<u64> = (0..).zip(&whole).filter(|(_, whole)| !**whole).map(|(at, _)| at).collect();
    match &report.damage {
        // After a crash, a last append that is not whole may be one that nobody was told is kept.
        None if !closed => prop_assert!(missing.is_empty() || missing == [appends().len() as u64 - 1]),
        None => prop_assert!(missing.is_empty() || bytes.is_empty(), "{:?}", missing),
        Some(damage) => {
            let last = whole.iter().rposition(|whole| *whole).map(|last| last as u64);
            prop_assert_eq!(damage.last, last);
            let before = |at: &u64| last.is_some_and(|last| *at < last);
            let named: Vec<u64> = damage.gaps.lost.iter().cloned().flatten().collect();
            prop_assert_eq!(named, missing.iter().copied().filter(before).collect::<Vec<_>>());
            let lost = missing.iter().filter(|at| before(at)).map(|at| appends()[*at as usize].clone());
            prop_assert_eq!(damage.gaps.records, lost.flatten().map(|entry| value::records(&entry)).sum::<u64>());
            prop_assert_eq!(fs::read(&damage.kept_as).expect("kept"), bytes);
        }
    }

    // It takes more, and is sound when it is opened again.
    disk.append(&[entry(1000, 5)]).expect("room");
    drop(disk);
    let (mut again, second) = open(directory.path());
    prop_assert_eq!((second.damage, second.torn, second.appends), (None, None, report.appends + 1));
    prop_assert_eq!(held(&mut again), [kept.concat(), vec![entry(1000, 5)]].concat());
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, ..ProptestConfig::default() })]

    #[test]
    fn damage_is_found_named_and_mended(closed: bool, harms in prop::collection::vec(harm(), 1..4)) {
        mends(closed, &harms)?;
    }

    #[test]
    fn files_of_others_are_left_alone(bytes in prop::collection::vec(any::<u8>(), 1..3000), redb: bool) {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join(FILE);
        let bytes = if redb { [b"redb\x1a\x0a\xa9\x0d\x0a", &bytes[..]].concat() } else { bytes };
        prop_assume!(bytes.iter().any(|b| *b != 0));
        fs::write(&path, &bytes).expect("written");
        let error = Disk::open(directory.path(), Sync::PageCache).err().expect("refused");
        prop_assert_eq!(error.exit_code(), 2);
        prop_assert!(error.to_string().contains("no journal of ambience"), "{}", error);
        prop_assert_eq!(fs::read(&path).expect("there"), bytes);
    }
}

/// redb mends what a crash left while it opens the file, and finds the damage only then.
#[test]
fn a_damaged_file_is_kept_as_it_was_found() {
    let grown = [Harm::Zero(0.8183776436539433, 1), Harm::Grow(4096)];
    let flipped = [Harm::Flip(0.0001760076096799051, 0), Harm::Flip(0.030133424515349377, 0)];
    for harms in [&grown, &flipped] {
        mends(false, harms).expect("mended");
    }
}

#[test]
fn what_was_appended_comes_back_in_order() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("new");
    let mut expected = Vec::new();
    for round in 0..3 {
        let (mut disk, report) = open(&path);
        assert_eq!((report.appends, report.damage), (round * 12, None));
        assert_eq!(held(&mut disk), expected);
        for append in appends() {
            disk.append(&append).expect("room");
            expected.extend(append);
        }
        disk.append(&[]).expect("nothing to do");
        assert_eq!(held(&mut disk), expected);
    }
}

/// The page cache outlives the process: a copy of the file while it is open is what `kill -9` leaves.
#[test]
fn after_a_crash_every_append_is_there() {
    let directory = tempfile::tempdir().expect("a directory");
    let (mut disk, _) = open(directory.path());
    let mut kept = Vec::new();
    for (number, append) in appends().into_iter().enumerate() {
        disk.append(&append).expect("room");
        kept.extend(append);
        let crashed = tempfile::tempdir().expect("a directory");
        fs::copy(directory.path().join(FILE), crashed.path().join(FILE)).expect("copied");
        let (mut recovered, report) = open(crashed.path());
        assert_eq!((report.appends, report.damage, report.torn), (number as u64 + 1, None, None));
        assert_eq!(held(&mut recovered), kept);
    }
}

/// The same bytes tell of a crash in one file and of nothing in the other: an append that failed may have left them.
#[test]
fn only_a_crash_leaves_a_torn_append() {
    let next = appends().len() as u64;
    let mut begun = Place { sequence: next, before: 0 }.seal(&[entry(1000, 1)]);
    *begun.last_mut().expect("a byte") ^= 1;
    for (closed, torn) in [(false, Some(next)), (true, None)] {
        let mut bytes = file(closed).to_vec();
        let free = memmem::find(&bytes, &[0; 4096]).expect("a page nobody uses");
        bytes[free..free + begun.len()].copy_from_slice(&begun);
        let directory = tempfile::tempdir().expect("a directory");
        fs::write(directory.path().join(FILE), bytes).expect("written");
        let report = open(directory.path()).1;
        assert_eq!((report.appends, report.torn, report.damage), (next, torn, None));
    }
}

/// redb would make room for pages of 4 GiB.
#[test]
fn a_header_that_claims_more_than_the_file_is_not_believed() {
    for closed in [false, true] {
        for highest in [64 + 15, 64 + 47, 192 + 15, 192 + 47] {
            let mut bytes = file(closed).to_vec();
            bytes[highest] = 20 << 3;
            let directory = tempfile::tempdir().expect("a directory");
            fs::write(directory.path().join(FILE), bytes).expect("written");
            let (mut disk, report) = open(directory.path());
            assert_eq!(held(&mut disk), appends().concat());
            let reason = report.damage.expect("told").reason;
            assert!(reason.contains("names pages larger than the file"), "{reason}");
        }
    }
}

/// The power is cut at any moment of an append, and what the kernel had not yet brought to the device is lost, any part of
/// it: what was acknowledged before is there, and nothing that was not appended.
#[test]
fn after_a_power_cut_every_acknowledged_append_is_there() {
    let unsynced = device::Unsynced::default();
    device::UNSYNCED.set(Some(unsynced.clone()));
    let directory = tempfile::tempdir().expect("a directory");
    let (mut disk, _) = Disk::open(directory.path(), Sync::Device).expect("a journal");
    device::UNSYNCED.set(None);
    unsynced.take();
    let mut random = 1u64;
    let mut coin = || {
        random = random.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        random >> 63 == 0
    };
    let (mut kept, mut undone) = (Vec::new(), 0);
    for append in appends() {
        disk.append(&append).expect("room");
        let more = [kept.clone(), append].concat();
        let file = fs::File::open(directory.path().join(FILE)).expect("there");
        let during = unsynced.take();
        assert!(!during.is_empty(), "nobody waited for the device");
        let now = unsynced.moment(&file).expect("readable");
        for (moment, acknowledged) in during.iter().map(|moment| (moment, &kept)).chain([(&now, &more)]) {
            for _ in 0..4 {
                let left = tempfile::tempdir().expect("a directory");
                fs::write(left.path().join(FILE), moment.cut(&mut coin)).expect("written");
                let (mut disk, report) = open(left.path());
                let held = held(&mut disk);
                assert!(held == *acknowledged || held == more, "{report:?}, {} acknowledged", acknowledged.len());
                undone += usize::from(held.len() < more.len());
            }
        }
        kept = more;
    }
    assert!(undone > 10, "no cut undid anything: {undone}");
}

#[test]
fn one_process_at_a_time() {
    let directory = tempfile::tempdir().expect("a directory");
    let (disk, _) = open(directory.path());
    let error = Disk::open(directory.path(), Sync::PageCache).err().expect("refused");
    assert!(error.to_string().ends_with("is in use by another process"), "{error}");
    drop(disk);
    open(directory.path());
}

#[test]
fn empty_and_zeroed_files_are_journals() {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join(FILE);
    fs::write(&path, []).expect("written");
    assert_eq!(open(directory.path()).1, Report::default());
    fs::write(&path, [0; 10_000]).expect("written");
    let (_, report) = open(directory.path());
    let damage = report.damage.expect("told").to_string();
    assert!(damage.contains("nothing in it could be read") && damage.contains("journal.redb.damaged-1"), "{damage}");
}

#[test]
fn a_directory_that_cannot_be_is_named() {
    let error = Disk::open(Path::new("/no/such/directory"), Sync::PageCache).err().expect("refused");
    assert_eq!(error.exit_code(), 2);
    assert!(error.to_string().contains("/no/such/directory"), "{error}");
    let directory = tempfile::tempdir().expect("a directory");
    fs::create_dir(directory.path().join(FILE)).expect("made");
    let error = Disk::open(directory.path(), Sync::PageCache).err().expect("refused");
    assert!(error.to_string().ends_with("is not a file"), "{error}");
}

#[test]
fn newer_journals_are_refused_and_left_alone() {
    let directory = tempfile::tempdir().expect("a directory");
    drop(open(directory.path()));
    let path = directory.path().join(FILE);
    let database = disk::open(&path, Sync::PageCache, Undo::default()).expect("open");
    disk::tests::claim_format(&database, value::FORMAT + 1);
    drop(database);
    let error = Disk::open(directory.path(), Sync::PageCache).err().expect("refused");
    assert_eq!(error.exit_code(), 2);
    assert!(error.to_string().contains("has format 2, this build reads up to format 1"), "{error}");
    assert!(!directory.path().join("journal.redb.damaged-1").exists());
}

#[test]
fn a_full_disk_is_told_and_passes() {
    let room = device::ROOM.with_borrow(Clone::clone);
    let directory = tempfile::tempdir().expect("a directory");
    let (mut disk, _) = open(directory.path());
    disk.append(&[entry(0, 10)]).expect("room");
    for more in [0, 100, 5000, 20_000] {
        room.store(more, Ordering::Relaxed);
        let full = disk.append(&[entry(1, 4000)]).expect_err("full");
        assert_eq!(full.kind(), std::io::ErrorKind::StorageFull, "{full}");
        assert!(disk.append(&[entry(2, 4000)]).is_err());
    }
    room.store(usize::MAX, Ordering::Relaxed);
    disk.append(&[entry(3, 10)]).expect("room again");
    assert_eq!(held(&mut disk), [entry(0, 10), entry(3, 10)]);
    drop(disk);
    let (mut again, report) = open(directory.path());
    assert_eq!((report.appends, report.damage), (2, None));
    assert_eq!(held(&mut again), [entry(0, 10), entry(3, 10)]);
}

#[test]
fn large_appends_are_split_and_too_large_entries_refused() {
    let directory = tempfile::tempdir().expect("a directory");
    let (mut disk, _) = open(directory.path());
    let many: Vec<_> = (0..30).map(|number| entry(number, 4096)).collect();
    disk.append(&many).expect("room");
    assert!(disk.append(&[entry(99, 200_000)]).is_err());
    assert_eq!(held(&mut disk), many);
    drop(disk);
    let report = open(directory.path()).1;
    assert_eq!((report.appends, report.records), (5, 30 * 4096));
}

#[test]
fn entries_are_read_one_at_a_time_up_to_the_first_that_is_none() {
    let payload = [&entry(1, 2).encode_length_delimited_to_vec()[..], &[0, 0, 9, 9]].concat();
    let read: Vec<_> = value::entries(&payload).collect();
    let none = Entry { entry: None };
    assert_eq!(read, [Ok(entry(1, 2)), Ok(none.clone()), Ok(none), Err(value::Unsound::Payload)]);
    assert!(value::entries(&vec![0; value::PAYLOAD_MAX]).take(1).all(|entry| entry.is_ok()));
}

#[test]
fn sequence_numbers_of_a_liar_are_counted_without_overflow() {
    let value = |(sequence, before)| {
        let value = Place { sequence, before }.seal(&[]);
        (0, value::Header::read(&value).expect("a header"))
    };
    let values = [(2, u64::MAX), (5, 0), (9, u64::MAX)].map(value).to_vec();
    let gaps = super::salvage::Found { values, ..Default::default() }.gaps();
    assert_eq!((gaps.lost.len(), gaps.records), (3, u64::MAX));
}
