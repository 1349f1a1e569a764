use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::OnceLock;

use cache_proto::v1::{Entry, RecordBatch, entry::Entry as Kind};
use cache_server::journal::Journal as _;
use cache_server::journal::device::Sync;
use cache_server::journal::disk::{Disk, FILE};
use cache_server::journal::recovery::OpenError;
use cache_server::journal::salvage::Found;
use cache_server::journal::value::{self, Place};

use super::{byte, pieces};

/// Opens a journal on a file that may be anything; see [`store`].
const RAW: u8 = 0;
const CLOSED: u8 = 1;
const CRASHED: u8 = 2;

/// A file is opened, mended or refused; what is read from it was written to it, in that order; it then takes more.
///
/// The first byte chooses the file: the bytes that follow, a journal patched by them, or values placed by them.
pub fn store(data: &[u8]) {
    let Some((kind, rest)) = data.split_first() else { return };
    if let Ok((_, payload)) = value::open(rest) {
        value::entries(payload).for_each(drop);
    }
    let (bytes, written) = match kind % 4 {
        // Whatever has a checksum counts as written.
        RAW => (rest.to_vec(), None),
        CLOSED => (patched(file(true), rest), Some(appends().concat())),
        CRASHED => (patched(file(false), rest), Some(appends().concat())),
        _ => {
            let (bytes, written) = placed(rest);
            (bytes, Some(written))
        }
    };
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join(FILE);
    fs::write(&path, &bytes).expect("room");
    let found = Found::scan(&fs::File::open(&path).expect("there")).expect("readable");
    assert!(!found.gaps().to_string().is_empty());
    opened(directory.path(), written.as_deref());
}

fn opened(directory: &Path, written: Option<&[Entry]>) {
    let (mut disk, report) = match Disk::open(directory, Sync::PageCache) {
        Ok(opened) => opened,
        Err(OpenError::Foreign(_) | OpenError::Newer { .. }) => return,
        Err(error) => panic!("{error}"),
    };
    if let Some(damage) = &report.damage {
        assert!(damage.kept_as.is_file() && !damage.to_string().is_empty());
    }
    let before = held(&mut disk);
    // Values placed by the fuzzer may hold anything that has a checksum.
    let Some(before) = before else { return };
    if let Some(written) = written {
        let mut rest = before.iter();
        let mut wanted = rest.next();
        for entry in written {
            if wanted == Some(entry) {
                wanted = rest.next();
            }
        }
        assert_eq!(wanted, None, "what was never written, or not in this order");
    }
    let more = entry(200, 2);
    disk.append(std::slice::from_ref(&more)).expect("room");
    drop(disk);
    let (mut again, report) = Disk::open(directory, Sync::PageCache).expect("a journal");
    assert_eq!((report.damage, report.torn), (None, None));
    assert_eq!(held(&mut again), Some([before, vec![more]].concat()));
}

/// What a journal replays; `None` if it holds what is no entry.
fn held(disk: &mut Disk) -> Option<Vec<Entry>> {
    let mut held = Vec::new();
    let replayed = disk.replay(&mut |entry| {
        held.push(entry);
        Ok(())
    });
    replayed.is_ok().then_some(held)
}

/// An entry unlike that of any other number.
fn entry(number: u8, records: usize) -> Entry {
    let bytes: Vec<u8> = (0..records * 128).map(|i| (i as u8).wrapping_mul(number) ^ number).collect();
    let namespace = vec![number; 32].into();
    let batch = RecordBatch { namespace, kind: 1, level: 1, records: bytes.into(), step: number.into() };
    Entry { entry: Some(Kind::Batch(batch)) }
}

fn appends() -> &'static [Vec<Entry>] {
    static APPENDS: OnceLock<Vec<Vec<Entry>>> = OnceLock::new();
    APPENDS.get_or_init(|| {
        let sizes = [1, 0, 7, 80, 2, 40];
        (0..).zip(sizes).map(|(number, records)| vec![entry(number, records), entry(number + 100, 1)]).collect()
    })
}

/// The file of a journal of [`appends`]: closed as it should be, or as a crash leaves it.
fn file(closed: bool) -> &'static [u8] {
    static FILES: OnceLock<[Vec<u8>; 2]> = OnceLock::new();
    let files = FILES.get_or_init(|| {
        let directory = tempfile::tempdir().expect("a directory");
        let (mut disk, _) = Disk::open(directory.path(), Sync::PageCache).expect("a journal");
        for append in appends() {
            disk.append(append).expect("room");
        }
        let read = || fs::read(directory.path().join(FILE)).expect("the file");
        let crashed = read();
        drop(disk);
        [crashed, read()]
    });
    &files[usize::from(closed)]
}

/// A file with pieces of it replaced: each begins with where, three bytes. Of kind 1, the file is cut there; of kind 2,
/// they change bits; else they take the place of what was there.
fn patched(file: &[u8], patches: &[u8]) -> Vec<u8> {
    let mut bytes = file.to_vec();
    for (kind, patch) in pieces(patches).take(16) {
        let Some((&[a, b, c], patch)) = patch.split_first_chunk() else { continue };
        let at = u32::from_le_bytes([a, b, c, 0]) as usize % file.len();
        if kind % 4 == 1 {
            bytes.truncate(at);
        }
        for (old, new) in bytes.iter_mut().skip(at).zip(patch) {
            *old = if kind % 4 == 2 { *old ^ new } else { *new };
        }
    }
    bytes
}

/// A file of bytes and sound values: a piece of kind 0 is bytes; of others a value of the piece, whose sequence number and
/// records before it are said by the kind and the first bytes. Values of one number come in the order of their checksums,
/// so only the first counts as written.
fn placed(data: &[u8]) -> (Vec<u8>, Vec<Entry>) {
    let (mut bytes, mut values) = (Vec::new(), BTreeMap::new());
    for (kind, piece) in pieces(data).take(32) {
        if kind == 0 {
            bytes.extend(piece);
            continue;
        }
        let number = |byte: u8| if byte < 250 { u64::from(byte) } else { u64::MAX - u64::from(byte) };
        let mut place = Place { sequence: number(kind - 1), before: number(byte(piece, 0)) };
        if values.contains_key(&place.sequence) {
            continue;
        }
        let payload = piece.get(2..).unwrap_or(&[]);
        values.insert(place.sequence, value::entries(payload).map_while(Result::ok).collect::<Vec<_>>());
        bytes.extend(place.seal_payload(number(byte(piece, 1)), payload));
    }
    (bytes, values.into_values().flatten().collect())
}
